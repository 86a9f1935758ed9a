"""The blocks of phi_{j,0}: kinematics, the biases that drive them, and a diagonal; what is made with them, compiled.

phi = [[diagonal, 0, 0], [0, I, 0], [0, b, a]] in the order of the factor, tail, biases, kinematics; a is 7 x 7, b is
7 x 6.
"""

from __future__ import annotations

import numpy as np

from estimator import rotation, sweeps, ud
from estimator.extended.structures import B, Carry, K, Model
from estimator.kinematics import TURBULENCE
from estimator.rotation import euler, euler_jacobian, exponential, turn
from estimator.sweeps import spread
from estimator.ud import Array, Order, exact, factor, mwgs, part, solve

ud.follow(__file__, rotation.__file__, sweeps.__file__)

EPS = 2.3e-16


@exact
def follow_on(phi: Array, b6: Array, a: Array, b: Array, a_new: Array, b_new: Array) -> None:
    """Fill ``a_new`` with phi a and ``b_new`` with phi b + b6: no rotation depends on height or velocity, nor on ba."""
    for i in range(4):
        for j in range(4):
            t = 0.0
            for c in range(4):
                t += phi[i, c] * a[c, j]
            a_new[i, j] = t
        for j in range(4, K):
            t = 0.0
            for c in range(K):
                t += phi[i, c] * a[c, j]
            a_new[i, j] = t
        for j in range(B):
            t = b6[i, j]
            for c in range(K):
                t += phi[i, c] * b[c, j]
            b_new[i, j] = t
    for i in range(4, K):
        for j in range(4):
            a_new[i, j] = 0.0
        for j in range(4, K):
            a_new[i, j] = phi[i, 4] * a[4, j] + phi[i, 5] * a[5, j] + phi[i, 6] * a[6, j]
        for j in range(3):
            b_new[i, j] = 0.0
        for j in range(3, B):
            b_new[i, j] = b6[i, j] + phi[i, 4] * b[4, j] + phi[i, 5] * b[5, j] + phi[i, 6] * b[6, j]


