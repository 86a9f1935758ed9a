"""How accurate the flight path is, and how honest its error bars: aircraft x manoeuvres x sensors x air, over draws.

Every draw of every case flies through gusts of its own and has sensor errors of its own; in calm air one flight per
plan serves all draws. The two settings of the gust model are fitted per aircraft to the simulator's own gusts, which
nobody can do in flight: the figures are those of a tuned filter. The targets were set before the figures were known.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

import sims
from estimator import reconstruct
from estimator.consistency import LAMP
from estimator.models import flight_path
from estimator.stage import Settings
from sims.experiments import scoring
from sims.experiments.scoring import BIASES, FILTER, HYBRID, KINEMATIC, METHODS, SMOOTHER, WINDOWS, Score

if TYPE_CHECKING:
    from rich.table import Table

    from sims.flight import Flight
    from sims.truth import Truth

SEVERITY = 3
CALM_GUSTS = 0.1  # m/s: nobody knows that the air is quite still
GUSTS = {"c172x": (2.25, 7.0), "737": (1.12, 1.9), "T38": (1.33, 1.9)}
"""Standard deviation of a gust component (m/s) and its correlation time (s), fitted to flights of severity 3."""
LATELY = (1.0, 2.0, 4.0)  # s, at which the correlation of gusts is measured
JOINT = 2  # draws of a case whose covariances are worked out


class Plan(NamedTuple):
    """What is flown: every combination, and how many draws of each; half as many in calm air."""

    aircraft: tuple[str, ...] = ("c172x", "737", "T38")
    plans: tuple[str, ...] = ("straight", "turn-record", "calibration")
    sensors: tuple[str, ...] = ("fti", "mems-vanes")
    airs: tuple[str, ...] = ("gusts", "calm")
    seeds: int = 10
    windows: tuple[float, ...] = WINDOWS


QUICK = Plan(aircraft=("c172x", "737"), plans=("turn-record",), seeds=3)


class Draw(NamedTuple):
    """One flight through one air: scores by sensor set, the gusts it met, alarms on a flat Earth and on the true one.

    Gusts are the standard deviation and correlation at `LATELY` without the mean, and the mean, each by axis.
    """

    aircraft: str
    plan: str
    air: str
    scores: dict[str, Score]
    gusts: dict[str, list[float]]
    flat: int | None
    round: int | None


@dataclass(frozen=True)
class Case:
    """One aircraft, plan, sensor set and air; SI and rad.

    Attributes
    ----------
    rmse : dict of dict of float
        By quantity and method: root of the mean square over time and draws.
    cover, worst_cover : dict of dict of float
        Share of the errors within two sigmas, by method and state: of all draws, and of the worst one.
    nees : dict of dict of float
        By method and state, 1 if the error bars are right.
    joint : dict of float
        Of the kinematic states together, by method.
    z : dict of dict of list of float
        By method and constant, of every draw: error over sigma at the end.
    nis, lag1 : dict of float
        By measured quantity, means over draws.
    moved : float
        Largest number of sigmas by which the hybrid pass moved the scale error of the airspeed.
    """

    aircraft: str
    plan: str
    sensors: str
    air: str
    draws: int
    rmse: dict[str, dict[str, float]]
    cover: dict[str, dict[str, float]]
    worst_cover: dict[str, dict[str, float]]
    nees: dict[str, dict[str, float]]
    joint: dict[str, float]
    z: dict[str, dict[str, list[float]]]
    nis: dict[str, float]
    lag1: dict[str, float]
    moved: float

    @property
    def name(self) -> str:
        """Of the row."""
        return f"{self.aircraft} {self.plan}"


@dataclass(frozen=True)
class Target:
    """What was wanted, what was found, and whether that is enough."""

    what: str
    wanted: str
    found: str
    met: bool


@dataclass(frozen=True)
class Comparison:
    """What was measured.

    Attributes
    ----------
    seeds : int
        Draws of a case in gusts.
    draws : int
        Flights reconstructed, each from every sensor set.
    took : float
        s.
    gusts : dict of dict
        By aircraft: what the filter was told, and what the simulator did.
    cases : list of Case
    flat_alarms, round_alarms : dict of int
        Alarms by aircraft and plan with flight-test sensors in gusts, on a flat Earth without rotation and on WGS-84.
    targets : list of Target
    """

    seeds: int
    draws: int
    took: float
    gusts: dict[str, dict[str, Any]]
    cases: list[Case]
    flat_alarms: dict[str, int]
    round_alarms: dict[str, int]
    targets: list[Target]

    def tables(self) -> list[Table]:
        """Everything, for people."""
        from sims.experiments import truth_print

        return truth_print.tables(self)


def settings(flight: Flight, air: str) -> Settings:
    """What the estimator is told about a simulated flight: grade, places of the sensors, gusts."""
    sigma, tau = GUSTS[flight.aircraft]
    grade = flight_path.Settings.fti if flight.sensors.grade.name == "fti" else flight_path.Settings.mems
    chosen = grade(
        turbulence=CALM_GUSTS if air == "calm" else sigma, turbulence_time=tau, gnss_delay=0.0,
        **flight.sensors.arms.from_imu()._asdict(),
    )  # fmt: skip
    return Settings(flight_path=chosen)


@functools.lru_cache(maxsize=16)
def _flown(aircraft: str, plan: str, severity: int, seed: int) -> Flight:
    return sims.fly(aircraft, plan, sensors="fti", turbulence=severity, seed=seed)


def gusts(truth: Truth, wind: tuple[float, float]) -> dict[str, list[float]]:
    """What the gusts of a flight were, by axis: standard deviation and correlation without the mean, and the mean."""
    moving = truth.wind - np.array([*wind, 0.0])
    mean = moving.mean(axis=0)
    swing = moving - mean
    found = {"std": swing.std(axis=0).tolist(), "mean": mean.tolist()}
    power = np.square(swing).mean(axis=0)
    for seconds in LATELY:
        k = round(seconds * truth.rate)
        found[f"after {seconds:g} s"] = ((swing[k:] * swing[:-k]).mean(axis=0) / power).tolist()
    return found


def draw(tasks: list[tuple[str, str, str, int]], windows: tuple[float, ...], sets: tuple[str, ...], task: int) -> Draw:
    """Fly one task, reconstruct it from every sensor set, and score it."""
    aircraft, plan, air, number = tasks[task]
    seed = 1 + task  # no case shares its draws with another: their means would hide what they have in common
    flown = _flown(aircraft, plan, 0, 1) if air == "calm" else _flown(aircraft, plan, SEVERITY, seed)
    scores, flat, whole = {}, None, None
    for grade in sets:
        flight = sims.redraw(flown, seed, grade)
        chosen = settings(flight, air)
        scores[grade] = scoring.score(flight, chosen, windows=windows, joint=number <= JOINT)
        if grade == "fti" and air == "gusts" and number == 1:
            flat, whole = (_alarms(flight, chosen, earth) for earth in ("flat", "wgs84"))
    found = gusts(flown.truth, flown.wind) if air == "gusts" else {}
    return Draw(aircraft, plan, air, scores, found, flat, whole)


def _alarms(flight: Flight, chosen: Settings, earth: str) -> int:
    from msgspec.structs import replace

    path = replace(chosen.flight_path, earth=earth)
    found = reconstruct(sims.messages(flight), replace(chosen, flight_path=path, iterate=0))
    return len(found.reports[-1].alarms)


def compare(
    plan: Plan | None = None, *, processes: int = 2, progress: Callable[[int, int], None] | None = None
) -> Comparison:
    """Fly, reconstruct and compare everything.

    Parameters
    ----------
    plan : Plan
    processes : int
        How many at once; 1 works in this one.
    progress : callable
        Told how many flights are done, and of how many.

    Raises
    ------
    ValueError
        There is no draw.
    """
    plan = plan or Plan()
    if plan.seeds < 1:
        raise ValueError(f"--seeds is {plan.seeds}: at least one draw is needed")
    begin = time.perf_counter()
    tasks = [
        (aircraft, name, air, number)
        for air in plan.airs for aircraft in plan.aircraft for name in plan.plans
        for number in range(1, 1 + (plan.seeds if air == "gusts" else (plan.seeds + 1) // 2))
    ]  # fmt: skip
    work = functools.partial(draw, tasks, plan.windows, plan.sensors)
    draws = sims.monte_carlo(work, range(len(tasks)), processes, progress)
    cases = [
        _case(aircraft, name, grade, air, [d.scores[grade] for d in draws if d[:3] == (aircraft, name, air)])
        for air in plan.airs for grade in plan.sensors for aircraft in plan.aircraft for name in plan.plans
    ]  # fmt: skip
    flat = {f"{d.aircraft} {d.plan}": d.flat for d in draws if d.flat is not None}
    whole = {f"{d.aircraft} {d.plan}": d.round for d in draws if d.round is not None}
    took = time.perf_counter() - begin
    targets = judge(cases, flat, whole)
    return Comparison(plan.seeds, len(draws), took, _gusts(draws), cases, flat, whole, targets)


def _case(aircraft: str, plan: str, grade: str, air: str, scores: list[Score]) -> Case:
    methods = [m for m in METHODS if m in scores[0].rmse]
    quantities = list(dict.fromkeys(q for m in methods for q in scores[0].rmse[m]))
    rmse = {q: {m: _rms(s.rmse[m][q] for s in scores) for m in methods if q in scores[0].rmse[m]} for q in quantities}
    own = [m for m in methods if scores[0].cover.get(m)]
    return Case(
        aircraft, plan, grade, air, len(scores), rmse,
        {m: {q: _mean(s.cover[m][q] for s in scores) for q in scores[0].cover[m]} for m in own},
        {m: {q: min(s.cover[m][q] for s in scores) for q in scores[0].cover[m]} for m in own},
        {m: {q: _mean(s.nees[m][q] for s in scores) for q in scores[0].nees[m]} for m in own},
        {m: _mean(s.joint[m] for s in scores if s.joint) for m in scores[0].joint},
        {m: {q: [s.z[m][q] for s in scores] for q in scores[0].z[m]} for m in own},
        {q: _mean(s.nis[q] for s in scores) for q in scores[0].nis},
        {q: _mean(s.lag1[q] for s in scores) for q in scores[0].lag1},
        max(s.moved for s in scores),
    )  # fmt: skip


def _gusts(draws: Iterable[Draw]) -> dict[str, dict[str, Any]]:
    out: dict[str, dict[str, Any]] = {}
    met = [d for d in draws if d.gusts]
    for aircraft in dict.fromkeys(d.aircraft for d in met):
        mine = [d.gusts for d in met if d.aircraft == aircraft]
        sigma, tau = GUSTS[aircraft]
        swing = np.sqrt(np.mean(np.square([g["std"] for g in mine]), axis=0))
        drift = np.sqrt(np.mean(np.square([g["mean"] for g in mine]), axis=0))
        found: dict[str, Any] = {"told": {"sigma": sigma, "time": tau}, "std": swing.tolist(), "mean": drift.tolist()}
        for seconds in LATELY:
            name = f"after {seconds:g} s"
            found[name] = np.mean([g[name] for g in mine], axis=0).tolist()
        found["sigma"] = float(np.sqrt(np.mean(swing**2 + drift**2)))
        # What is left after the mean has been taken out falls too fast; the mean's share belongs to the correlation.
        share = found[f"after {LATELY[1]:g} s"] * swing**2 + drift**2
        found["time"] = float(-LATELY[1] / np.log(np.mean(share) / np.mean(swing**2 + drift**2)))
        out[aircraft] = found
    return out


def judge(cases: list[Case], flat: dict[str, int], whole: dict[str, int]) -> list[Target]:
    """Compare with the targets."""
    out = []
    fti, mems = ([c for c in cases if c.sensors == grade] for grade in ("fti", "mems-vanes"))
    rough = [c for c in fti if c.air == "gusts"]

    def add(what: str, wanted: str, found: list[tuple[str, float]], low: float, high: float) -> None:
        if found:
            far = max(found, key=lambda f: max(f[1] - high, low - f[1], key=float))
            missed = [name for name, value in found if not low <= value <= high]
            text = f"{_mean(v for _, v in found):.3g}; worst {far[1]:.3g} ({far[0]})"
            if missed:
                text += f"; {len(missed)} of {len(found)} outside"
            out.append(Target(what, wanted, text, not missed))

    for some, grade, low, high in ((fti, "fti", 0.93, 0.98), (mems, "mems-vanes", 0.90, 1.0)):
        for method in (FILTER, SMOOTHER, HYBRID):
            if grade == "mems-vanes" and method != HYBRID:
                continue
            for air in ("gusts", "calm"):
                mine = [(c.name, _mean(c.cover[method][q] for q in KINEMATIC)) for c in some if c.air == air]
                wanted = f"{low} .. {high}" if high < 1.0 else f">= {low}"
                add(f"{grade}, {air}: coverage of 2 sigma, {method}, per case", wanted, mine, low, high)
    for some, grade in ((fti, "fti"), (mems, "mems-vanes")):
        for method in (FILTER, HYBRID):
            values = [(q, _mean(c.nees[method][q] for c in some)) for q in KINEMATIC if some]
            add(f"{grade}: NEES per state, {method}, mean of the cases", "0.8 .. 1.3", values, 0.8, 1.3)
    for some, grade in ((fti, "fti"), (mems, "mems-vanes")):
        biases = [(q, _rms(z for c in some for z in c.z[HYBRID][q])) for q in BIASES if some]
        add(f"{grade}: z rms of every accelerometer and gyro bias, {HYBRID}, all cases", "0.7 .. 1.5", biases, 0.7, 1.5)
    ratios = [(f"{c.name} {q}", c.rmse[q][SMOOTHER] / c.rmse[q][FILTER]) for c in rough for q in KINEMATIC[1:6]]
    add("fti, gusts: smoother's RMSE over the filter's in u, v, w, theta, phi", "<= 0.7", ratios, 0.0, 0.7)
    if flat:
        silent, false = [n for n, k in flat.items() if not k], [n for n, k in whole.items() if k]
        text = ", ".join(f"{name} {count}" for name, count in flat.items())
        out.append(Target("fti: alarms on a flat Earth without rotation", "at least one each", text, not silent))
        told = f"{len(false)} of {len(whole)}{': ' if false else ''}{', '.join(false)}"
        out.append(Target("fti: alarms on the true Earth", "none", told, not false))
    channels = [(f"{c.sensors} {c.name} {q}", v) for c in cases for q, v in c.nis.items()]
    add("NIS of every channel, per case", f"{LAMP[0]} .. {LAMP[1]}", channels, *LAMP)
    return out


def _mean(values: Iterable[float]) -> float:
    return float(np.mean(list(values)))


def _rms(values: Iterable[float]) -> float:
    return float(np.sqrt(np.mean(np.square(list(values)))))
