"""The truth away from the centre of gravity is that of a rigid body, on both Earths."""

import math

import numpy as np
import pytest

import sims
from sims import earth, points
from sims.grades import RIGS

from .conftest import UTC

EARTH_RATE = 7.292115e-5
AIRCRAFT = ("c172x", "737", "T38")


@pytest.fixture(scope="module", params=AIRCRAFT)
def flown(request):
    return sims.fly(request.param, "calibration", sensors="fti", turbulence=3, start_utc=UTC)


@pytest.fixture(scope="module", params=AIRCRAFT)
def flat(request):
    return sims.fly(request.param, "calibration", sensors="fti", turbulence=3, planet="flat", start_utc=UTC)


def derivative(x, force, rates, place, spin, flat):
    """The kinematic equations of flight over the Earth, written out; body velocity and Euler angles."""
    h, u, v, w, theta, phi, psi = x
    latitude, north_curvature, east_curvature, surface, gradient = place
    st, ct, sp, cp, ss, cs = (f(a) for a in (theta, phi, psi) for f in (math.sin, math.cos))

    def to_body(n, e, d):
        a1, a2 = cs * n + ss * e, -ss * n + cs * e
        m3 = st * a1 + ct * d
        return ct * a1 - st * d, cp * a2 + sp * m3, -sp * a2 + cp * m3

    forward = ct * u + sp * st * v + cp * st * w
    right = cp * v - sp * w
    north, east = cs * forward - ss * right, ss * forward + cs * right
    earth_ned = spin * math.cos(latitude), 0.0, -spin * math.sin(latitude)
    transport = (0.0, 0.0, 0.0)
    if not flat:
        transport = (east * east_curvature, -north * north_curvature, -east * math.tan(latitude) * east_curvature)
    e = to_body(*earth_ned)
    t = to_body(*(a + b for a, b in zip(earth_ned, transport, strict=True)))
    a1, a2, a3 = (r + k for r, k in zip(rates, e, strict=True))
    p, q, r = (r - k for r, k in zip(rates, t, strict=True))
    g = surface + gradient * h
    return (
        u * st - (v * sp + w * cp) * ct,
        a3 * v - a2 * w + force[0] - g * st,
        a1 * w - a3 * u + force[1] + g * sp * ct,
        a2 * u - a1 * v + force[2] + g * cp * ct,
        q * cp - r * sp,
        p + (q * sp + r * cp) * st / ct,
        (q * sp + r * cp) / ct,
    )


def drift(truth, arm, seconds=60, textbook=False):
    """Largest error of velocity (m/s), angles (deg) and height (m) of dead reckoning with perfect sensors at `arm`."""
    n = round(seconds * truth.rate) + 1
    flat = textbook or truth.planet == "flat"
    latitude = float(truth.latitude[0])
    w2 = 1 - 6.69437999014e-3 * math.sin(latitude) ** 2
    prime = 6378137.0 / math.sqrt(w2)
    h = float(points.altitude(truth, arm)[0])
    surface, gradient = 9.80665, 0.0
    if not flat:
        s2 = math.sin(latitude) ** 2
        surface = 9.7803253359 * (1 + 0.00193185265241 * s2) / math.sqrt(w2)
        gradient = -2 / 6378137.0 * (1 + 1 / 298.257223563 + 0.00344979 - 2 / 298.257223563 * s2) * surface
    place = (latitude, 1 / (prime * (1 - 6.69437999014e-3) / w2 + h), 1 / (prime + h), surface, gradient)
    true = np.column_stack(
        [points.altitude(truth, arm), points.body_velocity(truth, arm), truth.attitude[:, [1, 0, 2]]]
    )[:n]
    force, rates = points.mean_specific_force(truth, arm).tolist(), truth.mean_rates.tolist()
    x, dt, found = true[0].tolist(), 1 / truth.rate, [true[0].tolist()]
    for k in range(1, n):
        inputs = (force[k], rates[k], place, 0.0 if flat else EARTH_RATE, flat)
        middle = [a + 0.5 * dt * b for a, b in zip(x, derivative(x, *inputs), strict=True)]
        x = [a + dt * b for a, b in zip(x, derivative(middle, *inputs), strict=True)]
        found.append(x)
    error = np.array(found) - true
    error[:, 4:] = (error[:, 4:] + np.pi) % (2 * np.pi) - np.pi
    largest = np.abs(error).max(axis=0)
    return largest[1:4].max(), np.degrees(largest[4:]).max(), largest[0]


def test_dead_reckoning_at_the_imu_closes_on_the_rotating_earth(flown):
    velocity, angle, height = drift(flown.truth, flown.sensors.arms.imu)
    assert velocity < 0.01
    assert angle < 5e-4
    assert height < 0.3


