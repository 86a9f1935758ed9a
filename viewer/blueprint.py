"""Blueprint: the layout that a recording carries, made from the entities that it holds."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping
from typing import Any, NamedTuple

import rerun as rr
import rerun.blueprint as rrb

from viewer.columns import TRAJECTORY, first, model_path, place, role, slug
from viewer.states import GROUPS, OTHERS, group, measured, order, words

TIMELINE = "t_vehicle"
_STAGES = ("live", "window")
_SHOWN = {
    "altitude": "Altitude, m",
    "climb_rate": "Climb rate, m/s",
    "velocity_north": "North velocity, m/s",
    "velocity_east": "East velocity, m/s",
}
_UNITS = {"Velocities": "m/s", "Angles": "rad", "Air data and wind": "m/s"}
_UNIT = {
    "h": "m",
    **dict.fromkeys(("alpha", "beta", "b_alpha", "b_beta"), "rad"),
    **dict.fromkeys(("ba_x", "ba_y", "ba_z"), "m/s2"),
    **dict.fromkeys(("bg_x", "bg_y", "bg_z"), "rad/s"),
}


class Extent(NamedTuple):
    """Box around a track in local metres: east and north, low and high."""

    west: float
    south: float
    east: float
    north: float


def layout(entities: Collection[str], extents: Mapping[str, Extent] | None = None, *, live: bool = False) -> Any:
    """Default layout of a recording.

    Parameters
    ----------
    entities : collection of str
        Entity paths that hold data. Of each state both the live and the smoothed entity are laid out, whether there
        already or not: windows come later, and often from another file.
    extents : mapping of str to Extent, optional
        Where each vehicle (``v1``) has been: what the eye above the map must see.
    live : bool
        Whether the plots follow the last two minutes; else they show the whole flight.

    Returns
    -------
    rerun.blueprint.Blueprint
        One tab per vehicle, then events and links; no map that would fetch tiles from the network.
    """
    vehicles = sorted({path.split("/")[1] for path in entities if _vehicle(path)}, key=lambda name: (len(name), name))
    pages: list[Any] = [
        _page(name, entities, (extents or {}).get(name), live=live, alone=len(vehicles) == 1) for name in vehicles
    ]
    if not pages:
        pages = [rrb.Vertical(rrb.TextDocumentView(name="Note", origin="/note"), _events(), name="Sortie")]
    root = pages[0] if len(pages) == 1 else rrb.Tabs(*pages, active_tab=0)
    return rrb.Blueprint(
        root,
        rrb.TimePanel(state="collapsed", timeline=TIMELINE, play_state="following" if live else None),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        auto_views=False,
        auto_layout=False,
    )


def _vehicle(path: str) -> bool:
    name = path.split("/")[1]
    return name.startswith("v") and name[1:].isdigit()


def _page(name: str, entities: Collection[str], extent: Extent | None, *, live: bool, alone: bool) -> Any:
    """One tab per model; the trajectory's, with the map, stands alone where there is no other."""
    root, title = f"/{name}", f"Vehicle {name[1:]}"
    others = [model for model in _models(root, entities) if model != TRAJECTORY]
    if not others:
        return _trajectory(root, entities, extent, title, live=live, alone=alone)
    pages = [_flight_path(root, model, entities, title, live=live, alone=alone) for model in others]
    if any(_states(root, TRAJECTORY, entities)):
        pages.insert(0, _trajectory(root, entities, extent, "Trajectory", live=live, alone=alone))
    for page, model in zip(pages[-len(others) :], others, strict=True):
        page.name = model.replace("_", " ").capitalize() if len(pages) > 1 else title
    return pages[0] if len(pages) == 1 else rrb.Tabs(*pages, active_tab=len(pages) - 1, name=title)


def _trajectory(
    root: str, entities: Collection[str], extent: Extent | None, title: str, *, live: bool, alone: bool
) -> Any:
    axis = _axis(live=live)
    states = _states(root, TRAJECTORY, entities)
    raw = {path for path in entities if path.startswith(f"{root}/raw/")}
    parent = model_path(int(root[2:]), TRAJECTORY)
    # One legend is enough, since a colour means the same everywhere: the others would cover what they explain.
    main = [
        _series(
            heading,
            _paths(root, parent, [s for s in states if role(s) == key], measured(key), raw),
            axis,
            legend=key == "altitude",
        )
        for key, heading in _SHOWN.items()
    ]
    main = [view for view in main if view is not None]
    others = [s for s in states if role(s) not in (*_SHOWN, "north", "east")]
    more = [
        view
        for s in others
        if (view := _series(s.replace("_", " "), _paths(root, parent, [s], measured(s), raw), axis))
    ]
    lanes = _lanes(root, [f"{root}/boot", f"{root}/window"], axis)
    windows = rrb.TextDocumentView(name="Window report", origin=f"{parent}/window/report")
    left: list[Any] = [*main, lanes] if main else [*_sensors(root, raw, axis)[:4], lanes]
    tabs: list[Any] = [*_reports(root, TRAJECTORY, entities), windows]
    tabs.append(_link(root, entities, axis, alone=alone))
    tabs.append(_series("NIS", [f"{parent}/live/nis"], axis))
    if more:
        tabs.append(rrb.Grid(*more, name="Other states"))
    tabs += _grids(root, raw, axis)
    shares = [4.0, *[3.0] * (len(left) - 2), 2.5] if len(left) > 1 else [1.0]
    right = rrb.Vertical(
        _map(root, extent, entities),
        rrb.Tabs(*[tab for tab in tabs if tab is not None], active_tab=0),
        _events(),
        row_shares=[3, 3, 2],
    )
    return rrb.Horizontal(rrb.Vertical(*left, row_shares=shares), right, column_shares=[3, 2], name=title)


