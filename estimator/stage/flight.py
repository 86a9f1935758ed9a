"""The flight path of one leg: looked for until it can begin, flown in stretches, told in windows and reports.

A stretch begins when the sensors allow an alignment and ends with a silence of the inertial sensors, when roll is no
longer known, or when the filter fails; the next one begins as soon as it can. Windows close at marks, after their
length, and with the stretch. Samples that came too late for the filter but into the open window are put in when it
closes: the window is filtered again, and the filter goes on from there. Over a whole sortie a stretch is smoothed when
it ends, once as the filter linearised it and then about the smoothed trajectory.
"""

from __future__ import annotations

import math
import re
from collections import deque
from collections.abc import Callable, Generator, Iterator
from functools import partial
from typing import TYPE_CHECKING

import msgspec
import numpy as np
from numpy.typing import NDArray

from estimator import alignment
from estimator.arrivals import Place
from estimator.drive import IMPACT, LONGEST_GAP, MEASURED, WIDTH, Driver, Samples, Steps
from estimator.models.flight_path import FlightPath
from estimator.stage.examining import Examiner
from estimator.stage.passage import Closed, Passage
from estimator.stage.report import Known, Sum, test_point_report
from estimator.stage.rows import AIR, GNSS, SENSORS
from estimator.stage.settings import Level, Reason
from estimator.stretch import Diverged, Filtered, Smoothed
from estimator.synchronise import MARK, Rows, Synchroniser, Watermark, concatenate, take
from telemetry.messages import Message

if TYPE_CHECKING:
    from estimator.stage.epoch import Epoch

Times = NDArray[np.int64]

S = 1_000_000_000
SLOT = 5 * S  # ns of arrivals, after which a delay of the fixes that has been found is taken off
ASK, RECENT = 6, 180 * S  # slots between two questions for the delay, and how far back they look, ns
TRY = S // 2  # ns between two attempts to begin
ASTRAY = "heading is no longer known to 25 deg"
PATIENCE = 5 * S  # ns of vain attempts before the reason is told
UNKNOWN_HEADING = math.radians(25.0)  # beyond it a filter begins to believe headings that nothing has measured
UNKNOWN_ROLL = math.radians(60.0)
DOUBTS = 6  # times that one stretch may be doubted
PAUSE, LONGEST_PAUSE = 2 * S, 120 * S  # ns from a stretch that failed to the next, twice as long after each failure
SOUND = 120 * S  # ns: a stretch that lasted so long was no failure of the sensors
ALL = 1 << 62
AIR_NOW = "air data have come, which it was begun without"


