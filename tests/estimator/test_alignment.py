"""A flight path begins where the sensors allow it, with the safest attitude and heading there are."""

from __future__ import annotations

import math

import numpy as np
import pytest

from estimator import alignment, atmosphere
from estimator.drive import IMU, MEASURED, STATIC, WIDTH, Samples
from estimator.kinematics import ATTITUDE, HEIGHT, VELOCITY
from estimator.models.flight_path import FlightPath, Settings
from tests.estimator.flights import from_angles

S = 1_000_000_000
G = 9.80665


def samples(
    *,
    hertz=50,
    seconds=2.0,
    theta=0.05,
    phi=0.0,
    psi=0.6,
    speed=30.0,
    rate=(0.0, 0.0, 0.0),
    gain=0.0,
    airspeed=None,
    attitude=None,
    age=0.0,
    height=500.0,
    fixes=True,
):
    """Straight or turning flight: `attitude` is what is measured of it, None for none, `age` how long ago, s."""
    t = np.arange(0, round(seconds * S) + 1, S // hertz) + 100 * S
    z = np.full((len(t), WIDTH), np.nan)
    r = from_angles(theta, phi, psi)
    now = speed + gain * (t - t[-1]) * 1e-9
    z[:, IMU : IMU + 3] = r.T @ [0.0, 0.0, -G]
    z[:, IMU : IMU + 3] += np.cross(rate, [speed, 0.0, 0.0]) + np.array([gain, 0.0, 0.0])
    z[:, IMU + 3 : IMU + 6] = rate
    if fixes:
        z[::10, MEASURED + VELOCITY : MEASURED + VELOCITY + 3] = np.stack(
            [now * math.cos(psi), now * math.sin(psi), 0.0 * now], axis=1
        )[::10]
    if attitude is not None:
        known = t <= t[-1] - round(age * S)
        z[known, MEASURED + ATTITUDE : MEASURED + ATTITUDE + 3] = attitude
    z[:, MEASURED + HEIGHT] = height
    z[:, STATIC] = atmosphere.SEA_LEVEL_PRESSURE
    if airspeed is not None:
        z[:, MEASURED] = airspeed
    return Samples(t, t, z, np.full_like(z, np.nan))


def find(settings=None, **changes):
    flight = FlightPath.of(settings or Settings(mode="G", earth="flat"), 0.8, 500.0)
    recent = samples(**changes)
    return alignment.find(recent, flight, alignment.true_airspeed(recent))


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"seconds": 0.5}, "inertial samples for less than a second"),
        ({"hertz": 5}, "inertial samples at 5.0 Hz: at least 20 Hz are needed"),
        ({"fixes": False}, "no satellite velocity"),
        ({"height": np.nan}, "no altitude"),
        ({"speed": 2.0}, "no heading, and too slow for a track"),
        ({"rate": (0.8, 0.0, 0.0)}, "no attitude, and turning or accelerating too much to level"),
        ({"rate": (0.0, 1.0, 0.0), "speed": 30.0}, "no start while manoeuvring hard"),
    ],
)
def test_what_is_missing_is_said(changes, reason):
    assert reason in find(**changes)


@pytest.mark.parametrize(("theta", "phi", "psi"), [(0.0, 0.0, 0.0), (0.1, -0.05, 2.0), (-0.2, 0.3, -3.0)])
def test_in_straight_flight_it_levels_and_takes_the_heading_from_the_track(theta, phi, psi):
    start = find(theta=theta, phi=phi, psi=psi)
    assert start.text == "level from the specific force, heading from the track"
    for name, true in (("theta", theta), ("phi", phi), ("psi", psi)):
        assert start.values[name] == pytest.approx(true, abs=1e-9)


def test_the_velocity_is_turned_into_body_axes():
    start = find(theta=0.1, psi=0.5, attitude=(0.1, 0.0, 0.5))
    assert start.values["u"] == pytest.approx(30.0 * math.cos(0.1))
    assert start.values["w"] == pytest.approx(30.0 * math.sin(0.1))
    assert start.values["v"] == pytest.approx(0.0, abs=1e-9)


def test_a_measured_attitude_is_taken_where_it_is_fresh_and_agrees_with_gravity():
    start = find(theta=0.08, attitude=(0.1, 0.02, 0.6))
    assert start.text == "measured attitude"
    assert start.values["theta"] == pytest.approx(0.1)


def test_an_old_attitude_is_none():
    start = find(theta=0.08, attitude=(0.3, 0.3, 0.6), age=1.0)
    assert start.text.startswith("level")
    assert start.values["theta"] == pytest.approx(0.08, abs=1e-6)


@pytest.mark.parametrize("measured", [(0.6, 0.0, 0.6), (0.0, -0.7, 0.6), (0.08, math.pi, 0.6)])
def test_an_attitude_that_contradicts_gravity_is_not_believed_and_that_is_said(measured):
    start = find(theta=0.08, attitude=measured)
    assert start.doubtful
    assert "not believed" in start.text
    assert start.values["theta"] == pytest.approx(0.08, abs=1e-6)
    assert start.values["phi"] == pytest.approx(0.0, abs=1e-6)


def test_angles_in_degrees_are_no_attitude():
    start = find(theta=0.08, attitude=(4.6, 12.0, 34.0))
    assert start.text.startswith("level")


def test_in_a_turn_the_centripetal_force_is_taken_off_and_level_is_less_sure():
    phi, speed = 0.5, 30.0
    turn = G * math.tan(phi) / speed
    rate = (0.0, turn * math.sin(phi), turn * math.cos(phi))
    settings = Settings.mems(mode="G", earth="flat")
    start = find(settings, theta=0.0, phi=phi, rate=rate, speed=speed)
    assert start.values["phi"] == pytest.approx(phi, abs=0.02)
    flight = FlightPath.of(settings, 0.8, 500.0)
    assert start.sigma[flight.names.index("phi")] > settings.prior_attitude


def test_a_good_attitude_is_believed_in_a_take_off_run():
    """3 m/s2 would be 17 deg of pitch."""
    start = find(theta=0.0, attitude=(0.0, 0.0, 0.6), gain=3.0)
    assert start.text == "measured attitude"
    assert not start.doubtful


def test_a_heading_that_the_filter_does_not_use_is_no_surer_than_ten_degrees():
    flight = FlightPath.of(Settings(mode="G", prior_heading=0.01), 0.8, 500.0)
    recent = samples(attitude=(0.05, 0.0, 0.6))
    start = alignment.find(recent, flight, alignment.true_airspeed(recent))
    assert start.sigma[flight.names.index("psi")] == pytest.approx(math.radians(10.0))


def test_the_wind_is_what_is_left_between_air_and_ground_speed():
    start = find(theta=0.0, psi=0.0, airspeed=25.0, attitude=(0.0, 0.0, 0.0))
    assert start.values["wind_north"] == pytest.approx(5.0, abs=0.1)
    assert start.values["wind_east"] == pytest.approx(0.0, abs=1e-6)


def test_an_absurd_wind_is_not_begun_with():
    assert "wind_north" not in find(theta=0.0, psi=0.0, airspeed=150.0, attitude=(0.0, 0.0, 0.0)).values


def test_with_the_sensors_of_the_paper_an_airspeed_is_needed_and_no_fix():
    paper = Settings(mode="P", attitude=0.002)
    assert find(paper, fixes=False, attitude=(0.05, 0.0, 0.6)) == "no airspeed"
    start = find(paper, fixes=False, attitude=(0.05, 0.0, 0.6), airspeed=40.0)
    assert start.values["u"] == pytest.approx(40.0, rel=0.01)
