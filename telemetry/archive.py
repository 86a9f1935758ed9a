"""Raw evidence on disk before anything else happens to it.

``raw.tlog`` is a telemetry log that any MAVLink tool reads, with bytes that were no frame kept in records of their
own (`telemetry.frames`). It is written through to the disk at least once a second, and everything else can be
computed again from it. A long one goes on in ``raw.001.tlog``, ``raw.002.tlog`` and so on: every segment begins with a
record, and the segments end to end are the log.
"""

from __future__ import annotations

import errno
import fcntl
import math
import os
import threading
import time
from collections import deque
from datetime import UTC, datetime
from io import FileIO
from pathlib import Path

import numpy as np
from numba import njit
from numpy.typing import NDArray

from telemetry.frames import HEADER, JUNK, JUNK_HEADER, LONGEST_JUNK, Frames, link_bits
from telemetry.tail import repair, sync_folder

NAME = "raw.tlog"
SEGMENT = 1 << 30
RESERVE = 256_000_000
WAITING = 64 << 20  # bytes of records that wait in memory for the disk
BLOCK = 1 << 18  # bytes of them that are written at once
RETRY = 0.1  # s from a failed write to the next attempt
STUCK = 10.0  # s without a look at the disk that are an alarm
CATCH_UP = 0.01  # s of writing what has waited before the reader of the sockets has its turn again


def segments(path: str | Path) -> list[Path]:
    """The files of a raw log in their order.

    Parameters
    ----------
    path : str or Path
        A sortie folder, or the log's first file.

    Returns
    -------
    list of Path
        Those that exist; empty if there are none.
    """
    path = Path(path)
    path = path / NAME if path.is_dir() else path
    beside = path.parent.iterdir() if path.parent.is_dir() else ()
    found = [p for p in beside if p.name == path.name or _number(p, path)]
    return sorted(found, key=lambda p: _number(p, path))


def missing_segments(path: str | Path) -> list[Path]:
    """Files of a raw log that should be there, because later ones are, and are not; `path` as for `segments`."""
    path = Path(path)
    path = path / NAME if path.is_dir() else path
    existing = segments(path)
    last = _number(existing[-1], path) if existing else 0
    return [p for p in (_segment(path, number) for number in range(last)) if p not in existing]


def _number(segment: Path, first: Path) -> int:
    """The number in a segment's name, 0 if the name is none of a segment."""
    digits = segment.name[len(first.stem) + 1 : len(segment.name) - len(first.suffix)]
    number = int(digits) if digits.isascii() and digits.isdigit() and len(digits) < 10 else 0
    return number if number and segment.name == _segment(first, number).name else 0


def _segment(first: Path, number: int) -> Path:
    return first.with_name(f"{first.stem}.{number:03d}{first.suffix}") if number else first


