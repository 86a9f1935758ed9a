"""MAVLink columns to SI samples: which message feeds which sensor, in which units, and which values are no measurement.

Several messages can feed one sensor. They are ranked by how close they are to the instrument, and as long as a better
one is heard from a component the lesser ones of that component are not used. Stale but plausible values never
become measurements: a fix below three dimensions, a field that ``fields_updated`` leaves out, a fix repeated under
the same time.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from telemetry.messages import AirData, Altitude, Attitude, FlowAngles, Gnss, Imu, Message

STANDARD_GRAVITY = 9.80665
SEA_LEVEL_PRESSURE = 101325.0
SEA_LEVEL_SOUND = 340.294  # m/s

PATIENCE = 5_000_000_000  # ns without the better message, after which a lesser one is used again
NEVER = -(1 << 62)
STAMP = "stamp"  # the receiver's own time of a fix, by which a repetition is known

GNSS_SIGMA = 2.5  # m, horizontal, per axis, at HDOP 1 when the receiver states no accuracy
GNSS_VELOCITY_SIGMA = 0.3  # m/s
ALTIMETER_SIGMA = 1.0  # m, of a MEMS barometer

Columns = dict[str, NDArray[Any]]


def pressure_altitude(pressure: NDArray[np.float64]) -> NDArray[np.float64]:
    """Altitude in the ICAO standard atmosphere up to 11 km, m, from static pressure, Pa (NaN stays NaN)."""
    return 44330.769 * (1.0 - (pressure / SEA_LEVEL_PRESSURE) ** 0.19026324)


def _calibrated_airspeed(differential: NDArray[np.float64]) -> NDArray[np.float64]:
    """Calibrated airspeed, m/s, of subsonic compressible flow, V = a0 sqrt(5 ((q_c/p0 + 1)^(2/7) - 1)).

    A negative pressure, as at rest, gives a negative airspeed, not a root of it.
    """
    ratio = np.abs(differential) / SEA_LEVEL_PRESSURE
    return np.sign(differential) * SEA_LEVEL_SOUND * np.sqrt(5.0 * np.expm1(2.0 / 7.0 * np.log1p(ratio)))


def _vector(values: NDArray[Any], names: tuple[str, str, str], scale: float) -> NDArray[np.float64]:
    return np.stack([values[name].astype(np.float64) for name in names], axis=1) * scale


def _unless(values: NDArray[Any], unknown: int, scale: float) -> NDArray[np.float64]:
    """Scale integers, with the value that means "unknown" as NaN."""
    return np.where(values == unknown, np.nan, values.astype(np.float64) * scale)


def _updated(values: NDArray[Any], bits: int) -> NDArray[np.bool_]:
    return np.asarray((values["fields_updated"] & bits) == bits)


def _highres_imu(values: NDArray[Any]) -> tuple[NDArray[np.bool_], Columns]:
    columns = {
        "specific_force": _vector(values, ("xacc", "yacc", "zacc"), 1.0),
        "angular_rate": _vector(values, ("xgyro", "ygyro", "zgyro"), 1.0),
    }
    return _updated(values, 0x3F) & _finite(columns), columns


def _scaled_imu(values: NDArray[Any]) -> tuple[NDArray[np.bool_], Columns]:
    return np.ones(len(values), np.bool_), {
        "specific_force": _vector(values, ("xacc", "yacc", "zacc"), STANDARD_GRAVITY * 1e-3),
        "angular_rate": _vector(values, ("xgyro", "ygyro", "zgyro"), 1e-3),
    }


def _attitude(values: NDArray[Any]) -> tuple[NDArray[np.bool_], Columns]:
    names = {"phi": "roll", "theta": "pitch", "psi": "yaw"}
    angles = {name: values[field].astype(np.float64) for name, field in names.items()}
    compass = np.isnan(angles["phi"]) & np.isnan(angles["theta"]) & np.isfinite(angles["psi"])  # knows only a heading
    return _finite(angles) | compass, angles


def _attitude_quaternion(values: NDArray[Any]) -> tuple[NDArray[np.bool_], Columns]:
    w, x, y, z = (values[name].astype(np.float64) for name in ("q1", "q2", "q3", "q4"))
    with np.errstate(invalid="ignore", over="ignore"):  # infinities from the wire are no attitude
        square = w * w + x * x + y * y + z * z
        return (square > 0.5) & (square < 2.0), {
            "phi": np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)),
            "theta": np.arcsin(np.clip(2 * (w * y - z * x), -1, 1)),
            "psi": np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)),
        }


def _altitude(altitude: NDArray[np.float64], pressure: NDArray[np.float64]) -> Columns:
    return {"altitude": altitude, "pressure": pressure, "sigma": np.full(len(altitude), ALTIMETER_SIGMA)}


def _plausible(pressure: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Static pressure, Pa, between the Dead Sea's and that at 30 km; NaN, infinity and zero are none."""
    return np.asarray((pressure > 1e3) & (pressure < 1.2e5))


