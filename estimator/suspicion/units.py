"""Wrong units, by the ratio to another sensor that knows the quantity too."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from estimator.suspicion.columns import (
    DEGREE,
    Air,
    Altitude,
    Attitude,
    Columns,
    Finding,
    Flags,
    Floats,
    Flow,
    Gnss,
    Imu,
    blocks,
    fit,
    seconds,
)

SPEEDS = {"knots": 1.943844, "km/h": 3.6, "miles per hour": 2.236936, "feet per second": 3.28084, "cm/s": 100.0}
LENGTHS = {"feet": 3.28084, "cm": 100.0, "mm": 1000.0, "km": 0.001}
FORCES = {"g": 1.0 / 9.80665, "mg": 1000.0 / 9.80665, "feet per second squared": 3.28084}
NEAR = 0.12
"""How far the logarithm of a ratio may be from that of a unit."""


class Ratio(NamedTuple):
    """What a sensor says over what it should say, and its standard deviation."""

    value: float
    sigma: float


def unit(ratio: Ratio, units: dict[str, float]) -> str | None:
    """Name of the unit that explains a ratio, if one does and SI does not.

    A scale error of a few percent comes on top: of several units that are near, the first, most usual one is named.
    """
    if not (ratio.value > 0.0 and abs(np.log(ratio.value)) > 2.0 * NEAR + 4.0 * ratio.sigma / ratio.value):
        return None
    limit = NEAR + 2.0 * ratio.sigma / ratio.value
    return next((name for name, factor in units.items() if abs(np.log(ratio.value / factor)) < limit), None)


def _means(t: Floats, values: Floats, bins: int) -> Floats:
    """Means over whole seconds (bins,), NaN where there is nothing."""
    good = np.isfinite(values) & (t >= 0.0)
    second = t[good].astype(np.int64)
    inside = second < bins
    second = second[inside]
    count = np.bincount(second, minlength=bins)
    total = np.bincount(second, weights=values[good][inside], minlength=bins)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def airspeed_ratio(columns: Columns, start: int) -> Ratio | None:
    """Airspeed over the speed through the air that ground velocity and one steady wind allow.

    V = k |v - w| over means of a second, by Gauss-Newton in k and w from the circle that fits v best (Kasa). Wind and
    factor come apart only by turning: the standard deviation (jackknife over stretches) says whether they did. Vertical
    speed is neglected: k is high by half of its square over V squared.
    """
    if columns.air is None or columns.gnss is None:
        return None
    fix, t = seconds(columns.gnss.t, start), seconds(columns.air.t, start)
    bins = int(min(fix[-1], t[-1])) + 1
    airspeed = _means(t, columns.air.true_airspeed, bins)
    north, east = (_means(fix, columns.gnss.velocity[:, i], bins) for i in range(2))
    ground = np.hypot(north, east)
    good = np.isfinite(airspeed) & np.isfinite(ground)
    if np.count_nonzero(good) < 30:
        return None
    good &= (ground > max(4.0, 0.3 * float(np.percentile(ground[good], 95.0)))) & (airspeed > 0.0)
    block = blocks(np.flatnonzero(good).astype(np.float64))
    v, airspeed = np.stack([north, east], axis=1)[good], airspeed[good]
    circle = fit(np.column_stack([2.0 * v, np.ones(len(v))]), (v**2).sum(axis=1)[:, None], block)
    if circle is None:
        return None
    wind = circle.value[:2, 0]
    factor = float(np.median(airspeed) / np.median(np.linalg.norm(v - wind, axis=1)))
    found = None
    for _ in range(10):
        relative = v - wind
        speed = np.maximum(np.linalg.norm(relative, axis=1), 1e-3)
        x = np.column_stack([speed, -factor * relative / speed[:, None]])
        found = fit(x, (airspeed - factor * speed)[:, None], block)
        if found is None:
            return None
        factor, wind = factor + float(found.value[0, 0]), wind + found.value[1:, 0]
        if not 1e-4 < factor < 1e4:
            return None
    # A wind as fast as the aircraft itself is no solution.
    if found is None or not float(np.hypot(*wind)) < 0.9 * float(np.median(airspeed)) / factor:
        return None
    sigma = float(found.sigma[0, 0])
    return Ratio(factor, sigma) if sigma < 0.2 * factor else None


def altitude_ratio(columns: Columns, start: int) -> Ratio | None:
    """Changes of barometric over those of GNSS altitude, over means of two seconds.

    Least squares of the GNSS altitude, the noisier one, on the barometric; the jackknife over stretches knows of the
    slow errors of GNSS.
    """
    if columns.altitude is None or columns.gnss is None:
        return None
    t, fix = seconds(columns.altitude.t, start), seconds(columns.gnss.t, start)
    bins = int(min(fix[-1], t[-1])) + 1
    low, high = _means(t, columns.altitude.altitude, bins), _means(fix, columns.gnss.altitude, bins)
    good = np.isfinite(low) & np.isfinite(high)
    if np.count_nonzero(good) < 30:
        return None
    when = np.flatnonzero(good).astype(np.float64)
    low, high = low[good] - low[good].mean(), high[good] - high[good].mean()
    # The larger of the two must have climbed well beyond a GNSS error.
    if max(np.ptp(low), np.ptp(high)) < 40.0:
        return None
    found = fit(np.stack([low, np.ones(len(low))], axis=1), high[:, None], blocks(when, 20.0))
    if found is None or not found.value[0, 0] > 0.0:
        return None
    value = float(1.0 / found.value[0, 0])
    sigma = value * float(found.sigma[0, 0] / found.value[0, 0])
    return Ratio(value, sigma) if sigma < 0.15 * value else None


def force_ratio(columns: Columns, gravity: float) -> Ratio | None:
    """Median of |f| over gravity: 1 at rest and in level flight, seldom above 2 over a flight."""
    if columns.imu is None or len(columns.imu.t) < 50:
        return None
    norm = np.linalg.norm(columns.imu.specific_force, axis=1)
    middle = float(np.median(norm)) / gravity
    return Ratio(middle, 1.4826 * float(np.median(np.abs(norm / gravity - middle))) / np.sqrt(len(norm) / 50.0))


def _told(sensor: str, ratio: Ratio, name: str, of: str) -> Finding:
    return Finding(
        sensor, "units", ratio.value, ratio.sigma, "", "warning",
        f"{sensor}: {ratio.value:.4g} +- {ratio.sigma:.2g} times {of}: it is in {name}, not in SI units; convert it "
        f"before "
        "it is used",
    )  # fmt: skip


def find_units(columns: Columns, start: int, gravity: float) -> tuple[Columns, list[Finding]]:
    """Wrong units of airspeed, altitude, accelerometer, attitude and vanes; and the columns with these repaired.

    Gyros are compared with the attitude in `axes`.
    """
    found = []
    imu, attitude, air, flow, altitude, gnss = columns
    force = force_ratio(columns, gravity)
    # Flying does not take the median of |f| out of (0.4, 2.7); metres per second squared need no finer judgement.
    if imu is not None and force is not None and not (0.4 < force.value < 2.7):
        off = {name: abs(np.log(force.value / factor)) for name, factor in FORCES.items()}
        name = min(off, key=lambda name: off[name])
        if off[name] < 0.7:
            found.append(_told("accelerometer", force, name, "gravity (median of |f|)"))
            imu = Imu(imu.t, imu.specific_force / FORCES[name], imu.angular_rate)
    if attitude is not None:
        attitude, told = _attitude(attitude)
        found += told
    if flow is not None:
        flow, told = _flow(flow, columns, start)
        found += told
    ratio = altitude_ratio(columns, start)
    if ratio is not None and altitude is not None and gnss is not None:
        name_of_other = unit(Ratio(1.0 / ratio.value, ratio.sigma / ratio.value**2), LENGTHS)
        name_of_own = unit(ratio, LENGTHS)
        if name_of_own is not None and name_of_own != "km":
            found.append(_told("altimeter", ratio, name_of_own, "the changes of GNSS altitude"))
            altitude = Altitude(altitude.t, altitude.altitude / LENGTHS[name_of_own])
        elif name_of_other is not None and name_of_other != "km":
            inverse = Ratio(1.0 / ratio.value, ratio.sigma / ratio.value**2)
            found.append(_told("gnss", inverse, name_of_other, "the changes of barometric altitude"))
            gnss = Gnss(gnss.t, gnss.velocity, gnss.altitude / LENGTHS[name_of_other], *gnss[3:])
    ratio = airspeed_ratio(columns, start)
    if ratio is not None and air is not None:
        name_or_none = unit(ratio, SPEEDS)
        if name_or_none is not None:
            found.append(
                _told("airspeed", ratio, name_or_none, "the speed that ground velocity and a steady wind allow")
            )
            air = Air(air.t, air.true_airspeed / SPEEDS[name_or_none])
        elif abs(np.log(ratio.value)) > 0.25 + 4.0 * ratio.sigma / ratio.value:
            found.append(
                Finding(
                    "airspeed", "scale", ratio.value, ratio.sigma, "", "warning",
                    f"airspeed: {ratio.value:.3g} +- {ratio.sigma:.2g} times the speed that ground velocity and a "
                    f"steady "
                    "wind allow, and no unit explains it: the estimate of wind and scale will be wrong; look at the "
                    "pitot system, or at calibrated against true airspeed",
                )
            )  # fmt: skip
    return Columns(imu, attitude, air, flow, altitude, gnss), found


def _attitude(attitude: Attitude) -> tuple[Attitude, list[Finding]]:
    """Angles beyond what Euler angles in radians can be are degrees."""
    largest = {
        name: float(np.nanmax(np.abs(angle), initial=0.0))
        for name, angle in zip(("phi", "theta", "psi"), attitude[1:], strict=True)
    }
    # 1 % of slack for angles that are not wrapped at exactly pi.
    beyond = {name: largest[name] / limit for name, limit in (("phi", np.pi), ("theta", np.pi / 2), ("psi", 2 * np.pi))}
    name = max(beyond, key=lambda name: beyond[name])
    if not beyond[name] > 1.01:
        return attitude, []
    degrees = [angle * DEGREE for angle in attitude[1:]]
    text = (
        f"attitude: {name} reaches {largest[name]:.4g}, {beyond[name]:.3g} times what an angle in radians can: it is "
        f"in "
        "degrees; convert it before it is used"
    )
    return Attitude(attitude.t, *degrees), [Finding("attitude", "units", largest[name], 0.0, "rad", "warning", text)]


def _flow(flow: Flow, columns: Columns, start: int) -> tuple[Flow, list[Finding]]:
    """Flow angles are small in flight: a 90 % quantile above 0.9 (52 deg, if radians) means degrees."""
    fast: Flags = np.ones(len(flow.t), np.bool_)
    if columns.gnss is not None:
        t, fix = seconds(flow.t, start), seconds(columns.gnss.t, start)
        speed = np.hypot(*columns.gnss.velocity[:, :2].T)
        good = np.isfinite(speed)
        if np.count_nonzero(good) > 1:
            fast = np.interp(t, fix[good], speed[good]) > max(5.0, 0.5 * float(np.percentile(speed[good], 95.0)))
    sizes = {
        name: np.abs(angle[fast & np.isfinite(angle)]) for name, angle in (("alpha", flow.alpha), ("beta", flow.beta))
    }
    large = {name: float(np.percentile(size, 90.0)) for name, size in sizes.items() if len(size) > 50}
    if not large or max(large.values()) < 0.9:
        return flow, []
    name = max(large, key=lambda name: large[name])
    text = (
        f"vanes: {name} exceeds {large[name]:.3g} for a tenth of the flight, which no flight does in radians: it is in "
        "degrees; convert it before it is used"
    )
    return Flow(flow.t, flow.alpha * DEGREE, flow.beta * DEGREE), [
        Finding("vanes", "units", large[name], 0.0, "rad", "warning", text)
    ]
