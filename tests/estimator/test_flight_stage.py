"""The flight path beside the trajectory: the same however it came, told in windows and reports, with late samples."""

from __future__ import annotations

from itertools import pairwise

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis
from hypothesis import strategies as st

import sims
from estimator.stage import estimate
from telemetry.messages import AirData, Altitude, Estimate, Event, FlowAngles, Gnss, Imu, Mark, Progress, Report, Window
from tests.estimator.sorties import (
    BEGIN,
    S,
    batches,
    changed,
    column,
    delayed,
    errors,
    everything,
    flown,
    mark,
    messages_of,
    rows,
    run,
    seconds,
    settings,
    texts,
    told,
    without,
    worst,
)

CUTS = st.lists(st.floats(0.0, 1.0), max_size=12)


def late_radio(messages, share=0.03):
    """Of every sensor a few samples come up to three seconds late."""
    random = np.random.default_rng(2)
    for kind in (Imu, AirData, FlowAngles, Altitude, Gnss):
        messages = delayed(
            messages, kind, lambda t: 0.02 + 3.0 * random.random(len(t)) * (random.random(len(t)) < share)
        )
    return messages


def frozen(messages):
    """The gyros stand still from 20 s on: the path fails again and again."""

    def freeze(rate, t):
        rate[t > 20.0] = rate[int(np.argmax(t > 20.0))]
        return rate

    return column(messages, Imu, "angular_rate", freeze)


def broken(messages):
    """Two short gaps, a long one, and numbers that are none."""
    messages = without(without(without(messages, Imu, 12.0, 12.8), Imu, 18.0, 18.1), Imu, 25.0, 29.0)

    def spoil(force, t):
        force[(t > 34.0) & (t < 34.02)] = np.inf
        return force

    return column(messages, Imu, "specific_force", spoil)


SPOILT = {"clean": lambda messages: messages, "late": late_radio, "frozen": frozen, "broken": broken}
WHOLE = {}


@pytest.mark.parametrize("scope", ["window", "sortie"])
@pytest.mark.parametrize("how", list(SPOILT))
@given(cuts=CUTS)
@hypothesis(max_examples=3, deadline=None)
def test_batches_do_not_change_a_bit(how, scope, cuts):
    flight = flown()
    messages, options = SPOILT[how](messages_of(flight)), settings(flight, window=10.0)
    if (how, scope) not in WHOLE:
        WHOLE[how, scope] = everything(run(batches(messages), options, scope))
    for a, b in zip(everything(run(batches(messages, cuts), options, scope)), WHOLE[how, scope], strict=True):
        assert a == b


def test_the_estimates_do_not_depend_on_anything_later():
    flight = flown()
    messages, options = messages_of(flight), settings(flight)
    whole = told(run(messages, options), Estimate)
    part = told(run(batches(without_after(messages, 25.0)), options), Estimate)
    mean = np.concatenate([m.mean for m in whole])
    t_part, mean_part = (np.concatenate([getattr(m, name) for m in part]) for name in ("t", "mean"))
    assert len(t_part) > 500
    np.testing.assert_array_equal(mean_part, mean[: len(t_part)])


def without_after(messages, second):
    for kind in {type(m) for m in messages} - {Progress}:
        messages = without(messages, kind, second, 1e9)
    return messages


def test_the_estimates_do_not_depend_on_the_scope():
    flight = flown()
    messages, options = late_radio(messages_of(flight)), settings(flight)
    by_window, whole = (told(run(batches(messages), options, scope), Estimate) for scope in ("window", "sortie"))
    for name in ("t", "mean", "std"):
        a, b = (np.concatenate([getattr(m, name) for m in out]) for out in (by_window, whole))
        np.testing.assert_allclose(b, a, rtol=1e-8, atol=1e-8)


def test_a_window_is_told_when_it_closes_and_the_sortie_at_the_end():
    flight = flown()
    messages = batches(messages_of(flight), np.linspace(0.02, 0.98, 49))
    for scope in ("window", "sortie"):
        delays, now = [], 0
        for message in estimate(messages, settings(flight), scope=scope):
            if isinstance(message, Progress):
                now = int(message.t[-1])
            elif isinstance(message, Window) and message.model == "flight_path":
                delays.append((now - int(message.t[-1])) * 1e-9)
        if scope == "window":
            assert max(delays[:-1]) < 2.0
        else:
            assert delays[0] > 30.0


