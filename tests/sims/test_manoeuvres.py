"""A plan is data."""

import pytest

from sims.manoeuvres import PLANS, Plan, PlanError, Segment, doublet, find, three_two_one_one


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
    with pytest.raises(PlanError, match="known: demo"):
        find("spin")
