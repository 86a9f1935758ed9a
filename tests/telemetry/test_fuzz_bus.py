"""Payloads from a hostile network: refused and counted, never an exception, never more memory than is allowed.

``SORTIE_FUZZ=1000000`` tries as many inputs by hand.
"""

from __future__ import annotations

import os
import random
import threading
import tracemalloc
from collections.abc import Iterator

import msgspec
import numpy as np
import pytest
import zenoh

from telemetry.bus import Bus
from telemetry.bus import feed as feed_module
from telemetry.bus.ancestry import Ancestry, read_lineage
from telemetry.bus.feed import WINDOW, Answer, Feed, Payload
from telemetry.bus.spool import Spool, records
from telemetry.messages import KINDS, Message
from telemetry.wire import decode, encode, schema
from tests.telemetry.test_bus import collect, heard, stream, wait_for

TRIES = int(os.environ.get("SORTIE_FUZZ", "3000"))


def seeds() -> list[tuple[str, bytes]]:
    return [(schema(type(m)), encode(msgspec.structs.replace(m, sequence=i))) for i, m in enumerate(stream(5))]


def garbage(draw: random.Random) -> tuple[str, bytes]:
    """A schema and a payload: noise, or one of ours with something changed."""
    name, payload = draw.choice(SEEDS)
    data = bytearray(payload)
    match draw.randrange(8):
        case 0:
            data = bytearray(draw.randbytes(draw.randrange(200)))
        case 1:
            for _ in range(draw.randrange(1, 5)):
                data[draw.randrange(len(data))] = draw.randrange(256)
        case 2:
            del data[draw.randrange(len(data)) :]
        case 3:
            data += draw.randbytes(draw.randrange(1, 50))
        case 4:
            name = draw.choice(
                ["", "sortie.", "sortie.Imu.v2", "sortie.Nothing.v1", "x" * 1000, schema(draw.choice(ALL))]
            )
        case 5:  # lengths that promise gigabytes: array 32, map 32, bin 32, str 32
            at = draw.randrange(len(data))
            data[at:at] = bytes([draw.choice([0xDD, 0xDF, 0xC6, 0xDB])]) + b"\xff\xff\xff\xff"
        case 6:
            told = msgspec.msgpack.decode(payload)
            told["t"] = [draw.choice(DTYPES), draw.choice(SHAPES), bytes(draw.randrange(33))]
            data = bytearray(msgspec.msgpack.encode(told))
        case 7:
            told = msgspec.msgpack.decode(payload)
            told[draw.choice(list(told))] = draw.choice(VALUES)
            data = bytearray(msgspec.msgpack.encode(told))
    return name, bytes(data)


SEEDS = seeds()
ALL = list(KINDS.values())
NAMES = ["", "sortie.", "sortie.Imu.v2", "sortie.Nothing.v1", "x" * 1000]
DTYPES = ["<i8", "<f8", "|O8", ">i8", "<M8[ns]", ""]
VALUES = [None, -1, 2**63, 2**64 - 1, 1e308, "x", b"x", [], {}, [[]] * 3, b"\xed\xa0\x80"]
SHAPES = [[], [0], [-1], [1, -8], [2**40], [2**31, 2**31], [2**63], [1, 1, 1], [4], [2**62, 4], "x", [1.5]]


def whole(message: object) -> bool:
    """Whether something is a message whose columns agree."""
    if not isinstance(message, Message):
        return False
    arrays = [getattr(message, name) for name in message.__struct_fields__]
    return all(len(array) == len(message.t) > 0 for array in arrays if isinstance(array, np.ndarray))


def test_what_is_decoded_is_a_whole_message_or_refused():
    draw = random.Random(1)
    refused = 0
    for _ in range(TRIES):
        name, data = garbage(draw)
        try:
            assert whole(decode(name, data))
        except ValueError:
            refused += 1
    assert TRIES * 0.5 < refused < TRIES, "both happen"


def hostile(draw: random.Random) -> Iterator[tuple[int, Payload]]:
    number = draw.choice([0, 1, 2, 5, 100, WINDOW - 1, WINDOW, WINDOW + 1, 2**31, 2**60, 10**18])
    yield number + draw.randrange(3), Payload(*garbage(draw))


def test_a_feed_survives_whatever_comes_and_its_counters_add_up():
    """What is handed on, given up and refused is every number up to the next one."""
    draw = random.Random(2)
    feed = Feed("ingest", patience=0.0)
    handed = 0
    for i in range(TRIES):
        for number, payload in hostile(draw):
            feed.add(feed.next + number if draw.random() < 0.5 else number, payload)
        if draw.random() < 0.05:
            first = draw.choice([feed.next, feed.next, 0, -1, feed.next + 3, 2**60])
            length = draw.choice([0, 1, 2, -1, 2**60])
            total = draw.choice([first + length, first + 5, 0, 2**62])
            spool = Spool(1 << 20)
            for _ in range(draw.randrange(3)):
                name, record = draw.choice([garbage(draw), draw.choice(SEEDS)])
                spool.add(name[:200], record)
            data = bytearray(spool.read(0, 3, 1 << 20).data)
            spool.close()
            if data and draw.random() < 0.3:
                data[draw.randrange(len(data))] ^= 1 << draw.randrange(8)
            feed.answer(Answer(first, length, total, bytes(data)))
        if draw.random() < 0.05:
            feed.unanswered(connected=draw.random() < 0.9)
        feed.wants()
        for message in feed.ready(4):
            assert whole(message)
            handed += 1
            feed.final = False
        assert feed.held <= WINDOW + 1
        assert handed + feed.missing == feed.next, i
        feed.findings.clear()
    assert feed.refused > 0


