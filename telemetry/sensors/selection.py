"""One kind of sensor of one vehicle: which of its streams is used, and what they measure."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from telemetry.messages import Sample
from telemetry.sensors.batch import Batch, Level, Part
from telemetry.sensors.choice import BACK, BETTER, FIRST, MOST, NOBODY, PATIENCE, SILENT, Change, Choice
from telemetry.sensors.feeds import Columns
from telemetry.sensors.gnss import STAMP, once
from telemetry.sensors.overrides import SensorSettings
from telemetry.sensors.stream import Use

TOO_MANY = f"{MOST} streams of its kind are heard already"


class Selection:
    """The streams of one kind of sensor of one vehicle.

    Parameters
    ----------
    kind : type of Sample
    settings : SensorSettings

    Attributes
    ----------
    uses : list of Use
        What has been heard, by number in the choice.
    """

    def __init__(self, kind: type[Sample], settings: SensorSettings) -> None:
        self.uses: list[Use] = []
        self._kind, self._choice = kind, Choice()
        self._off = settings.off(kind)
        self._asked = getattr(settings, kind.stream) if settings.wanted(kind) else None
        self._fixes: dict[str, int] = {}  # time of the last fix, by source

    def tell(self, parts: list[Part], batch: Batch) -> None:
        """Choose among the streams of a batch, and tell what they measure."""
        new = self._meet(parts, batch)
        parts = [part for part in parts if part.use.stream != NOBODY]
        if not parts:
            return
        first = parts[0]
        if len(parts) == 1 and self._choice.only(first.use.stream, batch.t_rx[first.rows]):
            self._send(first.source, first.rows, first.columns, None, None, batch)
            return
        rows = np.concatenate([part.rows for part in parts])
        streams = np.concatenate([np.full(len(part.rows), part.use.stream) for part in parts])
        order = np.argsort(rows, kind="stable")
        use = np.empty(len(rows), np.int8)
        use[order], changes = self._choice.choose(streams[order], batch.t_rx[rows[order]])
        if not self._off:
            for change in changes:
                text, level = self._changed(change)
                batch.say(text, int(rows[order[change.row]]), level)
        begin = np.cumsum([0, *(len(part.rows) for part in parts)])
        for part in new:
            at = int(begin[next(i for i, p in enumerate(parts) if p is part)])
            self._heard_beside(part, int(use[at]), batch)
        by_source: dict[str, list[int]] = {}
        for i, part in enumerate(parts):
            by_source.setdefault(part.source, []).append(i)
        for source, which in by_source.items():
            columns = parts[which[0]].columns
            place = np.concatenate([np.arange(begin[i], begin[i + 1]) for i in which])
            if len(which) > 1:
                columns = {name: np.concatenate([parts[i].columns[name] for i in which]) for name in columns}
                mixed = np.argsort(rows[place], kind="stable")
                columns = {name: column[mixed] for name, column in columns.items()}
                place = place[mixed]
            self._send(source, rows[place], columns, streams[place], use[place], batch)

    def _meet(self, parts: list[Part], batch: Batch) -> list[Part]:
        """Enter the streams that are new into the choice, the first heard first."""
        new = []
        for part in sorted((p for p in parts if p.use.stream == NOBODY), key=lambda p: int(p.rows[0])):
            if part.use.stream == NOBODY and len(self.uses) < MOST:
                part.use.stream = self._choice.add(part.use.rank, part.use.instrument)
                self.uses.append(part.use)
                new.append(part)
            elif part.use.stream == NOBODY:
                batch.refuse(part.use.refused, f"{self._kind.stream}: {part.use.words}", TOO_MANY, part.rows)
        return new

    def _send(
        self,
        source: str,
        rows: NDArray[np.int64],
        columns: Columns,
        streams: NDArray[np.int64] | None,
        use: NDArray[np.int8] | None,
        batch: Batch,
    ) -> None:
        """Tell the rows of one source that are used or recorded: a message for every run of like ones.

        `streams` and `use` are None where all rows are of the stream that is used.
        """
        keep = None if use is None else use > 0
        if STAMP in columns:
            columns, keep = self._new_fixes(source, columns, keep)
        if keep is not None and not keep.all():
            rows, columns = rows[keep], {name: column[keep] for name, column in columns.items()}
            streams, use = (None, None) if streams is None or use is None else (streams[keep], use[keep])
        if not len(rows):
            return
        sigma = None if batch.t_sigma is None else batch.t_sigma[rows]
        if sigma is not None and not sigma.any():
            sigma = None
        edges = [0, len(rows)]
        if len(rows) > 1 and (use is not None or sigma is not None):
            like = np.zeros(len(rows), np.int64) if use is None or streams is None else streams * 2 + (use == 2)
            like = like * 2 + (0 if sigma is None else sigma != 0)
            edges = [0, *(np.flatnonzero(like[1:] != like[:-1]) + 1).tolist(), len(rows)]
        t, t_rx = batch.t[rows], batch.t_rx[rows]
        for begin, end in pairwise(edges):
            some = slice(begin, end)
            told: dict[str, Any] = {name: column[some] for name, column in columns.items()}
            told["t_sigma"] = sigma[some] if sigma is not None and sigma[begin] else None
            told["chosen"] = (use is None or bool(use[begin] == 2)) and not self._off
            batch.out.append(
                self._kind(vehicle=batch.vehicle, source=source, boot=batch.boot, t=t[some], t_rx=t_rx[some], **told)
            )

    def _new_fixes(
        self, source: str, columns: Columns, keep: NDArray[np.bool_] | None
    ) -> tuple[Columns, NDArray[np.bool_]]:
        """Of the rows to be told those that are fixes not told before; and the columns of a message."""
        keep = np.ones(len(columns[STAMP]), np.bool_) if keep is None else keep
        stamp = columns[STAMP][keep]
        if len(stamp):
            keep[keep] = once(stamp, self._fixes.get(source, 0))
            self._fixes[source] = int(stamp[-1])
        return {name: column for name, column in columns.items() if name != STAMP}, keep

    def _changed(self, change: Change) -> tuple[str, Level]:
        """What is said of another stream being used."""
        what, after = self._kind.stream, self.uses[change.after]
        if change.why == FIRST:
            vain = f"; {self._asked} of [ingest.sensors] has not been heard" if self._asked and after.rank[0] else ""
            return f"{what}: {after.words} ({after.why}{vain})", "info"
        before = self.uses[change.before]
        if change.why == SILENT:
            return (
                f"{what}: {after.words} takes over: nothing from {before.words} for {change.silence:.1f} s",
                "warning",
            )
        because = {BETTER: after.why, BACK: f"heard again for {PATIENCE * 1e-9:.0f} s"}[change.why]
        return f"{what}: {after.words} takes over from {before.words} ({because})", "info"

    def _heard_beside(self, part: Part, use: int, batch: Batch) -> None:
        """Say that a new stream is heard, unless it is the one that is used."""
        row, what = int(part.rows[0]), self._kind.stream
        words = f"{what}: {part.use.words}"
        if self._off and use:
            batch.say(f"{words} is recorded, not used: {what} is off in [ingest.sensors]", row)
        elif use == 1:
            batch.say(f"{words} is also heard: another instrument, recorded beside the one in use", row)
        elif use == 0:
            batch.say(f"{words} is also heard: the same instrument from further away, not used", row)
