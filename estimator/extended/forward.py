"""The filter: steps driven by the inertial sensors, measurements one scalar at a time, gates, anchors."""

from __future__ import annotations

import numpy as np

from estimator import kinematics, rotation, sweeps, ud
from estimator.extended import blocks
from estimator.extended.blocks import (
    anchor,
    deviations,
    divide,
    doubt,
    downdate,
    follow_on,
    innovate,
    place,
    project,
    wrapped,
)  # fmt: skip
from estimator.extended.structures import (
    ABSENT,
    REJECTED,
    USED,
    WALKS,
    WEAKENED,
    About,
    B,
    Carry,
    Drive,
    K,
    Model,
    Rows,
    Told,
)
from estimator.kinematics import (
    AIR,
    ATTITUDE,
    HEIGHT,
    SLOW,
    STATES,
    STEEP,
    TURBULENCE,
    VELOCITY,
    WIND,
    M,
    deafen,
    observe_air,
    observe_attitude,
    observe_velocity,
    step,
)  # fmt: skip
from estimator.rotation import difference, exponential, matrix
from estimator.sweeps import state
from estimator.ud import agee_turner, compiled

ud.follow(__file__, kinematics.__file__, rotation.__file__, sweeps.__file__, blocks.__file__)

ACCEPT, WEAKEN = 25.0, 64.0  # squares of sigmas: accepted, accepted with raised noise, rejected
ROW, SHARE, MEMORY = 10, 0.3, 2.0  # rejections in a row, or their share over seconds, that mean it is the filter
QUIET = 10.0  # s from the start without a gate
GROUP = np.array([2, 2, 2, 1, 1, 1, -1, 0, 0, 0])  # what is doubted when a channel is locked out: v, a or T