def _flight_path(root: str, model: str, entities: Collection[str], title: str, *, live: bool, alone: bool) -> Any:
    """Its states in groups, each group a tab; the reports beside them."""
    axis = _axis(live=live)
    states = _states(root, model, entities)
    raw = {path for path in entities if path.startswith(f"{root}/raw/")}
    parent = model_path(int(root[2:]), model)
    groups: dict[str, list[Any]] = {}
    for s in sorted({*states, *(name for names in GROUPS.values() for name in names)}, key=order):
        paths = _paths(root, parent, [s] if s in states else [], measured(s), raw)
        if s in states or (paths and states):  # what is measured, and no state of the model, belongs there too
            groups.setdefault(group(s), []).append(_series(_heading(s), paths, axis, legend=group(s) not in groups))
    tabs = [
        rrb.Vertical(*views, name=heading) if len(views) <= 4 else rrb.Grid(*views, grid_columns=2, name=heading)
        for heading in (*GROUPS, OTHERS)
        if (views := groups.get(heading))
    ]
    lanes = _lanes(root, [f"{root}/boot", f"{root}/window/{model}"], axis)
    left = [rrb.Tabs(*tabs, active_tab=0), lanes] if tabs else [lanes]
    documents: list[Any] = _reports(root, model, entities)
    documents.append(rrb.TextDocumentView(name="Window figures", origin=f"{parent}/window/report"))
    documents.append(_series("NIS", [f"{parent}/live/nis"], axis))
    documents += _grids(root, raw, axis)
    documents.append(_link(root, entities, axis, alone=alone))
    right = rrb.Vertical(
        rrb.Tabs(*[view for view in documents if view is not None], active_tab=0), _events(), row_shares=[4, 1]
    )
    return rrb.Horizontal(
        rrb.Vertical(*left, row_shares=[6.0, 1.0][: len(left)]), right, column_shares=[3, 2], name=title
    )


def _heading(name: str) -> str:
    said = words(name) or name.replace("_", " ")
    unit = next((unit for title, unit in _UNITS.items() if name in GROUPS[title]), "")
    unit = _UNIT.get(name, unit)
    return f"{said[0].upper()}{said[1:]}{f', {unit}' if unit else ''}"


def _reports(root: str, model: str, entities: Collection[str]) -> list[Any]:
    """What the flight was worth, the widest scope first; of each the page at the cursor, which is the newest live."""
    there = [(scope, f"{root}/report/{model}/{slug(scope)}") for scope in ("sortie", "test point", "window")]
    return [
        rrb.TextDocumentView(name=f"{scope.capitalize()} report", origin=path)
        for scope, path in there
        if path in entities
    ]


def _lanes(root: str, contents: list[str], axis: Any) -> Any:
    return rrb.StateTimelineView(name="Boot epochs and windows", origin=root, contents=contents, time_view=axis)


def _models(root: str, entities: Collection[str]) -> list[str]:
    """Models that a vehicle has estimates, windows or reports of."""
    found = {p.model for path in entities if path.startswith(f"{root}/est/") and (p := place(path)) is not None}
    found |= {path.split("/")[3] for path in entities if path.startswith(f"{root}/report/")}
    return sorted(found, key=first)


def _states(root: str, model: str, entities: Collection[str]) -> list[str]:
    here = [p for path in entities if path.startswith(f"{root}/est/") and (p := place(path)) is not None]
    found = {p.name for p in here if p.model == model and p.stage in _STAGES}
    return sorted(found - {"nis", "report", "geodetic"}, key=None if model == TRAJECTORY else order)


def _paths(root: str, parent: str, states: Iterable[str], raw: Iterable[str], there: Collection[str]) -> list[str]:
    """Entities of one view, in the order in which they are drawn: raw below, smoothed on top."""
    paths = [path for name in raw if (path := f"{root}/raw/{name}") in there]
    return paths + [f"{parent}/{stage}/{state}" for stage in _STAGES for state in states]


