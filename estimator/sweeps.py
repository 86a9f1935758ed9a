"""The compiled sweeps of MS-A: forward over N steps, hand-over at an anchor, backward over windows.

MS-A is Shi's information filter in moving coordinates and its smoother [1]_, in augmented and sequential form: the data
ride in slot 0 of the information matrix, L_aug = [[rho, d^T], [d, L]] = U_aug D_aug U_aug^T with U^T x* = eta in row 0
of U_aug, and noise components and measurements enter one scalar at a time. Matrices are stored as in ``ud``.

References
----------
.. [1] Z. K. Shi, "A new algorithm of fixed-interval smoother and its application to flight test", Acta Automatica
   Sinica, 1991.
"""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from estimator import ud
from estimator.ud import Array, Order, agee_turner, bierman, compiled, factor, multiply, mwgs, solve, solve_transposed

# numba's on-disk cache asks only whether this file has changed, and would go on running the old code of a changed
# callee. Making this file as young as the one it calls into is what its cache does notice.
with suppress(OSError):
    _callees = Path(ud.__file__).stat().st_mtime_ns
    if Path(__file__).stat().st_mtime_ns < _callees:
        os.utime(__file__, ns=(_callees, _callees))

Flags = NDArray[np.uint8]

DONE, SINGULAR, INFINITE, OVERFLOW = 0, 1, 2, 3  # how the forward sweep ended
CONDITION, LENGTH = 1, 2  # bits of ``closed``: a window ended before this step, after it
CHECK = 8  # steps between two exact condition numbers
PIVOT = 1e-20  # of L_jj: a pivot below it is rounding (measured: 4e-23 and less), not information
FAINT = 1e-8  # smallest singular value of the scaled factor that counts as observed: rounding alone reaches 3e-9 when
# measurement variances range over 18 decades, 3e-12 otherwise; solvable problems stay above 1e-5


@compiled
def too_stiff(a: Array, lu: Array, order: Order, scale: Array, exact: bool, limit: float, w: Array) -> bool:
    """Is the infinity-norm condition number of S^{-1} A S above ``limit``, S = diag(scale)? ``w`` (n, 2n) is scratch.

    The n^3 inverse is formed only when asked for, or when pivots and norm say that the limit is near.
    """
    n = a.shape[0]
    norm = 0.0
    pivot = 0.0
    for i in range(n):
        total = 0.0
        for j in range(n):
            total += abs(a[i, j]) * scale[j]
        norm = max(norm, total / scale[i])
        pivot = max(pivot, scale[order[i]] / (scale[i] * abs(lu[i, i])))
    if not exact and 10.0 * norm * pivot < limit:
        return False
    w[:, :n] = 0.0
    for i in range(n):
        w[i, i] = 1.0
    solve(lu, order, w[:, :n], w[:, n:])
    inverse = 0.0
    for i in range(n):
        total = 0.0
        for j in range(n):
            total += abs(w[i, n + j]) * scale[j]
        inverse = max(inverse, total / scale[i])
    return not norm * inverse <= limit


@compiled
def state(ut: Array, x: Array) -> None:
    """Solve U^T x = eta for the star state ``x`` (n,); row j + 1 of the augmented ``ut`` begins with eta_j."""
    for j in range(x.size):
        t = ut[j + 1, 0]
        for i in range(j):
            t -= ut[j + 1, i + 1] * x[i]
        x[j] = t


@compiled
def rank(ut: Array, d: Array) -> int:
    """Count the state pivots of the augmented factor that are information and not rounding (see PIVOT)."""
    count = 0
    for j in range(1, d.size):
        total = 0.0
        for k in range(j, d.size):
            total += ut[k, j] * ut[k, j] * d[k]
        if d[j] > PIVOT * total:
            count += 1
    return count


