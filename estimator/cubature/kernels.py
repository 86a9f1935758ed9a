"""The steps of the cubature filters, for compiled code to call (and for Python code, where a model is Python).

Every function returns a status: ``FINE`` (0), or what was wrong with a model function: ``INFINITE`` (1 for f, 2 for h)
or ``SHAPE`` (3 for f, 4 for h). Results are written last and only where all went well; they may be the arrays that
were given. A compiled Monte Carlo loop reads::

    @njit
    def run(f, h, u, mean, root, z, sqrt_q, sqrt_r, turns, work):
        for j in range(len(z)):
            status = kernels.filter_step(f, h, u, mean, root, z[j], sqrt_q, sqrt_r, turns, work, mean, root)
            ...

with ``work = kernels.workspace(n, n, q, m, r, mean)``, ``turns`` (m,) bool, True where a component of z is an angle,
and ``u`` None or what is handed on to f(x, u) and h(x, u). Arrays are C-contiguous and all of one dtype; a missing
component of z is NaN.

A loop that allocates counts the references to every array in ``work`` at every use. A function around the step that is
compiled as in ``ud.lean`` counts none, which makes a step a third faster.
"""

from __future__ import annotations

from typing import Any

from estimator.cubature import arrays, compile, models, reflections
from estimator.cubature.arrays import (
    Side,
    Work,
    choose,
    compare,
    copy,
    couple,
    draw,
    extrapolate,
    gain_by,
    measured,
    moments,
    noise_factor,
    regress,
    reproject,
    retrace,
    side,
    take,
    workspace,
)
from estimator.cubature.compile import woven
from estimator.cubature.models import FINE, INFINITE, SHAPE, images
from estimator.cubature.reflections import Array, annihilate, echelon
from estimator.ud import follow

__all__ = [
    "FINE",
    "INFINITE",
    "SHAPE",
    "Side",
    "Work",
    "backward_smoothing_step",
    "diplf_step",
    "filter_step",
    "predict",
    "side",
    "smooth_step",
    "update",
    "workspace",
]

follow(__file__, arrays.__file__, compile.__file__, models.__file__, reflections.__file__)


NO_LOOK, COUNT, LEAVE_OUT = 0.0, -1.0, 1.0  # what ``annihilate`` does about pivots that are rounding


@woven
def transform(f: Any, u: Any, mean: Array, root: Array, own: Side) -> int:
    """Moments of the images of N(mean, root root^T) under f."""
    n = mean.size
    draw(mean, root, own.points)
    status = images(f, u, own.points, 2 * n, own.values)
    if status == FINE:
        moments(own.values, n, own.mean.size, own.mean, own.parts)
    return status


@woven
def observe(h: Any, u: Any, mean: Array, root: Array, count: int, turns: Any, present: Any, own: Side) -> int:
    """Moments of the images under h of the components that are there; ``count`` as ``measured`` says."""
    n = mean.size
    draw(mean, root, own.points)
    status = images(h, u, own.points, 2 * n + 1 if count < 0 else 2 * n, own.values)
    if status != FINE:
        return status + 1
    choose(n, abs(count), turns, present, own.values)
    moments(own.values, n, abs(count), own.mean, own.parts)
    return FINE


@woven
def forecast(sqrt_q: Array, every: Any, n: int, evens: int, own: Side) -> None:
    """The joint array of a prediction without its lower half: L11 alone."""
    k = own.mean.size
    noise_factor(sqrt_q, every, k, n, own.noise, own.top, own.floor)
    annihilate(own.top, own.parts, n + evens, k, k, own.floor, NO_LOOK)


@woven
def joint(sqrt_q: Array, every: Any, prior_root: Array, evens: int, own: Side, drop: float) -> int:
    """The joint array of a prediction; how many pivots are rounding, counted or left out."""
    n, k = prior_root.shape[0], own.mean.size
    noise_factor(sqrt_q, every, k, n, own.noise, own.top, own.floor)
    couple(prior_root, k, n, evens, own.parts, own.top, own.below, own.floor)
    return annihilate(own.top, own.below, n, k, k + n, own.floor, drop)


@woven
def gain(
    m: int, evens: int, sqrt_r: Array, prior: Array, prior_root: Array, work: Work, mean: Array, out: Array
) -> None:
    """The update by the ``m`` innovations in ``work.innovation``, whose moments stand in ``work.h``."""
    own, n = work.h, prior.size
    noise_factor(sqrt_r, work.present, m, n, own.noise, own.top, own.floor)
    couple(prior_root, m, n, evens, own.parts, own.top, own.below, own.floor)
    dropped = annihilate(own.top, own.below, n, m, m + n, own.floor, LEAVE_OUT)
    gain_by(m, dropped, prior, work.innovation, own.top, own.below, work.spread, work.white, work.told, mean, out)


