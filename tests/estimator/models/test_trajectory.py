"""The trajectory model: exact over any interval, and about the right things."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estimator.models.trajectory import MEASUREMENTS, NAMES, SCALE, UNITS, M, N, P, Settings, Trajectory

MODEL = Trajectory(0.8, 0.2, 500.0, Settings())


def covariance(dt: float) -> tuple[np.ndarray, np.ndarray]:
    phi, gamma, q = MODEL.transition(np.array([dt]))
    return phi[0], gamma[0] @ np.diag(q[0]) @ gamma[0].T


def test_every_state_has_a_name_a_unit_and_a_scale():
    assert len(NAMES) == len(UNITS) == len(SCALE) == N == P
    assert len(MEASUREMENTS) == M
    assert len(set(NAMES)) == N


@given(st.floats(0, 100), st.floats(0, 1))
def test_an_interval_cut_in_two_is_the_interval(dt, share):
    phi, q = covariance(dt)
    first, q1 = covariance(dt * share)
    second, q2 = covariance(dt - dt * share)
    np.testing.assert_allclose(second @ first, phi, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(second @ q1 @ second.T + q2, q, rtol=1e-9, atol=1e-9)


def test_no_time_no_noise():
    phi, q = covariance(0.0)
    np.testing.assert_array_equal(phi, np.eye(N))
    assert not q.any()


def test_process_noise_is_white_acceleration():
    _, q = covariance(2.0)
    psd = Settings().acceleration_horizontal
    np.testing.assert_allclose(q[:2, :2], psd * np.array([[8 / 3, 2], [2, 2]]))


def test_a_fix_measures_what_its_receiver_states():
    """White and lasting error together have the stated variance."""
    sigma = np.array([[3.0, 5.0, 0.2]])
    z, r = MODEL.gnss(np.array([0.8]), np.array([0.2]), np.array([510.0]), np.array([[1.0, 2.0, np.nan]]), sigma)
    np.testing.assert_allclose(z[0], [0, 0, 510, 1, 2, np.nan, np.nan], atol=1e-6)
    h = MODEL.observation(r)[0]
    total = r[0] + (h[:, 7:] ** 2).sum(axis=1)
    np.testing.assert_allclose(np.sqrt(total[:6]), [3, 3, 5, 0.2, 0.2, 0.2])
    np.testing.assert_array_equal((h[:, :7] != 0).sum(axis=1), [1, 1, 1, 1, 1, 1, 2])


def test_down_becomes_up():
    z, _ = MODEL.gnss(np.array([0.8]), np.array([0.2]), np.array([500.0]), np.array([[0, 0, 3.0]]), np.ones((1, 3)))
    assert z[0, 5] == -3


def test_velocities_are_in_the_axes_of_the_plane():
    """To the north and five degrees to the east at 60 degrees, north has turned by 5 sin(60) degrees."""
    model = Trajectory(np.deg2rad(60), 0.0, 0.0, Settings())
    place = np.deg2rad([60.0]), np.deg2rad([5.0]), np.zeros(1)
    z, _ = model.gnss(*place, np.array([[100.0, 0.0, np.nan]]), np.ones((1, 3)))
    angle = np.deg2rad(5) * np.sin(np.deg2rad(60))
    np.testing.assert_allclose(z[0, 3:5], [100 * np.cos(angle), -100 * np.sin(angle)], atol=0.2)
    assert np.isnan(z[0, 5])


def test_the_altimeter_measures_altitude_and_its_own_offset():
    z, r = MODEL.altimeter(np.array([480.0]), np.array([0.7]))
    assert np.isnan(z[0, :6]).all()
    assert (z[0, 6], r[0, 6]) == (480, pytest.approx(0.49))
    assert np.flatnonzero(MODEL.observation(r)[0, 6]).tolist() == [4, 6]


def test_geodetic_is_the_inverse_of_measuring():
    latitude, longitude = np.array([0.801]), np.array([0.199])
    z, _ = MODEL.gnss(latitude, longitude, np.array([700.0]), np.zeros((1, 3)), np.ones((1, 3)))
    mean = np.zeros((1, N))
    mean[0, [0, 2, 4]] = z[0, :3]
    np.testing.assert_allclose(MODEL.geodetic(mean)[0], [0.801, 0.199, 700.0], rtol=1e-12)
