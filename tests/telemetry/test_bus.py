"""Stages over real zenoh sessions: nothing out of order, nothing lost in silence."""

from __future__ import annotations

import socket
import threading
import time

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
