"""Sensors that say wrong things: the estimate never raises, the trajectory goes on, and the log names the suspect.

Wrong numbers without a warning are the worst outcome, so whatever spoils the flight path must be said somewhere.
"""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from estimator.stage import estimate
from telemetry.messages import AirData, Altitude, Attitude, Estimate, FlowAngles, Gnss, Imu, Report, Window
from tests.estimator.sorties import (
    S,
    batches,
    changed,
    column,
    errors,
    flown,
    messages_of,
    rows,
    run,
    said,
    seconds,
    settings,
    texts,
    told,
    without,
    worst,
)


def fly(spoil, scope="window", **changes):
    flight = flown()
    return run(batches(spoil(messages_of(flight))), settings(flight, **changes), scope)


def trajectory_is_whole(out):
    windows = told(out, Window, "trajectory")
    assert sum(len(w.t) for w in windows) > 350
    assert all(np.isfinite(w.mean).all() for w in windows)


def of(kind, name, change):
    return lambda messages: column(messages, kind, name, change)


def stuck(values, t):
    """The value of 15 s, from then on."""
    values[t > 15.0] = values[int(np.argmax(t > 15.0))]
    return values


def every(kind, n):
    return lambda messages: changed(messages, kind, lambda m: rows(m, np.arange(len(m.t)) % n == 0))


def gone(kind, first=-1e9, stop=1e9):
    return lambda messages: without(messages, kind, first, stop)


def jumping(velocity, t):
    velocity[(t > 20.0) & (t < 22.0)] += [15.0, 0.0, 0.0]
    return velocity


# -- what is missing ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("spoil", "reason"),
    [
        (gone(Imu), "no inertial samples"),
        (every(Imu, 25), "inertial samples at 4.0 Hz: at least 20 Hz are needed"),
        (gone(Altitude), "no altitude"),
        (of(Gnss, "velocity", lambda v, t: v * np.nan), "no satellite velocity"),
    ],
)
def test_where_no_flight_path_can_be_flown_the_trajectory_is_alone_and_the_log_says_why(spoil, reason):
    out = fly(spoil)
    assert not told(out, Estimate)
    assert any(f"the trajectory model goes on alone: {reason}" in text for text in texts(out, "info"))
    assert sum(len(w.t) for w in told(out, Window, "trajectory")) > 150


def test_the_missing_flight_path_is_a_warning_where_it_was_asked_for():
    flight = flown()
    out = run(batches(gone(Imu)(messages_of(flight))), settings(flight, stage={"model": "flight_path"}))
    assert any("no inertial samples" in text for text in texts(out, "warning"))


def test_without_a_fix_there_is_nothing_and_the_log_says_so():
    out = fly(gone(Gnss))
    assert not told(out, Estimate)
    assert any("no satellite fix" in text for text in texts(out, "warning"))


@pytest.mark.parametrize("length", [0.01, 0.3, 1.5])
def test_a_short_silence_of_the_inertial_sensors_is_bridged_and_said(length):
    flight = flown()
    out = fly(gone(Imu, 19.995, 19.995 + length))
    assert {m.reason for m in told(out, Window)} == {"mark", "end"}
    bridged = sum(r.gaps.get("interpolated", 0.0) for r in told(out, Report)[-1:])
    if length > 0.02:
        assert bridged == pytest.approx(length, abs=0.03)
        assert any("interpolated, with the variance of unknown manoeuvring" in text for text in texts(out, "warning"))
    else:
        assert not bridged
    assert worst(errors(flight, out, after=8.0))[0] < 3.0


def test_a_long_silence_of_the_inertial_sensors_ends_the_path_and_a_new_one_begins():
    flight = flown()
    out = fly(gone(Imu, 20.0, 24.0))
    assert any("begins anew: more than 2 s without inertial samples" in text for text in texts(out, "warning"))
    t = np.concatenate([seconds(m) for m in told(out, Estimate)])
    assert not ((t > 20.1) & (t < 24.5)).any()
    assert (t > 30.0).any()
    assert worst(errors(flight, out, after=8.0))[0] < 3.5


