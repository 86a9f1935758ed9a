"""`smooth`: one door to every fixed-interval smoother of a linear Gaussian system (`estimator.model.LinearModel`)."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimator import rivals
from estimator.information import Filtered, filter, start
from estimator.model import LinearModel
from estimator.smoother import backward
from estimator.snapshots import Store
from estimator.ud import Array
from estimator.window import Rule

RESULTS = ("mean", "std", "covariance", "cross", "filtered")
TOGETHER = 8  # records on a thread of their own, at least: each thread repeats the recursion of the covariance
WANT = ("mean", "std", "covariance", "filtered")


class Smoothed(NamedTuple):
    """A record, smoothed: epoch 0 is the prior's, epoch j + 1 the one where step j ends.

    What was not asked for was not computed and is empty: its first axis has length 0. Of K records of one model every
    array has an axis K in front; where records share their factors, the rows of a covariance are one array seen K times
    (read-only).

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
    cross : (N, n, n) array
        Covariance of neighbours: row j is cov(x_j, x_{j+1}), rows of the earlier epoch, columns of the later.
    """

    mean: Array
    covariance: Array
    std: Array
    filtered_mean: Array
    filtered_std: Array
    windows: list[int]
    bytes_per_step: int
    cross: Array


def smooth(
    model: LinearModel,
    z: ArrayLike,
    *,
    x0: ArrayLike | None = None,
    p0: ArrayLike | None = None,
    method: str = "ms",
    window: int | None = None,
    want: Iterable[str] = WANT,
    threads: int = 1,
    spill: Path | str | None = None,
) -> Smoothed:
    """Fixed-interval smoothing of a whole record, or of many records of one model.

    Parameters
    ----------
    model : LinearModel
    z : (N, m) array, or (K, N, m) for K records
        NaN = missing. Records that miss the same measurements share the recursion of the covariance.
    x0, p0 : (n,) or (K, n) mean and (n, n) covariance or (n,) variances, optional
        Prior at epoch 0; both None: no prior information.
    method : str
        "ms", or a method of ``estimator.rivals``.
    window : int, optional
        Steps per window, None = 100; a condition number above 1e4 (1e2 in float32) closes one earlier, so that
        whole-record windows stay exact on unstable systems too. Methods without windows take no notice.
    want : names among "mean", "std", "covariance", "cross", "filtered"
        What is computed and returned; the mean always is.
    threads : int
        2 filters a record from both ends to the middle and smooths it outwards, one thread each way: "ms" only, and the
        filter's estimates end in the middle (``middle``). Of many records, threads share the work.
    spill : path, optional
        A new or empty folder for a record whose steps or results do not fit in memory: snapshots go there while they
        are needed, and the results are files in it, mapped into memory ("ms" only, one record, one thread).

    Raises
    ------
    ValueError
        Unknown method or result, or data that the method cannot use; names argument and step. ``Unobservable`` is one
        of them. So is a smoothed sigma above the filtered one, where both are wanted: lost digits, not an estimate.
    FileExistsError
        ``spill`` holds files already.
    """
    wanted = frozenset([want] if isinstance(want, str) else want)
    if not wanted <= frozenset(RESULTS):
        raise ValueError(f"want names {sorted(wanted - frozenset(RESULTS))[0]!r}: choose from {', '.join(RESULTS)}")
    if method != "ms" and method not in rivals.METHODS:
        raise ValueError(f"method {method!r} is unknown: choose from ms, {', '.join(rivals.METHODS)}")
    if method != "ms" and spill is not None:
        raise ValueError(f"method {method!r} keeps everything in memory; spill is for method 'ms'")
    if threads < 1:
        raise ValueError(f"threads is {threads}: at least 1 is needed")
    rule = Rule.of(model) if window is None else Rule.of(model, window)

    def one(z: ArrayLike, x0: ArrayLike | None, wanted: frozenset[str]) -> Smoothed:
        if method == "ms":
            return _ms(model, z, x0, p0, rule, wanted)
        solution: Smoothed = importlib.import_module(rivals.METHODS[method]).smooth(model, z, x0, p0, window, wanted)
        return solution

    if np.ndim(z) == 3:
        if spill is not None:
            raise ValueError("spill is for one record, z of shape (N, m)")
        return _many(one, np.asarray(z, model.dtype), x0, wanted, threads, shared=method == "ms")
    if spill is not None:
        if threads > 1:
            raise ValueError("spill is for one thread: it keeps the snapshots of one pass")
        on_disk = importlib.import_module("estimator.spilled")
        result: Smoothed = on_disk.smooth(model, z, x0, p0, rule, wanted, Path(spill))
        return result
    if threads > 1 and method == "ms":
        meet = importlib.import_module("estimator.middle")
        both: Smoothed = meet.smooth_from_both_ends(model, z, x0, p0, window, wanted)
        return both
    return one(z, x0, wanted)


def _ms(
    model: LinearModel, z: ArrayLike, x0: ArrayLike | None, p0: ArrayLike | None, rule: Rule, wanted: frozenset[str]
) -> Smoothed:
    """One record, or (K, N, m) records that miss the same measurements; their factors are returned once."""
    records = np.shape(z)[0] if np.ndim(z) == 3 else 1
    store = Store()
    carry = start(model.n, x0, p0, records=records, dtype=model.dtype)
    carry, filtered = filter(model, carry, z, rule=rule, store=store, estimates="filtered" in wanted)
    smoothed = backward(store, carry, **flags(wanted))
    if np.ndim(z) == 3 and records == 1:
        smoothed = smoothed._replace(mean=smoothed.mean[None])
    mean, std = from_epoch_0(model, x0, p0, filtered, wanted)
    believable(smoothed.std, std)
    windows = [i for i in store.anchors if i < len(store)]
    return Smoothed(
        smoothed.mean, smoothed.covariance, smoothed.std, mean, std, windows, store.bytes_per_step, smoothed.cross
    )


def flags(wanted: frozenset[str]) -> dict[str, bool]:
    """What ``smoother.backward`` has to be asked for."""
    return {name: name in wanted for name in ("std", "covariance", "cross")}


def from_epoch_0(
    model: LinearModel, x0: ArrayLike | None, p0: ArrayLike | None, filtered: Filtered, wanted: frozenset[str]
) -> tuple[Array, Array]:
    """The filter's estimates with the prior in front: mean (.., N+1, n) and std (N+1, n); empty when not wanted."""
    rows = filtered.mean.shape[-2] + 1 if "filtered" in wanted else 0
    mean = np.full((*filtered.mean.shape[:-2], rows, model.n), np.nan, model.dtype)
    std = np.full((rows, model.n), np.inf, model.dtype)
    if rows:
        mean[..., 1:, :], std[1:] = filtered.mean, filtered.std
        if x0 is not None and p0 is not None:
            variance = np.asarray(p0, float)
            mean[..., 0, :] = x0
            std[0] = np.sqrt(variance if variance.ndim == 1 else np.diag(variance))
            mean[..., 0, np.isinf(std[0])] = np.nan
    return mean, std


