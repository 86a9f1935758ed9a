"""STATUSTEXT, whole again, and the marks in it."""

from __future__ import annotations

import numpy as np

from telemetry.mavlink import Dialect
from telemetry.messages import Mark, StatusText
from telemetry.text import Texts
from tests.telemetry.test_frames import scan
from tests.telemetry.wire import Sender

DIALECT = Dialect()


def read(texts: Texts, *frames: bytes):
    found = scan(*frames)
    values = DIALECT.decode(found, 253, np.arange(len(found)))
    return texts.read(values, 10 * np.arange(len(found)), found.t_rx, 0)


def test_plain_texts_keep_their_severity():
    (said,) = read(Texts(1, "0/1"), Sender().text("EKF2 active", 4), Sender().text("x" * 50, 6))
    assert isinstance(said, StatusText)
    assert said.text == ["EKF2 active", "x" * 50]
    assert said.severity.tolist() == [4, 6]


def test_chunks_are_joined_across_batches():
    texts, sender = Texts(1, "0/1"), Sender()
    assert read(texts, sender.text("a" * 50, id=7, chunk_seq=0)) == []
    (said,) = read(texts, sender.text("b" * 5, id=7, chunk_seq=1))
    assert said.text == ["a" * 50 + "b" * 5]


def test_a_text_whose_end_was_lost_is_told_when_the_next_begins():
    texts, sender = Texts(1, "0/1"), Sender()
    (said,) = read(texts, sender.text("a" * 50, id=7, chunk_seq=0), sender.text("next"))
    assert said.text == ["a" * 50, "next"]


def test_what_is_not_printable_is_replaced():
    (said,) = read(Texts(1, "0/1"), Sender().text("a\x1b[2Jb"))
    assert said.text == ["a\N{REPLACEMENT CHARACTER}[2Jb"]


def test_marks_begin_and_end_test_points():
    said = read(
        Texts(1, "0/1"), Sender().text("TP 12 start"), Sender().text("TP 12 stop"), Sender().text("TP 13 pause")
    )
    marks = [m for m in said if isinstance(m, Mark)]
    assert [(m.action[0], m.name[0], int(m.t[0])) for m in marks] == [("start", "12", 0), ("stop", "12", 10)]


def test_the_pattern_of_a_mark_can_be_set():
    texts = Texts(1, "0/1", r"^POINT (?P<action>start|stop): (?P<name>.+)$")
    said = read(texts, Sender().text("POINT start: phugoid 3"))
    assert said[1].name == ["phugoid 3"]
