"""The extended information smoother: MS-A about a reference, for the kinematics of a flight path, compiled.

A step linearised at the estimate is x_{j+1} = Phi_j x_j + c_j + Gam_j w_j. The affine part enters as an offset,
x_j = s_j + phi_{j,0} x*_j, and what is left is the linear smoother of ``sweeps``::

    s_{j+1} = F(x_{j/j}) + Phi_j (s_j - x_{j/j})           z~ = z - h(x_{j+1/j}) + H (x_{j+1/j} - s_{j+1})
    forward    E = phi_{j+1,0}^{-1} Gam_j;  downdate by [0; E_c], 1/q_c;  update by [z~_i, H_i phi_{j+1,0}], 1/r_i
    anchor     V = phi^{-T} U,  eta := 0,  s := x_{k/k},  phi := I
    backward   x* <- x* + E_c (g_c - b_c^T x*);  at an anchor x* := phi^{-1} (s_new + x* - s_old)

One number per state and step is kept beside the snapshots of the linear smoother, s_j, and the nominal attitude about
which it is. A pass about a given trajectory (``About``) is the Gauss-Newton step of the whole problem; turbulence and
wind are then taken from the present prediction, because latent gusts make the exact solution biased.

phi_{j,0} is blocks: kinematics (7), the biases that drive them (6), and a diagonal. States are ordered with the
kinematics last, so that the noise of the inertial sensors changes the last seven columns of U only::

    [tail | ba, bg | h, v, a]       tail: kV, b_alpha, b_beta (k_alpha, k_beta), W (mode G), T
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimator import kinematics, rotation, sweeps, ud
from estimator.kinematics import (
    AIR,
    ATTITUDE,
    HEIGHT,
    SLOW,
    STATES,
    STEEP,
    TURBULENCE,
    VELOCITY,
    Earth,
    M,
    observe_air,
    observe_attitude,
    observe_velocity,
    step,
)
from estimator.rotation import difference, euler, euler_jacobian, exponential, matrix, turn
from estimator.sweeps import state, terminal
from estimator.ud import Array, Order, agee_turner, bierman, compiled, factor, mwgs, solve

ud.follow(__file__, kinematics.__file__, rotation.__file__, sweeps.__file__)

Flags = NDArray[np.uint8]

K, B = 7, 6  # kinematic states, and the biases that drive them
EPS = 2.3e-16
ABSENT, USED, WEAKENED, REJECTED = 0, 1, 2, 3  # what became of a scalar
ACCEPT, WEAKEN = 25.0, 64.0  # squares of sigmas: accepted, accepted with raised noise, rejected
ROW, SHARE, MEMORY = 10, 0.3, 2.0  # rejections in a row, or their share over seconds, that mean it is the filter
QUIET = 10.0  # s from the start without a gate
QUIETEST = 11  # noise components; with more of them, biases walk
GROUP = np.array([2, 2, 2, 1, 1, 1, -1, 0, 0, 0])  # what is doubted when a channel is locked out: v, a or T


class Model(NamedTuple):
    """What does not change from step to step.

    Attributes
    ----------
    order : (n,) array
        Numbers of the states (see ``kinematics``) in the order of the factor.
    fades : (n,) array
        1 for turbulence, else 0.
    driven : (p - 6,) array
        Positions in ``order`` of the states that noise components 6.. drive; the first six are the inertial sensors'.
    vane, antenna : (3,) arrays
        From the inertial sensors, body axes, m.
    earth : Earth
    wind : int
        Number of the first state that a pass about a trajectory predicts: WIND, or TURBULENCE.
    """

    order: Order
    fades: Array
    driven: Order
    vane: Array
    antenna: Array
    earth: Earth
    wind: int


class Drive(NamedTuple):
    """N steps.

    Attributes
    ----------
    dt : (N,) array
        s.
    u : (N, 6) array
        Specific force and angular rate, means over the step.
    q : (N, p) array
        Variances of the noise components.
    fade : (N,) array
        exp(-dt / tau) of turbulence.
    z, r : (N, 10) arrays
        Measurements at the end of the step, NaN = absent, and their variances.
    bridged : (N,) array
        1 where the inertial data were made up.
    shown : (N,) array
        1 where standard deviations are wanted.
    """

    dt: Array
    u: Array
    q: Array
    fade: Array
    z: Array
    r: Array
    bridged: Flags
    shown: Flags

    def part(self, first: int, stop: int) -> Drive:
        """The steps first..stop-1: views."""
        return Drive(*(column[first:stop] for column in self))  # type: ignore[arg-type]

    @classmethod
    def join(cls, parts: list[Drive]) -> Drive:
        """All steps, one part after the other."""
        return cls(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


class Carry(NamedTuple):
    """All that is known so far, as arrays that the sweep overwrites.

    Attributes
    ----------
    ut (n, 1+n), d (n,) : factor of the information, data in front
    s (n,), x (23,), q (4,) : offset, estimate, and the nominal attitude of both
    a (7, 7), b (7, 6), fade (1,) : the blocks of phi_{j,0}
    gate (10, 3), doubt (3, 3) : rejections in a row, their recent number and that of all; variance to be added
    clock (3,) : s since the start; s of wide gates left; steps since the anchor
    cost (3,) : sum of NIS, of log S, and the number of scalars
    """

    ut: Array
    d: Array
    s: Array
    x: Array
    q: Array
    a: Array
    b: Array
    fade: Array
    gate: Array
    doubt: Array
    clock: Array
    cost: Array

    def copy(self) -> Carry:
        """The same knowledge in arrays of its own."""
        return Carry(*(array.copy() for array in self))


class Rows(NamedTuple):
    """Snapshots of N steps: Table 5 of Shi's paper, the offset, and the estimate, which is the offset after an anchor.

    Attributes
    ----------
    a (N, 7, 7), b (N, 7, 6), fade (N,) : phi_{j+1,0}
    e (N, 7, 6), w (N|0, 7, 6) : E of the inertial sensors' noise and, where biases walk, of theirs
    k (N, p, n), g (N, p), qs (N, p) : b_c, g_c and their weights
    s (N, n), x (N, n), q (N, 4) : offset, filter estimate, nominal attitude
    closed (N,) : 1 where a window ends after the step
    """

    a: Array
    b: Array
    fade: Array
    e: Array
    w: Array
    k: Array
    g: Array
    qs: Array
    s: Array
    x: Array
    q: Array
    closed: Flags

    @classmethod
    def empty(cls, count: int, n: int, p: int) -> Rows:
        """Room for ``count`` steps."""
        walk = count if p > QUIETEST else 0
        return cls(
            np.empty((count, K, K)), np.empty((count, K, B)), np.empty(count), np.empty((count, K, B)),
            np.empty((walk, K, B)), np.empty((count, p, n)), np.empty((count, p)), np.empty((count, p)),
            np.empty((count, n)), np.empty((count, n)), np.empty((count, 4)), np.zeros(count, np.uint8),
        )  # fmt: skip

    def part(self, first: int, stop: int) -> Rows:
        """The steps first..stop-1: views."""
        return Rows(*(array[first:stop] for array in self))  # type: ignore[arg-type]


class Told(NamedTuple):
    """What the filter says of N steps.

    Attributes
    ----------
    std (N, n) : of the named states, in their order; written where ``Drive.shown``
    innovation (N, 10) : divided by its standard deviation, NaN = absent
    status (N, 10) : ABSENT, USED, WEAKENED or REJECTED
    r (N, 10) : variances that were used
    doubted (N,) : bit 1, 2 or 4 where the filter was doubted about velocity, attitude or turbulence
    """

    std: Array
    innovation: Array
    status: Flags
    r: Array
    doubted: Flags

    @classmethod
    def empty(cls, count: int, n: int) -> Told:
        """Room for ``count`` steps."""
        return cls(
            np.full((count, n), np.nan), np.empty((count, M)), np.zeros((count, M), np.uint8), np.empty((count, M)),
            np.zeros(count, np.uint8),
        )  # fmt: skip

    def part(self, first: int, stop: int) -> Told:
        """The steps first..stop-1: views."""
        return Told(*(column[first:stop] for column in self))  # type: ignore[arg-type]

    @classmethod
    def join(cls, parts: list[Told]) -> Told:
        """All steps, one part after the other."""
        return cls(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


class About(NamedTuple):
    """A trajectory to linearise about: N + 1 epochs, N steps.

    Attributes
    ----------
    x (N+1, 23), q (N+1, 4) : states, rotation zero, and attitudes
    w (N, 6) : noise of the inertial sensors
    status, r (N, 10) : what the first pass decided about every scalar
    """

    x: Array
    q: Array
    w: Array
    status: Flags
    r: Array

    @classmethod
    def nothing(cls) -> About:
        """No trajectory: the filter linearises at its own estimates."""
        return cls(
            np.empty((0, STATES)), np.empty((0, 4)), np.empty((0, B)), np.empty((0, M), np.uint8), np.empty((0, M))
        )


@compiled
def downdate(ut: Array, d: Array, h: Array, first: int, stop: int, r: float, k: Array) -> float:
    """``ud.bierman`` with one column of data, for ``h`` (n,) that is zero outside first..stop-1."""
    n = d.size
    a = r
    for i in range(1 + first):
        k[i] = 0.0
    for j in range(first):
        k[1 + j] = 0.0
    for j in range(first, n):
        f = h[j] if j < stop else 0.0
        row = ut[j]
        for i in range(first, min(j, stop)):
            f += row[1 + i] * h[i]
        v = d[j] * f
        k[1 + j] = v
        if v != 0.0:
            grown = a + f * v
            d[j] *= a / grown
            gain = f / a
            for i in range(1 + j):
                t = row[i]
                row[i] = t - gain * k[i]
                k[i] += v * t
            a = grown
    return a


@compiled
def innovate(ut: Array, d: Array, m: Array, z: float, r: float, f: Array) -> tuple[float, float]:
    """Innovation of z = m^T x* + v and its variance, before it is absorbed: U f = m, S = r + sum f_i^2 / D_i."""
    n = d.size
    for i in range(n):
        f[i] = m[i]
    s = r
    for j in range(n - 1, -1, -1):
        t = f[j]
        s += t * t / d[j]
        row = ut[j]
        z -= t * row[0]
        for i in range(j):
            f[i] -= row[1 + i] * t
    return z, s


@compiled
def place(s: Array, star: Array, a: Array, b: Array, fade: float, fades: Array, x: Array) -> None:
    """Fill ``x`` (n,) with s + phi x*."""
    n = s.size
    base = n - K
    for i in range(n - K - B):
        x[i] = s[i] + star[i] * (fade if fades[i] > 0.0 else 1.0)
    for i in range(n - K - B, base):
        x[i] = s[i] + star[i]
    for i in range(K):
        t = s[base + i]
        for j in range(K):
            t += a[i, j] * star[base + j]
        for j in range(B):
            t += b[i, j] * star[base - B + j]
        x[base + i] = t


@compiled
def unplace(
    x: Array, s: Array, lu: Array, order: Order, b: Array, fade: float, fades: Array, star: Array, v: Array
) -> None:
    """Fill ``star`` (n,) with phi^{-1} (x - s); ``lu``, ``order``: the factors of its block A; ``v`` (7, 2) scratch."""
    n = s.size
    base = n - K
    for i in range(n - K - B):
        star[i] = (x[i] - s[i]) / (fade if fades[i] > 0.0 else 1.0)
    for i in range(n - K - B, base):
        star[i] = x[i] - s[i]
    right, left = v[:, :1], v[:, 1:]
    for i in range(K):
        t = x[base + i] - s[base + i]
        for j in range(B):
            t -= b[i, j] * star[base - B + j]
        right[i, 0] = t
    solve(lu, order, right, left)
    for i in range(K):
        star[base + i] = left[i, 0]


@compiled
def project(h: Array, model: Model, a: Array, b: Array, fade: float, m: Array) -> None:
    """Fill ``m`` (n,) with h phi, ``h`` (23,) by the numbers of the states."""
    n = m.size
    base = n - K
    for i in range(n - K - B):
        m[i] = h[model.order[i]] * (fade if model.fades[i] > 0.0 else 1.0)
    for j in range(B):
        t = h[K + j]
        for i in range(K):
            t += h[i] * b[i, j]
        m[base - B + j] = t
    for j in range(K):
        t = 0.0
        for i in range(K):
            t += h[i] * a[i, j]
        m[base + j] = t


@compiled
def image(
    model: Model, q: Array, x: Array, a: Array, b: Array, fade: float, euler_rows: bool, phi: Array, w: Array
) -> None:
    """Fill ``phi`` (n, n): rows are the named states in their own order, columns those of the factor.

    Angles are Euler angles at the estimate ``x`` (n,) about ``q``, or rotations about body axes. ``w`` (200,) scratch.
    """
    n = x.size
    base = n - K
    phi[:, :] = 0.0
    e, angles, now = w[0:9].reshape(3, 3), w[9:12], w[12:16]
    for i in range(K):
        for j in range(K):
            phi[i, base + j] = a[i, j]
        for j in range(B):
            phi[i, base - B + j] = b[i, j]
    if euler_rows:
        exponential(-x[base + 4], -x[base + 5], -x[base + 6], e)  # (u, v, w) = exp(-[a]x) V
        v1 = e[0, 0] * x[base + 1] + e[0, 1] * x[base + 2] + e[0, 2] * x[base + 3]
        v2 = e[1, 0] * x[base + 1] + e[1, 1] * x[base + 2] + e[1, 2] * x[base + 3]
        v3 = e[2, 0] * x[base + 1] + e[2, 1] * x[base + 2] + e[2, 2] * x[base + 3]
        for j in range(base - B, n):
            t1, t2, t3 = phi[1, j], phi[2, j], phi[3, j]
            a1, a2, a3 = phi[4, j], phi[5, j], phi[6, j]
            phi[1, j] = e[0, 0] * t1 + e[0, 1] * t2 + e[0, 2] * t3 + v2 * a3 - v3 * a2
            phi[2, j] = e[1, 0] * t1 + e[1, 1] * t2 + e[1, 2] * t3 + v3 * a1 - v1 * a3
            phi[3, j] = e[2, 0] * t1 + e[2, 1] * t2 + e[2, 2] * t3 + v1 * a2 - v2 * a1
        turn(q, x[base + 4], x[base + 5], x[base + 6], now)
        euler(now, angles)
        euler_jacobian(angles[0], angles[1], e)
        for j in range(base - B, n):
            t1, t2, t3 = phi[4, j], phi[5, j], phi[6, j]
            for i in range(3):
                phi[4 + i, j] = e[i, 0] * t1 + e[i, 1] * t2 + e[i, 2] * t3
    for j in range(B):
        phi[K + j, base - B + j] = 1.0
    for i in range(base - B):
        phi[K + B + i, i] = fade if model.fades[i] > 0.0 else 1.0


@compiled
def spread(ut: Array, d: Array, phi: Array, w: Array, std: Array) -> None:
    """Fill ``std`` (n,) with the roots of the diagonal of phi L^{-1} phi^T; ``w`` (n, n) is scratch."""
    sweeps.spread(ut, d, phi, w, std)


@compiled
def anchor(model: Model, carry: Carry, lu: Array, order: Order, x: Array) -> None:
    """Begin a window at the present epoch: V = phi^{-T} U, eta := 0, s := x, phi := I."""
    n = x.size
    base = n - K
    a, b, fade = carry.a, carry.b, carry.fade[0]
    v, weight, column, back = np.zeros((1 + n, n)), np.empty(n), np.empty((K, n)), np.empty((K, n))
    turned = np.empty((K, K))
    for i in range(K):
        for j in range(K):
            turned[i, j] = a[j, i]
    factor(turned, lu, order, EPS)
    for i in range(K):
        for j in range(n):
            column[i, j] = carry.ut[j, 1 + base + i]
    solve(lu, order, column, back)  # A^{-T} U_kinematic
    for i in range(K):
        for j in range(n):
            v[1 + base + i, j] = back[i, j]
    for i in range(B):
        for j in range(n):
            t = carry.ut[j, 1 + base - B + i]
            for c in range(K):
                t -= b[c, i] * back[c, j]
            v[1 + base - B + i, j] = t
    for i in range(base - B):
        scale = fade if model.fades[i] > 0.0 else 1.0
        for j in range(n):
            v[1 + i, j] = carry.ut[j, 1 + i] / scale
    weight[:] = carry.d
    mwgs(v, weight, carry.ut, carry.d)
    for j in range(n):
        carry.ut[j, 0] = 0.0
        carry.s[j] = x[j]
    a[:, :] = 0.0
    b[:, :] = 0.0
    for i in range(K):
        a[i, i] = 1.0
    carry.fade[0] = 1.0
    carry.clock[2] = 0.0


@compiled
def doubt(
    model: Model, carry: Carry, group: int, phi: Array, x: Array, scratch: Array, std: Array, work: Array
) -> None:
    """Note that the filter is to be doubted about a group of states: ten times its variance, from the next step on."""
    image(model, carry.q, x, carry.a, carry.b, carry.fade[0], False, phi, work)
    spread(carry.ut, carry.d, phi, scratch, std)
    for i in range(3):
        at = 1 + i if group == 0 else 4 + i
        if group == 2:
            for j in range(model.order.size - K - B):
                if model.order[j] == TURBULENCE + i:
                    at = K + B + j
        carry.doubt[group, i] = 9.0 * std[at] * std[at]


@compiled
def wrapped(angle: float) -> float:
    """The angle in [-pi, pi]."""
    turned: float = angle - 2.0 * np.pi * np.round(angle / (2.0 * np.pi))
    return turned


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
        for j in range(K):
            for c in range(K):
                t = 0.0
                for o in range(K):
                    t += phi7[j, o] * a[o, c]
                a_new[j, c] = t
            for c in range(B):
                t = b6[j, c]
                for o in range(K):
                    t += phi7[j, o] * b[o, c]
                b_new[j, c] = t
        a[:, :] = a_new
        b[:, :] = b_new
        carry.fade[0] *= fade
        factor(a, lu, order, EPS)
        solve(lu, order, b6, e6)
        if p > QUIETEST:
            solve(lu, order, b, walk)
        if keep:
            rows.a[i] = a
            rows.b[i] = b
            rows.fade[i] = carry.fade[0]
            rows.e[i] = e6
            if p > QUIETEST:
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
                if xm[1] < SLOW:
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
        state(ut, star)
        place(s, flat, a, b, carry.fade[0], model.fades, after)
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
            if lost[group]:
                told.doubted[i] |= 1 << group
                doubt(model, carry, group, full, after, scratch, std, work)
        if drive.shown[i]:
            image(model, q, after, a, b, carry.fade[0], True, full, work)
            spread(ut, d, full, scratch, told.std[i])
        carry.clock[2] += 1.0
        if carry.clock[2] >= window:
            anchor(model, carry, lu, order, after)
            if keep:
                rows.closed[i] = 1
    return -1


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
    full, u, image_u = np.empty((n, n)), np.empty((n, n)), np.empty((n, n))
    kin, moved, e33 = np.empty((K, n)), np.empty((K, n)), np.empty((3, 3))
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
                image(model, nominal, mean, unit_a, unit_b, 1.0, True, full, work)
            else:
                image(model, nominal, mean, rows.a[i - 1], rows.b[i - 1], rows.fade[i - 1], True, full, work)
            for row in range(n):
                for j in range(n):
                    u[row, j] = vt[j, row]
            np.dot(full, u, image_u)
            for row in range(n):
                variance = 0.0
                for j in range(n):
                    variance += image_u[row, j] * image_u[row, j] * d[j]
                std[i, row] = np.sqrt(variance)
        if i == 0:
            return
        at = i - 1
        if fresh:  # the state at the anchor, in the coordinates of the window before
            factor(rows.a[at], lu, order, EPS)
            unplace(mean, rows.s[at], lu, order, rows.b[at], rows.fade[at], model.fades, flat, pair)
            if factors:
                for row in range(n):
                    for j in range(n):
                        u[row, j] = vt[j, row]
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
                weight[:] = d
                mwgs(u, weight, vt, d)
        for c in range(p - 1, -1, -1):
            qs = rows.qs[at, c]
            if qs > 0.0:
                e[:] = 0.0
                if c < B:
                    for j in range(K):
                        e[base + j] = rows.e[at, j, c]
                else:
                    o = model.driven[c - 6]
                    e[o] = 1.0
                    if o >= tail:
                        for j in range(K):
                            e[base + j] = -rows.w[at, j, o - tail]
                    elif model.fades[o] > 0.0:
                        e[o] = 1.0 / rows.fade[at]
                miss = rows.g[at, c]
                for j in range(n):
                    miss -= rows.k[at, c, j] * flat[j]
                if c < B:
                    w[at, c] = -miss
                for j in range(n):
                    flat[j] += e[j] * miss
                if factors:
                    size = bierman(vt, d, rows.k[at, c], qs, k)
                    for j in range(n):
                        k[j] = e[j] - k[j] / size
                    agee_turner(vt, d, k, size)
            elif c < B:
                w[at, c] = 0.0


@compiled
def finish(carry: Carry, star: Array, vt: Array, d: Array, factors: bool) -> None:
    """Start the way back from a carry: x* (n, 1) and, with ``factors``, P* as ``vt`` (n, n), ``d`` (n,)."""
    if factors:
        terminal(carry.ut, carry.d, star, vt, d)
    else:
        state(carry.ut, star)


@compiled
def named(model: Model, x: Array, q: Array, rotated: bool, out: Array) -> None:
    """Fill ``out`` (k, n) with the named states in their own order, Euler angles in place of the rotation.

    ``x`` (k, n) in the order of the factor (``rotated``), or (k, 23) by number with rotation zero.
    """
    n = out.shape[1]
    base = n - K
    now, angles, e = np.empty(4), np.empty(3), np.empty((3, 3))
    for i in range(out.shape[0]):
        if rotated:
            turn(q[i], x[i, base + 4], x[i, base + 5], x[i, base + 6], now)
            exponential(-x[i, base + 4], -x[i, base + 5], -x[i, base + 6], e)
            out[i, 0] = x[i, base]
            for j in range(3):
                out[i, 1 + j] = e[j, 0] * x[i, base + 1] + e[j, 1] * x[i, base + 2] + e[j, 2] * x[i, base + 3]
            for j in range(B):
                out[i, K + j] = x[i, base - B + j]
            for j in range(base - B):
                out[i, K + B + j] = x[i, j]
        else:
            now[:] = q[i]
            for j in range(K + B):
                out[i, j] = x[i, j]
            for j in range(base - B):
                out[i, K + B + j] = x[i, model.order[j]]
        euler(now, angles)
        for j in range(3):
            out[i, 4 + j] = angles[j]