def believable(smoothed: Array, filtered: Array, first: int = 0) -> None:
    """Raise ValueError where smoothing would be less sure than filtering, which only lost digits can bring about.

    A mode that shrinks 1e-4-fold per step and is fed by no noise for several steps leaves too little of itself to be
    followed backward in float64. Standard deviations (k, n) of the epochs from ``first`` on; nothing is said without
    either of them, nor of float32, whose sigmas are worth less.
    """
    if not smoothed.size or not filtered.size or smoothed.dtype != np.float64:
        return
    lost = np.flatnonzero((smoothed > 1.001 * filtered).any(axis=1))
    if lost.size:
        raise ValueError(
            f"the digits of epoch {first + lost[0]} are lost on the way back: without noise, phi shrinks some "
            "direction too fast after it; method 'watanabe' smooths forward"
        )


def _many(
    one: Callable[[Array, ArrayLike | None, frozenset[str]], Smoothed],
    z: Array,
    x0: ArrayLike | None,
    wanted: frozenset[str],
    threads: int,
    *,
    shared: bool,
) -> Smoothed:
    """K records of one model: those that miss the same measurements together, each group on as many threads."""
    count = z.shape[0]
    if count == 0:
        raise ValueError("z has no records: (K, N, m) with K of at least 1 is needed")
    first = None if x0 is None else np.asarray(x0, float)
    if first is not None and not (first.ndim == 1 or (first.ndim == 2 and first.shape[0] == count)):
        raise ValueError(f"x0 has shape {first.shape} beside {count} records: (n,) or ({count}, n) is needed")
    if shared:
        patterns = np.packbits(np.isnan(z).reshape(count, -1), axis=1)
        group = np.unique(patterns, axis=0, return_inverse=True)[1].reshape(-1)
    else:
        group = np.arange(count)
    members = [np.flatnonzero(group == i) for i in range(group.max() + 1)]
    jobs = [
        (part, wanted if not i else wanted & {"filtered"})
        for own in members
        for i, part in enumerate(np.array_split(own, min(threads, max(own.size // TOGETHER, 1))))
    ]
    priors = None if first is None else np.broadcast_to(first, (count, first.shape[-1]))

    def run(job: tuple[NDArray[np.int64], frozenset[str]]) -> Smoothed:
        part, asked = job
        prior = None if priors is None else priors[part]
        try:
            if shared:
                return one(z[part], prior, asked)
            alone = one(z[part[0]], None if prior is None else prior[0], asked)
        except ValueError as error:
            error.add_note(f"in record {', '.join(map(str, part[:9]))}{', ..' if part.size > 9 else ''}")
            raise
        return alone._replace(mean=alone.mean[None], filtered_mean=alone.filtered_mean[None])

    if threads == 1:
        solved = [run(job) for job in jobs]
    else:
        with ThreadPoolExecutor(threads) as pool:
            solved = list(pool.map(run, jobs))
    leaders = [solved[next(i for i, (part, _) in enumerate(jobs) if part[0] == own[0])] for own in members]

    def spread(name: str) -> Array:
        """What groups share, for every record: one array seen K times, or as many copies as there are groups."""
        parts = [getattr(leader, name) for leader in leaders]
        if len(parts) == 1:
            return np.broadcast_to(parts[0], (count, *parts[0].shape))
        return np.stack(parts)[group]

    mean, filtered = (
        np.empty((count, *getattr(solved[0], name).shape[1:]), z.dtype) for name in ("mean", "filtered_mean")
    )
    for (part, _), own in zip(jobs, solved, strict=True):
        mean[part], filtered[part] = own.mean, own.filtered_mean
    lead = leaders[0]
    return Smoothed(
        mean, spread("covariance"), spread("std"), filtered, spread("filtered_std"), lead.windows,
        lead.bytes_per_step, spread("cross"),
    )  # fmt: skip
