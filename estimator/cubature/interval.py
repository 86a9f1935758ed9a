"""A whole record: filtered, smoothed over the fixed interval, or smoothed with a fixed lag."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import ArrayLike

from estimator.cubature import arguments as given
from estimator.cubature import arrays, kernels, models, reflections
from estimator.cubature.arguments import Function
from estimator.cubature.arrays import Work, copy
from estimator.cubature.compile import Kernel
from estimator.cubature.reflections import Array
from estimator.ud import follow, lean

follow(__file__, arrays.__file__, kernels.__file__, models.__file__, reflections.__file__)

PREDICTED, PARTIAL, DEGENERATE = 1, 2, 4


class Filtered(NamedTuple):
    """What a filter makes of N steps."""

    mean: Array  # (N + 1, n)
    sqrt_cov: Array  # (N + 1, n, n)
    std: Array  # (N + 1, n)
    innovation: Array  # (N, m), NaN where nothing was measured
    innovation_std: Array  # (N, m)
    nis: Array  # (N,) normalised innovation squared
    used: Any  # (N,) int64, components used
    flags: Any  # (N,) int64, a sum of PREDICTED, PARTIAL, DEGENERATE


class Smoothed(NamedTuple):
    """A record smoothed, and the filter's pass it came from."""

    mean: Array  # (N + 1, n)
    sqrt_cov: Array  # (N + 1, n, n)
    std: Array  # (N + 1, n)
    filtered: Filtered


@lean
def note(
    j: int, present: Any, found: Array, deviation: Array, of: Array, innovation: Array, spread: Array, told: Array
) -> None:
    """What the update of step ``j`` met."""
    for i in range(3):
        told[j, i] = of[i]
    for i in range(int(of[2])):
        innovation[j, present[i]] = found[i]
        spread[j, present[i]] = deviation[i]


def filtered(
    f: Any,
    h: Any,
    inputs: Any,
    mean: Array,
    root: Array,
    z: Array,
    sqrt_q: Array,
    sqrt_r: Array,
    turns: Any,
    work: Work,
    innovation: Array,
    spread: Array,
    told: Array,
    times: int,
) -> tuple[int, int]:
    """``filter_step`` from ``mean[0]``, ``root[0]`` through all of ``z``; status and the step it is of."""
    for j in range(z.shape[0]):
        u = None if inputs is None else inputs[j]
        q, r = sqrt_q[min(j, sqrt_q.shape[0] - 1)], sqrt_r[min(j, sqrt_r.shape[0] - 1)]
        status = kernels.filter_step(f, h, u, mean[j], root[j], z[j], q, r, turns, work, mean[j + 1], root[j + 1])
        if status != kernels.FINE:
            return status, j
        note(j, work.present, work.innovation, work.spread, work.told, innovation, spread, told)
    return kernels.FINE, z.shape[0]


def refined(
    f: Any,
    h: Any,
    inputs: Any,
    mean: Array,
    root: Array,
    z: Array,
    sqrt_q: Array,
    sqrt_r: Array,
    turns: Any,
    work: Work,
    innovation: Array,
    spread: Array,
    told: Array,
    times: int,
) -> tuple[int, int]:
    """``refined_step`` from ``mean[0]``, ``root[0]`` through all of ``z``; status and the step it is of."""
    for j in range(z.shape[0]):
        u = None if inputs is None else inputs[j]
        q, r = sqrt_q[min(j, sqrt_q.shape[0] - 1)], sqrt_r[min(j, sqrt_r.shape[0] - 1)]
        status = kernels.refined_step(
            f, h, u, mean[j], root[j], z[j], q, r, turns, work, mean[j + 1], root[j + 1], times
        )
        if status != kernels.FINE:
            return status, j
        note(j, work.present, work.innovation, work.spread, work.told, innovation, spread, told)
    return kernels.FINE, z.shape[0]


def backward(
    f: Any,
    inputs: Any,
    mean: Array,
    root: Array,
    sqrt_q: Array,
    work: Work,
    smoothed: Array,
    smoothed_root: Array,
    first: int,
    last: int,
) -> tuple[int, int]:
    """Smooth back from ``smoothed[last]`` to ``smoothed[first]``."""
    for j in range(last - 1, first - 1, -1):
        u = None if inputs is None else inputs[j]
        q = sqrt_q[min(j, sqrt_q.shape[0] - 1)]
        status = kernels.smooth_step(
            f, u, mean[j], root[j], q, smoothed[j + 1], smoothed_root[j + 1], work, smoothed[j], smoothed_root[j]
        )
        if status != kernels.FINE:
            return status, j
    return kernels.FINE, first


