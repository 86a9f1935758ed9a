"""Stages in one process: nothing changes its order, who fails is named and holds up nobody else, ages are told."""

from __future__ import annotations

import time

import numpy as np

from telemetry.chain import aged, also, expendable, unbroken
from telemetry.messages import Altitude, Event, Health, Progress


def height(i, t_rx=None):
    t = np.array([i], np.int64)
    t_rx = t if t_rx is None else np.array([t_rx], np.int64)
    return Altitude(
        vehicle=1, source="0/1", boot=0, t=t, t_rx=t_rx, altitude=1.0 * t, pressure=1.0 * t, sigma=1.0 * t
    )  # fmt: skip


def reached(i, final=False, source="ingest"):
    t = np.array([i], np.int64)
    return Progress(vehicle=0, source=source, boot=0, t=t, t_rx=t, final=final)


def sums(messages):
    total = 0
    for message in messages:
        if isinstance(message, Progress):
            yield height(1000 * total)
        else:
            total += int(message.t[0])
            if total == 6:
                raise ArithmeticError("six")


def places(messages):
    return [(type(message).__name__, int(message.t[0])) for message in messages]


def test_what_a_stage_makes_stands_behind_what_it_was_made_from():
    stream = [height(1), reached(1), height(7), reached(2), height(4)]
    assert places(also(iter(stream), sums)) == [
        ("Altitude", 1), ("Progress", 1), ("Altitude", 1000), ("Altitude", 7), ("Progress", 2), ("Altitude", 8000),
        ("Altitude", 4),
    ]  # fmt: skip


def test_a_stage_that_fails_says_so_and_what_it_was_given_goes_on():
    stream = [height(1), reached(1), height(5), reached(2), height(9), reached(3, final=True)]
    failures = []
    told = list(also(iter(stream), expendable("sums", sums, failures)))
    assert [type(error) for error in failures] == [ArithmeticError]
    (word,) = (message for message in told if isinstance(message, Event))
    assert (word.text, word.level, word.source) == (["stage sums failed: six"], ["error"], "sums")
    assert [m for m in told if m in stream] == stream
    assert [(m.t[0], m.final) for m in told if isinstance(m, Progress) and m.source == "sums"] == [
        (2, False),
        (3, True),
    ]


def test_a_source_that_fails_says_so_as_its_last_word():
    def stream():
        yield height(1)
        raise OSError

    failures = []
    first, last = unbroken("ingest", stream(), failures)
    assert first.t[0] == 1 and last.text == ["stage ingest failed: OSError"]
    assert isinstance(failures[0], OSError)


def test_what_takes_a_stage_too_long_is_told_each_second(monkeypatch):
    clock = [100.0]
    monkeypatch.setattr(time, "monotonic", lambda: clock[0])
    now = time.time_ns()

    def stream():
        for old in (0.0, 0.0, 0.0, 5.0, 5.0):
            yield height(1, now - round(old * 1e9))
            yield reached(1)
            clock[0] += 0.6

    told = list(aged(stream(), "record", "ingest", Altitude))
    health = [message for message in told if isinstance(message, Health)]
    assert [(m.source, m.stage, int(m.messages[0])) for m in health] == [
        ("record", "ingest", 3),
        ("record", "ingest", 5),
    ]
    assert health[0].age_max[0] < 1.0 < 4.9 < health[1].age_max[0]
    (alarm,) = (message for message in told if isinstance(message, Event))
    assert "data of stage ingest are 5.0 s old" in alarm.text[0] and alarm.level == ["error"]
