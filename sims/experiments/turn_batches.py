"""Filters and smoothers on the coordinated turn, in batches of runs: compiled loops, over all processors.

All methods of a batch see the same truths and measurements. What a run gives depends on the run alone: neither on the
number of runs nor on the number of threads.
"""

from __future__ import annotations

import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimator.cubature import kernels
from estimator.cubature.arrays import copy
from estimator.cubature.compile import woven
from estimator.parallel import processors
from estimator.rivals import ckf, covariance, ekf
from estimator.ud import Array, compiled, follow, lean
from sims.experiments import coordinated_turn
from sims.experiments.coordinated_turn import (
    FIRST,
    LAGS,
    PROBLEM,
    STEPS,
    TURNS,
    Draws,
    N,
    radar,
    radar_jacobian,
    turn,
    turn_jacobian,
)

PARTS = ("kernels", "arrays", "compile", "models", "reflections")
follow(
    __file__,
    *(str(Path(kernels.__file__).with_name(f"{part}.py")) for part in PARTS),
    *(str(module.__file__) for module in (covariance, ekf, coordinated_turn)),
)

Mask = NDArray[np.bool_]
Factors = tuple[Array, Array, Array]

LOST = 500.0  # m: a run whose position error is ever above it
CHUNK = 25  # runs a thread takes at a time


class Method(NamedTuple):
    """A filter or smoother of the experiment.

    Attributes
    ----------
    label : str
    code : int
        What the compiled loop does.
    repeats : int
        Backward-forward passes per step; of ``LAGGED``, steps of delay.
    inflation : float
        By which the standard deviations of the measurement noise are multiplied in the filter.
    """

    label: str
    code: int
    repeats: int = 1
    inflation: float = 1.0


EXTENDED, UNSCENTED, CUBATURE, SQUARE_ROOT, AGAIN, BESIDE, SHIFTED, MEAN_ONLY, ITERATED, WHOLE, LAGGED = range(11)
METHODS: dict[str, Method] = {
    "ekf": Method("EKF", EXTENDED),
    "ukf": Method("UKF, kappa = -2", UNSCENTED),
    "ckf": Method("CKF", CUBATURE),
    "sr_ckf": Method("SR-CKF", SQUARE_ROOT),
    "a": Method("SR-BS-CKF (A)", AGAIN),
    "b": Method("reading B: second pass only told", BESIDE),
    "c": Method("reading C: prior factor kept", SHIFTED),
    "d": Method("reading D: first factor kept", MEAN_ONLY),
    "a_inflated": Method("A with R doubled", AGAIN, 1, float(np.sqrt(2.0))),
    "a_2": Method("A, 2 passes", AGAIN, 2),
    "a_3": Method("A, 3 passes", AGAIN, 3),
    "a_5": Method("A, 5 passes", AGAIN, 5),
    "a_10": Method("A, 10 passes", AGAIN, 10),
    "diplf": Method("DIPLF", ITERATED),
    "diplf_2": Method("DIPLF, 2 passes", ITERATED, 2),
    "sr_cks": Method("SR-CKS, whole interval", WHOLE),
    **{f"lag_{lag}": Method(f"fixed lag {lag}", LAGGED, lag) for lag in range(LAGS + 1)},
}
"""By name. Of the readings of the paper's text, A goes on from the second pass; B goes on from the first and only tells
the second; C starts the second pass at the smoothed mean with the factor from before; D goes on from the mean of the
second and the factor of the first. A with more passes goes back and forward so many times, with the same z."""


class Outcome(NamedTuple):
    """What one method made of a batch.

    Attributes
    ----------
    squares : (runs, 4, STEPS - FIRST + 1) array
        Of the steps FIRST to STEPS: squared errors of position, velocity and turn rate (SI, rad), and the normalised
        estimation error squared over n. NaN where the method stopped.
    far : (runs,) array
        The largest position error of steps 1 to STEPS, m; infinite where the method stopped.
    stopped : (runs,) bool array
        The method raised.
    """

    squares: Array
    far: Array
    stopped: Mask

    @property
    def lost(self) -> Mask:
        """Runs with a position error above ``LOST`` at any step."""
        return np.asarray(self.far > LOST)


@compiled
def _score(true: Array, mean: Array, root: Array, step: int, squares: Array) -> float:
    """Put the errors of a step where they belong; returns the distance from the truth."""
    n = mean.size
    white = np.empty(n)
    total = 0.0
    for i in range(n):
        rest = mean[i] - true[i]
        for k in range(i):
            rest -= root[i, k] * white[k]
        white[i] = rest / root[i, i]
        total += white[i] * white[i]
    place = (mean[0] - true[0]) ** 2 + (mean[2] - true[2]) ** 2
    if FIRST <= step <= STEPS:
        squares[0, step - FIRST] = place
        squares[1, step - FIRST] = (mean[1] - true[1]) ** 2 + (mean[3] - true[3]) ** 2
        squares[2, step - FIRST] = (mean[4] - true[4]) ** 2
        squares[3, step - FIRST] = total / n
    return float(np.sqrt(place))


