"""Real flights have no truth, but they have samples that can be withheld: how well are those predicted?

Samples of one sensor are taken out, the flight path is reconstructed from the rest, and what the sensor would have said
is compared with what it did say, its noise included. Linear interpolation between the samples that were left, and the
last of them held, are what needs no model at all. The estimate at a fix is that at the time which the fix is about: its
stamp less the receiver's delay.

What is measured is not the truth. Errors of a receiver that last from one fix to the next are shared by a fix and its
neighbours: interpolation copies them and is praised for it, an estimate of the true velocity is blamed. So two more
numbers stand in the table: the smoother's error at the samples it used, and the correlation of its errors with those
interpolated from the samples on either side, which is near 0 for a sensor with independent errors.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from estimator import Reconstruction, atmosphere, reconstruct
from estimator.models import flight_path
from estimator.stage import Settings
from estimator.stage.rows import KINDS
from sims import points
from telemetry.messages import AirData, Altitude, Gnss, Imu, Message, Progress

if TYPE_CHECKING:
    from rich.table import Table

Floats = NDArray[np.float64]
Times = NDArray[np.int64]
Mask = NDArray[np.bool_]
Sensor = TypeVar("Sensor", bound=Message)

S = 1_000_000_000
DELAY = 0.27  # s by which the satellite fixes of the two public logs are late, as the estimator finds it in either
NOISE = 0.3  # m/s of their airspeed: with 1 m/s its innovations are a quarter as large as they should be
FLYING = 8.0  # m/s of airspeed
SETTLED = 10.0  # s after the start
DENSE = 0.1  # s: estimates further apart are not interpolated
OUTPUT = 0.02  # s between estimates
METHODS = ("filter", "smoother", "linear", "hold last")
VELOCITY, AIRSPEED = ("north", "east", "down"), ("airspeed",)


class Schedule(NamedTuple):
    """Which samples are withheld.

    Attributes
    ----------
    name : str
    kind : type of Message
        `Gnss` or `AirData`.
    away, every : float
        Seconds of silence in so many; 0 of 0: by number.
    one_in : int
        Of which one is kept.
    """

    name: str
    kind: type[Message]
    away: float = 0.0
    every: float = 0.0
    one_in: int = 2

    def mask(self, t: Times) -> Mask:
        """Samples that are withheld, of those at times t (ns)."""
        if not self.every:
            return np.asarray(np.arange(len(t)) % self.one_in != 0)
        phase = (t - t[0]) % round(self.every * S)
        begin = round(0.5 * (self.every - self.away) * S)
        return np.asarray((phase >= begin) & (phase < begin + round(self.away * S)))


SCHEDULES = (
    Schedule("satellite velocity, every other fix", Gnss),
    Schedule("satellite velocity, nine fixes of ten", Gnss, one_in=10),
    Schedule("satellite velocity, 10 s of every 30 s", Gnss, 10.0, 30.0),
    Schedule("airspeed, 2 s of every 10 s", AirData, 2.0, 10.0),
)


@dataclass(frozen=True)
class Withheld:
    """How one log and schedule came out.

    Attributes
    ----------
    log, schedule : str
    samples : int
        That were withheld and could be predicted by every method.
    sigma : float or None
        Noise that the receiver states, median, m/s.
    rmse : dict of dict of float
        By method and component, m/s.
    used : dict of float
        The smoother's at the samples that it used, by component, m/s.
    shared : dict of float
        Correlation of the smoother's errors with those interpolated from the samples it used.
    """

    log: str
    schedule: str
    samples: int
    sigma: float | None
    rmse: dict[str, dict[str, float]]
    used: dict[str, float]
    shared: dict[str, float]


def read(path: str | Path) -> list[Message]:
    """The sensors' samples of the first vehicle in a .tlog file, one message per kind and boot epoch of the most.

    Raises
    ------
    ValueError
        It holds no inertial samples.
    """
    from telemetry.ingest import ingest
    from telemetry.mavlink import Dialect
    from telemetry.sources.tlog import TlogSource

    dialect = Dialect("ardupilotmega")
    source = TlogSource(path, dialect)
    kept = [m for m in ingest(source.batches(), source.links, dialect) if isinstance(m, KINDS) and m.chosen]
    inertial: dict[tuple[int, int], int] = {}
    for message in kept:
        if isinstance(message, Imu):
            key = message.vehicle, message.boot
            inertial[key] = inertial.get(key, 0) + len(message.t)
    if not inertial:
        raise ValueError(f"{path}: no inertial samples, so there is no flight path to withhold anything from")
    key = max(inertial, key=lambda k: inertial[k])
    mine = [m for m in kept if (m.vehicle, m.boot) == key]
    return [
        _joined([m for m in mine if isinstance(m, kind)]) for kind in KINDS if any(isinstance(m, kind) for m in mine)
    ]


def airborne(messages: Iterable[Message]) -> list[Message]:
    """The samples of the longest time in which the airspeed stays above 8 m/s, short dips aside.

    Raises
    ------
    ValueError
        It is never above.
    """
    taken = list(messages)
    air = _one(taken, AirData)
    t, fast = air.t, air.airspeed > FLYING
    if not fast.any():
        raise ValueError(f"the airspeed is never above {FLYING:g} m/s: nothing was flown")
    flown = t[fast]
    breaks = np.flatnonzero(np.diff(flown) > 5 * S)
    first, last = np.concatenate([[0], breaks + 1]), np.concatenate([breaks, [len(flown) - 1]])
    longest = int(np.argmax(flown[last] - flown[first]))
    begin, end = int(flown[first[longest]]), int(flown[last[longest]])
    return [_rows(m, (m.t >= begin) & (m.t <= end)) for m in taken if ((m.t >= begin) & (m.t <= end)).any()]


def predict(messages: list[Message], schedule: Schedule, settings: flight_path.Settings, log: str = "") -> Withheld:
    """Withhold, reconstruct, compare.

    Parameters
    ----------
    messages : list of Message
        One per kind, of one vehicle and boot epoch, from the ground or in flight.
    schedule : Schedule
    settings : flight_path.Settings
        With a delay of the fixes that is given, for every run the same.
    log : str
        Name for the table.

    Raises
    ------
    ValueError
        The log has not the sensor, or the flight path did not begin.
    """
    whole = _one(messages, schedule.kind)
    gone = schedule.mask(whole.t)
    left = [_rows(m, ~gone) if m is whole else m for m in messages]
    end = max(int(m.t_rx[-1]) for m in messages)
    left.append(Progress(vehicle=0, source="", boot=0, t=np.array([end]), t_rx=np.array([end]), final=True))
    found = reconstruct(left, Settings(flight_path=settings, output=OUTPUT))
    components: tuple[str, ...]
    sigma: float | None = None
    if isinstance(whole, Gnss):
        t, said, components = whole.t - round((settings.gnss_delay or 0.0) * S), whole.velocity, VELOCITY
        estimates = [_velocity(found, mean, settings) for mean in (found.filtered, found.smoothed)]
        if settings.gnss_velocity is None:
            sigma = float(np.nanmedian(whole.sigma[:, 2]))
    else:
        assert isinstance(whole, AirData)
        t, said, components = whole.t, _true_airspeed(whole, messages)[:, None], AIRSPEED
        estimates = [_airspeed(found, mean) for mean in (found.filtered, found.smoothed)]
    held = np.zeros(len(t), np.bool_)  # the same value again is the old one
    held[1:] = ((said[1:] == said[:-1]) | np.isnan(said[1:])).all(axis=1)
    given = np.flatnonzero(~np.isnan(said).all(axis=0))  # some receivers do not tell the vertical
    said, names = said[:, given], [components[i] for i in given]
    estimates = [column[:, given] for column in estimates]
    measured = ~np.isnan(said).any(axis=1) & ~held
    if not measured.any():
        raise ValueError(f"{schedule.name}: no {schedule.kind.__name__} measures it")
    kept = measured & ~gone
    wanted = measured & gone & (t >= found.t[0] + round(SETTLED * S))
    wanted &= (t > t[kept][0]) & (t < t[kept][-1]) & _covered(found.t, t)
    at = t[wanted]
    before = np.searchsorted(t[kept], at) - 1
    guesses = [_between(found.t, column, at) for column in estimates]
    guesses += [_between(t[kept], said[kept], at), said[kept][before]]
    error = {m: guess - said[wanted] for m, guess in zip(METHODS, guesses, strict=True)}
    rmse = {m: dict(zip(names, np.sqrt(np.mean(np.square(e), axis=0)).tolist(), strict=True)) for m, e in error.items()}
    near = kept & (t >= found.t[0] + round(SETTLED * S)) & _covered(found.t, t)
    own = _between(found.t, estimates[1], t[near]) - said[near]
    beside = _between(t[near], own, at)
    shared = [float(np.corrcoef(a, b)[0, 1]) for a, b in zip(error["smoother"].T, beside.T, strict=True)]
    used = np.sqrt(np.mean(np.square(own), axis=0)).tolist()
    return Withheld(
        log, schedule.name, int(wanted.sum()), sigma, rmse, dict(zip(names, used, strict=True)),
        dict(zip(names, shared, strict=True)),
    )  # fmt: skip


def compare(
    logs: Iterable[str | Path], settings: flight_path.Settings | None = None, tell: Callable[[str], None] | None = None
) -> list[Withheld]:
    """Every schedule of every log, its airborne part.

    Raises
    ------
    ValueError
        As `read`, `airborne` and `predict`.
    """
    settings = settings or flight_path.Settings(gnss_delay=DELAY, airspeed=NOISE)
    out = []
    for log in logs:
        messages = airborne(read(log))
        for schedule in SCHEDULES:
            if tell:
                tell(f"{Path(log).name}: {schedule.name}")
            out.append(predict(messages, schedule, settings, Path(log).name))
    return out


def table(found: list[Withheld]) -> Table:
    """For people."""
    from rich.table import Table

    out = Table(
        title="withheld samples predicted: RMSE against the measurement, its noise included, m/s", title_justify="left"
    )
    for i, column in enumerate(("log", "withheld", "samples", "", *METHODS, "smoother, used", "shared")):
        out.add_column(column, justify="left" if i < 2 else "right")
    for one in found:
        for i, name in enumerate(one.rmse["filter"]):
            cells = (f"{one.rmse[method][name]:.2f}" for method in METHODS)
            head = (one.log, one.schedule, str(one.samples)) if i == 0 else ("", "", "")
            out.add_row(*head, name, *cells, f"{one.used[name]:.2f}", f"{one.shared[name]:.2f}")
        out.add_section()
    return out


def _one(messages: Iterable[Message], kind: type[Message]) -> Any:
    for message in messages:
        if isinstance(message, kind):
            return message
    raise ValueError(f"no {kind.__name__} among the samples, so there is nothing to withhold")


def _rows(message: Sensor, keep: Mask) -> Sensor:
    names = [n for n in message.__struct_fields__ if isinstance(getattr(message, n), np.ndarray)]
    return msgspec.structs.replace(message, **{name: getattr(message, name)[keep] for name in names})


def _joined(messages: list[Sensor]) -> Sensor:
    """All rows in one message, in order of time."""
    first = msgspec.structs.replace(messages[0], t_sigma=None)  # some told their time and some did not
    names = [n for n in first.__struct_fields__ if isinstance(getattr(first, n), np.ndarray)]
    columns = {name: np.concatenate([getattr(m, name) for m in messages]) for name in names}
    order = np.argsort(columns["t"], kind="stable")
    return msgspec.structs.replace(first, **{name: column[order] for name, column in columns.items()})


def _covered(known: Times, t: Times) -> Mask:
    """Times between two of `known` that are close together."""
    after = np.searchsorted(known, t)
    inside = (after > 0) & (after < len(known))
    after = np.clip(after, 1, len(known) - 1)
    return np.asarray(inside & (known[after] - known[after - 1] < DENSE * S))


def _between(known: Times, column: Floats, t: Times) -> Floats:
    """Rows (k, c) at times t, linear between those at the times known."""
    x, at = (known - known[0]) * 1e-9, (t - known[0]) * 1e-9
    return np.stack([np.interp(at, x, c) for c in column.T], axis=1)


def _velocity(found: Reconstruction, mean: Floats, settings: flight_path.Settings) -> Floats:
    """Velocity of the antenna over ground (k, 3), north, east, down; the turning of the arm is left out where it is 0.

    The angular rate is that between the estimates of attitude.
    """
    turn, first = _turn(found, mean), found.names.index("u")
    body = mean[:, first : first + 3]
    over_ground = np.einsum("kij,kj->ki", turn, body)
    arm = np.array(settings.antenna)
    if arm.any():  # d(R r)/dt
        over_ground = over_ground + np.gradient(turn @ arm, (found.t - found.t[0]) * 1e-9, axis=0)
    return np.asarray(over_ground)


def _airspeed(found: Reconstruction, mean: Floats) -> Floats:
    """What the airspeed sensor would say (k, 1): its scale error multiplies the flow without gusts."""
    at = {name: i for i, name in enumerate(found.names)}
    if "k_airspeed" not in at:
        raise ValueError("the flight path was flown without airspeed, so none can be predicted")
    wind = np.stack([mean[:, at["wind_north"]], mean[:, at["wind_east"]], np.zeros(len(mean))], axis=1)
    gust = mean[:, [at[f"gust_{axis}"] for axis in VELOCITY]]
    turn = _turn(found, mean)
    steady = mean[:, at["u"] : at["u"] + 3] - np.einsum("kji,kj->ki", turn, wind)
    flow = steady - np.einsum("kji,kj->ki", turn, gust)
    speed = np.linalg.norm(flow, axis=1) + mean[:, at["k_airspeed"]] * np.linalg.norm(steady, axis=1)
    return np.asarray(speed[:, None])


def _turn(found: Reconstruction, mean: Floats) -> Floats:
    return points.body_to_ned(mean[:, [found.names.index(name) for name in ("phi", "theta", "psi")]])


def _true_airspeed(air: AirData, messages: list[Message]) -> Floats:
    impact = np.where(
        np.isnan(air.differential_pressure), atmosphere.impact_pressure(air.airspeed), air.differential_pressure
    )
    static = np.full(len(air.t), atmosphere.SEA_LEVEL_PRESSURE)
    for message in messages:
        if isinstance(message, Altitude):
            known = ~np.isnan(message.pressure)
            if known.any():
                static = np.interp(air.t, message.t[known], message.pressure[known])
    return np.asarray(atmosphere.true_airspeed(impact, static))
