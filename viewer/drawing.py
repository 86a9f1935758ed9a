"""Drawing: what each kind of message becomes in a recording."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import msgspec
import numpy as np
import rerun as rr
from numpy.typing import NDArray

from telemetry.messages import Estimate, Event, Floats, Mark, Message, Report, StatusText, Times, Window
from viewer import style
from viewer.blueprint import Extent
from viewer.books import LEVELS, SEVERITIES
from viewer.columns import (
    TRAJECTORY,
    Seam,
    belief_columns,
    broken,
    broken_times,
    estimate_path,
    geodetic,
    joined,
    local_metres,
    merged,
    place,
    report_path,
    sensor_columns,
    slug,
    span,
    vehicle_path,
)
from viewer.sink import Sink, degrees
from viewer.summary import markdown, smoothed
from viewer.track import Strip, Track
from viewer.worth import markdown as page
from viewer.worth import worth


class Group(NamedTuple):
    """Messages of one kind from one sender that wait to be written together."""

    parent: str
    messages: list[Message]
    seam: Seam
    track: Track | None
    rows: list[int]  # one number: how many wait
    quick: bool  # drawn in the main plots; a chunk costs a kilobyte whatever is in it, so the others wait for a second


class Drawing:
    """Writes messages into the entities where a viewer looks for them.

    Parameters
    ----------
    main, layer : Sink
        Where everything goes, and where windows go; may be the same.
    gap : float
        Silence across which no line is drawn, s.
    silent : callable
        Told of every silence of a whole vehicle: vehicle, boot, beginning and end in ns.

    Attributes
    ----------
    origin : float array, shape (3,), or None
        The map's zero: latitude, longitude (rad), altitude (m).
    extents : dict of str to Extent
        Where each vehicle has been.
    """

    def __init__(self, main: Sink, layer: Sink, gap: float, silent: Callable[[int, int, int, int], None]) -> None:
        self.main, self.layer = main, layer
        self.origin: Floats | None = None
        self.extents: dict[str, Extent] = {}
        self._gap = gap
        self._silent = silent
        self._lines: dict[str, Group] = {}
        self._heard: dict[int, list[Message]] = {}  # sensor messages since the last boundary of the stream
        self._presence: dict[int, Seam] = {}
        self._windows: dict[tuple[int, str], dict[tuple[int, int], int]] = {}  # by vehicle and model, as all of windows
        self._scopes: dict[tuple[int, str], str] = {}
        self._mixed: set[tuple[int, str]] = set()
        self._placed: set[str] = set()
        self._begun: dict[tuple[int, int], int] = {}  # when a boot epoch was first heard
        self._styled: set[tuple[int, str]] = set()
        self._test_points: dict[str, list[str]] = {}

    def hear(self, message: Message) -> None:
        """Note that a vehicle was heard; drawn by `presences`."""
        self._heard.setdefault(message.vehicle, []).append(message)
        epoch, t = (message.vehicle, message.boot), span(message.t)[0]
        self._begun[epoch] = min(t, self._begun.get(epoch, t))

    def finish(self, groups: list[Group]) -> None:
        """Draw what was still growing."""
        self.presences()
        for group in groups:
            if group.track is not None:
                self.strips(group.parent, group.track, group.track.take())
        for vehicle, seam in self._presence.items():
            if seam.high is not None:
                self.main.state(f"{vehicle_path(vehicle)}/boot", seam.high + 1, seam.t_rx, None)

    def sensor(self, group: Group, run: list[Message]) -> None:
        """Raw quantities as rows of numbers, and fixes on the map."""
        t, t_rx = joined(run, "t"), joined(run, "t_rx")
        at, times, receive = group.seam.find(run[0].boot, t, t_rx)
        t_broken, rx_broken = broken_times(t, at, times), broken_times(t_rx, at, receive)
        parts = [sensor_columns(message) for message in run]
        for name in parts[0]:
            column = np.concatenate([part[name] for part in parts])
            entity = f"{group.parent}/{name}"
            self._style(self.main, entity, style.sensor, run[0].stream, name)
            self.main.scalars(entity, t_broken, rx_broken, broken(column, at))
        self._track(self.main, group, run, t, t_rx, at)

    def estimates(self, group: Group, run: list[Estimate]) -> None:
        """Live states with their variances, the innovation test, the track."""
        t, t_rx = joined(run, "t"), joined(run, "t_rx")
        at, times, receive = group.seam.find(run[0].boot, t, t_rx)
        t_broken, rx_broken = broken_times(t, at, times), broken_times(t_rx, at, receive)
        self._beliefs(self.main, run, t_broken, rx_broken, at, None)
        nis = np.column_stack([joined(run, "nis"), joined(run, "dof").astype(np.float64)])
        self._style(self.main, f"{group.parent}/nis", style.nis)
        self.main.scalars(f"{group.parent}/nis", t_broken, rx_broken, broken(nis, at))
        self._track(self.main, group, run, t, t_rx, at)

    def window(self, window: Window) -> None:
        """Smoothed states of a window, its figures and its lane."""
        stream = window.vehicle, window.model
        known = self._windows.setdefault(stream, {})
        first = (window.boot, window.number) not in known
        number = known.setdefault((window.boot, window.number), len(known))
        parent = estimate_path(window)
        if parent not in self._lines:
            self._lines[parent] = Group(parent, [], Seam(self._gap), Track(joins=True), [0], True)
        group = self._lines[parent]
        if self._scopes.setdefault(stream, window.scope) != window.scope and stream not in self._mixed:
            self._mixed.add(stream)
            which = "windows" if window.model == TRAJECTORY else f"windows of the {window.model.replace('_', ' ')}"
            text = (
                f"v{window.vehicle}: {which} smoothed at their closing and over the whole sortie lie in one recording"
            )
            self.main.texts("/events", window.t[:1], window.t_rx[:1], [text], ["WARN"])
        at, times, receive = group.seam.find(window.boot, window.t, window.t_rx)
        self._beliefs(
            self.layer, [window], broken_times(window.t, at, times), broken_times(window.t_rx, at, receive), at, number
        )
        self._track(self.layer, group, [window], window.t, window.t_rx, at)
        assert group.track is not None
        self.strips(parent, group.track, group.track.take())  # a window is whole: its last strip need not wait
        figures = smoothed(window)
        report = rr.TextDocument(markdown(figures), media_type=rr.MediaType.MARKDOWN)
        values = rr.AnyValues(verdict=msgspec.json.encode(figures).decode())
        # At its first row, so that the report of a window is the one that a cursor inside it shows.
        self.layer.once(f"{parent}/report", int(window.t[0]), int(window.t_rx[0]), report, values, window=number)
        if first:
            self._lane(window, number)

    def report(self, report: Report) -> None:
        """What a stretch of flight is worth, as a page, at its beginning: a cursor inside the stretch shows it.

        A whole sortie begins with its boot epoch, so that its page is there wherever the cursor stands.
        """
        told = worth(report)
        begin = report.begin
        if report.scope == "sortie":
            begin = min(begin, self._begun.get((report.vehicle, report.boot), begin))
        text = rr.TextDocument(page(told), media_type=rr.MediaType.MARKDOWN)
        values = rr.AnyValues(report=msgspec.json.encode(told).decode())
        self.layer.once(report_path(report), begin, int(report.t_rx[-1]), text, values)

    def _lane(self, window: Window, number: int) -> None:
        entity = f"{vehicle_path(window.vehicle)}/window"
        if window.model != TRAJECTORY:
            entity += f"/{slug(window.model)}"
        names = self._test_points.setdefault(entity, [])
        state = window.test_point or style.BETWEEN[number % 2]
        if window.test_point and window.test_point not in names:
            names.append(window.test_point)
            self.layer.static(entity, style.lane(names))
        elif number == 0:
            self.layer.static(entity, style.lane(names))
        self.layer.state(entity, int(window.t[0]), int(window.t_rx[0]), state)
        # One nanosecond early: the next window may begin at the very last row of this one.
        self.layer.state(entity, max(int(window.t[-1]) - 1, int(window.t[0]) + 1), int(window.t_rx[-1]), None)

    def _beliefs(
        self, sink: Sink, run: list[Any], t: Times, t_rx: Times, at: NDArray[np.intp], window: int | None
    ) -> None:
        whole = merged(run)
        for (entity, belief), name in zip(belief_columns(whole).items(), whole.names, strict=True):
            self._style(sink, entity, style.belief, entity, name, belief.unit)
            values, variances = broken(belief.values, at), broken(belief.variances, at)
            sink.measurements(entity, t, t_rx, values, variances, window)
        entity = f"{estimate_path(run[0])}/geodetic"
        points = broken(joined(run, "geodetic"), at)
        if entity not in self._placed:  # a model without a position has no column of nothing
            known = np.flatnonzero(np.isfinite(points).all(axis=1))
            if not len(known):
                return
            self._placed.add(entity)
            t, t_rx, points = t[known[0] :], t_rx[known[0] :], points[known[0] :]
        self._style(sink, entity, style.geodetic)
        sink.scalars(entity, t, t_rx, points, window)

    def clock(self, group: Group, messages: list[Message]) -> None:
        """What the vehicle clock was worth over time."""
        t, t_rx = joined(messages, "t"), joined(messages, "t_rx")
        for name, unit in (("offset", "s"), ("rate", "1")):
            entity = f"{group.parent}/{name}"
            self._style(self.main, entity, style.belief, entity, f"clock {name}", unit)
            self.main.measurements(
                entity, t, t_rx, joined(messages, name), np.square(joined(messages, f"{name}_sigma"))
            )
        self.plain(group, messages, {"delay": ("delay_p50", "delay_p99", "delay_max"), "span": ("span", "valid")})

    def plain(self, group: Group, messages: list[Message], entities: Mapping[str, tuple[str, ...]]) -> None:
        """Fields of messages as rows of numbers: entity name below the group's to its fields."""
        t, t_rx = joined(messages, "t"), joined(messages, "t_rx")
        for name, fields in entities.items():
            entity = f"{group.parent}/{name}" if name else group.parent
            self._style(self.main, entity, style.names, fields)
            self.main.scalars(
                entity, t, t_rx, np.column_stack([joined(messages, field).astype(np.float64) for field in fields])
            )

    def events(self, messages: list[Message]) -> None:
        """Events, status texts and marks as lines of one log."""
        texts: list[str] = []
        levels: list[str] = []
        for message in messages:
            who = f"v{message.vehicle}: " if message.vehicle else ""
            match message:
                case Event():
                    texts += [who + text for text in message.text]
                    levels += [LEVELS[level] for level in message.level]
                case StatusText():
                    texts += [f"{who}says: {text}" for text in message.text]
                    levels += [SEVERITIES[min(max(severity, 0), 7)] for severity in message.severity.tolist()]
                case Mark():
                    texts += [
                        f"{who}test point {name}: {action}"
                        for action, name in zip(message.action, message.name, strict=True)
                    ]
                    levels += ["INFO"] * len(message.action)
        self.main.texts("/events", joined(messages, "t"), joined(messages, "t_rx"), texts, levels)

    # -- the map --

    def place(self, message: Message) -> None:
        """The map's zero: the first place that anybody names."""
        if self.origin is None and (points := geodetic(message)) is not None:
            known = points[np.isfinite(points).all(axis=1)]
            if len(known):
                self.origin = known[0].copy()

    def _track(self, sink: Sink, group: Group, run: list[Any], t: Times, t_rx: Times, at: NDArray[np.intp]) -> None:
        if group.track is None:
            return
        points = np.concatenate([geodetic(message) for message in run])
        self.strips(group.parent, group.track, group.track.add(t, t_rx, points, at))
        if isinstance(run[0], Estimate) and self.origin is not None:
            known = np.isfinite(points).all(axis=1)
            if known.any():
                entity = f"{vehicle_path(run[0].vehicle)}/world/body{_branch(run[0].model)}"
                self._style(sink, entity, style.body, run[0].vehicle)
                here = local_metres(points[known], self.origin)
                sink.points(entity, t[known], t_rx[known], [row[None] for row in here])

    def strips(self, parent: str, track: Track, strips: list[Strip]) -> None:
        """Strips of track on the plan in metres and on the map in degrees."""
        if not strips or self.origin is None:
            return
        root, kind = "/" + parent.split("/")[1], parent.split("/")[-1]
        here = place(f"{parent}/geodetic")
        branch = "" if here is None else _branch(here.model)
        sink = self.layer if kind == "window" else self.main
        t, t_rx = np.array([s.t for s in strips]), np.array([s.t_rx for s in strips])
        metres = [local_metres(s.points, self.origin) for s in strips]
        angles = [degrees(s.points) for s in strips]
        self._see(root[1:], np.concatenate(metres))
        for view, rows in (("world", metres), ("geo", angles)):
            entity = f"{root}/{view}/{kind}{branch}"
            self._style(sink, entity, style.track, view, kind)
            write = {
                ("world", True): sink.lines,
                ("world", False): sink.points,
                ("geo", True): sink.geo_lines,
                ("geo", False): sink.geo_points,
            }[view, track.joins]
            write(entity, t, t_rx, rows)

    def _see(self, name: str, metres: Floats) -> None:
        low, high = metres.min(axis=0), metres.max(axis=0)
        was = self.extents.get(name, Extent(math.inf, math.inf, -math.inf, -math.inf))
        self.extents[name] = Extent(
            min(was.west, float(low[0])),
            min(was.south, float(low[1])),
            max(was.east, float(high[0])),
            max(was.north, float(high[1])),
        )

    # -- lanes, styles, layout --

    def presences(self) -> None:
        """Draw when a vehicle was heard, and in which boot epoch.

        Only at a boundary of the stream: there all samples of the past are known, so that a sensor that pauses while
        another goes on is no silence.
        """
        for vehicle, messages in self._heard.items():
            seam = self._presence.setdefault(vehicle, Seam(self._gap))
            entity = f"{vehicle_path(vehicle)}/boot"
            for boot in sorted({message.boot for message in messages}):
                mine = [message for message in messages if message.boot == boot]
                t, t_rx = joined(mine, "t"), joined(mine, "t_rx")
                order = np.argsort(t, kind="stable")
                t, t_rx = t[order], t_rx[order]
                new = seam.high is None
                at, times, receive = seam.find(boot, t, t_rx)
                for row, end, end_rx in zip(at.tolist(), times.tolist(), receive.tolist(), strict=True):
                    self.main.state(entity, end, end_rx, None)
                    self.main.state(entity, int(t[row]), int(t_rx[row]), f"boot {boot}")
                    self._silent(vehicle, boot, end - 1, int(t[row]))
                if new:
                    self.main.state(entity, int(t[0]), int(t_rx[0]), f"boot {boot}")
        self._heard.clear()

    def _style(self, sink: Sink, entity: str, what: Callable[..., Any], *arguments: Any) -> None:
        if (id(sink), entity) not in self._styled:
            self._styled.add((id(sink), entity))
            sink.static(entity, what(*arguments))


def _branch(model: str) -> str:
    """What sets the track of a model apart from that of the trajectory."""
    return "" if model == TRAJECTORY else f".{slug(model)}"