@exact
def divide(a: Array, right: Array, out: Array, work: Array) -> None:
    """Fill ``out`` (7, 6) with a^{-1} right, by the blocks a = [[f, g], [0, w]] of 4 and 3 rows.

    Both inverses are by cofactors: f and w are close to rotations, their determinants to 1. ``work`` (40,) is scratch.
    """
    f, w = work[0:16].reshape(4, 4), work[16:25].reshape(3, 3)
    s0, s1 = a[0, 0] * a[1, 1] - a[1, 0] * a[0, 1], a[0, 0] * a[1, 2] - a[1, 0] * a[0, 2]
    s2, s3 = a[0, 0] * a[1, 3] - a[1, 0] * a[0, 3], a[0, 1] * a[1, 2] - a[1, 1] * a[0, 2]
    s4, s5 = a[0, 1] * a[1, 3] - a[1, 1] * a[0, 3], a[0, 2] * a[1, 3] - a[1, 2] * a[0, 3]
    c5, c4 = a[2, 2] * a[3, 3] - a[3, 2] * a[2, 3], a[2, 1] * a[3, 3] - a[3, 1] * a[2, 3]
    c3, c2 = a[2, 1] * a[3, 2] - a[3, 1] * a[2, 2], a[2, 0] * a[3, 3] - a[3, 0] * a[2, 3]
    c1, c0 = a[2, 0] * a[3, 2] - a[3, 0] * a[2, 2], a[2, 0] * a[3, 1] - a[3, 0] * a[2, 1]
    t = 1.0 / (s0 * c5 - s1 * c4 + s2 * c3 + s3 * c2 - s4 * c1 + s5 * c0)
    f[0, 0] = t * (a[1, 1] * c5 - a[1, 2] * c4 + a[1, 3] * c3)
    f[0, 1] = t * (-a[0, 1] * c5 + a[0, 2] * c4 - a[0, 3] * c3)
    f[0, 2] = t * (a[3, 1] * s5 - a[3, 2] * s4 + a[3, 3] * s3)
    f[0, 3] = t * (-a[2, 1] * s5 + a[2, 2] * s4 - a[2, 3] * s3)
    f[1, 0] = t * (-a[1, 0] * c5 + a[1, 2] * c2 - a[1, 3] * c1)
    f[1, 1] = t * (a[0, 0] * c5 - a[0, 2] * c2 + a[0, 3] * c1)
    f[1, 2] = t * (-a[3, 0] * s5 + a[3, 2] * s2 - a[3, 3] * s1)
    f[1, 3] = t * (a[2, 0] * s5 - a[2, 2] * s2 + a[2, 3] * s1)
    f[2, 0] = t * (a[1, 0] * c4 - a[1, 1] * c2 + a[1, 3] * c0)
    f[2, 1] = t * (-a[0, 0] * c4 + a[0, 1] * c2 - a[0, 3] * c0)
    f[2, 2] = t * (a[3, 0] * s4 - a[3, 1] * s2 + a[3, 3] * s0)
    f[2, 3] = t * (-a[2, 0] * s4 + a[2, 1] * s2 - a[2, 3] * s0)
    f[3, 0] = t * (-a[1, 0] * c3 + a[1, 1] * c1 - a[1, 2] * c0)
    f[3, 1] = t * (a[0, 0] * c3 - a[0, 1] * c1 + a[0, 2] * c0)
    f[3, 2] = t * (-a[3, 0] * s3 + a[3, 1] * s1 - a[3, 2] * s0)
    f[3, 3] = t * (a[2, 0] * s3 - a[2, 1] * s1 + a[2, 2] * s0)
    w[0, 0] = a[5, 5] * a[6, 6] - a[5, 6] * a[6, 5]
    w[1, 0] = a[5, 6] * a[6, 4] - a[5, 4] * a[6, 6]
    w[2, 0] = a[5, 4] * a[6, 5] - a[5, 5] * a[6, 4]
    t = 1.0 / (a[4, 4] * w[0, 0] + a[4, 5] * w[1, 0] + a[4, 6] * w[2, 0])
    for i in range(3):
        w[i, 0] *= t
    w[0, 1] = t * (a[4, 6] * a[6, 5] - a[4, 5] * a[6, 6])
    w[0, 2] = t * (a[4, 5] * a[5, 6] - a[4, 6] * a[5, 5])
    w[1, 1] = t * (a[4, 4] * a[6, 6] - a[4, 6] * a[6, 4])
    w[1, 2] = t * (a[4, 6] * a[5, 4] - a[4, 4] * a[5, 6])
    w[2, 1] = t * (a[4, 5] * a[6, 4] - a[4, 4] * a[6, 5])
    w[2, 2] = t * (a[4, 4] * a[5, 5] - a[4, 5] * a[5, 4])
    for j in range(B):
        r4, r5, r6 = right[4, j], right[5, j], right[6, j]
        t4 = w[0, 0] * r4 + w[0, 1] * r5 + w[0, 2] * r6
        t5 = w[1, 0] * r4 + w[1, 1] * r5 + w[1, 2] * r6
        t6 = w[2, 0] * r4 + w[2, 1] * r5 + w[2, 2] * r6
        r0 = right[0, j] - a[0, 4] * t4 - a[0, 5] * t5 - a[0, 6] * t6
        r1 = right[1, j] - a[1, 4] * t4 - a[1, 5] * t5 - a[1, 6] * t6
        r2 = right[2, j] - a[2, 4] * t4 - a[2, 5] * t5 - a[2, 6] * t6
        r3 = right[3, j] - a[3, 4] * t4 - a[3, 5] * t5 - a[3, 6] * t6
        for i in range(4):
            out[i, j] = f[i, 0] * r0 + f[i, 1] * r1 + f[i, 2] * r2 + f[i, 3] * r3
        out[4, j], out[5, j], out[6, j] = t4, t5, t6


@part
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


@part
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


@exact
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


@exact
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


@part
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


