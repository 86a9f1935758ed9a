"""Parameters beside the states: Friedland's own equations and the augmented smoother are the oracles."""

from __future__ import annotations

from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimator import extended
from estimator.separated import absorb, separated
from estimator.stretch import Diverged
from tests.estimator.flights import (
    angles,
    apart,
    covariance,
    exp,
    flight,
    from_quaternion,
    sensitivity,
    textbook,
    transition,
    wrapped,
)

NEVER = 10**9
CASES = {
    "G": {"mode": "G"},
    "G, calm": {"mode": "G", "turbulence": 0.1},
    "P": {"mode": "P"},
    "I": {"mode": "I"},
    "P, constant gusts": {"mode": "P", "turbulence_time": 1e9},
    "G, no wind walk": {"mode": "G", "wind_walk": 0.0},
}
PARAMETERS = {
    "G": ("k_airspeed", "b_alpha", "b_beta", "ba_x", "ba_y", "ba_z", "bg_x", "bg_y", "bg_z"),
    "I": ("ba_x", "ba_y", "ba_z", "bg_x", "bg_y", "bg_z"),
}


@cache
def case(name):
    """A flight of 45 steps, and what the textbook says of it, all states in one vector."""
    found = flight(1 + list(CASES).index(name), 45, **CASES[name])
    return found, textbook(found)


@cache
def friedland(name, form="corrected"):
    """Friedland's equations as he wrote them, dense: U, V, S, M and two gains."""
    found, _ = case(name)
    model, drive = found.model, found.drive
    order = model.order
    moves = ((order >= 13) & (order < 18)) | (order < 7)
    at, par = order[moves], order[~moves]
    m, k = len(at), len(par)
    start = found.carry.x.copy()
    whole = covariance(found.carry)
    x, p = start[at], whole[np.ix_(moves, moves)]
    v, big_m, b = np.zeros((m, k)), whole[np.ix_(~moves, ~moves)], np.zeros(k)
    gamma = np.zeros((len(order), found.path.p))
    gamma[model.driven, np.arange(6, found.path.p)] = 1.0
    gamma = gamma[moves]
    r, kept, fading = from_quaternion(found.carry.q), [], model.fades[moves] > 0.0

    def full(states, parameters):
        every = start.copy()
        every[at], every[par] = states, start[par] + parameters
        return every

    def best(states, v, b):
        return full(states, 0.0 * b) if form == "free" else full(states + v @ b, b)

    says = [(full(x, b), r, p, v, big_m)]
    for i in range(found.count):
        lin = best(x, v, b)
        moved, r, jacobian = transition(lin, r, drive.u[i], drive.dt[i], model.earth)
        phi, push = np.diag(np.where(fading, drive.fade[i], 1.0)), np.zeros((m, k))
        phi[-7:, -7:], push[-7:, -6:] = jacobian[:, :7], jacobian[:, 7:]
        gamma[-7:, :6] = jacobian[:, 7:]
        carried = lin[at] * np.diag(phi)
        carried[-7:] = [*moved, 0.0, 0.0, 0.0]
        before = x, v, b, p
        x = carried + phi @ (x - lin[at]) + push @ (start[par] - lin[par])
        p = phi @ p @ phi.T + gamma @ np.diag(drive.q[i]) @ gamma.T
        u = phi @ v + push
        kept.append((before, phi, (x, u, u @ b, p)))
        lin = best(x, u, b)
        lin[4:7] = 0.0
        y, h = sensitivity(lin, r, drive.u[i], model.vane, model.antenna)
        here = np.flatnonzero(np.isfinite(drive.z[i]))
        v = u
        if len(here):
            miss = (drive.z[i] - y)[here]
            round_ = np.isin(here, range(1, 6))
            miss[round_] = wrapped(miss[round_])
            hx, c = h[np.ix_(here, at)], h[np.ix_(here, par)]
            nu = miss - hx @ (x - lin[at]) - c @ (start[par] - lin[par])
            noise = np.diag(drive.r[i][here])
            s = hx @ p @ hx.T + noise
            gain = np.linalg.solve(s, hx @ p).T
            seen = hx @ u + c
            x, v = x + gain @ nu, u - gain @ seen
            left = np.eye(m) - gain @ hx
            p = left @ p @ left.T + gain @ noise @ gain.T
            second = np.linalg.solve(seen @ big_m @ seen.T + s, seen @ big_m).T
            b = b + second @ (nu - seen @ b)
            left = np.eye(k) - second @ seen
            big_m = left @ big_m @ left.T + second @ s @ second.T
        says.append((full(x + v @ b, b), r, p, v, big_m))
    xs, vs, ps, plain = x, v, p, x + v @ b
    smooth, paper = [full(xs + vs @ b, b)], [full(plain, b)]
    spreads = [(ps, vs)]
    for i in range(found.count - 1, -1, -1):
        (x0, v0, b0, p0), phi, (ahead, u, shift, ahead_p) = kept[i]
        gain = np.linalg.solve(ahead_p, phi @ p0).T
        plain = x0 + v0 @ b0 + gain @ (plain - ahead - shift)
        xs, vs = x0 + gain @ (xs - ahead), v0 + gain @ (vs - u)
        ps = p0 + gain @ (ps - ahead_p) @ gain.T
        smooth.append(full(xs + vs @ b, b))
        paper.append(full(plain, b))
        spreads.append((ps, vs))
    attitudes = [r for _, r, *_ in says]
    told = [*range(13), *order[: len(order) - 13]]

    def named(x, r):
        e = exp(-x[4:7])
        mean = x[told].copy()
        mean[1:4], mean[4:7] = e @ x[1:4], angles(r @ exp(x[4:7])).real
        return mean

    def listed(states):
        return np.array([named(x, r) for x, r in zip(states, attitudes, strict=True)])

    heights = [(ps[-7, -7], ps[-7, -7] + vs[-7] @ big_m @ vs[-7]) for ps, vs in spreads[::-1]]
    return SimpleNamespace(
        filtered=listed([x for x, *_ in says])[1:], mean=listed(smooth[::-1]), paper=listed(paper[::-1]), value=b,
        sigma=np.sqrt(np.diag(big_m)), height=np.sqrt(np.array(heights)), names=par,
    )  # fmt: skip


