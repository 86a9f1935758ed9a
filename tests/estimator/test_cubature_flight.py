"""The cubature filter of the flight path: the same interface and the same flights as `Stretch`, other moments."""

from __future__ import annotations

from functools import cache
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis
from hypothesis import strategies as st

import sims
from estimator import extended, kinematics, rotation
from estimator import stretch as module
from estimator.cubature.flight import CubatureStretch
from estimator.cubature.flight_points import deviations, image
from estimator.cubature.flight_structures import Carry, Layout, desk
from estimator.extended import REJECTED, USED, WEAKENED
from estimator.kinematics import HEIGHT, STATES, VELOCITY, M
from estimator.models.flight_path import FlightPath, Settings
from estimator.stretch import BLOCK, KEPT, Diverged, Stretch
from sims.experiments.passes import prepare
from tests.estimator import flights, sorties
from tests.estimator.test_stretch import FLIGHT, START, advanced, drive, same

DEGREE = np.pi / 180.0
STEPS = drive(2 * BLOCK + 300)
MEMS = {
    "accelerometer": 0.1, "gyro": 0.15 * DEGREE, "accelerometer_bias": 0.2, "gyro_bias": 0.3 * DEGREE, "airspeed": 0.8,
    "airspeed_scale": 0.04, "flow_angle": 0.5 * DEGREE, "flow_offset": 1.5 * DEGREE, "gnss_velocity": 0.2,
    "prior_attitude": 2.0 * DEGREE, "prior_heading": 2.0 * DEGREE, "heading": 2.0 * DEGREE,
}  # fmt: skip


def begun(**options):
    return CubatureStretch.begin(FLIGHT, START, **options)


@cache
def made(**options):
    return flights.flight(**options)


def both(flight, start=flights.ORDINARY, gated=False):
    """The flight flown by the cubature filter and by the extended one, filtered and smoothed."""
    found = []
    for kind in (CubatureStretch, Stretch):
        stretch = kind.begin(flight.path, start, gated=gated)
        found += [stretch.advance(flight.drive), stretch.smooth()]
    return found


def truth(flight):
    """Named states of all epochs."""
    out = np.empty((flight.count + 1, flight.n))
    q = flights.Rotation.from_matrix(flight.r).as_quat(scalar_first=True)
    extended.named(flight.model, np.ascontiguousarray(flight.x), np.ascontiguousarray(q), False, out)
    return out


def errors(mean, true):
    error = mean - true
    error[:, 4:7] = flights.wrapped(error[:, 4:7])
    return error


# -- how it may be called ----------------------------------------------------------------------------------------------


@given(cuts=st.lists(st.integers(0, len(STEPS.dt)), max_size=8))
@hypothesis(max_examples=3, deadline=None)
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
    advanced(wound, drive(BLOCK + 500, seed=2))
    wound.rewind(point)
    assert len(wound) == at
    rest = STEPS.part(at, len(STEPS.dt))
    same(advanced(plain, rest), advanced(wound, rest))
    same(plain.smooth(), wound.smooth())


def test_it_can_be_wound_back_to_the_beginning_and_further_than_its_snapshots_reach():
    plain, wound = begun(), begun()
    beginning = wound.point()
    advanced(wound, drive(300, seed=3))
    wound.smooth()
    wound.rewind(beginning)
    assert len(wound) == 0
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


def test_what_has_been_taken_is_smoothed_while_the_filter_goes_on():
    plain, stretch = begun(), begun()
    for one in (plain, stretch):
        advanced(one, STEPS.part(0, 500))
    taken = stretch.taken()
    stretch.drop()
    advanced(stretch, STEPS.part(500, 700))
    same(taken.smooth(), plain.smooth())
    assert len(stretch) == 200
    assert stretch.smooth().mean.shape == (201, FLIGHT.n)


def test_a_cut_gives_back_what_drove_the_steps():
    stretch = begun()
    advanced(stretch, STEPS)
    steps, told = stretch.cut(BLOCK - 10, BLOCK + 10)
    same(steps, STEPS.part(BLOCK - 10, BLOCK + 10))
    assert told.status.shape == (20, M)


