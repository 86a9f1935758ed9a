"""Two models of one vehicle in one recording, and the reports about them."""

from __future__ import annotations

import json
from io import StringIO

import msgspec
import numpy as np
import pytest
import rerun as rr
from rich.console import Console

from telemetry import messages as m
from tests.viewer import flight as f
from tests.viewer import reconstruction as r
from tests.viewer.recordings import grown
from viewer.blueprint import layout
from viewer.columns import Place, estimate_path, place, report_path, role
from viewer.plot import _Picture, plot
from viewer.reading import Reading
from viewer.recorder import record
from viewer.report import tell, to_json
from viewer.review import column, compare, review
from viewer.states import GROUPS, OTHERS, group, order, words
from viewer.summary import read
from viewer.worth import estimate, headline, markdown, named, title, worth

BOTH = ("Scalars:scalars", "Measurements:values", "Measurements:variances")


@pytest.fixture(autouse=True)
def strict():
    rr.set_strict_mode(True)
    yield
    rr.set_strict_mode(False)


@pytest.fixture(scope="module")
def live(tmp_path_factory):
    """A sortie folder with both models, as a live flight leaves it."""
    rr.set_strict_mode(True)
    folder = tmp_path_factory.mktemp("models")
    summary = record(
        f.batched(r.flight(), 2.0), folder / "live.rrd", windows=folder / "windows.rrd", sortie="m1", interval=2.0
    )
    return folder, summary


@pytest.fixture(scope="module")
def single(tmp_path_factory):
    """The flight path alone."""
    rr.set_strict_mode(True)
    path = tmp_path_factory.mktemp("alone") / "p.rrd"
    messages = [x for x in r.flight() if getattr(x, "model", "flight_path") == "flight_path"]
    return path, record(messages, path, sortie="p", interval=None)


def told(found, width=160):
    out = StringIO()
    tell(found, Console(file=out, width=width))
    return out.getvalue()


def tables(path, prefix):
    """All numbers below an entity, by what follows it."""
    with Reading(path) as reading:
        return {
            (entity.removeprefix(prefix), component): [x.tobytes() for x in (*t, np.asarray(rows, float))]
            for entity in reading.chunks
            if entity.startswith(prefix) and place(entity) is not None and not entity.endswith("report")
            for component in BOTH
            for t, (rows,) in [reading.columns(entity, (component,), ("t_vehicle", "t_rx"))]
            if len(rows)
        }


def names(blueprint):
    """Names of all views and containers of a layout."""
    found, waiting = [], [blueprint.root_container]
    while waiting:
        part = waiting.pop(0)
        found.append(getattr(part, "name", None))
        waiting += getattr(part, "contents", None) or [] if hasattr(part, "active_tab") else []
    return [name for name in found if name]


def views(blueprint):
    """Every view of a layout by name."""
    found, waiting = {}, [blueprint.root_container]
    while waiting:
        part = waiting.pop(0)
        if hasattr(part, "active_tab"):
            waiting += part.contents
        else:
            found[part.name] = part
    return found


# -- where things are --


def test_a_model_has_a_place_of_its_own():
    trajectory, path = f.window(0, *f.WINDOWS[1]), r.windows()[1]
    assert estimate_path(trajectory) == "/v1/est/window" and estimate_path(path) == "/v1/est/flight_path/window"
    assert place("/v1/est/live/altitude") == Place(1, "trajectory", "live", "altitude")
    assert place("/v12/est/flight_path/live/u") == Place(12, "flight_path", "live", "u")
    assert place("/v1/raw/imu/angular_rate") is None and place("/link/est/live/x") is None
    scopes = {report_path(report) for report in r.reports()}
    assert scopes == {f"/v1/report/flight_path/{scope}" for scope in ("window", "test_point", "sortie")}


def test_vanes_are_recorded_as_any_sensor(live):
    folder, summary = live
    sent = r.vanes()
    for name in ("alpha", "beta"):
        t, values = column(folder, f"/v1/raw/flow_angles/{name}", "Scalars:scalars")
        breaks = np.isin(t, f.ns([f.SILENCE[0], f.REBOOT[0]]) + 1)
        assert breaks.sum() == 2 and np.isnan(values[breaks]).all()
        assert np.array_equal(t[~breaks], np.concatenate([x.t for x in sent]))
        expected = np.concatenate([getattr(x, name) for x in sent])
        assert np.array_equal(values[~breaks], expected, equal_nan=True)
    (sensor,) = [s for s in summary.vehicles[0].sensors if s.sensor == "flow_angles"]
    assert sensor.samples == len(f.times(20.0)) and sensor.rate == pytest.approx(20.0)