@compiled
def forward(
    model: Model, drive: Drive, about: About, window: int, gated: bool, carry: Carry, keep: bool, rows: Rows,
    told: Told,
) -> int:  # fmt: skip
    """Filter N steps; returns the first step whose result is not finite, or -1.

    Parameters
    ----------
    window : int
        Steps between anchors.
    gated : bool
        Whether improbable measurements are weakened and refused.
    carry : overwritten
    rows : written when ``keep``; x and q of it always
    told : written
    """
    n, p, count = carry.d.size, drive.q.shape[1], drive.dt.size
    base = n - K
    tail = base - B
    iterated = about.w.shape[0] > 0
    ut, d, s, x, q, a, b = carry.ut, carry.d, carry.s, carry.x, carry.q, carry.a, carry.b
    work, x1, q1, nominal = np.empty(200), np.empty(STATES), np.empty(4), np.empty(4)
    phi7, b6, u = np.empty((K, K)), np.empty((K, B)), np.empty(6)
    a_new, b_new = np.empty((K, K)), np.empty((K, B))
    lu, order = np.empty((K, K)), np.empty(K, np.int64)
    e6, walk = np.empty((K, B)), np.empty((K, B))
    e, k, f, m, row = np.zeros(n), np.empty(1 + n), np.empty(n), np.empty(n), np.empty(1 + n)
    star, predicted, before, after = np.empty((n, 1)), np.empty(n), np.empty(n), np.empty(n)
    flat = star.reshape(n)
    full, scratch, std = np.empty((n, n)), np.empty((n, n)), np.empty(n)
    xm, residual, r33 = np.empty(STATES), np.empty(3), np.empty((3, 3))
    y, h, omega = np.empty(M), np.empty((M, STATES)), np.empty(3)
    lost = np.zeros(3, np.uint8)
    lower, blocks, part = np.zeros((n, n)), np.empty((K, B + K)), np.empty((K, n))
    for i in range(count):
        dt = drive.dt[i]
        if iterated:
            x[:] = about.x[i]
            q[:] = about.q[i]
            for j in range(6):
                u[j] = drive.u[i, j] - about.w[i, j]
        else:
            u[:] = drive.u[i]
        step(x, q, u, dt, model.earth, x1, q1, phi7, b6, work)
        if iterated:
            nominal[:] = about.q[i + 1]
            difference(nominal, q1, residual)
            q1[:] = nominal
            exponential(residual[0], residual[1], residual[2], r33)
            t1, t2, t3 = x1[1], x1[2], x1[3]
            for j in range(3):
                x1[1 + j] = r33[j, 0] * t1 + r33[j, 1] * t2 + r33[j, 2] * t3
            for j in range(K):
                t = x1[j] if j < 4 else residual[j - 4]
                for c in range(B):
                    t -= b6[j, c] * about.w[i, c]
                x1[j] = t
        for j in range(K):
            before[base + j] = s[base + j] - x[j]
        for j in range(B):
            before[tail + j] = s[tail + j] - x[K + j]
        for j in range(K):
            t = x1[j]
            for c in range(K):
                t += phi7[j, c] * before[base + c]
            for c in range(B):
                t += b6[j, c] * before[tail + c]
            s[base + j] = t
        fade = drive.fade[i]
        for j in range(tail):
            if model.fades[j] > 0.0:
                s[j] *= fade
        follow_on(phi7, b6, a, b, a_new, b_new)
        a[:, :] = a_new
        b[:, :] = b_new
        carry.fade[0] *= fade
        divide(a, b6, e6, work)
        if p > WALKS:
            divide(a, b, walk, work)
        if keep:
            rows.a[i] = a
            rows.b[i] = b
            rows.fade[i] = carry.fade[0]
            rows.e[i] = e6
            if p > WALKS:
                rows.w[i] = walk
        for c in range(p):
            variance = drive.q[i, c]
            if c < 3:
                variance += carry.doubt[0, c] / (dt * dt)
            elif c < 6:
                variance += carry.doubt[1, c - 3] / (dt * dt)
            else:
                at = model.driven[c - 6]
                if at < tail and model.fades[at] > 0.0:
                    variance += carry.doubt[2, model.order[at] - TURBULENCE]
            if variance > 0.0:
                if c < B:
                    first, stop = base, n
                    for j in range(K):
                        e[base + j] = e6[j, c]
                else:
                    at = model.driven[c - 6]
                    if at >= tail:
                        first, stop = at, n
                        e[first:] = 0.0
                        e[at] = 1.0
                        for j in range(K):
                            e[base + j] = -walk[j, at - tail]
                    else:
                        first, stop = at, at + 1
                        e[at] = 1.0 / carry.fade[0] if model.fades[at] > 0.0 else 1.0
                qs = 1.0 / downdate(ut, d, e, first, stop, 1.0 / variance, k)
                if keep:
                    rows.qs[i, c] = qs
                    rows.g[i, c] = k[0] * qs
                    for j in range(n):
                        rows.k[i, c, j] = k[1 + j] * qs
            elif keep:
                rows.qs[i, c] = 0.0
                rows.g[i, c] = 0.0
                rows.k[i, c, :] = 0.0
        carry.doubt[:, :] = 0.0
        state(ut, star)
        place(s, flat, a, b, carry.fade[0], model.fades, predicted)
        carry.clock[0] += dt
        carry.clock[1] = 5.0 if drive.bridged[i] else carry.clock[1] - dt
        air = attitude = velocity = height = False
        for c in range(M):
            if drive.z[i, c] == drive.z[i, c]:
                air |= c < ATTITUDE
                attitude |= ATTITUDE <= c < HEIGHT
                height |= c == HEIGHT
                velocity |= c >= VELOCITY
        q[:] = q1
        xm[:] = x  # states that are not estimated stay as they are
        if air or attitude or velocity or height:
            for j in range(n):
                xm[model.order[j]] = predicted[j]
            if iterated:
                for j in range(STATES):
                    if not model.wind <= j < TURBULENCE + 3:
                        xm[j] = about.x[i + 1, j]
            xm[4] = xm[5] = xm[6] = 0.0
            matrix(q, r33)
            for j in range(3):
                omega[j] = drive.u[i, 3 + j] - xm[10 + j]
            if air:
                observe_air(xm, r33, omega, model.vane, y[AIR:ATTITUDE], h[AIR:ATTITUDE], work)
                if model.deaf:
                    deafen(xm, r33, h[AIR:ATTITUDE])
                if xm[1] - r33[0, 0] * xm[WIND] - r33[1, 0] * xm[WIND + 1] < SLOW:
                    air = False
            if attitude:
                observe_attitude(q, y[ATTITUDE:HEIGHT], h[ATTITUDE:HEIGHT], work)
                if abs(y[ATTITUDE]) > STEEP:
                    attitude = False
            if height:
                y[HEIGHT] = xm[0]
                h[HEIGHT, :] = 0.0
                h[HEIGHT, 0] = 1.0
            if velocity:
                observe_velocity(xm, r33, omega, model.antenna, y[VELOCITY:], h[VELOCITY:])
        lost[:] = 0
        absorbed = False
        for c in range(M):
            told.innovation[i, c] = np.nan
            told.status[i, c] = ABSENT
            told.r[i, c] = drive.r[i, c]
            present = drive.z[i, c] == drive.z[i, c]
            if (c < ATTITUDE and not air) or (ATTITUDE <= c < HEIGHT and not attitude):
                present = False
            if iterated and (about.status[i, c] == ABSENT or about.status[i, c] == REJECTED):
                present = False
            if not present:
                continue
            project(h[c], model, a, b, carry.fade[0], m)
            z = drive.z[i, c] - y[c]
            if 0 < c < HEIGHT:
                z = wrapped(z)
            for j in range(n):
                o = model.order[j]
                z += h[c, o] * (xm[o] - s[j])
            variance = about.r[i, c] if iterated else drive.r[i, c]
            miss, total = innovate(ut, d, m, z, variance, f)
            square = miss * miss / total
            status = USED
            if iterated:
                status = about.status[i, c]
            elif gated:
                carry.gate[c, 1] *= 1.0 - min(1.0, drive.dt[i] / MEMORY)
                carry.gate[c, 2] *= 1.0 - min(1.0, drive.dt[i] / MEMORY)
                carry.gate[c, 2] += 1.0
                if carry.clock[0] > QUIET:
                    wide = carry.clock[1] > 0.0
                    accept = WEAKEN if wide else ACCEPT
                    refuse = WEAKEN * WEAKEN / ACCEPT if wide else WEAKEN
                    if square > refuse:
                        status = REJECTED
                        carry.gate[c, 0] += 1.0
                        carry.gate[c, 1] += 1.0
                        often = carry.gate[c, 2] > 5.0 and carry.gate[c, 1] > SHARE * carry.gate[c, 2]
                        if (carry.gate[c, 0] > ROW or often) and GROUP[c] >= 0:
                            lost[GROUP[c]] = 1
                            carry.gate[c, 0] = 0.0
                            carry.gate[c, 1] = 0.0
                            carry.gate[c, 2] = 0.0
                    else:
                        carry.gate[c, 0] = 0.0
                        if square > accept:
                            status = WEAKENED
                            variance = max(variance, miss * miss / accept)
                            miss, total = innovate(ut, d, m, z, variance, f)
            told.innovation[i, c] = miss / np.sqrt(total)
            told.status[i, c] = status
            told.r[i, c] = variance
            if status == REJECTED:
                continue
            carry.cost[0] += miss * miss / total
            carry.cost[1] += np.log(total)
            carry.cost[2] += 1.0
            row[0] = z
            for j in range(n):
                row[1 + j] = m[j]
            agee_turner(ut, d, row, 1.0 / variance)
            absorbed = True
        if absorbed:
            state(ut, star)
            place(s, flat, a, b, carry.fade[0], model.fades, after)
        else:
            after[:] = predicted
        sum_ = 0.0
        for j in range(n):
            x[model.order[j]] = after[j]
            sum_ += after[j] + d[j]
        if not abs(sum_) < np.inf:
            return i
        rows.x[i] = after
        rows.q[i] = q
        if keep:
            rows.s[i] = s
            rows.closed[i] = 0
        told.doubted[i] = 0
        for group in range(3):
            if lost[group] or (iterated and about.doubted[i] & (1 << group)):
                told.doubted[i] |= 1 << group
                doubt(model, carry, group, full, scratch, std)
        if drive.shown[i]:
            deviations(
                model, ut, d, q, after, a, b, carry.fade[0], told.std[i], lower, blocks, part, work
            )  # fmt: skip
        carry.clock[2] += 1.0
        if carry.clock[2] >= window:
            anchor(model, carry, lu, order, after)
            if keep:
                rows.closed[i] = 1
    return -1
