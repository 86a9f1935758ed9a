"""Recordings written and read back, row by row."""

from __future__ import annotations

import itertools
import subprocess
import sys
from pathlib import Path

import msgspec
import numpy as np
import pytest
import rerun as rr
from rich.console import Console

from telemetry import messages as m
from tests.viewer import flight as f
from tests.viewer.recordings import everything, grown, rerun
from viewer.books import Books
from viewer.comparison import stored
from viewer.plot import plot
from viewer.reading import Reading
from viewer.recorder import Recorder, record
from viewer.report import tell, to_json
from viewer.review import column, compare, review


@pytest.fixture(autouse=True)
def strict():
    rr.set_strict_mode(True)
    yield
    rr.set_strict_mode(False)


@pytest.fixture(scope="module")
def live(tmp_path_factory):
    """A sortie folder as a live flight leaves it."""
    rr.set_strict_mode(True)
    folder = tmp_path_factory.mktemp("sortie")
    summary = record(
        f.batched(f.flight(), 0.5),
        folder / "live.rrd",
        windows=folder / "windows.rrd",
        sortie="s1",
        properties={"dialect": "ardupilotmega"},
        interval=0.5,
    )
    return folder, summary


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """One file, as a smoothing of a log writes it."""
    rr.set_strict_mode(True)
    path = tmp_path_factory.mktemp("smooth") / "s1.rrd"
    return path, record(f.flight(), path, sortie="s1", interval=None)


def test_both_files_verify_and_share_the_recording_id(live):
    folder, _ = live
    for name in ("live.rrd", "windows.rrd"):
        done = rerun("rrd", "verify", folder / name)
        assert done.returncode == 0, done.stderr
        (entry,) = rr.chunk.RrdReader(folder / name).recordings()
        assert (entry.application_id, entry.recording_id) == ("sortie", "s1")
    merged = folder / "merged.rrd"
    assert rerun("rrd", "merge", folder / "live.rrd", folder / "windows.rrd", "-o", merged).returncode == 0
    assert compare(merged, f.flight()) == []


def test_raw_rows_are_those_of_the_messages(live):
    folder, _ = live
    fixes = [message for message in f.flight() if isinstance(message, m.Gnss)]
    t, altitude = column(folder, "/v1/raw/gnss/altitude", "Scalars:scalars")
    real = np.isfinite(altitude)
    assert np.array_equal(t[real], np.concatenate([x.t for x in fixes]))
    assert np.array_equal(altitude[real], np.concatenate([x.altitude for x in fixes]))
    t_rx, _ = column(folder, "/v1/raw/gnss/altitude", "Scalars:scalars", "t_rx")
    assert np.array_equal(t_rx[1:][real[1:]][:5], fixes[0].t_rx[1:6])
    _, climb = column(folder, "/v1/raw/gnss/climb_rate", "Scalars:scalars")
    assert np.array_equal(climb[real], -np.concatenate([x.velocity[:, 2] for x in fixes]), equal_nan=True)
    assert np.isnan(climb[real]).sum() > 100  # not measured is not zero
    _, force = column(folder, "/v1/raw/imu/specific_force", "Scalars:scalars")
    assert force.shape[1] == 3


def test_lines_break_across_silence_and_boot(live):
    folder, summary = live
    t, altitude = column(folder, "/v1/est/live/altitude", "Measurements:values")
    holes = np.flatnonzero(np.isnan(altitude))
    assert np.array_equal(t[holes], f.ns([f.SILENCE[0], f.REBOOT[0]]) + 1)
    assert np.array_equal(t[holes + 1], f.ns([f.SILENCE[1], f.REBOOT[1]]))
    _, variance = column(folder, "/v1/est/live/altitude", "Measurements:variances")
    assert np.isnan(variance[holes]).all()
    (vehicle,) = summary.vehicles
    assert [b.boot for b in vehicle.boots] == [0, 1]
    assert [(s.t0, s.t1) for s in vehicle.silences] == [tuple(f.ns(f.SILENCE)), tuple(f.ns(f.REBOOT))]
    t, states = column(folder, "/v1/boot", "StateChange:state")
    assert [state or "" for state in states.tolist()] == ["boot 0", "", "boot 0", "", "boot 1", ""]


def test_no_estimate_yet_is_not_a_number(live):
    folder, _ = live
    t, (values, variances) = Reading(folder).columns(
        "/v1/est/live/climb_rate", ("Measurements:values", "Measurements:variances"), ("t_vehicle",)
    )
    early = t[0] < f.ns(1.0)
    assert np.isnan(values[early]).all() and np.isnan(variances[early]).all()
    first = next(x for x in f.flight() if isinstance(x, m.Estimate))
    assert variances[6] == first.std[6, 5] ** 2


