"""A small autopilot that flies the segments of a plan.

Proportional and derivative feedback about each axis around the trimmed controls, with slow integrators for altitude
and airspeed. During a test input the gains are cut, so that the aircraft answers with its own dynamics.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from sims.aircraft import Airframe, Controls, State

RATE = 50
"""How often the autopilot acts (Hz)."""

GRAVITY = 9.80665


class Targets(NamedTuple):
    """What the autopilot is asked to hold.

    Attributes
    ----------
    bank : float
        Bank angle (rad), right wing down positive.
    airspeed : float
        True airspeed (m/s).
    altitude : float or None
        Height to hold (m); None: `climb_rate` or `pitch` decides.
    climb_rate : float or None
        Climb rate to hold (m/s, up).
    pitch : float or None
        Pitch attitude to hold (rad).
    load : float or None
        Load factor to hold; goes before everything else in pitch.
    pitch_gain, roll_gain, yaw_gain : float
        Factor on the feedback about each axis; below 1 during a test input.
    input_elevator, input_aileron, input_rudder : float
        Test input added to the commands (normalised).
    """

    bank: float = 0.0
    airspeed: float = 0.0
    altitude: float | None = None
    climb_rate: float | None = None
    pitch: float | None = None
    load: float | None = None
    pitch_gain: float = 1.0
    roll_gain: float = 1.0
    yaw_gain: float = 1.0
    input_elevator: float = 0.0
    input_aileron: float = 0.0
    input_rudder: float = 0.0


class Gains(NamedTuple):
    """Feedback gains; commands are normalised, angles rad, rates rad/s, speeds m/s."""

    theta: float = 2.0
    theta_dot: float = 0.8
    theta_integral: float = 0.7
    phi: float = 1.2
    phi_integral: float = 0.15
    p: float = 0.35
    r: float = 0.5
    beta: float = 0.5
    height: float = 0.20
    climb: float = 1.0
    climb_integral: float = 0.25
    load: float = 0.05
    load_integral: float = 0.25
    load_forward: float = 0.14
    speed: float = 0.06
    speed_integral: float = 0.012


class Autopilot:
    """Feedback around a trimmed flight.

    Parameters
    ----------
    airframe : Airframe
        Its gain factors and climb rate.
    trim : Controls
        Trimmed commands.
    theta, alpha : float
        Pitch attitude and angle of attack in trim (rad).
    """

    BANK_RATE = math.radians(12.0)
    PITCH_LIMIT = math.radians(12.0)

    def __init__(self, airframe: Airframe, trim: Controls, theta: float, alpha: float, gains: Gains | None = None):
        self._airframe = airframe
        self._trim = trim
        self._theta, self._alpha = theta, alpha
        self._gains = Gains() if gains is None else gains
        self._bank = 0.0
        self._climb_integral = 0.0
        self._theta_integral = 0.0
        self._speed_integral = 0.0
        self._bank_integral = 0.0
        self._load_integral = 0.0
        self._climb = 0.0

    def command(self, s: State, targets: Targets) -> Controls:
        """Return the controls for the next 1 / `RATE` seconds."""
        elevator = self._elevator(s, targets)
        aileron, rudder = self._lateral(s, targets)
        return Controls(
            elevator=_clip(elevator + targets.input_elevator, -1.0, 1.0),
            aileron=_clip(aileron + targets.input_aileron, -1.0, 1.0),
            rudder=_clip(rudder + targets.input_rudder, -1.0, 1.0),
            throttle=self._throttle(s, targets),
        )

    def _elevator(self, s: State, targets: Targets) -> float:
        if targets.load is not None:
            return self._elevator_for_load(s, targets.load)
        self._load_integral = 0.0
        g = self._gains
        free = targets.pitch_gain < 1.0
        if targets.pitch is not None:
            theta = targets.pitch
        else:
            theta = self._pitch_for_climb(s, targets, frozen=free)
        # Damp the attitude's rate, not q: a steady turn needs a pitch rate that must not be fought.
        theta_dot = s.q * math.cos(s.phi) - s.r * math.sin(s.phi)
        error = theta - s.theta
        factor = self._airframe.pitch
        if not free:
            self._theta_integral = _clip(self._theta_integral + g.theta_integral * error / RATE, -0.3, 0.3)
        feedback = g.theta * error - g.theta_dot * theta_dot
        return self._trim.elevator - factor * (targets.pitch_gain * feedback + self._theta_integral)

    def _elevator_for_load(self, s: State, load: float) -> float:
        """Return the elevator of a proportional-integral loop on the load factor, damped in pitch rate."""
        g = self._gains
        # Where altitude or climb hold is to take over afterwards.
        self._climb = s.climb_rate
        error = load - s.load
        self._load_integral = _clip(self._load_integral + g.load_integral * error / RATE, -0.5, 0.5)
        # The pitch rate that bends the path at this load factor; damping about zero would fight it.
        wanted = GRAVITY * (load - math.cos(s.theta) * math.cos(s.phi)) / max(s.airspeed, 1.0)
        push = self._airframe.stick * (g.load_forward * (load - 1.0) + g.load * error + self._load_integral)
        return self._trim.elevator - self._airframe.pitch * (self._theta_integral + push - g.theta_dot * (s.q - wanted))

    def _pitch_for_climb(self, s: State, targets: Targets, frozen: bool) -> float:
        """Return the pitch attitude that brings the climb rate to where it is wanted."""
        g = self._gains
        limit = 1.25 * self._airframe.climb
        if targets.altitude is not None:
            wanted = _clip(g.height * (targets.altitude - s.altitude), -limit, limit)
        else:
            wanted = targets.climb_rate or 0.0
        # A climb is entered over a few seconds, as a pilot would.
        step = 0.5 * self._airframe.climb / RATE
        self._climb += _clip(wanted - self._climb, -step, step)
        speed = max(s.airspeed, 1.0)
        gamma = math.asin(_clip(self._climb / speed, -0.3, 0.3))
        error = (self._climb - s.climb_rate) / speed
        if not frozen:
            self._climb_integral = _clip(self._climb_integral + g.climb_integral * error / RATE, -0.1, 0.1)
        load = self._alpha_for_turn(s)
        theta = self._theta + gamma + load + g.climb * error + self._climb_integral
        return _clip(theta, self._theta - self.PITCH_LIMIT, self._theta + self.PITCH_LIMIT)

    def _alpha_for_turn(self, s: State) -> float:
        """Return the extra angle of attack that carries the aircraft's weight in a banked turn (rad)."""
        # Lift grows from zero at about -4 deg for the cambered wings here, so the trim alpha alone says too little.
        alpha = max(self._alpha + math.radians(4.0), math.radians(2.0))
        return alpha * (1.0 / max(math.cos(s.phi), 0.3) - 1.0) * math.cos(s.phi)

    def _lateral(self, s: State, targets: Targets) -> tuple[float, float]:
        g = self._gains
        step = self.BANK_RATE / RATE
        self._bank += _clip(targets.bank - self._bank, -step, step)
        error = self._bank - s.phi
        if targets.roll_gain == 1.0 and self._bank == targets.bank:
            self._bank_integral = _clip(self._bank_integral + g.phi_integral * error / RATE, -0.1, 0.1)
        roll = self._airframe.roll * (g.phi * error - g.p * s.p)
        # Yaw damper about the rate of the coordinated turn at this bank.
        coordinated = GRAVITY * math.sin(s.phi) * math.cos(s.theta) / max(s.airspeed, 1.0)
        # Positive rudder is nose left.
        yaw = self._airframe.yaw * (g.r * (coordinated - s.r) + g.beta * s.beta)
        aileron = self._trim.aileron + targets.roll_gain * roll + self._airframe.roll * self._bank_integral
        return aileron, self._trim.rudder - targets.yaw_gain * yaw

    def _throttle(self, s: State, targets: Targets) -> float:
        g = self._gains
        # During an input in pitch the throttle stays where it was: the response must not be mixed with thrust.
        frozen = targets.pitch_gain < 1.0
        error = 0.0 if frozen else targets.airspeed - s.airspeed
        wanted = self._trim.throttle + g.speed * error + self._speed_integral
        if 0.0 < wanted < 1.0:
            self._speed_integral += g.speed_integral * error / RATE
        return _clip(wanted, 0.0, 1.0)


def _clip(value: float, low: float, high: float) -> float:
    return min(max(value, low), high)
