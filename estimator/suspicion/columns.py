"""What is examined, and what is found: raw columns of sensors, findings, and the small statistics all checks share."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

Times = NDArray[np.int64]
Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

DEGREE = float(np.pi / 180.0)
BLOCK = 8.0
"""Length (s) of the stretches that count as independent when a sigma is made of their scatter."""


class Imu(NamedTuple):
    """Inertial sensors: t (k,) ns, specific force (k, 3) m/s2 and angular rate (k, 3) rad/s, body axes."""

    t: Times
    specific_force: Floats
    angular_rate: Floats


class Attitude(NamedTuple):
    """Attitude: t (k,) ns, phi, theta, psi (k,) rad; NaN where an angle is not measured."""

    t: Times
    phi: Floats
    theta: Floats
    psi: Floats


class Air(NamedTuple):
    """Airspeed: t (k,) ns, true airspeed (k,) m/s."""

    t: Times
    true_airspeed: Floats


class Flow(NamedTuple):
    """Vanes: t (k,) ns, alpha, beta (k,) rad."""

    t: Times
    alpha: Floats
    beta: Floats


class Altitude(NamedTuple):
    """Barometer: t (k,) ns, altitude (k,) m."""

    t: Times
    altitude: Floats


class Gnss(NamedTuple):
    """Satellite navigation: t (k,) ns, velocity (k, 3) m/s NED with NaN where a component is not reported, altitude
    (k,) m, satellites (k,), and, if the receiver states it, one sigma of the altitude (k,) m.
    """

    t: Times
    velocity: Floats
    altitude: Floats
    satellites: Times
    sigma_altitude: Floats | None = None


class Columns(NamedTuple):
    """The raw sensors of one vehicle over one stretch of time; None, or no rows, where there is no such sensor."""

    imu: Imu | None = None
    attitude: Attitude | None = None
    air: Air | None = None
    flow: Flow | None = None
    altitude: Altitude | None = None
    gnss: Gnss | None = None


Severity = Literal["note", "warning"]


class Finding(NamedTuple):
    """A defect of a sensor.

    Attributes
    ----------
    sensor : str
        "imu", "gyro", "accelerometer", "attitude", "airspeed", "vanes", "altimeter" or "gnss".
    defect : str
        "altitude", "axes", "delay", "frozen", "gap", "held", "irregular", "jump", "order", "saturated", "scale",
        "sign", "slow" or "units".
    value, sigma : float
        The number that shows it and its standard deviation; 0 where it was counted.
    unit : str
        Of both; empty for a ratio or a count.
    severity : str
        "note": the estimate bears it; "warning": it spoils the estimate or what is read from it.
    text : str
        One line for a report: sensor, number, consequence, way out.
    """

    sensor: str
    defect: str
    value: float
    sigma: float
    unit: str
    severity: Severity
    text: str


def ordered(columns: Columns) -> tuple[Columns, list[Finding]]:
    """Drop rows that are not later than all before them, and say how many; a sensor with fewer than two rows is None.

    Every check may then rely on strictly increasing times, and on an IMU without NaN.
    """
    out: list[Any] = []
    found = []
    for name, sensor in zip(NAMES, columns, strict=True):
        if sensor is None or len(sensor.t) < 2:
            out.append(None)
            continue
        keep = np.ones(len(sensor.t), np.bool_)
        keep[1:] = sensor.t[1:] > np.maximum.accumulate(sensor.t)[:-1]
        dropped = int(np.count_nonzero(~keep))
        if isinstance(sensor, Imu):
            keep &= np.isfinite(sensor.specific_force).all(axis=1) & np.isfinite(sensor.angular_rate).all(axis=1)
        if dropped:
            share = dropped / len(keep)
            found.append(
                Finding(
                    name, "order", float(dropped), 0.0, "", "warning" if share > 0.01 else "note",
                    f"{name}: {dropped} of {len(keep)} samples are not later than one before them and cannot be used; "
                    "look at the clock of the sender",
                )
            )  # fmt: skip
        sensor = _rows(sensor, keep)
        out.append(sensor if len(sensor.t) > 1 else None)
    return Columns(*out), found


def _rows(sensor: Any, keep: Flags) -> Any:
    return type(sensor)(*(None if column is None else column[keep] for column in sensor))


NAMES = ("imu", "attitude", "airspeed", "vanes", "altimeter", "gnss")
"""The sensors of `Columns` as findings call them."""


def seconds(t: Times, origin: int) -> Floats:
    """Times (s) since `origin` (ns)."""
    return np.asarray((t - origin) * 1e-9, np.float64)


def origin(columns: Columns) -> int:
    """First time of any sensor, ns."""
    return min((int(sensor.t[0]) for sensor in columns if sensor is not None), default=0)


def interpolate(at: Floats, t: Floats, values: Floats) -> Floats:
    """Values (k, c) at other times, linear between rows."""
    return np.stack([np.interp(at, t, column) for column in values.T], axis=1)


def mean_over(t: Floats, values: Floats, start: Floats, stop: Floats) -> Floats:
    """Means of values (k, c) over [start, stop]; a value holds for the interval that ends at its time."""
    total = np.zeros_like(values)
    np.cumsum(values[1:] * np.diff(t)[:, None], axis=0, out=total[1:])
    span = np.maximum(stop - start, 1e-9)[:, None]
    return np.asarray((interpolate(stop, t, total) - interpolate(start, t, total)) / span)


def blocks(t: Floats, length: float = BLOCK) -> Times:
    """Number of the stretch of `length` seconds that each time (k,) lies in, from 0 without holes."""
    return np.asarray(np.unique((t / length).astype(np.int64), return_inverse=True)[1], np.int64)


class Fit(NamedTuple):
    """Coefficients (c,) or (c, r) of a linear fit, and their standard deviations."""

    value: Floats
    sigma: Floats


def fit(x: Floats, y: Floats, block: Times) -> Fit | None:
    """Least squares y = x c with standard deviations from a jackknife over blocks; None without enough of them.

    Parameters
    ----------
    x : float array, shape (k, c)
    y : float array, shape (k, r)
    block : int64 array, shape (k,)
        Rows of one block may be as dependent as they like:
        var c = (B - 1) / B sum_b (c_{-b} - mean c_{-b})^2, c_{-b} without block b.

    Returns
    -------
    Fit or None
        None when fewer than four blocks remain or the columns of x are dependent.
    """
    good = np.isfinite(x).all(axis=1) & np.isfinite(y).all(axis=1)
    x, y, block = x[good], y[good], block[good]
    count = int(block.max()) + 1 if len(block) else 0
    if count < 4 or len(x) < 3 * x.shape[1]:
        return None
    normal, right = np.zeros((count, x.shape[1], x.shape[1])), np.zeros((count, x.shape[1], y.shape[1]))
    np.add.at(normal, block, x[:, :, None] * x[:, None, :])
    np.add.at(right, block, x[:, :, None] * y[:, None, :])
    filled = np.bincount(block, minlength=count) > 0
    normal, right = normal[filled], right[filled]
    count = len(normal)
    whole, data = normal.sum(axis=0), right.sum(axis=0)
    without = whole - normal
    # Units differ from column to column: judge dependence by correlations.
    root = np.sqrt(np.einsum("bii->bi", np.concatenate([whole[None], without])))
    if count < 4 or not (root > 0.0).all():
        return None
    scaled = np.concatenate([whole[None], without]) / (root[:, :, None] * root[:, None, :])
    if not (np.linalg.eigvalsh(scaled)[:, 0] > 1e-9).all():
        return None
    left_out = np.linalg.solve(without, data - right)
    spread = left_out - left_out.mean(axis=0)
    sigma = np.sqrt((count - 1) / count * (spread**2).sum(axis=0))
    return Fit(np.linalg.solve(whole, data), sigma)


def robust_fit(x: Floats, y: Floats, block: Times) -> Fit | None:
    """`fit`, and once more without the rows whose residual is beyond five robust standard deviations in any column."""
    first = fit(x, y, block)
    if first is None:
        return None
    rest = np.abs(y - x @ first.value)
    near = (rest <= np.maximum(5.0 * 1.4826 * np.nanmedian(rest, axis=0), 1e-12)).all(axis=1)
    return fit(x[near], y[near], block[near])


def flying(columns: Columns, start: int) -> Callable[[Floats], Flags]:
    """A function of time (s since `start`) that says where the aircraft flies, or at least moves fast.

    By GNSS: ground speed above 4 m/s and 0.3 of the speed it reaches for 5 % of the time; without GNSS by the same rule
    on airspeed; without either, where |f| or the rates of a second are not steady.
    """
    for t, speed in _speeds(columns, start):
        good = np.isfinite(speed)
        if np.count_nonzero(good) > 1:
            t, speed = t[good], speed[good]
            limit = max(4.0, 0.3 * float(np.percentile(speed, 95.0)))
            return lambda at: np.asarray(np.interp(at, t, speed, left=0.0, right=0.0) > limit)
    if columns.imu is None:
        return lambda at: np.zeros(len(at), np.bool_)
    t = seconds(columns.imu.t, start)
    block = blocks(t, 1.0)
    norm = np.linalg.norm(columns.imu.specific_force, axis=1)
    rate = np.linalg.norm(columns.imu.angular_rate, axis=1)
    restless = (spread(norm, block) > 0.3) | (spread(rate, block) > 0.03)
    middle = np.bincount(block, weights=t) / np.bincount(block)
    return lambda at: np.asarray(np.interp(at, middle, restless.astype(np.float64)) > 0.5)


def _speeds(columns: Columns, start: int) -> list[tuple[Floats, Floats]]:
    out = []
    if columns.gnss is not None:
        out.append((seconds(columns.gnss.t, start), np.hypot(*columns.gnss.velocity[:, :2].T)))
    if columns.air is not None:
        out.append((seconds(columns.air.t, start), columns.air.true_airspeed))
    return out


def spread(values: Floats, block: Times) -> Floats:
    """Standard deviation of values (k,) within each block."""
    count = np.maximum(np.bincount(block), 1)
    mean = np.bincount(block, weights=values) / count
    return np.asarray(np.sqrt(np.bincount(block, weights=(values - mean[block]) ** 2) / count))
