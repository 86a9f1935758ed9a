"""DataFlash logs in text: the same tables as of the binary form, from lines.

::

    FMT, 134, 43, IMU, IffffffIIf, TimeMS,GyrX,GyrY,GyrZ,AccX,AccY,AccZ,ErrG,ErrA,Temp
    IMU, 11460, 0.0001437337, -0.0001036508, ...

Lines are grouped by their first word, and each group is parsed in one columnar call. A line that has not the columns
of its definition, or no number where one belongs, is damaged: it is counted and left out as a whole. The last line of
a log counts only if its end is there, because a number that lost its last digits is still a number.
"""

from __future__ import annotations

import re
from collections.abc import Container, Iterator
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from telemetry.dataflash import CODES, FMT, FMT_LENGTH, Layout, Table, layout

_COLUMNS = "Type,Length,Name,Format,Columns"
LONGEST = 1 << 16  # a longer line is none
_COUNT = re.compile(r"[0-9]{1,3}$")


@njit(cache=True, nogil=True)
def _lines(data, starts, ends, names):  # type: ignore[no-untyped-def]
    """Where lines begin and end, and their first words as numbers (at most seven characters, 0 if it is none)."""
    k = begin = 0
    word, letters, open_ = np.uint64(0), 0, True
    for i in range(len(data)):
        c = data[i]
        if c == 10:
            starts[k], ends[k] = begin, i
            names[k] = np.uint64(0) if open_ or letters > 7 else word
            k += 1
            begin, word, letters, open_ = i + 1, np.uint64(0), 0, True
        elif open_:
            if c == 44:
                open_ = False
            else:
                word = (word << np.uint64(8)) | np.uint64(c)
                letters += 1
    return k


@njit(cache=True, nogil=True)
def _collect(data, starts, ends, commas, out, keep):  # type: ignore[no-untyped-def]
    """Copy the lines that have so many commas, without their first words, to `out`: bytes written."""
    n = 0
    for r in range(len(starts)):
        count, first = 0, -1
        good = True
        for i in range(starts[r], ends[r]):
            c = data[i]
            if c == 44:
                count += 1
                if first < 0:
                    first = i + 1
            elif c == 34 or c < 9 or c > 126:  # a number has no quotation marks
                good = False
        keep[r] = good and count == commas
        if keep[r]:
            for i in range(first, ends[r]):
                if data[i] > 32:
                    out[n] = data[i]
                    n += 1
            out[n] = 10
            n += 1
    return n


def _number(name: str) -> int:
    return int.from_bytes(name.encode("latin-1", "replace")[:7], "big")


class TextScanner:
    """Finds the messages of a text log that comes in blocks; as `telemetry.dataflash.Scanner`.

    Attributes
    ----------
    corrupt : int
        Damaged lines; their bytes are `discarded`.
    """

    def __init__(self) -> None:
        self.messages = self.unreadable = self.discarded = self.truncated = self.corrupt = 0
        first = layout(FMT, FMT_LENGTH, "FMT", "BBnNZ", _COLUMNS, text=True)
        assert first is not None
        self.layouts: dict[int, Layout | None] = {_number("FMT"): first}
        self._waiting = b""
        self._begin = 0

    @property
    def pending(self) -> int:
        """Bytes that wait for the next block."""
        return len(self._waiting)

    def scan(self, block: bytes, final: bool, names: Container[str] | None = None) -> list[Table]:
        """Find the messages of the next block; as `telemetry.dataflash.Scanner.scan`."""
        whole = self._waiting + block
        end = whole.rfind(b"\n") + 1
        if not end and not final and len(whole) > LONGEST:
            self.discarded += len(whole) - 1
            self._begin += len(whole) - 1
            self._waiting = whole[-1:]
            return []
        data = np.frombuffer(whole, np.uint8, end)
        most = whole.count(b"\n", 0, end)
        starts, ends, words = np.empty(most, np.int64), np.empty(most, np.int64), np.empty(most, np.uint64)
        _lines(data, starts, ends, words)
        blank = ends - starts <= 1  # nothing, or a carriage return
        self.discarded += int((ends - starts + 1)[blank].sum())
        tables = []
        for first, last in self._ranges(whole, starts, ends, words):
            rows = np.arange(first, last)
            rows = rows[~blank[first:last]]
            if not len(rows):
                continue
            order = rows[np.argsort(words[rows], kind="stable")]
            found, places = np.unique(words[order], return_index=True)
            for word, mine in zip(found.tolist(), np.split(order, places[1:]), strict=True):
                table = self._table(data, whole, word, starts[mine], ends[mine], names)
                if table is not None:
                    tables.append(table)
        self._begin += end
        self._waiting = whole[end:]
        if final:
            self.truncated, self._waiting = len(self._waiting), b""
        return tables

    def _ranges(
        self, whole: bytes, starts: NDArray[np.int64], ends: NDArray[np.int64], words: NDArray[np.uint64]
    ) -> Iterator[tuple[int, int]]:
        """Ranges of lines within which no definition changes; what changes behind one is taken in when it was read."""
        known = dict(self.layouts)
        changes: list[tuple[int, int, Layout | None]] = []
        for row in np.flatnonzero(words == _number("FMT")).tolist():
            fields = [w.strip() for w in whole[starts[row] : ends[row]].decode("latin-1").split(",", 5)]
            if len(fields) < 5 or not (_COUNT.match(fields[1]) and _COUNT.match(fields[2])) or fields[3] == "FMT":
                continue
            columns = ",".join(c.strip() for c in fields[5].split(",")) if len(fields) > 5 else ""
            word = _number(fields[3])
            form = layout(int(fields[1]), int(fields[2]), fields[3], fields[4], columns, text=True)
            if word not in known:
                self.layouts[word] = known[word] = form
            elif form != known[word]:
                known[word] = form
                changes.append((row, word, form))
        begin = 0
        for row, word, form in changes:
            yield begin, row + 1
            self.layouts[word] = form
            begin = row + 1
        yield begin, len(starts)

    def _table(
        self,
        data: NDArray[np.uint8],
        whole: bytes,
        word: int,
        starts: NDArray[np.int64],
        ends: NDArray[np.int64],
        names: Container[str] | None,
    ) -> Table | None:
        size = int((ends - starts + 1).sum())
        if word not in self.layouts:
            self.discarded += size
            self.corrupt += len(starts)
            return None
        form = self.layouts[word]
        if form is None or not form.columns or (names is not None and form.name not in names):
            self.messages += len(starts)
            self.unreadable += len(starts) if form is None else 0
            return None
        if any(CODES[code][2] == "S" for code in form.format):
            values, keep = _words(whole, starts, ends, form)
        else:
            values, keep = _numbers(data, starts, ends, form)
        self.messages += int(keep.sum())
        self.corrupt += int((~keep).sum())
        self.discarded += int((ends - starts + 1)[~keep].sum())
        return Table(form, values, starts[keep] + self._begin) if keep.any() else None


