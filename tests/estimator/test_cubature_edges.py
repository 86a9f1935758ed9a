"""Square-root cubature filtering where something is singular, missing, strange or wrong."""

from __future__ import annotations

import math

import numpy as np
import pytest

from estimator import cubature

I2 = np.eye(2)


def same(x):
    return x.copy()


def first(x):
    return x[:1].copy()


def test_a_model_that_projects_leaves_what_it_drops_unsmoothed():
    # both new states are the first old one: the second old one was never seen
    root = np.array([[1.0, 0.0], [0.6, 0.8]])
    mean, smoothed = cubature.smooth_step(
        np.zeros(2), root, lambda x: np.array([x[0], x[0]]), np.zeros((2, 1)), [0.3, 0.3], 1e-3 * np.eye(2)
    )
    assert smoothed[1] @ smoothed[1] == pytest.approx(0.64, rel=1e-4)  # what the first does not say of it
    assert mean == pytest.approx([0.3, 0.18], rel=1e-9)


def test_two_exact_measurements_of_one_thing_count_once():
    mean, root = cubature.update(
        np.zeros(2), [[2.0, 0.0], [0.7, 1.3]], lambda x: np.array([x[0], x[0]]), [0.5, 0.5], np.zeros((2, 2))
    )
    assert mean == pytest.approx([0.5, 0.175]) and np.hypot(*root[1]) == pytest.approx(1.3, rel=1e-6)
    record = cubature.filter_interval(
        np.zeros(2),
        [[2.0, 0.0], [0.7, 1.3]],
        same,
        lambda x: np.array([x[0], x[0]]),
        [[0.5, 0.5]],
        I2[:, :0],
        I2[:, :0],
    )
    assert record.flags[0] == cubature.DEGENERATE


@pytest.mark.parametrize("step", [cubature.filter_step, cubature.backward_smoothing_step, cubature.diplf_step])
def test_a_state_that_is_known_stays_known(step):
    mean, root = step(
        [1.0, 2.0], [[0.0, 0.0], [0.0, 1.0]], same, lambda x: x[:1] + x[1:], [3.5], np.zeros((2, 1)), [[1.0]]
    )
    assert mean[0] == pytest.approx(1.0, abs=1e-12) and abs(root[0]).max() < 1e-12 and 2.0 < mean[1] < 3.5


