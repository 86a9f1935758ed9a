"""Track: positions over time cut into short strips, so that a map can be drawn while it grows.

The strips are cut by the vehicle's time and never by batches: the same flight gives the same strips however it arrived.
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from telemetry.messages import Floats, Times

STRIP = (
    2_000_000_000  # ns of vehicle time in one strip: a viewer slows down with rows, and a map that lags more looks dead
)


class Strip(NamedTuple):
    """A piece of track: the times of its last point, and its points, shape (m, 3)."""

    t: int
    t_rx: int
    points: Floats


class Track:
    """Cuts positions into strips.

    Parameters
    ----------
    joins : bool
        Whether a strip starts with the last point of the one before: true for lines, false for points.
    """

    def __init__(self, *, joins: bool) -> None:
        self.joins = joins
        self._t: list[Times] = []
        self._t_rx: list[Times] = []
        self._points: list[Floats] = []
        self._tail: Floats | None = None  # last point of the strip before, where the line goes on

    def add(self, t: Times, t_rx: Times, points: Floats, breaks: NDArray[np.intp]) -> list[Strip]:
        """Add samples and take the strips that they complete.

        Parameters
        ----------
        t, t_rx : int64 array, shape (k,)
        points : float array, shape (k, 3)
            A row that is not finite is a hole in the track.
        breaks : int array
            Rows before which the track is interrupted.
        """
        strips: list[Strip] = []
        good = np.asarray(np.isfinite(points).all(axis=1))
        slot = t // STRIP
        before = self._t[-1][-1] // STRIP if self._t else slot[0]
        cut = np.concatenate([[before], slot])[:-1] != slot
        torn = np.zeros(len(t), bool)
        torn[breaks] = True
        torn |= ~good
        edges = [0, *np.flatnonzero(cut | torn).tolist(), len(t)]
        for i, (start, stop) in enumerate(pairwise(edges)):
            if i:  # the row at `start` is a cut or a tear
                strips += self.take()
                if torn[start]:
                    self._tail = None
            here = slice(start, stop)
            keep = good[here]
            if keep.any():
                self._t.append(t[here][keep])
                self._t_rx.append(t_rx[here][keep])
                self._points.append(points[here][keep])
        return strips

    def take(self) -> list[Strip]:
        """The strip that is not complete yet, if any; the next one goes on from it."""
        if not self._t:
            return []
        points = np.concatenate(self._points)
        strip = Strip(int(self._t[-1][-1]), int(self._t_rx[-1][-1]), points)
        if self.joins:
            whole = points if self._tail is None else np.concatenate([self._tail, points])
            strip = strip._replace(points=whole)
            self._tail = points[-1:]
        self._t, self._t_rx, self._points = [], [], []
        return [] if self.joins and len(strip.points) < 2 else [strip]
