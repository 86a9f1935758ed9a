"""The extended information smoother: the textbook's answer by other means, and what must never change it."""

from __future__ import annotations

from functools import cache
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares
from scipy.stats import chi2

from estimator import extended
from estimator.extended import ABSENT, REJECTED, USED, WEAKENED
from estimator.rivals import extended_rts
from tests.estimator import flights
from tests.estimator.flights import apart, flight, smoothed, textbook, wrapped

NEVER = 10**9
WINDOWS = (1, 20, 100, NEVER)
CASES = {
    "G": {"mode": "G"},
    "G, calm": {"mode": "G", "turbulence": 0.1},
    "G, biases walk": {"mode": "G", "accelerometer_walk": 1e-3, "gyro_walk": 1e-4},
    "P": {"mode": "P"},
    "I": {"mode": "I"},
    "I, biases walk": {"mode": "I", "accelerometer_walk": 1e-3, "gyro_walk": 1e-4},
    "I, gyros walk": {"mode": "I", "gyro_walk": 1e-4},
    "P, constant gusts": {"mode": "P", "turbulence_time": 1e9},
    "G, no wind walk": {"mode": "G", "wind_walk": 0.0},
}
SIZES = {
    "G": (21, 11),
    "G, calm": (23, 11),
    "G, biases walk": (21, 17),
    "P": (19, 9),
    "I": (13, 6),
    "I, biases walk": (13, 12),
}


@cache
def case(name):
    """A flight of 45 steps, and what the textbook says of it."""
    found = flight(mode_seed(name), 45, **CASES[name])
    return found, textbook(found)


def mode_seed(name):
    return 1 + list(CASES).index(name)


@cache
def long_flight():
    return flight(4, 900)


