"""Stages over real zenoh sessions: nothing out of order, nothing lost in silence."""

from __future__ import annotations

import socket
import subprocess
import sys
import threading
import time
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import msgspec
import numpy as np
import pytest

from telemetry import bus as bus_module
from telemetry.bus import Bus, chunk, publish, serve
from telemetry.messages import Altitude, Event, Imu, Progress, event


def stream(n: int, source: str = "ingest"):
    """Messages of three kinds in turn, and a final word."""
    for i in range(n):
        t = np.array([i])
        common = {"vehicle": 1 + i % 2, "source": "0/1", "boot": 0, "t": t, "t_rx": t}
        yield (
            Altitude(**common, altitude=np.ones(1), pressure=np.ones(1), sigma=np.ones(1)),
            Imu(**common, specific_force=np.zeros((1, 3)), angular_rate=np.zeros((1, 3))),
            event("something", t=i, t_rx=i),
        )[i % 3]
    yield Progress(vehicle=0, source=source, boot=0, t=np.array([n]), t_rx=np.array([n]), final=True)


def collect(subscription, into: list):
    into.extend(m for m in subscription if m is not None)
    subscription.close()


def told(received: list, service: str = "record") -> list[str]:
    """What the bus itself had to say."""
    return [text for m in received if isinstance(m, Event) and m.source == service for text in m.text]


def wait_for(condition) -> None:
    end = time.monotonic() + 20
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)


@pytest.fixture
def port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as sock:
        sock.bind(("127.0.0.1", 0))
        return sock.getsockname()[1]


def test_user_text_becomes_one_chunk_of_a_key():
    assert chunk("flight 7/*?#$") == "flight_7_____"
    assert chunk("") == "_"


@pytest.mark.parametrize("endpoint", ["tcp/0.0.0.0:7447", "tcp/10.0.0.1:7447", "udp/127.0.0.1:7447", "7447"])
def test_the_bus_stays_on_this_machine(endpoint):
    with pytest.raises(ValueError, match="is no loopback endpoint"):
        Bus("s", listen=[endpoint])


def test_a_busy_port_is_named(port):
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as other:
        other.bind(("127.0.0.1", port))
        other.listen()
        with pytest.raises(OSError, match=f"tcp/127.0.0.1:{port}: the port is in use"):
            Bus("s", listen=[f"tcp/127.0.0.1:{port}"])


def test_an_embedded_bus_carries_everything_in_order_through_a_stage():
    received: list = []
    with Bus("s") as bus:
        subscription = bus.subscribe("record", ["ingest", "estimate"])
        threads = [
            threading.Thread(target=collect, args=(subscription, received)),
            threading.Thread(target=serve, args=(bus, "estimate", ["ingest"], list)),
        ]
        for thread in threads:
            thread.start()
        assert publish(bus, "ingest", stream(3000))
        for thread in threads:
            thread.join(30)
    assert len(received) == 2 * 3001
    t = [int(m.t[0]) for m in received if isinstance(m, Altitude)]
    assert len(t) == 2000
    assert subscription.missing == subscription.refused == 0


def test_processes_meet_over_a_router_in_any_order_and_late(port):
    """A consumer waits long before there is anything to connect to; another comes in the middle."""
    endpoint = f"tcp/127.0.0.1:{port}"
    early, late = [], []

    def consume(name, into):
        with Bus("s", connect=[endpoint]) as client:
            collect(client.subscribe(name, ["ingest"]), into)

    first, second = (threading.Thread(target=consume, args=args) for args in (("early", early), ("late", late)))
    first.start()
    time.sleep(0.3)
    with Bus("s", listen=[endpoint]) as router:
        publisher = router.publisher("ingest")
        messages = list(stream(400))
        for message in messages[:300]:
            publisher.put(message)
        second.start()
        time.sleep(1.0)
        for message in messages[300:]:
            publisher.put(message)
        first.join(30)
        second.join(30)
        assert publisher.finish()
    assert [m.sequence for m in early] == [m.sequence for m in late] == list(range(401))


def test_a_bus_that_nobody_carries_is_told(port):
    with pytest.raises(OSError, match=f"nobody carries the bus on tcp/127.0.0.1:{port}"):
        Bus("s", connect=[f"tcp/127.0.0.1:{port}"], wait=0.5)


def test_finish_waits_for_a_slow_consumer():
    with Bus("s") as bus:
        subscription = bus.subscribe("slow", ["ingest"])
        done = []

        def slowly():
            for message in subscription:
                if message is not None:
                    time.sleep(0.002)
                    done.append(message)

        thread = threading.Thread(target=slowly)
        thread.start()
        assert publish(bus, "ingest", stream(200))
        assert len(done) == 201
        thread.join()
        subscription.close()


def test_finish_says_when_a_consumer_does_not_follow():
    with Bus("s") as bus:
        subscription = bus.subscribe("stuck", ["ingest"])
        publisher = bus.publisher("ingest")
        publisher.put(next(stream(1)))
        assert not publisher.finish(deadline=0.5)
        subscription.close()
        assert publisher.finish(deadline=0.5), "nobody listens any more"


