"""The raw sensors of one leg, kept to be examined: narrow columns, one set per sensor."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from estimator import atmosphere, suspicion
from estimator.drive import IMPACT, IMU, MEASURED, STATIC
from estimator.kinematics import ATTITUDE as ANGLES
from estimator.kinematics import Earth
from estimator.models.flight_path import Settings
from estimator.stage.rows import AIR, ALTITUDE, ATTITUDE, FIX_VELOCITY, FLOW, GNSS, HEIGHT_COLUMN, INERTIAL
from estimator.synchronise import Rows

Floats = NDArray[np.float64]
Times = NDArray[np.int64]

KEPT = {
    GNSS: (0, 1, 2, *range(FIX_VELOCITY.start, FIX_VELOCITY.stop)),
    ALTITUDE: (HEIGHT_COLUMN, STATIC),
    INERTIAL: tuple(range(IMU, IMU + 6)),
    ATTITUDE: tuple(range(MEASURED + ANGLES, MEASURED + ANGLES + 3)),
    AIR: (MEASURED, IMPACT),
    FLOW: (MEASURED + 1, MEASURED + 2),
}
CERTAIN = 5.0  # sigmas at which a delay that was found is taken off


class Examiner:
    """Keeps what the sensors said, and names what is wrong with it.

    Parameters
    ----------
    settings : Settings
    """

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._kept: dict[int, list[tuple[Times, Floats]]] = {sensor: [] for sensor in KEPT}

    def take(self, samples: Rows) -> None:
        """Keep samples, in order of their arrival."""
        for sensor, columns in KEPT.items():
            mine = np.flatnonzero(samples.sensor == sensor)
            if len(mine):
                self._kept[sensor].append((samples.t[mine], samples.z[np.ix_(mine, columns)]))

    def findings(self, first: int, stop: int, taken: float) -> tuple[str, ...]:
        """What is wrong with the sensors from time `first` to `stop`, ns, in words.

        ``taken`` is the delay of the fixes that was taken off, s, configured or found.
        """
        columns, gravity = self._columns(first, stop)
        configured = self._settings.gnss_delay or 0.0
        found = suspicion.examine(columns, gravity=gravity, gnss_delay=configured, gnss_arm=self._settings.antenna)
        return tuple(
            f"{finding.text} ({taken:.3f} s were taken off here)"
            if finding.defect == "delay" and taken != configured
            else finding.text
            for finding in found
        )

    def delay(self) -> float:
        """By how much the satellite fixes are older than they say, s; 0 where that is not certain."""
        columns, gravity = self._columns(-(1 << 62), 1 << 62)
        for finding in suspicion.examine(columns, gravity=gravity, gnss_arm=self._settings.antenna):
            if finding.defect == "delay" and finding.value > CERTAIN * finding.sigma:
                return round(finding.value, 3)
        return 0.0

    def loss(self, first: int, stop: int) -> float | None:
        """Share of inertial samples due between two times that did not come; None without any."""
        t = self._sensor(INERTIAL, first, stop)[0]
        if len(t) < 10:
            return None
        spans = np.diff(np.sort(t))
        period = float(np.median(spans))
        missing = np.maximum(np.round(spans.astype(np.float64) / period) - 1.0, 0.0).sum() if period > 0.0 else 0.0
        return float(missing / (missing + len(t)))

    def _sensor(self, sensor: int, first: int, stop: int) -> tuple[Times, Floats]:
        parts = self._kept[sensor]
        if not parts:
            return np.empty(0, np.int64), np.empty((0, len(KEPT[sensor])))
        if len(parts) > 1:
            parts[:] = [(np.concatenate([t for t, _ in parts]), np.concatenate([z for _, z in parts]))]
        t, z = parts[0]
        inside = (t >= first) & (t <= stop)
        return (t, z) if inside.all() else (t[inside], z[inside])

    def _columns(self, first: int, stop: int) -> tuple[suspicion.Columns, float]:
        imu, angles = self._sensor(INERTIAL, first, stop), self._sensor(ATTITUDE, first, stop)
        air, flow = self._sensor(AIR, first, stop), self._sensor(FLOW, first, stop)
        height, fixes = self._sensor(ALTITUDE, first, stop), self._sensor(GNSS, first, stop)
        gravity = 9.80665
        if len(fixes[0]):
            earth = Earth.at(float(fixes[1][0, 0]), 0.0)
            gravity = earth.g0 + earth.gh * float(fixes[1][0, 2])
        speed = np.empty(0)
        if len(air[0]):
            impact = np.where(np.isnan(air[1][:, 1]), atmosphere.impact_pressure(air[1][:, 0]), air[1][:, 1])
            static = np.full(len(impact), atmosphere.SEA_LEVEL_PRESSURE)
            known = ~np.isnan(height[1][:, 1])
            if known.any():
                static = np.interp(air[0], height[0][known], height[1][known, 1])
            speed = atmosphere.true_airspeed(impact, static)
        return (
            suspicion.Columns(
                imu=suspicion.Imu(imu[0], imu[1][:, :3], imu[1][:, 3:]),
                attitude=suspicion.Attitude(angles[0], angles[1][:, 1], angles[1][:, 0], angles[1][:, 2]),
                air=suspicion.Air(air[0], speed),
                flow=suspicion.Flow(flow[0], flow[1][:, 0], flow[1][:, 1]),
                altitude=suspicion.Altitude(height[0], height[1][:, 0]),
                gnss=suspicion.Gnss(fixes[0], fixes[1][:, 3:6], fixes[1][:, 2], np.full(len(fixes[0]), -1, np.int64)),
            ),
            gravity,
        )
