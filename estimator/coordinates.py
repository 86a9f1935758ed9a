"""Moving coordinates x = phi_{j,0} x*: what a step looks like from the anchor of its window, and when to anchor anew.

In star coordinates the state is a random walk x*_{j+1} = x*_j + E_j w_j, measured by M_{j+1} [1]_:

    phi_{j+1,0} = phi_j phi_{j,0}        E_j = phi_{j+1,0}^{-1} gamma_j        M_{j+1} = h_j phi_{j+1,0}

Nothing here depends on the data, nor on Q and R. So for a constant model the three are worked out for one window, once,
and looked up ever after; to the last bit they are the ones that would be worked out again.

References
----------
.. [1] Z. K. Shi, "A new algorithm of fixed-interval smoother and its application to flight test", Acta Automatica
   Sinica, 1991, eqs. (7).
.. [2] W. W. Hager, "Condition estimates", SIAM J. Sci. Stat. Comput. 5 (1984) 311-316; N. J. Higham, "FORTRAN codes for
   estimating the one-norm of a real or complex matrix", ACM TOMS 14 (1988) 381-396.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimator import ud
from estimator.model import LinearModel
from estimator.ud import Array, Order, compiled, exact, factor, solve, solve_transposed, solve_vector
from estimator.window import Rule

ud.follow(__file__)

Flags = NDArray[np.uint8]

CONDITION, LENGTH = 1, 2  # bits of ``closed``: a window ended before this step, after it
CHECK = 8  # steps between two estimates of the condition number
BLOCK = 256  # steps that are prepared at once
TABLES = 8  # of one model, by rule
LONGEST_TABLE = 1000  # steps; a longer window of a constant model is worked out step by step


@exact
def condition(a: Array, lu: Array, order: Order, scale: Array, v: Array) -> float:
    """Estimate of the infinity-norm condition number of F = S^{-1} A S, S = diag(scale); ``v`` (4, n) is scratch.

    The norm of the inverse is estimated from a few solutions with the factors at hand [2]_, in O(n^2): a lower bound,
    as a rule within a factor of three.
    """
    n = a.shape[0]
    x, y, w, xi = v[0], v[1], v[2], v[3]
    norm = 0.0
    for i in range(n):
        total = 0.0
        for j in range(n):
            total += abs(a[i, j]) * scale[j]
        norm = max(norm, total / scale[i])
    estimate = 0.0
    for i in range(n):
        x[i] = 1.0 / n
    for trial in range(5):
        for i in range(n):  # y = F^{-T} x
            w[i] = x[i] / scale[i]
        solve_transposed(lu, order, w, y)
        total = 0.0
        for i in range(n):
            y[i] *= scale[i]
            total += abs(y[i])
            xi[i] = scale[i] if y[i] >= 0.0 else -scale[i]
        if trial > 0 and total <= estimate:
            break
        estimate = total
        solve_vector(lu, order, xi, w)  # F^{-1} sign(y): where does the 1-norm grow?
        best, along = 0, 0.0
        for i in range(n):
            w[i] /= scale[i]
            along += w[i] * x[i]
            if abs(w[i]) > abs(w[best]):
                best = i
        if abs(w[best]) <= along:
            break
        for i in range(n):
            x[i] = 0.0
        x[best] = 1.0
    for i in range(n):  # one vector that the search above can miss
        w[i] = (1.0 + i / max(n - 1, 1)) * (1.0 - 2.0 * (i % 2)) / scale[i]
    solve_transposed(lu, order, w, y)
    total = 0.0
    for i in range(n):
        total += abs(y[i]) * scale[i]
    largest: float = norm * max(estimate, 2.0 * total / (3.0 * n))
    return largest


@exact
def suspect(a: Array, lu: Array, order: Order, scale: Array, limit: float) -> bool:
    """Do the pivots at hand say that the condition number of S^{-1} A S may be near ``limit``?"""
    n = a.shape[0]
    norm = 0.0
    pivot = 0.0
    for i in range(n):
        total = 0.0
        row = a[i]
        for j in range(n):
            total += abs(row[j]) * scale[j]
        norm = max(norm, total / scale[i])
        pivot = max(pivot, scale[order[i]] / (scale[i] * abs(lu[i, i])))
    return not 10.0 * norm * pivot < limit


@compiled
def move(
    phi: Array, gamma: Array, since: Array, steps: int, longest: int, limit: float, scale: Array, eps: float,
    ends: Array, es: Array, closed: Flags,
) -> tuple[int, int]:  # fmt: skip
    """Work out phi_{j+1,0} and E_j of N steps, and where windows close.

    Parameters
    ----------
    phi (1|N, n, n), gamma (1|N, n, p)
    since (n, n), steps : phi_{j,0} of the epoch before the first step, overwritten, and its steps since the anchor
    longest, limit, scale : the closing rule
    ends (N, n, n), es (N, p, n), closed (N,) : phi_{j+1,0}, E_j^T and bits CONDITION and LENGTH, written

    Returns
    -------
    steps since the anchor, and the step whose phi is singular, or -1
    """
    n, p = since.shape[0], gamma.shape[2]
    lu, order = np.empty((n, n), phi.dtype), np.empty(n, np.int64)
    full = (
        p if p <= 4 else (p + 7) // 8 * 8
    )  # columns, the last ones zero: whole registers instead of numbers left over
    g, e, v = np.zeros((n, full), phi.dtype), np.empty((n, full), phi.dtype), np.empty((4, n), phi.dtype)
    unit = np.eye(n).astype(phi.dtype)
    before = since
    for i in range(closed.size):
        now, end = phi[min(i, phi.shape[0] - 1)], ends[i]
        closed[i] = 0
        if steps > 0:
            np.dot(now, before, end)
            stiff = factor(end, lu, order, eps)
            if not stiff and (suspect(end, lu, order, scale, limit) or (steps + 1) % CHECK == 0):
                stiff = not condition(end, lu, order, scale, v) <= limit
            if stiff:
                closed[i] = CONDITION
                steps = 0
        if steps == 0:
            for row in range(n):
                for j in range(n):
                    end[row, j] = now[row, j]
            if factor(end, lu, order, eps):
                return steps, i
        noise = gamma[min(i, gamma.shape[0] - 1)]
        for j in range(n):
            for c in range(p):
                g[j, c] = noise[j, c]
        solve(lu, order, g, e)
        for j in range(n):
            for c in range(p):
                es[i, c, j] = e[j, c]
        steps += 1
        if steps >= longest:
            closed[i] |= LENGTH
            steps = 0
            before = unit
        else:
            before = end
    for row in range(n):
        for j in range(n):
            since[row, j] = before[row, j]
    return steps, -1


@compiled
def observe(h: Array, ends: Array, rows: Array) -> None:
    """M = h phi_{j+1,0}: ``h`` (1|N, m, n), ``ends`` (N, n, n) -> ``rows`` (N, m, n)."""
    for i in range(rows.shape[0]):
        np.dot(h[min(i, h.shape[0] - 1)], ends[i], rows[i])


class Table(NamedTuple):
    """One window of a constant model.

    Attributes
    ----------
    phi : (T+1, n, n) array
        phi_{w,0}, w = 0..T.
    es : (T, p, n) array
        E_w^T.
    rows : (T, m, n) array
        M_w; (0, m, n) where h varies, or a correlated R has to be absorbed in it first.
    why : int
        CONDITION or LENGTH: what closes the window after T steps.
    """

    phi: Array
    es: Array
    rows: Array
    why: int


def table(model: LinearModel, rule: Rule, count: int) -> Table | None:
    """Return the window of a model with constant phi and gamma, of which ``count`` more steps are to be taken.

    None: they vary, or phi is singular, or the window is longer than all the steps that have been asked for so far, or
    too long to tabulate. A step then has to be worked out.
    """
    if model.phi.shape[0] != 1 or model.gamma.shape[0] != 1 or rule.steps > LONGEST_TABLE:
        return None
    scale = rule.scales(model.n)
    key = (rule.steps, rule.kappa, scale.tobytes())
    found = model.tables.get(key)
    if found is None:
        model.taken += count
        if model.taken < rule.steps:
            return None
        if len(model.tables) >= TABLES:
            model.tables.clear()
        n, p, count = model.n, model.p, rule.steps
        phi, es = np.empty((count + 1, n, n), model.dtype), np.empty((count, p, n), model.dtype)
        closed = np.empty(count, np.uint8)
        phi[0] = np.eye(n)
        _, singular = move(
            model.phi, model.gamma, phi[0].copy(), 0, count, rule.kappa, scale.astype(model.dtype), model.eps, phi[1:],
            es, closed,
        )  # fmt: skip
        if singular >= 0:
            return None  # the step by step way says where
        stiff = np.flatnonzero(closed & CONDITION)
        length = int(stiff[0]) if stiff.size else count
        why = CONDITION if stiff.size else LENGTH
        plain = model.h.shape[0] == 1 and model.r.ndim == 2
        rows = np.empty((length if plain else 0, model.m, n), model.dtype)
        observe(model.h, phi[1:], rows)
        found = model.tables[key] = Table(phi[: length + 1].copy(), es[:length].copy(), rows, why)
    assert isinstance(found, Table)
    return found


def phases(table: Table, steps: int, count: int) -> tuple[NDArray[np.int64], Flags, int]:
    """Which step of the window each of ``count`` steps is, bits of ``closed``, and the steps since the anchor after."""
    length = table.es.shape[0]
    since = steps + np.arange(count)
    at = since % length
    if table.why == LENGTH:
        return at, np.where(at == length - 1, LENGTH, 0).astype(np.uint8), int((steps + count) % length)
    closed = np.where((at == 0) & (since > 0), CONDITION, 0).astype(np.uint8)
    return at, closed, int(at[-1]) + 1 if count else steps


class Prepared(NamedTuple):
    """A block of steps as the U-D sweep needs them.

    Attributes
    ----------
    part : slice
        Which steps.
    ends (T, n, n), es (T, p, n), at (k,) : arrays
        phi_{j+1,0} and E_j^T of each step are the rows ``at``.
    rows (S, m, n), seen (k,) : arrays
        M_{j+1} of each step are the rows ``seen``.
    closed : (k,) array
        Bits CONDITION and LENGTH.
    steps : int
        Since the anchor, after the block.
    """

    part: slice
    ends: Array
    es: Array
    at: Order
    rows: Array
    seen: Order
    closed: Flags
    steps: int


def prepare(
    model: LinearModel,
    h: Array,
    rule: Rule,
    found: Table | None,
    phi: Array,
    steps: int,
    count: int,
    kept: tuple[Array, Array] | None,
    first: int,
) -> Iterator[Prepared]:
    """Yield ``count`` steps in blocks.

    Parameters
    ----------
    h : (1|N, m, n) array
        That of the model, whitened.
    found : Table, optional
        Where the steps are looked up; None: they are worked out.
    phi, steps : (n, n) array and int
        phi_{j,0} of the epoch before, and its steps since the anchor.
    kept : (N, n, n) and (N, p, n) arrays, optional
        Where to keep phi_{j+1,0} and E_j^T of the steps worked out.
    first : int
        Number of the first step, for messages.

    Raises
    ------
    ValueError
        phi is singular at some step.
    """
    n, p, m, size = model.n, model.p, model.m, min(count, BLOCK)
    rows = np.empty((size, m, n), model.dtype)
    scale, since, closed = rule.scales(n).astype(model.dtype), phi.copy(), np.empty(size, np.uint8)
    room = kept or (np.empty((size, n, n), model.dtype), np.empty((size, p, n), model.dtype))
    for a in range(0, count, BLOCK):
        part = slice(a, min(a + BLOCK, count))
        own = np.arange(part.stop - a)
        if found is not None:
            at, marks, steps = phases(found, steps, own.size)
            if found.rows.shape[0]:
                yield Prepared(part, found.phi[1:], found.es, at, found.rows, at, marks, steps)
                continue
            ends, es = found.phi[1:], found.es
            observe(share(h, part), ends[at], rows[: own.size])
        else:
            ends, es = (array[part] for array in room) if kept else (array[: own.size] for array in room)
            at, marks = own, closed[: own.size]
            steps, singular = move(
                share(model.phi, part), share(model.gamma, part), since, steps, rule.steps, rule.kappa, scale,
                model.eps, ends, es, marks,
            )  # fmt: skip
            if singular >= 0:
                raise ValueError(
                    f"phi is singular at step {first + a + singular}: the information filter inverts it; methods 'rts' "
                    "and 'watanabe' do not"
                )
            observe(share(h, part), ends, rows[: own.size])
        yield Prepared(part, ends, es, at, rows, own, marks, steps)


def share(array: Array, part: slice) -> Array:
    """The rows of these steps, or the one row that is constant."""
    return array if array.shape[0] == 1 else array[part]
