"""Journal: a recording as it grows, and beside it the same rows as they shall last.

Who looks on wants every row at once, so a growing recording consists of many small chunks; a recording that lasts wants
few large ones and, at its end, the index that tools ask for. The index is kept in memory for as long as a file grows,
two kilobytes for each chunk: small chunks would take 50 MB a minute with five vehicles. Hence two files. The one that
bears the name of the recording is written at once and without index; it is there whatever happens. The other gathers
thousands of rows of an entity into a chunk, is a fraction as large, and takes the place of the first in the end.
"""

from __future__ import annotations

import os
import shutil
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr

from telemetry.messages import Floats, Times
from viewer.sink import Sink

ROWS = 8192  # rows, or points of lines, in one chunk of what lasts
PIECES = 64  # that wait side by side before they are laid end to end
PHASES = 64  # entities of one rate fill their chunks in turn, not all at one moment
SUFFIX = ".finishing"
RESERVE = 256 << 20  # bytes of free space below which the disk is left to what grows, and to the raw log


def indexed(path: Path) -> bool:
    """Whether a recording ends with a good index of all that is in it, as ``rerun rrd verify`` demands."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            rr.chunk.RrdReader(path).store()
        except (RuntimeError, ValueError, OSError):
            return False
    return True


def _free(path: Path) -> float:
    """Free space of the disk, bytes; endless where nobody knows."""
    try:
        return shutil.disk_usage(path.parent).free
    except OSError:
        return float("inf")


class _Rows:
    """Rows of one entity that wait to be written together, in `room` of them."""

    def __init__(self, room: int) -> None:
        self._room = room
        self._weight = 0
        self._pieces: list[Sequence[Any]] = []

    def add(self, weight: int, columns: Sequence[Any]) -> bool:
        """Add rows; whether it is full."""
        self._pieces.append(columns)
        self._weight += weight
        if len(self._pieces) >= PIECES:
            self._pieces = [self._joined()]
        return self._weight >= self._room

    def take(self) -> list[Any]:
        """All columns, end to end; nothing waits any more, and all of the room is there."""
        columns = self._joined() if self._pieces else []
        self._room, self._weight, self._pieces = ROWS, 0, []
        return columns

    def _joined(self) -> list[Any]:
        return [
            [row for part in parts for row in part] if isinstance(parts[0], list) else np.concatenate(parts)
            for parts in zip(*self._pieces, strict=True)
        ]


class _Whole:
    """The file that will last, in large chunks."""

    def __init__(self, path: Path, sortie: str, on_alarm: Callable[[str], None]) -> None:
        path.unlink(missing_ok=True)  # left by a process that was killed
        self.sink = Sink(path, sortie, on_alarm)
        self._waiting: dict[tuple[Any, ...], _Rows] = {}

    def add(self, write: Callable[..., None], entity: str, weight: int, *columns: Any) -> None:
        """Rows that a method of a sink is to write."""
        key = write, entity, *(column.shape[1:] for column in columns if isinstance(column, np.ndarray))
        rows = self._waiting.get(key)
        if rows is None:
            rows = self._waiting[key] = _Rows(ROWS * (len(self._waiting) % PHASES + 1) // PHASES)
        if rows.add(weight, columns):
            write(self.sink, entity, *rows.take())

    def write(self) -> None:
        """Write what waits."""
        for (write, entity, *_), rows in self._waiting.items():
            if columns := rows.take():
                write(self.sink, entity, *columns)

    def finish(self, place: Path) -> bool:
        """Write what waits, and the index, and take the place of another file; whether all of that went well."""
        self.write()
        if not self.sink.close() or not indexed(self.sink.path):
            return False
        try:
            with self.sink.path.open("rb") as file:
                os.fsync(file.fileno())
            self.sink.path.replace(place)
        except OSError:
            return False
        return True

    def abandon(self) -> None:
        """Give up and leave the room on the disk to others."""
        self._waiting.clear()
        self.sink.abandon()
        self.sink.path.unlink(missing_ok=True)


class Journal(Sink):
    """A recording that is read while it is written; parameters as of `Sink`.

    It may be broken off at any moment, and is readable to its last whole chunk. When it is closed, a file with the same
    rows in few large chunks and with an index is put in its place at once.
    """

    def __init__(
        self,
        path: Path,
        sortie: str,
        on_alarm: Callable[[str], None],
        *,
        serve: int | None = None,
        join: int | None = None,
    ) -> None:
        self._whole: _Whole | None = None
        self._given_up = False  # what would have lasted, before the end
        super().__init__(path, sortie, on_alarm, serve=serve, join=join, index=False)
        self._whole = _Whole(path.with_name(path.name + SUFFIX), sortie, on_alarm)
        self._blueprint: Any = None

    def scalars(self, entity: str, t: Times, t_rx: Times, values: Floats, window: int | None = None) -> None:
        """Rows of one or several plain numbers."""
        super().scalars(entity, t, t_rx, values, window)
        if self._whole is not None and window is None:
            self._whole.add(Sink.scalars, entity, len(t), t, t_rx, values)
        elif self._whole is not None:  # a window is many rows already
            self._whole.sink.scalars(entity, t, t_rx, values, window)

    def measurements(
        self, entity: str, t: Times, t_rx: Times, values: Floats, variances: Floats, window: int | None = None
    ) -> None:
        """Rows of a number with its variance."""
        super().measurements(entity, t, t_rx, values, variances, window)
        if self._whole is not None and window is None:
            self._whole.add(Sink.measurements, entity, len(t), t, t_rx, values, variances)
        elif self._whole is not None:
            self._whole.sink.measurements(entity, t, t_rx, values, variances, window)

    def points(self, entity: str, t: Times, t_rx: Times, positions: list[Floats]) -> None:
        """Rows of points in local metres."""
        super().points(entity, t, t_rx, positions)
        self._keep(Sink.points, entity, t, t_rx, positions)

    def lines(self, entity: str, t: Times, t_rx: Times, strips: list[Floats]) -> None:
        """Rows of one line strip each in local metres."""
        super().lines(entity, t, t_rx, strips)
        self._keep(Sink.lines, entity, t, t_rx, strips)

    def geo_points(self, entity: str, t: Times, t_rx: Times, degrees: list[Floats]) -> None:
        """Rows of points in degrees."""
        super().geo_points(entity, t, t_rx, degrees)
        self._keep(Sink.geo_points, entity, t, t_rx, degrees)

    def geo_lines(self, entity: str, t: Times, t_rx: Times, degrees: list[Floats]) -> None:
        """Rows of one line each in degrees."""
        super().geo_lines(entity, t, t_rx, degrees)
        self._keep(Sink.geo_lines, entity, t, t_rx, degrees)

    def texts(self, entity: str, t: Times, t_rx: Times, texts: list[str], levels: list[str]) -> None:
        """Rows of the event log."""
        super().texts(entity, t, t_rx, texts, levels)
        if self._whole is not None:
            self._whole.add(Sink.texts, entity, len(t), t, t_rx, texts, levels)

    def once(self, entity: str, t: int, t_rx: int, *what: Any, window: int | None = None) -> None:
        """One row of anything."""
        super().once(entity, t, t_rx, *what, window=window)
        if self._whole is not None:
            self._whole.sink.once(entity, t, t_rx, *what, window=window)

    def static(self, entity: str, what: Any) -> None:
        """Something that holds at all times."""
        super().static(entity, what)
        if self._whole is not None:
            self._whole.sink.static(entity, what)

    def property(self, name: str, **values: Any) -> None:
        """A static property of the whole recording: it comes after all that it speaks of."""
        super().property(name, **values)
        if self._whole is not None:
            self._whole.write()
            self._whole.sink.property(name, **values)

    def started(self, t: int) -> None:
        """Say when the recording began."""
        super().started(t)
        if self._whole is not None:
            self._whole.sink.started(t)

    def layout(self, blueprint: Any) -> None:
        """Store a default layout; what lasts needs the last one only."""
        super().layout(blueprint)
        self._blueprint = blueprint

    def sync(self, timeout: float = 10.0) -> Callable[[], bool]:
        """As of `Sink`. Where it fails, what would have lasted leaves its room to what is there; and before it fails,
        because a file that could not be written once cannot be written any more.
        """
        growing, whole = super().sync(timeout), self._whole
        lasting = None if whole is None else whole.sink.sync(timeout)
        narrow = whole is not None and _free(self.path) < RESERVE

        def settle() -> bool:
            done = growing()
            if lasting is not None and self._whole is whole and (not (done and lasting()) or narrow):
                self._given_up = True
                self._abandon()
            return done

        return settle

    def close(self) -> bool:
        """Flush, and put what lasts in the place of what grew."""
        done = self.flush()
        self._stream.disconnect()
        whole = self._whole
        if whole is not None:
            try:
                if self._blueprint is not None:
                    whole.sink.layout(self._blueprint)
                finished = whole.finish(self.path)
            except BaseException:
                self._abandon()
                raise
            if finished:
                self._whole = None
            else:
                self._abandon()
                self._on_alarm(
                    f"{self.path}: could not be finished; it holds everything, without an index: "
                    f"rerun rrd optimize {self.path} -o FILE writes one"
                )
        elif self._given_up and done:  # where writing fails to the end, that has been told
            self._on_alarm(
                f"{self.path}: for want of room, or because writing failed, it has no index: "
                f"rerun rrd optimize {self.path} -o FILE writes one"
            )
        return done

    def _keep(self, write: Callable[..., None], entity: str, t: Times, t_rx: Times, rows: list[Floats]) -> None:
        if self._whole is not None:
            self._whole.add(write, entity, sum(map(len, rows)), t, t_rx, rows)

    def _abandon(self) -> None:
        if self._whole is not None:
            self._whole.abandon()
            self._whole = None
