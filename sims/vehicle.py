"""A flight as a MAVLink vehicle: frames in time order, on a real socket or in a .tlog.

Units and scales of MAVLink appear here and nowhere else in the room.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sims.sensors import VERTICAL
from sims.transmitter import send, write_tlog
from sims.vocabulary import SATELLITES

if TYPE_CHECKING:
    from sims.faults import Frame
    from sims.flight import Flight
    from sims.sensors import Fixes
    from sims.truth import Array, Times

__all__ = ["frames", "send", "write_tlog"]

AUTOPILOT = 1
"""Component that speaks; its sequence numbers run without gaps."""

FIXED_WING = mavlink.MAV_TYPE_FIXED_WING

IMU_FIELDS = 0b000_111_111
"""HIGHRES_IMU.fields_updated: accelerometers (bits 0..2) and gyros (3..5). The magnetometer (6..8) does not exist."""
STATIC_FIELDS = 0b1101 << 9
"""HIGHRES_IMU.fields_updated: static pressure, pressure altitude, temperature (9, 11, 12)."""
PITOT_FIELDS = 1 << 10
"""HIGHRES_IMU.fields_updated: differential pressure."""

KELVIN = 273.15

DILUTION = (80, 120)
"""GPS_RAW_INT.eph and epv: dilution of precision x 100."""

GPS_EPOCH = 315_964_800
"""Unix time of the GPS epoch (s)."""
LEAP_SECONDS = 18
"""GPS time minus UTC since 2017 (s)."""
WEEK = 604_800_000
"""A GPS week (ms)."""

_Stream = Iterator[tuple[int, Any]]


def frames(flight: Flight, *, sysid: int = 1) -> Iterator[Frame]:
    """Return the flight's MAVLink 2 frames in the order in which the vehicle sends them.

    Pure: the same flight gives the same bytes.

    Parameters
    ----------
    flight : Flight
        What was flown.
    sysid : int
        System number 1..255 of the vehicle.

    Yields
    ------
    t : int
        Vehicle time (ns since boot).
    frame : bytes
        One whole frame.

    Notes
    -----
    HIGHRES_IMU at the rate of the IMU; ATTITUDE, SCALED_PRESSURE, AOA_SSA and GPS_RAW_INT at those of their sensors;
    GPS_INPUT beside GPS_RAW_INT where the receiver reports three components of velocity, which the latter cannot carry;
    GLOBAL_POSITION_INT and VFR_HUD 5 Hz; HEARTBEAT and SYSTEM_TIME 1; STATUSTEXT at boot and for every mark. Pressures
    are float32 hPa on the wire: 0.006 Pa, half a millimetre of height. An angle that is not measured is NaN in
    ATTITUDE.
    """
    if not 1 <= sysid <= 255:
        raise ValueError(f"a MAVLink system number is 1..255, not {sysid}")
    return _frames(flight, sysid)


def _frames(flight: Flight, sysid: int) -> Iterator[Frame]:
    packer = mavlink.MAVLink(None, srcSystem=sysid, srcComponent=AUTOPILOT)
    streams = (
        _heartbeat, _system_time, _text, _imu, _attitude, _pressure, _vanes, _gnss_input, _gnss, _position, _hud,
    )  # fmt: skip
    # Each stream is in time order; at the same instant they speak in the order above, because the merge is stable.
    for t, message in heapq.merge(*(stream(flight) for stream in streams), key=lambda item: item[0]):
        frame = bytes(message.pack(packer))
        packer.seq = (packer.seq + 1) % 256
        yield t, frame


def _seconds(flight: Flight) -> Iterator[int]:
    """Return every whole second of the flight from its first record (ns since boot)."""
    truth = flight.truth
    return iter(range(int(truth.t[0]), int(truth.t[-1]) + 1, 1_000_000_000))


def _heartbeat(flight: Flight) -> _Stream:
    mode = mavlink.MAV_MODE_FLAG_SAFETY_ARMED | mavlink.MAV_MODE_FLAG_STABILIZE_ENABLED
    state = (mavlink.MAV_AUTOPILOT_GENERIC, mode, 0, mavlink.MAV_STATE_ACTIVE, 3)
    for t in _seconds(flight):
        yield t, mavlink.MAVLink_heartbeat_message(FIXED_WING, *state)


def _system_time(flight: Flight) -> _Stream:
    first = int(flight.truth.t[0])
    for t in _seconds(flight):
        yield t, mavlink.MAVLink_system_time_message((flight.start_utc + t - first) // 1000, t // 1_000_000)


def _text(flight: Flight) -> _Stream:
    hello = f"Sortie simulated {flight.aircraft}"
    lines = [(int(flight.truth.t[0]), mavlink.MAV_SEVERITY_INFO, hello)]
    lines += [(mark.t, mavlink.MAV_SEVERITY_NOTICE, mark.text) for mark in flight.marks]
    for t, severity, text in lines:
        yield t, mavlink.MAVLink_statustext_message(severity, text.encode()[:50])


def _imu(flight: Flight) -> _Stream:
    imu, static, pitot = flight.sensors.imu, flight.sensors.static, flight.sensors.pitot
    magnetometer = (0.0, 0.0, 0.0)
    # Air data come more rarely. In between the last values stay in place with their bits unset.
    absolute = _Latest(static.t, static.pressure / 100.0, static.altitude, static.temperature - KELVIN)
    differential = _Latest(pitot.t, pitot.impact / 100.0)
    for t, force, rates in zip(imu.t.tolist(), imu.specific_force.tolist(), imu.rates.tolist(), strict=True):
        (pressure, altitude, temperature), (impact,) = absolute.at(t), differential.at(t)
        fields = IMU_FIELDS | (STATIC_FIELDS if absolute.fresh else 0) | (PITOT_FIELDS if differential.fresh else 0)
        air = (pressure, impact, altitude, temperature)
        yield t, mavlink.MAVLink_highres_imu_message(t // 1000, *force, *rates, *magnetometer, *air, fields)


class _Latest:
    """The latest row of columns at times that only grow; zeros before the first."""

    def __init__(self, t: Times, *columns: Array) -> None:
        self._t = t.tolist()
        self._rows = np.stack(columns, axis=1).tolist()
        self._next = 0
        self._row = [0.0] * len(columns)
        self.fresh = False

    def at(self, t: int) -> list[float]:
        self.fresh = False
        while self._next < len(self._t) and self._t[self._next] <= t:
            self._row, self.fresh = self._rows[self._next], True
            self._next += 1
        return self._row


def _attitude(flight: Flight) -> _Stream:
    reference = flight.sensors.attitude
    rows = zip(reference.t.tolist(), reference.attitude.tolist(), reference.rates.tolist(), strict=True)
    for t, (phi, theta, psi), rates in rows:
        yaw = math.remainder(psi, 2.0 * math.pi)
        yield t, mavlink.MAVLink_attitude_message(t // 1_000_000, phi, theta, yaw, *rates)


def _pressure(flight: Flight) -> _Stream:
    static, pitot = flight.sensors.static, flight.sensors.pitot
    columns = (static.t, static.pressure / 100.0, _hold(pitot.t, pitot.impact, static.t) / 100.0,
               (static.temperature - KELVIN) * 100.0)  # fmt: skip
    for t, absolute, differential, centi in zip(*(column.tolist() for column in columns), strict=True):
        yield t, mavlink.MAVLink_scaled_pressure_message(t // 1_000_000, absolute, differential, round(centi))


def _vanes(flight: Flight) -> _Stream:
    vanes = flight.sensors.vanes
    columns = (vanes.t, np.degrees(vanes.alpha), np.degrees(vanes.beta))
    for t, alpha, beta in zip(*(column.tolist() for column in columns), strict=True):
        yield t, mavlink.MAVLink_aoa_ssa_message(t // 1000, alpha, beta)


def _gnss_input(flight: Flight) -> _Stream:
    grade, first = flight.sensors.grade, int(flight.truth.t[0])
    if not grade.gnss_down:
        return
    dilution = [value / 100.0 for value in DILUTION]
    accuracy = (grade.velocity, grade.position, grade.position * VERTICAL)
    for t, latitude, longitude, altitude, *velocity in _rows(flight.sensors.gnss):
        week, ms = divmod((flight.start_utc + t - first) // 1_000_000 - (GPS_EPOCH - LEAP_SECONDS) * 1000, WEEK)
        where = (_degrees7(latitude), _degrees7(longitude), altitude)
        fix = (ms, week, mavlink.GPS_FIX_TYPE_3D_FIX)
        yield (
            t,
            mavlink.MAVLink_gps_input_message(
                t // 1000, 0, 0, *fix, *where, *dilution, *velocity, *accuracy, SATELLITES
            ),
        )


def _gnss(flight: Flight) -> _Stream:
    grade = flight.sensors.grade
    quality = {
        "h_acc": round(grade.position * 1e3),
        "v_acc": round(grade.position * VERTICAL * 1e3),
        "vel_acc": round(grade.velocity * 1e3),
    }
    for t, latitude, longitude, altitude, north, east, _ in _rows(flight.sensors.gnss):
        where = (_degrees7(latitude), _degrees7(longitude), round(altitude * 1e3))
        speed = round(math.hypot(north, east) * 100.0)
        course = _centidegrees(math.atan2(east, north))
        # No geoid is modelled: height above the ellipsoid is height above the sea.
        yield (
            t,
            mavlink.MAVLink_gps_raw_int_message(
                t // 1000,
                mavlink.GPS_FIX_TYPE_3D_FIX,
                *where,
                *DILUTION,
                speed,
                course,
                SATELLITES,
                where[2],
                **quality,
            ),
        )


def _position(flight: Flight) -> _Stream:
    navigation = flight.sensors.navigation
    for row, psi in zip(_rows(navigation), _heading(flight, navigation), strict=True):
        t, latitude, longitude, altitude, *velocity = row
        # Home is at sea level, as JSBSim's ground is.
        where = (_degrees7(latitude), _degrees7(longitude), round(altitude * 1e3), round(altitude * 1e3))
        speeds = (round(v * 100.0) for v in velocity)
        yield t, mavlink.MAVLink_global_position_int_message(t // 1_000_000, *where, *speeds, _centidegrees(psi))


def _hud(flight: Flight) -> _Stream:
    navigation, pitot = flight.sensors.navigation, flight.sensors.pitot
    airspeed = _hold(pitot.t, pitot.airspeed, navigation.t).tolist()
    throttle = np.interp(navigation.t, flight.truth.t, flight.truth.controls[:, 3]).tolist()
    rows = zip(_rows(navigation), airspeed, throttle, _heading(flight, navigation), strict=True)
    for (t, _, _, altitude, north, east, down), speed, lever, psi in rows:
        heading, percent = round(math.degrees(psi)) % 360, round(lever * 100.0)
        yield t, mavlink.MAVLink_vfr_hud_message(speed, math.hypot(north, east), heading, percent, altitude, -down)


def _heading(flight: Flight, fixes: Fixes) -> list[float]:
    """Return the latest measured heading (rad) at the times of `fixes`; 0 before the first."""
    reference = flight.sensors.attitude
    measured = np.isfinite(reference.attitude[:, 2])
    return [float(psi) for psi in _hold(reference.t[measured], reference.attitude[measured, 2], fixes.t)]


def _hold(t: Times, values: Array, at: Times) -> Array:
    """Return the latest of `values` at the times `at`; 0 before the first."""
    return np.concatenate([[0.0], values])[np.searchsorted(t, at, side="right")]


def _rows(fixes: Fixes) -> Iterator[tuple[Any, ...]]:
    """Yield t, latitude, longitude, altitude, north, east, down as plain Python numbers."""
    columns = (fixes.t, fixes.latitude, fixes.longitude, fixes.altitude, *fixes.velocity.T)
    return zip(*(column.tolist() for column in columns), strict=True)


def _degrees7(angle: float) -> int:
    return round(math.degrees(angle) * 1e7)


def _centidegrees(angle: float) -> int:
    return round(math.degrees(angle) * 100.0) % 36000
