"""Square-root cubature filtering: exact where it is linear, sound where covariances are not, the same everywhere."""

from __future__ import annotations

import math
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numba import njit

from estimator import cubature

seeds = st.integers(0, 2**32 - 1)


def exact(a):
    """A matrix (or vector, as a column) of rationals."""
    a = np.asarray(a, float)
    return [[Fraction(float(x)) for x in np.atleast_1d(row)] for row in a]


def times(a, b):
    return [
        [sum((x * y for x, y in zip(row, column, strict=True)), Fraction(0)) for column in zip(*b, strict=True)]
        for row in a
    ]


def plus(a, b, sign=1):
    return [[x + sign * y for x, y in zip(r, s, strict=True)] for r, s in zip(a, b, strict=True)]


def turned(a):
    return [list(row) for row in zip(*a, strict=True)]


def inverse(a):
    n = len(a)
    a = [list(row) + [Fraction(int(i == j)) for j in range(n)] for i, row in enumerate(a)]
    for j in range(n):
        best = max(range(j, n), key=lambda i: abs(a[i][j]))
        a[j], a[best] = a[best], a[j]
        a[j] = [x / a[j][j] for x in a[j]]
        for i in range(n):
            if i != j and a[i][j]:
                a[i] = [x - a[i][j] * y for x, y in zip(a[i], a[j], strict=True)]
    return [row[n:] for row in a]


def square(root):
    return times(exact(root), turned(exact(root)))


def exact_filter(mean, root, phi, h, z, q, r):
    """Kalman filter in rational arithmetic; missing components left out. Means, covariances and predictions."""
    m, p, phi_, q_, r_, h_ = exact(mean), square(root), exact(phi), square(q), square(r), exact(h)
    filtered, predicted = [(m, p)], []
    for row in z:
        m, p = times(phi_, m), plus(times(times(phi_, p), turned(phi_)), q_)
        predicted.append((m, p))
        there = [i for i, value in enumerate(row) if not math.isnan(value)]
        if there:
            hj = [h_[i] for i in there]
            rj = [[r_[i][j] for j in there] for i in there]
            ph = times(p, turned(hj))
            gain = times(ph, inverse(plus(times(hj, ph), rj)))
            m = plus(m, times(gain, plus(exact([row[i] for i in there]), times(hj, m), -1)))
            p = plus(p, times(gain, turned(ph)), -1)
        filtered.append((m, p))
    return filtered, predicted


def exact_smoother(filtered, predicted, phi):
    smoothed, phi_ = [filtered[-1]], exact(phi)
    for (m, p), (mp, pp) in zip(filtered[-2::-1], predicted[::-1], strict=True):
        w = times(times(p, turned(phi_)), inverse(pp))
        newer, covariance = smoothed[0]
        change = times(times(w, plus(covariance, pp, -1)), turned(w))
        smoothed.insert(0, (plus(m, times(w, plus(newer, mp, -1))), plus(p, change)))
    return smoothed


def deviations(states):
    return np.array([[math.sqrt(p[i][i]) for i in range(len(p))] for _, p in states])


def means(states):
    return np.array([[float(x[0]) for x in m] for m, _ in states])


def linear(a):
    a = np.asarray(a)
    return lambda x: a.astype(x.dtype) @ x


def proper(root):
    return np.isfinite(root).all() and np.array_equal(root, np.tril(root)) and (np.diagonal(root, 0, -2, -1) >= 0).all()


def problem(seed, n=3, m=2, q=2, steps=6, missing=0.3):
    rng = np.random.default_rng(seed)
    phi, h = np.eye(n) + 0.3 * rng.normal(size=(n, n)), rng.normal(size=(m, n))
    sq, sr = rng.normal(size=(n, q)), np.tril(rng.normal(size=(m, m))) + 2.0 * np.eye(m)
    z = np.where(rng.random((steps, m)) < missing, np.nan, rng.normal(size=(steps, m)))
    return rng.normal(size=n), np.tril(rng.normal(size=(n, n))) + 2.0 * np.eye(n), phi, h, z, sq, sr


# the radar problem, with products for powers: the same operations in Python and compiled


def turn(x):
    a = x[4]
    sw, cw = (math.sin(a) / a, 2.0 * math.sin(0.5 * a) * math.sin(0.5 * a) / a) if abs(a) > 1e-9 else (1.0, 0.5 * a)
    y = np.empty_like(x)
    y[0] = x[0] + sw * x[1] - cw * x[3]
    y[1] = math.cos(a) * x[1] - math.sin(a) * x[3]
    y[2] = x[2] + cw * x[1] + sw * x[3]
    y[3] = math.sin(a) * x[1] + math.cos(a) * x[3]
    y[4] = a
    return y


