"""What the smoother needs of every step, and nothing else: e, b, g, qs and phi_{j,0}.

The numbers per step are n^2 + 2 n p + 2 p (n states, p noise components): the storage of Shi's Table 5, with the p
numbers g in place of the state. They lie in growable contiguous arrays, no Python object per step:

    epoch      0        1        2       ...       K
    phi      phi[0]   phi[1]   phi[2]            phi[K]     from the anchor of the window that ends or goes on there
    step         e[0]     e[1]       ...    e[K-1]          b, g, qs likewise
    begins    yes       no      yes                no       does a window begin with the step that leaves the epoch?
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimator.ud import Array
from estimator.window import REASONS

FIRST_ROOM = 64  # steps


class Rows(NamedTuple):
    """Contiguous rows of K steps: phi (K or K + 1, n, n), e and b (K, p, n), g and qs (K, p)."""

    phi: Array
    e: Array
    b: Array
    g: Array
    qs: Array


def rows(count: int, n: int, p: int) -> Rows:
    """Unwritten rows of ``count`` steps."""
    return Rows(
        np.empty((count, n, n)), np.empty((count, p, n)), np.empty((count, p, n)), np.empty((count, p)),
        np.empty((count, p)),
    )  # fmt: skip


class Store:
    """Snapshots of consecutive steps, across any number of windows. ``len(store)`` is the number of steps held.

    Attributes
    ----------
    dropped : int
        Steps forgotten so far; step i of the store is step ``dropped + i`` since it began.
    """

    def __init__(self) -> None:
        self.dropped = 0
        self._room = rows(0, 0, 0)
        self._begins: NDArray[np.uint8] = np.zeros(1, np.uint8)
        self._first = 0  # row of the oldest step held
        self._end = 0  # row after the newest one

    def __len__(self) -> int:
        return self._end - self._first

    def __repr__(self) -> str:
        return f"Store({len(self)} steps, windows begin at {self.anchors}, {self.bytes_per_step} bytes per step)"

    @property
    def bytes_per_step(self) -> int:
        """8 (n^2 + 2 n p + 2 p); 0 while the store has seen no step."""
        _, p, n = self._room.e.shape
        return 8 * int(n * n + 2 * n * p + 2 * p)

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
        return self._begins[self._first : self._end + 1]

    @property
    def steps(self) -> Rows:
        """Views of what is held; ``phi`` has K + 1 rows, the others K."""
        a, b = self._first, self._end
        return Rows(self._room.phi[a : b + 1], *(field[a:b] for field in self._room[1:]))

    def reserve(self, n: int, p: int, count: int, phi: Array, steps: int) -> Rows:
        """Room for ``count`` steps after the newest one, to be written and then kept with ``commit``.

        Parameters
        ----------
        phi, steps : (n, n) array and int
            phi_{j,0} and the steps since the anchor of the carry that the new steps continue.

        Raises
        ------
        ValueError
            The carry does not continue the steps held, or n or p have changed.
        """
        if len(self) == 0 and self.dropped == 0:
            self._room = rows(max(FIRST_ROOM, count + 1), n, p)
            self._begins = np.zeros(self._room.phi.shape[0], np.uint8)
            self._room.phi[0] = phi
        elif self._room.e.shape[1:] != (p, n):
            was = self._room.e.shape
            raise ValueError(f"store holds {was[2]} states and {was[1]} noise components, the model has {n} and {p}")
        else:
            self.check(phi, steps)
        if self._end + count + 1 > self._room.phi.shape[0]:
            self._grow(count)
        a = self._end
        return Rows(self._room.phi[a + 1 : a + 1 + count], *(field[a : a + count] for field in self._room[1:]))

    def commit(self, closed: NDArray[np.uint8], steps: int) -> None:
        """Keep the steps just written; ``closed`` (N,) as the forward sweep leaves it, ``steps`` as in ``reserve``."""
        a, count = self._end, closed.size
        if steps == 0 and self._begins[a] == 0:
            self._begins[a] = 3
        self._begins[a + 1 : a + count + 1] = closed & 2
        self._begins[a : a + count] |= closed & 1
        self._end = a + count

    def check(self, phi: Array, steps: int) -> None:
        """Raise ValueError when a carry with this phi_{j,0} does not stand at the newest step."""
        if steps > 0 and not np.array_equal(self._room.phi[self._end], phi):
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
        self._first += before
        self.dropped += before

    def _grow(self, count: int) -> None:
        """Amortised: move to the front when that frees half of the room, otherwise double it."""
        held = len(self)
        need = held + count + 1
        room, begins = self._room, self._begins
        if 2 * need > room.phi.shape[0]:
            _, p, n = room.e.shape
            self._room = rows(2 * need, n, p)
            self._begins = np.zeros(2 * need, np.uint8)
        for old, new in zip(room, self._room, strict=True):
            new[: held + 1] = old[self._first : self._end + 1]
        self._begins[: held + 1] = begins[self._first : self._end + 1]
        self._begins[held + 1 :] = 0
        self._first, self._end = 0, held