def test_there_is_nothing_to_iterate_and_states_alone_are_those_with_deviations():
    stretch = begun()
    advanced(stretch, STEPS.part(0, 300))
    found, alone = stretch.smooth(), stretch.smooth(std=False)
    same(stretch.hybrid(found), found)
    np.testing.assert_array_equal(alone.mean, found.mean)
    assert np.isnan(alone.std).all()
    assert np.isnan(found.w).all()


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


@pytest.mark.parametrize("kind", [Stretch, CubatureStretch])
def test_a_start_that_is_not_finite_is_refused_by_name(kind):
    with pytest.raises(ValueError, match="the start has no theta"):
        kind.begin(FLIGHT, {**START, "theta": np.nan})


# -- what it finds -----------------------------------------------------------------------------------------------------


@given(
    seed=st.integers(0, 1000), dt=st.floats(0.001, 0.1), spin=st.floats(0.0, 3.0), far=st.floats(0.0, 1.5),
)  # fmt: skip
@hypothesis(max_examples=30, deadline=None)
def test_a_point_goes_where_the_step_with_its_derivatives_goes(seed, dt, spin, far):
    """The image about its own attitude has no rotation left and the velocity that `kinematics.step` says."""
    rng = np.random.default_rng(seed)
    x, q, u = np.zeros(STATES), np.empty(4), rng.normal(size=6) * [5.0] * 6
    u[3:] = spin * rng.normal(size=3)
    x[:13] = rng.normal(size=13) * [1000.0, 60.0, 20.0, 20.0, far, far, far, 0.3, 0.3, 0.3, 0.02, 0.02, 0.02]
    rotation.quaternion(*rng.uniform(-1.4, 1.4, 3), q)
    earth = kinematics.Earth.at(0.8, 500.0)
    x1, q1 = np.empty(STATES), np.empty(4)
    kinematics.step(x, q, u, dt, earth, x1, q1, np.empty((7, 7)), np.empty((7, 6)), np.empty(200))
    r, r1, y = np.empty((3, 3)), np.empty((3, 3)), np.empty(7)
    rotation.matrix(q, r)
    rotation.matrix(q1, r1)
    image(np.concatenate([x[7:13], x[4:7]]), x[0], r @ x[1:4], q, u, dt, earth, q1, r1, y, np.empty(60))
    np.testing.assert_allclose(y[:4], x1[:4], rtol=1e-11, atol=1e-10)
    np.testing.assert_allclose(y[4:], 0.0, atol=1e-12)


@pytest.mark.parametrize("mode", ["G", "I", "P"])
def test_where_errors_are_small_it_is_the_textbooks_filter_and_smoother(mode):
    """Dense, with complex steps, in plain numpy: nothing shared but the settings. Calm air: vane slopes as well."""
    small = {
        "prior_height": 0.1, "prior_attitude": 1e-4, "prior_heading": 1e-4, "prior_velocity": 0.02, "wind": 0.02,
        "airspeed_scale": 1e-4, "flow_offset": 1e-4, "flow_slope": 1e-4, "turbulence": 0.02, "gyro_bias": 1e-5,
        "accelerometer_bias": 1e-3, "gyro_walk": 1e-6, "accelerometer_walk": 1e-5,
    }  # fmt: skip
    flight = flights.flight(seed=5, count=60, mode=mode, **small)
    sigma = flight.path.prior()
    sigma[1:4] = 0.02  # mode P begins with more
    flight.carry = flight.path.start(flights.ORDINARY, sigma)
    stretch = CubatureStretch.begin(flight.path, flights.ORDINARY, sigma, gated=False)
    filtered, smoothed, book = stretch.advance(flight.drive), stretch.smooth(), flights.textbook(flight)
    assert flights.apart(filtered.mean, book.filtered, book.filtered_std) < 1e-3
    assert flights.apart(smoothed.mean, book.mean, book.std) < 1e-3
    np.testing.assert_allclose(filtered.std, book.filtered_std, rtol=1e-3)
    np.testing.assert_allclose(smoothed.std, book.std, rtol=1e-3)


