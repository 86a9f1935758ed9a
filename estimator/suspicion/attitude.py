"""The attitude, judged by GNSS and altimeter alone: signs of its angles, and of the ground track they are judged by."""

from __future__ import annotations

import numpy as np

from estimator.suspicion.columns import (
    Attitude,
    Columns,
    Finding,
    Floats,
    Gnss,
    blocks,
    fit,
    flying,
    interpolate,
    seconds,
)

SURE = 5.0
"""Standard deviations behind a verdict."""
STEP = 0.2
"""Interval over which attitude is differenced (s)."""
MOVED = {"phi": 0.006, "psi": 0.006, "theta": 0.5}
"""Standard deviation of what an angle should make (rate of turn, rad/s; climb rate, m/s) that a verdict needs."""


def rotations(attitude: Attitude) -> Floats:
    """Body to north-east-down (k, 3, 3)."""
    (cp, ct, cs), (sp, st, ss) = ([f(angle) for angle in attitude[1:]] for f in (np.cos, np.sin))
    rows = [
        [ct * cs, sp * st * cs - cp * ss, cp * st * cs + sp * ss],
        [ct * ss, sp * st * ss + cp * cs, cp * st * ss - sp * cs],
        [-st, sp * ct, cp * ct],
    ]
    return np.stack([np.stack(row, axis=1) for row in rows], axis=1)


def complete(attitude: Attitude) -> Attitude | None:
    """The rows that have all three angles; None without twenty of them."""
    t, phi, theta, psi = attitude
    good = np.isfinite(phi) & np.isfinite(theta) & np.isfinite(psi)
    return Attitude(t[good], phi[good], theta[good], psi[good]) if np.count_nonzero(good) > 20 else None


def attitude_rates(attitude: Attitude, start: int) -> tuple[Floats, Floats, Floats]:
    """Body rates (k, 3) that the attitude implies, vee(R1^T R2) / dt, and the ends of the intervals, s."""
    t = seconds(attitude.t, start)
    # Neighbours are too near for the noise of angles.
    interval = float(np.median(np.diff(t)))
    every = max(1, round(STEP / interval)) if interval > 0 else 1
    r = rotations(attitude)[::every]
    t = t[::every]
    turn = np.einsum("kji,kjl->kil", r[:-1], r[1:])
    sine = 0.5 * np.stack(
        [turn[:, 2, 1] - turn[:, 1, 2], turn[:, 0, 2] - turn[:, 2, 0], turn[:, 1, 0] - turn[:, 0, 1]], 1
    )
    size = np.linalg.norm(sine, axis=1)
    angle = np.where(size > 1e-6, np.arcsin(np.minimum(size, 1.0)) / np.maximum(size, 1e-9), 1.0)
    return angle[:, None] * sine / np.diff(t)[:, None], t[:-1], t[1:]


def _track(columns: Columns, start: int) -> tuple[Floats, Floats, Floats, Floats] | None:
    """Times, ground speed, track and its rate, in flight, over intervals of about a second."""
    if columns.gnss is None:
        return None
    t, v = seconds(columns.gnss.t, start), columns.gnss.velocity[:, :2]
    good = np.isfinite(v).all(axis=1)
    good &= flying(columns, start)(t)
    t, v = t[good], v[good]
    if len(t) < 20:
        return None
    every = max(1, round(1.0 / float(np.median(np.diff(t)))))
    a, b = v[:-every], v[every:]
    dt = t[every:] - t[:-every]
    turned = np.arctan2(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0], (a * b).sum(axis=1))
    good = dt < 2.0
    middle = 0.5 * (a + b)
    values = 0.5 * (t[every:] + t[:-every]), np.hypot(*middle.T), np.arctan2(middle[:, 1], middle[:, 0]), turned / dt
    return tuple(column[good] for column in values)  # type: ignore[return-value]


