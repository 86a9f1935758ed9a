"""A sortie in three processes, started by the first of them.

::

    this one: receive, archive, decode ──┬──> bus ──> sortie estimate ──┬──> bus ──> sortie record ──> recordings
                                         └──────────────────────────────┴──> back here, to whoever looks on
"""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

from live import Reception, stop_on_signals
from telling import Failure, watch

if TYPE_CHECKING:
    from sims.command import Command
    from telemetry.messages import Message

PATIENCE = 60.0  # s that the others have to end when everything has been handed to them


def follow_apart(
    reception: Reception,
    name: str,
    folder: Path,
    idle: float | None,
    ready: Callable[[str], object],
    tell: Callable[[str], None],
    keep: Callable[[Message], object],
) -> None:
    """Follow a flight as ``sortie ingest``, ``estimate`` and ``record`` do over a bus on this machine, until stopped.

    Parameters
    ----------
    reception : Reception
    name, folder
        The sortie's.
    idle : float or None
        Stop by itself after so many seconds of silence.
    ready : callable
        Given the endpoint of the bus when everything is listening.
    tell : callable
        Given a line for every event and window.
    keep : callable
        Given every message, on another thread.

    Raises
    ------
    Failure
        If one of the others did not begin, failed, or did not end.
    """
    from sims.command import Command, free_port
    from telemetry.bus import Bus, publish

    at = f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
    on_it = ("--sortie", name, "--connect", at)
    which = ("--estimator", reception.configuration.estimate.estimator)
    failures: list[Exception] = []

    def hear(line: str) -> None:
        if line.startswith("ALARM"):  # of the recorder; all else comes over the bus
            tell(line)

    def look_on(subscription: Any) -> None:
        try:
            for message in watch((message for message in subscription if message is not None), tell):
                keep(message)
        except Exception as error:  # the thread has nobody to tell
            failures.append(error)
        finally:
            subscription.close()

    try:
        with ExitStack() as stack:
            bus = stack.enter_context(Bus(name, listen=[at], role="router"))
            others = [
                stack.enter_context(Command("estimate", "estimating on", *on_it, *which)),
                stack.enter_context(Command("record", "recording from", folder, *on_it, hear=hear)),
            ]
            stop_on_signals(reception.source.stop)
            for other in others:
                _begun(other)
            subscription = bus.subscribe("onlooker", ["ingest", "estimate"])
            onlooker = threading.Thread(target=look_on, args=(subscription,))
            onlooker.start()
            ready(at)
            try:
                publish(bus, "ingest", reception.messages(idle))
            finally:  # where it fails it has said so, and the others close what they have
                end = time.monotonic() + PATIENCE
                bus.linger()
                amiss = [text for other in others if (text := _amiss(other, end))]
                if amiss:
                    subscription.stop()
                onlooker.join()
    finally:
        reception.close()
    reception.refuse_loss()
    if amiss:
        raise Failure("; ".join(amiss))
    if failures:
        raise failures[0]


def _begun(other: Command) -> None:
    """Wait until a process is ready."""
    try:
        other.wait()
    except RuntimeError as error:
        raise Failure(str(error)) from None


def _amiss(other: Command, end: float) -> str:
    """Why a process has not ended as it should, if so."""
    try:
        ended = other.end(end)
    except RuntimeError as error:
        return str(error)
    return "" if ended else f"sortie {other.name} did not end: what it has made of the flight may not be whole"
