"""U-D kernels: what the information filter and its smoother are made of, compiled.

A symmetric matrix is held as U diag(d) U^T with U unit upper triangular. The array is always ``ut``, the transpose of U
(``ut[j, i] = U[i, j]``): every loop below runs down a column of U, which is then a contiguous row. A factor may carry
data: ``ut`` (n, K + n) has K columns in front, row j = [eta_j of K records, U_0j .. U_jj, 0 ..], and whatever is done
to the columns of U is done to them. K = 0 is the plain factor.

Matrices are C-contiguous, float64 or float32; nothing is allocated inside a loop. Where one array is read and written,
rows are cut out as slices, because loops over them are vectorised; where several arrays are, indices are faster.

The sweeps over many steps that call all of it are in ``sweeps``.

References
----------
.. [1] G. J. Bierman, "Factorization Methods for Discrete Sequential Estimation", Academic Press, 1977.
.. [2] R. Fletcher and M. J. D. Powell, "On the modification of LDL^T factorizations", Math. Comp. 28 (1974) 1067-1087.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, ParamSpec, TypeVar, cast

import numpy as np
from numba import njit  # type: ignore[import-untyped, unused-ignore]
from numpy.typing import NDArray

Array = NDArray[np.float64]  # or float32: a model says which, and everything made from it follows
Order = NDArray[np.int64]
P = ParamSpec("P")
T = TypeVar("T")


# All is said, for what is not said a function takes from the kernel for which it happens to be compiled.
EXACT: Any = {"cache": True, "nogil": True, "error_model": "numpy", "fastmath": False, "forceinline": False}
LEAN: Any = EXACT | {"_nrt": False}
COMPILED: Any = EXACT | {"fastmath": {"reassoc", "contract", "nsz"}}


def compiled(function: Callable[P, T]) -> Callable[P, T]:
    """Compile with numba and keep the declared type: what only Python calls; what kernels call is `part` or `exact`.

    NaN and infinity keep their meaning: they mark what is missing, and a division by zero is one of them, not an error.
    Sums are reassociated and products fused with them.
    """
    return cast(Callable[P, T], njit(**COMPILED)(function))


def part(function: Callable[P, T]) -> Callable[P, T]:
    """Compile as `compiled`, as a part of every kernel that calls it.

    Two compilations of reassociated code need not round alike. A kernel has its own copy of what it calls; but in the
    process that compiles both, the linker takes what was compiled first in its place, and the first flight on a machine
    would differ from all later ones. What is inlined has no place.
    """
    return cast(Callable[P, T], njit(**(COMPILED | {"forceinline": True}))(function))


def exact(function: Callable[P, T]) -> Callable[P, T]:
    """Compile as `compiled`, but with every operation rounded as IEEE 754 says: the same bits wherever it is used."""
    return cast(Callable[P, T], njit(**EXACT)(function))


def lean(function: Callable[P, T]) -> Callable[P, T]:
    """Compile as `exact`, for functions that allocate nothing: no references are counted.

    With dozens of arrays in hand, that costs more than what is done with them.
    """
    return cast(Callable[P, T], njit(**LEAN)(function))


def follow(caller: str, *callees: str) -> None:
    """Forget the compiled kernels of the file ``caller`` where those here, or those of ``callees``, have changed since.

    numba's on-disk cache asks only whether the caller's own file has changed, and would go on running the old code of a
    changed callee. What they were compiled from is noted beside them.
    """
    cache = Path(caller).parent / "__pycache__"
    note = cache / f"{Path(caller).stem}.follows"
    with suppress(OSError):
        content = b"".join(Path(path).read_bytes() for path in sorted({__file__, caller, *callees}))
        digest = hashlib.sha256(content).hexdigest()
        if not note.exists() or note.read_text() != digest:
            for index in cache.glob(f"{Path(caller).stem}.*.nbi"):
                index.unlink(missing_ok=True)
            cache.mkdir(exist_ok=True)
            note.write_text(digest)


@part
def bierman(ut: Array, d: Array, h: Array, r: float, k: Array) -> float:
    """Downdate P = U D U^T by one scalar: P <- P - P h h^T P / s, s = r + h^T P h [1]_. Needs r > 0.

    Overwrites ``ut`` (n, K + n) and ``d`` (n,); ``h`` is (n,). Fills ``k`` (K + n,): P h of the old P, and in the K
    places in front what the data say of it, eta^T D U^T h. Returns s.
    """
    n = d.size
    data = ut.shape[1] - n
    a = r
    for i in range(data):
        k[i] = 0.0
    for j in range(n):
        f = h[j]
        for i in range(j):
            f += ut[j, data + i] * h[i]
        v = d[j] * f
        k[data + j] = v
        if v != 0.0:
            grown = a + f * v
            d[j] *= a / grown
            gain = f / a
            for i in range(data + j):
                t = ut[j, i]
                ut[j, i] = t - gain * k[i]
                k[i] += v * t
            a = grown
    return a


@part
def agee_turner(ut: Array, d: Array, a: Array, c: float) -> float:
    """Update U D U^T <- U D U^T + c a a^T, c >= 0. Overwrites ``ut`` (n, K + n), ``d`` (n,) and ``a`` (K + n,).

    Returns the weight that is left: of the K data in front of ``a`` it leaves residuals, whose squares times that
    weight are what the scalar disagrees with all that was known. Both branches are one number in exact arithmetic
    (1 - beta s = rho). The second is the composite of Fletcher and Powell [2]_: without it a datum that dwarfs the
    pivot, and every start without prior, loses all digits.
    """
    n = d.size
    data = ut.shape[1] - n
    for j in range(n - 1, -1, -1):
        s = a[data + j]
        v = c * s
        dn = d[j] + v * s
        if v == 0.0 or dn == 0.0:
            continue
        beta = v / dn
        rho = d[j] / dn
        c *= rho
        d[j] = dn
        if rho > 0.25:
            for i in range(data + j):
                t = a[i] - s * ut[j, i]
                a[i] = t
                ut[j, i] += beta * t
        else:
            for i in range(data + j):
                t = a[i]
                a[i] = t - s * ut[j, i]
                ut[j, i] = rho * ut[j, i] + beta * t
        if c == 0.0:
            break
    return c


@part
def agee_turner_all(ut: Array, d: Array, a: Array, c: Array, count: int) -> None:
    """The updates of ``agee_turner`` with the first ``count`` rows of ``a`` (k, K + n), weights ``c`` (k,), in order.

    Leaves in ``a`` the residuals and in ``c`` the weights that are left. Column by column instead of row by row: the
    numbers are the same, but the short chains of dependent operations of several rows overlap.
    """
    n = d.size
    data = ut.shape[1] - n
    for j in range(n - 1, -1, -1):
        for b in range(count):
            s = a[b, data + j]
            v = c[b] * s
            dn = d[j] + v * s
            if v == 0.0 or dn == 0.0:
                continue
            beta = v / dn
            rho = d[j] / dn
            c[b] *= rho
            d[j] = dn
            if rho > 0.25:
                for i in range(data + j):
                    t = a[b, i] - s * ut[j, i]
                    a[b, i] = t
                    ut[j, i] += beta * t
            else:
                for i in range(data + j):
                    t = a[b, i]
                    a[b, i] = t - s * ut[j, i]
                    ut[j, i] = rho * ut[j, i] + beta * t


@exact
def mwgs(w: Array, weight: Array, ut: Array, d: Array) -> None:
    """Modified weighted Gram-Schmidt [1]_: W diag(weight) W^T = U D U^T for ``w`` (K + n, k), which is overwritten.

    Fills ``ut`` (n, K + n) and ``d`` (n,). A row that is nothing but the later rows gives a zero pivot and a zero
    column. The first K rows are data: they are expressed by the others and have no pivots.
    """
    n, count = d.size, w.shape[1]
    data = w.shape[0] - n
    heavy = np.empty(count, w.dtype)
    for j in range(n - 1, -1, -1):
        row = w[data + j]
        total = 0.0
        for k in range(count):
            heavy[k] = row[k] * weight[k]
            total += row[k] * heavy[k]
        d[j] = total
        ut[j, :] = 0.0
        ut[j, data + j] = 1.0
        if total > 0.0:
            for i in range(data + j):
                other = w[i]
                dot = 0.0
                for k in range(count):
                    dot += other[k] * heavy[k]
                dot /= total
                ut[j, i] = dot
                for k in range(count):
                    other[k] -= dot * row[k]


@exact
def faint(a: Array, column: int, pivot: float, few: float) -> bool:
    """Is the square of ``pivot`` not above ``few`` times that of the largest entry of its column of ``a``?"""
    largest = 0.0
    for i in range(a.shape[0]):
        largest = max(largest, abs(a[i, column]))
    return not abs(pivot) > np.sqrt(few) * largest


@exact
def factor(a: Array, lu: Array, order: Order, eps: float = 2.3e-16) -> bool:
    """LU with partial pivoting: row ``order[i]`` of ``a`` (n, n) is row i of L U, both in ``lu``. True: a is singular.

    A pivot is judged against the largest entry of its own column, so that units do not make a matrix singular; ``eps``
    is the rounding unit of its numbers. Two pivots at a time: what is below them is then passed over half as often.
    """
    n = a.shape[0]
    square = 0.0
    for i in range(n):
        order[i] = i
        for j in range(n):
            lu[i, j] = a[i, j]
            square += a[i, j] * a[i, j]
    few = (4.0 * n * eps) ** 2
    singular = False
    for k in range(0, n, 2):
        best = k
        for i in range(k + 1, n):
            if abs(lu[i, k]) > abs(lu[best, k]):
                best = i
        if best != k:
            order[k], order[best] = order[best], order[k]
            for j in range(n):
                lu[k, j], lu[best, j] = lu[best, j], lu[k, j]
        if not lu[k, k] * lu[k, k] > few * square and faint(a, k, lu[k, k], few):
            singular = True
            if not abs(lu[k, k]) > 0.0:
                return True
        if k + 1 == n:
            break
        inverse, ahead = 1.0 / lu[k, k], lu[k, k + 1]
        best = k + 1
        for i in range(k + 1, n):
            t = lu[i, k] * inverse
            lu[i, k] = t
            lu[i, k + 1] -= t * ahead
            if abs(lu[i, k + 1]) > abs(lu[best, k + 1]):
                best = i
        if best != k + 1:
            order[k + 1], order[best] = order[best], order[k + 1]
            for j in range(n):
                lu[k + 1, j], lu[best, j] = lu[best, j], lu[k + 1, j]
        if not lu[k + 1, k + 1] * lu[k + 1, k + 1] > few * square and faint(a, k + 1, lu[k + 1, k + 1], few):
            singular = True
            if not abs(lu[k + 1, k + 1]) > 0.0:
                return True
        first, second = lu[k, k + 2 :], lu[k + 1, k + 2 :]
        t = lu[k + 1, k]
        for j in range(first.size):
            second[j] -= t * first[j]
        inverse = 1.0 / lu[k + 1, k + 1]
        for i in range(k + 2, n):
            t = lu[i, k]
            s = lu[i, k + 1] * inverse
            lu[i, k + 1] = s
            below = lu[i, k + 2 :]
            for j in range(first.size):
                below[j] -= t * first[j] + s * second[j]
    return singular


@exact
def solve(lu: Array, order: Order, b: Array, x: Array) -> None:
    """Fill ``x`` (n, k) with A^{-1} b from the factors of A; all columns advance together, two rows at a time."""
    n, count = x.shape
    for i in range(n):
        own, given = x[i], b[order[i]]
        for k in range(count):
            own[k] = given[k]
        for j in range(0, i - 1, 2):
            t, s, first, second = lu[i, j], lu[i, j + 1], x[j], x[j + 1]
            for k in range(count):
                own[k] -= t * first[k] + s * second[k]
        if i % 2 == 1:
            t, first = lu[i, i - 1], x[i - 1]
            for k in range(count):
                own[k] -= t * first[k]
    for i in range(n - 1, -1, -1):
        own = x[i]
        for j in range(i + 1, n - 1, 2):
            t, s, first, second = lu[i, j], lu[i, j + 1], x[j], x[j + 1]
            for k in range(count):
                own[k] -= t * first[k] + s * second[k]
        if (n - i) % 2 == 0:
            t, first = lu[i, n - 1], x[n - 1]
            for k in range(count):
                own[k] -= t * first[k]
        t = 1.0 / lu[i, i]
        for k in range(count):
            own[k] *= t


@exact
def solve_vector(lu: Array, order: Order, b: Array, x: Array) -> None:
    """Fill ``x`` (n,) with A^{-1} b from the factors of A."""
    n = x.size
    for i in range(n):
        t, row, known = b[order[i]], lu[i, :i], x[:i]
        for j in range(i):
            t -= row[j] * known[j]
        x[i] = t
    for i in range(n - 1, -1, -1):
        t, row, known = x[i], lu[i, i + 1 :], x[i + 1 :]
        for j in range(known.size):
            t -= row[j] * known[j]
        x[i] = t / lu[i, i]


@exact
def solve_transposed(lu: Array, order: Order, b: Array, x: Array) -> None:
    """Overwrite ``b`` (n,) and fill ``x`` (n,) with A^{-T} b from the factors of A."""
    n = b.size
    for i in range(n):
        b[i] /= lu[i, i]
        t, row, rest = b[i], lu[i, i + 1 :], b[i + 1 :]
        for j in range(rest.size):
            rest[j] -= t * row[j]
    for i in range(n - 1, -1, -1):
        t, row, rest = b[i], lu[i, :i], b[:i]
        for j in range(i):
            rest[j] -= t * row[j]
        x[order[i]] = b[i]
