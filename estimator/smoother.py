"""Fixed-interval smoothing: the backward pass of MS-A over stored steps, given everything up to a carry.

Nothing but sums of positive terms is formed on the way back, so variances stay positive; the data travel in g, so no
filtered state and no inverse of a filtered information matrix is needed, and a start without prior is no special case.
"""

from __future__ import annotations

import numpy as np

from estimator import sweeps
from estimator.information import Carry
from estimator.snapshots import Store
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
    u, d = carry.u[1:, 1:], carry.d[1:]
    root = u * np.sqrt(d)
    length = np.sqrt((root * root).sum(axis=1))
    scale = np.where(length > 0.0, length, 1.0)
    left, values, _ = np.linalg.svd(root / scale[:, None])
    count = int((values <= sweeps.FAINT * values[0]).sum()) if values[0] > 0.0 else d.size
    direction = left[:, -1] / scale
    if (length == 0.0).any():  # such states are axes of the null space, and its plainest members
        direction = (length == 0.0) * (np.cumsum(length == 0.0) == 1) * 1.0
    direction = carry.phi @ direction
    return direction / direction[np.argmax(np.abs(direction))], count


def backward(store: Store, carry: Carry, *, first: int = 0, covariance: bool = True) -> tuple[Array, Array]:
    """Smooth the steps ``first``.. of the store, k of them, given everything up to ``carry``.

    Parameters
    ----------
    store : Store
        Its newest step ends where ``carry`` stands. Windows in it do not matter; it is not changed.
    carry : Carry
        From the last call of ``filter``, or that one anchored.
    first : int
        First step wanted, 0 <= first <= len(store).
    covariance : bool
        False returns standard deviations instead, for about two thirds of the time.

    Returns
    -------
    mean : (k+1, n) array
        Epoch ``first``, where step ``first`` begins, is row 0.
    covariance : (k+1, n, n) array, symmetric to the last bit; or standard deviations, (k+1, n) array

    Raises
    ------
    Unobservable
        Some direction is told by nothing up to ``carry``.
    ValueError
        ``carry`` does not stand at the end of the store.
    IndexError
        ``first`` is negative or beyond the store.
    """
    n, count = carry.d.size - 1, len(store)
    if not 0 <= first <= count:
        raise IndexError(f"first is {first}: the store holds {count} steps")
    begins = store.begins[first:].copy()
    steps = store.steps
    if steps.phi.shape[0] == 0:
        phi, e, b, g, qs = np.array(carry.phi)[None], *(np.empty((0, *field.shape[1:])) for field in steps[1:])
    else:
        if steps.phi.shape[1] != n:
            raise ValueError(f"carry has {n} states, the store {steps.phi.shape[1]}")
        store.check(carry.phi, carry.steps)
        phi, e, b, g, qs = steps.phi[first:], *(field[first:] for field in steps[1:])
    if carry.steps == 0:
        begins[-1] = 1  # closed by hand after the newest step: the store has not heard of it
    elif begins[-1]:
        raise ValueError("carry is not the one that the newest step of this store ended with")
    if not carry.regular or not (carry.d[1:] > 0.0).all():
        direction, unknown = unobserved(carry)
        if unknown or not (carry.d[1:] > 0.0).all():
            raise Unobservable(direction, max(unknown, 1))
    x, vt, d = np.empty(n), np.empty((n, n)), np.empty(n)
    sweeps.terminal(np.array(carry.u.T, order="C"), np.array(carry.d), x, vt, d)
    mean, std = np.empty((count - first + 1, n)), np.empty((count - first + 1, n))
    square = np.empty((count - first + 1, n, n) if covariance else (0, n, n))
    sweeps.backward(phi, e, b, g, qs, begins, x, vt, d, covariance, mean, std, square)
    return mean, square if covariance else std
