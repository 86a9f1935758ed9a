"""What the two U-D rivals share: a smoothed covariance moved by phi, conditioned on a noise component, written out.

Matrices are held as in ``ud``: ``ut`` is the transpose of U.
"""

from __future__ import annotations

import numpy as np

from estimator import ud
from estimator.ud import Array, agee_turner, bierman, compiled, mwgs

ud.follow(__file__)


@compiled
def carried(a: Array, ut: Array, u: Array, w: Array) -> None:
    """Fill ``w`` (n, n) with A U; ``u`` (n, n) is scratch. Half of the products: U is unit upper triangular."""
    n = ut.shape[0]
    for i in range(n):
        for j in range(i):
            u[j, i] = ut[i, j]
    for i in range(n):
        row, given = w[i], a[i]
        for j in range(n):
            row[j] = given[j]
        for c in range(0, n - 1, 2):
            t, s = given[c], given[c + 1]
            row[c + 1] += t * u[c, c + 1]
            first, second, tail = u[c, c + 2 :], u[c + 1, c + 2 :], row[c + 2 :]
            for j in range(tail.size):
                tail[j] += t * first[j] + s * second[j]


@compiled
def condition(
    ut: Array, d: Array, g: Array, b: Array, qs: float, per_component_mwgs: bool,
    k: Array, w: Array, weight: Array,
) -> None:  # fmt: skip
    """P <- (I - g b^T) P (I - g b^T)^T + qs g g^T for P = U D U^T, overwritten: a sum of two positive terms.

    Two rank-one steps of n^2 each: with k = P b and s = qs + b^T P b it is (P - k k^T / s) + s (g - k/s)(g - k/s)^T.
    Or, ``per_component_mwgs`` and where qs is zero, one orthogonalisation of the n x (n+1) array [(I - g b^T) U, g],
    the n^3 that the paper's tables charge.

    Parameters
    ----------
    ut (n, n), d (n,), g, b (n,), qs : covariance and component
    k (n,), w (n, n+1), weight (n+1,) : scratch
    """
    n = d.size
    if per_component_mwgs or not qs > 0.0:
        for j in range(n):
            t = b[j]
            column, along = ut[j, :j], b[:j]
            for i in range(j):
                t += column[i] * along[i]
            for i in range(j):
                w[i, j] = ut[j, i] - g[i] * t
            w[j, j] = 1.0 - g[j] * t
            for i in range(j + 1, n):
                w[i, j] = -(g[i] * t)
            w[j, n] = g[j]
            weight[j] = d[j]
        weight[n] = qs
        mwgs(w, weight, ut, d)
    else:
        s = bierman(ut, d, b, qs, k)
        for i in range(n):
            k[i] = g[i] - k[i] / s
        agee_turner(ut, d, k, s)


@compiled
def finite(d: Array, x: Array) -> bool:
    """Are all pivots ``d`` (n,) and all of the vector ``x`` (n,) numbers? One that is not makes all later ones so."""
    lost = 0
    for i in range(d.size):
        if not (d[i] < np.inf and abs(x[i]) < np.inf):
            lost += 1
    return lost == 0


@compiled
def variances(ut: Array, d: Array, out: Array) -> None:
    """Fill ``out`` (n,) with the diagonal of U D U^T."""
    for k in range(d.size):
        t = d[k]
        out[k] = t
        row = ut[k, :k]
        for i in range(k):
            out[i] += t * row[i] * row[i]


@compiled
def square(ut: Array, d: Array, out: Array) -> None:
    """Fill ``out`` (n, n) with U D U^T: one triangle, mirrored, so symmetric to the last bit."""
    n = d.size
    for k in range(n):
        column = ut[k, :k]
        for i in range(k):
            t = d[k] * column[i]
            row, rest = out[i, i:k], ut[k, i:k]
            for j in range(row.size):
                row[j] += t * rest[j]
            out[i, k] = t
        out[k, k] = d[k]
    for i in range(n):
        for j in range(i):
            out[i, j] = out[j, i]


@compiled
def project(g: Array, b: Array, a: Array, row: Array) -> None:
    """Overwrite ``a`` (n, n) with (I - g b^T) A; ``row`` (n,) is scratch."""
    n = g.size
    for j in range(n):
        row[j] = b[0] * a[0, j]
    for i in range(1, n):
        t, source = b[i], a[i]
        for j in range(n):
            row[j] += t * source[j]
    for i in range(n):
        t, target = g[i], a[i]
        for j in range(n):
            target[j] -= t * row[j]
