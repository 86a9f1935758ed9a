"""Comparison: does a recording hold exactly what a replay gives?"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import zip_longest
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from telemetry.messages import Estimate, Message, Report, Times, Window
from viewer.columns import GAP, Seam, belief_columns, broken, broken_times, estimate_path, report_path
from viewer.reading import Reading
from viewer.worth import Worth, worth

_FIELDS = ("t", "t_rx", "mean", "variance")


class Difference(msgspec.Struct, frozen=True, kw_only=True):
    """The first difference of one entity.

    Parameters
    ----------
    entity : str
    row : int
        Row in order of vehicle time; -1 when the whole entity is missing on one side.
    t : int
        Vehicle time of the row, ns.
    what : str
        "t", "t_rx", "mean", "variance", "rows" or "entity"; of a report the first of its fields.
    recorded, replayed : str
        Both sides, exact.
    count : int
        Rows of this entity that differ.
    """

    entity: str
    row: int
    t: int
    what: str
    recorded: str
    replayed: str
    count: int

    def __str__(self) -> str:
        place = "" if self.row < 0 else f" row {self.row} (t = {self.t} ns)"
        sides = f"recorded {self.recorded}, replayed {self.replayed}"
        return f"{self.entity}{place}: {self.what} {sides} ({self.count} rows differ)"


def stored(messages: Iterable[Message], gap: float = GAP) -> dict[str, NDArray[np.int64]]:
    """Rows that a recording of these messages holds of their estimates and windows, breaks included.

    Returns
    -------
    dict of str to int64 array, shape (k, 4)
        By entity: t, t_rx, and the bits of mean and variance; sorted.
    """
    parts: dict[str, list[list[NDArray[Any]]]] = {}
    seams: dict[str, Seam] = {}
    for message in messages:
        if isinstance(message, (Estimate, Window)):
            seam = seams.setdefault(estimate_path(message), Seam(gap))
            at, times, receive = seam.find(message.boot, message.t, message.t_rx)
            t, t_rx = broken_times(message.t, at, times), broken_times(message.t_rx, at, receive)
            for entity, column in belief_columns(message).items():
                parts.setdefault(entity, []).append([t, t_rx, broken(column.values, at), broken(column.variances, at)])
    return {
        entity: _table(*(np.concatenate(column) for column in zip(*rows, strict=True)))
        for entity, rows in parts.items()
    }


def compare(path: str | Path, messages: Iterable[Message]) -> list[Difference]:
    """Compare every estimate, window and report of a recording with those of a replay, bit for bit: times, means,
    variances, and all that a report says.

    Parameters
    ----------
    path : path
        Recording or sortie folder.
    messages : iterable of Message
        What the replay gives; other kinds are passed over.

    Returns
    -------
    list of Difference
        The first of each entity; empty when equal. Missing and extra rows are differences.
    """
    with Reading(path) as reading:
        gap = reading.constant("/__properties/run", "gap")
        told: dict[str, list[Worth]] = {}
        replayed = stored(_aside(messages, told), GAP if gap is None else float(gap))
        recorded = {}
        reports: dict[str, list[Worth]] = {}
        for entity in reading.chunks:
            if "/report/" in entity:
                _, texts = reading.column(entity, "report")
                reports[entity] = [msgspec.json.decode(text, type=Worth) for text in texts]
            elif "/est/" in entity:
                (t, t_rx), rows = reading.columns(
                    entity, ("Measurements:values", "Measurements:variances"), ("t_vehicle", "t_rx")
                )
                if len(t):
                    recorded[entity] = _table(t, t_rx, *rows)
    found = [
        _first(entity, recorded.get(entity), replayed.get(entity))
        for entity in sorted(recorded.keys() | replayed.keys())
    ]
    found += [_unlike(entity, reports.get(entity, []), told.get(entity, [])) for entity in sorted(reports | told)]
    return [difference for difference in found if difference is not None]


def _aside(messages: Iterable[Message], reports: dict[str, list[Worth]]) -> Iterator[Message]:
    """Messages as they come; what the reports among them say is put aside, by entity."""
    for message in messages:
        if isinstance(message, Report):
            reports.setdefault(report_path(message), []).append(worth(message))
        yield message


def _unlike(entity: str, recorded: list[Worth], replayed: list[Worth]) -> Difference | None:
    """The first difference between reports, if there is one."""
    texts = [sorted((r.end, r.begin, msgspec.json.encode(r)) for r in side) for side in (recorded, replayed)]
    pairs = list(zip_longest(*texts))
    unlike = [i for i, (a, b) in enumerate(pairs) if a != b]
    if not unlike:
        return None
    mine, theirs = pairs[unlike[0]]
    there = mine or theirs
    assert there is not None
    if mine is None or theirs is None:
        what, sides = "rows", [f"{len(side)} reports" for side in texts]
    else:
        fields = [msgspec.json.decode(side[2]) for side in (mine, theirs)]
        what = next(name for name in fields[0] if fields[0][name] != fields[1][name])
        sides = [str(side[what]) for side in fields]
    return Difference(
        entity=entity, row=unlike[0], t=there[0], what=what, recorded=sides[0], replayed=sides[1], count=len(unlike)
    )


def _table(t: Times, t_rx: Times, values: NDArray[Any], variances: NDArray[Any]) -> NDArray[np.int64]:
    bits = [np.where(np.isnan(x), np.nan, x).astype(np.float64).view(np.int64) for x in (values, variances)]
    table = np.column_stack([t, t_rx, *bits])
    return np.asarray(table[np.lexsort(table.T[::-1])])


def _first(entity: str, recorded: NDArray[np.int64] | None, replayed: NDArray[np.int64] | None) -> Difference | None:
    if recorded is None or replayed is None:
        there = recorded if recorded is not None else replayed
        assert there is not None
        sides = [f"{0 if side is None else len(side)} rows" for side in (recorded, replayed)]
        return Difference(
            entity=entity, row=-1, t=0, what="entity", recorded=sides[0], replayed=sides[1], count=len(there)
        )
    n = min(len(recorded), len(replayed))
    unlike = recorded[:n] != replayed[:n]
    count = int(unlike.any(axis=1).sum()) + abs(len(recorded) - len(replayed))
    if not count:
        return None
    rows = np.flatnonzero(unlike.any(axis=1))
    if not len(rows):
        longer = recorded if len(recorded) > n else replayed
        return Difference(
            entity=entity,
            row=n,
            t=int(longer[n, 0]),
            what="rows",
            recorded=f"{len(recorded)} rows",
            replayed=f"{len(replayed)} rows",
            count=count,
        )
    row = int(rows[0])
    field = int(np.flatnonzero(unlike[row])[0])
    sides = [_text(side[row, field], field) for side in (recorded, replayed)]
    return Difference(
        entity=entity,
        row=row,
        t=int(recorded[row, 0]),
        what=_FIELDS[field],
        recorded=sides[0],
        replayed=sides[1],
        count=count,
    )


def _text(bits: np.int64, field: int) -> str:
    return str(int(bits)) if field < 2 else repr(float(bits.view(np.float64)))