def run(found, **options):
    return separated(found.path, found.carry, found.drive, **options)


@pytest.mark.parametrize("name", CASES)
def test_filter_and_smoother_are_the_textbooks_with_all_states_in_one_vector(name):
    found, known = case(name)
    ours = run(found)
    assert apart(ours.filtered, known.filtered, known.filtered_std) < 1e-9
    assert apart(ours.mean, known.mean, known.std) < 1e-9
    np.testing.assert_allclose(ours.filtered_std, known.filtered_std, rtol=1e-9)
    np.testing.assert_allclose(ours.std, known.std, rtol=1e-9)
    assert np.nansum(ours.nis) == pytest.approx(known.nis, rel=1e-9)
    at = [found.path.names.index(parameter) for parameter in ours.names]
    np.testing.assert_allclose((ours.value - known.mean[-1, at]) / ours.sigma, 0.0, atol=1e-9)
    np.testing.assert_allclose(ours.sigma, known.std[-1, at], rtol=1e-9)


@pytest.mark.parametrize("name", CASES)
def test_both_are_friedlands_two_filters_with_their_gains_and_sensitivities(name):
    found, _ = case(name)
    ours, known = run(found), friedland(name)
    assert apart(ours.filtered, known.filtered, ours.filtered_std) < 1e-9
    assert apart(ours.mean, known.mean, ours.std) < 1e-9
    np.testing.assert_allclose((ours.value - known.value) / known.sigma, 0.0, atol=1e-9)
    np.testing.assert_allclose(ours.sigma, known.sigma, rtol=1e-9)
    np.testing.assert_allclose(ours.std[:, 0], known.height[:, 1], rtol=1e-9)


@pytest.mark.parametrize("name", CASES)
def test_without_feedback_everything_is_linearised_at_the_filter_that_knows_no_parameters(name):
    found, _ = case(name)
    ours, known = run(found, form="free"), friedland(name, "free")
    assert apart(ours.filtered, known.filtered, ours.filtered_std) < 1e-9
    assert apart(ours.mean, known.mean, ours.std) < 1e-9
    np.testing.assert_allclose(ours.sigma, known.sigma, rtol=1e-9)


