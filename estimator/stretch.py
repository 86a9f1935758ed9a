"""One stretch of flight: filtered as it comes, smoothed from any closed step on, iterated when it is over.

Steps stand in blocks, each beginning with an anchor. A block holds what drove it and the carry it began with, and as
long as there is room the snapshots; those of an older block are made again when they are wanted, to the same bits. So
memory grows by the inputs alone, whatever the length of the flight.
"""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import Any, Generic, NamedTuple, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from estimator import extended
from estimator.extended import About, Carry, Drive, Rows, Told
from estimator.models.flight_path import FlightPath
from estimator.rotation import difference, exponential

Floats = NDArray[np.float64]

BLOCK = 2000  # steps
KEPT = 8  # blocks whose snapshots stay in memory
WINDOW = 100  # steps between anchors


class Filtered(NamedTuple):
    """What the filter says of N steps.

    Attributes
    ----------
    mean, std (N, n) : named states; std is NaN where none was wanted
    innovation (N, 10), status (N, 10), doubted (N,) : as `extended.Told`
    """

    mean: Floats
    std: Floats
    innovation: Floats
    status: NDArray[np.uint8]
    doubted: NDArray[np.uint8]


class Smoothed(NamedTuple):
    """What the smoother says of N + 1 epochs.

    Attributes
    ----------
    mean, std (N+1, n) : named states; std is NaN where none was wanted
    x (N+1, 23), q (N+1, 4), w (N, 6) : the trajectory to linearise about, and the noise of the inertial sensors, NaN
        from a smoother that does not estimate it
    """

    mean: Floats
    std: Floats
    x: Floats
    q: Floats
    w: Floats


class Known(Protocol):
    """What a filter carries along: arrays that it overwrites."""

    def copy(self: C) -> C:
        """The same knowledge in arrays of its own."""
        ...


C = TypeVar("C", bound=Known)
R = TypeVar("R")  # snapshots of the steps of a block
S = TypeVar("S", bound="Course[Any, Any]")


class Point(NamedTuple, Generic[C]):
    """An epoch to which a stretch can be wound back: the carry there, and how many blocks and steps there were.

    `closed` is whether an anchor stood after the last of them.
    """

    carry: C
    blocks: int
    steps: int
    closed: int


class Diverged(ArithmeticError):
    """The filter's result is no longer finite; ``step`` says where."""

    def __init__(self, step: int) -> None:
        self.step = step
        super().__init__("the flight path is no longer finite")


@dataclass(slots=True)
class Block(Generic[C, R]):
    """Steps that follow on one another: the carry they began with, what drove them, what was told, and snapshots."""

    begin: C
    drives: list[Drive] = field(default_factory=list)
    tolds: list[Told] = field(default_factory=list)
    rows: R | None = None
    count: int = 0

    def drive(self) -> Drive:
        """What drove all of its steps."""
        if len(self.drives) > 1:
            self.drives = [Drive.join(self.drives)]
        return self.drives[0]

    def told(self) -> Told:
        """What the filter told of all of its steps."""
        if len(self.tolds) > 1:
            self.tolds = [Told.join(self.tolds)]
        return self.tolds[0]


