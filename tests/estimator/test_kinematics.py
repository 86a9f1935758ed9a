"""One step of the kinematics and what sensors see of it, against the equations in plain numpy and in Euler angles."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estimator import kinematics, rotation
from estimator.kinematics import Earth
from tests.estimator import flights

TURNING = Earth.at(0.8, 1000.0)
FLAT = Earth.flat(9.81)
VANE, ANTENNA = np.array([5.0, 0.3, -0.2]), np.array([-1.0, 0.3, -1.2])

seeds = st.integers(0, 10_000)
earths = st.sampled_from([TURNING, FLAT])


def quaternion(theta, phi, psi):
    q = np.empty(4)
    rotation.quaternion(theta, phi, psi, q)
    return q


def matrix(q):
    r = np.empty((3, 3))
    rotation.matrix(q, r)
    return r


def random_state(seed, pitch=None, rate=1.5, small=0.05):
    rng = np.random.default_rng(seed)
    x = np.zeros(23)
    x[0] = rng.uniform(-500.0, 12000.0)
    x[1:4] = rng.normal(size=3) * [30.0, 8.0, 8.0] + [80.0, 0.0, 0.0]
    x[4:7] = small * rng.normal(size=3)
    x[7:13] = 0.1 * rng.normal(size=6)
    x[13:18] = 5.0 * rng.normal(size=5)
    x[18:23] = 0.03 * rng.normal(size=5)
    q = rng.normal(size=4)
    q /= np.linalg.norm(q)
    if pitch is not None:
        q = quaternion(pitch, rng.uniform(-3.0, 3.0), rng.uniform(-3.0, 3.0))
    return x, q, np.concatenate([10.0 * rng.normal(size=3), rate * rng.normal(size=3)])


def step(x, q, u, dt, earth):
    """The next state, the next nominal attitude and the Jacobian (7, 13)."""
    x1, q1, phi, b = x.copy(), np.empty(4), np.full((7, 7), np.nan), np.full((7, 6), np.nan)
    kinematics.step(x, q, u, dt, earth, x1, q1, phi, b, np.full(200, np.nan))
    return x1, q1, np.concatenate([phi, b], axis=1)


def euler_rates(x, u, earth):
    """The derivative of (h, u, v, w, theta, phi, psi), written out as in the equations of motion."""
    h, (u_, v_, w_), (th, ph, ps) = x[0], x[1:4], x[4:7]
    f, om = u[:3] - x[7:10], u[3:] - x[10:13]
    st_, ct, sp, cp, ss, cs = np.sin(th), np.cos(th), np.sin(ph), np.cos(ph), np.sin(ps), np.cos(ps)
    to_earth = np.array([
        [ct * cs, sp * st_ * cs - cp * ss, cp * st_ * cs + sp * ss],
        [ct * ss, sp * st_ * ss + cp * cs, cp * st_ * ss - sp * cs],
        [-st_, sp * ct, cp * ct],
    ])  # fmt: skip
    vn, ve, _ = to_earth @ x[1:4]
    ie = np.array([earth.rate_north, 0.0, earth.rate_down])
    en = np.array([ve * earth.vertical, -vn * earth.meridian, -ve * earth.tangent * earth.vertical])
    a1, a2, a3 = om + to_earth.T @ ie
    p, q, r = om - to_earth.T @ (ie + en)
    g = earth.g0 + earth.gh * h
    return np.array([
        u_ * st_ - (v_ * sp + w_ * cp) * ct,
        a3 * v_ - a2 * w_ + f[0] - g * st_,
        a1 * w_ - a3 * u_ + f[1] + g * sp * ct,
        a2 * u_ - a1 * v_ + f[2] + g * cp * ct,
        q * cp - r * sp,
        p + (q * sp + r * cp) * st_ / ct,
        (q * sp + r * cp) / ct,
    ])  # fmt: skip


def integrated(x, u, dt, earth, pieces=8):
    """Runge-Kutta of fourth order in Euler angles, x = (h, v, angles, ba, bg)."""
    x, dt = x.copy(), dt / pieces
    for _ in range(pieces):

        def moved(k, by, x=x):
            return np.concatenate([x[:7] + by * k, x[7:]])

        k1 = euler_rates(x, u, earth)
        k2 = euler_rates(moved(k1, dt / 2), u, earth)
        k3 = euler_rates(moved(k2, dt / 2), u, earth)
        k4 = euler_rates(moved(k3, dt), u, earth)
        x = moved((k1 + 2 * k2 + 2 * k3 + k4) / 6.0, dt)
    return x


def ordinary(seed):
    """A state at ordinary pitch, in Euler angles and about a quaternion."""
    rng = np.random.default_rng(seed)
    x, _, u = random_state(seed, small=0.0)
    angles = np.array([rng.uniform(-1.0, 1.0), rng.uniform(-3.0, 3.0), rng.uniform(-3.0, 3.0)])
    flat = x[:13].copy()
    flat[4:7] = angles
    return x, quaternion(*angles), u, flat


@given(seeds, earths)
def test_a_step_is_the_equations_in_euler_angles_to_third_order(seed, earth):
    x, q, u, flat = ordinary(seed)
    errors = []
    for dt in (0.02, 0.01):
        x1, q1, _ = step(x, q, u, dt, earth)
        expected = integrated(flat, u, dt, earth)
        turned = flights.difference(flights.from_angles(*expected[4:7]), matrix(q1))
        assert np.abs(turned).max() < 2e-8  # the attitude is exact but for the turning of the Earth
        errors.append(np.abs(x1[:4] - expected[:4]).max())
    assert errors[0] < 3e-2
    assert errors[1] < errors[0] / 5.0 or errors[1] < 1e-9


def test_a_flight_of_steps_is_the_flight_in_euler_angles():
    x, q, _, flat = ordinary(3)
    flat[4:7] = 0.1, 0.2, 0.3
    q = quaternion(*flat[4:7])
    dt = 0.005
    for i in range(400):
        t = i * dt
        u = np.array([1.0, 0.3 * np.sin(t), -9.8 + np.cos(3 * t), 0.4 * np.sin(2 * t), 0.1, 0.1 * np.cos(t)])
        x, q, _ = step(x, q, u, dt, TURNING)
        flat = integrated(flat, u, dt, TURNING, 1)
    found = np.empty(3)
    rotation.euler(q, found)
    np.testing.assert_allclose(found, flat[4:7], atol=1e-9)
    np.testing.assert_allclose(x[:4], flat[:4], atol=2e-3)


@given(seeds, earths)
def test_the_jacobian_in_euler_angles_is_that_of_the_equations_in_euler_angles(seed, earth):
    dt = 1e-3
    x, q, u, flat = ordinary(seed)
    _, _, jacobian = step(x, q, u, dt, earth)
    after = integrated(flat, u, dt, earth, 1)
    to, back = np.eye(7), np.eye(13)
    rotation.euler_jacobian(after[4], after[5], to[4:7, 4:7])
    rotation.euler_jacobian(flat[4], flat[5], back[4:7, 4:7])
    to[1:4, 4:7], back[1:4, 4:7] = flights.cross(after[1:4]), flights.cross(flat[1:4])  # v = V - a x v
    back = np.linalg.inv(back)
    expected = np.empty((7, 13))
    for c in range(13):
        moved = flat.astype(complex)
        moved[c] += 1e-30j
        expected[:, c] = integrated(moved, u, dt, earth, 1)[:7].imag / 1e-30
    # entries are dt times rates; the two integrators differ by dt^3, and transport of the Earth is left out
    np.testing.assert_allclose(to @ jacobian @ back, expected, atol=2e-5)


@given(seeds, earths, st.sampled_from([None, 1.45, 1.5707963267948966, -1.5, 0.0]), st.sampled_from([0.02, 0.005]))
def test_a_step_and_its_jacobian_are_those_of_the_model_in_plain_numpy_at_any_pitch(seed, earth, pitch, dt):
    x, q, u = random_state(seed, pitch)
    x1, q1, jacobian = step(x, q, u, dt, earth)
    moved, r1, expected = flights.transition(x, matrix(q), u, dt, earth)
    np.testing.assert_allclose(x1[:4], moved, rtol=2e-14, atol=1e-11)
    np.testing.assert_allclose(matrix(q1), r1, atol=3e-15)
    np.testing.assert_allclose(jacobian, expected, rtol=1e-11, atol=2e-13)
    np.testing.assert_array_equal(x1[4:7], 0.0)
    np.testing.assert_array_equal(x1[7:], x[7:])


@pytest.mark.parametrize("rate", [0.0, 1e-9, 1e-3, 30.0])
def test_no_rate_and_a_spin_of_five_turns_a_second_are_stepped_alike(rate):
    x, q, u = random_state(5, 0.3, small=0.0 if rate == 0.0 else 0.02)
    u[3:] = x[10:13] + rate * np.array([0.6, -0.48, 0.64])
    x1, q1, jacobian = step(x, q, u, 0.01, TURNING)
    moved, r1, expected = flights.transition(x, matrix(q), u, 0.01, TURNING)
    np.testing.assert_allclose(x1[:4], moved, rtol=1e-13)
    np.testing.assert_allclose(matrix(q1), r1, atol=3e-15)
    np.testing.assert_allclose(jacobian, expected, rtol=1e-10, atol=2e-13)


@given(seeds)
def test_the_jacobian_is_the_central_difference_of_the_step(seed):
    x, q, u = random_state(seed)
    _, q1, jacobian = step(x, q, u, 0.02, TURNING)
    for c in range(13):
        width = 1e-3 if c < 4 else 1e-5
        ends = []
        for sign in (1.0, -1.0):
            moved = x.copy()
            moved[c] += sign * width
            y, p, _ = step(moved, q, u, 0.02, TURNING)
            turned = np.empty(3)
            rotation.difference(q1, p, turned)
            ends.append(np.concatenate([y[:1], flights.exp(turned) @ y[1:4], turned]))
        # beside rounding of the height: transport rate, dt v / radius = 3e-7 and less, which the Jacobian leaves out
        np.testing.assert_allclose(jacobian[:, c], (ends[0] - ends[1]) / (2 * width), atol=1e-6)


def test_errors_of_the_inputs_enter_like_those_of_the_biases():
    x, q, u = random_state(8)
    for c in range(6):
        changed, moved = u.copy(), x.copy()
        changed[c] -= 1e-4
        moved[7 + c] += 1e-4
        one, other = step(x, q, changed, 0.02, TURNING), step(moved, q, u, 0.02, TURNING)
        np.testing.assert_allclose(one[0][:7], other[0][:7], atol=1e-12)
        np.testing.assert_allclose(one[1], other[1], atol=1e-15)


def test_a_loop_goes_through_the_vertical_twice_without_a_break():
    x, q = np.zeros(23), quaternion(0.0, 0.0, 0.5)
    x[0], x[1] = 1000.0, 100.0
    turn_rate, dt = 0.5, 0.01
    pitches, heights = [], []
    for _ in range(round(2 * np.pi / turn_rate / dt)):
        up = matrix(q)[2]
        force = -9.81 * up + np.array([0.0, 0.0, -100.0 * turn_rate])  # a circle at constant speed
        before = x.copy(), q.copy()
        x, q, jacobian = step(x, q, np.array([*force, 0.0, turn_rate, 0.0]), dt, FLAT)
        assert np.isfinite(jacobian).all() and np.abs(jacobian).max() < 3.0
        assert np.abs(x[1:4] - before[0][1:4]).max() < 0.02
        assert np.abs(flights.difference(matrix(before[1]), matrix(q))).max() == pytest.approx(turn_rate * dt, rel=1e-9)
        angles = np.empty(3)
        rotation.euler(q, angles)
        pitches.append(angles[0])
        heights.append(x[0])
    assert max(pitches) > 1.56 and min(pitches) < -1.56
    assert max(heights) == pytest.approx(1000.0 + 2 * 100.0 / turn_rate, abs=0.5)
    np.testing.assert_allclose(x[:4], [1000.0, 100.0, 0.0, 0.0], atol=0.5)
    assert np.abs(flights.difference(matrix(quaternion(0.0, 0.0, 0.5)), matrix(q))).max() < 0.005


@given(seeds, st.sampled_from([None, 1.45, -1.3, 0.0]))
def test_measurements_and_their_jacobians_are_those_of_the_model_in_plain_numpy(seed, pitch):
    x, q, u = random_state(seed, pitch, small=0.0)
    y, h, work, r = np.empty(10), np.full((10, 23), np.nan), np.full(200, np.nan), matrix(q)
    w = u[3:] - x[10:13]
    kinematics.observe_air(x, r, w, VANE, y[:3], h[:3], work)
    kinematics.observe_attitude(q, y[3:6], h[3:6], work)
    kinematics.observe_velocity(x, r, w, ANTENNA, y[7:], h[7:])
    expected, jacobian = flights.sensitivity(x, r, u, VANE, ANTENNA)
    for rows in (slice(0, 3), slice(3, 6), slice(7, 10)):
        np.testing.assert_allclose(y[rows], expected[rows], rtol=1e-12, atol=1e-12)
        scale = np.abs(jacobian[rows]).max()
        np.testing.assert_allclose(h[rows] / scale, jacobian[rows] / scale, atol=1e-12)


def test_gusts_do_not_enter_the_scale_errors():
    x, q, u = random_state(2, 0.1, small=0.0)
    y, h, work, r = np.empty(3), np.empty((3, 23)), np.empty(200), matrix(q)
    seen = []
    for scale in (0.0, 0.05):
        x[18], x[21], x[22] = scale, scale, scale
        kinematics.observe_air(x, r, u[3:] - x[10:13], VANE, y, h, work)
        seen.append(h[:, 15:18].copy())
    np.testing.assert_allclose(seen[0], seen[1], rtol=1e-12)


def test_gravity_is_that_of_wgs84():
    assert Earth.at(0.0, 0.0).g0 == pytest.approx(9.7803253359)
    assert Earth.at(np.pi / 2, 0.0).g0 == pytest.approx(9.8321849379, abs=1e-9)
    middle = Earth.at(np.radians(45.0), 0.0)
    assert middle.g0 == pytest.approx(9.806197769, abs=1e-8)
    assert middle.gh == pytest.approx(-3.0861e-6, rel=2e-3)  # the free-air gradient


def test_radii_and_rates_of_the_earth_are_those_of_the_ellipsoid():
    at = Earth.at(np.radians(50.0), 2000.0)
    assert 1.0 / at.meridian == pytest.approx(6372956.0 + 2000.0, abs=10.0)
    assert 1.0 / at.vertical == pytest.approx(6390702.0 + 2000.0, abs=10.0)
    assert np.hypot(at.rate_north, at.rate_down) == pytest.approx(7.292115e-5)
    assert at.rate_down < 0.0 < at.rate_north


def test_a_body_at_rest_on_the_turning_earth_stays_at_rest():
    x, q = np.zeros(23), quaternion(0.2, -0.1, 1.0)
    x[0] = 1000.0
    start = matrix(q).copy()
    for _ in range(1000):
        r = matrix(q)
        e = r.T @ [TURNING.rate_north, 0.0, TURNING.rate_down]
        u = np.concatenate([-(TURNING.g0 + TURNING.gh * 1000.0) * r[2], e])
        x, q, _ = step(x, q, u, 0.01, TURNING)
    assert np.abs(x[1:4]).max() < 1e-9
    assert np.abs(flights.difference(start, matrix(q))).max() < 1e-12
