"""The raw log holds what arrived, whatever happens next."""

from __future__ import annotations

import errno
import os

import pytest
from pymavlink import mavutil

from telemetry.archive import RawLog
from telemetry.frames import join
from tests.telemetry.test_frames import frames_of, junk_of, read, scan
from tests.telemetry.wire import Sender


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
    (tmp_path / "raw.tlog").touch()
    with pytest.raises(FileExistsError):
        RawLog(tmp_path / "raw.tlog")


def test_more_links_than_it_can_tell_apart_are_refused(tmp_path):
    with pytest.raises(ValueError, match="5 links: a raw log tells at most 4 apart"):
        RawLog(tmp_path / "raw.tlog", links=5)


def test_written_through_at_least_once_a_second(tmp_path, monkeypatch):
    synced = []
    monkeypatch.setattr(os, "fsync", synced.append)
    log = RawLog(tmp_path / "raw.tlog", interval=0.0)
    log.write(scan(Sender().attitude(1)))
    assert len(synced) == 1
    log.sync(force=False)
    assert len(synced) == 1, "nothing new to write through"
    log.close()


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


def test_a_full_disk_is_told_and_leaves_whole_records(tmp_path):
    sender = Sender()
    log = RawLog(tmp_path / "raw.tlog")
    log.write(scan(sender.attitude(1)))
    whole = log._file
    log._file = FullDisk(whole, 10)
    log.write(scan(sender.attitude(2)))
    assert "No space left on device" in log.error
    assert log.lost > 0
    log._file = whole
    log.write(scan(sender.attitude(3)))
    assert log.error is None
    log.close()
    found = read((tmp_path / "raw.tlog").read_bytes())
    assert len(frames_of(found)) == 2
    assert found[-1].discarded == 0
