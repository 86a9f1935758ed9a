"""What lost samples cost: the standard deviations of a window with and without them.

Covariances depend on times and noise, hardly on values. So the window is filtered and smoothed alone twice: as it was
flown, and with every sample that was due and did not come put in, a value between its neighbours.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from estimator.extended import REJECTED, Drive, Told
from estimator.kinematics import ATTITUDE, HEIGHT, VELOCITY, M
from estimator.models.flight_path import PARAMETERS
from estimator.stage.examining import absent
from estimator.stage.rows import AIR, ALTITUDE, FLOW, GNSS, INERTIAL
from estimator.stage.rows import ATTITUDE as ANGLES
from estimator.stretch import Smoothed

if TYPE_CHECKING:
    from estimator.stage.estimators import Path
    from estimator.stage.passage import Closed, Passage

Floats = NDArray[np.float64]
Times = NDArray[np.int64]

LOST = 0.01  # share of lost samples from which on their price is told
NAMES = ("h", "u", "v", "w", "theta", "phi", "psi")
CHANNELS = {
    AIR: (0,), FLOW: (1, 2), ANGLES: tuple(range(ATTITUDE, HEIGHT)), ALTITUDE: (HEIGHT,),
    GNSS: tuple(range(VELOCITY, M)),
}  # fmt: skip


def alone(passage: Passage, window: Closed, smoothed: Smoothed) -> tuple[Path, Drive, Told]:
    """A stretch that begins where a window did, knowing nothing but the priors, and what drives it through the window.

    Begun where the smoothed path passes; what the gate decided on the way stays decided.
    """
    drive, told = passage.stretch.cut(window.first, window.stop)
    drive = drive._replace(z=np.where(told.status == REJECTED, np.nan, drive.z), r=told.r)
    flight = passage.flight
    values = {
        name: float(value)
        for name, value in zip(flight.names, smoothed.mean[window.first], strict=True)
        if name not in PARAMETERS
    }
    return passage.estimator.begin(flight, values, gated=False), drive, told


def loss_effect(
    passage: Passage, window: Closed, smoothed: Smoothed, due: dict[int, tuple[Times, int]]
) -> dict[str, float]:
    """By what factor the lost samples raised the standard deviations of a window; empty where that cannot be said.

    Parameters
    ----------
    due : dict
        Times of the samples of each sensor, and its usual interval, ns (`Examiner.due`).
    """
    stretch, drive, _ = alone(passage, window, smoothed)
    every, _, _ = alone(passage, window, smoothed)
    ends = window.begin + np.rint(1e9 * np.cumsum(drive.dt)).astype(np.int64)
    try:
        stretch.advance(drive)
        every.advance(_complete(passage, drive, ends, due))
        flown, whole = stretch.smooth().std, every.smooth().std
    except ArithmeticError:
        return {}
    effect = {}
    for i, name in enumerate(passage.flight.names):
        if name in NAMES:
            effect[name] = round(float(np.nanmedian(flown[:, i]) / np.nanmedian(whole[:, i])), 3)
    return effect


def _complete(passage: Passage, drive: Drive, ends: Times, due: dict[int, tuple[Times, int]]) -> Drive:
    """The same steps as if nothing had been lost."""
    settings, period = passage.flight.settings, passage.driver.period
    z, r, q = drive.z.copy(), drive.r.copy(), drive.q.copy()
    if INERTIAL in due:
        sample = np.repeat([settings.accelerometer**2, settings.gyro**2], 3)
        long = q[:, 0] * drive.dt > 3.0 * settings.accelerometer**2 * period  # held or interpolated
        q[long, :6] = sample * (period / np.maximum(drive.dt[long], 1e-9))[:, None]
    for sensor, channels in CHANNELS.items():
        if sensor not in due:
            continue
        t, usual = due[sensor]
        missing = absent(t, usual, int(ends[0]), int(ends[-1]))
        at = np.clip(np.searchsorted(ends, missing), 0, len(ends) - 1)
        for channel in channels:
            known = np.flatnonzero(~np.isnan(drive.z[:, channel]))
            if len(known):
                new = np.unique(at[np.isnan(drive.z[at, channel])])
                values = drive.z[known, channel]
                values = np.unwrap(values) if 0 < channel < HEIGHT else values
                z[new, channel] = np.interp(ends[new], ends[known], values)
                r[new, channel] = float(np.median(drive.r[known, channel]))
    return drive._replace(z=z, r=r, q=q, bridged=np.zeros_like(drive.bridged))
