"""DataFlash messages to SI samples: which one feeds which sensor, and which values are no measurement.

==========  ============  ==========================================================================================
sensor      messages      columns
==========  ============  ==========================================================================================
imu         IMU (2, 3)    AccX.. m/s2, specific force; GyrX.. rad/s; body axes forward-right-down; GH, AH: 0 = sick
imu         ACC and GYR   the same where IMU is absent, at the sensor's own rate and time (SampleUS): a gyro sample
                          takes the nearest accelerometer sample of its instance, within `TOGETHER`, or none
attitude    ATT           Roll, Pitch, Yaw, degrees
gnss        GPS (2)       Status (3 or more), Lat, Lng degrees, Alt m, Spd m/s, GCrs degrees, VZ m/s down, HDop, NSats
gnss        GPA           HAcc, VAcc m, SAcc m/s of the fix at the same time; VV: 0 = no vertical velocity
altitude    BARO (BAR2)   Press Pa; Alt is above the take-off place in some versions, so it is not used
air data    ARSP (ASP2)   Airspeed m/s, calibrated by ARSPD_RATIO; H: 0 = unhealthy. DiffPress, Pa, is what the probe
                          felt, without that calibration: a stream of its own beside it, never chosen
flow        AOA           AOA, SSA degrees: derived by the autopilot's filter and no vane, so never chosen
==========  ============  ==========================================================================================

Of several sensors of a kind the column I, or the number in the name of the message, tells which one it is.
"""

from __future__ import annotations

from collections import Counter
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from telemetry.dataflash import Table
from telemetry.messages import AirData, Altitude, Attitude, Floats, FlowAngles, Gnss, Imu, Sample, Times
from telemetry.sensors import ALTIMETER_SIGMA, GNSS_SIGMA, GNSS_VELOCITY_SIGMA, pressure_altitude
from telemetry.sources.onboard import Columns, Stream, last_before, nearest, order

TOGETHER = 2_000_000  # ns: an accelerometer sample further away is not joined with a gyro sample
WAIT = 100_000_000  # ns that a raw gyro sample waits for the accelerometer's: they are logged in bursts
PRESSURE = 1e3, 1.2e5  # Pa: the static pressure at 30 km and at the Dead Sea
FELT = 10  # no sensor has so high a number: added to the number of an airspeed sensor: what its probe felt
POORER = 1.5  # a receiver's vertical dilution beside its horizontal one, where it does not state it


class Feed(NamedTuple):
    """A message that feeds a sensor."""

    kind: type[Sample]
    instance: int
    units: dict[str, str]  # of its columns, as a log may declare them


_INERTIAL = {"AccX": "m/s/s", "AccY": "m/s/s", "AccZ": "m/s/s", "GyrX": "rad/s", "GyrY": "rad/s", "GyrZ": "rad/s"}
_FIX = {"Lat": "deglatitude", "Lng": "deglongitude", "Alt": "m", "Spd": "m/s", "GCrs": "degheading", "VZ": "m/s"}
_AIR = {"Airspeed": "m/s", "DiffPress": "Pa"}
FEEDS: dict[str, Feed] = {
    "IMU": Feed(Imu, 0, _INERTIAL),
    "IMU2": Feed(Imu, 1, _INERTIAL),
    "IMU3": Feed(Imu, 2, _INERTIAL),
    "GYR": Feed(Imu, 0, _INERTIAL),
    "ATT": Feed(Attitude, 0, {"Roll": "deg", "Pitch": "deg", "Yaw": "degheading"}),
    "GPS": Feed(Gnss, 0, _FIX),
    "GPS2": Feed(Gnss, 1, _FIX),
    "BARO": Feed(Altitude, 0, {"Press": "Pa"}),
    "BAR2": Feed(Altitude, 1, {"Press": "Pa"}),
    "BAR3": Feed(Altitude, 2, {"Press": "Pa"}),
    "ARSP": Feed(AirData, 0, _AIR),
    "ASP2": Feed(AirData, 1, _AIR),
    "AOA": Feed(FlowAngles, 0, {"AOA": "deg", "SSA": "deg"}),
}
HELPERS: dict[str, dict[str, str]] = {"ACC": _INERTIAL, "GPA": {"HAcc": "m", "VAcc": "m", "SAcc": "m/s"}, "GPA2": {}}


