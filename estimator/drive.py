"""Samples in order of time to the steps of the flight-path filter.

Every sensor keeps its own times: the interval between two inertial samples is cut wherever something was measured in
it. The mean specific force and rate are those of the whole interval in every part of it, and the variance of a part is
that of the sample times interval over part, which keeps the variance of the integral. A step ends at each sample time.

What is missing between two inertial samples: up to 2.5 sample times, the mean is held and its variance taken four
times; up to 2 s, it is interpolated with the variance of unknown manoeuvring, and flagged; after that there is no path.
"""

from __future__ import annotations

import copy
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimator import atmosphere
from estimator.extended import Drive
from estimator.kinematics import ATTITUDE, HEIGHT, VELOCITY, M
from estimator.models.flight_path import FlightPath
from estimator.synchronise import Rows

Floats = NDArray[np.float64]
Times = NDArray[np.int64]

# Columns of a row of samples: inertial, then measurements as in ``kinematics``, then what the airspeed is made of.
IMU, MEASURED, STATIC, IMPACT, WIDTH = 0, 6, 6 + M, 7 + M, 8 + M
S = 1_000_000_000
WALK = S // 5  # ns between two steps of what walks slowly
LATE_SAMPLES, WEAK = 2.5, 4.0  # sample times that are held, and by how much that raises the variance
LONGEST_GAP = 2.0  # s
MANOEUVRE = (3.0, 0.4)  # m/s2 and rad/s: what an aircraft may do unseen
MANOEUVRE_TIME = 0.25  # s
REPEAT = S // 2  # ns: the same value again within this time is the old one, held
BLIND = 8.0  # sigmas of airspeed below which a pitot tube says nothing; nearer to the speed of flight it cuts off noise


class Samples(NamedTuple):
    """Rows of samples in order of time.

    Attributes
    ----------
    t, t_rx : (k,) int64 arrays
        ns.
    z, r : (k, WIDTH) arrays
        Values, NaN where not measured, and variances where a sensor states them, else NaN.
    """

    t: Times
    t_rx: Times
    z: Floats
    r: Floats

    def rows(self, part: slice) -> Samples:
        """Some of the rows."""
        return Samples(self.t[part], self.t_rx[part], self.z[part], self.r[part])

    @classmethod
    def join(cls, parts: list[Samples]) -> Samples:
        """All rows, one part after the other."""
        return parts[0] if len(parts) == 1 else cls(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))

    @classmethod
    def none(cls) -> Samples:
        """No rows."""
        return cls(np.empty(0, np.int64), np.empty(0, np.int64), np.empty((0, WIDTH)), np.empty((0, WIDTH)))


def merged(samples: Samples, late: Rows) -> tuple[Samples, NDArray[np.bool_]]:
    """Samples with others put in where they belong; what has been measured at the same time already stays.

    Parameters
    ----------
    samples : Samples
    late : Rows
        In the order of their arrival, z and r as wide as those of the samples.

    Returns
    -------
    samples : Samples
    new : bool array
        Which of `late` added anything.
    """
    t = np.unique(late.t)
    t = t[~np.isin(t, samples.t)]
    at = np.searchsorted(samples.t, t)
    nothing = np.full((len(t), WIDTH), np.nan)
    all_t = np.insert(samples.t, at, t)
    t_rx = np.insert(samples.t_rx, at, np.zeros(len(t), np.int64))
    z, r = np.insert(samples.z, at, nothing, axis=0), np.insert(samples.r, at, nothing, axis=0)
    place = np.searchsorted(all_t, late.t)
    added = np.zeros(len(late.t), np.bool_)
    for i, k in enumerate(place.tolist()):  # few, and the first of two at one time counts
        new = np.isnan(z[k]) & ~np.isnan(late.z[i])
        if new.any():
            added[i] = True
            z[k, new], r[k, new] = late.z[i, new], late.r[i, new]
            t_rx[k] = max(t_rx[k], late.t_rx[i])
    return Samples(all_t, t_rx, z, r), added


class Steps(NamedTuple):
    """What the filter is driven by, and the times that go with it.

    Attributes
    ----------
    t, t_rx : (N,) int64 arrays
        Ends of the steps, ns.
    drive : Drive
    inertial : (N,) bool array
        An inertial sample ends there.
    """

    t: Times
    t_rx: Times
    drive: Drive
    inertial: NDArray[np.bool_]

    def part(self, stop: int) -> Steps:
        """The first steps."""
        return Steps(self.t[:stop], self.t_rx[:stop], self.drive.part(0, stop), self.inertial[:stop])


