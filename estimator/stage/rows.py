"""Messages to rows of samples: which column of a row holds what.

A row is ``WIDTH`` numbers wide, as `drive` reads it, whatever the sensor. A fix begins with its latitude, longitude and
altitude in the columns where an inertial sample has its specific force; its accuracies stand in the same columns of r.
"""

from __future__ import annotations

import numpy as np

from estimator.drive import IMPACT, IMU, MEASURED, STATIC, WIDTH
from estimator.kinematics import ATTITUDE as ANGLES
from estimator.kinematics import HEIGHT, VELOCITY
from estimator.synchronise import Rows
from telemetry.messages import AirData, Altitude, Attitude, FlowAngles, Gnss, Imu, Message

SENSORS = ("gnss", "altitude", "imu", "attitude", "air_data", "flow_angles")
GNSS, ALTITUDE, INERTIAL, ATTITUDE, AIR, FLOW = range(len(SENSORS))
WITNESSES = 2  # the slow ones, whose times say whether a clock has leapt

HEIGHT_COLUMN = MEASURED + HEIGHT
FIX_VELOCITY = slice(MEASURED + VELOCITY, MEASURED + VELOCITY + 3)
KINDS = (Gnss, Altitude, Imu, Attitude, AirData, FlowAngles)


def rows(message: Message) -> Rows:
    """The samples of a sensor's message."""
    k = len(message.t)
    z, r = np.full((k, WIDTH), np.nan), np.full((k, WIDTH), np.nan)
    match message:
        case Gnss():
            sensor = GNSS
            z[:, :3] = np.stack([message.latitude, message.longitude, message.altitude], axis=1)
            z[:, FIX_VELOCITY] = message.velocity
            r[:, :3] = message.sigma
            with np.errstate(over="ignore"):
                r[:, FIX_VELOCITY] = np.square(message.sigma[:, 2:])
        case Altitude():
            sensor = ALTITUDE
            z[:, HEIGHT_COLUMN], r[:, HEIGHT_COLUMN] = message.altitude, message.sigma
            z[:, STATIC] = message.pressure
        case Imu():
            sensor = INERTIAL
            z[:, IMU : IMU + 3], z[:, IMU + 3 : IMU + 6] = message.specific_force, message.angular_rate
        case Attitude():
            sensor = ATTITUDE
            z[:, MEASURED + ANGLES : MEASURED + ANGLES + 3] = np.stack(
                [message.theta, message.phi, message.psi], axis=1
            )
        case AirData():
            sensor = AIR
            z[:, MEASURED], z[:, IMPACT] = message.airspeed, message.differential_pressure
        case FlowAngles():
            sensor = FLOW
            z[:, MEASURED + 1], z[:, MEASURED + 2] = message.alpha, message.beta
        case _:
            raise TypeError(f"{type(message).__name__} is no sensor's message")
    return Rows(message.t, message.t_rx, np.full(k, sensor), z, r)
