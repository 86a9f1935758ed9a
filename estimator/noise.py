"""Noise made diagonal: correlated Q and R are factored once and absorbed into gamma, and into z and h.

With U unit upper triangular:

    Q = U_Q diag(q) U_Q^T :  gamma <- gamma U_Q             R = U_R diag(r) U_R^T :  z, h <- U_R^{-1} z, U_R^{-1} h
"""

from __future__ import annotations

import numpy as np

from estimator.ud import Array, compiled, exact


@exact
def factored(matrix: Array, tolerance: float, definite: bool, u: Array, d: Array) -> bool:
    """Factor ``matrix`` (k, k) = U diag(d) U^T; False when it is not symmetric, or not (semi)definite.

    A pivot within ``tolerance`` of zero, measured by its own diagonal entry, is zero; its column must then be zero too.
    """
    k = d.size
    slack = 1e-9 if matrix.itemsize == 8 else 1e-5
    for j in range(k):
        for i in range(j):
            if not abs(matrix[i, j] - matrix[j, i]) <= slack * np.sqrt(abs(matrix[i, i] * matrix[j, j])):
                return False
    u[:, :] = matrix
    for j in range(k - 1, -1, -1):
        own = tolerance * abs(matrix[j, j])
        d[j] = u[j, j]
        if d[j] <= own:
            if definite or d[j] < -own:
                return False
            d[j] = 0.0
            for i in range(j):
                if abs(u[i, j]) > np.sqrt(tolerance * abs(matrix[i, i] * matrix[j, j])):
                    return False
                u[i, j] = 0.0
        else:
            for i in range(j):
                t = u[i, j] / d[j]
                for c in range(i + 1):
                    u[c, i] -= t * u[c, j]
            for i in range(j):
                u[i, j] /= d[j]
        u[j, j] = 1.0
        u[j, :j] = 0.0
    return True


@compiled
def absorb(q: Array, gamma: Array, tolerance: float, out_gamma: Array, out_q: Array) -> int:
    """Make Q diagonal: ``q`` (1|N, p, p), ``gamma`` (1|N, n, p) -> (K, n, p), (K, p). Returns a wrong step or -1."""
    p = q.shape[1]
    u = np.empty((p, p), q.dtype)
    for i in range(out_q.shape[0]):
        if not factored(q[min(i, q.shape[0] - 1)], tolerance, False, u, out_q[i]):
            return i
        now = gamma[min(i, gamma.shape[0] - 1)]
        for row in range(now.shape[0]):
            for c in range(p):
                total = now[row, c]
                for j in range(c):
                    total += now[row, j] * u[j, c]
                out_gamma[i, row, c] = total
    return -1


@compiled
def definite(r: Array, tolerance: float) -> int:
    """First step at which ``r`` (K, m, m) is not symmetric and positive definite, or -1."""
    m = r.shape[1]
    u, d = np.empty((m, m), r.dtype), np.empty(m, r.dtype)
    for i in range(r.shape[0]):
        if not factored(r[i], tolerance, True, u, d):
            return i
    return -1


@compiled
def whiten(r: Array, h: Array, z: Array, out_h: Array, out_r: Array, out_z: Array) -> None:
    """Make R diagonal: ``r`` (1|N, m, m), ``h`` (1|N, m, n) -> (N, m, n), (N, m); ``out_z`` (K, N, m) is overwritten.

    Only the block of R that belongs to the present scalars, those of ``z`` (N, m), is factored: a masked scalar is a
    removed one. With a single row in ``out_h`` nothing varies and nothing is missing.
    """
    m, n = h.shape[1], h.shape[2]
    block, u, d = np.empty((m, m), r.dtype), np.empty((m, m), r.dtype), np.empty(m, r.dtype)
    kept = np.empty(m, np.int64)
    count = 0
    for i in range(z.shape[0]):
        if i < out_h.shape[0]:
            now, rows = r[min(i, r.shape[0] - 1)], h[min(i, h.shape[0] - 1)]
            count = 0
            for c in range(m):
                out_r[i, c] = 1.0
                if not np.isnan(z[i, c]):
                    kept[count] = c
                    count += 1
            for c in range(count):
                for j in range(count):
                    block[c, j] = now[kept[c], kept[j]]
            factored(block[:count, :count], 0.0, True, u[:count, :count], d[:count])
            out_h[i] = rows
            for c in range(count - 1, -1, -1):
                own = kept[c]
                out_r[i, own] = d[c]
                for j in range(c + 1, count):
                    for column in range(n):
                        out_h[i, own, column] -= u[c, j] * out_h[i, kept[j], column]
        for t in range(out_z.shape[0]):
            for c in range(count - 1, -1, -1):
                for j in range(c + 1, count):
                    out_z[t, i, kept[c]] -= u[c, j] * out_z[t, i, kept[j]]
