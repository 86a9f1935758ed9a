"""The two Earths that can be flown on, and the little geodesy that truth and sensors need.

``wgs84``
    The rotating ellipsoid with its normal gravity: what a real flight has.
``flat``
    A plane that does not rotate, with constant gravity: what textbook equations of motion assume. Positions on it are
    told as latitude and longitude of a plane that touches WGS-84 at the start.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from sims.truth import Array

Planet = Literal["wgs84", "flat"]

PLANETS: tuple[Planet, ...] = ("wgs84", "flat")

EQUATOR = 6378137.0
"""WGS-84 semi-major axis (m)."""
ECCENTRICITY2 = 6.69437999014e-3
"""WGS-84 first eccentricity squared."""
ROTATION = 7.292115e-5
"""WGS-84 rotation rate (rad/s)."""
FLAT_GRAVITY = 9.80665
"""Gravity on the flat Earth (m/s2)."""

_FLATTENING = 1.0 / 298.257223563
_ROTATION_RATIO = 0.00344978650684  # rotation^2 a^2 b / GM


def rotation(planet: str) -> float:
    """Return the rotation rate of `planet` (rad/s)."""
    return ROTATION if planet == "wgs84" else 0.0


def radii(latitude: Array) -> tuple[Array, Array]:
    """Return the meridian and the prime-vertical radius of curvature (m) at a geodetic latitude (rad)."""
    w2 = 1.0 - ECCENTRICITY2 * np.sin(latitude) ** 2
    prime = EQUATOR / np.sqrt(w2)
    return np.asarray(prime * (1.0 - ECCENTRICITY2) / w2), np.asarray(prime)


def gravity(planet: str, latitude: Array, altitude: Array) -> Array:
    """Return gravity along the vertical (m/s2, down) at a latitude (rad) and an altitude (m).

    WGS-84 normal gravity by Somigliana's formula, with the gradient of first order in the altitude.
    """
    if planet == "flat":
        return np.full(np.shape(altitude), FLAT_GRAVITY)
    s2 = np.sin(latitude) ** 2
    surface = 9.7803253359 * (1.0 + 0.00193185265241 * s2) / np.sqrt(1.0 - ECCENTRICITY2 * s2)
    gradient = -2.0 / EQUATOR * (1.0 + _FLATTENING + _ROTATION_RATIO - 2.0 * _FLATTENING * s2) * surface
    return np.asarray(surface + gradient * altitude)


def displace(latitude: Array, longitude: Array, altitude: Array, offset: Array) -> tuple[Array, Array, Array]:
    """Return latitude, longitude (rad) and altitude (m) moved by `offset` (N, 3) NED (m) on WGS-84."""
    north, east = radii(latitude)
    return (
        latitude + offset[:, 0] / (north + altitude),
        longitude + offset[:, 1] / ((east + altitude) * np.cos(latitude)),
        altitude - offset[:, 2],
    )


def unroll(latitude: Array, longitude: Array, start: tuple[float, float], radius: float) -> tuple[Array, Array]:
    """Return the latitude and longitude on WGS-84 (rad) of places on a sphere of `radius` (m), both from `start`.

    On a sphere a thousand times the Earth's size a flight is flat to within a millimetre; its metres to the north and
    to the east are laid on the ellipsoid at the start.
    """
    north, east = radii(np.asarray(start[0]))
    return (
        np.asarray(start[0] + (latitude - start[0]) * (radius / north)),
        np.asarray(start[1] + (longitude - start[1]) * (radius / east)),
    )
