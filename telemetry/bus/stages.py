"""Stages on the bus: messages in, messages out, and the same again when what they were made from is replaced."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from typing import TYPE_CHECKING

import numpy as np

from telemetry.bus.ancestry import Lineage
from telemetry.bus.subscription import GRACE, Life
from telemetry.chain import failed
from telemetry.messages import Message, Progress

if TYPE_CHECKING:
    from collections.abc import Sequence

    from telemetry.bus.session import Bus
    from telemetry.bus.subscription import Subscription


class Replaced(Exception):
    """What a stage was fed with is void: an input has been restarted."""


def publish(bus: Bus, stage: str, messages: Iterable[Message], lineage: Lineage | None = None) -> bool:
    """Put all a stage says on the bus.

    If making the messages fails, consumers are told why and that nothing more will come, and the error goes on. An
    interruption is no failure, and ends the output too. After `Replaced` there is no last word: the output is void.

    Parameters
    ----------
    bus : Bus
    stage : str
    messages : iterable of Message
    lineage : mapping of str to str, optional
        The runs of other stages that they are made from: `Life.instances`.

    Returns
    -------
    bool
        Whether every consumer has processed all of it.
    """
    publisher = bus.publisher(stage, lineage)
    try:
        for message in messages:
            publisher.put(message)
    except Replaced:
        publisher.abandon()
        raise
    except BaseException as error:
        now = time.time_ns()
        if not isinstance(error, KeyboardInterrupt):
            publisher.put(failed(stage, error))
        times = np.array([now], np.int64)
        publisher.put(Progress(vehicle=0, source=stage, boot=0, t=times, t_rx=times, final=True))
        publisher.finish(GRACE)
        raise
    return publisher.finish()


def serve(
    bus: Bus,
    stage: str,
    inputs: Sequence[str],
    function: Callable[[Iterable[Message]], Iterable[Message]],
    *,
    started: Callable[[Subscription], object] | None = None,
) -> bool:
    """Run a stage on the bus until its inputs have said their last.

    When one of them is restarted, the function begins anew on everything from the beginning, and so do those who
    listen to it.

    Parameters
    ----------
    bus : Bus
    stage : str
        Its name.
    inputs : sequence of str
        The stages it listens to.
    function : callable
        The stage itself: messages in, messages out.
    started : callable, optional
        Given the subscription, e.g. to be able to `stop` it.

    Returns
    -------
    bool
        As `publish`; False when it was stopped before there was anything to listen to.
    """
    subscription = bus.subscribe(stage, inputs)
    try:
        if started is not None:
            started(subscription)
        for life in subscription.lives(together=True):
            try:
                return publish(bus, stage, function(_fed(life)), life.instances)
            except Replaced:
                continue
        return False
    finally:
        subscription.close()


def _fed(life: Life) -> Iterator[Message]:
    for message in life:
        if message is not None:
            yield message
    if life.replaced is not None:
        raise Replaced(life.replaced)
