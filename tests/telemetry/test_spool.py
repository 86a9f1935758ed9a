"""What was said is read back as it was said; a disk that fails costs the history and nothing else."""

from __future__ import annotations

import subprocess
import sys
import threading
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from telemetry.bus.spool import Spool, records

ROOT = Path(__file__).parents[2]


def said(i: int) -> tuple[str, bytes]:
    return f"sortie.Kind{i % 3}.v1", bytes([i % 251]) * (i * 7 % 90)


def filled(count: int, limit: int = 1 << 30) -> Spool:
    spool = Spool(limit)
    for i in range(count):
        spool.add(*said(i))
    return spool


@given(count=st.integers(0, 60), first=st.integers(-5, 70), last=st.integers(-5, 70), size=st.integers(0, 3000))
def test_any_run_is_read_back_as_it_was_said(count, first, last, size):
    spool = filled(count)
    run = spool.read(first, last, size)
    found = list(records(run.data))
    assert len(found) == run.length
    assert found == [said(i) for i in range(run.first, run.first + run.length)]
    assert run.first >= max(first, 0)
    if max(first, 0) < min(last, count):
        assert run.first == max(first, 0)
        assert run.length >= 1, "always some progress"
        assert run.length == 1 or len(run.data) <= size
        more = spool.read(first, run.first + run.length + 1, 1 << 20)
        assert more.length == run.length or run.first + run.length == last or len(more.data) > size, "as much as fits"
    else:
        assert run.length == 0
    spool.close()


def test_beyond_its_limit_the_older_half_goes():
    spool = filled(2000, limit=20_000)
    assert spool.count == 2000
    assert spool.shortened > 0
    assert 0 < spool.oldest < 2000
    run = spool.read(0, 2000, 1 << 20)
    assert run.first == spool.oldest
    numbers = run.first + run.length
    while numbers < 2000:
        run = spool.read(numbers, 2000, 1 << 20)
        assert list(records(run.data)) == [said(i) for i in range(numbers, numbers + run.length)]
        numbers += run.length
    kept = sum(len(a) + len(b) + 5 for a, b in (said(i) for i in range(spool.oldest, 2000)))
    assert 9_000 < kept <= 20_200
    spool.close()


def test_it_leaves_no_file_behind(tmp_path):
    spool = Spool(1 << 20, tmp_path)
    spool.add("a", b"b")
    assert list(tmp_path.iterdir()) == [], "it has no name from the beginning"
    spool.close()


def test_closing_gives_the_space_back_and_reading_then_finds_nothing():
    spool = filled(10)
    descriptors = sum(1 for _ in Path("/proc/self/fd").iterdir())
    spool.close()
    assert sum(1 for _ in Path("/proc/self/fd").iterdir()) == descriptors - 1
    assert spool.read(0, 10, 1000).length == 0
    assert spool.oldest == spool.count == 10


def test_who_reads_while_it_grows_sees_whole_records():
    spool = Spool(10_000)
    wrong = []
    done = threading.Event()

    def read() -> None:
        while not done.is_set():
            total = spool.count
            run = spool.read(max(total - 50, 0), total, 4000)
            if list(records(run.data)) != [said(i) for i in range(run.first, run.first + run.length)]:
                wrong.append(run.first)

    thread = threading.Thread(target=read)
    thread.start()
    for i in range(1_000):
        spool.add(*said(i))
    done.set()
    thread.join()
    assert not wrong
    spool.close()


@pytest.mark.parametrize("cut", [1, 4, 6, 20])
def test_what_breaks_off_is_told_after_the_whole_records(cut):
    spool = filled(3)
    data = spool.read(0, 3, 1000).data
    spool.close()
    found = []
    with pytest.raises(ValueError, match="breaks off"):
        found.extend(records(data[:-cut]))
    assert found == [said(i) for i in range(len(found))]
    assert len(found) < 3


FULL = """
import resource, signal
from telemetry.bus import Bus
from telemetry.messages import Event, event
from tests.telemetry.test_bus import stream
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, 50_000))  # as if the disk were full then
with Bus("s", listen=["tcp/127.0.0.1:0"]) as bus:
    subscription = bus.subscribe("record", ["ingest"])
    publisher = bus.publisher("ingest")
    heard = iter(subscription)
    while not subscription._inputs[0].run[0]:
        next(heard)
    numbers, alarms = [], []
    def take():
        for message in heard:
            if message is None:
                return
            if message.source != "record":
                numbers.append(message.sequence)
            if isinstance(message, Event) and message.level[0] == "error":
                alarms.append(message.text[0])
    for i, message in enumerate(stream(2000)):
        publisher.put(message)
        if i % 100 == 0:
            take()
    while numbers[-1] < publisher.sequence - 1:
        message = next(heard, None)
        if message is not None and message.source != "record":
            numbers.append(message.sequence)
    assert numbers == list(range(2002)), numbers[:10]
    assert publisher._spool.oldest == publisher._spool.count
print(alarms)
"""


def test_a_full_disk_is_an_alarm_and_the_stage_goes_on():
    done = subprocess.run(
        [sys.executable, "-c", FULL], cwd=ROOT, capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout == ("['the history of stage ingest is given up: File too large; who joins late misses it']\n")
