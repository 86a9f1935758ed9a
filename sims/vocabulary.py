"""The array door: a flight's samples as messages of the vocabulary, without MAVLink and without its quantisation."""

from __future__ import annotations

import math
import re
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from sims.sensors import VERTICAL
from telemetry.messages import AirData, Altitude, Attitude, FlowAngles, Gnss, Imu, Mark, Message, Progress
from telemetry.text import MARK

if TYPE_CHECKING:
    from sims.flight import Flight
    from sims.truth import Times

SOURCE = "0/1"
"""Link and component, as of a vehicle on the first link."""
SATELLITES = 14
"""In every simulated fix."""


def messages(flight: Flight, vehicle: int = 1) -> list[Message]:
    """Return everything the sensors of a flight said, one message per sensor, then the marks and the end.

    Parameters
    ----------
    flight : Flight
        What was flown.
    vehicle : int
        Number of the vehicle.

    Returns
    -------
    list of Message
        `Imu`, `Attitude`, `AirData`, `FlowAngles`, `Altitude` and `Gnss` as far as they are fitted, a `Mark` for every
        start and stop of a test point, and a final `Progress`. ``t = t_rx``: UTC by the flight's `start_utc`, ns.

    Notes
    -----
    A sample keeps its stamp; what is measured late describes an earlier time, as on the link. `AirData.airspeed` is
    calibrated airspeed, `differential_pressure` the impact pressure of compressible flow.
    """
    sensors, grade = flight.sensors, flight.sensors.grade

    def who(t: Times) -> dict[str, Any]:
        utc = flight.start_utc + (t - flight.truth.t[0])
        return {"vehicle": vehicle, "source": SOURCE, "boot": 0, "t": utc, "t_rx": utc}

    imu, attitude, pitot, vanes, static, gnss = (
        getattr(sensors, name) for name in ("imu", "attitude", "pitot", "vanes", "static", "gnss")
    )
    velocity = gnss.velocity.copy()
    if not grade.gnss_down:
        velocity[:, 2] = math.nan
    accuracy = (grade.position, grade.position * VERTICAL, grade.velocity)
    phi, theta, psi = (attitude.attitude[:, axis].copy() for axis in range(3))
    kinds: list[tuple[type[Message], Times, dict[str, Any]]] = [
        (Imu, imu.t, {"specific_force": imu.specific_force, "angular_rate": imu.rates}),
        # -pi..pi, as on the link.
        (Attitude, attitude.t, {"phi": phi, "theta": theta, "psi": (psi + math.pi) % (2.0 * math.pi) - math.pi}),
        (AirData, pitot.t, {"airspeed": pitot.airspeed, "differential_pressure": pitot.impact}),
        (FlowAngles, vanes.t, {"alpha": vanes.alpha, "beta": vanes.beta}),
        (
            Altitude,
            static.t,
            {"altitude": static.altitude, "pressure": static.pressure, "sigma": np.full(len(static.t), grade.altitude)},
        ),
        (
            Gnss,
            gnss.t,
            {
                "latitude": gnss.latitude,
                "longitude": gnss.longitude,
                "altitude": gnss.altitude,
                "velocity": velocity,
                "sigma": np.tile(accuracy, (len(gnss.t), 1)),
                "satellites": np.full(len(gnss.t), SATELLITES, np.int64),
            },
        ),
    ]
    out = [kind(**who(t), **columns) for kind, t, columns in kinds if len(t)]
    for mark in flight.marks:
        if found := re.match(MARK, mark.text):
            action: Literal["start", "stop"] = "start" if found["action"] == "start" else "stop"
            out.append(Mark(**who(np.array([mark.t])), action=[action], name=[found["name"]]))
    out.append(Progress(**who(flight.truth.t[-1:]), final=True))
    return out
