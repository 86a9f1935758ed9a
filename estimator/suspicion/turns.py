"""Signed permutations: which axis of a sensor is which, by a matrix that should be the identity."""

from __future__ import annotations

from itertools import permutations, product
from typing import NamedTuple

import numpy as np

from estimator.suspicion.columns import Fit, Floats


class Turn(NamedTuple):
    """A signed permutation: y_i = sign_i x_{order_i}."""

    order: tuple[int, ...]
    sign: tuple[int, ...]

    @property
    def matrix(self) -> Floats:
        """P (n, n) with y = P x."""
        out = np.zeros((len(self.order), len(self.order)))
        out[np.arange(len(self.order)), list(self.order)] = self.sign
        return out


def misfit(found: Fit, turn: Turn | None = None) -> float:
    """Sum of ((M - P) / (sigma + 0.15))^2 for y = M x, M (n, n); P the identity by default.

    An axis that was not excited (large sigma) votes for none.
    """
    matrix = np.eye(len(found.value)) if turn is None else turn.matrix
    return float((((found.value - matrix) / (found.sigma + 0.15)) ** 2).sum())


def nearest_turn(found: Fit) -> Turn | None:
    """The signed permutation P with the least `misfit`, if that of the identity is larger by 15."""
    n = len(found.value)
    own = misfit(found)
    best, least = None, own
    for order in permutations(range(n)):
        for sign in product((1, -1), repeat=n):
            turn = Turn(order, sign)
            # A tie between turns that differ only where nothing was seen goes to the least change.
            changed = sum(i != o for i, o in enumerate(order)) + sum(s < 0 for s in sign)
            cost = misfit(found, turn) + 0.5 * changed
            if changed and cost < least:
                best, least = turn, cost
    return best if own - least > 15.0 else None


def named(turn: Turn, names: tuple[str, ...]) -> tuple[str, str]:
    """Defect ("sign" or "axes") and words for what a sensor with that turn does."""
    moved = [i for i, o in enumerate(turn.order) if i != o]
    flipped = [names[i] for i in range(len(names)) if turn.order[i] == i and turn.sign[i] < 0]
    words = []
    if moved:
        what = ", ".join(f"{names[i]} is {'-' if turn.sign[i] < 0 else ''}{names[turn.order[i]]}" for i in moved)
        words.append(f"its axes are exchanged ({what})")
    if flipped:
        words.append(f"{' and '.join(flipped)} {'has' if len(flipped) == 1 else 'have'} the wrong sign")
    return "axes" if moved else "sign", "; ".join(words)