@woven
def back(
    dropped: int, prior: Array, predicted: Array, newer: Array, newer_root: Array, work: Work, mean: Array, out: Array
) -> None:
    """One step of smoothing back from the joint array of a prediction."""
    own = work.f
    retrace(dropped, prior, predicted, newer, newer_root, own.top, own.below, work.gain, work.stack, mean, out)


@woven
def predict(f: Any, u: Any, mean: Array, root: Array, sqrt_q: Array, work: Work, new: Array, new_root: Array) -> int:
    """Time update into ``new``, ``new_root``."""
    status = transform(f, u, mean, root, work.f)
    if status == FINE:
        forecast(sqrt_q, work.every, mean.size, mean.size, work.f)
        take(work.f.mean, work.f.top, new, new_root)
    return status


@woven
def correct(
    h: Any, u: Any, mean: Array, root: Array, z: Array, count: int, sqrt_r: Array, turns: Any, work: Work, new: Array,
    new_root: Array,
) -> int:  # fmt: skip
    """Measurement update with the components that ``measured`` has listed and counted."""
    status = observe(h, u, mean, root, count, turns, work.present, work.h)
    if status == FINE:
        compare(z, abs(count), turns, work.present, work.h.mean, work.innovation)
        gain(abs(count), mean.size, sqrt_r, mean, root, work, new, new_root)
    return status


@woven
def update(
    h: Any, u: Any, mean: Array, root: Array, z: Array, sqrt_r: Array, turns: Any, work: Work, new: Array,
    new_root: Array,
) -> int:  # fmt: skip
    """Measurement update into ``new``, ``new_root``; ``work.told`` says what it met."""
    count = measured(z, turns, work.present, work.told)
    if count == 0:
        copy(mean, new, root, new_root)
        return FINE
    return correct(h, u, mean, root, z, count, sqrt_r, turns, work, new, new_root)


@woven
def filter_step(
    f: Any, h: Any, u: Any, mean: Array, root: Array, z: Array, sqrt_q: Array, sqrt_r: Array, turns: Any, work: Work,
    new: Array, new_root: Array,
) -> int:  # fmt: skip
    """Time and measurement update."""
    status = predict(f, u, mean, root, sqrt_q, work, work.predicted, work.predicted_root)
    if status == FINE:
        status = update(h, u, work.predicted, work.predicted_root, z, sqrt_r, turns, work, new, new_root)
    return status


@woven
def smooth_step(
    f: Any, u: Any, mean: Array, root: Array, sqrt_q: Array, newer: Array, newer_root: Array, work: Work, new: Array,
    new_root: Array,
) -> int:  # fmt: skip
    """From the state before a step and that after it, given more, to the state before it given as much."""
    status = transform(f, u, mean, root, work.f)
    if status == FINE:
        dropped = joint(sqrt_q, work.every, root, mean.size, work.f, LEAVE_OUT)
        back(dropped, mean, work.f.mean, newer, newer_root, work, new, new_root)
    return status


@woven
def out_and_back(
    f: Any, h: Any, u: Any, mean: Array, root: Array, z: Array, count: int, sqrt_q: Array, sqrt_r: Array, turns: Any,
    stay: bool, work: Work,
) -> int:  # fmt: skip
    """A filter step to ``work.filtered`` and, unless it is to ``stay`` or nothing was measured, back to ``earlier``."""
    n, dropped = mean.size, 0
    stay = stay or count == 0
    status = transform(f, u, mean, root, work.f)
    if status != FINE:
        return status
    if stay:
        forecast(sqrt_q, work.every, n, n, work.f)
    else:
        dropped = joint(sqrt_q, work.every, root, n, work.f, COUNT)
    take(work.f.mean, work.f.top, work.predicted, work.predicted_root)
    if count == 0:
        copy(work.predicted, work.filtered, work.predicted_root, work.filtered_root)
        return FINE
    status = correct(
        h, u, work.predicted, work.predicted_root, z, count, sqrt_r, turns, work, work.filtered, work.filtered_root
    )
    if status != FINE or stay:
        return status
    if dropped > 0:
        moments(work.f.values, n, work.predicted.size, work.f.mean, work.f.parts)
        joint(sqrt_q, work.every, root, n, work.f, LEAVE_OUT)
    back(dropped, mean, work.predicted, work.filtered, work.filtered_root, work, work.earlier, work.earlier_root)
    return FINE


