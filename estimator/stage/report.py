"""Reports: what a test point or a whole sortie is worth, in numbers with verdicts."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimator import consistency
from estimator.consistency import Tally
from estimator.kinematics import MEASUREMENTS
from estimator.models.flight_path import CALM, MODEL, PARAMETERS, FlightPath
from estimator.stage.examining import Examiner
from estimator.stage.losing import LOST, loss_effect
from estimator.stage.losing import alone as begun
from estimator.stage.settings import STAGE
from estimator.stage.shelf import EVER
from estimator.stretch import Smoothed
from telemetry.messages import Channel, Parameter, Report, Spread

if TYPE_CHECKING:
    from estimator.stage.epoch import Epoch
    from estimator.stage.passage import Closed, Passage

Floats = NDArray[np.float64]

UNITS = ("m/s", "rad", "rad", "rad", "rad", "rad", "m", "m/s", "m/s", "m/s")
REFUSED = 0.05  # share of refused measurements that is an alarm
OPTIMISTIC = 2.0  # the airspeed scale in turbulence is stated with so many times its sigma: the aircraft answers gusts


def alone(passage: Passage, window: Closed, smoothed: Smoothed) -> tuple[Floats, Floats]:
    """Mean and standard deviation of all states at the end of a window from what was measured in it alone.

    Begun where the smoothed path passes, with the priors of a first start and what the gate decided on the way. Where
    that fails, the priors.
    """
    stretch, drive, _ = begun(passage, window, smoothed)
    shown = np.zeros(len(drive.dt), np.uint8)
    shown[-1] = 1
    try:
        filtered = stretch.advance(drive._replace(shown=shown))
    except ArithmeticError:
        return smoothed.mean[window.stop], passage.flight.prior()  # nothing can be said
    return filtered.mean[-1], filtered.std[-1]


def parameters(
    flight: FlightPath, mean: Floats, std: Floats, others: dict[str, list[tuple[float, float]]]
) -> tuple[Parameter, ...]:
    """Judge every parameter of the model."""
    prior = flight.prior()
    gusts = flight.settings.turbulence >= CALM
    out = []
    for i, (name, unit) in enumerate(zip(flight.names, flight.units, strict=True)):
        if name in PARAMETERS:
            factor = OPTIMISTIC if gusts and name == "k_airspeed" else 1.0
            found = consistency.parameter(float(mean[i]), float(std[i]), float(prior[i]), others.get(name, ()), factor)
            out.append(Parameter(name=name, unit=unit, prior=float(prior[i]), **found._asdict()))
    return tuple(out)


def channels(tallies: Sequence[Tally]) -> tuple[Channel, ...]:
    """Judge every measured quantity."""
    out = []
    for i, tally in enumerate(tallies):
        if tally.used or tally.rejected:
            judged = consistency.judge(tally, air_data=i < 3)
            out.append(
                Channel(
                    name=MEASUREMENTS[i], unit=UNITS[i], used=tally.used, weakened=tally.weakened,
                    rejected=tally.rejected, **judged._asdict(),
                )
            )  # fmt: skip
    return tuple(out)


def alarms(told: Sequence[Channel], doubts: int, failures: int) -> tuple[str, ...]:
    """What makes the error bars untrustworthy: innovations, measurements refused, a filter doubted or lost."""
    out = [f"over-confident about {one.name}: {one.why}" for one in told if one.verdict == "over-confident"]
    for one in told:
        share = one.rejected / (one.used + one.rejected)
        if share > REFUSED:
            out.append(f"{one.name}: {share:.0%} of {one.used + one.rejected} measurements were refused")
    if doubts:
        out.append(f"the filter was doubted {doubts} times: error bars near these times are not to be trusted")
    if failures:
        out.append(f"the filter was lost {failures} times, and began anew")
    return tuple(out)


def spreads(flight: FlightPath, filtered: Floats, smoothed: Floats) -> tuple[Spread, ...]:
    """Medians of the standard deviations (n,) by state; None where there is none."""
    return tuple(
        Spread(name=name, unit=unit, filtered=_finite(before), smoothed=_finite(after))
        for name, unit, before, after in zip(flight.names, flight.units, filtered, smoothed, strict=True)
    )


class Known(NamedTuple):
    """What was known when a window closed.

    Attributes
    ----------
    examiner : Examiner
        What the sensors had said.
    heard : int
        The time that had been passed by then, ns; what came after that does not count.
    delay : float
        Of the satellite fixes, that was taken off, s.
    """

    examiner: Examiner
    heard: int
    delay: float


def test_point_report(epoch: Epoch, passage: Passage, window: Closed, smoothed: Smoothed, known: Known) -> Report:
    """Report a closed window that is a test point."""
    flight, examiner, heard = passage.flight, known.examiner, known.heard
    at, t = np.concatenate(window.at), np.concatenate(window.t)
    mean, std = alone(passage, window, smoothed)
    found = parameters(flight, mean, std, epoch.found)
    for parameter in found:
        if parameter.value is not None and parameter.sigma is not None:
            epoch.found.setdefault(parameter.name, []).append((parameter.value, parameter.sigma))
    told = channels(window.tallies)
    loss = examiner.loss(int(t[0]), int(t[-1]), heard)
    effect = {}
    if loss is not None and loss > LOST:
        effect = loss_effect(passage, window, smoothed, examiner.due(int(t[0]), int(t[-1]), heard))
    return Report(
        vehicle=epoch.vehicle,
        source=STAGE,
        boot=epoch.boot,
        t=t[-1:],
        t_rx=np.concatenate(window.t_rx)[-1:],
        model=MODEL,
        test_point=window.test_point,
        scope="test point",
        window=window.number,
        begin=int(t[0]),
        states=spreads(flight, np.median(np.concatenate(window.std), axis=0), np.median(smoothed.std[at], axis=0)),
        parameters=found,
        channels=told,
        gaps=({"interpolated": window.bridged} if window.bridged else {})
        | examiner.silences(int(t[0]), int(t[-1]), heard),
        loss=loss,
        loss_effect=effect,
        findings=examiner.findings(int(t[0]), int(t[-1]), heard, known.delay),
        alarms=alarms(told, window.doubts, int(passage.failed)),
        digest=window.digest.hexdigest(),
    )


class Sum:
    """What the windows of a leg add up to."""

    def __init__(self) -> None:
        self.flight: FlightPath | None = None
        self.tallies: list[Tally] = []
        self.filtered: list[Floats] = []
        self.smoothed: list[Floats] = []
        self.found: dict[str, tuple[float, float]] = {}  # parameters: value and sigma where they were known best
        self.doubts = 0
        self._failed: set[int] = set()  # beginnings of the stretches that did
        self._stretch: int | None = None  # beginning of the newest
        self.begin = 0
        self.end = (0, 0)
        self.number = 0
        self.bridged = 0.0
        self.lost = 0.0
        self._digest = hashlib.sha256()

    def add(self, passage: Passage, window: Closed, smoothed: Smoothed) -> None:
        """Take a window."""
        at = np.concatenate(window.at)
        if self.flight is None or self.flight.names != passage.flight.names:
            self.flight, self.filtered, self.smoothed = passage.flight, [], []
        if not self.tallies:
            self.begin = int(np.concatenate(window.t)[0])
        first = not self.tallies
        self.tallies = (
            list(window.tallies) if first else [a + b for a, b in zip(self.tallies, window.tallies, strict=True)]
        )
        self.filtered.append(np.median(np.concatenate(window.std), axis=0))
        self.smoothed.append(np.median(smoothed.std[at], axis=0))
        for name, value, sigma in zip(passage.flight.names, smoothed.mean[at[-1]], smoothed.std[at[-1]], strict=True):
            if name in PARAMETERS and not sigma > self.found.get(name, (0.0, np.inf))[1]:
                self.found[name] = float(value), float(sigma)
        self.doubts += window.doubts
        if passage.failed:
            self._failed.add(passage.first)
        if self._stretch is not None and passage.first != self._stretch:
            self.lost += max(passage.first - self.end[0], 0) * 1e-9
        self._stretch = passage.first
        self.end = self.last(window)
        self.number = window.number
        self.bridged += window.bridged
        self._digest.update(window.digest.digest())

    @staticmethod
    def last(window: Closed) -> tuple[int, int]:
        """Times of the last epoch of a window."""
        t, t_rx = np.concatenate(window.t), np.concatenate(window.t_rx)
        return int(t[-1]), int(t_rx[-1])

    def report(self, epoch: Epoch, known: Known) -> Report:
        """Report the whole leg."""
        assert self.flight is not None
        told = channels(self.tallies)
        gaps = {"interpolated": self.bridged, "lost": self.lost}
        gaps |= known.examiner.silences(self.begin, self.end[0], EVER)
        found = np.array([self.found.get(name, (np.nan, np.nan)) for name in self.flight.names])
        return Report(
            vehicle=epoch.vehicle,
            source=STAGE,
            boot=epoch.boot,
            t=np.array([self.end[0]]),
            t_rx=np.array([self.end[1]]),
            model=MODEL,
            test_point="",
            scope="sortie",
            window=self.number,
            begin=self.begin,
            states=spreads(self.flight, np.median(self.filtered, axis=0), np.median(self.smoothed, axis=0)),
            parameters=parameters(self.flight, found[:, 0], found[:, 1], {}),
            channels=told,
            gaps={name: seconds for name, seconds in gaps.items() if seconds},
            loss=known.examiner.loss(self.begin, self.end[0], EVER),
            loss_effect={},
            findings=known.examiner.findings(-EVER, EVER, EVER, known.delay),
            alarms=alarms(told, self.doubts, len(self._failed)),
            digest=self._digest.hexdigest(),
        )


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
