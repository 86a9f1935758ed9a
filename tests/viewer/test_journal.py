"""A recording while it grows, when it is broken off, and when it is finished."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
import rerun as rr

from tests.viewer import flight as f
from tests.viewer.recordings import everything, grown, rerun
from viewer import journal
from viewer.journal import SUFFIX, indexed
from viewer.reading import Reading
from viewer.recorder import record
from viewer.review import review

ROOT = Path(__file__).parents[2]


@pytest.fixture(autouse=True)
def strict():
    rr.set_strict_mode(True)
    yield
    rr.set_strict_mode(False)


def python(code: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)


@pytest.fixture(scope="module")
def both(tmp_path_factory):
    """One flight as it has grown, and finished; so short chunks that every entity fills several."""
    rr.set_strict_mode(True)
    folder = tmp_path_factory.mktemp("journal")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(journal, "ROWS", 200)
        grown(f.batched(f.flight(), 0.5), folder / "grown.rrd", folder / "finished.rrd", interval=0.5)
    return folder / "grown.rrd", folder / "finished.rrd"


def chunks(path):
    with Reading(path) as reading:
        return sum(map(len, reading.chunks.values()))


def test_a_finished_recording_verifies_and_one_that_grows_is_read_without_index(both):
    for path, good in zip(both, (False, True), strict=True):
        assert (rerun("rrd", "verify", path).returncode == 0) is good
        assert indexed(path) is good
    found = review(both[0])
    assert not found.closed and any("no index" in remark for remark in found.remarks)
    found = review(both[1])
    assert found.closed and not found.remarks


def test_a_finished_recording_holds_the_same_rows_in_few_chunks(both):
    was, now = (everything(path) for path in both)
    assert was.keys() <= now.keys()
    for key in now:
        if key[0].startswith("/v1/raw") or "/live/" in key[0] or key[0].startswith("/link"):
            assert was[key] == now[key], key
    assert 5 * chunks(both[1]) < chunks(both[0])
    assert both[1].stat().st_size < both[0].stat().st_size


def test_the_layout_is_in_the_finished_recording(both):
    (entry,) = rr.chunk.RrdReader(both[1]).blueprints()
    assert entry.application_id == "sortie"
    assert rr.chunk.RrdReader(both[1]).stream(store=entry).to_chunks()


def test_a_recorder_that_is_killed_leaves_what_it_had_flushed(tmp_path):
    path = tmp_path / "killed.rrd"
    done = python(f"""
import os, signal
from tests.viewer import flight as f
from viewer.recorder import Recorder
recorder = Recorder({str(path)!r}, sortie="k", interval=4.0)
for message in f.batched(f.flight(), 4.0):
    recorder.write(message)
recorder.flush()
os.kill(os.getpid(), signal.SIGKILL)
""")
    assert done.returncode == -9, done.stderr
    found = review(path)
    assert not found.closed and found.summary.completeness == "not closed"
    (vehicle,) = found.summary.vehicles
    assert next(s for s in vehicle.sensors if s.sensor == "gnss").samples == len(f.times(5.0))
    path.unlink()  # as the sortie is resumed: all of it is told again
    record(f.batched(f.flight(), 4.0), path, sortie="k", interval=4.0)
    assert indexed(path) and [file.name for file in tmp_path.iterdir()] == [path.name]


def test_killed_while_it_finishes_it_leaves_everything_unfinished(tmp_path):
    path = tmp_path / "killed.rrd"
    done = python(f"""
import os, signal
from tests.viewer import flight as f
from viewer import journal
from viewer.recorder import record
journal.os.fsync = lambda _: os.kill(os.getpid(), signal.SIGKILL)
record(f.batched(f.flight(), 4.0), {str(path)!r}, sortie="k", interval=4.0)
""")
    assert done.returncode == -9, done.stderr
    assert sorted(file.name for file in tmp_path.iterdir()) == [path.name, path.name + SUFFIX]
    found = review(path)
    assert found.closed and found.summary.completeness == "complete" and len(found.remarks) == 1
    assert not indexed(path)


def test_interrupted_while_it_finishes_it_cleans_up(tmp_path, monkeypatch):
    def interrupt(_):
        raise KeyboardInterrupt

    path = tmp_path / "x.rrd"
    monkeypatch.setattr(journal.os, "fsync", interrupt)
    with pytest.raises(KeyboardInterrupt):
        record(f.batched(f.flight(), 4.0), path, sortie="x", interval=4.0)
    assert [file.name for file in tmp_path.iterdir()] == [path.name]
    assert review(path).closed and not indexed(path)


def test_what_cannot_be_finished_stays_as_it_has_grown_and_is_told(tmp_path, monkeypatch):
    def lose(path):
        with path.open("r+b") as file:
            file.truncate(path.stat().st_size // 2)
        return indexed(path)

    path, heard = tmp_path / "x.rrd", []
    monkeypatch.setattr(journal, "indexed", lose)
    summary = record(f.batched(f.flight(), 4.0), path, sortie="x", interval=4.0, on_alarm=heard.append)
    assert len(heard) == 1 and f"rerun rrd optimize {path}" in heard[0] and summary.alarms == heard
    assert [file.name for file in tmp_path.iterdir()] == [path.name]
    assert review(path).closed
    assert rerun("rrd", "optimize", path, "-o", tmp_path / "way_out.rrd").returncode == 0
    assert indexed(tmp_path / "way_out.rrd")


def test_where_the_disk_is_nearly_full_all_of_it_is_left_to_what_grows(tmp_path, monkeypatch):
    path, heard = tmp_path / "x.rrd", []
    monkeypatch.setattr(journal, "RESERVE", 1 << 62)
    summary = record(f.batched(f.flight(), 4.0), path, sortie="x", interval=4.0, on_alarm=heard.append)
    assert summary.completeness == "complete"
    assert len(heard) == 1 and "for want of room" in heard[0] and f"rerun rrd optimize {path}" in heard[0]
    assert [file.name for file in tmp_path.iterdir()] == [path.name]
    assert review(path).closed


def test_memory_does_not_grow_with_what_has_been_recorded(tmp_path):
    done = python(f"""
import os
import msgspec, numpy as np
import viewer
viewer.load()
from telemetry import messages as m
from tests.viewer import flight as f
from viewer.recorder import Recorder

def resident():
    return int(open("/proc/self/statm").read().split()[1]) * os.sysconf("SC_PAGE_SIZE")

(whole, *_) = [f.sliced(x, slice(20, 21)) for x in f.flight() if isinstance(x, m.Estimate)]
recorder = Recorder({str(tmp_path / "long.rrd")!r}, sortie="long", interval=0.0)
for n in range(1200):  # every one is nine chunks
    if n % 100 == 0:  # as in real time, where chunks do not wait to be written
        recorder.flush()
    if n == 300:
        begin = resident()
    shift = n * 20_000_000
    recorder.write(msgspec.structs.replace(whole, t=whole.t + shift, t_rx=whole.t_rx + shift))
recorder.flush()
print(resident() - begin)
recorder.close()
""")
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""  # the SDK has no advice to give
    assert int(done.stdout) < 8e6, "900 rows in 8100 chunks"  # their index alone would be 17 MB
    assert indexed(tmp_path / "long.rrd")