@woven
def passages(
    f: Any, h: Any, u: Any, mean: Array, root: Array, z: Array, count: int, sqrt_q: Array, sqrt_r: Array, turns: Any,
    number: int, work: Work,
) -> int:  # fmt: skip
    """One filter step and back, or 2 of them, the second from where the first led, and there it stays."""
    start, start_root, status = mean, root, FINE
    for passage in range(1 if count == 0 else number):
        if status == FINE:
            again = passage == 1
            status = out_and_back(f, h, u, start, start_root, z, count, sqrt_q, sqrt_r, turns, again, work)
            start, start_root = work.earlier, work.earlier_root
    return status


@woven
def relinearise(
    f: Any, h: Any, u: Any, mean: Array, root: Array, z: Array, count: int, sqrt_q: Array, sqrt_r: Array, turns: Any,
    iterations: int, work: Work,
) -> int:  # fmt: skip
    """Steps from the prior to ``work.filtered``, linear about ``work.earlier`` and ``work.filtered``."""
    status = FINE
    of_f, of_h, n, k, m = work.f, work.h, mean.size, work.predicted.size, abs(count)
    for iteration in range(0 if count == 0 else iterations):
        if status == FINE:
            echelon(work.earlier_root, work.stack)
            echelon(work.filtered_root, work.predicted_root)
            status = transform(f, u, work.earlier, work.earlier_root, work.f)
        if status == FINE:
            status = observe(h, u, work.filtered, work.filtered_root, count, turns, work.present, work.h)
        if status != FINE:
            return status
        regress(work.earlier_root, n, k, of_f.slope, of_f.parts)
        extrapolate(mean, work.earlier, k, of_f.mean, of_f.slope, work.predicted)
        evens = reproject(root, n, k, of_f.slope, of_f.parts)
        again = iteration + 1 < iterations
        dropped = 0
        if again:
            dropped = joint(sqrt_q, work.every, root, evens, work.f, COUNT)
        else:
            forecast(sqrt_q, work.every, n, evens, work.f)
        take(work.predicted, of_f.top, work.predicted, work.predicted_root)
        regress(work.filtered_root, k, m, of_h.slope, of_h.parts)
        extrapolate(work.predicted, work.filtered, m, of_h.mean, of_h.slope, of_h.shift)
        compare(z, m, turns, work.present, of_h.shift, work.innovation)
        evens = reproject(work.predicted_root, k, m, of_h.slope, of_h.parts)
        gain(m, evens, sqrt_r, work.predicted, work.predicted_root, work, work.filtered, work.filtered_root)
        if again:
            if dropped > 0:
                moments(of_f.values, n, k, of_f.mean, of_f.parts)
                regress(work.earlier_root, n, k, of_f.slope, of_f.parts)
                evens = reproject(root, n, k, of_f.slope, of_f.parts)
                joint(sqrt_q, work.every, root, evens, work.f, LEAVE_OUT)
            back(
                dropped, mean, work.predicted, work.filtered, work.filtered_root, work, work.earlier, work.earlier_root
            )
    return status


@woven
def refined_step(
    f: Any, h: Any, u: Any, mean: Array, root: Array, z: Array, sqrt_q: Array, sqrt_r: Array, turns: Any, work: Work,
    new: Array, new_root: Array, iterations: int,
) -> int:  # fmt: skip
    """``diplf_step``, or ``backward_smoothing_step`` where there are no iterations: compiled once for both."""
    count = measured(z, turns, work.present, work.told)
    number = 1 if iterations else 2
    status = passages(f, h, u, mean, root, z, count, sqrt_q, sqrt_r, turns, number, work)
    if status == FINE:
        status = relinearise(f, h, u, mean, root, z, count, sqrt_q, sqrt_r, turns, iterations, work)
    if status == FINE:
        copy(work.filtered, new, work.filtered_root, new_root)
    return status


@woven
def backward_smoothing_step(
    f: Any, h: Any, u: Any, mean: Array, root: Array, z: Array, sqrt_q: Array, sqrt_r: Array, turns: Any, work: Work,
    new: Array, new_root: Array,
) -> int:  # fmt: skip
    """SR-BS-CKF: a step, back by smoothing, and the step again with the same z."""
    count = measured(z, turns, work.present, work.told)
    status = passages(f, h, u, mean, root, z, count, sqrt_q, sqrt_r, turns, 2, work)
    if status == FINE:
        copy(work.filtered, new, work.filtered_root, new_root)
    return status


@woven
def diplf_step(
    f: Any, h: Any, u: Any, mean: Array, root: Array, z: Array, sqrt_q: Array, sqrt_r: Array, turns: Any, work: Work,
    new: Array, new_root: Array, iterations: int,
) -> int:  # fmt: skip
    """A step with f and h linearised where the step itself has led: about the smoothed and the filtered state."""
    return refined_step(f, h, u, mean, root, z, sqrt_q, sqrt_r, turns, work, new, new_root, iterations)
