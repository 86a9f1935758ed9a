"""The raw sensors of one leg, kept to be examined: narrow columns, one set per sensor."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from estimator import atmosphere, suspicion
from estimator.alignment import SLOWEST, rate
from estimator.drive import IMPACT, IMU, MEASURED, STATIC
from estimator.kinematics import ATTITUDE as ANGLES
from estimator.kinematics import Earth
from estimator.models.flight_path import Settings
from estimator.stage.rows import AIR, ALTITUDE, ATTITUDE, FIX_VELOCITY, FLOW, GNSS, HEIGHT_COLUMN, INERTIAL, SENSORS
from estimator.stage.shelf import EVER, Shelf
from estimator.stage.shelf import Rows as Kept
from estimator.synchronise import Rows, concatenate

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
UNSORTED = 1000  # rows that may wait to be sorted by sensor
HOLE = 1.75  # usual intervals between two samples: from there on one is missing, and not only late
QUIET = 5.0  # s: a longer silence of a sensor is told
CERTAIN = 5.0  # sigmas at which a delay that was found is taken off


def absent(t: Times, period: int, first: int, stop: int) -> Times:
    """Times between two times at which samples were due that did not come: in the holes between ``t``, rising."""
    edges = np.concatenate([[first], t, [stop]])
    spans = np.diff(edges) / period
    count = np.where(spans > HOLE, np.rint(spans) - 1.0, 0.0).astype(np.int64)
    index = np.repeat(np.arange(len(count)), count)
    position = np.arange(len(index)) - np.repeat(np.cumsum(count) - count, count) + 1
    return np.asarray(edges[index] + position * period)


class Examiner:
    """Keeps what the sensors said, and names what is wrong with it.

    Parameters
    ----------
    settings : Settings
    """

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._kept = {sensor: Shelf(len(columns)) for sensor, columns in KEPT.items()}
        self._fast = False
        self._unsorted: list[tuple[Rows, Times]] = []
        self._count = 0  # of these

    def so_far(self) -> Examiner:
        """What has been kept by now, to be asked while more is taken in here."""
        self._sort()
        other = Examiner(self._settings)
        other._kept = {sensor: shelf.so_far() for sensor, shelf in self._kept.items()}
        return other

    def take(self, samples: Rows, passed: Times) -> None:
        """Keep samples, in order of their arrival.

        ``passed`` (k,): time that had been passed, and would not be waited for, when each of them arrived.
        """
        self._unsorted.append((samples, passed))
        self._count += len(passed)
        if self._count >= UNSORTED:
            self._sort()

    def _sort(self) -> None:
        if not self._unsorted:
            return
        samples = concatenate([rows for rows, _ in self._unsorted])
        passed = np.concatenate([times for _, times in self._unsorted])
        self._unsorted, self._count = [], 0
        for sensor, columns in KEPT.items():
            mine = np.flatnonzero(samples.sensor == sensor)
            if len(mine):
                self._kept[sensor].put(Kept(samples.t[mine], passed[mine], samples.z[np.ix_(mine, columns)]))

    def findings(self, first: int, stop: int, heard: int, taken: float) -> tuple[str, ...]:
        """What is wrong with the sensors from time `first` to `stop`, ns, in words.

        ``heard``: what came after this time had been passed does not count, so that it does not matter when the
        question is asked. ``taken`` is the delay of the fixes that was taken off, s, configured or found.
        """
        columns, gravity = self._columns(first, stop, heard)
        configured = self._settings.gnss_delay or 0.0
        try:
            found = self._examine(columns, gravity, configured)
        except (ValueError, ArithmeticError, IndexError) as error:
            return (f"the sensors could not be examined: {error}",)
        return tuple(
            f"{finding.text} ({taken:.3f} s were taken off here)"
            if finding.defect == "delay" and taken != configured
            else finding.text
            for finding in found
        )

    def delay(self, since: int = -EVER) -> float:
        """By how much the satellite fixes are older than they say, s; 0 where that is not certain.

        ``since``: what was measured before this time, ns, is left alone.
        """
        columns, gravity = self._columns(since, EVER, EVER)
        try:
            found = self._examine(columns, gravity, 0.0)
        except (ValueError, ArithmeticError, IndexError):
            return 0.0
        for finding in found:
            if finding.defect == "delay" and finding.value > CERTAIN * finding.sigma:
                return round(finding.value, 3)
        return 0.0

    def _examine(self, columns: suspicion.Columns, gravity: float, delay: float) -> list[suspicion.Finding]:
        with np.errstate(all="ignore"):  # the columns are as bad as they are
            return suspicion.examine(columns, gravity=gravity, gnss_delay=delay, gnss_arm=self._settings.antenna)

    def fast(self) -> bool:
        """Whether inertial samples have come often enough for a flight path."""
        if not self._fast:
            self._fast = rate(self._times(INERTIAL, EVER, EVER)) >= SLOWEST
        return self._fast

    def due(self, first: int, stop: int, heard: int) -> dict[int, tuple[Times, int]]:
        """Times of each sensor's samples between two times, and its usual interval up to then, ns; of those that have
        spoken ten times or more.
        """
        found = {}
        for sensor in KEPT:
            t = self._times(sensor, stop, heard)
            if len(t) >= 10:
                found[sensor] = t[np.searchsorted(t, first) :], max(int(np.median(np.diff(t))), 1)
        return found

    def silences(self, first: int, stop: int, heard: int) -> dict[str, float]:
        """Seconds of silences longer than `QUIET` between two times, by sensor; only of those that were silent."""
        found = {}
        for sensor, (t, _) in self.due(first, stop, heard).items():
            spans = np.diff(np.concatenate([[first], t, [stop]])) * 1e-9
            total = float(spans[spans > QUIET].sum())
            if total and sensor != INERTIAL:
                found[SENSORS[sensor]] = total
        return found

    def loss(self, first: int, stop: int, heard: int) -> float | None:
        """Share of the samples due between two times that did not come, over all sensors; None without any."""
        missing = came = 0
        for t, period in self.due(first, stop, heard).values():
            missing += len(absent(t, period, first, stop))
            came += len(t)
        return missing / (missing + came) if came else None

    def _times(self, sensor: int, stop: int, heard: int) -> Times:
        self._sort()
        t, passed = self._kept[sensor].times(-EVER, stop)
        return np.unique(t[passed < heard])

    def _sensor(self, sensor: int, first: int, stop: int, heard: int) -> tuple[Times, Floats]:
        self._sort()
        t, passed, z = self._kept[sensor].rows(first, stop)
        inside = passed < heard
        if not inside.all():
            t, z = t[inside], z[inside]
        if (np.diff(t) <= 0).any():  # in order of time, of two at one time the first to arrive, as they are used
            t, order = np.unique(t, return_index=True)
            z = z[order]
        return t, z

    def _columns(self, first: int, stop: int, heard: int) -> tuple[suspicion.Columns, float]:
        imu, angles, air, flow, height, fixes = (
            self._sensor(sensor, first, stop, heard) for sensor in (INERTIAL, ATTITUDE, AIR, FLOW, ALTITUDE, GNSS)
        )
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
            same = np.zeros(len(speed), np.bool_)  # said again: no new value because the static pressure has changed
            same[1:] = ((air[1][1:] == air[1][:-1]) | np.isnan(air[1][1:])).all(axis=1)
            said = np.maximum.accumulate(np.where(same, 0, np.arange(len(speed))))
            speed = speed[said]
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
