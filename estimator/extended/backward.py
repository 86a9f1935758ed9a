"""The smoother: stored steps from the last epoch to the first, and the end of the filter from which it starts."""

from __future__ import annotations

import numpy as np

from estimator import rotation, sweeps, ud
from estimator.extended import blocks
from estimator.extended.blocks import EPS, place, seen, unplace
from estimator.extended.structures import B, Carry, Flags, K, Model, Rows
from estimator.rotation import exponential, turn
from estimator.sweeps import state, terminal
from estimator.ud import Array, compiled, factor, part, solve

ud.follow(__file__, rotation.__file__, sweeps.__file__, blocks.__file__)


@part
def dense(vt: Array, d: Array, p: Array) -> None:
    """Fill ``p`` (n, n) with U diag(d) U^T, symmetric to the last bit."""
    n = d.size
    for i in range(n):
        for j in range(i + 1):
            t = 0.0
            for c in range(i, n):
                t += vt[c, i] * d[c] * vt[c, j]
            p[i, j] = t
            p[j, i] = t


@part
def variances(
    model: Model,
    q: Array,
    x: Array,
    a: Array,
    b: Array,
    fade: float,
    p: Array,
    std: Array,
    rows: Array,
    part: Array,
    w: Array,
) -> None:
    """Fill ``std`` (n,) with the deviations of the named states, from ``p`` (n, n) = P*.

    Three blocks: kinematic states are phi's seven rows, the biases are themselves, the tail is a diagonal. ``rows``
    (7, 13), ``part`` (7, 13) and ``w`` (200,) are scratch.
    """
    n = x.size
    tail = n - K - B
    for i in range(B):
        std[K + i] = np.sqrt(p[tail + i, tail + i])
    for i in range(tail):
        scale = fade if model.fades[i] > 0.0 else 1.0
        std[K + B + i] = np.sqrt(p[i, i]) * scale
    seen(q, x, a, b, rows, w)
    for i in range(K):
        one, many = rows[i], part[i]
        for c in range(B + K):
            many[c] = 0.0
        for c in range(B + K):
            row, t = p[tail + c], one[c]
            for j in range(B + K):
                many[j] += t * row[tail + j]
        variance = 0.0
        for j in range(B + K):
            variance += one[j] * many[j]
        std[i] = np.sqrt(variance)


@part
def undo(p: Array, e: Array, first: int, stop: int, b: Array, qs: float, k: Array) -> None:
    """P* <- (I - e b^T) P* (I - e b^T)^T + qs e e^T for ``e`` (n,) that is zero outside first..stop-1.

    With k = P* b, s = qs + b^T k and g = k - s/2 e it is P* - e g^T - g e^T: only the rows and columns of e change.
    """
    n = b.size
    s = qs
    for i in range(n):
        row = p[i]
        t = 0.0
        for j in range(n):
            t += row[j] * b[j]
        k[i] = t
        s += t * b[i]
    for i in range(first, stop):
        k[i] -= 0.5 * s * e[i]
    for i in range(first, stop):
        row = p[i]
        own, t = e[i], k[i]
        for j in range(n):
            row[j] -= own * k[j]
        for j in range(first, stop):
            row[j] -= t * e[j]
    for i in range(first, stop):
        row = p[i]
        for j in range(first):
            p[j, i] = row[j]
        for j in range(stop, n):
            p[j, i] = row[j]


@part
def refactor(p: Array, vt: Array, d: Array) -> None:
    """Factor ``p`` (n, n), which is overwritten: P = U diag(d) U^T."""
    n = d.size
    for j in range(n - 1, -1, -1):
        d[j] = p[j, j]
        vt[j, :] = 0.0
        vt[j, j] = 1.0
        for i in range(j):
            vt[j, i] = p[i, j] / d[j]
        for i in range(j):
            for c in range(j):
                p[i, c] -= vt[j, i] * d[j] * vt[j, c]


