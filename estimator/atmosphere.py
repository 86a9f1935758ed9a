"""True airspeed from what pitot and static ports measure, in the ICAO standard atmosphere."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

SEA_LEVEL_PRESSURE = 101325.0  # Pa
SEA_LEVEL_TEMPERATURE = 288.15  # K
SEA_LEVEL_SOUND = 340.294  # m/s
TROPOPAUSE_RATIO = 0.2233609  # pressure over that at sea level, at 11 km
EXPONENT = 0.19026324  # g0 / (R / lapse rate), inverted


def impact_pressure(calibrated: Floats) -> Floats:
    """Impact pressure, Pa, that an airspeed indicator shows as this calibrated airspeed, m/s (compressible, subsonic).

    The sign is kept: at rest a sensor reads a little below zero as often as above.
    """
    mach = calibrated / SEA_LEVEL_SOUND
    return np.sign(calibrated) * SEA_LEVEL_PRESSURE * ((1.0 + 0.2 * mach * mach) ** 3.5 - 1.0)


def true_airspeed(impact: Floats, static: Floats) -> Floats:
    """True airspeed, m/s, from impact and static pressure, Pa, at the standard temperature of that pressure.

    ::

        M^2 = 5 ((q_c/p + 1)^(2/7) - 1)        V = M a(T)        a proportional to sqrt(T)

    A day 10 K off the standard makes it wrong by 2 %: that is a scale error, and estimated as one.
    """
    ratio = np.maximum(static / SEA_LEVEL_PRESSURE, TROPOPAUSE_RATIO)
    sound = SEA_LEVEL_SOUND * np.sqrt(ratio**EXPONENT)
    mach = np.sqrt(5.0 * ((np.abs(impact) / static + 1.0) ** (2.0 / 7.0) - 1.0))
    return np.sign(impact) * mach * sound


def standard_pressure(altitude: Floats) -> Floats:
    """Static pressure, Pa, at a pressure altitude, m, below 11 km."""
    return SEA_LEVEL_PRESSURE * np.maximum(1.0 - altitude / 44330.769, 0.1) ** (1.0 / EXPONENT)
