"""What a sensor has said since the leg began: the newest rows in memory, the others in a file that has no name.

So the memory of a flight does not grow with its length. Where nothing can be written, everything stays in memory.
"""

from __future__ import annotations

import os
import tempfile
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Times = NDArray[np.int64]

ROWS = 8192  # in memory before they are put into the file
EVER = 1 << 62  # ns


class Rows(NamedTuple):
    """Samples in order of arrival.

    Attributes
    ----------
    t, passed : (k,) arrays
        Times of the samples, and the times that had been passed when they came, ns.
    z : (k, m) array
    """

    t: Times
    passed: Times
    z: Floats


class _Filed(NamedTuple):
    """Rows in the file: from which byte on, how many, and the span of their times."""

    offset: int
    size: int
    first: int
    last: int


class _File:
    """A file that has no name, closed when nobody reads it any more.

    Raises
    ------
    OSError
        It cannot be made.
    """

    def __init__(self) -> None:
        with tempfile.TemporaryFile(prefix="sortie-") as file:
            self.number = os.dup(file.fileno())

    def __del__(self) -> None:
        if hasattr(self, "number"):
            os.close(self.number)


class Shelf:
    """Rows of one sensor.

    Parameters
    ----------
    width : int
        Columns of z.
    """

    def __init__(self, width: int) -> None:
        self._width = width
        self._file: _File | None = None
        self._filed: list[_Filed] = []
        self._size = 0
        self._loose: list[Rows] = []
        self._count = 0  # of these

    def put(self, rows: Rows) -> None:
        """Add rows, which came after all others."""
        self._loose.append(rows)
        self._count += len(rows.t)
        if self._count >= ROWS:
            self._tidy()

    def so_far(self) -> Shelf:
        """The same rows, to be read in another thread while more are put here."""
        other = Shelf(self._width)
        other._file = self._file  # read by place: who reads where does not matter to the others
        other._filed, other._loose = list(self._filed), list(self._loose)
        return other

    def times(self, first: int = -EVER, stop: int = EVER) -> tuple[Times, Times]:
        """`Rows.t` and `Rows.passed` from time `first` to `stop`, ns, in order of arrival."""
        found = self._between(first, stop, values=False)
        return found.t, found.passed

    def rows(self, first: int = -EVER, stop: int = EVER) -> Rows:
        """Everything from time `first` to `stop`, ns, in order of arrival."""
        return self._between(first, stop, values=True)

    def _between(self, first: int, stop: int, *, values: bool) -> Rows:
        width = self._width if values else 0
        parts = [self._read(part, width) for part in self._filed if part.first <= stop and part.last >= first]
        parts += [Rows(part.t, part.passed, part.z[:, :width]) for part in self._loose]
        if not parts:
            return Rows(np.empty(0, np.int64), np.empty(0, np.int64), np.empty((0, width)))
        whole = Rows(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))
        inside = (whole.t >= first) & (whole.t <= stop)
        return whole if inside.all() else Rows(whole.t[inside], whole.passed[inside], whole.z[inside])

    def _read(self, part: _Filed, width: int) -> Rows:
        assert self._file is not None
        try:
            data = os.pread(self._file.number, 8 * part.size * (2 + width), part.offset)
        except OSError as error:
            raise ArithmeticError(f"what the sensors said could not be read back: {error}") from None
        if len(data) != 8 * part.size * (2 + width):
            raise ArithmeticError("what the sensors said could not be read back from the temporary file")
        words = np.frombuffer(data, np.int64)
        t, passed = words[: part.size], words[part.size : 2 * part.size]
        return Rows(t, passed, words[2 * part.size :].view(np.float64).reshape(part.size, width))

    def _tidy(self) -> None:
        """Put what lies loose into the file."""
        rows = Rows(*(np.concatenate(columns) for columns in zip(*self._loose, strict=True)))
        self._loose, self._count = [rows], 0
        data = b"".join(np.ascontiguousarray(column).tobytes() for column in rows)
        try:
            if self._file is None:
                self._file = _File()
            if os.pwrite(self._file.number, data, self._size) < len(data):
                return  # the disk is full: what was begun will be written over
        except OSError:
            return
        self._filed.append(_Filed(self._size, len(rows.t), int(rows.t.min()), int(rows.t.max())))
        self._size += len(data)
        self._loose = []
