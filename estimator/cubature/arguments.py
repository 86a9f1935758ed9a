"""What the functions of ``estimator.cubature`` are given, checked once and made contiguous."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from estimator.cubature.arrays import Side
from estimator.cubature.models import SHAPE
from estimator.cubature.reflections import Array, triangular

Function = Callable[..., Any]  # f(x) or f(x, u): one point (n,) -> a new array


class NotFinite(ArithmeticError):
    """A model function returned NaN or infinity: which one, where, and of what."""


def numbers(name: str, value: Any, dtype: Any, *shapes: str) -> Array:
    """``value`` as a writable contiguous array of ``dtype`` with as many dimensions as one of ``shapes``."""
    try:
        array = np.array(value, dtype, order="C")
    except (TypeError, ValueError):
        raise ValueError(f"{name} is not an array of numbers") from None
    if array.ndim not in {shape.count(",") + 1 - shape.endswith(",") for shape in shapes}:
        raise ValueError(f"{name} has shape {array.shape}: {' or '.join(f'({shape})' for shape in shapes)} is needed")
    return array


def finite(name: str, array: Array) -> Array:
    """``array``; ValueError where it is not finite."""
    if not np.isfinite(array).all():
        raise ValueError(f"{name} is not finite")
    return array


def state(mean: ArrayLike, sqrt_cov: ArrayLike, names: tuple[str, str] = ("mean", "sqrt_cov")) -> tuple[Array, Array]:
    """A state as copies, (n,) and (n, n) lower triangular; any other square factor is made so."""
    single = np.asarray(mean).dtype == np.float32 and np.asarray(sqrt_cov).dtype == np.float32
    dtype = np.float32 if single else np.float64
    m = finite(names[0], numbers(names[0], mean, dtype, "n,"))
    root = finite(names[1], numbers(names[1], sqrt_cov, dtype, "n, n"))
    if not m.size:
        raise ValueError(f"{names[0]} is empty")
    if root.shape != (m.size, m.size):
        raise ValueError(
            f"{names[1]} has shape {root.shape}: ({m.size}, {m.size}) is needed, as {names[0]} has {m.size}"
        )
    if np.triu(root, 1).any() or (np.diagonal(root) < 0.0).any():
        root = triangular(root)
    return m, root


def noise(name: str, value: ArrayLike, rows: int | None, dtype: Any) -> Array:
    """A noise factor, any number of columns; ``rows`` None takes any number of rows."""
    root = finite(name, numbers(name, value, dtype, "n, q"))
    if rows is not None and root.shape[0] != rows:
        raise ValueError(f"{name} has shape {root.shape}: ({rows}, any) is needed")
    if not root.shape[0]:
        raise ValueError(f"{name} has no rows")
    return root


def noises(name: str, value: ArrayLike, rows: int | None, steps: int, dtype: Any) -> Array:
    """Noise factors, (1, rows, q) of a constant one or (N, rows, q)."""
    root = finite(name, numbers(name, value, dtype, "n, q", "N, n, q"))
    if root.ndim == 2:
        root = root[None]
    elif root.shape[0] != steps:
        raise ValueError(f"{name} is given for {root.shape[0]} steps, z for {steps}")
    if rows is not None and root.shape[1] != rows:
        raise ValueError(f"{name} has shape {root.shape[1:]} per step: ({rows}, any) is needed")
    if not root.shape[1]:
        raise ValueError(f"{name} has no rows")
    return root


def measurement(z: ArrayLike | None, size: int, dtype: Any) -> Array:
    """Z (m,), all NaN where there is none."""
    if z is None:
        return np.full(size, np.nan, dtype)
    array = numbers("z", z, dtype, "m,")
    if array.shape != (size,):
        raise ValueError(f"z has shape {array.shape}: ({size},) is needed, as sqrt_r has {size} rows")
    if np.isinf(array).any():
        raise ValueError("z is infinite; a missing component is NaN")
    return array


def measurements(z: ArrayLike, dtype: Any) -> Array:
    """Z (N, m)."""
    array = numbers("z", z, dtype, "N, m")
    if not array.shape[1]:
        raise ValueError("z has no components")
    if np.isinf(array).any():
        step = int(np.flatnonzero(np.isinf(array).any(axis=1))[0])
        raise ValueError(f"z is infinite at step {step}; a missing component is NaN")
    return array


def wrapped_components(angles: Sequence[int], m: int) -> Any:
    """(m,) bool: True where a component of z is an angle."""
    turns = np.zeros(m, np.bool_)
    for component in angles:
        if isinstance(component, bool | np.bool_):
            raise ValueError("angles is a mask: the numbers of the components are needed")
        if not 0 <= component < m:
            raise ValueError(f"angles names component {component}: z has components 0 to {m - 1}")
        turns[component] = True
    return turns


def inputs(u: ArrayLike | None, steps: int, dtype: Any) -> Array | None:
    """U (N, d), or None."""
    if u is None:
        return None
    array = numbers("u", u, dtype, "N, d")
    if array.shape[0] != steps:
        raise ValueError(f"u is given for {array.shape[0]} steps, z for {steps}")
    return array


def refuse(status: int, function: Function, own: Side, u: Any, where: str = "") -> None:
    """Raise what ``status`` says of a model function whose last points and values are in ``own``."""
    name = "f" if status % 2 else "h"
    size = own.values.shape[1]
    if status >= SHAPE:
        y = np.shape(function(own.points[0].copy()) if u is None else function(own.points[0].copy(), u))
        raise ValueError(f"{name} returned shape {y}{where}: ({size},) is needed")
    bad = ~np.isfinite(own.values)
    row = int(np.flatnonzero(bad.any(axis=1))[0])
    component = int(np.flatnonzero(bad[row])[0])
    x = ", ".join(f"{value:.6g}" for value in own.points[row])
    raise NotFinite(f"{name} returned {own.values[row, component]} in component {component}{where}, at x = [{x}]")