def test_what_never_arrives_is_told(monkeypatch):
    monkeypatch.setattr(bus_module, "PATIENCE", 0.2)
    received: list = []
    with Bus("s") as bus:
        subscription = bus.subscribe("record", ["ingest"])
        publisher = bus.publisher("ingest")
        messages = list(stream(10))
        for message in messages[:4]:
            publisher.put(message)
        publisher.sequence += 3  # as if three had been lost on the way
        for message in messages[7:]:
            publisher.put(message)
        collect(subscription, received)
    (told,) = [m for m in received if isinstance(m, Event) and m.source == "record"]
    assert told.text == ["bus: 3 messages of stage ingest never arrived"]
    assert subscription.missing == 3


def test_a_late_joiner_waits_once_for_what_no_cache_holds(monkeypatch):
    """The cache of a slow stream goes back further than that of a fast one, which leaves many gaps."""
    monkeypatch.setattr(bus_module, "PATIENCE", 0.5)
    monkeypatch.setattr(bus_module, "CACHE", 16)
    received: list = []
    with Bus("s") as bus:
        publisher = bus.publisher("ingest")
        *messages, last = stream(200)
        slow, fast = messages[0::6], messages[1::3]
        for i in range(200):
            publisher.put(slow[i // 10] if i % 10 == 0 else fast[i // 10])
        subscription = bus.subscribe("record", ["ingest"])
        thread = threading.Thread(target=collect, args=(subscription, received))
        begin = time.monotonic()
        thread.start()
        publisher.put(last)
        thread.join(30)
        took = time.monotonic() - begin
    numbers = [m.sequence for m in received if m.sequence >= 0]
    assert numbers == sorted(numbers)
    assert len(numbers) < 60
    assert numbers[-1] == 200
    gaps = sum(b - a > 1 for a, b in pairwise([-1, *numbers]))
    assert gaps > 5, "no gaps, no test"
    given_up = [int(text.split()[1]) for text in told(received)]
    assert sum(given_up) == subscription.missing == 201 - len(numbers)
    assert took < gaps * bus_module.PATIENCE, "not one wait per gap"


def test_a_message_that_still_comes_is_not_given_up(monkeypatch):
    """Only gaps before messages that have waited too long are given up, and a number that came twice counts once."""
    clock = SimpleNamespace(now=0.0, monotonic=lambda: clock.now)
    monkeypatch.setattr(bus_module, "time", clock)
    order = bus_module._Order("ingest")
    (message,) = stream(0)
    for clock.now, number in enumerate([3, 2, 3, 7, 9]):
        order.add("a", msgspec.structs.replace(message, sequence=number))
    clock.now = bus_module.PATIENCE + 3.5
    assert order.overdue() == 2 + 3
    assert [m.sequence for m in order.ready()] == [2, 3, 7]
    assert order.overdue() == 0
    order.add("a", msgspec.structs.replace(message, sequence=8))
    assert [m.sequence for m in order.ready()] == [8, 9]


def test_many_messages_can_wait():
    order = bus_module._Order("ingest")
    (message,) = stream(0)
    begin = time.monotonic()
    for number in range(30000, -1, -1):
        order.add("a", msgspec.structs.replace(message, sequence=number))
    assert sum(1 for _ in order.ready()) == 30001
    assert time.monotonic() - begin < 3


def test_a_payload_that_is_no_message_is_refused_and_told():
    received: list = []
    with Bus("s") as bus:
        subscription = bus.subscribe("record", ["ingest"])
        bus.session.put("sortie/s/ingest/1/sensor/imu", b"rubbish")
        bus.session.put(
            "sortie/s/ingest/1/sensor/imu",
            b"\x80",
            encoding=bus_module.zenoh.Encoding("application/msgpack").with_schema("sortie.Imu.v1"),
        )
        thread = threading.Thread(target=collect, args=(subscription, received))
        thread.start()
        publish(bus, "ingest", stream(3))
        thread.join(30)
    assert subscription.refused == 2
    assert [m.sequence for m in received if m.source != "record"] == [0, 1, 2, 3]
    assert "refused 1 payloads" in received[0].text[0]


def test_a_restarted_stage_is_told_apart():
    received: list = []
    with Bus("s") as bus:
        subscription = bus.subscribe("record", ["ingest"])
        thread = threading.Thread(target=collect, args=(subscription, received))
        thread.start()
        first = bus.publisher("ingest")
        first.put(next(stream(1)))
        time.sleep(0.2)
        publish(bus, "ingest", stream(2))
        thread.join(30)
    assert [m.text[0] for m in received if m.source == "record"] == ["bus: stage ingest was restarted"]
    assert [m.sequence for m in received if m.source != "record"] == [0, 0, 1, 2]


def test_what_waits_when_a_stage_is_restarted_is_told_as_lost():
    received: list = []
    with Bus("s") as bus:
        subscription = bus.subscribe("record", ["ingest"])
        thread = threading.Thread(target=collect, args=(subscription, received))
        thread.start()
        first = bus.publisher("ingest")
        first.put(next(stream(1)))
        first.sequence += 3
        first.put(next(stream(1)))
        wait_for(lambda: subscription._orders["ingest"].waiting)
        publish(bus, "ingest", stream(2))
        thread.join(30)
    assert told(received) == ["bus: stage ingest was restarted; 4 messages of before are lost"]
    assert subscription.missing == 4
    assert [m.sequence for m in received if m.source != "record"] == [0, 0, 1, 2]


ROOT = Path(__file__).parents[2]
CARRIER = """
import os, sys, time
from telemetry.bus import Bus
from tests.telemetry.test_bus import stream

*messages, last = stream(30)
bus = Bus("s", listen=[sys.argv[1]])
publisher = bus.publisher("ingest")
for message in messages:
    publisher.put(message)
if sys.stdin.readline():
    publisher.put(last)
    publisher.finish()
os._exit(0)
"""


def test_a_consumer_outlives_the_process_that_carries_the_bus(port, monkeypatch):
    monkeypatch.setattr(bus_module, "GRACE", 0.1)
    endpoint = f"tcp/127.0.0.1:{port}"
    received: list = []
    carriers = []

    def carry():
        command = [sys.executable, "-c", CARRIER, endpoint]
        carriers.append(subprocess.Popen(command, stdin=subprocess.PIPE, text=True, cwd=ROOT))
        return carriers[-1]

    try:
        carrier = carry()
        with Bus("s", connect=[endpoint]) as bus:
            thread = threading.Thread(target=collect, args=(bus.subscribe("record", ["ingest"]), received))
            thread.start()
            wait_for(lambda: len(received) == 30)
            carrier.kill()
            wait_for(lambda: len(received) == 31)
            assert not bus.connected
            assert not bus.publisher("estimate").finish(deadline=0.2), "who listens cannot be known"
            carrier = carry()
            wait_for(lambda: len(received) == 30 + 1 + 2 + 30)
            assert thread.is_alive()
            carrier.stdin.write("finish\n")
            carrier.stdin.flush()
            thread.join(30)
            assert carrier.wait(30) == 0
    finally:
        for carrier in carriers:
            carrier.kill()
            carrier.communicate()
    first, *others = told(received)
    assert first == "bus: stage ingest is gone"
    assert sorted(others) == ["bus: stage ingest is back", "bus: stage ingest was restarted"]
    assert received[-1].final


def test_a_stage_is_gone_only_before_its_last_word(port, monkeypatch):
    monkeypatch.setattr(bus_module, "GRACE", 0.1)
    endpoint = f"tcp/127.0.0.1:{port}"
    received: list = []
    with Bus("s", listen=[endpoint]) as router:
        subscription = router.subscribe("record", ["ingest", "estimate", "absent"])
        thread = threading.Thread(target=collect, args=(subscription, received))
        thread.start()
        with Bus("s", connect=[endpoint]) as client:
            assert publish(client, "ingest", stream(5))
            client.publisher("estimate").put(next(stream(1)))
            wait_for(lambda: len(received) == 7)
        wait_for(lambda: told(received))
        time.sleep(0.5)
        subscription.stop()
        thread.join(30)
    assert told(received) == ["bus: stage estimate is gone"]


def test_who_carries_the_bus_can_leave_last(port):
    endpoint = f"tcp/127.0.0.1:{port}"
    with Bus("s", listen=[endpoint]) as router, Bus("s", connect=[endpoint]) as client:
        own = router.publisher("ingest"), router.subscribe("watch", ["estimate"])
        publisher = client.publisher("estimate")
        subscription = client.subscribe("record", ["ingest"])
        wait_for(lambda: len(router.tokens("alive/**")) == len(router.tokens("listening/**")) == 2)
        assert not router.linger(0.2)
        subscription.close()
        wait_for(lambda: len(router.tokens("listening/**")) == 1)
        assert not router.linger(0.2), "it may still have something to say"
        assert publisher.finish()
        assert router.linger(5)
        assert own


def test_a_stage_that_fails_says_so_and_ends():
    received: list = []
    with Bus("s") as bus:
        subscription = bus.subscribe("record", ["ingest"])
        thread = threading.Thread(target=collect, args=(subscription, received))
        thread.start()

        def failing():
            yield next(stream(1))
            raise RuntimeError("the estimator broke")

        with pytest.raises(RuntimeError):
            publish(bus, "ingest", failing())
        thread.join(30)
    assert "stage ingest failed: the estimator broke" in received[1].text[0]
    assert received[-1].final


@pytest.mark.parametrize(("error", "expected"), [(RuntimeError(), "RuntimeError"), (KeyboardInterrupt(), None)])
def test_a_stage_that_is_interrupted_ends_too(error, expected):
    received: list = []
    with Bus("s") as bus:
        thread = threading.Thread(target=collect, args=(bus.subscribe("record", ["ingest"]), received))
        thread.start()

        def failing():
            yield next(stream(1))
            raise error

        with pytest.raises(type(error)):
            publish(bus, "ingest", failing())
        thread.join(30)
    assert told(received, "ingest") == ([f"stage ingest failed: {expected}"] if expected else [])
    assert received[-1].final
