"""The compiled sweeps of MS-A: forward over N steps, hand-over at an anchor, backward over windows.

MS-A is Shi's information filter in moving coordinates and its smoother [1]_, in augmented and sequential form: the data
ride in front of the information factor, L = U D U^T with U^T x* = eta in the columns before U, and noise components and
measurements enter one scalar at a time. K records with the same model, noise and missing samples differ in eta alone:
they share every factor, and K = 1 is one record. Matrices are stored as in ``ud``; ``coordinates`` prepares the steps.

References
----------
.. [1] Z. K. Shi, "A new algorithm of fixed-interval smoother and its application to flight test", Acta Automatica
   Sinica, 1991.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from estimator import ud
from estimator.coordinates import CONDITION, LENGTH, Flags
from estimator.ud import (
    Array,
    Order,
    agee_turner,
    agee_turner_all,
    bierman,
    compiled,
    exact,
    factor,
    mwgs,
    part,
    solve,
    solve_transposed,
)

ud.follow(__file__)


# By bytes per number. A pivot below PIVOT, measured by L_jj, is rounding and not information: rounding leaves 4e-23 and
# less in float64. A direction is observed when the singular value of the scaled factor is above FAINT times the
# largest: in float64 rounding reaches 3e-9 where measurement variances range over 18 decades, 3e-12 otherwise, and
# solvable problems stay above 1e-5.
PIVOT = {8: 1e-20, 4: 1e-9}
FAINT = {8: 1e-8, 4: 1e-4}
LARGE = 1e4  # sigmas: sums of smaller terms lose at most 2e-12 of a sigma, in float32 a thousandth


def limits(dtype: np.dtype[Any]) -> tuple[float, float]:
    """PIVOT and FAINT of a number type."""
    return PIVOT[dtype.itemsize], FAINT[dtype.itemsize]


@exact
def state(ut: Array, x: Array) -> None:
    """Solve U^T x = eta for the star states ``x`` (n, K); ``ut`` (n, K + n)."""
    n, records = x.shape
    if records == 1:
        flat = x.reshape(n)
        for j in range(n):
            t = ut[j, 0]
            for i in range(j):
                t -= ut[j, 1 + i] * flat[i]
            flat[j] = t
        return
    for j in range(n):
        own = x[j]
        for t in range(records):
            own[t] = ut[j, t]
        for i in range(j):
            u, known = ut[j, records + i], x[i]
            for t in range(records):
                own[t] -= u * known[t]


@exact
def rank(ut: Array, d: Array, pivot: float) -> int:
    """Count the pivots of the factor that are information and not rounding: above ``pivot``, measured by L_jj."""
    n = d.size
    data = ut.shape[1] - n
    count = 0
    for j in range(n):
        total = 0.0
        for k in range(j, n):
            total += ut[k, data + j] * ut[k, data + j] * d[k]
        if d[j] > pivot * total:
            count += 1
    return count


@exact
def inverse(ut: Array, w: Array) -> None:
    """Fill ``w`` (n, n) with U^{-T}: row j = e_j - sum_i U_ij row i."""
    n = ut.shape[0]
    data = ut.shape[1] - n
    for j in range(n):
        own = w[j]
        own[:] = 0.0
        own[j] = 1.0
        for i in range(j):
            u, known = ut[j, data + i], w[i]
            for k in range(i + 1):
                own[k] -= u * known[k]


@exact
def determined(ut: Array, d: Array, w: Array, faint: float) -> bool:
    """Is the smallest singular value of diag(L)^{-1/2} U D^{1/2} surely above ``faint``? Full rank; ``w`` (n, n).

    The Frobenius norm of the inverse bounds the smallest singular value from below.
    """
    n = d.size
    data = ut.shape[1] - n
    norm = 0.0
    inverse(ut, w)
    for k in range(n):
        length = 0.0
        for j in range(k, n):
            length += ut[j, data + k] * ut[j, data + k] * d[j]
        for j in range(k, n):
            norm += w[j, k] * w[j, k] * length / d[j]
    return norm * n * faint * faint < 1.0


@exact
def anchor(ut: Array, d: Array, phi: Array, regular: bool, eps: float) -> None:
    """Move the anchor to the present epoch: overwrite ``ut`` (n, K + n) and ``d``; ``phi`` (n, n) = phi_{j,0}.

    V = diag(I, phi^{-T}) [eta^T; U], then mwgs; states and their covariance do not change. The eta that comes out is
    exact but amplifies rounding, so it is formed again from the state, U^T phi x*, wherever that is a sum of terms
    below LARGE sigmas: a mode that has run away unseen makes huge terms that cancel. Never while some direction is
    unknown (``regular`` is false): pivots of rounding size stand for it then, and the state is nonsense along it.
    """
    n = phi.shape[0]
    data = ut.shape[1] - n
    v, weight = np.empty((data + n, n), phi.dtype), np.empty(n, phi.dtype)
    lu, order = np.empty((n, n), phi.dtype), np.empty(n, np.int64)
    x, moved = np.empty((n, data), phi.dtype), np.empty((n, data), phi.dtype)
    b, column = np.empty(n, phi.dtype), np.empty(n, phi.dtype)
    factor(phi, lu, order, eps)
    for j in range(n):
        weight[j] = d[j]
        for t in range(data):
            v[t, j] = ut[j, t]
        for i in range(n):
            b[i] = ut[j, data + i]
        solve_transposed(lu, order, b, column)
        for i in range(n):
            v[data + i, j] = column[i]
    state(ut, x)
    np.dot(phi, x, moved)
    mwgs(v, weight, ut, d)
    if regular:
        for j in range(n):
            for t in range(data):
                eta = moved[j, t]
                size = abs(eta)
                for i in range(j):
                    term = ut[j, data + i] * moved[i, t]
                    eta += term
                    size += abs(term)
                if np.sqrt(d[j]) * size < LARGE:
                    ut[j, t] = eta


@exact
def spread(ut: Array, d: Array, phi: Array, w: Array, std: Array) -> None:
    """Fill ``std`` (n,) with the roots of the diagonal of phi L^{-1} phi^T; ``w`` (n, n) is scratch."""
    n = phi.shape[0]
    data = ut.shape[1] - n
    std[:] = 0.0
    for j in range(n):
        own = w[j]
        for k in range(n):
            own[k] = phi[k, j]
    for j in range(n - 1, -1, -1):  # w = (phi U^{-T})^T, back substitution on all rows of phi at once
        done = w[j]
        for i in range(0, j - 1, 2):
            t, s, one, two = ut[j, data + i], ut[j, data + i + 1], w[i], w[i + 1]
            for k in range(n):
                one[k] -= t * done[k]
                two[k] -= s * done[k]
        if j % 2 == 1:
            t, one = ut[j, data + j - 1], w[j - 1]
            for k in range(n):
                one[k] -= t * done[k]
        weight = 1.0 / d[j]
        for k in range(n):
            std[k] += done[k] * done[k] * weight
    for k in range(n):
        std[k] = np.sqrt(std[k])


@compiled
def forward(
    ends: Array, es: Array, at: Order, rows: Array, seen: Order, q: Array, r: Array, z: Array, closed: Flags,
    ut: Array, d: Array, rho: Array, since: Array, regular: bool, pivot: float, faint: float, eps: float,
    keep: bool, kept_b: Array, kept_g: Array, kept_qs: Array,
    estimates: bool, mean: Array, std: Array, nis: Array, dof: Order,
) -> tuple[bool, int]:  # fmt: skip
    """Filter N steps of K records: the forward pass of MS-A, in prepared coordinates.

    Per step one bierman downdate of L per noise component, E_c and 1/q_c, and one agee_turner update per present
    scalar, [z_i, M_i] and 1/r_i.

    Parameters
    ----------
    ends (T, n, n), es (T, p, n), at (N,) : phi_{j+1,0} and E_j^T of step i are rows at[i]
    rows (S, m, n), seen (N,) : M of step i is row seen[i]
    q (1|N, p), r (1|N, m), z (N, m, K), closed (N,) : bits CONDITION and LENGTH say when to anchor
    ut (n, K+n), d (n,), rho (K,) : the carry, overwritten; since (n, n) = phi_{j,0} of the epoch before the first step
    pivot, faint : see ``rank`` and ``determined``; eps : the rounding unit
    kept_b (N, p, n), kept_g (N, p, K), kept_qs (N, p) : rows of the store, written when ``keep``
    mean (N, n, K), std (N, n), written when ``estimates``; nis (N, K), dof (N,)

    Returns
    -------
    whether every direction is known, and the first step whose result is not finite, or -1
    """
    n, p, m = d.size, es.shape[1], rows.shape[1]
    data = ut.shape[1] - n
    scratch, x = np.empty((n, n), ut.dtype), np.empty((n, data), ut.dtype)
    a, weight, k = np.empty((m, data + n), ut.dtype), np.empty(m, ut.dtype), np.empty(data + n, ut.dtype)
    for i in range(at.size):
        if closed[i] & CONDITION:
            anchor(ut, d, since, regular, eps)
        since = ends[at[i]]
        variance, e = q[min(i, q.shape[0] - 1)], es[at[i]]
        for c in range(p):
            if variance[c] > 0.0:
                qs = 1.0 / bierman(ut, d, e[c], 1.0 / variance[c], k)
                if keep:
                    kept_qs[i, c] = qs
                    for t in range(data):
                        kept_g[i, c, t] = k[t] * qs
                    for j in range(n):
                        kept_b[i, c, j] = k[data + j] * qs
            elif keep:
                kept_qs[i, c] = 0.0
                kept_g[i, c, :] = 0.0
                kept_b[i, c, :] = 0.0
        variance, row = r[min(i, r.shape[0] - 1)], rows[seen[i]]
        total = 0.0
        disagreement = nis[i]
        disagreement[:] = 0.0
        dof[i] = 0
        count = 0
        for c in range(m):
            if z[i, c, 0] == z[i, c, 0]:
                for t in range(data):
                    a[count, t] = z[i, c, t]
                for j in range(n):
                    a[count, data + j] = row[c, j]
                weight[count] = 1.0 / variance[c]
                count += 1
        known = n
        if regular:
            agee_turner_all(ut, d, a, weight, count)
        for c in range(count):
            if not regular:
                known = rank(ut, d, pivot)
                weight[c] = agee_turner(ut, d, a[c], weight[c])
            new = not regular and rank(ut, d, pivot) != known
            dof[i] += not new
            for t in range(data):
                square = weight[c] * a[c, t] * a[c, t]
                rho[t] += square
                total += square
                if not new:  # what tells a new direction is compared with nothing
                    disagreement[t] += square
        for j in range(n):
            total += d[j]
        if not abs(total) < np.inf:  # np.isfinite is x - x == x - x inside, which 'reassoc' is free to call 0
            return regular, i
        if not regular and rank(ut, d, pivot) == n:
            regular = determined(ut, d, scratch, faint)
        if estimates:
            if regular:
                state(ut, x)
                np.dot(since, x, mean[i])
                spread(ut, d, since, scratch, std[i])
            else:
                mean[i, :, :] = np.nan
                std[i, :] = np.inf
        if closed[i] & LENGTH:
            anchor(ut, d, since, regular, eps)
    return regular, -1


@exact
def terminal(ut: Array, d: Array, x: Array, vt: Array, dv: Array) -> None:
    """Start the way back: x* (n, K) from U^T x* = eta, and P* = L^{-1} as ``vt`` (n, n), ``dv`` (n,). All D > 0."""
    n = d.size
    w, weight = np.empty((n, n), ut.dtype), np.empty(n, ut.dtype)
    state(ut, x)
    inverse(ut, w)
    for j in range(n):
        weight[j] = 1.0 / d[j]
    mwgs(w, weight, vt, dv)


@part
def advance(x: Array, e: Array, b: Array, g: Array, row: int, i: int, c: int, miss: Array) -> None:
    """x* <- x* + e (g - b^T x*) for component ``c`` of step ``i``, whose e is in ``row``; ``miss`` (K,) is scratch."""
    n, records = x.shape
    if records == 1:
        t = g[i, c, 0]
        for j in range(n):
            t -= b[i, c, j] * x[j, 0]
        for j in range(n):
            x[j, 0] += e[row, c, j] * t
        return
    for t in range(records):
        miss[t] = g[i, c, t]
    for j in range(n):
        for t in range(records):
            miss[t] -= b[i, c, j] * x[j, t]
    for j in range(n):
        for t in range(records):
            x[j, t] += e[row, c, j] * miss[t]


@part
def image(phi: Array, vt: Array, u: Array, w: Array) -> None:
    """Fill ``w`` (n, n) with phi U; ``u`` is scratch: a product of plain matrices is twice as fast as one with U^T."""
    n = phi.shape[0]
    for i in range(n):
        for j in range(n):
            u[i, j] = vt[j, i]
    np.dot(phi, u, w)


@part
def outer(w: Array, heavy: Array, out: Array) -> None:
    """Fill ``out`` (n, n) with w heavy^T, known to be symmetric: one triangle, mirrored, symmetric to the last bit."""
    n = w.shape[0]
    for row in range(n):
        for c in range(row + 1):
            t = 0.0
            for j in range(n):
                t += heavy[row, j] * w[c, j]
            out[row, c] = t
            out[c, row] = t


@compiled
def backward(
    phi: Array, e: Array, at: Order, b: Array, g: Array, qs: Array, begins: Flags,
    x: Array, vt: Array, d: Array, eps: float, lowest: bool, spreads: bool, full: bool, crossed: bool,
    mean: Array, std: Array, covariance: Array, cross: Array,
) -> None:  # fmt: skip
    """Smooth k stored steps of K records, from the last epoch to the first, across any number of anchors.

    Per noise component, last one first: x* <- x* + e (g - b^T x*) and
    P* <- (I - e b^T) P* (I - e b^T)^T + qs e e^T = (P* - k k^T / s) + s (e - k/s)(e - k/s)^T with k = P* b,
    s = qs + b^T P* b: one downdate and one update, no subtraction of covariances. The covariance of neighbours is
    phi_{j,0} A P* phi_{j+1,0}^T, A = prod (I - e b^T).

    Parameters
    ----------
    phi (T+1, n, n), e (T, p, n), at (k+1,) : transition from the anchor of the window that ends or goes on at epoch i
        is row at[i] of phi, and E of the step that ends there row at[i] - 1 of e
    b (k, p, n), g (k, p, K), qs (k, p), begins (k+1,) : the store; ``begins[i]``: a window starts with step i
    x (n, K), vt (n, n), d (n,) : star states and covariance at epoch k, overwritten with those of epoch 0
    lowest : whether to show epoch 0, which otherwise is the last one of the steps before
    mean (k+1, n, K); std (k+1, n), covariance (k+1, n, n), cross (k, n, n) : written when asked for
    """
    n, last, p = d.size, qs.shape[0], qs.shape[1]
    lu, order = np.empty((n, n), x.dtype), np.empty(n, np.int64)
    k, miss, moved = np.empty(n, x.dtype), np.empty(x.shape[1], x.dtype), np.empty(x.shape, x.dtype)
    w, pair, z = np.empty((n, n), x.dtype), np.empty((n, n), x.dtype), np.empty((n, n), x.dtype)
    weight, line = np.empty(n, x.dtype), np.empty(n, x.dtype)
    factors = spreads or full or crossed
    for i in range(last, -1, -1):
        if i == 0 and not lowest:
            return
        if begins[i]:
            mean[i] = x
        else:
            np.dot(phi[at[i]], x, mean[i])
        if factors:  # w = phi U and pair = w D: P = w pair^T
            if begins[i]:
                for row in range(n):
                    for j in range(n):
                        w[row, j] = vt[j, row]
            else:
                image(phi[at[i]], vt, z, w)
            for row in range(n):
                variance = 0.0
                for j in range(n):
                    pair[row, j] = w[row, j] * d[j]
                    variance += w[row, j] * pair[row, j]
                if spreads:
                    std[i, row] = np.sqrt(variance)
        if full:
            outer(w, pair, covariance[i])
        if i == 0:
            return
        now = phi[at[i]]
        if begins[i]:  # the state at the anchor, in the coordinates of the window before: x* = phi_{k,0}^{-1} x
            factor(now, lu, order, eps)
            moved[:, :] = x
            solve(lu, order, moved, x)
            if factors:
                for row in range(n):
                    for j in range(n):
                        pair[row, j] = vt[j, row]
                solve(lu, order, pair, w)
                weight[:] = d
                mwgs(w, weight, vt, d)
        if crossed:  # z = P* phi^T
            image(now, vt, z, w)
            for row in range(n):
                for j in range(n):
                    pair[j, row] = w[row, j] * d[j]
            for row in range(n):
                for j in range(n):
                    w[row, j] = vt[j, row]
            np.dot(w, pair, z)
        step = e[at[i] - 1]
        for c in range(p - 1, -1, -1):
            if qs[i - 1, c] > 0.0:
                own = step[c]
                advance(x, e, b, g, at[i] - 1, i - 1, c, miss)
                if factors:
                    s = bierman(vt, d, b[i - 1, c], qs[i - 1, c], k)
                    for j in range(n):
                        k[j] = own[j] - k[j] / s
                    agee_turner(vt, d, k, s)
                if crossed:
                    np.dot(b[i - 1, c], z, line)
                    for row in range(n):
                        for j in range(n):
                            z[row, j] -= own[row] * line[j]
        if crossed:
            if begins[i - 1]:
                cross[i - 1] = z
            else:
                np.dot(phi[at[i - 1]], z, cross[i - 1])
