"""What the sensors see of a flight path, compiled: regressions by cubature points in place of derivatives.

The velocity over ground is linear in the velocity along nominal axes, the height is itself. The attitude, and what a
lever arm adds to a velocity, are functions of the rotation alone: three dimensions. The air data are functions of the
flow without gusts, the gusts, both along nominal axes, the rotation, and the scale errors that multiply them: nine, ten
or twelve dimensions, whatever states they are made of. Rates at a lever arm change with the gyro biases by so little
that they are taken to do so linearly.
"""

from __future__ import annotations

import numpy as np

from estimator import kinematics, rotation, ud
from estimator.cubature import flight_points, reflections
from estimator.cubature.flight_points import FAR, compress, part, regress, settle, wrapped
from estimator.cubature.flight_structures import Desk, Layout
from estimator.cubature.reflections import reflect
from estimator.kinematics import (
    ATTITUDE,
    HEIGHT,
    OFFSETS,
    SCALE,
    SLOPES,
    SLOW,
    STEEP,
    TURBULENCE,
    VELOCITY,
    WIND,
    cross_matrix,
    deafen,
)  # fmt: skip
from estimator.rotation import euler, exponential, matrix, turn
from estimator.ud import Array, lean

ud.follow(__file__, kinematics.__file__, rotation.__file__, reflections.__file__, flight_points.__file__)


@lean
def lever(x: Array, omega: Array, arm: Array, out: Array, by: Array, work: Array) -> None:
    """What an arm adds to a velocity: ``out`` (3,) along body axes; ``by`` (3, 3), by bg, along nominal axes."""
    e, c = work[0:9].reshape(3, 3), work[9:18].reshape(3, 3)
    out[0] = omega[1] * arm[2] - omega[2] * arm[1]
    out[1] = omega[2] * arm[0] - omega[0] * arm[2]
    out[2] = omega[0] * arm[1] - omega[1] * arm[0]
    exponential(x[4], x[5], x[6], e)
    cross_matrix(arm[0], arm[1], arm[2], c)
    for i in range(3):
        for j in range(3):
            by[i, j] = e[i, 0] * c[0, j] + e[i, 1] * c[1, j] + e[i, 2] * c[2, j]


@lean
def vanes(p: Array, k: Array, ahead: Array, offsets: Array, slopes: bool, y: Array, work: Array) -> None:
    """Fill ``y`` (3,): airspeed, alpha, beta of flow p[0:3] less gusts p[3:6], along nominal axes, rotation p[6:9].

    ``k`` (3,) scale errors, ``ahead`` (3,) velocity of the vanes, ``offsets`` (2,); ``slopes``: whether k[1:] count.
    """
    e = work[0:9].reshape(3, 3)
    exponential(-p[6], -p[7], -p[8], e)
    c1 = e[0, 0] * p[0] + e[0, 1] * p[1] + e[0, 2] * p[2] + ahead[0]
    c2 = e[1, 0] * p[0] + e[1, 1] * p[1] + e[1, 2] * p[2] + ahead[1]
    c3 = e[2, 0] * p[0] + e[2, 1] * p[1] + e[2, 2] * p[2] + ahead[2]
    g1 = c1 - (e[0, 0] * p[3] + e[0, 1] * p[4] + e[0, 2] * p[5])
    g2 = c2 - (e[1, 0] * p[3] + e[1, 1] * p[4] + e[1, 2] * p[5])
    g3 = c3 - (e[2, 0] * p[3] + e[2, 1] * p[4] + e[2, 2] * p[5])
    calm, gusty = c1 * c1 + c3 * c3, g1 * g1 + g3 * g3
    y[0] = np.sqrt(gusty + g2 * g2) + k[0] * np.sqrt(calm + c2 * c2)
    y[1] = np.arctan2(g3, g1) + offsets[0]
    y[2] = np.arctan2(g2, np.sqrt(gusty)) + offsets[1]
    if slopes:
        y[1] += k[1] * np.arctan2(c3, c1)
        y[2] += k[2] * np.arctan2(c2, np.sqrt(calm))


