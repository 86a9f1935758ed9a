"""The vanes, judged by what the air does to the aircraft: lift and side force."""

from __future__ import annotations

import numpy as np

from estimator.suspicion.columns import Columns, Finding, Fit, Flow, blocks, fit, flying, mean_over, seconds

SURE = 5.0
"""Standard deviations behind a verdict."""


def vanes_by_force(columns: Columns, start: int) -> Fit | None:
    """L of (-f_z, -f_y) / V^2 = L (alpha, beta) + b, (2, 2), each scaled by its own spread.

    Lift grows with alpha and the side force points away from the wind that comes from the side, so both diagonal
    entries are positive whatever the aircraft.
    """
    if columns.imu is None or columns.flow is None:
        return None
    t, at = seconds(columns.imu.t, start), seconds(columns.flow.t, start)
    angles = np.column_stack(columns.flow[1:])
    good = np.isfinite(angles).all(axis=1) & (at > t[0] + 0.2) & (at < t[-1] - 0.2) & flying(columns, start)(at)
    at, angles = at[good], angles[good]
    if len(at) < 100:
        return None
    force = mean_over(t, columns.imu.specific_force, at - 0.05, at + 0.05)
    speed = np.ones(len(at))
    if columns.air is not None:
        heard = np.isfinite(columns.air.true_airspeed)
        if np.count_nonzero(heard) > 20:
            speed = np.interp(at, seconds(columns.air.t, start)[heard], columns.air.true_airspeed[heard])
            speed = np.maximum(speed, max(0.3 * float(np.median(speed)), 1.0))
    y = np.column_stack([-force[:, 2], -force[:, 1]]) / speed[:, None] ** 2
    angles = angles - angles.mean(axis=0)
    width = np.maximum(angles.std(axis=0), 1e-9)
    y = (y - y.mean(axis=0)) / np.maximum(y.std(axis=0), 1e-12)
    found = fit(np.column_stack([angles / width, np.ones(len(at))]), y, blocks(at, 4.0))
    return None if found is None else Fit(found.value[:2].T, found.sigma[:2].T)


def find_vanes(columns: Columns, start: int) -> tuple[Columns, list[Finding]]:
    """Alpha or beta of the wrong sign, or exchanged."""
    fitted = vanes_by_force(columns, start)
    flow = columns.flow
    if fitted is None or flow is None:
        return columns, []
    value, sigma = fitted
    sure = np.abs(value) > np.maximum(SURE * sigma, 0.3)
    if sure[0, 1] and sure[1, 0] and np.abs(value[[0, 1], [1, 0]]).min() > 2.0 * np.abs(value.diagonal()).max():
        slope, error = float(value[0, 1]), float(sigma[0, 1])
        text = f"vanes: lift follows beta and side force alpha (correlation {slope:.2f} +- {error:.2f}): "
        finding = Finding(
            "vanes", "axes", slope, error, "", "warning", text + "the two are exchanged; correct the source"
        )
        return columns._replace(flow=Flow(flow.t, flow.beta, flow.alpha)), [finding]
    found = []
    for i, (name, what) in enumerate((("alpha", "lift"), ("beta", "side force"))):
        if sure[i, i] and value[i, i] < 0.0:
            found.append(
                Finding(
                    "vanes", "sign", float(value[i, i]), float(sigma[i, i]), "", "warning",
                    f"vanes: {what} falls with {name} (correlation {value[i, i]:.2f} +- {sigma[i, i]:.2f}): {name} "
                    f"has the "
                    "wrong sign; correct the source",
                )
            )  # fmt: skip
            flow = flow._replace(**{name: -getattr(flow, name)})
    return columns._replace(flow=flow), found