@compiled
def determined(ut: Array, d: Array, w: Array) -> bool:
    """Is the smallest singular value of diag(L)^{-1/2} U D^{1/2} surely above FAINT? Needs full rank; ``w`` (n, n).

    The Frobenius norm of the inverse bounds the smallest singular value from below.
    """
    n = d.size - 1
    norm = 0.0
    for j in range(n):  # w = U^{-T}, one row after the other: row j = e_j - sum_i U_ij row i
        w[j, :] = 0.0
        w[j, j] = 1.0
        for i in range(j):
            for k in range(i + 1):
                w[j, k] -= ut[j + 1, i + 1] * w[i, k]
    for k in range(n):
        length = 0.0
        for j in range(k, n):
            length += ut[j + 1, k + 1] * ut[j + 1, k + 1] * d[j + 1]
        for j in range(k, n):
            norm += w[j, k] * w[j, k] * length / d[j + 1]
    return norm * n * FAINT * FAINT < 1.0


@compiled
def anchor(ut: Array, d: Array, phi: Array, w: Array) -> None:
    """Move the anchor to the present epoch: overwrite augmented ``ut`` and ``d``, set ``phi`` = I; ``w`` (n+1, 2n+2).

    V = diag(1, phi^{-T}) U_aug, then mwgs; the state and its covariance do not change. Row 0 of the result is exact but
    amplifies rounding, so eta is formed again from the state, unless the two disagree by more than a thousandth of a
    sigma: then pivots of rounding size stand for directions nobody has seen, and row 0 is the better one.
    """
    n = phi.shape[0]
    v, spare = w[:, : n + 1], w[:, n + 1 :]
    lu = np.empty((n, n))
    order = np.empty(n, np.int64)
    x, b, weight = np.empty(n), np.empty(n), d.copy()
    factor(phi, lu, order)
    informed = True
    v[:, :] = 0.0
    v[0, 0] = 1.0
    for j in range(n):
        informed = informed and d[j + 1] > 0.0
        v[0, j + 1] = ut[j + 1, 0]
        b[:] = ut[j + 1, 1:]
        solve_transposed(lu, order, b, x)
        v[1:, j + 1] = x
    state(ut, x)
    for i in range(n):
        b[i] = 0.0
        for j in range(n):
            b[i] += phi[i, j] * x[j]
    mwgs(v, weight, ut, d)
    d[0] = weight[0]
    for j in range(n):
        eta = 0.0
        for i in range(j + 1):
            eta += ut[j + 1, i + 1] * b[i]
        spare[0, j] = eta
        informed = informed and abs(eta - ut[j + 1, 0]) * np.sqrt(d[j + 1]) < 1e-3
    if informed:
        ut[1:, 0] = spare[0, :n]
    phi[:, :] = 0.0
    for i in range(n):
        phi[i, i] = 1.0


@compiled
def spread(ut: Array, d: Array, phi: Array, w: Array, std: Array) -> None:
    """Fill ``std`` (n,) with the roots of the diagonal of phi L^{-1} phi^T; ``w`` (n, n) is scratch."""
    n = phi.shape[0]
    std[:] = 0.0
    for j in range(n):
        w[j, :] = phi[:, j]
    for j in range(n - 1, -1, -1):  # w = (phi U^{-T})^T, back substitution on all rows of phi at once
        for i in range(j):
            t = ut[j + 1, i + 1]
            if t != 0.0:
                for k in range(n):
                    w[i, k] -= t * w[j, k]
        for k in range(n):
            std[k] += w[j, k] * w[j, k] / d[j + 1]
    for k in range(n):
        std[k] = np.sqrt(std[k])


