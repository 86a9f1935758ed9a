"""One stretch of flight, flown by the square-root cubature filter and smoothed by its fixed-interval smoother.

The same model, noise and gates as the extended smoother's; what differs is that nothing is linearised where it is
curved: moments come from cubature points (``flight_points``, ``flight_seen``), and what a regression leaves is noise.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from estimator import extended
from estimator.cubature.flight_backward import backward
from estimator.cubature.flight_forward import forward
from estimator.cubature.flight_points import straighten
from estimator.cubature.flight_structures import Carry, Layout, Rows, desk
from estimator.extended import Drive, Told
from estimator.models.flight_path import FlightPath
from estimator.stretch import BLOCK, Block, Course, Diverged, Filtered, Smoothed

Floats = NDArray[np.float64]
Own = Block[Carry, Rows]


class CubatureStretch(Course[Carry, Rows]):
    """A stretch of flight, flown by the cubature filter.

    Parameters
    ----------
    flight : FlightPath
    carry : Carry
        What is known at its beginning; see `begin`.
    gated : bool
        Whether improbable measurements are weakened and refused.
    """

    def __init__(self, flight: FlightPath, carry: Carry, *, gated: bool = True) -> None:
        super().__init__(flight, carry, gated=gated)
        self._layout = Layout.of(flight.model)
        self._desk = desk(flight.n, flight.p)

    @classmethod
    def begin(
        cls, flight: FlightPath, values: dict[str, float], sigma: Floats | None = None, *, gated: bool = True
    ) -> CubatureStretch:
        """Begin from named values (zero where none is given) with standard deviations (n,), the prior's if none.

        Raises
        ------
        ValueError
            A value is not finite.
        """
        x, q, covariance = flight.beginning(values, sigma)
        return cls(flight, Carry.begin(Layout.of(flight.model), x, q, covariance, flight.model.order), gated=gated)

    def _room(self, count: int) -> Rows:
        return Rows.empty(count, self.flight.n, self._layout.most)

    def _filter(self, block: Own, drive: Drive, first: int) -> Filtered:
        count, n = len(drive.dt), self.flight.n
        told = Told.empty(count, n)
        assert block.rows is not None
        rows = block.rows.part(block.count, block.count + count)
        wrong = forward(self._layout, drive, self._gated, self.carry, self._desk, rows, told)
        if wrong >= 0:
            raise Diverged(first + wrong)
        block.drives.append(drive)
        block.tolds.append(told)
        block.count += count
        x, q, mean = np.empty((count, 23)), np.empty((count, 4)), np.empty((count, n))
        straighten(self._layout.order, rows.x, rows.q, block.begin.x, x, q, self._desk.work)
        extended.named(self.flight.model, x, q, False, mean)
        return Filtered(mean, told.std, told.innovation, told.status, told.doubted)

    def _again(self, block: Own) -> Rows:
        rows = self._room(BLOCK)
        drive = block.drive()._replace(shown=np.zeros(block.count, np.uint8))
        told = Told.empty(block.count, self.flight.n)
        scratch = desk(self.flight.n, self.flight.p)
        wrong = forward(
            self._layout, drive, self._gated, block.begin.copy(), scratch, rows.part(0, block.count), told
        )  # fmt: skip
        if wrong >= 0:
            raise Diverged(wrong)
        return rows

    def smooth(self, *, std: bool = True) -> Smoothed:
        """Smooth everything from the first block on, given what is known now.

        The noise of the inertial sensors is not estimated: ``w`` of what is given back is NaN.
        """
        blocks = [block for block in self._blocks if block.count]
        n, total = self.flight.n, sum(block.count for block in blocks)
        means, attitudes = np.empty((total + 1, 23)), np.empty((total + 1, 4))
        deviations = np.full((total + 1, n), np.nan)
        x, root = self.carry.x[self._layout.order], self.carry.root.copy()
        scratch, stack = desk(n, self.flight.p), np.empty((2 * n + 1, n))
        stop = total
        for i in range(len(blocks) - 1, -1, -1):
            block = blocks[i]
            first = stop - block.count
            rows = block.rows if block.rows is not None else self._again(block)
            shown = np.concatenate([[0], block.drive().shown]).astype(np.uint8)
            if i == 0:
                shown[0] = 1
            backward(
                self._layout, rows.part(0, block.count), x, root, block.begin.x, block.begin.q, shown, std,
                means[first : stop + 1], attitudes[first : stop + 1], deviations[first : stop + 1], scratch, stack,
            )  # fmt: skip
            stop = first
        mean = np.empty((total + 1, n))
        extended.named(self.flight.model, means, attitudes, False, mean)
        return Smoothed(mean, deviations, means, attitudes, np.full((total, 6), np.nan))

    def hybrid(self, found: Smoothed, *, std: bool = True) -> Smoothed:
        """What has been found, unchanged: there is no linearisation to be done anew."""
        return found