def test_summary_is_stored_and_read_back(live):
    folder, summary = live
    found = review(folder)
    assert found.closed and not found.remarks
    assert msgspec.json.encode(found.summary) == msgspec.json.encode(summary)
    assert summary.completeness == "complete" and summary.properties == {"dialect": "ardupilotmega"}
    assert [w.test_point for w in summary.windows if w.test_point] == ["level turn", "phugoid"]
    assert summary.events == {"INFO": 6, "WARN": 1, "ERROR": 2} and len(found.log) == 9
    (account,) = summary.accounts
    assert account.received == 50 * (len(f.times(1.0)) - 1) and account.source == "0/1"
    gnss = next(s for s in summary.vehicles[0].sensors if s.sensor == "gnss")
    assert gnss.samples == len(f.times(5.0)) and gnss.rate == pytest.approx(5.0) and gnss.gaps == 2
    msgspec.json.decode(to_json(found))


def test_stored_columns_do_not_depend_on_batches(live, whole, tmp_path):
    other = tmp_path / "other.rrd"
    record(f.batched(f.flight(), 7.3), other, sortie="s1", interval=2.0)
    expected = everything(live[0])
    for path in (whole[0], other):
        found = everything(path)
        assert found.keys() == expected.keys()
        for key, rows in expected.items():
            if key[0] != "/events":  # what is said at one time has no order of its own
                assert found[key] == rows, key


def test_comparison_finds_what_was_changed(live):
    folder, _ = live
    messages = f.flight()
    assert compare(folder, messages) == []
    assert compare(folder, f.batched(messages, 3.0)) == []
    place = next(i for i, x in enumerate(messages) if isinstance(x, m.Estimate))
    std = messages[place].std.copy()
    std[100, 2] = np.nextafter(std[100, 2] * 1.0000001, np.inf)
    changed = [*messages]
    changed[place] = msgspec.structs.replace(messages[place], std=std)
    (difference,) = compare(folder, changed)
    assert (difference.entity, difference.what, difference.count) == ("/v1/est/live/altitude", "variance", 1)
    assert difference.t == messages[place].t[100] and "/v1/est/live/altitude" in str(difference)
    missing = [x for x in messages if not (isinstance(x, m.Window) and x.number == 1)]
    differences = compare(folder, missing)
    assert {d.entity for d in differences} == {f"/v1/est/window/{name}" for name in f.NAMES}
    assert all(d.count >= 150 for d in differences)
    none = compare(folder, [])
    assert len(none) == 12 and all(d.what == "entity" for d in none)


