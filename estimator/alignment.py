"""Where a flight path can begin, and with what: levelling, heading and wind from the last samples before it.

A start needs inertial samples fast enough to be integrated, a satellite velocity (mode P: an airspeed) and an attitude:
a measured one, or level from the specific force, less what turning and gaining speed add to it; and a heading: a
measured one, or the track of a vehicle that moves. A measured attitude that is old, or far from level where level can
be told, is not believed.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimator.drive import BLIND, IMPACT, IMU, MEASURED, STATIC, Samples
from estimator.kinematics import ATTITUDE, HEIGHT, VELOCITY
from estimator.models.flight_path import FlightPath

Floats = NDArray[np.float64]

SLOWEST = 20.0  # Hz of inertial samples
SPAN = 2.0  # s that are looked at
STEADY = (0.1, 0.7)  # rad/s and m/s2: less than that is neither turning nor accelerating
TURNING = 0.5  # rad/s: up to it level is told from the specific force less what the turn adds
GAIN = 1.0  # m/s2 of speed: less than that is not taken off, because the fixes tell it no better
UNSURE = math.radians(10.0)  # a level that is known no better is none
FRESH = 500_000_000  # ns: an older attitude is none
CONTRADICTION = math.radians(15.0)  # of a measured attitude and gravity
MOVING = 5.0  # m/s: a track above it is a heading
GUST = 3.0  # m/s: what a crosswind does to a track as a heading


class Start(NamedTuple):
    """A beginning.

    Attributes
    ----------
    row : int
        The inertial sample at whose time it is.
    values : dict
        Of the states, by name.
    sigma : (n,) array
        Standard deviations of the named states.
    period : float
        Usual time between inertial samples, s.
    text : str
        Where attitude and heading come from.
    doubtful : bool
        A sensor was not believed.
    """

    row: int
    values: dict[str, float]
    sigma: Floats
    period: float
    text: str
    doubtful: bool = False


def rate(t: NDArray[np.int64]) -> float:
    """Usual rate of inertial samples, Hz: from the median interval; 0 for fewer than three."""
    return 1e9 / float(np.median(np.diff(t))) if len(t) > 2 else 0.0


def find(samples: Samples, flight: FlightPath, airspeed: Floats) -> Start | str:
    """Begin at the newest inertial sample, or say what is missing.

    Parameters
    ----------
    samples : Samples
        The last two seconds or more.
    flight : FlightPath
    airspeed : (k,) array
        True airspeed of the rows, NaN where none.
    """
    settings = flight.settings
    inertial = np.flatnonzero(~np.isnan(samples.z[:, IMU]))
    if not len(inertial):
        return "no inertial samples"
    row = int(inertial[-1])
    end = int(samples.t[row])
    inertial = inertial[samples.t[inertial] >= end - round(SPAN * 1e9)]
    if end - int(samples.t[inertial[0]]) < 0.45 * SPAN * 1e9:
        return "inertial samples for less than a second"
    hertz = rate(samples.t[inertial])
    if hertz < SLOWEST:
        return f"inertial samples at {hertz:.1f} Hz: at least {SLOWEST:.0f} Hz are needed"
    recent = slice(int(inertial[0]), row + 1)
    z = samples.z[recent]
    force, turning = z[:, IMU : IMU + 3], z[:, IMU + 3 : IMU + 6]
    second = samples.t[recent] >= end - 1_000_000_000
    f, w = np.nanmean(force[second], axis=0), np.nanmean(turning[second], axis=0)
    g = flight.model.earth.g0
    if not 0.5 < float(np.linalg.norm(f)) / g < 1.5:
        return f"specific force of {np.linalg.norm(f):.1f} m/s2, gravity is {g:.2f}: no start while manoeuvring hard"
    velocity = z[:, MEASURED + VELOCITY : MEASURED + VELOCITY + 3]
    fixed = np.flatnonzero(~np.isnan(velocity[:, 0]))
    if settings.mode != "P" and not len(fixed):
        return "no satellite velocity"
    height = _last(z[:, MEASURED + HEIGHT])
    if math.isnan(height):
        return "no altitude"
    speed = _last(airspeed[recent])
    level = _level(f, w, g, speed, samples.t[recent][fixed], velocity[fixed], settings.gyro_bias)
    fresh = samples.t[recent] >= end - FRESH
    angles = np.array([_last(z[fresh, MEASURED + ATTITUDE + i]) for i in range(3)])
    sigma = flight.prior()
    names = flight.names
    known = bool(np.isfinite(angles[:2]).all()) and abs(angles[0]) < 1.6 and abs(angles[1]) < 6.4
    doubtful = False
    if known and level is not None:
        between = _rotation(level[0], level[1], 0.0)[2] @ _rotation(float(angles[0]), float(angles[1]), 0.0)[2]
        apart = math.acos(min(max(float(between), -1.0), 1.0))
        doubtful = apart > max(CONTRADICTION, 3.0 * settings.prior_attitude) + 3.0 * level[2]
    if known and not doubtful:
        theta, phi, source = float(angles[0]), float(angles[1]), "measured attitude"
    elif level is not None:
        theta, phi, unsure = level
        for name in ("theta", "phi"):
            sigma[names.index(name)] = math.hypot(settings.prior_attitude, unsure)
        source = "level from the specific force"
        if doubtful:
            source += f" (the measured attitude is {math.degrees(apart):.0f} deg away and not believed)"
    else:
        return "no attitude, and turning or accelerating too much to level"
    v = velocity[fixed[-1]].copy() if len(fixed) else np.zeros(3)
    v[2] = 0.0 if math.isnan(v[2]) else v[2]
    track = math.hypot(v[0], v[1])
    if settings.mode == "P":
        psi = float(angles[2]) if math.isfinite(angles[2]) else 0.0
    elif math.isfinite(angles[2]):
        psi = float(angles[2])
        if settings.heading is None:
            sigma[names.index("psi")] = max(settings.prior_heading, math.radians(10.0))
    elif track > MOVING:
        psi = math.atan2(v[1], v[0])
        sigma[names.index("psi")] = max(settings.prior_heading, GUST / track)
        source += ", heading from the track"
    else:
        return "no heading, and too slow for a track"
    turn_back = _rotation(theta, phi, psi).T
    values = {"h": height, "theta": theta, "phi": phi, "psi": psi}
    if settings.mode == "P":
        if math.isnan(speed):
            return "no airspeed"
        alpha, beta = (_last(z[:, MEASURED + i]) for i in (1, 2))
        alpha, beta = (0.0 if math.isnan(a) else a for a in (alpha, beta))
        body = speed * np.array([math.cos(alpha) * math.cos(beta), math.sin(beta), math.sin(alpha) * math.cos(beta)])
    else:
        body = turn_back @ v
        if settings.mode == "G" and speed > max(BLIND * settings.airspeed, MOVING):
            alpha, beta = (_last(z[:, MEASURED + i]) for i in (1, 2))
            alpha = theta if math.isnan(alpha) else alpha  # level flight, as a rule
            beta = 0.0 if math.isnan(beta) else beta
            air = speed * np.array([math.cos(alpha) * math.cos(beta), math.sin(beta), math.sin(alpha) * math.cos(beta)])
            wind = v - turn_back.T @ air
            if math.hypot(wind[0], wind[1]) < 3.0 * settings.wind:
                values["wind_north"], values["wind_east"] = float(wind[0]), float(wind[1])
    values.update(u=float(body[0]), v=float(body[1]), w=float(body[2]))
    return Start(row, values, sigma, 1.0 / hertz, source, doubtful)


def _level(
    f: Floats, w: Floats, g: float, airspeed: float, t: NDArray[np.int64], velocity: Floats, gyro_bias: float
) -> tuple[float, float, float] | None:
    """Pitch and roll from the specific force ``f``, and how much less sure they are in a turn; None in a manoeuvre.

    What gaining speed adds is taken off, and in a turn the centripetal force: that of straight flight would be nothing
    but the gyros' bias times the speed.
    """
    track = np.hypot(velocity[:, 0], velocity[:, 1])
    gain = float((track[-1] - track[0]) / (1e-9 * (t[-1] - t[0]))) if len(track) > 1 else 0.0
    felt = f - np.array([gain if abs(gain) > GAIN else 0.0, 0.0, 0.0])
    turning, unsure = float(np.linalg.norm(w)), 0.0
    if turning > STEADY[0]:
        speed = airspeed if airspeed > MOVING else float(track[-1]) if len(track) else 0.0
        felt = felt - np.array([0.0, w[2] * speed, -w[1] * speed])
        unsure = gyro_bias * speed / g
    if turning > TURNING or unsure > UNSURE or not abs(float(np.linalg.norm(felt)) - g) < STEADY[1]:
        return None
    return math.atan2(felt[0], math.hypot(felt[1], felt[2])), math.atan2(-felt[1], -felt[2]), unsure


def true_airspeed(samples: Samples) -> Floats:
    """True airspeed (k,) of rows, with the static pressure of the newest row before each; NaN where none."""
    from estimator import atmosphere

    static = samples.z[:, STATIC]
    last = np.maximum.accumulate(np.where(np.isnan(static), -1, np.arange(len(static))))
    filled = np.where(last >= 0, static[last], atmosphere.SEA_LEVEL_PRESSURE)
    impact = samples.z[:, IMPACT]
    impact = np.where(np.isnan(impact), atmosphere.impact_pressure(samples.z[:, MEASURED]), impact)
    with np.errstate(invalid="ignore"):
        return atmosphere.true_airspeed(impact, filled)


def _last(column: Floats) -> float:
    known = np.flatnonzero(~np.isnan(column))
    return float(column[known[-1]]) if len(known) else math.nan


def _rotation(theta: float, phi: float, psi: float) -> Floats:
    from estimator.rotation import matrix, quaternion

    q, r = np.empty(4), np.empty((3, 3))
    quaternion(theta, phi, psi, q)
    matrix(q, r)
    return r
