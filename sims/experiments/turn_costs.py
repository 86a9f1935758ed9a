"""What a step of the filters of the coordinated turn costs, beside filterpy where it is installed: Table 2.

CPU time of one thread. The methods take turns, round after round, so that a busy moment of the machine meets all.
"""

from __future__ import annotations

import importlib.util
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

from sims.experiments.coordinated_turn import PROBLEM, STEPS, Draws, M, N, T, radar, turn
from sims.experiments.turn_batches import METHODS, seconds

BASE = "sr_ckf"
TIMED = (BASE, "ekf", "ukf", "ckf", "a", "b", "diplf", "sr_cks", "lag_1")
FILTERPY = "filterpy CubatureKalmanFilter"
ABSENT = "not installed"


class Range(NamedTuple):
    """A figure and its 95 % interval."""

    value: float
    low: float
    high: float
    sigma: float = float("nan")  # of the bootstrap experiments

    def holds(self, value: float) -> bool:
        """Is ``value`` in the interval?"""
        return self.low <= value <= self.high


@dataclass(frozen=True)
class Cost:
    """CPU time of a step, s, the least of the rounds; and over that of SR-CKF, with the range over the rounds."""

    name: str
    label: str
    seconds: float | None
    ratio: Range | None
    note: str = ""


def measure(draws: Draws, rounds: int) -> list[Cost]:
    """CPU time per step of some of the methods and of filterpy, one thread, the methods in turn, round after round."""
    peer = filterpy(draws)
    spent: dict[str, list[float]] = {name: [] for name in TIMED}
    spent[FILTERPY] = []
    for name in TIMED:
        seconds(METHODS[name], draws)  # compiled by now, but not in the cache of the processor
    for _ in range(rounds):
        for name in TIMED:
            spent[name].append(seconds(METHODS[name], draws))
        if peer is not None:
            spent[FILTERPY].append(peer())
    costs = []
    for name, each in spent.items():
        label = METHODS[name].label if name in METHODS else name
        if each:
            ratios = [own / base for own, base in zip(each, spent[BASE], strict=True)]
            least = min(each)
            costs.append(Cost(name, label, least, Range(least / min(spent[BASE]), min(ratios), max(ratios))))
        else:
            costs.append(Cost(name, label, None, None, ABSENT))
    return costs


def filterpy(draws: Draws) -> Callable[[], float] | None:
    """CPU time of a step of filterpy's cubature filter on the first run, s, as a function; None: not installed."""
    if importlib.util.find_spec("filterpy") is None:
        return None
    from filterpy.kalman import CubatureKalmanFilter

    def once() -> float:
        peer: Any = CubatureKalmanFilter(N, M, T, radar, lambda x, _: turn(x))
        peer.x, peer.P = draws.start[0, :, None].copy(), PROBLEM.sqrt_p @ PROBLEM.sqrt_p.T
        peer.Q, peer.R = PROBLEM.sqrt_q @ PROBLEM.sqrt_q.T, PROBLEM.sqrt_r @ PROBLEM.sqrt_r.T
        begin = time.thread_time()
        for k in range(STEPS):
            peer.predict()
            peer.update(draws.z[0, k, :, None])
        return (time.thread_time() - begin) / STEPS

    once()
    return once
