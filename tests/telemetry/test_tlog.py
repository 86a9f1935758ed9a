"""Logs are told from other files, and read in blocks."""

from __future__ import annotations

import pytest

from telemetry.frames import write_junk, write_record
from telemetry.mavlink import Dialect
from telemetry.sources import tlog
from telemetry.sources.tlog import TlogSource
from tests.telemetry.wire import Sender

DIALECT = Dialect()
US = 1_700_000_000_000_000


@pytest.fixture(autouse=True)
def small_blocks(monkeypatch):
    monkeypatch.setattr(tlog, "BLOCK", 100)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "raw.tlog"


def frames() -> bytes:
    sender = Sender()
    return b"".join(write_record(US + 1000 * i, sender.attitude(i)) for i in range(10))


def test_a_log_is_read_to_its_end_in_blocks(path):
    path.write_bytes(frames()[:-3])
    seen: list[int] = []
    source = TlogSource(path, DIALECT, on_progress=seen.append)
    assert sum(len(batch) for batch in source.batches()) == 9
    assert source.truncated == len(frames()) // 10 - 3
    assert source.discarded == 0
    assert seen[-1] == source.size
    assert len(seen) > 3


def test_an_empty_file_is_refused(path):
    path.touch()
    with pytest.raises(ValueError, match="nothing was recorded"):
        TlogSource(path, DIALECT, trusted=True)


def test_what_is_no_log_is_refused(path):
    path.write_bytes(b"time,latitude,longitude\n" * 20)
    with pytest.raises(ValueError, match="no telemetry log"):
        TlogSource(path, DIALECT)


def test_our_own_log_is_one_whatever_arrived_first(path):
    path.write_bytes(b"".join(write_junk(US - 100 + i, b"noise") for i in range(50)) + frames())
    source = TlogSource(path, DIALECT)
    assert sum(len(batch) for batch in source.batches()) == 10
    assert source.discarded == 50 * len(b"noise")


@pytest.mark.parametrize("first", [write_junk(US - 1, bytes(500)), b"damaged beyond recognition" * 20])
def test_a_log_that_is_known_to_be_one_need_not_look_like_one(path, first):
    path.write_bytes(first + frames())
    with pytest.raises(ValueError, match="no telemetry log"):
        TlogSource(path, DIALECT)
    assert sum(len(batch) for batch in TlogSource(path, DIALECT, trusted=True).batches()) == 10


def test_a_damaged_link_number_is_a_link_of_the_log(path):
    log = bytearray(frames())
    log[7] |= 3
    path.write_bytes(log)
    source = TlogSource(path, DIALECT, links=2)
    assert {source.links[link] for batch in source.batches() for link in batch.link} == {"0"}
