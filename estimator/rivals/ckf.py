"""The plain cubature Kalman filter: covariance form, a Cholesky factor at every step, P - K Pzz K^T [1]_.

Algebraically what ``estimator.cubature`` is in square-root form. It stops, with an ArithmeticError that says where,
when rounding has taken definiteness from a covariance: nearly collinear accurate measurements, a wide prior with very
accurate measurements, float32.

References
----------
.. [1] I. Arasaratnam and S. Haykin, "Cubature Kalman filters", IEEE TAC 54 (2009) 1254-1269.
"""

from __future__ import annotations

from collections.abc import Sequence

from numpy.typing import ArrayLike

from estimator.rivals.covariance import Kernels, Model, filtered, sigma_kernels, smoothed
from estimator.ud import Array

NAME = "cubature filter in covariance form"


def kernels(f: Model, h: Model) -> Kernels:
    """Kernels for these models; compiled, and callable from compiled functions, if the models are. Their kappa is 0."""
    return sigma_kernels(f, h)


def filter_step(
    mean: ArrayLike, sqrt_cov: ArrayLike, f: Model, h: Model, z: ArrayLike | None, sqrt_q: ArrayLike,
    sqrt_r: ArrayLike, angles: Sequence[int] = (),
) -> tuple[Array, Array]:  # fmt: skip
    """One step, prediction and update.

    Parameters
    ----------
    mean : (n,) array
        State before the step.
    sqrt_cov : (n, n) array
        S with covariance S S^T; the result is lower triangular.
    f, h : callable
        Of one state (n,): the next state, and the measurements (m,).
    z : (m,) array or None
        NaN = missing; None or all missing: prediction only.
    sqrt_q : (n, q) array
    sqrt_r : (m, r) array
        Factors of the covariances of process and measurement noise.
    angles : sequence of int
        Measurements that wrap around, rad.

    Raises
    ------
    ArithmeticError
        A covariance is not positive definite.
    FloatingPointError
        A model gave a number that is not finite.
    """
    return filtered(kernels(f, h), NAME, (f, h), mean, sqrt_cov, z, sqrt_q, sqrt_r, angles)


def smooth_step(
    mean: ArrayLike, sqrt_cov: ArrayLike, f: Model, sqrt_q: ArrayLike, next_mean: ArrayLike, next_sqrt_cov: ArrayLike
) -> tuple[Array, Array]:
    """One step back: N(mean, sqrt_cov) of an epoch, given what is known of the epoch after it.

    Raises
    ------
    ArithmeticError
        A covariance is not positive definite; the one of the prediction must be, so f may not project.
    FloatingPointError
        ``f`` gave a number that is not finite.
    """
    return smoothed(kernels(f, f), NAME, f, mean, sqrt_cov, sqrt_q, next_mean, next_sqrt_cov)
