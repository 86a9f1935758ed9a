"""How close the estimates came to the truth, and whether their error bars said so."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import numpy as np

from estimator.geodesy import TangentPlane
from sims.states import truth_states
from telemetry.messages import Attitude, ClockFit, Estimate, Gnss, Message, Window

if TYPE_CHECKING:
    from rich.table import Table

    from sims.flight import Flight

QUANTITIES = {  # name -> states
    "horizontal position": ("north", "east"),
    "altitude": ("altitude",),
    "horizontal velocity": ("velocity_north", "velocity_east"),
    "climb rate": ("climb_rate",),
    "velocity u, v, w": ("u", "v", "w"),
    "roll and pitch": ("phi", "theta"),
    "heading": ("psi",),
}
UNITS = {
    "horizontal position": "m", "altitude": "m", "horizontal velocity": "m/s", "climb rate": "m/s",
    "velocity u, v, w": "m/s", "roll and pitch": "deg", "heading": "deg",
}  # fmt: skip
ANGLES = ("phi", "theta", "psi")
SOURCES = ("raw", "live", "window by window", "whole sortie")


class Accuracy:
    """Collects what was estimated of one simulated flight, beside its truth.

    Truth and estimate meet on UTC: the truth knows its own, and the vehicle's `ClockFit` tells that of the estimates.

    Parameters
    ----------
    flight : sims.flight.Flight
    """

    def __init__(self, flight: Flight) -> None:
        self._flight = flight
        self._kept: dict[str, list[Message]] = {source: [] for source in SOURCES}
        self._offset: int | None = None

    def live(self, message: Message) -> None:
        """Take a message of the live sortie."""
        if isinstance(message, ClockFit) and message.reference[-1] == "system_time":
            self._offset = round(float(message.offset[-1]) * 1e9)
        elif isinstance(message, Gnss | Attitude):
            self._kept["raw"].append(message)
        elif isinstance(message, Estimate):
            self._kept["live"].append(message)
        elif isinstance(message, Window):
            self._kept["window by window"].append(message)

    def smoothed(self, _: str, stream: Iterable[Any]) -> Iterable[Any]:
        """Pass on a stream of the smoothing of the whole sortie, and take the windows in it."""
        for item in stream:
            if isinstance(item, Window):
                self._kept["whole sortie"].append(item)
            yield item

    def figures(self) -> dict[str, dict[str, dict[str, float | None]]]:
        """Per source and quantity the rms error and the share of errors within two standard deviations.

        A quantity that the source does not measure is missing; the rms of the stated standard deviations stands
        beside the error, None for both where none is stated. Errors are those of all components together, SI; samples
        before the first complete estimate are left out.
        """
        if self._offset is None:
            raise ValueError("no UTC was heard from the vehicle: its estimates cannot be placed beside the truth")
        return {source: self._compare(messages) for source, messages in self._kept.items() if messages}

    def table(self) -> Table:
        """The figures as a table for people."""
        from rich.table import Table

        table = Table(title="against the truth: rms error (share of errors within 2 sigma)")
        table.add_column("")
        figures = self.figures()
        for source in figures:
            table.add_column(source, justify="right")
        for quantity, unit in UNITS.items():
            cells = []
            for source in figures:
                found = figures[source].get(quantity)
                cells.append(_cell(found, 57.29578 if unit == "deg" else 1.0))
            table.add_row(f"{quantity}, {unit}", *cells)
        return table

    def _compare(self, messages: Iterable[Message]) -> dict[str, dict[str, float | None]]:
        errors: dict[str, list[np.ndarray[Any, Any]]] = {name: [] for name in QUANTITIES}
        sigmas: dict[str, list[np.ndarray[Any, Any]]] = {name: [] for name in QUANTITIES}
        for message in messages:
            inside, truth = self._truth(message.t)
            for name, states in QUANTITIES.items():
                for state in states:
                    found = _value(message, state, self._plane)
                    if found is None:
                        continue
                    value, sigma = found
                    good = inside & np.isfinite(value) & ~np.isinf(sigma)
                    error = value - truth[state]
                    if state in ANGLES:
                        error = np.remainder(error + np.pi, 2.0 * np.pi) - np.pi
                    errors[name].append(error[good])
                    sigmas[name].append(sigma[good])
        out: dict[str, dict[str, float | None]] = {}
        for name in QUANTITIES:
            if not sum(len(part) for part in errors[name]):
                continue
            error, sigma = np.concatenate(errors[name]), np.concatenate(sigmas[name])
            stated = bool(np.isfinite(sigma).all())
            out[name] = {
                "rms": float(np.sqrt(np.mean(error**2))),
                "sigma": float(np.sqrt(np.mean(sigma**2))) if stated else None,
                "coverage": float(np.mean(np.abs(error) <= 2 * sigma)) if stated else None,
            }
        return out

    @property
    def _plane(self) -> TangentPlane:
        truth = self._flight.truth
        return TangentPlane(float(truth.latitude[0]), float(truth.longitude[0]), float(truth.altitude[0]))

    def _truth(self, t: np.ndarray[Any, Any]) -> tuple[np.ndarray[Any, Any], dict[str, np.ndarray[Any, Any]]]:
        """The truth at vehicle times t, and where there is any."""
        truth = self._flight.truth
        assert self._offset is not None
        at = (t + self._offset - self._flight.start_utc + truth.t[0]) * 1e-9
        seconds = truth.seconds
        inside = (at >= seconds[0]) & (at <= seconds[-1])
        north, east = self._plane.to_plane(truth.latitude, truth.longitude, truth.altitude)
        columns = {
            "north": north,
            "east": east,
            "altitude": truth.altitude,
            "velocity_north": truth.velocity[:, 0],
            "velocity_east": truth.velocity[:, 1],
            "climb_rate": -truth.velocity[:, 2],
        }
        states = truth_states(self._flight)
        columns |= {name: states[name] for name in ("u", "v", "w", "phi", "theta")} | {"psi": np.unwrap(states["psi"])}
        return inside, {name: np.interp(at, seconds, column) for name, column in columns.items()}


def _cell(found: dict[str, float | None] | None, scale: float) -> str:
    """Error and coverage of one quantity in words."""
    if found is None or found["rms"] is None:
        return "not measured"
    coverage = "" if found["coverage"] is None else f" ({found['coverage']:.0%})"
    return f"{found['rms'] * scale:.2f}{coverage}"


def _value(
    message: Message, state: str, plane: TangentPlane
) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]] | None:
    """A state and its standard deviation (NaN: not stated) as the message has them; places on the truth's plane."""
    if isinstance(message, Attitude):
        return (getattr(message, state), np.full(len(message.t), np.nan)) if state in ANGLES else None
    if isinstance(message, Gnss):
        if state in ANGLES or state in ("u", "v", "w"):
            return None
        latitude, longitude, altitude = message.latitude, message.longitude, message.altitude
        velocity = {
            "velocity_north": message.velocity[:, 0],
            "velocity_east": message.velocity[:, 1],
            "climb_rate": -message.velocity[:, 2],
        }
        sigma = message.sigma[:, 1 if state == "altitude" else 2 if state in velocity else 0]
        if state in velocity:
            return velocity[state], sigma
    else:
        assert isinstance(message, Estimate | Window)
        if state not in message.names:
            return None
        column = message.names.index(state)
        latitude, longitude, altitude = message.geodetic.T
        sigma = message.std[:, column]
        if state not in ("north", "east", "altitude"):
            return message.mean[:, column], sigma
    if state == "altitude":
        return altitude, sigma
    north, east = plane.to_plane(latitude, longitude, altitude)
    return (north if state == "north" else east), sigma
