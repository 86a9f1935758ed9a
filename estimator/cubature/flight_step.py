"""One step of the cubature filter of a flight path, compiled: the state ahead, and what leads back.

A step is regressed on the rotation by its points (``flight_points``), biases go with it as is expected of them; biases
by themselves, height and velocity enter linearly, by the derivatives; turbulence fades, the rest stays. The joint array
of a step::

    Tria([[odd, even, S_Q], [S, 0, 0]]) = [[S^-, 0], [L21, L22]]

has nothing to be annihilated but what stands in the columns of the states that the step changes. Its lower rows lead
back, and are kept: W = L21 (S^-)^{-1}, L22.
"""

from __future__ import annotations

import numpy as np

from estimator import kinematics, rotation, ud
from estimator.cubature import flight_points, reflections
from estimator.cubature.flight_points import EPS, FAR, core, image, part, regress, settle
from estimator.cubature.flight_structures import TURN, B, Carry, Desk, K, Layout
from estimator.cubature.reflections import NULL, reflect
from estimator.kinematics import TURBULENCE, step
from estimator.rotation import matrix
from estimator.ud import Array, lean

FOLLOWED = (kinematics.__file__, rotation.__file__, reflections.__file__, flight_points.__file__)
ud.follow(__file__, *FOLLOWED)


@lean
def regress_step(layout: Layout, x: Array, q: Array, root: Array, u: Array, dt: float, desk: Desk) -> None:
    """Regress a step: predicted mean, q1, odd parts in ``moved``, even parts in the first rows of ``noise``."""
    bias = layout.at[7]
    z, odd, even, slope, point, work = desk.z, desk.odd, desk.even, desk.slope, desk.point, desk.work
    r, over, r1, middle = work[60:69].reshape(3, 3), work[69:72], work[72:81].reshape(3, 3), work[81:90]
    step(x, q, u, dt, layout.earth, desk.x1, desk.q1, desk.phi, desk.b, work)
    core(root, bias, z)
    matrix(q, r)
    matrix(desk.q1, r1)
    for i in range(3):
        over[i] = r[i, 0] * x[1] + r[i, 1] * x[2] + r[i, 2] * x[3]
    for j in range(6):
        middle[j] = x[7 + j]
    for j in range(3):
        middle[6 + j] = x[4 + j]
    for c in range(K):
        desk.centre[c] = desk.x1[c]
    for i in range(TURN):
        for sign in range(2):
            reach = FAR if sign == 0 else -FAR
            for j in range(6):
                point[j] = middle[j] + reach * z[i, 3 + j]
            for j in range(3):
                point[6 + j] = middle[6 + j] + reach * z[i, j] if j >= i else middle[6 + j]
            y = desk.plus if sign == 0 else desk.minus
            image(point, x[0], over, q, u, dt, layout.earth, desk.q1, r1, y, work)
        part(desk.plus, desk.minus, desk.centre, i, 0, K, odd, even)
    settle(TURN, 0, K, desk.centre, desk.mean, even)
    for i in range(TURN):
        for c in range(K):
            desk.noise[i, c] = even[i, c]
            for j in range(B):
                odd[i, c] -= z[i, 3 + j] * desk.b[c, j]
    regress(z, TURN, odd, 0, K, slope)
    for c in range(K):
        for j in range(B):
            desk.moved[j, c] = desk.b[c, j]
        for j in range(4):
            desk.moved[B + j, c] = desk.phi[c, j]
        for j in range(3):
            desk.moved[B + 4 + j, c] = slope[j, c]


@lean
def carry_over(root: Array, bias: int, moved: Array, out: Array) -> None:
    """Fill ``out`` (n, 8) with the images of the columns of S in the kinematic states."""
    n = root.shape[0]
    base = n - K
    for i in range(n):
        own, one, two = out[i], root[i, bias:], root[i, base:]
        for c in range(0, K, 4):
            t0, t1, t2, t3 = 0.0, 0.0, 0.0, 0.0
            for j in range(max(i - bias, 0), B):
                t = one[j]
                t0 += t * moved[j, c]
                t1 += t * moved[j, c + 1]
                t2 += t * moved[j, c + 2]
                t3 += t * moved[j, c + 3]
            for j in range(max(i - base, 0), K):
                t = two[j]
                t0 += t * moved[B + j, c]
                t1 += t * moved[B + j, c + 1]
                t2 += t * moved[B + j, c + 2]
                t3 += t * moved[B + j, c + 3]
            own[c] = t0
            own[c + 1] = t1
            own[c + 2] = t2
            own[c + 3] = t3


