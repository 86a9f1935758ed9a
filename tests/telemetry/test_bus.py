"""Stages over real zenoh sessions: nothing out of order, nothing lost in silence."""

from __future__ import annotations

import socket
import subprocess
import sys
import threading
import time
from functools import partial
from itertools import pairwise
from pathlib import Path

import msgspec
import numpy as np
import pytest
import zenoh

from telemetry.bus import Bus, chunk, publish, serve
from telemetry.bus import subscription as subscription_module
from telemetry.messages import Altitude, Event, Health, Imu, Progress, event
from telemetry.wire import encode, schema


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


def heard(received: list, service: str = "record") -> list[int]:
    """Numbers of what the stages had to say."""
    return [m.sequence for m in list(received) if m.source != service]


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
    received = [m for m in received if m.source not in ("record", "estimate") or isinstance(m, Progress)]
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
    for received in (early, late):
        assert [m.sequence for m in received if m.source not in ("early", "late")] == list(range(401))


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
        assert heard(done, "slow") == list(range(201))
        thread.join()
        subscription.close()


def test_finish_says_when_a_consumer_does_not_follow():
    with Bus("s") as bus:
        subscription = bus.subscribe("stuck", ["ingest"])
        publisher = bus.publisher("ingest")
        publisher.put(next(stream(1)))
        assert not publisher.finish(deadline=0.5)
        another = bus.publisher("ingest")
        another.put(next(stream(1)))
        subscription.close()
        assert another.finish(deadline=5), "nobody listens any more"


def stranger(bus: Bus, numbers, *, instance: str = "0" * 24, stage: str = "ingest"):
    """A publisher that numbers as it likes and has no history."""
    token = bus.token("alive", stage, instance, "-")
    (final,) = stream(0)
    for number in numbers:
        message = msgspec.structs.replace(final if number == max(numbers) else event("x", t=0, t_rx=0), sequence=number)
        bus.session.put(
            f"{bus.root}/{stage}/0/{message.family}/{message.stream}",
            encode(message),
            encoding=zenoh.Encoding("application/msgpack").with_schema(schema(type(message))),
            attachment=f"{instance} {number}",
        )
    return token


def test_what_never_arrives_is_told(monkeypatch):
    monkeypatch.setattr(subscription_module, "PATIENCE", 0.2)
    received: list = []
    with Bus("s") as bus:
        subscription = bus.subscribe("record", ["ingest"])
        thread = threading.Thread(target=collect, args=(subscription, received))
        thread.start()
        wait_for(lambda: bus.tokens("listening/**"))
        token = bus.token("alive", "ingest", "0" * 24, "-")
        wait_for(lambda: subscription._inputs[0].run[0])
        token.undeclare()
        assert stranger(bus, [0, 1, 2, 3, 7, 9, 8])
        thread.join(30)
        assert not thread.is_alive()
    assert [m.sequence for m in received if m.source != "record"] == [0, 1, 2, 3, 7, 8, 9]
    assert "bus: 3 messages of stage ingest never arrived" in told(received)
    assert subscription.missing == 3


def test_a_late_joiner_hears_everything_from_the_beginning():
    """More than can wait anywhere in memory, and more than one answer of the history holds."""
    received: list = []
    with Bus("s") as bus:
        publisher = bus.publisher("ingest")
        *messages, last = stream(20_000)
        for message in messages:
            publisher.put(message)
        subscription = bus.subscribe("record", ["ingest"])
        thread = threading.Thread(target=collect, args=(subscription, received))
        thread.start()
        publisher.put(last)
        assert publisher.finish()
        thread.join(30)
    assert [m.sequence for m in received if m.source != "record"] == list(range(20_001))
    assert subscription.missing == 0
    assert subscription.backfilled >= 20_000


def test_what_the_history_has_let_go_is_told_to_a_late_joiner():
    received: list = []
    with Bus("s", history=200_000) as bus:
        publisher = bus.publisher("ingest")
        *messages, last = stream(3000)
        for message in messages:
            publisher.put(message)
        subscription = bus.subscribe("record", ["ingest"])
        thread = threading.Thread(target=collect, args=(subscription, received))
        thread.start()
        wait_for(lambda: any(m.source != "record" for m in received))
        publisher.put(last)
        thread.join(30)
    numbers = [m.sequence for m in received if m.source != "record"]
    assert numbers == list(range(numbers[0], 3001))
    assert 0 < numbers[0] == subscription.missing
    assert f"bus: {numbers[0]} messages of stage ingest never arrived" in told(received)


