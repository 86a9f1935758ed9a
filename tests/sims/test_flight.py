"""The demonstration flight: what it flies, where its marks are, and that it flies the same every time."""

import dataclasses
import subprocess
import sys

import numpy as np
import pytest

import sims
from sims.aircraft import AIRFRAMES, AircraftError
from sims.manoeuvres import PlanError
from sims.truth import UNITS


def during(flight, name):
    start, stop = (next(m.t for m in flight.marks if m.text == f"{name} {edge}") for edge in ("start", "stop"))
    return (flight.truth.t >= start) & (flight.truth.t <= stop)


def segment(flight, name):
    return flight.truth.segment == [s.name for s in flight.plan.segments].index(name)


def test_marks_come_in_pairs_and_in_order(flight):
    texts = [mark.text for mark in flight.marks]
    assert texts == [f"TP {n} {edge}" for n in (1, 2, 3) for edge in ("start", "stop")]
    assert [mark.t for mark in flight.marks] == sorted(mark.t for mark in flight.marks)


def test_level_turns_bank_thirty_degrees_both_ways_and_keep_their_height(flight):
    truth, inside = flight.truth, during(flight, "TP 1")
    bank = np.degrees(truth.attitude[:, 0])
    for name, wanted in (("level turn right", 30), ("level turn left", -30)):
        steady = np.flatnonzero(segment(flight, name))[10 * 50 :]
        assert np.abs(bank[steady] - wanted).max() < 2
    assert np.abs(truth.altitude[inside] - 1000).max() < 3
    turned = np.degrees(np.unwrap(truth.attitude[inside, 2]))
    assert turned.max() - turned[0] > 120
    assert turned.max() - turned[-1] > 110


def test_the_climb_climbs(flight):
    inside = np.flatnonzero(during(flight, "TP 2"))
    climb = -flight.truth.velocity[inside, 2]
    np.testing.assert_allclose(climb[10 * 50 : -50], 2.0, atol=0.2)
    assert flight.truth.altitude[inside[-1]] - flight.truth.altitude[inside[0]] > 60


def test_the_3211_excites_pitch_and_leaves_the_rest_alone(flight):
    inside = during(flight, "TP 3")
    load = -flight.truth.specific_force[inside, 2] / 9.80665
    assert load.min() < 0.75
    assert load.max() > 1.25
    assert load.min() > 0.3
    assert load.max() < 1.8
    assert np.abs(np.degrees(flight.truth.attitude[inside, 0])).max() < 3
    elevator = flight.truth.controls[inside, 0]
    assert np.degrees(elevator.max() - elevator.min()) > 3


def test_airspeed_stays_near_trim(flight):
    assert np.abs(flight.truth.airspeed - AIRFRAMES["c172x"].airspeed).max() < 2


@pytest.mark.parametrize("name", ["straight and level", "back to level"])
def test_level_flight_is_quiet(flight, name):
    quiet = np.flatnonzero(segment(flight, name))[-10 * 50 :]
    assert np.degrees(flight.truth.rates[quiet, :2]).std(axis=0).max() < 0.2
    assert np.abs(flight.truth.velocity[quiet, 2]).max() < 0.2


def columns(flight):
    yield from ((name, getattr(flight.truth, name)) for name in UNITS)
    for part in ("imu", "attitude", "static", "pitot", "gnss", "navigation"):
        yield from ((part, column) for column in getattr(flight.sensors, part))


def test_the_same_seed_flies_the_same_flight_bit_for_bit():
    def fly(seed):
        return sims.fly("c172x", "turn", seed=seed, duration=12, turbulence=3, start_utc=0)

    one, two, other = fly(7), fly(7), fly(8)
    for (name, a), (_, b) in zip(columns(one), columns(two), strict=True):
        assert a.tobytes() == b.tobytes(), name
    assert list(sims.frames(one)) == list(sims.frames(two))
    assert one.truth.attitude.tobytes() != other.truth.attitude.tobytes()
    assert one.sensors.imu.rates.tobytes() != other.sensors.imu.rates.tobytes()


def test_another_process_flies_the_same_flight():
    code = (
        "import sims, hashlib;"
        "f = sims.fly('c172x', 'level', seed=7, duration=3, turbulence=3, start_utc=0);"
        "print(hashlib.sha256(b''.join(b for _, b in sims.frames(f))).hexdigest())"
    )
    first, second = (
        subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True) for _ in range(2)
    )
    assert first.stdout == second.stdout
    assert len(first.stdout.strip()) == 64, "JSBSim wrote to the console"
    assert first.stderr == ""


def test_duration_cuts_and_stretches_the_plan():
    short = sims.fly(plan="turn", duration=15)
    assert len(short.truth) == 15 * 50 + 1
    assert [mark.text for mark in short.marks] == ["TP 1 start"], "a test point that the end cuts has no stop"
    long = sims.fly(plan="level", duration=65)
    assert len(long.truth) == 65 * 50 + 1


@pytest.mark.parametrize("name", ["pa28", "737", "f16"])
def test_other_aircraft_fly_the_same_plan(name):
    flight = sims.fly(name, "turn", seed=1)
    bank = np.degrees(flight.truth.attitude[segment(flight, "level turn right"), 0])
    assert abs(bank[-1] - 30) < 2
    assert np.abs(flight.truth.altitude - AIRFRAMES[name].altitude).max() < 10
    assert np.abs(flight.truth.airspeed - AIRFRAMES[name].airspeed).max() < 3
    assert np.abs(flight.truth.attitude[-1, 0]) < np.radians(2)


def test_silence(capfd, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    sims.fly(plan="level", duration=1)
    sims.fly("global5000", plan="level", duration=1)
    with pytest.raises(AircraftError):
        sims.fly(plan="level", airspeed=10.0)
    assert capfd.readouterr() == ("", "")
    assert list(tmp_path.iterdir()) == []


def test_wrong_words_are_answered_with_the_right_ones():
    with pytest.raises(AircraftError, match=r"unknown aircraft 'c310'.*c172x"):
        sims.fly("c310")
    with pytest.raises(PlanError, match=r"unknown plan 'loop'.*demo"):
        sims.fly(plan="loop")
    with pytest.raises(ValueError, match=r"unknown sensors 'gold'.*fti, mems, mems-vanes"):
        sims.fly(sensors="gold")
    with pytest.raises(PlanError, match="positive number of seconds"):
        sims.fly(duration=0)
    with pytest.raises(AircraftError, match="unknown planet 'disc'; known: wgs84, flat"):
        sims.fly(planet="disc")
    with pytest.raises(PlanError, match="must divide 400"):
        sims.fly(record_rate=60)
    with pytest.raises(AircraftError, match="does not trim at 1000 m and 10 m/s"):
        sims.fly(airspeed=10.0)


def test_a_flight_cannot_be_changed_by_accident(flight):
    with pytest.raises(dataclasses.FrozenInstanceError):
        flight.seed = 2


def test_importing_the_room_loads_no_jsbsim():
    code = "import sys, sims; dir(sims); sys.exit('jsbsim' in sys.modules or 'pymavlink' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0