def lagged(
    f: Any,
    inputs: Any,
    mean: Array,
    root: Array,
    sqrt_q: Array,
    work: Work,
    held: Array,
    held_root: Array,
    lag: int,
    out: Array,
    out_root: Array,
) -> tuple[int, int]:
    """Every state given the ``lag`` measurements after it. ``held`` (lag + 1, n) and its roots are scratch."""
    last = mean.shape[0] - 1
    for newest in range(min(lag, last), last + 1):
        reach = min(lag, newest)
        copy(mean[newest], held[reach], root[newest], held_root[reach])
        for i in range(reach - 1, -1, -1):
            j = newest - reach + i
            u = None if inputs is None else inputs[j]
            q = sqrt_q[min(j, sqrt_q.shape[0] - 1)]
            status = kernels.smooth_step(
                f, u, mean[j], root[j], q, held[i + 1], held_root[i + 1], work, held[i], held_root[i]
            )
            if status != kernels.FINE:
                return status, j
        copy(held[0], out[newest - reach], held_root[0], out_root[newest - reach])
    kept = min(lag, last)
    for i in range(kept + 1):
        copy(held[i], out[last - kept + i], held_root[i], out_root[last - kept + i])
    return kernels.FINE, last


REFINED = Kernel(refined, 2)
STEPS = {"filter": Kernel(filtered, 2), "backward": REFINED, "diplf": REFINED}
BACK = Kernel(backward, 1)
LAG = Kernel(lagged, 1)


class _Record:
    """A record as checked arrays, with what its passes work in."""

    def __init__(
        self,
        mean: ArrayLike,
        sqrt_cov: ArrayLike,
        f: Function,
        h: Function,
        z: ArrayLike,
        sqrt_q: ArrayLike,
        sqrt_r: ArrayLike,
        angles: Sequence[int],
        u: ArrayLike | None,
    ) -> None:
        self.f, self.h = f, h
        prior, prior_root = given.state(mean, sqrt_cov)
        n, dtype = prior.size, prior.dtype
        self.z = given.measurements(z, dtype)
        steps, m = self.z.shape
        self.q = given.noises("sqrt_q", sqrt_q, n, steps, dtype)
        self.r = given.noises("sqrt_r", sqrt_r, m, steps, dtype)
        self.turns, self.inputs = given.wrapped_components(angles, m), given.inputs(u, steps, dtype)
        self.work = kernels.workspace(n, n, self.q.shape[2], m, self.r.shape[2], prior)
        self.mean, self.root = np.empty((steps + 1, n), dtype), np.empty((steps + 1, n, n), dtype)
        self.mean[0], self.root[0] = prior, prior_root

    def run(self, kernel: Kernel, *arguments: Any) -> None:
        """Call ``kernel`` and raise what it reports."""
        models = (self.f, self.h)[: kernel.functions]
        status, j = kernel(self.mean.dtype, self.inputs is not None, *models, self.inputs, *arguments)
        if status != kernels.FINE:
            own, function = (self.work.f, self.f) if status % 2 else (self.work.h, self.h)
            given.refuse(status, function, own, None if self.inputs is None else self.inputs[j], f" at step {j}")

    def filter(self, method: str, iterations: int) -> Filtered:
        """The pass forward."""
        if method not in STEPS:
            raise ValueError(f"method is {method!r}: one of {', '.join(map(repr, STEPS))} is needed")
        if iterations < 1:
            raise ValueError(f"iterations is {iterations}: at least 1 is needed")
        steps, m = self.z.shape
        innovation, spread = np.full((2, steps, m), np.nan, self.z.dtype)
        told = np.empty((steps, 3), self.z.dtype)
        self.run(
            STEPS[method],
            self.mean,
            self.root,
            self.z,
            self.q,
            self.r,
            self.turns,
            self.work,
            innovation,
            spread,
            told,
            0 if method == "backward" else iterations,
        )
        used = told[:, 2].astype(np.int64)
        flags = PREDICTED * (used == 0) + PARTIAL * ((used > 0) & (used < m)) + DEGENERATE * (told[:, 1] > 0)
        nis = np.where(used > 0, told[:, 0], np.nan).astype(self.z.dtype)
        return Filtered(self.mean, self.root, _std(self.root), innovation, spread, nis, used, flags)


def _std(root: Array) -> Array:
    return cast(Array, np.sqrt(np.einsum("kij,kij->ki", root, root)))


