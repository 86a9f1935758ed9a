"""Samples become estimates and windows, the same ones however the samples came."""

from __future__ import annotations

import itertools

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimator.geodesy import ECCENTRICITY2, SEMI_MAJOR
from estimator.models import trajectory
from estimator.models.trajectory import NAMES
from estimator.stage import Settings, estimate
from telemetry.messages import Altitude, Estimate, Event, Gnss, Mark, Message, Progress, Window

S = 1_000_000_000
RADIUS = 6_378_137.0


def flight(seconds=40.0, *, vehicle=1, boot=0, begin=1000.0, silence=(), seed=1) -> list[Message]:
    """Single samples in the order of arrival: north at 20 m/s, fixes at 5 Hz, pressure at 10 Hz."""
    random = np.random.default_rng(seed)
    out: list[tuple[int, Message]] = []
    for i in range(int(10 * seconds)):
        t = begin + 0.1 * i
        if any(a <= t - begin < b for a, b in silence):
            continue
        delay = random.exponential(0.02)
        common = {"vehicle": vehicle, "source": "0/1", "boot": boot}
        times = {"t": np.array([round(t * S)]), "t_rx": np.array([round((t + delay) * S)])}
        altitude = np.array([500.0 + random.normal() * 0.5])
        out.append(
            (
                times["t_rx"][0],
                Altitude(**common, **times, altitude=altitude + 30, pressure=np.ones(1), sigma=np.full(1, 0.5)),
            )
        )
        if i % 2 == 0:
            late = {"t": times["t"] - S // 20, "t_rx": times["t_rx"] + 1}
            latitude = np.array([0.8 + (20 * (t - begin) + random.normal()) / RADIUS])
            velocity = np.array([[20.0, 0.0, np.nan]]) + random.normal(size=(1, 3)) * 0.2
            out.append(
                (
                    late["t_rx"][0],
                    Gnss(
                        **common,
                        **late,
                        latitude=latitude,
                        longitude=np.array([0.2]),
                        altitude=altitude,
                        velocity=velocity,
                        sigma=np.array([[2.0, 3.0, 0.3]]),
                        satellites=np.array([9]),
                    ),
                )
            )
    return [message for _, message in sorted(out, key=lambda item: item[0])]


def mark(t: float, action: str, name: str, boot=0) -> Mark:
    when = np.array([round(t * S)])
    return Mark(vehicle=1, source="0/1", boot=boot, t=when, t_rx=when + 1, action=[action], name=[name])


def progress(messages, final=False) -> Progress:
    t = np.array([max(int(m.t_rx[-1]) for m in messages)])
    return Progress(vehicle=0, source="ingest", boot=0, t=t, t_rx=t, final=final)


def run(messages, cuts=None, scope="window", options=None) -> list[Message]:
    messages = sorted(messages, key=lambda m: int(m.t_rx[0]))
    edges = sorted({0, len(messages), *(cuts or [])})
    stream: list[Message] = []
    for a, b in itertools.pairwise(edges):
        stream += [*messages[a:b], progress(messages[:b], final=b == len(messages))]
    return list(estimate(stream, options or Settings(), scope=scope))


def told(messages, kind):
    return [m for m in messages if isinstance(m, kind)]


def live(messages, boot=0):
    found = [m for m in told(messages, Estimate) if m.boot == boot]
    return {
        name: np.concatenate([getattr(m, name) for m in found])
        for name in ("t", "t_rx", "mean", "std", "nis", "dof", "geodetic")
    }


def smoothed(messages, boot=0):
    found = [m for m in told(messages, Window) if m.boot == boot]
    return {name: np.concatenate([getattr(m, name) for m in found]) for name in ("t", "mean", "std", "geodetic")}


FLIGHT = flight()


@given(
    st.lists(st.integers(1, len(FLIGHT) - 1), max_size=30),
    st.sampled_from(["window", "sortie"]),
    st.sampled_from([None, 0.0, 0.02]),
)
@settings(max_examples=15, deadline=None)
def test_batches_do_not_change_a_bit(cuts, scope, least_lag):
    messages = [
        *FLIGHT,
        mark(1010, "start", "1"),
        mark(1022, "stop", "1"),
        *flight(20, boot=1, begin=1100, silence=[(5, 11)]),
    ]
    options = Settings(least_lag=least_lag)
    whole, parts = run(messages, None, scope, options), run(messages, cuts, scope, options)
    for boot in (0, 1):
        for a, b in ((live(whole, boot), live(parts, boot)), (smoothed(whole, boot), smoothed(parts, boot))):
            for name in a:
                np.testing.assert_array_equal(a[name], b[name], err_msg=name)
    about = ("boot", "number", "test_point", "reason", "measurements", "late", "anchors", "nis", "dof", "digest")
    assert [[getattr(m, a) for a in about] for m in told(parts, Window)] == [
        [getattr(m, a) for a in about] for m in told(whole, Window)
    ]


def test_every_live_step_is_smoothed_once_and_never_less_sure():
    out = run([*FLIGHT, mark(1015, "start", "1"), mark(1025, "stop", "1")])
    before, after = live(out), smoothed(out)
    np.testing.assert_array_equal(before["t"], after["t"])
    assert (after["std"] <= before["std"] * (1 + 1e-12)).all()
    assert np.median(after["std"][:, 5] / before["std"][:, 5]) < 0.8


def test_the_whole_sortie_knows_more_than_its_windows():
    by_window, whole = smoothed(run(FLIGHT)), smoothed(run(FLIGHT, scope="sortie"))
    assert (whole["std"] <= by_window["std"] * (1 + 1e-9)).all()
    assert (whole["std"][:250] < by_window["std"][:250]).any()
    np.testing.assert_array_equal(live(run(FLIGHT))["mean"], live(run(FLIGHT, scope="sortie"))["mean"])


def test_the_windows_of_a_sortie_are_one_smoothing():
    """However short the windows, the smoothing of the whole sortie is the same."""
    long = smoothed(run(FLIGHT, scope="sortie", options=Settings(window=1000)))
    short = smoothed(run(FLIGHT, scope="sortie", options=Settings(window=2)))
    np.testing.assert_allclose(short["mean"], long["mean"], atol=1e-7)
    np.testing.assert_allclose(short["std"], long["std"], rtol=1e-7)


def test_the_estimate_is_where_the_vehicle_is():
    out = smoothed(run(FLIGHT))
    late = out["t"] > 1010 * S
    north = 20 * (out["t"] / S - 1000.0)
    assert np.abs(out["mean"][late, 0] - north[late]).max() < 4 * np.median(out["std"][late, 0])
    assert np.abs(out["mean"][late, 1] - 20).max() < 1.0
    assert np.abs(out["geodetic"][late, 0] - (0.8 + north[late] / RADIUS)).max() * RADIUS < 10
    assert np.abs(out["mean"][late, NAMES.index("altimeter_bias")] - 30).max() < 8


def test_marks_make_test_points():
    out = run([*FLIGHT, mark(1010, "start", "12"), mark(1020, "stop", "12")])
    found = [(w.test_point, w.reason, round(w.t[0] / S, 1), round(w.t[-1] / S, 1)) for w in told(out, Window)]
    assert [f[:2] for f in found] == [("", "mark"), ("12", "mark"), ("", "end")]
    assert 1010 < found[1][2] <= 1010.1
    assert 1019.9 <= found[1][3] <= 1020


def test_a_test_point_is_not_cut_by_the_length_of_windows():
    out = run([*FLIGHT, mark(1005, "start", "1"), mark(1035, "stop", "1")], options=Settings(window=5))
    (point,) = [w for w in told(out, Window) if w.test_point]
    assert (point.t[-1] - point.t[0]) / S > 29


def test_a_stop_that_was_never_started_is_told_and_ignored():
    out = run([*FLIGHT, mark(1010, "stop", "7")])
    assert any("test point 7 stopped without having been started" in e.text[0] for e in told(out, Event))
    assert [w.reason for w in told(out, Window)] == ["length", "end"]


def test_windows_close_by_length():
    out = run(FLIGHT, options=Settings(window=10))
    assert [w.reason for w in told(out, Window)] == ["length", "length", "length", "end"]
    assert all((w.t[-1] - w.t[0]) / S <= 10 for w in told(out, Window))


def test_no_window_crosses_a_boot():
    out = run([*FLIGHT, *flight(20, boot=1, begin=1060)])
    assert [(w.boot, w.reason) for w in told(out, Window)] == [(0, "length"), (0, "reboot"), (1, "end")]
    assert all(w.number == 0 for w in told(out, Window) if w.boot == 1)
    first = live(out, boot=1)
    assert first["std"][0, 5] > 100, "the climb rate of another boot is not this one's"


def test_a_silence_closes_the_window_and_its_growing_uncertainty_is_seen():
    out = run(flight(30, silence=[(10, 20)]))
    found = live(out)
    gap = (found["t"] > 1010 * S) & (found["t"] < 1019.9 * S)
    assert gap.sum() >= 18
    assert (found["dof"][gap] == 0).all()
    assert (np.diff(found["std"][gap, 0]) > 0).all()
    assert [w.reason for w in told(out, Window)] == ["gap", "end"]
    (text,) = [e.text[0] for e in told(out, Event) if "without a measurement" in e.text[0]]
    assert text.startswith("10.1 s without a measurement: std(north)")
    middle = smoothed(out)["std"][gap, 0].max()
    assert 1 < middle < found["std"][gap, 0].max(), "bridged from both sides, and unsure in the middle"


def test_a_test_point_that_a_silence_cuts_stays_one():
    out = run([*flight(30, silence=[(10, 20)]), mark(1005, "start", "3"), mark(1025, "stop", "3")])
    assert [(w.test_point, w.reason) for w in told(out, Window)] == [
        ("", "mark"),
        ("3", "gap"),
        ("3", "mark"),
        ("", "end"),
    ]


def test_without_a_fix_nothing_is_estimated_and_that_is_said():
    out = run([m for m in FLIGHT if isinstance(m, Altitude)])
    assert not told(out, Estimate)
    assert not told(out, Window)
    assert "no satellite fix in boot 0: nothing to estimate from 400 samples" in told(out, Event)[0].text[0]


def test_samples_before_the_first_fix_are_not_used():
    early = [m for m in flight(40) if isinstance(m, Altitude) or m.t[0] > 1010 * S]
    assert live(run(early))["t"][0] >= 1009.9 * S


def test_late_samples_are_counted_where_they_were_missed():
    late = Altitude(
        vehicle=1,
        source="0/1",
        boot=0,
        t=np.array([1010 * S]),
        t_rx=np.array([1015 * S]),
        altitude=np.full(1, 9e3),
        pressure=np.ones(1),
        sigma=np.ones(1),
    )
    out, without = run([*FLIGHT, late]), run(FLIGHT)
    assert [w.late for w in told(out, Window)] == [{"altitude": 1}, {}]
    np.testing.assert_array_equal(live(out)["mean"], live(without)["mean"])


def test_input_that_breaks_off_closes_the_window():
    stream = [*FLIGHT, progress(FLIGHT)]
    out = list(estimate(stream))
    assert [w.reason for w in told(out, Window)][-1] == "end"
    assert told(out, Progress)[-1].final


def test_vehicles_do_not_touch_one_another():
    both = run([*FLIGHT, *flight(vehicle=2, seed=9, silence=[(3, 8)])])
    alone = run(FLIGHT)
    mine = [m for m in told(both, Estimate) if m.vehicle == 1]
    np.testing.assert_array_equal(np.concatenate([m.mean for m in mine]), live(alone)["mean"])


def test_consistent_errors_give_a_consistent_nis():
    """White errors of the stated size, and a model that says they are white."""
    quiet = trajectory.Settings(gnss_correlated_share=0.0, acceleration_horizontal=0.1, acceleration_vertical=0.1)
    found = live(run(flight(120, seed=5), options=Settings(trajectory=quiet)))
    known = found["t"] > 1005 * S
    ratio = found["nis"][known].sum() / found["dof"][known].sum()
    assert 0.3 < ratio < 1.2


def test_settings_refuse_what_they_do_not_know():
    with pytest.raises(msgspec.ValidationError, match="unknown field `windw`"):
        msgspec.convert({"windw": 3}, Settings)


NONSENSE = [
    *((f, v) for f in ("grid", "gap", "window", "test_point") for v in (0.0, -1.0, np.inf, np.nan)),
    *(("lag", v) for v in (-0.1, np.inf, np.nan)),
]
NONSENSE_OF_THE_MODEL = [
    *((f"prior_{f}", v) for f in ("position", "velocity", "altimeter_bias") for v in (0.0, -1.0, np.inf)),
    *((f, v) for f in ("acceleration_horizontal", "acceleration_vertical", "altimeter_drift") for v in (-1.0, np.inf)),
    *(("gnss_correlated_share", v) for v in (-0.1, 1.0, np.nan)),
    ("gnss_correlation_time", 0.0),
]


@pytest.mark.parametrize(("name", "value"), NONSENSE)
def test_settings_refuse_nonsense_by_name(name, value):
    with pytest.raises(msgspec.ValidationError, match=rf"\$\.{name}"):
        msgspec.convert({name: value}, Settings)


@pytest.mark.parametrize(("name", "value"), NONSENSE_OF_THE_MODEL)
def test_settings_of_the_model_refuse_nonsense_by_name(name, value):
    with pytest.raises(msgspec.ValidationError, match=rf"\$\.trajectory\.{name}"):
        msgspec.convert({"trajectory": {name: value}}, Settings)


# -- what must not end, blind or fool the estimate ---------------------------------------------------------------------


def moved(messages, by, *, after=-np.inf):
    """The same messages with their vehicle time `by` seconds later, from `after` on."""
    return [msgspec.structs.replace(m, t=m.t + round(by * S)) if m.t_rx[0] / S > after else m for m in messages]


def later(messages, by):
    """The same messages, sent and received `by` seconds later."""
    return [msgspec.structs.replace(m, t=m.t + round(by * S), t_rx=m.t_rx + round(by * S)) for m in messages]


def at(messages, latitude, longitude):
    """The same messages at another place."""
    return [
        msgspec.structs.replace(m, latitude=m.latitude + latitude, longitude=m.longitude + longitude)
        if isinstance(m, Gnss)
        else m
        for m in messages
    ]


def altitude(t, value=500.0, t_rx=None, vehicle=1) -> Altitude:
    return Altitude(
        vehicle=vehicle,
        source="0/1",
        boot=0,
        t=np.array([round(t * S)]),
        t_rx=np.array([round((t if t_rx is None else t_rx) * S)]),
        altitude=np.full(1, value),
        pressure=np.ones(1),
        sigma=np.full(1, 0.5),
    )


def said(messages, what):
    return [e for e in told(messages, Event) if what in e.text[0]]


def used(messages):
    return sum(sum(w.measurements.values()) for w in told(messages, Window))


def windows(messages):
    return [(w.number, w.test_point, w.reason) for w in told(messages, Window)]


SHORT = flight(12)
AWAY = [*SHORT, *at(later(flight(8, seed=2), 12), 0.1, 0.0)]
TROUBLE = {
    "wild": [*SHORT, altitude(4610.0, t_rx=1006.01)],
    "leap": moved(SHORT, 60, after=1006),
    "step back": [*moved(SHORT, -30, after=1006), mark(1002, "start", "1"), mark(1009.5, "stop", "1")],
    "nonsense": [*SHORT, altitude(1006.003, np.inf), altitude(1009.003, np.inf)],
    "long silence": [*SHORT, *later(flight(8, seed=2), 86_400), mark(1005, "start", "1")],
    "away": AWAY,
    "mark in a silence": [*flight(12, silence=[(4, 9)]), mark(1006, "start", "1")],
    "all": sorted(
        [
            *moved(AWAY, -30, after=1015),
            altitude(1005.003, np.inf),
            altitude(4610.0, t_rx=1005.35),
            altitude(4610.1, t_rx=1005.75),
            mark(1004, "start", "2"),
        ],
        key=lambda m: m.t_rx[0],
    ),
}


@given(
    st.sampled_from(sorted(TROUBLE)), st.lists(st.integers(1, 190), max_size=30), st.sampled_from(["window", "sortie"])
)
@settings(max_examples=40, deadline=None)
def test_batches_do_not_change_a_bit_of_trouble_either(trouble, cuts, scope):
    messages = TROUBLE[trouble]
    cuts = [c for c in cuts if c < len(messages)]
    whole, parts = run(messages, scope=scope), run(messages, cuts, scope=scope)
    for a, b in ((live(whole), live(parts)), (smoothed(whole), smoothed(parts))):
        for name in a:
            np.testing.assert_array_equal(a[name], b[name], err_msg=name)
    about = ("number", "test_point", "reason", "measurements", "late", "anchors", "nis", "dof", "digest")
    assert [[getattr(m, a) for a in about] for m in told(parts, Window)] == [
        [getattr(m, a) for a in about] for m in told(whole, Window)
    ]
    assert sorted((e.text, e.t[0], e.t_rx[0]) for e in told(parts, Event)) == sorted(
        (e.text, e.t[0], e.t_rx[0]) for e in told(whole, Event)
    )


def test_one_wild_time_is_left_out_and_told():
    out, without = run(TROUBLE["wild"]), run(SHORT)
    np.testing.assert_array_equal(live(out)["mean"], live(without)["mean"])
    assert len(said(out, "a sample of altitude 3604 s ahead of the others was left out")) == 1


def test_a_clock_that_leaps_ahead_and_stays_there_is_followed():
    out = run(TROUBLE["leap"])
    assert [w.reason for w in told(out, Window)] == ["gap", "end"]
    assert used(out) == used(run(SHORT))


def test_a_clock_that_steps_back_is_followed():
    out = run(TROUBLE["step back"])
    assert windows(out) == [(0, "", "mark"), (1, "1", "gap"), (2, "1", "mark"), (3, "", "end")]
    assert len(said(out, "the vehicle clock stepped back by 29.9 s: the estimate begins anew")) == 1
    assert used(out) >= used(run(SHORT)) - 2, "nothing but what came before the next fix is lost"


def test_a_burst_of_old_samples_is_late_and_nothing_more():
    burst = [altitude(1002 + 0.1 * i, 9e3, t_rx=1008.0) for i in range(8)]
    out, without = run([*SHORT, *burst]), run(SHORT)
    np.testing.assert_array_equal(live(out)["mean"], live(without)["mean"])
    assert [w.late for w in told(out, Window)] == [{"altitude": 8}]


def test_what_no_sensor_can_mean_is_left_out_and_said():
    out = run(TROUBLE["nonsense"])
    (first, count) = told([m for m in out if isinstance(m, Event) and m.level[0] == "warning"], Event)
    assert first.text[0] == "altitude: altitude of inf m is impossible: left out"
    assert first.t[0] == round(1006.003 * S)
    assert count.text[0] == "altitude: 2 samples with an impossible altitude left out"
    np.testing.assert_array_equal(live(out)["mean"], live(run(SHORT))["mean"])


@pytest.mark.parametrize("days", [0.01, 1, 365, 10_000])
def test_a_silence_too_long_to_be_bridged_begins_anew(days):
    out = run([*SHORT, *later(flight(8, seed=2), days * 86_400)])
    assert [w.reason for w in told(out, Window)] == ["gap", "end"]
    assert len(said(out, "s without a measurement: the estimate begins anew")) == 1
    assert (live(out)["dof"] > 0).all()


def test_windows_are_not_cut_by_their_length_inside_a_silence():
    out = run(flight(130, silence=[(10, 110)]), options=Settings(window=15))
    assert [w.reason for w in told(out, Window)] == ["gap", "length", "end"]
    assert all(sum(w.measurements.values()) > 20 for w in told(out, Window))


@pytest.mark.parametrize("cuts", [None, range(1, 170)])
@pytest.mark.parametrize("options", [Settings(), Settings(window=8)])
def test_what_a_silence_did_is_told_the_same_however_it_is_cut(cuts, options):
    for length in (3.0, 3.5, 4.0, 4.5, 5.0):
        messages = flight(17, silence=[(5, 5 + length)])
        (event,) = said(run(messages, cuts, options=options), "without a measurement")
        found = live(run(messages))
        before = found["std"][found["t"] < 1005 * S][-1, 0]
        assert f"std(north) {before:.1f} ->" in event.text[0]


def test_before_the_first_fix_nothing_is_kept_but_marks():
    early = [altitude(900 + 0.1 * i) for i in range(500)]
    out = run([*early, mark(940, "start", "1"), *SHORT], range(1, 500))
    assert {w.test_point for w in told(out, Window) if w.dof} == {"1"}
    np.testing.assert_array_equal(live(out)["mean"], live(run(SHORT))["mean"])


def test_the_time_of_having_had_no_fix_is_the_newest():
    out = run([altitude(1010.0, t_rx=1010.0), altitude(1005.0, t_rx=1011.0)])
    assert said(out, "no satellite fix")[0].t[0] == 1010 * S


def test_late_samples_of_an_empty_window_are_not_lost():
    fixes = [m for m in FLIGHT if isinstance(m, Gnss)]
    early = [m for m in fixes if m.t[0] < 1009 * S]
    rest = [m for m in fixes if m.t[0] > 1012 * S]
    late = [msgspec.structs.replace(fixes[5], t=fixes[5].t + 7, t_rx=np.array([1010 * S + i])) for i in (0, 2)]
    out = run(
        [*early, mark(1009.2, "start", "A"), late[0], mark(1009.4, "stop", "A"), late[1], *rest],
        options=Settings(gap=9),
    )
    assert sum(w.late.get("gnss", 0) for w in told(out, Window)) == 2


def test_far_from_the_origin_another_one_is_taken():
    out = run(AWAY)
    assert len(said(out, "origin")) == 4
    assert [w.reason for w in told(out, Window)] == ["gap", "end"]
    found = smoothed(out)
    assert abs(found["geodetic"][-1, 0] - (0.9 + 20 * 8 / RADIUS)) * RADIUS < 10


def test_one_fix_far_away_is_left_out():
    (fix,) = at(
        [SHORT[30] if isinstance(SHORT[30], Gnss) else next(m for m in SHORT[30:] if isinstance(m, Gnss))], 1, 1
    )
    out = run([msgspec.structs.replace(fix, t=fix.t + 1, t_rx=fix.t_rx + 1), *SHORT])
    np.testing.assert_array_equal(live(out)["mean"], live(run(SHORT))["mean"])
    assert len(said(out, "km from the origin was left out")) == 1


def test_a_fix_at_zero_is_none():
    nowhere = [
        msgspec.structs.replace(m, latitude=np.zeros(1), longitude=np.zeros(1)) if isinstance(m, Gnss) else m
        for m in flight(5, begin=990)
    ]
    out = run([*nowhere, *SHORT])
    assert len(said(out, "fixes at latitude 0, longitude 0 are none")) == 1
    np.testing.assert_array_equal(live(out)["mean"], live(run(SHORT))["mean"])


def test_far_to_the_east_the_errors_stay_consistent():
    """300 km along the parallel of 60 degrees, where north turns by 4 degrees."""
    n, speed, random = 1500, 200.0, np.random.default_rng(1)
    latitude, k = np.deg2rad(60.0), np.arange(n)
    normal = SEMI_MAJOR / np.sqrt(1 - ECCENTRICITY2 * np.sin(latitude) ** 2) + 500
    t = (1000 + k) * S
    fixes = Gnss(
        vehicle=1,
        source="0/1",
        boot=0,
        t=t,
        t_rx=t,
        latitude=latitude + random.normal(size=n) * 1.5 / RADIUS,
        longitude=speed * k / normal / np.cos(latitude) + random.normal(size=n) * 1.5 / RADIUS / np.cos(latitude),
        altitude=500 + 2 * random.normal(size=n),
        velocity=np.column_stack(
            [0.3 * random.normal(size=n), speed + 0.3 * random.normal(size=n), np.full(n, np.nan)]
        ),
        sigma=np.tile([1.5, 2, 0.3], (n, 1)),
        satellites=np.full(n, 9),
    )
    found = live(run([fixes]))
    first, last = (found["nis"][s].sum() / found["dof"][s].sum() for s in (slice(50, 400), slice(n - 400, n)))
    assert last == pytest.approx(first, rel=0.25)
