"""One step at a time: each takes a state, mean and factor, and returns a new one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from estimator.cubature import arguments as given
from estimator.cubature import kernels
from estimator.cubature.arguments import Function
from estimator.cubature.arrays import Work
from estimator.cubature.reflections import Array

State = tuple[Array, Array]


def _run(kernel: Callable[..., int], functions: tuple[Function, ...], u: Any, *arguments: Any) -> None:
    """Call ``kernel`` and raise what it reports."""
    status = kernel(*functions, u, *arguments)
    if status != kernels.FINE:
        work = next(argument for argument in arguments if isinstance(argument, Work))
        own = work.f if status % 2 else work.h
        given.refuse(status, functions[0] if status % 2 else functions[-1], own, u)


def _input(u: ArrayLike | None, dtype: Any) -> Array | None:
    return None if u is None else given.numbers("u", u, dtype, "d,")


def predict(mean: ArrayLike, sqrt_cov: ArrayLike, f: Function, sqrt_q: ArrayLike, u: ArrayLike | None = None) -> State:
    """Time update: x_k = f(x_{k-1}) + w, w ~ N(0, Q). S^- = Tria([Xs, S_Q]).

    Parameters
    ----------
    mean : (n,) array
        The state before the step; float32 where it and ``sqrt_cov`` are, and then everything is.
    sqrt_cov : (n, n) array
        A factor S of its covariance S S^T; any square one, a lower triangular one is used as it is.
    f : function
        f(x) -> (n',), or f(x, u): one point (n,), a new array. Python or numba's.
    sqrt_q : (n', q) array
        A factor of the process noise, any number of columns.
    u : (d,) array, optional
        Input, handed to the model as a second argument.

    Returns
    -------
    mean, sqrt_cov : arrays
        The predicted state, (n') and (n', n'); the factor is lower triangular, its diagonal not negative.

    Raises
    ------
    NotFinite
        A model function returned NaN or infinity: which, where.
    ValueError
        A shape does not fit or a number is not finite: which argument.
    """
    m, root = given.state(mean, sqrt_cov)
    q = given.noise("sqrt_q", sqrt_q, None, m.dtype)
    n, k = m.size, q.shape[0]
    work = kernels.workspace(n, k, q.shape[1], 1, 1, m)
    new, new_root = np.empty(k, m.dtype), np.empty((k, k), m.dtype)
    _run(kernels.predict, (f,), _input(u, m.dtype), m, root, q, work, new, new_root)
    return new, new_root


def update(
    mean: ArrayLike,
    sqrt_cov: ArrayLike,
    h: Function,
    z: ArrayLike | None,
    sqrt_r: ArrayLike,
    angles: Sequence[int] = (),
    u: ArrayLike | None = None,
) -> State:
    """Measurement update: z = h(x) + v, v ~ N(0, R), by one joint array.

    Tria([[Z, S_R], [X, 0]]) = [[S_zz, 0], [Y, S]];  x + Y S_zz^{-1} (z - zhat). A pivot of S_zz that is nothing but
    rounding gains nothing.

    Parameters
    ----------
    mean : (n,) array
        The state predicted; float32 where it and ``sqrt_cov`` are, and then everything is.
    sqrt_cov : (n, n) array
        A factor S of its covariance S S^T; any square one, a lower triangular one is used as it is.
    h : function
        h(x) -> (m,), or h(x, u), likewise.
    z : (m,) array or None
        What was measured; NaN where a component is missing.
    sqrt_r : (m, r) array
        A factor of the measurement noise.
    angles : sequence of int
        Components of z that are angles, rad: unwrapped about h(mean), innovation in (-pi, pi].
    u : (d,) array, optional
        Input, handed to the model as a second argument.

    Returns
    -------
    mean, sqrt_cov : arrays
        The state given z; the factor is lower triangular, its diagonal not negative.

    Raises
    ------
    NotFinite
        A model function returned NaN or infinity: which, where.
    ValueError
        A shape does not fit or a number is not finite: which argument.
    """
    m, root = given.state(mean, sqrt_cov)
    r = given.noise("sqrt_r", sqrt_r, None, m.dtype)
    seen = given.measurement(z, r.shape[0], m.dtype)
    turns = given.wrapped_components(angles, seen.size)
    work = kernels.workspace(m.size, m.size, 1, seen.size, r.shape[1], m)
    new, new_root = np.empty_like(m), np.empty_like(root)
    _run(kernels.update, (h,), _input(u, m.dtype), m, root, seen, r, turns, work, new, new_root)
    return new, new_root


def _whole(
    kernel: Callable[..., int],
    mean: ArrayLike,
    sqrt_cov: ArrayLike,
    f: Function,
    h: Function,
    z: ArrayLike | None,
    sqrt_q: ArrayLike,
    sqrt_r: ArrayLike,
    angles: Sequence[int],
    u: ArrayLike | None,
    *more: int,
) -> State:
    m, root = given.state(mean, sqrt_cov)
    q, r = given.noise("sqrt_q", sqrt_q, None, m.dtype), given.noise("sqrt_r", sqrt_r, None, m.dtype)
    seen = given.measurement(z, r.shape[0], m.dtype)
    turns = given.wrapped_components(angles, seen.size)
    k = q.shape[0]
    work = kernels.workspace(m.size, k, q.shape[1], seen.size, r.shape[1], m)
    new, new_root = np.empty(k, m.dtype), np.empty((k, k), m.dtype)
    _run(kernel, (f, h), _input(u, m.dtype), m, root, seen, q, r, turns, work, new, new_root, *more)
    return new, new_root


def filter_step(
    mean: ArrayLike,
    sqrt_cov: ArrayLike,
    f: Function,
    h: Function,
    z: ArrayLike | None,
    sqrt_q: ArrayLike,
    sqrt_r: ArrayLike,
    angles: Sequence[int] = (),
    u: ArrayLike | None = None,
) -> State:
    """SR-CKF (Arasaratnam and Haykin, 2009): time update, then measurement update.

    Parameters
    ----------
    mean : (n,) array
        The state before the step; float32 where it and ``sqrt_cov`` are, and then everything is.
    sqrt_cov : (n, n) array
        A factor S of its covariance S S^T; any square one, a lower triangular one is used as it is.
    f : function
        f(x) -> (n',), or f(x, u): one point (n,), a new array. Python or numba's.
    h : function
        h(x) -> (m,), or h(x, u), likewise.
    z : (m,) array or None
        What was measured; NaN where a component is missing.
    sqrt_q : (n', q) array
        A factor of the process noise, any number of columns.
    sqrt_r : (m, r) array
        A factor of the measurement noise.
    angles : sequence of int
        Components of z that are angles, rad: unwrapped about h(mean), innovation in (-pi, pi].
    u : (d,) array, optional
        Input, handed to the model as a second argument.

    Returns
    -------
    mean, sqrt_cov : arrays
        The state given z; the factor is lower triangular, its diagonal not negative.

    Raises
    ------
    NotFinite
        A model function returned NaN or infinity: which, where.
    ValueError
        A shape does not fit or a number is not finite: which argument.
    """
    return _whole(kernels.filter_step, mean, sqrt_cov, f, h, z, sqrt_q, sqrt_r, angles, u)


def smooth_step(
    mean: ArrayLike,
    sqrt_cov: ArrayLike,
    f: Function,
    sqrt_q: ArrayLike,
    next_mean: ArrayLike,
    next_sqrt_cov: ArrayLike,
    u: ArrayLike | None = None,
) -> State:
    """One step of smoothing back: the state before a step, given what is known after it.

    W = L21 L11^{-1};  m + W (m_next - m^-);  Tria([L22, W S_next]). Nothing is subtracted. Where the predicted
    covariance is singular, so that a pivot of L11 is rounding, that direction is left out.

    Parameters
    ----------
    mean : (n,) array
        The state before the step, given what was known then; float32 where it and ``sqrt_cov`` are, and so is all else.
    sqrt_cov : (n, n) array
        A factor S of its covariance S S^T; any square one, a lower triangular one is used as it is.
    f : function
        f(x) -> (n',), or f(x, u): one point (n,), a new array. Python or numba's.
    sqrt_q : (n', q) array
        A factor of the process noise, any number of columns.
    next_mean, next_sqrt_cov : arrays
        The state after the step, given more.
    u : (d,) array, optional
        Input, handed to the model as a second argument.

    Returns
    -------
    mean, sqrt_cov : arrays
        The state before the step, given as much; the factor is lower triangular, its diagonal not negative.

    Raises
    ------
    NotFinite
        A model function returned NaN or infinity: which, where.
    ValueError
        A shape does not fit or a number is not finite: which argument.
    """
    m, root = given.state(mean, sqrt_cov)
    newer, newer_root = given.state(next_mean, next_sqrt_cov, ("next_mean", "next_sqrt_cov"))
    newer, newer_root = newer.astype(m.dtype), newer_root.astype(m.dtype)
    q = given.noise("sqrt_q", sqrt_q, newer.size, m.dtype)
    work = kernels.workspace(m.size, newer.size, q.shape[1], 1, 1, m)
    new, new_root = np.empty_like(m), np.empty_like(root)
    _run(kernels.smooth_step, (f,), _input(u, m.dtype), m, root, q, newer, newer_root, work, new, new_root)
    return new, new_root


def backward_smoothing_step(
    mean: ArrayLike,
    sqrt_cov: ArrayLike,
    f: Function,
    h: Function,
    z: ArrayLike | None,
    sqrt_q: ArrayLike,
    sqrt_r: ArrayLike,
    angles: Sequence[int] = (),
    u: ArrayLike | None = None,
) -> State:
    """SR-BS-CKF (Tang et al., 2015): a step, one step of smoothing back, and the step again with the same z.

    The second pass feeds the next step. z is used twice, and nothing takes that back: a static scalar has
    1/P_k = 1/P_0 + 2 k/R. What it reports is overconfident (ANEES about 1.6 in the experiment of the paper) and now and
    then a run is lost; its factor is no measure of error for gates, fusion or error bars. ``diplf_step`` uses z once.

    Parameters
    ----------
    mean : (n,) array
        The state before the step; float32 where it and ``sqrt_cov`` are, and then everything is.
    sqrt_cov : (n, n) array
        A factor S of its covariance S S^T; any square one, a lower triangular one is used as it is.
    f : function
        f(x) -> (n',), or f(x, u): one point (n,), a new array. Python or numba's.
    h : function
        h(x) -> (m,), or h(x, u), likewise.
    z : (m,) array or None
        What was measured; NaN where a component is missing.
    sqrt_q : (n', q) array
        A factor of the process noise, any number of columns.
    sqrt_r : (m, r) array
        A factor of the measurement noise.
    angles : sequence of int
        Components of z that are angles, rad: unwrapped about h(mean), innovation in (-pi, pi].
    u : (d,) array, optional
        Input, handed to the model as a second argument.

    Returns
    -------
    mean, sqrt_cov : arrays
        The state given z; the factor is lower triangular, its diagonal not negative.

    Raises
    ------
    NotFinite
        A model function returned NaN or infinity: which, where.
    ValueError
        A shape does not fit or a number is not finite: which argument.
    """
    return _whole(kernels.backward_smoothing_step, mean, sqrt_cov, f, h, z, sqrt_q, sqrt_r, angles, u)


def diplf_step(
    mean: ArrayLike,
    sqrt_cov: ArrayLike,
    f: Function,
    h: Function,
    z: ArrayLike | None,
    sqrt_q: ArrayLike,
    sqrt_r: ArrayLike,
    angles: Sequence[int] = (),
    iterations: int = 1,
    u: ArrayLike | None = None,
) -> State:
    """DIPLF: a step with f and h linearised where the step itself has led, from the original prior; z is used once.

    f is regressed about the smoothed earlier state, h about the filtered one (dynamically iterated posterior
    linearisation filter). One iteration is enough.

    Parameters
    ----------
    mean : (n,) array
        The state before the step; float32 where it and ``sqrt_cov`` are, and then everything is.
    sqrt_cov : (n, n) array
        A factor S of its covariance S S^T; any square one, a lower triangular one is used as it is.
    f : function
        f(x) -> (n',), or f(x, u): one point (n,), a new array. Python or numba's.
    h : function
        h(x) -> (m,), or h(x, u), likewise.
    z : (m,) array or None
        What was measured; NaN where a component is missing.
    sqrt_q : (n', q) array
        A factor of the process noise, any number of columns.
    sqrt_r : (m, r) array
        A factor of the measurement noise.
    angles : sequence of int
        Components of z that are angles, rad: unwrapped about h(mean), innovation in (-pi, pi].
    iterations : int
        How often the step is relinearised, 1 or more.
    u : (d,) array, optional
        Input, handed to the model as a second argument.

    Returns
    -------
    mean, sqrt_cov : arrays
        The state given z; the factor is lower triangular, its diagonal not negative.

    Raises
    ------
    NotFinite
        A model function returned NaN or infinity: which, where.
    ValueError
        A shape does not fit or a number is not finite: which argument.
    """
    if iterations < 1:
        raise ValueError(f"iterations is {iterations}: at least 1 is needed")
    return _whole(kernels.diplf_step, mean, sqrt_cov, f, h, z, sqrt_q, sqrt_r, angles, u, iterations)