def _finite(columns: Columns) -> NDArray[np.bool_]:
    """Rows without NaN or infinity."""
    return np.asarray(np.all([np.isfinite(c).reshape(len(c), -1).all(axis=1) for c in columns.values()], axis=0))


def _highres_altitude(values: NDArray[Any]) -> tuple[NDArray[np.bool_], Columns]:
    pressure = np.where(_updated(values, 0x200), values["abs_pressure"].astype(np.float64) * 100.0, np.nan)
    pressure[~_plausible(pressure)] = np.nan
    altitude = np.where(_updated(values, 0x800), values["pressure_alt"].astype(np.float64), pressure_altitude(pressure))
    return np.abs(altitude) < 1e5, _altitude(altitude, pressure)


def _scaled_pressure(values: NDArray[Any]) -> tuple[NDArray[np.bool_], Columns]:
    pressure = values["press_abs"].astype(np.float64) * 100.0
    real = _plausible(pressure)
    return real, _altitude(pressure_altitude(np.where(real, pressure, np.nan)), pressure)


def _vfr_hud(values: NDArray[Any]) -> tuple[NDArray[np.bool_], Columns]:
    airspeed = values["airspeed"].astype(np.float64)
    return np.isfinite(airspeed), {"airspeed": airspeed, "differential_pressure": np.full(len(values), np.nan)}


def _highres_air(values: NDArray[Any]) -> tuple[NDArray[np.bool_], Columns]:
    pressure = values["diff_pressure"].astype(np.float64) * 100.0
    columns = {"airspeed": _calibrated_airspeed(pressure), "differential_pressure": pressure}
    return _updated(values, 0x400) & _finite(columns), columns


def _aoa_ssa(values: NDArray[Any]) -> tuple[NDArray[np.bool_], Columns]:
    """Degrees on the wire; a vane that points backwards, or nowhere, measures nothing."""
    angles = {name: values[field].astype(np.float64) for name, field in (("alpha", "AOA"), ("beta", "SSA"))}
    columns = {name: np.where(np.abs(angle) <= 90.0, np.deg2rad(angle), np.nan) for name, angle in angles.items()}
    return np.isfinite(columns["alpha"]) | np.isfinite(columns["beta"]), columns


def _on_earth(values: NDArray[Any]) -> NDArray[np.bool_]:
    """Rows whose latitude and longitude, 1e-7 degrees, exist."""
    latitude, longitude = (np.abs(values[name].astype(np.int64)) for name in ("lat", "lon"))
    return np.asarray((latitude <= 900_000_000) & (longitude <= 1_800_000_000))


