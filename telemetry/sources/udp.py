"""UDP: telemetry as it arrives.

``udpin:HOST:PORT`` listens; ``udpout:HOST:PORT`` calls a station that listens, and introduces itself with a heartbeat
once a second, because over UDP the far end cannot know where to send before it has heard from us. The host may be
left out (``udpin:14550``): then it is the loopback address, never every interface of the machine.
"""

from __future__ import annotations

import errno
import selectors
import socket
import threading
import time
from collections import deque
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from telemetry.archive import RawLog
from telemetry.frames import Frames, scan_datagrams
from telemetry.mavlink import Dialect

RECEIVE_BUFFER = 8 << 20
TICK = 4_000  # ns: the resolution of receive times in the raw log
BACKLOG = 256 << 20


class Endpoint(NamedTuple):
    """Where to listen or whom to call."""

    scheme: str
    host: str
    port: int

    def __str__(self) -> str:
        return f"{self.scheme}:{self.host}:{self.port}"


def parse_endpoint(text: str) -> Endpoint:
    """Read ``udpin:[HOST:]PORT`` or ``udpout:[HOST:]PORT``.

    Raises
    ------
    ValueError
        If it is neither; the text says what is expected.
    """
    scheme, _, rest = text.partition(":")
    host, _, port = rest.rpartition(":")
    if scheme not in ("udpin", "udpout") or not port.isdigit() or not 0 < int(port) < 65536:
        raise ValueError(
            f"{text!r} is no endpoint: write udpin:HOST:PORT to listen or udpout:HOST:PORT to call, "
            "e.g. udpin:127.0.0.1:14550"
        )
    return Endpoint(scheme, host or "127.0.0.1", int(port))


def _open(endpoint: Endpoint) -> socket.socket:
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    for option in (getattr(socket, "SO_RCVBUFFORCE", 33), socket.SO_RCVBUF):  # the first needs a privilege
        try:
            sock.setsockopt(socket.SOL_SOCKET, option, RECEIVE_BUFFER)
            break
        except OSError:
            continue
    try:
        if endpoint.scheme == "udpin":
            sock.bind((endpoint.host, endpoint.port))
        else:
            sock.connect((endpoint.host, endpoint.port))
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