@compiled
def forward(
    phi: Array, gamma: Array, q: Array, h: Array, r: Array, z: Array,
    ut: Array, d: Array, since: Array, steps: int, regular: bool, longest: int, limit: float, scale: Array,
    keep: bool, kept_phi: Array, kept_e: Array, kept_b: Array, kept_g: Array, kept_qs: Array,
    estimates: bool, mean: Array, std: Array, nis: Array, dof: Order, closed: Flags,
) -> tuple[int, bool, int, int]:  # fmt: skip
    """Filter N steps: the forward pass of MS-A.

    Per step, in star coordinates x = phi_{j,0} x*: E = phi_{j+1,0}^{-1} Gamma_j, M = H phi_{j+1,0}; one bierman
    downdate of L_aug per noise component, [0, E_c] and 1/q_c; one agee_turner update per present scalar, [z_i, M_i].

    Parameters
    ----------
    phi (1|N, n, n), gamma (1|N, n, p), q (1|N, p), h (1|N, m, n), r (1|N, m), z (N, m)
    ut (n+1, n+1), d (n+1,), since (n, n) = phi_{j,0} : the carry, overwritten
    kept_phi (N, n, n), kept_e, kept_b (N, p, n), kept_g, kept_qs (N, p) : rows of the store, written when ``keep``
    mean, std (N, n), written when ``estimates``; nis, dof (N,); closed (N,) : bits CONDITION and LENGTH

    Returns
    -------
    steps since the anchor; whether every direction is known; how the sweep ended, and at which step
    """
    n, p, m = since.shape[0], gamma.shape[2], h.shape[1]
    end, lu, order, x = np.empty((n, n)), np.empty((n, n)), np.empty(n, np.int64), np.empty(n)
    w, wide, scratch = np.empty((n, 2 * n)), np.empty((n + 1, 2 * n + 2)), np.empty((n, n))
    e, rows = np.empty((n, p)), np.empty((m, n))
    a, k = np.empty(n + 1), np.empty(n + 1)
    for i in range(z.shape[0]):
        now = phi[min(i, phi.shape[0] - 1)]
        closed[i] = 0
        if steps > 0:
            multiply(now, since, end)
            bad = factor(end, lu, order)
            if bad or too_stiff(end, lu, order, scale, (steps + 1) % CHECK == 0, limit, w):
                anchor(ut, d, since, wide)
                closed[i] = CONDITION
                steps = 0
        if steps == 0:
            end[:, :] = now
            if factor(end, lu, order):
                return steps, regular, SINGULAR, i
        solve(lu, order, gamma[min(i, gamma.shape[0] - 1)], e)
        variance = q[min(i, q.shape[0] - 1)]
        for c in range(p):
            if variance[c] > 0.0:
                a[0] = 0.0
                for j in range(n):
                    a[j + 1] = e[j, c]
                sigma = bierman(ut, d, a, 1.0 / variance[c], k)
                if keep:
                    kept_qs[i, c] = 1.0 / sigma
                    kept_g[i, c] = k[0] / sigma
                    for j in range(n):
                        kept_e[i, c, j] = e[j, c]
                        kept_b[i, c, j] = k[j + 1] / sigma
            elif keep:
                kept_qs[i, c] = kept_g[i, c] = 0.0
                kept_e[i, c, :] = 0.0
                kept_b[i, c, :] = 0.0
        multiply(h[min(i, h.shape[0] - 1)], end, rows)
        variance = r[min(i, r.shape[0] - 1)]
        nis[i] = 0.0
        dof[i] = 0
        for c in range(m):
            if abs(z[i, c]) == np.inf:
                return steps, regular, INFINITE, i
            if not np.isnan(z[i, c]):
                a[0] = z[i, c]
                a[1:] = rows[c]
                before = n if regular else rank(ut, d)
                added = agee_turner(ut, d, a, 1.0 / variance[c])
                if regular or rank(ut, d) == before:  # else it told a new direction and was compared with nothing
                    nis[i] += added
                    dof[i] += 1
        since[:, :] = end
        steps += 1
        if keep:
            kept_phi[i] = end
        total = 0.0
        for j in range(n + 1):
            total += d[j]
        if not abs(total) < np.inf:  # np.isfinite is x - x == x - x inside, which 'reassoc' is free to call 0
            return steps, regular, OVERFLOW, i
        if not regular and rank(ut, d) == n:
            regular = determined(ut, d, scratch)
        if estimates:
            if regular:
                state(ut, x)
                for row in range(n):
                    total = 0.0
                    for j in range(n):
                        total += end[row, j] * x[j]
                    mean[i, row] = total
                spread(ut, d, end, scratch, std[i])
            else:
                mean[i, :] = np.nan
                std[i, :] = np.inf
        if steps >= longest:
            anchor(ut, d, since, wide)
            closed[i] |= LENGTH
            steps = 0
    return steps, regular, DONE, z.shape[0]