def _series(title: str, paths: list[str], axis: Any, *, legend: bool = True) -> Any:
    if not paths:
        return None
    box = rrb.PlotLegend("LeftTop", visible=legend)
    return rrb.TimeSeriesView(name=title, origin="/", contents=paths, plot_legend=box, axis_x=axis)


def _grids(root: str, raw: Collection[str], axis: Any) -> list[Any]:
    """The sensors that are used, and behind them those that are only compared."""
    used = {path for path in raw if "." not in path.split("/")[3]}
    return [
        rrb.Grid(*_sensors(root, those, axis), name=name)
        for name, those in (("Sensors", used), ("Other sensors", set(raw) - used))
        if those
    ]


def _sensors(root: str, raw: Collection[str], axis: Any) -> list[Any]:
    return [
        _series(path.removeprefix(f"{root}/raw/").replace("/", ": ").replace("_", " "), [path], axis)
        for path in sorted(raw)
    ]


def _map(root: str, extent: Extent | None, entities: Collection[str]) -> Any:
    whole = rrb.VisibleTimeRange(TIMELINE, start=rrb.TimeRangeBoundary.infinite(), end=rrb.TimeRangeBoundary.infinite())
    extent = extent or Extent(-300.0, -300.0, 300.0, 300.0)
    spacing = _spacing(max(extent.east - extent.west, extent.north - extent.south))
    branches = sorted(path for path in entities if path.startswith((f"{root}/world/live.", f"{root}/world/window.")))
    return rrb.Spatial3DView(
        name=f"Track from above, north up, grid {spacing:g} m",
        origin=f"{root}/world",
        contents=[f"{root}/world/gnss", f"{root}/world/live", f"{root}/world/window", *branches],
        time_ranges=whole,
        eye_controls=_above(extent),
        line_grid=rrb.LineGrid3D(visible=True, spacing=spacing, color=(60, 60, 60)),
    )


def _link(root: str, entities: Collection[str], axis: Any, *, alone: bool) -> Any:
    mine = root[1:]
    senders = sorted(
        {p.rsplit("/", 1)[0] for p in entities if p.startswith("/link/") and p.split("/")[-1] in ("loss", "counters")}
    )
    here = [p for p in senders if p.split("/")[-1].split(".")[0] == mine or alone]
    accounts = sorted(path for path in entities if path.startswith("/link/") and path.endswith("/bytes"))
    views = [
        _series("Loss, 0 to 1", [f"{p}/loss" for p in here], axis),
        _series("Frames: received, lost, late ...", [f"{p}/counters" for p in here], axis),
        _series("Bytes on the link", accounts, axis),
        _series("Age at the consumers, s", sorted(p for p in entities if _age_of_all(p)), axis),
        _series("Arrival delay, s", [p for p in (f"{root}/clock/delay",) if p in entities], axis),
    ]
    views = [view for view in views if view is not None]
    return rrb.Grid(*views, name="Link") if views else None


def _age_of_all(path: str) -> bool:
    """Whether it is how old things were when a consumer had them."""
    return path.startswith("/health/") and path.endswith("/age")


def _events() -> Any:
    # The entity path would say "/events" in every line.
    return rrb.TextLogView(
        name="Events", origin="/events", columns=rrb.TextLogColumns(text_log_columns=["LogLevel", "Body"])
    )


def _axis(*, live: bool) -> Any:
    """One time axis for all plots, so that they move together."""
    if live:
        start, end = (
            rrb.TimeRangeBoundary.cursor_relative(seconds=-120),
            rrb.TimeRangeBoundary.cursor_relative(seconds=5),
        )
    else:
        start, end = rrb.TimeRangeBoundary.infinite(), rrb.TimeRangeBoundary.infinite()
    return rrb.TimeAxis(view_range=rr.TimeRange(start, end))


def _spacing(size: float) -> float:
    """Round distance of grid lines, about ten of them across."""
    decade = 10.0 ** math.floor(math.log10(max(size, 50.0) / 10.0))
    return next(step * decade for step in (1.0, 2.0, 5.0, 10.0) if step * decade >= size / 15.0)


def _above(extent: Extent) -> Any:
    """An eye above the middle of the track that looks down, north up."""
    east, north = (extent.west + extent.east) / 2, (extent.south + extent.north) / 2
    height = 1.3 * max(extent.east - extent.west, extent.north - extent.south, 50.0)
    # Not quite from the zenith, where "up" would have no direction on the screen.
    return rrb.EyeControls3D(
        kind=rrb.Eye3DKind.Orbital,
        position=(east, north - 0.02 * height, height),
        look_target=(east, north, 0.0),
        eye_up=(0.0, 0.0, 1.0),
    )
