"""The load of a pipeline benchmark: several vehicles on UDP in real time, encoded beforehand.

One flight is simulated and written as frames once. For every vehicle its frames get another system number, what an
autopilot says beside them to fill the rate, sequence numbers and checksums; while sending, nothing is done but to send.
"""

from __future__ import annotations

import json
import socket
import struct
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import fastcrc
import msgspec
import numpy as np
from numpy.typing import NDArray
from pymavlink.dialects.v20 import ardupilotmega as mavlink

Times = NDArray[np.int64]

BURST = 0.002
"""Between two looks at the clock (s)."""
HEAD = 10
"""Bytes of a MAVLink 2 frame before its payload."""
CLOCKS = {
    mavlink.MAVLINK_MSG_ID_SERVO_OUTPUT_RAW: (4, 1_000),
    mavlink.MAVLINK_MSG_ID_VIBRATION: (8, 1_000),
    mavlink.MAVLINK_MSG_ID_RC_CHANNELS: (4, 1_000_000),
    mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED: (4, 1_000_000),
}
"""Bytes and unit (ns) of the time since boot, with which the payload begins, by message."""
STAGGER = 4_300_000_000
"""By how much each vehicle takes off after the one before (ns): their windows do not all close at once."""


class Load(msgspec.Struct, frozen=True, kw_only=True):
    """What is sent.

    Parameters
    ----------
    flight : str
        A .tlog of MAVLink 2 frames without signatures.
    vehicles : int
        System numbers 1 to this.
    rate : float
        Messages per second of all vehicles; what the flight does not reach is filled with what an autopilot says
        beside. 0 adds nothing.
    seconds : float
    ports : tuple of int
        Where to, on this machine; vehicles take them in turn.
    """

    flight: str
    vehicles: int
    rate: float
    seconds: float
    ports: tuple[int, ...]


class Sent(msgspec.Struct, frozen=True, kw_only=True):
    """What went out: datagrams, bytes, seconds, CPU seconds, and how late the sender was at most (s)."""

    datagrams: int
    octets: int
    seconds: float
    cpu: float
    behind: float


class Frames(NamedTuple):
    """Frames and their times (ns) from 0, in order of time; `sender` is the vehicle's place in the row."""

    t: Times
    sender: NDArray[np.int64]
    frame: list[bytes]


def read(path: str | Path, seconds: float) -> tuple[Times, list[bytes]]:
    """Times (ns) from 0 and frames of the beginning of a .tlog."""
    data = Path(path).read_bytes()
    t: list[int] = []
    frames: list[bytes] = []
    at = 0
    while at < len(data):
        (us,) = struct.unpack_from(">Q", data, at)
        end = at + 8 + HEAD + data[at + 9] + 2
        if t and us * 1000 - t[0] >= seconds * 1e9:
            break
        t.append(us * 1000)
        frames.append(data[at + 8 : end])
        at = end
    times = np.array(t, np.int64)
    return times - times[0], frames


def beside() -> list[bytes]:
    """What an autopilot says beside what it measures, one frame each."""
    packer = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    servos = [1500] * 8
    messages = (
        mavlink.MAVLink_servo_output_raw_message(1, 0, *servos),
        mavlink.MAVLink_vibration_message(1, 0.1, 0.2, 0.3, 1, 2, 3),
        mavlink.MAVLink_nav_controller_output_message(1.0, 2.0, 3, 4, 5, 6.0, 7.0, 8.0),
        mavlink.MAVLink_rc_channels_message(1, 16, *servos, *servos, 1500, 1500, 200),
        mavlink.MAVLink_sys_status_message(1, 1, 1, 500, 12000, 100, 50, 0, 0, 0, 0, 0, 0),
        mavlink.MAVLink_local_position_ned_message(1, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0),
    )
    return [bytes(message.pack(packer)) for message in messages]


