"""The array door says what the link says, but for the link's quantisation."""

import math

import numpy as np
import pytest

import sims
from telemetry import wire
from telemetry.ingest import ingest
from telemetry.mavlink import Dialect
from telemetry.messages import AirData, Altitude, Attitude, FlowAngles, Gnss, Imu, Mark, Progress
from telemetry.sources.tlog import TlogSource

from .conftest import UTC


@pytest.fixture(scope="module")
def fti():
    return sims.fly("T38", "3-2-1-1", sensors="fti", turbulence=3, seed=2, start_utc=UTC)


@pytest.fixture(scope="module")
def told(fti):
    return {type(m): m for m in sims.messages(fti)}


@pytest.fixture(scope="module")
def heard(fti, tmp_path_factory):
    path = tmp_path_factory.mktemp("log") / "fti.tlog"
    sims.write_tlog(sims.frames(fti), path, fti.start_utc)
    dialect = Dialect()
    source = TlogSource(path, dialect)
    kinds = {}
    for message in ingest(source.batches(), source.links, dialect):
        kinds.setdefault(type(message), []).append(message)
    return kinds


TOLERANCES = {
    (Imu, "specific_force"): 2e-6,
    (Imu, "angular_rate"): 1e-7,
    (Attitude, "phi"): 1e-6,
    (Attitude, "theta"): 1e-6,
    (Attitude, "psi"): 1e-6,
    (AirData, "differential_pressure"): 2e-3,
    (FlowAngles, "alpha"): 1e-7,
    (FlowAngles, "beta"): 1e-7,
    (Altitude, "altitude"): 1e-3,
    (Altitude, "pressure"): 0.01,
    (Gnss, "latitude"): 1e-9,
    (Gnss, "longitude"): 1e-9,
    (Gnss, "altitude"): 1e-3,
    (Gnss, "velocity"): 1e-4,
    (Gnss, "sigma"): 1e-3,
}


@pytest.mark.parametrize(("kind", "column"), TOLERANCES)
def test_the_link_brings_the_same_samples(told, heard, kind, column):
    linked = np.concatenate([getattr(m, column) for m in heard[kind]])
    np.testing.assert_allclose(linked, getattr(told[kind], column), atol=TOLERANCES[kind, column], rtol=1e-6)
    np.testing.assert_array_equal(np.concatenate([m.t for m in heard[kind]]), told[kind].t)


def test_marks_and_the_end_are_told_too(fti, told, heard):
    marks = [m for m in sims.messages(fti) if isinstance(m, Mark)]
    assert [(m.action, m.name) for m in marks] == [(m.action, m.name) for m in heard[Mark]]
    for told_there, heard_here in zip(marks, heard[Mark], strict=True):  # a text has no time: it lies between samples
        assert abs(told_there.t[0] - heard_here.t[0]) <= 10_000_000
    last = sims.messages(fti)[-1]
    assert isinstance(last, Progress)
    assert last.final
    assert last.t[0] == fti.start_utc + 25_000_000_000


def test_times_are_utc_and_nothing_is_late(fti, told):
    for message in told.values():
        assert message.t is message.t_rx
        assert message.t.dtype == np.int64
    assert told[Imu].t[0] == fti.start_utc
    assert {m.vehicle for m in sims.messages(fti, vehicle=7)} == {7}


def test_every_message_survives_the_wire_of_the_bus(told):
    for message in told.values():
        again = wire.decode(wire.schema(type(message)), wire.encode(message))
        assert again.t.tolist() == message.t.tolist()


def test_impact_pressure_is_that_of_compressible_flow(fti, told):
    from sims import atmosphere

    air = told[AirData]
    np.testing.assert_allclose(atmosphere.calibrated_airspeed(air.differential_pressure), air.airspeed)
    incompressible = np.sqrt(2 * air.differential_pressure / 1.225)
    assert (incompressible / air.airspeed - 1).min() > 0.02


def test_the_small_autopilot_has_no_vanes_and_no_vertical_velocity(flight):
    told = {type(m): m for m in sims.messages(flight)}
    assert FlowAngles not in told
    assert np.isnan(told[Gnss].velocity[:, 2]).all()
    assert np.isfinite(told[Gnss].velocity[:, :2]).all()


def test_a_heading_alone_leaves_roll_and_pitch_unmeasured(fti):
    told = {type(m): m for m in sims.messages(sims.redraw(fti, 3, "mems-vanes"))}
    assert np.isnan(told[Attitude].phi).all()
    assert np.isnan(told[Attitude].theta).all()
    assert np.abs(told[Attitude].psi).max() <= math.pi
    assert {type(m) for m in told.values()} >= {Imu, AirData, FlowAngles, Altitude, Gnss}


def test_states_are_those_of_the_imu(fti):
    states, truth = sims.truth_states(fti), fti.truth
    constants = fti.sensors.constants
    assert {len(column) for column in states.values()} == {len(truth)}
    speed = np.sqrt(states["u"] ** 2 + states["v"] ** 2 + states["w"] ** 2)
    assert np.abs(speed - np.linalg.norm(truth.velocity, axis=1)).max() < 0.3
    np.testing.assert_allclose(states["wind_east"] - states["gust_east"], 4.0, atol=1e-9)
    assert set(states["b_alpha"]) == {constants.vane_offset[0]}
    assert set(states["k_airspeed"]) == {constants.airspeed_scale}
    assert set(states["bg_y"]) == {constants.gyro[1]}
    np.testing.assert_allclose(states["h"], truth.altitude, atol=1.5)
    np.testing.assert_allclose(states["alpha_cg"], truth.alpha)


def test_an_altimeter_shows_geopotential_height(fti):
    states = sims.truth_states(fti)
    np.testing.assert_allclose(states["h"] - states["pressure_altitude"], states["h"] ** 2 / 6356766, atol=0.3)
