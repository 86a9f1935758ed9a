"""Many seeds of one flight."""

import functools

import numpy as np
import pytest

import sims
from sims.draws import DrawError

from .conftest import UTC


def cube(seed):
    return seed**3


def stumble(seed):
    if seed == 2:
        raise ZeroDivisionError("two")
    return seed


def bias(path, seed):
    """Of the gyro about x, of a flight in a file."""
    return float(sims.redraw(sims.Flight.load(path), seed).sensors.constants.gyro[0])


@pytest.fixture(scope="module")
def flown():
    return sims.fly("737", "level", sensors="fti", duration=5, latencies={"gnss": 0.2}, turbulence=3, start_utc=UTC)


def test_another_seed_draws_other_errors_of_the_same_flight(flown):
    one, two, again = (sims.redraw(flown, seed) for seed in (5, 6, 5))
    assert one.truth is flown.truth
    assert one.sensors.imu.rates.tobytes() == again.sensors.imu.rates.tobytes()
    assert one.sensors.imu.rates.tobytes() != two.sensors.imu.rates.tobytes()
    assert one.sensors.arms == flown.sensors.arms
    assert one.sensors.latencies == {"gnss": 0.2}
    same = sims.redraw(flown, flown.seed)
    assert same.sensors.vanes.alpha.tobytes() == flown.sensors.vanes.alpha.tobytes()


def test_another_grade_sits_where_that_grade_does(flown):
    small = sims.redraw(flown, 5, "mems")
    assert small.sensors.arms.imu == (0, 0, 0)
    assert len(small.sensors.vanes.t) == 0


def test_a_file_keeps_the_flight_and_its_sensors(flown, tmp_path):
    path = tmp_path / "flight.npz"
    flown.save(path)
    again = sims.Flight.load(path)
    assert list(sims.frames(again)) == list(sims.frames(flown))
    assert (again.plan, again.marks, again.wind, again.aircraft) == (flown.plan, flown.marks, flown.wind, "737")
    assert sims.Truth.load(path).aircraft == "737"


def test_a_file_with_only_the_truth_is_refused(flown, tmp_path):
    path = tmp_path / "truth.npz"
    flown.truth.save(path)
    with pytest.raises(ValueError, match="no flight"):
        sims.Flight.load(path)


def test_results_come_in_the_order_of_the_seeds(flown, tmp_path):
    path = tmp_path / "flight.npz"
    flown.save(path)
    function = functools.partial(bias, path)
    told = []
    several = sims.monte_carlo(function, [3, 1, 2], processes=2, progress=lambda done, of: told.append((done, of)))
    assert several == sims.monte_carlo(function, [3, 1, 2], processes=1)
    assert several == [function(3), function(1), function(2)]
    assert told == [(1, 3), (2, 3), (3, 3)]
    assert np.std(several) > 0


@pytest.mark.parametrize("processes", [1, 2])
def test_a_seed_that_fails_is_named(processes):
    with pytest.raises(DrawError, match="seed 2: ZeroDivisionError: two"):
        sims.monte_carlo(stumble, range(4), processes=processes)


def test_no_process_is_refused():
    assert sims.monte_carlo(cube, [], processes=2) == []
    with pytest.raises(ValueError, match="at least one process, not 0"):
        sims.monte_carlo(cube, [1], processes=0)