def boot_clock(t: Times, frames: Sequence[bytes]) -> int:
    """Time since boot, ns, at time 0: from the first frame of the inertial sensors."""
    for at, frame in zip(t.tolist(), frames, strict=True):
        if int.from_bytes(frame[7:10], "little") == mavlink.MAVLINK_MSG_ID_HIGHRES_IMU:
            return int.from_bytes(frame[HEAD : HEAD + 8], "little") * 1000 - int(at)
    return 0


def stamp(body: bytearray, boot: int) -> None:
    """Write the time since boot, ns, into a frame that tells it: one that stood still would tell of reboots."""
    field = CLOCKS.get(int.from_bytes(body[7:10], "little"))
    if field is not None:
        width, unit = field
        body[HEAD : HEAD + width] = (boot // unit).to_bytes(width, "little")


def encode(load: Load) -> Frames:
    """The frames of all vehicles as they are to be sent."""
    t, base = read(load.flight, load.seconds)
    others = beside()
    wanted = round((load.rate / load.vehicles if load.rate else 0.0) * load.seconds) - len(t)
    extra = np.linspace(0, load.seconds * 1e9, max(wanted, 0), endpoint=False).astype(np.int64)
    every, boot = np.concatenate([t, extra]), boot_clock(t, base)
    bodies = [*base, *(others[i % len(others)] for i in range(len(extra)))]
    order = np.argsort(every, kind="stable").tolist()
    extras = {msgid: bytes([kind.crc_extra]) for msgid, kind in mavlink.mavlink_map.items()}
    crc = fastcrc.crc16.mcrf4xx
    frames: list[bytes] = []
    for vehicle in range(1, load.vehicles + 1):
        for sequence, i in enumerate(order):
            body = bytearray(bodies[i][:-2])
            body[4], body[5] = sequence & 255, vehicle
            if i >= len(base):
                stamp(body, boot + int(every[i]))
            msgid = body[7] | body[8] << 8 | body[9] << 16
            checksum = crc(bytes(body[1:]) + extras[msgid], 0xFFFF)
            frames.append(bytes(body) + checksum.to_bytes(2, "little"))
    times = np.sort(every, kind="stable")
    whole = np.concatenate([times + STAGGER * vehicle for vehicle in range(load.vehicles)])
    sender = np.repeat(np.arange(load.vehicles), len(times))
    place = np.argsort(whole, kind="stable")
    return Frames(whole[place], sender[place], [frames[i] for i in place.tolist()])


def send(frames: Frames, ports: Sequence[int]) -> Sent:
    """Send in real time, in short bursts, one datagram each."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp:
        addresses = [("127.0.0.1", ports[i % len(ports)]) for i in range(int(frames.sender.max(initial=0)) + 1)]
        pairs = list(zip(frames.frame, (addresses[i] for i in frames.sender.tolist()), strict=True))
        due, put = frames.t * 1e-9, udp.sendto
        begin, spent = time.monotonic(), time.process_time()
        done, octets, behind = 0, 0, 0.0
        while done < len(pairs):
            now = time.monotonic() - begin
            stop = int(np.searchsorted(due, now, "right"))
            if stop > done:
                behind = max(behind, now - float(due[done]))
            for frame, address in pairs[done:stop]:
                octets += put(frame, address)
            done = stop
            ahead = BURST - (time.monotonic() - begin - now)
            if ahead > 0.0:
                time.sleep(ahead)
        return Sent(
            datagrams=done,
            octets=octets,
            seconds=time.monotonic() - begin,
            cpu=time.process_time() - spent,
            behind=behind,
        )


def main() -> None:
    """Encode the load told on the command line, wait for a line on standard input, send, and print what was sent."""
    frames = encode(msgspec.json.decode(sys.argv[1], type=Load))
    ports = json.loads(sys.argv[1])["ports"]
    print("ready", flush=True)
    sys.stdin.readline()
    print(msgspec.json.encode(send(frames, ports)).decode(), flush=True)


if __name__ == "__main__":
    main()
