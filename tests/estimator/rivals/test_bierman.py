"""SS (reconstructed): covariance factors forward, one noise component at a time backward."""

import numpy as np
import pytest

from estimator import LinearModel, smooth
from estimator.rivals import bierman, entry
from tests.estimator.oracle import batch, exact, in_sigmas, problem, relative


def smoothed(case, per_component_mwgs):
    model = case.model
    n, p, count = model.n, model.p, case.z.shape[0]
    ut, d = entry.factors(case.p0, model.phi.dtype)
    x, b, qs, x_pred = case.x0.copy(), np.empty((count, p, n)), np.empty((count, p)), np.empty((count, n))
    h, r, z = model.whitened(case.z)
    room = entry.Room.of(frozenset({"std", "covariance"}), count, n, model.phi.dtype)
    bierman.forward(
        model.phi, model.gamma, model.q, h, r, z, x, ut, d, x_pred, b, qs, room.filtered_mean, room.filtered_variance
    )
    end = bierman.backward(
        model.phi, model.gamma, model.q, x_pred, b, qs, x, ut, d, 2.3e-16, per_component_mwgs,
        room.mean, room.variance, room.covariance, room.cross,
    )  # fmt: skip
    assert end == -1
    return room


@pytest.mark.parametrize("kind", [{}, {"missing": 0.4}, {"quiet": 0.5}])
def test_both_ways_to_condition_on_a_component_are_one(kind):
    case = problem(0, 6, 3, 2, 20, **kind)
    a, b = smoothed(case, False), smoothed(case, True)
    assert np.allclose(a.mean, b.mean, rtol=1e-11, atol=1e-12)
    assert np.allclose(a.covariance, b.covariance, rtol=1e-11, atol=1e-12)


def test_what_the_prior_knows_exactly_needs_no_inverse():
    # Variance zero at epoch 0, and noise that enters along it: q (P + q g g^T)^{-1} g is a limit.
    case = problem(1, 3, 2, 2, 10)
    case = case.but(
        p0=np.diag([0.0, 0.0, 1.0]), gamma=np.tile(np.eye(3)[:, :2], (10, 1, 1)), phi=np.tile(np.eye(3), (10, 1, 1))
    )
    ss = smooth(case.model, case.z, **case.prior, method="bierman")
    mean, std = batch(case.but(p0=np.diag([1e-14, 1e-14, 1.0])))[0], ss.std
    assert np.array_equal(ss.std[0] == 0.0, [True, True, False])
    assert np.allclose(ss.mean, mean, atol=1e-9) and (std[1:] > 0.0).all()


def test_near_perfect_measurements_leave_right_deviations():
    for seed in range(4):
        case = problem(seed, 4, 2, 2, 12, r_range=(1e-12, 1e6)).but(p0=1e8 * np.eye(4))
        ss = smooth(case.model, case.z, **case.prior, method="bierman")
        mean, std = exact(case)
        assert relative(ss.std, std) < 1e-6
        assert in_sigmas(ss.mean, mean, std) < 1e-9 + 1e4 * 2.3e-16 * np.abs(mean).max() / std.min()


def test_a_singular_phi_is_named_with_its_step():
    phi = np.repeat(np.eye(2)[None], 6, axis=0)
    phi[4, 1, 1] = 0.0
    model = LinearModel(phi, np.eye(2), [1.0, 1.0], np.eye(2), [1.0, 1.0])
    with pytest.raises(ValueError, match="phi is singular at step 4: method 'bierman' inverts it"):
        smooth(model, np.ones((6, 2)), x0=[0.0, 0.0], p0=[1.0, 1.0], method="bierman")


def test_what_is_kept_per_step():
    case = problem(2, 5, 3, 2, 8)
    assert smooth(case.model, case.z, **case.prior, method="bierman").bytes_per_step == 8 * (5 * 3 + 3 + 5)