def same_bits(one, other):
    for a, b in zip(one, other, strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("name", SIZES)
def test_modes_have_their_numbers_of_states_and_noise_components(name):
    found, _ = case(name)
    assert (found.n, found.path.p) == SIZES[name]


@pytest.mark.parametrize("window", WINDOWS)
@pytest.mark.parametrize("name", CASES)
def test_filter_and_smoother_are_the_textbooks_whatever_the_window(name, window):
    found, known = case(name)
    ours = smoothed(found, window)
    assert apart(ours.filtered, known.filtered, known.filtered_std) < 1e-9
    np.testing.assert_allclose(ours.told.std, known.filtered_std, rtol=1e-9)
    assert apart(ours.mean, known.mean, known.std) < 1e-9
    np.testing.assert_allclose(ours.std, known.std, rtol=1e-9)
    np.testing.assert_allclose(
        ours.p0 / np.sqrt(np.outer(np.diag(known.p0), np.diag(known.p0))),
        known.p0 / np.sqrt(np.outer(np.diag(known.p0), np.diag(known.p0))), atol=1e-9,
    )  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_the_smoothed_noise_of_the_inertial_sensors_is_the_textbooks(name):
    found, known = case(name)
    sigma = np.sqrt(found.drive.q[:, :6])
    np.testing.assert_allclose(smoothed(found, 20).w / sigma, known.w / sigma, atol=1e-9)


@pytest.mark.parametrize("name", CASES)
def test_the_sums_over_innovations_are_those_of_the_block_filter(name):
    found, known = case(name)
    ours = smoothed(found, 20)
    assert ours.carry.cost[0] == pytest.approx(known.nis, rel=1e-10)
    assert ours.carry.cost[1] == pytest.approx(known.log_s, abs=1e-8)
    assert ours.carry.cost[2] == known.scalars == np.isfinite(found.drive.z).sum()
    assert np.nansum(ours.told.innovation**2) == pytest.approx(known.nis, rel=1e-10)
    np.testing.assert_array_equal(np.isfinite(ours.told.innovation), np.isfinite(found.drive.z))
    np.testing.assert_array_equal(ours.told.status, np.where(np.isfinite(found.drive.z), USED, ABSENT))


@pytest.mark.parametrize("window", WINDOWS)
@pytest.mark.parametrize("mode", ["G", "P", "I"])
def test_a_long_flight_is_that_of_the_compiled_textbook(mode, window):
    found = long_flight() if mode == "G" else flight(4, 900, mode)
    room = extended_rts.Room.of(found.carry, found.count)
    assert extended_rts.forward(found.model, found.drive, found.carry.x, room) == -1
    filtered, mean = np.empty((found.count, found.n)), np.empty((found.count + 1, found.n))
    extended.named(found.model, room.x[1:], room.q[1:], True, filtered)
    filtered_std = room.std[1:].copy()
    ours = smoothed(found, window)
    assert apart(ours.filtered, filtered, filtered_std) < 1e-8
    np.testing.assert_allclose(ours.told.std, filtered_std, rtol=1e-8)
    assert extended_rts.backward(found.model, found.drive, room) == -1
    extended.named(found.model, room.x, room.q, True, mean)
    assert apart(ours.mean, mean, room.std) < 1e-8
    np.testing.assert_allclose(ours.std, room.std, rtol=1e-8)
    sigma = np.sqrt(found.drive.q[:, :6])
    np.testing.assert_allclose(ours.w / sigma, room.w / sigma, atol=1e-8)


@pytest.mark.parametrize("name", ["G", "P", "I, biases walk"])
def test_the_compiled_textbook_is_the_one_in_plain_numpy(name):
    found, known = case(name)
    room = extended_rts.Room.of(found.carry, found.count)
    assert extended_rts.forward(found.model, found.drive, found.carry.x, room) == -1
    np.testing.assert_allclose(room.std[1:], known.filtered_std, rtol=1e-9)
    assert extended_rts.backward(found.model, found.drive, room) == -1
    mean = np.empty((found.count + 1, found.n))
    extended.named(found.model, room.x, room.q, True, mean)
    assert apart(mean, known.mean, known.std) < 1e-9
    np.testing.assert_allclose(room.std, known.std, rtol=1e-9)
    sigma = np.sqrt(found.drive.q[:, :6])
    np.testing.assert_allclose(room.w / sigma, known.w / sigma, atol=1e-9)


@settings(max_examples=25, deadline=None)
@given(st.lists(st.integers(0, 900), max_size=5), st.sampled_from([1, 7, 100]), st.booleans(), st.booleans())
def test_cutting_a_flight_into_pieces_changes_no_bit(cuts, window, gated, keep):
    found = long_flight()
    whole, pieces = smoothed(found, window, gated=gated, keep=keep), None
    pieces = smoothed(found, window, gated=gated, keep=keep, cuts=cuts)
    same_bits(whole.carry, pieces.carry)
    same_bits(whole.told, pieces.told)
    np.testing.assert_array_equal(whole.rows.x, pieces.rows.x)
    np.testing.assert_array_equal(whole.rows.q, pieces.rows.q)
    if keep:
        for name in ("x", "q", "w", "std"):
            np.testing.assert_array_equal(getattr(whole, name), getattr(pieces, name))


@settings(max_examples=10, deadline=None)
@given(st.lists(st.integers(0, 45), max_size=3))
def test_cutting_a_pass_about_a_trajectory_changes_no_bit(cuts):
    found, _ = case("G")
    first = smoothed(found, 20)
    whole, pieces = smoothed(found, 20, first.about), smoothed(found, 20, first.about, cuts=cuts)
    same_bits(whole.about, pieces.about)
    same_bits(whole.carry, pieces.carry)


def test_what_is_kept_for_the_way_back_changes_no_bit_of_the_filter():
    found = long_flight()
    kept, live = smoothed(found, 50, gated=True), smoothed(found, 50, gated=True, keep=False)
    same_bits(kept.carry, live.carry)
    same_bits(kept.told, live.told)
    np.testing.assert_array_equal(kept.rows.x, live.rows.x)


def test_deviations_are_told_where_they_are_asked_for_and_the_rest_does_not_depend_on_it():
    found = long_flight()
    shown = np.zeros(found.count, np.uint8)
    shown[::7] = 1
    every, some = smoothed(found, 50), smoothed(found, 50, drive=found.drive._replace(shown=shown))
    np.testing.assert_array_equal(some.told.std[::7], every.told.std[::7])
    assert np.isnan(some.told.std[shown == 0]).all()
    same_bits(every.carry, some.carry)


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 99))
def test_the_variance_of_what_is_not_measured_does_not_matter(seed):
    found, _ = case("G")
    r = found.drive.r.copy()
    absent = ~np.isfinite(found.drive.z)
    r[absent] = np.random.default_rng(seed).uniform(1e-9, 1e9, absent.sum())
    one, other = smoothed(found, 20), smoothed(found, 20, drive=found.drive._replace(r=r))
    same_bits(one.about[:3], other.about[:3])
    same_bits(one.carry, other.carry)


