"""The textbook baseline: covariance Kalman filter and Rauch-Tung-Striebel smoother, dense and compiled.

Right on well-conditioned problems. Its covariances are differences, so rounding can make variances negative where
measurements are much better than the prior; that is what it is here to show. It is also the yardstick of speed, and so
as fast as dense algebra allows: matrix products by BLAS, factors by whole rows, two pivots at a time.

References
----------
.. [1] H. E. Rauch, F. Tung and C. T. Striebel, "Maximum likelihood estimates of linear dynamic systems", AIAA Journal 3
   (1965) 1445-1450.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from estimator.linear import Smoothed
from estimator.model import LinearModel
from estimator.rivals import entry
from estimator.ud import Array, compiled

LOST = -1  # the innovation covariance is not positive definite


@compiled
def inverse_factor(a: Array, d: Array) -> bool:
    """Overwrite a symmetric ``a`` (n, n) by L^{-1}, unit lower triangular; fill ``d``: a^{-1} = L^{-T} diag(d) L^{-1}.

    Gauss elimination of [a, 1] in place, two pivots at a time: the columns left behind by a hold the inverse. Rows are
    passed over from end to end and their single entries put right afterwards: a vector load that waits for a scalar
    store just before it costs three times the arithmetic. False: not positive definite.
    """
    n = d.size
    for k in range(0, n - 1, 2):
        first, second = a[k], a[k + 1]
        if not first[k] > 0.0:
            return False
        d[k] = 1.0 / first[k]
        one = d[k]
        u = first[k + 1] * one
        for c in range(n):
            second[c] -= u * first[c]
        if not second[k + 1] > 0.0:
            return False
        d[k + 1] = 1.0 / second[k + 1]
        two = d[k + 1]
        for i in range(k + 2, n):
            s = first[i] * one
            t = second[i] * two
            row = a[i]
            for c in range(n):
                row[c] -= s * first[c] + t * second[c]
            row[k] = t * u - s
            row[k + 1] = -t
        first[k] = 1.0
        first[k + 1] = 0.0
        second[k] = -u
        second[k + 1] = 1.0
    if n % 2 == 1:
        if not a[n - 1, n - 1] > 0.0:
            return False
        d[n - 1] = 1.0 / a[n - 1, n - 1]
        a[n - 1, n - 1] = 1.0
    for k in range(n):
        a[k, k + 1 :] = 0.0
    return True


@compiled
def noise(gamma: Array, q: Array, scaled: Array, turned: Array, out: Array) -> None:
    """Fill ``out`` (n, n) with Gamma diag(q) Gamma^T; ``scaled`` (n, p) and ``turned`` (p, n) are scratch."""
    if q.size == 0:
        out[:, :] = 0.0
        return
    for i in range(gamma.shape[0]):
        for c in range(q.size):
            scaled[i, c] = gamma[i, c] * q[c]
            turned[c, i] = gamma[i, c]
    np.dot(scaled, turned, out)


@compiled
def predict(
    phi: Array, turned: Array, x: Array, p: Array, added: Array, work: Array, x_pred: Array, p_pred: Array
) -> None:
    """x_pred = phi x, P_pred = phi P phi^T + ``added``; ``turned`` is a copy of phi^T, ``work`` (n, n) scratch."""
    np.dot(phi, x, x_pred)
    np.dot(phi, p, work)
    np.dot(work, turned, p_pred)
    for i in range(x.size):
        row, more = p_pred[i], added[i]
        for c in range(row.size):
            row[c] += more[c]


@compiled
def innovate(
    h: Array, r: Array, z: Array, x: Array, p: Array,
    rows: Array, nu: Array, hp: Array, reduced: Array, scaled: Array, root: Array, d: Array,
) -> int:  # fmt: skip
    """Innovation of the present scalars, its covariance S = H P H^T + R = L D L^T, and what an update is made of.

    Parameters
    ----------
    h (m, n), r (m, m) or variances (m, 1), z (m,), x (n,), p (n, n) : measurement and prediction
    rows, reduced, scaled (m, n) : the rows of h that count; T = L^{-1} H P; D^{-1} T
    nu (2, m), root (m m,), d (m,) : nu[0] the innovation and nu[1] = L^{-1} nu; L^{-1}; D^{-1}
    hp (m, n) : H P

    Returns
    -------
    The number of present scalars, which come first in every array; LOST when S is not positive definite.
    """
    count = 0
    for c in range(z.size):
        if z[c] == z[c]:
            rows[count] = h[c]
            count += 1
    if count == 0:
        return 0
    np.dot(rows[:count], p, hp[:count])
    inverse = root[: count * count].reshape((count, count))
    np.dot(hp[:count], rows[:count].T, inverse)
    i = 0
    for c in range(z.size):
        if z[c] == z[c]:
            total = z[c]
            row = rows[i]
            for j in range(x.size):
                total -= row[j] * x[j]
            nu[0, i] = total
            if r.shape[1] == 1:
                inverse[i, i] += r[c, 0]
            else:
                j = 0
                for k in range(z.size):
                    if z[k] == z[k]:
                        inverse[i, j] += r[c, k]
                        j += 1
            i += 1
    if not inverse_factor(inverse, d[:count]):
        return LOST
    np.dot(inverse, hp[:count], reduced[:count])
    for i in range(count):
        total = nu[0, i]
        for j in range(i):
            total += inverse[i, j] * nu[0, j]
        nu[1, i] = total
        t = d[i]
        row, full = scaled[i], reduced[i]
        for j in range(row.size):
            row[j] = full[j] * t
    return count


@compiled
def forward(
    phi: Array, gamma: Array, q: Array, h: Array, r: Array, z: Array,
    x_pred: Array, p_pred: Array, x: Array, p: Array, mean: Array, variance: Array,
) -> int:  # fmt: skip
    """Filter N steps from row 0 of ``x`` and ``p``: x += K nu, P -= K S K^T with K = P H^T S^{-1}.

    Parameters
    ----------
    phi (1|N, n, n), gamma (1|N, n, p), q (1|N, p), h (1|N, m, n), r (1|N, m, m) or (1|N, m, 1), z (N, m)
    x_pred (N, n), p_pred (N, n, n), x (N+1, n), p (N+1, n, n) : predicted and filtered, written
    mean, variance (N+1|0, n) : filtered, once more

    Returns
    -------
    The step at which the innovation covariance is not positive definite, or -1.
    """
    n, m = x.shape[1], h.shape[1]
    work, added, gained = np.empty((n, n), phi.dtype), np.empty((n, n), phi.dtype), np.empty((n, n), phi.dtype)
    step, turned, push = np.empty(n, phi.dtype), np.empty((n, n), phi.dtype), np.empty((n, gamma.shape[2]), phi.dtype)
    lifted = np.empty((gamma.shape[2], n), phi.dtype)
    rows, hp, reduced = np.empty((m, n), phi.dtype), np.empty((m, n), phi.dtype), np.empty((m, n), phi.dtype)
    scaled, nu, root = np.empty((m, n), phi.dtype), np.empty((2, m), phi.dtype), np.empty(m * m, phi.dtype)
    d = np.empty(m, phi.dtype)
    for i in range(z.shape[0] + 1):
        if mean.shape[0] > 0:
            mean[i] = x[i]
            for a in range(n):
                variance[i, a] = p[i, a, a]
        if i == z.shape[0]:
            break
        if i == 0 or gamma.shape[0] > 1 or q.shape[0] > 1:
            noise(gamma[min(i, gamma.shape[0] - 1)], q[min(i, q.shape[0] - 1)], push, lifted, added)
        now = phi[min(i, phi.shape[0] - 1)]
        if i == 0 or phi.shape[0] > 1:
            turned[:, :] = now.T
        predict(now, turned, x[i], p[i], added, work, x_pred[i], p_pred[i])
        count = innovate(
            h[min(i, h.shape[0] - 1)], r[min(i, r.shape[0] - 1)], z[i], x_pred[i], p_pred[i],
            rows, nu, hp, reduced, scaled, root, d,
        )  # fmt: skip
        if count == LOST:
            return i
        x[i + 1] = x_pred[i]
        if count == 0:
            p[i + 1] = p_pred[i]
        else:
            np.dot(scaled[:count].T, nu[1, :count], step)
            np.dot(scaled[:count].T, reduced[:count], gained)
            for a in range(n):
                x[i + 1, a] += step[a]
                row, less, out = p_pred[i, a], gained[a], p[i + 1, a]
                for b in range(n):
                    out[b] = row[b] - less[b]
        mirror(p[i + 1])  # the asymmetry of rounding would otherwise be fed back through phi P phi^T
    return -1


@compiled
def mirror(a: Array) -> None:
    """Copy the upper triangle of ``a`` (n, n) to the lower one: symmetric to the last bit."""
    for i in range(a.shape[0]):
        for j in range(i):
            a[i, j] = a[j, i]


@compiled
def backward_mean(phi: Array, x_pred: Array, p_pred: Array, x: Array, p: Array) -> int:
    """Add P phi^T P_pred^{-1} (x_next - x_pred) to x (N+1, n), and nothing else; result as ``backward``."""
    n = x.shape[1]
    root, d = np.empty((n, n), phi.dtype), np.empty(n, phi.dtype)
    y, t = np.empty(n, phi.dtype), np.empty(n, phi.dtype)
    for i in range(x_pred.shape[0] - 1, -1, -1):
        root[:, :] = p_pred[i]
        if not inverse_factor(root, d):
            return i
        for j in range(n):
            y[j] = x[i + 1, j] - x_pred[i, j]
        np.dot(root, y, t)
        for j in range(n):
            t[j] *= d[j]
        np.dot(root.T, t, y)
        np.dot(phi[min(i, phi.shape[0] - 1)].T, y, t)
        np.dot(p[i], t, y)
        for j in range(n):
            x[i, j] += y[j]
    return -1


@compiled
def gain(phi: Array, p: Array, p_pred: Array, root: Array, d: Array, work: Array, out: Array) -> bool:
    """Fill ``out`` (n, n) with G^T = P_pred^{-1} phi P, G the smoother's gain. False: P_pred not positive definite.

    ``root`` (n, n), ``d`` (n,) and ``work`` (n, n) are scratch.
    """
    root[:, :] = p_pred
    if not inverse_factor(root, d):
        return False
    np.dot(phi, p, out)
    np.dot(root, out, work)
    for i in range(d.size):
        t = d[i]
        row = work[i]
        for j in range(row.size):
            row[j] *= t
    np.dot(root.T, work, out)
    return True


@compiled
def backward(phi: Array, x_pred: Array, p_pred: Array, x: Array, p: Array, variance: Array, cross: Array) -> int:
    """G = P phi^T P_pred^{-1}; x += G (x_next - x_pred); P += G (P_next - P_pred) G^T [1]_. Overwrites x and p.

    Parameters
    ----------
    phi (1|N, n, n), x_pred (N, n), p_pred (N, n, n), x (N+1, n), p (N+1, n, n) : from ``forward``
    variance (N+1|0, n), cross (N|0, n, n) : written; cov(x_j, x_{j+1}) = G P_next

    Returns
    -------
    The step whose predicted covariance is not positive definite, or -1.
    """
    n, last = x.shape[1], x_pred.shape[0]
    root, d, work = np.empty((n, n), phi.dtype), np.empty(n, phi.dtype), np.empty((n, n), phi.dtype)
    g, change, step = np.empty((n, n), phi.dtype), np.empty((n, n), phi.dtype), np.empty(n, phi.dtype)
    for i in range(last, -1, -1):
        if i < last:
            if not gain(phi[min(i, phi.shape[0] - 1)], p[i], p_pred[i], root, d, work, g):
                return i
            if cross.shape[0] > 0:
                np.dot(g.T, p[i + 1], cross[i])
            for a in range(n):
                d[a] = x[i + 1, a] - x_pred[i, a]
                row, after, before = change[a], p[i + 1, a], p_pred[i, a]
                for b in range(n):
                    row[b] = after[b] - before[b]
            np.dot(g.T, d, step)
            np.dot(g.T, change, work)
            np.dot(work, g, change)
            for a in range(n):
                x[i, a] += step[a]
                row, more = p[i, a], change[a]
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
    room, x, p, x_pred, p_pred = swept("rts", forward, model, z, x0, p0, want)
    if want.isdisjoint({"std", "covariance", "cross"}):
        step = backward_mean(model.phi, x_pred, p_pred, x, p)
    else:
        step = backward(model.phi, x_pred, p_pred, x, p, room.variance, room.cross)
    if step >= 0:
        raise lost_prediction(step)
    return finished(room, x, p, want)


def filtered(model: LinearModel, z: ArrayLike, x0: ArrayLike | None, p0: ArrayLike | None) -> tuple[Array, Array]:
    """Filter forward, and nothing else.

    Returns
    -------
    mean, std : (N+1, n) arrays
        Of epoch 0, the prior's, to N; a deviation is NaN where rounding has made the variance negative.

    Raises
    ------
    ValueError
        No prior; numbers that are no longer finite, or an innovation covariance that has lost definiteness.
    """
    return live(swept("rts", forward, model, z, x0, p0, frozenset({"filtered"}))[0])


def live(room: entry.Room) -> tuple[Array, Array]:
    """Mean and standard deviation (N+1, n) that the filter has left in ``room``."""
    return room.filtered_mean, entry.deviations(room.filtered_variance)


def swept(
    method: str,
    sweep: Callable[..., int],
    model: LinearModel,
    z: ArrayLike,
    x0: ArrayLike | None,
    p0: ArrayLike | None,
    want: frozenset[str],
) -> tuple[entry.Room, Array, Array, Array, Array]:
    """Check the arguments, filter by ``sweep``; room for results, and x, p, x_pred and p_pred as ``forward`` writes."""
    mean, covariance = entry.prior(method, model, x0, p0)
    data = entry.measurements(model, z)
    n, count, dtype = model.n, data.shape[0], model.phi.dtype
    x, p = np.empty((count + 1, n), dtype), np.empty((count + 1, n, n), dtype)
    x[0], p[0] = mean, covariance
    r = model.r if model.r.ndim == 3 else model.r[:, :, None]
    room = entry.Room.of(want - {"covariance"}, count, n, dtype)
    x_pred, p_pred = np.empty((count, n), dtype), np.empty((count, n, n), dtype)
    step = sweep(
        model.phi, model.gamma, model.q, model.h, r, data,
        x_pred, p_pred, x, p, room.filtered_mean, room.filtered_variance,
    )  # fmt: skip
    if step >= 0:
        if not (np.isfinite(x_pred[step]).all() and np.isfinite(p_pred[step]).all()):
            raise entry.too_large("the predicted estimate", step)
        raise ValueError(
            f"the innovation covariance at step {step} has lost positive definiteness; methods 'ms', 'bierman' and "
            "'watanabe' keep factors, which cannot"
        )
    if not (np.isfinite(x[-1]).all() and np.isfinite(p[-1]).all()):  # what is not finite once remains so
        finite = np.isfinite(x).all(axis=1) & np.isfinite(p).all(axis=(1, 2))
        raise entry.too_large("the filtered estimate", int(np.argmin(finite)) - 1)
    return room, x, p, x_pred, p_pred


def finished(room: entry.Room, x: Array, p: Array, want: frozenset[str]) -> Smoothed:
    """Means and covariances were smoothed in place, where the filter had left them."""
    n = x.shape[1]
    room = room._replace(mean=x, covariance=p if "covariance" in want else room.covariance)
    return room.smoothed(2 * n + 2 * n * n)


def lost_prediction(step: int) -> ValueError:
    """The smoother cannot go on."""
    return ValueError(
        f"the predicted covariance at step {step} is not positive definite; 'watanabe' inverts neither it nor phi"
    )