def test_a_recording_cut_in_the_middle_is_still_reviewed(tmp_path):
    messages = f.batched(f.flight(), 0.5)
    data = grown(messages, tmp_path / "grown.rrd", tmp_path / "finished.rrd", interval=0.5).read_bytes()
    cut = tmp_path / "cut.rrd"
    cut.write_bytes(data[: len(data) * 3 // 5])
    found = review(cut)
    assert not found.closed and found.summary.completeness == "truncated" and found.summary.sortie == "grown"
    assert any("middle of a message" in remark for remark in found.remarks)
    assert any("not closed cleanly" in remark for remark in found.remarks)
    (vehicle,) = found.summary.vehicles
    gnss = next(s for s in vehicle.sensors if s.sensor == "gnss")
    assert gnss.samples > 300 and gnss.rate == pytest.approx(5.0)
    assert found.summary.accounts[0].received > 0 and found.summary.byte_accounts[0].bytes > 0
    assert cut.read_bytes() == data[: len(data) * 3 // 5]
    with (tmp_path / "told").open("w") as file:
        tell(found, Console(file=file, width=100))
    plot(found, tmp_path / "cut.png")


def test_windows_alone_can_be_counted_from_their_file(live):
    found = review(live[0] / "windows.rrd")
    assert not found.closed and len(found.summary.windows) == len(f.WINDOWS)


def test_an_existing_file_is_never_overwritten(tmp_path):
    path = tmp_path / "there.rrd"
    path.write_bytes(b"flight")
    with pytest.raises(FileExistsError, match="another name"):
        record([], path, sortie="s")
    with pytest.raises(FileExistsError, match="another name"):
        record([], tmp_path / "new.rrd", windows=path, sortie="s")
    assert path.read_bytes() == b"flight" and not (tmp_path / "new.rrd").exists()


def test_a_place_that_cannot_be_written_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match="no folder"):
        record([], tmp_path / "no" / "x.rrd", sortie="s")
    with pytest.raises(OSError, match=r"x\.rrd"):
        record([], Path("/proc/x.rrd"), sortie="s")


def test_no_data_is_a_recording_that_says_so(tmp_path):
    path = tmp_path / "empty.rrd"
    summary = record([f.progress(f.START)], path, sortie="quiet")
    assert summary.completeness == "no data"
    assert rerun("rrd", "verify", path).returncode == 0
    found = review(path)
    assert found.closed and found.summary.sortie == "quiet"
    plot(path, tmp_path / "empty.png")
    assert (tmp_path / "empty.png").stat().st_size > 1000


def test_several_vehicles_and_receivers_stay_apart(tmp_path):
    path = tmp_path / "two.rrd"
    second = next(x for x in f.flight(1) if isinstance(x, m.Gnss))
    second = msgspec.structs.replace(second, source="0/220", altitude=second.altitude + 1000)
    summary = record([*f.flight(1), second, *f.flight(2)], path, sortie="two", interval=None)
    assert [v.vehicle for v in summary.vehicles] == [1, 2] and len(summary.vehicles[0].sensors) == 4
    _, plain = column(path, "/v1/raw/gnss/altitude", "Scalars:scalars")
    _, other = column(path, "/v1/raw/gnss.220/altitude", "Scalars:scalars")
    assert np.nanmax(plain) < 1000 < np.nanmin(other)
    assert compare(path, [*f.flight(1), *f.flight(2)]) == []
    assert len(rr.chunk.RrdReader(path).blueprints()) >= 1


def test_two_scopes_in_one_recording_are_said(tmp_path):
    path = tmp_path / "scopes.rrd"
    both = [f.window(0, *f.WINDOWS[1], scope="window"), f.window(0, *f.WINDOWS[1], seed=9, scope="sortie")]
    record(both, path, sortie="scopes")
    assert compare(path, both) == []
    assert [line.level for line in review(path).log] == ["WARN"]
    t, number = column(path, "/v1/est/window/altitude", "Measurements:values", "window")
    assert (t == 0).all() and len(number) == 2 * len(both[0].t)


def test_a_full_disk_is_an_alarm_and_not_the_end(tmp_path):
    code = f"""
import resource, signal, sys
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
from tests.viewer import flight as f
from viewer.recorder import Recorder
heard = []
recorder = Recorder({str(tmp_path / "full.rrd")!r}, sortie="full", interval=0.1, on_alarm=heard.append)
resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, 200_000))
for message in f.batched(f.flight(), 0.5):
    recorder.write(message)
recorder.flush()
summary = recorder.close()
print(summary.completeness, len(summary.alarms), len(heard), summary.alarms[0])
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=Path(__file__).parents[2])
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("truncated 1 1 ") and "writing fails" in done.stdout
    assert review(tmp_path / "full.rrd").summary.completeness in ("truncated", "not closed")
    assert [path.name for path in tmp_path.iterdir()] == ["full.rrd"]


def test_an_error_upstream_keeps_what_was_recorded(tmp_path):
    def broken():
        yield from itertools.islice(f.batched(f.flight(), 1.0), 50)
        raise RuntimeError("cable")

    with pytest.raises(RuntimeError, match="cable"):
        record(broken(), tmp_path / "x.rrd", sortie="x")
    found = review(tmp_path / "x.rrd")
    assert found.closed and found.summary.completeness == "interrupted" and found.summary.vehicles


def test_what_cannot_be_read_is_told_in_one_line(tmp_path):
    with pytest.raises(FileNotFoundError, match="no such recording"):
        review(tmp_path / "none.rrd")
    with pytest.raises(FileNotFoundError, match=r"no live\.rrd"):
        review(tmp_path)
    (tmp_path / "junk.rrd").write_bytes(b"this is no recording at all, whatever its name says" * 20)
    with pytest.raises(ValueError, match="not a recording"):
        review(tmp_path / "junk.rrd")


def test_report_and_picture(live, whole, tmp_path):
    out = tmp_path / "told.txt"
    with out.open("w") as file:
        tell(review(live[0]), Console(file=file, width=140))
    text = out.read_text()
    for word in ("complete", "level turn", "phugoid", "reboot", "4.3", "consistent", "not heard", "12.0 s"):
        assert word in text
    for name, source in (("folder", live[0]), ("file", whole[0])):
        plot(source, tmp_path / f"{name}.png")
        assert (tmp_path / f"{name}.png").stat().st_size > 50_000


def test_importing_the_room_is_cheap():
    code = "import sys, viewer, viewer.report, viewer.summary; assert not {'rerun', 'matplotlib'} & set(sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], cwd=Path(__file__).parents[2]).returncode == 0


def test_recorder_can_be_fed_message_by_message(tmp_path):
    recorder = Recorder(tmp_path / "one.rrd", sortie="one")
    window = f.window(0, *f.WINDOWS[1])
    recorder.write(window)
    recorder.flush()
    summary = recorder.close()
    assert len(summary.windows) == 1 and len(stored([window])["/v1/est/window/altitude"]) == len(window.t)


def test_how_consumers_keep_up_is_recorded_and_told(tmp_path):
    begin = int(f.flight()[0].t[0])
    t = begin + 1_000_000_000 * np.arange(3)
    age = np.array([0.01, 0.02, 0.03])
    health = m.Health(
        vehicle=0, source="record", stage="estimate", boot=0, t=t, t_rx=t, age_p50=age, age_p99=2 * age[::-1],
        age_max=np.array([np.nan, 4.0, 1.0]), messages=np.array([10, 20, 30]), missing=np.array([0, 0, 1]),
        backfilled=np.array([0, 2, 2]), refused=np.array([0, 0, 0]),
    )  # fmt: skip
    path = tmp_path / "health.rrd"
    summary = record([*f.flight(), health], path, sortie="h", interval=None)
    (kept,) = summary.consumers
    assert (kept.consumer, kept.stage, kept.age_p99, kept.age_max) == ("record", "estimate", 0.06, 4.0)
    assert (kept.messages, kept.missing, kept.backfilled, kept.refused) == (30, 1, 2, 0)
    at, ages = column(path, "/health/record/estimate/age", "Scalars:scalars")
    assert np.array_equal(at, t) and np.array_equal(ages[:, 0], age)
    _, counters = column(path, "/health/record/estimate/counters", "Scalars:scalars")
    assert counters[-1].tolist() == [30, 1, 2, 0]
    assert review(path).summary.consumers == [kept]


def test_the_ages_of_a_recording_that_was_not_closed_are_still_found(tmp_path):
    t = int(f.flight()[0].t[0]) + np.zeros(1, np.int64)
    one = np.array([1])
    health = m.Health(
        vehicle=0, source="estimate", stage="ingest", boot=0, t=t, t_rx=t, age_p50=one * 0.1, age_p99=one * 0.2,
        age_max=one * 0.3, messages=one, missing=one, backfilled=one, refused=one,
    )  # fmt: skip
    recorder = Recorder(tmp_path / "open.rrd", sortie="o", interval=0.1)
    for message in [health, *f.flight()]:
        recorder.write(message)
    recorder.flush()
    found = review(tmp_path / "open.rrd")
    assert not found.closed
    (kept,) = found.summary.consumers
    assert (kept.consumer, kept.stage, kept.age_p99, kept.age_max, kept.missing) == ("estimate", "ingest", 0.2, 0.3, 1)
    recorder.close()


def test_a_stream_that_is_only_compared_stands_beside_the_one_that_is_used(tmp_path):
    imu = next(message for message in f.flight() if isinstance(message, m.Imu))
    other = msgspec.structs.replace(imu, source="0/1.2", chosen=False, angular_rate=imu.angular_rate + 1.0)
    path = tmp_path / "two.rrd"
    record([other, imu], path, sortie="t", interval=None)  # the one that is not used is heard first
    _, used = column(path, "/v1/raw/imu/angular_rate", "Scalars:scalars")
    _, compared = column(path, "/v1/raw/imu.1.2/angular_rate", "Scalars:scalars")
    for rows, sent in ((used, imu), (compared, other)):
        assert np.array_equal(rows[np.isfinite(rows[:, 0])], sent.angular_rate)


def test_plain_numbers_are_sent_as_the_archetypes_send_them():
    from viewer.sink import _MEASUREMENTS, _SCALARS, numbers

    values, variances = np.arange(6.0).reshape(3, 2), np.array([1.0, np.nan, 3.0])
    for ours, theirs in (
        (numbers(_SCALARS, values), rr.Scalars.columns(scalars=values)),
        (numbers(_MEASUREMENTS, variances, variances), rr.Measurements.columns(values=variances, variances=variances)),
    ):
        for a, b in zip(ours, theirs, strict=True):
            assert str(a.component_descriptor()) == str(b.component_descriptor())
            assert a.as_arrow_array().type == b.as_arrow_array().type
            assert repr(a.as_arrow_array().to_pylist()) == repr(b.as_arrow_array().to_pylist())


def test_the_age_of_estimates_is_told_with_and_without_the_first_half_minute():
    books = Books("s", 1.0)
    estimates = [message for message in f.flight() if isinstance(message, m.Estimate)]
    rows = [f.sliced(message, slice(i, i + 1)) for message in estimates for i in range(len(message.t))]
    rows.sort(key=lambda row: int(row.t_rx[0]))
    begin = int(rows[0].t_rx[0])
    for row in rows:
        waited = 400_000_000 if row.t_rx[0] - begin <= 30e9 else 20_000_000
        books.add(row, int(row.t_rx[0]) + waited)
    summary = books.close("complete", [])
    assert (summary.age.max, summary.settled.max) == (0.4, 0.02)
    assert summary.settled.p99 == pytest.approx(0.02, rel=0.01)
