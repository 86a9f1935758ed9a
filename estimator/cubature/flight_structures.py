"""What the cubature filter of the flight path is given, carries along and keeps."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from estimator.extended import Model
from estimator.kinematics import STATES, TURBULENCE, Earth, M
from estimator.ud import Array, Order

K, B = 7, 6  # kinematic states, and the biases that drive them
TURN = 3  # the rotation: what a step is not linear in, given that
FLOW = 12  # at most: flow without gusts, gusts, rotation, scale error and slopes, in which the vanes are not linear
SPARE = 6  # rows of what the regression of a measurement leaves: three of the air data, three of the rotation


class Layout(NamedTuple):
    """What does not change from step to step.

    States stand in the order of the factor: those that stay as they are first, then biases, turbulence and kinematics,
    so that a step changes the last columns of the factor only::

        [kV, b_alpha, b_beta (k_alpha, k_beta), W | ba, bg | T | h, V, a]

    Attributes
    ----------
    order : (n,) array
        Numbers of the states (see ``kinematics``).
    at : (23,) array
        Their places by number, -1 where a state is not estimated.
    named : (n,) array
        Places of the named states.
    fades : (n,) array
        1 for turbulence, else 0.
    driven : (p - 6,) array
        Places that noise components 6.. drive; the first six are the inertial sensors'.
    vane, antenna : (3,) arrays
        From the inertial sensors, body axes, m.
    earth : Earth
    deaf : bool
        Alpha and beta are not asked for the airspeed (`kinematics.deafen`).
    """

    order: Order
    at: Order
    named: Order
    fades: Array
    driven: Order
    vane: Array
    antenna: Array
    earth: Earth
    deaf: bool

    @classmethod
    def of(cls, model: Model) -> Layout:
        """The same model with its states in the order of the cubature filter."""
        tail = model.order[: model.order.size - K - B]
        gusts = (tail >= TURBULENCE) & (tail < TURBULENCE + 3)
        order = np.array([*tail[~gusts], *range(K, K + B), *tail[gusts], *range(K)], np.int64)
        at = np.full(STATES, -1, np.int64)
        at[order] = np.arange(order.size)
        fades = ((order >= TURBULENCE) & (order < TURBULENCE + 3)).astype(np.float64)
        named = at[np.array([*range(K + B), *tail], np.int64)]
        driven = at[model.order[model.driven]]
        return cls(order, at, named, fades, driven, model.vane, model.antenna, model.earth, model.deaf)

    @property
    def most(self) -> int:
        """How many of the last states a step may change."""
        return int(self.order.size - min(self.order.size - K, *self.driven.tolist(), self.order.size - K))


class Carry(NamedTuple):
    """All that is known so far, as arrays that the sweep overwrites.

    Attributes
    ----------
    x (23,), q (4,) : estimate, its rotation about the nominal attitude q
    root (n, n) : S^T, upper triangular with diagonal >= 0; covariance S S^T, in the order of `Layout`
    gate (10, 3), doubt (3, 3) : rejections in a row, their recent number and that of all; variance to be added
    clock (2,) : s since the start; s of wide gates left
    cost (3,) : sum of NIS, of log S, and the number of scalars
    """

    x: Array
    q: Array
    root: Array
    gate: Array
    doubt: Array
    clock: Array
    cost: Array

    def copy(self) -> Carry:
        """The same knowledge in arrays of its own."""
        return Carry(*(array.copy() for array in self))

    @classmethod
    def begin(cls, layout: Layout, x: Array, q: Array, covariance: Array, order: Order) -> Carry:
        """What is known at the start, ``covariance`` (n, n) of the states ``order``."""
        place = np.empty(STATES, np.int64)
        place[order] = np.arange(order.size)
        pick = place[layout.order]
        root = np.ascontiguousarray(np.linalg.cholesky(covariance[np.ix_(pick, pick)]).T)
        return cls(x.copy(), q.copy(), root, np.zeros((M, 3)), np.zeros((3, 3)), np.zeros(2), np.zeros(3))


class Rows(NamedTuple):
    """Snapshots of N steps: what leads back from the state after a step to that before it.

    x_j = x_{j/j} + W (x_{j+1} - x_{j+1/j}) + L22 xi: W is one for the states that the step leaves as they are. Of the
    c others, the last, their rows stand here, transposed.

    Attributes
    ----------
    x (N, n), q (N, 4) : filter estimate after the step, and its nominal attitude
    predicted (N, n) : before the measurements
    changed (N,) : c
    gain (N, n, c), left (N, c, c) : W^T and L22^T, in the first c columns
    """

    x: Array
    q: Array
    predicted: Array
    changed: Order
    gain: Array
    left: Array

    @classmethod
    def empty(cls, count: int, n: int, most: int) -> Rows:
        """Room for ``count`` steps."""
        return cls(
            np.empty((count, n)), np.empty((count, 4)), np.empty((count, n)), np.empty(count, np.int64),
            np.empty((count, n, most)), np.empty((count, most, most)),
        )  # fmt: skip

    def part(self, first: int, stop: int) -> Rows:
        """The steps first..stop-1: views."""
        return Rows(*(array[first:stop] for array in self))  # type: ignore[arg-type]


class Desk(NamedTuple):
    """Scratch of a step: allocated once."""

    x1: Array  # (23,)
    q1: Array  # (4,)
    phi: Array  # (7, 7)
    b: Array  # (7, 6)
    mean: Array  # (7,)
    z: Array  # (n + 12, 12) marginal factors
    plus: Array  # (10,)
    minus: Array  # (10,)
    centre: Array  # (10,)
    odd: Array  # (12, 10)
    even: Array  # (12, 10)
    slope: Array  # (12, 10)
    moved: Array  # (13, 8) transition of biases and kinematics, transposed, one column to spare
    fresh: Array  # (n, 8) images of the columns of S, one column to spare
    top: Array  # (n, n + n)
    below: Array  # (7 + p, n + n)
    noise: Array  # (9, 7)
    y: Array  # (10,)
    h: Array  # (10, 23)
    seen: Array  # (n, 10): S^T H^T
    spare: Array  # (6, 10)
    pivot: Array  # (10 + n,)
    point: Array  # (12,)
    std: Array  # (n,)
    lost: Array  # (3,)
    work: Array  # (200,)


def desk(n: int, p: int) -> Desk:
    """Allocate scratch."""
    shapes = (
        (STATES,), (4,), (K, K), (K, B), (K,), (n + FLOW, FLOW), (M,), (M,), (M,), (FLOW, M), (FLOW, M), (FLOW, M),
        (K + B, K + 1), (n, K + 1), (n, 2 * n), (K + p, 2 * n), (TURN + B, K), (M,), (M, STATES), (n, M), (SPARE, M),
        (M + n,), (FLOW,), (n,), (3,), (200,),
    )  # fmt: skip
    return Desk(*(np.zeros(shape) for shape in shapes))
