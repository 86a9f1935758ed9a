"""Estimators: samples in, states with honest uncertainty out.

Conventions, written once
-------------------------
    x_{j+1} = phi_j x_j + gamma_j w_j           w_j ~ N(0, Q_j)        phi (n, n), gamma (n, p)
    z_j     = h_j x_{j+1} + v_j                 v_j ~ N(0, R_j)        h (m, n)               j = 0..N-1

N steps join N + 1 epochs. The prior belongs to epoch 0, before any measurement; step j ends at epoch j + 1, where z_j
was taken. NaN in z: that scalar is missing. No prior information: x0 = p0 = None.

Importing this package compiles nothing and does not import numba; using a name below does.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from estimator.information import Carry, Filtered, InformationFilter
    from estimator.linear import Smoothed, smooth
    from estimator.model import LinearModel
    from estimator.parallel import Record, smooth_records
    from estimator.smoother import Unobservable
    from estimator.snapshots import Store
    from estimator.stage.reconstruction import NoFlightPath, Reconstruction, reconstruct
    from estimator.window import Rule

__all__ = [
    "Carry",
    "Filtered",
    "InformationFilter",
    "LinearModel",
    "NoFlightPath",
    "Reconstruction",
    "Record",
    "Rule",
    "Smoothed",
    "Store",
    "Unobservable",
    "reconstruct",
    "smooth",
    "smooth_records",
]

_HOME = {
    "Carry": "information",
    "Filtered": "information",
    "InformationFilter": "information",
    "LinearModel": "model",
    "NoFlightPath": "stage.reconstruction",
    "Reconstruction": "stage.reconstruction",
    "Record": "parallel",
    "Rule": "window",
    "Smoothed": "linear",
    "Store": "snapshots",
    "Unobservable": "smoother",
    "reconstruct": "stage.reconstruction",
    "smooth": "linear",
    "smooth_records": "parallel",
}


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'estimator' has no attribute {name!r}")
    return getattr(importlib.import_module(f"estimator.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)
