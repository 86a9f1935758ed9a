"""The textbook smoother with sums in place of differences: Joseph's form in the filter, its like in the smoother.

    P_{j/j} = (I - K H) P (I - K H)^T + K R K^T
    P_{j/N} = (I - G phi) P_{j/j} (I - G phi)^T + G (P_{j+1/N} + Gamma Q Gamma^T) G^T

Equal to ``rts`` in exact arithmetic, dearer, and never negative; the gains are still made from inverted covariances,
so what rounding does to these it does to the answer. Everything else is shared with ``rts``.

References
----------
.. [1] R. S. Bucy and P. D. Joseph, "Filtering for Stochastic Processes with Applications to Guidance", Wiley, 1968.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from estimator import ud
from estimator.linear import Smoothed
from estimator.model import LinearModel
from estimator.rivals import rts
from estimator.rivals.rts import LOST, gain, innovate, mirror, noise, predict
from estimator.ud import Array, compiled

ud.follow(__file__, rts.__file__)


@compiled
def congruence(a: Array, p: Array, work: Array, out: Array) -> None:
    """Fill ``out`` (n, n) with A P A^T; ``work`` (n, n) is scratch."""
    np.dot(a, p, work)
    np.dot(work, a.T, out)


@compiled
def forward(
    phi: Array, gamma: Array, q: Array, h: Array, r: Array, z: Array,
    x_pred: Array, p_pred: Array, x: Array, p: Array, mean: Array, variance: Array,
) -> int:  # fmt: skip
    """Filter N steps with P <- (I - K H) P (I - K H)^T + K R K^T [1]_; arguments and result as ``rts.forward``."""
    n, m = x.shape[1], h.shape[1]
    work, added, left = np.empty((n, n), phi.dtype), np.empty((n, n), phi.dtype), np.empty((n, n), phi.dtype)
    step, turned, push = np.empty(n, phi.dtype), np.empty((n, n), phi.dtype), np.empty((n, gamma.shape[2]), phi.dtype)
    lifted = np.empty((gamma.shape[2], n), phi.dtype)
    rows, hp, reduced = np.empty((m, n), phi.dtype), np.empty((m, n), phi.dtype), np.empty((m, n), phi.dtype)
    scaled, nu, root = np.empty((m, n), phi.dtype), np.empty((2, m), phi.dtype), np.empty(m * m, phi.dtype)
    d, block = np.empty(m, phi.dtype), np.empty(m * m, phi.dtype)
    kept, kr = np.empty(m, np.int64), np.empty((m, n), phi.dtype)
    for i in range(z.shape[0] + 1):
        if mean.shape[0] > 0:
            mean[i] = x[i]
            for a in range(n):
                variance[i, a] = p[i, a, a]
        if i == z.shape[0]:
            break
        ri = r[min(i, r.shape[0] - 1)]
        if i == 0 or gamma.shape[0] > 1 or q.shape[0] > 1:
            noise(gamma[min(i, gamma.shape[0] - 1)], q[min(i, q.shape[0] - 1)], push, lifted, added)
        now = phi[min(i, phi.shape[0] - 1)]
        if i == 0 or phi.shape[0] > 1:
            turned[:, :] = now.T
        predict(now, turned, x[i], p[i], added, work, x_pred[i], p_pred[i])
        count = innovate(
            h[min(i, h.shape[0] - 1)], ri, z[i], x_pred[i], p_pred[i], rows, nu, hp, reduced, scaled, root, d
        )
        if count == LOST:
            return i
        x[i + 1] = x_pred[i]
        if count == 0:
            p[i + 1] = p_pred[i]
        else:
            np.dot(scaled[:count].T, nu[1, :count], step)
            gained = hp[:count]  # K^T = L^{-T} D^{-1} T, where H P was
            np.dot(root[: count * count].reshape((count, count)).T, scaled[:count], gained)
            np.dot(gained.T, rows[:count], left)
            for a in range(n):
                x[i + 1, a] += step[a]
                row = left[a]
                for b in range(n):
                    row[b] = -row[b]
                row[a] += 1.0
            congruence(left, p_pred[i], work, p[i + 1])
            c = 0
            for a in range(m):
                if z[i, a] == z[i, a]:
                    kept[c] = a
                    c += 1
            if ri.shape[1] == 1:
                for c in range(count):
                    row, full = kr[c], gained[c]
                    for b in range(n):
                        row[b] = full[b] * ri[kept[c], 0]
            else:
                present = block[: count * count].reshape((count, count))
                for a in range(count):
                    for b in range(count):
                        present[a, b] = ri[kept[a], kept[b]]
                np.dot(present, gained, kr[:count])
            np.dot(gained.T, kr[:count], left)
            for a in range(n):
                row, more = p[i + 1, a], left[a]
                for b in range(n):
                    row[b] += more[b]
        mirror(p[i + 1])
    return -1


@compiled
def backward(
    phi: Array, gamma: Array, q: Array, x_pred: Array, p_pred: Array, x: Array, p: Array,
    variance: Array, cross: Array,
) -> int:  # fmt: skip
    """P <- (I - G phi) P (I - G phi)^T + G (P_next + Gamma Q Gamma^T) G^T; otherwise as ``rts.backward``."""
    n, last = x.shape[1], x_pred.shape[0]
    root, d, work = np.empty((n, n), phi.dtype), np.empty(n, phi.dtype), np.empty((n, n), phi.dtype)
    gt, g, left = np.empty((n, n), phi.dtype), np.empty((n, n), phi.dtype), np.empty((n, n), phi.dtype)
    added, push, step = np.empty((n, n), phi.dtype), np.empty((n, gamma.shape[2]), phi.dtype), np.empty(n, phi.dtype)
    lifted = np.empty((gamma.shape[2], n), phi.dtype)
    for i in range(last, -1, -1):
        if i < last:
            now = phi[min(i, phi.shape[0] - 1)]
            if not gain(now, p[i], p_pred[i], root, d, work, gt):
                return i
            g[:, :] = gt.T
            if cross.shape[0] > 0:
                np.dot(g, p[i + 1], cross[i])
            for a in range(n):
                d[a] = x[i + 1, a] - x_pred[i, a]
            np.dot(g, d, step)
            np.dot(g, now, left)
            if i == last - 1 or gamma.shape[0] > 1 or q.shape[0] > 1:
                noise(gamma[min(i, gamma.shape[0] - 1)], q[min(i, q.shape[0] - 1)], push, lifted, added)
            for a in range(n):
                x[i, a] += step[a]
                row, sums, after, more = left[a], root[a], p[i + 1, a], added[a]
                for b in range(n):
                    row[b] = -row[b]
                    sums[b] = after[b] + more[b]
                row[a] += 1.0
            congruence(left, p[i], work, gt)
            congruence(g, root, work, p[i])
            for a in range(n):
                row, more = p[i, a], gt[a]
                for b in range(n):
                    row[b] += more[b]
            mirror(p[i])
        if variance.shape[0] > 0:
            for a in range(n):
                variance[i, a] = p[i, a, a]
    return -1


def smooth(
    model: LinearModel,
    z: ArrayLike,
    x0: ArrayLike | None,
    p0: ArrayLike | None,
    window: int | None,
    want: frozenset[str],
) -> Smoothed:
    """Filter forward, smooth backward. ``window`` has no meaning here.

    Raises
    ------
    ValueError
        No prior: a covariance filter cannot start without one. A covariance that has lost its positive definiteness.
    """
    room, x, p, x_pred, p_pred = rts.swept("joseph", forward, model, z, x0, p0, want)
    if want.isdisjoint({"std", "covariance", "cross"}):
        step = rts.backward_mean(model.phi, x_pred, p_pred, x, p)
    else:
        step = backward(model.phi, model.gamma, model.q, x_pred, p_pred, x, p, room.variance, room.cross)
    if step >= 0:
        raise rts.lost_prediction(step)
    return rts.finished(room, x, p, want)


def filtered(model: LinearModel, z: ArrayLike, x0: ArrayLike | None, p0: ArrayLike | None) -> tuple[Array, Array]:
    """Filter forward, and nothing else: mean and standard deviation (N+1, n), as ``rts.filtered``."""
    return rts.live(rts.swept("joseph", forward, model, z, x0, p0, frozenset({"filtered"}))[0])
