"""Answers to test against: batch least squares over the whole record, by other arithmetic than the estimator's.

Unknowns are theta = (x_0, whitened w_0, .., w_{N-1}); every epoch is a linear function of theta, and the data are rows
of a whitened least-squares problem. Solved by Householder QR in 80-bit floats (``batch``), or by the normal equations
in decimal arithmetic of 150 digits (``exact``), where condition numbers of 1e40 do not matter.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from decimal import Decimal, localcontext

import numpy as np

LONG = np.longdouble


@dataclass(frozen=True)
class Problem:
    """A record with everything per step and full covariances: phi (N, n, n), gamma, q (N, p, p), h, r (N, m, m), z."""

    phi: np.ndarray
    gamma: np.ndarray
    q: np.ndarray
    h: np.ndarray
    r: np.ndarray
    z: np.ndarray
    x0: np.ndarray | None
    p0: np.ndarray | None

    @property
    def model(self):
        from estimator import LinearModel

        return LinearModel(self.phi, self.gamma, _shortest(self.q), self.h, _shortest(self.r))

    @property
    def prior(self):
        return {"x0": self.x0, "p0": self.p0}

    def but(self, **changes):
        return replace(self, **changes)


def _shortest(a):
    """Variances where covariances are diagonal, unless their shape could be taken for one covariance."""
    steps, size, _ = a.shape
    if steps == size or not np.array_equal(a, a * np.eye(size)):
        return a
    return np.ascontiguousarray(np.einsum("jii->ji", a))


def problem(
    seed,
    n=4,
    p=2,
    m=2,
    steps=20,
    *,
    prior=True,
    missing=0.0,
    correlated=False,
    growth=1.0,
    r_range=(0.1, 1.0),
    quiet=0.0,
):
    """A random time-varying record, simulated from its own model; ``growth`` spreads modes from 1/growth to growth."""
    rng = np.random.default_rng(seed)
    modes = np.geomspace(1.0 / growth, growth, n) if growth != 1.0 else np.ones(n)
    basis = np.linalg.qr(rng.normal(size=(n, n)))[0]
    phi = basis @ np.diag(modes) @ basis.T + 0.3 / np.sqrt(n) * rng.normal(size=(steps, n, n)) * (growth == 1.0)
    if growth == 1.0:
        phi /= np.abs(np.linalg.eigvals(phi)).max(initial=1.0)
    gamma = rng.normal(size=(steps, n, p))
    gamma[rng.random(steps) < quiet / 2] = 0.0
    h = rng.normal(size=(steps, m, n))
    q = _noise(rng, steps, p, (0.1, 1.0), correlated)
    q *= np.where(rng.random((steps, p)) < quiet, 0.0, 1.0)[:, :, None]
    q *= (np.abs(np.einsum("jii->ji", q)) > 0)[:, None, :]
    r = _noise(rng, steps, m, r_range, correlated)
    x0, root = rng.normal(size=n), 0.3 * rng.normal(size=(n, n)) + np.diag(rng.uniform(0.5, 2.0, n))
    x = x0 + root @ rng.normal(size=n)
    z = np.empty((steps, m))
    for j in range(steps):
        x = phi[j] @ x + gamma[j] @ _draw(rng, q[j])
        z[j] = h[j] @ x + _draw(rng, r[j])
    z[rng.random((steps, m)) < missing] = np.nan
    z[rng.random(steps) < missing / 2] = np.nan
    return Problem(phi, gamma, q, h, r, z, x0 if prior else None, root @ root.T if prior else None)


def _noise(rng, steps, size, bounds, correlated):
    variance = np.exp(rng.uniform(np.log(bounds[0]), np.log(bounds[1]), (steps, size)))
    if not correlated:
        return variance[:, :, None] * np.eye(size)
    root = np.eye(size) + 0.5 * rng.normal(size=(steps, size, size))
    root *= np.sqrt(variance)[:, :, None]
    return root @ root.transpose(0, 2, 1)


def _draw(rng, covariance):
    values, vectors = np.linalg.eigh(covariance)
    return vectors @ (np.sqrt(np.maximum(values, 0.0)) * rng.normal(size=values.size))


def _cholesky(a):
    """Lower factor in the arithmetic of ``a``; a zero pivot gives a zero column."""
    a = a.copy()
    n = a.shape[0]
    for j in range(n):
        pivot = a[j, j] - a[j, :j] @ a[j, :j]
        if pivot <= 1e-14 * abs(a[j, j]):
            a[j:, j] = 0
            continue
        a[j, j] = np.sqrt(pivot)
        a[j + 1 :, j] = (a[j + 1 :, j] - a[j + 1 :, :j] @ a[j, :j]) / a[j, j]
    return np.tril(a)


def _lower_solve(c, b):
    x = b.copy()
    for i in range(c.shape[0]):
        x[i] = (x[i] - c[i, :i] @ x[:i]) / c[i, i]
    return x


def batch(problem):
    """Smoothed mean (N+1, n) and covariance (N+1, n, n) by QR in longdouble."""
    steps, n, p = problem.gamma.shape
    size = n + steps * p
    rows, right = [], []
    epoch = np.zeros((n, size), LONG)
    epoch[:, :n] = np.eye(n)
    epochs = [epoch]
    if problem.x0 is not None:
        c = _cholesky(problem.p0.astype(LONG))
        rows.append(_lower_solve(c, epoch))
        right.append(_lower_solve(c, problem.x0.astype(LONG)))
    for j in range(steps):
        epoch = problem.phi[j].astype(LONG) @ epoch
        at = slice(n + j * p, n + (j + 1) * p)
        epoch[:, at] += problem.gamma[j].astype(LONG) @ _cholesky(problem.q[j].astype(LONG))
        epochs.append(epoch)
        own = np.zeros((p, size), LONG)
        own[:, at] = np.eye(p)
        rows.append(own)
        right.append(np.zeros(p, LONG))
        there = ~np.isnan(problem.z[j])
        if there.any():
            c = _cholesky(problem.r[j][np.ix_(there, there)].astype(LONG))
            rows.append(_lower_solve(c, problem.h[j][there].astype(LONG) @ epoch))
            right.append(_lower_solve(c, problem.z[j][there].astype(LONG)))
    a, b = np.concatenate(rows), np.concatenate(right)
    order = np.argsort(-np.abs(a).max(axis=1), kind="stable")  # heavy rows first: Householder is then row-wise stable
    a, b = a[order], b[order]
    for k in range(size):
        v = a[k:, k].copy()
        v[0] += np.copysign(np.sqrt(v @ v), v[0])
        scale = 2 / (v @ v)
        a[k:, k:] -= np.outer(scale * v, v @ a[k:, k:])
        b[k:] -= scale * v * (v @ b[k:])
    upper = np.triu(a[:size])
    t = np.concatenate(epochs)
    y = _lower_solve(upper.T, np.ascontiguousarray(t.T))  # R^{-T} t^T
    mean = (y.T @ b[:size]).reshape(steps + 1, n)
    y = y.T.reshape(steps + 1, n, size)
    return mean.astype(float), (y @ y.transpose(0, 2, 1)).astype(float)


def exact(problem):
    """Smoothed mean and standard deviations (N+1, n) in decimal arithmetic; q and r diagonal, small problems only."""
    steps, n, p = problem.gamma.shape
    with localcontext() as context:
        context.prec = 150
        exactly = np.vectorize(Decimal, otypes=[object])
        used = [(j, c) for j in range(steps) for c in range(p) if problem.q[j, c, c] > 0]
        size = n + len(used)
        epoch = np.full((n, size), Decimal(0), object)
        epoch[:, :n] = exactly(np.eye(n))
        epochs, rows, right, weights = [epoch], [], [], []
        if problem.x0 is not None:
            c = np.diag(problem.p0)
            rows += list(epoch)
            right += list(exactly(problem.x0))
            weights += [1 / Decimal(v) for v in c]
        for j in range(steps):
            epoch = exactly(problem.phi[j]).dot(epoch)
            for c in range(p):
                if (j, c) in used:
                    at = n + used.index((j, c))
                    epoch[:, at] += exactly(problem.gamma[j][:, c])
                    own = np.full(size, Decimal(0), object)
                    own[at] = Decimal(1)
                    rows.append(own)
                    right.append(Decimal(0))
                    weights.append(1 / Decimal(problem.q[j, c, c]))
            epochs.append(epoch)
            for c in np.flatnonzero(~np.isnan(problem.z[j])):
                rows.append(exactly(problem.h[j][c]).dot(epoch))
                right.append(Decimal(problem.z[j, c]))
                weights.append(1 / Decimal(problem.r[j, c, c]))
        a, b, w = np.array(rows), np.array(right), np.array(weights)
        normal, y = (a * w[:, None]).T.dot(a), (a * w[:, None]).T.dot(b)
        t = np.concatenate(epochs)
        both = np.concatenate([normal, y[:, None], t.T], axis=1)
        for k in range(size):  # positive definite: no pivoting; rows below only, U and L^{-1} [y, t^T] remain
            for i in range(k + 1, size):
                if both[i, k] != 0:
                    both[i, k:] = both[i, k:] - (both[i, k] / both[k, k]) * both[k, k:]
        pivot = np.array([both[k, k] for k in range(size)])
        y, t = both[:, size], both[:, size + 1 :]
        mean = np.array([float(((t[:, c] * y) / pivot).sum()) for c in range(t.shape[1])])
        std = np.array([float(((t[:, c] * t[:, c]) / pivot).sum().sqrt()) for c in range(t.shape[1])])
    return mean.reshape(steps + 1, n), std.reshape(steps + 1, n)


def in_sigmas(mean, reference, std):
    """Largest error of the mean, in standard deviations."""
    return float(np.abs((mean - reference) / std).max())


def relative(std, reference):
    """Largest relative error of the standard deviations."""
    return float(np.abs(std / reference - 1.0).max())


def in_correlation(covariance, reference):
    """Largest error of a covariance, in units of its own standard deviations."""
    std = np.sqrt(np.einsum("jii->ji", reference))
    return float((np.abs(covariance - reference) / (std[:, :, None] * std[:, None, :])).max())
