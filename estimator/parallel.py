"""Many records at the same time, one thread each: the same bits as one after the other.

The compiled sweeps hold no lock, so threads are enough; records and results are not copied from process to process.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, NamedTuple

from numpy.typing import ArrayLike

from estimator.linear import Smoothed, smooth
from estimator.model import LinearModel

AHEAD = 2  # records per thread taken from the input before their turn: no thread waits for the next one to be made


class Record(NamedTuple):
    """A record and its model, as for ``estimator.smooth``.

    Attributes
    ----------
    model : LinearModel
    z : (N, m) array
        Measurements, NaN = missing.
    x0, p0 : (n,) mean and (n, n) covariance or (n,) variances
        Prior at epoch 0, or None for both.
    """

    model: LinearModel
    z: ArrayLike
    x0: ArrayLike | None = None
    p0: ArrayLike | None = None


def smooth_records(records: Iterable[Record], *, threads: int | None = None, **options: Any) -> list[Smoothed]:
    """Smooth many records, of any models and lengths, each by ``estimator.smooth`` on a thread of its own.

    Parameters
    ----------
    records : iterable of Record
        Taken as they are needed: of a generator, at most ``AHEAD`` records per thread are held at a time.
    threads : int, optional
        None: as many as there are processors for this process.
    **options
        Keyword arguments of ``estimator.smooth`` that hold for all records: method, window, want.

    Returns
    -------
    Results in the order of the records.

    Raises
    ------
    ValueError
        ``threads`` is less than 1, or ``spill`` is among the options.
    Exception
        Of the first record that failed, as ``estimator.smooth`` raised it, with a note that tells which record it was.
        Records that have not begun are then left alone.
    """
    count = processors() if threads is None else threads
    if count < 1:
        raise ValueError(f"threads is {count}: at least 1 is needed")
    if "spill" in options:
        raise ValueError("spill is for one record: every record needs a folder of its own, with estimator.smooth")
    done: list[Smoothed] = []
    waiting: deque[Future[Smoothed]] = deque()

    def take() -> None:
        try:
            done.append(waiting.popleft().result())
        except Exception as error:
            error.add_note(f"in record {len(done)}")
            raise

    pool = ThreadPoolExecutor(count)
    try:
        for record in records:
            waiting.append(pool.submit(smooth, record.model, record.z, x0=record.x0, p0=record.p0, **options))
            del record
            if len(waiting) >= AHEAD * count:
                take()
        while waiting:
            take()
    finally:
        pool.shutdown(cancel_futures=True)
    return done


def processors() -> int:
    """How many processors this process may use."""
    allowed = getattr(os, "sched_getaffinity", None)  # not every system can say
    return len(allowed(0)) if allowed is not None else os.cpu_count() or 1
