"""Attitude: unit quaternions from body axes to north-east-down, small rotations about body axes, Euler angles.

An attitude near a nominal one q is q * exp(a), a the rotation vector in body axes, rad: three numbers without a
singularity, whatever the pitch. Euler angles 3-2-1 (heading psi, pitch theta, roll phi) are for people.

A quaternion is (w, x, y, z), w the cosine of half the angle; R(q) turns body components into north-east-down.
"""

from __future__ import annotations

import numpy as np

from estimator import ud
from estimator.ud import Array, exact

ud.follow(__file__)

SMALL = 1e-4  # rad: below it series are exact to the last bit, and quotients are not


@exact
def matrix(q: Array, r: Array) -> None:
    """Fill ``r`` (3, 3) with R(q), body to north-east-down."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    r[0, 0] = 1.0 - 2.0 * (y * y + z * z)
    r[0, 1] = 2.0 * (x * y - w * z)
    r[0, 2] = 2.0 * (x * z + w * y)
    r[1, 0] = 2.0 * (x * y + w * z)
    r[1, 1] = 1.0 - 2.0 * (x * x + z * z)
    r[1, 2] = 2.0 * (y * z - w * x)
    r[2, 0] = 2.0 * (x * z - w * y)
    r[2, 1] = 2.0 * (y * z + w * x)
    r[2, 2] = 1.0 - 2.0 * (x * x + y * y)


@exact
def turn(q: Array, a1: float, a2: float, a3: float, out: Array) -> None:
    """Fill ``out`` (4,) with q * exp(a): a rotation about body axes. ``out`` may be ``q``."""
    square = a1 * a1 + a2 * a2 + a3 * a3
    if square > SMALL * SMALL:
        angle = np.sqrt(square)
        c, s = np.cos(0.5 * angle), np.sin(0.5 * angle) / angle
    else:
        c, s = 1.0 - square / 8.0, 0.5 - square / 48.0
    x, y, z = s * a1, s * a2, s * a3
    q0, q1, q2, q3 = q[0], q[1], q[2], q[3]
    w0 = q0 * c - q1 * x - q2 * y - q3 * z
    w1 = q0 * x + q1 * c + q2 * z - q3 * y
    w2 = q0 * y - q1 * z + q2 * c + q3 * x
    w3 = q0 * z + q1 * y - q2 * x + q3 * c
    norm = 1.0 / np.sqrt(w0 * w0 + w1 * w1 + w2 * w2 + w3 * w3)
    out[0], out[1], out[2], out[3] = w0 * norm, w1 * norm, w2 * norm, w3 * norm


@exact
def turn_earth(q: Array, a1: float, a2: float, a3: float, out: Array) -> None:
    """Fill ``out`` (4,) with exp(a) * q: a small rotation about north, east and down. ``out`` may be ``q``."""
    x, y, z = 0.5 * a1, 0.5 * a2, 0.5 * a3
    q0, q1, q2, q3 = q[0], q[1], q[2], q[3]
    w0 = q0 - x * q1 - y * q2 - z * q3
    w1 = q1 + x * q0 + y * q3 - z * q2
    w2 = q2 + y * q0 + z * q1 - x * q3
    w3 = q3 + z * q0 + x * q2 - y * q1
    norm = 1.0 / np.sqrt(w0 * w0 + w1 * w1 + w2 * w2 + w3 * w3)
    out[0], out[1], out[2], out[3] = w0 * norm, w1 * norm, w2 * norm, w3 * norm


@exact
def difference(q: Array, p: Array, a: Array) -> None:
    """Fill ``a`` (3,) with the rotation vector from q to p: p = q * exp(a)."""
    w = q[0] * p[0] + q[1] * p[1] + q[2] * p[2] + q[3] * p[3]
    x = q[0] * p[1] - q[1] * p[0] - q[2] * p[3] + q[3] * p[2]
    y = q[0] * p[2] + q[1] * p[3] - q[2] * p[0] - q[3] * p[1]
    z = q[0] * p[3] - q[1] * p[2] + q[2] * p[1] - q[3] * p[0]
    if w < 0.0:
        w, x, y, z = -w, -x, -y, -z
    s = np.sqrt(x * x + y * y + z * z)
    scale = 2.0 * np.arctan2(s, w) / s if s > SMALL else 2.0 / w * (1.0 - s * s / (3.0 * w * w))
    a[0], a[1], a[2] = scale * x, scale * y, scale * z


@exact
def exponential(a1: float, a2: float, a3: float, e: Array) -> None:
    """Fill ``e`` (3, 3) with exp([a]x), by Rodrigues' formula."""
    square = a1 * a1 + a2 * a2 + a3 * a3
    if square > SMALL * SMALL:
        angle = np.sqrt(square)
        s, half = np.sin(angle) / angle, np.sin(0.5 * angle) / angle
        c = 2.0 * half * half
    else:
        s, c = 1.0 - square / 6.0, 0.5 - square / 24.0
    e[0, 0] = 1.0 - c * (a2 * a2 + a3 * a3)
    e[0, 1] = c * a1 * a2 - s * a3
    e[0, 2] = c * a1 * a3 + s * a2
    e[1, 0] = c * a1 * a2 + s * a3
    e[1, 1] = 1.0 - c * (a1 * a1 + a3 * a3)
    e[1, 2] = c * a2 * a3 - s * a1
    e[2, 0] = c * a1 * a3 - s * a2
    e[2, 1] = c * a2 * a3 + s * a1
    e[2, 2] = 1.0 - c * (a1 * a1 + a2 * a2)