class RawLog:
    """An append-only raw log.

    `write` and `sync` are for the one thread that receives; a thread of the log's own writes through to the disk and
    looks after the free space, because either may take longer than a socket can wait. Records that the disk does not
    take wait in memory, up to 64 MB, and are written when it does.

    Parameters
    ----------
    path : str or Path
        Must not exist, unless it is to be resumed: evidence is never overwritten.
    links : int
        With more than one link the `link_bits` lowest bits of a record's microseconds are the link number, so receive
        times must be multiples of ``1 << link_bits(links)`` us.
    resume : bool
        Go on with the log if there is one, after its end has been repaired (`telemetry.tail`).
    crc_extra : int16 array, optional
        The dialect's (`telemetry.mavlink.Dialect`), which tells the whole records of a log to be resumed.
    interval : float
        Longest time between two fsyncs, s.
    segment : int
        A segment that would become longer, bytes, is ended before the next batch.
    reserve : int
        Free space of the file system, bytes, below which there is an alarm, and below four times which a warning.

    Attributes
    ----------
    error : str or None
        What is wrong now: records cannot be written, cannot be written through, or the disk is about to be full or
        does not answer.
    warning : str or None
        The disk will be full before long.
    notes : list of str
        What has happened to the evidence and stays true: a repair, a hole, a failed fsync. It only ever grows.
    lost : int
        Bytes that could not be written and were given up.
    unwritten : int
        Bytes that wait in memory for the disk.
    size : int
        Bytes of the log, in all its segments.
    synced : int
        Bytes of it that are on disk for certain.
    synced_at, sync_took : int, float
        When the last fsync ended, ns of Unix time (0: none yet), and how long it took, s.
    repaired : int
        Bytes after the last whole record that have become junk records.
    reached : int
        Receive time of the last record of a log that was resumed, ns: later ones must be later. 0 for a new log.

    Raises
    ------
    FileExistsError
        If `path` exists and is not to be resumed.
    ValueError
        If there are more links than a log tells apart, or `resume` is given without `crc_extra`.
    OSError
        If it cannot be created or repaired, or another process is writing it.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        links: int = 1,
        resume: bool = False,
        crc_extra: NDArray[np.int16] | None = None,
        interval: float = 1.0,
        segment: int = SEGMENT,
        reserve: int = RESERVE,
    ) -> None:
        self._low = (1 << link_bits(links)) - 1 if links > 1 else 0
        self.path = Path(path)
        self.notes: list[str] = []
        self.warning: str | None = None
        self.lost = self.unwritten = self.size = self.synced = self.synced_at = self.repaired = self.reached = 0
        self.sync_took = 0.0
        self._interval, self._limit, self._reserve = max(interval, 0.01), segment, reserve
        self._unkept: str | None = None  # why records cannot be written
        self._unsynced: str | None = None  # why they cannot be written through
        self._full: str | None = None  # how little space is left
        self._told = math.inf  # free space when it was last told
        self._waiting: deque[bytearray] = deque()
        self._hole = [0, 0, 0]  # first and last receive time, ns, and bytes of what was given up
        self._retry_at = 0.0
        self._retired: deque[FileIO] = deque()
        for data in (np.empty(0, np.uint8), np.frombuffer(b"", np.uint8)):  # compile before anything arrives
            none, link = np.empty(0, np.int64), np.empty(0, np.uint8)
            _records(data, none, none, none, link, none, none, none, link, self._low, _MARK)
        existing = segments(self.path)
        if existing and not resume:
            raise FileExistsError(errno.EEXIST, "evidence is never overwritten", str(existing[0]))
        if existing and crc_extra is None:
            raise ValueError(f"{self.path}: resuming needs the dialect's crc_extra, to tell which records are whole")
        self._index = _number(existing[-1], self.path) if existing else 0
        self._file = FileIO(_segment(self.path, self._index), "r+" if existing else "x+")
        try:
            self._lock()
            if existing and crc_extra is not None:
                self._resume(existing, crc_extra, links)
            os.fsync(self._file.fileno())
            sync_folder(self.path.parent)
        except BaseException:
            self._file.close()
            raise
        self._at = self._file.seek(0, os.SEEK_END)
        self.synced = self.size
        self._measured, self._rate = (time.monotonic(), self.size), 0.0
        self._look()
        self._looked = time.monotonic()
        self._syncing, self._closing = threading.Lock(), threading.Event()
        self._thread = threading.Thread(target=self._keep_house, name="sortie-raw-log", daemon=True)
        self._thread.start()

    @property
    def error(self) -> str | None:
        """What is wrong now, None if nothing is."""
        if time.monotonic() - self._looked > STUCK + self._interval and not self._closing.is_set():
            return self._unkept or f"{self.path}: the disk does not answer: raw telemetry may not be on disk"
        return self._unkept or self._unsynced or self._full

    def write(self, frames: Frames) -> None:
        """Append a batch, frames and junk in the order of their arrival.

        Raises
        ------
        ValueError
            If the log is closed.
        """
        if self._file.closed:
            raise ValueError(f"{self.path} is closed")
        records = _records(
            frames.data, frames.start, frames.length, frames.t_rx, frames.link,
            frames.junk_start, frames.junk_length, frames.junk_t_rx, frames.junk_link, self._low, _MARK,
        )  # fmt: skip
        if self._waiting:
            self._write_waiting()
        if len(records) and (self._waiting or not self._append(records.data)):
            self._wait(records.data, frames)

    def sync(self, force: bool = True) -> None:
        """Try again to write what waits for the disk; with `force`, also write through to the disk now."""
        if self._waiting:
            self._write_waiting(force)
        if force:
            self._write_through()

    def close(self) -> None:
        """Write through and close; closing twice is harmless."""
        if self._file.closed:
            return
        self._closing.set()
        self._thread.join()
        self.sync()
        self.lost += self.unwritten
        self._waiting.clear()
        self.unwritten = 0
        self._file.close()

    # What the receiving thread does.

    def _append(self, records: memoryview | bytearray) -> bool:
        """Write whole records at the end of the log; if that fails, it still ends with a whole record."""
        if self._at and self._at + len(records) > self._limit:
            self._begin_segment()
        try:
            self._file.seek(self._at)
            done = 0
            while done < len(records):
                done += self._file.write(memoryview(records)[done:])
        except OSError as error:
            what = "being lost" if self._hole[2] else "waiting in memory"
            self._unkept = f"{self.path}: {error.strerror}: raw telemetry is not being kept, it is {what}"
            self._retry_at = time.monotonic() + RETRY
            try:
                self._file.truncate(self._at)
            except OSError:  # the same disk: the next write goes over it
                pass
            return False
        self._at += len(records)
        self.size += len(records)
        return True

    def _begin_segment(self) -> None:
        """Go on in the next file; if there can be none, in this one."""
        try:
            file = FileIO(_segment(self.path, self._index + 1), "x")
        except OSError:
            return
        self._retired.append(self._file)
        self._index += 1
        self._file, self._at = file, 0
        self._lock()

    def _wait(self, records: memoryview, frames: Frames) -> None:
        """Keep records in memory, or count them as lost."""
        if self._waiting and self.unwritten + len(records) > WAITING:
            times = np.concatenate([frames.t_rx, frames.junk_t_rx])
            self._hole = [self._hole[0] or int(times.min()), int(times.max()), self._hole[2] + len(records)]
            self.lost += len(records)
            return
        if not self._waiting or len(self._waiting[-1]) + len(records) > BLOCK:
            self._waiting.append(bytearray())
        self._waiting[-1] += records
        self.unwritten += len(records)

    def _write_waiting(self, force: bool = False) -> None:
        begin = time.monotonic()
        if not force and begin < self._retry_at:
            return
        while self._waiting and (force or time.monotonic() - begin < CATCH_UP):
            if not self._append(self._waiting[0]):
                return
            self.unwritten -= len(self._waiting.popleft())
        if not self._waiting:
            self._unkept = None
            first, last, lost = self._hole
            if lost:
                self.notes.append(f"{self.path}: {lost} bytes received from {_utc(first)} to {_utc(last)} are lost")
            self._hole = [0, 0, 0]

    # What the log's own thread does.

    def _keep_house(self) -> None:
        due = time.monotonic() + self._interval
        while not self._closing.wait(max(0.0, due - time.monotonic())):
            due = time.monotonic() + self._interval
            self._look()
            if self.synced < self.size:
                self._write_through()
            self._looked = time.monotonic()

    def _write_through(self) -> None:
        with self._syncing:
            begin, size, file = time.monotonic(), self.size, self._file  # in this order: a segment may begin meanwhile
            retired = list(self._retired)
            try:
                for old in retired:
                    os.fsync(old.fileno())
                os.fsync(file.fileno())
                if retired:
                    sync_folder(self.path.parent)
            except OSError as error:
                if not self._unsynced:  # the system may take what it could not write for written from now on
                    self.notes.append(f"{self.path}: fsync failed: bytes {self.synced} to {size} may not be on disk")
                self._unsynced = f"{self.path}: {error.strerror}: raw telemetry may not be on disk"
                return
            for old in retired:
                if old is not file:  # else the next time: a segment has begun since
                    self._retired.remove(old)
                    old.close()
            self._unsynced = None
            self.synced = size
            self.synced_at, self.sync_took = time.time_ns(), time.monotonic() - begin

    def _look(self) -> None:
        """Look after the free space; it is told again when a quarter of it has gone, not every second."""
        now = time.monotonic()
        before, size = self._measured
        if now > before:
            weight = 1 - math.exp((before - now) / 10.0)
            self._rate += weight * ((self.size - size) / (now - before) - self._rate)
        self._measured = now, self.size
        try:
            disk = os.statvfs(self.path.parent)
        except OSError:  # what is wrong is told by the next write
            return
        free = disk.f_bavail * disk.f_frsize
        if free >= 4.4 * self._reserve or (not self._full and not self.warning and free >= 4 * self._reserve):
            self._full, self.warning, self._told = None, None, math.inf
            return
        low = free < self._reserve * (1.1 if self._full else 1.0)
        if free > 0.75 * self._told and low == bool(self._full):
            return
        left = f"{self.path.parent}: {free / 1e6:.0f} MB left"
        if self._rate > 0:
            left += f": about {free / self._rate / 60:.0f} minutes at the present rate"
        self._told = free
        self._full = f"{left}: the disk is about to be full: make room, or end the sortie" if low else None
        self.warning = None if low else f"{left}: make room"

    # Beginnings.

    def _lock(self) -> None:
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise OSError(errno.EBUSY, "another process is writing this log: end it first", str(self.path)) from None
        except OSError:  # a file system without locks
            pass

    def _resume(self, existing: list[Path], crc_extra: NDArray[np.int16], links: int) -> None:
        *earlier, last = existing
        self.repaired, us = repair(last, crc_extra, links, before=earlier[-1] if earlier else None)
        if self.repaired:
            self.notes.append(
                f"{last}: its last {self.repaired} bytes were no whole record, left by a writer that was killed: "
                "they are kept as junk"
            )
        self.reached = (us & ~self._low) * 1000
        self.size = sum(path.stat().st_size for path in existing)


def _utc(t: int) -> str:
    return f"{datetime.fromtimestamp(t * 1e-9, UTC):%Y-%m-%d %H:%M:%S.%f} UTC"


_MARK = np.frombuffer(JUNK, np.uint8)


@njit(cache=True, nogil=True)
def _records(data, start, length, t_rx, link, junk_start, junk_length, junk_t_rx, junk_link, low, mark):  # type: ignore[no-untyped-def]
    """The records of frames and junk, uint8, as they stand in `data`; `low` bits of a time are the link number."""
    size = HEADER * len(start)
    for i in range(len(start)):
        size += length[i]
    for i in range(len(junk_start)):
        size += junk_length[i] + (junk_length[i] + LONGEST_JUNK - 1) // LONGEST_JUNK * JUNK_HEADER
    out = np.empty(size, np.uint8)
    at = 0
    frame = 0
    run = 0
    while frame < len(start) or run < len(junk_start):
        whole = run == len(junk_start) or (frame < len(start) and start[frame] < junk_start[run])
        if whole:
            begin, rest, t, number = start[frame], length[frame], t_rx[frame], link[frame]
            frame += 1
        else:
            begin, rest, t, number = junk_start[run], junk_length[run], junk_t_rx[run], junk_link[run]
            run += 1
        us = t // 1000
        if low:
            us = us & ~low | np.int64(number)
        while rest > 0:
            for k in range(8):
                out[at + k] = us >> (56 - 8 * k) & 0xFF
            at += HEADER
            piece = rest
            if not whole:
                piece = min(rest, LONGEST_JUNK)
                for k in range(len(mark)):
                    out[at + k] = mark[k]
                at += len(mark)
                out[at] = piece & 0xFF
                out[at + 1] = piece >> 8
                at += 2
            for k in range(piece):
                out[at + k] = data[begin + k]
            at += piece
            begin += piece
            rest -= piece
    return out
