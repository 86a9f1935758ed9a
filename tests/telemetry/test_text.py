"""STATUSTEXT, whole again, and the marks in it."""

from __future__ import annotations

import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from telemetry.mavlink import Dialect
from telemetry.messages import Mark, StatusText
from telemetry.text import PATIENCE, GroundMark, Texts, check_mark, ground_mark, ground_text
from tests.telemetry.test_frames import scan
from tests.telemetry.wire import Sender

DIALECT = Dialect()


def read(texts: Texts, *frames: bytes, link: int = 0, t_rx: int = 0):
    found = scan(*frames)
    values = DIALECT.decode(found, 253, np.arange(len(found)))
    links = np.full(len(found), link, np.uint8)
    return texts.read(values, found.seq, links, 10 * np.arange(len(found)), found.t_rx + t_rx, 0)


def said(messages) -> list[str]:
    return [text for m in messages if isinstance(m, StatusText) for text in m.text]


def test_plain_texts_keep_their_severity():
    sender = Sender()
    told = read(Texts(1, "0/1"), sender.text("EKF2 active", 4), sender.text("x" * 50, 6))
    assert said(told) == ["EKF2 active", "x" * 50]
    assert [int(m.severity[0]) for m in told] == [4, 6]


def test_chunks_are_joined_across_batches():
    texts, sender = Texts(1, "0/1"), Sender()
    assert read(texts, sender.text("a" * 50, id=7, chunk_seq=0)) == []
    assert said(read(texts, sender.text("b" * 5, id=7, chunk_seq=1))) == ["a" * 50 + "b" * 5]


def test_a_short_text_in_between_does_not_tear_a_long_one():
    texts, sender = Texts(1, "0/1"), Sender()
    frames = [sender.text("a" * 50, id=7), sender.text("short"), sender.text("b", id=7, chunk_seq=1)]
    assert said(read(texts, *frames)) == ["short", "a" * 50 + "b"]


def test_a_text_whose_end_was_lost_is_told_when_another_long_one_begins():
    texts, sender = Texts(1, "0/1"), Sender()
    assert said(read(texts, sender.text("a" * 50, id=7), sender.text("next", id=8))) == ["a" * 50, "next"]


@pytest.mark.parametrize("late", [0, 1])
def test_a_text_that_fills_its_last_chunk_is_told_after_a_while_whatever_comes(late):
    texts, sender = Texts(1, "0/1"), Sender()
    begun = read(texts, sender.text("a" * 50, id=7))
    assert begun == []
    deadline = 1_000_000 + PATIENCE
    assert texts.expire(deadline - 1) == []
    told = texts.expire(deadline + 5) if late else read(texts, sender.text("b", id=7, chunk_seq=1), t_rx=deadline)
    assert said(told)[0] == "a" * 50
    assert told[0].t_rx[0] == deadline, "the same however it is found out"


def test_at_the_end_what_waits_is_told():
    texts = Texts(1, "0/1")
    read(texts, Sender().text("a" * 50, id=7))
    assert said(texts.expire(0, final=True)) == ["a" * 50]


def test_a_text_heard_over_two_links_is_told_once():
    texts, frame = Texts(1, "0/1"), Sender().text("TP 1 start")
    assert len(read(texts, frame)) == 2
    assert read(texts, frame, link=1, t_rx=1_500_000_000) == []
    assert read(texts, frame, t_rx=1_900_000_000, link=1) == []


def test_a_text_said_again_is_told_again():
    texts, sender = Texts(1, "0/1"), Sender()
    assert said(read(texts, sender.text("PreArm: no fix"), sender.text("PreArm: no fix"))) == ["PreArm: no fix"] * 2


def test_what_is_not_printable_is_replaced():
    assert said(read(Texts(1, "0/1"), Sender().text("a\x1b[2Jb"))) == ["a\N{REPLACEMENT CHARACTER}[2Jb"]


def test_marks_begin_and_end_test_points():
    sender = Sender()
    texts = [sender.text(text) for text in ("TP 12 start", "TP 12 stop", "TP 13 pause")]
    marks = [m for m in read(Texts(1, "0/1"), *texts) if isinstance(m, Mark)]
    assert [(m.action[0], m.name[0], int(m.t[0])) for m in marks] == [("start", "12", 0), ("stop", "12", 10)]


def test_the_pattern_of_a_mark_can_be_set():
    texts = Texts(1, "0/1", r"^POINT (?P<action>start|stop): (?P<name>.+)$")
    assert read(texts, Sender().text("POINT start: phugoid 3"))[1].name == ["phugoid 3"]


def test_a_pattern_may_ignore_case_and_a_text_without_both_groups_is_no_mark():
    texts, sender = Texts(1, "0/1", r"(?i)^TP( (?P<name>\w+))? (?P<action>start|stop|hold)$"), Sender()
    told = read(texts, *(sender.text(text) for text in ("tp 1 START", "tp 1 Stop", "tp 1 hold", "tp stop")))
    assert [(m.action, m.name) for m in told if isinstance(m, Mark)] == [(["start"], ["1"]), (["stop"], ["1"])]


@given(
    st.sampled_from(["start", "stop"]),
    st.text("aB1 @._-é", min_size=1, max_size=12).map(str.strip).filter(bool),
    st.integers(0, 255),
    st.sampled_from([r"^POINT (?P<name>\d+) (?P<action>start|stop)$", r"(?P<name>.*) (?P<action>start|stop)"]),
)
def test_what_is_said_on_the_ground_is_understood_whatever_the_pattern(action, name, vehicle, pattern):
    assert ground_mark(ground_text(action, name, vehicle), pattern) == GroundMark(action, name, vehicle)


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("TP 12 start", GroundMark("start", "12", 0)),
        ("TP 12 stop @7", GroundMark("stop", "12", 7)),
        ("TP two words start", None),
        ("TP 12 pause @7", None),
        ("hello @7", None),
        ("TP 12 start @1234", None),
        ("", None),
    ],
)
def test_a_ground_station_may_use_the_words_of_a_vehicle_and_name_one(text, found):
    assert ground_mark(text) == found


def test_a_ground_station_may_use_the_pattern_that_is_set_and_name_a_vehicle():
    pattern = r"^POINT (?P<action>start|stop): (?P<name>.+)$"
    assert ground_mark("POINT start: phugoid 3 @2", pattern) == GroundMark("start", "phugoid 3", 2)


@pytest.mark.parametrize(
    ("name", "vehicle", "words"),
    [
        ("x" * 50, 0, "has 12 more; choose a shorter name"),
        ("", 0, "a name is printable"),
        (" 1", 0, "a name is printable"),
        ("a\nb", 0, "a name is printable"),
        ("1", 256, "a MAVLink system is 1 to 255"),
    ],
)
def test_what_cannot_be_said_from_the_ground_is_refused(name, vehicle, words):
    with pytest.raises(ValueError, match=re.escape(words)):
        ground_text("start", name, vehicle)


@pytest.mark.parametrize(
    ("pattern", "words"), [(r"^TP (\S+) (start|stop)$", "needs the groups"), ("(", "is no regular expression")]
)
def test_a_pattern_that_cannot_work_is_refused(pattern, words):
    with pytest.raises(ValueError, match=words):
        check_mark(pattern)
