"""Truth -> what the sensors say: biases, scale errors, noise and latency, each sensor at its own rate.

Two grades stand for two worlds: ``fti``, flight-test instrumentation, and ``mems``, the sensors of a small autopilot.
Every sensor draws from its own random stream, so that a change to one leaves the errors of the others as they were.
"""

from __future__ import annotations

import dataclasses
import math
from typing import NamedTuple

import numpy as np

from sims import atmosphere
from sims.truth import Array, Times, Truth

Generator = np.random.Generator

EQUATOR = 6378137.0
"""WGS-84 semi-major axis (m)."""
ECCENTRICITY2 = 6.69437999014e-3
"""WGS-84 first eccentricity squared."""


class SensorError(ValueError):
    """The grade is not known, or a rate does not fit the truth's."""


class Grade(NamedTuple):
    """What a set of sensors is worth: 1 sigma of noise per sample, and of errors that are constant over a flight.

    Attributes
    ----------
    name : str
        Of the set.
    accelerometer, accelerometer_bias : float
        Per axis (m/s2).
    gyro, gyro_bias : float
        Per axis (rad/s).
    attitude, attitude_time : float
        Attitude error per angle (rad) and its correlation time (s); 0 is white.
    altitude, altitude_step, altimeter_offset : float
        Pressure-altitude noise, resolution (0 = none) and 1 sigma of the constant offset (m).
    airspeed, airspeed_scale : float
        Calibrated-airspeed noise (m/s) and 1 sigma of the constant relative error.
    temperature : float
        Of the air outside (K).
    position, position_time, position_white : float
        GNSS position error per horizontal axis (m), correlation time of its slow part (s), and the share of the
        variance that is white. The height error is 1.5 times as large.
    velocity : float
        GNSS velocity noise per axis (m/s).
    """

    name: str
    accelerometer: float
    accelerometer_bias: float
    gyro: float
    gyro_bias: float
    attitude: float
    attitude_time: float
    altitude: float
    altitude_step: float
    altimeter_offset: float
    airspeed: float
    airspeed_scale: float
    temperature: float
    position: float
    position_time: float
    position_white: float
    velocity: float


_DEG = math.pi / 180.0

GRADES: dict[str, Grade] = {
    "fti": Grade(
        name="fti",
        accelerometer=0.01,
        accelerometer_bias=0.02,
        gyro=0.01 * _DEG,
        gyro_bias=0.02 * _DEG,
        attitude=0.05 * _DEG,
        attitude_time=0.0,
        altitude=0.5,
        altitude_step=0.0,
        altimeter_offset=10.0,
        airspeed=0.3,
        airspeed_scale=0.01,
        temperature=0.2,
        position=2.0,
        position_time=30.0,
        position_white=0.2,
        velocity=0.05,
    ),
    "mems": Grade(
        name="mems",
        accelerometer=0.1,
        accelerometer_bias=0.3,
        gyro=0.1 * _DEG,
        gyro_bias=0.5 * _DEG,
        attitude=0.5 * _DEG,
        attitude_time=3.0,
        altitude=1.0,
        altitude_step=0.1,
        altimeter_offset=10.0,
        airspeed=1.0,
        airspeed_scale=0.05,
        temperature=1.0,
        position=5.0,
        position_time=30.0,
        position_white=0.2,
        velocity=0.2,
    ),
}
"""The two sets by name."""

VERTICAL = 1.5
"""How much worse GNSS height is than a horizontal axis."""

RATES = {"imu": 50, "attitude": 25, "static": 10, "pitot": 10, "gnss": 5, "navigation": 5}
"""Samples per second of each sensor (Hz)."""


class Imu(NamedTuple):
    """Strapdown sensors at the CG: t (N,) ns since boot, specific force (N, 3) m/s2, rates (N, 3) rad/s, body axes.

    A sample is the mean over the time since the sample before it, as an integrating IMU gives it.
    """

    t: Times
    specific_force: Array
    rates: Array


class Attitude(NamedTuple):
    """An attitude reference: t (N,) ns, attitude (N, 3) phi, theta, psi rad (psi 0..2 pi), rates (N, 3) rad/s."""

    t: Times
    attitude: Array
    rates: Array


class Static(NamedTuple):
    """Static port and thermometer: t (N,) ns, pressure (N,) Pa, pressure altitude (N,) m, temperature (N,) K."""

    t: Times
    pressure: Array
    altitude: Array
    temperature: Array


class Pitot(NamedTuple):
    """Pitot tube: t (N,) ns, impact pressure (N,) Pa and the calibrated airspeed (N,) m/s that belongs to it."""

    t: Times
    impact: Array
    airspeed: Array