class Driver:
    """Turns the samples of one stretch of flight into steps, in any number of calls.

    Parameters
    ----------
    flight : FlightPath
    t : int
        Time of the start, ns, at which an inertial sample ended.
    u : (6,) array
        That sample.
    period : float
        Usual time between inertial samples, s.
    output : int
        Standard deviations are wanted once in so many ns.
    attitude_interval : int
        Attitude counts once in so many ns.
    """

    def __init__(
        self, flight: FlightPath, t: int, u: Floats, period: float, *, output: int, attitude_interval: int
    ) -> None:
        self.flight, self.period = flight, period
        self._t = self._imu_t = self._walked = t
        self._u = u
        self._output, self._thin = output, attitude_interval
        self._pending: list[Samples] = []
        self._static = self._speed = np.nan
        self._said: dict[int, tuple[Floats, int]] = {}  # column -> what was said last, and when
        self._attitude = -(1 << 62)
        self.gap: int | None = None  # time of the last inertial sample before a gap that is too long

    def push(self, samples: Samples) -> Steps | None:
        """Steps that are complete, those up to the last inertial sample; None when there are none.

        Once `gap` is set nothing more comes.
        """
        if self.gap is not None or len(samples.t) == 0:
            return None
        self._pending.append(samples)
        if np.isnan(samples.z[:, IMU]).all():
            if samples.t[-1] - self._imu_t > LONGEST_GAP * S:
                self.gap = self._imu_t
            return None
        rows = Samples.join(self._pending)
        ends = np.flatnonzero(~np.isnan(rows.z[:, IMU]))
        times = rows.t[ends]
        spans = np.diff(times, prepend=self._imu_t)
        lost = np.flatnonzero(spans > LONGEST_GAP * S)
        if len(lost):
            self.gap = int(self._imu_t if lost[0] == 0 else times[lost[0] - 1])
            ends, times, spans = ends[: lost[0]], times[: lost[0]], spans[: lost[0]]
            if not len(ends):
                return None
        last = int(ends[-1]) + 1
        self._pending = [rows.rows(slice(last, None))] if last < len(rows.t) else []
        return self._steps(rows.rows(slice(last)), ends, times, spans)

    def copy(self) -> Driver:
        """The same driver, to go on differently from here."""
        other = copy.copy(self)
        other._pending, other._said = list(self._pending), dict(self._said)
        return other

    def wait(self, samples: Samples) -> None:
        """Let samples be all that has been pushed and has not become steps."""
        self._pending = [samples] if len(samples.t) else []

    def rest(self) -> Samples:
        """What has been pushed and has not become steps."""
        return Samples.join(self._pending) if self._pending else Samples.none()

    def _steps(self, rows: Samples, ends: NDArray[np.intp], times: Times, spans: Times) -> Steps:
        settings = self.flight.settings
        u_end = rows.z[ends, IMU : IMU + 6]
        u_before = np.concatenate([self._u[None], u_end[:-1]])
        begin = times - spans
        long = spans > LATE_SAMPLES * self.period * S
        if long.any():  # put rows into the gaps
            where, extra = [], []
            for k in np.flatnonzero(long).tolist():
                grid = np.arange(int(begin[k]) + round(self.period * S), int(times[k]), round(self.period * S))
                grid = grid[~np.isin(grid, rows.t)]
                extra.append(grid)
                where.append(np.searchsorted(rows.t, grid))
            t_new, at = np.concatenate(extra), np.concatenate(where)
            t_rx = rows.t_rx[np.minimum(at, len(rows.t) - 1)]
            nothing = np.full(WIDTH, np.nan)
            rows = Samples(
                np.insert(rows.t, at, t_new), np.insert(rows.t_rx, at, t_rx), np.insert(rows.z, at, nothing, axis=0),
                np.insert(rows.r, at, nothing, axis=0),
            )  # fmt: skip
        t = rows.t
        interval = np.searchsorted(times, t)  # of which inertial sample each step is a part
        before = np.concatenate([[self._t], t[:-1]])
        dt = (t - before) * 1e-9
        whole = spans[interval] * 1e-9
        u = u_end[interval].copy()
        if settings.imu_input == "point":
            u = 0.5 * (u + u_before[interval])
        bridged = long[interval]
        if bridged.any():
            middle = 0.5 * (t + before)[bridged]
            share = ((middle - begin[interval][bridged]) / spans[interval][bridged])[:, None]
            u[bridged] = (1.0 - share) * u_before[interval][bridged] + share * u_end[interval][bridged]
        held = (spans > 1.5 * self.period * S)[interval] & ~bridged
        sample = np.repeat([settings.accelerometer**2, settings.gyro**2], 3)
        variance = sample * (np.where(held, WEAK, 1.0) * whole / np.maximum(dt, 1e-9))[:, None]
        if bridged.any():
            unknown = np.repeat(np.square(MANOEUVRE), 3) * 2.0 * MANOEUVRE_TIME
            variance[bridged] = unknown / np.maximum(dt[bridged], 1e-9)[:, None]
        q, fade = self.flight.noise(dt, variance, self._walks(t, before))
        z, r = self._measurements(rows)
        shown = (t // self._output != before // self._output).astype(np.uint8)
        inertial = ~np.isnan(rows.z[:, IMU])
        self._t = self._imu_t = int(times[-1])
        self._u = u_end[-1].copy()
        return Steps(t, rows.t_rx, Drive(dt, u, q, fade, z, r, bridged.astype(np.uint8), shown), inertial)

    def _too_slow(self, speed: Floats, blind: float) -> NDArray[np.bool_]:
        """Where the newest airspeed known is too small for vanes to mean anything."""
        known = ~np.isnan(speed)
        last = np.maximum.accumulate(np.where(known, np.arange(len(speed)), -1))
        newest = np.where(last >= 0, speed[last], self._speed)
        if len(newest):
            self._speed = float(newest[-1])
        return np.asarray(newest <= blind)

    def _walks(self, t: Times, before: Times) -> Floats:
        """For how much time wind and biases walk at each step (N,), s: since they last did, five times a second."""
        slow = np.zeros(len(t))
        at = np.flatnonzero(t // WALK != before // WALK)
        slow[at] = np.diff(t[at], prepend=self._walked) * 1e-9
        if len(at):
            self._walked = int(t[at[-1]])
        return slow

    def _measurements(self, rows: Samples) -> tuple[Floats, Floats]:
        """Measurements (N, 10) and variances, with what is no measurement left out."""
        s = self.flight.settings
        z = rows.z[:, MEASURED : MEASURED + M].copy()
        z[:, 0] = self._airspeed(rows)
        speed = z[:, 0].copy()
        blind = max(BLIND * s.airspeed, 0.6 * s.stall_speed)
        z[~(z[:, 0] > blind), 0] = np.nan
        z[self._too_slow(speed, blind), 1:3] = np.nan
        self._drop_repeats(rows.t, z, 0, rows.z[:, (MEASURED, IMPACT)])
        self._drop_repeats(rows.t, z, HEIGHT, z[:, HEIGHT : HEIGHT + 1])
        if s.mode == "I":
            z[:, :ATTITUDE] = np.nan
        if s.mode == "P":
            z[:, VELOCITY:] = np.nan
        if s.attitude is None:
            z[:, ATTITUDE : ATTITUDE + 2] = np.nan
        if s.heading is None or s.mode == "P":
            z[:, ATTITUDE + 2] = np.nan
        if self._thin:
            self._thin_attitude(rows.t, z)
        r = np.empty_like(z)
        angle = s.attitude or 1.0
        r[:] = np.square(
            [s.airspeed, s.flow_angle, s.flow_angle, angle, angle, s.heading or 1.0, s.height, 1.0, 1.0, 1.0]
        )
        stated = rows.r[:, MEASURED + VELOCITY : MEASURED + M]
        given = np.square(s.gnss_velocity) if s.gnss_velocity is not None else stated
        r[:, VELOCITY:] = np.where(np.isnan(given), 1.0, np.maximum(given, 1e-4))
        return z, r

    def _airspeed(self, rows: Samples) -> Floats:
        static = rows.z[:, STATIC]
        known = np.where(np.isnan(static), -1, np.arange(len(static)))
        last = np.maximum.accumulate(known)
        filled = np.where(last >= 0, static[last], self._static)
        if len(filled):
            self._static = float(filled[-1])
        impact = rows.z[:, IMPACT]
        impact = np.where(np.isnan(impact), atmosphere.impact_pressure(rows.z[:, MEASURED]), impact)
        with np.errstate(invalid="ignore"):
            return atmosphere.true_airspeed(impact, np.where(np.isnan(filled), atmosphere.SEA_LEVEL_PRESSURE, filled))

    def _drop_repeats(self, t: Times, z: Floats, column: int, said: Floats) -> None:
        """What is exactly the same as before was held, not measured; ``said`` (N, k): as the sensor says it."""
        at = np.flatnonzero(~np.isnan(said).all(axis=1))
        if not len(at):
            return
        values, times = np.where(np.isnan(said[at]), np.inf, said[at]), t[at]
        value, when = self._said.get(column, (np.full(values.shape[1], np.nan), 0))
        again = (values == np.concatenate([value[None], values[:-1]])).all(axis=1)
        again &= times - np.concatenate([[when], times[:-1]]) < REPEAT
        self._said[column] = (values[-1].copy(), int(times[-1]))
        z[at[again], column] = np.nan

    def _thin_attitude(self, t: Times, z: Floats) -> None:
        """An attitude that is correlated over seconds counts once in an interval."""
        at = np.flatnonzero(~np.isnan(z[:, ATTITUDE:HEIGHT]).all(axis=1))
        if not len(at):
            return
        slot = t[at] // self._thin
        first = slot != np.concatenate([[self._attitude], slot[:-1]])
        self._attitude = int(slot[-1])
        z[at[~first], ATTITUDE:HEIGHT] = np.nan
