"""What a stage says: numbered, kept on disk, put on the bus."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

import msgspec
import zenoh

from telemetry.bus.ancestry import Lineage, new_instance, write_lineage
from telemetry.bus.feed import LARGEST
from telemetry.bus.security import ONLOOKER
from telemetry.bus.spool import Spool
from telemetry.messages import Message, event
from telemetry.wire import encode, schema

if TYPE_CHECKING:
    from telemetry.bus.session import Bus

MSGPACK = "application/msgpack"
DRAIN = 30.0
ONLOOKERS = 3.0  # s, for who only looks on: nobody fails because of them
ROUND = 1 << 19  # bytes of one answer of the history
MANY = 256  # who comes and goes, remembered until it is looked at
LEFT = b"left"


class Publisher:
    """Puts the messages of one stage on the bus, numbered.

    Parameters
    ----------
    bus : Bus
    stage : str
    lineage : mapping of str to str, optional
        The runs of other stages that this output is made from, instance by stage. When one of them is replaced, this
        output is void.

    Attributes
    ----------
    instance : str
        Name of this run: a restarted stage counts from 0 again, and must be told apart.
    sequence : int
        Number of the next message.
    """

    def __init__(self, bus: Bus, stage: str, lineage: Lineage | None = None) -> None:
        self.sequence = 0
        self.instance = new_instance()
        self._bus = bus
        self._name = stage
        self._stage = bus.chunk(stage)
        self._spool = Spool(bus.history)
        self._told: tuple[str | None, int] = None, 0
        self._publishers: dict[str, Any] = {}
        self._history = bus.session.declare_queryable(f"{bus.root}/history/{self._stage}/{self.instance}", self._answer)
        self._listeners = bus.session.liveliness().declare_subscriber(
            f"{bus.root}/listening/*/*/{self._stage}", zenoh.handlers.RingChannel(MANY), history=True
        )
        self._leaving = bus.session.declare_subscriber(
            f"{bus.root}/ack/*/{self._stage}", zenoh.handlers.RingChannel(MANY)
        )
        self._listening: set[str] = set()  # services that were there and have not said that they left
        self._alive: Any = bus.token("alive", self._stage, self.instance, write_lineage(lineage or {}))

    def put(self, message: Message) -> None:
        """Send one message; blocks while a consumer is too slow, at most for as long as the bus lets it."""
        self._put(message)
        self._check_spool(message)

    def _put(self, message: Message) -> None:
        numbered = msgspec.structs.replace(message, sequence=self.sequence)
        payload = encode(numbered)
        if len(payload) > LARGEST:
            text = f"{type(message).__name__} of {len(payload) >> 20} MB left out: the bus carries {LARGEST >> 20} MB"
            now = time.time_ns()
            numbered = event(text, level="error", source=self._name, t=now, t_rx=now)
            numbered = msgspec.structs.replace(numbered, sequence=self.sequence)
            payload = encode(numbered)
        kind = type(numbered)
        # On disk before it is on the bus: whoever sees its number may ask for what came before.
        self._spool.add(schema(kind), payload)
        self.sequence += 1
        key = f"{numbered.vehicle}/{kind.family}/{kind.stream}"
        publisher = self._publishers.get(key)
        if publisher is None:
            publisher = self._publishers[key] = self._bus.session.declare_publisher(
                f"{self._bus.root}/{self._stage}/{key}",
                encoding=zenoh.Encoding(MSGPACK).with_schema(schema(kind)),
                congestion_control=zenoh.CongestionControl.BLOCK,
                priority=zenoh.Priority.DATA_HIGH,
            )
        publisher.put(payload, attachment=f"{self.instance} {numbered.sequence}")

    def _check_spool(self, message: Message) -> None:
        told = self._spool.error, self._spool.shortened
        if told == self._told:
            return
        self._told = told
        if not self._bus.networked:  # everybody is in this process, and no link can drop
            return
        if self._spool.error is not None:
            text = f"the history of stage {self._name} is given up: {self._spool.error}; who joins late misses it"
        else:
            text = f"the history of stage {self._name} begins at message {self._spool.oldest} now: it was too long"
        self._put(event(text, level="error", source=self._name, t=int(message.t[-1]), t_rx=int(message.t_rx[-1])))

    def _answer(self, query: Any) -> None:
        """One round of the history, to ``?from=N;to=M``; without `to`, up to the end."""
        with query:
            try:
                first = int(query.parameters.get("from") or 0)
                last = int(query.parameters.get("to") or 0)
            except ValueError:
                query.reply_err(b"from and to are numbers")
                return
            total = self._spool.count
            run = self._spool.read(first, min(last, total) if last else total, ROUND)
            query.reply(
                f"{self._bus.root}/history/{self._stage}/{self.instance}",
                run.data,
                attachment=f"{run.first} {run.length} {total}",
            )

    def finish(self, deadline: float = DRAIN) -> bool:
        """Wait until every consumer has processed the last message; the stage then no longer counts as there.

        A consumer that is gone without having said so was killed: it may be restarted, and is waited for too.

        Returns
        -------
        bool
            False when one had not within `deadline` seconds, or nobody can tell because the router is gone.
        """
        end = time.monotonic() + deadline
        while not (done := self._bus.connected and self._processed()) and time.monotonic() < end:
            time.sleep(0.02)
        patience = min(end, time.monotonic() + ONLOOKERS)
        while done and not self._processed(onlookers=True) and time.monotonic() < patience:
            time.sleep(0.02)
        self.abandon()
        return done

    def abandon(self) -> None:
        """Leave at once: what has been said is void, or everybody has it."""
        if self._alive is not None:
            self._alive.undeclare()
            for handle in (self._history, self._listeners, self._leaving):
                handle.undeclare()  # type: ignore[no-untyped-call]
            publisher: Any  # zenoh tells no types of it
            for publisher in self._publishers.values():
                publisher.undeclare()
            self._alive = None
            self._publishers = {}
            self._spool.close()

    def _processed(self, onlookers: bool = False) -> bool:
        listening = {service for _, _, service, *_ in self._bus.tokens(f"listening/*/*/{self._stage}")}
        while (sample := self._listeners.try_recv()) is not None:
            if sample.kind == zenoh.SampleKind.PUT:
                self._listening.add(str(sample.key_expr).split("/")[-2])
        while (sample := self._leaving.try_recv()) is not None:
            self._listening.discard(str(sample.key_expr).split("/")[-2])
        listening = (listening | self._listening) - (set() if onlookers else {ONLOOKER})
        if not listening or self.sequence == 0:
            return True
        done: dict[str, int] = {}
        everyone = zenoh.ConsolidationMode.NONE  # two consumers of one name are two
        for reply in self._bus.session.get(
            f"{self._bus.root}/ack/*/{self._stage}", consolidation=everyone, timeout=1.0
        ):
            if reply.ok is None:
                continue
            *_, service, _ = str(reply.ok.key_expr).split("/")
            try:
                instance, processed = reply.ok.payload.to_string().split(" ")
                number = int(processed)
            except ValueError:  # no answer of ours
                continue
            number = number if instance == self.instance and number < self.sequence else -1
            done[service] = min(number, done.get(service, number))
        return all(done.get(service, -1) >= self.sequence - 1 for service in listening)
