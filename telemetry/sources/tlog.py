"""Telemetry logs (.tlog): what a ground station, or our own archive, wrote."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

from telemetry.frames import Frames, TlogScanner
from telemetry.mavlink import Dialect

BLOCK = 1 << 20


class TlogSource:
    """The frames of a .tlog file, in blocks, so that a log of any size passes through bounded memory.

    Parameters
    ----------
    path : str or Path
    dialect : Dialect
    links : int
        Links in the log: more than 1 only for our own raw logs, which keep the link number in the time's lowest bits.
    trusted : bool
        It is known to be a log (a sortie's own), whatever it begins with.
    on_progress : callable, optional
        Called with the number of bytes read so far, after each block.

    Attributes
    ----------
    truncated, discarded : int
        Bytes of a record cut at the end, and of no frame, in what has been read so far.

    Raises
    ------
    FileNotFoundError, IsADirectoryError, PermissionError
        If the file cannot be opened.
    ValueError
        If it is empty, or (not `trusted`) has not one record in its first megabyte.
    """

    def __init__(
        self,
        path: str | Path,
        dialect: Dialect,
        *,
        links: int = 1,
        trusted: bool = False,
        on_progress: Callable[[int], None] | None = None,
    ) -> None:
        self.path = Path(path)
        self.links = ["0", "1", "2", "3"][:links]
        self.size = self.path.stat().st_size
        self.truncated = self.discarded = 0
        self._dialect = dialect
        self._count = links
        self._progress = on_progress
        with self.path.open("rb") as file:
            first = file.read(BLOCK)
        if not first:
            raise ValueError(f"{self.path} is empty: nothing was recorded")
        if not trusted and not TlogScanner(dialect.crc_extra, links).scan(first, final=len(first) == self.size).headers:
            raise ValueError(f"{self.path} is no telemetry log: no MAVLink frame in its first {len(first)} bytes")

    def batches(self) -> Iterator[Frames]:
        """Yield the frames block by block."""
        scanner = TlogScanner(self._dialect.crc_extra, self._count)
        done = 0
        with self.path.open("rb") as file:
            while True:
                block = file.read(BLOCK)
                done += len(block)
                final = len(block) < BLOCK
                frames = scanner.scan(block, final)
                self.discarded += frames.discarded
                if final:
                    self.truncated = frames.pending
                yield frames
                if self._progress:
                    self._progress(done)
                if final:
                    return
