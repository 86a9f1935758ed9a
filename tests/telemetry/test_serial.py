"""A serial line, made of a real pseudo-terminal."""

from __future__ import annotations

import pytest

from telemetry.archive import RawLog
from telemetry.sources.receiver import Receiver
from tests.telemetry.receiving import DIALECT, Listening, Pty, evidence, replay, until
from tests.telemetry.wire import Sender


@pytest.fixture
def line():
    line = Pty()
    yield line
    line.unplug()


def test_what_comes_over_the_line_is_archived_and_handed_out(line, tmp_path):
    sender = Sender()
    sent = [sender.attitude(i) for i in range(200)]
    with Listening(f"serial:{line.device}", raw_log=RawLog(tmp_path / "raw.tlog")) as source:
        line.write(b"\xfd noise" + b"".join(sent))
        until(lambda: len(source.got) == 200)
    assert source.got == sent
    assert source.bytes_in == len(b"".join(sent)) + 7
    assert evidence(replay(tmp_path / "raw.tlog", 1)) == evidence(source.all())


def test_a_silent_line_is_not_a_lost_one(line):
    with Listening(f"serial:{line.device}:115200") as source:
        line.write(Sender().attitude(1))
        until(lambda: len(source.got) == 1)
        line.write(Sender().attitude(2))
        until(lambda: len(source.got) == 2)
    assert not source.troubles
    assert not source.hear()


def test_a_device_that_vanishes_is_opened_again_when_it_is_back(tmp_path):
    name = tmp_path / "by-id"
    first = Pty()
    name.symlink_to(first.device)
    with Listening(f"serial:{name}") as source:
        first.write(Sender().attitude(1) + Sender(seq=1).attitude(2)[:9])
        until(lambda: len(source.got) == 1)
        name.unlink()
        first.unplug()
        until(lambda: f"link 0: serial:{name}:57600: lost" in source.hear())
        until(lambda: any("No such file" in text for text in source.troubles))
        second = Pty()
        name.symlink_to(second.device)
        until(lambda: "it is back" in source.hear())
        second.write(Sender(seq=2).attitude(3))
        until(lambda: len(source.got) == 2)
    second.unplug()
    assert source.all().junk(0) == Sender(seq=1).attitude(2)[:9]


def test_a_device_that_is_not_there_at_the_start_is_named(tmp_path):
    with pytest.raises(OSError, match=f"serial:{tmp_path}/none:57600: No such file or directory"):
        Receiver([f"serial:{tmp_path}/none"], DIALECT)


def test_a_device_that_another_program_has_is_not_shared(line):
    with Listening(f"serial:{line.device}"), pytest.raises(OSError, match=line.device):
        Receiver([f"serial:{line.device}"], DIALECT)