@pytest.mark.parametrize(("mode", "close"), [("I", 0.03), ("G", 0.3), ("P", 0.5)])
def test_on_an_ordinary_flight_it_agrees_with_the_extended_smoother(mode, close):
    flight = made(seed=3, count=400, mode=mode)
    filtered, smoothed, other, smoothed_other = both(flight)
    for one, two in ((filtered, other), (smoothed, smoothed_other)):
        gap = errors(one.mean, two.mean)[:, :13] / two.std[:, :13]
        assert np.sqrt(np.mean(gap**2)) < close / 2
        assert np.abs(gap).max() < close
        assert np.abs(np.median(one.std / two.std, axis=0)[:13] - 1.0).max() < 0.02
    assert (filtered.status == other.status).all()


def test_a_simulated_sortie_is_found_as_by_the_extended_smoother_and_as_it_was():
    """An aircraft of its own, sensors as sold: both paths beside each other and beside the truth."""
    flight = sorties.flown()
    record = prepare(sorties.messages_of(flight), sorties.settings(flight))
    model, carry = record.flight.model, record.carry
    begin = Carry.begin(Layout.of(model), carry.x, carry.q, flights.covariance(carry), model.order)
    cubature, other = CubatureStretch(record.flight, begin), Stretch(record.flight, carry.copy())
    filtered, filtered_other = (stretch.advance(record.steps.drive) for stretch in (cubature, other))
    smoothed, smoothed_other = cubature.smooth(), other.smooth()
    at = record.shown
    for one, two, rows in ((filtered, filtered_other, at), (smoothed, smoothed_other, at + 1)):
        gap = errors(one.mean[rows], two.mean[rows])[:, :13] / two.std[rows, :13]
        assert np.sqrt(np.mean(gap**2)) < 0.2
        np.testing.assert_allclose(np.median(one.std[rows] / two.std[rows], axis=0)[:13], 1.0, rtol=0.02)
    assert (filtered.status == filtered_other.status).mean() > 0.9999
    true, t = sims.truth_states(flight), record.t
    for name in ("u", "v", "w", "theta", "phi"):
        i = record.flight.names.index(name)
        error = smoothed.mean[at + 1, i] - np.interp(t, flight.utc, true[name])
        assert np.sqrt(np.mean((error / smoothed.std[at + 1, i]) ** 2)) < 1.6


def test_errors_are_as_large_as_their_deviations_say():
    """Six flights of their own model, autopilot grade: every filtered and smoothed kinematic state, and the biases."""
    z, inside = [], []
    for seed in range(6):
        flight = flights.flight(seed=seed, count=400, attitude=False, **MEMS)
        filtered, smoothed, *_ = both(flight)
        true = truth(flight)
        for mean, std, t in ((filtered.mean, filtered.std, true[1:]), (smoothed.mean[1:], smoothed.std[1:], true[1:])):
            ratio = errors(mean, t)[100:, :13] / std[100:, :13]
            z.append(np.mean(ratio**2))
            inside.append(np.mean(np.abs(ratio) < 2.0))
    assert 0.6 < np.mean(z) < 1.3
    assert np.mean(inside) > 0.92


def test_a_start_that_is_far_off_is_followed_no_worse_than_by_the_extended_smoother():
    """Attitude unknown to 15 deg, heading to 30: normalised errors of everything, both filters and smoothers."""
    cubature, other = [], []
    for seed in range(1, 5):
        flight = flights.flight(seed=seed, count=300, prior_heading=30 * DEGREE, prior_attitude=15 * DEGREE)
        true = truth(flight)
        found = both(flight)
        for into, (filtered, smoothed) in ((cubature, found[:2]), (other, found[2:])):
            for mean, std in ((filtered.mean, filtered.std), (smoothed.mean[1:], smoothed.std[1:])):
                into.append(np.mean((errors(mean, true[1:])[100:] / std[100:]) ** 2))
    assert np.mean(cubature) < 0.8 * np.mean(other)