def _gps_raw_int(values: NDArray[Any]) -> tuple[NDArray[np.bool_], Columns]:
    rows = len(values)
    dilution = np.where((values["eph"] == 65535) | (values["eph"] == 0), 1.0, values["eph"] * 0.01)
    vertical = np.where((values["epv"] == 65535) | (values["epv"] == 0), 1.5 * dilution, values["epv"] * 0.01)
    sigma = np.empty((rows, 3))
    # The accuracies are extension fields: zero means that the sender does not know them.
    sigma[:, 0] = np.where(values["h_acc"] > 0, values["h_acc"] * 1e-3, GNSS_SIGMA * dilution)
    sigma[:, 1] = np.where(values["v_acc"] > 0, values["v_acc"] * 1e-3, GNSS_SIGMA * vertical)
    sigma[:, 2] = np.where(values["vel_acc"] > 0, values["vel_acc"] * 1e-3, GNSS_VELOCITY_SIGMA)
    speed = _unless(values["vel"], 65535, 1e-2)
    course = np.deg2rad(_unless(values["cog"], 65535, 1e-2))
    velocity = np.stack([speed * np.cos(course), speed * np.sin(course), np.full(rows, np.nan)], axis=1)
    return (values["fix_type"] >= 3) & (values["fix_type"] <= 8) & _on_earth(values), {
        "latitude": np.deg2rad(values["lat"] * 1e-7),
        "longitude": np.deg2rad(values["lon"] * 1e-7),
        "altitude": values["alt"] * 1e-3,
        "velocity": velocity,
        "sigma": sigma,
        STAMP: values["time_usec"],
        "satellites": np.where(values["satellites_visible"] == 255, -1, values["satellites_visible"].astype(np.int64)),
    }


def _gps_input(values: NDArray[Any]) -> tuple[NDArray[np.bool_], Columns]:
    """A fix with all three components of velocity; whatever ``ignore_flags`` leaves out is not measured."""

    def told(name: str, flag: int, otherwise: NDArray[np.float64] | float = math.nan) -> NDArray[np.float64]:
        value = values[name].astype(np.float64)
        return np.where(((values["ignore_flags"] & flag) == 0) & np.isfinite(value), value, otherwise)

    def accuracy(name: str, flag: int, otherwise: NDArray[np.float64] | float) -> NDArray[np.float64]:
        value = told(name, flag)
        return np.where(value > 0.0, value, otherwise)

    dilution = accuracy("hdop", 2, 1.0)
    dilution = np.where(dilution < 100.0, dilution, 1.0)  # 65535 is "unknown" here as well
    vertical = accuracy("vdop", 4, 1.5 * dilution)
    vertical = np.where(vertical < 100.0, vertical, 1.5 * dilution)
    sigma = np.stack(
        [
            accuracy("horiz_accuracy", 64, GNSS_SIGMA * dilution),
            accuracy("vert_accuracy", 128, GNSS_SIGMA * vertical),
            accuracy("speed_accuracy", 32, GNSS_VELOCITY_SIGMA),
        ],
        axis=1,
    )
    altitude = told("alt", 1)
    return (values["fix_type"] >= 3) & (values["fix_type"] <= 8) & _on_earth(values) & np.isfinite(altitude), {
        "latitude": np.deg2rad(values["lat"] * 1e-7),
        "longitude": np.deg2rad(values["lon"] * 1e-7),
        "altitude": altitude,
        "velocity": np.stack([told("vn", 8), told("ve", 8), told("vd", 16)], axis=1),
        "sigma": sigma,
        STAMP: values["time_usec"],
        "satellites": np.where(values["satellites_visible"] == 255, -1, values["satellites_visible"].astype(np.int64)),
    }


class Feed(NamedTuple):
    """One message that can feed a sensor: of those heard, the lowest rank is used."""

    msgid: int
    kind: type[Message]
    rank: int
    convert: Callable[[NDArray[Any]], tuple[NDArray[np.bool_], Columns]]


FEEDS = (
    Feed(105, Imu, 0, _highres_imu),
    Feed(26, Imu, 1, _scaled_imu),
    Feed(27, Imu, 2, _scaled_imu),
    Feed(30, Attitude, 0, _attitude),
    Feed(31, Attitude, 1, _attitude_quaternion),
    Feed(105, Altitude, 0, _highres_altitude),
    Feed(29, Altitude, 1, _scaled_pressure),
    Feed(105, AirData, 0, _highres_air),
    Feed(74, AirData, 1, _vfr_hud),
    Feed(11020, FlowAngles, 0, _aoa_ssa),
    Feed(232, Gnss, 0, _gps_input),
    Feed(24, Gnss, 1, _gps_raw_int),
)


