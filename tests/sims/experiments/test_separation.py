"""Parameters among the states and beside them, on the steps of a flight that the stage has flown."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

import sims
from estimator.models import flight_path
from estimator.stage import Settings, estimate
from sims.experiments.separation import FORMS, Witness, compare
from telemetry.messages import Window
from tests.console import run

FTI = Settings(flight_path=flight_path.Settings.fti(gnss_delay=0.0, turbulence=1.9, turbulence_time=6.0), iterate=0)


@pytest.fixture(scope="module")
def flight():
    return sims.fly("c172x", "calibration", sensors="fti", turbulence=3, duration=25)


@pytest.fixture(scope="module")
def samples(flight):
    return list(sims.messages(flight))


@pytest.fixture(scope="module")
def flown(samples):
    witness = Witness()
    told = [m for m in estimate(samples, FTI, scope="sortie", begun=witness) if isinstance(m, Window)]
    return witness.steps(), [window for window in told if window.model == "flight_path"]


@pytest.fixture(scope="module")
def comparison(flown):
    lines = []
    found = compare(flown[0][0], rounds=1, tell=lines.append)
    assert len(lines) == 1
    return found


def test_the_steps_are_those_that_the_stage_flew(flown):
    (steps,), windows = flown
    last = windows[-1]
    assert steps.flight.names == last.names
    assert float(steps.drive.dt.sum()) * 1e9 == pytest.approx(last.t[-1] - windows[0].t[0], rel=0.01)


def test_a_witness_changes_nothing(samples, flown):
    alone = [m for m in estimate(samples, FTI, scope="sortie") if isinstance(m, Window) and m.model == "flight_path"]
    for one, other in zip(alone, flown[1], strict=True):
        np.testing.assert_array_equal(one.mean, other.mean)
        np.testing.assert_array_equal(one.std, other.std)


def test_parameters_are_the_same_among_the_states_and_beside_them(comparison, flown):
    last = flown[1][-1]
    assert [row.name for row in comparison.parameters][:3] == ["k_airspeed", "b_alpha", "b_beta"]
    for row in comparison.parameters:
        assert abs(row.difference) < 1e-7
        assert row.separated[1] == pytest.approx(row.augmented[1], rel=1e-8)
        at = last.names.index(row.name)
        assert row.augmented[0] == pytest.approx(last.mean[-1, at], abs=1e-6 * last.std[-1, at])


def test_states_are_the_same_but_for_what_a_form_leaves_out(comparison):
    assert set(comparison.forms) == set(FORMS)
    exact, paper = comparison.forms["corrected"], comparison.forms["paper"]
    assert exact.largest < 1e-7
    assert exact.sigma == pytest.approx(1.0, rel=1e-8)
    assert paper.largest > 1.0
    assert paper.sigma < 0.9
    assert all(states.seconds > 0.0 for states in comparison.forms.values())
    assert (comparison.states, comparison.constants, comparison.constant) == (12, 9, False)


def test_biases_that_walk_are_named_in_the_table(flown, comparison):
    steps = flown[0][0]
    walking = msgspec.structs.replace(steps.flight.settings, accelerometer_walk=0.006, gyro_walk=4e-4)
    flight = flight_path.FlightPath.of(walking, 0.8, 1000.0)
    q = np.concatenate([steps.drive.q, np.tile(np.repeat([0.006, 4e-4], 3) ** 2 * 0.01, (len(steps.drive.dt), 1))], 1)
    found = compare(steps._replace(flight=flight, drive=steps.drive._replace(q=q).part(0, 500)), rounds=1)
    assert found.constant
    assert "biases walk in the settings" in str(found.forms_table().caption)
    assert "biases walk" not in str(comparison.forms_table().caption)


def test_the_command_line_prints_both(flight, tmp_path):
    sims.write_tlog(sims.frames(flight), tmp_path / "flight.tlog", flight.start_utc)
    done = run("smooth", "flight.tlog", "--bias-separation", "--quiet", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "stretch 1 of 1, mode G" in done.stdout
    for told in ("b_alpha", "bg_z", "augmented", "separated, smoothed as the paper words it", "biases walk"):
        assert told in done.stdout
    assert (tmp_path / "flight.rrd").exists()


def test_the_tables_are_for_people(comparison):
    table = comparison.table()
    assert table.row_count == 9
    units = list(table.columns[1].cells)
    assert units == ["%", "deg", "deg", "m/s2", "m/s2", "m/s2", "deg/s", "deg/s", "deg/s"]
    assert comparison.forms_table().row_count == 1 + len(FORMS)
