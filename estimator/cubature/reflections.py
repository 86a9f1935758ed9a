"""Triangular factors of stacked rows by Householder reflections, compiled: what the square-root filters are made of.

``Tria(A)`` is the lower triangular L with L L^T = A A^T. Arrays are held transposed here: a row of an array is a column
of A, so that a sigma point is one contiguous row, and what comes out is the upper triangular L^T. In a column, the row
with the largest entry is taken as the pivot and the reflection has the sign that does not cancel: rows that differ by
many orders of magnitude (a wide prior, an accurate measurement) each keep their own digits [1]_. The sign of a finished
row makes its diagonal entry non-negative.

References
----------
.. [1] A. J. Cox and N. J. Higham, "Stability of Householder QR factorization for weighted least squares problems",
   Numerical Analysis 1997, Pitman Research Notes 380 (1998) 57-73.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.ud import exact, follow, lean

follow(__file__)

Array = NDArray[Any]  # float64 or float32: what goes in says which

NULL = 50.0  # a pivot of k columns is rounding where it is below NULL k eps of its row of the factor,
REAL = 8.0  # unless the noise alone makes it larger than REAL eps of that row

SMALL, LARGE = 1e-15, 1e15  # of a norm: their squares are normal numbers in either precision

ONE, TWO, THREE, FOUR = np.uintp(1), np.uintp(2), np.uintp(3), np.uintp(4)


@lean
def reflect(top: Array, row: int, others: Array, first: int, stop: int, at: int, columns: int) -> None:
    """One reflection: ``others[first:stop, at]`` becomes zero, ``top[row, at]`` the norm of what was there.

    Row ``row`` of ``top`` is a row that is not one of ``others[first:stop]``. Columns ``at`` to ``columns`` are
    overwritten, four at a time: their sums are independent of one another.
    """
    # unsigned, so that no index is taken to count from the end
    r, begin, end = np.uintp(row), np.uintp(first), np.uintp(stop)
    column, width = np.uintp(at), np.uintp(columns)
    head = top[r, column]
    best: Any = begin
    largest, rest = abs(head), 0.0
    found = False
    for i in range(begin, end):
        value = others[i, column]
        rest += value * value
        if abs(value) > largest:
            best, largest, found = i, abs(value), True
    if rest == 0.0 and not found and head >= 0.0:
        return
    norm = np.sqrt(rest + head * head)
    if found:
        for swap in range(column, width):
            top[r, swap], others[best, swap] = others[best, swap], top[r, swap]
        head = top[r, column]
    if not SMALL < norm < LARGE:  # the squares may have left the range of the numbers
        if largest == 0.0 or not top.dtype.type(1.0 / largest) < np.inf:
            for i in range(begin, end):
                others[i, column] = 0.0
            top[r, column] = 0.0
            return
        total = (head / largest) * (head / largest)
        for i in range(begin, end):
            ratio = others[i, column] / largest
            total += ratio * ratio
        norm = largest * np.sqrt(total)
    sign = 1.0 if head < 0.0 else -1.0
    divisor = head - sign * norm
    inverse, scale = top.dtype.type(1.0) / divisor, (norm + abs(head)) / norm
    for i in range(begin, end):
        others[i, column] *= inverse
    k: Any = column + ONE
    while k + THREE < width:
        a, b, c, d = top[r, k], top[r, k + ONE], top[r, k + TWO], top[r, k + THREE]
        for i in range(begin, end):
            t = others[i, column]
            a += t * others[i, k]
            b += t * others[i, k + ONE]
            c += t * others[i, k + TWO]
            d += t * others[i, k + THREE]
        a *= scale
        b *= scale
        c *= scale
        d *= scale
        top[r, k] = sign * (top[r, k] - a)
        top[r, k + ONE] = sign * (top[r, k + ONE] - b)
        top[r, k + TWO] = sign * (top[r, k + TWO] - c)
        top[r, k + THREE] = sign * (top[r, k + THREE] - d)
        for i in range(begin, end):
            t = others[i, column]
            others[i, k] -= t * a
            others[i, k + ONE] -= t * b
            others[i, k + TWO] -= t * c
            others[i, k + THREE] -= t * d
        k += FOUR
    while k < width:
        a = top[r, k]
        for i in range(begin, end):
            a += others[i, column] * others[i, k]
        a *= scale
        top[r, k] = sign * (top[r, k] - a)
        for i in range(begin, end):
            others[i, k] -= others[i, column] * a
        k += ONE
    top[r, column] = norm
    for i in range(begin, end):
        others[i, column] = 0.0


@lean
def reduce(a: Array, rows: int, first: int, width: int) -> None:
    """Make ``a[:rows, first:width]`` upper triangular, in place. Rows below the triangle become zero.

    Needs at least as many rows as columns in ``a``: those from ``rows`` on are taken to be zero and are set so.
    """
    for i in range(rows, width - first):
        for k in range(first, width):
            a[i, k] = 0.0
    for j in range(width - first):
        reflect(a, j, a, j + 1, rows, first + j, width)


@lean
def echelon(root: Array, rows: Array) -> None:
    """Bring a singular factor to the form in which a pivot that is rounding has an empty column; else leave it.

    Under such a pivot may stand what is known of later states. It goes to their own pivots, by which a regression can
    divide. ``rows`` is scratch of as many rows and columns.
    """
    n = root.shape[0]
    few = NULL * n * np.finfo(root.dtype).eps
    singular = False
    for j in range(n):
        norm = 0.0
        for i in range(j + 1):
            norm += root[j, i] * root[j, i]
        singular = singular or root[j, j] <= few * np.sqrt(norm)
    if not singular:
        return
    for i in range(n):
        for j in range(n):
            rows[j, i] = root[i, j] if j <= i else 0.0
    rank = n - n
    for j in range(n):
        before, pivot = 0.0, 0.0
        for i in range(rank):
            before += rows[i, j] * rows[i, j]
        for i in range(rank, n):
            pivot += rows[i, j] * rows[i, j]
        if np.sqrt(pivot) <= few * np.sqrt(before + pivot):
            for i in range(rank, n):
                rows[i, j] = 0.0
        else:
            reflect(rows, rank, rows, rank + 1, n, j, n)
            rank += 1
    for i in range(n):
        for j in range(n):
            root[i, j] = 0.0
    for i in range(rank):
        first = i
        while first < n - 1 and rows[i, first] == 0.0:
            first += 1
        for j in range(first, n):
            root[j, first] = rows[i, j]


@lean
def annihilate(top: Array, below: Array, rows: int, count: int, width: int, floor: Array, drop: float) -> int:
    """Reflect ``below[:rows]`` into the triangle ``top`` (count, width): its first ``count`` columns become zero.

    A pivot that is not above NULL count eps times the norm of its row of the factor is rounding, unless ``floor`` of
    its column (what the noise alone makes of it) is above REAL eps times that norm. Returns how many are: with ``drop``
    0 nobody looks, with -1 they are counted, and with 1 such a column is left out: its row of ``top`` is zero, nothing
    is taken from ``below`` for it, and what the row still said of the later columns is one more row of ``below`` (which
    has ``count`` rows to spare).
    """
    found, begin = 0, count - count
    eps = np.finfo(top.dtype).eps
    few, real = NULL * count * eps, REAL * eps
    for j in range(count):
        if drop != 0.0:
            largest = abs(top[j, j])
            for i in range(rows):
                largest = max(largest, abs(below[i, j]))
            before = 0.0
            for i in range(j):
                before = max(before, abs(top[i, j]))
            # the norms lie within a factor sqrt(rows) of the largest entries: only then is it worth a closer look
            if largest <= few * before * (j + 1.0):
                before, pivot = 0.0, top[j, j] * top[j, j]
                for i in range(rows):
                    pivot += below[i, j] * below[i, j]
                for i in range(j):
                    before += top[i, j] * top[i, j]
                norm = np.sqrt(before + pivot)
                if np.sqrt(pivot) <= few * norm and floor[j] <= real * norm:
                    found += 1
                    if drop > 0.0:
                        below[rows, j] = 0.0
                        for k in range(j + 1, width):
                            below[rows, k] = top[j, k]
                        for k in range(j, width):
                            top[j, k] = 0.0
                        rows += 1
                        continue
        reflect(top, j, below, begin, rows, j, width)
    return found


@exact
def _tria(a: Array, out: Array) -> None:
    n, columns = a.shape
    rows = max(n, columns)
    b = np.zeros((rows, n), a.dtype)
    for i in range(n):
        for j in range(columns):
            b[j, i] = a[i, j]
    reduce(b, columns, n - n, n)
    for i in range(n):
        for j in range(n):
            out[i, j] = b[j, i] if j <= i else 0.0


def triangular(a: Any) -> Array:
    """Tria(A): the lower triangular L with non-negative diagonal and L L^T = A A^T.

    Parameters
    ----------
    a : (n, k) array
        Any number of columns; fewer than n leave zero columns on the right.

    Returns
    -------
    (n, n) array
        float32 of float32, float64 of anything else.

    Raises
    ------
    ValueError
        ``a`` has not two dimensions, or an entry is not finite.
    """
    given = np.asarray(a)
    array = np.ascontiguousarray(given, np.float32 if given.dtype == np.float32 else np.float64)
    if array.ndim != 2 or not array.shape[0]:
        raise ValueError(f"a has shape {array.shape}: (n, k) is needed")
    if not np.isfinite(array).all():
        raise ValueError("a is not finite")
    out = np.empty((array.shape[0], array.shape[0]), array.dtype)
    _tria(array if array.flags.writeable else array.copy(), out)
    return out