def test_a_measurement_without_weight_is_a_measurement_that_is_not_there():
    found, _ = case("G")
    rng = np.random.default_rng(2)
    chosen = rng.random(found.drive.z.shape) < 0.3
    z, r = np.where(chosen, np.nan, found.drive.z), np.where(chosen, 1e30, found.drive.r)
    removed = smoothed(found, 20, drive=found.drive._replace(z=z))
    weightless = smoothed(found, 20, drive=found.drive._replace(r=r))
    assert apart(weightless.mean, removed.mean, removed.std) < 1e-9
    np.testing.assert_allclose(weightless.std, removed.std, rtol=1e-9)


@pytest.mark.parametrize("status", [ABSENT, REJECTED])
def test_a_pass_about_a_trajectory_uses_no_measurement_that_the_first_pass_did_not(status):
    found, _ = case("G")
    first = smoothed(found, 20).about
    chosen = np.random.default_rng(2).random(found.drive.z.shape) < 0.3
    refused = first._replace(status=np.where(chosen, status, first.status).astype(np.uint8))
    one = smoothed(found, 20, refused)
    other = smoothed(found, 20, first, drive=found.drive._replace(z=np.where(chosen, np.nan, found.drive.z)))
    same_bits(one.about[:3], other.about[:3])


def test_steps_without_any_measurement_carry_the_filter_on():
    found = flight(6, 40, missing=1.0)
    ours, known = smoothed(found, 20), textbook(found)
    assert apart(ours.mean, known.mean, known.std) < 1e-9
    np.testing.assert_allclose(ours.std, known.std, rtol=1e-9)
    np.testing.assert_array_equal(ours.w, 0.0)
    np.testing.assert_array_equal(ours.carry.cost, 0.0)


def test_noise_components_without_variance_are_left_out():
    found, _ = case("G")
    q = found.drive.q.copy()
    q[:, 2], q[10:20, 4], q[:, 7], q[5:, 9] = 0.0, 0.0, 0.0, 0.0
    found = flights.SimpleNamespace(**{**vars(found), "drive": found.drive._replace(q=q)})
    known = textbook(found)
    for window in (20, NEVER):
        ours = smoothed(found, window)
        assert apart(ours.mean, known.mean, known.std) < 1e-9
        np.testing.assert_allclose(ours.std, known.std, rtol=1e-9)
        np.testing.assert_array_equal(ours.w[:, 2], 0.0)
        np.testing.assert_array_equal(ours.w[10:20, 4], 0.0)


def test_no_noise_at_all_leaves_one_unknown_the_start():
    found, _ = case("G")
    found = flights.SimpleNamespace(**{**vars(found), "drive": found.drive._replace(q=np.zeros_like(found.drive.q))})
    known, ours = textbook(found), smoothed(found, 20)
    assert apart(ours.mean, known.mean, known.std) < 1e-7
    np.testing.assert_allclose(ours.std, known.std, rtol=1e-7)


def test_states_alone_are_the_states_with_their_deviations():
    found, _ = case("G")
    both = smoothed(found, 20)
    carry, n = both.carry, found.n
    star, empty = np.empty((n, 1)), np.empty((0, 0))
    extended.finish(carry, star, empty, np.empty(0), False)
    x, q, w = np.empty_like(both.x), np.empty_like(both.q), np.empty_like(both.w)
    shown = np.ones(found.count + 1, np.uint8)
    first = found.carry
    extended.backward(
        found.model, both.rows, star, empty, np.empty(0), shown, False, first.s, first.q, first.x, x, q, w,
        np.empty((found.count + 1, n)),
    )  # fmt: skip
    mean = np.empty_like(both.mean)
    extended.named(found.model, x, q, False, mean)
    assert apart(mean, both.mean, both.std) < 1e-10
    np.testing.assert_allclose(w, both.w, atol=1e-12)


