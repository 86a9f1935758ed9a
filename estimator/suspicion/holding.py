"""Values that do not move when they should: held samples, frozen sensors, sensors at the end of their range."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from estimator.suspicion.columns import Columns, Finding, Flags, Floats, Times, seconds

GROUP = 200
"""Samples whose own step and resolution are compared."""
COARSE = 8.0
"""Steps of a group must be this many times its resolution before a repetition means anything."""


class Held(NamedTuple):
    """Share of samples that repeat the one before, beyond chance; its standard deviation; samples looked at."""

    share: float
    sigma: float
    samples: int


class Run(NamedTuple):
    """A run of one value: its time span (s), samples, the value, and how long such runs usually are (s)."""

    start: float
    stop: float
    samples: int
    value: float
    usual: float


def held(values: Floats, use: Flags) -> Held | None:
    """How often a sample repeats the one before although the quantity moves.

    Parameters
    ----------
    values : float array, shape (k, c)
        A sample is repeated when all its components are.
    use : bool array, shape (k,)
        Samples that count (in flight, not frozen).

    Returns
    -------
    Held or None
        None where the resolution is too coarse to tell: with a resolution q and steps of median size s (both of the
        group of samples, of the steps that are not zero) normal steps round to zero with the probability 0.27 q / s,
        c, so the share h of those that repeat is (share seen - c) / (1 - c); groups with s < 8 q are left out.
    """
    step = np.abs(np.diff(values, axis=0))
    good = use[1:] & use[:-1] & np.isfinite(step).all(axis=1)
    step = step[good]
    size = min(GROUP, max(40, len(step) // 4))
    groups = len(step) // size
    if groups < 2:
        return None
    step = step[: groups * size].reshape(groups, size, -1)
    repeated = (step == 0.0).all(axis=2)
    count = np.count_nonzero(step > 0.0, axis=1)
    few = count < 20  # a component that rests says nothing
    moved = np.sort(np.where(step > 0.0, step, np.inf), axis=1)
    resolution, usual = moved[:, 0], np.take_along_axis(moved, count[:, None] // 2, axis=1)[:, 0]
    with np.errstate(invalid="ignore"):
        fine = np.where(few, np.inf, resolution / usual).min(axis=1)
    telling = fine * COARSE <= 1.0
    if np.count_nonzero(telling) < 2:
        return None
    shares = repeated[telling].mean(axis=1)
    sigma = float(shares.std(ddof=1) / np.sqrt(len(shares)))
    chance = float(0.27 * fine[telling].mean())
    return Held((float(shares.mean()) - chance) / (1.0 - chance), sigma / (1.0 - chance), int(len(shares) * size))


def longest_run(t: Floats, values: Floats) -> Run | None:
    """The longest run of one value (k,) by time; NaN interrupts it. None when no value is repeated."""
    same = np.concatenate([[False], values[1:] == values[:-1], [False]])
    begin, end = np.flatnonzero(~same[:-1] & same[1:]), np.flatnonzero(same[:-1] & ~same[1:])
    if not len(begin):
        return None
    lasts = t[end] - t[begin]
    longest = int(lasts.argmax())
    # A sample that is not repeated is a run that lasts no time.
    single = len(values) - int(np.sum(end - begin + 1))
    others = np.concatenate([np.delete(lasts, longest), np.zeros(single)])
    usual = float(np.percentile(others, 99.0)) if len(others) else 0.0
    a, b = begin[longest], end[longest]
    return Run(float(t[a]), float(t[b]), int(b - a + 1), float(values[a]), usual)


def frozen(t: Floats, values: Floats, flies: Callable[[Floats], Flags], noisy: bool) -> Run | None:
    """A run of one value that neither noise nor motion of the sensor (k,) explains.

    It lasts 2 s, 25 samples, and ten times what 99 % of the runs of this sensor do, mostly in flight; or it is the
    whole record of a sensor that, like every inertial one, shows noise at rest too (``noisy``).
    """
    good = np.isfinite(values)
    if np.count_nonzero(good) < 25:
        return None
    run = longest_run(t, values)
    if run is None or run.samples < 25:
        return None
    if run.samples == np.count_nonzero(good) and noisy:
        return run
    if run.stop - run.start < max(2.0, 10.0 * run.usual):
        return None
    if noisy and run.value in (float(np.nanmax(values)), float(np.nanmin(values))):
        return None  # the end of its range: `saturated`
    inside = t[(t >= run.start) & (t <= run.stop)]
    return run if float(np.mean(flies(inside))) > 0.8 else None


def saturated(values: Floats) -> tuple[int, float, int]:
    """Samples (k,) at the end of the range, that value, and the number of runs of it.

    The end of the range is an extreme value that is met in runs of at least three samples, entered and left by steps
    larger than the resolution: a signal that merely turns round there would be seen to slow down.
    """
    good = values[np.isfinite(values)]
    if len(good) < 100:
        return 0, 0.0, 0
    steps = np.abs(np.diff(good))
    moving = steps[steps > 0.0]
    if not len(moving):
        return 0, 0.0, 0
    resolution, total, worst, runs = float(moving.min()), 0, 0.0, 0
    middle = float(np.median(good))
    scale = 1.4826 * float(np.median(np.abs(good - middle)))
    for end in (float(good.max()), float(good.min())):
        at = np.concatenate([[False], good == end, [False]])
        begin, stop = np.flatnonzero(~at[:-1] & at[1:]), np.flatnonzero(at[:-1] & ~at[1:])
        long = (stop - begin >= 3) & (begin > 0) & (stop < len(good))
        begin, stop = begin[long], stop[long]
        if not len(begin) or abs(end - middle) < 4.0 * scale:
            continue
        edge = np.concatenate([steps[begin - 1], steps[stop - 1]])
        if float(np.median(edge)) > 5.0 * resolution:
            total, runs, worst = total + int(np.sum(stop - begin)), runs + len(begin), end
    return total, worst, runs


def find_held(columns: Columns, start: int, flies: Callable[[Floats], Flags]) -> list[Finding]:
    """Frozen and held sensors."""
    found: list[Finding] = []
    for sensor, t, parts in _streams(columns):
        when = seconds(t, start)
        use = np.asarray(flies(when))
        stuck = False
        for name, values in parts.items():
            run = frozen(when, values, flies, sensor in ("gyro", "accelerometer"))
            if run is not None:
                found.append(_frozen(sensor, name, run))
                use &= (when < run.start) | (when > run.stop)
                stuck = stuck or run.samples > 0.5 * len(when)
        if stuck:
            continue
        share = held(np.stack(list(parts.values()), axis=1), use)
        if share is not None and share.share > max(0.02, 3.0 * share.sigma):
            found.append(_held(sensor, share))
    return found


def _frozen(sensor: str, name: str, run: Run) -> Finding:
    value = run.value
    return Finding(
        sensor, "frozen", run.stop - run.start, 0.0, "s", "warning",
        f"{sensor}: {name} stands at {value:.6g} for {run.stop - run.start:.1f} s from {run.start:.1f} s on "
        f"({run.samples} samples) while the aircraft moves: it is taken for a measurement; leave it out or repair it",
    )  # fmt: skip


def _held(sensor: str, found: Held) -> Finding:
    percent, sigma = 100.0 * found.share, 100.0 * found.sigma
    return Finding(
        sensor, "held", found.share, found.sigma, "", "warning" if found.share > 0.25 else "note",
        f"{sensor}: {percent:.1f} +- {sigma:.1f} % of {found.samples} samples in flight repeat the one before: old "
        f"values "
        f"with new times, so error bars are too small; drop repeats or raise its sigma by "
        f"{1.0 / np.sqrt(max(1.0 - found.share, 0.01)):.2f}",
    )  # fmt: skip


def _streams(columns: Columns) -> list[tuple[str, Times, dict[str, Floats]]]:
    """Sensor, times, and its components by name; components that are never measured are left out."""
    streams: list[tuple[str, Times, dict[str, Floats]]] = []
    if columns.imu is not None:
        t, force, rate = columns.imu
        streams.append(("accelerometer", t, {axis: force[:, i] for i, axis in enumerate(("f_x", "f_y", "f_z"))}))
        streams.append(("gyro", t, {axis: rate[:, i] for i, axis in enumerate("pqr")}))
    for sensor, data, names in (
        ("attitude", columns.attitude, ("phi", "theta", "psi")),
        ("airspeed", columns.air, ("true_airspeed",)),
        ("vanes", columns.flow, ("alpha", "beta")),
        ("altimeter", columns.altitude, ("altitude",)),
    ):
        if data is not None:
            streams.append((sensor, data.t, {name: getattr(data, name) for name in names}))
    if columns.gnss is not None:
        velocity = columns.gnss.velocity
        parts = {name: velocity[:, i] for i, name in enumerate(("north velocity", "east velocity"))}
        streams.append(("gnss", columns.gnss.t, parts))
    out = []
    for sensor, t, parts in streams:
        measured = {name: values for name, values in parts.items() if np.isfinite(values).any()}
        if measured:
            out.append((sensor, t, measured))
    return out


def find_saturated(columns: Columns) -> list[Finding]:
    """Gyros and accelerometers at the end of their range."""
    if columns.imu is None:
        return []
    found = []
    axes = ("f_x", "f_y", "f_z", "p", "q", "r")
    for i, name in enumerate(axes):
        values = (columns.imu.specific_force, columns.imu.angular_rate)[i // 3][:, i % 3]
        samples, end, runs = saturated(values)
        if samples:
            sensor, unit = ("accelerometer", "m/s2") if i < 3 else ("gyro", "rad/s")
            found.append(
                Finding(
                    sensor, "saturated", end, 0.0, unit, "warning",
                    f"{sensor}: {name} stops at {end:.4g} {unit} ({samples} samples in {runs} runs): what it missed "
                    f"is lost "
                    "to velocity and attitude; distrust these stretches, fly a wider range",
                )
            )  # fmt: skip
    return found
