"""Flights to test against: the model of the flight path once more, in plain numpy, and what follows from it.

Rotation matrices instead of quaternions, derivatives by complex steps instead of by hand, covariances instead of
factors of the information: nothing is shared with the estimator but the numbers of the states and the settings.
"""

from __future__ import annotations

from itertools import pairwise
from types import SimpleNamespace

import numpy as np
from scipy.linalg import solve_triangular
from scipy.spatial.transform import Rotation

from estimator import extended
from estimator.models.flight_path import FlightPath, Settings

TINY = 1e-30
ORDINARY = {"h": 1000.0, "u": 60.0, "theta": 0.05, "psi": 0.3}


def cross(c):
    zero = 0.0 * c[0]
    return np.array([[zero, -c[2], c[1]], [c[2], zero, -c[0]], [-c[1], c[0], zero]])


def exp(a):
    """The rotation by vector a: its power series, which takes complex numbers."""
    term, total, m = np.eye(3), np.eye(3), cross(np.asarray(a))
    for k in range(1, 24):
        term = term @ m / k
        total = total + term
        if np.abs(term).max() < 1e-18:
            break
    return total


def atan2(y, x):
    """To first order in the imaginary parts."""
    y, x = complex(y), complex(x)
    return np.arctan2(y.real, x.real) + 1j * (x.real * y.imag - y.real * x.imag) / (x.real**2 + y.real**2)


def angles(r):
    """Theta, phi, psi of a rotation matrix."""
    s = -r[2, 0]
    return np.array([atan2(s, np.sqrt(1.0 - s * s + 0j)), atan2(r[2, 1], r[2, 2]), atan2(r[1, 0], r[0, 0])])


def from_angles(theta, phi, psi):
    return Rotation.from_euler("ZYX", [psi, theta, phi]).as_matrix()


def from_quaternion(q):
    return Rotation.from_quat(np.asarray(q), scalar_first=True).as_matrix()


def difference(r, r1):
    """The rotation vector from r to r1."""
    return Rotation.from_matrix(r.T @ r1).as_rotvec()


def derivative(h, v, r, f, w, earth):
    """h', v' of section 2.2 with every vector written as a vector."""
    rate = np.array([earth.rate_north, 0.0, earth.rate_down])
    down = np.array([0.0, 0.0, earth.g0 + earth.gh * h])
    return -(r @ v)[2], f + r.T @ down - cross(w + r.T @ rate) @ v


def turning(r, v, earth):
    """Rate of north-east-down against the stars, in itself; the estimator takes it for known."""
    vn, ve, _ = np.real(r @ v)
    over = np.array([ve * earth.vertical, -vn * earth.meridian, -ve * earth.tangent * earth.vertical])
    return np.array([earth.rate_north, 0.0, earth.rate_down]) + over


def about(x, r, nominal):
    """State x, whose rotation about r is zero, about another attitude: the velocity goes with it."""
    moved = x.copy()
    moved[4:7] = difference(nominal, r)
    moved[1:4] = nominal.T @ r @ x[1:4]
    return moved


def carried(x, r, u, dt, earth):
    """One midpoint step of (h, V, a, ba, bg) about r, V = exp([a]x) v: h, v and the new attitude."""
    f, w = u[:3] - x[7:10], u[3:] - x[10:13]
    h, v, r = x[0], exp(-x[4:7]) @ x[1:4], r @ exp(x[4:7])
    earthly = -turning(r, v, earth)
    dh, dv = derivative(h, v, r, f, w, earth)
    middle = exp(0.5 * dt * earthly) @ r @ exp(0.5 * dt * w)
    dh, dv = derivative(h + 0.5 * dt * dh, v + 0.5 * dt * dv, middle, f, w, earth)
    return h + dt * dh, v + dt * dv, exp(dt * earthly) @ r @ exp(dt * w)


