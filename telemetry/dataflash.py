"""ArduPilot's on-board logs: DataFlash bytes to columns of any message.

A log describes itself. Every message is

::

    A3 95  type  body

and the layout of a type's body is told by a message of type 128 before it::

    A3 95 80  type  length  name[4]  format[16]  columns[64]

``length`` counts the three bytes of the head; ``format`` has a letter per column (`CODES`). There is no checksum: a
message is known by its head, and by the head of the next behind it. Where that is missing, something was lost: if a
message begins inside the body, what was thought to be one is given up byte by byte, so that no good message is lost
for a damaged one before it.
"""

from __future__ import annotations

from collections.abc import Container
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

FMT = 128
FMT_LENGTH = 89
BLOCK = 1 << 22
ROWS = 1 << 18  # messages found by one call

# Letter of a format -> how it is stored, by what it is divided to be SI or degrees (0: not at all), how a text log
# writes it.
CODES: dict[str, tuple[str, float, str]] = {
    "a": ("(32,)<i2", 0, "S"),
    "b": ("<i1", 0, "i8"),
    "B": ("<u1", 0, "i8"),
    "g": ("<f2", 0, "f8"),
    "h": ("<i2", 0, "i8"),
    "H": ("<u2", 0, "i8"),
    "i": ("<i4", 0, "i8"),
    "I": ("<u4", 0, "i8"),
    "f": ("<f4", 0, "f8"),
    "d": ("<f8", 0, "f8"),
    "n": ("S4", 0, "S"),
    "N": ("S16", 0, "S"),
    "Z": ("S64", 0, "S"),
    "c": ("<i2", 100.0, "f8"),
    "C": ("<u2", 100.0, "f8"),
    "e": ("<i4", 100.0, "f8"),
    "E": ("<u4", 100.0, "f8"),
    "L": ("<i4", 1e7, "f8"),
    "M": ("<u1", 0, "S"),
    "q": ("<i8", 0, "i8"),
    "Q": ("<u8", 0, "u8"),
}


class Layout(NamedTuple):
    """What a type of message holds.

    Attributes
    ----------
    number : int
        Type.
    name : str
    format : str
        A letter per column.
    columns : tuple of str
    length : int
        Of a message with its head, bytes.
    dtype : numpy.dtype
        Of a body as stored.
    divisors : dict of str to float
        Columns that are stored as multiples of a fraction, and by what they are divided.
    """

    number: int
    name: str
    format: str
    columns: tuple[str, ...]
    length: int
    dtype: np.dtype[Any]
    divisors: dict[str, float]


class Table:
    """Messages of one layout, in the order of the file.

    Attributes
    ----------
    layout : Layout
    values : structured array, shape (k,)
        As stored.
    offset : int64 array, shape (k,)
        Where in the file each begins.
    """

    __slots__ = ("layout", "offset", "values")

    def __init__(self, layout: Layout, values: NDArray[Any], offset: NDArray[np.int64]) -> None:
        self.layout, self.values, self.offset = layout, values, offset

    def __len__(self) -> int:
        return len(self.offset)

    def __contains__(self, column: str) -> bool:
        return column in (self.values.dtype.names or ())

    def column(self, name: str) -> NDArray[Any]:
        """One column, shape (k,), in its unit: the stored integers of ``c C e E L`` divided."""
        values = self.values[name]
        divisor = self.layout.divisors.get(name)
        return values if divisor is None else values / divisor

    def select(self, rows: slice | NDArray[Any]) -> Table:
        """Some of the messages."""
        return Table(self.layout, self.values[rows], self.offset[rows])


def join(parts: list[Table]) -> Table:
    """Messages of one layout, one part after the other."""
    if len(parts) == 1:
        return parts[0]
    return Table(
        parts[0].layout, np.concatenate([p.values for p in parts]), np.concatenate([p.offset for p in parts])
    )  # fmt: skip


def layout(number: int, length: int, name: str, form: str, columns: str, *, text: bool = False) -> Layout | None:
    """What an FMT message defines; None where it contradicts itself, so that its messages cannot be read.

    Parameters
    ----------
    number, length, name, form, columns
        Its five columns.
    text : bool
        Of a text log: values stand there as numbers in their units.
    """
    names = tuple(columns.split(",")) if columns else ()
    if len(names) != len(form) or len(set(names)) != len(names) or not all(names) or not set(form) <= set(CODES):
        return None
    fields, divisors = [], {}
    for column, code in zip(names, form, strict=True):
        stored, divisor, written = CODES[code]
        fields.append((column, ("S64" if written == "S" else written) if text else stored))
        if divisor and not text:
            divisors[column] = divisor
    dtype = np.dtype(fields)
    if not text and dtype.itemsize != length - 3:
        return None
    return Layout(number, name, form, names, length, dtype, divisors)