SINGULAR = {  # mean, factor, phi, h, sqrt_q: all leave a state without a pivot of its own
    "noise on the second": ([0.0, 0.0], np.zeros((2, 2)), I2, [[0.0, 1.0]], [[0.0], [1.0]]),
    "noise on the velocity": ([0.0, 1.0], np.zeros((2, 2)), [[1.0, 1.0], [0.0, 1.0]], [[0.0, 1.0]], [[0.0], [1.0]]),
    "content under a null pivot": ([0.0, 0.0], [[0.0, 0.0], [1.0, 0.0]], I2, [[0.0, 1.0]], np.zeros((2, 1))),
    "projected": (
        np.zeros(3), [[1.0, 0.0, 0.0], [0.3, 0.7, 0.0], [0.2, 0.1, 0.5]],
        [[1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], [[0.0, 0.0, 1.0]], np.zeros((3, 1)),
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", SINGULAR)
@pytest.mark.parametrize("step", [cubature.filter_step, cubature.diplf_step])
def test_with_a_singular_factor_a_linear_step_is_that_of_the_kalman_filter(case, step):
    mean, root, phi, h, noise = (np.asarray(a, float) for a in SINGULAR[case])
    p = phi @ root @ root.T @ phi.T + noise @ noise.T
    gain = p @ h.T / (h @ p @ h.T + 1.0)
    known = phi @ mean + gain @ (2.0 - h @ phi @ mean)
    for more in ({}, {"iterations": 3}) if step is cubature.diplf_step else ({},):
        found, factor = step(mean, root, lambda x: phi @ x, lambda x: h @ x, [2.0], noise, [[1.0]], **more)
        np.testing.assert_allclose(found, known, atol=1e-12)
        np.testing.assert_allclose(factor @ factor.T, p - gain @ h @ p, atol=1e-12)
    z, models = np.full((1, 1), 2.0), (lambda x: phi @ x, lambda x: h @ x)
    method = "diplf" if step is cubature.diplf_step else "filter"
    record = cubature.filter_interval(mean, root, *models, z, noise, [[1.0]], method=method)
    np.testing.assert_allclose(record.mean[-1], known, atol=1e-12)


def test_angles_are_numbers_of_components_and_no_mask():
    with pytest.raises(ValueError, match="angles is a mask: the numbers of the components are needed"):
        cubature.update(np.zeros(2), I2, same, [0.0, 0.0], I2, angles=[False, True])


@pytest.mark.parametrize("step", [cubature.filter_step, cubature.backward_smoothing_step, cubature.diplf_step])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_one_state_many_measurements_and_the_given_precision(step, dtype):
    mean, root = np.ones(1, dtype), np.ones((1, 1), dtype)
    z = np.array([1.1, 0.9, 1.3], dtype)
    before = mean.copy(), root.copy(), z.copy()

    def three(x):
        assert x.dtype == dtype
        return np.repeat(x, 3)

    new, new_root = step(mean, root, same, three, z, np.ones((1, 4), dtype), np.eye(3, dtype=dtype))
    assert new.dtype == new_root.dtype == dtype and new_root[0, 0] > 0
    assert all(np.array_equal(a, b) for a, b in zip(before, (mean, root, z), strict=True))


def test_a_model_may_write_on_its_point():
    def careless(x):
        x += 1.0
        return x

    root = np.array([[1.0, 0.0], [0.5, 2.0]])
    mean, new = cubature.predict([0.0, 1.0], root, careless, np.zeros((2, 1)))
    assert mean == pytest.approx([1.0, 2.0]) and np.allclose(new, root)


def test_inputs_reach_the_model_step_by_step():
    u = np.array([[1.0], [10.0], [100.0]])
    record = cubature.smooth_interval(
        [0.0], [[1e-3]], lambda x, u: x + u, lambda x, u: x - u, [[0.0], [1.0], [11.0]], [[1e-3]], [[1e-3]], u=u
    )
    assert record.mean[:, 0] == pytest.approx([0.0, 1.0, 11.0, 111.0], abs=1e-2)
    mean, _ = cubature.predict([0.0], [[1.0]], lambda x, u: x + u, [[1.0]], u=[7.0])
    assert mean[0] == pytest.approx(7.0)


def test_noises_may_change_from_step_to_step():
    q, r = np.array([[[1.0]], [[2.0]]]), np.array([[[1.0]], [[0.5]]])
    record = cubature.filter_interval([0.0], [[1.0]], same, same, [[1.0], [2.0]], q, r)
    mean, root = np.zeros(1), np.ones((1, 1))
    for z, sq, sr in zip([[1.0], [2.0]], q, r, strict=True):
        mean, root = cubature.filter_step(mean, root, same, same, z, sq, sr)
    assert np.array_equal(record.mean[-1], mean) and np.array_equal(record.sqrt_cov[-1], root)


def test_an_upper_factor_is_as_good_as_a_lower_one():
    lower = np.array([[1.0, 0.0], [0.5, 2.0]])
    upper = np.linalg.qr(lower.T @ np.eye(2))[1].T @ np.array([[0.6, 0.8], [-0.8, 0.6]])
    for own, other in zip(*(cubature.predict([0.0, 0.0], s, same, I2) for s in (lower, upper)), strict=True):
        assert np.allclose(own, other)


def test_what_is_not_finite_is_named_with_its_step():
    def breaks(x):
        return np.array([x[0], math.nan if x[0] > 2.5 else x[1]])

    def grows(x):
        return x + np.array([1.0, 0.0])

    args = (np.zeros(2), 1e-3 * I2)
    with pytest.raises(cubature.NotFinite, match=r"^f returned nan in component 1, at x = \["):
        cubature.predict([3.0, 0.0], 1e-3 * I2, breaks, I2)
    with pytest.raises(cubature.NotFinite, match=r"^h returned nan in component 1, at x = \["):
        cubature.update([3.0, 0.0], 1e-3 * I2, breaks, [0.0, 0.0], I2)
    with pytest.raises(ArithmeticError, match=r"^h returned nan in component 1 at step 2, at x = \["):
        cubature.filter_interval(*args, grows, breaks, np.full((5, 2), 3.0) * [1, 0], 1e-6 * I2, 1e3 * I2)


ASK = {
    "mean has shape (1, 2)": lambda: cubature.predict([[1.0, 2.0]], I2, same, I2),
    "mean is empty": lambda: cubature.predict([], np.zeros((0, 0)), same, I2),
    "mean is not finite": lambda: cubature.predict([np.nan, 0.0], I2, same, I2),
    "mean is not an array of numbers": lambda: cubature.predict(["a", "b"], I2, same, I2),
    "sqrt_cov has shape (3, 3): (2, 2) is needed": lambda: cubature.predict([0.0, 0.0], np.eye(3), same, I2),
    "sqrt_q has shape (3, 3): (2, any)": lambda: cubature.smooth_step([0.0, 0.0], I2, same, np.eye(3), [0.0, 0.0], I2),
    "sqrt_q has shape (2,)": lambda: cubature.predict([0.0, 0.0], I2, same, [1.0, 1.0]),
    "next_sqrt_cov has shape": lambda: cubature.smooth_step([0.0, 0.0], I2, same, I2, [0.0, 0.0], np.eye(3)),
    "z has shape (1,): (2,) is needed": lambda: cubature.update([0.0, 0.0], I2, same, [1.0], I2),
    "z is infinite": lambda: cubature.update([0.0, 0.0], I2, same, [1.0, np.inf], I2),
    "z is infinite at step 1": lambda: cubature.filter_interval(
        [0.0], [[1.0]], same, same, [[1], [np.inf]], [[1]], [[1]]
    ),
    "z has shape (2,): (N, m)": lambda: cubature.filter_interval([0.0], [[1.0]], same, same, [1, 2], [[1]], [[1]]),
    "sqrt_r has shape (2, 2) per step": lambda: cubature.filter_interval([0.0], [[1.0]], same, same, [[1]], [[1]], I2),
    "sqrt_q is given for 3 steps, z for 1": lambda: cubature.filter_interval(
        [0.0], [[1.0]], same, same, [[1]], np.ones((3, 1, 1)), [[1]]
    ),
    "u is given for 2 steps, z for 1": lambda: cubature.filter_interval(
        [0.0], [[1.0]], same, same, [[1]], [[1]], [[1]], u=[[1], [2]]
    ),
    "angles names component 2": lambda: cubature.update([0.0, 0.0], I2, same, [0.0, 0.0], I2, angles=(2,)),
    "iterations is 0": lambda: cubature.diplf_step([0.0], [[1.0]], same, same, [0.0], [[1]], [[1]], iterations=0),
    "method is 'ckf'": lambda: cubature.filter_interval([0.0], [[1.0]], same, same, [[1]], [[1]], [[1]], method="ckf"),
    "lag is -1": lambda: cubature.fixed_lag([0.0], [[1.0]], same, same, [[1]], [[1]], [[1]], -1),
    "f returned shape (1,): (2,) is needed": lambda: cubature.predict([0.0, 0.0], I2, first, I2),
    "h returned shape (1,): (2,) is needed": lambda: cubature.update([0.0, 0.0], I2, first, [0.0, 0.0], I2),
    "a has shape (3,)": lambda: cubature.triangular([1.0, 2.0, 3.0]),
    "a is not finite": lambda: cubature.triangular([[np.inf]]),
}


@pytest.mark.parametrize("message", ASK)
def test_what_does_not_fit_is_named(message):
    with pytest.raises(ValueError) as error:
        ASK[message]()
    assert str(error.value).startswith(message)
