"""What both sweeps are made of: a scalar absorbed by two factors, places in moving coordinates, anchors, compiled.

phi_{j,0} has a block of kinematics, 7 x 7, and a diagonal; what parameters push is in the sensitivity of the offset.
"""

from __future__ import annotations

import numpy as np

from estimator import rotation, sweeps, ud
from estimator.extended import EPS, B, K
from estimator.rotation import euler, euler_jacobian, exponential, turn
from estimator.separated.structures import Known, Rows, Split
from estimator.sweeps import state
from estimator.ud import Array, Order, agee_turner, factor, mwgs, part, solve

ud.follow(__file__, rotation.__file__, sweeps.__file__)


@part
def absorb(ut: Array, d: Array, ub: Array, db: Array, row: Array, own: Array, weight: float) -> float:
    """Absorb a scalar, first by the state filter, then what is left of it by the bias filter.

    ``row`` (1+k+m,): M x* = row_0 + sum row_l b'_l + v; it is overwritten, as is ``own`` (1+k,). Returns the square of
    the innovation over its variance.
    """
    left = agee_turner(ut, d, row, weight)
    own[0] = row[0]
    for i in range(1, own.size):
        own[i] = -row[i]
    left = agee_turner(ub, db, own, left)
    square: float = left * own[0] * own[0]
    return square


@part
def place(s: Array, v: Array, b: Array, star: Array, a: Array, fade: float, fades: Array, x: Array) -> None:
    """Fill ``x`` (m,) with s + v b + phi x*; ``b`` (k,), ``star`` (m,)."""
    m = s.size
    base = m - K
    for i in range(m):
        t = s[i]
        for c in range(b.size):
            t += v[i, c] * b[c]
        if i < base:
            t += star[i] * (fade if fades[i] > 0.0 else 1.0)
        else:
            for j in range(K):
                t += a[i - base, j] * star[base + j]
        x[i] = t


@part
def unplace(x: Array, lu: Array, order: Order, fade: float, fades: Array, star: Array, kin: Array) -> None:
    """Fill ``star`` (m, c) with phi^{-1} x, both (m, c); ``lu``, ``order``: of its block; ``kin`` (7, c): scratch."""
    base = x.shape[0] - K
    for i in range(base):
        for c in range(x.shape[1]):
            star[i, c] = x[i, c] / fade if fades[i] > 0.0 else x[i, c]
    solve(lu, order, x[base:], kin)
    for i in range(K):
        for c in range(x.shape[1]):
            star[base + i, c] = kin[i, c]


@part
def moved(v: Array, star: Array, a: Array, fade: float, fades: Array, out: Array) -> None:
    """Fill ``out`` (m, c) with v + phi X*, ``star`` (m, c)."""
    m, count = v.shape
    base = m - K
    for i in range(m):
        row = out[i]
        for c in range(count):
            row[c] = v[i, c]
        if i < base:
            t = fade if fades[i] > 0.0 else 1.0
            for c in range(count):
                row[c] += t * star[i, c]
        else:
            for j in range(K):
                t = a[i - base, j]
                for c in range(count):
                    row[c] += t * star[base + j, c]


@part
def named_rows(q: Array, x: Array, m7: Array, work: Array) -> None:
    """Fill ``m7`` (7, 7) with d(h, u, v, w, theta, phi, psi)/d(h, V, a) at ``x`` (7,) about ``q``."""
    e, angles, now = work[0:9].reshape(3, 3), work[9:12], work[12:16]
    m7[:, :] = 0.0
    m7[0, 0] = 1.0
    exponential(-x[4], -x[5], -x[6], e)  # (u, v, w) = exp(-[a]x) V
    v1 = e[0, 0] * x[1] + e[0, 1] * x[2] + e[0, 2] * x[3]
    v2 = e[1, 0] * x[1] + e[1, 1] * x[2] + e[1, 2] * x[3]
    v3 = e[2, 0] * x[1] + e[2, 1] * x[2] + e[2, 2] * x[3]
    m7[1:4, 1:4] = e
    m7[1, 5], m7[1, 6] = -v3, v2
    m7[2, 4], m7[2, 6] = v3, -v1
    m7[3, 4], m7[3, 5] = -v2, v1
    turn(q, x[4], x[5], x[6], now)
    euler(now, angles)
    euler_jacobian(angles[0], angles[1], e)
    m7[4:7, 4:7] = e