def radar(x):
    z = np.empty_like(x[:2])
    z[0] = math.sqrt(x[0] * x[0] + x[2] * x[2])
    z[1] = math.atan2(x[2], x[0])
    return z


TURN, RADAR = njit(turn), njit(radar)
Q = np.zeros((5, 5))
Q[:2, :2] = Q[2:4, 2:4] = 0.1 * np.array([[1 / 3, 1 / 2], [1 / 2, 1]])
Q[4, 4] = 1.75e-4
SQ, SR = np.linalg.cholesky(Q), np.diag([10.0, math.sqrt(10.0) * 1e-3])
X0, S0 = np.array([1000.0, 300.0, 1000.0, 0.0, -math.radians(3.0)]), np.diag(np.sqrt([100.0, 10.0, 100.0, 10.0, 0.01]))


def track(seed, steps, start=X0):
    rng = np.random.default_rng(seed)
    x, z = start, []
    for _ in range(steps):
        x = turn(x) + SQ @ rng.normal(size=5)
        z.append(radar(x) + SR @ rng.normal(size=2))
    return np.array(z)


@given(seeds, st.integers(1, 7), st.integers(1, 12))
@settings(max_examples=60, deadline=None)
def test_a_triangular_factor_has_the_same_square(seed, n, columns):
    a = np.random.default_rng(seed).normal(size=(n, columns))
    a[:, ::3] *= 1e-7
    root = cubature.triangular(a)
    assert proper(root) and np.allclose(root @ root.T, a @ a.T, rtol=1e-12, atol=1e-13 * n)
    assert not root[:, columns:].any()


@pytest.mark.parametrize("scale", [1e-150, 1.0, 1e150])
def test_a_triangular_factor_keeps_its_digits_far_from_one(scale):
    a = np.random.default_rng(3).normal(size=(4, 6))
    assert np.allclose(cubature.triangular(a * scale) / scale, cubature.triangular(a), rtol=1e-12)


@given(seeds, st.integers(1, 4), st.integers(1, 5), st.integers(0, 4))
@settings(max_examples=40, deadline=None)
def test_on_linear_models_it_is_the_kalman_filter_and_the_rts_smoother(seed, n, m, q):
    mean, root, phi, h, z, sq, sr = problem(seed, n, m, q or n, steps=4)
    filtered, predicted = exact_filter(mean, root, phi, h, z, sq, sr)
    if n > max(q or n, 1) and not all(np.linalg.cond(np.array(p, float)) < 1e10 for _, p in predicted):
        return
    ours = cubature.smooth_interval(mean, root, linear(phi), linear(h), z, sq, sr)
    smoothed = exact_smoother(filtered, predicted, phi)
    for states, own in ((filtered, ours.filtered), (smoothed, ours)):
        assert np.allclose(own.std, deviations(states), rtol=1e-8)
        assert np.allclose(own.mean, means(states), rtol=1e-7, atol=1e-8)
        assert proper(own.sqrt_cov)


@pytest.mark.parametrize("steps", [1, 5, 30])
def test_using_z_twice_counts_it_twice(steps):
    p0, r = 3.0, 0.7
    mean, root = np.zeros(1), np.array([[math.sqrt(p0)]])
    for _ in range(steps):
        mean, root = cubature.backward_smoothing_step(
            mean, root, lambda x: x, lambda x: x, [0.3], np.zeros((1, 1)), [[math.sqrt(r)]]
        )
    assert root[0, 0] ** -2 == pytest.approx(1.0 / p0 + 2.0 * steps / r, rel=1e-12)


@given(seeds, st.integers(1, 3))
@settings(max_examples=20, deadline=None)
def test_on_linear_models_diplf_is_the_kalman_filter(seed, iterations):
    mean, root, phi, h, z, sq, sr = problem(seed, steps=3)
    filtered, _ = exact_filter(mean, root, phi, h, z, sq, sr)
    ours = cubature.filter_interval(
        mean, root, linear(phi), linear(h), z, sq, sr, method="diplf", iterations=iterations
    )
    assert np.allclose(ours.std, deviations(filtered), rtol=1e-8) and np.allclose(ours.mean, means(filtered), atol=1e-8)


