"""Marks of test points that no vehicle says: said live from the ground, and read from a file afterwards.

A file names test points by rows. In a CSV file the first row names the columns; `vehicle` may be left out, or left
empty::

    name,start,stop,vehicle
    1,12.5,40,
    phugoid,95,150.2,7

and in a TOML file each is a table::

    [[test_point]]
    name = "phugoid"
    start = 2026-11-22T10:15:03.5Z
    stop = 2026-11-22T10:16:10Z
    vehicle = 7

A time is one of the recording's time axis (the vehicle's clock, anchored to the receive time): seconds from the first
sample of the log, UTC with its zone, or Unix seconds (numbers from `UNIX` on).
"""

from __future__ import annotations

import csv
import math
import socket
import time
import tomllib
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numba import njit

from telemetry.messages import SENSORS, Event, Mark, Message, Progress, Times, event
from telemetry.text import STATION, STATION_COMPONENT, Action, ground_text

STAGE = "marks"
S = 1_000_000_000
UNIX = 100_000_000  # a number of seconds from here on is Unix time: a log lasts no three years
LATEST = 7_258_118_400  # the year 2200, s
LEAP, BACK = 10 * S, 2 * S  # a time further ahead or behind counts only when others confirm it, as in the estimator,
LEAPT, STEPPED = 2, 10  # so many with it
ANSWER = 0.2  # s in which this machine says that nobody listens on a port of its own
COLUMNS = ("name", "start", "stop", "vehicle")


def say(endpoint: str, action: Action, name: str, vehicle: int = 0) -> str:
    """Mark a test point live: send a STATUSTEXT, as a ground station, to where `sortie live` listens.

    Parameters
    ----------
    endpoint : str
        ``udpout:HOST:PORT``.
    action : {"start", "stop"}
    name : str
    vehicle : int
        System id of the vehicle that it is about; 0 is every vehicle heard.

    Returns
    -------
    str
        The text that was sent.

    Raises
    ------
    ValueError
        If the endpoint, the name or the vehicle cannot be used.
    OSError
        If the host is not known or, for a port of this machine, nobody listens there.
    """
    from pymavlink.dialects.v20 import common

    from telemetry.sources.endpoint import parse_endpoint

    text = ground_text(action, name, vehicle)
    there = parse_endpoint(endpoint)
    if there.scheme != "udpout":
        raise ValueError(f"{endpoint!r}: a mark is sent to where sortie live listens, e.g. udpout:127.0.0.1:14550")
    station = common.MAVLink(None, srcSystem=STATION, srcComponent=STATION_COMPONENT)
    station.seq = time.time_ns() // (S // 10) & 255  # a mark and its copies over other links share it, the next has not
    frame = bytes(common.MAVLink_statustext_message(common.MAV_SEVERITY_NOTICE, text.encode()).pack(station))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        try:
            sock.connect((there.host, there.port))
            sock.send(frame)
            sock.settimeout(ANSWER)
            sock.recv(1)
        except TimeoutError:
            pass  # nobody answers a mark: this is how it looks when it has arrived
        except ConnectionRefusedError as error:
            said = f"{there}: nobody listens there, so the mark is lost; is sortie live running, and on this port?"
            raise OSError(error.errno, said) from None
        except OSError as error:
            raise OSError(error.errno, f"{there}: {error.strerror or error}") from None
    return text


class Point(NamedTuple):
    """A test point of a file.

    Attributes
    ----------
    name : str
    start, stop : int
        ns, of Unix time or, if `relative`, from the first sample of the log.
    vehicle : int
        System id; 0 is every vehicle.
    relative : bool
    """

    name: str
    start: int
    stop: int
    vehicle: int = 0
    relative: bool = False

    def __str__(self) -> str:
        if self.relative:
            return f"test point {self.name} ({self.start / S:g} s to {self.stop / S:g} s)"
        return f"test point {self.name} ({_utc(self.start)} to {_utc(self.stop)})"


