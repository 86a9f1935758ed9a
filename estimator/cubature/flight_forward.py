"""The cubature filter of a flight path, compiled: steps driven by the inertial sensors, measurements, gates.

The joint array of the measurements is brought to its triangular form one scalar after the other, by rotations that
leave the factor triangular: its pivot is then the standard deviation of the innovation given all scalars before, and
one that the gate refuses is left out. Nothing is subtracted from a covariance anywhere.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from estimator import extended, ud
from estimator.cubature import flight_points, flight_seen, flight_step
from estimator.cubature.flight_points import deviations, wrapped
from estimator.cubature.flight_seen import see
from estimator.cubature.flight_step import predict
from estimator.cubature.flight_structures import SPARE, Carry, Desk, Layout, Rows
from estimator.extended.forward import ACCEPT, GROUP, MEMORY, QUIET, ROW, SHARE, WEAKEN
from estimator.extended.structures import ABSENT, REJECTED, USED, WEAKENED, Drive, Told
from estimator.kinematics import ATTITUDE, HEIGHT, TURBULENCE, M
from estimator.ud import Array, lean

ud.follow(
    __file__, str(Path(extended.__file__).parent / "forward.py"), *flight_step.FOLLOWED, flight_step.__file__,
    flight_points.__file__, flight_seen.__file__,
)  # fmt: skip


@lean
def condition(c: int, variance: float, root: Array, seen: Array, spare: Array, pivot: Array) -> float:
    """Rotate scalar ``c`` of the joint array into its triangular form; returns the deviation of its innovation.

    Leaves in ``pivot`` (10 + n,) the rows below it: the later scalars', then the gains of the states.
    """
    n = root.shape[0]
    head: float = np.sqrt(variance)
    pivot[:] = 0.0
    for i in range(SPARE):
        t = spare[i, c]
        if t != 0.0:
            size = np.sqrt(head * head + t * t)
            cosine, sine = head / size, t / size
            head = size
            row = spare[i]
            for k in range(c + 1, M):
                one, other = pivot[k], row[k]
                pivot[k] = cosine * one + sine * other
                row[k] = cosine * other - sine * one
            row[c] = 0.0
    for i in range(n - 1, -1, -1):  # from the last: what is rotated in has nothing to the left of its row's own place
        t = seen[i, c]
        if t != 0.0:
            size = np.sqrt(head * head + t * t)
            cosine, sine = head / size, t / size
            head = size
            row, far = seen[i], root[i]
            for k in range(c + 1, M):
                one, other = pivot[k], row[k]
                pivot[k] = cosine * one + sine * other
                row[k] = cosine * other - sine * one
            gains = pivot[M:]
            for k in range(i, n):
                one, other = gains[k], far[k]
                gains[k] = cosine * one + sine * other
                far[k] = cosine * other - sine * one
            row[c] = 0.0
    return head


@lean
def spread(c: int, seen: Array, spare: Array) -> float:
    """Variance of what scalar ``c`` is expected to be, given the scalars before, without its own noise."""
    t = 0.0
    for i in range(SPARE):
        t += spare[i, c] * spare[i, c]
    for i in range(seen.shape[0]):
        t += seen[i, c] * seen[i, c]
    return t


@lean
def forward(layout: Layout, drive: Drive, gated: bool, carry: Carry, desk: Desk, rows: Rows, told: Told) -> int:
    """Filter N steps; returns the first step whose result is not finite, or -1.

    ``carry`` is overwritten, ``rows`` and ``told`` are written.
    """
    n, count = carry.root.shape[0], drive.dt.size
    x, q, root, gate, pivot = carry.x, carry.q, carry.root, carry.gate, desk.pivot
    std, lost = desk.std, desk.lost
    for i in range(count):
        dt = drive.dt[i]
        rows.changed[i] = predict(
            layout, carry, drive.u[i], dt, drive.fade[i], drive.q[i], desk, rows.gain[i], rows.left[i]
        )
        for j in range(n):
            rows.predicted[i, j] = x[layout.order[j]]
        carry.clock[0] += dt
        carry.clock[1] = 5.0 if drive.bridged[i] else carry.clock[1] - dt
        some = False
        for c in range(M):
            some |= drive.z[i, c] == drive.z[i, c]
        air = attitude = False
        if some:
            air, attitude = see(layout, drive.z[i], x, q, drive.u[i, 3:], root, desk)
            for c in range(M):
                desk.y[c] = drive.z[i, c] - desk.y[c]  # from here on the innovation
        lost[:] = 0.0
        for c in range(M):
            told.innovation[i, c] = np.nan
            told.status[i, c] = ABSENT
            told.r[i, c] = drive.r[i, c]
            present = drive.z[i, c] == drive.z[i, c]
            if not present or (c < ATTITUDE and not air) or (ATTITUDE <= c < HEIGHT and not attitude):
                continue
            miss = wrapped(desk.y[c]) if 0 < c < HEIGHT else desk.y[c]
            variance = drive.r[i, c]
            total = variance + spread(c, desk.seen, desk.spare)
            square = miss * miss / total
            status = USED
            if gated:
                gate[c, 1] *= 1.0 - min(1.0, dt / MEMORY)
                gate[c, 2] *= 1.0 - min(1.0, dt / MEMORY)
                gate[c, 2] += 1.0
                if carry.clock[0] > QUIET:
                    wide = carry.clock[1] > 0.0
                    accept = WEAKEN if wide else ACCEPT
                    refuse = WEAKEN * WEAKEN / ACCEPT if wide else WEAKEN
                    if square > refuse:
                        status = REJECTED
                        gate[c, 0] += 1.0
                        gate[c, 1] += 1.0
                        often = gate[c, 2] > 5.0 and gate[c, 1] > SHARE * gate[c, 2]
                        if (gate[c, 0] > ROW or often) and GROUP[c] >= 0:
                            lost[GROUP[c]] = 1.0
                            gate[c, 0] = 0.0
                            gate[c, 1] = 0.0
                            gate[c, 2] = 0.0
                    else:
                        gate[c, 0] = 0.0
                        if square > accept:
                            status = WEAKENED
                            raised = max(variance, miss * miss / accept)
                            total += raised - variance
                            variance = raised
            told.innovation[i, c] = miss / np.sqrt(total)
            told.status[i, c] = status
            told.r[i, c] = variance
            if status == REJECTED:
                continue
            carry.cost[0] += miss * miss / total
            carry.cost[1] += np.log(total)
            carry.cost[2] += 1.0
            white = miss / condition(c, variance, root, desk.seen, desk.spare, pivot)
            for k in range(c + 1, M):
                desk.y[k] -= pivot[k] * white
            for j in range(n):
                x[layout.order[j]] += pivot[M + j] * white
        sum_ = 0.0
        for j in range(n):
            rows.x[i, j] = x[layout.order[j]]
            sum_ += rows.x[i, j] + root[j, j]
        if not abs(sum_) < np.inf:
            return i
        for j in range(4):
            rows.q[i, j] = q[j]
        told.doubted[i] = 0
        doubted = lost[0] + lost[1] + lost[2] > 0.0
        if drive.shown[i] or doubted:
            deviations(layout.named, root, x, q, std, desk.z, desk.plus, desk.minus, desk.centre, desk.work)
        if drive.shown[i]:
            for j in range(n):
                told.std[i, j] = std[j]
        if doubted:
            for group in range(3):
                if lost[group] > 0.0:
                    told.doubted[i] |= 1 << group
                    doubt(layout, carry, group, root, std)
    return -1


@lean
def doubt(layout: Layout, carry: Carry, group: int, root: Array, std: Array) -> None:
    """Note that the filter is to be doubted about a group of states: ten times its variance, from the next step on."""
    for i in range(3):
        variance = 0.0
        if group < 2:
            variance = std[1 + 3 * group + i] ** 2
        elif layout.at[TURBULENCE] >= 0:
            at = layout.at[TURBULENCE + i]
            for j in range(at + 1):
                variance += root[j, at] * root[j, at]
        carry.doubt[group, i] = 9.0 * variance
