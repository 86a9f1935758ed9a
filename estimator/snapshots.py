"""What the smoother needs of every step, and nothing else: e, b, g, qs and phi_{j,0}.

The numbers per step are n^2 + 2 n p + 2 p (n states, p noise components): the storage of Shi's Table 5, with the p
numbers g in place of the state. They lie in contiguous arrays, no Python object per step:

    epoch      0        1        2       ...       K
    phi      phi[0]   phi[1]   phi[2]            phi[K]     from the anchor of the window that ends or goes on there
    step         e[0]     e[1]       ...    e[K-1]          b, g, qs likewise
    begins    yes       no      yes                no       does a window begin with the step that leaves the epoch?

Steps are held in blocks. Of a constant model phi and e are looked up in the table of one window (``coordinates``) and
not kept, which leaves n p + 2 p numbers and an index per step. With a folder, full blocks go to disk and are mapped
back one at a time, so that a record may be as long as the disk is large.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimator.coordinates import CONDITION, LENGTH, Table
from estimator.ud import Array, Order

START = 3  # a window begun by hand: neither CONDITION nor LENGTH closed the one before
REASONS = {CONDITION: "condition", LENGTH: "length", START: "start"}
FIRST_ROOM = 64  # steps
SPILL = 8192  # steps in a block on disk


class Rows(NamedTuple):
    """Contiguous rows of K steps: phi (K or K + 1, n, n), e and b (K, p, n), g (K, p, records) and qs (K, p)."""

    phi: Array
    e: Array
    b: Array
    g: Array
    qs: Array


class Shape(NamedTuple):
    """States, noise components, records that share the factors, and the type of every number."""

    n: int
    p: int
    records: int
    dtype: np.dtype[Any]

    def states(self) -> str:
        """In words, what has to agree between a carry and a store."""
        records = f" of {self.records} records" if self.records != 1 else ""
        single = "" if self.dtype == np.float64 else f" in {self.dtype}"
        return f"{self.n} states{records}{single}"

    def rows(self, count: int, *, own: bool = True) -> Rows:
        """Unwritten rows of ``count`` steps; without phi and e unless they are a block's ``own``."""
        n, p, records, dtype = self
        held = count if own else 0
        return Rows(
            np.empty((held, n, n), dtype), np.empty((held, p, n), dtype), np.empty((count, p, n), dtype),
            np.empty((count, p, records), dtype), np.empty((count, p), dtype),
        )  # fmt: skip


@dataclass(slots=True)
class _Block:
    """Consecutive steps, rows first..end of arrays with room for more."""

    room: Rows
    table: Table | None
    at: Order  # of each epoch in a table
    first: int = 0
    end: int = 0
    file: Path | None = None

    @property
    def capacity(self) -> int:
        return int(self.room.qs.shape[0])

    def __len__(self) -> int:
        return self.end - self.first

    def kept(self) -> Rows:
        """Views of what is held, ``phi`` with one row more; phi and e are the whole table where there is one."""
        a, b = self.first, self.end
        room = self.room if self.file is None else _mapped(self.file)
        if self.table is not None:
            return Rows(self.table.phi, self.table.es, *(part[a:b] for part in room[2:]))
        return Rows(room.phi[a : b + 1], *(part[a:b] for part in room[1:]))

    def epochs(self) -> Order:
        """For each of its epochs, the row of phi."""
        return np.arange(len(self) + 1) if self.table is None else self.at[self.first : self.end + 1]

    def last_phi(self) -> Array:
        if self.table is not None:
            phi: Array = self.table.phi[self.at[self.end]]
        else:
            phi = (self.room if self.file is None else _mapped(self.file)).phi[self.end]
        return phi

    def grow(self, shape: Shape, count: int) -> None:
        """Amortised: move to the front when that frees half of the room, otherwise double it."""
        held = len(self)
        need = held + count + 1
        room = self.room if 2 * need <= self.capacity else shape.rows(2 * need, own=self.table is None)
        at = self.at if 2 * need <= self.at.size or self.table is None else np.empty(2 * need, np.int64)
        for old, new in zip(self.room, room, strict=True):
            if old.size:
                new[: held + 1] = (
                    old[self.first : self.end + 1].copy() if old is new else old[self.first : self.end + 1]
                )
        if self.table is not None:
            at[: held + 1] = self.at[self.first : self.end + 1].copy()
        self.room, self.at, self.first, self.end = room, at, 0, held


def _mapped(file: Path) -> Rows:
    """A block on disk, mapped into memory as plain arrays; writing to them would not change the files."""
    parts = []
    for name in Rows._fields:
        path = file.with_suffix(f".{name}.npy")
        try:
            parts.append(np.asarray(np.load(path, mmap_mode="c")))
        except ValueError:  # nothing can be mapped of an empty array
            parts.append(np.load(path))
    return Rows(*parts)


