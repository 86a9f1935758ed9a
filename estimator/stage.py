"""The stage: samples to estimates and windows.

The only file of the room that knows the vocabulary. Per vehicle and boot epoch it orders the samples, filters them as
they become complete, closes windows, and smooths what has closed. Nothing crosses a boot: a new epoch begins from the
prior.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from estimator.information import Carry, anchor, filter, start
from estimator.model import LinearModel
from estimator.models import trajectory
from estimator.models.trajectory import Trajectory
from estimator.smoother import backward
from estimator.snapshots import Store
from estimator.synchronise import Rows, Steps, Synchroniser
from estimator.window import Rule
from telemetry.messages import Altitude, Estimate, Event, Gnss, Mark, Message, Progress, Window, event

SENSORS = ("gnss", "altitude")
STAGE = "estimate"
Scope = Literal["window", "sortie"]
Reason = Literal["mark", "gap", "length", "reboot", "end"]


class Settings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How samples become estimates.

    Parameters
    ----------
    lag : float
        How long a sample waits for older ones, s: the delay of the live estimate.
    grid : float
        Longest step without a measurement, s.
    gap : float
        A silence longer than this closes the window, s.
    window : float
        Longest window between test points, s.
    test_point : float
        Longest test point, s; one that is never stopped closes then.
    trajectory : estimator.models.trajectory.Settings
    """

    lag: float = 0.3
    grid: float = 0.5
    gap: float = 3.0
    window: float = 30.0
    test_point: float = 600.0
    trajectory: trajectory.Settings = trajectory.Settings()


def estimate(
    messages: Iterable[Message], settings: Settings | None = None, *, scope: Scope = "window"
) -> Iterator[Message]:
    """Estimate the state of every vehicle.

    Parameters
    ----------
    messages : iterable of Message
        The output of `telemetry.ingest.ingest`.
    settings : Settings, optional
    scope : {"window", "sortie"}
        What a window's smoothing knows: everything up to its closing, told when it closes; or the whole boot epoch,
        told when that ends.

    Yields
    ------
    Estimate, Window, Event, Progress
        The estimates do not depend on `scope`, nor does anything on how the input was cut into batches.
    """
    settings = settings or Settings()
    vehicles: dict[int, dict[int, _Epoch]] = {}
    for message in messages:
        if isinstance(message, Gnss | Altitude | Mark):
            epochs = vehicles.setdefault(message.vehicle, {})
            if message.boot not in epochs:
                epochs[message.boot] = _Epoch(message.vehicle, message.boot, settings, scope)
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
            yield Progress(vehicle=0, source=STAGE, boot=0, t=message.t, t_rx=message.t_rx, final=message.final)


def warm_up() -> None:
    """Compile the stage by running it on a few samples, so that the first real ones do not wait for it."""
    t = 200_000_000 * np.arange(1, 41)
    common: dict[str, Any] = {"vehicle": 1, "source": "0/1", "boot": 0, "t": t, "t_rx": t}
    ones = np.ones(len(t))
    samples: list[Message] = [
        Gnss(
            **common,
            latitude=ones,
            longitude=ones,
            altitude=ones,
            velocity=np.zeros((len(t), 3)),
            sigma=np.ones((len(t), 3)),
            satellites=np.full(len(t), 9),
        ),
        Altitude(**common, altitude=ones, pressure=ones, sigma=ones),
        Progress(vehicle=0, source="", boot=0, t=t[-1:], t_rx=t[-1:], final=True),
    ]
    for _ in estimate(samples, Settings(window=3.0)):
        pass


@dataclass(slots=True)
class _Open:
    """The window that is being flown."""

    first: int  # index of its first step in the store
    test_point: str = ""
    t: list[NDArray[np.int64]] = field(default_factory=list)
    t_rx: list[NDArray[np.int64]] = field(default_factory=list)
    used: NDArray[np.int64] = field(default_factory=lambda: np.zeros(len(SENSORS), np.int64))
    nis: float = 0.0
    dof: int = 0
    anchors: int = 0
    digest: Any = None

    @property
    def begin(self) -> int:
        return int(self.t[0][0])

    def __len__(self) -> int:
        return sum(len(t) for t in self.t)


