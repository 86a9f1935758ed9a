"""Logs are told from other files, and read in blocks."""

from __future__ import annotations

from itertools import pairwise

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from telemetry.archive import RawLog
from telemetry.frames import join, write_junk, write_record
from telemetry.mavlink import Dialect
from telemetry.sources import tlog
from telemetry.sources.tlog import TlogSource
from tests.telemetry.test_archive import numbered, numbers
from tests.telemetry.test_frames import evidence, read
from tests.telemetry.wire import DATA, LOGS, Sender

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


# Several files that are one log.


@given(st.lists(st.integers(0, 500), max_size=6), st.integers(1, 200), st.integers(0, 40))
@settings(max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_files_and_blocks_may_end_anywhere(tmp_path, monkeypatch, cuts, block, missing):
    monkeypatch.setattr(tlog, "BLOCK", block)
    log = write_junk(US - 1, b"noise") + frames()
    log = log[: len(log) - missing]
    edges = [0, *sorted(min(cut, len(log)) for cut in cuts), len(log)]
    paths = []
    for i, (begin, end) in enumerate(pairwise(edges)):
        paths.append(tmp_path / f"{i}.tlog")
        paths[-1].write_bytes(log[begin:end])
    source = TlogSource(paths, DIALECT, trusted=True)
    whole = join(read(log))
    batches = list(source.batches())
    assert evidence(join(batches)) == evidence(whole)
    assert (source.size, source.truncated, source.discarded) == (len(log), whole.pending, whole.discarded)
    inside = sum(int(batch.length.sum()) + batch.headers for batch in batches)
    assert inside + source.discarded + source.truncated == source.size


def test_a_damaged_segment_in_the_middle_does_not_end_the_log(tmp_path):
    names = ["raw.tlog", "raw.001.tlog", "raw.002.tlog"]
    for i, name in enumerate(names):
        (tmp_path / name).write_bytes(b"".join(write_record(US + i, Sender().attitude(10 * i + k)) for k in range(10)))
    (tmp_path / names[1]).write_bytes((tmp_path / names[1]).read_bytes()[:200] + bytes(77))
    source = TlogSource(tmp_path, DIALECT)
    found = numbers(list(source.batches()))
    assert [n for n in found if not 10 <= n < 20] == [*range(10), *range(20, 30)]
    assert source.discarded > 77
    (tmp_path / names[1]).unlink()
    source = TlogSource(tmp_path, DIALECT)
    assert numbers(list(source.batches())) == [*range(10), *range(20, 30)]
    assert [p.name for p in source.missing] == [names[1]]


def test_a_log_that_is_still_written_is_read_to_its_end_through_new_segments(tmp_path):
    log = RawLog(tmp_path / "raw.tlog", segment=500)
    log.write(numbered(0, 5))
    source = TlogSource(tmp_path, DIALECT)
    written, batches = 5, []
    for batch in source.batches():
        batches.append(batch)
        if written < 200:
            log.write(numbered(written, 5))
            written += 5
    log.close()
    assert len(source.paths) > 10
    assert numbers(batches) == list(range(written))
    assert (source.discarded, source.truncated, source.missing) == (0, 0, [])


def test_only_as_much_is_read_as_is_asked_for(tmp_path):
    log = RawLog(tmp_path / "raw.tlog", segment=300)
    for i in range(10):
        log.write(numbered(i, 1))
    log.close()
    source = TlogSource(tmp_path, DIALECT, size=log.size * 7 // 10)
    assert numbers(list(source.batches())) == list(range(7))
    assert source.size == log.size * 7 // 10


def test_what_is_not_there_is_refused(tmp_path):
    with pytest.raises(FileNotFoundError):
        TlogSource(tmp_path, DIALECT)
    with pytest.raises(ValueError, match="empty list"):
        TlogSource([], DIALECT)


@pytest.mark.parametrize("log", LOGS)
def test_a_real_log_in_segments_is_the_log(tmp_path, monkeypatch, log):
    if not (DATA / log).exists():
        pytest.skip(f"{DATA / log} is not there")
    monkeypatch.setattr(tlog, "BLOCK", 1 << 20)
    content = (DATA / log).read_bytes()[:3_000_000]
    third = len(content) // 3
    for i, name in enumerate(["raw.tlog", "raw.001.tlog", "raw.002.tlog"]):
        (tmp_path / name).write_bytes(content[i * third : (i + 1) * third if i < 2 else None])
    whole = join(read(content))
    found = join(list(TlogSource(tmp_path, DIALECT).batches()))
    for name in ("msgid", "link", "seq", "known", "t_rx", "length", "junk_length", "junk_t_rx"):
        assert (getattr(found, name) == getattr(whole, name)).all(), name
    assert found.pending == whole.pending