def transition(x, r, u, dt, earth):
    """The step, and its Jacobian (7, 13) by complex steps, about the new attitude."""
    h, v, r1 = carried(x[:13], r, u, dt, earth)
    jacobian = np.empty((7, 13))
    for c in range(13):
        moved = x[:13].astype(complex)
        moved[c] += TINY * 1j
        dh, dv, dr = carried(moved, r, u, dt, earth)
        turned = (r1.T @ dr).imag / TINY
        dv = r1.T @ dr @ dv
        jacobian[:, c] = [dh.imag / TINY, *(dv.imag / TINY), turned[2, 1], turned[0, 2], turned[1, 0]]
    return np.array([h, *v]), r1, jacobian


def flow(v):
    return np.array([np.sqrt(v @ v), atan2(v[2], v[0]), atan2(v[1], np.sqrt(v[0] ** 2 + v[2] ** 2 + 0j))])


def measured(x, r, u, vane, antenna):
    """The ten measurements of section 2.5 at state x (23,) about r."""
    r, v = r @ exp(x[4:7]), exp(-x[4:7]) @ x[1:4]
    w = u[3:] - x[10:13]
    wind = np.array([x[13], x[14], 0.0 * x[13]])
    calm = v - r.T @ wind + cross(w) @ vane
    air = flow(calm - r.T @ x[15:18]) + np.array([x[18], x[21], x[22]]) * flow(calm)
    air = air + np.array([0.0 * x[19], x[19], x[20]])
    return np.concatenate([air, angles(r), [x[0]], r @ (v + cross(w) @ antenna)])


def sensitivity(x, r, u, vane, antenna):
    """The measurements and their Jacobian (10, 23), by complex steps."""
    jacobian = np.empty((10, 23))
    for c in range(23):
        moved = x.astype(complex)
        moved[c] += TINY * 1j
        jacobian[:, c] = measured(moved, r, u, vane, antenna).imag / TINY
    return measured(x.astype(complex), r, u, vane, antenna).real, jacobian


def wrapped(z):
    return z - 2.0 * np.pi * np.round(z / (2.0 * np.pi))


def covariance(carry):
    """Of the start, in the order of the factor."""
    root = solve_triangular(carry.ut[:, 1:], np.eye(carry.d.size), lower=True)
    return (root / carry.d) @ root.T


def flight(seed=1, count=60, mode="G", dt=0.02, missing=0.1, attitude=True, air=True, start=ORDINARY, **changes):
    """A flight that its own model has made: truth, and a Drive with sensors of several rates and missing samples."""
    rng = np.random.default_rng(seed)
    places = {"vane": (4.0, 0.3, -0.2), "antenna": (-2.0, 0.1, -1.0)}
    settings = Settings.fti(
        **{"mode": mode, "turbulence": 1.0, "turbulence_time": 3.0, "flow_tells_airspeed": True, **places, **changes}
    )
    path = FlightPath.of(settings, 0.8, 1000.0)
    carry = path.start(start)
    model, n = path.model, path.n
    x, r = carry.x.copy(), from_quaternion(carry.q)
    x[model.order] += np.linalg.cholesky(covariance(carry)) @ rng.normal(size=n)
    r, x[1:4], x[4:7] = r @ exp(x[4:7]), exp(-x[4:7]) @ x[1:4], 0.0
    times = np.arange(count) * dt
    steps = dt * rng.uniform(0.8, 1.2, count)
    inertial = np.tile(np.repeat([settings.accelerometer, settings.gyro], 3) ** 2, (count, 1))
    q, fade = path.noise(steps, inertial)
    sigma = np.array([
        settings.airspeed, settings.flow_angle, settings.flow_angle, settings.attitude or 1.0, settings.attitude or 1.0,
        settings.heading or 1.0, settings.height, *[settings.gnss_velocity or 0.2] * 3,
    ])  # fmt: skip
    every = np.array([5, 2, 2, 2, 2, 2, 5, 10, 10, 10])
    absent = np.zeros(10, bool)
    absent[:3] = mode == "I" or not air
    absent[3:5] = not attitude
    absent[[5, 7, 8, 9]] |= mode == "P"
    u, z = np.empty((count, 6)), np.full((count, 10), np.nan)
    true_x, true_r = np.empty((count + 1, 23)), np.empty((count + 1, 3, 3))
    true_x[0], true_r[0] = x, r
    for i, t in enumerate(times):
        rate = np.array([0.4 * np.sin(1.1 * t), 0.05 + 0.1 * np.sin(0.7 * t), 0.1 * np.sin(0.4 * t)])
        pull = np.array([0.5 * np.sin(0.3 * t) - 0.02 * (x[1] - 60.0), -0.1 * x[2], -0.3 * x[3]])
        true = np.concatenate([cross(rate) @ x[1:4] - 9.81 * r[2] + pull, rate])
        noise = np.sqrt(q[i]) * rng.normal(size=path.p)
        u[i] = true + x[7:13] + noise[:6]
        h, v, r = carried(x, r, u[i] - noise[:6], steps[i], model.earth)
        x[0], x[1:4] = h, v
        x[model.order[model.fades > 0.0]] *= fade[i]
        x[model.order[model.driven]] += noise[6:]
        y = measured(x.astype(complex), r, u[i], settings.vane, settings.antenna).real
        here = (i % every == every - 1) & ~absent & (rng.random(10) >= missing)
        z[i] = np.where(here, y + sigma * rng.normal(size=10), np.nan)
        true_x[i + 1], true_r[i + 1] = x, r
    flags = np.zeros(count, np.uint8)
    drive = extended.Drive(steps, u, q, fade, z, np.tile(sigma**2, (count, 1)), flags, np.ones(count, np.uint8))
    return SimpleNamespace(path=path, model=model, n=n, drive=drive, carry=carry, x=true_x, r=true_r, count=count)


