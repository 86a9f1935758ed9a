"""U-D kernels: what the information filter and its smoother are made of, compiled.

A symmetric matrix is held as U diag(d) U^T with U unit upper triangular. The array is always ``ut``, the transpose of U
(``ut[j, i] = U[i, j]``): every loop below runs down a column of U, which is then a contiguous row. Matrices are
C-contiguous float64; nothing is allocated inside a loop.

Nothing here calls anything else here; the sweeps over many steps that call all of it are in ``sweeps``.

References
----------
.. [1] G. J. Bierman, "Factorization Methods for Discrete Sequential Estimation", Academic Press, 1977.
.. [2] R. Fletcher and M. J. D. Powell, "On the modification of LDL^T factorizations", Math. Comp. 28 (1974) 1067-1087.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import ParamSpec, TypeVar, cast

import numpy as np
from numba import njit  # type: ignore[import-untyped, unused-ignore]
from numpy.typing import NDArray

Array = NDArray[np.float64]
Order = NDArray[np.int64]
P = ParamSpec("P")
T = TypeVar("T")


def compiled(function: Callable[P, T]) -> Callable[P, T]:
    """Compile with numba and keep the declared type. NaN and infinity keep their meaning: they mark what is missing."""
    return cast(Callable[P, T], njit(cache=True, nogil=True, fastmath={"reassoc", "contract", "nsz"})(function))


@compiled
def bierman(ut: Array, d: Array, h: Array, r: float, k: Array) -> float:
    """Downdate P = U D U^T by one scalar: P <- P - P h h^T P / s, s = r + h^T P h [1]_. Needs r > 0.

    Overwrites ``ut`` (n, n) and ``d`` (n,); fills ``k`` (n,) with P h of the old P; returns s.
    """
    a = r
    for j in range(d.size):
        f = h[j]
        for i in range(j):
            f += ut[j, i] * h[i]
        v = d[j] * f
        k[j] = v
        if v != 0.0:
            grown = a + f * v
            d[j] *= a / grown
            gain = f / a
            for i in range(j):
                t = ut[j, i]
                ut[j, i] = t - gain * k[i]
                k[i] += v * t
            a = grown
    return a


@compiled
def agee_turner(ut: Array, d: Array, a: Array, c: float) -> float:
    """Update U D U^T <- U D U^T + c a a^T, c >= 0. Overwrites ``ut``, ``d`` and ``a``; returns what was added to d[0].

    Both branches are one number in exact arithmetic (1 - beta s = rho). The second is the composite of Fletcher and
    Powell [2]_: without it a datum that dwarfs the pivot, and every start without prior, loses all digits.
    """
    for j in range(d.size - 1, 0, -1):
        s = a[j]
        if s == 0.0:
            continue
        v = c * s
        dn = d[j] + v * s
        if dn == 0.0:
            continue
        beta = v / dn
        rho = d[j] / dn
        c *= rho
        d[j] = dn
        if rho > 0.25:
            for i in range(j):
                t = a[i] - s * ut[j, i]
                a[i] = t
                ut[j, i] += beta * t
        else:
            for i in range(j):
                t = a[i]
                a[i] = t - s * ut[j, i]
                ut[j, i] = rho * ut[j, i] + beta * t
        if c == 0.0:
            return 0.0
    added: float = c * a[0] * a[0]
    d[0] += added
    return added


@compiled
def mwgs(w: Array, weight: Array, ut: Array, d: Array) -> None:
    """Modified weighted Gram-Schmidt [1]_: W diag(weight) W^T = U D U^T for ``w`` (n, k), which is overwritten.

    Fills ``ut`` (n, n) and ``d`` (n,). A row that is nothing but the later rows gives a zero pivot and a zero column.
    """
    n, count = w.shape
    for j in range(n - 1, -1, -1):
        total = 0.0
        for k in range(count):
            total += w[j, k] * w[j, k] * weight[k]
        d[j] = total
        ut[j, :] = 0.0
        ut[j, j] = 1.0
        if total > 0.0:
            for i in range(j):
                dot = 0.0
                for k in range(count):
                    dot += w[i, k] * (w[j, k] * weight[k])
                dot /= total
                ut[j, i] = dot
                for k in range(count):
                    w[i, k] -= dot * w[j, k]


@compiled
def factor(a: Array, lu: Array, order: Order) -> bool:
    """LU with partial pivoting: row ``order[i]`` of ``a`` (n, n) is row i of L U, both in ``lu``. True: a is singular.

    A pivot is judged against the largest entry of its own column, so that units do not make a matrix singular.
    """
    n = a.shape[0]
    lu[:, :] = a
    for i in range(n):
        order[i] = i
    singular = False
    for k in range(n):
        column = 0.0
        for i in range(n):
            column = max(column, abs(a[i, k]))
        best = k
        for i in range(k + 1, n):
            if abs(lu[i, k]) > abs(lu[best, k]):
                best = i
        if best != k:
            order[k], order[best] = order[best], order[k]
            for j in range(n):
                lu[k, j], lu[best, j] = lu[best, j], lu[k, j]
        if not abs(lu[k, k]) > 4.0 * n * 2.2e-16 * column:
            singular = True
            if not abs(lu[k, k]) > 0.0:
                return True
        for i in range(k + 1, n):
            if lu[i, k] != 0.0:
                t = lu[i, k] / lu[k, k]
                lu[i, k] = t
                for j in range(k + 1, n):
                    lu[i, j] -= t * lu[k, j]
    return singular


@compiled
def solve(lu: Array, order: Order, b: Array, x: Array) -> None:
    """Fill ``x`` (n, k) with A^{-1} b from the factors of A; all columns advance together, row by row."""
    n, count = x.shape
    for i in range(n):
        for k in range(count):
            x[i, k] = b[order[i], k]
        for j in range(i):
            t = lu[i, j]
            if t != 0.0:
                for k in range(count):
                    x[i, k] -= t * x[j, k]
    for i in range(n - 1, -1, -1):
        for j in range(i + 1, n):
            t = lu[i, j]
            if t != 0.0:
                for k in range(count):
                    x[i, k] -= t * x[j, k]
        t = 1.0 / lu[i, i]
        for k in range(count):
            x[i, k] *= t


@compiled
def solve_transposed(lu: Array, order: Order, b: Array, x: Array) -> None:
    """Overwrite ``b`` (n,) and fill ``x`` (n,) with A^{-T} b from the factors of A."""
    n = b.size
    for i in range(n):
        b[i] /= lu[i, i]
        for j in range(i + 1, n):
            b[j] -= lu[i, j] * b[i]
    for i in range(n - 1, -1, -1):
        for j in range(i):
            b[j] -= lu[i, j] * b[i]
        x[order[i]] = b[i]


@compiled
def multiply(a: Array, b: Array, out: Array) -> None:
    """Fill ``out`` with A B; transition and measurement matrices are mostly zeros, which are skipped."""
    for i in range(a.shape[0]):
        out[i, :] = 0.0
        for k in range(a.shape[1]):
            t = a[i, k]
            if t != 0.0:
                for j in range(b.shape[1]):
                    out[i, j] += t * b[k, j]
