"""The square-root cubature filter and smoother of a linear model, where the cubature sums have a closed form.

The images of the points of N(m, S S^T) under x -> phi x deviate by phi S from their mean, and those under x -> h x by
h S: no point has to be drawn to say what the filter and smoother of `estimator.cubature` say, to rounding. With
S_Q = gamma diag(sqrt q) and Tria as in `reflections`::

    predict    m^- = phi m           S^- = Tria([phi S, S_Q])
    update     Tria([[S_R, h S^-], [0, S^-]]) = [[S_zz, 0], [Y, S]]        m = m^- + Y S_zz^{-1} (z - h m^-)
    back       Tria([[phi S, S_Q], [S, 0]]) = [[L11, 0], [L21, L22]]       W = L21 L11^{-1}
               m_s = m + W (m_s' - m^-)                                    S_s = Tria([L22, L21 - W L11, W S_s'])

Where a pivot of L11 is rounding its column of W is zero, and what it leaves is in L21 - W L11 (zero otherwise): S_s is
right whatever W is, and no covariance is ever subtracted. Every function is one of a carry, as in
`estimator.information`: the same steps in any chunks give the same bits.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimator import ud
from estimator.cubature import reflections
from estimator.cubature.reflections import NULL, reflect
from estimator.information import Filtered
from estimator.model import LinearModel
from estimator.ud import exact

ud.follow(__file__, reflections.__file__)

Floats = NDArray[np.float64]


class Carry(NamedTuple):
    """All that is known so far: a mean (n,) and a lower triangular factor (n, n) of the covariance; both read-only."""

    mean: Floats
    root: Floats


class Steps(NamedTuple):
    """What smoothing needs of k steps.

    Attributes
    ----------
    mean, root : (k, n) and (k, n, n) arrays
        The state before each step, given the measurements up to there.
    phi, noise : (1|k, n, n) and (1|k, n, p) arrays
        Transition, and S_Q.
    """

    mean: Floats
    root: Floats
    phi: Floats
    noise: Floats

    def part(self, first: int) -> Steps:
        """The steps from ``first`` on."""
        return Steps(*(column if len(column) == 1 < len(self.mean) else column[first:] for column in self))


class Store:
    """The steps of a filter, kept for its smoother: 2 n^2 + n p + n numbers each. ``len(store)`` tells how many."""

    def __init__(self) -> None:
        self._parts: list[Steps] = []
        self._end: Carry | None = None

    def __len__(self) -> int:
        return sum(len(part.mean) for part in self._parts)

    @property
    def anchors(self) -> list[int]:
        """First steps of the windows held: none, a square root in plain coordinates needs no anchor."""
        return []

    def check(self, carry: Carry) -> None:
        """Raise ValueError when the newest step did not end with this carry."""
        if self._parts and self._end is not carry:
            raise ValueError("carry is not the one that the newest step of this store ended with")

    def keep(self, steps: Steps, carry: Carry) -> None:
        """Keep steps, which end with ``carry``."""
        self._parts.append(steps)
        self._end = carry

    def backwards(self) -> list[Steps]:
        """The steps in parts, the newest one first."""
        return self._parts[::-1]

    def drop(self, before: int) -> None:
        """Forget the steps before index ``before``; what was step ``before`` is step 0 afterwards.

        Raises
        ------
        IndexError
            ``before`` is negative or beyond ``len(store)``.
        """
        if not 0 <= before <= len(self):
            raise IndexError(f"drop({before}): the store holds {len(self)} steps")
        while before and before >= len(self._parts[0].mean):
            before -= len(self._parts.pop(0).mean)
        if before:
            self._parts[0] = self._parts[0].part(before)


def start(n: int, x0: ArrayLike, p0: ArrayLike) -> Carry:
    """Begin at epoch 0 from a prior.

    Parameters
    ----------
    n : int
        Number of states.
    x0 : (n,) array
        Prior mean.
    p0 : (n, n) covariance or (n,) variances

    Raises
    ------
    ValueError
        A shape does not fit, something is not finite, or p0 is not symmetric and positive definite (variances alone may
        be zero).
    """
    mean, covariance = np.array(x0, np.float64), np.array(p0, np.float64)
    if mean.shape != (n,):
        raise ValueError(f"x0 has shape {mean.shape}, ({n},) is needed")
    if covariance.shape == (n,):
        covariance = np.diag(covariance)
    if covariance.shape != (n, n):
        raise ValueError(f"p0 has shape {covariance.shape}, ({n}, {n}) or ({n},) is needed")
    if not (np.isfinite(mean).all() and np.isfinite(covariance).all()):
        raise ValueError("x0 or p0 is not finite: this filter begins from a prior of every state")
    diagonal = np.diag(covariance)
    if np.count_nonzero(covariance) == np.count_nonzero(diagonal) and (diagonal >= 0.0).all():
        return _carry(mean, np.diag(np.sqrt(diagonal)))
    if not np.allclose(covariance, covariance.T, rtol=1e-9, atol=0.0):
        raise ValueError("p0 is not symmetric")
    try:
        return _carry(mean, np.asarray(np.linalg.cholesky(covariance), np.float64))
    except np.linalg.LinAlgError:
        raise ValueError("p0 is singular or indefinite") from None


def _carry(mean: Floats, root: Floats) -> Carry:
    mean.flags.writeable = root.flags.writeable = False
    return Carry(mean, root)


def filter(
    model: LinearModel, carry: Carry, z: ArrayLike, *, rule: object = None, store: Store | None = None
) -> tuple[Carry, Filtered]:
    """Filter N >= 0 steps; the same steps in any chunks give the same bits.

    Parameters
    ----------
    model : LinearModel
        Constant, or with exactly N steps; float64.
    carry : Carry
        From ``start``, or from the steps before. It is not changed.
    z : (N, m) array
        Measurements, NaN = missing.
    rule
        Of no use here: nothing is ever anchored. It is there for likeness with ``information.filter``.
    store : Store, optional
        Receives what smoothing needs.

    Returns
    -------
    The new carry and the filter's estimates.

    Raises
    ------
    ValueError
        A measurement is infinite or an estimate overflows, named with the step; something does not fit. The store then
        holds the steps it held.
    """
    n = model.n
    data = model.measurements(z)
    if data.ndim != 2 or model.dtype != np.float64:
        raise ValueError("one record in float64 is needed")
    if carry.mean.size != n:
        raise ValueError(f"carry has {carry.mean.size} states, the model has {n}")
    if store is not None:
        store.check(carry)
    count = len(data)
    h, r, white = model.whitened(data)
    noise = np.ascontiguousarray(model.gamma * np.sqrt(model.q)[:, None, :])
    kept = Steps(np.empty((count, n)), np.empty((count, n, n)), model.phi, noise)
    live = Filtered(np.empty((count, n)), np.empty((count, n)), np.empty(count), np.empty(count, np.int64))
    if not count:
        return carry, live
    shown, std, nis, dof = live
    mean, root = carry.mean.copy(), carry.root.copy()
    wrong = _forward(*kept[2:], h, np.sqrt(r), white, mean, root, *kept[:2], shown, std, nis, dof)
    if wrong >= 0:
        raise ValueError(f"the estimate is no longer finite at step {wrong}: check the units of phi, q and r there")
    carry = _carry(mean, root)
    if store is not None:
        store.keep(kept, carry)
    return carry, live


def anchor(carry: Carry) -> Carry:
    """The same knowledge: a window may end at any step."""
    return carry


def smooth(store: Store, carry: Carry) -> tuple[Floats, Floats]:
    """Smooth all k steps of a store, given everything up to ``carry``.

    Returns
    -------
    mean, std : (k+1, n) arrays
        Row 0 is where the first step begins.

    Raises
    ------
    ValueError
        ``carry`` does not stand at the end of the store.
    """
    store.check(carry)
    count, n = len(store), carry.mean.size
    mean, std = np.empty((count + 1, n)), np.empty((count + 1, n))
    mean[count] = carry.mean
    std[count] = np.sqrt(np.square(carry.root).sum(axis=1))
    root, stop = carry.root.copy(), count
    for steps in store.backwards():
        first = stop - len(steps.mean)
        _backward(*steps, root, mean[first : stop + 1], std[first : stop + 1])
        stop = first
    return mean, std


@exact
def _triangle(a: Floats, rows: int, count: int, first: int, width: int) -> None:
    """Make ``count`` columns of ``a[:rows]`` from ``first`` on upper triangular; what is right of them goes with it."""
    for c in range(count):
        reflect(a, c, a, c + 1, rows, first + c, width)


@exact
def _lower(upper: Floats, column: int, root: Floats) -> None:
    """``root`` is the transpose of the triangle that begins at ``upper[0, column]``."""
    n = root.shape[0]
    for i in range(n):
        for k in range(n):
            root[k, i] = upper[i, column + k] if k >= i else 0.0


@exact
def _spread(root: Floats, std: Floats) -> bool:
    """Standard deviations of a factor; whether all are finite."""
    fine = True
    for k in range(root.shape[0]):
        total = 0.0
        for i in range(k + 1):
            total += root[k, i] * root[k, i]
        std[k] = np.sqrt(total)
        fine = fine and std[k] < np.inf
    return fine


@exact
def _carried(phi: Floats, noise: Floats, root: Floats, rows: Floats) -> None:
    """Rows 0..n + p of ``rows`` begin with the columns of phi S and of S_Q."""
    n, p = noise.shape
    for i in range(n):
        for c in range(n):
            total = 0.0
            for k in range(i, n):
                total += phi[c, k] * root[k, i]
            rows[i, c] = total
    for j in range(p):
        for c in range(n):
            rows[n + j, c] = noise[c, j]


@exact
def _forward(
    phi: Floats, noise: Floats, h: Floats, deviation: Floats, z: Floats, mean: Floats, root: Floats, means: Floats,
    roots: Floats, shown: Floats, std: Floats, nis: Floats, dof: NDArray[np.int64],
) -> int:  # fmt: skip
    """Filter; ``mean`` and ``root`` go from before the first step to after the last. The step that failed, or -1."""
    n, p, m = phi.shape[1], noise.shape[2], z.shape[1]
    rows, ahead = np.empty((n + p, n)), np.empty(n)
    joint, top, white, present = np.empty((n, m + n)), np.empty((m, m + n)), np.empty(m), np.empty(m, np.int64)
    for j in range(z.shape[0]):
        means[j], roots[j] = mean, root
        f, seen = phi[min(j, phi.shape[0] - 1)], h[min(j, h.shape[0] - 1)]
        scale = deviation[min(j, deviation.shape[0] - 1)]
        _carried(f, noise[min(j, noise.shape[0] - 1)], root, rows)
        _triangle(rows, n + p, n, 0, n)
        for i in range(n):
            total = 0.0
            for k in range(n):
                total += f[i, k] * mean[k]
            ahead[i] = total
        count = 0
        for c in range(m):
            if z[j, c] == z[j, c]:
                present[count] = c
                count += 1
        width = count + n
        for i in range(n):
            for c in range(count):
                total = 0.0
                for k in range(i, n):
                    total += seen[present[c], k] * rows[i, k]
                joint[i, c] = total
            for k in range(n):
                joint[i, count + k] = rows[i, k] if k >= i else 0.0
        for c in range(count):
            for k in range(width):
                top[c, k] = 0.0
            top[c, c] = scale[present[c]]
        for c in range(count):
            reflect(top, c, joint, 0, n, c, width)
        for i in range(n):
            mean[i] = ahead[i]
        square = 0.0
        for c in range(count):
            value = z[j, present[c]]
            for k in range(n):
                value -= seen[present[c], k] * ahead[k]
            for i in range(c):
                value -= top[i, c] * white[i]
            white[c] = value / top[c, c]
            square += white[c] * white[c]
            for k in range(n):
                mean[k] += top[c, count + k] * white[c]
        if count:
            _triangle(joint, n, n, count, width)
        _lower(joint, count, root)
        fine = _spread(root, std[j])
        for k in range(n):
            shown[j, k] = mean[k]
            fine = fine and abs(mean[k]) < np.inf
        if not fine:
            return j
        nis[j], dof[j] = square, count
    return -1


@exact
def _backward(
    means: Floats, roots: Floats, phi: Floats, noise: Floats, root: Floats, smoothed: Floats, std: Floats
) -> None:
    """Smooth; ``root`` goes from after the last step to before the first one."""
    n, p = phi.shape[1], noise.shape[2]
    few = NULL * n * np.finfo(np.float64).eps
    rows, gain, stack, told = np.empty((n + p, 2 * n)), np.empty((n, n)), np.empty((2 * n + p, n)), np.empty(n)
    for j in range(means.shape[0] - 1, -1, -1):
        f, own, before = phi[min(j, phi.shape[0] - 1)], roots[j], means[j]
        _carried(f, noise[min(j, noise.shape[0] - 1)], own, rows)
        for i in range(n + p):
            for k in range(n):
                rows[i, n + k] = own[k, i] if i <= k else 0.0
        _triangle(rows, n + p, n, 0, 2 * n)
        for i in range(p):
            for k in range(n):
                stack[i, k] = rows[n + i, n + k]
        used = p
        for c in range(n - 1, -1, -1):
            norm = 0.0
            for i in range(c + 1):
                norm += rows[i, c] * rows[i, c]
            null = rows[c, c] <= few * np.sqrt(norm)
            for i in range(n):
                value = rows[c, n + i]
                for k in range(c + 1, n):
                    value -= gain[i, k] * rows[c, k]
                if null:
                    stack[used, i] = value
                gain[i, c] = 0.0 if null else value / rows[c, c]
            if null:
                used += 1
        for c in range(n):
            for i in range(n):
                total = 0.0
                for k in range(c, n):
                    total += gain[i, k] * root[k, c]
                stack[used + c, i] = total
        used += n
        for k in range(n):
            total = smoothed[j + 1, k]
            for c in range(n):
                total -= f[k, c] * before[c]
            told[k] = total
        for i in range(n):
            total = before[i]
            for k in range(n):
                total += gain[i, k] * told[k]
            smoothed[j, i] = total
        _triangle(stack, used, n, 0, n)
        _lower(stack, 0, root)
        _spread(root, std[j])
