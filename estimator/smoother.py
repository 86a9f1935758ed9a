"""Fixed-interval smoothing: the backward pass of MS-A over stored steps, given everything up to a carry.

Nothing but sums of positive terms is formed on the way back, so variances stay positive; the data travel in g, so no
filtered state and no inverse of a filtered information matrix is needed, and a start without prior is no special case.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from estimator import sweeps
from estimator.information import Carry, factors
from estimator.snapshots import Shape, Store, Stretch
from estimator.ud import Array

NAMED = 3  # directions in the message of ``Unobservable``


class Unobservable(ValueError):
    """Some directions of the state were seen by no measurement and no prior.

    A direction that phi keeps shrinking while process noise feeds it is forgotten in time: over a long record its
    process noise tells its variance, and it does not count as unobservable.

    Attributes
    ----------
    directions : (count, n) array
        Weights of the states in each direction, largest magnitude 1, at the last epoch (at epoch 0 for method
        "watanabe"). They span all that is unknown.
    """

    def __init__(self, directions: Array) -> None:
        self.directions = directions / np.take_along_axis(
            directions, np.argmax(np.abs(directions), axis=1)[:, None], axis=1
        )
        told = "; ".join(_named(direction) for direction in self.directions[:NAMED])
        more = f"; and {self.count - NAMED} more" if self.count > NAMED else ""
        what = "direction" if self.count == 1 else "directions"
        super().__init__(f"no measurement and no prior tells the {what} {told}{more}")

    @property
    def count(self) -> int:
        """How many directions are unknown."""
        return int(self.directions.shape[0])

    @property
    def direction(self) -> Array:
        """The first of them."""
        first: Array = self.directions[0]
        return first


def _named(direction: Array) -> str:
    order = np.argsort(-np.abs(direction), kind="stable")
    return " ".join(f"{direction[i]:+.3g} x[{i}]" for i in order if abs(direction[i]) >= 1e-3)


def unknown_directions(ut: Array, d: Array, faint: float) -> Array:
    """Directions (k, n) about which an information matrix U D U^T says nothing, or nothing but rounding.

    Singular values of diag(L)^{-1/2} U D^{1/2}, whose rows have length 1 (or 0: states nobody has seen, which are plain
    axes of the null space). An oblique unobserved direction leaves a pivot of rounding size and not a zero, so D alone
    does not tell; where it holds a zero, the least known direction is one of them in any case.
    """
    n = d.size
    root = ut.T.astype(np.float64) * np.sqrt(d.astype(np.float64))
    length = np.sqrt((root * root).sum(axis=1))
    seen = length > 0.0
    axes: Array = np.eye(n)[~seen]
    if not seen.any():
        return axes
    left, values, _ = np.linalg.svd(root[seen] / length[seen, None])
    unknown = int((values <= faint * values[0]).sum())
    if not unknown and not axes.size and not (d > 0.0).all():
        unknown = 1
    oblique = np.zeros((unknown, n))
    oblique[:, seen] = (left[:, ::-1][:, :unknown] / length[seen, None]).T
    return np.concatenate([axes, oblique])


class Interval(NamedTuple):
    """Steps ``first``.. smoothed, k of them; what was not asked for has no rows.

    Attributes
    ----------
    mean : (k+1, n) array, or (records, k+1, n)
        Epoch ``first``, where step ``first`` begins, is row 0.
    std : (k+1, n) array
    covariance : (k+1, n, n) array
        Symmetric to the last bit.
    cross : (k, n, n) array
        cov(x_j, x_{j+1}).
    """

    mean: Array
    std: Array
    covariance: Array
    cross: Array


def stretches(
    store: Store,
    carry: Carry,
    first: int,
    std: bool,
    covariance: bool,
    cross: bool,
    room: Callable[[int, int], Interval],
) -> Iterator[tuple[int, Interval]]:
    """Smooth from the newest step to step ``first``, one stretch of the store after the other.

    ``room(a, b)`` gives the arrays for epochs a..b, mean (b-a+1, n, records); they are yielded with a when they are
    full. All epochs are shown once: row 0 of every stretch but the last belongs to the next and is not written.
    """
    n, count = carry.phi.shape[0], len(store)
    if not 0 <= first <= count:
        raise IndexError(f"first is {first}: the store holds {count} steps")
    if count and (store.shape.n, store.shape.records, store.shape.dtype) != (n, carry.d.size - n, carry.d.dtype):
        own = Shape(n, store.shape.p, carry.d.size - n, carry.d.dtype)
        raise ValueError(f"carry has {own.states()}, the store {store.shape.states()}")
    store.check(carry.phi, carry.steps)
    closed_by_hand = carry.steps == 0
    if not closed_by_hand and store.begins[-1]:
        raise ValueError("carry is not the one that the newest step of this store ended with")
    ut, d, phi = factors(carry)
    if not carry.regular or not (d > 0.0).all():
        unknown = unknown_directions(ut[:, -n:], d, sweeps.limits(d.dtype)[1])
        if unknown.size:
            raise Unobservable(unknown @ phi.T)
    x, vt, weight = np.empty((n, ut.shape[1] - n), d.dtype), np.empty((n, n), d.dtype), np.empty(n, d.dtype)
    sweeps.terminal(ut, d, x, vt, weight)
    shape = store.shape if count else Shape(n, 0, x.shape[1], d.dtype)
    last = Stretch(count, shape.rows(0)._replace(phi=phi[None]), np.zeros(1, np.int64), store.begins[-1:])
    for stretch in store.backwards(first) if first < count else [last]:
        rows, begins = stretch.rows, stretch.begins.copy()
        stop = stretch.start + rows.qs.shape[0]
        if closed_by_hand and stop == count:
            begins[-1] = 1  # after the newest step: the store has not heard of it
        out = room(stretch.start, stop)
        sweeps.backward(
            rows.phi, rows.e, stretch.at, rows.b, rows.g, rows.qs, begins, x, vt, weight, float(np.finfo(d.dtype).eps),
            stretch.start == first, std, covariance, cross, *out,
        )  # fmt: skip
        yield stretch.start, out


def backward(
    store: Store, carry: Carry, *, first: int = 0, std: bool = False, covariance: bool = True, cross: bool = False
) -> Interval:
    """Smooth the steps ``first``.. of the store, k of them, given everything up to ``carry``.

    Parameters
    ----------
    store : Store
        Its newest step ends where ``carry`` stands. Windows in it do not matter; it is not changed.
    carry : Carry
        From the last call of ``filter``, or that one anchored.
    first : int
        First step wanted, 0 <= first <= len(store).
    std, covariance, cross : bool
        What is wanted beside the mean. Without any of them no covariance is propagated.

    Raises
    ------
    Unobservable
        Some direction is told by nothing up to ``carry``.
    ValueError
        ``carry`` does not stand at the end of the store.
    IndexError
        ``first`` is negative or beyond the store.
    """
    n, count = carry.phi.shape[0], len(store) - first
    records, dtype = carry.d.size - n, carry.d.dtype
    whole = Interval(
        np.empty((count + 1, n, records), dtype),
        np.empty((count + 1 if std else 0, n), dtype),
        np.empty((count + 1 if covariance else 0, n, n), dtype),
        np.empty((count if cross else 0, n, n), dtype),
    )

    def room(a: int, b: int) -> Interval:
        epochs, steps = slice(a - first, b - first + 1), slice(a - first, b - first)
        return Interval(whole.mean[epochs], whole.std[epochs], whole.covariance[epochs], whole.cross[steps])

    for _ in stretches(store, carry, first, std, covariance, cross, room):
        pass
    mean = whole.mean[:, :, 0] if records == 1 else whole.mean.transpose(2, 0, 1)
    return whole._replace(mean=mean)