def test_a_consumer_that_does_not_keep_up_holds_up_who_publishes_and_loses_nothing():
    done = []
    with Bus("s") as bus:
        subscription = bus.subscribe("record", ["ingest"])
        publisher = bus.publisher("ingest")
        held = []

        def slowly():
            for message in subscription:
                if message is not None and message.source != "record":
                    done.append(message.sequence)
                    held.append(publisher.sequence - message.sequence)
                    if len(done) % 100 == 0:
                        time.sleep(0.005)

        thread = threading.Thread(target=slowly)
        thread.start()
        wait_for(lambda: len(bus.tokens("listening/**")) == 1)
        for message in stream(20_000):
            publisher.put(message)
        assert publisher.finish()
        thread.join(30)
        subscription.close()
    assert done == list(range(20_001))
    assert max(held) < 10_000, "it waits in the publisher, not in memory"


def test_who_has_fallen_behind_is_told_all_samples_and_at_last_how_far_they_reach():
    with Bus("s") as bus:
        publisher = bus.publisher("ingest")
        for message in stream(600):
            publisher.put(message)
            if not isinstance(message, Progress):
                far = Progress(vehicle=0, source="ingest", boot=0, t=message.t, t_rx=message.t_rx, final=False)
                publisher.put(far)
        subscription = bus.subscribe("record", ["ingest"])
        received = [m for m in subscription if m is not None and m.source != "record"]
        assert publisher.finish()
        subscription.close()
    samples = [int(m.t_rx[0]) for m in received if not isinstance(m, Progress)]
    reached = [m for m in received if isinstance(m, Progress)]
    assert samples == list(range(600))
    assert 0 < len(reached) < 60 and [m.final for m in reached] == [False] * (len(reached) - 1) + [True]
    for before, after in pairwise(received):
        if isinstance(before, Progress) and not before.final:
            assert after.t_rx[0] >= before.t_rx[0], "a progress covers what came before it, and no more"


def test_a_payload_that_is_no_message_is_refused_and_told():
    received: list = []
    with Bus("s") as bus:
        subscription = bus.subscribe("record", ["ingest"])
        imu = zenoh.Encoding("application/msgpack").with_schema("sortie.Imu.v1")
        bus.session.put("sortie/s/ingest/1/sensor/imu", b"rubbish")
        bus.session.put("sortie/s/ingest/1/sensor/imu", b"\x80", encoding=imu)
        publisher = bus.publisher("ingest")
        bus.session.put("sortie/s/ingest/1/sensor/imu", b"\x80", encoding=imu, attachment=f"{publisher.instance} 1")
        thread = threading.Thread(target=collect, args=(subscription, received))
        thread.start()
        wait_for(lambda: subscription._inputs[0].run[0])
        bus.session.put("sortie/s/ingest/1/sensor/imu", b"\x80", encoding=imu, attachment=f"{publisher.instance} 1")
        for message in stream(3):
            publisher.put(message)
        assert publisher.finish()
        thread.join(30)
    assert subscription.refused >= 3
    assert subscription.missing == 0, "the history has what was really said"
    assert [m.sequence for m in received if m.source != "record"] == [0, 1, 2, 3]
    assert "refused 1 payloads" in received[0].text[0]


def test_what_a_restarted_stage_says_begins_another_life():
    lives: list[list] = []
    ends = []
    with Bus("s") as bus:
        subscription = bus.subscribe("record", ["ingest"])

        def consume():
            for life in subscription.lives():
                lives.append([])
                collect_into = lives[-1]
                collect_into.extend(m for m in life if m is not None)
                ends.append((life.replaced, life.instances["ingest"]))
            subscription.close()

        thread = threading.Thread(target=consume)
        thread.start()
        first = bus.publisher("ingest")
        for message in list(stream(5))[:5]:
            first.put(message)
        wait_for(lambda: subscription._inputs[0].run[1].processed >= 3)
        second = bus.publisher("ingest")
        first.put(next(stream(1)))
        for message in stream(2):
            second.put(message)
        assert second.finish()
        thread.join(30)
    assert [m.sequence for m in lives[0]] == [0, 1, 2, 3, 4]
    assert told(lives[1]) == ["bus: stage ingest was restarted: everything is told again from its beginning"]
    assert [m.sequence for m in lives[1] if m.source != "record"] == [0, 1, 2]
    assert ends[0][0] == "stage ingest was restarted"
    assert ends[1] == (None, second.instance)
    assert subscription.missing == 0


