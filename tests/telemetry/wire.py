"""MAVLink frames made by pymavlink, for tests that read them with our own code."""

from __future__ import annotations

from pathlib import Path

from pymavlink.dialects.v20 import ardupilotmega as mavlink

DATA = Path(__file__).resolve().parents[2].parent / "shared" / "data"
LOGS = [
    "copter_2015_4reboots.tlog",
    "sitl_quadplane_uavlogviewer_vtol.tlog",
    "plane_2014_aerobatic_50hz.tlog",
    "plane_swiss_137hz.tlog",
]


class Sender:
    """One component of one vehicle; counts its frames as MAVLink asks."""

    def __init__(self, sysid: int = 1, compid: int = 1, seq: int = 0, *, version: int = 2) -> None:
        self.mav = mavlink.MAVLink(None, srcSystem=sysid, srcComponent=compid)
        self.mav.seq = seq
        self.version = version

    def pack(self, message: mavlink.MAVLink_message) -> bytes:
        frame = bytes(message.pack(self.mav, force_mavlink1=self.version == 1))
        self.mav.seq = (self.mav.seq + 1) % 256
        return frame

    def attitude(self, ms: int, roll: float = 0.1) -> bytes:
        return self.pack(mavlink.MAVLink_attitude_message(ms, roll, 0.2, 0.3, 0.0, 0.0, 0.0))

    def heartbeat(self) -> bytes:
        return self.pack(mavlink.MAVLink_heartbeat_message(1, 3, 0, 0, 4, 3))

    def pressure(self, ms: int, hpa: float) -> bytes:
        return self.pack(mavlink.MAVLink_scaled_pressure_message(ms, hpa, 0.0, 2500))

    def gps(
        self,
        ms: int,
        lat: float,
        lon: float,
        alt: float,
        *,
        fix: int = 3,
        vel: float = 10.0,
        cog: float = 90.0,
        **extra: int,
    ) -> bytes:
        return self.pack(
            mavlink.MAVLink_gps_raw_int_message(
                ms * 1000,
                fix,
                round(lat * 1e7),
                round(lon * 1e7),
                round(alt * 1e3),
                120,
                65535,
                round(vel * 100),
                round(cog * 100),
                10,
                **extra,
            )
        )

    def system_time(self, unix_us: int, ms: int) -> bytes:
        return self.pack(mavlink.MAVLink_system_time_message(unix_us, ms))

    def text(self, text: str, severity: int = 6, **chunk: int) -> bytes:
        return self.pack(mavlink.MAVLink_statustext_message(severity, text.encode(), **chunk))

    def unknown(self) -> bytes:
        """A whole frame of an id that no dialect has."""
        body = bytes([5, 0, 0, self.mav.seq, self.mav.srcSystem, self.mav.srcComponent]) + (15_000_000).to_bytes(
            3, "little"
        )
        self.mav.seq = (self.mav.seq + 1) % 256
        return b"\xfd" + body + b"hello" + b"\x12\x34"


def tlog(frames: list[tuple[int, bytes]]) -> bytes:
    """Frames with their receive times in us, as a telemetry log."""
    return b"".join(us.to_bytes(8, "big") + frame for us, frame in frames)
