"""Work beside the flight: windows are smoothed and judged while the filter flies on.

What a job says depends on nothing that changes after it was given, so it is the same whenever it is done; only its
place among the other messages is not.
"""

from __future__ import annotations

import os
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from typing import TypeVar

from telemetry.messages import Message

T = TypeVar("T")
Job = Callable[[], Iterable[Message]]

BACKLOG = 16  # jobs that may wait: beyond that the flight waits for them, and memory stays bounded


class Beside:
    """Does jobs in the order they are given: at once, or on a thread of their own; questions on another.

    Parameters
    ----------
    thread : bool
        Whether on a thread. The compiled sweeps, where the time goes, hold no lock.
    """

    def __init__(self, thread: bool) -> None:
        self._pool = ThreadPoolExecutor(1, "beside", _make_way) if thread else None
        self._asked = ThreadPoolExecutor(1, "asked") if thread else None  # an answer is due sooner than a long window
        self._waiting: deque[Future[list[Message]]] = deque()

    def run(self, job: Job) -> Iterator[Message]:
        """Do a job, or see to it that it is done; says what there is to say by now."""
        if self._pool is None:
            yield from job()
            return
        while len(self._waiting) >= BACKLOG:
            yield from self._waiting.popleft().result()
        self._waiting.append(self._pool.submit(_whole, job))

    def ask(self, question: Callable[[], T]) -> Callable[[], T]:
        """Have a question answered; gives back what waits for the answer."""
        if self._asked is None:
            answer = question()
            return lambda: answer
        return self._asked.submit(question).result

    def done(self, *, all: bool = False) -> Iterator[Message]:
        """What finished jobs have to say; with `all`, after waiting for those that are not finished."""
        while self._waiting and (all or self._waiting[0].done()):
            yield from self._waiting.popleft().result()

    def close(self) -> None:
        """Give up what has not begun."""
        for pool in (self._pool, self._asked):
            if pool is not None:
                pool.shutdown(cancel_futures=True)


def _whole(job: Job) -> list[Message]:
    return list(job())


def _make_way() -> None:
    """Let this thread have what of the processors the flight leaves, where a thread has a priority of its own."""
    if sys.platform != "linux":
        return
    thread = threading.get_native_id()
    with suppress(OSError):  # not allowed: then it takes its share
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))  # also in a process of real-time priority
        os.setpriority(os.PRIO_PROCESS, thread, min(os.getpriority(os.PRIO_PROCESS, thread) + 10, 19))