def test_what_was_made_from_a_replaced_run_is_never_mixed_with_the_new_one():
    """The relay is slow to notice: what it still says of the old run is void for who has heard of the new one."""
    lives: list[list] = []
    with Bus("s") as bus:
        subscription = bus.subscribe("record", ["ingest", "estimate"])

        def consume():
            for life in subscription.lives():
                lives.append([])
                lives[-1].extend(m for m in life if m is not None and m.source != "record")
            subscription.close()

        thread = threading.Thread(target=consume)
        thread.start()
        old = bus.publisher("ingest")
        made_of_old = bus.publisher("estimate", {"ingest": old.instance})
        old.put(event("old", t=0, t_rx=0))
        made_of_old.put(event("of old", t=0, t_rx=0))
        wait_for(lambda: lives and len(lives[0]) == 2)
        new = bus.publisher("ingest")
        wait_for(lambda: subscription._inputs[0].run[0] == new.instance)
        made_of_old.put(event("of old", t=0, t_rx=0))
        (last,) = stream(0, "estimate")
        made_of_old.put(last)
        new.put(event("new", t=0, t_rx=0))
        made_of_new = bus.publisher("estimate", {"ingest": new.instance})
        made_of_new.put(event("of new", t=0, t_rx=0))
        made_of_new.put(last)
        (last,) = stream(0)
        new.put(last)
        assert new.finish()
        assert made_of_new.finish()
        thread.join(30)
        assert not thread.is_alive()
    assert sorted(m.text[0] for m in lives[0]) == ["of old", "old"]
    assert sorted(m.text[0] for m in lives[-1] if isinstance(m, Event)) == ["new", "of new"]


def test_a_stage_begins_anew_when_its_input_does():
    received: list = []
    begun = []
    with Bus("s") as bus:
        subscription = bus.subscribe("record", ["estimate"])

        def counting(messages):
            begun.append([])
            for message in messages:
                begun[-1].append(message.sequence)
                yield message

        threads = [
            threading.Thread(target=collect, args=(subscription, received)),
            threading.Thread(target=serve, args=(bus, "estimate", ["ingest"], counting)),
        ]
        for thread in threads:
            thread.start()
        first = bus.publisher("ingest")
        first.put(next(stream(1)))
        wait_for(lambda: begun and begun[-1] == [0])
        assert publish(bus, "ingest", stream(2))
        for thread in threads:
            thread.join(30)
            assert not thread.is_alive()
    assert [number for number in begun[-1] if number >= 0] == [0, 1, 2]
    assert received[-1].final
    again = [i for i, m in enumerate(received) if m.source == "record"][-1]
    assert [m.t[0] for m in received[again + 1 :] if m.source == "0/1"] == [0, 1]


def test_iterating_a_subscription_goes_on_through_its_lives():
    received: list = []
    with Bus("s") as bus:
        subscription = bus.subscribe("record", ["ingest"])
        thread = threading.Thread(target=collect, args=(subscription, received))
        thread.start()
        first = bus.publisher("ingest")
        first.put(next(stream(1)))
        wait_for(lambda: received)
        assert publish(bus, "ingest", stream(2))
        thread.join(30)
    assert [m.sequence for m in received if m.source != "record"] == [0, 0, 1, 2]
    assert told(received) == ["bus: stage ingest was restarted: everything is told again from its beginning"]


def test_the_health_of_a_consumer_is_told_to_who_asks(port):
    endpoint = f"tcp/127.0.0.1:{port}"
    recorded: list = []
    plain: list = []
    with Bus("s", listen=[endpoint]) as router, Bus("s", connect=[endpoint]) as client:
        recorder = router.subscribe("record", ["ingest", "estimate"], health=True)
        viewer = router.subscribe("viewer", ["estimate"])
        publisher = router.publisher("ingest")
        threads = [
            threading.Thread(target=collect, args=(recorder, recorded)),
            threading.Thread(target=collect, args=(viewer, plain)),
            threading.Thread(target=serve, args=(client, "estimate", ["ingest"], lambda messages: messages)),
        ]
        for thread in threads:
            thread.start()

        def said(ago: float, words: str) -> bool:
            t = np.array([time.time_ns() - round(ago * 1e9)])
            common = {"vehicle": 1, "source": "0/1", "boot": 0, "t": t, "t_rx": t}
            publisher.put(Altitude(**common, altitude=np.ones(1), pressure=np.ones(1), sigma=np.ones(1)))
            return any(words in text for text in told(recorded, "estimate"))

        for ago, words in (
            (90.0, "catching up with stage ingest: 90 s behind"),
            (0.0, "caught up with stage ingest"),
            (2.0, "data of stage ingest are 2.0 s old"),
            (0.0, "data of stage ingest are fresh again"),
        ):
            wait_for(partial(said, ago, words))
        for message in stream(0):
            publisher.put(message)
        assert publisher.finish()
        for thread in threads:
            thread.join(30)
            assert not thread.is_alive()
    health = [m for m in recorded if isinstance(m, Health)]
    assert {(m.source, m.stage) for m in health} == {
        ("record", "ingest"), ("record", "estimate"), ("estimate", "ingest")
    }  # fmt: skip
    assert not any(isinstance(m, Health) for m in plain)
    ages = [float(m.age_max[0]) for m in health if m.source == "estimate"]
    assert max(age for age in ages if np.isfinite(age)) >= 90
    for words in ("catching up", "caught up", "2.0 s old", "fresh again"):
        assert sum(words in text for text in told(recorded, "estimate")) == 1, "said once"


