"""WGS-84 geodesy: a local tangent plane and back.

Conventions: latitude and longitude in rad, lengths in m. Heights are whatever the caller's heights are; a height
above mean sea level taken for one above the ellipsoid shifts horizontal distances by 1e-5 of themselves at most.

References
----------
NIMA TR8350.2, Department of Defense World Geodetic System 1984; B. R. Bowring, "Transformation from spatial to
geographical coordinates", Survey Review 23 (1976) 323-327.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

SEMI_MAJOR = 6378137.0
FLATTENING = 1 / 298.257223563
ECCENTRICITY2 = FLATTENING * (2 - FLATTENING)
SEMI_MINOR = SEMI_MAJOR * (1 - FLATTENING)


def to_earth(latitude: Floats, longitude: Floats, height: Floats) -> Floats:
    """Earth-centred, Earth-fixed coordinates, shape (k, 3), m."""
    normal = SEMI_MAJOR / np.sqrt(1 - ECCENTRICITY2 * np.sin(latitude) ** 2)
    return np.stack(
        [
            (normal + height) * np.cos(latitude) * np.cos(longitude),
            (normal + height) * np.cos(latitude) * np.sin(longitude),
            (normal * (1 - ECCENTRICITY2) + height) * np.sin(latitude),
        ],
        axis=-1,
    )


def from_earth(earth: Floats) -> tuple[Floats, Floats, Floats]:
    """Latitude, longitude, height of Earth-fixed points, shape (k, 3); Bowring's formula, below 1e-9 rad near the
    ground.
    """
    x, y, z = earth[..., 0], earth[..., 1], earth[..., 2]
    distance = np.hypot(x, y)
    reduced = np.arctan2(z * SEMI_MAJOR, distance * SEMI_MINOR)
    latitude = np.arctan2(
        z + ECCENTRICITY2 / (1 - ECCENTRICITY2) * SEMI_MINOR * np.sin(reduced) ** 3,
        distance - ECCENTRICITY2 * SEMI_MAJOR * np.cos(reduced) ** 3,
    )
    normal = SEMI_MAJOR / np.sqrt(1 - ECCENTRICITY2 * np.sin(latitude) ** 2)
    # The form that has no pole: h = p cos(lat) + z sin(lat) - a^2 / N
    height = distance * np.cos(latitude) + z * np.sin(latitude) - SEMI_MAJOR**2 / normal
    return latitude, np.arctan2(y, x), height


def axes(latitude: Floats, longitude: Floats) -> Floats:
    """North, east and down at places (...), as Earth-fixed rows: shape (3, 3, ...)."""
    sin, cos, sin_l, cos_l = np.sin(latitude), np.cos(latitude), np.sin(longitude), np.cos(longitude)
    return np.array(
        [[-sin * cos_l, -sin * sin_l, cos], [-sin_l, cos_l, np.zeros_like(sin)], [-cos * cos_l, -cos * sin_l, -sin]]
    )


def _rotate(matrix: Floats, vectors: Floats) -> Floats:
    """Matrix times vectors (..., 3), term by term: a matrix product rounds otherwise for one vector than for many."""
    x, y, z = vectors[..., 0], vectors[..., 1], vectors[..., 2]
    return np.stack([row[0] * x + row[1] * y + row[2] * z for row in matrix], axis=-1)


class TangentPlane:
    """North and east on the plane that touches the Earth at one point; heights stay heights.

    Parameters
    ----------
    latitude, longitude, height : float
        The point, rad and m.
    """

    def __init__(self, latitude: float, longitude: float, height: float) -> None:
        self.latitude, self.longitude, self.height = latitude, longitude, height
        self._point = to_earth(np.array(latitude), np.array(longitude), np.array(height))
        self._axes = axes(np.array(latitude), np.array(longitude))

    def to_plane(self, latitude: Floats, longitude: Floats, height: Floats) -> tuple[Floats, Floats]:
        """North and east, m, of points at their heights."""
        local = _rotate(self._axes, to_earth(latitude, longitude, height) - self._point)
        return local[..., 0], local[..., 1]

    def turn(self, latitude: Floats, longitude: Floats, velocity: Floats) -> tuple[Floats, Floats]:
        """North and east in the plane, m/s, of velocities (k, 3) along north, east and down of where they were
        measured. A vertical part that is not known (NaN) is taken for zero.
        """
        there = axes(latitude, longitude)
        parts = velocity[:, 0], velocity[:, 1], np.where(np.isnan(velocity[:, 2]), 0.0, velocity[:, 2])
        x, y, z = (parts[0] * there[0, i] + parts[1] * there[1, i] + parts[2] * there[2, i] for i in range(3))
        north, east = (row[0] * x + row[1] * y + row[2] * z for row in self._axes[:2])
        return north, east

    def from_plane(self, north: Floats, east: Floats, height: Floats) -> tuple[Floats, Floats]:
        """Latitude and longitude, rad, of points at their heights: the inverse of `to_plane`."""
        down = self.height - height + (north**2 + east**2) / (2 * SEMI_MAJOR)
        latitude, longitude = np.full_like(north, np.nan), np.full_like(north, np.nan)
        back = self._axes.T
        for _ in range(3):  # the height's error shrinks by the square of the distance over the Earth's radius each time
            latitude, longitude, found = from_earth(self._point + _rotate(back, np.stack([north, east, down], axis=-1)))
            down = down + found - height
        return latitude, longitude