@compiled
def terminal(ut: Array, d: Array, x: Array, vt: Array, dv: Array) -> None:
    """Start the way back: x* from U^T x* = eta, and P* = L^{-1} as ``vt`` (n, n), ``dv`` (n,). Needs all D > 0."""
    n = x.size
    w, weight = np.empty((n, n)), np.empty(n)
    state(ut, x)
    for j in range(n):  # U^{-T}: row j = e_j - sum_i U_ij row i
        w[j, :] = 0.0
        w[j, j] = 1.0
        for i in range(j):
            for k in range(i + 1):
                w[j, k] -= ut[j + 1, i + 1] * w[i, k]
        weight[j] = 1.0 / d[j + 1]
    mwgs(w, weight, vt, dv)


@compiled
def backward(
    phi: Array, e: Array, b: Array, g: Array, qs: Array, begins: Flags, x: Array, vt: Array, d: Array,
    full: bool, mean: Array, std: Array, covariance: Array,
) -> None:  # fmt: skip
    """Smooth K stored steps, from the last epoch to the first, across any number of anchors.

    Per noise component, last one first: x* <- x* + e (g - b^T x*) and
    P* <- (I - e b^T) P* (I - e b^T)^T + qs e e^T = (P* - k k^T / s) + s (e - k/s)(e - k/s)^T with k = P* b,
    s = qs + b^T P* b: one downdate and one update, no subtraction of covariances.

    Parameters
    ----------
    phi (K+1, n, n) : transition from the anchor of the window that ends or goes on at each epoch
    e, b (K, p, n), g, qs (K, p), begins (K+1,) : the store; ``begins[i]``: a window starts with step i
    x (n,), vt (n, n), d (n,) : star state and covariance at epoch K, overwritten
    mean, std (K+1, n); covariance (K+1, n, n), written when ``full``
    """
    n, last = x.size, e.shape[0]
    lu, order = np.empty((n, n)), np.empty(n, np.int64)
    k, column, moved = np.empty(n), np.empty((n, 1)), np.empty((n, 1))
    w, pair, weight = np.empty((n, n)), np.empty((n, n)), np.empty(n)
    for i in range(last, -1, -1):
        for row in range(n):  # w = phi U and pair = w D: x = phi x*, P = w pair^T
            total = 0.0
            if begins[i]:
                total = x[row]
            else:
                for j in range(n):
                    total += phi[i, row, j] * x[j]
            mean[i, row] = total
            variance = 0.0
            for j in range(n):
                if begins[i]:
                    total = vt[j, row]
                else:
                    total = phi[i, row, j]
                    for c in range(j):
                        total += phi[i, row, c] * vt[j, c]
                w[row, j] = total
                pair[row, j] = total * d[j]
                variance += total * total * d[j]
            std[i, row] = np.sqrt(variance)
            if full:  # one triangle, mirrored: symmetric to the last bit
                for c in range(row + 1):
                    total = 0.0
                    for j in range(n):
                        total += w[row, j] * pair[c, j]
                    covariance[i, row, c] = total
                    covariance[i, c, row] = total
        if i == 0:
            return
        if begins[i]:  # the state at the anchor, in the coordinates of the window before: x* = phi_{k,0}^{-1} x
            factor(phi[i], lu, order)
            column[:, 0] = x
            solve(lu, order, column, moved)
            x[:] = moved[:, 0]
            for row in range(n):
                for j in range(n):
                    pair[row, j] = vt[j, row]
            solve(lu, order, pair, w)
            weight[:] = d
            mwgs(w, weight, vt, d)
        for c in range(e.shape[1] - 1, -1, -1):
            if qs[i - 1, c] > 0.0:
                miss = g[i - 1, c]
                for j in range(n):
                    miss -= b[i - 1, c, j] * x[j]
                for j in range(n):
                    x[j] += e[i - 1, c, j] * miss
                s = bierman(vt, d, b[i - 1, c], qs[i - 1, c], k)
                for j in range(n):
                    k[j] = e[i - 1, c, j] - k[j] / s
                agee_turner(vt, d, k, s)
