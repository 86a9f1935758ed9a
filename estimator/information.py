"""The streaming information filter: square-root, augmented, sequential, in moving coordinates (MS-A).

The filter is one function of a carry. Any number of steps at once, one or a million, gives the same carry, estimates
and snapshots to the last bit, so that a live filter and a replay are the same computation.

A streaming stage::

    carry, store, rule = start(n, x0, p0), Store(), Rule(scale=sigmas)
    for chunk, z in batches:                                 # a LinearModel and (N, m) measurements, NaN = missing
        carry, live = filter(chunk, carry, z, rule=rule, store=store)
    mean, std = backward(store, carry, covariance=False)     # smoother.backward: the window just flown
    carry = anchor(carry)                                    # a mark: the next window begins here
    store.drop(len(store))
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimator import sweeps
from estimator.model import LinearModel
from estimator.snapshots import Store, rows
from estimator.ud import Array
from estimator.window import Rule

RULE = Rule()


class Carry(NamedTuple):
    """All that is known so far. Arrays are read-only; no function changes a carry.

    Attributes
    ----------
    u, d : (n+1, n+1) unit upper triangular and (n+1,) arrays
        U diag(d) U^T = [[rho, (L x*)^T], [L x*, L]], the information L about the state at the anchor; row 0 of U is
        [1, eta^T] with U^T x* = eta, and d[0] is the sum of nu^T S^{-1} nu over all innovations so far.
    phi : (n, n) array
        phi_{j,0}, from the anchor to the present epoch.
    steps : int
        Steps since the anchor.
    regular : bool
        Whether there is information about every direction; until then there is no filter estimate.
    """

    u: Array
    d: Array
    phi: Array
    steps: int
    regular: bool


class Filtered(NamedTuple):
    """Estimates after each of N steps, given the measurements up to it.

    Attributes
    ----------
    mean, std : (N, n) arrays
        NaN and infinity until every direction is known.
    nis : (N,) array
        Normalised innovation squared nu^T S^{-1} nu of the present scalars; chi-square with ``dof`` degrees of freedom.
    dof : (N,) int array
        Scalars that entered ``nis``: present, and about directions of which something was known.
    """

    mean: Array
    std: Array
    nis: Array
    dof: NDArray[np.int64]


def _carry(ut: Array, d: Array, phi: Array, steps: int, regular: bool) -> Carry:
    for array in (ut, d, phi):
        array.flags.writeable = False
    return Carry(ut.T, d, phi, int(steps), bool(regular))


def _copies(carry: Carry) -> tuple[Array, Array, Array]:
    """U^T, d and phi, C-contiguous and free to be overwritten."""
    return np.array(carry.u.T, order="C"), np.array(carry.d), np.array(carry.phi, order="C")


def start(n: int, x0: ArrayLike | None = None, p0: ArrayLike | None = None) -> Carry:
    """Begin at epoch 0 from a prior, or from nothing.

    Parameters
    ----------
    n : int
        Number of states.
    x0 : (n,) array, optional
        Prior mean.
    p0 : (n, n) covariance or (n,) variances, optional
        Prior covariance. An infinite variance is no information about that state. None, with x0 None: no prior at all.

    Raises
    ------
    ValueError
        Only one of x0 and p0 is given, a shape does not fit, or p0 is not symmetric and positive definite.
    """
    ut, d = np.eye(n + 1), np.zeros(n + 1)
    regular = False
    if (x0 is None) != (p0 is None):
        raise ValueError("x0 and p0 come together: give both, or neither for no prior information")
    if x0 is not None and p0 is not None:
        mean, covariance = np.asarray(x0, np.float64), np.asarray(p0, np.float64)
        if mean.shape != (n,):
            raise ValueError(f"x0 has shape {mean.shape}, ({n},) is needed")
        if covariance.shape == (n,):
            covariance = np.diag(covariance)
        if covariance.shape != (n, n):
            raise ValueError(f"p0 has shape {covariance.shape}, ({n}, {n}) or ({n},) is needed")
        known = np.diag(covariance) != np.inf
        block = covariance[np.ix_(known, known)]
        if not np.isfinite(mean[known]).all():
            raise ValueError("x0 is not finite")
        coupled = np.count_nonzero(covariance[~known]) + np.count_nonzero(covariance[:, ~known]) - 2 * (~known).sum()
        if coupled or not np.isfinite(block).all():
            raise ValueError("p0 is not finite (only a variance that is correlated with nothing may be infinite)")
        regular = bool(known.all())
        if known.any():
            factor, weight = _information(block)
            index = 1 + np.flatnonzero(known)
            ut[np.ix_(index, index)] = factor.T
            ut[index, 0] = factor.T @ mean[known]
            d[index] = weight
    return _carry(ut, d, np.eye(n), 0, regular)


def _information(p0: Array) -> tuple[Array, Array]:
    """U and D of P_0^{-1}: P_0 = C C^T, and C^{-T} is already upper triangular."""
    if not np.allclose(p0, p0.T, rtol=1e-9, atol=0.0):
        raise ValueError("p0 is not symmetric")
    diagonal = np.diag(p0)
    advice = (
        "p0 is singular or indefinite; every state needs a variance above zero (what is known exactly is given a very "
        "small one, what is not known at all an infinite one)"
    )
    if np.count_nonzero(p0) == np.count_nonzero(diagonal):
        if not (diagonal > 0.0).all():
            raise ValueError(advice)
        return np.eye(diagonal.size), 1.0 / diagonal
    try:
        root = np.linalg.cholesky(p0)
    except np.linalg.LinAlgError:
        raise ValueError(advice) from None
    if (np.diag(root) ** 2 <= 4.0 * diagonal.size * np.finfo(float).eps * diagonal).any():
        raise ValueError(advice)
    upper = np.linalg.solve(root, np.eye(diagonal.size)).T
    pivot = np.diag(upper)
    return np.triu(upper / pivot, 1) + np.eye(diagonal.size), pivot**2


def filter(
    model: LinearModel,
    carry: Carry,
    z: ArrayLike,
    *,
    rule: Rule = RULE,
    store: Store | None = None,
    estimates: bool = True,
) -> tuple[Carry, Filtered]:
    """Filter N >= 0 steps; the same steps in any chunks give the same bits.

    Parameters
    ----------
    model : LinearModel
        Constant, or with exactly N steps.
    carry : Carry
        From ``start``, or from the steps before. It is not changed.
    z : (N, m) array
        Measurements, NaN = missing.
    rule : Rule
        When a window closes.
    store : Store, optional
        Receives the snapshots that smoothing needs.
    estimates : bool
        False leaves ``mean`` and ``std`` empty (shape (0, n)) and saves their time.

    Returns
    -------
    The new carry and the filter's estimates.

    Raises
    ------
    ValueError
        phi singular, a measurement infinite, or an estimate overflowing: named with the step; shapes that do not fit.
        The carry and the store are then as they were.
    """
    n, p = model.n, model.p
    z = model.measurements(z)
    if carry.d.size != n + 1:
        raise ValueError(f"carry has {carry.d.size - 1} states, the model has {n}")
    count = z.shape[0]
    shown = count if estimates else 0
    mean, std = np.empty((shown, n)), np.empty((shown, n))
    nis, dof = np.empty(count), np.empty(count, np.int64)
    filtered = Filtered(mean, std, nis, dof)
    if count == 0:
        return carry, filtered
    closed = np.empty(count, np.uint8)
    ut, d, phi = _copies(carry)
    kept = rows(0, n, p) if store is None else store.reserve(n, p, count, phi, carry.steps)
    h, r, whitened = model.whitened(z)
    steps, regular, end, step = sweeps.forward(
        model.phi, model.gamma, model.q, h, r, whitened, ut, d, phi, carry.steps, carry.regular,
        rule.steps, rule.kappa, rule.scales(n), store is not None, *kept, estimates, mean, std, nis, dof, closed,
    )  # fmt: skip
    if end == sweeps.SINGULAR:
        raise ValueError(f"phi is singular at step {step}: the information filter inverts it; method 'rts' does not")
    if end == sweeps.INFINITE:
        raise ValueError(f"z is infinite at step {step}; a missing measurement is NaN")
    if end == sweeps.OVERFLOW:
        raise ValueError(f"the information is no longer finite at step {step}: check the units of phi, q and r there")
    if store is not None:
        store.commit(closed, carry.steps)
    return _carry(ut, d, phi, steps, regular), filtered


def anchor(carry: Carry) -> Carry:
    """Close the current window: the same knowledge about the present epoch, anchored at it. Exact, idempotent."""
    if carry.steps == 0:
        return carry
    ut, d, phi = _copies(carry)
    n = d.size - 1
    sweeps.anchor(ut, d, phi, np.empty((n + 1, 2 * n + 2)))
    return _carry(ut, d, phi, 0, carry.regular)


class InformationFilter:
    """The filter as an object, for one live step at a time. ``carry`` is its whole state; ``store`` may be None.

    Parameters
    ----------
    model : LinearModel
        Constant, or one per step: step i then uses its row i.
    x0, p0
        As in ``start``.
    rule, store
        As in ``filter``.
    """

    def __init__(
        self,
        model: LinearModel,
        x0: ArrayLike | None = None,
        p0: ArrayLike | None = None,
        *,
        rule: Rule = RULE,
        store: Store | None = None,
    ) -> None:
        self.model, self.rule, self.store = model, rule, store
        self.carry = start(model.n, x0, p0)
        self.steps = 0

    def step(self, z: ArrayLike, model: LinearModel | None = None) -> Filtered:
        """One step: mean (n,), std (n,), nis and dof after measurement ``z`` (m,); ``model`` replaces the one given."""
        now = self.model.cut(self.steps, self.steps + 1) if model is None else model
        self.carry, after = filter(now, self.carry, np.asarray(z, float)[None], rule=self.rule, store=self.store)
        self.steps += 1
        return Filtered(after.mean[0], after.std[0], after.nis[0], after.dof[0])