def test_when_the_inertial_sensors_fall_silent_for_good_the_path_ends_at_once():
    flight = flown()
    ended = None
    stream = batches(gone(Imu, 20.0)(messages_of(flight)), np.linspace(0.01, 0.99, 99))
    for message in estimate(stream, settings(flight)):
        if type(message).__name__ == "Progress":
            now = seconds(message)[-1]
        elif type(message).__name__ == "Event" and "without inertial samples" in message.text[0]:
            ended = now if ended is None else ended
    assert ended is not None
    assert ended < 24.0


# -- what is no number -------------------------------------------------------------------------------------------------

COLUMNS = {
    Imu: ("specific_force", "angular_rate"),
    Attitude: ("phi", "theta", "psi"),
    AirData: ("airspeed", "differential_pressure"),
    FlowAngles: ("alpha", "beta"),
    Altitude: ("altitude", "pressure", "sigma"),
    Gnss: ("latitude", "longitude", "altitude", "velocity", "sigma"),
}


@pytest.mark.parametrize(("kind", "name"), [(kind, name) for kind, names in COLUMNS.items() for name in names])
@pytest.mark.parametrize("value", [np.nan, np.inf, 1e300, -1e30])
def test_a_value_that_is_none_is_left_out_and_said(kind, name, value):
    """Two samples in a hundred."""
    flight = flown()

    def poison(values, t):
        values[np.random.default_rng(3).random(len(t)) < 0.02] = value
        return values

    out = fly(of(kind, name, poison))
    trajectory_is_whole(out)
    assert worst(errors(flight, out, after=8.0))[0] < 3.0
    if not (np.isnan(value) or kind is Gnss):
        assert any("is impossible: left out" in text for text in texts(out, "warning"))
    assert len(texts(out)) < 60


def test_a_sensor_that_says_nothing_but_nonsense_is_as_good_as_none():
    for kind, name in ((Imu, "specific_force"), (Gnss, "sigma")):
        out = fly(of(kind, name, lambda values, t: values * np.inf))
        assert not told(out, Estimate)
        assert len(texts(out)) < 10


# -- what is wrong -----------------------------------------------------------------------------------------------------

AXES = {"swapped": [1, 0, 2], "x": [-1, 1, 1], "y": [1, -1, 1], "z": [1, 1, -1]}
WRONG = {
    "frozen gyro": (of(Imu, "angular_rate", stuck), "gyro"),
    "frozen accelerometer": (of(Imu, "specific_force", stuck), "accelerometer"),
    "dead accelerometer": (of(Imu, "specific_force", lambda f, t: np.where((t > 15.0)[:, None], 0.0, f)), ""),
    "frozen altimeter": (of(Altitude, "altitude", stuck), "altimeter"),
    "frozen vane": (of(FlowAngles, "alpha", stuck), "vanes"),
    "frozen velocity": (of(Gnss, "velocity", stuck), "gnss"),
    "frozen heading": (of(Attitude, "psi", stuck), "psi"),
    "constant heading": (of(Attitude, "psi", lambda psi, t: 0.0 * psi), "psi"),
    "gyro in degrees": (of(Imu, "angular_rate", lambda w, t: np.rad2deg(w)), "turning"),
    "alpha in degrees": (of(FlowAngles, "alpha", lambda a, t: np.rad2deg(a)), "vanes"),
    "heading in degrees": (of(Attitude, "psi", lambda a, t: np.rad2deg(a)), "psi"),
    "altitude in feet": (of(Altitude, "altitude", lambda h, t: h / 0.3048), ""),
    "force in g": (of(Imu, "specific_force", lambda f, t: f / 9.80665), ""),
    "force upward": (of(Imu, "specific_force", lambda f, t: f * AXES["z"]), ""),
    "force swapped": (of(Imu, "specific_force", lambda f, t: f[:, AXES["swapped"]].copy()), ""),
    "gyro swapped": (of(Imu, "angular_rate", lambda w, t: w[:, AXES["swapped"]].copy()), ""),
    "gyro x reversed": (of(Imu, "angular_rate", lambda w, t: w * AXES["x"]), ""),
    "gyro z reversed": (of(Imu, "angular_rate", lambda w, t: w * AXES["z"]), ""),
    "heading reversed": (of(Attitude, "psi", lambda a, t: -a), "psi"),
    "east reversed": (of(Gnss, "velocity", lambda v, t: v * AXES["y"]), "velocity_east"),
    "north and east exchanged": (of(Gnss, "velocity", lambda v, t: v[:, AXES["swapped"]].copy()), "velocity"),
    "velocity in km/h": (of(Gnss, "velocity", lambda v, t: v * 3.6), "velocity"),
    "velocity jumps": (of(Gnss, "velocity", jumping), "velocity"),
    "saturated gyro": (of(Imu, "angular_rate", lambda w, t: np.clip(w, -0.05, 0.05)), ""),
}


