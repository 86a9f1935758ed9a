"""The programming door: a flight's samples in, its path out."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
import pytest

import estimator
import sims
from estimator.stage import Settings
from estimator.stage.reconstruction import NoFlightPath
from telemetry.messages import AirData, Altitude, FlowAngles, Gnss, Imu, Progress
from tests.estimator.sorties import BEGIN, batches, delayed, flown, messages_of, settings, without

DATA = Path(__file__).resolve().parents[2].parent / "shared" / "data"


def test_a_simulated_flight_comes_back_with_its_parameters_and_verdicts():
    flight = flown(plan="turn-record")
    found = estimator.reconstruct(messages_of(flight), settings(flight))
    assert found.t.shape == (len(found.smoothed),)
    assert found.smoothed.shape == found.filtered.shape == found.smoothed_std.shape == (len(found.t), len(found.names))
    assert (found.smoothed_std <= 1.01 * found.filtered_std).all()  # at another estimate
    assert (np.median(found.smoothed_std / found.filtered_std, axis=0) < 0.9).all()
    assert (np.diff(found.t) > 0).all()
    assert found.reports[-1].scope == "sortie"
    assert set(found.verdicts) == set(found.parameters) | set(found.nis)
    wind = [found.parameters[name] for name in ("wind_north", "wind_east")]
    for parameter, true in zip(wind, flight.wind, strict=True):
        assert abs(parameter.value - true) < 4 * parameter.sigma + 0.3


def test_every_smoothed_row_has_its_filtered_row():
    """Also where the windows were filtered again with late samples."""
    flight = flown()
    late = delayed(messages_of(flight), Imu, lambda t: np.where((t > 10.0) & (t < 10.2), 1.5, 0.0))
    found = estimator.reconstruct(batches(late), settings(flight))
    truth = sims.truth_states(flight)
    for rows in (found.filtered, found.smoothed):
        error = rows[:, found.names.index("u")] - np.interp(found.t, flight.utc, truth["u"])
        assert np.abs(error[found.t > BEGIN + 5_000_000_000]).max() < 1.0


def test_without_a_path_the_error_says_why():
    flight = flown()
    with pytest.raises(NoFlightPath, match="no inertial samples"):
        estimator.reconstruct(without(messages_of(flight), Imu), settings(flight))
    with pytest.raises(NoFlightPath, match="no satellite fix"):
        estimator.reconstruct([])


def test_a_vehicle_can_be_asked_for():
    flight = flown()
    one = [m for m in messages_of(flight) if not isinstance(m, Progress)]
    both = batches([*one, *(msgspec.structs.replace(m, vehicle=2) for m in one)])
    a, b = (estimator.reconstruct(both, settings(flight), vehicle=vehicle) for vehicle in (1, 2))
    np.testing.assert_array_equal(a.smoothed, b.smoothed)
    assert b.windows[0].vehicle == 2
    with pytest.raises(NoFlightPath):
        estimator.reconstruct(both, settings(flight), vehicle=3)


def test_messages_of_ones_own_are_enough():
    """Ten seconds of straight flight, by hand."""
    t = 1_700_000_000_000_000_000 + np.arange(0, 10_000_000_000, 20_000_000)

    def who(every):
        return {"vehicle": 1, "source": "mine", "boot": 0, "t": t[::every], "t_rx": t[::every]}

    k, random = len(t), np.random.default_rng(1)
    force = np.tile([0.0, 0.0, -9.81], (k, 1)) + 0.05 * random.normal(size=(k, 3))
    slow, fixes = len(t[::5]), len(t[::10])
    messages = [
        Imu(**who(1), specific_force=force, angular_rate=0.001 * random.normal(size=(k, 3))),
        Altitude(
            **who(5), altitude=500.0 + random.normal(size=slow), pressure=np.full(slow, 95_460.0), sigma=np.ones(slow)
        ),
        AirData(**who(5), airspeed=30.0 + 0.5 * random.normal(size=slow), differential_pressure=np.full(slow, np.nan)),
        FlowAngles(**who(5), alpha=0.01 * random.normal(size=slow), beta=0.01 * random.normal(size=slow)),
        Gnss(
            **who(10),
            latitude=0.8 + 30.0 * np.arange(fixes) * 0.2 / 6.37e6,
            longitude=np.full(fixes, 0.2),
            altitude=np.full(fixes, 500.0),
            velocity=np.array([30.0, 0.0, 0.0]) + 0.2 * random.normal(size=(fixes, 3)),
            sigma=np.tile([2.0, 3.0, 0.2], (fixes, 1)),
            satellites=np.full(fixes, 10),
        ),
        Progress(vehicle=0, source="mine", boot=0, t=t[-1:], t_rx=t[-1:], final=True),
    ]
    found = estimator.reconstruct(messages, Settings())
    assert abs(found.smoothed[-1, found.names.index("u")] - 30.0) < 0.5


@pytest.mark.skipif(not DATA.is_dir(), reason="the logs of ../shared/data are not here")
@pytest.mark.parametrize(("log", "seconds"), [("plane_2014_aerobatic_50hz", 600), ("plane_swiss_137hz", 95)])
def test_real_flights_are_reconstructed_without_an_error(log, seconds):
    from telemetry.ingest import Settings as Ingest
    from telemetry.ingest import ingest
    from telemetry.mavlink import Dialect
    from telemetry.sources.tlog import TlogSource

    dialect = Dialect("ardupilotmega")
    source = TlogSource(DATA / f"{log}.tlog", dialect, links=1, trusted=False)
    found = estimator.reconstruct(ingest(source.batches(), source.links, dialect, Ingest()))
    assert (found.t[-1] - found.t[0]) * 1e-9 > seconds
    assert np.isfinite(found.smoothed).all()
    assert (found.smoothed_std > 0).all()
    for name in ("velocity_north", "velocity_east"):
        assert 0.3 < found.nis[name] < 2.2
    assert any("0.2" in text for text in found.events if "satellite fixes taken as" in text)
