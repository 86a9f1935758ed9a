"""Plot: a review as one picture for a report."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from telemetry.messages import Floats
from viewer.columns import TRAJECTORY, first, local_metres, model_path, place, role
from viewer.reading import Reading
from viewer.review import Review, review
from viewer.summary import Smoothed
from viewer.text import utc

RAW, LIVE, SMOOTHED = "#8a8a8a", "#1f6fd6", "#f08000"


class _Row(NamedTuple):
    """A diagram: what it shows of the states, by role or name, each with its dashes; what was measured; its scale."""

    title: str
    states: tuple[tuple[str, str], ...]
    raw: tuple[tuple[str, str, str], ...] = ()  # quantity, colour, label
    scale: float = 1.0


_ALTITUDES = ("gnss/altitude", RAW, "raw GNSS"), ("altitude/altitude", "#b9c4b4", "raw barometer")
_TRAJECTORY = (
    _Row("altitude, m", (("altitude", "-"),), _ALTITUDES),
    _Row("climb rate, m/s", (("climb_rate", "-"),), (("gnss/climb_rate", RAW, "raw GNSS"),)),
    _Row("north velocity, m/s", (("velocity_north", "-"),), (("gnss/velocity_north", RAW, "raw GNSS"),)),
    _Row("east velocity, m/s", (("velocity_east", "-"),), (("gnss/velocity_east", RAW, "raw GNSS"),)),
    _Row("sigma, m", (("altitude", "-"), ("north", ":"))),
)
_ATTITUDE = ("attitude/pitch", RAW, "raw attitude"), ("attitude/roll", "#b9c4b4", "raw attitude")
_FLIGHT_PATH = (
    _Row("height, m", (("altitude", "-"),), _ALTITUDES),
    _Row("u, m/s", (("u", "-"),), (("air_data/airspeed", RAW, "raw airspeed"),)),
    _Row("v (-), w (:), m/s", (("v", "-"), ("w", ":"))),
    _Row("pitch (-), roll (:), deg", (("pitch", "-"), ("roll", ":")), _ATTITUDE, math.degrees(1.0)),
    _Row("sigma, m/s", (("u", "-"), ("v", "--"), ("w", ":"))),
)
_POINTS = 20000  # per line: more than a picture can show, few enough to draw in a second


def plot(
    recording: str | Path | Review, out: str | Path, *, vehicle: int | None = None, model: str | None = None
) -> None:
    """Draw height, velocities, their uncertainty and the map: raw, live and smoothed with bands of two standard
    deviations; of a flight path also attitude.

    Parameters
    ----------
    recording : path or Review
        Recording, sortie folder, or a review of one.
    out : path
        PNG, 1600 x 1000 pixels.
    vehicle : int, optional
        Which one; the first if not given.
    model : str, optional
        Whose estimate; the trajectory if not given, or what else there is.

    Raises
    ------
    ValueError
        If the vehicle, or the model, is not in the recording.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    found = recording if isinstance(recording, Review) else review(recording)
    source = Path(found.files[0]).parent if len(found.files) > 1 else Path(found.files[0])
    numbers = [v.vehicle for v in found.summary.vehicles]
    figure = Figure(figsize=(16, 10), dpi=100, layout="constrained")
    FigureCanvasAgg(figure)
    if not numbers:
        figure.text(0.5, 0.5, f"{found.summary.sortie}: no data", ha="center", fontsize=24)
        figure.savefig(out)
        return
    number = numbers[0] if vehicle is None else vehicle
    if number not in numbers:
        raise ValueError(f"vehicle {number} is not in the recording: it holds {', '.join(map(str, numbers))}")
    with Reading(source) as reading:
        _Picture(figure, found, reading, number, model).draw()
    figure.savefig(out)