@woven
def _turn(x: Array) -> Any:
    return turn(x)


@woven
def _radar(x: Array) -> Any:
    return radar(x)


@lean
def _filtered(x: Array, s: Array, z: Array, of: Factors, work: Any, new: Array, new_s: Array) -> Any:
    return kernels.filter_step(_turn, _radar, None, x, s, z, of[1], of[2], TURNS, work, new, new_s)


@lean
def _smoothed(
    x: Array, s: Array, of: Factors, newer: Array, newer_s: Array, work: Any, spare: Array, spare_s: Array
) -> Any:
    """From (x, s) before a step and what is known after it, which is overwritten, to what is known before it."""
    status = kernels.smooth_step(_turn, None, x, s, of[1], newer, newer_s, work, spare, spare_s)
    copy(spare, newer, spare_s, newer_s)
    return status


# Every method runs through the same loop, ``_runs``: it is compiled once for each kind of step, so that nothing is
# compiled that is not used, and cached, because the step is a name in it and not an argument.
_EKF = ekf.kernels(turn, radar, turn_jacobian, radar_jacobian).step
_POINTS = ckf.kernels(turn, radar).step


@woven
def _extended(_: int, x: Array, s: Array, z: Array, of: Factors, work: Any, new: Array, new_s: Array) -> Any:
    return _EKF(x, s, z, of[1], of[2], TURNS, 0.0, new, new_s)


@woven
def _unscented(code: int, x: Array, s: Array, z: Array, of: Factors, work: Any, new: Array, new_s: Array) -> Any:
    return _POINTS(x, s, z, of[1], of[2], TURNS, 3.0 - N if code == UNSCENTED else 0.0, new, new_s)


@woven
def _square_root(_: int, x: Array, s: Array, z: Array, of: Factors, work: Any, new: Array, new_s: Array) -> Any:
    return _filtered(x, s, z, of, work, new, new_s)


@lean
def _again(_: int, x: Array, s: Array, z: Array, of: Factors, work: Any, new: Array, new_s: Array) -> Any:
    return kernels.backward_smoothing_step(_turn, _radar, None, x, s, z, of[1], of[2], TURNS, work, new, new_s)


@lean
def _iterated(code: int, x: Array, s: Array, z: Array, of: Factors, work: Any, new: Array, new_s: Array) -> Any:
    return kernels.diplf_step(_turn, _radar, None, x, s, z, of[1], of[2], TURNS, work, new, new_s, code)


@woven
def _forward(
    step: Any, code: int, truth: Array, z: Array, start: Array, of: Factors, scored: bool, squares: Array, far: Array,
    stopped: Mask,
) -> None:  # fmt: skip
    """All steps of some runs, one run after the other; with ``scored`` what came of them."""
    n = start.shape[1]
    work = kernels.workspace(n, n, of[1].shape[1], z.shape[2], of[2].shape[1], start)
    x, s = np.empty(n), np.empty((n, n))
    for r in range(len(z)):
        x[:], s[:, :] = start[r], of[0]
        far[r], stopped[r] = 0.0, False
        for k in range(1, STEPS + 1):
            if step(code, x, s, z[r, k - 1], of, work, x, s) != 0:
                squares[r], far[r], stopped[r] = np.nan, np.inf, True
                break
            if scored:
                far[r] = max(far[r], _score(truth[r, k], x, s, k, squares[r]))


@compiled
def _run_extended(
    code: int, truth: Array, z: Array, start: Array, of: Factors, scored: bool, squares: Array, far: Array,
    stopped: Mask,
) -> None:  # fmt: skip
    _forward(_extended, code, truth, z, start, of, scored, squares, far, stopped)


@compiled
def _run_unscented(
    code: int, truth: Array, z: Array, start: Array, of: Factors, scored: bool, squares: Array, far: Array,
    stopped: Mask,
) -> None:  # fmt: skip
    _forward(_unscented, code, truth, z, start, of, scored, squares, far, stopped)


@compiled
def _run_square_root(
    code: int, truth: Array, z: Array, start: Array, of: Factors, scored: bool, squares: Array, far: Array,
    stopped: Mask,
) -> None:  # fmt: skip
    _forward(_square_root, code, truth, z, start, of, scored, squares, far, stopped)


@compiled
def _run_again(
    code: int, truth: Array, z: Array, start: Array, of: Factors, scored: bool, squares: Array, far: Array,
    stopped: Mask,
) -> None:  # fmt: skip
    _forward(_again, code, truth, z, start, of, scored, squares, far, stopped)


@compiled
def _run_iterated(
    code: int, truth: Array, z: Array, start: Array, of: Factors, scored: bool, squares: Array, far: Array,
    stopped: Mask,
) -> None:  # fmt: skip
    _forward(_iterated, code, truth, z, start, of, scored, squares, far, stopped)


