"""What nonlinear filters in covariance form share: points and moments, P - K Pzz K^T, a Cholesky factor every step.

Their covariances are differences, so rounding can take definiteness away from them; then they stop and say where. That
is what they are here to show. The kernels are made for one pair of models: of compiled models they are compiled, and
other compiled functions can call them; of plain callables they are plain Python.

A kernel that a cached compiled function calls is not cached itself: numba keeps nothing that depends on a function it
was given, and would write a new copy every time.

References
----------
.. [1] S. J. Julier and J. K. Uhlmann, "Unscented filtering and nonlinear estimation", Proc. IEEE 92 (2004) 401-422.
.. [2] S. Sarkka, "Unscented Rauch-Tung-Striebel smoother", IEEE TAC 53 (2008) 845-849.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any, Literal, NamedTuple, TypeVar, cast

import numpy as np
from numba import njit
from numba.core.dispatcher import Dispatcher
from numpy.typing import ArrayLike, NDArray

from estimator.ud import Array, compiled, follow

follow(__file__)

T = TypeVar("T")
Model = Callable[[Array], Any]
Mask = NDArray[np.bool_]
KEPT = 64  # pairs of models whose kernels are kept

FINE, LOST_F, LOST_H, PREDICTED, INNOVATION, UPDATED, SMOOTHED = range(7)
SAID = {
    PREDICTED: "the covariance of the prediction is not positive definite",
    INNOVATION: "the covariance of the innovation is not positive definite",
    UPDATED: "the covariance after the measurement, P - K Pzz K^T, is not positive definite",
    SMOOTHED: "the smoothed covariance, a difference, is not positive definite",
}


def specialised(*models: object, part: bool = False) -> Callable[[T], T]:
    """Decorate a kernel that calls these models: compiled if they are, without a cache; otherwise as it is.

    A ``part`` of another kernel is compiled with it and not before.
    """
    if all(isinstance(model, Dispatcher) for model in models):
        flags = {"reassoc", "contract", "nsz"}
        inline: Literal["always", "never"] = "always" if part else "never"
        return cast(Callable[[T], T], njit(nogil=True, fastmath=flags, error_model="numpy", inline=inline))
    return lambda function: function


@compiled
def cholesky(p: Array, s: Array) -> bool:
    """Fill ``s`` with the lower factor of ``p`` = s s^T. False: not positive definite, or not finite."""
    n = p.shape[0]
    for j in range(n):
        total = p[j, j]
        for k in range(j):
            s[k, j] = 0.0
            total -= s[j, k] * s[j, k]
        if not (total > 0.0 and total < np.inf):
            return False
        root = np.sqrt(total)
        s[j, j] = root
        for i in range(j + 1, n):
            rest = p[i, j]
            for k in range(j):
                rest -= s[i, k] * s[j, k]
            s[i, j] = rest / root
    return True


@compiled
def divide(c: Array, s: Array, y: Array) -> None:
    """Fill ``y`` (n, m) with C S^{-T} for ``c`` (n, m) and lower triangular ``s`` (m, m)."""
    for i in range(c.shape[0]):
        for j in range(c.shape[1]):
            rest = c[i, j]
            for k in range(j):
                rest -= y[i, k] * s[j, k]
            y[i, j] = rest / s[j, j]


@compiled
def gram(a: Array, p: Array) -> None:
    """Add A A^T to ``p``."""
    for i in range(a.shape[0]):
        for j in range(i + 1):
            total = p[i, j]
            for k in range(a.shape[1]):
                total += a[i, k] * a[j, k]
            p[i, j] = total
            p[j, i] = total


@compiled
def finite(values: Array) -> bool:
    """Are all of them?"""
    good = True
    for value in values.flat:
        good = good and np.isfinite(value)
    return good


@compiled
def turned(values: Array, about: Array, circular: Mask) -> None:
    """Move angles by whole turns, to within half a turn of ``about``."""
    for i in range(values.size):
        if circular[i]:
            gap = values[i] - about[i]
            values[i] = about[i] + (gap - 2.0 * np.pi * np.ceil((gap - np.pi) / (2.0 * np.pi)))


@compiled
def condition(
    x: Array, p: Array, predicted: Array, pzz: Array, pxz: Array, z: Array, circular: Mask, x1: Array, p1: Array
) -> int:
    """Update N(x, p) by what is known of ``z``, its noise in ``pzz``. Fills ``x1``, ``p1``; returns what happened."""
    n, rows = x.size, np.flatnonzero(~np.isnan(z))
    m = rows.size
    x1[:] = x
    p1[:, :] = p
    if m == 0:
        return FINE
    innovation = z.copy()
    turned(innovation, predicted, circular)
    cov, cross = np.empty((m, m), x.dtype), np.empty((n, m), x.dtype)
    for a in range(m):
        for b in range(m):
            cov[a, b] = pzz[rows[a], rows[b]]
        for i in range(n):
            cross[i, a] = pxz[i, rows[a]]
    s, y, e = np.empty((m, m), x.dtype), np.empty((n, m), x.dtype), np.empty(m, x.dtype)
    if not cholesky(cov, s):
        return INNOVATION
    divide(cross, s, y)  # K = Y S^{-1}, so K Pzz K^T = Y Y^T
    for a in range(m):
        rest = innovation[rows[a]] - predicted[rows[a]]
        for b in range(a):
            rest -= s[a, b] * e[b]
        e[a] = rest / s[a, a]
    for i in range(n):
        for a in range(m):
            x1[i] += y[i, a] * e[a]
        for j in range(n):
            for a in range(m):
                p1[i, j] -= y[i, a] * y[j, a]
    return FINE


@compiled
def reverse(
    mean: Array, s: Array, x: Array, p: Array, cross: Array, ahead: Array, ahead_s: Array, out: Array, out_s: Array
) -> int:
    """Rauch-Tung-Striebel step with the moments of a prediction: P + G (P' - P^-) G^T, G = C (P^-)^{-1} [2]_."""
    n = mean.size
    factor, half, gain = np.empty((n, n), x.dtype), np.empty((n, n), x.dtype), np.empty((n, n), x.dtype)
    if not cholesky(p, factor):
        return PREDICTED
    divide(cross, factor, half)
    for i in range(n):
        for j in range(n - 1, -1, -1):
            rest = half[i, j]
            for k in range(j + 1, n):
                rest -= gain[i, k] * factor[k, j]
            gain[i, j] = rest / factor[j, j]
    change, result, turn = -p, np.zeros((n, n), x.dtype), np.empty((n, n), x.dtype)
    gram(ahead_s, change)
    gram(s, result)
    for i in range(n):
        total = mean[i]
        for k in range(n):
            total += gain[i, k] * (ahead[k] - x[k])
        out[i] = total
        for j in range(n):
            rest = gain[i, 0] * change[0, j]
            for k in range(1, n):
                rest += gain[i, k] * change[k, j]
            turn[i, j] = rest
    for i in range(n):
        for j in range(i + 1):
            total = result[i, j]
            for k in range(n):
                total += turn[i, k] * gain[j, k]
            result[i, j] = total
            result[j, i] = total
    return FINE if cholesky(result, out_s) else SMOOTHED


@compiled
def spread(mean: Array, s: Array, kappa: float, points: Array) -> None:
    """Fill ``points`` (2 n + 1, n): the mean and mean +- sqrt(n + kappa) times each column of ``s`` [1]_."""
    n = mean.size
    far = np.sqrt(n + kappa)
    points[0] = mean
    for c in range(n):
        for i in range(n):
            points[1 + c, i] = mean[i] + far * s[i, c]
            points[1 + n + c, i] = mean[i] - far * s[i, c]


@compiled
def moments(
    points: Array, centre: Array, values: Array, noise: Array, kappa: float, x: Array, p: Array, cross: Array
) -> None:
    """Fill mean, covariance with noise, and cross covariance (points, values) of weighted points.

    The first weighs kappa / (n + kappa), the others 1 / (2 (n + kappa)).
    """
    n, m = points.shape[1], values.shape[1]
    light = 0.5 / (n + kappa)
    x[:] = 0.0
    p[:, :] = 0.0
    cross[:, :] = 0.0
    for i in range(values.shape[0]):
        weight = kappa / (n + kappa) if i == 0 else light
        for a in range(m):
            x[a] += weight * values[i, a]
    for i in range(values.shape[0]):
        weight = kappa / (n + kappa) if i == 0 else light
        for a in range(m):
            heavy = weight * (values[i, a] - x[a])
            for b in range(m):
                p[a, b] += heavy * (values[i, b] - x[b])
            for j in range(n):
                cross[j, a] += heavy * (points[i, j] - centre[j])
    gram(noise, p)


class Kernels(NamedTuple):
    """Kernels for one pair of models, ``circular`` (m,) telling which measurements are angles; each returns a status.

    Attributes
    ----------
    step
        (mean, s, z, sqrt_q, sqrt_r, circular, kappa, mean_out, s_out): one step of the filter.
    smooth
        (mean, s, sqrt_q, next_mean, next_s, kappa, mean_out, s_out): one step back.
    """

    step: Any
    smooth: Any


def joined(predict: Callable[..., int], update: Callable[..., int]) -> Kernels:
    """Filter and smoother of a time update and a measurement update."""

    @specialised(predict, update)
    def step(
        mean: Array, s: Array, z: Array, sqrt_q: Array, sqrt_r: Array, circular: Mask, kappa: float, out: Array,
        to: Array,
    ) -> int:  # fmt: skip
        n = mean.size
        x, p, cross = np.empty(n, mean.dtype), np.empty((n, n), mean.dtype), np.empty((n, n), mean.dtype)
        p1 = np.empty((n, n), mean.dtype)
        status = predict(mean, s, sqrt_q, kappa, x, p, cross)
        if status == FINE:
            status = update(x, p, z, sqrt_r, circular, kappa, out, p1)
        if status == FINE and not cholesky(p1, to):
            status = UPDATED
        return status

    @specialised(predict)
    def smooth(
        mean: Array, s: Array, sqrt_q: Array, ahead: Array, ahead_s: Array, kappa: float, out: Array, to: Array
    ) -> int:
        n = mean.size
        x, p, cross = np.empty(n, mean.dtype), np.empty((n, n), mean.dtype), np.empty((n, n), mean.dtype)
        status = predict(mean, s, sqrt_q, kappa, x, p, cross)
        if status == FINE:
            status = reverse(mean, s, x, p, cross, ahead, ahead_s, out, to)
        return status

    return Kernels(step, smooth)


@lru_cache(maxsize=KEPT)
def sigma_kernels(f: Model, h: Model) -> Kernels:
    """Kernels with 2 n + 1 points; without the one in the middle where ``kappa`` is 0."""

    @specialised(f, part=True)
    def predict(mean: Array, s: Array, sqrt_q: Array, kappa: float, x: Array, p: Array, cross: Array) -> int:
        n, first = mean.size, 1 if kappa == 0.0 else 0
        points, values = np.empty((2 * n + 1, n), mean.dtype), np.zeros((2 * n + 1, n), mean.dtype)
        spread(mean, s, kappa, points)
        for i in range(first, 2 * n + 1):
            values[i] = f(points[i].copy())  # which a model may write on
        if not finite(values):
            return LOST_F
        moments(points, mean, values, sqrt_q, kappa, x, p, cross)
        return FINE

    @specialised(h, part=True)
    def update(x: Array, p: Array, z: Array, sqrt_r: Array, circular: Mask, kappa: float, x1: Array, p1: Array) -> int:
        n, m, first = x.size, z.size, 1 if kappa == 0.0 else 0
        if np.isnan(z).all():
            x1[:] = x
            p1[:, :] = p
            return FINE
        s = np.empty((n, n), x.dtype)
        if not cholesky(p, s):
            return PREDICTED
        points, values = np.empty((2 * n + 1, n), x.dtype), np.zeros((2 * n + 1, m), x.dtype)
        spread(x, s, kappa, points)
        turning = circular.any()
        for i in range(0 if turning else first, 2 * n + 1):
            values[i] = h(points[i].copy())
            if turning:
                turned(values[i], values[0], circular)
        if not finite(values):
            return LOST_H
        predicted, pzz, pxz = np.empty(m, x.dtype), np.empty((m, m), x.dtype), np.empty((n, m), x.dtype)
        moments(points, x, values, sqrt_r, kappa, predicted, pzz, pxz)
        return condition(x, p, predicted, pzz, pxz, z, circular, x1, p1)

    return joined(predict, update)


def filtered(
    kernels: Kernels, name: str, models: tuple[Model, Model], mean: ArrayLike, sqrt_cov: ArrayLike,
    z: ArrayLike | None, sqrt_q: ArrayLike, sqrt_r: ArrayLike, angles: Sequence[int], kappa: float = 0.0,
) -> tuple[Array, Array]:  # fmt: skip
    """Run ``kernels.step`` on arrays of any kind and raise what it says."""
    x, s, q, r = arrays(mean, sqrt_cov, sqrt_q, sqrt_r)
    measured = np.full(len(r), np.nan, x.dtype) if z is None else np.array(z, x.dtype)
    fits(name, "sqrt_cov", s, (x.size, x.size))
    fits(name, "sqrt_q", q, (x.size, q.shape[-1]))
    fits(name, "sqrt_r", r, (measured.size, r.shape[-1]))
    fits(name, "z", measured, (len(r),))
    circular = np.zeros(len(r), bool)
    circular[list(angles)] = True
    out, to = np.empty_like(x), np.empty_like(s)
    check(kernels.step(x, s, measured, q, r, circular, kappa, out, to), name, models)
    return out, to


def smoothed(
    kernels: Kernels, name: str, model: Model, mean: ArrayLike, sqrt_cov: ArrayLike, sqrt_q: ArrayLike,
    next_mean: ArrayLike, next_sqrt_cov: ArrayLike, kappa: float = 0.0,
) -> tuple[Array, Array]:  # fmt: skip
    """Run ``kernels.smooth`` on arrays of any kind and raise what it says."""
    x, s, q, ahead, ahead_s = arrays(mean, sqrt_cov, sqrt_q, next_mean, next_sqrt_cov)
    fits(name, "sqrt_cov", s, (x.size, x.size))
    fits(name, "sqrt_q", q, (x.size, q.shape[-1]))
    fits(name, "next_mean", ahead, x.shape)
    fits(name, "next_sqrt_cov", ahead_s, s.shape)
    out, to = np.empty_like(x), np.empty_like(s)
    check(kernels.smooth(x, s, q, ahead, ahead_s, kappa, out, to), name, (model, model))
    return out, to


def arrays(mean: ArrayLike, *others: ArrayLike) -> list[Array]:
    """Contiguous arrays of the precision of the mean: float32 if it is that, float64 otherwise."""
    dtype = np.float32 if np.asarray(mean).dtype == np.float32 else np.float64
    return [np.ascontiguousarray(each, dtype) for each in (mean, *others)]


def fits(name: str, what: str, array: Array, shape: tuple[int, ...]) -> None:
    """ValueError where an array has not the shape that the compiled loops go by."""
    if array.shape != shape:
        raise ValueError(f"{name}: {what} has shape {array.shape}, not {shape}")


def check(status: int, name: str, models: tuple[Model, Model]) -> None:
    """Raise what a kernel says.

    Raises
    ------
    ArithmeticError
        A covariance is not positive definite.
    FloatingPointError
        A model gave a number that is not finite; it is an ArithmeticError, too.
    """
    if status in (LOST_F, LOST_H):
        side = "f" if status == LOST_F else "h"
        model = models[status - LOST_F]
        raise FloatingPointError(
            f"{name}: {side}, {getattr(model, '__name__', model)}, gave a number that is not finite"
        )
    if status != FINE:
        raise ArithmeticError(f"{name}: {SAID[status]}; estimator.cubature keeps square roots and goes on")
