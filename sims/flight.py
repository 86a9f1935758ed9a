"""Fly a plan: aircraft, autopilot and recorder together, and what the sensors made of it."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import msgspec
import numpy as np

from sims import aircraft as jsb
from sims import autopilot, manoeuvres
from sims import sensors as suite
from sims.grades import Arms, Grade
from sims.truth import Times, Truth

if TYPE_CHECKING:
    from sims.aircraft import Aircraft, Place, State
    from sims.autopilot import Autopilot, Targets
    from sims.earth import Planet
    from sims.manoeuvres import Plan, Segment

BOOT = 4_000_000_000
"""Vehicle time of the first record (ns since boot)."""

WIND = (-3.0, 4.0)
"""Default steady wind: 5 m/s, north and east components, the way the air moves (m/s)."""

_RAMP, _SETTLE = 10.0, 30.0


class Mark(NamedTuple):
    """A line in the pilot's log: vehicle time (ns since boot) and text such as ``TP 1 start``."""

    t: int
    text: str


@dataclasses.dataclass(frozen=True, slots=True)
class Flight:
    """A flight that has been flown.

    Attributes
    ----------
    aircraft : str
        Name of the JSBSim model.
    plan : Plan
        What was flown.
    seed : int
        Of turbulence and sensor errors.
    truth : Truth
        What the aircraft did.
    sensors : Sensors
        What its sensors said.
    marks : tuple of Mark
        Starts and stops of test points.
    start_utc : int
        UTC of the first record (ns since the Unix epoch).
    wind : (float, float)
        Steady wind, north and east (m/s, the way the air moves).
    """

    aircraft: str
    plan: Plan
    seed: int
    truth: Truth
    sensors: suite.Sensors
    marks: tuple[Mark, ...]
    start_utc: int
    wind: tuple[float, float] = WIND

    @property
    def utc(self) -> Times:
        """UTC of every record of the truth (N,), ns; the times of `sims.messages` are among them or between them."""
        return np.asarray(self.start_utc + (self.truth.t - self.truth.t[0]))

    def save(self, path: str | Path) -> None:
        """Write the truth and what the sensors were to an .npz, which `sims.Truth.load` reads as well."""
        said = self.sensors
        about = _About(
            self.aircraft,
            self.plan,
            self.seed,
            self.start_utc,
            self.wind,
            said.grade,
            said.arms,
            said.latencies,
            said.dropouts,
        )
        self.truth.save(path, flight=msgspec.json.encode(about).decode())

    @classmethod
    def load(cls, path: str | Path) -> Flight:
        """Read what `save` wrote; the sensors say the same again, bit for bit.

        Raises
        ------
        ValueError
            The file holds no flight, or one of another version.
        """
        truth = Truth.load(path)
        with np.load(path, allow_pickle=False) as file:
            if "flight" not in file:
                raise ValueError(f"{path} holds a truth record but no flight: fly it with sims.fly and Flight.save it")
            text = str(file["flight"])
        try:
            about = msgspec.json.decode(text, type=_About)
        except msgspec.DecodeError as error:
            raise ValueError(f"{path} is a flight of another version ({error}): fly it again") from None
        sensors = suite.sense(
            truth, about.grade, seed=about.seed, arms=about.arms, latencies=about.latencies, dropouts=about.dropouts
        )
        seconds = (len(truth) - 1) / truth.rate
        return cls(
            about.aircraft,
            about.plan,
            about.seed,
            truth,
            sensors,
            _marks(about.plan, seconds),
            about.start_utc,
            about.wind,
        )


class _About(NamedTuple):
    """What a file says about a flight beside its truth."""

    aircraft: str
    plan: manoeuvres.Plan
    seed: int
    start_utc: int
    wind: tuple[float, float]
    grade: Grade
    arms: Arms
    latencies: dict[str, float]
    dropouts: tuple[tuple[str, float, float], ...]