@pytest.mark.parametrize("name", CASES)
def test_the_papers_smoother_takes_the_running_parameters_for_known(name):
    found, _ = case(name)
    ours, known = run(found, form="paper"), friedland(name)
    assert apart(ours.filtered, known.filtered, ours.filtered_std) < 1e-8
    assert apart(ours.mean, known.paper, ours.std) < 1e-8
    np.testing.assert_allclose(ours.std[:, 0], known.height[:, 0], rtol=1e-9)
    np.testing.assert_allclose(ours.sigma, known.sigma, rtol=1e-9)


def test_the_papers_smoother_is_too_sure_and_forgets_what_is_learnt_later():
    found = flight(5, 400)
    exact, paper = run(found), run(found, form="paper")
    moving = [i for i, name in enumerate(found.path.names) if name not in exact.names]
    assert (paper.std[:, moving] <= exact.std[:, moving] * (1.0 + 1e-9)).all()
    assert paper.std[0, 6] < 0.999 * exact.std[0, 6]
    assert apart(paper.mean[:100], exact.mean[:100], exact.std[:100]) > 1.0
    assert apart(paper.mean[-1:], exact.mean[-1:], exact.std[-1:]) < 1e-9


def test_what_the_form_without_feedback_leaves_out_is_of_second_order():
    """Where every error is a quarter of what it was, so are the sigmas, and the rest is a sixteenth."""
    errors = {"airspeed": 0.3, "flow_angle": 2e-3, "attitude": 2e-3, "heading": 3e-3, "height": 1.0}
    errors |= {"gnss_velocity": 0.05, "accelerometer": 0.02, "gyro": 3e-4, "accelerometer_bias": 0.3}
    errors |= {"gyro_bias": 0.01, "airspeed_scale": 0.05, "flow_offset": 0.02, "wind": 5.0, "wind_walk": 0.02}
    errors |= {"prior_height": 5.0, "prior_attitude": 0.02, "prior_heading": 0.02, "prior_velocity": 2.0}
    errors |= {"turbulence": 5.0}
    gaps = []
    for scale in (1.0, 0.25, 0.0625):
        found = flight(2, 200, **{name: scale * value for name, value in errors.items()})
        exact, free = run(found), run(found, form="free")
        gaps.append(np.linalg.norm((free.value - exact.value) / exact.sigma))
    assert gaps[1] < 0.3 * gaps[0]
    assert 0.0 < gaps[2] < 0.3 * gaps[1]


@pytest.mark.parametrize(("window", "block"), [(1, 2000), (7, 20), (NEVER, 2000), (NEVER, 11), (20, 4)])
@pytest.mark.parametrize("form", ["corrected", "free", "paper"])
def test_windows_and_blocks_do_not_matter(window, block, form):
    found, _ = case("G")
    ours, other = run(found, form=form), run(found, form=form, window=window, block=block)
    assert apart(other.mean, ours.mean, ours.std) < 1e-8
    assert apart(other.filtered, ours.filtered, ours.filtered_std) < 1e-8
    np.testing.assert_allclose(other.std, ours.std, rtol=1e-8)
    np.testing.assert_allclose(other.sigma, ours.sigma, rtol=1e-9)


def test_parameters_that_are_correlated_with_the_states_at_the_start_go_on_from_there():
    found = flight(8, 120)
    carry, told = found.carry.copy(), extended.Told.empty(120, found.n)
    rows = extended.Rows.empty(120, found.n, found.path.p)

    def advance(first, stop):
        nothing = extended.About.nothing()
        drive, part, said = found.drive.part(first, stop), rows.part(first, stop), told.part(first, stop)
        assert extended.forward(found.model, drive, nothing, 100, False, carry, True, part, said) == -1

    advance(0, 70)
    before = carry.copy()
    ours = separated(found.path, carry, found.drive.part(70, 120))
    for one, other in zip(carry, before, strict=True):
        np.testing.assert_array_equal(one, other)
    advance(70, 120)
    mean = np.empty((120, found.n))
    extended.named(found.model, rows.x, rows.q, True, mean)
    assert apart(ours.filtered, mean[70:], told.std[70:]) < 1e-8
    np.testing.assert_allclose(ours.filtered_std, told.std[70:], rtol=1e-8)


