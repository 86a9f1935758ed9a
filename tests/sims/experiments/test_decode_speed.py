"""Every reader reads the same messages, what is not here says so, and the verdicts follow from the figures."""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest
from rich.console import Console

from sims.experiments import decode_speed
from sims.experiments.decode_speed import BATCHES, COLUMNS, RATE, RECV_MATCH, SHARE, TIMES, Live, Row, compare
from telemetry import dataflash
from tests.telemetry.wire import DATA, Sender, tlog

FRAMES = 250


@pytest.fixture(scope="module")
def log(tmp_path_factory) -> Path:
    sender, old = Sender(), Sender(2, version=1)
    sent = [b for i in range(FRAMES // 5) for b in (
        sender.attitude(1000 + i), old.pressure(1000 + i, 900.0), sender.gps(1000 + i, 47.0, 8.0, 500.0),
        sender.text(f"text {i}"), old.heartbeat(),
    )]  # fmt: skip
    path = tmp_path_factory.mktemp("decode") / "some.tlog"
    path.write_bytes(tlog([(1_700_000_000_000_000 + 1000 * i, frame) for i, frame in enumerate(sent)]))
    return path


@pytest.fixture(scope="module")
def found(log):
    lines: list[str] = []
    comparison = compare([log], rounds=1, tell=lines.append)
    assert any("some.tlog: pymavlink recv_match, round 1 of 1" in line for line in lines)
    return comparison


def test_all_readers_find_every_message_of_a_log(found):
    assert [row.messages for row in found.rows if row.seconds is not None][:4] == [FRAMES] * 4
    assert {row.log for row in found.rows} == {"some.tlog"}


def test_a_reader_that_is_not_installed_is_a_row_that_says_so(found):
    (row,) = [row for row in found.rows if row.reader == "fasttlogparser"]
    assert (row.seconds is None) == (row.note == "not installed")


def test_times_are_those_of_the_whole_log_beside_our_columns(found):
    ours, *others = [row for row in found.rows if row.seconds is not None]
    assert (ours.reader, ours.times) == (COLUMNS, 1.0)
    for row in others:
        assert row.times == pytest.approx(row.seconds / ours.seconds)


def test_live_frames_are_measured_in_batches_of_several_sizes(found):
    assert [one.batch for one in found.live] == list(BATCHES)
    for one in found.live:
        assert one.share == pytest.approx(one.ours / one.theirs)


def test_a_verdict_is_met_at_its_target_and_missed_below():
    rows = [
        Row(log="a", reader=COLUMNS, messages=int(RATE), seconds=1.0, times=1.0),
        Row(log="a", reader=RECV_MATCH, messages=int(RATE), seconds=TIMES, times=TIMES),
        Row(log="b", reader=COLUMNS, messages=int(RATE), seconds=1.1, times=1.0),
        Row(log="b", reader=RECV_MATCH, messages=int(RATE), seconds=10.9, times=9.9),
    ]
    live = [Live(batch=5, ours=1.0, theirs=3.0, share=SHARE), Live(batch=1, ours=2.0, theirs=3.0, share=2.0 / 3.0)]
    assert [verdict.met for verdict in decode_speed._verdicts(rows, live)] == [True, True, False, False, True, False]


def test_the_tables_and_the_figures_can_be_printed(found):
    console = Console(width=160, record=True)
    for table in found.tables():
        console.print(table)
    text = console.export_text()
    assert all(row.reader in text for row in found.rows)
    assert all(verdict.target in text for verdict in found.verdicts)
    assert msgspec.json.decode(msgspec.json.encode(found), type=decode_speed.Comparison) == found


def test_dataflash_is_read_beside_pymavlink(tmp_path):
    path = DATA / "copter_dronekit_log171.bin"
    if not path.exists():
        pytest.skip(f"{path} is not here")
    short = tmp_path / "short.bin"
    short.write_bytes(path.read_bytes()[:200_000])
    ours, theirs = compare([short], rounds=1).rows
    assert ours.messages == sum(map(len, dataflash.read(short).values()))
    assert abs(ours.messages - theirs.messages) <= 2
    assert theirs.times is not None


def test_ulog_is_read_beside_pyulog():
    path = DATA / "sitl_pyulog_sample_px4_events.ulg"
    if not path.exists():
        pytest.skip(f"{path} is not here")
    rows = compare([path], rounds=1).rows
    assert [row.reader for row in rows] == ["ours, samples", "pyulog ULog, every topic"]
    for row in rows:
        assert (row.seconds is None) == (row.note == "not installed")
        assert row.messages > 0 or row.note


def test_no_round_is_refused():
    with pytest.raises(ValueError, match="0 rounds: at least one is needed"):
        compare(rounds=0)


def test_a_file_that_is_no_log_is_refused(tmp_path):
    path = tmp_path / "letter.txt"
    path.write_text("Dear Sir,\n" * 100)
    with pytest.raises(ValueError, match="is no telemetry log"):
        compare([path], rounds=1)