def test_deviations_of_named_states_are_those_of_samples_about_what_is_told():
    """Heading unknown to 11 deg at 60 m/s: much of the spread of u is the bend of the cosine."""
    layout, n = Layout.of(FLIGHT.model), FLIGHT.n
    rng = np.random.default_rng(1)
    factor = 0.02 * np.tril(rng.normal(size=(n, n)))
    factor[-6:-3] *= 20.0
    factor[-1] *= 3.0
    factor[np.diag_indices(n)] = np.abs(np.diag(factor))
    x, q, std, d = np.zeros(STATES), np.empty(4), np.empty(n), desk(n, FLIGHT.p)
    x[1:4] = 60.0, 2.0, -1.0
    rotation.quaternion(0.1, 0.3, 3.0, q)
    root = np.ascontiguousarray(factor.T)
    deviations(layout.named, root, x, q, std, d.z, d.plus, d.minus, d.centre, d.work)
    count = 200_000
    sample = x[layout.order] + rng.normal(size=(count, n)) @ root
    states, attitudes = np.zeros((count, STATES)), np.tile(q, (count, 1))
    states[:, layout.order] = sample
    turned = (flights.Rotation.from_quat(attitudes, scalar_first=True)
              * flights.Rotation.from_rotvec(states[:, 4:7]))  # fmt: skip
    back = flights.Rotation.from_rotvec(-states[:, 4:7])
    states[:, 1:4], states[:, 4:7] = back.apply(states[:, 1:4]), 0.0
    out, here = np.empty((count, n)), np.empty((1, n))
    extended.named(FLIGHT.model, states, turned.as_quat(scalar_first=True), False, out)
    extended.named(FLIGHT.model, x[None], q[None], False, here)
    np.testing.assert_allclose(std, np.sqrt(np.mean(errors(out, here) ** 2, axis=0)), rtol=0.08)


def test_the_smoother_ends_where_the_filter_does_and_is_never_less_sure():
    stretch = begun()
    mean, std, *_ = advanced(stretch, STEPS)
    smoothed = stretch.smooth()
    np.testing.assert_allclose(smoothed.mean[-1], mean[-1], rtol=1e-12, atol=1e-12)
    shown = np.flatnonzero(STEPS.shown)
    np.testing.assert_allclose(smoothed.std[-1], std[shown[-1]], rtol=1e-9)
    other = [i for i, name in enumerate(FLIGHT.names) if name not in ("u", "v", "w")]  # those turn with the estimate
    assert (smoothed.std[shown + 1][:, other] <= std[shown][:, other] * (1 + 1e-3)).all()


def test_the_seam_of_the_circle_does_not_matter():
    start = {**START, "psi": np.pi - 0.01}
    steps = drive(600, seed=6)
    heading = np.full(600, np.nan)
    heading[::7] = np.pi + 0.03 * np.random.default_rng(2).normal(size=len(heading[::7]))
    told = []
    for whole in (0.0, 2.0 * np.pi, -4.0 * np.pi):
        z = steps.z.copy()
        z[:, 5] = heading + whole
        z[:, VELOCITY:] = np.where(np.isnan(z[:, VELOCITY:]), np.nan, [-50.0, 0.0, 0.0])
        stretch = CubatureStretch.begin(FLIGHT, start)
        advanced(stretch, steps._replace(z=z))
        told.append(stretch.smooth())
    for other in told[1:]:
        np.testing.assert_allclose(errors(other.mean, told[0].mean), 0.0, atol=1e-9)
        np.testing.assert_allclose(other.std, told[0].std, rtol=1e-9)
    away = np.cos(told[0].mean[200:, 6])
    assert (away < -0.99).all()


# -- square roots ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("mode", ["G", "I", "P"])
def test_the_factor_stays_triangular_whatever_is_measured(mode):
    """Measurements ten decades better than what is known, and half of the time none."""
    flight = made(seed=8, count=200, mode=mode)
    stretch = CubatureStretch.begin(flight.path, flights.ORDINARY, gated=False)
    r = flight.drive.r.copy()
    r[50:60] = 1e-20
    z = flight.drive.z.copy()
    z[100:] = np.nan
    flown = flight.drive._replace(r=r, z=z)
    for i in range(0, 200, 10):
        stretch.advance(flown.part(i, i + 10))
        root = stretch.carry.root
        assert np.isfinite(root).all()
        assert not np.tril(root, -1).any()
        assert (np.diag(root) >= 0.0).all()
    assert np.isfinite(stretch.smooth().std).all()


