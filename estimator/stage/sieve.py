"""Values that no sensor can mean: left out before anything is made of them, and told.

Limits are those of any aircraft on Earth, so wide that wrong units pass: those are named by ``suspicion``, which wants
to see them. What is not finite passes nowhere. A sample without its essential value is left out as a whole, another
value alone: NaN is "not measured".
"""

from __future__ import annotations

from collections import Counter
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimator.drive import IMPACT, IMU, MEASURED, STATIC, WIDTH
from estimator.kinematics import ATTITUDE as ANGLES
from estimator.stage.rows import AIR, ALTITUDE, ATTITUDE, FIX_VELOCITY, FLOW, GNSS, HEIGHT_COLUMN, INERTIAL, SENSORS
from estimator.synchronise import Rows, take
from estimator.ud import compiled

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]


class _Limit(NamedTuple):
    """Columns of a sensor's rows and what they can be; `whole`: a sample without them is none."""

    quantity: str
    unit: str
    columns: tuple[int, ...]
    low: float
    high: float
    whole: bool = False


LIMITS = {
    INERTIAL: (
        _Limit("specific force", "m/s2", tuple(range(IMU, IMU + 3)), -400.0, 400.0, True),
        _Limit("angular rate", "rad/s", tuple(range(IMU + 3, IMU + 6)), -80.0, 80.0, True),
    ),
    ATTITUDE: (_Limit("attitude", "rad", tuple(range(MEASURED + ANGLES, MEASURED + ANGLES + 3)), -1000.0, 1000.0),),
    AIR: (
        _Limit("airspeed", "m/s", (MEASURED,), -500.0, 3000.0),
        _Limit("differential pressure", "Pa", (IMPACT,), -3e5, 3e5),
    ),
    FLOW: (_Limit("flow angle", "rad", (MEASURED + 1, MEASURED + 2), -1000.0, 1000.0),),
    ALTITUDE: (
        _Limit("altitude", "m", (HEIGHT_COLUMN,), -5e3, 3e5, True),
        _Limit("pressure", "Pa", (STATIC,), 1e-3, 2e5),
    ),
    GNSS: (
        _Limit("latitude and longitude", "rad", (0, 1), -7.0, 7.0),
        _Limit("altitude", "m", (2,), -1e4, 1e6),
        _Limit("velocity", "m/s", tuple(range(FIX_VELOCITY.start, FIX_VELOCITY.stop)), -1e4, 1e4),
    ),
}
SIGMAS = {ALTITUDE: (HEIGHT_COLUMN,), GNSS: (0, 1, 2)}  # columns of r that hold standard deviations as stated
SIGMA = (1e-9, 1e9)


def _table() -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_]]:
    """The limits by sensor and column; the last row is that of marks, which have none."""
    shape = len(SENSORS) + 1, WIDTH
    low, high, whole, stated = np.full(shape, -np.inf), np.full(shape, np.inf), np.zeros(shape), np.zeros(shape)
    for sensor, limits in LIMITS.items():
        for limit in limits:
            columns = list(limit.columns)
            low[sensor, columns], high[sensor, columns], whole[sensor, columns] = limit.low, limit.high, limit.whole
    for sensor, those in SIGMAS.items():
        stated[sensor, list(those)] = True
    return low, high, whole.astype(np.bool_), stated.astype(np.bool_)


_LOW, _HIGH, _WHOLE, _STATED = _table()


@compiled
def _strange(
    z: Floats, r: Floats, sensor: NDArray[np.int64], low: Floats, high: Floats, whole: Flags, stated: Flags
) -> bool:
    for i in range(sensor.size):
        s = sensor[i]  # -1 of a mark is the last row of the tables
        for c in range(z.shape[1]):
            if z[i, c] < low[s, c] or z[i, c] > high[s, c] or (whole[s, c] and np.isnan(z[i, c])):
                return True
            if stated[s, c] and not (r[i, c] > SIGMA[0] and r[i, c] < SIGMA[1]):
                return True
    return False


class Refusal(NamedTuple):
    """The first value of its kind that was left out, and its times."""

    text: str
    t: int
    t_rx: int


class Sieve:
    """Leaves out what cannot be; the first of each kind is told at once, the number of all at the end."""

    def __init__(self) -> None:
        self._count: Counter[tuple[int, str]] = Counter()

    def sift(self, rows: Rows) -> tuple[Rows, list[Refusal]]:
        """The rows that remain, in order of arrival, and what is to be told."""
        if not self._doubtful(rows):
            return rows, []
        keep = np.ones(len(rows.t), np.bool_)
        told: list[tuple[int, Refusal]] = []
        z = rows.z
        for sensor, limits in LIMITS.items():
            mine = np.flatnonzero(rows.sensor == sensor)
            if not len(mine):
                continue
            for limit in limits:
                values = rows.z[np.ix_(mine, np.array(limit.columns))]
                missing = np.isnan(values)
                with np.errstate(invalid="ignore"):
                    bad = ~missing & ~((values >= limit.low) & (values <= limit.high))
                if limit.whole:
                    keep[mine[(missing | bad).any(axis=1)]] = False
                if bad.any():
                    z = z.copy() if z is rows.z else z
                    at, column = np.nonzero(bad)
                    z[mine[at], np.array(limit.columns)[column]] = np.nan
                    text = f"{limit.quantity} of {values[at[0], column[0]]:.3g} {limit.unit}"
                    self._tell(told, rows, mine[np.unique(at)], (sensor, limit.quantity), text)
            if sensor in SIGMAS:
                values = rows.r[np.ix_(mine, np.array(SIGMAS[sensor]))]
                at, column = np.nonzero(~((values > SIGMA[0]) & (values < SIGMA[1])))
                if len(at):
                    keep[mine[at]] = False
                    text = f"standard deviation of {values[at[0], column[0]]:.3g}"
                    self._tell(told, rows, mine[np.unique(at)], (sensor, "standard deviation"), text)
        if z is not rows.z:
            rows = rows._replace(z=z)
        if not keep.all():
            rows = take(rows, keep)
        return rows, [refusal for _, refusal in sorted(told)]

    @staticmethod
    def _doubtful(rows: Rows) -> bool:
        """Whether there is anything to be left out; as a rule there is not, and this is quick."""
        return _strange(rows.z, rows.r, rows.sensor, _LOW, _HIGH, _WHOLE, _STATED)

    def _tell(
        self, told: list[tuple[int, Refusal]], rows: Rows, at: NDArray[np.intp], key: tuple[int, str], text: str
    ) -> None:
        if not self._count[key]:
            i = int(at[0])
            words = f"{SENSORS[key[0]]}: {text} is impossible: left out"
            told.append((i, Refusal(words, int(rows.t[i]), int(rows.t_rx[i]))))
        self._count[key] += len(at)

    def sums(self) -> list[str]:
        """How many samples of each kind had to be left out, where it was more than the one that has been told."""
        return [
            f"{SENSORS[sensor]}: {count} samples with an impossible {quantity} left out"
            for (sensor, quantity), count in sorted(self._count.items())
            if count > 1
        ]