class Sensors:
    """The sensors of one component of one vehicle.

    Parameters
    ----------
    vehicle : int
    source : str
        ``"link/component"`` for the messages.
    """

    def __init__(self, vehicle: int, source: str) -> None:
        self._vehicle = vehicle
        self._source = source
        self._heard: dict[tuple[type[Message], int], int] = {}  # when each rank was last heard
        self._last_stamp = 0

    def samples(
        self,
        decoded: dict[int, tuple[NDArray[np.int64], NDArray[Any]]],
        t: NDArray[np.int64],
        t_rx: NDArray[np.int64],
        boot: int,
    ) -> list[Message]:
        """What a batch of frames of one boot epoch measures.

        Parameters
        ----------
        decoded : dict of int to (int64 array, structured array)
            Per message id the rows of the batch, in order of arrival, and their payloads.
        t, t_rx : int64 array
            Times of the whole batch, indexed by those rows.
        boot : int

        Returns
        -------
        list of Message
            One per sensor heard, rows in order of arrival.
        """
        messages: list[Message] = []
        for kind in (Imu, Attitude, AirData, FlowAngles, Altitude, Gnss):
            candidates = []
            for feed in FEEDS:
                if feed.kind is kind and feed.msgid in decoded:
                    rows, values = decoded[feed.msgid]
                    valid, columns = feed.convert(values)
                    candidates.append((rows[valid], feed.rank, {name: c[valid] for name, c in columns.items()}))
            candidates = [c for c in candidates if len(c[0])]
            if candidates:
                message = self._merge(kind, candidates, t, t_rx, boot)
                if message is not None:
                    messages.append(message)
        return messages

    def _merge(
        self,
        kind: type[Message],
        candidates: list[tuple[NDArray[np.int64], int, Columns]],
        t: NDArray[np.int64],
        t_rx: NDArray[np.int64],
        boot: int,
    ) -> Message | None:
        rows = np.concatenate([c[0] for c in candidates])
        rank = np.concatenate([np.full(len(c[0]), c[1]) for c in candidates])
        order = np.argsort(rows, kind="stable")
        rows, rank = rows[order], rank[order]
        columns: dict[str, Any] = {
            name: np.concatenate([c[2][name] for c in candidates])[order] for name in candidates[0][2]
        }
        keep = self._best(kind, rank, t_rx[rows])
        columns = {name: column[keep] for name, column in columns.items()}
        rows = rows[keep]
        # Only after the ranking: two messages about one fix carry one stamp, and the better one must not fall to it.
        if STAMP in columns and len(rows):
            new = self._new_fix(columns.pop(STAMP))
            columns = {name: column[new] for name, column in columns.items()}
            rows = rows[new]
        if not len(rows):
            return None
        return kind(vehicle=self._vehicle, source=self._source, boot=boot, t=t[rows], t_rx=t_rx[rows], **columns)

    def _best(self, kind: type[Message], rank: NDArray[np.int64], t_rx: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Rows of whose sensor no better message has been heard for `PATIENCE`."""
        keep = np.ones(len(rank), np.bool_)
        for better in range(int(rank.max()) + 1):
            heard = np.where(rank == better, t_rx, NEVER)
            heard = np.maximum.accumulate(np.maximum(heard, self._heard.get((kind, better), NEVER)))
            self._heard[kind, better] = int(heard[-1])
            keep &= (rank <= better) | (t_rx - heard > PATIENCE)
        return keep

    def _new_fix(self, stamp: NDArray[np.uint64]) -> NDArray[np.bool_]:
        """Receivers repeat a fix until there is a new one: the same time again is no new measurement; 0 is no time."""
        before = np.concatenate([np.array([self._last_stamp], np.uint64), stamp[:-1]])
        self._last_stamp = int(stamp[-1])
        return np.asarray((stamp != before) | (stamp == 0))
