"""A tangent plane there and back."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estimator.geodesy import SEMI_MAJOR, SEMI_MINOR, TangentPlane, axes, from_earth, to_earth


def test_known_points():
    np.testing.assert_allclose(to_earth(np.array([0.0]), np.array([0.0]), np.array([0.0])), [[SEMI_MAJOR, 0, 0]])
    np.testing.assert_allclose(
        to_earth(np.array([np.pi / 2]), np.array([0.0]), np.array([7.0])), [[0, 0, SEMI_MINOR + 7]], atol=1e-9
    )


@given(st.floats(-1.57, 1.57), st.floats(-3.14, 3.14), st.floats(-500, 20_000))
def test_earth_fixed_there_and_back(latitude, longitude, height):
    found = from_earth(to_earth(np.array(latitude), np.array(longitude), np.array(height)))
    assert found[0] == pytest.approx(latitude, abs=1e-10)
    assert found[1] == pytest.approx(longitude, abs=1e-12)
    assert found[2] == pytest.approx(height, abs=1e-3)


@given(
    st.floats(-1.4, 1.4),
    st.floats(-3.1, 3.1),
    st.floats(-50_000, 50_000),
    st.floats(-50_000, 50_000),
    st.floats(-200, 9000),
)
def test_the_plane_there_and_back(latitude, longitude, north, east, height):
    plane = TangentPlane(latitude, longitude, 300.0)
    found = plane.to_plane(
        *plane.from_plane(np.array([north]), np.array([east]), np.array([height])), np.array([height])
    )
    np.testing.assert_allclose(np.ravel(found), [north, east], atol=1e-5)


def test_a_minute_of_latitude_is_a_sea_mile():
    plane = TangentPlane(np.deg2rad(45.0), 0.2, 0.0)
    north, east = plane.to_plane(np.deg2rad([45 + 1 / 60]), np.array([0.2]), np.zeros(1))
    assert north[0] == pytest.approx(1852.2, abs=1)
    assert east[0] == pytest.approx(0, abs=1e-6)


def test_one_point_rounds_as_many_do():
    random = np.random.default_rng(1)
    plane = TangentPlane(0.8, 0.2, 500.0)
    points = 0.8 + random.normal(size=500) * 1e-3, 0.2 + random.normal(size=500) * 1e-3, random.normal(size=500) * 100
    whole = plane.to_plane(*points)
    single = [plane.to_plane(*(p[i : i + 1] for p in points)) for i in range(500)]
    np.testing.assert_array_equal(whole, np.concatenate(single, axis=1))


@given(st.floats(-1.5, 1.5), st.floats(-0.04, 0.04), st.floats(-0.04, 0.04), st.sampled_from(range(3)))
def test_a_velocity_turned_is_how_fast_the_place_moves(latitude, away, aside, axis):
    """Against a difference quotient along local north, east and down."""
    plane = TangentPlane(latitude - away, 0.2, 0.0)
    longitude, step = 0.2 + aside, 1.0
    velocity = np.eye(3)[axis]
    there = from_earth(
        to_earth(np.array(latitude), np.array(longitude), np.array(0.0))
        + np.array([[-step], [step]]) * (velocity @ axes(np.array(latitude), np.array(longitude)))
    )
    north, east = plane.to_plane(*there)
    turned = plane.turn(np.array([latitude]), np.array([longitude]), velocity[None])
    np.testing.assert_allclose(np.ravel(turned), [np.diff(north)[0] / 2, np.diff(east)[0] / 2], atol=1e-7)


def test_one_velocity_rounds_as_many_do():
    random = np.random.default_rng(1)
    plane = TangentPlane(0.8, 0.2, 500.0)
    places = 0.8 + random.normal(size=500) * 1e-2, 0.2 + random.normal(size=500) * 1e-2
    velocity = random.normal(size=(500, 3)) * 100
    whole = plane.turn(*places, velocity)
    single = [plane.turn(places[0][i : i + 1], places[1][i : i + 1], velocity[i : i + 1]) for i in range(500)]
    np.testing.assert_array_equal(whole, np.concatenate(single, axis=1))