def _numbers(
    data: NDArray[np.uint8], starts: NDArray[np.int64], ends: NDArray[np.int64], form: Layout
) -> tuple[NDArray[Any], NDArray[np.bool_]]:
    """Columns of numbers of lines, and which of the lines are whole."""
    import pyarrow as pa
    import pyarrow.compute as pc
    from pyarrow import csv

    keep = np.zeros(len(starts), np.bool_)
    out = np.empty(int((ends - starts + 1).sum()), np.uint8)
    size = _collect(data, starts, ends, len(form.columns), out, keep)
    rows = int(keep.sum())
    if not rows:
        return np.empty(0, form.dtype), keep
    read = csv.ReadOptions(column_names=list(form.columns), use_threads=False, block_size=max(size, 1))
    parse = csv.ParseOptions(quote_char=False, ignore_empty_lines=False)
    table = csv.read_csv(
        pa.BufferReader(out[:size].tobytes()),
        read_options=read,
        parse_options=parse,
        convert_options=csv.ConvertOptions(
            column_types={c: pa.string() for c in form.columns}, strings_can_be_null=False
        ),
    )
    values = np.zeros(rows, form.dtype)
    good = np.ones(rows, np.bool_)
    for name, code in zip(form.columns, form.format, strict=True):
        kind = CODES[code][2]
        pattern = _FLOAT if kind == "f8" else (_UNSIGNED if kind == "u8" else _INTEGER)
        words = table.column(name).combine_chunks()
        number = pc.match_substring_regex(words, pattern)
        numbers = pc.cast(pc.if_else(number, words, pa.scalar("0")), _ARROW[kind](), safe=True)
        values[name] = numbers.to_numpy(zero_copy_only=False)
        good &= number.to_numpy(zero_copy_only=False)
    keep[np.flatnonzero(keep)[~good]] = False
    return values[good], keep


_FLOAT = r"^[-+]?([0-9]{1,40}\.?[0-9]{0,40}|\.[0-9]{1,40})([eE][-+]?[0-9]{1,3})?$|^[-+]?(?i:nan|inf)$"
_INTEGER, _UNSIGNED = r"^-?[0-9]{1,18}$", r"^[0-9]{1,18}$"


def _arrow_float() -> Any:
    import pyarrow as pa

    return pa.float64()


def _arrow_int() -> Any:
    import pyarrow as pa

    return pa.int64()


def _arrow_unsigned() -> Any:
    import pyarrow as pa

    return pa.uint64()


_ARROW = {"f8": _arrow_float, "i8": _arrow_int, "u8": _arrow_unsigned}


def _words(
    whole: bytes, starts: NDArray[np.int64], ends: NDArray[np.int64], form: Layout
) -> tuple[NDArray[Any], NDArray[np.bool_]]:
    """As `_numbers`, for messages with words in them: these are few, and the last of a line may hold commas."""
    keep = np.zeros(len(starts), np.bool_)
    values = np.zeros(len(starts), form.dtype)
    for r, (begin, end) in enumerate(zip(starts.tolist(), ends.tolist(), strict=True)):
        fields = [w.strip() for w in whole[begin:end].split(b",", len(form.columns))[1:]]
        try:
            values[r] = tuple(
                w if CODES[code][2] == "S" else (float(w) if CODES[code][2] == "f8" else int(w))
                for w, code in zip(fields, form.format, strict=True)
            )
        except (ValueError, OverflowError):
            continue
        keep[r] = True
    return values[keep], keep