@settings(max_examples=25, deadline=None)
@given(
    st.integers(0, 2**31), st.integers(1, 6), st.integers(1, 5), st.floats(-6.0, 6.0), st.floats(-6.0, 6.0)
)  # fmt: skip
def test_two_factors_absorb_what_one_of_all_states_would(seed, m, k, size, weight):
    """A linear problem: x and b at rest, prior N(0, I), scalars z = H x + C b + v; the oracle is least squares."""
    rng = np.random.default_rng(seed)
    count = 2 * (m + k)
    h, c = rng.normal(size=(count, m)), 10.0**size * rng.normal(size=(count, k))
    z, r = rng.normal(size=count), 10.0 ** (-weight) * rng.uniform(0.5, 2.0, count)
    ut, d = np.concatenate([np.zeros((m, 1 + k)), np.eye(m)], axis=1), np.ones(m)
    ub, db = np.concatenate([np.zeros((k, 1)), np.eye(k)], axis=1), np.ones(k)
    squares = 0.0
    for i in range(count):
        row = np.concatenate([[z[i]], -c[i], h[i]])
        squares += absorb(ut, d, ub, db, row, np.empty(1 + k), 1.0 / r[i])
    every = np.concatenate([np.eye(k + m), np.concatenate([c, h], axis=1) / np.sqrt(r)[:, None]])
    data = np.concatenate([np.zeros(k + m), z / np.sqrt(r)])
    q, triangle = np.linalg.qr(every)
    known = np.linalg.solve(triangle, q.T @ data)
    sigma = np.linalg.norm(np.linalg.inv(triangle), axis=1)
    b = np.linalg.solve(ub[:, 1:], ub[:, 0])
    x = np.linalg.solve(ut[:, 1 + k :], ut[:, : 1 + k] @ np.concatenate([[1.0], b]))
    np.testing.assert_allclose((np.concatenate([b, x]) - known) / sigma, 0.0, atol=1e-8)
    np.testing.assert_allclose(squares, np.sum(np.square(data - every @ known)), rtol=1e-8)


@pytest.mark.parametrize("name", PARAMETERS)
def test_biases_and_scale_errors_are_the_parameters(name):
    found, _ = case(name)
    ours = run(found)
    assert ours.names == PARAMETERS[name]
    assert ours.units == tuple(found.path.units[found.path.names.index(parameter)] for parameter in ours.names)
    assert not ours.constant


def test_biases_that_walk_are_constants_here_and_the_result_says_so():
    walking = flight(6, 60, accelerometer_walk=0.01, gyro_walk=1e-3)
    still = flight(6, 60)
    ours = separated(walking.path, walking.carry, walking.drive)
    known = separated(still.path, walking.carry, walking.drive._replace(q=walking.drive.q[:, :11].copy()))
    assert ours.constant and not known.constant
    np.testing.assert_array_equal(ours.mean, known.mean)
    np.testing.assert_array_equal(ours.std, known.std)


def test_standard_deviations_are_told_where_they_are_wanted():
    found, _ = case("G")
    shown = (np.arange(found.count) % 5 == 0).astype(np.uint8)
    every, some = run(found), separated(found.path, found.carry, found.drive._replace(shown=shown))
    wanted = np.concatenate([[True], shown == 1])
    np.testing.assert_array_equal(some.std[wanted], every.std[wanted])
    assert np.isnan(some.std[~wanted]).all()
    np.testing.assert_array_equal(some.mean, every.mean)


def test_a_filter_alone_smooths_nothing():
    found, _ = case("P")
    alone, both = run(found, smooth=False), run(found)
    assert alone.mean.shape == (0, found.n) == alone.std.shape
    np.testing.assert_array_equal(alone.filtered, both.filtered)
    np.testing.assert_array_equal(alone.value, both.value)


def test_what_cannot_be_done_is_said():
    found, _ = case("G")
    with pytest.raises(ValueError, match="no steps"):
        separated(found.path, found.carry, found.drive.part(0, 0))
    with pytest.raises(ValueError, match="form 'exact' is none of"):
        separated(found.path, found.carry, found.drive, form="exact")
    z = found.drive.z.copy()
    z[30, 6] = np.inf
    with pytest.raises(Diverged) as caught:
        separated(found.path, found.carry, found.drive._replace(z=z))
    assert caught.value.step == 30
