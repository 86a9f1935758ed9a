"""The smoother: states for the parameters that are known in the end, and how they would change with them."""

from __future__ import annotations

import numpy as np

from estimator import ud
from estimator.extended import EPS, Flags, K
from estimator.separated import blocks
from estimator.separated.blocks import add_parameters, moved, named_rows, noise, place, turned, unplace
from estimator.separated.structures import Known, Rows, Split
from estimator.ud import Array, agee_turner, bierman, compiled, factor, mwgs

ud.follow(__file__, blocks.__file__)


@compiled
def backward(
    split: Split, rows: Rows, begin: Known, final: Known, told: Array, paper: bool, cross: bool, star: Array,
    stars: Array, vt: Array, d: Array, shown: Flags, factors: bool, x: Array, q: Array, std: Array,
) -> None:  # fmt: skip
    """Smooth N stored steps that end with an anchor, from the last epoch to the first.

    Parameters
    ----------
    begin, final : what was known at epoch 0 of these steps, and after the whole record
    told (N+1, k) : parameters that go with each epoch: b'_N, or with ``paper`` the running ones
    cross : whether the parameters' uncertainty counts in the states'
    star (m,), stars (m, k), vt (m, m), d (m,) : x*, its sensitivity and P~* at the last epoch, in the window that
        begins there; overwritten with those of epoch 0 in the window that begins at it
    shown (N+1,) : where standard deviations are wanted
    factors : False: states only; ``stars``, ``vt`` and ``d`` are not used
    x (N+1, n), q (N+1, 4) : smoothed states, in the order of the factor, and the attitudes they are about; written
    std (N+1, n) : of the named states, written where ``shown``
    """
    count, p, m = rows.k.shape
    k, base = told.shape[1], m - K
    lu, order, work = np.empty((K, K)), np.empty(K, np.int64), np.empty(200)
    kin_one, kin_k, kin_m = np.empty((K, 1)), np.empty((K, k)), np.empty((K, m))
    mean, given, single, sensitivity = np.empty(m), np.empty((m, 1)), np.empty((m, 1)), np.empty((m, k))
    shifted, u, moved_u, full = np.empty((m, k)), np.empty((m, m)), np.empty((m, m)), np.zeros((m, m))
    e, gain, weight, f, miss_k = np.empty(m), np.empty(m), np.empty(m), np.empty((k, m + k)), np.empty(k)
    a_told, v_told = np.empty((K, K)), np.empty((K, k))
    m7, unit, xs = np.empty((K, K)), np.zeros((K, K)), final.ref.copy()
    for i in range(K):
        unit[i, i] = 1.0
    for o in range(k):
        xs[split.fixed[o]] += final.b[1 + o]
    for i in range(count, -1, -1):
        at = i - 1
        fresh = i == 0 or rows.closed[at] > 0
        if i == 0:
            s, v, a, fade, nominal = begin.s, begin.v, unit, 1.0, begin.q
        elif fresh:
            number = rows.closed[at] - 1
            s, v, a, fade, nominal = rows.s_new[number], rows.v_new[number], unit, 1.0, rows.q[at]
        else:
            s, v, a, fade, nominal = rows.s[at], rows.v[at], rows.a[at], rows.fade[at], rows.q[at]
        place(s, v, told[i], star, a, fade, split.fades, mean)
        for j in range(m):
            xs[split.moving[j]] = mean[j]
        for j in range(split.order.size):
            x[i, j] = xs[split.order[j]]
        q[i] = nominal
        if factors and shown[i]:
            moved(v, stars, a, fade, split.fades, sensitivity)
            named_rows(nominal, xs[:K], m7, work)
            turned(m7, sensitivity, base, v_told)
            sensitivity[base:] = v_told
            for j in range(base):
                full[j, j] = fade if split.fades[j] > 0.0 else 1.0
            turned(m7, a, 0, a_told)
            full[base:, base:] = a_told
            u[:, :] = vt.T
            np.dot(full, u, moved_u)
            for row in range(m):
                t = 0.0
                for j in range(m):
                    t += moved_u[row, j] * moved_u[row, j] * d[j]
                std[i, split.moving_at[row]] = t
            add_parameters(split, sensitivity, final.ub, final.db, cross, f, std[i])
        if i == 0:
            return
        if fresh or paper:
            factor(rows.a[at], lu, order, EPS)
            for j in range(m):
                t = mean[j] - rows.s[at, j]
                for o in range(k):
                    t -= rows.v[at, j, o] * told[at, o]
                given[j, 0] = t
            unplace(given, lu, order, rows.fade[at], split.fades, single, kin_one)
            star[:] = single[:, 0]
        if fresh and factors:
            for j in range(m):
                for o in range(k):
                    shifted[j, o] = v[j, o] + stars[j, o] - rows.v[at, j, o]
            unplace(shifted, lu, order, rows.fade[at], split.fades, stars, kin_k)
            u[:, :] = vt.T
            unplace(u, lu, order, rows.fade[at], split.fades, moved_u, kin_m)
            weight[:] = d
            mwgs(moved_u, weight, vt, d)
        for c in range(p - 1, -1, -1):
            qs = rows.qs[at, c]
            if not qs > 0.0:
                continue
            noise(split, rows.e[at], rows.fade[at], c, e)
            known = rows.k[at, c]
            miss = rows.g[at, c, 0]
            for o in range(k):
                miss += rows.g[at, c, 1 + o] * told[at, o]
            for j in range(m):
                miss -= known[j] * star[j]
            for j in range(m):
                star[j] += e[j] * miss
            if factors:
                said = rows.g[at, c]
                for o in range(k):
                    miss_k[o] = said[1 + o]
                for j in range(m):
                    t, own = known[j], stars[j]
                    for o in range(k):
                        miss_k[o] -= t * own[o]
                for j in range(m):
                    t, own = e[j], stars[j]
                    if t != 0.0:
                        for o in range(k):
                            own[o] += t * miss_k[o]
                size = bierman(vt, d, known, qs, gain)
                for j in range(m):
                    gain[j] = e[j] - gain[j] / size
                agee_turner(vt, d, gain, size)
