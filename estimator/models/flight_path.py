"""The flight-path model: which states are estimated from which sensors, with what noise, from what start.

Mode "G" has satellite velocity and, as a rule, a heading: velocity relative to the Earth, wind apart. Mode "I" is what
is left of it without air data: no wind, no turbulence. Mode "P" has the sensors of Shi's paper, air data, altitude and
attitude: velocity relative to the mean air mass, no Earth rate. The equations are in ``kinematics``, the filter and
smoother in ``extended``.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Annotated, Literal, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from estimator import extended
from estimator.information import factored
from estimator.kinematics import OFFSETS, SCALE, SLOPES, TURBULENCE, WIND, Earth
from estimator.rotation import euler_jacobian, quaternion

Floats = NDArray[np.float64]

MODEL = "flight_path"
SENSORS = ("imu", "air_data", "flow_angles", "attitude", "altitude", "gnss")
DEGREE = math.pi / 180.0
CALM = 0.3  # m/s of turbulence: above it the aircraft's answer to gusts is taken for a slope of the vanes
ALL_NAMES = (
    "h", "u", "v", "w", "theta", "phi", "psi", "ba_x", "ba_y", "ba_z", "bg_x", "bg_y", "bg_z",
    "wind_north", "wind_east", "gust_north", "gust_east", "gust_down",
    "k_airspeed", "b_alpha", "b_beta", "k_alpha", "k_beta",
)  # fmt: skip
ALL_UNITS = (
    "m", "m/s", "m/s", "m/s", "rad", "rad", "rad", "m/s2", "m/s2", "m/s2", "rad/s", "rad/s", "rad/s", "m/s", "m/s",
    "m/s", "m/s", "m/s", "1", "rad", "rad", "1", "1",
)  # fmt: skip
PARAMETERS = frozenset(name for i, name in enumerate(ALL_NAMES) if i >= 7 and not name.startswith("gust"))

Positive = Annotated[float, msgspec.Meta(gt=0, le=1e9)]
NotNegative = Annotated[float, msgspec.Meta(ge=0, le=1e9)]
Place = tuple[float, float, float]


class Settings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Noise, priors and places of the sensors; one standard deviation each, SI and rad.

    The defaults are those of an autopilot in a small vibrating airframe, of which nothing is known; `mems` and `fti`
    are two grades of sensors that are.

    Parameters
    ----------
    mode : {"auto", "G", "I", "P"}
        Satellite velocity, with air data or without; or air data, altitude and attitude alone. "auto" is G where an
        airspeed is measured, else I.
    earth : {"wgs84", "flat"}
        With its rotation, curvature and normal gravity, or a plane at rest with 9.80665 m/s2: a textbook's.
    accelerometer, gyro : float
        Noise of an inertial sample (the mean since the one before), vibration and aliasing included.
    accelerometer_bias, gyro_bias, accelerometer_walk, gyro_walk : float
        Prior of the biases, and how they walk, per root second; 0 is constant.
    imu_input : {"mean", "point"}
        What a sample is: the mean since the one before, or the value at its time.
    airspeed, airspeed_scale, flow_angle, flow_offset, flow_slope : float
        Noise and scale error of the airspeed; noise, offset and slope of the vanes. Slopes are estimated only where
        ``turbulence`` is below 0.3 m/s.
    attitude, heading : float or None
        Noise of roll and pitch, and of heading, where they are measured independently of the other sensors; None: not
        used, save for the start. An autopilot's attitude is no independent measurement.
    attitude_interval : float
        Attitude and heading count once in so many seconds, because their errors last; 0 is every one.
    height : float
        Noise of the altimeter, m.
    gnss_velocity : float or None
        Noise per axis; None: as the receiver states.
    gnss_delay : float or None
        By how much a satellite fix is older than its time says, s; None: estimated.
    air_delay : float
        The same of the pressure sensors, s.
    flow_tells_airspeed : bool
        Whether alpha and beta may tell the airspeed in turbulence too, where the aircraft's yielding misleads them.
    turbulence, turbulence_time : float
        Standard deviation of a gust component, m/s, and its correlation time, s (length over airspeed).
    wind, wind_walk : float
        Prior of the mean wind, m/s, and how it walks, m/s per root second.
    prior_height, prior_attitude, prior_heading, prior_velocity : float
        Of the start: m, rad, rad, m/s.
    stall_speed : float
        m/s: the air data count above 0.6 of it.
    vane, antenna, centre : tuple of float
        Places of vanes and probe, of the antenna and of the centre of gravity, from the inertial sensors, body axes, m.
    """

    mode: Literal["auto", "G", "I", "P"] = "auto"
    earth: Literal["wgs84", "flat"] = "wgs84"
    accelerometer: Positive = 0.25
    gyro: Positive = 0.02
    accelerometer_bias: Positive = 0.3
    gyro_bias: Positive = 1.0 * DEGREE
    accelerometer_walk: NotNegative = 0.006
    gyro_walk: NotNegative = 4e-4
    imu_input: Literal["mean", "point"] = "mean"
    airspeed: Positive = 1.0
    airspeed_scale: Positive = 0.05
    flow_angle: Positive = 1.0 * DEGREE
    flow_offset: Positive = 2.0 * DEGREE
    flow_slope: Positive = 0.05
    attitude: Positive | None = None
    heading: Positive | None = None
    attitude_interval: NotNegative = 1.0
    height: Positive = 1.5
    gnss_velocity: Positive | None = None
    gnss_delay: float | None = None
    air_delay: float = 0.0
    flow_tells_airspeed: bool = False
    turbulence: NotNegative = 1.5
    turbulence_time: Positive = 5.0
    wind: Positive = 10.0
    wind_walk: NotNegative = 0.03
    prior_height: Positive = 10.0
    prior_attitude: Positive = 3.0 * DEGREE
    prior_heading: Positive = 10.0 * DEGREE
    prior_velocity: Positive = 3.0
    stall_speed: NotNegative = 0.0
    vane: Place = (0.0, 0.0, 0.0)
    antenna: Place = (0.0, 0.0, 0.0)
    centre: Place = (0.0, 0.0, 0.0)

    @classmethod
    def mems(cls, **changes: object) -> Settings:
        """A small autopilot's sensors as in their data sheets, with a heading of its own and without vibration."""
        grade: dict[str, object] = {
            "accelerometer": 0.1, "gyro": 0.15 * DEGREE, "accelerometer_bias": 0.2, "gyro_bias": 0.3 * DEGREE,
            "accelerometer_walk": 0.0, "gyro_walk": 0.0, "airspeed": 0.8, "airspeed_scale": 0.04,
            "flow_angle": 0.5 * DEGREE, "flow_offset": 1.5 * DEGREE, "heading": 2.0 * DEGREE, "attitude_interval": 0.0,
            "gnss_velocity": 0.2, "prior_attitude": 2.0 * DEGREE, "prior_heading": 2.0 * DEGREE,
        }  # fmt: skip
        return cls(**{**grade, **changes})  # type: ignore[arg-type]

    @classmethod
    def fti(cls, **changes: object) -> Settings:
        """Flight-test instrumentation: a gyro platform, vanes on a boom, a good receiver."""
        grade: dict[str, object] = {
            "accelerometer": 0.02, "gyro": 0.02 * DEGREE, "accelerometer_bias": 0.03, "gyro_bias": 0.03 * DEGREE,
            "accelerometer_walk": 0.0, "gyro_walk": 0.0, "airspeed": 0.3, "airspeed_scale": 0.02,
            "flow_angle": 0.1 * DEGREE, "flow_offset": 0.5 * DEGREE, "attitude": 0.1 * DEGREE,
            "heading": 0.2 * DEGREE, "attitude_interval": 0.0, "height": 1.0, "gnss_velocity": 0.05,
            "prior_attitude": 1.0 * DEGREE, "prior_heading": 0.2 * DEGREE, "wind_walk": 0.02,
        }  # fmt: skip
        return cls(**{**grade, **changes})  # type: ignore[arg-type]