def test_a_flight_through_the_vertical_is_smoothed_like_any_other():
    steep = {"h": 3000.0, "u": 80.0, "theta": 1.55, "psi": 0.3, "phi": 0.2}
    found = flight(5, 40, start=steep, attitude=False, heading=None)
    drive = found.drive._replace(z=np.where(np.arange(10) == 5, np.nan, found.drive.z))
    found = flights.SimpleNamespace(**{**vars(found), "drive": drive})
    ours, known = smoothed(found, 20), textbook(found)
    keep = [i for i in range(found.n) if i not in (4, 5, 6)]  # Euler angles mean nothing here
    assert np.isfinite(ours.x).all() and np.isfinite(ours.w).all()
    assert np.abs((ours.mean - known.mean) / known.std)[:, keep].max() < 1e-8
    np.testing.assert_allclose(ours.std[:, keep], known.std[:, keep], rtol=1e-8)


def test_euler_angles_are_no_measurement_beyond_eighty_degrees():
    steep = {"h": 3000.0, "u": 80.0, "theta": 1.5, "psi": 0.3}
    found = flight(5, 20, start=steep)
    ours = smoothed(found, 20)
    assert (ours.told.status[:, 3:6] == ABSENT).all()
    assert (ours.told.status[:, 6:] == USED).sum() == np.isfinite(found.drive.z[:, 6:]).sum()


def test_air_data_count_for_nothing_when_the_aircraft_hardly_moves():
    found = flight(5, 20, start={"h": 100.0, "u": 0.5}, prior_velocity=0.01)
    ours = smoothed(found, 20)
    assert (ours.told.status[:, :3] == ABSENT).all()
    assert np.isfinite(ours.mean).all()


def test_what_is_not_finite_is_told_by_its_step():
    found, _ = case("G")
    u = found.drive.u.copy()
    u[17, 2] = np.inf
    rows, told = extended.Rows.empty(found.count, found.n, found.path.p), extended.Told.empty(found.count, found.n)
    failed = extended.forward(
        found.model, found.drive._replace(u=u), extended.About.nothing(), 20, False, found.carry.copy(), True, rows,
        told,
    )  # fmt: skip
    assert failed == 17


# -- gates


def with_sigmas(found, step, channel, sigmas):
    """The drive in which one measurement deviates by so many sigmas of its innovation."""
    z = found.drive.z.copy()
    level = smoothed(found, 100, keep=False).told.innovation[step, channel]
    z[step, channel] += 1.0
    slope = smoothed(found, 100, keep=False, drive=found.drive._replace(z=z)).told.innovation[step, channel] - level
    z[step, channel] = found.drive.z[step, channel] + (sigmas - level) / slope
    return found.drive._replace(z=z)


def first_seen(found, channel, after):
    return int(np.flatnonzero(np.isfinite(found.drive.z[:, channel]) & (np.cumsum(found.drive.dt) > after))[0])


@pytest.mark.parametrize("channel", [0, 1, 4, 6, 8])
@pytest.mark.parametrize(("sigmas", "status"), [(4.9, USED), (6.0, WEAKENED), (-6.0, WEAKENED), (20.0, REJECTED)])
def test_an_outlier_of_six_sigmas_is_weakened_and_one_of_twenty_is_refused(channel, sigmas, status):
    found = long_flight()
    step = first_seen(found, channel, 12.0)
    drive = with_sigmas(found, step, channel, sigmas)
    told = smoothed(found, 100, drive=drive, gated=True, keep=False).told
    assert told.status[step, channel] == status
    if status == WEAKENED:
        assert abs(told.innovation[step, channel]) <= 5.0
        assert told.r[step, channel] > found.drive.r[step, channel]
    else:
        assert told.innovation[step, channel] == pytest.approx(sigmas, rel=1e-6)
        assert told.r[step, channel] == found.drive.r[step, channel]


def test_a_refused_measurement_changes_nothing_but_its_report():
    found = long_flight()
    step = first_seen(found, 8, 12.0)
    z = found.drive.z.copy()
    z[step, 8] = np.nan
    ours = smoothed(found, 100, drive=with_sigmas(found, step, 8, 20.0), gated=True)
    other = smoothed(found, 100, drive=found.drive._replace(z=z), gated=True)
    np.testing.assert_array_equal(ours.mean, other.mean)
    np.testing.assert_array_equal(ours.std, other.std)