def test_steps_without_any_measurement_only_forget():
    steps = STEPS.part(0, 200)
    stretch = begun()
    filtered = stretch.advance(steps._replace(z=np.full_like(steps.z, np.nan)))
    assert not filtered.status.any()
    assert np.isnan(filtered.innovation).all()
    shown = np.flatnonzero(steps.shown)
    kinematic = filtered.std[shown][:, [0, 4, 5, 6]]
    assert (np.diff(kinematic, axis=0) > 0.0).all()
    smoothed = stretch.smooth()
    np.testing.assert_allclose(smoothed.mean[shown + 1], filtered.mean[shown], rtol=1e-7, atol=1e-7)
    np.testing.assert_allclose(smoothed.std[shown + 1], filtered.std[shown], rtol=1e-6)


def test_steps_without_noise_take_nothing_over_from_steps_with_it():
    """What went before is in the carry alone: a stretch begun from it goes on to the same bits."""
    steps = STEPS.part(0, 200)
    stretch = begun()
    stretch.advance(steps.part(0, 100))
    fresh = CubatureStretch(FLIGHT, stretch.carry.copy())
    stretch.drop()
    silent = steps.part(100, 200)
    silent = silent._replace(q=np.zeros_like(silent.q))
    same(stretch.advance(silent), fresh.advance(silent))
    smoothed = stretch.smooth()
    same(smoothed, fresh.smooth())
    assert np.isfinite(smoothed.mean).all()
    constant = slice(7, 17)  # biases, scale, offsets, wind: one number each, known as well at the start as at the end
    np.testing.assert_allclose(smoothed.mean[0, constant], smoothed.mean[-1, constant], rtol=1e-9)
    np.testing.assert_allclose(smoothed.std[0, constant], smoothed.std[-1, constant], rtol=1e-9)


def test_an_absent_sensor_is_one_without_weight():
    flight = made(seed=9, count=150)
    z, r = flight.drive.z.copy(), flight.drive.r.copy()
    z[:, [1, 4, HEIGHT]] = np.nan
    r[:, [1, 4, HEIGHT]] = 1e18
    absent, weak = (CubatureStretch.begin(flight.path, flights.ORDINARY, gated=False) for _ in range(2))
    one = absent.advance(flight.drive._replace(z=z))
    two = weak.advance(flight.drive._replace(r=r))
    np.testing.assert_allclose(one.mean, two.mean, rtol=1e-7, atol=1e-7)
    np.testing.assert_allclose(one.std, two.std, rtol=1e-7)


def test_deaf_vanes_say_nothing_of_the_wind_along_the_flow():
    """Straight north: what alpha and beta tell of wind and gusts is across; with ears they tell the airspeed too."""
    told = {}
    for hears in (False, True):
        settings = Settings.mems(
            mode="G", earth="flat", flow_tells_airspeed=hears, turbulence=2.0, flow_offset=1e-3, prior_velocity=0.1,
            prior_attitude=1e-3,
        )  # fmt: skip
        path = FlightPath.of(settings, 0.8, 500.0)
        stretch = CubatureStretch.begin(path, {"h": 500.0, "u": 50.0, "w": 25.0, "wind_north": 3.0})
        steps = drive(1)
        q, fade = path.noise(steps.dt, steps.q[:, :6])
        z = np.full_like(steps.z, np.nan)
        z[:, 1:3] = 0.5, 0.01
        stretch.advance(steps._replace(z=z, q=q, fade=fade))
        layout, root = Layout.of(path.model), stretch.carry.root
        wind = [root[:, layout.at[13 + i]] + root[:, layout.at[15 + i]] for i in range(2)]
        told[hears] = [float(np.sqrt(part @ part)) for part in wind]
    alone = np.sqrt(10.0**2 + 2.0**2)
    assert told[False][0] == pytest.approx(alone, rel=1e-4)
    assert told[True][0] < 0.5 * alone
    assert told[False][1] < 0.5 * alone