def read(path: Path) -> list[Point]:
    """Test points of a TOML or CSV file, in the order of their beginning.

    Raises
    ------
    ValueError
        If the file, a row, a key or a value cannot be used; the text names them and the way out.
    OSError
        If it cannot be opened.
    """
    kind = path.suffix.lower()
    if kind not in (".toml", ".csv"):
        raise ValueError(f"{path} is neither .toml nor .csv: test points are read from these")
    try:
        rows = _toml_rows(path) if kind == ".toml" else _csv_rows(path)
        placed = [(where, _point(where, row)) for where, row in rows]
        if not placed:
            raise ValueError("no test point in it: each has " + ", ".join(COLUMNS[:3]) + " and, if wanted, vehicle")
        _compare(placed)
    except (ValueError, csv.Error) as error:  # those of tomllib and of text that is no UTF-8 are among them
        raise ValueError(f"{path}: {error}") from None
    return sorted((point for _, point in placed), key=lambda point: point.start)


def _toml_rows(path: Path) -> Iterator[tuple[str, dict[str, Any]]]:
    found = tomllib.loads(path.read_text("utf-8"))
    rows = found.pop("test_point", [])
    if found:
        raise ValueError(f"unknown key {next(iter(found))!r}: each test point is a table under [[test_point]]")
    if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
        raise ValueError("test_point is no list of tables: write [[test_point]] above each")
    for number, row in enumerate(rows, 1):
        _known(f"test_point {number}", row)
        yield f"test_point {number}", row


def _csv_rows(path: Path) -> Iterator[tuple[str, dict[str, Any]]]:
    with path.open(encoding="utf-8-sig", newline="") as file:
        lines = csv.reader(file, strict=True)
        columns = [column.strip() for column in next(lines, [])]
        if columns:
            _known("row 1", columns)
            if len(set(columns)) < len(columns):
                raise ValueError(f"row 1: a column is there twice: {', '.join(columns)}")
        for cells in lines:
            where = f"row {lines.line_num}"
            values = [cell.strip() for cell in cells]
            if not any(values):
                continue
            if len(values) != len(columns):
                raise ValueError(f"{where}: {len(values)} values where row 1 names {len(columns)} columns")
            yield where, {column: value for column, value in zip(columns, values, strict=True) if value}


def _known(where: str, keys: Iterable[str]) -> None:
    for key in keys:
        if key not in COLUMNS:
            raise ValueError(f"{where}: unknown {key!r}: there are name, start, stop and, if wanted, vehicle")


def _point(where: str, row: dict[str, Any]) -> Point:
    for key in COLUMNS[:3]:
        if key not in row:
            raise ValueError(f"{where}: {key} is missing")
    name = row["name"]
    if type(name) not in (str, int) or not str(name).strip() or not str(name).isprintable():
        raise ValueError(f"{where}: name = {name!r}: a name is printable text")
    vehicle = row.get("vehicle", 0)
    if isinstance(vehicle, str) and vehicle.isascii() and vehicle.isdigit() and len(vehicle) < 4:
        vehicle = int(vehicle)
    if "vehicle" in row and (type(vehicle) is not int or not 1 <= vehicle <= 255):
        raise ValueError(f"{where}: vehicle = {row['vehicle']!r} is no MAVLink system, 1 to 255; leave it out for all")
    (start, relative), (stop, other) = (_time(f"{where}: {key} = {row[key]}", row[key]) for key in ("start", "stop"))
    if relative != other:
        raise ValueError(f"{where}: only one of start and stop counts from the first sample: tell both alike")
    if stop <= start:
        raise ValueError(f"{where}: stop = {row['stop']} is not after start = {row['start']}")
    return Point(str(name).strip(), start, stop, vehicle, relative)


