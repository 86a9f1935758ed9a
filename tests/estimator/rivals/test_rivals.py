"""Every rival solves the same problem: batch least squares over the whole record is the answer."""

import numpy as np
import pytest

from estimator import LinearModel, smooth
from estimator.linear import RESULTS
from estimator.rivals import METHODS, joseph, rts
from tests.estimator.oracle import batch, in_correlation, in_sigmas, problem, relative

KINDS = {
    "plain": {},
    "missing": {"missing": 0.4},
    "correlated": {"correlated": True, "missing": 0.3},
    "quiet": {"quiet": 0.5},
}
every = pytest.mark.parametrize("method", METHODS)
with_a_prior_only = pytest.mark.parametrize("method", ["rts", "joseph", "bierman"])


def deviations(covariance):
    return np.sqrt(np.einsum("jii->ji", covariance))


@every
@pytest.mark.parametrize("kind", KINDS.values(), ids=KINDS)
def test_every_rival_is_batch_least_squares(kind, method):
    for seed, (n, p, m) in enumerate([(1, 1, 1), (2, 1, 3), (5, 2, 2), (8, 4, 3)]):
        case = problem(seed, n, p, m, 20, **kind)
        smoothed = smooth(case.model, case.z, **case.prior, method=method)
        mean, covariance = batch(case)
        std = deviations(covariance)
        assert in_sigmas(smoothed.mean, mean, std) < 1e-9
        assert relative(smoothed.std, std) < 1e-10
        assert in_correlation(smoothed.covariance, covariance) < 1e-10


@every
def test_neighbours_covary_as_a_doubled_state_says(method):
    # The state (x_j, x_{j-1}), smoothed by batch least squares, holds the covariance of neighbours in its corner.
    case = problem(3, 3, 2, 2, 12, missing=0.2, quiet=0.3)
    one, none = np.eye(3), np.zeros((3, 3))
    phi = np.stack([np.block([[now, none], [one, none]]) for now in case.phi])
    doubled = case.but(
        phi=phi,
        gamma=np.concatenate([case.gamma, np.zeros_like(case.gamma)], axis=1),
        h=np.concatenate([case.h, np.zeros_like(case.h)], axis=2),
        x0=np.concatenate([case.x0, np.zeros(3)]),
        p0=np.block([[case.p0, none], [none, one]]),
    )
    smoothed = smooth(case.model, case.z, **case.prior, method=method, want=["cross"])
    _, covariance = batch(doubled)
    assert smoothed.cross.shape == (12, 3, 3)
    assert np.allclose(smoothed.cross, covariance[1:, 3:, :3], rtol=1e-10, atol=1e-12)


@with_a_prior_only
@pytest.mark.parametrize("kind", KINDS.values(), ids=KINDS)
def test_filtering_a_record_is_smoothing_every_beginning_of_it(kind, method):
    case = problem(4, 4, 2, 2, 12, **kind)
    smoothed = smooth(case.model, case.z, **case.prior, method=method)
    assert np.allclose(smoothed.filtered_mean[0], case.x0)
    assert np.allclose(smoothed.filtered_std[0] ** 2, case.p0.diagonal())
    for end in (1, 5, 12):
        cut = case.but(**{name: getattr(case, name)[:end] for name in ("phi", "gamma", "q", "h", "r", "z")})
        mean, covariance = batch(cut)
        std = deviations(covariance)[-1]
        assert in_sigmas(smoothed.filtered_mean[end], mean[-1], std) < 1e-10
        assert relative(smoothed.filtered_std[end], std) < 1e-10


@every
def test_covariances_are_symmetric_to_the_last_bit(method):
    case = problem(5, 7, 3, 3, 30, missing=0.3)
    covariance = smooth(case.model, case.z, **case.prior, method=method).covariance
    assert np.array_equal(covariance, covariance.transpose(0, 2, 1))


@every
@pytest.mark.parametrize("want", [(), *((name,) for name in RESULTS), ("std", "cross")])
def test_what_is_not_wanted_is_empty_and_what_is_does_not_depend_on_it(want, method):
    case = problem(6, 5, 2, 2, 15, missing=0.2)
    everything = smooth(case.model, case.z, **case.prior, method=method, want=RESULTS)
    part = smooth(case.model, case.z, **case.prior, method=method, want=want)
    assert np.allclose(part.mean, everything.mean, rtol=1e-12, atol=1e-12)
    for field, name in (
        ("std", "std"),
        ("covariance", "covariance"),
        ("cross", "cross"),
        ("filtered_mean", "filtered"),
        ("filtered_std", "filtered"),
    ):
        got, whole = getattr(part, field), getattr(everything, field)
        if name in want:
            assert np.array_equal(got, whole, equal_nan=True)
        else:
            assert got.shape == (0, *whole.shape[1:])


