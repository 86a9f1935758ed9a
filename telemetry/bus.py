"""The bus: stages hand messages to one another over zenoh, inside one process or between several.

Keys are ``sortie/{sortie}/{stage}/{vehicle}/{family}/{stream}``: who speaks first, so that a consumer subscribes to a
stage, and an access list can tie a stage to a certificate. Nothing is scouted, and nothing listens unless it is
named.

A stage numbers its output (`Message.sequence`) without gaps over all its streams. A consumer puts the streams
together again in that order, whatever the network did to them; what does not come within `PATIENCE` is reported as
missing, never skipped in silence. Publishers block rather than drop, keep a cache for late joiners, and at the end
wait until every consumer has processed the last message, because closing a session does not drain it.
"""

from __future__ import annotations

import heapq
import json
import re
import secrets
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import msgspec
import numpy as np
import zenoh
import zenoh.ext

from telemetry.messages import Event, Message, Progress, decode, encode, event, schema

PATIENCE = 5.0
DRAIN = 30.0
CACHE = 8192
_MSGPACK = "application/msgpack"
_LOOPBACK = re.compile(r"^tcp/(127\.\d+\.\d+\.\d+|localhost|\[::1\]):\d+$")


def _config(mode: str, listen: Sequence[str], connect: Sequence[str]) -> zenoh.Config:
    config = zenoh.Config()
    for key, value in {
        "mode": mode,
        "listen/endpoints": list(listen),
        "connect/endpoints": list(connect),
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "timestamping/enabled": True,  # the caches need it
        "connect/timeout_ms": 500,
        "connect/exit_on_failure": True,
        "connect/retry": {"period_init_ms": 100, "period_max_ms": 1000, "period_increase_factor": 1.5},
        # A consumer that stalls for longer than this loses its link, and with it what was on the way.
        "transport/link/tx/queue/congestion_control/block/wait_before_close": 30_000_000,
    }.items():
        config.insert_json5(key, json.dumps(value))
    return config


def chunk(text: str) -> str:
    """User text as one chunk of a key: what zenoh gives a meaning to becomes ``_``."""
    return re.sub(r"[^A-Za-z0-9_.-]", "_", text) or "_"