def test_a_consumer_that_was_killed_is_waited_for_at_the_end(port):
    """Who says goodbye is not."""
    endpoint = f"tcp/127.0.0.1:{port}"
    received: list = []
    with Bus("s", listen=[endpoint]) as router:
        publisher = router.publisher("ingest")
        for message in stream(3):
            publisher.put(message)
        killed = Bus("s", connect=[endpoint])
        unheard = killed.subscribe("record", ["ingest"])
        wait_for(lambda: router.tokens("listening/**"))
        killed.session.close()
        wait_for(lambda: not router.tokens("listening/**"))
        assert unheard.missing == 0
        assert not publisher._processed()
        with Bus("s", connect=[endpoint]) as client:
            thread = threading.Thread(target=collect, args=(client.subscribe("record", ["ingest"]), received))
            thread.start()
            assert publisher.finish()
            thread.join(30)
        another = router.publisher("estimate")
        another.put(next(stream(1)))
        leaving = router.subscribe("record", ["estimate"])
        leaving.close()
        assert another.finish(1.0)
    assert [m.sequence for m in received if m.source != "record"] == [0, 1, 2, 3]


def test_sessions_in_different_namespaces_do_not_hear_each_other(port):
    endpoint = f"tcp/127.0.0.1:{port}"
    live: list = []
    with (
        Bus("s", listen=[endpoint]) as router,
        Bus("s", connect=[endpoint], namespace="replay/7") as replay,
        Bus("s", connect=[endpoint], namespace="replay/7") as reader,
    ):
        subscription = router.subscribe("record", ["ingest"])
        thread = threading.Thread(target=collect, args=(subscription, live))
        thread.start()
        replayed: list = []
        other = threading.Thread(target=collect, args=(reader.subscribe("record", ["ingest"]), replayed))
        other.start()
        wait_for(lambda: reader.tokens("listening/**"))
        assert publish(replay, "ingest", stream(50))
        other.join(30)
        assert publish(router, "ingest", stream(3))
        thread.join(30)
    assert [m.sequence for m in replayed if m.source != "record"] == list(range(51))
    assert [m.sequence for m in live if m.source != "record"] == [0, 1, 2, 3]


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
    monkeypatch.setattr(subscription_module, "GRACE", 0.1)
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
            wait_for(lambda: heard(received) == list(range(30)))
            carrier.kill()
            wait_for(lambda: "bus: stage ingest is gone" in told(received))
            assert not bus.connected
            assert not bus.publisher("estimate").finish(deadline=0.2), "who listens cannot be known"
            carrier = carry()
            wait_for(lambda: heard(received) == 2 * list(range(30)))
            assert thread.is_alive()
            carrier.stdin.write("finish\n")
            carrier.stdin.flush()
            thread.join(30)
            assert carrier.wait(30) == 0
    finally:
        for carrier in carriers:
            carrier.kill()
            carrier.communicate()
    words = [text for text in told(received) if "catching up" not in text]
    assert words == [
        "bus: the link is lost",
        "bus: stage ingest is gone",
        "bus: the link is open again",
        "bus: stage ingest was restarted: everything is told again from its beginning",
    ]
    assert received[-1].final


def test_a_stage_is_gone_only_before_its_last_word(port, monkeypatch):
    monkeypatch.setattr(subscription_module, "GRACE", 0.1)
    endpoint = f"tcp/127.0.0.1:{port}"
    received: list = []
    with Bus("s", listen=[endpoint]) as router:
        subscription = router.subscribe("record", ["ingest", "estimate", "absent"])
        thread = threading.Thread(target=collect, args=(subscription, received))
        thread.start()
        with Bus("s", connect=[endpoint]) as client:
            assert publish(client, "ingest", stream(5))
            client.publisher("estimate").put(next(stream(1)))
            wait_for(lambda: len(heard(received)) == 7)
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
