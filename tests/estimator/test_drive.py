"""Samples become steps: cut where something was measured, bridged where something is missing, whatever the batches."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis
from hypothesis import strategies as st

from estimator import atmosphere
from estimator.drive import IMPACT, IMU, MEASURED, STATIC, WEAK, WIDTH, Driver, Samples, merged
from estimator.kinematics import ATTITUDE, HEIGHT, VELOCITY
from estimator.models.flight_path import FlightPath, Settings
from estimator.synchronise import Rows

S = 1_000_000_000
MS = 1_000_000
PERIOD = 20 * MS
PLAIN = Settings(mode="G", heading=0.01, attitude=0.01, attitude_interval=0.0)


def rows(entries):
    """Samples of ``(milliseconds, {column: value})``."""
    entries = sorted(entries, key=lambda entry: entry[0])
    t = np.array([round(ms * MS) for ms, _ in entries], np.int64)
    z = np.full((len(t), WIDTH), np.nan)
    for row, (_, values) in enumerate(entries):
        for column, value in values.items():
            z[row, column] = value
    return Samples(t, t + 5, z, np.full_like(z, np.nan))


def imu(ms, value=1.0):
    return ms, {IMU + i: value * (i + 1) for i in range(6)}


def driver(settings=PLAIN, **changes):
    flight = FlightPath.of(settings, 0.8, 500.0)
    options = {"output": S // 25, "attitude_interval": round(settings.attitude_interval * 1e9)}
    return Driver(flight, 0, np.zeros(6), 0.02, **{**options, **changes})


def test_a_step_ends_at_every_sample_and_the_steps_fill_the_time():
    steps = driver().push(rows([imu(20), imu(40), (27, {MEASURED + HEIGHT: 5.0}), (33, {MEASURED + HEIGHT: 6.0})]))
    np.testing.assert_array_equal(steps.t // MS, [20, 27, 33, 40])
    np.testing.assert_allclose(steps.drive.dt, [0.02, 0.007, 0.006, 0.007])
    np.testing.assert_array_equal(steps.inertial, [True, False, False, True])
    np.testing.assert_array_equal(steps.drive.z[:, HEIGHT], [np.nan, 5.0, 6.0, np.nan])


def test_every_part_of_an_interval_has_its_mean_and_the_parts_keep_the_variance_of_the_integral():
    steps = driver().push(rows([imu(20, 3.0), imu(40, 7.0), (25, {MEASURED + HEIGHT: 5.0})]))
    np.testing.assert_array_equal(steps.drive.u[:, 0], [3.0, 7.0, 7.0])
    dt, q = steps.drive.dt, steps.drive.q[:, 0]
    np.testing.assert_allclose(dt[1:] @ np.diag(q[1:]) @ dt[1:], 0.02**2 * PLAIN.accelerometer**2)


def test_point_samples_are_taken_as_the_mean_of_both_ends():
    settings = Settings(mode="G", imu_input="point")
    steps = driver(settings).push(rows([imu(20, 2.0), imu(40, 6.0)]))
    np.testing.assert_array_equal(steps.drive.u[:, 0], [1.0, 4.0])


def test_nothing_is_a_step_before_an_inertial_sample_ends_it():
    d = driver()
    assert d.push(rows([(5, {MEASURED + HEIGHT: 1.0})])) is None
    assert len(d.rest().t) == 1
    assert len(d.push(rows([imu(20)])).t) == 2


@pytest.mark.parametrize(("span", "held"), [(20, False), (28, False), (40, True), (49, True)])
def test_up_to_two_and_a_half_sample_times_the_mean_is_held_and_four_times_its_variance(span, held):
    steps = driver().push(rows([imu(span)]))
    assert len(steps.t) == 1
    assert not steps.drive.bridged.any()
    assert steps.drive.q[0, 0] == pytest.approx((WEAK if held else 1.0) * PLAIN.accelerometer**2)


@pytest.mark.parametrize("span", [60, 500, 2000])
def test_up_to_two_seconds_are_interpolated_with_the_variance_of_unknown_manoeuvring(span):
    steps = driver().push(rows([imu(20, 0.0), imu(20 + span, 10.0)]))
    assert steps.drive.bridged[1:].all()
    assert not steps.drive.bridged[0]
    middle = 0.5 * (steps.t[1:] + steps.t[:-1]) * 1e-6
    np.testing.assert_allclose(steps.drive.u[1:, 0], 10.0 * (middle - 20) / span)
    dt, q = steps.drive.dt[1:], steps.drive.q[1:, 0]
    assert (dt**2 * q).sum() == pytest.approx(9.0 * 2 * 0.25 * span * 1e-3)
    assert (q > 50 * PLAIN.accelerometer**2).all()


def test_after_two_seconds_there_is_no_path():
    d = driver()
    steps = d.push(rows([imu(20), imu(2021), imu(2041)]))
    assert len(steps.t) == 1
    assert d.gap == 20 * MS
    assert d.push(rows([imu(2061)])) is None


def test_a_silence_is_noticed_by_what_other_sensors_say():
    d = driver()
    d.push(rows([imu(20)]))
    d.push(rows([(1900, {MEASURED + HEIGHT: 1.0})]))
    assert d.gap is None
    d.push(rows([(2100, {MEASURED + HEIGHT: 2.0})]))
    assert d.gap == 20 * MS


def test_a_value_said_again_is_no_measurement():
    values = [5.0, 5.0, 5.0, 6.0, 5.0]
    steps = driver().push(rows([(20 * i + 10, {MEASURED + HEIGHT: v}) for i, v in enumerate(values)] + [imu(100)]))
    z = steps.drive.z[:, HEIGHT]
    np.testing.assert_array_equal(z[~np.isnan(z)], [5.0, 6.0, 5.0])


def test_an_airspeed_said_again_is_none_even_if_the_static_pressure_has_changed():
    entries = [(20 * i + 10, {MEASURED: 40.0, IMPACT: 990.0, STATIC: 9e4 - i}) for i in range(4)]
    z = driver().push(rows([*entries, imu(90)])).drive.z[:, 0]
    assert (~np.isnan(z)).sum() == 1


def test_after_half_a_second_the_same_value_is_a_new_one():
    entries = [(10, {MEASURED + HEIGHT: 5.0}), (520, {MEASURED + HEIGHT: 5.0})]
    z = driver().push(rows([*entries, *(imu(20 * i) for i in range(1, 30))])).drive.z[:, HEIGHT]
    assert (~np.isnan(z)).sum() == 2


@pytest.mark.parametrize(("airspeed", "stall", "counts"), [(5.0, 0.0, False), (8.0, 0.0, True), (8.0, 25.0, False)])
def test_air_data_count_above_their_noise_and_the_stall(airspeed, stall, counts):
    settings = Settings(mode="G", airspeed=0.8, stall_speed=stall)
    z = driver(settings).push(rows([(10, {MEASURED: airspeed}), imu(20)])).drive.z[0, 0]
    assert np.isfinite(z) == counts


def test_the_airspeed_is_true_with_the_newest_static_pressure():
    static = 70_000.0
    impact = float(atmosphere.impact_pressure(np.array([50.0]))[0])
    d = driver()
    d.push(rows([(5, {STATIC: static}), imu(20)]))
    z = d.push(rows([(30, {MEASURED: 50.0}), (32, {IMPACT: impact}), imu(40)])).drive.z[:2, 0]
    np.testing.assert_allclose(z[0], atmosphere.true_airspeed(np.array([impact]), np.array([static]))[0])


def test_a_mode_uses_its_own_sensors():
    everything = {MEASURED + i: 30.0 + i for i in range(3)} | {MEASURED + i: 0.1 for i in range(ATTITUDE, HEIGHT)}
    everything |= {MEASURED + HEIGHT: 1.0} | {MEASURED + VELOCITY + i: 1.0 for i in range(3)}
    used = {}
    for mode in ("G", "I", "P"):
        z = driver(Settings(mode=mode, attitude=0.01, heading=0.01)).push(rows([(10, everything), imu(20)])).drive.z[0]
        used[mode] = set(np.flatnonzero(~np.isnan(z)).tolist())
    assert used == {"G": set(range(10)), "I": {3, 4, 5, 6, 7, 8, 9}, "P": {0, 1, 2, 3, 4, 6}}


def test_an_attitude_counts_once_in_its_interval():
    settings = Settings(mode="G", attitude=0.01, attitude_interval=1.0)
    entries = [(100 * i, {MEASURED + ATTITUDE: 0.01 * i}) for i in range(1, 25)]
    z = driver(settings).push(rows([*entries, *(imu(20 * i + 1) for i in range(1, 130))])).drive.z[:, ATTITUDE]
    assert (~np.isnan(z)).sum() == 3


def crowd(seed=1, count=400):
    random = np.random.default_rng(seed)
    times = np.unique(random.integers(1, 8000, count))
    entries = []
    for ms in times.tolist():
        if random.random() < 0.6:
            entries.append(imu(ms, float(random.normal())))
        else:
            columns = random.choice([MEASURED, MEASURED + 1, MEASURED + HEIGHT, STATIC, MEASURED + VELOCITY], 2)
            entries.append((ms, {int(c): float(random.integers(20, 24)) for c in columns}))
    return rows(entries)


def drive_in(samples, cuts):
    d, parts = driver(), []
    edges = [0, *sorted(cuts), len(samples.t)]
    for a, b in pairwise(edges):
        steps = d.push(samples.rows(slice(a, b)))
        parts += [] if steps is None else [steps]
    columns = [np.concatenate([p.t for p in parts]), np.concatenate([p.t_rx for p in parts])]
    return columns + [np.concatenate([p.drive[i] for p in parts]) for i in range(8)]


@given(cuts=st.lists(st.integers(0, 300), max_size=20))
@hypothesis(max_examples=20, deadline=None)
def test_batches_do_not_change_a_bit(cuts):
    samples = crowd()
    cuts = [min(cut, len(samples.t)) for cut in cuts]
    for a, b in zip(drive_in(samples, cuts), drive_in(samples, []), strict=True):
        np.testing.assert_array_equal(a, b)


@given(seed=st.integers(0, 100))
@hypothesis(max_examples=20, deadline=None)
def test_late_samples_put_in_are_the_samples_as_if_in_time(seed):
    samples = crowd()
    late = np.random.default_rng(seed).random(len(samples.t)) < 0.3
    order = np.random.default_rng(seed + 1).permutation(np.flatnonzero(late))
    kept = Samples(*(column[~late] for column in samples))
    missing = Rows(
        samples.t[order], samples.t_rx[order], np.zeros(len(order), np.int64), samples.z[order], samples.r[order]
    )
    whole, new = merged(kept, missing)
    assert new.all()
    for a, b in zip(whole, samples, strict=True):
        np.testing.assert_array_equal(a, b)


def test_what_is_there_already_is_not_replaced():
    samples = rows([imu(20, 1.0), (30, {MEASURED: 5.0})])
    again = rows([(30, {MEASURED: 9.0, MEASURED + HEIGHT: 7.0})])
    late = Rows(again.t, again.t_rx, np.zeros(1, np.int64), again.z, again.r)
    whole, new = merged(samples, late)
    assert new.all()
    assert whole.z[1, MEASURED] == 5.0
    assert whole.z[1, MEASURED + HEIGHT] == 7.0
    _, new = merged(whole, late)
    assert not new.any()


def test_a_copy_goes_its_own_way():
    d = driver()
    d.push(rows([imu(20), (25, {MEASURED + HEIGHT: 1.0})]))
    other = d.copy()
    a = d.push(rows([imu(40, 5.0)]))
    b = other.push(rows([imu(40, 5.0)]))
    np.testing.assert_array_equal(a.drive.z, b.drive.z)
    assert len(other.push(rows([imu(60)])).t) == 1
    assert len(d.push(rows([imu(60)])).t) == 1
