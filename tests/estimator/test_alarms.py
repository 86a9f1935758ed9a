"""What a report must alarm about, and what ends a path that can no longer be trusted."""

from __future__ import annotations

import numpy as np

import sims
from estimator.consistency import Tally
from estimator.models.flight_path import Settings as FlightPath
from estimator.stage import Settings
from estimator.stage.report import alarms, channels
from telemetry.messages import Event, Window
from tests.estimator.sorties import BEGIN, batches, run, told


def tallies(used, rejected):
    e = np.random.default_rng(1).normal(size=used + rejected)
    status = np.repeat([1, 3], [used, rejected])
    return [Tally().add(e, status)]


def test_measurements_refused_are_an_alarm_where_they_are_many():
    assert alarms(channels(tallies(190, 5)), 0, 0) == ()
    (alarm,) = alarms(channels(tallies(180, 20)), 0, 0)
    assert alarm == "airspeed: 10% of 200 measurements were refused"


def test_a_filter_doubted_or_lost_is_an_alarm():
    doubted, lost = alarms(channels(tallies(100, 0)), 2, 1)
    assert "doubted 2 times" in doubted
    assert "lost 1 times" in lost


def test_a_heading_that_nothing_shows_is_given_up_before_it_is_believed():
    flight = sims.fly("c172x", "level", sensors="mems", duration=100.0, start_utc=BEGIN)
    out = run(batches(sims.messages(flight)), Settings(flight_path=FlightPath(gnss_delay=0.0)))
    events = [text for message in out if isinstance(message, Event) for text in message.text]
    assert any("heading is no longer known to 25 deg" in text for text in events)
    truth = sims.truth_states(flight)["psi"]
    for window in told(out, Window):
        psi = window.names.index("psi")
        error = window.mean[:, psi] - np.interp(window.t, flight.utc, truth)
        error = np.remainder(error + np.pi, 2.0 * np.pi) - np.pi
        assert (np.abs(error) < 3.0 * window.std[:, psi]).all()
