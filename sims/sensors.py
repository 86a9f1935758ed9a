"""Truth -> what the sensors say: biases, scale errors, noise and latency, each sensor at its own rate and place.

How good they are is in `sims.grades`. Every sensor draws from its own random stream, so that a change to one leaves the
errors of the others as they were.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, TypeVar

import numpy as np

from sims import atmosphere, earth, points
from sims.grades import GRADES, Arms, Grade, SensorError, find, rig
from sims.truth import Array, Times, Truth

__all__ = ["GRADES", "Grade", "SensorError", "find", "sense"]

Generator = np.random.Generator

VERTICAL = 1.5
"""How much worse GNSS height is than a horizontal axis."""

NAMES = ("imu", "attitude", "static", "pitot", "vanes", "gnss", "navigation")
"""The sensors that can be late or drop out."""

Dropout = tuple[str, float, float]
"""Sensor, and when it falls silent and speaks again: seconds from the first record."""


class Imu(NamedTuple):
    """Strapdown sensors: t (N,) ns since boot, specific force (N, 3) m/s2, rates (N, 3) rad/s, body axes.

    A sample is the mean over the time since the sample before it, as an integrating IMU gives it.
    """

    t: Times
    specific_force: Array
    rates: Array


class Attitude(NamedTuple):
    """An attitude reference: t (N,) ns, attitude (N, 3) phi, theta, psi rad (psi 0..2 pi), rates (N, 3) rad/s.

    An angle that is not measured at a time is NaN there.
    """

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


class Vanes(NamedTuple):
    """Flow angles at the boom: t (N,) ns, alpha and beta (N,) rad."""

    t: Times
    alpha: Array
    beta: Array


class Fixes(NamedTuple):
    """Positions: t (N,) ns, latitude and longitude (N,) rad, altitude (N,) m, velocity (N, 3) m/s NED."""

    t: Times
    latitude: Array
    longitude: Array
    altitude: Array
    velocity: Array


class Constants(NamedTuple):
    """Errors that stay the same over the flight, for comparison with what an estimator finds.

    Measured = true x (1 + scale) + bias, for accelerometers (3,), gyros (3,), altimeter, airspeed and vanes (2,).
    """

    accelerometer: Array
    gyro: Array
    altimeter: float
    airspeed_scale: float
    vane_offset: Array
    vane_scale: Array
    accelerometer_scale: Array


@dataclasses.dataclass(frozen=True, slots=True)
class Sensors:
    """Everything the sensors said in one flight.

    Attributes
    ----------
    grade : Grade
        Declared quality.
    arms : Arms
        Where they sit.
    latencies : dict of str to float
        Age of a sample at its time stamp (s), of the sensors that are late.
    dropouts : tuple of (str, float, float)
        Sensor, begin and end of its silences (s from the first record).
    imu, attitude, static, pitot, vanes : Imu, Attitude, Static, Pitot, Vanes
        Columns.
    gnss : Fixes
        Receiver's solution.
    navigation : Fixes
        The vehicle's own filter: it follows the slow part of the GNSS error, so it is not independent of `gnss`.
    constants : Constants
        The constant errors that were drawn.
    """

    grade: Grade
    arms: Arms
    latencies: dict[str, float]
    dropouts: tuple[Dropout, ...]
    imu: Imu
    attitude: Attitude
    static: Static
    pitot: Pitot
    vanes: Vanes
    gnss: Fixes
    navigation: Fixes
    constants: Constants


def sense(
    truth: Truth,
    grade: str | Grade = "mems",
    *,
    seed: int = 1,
    arms: Arms | None = None,
    latencies: Mapping[str, float] | None = None,
    dropouts: Sequence[Dropout] = (),
) -> Sensors:
    """Return what sensors of this grade say about `truth`; the same seed gives the same errors.

    Parameters
    ----------
    truth : Truth
        What was flown.
    grade : str or Grade
        How good the sensors are.
    seed : int
        Of all errors.
    arms : Arms, optional
        Where the sensors sit; where the grade has them in the aircraft that flew, by default.
    latencies : dict of str to float, optional
        Seconds by which the samples of a sensor are older than their stamps.
    dropouts : sequence of (str, float, float)
        Sensor, and when it falls silent and speaks again (s from the first record, by the stamps).

    Raises
    ------
    SensorError
        Unknown grade or sensor, a negative latency, a dropout that ends before it begins, or a sensor rate that does
        not divide the truth's record rate.
    """
    late, silent = dict(latencies or {}), tuple((str(name), float(a), float(b)) for name, a, b in dropouts)
    _check(late, silent)
    grade = find(grade)
    arms = rig(grade, truth.aircraft) if arms is None else arms
    streams = [np.random.default_rng(child) for child in np.random.SeedSequence(seed).spawn(8)]
    constant, imu, attitude, static, pitot, gnss, navigation, vanes = streams
    constants = Constants(
        accelerometer=grade.accelerometer_bias * constant.standard_normal(3),
        gyro=grade.gyro_bias * constant.standard_normal(3),
        altimeter=grade.altimeter_offset * float(constant.standard_normal()),
        airspeed_scale=grade.airspeed_scale * float(constant.standard_normal()),
        vane_offset=grade.vane_offset * constant.standard_normal(2),
        vane_scale=grade.vane_scale * constant.standard_normal(2),
        accelerometer_scale=grade.accelerometer_scale * constant.standard_normal(3),
    )
    fixes, slow = _gnss(truth, grade, arms, gnss)
    said: dict[str, Any] = {
        "imu": _imu(truth, grade, constants, arms, imu),
        "attitude": _attitude(truth, grade, attitude),
        "static": _static(truth, grade, constants, arms, static),
        "pitot": _pitot(truth, grade, constants, arms, pitot),
        "vanes": _vanes(truth, grade, constants, arms, vanes),
        "gnss": fixes,
        "navigation": _navigation(truth, grade, slow, navigation),
    }
    for name, columns in said.items():
        said[name] = _heard(truth, columns, late.get(name, 0.0), [(a, b) for who, a, b in silent if who == name])
    return Sensors(grade=grade, arms=arms, latencies=late, dropouts=silent, constants=constants, **said)


def _check(latencies: Mapping[str, float], dropouts: Sequence[Dropout]) -> None:
    for name in [*latencies, *(dropout[0] for dropout in dropouts)]:
        if name not in NAMES:
            raise SensorError(f"unknown sensor {name!r}; known: {', '.join(NAMES)}")
    for name, latency in latencies.items():
        if not (0.0 <= latency < math.inf):
            raise SensorError(f"the latency of {name} is a number of seconds from 0 on, not {latency}")
    for name, start, stop in dropouts:
        if not start < stop:
            raise SensorError(f"the dropout of {name} ends at {stop} s, which is not after its begin at {start} s")


Columns = TypeVar("Columns", bound=tuple[Any, ...])


def _heard(truth: Truth, columns: Columns, latency: float, silences: list[tuple[float, float]]) -> Columns:
    """Stamp samples with the time at which they are there, and leave out those of silences and after the end."""
    if not latency and not silences:
        return columns
    # A late sample describes where the aircraft was before.
    t = columns[0] + round(latency * 1e9)
    seconds = (t - truth.t[0]) * 1e-9
    keep = t <= truth.t[-1]
    for start, stop in silences:
        keep &= ~((seconds >= start) & (seconds < stop))
    return type(columns)(*(column[keep] for column in (t, *columns[1:])))


def _every(truth: Truth, sensor: str, rate: int) -> slice:
    """Return which records a sensor samples."""
    if rate == 0:
        return slice(0, 0, 1)
    step = round(truth.rate) / rate
    if step != int(step) or step < 1:
        raise SensorError(
            f"{sensor} at {rate} Hz does not divide the truth's {truth.rate:.0f} Hz: choose another record rate"
        )
    return slice(None, None, int(step))


def _imu(truth: Truth, grade: Grade, constants: Constants, arms: Arms, random: Generator) -> Imu:
    at = _every(truth, "imu", grade.rates.imu)
    means = points.mean_specific_force(truth, arms.imu), truth.mean_rates
    force, rates = (_interval_mean(column, at.step)[: None if grade.rates.imu else 0] for column in means)
    force = force * (1.0 + constants.accelerometer_scale)
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
    level, heading = (_every(truth, name, getattr(grade.rates, name)) for name in ("attitude", "heading"))
    at = level if grade.rates.attitude >= grade.rates.heading else heading
    angles = truth.attitude[at]
    error = markov(random, len(angles), 3, grade.attitude_time * max(grade.rates.attitude, grade.rates.heading))
    angles = angles + np.array([grade.attitude, grade.attitude, grade.heading]) * error
    angles[:, 2] %= 2.0 * math.pi
    rates = truth.rates[at]
    # The reference has taken the gyro's bias out already; its noise remains.
    rates = rates + grade.gyro * random.standard_normal(rates.shape)
    for axes, own in ((slice(0, 2), level), (slice(2, 3), heading)):
        absent = np.ones(len(truth), np.bool_)
        absent[own] = False
        angles[absent[at], axes] = np.nan
    return Attitude(truth.t[at], angles, rates)


def _static(truth: Truth, grade: Grade, constants: Constants, arms: Arms, random: Generator) -> Static:
    at = _every(truth, "static", grade.rates.static)
    above = points.altitude(truth, arms.imu)[at] - truth.altitude[at]
    altitude = atmosphere.pressure_altitude(truth.pressure[at]) + above + constants.altimeter
    altitude = altitude + grade.altitude * random.standard_normal(len(altitude))
    if grade.altitude_step:
        altitude = np.round(altitude / grade.altitude_step) * grade.altitude_step
    temperature = truth.temperature[at] + grade.temperature * random.standard_normal(len(altitude))
    return Static(truth.t[at], atmosphere.pressure(altitude), altitude, temperature)


def _pitot(truth: Truth, grade: Grade, constants: Constants, arms: Arms, random: Generator) -> Pitot:
    at = _every(truth, "pitot", grade.rates.pitot)
    true, _, _ = (column[at] for column in points.air_data(truth, arms.vanes))
    noise = grade.airspeed * random.standard_normal(len(true))
    if grade.airspeed_is_true:
        # The altimeter's offset is the weather of the day: the air that the static port feels, and no error of it.
        day = atmosphere.pressure_altitude(truth.pressure[at]) + constants.altimeter
        air = atmosphere.pressure(day), atmosphere.standard_temperature(day)
        wrong = true * (1.0 + constants.airspeed_scale) + noise
        airspeed = atmosphere.calibrated_airspeed(atmosphere.impact_pressure(wrong, *air))
    else:
        impact = atmosphere.impact_pressure(true, truth.pressure[at], truth.temperature[at])
        airspeed = atmosphere.calibrated_airspeed(impact) * (1.0 + constants.airspeed_scale) + noise
    return Pitot(truth.t[at], atmosphere.impact_of_calibrated(airspeed), airspeed)


def _vanes(truth: Truth, grade: Grade, constants: Constants, arms: Arms, random: Generator) -> Vanes:
    at = _every(truth, "vanes", grade.rates.vanes)
    _, *angles = (column[at] for column in points.air_data(truth, arms.vanes))
    flow = np.stack(angles, axis=1)
    flow = flow * (1.0 + constants.vane_scale) + constants.vane_offset + grade.vane * random.standard_normal(flow.shape)
    return Vanes(truth.t[at], flow[:, 0].copy(), flow[:, 1].copy())


def _gnss(truth: Truth, grade: Grade, arms: Arms, random: Generator) -> tuple[Fixes, Array]:
    """Return the receiver's solutions, and the slow part of their error at every sample (N, 3) NED (m)."""
    at = _every(truth, "gnss", grade.rates.gnss)
    t = truth.t[at]
    per_axis = grade.position * np.array([1.0, 1.0, VERTICAL])
    slow = markov(random, len(t), 3, grade.position_time * grade.rates.gnss)
    slow *= per_axis * math.sqrt(1.0 - grade.position_white)
    white = per_axis * math.sqrt(grade.position_white) * random.standard_normal((len(t), 3))
    noise = grade.velocity * random.standard_normal((len(t), 3))
    latitude, longitude, altitude = (column[at] for column in points.position(truth, arms.gnss))
    position = earth.displace(latitude, longitude, altitude, slow + white)
    return Fixes(t, *position, points.velocity(truth, arms.gnss)[at] + noise), slow


def _navigation(truth: Truth, grade: Grade, slow: Array, random: Generator) -> Fixes:
    """Return the vehicle's own filter: it averages white noise away and follows everything slower."""
    if grade.rates.navigation and grade.rates.navigation != grade.rates.gnss:
        raise SensorError(
            f"navigation at {grade.rates.navigation} Hz follows GNSS at {grade.rates.gnss} Hz: give both one rate"
        )
    at = _every(truth, "navigation", grade.rates.navigation)
    t = truth.t[at]
    noise = 0.5 * grade.velocity * markov(random, len(t), 3, 2.0 * grade.rates.navigation)
    position = earth.displace(truth.latitude[at], truth.longitude[at], truth.altitude[at], slow[: len(t)])
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
