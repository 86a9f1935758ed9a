"""How good a set of sensors is, how often each of them speaks, and where on the airframe they sit.

Three named sets: ``fti``, flight-test instrumentation; ``mems``, the sensors of a small autopilot, without vanes;
``mems-vanes``, a small autopilot of the better sort with a boom for vanes and pitot.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from sims.points import Arm


class SensorError(ValueError):
    """The grade is not known, a sensor is not known, or a rate does not fit the truth's."""


class Rates(NamedTuple):
    """Samples per second of each sensor (Hz); 0 means that it is not fitted.

    `attitude` is that of roll and pitch, `heading` that of the heading; `navigation` is the vehicle's own filter.
    """

    imu: int = 50
    attitude: int = 25
    heading: int = 25
    static: int = 10
    pitot: int = 10
    vanes: int = 0
    gnss: int = 5
    navigation: int = 5


class Places(NamedTuple):
    """Vanes with pitot, GNSS antenna and centre of gravity as seen from the IMU: body axes (m)."""

    vane: Arm
    antenna: Arm
    centre: Arm


class Arms(NamedTuple):
    """Where sensors sit: from the centre of gravity, body axes forward, right, down (m).

    The pitot tube is on the boom of the vanes; the static pressure is that at the height of the IMU.
    """

    imu: Arm = (0.0, 0.0, 0.0)
    vanes: Arm = (0.0, 0.0, 0.0)
    gnss: Arm = (0.0, 0.0, 0.0)

    def from_imu(self) -> Places:
        """Return the places as flight-path reconstruction wants them, whose state point is the IMU."""
        x, y, z = self.imu

        def seen(arm: Arm) -> Arm:
            return arm[0] - x, arm[1] - y, arm[2] - z

        return Places(vane=seen(self.vanes), antenna=seen(self.gnss), centre=seen((0.0, 0.0, 0.0)))


AT_CG = Arms()
_LIGHT = Arms(imu=(-0.4, 0.2, 0.3), vanes=(1.6, -3.2, -0.8), gnss=(-0.9, 0.0, -1.1))  # the boom is on the left wing
_FIGHTER = Arms(imu=(1.2, 0.2, 0.3), vanes=(7.5, 0.0, 0.2), gnss=(-1.5, 0.0, -1.0))
_AIRLINER = Arms(imu=(2.0, 0.4, 1.2), vanes=(14.0, 0.0, 0.5), gnss=(5.0, 0.0, -2.2))

RIGS: dict[str, Arms] = {
    **dict.fromkeys(("c172x", "c172p", "pa28"), _LIGHT),
    **dict.fromkeys(("f15", "f16", "T37", "T38", "A4"), _FIGHTER),
    **dict.fromkeys(("737", "A320", "MD11", "787-8", "global5000", "B747"), _AIRLINER),
}
"""Where flight-test instrumentation sits in each aircraft."""


class Grade(NamedTuple):
    """What a set of sensors is worth: 1 sigma of noise per sample, and of errors that are constant over a flight.

    Attributes
    ----------
    name : str
        Of the set.
    accelerometer, accelerometer_bias : float
        Per axis (m/s2).
    gyro, gyro_bias : float
        Per axis (rad/s).
    attitude, attitude_time : float
        Error of roll and pitch (rad) and its correlation time (s); 0 is white.
    altitude, altitude_step, altimeter_offset : float
        Pressure-altitude noise, resolution (0 = none) and 1 sigma of the constant offset (m).
    airspeed, airspeed_scale : float
        Airspeed noise (m/s) and 1 sigma of the constant relative error.
    temperature : float
        Of the air outside (K).
    position, position_time, position_white : float
        GNSS position error per horizontal axis (m), correlation time of its slow part (s), and the share of the
        variance that is white. The height error is 1.5 times as large.
    velocity : float
        GNSS velocity noise per axis (m/s).
    heading : float
        Error of the heading (rad), of the same correlation time as that of roll and pitch.
    rates : Rates
        How often each sensor speaks.
    vane, vane_offset, vane_scale : float
        Alpha and beta: noise and constant offset (rad), constant relative error.
    accelerometer_scale : float
        Constant relative error per axis.
    airspeed_is_true : bool
        Whether the errors of airspeed are those of the true airspeed that is computed from impact and static pressure
        in the standard atmosphere, or those of the calibrated airspeed.
    gnss_down : bool
        Whether the receiver reports its vertical velocity.
    arms : Arms or None
        Where the sensors sit; None is where `RIGS` has them in the aircraft that flew.
    """

    name: str
    accelerometer: float
    accelerometer_bias: float
    gyro: float
    gyro_bias: float
    attitude: float
    attitude_time: float
    altitude: float
    altitude_step: float
    altimeter_offset: float
    airspeed: float
    airspeed_scale: float
    temperature: float
    position: float
    position_time: float
    position_white: float
    velocity: float
    heading: float
    rates: Rates = Rates()
    vane: float = 0.0
    vane_offset: float = 0.0
    vane_scale: float = 0.0
    accelerometer_scale: float = 0.0
    airspeed_is_true: bool = False
    gnss_down: bool = True
    arms: Arms | None = None