def _time(what: str, value: Any) -> tuple[int, bool]:
    """A time in ns, and whether it counts from the first sample of the log."""
    if isinstance(value, str):
        try:
            value = float(value)
        except ValueError:
            try:
                value = datetime.fromisoformat(value)
            except ValueError:
                raise ValueError(f"{what}: {_TIMES}") from None
    if isinstance(value, datetime):
        if value.tzinfo is None:
            raise ValueError(f"{what}: no zone: end it with Z, or with an offset such as +02:00")
        since = value - datetime(1970, 1, 1, tzinfo=UTC)
        ns = (since.days * 86400 + since.seconds) * S + since.microseconds * 1000
        relative = False
    elif type(value) in (int, float) and math.isfinite(value):
        relative = value < UNIX
        ns = round(value * S) if abs(value) <= LATEST else -1
    else:
        raise ValueError(f"{what}: {_TIMES}")
    if not 0 <= ns <= LATEST * S:
        raise ValueError(f"{what}: before the first sample, or beyond the year 2200")
    return ns, relative


_TIMES = "a time is seconds from the first sample, Unix seconds, or UTC such as 2026-11-22T10:15:03Z"


def _compare(placed: Sequence[tuple[str, Point]]) -> None:
    """Refuse what does not go together."""
    (first, point), *rest = placed
    for where, other in rest:
        if other.relative != point.relative:
            raise ValueError(
                f"{where}: times count from the first sample in some test points and not in others ({first}): "
                "tell all alike"
            )
    for vehicle in sorted({point.vehicle for _, point in placed}):
        mine = [one for one in placed if one[1].vehicle in (0, vehicle)]
        for (before, a), (after, b) in pairwise(sorted(mine, key=lambda one: one[1].start)):
            if b.start < a.stop:
                raise ValueError(
                    f"{after}: {b} begins before {a} of {before} ends: a vehicle flies one test point at a time"
                )


@njit(cache=True, nogil=True)
def _reached(t, state, seen):  # type: ignore[no-untyped-def]
    """Fill the newest time believed after each arrival, int64 (k,), ns; state (4,): it, how many arrivals say that the
    clock leapt, how many that it stepped back, how many there were.
    """
    for i in range(len(t)):
        newest = state[0]
        state[1] = state[1] + 1 if t[i] > newest + LEAP else 0
        state[2] = state[2] + 1 if t[i] < newest - BACK else 0
        usual = state[1] == 0 and t[i] > newest
        if usual or state[3] == 0 or state[1] == LEAPT or state[2] == STEPPED:
            state[0] = t[i]
            state[1] = state[2] = 0
        state[3] += 1
        seen[i] = state[0]


class _Track:
    """The samples of one vehicle in one boot epoch, and how far it has come in its test points."""

    def __init__(self) -> None:
        self.waiting: list[tuple[Times, Times]] = []  # t_rx, t
        self.state = np.zeros(4, np.int64)
        self.span: tuple[int, int] | None = None  # times of its first and its last sample
        self.started: set[int] = set()  # of the test points, by number
        self.stopped: set[int] = set()

    def covered(self, until: int) -> tuple[Times, Times]:
        """Receive times of what has arrived up to `until`, in order, and the newest times believed."""
        if not self.waiting:
            return np.empty(0, np.int64), np.empty(0, np.int64)
        t_rx, t = (np.concatenate(column) for column in zip(*self.waiting, strict=True))
        now = t_rx <= until
        self.waiting = [] if now.all() else [(t_rx[~now], t[~now])]
        order = np.lexsort((t[now], t_rx[now]))
        t_rx, t = t_rx[now][order], t[now][order]
        seen = np.empty(len(t), np.int64)
        _reached(t, self.state, seen)
        if len(seen):
            first, last = self.span or (int(seen[0]), int(seen[0]))
            self.span = first, max(last, int(seen.max()))
        return t_rx, seen


def insert(messages: Iterable[Message], points: Sequence[Point]) -> Iterator[Message]:
    """Put the marks of a file into a stream of samples.

    A mark is told when the vehicle's clock reaches it, with the receive time of the first sample that is not older, so
    that it comes neither too late nor far ahead. Where a boot begins inside a test point, the point begins again.

    Parameters
    ----------
    messages : iterable of Message
        The output of `telemetry.ingest.ingest`. Marks among them stay.
    points : sequence of Point
        As `read` gives them.

    Yields
    ------
    Message
        The same messages, with the marks and, at the end, warnings of test points that lie outside the log. They do
        not depend on how the stream was cut into batches.
    """
    placing = _Placing(points)
    for message in messages:
        if isinstance(message, SENSORS):
            placing.tracks[message.vehicle, message.boot].waiting.append((message.t_rx, message.t))
        elif isinstance(message, Progress):
            until = int(message.t_rx[-1])
            yield from placing.advance(np.iinfo(np.int64).max if message.final else until)
            if message.final:
                yield from placing.finish(until)
        yield message


