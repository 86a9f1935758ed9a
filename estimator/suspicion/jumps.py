"""GNSS beyond physics: velocity that no felt force explains, altitude that leaves the barometer."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from estimator.suspicion.columns import Columns, Finding, Floats, Times, seconds

MOST_FORCE = 60.0
"""Acceleration (m/s2) that is believed without an IMU."""
ALTITUDE_SIGMA = 7.5
"""Of a GNSS altitude (m) when the receiver states none."""


class Jumps(NamedTuple):
    """Times (s) of the fixes after a jump, and its size there (m/s or m), beyond what is allowed."""

    t: Floats
    size: Floats
    limit: Floats


def velocity_jumps(columns: Columns, start: int) -> Jumps:
    """Changes of the horizontal velocity between fixes that the specific force cannot make.

    Gravity has no horizontal part, so |dv_h| <= max |f| dt, with the largest |f| from 2 s before the fix (it may be
    late) to 1 s after it. Half as much again is allowed to receivers that filter and catch up, and six robust standard
    deviations of the noise (of second differences over sqrt 6), 1.5 m/s at least.
    """
    empty = Jumps(np.empty(0), np.empty(0), np.empty(0))
    if columns.gnss is None:
        return empty
    t, velocity = seconds(columns.gnss.t, start), columns.gnss.velocity[:, :2]
    good = np.isfinite(velocity).all(axis=1)
    t, velocity = t[good], velocity[good]
    if len(t) < 20:
        return empty
    change = np.linalg.norm(np.diff(velocity, axis=0), axis=1)
    bend = np.diff(velocity, n=2, axis=0)
    noise = 1.4826 * float(np.median(np.abs(bend))) / np.sqrt(6.0)
    limit = 1.5 * _largest_force(columns, start, t[1:]) * np.diff(t) + max(6.0 * noise, 1.5)
    beyond = change > limit
    return Jumps(t[1:][beyond], change[beyond], limit[beyond])


def _largest_force(columns: Columns, start: int, at: Floats) -> Floats:
    """Largest |f| around each time, m/s2, by whole seconds."""
    if columns.imu is None:
        return np.full(len(at), MOST_FORCE)
    t = seconds(columns.imu.t, start)
    norm = np.linalg.norm(columns.imu.specific_force, axis=1)
    second = (t - t[0]).astype(np.int64)
    most = np.zeros(int(second[-1]) + 1)
    np.maximum.at(most, second, norm)
    here = np.floor(at - t[0]).astype(np.int64)
    around = [most[np.clip(here + shift, 0, len(most) - 1)] for shift in (-2, -1, 0, 1)]
    # A second without samples may have held anything.
    return np.where(np.min(around, axis=0) > 0.0, np.max(around, axis=0), MOST_FORCE)


def altitude_jumps(columns: Columns, start: int) -> Jumps:
    """Changes of GNSS less barometric altitude between fixes, beyond ten robust standard deviations and 5 m."""
    t, off = _off(columns, start)
    if len(t) < 20:
        return Jumps(np.empty(0), np.empty(0), np.empty(0))
    change = np.abs(np.diff(off))
    limit = np.full(len(change), max(5.0, 14.826 * float(np.median(change))))
    beyond = change > limit
    return Jumps(t[1:][beyond], change[beyond], limit[beyond])


def _off(columns: Columns, start: int) -> tuple[Floats, Floats]:
    """GNSS less barometric altitude at the fixes inside the barometer's record."""
    if columns.gnss is None or columns.altitude is None:
        return np.empty(0), np.empty(0)
    t, heard = seconds(columns.gnss.t, start), seconds(columns.altitude.t, start)
    level = np.isfinite(columns.altitude.altitude)
    good = np.isfinite(columns.gnss.altitude) & (t >= heard[0]) & (t <= heard[-1])
    if np.count_nonzero(level) < 2:
        return np.empty(0), np.empty(0)
    t = t[good]
    return t, columns.gnss.altitude[good] - np.interp(t, heard[level], columns.altitude.altitude[level])


def find_jumps(columns: Columns, start: int) -> list[Finding]:
    """Jumps of GNSS velocity and altitude, and an altitude that wanders off the barometer."""
    found = []
    for quantity, unit, jumps in (
        ("velocity", "m/s", velocity_jumps(columns, start)),
        ("altitude", "m", altitude_jumps(columns, start)),
    ):
        if len(jumps.t):
            worst = int((jumps.size / jumps.limit).argmax())
            why = "the felt force" if quantity == "velocity" else "noise beside the barometer"
            found.append(
                Finding(
                    "gnss", "jump", float(jumps.size[worst]), float(jumps.limit[worst]) / 6.0, unit,
                    "warning" if quantity == "velocity" else "note",
                    f"gnss: {quantity} jumps {len(jumps.t)} times, most by {jumps.size[worst]:.1f} {unit} at "
                    f"{jumps.t[worst]:.1f} s where {why} allows {jumps.limit[worst]:.1f} {unit}: the gate must refuse "
                    "these fixes; look for multipath or a receiver that changes its solution",
                )
            )  # fmt: skip
    return found + _find_drift(columns, start)


def _find_drift(columns: Columns, start: int) -> list[Finding]:
    """GNSS altitude that wanders from the barometer by much more than its own sigma."""
    t, off = _off(columns, start)
    if len(t) < 100 or columns.gnss is None or np.ptp(t) < 60.0:
        return []
    stated = columns.gnss.sigma_altitude
    sigma = ALTITUDE_SIGMA if stated is None else float(np.nanmedian(stated))
    off = off - np.median(off)
    second: Times = (t - t[0]).astype(np.int64)
    means = np.bincount(second, weights=off) / np.maximum(np.bincount(second), 1)
    rms = float(np.sqrt(np.mean(means**2)))
    # Such errors live for half a minute: so many independent ones make up the rms.
    independent = max(np.ptp(t) / 30.0, 3.0)
    if not rms > sigma * np.sqrt(1.0 + 4.0 * np.sqrt(2.0 / independent)):
        return []
    return [
        Finding(
            "gnss", "altitude", rms, sigma, "m", "note",
            f"gnss: altitude wanders from the barometer by {off.min():+.0f} to {off.max():+.0f} m about its median "
            f"(rms "
            f"{rms:.1f} m where its own sigma is {sigma:.1f} m): one of the two is off by that; rely on the barometer "
            f"for "
            "height changes, or raise the sigma of the GNSS altitude",
        )
    ]  # fmt: skip
