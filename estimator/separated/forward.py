"""The two filters: steps driven by the inertial sensors, measurements one scalar at a time, anchors."""

from __future__ import annotations

import numpy as np

from estimator import extended, kinematics, rotation, sweeps, ud
from estimator.extended import EPS, B, Drive, K, Model, wrapped
from estimator.kinematics import (
    AIR,
    ATTITUDE,
    HEIGHT,
    SLOW,
    STATES,
    STEEP,
    VELOCITY,
    WIND,
    M,
    deafen,
    observe_air,
    observe_attitude,
    observe_velocity,
    step,
)
from estimator.rotation import matrix
from estimator.separated import blocks
from estimator.separated.blocks import absorb, add_parameters, anchor, estimate, moved, named_rows, noise, turned
from estimator.separated.structures import Known, Rows, Split
from estimator.sweeps import state
from estimator.ud import Array, bierman, compiled, factor, solve

ud.follow(__file__, extended.__file__, kinematics.__file__, rotation.__file__, sweeps.__file__, blocks.__file__)


@compiled
def forward(
    model: Model, split: Split, drive: Drive, window: int, free: bool, cross: bool, known: Known, keep: bool,
    rows: Rows, std: Array, nis: Array,
) -> int:  # fmt: skip
    """Filter N steps; returns the first step whose result is not finite, or -1.

    Parameters
    ----------
    window : int
        Steps between anchors; one more is after the last step.
    free : bool
        Linearise at x~ and the start of the parameters.
    cross : bool
        Whether the parameters' uncertainty counts in the states'.
    known : overwritten
    rows : written when ``keep``; x, q and b of it always
    std (N, n) : of the named states, written where ``drive.shown``
    nis (N, 10) : squared innovation over its variance, NaN = absent; written
    """
    count, m, k = drive.dt.size, known.s.size, known.db.size
    p, base, lead = B + split.driven.size, m - K, 1 + k
    ut, d, s, v, a, x, q, b = known.ut, known.d, known.s, known.v, known.a, known.x, known.q, known.b
    work, x1, q1, xm = np.empty(200), np.empty(STATES), np.empty(4), np.empty(STATES)
    phi7, b6, a_new = np.empty((K, K)), np.empty((K, B)), np.empty((K, K))
    s_new, v_new = np.empty(K), np.empty((K, k))
    lu, order, e6, e, gain = np.empty((K, K)), np.empty(K, np.int64), np.empty((K, B)), np.empty(m), np.empty(lead + m)
    column, star, stars, sensitivity = np.empty((m, 1)), np.empty(m), np.empty((m, lead)), np.empty((m, k))
    row, own, guess, parameters = np.empty(lead + m), np.empty(lead), np.empty(m), np.empty((k, 1))
    y, h, omega, r33 = np.empty(M), np.empty((M, STATES)), np.empty(3), np.empty((3, 3))
    full, scratch, spread, m7 = np.zeros((m, m)), np.empty((m, m)), np.empty(m), np.empty((K, K))
    a_told, v_told, f = np.empty((K, K)), np.empty((K, k)), np.empty((k, m + k))
    linear = np.zeros(lead)  # 1 and the parameters to linearise at, less their start
    linear[0] = 1.0
    for i in range(count):
        if not free:
            linear[:] = b
        step(x, q, drive.u[i], drive.dt[i], model.earth, x1, q1, phi7, b6, work)
        for j in range(K):
            t = x1[j]
            for c in range(K):
                t += phi7[j, c] * (s[base + c] - x[c])
            for c in range(B):
                t -= b6[j, c] * linear[lead - B + c]
            s_new[j] = t
            for c in range(k):
                v_new[j, c] = b6[j, c - k + B] if c >= k - B else 0.0
            for o in range(K):
                t = phi7[j, o]
                for c in range(k):
                    v_new[j, c] += t * v[base + o, c]
            for c in range(K):
                t = 0.0
                for o in range(K):
                    t += phi7[j, o] * a[o, c]
                a_new[j, c] = t
        s[base:] = s_new
        v[base:] = v_new
        a[:, :] = a_new
        for j in range(base):
            if split.fades[j] > 0.0:
                s[j] *= drive.fade[i]
                v[j] *= drive.fade[i]
        known.fade[0] *= drive.fade[i]
        fade = known.fade[0]
        factor(a, lu, order, EPS)
        solve(lu, order, b6, e6)
        if keep:
            rows.a[i], rows.fade[i], rows.s[i], rows.v[i], rows.e[i] = a, fade, s, v, e6
        for c in range(p):
            if keep:
                rows.qs[i, c] = 0.0
            if not drive.q[i, c] > 0.0:
                continue
            noise(split, e6, fade, c, e)
            size = bierman(ut, d, e, 1.0 / drive.q[i, c], gain)
            if keep:
                rows.qs[i, c] = 1.0 / size
                for j in range(lead):
                    rows.g[i, c, j] = gain[j] / size
                for j in range(m):
                    rows.k[i, c, j] = gain[lead + j] / size
        q[:] = q1
        seen = False
        for c in range(M):
            nis[i, c] = np.nan
            seen |= drive.z[i, c] == drive.z[i, c]
        if seen:
            estimate(ut, linear, s, v, a, fade, split.fades, column, star, guess)
            xm[:] = x
            for j in range(m):
                xm[split.moving[j]] = guess[j]
            xm[4] = xm[5] = xm[6] = 0.0
            matrix(q, r33)
            for j in range(3):
                omega[j] = drive.u[i, 3 + j] - xm[10 + j]
            observe_air(xm, r33, omega, model.vane, y[AIR:ATTITUDE], h[AIR:ATTITUDE], work)
            if model.deaf:
                deafen(xm, r33, h[AIR:ATTITUDE])
            observe_attitude(q, y[ATTITUDE:HEIGHT], h[ATTITUDE:HEIGHT], work)
            y[HEIGHT] = xm[0]
            h[HEIGHT, :] = 0.0
            h[HEIGHT, 0] = 1.0
            observe_velocity(xm, r33, omega, model.antenna, y[VELOCITY:], h[VELOCITY:])
            for c in range(M):
                absent = drive.z[i, c] != drive.z[i, c]
                calm = c < ATTITUDE and xm[1] - r33[0, 0] * xm[WIND] - r33[1, 0] * xm[WIND + 1] < SLOW
                if absent or calm or (ATTITUDE <= c < HEIGHT and abs(y[ATTITUDE]) > STEEP):
                    continue
                z = drive.z[i, c] - y[c]
                if 0 < c < HEIGHT:
                    z = wrapped(z)
                for o in range(k):
                    t = h[c, split.fixed[o]]
                    z += t * linear[1 + o]
                    row[1 + o] = -t
                for j in range(m):
                    t = h[c, split.moving[j]]
                    if t != 0.0:
                        z += t * (xm[split.moving[j]] - s[j])
                        for o in range(k):
                            row[1 + o] -= t * v[j, o]
                    if j < base:
                        row[lead + j] = t * (fade if split.fades[j] > 0.0 else 1.0)
                for j in range(K):
                    t = 0.0
                    for o in range(K):
                        t += h[c, o] * a[o, j]
                    row[lead + base + j] = t
                row[0] = z
                nis[i, c] = absorb(ut, d, known.ub, known.db, row, own, 1.0 / drive.r[i, c])
            state(known.ub, parameters)
            b[1:] = parameters[:, 0]
            if not free:
                linear[:] = b
        estimate(ut, linear, s, v, a, fade, split.fades, column, star, guess)
        total = 0.0
        for j in range(m):
            x[split.moving[j]] = guess[j]
            total += guess[j] + d[j]
        for o in range(k):
            x[split.fixed[o]] = known.ref[split.fixed[o]] + linear[1 + o]
            total += b[1 + o]
        if not abs(total) < np.inf:
            return i
        xm[:] = x
        if free:  # what is told is corrected even where nothing is linearised at it
            estimate(ut, b, s, v, a, fade, split.fades, column, star, guess)
            for j in range(m):
                xm[split.moving[j]] = guess[j]
            for o in range(k):
                xm[split.fixed[o]] = known.ref[split.fixed[o]] + b[1 + o]
        for j in range(split.order.size):
            rows.x[i, j] = xm[split.order[j]]
        rows.q[i] = q
        rows.b[i] = b[1:]
        if drive.shown[i]:
            state(ut, stars)
            moved(v, stars[:, 1:], a, fade, split.fades, sensitivity)
            named_rows(q, xm[:K], m7, work)
            for j in range(base):
                full[j, j] = fade if split.fades[j] > 0.0 else 1.0
            turned(m7, a, 0, a_told)
            full[base:, base:] = a_told
            sweeps.spread(ut, d, full, scratch, spread)
            turned(m7, sensitivity, base, v_told)
            sensitivity[base:] = v_told
            for j in range(m):
                std[i, split.moving_at[j]] = spread[j] * spread[j]
            add_parameters(split, sensitivity, known.ub, known.db, cross, f, std[i])
        known.clock[0] += 1
        rows.closed[i] = 0
        if known.clock[0] >= window or i == count - 1:
            anchor(split, known, rows, keep, lu, order)
            rows.closed[i] = known.clock[1]
    return -1
