"""Many rates, late and missing samples: one ordered sequence of steps.

Samples come in the order of their arrival, a little out of order in their own time. They wait until the newest time
seen is `lag` ahead of theirs, and leave in the order of that time; samples of one time make one step. A sample that
comes after its place has been passed is late: it is counted and kept aside. Where nothing was measured for longer than
`grid`, steps without a measurement are put in, so that the growth of uncertainty is seen and not
drawn over.

Everything is decided by the order of arrival alone, so the steps do not depend on how the stream was cut into batches.
"""

from __future__ import annotations

import copy
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimator.ud import compiled

Floats = NDArray[np.float64]
Times = NDArray[np.int64]

MARK = -1
MEMORY = 10_000_000_000  # ns of vehicle time in which the lateness of samples is looked for
LEARNING = 3_000_000_000  # ns at the beginning of which nothing is known yet
NEVER = np.iinfo(np.int64).max
LONGEST_SILENCE = 2000  # steps put into one silence at most; beyond that they lie further apart


class Rows(NamedTuple):
    """Samples: times t and t_rx (k,) in ns, sensor number (k,), values z (k, m) with NaN = missing, variances r (k,
    m).
    """

    t: Times
    t_rx: Times
    sensor: NDArray[np.int64]
    z: Floats
    r: Floats


class Steps(NamedTuple):
    """Released steps and what else happened on the way.

    Attributes
    ----------
    t, t_rx : int64 array, shape (k,)
        Strictly increasing time; arrival of the newest sample in the step (or, in a silence, of the sample that ended
        it).
    dt : float array, shape (k,)
        Time since the step before, s; 0 for the very first.
    silence : float array, shape (k,)
        Length of the interval between measurements that the step lies in or ends, s.
    silent : bool array, shape (k,)
        A step put in because nothing was measured.
    z, r : float array, shape (k, m)
    used : int64 array, shape (k, sensors)
        Samples of each sensor in the step (0 or 1).
    marks : list of (int, int)
        Time and number of released marks.
    late : list of (int, int)
        Time at which a late sample was noticed and its sensor.
    belated : Rows or None
        The late samples themselves, in the order of `late`.
    """

    t: Times
    t_rx: Times
    dt: Floats
    silence: Floats
    silent: NDArray[np.bool_]
    z: Floats
    r: Floats
    used: NDArray[np.int64]
    marks: list[tuple[int, int]]
    late: list[tuple[int, int]]
    belated: Rows | None = None

    def cut(self, first: int, last: int) -> Steps:
        """The steps from `first` to before `last`, without marks and late samples."""
        rows = slice(first, last)
        return Steps(
            self.t[rows], self.t_rx[rows], self.dt[rows], self.silence[rows], self.silent[rows], self.z[rows],
            self.r[rows], self.used[rows], marks=[], late=[],
        )  # fmt: skip


class Watermark:
    """The time that has been passed and is no longer waited for: the newest time seen, less the lag.

    With `least` given the lag follows the samples: it is a little more than the most by which one of them came behind
    the newest time in the last `MEMORY` to twice that, between `least` and `lag`. For the first `LEARNING` it is
    `lag`. Time passed never goes back.

    Parameters
    ----------
    sensors : int
        Samples with a number from here on are not waited for, but time passes with them.
    lag : int
        ns.
    least : int, optional
        ns; the lag is fixed if not given.
    """

    def __init__(self, sensors: int, lag: int, least: int | None = None) -> None:
        self._sensors, self._lag, self._least = sensors, lag, lag if least is None else min(least, lag)
        never = np.iinfo(np.int64).min // 2
        self._state = np.array([never, never, never, lag, lag])  # newest, passed, begin of the memory, two maxima

    @property
    def passed(self) -> int:
        """Time that has been passed, ns."""
        return int(self._state[1])

    @property
    def lag(self) -> int:
        """How long a sample waits now, ns."""
        return int(self._state[0] - self._state[1])

    def copy(self) -> Watermark:
        """The same, to go on by itself."""
        other = copy.copy(self)
        other._state = self._state.copy()
        return other

    def before(self, t: Times, sensor: NDArray[np.int64]) -> Times:
        """Take arrivals, in order; for each, the time that had been passed when it came."""
        out = np.empty(len(t), np.int64)
        _pass(t, sensor, self._sensors, self._lag, self._least, self._state, out)
        return out

    def row(self, t: Times, sensor: NDArray[np.int64], time: int) -> int:
        """Take arrivals; the row by whose arrival `time` was passed, or their number."""
        passed = self.before(t, sensor)
        return int(np.searchsorted(np.append(passed[1:], self._state[1])[: len(t)], time))


