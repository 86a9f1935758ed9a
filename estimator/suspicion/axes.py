"""Gyro and accelerometer: units, exchanged axes and wrong signs, by the attitude, by gravity and by GNSS.

The attitude has been judged by the GNSS before (`attitude`). The gyro is judged by it, the accelerometer by both; each
step uses the sensors as the step before repaired them, so that one fault makes one finding.
"""

from __future__ import annotations

import numpy as np

from estimator.suspicion.attitude import SURE, attitude_rates, complete, rotations
from estimator.suspicion.columns import (
    Columns,
    Finding,
    Fit,
    Imu,
    blocks,
    flying,
    interpolate,
    mean_over,
    robust_fit,
    seconds,
)
from estimator.suspicion.delay import gnss_delay
from estimator.suspicion.turns import misfit, named, nearest_turn


def gyro_by_attitude(columns: Columns, start: int) -> Fit | None:
    """M of omega_attitude = M omega_gyro + b, (3, 3), over intervals of 0.2 s; None without both.

    The gyro, with less noise than differences of angles, stands on the right: noise there would flatten the slopes. M
    is the identity for good sensors, 1/57.3 of it for a gyro in deg/s.
    """
    if columns.imu is None or columns.attitude is None:
        return None
    attitude = complete(columns.attitude)
    if attitude is None:
        return None
    rate, begin, end = attitude_rates(attitude, start)
    t = seconds(columns.imu.t, start)
    inside = (begin >= t[0]) & (end <= t[-1]) & (end - begin < 1.0) & (end > begin)
    rate, begin, end = rate[inside], begin[inside], end[inside]
    if len(rate) < 50:
        return None
    gyro = mean_over(t, columns.imu.angular_rate, begin, end)
    found = robust_fit(np.column_stack([gyro, np.ones(len(gyro))]), rate, blocks(end))
    return None if found is None else Fit(found.value[:3].T, found.sigma[:3].T)


def find_gyro(columns: Columns, start: int, gravity: float) -> tuple[Columns, list[Finding]]:
    """A gyro (or attitude) in degrees, and gyro axes that are exchanged or reversed."""
    fitted = gyro_by_attitude(columns, start)
    imu = columns.imu
    if fitted is None or imu is None:
        return columns, []
    found = []
    # Every row and column that was excited has one entry of the size of the ratio of units.
    ratio = np.abs(fitted.value)
    telling = ratio > SURE * fitted.sigma
    if not telling.any():
        return columns, []
    at = int(np.argmax(np.where(telling, ratio / np.maximum(fitted.sigma, 1e-12), 0.0)))
    scale = 1.0 / float(ratio.flat[at])  # of the gyro, over the attitude
    sigma = scale**2 * float(fitted.sigma.flat[at])
    degrees = 180.0 / np.pi
    if abs(np.log(scale / degrees)) < 0.5:
        found.append(
            Finding(
                "gyro", "units", scale, sigma, "", "warning",
                f"gyro: {scale:.3g} +- {sigma:.2g} times the rates of the attitude: it is in deg/s; convert it to "
                f"rad/s",
            )
        )  # fmt: skip
        imu = imu._replace(angular_rate=imu.angular_rate / degrees)
        fitted = Fit(fitted.value * degrees, fitted.sigma * degrees)
    elif abs(np.log(scale * degrees)) < 0.5:
        found.append(
            Finding(
                "attitude", "units", 1.0 / scale, sigma / scale**2, "", "warning",
                f"attitude: its rates are {1.0 / scale:.3g} +- {sigma / scale**2:.2g} times those of the gyro: its "
                f"angles "
                "are in degrees; convert them to rad",
            )
        )  # fmt: skip
        return columns, found
    elif abs(np.log(scale)) > 0.7:
        return columns, []
    repaired = columns._replace(imu=imu)
    turn = nearest_turn(fitted)
    angle = _reversed_angle(repaired, start, fitted, np.inf if turn is None else misfit(fitted, turn))
    if angle is not None:
        name, value, error = angle
        found.append(
            Finding(
                "attitude", "sign", value, error, "", "warning",
                f"attitude: its rates fit the gyro only with {name} reversed (slope {value:.2f} +- {error:.2f}): it "
                f"has the wrong "
                "sign; correct the source",
            )
        )  # fmt: skip
        attitude = columns.attitude
        assert attitude is not None
        return repaired._replace(attitude=attitude._replace(**{name: -getattr(attitude, name)})), found
    if turn is None:
        return repaired, found
    defect, words = named(turn, ("p", "q", "r"))
    i = next(i for i in range(3) if turn.order[i] != i or turn.sign[i] < 0)
    value, error = float(fitted.value[i, turn.order[i]]), float(fitted.sigma[i, turn.order[i]])
    turned = repaired._replace(imu=imu._replace(angular_rate=imu.angular_rate @ turn.matrix.T))
    # Gyro and attitude only contradict each other; accelerometer and GNSS know which of them is wrong, unless the whole
    # IMU is turned over: its parts then agree.
    upright = float(np.median(imu.specific_force[:, 2])) < -0.5 * gravity
    before, after = (gnss_delay(c, gravity) if upright else None for c in (repaired, turned))
    gain = 1.0 if before is None or after is None else before.residual / after.residual
    if gain < 0.7:
        found.append(
            Finding(
                "attitude", defect, value, error, "", "warning",
                f"attitude: against the rates of the gyro, which fit accelerometer and GNSS, {words} (axes p, q, r of "
                f"its rates; "
                f"slope {value:.2f} +- {error:.2f}): correct the source",
            )
        )  # fmt: skip
        return repaired._replace(attitude=None), found
    other = "" if gain > 1.4 or not upright else " (or the attitude: no manoeuvre that tells them apart by GNSS)"
    found.append(
        Finding(
            "gyro", defect, value, error, "", "warning",
            f"gyro{other}: against the rates of the attitude {words} (slope {value:.2f} +- {error:.2f}): integrated, "
            f"it turns "
            "the aircraft the wrong way; correct the mounting or the source",
        )
    )  # fmt: skip
    return turned, found


