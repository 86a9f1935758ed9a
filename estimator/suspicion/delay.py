"""How late the GNSS velocity is, against accelerometers and gyros alone: no attitude, no wind, no vertical speed.

Over a block of ten seconds the gyros give the body's attitude relative to that at the block's start, C(t), and with it
the integral of the specific force in the axes of the start. What is unknown, a rotation R0 to north-east-down, the
starting velocity, biases, the antenna's place and the delay tau, the horizontal GNSS velocities of all blocks tell::

    s(t) = int C f dt     M(t) = int C dt     N(t) = int [C f]x M dt     D(t) = C [omega]x
    v(t) = v0 + R0 (s - M ba + N bg + D r) (t - tau)       (its north and east)

All but R0 and tau is linear. R0 starts from Wahba's problem (the singular value decomposition of sum v s^T, gravity
as the third component), tau from a scan; then Gauss-Newton over all of it, the unknowns of a block eliminated block by
block (Schur complement).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from estimator.suspicion.columns import Columns, Finding, Floats, Times, seconds
from estimator.ud import compiled

LENGTH = 10.0
"""Length of a block (s): long enough to hold a manoeuvre, short enough for gyros of 0.5 deg/s."""
EARLY, LATE = -0.3, 1.2
"""Delays that are looked for (s)."""
PRIORS = np.array([0.5, 0.5, 0.5, 0.5, 0.5, 0.5, 0.02, 0.02, 0.02, 2.0, 2.0, 2.0, 1e3, 1e3])
"""Prior sd of the unknowns of a block: error of R0 (rad), ba (m/s2), bg (rad/s), r (m), v0 (m/s)."""
LIVELY = 4.0
"""Blocks count whose velocity leaves a straight line by this many times the noise of a fix (rms)."""
MOST = 100
"""Blocks used: the liveliest ones."""


class Delay(NamedTuple):
    """GNSS velocity delay, its standard deviation (s), the blocks behind it, and the rms of the residuals (m/s)."""

    value: float
    sigma: float
    blocks: int
    residual: float


@compiled
def integrals(t: Floats, force: Floats, rate: Floats, first: Times, last: Times, out: Floats) -> None:
    """Fill rows ``first[b] .. last[b] - 1`` of ``out`` (k, 30) with s, M, N, D from the start of block b.

    A sample of ``force`` and ``rate`` (k, 3) is the mean over the interval that ends at its ``t`` (k,), s.
    """
    for b in range(first.size):
        w, x, y, z = 1.0, 0.0, 0.0, 0.0
        c = np.eye(3)
        turned = np.empty(3)
        for k in range(first[b], last[b]):
            if k == first[b]:
                out[k, :21] = 0.0
            else:
                dt = t[k] - t[k - 1]
                for half in range(2):
                    hx, hy, hz = 0.25 * dt * rate[k, 0], 0.25 * dt * rate[k, 1], 0.25 * dt * rate[k, 2]
                    angle = np.sqrt(hx * hx + hy * hy + hz * hz)
                    cosine, sine = np.cos(angle), np.sin(angle) / angle if angle > 1e-9 else 1.0
                    hx, hy, hz = sine * hx, sine * hy, sine * hz
                    w, x, y, z = (
                        w * cosine - x * hx - y * hy - z * hz,
                        w * hx + x * cosine + y * hz - z * hy,
                        w * hy - x * hz + y * cosine + z * hx,
                        w * hz + x * hy - y * hx + z * cosine,
                    )
                    c[0, 0], c[0, 1], c[0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
                    c[1, 0], c[1, 1], c[1, 2] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
                    c[2, 0], c[2, 1], c[2, 2] = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
                    if half == 0:  # the middle of the interval stands for it
                        for i in range(3):
                            turned[i] = c[i, 0] * force[k, 0] + c[i, 1] * force[k, 1] + c[i, 2] * force[k, 2]
                            out[k, i] = out[k - 1, i] + dt * turned[i]
                            for j in range(3):
                                out[k, 3 + 3 * i + j] = out[k - 1, 3 + 3 * i + j] + dt * c[i, j]
                        for j in range(3):
                            m0 = 0.5 * (out[k - 1, 3 + j] + out[k, 3 + j])
                            m1 = 0.5 * (out[k - 1, 6 + j] + out[k, 6 + j])
                            m2 = 0.5 * (out[k - 1, 9 + j] + out[k, 9 + j])
                            out[k, 12 + j] = out[k - 1, 12 + j] + dt * (turned[1] * m2 - turned[2] * m1)
                            out[k, 15 + j] = out[k - 1, 15 + j] + dt * (turned[2] * m0 - turned[0] * m2)
                            out[k, 18 + j] = out[k - 1, 18 + j] + dt * (turned[0] * m1 - turned[1] * m0)
            p, q, r = rate[k, 0], rate[k, 1], rate[k, 2]
            for i in range(3):
                out[k, 21 + 3 * i] = c[i, 1] * r - c[i, 2] * q
                out[k, 22 + 3 * i] = c[i, 2] * p - c[i, 0] * r
                out[k, 23 + 3 * i] = c[i, 0] * q - c[i, 1] * p


class _Problem(NamedTuple):
    """Blocks side by side: IMU rows, their integrals, and per block (B, F) the fixes, weight 0 where there is none."""

    t: Floats  # (k,)
    integral: Floats  # (k, 30)
    first: Times  # (B,)
    last: Times
    fix: Floats  # (B, F) times
    velocity: Floats  # (B, F, 3): north, east, and down as far as it is known
    there: Floats  # (B, F) 1 or 0
    arm: Floats  # (3,)


def gnss_delay(
    columns: Columns, gravity: float = 9.80665, arm: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> Delay | None:
    """Delay of the GNSS velocity behind the inertial sensors.

    Parameters
    ----------
    columns : Columns
        IMU and GNSS; an altimeter helps to level.
    gravity : float
        m/s2.
    arm : (float, float, float)
        From the IMU to the antenna, body axes, m; found within 2 m of that.

    Returns
    -------
    Delay or None
        None without three blocks of manoeuvres. The standard deviation is the larger of that of the fit, with the noise
        of the residuals, and of the scatter from block to block; half an IMU interval is added, because whether a
        sample is a mean over its interval or a point value cannot be seen.
    """
    problem = _problem(columns, arm)
    if problem is None:
        return None
    scan = np.arange(EARLY, LATE + 0.05, 0.1)
    costs = np.array([_wahba(problem, tau, gravity)[1] for tau in scan])
    quiet = np.maximum(costs.min(axis=0), np.median(costs.min(axis=0)))
    tau = float(scan[int((costs / quiet).sum(axis=1).argmin())])
    rotation, _ = _wahba(problem, tau, gravity)
    unknown = np.zeros((len(rotation), 9))
    count = np.maximum(2.0 * problem.there.sum(axis=1) - 8.0, 4.0)
    weight = np.full(len(rotation), 1.0 / 0.2**2)
    for _ in range(8):
        residual, jacobian, late = _linearised(problem, tau, rotation, unknown)
        prior = np.concatenate([np.zeros((len(rotation), 3)), unknown, np.zeros((len(rotation), 2))], axis=1)
        information = np.einsum("bfi,bfj,b->bij", jacobian, jacobian, weight) + np.diag(PRIORS**-2)
        right = np.einsum("bfi,bf,b->bi", jacobian, residual, weight) - prior * PRIORS**-2
        cross = np.einsum("bfi,bf,b->bi", jacobian, late, weight)
        gain = np.linalg.solve(information, np.stack([cross, right], axis=2))
        own = np.einsum("bf,bf,b->b", late, late, weight) - (cross * gain[:, :, 0]).sum(axis=1)
        score = np.einsum("bf,bf,b->b", late, residual, weight) - (cross * gain[:, :, 1]).sum(axis=1)
        step = float(np.clip(score.sum() / own.sum(), -0.2, 0.2))
        change = gain[:, :, 1] - gain[:, :, 0] * step
        rest = residual - np.einsum("bfi,bi->bf", jacobian, change) - late * step
        variance = (rest**2).sum(axis=1) / count
        score -= own * step
        rotation = _turned(rotation, np.clip(change[:, :3], -0.5, 0.5))
        unknown = unknown + change[:, 3:12]
        tau += step
        weight = 1.0 / np.maximum(variance, max(float(np.median(variance)), 0.02**2))
        if not (np.isfinite(tau) and EARLY - 0.3 < tau < LATE + 0.3):
            return None
    found = float(own.sum())
    if not found > 0.0:
        return None
    blocks = len(own)
    scatter = np.sqrt(blocks / (blocks - 1.0) * (score**2).sum()) / found
    chi = np.sqrt(max(1.0, float((variance * weight).mean())))
    interval = float(np.median(np.diff(problem.t)))
    sigma = float(np.hypot(max(scatter, chi / np.sqrt(found)), 0.5 * interval))
    return Delay(float(tau), sigma, blocks, float(np.sqrt(np.median(variance))))


def _problem(columns: Columns, arm: tuple[float, float, float]) -> _Problem | None:
    if columns.imu is None or columns.gnss is None:
        return None
    start = int(columns.imu.t[0])
    t, fix = seconds(columns.imu.t, start), seconds(columns.gnss.t, start)
    good = np.isfinite(columns.gnss.velocity[:, :2]).all(axis=1) & (fix >= LATE) & (fix <= t[-1] + EARLY)
    fix, velocity = fix[good], columns.gnss.velocity[good].copy()
    if len(fix) < 30:
        return None
    velocity[:, 2] = _down(columns, start, fix, velocity[:, 2])
    begins = np.arange(LATE, t[-1] - LENGTH + EARLY, LENGTH)
    low, high = np.searchsorted(fix, begins), np.searchsorted(fix, begins + LENGTH)
    first, last = np.searchsorted(t, begins - LATE, "right") - 1, np.searchsorted(t, begins + LENGTH - EARLY) + 1
    last = np.minimum(last, len(t))
    most = int((high - low).max(initial=0))
    if most < 15:
        return None
    holes = np.concatenate([[0], np.cumsum(np.diff(t) > 0.25)])
    whole = (high - low >= max(15, most // 2)) & (holes[last - 1] == holes[first]) & (first >= 0)
    rows = low[:, None] + np.arange(most)
    there = rows < high[:, None]
    rows = np.minimum(rows, len(fix) - 1)
    when, what = fix[rows], velocity[rows]
    # How far the velocity leaves a straight line: without manoeuvres there is nothing to compare.
    line = np.stack([np.ones_like(when), when - when.mean(axis=1, keepdims=True)], axis=2) * there[:, :, None]
    normal = np.einsum("bfi,bfj->bij", line, line) + 1e-9 * np.eye(2)
    known = what[:, :, :2] * there[:, :, None]
    coefficient = np.linalg.solve(normal, np.einsum("bfi,bfc->bic", line, known))
    bend = np.sqrt(((known - np.einsum("bfi,bic->bfc", line, coefficient)) ** 2).sum(axis=(1, 2)) / there.sum(axis=1))
    noise = 1.4826 * float(np.median(np.abs(np.diff(velocity[:, :2], n=2, axis=0)))) / np.sqrt(6.0)
    bend[~whole | ~(bend > LIVELY * max(noise, 0.05))] = 0.0
    chosen = np.sort(np.argsort(-bend)[:MOST])
    chosen = chosen[bend[chosen] > 0.0]
    if len(chosen) < 3:
        return None
    # Blocks overlap by the delays looked for, so each gets rows of its own.
    sizes = last[chosen] - first[chosen]
    starts = np.concatenate([[0], np.cumsum(sizes)])
    own = np.concatenate([np.arange(a, b) for a, b in zip(first[chosen], last[chosen], strict=True)])
    integral = np.zeros((len(own), 30))
    times = np.ascontiguousarray(t[own])
    force, rate = (np.ascontiguousarray(c[own], dtype=np.float64) for c in columns.imu[1:])
    integrals(times, force, rate, starts[:-1], starts[1:], integral)
    present = there[chosen].astype(np.float64)
    return _Problem(times, integral, starts[:-1], starts[1:], when[chosen], what[chosen], present, np.array(arm))


def warm_up() -> None:
    """Compile what is needed only after an aircraft has manoeuvred, so that nothing waits for it then."""
    t, rows, ends = np.arange(2.0), np.zeros((2, 3)), np.array([0, 2])
    integrals(t, rows, rows, ends[:-1], ends[1:], np.zeros((2, 30)))


def _down(columns: Columns, start: int, fix: Floats, down: Floats) -> Floats:
    """Velocity down at the fixes, m/s, from the altimeter where the receiver does not report it, else zero."""
    if np.isfinite(down).all():
        return down
    if columns.altitude is None:
        return np.zeros(len(fix))
    good = np.isfinite(columns.altitude.altitude)
    if np.count_nonzero(good) < 2:
        return np.zeros(len(fix))
    t, altitude = seconds(columns.altitude.t, start)[good], columns.altitude.altitude[good]
    climb = np.interp(fix + 1.0, t, altitude) - np.interp(fix - 1.0, t, altitude)
    return np.where(np.isfinite(down), down, -0.5 * climb)


def _sampled(problem: _Problem, tau: float, width: int = 30) -> Floats:
    """The first integrals (B, F, width) at the fixes less the delay."""
    out = np.empty((*problem.fix.shape, width))
    for b, (first, last) in enumerate(zip(problem.first, problem.last, strict=True)):
        t = problem.t[first:last]
        at = problem.fix[b] - tau
        k = np.clip(np.searchsorted(t, at), 1, len(t) - 1)
        share = np.clip((at - t[k - 1]) / (t[k] - t[k - 1]), 0.0, 1.0)[:, None]
        rows = problem.integral[first:last, :width]
        out[b] = rows[k - 1] + share * (rows[k] - rows[k - 1])
    return out


def _wahba(problem: _Problem, tau: float, gravity: float) -> tuple[Floats, Floats]:
    """Rotations (B, 3, 3) that bring s nearest to the velocities, and what is left of them, per block."""
    s = _sampled(problem, tau, 3)
    target = problem.velocity.copy()
    target[:, :, 2] -= gravity * problem.fix
    weight = (problem.there / problem.there.sum(axis=1, keepdims=True))[:, :, None]
    target = target - (weight * target).sum(axis=1, keepdims=True)
    s = s - (weight * s).sum(axis=1, keepdims=True)
    u, _, vt = np.linalg.svd(np.einsum("bfi,bfj->bij", weight * target, s))
    u[:, :, 2] *= np.linalg.det(u @ vt)[:, None]
    rotation = u @ vt
    rest = target - np.einsum("bij,bfj->bfi", rotation, s)
    return rotation, np.asarray((weight * rest**2)[:, :, :2].sum(axis=(1, 2)))


def _linearised(problem: _Problem, tau: float, rotation: Floats, unknown: Floats) -> tuple[Floats, Floats, Floats]:
    """Residuals (B, 2F), their Jacobian (B, 2F, 14) and derivative by tau (B, 2F); north rows, then east rows.

    v0 is fitted anew each time: its columns stand for the mean of the residuals.
    """
    now, before, after = (_sampled(problem, tau + shift) for shift in (0.0, 0.02, -0.02))

    def moved(rows: Floats) -> Floats:
        s, m, n, d = rows[..., :3], *(rows[..., i : i + 9].reshape(*rows.shape[:2], 3, 3) for i in (3, 12, 21))
        ba, bg, r = unknown[:, None, :3], unknown[:, None, 3:6], unknown[:, None, 6:] + problem.arm

        def times(matrix: Floats, vector: Floats) -> Floats:
            return np.asarray(np.einsum("bfij,bfj->bfi", matrix, np.broadcast_to(vector, matrix.shape[:3])))

        body = s - times(m, ba) + times(n, bg) + times(d, r)
        return np.asarray(np.einsum("bij,bfj->bfi", rotation, body))

    v = moved(now)
    matrices = [
        np.einsum("bij,bfjk->bfik", rotation, now[..., i : i + 9].reshape(*now.shape[:2], 3, 3)) for i in (3, 12, 21)
    ]
    zero, one = np.zeros(v.shape[:2]), np.ones(v.shape[:2])
    # A small rotation e of R0 moves v by e x v.
    north = np.stack([zero, v[..., 2], -v[..., 1]], axis=2), np.stack([-v[..., 2], zero, v[..., 0]], axis=2)
    rows = []
    for i in range(2):
        parts = [north[i], -matrices[0][:, :, i], matrices[1][:, :, i], matrices[2][:, :, i]]
        rows.append(np.concatenate([*parts, np.stack([one, zero] if i == 0 else [zero, one], axis=2)], axis=2))
    there = np.concatenate([problem.there, problem.there], axis=1)
    jacobian = np.concatenate(rows, axis=1) * there[:, :, None]
    slope = (moved(before) - moved(after)) / 0.04
    difference = problem.velocity[:, :, :2] - v[:, :, :2]
    difference -= (difference * problem.there[:, :, None]).sum(axis=1, keepdims=True) / problem.there.sum(axis=1)[
        :, None, None
    ]

    def flat(values: Floats) -> Floats:
        return np.asarray(np.concatenate([values[:, :, 0], values[:, :, 1]], axis=1) * there)

    return flat(difference), jacobian, flat(slope)


def _turned(rotation: Floats, angle: Floats) -> Floats:
    """exp([angle]x) rotation, per block."""
    size = np.linalg.norm(angle, axis=1)
    safe = np.maximum(size, 1e-12)
    cross = np.zeros((len(angle), 3, 3))
    cross[:, 0, 1], cross[:, 0, 2], cross[:, 1, 2] = -angle[:, 2], angle[:, 1], -angle[:, 0]
    cross = cross - cross.transpose(0, 2, 1)
    first = (np.sin(size) / safe)[:, None, None] * cross
    second = ((1.0 - np.cos(size)) / safe**2)[:, None, None] * (cross @ cross)
    return np.asarray((np.eye(3) + first + second) @ rotation)


def find_delay(columns: Columns, configured: float, gravity: float, arm: tuple[float, float, float]) -> list[Finding]:
    """A GNSS delay that differs from the configured one by more than four sigma and 0.03 s."""
    delay = gnss_delay(columns, gravity, arm)
    if delay is None or abs(delay.value - configured) < max(4.0 * delay.sigma, 0.03):
        return []
    return [
        Finding(
            "gnss", "delay", delay.value, delay.sigma, "s", "warning",
            f"gnss: velocity is {delay.value:.3f} +- {delay.sigma:.3f} s behind the inertial sensors "
            f"({configured:.3f} s "
            f"configured; {delay.blocks} stretches of manoeuvres): it bends every turn; configure "
            f"estimate.flight_path.gnss_delay = {max(delay.value, 0.0):.2f}",
        )
    ]  # fmt: skip
