"""What is known of states and parameters, and the snapshots of the way forward."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from estimator import extended
from estimator.extended import B, Carry, K, Model
from estimator.information import factored
from estimator.kinematics import SCALE, WIND
from estimator.ud import Array, Order


class Split(NamedTuple):
    """Which of the n states move (m), and which are parameters (k).

    Attributes
    ----------
    moving (m,), fixed (k,) : numbers of the states (see ``kinematics``), kinematics and their biases last
    fades (m,) : 1 for turbulence, else 0
    driven (p - 6,) : positions in ``moving`` of what noise components 6.. drive
    moving_at (m,), fixed_at (k,) : positions among the named states
    order (n,) : of the factor of ``extended``
    """

    moving: Order
    fixed: Order
    fades: Array
    driven: Order
    moving_at: Order
    fixed_at: Order
    order: Order

    @classmethod
    def of(cls, model: Model) -> Split:
        """Split a model."""
        order = model.order
        moves = ((order >= WIND) & (order < SCALE)) | (order < K)
        places = np.cumsum(moves) - 1
        driven = model.driven[moves[model.driven]]
        told = [*range(K + B), *order[: order.size - K - B].tolist()]
        named = np.array([told.index(number) for number in order.tolist()])
        return cls(order[moves], order[~moves], model.fades[moves], places[driven], named[moves], named[~moves], order)


class Known(NamedTuple):
    """All that is known so far, as arrays that the sweep overwrites.

    Attributes
    ----------
    ut (m, 1+k+m), d (m,) : factor of the state filter; in front its data and, by parameter, what V is made from
    ub (k, 1+k), db (k,) : factor of the bias filter, data in front
    s (m,), v (m, k) : x = s + v b' + phi x*(b'), b' the parameters less ``ref``
    a (7, 7), fade (1,) : phi since the anchor
    x (23,), q (4,), ref (23,) : estimate to linearise at, nominal attitude of all of it, start of the parameters
    b (1+k,) : 1 and the estimate of b'
    clock (2,) : steps since the anchor, anchors since the block began
    """

    ut: Array
    d: Array
    ub: Array
    db: Array
    s: Array
    v: Array
    a: Array
    fade: Array
    x: Array
    q: Array
    ref: Array
    b: Array
    clock: Order

    @classmethod
    def of(cls, model: Model, split: Split, carry: Carry) -> Known:
        """What a carry of ``extended`` knows."""
        m, k = split.moving.size, split.fixed.size
        carry = carry.copy()
        if carry.clock[2] > 0:
            extended.anchor(model, carry, np.empty((K, K)), np.empty(K, np.int64), carry.x[model.order])
        root = np.linalg.inv(carry.ut[:, 1:])
        p = (root / carry.d) @ root.T
        place = [int(np.flatnonzero(model.order == number)[0]) for number in [*split.fixed, *split.moving]]
        p = p[np.ix_(place, place)]
        u, d = factored(0.5 * (p + p.T))
        ut = np.zeros((m, 1 + k + m))
        ut[:, 1 : 1 + k], ut[:, 1 + k :] = -u[:k, k:].T, u[k:, k:].T
        ub = np.zeros((k, 1 + k))
        ub[:, 1:] = u[:k, :k].T
        b = np.zeros(1 + k)
        b[0] = 1.0
        return cls(
            ut, d[k:].copy(), ub, d[:k].copy(), carry.s[place[k:]], np.zeros((m, k)), np.eye(K), np.ones(1), carry.x,
            carry.q, carry.x.copy(), b, np.zeros(2, np.int64),
        )  # fmt: skip

    def copy(self) -> Known:
        """The same in arrays of its own."""
        return Known(*(array.copy() for array in self))  # type: ignore[arg-type]


class Rows(NamedTuple):
    """Snapshots of N steps.

    Attributes
    ----------
    a (N, 7, 7), fade (N,), s (N, m), v (N, m, k) : phi_{j+1,0}, and the offset with its sensitivity
    e (N, 7, 6) : E of the inertial sensors' noise
    k (N, p, m), g (N, p, 1+k), qs (N, p) : b_c, what the data say of it, and weights
    b (N, k), x (N, n), q (N, 4) : parameters and estimate after the step, about attitude q, in the order of the factor
    closed (N,) : number, from 1, of the anchor after the step, else 0
    s_new (W, m), v_new (W, m, k) : offset and sensitivity after an anchor
    """

    a: Array
    fade: Array
    s: Array
    v: Array
    e: Array
    k: Array
    g: Array
    qs: Array
    b: Array
    x: Array
    q: Array
    closed: Order
    s_new: Array
    v_new: Array

    @classmethod
    def empty(cls, count: int, split: Split, window: int) -> Rows:
        """Room for ``count`` steps."""
        m, k, n, p = split.moving.size, split.fixed.size, split.order.size, B + split.driven.size
        anchors = count // window + 1
        return cls(
            np.empty((count, K, K)), np.empty(count), np.empty((count, m)), np.empty((count, m, k)),
            np.empty((count, K, B)), np.empty((count, p, m)), np.empty((count, p, 1 + k)), np.empty((count, p)),
            np.empty((count, k)), np.empty((count, n)), np.empty((count, 4)), np.zeros(count, np.int64),
            np.empty((anchors, m)), np.empty((anchors, m, k)),
        )  # fmt: skip

    def part(self, count: int) -> Rows:
        """Views: room for the first ``count`` steps."""
        return Rows(*(array[:count] for array in self[:12]), *self[12:])  # type: ignore[arg-type, call-arg]
