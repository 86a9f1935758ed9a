"""The accuracy table: what the stage says, figures that the truth itself passes, targets that can be missed."""

import dataclasses
import functools
import io

import msgspec
import numpy as np
import pytest
from rich.console import Console

import sims
from estimator import reconstruct
from estimator.stage import estimate
from sims.experiments import scoring, truth_table
from sims.experiments.passes import NoStart, Passes, Path, prepare
from sims.experiments.scoring import AIR, FILTER, HYBRID, KINEMATIC, SAVGOL, SENSORS, SMOOTHER, WINDOWS
from sims.experiments.truth_table import Plan, compare, gusts, settings
from telemetry.messages import Gnss, Window

from .conftest import UTC

PLAN = sims.PLANS["turn-record"]


@pytest.fixture(scope="module")
def flown():
    return sims.fly("737", PLAN, sensors="fti", turbulence=3, seed=5, duration=40, start_utc=UTC)


@pytest.fixture(scope="module")
def passes(flown):
    return Passes(prepare(sims.messages(flown), settings(flown, "gusts")))


@pytest.fixture(scope="module")
def found():
    return compare(Plan(("737",), ("turn-record",), ("fti",), ("gusts", "calm"), 2, (10.0,)), processes=1)


def test_filter_smoother_and_hybrid_say_what_the_stage_says_to_the_last_bit(flown, passes):
    chosen = settings(flown, "gusts")
    with_pass = reconstruct(sims.messages(flown), chosen)
    without = reconstruct(sims.messages(flown), msgspec.structs.replace(chosen, iterate=0))
    assert np.array_equal(with_pass.t, passes.record.t)
    for path, mean, std in (
        (passes.filter(), with_pass.filtered, with_pass.filtered_std),
        (passes.smoother(), without.smoothed, without.smoothed_std),
        (passes.hybrid(), with_pass.smoothed, with_pass.smoothed_std),
    ):
        assert np.array_equal(path.mean, mean)
        assert np.array_equal(path.std, std)
    assert {name: tally.nis for name, tally in passes.tallies().items()} == with_pass.nis


def test_windows_say_what_the_stage_says_to_the_last_bit(flown, passes):
    chosen = msgspec.structs.replace(settings(flown, "gusts"), window=10.0, model="flight_path")
    told = [m for m in estimate(sims.messages(flown), chosen) if isinstance(m, Window) and m.model == "flight_path"]
    path = passes.windows(10.0)
    assert len(told) == 4
    assert np.array_equal(np.concatenate([window.mean for window in told]), path.mean)
    assert np.array_equal(np.concatenate([window.std for window in told]), path.std)


def test_gusts_predicted_alone_are_another_estimate_than_gusts_and_wind(passes):
    assert not np.array_equal(passes.hybrid().mean, passes.hybrid(predict_wind=False).mean)
    assert np.array_equal(passes.hybrid().mean, passes.hybrid().mean)


def test_samples_without_a_fix_are_no_record(flown):
    with pytest.raises(NoStart, match="no satellite fix"):
        prepare([m for m in sims.messages(flown) if not isinstance(m, Gnss)], settings(flown, "gusts"))


def test_the_textbooks_covariances_are_those_of_the_error_bars(passes):
    before, after = passes.covariances()
    for path, covariance in ((passes.filter(), before), (passes.smoother(), after)):
        assert np.allclose(np.sqrt(covariance[:, 0, 0]), path.std[:, 0], rtol=0.02)  # height is height to both


def test_the_truth_has_no_errors(flown, passes):
    record = passes.record
    truth = scoring.truth_at(flown, record.t)
    exact = Path(np.stack([truth[name] for name in record.flight.names], axis=1), passes.filter().std)
    assert np.abs(scoring.kinematic_errors(record, exact, truth)).max() < 1e-9
    for name, column in scoring.air(record.flight.names, exact.mean).items():
        assert np.abs(column - truth[name]).max() < 1e-9