def test_the_trajectory_is_recorded_as_if_it_were_alone(live, tmp_path):
    alone = tmp_path / "alone.rrd"
    record(f.flight(), alone, sortie="m1", interval=None)
    for stage, count in (("live", 14), ("window", 13)):  # six states of two columns, the place, and NIS
        expected = tables(alone, f"/v1/est/{stage}/")
        assert tables(live[0], f"/v1/est/{stage}/") == expected and len(expected) == count


def test_the_flight_path_is_recorded_as_if_it_were_alone(live, single):
    expected = tables(single[0], "/v1/est/flight_path/")
    assert tables(live[0], "/v1/est/flight_path/") == expected
    assert {entity for entity, _ in expected} == {
        *(f"{stage}/{name}" for stage in ("live", "window") for name in r.NAMES),
        "live/nis",
    }


def test_every_state_has_its_value_and_its_variance(live):
    sent = r.estimates()
    with Reading(live[0]) as reading:
        for i, name in enumerate(r.NAMES):
            components = ("Measurements:values", "Measurements:variances")
            (t,), (values, variances) = reading.columns(f"/v1/est/flight_path/live/{name}", components, ("t_vehicle",))
            real = np.isfinite(values)
            assert np.array_equal(t[real], np.concatenate([x.t for x in sent]))
            assert np.array_equal(values[real], np.concatenate([x.mean[:, i] for x in sent]))
            assert np.array_equal(variances[real], np.concatenate([x.std[:, i] for x in sent]) ** 2)
            assert (~real).sum() == 2  # the silence, and the reboot


def test_a_track_is_drawn_only_where_there_is_a_position(live, single):
    with Reading(live[0]) as reading:
        world = {entity for entity in reading.chunks if entity.startswith(("/v1/world", "/v1/geo"))}
        assert {entity.split("/")[-1] for entity in world} == {"gnss", "live", "window", "body"}
    with Reading(single[0]) as reading:
        assert not [entity for entity in reading.chunks if entity.endswith(("/geodetic", "/world/live", "/world/body"))]


def test_a_model_with_a_position_has_a_track_of_its_own(tmp_path):
    path = tmp_path / "placed.rrd"
    first = next(x for x in f.flight() if isinstance(x, m.Estimate))
    late = np.arange(len(first.t))[:, None] >= 9
    other = r.changed(first, model="other", geodetic=np.where(late, first.geodetic, np.nan))
    record([first, other], path, sortie="placed")
    with Reading(path) as reading:
        assert {"/v1/world/live", "/v1/world/live.other", "/v1/world/body.other"} <= set(reading.chunks)
        t, _ = reading.column("/v1/est/other/live/geodetic", "Scalars:scalars")
        assert t[0] == first.t[9]
        assert len(reading.column("/v1/est/live/geodetic", "Scalars:scalars")[0]) > len(t)


def test_windows_have_a_lane_per_model(live):
    t, states = column(live[0], "/v1/window", "StateChange:state")
    assert "phugoid" in states and t[0] == f.ns(0.0)
    t, states = column(live[0], "/v1/window/flight_path", "StateChange:state")
    assert t[0] == f.ns(4.0) and [s for s in states if s] == [
        "window A", "level turn", "window A", "window B", "phugoid", "window B",
    ]  # fmt: skip
    t, number = column(live[0], "/v1/est/flight_path/window/u", "Measurements:values", "window")
    assert set(t.tolist()) == set(range(6)) and len(number)


def test_windows_of_two_models_are_of_one_scope_each(tmp_path):
    path = tmp_path / "scopes.rrd"
    window = r.windows()[1]
    record([f.window(0, *f.WINDOWS[1], scope="sortie"), window], path, sortie="scopes")
    assert review(path).log == []
    other = tmp_path / "mixed.rrd"
    record([window, r.changed(window, scope="sortie")], other, sortie="mixed")
    assert [line.text for line in review(other).log] == [
        "v1: windows of the flight path smoothed at their closing and over the whole sortie lie in one recording"
    ]


# -- accounts --


def test_live_accounts_are_kept_per_model(live):
    accounts = live[1].vehicles[0].live
    assert [(a.model, tuple(a.names)) for a in accounts] == [("trajectory", f.NAMES), ("flight_path", r.NAMES)]
    for account in accounts:
        sent = [x for x in r.flight() if isinstance(x, m.Estimate) and x.model == account.model]
        assert account.rows == sum(len(x.t) for x in sent) and account.dof == sum(int(x.dof.sum()) for x in sent)
        assert account.nis == pytest.approx(sum(x.nis.sum() for x in sent))
    assert accounts[0].determined < accounts[0].rows and accounts[1].determined == accounts[1].rows