@compiled
def _run_back(
    code: int, repeats: int, truth: Array, z: Array, start: Array, of: Factors, scored: bool, squares: Array,
    far: Array, stopped: Mask,
) -> None:  # fmt: skip
    """The same for what is put together here of filter steps and steps back."""
    n = start.shape[1]
    steps = STEPS + repeats if code == LAGGED else STEPS
    work = kernels.workspace(n, n, of[1].shape[1], z.shape[2], of[2].shape[1], start)
    x, first, back, told = np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    s, first_s, back_s, told_s = np.empty((n, n)), np.empty((n, n)), np.empty((n, n)), np.empty((n, n))
    spare, spare_s = np.empty(n), np.empty((n, n))
    means, roots = np.empty((steps + 1, n)), np.empty((steps + 1, n, n))
    for r in range(len(z)):
        x[:], s[:, :] = start[r], of[0]
        far[r], status = 0.0, 0
        for k in range(1, steps + 1):
            means[k - 1], roots[k - 1] = x, s
            status = max(status, _filtered(x, s, z[r, k - 1], of, work, first, first_s))
            told[:], told_s[:, :] = first, first_s
            if code < WHOLE:
                back[:], back_s[:, :] = x, s
                for _ in range(repeats):
                    status = max(status, _smoothed(back, back_s, of, told, told_s, work, spare, spare_s))
                    back[:] = told
                    back_s[:, :] = s if code == SHIFTED else told_s
                    status = max(status, _filtered(back, back_s, z[r, k - 1], of, work, told, told_s))
            at = k
            if code == LAGGED:
                at = k - repeats
                for j in range(k - 1, max(at, 0) - 1, -1):
                    status = max(status, _smoothed(means[j], roots[j], of, told, told_s, work, spare, spare_s))
            if code == MEAN_ONLY:
                told_s[:, :] = first_s
            if scored and code != WHOLE and at > 0:
                far[r] = max(far[r], _score(truth[r, at], told, told_s, at, squares[r]))
            if code in (BESIDE, WHOLE, LAGGED):
                x[:], s[:, :] = first, first_s
            else:
                x[:], s[:, :] = told, told_s
            if status != 0:
                break
        if code == WHOLE:
            for k in range(steps, 0, -1):
                if status != 0:
                    break
                if scored:
                    far[r] = max(far[r], _score(truth[r, k], told, told_s, k, squares[r]))
                status = _smoothed(means[k - 1], roots[k - 1], of, told, told_s, work, spare, spare_s)
        stopped[r] = status != 0
        if stopped[r]:
            squares[r], far[r] = np.nan, np.inf


ALONE = {
    EXTENDED: _run_extended,
    UNSCENTED: _run_unscented,
    CUBATURE: _run_unscented,
    SQUARE_ROOT: _run_square_root,
    AGAIN: _run_again,
}


def run(method: Method, draws: Draws, threads: int | None = None) -> Outcome:
    """One method on a batch, over all processors or so many threads; the result does not depend on how many.

    Raises
    ------
    ValueError
        ``threads`` is less than 1.
    """
    count = processors() if threads is None else threads
    if count < 1:
        raise ValueError(f"threads is {count}: at least 1 is needed")
    runs = len(draws.z)
    found = Outcome(np.empty((runs, 4, STEPS - FIRST + 1)), np.empty(runs), np.empty(runs, bool))

    def part(first: int) -> None:
        _some(method, draws, first, found, True)

    with ThreadPoolExecutor(count) as pool:
        for _ in pool.map(part, range(0, runs, CHUNK)):
            pass
    return found


def _some(method: Method, draws: Draws, first: int, found: Outcome, scored: bool) -> None:
    at = slice(first, first + CHUNK)
    factors = (PROBLEM.sqrt_p, PROBLEM.sqrt_q, PROBLEM.sqrt_r * method.inflation)
    given: tuple[Any, ...] = (
        draws.truth[at],
        draws.z[at],
        draws.start[at],
        factors,
        scored,
        *(each[at] for each in found),
    )
    if method.code in ALONE and method.repeats == 1:
        ALONE[method.code](method.code, *given)
    elif method.code == ITERATED:
        _run_iterated(method.repeats, *given)
    else:
        _run_back(method.code, method.repeats, *given)


def seconds(method: Method, draws: Draws) -> float:
    """CPU time of a step, s, of one thread, without the comparison with the truth."""
    runs = min(len(draws.z), CHUNK)
    few = Draws(*(each[:runs] for each in draws))
    room = Outcome(np.empty((runs, 4, STEPS - FIRST + 1)), np.empty(runs), np.empty(runs, bool))
    begin = time.thread_time()
    _some(method, few, 0, room, False)
    return (time.thread_time() - begin) / (runs * STEPS)
