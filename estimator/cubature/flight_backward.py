"""The cubature smoother of a flight path, compiled: stored steps from the last epoch to the first.

x_{j/N} = x_{j/j} + W (x_{j+1/N} - x_{j+1/j});  S_{j/N} = Tria([L22, W S_{j+1/N}]): no covariance is subtracted, and
what a step leaves as it is stays as it is on the way back.
"""

from __future__ import annotations

from estimator import ud
from estimator.cubature import flight_points, reflections
from estimator.cubature.flight_points import deviations, straighten
from estimator.cubature.flight_structures import Desk, K, Layout, Rows
from estimator.cubature.reflections import reflect
from estimator.extended.structures import Flags
from estimator.ud import Array, lean

ud.follow(__file__, reflections.__file__, flight_points.__file__)


@lean
def go_back(filtered: Array, predicted: Array, changed: int, gain: Array, left: Array, x: Array, root: Array,
            factors: bool, stack: Array) -> None:  # fmt: skip
    """One step back: ``x`` (n,) and ``root`` (n, n) after it, smoothed, become those before it.

    ``stack`` (2 n, n) is scratch.
    """
    n = x.size
    first = n - changed
    new = stack[2 * n - 1]
    for c in range(changed):
        new[c] = filtered[first + c]
    for j in range(n):
        t, own = x[j] - predicted[j], gain[j]
        for c in range(changed):
            new[c] += t * own[c]
    for c in range(changed):
        x[first + c] = new[c]
    if not factors:
        return
    for i in range(n):  # S^T W^T, four columns at a time
        row, own = root[i], stack[i]
        c = 0
        while c + 3 < changed:
            t0, t1, t2, t3 = 0.0, 0.0, 0.0, 0.0
            for j in range(i, n):
                t = row[j]
                t0 += t * gain[j, c]
                t1 += t * gain[j, c + 1]
                t2 += t * gain[j, c + 2]
                t3 += t * gain[j, c + 3]
            own[c], own[c + 1], own[c + 2], own[c + 3] = t0, t1, t2, t3
            c += 4
        while c < changed:
            t0 = 0.0
            for j in range(i, n):
                t0 += row[j] * gain[j, c]
            own[c] = t0
            c += 1
    for i in range(first):
        for c in range(changed):
            root[i, first + c] = stack[i, c]
    rows = 0
    for i in range(changed):
        size = 0.0
        for c in range(changed):
            size += abs(left[i, c])
        if size > 0.0:
            for c in range(changed):
                stack[n + rows, c] = left[i, c]
            rows += 1
    for j in range(changed):
        reflect(stack, first + j, stack, first + j + 1, n + rows, j, changed)
    for i in range(changed):
        for c in range(changed):
            root[first + i, first + c] = stack[first + i, c] if c >= i else 0.0


@lean
def backward(
    layout: Layout, rows: Rows, x: Array, root: Array, begin: Array, q0: Array, shown: Flags, factors: bool,
    means: Array, attitudes: Array, std: Array, desk: Desk, stack: Array,
) -> None:  # fmt: skip
    """Smooth N stored steps, from the last epoch to the first.

    Parameters
    ----------
    x (n,), root (n, n) : smoothed state and its factor, transposed, at the last epoch; overwritten with the first's
    begin (23,), q0 (4,) : state and nominal attitude that the filter began with
    shown (N+1,) : where standard deviations are wanted
    factors : False: states only, ``root`` is not used
    means (N+1, 23), attitudes (N+1, 4), std (N+1, n) : smoothed states, rotation zero; standard deviations of the named
        states; written
    stack (2 n + 1, n) : scratch
    """
    n, count = x.size, rows.changed.size
    base = n - K
    before, state, one, q1 = stack[2 * n], desk.x1, x.reshape(1, n), desk.q1.reshape(1, 4)
    for j in range(begin.size):
        state[j] = begin[j]
    for i in range(count, -1, -1):
        for j in range(4):
            q1[0, j] = q0[j] if i == 0 else rows.q[i - 1, j]
        straighten(layout.order, one, q1, begin, means[i : i + 1], attitudes[i : i + 1], desk.work)
        if factors and shown[i]:
            for j in range(K):
                state[j] = x[base + j]
            deviations(layout.named, root, state, q1[0], std[i], desk.z, desk.plus, desk.minus, desk.centre, desk.work)
        if i == 0:
            return
        at = i - 1
        for j in range(n):
            before[j] = rows.x[at - 1, j] if at > 0 else begin[layout.order[j]]
        go_back(before, rows.predicted[at], rows.changed[at], rows.gain[at], rows.left[at], x, root, factors, stack)