def test_absurd_numbers_neither_fill_memory_nor_count_as_loss():
    feed = Feed("ingest", patience=1e9)
    payload = Payload(*SEEDS[0])
    tracemalloc.start()
    begin, _ = tracemalloc.get_traced_memory()
    for i in range(50_000):
        feed.add(2**60 + i, payload)
        feed.add(feed.next + 1 + i, payload)
    end, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert feed.held <= WINDOW
    assert end - begin < 5e6
    feed.answer(Answer(0, 0, 0, b""))
    assert list(feed.ready(10)) == []
    assert feed.missing == 0, "whoever said it is not believed"


def test_the_bytes_that_wait_are_bounded_too(monkeypatch):
    monkeypatch.setattr(feed_module, "WINDOW_BYTES", 100_000)
    feed = Feed("ingest", patience=1e9)
    for i in range(1, 100):
        feed.add(i, Payload("sortie.Imu.v1", bytes(10_000)))
    assert feed.held == 10
    feed.add(0, Payload(*SEEDS[0]))
    assert [m.sequence for m in feed.ready(1)] == [0], "what is next is always taken"


def test_history_from_a_stranger_is_read_or_refused():
    draw = random.Random(3)
    for _ in range(TRIES):
        data = draw.randbytes(draw.randrange(60))
        if draw.random() < 0.5:
            data = len(data).to_bytes(4, "little") + data
        try:
            assert sum(len(a) + len(b) for a, b in records(data)) <= 2 * len(data)
        except ValueError:
            pass


def test_tokens_of_strangers_are_ignored():
    draw = random.Random(4)
    ancestry = Ancestry(["ingest", "estimate"])
    pieces = ["", "-", "=", "+", "ingest", "0" * 24, "f" * 24, "F" * 24, "g" * 24, "ingest=" + "0" * 24, "x" * 500]
    for _ in range(TRIES):
        instance = draw.choice([*pieces, f"{draw.randrange(2**96):024x}"])
        ancestry.appear(draw.choice(["ingest", "estimate", "other", ""]), instance, "".join(draw.choices(pieces, k=3)))
        if draw.random() < 0.1:
            ancestry.adopt(ancestry.choose())
    assert all(len(found) <= 256 for found in (*ancestry._alive.values(), *ancestry._void.values()))
    assert set(ancestry.current) == {"ingest", "estimate"}
    with pytest.raises(ValueError, match="lineage"):
        read_lineage("ingest=xyz")


def test_a_subscription_hears_the_stage_among_garbage():
    """On a bus without certificates anybody may say anything under any key, with any number and any answer."""
    draw = random.Random(5)
    received: list = []
    tries = min(TRIES, 20_000)
    with Bus("s") as bus:
        subscription = bus.subscribe("record", ["ingest"])
        thread = threading.Thread(target=collect, args=(subscription, received))
        thread.start()
        publisher = bus.publisher("ingest")
        wait_for(lambda: subscription._inputs[0].run[0])
        answers = ["", " ", f"{publisher.instance} 99999999999", f"{publisher.instance} x", "a b c", f"{'f' * 24} 3"]

        def forge(query) -> None:
            with query:
                query.reply("sortie/s/ack/forger/ingest", draw.choice(answers))

        forged = bus.session.declare_queryable("sortie/s/ack/forger/ingest", forge)
        token = bus.token("listening", "forger", "ingest")
        *messages, last = stream(300)
        for i in range(tries):
            name, data = garbage(draw)
            number = draw.choice([0, publisher.sequence + 1, 2**60, -1, "x", "", "9" * 5000, WINDOW])
            instance = draw.choice([publisher.instance, "f" * 24, "", "\u20ac"])
            bus.session.put(
                "sortie/s/ingest/1/sensor/imu",
                data,
                encoding=zenoh.Encoding(draw.choice(["application/msgpack", "text/plain"])).with_schema(name),
                attachment=draw.choice([f"{instance} {number}", b"\xff\xfe", None]),
                congestion_control=zenoh.CongestionControl.BLOCK,
            )
            if i % (tries // 300) == 0 and messages:
                publisher.put(messages.pop(0))
        for message in (*messages, last):
            publisher.put(message)
        wait_for(lambda: not thread.is_alive())
        assert not publisher._processed(), "a forged acknowledgement of the future is none"
        forged.undeclare()
        token.undeclare()
        publisher.abandon()
    assert subscription.refused > 0
    numbers = heard(received)
    assert numbers == list(range(numbers[-1] + 1))
    assert subscription.missing == 0