class Fixes(NamedTuple):
    """Positions: t (N,) ns, latitude and longitude (N,) rad, altitude (N,) m, velocity (N, 3) m/s NED."""

    t: Times
    latitude: Array
    longitude: Array
    altitude: Array
    velocity: Array


class Constants(NamedTuple):
    """Errors that stay the same over the flight, for comparison with what an estimator finds.

    Measured = true + bias; measured airspeed = true x (1 + scale); measured altitude = true + offset.
    """

    accelerometer: Array
    gyro: Array
    altimeter: float
    airspeed_scale: float


@dataclasses.dataclass(frozen=True, slots=True)
class Sensors:
    """Everything the sensors said in one flight.

    Attributes
    ----------
    grade : Grade
        Declared quality.
    gnss_latency : float
        Age of a GNSS solution at its time stamp (s).
    imu, attitude, static, pitot : Imu, Attitude, Static, Pitot
        Columns.
    gnss : Fixes
        Receiver's solution.
    navigation : Fixes
        The vehicle's own filter: it follows the slow part of the GNSS error, so it is not independent of `gnss`.
    constants : Constants
        The constant errors that were drawn.
    """

    grade: Grade
    gnss_latency: float
    imu: Imu
    attitude: Attitude
    static: Static
    pitot: Pitot
    gnss: Fixes
    navigation: Fixes
    constants: Constants


def find(grade: str | Grade) -> Grade:
    """Return `grade` itself, or the grade of that name.

    Raises
    ------
    SensorError
        No grade of that name.
    """
    if isinstance(grade, Grade):
        return grade
    if grade not in GRADES:
        raise SensorError(f"unknown sensors {grade!r}; known: {', '.join(sorted(GRADES))}")
    return GRADES[grade]


def sense(truth: Truth, grade: str | Grade = "mems", *, seed: int = 1, gnss_latency: float = 0.0) -> Sensors:
    """Return what sensors of this grade say about `truth`; the same seed gives the same errors.

    Raises
    ------
    SensorError
        Unknown grade, a negative latency, or a sensor rate that does not divide the truth's record rate.
    """
    if gnss_latency < 0.0:
        raise SensorError(f"a GNSS solution cannot be {-gnss_latency} s early")
    grade = find(grade)
    streams = [np.random.default_rng(child) for child in np.random.SeedSequence(seed).spawn(7)]
    constant, imu, attitude, static, pitot, gnss, navigation = streams
    constants = Constants(
        accelerometer=grade.accelerometer_bias * constant.standard_normal(3),
        gyro=grade.gyro_bias * constant.standard_normal(3),
        altimeter=grade.altimeter_offset * float(constant.standard_normal()),
        airspeed_scale=grade.airspeed_scale * float(constant.standard_normal()),
    )
    fixes, slow = _gnss(truth, grade, gnss_latency, gnss)
    return Sensors(
        grade=grade,
        gnss_latency=gnss_latency,
        imu=_imu(truth, grade, constants, imu),
        attitude=_attitude(truth, grade, attitude),
        static=_static(truth, grade, constants, static),
        pitot=_pitot(truth, grade, constants, pitot),
        gnss=fixes,
        navigation=_navigation(truth, grade, slow, navigation),
        constants=constants,
    )


def _every(truth: Truth, sensor: str) -> slice:
    """Return which records a sensor samples."""
    step = round(truth.rate) / RATES[sensor]
    if step != int(step) or step < 1:
        raise SensorError(f"{sensor} at {RATES[sensor]} Hz does not divide the truth's {truth.rate:.0f} Hz")
    return slice(None, None, int(step))


def _imu(truth: Truth, grade: Grade, constants: Constants, random: Generator) -> Imu:
    at = _every(truth, "imu")
    force, rates = (_interval_mean(column, at.step) for column in (truth.mean_specific_force, truth.mean_rates))
    return Imu(
        t=truth.t[at],
        specific_force=force + constants.accelerometer + grade.accelerometer * random.standard_normal(force.shape),
        rates=rates + constants.gyro + grade.gyro * random.standard_normal(rates.shape),
    )


def _interval_mean(column: Array, step: int) -> Array:
    """Return the mean of each `step` records that end at a sample; the first has only itself."""
    rest = column[1 : len(column) - (len(column) - 1) % step]
    return np.concatenate([column[:1], rest.reshape(-1, step, column.shape[1]).mean(axis=1)])


