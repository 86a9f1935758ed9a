"""The accelerometer at rest: what it says of gravity when nothing moves."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from estimator.suspicion.columns import Columns, Finding, Floats, blocks, seconds, spread

QUIET_FORCE, QUIET_RATE = 0.3, 0.02
"""Standard deviation within a second that rest allows: |f| (m/s2), each rate (rad/s)."""
STILL = 1.0
"""Ground speed that rest allows (m/s)."""
KNOWN = 5e-4
"""How well local gravity is known, relative (1 sigma): height and anomalies."""


class Scale(NamedTuple):
    """(|f| - g) / g at rest: mean, standard deviation, its value in the first and the last minute, seconds of rest."""

    value: float
    sigma: float
    first: float
    last: float
    span: float


def scale_at_rest(columns: Columns, gravity: float) -> Scale | None:
    """Relative error of |f| against local gravity while the aircraft stands.

    Rest is a second of quiet gyros, quiet accelerometers and, because a trimmed flight in calm air is as quiet, a GNSS
    ground speed below 1 m/s; without GNSS there is no rest. |f| / g - 1 has the accelerometer's scale error and, along
    the vertical, its bias over g in it; one attitude cannot tell the two apart.

    Returns
    -------
    Scale or None
        None with less than five seconds of rest. The standard deviation is the scatter of the means of ten-second
        stretches (drift as it warms up included), not of their mean: rest is one sample of the drift.
    """
    if columns.imu is None or columns.gnss is None:
        return None
    start = int(columns.imu.t[0])
    t, force, rate = seconds(columns.imu.t, start), columns.imu.specific_force, columns.imu.angular_rate
    speed = np.hypot(*columns.gnss.velocity[:, :2].T)
    fix = seconds(columns.gnss.t, start)
    good = np.isfinite(speed)
    if np.count_nonzero(good) < 5:
        return None
    block = blocks(t, 1.0)
    norm = np.linalg.norm(force, axis=1)
    quiet = spread(norm, block) < QUIET_FORCE
    for axis in range(3):
        quiet &= (spread(rate[:, axis], block) < QUIET_RATE) & (spread(force[:, axis], block) < QUIET_FORCE)
    count = np.bincount(block)
    middle = np.bincount(block, weights=t) / count
    # The GNSS may be late, so it must have been slow for a while on both sides, and must have spoken at all.
    for shift in (-1.5, 0.0, 1.5):
        quiet &= np.interp(middle + shift, fix[good], speed[good]) < STILL
    nearest = np.abs(fix[good][np.clip(np.searchsorted(fix[good], middle), 0, np.count_nonzero(good) - 1)] - middle)
    quiet &= (count >= 5) & (nearest < 2.0)
    if np.count_nonzero(quiet) < 5:
        return None
    ratio: Floats = np.bincount(block, weights=norm)[quiet] / count[quiet] / gravity - 1.0
    stretch = blocks(middle[quiet], 10.0)
    means = np.bincount(stretch, weights=ratio) / np.bincount(stretch)
    sigma = float(np.hypot(means.std(ddof=1) if len(means) > 1 else ratio.std(ddof=1), KNOWN))
    when = middle[quiet]
    first, last = (float(ratio[near].mean()) for near in (when < when[0] + 60.0, when > when[-1] - 60.0))
    return Scale(float(ratio.mean()), sigma, first, last, float(np.count_nonzero(quiet)))


def find_scale(columns: Columns, gravity: float) -> list[Finding]:
    """An accelerometer that is off by more than 0.5 % (and three standard errors) at rest."""
    scale = scale_at_rest(columns, gravity)
    if scale is None or abs(scale.value) > 0.25:  # beyond that it is a matter of units
        return []
    if abs(scale.value) < max(0.005, 3.0 * np.hypot(scale.sigma / np.sqrt(max(scale.span / 10.0, 1.0)), KNOWN)):
        return []
    percent, off = 100.0 * scale.value, scale.value * gravity
    return [
        Finding(
            "accelerometer", "scale", scale.value, scale.sigma, "", "warning" if abs(scale.value) > 0.04 else "note",
            f"accelerometer: |f| at rest is {abs(percent):.2f} +- {100.0 * scale.sigma:.2f} % "
            f"{'low' if percent < 0 else 'high'} "
            f"({scale.span:.0f} s; first minute {100.0 * scale.first:+.2f} %, last {100.0 * scale.last:+.2f} %; a "
            f"scale error, "
            f"or a bias of {off:+.3f} m/s2): errors grow with load factor; calibrate, or let the bias prior cover it",
        )
    ]  # fmt: skip
