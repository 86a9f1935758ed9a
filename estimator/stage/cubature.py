"""The estimator "cubature": square-root cubature filter and smoother, of the trajectory in closed form."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from estimator.cubature.trajectory import Store as store
from estimator.cubature.trajectory import anchor, filter, smooth, start
from estimator.models.flight_path import FlightPath

if TYPE_CHECKING:
    from estimator.cubature.flight import CubatureStretch

__all__ = ["anchor", "begin", "filter", "smooth", "start", "store"]


def begin(
    flight: FlightPath, values: dict[str, float], sigma: NDArray[np.float64] | None = None, *, gated: bool = True
) -> CubatureStretch:
    """A stretch of flight path from named values with standard deviations (n,), those of the prior if none."""
    from estimator.cubature.flight import CubatureStretch  # not where the trajectory flies alone

    return CubatureStretch.begin(flight, values, sigma, gated=gated)
