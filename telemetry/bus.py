"""The bus: stages hand messages to one another over zenoh, inside one process or between several.

Keys are ``sortie/{sortie}/{stage}/{vehicle}/{family}/{stream}``: who speaks first, so that a consumer subscribes to a
stage, and an access list can tie a stage to a certificate. Nothing is scouted, and nothing listens unless it is
named.

A stage numbers its output (`Message.sequence`) without gaps over all its streams. A consumer puts the streams
together again in that order, whatever the network did to them; what does not come within `PATIENCE` is reported as
missing, never skipped in silence. Publishers block rather than drop, keep a cache for late joiners, and at the end
wait until every consumer has processed the last message, because closing a session does not drain it.

Who is there is told by liveliness tokens, which vanish with their process: ``alive/{session}/{stage}/{instance}`` of
a publisher, ``listening/{session}/{service}/{stage}`` of a subscription.
"""

from __future__ import annotations

import heapq
import json
import re
import secrets
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import msgspec
import numpy as np
import zenoh
import zenoh.ext

from telemetry.messages import Event, Message, Progress, event
from telemetry.wire import decode, encode, schema

PATIENCE = 5.0
DRAIN = 30.0
GRACE = 1.0
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
        self._client = bool(connect) and not listen
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

    @property
    def connected(self) -> bool:
        """False while a client has lost its router."""
        return not self._client or bool(self.session.info.routers_zid())

    def token(self, kind: str, *chunks: str) -> Any:
        """Show that something is there, until the token is undeclared or the process is gone."""
        return self.session.liveliness().declare_token(
            "/".join((self.root, kind, str(self.session.info.zid()), *chunks))
        )

    def tokens(self, pattern: str) -> list[list[str]]:
        """Who is there: kind, session and what follows."""
        replies = self.session.liveliness().get(f"{self.root}/{pattern}", timeout=1.0)
        return [str(reply.ok.key_expr).removeprefix(f"{self.root}/").split("/") for reply in replies if reply.ok]

    def linger(self, deadline: float = DRAIN) -> bool:
        """Wait until no other session publishes or listens any more, so that whoever carries the bus leaves last.

        Returns
        -------
        bool
            False when one still did after `deadline` seconds.
        """
        end = time.monotonic() + deadline
        own = str(self.session.info.zid())
        while any(session != own for kind in ("alive", "listening") for _, session, *_ in self.tokens(f"{kind}/**")):
            if time.monotonic() > end:
                return False
            time.sleep(0.05)
        return True

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
        self._alive = bus.token("alive", chunk(stage), self._instance)

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
        """Wait until every consumer has processed the last message; the stage then no longer counts as there.

        Returns
        -------
        bool
            False when one had not within `deadline` seconds, or nobody can tell because the router is gone.
        """
        end = time.monotonic() + deadline
        while not (done := self._bus.connected and self._processed()) and time.monotonic() < end:
            time.sleep(0.02)
        if self._alive is not None:
            self._alive.undeclare()
            self._alive = None
        return done

    def _processed(self) -> bool:
        stage = chunk(self._stage)
        listening = [service for _, _, service, _ in self._bus.tokens(f"listening/*/*/{stage}")]
        done = {}
        for reply in self._bus.session.get(f"{self._bus.root}/ack/*/{stage}", timeout=1.0):
            if reply.ok:
                service, instance, processed = reply.ok.payload.to_string().split(" ")
                done[service] = int(processed) if instance == self._instance else -1
        return all(done.get(service, -1) >= self.sequence - 1 for service in listening)


class _Order:
    """Puts the messages of one stage in the order of their numbers."""

    def __init__(self, stage: str) -> None:
        self.stage = stage
        self.instance = ""
        self.next = 0
        self.processed = -1
        self.final = False
        self.waiting: dict[int, tuple[float, Message]] = {}  # when each came, oldest first
        self._numbers: list[int] = []  # those that wait, as a heap
        self._given_up = -1  # no gap below this number is waited for

    def add(self, instance: str, message: Message) -> int | None:
        """Take a message in; if the stage turned out to have been restarted, how many of its messages are lost."""
        lost = None
        if instance != self.instance:
            if self.instance:
                lost = max(self.waiting, default=self.next - 1) + 1 - self.next
            self.processed = -1  # before the instance, for whoever is asked meanwhile
            self.instance, self.next, self._given_up = instance, 0, -1
            self.waiting, self._numbers = {}, []
        number = message.sequence
        if number >= self.next and number not in self.waiting:
            self.waiting[number] = time.monotonic(), message
            heapq.heappush(self._numbers, number)
        return lost

    def ready(self) -> Iterator[Message]:
        while self._numbers and self._numbers[0] <= max(self.next, self._given_up):
            number = heapq.heappop(self._numbers)
            _, message = self.waiting.pop(number)
            self.next = number + 1
            self.final = self.final or (isinstance(message, Progress) and message.final)
            yield message

    def overdue(self) -> int:
        """Give up, all at once, what messages have waited for too long for; the answer is how many."""
        limit = time.monotonic() - PATIENCE
        last = -1
        for number, (came, _) in self.waiting.items():
            if came > limit:
                break
            last = max(last, number)
        if last < 0:
            return 0
        self._given_up = last
        return last + 1 - self.next - sum(number <= last for number in self.waiting)


