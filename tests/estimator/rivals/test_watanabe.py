"""FPS (reconstructed): information backward, estimates forward, no inverse of phi."""

import numpy as np
import pytest

from estimator import LinearModel, Unobservable, smooth
from estimator.rivals import entry, watanabe
from tests.estimator.oracle import batch, exact, in_correlation, in_sigmas, problem, relative


def deviations(covariance):
    return np.sqrt(np.einsum("jii->ji", covariance))


def smoothed(case, per_component_mwgs):
    model = case.model
    n, p, count = model.n, model.p, case.z.shape[0]
    x, (ut, d) = case.x0.copy(), entry.factors(case.p0, model.phi.dtype)
    b, qs, gs = np.empty((count, p, n)), np.empty((count, p)), np.empty((count, p))
    y, info_ut, info_d = np.empty(n), np.empty((n, n)), np.empty(n)
    watanabe.backward(model.phi, model.gamma, model.q, *model.whitened(case.z), y, info_ut, info_d, b, qs, gs)
    watanabe.combine(info_ut, info_d, y, x, ut, d)
    room = entry.Room.of(frozenset({"std", "covariance"}), count, n, model.phi.dtype)
    watanabe.forward(
        model.phi, model.gamma, model.q, b, qs, gs, x, ut, d, per_component_mwgs,
        room.mean, room.variance, room.covariance, room.cross,
    )  # fmt: skip
    return room


@pytest.mark.parametrize("kind", [{}, {"missing": 0.4}, {"quiet": 0.5}])
def test_both_ways_to_condition_on_a_component_are_one(kind):
    case = problem(0, 6, 3, 2, 20, **kind)
    a, b = smoothed(case, False), smoothed(case, True)
    assert np.allclose(a.mean, b.mean, rtol=1e-11, atol=1e-12)
    assert np.allclose(a.covariance, b.covariance, rtol=1e-11, atol=1e-12)


@pytest.mark.parametrize("kind", [{}, {"missing": 0.3}, {"correlated": True}, {"quiet": 0.4}])
def test_no_prior_is_no_special_case_where_the_measurements_suffice(kind):
    for seed, (n, p, m) in enumerate([(1, 1, 1), (3, 2, 2), (6, 2, 3)]):
        case = problem(seed, n, p, m, 25, prior=False, **kind)
        fps = smooth(case.model, case.z, method="watanabe")
        mean, covariance = batch(case)
        std = deviations(covariance)
        assert in_sigmas(fps.mean, mean, std) < 1e-8 and relative(fps.std, std) < 1e-8
        assert in_correlation(fps.covariance, covariance) < 1e-8
        assert np.isnan(fps.filtered_mean[:-1]).all() and np.isinf(fps.filtered_std[:-1]).all()


def test_an_unobserved_direction_of_the_first_epoch_is_named():
    model = LinearModel(np.eye(3), np.eye(3), np.full(3, 0.1), [[1.0, 0.0, 0.0], [0.0, 0.0, 2.0]], [1.0, 1.0])
    with pytest.raises(Unobservable, match=r"the direction \+1 x\[1\]$") as caught:
        smooth(model, np.ones((20, 2)), method="watanabe")
    assert np.array_equal(caught.value.direction, [0.0, 1.0, 0.0]) and caught.value.count == 1
    oblique = LinearModel(np.eye(3), np.eye(3), np.full(3, 0.1), [[0.1, 0.2, 0.0], [0.0, 0.0, 1.0]], [1.0, 1.0])
    with pytest.raises(Unobservable) as caught:
        smooth(oblique, np.ones((20, 2)), method="watanabe")
    assert np.allclose(caught.value.direction, [1.0, -0.5, 0.0], atol=1e-6)


def test_no_measurement_and_no_prior_is_nothing():
    model = LinearModel(np.eye(2), np.eye(2), [1.0, 1.0], np.eye(2), [1.0, 1.0])
    for z in (np.full((3, 2), np.nan), np.empty((0, 2))):
        with pytest.raises(Unobservable) as caught:
            smooth(model, z, method="watanabe")
        assert caught.value.count == 2