@dataclass(slots=True)
class Stretch:
    """A block for the way back: rows, the row of phi at each epoch, and where windows begin; ``start`` is its step."""

    start: int
    rows: Rows
    at: Order
    begins: NDArray[np.uint8] = field(repr=False)


class Store:
    """Snapshots of consecutive steps, across any number of windows. ``len(store)`` is the number of steps held.

    Parameters
    ----------
    folder : path, optional
        Where full blocks are put, in .npy files; it is made when it is not there, and belongs to this store alone. None
        keeps everything in memory. Files of steps that were dropped are deleted, the others stay.
    spill : int
        Steps in a block on disk. A single call of ``filter`` is one block at the least, however long.

    Attributes
    ----------
    dropped : int
        Steps forgotten so far; step i of the store is step ``dropped + i`` since it began.
    """

    def __init__(self, folder: Path | str | None = None, spill: int = SPILL) -> None:
        self.dropped = 0
        self._folder = None if folder is None else Path(folder)
        self._spill = spill
        self._files = 0
        self._shape = Shape(0, 0, 1, np.dtype(np.float64))
        self._blocks: list[_Block] = []
        self._begins: NDArray[np.uint8] = np.zeros(1, np.uint8)
        self._first = 0  # place of the oldest epoch held in _begins
        self._count = 0
        if spill < 1:
            raise ValueError(f"spill is {spill}: a block on disk has at least one step")
        if self._folder is not None:
            self._folder.mkdir(parents=True, exist_ok=True)
            if any(self._folder.glob("steps-*.npy")):
                raise FileExistsError(f"{self._folder} holds the steps of another store: choose an empty folder")

    def __len__(self) -> int:
        return self._count

    def __repr__(self) -> str:
        return f"Store({len(self)} steps, windows begin at {self.anchors}, {self.bytes_per_step} bytes per step)"

    @property
    def shape(self) -> Shape:
        """States, noise components, records and number type of the steps held."""
        return self._shape

    @property
    def bytes_per_step(self) -> int:
        """8 (n^2 + 2 n p + 2 p), 8 (n p + 2 p + 1) with a table (4 in float32); 0 while the store has seen no step."""
        n, p, records, dtype = self._shape
        if not self._blocks:
            return 0
        if self._blocks[-1].table is not None:
            return dtype.itemsize * (n * p + p + p * records) + 8
        return dtype.itemsize * (n * n + 2 * n * p + p + p * records)

    @property
    def anchors(self) -> list[int]:
        """First steps of the windows held; ``len(store)`` is among them when a window has just closed."""
        return [int(i) for i in np.flatnonzero(self.begins)]

    @property
    def reasons(self) -> list[str]:
        """Why each window of ``anchors`` began: the one before closed by 'condition' or 'length'; 'start' otherwise."""
        return [REASONS[int(self.begins[i])] for i in self.anchors]

    @property
    def begins(self) -> NDArray[np.uint8]:
        """Nonzero where a window begins, shape (K + 1,)."""
        return self._begins[self._first : self._first + self._count + 1]

    @property
    def steps(self) -> Rows:
        """What is held; ``phi`` has K + 1 rows, the others K. Views when it is one block without a table."""
        if len(self._blocks) == 1 and self._blocks[0].table is None:
            return self._blocks[0].kept()
        parts = [(block.kept(), block.epochs()) for block in self._blocks]
        if not parts:
            return self._shape.rows(0)
        phi = [parts[0][0].phi[parts[0][1][:1]]] + [rows.phi[at[1:]] for rows, at in parts]
        e = [
            rows.e if block.table is None else rows.e[at[1:] - 1]
            for block, (rows, at) in zip(self._blocks, parts, strict=True)
        ]
        others = [np.concatenate([rows[i] for rows, _ in parts]) for i in range(2, len(Rows._fields))]
        return Rows(np.concatenate(phi), np.concatenate(e), *others)

    def backwards(self, first: int = 0) -> Iterator[Stretch]:
        """Yield the steps ``first``.. in stretches, the newest one first; each meets the one before in an epoch."""
        stop = len(self)
        for block in reversed(self._blocks):
            if stop <= first:
                return
            start = stop - len(block)
            skip = max(first - start, 0)
            rows, at = block.kept(), block.epochs()
            if block.table is None:
                rows, at = rows._replace(phi=rows.phi[skip:], e=rows.e[skip:]), at[: at.size - skip]
            else:
                at = at[skip:]
            begins = self.begins[start + skip : stop + 1]
            yield Stretch(start + skip, Rows(rows.phi, rows.e, *(part[skip:] for part in rows[2:])), at, begins)
            stop = start

    def reserve(self, shape: Shape, count: int, phi: Array, steps: int, table: Table | None) -> Rows:
        """Room for ``count`` steps after the newest one, to be written and then kept with ``commit``.

        Parameters
        ----------
        phi, steps : (n, n) array and int
            phi_{j,0} and the steps since the anchor of the carry that the new steps continue.
        table : Table, optional
            Where phi and e of the new steps are to be found; their rows are then not there to be written.

        Raises
        ------
        ValueError
            The carry does not continue the steps held, or the shape has changed.
        """
        while self._blocks and self._blocks[-1].end == 0 and self._blocks[-1].file is None:
            self._blocks.pop()  # reserved by a call that failed
        if not self._blocks:
            self._shape = shape
        elif self._shape != shape:
            raise ValueError(
                f"store holds {self._shape.states()} and {self._shape.p} noise components, the model has "
                f"{shape.states()} and {shape.p} noise components"
            )
        else:
            self.check(phi, steps)
        newest = self._blocks[-1] if self._blocks else None
        done = newest is not None and (len(newest) >= self._spill or newest.table is not table)
        if newest is not None and newest.file is None and self._folder is not None and done:
            self._put_away(newest)
        if newest is None or newest.file is not None or newest.table is not table:
            room = shape.rows(max(FIRST_ROOM, count + 1), own=table is None)
            newest = _Block(room, table, np.empty(0 if table is None else room.qs.shape[0], np.int64))
            if table is None:
                room.phi[0] = phi
            else:
                newest.at[0] = steps
            self._blocks.append(newest)
        if newest.end + count + 1 > newest.capacity:
            newest.grow(shape, count)
        a, room = newest.end, newest.room
        parts = (part[a : a + count] for part in room[2:])
        if table is not None:
            return Rows(room.phi, room.e, *parts)
        return Rows(room.phi[a + 1 : a + 1 + count], room.e[a : a + count], *parts)

    def commit(self, closed: NDArray[np.uint8], steps: int, at: Order) -> None:
        """Keep the steps just written; ``closed`` (N,) as the forward sweep leaves it, ``steps`` as in ``reserve``.

        ``at`` (N,) are the rows of a table's ``es`` that the steps took.
        """
        block, count = self._blocks[-1], closed.size
        if block.table is not None:
            block.at[block.end + 1 : block.end + count + 1] = at + 1
        block.end += count
        if self._first + self._count + count + 1 > self._begins.size:
            held = self.begins.copy()
            self._begins = np.zeros(max(FIRST_ROOM, 2 * (held.size + count)), np.uint8)
            self._begins[: held.size] = held
            self._first = 0
        a = self._first + self._count
        if steps == 0 and self._begins[a] == 0:
            self._begins[a] = START
        self._begins[a + 1 : a + count + 1] = closed & LENGTH
        self._begins[a : a + count] |= closed & CONDITION
        self._count += count

    def check(self, phi: Array, steps: int) -> None:
        """Raise ValueError when a carry with this phi_{j,0} does not stand at the newest step."""
        if self._blocks and steps > 0 and not np.array_equal(self._blocks[-1].last_phi(), phi):
            raise ValueError("carry is not the one that the newest step of this store ended with")

    def drop(self, before: int) -> None:
        """Forget the steps before index ``before``; what was step ``before`` is step 0 afterwards.

        Raises
        ------
        IndexError
            ``before`` is negative or beyond ``len(store)``.
        """
        if not 0 <= before <= len(self):
            raise IndexError(f"drop({before}): the store holds {len(self)} steps")
        self.dropped += before
        self._first += before
        self._count -= before
        while len(self._blocks) > 1 and before >= len(self._blocks[0]):
            gone = self._blocks.pop(0)
            before -= len(gone)
            if gone.file is not None:
                for name in Rows._fields:
                    gone.file.with_suffix(f".{name}.npy").unlink(missing_ok=True)
        if self._blocks:
            self._blocks[0].first += before

    def _put_away(self, block: _Block) -> None:
        """Move a block to disk; what it held in memory is free afterwards."""
        assert self._folder is not None
        self._files += 1
        file = self._folder / f"steps-{self._files:06d}"
        own = block.table is None
        for name, part in zip(Rows._fields, block.room, strict=True):
            more = 1 if name == "phi" else 0
            held = part[block.first : block.end + more] if own or name not in ("phi", "e") else part
            with file.with_suffix(f".{name}.npy").open("xb") as out:  # never over the steps of another store
                np.save(out, held)
        block.at = block.epochs().copy() if not own else block.at
        block.end, block.first, block.file = len(block), 0, file
        block.room = self._shape.rows(0)