def attitude_by_gnss(columns: Columns, start: int, gravity: float) -> dict[str, tuple[float, float]]:
    """Slopes and standard deviations of what should rise together, by what they judge; about 1 for good sensors.

    - "phi": track rate against g tan(phi) / V (a coordinated turn);
    - "psi": track rate against the rate of psi;
    - "theta": climb rate against V sin(theta).
    """
    track = _track(columns, start)
    if track is None or columns.attitude is None:
        return {}
    attitude = complete(columns.attitude)
    if attitude is None:
        return {}
    at, speed, _, rate = track
    t = seconds(attitude.t, start)
    inside = (at > t[0] + 0.5) & (at < t[-1] - 0.5)
    at, speed, rate = at[inside], speed[inside], rate[inside]
    if len(at) < 20:
        return {}
    block = blocks(at)
    angles = np.stack([np.unwrap(attitude.psi), np.sin(attitude.theta), np.sin(attitude.phi), np.cos(attitude.phi)], 1)
    _, pitch, sine, cosine = interpolate(at, t, angles).T
    turned = (np.interp(at + 0.5, t, angles[:, 0]) - np.interp(at - 0.5, t, angles[:, 0])) / 1.0
    upright = (cosine > 0.3) & (np.abs(pitch) < 0.6)
    pairs = {
        "phi": (gravity * sine / np.maximum(cosine, 0.3) / np.maximum(speed, 3.0), rate, upright),
        "psi": (turned, rate, upright),
    }
    if columns.altitude is not None:
        heard, level = seconds(columns.altitude.t, start), columns.altitude.altitude
        good = np.isfinite(level)
        if np.count_nonzero(good) > 20:
            climb = np.interp(at + 1.0, heard[good], level[good]) - np.interp(at - 1.0, heard[good], level[good])
            pairs["theta"] = (speed * pitch, 0.5 * climb, upright)
    out = {}
    for name, (x, y, use) in pairs.items():
        if np.count_nonzero(use) < 20 or float(np.std(x[use])) < MOVED[name]:
            continue
        found = fit(np.column_stack([x, np.ones(len(x))])[use], y[use, None], block[use])
        if found is not None:
            out[name] = float(found.value[0, 0]), float(found.sigma[0, 0])
    return out


def _wrong(slopes: dict[str, tuple[float, float]], name: str) -> bool:
    value, sigma = slopes.get(name, (0.0, np.inf))
    return value < -0.3 and value < -SURE * sigma


def find_attitude(columns: Columns, start: int, gravity: float) -> tuple[Columns, list[Finding]]:
    """Attitude angles of the wrong sign, or a GNSS velocity whose axes are exchanged."""
    slopes = attitude_by_gnss(columns, start, gravity)
    attitude, gnss = columns.attitude, columns.gnss
    if attitude is None or gnss is None or not slopes:
        return columns, []
    found = []
    phi, theta, psi = (_wrong(slopes, name) for name in ("phi", "theta", "psi"))
    if phi and psi:
        # Both at once is one fault of what both were compared with: a mirrored ground track.
        value, sigma = slopes["psi"]
        heading = np.interp(seconds(gnss.t, start), seconds(attitude.t, start), np.unwrap(_filled(attitude.psi)))
        velocity = gnss.velocity.copy()
        ways = {
            "north and east are exchanged": velocity[:, [1, 0]],
            "north has the wrong sign": velocity[:, :2] * [-1.0, 1.0],
            "east has the wrong sign": velocity[:, :2] * [1.0, -1.0],
        }
        along = {
            way: float(np.nanmean(np.cos(heading) * v[:, 0] + np.sin(heading) * v[:, 1])) for way, v in ways.items()
        }
        way = max(along, key=lambda way: along[way])
        velocity[:, :2] = ways[way]
        found.append(
            Finding(
                "gnss", "axes" if "exchanged" in way else "sign", value, sigma, "", "warning",
                f"gnss: the track turns against roll and heading (slope {value:.2f} +- {sigma:.2f} where 1 belongs): "
                f"of its "
                f"velocity {way}; correct the source",
            )
        )  # fmt: skip
        columns = columns._replace(gnss=Gnss(gnss.t, velocity, *gnss[2:]))
        phi = psi = False
    for name, wrong, against in (
        ("phi", phi, "the rate of turn"), ("theta", theta, "the climb rate"), ("psi", psi, "the rate of turn")
    ):  # fmt: skip
        if wrong:
            value, sigma = slopes[name]
            found.append(
                Finding(
                    "attitude", "sign", value, sigma, "", "warning",
                    f"attitude: {name} moves against {against} of GNSS and altimeter (slope {value:.2f} +- "
                    f"{sigma:.2f} where "
                    "1 belongs): it has the wrong sign; correct the source",
                )
            )  # fmt: skip
            attitude = attitude._replace(**{name: -getattr(attitude, name)})
    return columns._replace(attitude=attitude), found


def _filled(angle: Floats) -> Floats:
    good = np.isfinite(angle)
    rows = np.arange(len(angle))
    return np.interp(rows, rows[good], angle[good]) if good.any() else np.zeros(len(angle))
