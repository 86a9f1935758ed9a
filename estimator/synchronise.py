"""Many rates, late and missing samples: one ordered sequence of steps.

Samples come in the order of their arrival, a little out of order in their own time. They wait until the newest time
seen is `lag` ahead of theirs, and leave in the order of that time; samples of one time make one step. A sample that
comes after its place has been passed is late: it is counted and kept aside. Where nothing was measured for longer than
`grid`, steps without a measurement are put in, so that the growth of uncertainty is seen and not
drawn over.

Everything is decided by the order of arrival alone, so the steps do not depend on how the stream was cut into batches.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Times = NDArray[np.int64]

MARK = -1
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


class Synchroniser:
    """Orders the samples of one vehicle in one boot epoch.

    Parameters
    ----------
    sensors, m : int
        Number of sensors; length of z.
    lag, grid : int
        ns.
    """

    def __init__(self, sensors: int, m: int, *, lag: int, grid: int) -> None:
        self._sensors, self._m, self._lag, self._grid = sensors, m, lag, grid
        self._arrived: list[Rows] = []
        self._waiting = self._empty()
        self._newest = np.iinfo(np.int64).min // 2
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
        rows = concatenate([self._empty(), *self._arrived])
        covered = rows.t_rx <= until
        self._arrived = [] if covered.all() else [take(rows, ~covered)]
        rows = take(rows, covered)
        rows = take(rows, np.lexsort((rows.sensor, rows.t, rows.t_rx)))

        is_mark = rows.sensor == MARK
        seen = np.where(is_mark, self._newest, rows.t)  # a mark says nothing about what has been measured
        newest = np.maximum.accumulate(np.concatenate([[self._newest], seen]))
        passed = newest[:-1] - self._lag
        is_late = rows.t <= passed
        missed = np.flatnonzero(is_late & ~is_mark)
        late = [(int(passed[i]) + 1, int(rows.sensor[i])) for i in missed]
        belated = take(rows, missed) if len(missed) else None
        time = np.where(is_late & is_mark, passed + 1, rows.t)
        self._newest = int(newest[-1])

        keep = ~is_late | is_mark
        waiting = concatenate([self._waiting, take(rows._replace(t=time), keep)])
        ready = np.ones(len(waiting.t), np.bool_) if final else waiting.t <= self._newest - self._lag
        if not final:  # a mark leaves with the next sample, so that the steps of a silence stand on their side of it
            last = waiting.t[ready & (waiting.sensor != MARK)].max(initial=np.iinfo(np.int64).min)
            ready &= (waiting.sensor != MARK) | (waiting.t <= last)
        self._waiting = take(waiting, ~ready)
        return self._steps(take(waiting, ready), late)._replace(belated=belated)

    def _steps(self, rows: Rows, late: list[tuple[int, int]]) -> Steps:
        is_mark = rows.sensor == MARK
        marks = sorted((int(t), int(number)) for t, number in zip(rows.t[is_mark], rows.z[is_mark, 0], strict=True))
        rows = take(rows, ~is_mark)
        rows = take(rows, np.lexsort((rows.t_rx, rows.sensor, rows.t)))
        t, place = np.unique(rows.t, return_inverse=True)
        k = len(t)
        z, r = np.full((k, self._m), np.nan), np.ones((k, self._m))
        used = np.zeros((k, self._sensors), np.int64)
        t_rx = np.zeros(k, np.int64)
        np.maximum.at(t_rx, place, rows.t_rx)
        for i in range(self._sensors):
            mine = np.flatnonzero(rows.sensor == i)
            where, first = np.unique(place[mine], return_index=True)  # of two at one time the first to arrive counts
            mine = mine[first]
            measured = ~np.isnan(rows.z[mine])
            at, column = np.nonzero(measured)
            z[where[at], column] = rows.z[mine[at], column]
            r[where[at], column] = rows.r[mine[at], column]
            used[where, i] = 1
        return self._fill(Steps(t, t_rx, np.zeros(k), np.zeros(k), np.zeros(k, np.bool_), z, r, used, marks, late))

    def _fill(self, steps: Steps) -> Steps:
        """Put steps into the silences, and the intervals between all."""
        if len(steps.t) == 0:
            return steps
        before = np.concatenate([[steps.t[0] if self._last is None else self._last], steps.t[:-1]])
        self._last = int(steps.t[-1])
        gap = steps.t - before
        silence = gap * 1e-9
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


def take(rows: Rows, which: NDArray[np.bool_] | NDArray[np.int64]) -> Rows:
    """Some of the rows."""
    return Rows(rows.t[which], rows.t_rx[which], rows.sensor[which], rows.z[which], rows.r[which])


def concatenate(parts: list[Rows]) -> Rows:
    """All rows, one part after the other."""
    return parts[-1] if len(parts) == 1 else Rows(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))
