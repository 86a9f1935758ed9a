"""What is wrong with the sensors of a flight: each defect with the number that shows it, and a way out.

`examine` takes the raw columns of the sensors and returns findings. It needs no model of the aircraft, no estimate:
each sensor is judged by itself (held, frozen, saturated, slow), by gravity (accelerometer at rest), or by another
sensor that knows the same quantity (delay, units, axes, signs, jumps). A check that lacks sensors, manoeuvres or time
says nothing. Where one sensor spoils the check of another it is repaired first (units, then the attitude's signs,
then the gyro's axes, the accelerometer's, the vanes'), so that one fault makes one finding.
"""

from __future__ import annotations

from estimator.suspicion import attitude, axes, delay, holding, jumps, rest, timing, units, vanes
from estimator.suspicion.columns import (
    Air,
    Altitude,
    Attitude,
    Columns,
    Finding,
    Flow,
    Gnss,
    Imu,
    flying,
    ordered,
    origin,
)

__all__ = ["Air", "Altitude", "Attitude", "Columns", "Finding", "Flow", "Gnss", "Imu", "examine"]


def examine(
    columns: Columns,
    *,
    gravity: float = 9.80665,
    gnss_delay: float = 0.0,
    gnss_arm: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> list[Finding]:
    """Name the defects of the sensors.

    Parameters
    ----------
    columns : Columns
        As measured, SI and radians if the sensors are right; ten minutes or an hour of flight, or what there is.
    gravity : float
        Local gravity, m/s2.
    gnss_delay : float
        What the estimator is configured to take off the GNSS stamps, s: only another delay is a finding.
    gnss_arm : (float, float, float)
        Antenna from the IMU, body axes, m.

    Returns
    -------
    list of Finding
        Warnings first; empty for sensors without fault, and where nothing can be told.
    """
    columns, found = ordered(columns)
    start = origin(columns)
    found += timing.find_timing(columns)
    flies = flying(columns, start)
    found += holding.find_held(columns, start, flies)
    found += holding.find_saturated(columns)
    columns = _without(columns, {finding.sensor for finding in found if finding.defect == "frozen"})
    columns, told = units.find_units(columns, start, gravity)
    found += told
    columns, told = attitude.find_attitude(columns, start, gravity)
    found += told
    columns, told = axes.find_gyro(columns, start, gravity)
    found += told
    columns, told = axes.find_accelerometer(columns, start, gravity)
    found += told
    columns, told = vanes.find_vanes(columns, start)
    found += told
    found += rest.find_scale(columns, gravity)
    found += jumps.find_jumps(columns, start)
    found += delay.find_delay(columns, gnss_delay, gravity, gnss_arm)
    return sorted(found, key=lambda finding: finding.severity != "warning")


def _without(columns: Columns, frozen: set[str]) -> Columns:
    """Leave out sensors that cannot judge others."""
    parts = {
        "imu": {"gyro", "accelerometer"}, "attitude": {"attitude"}, "air": {"airspeed"}, "flow": {"vanes"},
        "altitude": {"altimeter"}, "gnss": {"gnss"},
    }  # fmt: skip
    return columns._replace(**{name: None for name, sensors in parts.items() if sensors & frozen})
