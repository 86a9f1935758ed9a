"""What the sensors say differs from the truth by what their grade declares."""

import dataclasses

import numpy as np
import pytest

import sims
from sims import atmosphere
from sims.sensors import ECCENTRICITY2, EQUATOR, GRADES, RATES, SensorError, markov, sense


@pytest.fixture(scope="module")
def still(flight):
    """An hour in which nothing changes, so that every difference is a sensor's."""
    n = 3600 * 50
    columns = {
        field.name: np.repeat(getattr(flight.truth, field.name)[:1], n, axis=0)
        for field in dataclasses.fields(flight.truth)
    }
    columns["t"] = 4_000_000_000 + 20_000_000 * np.arange(n, dtype=np.int64)
    return sims.Truth(**columns)


@pytest.fixture(scope="module", params=["fti", "mems"])
def heard(still, request):
    return sense(still, request.param, seed=11)


def metres(truth, fixes):
    """Position error, NED (m), of fixes at a place that does not move."""
    w2 = 1 - ECCENTRICITY2 * np.sin(truth.latitude[0]) ** 2
    north = EQUATOR * (1 - ECCENTRICITY2) / w2**1.5 + truth.altitude[0]
    east = (EQUATOR / np.sqrt(w2) + truth.altitude[0]) * np.cos(truth.latitude[0])
    return np.stack(
        [
            (fixes.latitude - truth.latitude[0]) * north,
            (fixes.longitude - truth.longitude[0]) * east,
            truth.altitude[0] - fixes.altitude,
        ],
        axis=1,
    )


