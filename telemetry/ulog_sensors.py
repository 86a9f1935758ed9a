"""PX4 topics to SI samples: which one feeds which sensor, and which values are no measurement.

==========  =======================================  ===============================================================
sensor      topics, the better first                 columns
==========  =======================================  ===============================================================
imu         sensor_combined                          gyro_rad, accelerometer_m_s2: means over the interval before
            vehicle_imu                              delta_angle, delta_velocity over their own intervals
            vehicle_angular_velocity, .._acceleration  xyz of both, joined; only where neither of the above is
            sensor_gyro, sensor_accel                x, y, z of both, joined by instance; only where nothing else is:
                                                     neither calibrated nor turned by SENS_BOARD_ROT
attitude    vehicle_attitude                         q, NED to body, w x y z
gnss        vehicle_gps_position, sensor_gps         fix_type (3 or more); lat, lon 1e-7 degrees and alt mm, or
                                                     latitude_deg, longitude_deg and altitude_msl_m; vel_n_m_s..
                                                     unless vel_ned_valid is 0; eph, epv m; s_variance_m_s m/s
altitude    vehicle_air_data, sensor_baro            baro_pressure_pa; pressure, hPa before version 1.14, then Pa
air data    airspeed                                 indicated_airspeed_m_s, negative as it is; confidence 0 is none
            airspeed_validated                       calibrated_airspeed_m_s (equivalent_airspeed_m_s before 1.12)
            differential_pressure                    differential_pressure_pa, only where there is no airspeed
==========  =======================================  ===============================================================

Two topics are joined by the nearest times of their samples, within half the slower interval of the first; a sample
without a partner is left out, and none is interpolated. A sample is dated by `timestamp_sample` where there is one.
Frames are those of PX4: NED, and forward-right-down.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from telemetry.messages import AirData, Altitude, Attitude, Floats, Gnss, Imu, Sample, Times
from telemetry.sensors import ALTIMETER_SIGMA, GNSS_SIGMA, GNSS_VELOCITY_SIGMA, pressure_altitude
from telemetry.sources.logtime import LATEST, NEVER, judge
from telemetry.sources.onboard import Columns, Stream, nearest

US = 1_000
DELAY = 1_000_000  # us: a sample is not older than this when it is published
HECTOPASCAL = 2_000.0  # a pressure below this is in hPa: in Pa it would be that of 27 km
PRESSURE = 1e3, 1.2e5
POORER = 1.5  # a receiver's vertical dilution beside its horizontal one, where it does not state it

Good = dict[str, NDArray[np.bool_]]


class Topic:
    """Samples of one instance of a topic, in the order of their times.

    Attributes
    ----------
    name : str
    number : int
        Instance.
    t : int64 array, shape (k,)
        When they were taken, since boot, ns.
    """

    def __init__(self, name: str, number: int, data: dict[str, NDArray[Any]], left_out: Counter[str]) -> None:
        self.name, self.number = name, number
        t = _clock(data)
        good = _dated(t)
        if not good.all():
            left_out[f"{self.called}: its time is damaged or 0"] += int((~good).sum())
        rows = np.flatnonzero(good)
        rows = rows[np.argsort(t[rows], kind="stable")]
        self.t: Times = t[rows]
        self._data = {name: column[rows] for name, column in data.items()}

    def __len__(self) -> int:
        return len(self.t)

    @property
    def called(self) -> str:
        """What it is called in words."""
        return f"{self.name}[{self.number}]" if self.number else self.name

    @property
    def interval(self) -> float:
        """Median time between two samples, s; 0 with fewer than two."""
        steps = np.diff(self.t)
        steps = steps[steps > 0]
        return float(np.median(steps)) * 1e-9 if len(steps) else 0.0

    def column(self, *names: str) -> Floats | None:
        """The first column there is of these."""
        for name in names:
            if name in self._data:
                return np.asarray(self._data[name], np.float64)
        return None

    def needed(self, *names: str) -> Floats:
        """The first column there is of these.

        Raises
        ------
        KeyError
            If there is none.
        """
        column = self.column(*names)
        if column is None:
            raise KeyError(f"no column {' or '.join(names)}")
        return column

    def integers(self, name: str) -> NDArray[np.int64] | None:
        """A column of whole numbers."""
        return self._data[name].astype(np.int64) if name in self._data else None

    def vector(self, name: str, size: int = 3) -> Floats:
        """The columns ``name[0]`` and so on, shape (k, size)."""
        return np.stack([self.needed(f"{name}[{i}]") for i in range(size)], axis=1)


def _clock(data: dict[str, NDArray[Any]]) -> Times:
    stamp = np.minimum(data["timestamp"].astype(np.uint64), np.uint64(LATEST // US + 1)).astype(np.int64)
    if "timestamp_sample" in data:
        sample = np.minimum(data["timestamp_sample"].astype(np.uint64), np.uint64(LATEST // US + 1)).astype(np.int64)
        stamp = np.where((sample > 0) & (sample <= stamp) & (stamp - sample < DELAY), sample, stamp)
    return stamp * US


def _dated(t: Times) -> NDArray[np.bool_]:
    """Rows whose time the times around them confirm."""
    good = np.zeros(len(t), np.bool_)
    state = np.array([NEVER, 0], np.int64)
    none = np.empty(len(t), np.int64)
    judge(np.where(t == 0, -1, t), np.ones(len(t), np.bool_), True, state, none, none.copy(), good)
    return good


def _combined(topic: Topic) -> tuple[Good, Columns]:
    return _inertial(topic.vector("accelerometer_m_s2"), topic.vector("gyro_rad"))


def _inertial(force: Floats, rate: Floats) -> tuple[Good, Columns]:
    finite = np.asarray(np.isfinite(force).all(axis=1) & np.isfinite(rate).all(axis=1))
    return {"not a number": finite}, {"specific_force": force, "angular_rate": rate}


def _increments(topic: Topic) -> tuple[Good, Columns]:
    times = [topic.needed(f"{name}_dt") * 1e-6 for name in ("delta_velocity", "delta_angle")]
    force, rate = (
        topic.vector(name) / np.where(dt > 0, dt, np.nan)[:, None]
        for name, dt in zip(("delta_velocity", "delta_angle"), times, strict=True)
    )
    return _inertial(force, rate)


def _attitude(topic: Topic) -> tuple[Good, Columns]:
    w, x, y, z = topic.vector("q", 4).T
    with np.errstate(invalid="ignore", over="ignore"):
        square = w * w + x * x + y * y + z * z
        return {"no rotation": (square > 0.5) & (square < 2.0)}, {
            "phi": np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)),
            "theta": np.arcsin(np.clip(2 * (w * y - z * x), -1, 1)),
            "psi": np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)),
        }


def _fix(topic: Topic) -> tuple[Good, Columns]:
    k = len(topic)
    if topic.column("latitude_deg") is not None:
        latitude, longitude = topic.needed("latitude_deg"), topic.needed("longitude_deg")
        altitude = topic.needed("altitude_msl_m")
    else:
        latitude, longitude = topic.needed("lat") / 1e7, topic.needed("lon") / 1e7
        altitude = topic.needed("alt") / 1e3
    kind = topic.needed("fix_type")
    with np.errstate(invalid="ignore"):
        exists = (np.abs(latitude) <= 90) & (np.abs(longitude) <= 180) & np.isfinite(altitude)
    solid = (kind >= 3) & (kind <= 8)
    dilution, vertical = (_positive(topic.column(name), 50.0) for name in ("hdop", "vdop"))
    dilution = np.ones(k) if dilution is None else np.where(np.isnan(dilution), 1.0, dilution)
    vertical = POORER * dilution if vertical is None else np.where(np.isnan(vertical), POORER * dilution, vertical)
    sigma = np.stack([GNSS_SIGMA * dilution, GNSS_SIGMA * vertical, np.full(k, GNSS_VELOCITY_SIGMA)], axis=1)
    for i, name in enumerate(("eph", "epv", "s_variance_m_s")):
        stated = _positive(topic.column(name), 1e6)
        if stated is not None:
            sigma[:, i] = np.where(np.isnan(stated), sigma[:, i], stated)
    velocity = np.stack([topic.needed(f"vel_{axis}_m_s") for axis in "ned"], axis=1)
    valid = topic.column("vel_ned_valid")
    if valid is not None:
        velocity[valid == 0] = np.nan
    satellites = topic.integers("satellites_used")
    return {
        "no three-dimensional fix": np.asarray(solid),
        "no place on Earth": np.asarray(exists | ~solid),
        "the same fix again": _new(topic, np.asarray(solid & exists)),
    }, {
        "latitude": np.deg2rad(latitude),
        "longitude": np.deg2rad(longitude),
        "altitude": altitude,
        "velocity": velocity,
        "sigma": sigma,
        "satellites": np.full(k, -1) if satellites is None else satellites,
    }


def _positive(values: Floats | None, most: float) -> Floats | None:
    if values is None:
        return None
    with np.errstate(invalid="ignore"):
        return np.where((values > 0) & (values < most), values, np.nan)


def _new(topic: Topic, usable: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Fixes of another UTC than the one before; 0 is no time."""
    new = np.ones(len(topic), np.bool_)
    utc = topic.integers("time_utc_usec")
    at = np.flatnonzero(usable)
    if utc is not None and len(at):
        new[at[1:]] = (np.diff(utc[at]) != 0) | (utc[at[1:]] == 0)
    return new


