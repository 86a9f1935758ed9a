"""Arrivals: which samples to believe, and where a leg of the estimate begins and ends.

A leg is a stretch of one boot epoch with one clock and one origin: it begins with a satellite fix and lasts until the
clock steps, a silence is too long to be bridged, or the vehicle is too far away for a plane.

A vehicle's clock may leap. Such a time counts only when the arrivals that follow confirm it: one for a time ahead, more
for one behind, because a burst of old samples is nothing special. Until then nothing behind it is judged. What nobody
confirms is left out (ahead) or goes on as an ordinary late sample (behind).

Everything is decided by the order of arrival alone, so it does not depend on how the stream was cut into batches.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimator.geodesy import to_earth
from estimator.synchronise import MARK, Rows, Times, Watermark, concatenate, in_order, take
from estimator.ud import compiled

S = 1_000_000_000
LEAP = 10 * S  # further ahead of the newest time than this is to be confirmed; so far apart the confirming ones may be
LATE = 1 * S  # further behind the oldest time that is still waited for than this is perhaps a step of the clock
AHEAD, BEHIND = 2, 10  # arrivals that make a leap and a step back
SILENCE = 600 * S  # a longer one is not bridged
FAR = 300e3  # m from the origin

Place = tuple[float, float, float]  # latitude, longitude (rad), altitude (m)


class Note(NamedTuple):
    """What should be told, the times it is told for, and the row it is about."""

    text: str
    t: int
    t_rx: int
    row: int


class Piece(NamedTuple):
    """A stretch of arrivals.

    Attributes
    ----------
    origin : Place or None
        A new leg begins with this piece, at this place; None: it belongs to the leg before.
    rows : Rows
        What is to be believed, beginning with marks that waited for a leg.
    over : bool
        The leg ends with it.
    rest : Rows
        What remains to be judged.
    notes : list of Note
    judged : Rows
    places : int array
        Where in `judged` each of `rows` was; -1 for a mark that waited.
    """

    origin: Place | None
    rows: Rows
    over: bool
    rest: Rows
    notes: list[Note]
    judged: Rows
    places: NDArray[np.int64]

    def row(self, watermark: Watermark, t: int) -> int:
        """The row judged by whose arrival the time `t` was passed, given what had been passed before."""
        reached = self.places[watermark.row(self.rows.t, self.rows.sensor, t) :]
        return int(reached[0]) if len(reached) else len(self.judged.t)


class Arrivals:
    """The samples of one vehicle in one boot epoch, as they arrive.

    Rows hold the values as the sensors state them. Those of the sensor `fix` begin with latitude, longitude (rad) and
    altitude (m).

    Parameters
    ----------
    sensors : tuple of str
        Their names.
    fix : int
        Number of the sensor that gives places.
    lag : int
        How long a sample waits for older ones, ns.
    witnesses : int, optional
        How many of the sensors, the first ones, can confirm a leap: not the fast ones, whose bursts are long. All if
        not given.
    """

    def __init__(self, sensors: tuple[str, ...], fix: int, *, lag: int, witnesses: int | None = None) -> None:
        self._sensors, self._fix, self._late = sensors, fix, lag + LATE
        self._witnesses = len(sensors) if witnesses is None else witnesses
        self._waiting: list[Rows] = []
        self._early: list[Rows] = []  # marks before the first fix of a leg
        self._origin: tuple[float, ...] | None = None  # Earth-fixed
        self._newest = 0
        self._far = False  # the fix before was too far away
        self._nowhere = False  # fixes at (0, 0) have been told in this leg

    def push(self, rows: Rows) -> None:
        """Take arrivals in; nothing is judged before its receive time has been covered."""
        self._waiting.append(rows)

    def covered(self, until: int) -> Rows | None:
        """What has arrived up to `until` and is to be judged now, in order."""
        if not self._waiting:
            return None
        rows = concatenate(self._waiting)
        now = rows.t_rx <= until
        if now.all():
            self._waiting = []
        else:
            self._waiting, rows = [take(rows, ~now)], take(rows, now)
        return in_order(rows)

    def forget(self) -> None:
        """End the leg: the next fix begins another."""
        self._origin, self._nowhere = None, False

    def judge(self, rows: Rows, final: bool) -> Piece:
        """Judge arrivals up to the end of a leg; with `final`, nothing will come that could confirm anything."""
        notes: list[Note] = []
        place, first = None, 0
        if self._origin is None:
            found = self._found(rows, notes)
            marks = np.flatnonzero(rows.sensor[:found] == MARK)
            self._early += [take(rows, marks)] if len(marks) else []
            if found == len(rows.t):
                nothing = take(rows, marks[:0])
                return Piece(None, nothing, False, nothing, notes, rows, marks[:0])
            latitude, longitude, altitude = (float(x) for x in rows.z[found, :3])
            place, first = (latitude, longitude, altitude), found
            self._origin = tuple(to_earth(rows.z[found, 0], rows.z[found, 1], rows.z[found, 2]).tolist())
            self._newest, self._far = int(rows.t[found]), False
        elif (plain := self._all_plain(rows)) is not None:
            return Piece(None, rows, False, take(rows, plain[:0]), notes, rows, plain)
        index, times, end, over = self._walk(rows, first, final, notes)
        if over:
            self.forget()
        elif end < len(rows.t):  # undecided
            self._waiting.insert(0, take(rows, np.arange(end, len(rows.t))))
            rows = take(rows, np.arange(end))
        believed = take(rows, index)._replace(t=times)
        if place is not None and self._early:
            early, self._early = concatenate(self._early), []
            believed, index = concatenate([early, believed]), np.concatenate([np.full(len(early.t), -1), index])
        judged, rest = take(rows, np.arange(end)), take(rows, np.arange(end, len(rows.t)))
        return Piece(place, believed, over, rest, notes, judged, index)

    def _all_plain(self, rows: Rows) -> NDArray[np.int64] | None:
        """The indices of all rows where nothing about any of them is odd, as is the rule; else None."""
        newest = _plain_until(rows.t, rows.sensor, self._newest, self._late)
        if newest < self._newest:
            return None
        fixes = np.flatnonzero(rows.sensor == self._fix)
        if len(fixes):
            places = rows.z[fixes, :3]
            if not np.isfinite(places).all() or ((places[:, 0] == 0) & (places[:, 1] == 0)).any():
                return None
            earth = to_earth(places[:, 0], places[:, 1], places[:, 2])
            assert self._origin is not None
            if (np.linalg.norm(earth - self._origin, axis=1) > FAR).any():
                return None
            self._far = False
        self._newest = newest
        return np.arange(len(rows.t))

    def _found(self, rows: Rows, notes: list[Note]) -> int:
        """Index of the first fix, or the number of rows."""
        for i in np.flatnonzero(rows.sensor == self._fix).tolist():
            if np.isfinite(rows.z[i, :3]).all() and not self._is_nowhere(rows, i, notes):
                return int(i)
        return len(rows.t)

    def _is_nowhere(self, rows: Rows, i: int, notes: list[Note]) -> bool:
        nowhere = rows.z[i, 0] == 0 and rows.z[i, 1] == 0
        if nowhere and not self._nowhere:
            self._nowhere = True
            notes.append(_note(rows, i, "fixes at latitude 0, longitude 0 are none: left out"))
        return bool(nowhere)

    def _walk(
        self, rows: Rows, first: int, final: bool, notes: list[Note]
    ) -> tuple[NDArray[np.int64], NDArray[np.int64], int, bool]:
        """Indices and times of the rows to be believed, the index of the first row not judged, and whether the leg
        ends there.
        """
        fixed = (rows.sensor == self._fix) & np.isfinite(rows.z[:, :3]).all(axis=1)
        earth = np.zeros((len(rows.t), 3))
        earth[fixed] = to_earth(rows.z[fixed, 0], rows.z[fixed, 1], rows.z[fixed, 2])
        plain = self._plain(rows, first, fixed, earth)
        begin = np.arange(first, plain)
        if plain == len(rows.t):
            return begin, rows.t[begin], plain, False
        kept, end, over = self._judge_each(rows, plain, final, notes, fixed, earth)
        index, times = np.array(list(kept), np.int64), np.array(list(kept.values()), np.int64)
        return np.concatenate([begin, index]), np.concatenate([rows.t[begin], times]), end, over

    def _plain(self, rows: Rows, first: int, fixed: NDArray[np.bool_], earth: NDArray[np.float64]) -> int:
        """Index of the first row from `first` on that is not plainly to be believed; those before it are."""
        assert self._origin is not None
        t, mark = rows.t[first:], rows.sensor[first:] == MARK
        seen = np.where(mark, np.iinfo(np.int64).min, t)
        newest = np.maximum.accumulate(np.concatenate([[self._newest], seen]))
        odd = (t > newest[:-1] + LEAP) | (~mark & (t < newest[:-1] - self._late))
        at = fixed[first:]
        odd[at] |= np.linalg.norm(earth[first:][at] - self._origin, axis=1) > FAR
        odd[at] |= (rows.z[first:][at, 0] == 0) & (rows.z[first:][at, 1] == 0)
        count = int(np.argmax(odd)) if odd.any() else len(t)
        self._newest = int(newest[count])
        self._far = self._far and not at[:count].any()
        return first + count

    def _judge_each(
        self,
        rows: Rows,
        first: int,
        final: bool,
        notes: list[Note],
        fixed: NDArray[np.bool_],
        earth: NDArray[np.float64],
    ) -> tuple[dict[int, int], int, bool]:
        """Times of the rows from `first` on that are to be believed, by their index; the rest as `_walk`."""
        times, sensors = rows.t.tolist(), rows.sensor.tolist()
        kept: dict[int, int] = {}
        for i in range(first, len(times)):
            t, sensor = times[i], sensors[i]
            ahead = t > self._newest + LEAP
            if sensor == MARK:
                kept[i] = self._newest if ahead else t
                continue
            if ahead or t < self._newest - self._late:
                confirmed = self._confirmed(times, sensors, i)
                if confirmed is None and not final:
                    return kept, i, False
                by = abs(t - self._newest) / S
                if confirmed and not ahead:
                    text = f"the vehicle clock stepped back by {by:.1f} s: the estimate begins anew"
                    notes.append(_note(rows, i, text))
                    return kept, i, True
                if confirmed and t > self._newest + SILENCE:
                    notes.append(_note(rows, i, f"{by:.0f} s without a measurement: the estimate begins anew"))
                    return kept, i, True
                if ahead and not confirmed:
                    name = self._sensors[sensor]
                    text = f"a sample of {name} {by:.0f} s ahead of the others was left out"
                    notes.append(_note(rows, i, text)._replace(t=self._newest))
                    continue
            if fixed[i]:
                assert self._origin is not None
                distance = math.dist(earth[i].tolist(), self._origin)
                if self._is_nowhere(rows, i, notes):
                    continue
                if distance > FAR:
                    away = f"a fix {distance / 1e3:.0f} km from the origin"
                    if self._far:
                        notes.append(_note(rows, i, f"{away} again: the estimate begins anew there"))
                        return kept, i, True
                    self._far = True
                    notes.append(_note(rows, i, f"{away} was left out"))
                    continue
                self._far = False
            kept[i] = t
            self._newest = max(self._newest, t)
        return kept, len(times), False

    def _confirmed(self, times: list[int], sensors: list[int], i: int) -> bool | None:
        """Whether the arrivals after i confirm its time; None when that cannot be said yet."""
        ahead = times[i] > self._newest
        missing, last = (AHEAD if ahead else BEHIND) - (sensors[i] < self._witnesses), times[i]
        for j in range(i + 1, len(times)):
            if sensors[j] == MARK or sensors[j] >= self._witnesses:
                continue
            t = times[j]
            elsewhere = t > self._newest + LEAP if ahead else t < self._newest - self._late
            if not elsewhere or abs(t - last) > LEAP:
                return False
            missing, last = missing - 1, t
            if missing == 0:
                return True
        return None


@compiled
def _plain_until(t: Times, sensor: NDArray[np.int64], newest: int, late: int) -> int:
    """The newest time after all rows where none of them is a leap; less than `newest` where one is."""
    now = newest
    for i in range(t.size):
        if t[i] > now + LEAP or (sensor[i] != MARK and t[i] < now - late):
            return newest - 1
        if sensor[i] != MARK:
            now = max(now, t[i])
    return now


def _note(rows: Rows, i: int, text: str) -> Note:
    return Note(text, int(rows.t[i]), int(rows.t_rx[i]), i)