def smoothed(given, window=100, near=None, gated=False, drive=None, cuts=(), keep=True, model=None):
    """Forward in pieces, backward in one: all that ``extended`` says of a flight."""
    drive, model, n = drive or given.drive, model or given.model, given.n
    count = len(drive.dt)
    rows, told = extended.Rows.empty(count, n, given.path.p), extended.Told.empty(count, n)
    carry = given.carry.copy()
    if near is not None:
        carry.x[:] = about(carry.x, from_quaternion(carry.q), from_quaternion(near.q[0]))
        carry.s[-6:], carry.q[:] = carry.x[1:7], near.q[0]
    first = carry.copy()
    ends = [0, *sorted(cuts), count]
    for begin, end in pairwise(ends):
        part = extended.Drive(*(a[begin:end] for a in drive))
        trajectory = extended.About.nothing()
        if near is not None:
            trajectory = extended.About(
                near.x[begin : end + 1], near.q[begin : end + 1], *(a[begin:end] for a in near[2:])
            )
        failed = extended.forward(
            model, part, trajectory, window, gated, carry, keep, rows.part(begin, end),
            extended.Told(*(a[begin:end] for a in told)),
        )  # fmt: skip
        assert failed == -1
    found = SimpleNamespace(carry=carry.copy(), rows=rows, told=told)
    found.filtered = np.empty((count, n))
    extended.named(model, rows.x, rows.q, True, found.filtered)
    if not keep:
        return found
    star, vt, d = np.empty((n, 1)), np.empty((n, n)), np.empty(n)
    found.x, found.q, found.w = np.empty((count + 1, 23)), np.empty((count + 1, 4)), np.empty((count, 6))
    found.std = np.full((count + 1, n), np.nan)
    extended.finish(carry, star, vt, d, True)
    extended.backward(
        model, rows, star, vt, d, np.ones(count + 1, np.uint8), True, first.s, first.q, first.x, found.x, found.q,
        found.w, found.std,
    )  # fmt: skip
    found.mean = np.empty((count + 1, n))
    extended.named(model, found.x, found.q, False, found.mean)
    found.p0 = vt.T @ (d[:, None] * vt)  # of epoch 0, where phi = I
    found.about = extended.About(found.x, found.q, found.w, told.status, told.r, told.doubted)
    return found


