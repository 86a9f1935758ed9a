"""SS (reconstructed): Bierman's covariance U-D smoother, one noise component at a time.

No text of the paper [1]_ was at hand; this is rebuilt from the operation and storage tables in which Shi [2]_ compares
it. Forward, a covariance filter in U-D factors:

    x <- phi x,  U <- phi U;   per component  b = q (P + q g g^T)^{-1} g,  qs = 1 / (1/q + g^T P^{-1} g)  with P before
    it, then P <- P + q g g^T;   per scalar measurement  ``ud.bierman``

and backward, last component first, with x_pred the mean before any of them:

    x <- x + g b^T (x_pred - x),  P <- (I - g b^T) P (I - g b^T)^T + qs g g^T;     x <- phi^{-1} x,  U <- phi^{-1} U

References
----------
.. [1] G. J. Bierman, "A new computationally efficient fixed-interval, discrete-time smoother", Automatica 19 (1983)
   503-511.
.. [2] Z. K. Shi, "A new algorithm of fixed-interval smoother and its application to flight test", Acta Automatica
   Sinica, 1991.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from estimator import ud
from estimator.linear import Smoothed
from estimator.model import LinearModel
from estimator.rivals import conditioning, entry
from estimator.rivals.conditioning import carried, condition, finite, project, square, variances
from estimator.ud import Array, agee_turner, compiled, factor, mwgs, solve
from estimator.ud import bierman as downdate

ud.follow(__file__, conditioning.__file__)


@compiled
def absorb(ut: Array, d: Array, g: Array, q: float, y: Array, b: Array) -> float:
    """Add q g g^T to P = U D U^T; fill ``b`` (n,) with q (P + q g g^T)^{-1} g and return qs = 1/(1/q + g^T P^{-1} g).

    With U y = g, both are products of D_j / (D_j + c_j y_j^2) <= 1, the pivots' shrinking while c_j falls from q to qs:
    nothing is divided by D, so P may be singular. Overwrites ``g`` (n,); ``y`` (n,) is scratch.
    """
    n = d.size
    for i in range(n):
        y[i] = g[i]
    for j in range(n - 1, 0, -1):
        t, column, rest = y[j], ut[j, :j], y[:j]
        for i in range(j):
            rest[i] -= t * column[i]
    c = q
    for j in range(n - 1, -1, -1):
        v = c * y[j]
        grown = d[j] + v * y[j]
        if v != 0.0 and grown > 0.0:
            y[j] = v / grown
            b[j] = d[j] / grown
            c *= b[j]
        else:
            y[j] = 0.0
            b[j] = 1.0
    shrunk = 1.0
    for j in range(n):  # b = U^{-T} f, where f_j = y_j times the ratios of the pivots before it
        t = shrunk * y[j]
        shrunk *= b[j]
        column, known = ut[j, :j], b[:j]
        for i in range(j):
            t -= column[i] * known[i]
        b[j] = t
    agee_turner(ut, d, g, q)
    return c


@compiled
def forward(
    phi: Array, gamma: Array, q: Array, h: Array, r: Array, z: Array, x: Array, ut: Array, d: Array,
    x_pred: Array, kept_b: Array, kept_qs: Array, mean: Array, variance: Array,
) -> int:  # fmt: skip
    """Filter N steps.

    Parameters
    ----------
    phi (1|N, n, n), gamma (1|N, n, p), q (1|N, p), h (1|N, m, n), r (1|N, m), z (N, m)
    x (n,), ut (n, n), d (n,) : the prior; left as the last filtered estimate
    x_pred (N, n), kept_b (N, p, n), kept_qs (N, p) : written for ``backward``
    mean, variance (N+1|0, n) : filtered

    Returns
    -------
    The step after which the estimate is not finite, or -1.
    """
    n, p, m = x.size, gamma.shape[2], h.shape[1]
    u, w, weight = np.empty((n, n), phi.dtype), np.empty((n, n), phi.dtype), np.empty(n, phi.dtype)
    g, y, k = np.empty(n, phi.dtype), np.empty(n, phi.dtype), np.empty(n, phi.dtype)
    for i in range(z.shape[0] + 1):
        if mean.shape[0] > 0:
            mean[i] = x
            variances(ut, d, variance[i])
        if i == z.shape[0]:
            break
        now, push, rows = phi[min(i, phi.shape[0] - 1)], gamma[min(i, gamma.shape[0] - 1)], h[min(i, h.shape[0] - 1)]
        qi, ri = q[min(i, q.shape[0] - 1)], r[min(i, r.shape[0] - 1)]
        before = x_pred[i]
        for a in range(n):
            t = now[a, 0] * x[0]
            for j in range(1, n):
                t += now[a, j] * x[j]
            before[a] = t
            weight[a] = d[a]
        x[:] = before
        carried(now, ut, u, w)
        mwgs(w, weight, ut, d)
        for c in range(p):
            if qi[c] > 0.0:
                for a in range(n):
                    g[a] = push[a, c]
                kept_qs[i, c] = absorb(ut, d, g, qi[c], y, kept_b[i, c])
        for c in range(m):
            if z[i, c] == z[i, c]:
                row = rows[c]
                t = z[i, c]
                for a in range(n):
                    t -= row[a] * x[a]
                t /= downdate(ut, d, row, ri[c], k)
                for a in range(n):
                    x[a] += k[a] * t
        if not finite(d, x):
            return i
    return -1


@compiled
def backward(
    phi: Array, gamma: Array, q: Array, x_pred: Array, kept_b: Array, kept_qs: Array, x: Array, ut: Array, d: Array,
    eps: float, per_component_mwgs: bool, mean: Array, variance: Array, covariance: Array, cross: Array,
) -> int:  # fmt: skip
    """Smooth N steps, last one first.

    Parameters
    ----------
    phi, gamma, q : as in ``forward``; x_pred, kept_b, kept_qs, x, ut, d : as ``forward`` left them; the last three are
        overwritten
    eps : rounding unit, for the test of phi
    per_component_mwgs : how ``conditioning.condition`` goes about it
    mean (N+1, n), variance (N+1|0, n), covariance (N+1|0, n, n), cross (N|0, n, n) : smoothed; without the last three,
        no covariance is formed

    Returns
    -------
    The step with a singular phi, or -1.
    """
    n, p, last = x.size, gamma.shape[2], x_pred.shape[0]
    second = variance.shape[0] > 0 or covariance.shape[0] > 0 or cross.shape[0] > 0
    lu, order = np.empty((n, n), phi.dtype), np.empty(n, np.int64)
    u, w, weight = np.empty((n, n), phi.dtype), np.empty((n, n), phi.dtype), np.empty(n, phi.dtype)
    wide, heavy, g, k = np.empty((n, n + 1), phi.dtype), np.empty(n + 1, phi.dtype), np.empty(n, phi.dtype), weight
    column, moved = np.empty((n, 1), phi.dtype), np.empty((n, 1), phi.dtype)
    for i in range(last, -1, -1):
        if i < last:
            push, qi, before = gamma[min(i, gamma.shape[0] - 1)], q[min(i, q.shape[0] - 1)], x_pred[i]
            new = i == last - 1 or phi.shape[0] > 1
            if new and factor(phi[min(i, phi.shape[0] - 1)], lu, order, eps):
                return i
            if cross.shape[0] > 0:
                square(ut, d, w)
            for c in range(p - 1, -1, -1):
                if qi[c] > 0.0:
                    b = kept_b[i, c]
                    t = b[0] * (before[0] - x[0])
                    for a in range(1, n):
                        t += b[a] * (before[a] - x[a])
                    for a in range(n):
                        g[a] = push[a, c]
                        x[a] += g[a] * t
                    if second:
                        condition(ut, d, g, b, kept_qs[i, c], per_component_mwgs, k, wide, heavy)
                    if cross.shape[0] > 0:
                        project(g, b, w, k)
            if cross.shape[0] > 0:  # cov(x_j, x_{j+1}) = phi^{-1} (product of all I - g b^T) P_{j+1/N}
                solve(lu, order, w, cross[i])
            column[:, 0] = x
            solve(lu, order, column, moved)
            x[:] = moved[:, 0]
            if second:
                for a in range(n):
                    weight[a] = d[a]
                    for j in range(n):
                        u[a, j] = ut[j, a]
                solve(lu, order, u, w)
                mwgs(w, weight, ut, d)
        mean[i] = x
        if variance.shape[0] > 0:
            variances(ut, d, variance[i])
        if covariance.shape[0] > 0:
            square(ut, d, covariance[i])
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

    ``bytes_per_step`` counts b, qs and x_pred; phi and gamma, which Shi's storage table adds, are the model's own.

    Raises
    ------
    ValueError
        No prior: a covariance filter cannot start without one. p0 indefinite. phi singular: it is inverted on the way
        back. Numbers that are no longer finite, with the step.

    Notes
    -----
    A direction that phi shrinks and no noise feeds is stretched on the way back, and its rounding errors with it: what
    was known of it long before is lost, without a word as long as it stays finite. "watanabe" smooths forward.
    """
    mean, covariance = entry.prior("bierman", model, x0, p0)
    h, r, data = model.whitened(entry.measurements(model, z))
    n, p, count, dtype = model.n, model.p, data.shape[0], model.phi.dtype
    x, (ut, d) = mean.astype(dtype), entry.factors(covariance, dtype)
    room = entry.Room.of(want, count, n, dtype)
    x_pred, b, qs = np.empty((count, n), dtype), np.empty((count, p, n), dtype), np.empty((count, p), dtype)
    step = forward(
        model.phi, model.gamma, model.q, h, r, data, x, ut, d, x_pred, b, qs,
        room.filtered_mean, room.filtered_variance,
    )  # fmt: skip
    if step >= 0:
        raise entry.too_large("the filtered estimate", step)
    step = backward(
        model.phi, model.gamma, model.q, x_pred, b, qs, x, ut, d, float(np.finfo(dtype).eps), False,
        room.mean, room.variance, room.covariance, room.cross,
    )  # fmt: skip
    if step >= 0:
        raise ValueError(f"phi is singular at step {step}: method 'bierman' inverts it; 'watanabe' does not")
    lost = room.lost()
    if lost.size:
        raise ValueError(
            f"the estimate of epoch {lost[-1]} is no longer finite on the way back: the inverse of phi stretches a "
            "direction too fast after it; method 'watanabe' smooths forward"
        )
    return room.smoothed(n * p + p + n)
