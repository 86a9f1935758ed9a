"""One stretch of the flight path as the stage tells it: estimates as they come, windows as they close."""

from __future__ import annotations

import copy
import hashlib
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimator.consistency import Tally
from estimator.drive import IMPACT, MEASURED, Driver, Samples, Steps, merged
from estimator.extended import REJECTED
from estimator.kinematics import MEASUREMENTS, M
from estimator.models.flight_path import MODEL, FlightPath
from estimator.stage.estimators import Estimator, Path
from estimator.stage.rows import SENSORS
from estimator.stage.settings import STAGE, Reason, fingerprint
from estimator.stretch import Diverged, Filtered, Smoothed
from estimator.synchronise import Rows
from estimator.ud import compiled
from telemetry.messages import Estimate, Event, Window

if TYPE_CHECKING:
    from estimator.stage.flight import Flight

Floats = NDArray[np.float64]
Times = NDArray[np.int64]

SENSOR_OF = ("air_data", "flow_angles", "flow_angles", *("attitude",) * 3, "altitude", *("gnss",) * 3)
FIRST_OF = (0, 1, 3, 6, 7)  # one channel of each sensor, by which its samples are counted
TOLD_GAP = 0.5  # s without inertial samples that are told at once
DOUBTED = {1: "velocity", 2: "attitude", 4: "turbulence"}


@compiled
def _sums(square: Floats, used: Times, shown: NDArray[np.uint8], left: Floats, nis: Floats, dof: Times) -> None:
    """Sum the squares since the last shown row, in order, so that cuts do not matter; ``left`` carries the rest."""
    k = 0
    for i in range(square.size):
        left[0] += square[i]
        left[1] += used[i]
        if shown[i]:
            nis[k] = left[0]
            dof[k] = np.int64(left[1])
            left[0] = 0.0
            left[1] = 0.0
            k += 1


class _Opening(NamedTuple):
    """Everything as it was when the window was opened."""

    t: int
    point: Any
    driver: Driver
    left: Floats
    steps: int


def _bridged(steps: Steps) -> Iterator[tuple[int, float]]:
    """Ends of the intervals without inertial data, and how long they were, s."""
    bridged = steps.drive.bridged == 1
    if not bridged.any():
        return
    ends = np.flatnonzero(steps.inertial)
    for i in np.flatnonzero(bridged & steps.inertial).tolist():
        before = int(np.searchsorted(ends, i)) - 1
        begin = int(ends[before]) + 1 if before >= 0 else 0
        yield i, float(steps.drive.dt[begin : i + 1].sum())


@dataclass(slots=True)
class Closed:
    """A window of the flight path, open or closed.

    `first` and `stop` are its steps in the stretch, `at` the epochs that are told.
    """

    number: int
    test_point: str
    begin: int
    first: int
    digest: Any
    stop: int = 0
    reason: Reason = "end"
    t: list[Times] = field(default_factory=list)
    t_rx: list[Times] = field(default_factory=list)
    at: list[Times] = field(default_factory=list)
    std: list[Floats] = field(default_factory=list)
    tallies: list[Tally] = field(default_factory=lambda: [Tally() for _ in range(M)])
    used: dict[str, int] = field(default_factory=lambda: dict.fromkeys(SENSORS, 0))
    nis: float = 0.0
    dof: int = 0
    bridged: float = 0.0
    doubts: int = 0
    gaps: int = 0  # that were interpolated and not told one by one
    longest: float = 0.0  # of these, s
    late: dict[str, int] = field(default_factory=dict)


