"""Live, the age of satellite fixes is found while the aircraft manoeuvres, and taken off from then on."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import sims
from estimator.stage import Settings
from telemetry.messages import Estimate, Event, Report
from tests.estimator.sorties import BEGIN, batches, flight_path, run, told

AGE = 0.25


@pytest.fixture(scope="module")
def late():
    """A flight with fixes a quarter of a second old, about which nothing has been configured."""
    flight = sims.fly("c172x", "turn-record", sensors="fti", turbulence=3, latencies={"gnss": AGE}, start_utc=BEGIN)
    return sims.messages(flight), Settings(flight_path=flight_path(flight, gnss_delay=None, turbulence=2.0))


def test_the_age_of_the_fixes_is_taken_off_as_soon_as_it_is_known(late):
    out = run(batches(late[0]), late[1])
    events = [text for message in out if isinstance(message, Event) for text in message.text]
    found = [text for text in events if "older than they say" in text]
    assert len(found) == 1
    assert abs(float(found[0].split("to be ")[1].split(" s")[0]) - AGE) < 0.05
    begun = [text for text in events if text.startswith("flight path, mode")]
    assert "taken as 0.00 s old" in begun[0]
    assert f"taken as {AGE:.1f}" in begun[-1]
    report = told(out, Report)[-1]
    assert any("behind the inertial sensors" in text and "taken off here" in text for text in report.findings)


@settings(max_examples=4)
@given(cuts=st.lists(st.floats(0.0, 1.0), max_size=40))
def test_when_it_is_taken_off_does_not_depend_on_the_batches(late, cuts):
    whole, cut = (told(run(batches(late[0], how), late[1]), Estimate) for how in ((), cuts))
    for name in ("t", "mean", "std", "nis"):
        one, other = (np.concatenate([getattr(message, name) for message in out]) for out in (whole, cut))
        assert np.array_equal(one, other, equal_nan=True), name


def test_what_is_configured_is_not_asked_for_again(late):
    fixed = msgspec.structs.replace(late[1].flight_path, gnss_delay=0.1)
    out = run(batches(late[0]), msgspec.structs.replace(late[1], flight_path=fixed))
    texts = [text for message in out if isinstance(message, Event) for text in message.text]
    assert not any("older than they say" in text for text in texts)
