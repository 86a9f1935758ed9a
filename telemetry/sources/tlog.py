"""Telemetry logs (.tlog): what a ground station, or our own archive, wrote."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import BinaryIO

from telemetry.archive import NAME, missing_segments, segments
from telemetry.frames import Frames, TlogScanner
from telemetry.mavlink import Dialect

BLOCK = 1 << 20


class TlogSource:
    """The frames of a .tlog file, in blocks, so that a log of any size passes through bounded memory.

    A log that another process is still writing is read to its present end.

    Parameters
    ----------
    path : str, Path or sequence of Path
        A log; several that are one log, in their order (`telemetry.archive.segments`); or a sortie folder, whose raw
        log is read in all its segments, those too that begin while it is read.
    dialect : Dialect
    links : int
        Links in the log: more than 1 only for our own raw logs, which keep the link number in the time's lowest bits.
    trusted : bool
        It is known to be a log (a sortie's own), whatever it begins with.
    on_progress : callable, optional
        Called with the number of bytes read so far, after each block.
    size : int, optional
        Read so many bytes only.

    Attributes
    ----------
    path : Path
        The first file.
    paths : list of Path
        All files.
    size : int
        Bytes to be read, as far as was known when the source was made.
    truncated, discarded : int
        Bytes of a record cut at the end, and of no frame, in what has been read so far.

    Raises
    ------
    FileNotFoundError, IsADirectoryError, PermissionError
        If a file cannot be opened.
    ValueError
        If it is empty, or (not `trusted`) has not one record in its first megabyte, or has more links than a log tells
        apart.
    """

    def __init__(
        self,
        path: str | Path | Sequence[Path],
        dialect: Dialect,
        *,
        links: int = 1,
        trusted: bool = False,
        on_progress: Callable[[int], None] | None = None,
        size: int | None = None,
    ) -> None:
        self._folder = Path(path) if isinstance(path, (str, Path)) and Path(path).is_dir() else None
        if self._folder:
            self.paths = segments(self._folder) or [self._folder / NAME]
        else:
            self.paths = [Path(path)] if isinstance(path, (str, Path)) else [Path(p) for p in path]
        if not self.paths:
            raise ValueError("no telemetry log: an empty list of files")
        self.path = self.paths[0]
        self.links = [str(link) for link in range(links)]
        self.size = sum(p.stat().st_size for p in self.paths)
        self._limit = size
        if size is not None:
            self.size = min(self.size, size)
        self.truncated = self.discarded = 0
        self._dialect = dialect
        self._count = links
        self._progress = on_progress
        scanner = TlogScanner(dialect.crc_extra, links)
        first = b""
        for each in self.paths:
            with each.open("rb") as file:
                first = first or file.read(min(BLOCK, self.size))
        if not first:
            raise ValueError(f"{self.path} is empty: nothing was recorded")
        if not trusted and not scanner.scan(first, final=len(first) == self.size).headers:
            raise ValueError(f"{self.path} is no telemetry log: no MAVLink frame in its first {len(first)} bytes")

    @property
    def missing(self) -> list[Path]:
        """Segments of a sortie's raw log that are not there, although later ones are."""
        return missing_segments(self._folder) if self._folder else []

    def batches(self) -> Iterator[Frames]:
        """Yield the frames block by block."""
        scanner = TlogScanner(self._dialect.crc_extra, self._count)
        done = 0
        held = b""  # one block behind, because the last one is known only when there is no other
        for block in self._blocks():
            if held:
                done += len(held)
                yield self._told(scanner.scan(held), done)
            held = block
        last = scanner.scan(held, final=True)
        self.truncated = last.pending
        yield self._told(last, done + len(held))

    def _told(self, frames: Frames, done: int) -> Frames:
        self.discarded += frames.discarded
        if self._progress:
            self._progress(done)
        return frames

    def _blocks(self) -> Iterator[bytes]:
        """What the files hold, end to end."""
        left = sys.maxsize if self._limit is None else self._limit

        def rest(file: BinaryIO) -> Iterator[bytes]:
            nonlocal left
            while block := file.read(min(BLOCK, left)):
                left -= len(block)
                yield block

        index = 0
        while index < len(self.paths):
            with self.paths[index].open("rb") as file:
                yield from rest(file)
                if self._folder and index + 1 == len(self.paths):
                    self.paths = segments(self._folder)
                    yield from rest(file)  # what was written here before the next one began
            index += 1
