"""The truth obeys the equations of motion, and a file keeps every bit of it."""

import numpy as np
import pytest

from sims.earth import ECCENTRICITY2, EQUATOR
from sims.truth import UNITS, Truth

EARTH_RATE = 7.292115e-5


def radii(latitude):
    w2 = 1 - ECCENTRICITY2 * np.sin(latitude) ** 2
    return EQUATOR * (1 - ECCENTRICITY2) / w2**1.5, EQUATOR / np.sqrt(w2)


def body_to_ned(phi, theta, psi):
    cf, sf, ct, st, cp, sp = np.cos(phi), np.sin(phi), np.cos(theta), np.sin(theta), np.cos(psi), np.sin(psi)
    return np.array(
        [
            [ct * cp, sf * st * cp - cf * sp, cf * st * cp + sf * sp],
            [ct * sp, sf * st * sp + cf * cp, cf * st * sp - sf * cp],
            [-st, sf * ct, cf * ct],
        ]
    )


def angles(matrix):
    return np.array(
        [np.arctan2(matrix[2, 1], matrix[2, 2]), -np.arcsin(matrix[2, 0]), np.arctan2(matrix[1, 0], matrix[0, 0])]
    )


def rotation(vector):
    """Rodrigues: the rotation by `vector`."""
    angle = np.linalg.norm(vector)
    k = np.array([[0, -vector[2], vector[1]], [vector[2], 0, -vector[0]], [-vector[1], vector[0], 0]])
    if angle < 1e-12:
        return np.eye(3) + k
    return np.eye(3) + np.sin(angle) / angle * k + (1 - np.cos(angle)) / angle**2 * k @ k


def gravity(latitude, altitude):
    s2 = np.sin(latitude) ** 2
    g0 = 9.7803253359 * (1 + 0.00193185265241 * s2) / np.sqrt(1 - ECCENTRICITY2 * s2)
    gradient = -2 / EQUATOR * (1 + 1 / 298.257223563 + 0.00344979 - 2 / 298.257223563 * s2) * g0
    return g0 + gradient * altitude


def reckon(truth, seconds):
    """Dead reckoning on the rotating ellipsoid from the first record, with the interval-mean IMU."""
    n = round(seconds * truth.rate)
    dt = 1 / truth.rate
    c = body_to_ned(*truth.attitude[0])
    v = truth.velocity[0].copy()
    latitude, altitude = truth.latitude[0], truth.altitude[0]
    for k in range(1, n + 1):
        meridian, prime = radii(latitude)
        earth = EARTH_RATE * np.array([np.cos(latitude), 0, -np.sin(latitude)])
        east = v[1] / (prime + altitude)
        transport = np.array([east, -v[0] / (meridian + altitude), -east * np.tan(latitude)])
        turned = rotation(-(earth + transport) * dt) @ c @ rotation(truth.mean_rates[k] * dt)
        half = rotation(-(earth + transport) * dt / 2) @ c @ rotation(truth.mean_rates[k] * dt / 2)
        down = np.array([0, 0, gravity(latitude, altitude)])
        rate = half @ truth.mean_specific_force[k] + down - np.cross(2 * earth + transport, v)
        before, v, c = v, v + rate * dt, turned
        latitude += 0.5 * (before[0] + v[0]) / (meridian + altitude) * dt
        altitude -= 0.5 * (before[2] + v[2]) * dt
    error = angles(c) - truth.attitude[n]
    return v - truth.velocity[n], np.degrees(np.mod(error + np.pi, 2 * np.pi) - np.pi), altitude - truth.altitude[n]


def test_velocity_integrates_to_position(flight):
    truth = flight.truth
    dt = 1 / truth.rate
    mean = 0.5 * (truth.velocity[:-1] + truth.velocity[1:])
    meridian, prime = radii(truth.latitude)
    north = np.cumsum(mean[:, 0] * dt / (meridian + truth.altitude)[1:])
    east = np.cumsum(mean[:, 1] * dt / ((prime + truth.altitude) * np.cos(truth.latitude))[1:])
    down = np.cumsum(mean[:, 2] * dt)
    assert np.abs(truth.latitude[1:] - truth.latitude[0] - north).max() * EQUATOR < 0.1
    assert np.abs(truth.longitude[1:] - truth.longitude[0] - east).max() * EQUATOR < 0.1
    assert np.abs(truth.altitude[1:] - truth.altitude[0] + down).max() < 0.05


@pytest.mark.parametrize("which", ["flight", "rough"])
def test_imu_integrates_to_velocity_attitude_and_height(which, request):
    truth = request.getfixturevalue(which).truth
    velocity, attitude, height = reckon(truth, min(60, (len(truth) - 1) / truth.rate))
    assert np.abs(velocity).max() < 0.02
    assert np.abs(attitude).max() < 1e-3
    assert abs(height) < 0.3


def test_air_data_close_the_wind_triangle(rough):
    truth = rough.truth
    for k in range(0, len(truth), 97):
        v, alpha, beta = truth.airspeed[k], truth.alpha[k], truth.beta[k]
        air = v * np.array([np.cos(alpha) * np.cos(beta), np.sin(beta), np.sin(alpha) * np.cos(beta)])
        ground = body_to_ned(*truth.attitude[k]) @ air + truth.wind[k]
        np.testing.assert_allclose(ground, truth.velocity[k], atol=1e-9)


def test_still_wind_is_the_one_asked_for(flight):
    np.testing.assert_allclose(flight.truth.wind, np.tile([-3.0, 4.0, 0.0], (len(flight.truth), 1)), atol=1e-9)


def test_interval_means_agree_with_the_points_around_them(flight):
    truth = flight.truth
    middle = 0.5 * (truth.rates[1:] + truth.rates[:-1])
    assert np.abs(truth.mean_rates[1:] - middle).max() < np.radians(0.5)


def test_records_are_evenly_spaced_in_nanoseconds(flight):
    truth = flight.truth
    assert truth.t.dtype == np.int64
    assert set(np.diff(truth.t)) == {20_000_000}
    assert len(truth) == 170 * 50 + 1
    assert truth.rate == 50


def test_a_file_keeps_every_bit_and_the_units(flight, tmp_path):
    path = tmp_path / "truth.npz"
    flight.truth.save(path)
    again = Truth.load(path)
    for name in UNITS:
        assert getattr(again, name).tobytes() == getattr(flight.truth, name).tobytes()
    with np.load(path) as file:
        assert any("north, east, down" in line for line in file["units"])


def test_another_npz_is_refused(tmp_path):
    path = tmp_path / "other.npz"
    np.savez(path, t=np.arange(3))
    with pytest.raises(ValueError, match="no column latitude"):
        Truth.load(path)
