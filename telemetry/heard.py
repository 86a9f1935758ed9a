"""Frames, and what the whole batch of them has shown before they go to their systems."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from telemetry import frames
from telemetry.boottimes import Told
from telemetry.frames import Frames
from telemetry.messages import Counts


class Heard(NamedTuple):
    """Frames, and what has been found out about them by the whole batch; columns of shape (k,).

    Parameters
    ----------
    frames : Frames
    told : Told
        The times they tell.
    copy : uint8 array
        First arrivals and copies (`telemetry.redundant`).
    digest : int64 array
        Equal for equal frames.
    """

    frames: Frames
    told: Told
    copy: NDArray[np.uint8]
    digest: Counts

    def select(self, rows: NDArray[Any] | slice) -> Heard:
        """The frames at `rows`."""
        told = Told(*(column[rows] for column in self.told))
        return Heard(self.frames.select(rows), told, self.copy[rows], self.digest[rows])

    def kept(self, begin: int) -> Heard:
        """The frames from `begin` on, over memory of their own."""
        rest = self.select(slice(begin, None))
        told = Told(*(column.copy() for column in rest.told))
        return Heard(rest.frames.compact(), told, rest.copy.copy(), rest.digest.copy())


def join(before: Heard, after: Heard) -> Heard:
    """Frames of two batches as one."""
    told = Told(*(np.concatenate(pair) for pair in zip(before.told, after.told, strict=True)))
    copy, digest = np.concatenate([before.copy, after.copy]), np.concatenate([before.digest, after.digest])
    return Heard(frames.join([before.frames, after.frames]), told, copy, digest)
