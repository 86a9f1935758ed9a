"""Stages chained in one process: the messages of one are handed to the next as they are, one after the other.

What a bus does between processes is done here without one: the age of data at every consumer is told each second, and
a stage that fails ends neither those before it nor those after it.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator

import msgspec

from telemetry.age import Age
from telemetry.messages import Event, Message, Progress, event

Stage = Callable[[Iterable[Message]], Iterable[Message]]


def also(messages: Iterable[Message], stage: Stage) -> Iterator[Message]:
    """The messages, and among them what a stage makes of them."""
    passed: deque[Message] = deque()

    def tap() -> Iterator[Message]:
        for message in messages:
            passed.append(message)
            yield message

    for made in stage(tap()):
        while passed:
            yield passed.popleft()
        yield made
    yield from passed


def unbroken(name: str, messages: Iterable[Message], failures: list[Exception]) -> Iterator[Message]:
    """What a stage says; where it fails, why, as its last word. The error is appended to `failures`."""
    try:
        yield from messages
    except Exception as error:
        failures.append(error)
        yield failed(name, error)


def expendable(name: str, stage: Stage, failures: list[Exception]) -> Stage:
    """A stage without which the others go on: where it fails, it says why, and from then on only how far time has come.

    The error is appended to `failures`.
    """

    def safe(messages: Iterable[Message]) -> Iterator[Message]:
        stream = iter(messages)
        yield from unbroken(name, stage(stream), failures)
        for message in stream:
            if isinstance(message, Progress):
                yield msgspec.structs.replace(message, source=name)

    return safe


def aged(
    messages: Iterable[Message],
    consumer: str,
    stage: str,
    kinds: type[Message] | tuple[type[Message], ...] = Message,
    *,
    stale: float = 1.0,
) -> Iterator[Message]:
    """Tell each second how old the messages of a stage are where a consumer gets them.

    Parameters
    ----------
    messages : iterable of Message
        What the consumer is handed.
    consumer, stage : str
        Who listens to whom.
    kinds : type or tuple of types
        What the stage says; all else passes by.
    stale : float
        Age from which an event alarms, s (`telemetry.age`).
    """
    age = Age(stage, stale)
    for message in messages:
        if isinstance(message, kinds):
            age.add(message)
        yield message
        if age.due:
            health, word = age.row(consumer, 0, 0, 0)
            yield health
            if word is not None:
                yield event(word.text, level=word.level, source=consumer, t=int(health.t[0]), t_rx=int(health.t_rx[0]))


def failed(stage: str, error: BaseException) -> Event:
    """The last word of a stage that fails."""
    now = time.time_ns()
    text = f"stage {stage} failed: {str(error).strip() or type(error).__name__}"
    return event(text, level="error", source=stage, t=now, t_rx=now)
