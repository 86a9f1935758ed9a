"""The streaming information filter: square-root, augmented, sequential, in moving coordinates (MS-A).

The filter is one function of a carry. Any number of steps at once, one or a million, gives the same carry, estimates
and snapshots to the last bit, so that a live filter and a replay are the same computation.

A streaming stage::

    carry, store, rule = start(n, x0, p0), Store(), Rule(scale=sigmas)
    for chunk, z in batches:                                 # a LinearModel and (N, m) measurements, NaN = missing
        carry, live = filter(chunk, carry, z, rule=rule, store=store)
    flown = backward(store, carry, std=True, covariance=False)    # smoother.backward: the window just flown
    carry = anchor(carry)                                    # a mark: the next window begins here
    store.drop(len(store))
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from estimator import coordinates, sweeps
from estimator.model import LinearModel
from estimator.snapshots import Shape, Store
from estimator.ud import Array, Order
from estimator.window import Rule


class Carry(NamedTuple):
    """All that is known so far. Arrays are read-only; no function changes a carry.

    Attributes
    ----------
    u, d : (n+1, n+1) unit upper triangular and (n+1,) arrays
        U diag(d) U^T = [[rho, (L x*)^T], [L x*, L]], the information L about the state at the anchor; row 0 of U is
        [1, eta^T] with U^T x* = eta, and d[0] is the sum of nu^T S^{-1} nu over all innovations so far. Records that
        share model, noise and missing samples share U and d; each has a row [.. 1 .., eta^T] and a sum of its own.
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
        NaN and infinity until every direction is known. Of several records, mean is (records, N, n).
    nis : (N,) array, or (records, N)
        Normalised innovation squared nu^T S^{-1} nu of the present scalars; chi-square with ``dof`` degrees of freedom.
    dof : (N,) int array
        Scalars that entered ``nis``: present, and about directions of which something was known.
    """

    mean: Array
    std: Array
    nis: Array
    dof: NDArray[np.int64]


def _carry(ut: Array, d: Array, rho: Array, phi: Array, steps: int, regular: bool) -> Carry:
    records, n = rho.size, d.size
    u = np.zeros((records + n, records + n), ut.dtype)
    u[:records, :records] = np.eye(records)
    u[:, records:] = ut.T
    whole = np.concatenate([rho, d])
    for array in (u, whole, phi):
        array.flags.writeable = False
    return Carry(u, whole, phi, int(steps), bool(regular))


def factors(carry: Carry) -> tuple[Array, Array, Array]:
    """U^T with the data in front (n, records + n), D (n,) and phi, C-contiguous and free to be overwritten."""
    n = carry.phi.shape[0]
    records = carry.d.size - n
    return np.array(carry.u.T[records:], order="C"), np.array(carry.d[records:]), np.array(carry.phi, order="C")


def start(
    n: int, x0: ArrayLike | None = None, p0: ArrayLike | None = None, *, records: int = 1, dtype: DTypeLike = np.float64
) -> Carry:
    """Begin at epoch 0 from a prior, or from nothing.

    Parameters
    ----------
    n : int
        Number of states.
    x0 : (n,) array, or (records, n), optional
        Prior mean.
    p0 : (n, n) covariance or (n,) variances, optional
        Prior covariance. An infinite variance is no information about that state. None, with x0 None: no prior at all.
    records : int
        Records that share model, noise and missing samples.
    dtype : float64 or float32
        That of the model.

    Raises
    ------
    ValueError
        Only one of x0 and p0 is given, a shape does not fit, or p0 is not symmetric and positive definite.
    """
    ut, d = np.concatenate([np.zeros((n, records)), np.eye(n)], axis=1), np.zeros(n)
    regular = False
    if (x0 is None) != (p0 is None):
        raise ValueError("x0 and p0 come together: give both, or neither for no prior information")
    if x0 is not None and p0 is not None:
        mean, covariance = np.asarray(x0, np.float64), np.asarray(p0, np.float64)
        if mean.shape not in ((n,), (records, n)):
            raise ValueError(f"x0 has shape {mean.shape}, ({n},) is needed")
        mean = np.broadcast_to(mean, (records, n))
        if covariance.shape == (n,):
            covariance = np.diag(covariance)
        if covariance.shape != (n, n):
            raise ValueError(f"p0 has shape {covariance.shape}, ({n}, {n}) or ({n},) is needed")
        known = np.diag(covariance) != np.inf
        block = covariance[np.ix_(known, known)]
        if not np.isfinite(mean[:, known]).all():
            raise ValueError("x0 is not finite")
        coupled = np.count_nonzero(covariance[~known]) + np.count_nonzero(covariance[:, ~known]) - 2 * (~known).sum()
        if coupled or not np.isfinite(block).all():
            raise ValueError("p0 is not finite (only a variance that is correlated with nothing may be infinite)")
        regular = bool(known.all())
        if known.any():
            factor, weight = factored(block)
            index = np.flatnonzero(known)
            ut[np.ix_(index, records + index)] = factor.T
            ut[index, :records] = factor.T @ mean[:, known].T
            d[index] = weight
    with np.errstate(over="ignore"):
        ut, d = ut.astype(dtype), d.astype(dtype)
    if not (np.isfinite(ut).all() and np.isfinite(d).all()):
        raise ValueError(f"x0 or 1 / p0 is beyond {np.dtype(dtype)}")
    return _carry(ut, d, np.zeros(records, dtype), np.eye(n, dtype=dtype), 0, regular)


def factored(p0: Array) -> tuple[Array, Array]:
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
    rule: Rule | None = None,
    store: Store | None = None,
    estimates: bool = True,
    first: int = 0,
) -> tuple[Carry, Filtered]:
    """Filter N >= 0 steps; the same steps in any chunks give the same bits.

    Parameters
    ----------
    model : LinearModel
        Constant, or with exactly N steps.
    carry : Carry
        From ``start``, or from the steps before. It is not changed.
    z : (N, m) array, or (records, N, m)
        Measurements, NaN = missing; records miss the same ones.
    rule : Rule, optional
        When a window closes; None: as ``Rule.of`` says for the model.
    store : Store, optional
        Receives the snapshots that smoothing needs.
    estimates : bool
        False leaves ``mean`` and ``std`` empty (shape (0, n)) and saves their time.
    first : int
        Number of the first step, for messages.

    Returns
    -------
    The new carry and the filter's estimates.

    Raises
    ------
    ValueError
        phi singular, a measurement infinite, or an estimate overflowing: named with the step; shapes that do not fit.
        The carry is then as it was, and the store holds the steps it held.
    """
    n = model.n
    rule = Rule.of(model) if rule is None else rule
    data = model.measurements(z)
    records = data.shape[0] if data.ndim == 3 else 1
    if carry.phi.shape[0] != n:
        raise ValueError(f"carry has {carry.phi.shape[0]} states, the model has {n}")
    if carry.d.size != n + records:
        raise ValueError(f"carry is of {carry.d.size - n} records, z of {records}")
    if carry.d.dtype != model.dtype:
        raise ValueError(f"carry is {carry.d.dtype}, the model {model.dtype}: start(..., dtype={model.dtype}) fits it")
    count = data.shape[-2]
    shown = count if estimates else 0
    mean, std = np.empty((shown, n, records), model.dtype), np.empty((shown, n), model.dtype)
    nis, dof = np.empty((count, records), model.dtype), np.empty(count, np.int64)
    if count:
        carry = _sweep(model, carry, data, rule, store, estimates, first, mean, std, nis, dof)
    if data.ndim == 3:
        return carry, Filtered(mean.transpose(2, 0, 1), std, nis.T, dof)
    return carry, Filtered(mean[:, :, 0], std, nis[:, 0], dof)


def _sweep(
    model: LinearModel, carry: Carry, data: Array, rule: Rule, store: Store | None, estimates: bool,
    first: int, mean: Array, std: Array, nis: Array, dof: Order,
) -> Carry:  # fmt: skip
    """The new carry after all steps of ``data`` (N, m) or (records, N, m); fills the results."""
    count, dtype = data.shape[-2], model.dtype
    ut, d, since = factors(carry)
    rho = np.array(carry.d[: carry.d.size - model.n])
    h, r, white = model.whitened(data)
    z = np.ascontiguousarray(white.transpose(1, 2, 0)) if white.ndim == 3 else white[:, :, None]
    table = coordinates.table(model, rule, count)
    if table is not None and not (carry.steps < len(table.phi) and np.array_equal(table.phi[carry.steps], carry.phi)):
        table = None  # the window began with another model
    shape = Shape(model.n, model.p, rho.size, dtype)
    kept = shape.rows(0) if store is None else store.reserve(shape, count, since, carry.steps, table)
    closed, at = np.empty(count, np.uint8), np.empty(count, np.int64)
    regular, own = carry.regular, None if store is None or table is not None else (kept.phi, kept.e)
    for block in coordinates.prepare(model, h, rule, table, carry.phi, carry.steps, count, own, first):
        part, steps = block.part, block.steps
        closed[part], at[part] = block.closed, block.at
        regular, wrong = sweeps.forward(
            block.ends, block.es, block.at, block.rows, block.seen,
            coordinates.share(model.q, part), coordinates.share(r, part), z[part], block.closed,
            ut, d, rho, since, regular, *sweeps.limits(dtype), model.eps,
            store is not None, kept.b[part], kept.g[part], kept.qs[part],
            estimates, mean[part], std[part], nis[part], dof[part],
        )  # fmt: skip
        if wrong >= 0:
            raise ValueError(
                f"the information is no longer finite at step {first + part.start + wrong}: check the units of phi, q "
                "and r there; a direction that phi shrinks and no noise feeds does it too: then use method 'watanabe'"
            )
        since = np.eye(model.n, dtype=dtype) if steps == 0 else block.ends[block.at[-1]].copy()
    if store is not None:
        store.commit(closed, carry.steps, at)
    return _carry(ut, d, rho, since, steps, regular)


def anchor(carry: Carry) -> Carry:
    """Close the current window: the same knowledge about the present epoch, anchored at it. Exact, idempotent."""
    if carry.steps == 0:
        return carry
    ut, d, phi = factors(carry)
    n = phi.shape[0]
    sweeps.anchor(ut, d, phi, carry.regular, float(np.finfo(phi.dtype).eps))
    return _carry(ut, d, carry.d[: carry.d.size - n], np.eye(n, dtype=phi.dtype), 0, carry.regular)


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
        rule: Rule | None = None,
        store: Store | None = None,
    ) -> None:
        self.model, self.rule, self.store = model, rule, store
        self.carry = start(model.n, x0, p0, dtype=model.dtype)
        self.steps = 0

    def step(self, z: ArrayLike, model: LinearModel | None = None) -> Filtered:
        """One step: mean (n,), std (n,), nis and dof after measurement ``z`` (m,); ``model`` replaces the one given."""
        now = self.model.cut(self.steps, self.steps + 1) if model is None else model
        self.carry, after = filter(
            now, self.carry, np.asarray(z, now.dtype)[None], rule=self.rule, store=self.store, first=self.steps
        )
        self.steps += 1
        return Filtered(after.mean[0], after.std[0], after.nis[0], after.dof[0])
