"""The array arithmetic between two calls of a model: points, moments, and the joint arrays of prediction and update.

The 2 n cubature points come in pairs m +- sqrt(n) s_i. A pair y+, y- of images is turned by 45 degrees into

    odd_i  = (y+ - y-) / (2 sqrt n)                even_i = (y+ + y- - 2 mean) / (2 sqrt n)

which has the same products, and leaves of the deviations [S, -S] / sqrt 2 of the points themselves just [S, 0]. The
even parts, zero for a linear model, act as noise: they join the noise factor first, and the joint array is

    Tria([[odd, T], [S, 0]]) = [[L11, 0], [L21, L22]]         T = Tria([even, S_noise])

All of it is transposed (see ``reflections``) and lies in the scratch of a ``Side``. A function is handed the arrays it
works on, never all of the scratch: dozens of arrays cost more to hand over, and to compile, than to work on.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba.extending import register_jitable  # type: ignore[import-untyped, unused-ignore]

from estimator.cubature import reflections
from estimator.cubature.reflections import NULL, Array, annihilate, reduce
from estimator.ud import follow, lean

follow(__file__, reflections.__file__)


class Side(NamedTuple):
    """Scratch of one model function: n inputs, k outputs, q noise columns."""

    points: Array  # (2 n + 1, n), the mean last
    values: Array  # (2 n + 1, k)
    mean: Array  # (k,)
    parts: Array  # (3 n, k): n odd parts, n even ones, and room for what a regression leaves
    noise: Array  # (max(q, k), k)
    top: Array  # (k, k + n): L11^T, L21^T
    below: Array  # (n + k, k + n): L22^T in its last n columns
    floor: Array  # (k,) diagonal of Tria(S_noise)
    slope: Array  # (k, n) of a regression
    shift: Array  # (k,)


class Work(NamedTuple):
    """Scratch of a step: allocate once (``workspace``), use for every step of the same sizes."""

    f: Side
    h: Side
    present: Any  # (m,) int64: which components of z are there
    innovation: Array  # (m,) z minus what was predicted, of those that are there, in their order
    spread: Array  # (m,) its standard deviation
    white: Array  # (m,) S_zz^{-1} innovation
    told: Array  # (3,) of the last update: normalised innovation squared, pivots that were rounding, components used
    every: Any  # (k,) int64: 0, 1 .. k - 1
    stack: Array  # (2 n, n)
    gain: Array  # (n, n) W
    predicted: Array  # (n,)
    predicted_root: Array  # (n, n)
    filtered: Array
    filtered_root: Array
    earlier: Array  # the state before the step, smoothed
    earlier_root: Array


@register_jitable  # type: ignore[misc, unused-ignore]
def side(n: int, k: int, q: int, like: Array) -> Side:
    """Allocate the scratch of a function of n inputs and k outputs with q noise columns, of the dtype of ``like``."""
    dtype = like.dtype
    return Side(
        np.empty((2 * n + 1, n), dtype),
        np.empty((2 * n + 1, k), dtype),
        np.empty(k, dtype),
        np.empty((3 * n, k), dtype),
        np.empty((max(q, k), k), dtype),
        np.empty((k, k + n), dtype),
        np.empty((n + k, k + n), dtype),
        np.empty(k, dtype),
        np.empty((k, n), dtype),
        np.empty(k, dtype),
    )


@register_jitable  # type: ignore[misc, unused-ignore]
def workspace(n: int, k: int, q: int, m: int, r: int, like: Array) -> Work:
    """Allocate the scratch of a step from n to k states with q and r noise columns and m measurements.

    ``like`` is an array whose dtype, float64 or float32, everything has.
    """
    dtype = like.dtype
    return Work(
        side(n, k, q, like),
        side(k, m, r, like),
        np.empty(m, np.int64),
        np.empty(m, dtype),
        np.empty(m, dtype),
        np.empty(m, dtype),
        np.zeros(3, dtype),
        np.arange(k),
        np.empty((n + k, n), dtype),
        np.empty((n, k), dtype),
        np.empty(k, dtype),
        np.empty((k, k), dtype),
        np.empty(k, dtype),
        np.empty((k, k), dtype),
        np.empty(n, dtype),
        np.empty((n, n), dtype),
    )


@lean
def draw(mean: Array, root: Array, points: Array) -> None:
    """Draw the ``points`` (2 n + 1, n): mean +- sqrt(n) times the columns of ``root``, and the mean."""
    n = mean.size
    far = root.dtype.type(np.sqrt(n))
    for i in range(n):
        for k in range(n):
            reach = far * root[k, i]
            points[i, k] = mean[k] + reach
            points[n + i, k] = mean[k] - reach
    for k in range(n):
        points[2 * n, k] = mean[k]


@lean
def moments(values: Array, n: int, k: int, mean: Array, parts: Array) -> None:
    """Mean, odd and even parts of the first ``k`` components of 2 ``n`` images."""
    scale = values.dtype.type(0.5 / np.sqrt(n))
    weight = values.dtype.type(0.5 / n)
    for c in range(k):
        mean[c] = 0.0
    for i in range(n):
        for c in range(k):
            total = values[i, c] + values[n + i, c]
            mean[c] += total
            parts[n + i, c] = total
            parts[i, c] = scale * (values[i, c] - values[n + i, c])
    for c in range(k):
        mean[c] *= weight
    for i in range(n, 2 * n):
        for c in range(k):
            parts[i, c] = scale * (parts[i, c] - (mean[c] + mean[c]))


@lean
def noise_factor(root: Array, rows: Any, k: int, n: int, noise: Array, top: Array, floor: Array) -> None:
    """Tria(S_noise) of the ``k`` rows ``rows`` of ``root`` into ``top``, zeros right of it; diagonal: ``floor``."""
    q = root.shape[1]
    for j in range(q):
        for i in range(k):
            noise[j, i] = root[rows[i], j]
    reduce(noise, q, q - q, k)
    for i in range(k):
        floor[i] = noise[i, i]
        for j in range(k):
            top[i, j] = noise[i, j] if j >= i else 0.0
        for j in range(k, k + n):
            top[i, j] = 0.0


@lean
def couple(root: Array, k: int, n: int, evens: int, parts: Array, top: Array, below: Array, floor: Array) -> None:
    """Even parts into the noise factor, T = Tria([even, S_noise]), and [odd, S^T] into ``below``."""
    annihilate(top, parts[n : n + evens], evens, k, k, floor, 0.0)
    for i in range(n):
        for j in range(k):
            below[i, j] = parts[i, j]
        for j in range(n):
            below[i, k + j] = root[j, i] if j >= i else 0.0


@lean
def take(predicted: Array, top: Array, mean: Array, root: Array) -> None:
    """The mean of the images under f, and L11."""
    k = mean.size
    for i in range(k):
        mean[i] = predicted[i]
        for j in range(k):
            root[i, j] = top[j, i] if j <= i else 0.0


@lean
def copy(source: Array, target: Array, source_root: Array, target_root: Array) -> None:
    """A state into another."""
    for i in range(source.size):
        target[i] = source[i]
        for j in range(source.size):
            target_root[i, j] = source_root[i, j]


@lean
def measured(z: Array, turns: Any, present: Any, told: Array) -> int:
    """List in ``present`` which components of z are there: how many, negative where one of them is an angle."""
    count, angle = 0, False
    for c in range(z.size):
        if z[c] == z[c]:
            present[count] = c
            count += 1
            angle = angle or turns[c]
    told[0], told[1], told[2] = 0.0, 0.0, count
    return -count if angle else count


@lean
def choose(n: int, m: int, turns: Any, present: Any, values: Array) -> None:
    """The ``m`` components that are there of the images under h come first; angles are unwrapped about h(mean)."""
    for j in range(m):
        c = present[j]
        if turns[c]:
            centre = values[2 * n, c]
            for i in range(2 * n):
                values[i, j] = centre + wrapped(values[i, c] - centre)
        elif c != j:
            for i in range(2 * n):
                values[i, j] = values[i, c]


@lean
def compare(z: Array, m: int, turns: Any, present: Any, expected: Array, innovation: Array) -> None:
    """The innovations of the ``m`` components that are there; those of angles are in (-pi, pi]."""
    for j in range(m):
        c = present[j]
        innovation[j] = z[c] - expected[j]
        if turns[c]:
            innovation[j] = wrapped(innovation[j])


@lean
def gain_by(
    m: int,
    dropped: int,
    prior: Array,
    innovation: Array,
    top: Array,
    below: Array,
    spread: Array,
    white: Array,
    told: Array,
    mean: Array,
    out: Array,
) -> None:
    """The update by ``m`` innovations from their joint array; a pivot that is rounding gains nothing."""
    n = prior.size
    square = 0.0
    for k in range(n):
        mean[k] = prior[k]
    for j in range(m):
        value, variance = innovation[j], 0.0
        for i in range(j):
            value -= top[i, j] * white[i]
        for i in range(j + 1):
            variance += top[i, j] * top[i, j]
        spread[j] = np.sqrt(variance)
        white[j] = value / top[j, j] if top[j, j] > 0.0 else 0.0
        square += white[j] * white[j]
        for k in range(n):
            mean[k] += top[j, m + k] * white[j]
    told[0], told[1], told[2] = square, dropped, m
    reduce(below, n + dropped, m, m + n)
    for i in range(n):
        for j in range(n):
            out[i, j] = below[j, m + i] if j <= i else 0.0


@lean
def retrace(
    dropped: int,
    prior: Array,
    predicted: Array,
    newer: Array,
    newer_root: Array,
    top: Array,
    below: Array,
    gain: Array,
    stack: Array,
    mean: Array,
    out: Array,
) -> None:
    """From the joint array of a prediction, rounding left out, and the newer state, to the older state given both.

    W = L21 L11^{-1};  m + W (m_newer - m_predicted);  Tria([L22, W S_newer]). ``mean`` and ``out`` may be the inputs.
    """
    n, k = prior.size, newer.size
    for j in range(k - 1, -1, -1):
        pivot = top[j, j]
        for i in range(n):
            value = top[j, k + i]
            for c in range(j + 1, k):
                value -= gain[i, c] * top[j, c]
            gain[i, j] = value / pivot if pivot > 0.0 else 0.0
    reduce(below, n + dropped, k, k + n)
    for i in range(n):
        for j in range(n):
            stack[i, j] = below[i, k + j]
    for c in range(k):
        for i in range(n):
            value = stack.dtype.type(0.0)
            for j in range(c, k):
                value += gain[i, j] * newer_root[j, c]
            stack[n + c, i] = value
    for i in range(n):
        value = prior[i]
        for j in range(k):
            value += gain[i, j] * (newer[j] - predicted[j])
        mean[i] = value
    reduce(stack, n + k, n - n, n)
    for i in range(n):
        for j in range(n):
            out[i, j] = stack[j, i] if j <= i else 0.0


@lean
def wrapped(angle: Any) -> Any:
    """``angle`` in (-pi, pi], in its own precision."""
    turn = 2.0 * np.pi
    return angle - turn * np.ceil((angle - np.pi) / turn)


@lean
def regress(root: Array, n: int, k: int, slope: Array, parts: Array) -> None:
    """Slope A of y about N(., S S^T): A S = odd, column by column; zero where a pivot of S is rounding.

    Leaves in ``parts`` what the slope does not explain: nothing but for those columns.
    """
    few = NULL * n * np.finfo(root.dtype).eps
    for j in range(n - 1, -1, -1):
        norm = 0.0
        for i in range(j + 1):
            norm += root[j, i] * root[j, i]
        pivot = root[j, j]
        null = pivot <= few * np.sqrt(norm)
        for c in range(k):
            value = parts[j, c]
            for i in range(j + 1, n):
                value -= slope[c, i] * root[i, j]
            slope[c, j] = 0.0 if null else value / pivot
            parts[j, c] = value if null else 0.0


@lean
def reproject(root: Array, n: int, k: int, slope: Array, parts: Array) -> int:
    """A S of the ``root`` (n, n) S in the place of the odd parts; the errors of the regression join the even ones.

    Returns how many rows of ``parts`` after the odd ones are in use.
    """
    rows = n
    for j in range(n):
        left = False
        for c in range(k):
            left = left or parts[j, c] != 0.0
            parts[n + min(rows, 2 * n - 1), c] = parts[j, c]
        if left:
            rows += 1
        for c in range(k):
            value = parts.dtype.type(0.0)
            for i in range(j, n):
                value += slope[c, i] * root[i, j]
            parts[j, c] = value
    return rows


@lean
def extrapolate(at: Array, about: Array, k: int, mean: Array, slope: Array, out: Array) -> None:
    """A regression about ``about``, at ``at``: mean + A (at - about)."""
    n = at.size
    for c in range(k):
        value = mean[c]
        for i in range(n):
            value += slope[c, i] * (at[i] - about[i])
        out[c] = value
