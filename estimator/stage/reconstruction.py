"""The programming door: a flight's samples in, its path out."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from typing import NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from estimator.models.flight_path import MODEL
from estimator.stage import estimate
from estimator.stage.settings import Settings
from telemetry.messages import Channel, Estimate, Event, Message, Parameter, Report, Window

Floats = NDArray[np.float64]


class Reconstruction(NamedTuple):
    """The flight path of one vehicle in one boot epoch.

    Attributes
    ----------
    t : (k,) int64 array
        Times of the rows below, ns of the samples' clock.
    names, units : tuple of str, length n
        Of the states, SI.
    filtered, filtered_std : (k, n) arrays
        As they would have been known at the time.
    smoothed, smoothed_std : (k, n) arrays
        As they are known from the whole flight.
    parameters : dict of str to Parameter
        Biases, scale errors and wind, with sigma and verdict.
    windows : list of Window
        The same smoothed path, cut at marks, gaps and lengths.
    reports : list of Report
        One per test point, then that of the sortie.
    nis : dict of str to float or None
        Mean of the normalised innovation squared by measured quantity.
    verdicts : dict of str to str
        Of every parameter and measured quantity.
    events : list of str
        What a reader of the log should know.
    """

    t: NDArray[np.int64]
    names: tuple[str, ...]
    units: tuple[str, ...]
    filtered: Floats
    filtered_std: Floats
    smoothed: Floats
    smoothed_std: Floats
    parameters: dict[str, Parameter]
    windows: list[Window]
    reports: list[Report]
    nis: dict[str, float | None]
    verdicts: dict[str, str]
    events: list[str]


class NoFlightPath(ValueError):
    """The samples do not allow a flight path; the text says why."""


def reconstruct(
    messages: Iterable[Message], config: Settings | None = None, *, vehicle: int | None = None, boot: int | None = None
) -> Reconstruction:
    """Reconstruct the flight path from a vehicle's samples.

    Parameters
    ----------
    messages : iterable of Message
        The output of `telemetry.ingest.ingest`, or messages of one's own (`Imu`, `Gnss`, `AirData`, ...), ended by a
        final `Progress`.
    config : Settings, optional
    vehicle, boot : int, optional
        Which vehicle and boot epoch; the first that has a flight path if not given.

    Raises
    ------
    NoFlightPath
        There is none; the reasons are those of the event log.
    """
    settings = msgspec.structs.replace(config or Settings(), model="flight_path")
    live: list[Estimate] = []
    windows: list[Window] = []
    reports: list[Report] = []
    events: list[str] = []
    for message in estimate(messages, settings, scope="sortie"):
        if isinstance(message, Event):
            events += message.text
        elif isinstance(message, Estimate | Window | Report) and message.model == MODEL:
            vehicle = message.vehicle if vehicle is None else vehicle
            if message.vehicle != vehicle:
                continue
            boot = message.boot if boot is None else boot
            if message.boot != boot:
                continue
            kept: list[Message] = live if isinstance(message, Estimate) else windows  # type: ignore[assignment]
            (reports if isinstance(message, Report) else kept).append(message)  # type: ignore[arg-type]
    if not windows:
        why = dict.fromkeys(text.split("alone: ", 1)[1] for text in events if text.startswith("no flight path yet"))
        raise NoFlightPath(f"no flight path: {'; '.join(why) or 'no satellite fix, or no inertial samples'}")
    rows = Counter({window.names: 0 for window in windows})
    for window in windows:
        rows[window.names] += len(window.t)
    names = rows.most_common(1)[0][0]
    left_out = sum(rows.values()) - rows[names]
    if left_out:
        events.append(f"{left_out} epochs were flown with other states (air data came or went) and are left out here")
    windows = [window for window in windows if window.names == names]
    live = [message for message in live if message.names == names]
    t = np.concatenate([window.t for window in windows])
    filtered_t = np.concatenate([message.t for message in live])
    at = np.searchsorted(filtered_t, t)
    report = reports[-1]
    return Reconstruction(
        t=t,
        names=names,
        units=windows[-1].units,
        filtered=np.concatenate([message.mean for message in live])[at],
        filtered_std=np.concatenate([message.std for message in live])[at],
        smoothed=np.concatenate([window.mean for window in windows]),
        smoothed_std=np.concatenate([window.std for window in windows]),
        parameters={parameter.name: parameter for parameter in report.parameters},
        windows=windows,
        reports=reports,
        nis={channel.name: channel.nis for channel in report.channels},
        verdicts=_verdicts(report.parameters, report.channels),
        events=events,
    )


def _verdicts(parameters: Iterable[Parameter], channels: Iterable[Channel]) -> dict[str, str]:
    return {told.name: told.verdict for told in parameters} | {told.name: told.verdict for told in channels}