def textbook(given):
    """Extended Kalman filter and Rauch-Tung-Striebel smoother, dense: blocks, Joseph's form, complex steps."""
    model, n, drive = given.model, given.n, given.drive
    order, base = model.order, n - 7
    told = np.array([*range(13), *order[: n - 13]])
    to_named = np.array([int(np.flatnonzero(order == state)[0]) for state in told])
    gamma = np.zeros((n, given.path.p))
    gamma[model.driven, np.arange(6, given.path.p)] = 1.0
    x, r, p = given.carry.x.copy(), from_quaternion(given.carry.q), covariance(given.carry)
    kept, found = [], SimpleNamespace(nis=0.0, log_s=0.0, scalars=0)

    def say(x, r, p):
        r = r @ exp(x[4:7])
        turned = np.empty((3, 3))
        for c in range(3):
            turned[:, c] = angles(r @ exp(TINY * 1j * np.eye(3)[c])).imag / TINY
        image = np.eye(n)
        image[4:7, 4:7] = turned
        mean = x[told].copy()
        image[1:4, 1:4] = exp(-x[4:7])
        mean[1:4], mean[4:7] = image[1:4, 1:4] @ x[1:4], angles(r).real
        image[1:4, 4:7] = cross(mean[1:4])
        return mean, np.sqrt(np.diag(image @ p[np.ix_(to_named, to_named)] @ image.T))

    for i in range(given.count):
        before = x.copy(), r, p
        moved, r1, jacobian = transition(x, r, drive.u[i], drive.dt[i], model.earth)
        phi = np.eye(n)
        phi[base:, base:], phi[base:, base - 6 : base] = jacobian[:, :7], jacobian[:, 7:]
        fading = model.fades > 0.0
        phi[fading, fading] = drive.fade[i]
        gamma[base:, :6] = jacobian[:, 7:]
        x, r = x.copy(), r1
        x[:4], x[4:7] = moved, 0.0
        x[order[fading]] *= drive.fade[i]
        q = gamma @ np.diag(drive.q[i]) @ gamma.T
        p = phi @ p @ phi.T + q
        ahead = x.copy(), p
        y, h = sensitivity(x, r, drive.u[i], model.vane, model.antenna)
        here = np.isfinite(drive.z[i])
        if here.any():
            h = h[np.ix_(here, order)]
            miss = (drive.z[i] - y)[here]
            round_ = np.isin(np.flatnonzero(here), range(1, 6))
            miss[round_] = wrapped(miss[round_])
            noise = np.diag(drive.r[i][here])
            s = h @ p @ h.T + noise
            gain = np.linalg.solve(s, h @ p).T
            x[order] += gain @ miss
            left = np.eye(n) - gain @ h
            p = left @ p @ left.T + gain @ noise @ gain.T
            found.nis += miss @ np.linalg.solve(s, miss)
            found.log_s += np.linalg.slogdet(s)[1]
            found.scalars += here.sum()
        kept.append((before, phi, gamma.copy(), ahead, (x.copy(), r, p)))
    told_of = [say(*after) for *_, after in kept]
    found.filtered, found.filtered_std = (np.array(part) for part in zip(*told_of, strict=True))
    means, noises = [say(x, r, p)], []
    for i in range(given.count - 1, -1, -1):
        (x0, r0, p0), phi, gam, (ahead, ahead_p), _ = kept[i]
        jump = x[order] - ahead[order]
        noises.append(drive.q[i] * (gam.T @ np.linalg.solve(ahead_p, jump)))
        gain = np.linalg.solve(ahead_p, phi @ p0).T
        left = np.eye(n) - gain @ phi
        p = left @ p0 @ left.T + gain @ (p + gam @ np.diag(drive.q[i]) @ gam.T) @ gain.T
        x, r = x0.copy(), r0
        x[order] += gain @ jump
        means.append(say(x, r, p))
    found.mean, found.std = (np.array(part)[::-1] for part in zip(*means, strict=True))
    found.w = np.array(noises)[::-1, :6]
    found.p0 = p
    return found


def apart(one, other, std):
    """Largest difference of named states in standard deviations, angles round the circle."""
    gap = one - other
    gap[:, 4:7] = wrapped(gap[:, 4:7])
    return float(np.abs(gap / std).max())