class Rows:
    """Messages of one layout with their times.

    Attributes
    ----------
    table : Table
    t, t_rx : int64 array, shape (k,)
        ns.
    """

    __slots__ = ("t", "t_rx", "table")

    def __init__(self, table: Table, t: Times, t_rx: Times) -> None:
        self.table, self.t, self.t_rx = table, t, t_rx

    def __len__(self) -> int:
        return len(self.t)

    def column(self, *names: str) -> Floats | None:
        """The first column there is of these, as numbers; None if there is none."""
        for name in names:
            if name in self.table and self.table.values[name].dtype.kind in "iuf" and self.table.values[name].ndim == 1:
                return np.asarray(self.table.column(name), np.float64)
        return None

    def vector(self, *names: str) -> Floats | None:
        """Three columns side by side, shape (k, 3)."""
        columns = [column for name in names if (column := self.column(name)) is not None]
        return np.stack(columns, axis=1) if len(columns) == len(names) else None

    def instance(self) -> NDArray[np.int64]:
        """Which of several sensors each message is about."""
        told = self.column("I")
        first = FEEDS[self.table.layout.name].instance if self.table.layout.name in FEEDS else 0
        return np.full(len(self), first) if told is None else told.astype(np.int64)

    def select(self, rows: Any) -> Rows:
        """Some of the messages."""
        return Rows(self.table.select(rows), self.t[rows], self.t_rx[rows])


class Unfit(ValueError):
    """A message has not the columns of a sensor."""


def label(name: str, instance: int, numbered: bool) -> str:
    """What a sensor is called: ``IMU[1]`` by its column, ``IMU2`` by its name."""
    return f"{name}[{instance}]" if numbered else name


