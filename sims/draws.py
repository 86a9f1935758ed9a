"""Many seeds: the same flight with other sensor errors, and a function of the seed on several processors."""

from __future__ import annotations

import dataclasses
import multiprocessing
from collections.abc import Callable, Iterable
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from typing import TYPE_CHECKING, TypeVar

from sims.sensors import sense

if TYPE_CHECKING:
    from sims.flight import Flight
    from sims.grades import Grade

Result = TypeVar("Result")


class DrawError(RuntimeError):
    """One of the seeds failed; the cause is the error itself."""


def redraw(flight: Flight, seed: int, grade: str | Grade | None = None) -> Flight:
    """Return the same flight with the sensor errors of another seed, and of another grade if one is given.

    Nothing is flown: it takes milliseconds.
    """
    sensors = flight.sensors
    drawn = sense(
        flight.truth,
        sensors.grade if grade is None else grade,
        seed=seed,
        arms=sensors.arms if grade is None else None,
        latencies=sensors.latencies,
        dropouts=sensors.dropouts,
    )
    return dataclasses.replace(flight, seed=seed, sensors=drawn)


def monte_carlo(
    function: Callable[[int], Result],
    seeds: Iterable[int],
    processes: int = 2,
    progress: Callable[[int, int], None] | None = None,
) -> list[Result]:
    """Return ``[function(seed) for seed in seeds]``, worked out by several processes.

    Parameters
    ----------
    function : callable
        Of a seed; a function at the top level of a module, or a `functools.partial` of one: it is sent to the other
        processes by name. A script that calls this stands under ``if __name__ == "__main__":``.
    seeds : iterable of int
    processes : int
        How many; 1 works here, without another process.
    progress : callable, optional
        Told how many seeds are done, and of how many, whenever one is.

    Raises
    ------
    DrawError
        A seed failed; the text says which. The seeds that had not begun are not begun.
    ValueError
        Fewer than one process.
    """
    wanted = list(seeds)
    if processes < 1:
        raise ValueError(f"monte_carlo needs at least one process, not {processes}")
    if processes == 1:
        return [_alone(function, seed, number, len(wanted), progress) for number, seed in enumerate(wanted, 1)]
    # Spawned and not forked: the parent may have threads of its own (bus, numba), which a fork would leave half alive.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(min(processes, max(1, len(wanted))), mp_context=context) as pool:
        futures: dict[Future[Result], int] = {pool.submit(function, seed): seed for seed in wanted}
        for number, future in enumerate(as_completed(futures), 1):
            if error := future.exception():
                pool.shutdown(wait=False, cancel_futures=True)
                raise DrawError(f"seed {futures[future]}: {type(error).__name__}: {error}") from error
            if progress is not None:
                progress(number, len(wanted))
        return [future.result() for future in futures]


def _alone(
    function: Callable[[int], Result], seed: int, number: int, of: int, progress: Callable[[int, int], None] | None
) -> Result:
    try:
        result = function(seed)
    except Exception as error:
        raise DrawError(f"seed {seed}: {type(error).__name__}: {error}") from error
    if progress is not None:
        progress(number, of)
    return result