class _Placing:
    """Where the test points of a file come to lie in the log."""

    def __init__(self, points: Sequence[Point]) -> None:
        self.tracks: dict[tuple[int, int], _Track] = defaultdict(_Track)  # by vehicle and boot
        self._points = sorted(points, key=lambda point: point.start)
        self._origin: int | None = None  # time of the first sample of the log

    def advance(self, until: int) -> Iterator[Mark]:
        """The marks that the samples received up to `until` have reached."""
        arrived = {key: track.covered(until) for key, track in sorted(self.tracks.items())}
        arrived = {key: rows for key, rows in arrived.items() if len(rows[0])}
        if self._origin is None and arrived:
            self._origin = min((int(t_rx[0]), int(seen[0])) for t_rx, seen in arrived.values())[1]
        for (vehicle, boot), (t_rx, seen) in arrived.items():
            yield from self._reach(vehicle, boot, t_rx, seen)

    def _reach(self, vehicle: int, boot: int, t_rx: Times, seen: Times) -> Iterator[Mark]:
        track = self.tracks[vehicle, boot]
        common: dict[str, Any] = {"vehicle": vehicle, "source": STAGE, "boot": boot}
        for i, point in enumerate(self._points):
            if point.vehicle not in (0, vehicle):
                continue
            start, stop = self._span(point)
            row = 0
            if i not in track.started:
                inside = (seen >= start) & (seen <= stop)
                if not inside.any():
                    continue
                row = int(inside.argmax())
                track.started.add(i)
                yield Mark(**common, t=np.array([start]), t_rx=t_rx[row : row + 1], action=["start"], name=[point.name])
            if i not in track.stopped and (over := seen[row:] >= stop).any():
                row += int(over.argmax())
                track.stopped.add(i)
                yield Mark(**common, t=np.array([stop]), t_rx=t_rx[row : row + 1], action=["stop"], name=[point.name])

    def _span(self, point: Point) -> tuple[int, int]:
        shift = (self._origin or 0) if point.relative else 0
        return point.start + shift, point.stop + shift

    def finish(self, now: int) -> Iterator[Event]:
        """Warnings of the test points that the log does not hold, or not all of."""
        vehicles = sorted({vehicle for vehicle, _ in self.tracks})
        for i, point in enumerate(self._points):
            tracks = [track for (vehicle, _), track in self.tracks.items() if point.vehicle in (0, vehicle)]
            if not tracks:
                heard = ", ".join(map(str, vehicles)) or "none"
                said = f"{point} is not used: the log holds no samples of vehicle {point.vehicle}, but of {heard}"
                if not point.vehicle:
                    said = f"{point} is not used: the log holds no samples"
            else:
                start, stop = self._span(point)
                spans = [track.span for track in tracks if track.span]
                first, last = min(a for a, _ in spans), max(b for _, b in spans)
                span = f"{_told(first, self._origin, point)} to {_told(last, self._origin, point)}"
                if not any(i in track.started for track in tracks):
                    said = f"{point} is not used: the log, {span}, holds no sample in it"
                elif start < first or last < stop:
                    said = f"{point} reaches beyond the log, {span}: it is cut there"
                else:
                    continue
            yield event(said, level="warning", vehicle=point.vehicle, source=STAGE, t=now, t_rx=now)


def _told(t: int, origin: int | None, point: Point) -> str:
    """A time, as the test point tells its own."""
    return f"{(t - (origin or 0)) / S:.1f} s" if point.relative else _utc(t)


def _utc(t: int) -> str:
    return datetime.fromtimestamp(t // S, UTC).strftime("%Y-%m-%dT%H:%M:%S") + f".{t % S // 10**8}Z"