def fly(
    aircraft: str = "c172x",
    plan: str | Plan = "demo",
    *,
    sensors: str | suite.Grade = "mems",
    seed: int = 1,
    duration: float | None = None,
    altitude: float | None = None,
    airspeed: float | None = None,
    place: Place | None = None,
    planet: Planet = "wgs84",
    wind: tuple[float, float] = WIND,
    turbulence: int = 0,
    record_rate: int | None = None,
    latencies: Mapping[str, float] | None = None,
    dropouts: Sequence[suite.Dropout] = (),
    start_utc: int | None = None,
) -> Flight:
    """Fly a plan and listen to the sensors.

    The same arguments give the same flight bit for bit, `start_utc` aside.

    Parameters
    ----------
    aircraft : str
        JSBSim model, one of `sims.aircraft.AIRFRAMES`.
    plan : str or Plan
        One of `sims.manoeuvres.PLANS`, or a plan of your own.
    sensors : str or Grade
        ``mems`` or ``fti``, or a grade of your own.
    seed : int
        Of turbulence and sensor errors.
    duration : float, optional
        Seconds to fly; shorter than the plan cuts it, longer goes on with its last segment.
    altitude, airspeed : float, optional
        Trimmed height (m) and true airspeed (m/s); the airframe's own by default.
    place : Place, optional
        Where the flight starts.
    planet : str
        ``wgs84``, or ``flat`` for textbook equations of motion: constant gravity, no rotation (`sims.earth`).
    wind : (float, float)
        Steady wind, north and east (m/s, the way the air moves).
    turbulence : int
        Severity 0 (calm) .. 7 of MIL-F-8785C; its tables leave the air above some 3000 m calm at 1 and 2.
    record_rate : int, optional
        Truth records per second; divides 400. The IMU's rate by default.
    latencies : dict of str to float, optional
        Seconds by which the samples of a sensor are older than their stamps, as ``{"gnss": 0.2}``.
    dropouts : sequence of (str, float, float)
        Sensor, and when it falls silent and speaks again (s from the first record), as ``[("gnss", 20, 30)]``.
    start_utc : int, optional
        UTC of the first record (ns since the Unix epoch); now by default.

    Raises
    ------
    AircraftError, PlanError, SensorError
        Unknown aircraft, plan or sensors; no trim; a duration that is not positive.
    """
    flown = manoeuvres.find(plan)
    grade = suite.find(sensors)
    seconds = flown.duration if duration is None else duration
    if not seconds > 0.0:
        raise manoeuvres.PlanError(f"a flight takes a positive number of seconds, not {seconds}")
    record_rate = grade.rates.imu if record_rate is None else record_rate
    if record_rate < 1 or jsb.RATE % record_rate:
        raise manoeuvres.PlanError(f"the record rate must divide {jsb.RATE} Hz: {record_rate} does not")
    plane = jsb.Aircraft(aircraft, altitude=altitude, airspeed=airspeed, place=place, planet=planet, seed=seed)
    truth = _record(plane, flown, seconds, record_rate, wind, turbulence)
    return Flight(
        aircraft=aircraft,
        plan=flown,
        seed=seed,
        truth=truth,
        sensors=suite.sense(truth, grade, seed=seed, latencies=latencies, dropouts=dropouts),
        marks=_marks(flown, seconds),
        start_utc=time.time_ns() if start_utc is None else start_utc,
        wind=wind,
    )


def _marks(plan: Plan, seconds: float) -> tuple[Mark, ...]:
    """Return the marks up to the end of the flight; a test point that it cuts has no stop."""
    events = [(p.start, f"{p.name} start") for p in plan.test_points()]
    events += [(p.stop, f"{p.name} stop") for p in plan.test_points()]
    return tuple(Mark(BOOT + round(t * 1e9), text) for t, text in sorted(events) if t <= seconds)


