"""Linear problems in which a filter that subtracts covariances fails, and how exact square roots stay in them.

The truth is worked out in rational numbers from the very floating-point numbers that the filters get: with diagonal R a
measurement is as good as its components one after the other, and each of these is P - P h h^T P / (h^T P h + r).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimator import cubature
from estimator.rivals import ckf

Array = NDArray[Any]
WRONG = 0.05
Exact = list[list[Fraction]]


class Case(NamedTuple):
    """x' = phi x + noise, z = h x + noise, ``steps`` times; all factors."""

    name: str
    phi: Array
    h: Array
    sqrt_p: Array
    sqrt_q: Array
    sqrt_r: Array
    steps: int = 5


@dataclass(frozen=True)
class Verdict:
    """What became of a case.

    Attributes
    ----------
    case : str
    plain_stops : int or None
        Step at which the covariance form stopped; None: it did not.
    plain_error, square_root_error : float or None
        Largest relative error of a standard deviation after the last step; None: it did not get there.
    """

    case: str
    plain_stops: int | None
    plain_error: float | None
    square_root_error: float | None

    @property
    def plain_fails(self) -> bool:
        """The covariance form stopped, or a standard deviation of it is wrong by more than 5 %."""
        return self.plain_error is None or self.plain_error > WRONG

    @property
    def square_root_fails(self) -> bool:
        """The same of the square-root form."""
        return self.square_root_error is None or self.square_root_error > WRONG


def cases() -> list[Case]:
    """Nearly collinear measurements, wide priors with accurate measurements, float32, a prior of rank one in effect."""
    moving = np.array([[1.0, 1.0, 0.5], [0.0, 1.0, 1.0], [0.0, 0.0, 1.0]])
    pair = np.array([[1.0, 1.0, 1.0], [1.0, 1.0, 1.0 + 2.0**-26]])
    first = np.array([[1.0, 0.0, 0.0]])
    both = np.array([[1.0, 0.0, 0.0], [1.0, 2.0**-10, 0.0]])
    still, one = np.eye(3), np.eye(3)
    lean = np.array([[1.0, 0.0, 0.0], [1.0, 2.0**-30, 0.0], [1.0, 2.0**-30, 2.0**-30]])
    return [
        Case("nearly collinear, accurate", still, pair, one, 0.0 * one, 2.0**-27 * np.eye(2)),
        Case("wide prior, very accurate", moving, both, 1e6 * one, 1e-9 * one, 1e-6 * np.eye(2)),
        Case("prior of condition 1e18", still, first, lean, 0.0 * one, np.array([[0.1]])),
        _single(Case("float32, prior 1e5 times the noise", moving, both, 1e3 * one, 1e-3 * one, 1e-2 * np.eye(2))),
    ]


def _single(case: Case) -> Case:
    phi, h, p, q, r = (a.astype(np.float32) for a in (case.phi, case.h, case.sqrt_p, case.sqrt_q, case.sqrt_r))
    return Case(case.name, phi, h, p, q, r, case.steps)


def verdicts() -> list[Verdict]:
    """Of all cases."""
    return [_verdict(case) for case in cases()]


def _verdict(case: Case) -> Verdict:
    true = exact(case)
    stops, plain = _filtered(case, ckf.filter_step, true)
    _, root = _filtered(case, cubature.filter_step, true)
    return Verdict(case.name, stops, plain, root)


def _filtered(case: Case, step: Callable[..., tuple[Array, Array]], true: Array) -> tuple[int | None, float | None]:
    """Step at which a filter stopped, or the largest relative error of its standard deviations."""
    mean, root = np.zeros(len(case.phi), case.phi.dtype), case.sqrt_p
    z = np.zeros(len(case.h), case.h.dtype)
    for k in range(case.steps):
        try:
            mean, root = step(mean, root, lambda x: case.phi @ x, lambda x: case.h @ x, z, case.sqrt_q, case.sqrt_r)
        except ArithmeticError:
            return k + 1, None
    if not np.isfinite(root).all():
        return case.steps, None
    sigma = np.sqrt((root.astype(float) ** 2).sum(axis=1))
    return None, float(np.abs(sigma / true - 1.0).max())


def exact(case: Case) -> Array:
    """Standard deviations after the last step, without rounding but for the square root."""
    phi, h, q, r = (_rational(a) for a in (case.phi, case.h, case.sqrt_q, case.sqrt_r))
    p = _square(_rational(case.sqrt_p))
    noise = _square(q)
    for _ in range(case.steps):
        p = _product(_product(phi, p), _transposed(phi))
        p = [[a + b for a, b in zip(*rows, strict=True)] for rows in zip(p, noise, strict=True)]
        for i, row in enumerate(h):
            ph = [sum((a * b for a, b in zip(line, row, strict=True)), Fraction(0)) for line in p]
            s = sum((a * b for a, b in zip(row, ph, strict=True)), r[i][i] * r[i][i])
            p = [[p[a][b] - ph[a] * ph[b] / s for b in range(len(p))] for a in range(len(p))]
    return np.sqrt([float(p[i][i]) for i in range(len(p))])


def _rational(a: Array) -> Exact:
    return [[Fraction(float(v)) for v in row] for row in a]


def _transposed(a: Exact) -> Exact:
    return [list(column) for column in zip(*a, strict=True)]


def _product(a: Exact, b: Sequence[Sequence[Fraction]]) -> Exact:
    columns = list(zip(*b, strict=True))
    return [[sum((x * y for x, y in zip(row, c, strict=True)), Fraction(0)) for c in columns] for row in a]


def _square(a: Exact) -> Exact:
    return _product(a, _transposed(a))
