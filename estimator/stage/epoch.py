"""One boot epoch of one vehicle: what arrives, and the legs that are flown with it."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from estimator.arrivals import Arrivals, Place
from estimator.drive import WIDTH
from estimator.models.trajectory import Trajectory
from estimator.stage import estimators
from estimator.stage.beside import Beside
from estimator.stage.estimators import Path
from estimator.stage.flight import Flight
from estimator.stage.rows import GNSS, KINDS, SENSORS, WITNESSES, rows
from estimator.stage.settings import STAGE, Level, Reason, Scope, Settings
from estimator.stage.sieve import Sieve
from estimator.stage.trajectory import Leg
from estimator.synchronise import MARK, NEVER, Rows, concatenate, take
from telemetry.messages import Altitude, Event, Gnss, Mark, Message, event

TAKEN = (*KINDS, Mark)
SLOW = (Gnss, Altitude)  # what the trajectory is made of


class Epoch:
    """One boot epoch of one vehicle: its arrivals, and the leg that is being flown."""

    def __init__(self, vehicle: int, boot: int, settings: Settings, scope: Scope, beside: Beside) -> None:
        self.heard = np.iinfo(np.int64).max  # receive time of the first message
        self.vehicle, self.boot, self.settings, self.scope, self.beside = vehicle, boot, settings, scope, beside
        self.estimator = estimators.named(settings.estimator)
        self._lag, self._output = round(settings.lag * 1e9), round(settings.output * 1e9)
        self._arrivals = Arrivals(SENSORS, GNSS, lag=self._lag, witnesses=WITNESSES)
        self._sieve = Sieve()
        self.marks: list[tuple[str, str]] = []  # action and name
        self._leg: Leg | None = None
        self._flight: Flight | None = None
        self.flown = 0  # windows of the flight path
        self.found: dict[str, list[tuple[float, float]]] = {}  # parameters of the test points so far: value, sigma
        self._number, self._test_point = 0, ""  # of the next leg's first window
        self._begun = False
        self.begun: Callable[[Path], object] | None = None  # told of every flight path that begins
        self._samples, self._t, self._t_rx = 0, np.iinfo(np.int64).min, np.iinfo(np.int64).min
        self._waits = NEVER  # least time of what the trajectory has not used yet
        self._worked = -NEVER  # receive time up to which everything has been worked on
        self._new = False  # something has come since
        self._told = False  # a mark has

    def take(self, message: Message) -> None:
        """Take a message in; nothing happens before its receive time has been covered."""
        self.heard = min(self.heard, int(message.t_rx.min()))
        self._samples += len(message.t)
        self._t, self._t_rx = max(self._t, int(message.t.max())), max(self._t_rx, int(message.t_rx.max()))
        self._new = True
        if isinstance(message, Mark):
            self._told = True
            k = len(message.t)
            z = np.full((k, WIDTH), np.nan)
            z[:, 0] = len(self.marks) + np.arange(k)
            self.marks += zip(message.action, message.name, strict=True)
            self._arrivals.push(Rows(message.t, message.t_rx, np.full(k, MARK), z, np.ones((k, WIDTH))))
        else:
            if isinstance(message, SLOW):
                self._waits = min(self._waits, int(message.t.min()))
            self._arrivals.push(rows(message))

    def _due(self, until: int) -> bool:
        """Whether an estimate may be told now: what comes in between is worked on with it, which is so much cheaper.

        Results do not depend on it, as they do not depend on how the input was cut.
        """
        if not self._new:
            return False
        if self._told or self._leg is None or until - self._worked >= self._output:
            return True
        if self._t - self._leg.lag >= self._waits:
            return True
        if self._flight is None or self._flight.at is None:
            return False
        return (self._t - self._flight.lag) // self._output > self._flight.at[0] // self._output

    def advance(self, until: int, end: Reason | None = None) -> Iterator[Message]:
        """Filter what is complete, and tell the windows that close on the way."""
        if end is None and not self._due(until):
            return
        yield from self._work(until, end)
        self._waits = NEVER if self._leg is None else self._leg.oldest
        self._worked, self._new, self._told = until, False, False

    def _work(self, until: int, end: Reason | None) -> Iterator[Message]:
        arrived = self._arrivals.covered(until)
        if arrived is not None:
            arrived, refusals = self._sieve.sift(arrived)
            for refusal in refusals:
                yield self.event("warning", *refusal)
        while arrived is not None and len(arrived.t):
            piece = self._arrivals.judge(arrived, end is not None)
            arrived = piece.rest
            failed = len(piece.judged.t)  # nowhere
            if piece.origin is not None:
                self._leg, self._flight = self._begin(piece.origin)
                fix = int(np.flatnonzero(piece.rows.sensor == GNSS)[0])
                yield self.event(
                    "info",
                    f"trajectory model{self.by} from satellite fixes and altimeter, origin "
                    f"{np.rad2deg(piece.origin[0]):.5f} {np.rad2deg(piece.origin[1]):.5f} deg, "
                    f"{piece.origin[2]:.0f} m",
                    int(piece.rows.t[fix]),
                    int(piece.rows.t_rx[fix]),
                )
            if self._leg is not None:
                try:
                    yield from self._leg.advance(piece.rows, until)
                    if piece.over:
                        yield from self._leg.finish("gap", until)
                except (ValueError, ArithmeticError) as error:
                    failed = piece.row(self._leg.watermark, self._leg.at)
                    yield from self._fly(take(piece.rows, piece.places <= failed), until)
                    yield from self._fail(self._leg, error)
                    arrived = concatenate([take(piece.judged, np.arange(failed + 1, len(piece.judged.t))), arrived])
                else:
                    yield from self._fly(piece.rows, until)
                    if piece.over:
                        yield from self._over(self._leg, "gap", until)
            for note in piece.notes:
                if note.row <= failed:  # what came after is judged anew
                    yield self.event("warning", note.text, note.t, note.t_rx)

    def finish(self, until: int, reason: Reason) -> Iterator[Message]:
        """Let everything out and close the last window."""
        yield from self.advance(until, reason)
        if self._leg is not None:
            leg = self._leg
            try:
                yield from leg.finish(reason, until)
            except (ValueError, ArithmeticError) as error:
                yield from self._fail(leg, error)
            else:
                yield from self._over(leg, reason, until)
        for text in self._sieve.sums():
            yield self.event("warning", text, self._t, self._t_rx)
        if not self._begun:
            text = f"no satellite fix in boot {self.boot}: nothing to estimate from {self._samples} samples"
            yield self.event("warning", text, self._t, self._t_rx)

    def _begin(self, origin: Place) -> tuple[Leg, Flight | None]:
        self._begun = True
        model = Trajectory(*origin, self.settings.trajectory)
        leg = Leg(self, model, self._number, self._test_point)
        return leg, None if self.settings.model == "trajectory" else Flight(self, origin, self._test_point)

    def _fly(self, samples: Rows, until: int) -> Iterator[Message]:
        if self._flight is not None:
            try:
                yield from self._flight.advance(samples, until)
            except (ValueError, ArithmeticError) as error:
                yield self._lost(self._flight, error)
                self._flight = None

    def _land(self, reason: Reason, until: int) -> Iterator[Message]:
        if self._flight is not None:
            flight, self._flight = self._flight, None
            try:
                yield from flight.finish(reason, until)
            except (ValueError, ArithmeticError) as error:
                yield self._lost(flight, error)

    def _lost(self, flight: Flight, error: Exception) -> Event:
        """Give the flight path of this leg up; the trajectory goes on."""
        text = f"the flight path of vehicle {self.vehicle}, boot {self.boot} failed, the trajectory goes on: {error}"
        return self.event("error", text, *(flight.at or (self._t, self._t_rx)))

    def _over(self, leg: Leg, reason: Reason, until: int) -> Iterator[Message]:
        yield from self._land(reason, until)
        self._leg, self._number, self._test_point = None, leg.number, leg.test_point

    def _fail(self, leg: Leg, error: Exception) -> Iterator[Message]:
        """Tell of an error, and what is left of the leg; the next fix begins another."""
        self._arrivals.forget()
        text = f"the estimate of vehicle {self.vehicle}, boot {self.boot} failed and begins anew: {error}"
        yield self.event("error", text, leg.at, leg.at_rx)
        try:
            yield from leg.close("gap", leg.at)  # what was late after that counts in the next leg
            yield from leg.smooth()
        except (ValueError, ArithmeticError):
            pass  # told already: the window is lost
        yield from self._land("gap", leg.at_rx)
        self._leg, self._number, self._test_point = None, leg.number, leg.test_point

    @property
    def by(self) -> str:
        """Words for the estimator, if it is not the usual one."""
        return "" if self.settings.estimator == "ms" else f" ({self.settings.estimator})"

    def event(self, level: Level, text: str, t: int, t_rx: int) -> Event:
        """One event about this vehicle."""
        return event(text, level=level, vehicle=self.vehicle, source=STAGE, boot=self.boot, t=t, t_rx=t_rx)