def test_each_sensor_keeps_its_rate(heard):
    for name, rate in RATES.items():
        assert set(np.diff(getattr(heard, name).t)) == {1_000_000_000 // rate}


def test_imu_noise_and_bias(still, heard):
    grade, constants = heard.grade, heard.constants
    for measured, true, bias, sigma in (
        (heard.imu.specific_force, still.mean_specific_force, constants.accelerometer, grade.accelerometer),
        (heard.imu.rates, still.mean_rates, constants.gyro, grade.gyro),
    ):
        error = measured - true - bias
        np.testing.assert_allclose(error.std(axis=0), sigma, rtol=0.02)
        np.testing.assert_allclose(error.mean(axis=0), 0, atol=5 * sigma / np.sqrt(len(error)))


def test_attitude_error(still, heard):
    error = heard.attitude.attitude - still.attitude[0]
    error[:, 2] = (error[:, 2] + np.pi) % (2 * np.pi) - np.pi
    np.testing.assert_allclose(error.std(axis=0), heard.grade.attitude, rtol=0.15)
    step = round(heard.grade.attitude_time * RATES["attitude"])
    if step:
        correlation = np.mean(error[step:] * error[:-step]) / np.mean(error**2)
        assert correlation == pytest.approx(np.exp(-1), abs=0.1)
    else:
        assert abs(np.mean(error[1:] * error[:-1]) / np.mean(error**2)) < 0.02


def test_pressure_altitude_noise_offset_and_steps(still, heard):
    grade, static = heard.grade, heard.static
    true = atmosphere.pressure_altitude(still.pressure[:1])[0]
    error = static.altitude - true - heard.constants.altimeter
    assert error.std() == pytest.approx(np.hypot(grade.altitude, grade.altitude_step / np.sqrt(12)), rel=0.03)
    assert abs(error.mean()) < 0.05
    np.testing.assert_allclose(atmosphere.pressure_altitude(static.pressure), static.altitude, atol=1e-6)
    if grade.altitude_step:
        steps = static.altitude / grade.altitude_step
        np.testing.assert_allclose(steps, np.round(steps), atol=1e-6)


def test_airspeed_noise_and_scale(still, heard):
    impact = atmosphere.impact_pressure(still.airspeed[:1], still.pressure[:1], still.temperature[:1])
    true = atmosphere.calibrated_airspeed(impact)[0]
    error = heard.pitot.airspeed - true * (1 + heard.constants.airspeed_scale)
    assert error.std() == pytest.approx(heard.grade.airspeed, rel=0.03)
    assert abs(error.mean()) < 5 * heard.grade.airspeed / np.sqrt(len(error))
    np.testing.assert_allclose(atmosphere.calibrated_airspeed(heard.pitot.impact), heard.pitot.airspeed, atol=1e-6)


def test_gnss_noise_is_as_large_as_declared_and_partly_slow(still, heard):
    grade = heard.grade
    error = metres(still, heard.gnss)
    # An hour holds some sixty independent values of the slow part.
    np.testing.assert_allclose(error.std(axis=0) / [1, 1, 1.5], grade.position, rtol=0.3)
    white = np.diff(error, axis=0).std(axis=0) / np.sqrt(2) / [1, 1, 1.5]
    slow_step = (1 - grade.position_white) * (1 - np.exp(-1 / (grade.position_time * RATES["gnss"])))
    np.testing.assert_allclose(white, grade.position * np.sqrt(grade.position_white + slow_step), rtol=0.03)
    np.testing.assert_allclose((heard.gnss.velocity - still.velocity[0]).std(axis=0), grade.velocity, rtol=0.03)


def test_navigation_shares_the_slow_error_of_gnss(still, heard):
    gnss, navigation = metres(still, heard.gnss), metres(still, heard.navigation)
    assert np.corrcoef(gnss[:, 0], navigation[:, 0])[0, 1] > 0.8
    assert navigation.std() < gnss.std()


def test_constant_errors_have_the_declared_spread(still):
    short = sims.Truth(**{field.name: getattr(still, field.name)[:51] for field in dataclasses.fields(still)})
    drawn = [sense(short, "mems", seed=seed).constants for seed in range(300)]
    grade = GRADES["mems"]
    assert np.std([c.accelerometer for c in drawn]) == pytest.approx(grade.accelerometer_bias, rel=0.1)
    assert np.std([c.gyro for c in drawn]) == pytest.approx(grade.gyro_bias, rel=0.1)
    assert np.std([c.altimeter for c in drawn]) == pytest.approx(grade.altimeter_offset, rel=0.15)
    assert np.std([c.airspeed_scale for c in drawn]) == pytest.approx(grade.airspeed_scale, rel=0.15)


def test_a_late_solution_describes_the_past(flight):
    quiet = GRADES["fti"]._replace(position=0.0, velocity=0.0)
    truth = flight.truth
    now, late = (sense(truth, quiet, gnss_latency=latency).gnss for latency in (0.0, 0.2))
    assert late.t[0] == truth.t[0] + 200_000_000
    np.testing.assert_allclose(late.velocity, now.velocity[:-1])
    np.testing.assert_allclose(late.latitude, now.latitude[:-1])
    with pytest.raises(SensorError, match="early"):
        sense(truth, quiet, gnss_latency=-0.1)


def test_an_imu_slower_than_the_record_averages_all_of_it(rough):
    truth = rough.truth
    imu = sense(truth, GRADES["fti"]._replace(accelerometer=0.0, accelerometer_bias=0.0)).imu
    assert np.diff(imu.t)[0] == 20_000_000
    np.testing.assert_allclose(imu.specific_force[5], truth.mean_specific_force[17:21].mean(axis=0))
    assert truth.t[20] == imu.t[5]


def test_a_rate_that_does_not_fit_is_refused(flight):
    half = sims.Truth(**{f.name: getattr(flight.truth, f.name)[::2] for f in dataclasses.fields(flight.truth)})
    with pytest.raises(SensorError, match="imu at 50 Hz does not divide the truth's 25 Hz"):
        sense(half)


def test_markov_noise_has_unit_variance_from_the_start():
    noise = markov(np.random.default_rng(1), 40, 20000, 10.0)
    np.testing.assert_allclose(noise.std(axis=1), 1, rtol=0.03)
    assert np.mean(noise[0] * noise[10]) == pytest.approx(np.exp(-1), abs=0.03)


def test_one_sensor_does_not_disturb_the_others(flight):
    one = sense(flight.truth, "mems", seed=4)
    two = sense(flight.truth, GRADES["mems"]._replace(altitude_step=0.0, airspeed=2.0), seed=4)
    assert one.imu.rates.tobytes() == two.imu.rates.tobytes()
    assert one.gnss.latitude.tobytes() == two.gnss.latitude.tobytes()
