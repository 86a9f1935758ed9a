"""The stage: samples to estimates and windows.

The only part of the room that knows the vocabulary. Per vehicle and boot epoch it orders the samples, filters them as
they become complete, closes windows, and smooths what has closed. Nothing crosses a boot: a new epoch begins from the
prior. So does a new leg of the same epoch, where the clock stepped, a silence or a distance was too long, or the filter
failed.

Two models fly side by side: the trajectory, which any telemetry with satellite fixes allows, and the flight path, which
needs inertial sensors at 20 Hz or more.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import Any

import msgspec
import numpy as np

from estimator.stage.beside import Beside
from estimator.stage.epoch import TAKEN, Epoch
from estimator.stage.estimators import Path
from estimator.stage.settings import STAGE, Scope, Settings
from estimator.suspicion import delay
from telemetry.messages import AirData, Altitude, Attitude, FlowAngles, Gnss, Imu, Mark, Message, Progress, Sample

__all__ = ["STAGE", "Scope", "Settings", "estimate", "warm_up"]


def estimate(
    messages: Iterable[Message],
    settings: Settings | None = None,
    *,
    scope: Scope = "window",
    beside: bool = False,
    begun: Callable[[Path], object] | None = None,
) -> Iterator[Message]:
    """Estimate the state of every vehicle.

    Parameters
    ----------
    messages : iterable of Message
        The output of `telemetry.ingest.ingest`.
    settings : Settings, optional
    scope : {"window", "sortie"}
        What a window's smoothing knows: everything up to its closing, told when it closes; or the whole leg, in
        general the boot epoch, told when that ends.
    beside : bool
        Whether windows are smoothed on a thread of their own while the filter goes on: live estimates do not wait for
        it, and windows and reports come a little later, the same to the last bit.
    begun : callable, optional
        Given every stretch of flight path when it begins, before its first step; it is to be looked at only.

    Yields
    ------
    Estimate, Window, Event, Progress
        The estimates do not depend on `scope`, nor does anything on how the input was cut into batches.
    """
    settings = settings or Settings()
    vehicles: dict[int, dict[int, Epoch]] = {}
    jobs = Beside(beside)
    try:
        for message in _ended(messages):
            if isinstance(message, TAKEN):
                if isinstance(message, Sample) and not message.chosen:
                    continue
                epochs = vehicles.setdefault(message.vehicle, {})
                if message.boot not in epochs:
                    epochs[message.boot] = Epoch(message.vehicle, message.boot, settings, scope, jobs)
                    epochs[message.boot].begun = begun
                epochs[message.boot].take(message)
            elif isinstance(message, Progress):
                until = int(message.t_rx[-1])
                for _, epochs in sorted(vehicles.items()):
                    for boot in sorted(epochs):
                        over = any(other > boot and epochs[other].heard <= until for other in epochs)
                        if over or message.final:
                            yield from epochs.pop(boot).finish(until, "reboot" if over else "end")
                        else:
                            yield from epochs[boot].advance(until)
                yield from jobs.done(all=message.final)
                yield Progress(vehicle=0, source=STAGE, boot=0, t=message.t, t_rx=message.t_rx, final=message.final)
    finally:
        jobs.close()


def _ended(messages: Iterable[Message]) -> Iterator[Message]:
    """The messages, with a final word where they break off without one: what has been covered is then the end."""
    last: Progress | None = None
    for message in messages:
        if isinstance(message, Progress):
            last = message
        yield message
    if last is not None and not last.final:
        yield msgspec.structs.replace(last, final=True)


def warm_up(settings: Settings | None = None) -> None:
    """Compile the stage by running it on a short flight, so that the first real one does not wait for it.

    Parameters
    ----------
    settings : Settings, optional
        Of the flight to come: what it does not fly is not compiled.
    """

    def times(hertz: int, which: Any = slice(None)) -> dict[str, Any]:
        t = 1_000_000_000 // hertz * np.arange(1, 8 * hertz + 1)[which]
        return {"vehicle": 1, "source": "0/1", "boot": 0, "t": t, "t_rx": t}

    def said(kind: type[Mark] | type[Progress], second: float, **what: Any) -> Message:
        t = np.array([round(second * 1e9)])
        return kind(**{"vehicle": 1, "source": "0/1", "boot": 0, "t": t, "t_rx": t, **what})

    slow, fast = np.ones(40), np.ones(160)
    level = np.tile([0.0, 0.0, -9.81], (160, 1))
    here = np.delete(np.arange(40), [20, 21])  # two fixes are lost, which a report tells the price of
    samples: list[Message] = [
        Gnss(
            **times(5, here),
            latitude=slow[here],
            longitude=slow[here],
            altitude=slow[here],
            velocity=np.tile([30.0, 0.0, 0.0], (38, 1)),
            sigma=np.ones((38, 3)),
            satellites=np.full(38, 9),
        ),
        Altitude(**times(5), altitude=slow, pressure=101325.0 * slow, sigma=slow),
        Imu(**times(20), specific_force=level, angular_rate=np.zeros((160, 3))),
        Attitude(**times(20), phi=0.0 * fast, theta=0.0 * fast, psi=0.0 * fast),
        AirData(**times(5), airspeed=30.0 * slow, differential_pressure=np.nan * slow),
        FlowAngles(**times(5), alpha=0.0 * slow, beta=0.0 * slow),
        said(Mark, 2.5, action=["start"], name=["TP"]),
        said(Mark, 7.0, action=["stop"], name=["TP"]),
    ]
    over = said(Progress, 1100.0, final=True)
    chosen = settings or Settings()
    short = Settings(window=3.0, model=chosen.model, estimator=chosen.estimator)
    flights: tuple[tuple[Scope, float], ...] = (("window", 7.9), ("sortie", 1.0))
    for scope, end in flights:
        until = [said(Progress, second, final=False) for second in np.arange(1.0, end, 0.5)]
        for _ in estimate([*samples, *until, over], short, scope=scope):
            pass
    delay.warm_up()