# -- gates -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("sigmas", "status"), [(3.0, USED), (6.5, WEAKENED), (20.0, REJECTED)])
@pytest.mark.parametrize("channel", [0, 5, HEIGHT, VELOCITY + 1])
def test_an_outlier_is_weakened_or_refused_as_by_the_extended_smoother(channel, sigmas, status):
    flight = made(seed=11, count=700)
    z = flight.drive.z.copy()
    plain = CubatureStretch.begin(flight.path, flights.ORDINARY)
    innovation = plain.advance(flight.drive).innovation
    row = int(np.flatnonzero(~np.isnan(z[:600, channel]) & (np.abs(innovation[:600, channel]) < 0.5))[-1])
    deviation = np.sqrt(flight.drive.r[row, channel])
    for _ in range(3):  # innovations are counted in their own deviations
        stretch = CubatureStretch.begin(flight.path, flights.ORDINARY)
        was = stretch.advance(flight.drive._replace(z=z)).innovation[row, channel] if z is not None else 0.0
        if status == USED and abs(was - sigmas) < 0.05:
            break
        clean = flight.drive.z.copy()
        clean[row, channel] += deviation
        one = CubatureStretch.begin(flight.path, flights.ORDINARY).advance(flight.drive._replace(z=clean))
        unit = (one.innovation[row, channel] - innovation[row, channel]) / deviation
        z = flight.drive.z.copy()
        z[row, channel] += (sigmas - innovation[row, channel]) / unit
    for kind in (CubatureStretch, Stretch):
        told = kind.begin(flight.path, flights.ORDINARY).advance(flight.drive._replace(z=z))
        assert told.status[row, channel] == status
        expected = 5.0 if status == WEAKENED else sigmas
        assert told.innovation[row, channel] == pytest.approx(expected, rel=0.15)


def test_nothing_is_refused_in_the_first_ten_seconds():
    flight = made(seed=11, count=700)
    z = flight.drive.z.copy()
    z[100:200] += 30.0
    told = CubatureStretch.begin(flight.path, flights.ORDINARY).advance(flight.drive._replace(z=z))
    early = flight.drive.dt.cumsum() <= 10.0
    assert not (told.status[early] > USED).any()


def test_a_channel_that_is_locked_out_opens_the_filter_and_is_heard_again():
    flight = made(seed=12, count=1100, mode="I")
    z = flight.drive.z.copy()
    z[700:, VELOCITY] += 8.0
    told = {}
    for kind in (CubatureStretch, Stretch):
        stretch = kind.begin(flight.path, flights.ORDINARY)
        told[kind] = stretch.advance(flight.drive._replace(z=z))
        assert np.isfinite(stretch.smooth().std).all()
    mine, other = told[CubatureStretch], told[Stretch]
    np.testing.assert_array_equal(mine.doubted, other.doubted)
    assert (mine.status == other.status).mean() > 0.999
    first = int(np.flatnonzero(mine.doubted)[0])
    assert mine.doubted[first] & 1
    assert mine.std[first + 1, 1:4].max() > 2.0 * mine.std[first, 1:4].max()


def test_parts_of_a_drive_are_what_the_whole_is():
    """Bit for bit with gates at work, wherever a call ends."""
    flight = made(seed=12, count=1100, mode="I")
    z = flight.drive.z.copy()
    z[700:, VELOCITY] += 8.0
    steps = flight.drive._replace(z=z)
    whole, parts = (CubatureStretch.begin(flight.path, flights.ORDINARY) for _ in range(2))
    one = whole.advance(steps)
    edges = [0, 1, 699, 701, 800, 1100]
    two = [parts.advance(steps.part(a, b)) for a, b in pairwise(edges)]
    same(one, [np.concatenate(columns) for columns in zip(*two, strict=True)])
    same(whole.smooth(), parts.smooth())