class Bus:
    """A session.

    Parameters
    ----------
    sortie : str
        Name of the sortie, part of every key.
    listen : sequence of str
        Endpoints to accept other processes on, e.g. ``tcp/127.0.0.1:7447``. The session is then the router of the
        sortie.
    connect : sequence of str
        Endpoints of a router to join. With neither, the session has no network at all.
    wait : float, optional
        How long to wait for the router, s; for ever if not given.

    Raises
    ------
    ValueError
        If an endpoint is not on the loopback interface: the bus neither authenticates nor hides anything yet.
    OSError
        If it cannot listen, e.g. because the port is in use, or the router did not come.
    """

    def __init__(
        self, sortie: str, *, listen: Sequence[str] = (), connect: Sequence[str] = (), wait: float | None = None
    ) -> None:
        for endpoint in (*listen, *connect):
            if not _LOOPBACK.match(endpoint):
                raise ValueError(
                    f"{endpoint!r} is no loopback endpoint such as tcp/127.0.0.1:7447: "
                    "the bus does not leave this machine"
                )
        self.root = f"sortie/{chunk(sortie)}"
        mode = "router" if listen else "client" if connect else "peer"
        zenoh.init_log_from_env_or("error")
        end = None if wait is None else time.monotonic() + wait
        while True:  # rather than inside zenoh, where nothing could interrupt the wait
            try:
                self.session = zenoh.open(_config(mode, listen, connect))
                return
            except zenoh.ZError as error:
                if listen:
                    raise OSError(
                        f"cannot open the bus on {', '.join(listen)}: the port is in use, or not ours to use "
                        f"({str(error).split(' at ')[0]})"
                    ) from None
                if end is not None and time.monotonic() > end:
                    raise OSError(
                        f"nobody carries the bus on {', '.join(connect)}: start sortie ingest there first"
                    ) from None

    def publisher(self, stage: str) -> Publisher:
        """The output of a stage."""
        return Publisher(self, stage)

    def subscribe(self, service: str, stages: Sequence[str]) -> Subscription:
        """Everything that `stages` say, for a consumer named `service`."""
        return Subscription(self, service, stages)

    def close(self) -> None:
        """Close the session; what is still on the way may be lost, so publishers `finish` first."""
        self.session.close()  # type: ignore[no-untyped-call]

    def __enter__(self) -> Bus:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class Publisher:
    """Puts the messages of one stage on the bus, numbered.

    Attributes
    ----------
    sequence : int
        Number of the next message.
    """

    def __init__(self, bus: Bus, stage: str) -> None:
        self.sequence = 0
        self._bus = bus
        self._stage = stage
        self._instance = secrets.token_hex(4)  # a restarted stage counts from 0 again, and must be told apart
        self._publishers: dict[str, Any] = {}

    def put(self, message: Message) -> None:
        """Send one message; blocks while a consumer is too slow."""
        kind = type(message)
        key = f"{self._bus.root}/{chunk(self._stage)}/{message.vehicle}/{kind.family}/{kind.stream}"
        if key not in self._publishers:
            self._publishers[key] = zenoh.ext.declare_advanced_publisher(
                self._bus.session,
                key,
                encoding=zenoh.Encoding(_MSGPACK).with_schema(schema(kind)),
                congestion_control=zenoh.CongestionControl.BLOCK,
                priority=zenoh.Priority.DATA_HIGH,
                cache=zenoh.ext.CacheConfig(max_samples=CACHE),
                sample_miss_detection=zenoh.ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=0.2),
                publisher_detection=True,
            )
        numbered = msgspec.structs.replace(message, sequence=self.sequence)
        self.sequence += 1
        self._publishers[key].put(encode(numbered), attachment=self._instance)

    def finish(self, deadline: float = DRAIN) -> bool:
        """Wait until every consumer has processed the last message.

        Returns
        -------
        bool
            False when one had not within `deadline` seconds.
        """
        end = time.monotonic() + deadline
        session = self._bus.session
        while True:
            listening = [
                str(r.ok.key_expr).split("/")[-2]
                for r in session.liveliness().get(f"{self._bus.root}/listening/*/{chunk(self._stage)}", timeout=1.0)
                if r.ok
            ]
            done = {}
            for reply in session.get(f"{self._bus.root}/ack/*/{chunk(self._stage)}", timeout=1.0):
                if reply.ok:
                    service, instance, processed = reply.ok.payload.to_string().split(" ")
                    done[service] = int(processed) if instance == self._instance else -1
            if all(done.get(service, -1) >= self.sequence - 1 for service in listening):
                return True
            if time.monotonic() > end:
                return False
            time.sleep(0.02)


class _Arrival(NamedTuple):
    stage: str
    instance: str
    schema: str
    payload: bytes


class _Order:
    """Puts the messages of one stage in the order of their numbers."""

    def __init__(self, stage: str) -> None:
        self.stage = stage
        self.instance = ""
        self.next = 0
        self.waiting: list[tuple[int, Message]] = []
        self.waiting_since = 0.0
        self.final = False

    def add(self, instance: str, message: Message) -> str | None:
        """Take a message in; the answer is a text if the stage turned out to have been restarted."""
        said = None
        if instance != self.instance:
            said = f"stage {self.stage} was restarted" if self.instance else None
            self.instance, self.next, self.waiting = instance, 0, []
        if message.sequence >= self.next and all(message.sequence != number for number, _ in self.waiting):
            heapq.heappush(self.waiting, (message.sequence, message))
        return said

    def ready(self) -> Iterator[Message]:
        while self.waiting and self.waiting[0][0] == self.next:
            self.next += 1
            self.waiting_since = time.monotonic()
            message = heapq.heappop(self.waiting)[1]
            self.final = self.final or (isinstance(message, Progress) and message.final)
            yield message

    def overdue(self) -> int:
        """Messages to give up, if the next one has been missing for too long."""
        if not self.waiting:
            self.waiting_since = time.monotonic()
            return 0
        if time.monotonic() - self.waiting_since < PATIENCE:
            return 0
        missing = self.waiting[0][0] - self.next
        self.next = self.waiting[0][0]
        return missing


