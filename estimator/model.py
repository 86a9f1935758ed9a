"""`LinearModel`: a linear Gaussian system, checked once and ready for compiled code.

The system, for j = 0..N-1:

    x_{j+1} = phi_j x_j + gamma_j w_j           w_j ~ N(0, Q_j)
    z_j     = h_j x_{j+1} + v_j                 v_j ~ N(0, R_j)
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, DTypeLike

from estimator import noise
from estimator.ud import Array, compiled

TOLERANCE = 1e-12  # of its diagonal entry: a pivot of Q closer to zero than that is zero


@compiled
def _first_bad(array: Array, floor: int) -> int:
    """First row of ``array`` (k, size) that is not finite, is negative (floor 1) or not positive (floor 2); or -1."""
    for i in range(array.shape[0]):
        for j in range(array.shape[1]):
            value = array[i, j]
            if not abs(value) < np.inf or (floor == 1 and value < 0.0) or (floor == 2 and value <= 0.0):
                return i
    return -1


def _contiguous(value: ArrayLike, name: str, dtype: DTypeLike) -> Array:
    """C-contiguous; a read-only array is copied, because compiled code counts it as another type."""
    try:
        array = np.asarray(value, dtype, order="C")
    except (TypeError, ValueError):
        raise ValueError(f"{name} is not an array of numbers") from None
    return array if array.flags.writeable else array.copy()


class LinearModel:
    """A linear Gaussian system, constant or varying from step to step.

    Parameters
    ----------
    phi : (n, n) or (N, n, n) array
        Transition of step j.
    gamma : (n, p) or (N, n, p) array
        Noise input.
    q : (p,) or (N, p) variances, or (p, p), (1, p, p) or (N, p, p) covariances
        Process noise; zero is allowed.
    h : (m, n) or (N, m, n) array
        Measurement.
    r : (m,) or (N, m) variances, or (m, m), (1, m, m) or (N, m, m) covariances
        Measurement noise, positive.
    dtype : float64 or float32
        Of everything that is computed. In float32 standard deviations are right to about five digits; a mean only when
        the states are deviations, not large numbers that near-perfect measurements tell apart.

    Attributes
    ----------
    n, p, m : int
    steps : int or None
        N, or None when nothing varies.
    dtype : numpy dtype
    phi, gamma, q, h, r : arrays
        With a leading axis of 1 or N. Correlated process noise is absorbed: gamma <- gamma U_Q, q (.., p) its pivots.

    Raises
    ------
    ValueError
        A shape does not fit, an entry is not finite, Q is indefinite or R not positive definite: argument and step.
        (A singular phi is a fair model; the methods that invert it say so.)

    Notes
    -----
    A square two-dimensional q or r is one covariance. Only when the other arguments say that there are exactly as many
    steps could it be rows of variances as well: it is, when it is not symmetric or all entries are equal, and otherwise
    it is refused. With a leading axis, (1, p, p) or (N, p, p), there is nothing to interpret.
    """

    __slots__ = ("dtype", "gamma", "h", "m", "n", "p", "phi", "q", "r", "steps", "tables", "taken")

    def __init__(
        self,
        phi: ArrayLike,
        gamma: ArrayLike,
        q: ArrayLike,
        h: ArrayLike,
        r: ArrayLike,
        *,
        dtype: DTypeLike = np.float64,
    ) -> None:
        self.dtype = np.dtype(dtype)
        if self.dtype not in (np.float64, np.float32):
            raise ValueError(f"dtype is {self.dtype}: float64 or float32 is needed")
        self.tables: dict[object, object] = {}  # what ``coordinates`` works out once for a constant model,
        self.taken = 0  # and the steps taken without
        self.phi = _stacked(phi, "phi", "n, n", self.dtype)
        self.gamma = _stacked(gamma, "gamma", "n, p", self.dtype)
        self.h = _stacked(h, "h", "m, n", self.dtype)
        self.n, self.p, self.m = self.phi.shape[2], self.gamma.shape[2], self.h.shape[1]
        for name, array, shape in (
            ("phi", self.phi, (self.n, self.n)),
            ("gamma", self.gamma, (self.n, self.p)),
            ("h", self.h, (self.m, self.n)),
        ):
            if array.shape[1:] != shape:
                raise ValueError(f"{name} has shape {array.shape[1:]} per step, {shape} is needed")
        self.q, self.r = _contiguous(q, "q", self.dtype), _contiguous(r, "r", self.dtype)
        lengths = {"phi": np.ndim(phi) == 3, "gamma": np.ndim(gamma) == 3, "h": np.ndim(h) == 3}
        self.steps = None
        for name, array, varies in (
            ("phi", self.phi, lengths["phi"]),
            ("gamma", self.gamma, lengths["gamma"]),
            ("h", self.h, lengths["h"]),
            ("q", self.q, _varies(self.q)),
            ("r", self.r, _varies(self.r)),
        ):
            if varies:
                if self.steps is not None and array.shape[0] != self.steps:
                    raise ValueError(f"{name} is given for {array.shape[0]} steps, others for {self.steps}")
                self.steps = array.shape[0]
        self.q = _spread(self.q, "q", self.p, self.steps)
        self.r = _spread(self.r, "r", self.m, self.steps)
        self._check()

    def _check(self) -> None:
        for name in ("phi", "gamma", "q", "h", "r"):
            array = getattr(self, name)
            floor = {"q": 1, "r": 2}.get(name, 0) if array.ndim == 2 else 0
            count = array.shape[0]
            step = _first_bad(array.reshape(count, array.size // max(count, 1)), floor)
            if step >= 0:
                row = array[step]
                wrong = "not finite" if not np.isfinite(row).all() else "negative" if floor == 1 else "not positive"
                raise ValueError(f"{name} is {wrong} at step {step}")
        if self.q.ndim == 3:
            count = max(self.q.shape[0], self.gamma.shape[0])
            gamma, q = np.empty((count, self.n, self.p), self.dtype), np.empty((count, self.p), self.dtype)
            step = noise.absorb(self.q, self.gamma, TOLERANCE * self.coarse, gamma, q)
            if step >= 0:
                raise ValueError(f"q is not symmetric and positive semidefinite at step {step}")
            self.gamma, self.q = gamma, q
        if self.r.ndim == 3:
            step = noise.definite(self.r, TOLERANCE * self.coarse)
            if step >= 0:
                raise ValueError(f"r is not symmetric and positive definite at step {step}")

    @property
    def eps(self) -> float:
        """The rounding unit of ``dtype``."""
        return float(np.finfo(self.dtype).eps)

    @property
    def coarse(self) -> float:
        """How many times coarser ``dtype`` is than float64: 1, or 5e8."""
        return float(self.eps / np.finfo(np.float64).eps)

    def __repr__(self) -> str:
        steps = "constant" if self.steps is None else f"{self.steps} steps"
        return f"LinearModel(n={self.n}, p={self.p}, m={self.m}, {steps})"

    def cut(self, first: int, stop: int) -> LinearModel:
        """The model of the steps first..stop-1 alone: views, nothing checked again. A constant model is its own cut."""
        if self.steps is None:
            return self
        if not 0 <= first <= stop <= self.steps:
            raise IndexError(f"steps {first}..{stop} of a model of {self.steps} steps")
        part = LinearModel.__new__(LinearModel)
        part.n, part.p, part.m, part.steps, part.dtype = self.n, self.p, self.m, stop - first, self.dtype
        part.tables, part.taken = {}, 0
        for name in ("phi", "gamma", "q", "h", "r"):
            array = getattr(self, name)
            setattr(part, name, array[first:stop] if array.shape[0] == self.steps else array)
        return part

    def measurements(self, z: ArrayLike) -> Array:
        """``z`` as a contiguous (N, m) or (records, N, m) array; ValueError when it does not fit the model."""
        array = _contiguous(z, "z", self.dtype)
        if array.ndim not in (2, 3) or array.shape[-1] != self.m:
            raise ValueError(f"z has shape {array.shape}, (N, {self.m}) is needed, or (K, N, {self.m}) for K records")
        if array.ndim == 3 and array.shape[0] == 0:
            raise ValueError(f"z has no records: (K, N, {self.m}) with K of at least 1 is needed")
        if self.steps is not None and array.shape[-2] != self.steps:
            raise ValueError(f"z has {array.shape[-2]} rows, the model {self.steps} steps")
        if np.isinf(array).any():
            step = np.flatnonzero(np.isinf(array).any(axis=-1).reshape(-1, array.shape[-2]).any(axis=0))[0]
            raise ValueError(f"z is infinite at step {step}; a missing measurement is NaN")
        if array.ndim == 3 and (np.isnan(array) != np.isnan(array[0])).any():
            raise ValueError("z: records that are filtered together miss the same measurements")
        return array

    def whitened(self, z: Array) -> tuple[Array, Array, Array]:
        """Return h (1|N, m, n), variances r (1|N, m) and z as given, the correlation of r absorbed."""
        if self.r.ndim == 2:
            return self.h, self.r, z
        one = z[0] if z.ndim == 3 else z
        constant = self.r.shape[0] == self.h.shape[0] == 1 and not np.isnan(one).any()
        count = 1 if constant else one.shape[0]
        h, r = np.empty((count, self.m, self.n), self.dtype), np.empty((count, self.m), self.dtype)
        white = np.array(z, order="C")
        noise.whiten(self.r, self.h, one, h, r, white.reshape(-1, *one.shape))
        return h, r, white


def _stacked(value: ArrayLike, name: str, shape: str, dtype: DTypeLike) -> Array:
    array = _contiguous(value, name, dtype)
    if array.ndim == 2:
        return array[None].copy()  # what is worked out from a constant model must not be left behind by its caller
    if array.ndim != 3:
        raise ValueError(f"{name} has shape {array.shape}, ({shape}) or (N, {shape}) is needed")
    return array


def _varies(array: Array) -> bool:
    """Does the shape of q or r alone say that it is given per step?"""
    return (array.ndim == 3 and array.shape[0] != 1) or (array.ndim == 2 and array.shape[0] != array.shape[1])


def _spread(array: Array, name: str, size: int, steps: int | None) -> Array:
    """Give q or r its leading axis: (1|N, size) variances or (1|N, size, size) covariances."""
    shape = array.shape
    if shape == (size,):
        return array[None]
    if array.ndim == 3 and shape[1:] == (size, size):
        return array
    if array.ndim == 2 and shape[1] == size:
        if shape[0] != size:
            return array
        if size == 1 or (steps == size and bool((array == array[0, 0]).all())):
            return array
        if steps != size:
            return array[None]
        if np.allclose(array, array.T, rtol=1e-9, atol=0.0):
            raise ValueError(
                f"{name} has shape {shape} beside {steps} steps: one covariance is written (1, {size}, {size}), "
                f"rows of variances (N, {size}, {size})"
            )
        return array
    raise ValueError(f"{name} has shape {shape}: ({size},) or ({size}, {size}), or N of them, is needed")