def _reversed_angle(columns: Columns, start: int, fitted: Fit, least: float) -> tuple[str, float, float] | None:
    """The Euler angle whose reversal explains rates better than any turn of the gyro (misfit ``least``) by 10.

    A reversed angle is not a reversed axis: in turns the rates of the other angles project on all axes.
    """
    attitude = columns.attitude
    least = min(least, misfit(fitted))
    if attitude is None or least < 10.0:
        return None
    best = None
    for i, name in enumerate(("phi", "theta", "psi")):
        other = gyro_by_attitude(
            columns._replace(attitude=attitude._replace(**{name: -getattr(attitude, name)})), start
        )
        if other is not None and misfit(other) < least - (10.0 if best is None else 0.0):
            best, least = (name, float(fitted.value[i, i]), float(fitted.sigma[i, i])), misfit(other)
    return best


def force_by_attitude(columns: Columns, start: int, gravity: float) -> Fit | None:
    """M of R^T (a - g) = M f + b, x and y axes only (2, 2), with a from GNSS over half a second, |f| within 0.7..1.3 g.

    The accelerometer, with less noise than differences of velocity, stands on the right. The vertical acceleration is
    not measured and taken for zero; near 1 g that costs x and y little.
    """
    if columns.imu is None or columns.attitude is None or columns.gnss is None:
        return None
    attitude = complete(columns.attitude)
    if attitude is None:
        return None
    fix, v = seconds(columns.gnss.t, start), columns.gnss.velocity[:, :2]
    good = np.isfinite(v).all(axis=1)
    fix, v = fix[good], v[good]
    t, known = seconds(columns.imu.t, start), seconds(attitude.t, start)
    if len(fix) < 50:
        return None
    every = max(1, round(0.5 / float(np.median(np.diff(fix)))))
    begin, end = fix[:-every], fix[every:]
    inside = (begin >= max(t[0], known[0])) & (end <= min(t[-1], known[-1])) & (end - begin < 1.5)
    acceleration = (v[every:] - v[:-every])[inside] / (end - begin)[inside, None]
    begin, end = begin[inside], end[inside]
    if len(begin) < 50:
        return None
    force = mean_over(t, columns.imu.specific_force, begin, end)
    # Elements of a rotation are interpolated: a degree over such intervals is no matter here.
    r = interpolate(0.5 * (begin + end), known, rotations(attitude).reshape(-1, 9)).reshape(-1, 3, 3)
    felt = np.column_stack([acceleration, np.full(len(acceleration), -gravity)])
    expected = np.einsum("kji,kj->ki", r, felt)
    norm = np.linalg.norm(force, axis=1)
    use = (norm > 0.7 * gravity) & (norm < 1.3 * gravity) & flying(columns, start)(0.5 * (begin + end))
    if np.count_nonzero(use) < 50:
        return None
    x = np.column_stack([force[use, :2], np.ones(np.count_nonzero(use))])
    found = robust_fit(x, expected[use, :2], blocks(end[use]))
    return None if found is None else Fit(found.value[:2].T, found.sigma[:2].T)


