"""A batch of frames of one boot epoch: its times, and the messages that come of it."""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from telemetry.messages import Event, Message, Sample, event
from telemetry.sensors.feeds import Columns, Mask, Refusals
from telemetry.sensors.refused import Refused
from telemetry.sensors.stream import Use

STAGE = "ingest"
Level = Literal["info", "warning"]


class Part(NamedTuple):
    """Rows of one stream for one kind of sensor."""

    use: Use
    source: str
    rows: NDArray[np.int64]
    columns: Columns


class Batch:
    """A batch of frames of one boot epoch.

    Parameters
    ----------
    vehicle : int
    t, t_rx : int64 array
        Times of all its rows, ns.
    t_sigma : float64 array or None
        Standard deviation of `t`, s, 0 where the vehicle told it; None where it told all.
    boot : int

    Attributes
    ----------
    out : list of Message
        What comes of it.
    parts : dict of type to list of Part
        What was read in it, by kind of sensor.
    """

    def __init__(
        self,
        vehicle: int,
        t: NDArray[np.int64],
        t_rx: NDArray[np.int64],
        t_sigma: NDArray[np.float64] | None,
        boot: int,
    ) -> None:
        self.vehicle, self.t, self.t_rx, self.t_sigma, self.boot = vehicle, t, t_rx, t_sigma, boot
        self.out: list[Message] = []
        self.parts: dict[type[Sample], list[Part]] = {}

    def add(
        self, kind: type[Sample], use: Use, source: str, rows: NDArray[np.int64], columns: Columns, valid: Mask | None
    ) -> None:
        """Note what was read; of it the rows that are `valid`, None being all."""
        if valid is not None:
            rows, columns = rows[valid], {name: column[valid] for name, column in columns.items()}
        if len(rows):
            self.parts.setdefault(kind, []).append(Part(use, source, rows, columns))

    def valid(self, refused: Refused, words: str, refusals: Refusals, rows: NDArray[np.int64]) -> Mask | None:
        """Refuse rows, each for the first reason that holds; return those that are left, None being all."""
        valid: Mask | None = None
        for reason, mask in refusals:
            if np.count_nonzero(mask):
                mine = mask if valid is None else mask & valid
                valid = ~mask if valid is None else valid & ~mask
                if len(bad := rows[mine]):
                    self.refuse(refused, words, reason, bad)
        return valid

    def refuse(self, refused: Refused, words: str, reason: str, rows: NDArray[np.int64]) -> None:
        """Count rows that are not used, and tell of it now and then."""
        for row, number in refused.count(reason, rows):
            so_far = f": {number} rows so far" if number > 1 else ""
            self.say(f"{words} is not used where {reason}{so_far}", row)

    def say(self, text: str, row: int, level: Level = "info") -> None:
        """Tell something at the time of a row."""
        self.out.append(told(self.vehicle, text, int(self.t[row]), int(self.t_rx[row]), self.boot, level))


def told(vehicle: int, text: str, t: int, t_rx: int, boot: int, level: Level = "info") -> Event:
    """An event of the stage about a vehicle."""
    return event(text, level=level, vehicle=vehicle, source=STAGE, boot=boot, t=t, t_rx=t_rx)