@compiled
def backward(
    model: Model, rows: Rows, star: Array, vt: Array, d: Array, shown: Flags, factors: bool, s0: Array, q0: Array,
    start: Array, x: Array, q: Array, w: Array, std: Array,
) -> None:  # fmt: skip
    """Smooth N stored steps, from the last epoch to the first.

    Parameters
    ----------
    star (n, 1), vt (n, n), d (n,) : x* and P* at the last epoch, in the window after it if one begins there;
        overwritten with those of epoch 0 in the window of step 0
    shown (N+1,) : where standard deviations are wanted
    factors : False: states only, ``vt`` and ``d`` are not used
    s0 (n,), q0 (4,) : offset and nominal attitude at epoch 0
    start (23,) : values of the states that are not estimated
    x (N+1, 23), q (N+1, 4), w (N, 6), std (N+1, n) : smoothed states, rotation zero, about attitude q; noise of the
        inertial sensors; standard deviations of the named states; written
    """
    n, count, p = rows.s.shape[1], rows.s.shape[0], rows.qs.shape[1]
    base = n - K
    tail = base - B
    flat = star.reshape(n)
    lu, order, pair = np.empty((K, K)), np.empty(K, np.int64), np.empty((K, 2))
    mean, e, k, weight, work = np.empty(n), np.zeros(n), np.empty(n), np.empty(n), np.empty(200)
    cov, u = np.empty((n, n)), np.empty((n, n))
    kin, moved, e33 = np.empty((K, n)), np.empty((K, n)), np.empty((3, 3))
    small, part = np.empty((K, B + K)), np.empty((K, B + K))
    if factors:
        dense(vt, d, cov)
    unit_a, unit_b = np.zeros((K, K)), np.zeros((K, B))
    for i in range(K):
        unit_a[i, i] = 1.0
    for i in range(count, -1, -1):
        fresh = i == 0 or rows.closed[i - 1] == 1  # a window begins at this epoch: phi = I there
        nominal = q0 if i == 0 else rows.q[i - 1]
        if i == 0:
            for j in range(n):
                mean[j] = s0[j] + flat[j]
        elif fresh:
            for j in range(n):
                mean[j] = rows.x[i - 1, j] + flat[j]
        else:
            place(rows.s[i - 1], flat, rows.a[i - 1], rows.b[i - 1], rows.fade[i - 1], model.fades, mean)
        x[i] = start
        for j in range(n):
            x[i, model.order[j]] = mean[j]
        turn(nominal, mean[base + 4], mean[base + 5], mean[base + 6], q[i])
        exponential(-x[i, 4], -x[i, 5], -x[i, 6], e33)
        for j in range(3):
            x[i, 1 + j] = e33[j, 0] * mean[base + 1] + e33[j, 1] * mean[base + 2] + e33[j, 2] * mean[base + 3]
        x[i, 4] = x[i, 5] = x[i, 6] = 0.0
        if factors and shown[i]:
            if fresh:
                variances(model, nominal, mean, unit_a, unit_b, 1.0, cov, std[i], small, part, work)
            else:
                variances(
                    model, nominal, mean, rows.a[i - 1], rows.b[i - 1], rows.fade[i - 1], cov, std[i], small, part, work
                )
        if i == 0:
            if factors:
                u[:, :] = cov
                for row in range(n):
                    weight[row] = 1.0
                refactor(u, vt, d)
            return
        at = i - 1
        if fresh:  # the state at the anchor, in the coordinates of the window before
            factor(rows.a[at], lu, order, EPS)
            unplace(mean, rows.s[at], lu, order, rows.b[at], rows.fade[at], model.fades, flat, pair)
            if factors:
                for _ in range(2):  # phi^{-1} P*, and the same of its transpose
                    for row in range(n):
                        for j in range(n):
                            u[row, j] = cov[j, row]
                    for row in range(K):
                        for j in range(n):
                            t = u[base + row, j]
                            for c in range(B):
                                t -= rows.b[at, row, c] * u[tail + c, j]
                            kin[row, j] = t
                    solve(lu, order, kin, moved)
                    for row in range(K):
                        for j in range(n):
                            u[base + row, j] = moved[row, j]
                    for row in range(tail):
                        if model.fades[row] > 0.0:
                            for j in range(n):
                                u[row, j] /= rows.fade[at]
                    cov[:, :] = u
                for row in range(n):
                    for j in range(row):
                        cov[j, row] = cov[row, j]
        for c in range(p - 1, -1, -1):
            qs = rows.qs[at, c]
            if qs > 0.0:
                if c < B:
                    first, stop = base, n
                    for j in range(K):
                        e[base + j] = rows.e[at, j, c]
                else:
                    o = model.driven[c - 6]
                    first, stop = o, o + 1
                    e[o] = 1.0
                    if o >= tail:
                        stop = n
                        e[o + 1 :] = 0.0
                        for j in range(K):
                            e[base + j] = -rows.w[at, j, o - tail]
                    elif model.fades[o] > 0.0:
                        e[o] = 1.0 / rows.fade[at]
                given = rows.k[at, c]
                miss = rows.g[at, c]
                for j in range(n):
                    miss -= given[j] * flat[j]
                if c < B:
                    w[at, c] = -miss
                for j in range(first, stop):
                    flat[j] += e[j] * miss
                if factors:
                    undo(cov, e, first, stop, given, qs, k)
            elif c < B:
                w[at, c] = 0.0


@compiled
def finish(carry: Carry, star: Array, vt: Array, d: Array, factors: bool) -> None:
    """Start the way back from a carry: x* (n, 1) and, with ``factors``, P* as ``vt`` (n, n), ``d`` (n,)."""
    if factors:
        terminal(carry.ut, carry.d, star, vt, d)
    else:
        state(carry.ut, star)
