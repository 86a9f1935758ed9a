"""What was not used, how often, and why."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

TOLD_AGAIN = 1000
"""After the first row a reason is told again at so many, and at every tenfold of it."""


class Refused:
    """Counts of the rows of one stream that are no measurement, by reason."""

    def __init__(self) -> None:
        self._counts: dict[str, int] = {}
        self._next: dict[str, int] = {}

    def count(self, reason: str, rows: NDArray[np.int64]) -> list[tuple[int, int]]:
        """Count rows; return those of them that are worth telling, each with its number."""
        before = self._counts.get(reason, 0)
        after = self._counts[reason] = before + len(rows)
        told = []
        while after >= (number := self._next.get(reason, 1)):
            told.append((int(rows[number - before - 1]), number))
            self._next[reason] = TOLD_AGAIN if number == 1 else 10 * number
        return told

    def untold(self) -> list[tuple[str, int]]:
        """Reasons and counts that have grown since they were told."""
        found = []
        for reason, count in self._counts.items():
            following = self._next[reason]
            if count > (1 if following == TOLD_AGAIN else following // 10):
                found.append((reason, count))
        return found
