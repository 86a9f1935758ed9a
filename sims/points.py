"""The truth at a point of the airframe that is not its centre of gravity.

A rigid body: with r from the centre of gravity to the point, body axes, the inertial rates omega and R from body to
north-east-down::

    velocity        v + R ((omega - R^T earth rate) x r)        relative to the ground
    specific force  f + omega' x r + omega x (omega x r)
    flow            R^T (velocity - wind) + (omega - R^T earth rate) x r

An arm of zero gives the columns of the truth themselves, bit for bit.
"""

from __future__ import annotations

import numpy as np

from sims import earth
from sims.truth import Array, Truth

Arm = tuple[float, float, float]


def body_to_ned(attitude: Array) -> Array:
    """Return the rotation matrices (N, 3, 3) of Euler angles (N, 3) phi, theta, psi (rad), 3-2-1."""
    (cf, ct, cs), (sf, st, ss) = np.cos(attitude.T), np.sin(attitude.T)
    rows = (
        (ct * cs, sf * st * cs - cf * ss, cf * st * cs + sf * ss),
        (ct * ss, sf * st * ss + cf * cs, cf * st * ss - sf * cs),
        (-st, sf * ct, cf * ct),
    )
    return np.moveaxis(np.array(rows), -1, 0)


def to_body(truth: Truth, vectors: Array) -> Array:
    """Return NED vectors (N, 3) in body axes."""
    return np.asarray(np.einsum("nji,nj->ni", body_to_ned(truth.attitude), vectors))


def to_ned(truth: Truth, vectors: Array) -> Array:
    """Return body vectors (N, 3) in NED axes."""
    return np.asarray(np.einsum("nij,nj->ni", body_to_ned(truth.attitude), vectors))


def relative_rates(truth: Truth) -> Array:
    """Return the body rates relative to the turning Earth (N, 3), rad/s."""
    spin = earth.rotation(truth.planet)
    zero = np.zeros(len(truth))
    turning = np.stack([spin * np.cos(truth.latitude), zero, -spin * np.sin(truth.latitude)], axis=1)
    return truth.rates - to_body(truth, turning)


def position(truth: Truth, arm: Arm) -> tuple[Array, Array, Array]:
    """Return latitude, longitude (rad) and altitude (m) of the point, each (N,)."""
    where = truth.latitude, truth.longitude, truth.altitude
    if not any(arm):
        return where
    return earth.displace(*where, to_ned(truth, np.broadcast_to(np.array(arm), (len(truth), 3))))


def altitude(truth: Truth, arm: Arm) -> Array:
    """Return the altitude of the point (N,), m."""
    return position(truth, arm)[2]


def velocity(truth: Truth, arm: Arm) -> Array:
    """Return the velocity of the point relative to the ground (N, 3), NED, m/s."""
    if not any(arm):
        return truth.velocity
    return truth.velocity + to_ned(truth, np.cross(relative_rates(truth), arm))


def body_velocity(truth: Truth, arm: Arm) -> Array:
    """Return the velocity of the point relative to the ground (N, 3) in body axes u, v, w, m/s."""
    return to_body(truth, velocity(truth, arm))


def flow(truth: Truth, arm: Arm) -> Array:
    """Return the velocity of the point relative to the air (N, 3), body axes, m/s; the wind is that at the CG."""
    return to_body(truth, truth.velocity - truth.wind) + np.cross(relative_rates(truth), arm)


def air_data(truth: Truth, arm: Arm) -> tuple[Array, Array, Array]:
    """Return true airspeed (m/s), alpha and beta (rad) of the flow at the point, each (N,)."""
    if not any(arm):
        return truth.airspeed, truth.alpha, truth.beta
    u, v, w = flow(truth, arm).T
    airspeed = np.sqrt(u * u + v * v + w * w)
    return airspeed, np.arctan2(w, u), np.arcsin(v / airspeed)


def mean_specific_force(truth: Truth, arm: Arm) -> Array:
    """Return the mean specific force at the point over the interval that ends at each record (N, 3), m/s2.

    The mean of omega' is the difference of omega across the interval, exactly. The mean of omega x (omega x r) is that
    of the parabola through omega at both ends with the recorded mean: the record's own accuracy.
    """
    if not any(arm):
        return truth.mean_specific_force
    dt = 1.0 / truth.rate
    after, mean = truth.rates, truth.mean_rates
    # The rate before the first record was not recorded: linear through the mean.
    before = np.concatenate([2.0 * mean[:1] - after[:1], after[:-1]])
    middle = 0.5 * (before + after)
    bulge = mean - middle

    def product(a: Array, b: Array) -> Array:
        return np.asarray(np.einsum("ni,nj->nij", a, b))

    mixed = product(middle, bulge) + product(bulge, middle)
    squares = (product(before, before) + product(after, after)) / 3.0
    squares += (product(before, after) + product(after, before)) / 6.0
    squares += mixed + 1.2 * product(bulge, bulge)
    r = np.array(arm)
    # omega x (omega x r) = omega (omega . r) - r omega^2
    centripetal = squares @ r - np.einsum("nii->n", squares)[:, None] * r
    return np.asarray(truth.mean_specific_force + np.cross((after - before) / dt, r) + centripetal)