def test_nothing_is_refused_in_the_first_ten_seconds():
    found = long_flight()
    step = first_seen(found, 6, 8.0)
    told = smoothed(found, 100, drive=with_sigmas(found, step, 6, 20.0), gated=True, keep=False).told
    assert told.status[step, 6] == USED


def test_gates_are_wider_after_inertial_data_that_were_made_up():
    found = long_flight()
    step = first_seen(found, 6, 13.0)
    drive = with_sigmas(found, step, 6, 7.0)
    bridged = np.zeros(found.count, np.uint8)
    bridged[step - 100] = 1  # 2 s ago
    assert smoothed(found, 100, drive=drive, gated=True, keep=False).told.status[step, 6] == WEAKENED
    told = smoothed(found, 100, drive=drive._replace(bridged=bridged), gated=True, keep=False).told
    assert told.status[step, 6] == USED


def test_without_gates_an_outlier_is_taken_as_it_is():
    found = long_flight()
    step = first_seen(found, 6, 12.0)
    assert smoothed(found, 100, drive=with_sigmas(found, step, 6, 20.0), keep=False).told.status[step, 6] == USED


def test_a_channel_that_is_locked_out_opens_the_filter_and_is_heard_again():
    found = flight(4, 1500, missing=0.0, air=False)
    z = found.drive.z.copy()
    late = np.cumsum(found.drive.dt) > 12.0
    z[late, 7:] += [3.0, 0.0, 0.0]  # as if the filter had lost its velocity
    told = smoothed(found, 100, drive=found.drive._replace(z=z), gated=True)
    seen = np.flatnonzero(late & np.isfinite(z[:, 7]))
    status = told.told.status[seen, 7]
    assert (status[:3] == REJECTED).all()
    heard = int(np.flatnonzero(status != REJECTED)[0])
    assert extended.ROW <= heard <= 3 * (extended.ROW + 1)  # each time, ten times the variance
    assert (status[heard + 15 :] != REJECTED).mean() > 0.95
    room_for_doubt = told.told.std[:, 1]
    assert room_for_doubt[seen[heard]] > 2.0 * room_for_doubt[seen[0]]
    velocity = flights.from_angles(*told.mean[-1, 4:7]) @ told.mean[-1, 1:4]
    true = found.r[-1] @ found.x[-1, 1:4]
    np.testing.assert_allclose(velocity - true, [3.0, 0.0, 0.0], atol=0.3)
    assert np.isfinite(told.mean).all() and np.isfinite(told.std).all()


def test_a_pass_about_the_result_doubts_where_the_first_one_did():
    found = flight(4, 1100, missing=0.0, air=False)
    z = found.drive.z.copy()
    z[np.cumsum(found.drive.dt) > 12.0, 7:] += [3.0, 0.0, 0.0]
    drive = found.drive._replace(z=z)
    first = smoothed(found, 100, drive=drive, gated=True)
    assert first.told.doubted.any()
    again = smoothed(found, 100, first.about, drive=drive, gated=True)
    np.testing.assert_array_equal(again.told.doubted, first.told.doubted)
    after = int(np.flatnonzero(first.told.doubted)[-1]) + 20
    assert again.std[after, 1] > 0.8 * first.std[after, 1]  # its variance was raised as well


def test_doubt_is_undone_exactly_by_the_smoother():
    found = flight(4, 1100, missing=0.0, air=False)
    z = found.drive.z.copy()
    z[np.cumsum(found.drive.dt) > 12.0, 7:] += [3.0, 0.0, 0.0]
    drive = found.drive._replace(z=z)
    one, other = (smoothed(found, window, drive=drive, gated=True) for window in (1, NEVER))
    assert (one.told.status == REJECTED).sum() > extended.ROW
    np.testing.assert_array_equal(one.told.status, other.told.status)
    assert apart(one.mean, other.mean, other.std) < 1e-6
    np.testing.assert_allclose(one.std, other.std, rtol=1e-6)


# -- iteration


def moved_about(found, x, q, w):
    """The trajectory that the equations make of the first state and the noise, in sigmas off the one given."""
    worst = 0.0
    for i in range(found.count):
        r = flights.from_quaternion(q[i])
        h, v, r1 = flights.carried(x[i], r, found.drive.u[i] - w[i], found.drive.dt[i], found.model.earth)
        turned = flights.difference(flights.from_quaternion(q[i + 1]), r1)
        worst = max(worst, np.abs([h - x[i + 1, 0], *(v - x[i + 1, 1:4]), *turned]).max())
    return worst


