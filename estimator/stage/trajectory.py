"""A leg of the trajectory: position and velocity from satellite fixes and altimeter, as long as one filter flies it."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from estimator.model import LinearModel
from estimator.models import trajectory
from estimator.models.trajectory import Trajectory
from estimator.stage.estimators import Store
from estimator.stage.rows import ALTITUDE, FIX_VELOCITY, GNSS, HEIGHT_COLUMN, SENSORS
from estimator.stage.settings import STAGE, Reason, fingerprint
from estimator.synchronise import MARK, Rows, Steps, Synchroniser, take
from estimator.window import Rule
from telemetry.messages import Estimate, Event, Message, Window

if TYPE_CHECKING:
    from estimator.stage.epoch import Epoch

USED = SENSORS[:2]


@dataclass(slots=True)
class _Open:
    """The window that is being flown."""

    test_point: str
    digest: Any
    begin: int | None = None  # time of its first measurement
    t: list[NDArray[np.int64]] = field(default_factory=list)
    t_rx: list[NDArray[np.int64]] = field(default_factory=list)
    used: NDArray[np.int64] = field(default_factory=lambda: np.zeros(len(USED), np.int64))
    nis: float = 0.0
    dof: int = 0
    anchors: int = 0


class Leg:
    """A stretch of an epoch that one filter flies.

    `number` and `test_point` are those of the window being flown, `at` and `at_rx` the times of the step at hand.
    """

    def __init__(self, epoch: Epoch, model: Trajectory, number: int, test_point: str) -> None:
        self._epoch, self._model = epoch, model
        self.number = number
        self.at = self.at_rx = 0
        settings = self._settings = epoch.settings
        self._synchroniser = Synchroniser(
            len(USED), trajectory.M, lag=round(settings.lag * 1e9), grid=round(settings.grid * 1e9),
            least=None if settings.least_lag is None else round(settings.least_lag * 1e9),
        )  # fmt: skip
        self.watermark = self._synchroniser.watermark  # before what is at hand arrived
        self._marks: list[tuple[str, str]] = []
        self._late: list[tuple[int, int]] = []
        self._rule = Rule(scale=np.array(trajectory.SCALE))
        self._use = epoch.estimator
        self._store: Store = self._use.store()
        self._carry = self._use.start(trajectory.N, model.x0, model.p0)
        self._std = self._std_measured = np.full(trajectory.N, np.inf)  # after the last step, and the last measured one
        self._configuration = fingerprint(settings)
        self._closed: list[Window] = []  # waiting for the end of the leg
        self._released = np.empty(0, np.int64)  # times of the measurements at hand
        self._window = self._open(test_point)

    @property
    def oldest(self) -> int:
        """The least time of a sample that waits to become a step, ns."""
        return self._synchroniser.oldest

    @property
    def lag(self) -> int:
        """How long a sample waits now, ns."""
        return self._synchroniser.watermark.lag

    @property
    def test_point(self) -> str:
        """Name of the test point under way, "" for none."""
        return self._window.test_point

    def advance(self, rows: Rows, until: int) -> Iterator[Message]:
        """Filter what is complete, and tell the windows that close on the way."""
        model = self._model
        is_mark = rows.sensor == MARK
        if is_mark.any():
            marks, rows = take(rows, is_mark), take(rows, ~is_mark)
            for t, t_rx, number in zip(marks.t, marks.t_rx, marks.z[:, 0], strict=True):
                self._synchroniser.mark(int(t), int(t_rx))
                self._marks.append(self._epoch.marks[int(number)])
        z, r = np.full((len(rows.t), trajectory.M), np.nan), np.ones((len(rows.t), trajectory.M))
        at = np.flatnonzero(rows.sensor == GNSS)
        if len(at):
            fixes, stated = rows.z[at], rows.r[at, :3]
            z[at], r[at] = model.gnss(fixes[:, 0], fixes[:, 1], fixes[:, 2], fixes[:, FIX_VELOCITY], stated)
        at = np.flatnonzero(rows.sensor == ALTITUDE)
        if len(at):
            z[at], r[at] = model.altimeter(rows.z[at, HEIGHT_COLUMN], rows.r[at, HEIGHT_COLUMN])
        # With a lag that adapts time passes with the others too, which make no steps: an altitude does not wait for the
        # next one.
        rows = rows._replace(z=z, r=r)
        if self._settings.least_lag is None:  # they wait for each other alone, whatever else has come
            rows = take(rows, rows.sensor < len(USED))
        self._synchroniser.push(rows)
        self.watermark = self._synchroniser.watermark.copy()
        yield from self._release(until, False)

    def finish(self, reason: Reason, until: int) -> Iterator[Message]:
        """Let everything out and close the last window."""
        yield from self._release(until, True)
        yield from self.close(reason, np.iinfo(np.int64).max)
        yield from self.smooth()

    def _release(self, until: int, final: bool) -> Iterator[Message]:
        steps = self._synchroniser.release(until, final)
        self._late += steps.late
        if len(steps.t) or steps.marks:
            yield from self._walk(steps)

    # -- windows -------------------------------------------------------------------------------------------------------

    def _walk(self, steps: Steps) -> Iterator[Message]:
        """Filter the steps, stopping wherever a window closes."""
        t = steps.t
        quiet = steps.silence > self._settings.gap
        quiet[1:] &= ~steps.silent[:-1]  # only the first step of a silence
        silences = np.flatnonzero(quiet)
        measured = np.flatnonzero(~steps.silent)  # a silence is released with the step that ends it
        self._released = t[measured]
        marks = list(steps.marks)
        i = 0
        while i < len(t) or marks:
            longest = self._settings.test_point if self._window.test_point else self._settings.window
            begin = self._window.begin
            if begin is None and i < len(t):
                begin = int(t[measured[np.searchsorted(measured, i)]])
            later = silences[silences >= i + (not self._window.t)]
            cuts: list[tuple[int, Reason]] = [(len(t), "end")]
            if len(later):
                cuts.append((int(later[0]), "gap"))
            if begin is not None:
                over = int(np.searchsorted(t, begin + round(longest * 1e9), "right"))
                if over < len(t) and over > i and steps.silent[over - 1]:  # not in a silence: after it
                    over = int(measured[np.searchsorted(measured, over)]) + 1
                cuts.append((over, "length"))
            if marks:
                cuts.append((int(np.searchsorted(t, marks[0][0], "right")), "mark"))
            order: dict[Reason, int] = {"mark": 0, "gap": 1, "length": 2, "end": 3}
            cut, reason = min(cuts, key=lambda c: (max(c[0], i), order[c[1]]))
            cut = max(cut, i)
            if cut > i:
                yield from self._filter(steps.cut(i, cut))
                i = cut
            if reason == "mark":
                when, number = marks.pop(0)
                yield from self._mark(when, *self._marks[number])
            elif cut < len(t):
                self.at, self.at_rx = int(t[measured[np.searchsorted(measured, cut)]]), int(steps.t_rx[cut])
                yield from self.close(reason, int(t[cut]))

    def _filter(self, steps: Steps) -> Iterator[Message]:
        if len(steps.t) in (trajectory.M, trajectory.P):  # variances by rows could be taken for a covariance
            yield from self._filter(steps.cut(0, 1))
            steps = steps.cut(1, len(steps.t))
        phi, gamma, q = self._model.transition(steps.dt)
        before = len(self._store.anchors)
        chunk = LinearModel(phi, gamma, q, self._model.observation(steps.r), steps.r)
        try:
            self._carry, live = self._use.filter(chunk, self._carry, steps.z, rule=self._rule, store=self._store)
        except (ValueError, ArithmeticError):
            if len(steps.t) == 1:
                self.at, self.at_rx = (
                    int(self._released[np.searchsorted(self._released, steps.t[0])]),
                    int(steps.t_rx[0]),
                )
                raise
            half = len(steps.t) // 2  # up to the step that fails, everything is as if it had come alone
            yield from self._filter(steps.cut(0, half))
            yield from self._filter(steps.cut(half, len(steps.t)))
            return
        window = self._window
        measured = np.flatnonzero(~steps.silent)
        if window.begin is None and len(measured):
            window.begin = int(steps.t[measured[0]])
        window.t.append(steps.t)
        window.t_rx.append(steps.t_rx)
        window.used += steps.used.sum(axis=0)
        for nis, dof in zip(live.nis.tolist(), live.dof.tolist(), strict=True):  # in order, so that cuts do not matter
            window.nis += nis
            window.dof += dof
        window.anchors += len(self._store.anchors) - before
        window.digest.update(np.column_stack([steps.t.view(np.float64), steps.z, steps.r]).tobytes())
        yield Estimate(
            vehicle=self._epoch.vehicle,
            source=STAGE,
            boot=self._epoch.boot,
            t=steps.t,
            t_rx=steps.t_rx,
            model=trajectory.MODEL,
            names=trajectory.NAMES,
            units=trajectory.UNITS,
            mean=live.mean,
            std=live.std,
            nis=live.nis,
            dof=live.dof,
            geodetic=self._model.geodetic(live.mean),
        )
        yield from self._tell_gaps(steps, live.std)
        self._std = live.std[-1]
        if len(measured):
            self._std_measured = live.std[measured[-1]]

    def _tell_gaps(self, steps: Steps, std: NDArray[np.float64]) -> Iterator[Event]:
        """What each silence did to the uncertainty."""
        measured = np.flatnonzero(~steps.silent)
        for end in np.flatnonzero((steps.silence > self._settings.gap) & ~steps.silent).tolist():
            last = int(np.searchsorted(measured, end)) - 1
            before = std[measured[last]] if last >= 0 else self._std_measured
            worst = std[end]
            if steps.dt[end] < steps.silence[end]:  # steps were put in: the last of them
                worst = std[end - 1] if end > 0 else self._std
            yield self._epoch.event(
                "warning",
                f"{steps.silence[end]:.1f} s without a measurement: std(north) {before[0]:.1f} -> "
                f"{worst[0]:.1f} m, std(altitude) {before[4]:.1f} -> {worst[4]:.1f} m",
                int(steps.t[end]),
                int(steps.t_rx[end]),
            )

    def _mark(self, when: int, action: str, name: str) -> Iterator[Message]:
        if action == "stop" and self._window.test_point != name:
            t_rx = int(self._window.t_rx[-1][-1]) if self._window.t else when
            yield self._epoch.event(
                "warning", f"test point {name} stopped without having been started: ignored", when, t_rx
            )
            return
        if action == "start" and self._window.test_point == name:
            return  # said twice
        yield from self.close("mark", when)
        self._window.test_point = name if action == "start" else ""

    def _open(self, test_point: str) -> _Open:
        return _Open(test_point, hashlib.sha256(self._configuration))

    def close(self, reason: Reason, when: int) -> Iterator[Window]:
        """Close the window at time `when` (of the step or mark that closed it) and begin the next one."""
        window = self._window
        if not window.t:
            return
        late = Counter(USED[sensor] for t, sensor in self._late if t <= when)
        self._late = [item for item in self._late if item[0] > when]
        closed = self._message(window, reason, dict(late))
        if self._epoch.scope == "window":
            mean, std = self._use.smooth(self._store, self._carry)
            yield self._smoothed(closed, mean[1:], std[1:])
            self._store.drop(len(self._store))
        else:
            self._closed.append(closed)
        self._carry = self._use.anchor(self._carry)
        self.number += 1
        # A test point that a silence or its length cuts in two stays one until it is stopped.
        self._window = self._open(window.test_point if reason in ("gap", "length") else "")

    def _message(self, window: _Open, reason: Reason, late: dict[str, int]) -> Window:
        t, t_rx = np.concatenate(window.t), np.concatenate(window.t_rx)
        nothing = np.full((len(t), trajectory.N), np.nan)
        return Window(
            vehicle=self._epoch.vehicle,
            source=STAGE,
            boot=self._epoch.boot,
            t=t,
            t_rx=t_rx,
            model=trajectory.MODEL,
            names=trajectory.NAMES,
            units=trajectory.UNITS,
            mean=nothing,
            std=nothing,
            geodetic=np.full((len(t), 3), np.nan),
            number=self.number,
            test_point=window.test_point,
            reason=reason,
            scope=self._epoch.scope,
            measurements=dict(zip(USED, window.used.tolist(), strict=True)),
            late=late,
            anchors=window.anchors,
            nis=window.nis,
            dof=window.dof,
            digest=window.digest.hexdigest(),
        )

    def smooth(self) -> Iterator[Window]:
        """One smoothing of the whole leg, told window by window."""
        if not self._closed:
            return
        mean, std = self._use.smooth(self._store, self._carry)
        first = 1
        for closed in self._closed:
            last = first + len(closed.t)
            yield self._smoothed(closed, mean[first:last], std[first:last])
            first = last
        self._closed = []
        self._store.drop(len(self._store))

    def _smoothed(self, closed: Window, mean: NDArray[np.float64], std: NDArray[np.float64]) -> Window:
        return msgspec.structs.replace(closed, mean=mean, std=std, geodetic=self._model.geodetic(mean))
