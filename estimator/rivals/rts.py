"""The textbook baseline: covariance Kalman filter and Rauch-Tung-Striebel smoother.

Right on well-conditioned problems. Its covariances are differences, so rounding can make variances negative where
measurements are much better than the prior; that is what it is here to show.

References
----------
.. [1] H. E. Rauch, F. Tung and C. T. Striebel, "Maximum likelihood estimates of linear dynamic systems", AIAA Journal 3
   (1965) 1445-1450.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from estimator.linear import Smoothed
from estimator.model import LinearModel
from estimator.ud import Array, compiled

DONE, UPDATE, PREDICTION = 0, 1, 2


@compiled
def _cholesky(a: Array, size: int) -> bool:
    """Lower factor in place of the leading (size, size) block; False when it is not positive definite."""
    for j in range(size):
        for i in range(j, size):
            total = a[i, j]
            for k in range(j):
                total -= a[i, k] * a[j, k]
            if i == j:
                if not total > 0.0:
                    return False
                a[j, j] = np.sqrt(total)
            else:
                a[i, j] = total / a[j, j]
    return True


@compiled
def _solve(root: Array, size: int, b: Array) -> None:
    """Overwrite each row of ``b`` (k, size) with (C C^T)^{-1} row, C the lower factor ``root``."""
    for row in range(b.shape[0]):
        for i in range(size):
            for k in range(i):
                b[row, i] -= root[i, k] * b[row, k]
            b[row, i] /= root[i, i]
        for i in range(size - 1, -1, -1):
            for k in range(i + 1, size):
                b[row, i] -= root[k, i] * b[row, k]
            b[row, i] /= root[i, i]


@compiled
def _product(a: Array, b: Array, transposed: bool, out: Array) -> None:
    """``out`` = A B, or A B^T."""
    for i in range(a.shape[0]):
        out[i, :] = 0.0
        for k in range(a.shape[1]):
            if a[i, k] != 0.0:
                for j in range(out.shape[1]):
                    out[i, j] += a[i, k] * (b[j, k] if transposed else b[k, j])


@compiled
def _filter(
    phi: Array, gamma: Array, q: Array, h: Array, r: Array, z: Array, x: Array, p: Array,
    x_pred: Array, p_pred: Array, x_filt: Array, p_filt: Array,
) -> tuple[int, int]:  # fmt: skip
    """Predict x <- phi x, P <- phi P phi^T + Gamma Q Gamma^T; update K = P H^T S^{-1}, x += K nu, P -= K S K^T."""
    n, m = x.size, h.shape[1]
    work, ph, gain = np.empty((n, n)), np.empty((n, m)), np.empty((n, m))
    s, nu, kept = np.empty((m, m)), np.empty(m), np.empty(m, np.int64)
    x_filt[0], p_filt[0] = x, p
    for i in range(z.shape[0]):
        f, g = phi[min(i, phi.shape[0] - 1)], gamma[min(i, gamma.shape[0] - 1)]
        qi, hi, ri = q[min(i, q.shape[0] - 1)], h[min(i, h.shape[0] - 1)], r[min(i, r.shape[0] - 1)]
        for a in range(n):
            x_pred[i, a] = 0.0
            for b in range(n):
                x_pred[i, a] += f[a, b] * x_filt[i, b]
        _product(f, p_filt[i], False, work)
        _product(work, f, True, p_pred[i])
        for a in range(n):
            for b in range(n):
                for c in range(qi.size):
                    p_pred[i, a, b] += g[a, c] * qi[c] * g[b, c]
        x_filt[i + 1], p_filt[i + 1] = x_pred[i], p_pred[i]
        count = 0
        for c in range(m):
            if not np.isnan(z[i, c]):
                kept[count] = c
                count += 1
        for c in range(count):
            nu[c] = z[i, kept[c]]
            for a in range(n):
                nu[c] -= hi[kept[c], a] * x_pred[i, a]
                ph[a, c] = 0.0
                for b in range(n):
                    ph[a, c] += p_pred[i, a, b] * hi[kept[c], b]
                gain[a, c] = ph[a, c]
        for c in range(count):
            for k in range(count):
                s[c, k] = ri[kept[c], kept[k]]
                for a in range(n):
                    s[c, k] += hi[kept[c], a] * ph[a, k]
        if not _cholesky(s, count):
            return UPDATE, i
        _solve(s, count, gain)
        for a in range(n):
            for c in range(count):
                x_filt[i + 1, a] += gain[a, c] * nu[c]
                for b in range(n):
                    p_filt[i + 1, a, b] -= gain[a, c] * ph[b, c]
        for a in range(n):  # rounding would otherwise feed the asymmetry of P back through phi P phi^T
            for b in range(a):
                p_filt[i + 1, a, b] = p_filt[i + 1, b, a] = 0.5 * (p_filt[i + 1, a, b] + p_filt[i + 1, b, a])
    return DONE, 0


@compiled
def _smooth(phi: Array, x_pred: Array, p_pred: Array, x: Array, p: Array) -> tuple[int, int]:
    """G = P phi^T P_pred^{-1}; x += G (x_next - x_pred); P += G (P_next - P_pred) G^T. Overwrites x and p [1]_."""
    n = x.shape[1]
    root, gain, work, change = np.empty((n, n)), np.empty((n, n)), np.empty((n, n)), np.empty((n, n))
    for i in range(x_pred.shape[0] - 1, -1, -1):
        root[:, :] = p_pred[i]
        if not _cholesky(root, n):
            return PREDICTION, i
        _product(p[i], phi[min(i, phi.shape[0] - 1)], True, gain)
        _solve(root, n, gain)
        for a in range(n):
            for b in range(n):
                x[i, a] += gain[a, b] * (x[i + 1, b] - x_pred[i, b])
                change[a, b] = p[i + 1, a, b] - p_pred[i, a, b]
        _product(gain, change, False, work)
        _product(work, gain, True, change)
        for a in range(n):
            for b in range(a + 1):
                p[i, a, b] = p[i, b, a] = 0.5 * (p[i, a, b] + change[a, b] + p[i, b, a] + change[b, a])
    return DONE, 0


def smooth(
    model: LinearModel, z: ArrayLike, x0: ArrayLike | None, p0: ArrayLike | None, window: int | None
) -> Smoothed:
    """Filter forward, smooth backward. ``window`` has no meaning here.

    Raises
    ------
    ValueError
        No prior: a covariance filter cannot start without one. A covariance that has lost its positive definiteness.
    """
    if x0 is None or p0 is None:
        raise ValueError("method 'rts' needs x0 and p0: a covariance cannot hold 'no prior information'; 'ms' can")
    data = model.measurements(z)
    if np.isinf(data).any():
        step = int(np.flatnonzero(np.isinf(data).any(axis=1))[0])
        raise ValueError(f"z is infinite at step {step}; a missing measurement is NaN")
    mean, covariance = np.array(x0, np.float64), np.array(p0, np.float64)
    n, count = model.n, data.shape[0]
    if covariance.ndim == 1:
        covariance = np.diag(covariance)
    if mean.shape != (n,) or covariance.shape != (n, n):
        raise ValueError(f"x0 has shape {mean.shape} and p0 {covariance.shape}, ({n},) and ({n}, {n}) are needed")
    if not (np.isfinite(mean).all() and np.isfinite(covariance).all()):
        raise ValueError("x0 or p0 is not finite")
    r = model.r if model.r.ndim == 3 else model.r[:, :, None] * np.eye(model.m)
    x_pred, p_pred = np.empty((count, n)), np.empty((count, n, n))
    x, p = np.empty((count + 1, n)), np.empty((count + 1, n, n))
    end, step = _filter(
        model.phi, model.gamma, model.q, model.h, r, data, mean, np.ascontiguousarray(covariance), x_pred, p_pred, x, p
    )
    if end == UPDATE:
        raise ValueError(f"the innovation covariance at step {step} has lost positive definiteness; 'ms' keeps it")
    filtered_mean, filtered_std = x.copy(), _deviations(p)
    end, step = _smooth(model.phi, x_pred, p_pred, x, p)
    if end == PREDICTION:
        raise ValueError(f"the predicted covariance at step {step} is not positive definite; 'ms' does not invert it")
    kept = 8 * (2 * n + 2 * n * n)
    return Smoothed(x, p, _deviations(p), filtered_mean, filtered_std, [0] if count else [], kept)


def _deviations(p: Array) -> Array:
    """Standard deviations (K, n); NaN for a variance that rounding has made negative."""
    variance = np.einsum("jii->ji", p)
    return np.sqrt(np.where(variance >= 0.0, variance, np.nan))