def test_dead_reckoning_at_the_imu_closes_on_the_flat_earth(flat):
    velocity, angle, height = drift(flat.truth, flat.sensors.arms.imu)
    assert velocity < 1.5e-3
    assert angle < 3.2e-4
    assert height < 0.06


def test_the_rotating_earth_shows_in_textbook_equations(flown):
    velocity, _, height = drift(flown.truth, flown.sensors.arms.imu, textbook=True)
    assert velocity > 0.5
    assert height > 1


def test_forgetting_where_the_imu_is_shows(flat):
    force = points.mean_specific_force(flat.truth, flat.sensors.arms.imu)
    assert np.abs(force - flat.truth.mean_specific_force).max() > 0.02


def test_the_vane_moves_as_its_position_does(flown):
    truth, arm = flown.truth, flown.sensors.arms.vanes
    latitude, longitude, altitude = points.position(truth, arm)
    meridian, prime = earth.radii(latitude)
    step = 2 / truth.rate
    ned = np.stack(
        [
            (latitude[2:] - latitude[:-2]) * (meridian + altitude)[1:-1],
            (longitude[2:] - longitude[:-2]) * ((prime + altitude) * np.cos(latitude))[1:-1],
            altitude[:-2] - altitude[2:],
        ],
        axis=1,
    )
    assert np.abs(ned / step - points.velocity(truth, arm)[1:-1]).max() < 0.03
    assert np.abs(points.velocity(truth, arm) - truth.velocity).max() > 0.5


def test_the_flow_at_the_vane_is_the_wind_triangle_there(flown):
    truth, arm = flown.truth, flown.sensors.arms.vanes
    airspeed, alpha, beta = points.air_data(truth, arm)
    flow = airspeed * np.array([np.cos(alpha) * np.cos(beta), np.sin(beta), np.sin(alpha) * np.cos(beta)])
    ground = points.velocity(truth, arm) - truth.wind
    np.testing.assert_allclose(points.to_ned(truth, flow.T), ground, atol=1e-9)
    # What JSBSim says of its own centre of gravity, and the rates relative to the Earth, bring one there as well.
    v, a, b = truth.airspeed, truth.alpha, truth.beta
    at_cg = np.stack([v * np.cos(a) * np.cos(b), v * np.sin(b), v * np.sin(a) * np.cos(b)], axis=1)
    np.testing.assert_allclose(flow.T, at_cg + np.cross(truth.rates, arm), atol=2 * EARTH_RATE * 15)


def test_at_the_centre_of_gravity_nothing_is_changed(flown):
    truth, here = flown.truth, (0.0, 0.0, 0.0)
    assert points.mean_specific_force(truth, here) is truth.mean_specific_force
    assert points.velocity(truth, here) is truth.velocity
    np.testing.assert_allclose(
        points.flow(truth, here)[:, 0], truth.airspeed * np.cos(truth.alpha) * np.cos(truth.beta)
    )
    for one, other in zip(points.air_data(truth, here), (truth.airspeed, truth.alpha, truth.beta), strict=True):
        assert one is other


def test_gusts_blow_at_the_aircraft(flown):
    wind = flown.truth.wind
    # Moderate turbulence is about 2 m/s near the ground and 1 m/s high up.
    assert np.all((wind.std(axis=0) > 0.5) & (wind.std(axis=0) < 3.5))
    np.testing.assert_allclose(wind.mean(axis=0), [-3, 4, 0], atol=1.8)


def test_the_flat_earth_is_told_as_places_near_the_start(flat):
    truth = flat.truth
    meridian, _ = earth.radii(truth.latitude[:1])
    north = (truth.latitude - truth.latitude[0]) * meridian
    flown = np.cumsum(0.5 * (truth.velocity[1:, 0] + truth.velocity[:-1, 0])) / truth.rate
    assert np.abs(north[1:] - flown).max() < 0.1
    assert truth.planet == "flat"


def test_every_aircraft_has_a_rig():
    from sims.aircraft import AIRFRAMES

    assert set(RIGS) == set(AIRFRAMES)
    for arms in RIGS.values():
        assert 1 <= arms.vanes[0] <= 14


def test_places_seen_from_the_imu_are_differences():
    places = RIGS["737"].from_imu()
    assert places.centre == tuple(-x for x in RIGS["737"].imu)
    np.testing.assert_allclose(np.add(places.vane, RIGS["737"].imu), RIGS["737"].vanes)
    np.testing.assert_allclose(np.subtract(places.antenna, places.centre), RIGS["737"].gnss)
