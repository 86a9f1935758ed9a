"""The raw log holds what arrived, whatever happens next."""

from __future__ import annotations

import contextlib
import errno
import multiprocessing
import os
import random
import resource
import tempfile
import threading
import time
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink import mavutil

from telemetry import archive, tail
from telemetry.archive import RawLog, missing_segments, segments
from telemetry.frames import MOST_LINKS, Frames, join, link_bits, write_junk, write_record
from telemetry.mavlink import Dialect
from telemetry.sources.tlog import TlogSource
from tests.telemetry.test_frames import arrivals, evidence, frames_of, junk_of, read, scan
from tests.telemetry.wire import Sender

DIALECT = Dialect()
KILLS = int(os.environ.get("SORTIE_ARCHIVE_KILLS", "4"))


def until(true, seconds: float = 20.0) -> None:
    """Wait until it is true."""
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end
        time.sleep(0.005)


def ticks(batch: Frames, begin: int = 0) -> Frames:
    """The batch with receive times that any number of links leaves room for."""
    return replace(
        batch,
        t_rx=batch.t_rx // 1_000_000 * 16_000 + begin,
        junk_t_rx=batch.junk_t_rx // 1_000_000 * 16_000 + begin,
        until=batch.until // 1_000_000 * 16_000 + begin,
    )


