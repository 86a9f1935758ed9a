"""The radar problem of cubature filtering, and what of Tang's tables reproduces."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from estimator import cubature
from sims.experiments import tang
from sims.experiments.coordinated_turn import (
    FIRST,
    LAGS,
    P0,
    PROBLEM,
    R0,
    STEPS,
    X0,
    draw,
    radar,
    radar_jacobian,
    turn,
    turn_jacobian,
)
from sims.experiments.stress import verdicts
from sims.experiments.turn_batches import CHUNK, LOST, METHODS, Outcome, run
from sims.experiments.turn_costs import Range
from tests.console import run as sortie

SEED = 2


@pytest.fixture(scope="module")
def draws():
    return draw(200, SEED)


@pytest.fixture(scope="module")
def found():
    return tang.compare(200, SEED, rounds=1)


def within(found_range, low, high):
    assert low <= found_range.value <= high


# the problem


def test_a_turn_keeps_speed_and_turns_by_its_rate():
    x = np.array([10.0, 30.0, -20.0, 40.0, 0.3])
    after = turn(x)
    assert np.hypot(after[1], after[3]) == pytest.approx(50.0)
    assert np.arctan2(after[3], after[1]) - np.arctan2(40.0, 30.0) == pytest.approx(0.3)
    for _ in range(9):
        after = turn(after)
    x[4] = after[4] = 2.0 * np.pi / 8.0
    there = x
    for _ in range(8):
        there = turn(there)
    np.testing.assert_allclose(there, x, atol=1e-12)


def test_a_turn_of_hardly_any_rate_is_a_straight_line():
    x = np.array([10.0, 30.0, -20.0, 40.0, 0.0])
    np.testing.assert_allclose(turn(x), [40.0, 30.0, 20.0, 40.0, 0.0])
    for rate in (0.99e-9, 1.01e-9):  # on both sides of the switch to the series: X' turns by the rate, X by half of it
        x[4] = rate
        np.testing.assert_allclose(
            turn(x)[:4] - [40.0, 30.0, 20.0, 40.0], rate * np.array([-20, -40, 15, 30]), atol=3e-14
        )


@pytest.mark.parametrize("rate", [0.3, -0.05, 1.1e-4, 0.9e-4, 1e-7, 0.0])
def test_jacobians_are_the_slopes_of_the_models(rate):
    x = np.array([900.0, 250.0, 1100.0, -80.0, rate])
    for model, jacobian in ((turn, turn_jacobian), (radar, radar_jacobian)):
        slopes = jacobian(x)
        for j, by in enumerate((1e-1, 1e-1, 1e-1, 1e-1, 1e-4)):
            step = by * np.eye(5)[j]
            numeric = (
                (8.0 * (model(x + step) - model(x - step)) - (model(x + 2 * step) - model(x - 2 * step))) / 12 / by
            )
            np.testing.assert_allclose(slopes[:, j], numeric, atol=1e-8 * max(1.0, np.abs(slopes[:, j]).max()))


def test_the_noise_of_the_problem_is_that_of_its_authors():
    q = PROBLEM.sqrt_q @ PROBLEM.sqrt_q.T
    block = 0.1 * np.array([[1 / 3, 1 / 2], [1 / 2, 1]])
    np.testing.assert_allclose(q[:2, :2], block)
    np.testing.assert_allclose(q[2:4, 2:4], block)
    assert q[4, 4] == pytest.approx(1.75e-4)
    np.testing.assert_allclose(np.diag(PROBLEM.sqrt_r) ** 2, [100.0, 1e-5])
    np.testing.assert_allclose(np.diag(PROBLEM.sqrt_p) ** 2, [100.0, 10.0, 100.0, 10.0, 0.01])


def test_truths_and_measurements_have_the_noise_that_the_filters_are_told(draws):
    shape = draws.z.shape
    assert draws.truth.shape == (200, STEPS + LAGS + 1, 5) and shape == (200, STEPS + LAGS, 2)
    np.testing.assert_array_equal(draws.truth[:, 0], np.tile(X0, (200, 1)))
    moved = np.array([[turn(x) for x in one[:-1]] for one in draws.truth[:20]])
    white = np.linalg.solve(PROBLEM.sqrt_q, (draws.truth[:20, 1:] - moved).reshape(-1, 5).T)
    np.testing.assert_allclose(white @ white.T / white.shape[1], np.eye(5), atol=0.1)
    error = draws.z[:20] - np.array([[radar(x) for x in one[1:]] for one in draws.truth[:20]])
    error[..., 1] = np.angle(np.exp(1j * error[..., 1]))
    np.testing.assert_allclose(error.reshape(-1, 2).std(axis=0), R0, rtol=0.06)
    assert np.abs(draws.z[..., 1]).max() <= np.pi
    np.testing.assert_allclose((draws.start - X0).std(axis=0), P0, rtol=0.2)


def test_a_run_is_the_same_in_a_batch_of_any_size(draws):
    for few, many in zip(draw(30, SEED), draws, strict=True):
        np.testing.assert_array_equal(few, many[:30])


# the batches


def test_results_do_not_depend_on_threads_or_on_the_size_of_the_batch(draws):
    few = draw(CHUNK + 7, SEED)
    for name in ("sr_ckf", "ckf"):
        whole = run(METHODS[name], draws, threads=2)
        for threads in (1, 2, 3):
            for one, other in zip(run(METHODS[name], few, threads), whole, strict=True):
                np.testing.assert_array_equal(one, other[: CHUNK + 7])


def test_a_batch_gives_what_the_filters_give_step_by_step(draws):
    last = FIRST + 3
    steps = {
        "sr_ckf": cubature.filter_step, "a": cubature.backward_smoothing_step, "diplf": cubature.diplf_step,
    }  # fmt: skip
    few = draw(2, SEED)
    for name, step in steps.items():
        squares = run(METHODS[name], few).squares[1]
        mean, root = few.start[1], PROBLEM.sqrt_p
        for k in range(1, last + 1):
            mean, root = step(
                mean, root, turn.py_func, radar.py_func, few.z[1, k - 1], PROBLEM.sqrt_q, PROBLEM.sqrt_r, (1,)
            )
            if k >= FIRST:
                error = mean - few.truth[1, k]
                known = [
                    error[0] ** 2 + error[2] ** 2, error[1] ** 2 + error[3] ** 2, error[4] ** 2,
                    error @ np.linalg.solve(root @ root.T, error) / 5,
                ]  # fmt: skip
                np.testing.assert_allclose(squares[:, k - FIRST], known, rtol=1e-6)


def test_the_whole_interval_ends_where_the_filter_ends_and_a_lag_lies_between(draws):
    few = draw(3, SEED)
    filtered, whole = (run(METHODS[name], few).squares for name in ("sr_ckf", "sr_cks"))
    np.testing.assert_allclose(whole[..., -1], filtered[..., -1], rtol=1e-9)
    assert not np.allclose(whole[..., -2], filtered[..., -2], rtol=1e-3)
    lags = [run(METHODS[f"lag_{lag}"], few).squares for lag in range(LAGS + 1)]
    np.testing.assert_array_equal(lags[0], filtered)
    # smoothed with the measurements up to the last step: the same as the lag that reaches there
    for lag in (1, 3, LAGS):
        np.testing.assert_allclose(lags[lag][..., STEPS - FIRST - lag], whole[..., STEPS - FIRST - lag], rtol=1e-6)


# the tables


def test_the_published_numbers_do_not_give_the_published_per_cents():
    assert tang.PAPER["sr_ckf"] == (24.9789, 14.0939, 1.4096)
    assert tang.PAPER["a"] == (22.9108, 13.6139, 1.4018)
    printed = tang.gains(tang.PAPER["sr_ckf"], tang.PAPER["a"])
    np.testing.assert_allclose(printed, (8.28, 3.41, 0.55), atol=0.005)
    assert tang.PAPER_GAINS == (10.0, 4.0, 1.0)


def test_two_hundred_runs_give_what_they_should(found):
    root, again, iterated = (found.row(name) for name in ("sr_ckf", "a", "diplf"))
    within(root.kept.rmse[0], 20.5, 25.5)
    within(root.kept.rmse[1], 11.2, 13.2)
    within(root.kept.rmse[2], 1.29, 1.43)
    within(root.kept.anees, 1.10, 1.45)
    for gain, low, high in zip(again.kept.gains, (2.0, -3.0, -3.0), (10.0, 4.5, 0.0), strict=True):
        within(gain, low, high)
    within(again.kept.anees, 1.45, 1.90)
    for gain, low, high in zip(iterated.kept.gains, (3.0, 0.0, -0.2), (10.0, 5.5, 0.8), strict=True):
        within(gain, low, high)
    within(iterated.kept.anees, 1.00, 1.12)
    within(found.row("a_inflated").kept.anees, 0.98, 1.15)
    assert root.lost == iterated.lost == 0 and again.lost <= 1


def test_the_covariance_form_gives_the_same_table_and_linearisation_a_worse_one(found):
    for plain, root in zip(found.row("ckf").every.rmse, found.row("sr_ckf").every.rmse, strict=True):
        assert plain.value == pytest.approx(root.value, rel=1e-9)
    assert found.row("ckf").stopped == 0
    assert found.row("ekf").every.rmse[0].low > found.row("sr_ckf").every.rmse[0].high
    assert found.row("ekf").every.anees.value > 2.0
    within(found.row("ukf").every.gains[0], -6.0, -0.5)


def test_a_delay_buys_more_than_any_filter_and_the_whole_interval_most(found):
    positions = [found.row(f"lag_{lag}").every.rmse[0].value for lag in range(LAGS + 1)]
    assert positions == sorted(positions, reverse=True)
    for gain, known in zip(found.row("lag_1").every.gains, (20.0, 34.0, 17.0), strict=True):
        assert gain.value == pytest.approx(known, abs=4.0)
        assert gain.low > max(row.every.gains[0].value for row in found.rows if row.name in ("a", "diplf"))
    for figure, known in zip(found.row("sr_cks").every.rmse, (12.83, 4.13, 0.579), strict=True):
        assert figure.value == pytest.approx(known, rel=0.12)


def test_intervals_hold_the_figures_and_the_paired_ones_are_the_narrower(found):
    for row in found.rows:
        for each in (*row.every.rmse, row.every.anees, *row.every.gains):
            assert each.low <= each.value <= each.high
    root, iterated = found.row("sr_ckf").every.rmse[0], found.row("diplf").every.gains[0]
    assert (root.high - root.low) / root.value > 2.0 * (iterated.high - iterated.low) / 100.0


def test_costs_are_told_for_filters_and_for_the_peer_if_it_is_there(found):
    root = found.cost("sr_ckf")
    assert root.ratio == Range(1.0, 1.0, 1.0)
    assert found.cost("a").ratio.value > 1.0
    peer = found.costs[-1]
    assert peer.note == "not installed" if peer.seconds is None else peer.ratio.value > 1.0


# what is said of them


def test_claims_follow_from_the_figures(found):
    claims = {claim.what: claim for claim in found.claims}
    assert claims["gains as stated in words"].verdict == "not what its table says"
    assert claims["SR-CKF: velocity 14.09 m/s"].verdict.startswith("not reproduced")
    assert claims["all three figures of SR-CKF together"].verdict == "not reproduced"
    turn_rate = next(claim for what, claim in claims.items() if what.startswith("SR-BS-CKF: turn rate"))
    assert turn_rate.verdict.startswith("not reproduced")
    assert claims["covariance of SR-BS-CKF (z used twice)"].verdict == "overconfident"
    assert claims["iterating improves further: SR-BS-CKF (A)"].verdict.startswith("does not hold")
    assert claims["square roots are stronger numerically"].verdict == "holds"
    assert claims["square roots are needed for Table 1"].verdict == "does not hold"


@pytest.mark.parametrize(
    ("printed", "expected", "verdict"),
    [
        (8.0, Range(5.0, 2.0, 8.1, 1.5), "reproduced"),
        (8.0, Range(5.0, 2.0, 7.9, 1.5), "at the edge: 2.0 sigma above"),
        (8.0, Range(5.0, 2.0, 7.0, 1.0), "not reproduced: 3.0 sigma above"),
        (1.0, Range(5.0, 3.0, 7.0, 1.0), "not reproduced: 4.0 sigma below"),
        (0.5, Range(-1.5, -2.5, -0.5, 0.5), "not reproduced: the sign is opposite, 4.0 sigma above"),
    ],
)
def test_a_printed_figure_is_judged_by_where_it_lies(printed, expected, verdict):
    assert tang._against("", printed, expected, "%").verdict == verdict


def outcomes(runs, far=()):
    """Made-up errors: those of "a" are half of those of "sr_ckf", but for runs that go far away."""
    rng = np.random.default_rng(1)
    squares = rng.uniform(1.0, 9.0, (runs, 4, 3))
    distance = np.full(runs, 10.0)
    moved, gone = squares / 4.0, distance.copy()
    for r in far:
        moved[r], gone[r] = 1e6, LOST + 1.0
    still = np.zeros(runs, bool)
    return {"sr_ckf": Outcome(squares, distance, still), "a": Outcome(moved, gone, still)}


def test_figures_are_root_means_over_runs_and_means_over_steps():
    squares = outcomes(7)["sr_ckf"].squares
    weights = np.array([[1.0] * 7, [2.0, 0, 0, 0, 0, 0, 1.0]])
    one, other = tang.figures(weights, squares)
    np.testing.assert_allclose(one[:2], [np.sqrt(squares[:, i].mean(axis=0)).mean() for i in (0, 1)])
    assert one[2] == pytest.approx(np.degrees(np.sqrt(squares[:, 2].mean(axis=0)).mean()))
    assert one[3] == pytest.approx(squares[:, 3].mean())
    twice = (2.0 * squares[0, 0] + squares[6, 0]) / 3.0
    assert other[0] == pytest.approx(np.sqrt(twice).mean())


def test_a_lost_run_is_counted_shown_and_left_out():
    row = tang.Judge(outcomes(50, far=[3]), seed=1).row("a")
    assert row.lost == 1
    assert row.every.rmse[0].value > 100.0 and row.every.gains[0].value < -1000.0
    for gain in row.kept.gains:
        assert gain.value == pytest.approx(50.0)
        assert gain.low == pytest.approx(50.0) and gain.high == pytest.approx(50.0)
    # some experiments draw the lost run not at all, some more than once
    assert row.every.gains[0].high == pytest.approx(50.0)


def test_intervals_shrink_with_the_number_of_runs_and_those_for_the_paper_do_not():
    few, many = outcomes(100), outcomes(1600)

    def width(judge):
        figures = judge.of("sr_ckf").rmse[0]
        return figures.high - figures.low

    assert width(tang.Judge(few, 1)) / width(tang.Judge(many, 1)) == pytest.approx(4.0, rel=0.3)
    widened = width(tang.Judge(many, 1, 100)) / width(tang.Judge(few, 1))
    assert widened == pytest.approx(np.sqrt(1.0 + 100 / 1600), rel=0.3)


def test_hard_cases_break_the_covariance_form_only():
    for verdict in verdicts():
        assert verdict.plain_fails and not verdict.square_root_fails
        assert verdict.square_root_error < (1e-4 if "float32" in verdict.case else 1e-8)


def test_too_few_runs_are_refused():
    with pytest.raises(ValueError, match="--runs is 1: at least 2"):
        tang.compare(1)
    with pytest.raises(ValueError, match="--seed is -1"):
        tang.compare(5, -1)
    with pytest.raises(ValueError, match="threads is 0"):
        run(METHODS["sr_ckf"], draw(1, 1), threads=0)


# the command


def test_the_command_prints_tables_and_verdicts():
    done = sortie("reproduce", "tang", "--runs", "8")
    assert done.returncode == 0, done.stderr
    for text in (
        "Table 1: 8 runs, seed 1",
        "paper: SR-BS-CKF",
        "+8.28",
        "Table 2",
        "2 to 3",
        "Hard cases",
        "verdict",
        "DIPLF",
    ):
        assert text in done.stdout
    assert "8 runs: SR-BS-CKF (A)" in done.stderr


def test_the_command_prints_json_which_follows_from_runs_and_seed():
    first, second = (sortie("reproduce", "tang", "--runs", "4", "--seed", "7", "--json") for _ in range(2))
    assert first.returncode == 0, first.stderr
    one, other = (msgspec.json.decode(done.stdout) for done in (first, second))
    assert one["runs"] == 4 and one["seed"] == 7
    assert one["rows"] == other["rows"] and one["expected"] == other["expected"] and one["stress"] == other["stress"]
    assert {row["name"] for row in one["rows"]} == set(METHODS)
    assert len(one["claims"]) > 10