@pytest.mark.parametrize("lag", [0, 1, 3, 6, 100])
def test_a_fixed_lag_is_the_smoothing_of_the_record_so_far(lag):
    mean, root, phi, h, z, sq, sr = problem(1)
    f, g = linear(phi), linear(h)
    ours = cubature.fixed_lag(mean, root, f, g, z, sq, sr, lag)
    for k in range(len(z) + 1):
        so_far = cubature.smooth_interval(mean, root, f, g, z[: min(k + lag, len(z))], sq, sr)
        assert np.array_equal(ours.mean[k], so_far.mean[k]) and np.array_equal(ours.sqrt_cov[k], so_far.sqrt_cov[k])


STEPS = {"filter": cubature.filter_step, "backward": cubature.backward_smoothing_step, "diplf": cubature.diplf_step}


@pytest.mark.parametrize("method", STEPS)
def test_a_record_equals_its_steps_and_compiled_models_equal_python_ones(method):
    z = track(2, 30)
    z[5], z[9, 0] = np.nan, np.nan
    compiled = cubature.filter_interval(X0, S0, TURN, RADAR, z, SQ, SR, (1,), method=method)
    python = cubature.filter_interval(X0, S0, turn, radar, z, SQ, SR, (1,), method=method)
    mean, root = X0, S0
    for j, row in enumerate(z):
        models = (turn, radar) if j % 2 else (TURN, RADAR)
        mean, root = STEPS[method](mean, root, *models, row, SQ, SR, (1,))
        assert np.array_equal(mean, compiled.mean[j + 1]) and np.array_equal(root, compiled.sqrt_cov[j + 1])
    for own, other in zip(compiled, python, strict=True):
        assert np.array_equal(own, other, equal_nan=own.dtype.kind == "f")
    assert list(compiled.used[[4, 5, 9]]) == [2, 0, 1]
    assert list(compiled.flags[[4, 5, 9]]) == [0, cubature.PREDICTED, cubature.PARTIAL]
    assert np.isnan(compiled.nis[5]) and np.isnan(compiled.innovation[9, 0]) and compiled.innovation_std[9, 1] > 0.0


def bends(x, u):
    y = np.empty_like(x)
    y[0] = x[0] + x[1] * u[0]
    y[1] = x[1] - x[0] * x[1]
    return y


def distance(x, u):
    z = np.empty_like(x[:1])
    z[0] = np.sqrt(x[0] * x[0] + x[1] * x[1]) - u[0]
    return z


def test_compiled_models_of_single_precision_with_inputs_equal_python_ones():
    prior = np.array([0.5, 0.1], np.float32), np.eye(2, dtype=np.float32)
    noise, u = (0.1 * np.eye(2), np.array([[0.3]])), np.linspace(0.0, 0.5, 20)[:, None]
    z = np.random.default_rng(5).uniform(0.2, 1.0, (20, 1))
    compiled = cubature.fixed_lag(*prior, njit(bends), njit(distance), z, *noise, 2, u=u)
    python = cubature.fixed_lag(*prior, bends, distance, z, *noise, 2, u=u)
    for own, other in zip(compiled[:3] + compiled.filtered, python[:3] + python.filtered, strict=True):
        assert np.array_equal(own, other)
        assert own.dtype == np.float32 or own is compiled.filtered.used or own is compiled.filtered.flags


@pytest.mark.parametrize("method", STEPS)
def test_the_seam_of_an_angle_is_nowhere(method):
    # the same geometry, turned about the radar: at half a turn the bearing crosses the seam
    z = track(4, 20)
    back = X0 * np.array([-1.0, -1.0, -1.0, -1.0, 1.0])
    turned_z = z + np.array([0.0, math.pi])
    plain = cubature.filter_interval(X0, S0, turn, radar, z, SQ, SR, (1,), method=method)
    for shift in (0.0, 2.0 * math.pi, -6.0 * math.pi):
        there = cubature.filter_interval(
            back, S0, turn, radar, turned_z + np.array([0.0, shift]), SQ, SR, (1,), method=method
        )
        assert np.allclose(there.mean * [-1, -1, -1, -1, 1], plain.mean, rtol=1e-9, atol=1e-7)
        assert np.allclose(there.std, plain.std, rtol=1e-9)