@cache
def iterated(wind, passes=7):
    """Passes about the last result: the moves in sigmas, and all passes."""
    found, _ = case("G")
    model = found.model._replace(wind=wind)
    results = [smoothed(found, 20)]
    for _ in range(passes):
        about = results[-1].about._replace(status=results[0].told.status, r=results[0].told.r)
        results.append(smoothed(found, 20, about, model=model))
    moves = [apart(b.mean, a.mean, b.std) for a, b in pairwise(results)]
    return found, moves, results


def test_the_smoothed_trajectory_obeys_the_equations_when_passes_have_converged():
    found, _, results = iterated(99)
    start, end = results[0], results[-1]
    first = moved_about(found, start.x, start.q, start.w)
    assert first < 0.05  # a single pass: to first order
    assert moved_about(found, end.x, end.q, end.w) < 1e-9


@pytest.mark.parametrize("wind", [13, 15, 99])
def test_passes_about_a_trajectory_converge(wind):
    _, moves, _ = iterated(wind)
    assert moves[1] < 0.2 * moves[0]
    assert moves[-1] < 1e-6


def test_the_windows_of_a_pass_about_a_trajectory_do_not_matter():
    found, _ = case("G")
    about = smoothed(found, 20).about
    one, other = (smoothed(found, window, about) for window in (1, NEVER))
    assert apart(one.mean, other.mean, other.std) < 1e-9
    np.testing.assert_allclose(one.std, other.std, rtol=1e-9)


def residuals(found, unknown, root):
    """Whitened residuals of the start, the noise and the measurements, by the equations in plain numpy."""
    n, p, model, drive = found.n, found.path.p, found.model, found.drive
    start, noise = unknown[:n], unknown[n:].reshape(-1, p) * np.sqrt(drive.q)
    x, r = found.carry.x.copy(), flights.from_quaternion(found.carry.q)
    x[model.order] += root @ start
    told = [unknown]
    for i in range(found.count):
        h, v, r = flights.carried(x, r, drive.u[i] - noise[i, :6], drive.dt[i], model.earth)
        x[0], x[1:4], x[4:7] = h, v, 0.0
        x[model.order[model.fades > 0.0]] *= drive.fade[i]
        x[model.order[model.driven]] += noise[i, 6:]
        here = np.isfinite(drive.z[i])
        miss = drive.z[i] - flights.measured(x.astype(complex), r, drive.u[i], model.vane, model.antenna).real
        miss[1:6] = wrapped(miss[1:6])
        told.append((miss / np.sqrt(drive.r[i]))[here])
    return np.concatenate(told)


def test_passes_without_prediction_reach_the_batch_least_squares_solution():
    found = flight(3, 10, missing=0.3, prior_attitude=1e-3, prior_heading=1e-3)
    model, order = found.model._replace(wind=99), found.model.order
    result = smoothed(found, 5)
    first = result.told
    for _ in range(8):
        result = smoothed(found, 5, result.about._replace(status=first.status, r=first.r), model=model)
    root = np.linalg.cholesky(flights.covariance(found.carry))
    given_start = found.carry.x.copy()
    start = result.x[0].copy()
    start = flights.about(start, flights.from_quaternion(result.q[0]), flights.from_quaternion(found.carry.q))
    drive = found.drive
    driven = order[found.model.driven]
    fade = np.where(np.isin(driven, [15, 16, 17]), drive.fade[:, None], 1.0)
    noise = np.concatenate([result.w, result.x[1:, driven] - fade * result.x[:-1, driven]], axis=1)
    whitened = np.linalg.solve(root, (start - given_start)[order])
    ours = np.concatenate([whitened, (noise / np.sqrt(drive.q)).ravel()])
    cost = 0.5 * np.sum(residuals(found, ours, root) ** 2)
    off = ours + 0.1 * np.random.default_rng(1).normal(size=ours.size)
    batch = least_squares(lambda unknown: residuals(found, unknown, root), off, ftol=1e-13, max_nfev=6)
    assert cost == pytest.approx(batch.cost, rel=1e-9)
    np.testing.assert_allclose(batch.x, ours, atol=1e-3)


