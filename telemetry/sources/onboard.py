"""What on-board logs have in common: several sensors of a kind, holes, and the order in which a log is told.

A log was received by nobody, so `t_rx` is `t`; only what was written more than two seconds behind its time has a later
one, because everything before it has been told by then. Samples leave in blocks of five seconds of that time, each kind
and instance in one message, then a `Progress`. How the file was read plays no part.

Of several sensors of a kind the first one is chosen; when it is silent for five seconds while another goes on, that one
is, from then on. The others are told beside it.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from telemetry.messages import SENSORS, ClockFit, LinkBytes, Mark, Message, Progress, Sample, StatusText, Times, event
from telemetry.text import ground_mark

STAGE = "log"
LINK = "log"
SOURCE = f"{LINK}/1"  # the autopilot
S = 1_000_000_000
BLOCK = 5 * S
SLACK = 2 * S  # so far behind the newest may a message be written and still be in time
PATIENCE = 5 * S
HOLE = 0.1  # s, and five intervals of the sensor: a shorter silence is none
TOLD = 20  # holes told one by one, per boot

Level = Literal["info", "warning", "error"]
Columns = dict[str, Any]  # arrays, by name

_COLOUR = re.compile(r"\x1b\[[0-9;]*m")
_SPEAKER = re.compile(r"^(\[[\w-]+\]|SRC=\d+/\d+:)\s*")


class Stream(NamedTuple):
    """Samples of one sensor.

    Attributes
    ----------
    kind : type of Sample
    instance : int
    name : str
        What the log calls it.
    t, t_rx : int64 array, shape (k,)
        ns.
    columns : dict of str to array
        As in `kind`.
    eligible : bool
        The estimator may use it.
    """

    kind: type[Sample]
    instance: int
    name: str
    t: Times
    t_rx: Times
    columns: Columns
    eligible: bool = True


class Said(NamedTuple):
    """What the vehicle said in words, severity as in syslog."""

    t: int
    t_rx: int
    severity: int
    text: str


class Note(NamedTuple):
    """What a reader of the log should know."""

    t: int
    t_rx: int
    level: Level
    text: str


class Account(NamedTuple):
    """The byte account so far, as in `LinkBytes`; its frames are messages, `unknown` those that cannot be read."""

    bytes: int
    frames: int
    unknown: int
    corrupt: int
    discarded: int
    pending: int


def readable(text: str) -> str:
    """Text from a log: without colours; what is not printable is shown as a replacement character."""
    text = _COLOUR.sub("", text).rstrip()
    return "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in text)


def order(t: Times, t_rx: Times) -> NDArray[np.int64] | slice:
    """The rows in the order in which they are told."""
    if len(t) < 2 or ((np.diff(t_rx) >= 0).all() and (np.diff(t) >= 0).all()):
        return slice(None)
    return np.lexsort((t, t_rx))


class Teller:
    """Tells what a log holds in the vocabulary.

    Parameters
    ----------
    vehicle : int
    mark : str
        Regular expression of a test-point mark in a text (`telemetry.text`).
    account : callable
        Gives the byte account so far.
    """

    def __init__(self, vehicle: int, mark: str, account: Callable[[], Account]) -> None:
        self._vehicle, self._mark, self._account = vehicle, mark, account
        self._boot, self._begin, self._offset, self._interval = 0, 0, 0, 0.0
        self._pulse: type[Sample] | None = None
        self._chosen: dict[type[Sample], tuple[int, int]] = {}  # instance, when last heard
        self._names: dict[tuple[type[Sample], int], str] = {}
        self._beat: int | None = None  # time of the last sample of the sensor that shows holes
        self._holes: list[float] = []
        self._reached = 0

    def boot(self, number: int, begin: int, offset: int, pulse: type[Sample] | None, interval: float) -> None:
        """Begin a boot.

        Parameters
        ----------
        number : int
        begin : int
            Unix time of its first message, ns.
        offset : int
            Unix time at which its clock showed 0, ns.
        pulse : type of Sample or None
            The sensor whose silence is a hole in the log.
        interval : float
            Time between two of its samples, s.
        """
        self._boot, self._begin, self._offset = number, begin, offset
        self._pulse, self._interval = pulse, interval
        self._chosen, self._beat, self._holes = {}, None, []

    def tell(self, streams: Sequence[Stream], said: Sequence[Said], notes: Sequence[Note]) -> Iterator[Message]:
        """Tell what one boot holds up to a time that ends a block, or to its end."""
        streams = sorted(_merged(streams), key=lambda s: (SENSORS.index(s.kind), s.instance))
        ordered = []
        for stream in streams:
            self._names[stream.kind, stream.instance] = stream.name
            rows = order(stream.t, stream.t_rx)
            columns = {name: column[rows] for name, column in stream.columns.items()}
            ordered.append(stream._replace(t=stream.t[rows], t_rx=stream.t_rx[rows], columns=columns))
        said, notes = sorted(said, key=lambda s: (s.t_rx, s.t)), sorted(notes, key=lambda n: (n.t_rx, n.t))
        places = [self._place(s.t_rx) for s in ordered]
        words = self._place(np.array([s.t_rx for s in said], np.int64))
        remarks = self._place(np.array([n.t_rx for n in notes], np.int64))
        for block in np.unique(np.concatenate([words, remarks, *places])).tolist():
            cut = []
            for stream, where in zip(ordered, places, strict=True):
                first, last = np.searchsorted(where, (block, block + 1)).tolist()
                if first < last:
                    cut.append(_part(stream, slice(first, last)))
            yield from self._tell(
                cut,
                [s for s, place in zip(said, words.tolist(), strict=True) if place == block],
                [n for n, place in zip(notes, remarks.tolist(), strict=True) if place == block],
            )
        if self._reached:
            yield self._bytes()

    def end(self, fit: ClockFit | None) -> Iterator[Message]:
        """End a boot."""
        rest = self._holes[TOLD:]
        if rest:
            text = f"{len(rest)} more holes in the log, {sum(rest):.3g} s together"
            yield self._event(Note(self._reached, self._reached, "warning", text))
        if fit is not None:
            self._reached = max(self._reached, int(fit.t_rx[-1]))
            yield fit

    def finish(self, notes: Sequence[Note]) -> Iterator[Message]:
        """End the log."""
        for note in notes:
            yield self._event(note._replace(t=self._reached, t_rx=self._reached))
        yield self._bytes()
        now = np.array([self._reached], np.int64)
        yield Progress(vehicle=0, source=STAGE, boot=0, t=now, t_rx=now, final=True)

    def _place(self, t_rx: Times) -> NDArray[np.int64]:
        return (t_rx - self._begin) // BLOCK

    def _tell(self, streams: list[Stream], said: list[Said], notes: list[Note]) -> Iterator[Message]:
        pieces: list[tuple[Stream, bool]] = []
        for kind in dict.fromkeys(s.kind for s in streams):
            mine = [s for s in streams if s.kind is kind]
            pieces += self._choose(kind, mine, notes)
        self._find_holes([s.t for s, chosen in pieces if chosen and s.kind is self._pulse], notes)
        for note in sorted(notes, key=lambda n: (n.t_rx, n.t)):
            yield self._event(note)
        for stream, chosen in pieces:
            yield stream.kind(
                vehicle=self._vehicle,
                source=SOURCE + (f".{stream.instance}" if stream.instance else ""),
                boot=self._boot,
                t=stream.t,
                t_rx=stream.t_rx,
                chosen=chosen,
                **stream.columns,
            )
        yield from self._say(said)
        times = [int(s.t_rx[-1]) for s in streams] + [s.t_rx for s in said] + [n.t_rx for n in notes]
        self._reached = max(self._reached, *times)
        now = np.array([self._reached], np.int64)
        yield Progress(vehicle=0, source=STAGE, boot=0, t=now, t_rx=now)

    def _choose(self, kind: type[Sample], streams: list[Stream], notes: list[Note]) -> list[tuple[Stream, bool]]:
        """Cut the streams of a kind where another one becomes the chosen one."""
        times = {s.instance: s.t_rx for s in streams if s.eligible}
        if kind not in self._chosen and times:
            first = min(times)
            self._chosen[kind] = first, int(times[first][0])
        spans: list[tuple[int, int, int]] = []  # instance, from, to
        if kind in self._chosen:
            instance, heard = self._chosen[kind]
            since = int(np.iinfo(np.int64).min)
            nothing = np.empty(0, np.int64)
            while True:
                own = times.get(instance, nothing)
                own = own[own >= since]
                last = np.concatenate([[heard], own])
                found: list[tuple[int, int, float]] = []
                for other, theirs in times.items():
                    theirs = theirs[theirs >= since]
                    if other != instance and len(theirs):
                        silence = theirs - last[np.searchsorted(own, theirs, side="right")]
                        if (silence > PATIENCE).any():
                            at = int(np.argmax(silence > PATIENCE))
                            found.append((int(theirs[at]), other, float(silence[at]) * 1e-9))
                if not found:
                    spans.append((instance, since, int(np.iinfo(np.int64).max)))
                    self._chosen[kind] = instance, int(last[-1])
                    break
                at, other, silent = min(found)
                was, now = (self._names.get((kind, i), str(i)) for i in (instance, other))
                text = f"{kind.stream}: {was} has been silent for {silent:.1f} s: {now} is used from here on"
                notes.append(Note(at, at, "warning", text))
                spans.append((instance, since, at))
                instance, heard, since = other, at, at
        out: list[tuple[Stream, bool]] = []
        for stream in streams:
            chosen = np.zeros(len(stream.t), np.bool_)
            for instance, begin, end in spans:
                if instance == stream.instance and stream.eligible:
                    chosen |= (stream.t_rx >= begin) & (stream.t_rx < end)
            cuts = [0, *(np.flatnonzero(np.diff(chosen)) + 1).tolist(), len(chosen)]
            for first, last_row in pairwise(cuts):
                out.append((_part(stream, slice(first, last_row)), bool(chosen[first])))
        return out

    def _find_holes(self, times: list[Times], notes: list[Note]) -> None:
        if not times:
            return
        t = np.sort(np.concatenate(times))
        before = np.concatenate([[t[0] if self._beat is None else self._beat], t[:-1]])
        self._beat = max(int(t[-1]), int(before[0]))
        assert self._pulse is not None
        for i in np.flatnonzero((t - before) * 1e-9 > max(HOLE, 5 * self._interval)).tolist():
            length = float(t[i] - before[i]) * 1e-9
            self._holes.append(length)
            if len(self._holes) <= TOLD:
                at = (int(before[i]) - self._offset) * 1e-9
                text = f"{length:.2f} s hole in the log at {at:.2f} s since boot: no {self._pulse.stream} sample"
                notes.append(Note(int(t[i]), int(t[i]), "warning", text))

    def _say(self, said: list[Said]) -> Iterator[Message]:
        if not said:
            return
        common: dict[str, Any] = {"vehicle": self._vehicle, "source": SOURCE, "boot": self._boot}
        severity = np.array([s.severity for s in said], np.int64)
        yield StatusText(**common, **_times(said), severity=severity, text=[s.text for s in said])
        marks = [(s, self._marked(s.text)) for s in said]
        found = [(s, mark) for s, mark in marks if mark is not None and mark.vehicle in (0, self._vehicle)]
        if found:
            times = _times([s for s, _ in found])
            yield Mark(**common, **times, action=[m.action for _, m in found], name=[m.name for _, m in found])

    def _marked(self, text: str) -> Any:
        """The mark in a text, which may begin with the name of who spoke."""
        return ground_mark(text, self._mark) or ground_mark(_SPEAKER.sub("", text), self._mark)

    def _event(self, note: Note) -> Message:
        return event(
            note.text, level=note.level, vehicle=self._vehicle, source=STAGE, boot=self._boot, t=note.t, t_rx=note.t_rx
        )

    def _bytes(self) -> Message:
        account = self._account()
        now = np.array([self._reached], np.int64)
        columns: dict[str, Any] = account._asdict() | {"refused": 0}
        columns = {name: np.array([count], np.int64) for name, count in columns.items()}
        return LinkBytes(vehicle=0, source=LINK, boot=0, t=now, t_rx=now, **columns)


def _times(said: Sequence[Said]) -> dict[str, Any]:
    return {"t": np.array([s.t for s in said], np.int64), "t_rx": np.array([s.t_rx for s in said], np.int64)}


def _part(stream: Stream, rows: slice) -> Stream:
    columns = {name: column[rows] for name, column in stream.columns.items()}
    return stream._replace(t=stream.t[rows], t_rx=stream.t_rx[rows], columns=columns)


def _merged(streams: Sequence[Stream]) -> list[Stream]:
    """One stream per sensor: two layouts of a message may tell of the same one."""
    by_sensor: dict[tuple[type[Sample], int], list[Stream]] = {}
    for stream in streams:
        if len(stream.t):
            by_sensor.setdefault((stream.kind, stream.instance), []).append(stream)
    return [
        parts[0]
        if len(parts) == 1
        else parts[0]._replace(
            t=np.concatenate([p.t for p in parts]),
            t_rx=np.concatenate([p.t_rx for p in parts]),
            columns={name: np.concatenate([p.columns[name] for p in parts]) for name in parts[0].columns},
        )
        for parts in by_sensor.values()
    ]


def said_of(streams: dict[str, tuple[str, float]], others: dict[str, list[str]]) -> list[str]:
    """What is told at the beginning: which message feeds which sensor, at what rate, and what stands beside it.

    Parameters
    ----------
    streams : dict of str to (str, float)
        By sensor: the name of its message and the time between two, s.
    others : dict of str to list of str
        By sensor: names of the other messages of its kind.
    """
    lines = []
    for sensor, (name, interval) in streams.items():
        rate = f", {1 / interval:.3g} Hz" if interval > 0 else ""
        also = f"; also {', '.join(others[sensor])}" if others.get(sensor) else ""
        lines.append(f"{sensor} from {name}{rate}{also}")
    return lines


def last_before(t: Times, of: Times) -> NDArray[np.int64]:
    """Index of the last of `of`, in order, at or before each of `t`; -1 if there is none."""
    return np.searchsorted(of, t, side="right") - 1


def nearest(t: Times, of: Times, within: int) -> NDArray[np.int64]:
    """Index of the one of `of`, in order, that is nearest to each of `t`; -1 where none is so near, ns."""
    if not len(of):
        return np.full(len(t), -1)
    after = np.minimum(np.searchsorted(of, t), len(of) - 1)
    before = np.maximum(after - 1, 0)
    at = np.where(np.abs(of[before] - t) <= np.abs(of[after] - t), before, after)
    return np.where(np.abs(of[at] - t) <= within, at, -1)