@lean
def lead_back(root: Array, changed: int, gain: Array) -> None:
    """Turn ``gain`` (n, >= changed) from L21^T into W^T = L11^{-T} L21^T, with L11^T = ``root``.

    A pivot that is rounding beside its row of L11 leads nowhere: its column of W is zero.
    """
    n = root.shape[0]
    few = NULL * n * EPS
    for j in range(n - 1, -1, -1):
        norm = 0.0
        for i in range(j + 1):
            norm += root[i, j] * root[i, j]
        pivot = root[j, j]
        inverse = 0.0 if pivot <= few * np.sqrt(norm) else 1.0 / pivot
        row, own = root[j], gain[j]
        c = 0
        while c + 3 < changed:
            t0, t1, t2, t3 = own[c], own[c + 1], own[c + 2], own[c + 3]
            for i in range(j + 1, n):
                t = row[i]
                t0 -= t * gain[i, c]
                t1 -= t * gain[i, c + 1]
                t2 -= t * gain[i, c + 2]
                t3 -= t * gain[i, c + 3]
            own[c], own[c + 1], own[c + 2], own[c + 3] = t0, t1, t2, t3
            c += 4
        while c < changed:
            t0 = own[c]
            for i in range(j + 1, n):
                t0 -= row[i] * gain[i, c]
            own[c] = t0
            c += 1
        for c in range(changed):
            own[c] *= inverse


@lean
def predict(
    layout: Layout, carry: Carry, u: Array, dt: float, fade: float, variances: Array, desk: Desk, gain: Array,
    left: Array,
) -> int:  # fmt: skip
    """One step of the state; fills ``gain`` and ``left`` as `Rows` says and returns how many states it changed."""
    x, q, root = carry.x, carry.q, carry.root
    n, p = root.shape[0], variances.size
    base, bias = n - K, layout.at[7]
    top, below, noise, fresh, moved = desk.top, desk.below, desk.noise, desk.fresh, desk.moved
    regress_step(layout, x, q, root, u, dt, desk)
    rows = TURN
    for c in range(6):
        variance = variances[c] + carry.doubt[0 if c < 3 else 1, c % 3] / (dt * dt)
        if variance > 0.0:
            sigma = np.sqrt(variance)
            for j in range(K):
                noise[rows, j] = sigma * desk.b[j, c]
            rows += 1
    for i in range(rows, K):
        for j in range(K):
            noise[i, j] = 0.0
    for j in range(K):
        reflect(noise, j, noise, j + 1, rows, j, K)
    first, walks = base, 0
    for c in range(6, p):
        at = layout.driven[c - 6]
        variance = variances[c]
        if layout.fades[at] > 0.0:
            variance += carry.doubt[2, layout.order[at] - TURBULENCE]
        if variance > 0.0 or layout.fades[at] > 0.0:
            first = min(first, at)
    changed: int = n - first
    width = n + changed
    for i in range(K + p - 6):
        for j in range(width):
            below[i, j] = 0.0
    for c in range(6, p):
        at = layout.driven[c - 6]
        variance = variances[c]
        if layout.fades[at] > 0.0:
            variance += carry.doubt[2, layout.order[at] - TURBULENCE]
        if variance > 0.0:
            below[K + walks, at] = np.sqrt(variance)
            walks += 1
    carry.doubt[:, :] = 0.0
    carry_over(root, bias, moved, fresh)
    for i in range(first, n):
        for j in range(width):
            top[i, j] = 0.0
    for i in range(first):  # what stands to the right of these rows of the joint array begins the gain
        row, own = root[i, first:], gain[i]
        for c in range(changed):
            own[c] = row[c]
    for i in range(first, base):
        row, own = root[i], top[i]
        right = own[n - first :]
        for j in range(i, n):
            right[j] = row[j]
        for j in range(i, base):
            own[j] = row[j] * fade if j >= bias + 6 else row[j]
        for c in range(K):
            own[base + c] = fresh[i, c]
    for i in range(K):  # triangular noise above, the images of the last columns below
        row, own = root[base + i], below[i]
        right = own[n - first :]
        for j in range(base + i, n):
            right[j] = row[j]
        for c in range(K):
            own[base + c] = fresh[base + i, c]
            top[base + i, base + c] = noise[i, c] if c >= i else 0.0
    for i in range(first):
        row = root[i]
        for j in range(bias + 6, base):
            row[j] *= fade
        for c in range(K):
            row[base + c] = fresh[i, c]
    for j in range(first, n):
        reflect(top, j, below, K if j < base else 0, K + walks, j, width)
    for i in range(first, n):
        row, own, right, back = root[i], top[i], top[i, n:], gain[i]
        for j in range(i, n):
            row[j] = own[j]
        for c in range(changed):
            back[c] = right[c]
    lead_back(root, changed, gain)
    for i in range(changed):
        right, own = below[i, n:], left[i]
        for c in range(changed):
            own[c] = right[c] if i < K + walks else 0.0
    for j in range(K):
        x[j] = desk.mean[j]
    for j in range(bias + 6, base):
        x[layout.order[j]] *= fade
    for j in range(4):
        q[j] = desk.q1[j]
    return changed
