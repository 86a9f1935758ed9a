"""The kinematics of a flight path, compiled: one step driven by the inertial sensors, and what the other sensors see.

Nothing aerodynamic is in it: specific force and angular rate are measured, and everything else follows. All states
are those of the point where the inertial sensors stand, so no angular acceleration is needed anywhere::

    0      h            height, up, m                       13, 14  W_N, W_E       slow mean wind, m/s
    1-3    V            velocity, see below, m/s            15-17   T_N, T_E, T_D  turbulence, m/s
    4-6    a            small rotation about body axes,     18      kV             airspeed scale error
                        rad, from the nominal attitude q    19, 20  b_alpha, b_beta    vane offsets, rad
    7-9    ba           accelerometer bias, m/s2            21, 22  k_alpha, k_beta    vane slopes
    10-12  bg           gyro bias, rad/s

The equations, with R = R(q) exp([a]x), f = f_m - ba, omega = omega_m - bg, e = R^T om_ie, (vN, vE, vD) = R (u, v, w)::

    h' = -(R v)_D     v' = f + R^T (0, 0, g(h)) - (omega + e) x v     R' = R [omega - R^T (om_ie + om_en)]x

the transport rate om_en cancels in v'. Shi's eq. (16) is the case without Earth rate, Earth radius and wind.

The attitude is an error vector about a nominal quaternion, not Euler angles: a step and its Jacobian are regular at any
pitch. The velocity is kept along the nominal axes, V = exp([a]x) (u, v, w): R(q) V is the velocity over ground whatever
a is, so a satellite velocity says nothing about an attitude that no acceleration has shown. With (u, v, w) as the state
an uncertain heading at high speed makes a filter believe what it cannot know (V sigma^2 / 2 against the noise).
Nothing of second order is cured by it: a heading that no acceleration shows for minutes is lost all the same. Where
a state is known to be x with rotation a, the next step begins by moving a into q, and says so in its Jacobian.

References
----------
.. [1] Z. K. Shi, "A new algorithm of fixed-interval smoother and its application to flight test", Acta Automatica
   Sinica, 1991, eq. (16).
.. [2] P. D. Groves, "Principles of GNSS, Inertial, and Multisensor Integrated Navigation Systems", 2nd ed., Artech
   House, 2013, sections 2.4 and 5.4.
.. [3] F. L. Markley, "Attitude error representations for Kalman filtering", J. Guidance 26 (2003) 311-317.
.. [4] A. Barrau, S. Bonnabel, "The invariant extended Kalman filter as a stable observer", IEEE Trans. Automatic
   Control 62 (2017) 1797-1812.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from estimator import rotation, ud
from estimator.rotation import euler, euler_jacobian, exponential, matrix, right_jacobian, turn, turn_earth
from estimator.ud import Array, exact

ud.follow(__file__, rotation.__file__)

STATES = 23
KINEMATIC, DRIVEN = 7, 13  # h, v, a; and the biases that drive them
WIND, TURBULENCE, SCALE, OFFSETS, SLOPES = 13, 15, 18, 19, 21
MEASUREMENTS = (
    "airspeed",
    "alpha",
    "beta",
    "theta",
    "phi",
    "psi",
    "height",
    "velocity_north",
    "velocity_east",
    "velocity_down",
)
M = len(MEASUREMENTS)
AIR, ATTITUDE, HEIGHT, VELOCITY = 0, 3, 6, 7

EARTH_RATE = 7.292115e-5
SEMI_MAJOR, FLATTENING = 6378137.0, 1.0 / 298.257223563
STEEP = 1.4  # rad of pitch, 80 deg: beyond it Euler angles are no measurement
SLOW = 5.0  # m/s forward: below it vanes and pitot tube say nothing


class Earth(NamedTuple):
    """What the Earth does to a flight path, constant over a stretch of flight.

    Attributes
    ----------
    g0, gh : float
        Gravity g = g0 + gh h: m/s2 and 1/s2.
    rate_north, rate_down : float
        Of the Earth's rotation, rad/s.
    meridian, vertical : float
        1 / (radius + h) along the meridian and in the prime vertical, 1/m.
    tangent : float
        Of the latitude.
    """

    g0: float
    gh: float
    rate_north: float
    rate_down: float
    meridian: float
    vertical: float
    tangent: float

    @classmethod
    def at(cls, latitude: float, height: float) -> Earth:
        """WGS-84 at a latitude (rad) and height (m)."""
        e2 = FLATTENING * (2.0 - FLATTENING)
        s = np.sin(latitude)
        g0 = 9.7803253359 * (1.0 + 0.00193185265241 * s * s) / np.sqrt(1.0 - e2 * s * s)
        gh = -(2.0 / SEMI_MAJOR) * (1.0 + FLATTENING + 0.00344979 - 2.0 * FLATTENING * s * s) * g0
        meridian = SEMI_MAJOR * (1.0 - e2) / (1.0 - e2 * s * s) ** 1.5
        vertical = SEMI_MAJOR / np.sqrt(1.0 - e2 * s * s)
        return cls(
            float(g0), float(gh), float(EARTH_RATE * np.cos(latitude)), float(-EARTH_RATE * s),
            float(1.0 / (meridian + height)), float(1.0 / (vertical + height)), float(np.tan(latitude)),
        )  # fmt: skip

    @classmethod
    def flat(cls, gravity: float) -> Earth:
        """A plane that does not turn, with constant gravity (m/s2)."""
        return cls(gravity, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


@exact
def cross_matrix(c1: float, c2: float, c3: float, m: Array) -> None:
    """Fill ``m`` (3, 3) with [c]x: m b = c x b."""
    m[0, 0], m[0, 1], m[0, 2] = 0.0, -c3, c2
    m[1, 0], m[1, 1], m[1, 2] = c3, 0.0, -c1
    m[2, 0], m[2, 1], m[2, 2] = -c2, c1, 0.0


@exact
def rates(r: Array, h: float, v: Array, f: Array, w: Array, earth: Earth, out: Array) -> None:
    """Fill ``out`` (4,) with h', v' at attitude ``r``; ``f``, ``w`` (3,) specific force and rate without bias."""
    g = earth.g0 + earth.gh * h
    a1 = w[0] + r[0, 0] * earth.rate_north + r[2, 0] * earth.rate_down
    a2 = w[1] + r[0, 1] * earth.rate_north + r[2, 1] * earth.rate_down
    a3 = w[2] + r[0, 2] * earth.rate_north + r[2, 2] * earth.rate_down
    out[0] = -(r[2, 0] * v[0] + r[2, 1] * v[1] + r[2, 2] * v[2])
    out[1] = f[0] + r[2, 0] * g - (a2 * v[2] - a3 * v[1])
    out[2] = f[1] + r[2, 1] * g - (a3 * v[0] - a1 * v[2])
    out[3] = f[2] + r[2, 2] * g - (a1 * v[1] - a2 * v[0])


@exact
def slopes(r: Array, h: float, v: Array, w: Array, earth: Earth, a: Array) -> None:
    """Fill ``a`` (4, 7) with d(h', v')/d(h, v, a); d v'/d ba = -I and d v'/d bg = -[v]x beside it."""
    g = earth.g0 + earth.gh * h
    e1 = r[0, 0] * earth.rate_north + r[2, 0] * earth.rate_down
    e2 = r[0, 1] * earth.rate_north + r[2, 1] * earth.rate_down
    e3 = r[0, 2] * earth.rate_north + r[2, 2] * earth.rate_down
    v1, v2, v3 = v[0], v[1], v[2]
    d1, d2, d3 = r[2, 0], r[2, 1], r[2, 2]
    a[0, 0] = 0.0
    a[0, 1], a[0, 2], a[0, 3] = -d1, -d2, -d3
    a[0, 4], a[0, 5], a[0, 6] = d2 * v3 - d3 * v2, d3 * v1 - d1 * v3, d1 * v2 - d2 * v1
    a[1, 0], a[2, 0], a[3, 0] = earth.gh * d1, earth.gh * d2, earth.gh * d3
    a1, a2, a3 = w[0] + e1, w[1] + e2, w[2] + e3
    a[1, 1], a[1, 2], a[1, 3] = 0.0, a3, -a2
    a[2, 1], a[2, 2], a[2, 3] = -a3, 0.0, a1
    a[3, 1], a[3, 2], a[3, 3] = a2, -a1, 0.0
    # [R^T (0, 0, g)]x + [v]x [e]x, and [v]x [e]x = e v^T - (v . e) I
    dot = v1 * e1 + v2 * e2 + v3 * e3
    a[1, 4], a[1, 5], a[1, 6] = e1 * v1 - dot, e1 * v2 - g * d3, e1 * v3 + g * d2
    a[2, 4], a[2, 5], a[2, 6] = e2 * v1 + g * d3, e2 * v2 - dot, e2 * v3 - g * d1
    a[3, 4], a[3, 5], a[3, 6] = e3 * v1 - g * d2, e3 * v2 + g * d1, e3 * v3 - dot


@exact
def step(
    x: Array, q: Array, u: Array, dt: float, earth: Earth, x1: Array, q1: Array, phi: Array, b: Array, work: Array
) -> None:
    """One midpoint step from state ``x`` (>= 13,), whose rotation is about ``q`` (4,), driven by ``u`` (6,).

    Fills ``x1`` (>= 13,) with the next state, its rotation zero about the next nominal attitude ``q1`` (4,); ``phi``
    (7, 7) and ``b`` (7, 6) with the Jacobian of the step by (h, V, a) and by the biases, which is also that by the
    errors of ``u``; exact but for the transport rate, whose derivatives (dt / Earth radius) are left
    out. ``work`` (200,) is scratch. What is beyond the biases is left alone.
    """
    r, rm = work[0:9].reshape(3, 3), work[9:18].reshape(3, 3)
    f, w, now, mid = work[18:21], work[21:24], work[24:28], work[28:32]
    vm, turned = work[32:35], work[35:39]
    s1, s2 = work[39:67].reshape(4, 7), work[67:95].reshape(4, 7)
    half, jh = work[95:104].reshape(3, 3), work[104:113].reshape(3, 3)
    whole, jw = work[113:122].reshape(3, 3), work[122:131].reshape(3, 3)
    chart, line = work[131:140].reshape(3, 3), work[140:147]
    back, v = work[147:156].reshape(3, 3), work[156:159]
    turn(q, x[4], x[5], x[6], turned)
    right_jacobian(x[4], x[5], x[6], chart)
    exponential(-x[4], -x[5], -x[6], back)
    for i in range(3):
        f[i], w[i] = u[i] - x[7 + i], u[3 + i] - x[10 + i]
        v[i] = back[i, 0] * x[1] + back[i, 1] * x[2] + back[i, 2] * x[3]
    matrix(turned, r)
    rates(r, x[0], v, f, w, earth, now)
    slopes(r, x[0], v, w, earth, s1)
    north = r[0, 0] * v[0] + r[0, 1] * v[1] + r[0, 2] * v[2]
    east = r[1, 0] * v[0] + r[1, 1] * v[1] + r[1, 2] * v[2]
    i1 = -dt * (earth.rate_north + east * earth.vertical)
    i2 = dt * north * earth.meridian
    i3 = -dt * (earth.rate_down - east * earth.tangent * earth.vertical)
    k = 0.5 * dt
    turn(turned, k * w[0], k * w[1], k * w[2], q1)
    turn_earth(q1, 0.5 * i1, 0.5 * i2, 0.5 * i3, q1)
    matrix(q1, rm)
    hm = x[0] + k * now[0]
    for i in range(3):
        vm[i] = v[i] + k * now[1 + i]
    rates(rm, hm, vm, f, w, earth, mid)
    slopes(rm, hm, vm, w, earth, s2)
    x1[0] = x[0] + dt * mid[0]
    for i in range(3):
        x1[1 + i] = v[i] + dt * mid[1 + i]
        x1[4 + i] = 0.0
        x1[7 + i], x1[10 + i] = x[7 + i], x[10 + i]
    turn(turned, dt * w[0], dt * w[1], dt * w[2], q1)
    turn_earth(q1, i1, i2, i3, q1)
    exponential(-k * w[0], -k * w[1], -k * w[2], half)
    exponential(-dt * w[0], -dt * w[1], -dt * w[2], whole)
    right_jacobian(k * w[0], k * w[1], k * w[2], jh)
    right_jacobian(dt * w[0], dt * w[1], dt * w[2], jw)
    for i in range(4):  # rows of h and v: dt S2 (I + dt/2 S1), the rotation by its own half step
        for j in range(4):
            t = s2[i, j]
            for c in range(4):
                t += k * s2[i, c] * s1[c, j]
            phi[i, j] = dt * t
        for j in range(3):
            t = 0.0
            for c in range(4):
                t += k * s2[i, c] * s1[c, 4 + j]
            for c in range(3):
                t += s2[i, 4 + c] * half[c, j]
            line[j] = dt * t
        phi[i, i] += 1.0
        a1, a2, a3 = phi[i, 1], phi[i, 2], phi[i, 3]  # (u, v, w) = V + V x a: row . [V]x = row x V
        line[0] += a2 * v[2] - a3 * v[1]
        line[1] += a3 * v[0] - a1 * v[2]
        line[2] += a1 * v[1] - a2 * v[0]
        for j in range(3):
            phi[i, 1 + j] = a1 * back[0, j] + a2 * back[1, j] + a3 * back[2, j]
            phi[i, 4 + j] = line[0] * chart[0, j] + line[1] * chart[1, j] + line[2] * chart[2, j]
        for j in range(3):
            b[i, j] = -dt * k * s2[i, 1 + j]
            t = 0.0
            for c in range(3):
                t += s2[i, 4 + c] * jh[c, j]
            b[i, 3 + j] = -dt * k * t
        # - k S2_v [v]x: row times cross matrix is row x v
        a1, a2, a3 = s2[i, 1], s2[i, 2], s2[i, 3]
        b[i, 3] -= dt * k * (a2 * v[2] - a3 * v[1])
        b[i, 4] -= dt * k * (a3 * v[0] - a1 * v[2])
        b[i, 5] -= dt * k * (a1 * v[1] - a2 * v[0])
    for j in range(3):
        b[1 + j, j] -= dt
    b[1, 4] += dt * vm[2]
    b[1, 5] -= dt * vm[1]
    b[2, 3] -= dt * vm[2]
    b[2, 5] += dt * vm[0]
    b[3, 3] += dt * vm[1]
    b[3, 4] -= dt * vm[0]
    for i in range(3):
        for j in range(4):
            phi[4 + i, j] = 0.0
        for j in range(3):
            phi[4 + i, 4 + j] = whole[i, 0] * chart[0, j] + whole[i, 1] * chart[1, j] + whole[i, 2] * chart[2, j]
            b[4 + i, j] = 0.0
            b[4 + i, 3 + j] = -dt * jw[i, j]
    v1, v2, v3 = x1[1], x1[2], x1[3]  # V = (u, v, w) + a x (u, v, w)
    for j in range(4, 7):
        t1, t2, t3 = phi[4, j], phi[5, j], phi[6, j]
        phi[1, j] += t2 * v3 - t3 * v2
        phi[2, j] += t3 * v1 - t1 * v3
        phi[3, j] += t1 * v2 - t2 * v1
    for j in range(3, 6):
        t1, t2, t3 = b[4, j], b[5, j], b[6, j]
        b[1, j] += t2 * v3 - t3 * v2
        b[2, j] += t3 * v1 - t1 * v3
        b[3, j] += t1 * v2 - t2 * v1


@exact
def flow(v1: float, v2: float, v3: float, y: Array, g: Array) -> None:
    """Airspeed, alpha and beta ``y`` (3,) of a flow vector in body axes, and their gradients ``g`` (3, 3)."""
    plane = v1 * v1 + v3 * v3
    speed = np.sqrt(plane + v2 * v2)
    s = np.sqrt(plane)
    y[0], y[1], y[2] = speed, np.arctan2(v3, v1), np.arctan2(v2, s)
    g[0, 0], g[0, 1], g[0, 2] = v1 / speed, v2 / speed, v3 / speed
    g[1, 0], g[1, 1], g[1, 2] = -v3 / plane, 0.0, v1 / plane
    square = speed * speed
    g[2, 0], g[2, 1], g[2, 2] = -v1 * v2 / (s * square), s / square, -v3 * v2 / (s * square)


@exact
def observe_air(x: Array, r: Array, w: Array, vane: Array, y: Array, h: Array, work: Array) -> None:
    """Airspeed, alpha and beta at the vanes: fills ``y`` (3,) and ``h`` (3, 23).

    The scale errors multiply the flow without turbulence: gusts shrink under a scale factor that multiplies them, and
    an estimate would make use of it. ``x`` (23,) with rotation zero, ``r`` (3, 3), ``w`` (3,) the angular rate.
    """
    g, gr = work[0:9].reshape(3, 3), work[9:18].reshape(3, 3)
    yr = work[18:21]
    h[:, :] = 0.0
    c1 = x[1] + w[1] * vane[2] - w[2] * vane[1]
    c2 = x[2] + w[2] * vane[0] - w[0] * vane[2]
    c3 = x[3] + w[0] * vane[1] - w[1] * vane[0]
    wn, we = x[WIND], x[WIND + 1]
    s1, s2, s3 = r[0, 0] * wn + r[1, 0] * we, r[0, 1] * wn + r[1, 1] * we, r[0, 2] * wn + r[1, 2] * we
    tn, te, td = x[TURBULENCE], x[TURBULENCE + 1], x[TURBULENCE + 2]
    t1 = r[0, 0] * tn + r[1, 0] * te + r[2, 0] * td
    t2 = r[0, 1] * tn + r[1, 1] * te + r[2, 1] * td
    t3 = r[0, 2] * tn + r[1, 2] * te + r[2, 2] * td
    flow(c1 - s1, c2 - s2, c3 - s3, yr, gr)
    flow(c1 - s1 - t1, c2 - s2 - t2, c3 - s3 - t3, y, g)
    for i in range(3):
        k = x[SCALE] if i == 0 else x[SLOPES + i - 1]
        h[i, SCALE if i == 0 else SLOPES + i - 1] = yr[i]
        y[i] += k * yr[i]
        if i > 0:
            y[i] += x[OFFSETS + i - 1]
            h[i, OFFSETS + i - 1] = 1.0
        b1, b2, b3 = g[i, 0] + k * gr[i, 0], g[i, 1] + k * gr[i, 1], g[i, 2] + k * gr[i, 2]
        h[i, 1], h[i, 2], h[i, 3] = b1, b2, b3
        # by the rotation: d(R^T c)/da = [R^T c]x, and row . [c]x = row x c
        v1, v2, v3 = x[1] - s1, x[2] - s2, x[3] - s3
        h[i, 4] = b2 * v3 - b3 * v2 - (g[i, 1] * t3 - g[i, 2] * t2)
        h[i, 5] = b3 * v1 - b1 * v3 - (g[i, 2] * t1 - g[i, 0] * t3)
        h[i, 6] = b1 * v2 - b2 * v1 - (g[i, 0] * t2 - g[i, 1] * t1)
        h[i, 10] = b2 * vane[2] - b3 * vane[1]
        h[i, 11] = b3 * vane[0] - b1 * vane[2]
        h[i, 12] = b1 * vane[1] - b2 * vane[0]
        for j in range(2):
            h[i, WIND + j] = -(r[j, 0] * b1 + r[j, 1] * b2 + r[j, 2] * b3)
        for j in range(3):
            h[i, TURBULENCE + j] = -(r[j, 0] * g[i, 0] + r[j, 1] * g[i, 1] + r[j, 2] * g[i, 2])


@exact
def deafen(x: Array, r: Array, h: Array) -> None:
    """Take from the rows of alpha and beta, ``h`` (3, 23) as `observe_air` leaves them, what they tell of the airspeed.

    How steep the flow is beside a climb of the aircraft tells the airspeed, through the wind along the flow. An
    aircraft that yields to gusts makes it tell it wrong: at 60 m/s in gusts of 2 m/s the airspeed scale came out wrong
    by 4.5 of its sigmas. So the two angles are not asked: their derivatives by wind and turbulence along the horizontal
    flow are zero. ``x`` (23,) with rotation zero, ``r`` (3, 3).
    """
    n1 = r[0, 0] * x[1] + r[0, 1] * x[2] + r[0, 2] * x[3] - x[WIND]
    n2 = r[1, 0] * x[1] + r[1, 1] * x[2] + r[1, 2] * x[3] - x[WIND + 1]
    square = n1 * n1 + n2 * n2
    if square > 1.0:
        for i in range(1, 3):
            for o in (WIND, TURBULENCE):
                along = (h[i, o] * n1 + h[i, o + 1] * n2) / square
                h[i, o] -= along * n1
                h[i, o + 1] -= along * n2


@exact
def observe_attitude(q: Array, y: Array, h: Array, work: Array) -> None:
    """Theta, phi, psi of the nominal attitude: fills ``y`` (3,) and ``h`` (3, 23)."""
    e = work[0:9].reshape(3, 3)
    euler(q, y)
    euler_jacobian(y[0], y[1], e)
    h[:, :] = 0.0
    for i in range(3):
        for j in range(3):
            h[i, 4 + j] = e[i, j]


@exact
def observe_velocity(x: Array, r: Array, w: Array, antenna: Array, y: Array, h: Array) -> None:
    """North, east and down velocity of the antenna: fills ``y`` (3,) and ``h`` (3, 23)."""
    c1 = w[1] * antenna[2] - w[2] * antenna[1]
    c2 = w[2] * antenna[0] - w[0] * antenna[2]
    c3 = w[0] * antenna[1] - w[1] * antenna[0]
    h[:, :] = 0.0
    for i in range(3):
        r1, r2, r3 = r[i, 0], r[i, 1], r[i, 2]
        y[i] = r1 * (x[1] + c1) + r2 * (x[2] + c2) + r3 * (x[3] + c3)
        h[i, 1], h[i, 2], h[i, 3] = r1, r2, r3
        h[i, 4], h[i, 5], h[i, 6] = -(r2 * c3 - r3 * c2), -(r3 * c1 - r1 * c3), -(r1 * c2 - r2 * c1)
        h[i, 10] = r2 * antenna[2] - r3 * antenna[1]
        h[i, 11] = r3 * antenna[0] - r1 * antenna[2]
        h[i, 12] = r1 * antenna[1] - r2 * antenna[0]
