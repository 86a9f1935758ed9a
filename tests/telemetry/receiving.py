"""A receiver on real sockets and devices, and what it has handed out."""

from __future__ import annotations

import os
import socket
import threading
import time
import tty

import numpy as np

from telemetry.frames import Frames, join
from telemetry.mavlink import Dialect
from telemetry.sources.receiver import Receiver
from telemetry.sources.tlog import TlogSource

DIALECT = Dialect()
COLUMNS = ("link", "sysid", "compid", "seq", "msgid", "known", "t_rx", "length")
JUNK_COLUMNS = ("junk_length", "junk_t_rx", "junk_link", "junk_corrupt", "junk_refused")


def free_port(kind: socket.SocketKind = socket.SOCK_DGRAM) -> int:
    with socket.socket(socket.AF_INET, kind) as sock:
        sock.bind(("127.0.0.1", 0))
        return sock.getsockname()[1]


def until(true, seconds: float = 10.0) -> None:
    """Wait until it is true; fail if it does not become so."""
    deadline = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < deadline, "it did not happen in time"
        time.sleep(0.002)


class Listening(Receiver):
    """A receiver whose batches are collected while it runs."""

    def __init__(self, *endpoints: str, raw_log=None, **options) -> None:
        self.collected: list[Frames] = []
        self.told: list[tuple[int, str, str]] = []
        super().__init__(endpoints, DIALECT, raw_log, **options)
        self._collector = threading.Thread(target=self._collect)
        self._collector.start()

    def _collect(self) -> None:
        for batch in self.batches():
            if len(batch.data):
                self.collected.append(batch)

    def __enter__(self) -> Listening:
        return self

    def __exit__(self, *error: object) -> None:
        self.stop()
        self._collector.join()
        self.join()
        self.hear()

    def hear(self) -> str:
        """All news so far, a line each."""
        self.told += self.news()
        return "\n".join(text for _, _, text in self.told)

    @property
    def got(self) -> list[bytes]:
        """The frames so far."""
        return [batch.frame(i) for batch in list(self.collected) for i in range(len(batch))]

    @property
    def bytes_in(self) -> int:
        return sum(int(batch.length.sum()) + batch.discarded for batch in list(self.collected))

    def all(self) -> Frames:
        return join(self.collected)


def evidence(frames: Frames) -> tuple:
    """All that is to be the same when the raw log is read again."""
    order = np.argsort(frames.junk_start, kind="stable")
    return (
        [frames.frame(i) for i in range(len(frames))],
        [getattr(frames, name).tolist() for name in COLUMNS],
        [frames.junk(i) for i in order],
        [getattr(frames, name)[order].tolist() for name in JUNK_COLUMNS],
    )


def replay(path, links: int) -> Frames:
    return join(list(TlogSource(path, DIALECT, links=links, trusted=True).batches()))


def in_order(frames: Frames) -> bool:
    return bool((np.diff(frames.t_rx) >= 0).all() and (np.diff(frames.junk_t_rx) >= 0).all())


class Pty:
    """A serial line: `device` is our end of it, and the radio's end can be read and written."""

    def __init__(self) -> None:
        self._radio, ours = os.openpty()
        tty.setraw(ours)
        os.set_blocking(self._radio, False)
        self.device = os.ttyname(ours)
        self._ours = ours

    def write(self, data: bytes) -> None:
        """Everything, however little the line takes at once."""
        done, deadline = 0, time.monotonic() + 10
        while done < len(data):
            assert time.monotonic() < deadline, "nobody reads the line"
            try:
                done += os.write(self._radio, data[done : done + 512])
            except BlockingIOError:
                time.sleep(0.001)

    def read(self) -> bytes:
        try:
            return os.read(self._radio, 65536)
        except BlockingIOError:
            return b""

    def unplug(self) -> None:
        for number in (self._ours, self._radio):
            if number >= 0:
                os.close(number)
        self._ours = self._radio = -1