def _attitude(truth: Truth, grade: Grade, random: Generator) -> Attitude:
    at = _every(truth, "attitude")
    angles = truth.attitude[at]
    error = markov(random, len(angles), 3, grade.attitude_time * RATES["attitude"])
    angles = angles + grade.attitude * error
    angles[:, 2] %= 2.0 * math.pi
    rates = truth.rates[at]
    # The reference has taken the gyro's bias out already; its noise remains.
    return Attitude(truth.t[at], angles, rates + grade.gyro * random.standard_normal(rates.shape))


def _static(truth: Truth, grade: Grade, constants: Constants, random: Generator) -> Static:
    at = _every(truth, "static")
    altitude = atmosphere.pressure_altitude(truth.pressure[at]) + constants.altimeter
    altitude = altitude + grade.altitude * random.standard_normal(len(altitude))
    if grade.altitude_step:
        altitude = np.round(altitude / grade.altitude_step) * grade.altitude_step
    temperature = truth.temperature[at] + grade.temperature * random.standard_normal(len(altitude))
    return Static(truth.t[at], atmosphere.pressure(altitude), altitude, temperature)


def _pitot(truth: Truth, grade: Grade, constants: Constants, random: Generator) -> Pitot:
    at = _every(truth, "pitot")
    impact = atmosphere.impact_pressure(truth.airspeed[at], truth.pressure[at], truth.temperature[at])
    airspeed = atmosphere.calibrated_airspeed(impact) * (1.0 + constants.airspeed_scale)
    airspeed = airspeed + grade.airspeed * random.standard_normal(len(airspeed))
    return Pitot(truth.t[at], atmosphere.impact_of_calibrated(airspeed), airspeed)


def _gnss(truth: Truth, grade: Grade, latency: float, random: Generator) -> tuple[Fixes, Array]:
    """Return the receiver's solutions, and the slow part of their error at every sample (N, 3) NED (m)."""
    t = truth.t[_every(truth, "gnss")]
    per_axis = grade.position * np.array([1.0, 1.0, VERTICAL])
    slow = markov(random, len(t), 3, grade.position_time * RATES["gnss"])
    slow *= per_axis * math.sqrt(1.0 - grade.position_white)
    white = per_axis * math.sqrt(grade.position_white) * random.standard_normal((len(t), 3))
    noise = grade.velocity * random.standard_normal((len(t), 3))
    # A late solution keeps the stamp of its arrival and describes where the aircraft was before.
    seen = t - round(latency * 1e9)
    known = seen >= truth.t[0]

    def then(column: Array) -> Array:
        # Linear between 50 Hz records: half a millimetre at 1 g.
        return np.interp(seen, truth.t, column)

    velocity = np.stack([then(truth.velocity[:, axis]) for axis in range(3)], axis=1) + noise
    position = displace(then(truth.latitude), then(truth.longitude), then(truth.altitude), slow + white)
    fixes = Fixes(t, *position, velocity)
    return Fixes(*(column[known] for column in fixes)), slow


def _navigation(truth: Truth, grade: Grade, slow: Array, random: Generator) -> Fixes:
    """Return the vehicle's own filter: it averages white noise away and follows everything slower."""
    at = _every(truth, "navigation")
    t = truth.t[at]
    noise = 0.5 * grade.velocity * markov(random, len(t), 3, 2.0 * RATES["navigation"])
    position = displace(truth.latitude[at], truth.longitude[at], truth.altitude[at], slow)
    return Fixes(t, *position, truth.velocity[at] + noise)


def markov(random: Generator, n: int, axes: int, samples: float) -> Array:
    """Return first-order Gauss-Markov noise of unit variance (n, axes).

    x_{k+1} = a x_k + sqrt(1 - a^2) w_k with a = exp(-1 / samples); `samples` is the correlation time in samples, and 0
    gives white noise.
    """
    noise = random.standard_normal((n, axes))
    if samples > 0.0:
        a = math.exp(-1.0 / samples)
        for k in range(1, n):
            noise[k] = a * noise[k - 1] + math.sqrt(1.0 - a * a) * noise[k]
    return noise


def displace(latitude: Array, longitude: Array, altitude: Array, offset: Array) -> tuple[Array, Array, Array]:
    """Return latitude, longitude (rad) and altitude (m) moved by `offset` (N, 3) NED (m) on WGS-84."""
    w2 = 1.0 - ECCENTRICITY2 * np.sin(latitude) ** 2
    east = EQUATOR / np.sqrt(w2)  # prime vertical
    north = east * (1.0 - ECCENTRICITY2) / w2  # meridian
    return (
        latitude + offset[:, 0] / (north + altitude),
        longitude + offset[:, 1] / ((east + altitude) * np.cos(latitude)),
        altitude - offset[:, 2],
    )
