"""What every rival does before and after its sweeps: arguments in, `Smoothed` out, and what to say when it cannot."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimator import noise
from estimator.linear import Smoothed
from estimator.model import LinearModel
from estimator.ud import Array

SEMIDEFINITE = 1e-12  # of its diagonal entry: a pivot of p0 closer to zero than that is zero


def measurements(model: LinearModel, z: ArrayLike) -> Array:
    """Return z (N, m) of the model's type, NaN = missing: one record."""
    data = model.measurements(z)
    if data.ndim != 2:
        raise ValueError(f"z has shape {data.shape}, (N, {model.m}) is needed: one record")
    return data


def prior(method: str, model: LinearModel, x0: ArrayLike | None, p0: ArrayLike | None) -> tuple[Array, Array]:
    """Return mean (n,) and covariance (n, n), float64 and free to be overwritten.

    Raises
    ------
    ValueError
        There is none; a shape does not fit; an entry is not finite, or not in the type of the model; p0 is not
        symmetric and positive semidefinite.
    """
    if x0 is None or p0 is None:
        raise ValueError(
            f"method {method!r} needs x0 and p0: a covariance cannot hold 'no prior information'; 'ms' can"
        )
    mean, covariance = np.array(x0, np.float64), np.array(p0, np.float64, order="C")
    if covariance.ndim == 1:
        covariance = np.diag(covariance)
    n = model.n
    if mean.shape != (n,) or covariance.shape != (n, n):
        raise ValueError(f"x0 has shape {mean.shape} and p0 {covariance.shape}, ({n},) and ({n}, {n}) are needed")
    covariance = np.ascontiguousarray(covariance)
    if not (np.isfinite(mean).all() and np.isfinite(covariance).all()):
        way_out = "; only 'ms' takes an infinite variance" if np.isposinf(covariance.diagonal()).any() else ""
        raise ValueError(f"x0 or p0 is not finite{way_out}")
    with np.errstate(over="ignore"):
        if not all(np.isfinite(a.astype(model.dtype)).all() for a in (mean, covariance)):
            raise ValueError(f"x0 or p0 is not finite in {model.dtype}")
    factors(covariance, covariance.dtype)
    return mean, covariance


def factors(p0: Array, dtype: np.dtype[np.float64]) -> tuple[Array, Array]:
    """U^T (n, n) and D (n,) of p0 = U diag(D) U^T, which may be singular. Factored in float64, then converted."""
    u, d = np.empty_like(p0), np.empty(p0.shape[0])
    if not noise.factored(p0, SEMIDEFINITE, False, u, d):
        raise ValueError("p0 is not symmetric and positive semidefinite")
    return np.array(u.T, dtype, order="C"), d.astype(dtype)


class Room(NamedTuple):
    """What the sweeps write: arrays over the epochs (``cross``: the steps), of length 0 where nothing is wanted."""

    mean: Array
    variance: Array
    covariance: Array
    cross: Array
    filtered_mean: Array
    filtered_variance: Array

    @classmethod
    def of(cls, wanted: frozenset[str], steps: int, n: int, dtype: np.dtype[np.float64]) -> Room:
        """Unwritten arrays for N steps of n states."""
        std, full, live = ((steps + 1) * (name in wanted) for name in ("std", "covariance", "filtered"))
        cross = steps * ("cross" in wanted)
        return cls(
            np.empty((steps + 1, n), dtype), np.empty((std, n), dtype), np.empty((full, n, n), dtype),
            np.empty((cross, n, n), dtype), np.empty((live, n), dtype), np.empty((live, n), dtype),
        )  # fmt: skip

    def lost(self) -> NDArray[np.int64]:
        """Epochs whose smoothed estimate, or the part of it that is wanted, is not finite."""
        lost = ~np.isfinite(self.mean)
        second = self.variance
        if not second.shape[0]:
            second = np.einsum("jii->ji", self.covariance if self.covariance.shape[0] else self.cross)
        lost[: second.shape[0]] |= ~np.isfinite(second)
        return np.flatnonzero(lost.any(axis=1))

    def smoothed(self, numbers: int) -> Smoothed:
        """Deviations for variances; ``numbers`` per step went from one sweep to the other. One window, whatever N."""
        return Smoothed(
            mean=self.mean,
            covariance=self.covariance,
            std=deviations(self.variance),
            filtered_mean=self.filtered_mean,
            filtered_std=deviations(self.filtered_variance),
            windows=[0] if self.mean.shape[0] > 1 else [],
            bytes_per_step=self.mean.itemsize * numbers,
            cross=self.cross,
        )


def deviations(variance: Array) -> Array:
    """Standard deviations; NaN for a variance that rounding has made negative."""
    return np.sqrt(np.where(variance >= 0.0, variance, variance.dtype.type(np.nan)))


def too_large(what: str, step: int) -> ValueError:
    """Numbers have run out on the way forward; no method would have more of them."""
    return ValueError(
        f"{what} is no longer finite at step {step}: check the units of phi, q and r there; a direction that phi "
        "stretches and no measurement tells does it too: then end the record before that step"
    )