def test_marks_cut_the_windows_at_their_times():
    flight = flown()
    out = run(messages_of(flight), settings(flight))
    marks = {
        (action, name): int(t)
        for m in messages_of(flight)
        if isinstance(m, Mark)
        for t, action, name in zip(m.t, m.action, m.name, strict=True)
    }
    for name in ("1", "2"):
        (window,) = [m for m in told(out, Window) if m.test_point == name]
        assert marks["start", name] < window.t[0] <= marks["start", name] + S // 10
        assert marks["stop", name] - S // 10 < window.t[-1] <= marks["stop", name]
        assert window.reason == "mark"


def test_windows_go_on_where_the_one_before_ended():
    flight = flown()
    windows = told(run(messages_of(flight), settings(flight)), Window)
    assert [w.number for w in windows] == list(range(len(windows)))
    for before, after in pairwise(windows):
        assert 0 < after.t[0] - before.t[-1] <= S // 10


def test_a_test_point_has_its_report_with_verdicts_and_the_sortie_its_own():
    flight = flown()
    for scope in ("window", "sortie"):
        reports = told(run(messages_of(flight), settings(flight), scope), Report)
        assert [(r.scope, r.test_point) for r in reports] == [("test point", "1"), ("test point", "2"), ("sortie", "")]
        for report in reports:
            assert {c.name for c in report.channels} >= {"airspeed", "alpha", "beta", "height", "velocity_north"}
            assert all(c.verdict and c.why for c in report.channels)
            assert all(p.verdict and p.why for p in report.parameters)
            smoothed = {s.name: (s.filtered, s.smoothed) for s in report.states}
            assert all(after <= before * (1 + 1e-9) for before, after in smoothed.values())


def test_the_path_is_where_the_aircraft_is():
    flight = flown()
    for scope in ("window", "sortie"):
        ratio, speed, angle = worst(errors(flight, run(messages_of(flight), settings(flight), scope), after=8.0))
        assert ratio < 2.5
        assert speed < 0.6
        assert angle < np.deg2rad(1.0)


def test_smoothing_is_never_less_sure_than_the_filter():
    flight = flown()
    out = run(messages_of(flight), settings(flight))
    live = {int(t): s for m in told(out, Estimate) for t, s in zip(m.t, m.std, strict=True)}
    for window in told(out, Window):
        before = np.array([live[int(t)] for t in window.t])
        assert (window.std <= before * (1 + 1e-6)).all()


# -- late samples ------------------------------------------------------------------------------------------------------


