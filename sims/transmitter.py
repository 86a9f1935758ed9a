"""Frames onto a real UDP socket at a chosen speed, or into a .tlog."""

from __future__ import annotations

import math
import socket
import struct
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import NamedTuple

from sims import faults as link
from sims.faults import Faults, Frame, Injected

LOOPBACK = "127.0.0.1"

BLOCK = 50
"""Frames between two looks at the send rate."""
BLOCK_TIME = 0.008
"""Least time for a block (s): 6250 frames/s, which a plain receiver reads without losing any in its socket buffer."""

Progress = Callable[[float, int], None]
"""Called about ten times a second with the seconds flown and the datagrams sent."""


class EndpointError(ValueError):
    """An endpoint that cannot be understood or resolved."""


class Sent(NamedTuple):
    """What went out: datagrams, bytes, seconds of flight, wall-clock seconds, and the faults that were injected."""

    datagrams: int
    octets: int
    flown: float
    took: float
    injected: Injected


def parse_endpoint(endpoint: str) -> tuple[str, int]:
    """Return host and port of ``udpout:HOST:PORT``; ``udpout:PORT`` means this machine.

    An IPv6 address stands in brackets, as in ``udpout:[::1]:14550``.

    Raises
    ------
    EndpointError
        Anything else.
    """
    scheme, colon, rest = endpoint.partition(":")
    if scheme != "udpout" or not colon:
        raise EndpointError(f"endpoint {endpoint!r}: a vehicle sends to udpout:HOST:PORT, as in udpout:127.0.0.1:14550")
    host, _, text = rest.rpartition(":")
    host = host.removeprefix("[").removesuffix("]")
    if not (text.isascii() and text.isdigit() and 1 <= int(text) <= 65535):
        raise EndpointError(f"endpoint {endpoint!r}: {text!r} is not a port from 1 to 65535")
    return host or LOOPBACK, int(text)


def send(
    frames: Iterable[Frame],
    endpoint: str,
    speed: float = 1.0,
    faults: str | Faults | None = None,
    progress: Progress | None = None,
) -> Sent:
    """Send frames over UDP, one datagram each, paced by the monotonic clock.

    Parameters
    ----------
    frames : iterable of (int, bytes)
        Vehicle time (ns) and frame.
    endpoint : str
        ``udpout:HOST:PORT``.
    speed : float
        Times real time; ``inf`` is as fast as a receiver can follow.
    faults : str or Faults, optional
        What the link does to the frames.
    progress : callable, optional
        Told how far the flight is.

    Raises
    ------
    EndpointError, FaultError, ValueError
        Before anything is sent.
    OSError
        The network refuses.
    """
    if not speed > 0.0:
        raise ValueError(f"speed is a positive factor on real time, not {speed}")
    host, port = parse_endpoint(endpoint)
    arriving, injected = link.apply(frames, faults)
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
    except OSError as error:
        raise EndpointError(f"endpoint {endpoint!r}: no such host {host!r} ({error.strerror})") from error
    with socket.socket(family, kind, protocol) as udp:
        # Not connected: a vehicle keeps talking when nobody listens, and is not told so by ICMP.
        return _pace(arriving, lambda frame: udp.sendto(frame, address), speed, injected, progress)


def _pace(
    frames: Iterable[Frame], put: Callable[[bytes], int], speed: float, injected: Injected, progress: Progress | None
) -> Sent:
    start = block = told = time.monotonic()
    first: int | None = None
    flown, count, octets = 0.0, 0, 0
    for t, frame in frames:
        if first is None:
            first = t
        flown = (t - first) * 1e-9
        if math.isfinite(speed):
            _sleep_until(start + flown / speed)
        octets += put(frame)
        count += 1
        if count % BLOCK == 0:
            _sleep_until(block + BLOCK_TIME)
            block = time.monotonic()
            if progress is not None and block - told > 0.1:
                told = block
                progress(flown, count)
    if progress is not None:
        progress(flown, count)
    return Sent(count, octets, flown, time.monotonic() - start, injected)


def _sleep_until(deadline: float) -> None:
    ahead = deadline - time.monotonic()
    # Shorter sleeps cost more than they wait.
    if ahead > 2e-4:
        time.sleep(ahead)


_TLOG_TIME = struct.Struct(">Q")


def write_tlog(frames: Iterable[Frame], path: str | Path, start_utc: int) -> int:
    """Write frames as a .tlog and return how many.

    ::

        | time, us UTC, uint64 big-endian | frame | time | frame ...

    Parameters
    ----------
    frames : iterable of (int, bytes)
        Vehicle time (ns) and frame.
    path : str or Path
        Where to.
    start_utc : int
        UTC of the first frame (ns since the Unix epoch).
    """
    count, first = 0, 0
    with Path(path).open("wb") as file:
        for t, frame in frames:
            if not count:
                first = t
            file.write(_TLOG_TIME.pack((start_utc + t - first) // 1000) + frame)
            count += 1
    return count