def test_a_singular_phi_is_nothing_special():
    for seed in range(4):
        case = problem(seed, 4, 2, 2, 12)
        phi = case.phi.copy()
        phi[5, :, 1] = 0.0  # x[1] is forgotten
        phi[8] = 0.0  # all is: begin again from process noise alone
        case = case.but(phi=phi)
        fps = smooth(case.model, case.z, **case.prior, method="watanabe")
        mean, covariance = batch(case)
        reference = np.einsum("jii->ji", covariance)
        assert np.allclose(fps.mean, mean, atol=1e-9) and np.allclose(fps.std**2, reference, rtol=1e-9, atol=1e-12)


def test_what_the_prior_knows_exactly_stays_so():
    case = problem(1, 3, 2, 2, 10)
    case = case.but(p0=np.diag([0.0, 0.0, 1.0]))
    fps = smooth(case.model, case.z, **case.prior, method="watanabe")
    assert np.array_equal(fps.std[0] == 0.0, [True, True, False])
    assert np.allclose(fps.mean, batch(case.but(p0=np.diag([1e-14, 1e-14, 1.0])))[0], atol=1e-9)


def test_near_perfect_measurements_leave_right_deviations():
    for seed in range(4):
        case = problem(seed, 4, 2, 2, 12, r_range=(1e-12, 1e6)).but(p0=1e8 * np.eye(4))
        fps = smooth(case.model, case.z, **case.prior, method="watanabe")
        _, std = exact(case)
        assert relative(fps.std, std) < 1e-6


def test_filtered_is_known_at_both_ends_only():
    case = problem(2, 4, 2, 2, 15)
    fps = smooth(case.model, case.z, **case.prior, method="watanabe")
    assert np.array_equal(fps.filtered_mean[0], case.x0)
    assert np.array_equal(fps.filtered_std[0] ** 2, np.sqrt(case.p0.diagonal()) ** 2)
    assert np.array_equal(fps.filtered_mean[-1], fps.mean[-1]) and np.array_equal(fps.filtered_std[-1], fps.std[-1])
    assert np.isnan(fps.filtered_mean[1:-1]).all() and np.isinf(fps.filtered_std[1:-1]).all()


def test_means_lose_digits_beside_near_perfect_measurements_and_no_more_than_is_said():
    lost = {"ms": 0.0, "watanabe": 0.0}
    for seed in range(20):
        case = problem(seed, 4, 2, 2, 12, r_range=(1e-12, 1e6)).but(p0=1e8 * np.eye(4))
        mean, std = exact(case)
        for method in lost:
            found = smooth(case.model, case.z, **case.prior, method=method).mean
            lost[method] = max(lost[method], in_sigmas(found, mean, std))
    assert lost["watanabe"] < 1e-3 and lost["ms"] < 1e-9, lost


def test_information_that_grows_without_bound_is_for_a_filter():
    # Without noise, measurements far ahead tell an unstable state at epoch 0 to more than 1e-154.
    model = LinearModel(np.diag([1.5, 0.9]), np.eye(2), [0.0, 0.0], np.eye(2), [1.0, 1.0])
    record = {"z": np.ones((2000, 2)), "x0": [0.0, 0.0], "p0": [1.0, 1.0]}
    with pytest.raises(ValueError, match=r"later measurements is no longer finite at step \d+: .*'ms' or 'bierman'"):
        smooth(model, **record, method="watanabe")
    for method in ("ms", "bierman"):
        assert np.isfinite(smooth(model, **record, method=method).mean).all()


def test_half_a_prior_is_none():
    model = LinearModel(np.eye(1), np.eye(1), [1.0], [[1.0]], [1.0])
    with pytest.raises(ValueError, match="x0 and p0 come together"):
        smooth(model, [[1.0]], x0=[0.0], method="watanabe")


def test_what_is_kept_per_step():
    case = problem(3, 5, 3, 2, 8)
    assert smooth(case.model, case.z, **case.prior, method="watanabe").bytes_per_step == 8 * (5 * 3 + 2 * 3)