class Passage:
    """The windows of one stretch.

    Parameters
    ----------
    flight : Flight
        The leg it belongs to.
    model : FlightPath
    stretch, driver
    t, t_rx : int
        Of its beginning, ns.
    """

    def __init__(
        self, flight: Flight, model: FlightPath, stretch: Path, driver: Driver, t: int, t_rx: int,
    ) -> None:  # fmt: skip
        self._leg, self.flight, self.stretch, self.driver = flight, model, stretch, driver
        self.last = (t, t_rx)
        self.first = self.begin = self.opened = t
        self.doubts = 0
        self.failed = False
        self._late: dict[str, int] = {}
        self.closed: list[Closed] = []
        self._left = np.zeros(2)
        self._steps = 0  # since the stretch was last forgotten
        self._configuration = fingerprint(flight.epoch.settings)
        self._window: Closed | None = None
        self._opening: _Opening | None = None
        self._log: list[Samples] = []  # since then

    def open(self, test_point: str, begin: int) -> None:
        """Begin a window."""
        self.begin, self.opened = begin, self.last[0]
        self._window = self._new(test_point, self.last[0])
        left, steps = self._left.copy(), self._steps
        self._opening = _Opening(self.last[0], self.stretch.point(), self.driver.copy(), left, steps)
        self._log = []

    def _new(self, test_point: str, begin: int) -> Closed:
        digest = hashlib.sha256(self._configuration)
        return Closed(self._leg.epoch.flown, test_point, begin, self._steps, digest)

    def push(self, samples: Samples) -> Steps | None:
        """Steps that are complete, as `Driver.push`."""
        if len(samples.t):
            self._log.append(samples)
        return self.driver.push(samples)

    @property
    def estimator(self) -> Estimator:
        """What flies it."""
        return self._leg.epoch.estimator

    def air(self) -> bool:
        """Whether an airspeed has come since the window was opened."""
        return any(bool(np.isfinite(part.z[:, (MEASURED, IMPACT)]).any()) for part in self._log)

    def too_late(self, sensors: Times) -> None:
        """Count samples that came after their window had been closed."""
        for sensor in sensors.tolist():
            self._late[SENSORS[sensor]] = self._late.get(SENSORS[sensor], 0) + 1

    def roll_back(self, late: Rows) -> Iterator[Event]:
        """Filter the open window again with samples that came too late for it; the filter goes on from there."""
        window, opening = self._window, self._opening
        if window is None or opening is None or not window.t:
            return
        samples = Samples.join([opening.driver.rest(), *self._log])
        stop = int(np.searchsorted(samples.t, self.last[0], "right"))
        now, after = samples.rows(slice(stop)), samples.rows(slice(stop, None))
        more, new = merged(now, late)
        if not new.any():
            return
        for with_late in (True, False):  # if that fails, as it was
            driver = opening.driver.copy()
            driver.wait(Samples.none())
            steps = driver.push(more if with_late else now)
            self.stretch.rewind(opening.point)
            if steps is None:
                continue
            shown = np.isin(steps.t, np.concatenate(window.t)).astype(np.uint8)
            steps = steps._replace(drive=steps.drive._replace(shown=shown))
            try:
                filtered = self.stretch.advance(steps.drive)
            except Diverged:
                continue
            self._left, self._steps = opening.left.copy(), opening.steps
            self._window = self._new(window.test_point, window.begin)
            self.account(steps, filtered)
            break
        driver.wait(after)
        self.driver = driver
        if with_late:
            names = Counter(SENSORS[sensor] for sensor in late.sensor[new].tolist())
            counts = ", ".join(f"{name} {names[name]}" for name in SENSORS if name in names)
            text = f"late samples put in, the window was filtered again from its beginning: {counts}"
            yield self._leg.epoch.event("info", text, *self.last)

    def account(self, steps: Steps, filtered: Filtered) -> Estimate | None:
        """Take filtered steps into the window, and make a message of those that are told."""
        window, drive = self._window, steps.drive
        assert window is not None
        status = filtered.status
        used = (status != 0) & (status != REJECTED)
        square = np.where(used, np.square(filtered.innovation), 0.0).sum(axis=1)
        shown = np.flatnonzero(drive.shown)
        nis, dof = np.empty(len(shown)), np.empty(len(shown), np.int64)
        _sums(square, used.sum(axis=1), drive.shown, self._left, nis, dof)
        for channel in np.flatnonzero(status.any(axis=0)).tolist():
            window.tallies[channel].add(filtered.innovation[:, channel], status[:, channel].astype(np.int64))
            if channel in FIRST_OF:
                window.used[SENSOR_OF[channel]] += int(np.count_nonzero(status[:, channel]))
        window.doubts += int(np.count_nonzero(filtered.doubted))
        window.used["imu"] += int(steps.inertial.sum())
        for value in nis.tolist():
            window.nis += value
        window.dof += int(dof.sum())
        for _, seconds in _bridged(steps):
            window.bridged += seconds
            if seconds < TOLD_GAP:
                window.gaps += 1
                window.longest = max(window.longest, seconds)
        window.digest.update(np.column_stack([steps.t.view(np.float64), drive.u, drive.z, drive.r]).tobytes())
        window.t.append(steps.t[shown])
        window.t_rx.append(steps.t_rx[shown])
        window.at.append(self._steps + shown + 1)
        window.std.append(filtered.std[shown])
        self._steps += len(steps.t)
        self.last = (int(steps.t[-1]), int(steps.t_rx[-1]))
        if not len(shown):
            return None
        epoch = self._leg.epoch
        return Estimate(
            vehicle=epoch.vehicle,
            source=STAGE,
            boot=epoch.boot,
            t=steps.t[shown],
            t_rx=steps.t_rx[shown],
            model=MODEL,
            names=self.flight.names,
            units=self.flight.units,
            mean=filtered.mean[shown],
            std=filtered.std[shown],
            nis=nis,
            dof=dof,
            geodetic=np.full((len(shown), 3), np.nan),
        )

    def events(self, steps: Steps, filtered: Filtered) -> Iterator[Event]:
        """What a reader of the log should know of these steps."""
        epoch = self._leg.epoch
        for i, seconds in _bridged(steps):
            if seconds >= TOLD_GAP:
                text = (
                    f"{seconds:.2f} s without inertial samples: interpolated, with the variance of unknown manoeuvring"
                )
                yield epoch.event("warning", text, int(steps.t[i]), int(steps.t_rx[i]))
        for i in np.flatnonzero(filtered.doubted).tolist():
            self.doubts += 1
            names = [DOUBTED[bit] for bit in DOUBTED if filtered.doubted[i] & bit]
            refused = [MEASUREMENTS[c] for c in np.flatnonzero(filtered.status[i] == REJECTED)]
            text = (
                f"{', '.join(refused)} refused too often to be wrong: {' and '.join(names)} of the filter doubted, "
                "its variance taken ten times"
            )
            yield epoch.event("warning", text, int(steps.t[i]), int(steps.t_rx[i]))

    def refused(self, window: Closed) -> Iterator[Event]:
        """What the gate did in a window."""
        for name, tally in zip(MEASUREMENTS, window.tallies, strict=True):
            if tally.rejected or tally.weakened:
                text = (
                    f"{name}: of {tally.used + tally.rejected} measurements {tally.rejected} refused "
                    f"(beyond 8 sigmas), {tally.weakened} weakened (beyond 5)"
                )
                yield self._leg.epoch.event("info", text, *self.last)
        if window.gaps:
            text = (
                f"inertial samples missing in {window.gaps} places, for {window.longest:.2f} s at most: interpolated, "
                "with the variance of unknown manoeuvring"
            )
            yield self._leg.epoch.event("warning", text, *self.last)

    def close(self, reason: Reason) -> Closed | None:
        """Close the window; None where it holds nothing."""
        window, self._window = self._window, None
        if window is None or not any(len(t) for t in window.t):
            return None
        window.stop, window.reason = self._steps, reason
        window.late, self._late = self._late, {}
        window.number = self._leg.epoch.flown
        self._leg.epoch.flown += 1
        self.closed.append(window)
        return window

    def taken(self) -> Passage:
        """The windows that have been closed, to be told while the filter goes on here after `forget`."""
        other = copy.copy(self)
        other.stretch, other.driver = self.stretch.taken(), self.driver.copy()
        other._window = other._opening = None
        other._log = []
        return other

    def forget(self) -> None:
        """Let go of what has been told."""
        self.stretch.drop()
        self._steps = 0
        self.closed = []

    def message(self, window: Closed, smoothed: Smoothed) -> Window:
        """The window as it is told."""
        epoch = self._leg.epoch
        at, t = np.concatenate(window.at), np.concatenate(window.t)
        return Window(
            vehicle=epoch.vehicle,
            source=STAGE,
            boot=epoch.boot,
            t=t,
            t_rx=np.concatenate(window.t_rx),
            model=MODEL,
            names=self.flight.names,
            units=self.flight.units,
            mean=smoothed.mean[at],
            std=smoothed.std[at],
            geodetic=np.full((len(t), 3), np.nan),
            number=window.number,
            test_point=window.test_point,
            reason=window.reason,
            scope=epoch.scope,
            measurements=window.used,
            late=window.late,
            anchors=0,
            nis=window.nis,
            dof=window.dof,
            digest=window.digest.hexdigest(),
        )
