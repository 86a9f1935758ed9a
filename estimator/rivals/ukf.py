"""The unscented Kalman filter: covariance form, 2 n + 1 points with the parameter kappa [1]_.

With the customary kappa = 3 - n the point in the middle weighs 1 - n/3: less than nothing from four states on, so that
a covariance can lose definiteness by the mathematics alone and not only by rounding. kappa = 0 is the cubature filter.

References
----------
.. [1] S. J. Julier and J. K. Uhlmann, "Unscented filtering and nonlinear estimation", Proc. IEEE 92 (2004) 401-422.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from estimator.rivals.covariance import Kernels, Model, filtered, sigma_kernels, smoothed
from estimator.ud import Array

NAME = "unscented filter"


def kernels(f: Model, h: Model) -> Kernels:
    """Kernels for these models; compiled, and callable from compiled functions, if the models are compiled."""
    return sigma_kernels(f, h)


def usual(n: int, kappa: float | None = None) -> float:
    """3 - n, or what is given.

    Raises
    ------
    ValueError
        n + kappa is not positive.
    """
    chosen = float(3 - n if kappa is None else kappa)
    if not n + chosen > 0.0:
        raise ValueError(f"{NAME}: kappa is {kappa} with {n} states: n + kappa must be positive")
    return chosen


def filter_step(
    mean: ArrayLike, sqrt_cov: ArrayLike, f: Model, h: Model, z: ArrayLike | None, sqrt_q: ArrayLike,
    sqrt_r: ArrayLike, angles: Sequence[int] = (), kappa: float | None = None,
) -> tuple[Array, Array]:  # fmt: skip
    """One step, prediction and update, as ``ckf.filter_step``.

    Parameters
    ----------
    mean, sqrt_cov, f, h, z, sqrt_q, sqrt_r, angles
        See ``ckf.filter_step``.
    kappa : float, optional
        More than -n; 3 - n if not given.

    Raises
    ------
    ArithmeticError
        A covariance is not positive definite.
    FloatingPointError
        A model gave a number that is not finite.
    ValueError
        n + kappa is not positive.
    """
    chosen = usual(np.shape(mean)[0], kappa)
    return filtered(kernels(f, h), NAME, (f, h), mean, sqrt_cov, z, sqrt_q, sqrt_r, angles, chosen)


def smooth_step(
    mean: ArrayLike, sqrt_cov: ArrayLike, f: Model, sqrt_q: ArrayLike, next_mean: ArrayLike,
    next_sqrt_cov: ArrayLike, kappa: float | None = None,
) -> tuple[Array, Array]:  # fmt: skip
    """One step back, as ``ckf.smooth_step``; ``kappa`` as of the filter."""
    chosen = usual(np.shape(mean)[0], kappa)
    return smoothed(kernels(f, f), NAME, f, mean, sqrt_cov, sqrt_q, next_mean, next_sqrt_cov, chosen)