def test_a_recording_without_summary_tells_the_same(live, tmp_path):
    folder, summary = live
    once = {"windows": tmp_path / "layer.rrd", "interval": 2.0}
    data = grown(f.batched(r.flight(), 2.0), tmp_path / "grown.rrd", tmp_path / "finished.rrd", **once).read_bytes()
    (tmp_path / "live.rrd").write_bytes(data[: len(data) * 3 // 5])
    (tmp_path / "windows.rrd").write_bytes((folder / "windows.rrd").read_bytes())
    found = review(tmp_path)
    assert not found.closed
    accounts = found.summary.vehicles[0].live
    assert [(a.model, set(a.names)) for a in accounts] == [("trajectory", set(f.NAMES)), ("flight_path", set(r.NAMES))]
    assert accounts[1].names[:7] == ["h", "u", "v", "w", "theta", "phi", "psi"]
    assert 0 < accounts[1].rows <= summary.vehicles[0].live[1].rows
    assert len(found.summary.windows) == len(summary.windows)
    assert {(w.model, w.boot, w.number) for w in found.summary.windows} == {
        (w.model, w.boot, w.number) for w in summary.windows
    }
    key = lambda told: (told.end, told.scope)  # noqa: E731
    assert sorted(found.summary.reports, key=key) == sorted(summary.reports, key=key)
    assert "Whole sortie" in told(found)


def test_a_summary_of_the_first_format_is_read(live):
    text = msgspec.json.encode(live[1]).decode()
    assert read(text) == live[1]
    old = json.loads(text)
    account = old["vehicles"][0]["live"][0]
    old.pop("reports")
    for before, now in ((account, [account]), (None, [])):
        old["vehicles"][0]["live"], old["format"] = before, 1
        assert msgspec.to_builtins(read(json.dumps(old)).vehicles[0].live) == now


def test_replay_is_compared_model_by_model(live):
    messages = r.flight()
    assert compare(live[0], f.batched(messages, 9.0)) == []
    place_ = next(i for i, x in enumerate(messages) if isinstance(x, m.Estimate) and x.model == "flight_path")
    mean = messages[place_].mean.copy()
    mean[50, 1] = np.nextafter(mean[50, 1], np.inf)
    (difference,) = compare(live[0], [r.changed(x, mean=mean) if x is messages[place_] else x for x in messages])
    assert (difference.entity, difference.what, difference.count) == ("/v1/est/flight_path/live/u", "mean", 1)


def test_replay_is_compared_in_its_reports(live):
    messages = r.flight()
    turn, phugoid = (x for x in messages if isinstance(x, m.Report) and x.scope == "test point")
    (difference,) = compare(live[0], [r.changed(x, loss=0.5) if x is turn else x for x in messages])
    assert difference.entity == "/v1/report/flight_path/test_point" and difference.what == "loss"
    assert (difference.recorded, difference.replayed, difference.count) == ("0.0312", "0.5", 1)
    (difference,) = compare(live[0], [x for x in messages if x is not phugoid])
    assert (difference.what, difference.recorded, difference.replayed) == ("rows", "2 reports", "1 reports")


# -- reports --


def test_each_report_is_a_page_at_the_beginning_of_its_stretch(live):
    with Reading(live[0]) as reading:
        for scope, starts in (
            ("test_point", [30.0, 110.0]), ("window", [4.0, 82.0]), ("sortie", [0.0, f.REBOOT[1]]),
        ):  # fmt: skip
            entity = f"/v1/report/flight_path/{scope}"
            t, pages = reading.column(entity, "TextDocument:text")
            assert t.tolist() == f.ns(starts).tolist()
            _, kinds = reading.column(entity, "TextDocument:media_type")
            assert set(kinds.tolist()) == {"text/markdown"}
            assert all(page.startswith("# ") for page in pages.tolist())
        t_rx, _ = reading.column("/v1/report/flight_path/test_point", "TextDocument:text", "t_rx")
        assert t_rx.tolist() == [x.t_rx[0] for x in r.reports() if x.scope == "test point"]


def test_reports_are_in_the_summary_complete(live, tmp_path):
    folder, summary = live
    sent = r.reports()
    assert len(summary.reports) == len(sent) and review(folder).summary.reports == summary.reports
    kept = json.loads(to_json(review(folder)))["summary"]["reports"]
    by_end = lambda x: (x["end"], x["scope"])  # noqa: E731
    for mine, report in zip(sorted(kept, key=by_end), sorted(sent, key=lambda x: (int(x.t[-1]), x.scope)), strict=True):
        assert mine["end"] == report.t[-1] and mine["t_rx"] == report.t_rx[-1]
        for name in report.__struct_fields__:
            if name not in ("t", "t_rx", "source", "sequence"):
                assert mine[name] == json.loads(msgspec.json.encode(getattr(report, name))), name


def test_a_page_has_the_verdict_first_and_the_evidence_below():
    page = markdown(worth(r.reports()[1]))
    lines = page.splitlines()
    assert lines[0] == "# level turn"
    assert lines[1] == "**2 alarms, 1 channel over-confident, 1 parameter inconsistent, 1 finding**"
    heads = [line for line in lines if line.startswith("## ")]
    assert heads == ["## Alarms", "## Parameters", "## Channels", "## Median sigma", "## Data", "## Findings"]
    for line in (
        "- **airspeed: over-confident, mean NIS 2.31**",
        "| ba_x (accelerometer bias x) | 0.0213 ± 0.0042 m/s2 | 0.05 m/s2 | 3.57 | 0.40 | consistent |",
        "| bg_z (gyro bias z) | -0.120 ± 0.018 deg/s | 0.298 deg/s | 4.07 | -0.90 | consistent |",
        "| b_alpha (alpha offset) | 1.17 ± 0.18 deg | 0.498 deg | 1.49 | 4.20 | **inconsistent** |",
        "| b_beta (beta offset) | - | 0.498 deg | 0.12 | - | not observable |",
        "| airspeed | 2.31 | 0.86 .. 1.16 | 0.52 | 580 / 3 / 1 | **over-confident** |",
        "| heading psi | - | - | - | 0 / 0 / 4 | no data |",
        "| pitch theta | 0.115 deg | 0.0688 deg | 0.60 |",
        "- without inertial data: 0.3 s held at its last value; 12 s lost: the estimate ended and began anew",
        "- loss: 3.12 % of the samples due did not come; it multiplied the sigma of h by 1.14",
        "- gyro z: 3.1 times its noise \\| vibration at 47 Hz",
    ):
        assert line in lines
    assert any("raise the turbulence sigma" in line for line in lines) and lines[-1].endswith(f"`{'0' * 16}`")
    names = [line.split("|")[1].strip() for line in lines[lines.index("## Median sigma") + 3 :] if line[:2] == "| "]
    assert names == [named(name) for name in sorted(r.NAMES, key=order)]
    assert names[:2] == ["h (height)", "forward velocity u"]


def test_a_page_without_anything_to_say_says_so():
    page = markdown(worth(r.report("calm", "test point", 1, 30.0, 60.0, **r.QUIET, states=())))
    assert "**consistent**" in page and "## Alarms" not in page and "## Median sigma" not in page
    assert "without inertial data: none" in page and "loss: not known" in page
    nothing = worth(r.report("", "sortie", 0, 0.0, 1.0, **{**r.QUIET, "channels": (), "parameters": ()}))
    assert headline(nothing) == "no innovation was tested" and title(nothing) == "Whole sortie"
    assert markdown(nothing).startswith("# Whole sortie\n")


@pytest.mark.parametrize(
    ("value", "sigma", "unit", "said"),
    [
        (0.0213, 0.0042, "m/s2", "0.0213 ± 0.0042 m/s2"),
        (-0.00001, 0.12, "1", "0.00 ± 0.12"),
        (1234.5, 123.0, "m", "1234 ± 123 m"),
        (0.0174533, 0.00174533, "rad", "1.00 ± 0.10 deg"),
        (0.0, 1e-30, "m", "0.000000000 ± 0.000000000 m"),
        (1.0, None, "m", "-"),
    ],
)
def test_a_parameter_has_the_digits_that_its_sigma_allows(value, sigma, unit, said):
    parameter = r.changed(r.PARAMETERS[0], value=value, sigma=sigma, unit=unit)
    (kept,) = worth(r.report("x", "window", 0, 0.0, 1.0, parameters=(parameter,))).parameters
    assert estimate(kept) == said


def test_numbers_that_json_does_not_have_are_none(tmp_path):
    strange = r.changed(r.PARAMETERS[0], gain=np.inf, prior=np.nan)
    report = r.report("x", "window", 0, 0.0, 1.0, parameters=(strange,), gaps={"lost": np.nan}, loss=np.nan)
    path = tmp_path / "strange.rrd"
    record([report], path, sortie="strange")
    (kept,) = review(path).summary.reports
    assert kept.parameters[0].gain is None and kept.parameters[0].prior is None and kept.loss is None
    assert "not known" in markdown(kept) and "x" in told(review(path))


def test_review_prints_every_report_with_its_alarms_in_red(live):
    found = review(live[0])
    text = told(found)
    for said in (
        "level turn: 2 alarms, 1 channel over-confident", "phugoid: consistent", "Whole sortie: 2 alarms",
        "Window 0, between test points: consistent", "! [silence] of 12.0 s", "1.17 ± 0.18 deg", "0.86 .. 1.16",
        "580 / 3 / 1", "raise the turbulence sigma", "gyro z: 3.1 times its noise | vibration",
        "model trajectory,", "model flight_path,", "Windows of the trajectory,", "Windows of the flight path,",
    ):  # fmt: skip
        assert said in text, said
    assert "…" not in told(found, width=80)  # nothing is cut where a terminal is narrow
    out = StringIO()
    tell(found, Console(file=out, width=160, force_terminal=True, color_system="standard"))
    (line,) = {line for line in out.getvalue().splitlines() if "! [silence]" in line}
    assert "\x1b[1;31m" in line


def test_quiet_windows_of_a_long_flight_are_told_in_a_line(tmp_path):
    path = tmp_path / "long.rrd"
    many = [r.report("", "window", n, 2.0 * n, 2.0 * n + 2, **r.QUIET) for n in range(20)]
    record([*many, r.reports()[1]], path, sortie="long")
    text = told(review(path))
    assert text.count("between test points: consistent") == 20 and text.count("Channels") == 1


# -- the layout, and the picture --


def test_the_layout_has_a_page_per_model(live):
    with Reading(live[0]) as reading:
        entities = set(reading.chunks)
    made = layout(entities)
    there = names(made)
    tabs = {"Vehicle 1", "Trajectory", "Flight path", "Velocities", "Angles", "Air data and wind", "Biases"}
    assert tabs <= set(there)
    reports = ["Sortie report", "Test point report", "Window report", "Window figures"]
    assert [name for name in there if name in reports] == ["Window report", *reports]  # the trajectory's, then these
    air = ["Alpha, rad", "Beta, rad", "North wind, m/s", "East wind, m/s", "North gust, m/s"]
    assert [name for name in there if name in air] == air
    shown = views(made)
    assert shown["Pitch theta, rad"].contents == [
        "/v1/raw/attitude/pitch", "/v1/est/flight_path/live/theta", "/v1/est/flight_path/window/theta",
    ]  # fmt: skip
    assert shown["Alpha, rad"].contents == ["/v1/raw/flow_angles/alpha"]
    assert shown["North wind, m/s"].contents == [f"/v1/est/flight_path/{s}/wind_north" for s in ("live", "window")]
    assert shown["Test point report"].origin == "/v1/report/flight_path/test_point"
    drawn = {path for view in shown.values() for path in (view.contents if isinstance(view.contents, list) else [])}
    assert {f"/v1/est/flight_path/window/{name}" for name in r.NAMES} <= drawn


def test_a_flight_path_alone_needs_no_map(single):
    with Reading(single[0]) as reading:
        there = names(layout(set(reading.chunks)))
    assert "Vehicle 1" in there and "Trajectory" not in there and not any("Track" in name for name in there)


def test_the_trajectory_alone_is_laid_out_as_ever(tmp_path):
    record(f.flight(), tmp_path / "one.rrd", sortie="one", interval=None)
    with Reading(tmp_path / "one.rrd") as reading:
        there = names(layout(set(reading.chunks)))
    assert there[0] == "Vehicle 1" and "Window report" in there and not {"Flight path", "Trajectory"} & set(there)


def test_states_have_words_and_a_group():
    assert {group(name) for name in r.NAMES} == set(GROUPS) and group("tail_wagging") == OTHERS
    assert all(words(name) for name in r.NAMES) and words("altitude") == ""
    assert sorted(sorted(r.NAMES), key=order)[:8] == ["h", "u", "v", "w", "theta", "phi", "psi", "wind_north"]
    assert [role(name) for name in r.NAMES[:7]] == ["altitude", "", "", "", "pitch", "roll", "heading"]


def test_a_picture_of_each_model(live, single, tmp_path):
    found = review(live[0])
    plot(found, tmp_path / "f.png", model="flight_path")
    assert (tmp_path / "f.png").stat().st_size > 50_000
    with Reading(single[0]) as reading:
        picture = _Picture(None, review(single[0]), reading, 1, None)
        assert picture.model == "flight_path" and len(picture.windows) == 6  # what there is, when nothing is asked for
        assert _Picture(None, found, reading, 1, None).windows == picture.windows
    with pytest.raises(ValueError, match="no estimate of the model 'x': it has flight_path, trajectory"):
        plot(found, tmp_path / "x.png", model="x")
