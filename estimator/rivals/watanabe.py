"""FPS (reconstructed): Watanabe's forward-pass smoother, on a backward information filter in U-D factors.

No text of the paper [1]_ was at hand; this is rebuilt from the operation and storage tables in which Shi [2]_ compares
it. Backward, with L = U D U^T the information that later measurements hold about the state, and y = L x:

    per scalar measurement  L <- L + h h^T / r,  y <- y + h z / r
    per component, last one first  qs = 1 / (1/q + g^T L g),  b = qs L g,  gs = qs g^T y,  L <- L - b b^T / qs,
                                   y <- y - b g^T y;      then  L <- phi^T L phi,  y <- phi^T y

At epoch 0 this is combined with the prior, and on the way forward

    x <- phi x,  U <- phi U;   per component  x <- x + g (gs - b^T x),  P <- (I - g b^T) P (I - g b^T)^T + qs g g^T

phi is never inverted. But y is carried as it is, not as a square root of it: beside near-perfect measurements its small
entries are differences of large ones.

References
----------
.. [1] K. Watanabe, "A new forward-pass fixed-interval smoother using the U-D information matrix factorization",
   Automatica 22 (1986) 465-475.
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
from estimator.smoother import Unobservable, unknown_directions
from estimator.ud import Array, agee_turner, bierman, compiled, mwgs

ud.follow(__file__, conditioning.__file__)


@compiled
def backward(
    phi: Array, gamma: Array, q: Array, h: Array, r: Array, z: Array, y: Array, ut: Array, d: Array,
    kept_b: Array, kept_qs: Array, kept_gs: Array,
) -> int:  # fmt: skip
    """Gather the information of N steps, last one first.

    Parameters
    ----------
    phi (1|N, n, n), gamma (1|N, n, p), q (1|N, p), h (1|N, m, n), r (1|N, m), z (N, m)
    y (n,), ut (n, n), d (n,) : written; what the measurements tell about the state at epoch 0
    kept_b (N, p, n), kept_qs, kept_gs (N, p) : written for ``forward``

    Returns
    -------
    The step at which the information is not finite, or -1.
    """
    n, p, m = y.size, gamma.shape[2], h.shape[1]
    u, w, weight = np.empty((n, n), phi.dtype), np.empty((n, n), phi.dtype), np.empty(n, phi.dtype)
    turned, g, k = np.empty((n, n), phi.dtype), np.empty(n, phi.dtype), np.empty(n, phi.dtype)
    ut[:, :] = 0.0
    d[:] = 0.0
    y[:] = 0.0
    for a in range(n):
        ut[a, a] = 1.0
    for i in range(z.shape[0] - 1, -1, -1):
        push, rows = gamma[min(i, gamma.shape[0] - 1)], h[min(i, h.shape[0] - 1)]
        qi, ri = q[min(i, q.shape[0] - 1)], r[min(i, r.shape[0] - 1)]
        for c in range(m):
            if z[i, c] == z[i, c]:
                t = z[i, c] / ri[c]
                for a in range(n):
                    g[a] = rows[c, a]
                    y[a] += g[a] * t
                agee_turner(ut, d, g, 1.0 / ri[c])
        for c in range(p - 1, -1, -1):
            if qi[c] > 0.0:
                for a in range(n):
                    g[a] = push[a, c]
                t = g[0] * y[0]
                for a in range(1, n):
                    t += g[a] * y[a]
                sigma = bierman(ut, d, g, 1.0 / qi[c], k)
                b = kept_b[i, c]
                for a in range(n):
                    b[a] = k[a] / sigma
                    y[a] -= b[a] * t
                kept_qs[i, c] = 1.0 / sigma
                kept_gs[i, c] = t / sigma
        now = phi[min(i, phi.shape[0] - 1)]
        for a in range(n):
            weight[a] = d[a]
            t = now[0, a] * y[0]
            for j in range(1, n):
                t += now[j, a] * y[j]
            k[a] = t
            for j in range(n):
                turned[a, j] = now[j, a]
        y[:] = k
        carried(turned, ut, u, w)
        mwgs(w, weight, ut, d)
        if not finite(d, y):
            return i
    return -1


@compiled
def combine(info_ut: Array, info_d: Array, y: Array, x: Array, ut: Array, d: Array) -> None:
    """Add information (L, y) to a prior x (n,), U D U^T, overwritten: a scalar measurement per column of L's own U.

    L x = y is D U^T x = U^{-1} y: column k measures u_k^T x, with variance 1 / D_k. Overwrites ``y``.
    """
    n = d.size
    k = np.empty(n, x.dtype)
    for j in range(n - 1, 0, -1):
        for i in range(j):
            y[i] -= info_ut[j, i] * y[j]
    for j in range(n):
        if info_d[j] > 0.0 and 1.0 / info_d[j] < np.inf:
            t = y[j]
            for i in range(j + 1):
                t -= info_d[j] * info_ut[j, i] * x[i]
            t /= info_d[j] * bierman(ut, d, info_ut[j], 1.0 / info_d[j], k)
            for i in range(n):
                x[i] += k[i] * t


@compiled
def invert(info_ut: Array, info_d: Array, y: Array, x: Array, ut: Array, d: Array) -> None:
    """The estimate that information (L, y) alone makes, all D > 0: x = L^{-1} y and U D U^T = L^{-1}. Overwrites y."""
    n = d.size
    w, weight = np.empty((n, n), x.dtype), np.empty(n, x.dtype)
    for j in range(n - 1, 0, -1):
        for i in range(j):
            y[i] -= info_ut[j, i] * y[j]
    for j in range(n):  # w = U^{-T}, one row after the other
        t = y[j] / info_d[j]
        for i in range(j):
            t -= info_ut[j, i] * x[i]
        x[j] = t
        w[j, :] = 0.0
        w[j, j] = 1.0
        for i in range(j):
            for c in range(i + 1):
                w[j, c] -= info_ut[j, i] * w[i, c]
        weight[j] = 1.0 / info_d[j]
    mwgs(w, weight, ut, d)


@compiled
def forward(
    phi: Array, gamma: Array, q: Array, kept_b: Array, kept_qs: Array, kept_gs: Array, x: Array, ut: Array, d: Array,
    per_component_mwgs: bool, mean: Array, variance: Array, covariance: Array, cross: Array,
) -> None:  # fmt: skip
    """Smooth N steps, first one first.

    Parameters
    ----------
    phi, gamma, q, kept_b, kept_qs, kept_gs : as in ``backward``
    x (n,), ut (n, n), d (n,) : smoothed estimate at epoch 0; overwritten
    per_component_mwgs : how ``conditioning.condition`` goes about it
    mean (N+1, n), variance (N+1|0, n), covariance (N+1|0, n, n), cross (N|0, n, n) : smoothed; without the last three,
        no covariance is formed
    """
    n, p, last = x.size, gamma.shape[2], kept_b.shape[0]
    second = variance.shape[0] > 0 or covariance.shape[0] > 0 or cross.shape[0] > 0
    u, w, weight = np.empty((n, n), phi.dtype), np.empty((n, n), phi.dtype), np.empty(n, phi.dtype)
    wide, heavy, g, k = np.empty((n, n + 1), phi.dtype), np.empty(n + 1, phi.dtype), np.empty(n, phi.dtype), weight
    across = np.empty((n, n), phi.dtype)
    for i in range(last + 1):
        mean[i] = x
        if variance.shape[0] > 0:
            variances(ut, d, variance[i])
        if covariance.shape[0] > 0:
            square(ut, d, covariance[i])
        if i == last:
            return
        now, push, qi = phi[min(i, phi.shape[0] - 1)], gamma[min(i, gamma.shape[0] - 1)], q[min(i, q.shape[0] - 1)]
        if cross.shape[0] > 0:
            square(ut, d, w)
            np.dot(now, w, across)
        for a in range(n):
            t = now[a, 0] * x[0]
            for j in range(1, n):
                t += now[a, j] * x[j]
            g[a] = t
        x[:] = g
        if second:
            carried(now, ut, u, w)
            for a in range(n):
                weight[a] = d[a]
            mwgs(w, weight, ut, d)
        for c in range(p):
            if qi[c] > 0.0:
                b = kept_b[i, c]
                t = kept_gs[i, c]
                for a in range(n):
                    t -= b[a] * x[a]
                for a in range(n):
                    g[a] = push[a, c]
                    x[a] += g[a] * t
                if second:
                    condition(ut, d, g, b, kept_qs[i, c], per_component_mwgs, k, wide, heavy)
                if cross.shape[0] > 0:
                    project(g, b, across, k)
        if cross.shape[0] > 0:  # cov(x_{j+1}, x_j) = (product of all I - g b^T) phi P_{j/N}
            for a in range(n):
                for j in range(n):
                    cross[i, a, j] = across[j, a]


def smooth(
    model: LinearModel,
    z: ArrayLike,
    x0: ArrayLike | None,
    p0: ArrayLike | None,
    window: int | None,
    want: frozenset[str],
) -> Smoothed:
    """Gather information backward, smooth forward. ``window`` has no meaning here.

    There is no filter in it: of "filtered", only the first row (the prior, if there is one) and the last (all
    measurements) are known; means between are NaN and deviations infinite. ``bytes_per_step`` counts b, qs and gs; phi
    and gamma, which Shi's storage table adds, are the model's own.

    Raises
    ------
    Unobservable
        Without prior, the measurements must tell every direction of the state at epoch 0; ``direction`` is one that
        they do not, at that epoch. A state that a singular phi wipes out at once is one such.
    ValueError
        Only one of x0 and p0 is given, p0 indefinite. Numbers that are no longer finite, with the step.

    Notes
    -----
    Means lose digits where measurements are far better than others and than the prior: with variances of 1e-12 beside
    1e6 and a prior of 1e8, up to 3e-4 sigma are lost, by "ms" 2e-12. Standard deviations do not suffer.
    """
    if (x0 is None) != (p0 is None):
        raise ValueError("x0 and p0 come together: give both, or neither for no prior information")
    data = entry.measurements(model, z)
    h, r, data = model.whitened(data)
    n, p, count, dtype = model.n, model.p, data.shape[0], model.phi.dtype
    x, ut, d = np.empty(n, dtype), np.empty((n, n), dtype), np.empty(n, dtype)
    if x0 is not None:
        mean, covariance = entry.prior("watanabe", model, x0, p0)
        x, (ut, d) = mean.astype(dtype), entry.factors(covariance, dtype)
    room = entry.Room.of(want | {"std"} if "filtered" in want else want, count, n, dtype)
    room.filtered_mean[:], room.filtered_variance[:] = np.nan, np.inf
    if x0 is not None:
        room.filtered_mean[:1], room.filtered_variance[:1] = mean, np.diag(covariance)
    b, qs, gs = np.empty((count, p, n), dtype), np.empty((count, p), dtype), np.empty((count, p), dtype)
    y, info_ut, info_d = np.empty(n, dtype), np.empty((n, n), dtype), np.empty(n, dtype)
    step = backward(model.phi, model.gamma, model.q, h, r, data, y, info_ut, info_d, b, qs, gs)
    if step >= 0:
        raise ValueError(
            f"the information of later measurements is no longer finite at step {step}: check the units of phi, q and "
            "r there; a direction that phi stretches and no noise feeds does it too: then use method 'ms' or 'bierman'"
        )
    if x0 is None:
        unknown = unknown_directions(info_ut, info_d, float(np.sqrt(np.finfo(dtype).eps)))
        if unknown.size:
            raise Unobservable(unknown)
        invert(info_ut, info_d, y, x, ut, d)
    else:
        combine(info_ut, info_d, y, x, ut, d)
    forward(
        model.phi, model.gamma, model.q, b, qs, gs, x, ut, d, False,
        room.mean, room.variance, room.covariance, room.cross,
    )  # fmt: skip
    lost = room.lost()
    if lost.size:
        raise entry.too_large("the smoothed estimate", int(lost[0]) - 1)
    if count and "filtered" in want:
        room.filtered_mean[-1], room.filtered_variance[-1] = room.mean[-1], room.variance[-1]
    if "std" not in want:
        room = room._replace(variance=room.variance[:0])
    return room.smoothed(n * p + 2 * p)