@njit(cache=True, nogil=True)
def _head(data, i, lengths):  # type: ignore[no-untyped-def]
    """Length of the message that begins at i; 0 if none does, -1 if that cannot be said before more bytes come."""
    n = len(data)
    if i >= n:
        return -1
    if data[i] != 0xA3:
        return 0
    if i + 1 >= n:
        return -1
    if data[i + 1] != 0x95:
        return 0
    return lengths[data[i + 2]] if i + 2 < n else -1


@njit(cache=True, nogil=True)
def _next(data, begin, end, lengths, final):  # type: ignore[no-untyped-def]
    """Where the first whole message begins in begin..end that another one, or the end of the log, follows.

    -1 if none does; -2 if that cannot be said before more bytes come.
    """
    n = len(data)
    for j in range(begin, end):
        size = _head(data, j, lengths)
        if size == 0:
            continue
        if size < 0 or j + size > n:
            if not final:
                return -2
            continue
        behind = _head(data, j + size, lengths)
        if behind > 0 or (behind < 0 and final):
            return j
        if behind < 0:
            return -2
    return -1


@njit(cache=True, nogil=True)
def _find(data, i, final, lengths, definitions, starts, types):  # type: ignore[no-untyped-def]
    """Find messages from i on: (where to go on, how many, bytes of none, whether a type was defined anew).

    A definition of an unknown type takes effect at once. One that changes a type ends the search behind it, because
    what was found so far is to be read by the old one.
    """
    n = len(data)
    k = lost = 0
    while i < n and k < len(starts):
        size = _head(data, i, lengths)
        if size == 0:
            lost += 1
            i += 1
            continue
        if size < 0 or i + size > n:
            if not final:
                break
            j = _next(data, i + 1, n, lengths, final)
            if j < 0:
                break
            lost += j - i
            i = j
            continue
        behind = _head(data, i + size, lengths)
        if behind < 0 and not final:
            break
        if behind == 0:  # bytes are missing in it, or there is garbage behind it
            j = _next(data, i + 3, i + size, lengths, final)
            if j == -2:
                break
            if j >= 0:
                lost += j - i
                i = j
                continue
        starts[k] = i
        types[k] = data[i + 2]
        k += 1
        if data[i + 2] == FMT:
            defined = data[i + 3]
            # its length is at least that of a head, and its name begins with a letter
            if defined != FMT and data[i + 4] >= 3 and 65 <= data[i + 5] <= 90:
                definition = data[i + 3 : i + FMT_LENGTH]
                if lengths[defined] == 0:
                    lengths[defined] = data[i + 4]
                    definitions[defined] = definition
                elif not (definitions[defined] == definition).all():
                    return i + size, k, lost, True
        i += size
    return i, k, lost, False


@njit(cache=True, nogil=True)
def _gather(data, starts, out):  # type: ignore[no-untyped-def]
    """Copy the bodies of the messages that begin at `starts` into the rows of `out`."""
    for r in range(len(starts)):
        begin = starts[r] + 3
        for c in range(out.shape[1]):
            out[r, c] = data[begin + c]


