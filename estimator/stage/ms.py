"""The estimator "ms": the information filter and smoother in moving coordinates, extended for the flight path."""

from __future__ import annotations

from estimator.information import Carry, anchor, filter, start
from estimator.models.flight_path import FlightPath
from estimator.smoother import backward
from estimator.snapshots import Store as store
from estimator.stretch import Stretch
from estimator.ud import Array

__all__ = ["anchor", "begin", "filter", "smooth", "start", "store"]


def smooth(store: store, carry: Carry) -> tuple[Array, Array]:
    """Mean and standard deviation (k+1, n) of the epochs of a store, given everything up to the carry."""
    mean, std, *_ = backward(store, carry, std=True, covariance=False)
    return mean, std


def begin(flight: FlightPath, values: dict[str, float], sigma: Array | None = None, *, gated: bool = True) -> Stretch:
    """A stretch of flight path from named values with standard deviations (n,), those of the prior if none."""
    return Stretch(flight, flight.start(values, sigma), gated=gated)
