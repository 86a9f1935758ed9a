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
    """

    name: str
    duration: float
    bank: float = 0.0
    climb: float = 0.0
    airspeed: float = 1.0
    input: Input | None = None
    test_point: str | None = None


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


_BANK = math.radians(30.0)

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