class Scanner:
    """Finds the messages of a binary log that comes in blocks.

    Attributes
    ----------
    messages, unreadable : int
        Messages found so far; of these, messages whose layout contradicts itself.
    discarded, truncated : int
        Bytes of no message so far; bytes of the message that the end of the log cuts.
    pending : int
        Bytes that wait for the next block.
    corrupt : int
        Damaged messages that could be told as such: none here, there is no checksum.

    Bytes scanned = bytes in messages + `discarded` + `pending`, at the end + `truncated` in place of `pending`.
    """

    def __init__(self) -> None:
        self.messages = self.unreadable = self.discarded = self.truncated = self.corrupt = 0
        self.layouts: dict[int, Layout | None] = {FMT: layout(FMT, FMT_LENGTH, "FMT", "BBnNZ", _FMT_COLUMNS)}
        self._lengths = np.zeros(256, np.int64)
        self._lengths[FMT] = FMT_LENGTH
        self._definitions = np.zeros((256, FMT_LENGTH - 3), np.uint8)
        self._waiting = b""
        self._begin = 0  # where in the file the waiting bytes begin

    @property
    def pending(self) -> int:
        """Bytes that wait for the next block."""
        return len(self._waiting)

    def scan(self, block: bytes, final: bool, names: Container[str] | None = None) -> list[Table]:
        """Find the messages of the next block.

        Parameters
        ----------
        block : bytes
        final : bool
            Nothing will follow.
        names : container of str, optional
            Names of the messages to be returned; all are counted.

        Returns
        -------
        list of Table
            Each layout at most once, unless a type is defined anew in the block.
        """
        data = np.frombuffer(self._waiting + block, np.uint8)
        starts, types = np.empty(ROWS, np.int64), np.empty(ROWS, np.uint8)
        tables: list[Table] = []
        i, stopped = 0, True
        while stopped:
            i, k, lost, changed = _find(data, i, final, self._lengths, self._definitions, starts, types)
            self.discarded += lost
            self.messages += k
            tables += self._tables(data, starts[:k], types[:k], names, changed)
            stopped = changed or k == ROWS
        self._begin += i
        self._waiting = data[i:].tobytes()
        if final:
            self.truncated, self._waiting = len(self._waiting), b""
        return tables

    def _tables(
        self,
        data: NDArray[np.uint8],
        starts: NDArray[np.int64],
        types: NDArray[np.uint8],
        names: Container[str] | None,
        changed: bool,
    ) -> list[Table]:
        order = np.argsort(types, kind="stable")
        bounds = np.concatenate([[0], np.cumsum(np.bincount(types, minlength=256))])
        definitions = starts[order[bounds[FMT] : bounds[FMT + 1]]].tolist()
        for start in definitions[: len(definitions) - changed]:
            self._define(data[start + 3 : start + FMT_LENGTH])
        tables = []
        for number, (first, last) in enumerate(pairwise(bounds.tolist())):
            if first == last:
                continue
            form = self.layouts.get(number)
            if form is None:
                self.unreadable += last - first
            elif form.columns and (names is None or form.name in names):
                mine = starts[order[first:last]]
                bodies = np.empty((len(mine), form.length - 3), np.uint8)
                _gather(data, mine, bodies)
                tables.append(Table(form, bodies.view(form.dtype)[:, 0], mine + self._begin))
        if changed:
            self._define(data[definitions[-1] + 3 : definitions[-1] + FMT_LENGTH])
        return tables

    def _define(self, definition: NDArray[np.uint8]) -> None:
        raw = definition.tobytes()
        number, length = raw[0], raw[1]
        if number == FMT or length < 3 or not 65 <= raw[2] <= 90:
            return
        if number not in self.layouts or not np.array_equal(self._definitions[number], definition):
            name, form, columns = (_word(raw[a:b]) for a, b in ((2, 6), (6, 22), (22, 86)))
            self.layouts[number] = layout(number, length, name, form, columns)
            self._lengths[number] = length
            self._definitions[number] = definition


_FMT_COLUMNS = "Type,Length,Name,Format,Columns"


def _word(raw: bytes) -> str:
    return raw.split(b"\0", 1)[0].decode("latin-1")


def is_binary(first: bytes) -> bool:
    """Whether a file that begins so is a binary log: a whole definition of a message is among its first bytes."""
    at = first.find(b"\xa3\x95\x80")
    return at >= 0 and at + FMT_LENGTH <= len(first) and 65 <= first[at + 5] <= 90


def is_text(first: bytes) -> bool:
    """Whether a file that begins so is a text log."""
    return first.startswith(b"FMT,") or b"\nFMT," in first


def read(path: str | Path, names: Container[str] | None = None) -> dict[str, Table]:
    """Read a whole log, binary or text.

    Parameters
    ----------
    path : str or Path
    names : container of str, optional
        Names of the messages to be read; all if not given.

    Returns
    -------
    dict of str to Table
        By name; messages of a second layout under the same name stand under ``NAME#2``.

    Raises
    ------
    OSError
        If the file cannot be read.
    ValueError
        If it is no DataFlash log.
    """
    path = Path(path)
    parts: dict[int, list[Table]] = {}
    with path.open("rb") as file:
        scanner = scanner_for(path, file.read(1 << 16))
        file.seek(0)
        while True:
            block = file.read(BLOCK)
            final = len(block) < BLOCK
            for table in scanner.scan(block, final, names):
                parts.setdefault(id(table.layout), []).append(table)
            if final:
                break
    tables: dict[str, Table] = {}
    for pieces in parts.values():
        name, again = pieces[0].layout.name, 1
        while (key := name if again == 1 else f"{name}#{again}") in tables:
            again += 1
        tables[key] = join(pieces)
    return tables


def scanner_for(path: Path, first: bytes) -> Any:
    """A scanner for a log that begins with these bytes: a `Scanner` or a `telemetry.dataflash_text.TextScanner`.

    Raises
    ------
    ValueError
        If it is empty or no DataFlash log.
    """
    if not first:
        raise ValueError(f"{path} is empty: nothing was recorded")
    if is_binary(first):
        return Scanner()
    if is_text(first):
        from telemetry.dataflash_text import TextScanner

        return TextScanner()
    raise ValueError(
        f"{path} is no DataFlash log: no definition of a message (FMT) in its first {len(first)} bytes; "
        "download the log from the autopilot again"
    )
