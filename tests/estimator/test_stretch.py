"""A stretch of flight is filtered in any number of calls, wound back, smoothed from any amount of memory."""

from __future__ import annotations

import os
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis
from hypothesis import strategies as st

from estimator import stretch as module
from estimator.drive import IMU, MEASURED, WIDTH, Driver, Samples
from estimator.extended import Drive
from estimator.kinematics import HEIGHT, VELOCITY, M
from estimator.models.flight_path import FlightPath, Settings
from estimator.stretch import BLOCK, KEPT, Diverged, Stretch

S = 1_000_000_000
ROOT = Path(__file__).parents[2]
FLIGHT = FlightPath.of(Settings.mems(mode="G", earth="flat"), 0.8, 500.0)
START = {"h": 500.0, "u": 50.0, "theta": 0.05, "psi": 0.3}


def drive(count, seed=1):
    """Gentle flight with fixes at 5 Hz and air data at 10 Hz."""
    random = np.random.default_rng(seed)
    dt = np.full(count, 0.02)
    u = np.tile([0.5, 0.0, -9.8, 0.0, 0.0, 0.0], (count, 1)) + random.normal(size=(count, 6)) * [0.1] * 3 + 0.0
    u[:, 3:] = 0.002 * random.normal(size=(count, 3))
    q, fade = FLIGHT.noise(dt, np.tile([0.01] * 3 + [1e-5] * 3, (count, 1)))
    z = np.full((count, M), np.nan)
    z[::5, 0] = 50.0 + 0.8 * random.normal(size=len(z[::5]))
    z[::5, HEIGHT] = 500.0 + random.normal(size=len(z[::5]))
    z[::10, VELOCITY:] = [47.0, 14.5, 0.0] + 0.2 * random.normal(size=(len(z[::10]), 3))
    r = np.tile([0.64, 1e-4, 1e-4, 1e-3, 1e-3, 1e-3, 1.0, 0.04, 0.04, 0.04], (count, 1))
    shown = (np.arange(count) % 5 == 4).astype(np.uint8)
    return Drive(dt, u, q, fade, z, r, np.zeros(count, np.uint8), shown)


def begun(**options):
    return Stretch(FLIGHT, FLIGHT.start(START), **options)


def advanced(stretch, steps, cuts=()):
    edges = [0, *sorted(cuts), len(steps.dt)]
    parts = [stretch.advance(steps.part(a, b)) for a, b in pairwise(edges) if b > a]
    return [np.concatenate(columns) for columns in zip(*parts, strict=True)]


def same(one, other):
    for a, b in zip(one, other, strict=True):
        np.testing.assert_array_equal(a, b)


STEPS = drive(2 * BLOCK + 300)


@given(cuts=st.lists(st.integers(0, len(STEPS.dt)), max_size=8))
@hypothesis(max_examples=6, deadline=None)
def test_calls_do_not_change_a_bit(cuts):
    whole, parts = begun(), begun()
    same(advanced(whole, STEPS), advanced(parts, STEPS, cuts))
    same(whole.smooth(), parts.smooth())


@pytest.mark.parametrize("at", [1, 37, BLOCK - 1, BLOCK, BLOCK + 1, 2 * BLOCK])
def test_wound_back_it_is_as_if_the_steps_had_never_been(at):
    plain, wound = begun(), begun()
    for stretch in (plain, wound):
        advanced(stretch, STEPS.part(0, at))
    point = wound.point()
    other = drive(BLOCK + 500, seed=2)
    advanced(wound, other)
    wound.rewind(point)
    assert len(wound) == at
    rest = STEPS.part(at, len(STEPS.dt))
    same(advanced(plain, rest), advanced(wound, rest))
    same(plain.smooth(), wound.smooth())


def test_it_can_be_wound_back_to_the_beginning_and_smoothed_in_between():
    plain, wound = begun(), begun()
    point = wound.point()
    advanced(wound, drive(300, seed=3))
    wound.smooth()
    wound.rewind(point)
    assert len(wound) == 0
    same(advanced(plain, STEPS), advanced(wound, STEPS))
    same(plain.smooth(), wound.smooth())


def test_it_can_be_wound_back_further_than_its_snapshots_reach():
    plain, wound = begun(), begun()
    steps = drive((KEPT + 2) * BLOCK)
    for stretch in (plain, wound):
        advanced(stretch, steps.part(0, 700))
    point = wound.point()
    advanced(wound, steps.part(700, len(steps.dt)))
    wound.rewind(point)
    rest = steps.part(700, 1500)
    same(advanced(plain, rest), advanced(wound, rest))
    same(plain.smooth(), wound.smooth())


def test_snapshots_made_again_are_the_same(monkeypatch):
    kept, thrifty = begun(), begun()
    advanced(kept, STEPS)
    monkeypatch.setattr(module, "KEPT", 1)
    advanced(thrifty, STEPS)
    same(kept.smooth(), thrifty.smooth())