@part
def turned(m7: Array, v: Array, base: int, out: Array) -> None:
    """Fill ``out`` (7, c) with ``m7`` times the rows of ``v`` from ``base`` on; most of ``m7`` is zero."""
    for i in range(K):
        own = out[i]
        own[:] = 0.0
        for j in range(K):
            t, row = m7[i, j], v[base + j]
            if t != 0.0:
                for c in range(own.size):
                    own[c] += t * row[c]


@part
def add_parameters(split: Split, v: Array, ub: Array, db: Array, cross: bool, w: Array, std: Array) -> None:
    """Add V M V^T, if ``cross``, to the variances of the moving states and fill in the parameters', then take roots.

    ``v`` (m, k) of the named states; ``w`` (k, m+k) scratch; ``std`` (n,) holds the variances from P~.
    """
    m, k = v.shape
    w[:, :] = 0.0
    for j in range(k):
        w[j, m + j] = 1.0
        if cross:
            for i in range(m):
                w[j, i] = v[i, j]
    for i in range(k):
        std[split.fixed_at[i]] = 0.0
    for j in range(k - 1, -1, -1):  # U_b^{-1} (V^T, I), back substitution on all columns at once
        done = w[j]
        for c in range(j):
            t, one = ub[j, 1 + c], w[c]
            for i in range(m + k):
                one[i] -= t * done[i]
        t = 1.0 / db[j]
        for i in range(m):
            std[split.moving_at[i]] += done[i] * done[i] * t
        for i in range(k):
            std[split.fixed_at[i]] += done[m + i] * done[m + i] * t
    for i in range(std.size):
        std[i] = np.sqrt(std[i])


@part
def anchor(split: Split, known: Known, rows: Rows, keep: bool, lu: Array, order: Order) -> None:
    """Begin a window: U := phi^{-T} U, s := x~, v := V, all data 0, phi := I; ``lu``, ``order`` are overwritten."""
    m, k = known.v.shape
    base, lead = m - K, 1 + k
    star, at_rest, turned = np.empty((m, lead)), np.empty((m, lead)), np.empty((K, K))
    v, weight, column, back = np.empty((m, m)), known.d.copy(), np.empty((K, m)), np.empty((K, m))
    state(known.ut, star)
    both = np.empty((m, lead))
    both[:, 0] = known.s
    both[:, 1:] = known.v
    moved(both, star, known.a, known.fade[0], split.fades, at_rest)
    known.s[:] = at_rest[:, 0]
    known.v[:, :] = at_rest[:, 1:]
    for i in range(K):
        for j in range(K):
            turned[i, j] = known.a[j, i]
        for j in range(m):
            column[i, j] = known.ut[j, lead + base + i]
    factor(turned, lu, order, EPS)
    solve(lu, order, column, back)
    for i in range(m):
        t = 1.0 / known.fade[0] if i < base and split.fades[i] > 0.0 else 1.0
        for j in range(m):
            v[i, j] = back[i - base, j] if i >= base else t * known.ut[j, lead + i]
    plain = np.empty((m, m))
    mwgs(v, weight, plain, known.d)
    known.ut[:, :lead] = 0.0
    known.ut[:, lead:] = plain
    known.a[:, :] = 0.0
    for i in range(K):
        known.a[i, i] = 1.0
    known.fade[0] = 1.0
    known.clock[0] = 0
    if keep:
        rows.s_new[known.clock[1]] = known.s
        rows.v_new[known.clock[1]] = known.v
    known.clock[1] += 1


@part
def noise(split: Split, e6: Array, fade: float, c: int, e: Array) -> None:
    """Fill ``e`` (m,) with phi^{-1} Gam of noise component ``c``."""
    e[:] = 0.0
    if c < B:
        for j in range(K):
            e[e.size - K + j] = e6[j, c]
    else:
        at = split.driven[c - B]
        e[at] = 1.0 / fade if split.fades[at] > 0.0 else 1.0


@part
def estimate(
    ut: Array, b: Array, s: Array, v: Array, a: Array, fade: float, fades: Array, column: Array, star: Array, x: Array
) -> None:
    """Fill ``x`` (m,) with the states for parameters ``b`` (1+k,); ``column`` (m, 1) and ``star`` (m,) are scratch."""
    m, lead = s.size, b.size
    for j in range(m):
        t = 0.0
        for c in range(lead):
            t += ut[j, c] * b[c]
        for i in range(j):
            t -= ut[j, lead + i] * star[i]
        star[j] = t
    place(s, v, b[1:], star, a, fade, fades, x)
