"""Age of data: how long after its arrival a consumer gets it.

A consumer that is too slow loses nothing here, so gaps would never tell: it falls behind.
"""

from __future__ import annotations

import time
from typing import Literal, NamedTuple

import numpy as np

from telemetry.messages import SENSORS, Estimate, Health, Message

AGED = (*SENSORS, Estimate)  # smoothed windows are late by design, and words carry no data
ROW = 1.0  # s


class Word(NamedTuple):
    """Something to tell about the age of data."""

    level: Literal["info", "warning", "error"]
    text: str


class Age:
    """The ages at which the data of one stage are handed on.

    Until they have once been fresh they are being caught up with, which is said once; after that old data are an
    alarm, which ends when they are younger than half of `stale`.

    Parameters
    ----------
    stage : str
    stale : float
        Alarm above this 99th percentile of one second, s.
    """

    def __init__(self, stage: str, stale: float) -> None:
        self.stage = stage
        self.messages = 0
        self._stale = stale
        self._state: Literal["new", "catching up", "fresh", "stale"] = "new"
        self._ages: list[int] = []
        self._due = time.monotonic() + ROW

    def add(self, message: Message) -> None:
        """A message is handed on now."""
        self.messages += 1
        if isinstance(message, AGED):
            self._ages.append(time.time_ns() - int(message.t_rx[-1]))

    @property
    def due(self) -> bool:
        """Whether a row is complete."""
        return time.monotonic() >= self._due

    def row(self, service: str, missing: int, backfilled: int, refused: int) -> tuple[Health, Word | None]:
        """The ages of the second that has gone by, NaN where nothing came, and what is to be told of them."""
        self._due = time.monotonic() + ROW
        ages, self._ages = sorted(self._ages), []
        # Nearest rank; `numpy.quantile` would hold up the stream for 60 ms when it is called first.
        ranks = (len(ages) // 2, -(-99 * len(ages) // 100) - 1, -1)
        p50, p99, most = (ages[rank] * 1e-9 for rank in ranks) if ages else (float("nan"),) * 3
        now = np.array([time.time_ns()], np.int64)
        health = Health(
            vehicle=0,
            source=service,
            boot=0,
            t=now,
            t_rx=now,
            stage=self.stage,
            age_p50=np.array([p50]),
            age_p99=np.array([p99]),
            age_max=np.array([most]),
            messages=np.array([self.messages]),
            missing=np.array([missing]),
            backfilled=np.array([backfilled]),
            refused=np.array([refused]),
        )
        return health, self._judge(p99) if ages else None

    def _judge(self, p99: float) -> Word | None:
        before = self._state
        if before in ("new", "catching up"):
            self._state = "catching up" if p99 > self._stale else "fresh"
            if self._state == before:
                return None
            if self._state == "catching up":
                return Word("warning", f"catching up with stage {self.stage}: {p99:.0f} s behind")
            return Word("info", f"caught up with stage {self.stage}") if before == "catching up" else None
        if before == "fresh" and p99 > self._stale:
            self._state = "stale"
            return Word("error", f"data of stage {self.stage} are {p99:.1f} s old: this consumer does not follow")
        if before == "stale" and p99 < self._stale / 2:
            self._state = "fresh"
            return Word("info", f"data of stage {self.stage} are fresh again")
        return None
