"""Cubature points of a flight path, compiled: their images under a step, and the regressions that come of them.

A step and what the sensors see are linear in most states. The rule is applied to those in which they are not, k of n,
drawn from their marginal factor [1]_. Its points lie on the axes, sqrt(3) standard deviations out whatever k is, where
a rotation by one of them is still a rotation that may be; with the mean as one more point of weight 1 - k/3 it is exact
for polynomials of the third degree, and for fourth powers along the axes. For k = 3, the rotation, that weight is zero
and its points are those of the cubature rule; for more, the cubature rule's, at sqrt(k), overstate what a bend spreads:
(k - 1)/2 times in variance. With L the marginal factor and y0, y+, y- the images of m and of m +- sqrt(3) l_i::

    odd_i = (y+ - y-) / (2 sqrt 3)      bend_i = y+ + y- - 2 y0      mean = y0 + sum bend_i / 6
    A = odd L^{-1}                      even_i = sqrt(2)/6 bend_i

y = mean + A (z - m) + e: the regression on z, with the even parts as the factor of the covariance of e [2]_. No weight
in a covariance is negative, whatever k is, and nothing is subtracted from one.

References
----------
.. [1] P. Closas, C. Fernandez-Prades, "The marginalized square-root quadrature Kalman filter", IEEE SPAWC 2010.
.. [2] M. Norgaard, N. K. Poulsen, O. Ravn, "New developments in state estimation for nonlinear systems", Automatica 36
   (2000) 1627-1638.
"""

from __future__ import annotations

import numpy as np

from estimator import kinematics, rotation, ud
from estimator.cubature import reflections
from estimator.cubature.flight_structures import TURN, B, K
from estimator.cubature.reflections import NULL, reflect
from estimator.kinematics import Earth, rates
from estimator.rotation import difference, euler, exponential, matrix, turn, turn_earth
from estimator.ud import Array, Order, lean

ud.follow(__file__, kinematics.__file__, rotation.__file__, reflections.__file__)

EPS = 2.3e-16
FAR = np.sqrt(3.0)  # standard deviations from the mean to a point
BEND = np.sqrt(2.0) / 6.0


@lean
def image(
    core: Array, h: float, over: Array, q: Array, u: Array, dt: float, earth: Earth, q1: Array, r1: Array, y: Array,
    work: Array,
) -> None:  # fmt: skip
    """One midpoint step, `kinematics.step` without its derivatives, told about a given nominal attitude.

    Parameters
    ----------
    core (9,) : biases of accelerometers and gyros, and the rotation about ``q`` (4,)
    h, over (3,) : height, and velocity over ground, north, east and down, m/s
    u (6,) : specific force and angular rate
    q1 (4,), r1 (3, 3) : attitude about which the result is told
    y (7,) : height, velocity along the axes of q1, rotation about q1; written
    work (60,) : scratch
    """
    turned, now, mid = work[0:4], work[4:8], work[8:12]
    r, f, w = work[12:21].reshape(3, 3), work[21:24], work[24:27]
    v, vm, then, a = work[27:30], work[30:33], work[33:37], work[37:40]
    turn(q, core[6], core[7], core[8], turned)
    matrix(turned, r)
    for i in range(3):
        f[i], w[i] = u[i] - core[i], u[3 + i] - core[3 + i]
        v[i] = r[0, i] * over[0] + r[1, i] * over[1] + r[2, i] * over[2]
    rates(r, h, v, f, w, earth, now)
    i1 = -dt * (earth.rate_north + over[1] * earth.vertical)
    i2 = dt * over[0] * earth.meridian
    i3 = -dt * (earth.rate_down - over[1] * earth.tangent * earth.vertical)
    k = 0.5 * dt
    turn(turned, k * w[0], k * w[1], k * w[2], then)
    turn_earth(then, 0.5 * i1, 0.5 * i2, 0.5 * i3, then)
    matrix(then, r)
    for i in range(3):
        vm[i] = v[i] + k * now[1 + i]
    rates(r, h + k * now[0], vm, f, w, earth, mid)
    turn(turned, dt * w[0], dt * w[1], dt * w[2], then)
    turn_earth(then, i1, i2, i3, then)
    matrix(then, r)
    for i in range(3):
        v[i] += dt * mid[1 + i]
    for i in range(3):
        vm[i] = r[i, 0] * v[0] + r[i, 1] * v[1] + r[i, 2] * v[2]
    y[0] = h + dt * mid[0]
    difference(q1, then, a)
    for i in range(3):
        y[1 + i] = r1[0, i] * vm[0] + r1[1, i] * vm[1] + r1[2, i] * vm[2]
        y[4 + i] = a[i]


@lean
def compress(z: Array, count: int, k: int) -> None:
    """Make ``z[:count, :k]`` upper triangular: rows are deviations, and what is left is the transposed factor."""
    for j in range(k):
        reflect(z, j, z, j + 1, count, j, k)


@lean
def part(plus: Array, minus: Array, centre: Array, i: int, first: int, stop: int, odd: Array, even: Array) -> None:
    """Take the images of the ``i``-th pair of points into ``odd`` and ``even`` (k, >= stop).

    `settle` is to follow once all have been taken.
    """
    scale = 0.5 / FAR
    for c in range(first, stop):
        odd[i, c] = scale * (plus[c] - minus[c])
        even[i, c] = plus[c] + minus[c] - 2.0 * centre[c]


