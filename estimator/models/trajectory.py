"""Position and velocity of any vehicle, from satellite navigation and a pressure altimeter.

Three axes, each driven by white acceleration of power spectral density S::

    per axis  phi = [[1, dt], [0, 1]],   Q = S [[dt^3/3, dt^2/2], [dt^2/2, dt]] = U diag(S dt^3/12, S dt) U^T
              U = [[1, dt/2], [0, 1]]

(Bar-Shalom, Li, Kirubarajan, "Estimation with Applications to Tracking and Navigation", section 6.2.2.) Q is the exact
discretisation, so an interval cut in two gives the same result as the interval: steps may fall anywhere.

What the sensors get wrong for longer than one sample is part of the state, because averaging does not remove it, and
a standard deviation that says so would be a lie: the altimeter's offset, a slow random walk, and the satellite fix's
error per axis, a Gauss-Markov process b of variance 1 and correlation time tau, in units of what the receiver states
as its
accuracy sigma, of which it is the share c::

    z = position + sigma sqrt(c) b + v,    var v = (1 - c) sigma^2
    b_{j+1} = exp(-dt/tau) b_j + w,        var w = 1 - exp(-2 dt/tau)

North and east lie in the plane that touches the Earth at the first fix, and so do the velocities north and east: they
are the rates of those two. Receivers state velocities along the north and east of where the vehicle is. At distance d
these axes have turned against the plane's, by d/R tan(latitude) for a flight to the east and by d/R out of the plane
(R: the Earth's radius), so every fix is turned into the plane's axes. Altitude is above mean sea level and the climb
rate is its rate, along the local vertical.
"""

from __future__ import annotations

from typing import Annotated

import msgspec
import numpy as np
from numpy.typing import NDArray

from estimator.geodesy import TangentPlane

Floats = NDArray[np.float64]

MODEL = "trajectory"
NAMES = (
    "north",
    "velocity_north",
    "east",
    "velocity_east",
    "altitude",
    "climb_rate",
    "altimeter_bias",
    "gnss_error_north",
    "gnss_error_east",
    "gnss_error_altitude",
)
UNITS = ("m", "m/s", "m", "m/s", "m", "m/s", "m", "sigma", "sigma", "sigma")
MEASUREMENTS = ("north", "east", "altitude", "velocity_north", "velocity_east", "climb_rate", "altimeter")

N, P, M = 10, 10, 7
SCALE = (1.0, 0.5, 1.0, 0.5, 1.0, 0.5, 2.0, 0.5, 0.5, 0.5)  # typical standard deviations
_AXES = (0, 2, 4)  # states of position
_BIAS, _ERROR = 6, 7


Positive = Annotated[float, msgspec.Meta(gt=0, le=1e9)]
NotNegative = Annotated[float, msgspec.Meta(ge=0, le=1e9)]
Share = Annotated[float, msgspec.Meta(ge=0, lt=1)]