def by_the_record(batch: Frames, links: int) -> bytes:
    """What the log should hold, record by record: the format as `telemetry.frames` draws it."""
    rows = [
        (int(batch.start[i]), int(batch.t_rx[i]), int(batch.link[i]), batch.frame(i), True) for i in range(len(batch))
    ]
    rows += [
        (int(batch.junk_start[i]), int(batch.junk_t_rx[i]), int(batch.junk_link[i]), batch.junk(i), False)
        for i in range(len(batch.junk_start))
    ]
    return b"".join(
        (write_record if whole else write_junk)(t_rx // 1000 + (link if links > 1 else 0), data)
        for _, t_rx, link, data, whole in sorted(rows)
    )


def numbered(first: int, count: int) -> Frames:
    """Frames that say which they are, one a datagram, dated by that."""
    sender = Sender()
    batch = scan(*[sender.attitude(first + i) for i in range(count)])
    return replace(batch, t_rx=batch.t_rx + first * 1_000_000, until=batch.until + first * 1_000_000)


def numbers(batches: list[Frames]) -> list[int]:
    """Which frames they are."""
    rows = [batch.data[batch.start[:, None] + np.arange(10, 14)].copy() for batch in batches]  # time_boot_ms
    return np.concatenate(rows).view("<u4").ravel().tolist()


def log_bytes(path: Path) -> bytes:
    return b"".join(segment.read_bytes() for segment in segments(path))


def test_frames_and_junk_come_back_in_their_order_with_their_times(tmp_path):
    sender = Sender()
    batch = scan(sender.attitude(1) + b"noise" + sender.attitude(2), b"more", sender.attitude(3))
    log = RawLog(tmp_path / "raw.tlog")
    log.write(batch)
    log.close()
    found = read((tmp_path / "raw.tlog").read_bytes())
    assert frames_of(found) == frames_of([batch])
    assert junk_of(found) == b"noisemore"
    assert join(found).junk_t_rx.tolist() == batch.junk_t_rx.tolist()


@given(st.lists(arrivals, min_size=1, max_size=8), st.integers(1, MOST_LINKS))
@settings(max_examples=150, deadline=None)
def test_what_is_written_is_the_format_to_the_byte(datagrams, links):
    batch = ticks(scan(*datagrams, links=links))
    with tempfile.TemporaryDirectory() as folder:
        log = RawLog(Path(folder) / "raw.tlog", links=links)
        log.write(batch)
        log.close()
        assert log.path.read_bytes() == by_the_record(batch, links)
        assert log.size == log.synced == len(by_the_record(batch, links))


def test_junk_longer_than_a_record_holds_is_several(tmp_path):
    batch = scan(bytes(70_000) + Sender().attitude(1), bytes(0xFFFF))
    log = RawLog(tmp_path / "raw.tlog")
    log.write(batch)
    log.close()
    assert log.path.read_bytes() == by_the_record(batch, 1)
    assert join(read(log.path.read_bytes())).junk_length.tolist() == [0xFFFF, 70_000 - 0xFFFF, 0xFFFF]


@pytest.mark.parametrize("links", range(1, MOST_LINKS + 1))
def test_every_link_is_told_apart(tmp_path, links):
    sender = Sender()
    batch = ticks(scan(*[sender.attitude(i) + b"noise" for i in range(links)], links=links))
    log = RawLog(tmp_path / "raw.tlog", links=links)
    log.write(batch)
    log.close()
    found = join(read(log.path.read_bytes(), links=links))
    assert found.link.tolist() == found.junk_link.tolist() == list(range(links))
    assert evidence(found) == evidence(batch)
    assert 1 << link_bits(links) >= links


def test_more_links_than_it_can_tell_apart_are_refused(tmp_path):
    with pytest.raises(ValueError, match="17 links: a raw log tells 1 to 16 apart"):
        RawLog(tmp_path / "raw.tlog", links=17)
    assert list(tmp_path.iterdir()) == []


def test_other_tools_read_it(tmp_path):
    sender = Sender()
    log = RawLog(tmp_path / "raw.tlog")
    log.write(scan(*[sender.attitude(i) for i in range(20)]))
    log.close()
    reader = mavutil.mavlink_connection(str(tmp_path / "raw.tlog"))
    times = []
    while (message := reader.recv_match(type="ATTITUDE")) is not None:
        times.append(message.time_boot_ms)
    reader.close()
    assert times == list(range(20))


def test_evidence_is_never_overwritten(tmp_path):
    (tmp_path / "raw.001.tlog").touch()
    with pytest.raises(FileExistsError, match=r"never overwritten.*raw\.001\.tlog"):
        RawLog(tmp_path / "raw.tlog")


def test_two_do_not_write_one_log(tmp_path):
    log = RawLog(tmp_path / "raw.tlog")
    with pytest.raises(OSError, match="another process is writing this log"):
        RawLog(tmp_path / "raw.tlog", resume=True, crc_extra=DIALECT.crc_extra)
    log.close()
    RawLog(tmp_path / "raw.tlog", resume=True, crc_extra=DIALECT.crc_extra).close()


def test_nothing_is_written_to_a_closed_log(tmp_path):
    log = RawLog(tmp_path / "raw.tlog")
    log.close()
    log.close()
    with pytest.raises(ValueError, match="is closed"):
        log.write(numbered(0, 1))


def test_it_is_written_through_without_being_asked(tmp_path):
    log = RawLog(tmp_path / "raw.tlog", interval=0.02)
    for i in range(3):
        log.write(numbered(i, 1))
        until(lambda: log.synced == log.size)
        assert abs(time.time_ns() - log.synced_at) < 60e9
        assert log.sync_took > 0
    log.close()


def test_a_slow_disk_holds_up_nobody_who_writes(tmp_path, monkeypatch):
    log = RawLog(tmp_path / "raw.tlog", interval=0.01)
    begun, over, through = threading.Event(), threading.Event(), os.fsync

    def slow(handle: int) -> None:
        begun.set()
        assert over.wait(20)
        through(handle)

    monkeypatch.setattr(os, "fsync", slow)
    log.write(numbered(0, 1))
    assert begun.wait(20)
    for i in range(1, 50):
        log.write(numbered(i, 1))
    assert numbers(read(log.path.read_bytes())) == list(range(50))
    assert log.synced == 0
    over.set()
    log.close()
    assert log.synced == log.size


def test_a_disk_that_does_not_answer_is_an_alarm(tmp_path, monkeypatch):
    monkeypatch.setattr(archive, "STUCK", 0.05)
    log = RawLog(tmp_path / "raw.tlog", interval=0.01)
    over, through = threading.Event(), os.fsync
    monkeypatch.setattr(os, "fsync", lambda handle: over.wait(20) and through(handle))
    log.write(numbered(0, 1))
    until(lambda: log.error)
    assert "the disk does not answer" in log.error
    over.set()
    until(lambda: log.error is None)
    log.close()
    assert (log.error, log.synced) == (None, log.size)


def test_an_fsync_that_fails_is_an_alarm_and_stays_on_record(tmp_path, monkeypatch):
    log = RawLog(tmp_path / "raw.tlog", interval=0.01)
    through = os.fsync

    def fail(handle: int) -> None:
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr(os, "fsync", fail)
    log.write(numbered(0, 1))
    until(lambda: log.error)
    assert "Input/output error: raw telemetry may not be on disk" in log.error
    monkeypatch.setattr(os, "fsync", through)
    until(lambda: log.error is None)
    log.close()
    assert [f"bytes 0 to {log.size} may not be on disk" in note for note in log.notes] == [True]


# A full disk.


class FullDisk:
    """The log's file on a disk that has room for a few bytes more."""

    def __init__(self, file, room: int) -> None:
        self._file, self._room = file, room

    def write(self, data: bytes) -> int:
        if self._room <= 0:
            raise OSError(errno.ENOSPC, "No space left on device")
        done = self._file.write(data[: self._room])
        self._room -= done
        return done

    def __getattr__(self, name):
        return getattr(self._file, name)


@contextlib.contextmanager
def no_file_longer_than(size: int):
    """The system refuses to write beyond: a real failure, with a part of what was to be written done before it."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.mark.parametrize("room", [0, 1, 8, 30, 44])
def test_a_short_full_disk_is_told_at_once_and_loses_nothing(tmp_path, room):
    log = RawLog(tmp_path / "raw.tlog")
    log.write(numbered(0, 1))
    with no_file_longer_than(log.size + room):
        for i in range(1, 10):
            log.write(numbered(i, 3 * i))
            assert "File too large: raw telemetry is not being kept, it is waiting in memory" in log.error
            assert numbers(read(log.path.read_bytes())) == [0]
            assert read(log.path.read_bytes())[-1].pending == 0, "it ends with a whole record"
        assert log.unwritten > 0
    log.sync()
    assert (log.error, log.lost, log.unwritten, log.notes) == (None, 0, 0, [])
    log.write(numbered(500, 1))
    log.close()
    assert log.path.read_bytes() == b"".join(
        by_the_record(numbered(i, n), 1) for i, n in [(0, 1), *((i, 3 * i) for i in range(1, 10)), (500, 1)]
    )


def test_a_disk_that_has_room_again_is_noticed_while_nothing_arrives(tmp_path):
    log = RawLog(tmp_path / "raw.tlog")
    with no_file_longer_than(0):
        log.write(numbered(0, 1))
    assert log.error

    def noticed() -> bool:
        log.sync(force=False)
        return log.error is None

    until(noticed)
    assert numbers(read(log.path.read_bytes())) == [0]
    log.close()


def test_what_no_memory_is_left_for_is_counted_and_the_hole_is_declared(tmp_path, monkeypatch):
    size = len(by_the_record(numbered(0, 1), 1))
    monkeypatch.setattr(archive, "WAITING", 5 * size)
    log = RawLog(tmp_path / "raw.tlog")
    with no_file_longer_than(0):
        for i in range(8):
            log.write(numbered(i, 1))
        log.sync()
        assert "it is being lost" in log.error
    log.sync()
    log.write(numbered(8, 1))
    log.close()
    assert numbers(read(log.path.read_bytes())) == [0, 1, 2, 3, 4, 8]
    assert log.lost == 3 * size
    assert log.error is None
    assert log.notes == [
        f"{log.path}: {3 * size} bytes received from 1970-01-01 00:00:00.006000 UTC to "
        "1970-01-01 00:00:00.008000 UTC are lost"
    ]


def test_what_is_still_waiting_when_it_closes_is_lost_and_counted(tmp_path):
    log = RawLog(tmp_path / "raw.tlog")
    with no_file_longer_than(20):
        log.write(numbered(0, 2))
        log.close()
    assert log.lost == len(by_the_record(numbered(0, 2), 1))
    assert log.path.read_bytes() == b""


def test_a_full_disk_that_takes_a_part_leaves_whole_records(tmp_path):
    log = RawLog(tmp_path / "raw.tlog")
    log.write(numbered(1, 1))
    whole = log._file
    log._file = FullDisk(whole, 10)
    log.write(numbered(2, 1))
    assert "No space left on device" in log.error
    assert numbers(read(log.path.read_bytes())) == [1]
    log._file = whole
    log.sync()
    assert log.error is None
    log.close()
    assert numbers(read(log.path.read_bytes())) == [1, 2]


def test_little_space_is_a_warning_and_very_little_an_alarm(tmp_path):
    disk = os.statvfs(tmp_path)
    free = disk.f_bavail * disk.f_frsize
    for name, reserve, warned, alarmed in (
        ("a", 1, False, False),
        ("b", free // 2, True, False),
        ("c", 2 * free, False, True),
    ):
        log = RawLog(tmp_path / f"{name}.tlog", reserve=reserve)
        assert ("MB left" in (log.warning or "")) == warned
        assert ("MB left: the disk is about to be full" in (log.error or "")) == alarmed
        log.write(numbered(0, 1))
        log.close()
        assert log.size == log.path.stat().st_size > 0, "evidence is kept as long as there is room"


# Segments.


@given(
    st.lists(st.lists(arrivals, min_size=1, max_size=4), min_size=1, max_size=6), st.integers(1, 600), st.integers(1, 7)
)
@settings(max_examples=100, deadline=None)
def test_any_length_of_segments_is_the_same_log(batches, segment, links):
    written = [ticks(scan(*datagrams, links=links), i * 1_000_000) for i, datagrams in enumerate(batches)]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        log = RawLog(folder / "raw.tlog", links=links, segment=segment)
        for batch in written:
            log.write(batch)
        log.close()
        whole = b"".join(by_the_record(batch, links) for batch in written)
        assert log_bytes(folder) == whole
        assert log.synced == log.size == len(whole)
        sizes = [p.stat().st_size for p in segments(folder)]
        assert all(size <= max(segment, *(len(by_the_record(b, links)) for b in written)) for size in sizes)
        for path in segments(folder)[1:]:
            first = join(read(path.read_bytes(), links=links))
            assert first.headers + first.discarded + int(first.length.sum()) == path.stat().st_size
            assert min([*first.start[:1], *first.junk_start[:1]]) in (8, 15), "a segment begins with a record"
        source = TlogSource(folder, DIALECT, links=links, trusted=True)
        assert evidence(join(list(source.batches()))) == evidence(join(written))


def test_segments_are_told_in_their_order_and_so_are_those_that_are_gone(tmp_path):
    names = ["raw.tlog", "raw.001.tlog", "raw.002.tlog", "raw.999.tlog", "raw.1000.tlog"]
    others = ["raw.01.tlog", "raw.0.tlog", "raw.x.tlog", "raw.tlog.tail", "live.rrd", "raw.000.tlog", "raw.²²².tlog"]
    for name in names + others:
        (tmp_path / name).touch()
    assert [p.name for p in segments(tmp_path)] == names
    assert segments(tmp_path / "raw.tlog") == segments(tmp_path)
    gone = missing_segments(tmp_path)
    assert [p.name for p in (gone[0], gone[-1])] == ["raw.003.tlog", "raw.998.tlog"]
    assert len(gone) == 1000 + 1 - len(names)
    assert segments(tmp_path / "nowhere" / "raw.tlog") == []


def test_a_segment_that_cannot_be_begun_is_no_reason_to_stop(tmp_path):
    log = RawLog(tmp_path / "raw.tlog", segment=1)
    log.write(numbered(0, 1))
    (tmp_path / "raw.001.tlog").mkdir()
    log.write(numbered(1, 1))
    assert numbers(read((tmp_path / "raw.tlog").read_bytes())) == [0, 1]
    assert log.error is None
    log.close()


# A writer that was killed.

damage = st.one_of(
    st.builds(lambda n: (n, b""), st.integers(0, 120)),
    st.builds(lambda n, more: (n, more), st.integers(0, 60), st.binary(max_size=80)),
    st.builds(lambda n, more: (n, more), st.just(0), arrivals),
    st.builds(
        lambda n: (0, (1_700_000_000_000_000).to_bytes(8, "big") + b"\x00junk" + n.to_bytes(2, "little")),
        st.integers(0, 90),
    ),
)


@given(
    st.lists(arrivals, min_size=1, max_size=5), damage, st.integers(1, 5), st.lists(arrivals, min_size=1, max_size=3)
)
@settings(max_examples=120, deadline=None)
def test_any_damaged_end_is_kept_as_junk_between_what_was_before_and_what_comes_after(old, damaged, links, new):
    first, second = ticks(scan(*old, links=links)), ticks(scan(*new, links=links), 10**9)
    cut, more = damaged
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "raw.tlog"
        log = RawLog(path, links=links)
        log.write(first)
        log.close()
        whole = path.read_bytes()
        content = whole[: max(0, len(whole) - cut)] + more
        path.write_bytes(content)
        before = join(read(content, links=links))
        log = RawLog(path, links=links, resume=True, crc_extra=DIALECT.crc_extra)
        middle = join(read(path.read_bytes(), links=links))
        assert evidence(middle)[0] == evidence(before)[0], "no frame is removed, none is made up"
        assert middle.pending == 0
        kept = junk_of([before]) + (content[len(content) - before.pending :] if before.pending else b"")
        assert junk_of([middle]) == kept, "not one byte is removed"
        assert (log.repaired > 0) == bool(log.notes)
        assert log.reached == middle.until
        log.write(second)
        log.close()
        after = join(read(path.read_bytes(), links=links))
        assert evidence(after)[0] == evidence(middle)[0] + evidence(second)[0]
        assert evidence(after)[1][: len(evidence(middle)[1])] == evidence(middle)[1]
        assert junk_of([after]) == kept + junk_of([second])
        assert list(Path(folder).iterdir()) == [path]


def test_a_cut_record_is_dated_by_the_one_before(tmp_path):
    path = tmp_path / "raw.tlog"
    whole = by_the_record(ticks(numbered(5, 3)), 2)
    path.write_bytes(whole[:-10])
    log = RawLog(path, links=2, resume=True, crc_extra=DIALECT.crc_extra)
    log.close()
    found = join(read(path.read_bytes(), links=2))
    assert found.junk_t_rx.tolist() == [int(found.t_rx[1])] == [log.reached]
    assert found.junk_length.tolist() == [len(whole) // 3 - 10] == [log.repaired]
    assert "were no whole record, left by a writer that was killed: they are kept as junk" in log.notes[0]


def test_a_segment_without_a_whole_record_is_dated_by_the_one_before(tmp_path):
    (tmp_path / "raw.tlog").write_bytes(by_the_record(numbered(0, 2), 1))
    (tmp_path / "raw.001.tlog").write_bytes(by_the_record(numbered(2, 1), 1)[:20])
    log = RawLog(tmp_path / "raw.tlog", resume=True, crc_extra=DIALECT.crc_extra)
    log.write(numbered(3, 1))
    log.close()
    found = join(read(log_bytes(tmp_path)))
    assert numbers([found]) == [0, 1, 3]
    assert found.junk_t_rx.tolist() == [int(found.t_rx[1])] == [log.reached]
    assert log.size == len(log_bytes(tmp_path))


def test_a_long_damaged_end_is_kept_whole(tmp_path):
    zeros = bytes(200_000)  # what a file system may leave after a power cut
    path = tmp_path / "raw.tlog"
    path.write_bytes(by_the_record(numbered(0, 2), 1) + zeros)
    log = RawLog(path, resume=True, crc_extra=DIALECT.crc_extra)
    log.write(numbered(2, 1))
    log.close()
    found = join(read(path.read_bytes()))
    assert (numbers([found]), junk_of([found]), log.repaired) == ([0, 1, 2], zeros, len(zeros))


def test_resuming_needs_to_know_what_a_record_is_and_nothing_is_a_new_log(tmp_path):
    log = RawLog(tmp_path / "raw.tlog", resume=True)
    log.write(numbered(0, 1))
    log.close()
    assert log.reached == 0
    with pytest.raises(ValueError, match="resuming needs the dialect's crc_extra"):
        RawLog(tmp_path / "raw.tlog", resume=True)


class Killed(BaseException):
    """The process ends here."""


@pytest.mark.parametrize("part", [0.0, 0.5, 1.0])
def test_a_repair_killed_at_any_step_leaves_a_log_to_read_and_to_repair(tmp_path, monkeypatch, part):
    whole = by_the_record(numbered(0, 3), 1)
    content = whole + b"rubbish" * 20
    steps = 0

    def step(real):
        def counted(*args):
            nonlocal steps
            steps += 1
            if steps != deadly:
                return real(*args)
            if real is really["write_whole"]:
                real(args[0], args[1][: round(part * len(args[1]))])
            raise Killed

        return counted

    really = {"write_whole": tail.write_whole, "fsync": os.fsync, "rename": Path.rename, "unlink": Path.unlink}
    monkeypatch.setattr(tail, "write_whole", step(tail.write_whole))
    monkeypatch.setattr(os, "fsync", step(os.fsync))
    monkeypatch.setattr(Path, "rename", step(Path.rename))
    monkeypatch.setattr(Path, "unlink", step(Path.unlink))
    for deadly in range(1, 20):
        path = tmp_path / f"{deadly}" / "raw.tlog"
        path.parent.mkdir()
        path.write_bytes(content)
        steps = 0
        try:
            tail.repair(path, DIALECT.crc_extra)
            break
        except Killed:
            pass
        assert numbers(read(path.read_bytes())) == [0, 1, 2]
        steps = -1000
        log = RawLog(path, resume=True, crc_extra=DIALECT.crc_extra)
        log.write(numbered(3, 1))
        log.close()
        found = join(read(path.read_bytes()))
        assert numbers([found]) == [0, 1, 2, 3]
        assert junk_of([found]) == b"rubbish" * 20
        assert [p.name for p in path.parent.iterdir()] == ["raw.tlog"]
    assert deadly == 10, "each of nine steps was the last one once"


def write_until_killed(folder: str, first: int, told) -> None:
    """Write numbered frames and tell after each batch what should be there."""
    log = RawLog(Path(folder) / "raw.tlog", resume=True, crc_extra=DIALECT.crc_extra, interval=0.01, segment=1_000_000)
    while True:
        log.write(numbered(first, 300))
        first += 300
        told.send((first, log.synced))


def test_a_writer_killed_at_any_moment_leaves_all_it_wrote_and_is_resumed(tmp_path):
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["tests.telemetry.test_archive"])
    draw = random.Random(5)
    first = 0
    for _ in range(KILLS):
        ours, theirs = context.Pipe(duplex=False)
        process = context.Process(target=write_until_killed, args=(str(tmp_path), first, theirs))
        process.start()
        theirs.close()
        said, synced = ours.recv()
        end = time.monotonic() + draw.uniform(0.0, 0.1)
        while time.monotonic() < end:
            if ours.poll(0.01):
                said, synced = ours.recv()
        process.kill()
        process.join()
        with contextlib.suppress(EOFError):
            while True:
                said, synced = ours.recv()
        ours.close()
        log = log_bytes(tmp_path)
        found = numbers(read(log))
        assert found == list(range(len(found))), "in order, without a hole"
        assert len(found) >= said
        assert len(log) >= synced
        first = len(found)
    log = RawLog(tmp_path / "raw.tlog", resume=True, crc_extra=DIALECT.crc_extra)
    log.close()
    found = read(log_bytes(tmp_path))
    assert numbers(found) == list(range(first))
    assert found[-1].pending == 0
    assert missing_segments(tmp_path) == []
    for before, after in pairwise(np.concatenate([batch.t_rx for batch in found])):
        assert before < after