def test_the_distance_between_anchors_does_not_matter():
    short, long = begun(window=10), begun(window=500)
    for a, b in zip(advanced(short, STEPS)[:2], advanced(long, STEPS)[:2], strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(short.smooth().mean, long.smooth().mean, rtol=1e-6, atol=1e-8)


def test_the_smoother_ends_where_the_filter_does_and_is_never_less_sure():
    stretch = begun()
    mean, std, *_ = advanced(stretch, STEPS)
    smoothed = stretch.smooth()
    np.testing.assert_allclose(smoothed.mean[-1], mean[-1], rtol=1e-8, atol=1e-8)
    shown = np.flatnonzero(STEPS.shown)
    other = [i for i, name in enumerate(FLIGHT.names) if name not in ("u", "v", "w")]  # those turn with the estimate
    assert (smoothed.std[shown + 1][:, other] <= std[shown][:, other] * (1 + 1e-4)).all()


def test_what_is_no_longer_finite_is_told_with_its_step_and_can_be_undone():
    stretch, plain = begun(), begun()
    for one in (stretch, plain):
        advanced(one, STEPS.part(0, 100))
    broken = drive(200, seed=4)
    broken.u[120, 3] = np.nan
    point = stretch.point()
    with pytest.raises(Diverged) as error:
        stretch.advance(broken)
    assert error.value.step == 120
    stretch.rewind(point)
    rest = STEPS.part(100, 400)
    same(advanced(plain, rest), advanced(stretch, rest))


def test_what_was_let_go_is_not_smoothed_again():
    stretch = begun()
    advanced(stretch, STEPS.part(0, 500))
    stretch.drop()
    assert len(stretch) == 0
    advanced(stretch, STEPS.part(500, 700))
    assert stretch.smooth().mean.shape == (201, FLIGHT.n)


def test_a_cut_gives_back_what_drove_the_steps():
    stretch = begun()
    advanced(stretch, STEPS)
    steps, told = stretch.cut(BLOCK - 10, BLOCK + 10)
    for a, b in zip(steps, STEPS.part(BLOCK - 10, BLOCK + 10), strict=True):
        np.testing.assert_array_equal(a, b)
    assert told.status.shape == (20, M)


def test_iterating_stays_where_the_model_is_nearly_linear():
    stretch = begun()
    advanced(stretch, STEPS.part(0, 600))
    smoothed = stretch.smooth()
    again = stretch.hybrid(smoothed)
    shown = np.flatnonzero(np.isfinite(smoothed.std[:, 0]))
    apart = np.abs(again.mean[shown] - smoothed.mean[shown]) / smoothed.std[shown]
    assert np.median(apart) < 0.1
    np.testing.assert_allclose(np.median(again.std[shown] / smoothed.std[shown], axis=0)[:7], 1.0, rtol=0.1)


@pytest.mark.parametrize("offset", [1, 7, 13, 19])
def test_a_measurement_between_two_inertial_samples_counts_at_its_own_time(offset):
    """Truth sampled as finely as one likes: 8 m/s2 along the nose, a velocity measured exactly, in between."""
    flight = FlightPath.of(Settings.fti(mode="G", earth="flat"), 0.8, 500.0)
    gain, period = 8.0, 20
    t = np.arange(period, 4000, period)
    fixes = np.arange(200 + offset, 4000, 200)
    times = np.concatenate([t, fixes])
    z = np.full((len(times), WIDTH), np.nan)
    z[: len(t), IMU : IMU + 6] = [gain, 0.0, -9.80665, 0.0, 0.0, 0.0]
    z[len(t) :, MEASURED + VELOCITY] = 50.0 + gain * fixes * 1e-3
    z[len(t) :, MEASURED + VELOCITY + 1 : MEASURED + M] = 0.0
    order = np.argsort(times)
    samples = Samples(times[order] * 1_000_000, times[order], z[order], np.full_like(z, np.nan))
    driver = Driver(flight, 0, samples.z[0, :6], 0.02, output=S // 25, attitude_interval=0)
    stretch = Stretch(flight, flight.start({"h": 500.0, "u": 50.0}))
    filtered = stretch.advance(driver.push(samples).drive)
    known = filtered.innovation[:, VELOCITY]
    assert np.nanmax(np.abs(known)) < 1e-6
    assert np.isfinite(known).sum() == len(fixes)


FIRST_FLIGHT = """
import hashlib
from tests.estimator.test_stretch import advanced, begun, drive
for told in advanced(begun(), drive(400)):
    print(hashlib.sha256(told.tobytes()).hexdigest())
"""


def test_the_first_flight_on_a_machine_is_that_of_all_later_ones(tmp_path):
    """In the first process the kernels are compiled, in the second they come from the disk."""
    command = [sys.executable, "-c", FIRST_FLIGHT]
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    first, second = (
        subprocess.run(command, env=environment, cwd=ROOT, check=True, capture_output=True, text=True).stdout
        for _ in range(2)
    )
    assert first and first == second