class Course(ABC, Generic[C, R]):
    """A stretch of flight in blocks, whichever filter flies it.

    Parameters
    ----------
    flight : FlightPath
    carry : C
        What is known at its beginning; overwritten.
    gated : bool
        Whether improbable measurements are weakened and refused.
    """

    def __init__(self, flight: FlightPath, carry: C, *, gated: bool = True) -> None:
        self.flight, self._gated = flight, gated
        self.carry = carry
        self._blocks: list[Block[C, R]] = []

    @classmethod
    @abstractmethod
    def begin(
        cls: type[S], flight: FlightPath, values: dict[str, float], sigma: Floats | None = None, *, gated: bool = True
    ) -> S:
        """Begin from named values (zero where none is given) with standard deviations (n,), the prior's if none.

        Raises
        ------
        ValueError
            A value is not finite.
        """

    @abstractmethod
    def smooth(self, *, std: bool = True) -> Smoothed:
        """Smooth everything from the first block on, given what is known now."""

    @abstractmethod
    def hybrid(self, found: Smoothed, *, std: bool = True) -> Smoothed:
        """One more pass, linearised about a smoothed trajectory."""

    @abstractmethod
    def _room(self, count: int) -> R:
        """Room for the snapshots of so many steps."""

    @abstractmethod
    def _filter(self, block: Block[C, R], drive: Drive, first: int) -> Filtered:
        """Filter steps of one block; ``first`` is what they are counted from in `Diverged`."""

    @abstractmethod
    def _again(self, block: Block[C, R]) -> R:
        """The snapshots of a block made again, with room for all of its steps to come."""

    def __len__(self) -> int:
        return sum(block.count for block in self._blocks)

    def advance(self, drive: Drive) -> Filtered:
        """Filter steps.

        Raises
        ------
        Diverged
            A result is not finite; the stretch ends before that step.
        """
        parts = []
        first, total = 0, len(drive.dt)
        while first < total:
            if not self._blocks or self._blocks[-1].count >= BLOCK:
                self._begin()
            block = self._blocks[-1]
            stop = min(total, first + BLOCK - block.count)
            parts.append(self._filter(block, drive.part(first, stop), first))
            first = stop
        return parts[0] if len(parts) == 1 else Filtered(*(np.concatenate(c) for c in zip(*parts, strict=True)))

    def point(self) -> Point[C]:
        """The present epoch, to come back to with `rewind`; good until `drop`."""
        return Point(self.carry.copy(), len(self._blocks), self._blocks[-1].count if self._blocks else 0, 1)

    def rewind(self, point: Point[C]) -> None:
        """Forget the steps since a point: the filter goes on from there, to the same bits as if they had never been.

        Snapshots that have been let go of in the meantime are made again.
        """
        self.carry = point.carry.copy()
        del self._blocks[point.blocks :]
        if not self._blocks:
            return
        block = self._blocks[-1]
        if block.count > point.steps:
            block.drives, block.tolds = [block.drive().part(0, point.steps)], [block.told().part(0, point.steps)]
            block.count = point.steps
        if block.rows is None:
            block.rows = self._again(block)

    def _begin(self) -> None:
        """Begin a block at the present epoch."""
        self._blocks.append(Block(self.carry.copy(), rows=self._room(BLOCK)))
        for old in self._blocks[-KEPT - 1 :: -1]:
            if old.rows is None:
                break
            old.rows = None

    def taken(self: S) -> S:
        """All that is known now, to be smoothed while the filter goes on here with `drop`."""
        other = copy.copy(self)
        other.carry = self.carry.copy()
        return other

    def drop(self) -> None:
        """Forget the steps: what is smoothed next begins at the present epoch."""
        self._blocks = []

    def cut(self, first: int, stop: int) -> tuple[Drive, Told]:
        """What drove the steps first..stop-1, and what was told of them."""
        drives, tolds, at = [], [], 0
        for block in self._blocks:
            a, b = max(first - at, 0), min(stop - at, block.count)
            if a < b:
                drives.append(block.drive().part(a, b))
                tolds.append(block.told().part(a, b))
            at += block.count
        return Drive.join(drives), Told.join(tolds)


Own = Block[Carry, Rows]