@lean
def settle(k: int, first: int, stop: int, centre: Array, mean: Array, even: Array) -> None:
    """Fill ``mean`` and bring ``even`` (k, >= stop) to its final form, once all pairs have been taken."""
    for c in range(first, stop):
        t = 0.0
        for i in range(k):
            t += even[i, c]
            even[i, c] *= BEND
        mean[c] = centre[c] + t / 6.0


@lean
def regress(z: Array, k: int, odd: Array, first: int, stop: int, slope: Array) -> None:
    """Fill ``slope`` (k, >= stop): row i is how the images change with the i-th state. A L = odd, ``z`` = L^T.

    A pivot that is rounding beside its row of L says nothing, and the slope by it is zero.
    """
    few = NULL * k * EPS
    for j in range(k - 1, -1, -1):
        norm = 0.0
        for i in range(j + 1):
            norm += z[i, j] * z[i, j]
        pivot = z[j, j]
        if pivot <= few * np.sqrt(norm):
            for c in range(first, stop):
                slope[j, c] = 0.0
            continue
        for c in range(first, stop):
            t = odd[j, c]
            for i in range(j + 1, k):
                t -= z[j, i] * slope[i, c]
            slope[j, c] = t / pivot


@lean
def core(root: Array, bias: int, z: Array) -> None:
    """Fill the first three rows of ``z`` (>= n, >= 9): how rotation and biases go with what the rotation is made of.

    The first three columns are the marginal factor of the rotation, transposed, and the others what is expected of the
    biases with it. ``bias`` is the place of the first bias.
    """
    n = root.shape[0]
    for i in range(n):
        row = root[n - 3 + i] if i < 3 else root[i - 3]  # those that are triangular first
        for j in range(3):
            z[i, j] = row[n - 3 + j]
        for j in range(6):
            z[i, 3 + j] = row[bias + j]
    for j in range(TURN):
        reflect(z, j, z, TURN, n, j, TURN + B)


@lean
def wrapped(angle: float) -> float:
    """The angle in [-pi, pi]."""
    turned: float = angle - 2.0 * np.pi * np.round(angle / (2.0 * np.pi))
    return turned


@lean
def told(q: Array, v: Array, a1: float, a2: float, a3: float, y: Array, work: Array) -> None:
    """Fill ``y`` (6,) with (u, v, w) and Euler angles at velocity ``v`` (3,) along nominal axes and a rotation."""
    now, e = work[0:4], work[4:13].reshape(3, 3)
    turn(q, a1, a2, a3, now)
    exponential(-a1, -a2, -a3, e)
    for i in range(3):
        y[i] = e[i, 0] * v[0] + e[i, 1] * v[1] + e[i, 2] * v[2]
    euler(now, y[3:6])


@lean
def deviations(
    named: Order, root: Array, x: Array, q: Array, std: Array, z: Array, plus: Array, minus: Array, centre: Array,
    work: Array,
) -> None:  # fmt: skip
    """Fill ``std`` (n,) with the deviations of the named states, ``x`` (>= 7,) by number about ``q``.

    Of (u, v, w) and the Euler angles by the points of velocity and rotation, about the values that are told.
    """
    n = std.size
    for j in range(n):
        at = named[j]
        t = 0.0
        for i in range(at + 1):
            t += root[i, at] * root[i, at]
        std[j] = np.sqrt(t)
    for i in range(n):
        row = n - 6 + i if i < 6 else i - 6  # those that are triangular first
        for j in range(6):
            z[i, j] = root[row, n - 6 + j]
    for j in range(6):
        reflect(z, j, z, 6, n, j, 6)
    v, point, shift = work[40:43], work[43:49], work[49:55]
    told(q, x[1:4], x[4], x[5], x[6], centre, work)
    for c in range(6):
        std[1 + c] = 0.0
        shift[c] = 0.0
    for i in range(6):
        for c in range(6):
            point[c] = x[1 + c] + FAR * z[i, c]
        for c in range(3):
            v[c] = point[c]
        told(q, v, point[3], point[4], point[5], plus, work)
        for c in range(6):
            point[c] = x[1 + c] - FAR * z[i, c]
        for c in range(3):
            v[c] = point[c]
        told(q, v, point[3], point[4], point[5], minus, work)
        for c in range(6):
            one, other = plus[c] - centre[c], minus[c] - centre[c]
            if c >= 3:
                one, other = wrapped(one), wrapped(other)
            odd, even = 0.5 * (one - other) / FAR, one + other
            std[1 + c] += odd * odd + (BEND * even) ** 2
            shift[c] += even / 6.0
    for c in range(6):
        std[1 + c] = np.sqrt(std[1 + c] + shift[c] * shift[c])


@lean
def straighten(order: Order, x: Array, q: Array, start: Array, out: Array, attitude: Array, work: Array) -> None:
    """Fill ``out`` (k, 23) by number and ``attitude`` (k, 4) with states ``x`` (k, n) about ``q``, rotation zero."""
    e = work[0:9].reshape(3, 3)
    n = order.size
    base = n - K
    for i in range(x.shape[0]):
        for j in range(start.size):
            out[i, j] = start[j]
        for j in range(n):
            out[i, order[j]] = x[i, j]
        a1, a2, a3 = x[i, base + 4], x[i, base + 5], x[i, base + 6]
        turn(q[i], a1, a2, a3, attitude[i])
        exponential(-a1, -a2, -a3, e)
        for j in range(3):
            out[i, 1 + j] = e[j, 0] * x[i, base + 1] + e[j, 1] * x[i, base + 2] + e[j, 2] * x[i, base + 3]
            out[i, 4 + j] = 0.0