_DEG = math.pi / 180.0

GRADES: dict[str, Grade] = {
    "fti": Grade(
        name="fti",
        accelerometer=0.02,
        accelerometer_bias=0.03,
        gyro=0.02 * _DEG,
        gyro_bias=0.03 * _DEG,
        attitude=0.1 * _DEG,
        attitude_time=0.0,
        altitude=1.0,
        altitude_step=0.0,
        altimeter_offset=10.0,
        airspeed=0.3,
        airspeed_scale=0.02,
        temperature=0.2,
        position=2.0,
        position_time=30.0,
        position_white=0.2,
        velocity=0.05,
        heading=0.2 * _DEG,
        rates=Rates(imu=100, attitude=50, heading=50, static=20, pitot=20, vanes=50),
        vane=0.1 * _DEG,
        vane_offset=0.5 * _DEG,
        airspeed_is_true=True,
    ),
    "mems": Grade(
        name="mems",
        accelerometer=0.1,
        accelerometer_bias=0.3,
        gyro=0.1 * _DEG,
        gyro_bias=0.5 * _DEG,
        attitude=0.5 * _DEG,
        attitude_time=3.0,
        altitude=1.0,
        altitude_step=0.1,
        altimeter_offset=10.0,
        airspeed=1.0,
        airspeed_scale=0.05,
        temperature=1.0,
        position=5.0,
        position_time=30.0,
        position_white=0.2,
        velocity=0.2,
        heading=0.5 * _DEG,
        gnss_down=False,
        arms=AT_CG,
    ),
    "mems-vanes": Grade(
        name="mems-vanes",
        accelerometer=0.1,
        accelerometer_bias=0.2,
        gyro=0.15 * _DEG,
        gyro_bias=0.3 * _DEG,
        attitude=2.0 * _DEG,
        attitude_time=0.0,
        altitude=1.5,
        altitude_step=0.0,
        altimeter_offset=10.0,
        airspeed=0.8,
        airspeed_scale=0.04,
        temperature=1.0,
        position=5.0,
        position_time=30.0,
        position_white=0.2,
        velocity=0.2,
        heading=2.0 * _DEG,
        rates=Rates(imu=100, attitude=0, heading=10, static=10, pitot=10, vanes=20),
        vane=0.5 * _DEG,
        vane_offset=1.5 * _DEG,
        airspeed_is_true=True,
    ),
}
"""The sets by name."""


def find(grade: str | Grade) -> Grade:
    """Return `grade` itself, or the grade of that name.

    Raises
    ------
    SensorError
        No grade of that name.
    """
    if isinstance(grade, Grade):
        return grade
    if grade not in GRADES:
        raise SensorError(f"unknown sensors {grade!r}; known: {', '.join(sorted(GRADES))}")
    return GRADES[grade]


def rig(grade: Grade, aircraft: str) -> Arms:
    """Return where the sensors of `grade` sit in `aircraft`; an aircraft without a known rig has them at its CG."""
    return grade.arms if grade.arms is not None else RIGS.get(aircraft, AT_CG)
