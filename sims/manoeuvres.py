"""A flight plan as data: segments in order, some of them test points, some with a test input.

Examples
--------
>>> plan = PLANS["demo"]
>>> [point.name for point in plan.test_points()]
['TP 1', 'TP 2', 'TP 3']
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal, NamedTuple

Axis = Literal["elevator", "aileron", "rudder"]


class PlanError(ValueError):
    """The plan is not known, or its duration makes no sense."""


class Input(NamedTuple):
    """A test input: steps of alternating sign on one control.

    Attributes
    ----------
    axis : str
        ``elevator``, ``aileron`` or ``rudder``.
    steps : tuple of float
        Length of each step in units; the sign alternates from step to step.
    unit : float
        Length of a unit (s).
    amplitude : float
        Of the first step (normalised command of the light single, scaled by the airframe's factor for the axis;
        positive elevator is nose down).
    delay : float
        From the start of the segment (s).
    gain : float
        What is left of the autopilot's feedback about this axis from the delay to the end of the segment.
    """

    axis: Axis
    steps: tuple[float, ...]
    unit: float
    amplitude: float
    delay: float = 2.0
    gain: float = 0.2

    def at(self, t: float) -> float:
        """Return the command (normalised) `t` seconds after the segment's start."""
        elapsed, sign = (t - self.delay) / self.unit, 1.0
        for length in self.steps if elapsed >= 0.0 else ():
            if elapsed < length:
                return sign * self.amplitude
            elapsed, sign = elapsed - length, -sign
        return 0.0

    def active(self, t: float) -> bool:
        """Say whether the feedback is cut at `t` seconds after the segment's start."""
        return t >= self.delay


def three_two_one_one(axis: Axis = "elevator", unit: float = 0.6, amplitude: float = -0.08, **rest: float) -> Input:
    """Return a 3-2-1-1: broad in frequency and almost free of a mean, so that the flight condition is kept."""
    return Input(axis, (3.0, 2.0, 1.0, 1.0), unit, amplitude, **rest)


def doublet(axis: Axis = "aileron", unit: float = 1.0, amplitude: float = 0.15, **rest: float) -> Input:
    """Return one step each way."""
    return Input(axis, (1.0, 1.0), unit, amplitude, **rest)


class Segment(NamedTuple):
    """One stretch of flight.

    Attributes
    ----------
    name : str
        What is flown.
    duration : float
        Seconds.
    bank : float
        Bank angle (rad).
    climb : float
        Climb rate as a fraction of the one that the airframe sustains; 0 holds the altitude of the segment's start.
    airspeed : float
        Factor on the trimmed true airspeed.
    input : Input or None
        A test input.
    test_point : str or None
        Name of the test point that this segment belongs to. Neighbours with the same name are one test point.
    load : tuple of (float, float)
        Seconds from the start of the segment and load factor, linear in between: the elevator holds it, and the height
        goes where it goes. In a turn the bank is then the one at which this load factor would keep the height, and
        `bank` its limit and direction.
    """

    name: str
    duration: float
    bank: float = 0.0
    climb: float = 0.0
    airspeed: float = 1.0
    input: Input | None = None
    test_point: str | None = None
    load: tuple[tuple[float, float], ...] = ()

    def load_at(self, t: float) -> float:
        """Return the load factor asked for `t` seconds after the segment's start."""
        before = self.load[0]
        for after in self.load:
            if t < after[0]:
                share = (t - before[0]) / (after[0] - before[0]) if after[0] > before[0] else 0.0
                return before[1] + share * (after[1] - before[1])
            before = after
        return before[1]


class Point(NamedTuple):
    """A test point, and when it is flown: seconds from the start of the plan."""

    name: str
    start: float
    stop: float


class Plan(NamedTuple):
    """Segments in the order in which they are flown."""

    name: str
    segments: tuple[Segment, ...]

    @property
    def duration(self) -> float:
        """Length of the plan (s)."""
        return math.fsum(segment.duration for segment in self.segments)

    def at(self, t: float) -> tuple[int, float]:
        """Return the segment's index at `t` seconds and the time since its start; the last one goes on for ever."""
        start = 0.0
        for index, segment in enumerate(self.segments):
            if t < start + segment.duration or index == len(self.segments) - 1:
                return index, t - start
            start += segment.duration
        raise PlanError(f"plan {self.name!r} has no segments")

    def test_points(self) -> list[Point]:
        """Return the test points in order."""
        points: list[Point] = []
        start, before = 0.0, None
        for segment in self.segments:
            stop = start + segment.duration
            if segment.test_point is not None and segment.test_point == before:
                points[-1] = points[-1]._replace(stop=stop)
            elif segment.test_point is not None:
                points.append(Point(segment.test_point, start, stop))
            start, before = stop, segment.test_point
        return points


def _plan(name: str, segments: Sequence[Segment]) -> Plan:
    return Plan(name, tuple(segments))


def push_pull(test_point: str | None = None) -> Segment:
    """Return a push-over, a pull-up and a push-over: a wide range of alpha, with the wings level."""
    # Push, pull twice as long, push: climb rate and height end about where they began.
    times = (0.0, 1.0, 1.8, 3.2, 4.8, 7.6, 9.2, 10.6, 11.4)
    load = tuple(zip(times, (1.0, 1.0, 0.5, 0.5, 1.5, 1.5, 0.5, 0.5, 1.0), strict=True))
    return Segment("push-over and pull-up", 13.0, load=load, test_point=test_point)


