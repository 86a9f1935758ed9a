"""One run of a stage, put together again in the order of its numbers: from what comes live and from its history.

Nothing here knows the network: `Subscription` brings live payloads and answers of the history, and asks what is
wanted. Memory is bounded: what is too far ahead of a gap is let go, because the history has it.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from itertools import islice
from typing import NamedTuple

from telemetry.bus.spool import records
from telemetry.messages import Message, Progress
from telemetry.wire import decode

WINDOW = 8192  # messages that may wait behind a gap,
WINDOW_BYTES = 64 << 20  # and their bytes
LARGEST = 64 << 20  # bytes of one message
SETTLE = 0.05  # s, after which a gap is asked for: streams overtake each other
MOST = 1 << 48  # messages of one run; who claims more is not believed
QUIET = 1.0  # s of silence, after which it is asked whether something was lost at the end
AGAIN = 0.1  # s between two questions of which the first brought nothing
HOPELESS = 1.0  # s, after which a gap that the history has not is given up


class Payload(NamedTuple):
    """A message as it came."""

    schema: str
    data: bytes


class Answer(NamedTuple):
    """What the history of a stage answers: a run of records, and what there is altogether.

    Parameters
    ----------
    first, length : int
        Of the run; `first` is greater than what was asked for if that is not kept any more.
    total : int
        Messages that the stage has said.
    data : bytes
    """

    first: int
    length: int
    total: int
    data: bytes


class Feed:
    """The output of one run of a stage.

    Attributes
    ----------
    next : int
        Number of the message to hand on next.
    processed : int
        Number of the last one that the consumer has finished with.
    final : bool
        The last word has been handed on.
    missing, refused, backfilled : int
        Messages given up; payloads that were no message; messages that came from the history.
    findings : list of str
        What is to be told: refusals and losses. Whoever tells it empties it.
    """

    def __init__(self, stage: str, patience: float) -> None:
        self.stage = stage
        self.next = 0
        self.processed = -1
        self.final = False
        self.missing = 0
        self.refused = 0
        self.backfilled = 0
        self.findings: list[str] = []
        self._patience = patience
        self._waiting: dict[int, Payload] = {}
        self._bytes = 0
        self._backlog: Iterator[tuple[str, bytes]] | None = None
        self._total = 0  # messages that there are, as far as the history or the live stream has told
        self._gone = 0  # the history keeps nothing below this number
        self._more = True  # ask at once: at the beginning, and after an answer that was not all
        now = time.monotonic()
        self._stuck = now  # since when the next message is not there
        self._heard = now  # when something came last
        self._asked = -AGAIN
        self._from = 0  # what was asked for last
        self._unanswered: float | None = None  # since when nobody answers

    @property
    def behind(self) -> bool:
        """Whether it works off history, so that what comes live may be let go."""
        return self._backlog is not None or self._more

    @property
    def hungry(self) -> bool:
        """Whether there is nothing to hand on now."""
        return self._backlog is None and self.next not in self._waiting

    @property
    def held(self) -> int:
        """Messages that wait."""
        return len(self._waiting)

    def add(self, number: int, payload: Payload) -> None:
        """Take a live payload in, unless it is known or too far ahead."""
        self._heard = time.monotonic()
        if number < self.next or number in self._waiting:
            return
        self._total = max(self._total, min(number, self.next + WINDOW) + 1)  # a claim: the history knows
        size = len(payload.data)
        if number > self.next and (number >= self.next + WINDOW or self._bytes + size > WINDOW_BYTES):
            return
        self._waiting[number] = payload
        self._bytes += size

    def wants(self) -> tuple[int, int] | None:
        """What to ask the history for, from and up to but without, if anything; or 0 for no end."""
        now = time.monotonic()
        if self.final or self._backlog is not None or now - self._asked < (0.0 if self._more else AGAIN):
            return None
        if self.next in self._waiting:
            self._more = False
            return None
        gap = self._total > self.next and now - self._stuck > SETTLE
        if not (self._more or gap or now - self._heard > QUIET):
            return None
        self._asked = self._heard = now
        self._from = self.next
        return self.next, min(self._waiting, default=0)

    def check(self) -> None:
        """Ask soon: the link was down."""
        self._more = True

    def unanswered(self, connected: bool) -> None:
        """Nobody answered; while there is no link that says nothing."""
        now = time.monotonic()
        self._more = False
        if not connected:
            self._unanswered = None
        elif self._unanswered is None:
            self._unanswered = now
        elif self._waiting and self.hungry and now - max(self._unanswered, self._stuck) > self._patience:
            self._give_up(min(self._waiting))

    def answer(self, answer: Answer) -> None:
        """Take an answer of the history in."""
        first, length, total, data = answer
        self._unanswered = None
        self._heard = time.monotonic()
        whole = self._from <= first and 0 <= length <= total - first and total < MOST and (length > 0) == bool(data)
        if not whole:
            self._refuse("an answer of the history that contradicts itself")
            self._more = False
            return
        self._total = total
        if first <= self.next < first + length:  # some of it may have come live meanwhile
            self._backlog = islice(self._counted(records(data), length), self.next - first, None)
            self._more = first + length < (min(self._waiting, default=total))
            return
        self._more = False
        if first > self.next:
            self._gone = first
            settled = time.monotonic() - self._stuck > HOPELESS
            if self.hungry and settled:
                self._give_up(min(first, min(self._waiting, default=first)))
                self._more = True

    def _counted(self, run: Iterator[tuple[str, bytes]], length: int) -> Iterator[tuple[str, bytes]]:
        for _ in range(length):
            one = next(run, None)
            if one is None:
                raise ValueError("history breaks off")
            yield one

    def _give_up(self, until: int) -> None:
        lost = until - self.next
        if lost <= 0:
            return
        self.missing += lost
        self.findings.append(f"{lost} messages of stage {self.stage} never arrived")
        self.next = until
        self._stuck = time.monotonic()

    def ready(self, most: int) -> Iterator[Message]:
        """Hand on at most `most` messages; each counts as processed when the next is asked for."""
        for _ in range(most):
            found = self._one()
            if found is None:
                return
            number, payload, stored = found
            try:
                message = _read(payload, number)
            except ValueError as error:
                self._refuse(str(error))
                if stored:
                    self._skip()
                continue  # a live one that is no message is asked for again: the history has what was said
            self.next = number + 1
            self.backfilled += stored
            self.final = isinstance(message, Progress) and message.final
            self._stuck = time.monotonic()
            yield message
            self.processed = number
            if self.final:
                return

    def _one(self) -> tuple[int, Payload, bool] | None:
        if self._backlog is not None:
            try:
                payload = Payload(*next(self._backlog))
            except StopIteration:
                self._backlog = None
            except ValueError:
                self._backlog = None
                self._refuse("history that breaks off")
            else:
                self._drop(self.next)
                return self.next, payload, True
        live = self._drop(self.next)
        return None if live is None else (self.next, live, False)

    def _drop(self, number: int) -> Payload | None:
        payload = self._waiting.pop(number, None)
        if payload is not None:
            self._bytes -= len(payload.data)
        return payload

    def _skip(self) -> None:
        self.missing += 1
        self.next += 1

    def _refuse(self, why: str) -> None:
        self.refused += 1
        if self.refused in (1, 10, 100, 1000):  # a flood of them must not become a flood of events
            self.findings.append(f"refused {self.refused} payloads of stage {self.stage}: {why}")


def _read(payload: Payload, number: int) -> Message:
    message = decode(payload.schema, payload.data)
    if message.sequence != number:
        raise ValueError(f"message {message.sequence} under the number {number}")
    return message