class _Epoch:
    """One boot epoch of one vehicle."""

    def __init__(self, vehicle: int, boot: int, settings: Settings, scope: Scope) -> None:
        self.heard = np.iinfo(np.int64).max  # receive time of the first message
        self._vehicle, self._boot, self._settings, self._scope = vehicle, boot, settings, scope
        self._taken: list[Message] = []
        self._model: Trajectory | None = None
        self._synchroniser = Synchroniser(
            len(SENSORS), trajectory.M, lag=round(settings.lag * 1e9), grid=round(settings.grid * 1e9)
        )
        self._marks: list[tuple[str, str]] = []
        self._late: list[tuple[int, int]] = []
        self._rule = Rule(scale=np.array(trajectory.SCALE))
        self._store = Store()
        self._carry: Carry = start(trajectory.N)
        self._std = np.full(trajectory.N, np.inf)
        self._configuration = msgspec.json.encode(settings)
        self._number = 0
        self._closed: list[Window] = []  # waiting for the end of the epoch
        self._window = self._open(0, "")

    def take(self, message: Message) -> None:
        """Take a message in; nothing happens before its receive time has been covered."""
        self.heard = min(self.heard, int(message.t_rx.min()))
        self._taken.append(message)

    def advance(self, until: int, final: bool = False) -> Iterator[Message]:
        """Filter what is complete, and tell the windows that close on the way."""
        if self._model is None:
            yield from self._begin(until)
        if self._model is None:
            return
        for message in self._taken:
            self._push(message, self._model)
        self._taken = []
        steps = self._synchroniser.release(until, final)
        self._late += steps.late
        yield from self._walk(steps, self._model)

    def finish(self, until: int, reason: Reason) -> Iterator[Message]:
        """Let everything out and close the last window."""
        yield from self.advance(until, final=True)
        if self._model is None:
            samples = sum(len(m.t) for m in self._taken)
            yield self._event(
                "warning",
                f"no satellite fix in boot {self._boot}: nothing to estimate from {samples} samples",
                int(self._taken[-1].t[-1]),
                int(self._taken[-1].t_rx[-1]),
            )
            return
        yield from self._close(reason, np.iinfo(np.int64).max)
        yield from self._smooth_epoch()

    # -- samples -------------------------------------------------------------------------------------------------------

    def _begin(self, until: int) -> Iterator[Event]:
        """Found the model on the first fix: its place is the origin."""
        fixes = [
            (int(m.t_rx[0]), int(m.t[0]), i)
            for i, m in enumerate(self._taken)
            if isinstance(m, Gnss) and m.t_rx[0] <= until
        ]
        if not fixes:
            return
        t_rx, t, index = min(fixes)
        fix = self._taken[index]
        assert isinstance(fix, Gnss)
        place = float(fix.latitude[0]), float(fix.longitude[0]), float(fix.altitude[0])
        self._model = Trajectory(*place, self._settings.trajectory)
        self._carry = start(trajectory.N, self._model.x0, self._model.p0)
        self._taken = [m for m in (_since(m, t_rx) for m in self._taken) if m is not None]
        yield self._event(
            "info",
            f"trajectory model from satellite fixes and altimeter, origin "
            f"{np.rad2deg(place[0]):.5f} {np.rad2deg(place[1]):.5f} deg, {place[2]:.0f} m",
            t,
            t_rx,
        )

    def _push(self, message: Message, model: Trajectory) -> None:
        if isinstance(message, Mark):
            for t, t_rx, action, name in zip(message.t, message.t_rx, message.action, message.name, strict=True):
                self._synchroniser.mark(int(t), int(t_rx))
                self._marks.append((action, name))
            return
        if isinstance(message, Gnss):
            z, r = model.gnss(message.latitude, message.longitude, message.altitude, message.velocity, message.sigma)
            sensor = 0
        else:
            assert isinstance(message, Altitude)
            z, r = model.altimeter(message.altitude, message.sigma)
            sensor = 1
        self._synchroniser.push(Rows(message.t, message.t_rx, np.full(len(message.t), sensor), z, r))

    # -- windows -------------------------------------------------------------------------------------------------------

    def _walk(self, steps: Steps, model: Trajectory) -> Iterator[Message]:
        """Filter the steps, stopping wherever a window closes."""
        t = steps.t
        quiet = steps.silence > self._settings.gap
        quiet[1:] &= ~steps.silent[:-1]  # only the first step of a silence
        silences = np.flatnonzero(quiet)
        marks = list(steps.marks)
        i = 0
        while i < len(t) or marks:
            longest = self._settings.test_point if self._window.test_point else self._settings.window
            begin = self._window.begin if len(self._window) else int(t[i]) if i < len(t) else 0
            later = silences[silences >= i + (len(self._window) == 0)]
            cuts: list[tuple[int, Reason]] = [(len(t), "end")]
            if len(later):
                cuts.append((int(later[0]), "gap"))
            cuts.append((int(np.searchsorted(t, begin + round(longest * 1e9), "right")), "length"))
            if marks:
                cuts.append((int(np.searchsorted(t, marks[0][0], "right")), "mark"))
            order: dict[Reason, int] = {"mark": 0, "gap": 1, "length": 2, "end": 3}
            cut, reason = min(cuts, key=lambda c: (max(c[0], i), order[c[1]]))
            cut = max(cut, i)
            if cut > i:
                yield from self._filter(_rows(steps, i, cut), model)
                i = cut
            if reason == "mark":
                when, number = marks.pop(0)
                yield from self._mark(when, *self._marks[number])
            elif cut < len(t):
                yield from self._close(reason, int(t[cut]))

    def _filter(self, steps: Steps, model: Trajectory) -> Iterator[Message]:
        if len(steps.t) in (trajectory.M, trajectory.P):  # variances by rows could be taken for a covariance
            yield from self._filter(_rows(steps, 0, 1), model)
            steps = _rows(steps, 1, len(steps.t))
        phi, gamma, q = model.transition(steps.dt)
        before = len(self._store.anchors)
        chunk = LinearModel(phi, gamma, q, model.observation(steps.r), steps.r)
        self._carry, live = filter(chunk, self._carry, steps.z, rule=self._rule, store=self._store)
        window = self._window
        window.t.append(steps.t)
        window.t_rx.append(steps.t_rx)
        window.used += steps.used.sum(axis=0)
        for nis, dof in zip(live.nis.tolist(), live.dof.tolist(), strict=True):  # in order, so that cuts do not matter
            window.nis += nis
            window.dof += dof
        window.anchors += len(self._store.anchors) - before
        window.digest.update(np.column_stack([steps.t.view(np.float64), steps.z, steps.r]).tobytes())
        yield Estimate(
            vehicle=self._vehicle,
            source=STAGE,
            boot=self._boot,
            t=steps.t,
            t_rx=steps.t_rx,
            model=trajectory.MODEL,
            names=trajectory.NAMES,
            units=trajectory.UNITS,
            mean=live.mean,
            std=live.std,
            nis=live.nis,
            dof=live.dof,
            geodetic=model.geodetic(live.mean),
        )
        yield from self._tell_gaps(steps, live.std)
        self._std = live.std[-1]

    def _tell_gaps(self, steps: Steps, std: NDArray[np.float64]) -> Iterator[Event]:
        """What each silence did to the uncertainty."""
        ends = np.flatnonzero((steps.silence > self._settings.gap) & ~steps.silent)
        for end in ends:
            first = int(end)
            while first > 0 and steps.silent[first - 1]:
                first -= 1
            before = std[first - 1] if first > 0 else self._std
            worst = std[end - 1] if end > first else std[end]
            yield self._event(
                "warning",
                f"{steps.silence[end]:.1f} s without a measurement: std(north) {before[0]:.1f} -> "
                f"{worst[0]:.1f} m, std(altitude) {before[4]:.1f} -> {worst[4]:.1f} m",
                int(steps.t[end]),
                int(steps.t_rx[end]),
            )

    def _mark(self, when: int, action: str, name: str) -> Iterator[Message]:
        if action == "stop" and self._window.test_point != name:
            t_rx = int(self._window.t_rx[-1][-1]) if len(self._window) else when
            yield self._event("warning", f"test point {name} stopped without having been started: ignored", when, t_rx)
            return
        if action == "start" and self._window.test_point == name:
            return  # said twice
        yield from self._close("mark", when)
        self._window.test_point = name if action == "start" else ""

    def _open(self, first: int, test_point: str) -> _Open:
        return _Open(first, test_point, digest=hashlib.sha256(self._configuration))

    def _close(self, reason: Reason, when: int) -> Iterator[Window]:
        """Close the window at time `when` (of the step or mark that closed it) and begin the next one."""
        window = self._window
        late = Counter(SENSORS[sensor] for t, sensor in self._late if t <= when)
        self._late = [item for item in self._late if item[0] > when]
        if not len(window):
            return
        closed = self._message(window, reason, dict(late))
        if self._scope == "window":
            mean, std = backward(self._store, self._carry, covariance=False)
            yield self._smoothed(closed, mean[1:], std[1:])
            self._store.drop(len(self._store))
        else:
            self._closed.append(closed)
        self._carry = anchor(self._carry)
        self._number += 1
        # A test point that a silence or its length cuts in two stays one until it is stopped.
        self._window = self._open(len(self._store), window.test_point if reason in ("gap", "length") else "")

    def _message(self, window: _Open, reason: Reason, late: dict[str, int]) -> Window:
        t, t_rx = np.concatenate(window.t), np.concatenate(window.t_rx)
        nothing = np.full((len(t), trajectory.N), np.nan)
        return Window(
            vehicle=self._vehicle,
            source=STAGE,
            boot=self._boot,
            t=t,
            t_rx=t_rx,
            model=trajectory.MODEL,
            names=trajectory.NAMES,
            units=trajectory.UNITS,
            mean=nothing,
            std=nothing,
            geodetic=np.full((len(t), 3), np.nan),
            number=self._number,
            test_point=window.test_point,
            reason=reason,
            scope=self._scope,
            measurements=dict(zip(SENSORS, window.used.tolist(), strict=True)),
            late=late,
            anchors=window.anchors,
            nis=window.nis,
            dof=window.dof,
            digest=window.digest.hexdigest(),
        )

    def _smooth_epoch(self) -> Iterator[Window]:
        """One smoothing of the whole epoch, told window by window."""
        if not self._closed:
            return
        mean, std = backward(self._store, self._carry, covariance=False)
        first = 1
        for closed in self._closed:
            last = first + len(closed.t)
            yield self._smoothed(closed, mean[first:last], std[first:last])
            first = last
        self._closed = []
        self._store.drop(len(self._store))

    def _smoothed(self, closed: Window, mean: NDArray[np.float64], std: NDArray[np.float64]) -> Window:
        assert self._model is not None
        return msgspec.structs.replace(closed, mean=mean, std=std, geodetic=self._model.geodetic(mean))

    def _event(self, level: Literal["info", "warning", "error"], text: str, t: int, t_rx: int) -> Event:
        return event(text, level=level, vehicle=self._vehicle, source=STAGE, boot=self._boot, t=t, t_rx=t_rx)


def _rows(steps: Steps, first: int, last: int) -> Steps:
    rows = slice(first, last)
    return Steps(
        steps.t[rows],
        steps.t_rx[rows],
        steps.dt[rows],
        steps.silence[rows],
        steps.silent[rows],
        steps.z[rows],
        steps.r[rows],
        steps.used[rows],
        marks=[],
        late=[],
    )


def _since(message: Message, t_rx: int) -> Message | None:
    """The samples received at `t_rx` or later; marks are kept whole."""
    keep = np.ones(len(message.t), np.bool_) if isinstance(message, Mark) else message.t_rx >= t_rx
    if not keep.any():
        return None
    columns = {
        name: value[keep]
        for name in message.__struct_fields__
        if isinstance(value := getattr(message, name), np.ndarray)
    }
    return msgspec.structs.replace(message, **columns)
