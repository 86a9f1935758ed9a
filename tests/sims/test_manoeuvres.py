"""A plan is data."""

import numpy as np
import pytest

import sims
from sims.manoeuvres import PLANS, Plan, PlanError, Segment, doublet, find, three_two_one_one

from .conftest import UTC


def test_neighbouring_segments_share_a_test_point():
    demo = PLANS["demo"]
    assert demo.test_points() == [("TP 1", 20, 70), ("TP 2", 84, 120), ("TP 3", 136, 150)]
    assert demo.duration == 170


def test_the_last_segment_goes_on():
    plan = Plan("two", (Segment("a", 10), Segment("b", 5)))
    assert plan.at(0) == (0, 0)
    assert plan.at(10) == (1, 0)
    assert plan.at(99) == (1, 89)


def test_a_plan_without_segments_is_refused():
    with pytest.raises(PlanError, match="no segments"):
        Plan("none", ()).at(0)


def test_3211_alternates_and_ends():
    signal = three_two_one_one(unit=1.0, amplitude=0.1, delay=2.0)
    assert [signal.at(t + 0.5) for t in range(11)] == [0, 0, 0.1, 0.1, 0.1, -0.1, -0.1, 0.1, -0.1, 0, 0]
    assert not signal.active(1.9)
    assert signal.active(2.0)


def test_a_doublet_has_no_mean():
    signal = doublet(unit=0.5, delay=0.0)
    assert sum(signal.at(0.01 * k) for k in range(200)) == pytest.approx(0)


def test_plans_are_found_by_name_or_given():
    assert find("demo") is PLANS["demo"]
    assert find(PLANS["turn"]) is PLANS["turn"]
    with pytest.raises(PlanError, match=r"known: .*calibration, demo"):
        find("spin")


def test_a_load_factor_is_linear_between_its_points_and_stays_at_the_last():
    segment = Segment("pull", 9.0, load=((0.0, 1.0), (1.0, 1.0), (3.0, 2.0)))
    assert [segment.load_at(t) for t in (0, 0.5, 1, 2, 3, 8)] == [1, 1, 1, 1.5, 2, 2]


def test_points_are_five_test_points_for_a_demonstration():
    plan = PLANS["points"]
    assert [point.name for point in plan.test_points()] == [f"TP {n}" for n in range(1, 6)]
    assert 140 <= plan.duration <= 160


def test_a_calibration_has_all_six_inputs_and_the_others_last_as_long():
    plan = PLANS["calibration"]
    assert [s.input.axis for s in plan.segments if s.input] == ["elevator", "aileron", "rudder"]
    assert {"push-over and pull-up", "wind-up turn", "bank right", "bank left"} <= {s.name for s in plan.segments}
    for name in ("calibration", "straight", "turn-record"):
        assert 95 <= PLANS[name].duration <= 110


@pytest.fixture(scope="module", params=["c172x", "737", "T38"])
def calibration(request):
    return sims.fly(request.param, "calibration", sensors="fti", start_utc=UTC)


def load(flight, name):
    return -flight.truth.specific_force[during(flight, name), 2] / 9.80665


def during(flight, name):
    return flight.truth.segment == [s.name for s in flight.plan.segments].index(name)


def turned(flight, which):
    """Degrees of heading between the extremes."""
    return np.degrees(np.ptp(np.unwrap(flight.truth.attitude[which, 2])))


def test_a_push_pull_ranges_over_the_load_factor_with_the_wings_level(calibration):
    n = load(calibration, "push-over and pull-up")
    assert n.min() < 0.6
    assert n.max() > 1.4
    phi = calibration.truth.attitude[during(calibration, "push-over and pull-up"), 0]
    assert np.abs(np.degrees(phi)).max() < 5


def test_a_wind_up_turn_tightens_and_turns_more_than_ninety_degrees(calibration):
    n = load(calibration, "wind-up turn")
    agile = 1.4 if calibration.aircraft == "T38" else 1.0
    assert n.max() == pytest.approx(1 + 0.7 * agile, abs=0.15)
    assert turned(calibration, during(calibration, "wind-up turn")) > 95
    altitude = calibration.truth.altitude[during(calibration, "wind-up turn")]
    assert np.ptp(altitude) < 120


def test_bank_to_bank_goes_thirty_degrees_both_ways(calibration):
    assert np.degrees(calibration.truth.attitude[during(calibration, "bank right"), 0]).max() > 25
    assert np.degrees(calibration.truth.attitude[during(calibration, "bank left"), 0]).min() < -22


def test_doublets_excite_their_axis(calibration):
    rates = np.degrees(calibration.truth.rates)
    assert np.ptp(rates[during(calibration, "aileron doublet"), 0]) > 15
    assert np.ptp(np.degrees(calibration.truth.beta[during(calibration, "rudder doublet")])) > 2


def test_no_manoeuvre_upsets_the_aircraft(calibration):
    truth = calibration.truth
    assert np.abs(truth.airspeed / truth.airspeed[0] - 1).max() < 0.15
    assert np.degrees(truth.alpha).max() < 12
    n = -truth.specific_force[:, 2] / 9.80665
    assert n.min() > -0.3
    assert n.max() < 2.5


def test_a_straight_record_does_not_turn_and_a_turn_record_does():
    straight, turn = (sims.fly("737", name, sensors="fti", start_utc=UTC) for name in ("straight", "turn-record"))
    assert turned(straight, slice(None)) < 25
    assert turned(turn, during(turn, "level turn right")) > 90


@pytest.mark.parametrize("name", ["3-2-1-1", "doublets", "bank-to-bank", "push-pull", "wind-up-turn", "points"])
def test_single_manoeuvres_end_in_level_flight(name):
    flight = sims.fly("T38", name, sensors="fti", start_utc=UTC)
    assert np.abs(np.degrees(flight.truth.attitude[-1, 0])) < 3
    assert abs(flight.truth.velocity[-1, 2]) < 3
    assert abs(-flight.truth.specific_force[-1, 2] / 9.80665 - 1) < 0.1
