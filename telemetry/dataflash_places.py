"""Messages of a DataFlash log with their places in time: which boot, and when since then."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from telemetry import dataflash
from telemetry.dataflash import Table, join, scanner_for
from telemetry.dataflash_sensors import FEEDS, HELPERS, WAIT, Rows
from telemetry.messages import Times
from telemetry.sources.logtime import LATEST, NEVER, judge
from telemetry.sources.onboard import SLACK

WORDS = "MSG", "MODE", "EV", "ERR", "PARM", "FMTU", "UNIT", "DSF"
NAMES = frozenset((*FEEDS, *HELPERS, *WORDS))


class Block(NamedTuple):
    """What a block of the file holds.

    Attributes
    ----------
    rows : list of Rows
        Messages of every layout, dated since boot, ns; `NEVER` where none before has told a time.
    boots : list of int64 array
        Their boots, as `rows`.
    done : int
        Bytes read so far.
    scanner : Scanner or TextScanner
        With its counters so far.
    """

    rows: list[Rows]
    boots: list[NDArray[np.int64]]
    done: int
    scanner: Any


class Reader:
    """Reads the messages that matter, in blocks, and places them.

    Parameters
    ----------
    path : Path
    digest : hash object, optional
        Takes every byte.

    Attributes
    ----------
    misdated : int
        Messages left out because their time is damaged.
    untimed : Counter of str
        Messages of sensors that do not say when they measured, left out.
    """

    def __init__(self, path: Path, digest: Any = None) -> None:
        self._path, self._digest = path, digest
        self.misdated = 0
        self.untimed: Counter[str] = Counter()

    def blocks(self) -> Iterator[Block]:
        """Yield the messages block by block.

        Raises
        ------
        OSError
            If the file cannot be read.
        ValueError
            If it is no DataFlash log.
        """
        state = np.array([NEVER, 0], np.int64)
        held: list[Table] = []
        done = 0
        with self._path.open("rb") as file:
            scanner = scanner_for(self._path, file.read(1 << 16))
            file.seek(0)
            while True:
                block = file.read(dataflash.BLOCK)
                done += len(block)
                final = len(block) < dataflash.BLOCK
                if self._digest is not None:
                    self._digest.update(block)
                rows, boots, held = self._place(_joined([*held, *scanner.scan(block, final, NAMES)]), state, final)
                yield Block(rows, boots, done, scanner)
                if final:
                    return

    def _place(
        self, tables: list[Table], state: Times, final: bool
    ) -> tuple[list[Rows], list[NDArray[np.int64]], list[Table]]:
        """Place what can be placed; the rest is to be shown again with what follows it."""
        clocks = []
        for table in list(tables):
            times, told = _times(table)
            if table.layout.name in FEEDS and not told:
                self.untimed[table.layout.name] += len(table)
                tables.remove(table)
            else:
                clocks.append((times, np.full(len(table), told)))
        if not tables:
            return [], [], []
        order = np.argsort(np.concatenate([table.offset for table in tables]), kind="stable")
        t, timed = np.concatenate([times for times, _ in clocks]), np.concatenate([told for _, told in clocks])
        boot, newest, good = np.zeros(len(t), np.int64), np.zeros(len(t), np.int64), np.zeros(len(t), np.bool_)
        n = judge(t[order], timed[order], final, state, boot, newest, good)
        decided = np.zeros(len(t), np.bool_)
        decided[order[:n]] = True
        back = np.empty(len(t), np.int64)
        back[order] = np.arange(len(t))
        boot, newest, good = boot[back], newest[back], good[back]
        self.misdated += int((decided & ~good).sum())
        rows, boots, held, begin = [], [], [], 0
        for table in tables:
            mine = slice(begin, begin + len(table))
            begin += len(table)
            k = int(decided[mine].sum())
            if k < len(table):
                held.append(table.select(slice(k, None)))
            keep = np.flatnonzero(good[mine][:k])
            if len(keep):
                now = newest[mine][keep]
                time = np.where(timed[mine][keep], t[mine][keep], now)
                known = np.where(now == NEVER, NEVER, np.maximum(time, np.maximum(now, SLACK) - SLACK))
                known += WAIT if table.layout.name == "GYR" else 0
                rows.append(Rows(table.select(keep), time, known))
                boots.append(boot[mine][keep])
        return rows, boots, held


def _joined(tables: list[Table]) -> list[Table]:
    by_layout: dict[int, list[Table]] = {}
    for table in tables:
        by_layout.setdefault(id(table.layout), []).append(table)
    return [join(parts) for parts in by_layout.values()]


def _times(table: Table) -> tuple[Times, bool]:
    """Time since boot, ns, -1 where it cannot be; and whether the messages tell one."""
    old = "T" in table and table.layout.name.startswith("GPS")  # there TimeMS is the time of the week
    for name, unit in (("T", 1_000_000),) if old else (("TimeUS", 1_000), ("TimeMS", 1_000_000)):
        if name in table and table.values[name].dtype.kind in "iuf" and table.values[name].ndim == 1:
            stored = table.column(name)
            with np.errstate(invalid="ignore"):
                real = (stored >= 0) & (stored <= LATEST // unit)
            return np.where(real, np.where(real, stored, 0).astype(np.int64) * unit, -1), True
    return np.full(len(table), -1), False
