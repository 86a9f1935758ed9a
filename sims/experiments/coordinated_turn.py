"""An aircraft in a coordinated turn, seen by a radar: the experiment of cubature filtering, in Monte Carlo batches.

The problem is that of Arasaratnam and Haykin [1]_, which Tang et al. [2]_ take over. State x = [X, X', Y, Y', Om], m,
m/s, rad/s; T = 1 s; measured are range and bearing:

    X+  = X + sw X' - cw Y'      X'+ = cos a X' - sin a Y'      a = Om T,  sw = sin a / Om,  cw = 2 sin^2(a/2) / Om
    Y+  = Y + cw X' + sw Y'      Y'+ = sin a X' + cos a Y'      Om+ = Om
    z   = [sqrt(X^2 + Y^2), atan2(Y, X)]

The truth starts at x0 and has process noise; a filter starts at a draw from N(x0, P0). All filters of a batch see the
same truths and measurements. A batch is one compiled loop per filter, over both processors; what a run gives depends
on seed and number of the run alone.

Of the text of [2]_ only x0 and the standard deviation of the turn rate survive: the bearing noise is that of [1]_.

References
----------
.. [1] I. Arasaratnam and S. Haykin, "Cubature Kalman filters", IEEE TAC 54 (2009) 1254-1269.
.. [2] X. Tang, X. Huang, M. Wu and H. Zhang, "Research on square root CKF / backward smoothing nonlinear filter",
   Journal of Academy of Armored Force Engineering, 2015 (2), 65-69.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from estimator.ud import Array, compiled, follow

follow(__file__)


T = 1.0  # s
N, M = 5, 2
STEPS = 100
FIRST = 51  # step from which errors are averaged
LAGS = 5  # measurements beyond the last step, for estimates with a lag
TURNS = np.array([False, True])  # which measurements are angles

X0 = np.array([1000.0, 300.0, 1000.0, 0.0, np.radians(-3.0)])
P0 = np.array([10.0, np.sqrt(10.0), 10.0, np.sqrt(10.0), 0.1])  # standard deviations
Q1, Q2 = 0.1, 1.75e-4  # m^2/s^3, s^-3
R0 = np.array([10.0, np.sqrt(10.0) * 1e-3])  # m, rad


def _sqrt_q() -> Array:
    """Lower factor of diag(q1 M, q1 M, q2 T), M = [[T^3/3, T^2/2], [T^2/2, T]]."""
    one = np.linalg.cholesky(Q1 * np.array([[T**3 / 3.0, T**2 / 2.0], [T**2 / 2.0, T]]))
    out = np.zeros((N, N))
    out[0:2, 0:2], out[2:4, 2:4], out[4, 4] = one, one, np.sqrt(Q2 * T)
    return out


class Problem(NamedTuple):
    """What the filters are told, all as factors: prior, process noise, measurement noise."""

    sqrt_p: Array
    sqrt_q: Array
    sqrt_r: Array


PROBLEM = Problem(np.diag(P0), _sqrt_q(), np.diag(R0))


@compiled
def turn(x: Array) -> Array:
    """One second of a coordinated turn; the series of sw and cw where the turn rate is nearly zero."""
    rate = x[4]
    a = rate * T
    if abs(rate) < 1e-9:
        along, across = T * (1.0 - a * a / 6.0), T * a / 2.0
    else:
        half = np.sin(0.5 * a)
        along, across = np.sin(a) / rate, 2.0 * half * half / rate
    cos, sin = np.cos(a), np.sin(a)
    out = np.empty_like(x)
    out[0] = x[0] + along * x[1] - across * x[3]
    out[1] = cos * x[1] - sin * x[3]
    out[2] = x[2] + across * x[1] + along * x[3]
    out[3] = sin * x[1] + cos * x[3]
    out[4] = rate
    return out


@compiled
def radar(x: Array) -> Array:
    """Range and bearing."""
    out = np.empty(M, x.dtype)
    out[0] = np.sqrt(x[0] * x[0] + x[2] * x[2])
    out[1] = np.arctan2(x[2], x[0])
    return out


@compiled
def turn_jacobian(x: Array) -> Array:
    """Derivatives of ``turn``, (5, 5)."""
    rate = x[4]
    a = rate * T
    cos, sin = np.cos(a), np.sin(a)
    if abs(a) < 1e-4:  # of sw and cw by the rate: differences that cancel
        along, across = T * (1.0 - a * a / 6.0), T * a / 2.0
        d_along, d_across = -T * T * a / 3.0, T * T * (0.5 - a * a / 8.0)
    else:
        half = np.sin(0.5 * a)
        along, across = sin / rate, 2.0 * half * half / rate
        d_along, d_across = (T * cos - along) / rate, (T * sin - across) / rate
    out = np.zeros((N, N), x.dtype)
    for i in range(N):
        out[i, i] = 1.0
    out[0, 1], out[0, 3], out[0, 4] = along, -across, d_along * x[1] - d_across * x[3]
    out[1, 1], out[1, 3], out[1, 4] = cos, -sin, -T * (sin * x[1] + cos * x[3])
    out[2, 1], out[2, 3], out[2, 4] = across, along, d_across * x[1] + d_along * x[3]
    out[3, 1], out[3, 3], out[3, 4] = sin, cos, T * (cos * x[1] - sin * x[3])
    return out


@compiled
def radar_jacobian(x: Array) -> Array:
    """Derivatives of ``radar``, (2, 5)."""
    square = x[0] * x[0] + x[2] * x[2]
    distance = np.sqrt(square)
    out = np.zeros((M, N), x.dtype)
    out[0, 0], out[0, 2] = x[0] / distance, x[2] / distance
    out[1, 0], out[1, 2] = -x[2] / square, x[0] / square
    return out


class Draws(NamedTuple):
    """What all filters of a batch see.

    Attributes
    ----------
    truth : (runs, STEPS + LAGS + 1, 5) array
    z : (runs, STEPS + LAGS, 2) array
        Of the epochs 1, 2, ..; bearings in (-pi, pi].
    start : (runs, 5) array
        Where the filters start.
    """

    truth: Array
    z: Array
    start: Array


def draw(runs: int, seed: int) -> Draws:
    """Truths, measurements and starts; those of a run are the same whatever the number of runs.

    Raises
    ------
    ValueError
        Fewer than one run.
    """
    if runs < 1:
        raise ValueError(f"runs is {runs}: at least 1 is needed")
    count = STEPS + LAGS
    normal = np.random.default_rng(seed).standard_normal((runs, N + count * (N + M)))
    start, noise = X0 + normal[:, :N] * P0, normal[:, N:].reshape(runs, count, N + M)
    truth, z = np.empty((runs, count + 1, N)), np.empty((runs, count, M))
    _simulate(np.ascontiguousarray(noise), X0, PROBLEM.sqrt_q, R0, truth, z)
    return Draws(truth, z, np.ascontiguousarray(start))


@compiled
def _simulate(noise: Array, x0: Array, sqrt_q: Array, sigma: Array, truth: Array, z: Array) -> None:
    for r in range(len(noise)):
        truth[r, 0] = x0
        for k in range(noise.shape[1]):
            truth[r, k + 1] = turn(truth[r, k]) + sqrt_q @ noise[r, k, :N]
            z[r, k] = radar(truth[r, k + 1]) + sigma * noise[r, k, N:]
            if z[r, k, 1] > np.pi:
                z[r, k, 1] -= 2.0 * np.pi
            elif z[r, k, 1] <= -np.pi:
                z[r, k, 1] += 2.0 * np.pi