@pytest.mark.parametrize("method", STEPS)
def test_a_missing_component_is_a_sensor_that_is_not_there(method):
    z = [1610.0, np.nan]
    step = STEPS[method]
    ours = step(X0, S0, turn, radar, z, SQ, SR, (1,))
    alone = step(X0, S0, turn, lambda x: radar(x)[:1], z[:1], SQ, SR[:1])
    assert np.allclose(ours[0], alone[0], rtol=1e-13) and np.allclose(ours[1], alone[1], rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize("step", STEPS.values())
@pytest.mark.parametrize("z", [None, [np.nan, np.nan]])
def test_without_a_measurement_a_step_predicts(step, z):
    ours, predicted = step(X0, S0, turn, radar, z, SQ, SR), cubature.predict(X0, S0, turn, SQ)
    assert all(np.array_equal(a, b) for a, b in zip(ours, predicted, strict=True))


def plain_cubature(mean, covariance, phi, h, z, q, r):
    """The filter as the textbooks have it: Cholesky of the covariance, and covariances subtracted."""
    n, dtype = mean.size, mean.dtype

    def points(m, p):
        root = np.sqrt(dtype.type(n)) * np.linalg.cholesky(p)
        return np.concatenate([m + root.T, m - root.T])

    for row in z:
        y = points(mean, covariance) @ phi.T
        mean = y.mean(axis=0)
        covariance = (y - mean).T @ (y - mean) / dtype.type(2 * n) + q
        x = points(mean, covariance)
        y = x @ h.T
        innovation = (y - y.mean(axis=0)).T @ (y - y.mean(axis=0)) / dtype.type(2 * n) + r
        gain = (x - mean).T @ (y - y.mean(axis=0)) / dtype.type(2 * n) @ np.linalg.inv(innovation)
        mean, covariance = mean + gain @ (row - y.mean(axis=0)), covariance - gain @ innovation @ gain.T
    np.linalg.cholesky(covariance)
    return covariance


def stress(name):
    rng = np.random.default_rng(7)
    phi, h = np.array([[1.0, 1.0, 0.5], [0.0, 1.0, 1.0], [0.0, 0.0, 1.0]]), np.array([[1.0, 0.0, 0.0]])
    root, q, r, dtype, limit = np.eye(3), 1e-3 * np.eye(3), np.array([[1.0]]), np.float64, 1e-8
    if name == "nearly collinear accurate measurements":
        h = np.array([[1.0, 1.0, 1.0], [1.0, 1.0, 1.0 + 2.0**-20]])
        phi, q, r = np.eye(3), 0.0 * q, 2.0**-26 * np.eye(2)
    elif name == "a very wide prior and very accurate measurements":
        root, q, r = 2.0**20 * root, 0.0 * q, np.array([[2.0**-13]])
        phi = np.eye(3)
        h = np.array([[1.0, 1.0, 0.0], [0.0, 1.0, 1.0]])
        r = 2.0**-13 * np.eye(2)
    elif name == "single precision, prior 1e10 times the noise":
        phi, q, dtype, limit = np.eye(3), 0.0 * q, np.float32, 1e-4
        h, root, r = np.array([[1.0, 1.0, 0.0], [0.0, 1.0, 1.0]]), 1e5 * root, np.eye(2)
    elif name == "a prior of condition beyond 1e16":
        root, phi = np.diag([1e6, 1.0, 1e-6]) + np.tril(np.full((3, 3), 1e-7), -1), np.eye(3)
        root[1, 0] = root[2, 0] = 1e6
        q, r = 0.0 * q, np.array([[1e-3]])
    z = np.zeros((3, len(h))) + rng.normal(size=(3, len(h))) * r[0, 0]
    return [np.asarray(a, dtype) for a in (np.zeros(3), root, phi, h, z, q, r)], limit


@pytest.mark.parametrize(
    "name",
    [
        "nearly collinear accurate measurements",
        "a very wide prior and very accurate measurements",
        "single precision, prior 1e10 times the noise",
        "a prior of condition beyond 1e16",
    ],
)
def test_where_covariances_lose_definiteness_the_factors_keep_their_digits(name):
    (mean, root, phi, h, z, q, r), limit = stress(name)
    filtered, _ = exact_filter(mean, root, phi, h, z, q, r)
    exact_std = deviations(filtered)
    with np.errstate(all="ignore"):
        try:
            covariance = plain_cubature(mean, root @ root.T, phi, h, z, q @ q.T, r @ r.T)
            wrong = not np.allclose(np.sqrt(np.diag(covariance)), exact_std[-1], rtol=1e-3)
        except np.linalg.LinAlgError:
            wrong = True
    assert wrong
    ours = cubature.filter_interval(mean, root, linear(phi), linear(h), z, q, r)
    assert ours.std.dtype == mean.dtype and proper(ours.sqrt_cov)
    assert np.abs(ours.std / exact_std - 1.0).max() < limit
    again = cubature.filter_interval(mean, root, linear(phi), linear(h), z, q, r, method="backward")
    assert proper(again.sqrt_cov) and np.isfinite(again.mean).all()