class Stretch(Course[Carry, Rows]):
    """A stretch of flight, flown by the extended information smoother.

    Parameters
    ----------
    flight : FlightPath
    carry : Carry
        From `FlightPath.start`.
    window : int
        Steps between anchors; the result does not depend on it.
    gated : bool
        Whether improbable measurements are weakened and refused.
    """

    def __init__(self, flight: FlightPath, carry: Carry, *, window: int = WINDOW, gated: bool = True) -> None:
        super().__init__(flight, carry, gated=gated)
        self._window = window

    @classmethod
    def begin(
        cls, flight: FlightPath, values: dict[str, float], sigma: Floats | None = None, *, gated: bool = True
    ) -> Stretch:
        """Begin from named values (zero where none is given) with standard deviations (n,), the prior's if none.

        Raises
        ------
        ValueError
            A value is not finite.
        """
        return cls(flight, flight.start(values, sigma), gated=gated)

    def point(self) -> Point[Carry]:
        """The present epoch, to come back to with `rewind`; good until `drop`."""
        last = self._blocks[-1] if self._blocks else None
        closed = int(last.rows.closed[last.count - 1]) if last is not None and last.rows is not None else 1
        return super().point()._replace(closed=closed)

    def rewind(self, point: Point[Carry]) -> None:
        """Forget the steps since a point: the filter goes on from there, to the same bits as if they had never been.

        Snapshots that have been let go of in the meantime are made again.
        """
        super().rewind(point)
        if self._blocks and (rows := self._blocks[-1].rows) is not None:
            rows.closed[self._blocks[-1].count - 1] = point.closed

    def _room(self, count: int) -> Rows:
        return Rows.empty(count, self.flight.n, self.flight.p)

    def _again(self, block: Own) -> Rows:
        rows = self._room(BLOCK)
        self._forward(block, block.begin.copy(), About.nothing(), rows.part(0, block.count), hidden=True)
        return rows

    def _begin(self) -> None:
        self._anchor(self.carry)
        if self._blocks and (rows := self._blocks[-1].rows) is not None:
            rows.closed[self._blocks[-1].count - 1] = 1
        super()._begin()

    def _anchor(self, carry: Carry) -> None:
        if carry.clock[2] > 0:
            extended.anchor(
                self.flight.model, carry, np.empty((7, 7)), np.empty(7, np.int64), carry.x[self.flight.model.order]
            )

    def _filter(self, block: Own, drive: Drive, first: int) -> Filtered:
        count, n = len(drive.dt), self.flight.n
        told = Told.empty(count, n)
        assert block.rows is not None
        rows = block.rows.part(block.count, block.count + count)
        wrong = extended.forward(
            self.flight.model, drive, About.nothing(), self._window, self._gated, self.carry, True, rows, told
        )
        if wrong >= 0:
            raise Diverged(first + wrong)
        block.drives.append(drive)
        block.tolds.append(told)
        block.count += count
        mean = np.empty((count, n))
        extended.named(self.flight.model, rows.x, rows.q, True, mean)
        return Filtered(mean, told.std, told.innovation, told.status, told.doubted)

    def smooth(self, *, std: bool = True) -> Smoothed:
        """Smooth everything from the first block on, given what is known now."""
        blocks = [block for block in self._blocks if block.count]
        return self._backward(blocks, self.carry, None, std)

    def hybrid(self, found: Smoothed, *, std: bool = True) -> Smoothed:
        """One more pass, linearised about a smoothed trajectory, gusts and wind about their own prediction."""
        blocks = [block for block in self._blocks if block.count]
        n = self.flight.n
        carry = blocks[0].begin.copy()
        turned = np.empty(3)
        difference(found.q[0], carry.q, turned)
        rotation = np.empty((3, 3))
        exponential(turned[0], turned[1], turned[2], rotation)
        carry.s[n - 6 : n - 3] = rotation @ carry.s[n - 6 : n - 3]
        carry.s[n - 3 :] = turned
        carry.q[:] = found.q[0]
        again: list[Own] = []
        first = 0
        for block in blocks:
            self._anchor(carry)
            again.append(Block(carry.copy(), [block.drive()], [block.told()], None, block.count))
            about = self._about(found, block, first)
            rows = Rows.empty(block.count, n, self.flight.p) if len(blocks) <= KEPT else None
            self._forward(again[-1], carry, about, rows, hidden=True)
            again[-1].rows = rows
            first += block.count
        for block in again[:-1]:
            if block.rows is not None:
                block.rows.closed[block.count - 1] = 1
        return self._backward(again, carry, found, std)

    def _about(self, found: Smoothed, block: Own, first: int) -> About:
        stop = first + block.count
        told = block.told()
        part = found.x[first : stop + 1], found.q[first : stop + 1], found.w[first:stop]
        return About(*part, told.status, told.r, told.doubted)

    def _forward(self, block: Own, carry: Carry, about: About, rows: Rows | None, *, hidden: bool) -> None:
        drive, n = block.drive(), self.flight.n
        if hidden:
            drive = drive._replace(shown=np.zeros(block.count, np.uint8))
        keep = rows is not None
        room = rows if rows is not None else Rows.empty(block.count, n, self.flight.p)
        wrong = extended.forward(
            self.flight.model, drive, about, self._window, self._gated, carry, keep, room, Told.empty(block.count, n)
        )
        if wrong >= 0:
            raise Diverged(wrong)

    def _backward(self, blocks: list[Own], carry: Carry, about: Smoothed | None, factors: bool) -> Smoothed:
        n, total = self.flight.n, sum(block.count for block in blocks)
        x, q, w = np.empty((total + 1, 23)), np.empty((total + 1, 4)), np.empty((total, 6))
        std = np.full((total + 1, n), np.nan)
        star, vt, d = np.empty((n, 1)), np.empty((n, n)), np.empty(n)
        last = carry.copy()
        if blocks[-1].rows is not None and blocks[-1].rows.closed[blocks[-1].count - 1]:
            self._anchor(last)
        extended.finish(last, star, vt, d, factors)
        stop = total
        for i in range(len(blocks) - 1, -1, -1):
            block = blocks[i]
            first = stop - block.count
            rows = block.rows
            if rows is None:
                rows = Rows.empty(block.count, n, self.flight.p)
                nothing = About.nothing() if about is None else self._about(about, block, first)
                self._forward(block, block.begin.copy(), nothing, rows, hidden=True)
                if i < len(blocks) - 1:
                    rows.closed[-1] = 1
            shown = np.concatenate([[0], block.drive().shown]).astype(np.uint8)
            if i == 0:
                shown[0] = 1
            extended.backward(
                self.flight.model, rows.part(0, block.count), star, vt, d, shown, factors, block.begin.s,
                block.begin.q, block.begin.x, x[first : stop + 1], q[first : stop + 1], w[first:stop],
                std[first : stop + 1],
            )  # fmt: skip
            stop = first
        mean = np.empty((total + 1, n))
        extended.named(self.flight.model, x, q, False, mean)
        return Smoothed(mean, std, x, q, w)
