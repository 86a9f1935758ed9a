"""What the extended smoother is given, carries along, keeps and tells."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimator.kinematics import STATES, Earth, M
from estimator.ud import Array, Order

Flags = NDArray[np.uint8]

K, B = 7, 6  # kinematic states, and the biases that drive them
WALKS = 11  # noise components; with more of them, biases walk
ABSENT, USED, WEAKENED, REJECTED = 0, 1, 2, 3  # what became of a scalar


class Model(NamedTuple):
    """What does not change from step to step.

    Attributes
    ----------
    order : (n,) array
        Numbers of the states (see ``kinematics``) in the order of the factor.
    fades : (n,) array
        1 for turbulence, else 0.
    driven : (p - 6,) array
        Positions in ``order`` of the states that noise components 6.. drive; the first six are the inertial sensors'.
    vane, antenna : (3,) arrays
        From the inertial sensors, body axes, m.
    earth : Earth
    wind : int
        Number of the first state that a pass about a trajectory predicts: WIND, or TURBULENCE.
    deaf : bool
        Alpha and beta are not asked for the airspeed (`kinematics.deafen`).
    """

    order: Order
    fades: Array
    driven: Order
    vane: Array
    antenna: Array
    earth: Earth
    wind: int
    deaf: bool = False


class Drive(NamedTuple):
    """N steps.

    Attributes
    ----------
    dt : (N,) array
        s.
    u : (N, 6) array
        Specific force and angular rate, means over the step.
    q : (N, p) array
        Variances of the noise components.
    fade : (N,) array
        exp(-dt / tau) of turbulence.
    z, r : (N, 10) arrays
        Measurements at the end of the step, NaN = absent, and their variances.
    bridged : (N,) array
        1 where the inertial data were made up.
    shown : (N,) array
        1 where standard deviations are wanted.
    """

    dt: Array
    u: Array
    q: Array
    fade: Array
    z: Array
    r: Array
    bridged: Flags
    shown: Flags

    def part(self, first: int, stop: int) -> Drive:
        """The steps first..stop-1: views."""
        return Drive(*(column[first:stop] for column in self))  # type: ignore[arg-type]

    @classmethod
    def join(cls, parts: list[Drive]) -> Drive:
        """All steps, one part after the other."""
        return cls(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


class Carry(NamedTuple):
    """All that is known so far, as arrays that the sweep overwrites.

    Attributes
    ----------
    ut (n, 1+n), d (n,) : factor of the information, data in front
    s (n,), x (23,), q (4,) : offset, estimate, and the nominal attitude of both
    a (7, 7), b (7, 6), fade (1,) : the blocks of phi_{j,0}
    gate (10, 3), doubt (3, 3) : rejections in a row, their recent number and that of all; variance to be added
    clock (3,) : s since the start; s of wide gates left; steps since the anchor
    cost (3,) : sum of NIS, of log S, and the number of scalars
    """

    ut: Array
    d: Array
    s: Array
    x: Array
    q: Array
    a: Array
    b: Array
    fade: Array
    gate: Array
    doubt: Array
    clock: Array
    cost: Array

    def copy(self) -> Carry:
        """The same knowledge in arrays of its own."""
        return Carry(*(array.copy() for array in self))


class Rows(NamedTuple):
    """Snapshots of N steps: Table 5 of Shi's paper, the offset, and the estimate, which is the offset after an anchor.

    Attributes
    ----------
    a (N, 7, 7), b (N, 7, 6), fade (N,) : phi_{j+1,0}
    e (N, 7, 6), w (N|0, 7, 6) : E of the inertial sensors' noise and, where biases walk, of theirs
    k (N, p, n), g (N, p), qs (N, p) : b_c, g_c and their weights
    s (N, n), x (N, n), q (N, 4) : offset, filter estimate, nominal attitude
    closed (N,) : 1 where a window ends after the step
    """

    a: Array
    b: Array
    fade: Array
    e: Array
    w: Array
    k: Array
    g: Array
    qs: Array
    s: Array
    x: Array
    q: Array
    closed: Flags

    @classmethod
    def empty(cls, count: int, n: int, p: int) -> Rows:
        """Room for ``count`` steps."""
        walk = count if p > WALKS else 0
        return cls(
            np.empty((count, K, K)), np.empty((count, K, B)), np.empty(count), np.empty((count, K, B)),
            np.empty((walk, K, B)), np.empty((count, p, n)), np.empty((count, p)), np.empty((count, p)),
            np.empty((count, n)), np.empty((count, n)), np.empty((count, 4)), np.zeros(count, np.uint8),
        )  # fmt: skip

    def part(self, first: int, stop: int) -> Rows:
        """The steps first..stop-1: views."""
        return Rows(*(array[first:stop] for array in self))  # type: ignore[arg-type]


class Told(NamedTuple):
    """What the filter says of N steps.

    Attributes
    ----------
    std (N, n) : of the named states, in their order; written where ``Drive.shown``
    innovation (N, 10) : divided by its standard deviation, NaN = absent
    status (N, 10) : ABSENT, USED, WEAKENED or REJECTED
    r (N, 10) : variances that were used
    doubted (N,) : bit 1, 2 or 4 where the filter was doubted about velocity, attitude or turbulence
    """

    std: Array
    innovation: Array
    status: Flags
    r: Array
    doubted: Flags

    @classmethod
    def empty(cls, count: int, n: int) -> Told:
        """Room for ``count`` steps."""
        return cls(
            np.full((count, n), np.nan), np.empty((count, M)), np.zeros((count, M), np.uint8), np.empty((count, M)),
            np.zeros(count, np.uint8),
        )  # fmt: skip

    def part(self, first: int, stop: int) -> Told:
        """The steps first..stop-1: views."""
        return Told(*(column[first:stop] for column in self))  # type: ignore[arg-type]

    @classmethod
    def join(cls, parts: list[Told]) -> Told:
        """All steps, one part after the other."""
        return cls(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


class About(NamedTuple):
    """A trajectory to linearise about: N + 1 epochs, N steps.

    Attributes
    ----------
    x (N+1, 23), q (N+1, 4) : states, rotation zero, and attitudes
    w (N, 6) : noise of the inertial sensors
    status, r (N, 10) : what the first pass decided about every scalar
    doubted (N,) : where it doubted the filter, and about what
    """

    x: Array
    q: Array
    w: Array
    status: Flags
    r: Array
    doubted: Flags

    @classmethod
    def nothing(cls) -> About:
        """No trajectory: the filter linearises at its own estimates."""
        return cls(
            np.empty((0, STATES)),
            np.empty((0, 4)),
            np.empty((0, B)),
            np.empty((0, M), np.uint8),
            np.empty((0, M)),
            np.empty(0, np.uint8),
        )
