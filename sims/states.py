"""The truth in the terms of flight-path reconstruction: states at the IMU, and the constants it is to find."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sims import atmosphere, points

if TYPE_CHECKING:
    from sims.flight import Flight
    from sims.truth import Array


def parameters(flight: Flight) -> dict[str, float]:
    """Return the constants of a flight's sensors that an estimator should find, SI and rad.

    ``ba_x .. ba_z``, ``bg_x .. bg_z``
        Accelerometer (m/s2) and gyro (rad/s) bias.
    ``k_airspeed``
        Scale error of the airspeed, true airspeed where the grade says so.
    ``b_alpha``, ``b_beta``, ``k_alpha``, ``k_beta``
        Offset (rad) and scale error of the vanes.
    ``altimeter_offset``
        Measured minus true pressure altitude (m).
    """
    c = flight.sensors.constants
    return {
        **{f"ba_{axis}": float(value) for axis, value in zip("xyz", c.accelerometer, strict=True)},
        **{f"bg_{axis}": float(value) for axis, value in zip("xyz", c.gyro, strict=True)},
        "k_airspeed": c.airspeed_scale,
        "b_alpha": float(c.vane_offset[0]),
        "b_beta": float(c.vane_offset[1]),
        "k_alpha": float(c.vane_scale[0]),
        "k_beta": float(c.vane_scale[1]),
        "altimeter_offset": c.altimeter,
    }


def truth_states(flight: Flight) -> dict[str, Array]:
    """Return the true states at the IMU at the truth's own times, each (N,), SI and rad, by name.

    ``h``, ``u``, ``v``, ``w``
        Altitude of the IMU (m, up) and its velocity relative to the ground, body axes (m/s).
    ``theta``, ``phi``, ``psi``
        Euler angles; psi in 0..2 pi.
    ``wind_north``, ``wind_east``, ``wind_down``
        The way the air moves at the aircraft, turbulence included (m/s).
    ``gust_north``, ``gust_east``, ``gust_down``
        What of it is turbulence: the wind less the flight's steady wind (m/s).
    ``airspeed``, ``alpha``, ``beta``
        True airspeed and flow angles at the IMU; with ``_cg`` at the centre of gravity, as JSBSim has them.
    ``pressure_altitude``
        What a perfect altimeter at the IMU would show (m): geopotential, so it differs from `h` by h^2 / Earth radius.

    and the constants of `parameters`, repeated for every record. The records' times, on the clock of `messages`, are
    ``flight.utc``.
    """
    truth, arm = flight.truth, flight.sensors.arms.imu
    n = len(truth)
    h = points.altitude(truth, arm)
    velocity = points.body_velocity(truth, arm)
    airspeed, alpha, beta = points.air_data(truth, arm)
    gust = truth.wind - np.array([*flight.wind, 0.0])
    states = {
        "h": h,
        **{name: velocity[:, axis].copy() for axis, name in enumerate("uvw")},
        "theta": truth.attitude[:, 1].copy(),
        "phi": truth.attitude[:, 0].copy(),
        "psi": truth.attitude[:, 2].copy(),
        **{f"wind_{name}": truth.wind[:, axis].copy() for axis, name in enumerate(("north", "east", "down"))},
        **{f"gust_{name}": gust[:, axis].copy() for axis, name in enumerate(("north", "east", "down"))},
        "airspeed": airspeed,
        "alpha": alpha,
        "beta": beta,
        "airspeed_cg": truth.airspeed,
        "alpha_cg": truth.alpha,
        "beta_cg": truth.beta,
        "pressure_altitude": atmosphere.pressure_altitude(truth.pressure) + h - truth.altitude,
    }
    return states | {name: np.full(n, value) for name, value in parameters(flight).items()}