class Synchroniser:
    """Orders the samples of one vehicle in one boot epoch.

    Parameters
    ----------
    sensors, m : int
        Number of sensors; length of z. Samples with a higher number make no steps, but time passes with them.
    lag, grid : int
        ns.
    least : int, optional
        As `Watermark`.
    """

    def __init__(self, sensors: int, m: int, *, lag: int, grid: int, least: int | None = None) -> None:
        self._sensors, self._m, self._grid = sensors, m, grid
        self._arrived: list[Rows] = []
        self._waiting = self._empty()
        self.watermark = Watermark(sensors, lag, least)
        self._last: int | None = None
        self._marks: list[int] = []

    def _empty(self) -> Rows:
        none = np.empty(0, np.int64)
        return Rows(none, none, none, np.empty((0, self._m)), np.empty((0, self._m)))

    def push(self, rows: Rows) -> None:
        """Take samples in, in any order within what `release` has not yet been told of."""
        self._arrived.append(rows)

    def mark(self, t: int, t_rx: int) -> int:
        """Take a mark in, which is ordered like a sample but is never late and makes none late; returns its number."""
        self._marks.append(t)
        number = len(self._marks) - 1
        nothing = np.full((1, self._m), np.nan)
        nothing[0, 0] = number  # carried through the ordering in place of a value
        self._arrived.append(Rows(np.array([t]), np.array([t_rx]), np.array([MARK]), nothing, np.ones((1, self._m))))
        return number

    def release(self, until: int, final: bool = False) -> Steps:
        """The steps that are complete, given that every sample with ``t_rx <= until`` has been pushed.

        Parameters
        ----------
        until : int
            ns.
        final : bool
            Nothing more will come: everything leaves.
        """
        late: list[tuple[int, int]] = []
        belated = None
        if self._arrived:
            rows = concatenate(self._arrived)
            covered = rows.t_rx <= until
            whole = bool(covered.all())
            self._arrived = [] if whole else [take(rows, ~covered)]
            rows = in_order(rows if whole else take(rows, covered))
            passed = self.watermark.before(rows.t, rows.sensor)
            time, keep = np.empty(len(rows.t), np.int64), np.empty(len(rows.t), np.bool_)
            kept, missed = _sift(rows.t, rows.sensor, self._sensors, passed, time, keep)
            if missed:
                which = np.flatnonzero(~keep & (rows.sensor < self._sensors))
                late = [(int(passed[i]) + 1, int(rows.sensor[i])) for i in which]
                belated = take(rows, which)
            if kept:
                new = rows._replace(t=time) if kept == len(keep) else take(rows._replace(t=time), keep)
                self._waiting = concatenate([self._waiting, new]) if len(self._waiting.t) else new
        waiting = self._waiting
        ready = np.ones(len(waiting.t), np.bool_)
        count = len(ready) if final else _ready(waiting.t, waiting.sensor, self.watermark.passed, ready)
        if count == 0:
            return self._steps(self._empty(), late)._replace(belated=belated) if late else self._nothing()
        if count < len(ready):
            self._waiting, waiting = take(waiting, ~ready), take(waiting, ready)
        else:
            self._waiting = self._empty()
        return self._steps(waiting, late)._replace(belated=belated)

    @property
    def oldest(self) -> int:
        """The least time that waits, ns; `NEVER` where nothing does."""
        return int(self._waiting.t.min(initial=NEVER))

    def _nothing(self) -> Steps:
        none = self._empty()
        seconds = np.empty(0)
        used = np.empty((0, self._sensors), np.int64)
        return Steps(none.t, none.t, seconds, seconds, np.empty(0, np.bool_), none.z, none.r, used, [], [])

    def _steps(self, rows: Rows, late: list[tuple[int, int]]) -> Steps:
        is_mark = rows.sensor == MARK
        marks: list[tuple[int, int]] = []
        if is_mark.any():
            marks = sorted((int(t), int(number)) for t, number in zip(rows.t[is_mark], rows.z[is_mark, 0], strict=True))
            rows = take(rows, ~is_mark)
        order = np.lexsort((rows.t_rx, rows.sensor, rows.t))
        k, m = len(order), self._m
        t, t_rx, used = np.empty(k, np.int64), np.empty(k, np.int64), np.zeros((k, self._sensors), np.int64)
        z, r = np.full((k, m), np.nan), np.ones((k, m))
        count = _merge(order, *rows, t, t_rx, z, r, used)
        nothing = np.zeros(count)
        times = t[:count], t_rx[:count], nothing, nothing, np.zeros(count, np.bool_)
        return self._fill(Steps(*times, z[:count], r[:count], used[:count], marks, late))

    def _fill(self, steps: Steps) -> Steps:
        """Put steps into the silences, and the intervals between all."""
        if len(steps.t) == 0:
            return steps
        before = np.concatenate([[steps.t[0] if self._last is None else self._last], steps.t[:-1]])
        self._last = int(steps.t[-1])
        gap = steps.t - before
        silence = gap * 1e-9
        if int(gap.max()) <= self._grid:
            return steps._replace(dt=silence, silence=silence)
        wanted = np.maximum(-(-gap // self._grid) - 1, 0)
        extra = np.minimum(wanted, LONGEST_SILENCE)
        if extra.any():
            index = np.repeat(np.arange(len(steps.t)), extra + 1)
            position = np.arange(len(index)) - np.repeat(np.cumsum(extra + 1) - (extra + 1), extra + 1) + 1
            silent = position <= extra[index]
            spacing = np.where(wanted > extra, gap // (extra + 1), self._grid)
            t = np.where(silent, before[index] + position * spacing[index], steps.t[index])
            z, r, used = steps.z[index], steps.r[index], steps.used[index]
            z[silent], r[silent], used[silent] = np.nan, 1.0, 0
            silence = silence[index]
            steps = steps._replace(t=t, t_rx=steps.t_rx[index], silent=silent, z=z, r=r, used=used)
        dt = np.diff(steps.t, prepend=before[0]) * 1e-9
        return steps._replace(dt=dt, silence=silence)


@compiled
def _pass(
    t: Times, sensor: NDArray[np.int64], sensors: int, lag: int, least: int, state: NDArray[np.int64], out: Times
) -> None:
    newest, passed, begin, now, before = state[0], state[1], state[2], state[3], state[4]
    for i in range(t.size):
        out[i] = passed
        if sensor[i] == MARK:  # says nothing about what has been measured
            continue
        if t[i] > newest:
            newest = t[i]
            if newest - begin >= MEMORY:
                first = begin < -MEMORY
                before, now, begin = (lag if first else now), 0, newest - (MEMORY - LEARNING if first else 0)
        elif sensor[i] < sensors:
            now = max(now, newest - t[i])
        most = max(now, before)
        passed = max(passed, newest - (lag if least == lag else min(lag, max(least, most + most // 4 + least))))
    state[0], state[1], state[2], state[3], state[4] = newest, passed, begin, now, before


@compiled
def _sift(
    t: Times, sensor: NDArray[np.int64], sensors: int, passed: Times, time: Times, keep: NDArray[np.bool_]
) -> tuple[int, int]:
    """Times of the rows that are kept, a mark's moved up to what has been passed; how many are kept, and late."""
    kept, missed = 0, 0
    for i in range(t.size):
        late = t[i] <= passed[i]
        keep[i] = sensor[i] == MARK or (sensor[i] < sensors and not late)
        kept += keep[i]
        missed += late and 0 <= sensor[i] < sensors
        time[i] = passed[i] + 1 if late else t[i]
    return kept, missed


@compiled
def _ready(t: Times, sensor: NDArray[np.int64], passed: int, ready: NDArray[np.bool_]) -> int:
    """Which rows leave; a mark with the next sample, so that the steps of a silence stand on their side of it."""
    last, count = np.iinfo(np.int64).min, 0
    for i in range(t.size):
        ready[i] = t[i] <= passed
        if ready[i] and sensor[i] != MARK:
            last = max(last, t[i])
    for i in range(t.size):
        if sensor[i] == MARK and t[i] > last:
            ready[i] = False
        count += ready[i]
    return count


@compiled
def _merge(
    order: NDArray[np.intp], t: Times, t_rx: Times, sensor: NDArray[np.int64], z: Floats, r: Floats, t_out: Times,
    rx_out: Times, z_out: Floats, r_out: Floats, used: NDArray[np.int64],
) -> int:  # fmt: skip
    """Rows in order of time, sensor and arrival to steps; how many. Of two at one time the first to arrive counts."""
    k = -1
    for i in order:
        if k < 0 or t[i] != t_out[k]:
            k += 1
            t_out[k], rx_out[k] = t[i], t_rx[i]
        rx_out[k] = max(rx_out[k], t_rx[i])
        if used[k, sensor[i]]:
            continue
        used[k, sensor[i]] = 1
        for c in range(z.shape[1]):
            if not np.isnan(z[i, c]):
                z_out[k, c], r_out[k, c] = z[i, c], r[i, c]
    return k + 1


@compiled
def _is_sorted(t_rx: Times, t: Times, sensor: NDArray[np.int64]) -> bool:
    for i in range(1, t.size):
        if t_rx[i] < t_rx[i - 1]:
            return False
        if t_rx[i] == t_rx[i - 1] and (t[i] < t[i - 1] or (t[i] == t[i - 1] and sensor[i] < sensor[i - 1])):
            return False
    return True


def in_order(rows: Rows) -> Rows:
    """The rows in the order of their arrival; at one time of arrival in that of their own time, then of the sensors."""
    if _is_sorted(rows.t_rx, rows.t, rows.sensor):
        return rows
    return take(rows, np.lexsort((rows.sensor, rows.t, rows.t_rx)))


def take(rows: Rows, which: NDArray[np.bool_] | NDArray[np.int64]) -> Rows:
    """Some of the rows."""
    return Rows(rows.t[which], rows.t_rx[which], rows.sensor[which], rows.z[which], rows.r[which])


def concatenate(parts: list[Rows]) -> Rows:
    """All rows, one part after the other."""
    return parts[-1] if len(parts) == 1 else Rows(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))
