"""The textbook smoother agrees where it can, and says so where it cannot."""

import numpy as np
import pytest

from estimator import LinearModel, smooth
from tests.estimator.oracle import batch, in_sigmas, problem, relative


@pytest.mark.parametrize("kind", [{}, {"missing": 0.4}, {"correlated": True, "missing": 0.3}, {"quiet": 0.4}])
def test_rts_agrees_with_ms_on_well_conditioned_records(kind):
    for seed in range(5):
        case = problem(seed, 6, 3, 2, 40, **kind)
        ms, rts = (smooth(case.model, case.z, **case.prior, method=method) for method in ("ms", "rts"))
        for a, b, std in ((rts.mean, ms.mean, ms.std), (rts.filtered_mean, ms.filtered_mean, ms.filtered_std)):
            assert in_sigmas(a, b, std) < 1e-9
        assert relative(rts.std, ms.std) < 1e-9 and relative(rts.filtered_std, ms.filtered_std) < 1e-9


def test_rts_is_batch_least_squares():
    case = problem(9, 4, 2, 2, 20)
    smoothed = smooth(case.model, case.z, **case.prior, method="rts")
    mean, covariance = batch(case)
    std = np.sqrt(np.einsum("jii->ji", covariance))
    assert in_sigmas(smoothed.mean, mean, std) < 1e-10 and relative(smoothed.std, std) < 1e-10


def test_rts_takes_a_singular_phi():
    phi = np.array([[0.5, 0.0], [1.0, 0.0]])  # a value and its predecessor
    model = LinearModel(phi, np.eye(2), [1.0, 1.0], [[1.0, 1.0]], [0.1])
    smoothed = smooth(model, [[1.0], [2.0], [3.0]], x0=[0.0, 0.0], p0=[1.0, 1.0], method="rts")
    assert np.isfinite(smoothed.mean).all() and (smoothed.std > 0.0).all()


@pytest.mark.parametrize("method", ["rts", "joseph"])
@pytest.mark.parametrize(("phi", "p0"), [(np.diag([1.0, 0.0]), [1.0, 1.0]), (np.eye(2), [0.0, 0.0])])
def test_a_prediction_without_inverse_is_refused_and_the_way_out_is_one(phi, p0, method):
    model = LinearModel(phi, np.eye(2), [0.0, 0.0], np.eye(2), [1.0, 1.0])
    record = {"z": np.ones((5, 2)), "x0": [0.0, 0.0], "p0": p0}
    with pytest.raises(ValueError, match=r"predicted covariance at step 4 .*; 'watanabe' inverts neither it nor phi"):
        smooth(model, **record, method=method)
    smoothed = smooth(model, **record, method="watanabe")
    assert np.isfinite(smoothed.mean).all() and np.isfinite(smoothed.std).all()


def test_a_difference_of_covariances_that_turned_negative_is_refused_and_factors_are_the_way_out():
    # A prior of 1e8, and the same sum measured again and again to 1e-6: what is left of its variance is rounding.
    model = LinearModel(np.eye(2), np.zeros((2, 1)), [0.0], [[1.0, 0.3]], [1e-12])
    record = {"z": np.ones((5, 1)), "x0": [0.0, 0.0], "p0": [1e8, 1e8]}
    with pytest.raises(ValueError, match=r"innovation covariance at step 1 has lost .*'ms', 'bierman' and 'watanabe'"):
        smooth(model, **record, method="rts")
    along = 1e4 / np.hypot(1.0, 0.3)  # the deviation of the direction that no measurement tells
    for method in ("ms", "bierman", "watanabe"):
        assert np.allclose(smooth(model, **record, method=method).std, [0.3 * along, along], rtol=1e-6)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({}, "method 'rts' needs x0 and p0"),
        ({"x0": [0.0], "p0": np.eye(2)}, r"x0 has shape \(1,\)"),
        ({"x0": [0.0, 0.0], "p0": [1.0, np.inf]}, "x0 or p0 is not finite"),
        ({"x0": [0.0, 0.0], "p0": [-9.0, 1.0]}, "p0 is not symmetric and positive semidefinite"),
        ({"x0": [0.0, 0.0], "p0": [0.0, 0.0]}, "predicted covariance at step 1 is not positive definite"),
    ],
)
def test_what_rts_cannot_do_it_says(arguments, message):
    model = LinearModel(np.eye(2), np.zeros((2, 1)), [0.0], [[1.0, 0.0]], [1.0])
    with pytest.raises(ValueError, match=message):
        smooth(model, [[1.0], [2.0]], **arguments, method="rts")


def test_an_infinite_measurement_is_refused():
    model = LinearModel(np.eye(1), np.eye(1), [1.0], [[1.0]], [1.0])
    with pytest.raises(ValueError, match="z is infinite at step 1"):
        smooth(model, [[1.0], [np.inf]], x0=[0.0], p0=[1.0], method="rts")