@exact
def seen(q: Array, x: Array, a: Array, b: Array, rows: Array, w: Array) -> None:
    """Fill ``rows`` (7, 13): h, (u, v, w) and Euler angles at the estimate ``x`` (n,) about ``q``, by the biases and
    the kinematic states at the anchor. ``w`` (200,) is scratch.
    """
    base = x.size - K
    e, angles, now = w[0:9].reshape(3, 3), w[9:12], w[12:16]
    for i in range(K):
        one = rows[i]
        for j in range(B):
            one[j] = b[i, j]
        for j in range(K):
            one[B + j] = a[i, j]
    turn(q, x[base + 4], x[base + 5], x[base + 6], now)
    exponential(-x[base + 4], -x[base + 5], -x[base + 6], e)  # (u, v, w) = exp(-[a]x) V
    v1 = e[0, 0] * x[base + 1] + e[0, 1] * x[base + 2] + e[0, 2] * x[base + 3]
    v2 = e[1, 0] * x[base + 1] + e[1, 1] * x[base + 2] + e[1, 2] * x[base + 3]
    v3 = e[2, 0] * x[base + 1] + e[2, 1] * x[base + 2] + e[2, 2] * x[base + 3]
    one, two, three, four, five, six = rows[1], rows[2], rows[3], rows[4], rows[5], rows[6]
    for j in range(B + K):
        t1, t2, t3, a1, a2, a3 = one[j], two[j], three[j], four[j], five[j], six[j]
        one[j] = e[0, 0] * t1 + e[0, 1] * t2 + e[0, 2] * t3 + v2 * a3 - v3 * a2
        two[j] = e[1, 0] * t1 + e[1, 1] * t2 + e[1, 2] * t3 + v3 * a1 - v1 * a3
        three[j] = e[2, 0] * t1 + e[2, 1] * t2 + e[2, 2] * t3 + v1 * a2 - v2 * a1
    euler(now, angles)
    euler_jacobian(angles[0], angles[1], e)
    for j in range(B + K):
        t1, t2, t3 = four[j], five[j], six[j]
        four[j] = e[0, 0] * t1 + e[0, 1] * t2 + e[0, 2] * t3
        five[j] = e[1, 0] * t1 + e[1, 1] * t2 + e[1, 2] * t3
        six[j] = e[2, 0] * t1 + e[2, 1] * t2 + e[2, 2] * t3


@exact
def deviations(
    model: Model,
    ut: Array,
    d: Array,
    q: Array,
    x: Array,
    a: Array,
    b: Array,
    fade: float,
    std: Array,
    w: Array,
    rows: Array,
    part: Array,
    work: Array,
) -> None:
    """Fill ``std`` (n,) with the deviations of the named states, P* = U^{-T} D^{-1} U^{-1}, by the blocks of phi.

    Scratch: ``w`` (n, n), zero above its diagonal and left so, ``rows`` (7, 13), ``part`` (7, n), ``work`` (200,).
    """
    n = x.size
    base, tail = n - K, n - K - B
    for j in range(n):  # rows of U^{-T}
        own, u = w[j], ut[j]
        for k in range(j):
            own[k] = 0.0
        own[j] = 1.0
        for i in range(0, j - 1, 2):
            t, s, one, two = u[1 + i], u[2 + i], w[i], w[i + 1]
            for k in range(i + 2):
                own[k] -= t * one[k] + s * two[k]
        if j % 2 == 1:
            t, one = u[j], w[j - 1]
            for k in range(j):
                own[k] -= t * one[k]
    light = work[160 : 160 + n]
    for i in range(n):
        light[i] = 1.0 / d[i]
    for i in range(base):
        own = w[i]
        t = 0.0
        for k in range(i + 1):
            t += own[k] * own[k] * light[k]
        if i >= tail:
            std[K + i - tail] = np.sqrt(t)
        else:
            std[K + B + i] = np.sqrt(t) * (fade if model.fades[i] > 0.0 else 1.0)
    seen(q, x, a, b, rows, work)
    np.dot(rows, w[tail:], part)
    for i in range(K):
        one = part[i]
        t = 0.0
        for k in range(n):
            t += one[k] * one[k] * light[k]
        std[i] = np.sqrt(t)


@exact
def image(model: Model, a: Array, b: Array, fade: float, phi: Array) -> None:
    """Fill ``phi`` (n, n): phi_{j,0}, its rows in the order of the named states, its columns in that of the factor."""
    n = phi.shape[0]
    base = n - K
    phi[:, :] = 0.0
    for i in range(K):
        for j in range(K):
            phi[i, base + j] = a[i, j]
        for j in range(B):
            phi[i, base - B + j] = b[i, j]
    for j in range(B):
        phi[K + j, base - B + j] = 1.0
    for i in range(base - B):
        phi[K + B + i, i] = fade if model.fades[i] > 0.0 else 1.0


@exact
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


@exact
def doubt(model: Model, carry: Carry, group: int, phi: Array, scratch: Array, std: Array) -> None:
    """Note that the filter is to be doubted about a group of states: ten times its variance, from the next step on."""
    image(model, carry.a, carry.b, carry.fade[0], phi)
    spread(carry.ut, carry.d, phi, scratch, std)
    for i in range(3):
        at = 1 + i if group == 0 else 4 + i
        if group == 2:
            for j in range(model.order.size - K - B):
                if model.order[j] == TURBULENCE + i:
                    at = K + B + j
        carry.doubt[group, i] = 9.0 * std[at] * std[at]


@exact
def wrapped(angle: float) -> float:
    """The angle in [-pi, pi]."""
    turned: float = angle - 2.0 * np.pi * np.round(angle / (2.0 * np.pi))
    return turned


@exact
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
