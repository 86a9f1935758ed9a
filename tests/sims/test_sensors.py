"""What the sensors say differs from the truth by what their grade declares."""

import numpy as np
import pytest

import sims
from sims import atmosphere, points
from sims.earth import ECCENTRICITY2, EQUATOR
from sims.grades import GRADES, Arms, SensorError
from sims.sensors import NAMES, markov, sense
from sims.truth import UNITS

from .conftest import UTC


@pytest.fixture(scope="module")
def still(flight):
    """An hour in which nothing changes, so that every difference is a sensor's."""
    n = 3600 * 100
    columns = {name: np.repeat(column[:1], n, axis=0) for name, column in part(flight.truth).items()}
    columns["rates"] = columns["mean_rates"] = np.zeros((n, 3))
    columns["t"] = 4_000_000_000 + 10_000_000 * np.arange(n, dtype=np.int64)
    return sims.Truth(**columns, aircraft="c172x")


def part(truth, which=slice(None)):
    """Some records of a truth, by column."""
    return {name: getattr(truth, name)[which] for name in UNITS}


@pytest.fixture(scope="module", params=["fti", "mems", "mems-vanes"])
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
    rates = heard.grade.rates
    for name in NAMES:
        rate = max(rates.attitude, rates.heading) if name == "attitude" else getattr(rates, name)
        assert set(np.diff(getattr(heard, name).t)) == ({1_000_000_000 // rate} if rate else set())


def test_imu_noise_and_bias(still, heard):
    grade, constants = heard.grade, heard.constants
    for measured, true, bias, sigma in (
        (heard.imu.specific_force, still.mean_specific_force[0], constants.accelerometer, grade.accelerometer),
        (heard.imu.rates, still.mean_rates[0], constants.gyro, grade.gyro),
    ):
        error = measured - true - bias
        np.testing.assert_allclose(error.std(axis=0), sigma, rtol=0.02)
        np.testing.assert_allclose(error.mean(axis=0), 0, atol=5 * sigma / np.sqrt(len(error)))


def test_attitude_error(still, heard):
    grade = heard.grade
    error = heard.attitude.attitude - still.attitude[0]
    error[:, 2] = (error[:, 2] + np.pi) % (2 * np.pi) - np.pi
    for axes, sigma, rate in (
        ([0, 1], grade.attitude, grade.rates.attitude),
        ([2], grade.heading, grade.rates.heading),
    ):
        if not rate:
            assert np.isnan(error[:, axes]).all()
            continue
        angles = error[:, axes]
        np.testing.assert_allclose(angles.std(axis=0), sigma, rtol=0.15)
        step = round(grade.attitude_time * rate)
        if step:
            correlation = np.mean(angles[step:] * angles[:-step]) / np.mean(angles**2)
            assert correlation == pytest.approx(np.exp(-1), abs=0.1)
        else:
            assert abs(np.mean(angles[1:] * angles[:-1]) / np.mean(angles**2)) < 0.02


def test_a_slow_heading_stands_among_fast_roll_and_pitch(still):
    grade = GRADES["fti"]
    short = sims.Truth(**part(still, slice(0, 201)))
    heard = sense(short, grade._replace(rates=grade.rates._replace(heading=10))).attitude
    assert set(np.diff(heard.t)) == {20_000_000}
    assert np.isfinite(heard.attitude[:, :2]).all()
    assert np.flatnonzero(np.isfinite(heard.attitude[:, 2])).tolist() == list(range(0, 101, 5))


def test_vane_noise_offset_and_scale(still):
    grade = GRADES["fti"]._replace(vane_scale=0.05, arms=Arms())
    heard = sense(still, grade, seed=11)
    constants = heard.constants
    for measured, true, axis in ((heard.vanes.alpha, still.alpha[0], 0), (heard.vanes.beta, still.beta[0], 1)):
        error = measured - true * (1 + constants.vane_scale[axis]) - constants.vane_offset[axis]
        assert error.std() == pytest.approx(grade.vane, rel=0.02)
        assert abs(error.mean()) < 5 * grade.vane / np.sqrt(len(error))


def test_pressure_altitude_noise_offset_and_steps(still, heard):
    grade, static = heard.grade, heard.static
    above = points.altitude(still, heard.arms.imu)[0] - still.altitude[0]
    true = atmosphere.pressure_altitude(still.pressure[:1])[0] + above
    error = static.altitude - true - heard.constants.altimeter
    assert error.std() == pytest.approx(np.hypot(grade.altitude, grade.altitude_step / np.sqrt(12)), rel=0.03)
    assert abs(error.mean()) < 0.05
    np.testing.assert_allclose(atmosphere.pressure_altitude(static.pressure), static.altitude, atol=1e-6)
    if grade.altitude_step:
        steps = static.altitude / grade.altitude_step
        np.testing.assert_allclose(steps, np.round(steps), atol=1e-6)


def test_airspeed_noise_and_scale(still, heard):
    grade, scale = heard.grade, 1 + heard.constants.airspeed_scale
    true = points.air_data(still, heard.arms.vanes)[0][:1]
    if grade.airspeed_is_true:
        found = true_airspeed(heard.pitot.impact, atmosphere.pressure(day(still, heard)))
    else:
        found = heard.pitot.airspeed
        impact = atmosphere.impact_pressure(true, still.pressure[:1], still.temperature[:1])
        true = atmosphere.calibrated_airspeed(impact)
    error = found - true * scale
    assert error.std() == pytest.approx(grade.airspeed, rel=0.03)
    assert abs(error.mean()) < 5 * grade.airspeed / np.sqrt(len(error)) + 1e-3
    np.testing.assert_allclose(atmosphere.calibrated_airspeed(heard.pitot.impact), heard.pitot.airspeed, atol=1e-6)


def day(truth, heard):
    """Pressure altitude of the day: the altimeter's offset is weather, and the pitot tube feels that weather too."""
    return atmosphere.pressure_altitude(truth.pressure[:1]) + heard.constants.altimeter


def true_airspeed(impact, static):
    """From impact and static pressure, at the standard temperature of that pressure."""
    mach = np.sqrt(5 * ((impact / static + 1) ** (2 / 7) - 1))
    return mach * 340.294 * np.sqrt((static / 101325) ** 0.190263)


def test_gnss_noise_is_as_large_as_declared_and_partly_slow(still, heard):
    grade = heard.grade
    error = metres(still, heard.gnss)
    # An hour holds some sixty independent values of the slow part.
    np.testing.assert_allclose(error.std(axis=0) / [1, 1, 1.5], grade.position, rtol=0.3)
    white = np.diff(error, axis=0).std(axis=0) / np.sqrt(2) / [1, 1, 1.5]
    slow_step = (1 - grade.position_white) * (1 - np.exp(-1 / (grade.position_time * grade.rates.gnss)))
    np.testing.assert_allclose(white, grade.position * np.sqrt(grade.position_white + slow_step), rtol=0.03)
    np.testing.assert_allclose((heard.gnss.velocity - still.velocity[0]).std(axis=0), grade.velocity, rtol=0.03)


def test_navigation_shares_the_slow_error_of_gnss(still, heard):
    gnss, navigation = metres(still, heard.gnss), metres(still, heard.navigation)
    assert np.corrcoef(gnss[:, 0], navigation[:, 0])[0, 1] > 0.8
    assert navigation.std() < gnss.std()


def test_constant_errors_have_the_declared_spread(still):
    short = sims.Truth(**part(still, slice(0, 101)))
    drawn = [sense(short, "mems-vanes", seed=seed).constants for seed in range(300)]
    grade = GRADES["mems-vanes"]
    assert np.std([c.vane_offset for c in drawn]) == pytest.approx(grade.vane_offset, rel=0.1)
    assert np.std([c.accelerometer for c in drawn]) == pytest.approx(grade.accelerometer_bias, rel=0.1)
    assert np.std([c.gyro for c in drawn]) == pytest.approx(grade.gyro_bias, rel=0.1)
    assert np.std([c.altimeter for c in drawn]) == pytest.approx(grade.altimeter_offset, rel=0.15)
    assert np.std([c.airspeed_scale for c in drawn]) == pytest.approx(grade.airspeed_scale, rel=0.15)


def test_a_late_solution_describes_the_past(flight):
    quiet = GRADES["mems"]._replace(position=0.0, velocity=0.0)
    truth = flight.truth
    now, late = (sense(truth, quiet, latencies={"gnss": latency}).gnss for latency in (0.0, 0.2))
    assert late.t[0] == truth.t[0] + 200_000_000
    np.testing.assert_allclose(late.velocity, now.velocity[:-1])
    np.testing.assert_allclose(late.latitude, now.latitude[:-1])
    with pytest.raises(SensorError, match=r"the latency of gnss is a number of seconds from 0 on, not -0.1"):
        sense(truth, quiet, latencies={"gnss": -0.1})
    with pytest.raises(SensorError, match=r"unknown sensor 'gps'; known: imu, .*gnss"):
        sense(truth, quiet, latencies={"gps": 0.1})


def test_only_the_late_sensor_is_late(flight):
    now, late = (sense(flight.truth, "mems", latencies=latencies) for latencies in ({}, {"static": 0.05}))
    assert late.static.t[0] == flight.truth.t[0] + 50_000_000
    assert late.static.t[-1] <= flight.truth.t[-1]
    np.testing.assert_array_equal(late.static.altitude, now.static.altitude[: len(late.static.t)])
    assert late.pitot.t.tobytes() == now.pitot.t.tobytes()


def test_a_sensor_falls_silent_and_speaks_again(flight):
    whole, holed = (sense(flight.truth, "mems", dropouts=d) for d in ((), [("gnss", 20, 30), ("gnss", 40, 41)]))
    seconds = (whole.gnss.t - flight.truth.t[0]) / 1e9
    kept = ((seconds < 20) | (seconds >= 30)) & ((seconds < 40) | (seconds >= 41))
    np.testing.assert_array_equal(holed.gnss.t, whole.gnss.t[kept])
    np.testing.assert_array_equal(holed.gnss.velocity, whole.gnss.velocity[kept])
    assert len(holed.imu.t) == len(whole.imu.t)
    with pytest.raises(SensorError, match=r"the dropout of gnss ends at 3.0 s, which is not after its begin at 5.0 s"):
        sense(flight.truth, "mems", dropouts=[("gnss", 5, 3)])


def test_a_flight_with_late_and_silent_sensors_still_speaks_mavlink():
    silent = [("imu", 1.0, 2.0), ("static", 0.0, 3.0), ("pitot", 0.0, 2.0), ("attitude", 0.0, 1.5), ("vanes", 1.0, 9.0)]
    flown = sims.fly(plan="level", sensors="fti", duration=4, latencies={"pitot": 0.13}, dropouts=silent, start_utc=UTC)
    times = [t for t, _ in sims.frames(flown)]
    assert times == sorted(times)
    assert len(flown.sensors.vanes.t) == 50


def test_the_imu_feels_the_turning_about_the_centre_of_gravity(flight):
    arms = Arms(imu=(2.0, 0.5, -0.3))
    quiet = GRADES["mems"]._replace(accelerometer=0.0, accelerometer_bias=0.0, accelerometer_scale=0.0)
    there, here = (sense(flight.truth, quiet, arms=a).imu.specific_force for a in (arms, Arms()))
    # In the steady turn only the centripetal part is left.
    turning = np.flatnonzero(flight.truth.segment == 1)[-200:]
    omega = flight.truth.rates[turning]
    np.testing.assert_allclose(
        (there - here)[turning].mean(axis=0), np.cross(omega, np.cross(omega, arms.imu)).mean(axis=0), atol=1e-3
    )


def test_an_accelerometer_scale_error_multiplies(flight):
    quiet = GRADES["mems"]._replace(accelerometer=0.0, accelerometer_bias=0.0, accelerometer_scale=0.01)
    heard = sense(flight.truth, quiet, seed=3)
    scale = heard.constants.accelerometer_scale
    assert 0 < np.abs(scale).max() < 0.04
    np.testing.assert_allclose(heard.imu.specific_force, flight.truth.mean_specific_force * (1 + scale))


def test_an_imu_slower_than_the_record_averages_all_of_it(rough):
    truth = rough.truth
    imu = sense(truth, GRADES["mems"]._replace(accelerometer=0.0, accelerometer_bias=0.0)).imu
    assert np.diff(imu.t)[0] == 20_000_000
    np.testing.assert_allclose(imu.specific_force[5], truth.mean_specific_force[17:21].mean(axis=0))
    assert truth.t[20] == imu.t[5]


def test_a_rate_that_does_not_fit_is_refused(flight):
    half = sims.Truth(**part(flight.truth, slice(None, None, 2)))
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
