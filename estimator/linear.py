"""`smooth`: one door to every fixed-interval smoother of a linear Gaussian system (`estimator.model.LinearModel`)."""

from __future__ import annotations

import importlib
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from estimator import rivals
from estimator.information import RULE, filter, start
from estimator.model import LinearModel
from estimator.smoother import backward
from estimator.snapshots import Store
from estimator.ud import Array
from estimator.window import Rule


class Smoothed(NamedTuple):
    """A record, smoothed: epoch 0 is the prior's, epoch j + 1 the one where step j ends.

    Attributes
    ----------
    mean, std : (N+1, n) arrays
    covariance : (N+1, n, n) array
    filtered_mean, filtered_std : (N+1, n) arrays
        The filter's estimates; NaN and infinity until every direction is known.
    windows : list of int
        First steps of the windows.
    bytes_per_step : int
        Kept from the forward pass for the backward pass.
    """

    mean: Array
    covariance: Array
    std: Array
    filtered_mean: Array
    filtered_std: Array
    windows: list[int]
    bytes_per_step: int


def smooth(
    model: LinearModel,
    z: ArrayLike,
    *,
    x0: ArrayLike | None = None,
    p0: ArrayLike | None = None,
    method: str = "ms",
    window: int | None = None,
) -> Smoothed:
    """Fixed-interval smoothing of a whole record.

    Parameters
    ----------
    model : LinearModel
    z : (N, m) array
        NaN = missing.
    x0, p0 : (n,) mean and (n, n) covariance or (n,) variances, optional
        Prior at epoch 0; both None: no prior information.
    method : str
        "ms", or a method of ``estimator.rivals``.
    window : int, optional
        Steps per window, None = 100; a condition number above 1e4 closes one earlier, so that whole-record windows stay
        exact on unstable systems too. Methods without windows take no notice.

    Raises
    ------
    ValueError
        Unknown method, or data that the method cannot use; names argument and step. ``Unobservable`` is one of them.
    """
    if method == "ms":
        return _ms(model, z, x0, p0, window)
    if method not in rivals.METHODS:
        raise ValueError(f"method {method!r} is unknown: choose from ms, {', '.join(rivals.METHODS)}")
    solution: Smoothed = importlib.import_module(rivals.METHODS[method]).smooth(model, z, x0, p0, window)
    return solution


def _ms(model: LinearModel, z: ArrayLike, x0: ArrayLike | None, p0: ArrayLike | None, window: int | None) -> Smoothed:
    rule = RULE if window is None else Rule(steps=window)
    store = Store()
    carry, filtered = filter(model, start(model.n, x0, p0), z, rule=rule, store=store)
    mean, covariance = backward(store, carry)
    filtered_mean, filtered_std = np.full_like(mean, np.nan), np.full_like(mean, np.inf)
    if x0 is not None and p0 is not None:
        variance = np.asarray(p0, float)
        filtered_mean[0] = x0
        filtered_std[0] = np.sqrt(variance if variance.ndim == 1 else np.diag(variance))
    filtered_mean[1:], filtered_std[1:] = filtered.mean, filtered.std
    std = np.sqrt(np.einsum("jii->ji", covariance))
    windows = [i for i in store.anchors if i < len(store)]
    return Smoothed(mean, covariance, std, filtered_mean, filtered_std, windows, store.bytes_per_step)