class Sensors:
    """Turns the messages of one boot into samples.

    Attributes
    ----------
    left_out : Counter of str
        Messages that were no measurement, by message and reason.
    """

    def __init__(self, left_out: Counter[str], inertial: str) -> None:
        self.left_out = left_out
        self._inertial = inertial  # what feeds the imu: "IMU" or "GYR"
        self._fix: dict[int, tuple[float, float]] = {}  # week and time of the last fix, by receiver
        self._force: dict[int, list[Rows]] = {}  # the last accelerometer samples, by instance

    def streams(self, rows: dict[str, list[Rows]]) -> list[Stream]:
        """Samples of all sensors, from messages that are complete up to some time.

        Parameters
        ----------
        rows : dict of str to list of Rows
            By the name of the message.
        """
        out: list[Stream] = []
        for name, feed in FEEDS.items():
            if feed.kind is Imu and name.startswith("IMU") != (self._inertial == "IMU"):
                continue
            for part in rows.get(name, []):
                numbers = part.instance()
                for instance in np.unique(numbers).tolist():
                    if not 0 <= instance < FELT:
                        self.left_out[f"{name}: there is no sensor of such a number"] += int(
                            (numbers == instance).sum()
                        )
                        continue
                    mine = part if (numbers == instance).all() else part.select(numbers == instance)
                    mine = mine.select(order(mine.t, mine.t_rx))
                    called = label(name, instance, "I" in part.table)
                    out += self._samples(name, feed.kind, instance, called, mine, rows)
        return out

    def _samples(
        self, name: str, kind: type[Sample], instance: int, called: str, mine: Rows, rows: dict[str, list[Rows]]
    ) -> list[Stream]:
        try:
            if name == "GYR":
                keep, columns = self._rates(mine, instance, rows.get("ACC", []))
            elif kind is Gnss:
                accuracies = rows.get("GPA" if instance == 0 or "I" in mine.table else "GPA2", [])
                keep, columns = self._fixes(mine, instance, accuracies)
            else:
                keep, columns = {
                    Imu: _inertial,
                    Attitude: _attitude,
                    Altitude: _altitude,
                    AirData: _air,
                    FlowAngles: _flow,
                }[kind](mine)
        except Unfit as error:
            self.left_out[f"{called}: {error}"] += len(mine)
            return []
        for why, good in keep.items():
            bad = int((~good).sum())
            if bad:
                self.left_out[f"{called}: {why}"] += bad
        fit = np.all(list(keep.values()), axis=0)
        t = _sampled(mine) if name == "GYR" else mine.t
        columns = {c: v[fit] for c, v in columns.items()}
        out = [Stream(kind, instance, called, t[fit], mine.t_rx[fit], columns, kind is not FlowAngles)]
        if kind is AirData and (pressure := mine.column("DiffPress")) is not None:
            felt = {"airspeed": np.full(fit.sum(), np.nan), "differential_pressure": pressure[fit]}
            out.append(Stream(kind, instance + FELT, f"{called}.DiffPress", t[fit], mine.t_rx[fit], felt, False))
        return out

    def _rates(self, gyro: Rows, instance: int, forces: list[Rows]) -> tuple[dict[str, NDArray[np.bool_]], Columns]:
        """Angular rates with the specific force that was measured beside them."""
        parts = list(self._force.get(instance, []))
        for part in forces:
            numbers = part.instance()
            parts.append(part.select(numbers == instance))
        parts = [p for p in parts if len(p)]
        rate = gyro.vector("GyrX", "GyrY", "GyrZ")
        if rate is None:
            raise Unfit("not the columns of an angular rate")
        force = np.full((len(gyro), 3), np.nan)
        if parts:
            found = [p.vector("AccX", "AccY", "AccZ") for p in parts]
            if any(f is None for f in found):
                raise Unfit("not the columns of a specific force")
            times = np.concatenate([_sampled(p) for p in parts])
            by_time = np.argsort(times, kind="stable")
            at = nearest(_sampled(gyro), times[by_time], TOGETHER)
            force[at >= 0] = np.concatenate([f for f in found if f is not None])[by_time[at[at >= 0]]]
            newest = max(int(p.t[-1]) for p in parts)
            self._force[instance] = [recent for p in parts if len(recent := p.select(p.t > newest - 3 * WAIT))]
        keep = {
            "no accelerometer sample beside it": np.isfinite(force).all(axis=1),
            "not a number": np.isfinite(rate).all(axis=1),
        }
        return keep, {"specific_force": force, "angular_rate": rate}

    def _fixes(self, rows: Rows, instance: int, accuracies: list[Rows]) -> tuple[dict[str, NDArray[np.bool_]], Columns]:
        needed = {name: rows.column(name) for name in ("Status", "Lat", "Lng", "Alt", "Spd", "GCrs")}
        if any(column is None for column in needed.values()):
            raise Unfit("not the columns of a satellite fix")
        status, latitude, longitude, altitude, speed, course = (c for c in needed.values() if c is not None)
        down, dilution, satellites = rows.column("VZ"), rows.column("HDop"), rows.column("NSats")
        k = len(rows)
        dilution = np.ones(k) if dilution is None else np.where((dilution > 0) & (dilution < 50), dilution, 1.0)
        sigma = np.stack(
            [GNSS_SIGMA * dilution, GNSS_SIGMA * POORER * dilution, np.full(k, GNSS_VELOCITY_SIGMA)], axis=1
        )
        down = np.full(k, np.nan) if down is None else down.copy()
        for part in accuracies:
            part = part.select(part.instance() == instance) if "I" in part.table else part
            part = part.select(np.argsort(part.t, kind="stable"))
            if not len(part):
                continue
            at = last_before(rows.t, part.t)
            same = (at >= 0) & (part.t[at] == rows.t)
            for i, name in enumerate(("HAcc", "VAcc", "SAcc")):
                stated = part.column(name)
                if stated is not None:
                    known = same & (stated[at] > 0)  # 0: the receiver does not know
                    sigma[known, i] = stated[at[known]]
            vertical = part.column("VV")
            if vertical is not None:
                down[same & (vertical[at] == 0)] = np.nan
        finite = np.isfinite(latitude) & np.isfinite(longitude) & np.isfinite(altitude)
        with np.errstate(invalid="ignore"):
            exists = finite & (np.abs(latitude) <= 90) & (np.abs(longitude) <= 180)
        solid = np.asarray((status >= 3) & (status <= 8))
        angle = np.deg2rad(course)
        keep = {
            "no three-dimensional fix": solid,
            "no place on Earth": np.asarray(exists | ~solid),
            "the same fix again": self._new(rows, instance, solid & exists) | ~(solid & exists),
        }
        return keep, {
            "latitude": np.deg2rad(latitude),
            "longitude": np.deg2rad(longitude),
            "altitude": altitude,
            "velocity": np.stack([speed * np.cos(angle), speed * np.sin(angle), down], axis=1),
            "sigma": sigma,
            "satellites": np.full(k, -1) if satellites is None else satellites.astype(np.int64),
        }

    def _new(self, rows: Rows, instance: int, usable: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Fixes of another time than the one before: a receiver's last fix may be logged again. 0 is no time."""
        new = np.ones(len(rows), np.bool_)
        week, ms = gps_time(rows)
        at = np.flatnonzero(usable)
        if week is None or ms is None or not len(at):
            return new
        week, ms = week[at], ms[at]
        before = self._fix.get(instance, (-1.0, -1.0))
        new[at] = (
            (np.concatenate([[before[0]], week[:-1]]) != week)
            | (np.concatenate([[before[1]], ms[:-1]]) != ms)
            | ((week == 0) & (ms == 0))
        )
        self._fix[instance] = float(week[-1]), float(ms[-1])
        return new


def gps_time(rows: Rows) -> tuple[Floats | None, Floats | None]:
    """GPS week and ms of the week; TimeMS is the latter in logs in which T is the time since boot."""
    old = "T" in rows.table
    return rows.column("GWk", "Week"), rows.column("GMS", "TimeMS") if old else rows.column("GMS")


def _sampled(rows: Rows) -> Times:
    """When raw inertial samples were taken: before they were logged, by at most a second."""
    sampled, logged = rows.column("SampleUS"), rows.column("TimeUS")
    if sampled is None or logged is None:
        return rows.t
    return rows.t + np.clip(np.nan_to_num((sampled - logged) * 1e3), -1e9, 0).astype(np.int64)


def _healthy(rows: Rows, *names: str) -> NDArray[np.bool_]:
    flag = rows.column(*names)
    return np.ones(len(rows), np.bool_) if flag is None else np.asarray(flag != 0)


def _inertial(rows: Rows) -> tuple[dict[str, NDArray[np.bool_]], Columns]:
    force, rate = rows.vector("AccX", "AccY", "AccZ"), rows.vector("GyrX", "GyrY", "GyrZ")
    if force is None or rate is None:
        raise Unfit("not the columns of an inertial sensor")
    healthy = _healthy(rows, "GH", "GyHlt") & _healthy(rows, "AH", "AcHlt")
    finite = np.isfinite(force).all(axis=1) & np.isfinite(rate).all(axis=1)
    return {"unhealthy": healthy, "not a number": finite | ~healthy}, {"specific_force": force, "angular_rate": rate}


def _attitude(rows: Rows) -> tuple[dict[str, NDArray[np.bool_]], Columns]:
    angles = rows.vector("Roll", "Pitch", "Yaw")
    if angles is None:
        raise Unfit("not the columns of an attitude")
    phi, theta, psi = np.deg2rad(angles).T
    psi = np.where(psi > np.pi, psi - 2 * np.pi, psi)  # 0..360 degrees in the log
    finite: NDArray[np.bool_] = np.asarray(np.isfinite(angles).all(axis=1))
    return {"not a number": finite}, {"phi": phi, "theta": theta, "psi": psi}


def _altitude(rows: Rows) -> tuple[dict[str, NDArray[np.bool_]], Columns]:
    pressure = rows.column("Press")
    if pressure is None:
        raise Unfit("no static pressure")
    healthy = _healthy(rows, "H", "Health")
    real = (pressure > PRESSURE[0]) & (pressure < PRESSURE[1])
    altitude = pressure_altitude(np.where(real, pressure, np.nan))
    return {"unhealthy": healthy, "no pressure of the atmosphere": real | ~healthy}, {
        "altitude": altitude,
        "pressure": pressure,
        "sigma": np.full(len(rows), ALTIMETER_SIGMA),
    }


def _air(rows: Rows) -> tuple[dict[str, NDArray[np.bool_]], Columns]:
    airspeed = rows.column("Airspeed")
    if airspeed is None:
        raise Unfit("no airspeed")
    healthy = _healthy(rows, "H", "Health")
    return {"unhealthy": healthy, "not a number": np.asarray(np.isfinite(airspeed) | ~healthy)}, {
        "airspeed": airspeed,
        "differential_pressure": np.full(len(rows), np.nan),
    }


def _flow(rows: Rows) -> tuple[dict[str, NDArray[np.bool_]], Columns]:
    angles = [rows.column(name) for name in ("AOA", "SSA")]
    alpha, beta = (np.full(len(rows), np.nan) if a is None else np.where(np.abs(a) <= 90, a, np.nan) for a in angles)
    return {"no angle": np.isfinite(alpha) | np.isfinite(beta)}, {"alpha": np.deg2rad(alpha), "beta": np.deg2rad(beta)}