def test_errors_of_velocity_and_attitude_are_told_about_the_axes_of_the_estimate(flown, passes):
    record, small = passes.record, 1e-4
    truth = scoring.truth_at(flown, record.t)
    names = record.flight.names
    mean = np.stack([truth[name] for name in names], axis=1)
    mean[:, names.index("u")] -= 0.5
    mean[:, names.index("h")] -= 2.0
    error = scoring.kinematic_errors(record, Path(mean, mean), truth)
    assert np.allclose(error[:, :4], [2.0, 0.5, 0.0, 0.0], atol=1e-9)
    mean[:, names.index("phi")] -= small
    error = scoring.kinematic_errors(record, Path(mean, mean), truth)
    assert np.allclose(error[:, 4:], [small, 0.0, 0.0], atol=1e-7)  # a roll is a rotation about the x axis


def test_gusts_are_described_without_their_mean(flown):
    random = np.random.default_rng(4)
    n, a = len(flown.truth), np.exp(-0.01 / 0.5)
    swing = np.zeros((n, 3))
    for i in range(1, n):
        swing[i] = a * swing[i - 1] + np.sqrt(1.0 - a * a) * random.normal(size=3)
    truth = dataclasses.replace(flown.truth, wind=np.array([-3.0, 4.0, 0.0]) + 1.5 + 2.0 * swing)
    told = gusts(truth, (-3.0, 4.0))
    assert np.allclose(told["std"], 2.0, rtol=0.35)
    assert np.allclose(told["mean"], 1.5, atol=1.2)
    assert np.allclose(told["after 1 s"], np.exp(-2.0), atol=0.25)


def test_the_smoother_is_better_than_the_filter_and_the_filter_than_the_sensors(found):
    for case in found.cases:
        for name in KINEMATIC[1:6]:
            assert case.rmse[name][SMOOTHER] < 0.85 * case.rmse[name][FILTER]
        for name in ("h", "theta", "phi", "psi"):
            assert case.rmse[name][FILTER] < 0.5 * case.rmse[name][SAVGOL] < case.rmse[name][SENSORS]


def test_error_bars_of_the_kinematic_states_are_honest(found):
    for case in found.cases:
        for method in (FILTER, SMOOTHER, HYBRID, f"{10:.0f} s"):
            assert 0.85 < np.mean([case.cover[method][name] for name in KINEMATIC]) <= 1.0
            assert 0.4 < np.mean([case.nees[method][name] for name in KINEMATIC]) < 2.0
        assert 0.4 < case.joint[SMOOTHER] < 2.0
        assert all(0.8 < value < 1.25 for value in case.nis.values())


def test_calm_air_makes_air_data_better(found):
    rough, calm = found.cases
    for name in AIR:
        assert calm.rmse[name][SMOOTHER] < 0.5 * rough.rmse[name][SMOOTHER]


def test_a_flat_earth_raises_the_alarm_and_the_true_one_does_not(found):
    assert found.flat_alarms["737 turn-record"] > 0
    assert found.round_alarms["737 turn-record"] == 0


def test_targets_are_met_or_missed(found):
    assert any(target.met for target in found.targets)
    worse = [dataclasses.replace(c, cover={m: dict.fromkeys(c.cover[m], 0.5) for m in c.cover}) for c in found.cases]
    missed = truth_table.judge(worse, {"737 turn-record": 0}, {"737 turn-record": 2})
    assert all(not target.met for target in missed if "coverage" in target.what or "alarms" in target.what)
    assert "0.5 (737 turn-record)" in missed[0].found


def test_everything_is_printed_and_told_as_json(found):
    console = Console(width=200, record=True, file=io.StringIO())
    for table in found.tables():
        console.print(table)
    text = console.export_text()
    for word in ("RMSE after 10 s, fti, calm", "737 turn-record beta, deg", "targets", "NEES"):
        assert word in text
    told = msgspec.json.decode(msgspec.json.encode(found))
    assert told["cases"][0]["rmse"]["u"].keys() == {FILTER, "10 s", SMOOTHER, HYBRID, scoring.HYBRID_T}
    assert len(WINDOWS) == 2


def test_draws_of_different_cases_share_nothing():
    tasks = [("c172x", "level", "gusts", 1), ("c172x", "level", "gusts", 2)]
    work = functools.partial(truth_table.draw, tasks, (), ("fti",))
    one, two = work(0), work(1)
    assert one.gusts["std"] != two.gusts["std"]
    assert one.scores["fti"].rmse[FILTER] != two.scores["fti"].rmse[FILTER]


def test_no_draw_is_refused():
    with pytest.raises(ValueError, match="at least one draw"):
        compare(Plan(seeds=0))