GRADES: dict[str, Callable[[], Settings]] = {"autopilot": Settings, "mems": Settings.mems, "fti": Settings.fti}
"""Settings to begin from, by name."""


class FlightPath(NamedTuple):
    """The model of one stretch of flight.

    Attributes
    ----------
    settings : Settings
    names, units : tuple of str, length n
        Of the named states, in the order in which they are told.
    model : extended.Model
    p : int
        Noise components.
    """

    settings: Settings
    names: tuple[str, ...]
    units: tuple[str, ...]
    model: extended.Model
    p: int

    @property
    def n(self) -> int:
        """Number of states."""
        return len(self.names)

    @classmethod
    def of(cls, settings: Settings, latitude: float, height: float, *, predict_wind: bool = True) -> FlightPath:
        """The model at a latitude (rad) and height (m)."""
        if settings.mode == "auto":
            settings = msgspec.structs.replace(settings, mode="G")
        calm = settings.turbulence < CALM
        tail = [] if settings.mode == "I" else [SCALE, OFFSETS, OFFSETS + 1, *((SLOPES, SLOPES + 1) if calm else ())]
        if settings.mode == "G":
            tail += [WIND, WIND + 1]
        if settings.mode != "I":
            tail += [TURBULENCE, TURBULENCE + 1, TURBULENCE + 2]
        order = np.array([*tail, *range(7, 13), *range(7)], np.int64)
        fades = np.array([1.0 if TURBULENCE <= state < TURBULENCE + 3 else 0.0 for state in order])
        driven = [] if settings.mode == "I" else [tail.index(TURBULENCE + i) for i in range(3)]
        if settings.mode == "G":
            driven += [tail.index(WIND), tail.index(WIND + 1)]
        if settings.accelerometer_walk or settings.gyro_walk:
            driven += list(range(len(tail), len(tail) + 6))
        earth = Earth.at(latitude, height) if settings.earth == "wgs84" else Earth.flat(9.80665)
        if settings.mode == "P":
            earth = earth._replace(rate_north=0.0, rate_down=0.0, meridian=0.0, vertical=0.0)
        told = [*range(13), *tail]
        model = extended.Model(
            order, fades, np.array(driven, np.int64), np.array(settings.vane, np.float64),
            np.array(settings.antenna, np.float64), earth, WIND if predict_wind else TURBULENCE,
            not (calm or settings.flow_tells_airspeed),
        )  # fmt: skip
        return cls(
            settings, tuple(ALL_NAMES[i] for i in told), tuple(ALL_UNITS[i] for i in told), model, 6 + len(driven)
        )

    def noise(self, dt: Floats, inertial: Floats, slow: Floats | None = None) -> tuple[Floats, Floats]:
        """Variances q (N, p) of the noise components and exp(-dt/tau) (N,) of steps dt (N,), s.

        Parameters
        ----------
        dt : (N,) array
        inertial : (N, 6) array
            Variances of the mean specific force and rate of each step.
        slow : (N,) array, optional
            For how much time wind and biases walk in each step, s: zero in most, because a component without noise
            costs nothing, and a wind that steps by a centimetre per second five times a second is as good as one that
            walks. dt if not given.
        """
        s = self.settings
        slow = dt if slow is None else slow
        fade = np.exp(-dt / s.turbulence_time)
        q = np.empty((len(dt), self.p))
        q[:, :6] = inertial
        at = 6
        if s.mode != "I":
            q[:, 6:9] = (max(s.turbulence, 0.01) ** 2 * -np.expm1(-2.0 * dt / s.turbulence_time))[:, None]
            at = 9
        if s.mode == "G":
            q[:, 9:11] = (s.wind_walk**2 * slow)[:, None]
            at = 11
        if self.p > at:
            q[:, at : at + 3] = (s.accelerometer_walk**2 * slow)[:, None]
            q[:, at + 3 : at + 6] = (s.gyro_walk**2 * slow)[:, None]
        return q, fade

    def prior(self) -> Floats:
        """Standard deviations (n,) of the named states at the start."""
        s = self.settings
        gust = max(s.turbulence, 0.01)
        sigma = {
            "h": s.prior_height, "u": s.prior_velocity, "theta": s.prior_attitude, "phi": s.prior_attitude,
            "psi": 1e-3 if s.mode == "P" else s.prior_heading, "wind_north": s.wind, "wind_east": s.wind,
            "gust_north": gust, "gust_east": gust, "gust_down": gust, "k_airspeed": s.airspeed_scale,
            "b_alpha": s.flow_offset, "b_beta": s.flow_offset, "k_alpha": s.flow_slope, "k_beta": s.flow_slope,
            "v": s.prior_velocity, "w": s.prior_velocity,
        }  # fmt: skip
        for axis in "xyz":
            sigma[f"ba_{axis}"], sigma[f"bg_{axis}"] = s.accelerometer_bias, s.gyro_bias
        if s.mode == "P":
            sigma["u"] = sigma["v"] = sigma["w"] = 5.0
        return np.array([sigma[name] for name in self.names])

    def beginning(self, values: dict[str, float], sigma: Floats | None = None) -> tuple[Floats, Floats, Floats]:
        """What is known of a start at named values (zero where none is given) with standard deviations (n,).

        Those of the prior if none are given. Returns the states (23,) by number, rotation zero, the attitude (4,), and
        the covariance (n, n) in the order of the model's factor.

        Raises
        ------
        ValueError
            A value is not finite.
        """
        x, q = np.zeros(23), np.empty(4)
        for name, value in values.items():
            if not math.isfinite(value):
                raise ValueError(f"the start has no {name}: {value}")
            x[ALL_NAMES.index(name)] = value
        quaternion(x[4], x[5], x[6], q)
        theta, phi = float(x[4]), float(x[5])
        x[4:7] = 0.0
        n, order = self.n, self.model.order
        named = np.square(self.prior() if sigma is None else sigma)
        covariance = np.diag(named)
        e = np.empty((3, 3))
        euler_jacobian(theta, phi, e)
        inverse = np.linalg.inv(e)
        covariance[4:7, 4:7] = inverse @ covariance[4:7, 4:7] @ inverse.T
        told = np.array([*range(13), *order[: n - 13]])
        to_factor = [int(np.flatnonzero(told == state)[0]) for state in order]
        covariance = covariance[np.ix_(to_factor, to_factor)]
        return x, q, 0.5 * (covariance + covariance.T)

    def start(self, values: dict[str, float], sigma: Floats | None = None) -> extended.Carry:
        """The carry of the extended smoother at a `beginning`.

        Raises
        ------
        ValueError
            A value is not finite.
        """
        x, q, covariance = self.beginning(values, sigma)
        upper, d = factored(covariance)
        n, order = self.n, self.model.order
        ut = np.concatenate([np.zeros((n, 1)), upper.T], axis=1)
        return extended.Carry(
            np.ascontiguousarray(ut), np.array(d), x[order].copy(), x, q, np.eye(7), np.zeros((7, 6)), np.ones(1),
            np.zeros((10, 3)), np.zeros((3, 3)), np.zeros(3), np.zeros(3),
        )  # fmt: skip