# -- statistics


@cache
def draws():
    """Flights with start, noise and sensors drawn anew, 20 of them (seeds 100 to 119), and what is said of them.

    Their priors are as good as a start from the first measurements; filters that linearise are no better than that.
    """
    start = {"prior_attitude": 0.003, "prior_heading": 0.003, "prior_velocity": 0.3, "wind": 1.5}
    flown = [flight(seed, 150, **start) for seed in range(100, 120)]
    return [(found, smoothed(found, 50)) for found in flown]


def inside(total, dof):
    """Is a sum of squares where 99.9 % of such sums are?"""
    low, high = chi2.ppf([5e-4, 1.0 - 5e-4], dof)
    return low < total < high


def test_errors_of_the_smoothed_start_are_as_large_as_their_covariance_says():
    total = dof = 0
    for found, ours in draws():
        nominal = flights.from_quaternion(found.carry.q)
        true = flights.about(found.x[0], found.r[0], nominal)
        said = flights.about(ours.x[0], flights.from_quaternion(ours.q[0]), nominal)
        error = (true - said)[found.model.order]
        total += error @ np.linalg.solve(ours.p0, error)
        dof += found.n
    assert inside(total, dof), total / dof


def test_errors_of_the_filter_at_the_end_are_as_large_as_their_covariance_says():
    total = dof = 0
    for found, ours in draws():
        carry, n = ours.carry, found.n
        assert carry.clock[2] == 0  # 150 steps, windows of 50: phi = I
        true = flights.about(found.x[-1], found.r[-1], flights.from_quaternion(carry.q))
        error = true[found.model.order] - carry.s
        whitened = carry.ut[:, 1:] @ error
        total += whitened @ (carry.d * whitened)
        dof += n
    assert inside(total, dof), total / dof


@pytest.mark.parametrize("channel", range(10))
def test_innovations_of_every_channel_are_as_large_as_their_variance_says(channel):
    squares = np.concatenate([ours.told.innovation[:, channel] ** 2 for _, ours in draws()])
    seen = np.isfinite(squares)
    assert seen.sum() > 200
    assert inside(squares[seen].sum(), seen.sum()), squares[seen].mean()


def test_innovations_are_white():
    lags = []
    for _, ours in draws():
        for channel in range(10):
            e = ours.told.innovation[:, channel]
            e = e[np.isfinite(e)]
            lags.append((np.sum(e[1:] * e[:-1]), len(e) - 1))
    total, count = np.sum(lags, axis=0)
    assert abs(total) / np.sqrt(count) < 3.5


def test_errors_of_the_smoother_are_smaller_than_those_of_the_filter():
    filtered, later = [], []
    for found, ours in draws():
        true = np.empty_like(ours.mean)
        q = np.array([extended_q(r) for r in found.r])
        extended.named(found.model, found.x, q, False, true)
        for estimate, into, at in ((ours.filtered, filtered, true[1:]), (ours.mean[1:], later, true[1:])):
            error = estimate - at
            error[:, 4:7] = wrapped(error[:, 4:7])
            into.append(np.sqrt(np.mean(error[:120] ** 2, axis=0)))
    ratio = np.mean(later, axis=0) / np.mean(filtered, axis=0)
    assert (ratio < 1.02).all()
    assert (ratio[:7] < 0.8).all()


def extended_q(r):
    return flights.Rotation.from_matrix(r).as_quat(scalar_first=True)


@pytest.mark.parametrize("mode", ["I", "P", "G"])
def test_the_benchmark_compares_two_smoothers_that_agree(mode):
    from sims.experiments.extended_speed import compare

    told = compare(120, 1, modes=(mode,))
    assert told.gap[mode] < 1e-8
    assert {t.mode for t in told.timings} == {mode}
    both = [t for t in told.timings if t.rival is not None]
    assert len(both) == 3 and all(t.ours > 0.0 and t.ratio == pytest.approx(t.rival / t.ours) for t in both)


def test_the_benchmark_wants_steps_and_rounds():
    from sims.experiments.extended_speed import compare

    with pytest.raises(ValueError, match="at least one of each"):
        compare(0, 1)
