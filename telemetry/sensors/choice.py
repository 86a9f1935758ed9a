"""Which of the streams that measure the same is used.

Streams of one kind are ordered: what the settings ask for, then the closest to the instrument, then the autopilot's
own, then the lower instance, then the first heard. The first in this order that is heard is used. When it has been
silent for `PATIENCE` the next takes over, and it comes back only after it has been heard for as long again, so that a
stream that comes and goes does not make the choice flap; only a stream that has never been heard before takes over at
once. A silence of all of them says nothing about one: only while others are heard does the time count, of a gap
between any two rows at most `GAP`. The same rule says which of several messages speaks for one instrument: the others
say the same from further away, and are not used at all.

Everything is decided row by row in the order of arrival, so it does not depend on how the stream was cut.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

PATIENCE = 5_000_000_000  # ns
GAP = 1_000_000_000  # ns
MOST = 64  # streams of one kind
NEVER = -(1 << 62)
NOBODY = -1

FIRST, SILENT, BETTER, BACK = range(4)
"""Why a stream was chosen: nobody was before, the one before fell silent, it is better and new, it is back."""

Rank = tuple[bool, int, bool, int]
"""Not asked for, distance from the instrument, not the autopilot's, instance."""


class Change(NamedTuple):
    """Another stream is used from a row on.

    Parameters
    ----------
    row : int
        Of those given.
    before, after : int
        Streams; `before` is `NOBODY` at first.
    why : int
    silence : float
        How long the one before has been silent, s.
    """

    row: int
    before: int
    after: int
    why: int
    silence: float


class Choice:
    """The streams of one kind of sensor of one vehicle."""

    def __init__(self) -> None:
        self._ranks: list[Rank] = []
        self._instruments: dict[object, int] = {}
        self._instrument = np.empty(0, np.int64)
        self._order = np.empty(0, np.int64)
        self._last = np.empty((0, 2), np.int64)  # when each was last heard: by the time that counts, and t_rx
        self._since = np.empty(0, np.int64)  # since when, after a silence, by the time that counts
        self._holder = np.array([NOBODY], np.int64)  # of the kind, then of every instrument
        self._clock = np.array([0, NEVER], np.int64)  # the time that counts, and t_rx, of the last row of any

    def __len__(self) -> int:
        return len(self._ranks)

    def add(self, rank: Rank, instrument: object) -> int:
        """A stream that is heard for the first time; of equal rank, the first added goes first."""
        if instrument not in self._instruments:
            self._instruments[instrument] = len(self._instruments)
            self._holder = np.append(self._holder, NOBODY)
        self._ranks.append(rank)
        self._instrument = np.append(self._instrument, self._instruments[instrument])
        self._last = np.concatenate([self._last, np.full((1, 2), NEVER)])
        self._since = np.append(self._since, NEVER)
        order = sorted(range(len(self._ranks)), key=self._ranks.__getitem__)
        self._order = np.argsort(np.array(order))
        return len(self._ranks) - 1

    def only(self, stream: int, t_rx: NDArray[np.int64]) -> bool:
        """Whether one stream, of which alone rows have come at `t_rx`, is used already and so stays in use."""
        if self._holder[0] != stream or self._holder[1 + self._instrument[stream]] != stream:
            return False
        clock, before = self._clock.tolist()
        clock += min(int(t_rx[0]) - before, GAP)
        if len(t_rx) > 1:
            clock += int(np.minimum(t_rx[1:] - t_rx[:-1], GAP).sum())
        self._clock[:] = self._last[stream] = clock, t_rx[-1]
        return True

    def choose(self, streams: NDArray[np.int64], t_rx: NDArray[np.int64]) -> tuple[NDArray[np.int8], list[Change]]:
        """Judge rows.

        Parameters
        ----------
        streams : int64 array, shape (k,)
            Of which stream each row is.
        t_rx : int64 array, shape (k,)
            When it came, ns, not decreasing.

        Returns
        -------
        use : int8 array, shape (k,)
            2 of the stream that is used, 1 of another instrument, 0 of another message of an instrument.
        changes : list of Change
        """
        use = np.empty(len(streams), np.int8)
        changes = np.empty((len(streams), 4), np.int64)
        state = self._last, self._since, self._clock, self._holder
        n = _choose(streams, t_rx, self._order, self._instrument, *state, use, changes)
        found = changes[:n].tolist()
        out = []
        for row, before, after, silence in found:
            why = FIRST if before == NOBODY else SILENT if silence >= 0 else BETTER if silence == -1 else BACK
            out.append(Change(row, before, after, why, max(silence, 0) * 1e-9))
        return use, out


@njit(cache=True, nogil=True)
def _choose(streams, t_rx, order, instrument, last, since, clock, holder, use, changes):  # type: ignore[no-untyped-def]
    """Judge rows; in `changes` row, before, after and silence (ns, -1 better, -2 back)."""
    n = 0
    for k in range(len(streams)):
        stream = streams[k]
        if clock[1] != NEVER:
            clock[0] += min(t_rx[k] - clock[1], GAP)
        clock[1] = t_rx[k]
        now = clock[0]
        if last[stream, 0] != NEVER and now - last[stream, 0] > PATIENCE:
            since[stream] = now
        last[stream, 0], last[stream, 1] = now, t_rx[k]
        use[k] = 0
        for level in range(2):
            at = 0 if level == 1 else 1 + instrument[stream]
            before = holder[at]
            after, silence = before, -1
            if before == NOBODY:
                after = stream
            elif before != stream:
                if now - last[before, 0] > PATIENCE:
                    silence = t_rx[k] - last[before, 1]
                    after = stream
                    for other in range(len(order)):
                        same = level == 1 or instrument[other] == instrument[stream]
                        if same and now - last[other, 0] <= PATIENCE and order[other] < order[after]:
                            after = other
                elif order[stream] < order[before] and now - since[stream] >= PATIENCE:
                    after = stream
                    silence = -1 if since[stream] == NEVER else -2
            if after != before:
                holder[at] = after
                if level == 1:
                    changes[n, 0], changes[n, 1], changes[n, 2], changes[n, 3] = k, before, after, silence
                    n += 1
            if after == stream and (level == 0 or use[k] == 1):
                use[k] += 1
    return n