def wind_up_turn(seconds: float = 34.0, load: float = 1.7, test_point: str | None = None) -> Segment:
    """Return a turn that tightens, holds and unwinds: load factor, alpha and heading together."""
    third = seconds / 3.0
    profile = ((0.0, 1.0), (1.0, 1.0), (third, load), (2.4 * third, load), (2.8 * third, 1.0))
    return Segment("wind-up turn", seconds, bank=math.radians(75.0), load=profile, test_point=test_point)


def bank_to_bank(test_point: str | None = None) -> list[Segment]:
    """Return bank to the right, to the left and back, 30 deg."""
    right, left = (Segment(f"bank {side}", 6.0, test_point=test_point) for side in ("right", "left"))
    level = Segment("wings level", 5.0, test_point=test_point)
    return [right._replace(bank=_BANK), left._replace(bank=-_BANK), level]


def _pitch(seconds: float = 9.0, test_point: str | None = None) -> Segment:
    return Segment("3-2-1-1 in pitch", seconds, input=three_two_one_one(delay=1.0), test_point=test_point)


def _roll(seconds: float = 6.0, test_point: str | None = None) -> Segment:
    return Segment("aileron doublet", seconds, input=doublet(delay=1.0), test_point=test_point)


def _yaw(seconds: float = 7.0, test_point: str | None = None) -> Segment:
    return Segment("rudder doublet", seconds, input=doublet("rudder", amplitude=0.2, delay=1.0), test_point=test_point)


def _level(seconds: float) -> Segment:
    return Segment("straight and level", seconds)


_BANK = math.radians(30.0)
_STEEP = math.radians(45.0)

PLANS: dict[str, Plan] = {
    plan.name: plan
    for plan in (
        _plan(
            "demo",
            [
                Segment("straight and level", 20.0),
                Segment("level turn right", 24.0, bank=_BANK, test_point="TP 1"),
                Segment("level turn left", 26.0, bank=-_BANK, test_point="TP 1"),
                Segment("roll out", 14.0),
                Segment("climb", 36.0, climb=1.0, test_point="TP 2"),
                Segment("level off", 16.0),
                Segment("3-2-1-1 in pitch", 14.0, input=three_two_one_one(), test_point="TP 3"),
                Segment("back to level", 20.0),
            ],
        ),
        _plan("level", [Segment("straight and level", 60.0)]),
        _plan(
            "turn",
            [
                Segment("straight and level", 10.0),
                Segment("level turn right", 30.0, bank=_BANK, test_point="TP 1"),
                Segment("roll out", 20.0),
            ],
        ),
        _plan(
            "inputs",
            [
                Segment("straight and level", 10.0),
                Segment("3-2-1-1 in pitch", 14.0, input=three_two_one_one(), test_point="TP 1"),
                Segment("recover", 16.0),
                Segment("aileron doublet", 10.0, input=doublet(), test_point="TP 2"),
                Segment("recover", 16.0),
                Segment("rudder doublet", 10.0, input=doublet("rudder", amplitude=0.2), test_point="TP 3"),
                Segment("recover", 14.0),
            ],
        ),
        _plan("3-2-1-1", [_level(5.0), _pitch(10.0, "TP 1"), _level(10.0)]),
        _plan("doublets", [_level(5.0), _roll(7.0, "TP 1"), _level(6.0), _yaw(8.0, "TP 2"), _level(9.0)]),
        _plan("bank-to-bank", [_level(5.0), *bank_to_bank("TP 1"), _level(8.0)]),
        _plan("push-pull", [_level(5.0), push_pull("TP 1"), _level(14.0)]),
        _plan("wind-up-turn", [_level(5.0), wind_up_turn(test_point="TP 1"), _level(11.0)]),
        _plan(
            "calibration",
            [
                _level(4.0),
                _pitch(),
                _roll(),
                _yaw(),
                *bank_to_bank(),
                push_pull(),
                _level(6.0),
                wind_up_turn(36.0),
                _level(8.0),
            ],
        ),
        _plan(
            "straight",
            [
                _level(5.0),
                _pitch(11.0),
                _roll(8.0),
                _yaw(9.0),
                *bank_to_bank(),
                push_pull(),
                _level(10.0),
                _pitch(11.0),
                _yaw(9.0),
                _level(9.0),
            ],
        ),
        _plan(
            "turn-record",
            [
                _level(5.0),
                push_pull(),
                _level(8.0),
                Segment("level turn right", 40.0, bank=_STEEP),
                Segment("level turn left", 26.0, bank=-_STEEP),
                Segment("roll out", 10.0),
            ],
        ),
        _plan(
            "points",
            [
                _level(8.0),
                _pitch(12.0, "TP 1"),
                _level(8.0),
                _roll(8.0, "TP 2"),
                _yaw(9.0, "TP 2"),
                _level(8.0),
                *bank_to_bank("TP 3"),
                _level(9.0),
                push_pull("TP 4"),
                _level(12.0),
                wind_up_turn(36.0, test_point="TP 5"),
                _level(12.0),
            ],
        ),
    )
}
"""The plans that can be flown by name."""


def find(plan: str | Plan) -> Plan:
    """Return `plan` itself, or the plan of that name.

    Raises
    ------
    PlanError
        No plan of that name.
    """
    if isinstance(plan, Plan):
        return plan
    if plan not in PLANS:
        raise PlanError(f"unknown plan {plan!r}; known: {', '.join(sorted(PLANS))}")
    return PLANS[plan]
