"""Withheld samples: what is left out, what predicts it, and what two real flights say."""

import io
from pathlib import Path

import msgspec
import numpy as np
import pytest
from rich.console import Console

import sims
from estimator.models import flight_path
from sims.experiments import truth_table
from sims.experiments.withheld import DELAY, NOISE, SCHEDULES, Schedule, airborne, predict, read, table
from telemetry.messages import AirData, Gnss, Imu, Progress

from .conftest import UTC

DATA = Path(__file__).resolve().parents[2].parent / "shared" / "data"
S = 1_000_000_000
OTHER, NINE, OUTAGE, AIRSPEED = SCHEDULES


@pytest.fixture(scope="module")
def flown():
    return sims.fly(
        "c172x", "turn-record", sensors="mems-vanes", turbulence=3, seed=3, duration=70, latencies={"gnss": 0.2},
        start_utc=UTC,
    )  # fmt: skip


@pytest.fixture(scope="module")
def samples(flown):
    return [m for m in sims.messages(flown) if not isinstance(m, Progress)]


@pytest.fixture(scope="module")
def chosen(flown):
    return msgspec.structs.replace(truth_table.settings(flown, "gusts").flight_path, gnss_delay=0.2)


def test_schedules_withhold_by_number_or_by_time():
    t = np.arange(0, 60 * S, S // 5)
    assert OTHER.mask(t).tolist() == [False, True] * 150
    assert NINE.mask(t).sum() == 270
    away = OUTAGE.mask(t)
    assert away.sum() == 100
    assert np.array_equal(t[away][[0, 49, 50, 99]] / S, [10.0, 19.8, 40.0, 49.8])
    assert Schedule("", AirData, 2.0, 10.0).mask(t)[20:30].all()


def test_airborne_is_the_longest_time_with_airspeed(samples):
    air = next(m for m in samples if isinstance(m, AirData))
    seconds = (air.t - air.t[0]) * 1e-9
    speed = np.where((seconds > 10) & (seconds < 50) & ~((seconds > 30) & (seconds < 33)), 20.0, 2.0)
    told = [msgspec.structs.replace(m, airspeed=speed) if m is air else m for m in samples]
    cut = {type(m): (m.t - air.t[0]) * 1e-9 for m in airborne(told)}
    assert cut[Imu][0] == pytest.approx(10.1, abs=0.02)
    assert cut[Imu][-1] == pytest.approx(49.9, abs=0.02)
    assert cut[Gnss][-1] == pytest.approx(49.8, abs=0.2)
    with pytest.raises(ValueError, match="nothing was flown"):
        airborne([msgspec.structs.replace(air, airspeed=0.0 * speed)])


def test_withheld_fixes_are_predicted_to_the_receivers_noise(samples, chosen):
    said = predict(samples, OTHER, chosen, "simulated")
    for axis in ("north", "east", "down"):
        assert said.rmse["smoother"][axis] < 0.25  # noise 0.2
        assert said.rmse["smoother"][axis] < said.rmse["linear"][axis] < said.rmse["hold last"][axis]
        assert abs(said.shared[axis]) < 0.4  # the errors of a simulated receiver do not last
    assert said.samples > 100


def test_the_longer_the_silence_the_more_the_smoother_is_worth(samples, chosen):
    said = predict(samples, OUTAGE, chosen)
    for axis in ("north", "east"):
        assert said.rmse["smoother"][axis] < said.rmse["filter"][axis] < said.rmse["linear"][axis]


def test_withheld_airspeed_is_predicted_by_the_rest(samples, chosen):
    said = predict(samples, AIRSPEED, chosen).rmse
    assert said["smoother"]["airspeed"] < said["filter"]["airspeed"] < said["hold last"]["airspeed"]
    assert said["smoother"]["airspeed"] < 1.6  # noise 0.8, and gusts of 2.4


def test_a_delay_that_is_not_taken_off_shows(samples, chosen):
    late = predict(samples, NINE, msgspec.structs.replace(chosen, gnss_delay=0.0))
    right = predict(samples, NINE, chosen)
    assert right.rmse["smoother"]["east"] < 0.7 * late.rmse["smoother"]["east"]


def test_a_sensor_that_is_not_there_cannot_be_withheld(samples, chosen):
    with pytest.raises(ValueError, match="no AirData among the samples"):
        predict([m for m in samples if not isinstance(m, AirData)], AIRSPEED, chosen)


def test_the_table_names_log_and_schedule(samples, chosen):
    console = Console(width=170, record=True, file=io.StringIO())
    console.print(table([predict(samples, AIRSPEED, chosen, "simulated")]))
    text = console.export_text()
    assert "simulated" in text
    assert "airspeed, 2 s of every 10 s" in text


def test_a_log_without_inertial_samples_is_refused():
    path = DATA / "sitl_quadplane_uavlogviewer_vtol.tlog"
    if not path.exists():
        pytest.skip(f"{path.name} is not in {DATA}")
    told = read(path)  # it has some: one kind, one message
    assert len({type(m) for m in told}) == len(told)


def test_a_real_flight_is_predicted_better_than_by_interpolation():
    path = DATA / "plane_swiss_137hz.tlog"
    if not path.exists():
        pytest.skip(f"{path.name} is not in {DATA}")
    told = airborne(read(path))
    chosen = flight_path.Settings(gnss_delay=DELAY, airspeed=NOISE)
    for schedule in (OUTAGE, AIRSPEED):
        said = predict(told, schedule, chosen).rmse
        for component in said["smoother"]:
            assert said["smoother"][component] < 0.8 * said["filter"][component]
            assert said["smoother"][component] < 0.8 * said["linear"][component]


def test_neighbouring_fixes_of_a_real_receiver_share_their_error():
    path = DATA / "plane_swiss_137hz.tlog"
    if not path.exists():
        pytest.skip(f"{path.name} is not in {DATA}")
    said = predict(airborne(read(path)), OTHER, flight_path.Settings(gnss_delay=DELAY, airspeed=NOISE))
    for axis in ("north", "east"):
        assert said.shared[axis] > 0.6  # so interpolation copies it
        assert said.rmse["smoother"][axis] < 1.3 * said.used[axis]  # as near to fixes left out as to those used
        assert said.rmse["smoother"][axis] < said.rmse["filter"][axis]
