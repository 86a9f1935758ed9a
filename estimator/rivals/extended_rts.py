"""The textbook baseline of the flight path: extended Kalman filter and Rauch-Tung-Striebel smoother, dense, compiled.

The same model as ``extended``, linearised at the same places: a step at x_{j/j}, all measurements of an epoch at
x_{j+1/j}, in error coordinates about the same nominal quaternions. In exact arithmetic the answers are the same
whatever the windows of the information smoother are. Covariances are carried, transitions are full matrices and are
stored, an epoch's measurements are one block; matrix products are BLAS, as in ``rts``, whose kernels these are.

    P_{j+1/j} = Phi P Phi^T + Gam Q Gam^T       x += P H^T S^{-1} (z - h),  P -= P H^T S^{-1} H P
    G = P Phi^T P_{j+1/j}^{-1}                  x += G (x_{j+1/N} - x_{j+1/j}),  P += G (P_{j+1/N} - P_{j+1/j}) G^T

There is no gate here and no iteration.

References
----------
.. [1] H. E. Rauch, F. Tung and C. T. Striebel, "Maximum likelihood estimates of linear dynamic systems", AIAA Journal 3
   (1965) 1445-1450.
.. [2] A. H. Jazwinski, "Stochastic Processes and Filtering Theory", Academic Press, 1970, section 8.3.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from estimator import extended, kinematics, rotation, ud
from estimator.extended import B, Carry, Drive, K, Model, wrapped
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
from estimator.rivals import rts
from estimator.rivals.rts import LOST, gain, innovate, mirror, noise
from estimator.rotation import euler, euler_jacobian, exponential, matrix, turn
from estimator.ud import Array, compiled

ud.follow(__file__, kinematics.__file__, rotation.__file__, rts.__file__, extended.__file__)


class Room(NamedTuple):
    """What the two sweeps over N steps write, states in the order of the factor, angles as rotations about ``q``.

    Attributes
    ----------
    x (N+1, n), p (N+1, n, n) : estimate and covariance, of the filter and then of the smoother
    q (N+1, 4) : nominal attitudes
    ahead (N, n), ahead_p (N, n, n), phi (N, n, n) : predicted, and the transitions
    std (N+1, n) : standard deviations of the named states in their own order, of the sweep that was last
    w (N, 6) : smoothed noise of the inertial sensors
    push (N, 7, 6) : by which that noise enters
    """

    x: Array
    p: Array
    q: Array
    ahead: Array
    ahead_p: Array
    phi: Array
    std: Array
    w: Array
    push: Array

    @classmethod
    def of(cls, carry: Carry, count: int) -> Room:
        """Room for ``count`` steps that start from what a carry without any step knows."""
        n = carry.d.size
        room = cls(
            np.empty((count + 1, n)), np.empty((count + 1, n, n)), np.empty((count + 1, 4)), np.empty((count, n)),
            np.empty((count, n, n)), np.empty((count, n, n)), np.empty((count + 1, n)), np.empty((count, B)),
            np.empty((count, K, B)),
        )  # fmt: skip
        root = np.linalg.inv(carry.ut[:, 1:])  # U^{-T}: L^{-1} = U^{-T} D^{-1} U^{-1}
        room.x[0], room.q[0], room.p[0] = carry.s, carry.q, (root / carry.d) @ root.T
        return room


@compiled
def transition(model: Model, phi7: Array, b6: Array, fade: float, phi: Array) -> None:
    """Fill ``phi`` (n, n), in the order of the factor, from its blocks."""
    n = phi.shape[0]
    base = n - K
    phi[:, :] = 0.0
    for i in range(base):
        phi[i, i] = fade if model.fades[i] > 0.0 else 1.0
    for i in range(K):
        for j in range(B):
            phi[base + i, base - B + j] = b6[i, j]
        for j in range(K):
            phi[base + i, base + j] = phi7[i, j]


@compiled
def spread(x: Array, q: Array, p: Array, std: Array, work: Array) -> None:
    """Fill ``std`` (n,) with the deviations of the named states; ``work`` (200,) is scratch."""
    n = x.size
    base = n - K
    e, angles, now = work[0:9].reshape(3, 3), work[9:12], work[12:16]
    image, v = work[16:52].reshape(6, 6), work[52:55]
    std[0] = np.sqrt(p[base, base])
    for i in range(B):
        std[K + i] = np.sqrt(p[base - B + i, base - B + i])
    for i in range(base - B):
        std[K + B + i] = np.sqrt(p[i, i])
    turn(q, x[base + 4], x[base + 5], x[base + 6], now)
    euler(now, angles)
    euler_jacobian(angles[0], angles[1], e)
    image[:, :] = 0.0
    image[3:, 3:] = e
    exponential(-x[base + 4], -x[base + 5], -x[base + 6], e)  # (u, v, w) = exp(-[a]x) V
    for i in range(3):
        v[i] = e[i, 0] * x[base + 1] + e[i, 1] * x[base + 2] + e[i, 2] * x[base + 3]
    image[:3, :3] = e
    image[0, 4], image[0, 5] = -v[2], v[1]
    image[1, 3], image[1, 5] = v[2], -v[0]
    image[2, 3], image[2, 4] = -v[1], v[0]
    for i in range(6):
        variance = 0.0
        for j in range(6):
            for c in range(6):
                variance += image[i, j] * p[base + 1 + j, base + 1 + c] * image[i, c]
        std[1 + i] = np.sqrt(variance)


@compiled
def forward(model: Model, drive: Drive, start: Array, room: Room) -> int:
    """Filter N steps from epoch 0 of ``room``; ``start`` (23,) has the states that are not estimated.

    Returns the step at which the innovation covariance is not positive definite, or -1.
    """
    count, p = drive.q.shape
    n = room.x.shape[1]
    base = n - K
    x, x1, work = start.copy(), np.empty(STATES), np.empty(200)
    phi7, b6, gamma = np.empty((K, K)), np.empty((K, B)), np.zeros((n, p))
    turned, product, added = np.empty((n, n)), np.empty((n, n)), np.empty((n, n))
    push, lifted, gained, jump = np.empty((n, p)), np.empty((p, n)), np.empty((n, n)), np.empty(n)
    y, h, miss, zero = np.empty(M), np.empty((M, STATES)), np.empty(M), np.zeros(n)
    ordered, r33, omega = np.empty((M, n)), np.empty((3, 3)), np.empty(3)
    rows, hp, reduced, scaled = np.empty((M, n)), np.empty((M, n)), np.empty((M, n)), np.empty((M, n))
    nu, root, d = np.empty((2, M)), np.empty(M * M), np.empty(M)
    for c in range(6, p):
        gamma[model.driven[c - 6], c] = 1.0
    for j in range(n):
        x[model.order[j]] = room.x[0, j]
    spread(room.x[0], room.q[0], room.p[0], room.std[0], work)
    for i in range(count):
        q1, ahead, ahead_p, now = room.q[i + 1], room.ahead[i], room.ahead_p[i], room.phi[i]
        step(x, room.q[i], drive.u[i], drive.dt[i], model.earth, x1, q1, phi7, b6, work)
        transition(model, phi7, b6, drive.fade[i], now)
        for j in range(K):
            for c in range(B):
                gamma[base + j, c] = b6[j, c]
                room.push[i, j, c] = b6[j, c]
        x[:13] = x1[:13]
        for j in range(base - B):
            if model.fades[j] > 0.0:
                x[model.order[j]] *= drive.fade[i]
        for j in range(n):
            ahead[j] = x[model.order[j]]
        noise(gamma, drive.q[i], push, lifted, added)
        turned[:, :] = now.T
        np.dot(now, room.p[i], product)
        np.dot(product, turned, ahead_p)
        for j in range(n):
            row, more = ahead_p[j], added[j]
            for c in range(n):
                row[c] += more[c]
        seen = used = 0
        for c in range(M):
            miss[c] = np.nan
            if drive.z[i, c] == drive.z[i, c]:
                seen |= 1 if c < ATTITUDE else 2 if c < HEIGHT else 4 if c == HEIGHT else 8
        if seen:
            matrix(q1, r33)
            for j in range(3):
                omega[j] = drive.u[i, 3 + j] - x[10 + j]
            if seen & 1 and not x[1] - r33[0, 0] * x[WIND] - r33[1, 0] * x[WIND + 1] < SLOW:
                observe_air(x, r33, omega, model.vane, y[AIR:ATTITUDE], h[AIR:ATTITUDE], work)
                if model.deaf:
                    deafen(x, r33, h[AIR:ATTITUDE])
                used |= 1
            if seen & 2:
                observe_attitude(q1, y[ATTITUDE:HEIGHT], h[ATTITUDE:HEIGHT], work)
                used |= 0 if abs(y[ATTITUDE]) > STEEP else 2
            if seen & 4:
                y[HEIGHT] = x[0]
                h[HEIGHT, :] = 0.0
                h[HEIGHT, 0] = 1.0
                used |= 4
            if seen & 8:
                observe_velocity(x, r33, omega, model.antenna, y[VELOCITY:], h[VELOCITY:])
                used |= 8
            for c in range(M):
                bit = 1 if c < ATTITUDE else 2 if c < HEIGHT else 4 if c == HEIGHT else 8
                if used & bit and drive.z[i, c] == drive.z[i, c]:
                    miss[c] = drive.z[i, c] - y[c]
                    if 0 < c < HEIGHT:
                        miss[c] = wrapped(miss[c])
                    for j in range(n):
                        ordered[c, j] = h[c, model.order[j]]
        count_now = innovate(
            ordered, drive.r[i].reshape((M, 1)), miss, zero, ahead_p, rows, nu, hp, reduced, scaled, root, d
        )
        if count_now == LOST:
            return i
        room.x[i + 1] = ahead
        if count_now == 0:
            room.p[i + 1] = ahead_p
        else:
            np.dot(scaled[:count_now].T, nu[1, :count_now], jump)
            np.dot(scaled[:count_now].T, reduced[:count_now], gained)
            for j in range(n):
                room.x[i + 1, j] += jump[j]
                row, less, out = ahead_p[j], gained[j], room.p[i + 1, j]
                for c in range(n):
                    out[c] = row[c] - less[c]
            for j in range(n):
                x[model.order[j]] = room.x[i + 1, j]
        mirror(room.p[i + 1])
        spread(room.x[i + 1], q1, room.p[i + 1], room.std[i + 1], work)
    return -1


@compiled
def backward(model: Model, drive: Drive, room: Room) -> int:
    """Smooth what ``forward`` left in ``room``, in place.

    Returns the step whose predicted covariance is not positive definite, or -1.
    """
    count, n = room.ahead.shape
    base = n - K
    root, d, work = np.empty((n, n)), np.empty(n), np.empty((n, n))
    g, change, jump, part, small = np.empty((n, n)), np.empty((n, n)), np.empty(n), np.empty(n), np.empty(200)
    spread(room.x[count], room.q[count], room.p[count], room.std[count], small)
    for i in range(count - 1, -1, -1):
        p, after, ahead_p = room.p[i], room.p[i + 1], room.ahead_p[i]
        if not gain(room.phi[i], p, ahead_p, root, d, work, g):
            return i
        for a in range(n):
            jump[a] = room.x[i + 1, a] - room.ahead[i, a]
            row, new, old = change[a], after[a], ahead_p[a]
            for b in range(n):
                row[b] = new[b] - old[b]
        np.dot(root, jump, part)  # P_pred^{-1} jump = L^{-T} D^{-1} L^{-1} jump: what the noise is told by
        for a in range(n):
            part[a] *= d[a]
        for c in range(B):
            t = 0.0
            for j in range(K):
                s = 0.0
                for a in range(base + j, n):
                    s += root[a, base + j] * part[a]
                t += room.push[i, j, c] * s
            room.w[i, c] = drive.q[i, c] * t
        np.dot(g.T, jump, part)
        np.dot(g.T, change, work)
        np.dot(work, g, change)
        for a in range(n):
            room.x[i, a] += part[a]
            row, more = p[a], change[a]
            for b in range(n):
                row[b] += more[b]
        mirror(p)
        spread(room.x[i], room.q[i], p, room.std[i], small)
    return -1