@exact
def right_jacobian(a1: float, a2: float, a3: float, j: Array) -> None:
    """Fill ``j`` (3, 3): exp(a + da) = exp(a) exp(J da) to first order.

    J = I - (1 - cos t) / t^2 [a]x + (t - sin t) / t^3 [a]x^2 with t = |a|.
    """
    square = a1 * a1 + a2 * a2 + a3 * a3
    if square > SMALL * SMALL:
        angle = np.sqrt(square)
        half = np.sin(0.5 * angle) / angle
        c, s = 2.0 * half * half, (angle - np.sin(angle)) / (square * angle)
    else:
        c, s = 0.5 - square / 24.0, 1.0 / 6.0 - square / 120.0
    j[0, 0] = 1.0 - s * (a2 * a2 + a3 * a3)
    j[0, 1] = s * a1 * a2 + c * a3
    j[0, 2] = s * a1 * a3 - c * a2
    j[1, 0] = s * a1 * a2 - c * a3
    j[1, 1] = 1.0 - s * (a1 * a1 + a3 * a3)
    j[1, 2] = s * a2 * a3 + c * a1
    j[2, 0] = s * a1 * a3 + c * a2
    j[2, 1] = s * a2 * a3 - c * a1
    j[2, 2] = 1.0 - s * (a1 * a1 + a2 * a2)


@exact
def euler(q: Array, angles: Array) -> None:
    """Fill ``angles`` (3,) with theta in [-pi/2, pi/2], phi and psi in (-pi, pi]."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    s = 2.0 * (w * y - x * z)
    angles[0] = np.arctan2(s, np.sqrt(max(0.0, 1.0 - s * s)))
    angles[1] = np.arctan2(2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y))
    angles[2] = np.arctan2(2.0 * (x * y + w * z), 1.0 - 2.0 * (y * y + z * z))


@exact
def euler_jacobian(theta: float, phi: float, e: Array) -> None:
    """Fill ``e`` (3, 3) with d(theta, phi, psi)/da, the inverse kinematic matrix; unbounded as |theta| -> pi/2."""
    sp, cp, ct = np.sin(phi), np.cos(phi), np.cos(theta)
    if abs(ct) < 1e-9:
        ct = 1e-9
    tt = np.sin(theta) / ct
    e[0, 0], e[0, 1], e[0, 2] = 0.0, cp, -sp
    e[1, 0], e[1, 1], e[1, 2] = 1.0, sp * tt, cp * tt
    e[2, 0], e[2, 1], e[2, 2] = 0.0, sp / ct, cp / ct


@exact
def quaternion(theta: float, phi: float, psi: float, q: Array) -> None:
    """Fill ``q`` (4,) from Euler angles 3-2-1."""
    ct, st = np.cos(0.5 * theta), np.sin(0.5 * theta)
    cp, sp = np.cos(0.5 * phi), np.sin(0.5 * phi)
    cs, ss = np.cos(0.5 * psi), np.sin(0.5 * psi)
    q[0] = cs * ct * cp + ss * st * sp
    q[1] = cs * ct * sp - ss * st * cp
    q[2] = cs * st * cp + ss * ct * sp
    q[3] = ss * ct * cp - cs * st * sp
