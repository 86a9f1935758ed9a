"""Square-root cubature filtering and smoothing: strongly nonlinear models, and factors that cannot lose definiteness.

    x_{j+1} = f(x_j) + w_j,    z_j = h(x_{j+1}) + v_j;    P = S S^T, of which only S is kept

With functions of plain Python and of numba the same operations are done: a record with those of numba is one compiled
loop, kept on disk, and single steps call either from Python.
``kernels`` are the same steps for other compiled code. A Monte Carlo run is one call of ``filter_interval``, which
lets go of the interpreter: threads over runs.

References
----------
.. [1] I. Arasaratnam and S. Haykin, "Cubature Kalman filters", IEEE Trans. Automatic Control 54 (2009) 1254-1269.
.. [2] Tang X., Huang X., Wu M. and Zhang H., "Research on square root CKF/backward smoothing nonlinear filter",
   J. Academy of Armored Force Engineering 2015 (2) 65-69.
"""

from estimator.cubature import kernels
from estimator.cubature.arguments import NotFinite
from estimator.cubature.interval import (
    DEGENERATE,
    PARTIAL,
    PREDICTED,
    Filtered,
    Smoothed,
    filter_interval,
    fixed_lag,
    smooth_interval,
)
from estimator.cubature.reflections import triangular
from estimator.cubature.steps import backward_smoothing_step, diplf_step, filter_step, predict, smooth_step, update

__all__ = [
    "DEGENERATE",
    "PARTIAL",
    "PREDICTED",
    "Filtered",
    "NotFinite",
    "Smoothed",
    "backward_smoothing_step",
    "diplf_step",
    "filter_interval",
    "filter_step",
    "fixed_lag",
    "kernels",
    "predict",
    "smooth_interval",
    "smooth_step",
    "triangular",
    "update",
]