class _Picture:
    def __init__(self, figure: Any, found: Review, reading: Reading, number: int, model: str | None) -> None:
        self.figure, self.found, self.reading, self.root = figure, found, reading, f"/v{number}"
        there = {p.model for path in reading.chunks if (p := place(path)) is not None and p.vehicle == number}
        if model is not None and model not in there:
            raise ValueError(
                f"vehicle {number} has no estimate of the model {model!r}: it has {', '.join(sorted(there)) or 'none'}"
            )
        self.model = min(there, key=first, default=TRAJECTORY) if model is None else model
        self.rows = _TRAJECTORY if self.model == TRAJECTORY else _FLIGHT_PATH
        self.windows = [w for w in found.summary.windows if (w.vehicle, w.model) == (number, self.model)]
        self.vehicle = next(v for v in found.summary.vehicles if v.vehicle == number)
        starts = [boot.t0 for boot in self.vehicle.boots] or [found.summary.t0]
        self.zero = starts[0]

    def draw(self) -> None:
        """Everything."""
        left, right = self.figure.add_gridspec(1, 2, width_ratios=(3, 2))
        rows = left.subgridspec(5, 1, height_ratios=(4, 2, 2, 2, 2))
        axes: list[Any] = []
        for i, row in enumerate(self.rows):
            axes.append(self.figure.add_subplot(rows[i], sharex=axes[0] if axes else None))
            (self._sigma if i == 4 else self._series)(axes[-1], row)
        for axis in axes:
            self._shade(axis, names=axis is axes[0])
            axis.grid(alpha=0.25)
            axis.margins(x=0.01)
            axis.tick_params(labelbottom=axis is axes[-1])
        axes[0].legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), fontsize=9, ncols=4, frameon=False, markerscale=3)
        axes[-1].set_xlabel(f"vehicle time, s after {utc(self.zero)} UTC")
        side = right.subgridspec(2, 1, height_ratios=(7, 5))
        self._map(self.figure.add_subplot(side[0]))
        self._words(self.figure.add_subplot(side[1]))
        summary = self.found.summary
        self.figure.suptitle(
            f"{summary.sortie}, vehicle {self.vehicle.vehicle}: {summary.completeness}", fontsize=14, fontweight="bold"
        )

    def _seconds(self, t: NDArray[np.int64]) -> Floats:
        return (t - self.zero) / 1e9

    def _state(self, stage: str, key: str) -> tuple[Floats, Floats, Floats] | None:
        """Seconds, values and standard deviations of the state with this role or name."""
        for entity in sorted(self.reading.chunks):
            here = place(entity)
            if here is None or here[:3] != (self.vehicle.vehicle, self.model, stage):
                continue
            if key in (here.name, role(here.name)):
                components = ("Measurements:values", "Measurements:variances")
                (t,), (values, variances) = self.reading.columns(entity, components, ("t_vehicle",))
                if len(t):
                    every = max(1, len(t) // _POINTS)
                    keep = (np.arange(len(t)) % every == 0) | np.isnan(values)  # the breaks must survive
                    return self._seconds(t[keep]), values[keep], np.sqrt(variances[keep])
        return None

    def _series(self, axis: Any, row: _Row) -> None:
        spans: list[Floats] = []
        for i, (quantity, colour, label) in enumerate(row.raw):
            t, raw = self.reading.column(f"{self.root}/raw/{quantity}", "Scalars:scalars")
            every, raw = max(1, len(t) // _POINTS), raw * row.scale
            size = 1.5 if i else 2.5
            axis.plot(
                self._seconds(t[::every]), raw[::every], ".", color=colour, markersize=size, label=label, zorder=1 - i
            )
            spans.append(raw)
        for stage, colour, name in (("live", LIVE, "live"), ("window", SMOOTHED, "smoothed")):
            for key, dashes in row.states:
                state = self._state(stage, key)
                if state is None:
                    continue
                s, values, std = state[0], state[1] * row.scale, state[2] * row.scale
                legend = f"{name} ± 2 sigma" if key == row.states[0][0] else None
                width = 1.0 if stage == "live" else 1.5
                axis.plot(s, values, dashes, color=colour, linewidth=width, label=legend, zorder=3)
                low, high = values - 2 * std, values + 2 * std
                axis.fill_between(s, low, high, color=colour, alpha=0.22, linewidth=0, zorder=2)
                spans.append(values)
        self._limits(axis, spans)
        axis.set_ylabel(row.title)

    @staticmethod
    def _limits(axis: Any, spans: list[Floats]) -> None:
        """The lines decide about the range: a band that is wide for a second must not flatten an hour."""
        known = np.concatenate([np.empty(0), *(span[np.isfinite(span)] for span in spans)])
        if len(known):
            low, high = np.percentile(known, [0.2, 99.8])
            room = 0.15 * max(high - low, 1.0)
            axis.set_ylim(low - room, high + room)

    def _sigma(self, axis: Any, row: _Row) -> None:
        for stage, colour, name in (("live", LIVE, "live"), ("window", SMOOTHED, "smoothed")):
            for key, dashes in row.states:
                state = self._state(stage, key)
                if state is not None:
                    positive = np.where(state[2] > 0, state[2], np.nan)
                    axis.semilogy(state[0], positive, dashes, color=colour, linewidth=1.2, label=f"{key}, {name}")
        axis.set_ylabel(row.title)
        if axis.lines:
            axis.legend(
                loc="lower center", bbox_to_anchor=(0.5, 1.0), fontsize=7, ncols=6, frameon=False, borderaxespad=0.1
            )

    def _shade(self, axis: Any, *, names: bool) -> None:
        for window in self.windows:
            low, high = (window.t0 - self.zero) / 1e9, (window.t1 - self.zero) / 1e9
            if window.test_point:
                axis.axvspan(low, high, color=SMOOTHED, alpha=0.10, linewidth=0)
                if names:
                    axis.text(
                        (low + high) / 2,
                        0.985,
                        window.test_point,
                        transform=axis.get_xaxis_transform(),
                        ha="center",
                        va="top",
                        fontsize=10,
                        fontweight="bold",
                        color="#a85a00",
                    )
            else:
                axis.axvline(low, color="#999999", linewidth=0.5, alpha=0.6)
        for silence in self.vehicle.silences:
            low, high = (silence.t0 - self.zero) / 1e9, (silence.t1 - self.zero) / 1e9
            axis.axvspan(low, high, facecolor="none", edgecolor="#bbbbbb", hatch="//", linewidth=0)
            if names:
                reboot = any(boot.t0 == silence.t1 for boot in self.vehicle.boots)
                axis.text(
                    (low + high) / 2,
                    0.03,
                    f"{'reboot' if reboot else 'not heard'}\n{high - low:.0f} s",
                    fontsize=8,
                    ha="center",
                    transform=axis.get_xaxis_transform(),
                    color="#555555",
                )

    def _map(self, axis: Any) -> None:
        origin: Floats | None = None
        for kind, colour, name in (("live", LIVE, "live"), ("window", SMOOTHED, "smoothed")):
            parent = model_path(self.vehicle.vehicle, TRAJECTORY)  # the model that has a place
            _, points = self.reading.column(f"{parent}/{kind}/geodetic", "Scalars:scalars")
            if not len(points):
                continue
            if origin is None:
                origin = self._origin(points)
            metres = local_metres(points, origin)
            axis.plot(
                metres[:, 0], metres[:, 1], color=colour, linewidth=1.0 if kind == "live" else 1.6, label=name, zorder=3
            )
        _, fixes = self.reading.column(f"{self.root}/raw/gnss/position", "Scalars:scalars")
        if len(fixes):
            origin = self._origin(np.column_stack([fixes, np.zeros(len(fixes))])) if origin is None else origin
            metres = local_metres(np.column_stack([fixes, np.full(len(fixes), origin[2])]), origin)
            every = max(1, len(metres) // _POINTS)
            axis.plot(
                metres[::every, 0], metres[::every, 1], ".", color=RAW, markersize=2.5, label="raw GNSS", zorder=1
            )
            known = metres[np.isfinite(metres).all(axis=1)]
            axis.plot(*known[0, :2], "^", color="black", markersize=8, label="start", zorder=4)
        axis.set_aspect("equal", adjustable="datalim")
        axis.set_xlabel("east, m")
        axis.set_ylabel("north, m")
        axis.grid(alpha=0.25)
        if axis.lines:
            axis.legend(loc="best", fontsize=9)

    def _origin(self, points: Floats) -> Floats:
        stored = self.found.summary.origin
        if stored is not None:
            return np.array([np.radians(stored[0]), np.radians(stored[1]), stored[2]])
        known = points[np.isfinite(points).all(axis=1)]
        return np.asarray(known[0]) if len(known) else np.zeros(3)

    def _words(self, axis: Any) -> None:
        axis.axis("off")
        named = [window for window in self.windows if window.test_point]
        shown = (
            named if named and len(self.windows) > 14 else self.windows
        )  # there is room for fourteen: test points first
        lines = ["window test point        length  closed by NIS/dof  sigma alt.  horiz."]
        lines += [_line(window) for window in shown[:14]]
        if len(self.windows) > len(shown[:14]):
            lines.append(f"... and {len(self.windows) - len(shown[:14])} more")
        lines.append("")
        lines += [
            f"link {a.source}: received {a.received}, lost {a.lost}"
            + ("" if a.loss is None else f" ({100 * a.loss:.2f} %)")
            for a in self.found.summary.accounts
            if a.vehicle == self.vehicle.vehicle
        ]
        lines += [
            f"{sensor.sensor}: {sensor.samples} samples" + ("" if sensor.rate is None else f" at {sensor.rate:.1f} Hz")
            for sensor in self.vehicle.sensors
        ]
        lines += [f"! {remark}" for remark in self.found.remarks]
        axis.text(
            0.0,
            1.0,
            "\n".join(line[:92] for line in lines),
            va="top",
            family="monospace",
            fontsize=8,
            transform=axis.transAxes,
        )


def _line(w: Smoothed) -> str:
    ratio = f"{w.nis / w.dof:7.2f}" if w.nis is not None and w.dof else "      -"
    sigma = [
        f"{value:7.2f} m" if value is not None else "      -  "
        for value in (w.median_sigma_altitude, w.median_sigma_horizontal)
    ]
    what = f"{f'{w.boot}.{w.number}':6} {(w.test_point or '-')[:15]:15} {(w.t1 - w.t0) / 1e9:6.1f} s  {w.reason:8}"
    return f"{what} {ratio} {sigma[0]}  {sigma[1]}"