def filter_interval(
    mean: ArrayLike,
    sqrt_cov: ArrayLike,
    f: Function,
    h: Function,
    z: ArrayLike,
    sqrt_q: ArrayLike,
    sqrt_r: ArrayLike,
    angles: Sequence[int] = (),
    u: ArrayLike | None = None,
    *,
    method: str = "filter",
    iterations: int = 1,
) -> Filtered:
    """A whole record filtered.

    Parameters
    ----------
    mean, sqrt_cov : (n,), (n, n) arrays
        The prior, at epoch 0. float32 where both are, and then everything is.
    f, h : functions
        x_{j+1} = f(x_j) + w_j and z_j = h(x_{j+1}) + v_j; with inputs f(x, u_j), h(x, u_j). numba's run compiled.
    z : (N, m) array
        z[j] was measured at epoch j + 1; NaN where a component is missing.
    sqrt_q, sqrt_r : (n, q), (m, r) arrays, or (N, n, q), (N, m, r)
        Factors of the noises, constant or one per step.
    angles : sequence of int
        Components of z that are angles, rad.
    u : (N, d) array, optional
        Inputs, one row per step.
    method : str
        "filter" (``filter_step``), "backward" (``backward_smoothing_step``, overconfident) or "diplf" (``diplf_step``).
    iterations : int
        Those of ``diplf_step``.

    Raises
    ------
    NotFinite
        A model function returned NaN or infinity: which, and at which step.
    ValueError
        An argument does not fit: which, and its shape.
    """
    return _Record(mean, sqrt_cov, f, h, z, sqrt_q, sqrt_r, angles, u).filter(method, iterations)


def smooth_interval(
    mean: ArrayLike,
    sqrt_cov: ArrayLike,
    f: Function,
    h: Function,
    z: ArrayLike,
    sqrt_q: ArrayLike,
    sqrt_r: ArrayLike,
    angles: Sequence[int] = (),
    u: ArrayLike | None = None,
) -> Smoothed:
    """A whole record smoothed over the fixed interval (SR-CKS): the filter, and ``smooth_step`` from the end back.

    Parameters
    ----------
    mean, sqrt_cov : (n,), (n, n) arrays
        The prior, at epoch 0. float32 where both are, and then everything is.
    f, h : functions
        x_{j+1} = f(x_j) + w_j and z_j = h(x_{j+1}) + v_j; with inputs f(x, u_j), h(x, u_j). numba's run compiled.
    z : (N, m) array
        z[j] was measured at epoch j + 1; NaN where a component is missing.
    sqrt_q, sqrt_r : (n, q), (m, r) arrays, or (N, n, q), (N, m, r)
        Factors of the noises, constant or one per step.
    angles : sequence of int
        Components of z that are angles, rad.
    u : (N, d) array, optional
        Inputs, one row per step.

    Raises
    ------
    NotFinite
        A model function returned NaN or infinity: which, and at which step.
    ValueError
        An argument does not fit: which, and its shape.
    """
    record = _Record(mean, sqrt_cov, f, h, z, sqrt_q, sqrt_r, angles, u)
    filtered = record.filter("filter", 1)
    new, new_root = record.mean.copy(), record.root.copy()
    record.run(BACK, record.mean, record.root, record.q, record.work, new, new_root, 0, len(record.z))
    return Smoothed(new, new_root, _std(new_root), filtered)


def fixed_lag(
    mean: ArrayLike,
    sqrt_cov: ArrayLike,
    f: Function,
    h: Function,
    z: ArrayLike,
    sqrt_q: ArrayLike,
    sqrt_r: ArrayLike,
    lag: int,
    angles: Sequence[int] = (),
    u: ArrayLike | None = None,
) -> Smoothed:
    """Every state given the measurements up to ``lag`` steps after it, what a filter says ``lag`` steps late.

    Parameters
    ----------
    mean, sqrt_cov : (n,), (n, n) arrays
        The prior, at epoch 0. float32 where both are, and then everything is.
    f, h : functions
        x_{j+1} = f(x_j) + w_j and z_j = h(x_{j+1}) + v_j; with inputs f(x, u_j), h(x, u_j). numba's run compiled.
    z : (N, m) array
        z[j] was measured at epoch j + 1; NaN where a component is missing.
    sqrt_q, sqrt_r : (n, q), (m, r) arrays, or (N, n, q), (N, m, r)
        Factors of the noises, constant or one per step.
    lag : int
        0 is the filter; N or more is ``smooth_interval``.
    angles : sequence of int
        Components of z that are angles, rad.
    u : (N, d) array, optional
        Inputs, one row per step.

    Raises
    ------
    NotFinite
        A model function returned NaN or infinity: which, and at which step.
    ValueError
        An argument does not fit: which, and its shape.
    """
    if lag < 0:
        raise ValueError(f"lag is {lag}: 0 or more is needed")
    record = _Record(mean, sqrt_cov, f, h, z, sqrt_q, sqrt_r, angles, u)
    filtered = record.filter("filter", 1)
    new, new_root = np.empty_like(record.mean), np.empty_like(record.root)
    lag = min(lag, len(record.z))
    held, held_root = np.empty_like(record.mean[: lag + 1]), np.empty_like(record.root[: lag + 1])
    record.run(LAG, record.mean, record.root, record.q, record.work, held, held_root, lag, new, new_root)
    return Smoothed(new, new_root, _std(new_root), filtered)
