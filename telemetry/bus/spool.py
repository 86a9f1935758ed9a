"""What a stage has said so far, on disk: whoever joins late or lost its link reads it there.

The file has no name, so it is gone with its process, however that ends. It lies where temporary files belong
(``TMPDIR``, else ``/var/tmp``, which is a disk where ``/tmp`` may be memory). In memory stays one offset a message,
8 bytes. A record is::

    +---------------+------------+---------+----------+
    | length of all | name's     | schema  | payload  |
    | that follows  | length, u8 |         |          |
    | u32           |            |         |          |
    +---------------+------------+---------+----------+

little-endian; records lie back to back, so that any run of them is one read.
"""

from __future__ import annotations

import os
import struct
import tempfile
import threading
import weakref
from array import array
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

_HEAD = struct.Struct("<IB")


class Run(NamedTuple):
    """Records in a row.

    Parameters
    ----------
    first : int
        Number of the first; the one asked for, or the oldest that is still kept.
    length : int
        How many.
    data : bytes
        The records.
    """

    first: int
    length: int
    data: bytes


class Spool:
    """Numbered records, from 0.

    One thread adds, any thread reads.

    Parameters
    ----------
    limit : int
        Bytes it may take on disk. Beyond it the older half goes.
    folder : Path, optional
        Where the file lies.

    Attributes
    ----------
    count : int
        Records told to it, whether they could be kept or not.
    error : str or None
        Why it keeps nothing any more, e.g. because the disk is full; the space it took is free again by then.
    shortened : int
        How often the older half went.
    """

    def __init__(self, limit: int, folder: Path | None = None) -> None:
        self.count = 0
        self.error: str | None = None
        self.shortened = 0
        self._half = max(limit // 2, 1)
        self._folder = folder
        self._segments: list[_Segment] = []

    @property
    def oldest(self) -> int:
        """Number of the oldest record that is kept; `count` when there is none."""
        segments = self._segments
        return segments[0].base if segments else self.count

    def add(self, schema: str, payload: bytes) -> None:
        """Keep one record; a disk that fails sets `error`, and nothing is raised."""
        if self.error is None:
            name = schema.encode()
            record = _HEAD.pack(1 + len(name) + len(payload), len(name)) + name + payload
            try:
                if not self._segments or self._segments[-1].size >= self._half:
                    self._begin()
                self._segments[-1].add(record)
            except OSError as error:
                self.error = error.strerror or str(error)
                self.close()
        self.count += 1

    def _begin(self) -> None:
        segments = [*self._segments[-1:], _Segment(self.count, self._folder)]
        if len(self._segments) > 1:
            self.shortened += 1
        self._segments = segments  # at once: a reader holds the old list, and with it the files it reads

    def read(self, first: int, last: int, size: int) -> Run:
        """Records from `first` up to but without `last`, at most `size` bytes of them, yet at least one if there is
        one. What is older than all that is kept is skipped.
        """
        segments = self._segments
        first = max(first, segments[0].base if segments else self.count, 0)
        for segment in reversed(segments):
            if first >= segment.base:
                return segment.read(first, last, size)
        return Run(first, 0, b"")

    def close(self) -> None:
        """Give the space back."""
        for segment in self._segments:
            segment.free()
        self._segments = []


class _Segment:
    """One file."""

    def __init__(self, base: int, folder: Path | None) -> None:
        self.base = base
        file = tempfile.TemporaryFile(buffering=0, dir=folder or _folder(), prefix="sortie-")  # noqa: SIM115
        self._close = weakref.finalize(self, file.close)  # with whoever reads it last
        self._lock = threading.Lock()  # nobody reads where it has been closed
        self._file = file
        self._ends = array("q")

    @property
    def size(self) -> int:
        return self._ends[-1] if self._ends else 0

    def add(self, record: bytes) -> None:
        view, position = memoryview(record), self.size
        while view:
            written = os.pwrite(self._file.fileno(), view, position)
            view, position = view[written:], position + written
        self._ends.append(position)  # last: a reader sees only what is there

    def read(self, first: int, last: int, size: int) -> Run:
        begin = first - self.base
        end = min(last - self.base, len(self._ends))
        if begin >= end:
            return Run(first, 0, b"")
        start = self._ends[begin - 1] if begin else 0
        low, high = begin + 1, end  # at least one
        while low < high:
            middle = (low + high + 1) // 2
            if self._ends[middle - 1] - start <= size:
                low = middle
            else:
                high = middle - 1
        with self._lock:
            if not self._close.alive:
                return Run(first, 0, b"")
            data = os.pread(self._file.fileno(), self._ends[low - 1] - start, start)
        return Run(first, low - begin, data)

    def free(self) -> None:
        """Give the space back, at once: the file has no name."""
        with self._lock:
            self._close()


def _folder() -> Path | None:
    disk = Path("/var/tmp")
    return disk if "TMPDIR" not in os.environ and os.access(disk, os.W_OK) else None


def records(data: bytes) -> Iterator[tuple[str, bytes]]:
    """The records of a run: schema and payload of each.

    Raises
    ------
    ValueError
        If it is no run of whole records; those before the damage have been told.
    """
    position = 0
    while position < len(data):
        if position + _HEAD.size > len(data):
            raise ValueError("history breaks off")
        length, name = _HEAD.unpack_from(data, position)
        begin, end = position + _HEAD.size, position + 4 + length
        if end > len(data) or begin + name > end:
            raise ValueError("history breaks off")
        yield data[begin : begin + name].decode("ascii", "replace"), data[begin + name : end]
        position = end