def utc(topic: Topic) -> tuple[Times, Times]:
    """Times since boot at which UTC was told with a three-dimensional fix, and that UTC, ns."""
    told, kind, relative = topic.integers("time_utc_usec"), topic.column("fix_type"), "timestamp_time_relative"
    if told is None or kind is None:
        return np.empty(0, np.int64), np.empty(0, np.int64)
    real = (told > 0) & (told < LATEST // US) & (kind >= 3)
    shift = topic.integers(relative)
    t = topic.integers("timestamp")
    assert t is not None
    at = t * US + (0 if shift is None else shift * US)
    return at[real], told[real] * US


def _air_data(topic: Topic) -> tuple[Good, Columns]:
    return _altimeter(topic.needed("baro_pressure_pa"))


def _barometer(topic: Topic) -> tuple[Good, Columns]:
    pressure = topic.needed("pressure")
    with np.errstate(invalid="ignore"):
        return _altimeter(np.where(pressure < HECTOPASCAL, pressure * 100.0, pressure))


def _altimeter(pressure: Floats) -> tuple[Good, Columns]:
    with np.errstate(invalid="ignore"):
        real = np.asarray((pressure > PRESSURE[0]) & (pressure < PRESSURE[1]))
    altitude = pressure_altitude(np.where(real, pressure, np.nan))
    sigma = np.full(len(pressure), ALTIMETER_SIGMA)
    return {"no pressure of the atmosphere": real}, {"altitude": altitude, "pressure": pressure, "sigma": sigma}


def _airspeed(topic: Topic) -> tuple[Good, Columns]:
    confidence = topic.column("confidence")
    trusted = np.ones(len(topic), np.bool_) if confidence is None else np.asarray(confidence > 0)
    return _air("not trusted by the autopilot", trusted, topic.needed("indicated_airspeed_m_s"))


def _validated(topic: Topic) -> tuple[Good, Columns]:
    speed = topic.needed("calibrated_airspeed_m_s", "equivalent_airspeed_m_s", "indicated_airspeed_m_s")
    measured = topic.column("airspeed_sensor_measurement_valid")
    valid = np.ones(len(topic), np.bool_) if measured is None else np.asarray(measured != 0)
    source = topic.column("airspeed_source")  # 1..3: a sensor; anything else is made of other measurements
    if source is not None:
        valid &= (source >= 1) & (source <= 3)
    return _air("not measured", valid, speed)


def _air(why: str, valid: NDArray[np.bool_], speed: Floats) -> tuple[Good, Columns]:
    return {why: valid, "not a number": np.asarray(np.isfinite(speed) | ~valid)}, {
        "airspeed": speed,
        "differential_pressure": np.full(len(speed), np.nan),
    }


def _impact(topic: Topic) -> tuple[Good, Columns]:
    pressure = topic.needed("differential_pressure_pa", "differential_pressure_filtered_pa")
    return {"not a number": np.asarray(np.isfinite(pressure))}, {
        "airspeed": np.full(len(topic), np.nan),
        "differential_pressure": pressure,
    }


class Feed(NamedTuple):
    """A topic that feeds a sensor.

    Attributes
    ----------
    beside : bool
        It is told beside a better one too.
    other : str
        The topic that it is joined with, which has the specific force.
    """

    topic: str
    convert: Callable[[Topic], tuple[Good, Columns]] | None
    beside: bool
    other: str = ""
    columns: tuple[str, str] = ("", "")  # of the angular rate and of the specific force


_XYZ = "xyz[0] xyz[1] xyz[2]", "xyz[0] xyz[1] xyz[2]"
FEEDS: dict[type[Sample], tuple[Feed, ...]] = {
    Imu: (
        Feed("sensor_combined", _combined, True),
        Feed("vehicle_imu", _increments, True),
        Feed("vehicle_angular_velocity", None, False, "vehicle_acceleration", _XYZ),
        Feed("sensor_gyro", None, False, "sensor_accel", ("x y z", "x y z")),
    ),
    Attitude: (Feed("vehicle_attitude", _attitude, True),),
    Gnss: (Feed("vehicle_gps_position", _fix, True), Feed("sensor_gps", _fix, True)),
    Altitude: (Feed("vehicle_air_data", _air_data, True), Feed("sensor_baro", _barometer, True)),
    AirData: (
        Feed("airspeed", _airspeed, True),
        Feed("airspeed_validated", _validated, True),
        Feed("differential_pressure", _impact, False),
    ),
}
TOPICS = frozenset(name for feeds in FEEDS.values() for feed in feeds for name in (feed.topic, feed.other) if name)


def streams(topics: list[Topic], left_out: Counter[str]) -> tuple[list[Stream], list[str]]:
    """All samples, the better source of each sensor first; and which topics were not used.

    Parameters
    ----------
    topics : list of Topic
    left_out : Counter of str
        Takes what was no measurement, by topic and reason.
    """
    out: list[Stream] = []
    unused: list[str] = []
    for kind, feeds in FEEDS.items():
        instance, best = 0, ""  # the topic that feeds the sensor
        for feed in feeds:
            for topic in sorted((t for t in topics if t.name == feed.topic and len(t)), key=lambda t: t.number):
                if best not in ("", feed.topic) and not feed.beside:
                    unused.append(topic.called)
                    continue
                try:
                    stream = _stream(kind, instance, feed, topic, topics, left_out)
                except KeyError as error:
                    left_out[f"{topic.called}: {error.args[0]}"] += len(topic)
                    continue
                if len(stream.t):
                    out.append(stream)
                    instance, best = instance + 1, best or feed.topic
    return out, unused


def _stream(
    kind: type[Sample], instance: int, feed: Feed, topic: Topic, topics: list[Topic], left_out: Counter[str]
) -> Stream:
    called = topic.called
    if feed.convert is not None:
        good, columns = feed.convert(topic)
    else:
        rate = np.stack([topic.needed(c) for c in feed.columns[0].split()], axis=1)
        force = np.full((len(topic), 3), np.nan)
        for other in topics:
            if other.name == feed.other and other.number == topic.number and len(other):
                at = nearest(topic.t, other.t, max(round(0.5e9 * topic.interval), 1))
                found = np.stack([other.needed(c) for c in feed.columns[1].split()], axis=1)
                force[at >= 0] = found[at[at >= 0]]
                called = f"{called} + {other.called}"
        good, columns = _inertial(force, rate)
        good = {f"no sample of {feed.other} beside it": good["not a number"]}
    good["the same sample again"] = np.concatenate([[True], np.diff(topic.t) > 0])
    for why, those in good.items():
        if not those.all():
            left_out[f"{topic.called}: {why}"] += int((~those).sum())
    fit = np.all(list(good.values()), axis=0)
    t = topic.t[fit]
    return Stream(kind, instance, called, t, t, {name: column[fit] for name, column in columns.items()})
