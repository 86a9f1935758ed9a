"""The extended information smoother beside the textbook extended RTS of the same model: time per step.

Sensors at the rates of flight-test instrumentation, inertial sensors at 100 Hz. Both are compiled, linearise at the
same places and say the same; how nearly, is part of the answer. They run in one process, one after the other and round
after round on the same arrays, so that a busy moment of the machine meets both alike; the least time counts. What the
first calls compile is not timed, and room for the results is made before.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from estimator import extended, kinematics, rotation
from estimator.extended import About, Carry, Drive, Flags, Rows, Told
from estimator.models.flight_path import FlightPath, Settings
from estimator.rivals import extended_rts

if TYPE_CHECKING:
    from rich.table import Table

Array = NDArray[np.float64]
Mode: TypeAlias = Literal["I", "P", "G"]

MODES: tuple[Mode, ...] = ("I", "P", "G")
EVERY = (5, 2, 2, 2, 2, 2, 5, 20, 20, 20)  # samples of the inertial sensors, 100 Hz, to one of each measurement
DT = 0.01
TOLD = 4  # steps to one whose standard deviations the stage tells
SLOW = 20  # steps in which wind and biases walk once
WINDOW = 100  # steps
SPEED = 60.0  # m/s
MODE_P = (0, 1, 2, 3, 4, 6)  # measurements of Shi's paper
NO_AIR = tuple(range(3, kinematics.M))


class Record(NamedTuple):
    """A simulated record of one mode.

    Attributes
    ----------
    path : FlightPath
    drive : Drive
    carry : Carry
        The start, without any step.
    scalars : float
        Measurements per step.
    """

    path: FlightPath
    drive: Drive
    carry: Carry
    scalars: float


@dataclass(frozen=True)
class Timing:
    """Microseconds per step.

    Attributes
    ----------
    mode, task : str
    n, p : int
        States and noise components.
    scalars : float
        Measurements per step.
    ours : float
    rival : float or None
        The extended RTS; None: it has no such task.
    ratio : float or None
        Of the rival's time to ours.
    """

    mode: str
    task: str
    n: int
    p: int
    scalars: float
    ours: float
    rival: float | None
    ratio: float | None


@dataclass(frozen=True)
class Comparison:
    """What was measured.

    Attributes
    ----------
    steps, rounds, window : int
    cores : int
    load : str
        Load averages before and after.
    gap : dict
        By mode: the largest deviation of the two, of means in sigma and of standard deviations relatively.
    timings : list of Timing
    """

    steps: int
    rounds: int
    window: int
    cores: int
    load: str
    gap: dict[str, float]
    timings: list[Timing]

    def table(self) -> Table:
        """Time by task and mode."""
        from rich.table import Table

        table = Table(
            title="microseconds per step: ours / extended RTS (times ours)", title_justify="left",
            caption=f"{self.steps} steps at {1 / DT:.0f} Hz, windows of {self.window}, least of {self.rounds} rounds; "
            "standard deviations at every step where they are named", caption_justify="left",
        )  # fmt: skip
        modes = list(dict.fromkeys(t.mode for t in self.timings))
        found = {(t.task, t.mode): t for t in self.timings}
        table.add_column("")
        for mode in modes:
            one = next(t for t in self.timings if t.mode == mode)
            table.add_column(f"mode {mode}: n {one.n}, p {one.p}, m {one.scalars:.1f}", justify="right")
        for task in dict.fromkeys(t.task for t in self.timings):
            table.add_row(task, *(_cell(found[task, mode]) for mode in modes))
        table.add_row("largest deviation, sigma", *(f"{self.gap[mode]:.0e}" for mode in modes))
        return table


def _cell(timing: Timing) -> str:
    if timing.rival is None:
        return f"{timing.ours:.2f}"
    return f"{timing.ours:.2f} / {timing.rival:.2f} ({timing.ratio:.2f}x)"


def record(mode: Mode, steps: int, seed: int = 1) -> Record:
    """A weaving flight in turbulence, and what the sensors of the mode say of it."""
    rng = np.random.default_rng(seed)
    settings = Settings.fti(mode=mode, turbulence=1.0, turbulence_time=5.0)
    path = FlightPath.of(settings, 0.8, 1000.0)
    carry = path.start({"h": 1000.0, "u": SPEED, "theta": 0.05, "psi": 0.3})
    x, q = carry.x.copy(), carry.q.copy()
    x1, q1, phi, b, work = x.copy(), q.copy(), np.empty((7, 7)), np.empty((7, 6)), np.empty(200)
    u, z, r = np.empty((steps, 6)), np.full((steps, 10), np.nan), np.ones((steps, 10))
    bias = np.array([0.02, -0.02, 0.02, 3e-4, -3e-4, 3e-4])
    noise = np.repeat([settings.accelerometer, settings.gyro], 3)
    attitude, heading, gnss = settings.attitude or 1.0, settings.heading or 1.0, settings.gnss_velocity or 1.0
    sigma = np.array([
        settings.airspeed, settings.flow_angle, settings.flow_angle, attitude, attitude, heading, settings.height,
        gnss, gnss, gnss,
    ])  # fmt: skip
    used = MODE_P if mode == "P" else NO_AIR if mode == "I" else range(kinematics.M)
    every = np.array(EVERY)
    r33, y, h = np.empty((3, 3)), np.empty(10), np.empty((10, 23))
    fade = np.exp(-DT / settings.turbulence_time)
    gust = np.zeros(3)
    for i in range(steps):
        t = i * DT
        rotation.matrix(q, r33)
        rate = np.array([0.3 * np.sin(0.9 * t), 0.05 + 0.1 * np.sin(0.5 * t), 0.1 * np.sin(0.2 * t)])
        drag = np.array([0.5 * np.sin(0.3 * t) - 0.02 * (x[1] - SPEED), -0.1 * x[2], -0.3 * x[3]])
        true = np.concatenate([np.cross(rate, x[1:4]) - 9.81 * r33[2] + drag, rate])
        x[7:13] = 0.0
        kinematics.step(x, q, true, DT, path.model.earth, x1, q1, phi, b, work)
        x[:13], q[:] = x1[:13], q1
        gust = fade * gust + settings.turbulence * np.sqrt(1.0 - fade * fade) * rng.normal(size=3)
        x[kinematics.TURBULENCE : kinematics.SCALE] = gust
        u[i] = true + bias + noise * rng.normal(size=6)
        rotation.matrix(q, r33)
        kinematics.observe_air(x, r33, rate, path.model.vane, y[:3], h[:3], work)
        kinematics.observe_attitude(q, y[3:6], h[3:6], work)
        y[6] = x[0]
        kinematics.observe_velocity(x, r33, rate, path.model.antenna, y[7:], h[7:])
        r[i] = sigma**2
        z[i] = np.where(i % every == every - 1, y + sigma * rng.normal(size=10), np.nan)
    for c in range(kinematics.M):
        if c not in used:
            z[:, c] = np.nan
    dt = np.full(steps, DT)
    walks = np.where(np.arange(steps) % SLOW == SLOW - 1, SLOW * dt, 0.0)  # as the stage has it, five times a second
    variances, fades = path.noise(dt, np.tile(noise**2, (steps, 1)), walks)
    drive = Drive(dt, u, variances, fades, z, r, np.zeros(steps, np.uint8), np.ones(steps, np.uint8))
    return Record(path, drive, carry, float(np.isfinite(z).sum() / steps))


class _Ours:
    """The tasks of the information smoother, with room made beforehand."""

    def __init__(self, given: Record) -> None:
        self.given, (count, n) = given, (len(given.drive.dt), given.path.n)
        self.rows, self.told = Rows.empty(count, n, given.path.p), Told.empty(count, n)
        self.x, self.q, self.w = np.empty((count + 1, 23)), np.empty((count + 1, 4)), np.empty((count, 6))
        self.std, self.shown = np.empty((count + 1, n)), np.ones(count + 1, np.uint8)
        self.star, self.vt, self.d = np.empty((n, 1)), np.empty((n, n)), np.empty(n)
        self.quiet = given.drive._replace(shown=np.zeros(count, np.uint8))
        some = np.zeros(count + 1, np.uint8)
        some[::TOLD] = 1
        self.some, self.flown = some, given.drive._replace(shown=some[1:].copy())
        self.carry, self.about = given.carry, About.nothing()

    def filter(
        self, spreads: bool = True, keep: bool = False, about: About | None = None, drive: Drive | None = None
    ) -> None:
        self.carry = self.given.carry.copy()
        if about is not None:  # the prior stays where it was, in coordinates about the trajectory
            x, turned = self.carry.x, np.empty((3, 3))
            rotation.difference(about.q[0], self.given.carry.q, x[4:7])
            rotation.exponential(x[4], x[5], x[6], turned)
            x[1:4] = turned @ self.given.carry.x[1:4]
            self.carry.q[:] = about.q[0]
            self.carry.s[-6:] = x[1:7]
        extended.forward(
            self.given.path.model, drive or (self.given.drive if spreads else self.quiet), about or About.nothing(),
            WINDOW, False, self.carry, keep, self.rows, self.told,
        )  # fmt: skip

    def back(self, spreads: bool = True, shown: Flags | None = None) -> None:
        extended.finish(self.carry, self.star, self.vt, self.d, spreads)
        first = self.given.carry
        extended.backward(
            self.given.path.model, self.rows, self.star, self.vt, self.d, self.shown if shown is None else shown,
            spreads, first.s, first.q, first.x, self.x, self.q, self.w, self.std,
        )  # fmt: skip

    def both(self) -> None:
        self.filter(keep=True)
        self.back()

    def told_at_times(self) -> None:
        self.filter(keep=True, drive=self.flown)
        self.back(shown=self.some)

    def mean(self) -> None:
        self.filter(spreads=False, keep=True)
        self.back(spreads=False)

    def again(self) -> None:
        self.filter(spreads=False, keep=True, about=self.about)
        self.back(spreads=False)


def _measure(given: Record, mode: str, rounds: int) -> tuple[list[Timing], float]:
    """All tasks of one record, interleaved."""
    model, drive, start = given.path.model, given.drive, given.carry.x
    mine = _Ours(given)
    first = extended_rts.Room.of(given.carry, len(drive.dt))
    room = extended_rts.Room.of(given.carry, len(drive.dt))

    def rival_filter() -> None:
        extended_rts.forward(model, drive, start, room)

    def rival_both() -> None:
        room.x[0], room.p[0], room.q[0] = first.x[0], first.p[0], first.q[0]
        extended_rts.forward(model, drive, start, room)
        extended_rts.backward(model, drive, room)

    rival_both()
    mine.both()
    gap = _gap(mine, room)
    told = mine.told
    mine.about = About(
        mine.x.copy(), mine.q.copy(), mine.w.copy(), told.status.copy(), told.r.copy(), told.doubted.copy()
    )
    tasks: dict[str, tuple[Callable[[], None], Callable[[], None] | None]] = {
        "filter and smoother, standard deviations": (mine.both, rival_both),
        "the same told at 25 Hz, as in flight": (mine.told_at_times, rival_both),
        "filter, standard deviations": (mine.filter, rival_filter),
        "filter, means": (lambda: mine.filter(spreads=False), None),
        "filter and smoother, means": (mine.mean, None),
        "another pass about the result, means": (mine.again, None),
    }
    best: dict[tuple[str, int], float] = {}
    for turn in range(rounds + 1):
        for task, runs in tasks.items():
            for side, run in enumerate(runs):
                if run is None:
                    continue
                if run is rival_filter:
                    room.x[0], room.p[0], room.q[0] = first.x[0], first.p[0], first.q[0]
                begin = time.perf_counter()
                run()
                spent = time.perf_counter() - begin
                if turn:
                    best[task, side] = min(best.get((task, side), spent), spent)
    scale = 1e6 / len(drive.dt)
    found = []
    for task in tasks:
        ours, rival = best[task, 0] * scale, best[task, 1] * scale if (task, 1) in best else None
        ratio = None if rival is None else rival / ours
        found.append(Timing(mode, task, given.path.n, given.path.p, given.scalars, ours, rival, ratio))
    return found, gap


def _gap(mine: _Ours, room: extended_rts.Room) -> float:
    """Largest deviation of smoothed means in sigma, and of their standard deviations relatively."""
    model, shape = mine.given.path.model, mine.std.shape
    one, other = np.empty(shape), np.empty(shape)
    extended.named(model, mine.x, mine.q, False, one)
    extended.named(model, room.x, room.q, True, other)
    apart = one - other
    apart[:, 4:7] -= 2.0 * np.pi * np.round(apart[:, 4:7] / (2.0 * np.pi))
    return float(np.maximum(np.abs(apart / room.std), np.abs(mine.std / room.std - 1.0)).max())


def compare(
    steps: int = 3000, rounds: int = 7, *, modes: Sequence[Mode] = MODES, tell: Callable[[str], None] | None = None
) -> Comparison:
    """Measure every mode.

    Parameters
    ----------
    steps : of the records, 100 Hz
    rounds : beside the one that compiles; the least time counts
    modes : of the flight path
    tell : called with a line about what is being done

    Raises
    ------
    ValueError
        ``steps`` or ``rounds`` is below 1.
    """
    if steps < 1 or rounds < 1:
        raise ValueError(f"steps are {steps} and rounds {rounds}: at least one of each is needed")
    before = _load()
    timings: list[Timing] = []
    gaps: dict[str, float] = {}
    for mode in modes:
        if tell:
            tell(f"mode {mode}")
        found, gaps[mode] = _measure(record(mode, steps), mode, rounds)
        timings += found
    return Comparison(steps, rounds, WINDOW, os.cpu_count() or 1, f"{before} {_load()}", gaps, timings)


def _load() -> str:
    return f"{os.getloadavg()[0]:.1f}" if hasattr(os, "getloadavg") else "unknown"