class Subscription:
    """What some stages say, in their order; ends when each has said its last.

    Iterating yields messages, and now and then None when nothing has come for 0.1 s, so that a consumer can do what
    time asks of it. A message counts as processed when the next one is asked for.

    Attributes
    ----------
    refused : int
        Payloads that were no message of this version.
    missing : int
        Messages given up.
    """

    def __init__(self, bus: Bus, service: str, stages: Sequence[str]) -> None:
        self.refused = 0
        self.missing = 0
        self._bus = bus
        self._service = chunk(service)
        self._orders = {chunk(stage): _Order(stage) for stage in stages}
        self._processed = dict.fromkeys(self._orders, -1)
        self._stopping = threading.Event()
        self._fifo: list[Any] = []
        self._handles: list[Any] = []
        for stage in self._orders:
            self._fifo.append(
                zenoh.ext.declare_advanced_subscriber(
                    bus.session,
                    f"{bus.root}/{stage}/**",
                    zenoh.handlers.FifoChannel(1024),
                    history=zenoh.ext.HistoryConfig(detect_late_publishers=True),
                    recovery=zenoh.ext.RecoveryConfig(periodic_queries=None, heartbeat=True),
                    subscriber_detection=True,
                )
            )
            self._handles.append(
                bus.session.declare_queryable(f"{bus.root}/ack/{self._service}/{stage}", self._answer(stage))
            )
            self._handles.append(
                bus.session.liveliness().declare_token(f"{bus.root}/listening/{self._service}/{stage}")
            )

    def _answer(self, stage: str) -> Callable[[Any], None]:
        def reply(query: Any) -> None:
            order = self._orders[stage]
            query.reply(query.key_expr, f"{self._service} {order.instance} {self._processed[stage]}")

        return reply

    def stop(self) -> None:
        """End the iteration before the stages have said their last."""
        self._stopping.set()

    def close(self) -> None:
        """Stop listening."""
        for handle in (*self._fifo, *self._handles):
            handle.undeclare()
        self._fifo, self._handles = [], []

    def __iter__(self) -> Iterator[Message | None]:
        while not self._stopping.is_set():
            idle = True
            for stage, fifo in zip(self._orders, self._fifo, strict=True):
                order = self._orders[stage]
                for _ in range(1024):
                    sample = fifo.try_recv()
                    if sample is None:
                        break
                    idle = False
                    yield from self._take(order, sample)
                missing = order.overdue()
                if missing:
                    self.missing += missing
                    yield self._tell(f"{missing} messages of stage {order.stage} never arrived", "error")
                    idle = False
                for message in order.ready():
                    idle = False
                    yield message
                    self._processed[stage] = message.sequence
            if all(order.final for order in self._orders.values()):
                return
            if idle:
                yield None
                time.sleep(0.002)

    def _take(self, order: _Order, sample: Any) -> Iterator[Message]:
        encoding, _, name = str(sample.encoding).partition(";")
        try:
            if encoding != _MSGPACK:
                raise ValueError(f"encoding {encoding!r}")
            message = decode(name, sample.payload.to_bytes())
        except ValueError as error:
            self.refused += 1
            if self.refused in (1, 10, 100, 1000):  # a flood of them must not become a flood of events
                yield self._tell(f"refused {self.refused} payloads on {sample.key_expr}: {error}", "error")
            return
        restarted = order.add(sample.attachment.to_string() if sample.attachment else "", message)
        if restarted:
            yield self._tell(restarted, "warning")

    def _tell(self, text: str, level: Any) -> Event:
        now = time.time_ns()
        return event(f"bus: {text}", level=level, source=self._service, t=now, t_rx=now)


def publish(bus: Bus, stage: str, messages: Iterable[Message]) -> bool:
    """Put all a stage says on the bus.

    If making the messages fails, consumers are told why and that nothing more will come, and the error goes on.

    Returns
    -------
    bool
        Whether every consumer has processed all of it.
    """
    publisher = bus.publisher(stage)
    try:
        for message in messages:
            publisher.put(message)
    except BaseException as error:
        now = time.time_ns()
        publisher.put(event(f"stage {stage} failed: {error}", level="error", source=stage, t=now, t_rx=now))
        times = np.array([now], np.int64)
        publisher.put(Progress(vehicle=0, source=stage, boot=0, t=times, t_rx=times, final=True))
        raise
    return publisher.finish()


def serve(
    bus: Bus, stage: str, inputs: Sequence[str], function: Callable[[Iterable[Message]], Iterable[Message]]
) -> bool:
    """Run a stage on the bus until its inputs have said their last.

    Parameters
    ----------
    bus : Bus
    stage : str
        Its name.
    inputs : sequence of str
        The stages it listens to.
    function : callable
        The stage itself: messages in, messages out.

    Returns
    -------
    bool
        As `publish`.
    """
    subscription = bus.subscribe(stage, inputs)
    try:
        return publish(bus, stage, function(m for m in subscription if m is not None))
    finally:
        subscription.close()
