"""Recorder: messages into one Rerun recording, by columns, headless."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import rerun as rr

from telemetry.messages import (
    SENSORS,
    ClockFit,
    Estimate,
    Event,
    Health,
    LinkBytes,
    LinkStats,
    Mark,
    Message,
    Progress,
    Report,
    Sample,
    StatusText,
    Window,
)
from viewer.blueprint import Extent, layout
from viewer.books import BYTES, CONSUMED, COUNTERS, Books
from viewer.columns import GAP, TRAJECTORY, Seam, estimate_path, runs, slug, vehicle_path
from viewer.drawing import Drawing, Group
from viewer.journal import Journal
from viewer.sink import Sink, claim
from viewer.summary import Summary
from viewer.track import Track

ROWS = 8192  # rows of one entity that are worth a chunk of their own, whatever the time
SLOW = 2.0  # s of receive time after which what nobody waits for is written
FLUSH = 1.0  # s between two flushes
STEP = 10.0  # s: by so much no receive time is behind another, unless the clock has been set back


def record(
    messages: Iterable[Message],
    path: str | Path,
    *,
    windows: str | Path | None = None,
    sortie: str,
    completeness: str | Callable[[], str] = "complete",
    properties: Mapping[str, str] | None = None,
    interval: float | None = 0.1,
    on_alarm: Callable[[str], None] | None = None,
) -> Summary:
    """Write a stream of messages into a recording.

    Parameters
    ----------
    messages : iterable of Message
        Any kinds, several vehicles, several boot epochs.
    path : path
        New file for everything; for everything but windows and reports if ``windows`` is given.
    windows : path, optional
        New file for windows and reports: a layer of the same recording.
    sortie : str
        Name, and recording id.
    completeness : str or callable
        What is known of the input; a callable is asked at the end. Without any sample it becomes "no data".
    properties : mapping of str to str, optional
        What ran: stored in the recording.
    interval : float or None
        Receive time after which what waits is written, s; None offline, where only full chunks are.
    on_alarm : callable, optional
        Told when writing fails or works again. Recording goes on.

    Returns
    -------
    Summary
        Also stored in the recording; a recording without it was not closed.

    Raises
    ------
    FileExistsError
        If a file exists: recordings are never overwritten.
    OSError
        If a file cannot be created.
    """
    recorder = Recorder(
        path, windows=windows, sortie=sortie, properties=properties, interval=interval, on_alarm=on_alarm
    )
    try:
        for message in messages:
            recorder.write(message)
    except BaseException:
        recorder.close("interrupted")  # what has been recorded until here is kept
        raise
    return recorder.close(completeness() if callable(completeness) else completeness)


class Recorder:
    """A recording that grows by one message after the other; parameters as in `record`.

    Parameters
    ----------
    gap : float
        Silence across which no line is drawn, s.
    serve : int, optional
        Port on 127.0.0.1 at which a Rerun viewer may look on.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        windows: str | Path | None = None,
        sortie: str,
        properties: Mapping[str, str] | None = None,
        interval: float | None = 0.1,
        on_alarm: Callable[[str], None] | None = None,
        gap: float = GAP,
        serve: int | None = None,
    ) -> None:
        self._interval = math.inf if interval is None else interval * 1e9
        self._live = interval is not None
        self._gap = gap
        self._tell = on_alarm
        self._alarms: list[str] = []
        path = Path(path)
        claim(path)
        if windows is not None:
            try:
                claim(Path(windows))
            except OSError:
                path.unlink()  # just created, empty
                raise
        self._main = (Journal if self._live else Sink)(path, sortie, self._alarm, serve=serve)
        self._layer = self._main if windows is None else Sink(Path(windows), sortie, self._alarm, join=serve)
        self._books = Books(sortie, gap)
        self._books.summary.properties = dict(properties or {})
        self._main.property(
            "run", sortie=sortie, gap=gap, **{slug(key): str(value) for key, value in (properties or {}).items()}
        )
        self._drawing = Drawing(self._main, self._layer, gap, self._books.silent)
        self._groups: dict[tuple[Any, ...], Group] = {}
        self._components: dict[tuple[int, str], dict[tuple[str, bool], str]] = {}
        self._drawn: frozenset[str] = frozenset()
        # Receive times from which on groups wait, in order; by quickness.
        self._waiting: dict[bool, deque[tuple[int, Group]]] = {True: deque(), False: deque()}
        self._thread = ThreadPoolExecutor(1, "record")  # flushes and lays out, which takes longer than data may wait
        self._flushing: Future[list[Callable[[], bool]]] | None = None
        self._flushed = time.monotonic()

    def write(self, message: Message) -> None:
        """Take one message; writes when it is time to."""
        self._books.add(message, time.time_ns() if self._live else None)
        if isinstance(message, Progress):
            self._drawing.presences()
        else:
            self._drawing.place(message)
            if isinstance(message, Window):
                self._drawing.window(message)
            elif isinstance(message, Report):
                self._drawing.report(message)
            else:
                group = self._group(message)
                if self._live and not group.messages:
                    self._waiting[group.quick].append((int(message.t_rx[-1]), group))
                group.messages.append(message)
                group.rows[0] += len(message.t)
                if group.rows[0] >= ROWS:
                    self._write(group)
        if isinstance(message, SENSORS):
            self._drawing.hear(message)
        if self._live:
            self._write_due(int(message.t_rx[-1]))
        late = time.monotonic() - self._flushed >= FLUSH
        if self._flushing is not None and (late or self._flushing.done()):
            self._settle()  # what comes faster than it can be written waits here, and not in memory
        if late:
            self._begin_flush()

    def flush(self) -> None:
        """Bring everything to the disk; a failure is an alarm, not an error."""
        self._settle()
        if self._live:
            self._write_all()
        self._begin_flush()
        self._settle()

    def _begin_flush(self) -> None:
        """Bring what has been written to the disk, and the layout up to date, while this goes on."""
        self._flushed = time.monotonic()
        entities, extents = frozenset(self._main.entities | self._layer.entities), dict(self._drawing.extents)
        self._flushing = self._thread.submit(self._bring, entities, extents, self._live)

    def _settle(self) -> None:
        """Wait for a flush that is under way, and take note of what became of it."""
        if self._flushing is not None:
            flushing, self._flushing = self._flushing, None
            for rest in flushing.result():
                rest()

    def _bring(
        self, entities: frozenset[str], extents: Mapping[str, Extent], live: bool, again: bool = False
    ) -> list[Callable[[], bool]]:
        """Store the layout anew when there is more to lay out, and flush; in the thread."""
        if again or entities != self._drawn:
            self._drawn = entities
            self._main.layout(layout(entities, extents, live=live))
        return [sink.sync() for sink in ([self._main] if self._layer is self._main else [self._main, self._layer])]

    def close(self, completeness: str = "complete") -> Summary:
        """Write what waits, store the summary and finish the files."""
        self._write_all()
        self._drawing.finish(list(self._groups.values()))
        empty = self._books.summary.rows == 0
        if empty:
            self._main.static(
                "/note", rr.TextDocument("# No data\nNot a single sample arrived.", media_type=rr.MediaType.MARKDOWN)
            )
        else:
            self._main.started(self._books.summary.t_rx0)
        self._settle()
        entities = frozenset(self._main.entities | self._layer.entities)
        whole = [rest() for rest in self._bring(entities, self._drawing.extents, live=False, again=True)]
        self._thread.shutdown()
        if empty:
            completeness = "no data"
        elif (self._alarms and completeness == "complete") or not all(whole):
            completeness = "truncated"
        summary = self._books.close(completeness, self._alarms)
        if self._drawing.origin is not None:
            summary.origin = [*np.degrees(self._drawing.origin[:2]).tolist(), float(self._drawing.origin[2])]
        self._main.property("sortie", completeness=completeness, summary=msgspec.json.encode(summary).decode())
        if self._layer is not self._main:
            self._layer.close()
        self._main.close()
        summary.alarms = list(self._alarms)
        return summary

    def _alarm(self, text: str) -> None:
        self._alarms.append(text)
        if self._tell is not None:
            self._tell(text)

    # -- where messages wait --

    def _group(self, message: Message) -> Group:
        root = vehicle_path(message.vehicle)
        track = None
        key: tuple[Any, ...]
        match message:
            case Event() | StatusText() | Mark():
                key, parent = ("events",), "/events"
            case LinkStats():
                link, _, component = message.source.partition("/")
                key = ("link", message.vehicle, message.source)
                parent = f"/link/{slug(link)}/v{message.vehicle}" + (f".{slug(component)}" if component else "")
            case LinkBytes():
                key, parent = ("bytes", message.source), f"/link/{slug(message.source)}/bytes"
            case ClockFit():
                key, parent = ("clock", message.vehicle), f"{root}/clock"
            case Health():
                parent = f"/health/{slug(message.source)}/{slug(message.stage)}"
                key = ("health", parent)
            case Estimate():
                parent, track = estimate_path(message), Track(joins=True)
                key = ("live", parent)
            case _:
                component = message.source.partition("/")[2] or message.source
                chosen = not isinstance(message, Sample) or message.chosen
                names = self._components.setdefault((message.vehicle, message.stream), {})
                # The first component that is used has the plain name; a second receiver stands beside it, not among its
                # rows, and so do those that are only compared.
                plain = chosen and message.stream not in names.values()
                name = names.setdefault(
                    (component, chosen), message.stream if plain else f"{message.stream}.{slug(component)}"
                )
                key, parent = (message.vehicle, name), f"{root}/raw/{name}"
                if message.stream == "gnss" and chosen:
                    track = Track(joins=False)
        if key not in self._groups:
            quick = isinstance(message, (Event, StatusText, Mark))
            quick |= isinstance(message, Estimate) and message.model == TRAJECTORY  # others have many states
            self._groups[key] = Group(parent, [], Seam(self._gap), track, [0], quick)
        return self._groups[key]

    def _write_all(self) -> None:
        for group in self._groups.values():
            if group.messages:
                self._write(group)

    def _write_due(self, now: int) -> None:
        """Write one group of each quickness, if it is time: all at once would keep the messages behind waiting."""
        for quick, queue in self._waiting.items():
            wait = self._interval if quick else max(self._interval, SLOW * 1e9)
            while queue and not now - wait < queue[0][0] < now + STEP * 1e9:
                group = queue.popleft()[1]
                if group.messages:  # else written before, because it was full
                    self._write(group)
                    break

    def _write(self, group: Group) -> None:
        messages = list(group.messages)
        group.messages.clear()
        group.rows[0] = 0
        match messages[0]:
            case Event() | StatusText() | Mark():
                self._drawing.events(messages)
            case LinkStats():
                self._drawing.plain(group, messages, {"counters": COUNTERS, "loss": ("loss", "loss_total")})
            case LinkBytes():
                self._drawing.plain(group, messages, {"": BYTES})
            case ClockFit():
                self._drawing.clock(group, messages)
            case Health():
                ages = ("age_p50", "age_p99", "age_max")
                self._drawing.plain(group, messages, {"age": ages, "counters": CONSUMED})
            case Estimate():
                for run in runs(messages):
                    self._drawing.estimates(group, run)
            case _:
                for run in runs(messages):
                    self._drawing.sensor(group, run)