@lean
def see_air(layout: Layout, x: Array, r: Array, omega: Array, root: Array, desk: Desk) -> bool:
    """Regress airspeed, alpha and beta: y, h and the first three rows of spare; False where it is too slow for them.

    ``x`` (23,) about the nominal attitude ``r`` (3, 3).
    """
    n = root.shape[0]
    base, bias = n - 7, layout.at[7]
    z, slope, y, h, point = desk.z, desk.slope, desk.y, desk.h, desk.point
    work = desk.work
    ahead, by = work[60:63], work[63:72].reshape(3, 3)
    centre, e = work[75:87], work[87:96].reshape(3, 3)
    lever(x, omega, layout.vane, ahead, by, work)
    for c in range(3):
        centre[c] = x[1 + c] - r[0, c] * x[WIND] - r[1, c] * x[WIND + 1]
        centre[3 + c] = r[0, c] * x[TURBULENCE] + r[1, c] * x[TURBULENCE + 1] + r[2, c] * x[TURBULENCE + 2]
        centre[6 + c] = x[4 + c]
    exponential(-x[4], -x[5], -x[6], e)
    if e[0, 0] * centre[0] + e[0, 1] * centre[1] + e[0, 2] * centre[2] < SLOW:
        return False
    centre[9], centre[10], centre[11] = x[SCALE], x[SLOPES], x[SLOPES + 1]
    size = 9
    if layout.at[SCALE] >= 0:
        size = 12 if layout.at[SLOPES] >= 0 else 10
    slopes = size == 12 or x[SLOPES] != 0.0 or x[SLOPES + 1] != 0.0
    wind, gust = layout.at[WIND], layout.at[TURBULENCE]
    for i in range(n):
        row = root[i]
        for c in range(3):
            t = row[base + 1 + c]
            for j in range(3):
                t += by[c, j] * row[bias + 3 + j]
            if wind >= 0:
                t -= r[0, c] * row[wind] + r[1, c] * row[wind + 1]
            z[i, c] = t
            t = 0.0
            if gust >= 0:
                for j in range(3):
                    t += r[j, c] * row[gust + j]
            z[i, 3 + c] = t
            z[i, 6 + c] = row[base + 4 + c]
        if size > 9:
            z[i, 9] = row[layout.at[SCALE]]
        if size > 10:
            z[i, 10], z[i, 11] = row[layout.at[SLOPES]], row[layout.at[SLOPES + 1]]
    compress(z, n, size)
    offsets = x[OFFSETS : OFFSETS + 2]
    plus, minus, about = desk.plus, desk.minus, desk.centre
    vanes(centre, centre[9:12], ahead, offsets, slopes, about, work)
    for i in range(size):
        for c in range(12):
            point[c] = centre[c] + FAR * z[i, c] if i <= c < size else centre[c]
        vanes(point, point[9:12], ahead, offsets, slopes, plus, work)
        for c in range(i, size):
            point[c] = centre[c] - FAR * z[i, c]
        vanes(point, point[9:12], ahead, offsets, slopes, minus, work)
        for c in range(1, 3):
            plus[c] = about[c] + wrapped(plus[c] - about[c])
            minus[c] = about[c] + wrapped(minus[c] - about[c])
        part(plus, minus, about, i, 0, 3, desk.odd, desk.even)
    settle(size, 0, 3, about, y, desk.even)
    regress(z, size, desk.odd, 0, 3, slope)
    compress(desk.even, size, 3)
    for i in range(3):
        for c in range(3):
            desk.spare[i, c] = desk.even[i, c] if c >= i else 0.0
    for c in range(3):
        row = h[c]
        row[:] = 0.0
        for j in range(3):
            row[1 + j], row[4 + j] = slope[j, c], slope[6 + j, c]
            row[10 + j] = slope[0, c] * by[0, j] + slope[1, c] * by[1, j] + slope[2, c] * by[2, j]
            row[TURBULENCE + j] = slope[3, c] * r[j, 0] + slope[4, c] * r[j, 1] + slope[5, c] * r[j, 2]
        for j in range(2):
            row[WIND + j] = -(slope[0, c] * r[j, 0] + slope[1, c] * r[j, 1] + slope[2, c] * r[j, 2])
        if c > 0:
            row[OFFSETS + c - 1] = 1.0
        if size > 9:
            row[SCALE] = slope[9, c]
        if size > 10:
            row[SLOPES], row[SLOPES + 1] = slope[10, c], slope[11, c]
    if layout.deaf:
        deafen(x, r, h[:ATTITUDE])
    return True