def find_accelerometer(columns: Columns, start: int, gravity: float) -> tuple[Columns, list[Finding]]:
    """Accelerometer axes that are exchanged or reversed: z by gravity, x and y by attitude and GNSS."""
    imu = columns.imu
    if imu is None or len(imu.t) < 100:
        return columns, []
    found = []
    names = ("f_x", "f_y", "f_z")
    middle = np.median(imu.specific_force, axis=0) / gravity
    sigma = 1.4826 * np.median(np.abs(imu.specific_force / gravity - middle), axis=0)
    sigma = sigma / np.sqrt(max(len(imu.t) / 50.0, 1.0))
    down = int(np.argmax(np.abs(middle)))
    if abs(middle[down]) > 0.7 and np.abs(np.delete(middle, down)).max() < 0.5 and (down != 2 or middle[2] > 0.0):
        words = (
            f"{names[down]} is {middle[down]:+.2f} +- {sigma[down]:.2f} g (median) where it is f_z that should be -1 "
            f"g: "
            + (
                "its axes are exchanged"
                if down != 2
                else "f_z has the wrong sign (up, or acceleration for specific force)"
            )
        )
        defect = "axes" if down != 2 else "sign"
        found.append(
            Finding(
                "accelerometer", defect, float(middle[down]), float(sigma[down]), "g", "warning",
                f"accelerometer: {words}; correct the mounting or the source",
            )
        )  # fmt: skip
        if down != 2:
            # Where z went, the two others can only be told by a second look at repaired data.
            return columns._replace(imu=None), found
        imu = Imu(imu.t, imu.specific_force * [1.0, 1.0, -1.0], imu.angular_rate)
        columns = columns._replace(imu=imu)
    fitted = force_by_attitude(columns, start, gravity)
    if fitted is None:
        return columns, found
    turn = nearest_turn(fitted)
    moved = [] if turn is None else [i for i in range(2) if turn.order[i] != i or turn.sign[i] < 0]
    # Level flight shows little of x and y: an axis is named only by a slope that is known well, and near one.
    sizes = [(abs(float(fitted.value[i, turn.order[i]])), float(fitted.sigma[i, turn.order[i]])) for i in moved if turn]
    if turn is not None and all(0.5 < size < 1.6 and error < 0.25 for size, error in sizes):
        defect, words = named(turn, names[:2])
        i = moved[0]
        value, error = float(fitted.value[i, turn.order[i]]), float(fitted.sigma[i, turn.order[i]])
        found.append(
            Finding(
                "accelerometer", defect, value, error, "", "warning",
                f"accelerometer: against attitude and GNSS acceleration {words} (slope {value:.2f} +- {error:.2f}), "
                f"if phi and theta are right: "
                "correct the mounting or the source",
            )
        )  # fmt: skip
        whole = np.eye(3)
        whole[:2, :2] = turn.matrix
        columns = columns._replace(imu=Imu(imu.t, imu.specific_force @ whole.T, imu.angular_rate))
    return columns, found
