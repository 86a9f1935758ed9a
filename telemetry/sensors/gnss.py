"""Satellite fixes: only those that the receiver itself calls three-dimensional, each once."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from telemetry.messages import Gnss
from telemetry.sensors.feeds import Columns, Feed, Mask, Refusals, known, number, vector

if TYPE_CHECKING:
    from telemetry.sensors.overrides import SensorSettings

STAMP = "stamp"
"""Column of the receiver's own time of a fix, by which two messages about one fix are known."""

UNKNOWN_ACCURACY = 0xFFFFFFFF


def _refusals(values: NDArray[Any]) -> Refusals:
    fix = values["fix_type"]
    latitude, longitude = np.abs(values["lat"].astype(np.int64)), np.abs(values["lon"].astype(np.int64))
    return [
        ("there is no fix in three dimensions", (fix < 3) | (fix > 8)),
        ("the position does not exist", (latitude > 900_000_000) | (longitude > 1_800_000_000)),
        ("latitude and longitude are 0", (latitude == 0) & (longitude == 0)),
    ]


def _satellites(values: NDArray[Any]) -> NDArray[np.int64]:
    seen = values["satellites_visible"].astype(np.int64)
    return np.where(seen == 255, -1, seen)


def _dilution(values: NDArray[Any]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Horizontal and vertical dilution of precision; on the wire times 100, 0 and 65535 unknown."""
    eph, epv = values["eph"], values["epv"]
    horizontal = np.where((eph == 65535) | (eph == 0), 1.0, eph * 0.01)
    return horizontal, np.where((epv == 65535) | (epv == 0), 1.5 * horizontal, epv * 0.01)


def _place(values: NDArray[Any], altitude: NDArray[np.float64]) -> Columns:
    return {
        "latitude": np.deg2rad(values["lat"] * 1e-7),
        "longitude": np.deg2rad(values["lon"] * 1e-7),
        "altitude": altitude,
    }


def _gps_raw(values: NDArray[Any], settings: SensorSettings) -> tuple[Refusals, Columns]:
    """GPS_RAW_INT and GPS2_RAW: no vertical velocity."""
    horizontal, vertical = _dilution(values)

    def accuracy(name: str, otherwise: NDArray[np.float64] | float) -> NDArray[np.float64]:
        """Accuracies are extension fields: zero means that the sender does not know them."""
        told = values[name]
        return np.where((told > 0) & (told != UNKNOWN_ACCURACY), told * 1e-3, otherwise)

    sigma = np.empty((len(values), 3))
    sigma[:, 0] = accuracy("h_acc", settings.gnss_sigma * horizontal)
    sigma[:, 1] = accuracy("v_acc", settings.gnss_sigma * vertical)
    sigma[:, 2] = accuracy("vel_acc", settings.gnss_velocity_sigma)
    course = values["cog"]
    direction = np.where(course <= 36000, np.deg2rad(course * 1e-2), np.nan)  # 65535 is unknown
    speed = known(values, "vel", 65535, 1e-2)
    velocity = np.empty((len(values), 3))
    velocity[:, 0], velocity[:, 1], velocity[:, 2] = speed * np.cos(direction), speed * np.sin(direction), math.nan
    unsent = (values["alt"] == 0) & (values["v_acc"] == 0) & (values["alt_ellipsoid"] == 0)
    refusals = [*_refusals(values), ("the altitude is 0 and nothing is told of its accuracy", unsent)]
    return refusals, _place(values, values["alt"] * 1e-3) | {
        "velocity": velocity,
        "sigma": sigma,
        "satellites": _satellites(values),
        STAMP: values["time_usec"].astype(np.uint64),
    }


def _gps_input(values: NDArray[Any], settings: SensorSettings) -> tuple[Refusals, Columns]:
    """A fix with all three components of velocity; whatever ``ignore_flags`` leaves out is not measured."""
    flags = values["ignore_flags"]

    def told(name: str, flag: int) -> NDArray[np.float64]:
        value = number(values, name)
        return np.where(((flags & flag) == 0) & np.isfinite(value), value, np.nan)

    def accuracy(name: str, flag: int, otherwise: NDArray[np.float64] | float) -> NDArray[np.float64]:
        value = told(name, flag)
        return np.where(value > 0.0, value, otherwise)

    horizontal = accuracy("hdop", 2, 1.0)
    horizontal = np.where(horizontal < 100.0, horizontal, 1.0)  # 65535 is "unknown" here as well
    vertical = accuracy("vdop", 4, 1.5 * horizontal)
    vertical = np.where(vertical < 100.0, vertical, 1.5 * horizontal)
    sigma = (
        accuracy("horiz_accuracy", 64, settings.gnss_sigma * horizontal),
        accuracy("vert_accuracy", 128, settings.gnss_sigma * vertical),
        accuracy("speed_accuracy", 32, settings.gnss_velocity_sigma),
    )
    altitude = told("alt", 1)
    return [*_refusals(values), ("it has no altitude", np.isnan(altitude))], _place(values, altitude) | {
        "velocity": np.stack([told("vn", 8), told("ve", 8), told("vd", 16)], axis=1),
        "sigma": np.stack(sigma, axis=1),
        "satellites": _satellites(values),
        STAMP: values["time_usec"].astype(np.uint64),
    }


def _hil_gps(values: NDArray[Any], settings: SensorSettings) -> tuple[Refusals, Columns]:
    """A simulator's receiver, with all three components of velocity."""
    horizontal, vertical = _dilution(values)
    sigma = np.empty((len(values), 3))
    sigma[:, 0], sigma[:, 1] = settings.gnss_sigma * horizontal, settings.gnss_sigma * vertical
    sigma[:, 2] = settings.gnss_velocity_sigma
    return _refusals(values), _place(values, values["alt"] * 1e-3) | {
        "velocity": vector(values, ("vn", "ve", "vd"), 1e-2),
        "sigma": sigma,
        "satellites": _satellites(values),
        STAMP: values["time_usec"].astype(np.uint64),
    }


def once(stamp: NDArray[np.uint64], before: int) -> Mask:
    """Fixes whose time is not that of the one before: one fix is one measurement, whoever tells it; 0 is no time."""
    previous = np.concatenate([np.array([before], np.uint64), stamp[:-1]])
    return np.asarray((stamp != previous) | (stamp == 0))


_THREE = "it has all three components of velocity"

GNSS_FEEDS = (
    Feed("GPS_INPUT", 232, Gnss, 0, _gps_input, _THREE, "gps_id", sent_to=True),
    Feed("HIL_GPS", 113, Gnss, 1, _hil_gps, f"a simulator's receiver, {_THREE}", "id", sent_to=True),
    Feed("GPS_RAW_INT", 24, Gnss, 2, _gps_raw, "the receiver's own fix", 0),
    Feed("GPS2_RAW", 124, Gnss, 2, _gps_raw, "the receiver's own fix", 1),
)
