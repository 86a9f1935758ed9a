"""Raw evidence on disk before anything else happens to it.

``raw.tlog`` is a telemetry log that any MAVLink tool reads, with bytes that were no frame kept in records of their
own (`telemetry.frames`). It is written through to the disk at least once a second, and everything else can be
computed again from it.
"""

from __future__ import annotations

import os
import time
from pathlib import Path

from telemetry.frames import Frames, write_junk, write_record


class RawLog:
    """An append-only raw log.

    Parameters
    ----------
    path : str or Path
        Must not exist: evidence is never overwritten.
    links : int
        With more than one link the two lowest bits of a record's microseconds are the link number, so receive times
        must be multiples of 4 us.
    interval : float
        Longest time between two fsyncs, s.

    Attributes
    ----------
    error : str or None
        Why the last write failed; None when the last one succeeded. A failed write loses its records but not the log:
        the file is cut back to its last whole record and the next write tries again.
    lost : int
        Bytes that could not be written.
    size : int
        Bytes written.

    Raises
    ------
    FileExistsError
        If `path` exists.
    ValueError
        If there are more than 4 links.
    """

    def __init__(self, path: str | Path, *, links: int = 1, interval: float = 1.0) -> None:
        if links > 4:
            raise ValueError(f"{links} links: a raw log tells at most 4 apart")
        self.path = Path(path)
        self.error: str | None = None
        self.lost = 0
        self.size = 0
        self._links = links
        self._interval = interval
        self._file = self.path.open("xb", buffering=0)
        self._synced = time.monotonic()
        self._dirty = False

    def write(self, frames: Frames) -> None:
        """Append a batch, frames and junk in the order of their arrival; fsync when one is due."""
        records = [
            (int(frames.start[i]), int(frames.t_rx[i]), int(frames.link[i]), True, i) for i in range(len(frames))
        ]
        records += [
            (int(frames.junk_start[i]), int(frames.junk_t_rx[i]), int(frames.junk_link[i]), False, i)
            for i in range(len(frames.junk_start))
        ]
        records.sort()
        out = bytearray()
        for _, t_rx, link, whole, i in records:
            us = t_rx // 1000 + (link if self._links > 1 else 0)
            out += write_record(us, frames.frame(i)) if whole else write_junk(us, frames.junk(i))
        if out:
            self._append(bytes(out))
        self.sync(force=False)

    def sync(self, force: bool = True) -> None:
        """Write through to the disk: now, or (not `force`) only when the interval has passed."""
        now = time.monotonic()
        if self._dirty and (force or now - self._synced >= self._interval):
            try:
                os.fsync(self._file.fileno())
                self._dirty = False
            except OSError as error:
                self.error = f"{self.path}: {error.strerror}"
            self._synced = now

    def close(self) -> None:
        """Write through and close; closing twice is harmless."""
        if not self._file.closed:
            self.sync()
            self._file.close()

    def _append(self, out: bytes) -> None:
        done = 0
        try:
            while done < len(out):
                done += self._file.write(out[done:])
        except OSError as error:
            self.error = f"{self.path}: {error.strerror}: raw telemetry is not being kept"
            self.lost += len(out)
            try:
                os.ftruncate(self._file.fileno(), self.size)
                self._file.seek(self.size)
            except OSError:  # the same disk: the reader will resynchronise
                pass
            return
        self.error = None
        self.size += len(out)
        self._dirty = True