class UdpSource:
    """Datagrams of one or more endpoints, archived and framed by a thread that nothing downstream can hold up.

    The thread reads, archives and frames; `batches` hands out what it has found. A consumer that falls behind by more
    than 256 MB of telemetry misses batches, which `dropped` counts and the raw log still holds.

    Parameters
    ----------
    endpoints : sequence of str
    dialect : Dialect
    raw_log : RawLog or None
        Where the evidence goes, before it is handed out.
    batch : float
        Longest time a frame waits for others, s.

    Attributes
    ----------
    dropped : int
        Frames in batches that were not handed out.
    troubles : dict of str to int
        What the network complained of, and how often; receiving goes on.

    Raises
    ------
    ValueError
        If an endpoint does not read as one.
    OSError
        If an endpoint cannot be opened, e.g. because the port is in use.
    """

    def __init__(
        self, endpoints: Sequence[str], dialect: Dialect, raw_log: RawLog | None = None, *, batch: float = 0.01
    ) -> None:
        self.endpoints = [parse_endpoint(text) for text in endpoints]
        self.links = [str(i) for i in range(len(self.endpoints))]
        self.dropped = 0
        self.troubles: dict[str, int] = {}
        self._dialect = dialect
        self._raw_log = raw_log
        self._batch = batch
        self._sockets: list[socket.socket] = []
        try:
            self._sockets = [_open(endpoint) for endpoint in self.endpoints]
        except OSError:
            self._close()
            raise
        self._queue: deque[Frames] = deque()
        self._queued = 0
        self._ready = threading.Condition()
        self._stopping = threading.Event()
        self._done = False
        self._failure: Exception | None = None
        self._thread = threading.Thread(target=self._run, name="sortie-receive", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Stop receiving; `batches` ends when it has handed out what was received."""
        self._stopping.set()

    def join(self) -> None:
        """Wait until the receiving thread has ended and the raw log is closed."""
        self._thread.join()

    def batches(self, idle: float | None = None) -> Iterator[Frames]:
        """Yield what has arrived, in order, until `stop`.

        Parameters
        ----------
        idle : float, optional
            Stop by itself when nothing has arrived for so long, s, counted from the first arrival.

        Raises
        ------
        Exception
            What ended the receiving thread, if anything did.
        """
        last: float | None = None
        while True:
            with self._ready:
                if not self._queue and not self._done:
                    self._ready.wait(0.1)
                frames = self._queue.popleft() if self._queue else None
                if frames is not None:
                    self._queued -= len(frames.data)
                elif self._done:
                    break
            if frames is not None:
                last = time.monotonic()
                yield frames
            elif idle is not None and last is not None and time.monotonic() - last > idle:
                self.stop()
        self._thread.join()
        if self._failure:
            raise self._failure

    def _run(self) -> None:
        try:
            self._receive()
        except Exception as error:  # the consumer is told; the thread has nobody to tell
            self._failure = error
        finally:
            self._close()
            if self._raw_log:
                self._raw_log.close()
            with self._ready:
                self._done = True
                self._ready.notify()

    def _receive(self) -> None:
        anchor = time.time_ns() - time.monotonic_ns()  # one anchor: a step of the system clock does not reach us
        selector = selectors.DefaultSelector()
        for link, sock in enumerate(self._sockets):
            selector.register(sock, selectors.EVENT_READ, link)
        calling = [s for s, e in zip(self._sockets, self.endpoints, strict=True) if e.scheme == "udpout"]
        hello = _heartbeat() if calling else b""
        said = -1.0
        last = 0
        pieces: list[tuple[int, int, bytes]] = []
        oldest = 0.0
        while True:
            stopping = self._stopping.is_set()  # what has arrived by now is still taken
            now = time.monotonic()
            if calling and now - said >= 1.0:
                said = now
                for sock in calling:
                    try:
                        sock.send(hello)
                    except OSError:  # nobody there yet
                        pass
            for key, _ in selector.select(0.0 if stopping else self._batch if pieces else 0.05):
                for _ in range(256):  # a busy link must not starve the others
                    datagram = self._read(key.fileobj)
                    if datagram is None:
                        break
                    last = max((time.monotonic_ns() + anchor) // TICK * TICK, last + TICK)
                    if not pieces:
                        oldest = time.monotonic()
                    pieces.append((last, key.data, datagram))
            if pieces and (stopping or time.monotonic() - oldest >= self._batch or len(pieces) >= 1024):
                self._hand_over(pieces)
                pieces = []
            elif self._raw_log:
                self._raw_log.sync(force=False)
            if stopping:
                return

    def _read(self, sock: Any) -> bytes | None:
        """The next datagram; None when there is none, or the network says that there will be none for now."""
        try:
            return bytes(sock.recv(65535))
        except BlockingIOError:
            return None
        except OSError as error:  # e.g. the far end's network is gone: it may come back, and other links are there
            self.troubles[error.strerror or str(error)] = self.troubles.get(error.strerror or str(error), 0) + 1
            return None

    def _hand_over(self, pieces: list[tuple[int, int, bytes]]) -> None:
        data = np.frombuffer(b"".join(piece for _, _, piece in pieces), np.uint8)
        bounds = np.cumsum([0] + [len(piece) for _, _, piece in pieces])
        frames = scan_datagrams(
            data,
            bounds,
            np.array([t for t, _, _ in pieces], np.int64),
            np.array([link for _, link, _ in pieces], np.uint8),
            self._dialect.crc_extra,
        )
        if self._raw_log:
            self._raw_log.write(frames)
        with self._ready:
            if self._queued > BACKLOG:
                self.dropped += len(frames)
            else:
                self._queue.append(frames)
                self._queued += len(frames.data)
            self._ready.notify()

    def _close(self) -> None:
        for sock in self._sockets:
            sock.close()