@every
@pytest.mark.parametrize("kind", KINDS.values(), ids=KINDS)
def test_float32_is_float64_to_a_few_digits(kind, method):
    case = problem(7, 6, 3, 3, 25, **kind)
    model = case.model
    single = LinearModel(model.phi, model.gamma, model.q, model.h, model.r, dtype=np.float32)
    exact = smooth(model, case.z, **case.prior, method=method, want=RESULTS)
    rough = smooth(single, case.z, **case.prior, method=method, want=RESULTS)
    assert all(field.dtype == np.float32 for field in rough if isinstance(field, np.ndarray))
    loss = 1e-2 if method in ("rts", "joseph") else 1e-4  # dense covariances lose what their factors keep
    assert in_sigmas(rough.mean, exact.mean, exact.std) < 10.0 * loss
    assert relative(rough.std, exact.std) < loss
    assert in_correlation(rough.covariance, exact.covariance) < loss
    assert rough.bytes_per_step * 2 == exact.bytes_per_step


@every
def test_constant_matrices_are_the_same_as_repeated_ones(method):
    rng = np.random.default_rng(8)
    parts = (
        0.5 * rng.normal(size=(4, 4)),
        rng.normal(size=(4, 2)),
        np.eye(2) + 0.5,
        rng.normal(size=(3, 4)),
        np.eye(3) + 0.3,
    )
    z, prior = rng.normal(size=(10, 3)), {"x0": np.zeros(4), "p0": np.eye(4), "method": method, "want": RESULTS}
    constant = smooth(LinearModel(*parts), z, **prior)
    repeated = smooth(LinearModel(*(np.repeat(a[None], 10, axis=0) for a in parts)), z, **prior)
    for a, b in zip(constant, repeated, strict=True):
        assert np.array_equal(a, b, equal_nan=True)


@every
def test_no_steps_give_the_prior(method):
    model = LinearModel(np.eye(2), np.eye(2), [1.0, 1.0], np.eye(2), [1.0, 1.0])
    smoothed = smooth(model, np.empty((0, 2)), x0=[1.0, 2.0], p0=[4.0, 9.0], method=method)
    assert np.array_equal(smoothed.mean, [[1.0, 2.0]]) and np.array_equal(smoothed.filtered_mean, [[1.0, 2.0]])
    assert np.array_equal(smoothed.std, [[2.0, 3.0]]) and np.array_equal(smoothed.filtered_std, [[2.0, 3.0]])
    assert smoothed.windows == []


@every
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"x0": [0.0], "p0": np.eye(2)}, r"x0 has shape \(1,\)"),
        ({"x0": [0.0, np.nan], "p0": np.eye(2)}, "x0 or p0 is not finite"),
        ({"x0": [0.0, 0.0], "p0": [1.0, np.nan]}, "x0 or p0 is not finite$"),
        ({"x0": [0.0, 0.0], "p0": [1.0, np.inf]}, "x0 or p0 is not finite; only 'ms' takes an infinite variance"),
        ({"x0": [0.0, 0.0], "p0": [[1.0, 2.0], [2.0, 1.0]]}, "p0 is not symmetric and positive semidefinite"),
        ({"x0": [0.0, 0.0], "p0": [[1.0, 0.5], [0.0, 1.0]]}, "p0 is not symmetric and positive semidefinite"),
        ({"x0": [0.0, 0.0], "p0": [-1.0, 1.0]}, "p0 is not symmetric and positive semidefinite"),
    ],
)
def test_a_prior_that_does_not_fit_is_refused(arguments, message, method):
    model = LinearModel(np.eye(2), np.zeros((2, 1)), [0.0], [[1.0, 0.0]], [1.0])
    with pytest.raises(ValueError, match=message):
        smooth(model, [[1.0], [2.0]], **arguments, method=method)


@with_a_prior_only
def test_a_covariance_cannot_start_from_nothing(method):
    model = LinearModel(np.eye(1), np.eye(1), [1.0], [[1.0]], [1.0])
    with pytest.raises(ValueError, match=f"method '{method}' needs x0 and p0: .*'ms' can"):
        smooth(model, [[1.0]], method=method)