@pytest.mark.parametrize("name", list(WRONG))
def test_what_spoils_the_path_is_said(name):
    spoil, suspect = WRONG[name]
    flight = flown()
    out = fly(spoil)
    trajectory_is_whole(out) if name != "altitude in feet" else None
    words = said(out)
    if told(out, Window):
        ratio, speed, angle = worst(errors(flight, out, after=8.0))
        if ratio > 4.0 and (speed > 1.0 or angle > np.deg2rad(2.0)):
            assert words, f"wrong by {ratio:.1f} sigma without a word"
    else:
        assert any("no flight path yet" in text for text in texts(out))
    if suspect:
        assert any(suspect in text for text in (*words, *texts(out))), words
    assert len(texts(out)) < 80
    assert all(np.isfinite(m.mean).all() for m in told(out, Estimate))


def test_airspeed_in_knots_is_named():
    def knots(m):
        nothing = np.full(len(m.t), np.nan)
        return msgspec.structs.replace(m, airspeed=m.airspeed / 0.514444, differential_pressure=nothing)

    flight = flown(plan="turn-record")
    out = run(batches(changed(messages_of(flight), AirData, knots)), settings(flight))
    assert any("airspeed" in text and "knots" in text for text in said(out))


def test_an_airspeed_that_is_held_is_no_measurement_and_is_named():
    def hold(m):
        return msgspec.structs.replace(
            m,
            airspeed=stuck(m.airspeed.copy(), seconds(m)),
            differential_pressure=stuck(m.differential_pressure.copy(), seconds(m)),
        )

    flight = flown()
    out = run(batches(changed(messages_of(flight), AirData, hold)), settings(flight))
    whole = run(messages_of(flight), settings(flight))
    used = [next(c.used for c in told(o, Report)[-1].channels if c.name == "airspeed") for o in (out, whole)]
    assert used[0] < 0.5 * used[1]
    assert worst(errors(flight, out, after=8.0))[0] < 3.0
    assert any(text.startswith("airspeed") and "stands at" in text for text in said(out))


# -- clocks ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("step", [-100, -5, 1, 5, 100])
def test_a_step_of_the_clock_is_survived_and_said(step):
    def leap(messages):
        for kind in COLUMNS:
            messages = changed(
                messages, kind, lambda m: msgspec.structs.replace(m, t=m.t + np.where(seconds(m) > 20.0, step * S, 0))
            )
        return messages

    out = fly(leap)
    assert said(out)
    assert sum(len(m.t) for m in told(out, Estimate)) > 600
    assert all(np.isfinite(m.mean).all() for m in told(out, Window))


def test_a_reboot_begins_a_path_of_its_own():
    def reboot(messages):
        out = []
        for m in messages:
            if type(m) in COLUMNS:
                later = seconds(m) > 20.0
                out += [rows(m, ~later), msgspec.structs.replace(rows(m, later), boot=1)]
        return out

    out = fly(reboot)
    assert {m.boot for m in told(out, Estimate)} == {0, 1}
    assert worst(errors(flown(), [m for m in out if m.boot == 0]))[0] < 4.0
