"""The International Standard Atmosphere below 11 km, and pitot pressures."""

from __future__ import annotations

import numpy as np

from sims.truth import Array

P0 = 101325.0
"""Sea-level pressure (Pa)."""
T0 = 288.15
"""Sea-level temperature (K)."""
A0 = 340.294
"""Sea-level speed of sound (m/s)."""

_LAPSE = 0.0065
_EXPONENT = 5.25588


def pressure(altitude: Array) -> Array:
    """Return the static pressure (Pa) at a pressure altitude (m)."""
    return np.asarray(P0 * (1.0 - _LAPSE / T0 * altitude) ** _EXPONENT)


def pressure_altitude(pressure: Array) -> Array:
    """Return the pressure altitude (m) of a static pressure (Pa)."""
    return np.asarray(T0 / _LAPSE * (1.0 - (pressure / P0) ** (1.0 / _EXPONENT)))


def standard_temperature(altitude: Array) -> Array:
    """Return the temperature (K) of the standard atmosphere at a pressure altitude (m)."""
    return np.asarray(T0 - _LAPSE * altitude)


def impact_pressure(airspeed: Array, pressure: Array, temperature: Array) -> Array:
    """Return what a pitot tube feels above static (Pa): true airspeed (m/s), static pressure (Pa), temperature (K)."""
    mach = airspeed / (A0 * np.sqrt(temperature / T0))
    return np.asarray(pressure * ((1.0 + 0.2 * mach**2) ** 3.5 - 1.0))


def calibrated_airspeed(impact: Array) -> Array:
    """Return the calibrated airspeed (m/s) of an impact pressure (Pa); that of a negative one is 0."""
    return np.asarray(A0 * np.sqrt(5.0 * ((np.maximum(impact, 0.0) / P0 + 1.0) ** (2.0 / 7.0) - 1.0)))


def impact_of_calibrated(airspeed: Array) -> Array:
    """Return the impact pressure (Pa) of a calibrated airspeed (m/s)."""
    return np.asarray(P0 * ((1.0 + 0.2 * (airspeed / A0) ** 2) ** 3.5 - 1.0))
