"""Calls of a model function from compiled code, and from Python code, by one name.

``images`` is a Python function that compiled code may call as well: what is compiled depends on whether there are
inputs.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import types  # type: ignore[import-untyped, unused-ignore]
from numba.extending import overload  # type: ignore[import-untyped, unused-ignore]

from estimator.cubature.reflections import Array

FINE, INFINITE, SHAPE = 0, 1, 3  # and one more where it is h
COUNTED: Any = {"_nrt": True}  # a model returns an array: it is to be let go, even where the caller counts none


def images(function: Any, u: Any, points: Array, count: int, values: Array) -> int:
    """Fill ``values`` with the images of the first ``count`` rows of ``points``; FINE, INFINITE or SHAPE."""
    for i in range(count):
        point = points[i].copy()
        y = np.asarray(function(point) if u is None else function(point, u))
        if y.shape != values.shape[1:]:
            return SHAPE
        values[i] = y
    return FINE if np.isfinite(values[:count]).all() else INFINITE


@overload(images, jit_options=COUNTED)
def _images(function: Any, u: Any, points: Array, count: int, values: Array) -> Any:
    if isinstance(u, types.NoneType):

        def alone(function: Any, u: Any, points: Array, count: int, values: Array) -> int:
            for i in range(count):
                y = function(points[i])
                if y.size != values.shape[1]:
                    return SHAPE
                for c in range(values.shape[1]):
                    values[i, c] = y[c]
                    if not abs(values[i, c]) < np.inf:
                        return INFINITE
            return FINE

        return alone

    def driven(function: Any, u: Any, points: Array, count: int, values: Array) -> int:
        for i in range(count):
            y = function(points[i], u)
            if y.size != values.shape[1]:
                return SHAPE
            for c in range(values.shape[1]):
                values[i, c] = y[c]
                if not abs(values[i, c]) < np.inf:
                    return INFINITE
        return FINE

    return driven