@every
@pytest.mark.parametrize("prior", [{"x0": [0.0, 1e40], "p0": [1.0, 1.0]}, {"x0": [0.0, 0.0], "p0": [1e40, 1.0]}])
def test_a_prior_beyond_float32_is_refused_there(prior, method):
    parts = np.eye(2), np.eye(2), [1.0, 1.0], np.eye(2), [1.0, 1.0]
    with pytest.raises(ValueError, match="x0 or p0 is not finite in float32"):
        smooth(LinearModel(*parts, dtype=np.float32), np.ones((3, 2)), **prior, method=method)
    assert np.isfinite(smooth(LinearModel(*parts), np.ones((3, 2)), **prior, method=method).mean).all()


@every
def test_numbers_that_run_out_are_reported_with_the_step_and_not_returned(method):
    model = LinearModel(1e200 * np.eye(2), np.eye(2), [1.0, 1.0], np.eye(2), [1.0, 1.0])
    with pytest.raises(ValueError, match=r"no longer finite at step \d: check the units of phi"):
        smooth(model, np.ones((5, 2)), x0=[0.0, 0.0], p0=[1.0, 1.0], method=method)


@every
def test_what_grows_unseen_until_numbers_run_out_ends_the_record_before_that(method):
    # A standard deviation that grows 1.5-fold per step after the fifth, until its square is above 1.8e308.
    model = LinearModel(np.diag([1.5, 0.9]), np.eye(2), [1.0, 1.0], np.eye(2), [1.0, 1.0])
    z = np.full((2000, 2), np.nan)
    z[:5] = 1.0
    prior = {"x0": [0.0, 0.0], "p0": [1.0, 1.0], "method": method}
    with pytest.raises(ValueError, match=r"no longer finite at step 879: .*end the record before that step"):
        smooth(model, z, **prior)
    smoothed = smooth(model, z[:870], **prior, want=RESULTS)
    assert np.isfinite(smoothed.mean).all() and np.isfinite(smoothed.std).all()


@pytest.mark.parametrize("name", ["rts", "joseph"])
@pytest.mark.parametrize("kind", KINDS.values(), ids=KINDS)
def test_the_filter_alone_is_what_smoothing_calls_filtered(kind, name):
    case = problem(10, 5, 2, 2, 15, **kind)
    mean, std = {"rts": rts, "joseph": joseph}[name].filtered(case.model, case.z, case.x0, case.p0)
    smoothed = smooth(case.model, case.z, **case.prior, method=name)
    assert np.array_equal(mean, smoothed.filtered_mean) and np.array_equal(std, smoothed.filtered_std)


@pytest.mark.parametrize("module", [rts, joseph])
def test_the_filter_alone_runs_where_only_the_way_back_fails(module):
    model = LinearModel(np.eye(2), np.zeros((2, 1)), [0.0], [[1.0, 0.0]], [1.0])
    mean, std = module.filtered(model, [[1.0], [2.0]], [3.0, 4.0], [0.0, 0.0])
    assert np.array_equal(mean, [[3.0, 4.0]] * 3) and np.array_equal(std, np.zeros((3, 2)))
    with pytest.raises(ValueError, match=f"method '{module.__name__.split('.')[-1]}' needs x0 and p0"):
        module.filtered(model, [[1.0], [2.0]], None, None)


@every
def test_an_infinite_measurement_is_refused(method):
    model = LinearModel(np.eye(1), np.eye(1), [1.0], [[1.0]], [1.0])
    with pytest.raises(ValueError, match="z is infinite at step 1"):
        smooth(model, [[1.0], [np.inf]], x0=[0.0], p0=[1.0], method=method)


@every
def test_nothing_given_is_changed(method):
    case = problem(9, 4, 2, 2, 10)
    kept = [np.copy(a) for a in (case.z, case.x0, case.p0, case.phi, case.gamma, case.h)]
    smooth(model := case.model, case.z, **case.prior, method=method)
    first = smooth(model, case.z, **case.prior, method=method).mean
    assert np.array_equal(first, smooth(case.model, case.z, **case.prior, method=method).mean)
    for a, b in zip(kept, (case.z, case.x0, case.p0, case.phi, case.gamma, case.h), strict=True):
        assert np.array_equal(a, b, equal_nan=True)
