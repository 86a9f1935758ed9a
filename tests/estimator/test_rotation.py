"""Attitudes: quaternions, small rotations, Euler angles, against scipy and finite differences."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from estimator import rotation

part = st.floats(-1.7, 1.7)
small = st.floats(-3e-4, 3e-4)  # on both sides of where series take over
vector = st.tuples(part, part, part) | st.tuples(small, small, small) | st.just((0.0, 0.0, 0.0))
angle = st.floats(-3.1, 3.1)
pitch = st.floats(-1.57, 1.57)


def quaternion(theta, phi, psi):
    q = np.empty(4)
    rotation.quaternion(theta, phi, psi, q)
    return q


def matrix(q):
    r = np.empty((3, 3))
    rotation.matrix(q, r)
    return r


def turned(q, a, by=rotation.turn):
    out = np.empty(4)
    by(q, *a, out)
    return out


@given(pitch, angle, angle)
def test_a_quaternion_is_the_rotation_by_heading_then_pitch_then_roll(theta, phi, psi):
    expected = Rotation.from_euler("ZYX", [psi, theta, phi]).as_matrix()
    np.testing.assert_allclose(matrix(quaternion(theta, phi, psi)), expected, atol=4e-16)


@given(st.floats(-1.5, 1.5), angle, angle)
def test_euler_angles_return_from_a_quaternion_and_from_its_negative(theta, phi, psi):
    q, found = quaternion(theta, phi, psi), np.empty(3)
    for sign in (1.0, -1.0):
        rotation.euler(sign * q, found)
        np.testing.assert_allclose(found, [theta, phi, psi], atol=2e-14)


@given(angle, angle, st.sampled_from([-1.0, 1.0]))
def test_euler_angles_are_finite_straight_up_and_straight_down(phi, psi, sign):
    found = np.empty(3)
    q = quaternion(sign * np.pi / 2, phi, psi)
    rotation.euler(q, found)
    assert np.isfinite(found).all()
    assert found[0] == pytest.approx(sign * np.pi / 2, abs=1e-7)
    e = np.empty((3, 3))
    rotation.euler_jacobian(found[0], found[1], e)
    assert np.isfinite(e).all()


@given(pitch, angle, angle, vector)
def test_a_turn_multiplies_by_the_rotation_about_body_axes(theta, phi, psi, a):
    q = quaternion(theta, phi, psi)
    found = turned(q, a)
    np.testing.assert_allclose(matrix(found), matrix(q) @ Rotation.from_rotvec(a).as_matrix(), atol=2e-15)
    assert found @ found == pytest.approx(1.0, abs=1e-15)
    rotation.turn(q, *a, q)
    np.testing.assert_array_equal(q, found)  # in place, the same


@given(pitch, angle, angle, st.tuples(small, small, small))
def test_a_turn_of_the_earth_multiplies_by_a_small_rotation_about_north_east_down(theta, phi, psi, a):
    q = quaternion(theta, phi, psi)
    found = turned(q, a, rotation.turn_earth)
    np.testing.assert_allclose(matrix(found), Rotation.from_rotvec(a).as_matrix() @ matrix(q), atol=1e-11)
    rotation.turn_earth(q, *a, q)
    np.testing.assert_array_equal(q, found)


@given(pitch, angle, angle, vector, st.sampled_from([-1.0, 1.0]))
def test_the_difference_of_two_attitudes_undoes_a_turn_whatever_the_sign_of_the_quaternion(theta, phi, psi, a, sign):
    q, found = quaternion(theta, phi, psi), np.empty(3)
    rotation.difference(q, sign * turned(q, a), found)
    np.testing.assert_allclose(found, a, rtol=1e-12, atol=4e-16)


@given(vector)
def test_the_exponential_is_the_rotation_matrix(a):
    found = np.empty((3, 3))
    rotation.exponential(*a, found)
    np.testing.assert_allclose(found, Rotation.from_rotvec(a).as_matrix(), atol=6e-16)


@given(vector)
def test_the_right_jacobian_is_what_a_small_change_of_the_vector_does(a):
    found, expected, step = np.empty((3, 3)), np.empty((3, 3)), 1e-6
    rotation.right_jacobian(*a, found)
    base = Rotation.from_rotvec(a)
    for c in range(3):
        change = step * np.eye(3)[c]
        ahead, behind = (base.inv() * Rotation.from_rotvec(np.array(a) + s * change) for s in (1.0, -1.0))
        expected[:, c] = (ahead.as_rotvec() - behind.as_rotvec()) / (2.0 * step)
    np.testing.assert_allclose(found, expected, atol=3e-9)


@pytest.mark.parametrize("name", ["exponential", "right_jacobian"])
def test_series_and_quotients_meet_where_one_gives_way_to_the_other(name):
    direction = np.array([0.6, -0.48, 0.64])
    below, above = np.empty((3, 3)), np.empty((3, 3))
    getattr(rotation, name)(*(rotation.SMALL * (1 - 1e-12) * direction), below)
    getattr(rotation, name)(*(rotation.SMALL * (1 + 1e-12) * direction), above)
    np.testing.assert_allclose(below, above, atol=3e-13)


@given(st.floats(-1.4, 1.4), angle, angle)
def test_the_euler_jacobian_is_the_change_of_the_angles_by_small_rotations(theta, phi, psi):
    q, found, expected, step = quaternion(theta, phi, psi), np.empty((3, 3)), np.empty((3, 3)), 1e-6
    rotation.euler_jacobian(theta, phi, found)
    for c in range(3):
        pair = []
        for s in (step, -step):
            angles = np.empty(3)
            rotation.euler(turned(q, s * np.eye(3)[c]), angles)
            pair.append(angles)
        gap = pair[0] - pair[1]
        expected[:, c] = (gap - 2.0 * np.pi * np.round(gap / (2.0 * np.pi))) / (2.0 * step)
    np.testing.assert_allclose(found, expected, rtol=1e-7, atol=1e-7)
