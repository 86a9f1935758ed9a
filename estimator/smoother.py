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


class Unobservable(ValueError):
    """Some direction of the state was seen by no measurement and no prior.

    A direction that phi keeps shrinking while process noise feeds it is forgotten in time: over a long record its
    process noise tells its variance, and it does not count as unobservable.

    Attributes
    ----------
    direction : (n,) array
        Weights of the states in that direction, at the last epoch, largest magnitude 1.
    count : int
        Number of such directions; ``direction`` is the one about which least is known.
    """

    def __init__(self, direction: Array, count: int) -> None:
        self.direction, self.count = direction, count
        order = np.argsort(-np.abs(direction), kind="stable")
        named = [f"{direction[i]:+.3g} x[{i}]" for i in order if abs(direction[i]) >= 1e-3]
        more = f" (and {count - 1} more)" if count > 1 else ""
        super().__init__(f"no measurement and no prior tells the direction {' '.join(named)}{more}")


def unobserved(carry: Carry) -> tuple[Array, int]:
    """The least known direction (n,) at the present epoch, and how many directions are not known at all.

    Singular values of diag(L)^{-1/2} U D^{1/2}, whose rows have length 1 (or 0: a state nobody has seen). An oblique
    unobserved direction leaves a pivot of rounding size and not a zero, so D alone does not tell.
    """
    ut, d, phi = (array.astype(np.float64) for array in factors(carry))
    n = d.size
    root = ut[:, -n:].T * np.sqrt(d)
    length = np.sqrt((root * root).sum(axis=1))
    scale = np.where(length > 0.0, length, 1.0)
    left, values, _ = np.linalg.svd(root / scale[:, None])
    faint = sweeps.limits(carry.d.dtype)[1]
    count = int((values <= faint * values[0]).sum()) if values[0] > 0.0 else n
    direction = left[:, -1] / scale
    if (length == 0.0).any():  # such states are axes of the null space, and its plainest members
        direction = (length == 0.0) * (np.cumsum(length == 0.0) == 1) * 1.0
    direction = phi @ direction
    return direction / direction[np.argmax(np.abs(direction))], count


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
    if count and store.shape.n != n:
        raise ValueError(f"carry has {n} states, the store {store.shape.n}")
    store.check(carry.phi, carry.steps)
    closed_by_hand = carry.steps == 0
    if not closed_by_hand and store.begins[-1]:
        raise ValueError("carry is not the one that the newest step of this store ended with")
    ut, d, phi = factors(carry)
    if not carry.regular or not (d > 0.0).all():
        direction, unknown = unobserved(carry)
        if unknown or not (d > 0.0).all():
            raise Unobservable(direction, max(unknown, 1))
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
