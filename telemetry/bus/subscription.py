"""What a consumer hears: the output of some stages, each in its order, whatever the network and the processes do."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, Any

import zenoh

from telemetry.age import Age
from telemetry.bus.ancestry import Ancestry
from telemetry.bus.feed import LARGEST, Answer, Feed, Payload
from telemetry.bus.publisher import LEFT, MSGPACK
from telemetry.messages import Event, Health, Message, Progress, event
from telemetry.wire import decode, encode, schema

if TYPE_CHECKING:
    from telemetry.bus.session import Bus

PATIENCE = 30.0
GRACE = 1.0
ANSWER = 15.0  # s, for one round of the history
POLL = 0.002  # s; waking up for every message costs more than looking as often
FIFO = 1024
TURN = 256


class Life:
    """An iterator over what the stages say while none of them is replaced.

    Attributes
    ----------
    instances : dict of str to str
        The run of each stage; empty while there is none yet.
    replaced : str or None
        When it has ended: why it was not the last, e.g. "stage ingest was restarted". All that was made from it is
        void, and the next life begins with everything from the beginning. None when the stages have said their last,
        or `Subscription.stop` was called.
    """

    def __init__(self, run: Callable[[Life], Iterator[Message | None]]) -> None:
        self.instances: dict[str, str] = {}
        self.replaced: str | None = None
        self._first: list[Message] = []
        self._messages = run(self)

    def join(self, stopped: Callable[[], bool]) -> bool:
        """Wait until every stage is there; False if one of them was replaced meanwhile."""
        while not (self.instances and all(self.instances.values())) and self.replaced is None and not stopped():
            message = next(self._messages, None)
            if message is not None:
                self._first.append(message)
        return self.replaced is None

    def __iter__(self) -> Iterator[Message | None]:
        yield from self._first
        self._first = []
        yield from self._messages


def newest_progress(messages: Iterable[Message]) -> Iterator[Message]:
    """What has come by now, and at its end how far that reaches: the last word about it says all that others did.

    So who has fallen behind catches up in few large batches, not in many small ones.
    """
    newest: Progress | None = None
    for message in messages:
        if not isinstance(message, Progress):
            yield message
        elif message.final:
            newest = None
            yield message
        else:
            newest = message
    if newest is not None:
        yield newest


class _Input:
    """One stage that is listened to."""

    def __init__(self, stage: str, age: Age) -> None:
        self.stage = stage
        self.age = age
        self.run: tuple[str, Feed] = "", Feed(stage, PATIENCE)  # one object, for whoever is asked meanwhile
        self.fifo: Any = None
        self.tokens: Any = None
        self.inquiry: Any = None
        self.left: float | None = None
        self.gone = False

    def begin(self, instance: str) -> Feed:
        """Hear another run from its beginning; the answer is the feed before."""
        before = self.run[1]
        self.run = instance, Feed(self.stage, PATIENCE)
        self.inquiry = None
        self.left, self.gone = None, False
        return before


class Subscription:
    """What some stages say, in their order; ends when each has said its last.

    An event tells when a stage goes before that, and when it is back: it may be restarted, so nothing ends.

    Iterating yields messages, and None when nothing has come, so that a consumer can do what time asks of it. A
    message counts as processed when the next one is asked for. When a stage is replaced by a new run of it, an event
    says so and all stages are told again from their beginning; a consumer that keeps what it heard takes `lives`.

    Attributes
    ----------
    refused : int
        Payloads that were no message of this version.
    missing : int
        Messages given up.
    finished : bool
        Whether all stages have said their last.
    backfilled : int
        Messages that came from the history of their stage: all that was said before this consumer came, and what was
        lost on the way.
    """

    def __init__(
        self, bus: Bus, service: str, stages: Sequence[str], *, health: bool = False, stale: float = 1.0
    ) -> None:
        self._bus = bus
        self._service = bus.chunk(service)
        self._health = health
        self.finished = False
        self._stopping = threading.Event()
        self._past = [0, 0, 0]  # missing, refused, backfilled of the lives before
        self._strays = 0  # payloads of no stage's numbering
        self._inputs = [_Input(bus.chunk(stage), Age(bus.chunk(stage), stale)) for stage in stages]
        self._ancestry = Ancestry([one.stage for one in self._inputs])
        self._tokens_changed = False
        self._handles: list[Any] = []
        self._links = bus.session.info.declare_transport_events_listener(zenoh.handlers.RingChannel(64))
        self._handles.append(self._links)
        for one in self._inputs:
            self._handles.append(
                bus.session.declare_queryable(f"{bus.root}/ack/{self._service}/{one.stage}", self._acknowledge(one))
            )
            self._handles.append(bus.token("listening", self._service, one.stage))
            one.fifo = bus.session.declare_subscriber(f"{bus.root}/{one.stage}/**", zenoh.handlers.FifoChannel(FIFO))
            one.tokens = bus.session.liveliness().declare_subscriber(
                f"{bus.root}/alive/*/{one.stage}/**", zenoh.handlers.FifoChannel(FIFO), history=True
            )
            self._handles.append(one.tokens)

    @property
    def missing(self) -> int:  # noqa: D102
        return self._past[0] + sum(one.run[1].missing for one in self._inputs)

    @property
    def refused(self) -> int:  # noqa: D102
        return self._past[1] + self._strays + sum(one.run[1].refused for one in self._inputs)

    @property
    def backfilled(self) -> int:  # noqa: D102
        return self._past[2] + sum(one.run[1].backfilled for one in self._inputs)

    def _acknowledge(self, one: _Input) -> Callable[[Any], None]:
        key = f"{self._bus.root}/ack/{self._service}/{one.stage}"

        def reply(query: Any) -> None:
            with query:
                instance, feed = one.run
                query.reply(key, f"{instance} {feed.processed}")

        return reply

    def stop(self) -> None:
        """End the iteration before the stages have said their last."""
        self._stopping.set()

    def close(self) -> None:
        """Stop listening."""
        if self._handles:
            self._leave()
        self._rest()
        for handle in self._handles:
            handle.undeclare()
        self._handles = []

    def _leave(self) -> None:
        """Say that nobody has to wait for this consumer any more; who is killed cannot."""
        for one in self._inputs:
            self._bus.session.put(
                f"{self._bus.root}/ack/{self._service}/{one.stage}",
                LEFT,
                congestion_control=zenoh.CongestionControl.BLOCK,
            )

    def _rest(self) -> None:
        """Take no more data: a channel that nobody empties would hold up the whole session."""
        for one in self._inputs:
            if one.fifo is not None:
                one.fifo.undeclare()
                one.fifo = None

    def __iter__(self) -> Iterator[Message | None]:
        for life in self.lives():
            yield from life

    def lives(self, *, together: bool = False) -> Iterator[Life]:
        """One life after another; each begins with everything from its beginning, and only the last has an end.

        Parameters
        ----------
        together : bool
            Wait before each life until all stages are there, so that its `instances` are complete.
        """
        why: str | None = None
        while not self._stopping.is_set():
            life = Life(lambda life, why=why: self._live(life, why, together))  # type: ignore[misc]
            if not together or life.join(self._stopping.is_set):
                yield life
            if life.replaced is None:
                return
            why = life.replaced

    def _live(self, life: Life, why: str | None, together: bool) -> Iterator[Message | None]:
        life.instances = dict(self._ancestry.current)
        if why is not None:
            yield self._tell(f"{why}: everything is told again from its beginning", "warning")
        while not self._stopping.is_set():
            self._look_who_is_there()
            if self._tokens_changed:
                self._tokens_changed = False
                if self._change(life):
                    return
            hold = together and not all(life.instances.values())
            idle = True
            yield from self._look_at_links()
            for one in self._inputs:
                _, feed = one.run
                yield from self._drain(one, hold)
                self._inquire(one)
                for message in () if hold else newest_progress(feed.ready(TURN)):
                    idle = False
                    one.age.add(message)
                    yield message
                for text in feed.findings:
                    yield self._tell(text, "error")
                feed.findings.clear()
                yield from self._watch(one)
            if all(one.run[1].final for one in self._inputs):
                self.finished = True
                self._leave()
                self._rest()
                return
            if idle:
                yield None
                time.sleep(POLL)

    def _change(self, life: Life) -> bool:
        """Follow those who came and went; True when the life is over."""
        chosen = self._ancestry.choose()
        replaced = self._ancestry.replaced(chosen)
        if replaced:
            life.replaced = f"stage {replaced[0]} was restarted"
            for one in self._inputs:  # all of them from their beginning, the others too
                self._account(one.begin(chosen[one.stage]))
            self._ancestry.adopt(chosen)
            return True
        new = set(self._ancestry.adopt(chosen))
        for one in self._inputs:
            if one.stage in new:
                self._account(one.begin(chosen[one.stage]))
        life.instances = dict(self._ancestry.current)
        return False

    def _account(self, feed: Feed) -> None:
        for i, count in enumerate((feed.missing, feed.refused, feed.backfilled)):
            self._past[i] += count

    def _look_who_is_there(self) -> None:
        for one in self._inputs:
            while (sample := one.tokens.try_recv()) is not None:
                self._tokens_changed = True
                chunks = str(sample.key_expr).removeprefix(f"{self._bus.root}/").split("/")
                if len(chunks) != 5 or chunks[2] != one.stage:  # a token speaks for the stage it is allowed for
                    continue
                *_, stage, instance, lineage = chunks
                if sample.kind == zenoh.SampleKind.PUT:
                    self._ancestry.appear(stage, instance, lineage)
                else:
                    self._ancestry.leave(stage, instance)

    def _look_at_links(self) -> Iterator[Message]:
        while (change := self._links.try_recv()) is not None:
            opened = change.kind == zenoh.SampleKind.PUT
            if opened:  # what was on the way is lost, and so are questions
                for one in self._inputs:
                    one.inquiry = None
                    one.run[1].check()
            if self._bus.is_client:
                yield self._tell(*(("the link is open again", "info") if opened else ("the link is lost", "warning")))

    def _drain(self, one: _Input, hold: bool) -> Iterator[Message]:
        """Take in what came live, unless there is enough to hand on: then it waits, and who publishes with it."""
        feed = one.run[1]
        if one.fifo is None or not (hold or feed.behind or feed.hungry):
            return
        for _ in range(FIFO if hold or feed.behind else TURN):
            sample = one.fifo.try_recv()
            if sample is None:
                return
            yield from self._take(one, sample)

    def _take(self, one: _Input, sample: Any) -> Iterator[Message]:
        encoding, _, name = str(sample.encoding).partition(";")
        try:
            size = len(sample.payload)
            if encoding != MSGPACK or size > LARGEST:
                raise ValueError(f"encoding {encoding!r}, {size} bytes")
            if sample.attachment is None:
                if name != schema(Health):
                    raise ValueError("no number")
                if self._health:
                    yield decode(name, sample.payload.to_bytes())
                return
            instance, _, text = sample.attachment.to_string().partition(" ")
            if not (text.isascii() and text.isdecimal() and len(text) < 19):
                raise ValueError(f"number {text[:20]!r}")
        except ValueError as error:
            self._strays += 1
            if self._strays in (1, 10, 100, 1000):
                yield self._tell(f"refused {self._strays} payloads on {sample.key_expr}: {error}", "error")
            return
        current, feed = one.run
        if instance == current:  # another one's are void, or come from its history when it has been announced
            feed.add(int(text), Payload(name, sample.payload.to_bytes()))

    def _inquire(self, one: _Input) -> None:
        """Ask the history, or look for its answer."""
        instance, feed = one.run
        if one.inquiry is None:
            wanted = feed.wants() if instance else None
            if wanted is None:
                return
            try:
                one.inquiry = self._bus.session.get(
                    f"{self._bus.root}/history/{one.stage}/{instance}?from={wanted[0]};to={wanted[1]}",
                    zenoh.handlers.FifoChannel(4),
                    consolidation=zenoh.ConsolidationMode.NONE,  # at once, not when everybody has answered
                    timeout=ANSWER,
                    congestion_control=zenoh.CongestionControl.BLOCK,
                    priority=zenoh.Priority.DATA_LOW,
                )
            except zenoh.ZError:
                feed.unanswered(self._bus.connected)
            return
        try:
            reply = one.inquiry.try_recv()
        except zenoh.ZError:  # the channel is closed
            one.inquiry = None
            feed.unanswered(self._bus.connected)
            return
        if reply is None or reply.ok is None:
            return
        one.inquiry = None
        sample = reply.ok
        try:
            first, count, total = (int(part) for part in sample.attachment.to_string().split(" "))
            feed.answer(Answer(first, count, total, sample.payload.to_bytes()))
        except (ValueError, AttributeError):
            feed.answer(Answer(-1, 0, 0, b""))  # refused there

    def _watch(self, one: _Input) -> Iterator[Message]:
        instance, feed = one.run
        if instance and not feed.final:
            if self._ancestry.is_alive(one.stage):
                one.left = None
            elif one.left is None:
                one.left = time.monotonic()
            gone = one.left is not None and (one.gone or time.monotonic() - one.left > GRACE)
            if gone != one.gone and (not gone or feed.hungry):
                one.gone = gone
                state, level = ("gone", "warning") if gone else ("back", "info")
                yield self._tell(f"stage {one.stage} is {state}", level)
        if one.age.due:
            health, word = one.age.row(self._service, feed.missing, feed.backfilled, feed.refused)
            if self._bus.networked:
                self._bus.session.put(
                    f"{self._bus.root}/{self._service}/0/{Health.family}/{Health.stream}",
                    encode(health),
                    encoding=zenoh.Encoding(MSGPACK).with_schema(schema(Health)),
                    congestion_control=zenoh.CongestionControl.DROP,
                    priority=zenoh.Priority.DATA_LOW,
                )
            if self._health:
                yield health
            if word is not None:
                yield self._tell(word.text, word.level)

    def _tell(self, text: str, level: Any) -> Event:
        now = time.time_ns()
        return event(f"bus: {text}", level=level, source=self._service, t=now, t_rx=now)