class Settings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How the vehicle is expected to move, and what is known of it before the first measurement.

    Parameters
    ----------
    acceleration_horizontal, acceleration_vertical : float
        Power spectral density of the acceleration, (m/s2)^2/Hz: about twice the variance of the acceleration times
        the time over which it stays the same.
    altimeter_drift : float
        Power spectral density of the altimeter offset's rate, m^2/s.
    gnss_correlation_time : float
        How long the error of a fix stays the same, tau, s.
    gnss_correlated_share : float
        Share c of the variance of a fix that is such an error, 0 <= c < 1.
    prior_position, prior_velocity, prior_altimeter_bias : float
        Standard deviations about the first fix, about rest, and about zero; m, m/s, m.
    """

    acceleration_horizontal: NotNegative = 10.0
    acceleration_vertical: NotNegative = 5.0
    altimeter_drift: NotNegative = 0.01
    gnss_correlation_time: Positive = 100.0
    gnss_correlated_share: Share = 0.8
    prior_position: Positive = 1e4
    prior_velocity: Positive = 300.0
    prior_altimeter_bias: Positive = 500.0


class Trajectory:
    """The model about one origin.

    Parameters
    ----------
    latitude, longitude, altitude : float
        Origin of the tangent plane, rad and m.
    settings : Settings
    """

    def __init__(self, latitude: float, longitude: float, altitude: float, settings: Settings) -> None:
        self.plane = TangentPlane(latitude, longitude, altitude)
        self._psd = np.array(
            [settings.acceleration_horizontal, settings.acceleration_horizontal, settings.acceleration_vertical]
        )
        self._drift = settings.altimeter_drift
        self._tau = settings.gnss_correlation_time
        self._share = settings.gnss_correlated_share
        self.x0 = np.zeros(N)
        self.x0[4] = altitude
        sigma = [settings.prior_position, settings.prior_velocity] * 3 + [settings.prior_altimeter_bias, 1.0, 1.0, 1.0]
        self.p0 = np.diag(np.square(sigma))
        self._h = np.zeros((M, N))
        for row, state in enumerate((0, 2, 4, 1, 3, 5, 4)):
            self._h[row, state] = 1.0
        self._h[6, _BIAS] = 1.0

    def transition(self, dt: Floats) -> tuple[Floats, Floats, Floats]:
        """Phi (k, n, n), gamma (k, n, p) and q (k, p) of intervals dt, shape (k,), s; q is zero where dt is."""
        k = len(dt)
        phi = np.zeros((k, N, N))
        phi[:, range(N), range(N)] = 1.0
        gamma = phi.copy()
        q = np.zeros((k, P))
        for position, psd in zip(_AXES, self._psd, strict=True):
            velocity = position + 1
            phi[:, position, velocity] = dt
            gamma[:, position, velocity] = dt / 2
            q[:, position] = psd * dt**3 / 12
            q[:, velocity] = psd * dt
        q[:, _BIAS] = self._drift * dt
        for error in range(_ERROR, N):
            phi[:, error, error] = np.exp(-dt / self._tau)
            q[:, error] = -np.expm1(-2 * dt / self._tau)
        return phi, gamma, q

    def observation(self, r: Floats) -> Floats:
        """H (k, m, n) of measurements with variances r (k, m)."""
        h = np.repeat(self._h[None], len(r), axis=0)
        stated = np.sqrt(r[:, :3] / (1 - self._share))
        h[:, (0, 1, 2), (_ERROR, _ERROR + 1, _ERROR + 2)] = np.sqrt(self._share) * stated
        return h

    def gnss(
        self, latitude: Floats, longitude: Floats, altitude: Floats, velocity: Floats, sigma: Floats
    ) -> tuple[Floats, Floats]:
        """Measurements z (k, m) and their variances r (k, m) of satellite fixes; arguments as in the message `Gnss`."""
        k = len(latitude)
        z, r = np.full((k, M), np.nan), np.ones((k, M))
        z[:, 0], z[:, 1] = self.plane.to_plane(latitude, longitude, altitude)
        z[:, 2] = altitude
        z[:, 3], z[:, 4] = self.plane.turn(latitude, longitude, velocity)
        z[:, 5] = -velocity[:, 2]
        r[:, 0:2] = (1 - self._share) * sigma[:, :1] ** 2
        r[:, 2] = (1 - self._share) * sigma[:, 1] ** 2
        r[:, 3:6] = sigma[:, 2:] ** 2
        return z, r

    def altimeter(self, altitude: Floats, sigma: Floats) -> tuple[Floats, Floats]:
        """Measurements z (k, m) and their variances r (k, m) of the pressure altimeter."""
        k = len(altitude)
        z, r = np.full((k, M), np.nan), np.ones((k, M))
        z[:, 6] = altitude
        r[:, 6] = sigma**2
        return z, r

    def geodetic(self, mean: Floats) -> Floats:
        """Latitude, longitude (rad) and altitude (m) of states, shape (k, 3)."""
        latitude, longitude = self.plane.from_plane(mean[:, 0], mean[:, 2], mean[:, 4])
        return np.stack([latitude, longitude, mean[:, 4]], axis=1)