class _Presence:
    """Whether a stage is there, by its tokens."""

    def __init__(self, tokens: Any) -> None:
        self.tokens = tokens
        self.gone = False
        self._alive: set[str] = set()
        self._left = float("inf")

    def changed(self) -> bool:
        """Whether the stage went, at least `GRACE` ago, or came back."""
        while (sample := self.tokens.try_recv()) is not None:
            if sample.kind == zenoh.SampleKind.PUT:
                self._alive.add(str(sample.key_expr))
            else:
                self._alive.discard(str(sample.key_expr))
                self._left = time.monotonic()
        gone = not self._alive and (self.gone or time.monotonic() - self._left > GRACE)
        changed, self.gone = gone != self.gone, gone
        return changed


class Subscription:
    """What some stages say, in their order; ends when each has said its last.

    An event tells when a stage goes before that, and when it is back: it may be restarted, so nothing ends.

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
        self._presences: list[_Presence] = []
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
            self._handles.append(bus.token("listening", self._service, stage))
            alive = bus.session.liveliness().declare_subscriber(
                f"{bus.root}/alive/*/{stage}/*", zenoh.handlers.FifoChannel(1024), history=True
            )
            self._handles.append(alive)
            self._presences.append(_Presence(alive))

    def _answer(self, stage: str) -> Callable[[Any], None]:
        def reply(query: Any) -> None:
            order = self._orders[stage]
            query.reply(query.key_expr, f"{self._service} {order.instance} {order.processed}")

        return reply

    def stop(self) -> None:
        """End the iteration before the stages have said their last."""
        self._stopping.set()

    def close(self) -> None:
        """Stop listening."""
        for handle in (*self._fifo, *self._handles):
            handle.undeclare()
        self._fifo, self._handles, self._presences = [], [], []

    def __iter__(self) -> Iterator[Message | None]:
        while not self._stopping.is_set():
            idle = True
            for order, fifo, presence in zip(self._orders.values(), self._fifo, self._presences, strict=True):
                drained = False
                for _ in range(1024):
                    sample = fifo.try_recv()
                    if sample is None:
                        drained = True
                        break
                    idle = False
                    yield from self._take(order, sample)
                # What is missing, or the last word, may still be in there after a long stall of the consumer.
                missing = order.overdue() if drained else 0
                if missing:
                    self.missing += missing
                    yield self._tell(f"{missing} messages of stage {order.stage} never arrived", "error")
                for message in order.ready():
                    idle = False
                    yield message
                    order.processed = message.sequence
                if drained and not order.waiting and not order.final and presence.changed():
                    state, level = ("gone", "warning") if presence.gone else ("back", "info")
                    yield self._tell(f"stage {order.stage} is {state}", level)
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
        lost = order.add(sample.attachment.to_string() if sample.attachment else "", message)
        if lost is not None:
            self.missing += lost
            text = f"stage {order.stage} was restarted"
            yield self._tell(f"{text}; {lost} messages of before are lost" if lost else text, "warning")

    def _tell(self, text: str, level: Any) -> Event:
        now = time.time_ns()
        return event(f"bus: {text}", level=level, source=self._service, t=now, t_rx=now)


def publish(bus: Bus, stage: str, messages: Iterable[Message]) -> bool:
    """Put all a stage says on the bus.

    If making the messages fails, consumers are told why and that nothing more will come, and the error goes on. An
    interruption is no failure, and ends the output too.

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
        if not isinstance(error, KeyboardInterrupt):
            text = f"stage {stage} failed: {str(error).strip() or type(error).__name__}"
            publisher.put(event(text, level="error", source=stage, t=now, t_rx=now))
        times = np.array([now], np.int64)
        publisher.put(Progress(vehicle=0, source=stage, boot=0, t=times, t_rx=times, final=True))
        publisher.finish(GRACE)
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
