"""Columns: a message turned into exactly the numbers that a recording stores. Knows no Rerun.

The recorder writes these columns and the comparison recomputes them from a replay, so the two cannot disagree about
what "the same" means. Nothing here depends on how a stream was cut into batches.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from functools import lru_cache
from itertools import groupby
from typing import Any, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from telemetry.messages import (
    AirData,
    Altitude,
    Attitude,
    Estimate,
    Floats,
    FlowAngles,
    Gnss,
    Imu,
    Message,
    Report,
    Times,
    Window,
)

GAP = 3.0  # s without a sample after which a line is broken
TRAJECTORY = "trajectory"  # the model that every flight has: its states need no branch of their own


class Belief(NamedTuple):
    """One state over k samples, as stored.

    Parameters
    ----------
    t, t_rx : int64 array, shape (k,)
        ns.
    values, variances : float array, shape (k,)
        NaN, both, where the state is not determined.
    unit : str
        SI unit.
    """

    t: Times
    t_rx: Times
    values: Floats
    variances: Floats
    unit: str


@lru_cache(maxsize=4096)
def slug(name: str) -> str:
    """Entity path part of a name: letters, digits, ``_``, ``-``, ``.``; anything else becomes ``_``."""
    return re.sub(r"[^A-Za-z0-9_.\-]+", "_", name).strip("_") or "_"


def vehicle_path(vehicle: int) -> str:
    """Root entity of a vehicle, e.g. ``/v1``."""
    return f"/v{vehicle}"


def role(name: str) -> str:
    """What a state is to a reader, whatever the model calls it.

    Returns
    -------
    str
        "altitude", "north", "east", "velocity_north", "velocity_east", "climb_rate", "roll", "pitch", "heading", or "".
    """
    words = set(re.findall(r"[a-z]+", name.lower())) - {"m", "s", "of", "position", "rate"}
    speed = bool(words & {"velocity", "speed", "v"})
    if words & {"bias", "scale", "wind", "gust", "acceleration", "error", "offset", "turn"}:
        return ""
    for side in ("north", "east"):
        if side in words or f"v{side[0]}" in words:
            return f"velocity_{side}" if speed or f"v{side[0]}" in words else side
    if "climb" in words or (speed and words & {"up", "vertical"}):
        return "climb_rate"
    if words & {"altitude", "height", "h"} and not speed:
        return "altitude"
    for angle, synonyms in (
        ("roll", {"roll", "phi"}),
        ("pitch", {"pitch", "theta"}),
        ("heading", {"heading", "psi", "yaw"}),
    ):
        if words and words <= synonyms:
            return angle
    return ""


def belief(mean: Floats, std: Floats) -> tuple[Floats, Floats]:
    """Values and variances of a state: ``variance = std**2``, and NaN for both where there is no estimate yet."""
    unknown = ~(np.isfinite(mean) & np.isfinite(std))
    with np.errstate(over="ignore", invalid="ignore"):
        return np.where(unknown, np.nan, mean), np.where(unknown, np.nan, np.square(std))


class Place(NamedTuple):
    """What the path of an estimated state says: ``/v1/est/live/altitude`` or ``/v1/est/flight_path/live/u``."""

    vehicle: int
    model: str
    stage: str
    name: str


def place(entity: str) -> Place | None:
    """Take the path of an estimated state apart; None for any other path."""
    parts = entity.split("/")[1:]
    if len(parts) not in (4, 5) or parts[1] != "est" or not re.fullmatch(r"v\d+", parts[0]):
        return None
    return Place(int(parts[0][1:]), TRAJECTORY if len(parts) == 4 else parts[2], parts[-2], parts[-1])


def first(model: str) -> tuple[bool, str]:
    """Sorting key of models: the one of every flight first, the others by name."""
    return model != TRAJECTORY, model


def model_path(vehicle: int, model: str) -> str:
    """Where the stages of a model are: models of one vehicle stand side by side and share no entity."""
    root = f"{vehicle_path(vehicle)}/est"
    return root if model == TRAJECTORY else f"{root}/{slug(model)}"


def estimate_path(message: Estimate | Window) -> str:
    """Parent entity of the states of an estimate or window.

    Smoothed states have one place whatever the smoothing knew: a recording holds windows of one scope, and its reports
    say which.
    """
    stage = "window" if isinstance(message, Window) else "live"
    return f"{model_path(message.vehicle, message.model)}/{stage}"


def report_path(message: Report) -> str:
    """Entity of a report: one for each scope, so that none hides another that covers the same time."""
    return f"{vehicle_path(message.vehicle)}/report/{slug(message.model)}/{slug(message.scope)}"


def belief_columns(message: Estimate | Window) -> dict[str, Belief]:
    """Every state of an estimate or window as the recording stores it, by entity path; the breaks of `Seam` come on
    top.
    """
    parent = estimate_path(message)
    values, variances = belief(message.mean, message.std)
    return {
        f"{parent}/{slug(name)}": Belief(message.t, message.t_rx, values[:, i], variances[:, i], unit)
        for i, (name, unit) in enumerate(zip(message.names, message.units, strict=True))
    }


def sensor_columns(message: Message) -> dict[str, Floats]:
    """Quantities of a sensor message, SI, by name: (k,) or (k, 3) arrays; empty for what is not a sensor.

    The sign of the receiver's down velocity is turned, so that it can stand beside the climb rate of an estimate.
    """
    match message:
        case Imu():
            return {"specific_force": message.specific_force, "angular_rate": message.angular_rate}
        case Attitude():
            return {"roll": message.phi, "pitch": message.theta, "heading": message.psi}
        case AirData():
            return {"airspeed": message.airspeed, "differential_pressure": message.differential_pressure}
        case FlowAngles():
            return {"alpha": message.alpha, "beta": message.beta}
        case Altitude():
            return {"altitude": message.altitude, "pressure": message.pressure, "sigma": message.sigma}
        case Gnss():
            return {
                "altitude": message.altitude,
                "position": np.column_stack([message.latitude, message.longitude]),
                "velocity_north": message.velocity[:, 0],
                "velocity_east": message.velocity[:, 1],
                "climb_rate": -message.velocity[:, 2],
                "sigma": message.sigma,
                "satellites": np.where(message.satellites < 0, np.nan, message.satellites.astype(np.float64)),
            }
    return {}


def geodetic(message: Message) -> Floats | None:
    """Latitude, longitude (rad) and altitude (m) of every sample, shape (k, 3), of a message that has them."""
    if isinstance(message, Gnss):
        return np.column_stack([message.latitude, message.longitude, message.altitude])
    return message.geodetic if isinstance(message, (Estimate, Window)) else None


def local_metres(points: Floats, origin: Floats) -> Floats:
    """East, north, up in metres of the plane that touches the WGS-84 ellipsoid at the origin.

    ``up`` is the difference of altitudes, not the height above the plane: a map reads it so.

    Parameters
    ----------
    points : float array, shape (k, 3)
        Latitude, longitude (rad), altitude (m).
    origin : float array, shape (3,)
        As a point.
    """
    a, e2 = 6378137.0, 6.69437999014e-3

    def earth(p: Floats) -> Floats:
        sin = np.sin(p[:, 0])
        n = a / np.sqrt(1.0 - e2 * sin**2)
        r = n * np.cos(p[:, 0])
        return np.column_stack([r * np.cos(p[:, 1]), r * np.sin(p[:, 1]), n * (1.0 - e2) * sin])

    d = earth(points) - earth(origin[None])
    (lat, lon, _) = origin
    east = -np.sin(lon) * d[:, 0] + np.cos(lon) * d[:, 1]
    north = -np.sin(lat) * (np.cos(lon) * d[:, 0] + np.sin(lon) * d[:, 1]) + np.cos(lat) * d[:, 2]
    return np.column_stack([east, north, points[:, 2] - origin[2]])


def runs(messages: Sequence[Message]) -> Iterator[list[Any]]:
    """Successive messages that may be joined into one: the same boot epoch and, for estimates, the same states."""
    for _, group in groupby(messages, lambda m: (m.boot, getattr(m, "names", None), getattr(m, "units", None))):
        yield list(group)


def joined(messages: Sequence[Message], field: str) -> NDArray[Any]:
    """One column of several messages, end to end."""
    return getattr(messages[0], field) if len(messages) == 1 else np.concatenate([getattr(m, field) for m in messages])


def merged(run: Sequence[Any]) -> Any:
    """Estimates or windows of one run as one."""
    if len(run) == 1:
        return run[0]
    columns = [name for name in run[0].__struct_fields__ if isinstance(getattr(run[0], name), np.ndarray)]
    return msgspec.structs.replace(run[0], **{name: joined(run, name) for name in columns})


def span(t: Times) -> tuple[int, int]:
    """The first and the last of times in any order."""
    if len(t) == 1:  # as a rule, live
        return (only := int(t[0])), only
    return int(t.min()), int(t.max())


_NOWHERE, _NEVER = np.empty(0, np.intp), np.empty(0, np.int64)


class Seam:
    """Where a line must not be joined: across a silence, and between boot epochs.

    A break is a row of NaN one nanosecond after the last sample before it. It depends on the samples so far and not on
    their batches.

    Parameters
    ----------
    gap : float
        Longest silence that a line may cross, s.
    """

    def __init__(self, gap: float = GAP) -> None:
        self.gap = round(gap * 1e9)
        self.high: int | None = None
        self.t_rx = 0
        self.boot = 0
        self.silence = 0  # ns within boot epochs that were not measured
        self.count = 0

    def find(self, boot: int, t: Times, t_rx: Times) -> tuple[NDArray[np.intp], Times, Times]:
        """Rows before which a break belongs, and the times of the breaks; remembers the rows as seen."""
        if self.high is not None and boot == self.boot and (newest := span(t)[1]) - self.high <= self.gap:
            self.high, self.t_rx = max(self.high, newest), int(t_rx[-1])
            return _NOWHERE, _NEVER, _NEVER  # as a rule; the same as below comes to
        before = np.concatenate([[t[0] if self.high is None else self.high], t])[:-1]
        if self.high is not None and boot != self.boot:
            before[0] = t[0]  # a new epoch starts afresh: its clock may have stepped back
        before = np.maximum.accumulate(before)
        silent = t - before > self.gap
        self.silence += int((t - before)[silent].sum())
        cut = silent.copy()
        times, receive = before + 1, np.concatenate([[self.t_rx], t_rx[:-1]])
        if self.high is not None and boot != self.boot:
            cut[0], times[0] = True, self.high + 1
        self.high, self.t_rx, self.boot = int(max(before[-1], t[-1])), int(t_rx[-1]), boot
        at = np.flatnonzero(cut)
        self.count += len(at)
        return at, times[at], receive[at]


def broken(column: NDArray[Any], at: NDArray[np.intp]) -> NDArray[Any]:
    """A column of floats with a row of NaN before each of the rows ``at``."""
    return np.insert(column, at, np.nan, axis=0) if len(at) else column


def broken_times(column: Times, at: NDArray[np.intp], times: Times) -> Times:
    """A column of times with the times of the breaks put in."""
    return np.insert(column, at, times) if len(at) else column