class _Pilot:
    """Turns the plan's segments into targets and flies them."""

    def __init__(self, plane: Aircraft, plan: Plan) -> None:
        self._plane, self._plan = plane, plan
        self._autopilot: Autopilot = autopilot.Autopilot(plane.airframe, plane.trim, plane.trim_theta, plane.trim_alpha)
        self._altitude = plane.altitude
        self._climbing = False
        self.segment = 0

    def settle(self, seconds: float, wind: tuple[float, float], turbulence: int) -> None:
        """Fly straight and level while the wind comes up: the trim is for still air only."""
        targets = autopilot.Targets(altitude=self._altitude, airspeed=self._plane.airspeed)
        for step in range(round(seconds * jsb.RATE)):
            if step % (jsb.RATE // autopilot.RATE) == 0:
                share = min(1.0, step / (jsb.RATE * _RAMP))
                self._plane.set_wind(wind[0] * share, wind[1] * share)
                self._plane.command(self._autopilot.command(self._plane.state(), targets))
            if step == round(_RAMP * jsb.RATE):
                self._plane.set_turbulence(turbulence)
            self._plane.step()

    def act(self, t: float) -> None:
        """Command the controls `t` seconds into the plan."""
        state = self._plane.state()
        self.segment, since = self._plan.at(t)
        segment = self._plan.segments[self.segment]
        if segment.climb or segment.load:
            self._climbing = True
        elif self._climbing:
            # The height a push-over from this climb rate ends at; holding today's height would overshoot.
            self._altitude = state.altitude + 2.0 * state.climb_rate
            self._climbing = False
        self._plane.command(self._autopilot.command(state, self._targets(segment, since, state)))

    def _targets(self, segment: Segment, since: float, state: State) -> Targets:
        if segment.load:
            load = 1.0 + (segment.load_at(since) - 1.0) * self._plane.airframe.agility
            return autopilot.Targets(bank=_bank(segment, load, state), airspeed=self._plane.airspeed, load=load)
        targets = autopilot.Targets(
            bank=segment.bank,
            airspeed=self._plane.airspeed * segment.airspeed,
            altitude=None if segment.climb else self._altitude,
            climb_rate=segment.climb * self._plane.airframe.climb if segment.climb else None,
        )
        test = segment.input
        if test is None or not test.active(since):
            return targets
        gain, value = test.gain, test.at(since)
        airframe = self._plane.airframe
        match test.axis:
            case "elevator":
                return targets._replace(pitch_gain=gain, input_elevator=value * airframe.pitch * airframe.stick)
            case "aileron":
                return targets._replace(roll_gain=gain, yaw_gain=gain, input_aileron=value * airframe.roll)
            case "rudder":
                return targets._replace(roll_gain=gain, yaw_gain=gain, input_rudder=value * airframe.yaw)


def _bank(segment: Segment, load: float, state: State) -> float:
    """Return the bank angle (rad) at which this load factor keeps the height; wings level where none is asked for."""
    level = math.acos(1.0 / max(load, 1.0))
    # Steeper in a climb and shallower in a descent, so that the height stays about where it was.
    correction = 2.0 * state.climb_rate / max(state.airspeed, 1.0) * min(1.0, level / 0.5)
    return math.copysign(min(max(level + correction, 0.0), abs(segment.bank)), segment.bank)


def _record(
    plane: Aircraft, plan: Plan, seconds: float, rate: int, wind: tuple[float, float], turbulence: int
) -> Truth:
    """Fly `plan` for `seconds` and return `rate` records per second, both ends included."""
    pilot = _Pilot(plane, plan)
    pilot.settle(_SETTLE, wind, turbulence)
    every, act = jsb.RATE // rate, jsb.RATE // autopilot.RATE
    rows: list[list[float]] = []
    inertial = [plane.inertial()]
    segments: list[int] = []
    # One interval before the first record, so that it has its interval mean too.
    for step in range(-every, round(seconds * rate) * every + 1):
        if step % every == 0 and step >= 0:
            rows.append(plane.columns())
            segments.append(plan.at(step / jsb.RATE)[0])
        if step % act == 0:
            pilot.act(max(0.0, step / jsb.RATE))
        plane.step()
        inertial.append(plane.inertial())
    return _truth(plane, np.array(rows), np.array(inertial), np.array(segments, np.int64), every)


def _truth(plane: Aircraft, rows: np.ndarray, inertial: np.ndarray, segments: np.ndarray, every: int) -> Truth:
    """Arrange columns; `inertial` starts one record interval before the first row, at 400 Hz."""
    n = len(rows)
    c = dict(zip(jsb.Aircraft.column_names(), rows.T, strict=True))
    point = inertial[every : every * n + 1 : every]
    # Trapezoid: what an integrating IMU reports for the interval that ends at the record.
    middle = 0.5 * (inertial[:-1] + inertial[1:])
    mean = middle[: every * n].reshape(n, every, 6).mean(axis=1)
    airspeed = np.sqrt(c["u_air"] ** 2 + c["v_air"] ** 2 + c["w_air"] ** 2)
    latitude, longitude = plane.on_map(c["latitude"], c["longitude"])
    record = every * 1_000_000_000 // jsb.RATE

    def stack(*names: str) -> np.ndarray:
        return np.stack([c[name] for name in names], axis=1)

    return Truth(
        t=BOOT + record * np.arange(n, dtype=np.int64),
        latitude=latitude.copy(),
        longitude=longitude.copy(),
        altitude=c["altitude"].copy(),
        velocity=stack("velocity_north", "velocity_east", "velocity_down"),
        attitude=stack("phi", "theta", "psi"),
        rates=point[:, 3:].copy(),
        specific_force=point[:, :3].copy(),
        mean_rates=mean[:, 3:].copy(),
        mean_specific_force=mean[:, :3].copy(),
        airspeed=airspeed,
        alpha=np.arctan2(c["w_air"], c["u_air"]),
        beta=np.arcsin(c["v_air"] / airspeed),
        wind=stack("wind_north", "wind_east", "wind_down"),
        pressure=c["pressure"].copy(),
        temperature=c["temperature"].copy(),
        controls=stack("elevator", "aileron", "rudder", "throttle"),
        segment=segments,
        planet=plane.planet,
        aircraft=plane.name,
    )
