"""Inertial sensors and attitude: body axes forward-right-down, specific force, NED to body."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from telemetry.messages import Attitude, Imu
from telemetry.sensors.feeds import Columns, Doubt, Feed, Mask, Refusals, infinite, number, vector

if TYPE_CHECKING:
    from telemetry.sensors.overrides import SensorSettings

STANDARD_GRAVITY = 9.80665
INERTIAL = 0x3F  # fields_updated: accelerometers and gyros
NOT_FINITE = "a value is NaN or infinite"

_FORCE, _RATE = ("xacc", "yacc", "zacc"), ("xgyro", "ygyro", "zgyro")


def _highres_imu(values: NDArray[Any], _: SensorSettings) -> tuple[Refusals, Columns]:
    columns: Columns = {"specific_force": vector(values, _FORCE), "angular_rate": vector(values, _RATE)}
    return [(NOT_FINITE, infinite(columns)), ("all six values are 0", _absent(columns))], columns


def _absent(columns: Columns) -> Mask:
    """Rows of zeros: a sensor that is not there. One that falls freely still has noise."""
    empty = columns["specific_force"][:, 2] == 0.0
    if empty.any():
        empty &= ~(columns["specific_force"].any(axis=1) | columns["angular_rate"].any(axis=1))
    return np.asarray(empty)


def _scaled_imu(values: NDArray[Any], _: SensorSettings) -> tuple[Refusals, Columns]:
    """Milli-g and milliradians per second, in steps of 0.0098 m/s2 and 1 mrad/s.

    The quantisation adds a variance of step^2 / 12, 0.0028 m/s2 and 0.29 mrad/s: far below the noise that the
    estimator is told of a small autopilot's sensors.
    """
    force, rate = vector(values, _FORCE), vector(values, _RATE)
    clipped: Mask = np.asarray(((np.abs(force) >= 32767.0) | (np.abs(rate) >= 32767.0)).any(axis=1))
    columns: Columns = {"specific_force": force, "angular_rate": rate}
    refusals = [("all six values are 0", _absent(columns)), ("a value is at the end of its range", clipped)]
    force *= STANDARD_GRAVITY * 1e-3
    rate *= 1e-3
    return refusals, columns


def _near_one_g(values: NDArray[Any]) -> Mask:
    """Rows whose specific force, read as milli-g, is 0.5 to 1.5 g."""
    square = np.square(vector(values, _FORCE)).sum(axis=1)
    return np.asarray((square > 500.0**2) & (square < 1500.0**2))


COUNTS = Doubt(
    "its specific force has not yet been 0.5 to 1.5 g in 10 rows running (it may be raw counts)", _near_one_g, 10
)


def _attitude(values: NDArray[Any], _: SensorSettings) -> tuple[Refusals, Columns]:
    columns: Columns = {"phi": number(values, "roll"), "theta": number(values, "pitch"), "psi": number(values, "yaw")}
    bad = infinite(columns)
    if bad.any():  # a compass alone knows a heading and nothing else
        bad &= ~(np.isnan(columns["phi"]) & np.isnan(columns["theta"]) & np.isfinite(columns["psi"]))
    return [(NOT_FINITE, bad)], columns


def _attitude_quaternion(values: NDArray[Any], _: SensorSettings) -> tuple[Refusals, Columns]:
    """Quaternion w, x, y, z, NED to body.

    ``repr_offset_q`` turns only what a pilot is shown (a tail-sitter's horizon); the inertial sensors keep the axes of
    the quaternion itself, so it is not applied.
    """
    w, x, y, z = (number(values, name) for name in ("q1", "q2", "q3", "q4"))
    with np.errstate(invalid="ignore", over="ignore"):  # infinities from the wire are no attitude
        square = w * w + x * x + y * y + z * z
        bad = ~((square > 0.5) & (square < 2.0))
        unit = np.where(bad, np.nan, 1.0 / np.sqrt(np.where(bad, 1.0, square)))
        w, x, y, z = w * unit, x * unit, y * unit, z * unit
        return [("the quaternion is not of length 1", bad)], {
            "phi": np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)),
            "theta": np.arcsin(np.clip(2 * (w * y - z * x), -1, 1)),
            "psi": np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)),
        }


IMU_FEEDS = (
    Feed("HIGHRES_IMU", 105, Imu, 0, _highres_imu, "closest to the instrument", "id", (INERTIAL,)),
    Feed("HIL_SENSOR", 107, Imu, 1, _highres_imu, "the sensors of a simulator", "id", (INERTIAL,), sent_to=True),
    Feed("SCALED_IMU", 26, Imu, 2, _scaled_imu, "in steps of 1 mg and 1 mrad/s", 0),
    Feed("RAW_IMU", 27, Imu, 3, _scaled_imu, "its units are mg and mrad/s, by its weight at rest", "id", doubt=COUNTS),
    Feed("SCALED_IMU2", 116, Imu, 3, _scaled_imu, "in steps of 1 mg and 1 mrad/s", 1),
    Feed("SCALED_IMU3", 129, Imu, 3, _scaled_imu, "in steps of 1 mg and 1 mrad/s", 2),
    Feed("ATTITUDE", 30, Attitude, 0, _attitude, "as the autopilot estimates it"),
    Feed("ATTITUDE_QUATERNION", 31, Attitude, 1, _attitude_quaternion, "as the autopilot estimates it"),
)
