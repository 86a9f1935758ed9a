"""UDP: telemetry in datagrams.

``udpin`` listens and answers those that it has heard within a minute; ``udpout`` calls a station that listens and
introduces itself with a heartbeat once a second, because over UDP the far end cannot know where to send before it has
heard from us.
"""

from __future__ import annotations

import errno
import socket
import struct
import time
from selectors import EVENT_READ, BaseSelector
from typing import Any

from telemetry.sources.endpoint import Endpoint, resolve
from telemetry.sources.port import Journal

RECEIVE_BUFFER = 8 << 20
LARGEST = 65_535
HELLO = 1.0  # s
REMEMBERED = 60.0  # s after which a sender that is silent is no longer answered
SENDERS = 16  # those heard last are answered: a flood of invented ones must not use up the memory
ABSENT = 0.1  # s without sending after the far end's machine has said that nobody listens
SO_RCVBUFFORCE = getattr(socket, "SO_RCVBUFFORCE", 33)
SO_MEMINFO, DROPS = 55, 8  # Linux: nine counters of a socket, and the place of the datagrams dropped


def open_port(
    endpoint: Endpoint, link: int, selector: BaseSelector, journal: Journal, *, two_way: bool, ground: bool
) -> UdpPort:
    """Open ``udpin`` or ``udpout`` (`telemetry.sources.port.open_port`)."""
    return UdpPort(endpoint, link, selector, journal, two_way=two_way, ground=ground)


class UdpPort:
    """A socket; both a `telemetry.sources.port.Port` and its only `Channel`."""

    stream = False

    def __init__(
        self, endpoint: Endpoint, link: int, selector: BaseSelector, journal: Journal, *, two_way: bool, ground: bool
    ) -> None:
        self.link = link
        self.origin: object = None
        self.closed = False
        self.kernel_drops = 0
        self._endpoint, self._selector, self._journal, self._two_way = endpoint, selector, journal, two_way
        self._heard: dict[Any, float] = {}
        self._calls = endpoint.scheme == "udpout"
        self._hello = _heartbeat() if self._calls and not ground else b""
        self._next_hello = self._next_count = self._absent = 0.0
        self._socket = _open(endpoint)
        self._peer = self._socket.getpeername() if self._calls else None
        selector.register(self._socket, EVENT_READ, self)

    def read(self) -> bytes | None:
        """The next datagram; None when there is none, or the network says that there will be none for now."""
        try:
            if self._two_way:
                piece, self.origin = self._socket.recvfrom(LARGEST)
                return piece
            return self._socket.recv(LARGEST)
        except BlockingIOError:
            return None
        except OSError as error:  # e.g. the far end's network is gone: it may come back, and other links are there
            self._complain(error)
            return None

    def flush(self) -> None:
        """Nothing is ever kept to be written."""

    def heard(self, origin: object) -> None:
        """Answer `origin`; of many, those heard last."""
        if not self._calls:
            self._heard.pop(origin, None)
            self._heard[origin] = time.monotonic()
            if len(self._heard) > SENDERS:
                del self._heard[next(iter(self._heard))]

    def send(self, unit: bytes, origin: object) -> None:
        """One datagram to whom it calls, or to each that it has heard lately."""
        if self._calls:
            if origin != self._peer:
                self._put(unit, None)
            return
        if not self._heard:
            self._journal.trouble(f"link {self.link}: not passed on to {self._endpoint}: nobody has been heard there")
        for address in list(self._heard):
            if address != origin:
                self._put(unit, address)

    def tick(self, now: float) -> None:
        """Greet, forget who is silent, and ask the kernel what it dropped, once a second."""
        if self._hello and now >= self._next_hello:
            self._next_hello = now + HELLO
            try:
                self._socket.send(self._hello)
            except OSError:  # nobody there yet
                pass
        if now >= self._next_count:
            self._next_count = now + 1.0
            self._count()
            for address in [one for one, last in self._heard.items() if now - last > REMEMBERED]:
                del self._heard[address]

    def close(self) -> None:
        """Close the socket."""
        if not self.closed:
            self.closed = True
            self._count()
            self._selector.unregister(self._socket)
            self._socket.close()

    def _put(self, unit: bytes, address: Any) -> None:
        to = f"link {self.link}: not passed on to {self._endpoint}"
        if self._absent and time.monotonic() < self._absent:  # each attempt would cost two errors
            self._journal.trouble(f"{to}: nobody listens there")
            return
        try:
            if address is None:
                self._socket.send(unit)
            else:
                self._socket.sendto(unit, address)
        except BlockingIOError:
            self._journal.trouble(f"{to}: the network cannot follow")
        except OSError as error:
            self._complain(error, f"{to}: ")

    def _complain(self, error: OSError, doing: str = "") -> None:
        if error.errno == errno.ECONNREFUSED:
            self._absent = time.monotonic() + ABSENT
        doing = doing or f"link {self.link}: {self._endpoint}: "
        self._journal.trouble(doing + (error.strerror or str(error)))

    def _count(self) -> None:
        """The drops are counted by the socket itself, so that they are known even if nothing comes after them."""
        try:
            counters = self._socket.getsockopt(socket.SOL_SOCKET, SO_MEMINFO, 36)
        except OSError:  # another kernel
            return
        if len(counters) == 36 and (drops := struct.unpack("9I", counters)[DROPS]) > self.kernel_drops:
            text = f"link {self.link}: the kernel dropped {drops - self.kernel_drops} datagrams, {drops} so far: "
            self.kernel_drops = drops
            self._journal.tell("warning", text + "receiving could not follow")


def _open(endpoint: Endpoint) -> socket.socket:
    family, address = resolve(endpoint, socket.SOCK_DGRAM)
    sock = socket.socket(family, socket.SOCK_DGRAM)
    for option in (SO_RCVBUFFORCE, socket.SO_RCVBUF):  # the first needs a privilege
        try:
            sock.setsockopt(socket.SOL_SOCKET, option, RECEIVE_BUFFER)
            break
        except OSError:
            continue
    try:
        if endpoint.scheme == "udpin":
            sock.bind(address)
        else:
            sock.connect(address)
    except OSError as error:
        sock.close()
        why = (
            "the port is in use: another program listens there; stop it or choose another port"
            if error.errno == errno.EADDRINUSE
            else error.strerror or str(error)
        )
        raise OSError(error.errno, f"{endpoint}: {why}") from None
    sock.setblocking(False)
    return sock


def _heartbeat() -> bytes:
    from pymavlink.dialects.v20 import common

    station = common.MAVLink(None, srcSystem=255, srcComponent=common.MAV_COMP_ID_MISSIONPLANNER)
    return bytes(station.heartbeat_encode(common.MAV_TYPE_GCS, common.MAV_AUTOPILOT_INVALID, 0, 0, 0).pack(station))