@lean
def see_turned(layout: Layout, x: Array, q: Array, r: Array, omega: Array, root: Array, desk: Desk) -> bool:
    """Regress Euler angles and velocity over ground: y, h and the last three rows of spare.

    ``x`` (23,) about the nominal attitude ``q`` (4,), ``r`` (3, 3). False where it is too steep for Euler angles.
    """
    n = root.shape[0]
    z, slope, y, h, point = desk.z, desk.slope, desk.y, desk.h, desk.point
    plus, minus, about, work = desk.plus, desk.minus, desk.centre, desk.work
    ahead, by, e = work[60:63], work[63:72].reshape(3, 3), work[72:81].reshape(3, 3)
    now, image = work[81:85], work[85:88]
    lever(x, omega, layout.antenna, ahead, by, work)
    for i in range(n):
        row = root[n - 3 + i] if i < 3 else root[i - 3]
        for j in range(3):
            z[i, j] = row[n - 3 + j]
    for j in range(3):
        reflect(z, j, z, 3, n, j, 3)
    for i in range(-1, 3):
        for sign in range(2):
            y1 = about if i < 0 else (plus if sign == 0 else minus)
            for j in range(3):
                point[j] = x[4 + j]
                if i >= 0:
                    point[j] += FAR * z[i, j] if sign == 0 else -FAR * z[i, j]
            turn(q, point[0], point[1], point[2], now)
            euler(now, y1[ATTITUDE:HEIGHT])
            exponential(point[0], point[1], point[2], e)
            for j in range(3):
                image[j] = e[j, 0] * ahead[0] + e[j, 1] * ahead[1] + e[j, 2] * ahead[2]
            for j in range(3):
                y1[VELOCITY + j] = r[j, 0] * image[0] + r[j, 1] * image[1] + r[j, 2] * image[2]
            for c in range(ATTITUDE, HEIGHT):
                y1[c] = about[c] + wrapped(y1[c] - about[c])
        if i >= 0:
            part(plus, minus, about, i, ATTITUDE, HEIGHT, desk.odd, desk.even)
            part(plus, minus, about, i, VELOCITY, VELOCITY + 3, desk.odd, desk.even)
    settle(3, ATTITUDE, HEIGHT, about, y, desk.even)
    settle(3, VELOCITY, VELOCITY + 3, about, y, desk.even)
    regress(z, 3, desk.odd, ATTITUDE, VELOCITY + 3, slope)
    for c in range(ATTITUDE, VELOCITY + 3):
        if c == HEIGHT:
            continue
        row = h[c]
        row[:] = 0.0
        for j in range(3):
            row[4 + j] = slope[j, c]
            desk.spare[3 + j, c] = desk.even[j, c]
        if c >= VELOCITY:
            o = c - VELOCITY
            for j in range(3):
                row[1 + j] = r[o, j]
                y[c] += r[o, j] * x[1 + j]
                row[10 + j] = r[o, 0] * by[0, j] + r[o, 1] * by[1, j] + r[o, 2] * by[2, j]
    return bool(abs(about[ATTITUDE]) <= STEEP)


@lean
def see(layout: Layout, z: Array, x: Array, q: Array, rate: Array, root: Array, desk: Desk) -> tuple[bool, bool]:
    """Regress what is measured, ``z`` (10,): y, h, seen and spare of ``desk``.

    Returns whether the air data and the Euler angles count. ``rate`` (3,) is that of the gyros.
    """
    n = root.shape[0]
    air = attitude = velocity = False
    for c in range(10):
        if z[c] == z[c]:
            air |= c < ATTITUDE
            attitude |= ATTITUDE <= c < HEIGHT
            velocity |= c >= VELOCITY
    r, omega = desk.work[100:109].reshape(3, 3), desk.work[109:112]
    matrix(q, r)
    for j in range(3):
        omega[j] = rate[j] - x[10 + j]
    desk.spare[:, :] = 0.0
    if air:
        air = see_air(layout, x, r, omega, root, desk)
    if attitude or velocity:
        attitude = see_turned(layout, x, q, r, omega, root, desk) and attitude
    desk.y[HEIGHT] = x[0]
    desk.h[HEIGHT, :] = 0.0
    desk.h[HEIGHT, 0] = 1.0
    for c in range(10):
        present = z[c] == z[c]
        if not present or (c < ATTITUDE and not air) or (ATTITUDE <= c < HEIGHT and not attitude):
            continue
        row = desk.h[c]
        for i in range(n):
            desk.seen[i, c] = 0.0
        for j in range(n):
            t = row[layout.order[j]]
            if t != 0.0:
                for i in range(j + 1):
                    desk.seen[i, c] += t * root[i, j]
    return air, attitude