class Flight:
    """The flight path beside one leg of the trajectory.

    Parameters
    ----------
    epoch : Epoch
    origin : (float, float, float)
        Latitude, longitude (rad), altitude (m).
    test_point : str
        Under way when the leg begins; "" for none.
    """

    def __init__(self, epoch: Epoch, origin: Place, test_point: str) -> None:
        self.epoch, self.origin = epoch, origin
        self.settings = epoch.settings.flight_path
        self.test_point = test_point
        self._marks: list[tuple[str, str]] = []
        self._buffer: deque[tuple[Rows, int]] = deque()
        self._whole = epoch.scope == "sortie"
        self.examiner = Examiner(self.settings)
        self._delay: float | None = self.settings.gnss_delay
        self._slot: int | None = None
        self._synchroniser = self._synchronise(self._delay or 0.0)
        self._recent: list[Samples] = []
        self._models: dict[str, FlightPath] = {}
        self._tried = -(1 << 62)
        self._since: int | None = None
        self._told: set[str] = set()
        self._passage: Passage | None = None
        self._belated: list[tuple[Times, Rows]] = []  # late samples, and when they were noticed
        self._newest = -ALL
        self._last = (0, 0)  # times of the newest arrival
        self.heard = -ALL  # time that was reached when the newest window closed
        self._not_before, self._pause = -ALL, PAUSE
        self._flown = False  # whether a window has been closed
        self.sum = Sum()  # of what has been smoothed
        self._answer: Callable[[], float] | None = None  # the delay of the fixes, once it is found

    @property
    def at(self) -> tuple[int, int] | None:
        """Times of the newest step, ns; None where nothing is being flown."""
        return None if self._passage is None else self._passage.last

    @property
    def lag(self) -> int:
        """How long a sample waits now, ns."""
        return self._synchroniser.watermark.lag

    def _synchronise(self, delay: float) -> Synchroniser:
        self.delay = delay
        settings = self.epoch.settings
        lag = round((settings.lag + max(delay, self.settings.air_delay, 0.0)) * 1e9)
        least = None if settings.least_lag is None else round(settings.least_lag * 1e9)
        self._watermark = Watermark(len(SENSORS), lag, least)
        return Synchroniser(len(SENSORS), WIDTH, lag=lag, grid=1 << 60, least=least)

    # -- samples in ----------------------------------------------------------------------------------------------------

    def advance(self, samples: Rows, until: int) -> Iterator[Message]:
        """Take what was believed; the flight goes on as far as it is complete."""
        if self._whole and self._delay is None:  # the delay of the fixes first
            self.examiner.take(samples, np.full(len(samples.t), -ALL))
            self._buffer.append((samples, until))
            return
        if self._delay is not None:
            self._push(samples)
            yield from self._release(until, False)
            return
        if self._slot is not None and len(samples.t) and samples.t_rx[-1] // SLOT == self._slot:
            self._push(samples)  # in order of arrival: the others are no later
            yield from self._release(min(until, (self._slot + 1) * SLOT - 1), False)
            return
        # Live, the delay is asked for and taken off between two slots: the same ones, whatever the batches.
        slots = samples.t_rx // SLOT
        for slot in np.unique(slots).tolist():
            if self._slot is not None and slot > self._slot:
                yield from self._correct(slot * SLOT - 1)
                if slot // ASK != self._slot // ASK:
                    self._ask()
            self._slot = slot
            self._push(take(samples, slots == slot))
            yield from self._release(min(until, (slot + 1) * SLOT - 1), False)

    def _ask(self) -> None:
        """Ask the newest minutes for the delay of the satellite fixes; the answer has time until the next slot."""
        if not self.test_point and self._delay is None and self.examiner.fast():
            examiner, since = self.examiner.so_far(), self._newest - RECENT
            self._answer = self.epoch.beside.ask(lambda: examiner.delay(since))

    def _correct(self, until: int) -> Iterator[Message]:
        """Take the delay of the satellite fixes off from here on, if one has been found."""
        yield from self._release(until, False)
        answer, self._answer = self._answer, None
        delay = answer() if answer is not None else 0.0
        if not delay or self.test_point or self._delay is not None:
            return
        yield from self._release(until, True)
        why = f"satellite fixes are found to be {delay:.2f} s older than they say, which is taken off from here on"
        if self._passage is not None:
            yield from self._end(self._passage, why)
        else:
            yield self.epoch.event("info", why, *self._last)
        self._delay, self._recent = delay, []
        self._synchroniser = self._synchronise(delay)

    def finish(self, reason: Reason, until: int) -> Iterator[Message]:
        """Let everything out and close the last window."""
        if self._buffer:
            yield from self._replay()
        yield from self._release(until, True)
        yield from self._land(reason, ALL)
        if self._flown:
            known = Known(self.examiner.so_far(), ALL, self.delay)
            yield from self.epoch.beside.run(partial(self._total, known))
        elif self.examiner.fast():  # there could have been a path: perhaps a sensor is why there is none
            for finding in self.examiner.findings(-ALL, ALL, ALL, self.delay):
                yield self.epoch.event("warning", finding, *self._last)

    def _replay(self) -> Iterator[Message]:
        """Find the delay of the satellite fixes in everything there is, then fly."""
        self._synchroniser = self._synchronise(self.examiner.delay())
        while self._buffer:
            samples, covered = self._buffer.popleft()
            self._push(samples, seen=True)
            yield from self._release(covered, False)

    def _push(self, samples: Rows, *, seen: bool = False) -> None:
        is_mark, rest = samples.sensor == MARK, samples
        if is_mark.any():
            marks, rest = take(samples, is_mark), take(samples, ~is_mark)
            for t_mark, t_rx, number in zip(marks.t, marks.t_rx, marks.z[:, 0], strict=True):
                self._synchroniser.mark(int(t_mark), int(t_rx))
                self._marks.append(self.epoch.marks[int(number)])
        z, t = rest.z, rest.t
        fixes = rest.sensor == GNSS
        if fixes.any():
            z = z.copy()
            z[fixes, :3] = np.nan  # the place: not a specific force
        if self.delay or self.settings.air_delay:
            shift = np.where(fixes, round(self.delay * 1e9), 0)
            shift[rest.sensor == AIR] = round(self.settings.air_delay * 1e9)
            t = t - shift
        self._newest = max(self._newest, int(t.max(initial=-ALL)))
        passed = self._watermark.before(t, rest.sensor)  # as the synchroniser will say when they are released
        if not seen:
            self.examiner.take(rest, passed)
        if len(rest.t):
            self._last = int(rest.t[-1]), int(rest.t_rx[-1])
        self._synchroniser.push(rest._replace(t=t, z=z))

    def _release(self, until: int, final: bool) -> Iterator[Message]:
        steps = self._synchroniser.release(until, final)
        if not len(steps.t) and not steps.marks and steps.belated is None:
            return
        samples = Samples(steps.t, steps.t_rx, steps.z, steps.r)
        if steps.belated is not None:
            self._belated.append((np.array([t for t, _ in steps.late], np.int64), steps.belated))
        marks = list(steps.marks)
        first = 0
        while first < len(samples.t) or marks:
            stop = int(np.searchsorted(samples.t, marks[0][0], "right")) if marks else len(samples.t)
            stop = max(stop, first)
            yield from self._walk(samples.rows(slice(first, stop)))
            first = stop
            if marks:
                when, number = marks.pop(0)
                yield from self._mark(when, *self._marks[number])

    def _mark(self, when: int, action: str, name: str) -> Iterator[Message]:
        if (action == "stop") != (self.test_point == name):
            return  # stopped without having been started, or said twice: the trajectory tells it
        if self._passage is not None:
            yield from self._close("mark", when)
        self.test_point = name if action == "start" else ""
        if self._passage is not None and self._poorer(self._passage):
            yield from self._end(self._passage, AIR_NOW)
        if self._passage is not None:
            self._passage.open(self.test_point, when)

    # -- beginning -----------------------------------------------------------------------------------------------------

    def _walk(self, samples: Samples) -> Iterator[Message]:
        while len(samples.t):
            if self._passage is None:
                samples = yield from self._look(samples)
            if self._passage is not None and len(samples.t):
                samples = yield from self._fly(samples)

    def _look(self, samples: Samples) -> Generator[Message, None, Samples]:
        """Try to begin, twice a second; gives back the samples after the beginning."""
        slot = samples.t // TRY
        first = slot != np.concatenate([[self._tried], slot[:-1]])
        for i in np.flatnonzero(first & (samples.t >= self._not_before)).tolist():
            recent = self._lately(samples.rows(slice(i + 1)), 1)
            found = self._begin(recent)
            if isinstance(found, str):
                yield from self._explain(found, recent)
                continue
            now = recent.rows(slice(found.row + 1, None))  # after the inertial sample of the beginning
            flight, begin = self._model(recent), recent.rows(slice(found.row + 1))
            yield from self._take_off(flight, begin, found)
            self._recent, self._tried = [], int(slot[i])
            return Samples.join([now, samples.rows(slice(i + 1, None))])
        self._recent, self._tried = [self._lately(samples, 2)], int(slot[-1])
        return Samples.none()

    def _lately(self, samples: Samples, spans: int) -> Samples:
        """The samples, and those before them that an alignment looks at."""
        recent = Samples.join([*self._recent, samples])
        first = np.searchsorted(recent.t, recent.t[-1] - spans * round(alignment.SPAN * 1e9))
        return recent.rows(slice(int(first), None))

    def _model(self, recent: Samples) -> FlightPath:
        settings = self.settings
        if settings.mode == "auto":
            air = bool(np.isfinite(recent.z[:, (MEASURED, IMPACT)]).any())
            settings = msgspec.structs.replace(settings, mode="G" if air else "I")
        if settings.mode not in self._models:
            self._models[settings.mode] = FlightPath.of(settings, self.origin[0], self.origin[2])
        return self._models[settings.mode]

    def _begin(self, recent: Samples) -> alignment.Start | str:
        if self._since is None:
            self._since = int(recent.t[-1])
        return alignment.find(recent, self._model(recent), alignment.true_airspeed(recent))

    def _explain(self, reason: str, recent: Samples) -> Iterator[Message]:
        """Say why there is no flight path, once for each reason."""
        assert self._since is not None
        key = re.sub(r"[-\d.]+", "", reason)
        if recent.t[-1] - self._since < PATIENCE or key in self._told:
            return
        self._told.add(key)
        level = "warning" if self.epoch.settings.model == "flight_path" else "info"
        yield self.epoch.event(
            "warning" if level == "warning" else "info",
            f"no flight path yet, the trajectory model goes on alone: {reason}",
            int(recent.t[-1]),
            int(recent.t_rx[-1]),
        )

    def _take_off(self, flight: FlightPath, begin: Samples, found: alignment.Start) -> Iterator[Message]:
        t = int(begin.t[-1])
        stretch = self.epoch.estimator.begin(flight, found.values, found.sigma)
        if self.epoch.begun is not None:
            self.epoch.begun(stretch)
        driver = Driver(
            flight, t, begin.z[-1, :6].copy(), found.period, output=round(self.epoch.settings.output * 1e9),
            attitude_interval=round(flight.settings.attitude_interval * 1e9),
        )  # fmt: skip
        self._passage = Passage(self, flight, stretch, driver, t, int(begin.t_rx[-1]))
        self._passage.open(self.test_point, t)
        self._told.clear()
        yield self.epoch.event(
            "warning" if found.doubtful else "info",
            f"flight path{self.epoch.by}, mode {flight.settings.mode}, {flight.n} states: inertial samples at "
            f"{1 / found.period:.1f} Hz, {found.text}, satellite fixes taken as {self.delay:.2f} s old",
            t,
            int(begin.t_rx[-1]),
        )

    # -- flying --------------------------------------------------------------------------------------------------------

    def _fly(self, samples: Samples) -> Generator[Message, None, Samples]:
        """Filter the samples, closing windows by their length; gives back those after the end of the stretch."""
        passage = self._passage
        assert passage is not None
        settings = self.epoch.settings
        longest = round((settings.test_point if self.test_point else settings.window) * 1e9)
        stop = int(np.searchsorted(samples.t, passage.begin + longest, "right"))
        over = stop < len(samples.t)
        before = passage.driver.rest()
        steps = passage.push(samples.rows(slice(stop)))
        rest = samples.rows(slice(stop, None))
        if steps is not None:
            bad = yield from self._filter(passage, steps)
            if bad is not None:
                every = Samples.join([before, samples])
                remains = every.rows(slice(int(np.searchsorted(every.t, passage.last[0], "right")), None))
                yield from self._fail(passage, bad)
                return remains
        if passage.driver.gap is not None:
            remains = Samples.join([passage.driver.rest(), rest])
            yield from self._end(passage, f"more than {LONGEST_GAP:.0f} s without inertial samples")
            return remains
        if not over:
            return rest
        yield from self._close("length", int(rest.t[0]))
        if self._poorer(passage):
            remains = Samples.join([passage.driver.rest(), rest])
            yield from self._end(passage, AIR_NOW)
            return remains
        passage.open(self.test_point, passage.begin + longest)
        return rest

    def _poorer(self, passage: Passage) -> bool:
        """Whether the stretch was begun without air data, and now there are some."""
        return self.settings.mode == "auto" and passage.flight.settings.mode == "I" and passage.air()

    def _filter(self, passage: Passage, steps: Steps) -> Generator[Message, None, str | None]:
        """Filter steps and tell the estimates; gives back why the stretch ends, if it does."""
        point, why = passage.stretch.point(), None
        try:
            filtered = passage.stretch.advance(steps.drive)
            stop, why = self._trouble(passage, steps, filtered)
        except Diverged as error:
            stop, why = error.step, str(error)
        if why is not None:  # as if the steps after that had not come
            passage.stretch.rewind(point)
            if stop == 0:
                return why
            steps = steps.part(stop)
            filtered = passage.stretch.advance(steps.drive)
        message = passage.account(steps, filtered)
        if message is not None:
            yield message
        yield from passage.events(steps, filtered)
        return why

    def _trouble(self, passage: Passage, steps: Steps, filtered: Filtered) -> tuple[int, str | None]:
        """After how many of the steps the filter is lost, and why."""
        found: list[tuple[int, str]] = []
        doubts = passage.doubts + np.cumsum(filtered.doubted != 0)
        if len(doubts) and doubts[-1] >= DOUBTS:
            words = f"measurements contradicted the filter {DOUBTS} times: look at the sensors, and at their noise"
            found.append((int(np.searchsorted(doubts, DOUBTS)) + 1, words))
        roll, pitch = (passage.flight.names.index(name) for name in ("phi", "theta"))
        lost = (steps.drive.shown == 1) & (np.abs(filtered.mean[:, pitch]) < math.radians(80.0))
        near = lost.copy()
        lost[lost] = filtered.std[lost, roll] > UNKNOWN_ROLL
        if lost.any():
            found.append((int(np.argmax(lost)) + 1, "roll is no longer known to 60 deg"))
        if passage.flight.settings.mode != "P":
            astray = near.copy()
            astray[near] = filtered.std[near, passage.flight.names.index("psi")] > UNKNOWN_HEADING
            if astray.any():
                found.append((int(np.argmax(astray)) + 1, ASTRAY))
        return min(found) if found else (len(steps.t), None)

    def _fail(self, passage: Passage, why: str) -> Iterator[Message]:
        """End a stretch whose filter was lost; the next one waits the longer the sooner that happens."""
        if why == ASTRAY:  # no fault of the filter's: nothing has shown a heading
            yield from self._end(passage, why, level="info")
            return
        passage.failed = True
        sound = passage.last[0] - passage.first >= SOUND
        self._pause = PAUSE if sound else self._pause
        self._not_before = passage.last[0] + self._pause
        yield from self._end(passage, f"{why}; no other before {self._pause / S:.0f} s have passed", failed=True)
        self._pause = min(2 * self._pause, LONGEST_PAUSE)

    def _end(self, passage: Passage, why: str, *, failed: bool = False, level: Level = "warning") -> Iterator[Message]:
        """End the stretch; the next one begins when it can."""
        at, at_rx = passage.last
        yield self.epoch.event(level, f"the flight path ends and begins anew: {why}", at, at_rx)
        yield from self._land("gap", at, failed=failed)

    def _close(self, reason: Reason, when: int, *, failed: bool = False) -> Iterator[Message]:
        """Close the window of the stretch; ``when``: the time that was reached by then."""
        passage = self._passage
        assert passage is not None
        late = self._late(passage, when)
        if late is not None and not failed:
            yield from passage.roll_back(late)
        closed = passage.close(reason)
        if closed is None:
            return
        yield from passage.refused(closed)
        self.heard, self._flown = when, True
        if self._whole:
            return
        taken, known = passage.taken(), Known(self.examiner.so_far(), when, self.delay)
        passage.forget()
        yield from self.epoch.beside.run(partial(self._smooth, taken, closed, known))

    def _smooth(self, passage: Passage, window: Closed, known: Known) -> Iterator[Message]:
        """Smooth a window that has been taken from its passage."""
        try:
            yield from self._tell(passage, [window], passage.stretch.smooth(), known)
        except (ValueError, ArithmeticError) as error:
            text = f"window {window.number} of the flight path could not be smoothed, its estimates stand: {error}"
            yield self.epoch.event("error", text, *Sum.last(window))

    def _late(self, passage: Passage, when: int) -> Rows | None:
        """Late samples that were noticed up to `when` and belong into the open window; older ones are counted."""
        if not self._belated:
            return None
        noticed = np.concatenate([times for times, _ in self._belated])
        rows = concatenate([part for _, part in self._belated])
        begin = passage.opened
        now = noticed <= when
        older = now & (rows.t <= begin)
        passage.too_late(rows.sensor[older & (noticed > begin)])
        inside = now & (rows.t > begin) & (rows.t <= passage.last[0])
        rest = ~(older | inside)
        self._belated = [(noticed[rest], take(rows, rest))] if rest.any() else []
        return take(rows, inside) if inside.any() else None

    def _land(self, reason: Reason, when: int, *, failed: bool = False) -> Iterator[Message]:
        """Close the last window and, over a whole sortie, smooth the stretch."""
        passage = self._passage
        if passage is None:
            return
        self._since = None
        yield from self._close(reason, when, failed=failed)
        if self._whole and passage.closed:
            smoothed = passage.stretch.smooth()
            try:
                for i in range(self.epoch.settings.iterate):
                    last = i == self.epoch.settings.iterate - 1
                    smoothed = passage.stretch.hybrid(smoothed, std=last)
            except ArithmeticError as error:
                text = f"iterating the smoothed flight path failed, what it was before is told: {error}"
                yield self.epoch.event("warning", text, *passage.last)
            known = Known(self.examiner.so_far(), self.heard, self.delay)
            yield from self._tell(passage, passage.closed, smoothed, known)
        self._passage = None

    def _tell(self, passage: Passage, closed: list[Closed], smoothed: Smoothed, known: Known) -> Iterator[Message]:
        for window in closed:
            self.sum.add(passage, window, smoothed)
            yield passage.message(window, smoothed)
            if window.test_point:
                told: Message
                try:
                    told = test_point_report(self.epoch, passage, window, smoothed, known)
                except (ValueError, ArithmeticError) as error:
                    text = f"test point {window.test_point} is smoothed, but could not be reported: {error}"
                    told = self.epoch.event("error", text, *Sum.last(window))
                yield told

    def _total(self, known: Known) -> Iterator[Message]:
        """What the windows add up to, once they have been smoothed."""
        if self.sum.flight is None:
            return
        told: Message
        try:
            told = self.sum.report(self.epoch, known)
        except (ValueError, ArithmeticError) as error:
            text = f"the flight path is smoothed, but could not be reported as a whole: {error}"
            told = self.epoch.event("error", text, *self.sum.end)
        yield told
