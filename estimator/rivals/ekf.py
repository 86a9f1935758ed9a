"""The extended Kalman filter: covariance form, models replaced by their tangents at the estimate.

Jacobians are functions, or else central differences, in which a state moves by the cube root of the rounding unit times
its value or its sigma, whichever is larger.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from estimator.rivals.covariance import (
    FINE,
    KEPT,
    LOST_F,
    LOST_H,
    Kernels,
    Mask,
    Model,
    condition,
    filtered,
    finite,
    gram,
    joined,
    smoothed,
    specialised,
    turned,
)
from estimator.ud import Array, compiled, follow

follow(__file__)

NAME = "extended Kalman filter"
Slope = Callable[[Array, Array, Array, Mask], Array]
NOWHERE = np.zeros(0, bool)


@compiled
def stride(x: float, sigma: float, single: bool) -> float:
    """By how much a state moves in a central difference."""
    root = 4.9e-3 if single else 6.1e-6
    size = max(abs(x), sigma)
    return root * size if size > 0.0 else root


@compiled
def transported(jacobian: Array, p: Array, cross: Array, out: Array) -> None:
    """Fill ``cross`` with P J^T and ``out`` with J P J^T."""
    n, m = p.shape[0], jacobian.shape[0]
    for i in range(n):
        for a in range(m):
            total = p[i, 0] * jacobian[a, 0]
            for k in range(1, n):
                total += p[i, k] * jacobian[a, k]
            cross[i, a] = total
    for a in range(m):
        for b in range(a + 1):
            total = jacobian[a, 0] * cross[0, b]
            for k in range(1, n):
                total += jacobian[a, k] * cross[k, b]
            out[a, b] = total
            out[b, a] = total


def differences(model: Model) -> Slope:
    """Jacobian by central differences: of a state, the sigmas that scale them, the value there and which are angles."""

    @specialised(model, part=True)
    def jacobian(x: Array, sigma: Array, value: Array, circular: Mask) -> Array:
        n, m = x.size, value.size
        out, moved = np.empty((m, n), x.dtype), x.copy()
        up, down = np.empty(m, x.dtype), np.empty(m, x.dtype)
        for j in range(n):
            by = stride(x[j], sigma[j], x.itemsize == 4)
            high = moved.dtype.type(x[j] + by)
            low = moved.dtype.type(x[j] - by)
            moved[j] = high
            up[:] = model(moved.copy())
            moved[j] = low
            down[:] = model(moved.copy())
            moved[j] = x[j]
            if circular.size > 0:
                turned(up, value, circular)
                turned(down, value, circular)
            for a in range(m):
                out[a, j] = (up[a] - down[a]) / (high - low)
        return out

    return jacobian


def _given(function: Model) -> Slope:
    """A Jacobian that was given, called like one by differences."""

    @specialised(function, part=True)
    def jacobian(x: Array, sigma: Array, value: Array, circular: Mask) -> Array:
        out = np.empty((value.size, x.size), x.dtype)
        out[:, :] = function(x.copy())
        return out

    return jacobian


@lru_cache(maxsize=KEPT)
def kernels(f: Model, h: Model, f_jacobian: Model | None = None, h_jacobian: Model | None = None) -> Kernels:
    """Kernels for these models; compiled, and callable from compiled functions, if the models are compiled."""
    slope_f = differences(f) if f_jacobian is None else _given(f_jacobian)
    slope_h = differences(h) if h_jacobian is None else _given(h_jacobian)

    @specialised(f, slope_f, part=True)
    def predict(mean: Array, s: Array, sqrt_q: Array, _: float, x: Array, p: Array, cross: Array) -> int:
        n = mean.size
        x[:] = f(mean.copy())
        if not finite(x):
            return LOST_F
        before, sigma = np.zeros((n, n), mean.dtype), np.empty(n, mean.dtype)
        gram(s, before)
        for i in range(n):
            sigma[i] = np.sqrt(before[i, i])
        slope = slope_f(mean, sigma, x, NOWHERE)
        if not finite(slope):
            return LOST_F
        transported(slope, before, cross, p)
        gram(sqrt_q, p)
        return FINE

    @specialised(h, slope_h, part=True)
    def update(x: Array, p: Array, z: Array, sqrt_r: Array, circular: Mask, _: float, x1: Array, p1: Array) -> int:
        n, m = x.size, z.size
        if np.isnan(z).all():
            x1[:] = x
            p1[:, :] = p
            return FINE
        predicted, sigma = np.empty(m, x.dtype), np.empty(n, x.dtype)
        predicted[:] = h(x.copy())
        if not finite(predicted):
            return LOST_H
        for i in range(n):
            sigma[i] = np.sqrt(max(p[i, i], x.dtype.type(0.0)))
        slope = slope_h(x, sigma, predicted, circular)
        if not finite(slope):
            return LOST_H
        pxz, pzz = np.empty((n, m), x.dtype), np.empty((m, m), x.dtype)
        transported(slope, p, pxz, pzz)
        gram(sqrt_r, pzz)
        return condition(x, p, predicted, pzz, pxz, z, circular, x1, p1)

    return joined(predict, update)


def filter_step(
    mean: ArrayLike, sqrt_cov: ArrayLike, f: Model, h: Model, z: ArrayLike | None, sqrt_q: ArrayLike,
    sqrt_r: ArrayLike, angles: Sequence[int] = (), f_jacobian: Model | None = None, h_jacobian: Model | None = None,
) -> tuple[Array, Array]:  # fmt: skip
    """One step, prediction and update, as ``ckf.filter_step``.

    Parameters
    ----------
    mean, sqrt_cov, f, h, z, sqrt_q, sqrt_r, angles
        See ``ckf.filter_step``.
    f_jacobian, h_jacobian : callable, optional
        Of one state (n,): (n, n) and (m, n); central differences if not given.

    Raises
    ------
    ArithmeticError
        A covariance is not positive definite.
    FloatingPointError
        A model or its Jacobian gave a number that is not finite.
    """
    made = kernels(f, h, f_jacobian, h_jacobian)
    return filtered(made, NAME, (f, h), mean, sqrt_cov, z, sqrt_q, sqrt_r, angles)


def smooth_step(
    mean: ArrayLike, sqrt_cov: ArrayLike, f: Model, sqrt_q: ArrayLike, next_mean: ArrayLike,
    next_sqrt_cov: ArrayLike, f_jacobian: Model | None = None,
) -> tuple[Array, Array]:  # fmt: skip
    """One step back, as ``ckf.smooth_step``; ``f_jacobian`` as of the filter."""
    made = kernels(f, f, f_jacobian)
    return smoothed(made, NAME, f, mean, sqrt_cov, sqrt_q, next_mean, next_sqrt_cov)
