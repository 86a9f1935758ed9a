"""Style: colours and names, the same in every view: raw grey, live blue, smoothed orange."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import rerun as rr

from viewer.columns import role
from viewer.states import words

RAW = (150, 150, 150)
RAW_SECOND = (105, 120, 105)
LIVE = (70, 150, 255)
SMOOTHED = (255, 140, 20)
BETWEEN = ("window A", "window B")  # two states for windows without a name, so that neighbours stay apart

_COLOURS = {"raw": RAW, "gnss": RAW, "live": LIVE, "window": SMOOTHED}
_SAID = {"live": "live", "window": "smoothed"}
_INSTRUMENTS = {
    "gnss": "GNSS",
    "altitude": "barometer",
    "attitude": "autopilot",
    "air_data": "air data",
    "flow_angles": "vane",
    "imu": "IMU",
}
_QUANTITIES = {
    "velocity_north": "north velocity",
    "velocity_east": "east velocity",
    "climb_rate": "climb rate",
    "altitude": "altitude",
}
_VECTORS = {
    ("imu", "specific_force"): ("forward", "right", "down"),
    ("imu", "angular_rate"): ("p", "q", "r"),
    ("gnss", "sigma"): ("horizontal position", "altitude", "velocity"),
    ("gnss", "position"): ("latitude", "longitude"),
}
_POINTS = {
    *("altitude", "velocity_north", "velocity_east", "climb_rate"),
    *("roll", "pitch", "heading", "airspeed", "alpha", "beta"),
}


def quantity(name: str) -> str:
    """A state or quantity in words, e.g. "north velocity"."""
    return words(name) or _QUANTITIES.get(role(name), name.replace("_", " "))


def sensor(stream: str, name: str) -> Any:
    """Style of a raw quantity: points where an estimate will lie over it, lines elsewhere."""
    if (stream, name) in _VECTORS:
        return rr.SeriesLines(names=[f"{name.replace('_', ' ')}: {axis}" for axis in _VECTORS[stream, name]])
    text = f"{_QUANTITIES.get(name, name.replace('_', ' '))}: raw {_INSTRUMENTS.get(stream, stream)}"
    colour = RAW_SECOND if (stream, name) == ("altitude", "altitude") else RAW
    if name in _POINTS:
        return rr.SeriesPoints(names=text, colors=colour, markers=rr.components.MarkerShape.Circle, marker_sizes=0.8)
    return rr.SeriesLines(names=text, colors=colour)


def belief(entity: str, name: str, unit: str) -> Any:
    """Style of a state with its band."""
    stage = entity.split("/")[-2]
    text = f"{quantity(name)}: {_SAID[stage]}" if stage in _SAID else name
    return rr.Measurements.from_fields(
        names=text, units=unit, colors=_COLOURS.get(stage, LIVE), widths=2.0 if stage == "window" else 1.5
    )


def names(fields: Sequence[str]) -> Any:
    """Names of several numbers in one row."""
    return rr.SeriesLines(names=[field.replace("_", " ") for field in fields])


def nis() -> Any:
    """Style of the innovation test: what came and what was to be expected."""
    return rr.SeriesLines(names=["NIS", "expected (dof)"], colors=[LIVE, RAW], widths=[1.0, 1.0])


def geodetic() -> Any:
    """Names of a geodetic position."""
    return rr.SeriesLines(names=["latitude, rad", "longitude, rad", "altitude, m"])


def track(place: str, kind: str) -> Any:
    """Style of a track on the plan or the map, its width in pixels of the screen."""
    colour = _COLOURS.get(kind, RAW)
    point = kind not in _SAID
    radius = rr.components.Radius.ui_points({"live": 1.0}.get(kind, 1.0 if point else 1.6))
    kinds: dict[tuple[str, bool], Any] = {
        ("geo", True): rr.GeoPoints,
        ("geo", False): rr.GeoLineStrings,
        ("world", True): rr.Points3D,
        ("world", False): rr.LineStrips3D,
    }
    return kinds[place, point].from_fields(colors=colour, radii=radius)


def body(vehicle: int) -> Any:
    """Style of the place where a vehicle is now."""
    return rr.Points3D.from_fields(
        colors=(255, 255, 255), radii=rr.components.Radius.ui_points(5.0), labels=f"v{vehicle}", show_labels=True
    )


def lane(test_points: Sequence[str]) -> Any:
    """States of the window lane: test points orange, what lies between in two greys."""
    orange = [SMOOTHED, (225, 110, 10)]
    return rr.StateConfiguration(
        values=[*BETWEEN, *test_points],
        labels=["between test points"] * 2 + [f"test point {name}" for name in test_points],
        colors=[(90, 90, 90), (115, 115, 115), *(orange[i % 2] for i in range(len(test_points)))],
    )


__all__ = [
    "BETWEEN",
    "LIVE",
    "RAW",
    "SMOOTHED",
    "belief",
    "body",
    "geodetic",
    "lane",
    "names",
    "nis",
    "quantity",
    "sensor",
    "track",
]