def test_late_samples_of_the_open_window_are_smoothed_as_if_they_had_come_in_time():
    flight = flown()
    clean = messages_of(flight)
    late = delayed(clean, Gnss, lambda t: np.where((t > 3.0) & (t < 6.0), 1.5, 0.0))
    in_time, out = (run(batches(m), settings(flight)) for m in (clean, late))
    assert any("late samples put in" in text and "gnss" in text for text in texts(out))
    for a, b in zip(told(in_time, Window), told(out, Window), strict=True):
        assert not b.late
        assert b.measurements == a.measurements
        np.testing.assert_allclose(b.mean, a.mean, rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(b.std, a.std, rtol=1e-6)


def test_the_live_estimate_goes_on_from_the_window_with_its_late_samples():
    flight = flown()
    clean = messages_of(flight)
    late = delayed(clean, Gnss, lambda t: np.where((t > 3.0) & (t < 7.0), 0.8, 0.0))
    a, b = (told(run(batches(m), settings(flight)), Estimate) for m in (clean, late))
    t, a, b = (
        np.concatenate([m.t for m in a]),
        np.concatenate([m.mean for m in a]),
        np.concatenate([m.mean for m in b]),
    )
    inside, after = (t > BEGIN + 4 * S) & (t < BEGIN + 7 * S), t > BEGIN + 9 * S
    assert np.abs(a[inside] - b[inside]).max() > 1e-3
    np.testing.assert_allclose(b[after], a[after], rtol=1e-6, atol=1e-6)


def test_late_inertial_samples_fill_the_gap_they_left():
    flight = flown()
    clean = messages_of(flight)
    late = delayed(clean, Imu, lambda t: np.where((t > 5.0) & (t < 5.4), 1.2, 0.0))
    a, b = (told(run(batches(m), settings(flight)), Window) for m in (clean, late))
    np.testing.assert_allclose(b[0].mean[-1], a[0].mean[-1], rtol=1e-6, atol=1e-6)
    assert b[0].measurements == a[0].measurements


def test_what_comes_after_its_window_is_counted_and_left_out():
    flight = flown()
    clean = messages_of(flight)
    late = delayed(clean, Gnss, lambda t: np.where((t > 5.9) & (t < 7.1), 6.0, 0.0))
    dropped = run(batches(without(clean, Gnss, 5.9, 7.1)), settings(flight))
    out = run(batches(late), settings(flight))
    assert sum(sum(w.late.values()) for w in told(out, Window)) == 6
    assert {name for w in told(out, Window) for name in w.late} == {"gnss"}
    for a, b in zip(told(dropped, Window), told(out, Window), strict=True):
        np.testing.assert_array_equal(b.mean, a.mean)


def test_what_is_said_twice_is_neither_late_nor_new():
    flight = flown()
    clean = messages_of(flight)

    def twice(m):
        again = msgspec.structs.replace(m, t_rx=m.t_rx + 2 * S)
        return [m, again]

    doubled = [x for m in clean if not isinstance(m, (Progress, Mark)) for x in twice(m)]
    doubled += [m for m in clean if isinstance(m, Mark)]
    out, once = run(batches(doubled), settings(flight)), run(batches(clean), settings(flight))
    assert not any("late" in text for text in texts(out))
    for a, b in zip(told(once, Window), told(out, Window), strict=True):
        np.testing.assert_array_equal(b.mean, a.mean)


def test_shuffled_samples_make_the_same_path():
    flight = flown()
    clean = messages_of(flight)
    random = np.random.default_rng(1)
    shuffled = clean
    for kind in (Imu, AirData, FlowAngles, Altitude, Gnss):
        shuffled = delayed(shuffled, kind, lambda t: 0.25 * random.random(len(t)) * (t > 2.0))
    for a, b in zip(*(told(run(batches(m), settings(flight)), Window) for m in (clean, shuffled)), strict=True):
        np.testing.assert_array_equal(b.mean, a.mean)


# -- loss --------------------------------------------------------------------------------------------------------------


def lossy(messages, kind, share):
    random = np.random.default_rng(3)
    return changed(messages, kind, lambda m: rows(m, random.random(len(m.t)) >= share))


def test_a_report_counts_the_samples_of_every_sensor_that_did_not_come():
    flight = flown()
    messages = messages_of(flight)
    for kind in (Imu, AirData, FlowAngles, Altitude, Gnss):
        messages = lossy(messages, kind, 0.1)
    for report in told(run(batches(messages), settings(flight)), Report):
        assert report.loss == pytest.approx(0.1, abs=0.03)
    for report in told(run(messages_of(flight), settings(flight)), Report):
        assert report.loss < 0.01
        assert not report.loss_effect


def test_what_a_loss_costs_is_told_by_state():
    flight = flown()
    gone = run(batches(without(messages_of(flight), Gnss, 9.0, 16.0)), settings(flight))
    report = told(gone, Report)[0]
    assert report.test_point == "1"
    assert report.loss > 0.01
    assert set(report.loss_effect) == {"h", "u", "v", "w", "theta", "phi", "psi"}
    assert report.loss_effect["u"] > 1.5
    assert all(factor > 0.98 for factor in report.loss_effect.values())
    assert report.loss_effect["u"] > report.loss_effect["h"]


def test_the_price_of_a_loss_agrees_with_the_flight_that_lost_nothing():
    """The oracle knows more at the beginning of the test point, so the factors agree roughly."""
    flight = flown()
    whole, gone = (
        run(batches(m), settings(flight)) for m in (messages_of(flight), without(messages_of(flight), Gnss, 9.0, 16.0))
    )
    (before,), (after,) = ([w for w in told(out, Window) if w.test_point == "1"] for out in (whole, gone))
    report = told(gone, Report)[0]
    for name in ("u", "h"):
        i = before.names.index(name)
        raised = np.median(after.std[:, i]) / np.median(before.std[:, i])
        assert report.loss_effect[name] == pytest.approx(raised, rel=0.5)


# -- beginnings and ends -----------------------------------------------------------------------------------------------


def test_an_unset_delay_of_the_fixes_is_found_over_a_sortie_and_taken_off():
    flight = flown(plan=sims.PLANS["turn-record"], latencies=frozendict({"gnss": 0.25}))
    out = run(messages_of(flight), settings(flight, gnss_delay=None), "sortie")
    (start,) = [text for text in texts(out) if "satellite fixes taken as" in text]
    assert 0.2 < float(start.split("taken as ")[1].split(" s")[0]) < 0.3
    untouched = run(messages_of(flight), settings(flight), "sortie")
    assert worst(errors(flight, out, after=8.0))[0] < 0.4 * worst(errors(flight, untouched, after=8.0))[0]
    assert any("behind the inertial sensors" in finding for finding in told(untouched, Report)[-1].findings)


def test_a_configured_delay_of_the_fixes_is_taken_off():
    flight = flown(latencies=frozendict({"gnss": 0.25}))
    right, wrong = (run(messages_of(flight), settings(flight, gnss_delay=d)) for d in (0.25, 0.0))
    nis = [
        max(c.nis for c in told(out, Report)[-1].channels if c.name.startswith("velocity")) for out in (right, wrong)
    ]
    assert nis[0] < 1.5
    assert nis[1] > 2.0 * nis[0]


class frozendict(dict):
    """A dict to be cached by."""

    def __hash__(self):
        return hash(tuple(sorted(self.items())))


def test_a_delay_of_the_air_data_is_taken_off():
    flight = flown()

    def late(m):
        return msgspec.structs.replace(m, t=m.t + S // 5, t_rx=m.t_rx + S // 5)

    messages = changed(messages_of(flight), AirData, late)
    a, b = run(messages_of(flight), settings(flight)), run(batches(messages), settings(flight, air_delay=0.2))
    np.testing.assert_allclose(told(b, Window)[1].mean[-1], told(a, Window)[1].mean[-1], rtol=1e-9, atol=1e-9)


def test_without_air_data_the_path_is_that_of_the_ground_alone():
    flight = flown()
    out = run(batches(without(without(messages_of(flight), AirData), FlowAngles)), settings(flight))
    assert any("mode I" in text for text in texts(out))
    assert "wind_north" not in told(out, Window)[0].names
    assert worst(errors(flight, out, after=8.0))[0] < 3.0


def test_air_data_that_come_later_are_used_from_the_next_window_on():
    flight = flown()
    messages = without(without(messages_of(flight), AirData, -1.0, 20.0), FlowAngles, -1.0, 20.0)
    out = run(batches(messages), settings(flight, window=8.0))
    assert any("air data have come" in text for text in texts(out, "warning"))
    assert "wind_north" in told(out, Window)[-1].names


def test_without_a_heading_it_starts_from_the_track():
    flight = flown()

    messages = [m for m in messages_of(flight) if type(m).__name__ != "Attitude"]
    out = run(batches(messages), settings(flight))
    assert any("level from the specific force, heading from the track" in text for text in texts(out))
    assert worst(errors(flight, out, after=8.0))[0] < 3.0


def test_two_vehicles_and_two_boots_have_paths_of_their_own():
    flight = flown()
    one = [m for m in messages_of(flight) if not isinstance(m, Progress)]
    two = [msgspec.structs.replace(m, vehicle=2) for m in one]
    alone = run(batches(one), settings(flight))
    both = run(batches([*one, *two]), settings(flight))
    for vehicle in (1, 2):
        mine = [m for m in told(both, Window) if m.vehicle == vehicle]
        for a, b in zip(told(alone, Window), mine, strict=True):
            np.testing.assert_array_equal(a.mean, b.mean)
    again = [msgspec.structs.replace(m, boot=1, t=m.t + 60 * S, t_rx=m.t_rx + 60 * S) for m in one]
    twice = run(batches([*one, *again]), settings(flight))
    assert {m.boot for m in told(twice, Window)} == {0, 1}
    assert [m.reason for m in told(twice, Window) if m.boot == 0][-1] == "reboot"


def test_the_trajectory_does_not_know_of_the_flight_path():
    flight = flown()
    messages = frozen(messages_of(flight))
    both = run(batches(messages), settings(flight))
    alone = run(batches(messages), settings(flight, stage={"model": "trajectory"}))
    for a, b in zip(told(both, Window, "trajectory"), told(alone, Window, "trajectory"), strict=True):
        np.testing.assert_array_equal(a.mean, b.mean)
    assert not told(alone, Window)
    assert told(both, Window)


def test_a_lock_out_does_not_flood_the_log():
    flight = flown()
    out = run(batches(frozen(messages_of(flight))), settings(flight))
    assert 1 <= sum("doubted" in text for text in texts(out)) <= 12
    assert len(told(out, Event)) < 60
    assert any("no other before" in text for text in texts(out, "warning"))


def test_a_mark_may_come_at_any_time():
    flight = flown()
    quiet = [m for m in messages_of(flight) if not isinstance(m, Mark)]
    marks = [mark(0.1, "start", "a"), mark(0.2, "stop", "a"), mark(10.0, "start", "b"), mark(41.9, "stop", "x")]
    out = run(batches([*quiet, *marks]), settings(flight))
    assert [w.test_point for w in told(out, Window)][-1] == "b"
    assert seconds(told(out, Window)[0])[0] < 3.0
