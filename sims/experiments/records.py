"""Linear Gaussian records to judge filters and smoothers on, and the truth about them.

`benchmark` is well conditioned and long enough to be timed. The families of `STRESS` are short and hard, each in one
way that flight-test data are hard: measurements ten decades better than the prior, nearly the same measurement twice,
no prior, gaps, noise that is silent, modes that grow beside modes that die at once. All have a well-determined answer,
and `truth` computes it with so many digits that none of this matters.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from decimal import Context, Decimal, localcontext
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from estimator import LinearModel

Array = np.ndarray[Any, np.dtype[np.float64]]
Digits = np.ndarray[Any, np.dtype[np.object_]]

DIGITS = 120  # condition numbers of a stress record stay below 1e50, and cancellation squares them
VAGUE = Decimal("1e120")  # variance that stands for no prior information; DIGITS are doubled and doubled again for it
UNKNOWN = 1e50  # a variance above it is what is left of VAGUE


@dataclass(frozen=True, eq=False)
class Record:
    """A model, a prior and measurements; conventions of ``estimator``. Leading axes are 1 (constant) or N.

    Attributes
    ----------
    name : str
    phi : (1|N, n, n) array
    gamma : (1|N, n, p) array
    q : (1|N, p) array
        Variances of the process noise.
    h : (1|N, m, n) array
    r : (1|N, m) array
        Variances of the measurement noise.
    z : (N, m) or (K, N, m) array
        Measurements of one track or of K tracks, NaN = missing.
    x0, p0 : (n,) and (n, n) arrays, or None
        Prior at epoch 0; None: no prior information.
    """

    name: str
    phi: Array
    gamma: Array
    q: Array
    h: Array
    r: Array
    z: Array
    x0: Array | None
    p0: Array | None

    @property
    def n(self) -> int:
        """Number of states."""
        return int(self.phi.shape[2])

    @property
    def steps(self) -> int:
        """Number of steps, N."""
        return int(self.z.shape[-2])

    @property
    def tracks(self) -> int:
        """Number of tracks; 1 when z has two axes."""
        return int(self.z.shape[0]) if self.z.ndim == 3 else 1

    @property
    def varying(self) -> bool:
        """Whether anything of the model varies from step to step."""
        return any(a.shape[0] > 1 for a in (self.phi, self.gamma, self.q, self.h, self.r))

    def model(self, dtype: Any = np.float64) -> LinearModel:
        """The record as the estimator's own model of number type ``dtype``."""
        from estimator import LinearModel

        arrays = [a if a.shape[0] > 1 else a[0] for a in (self.phi, self.gamma, self.q, self.h, self.r)]
        # Rows of variances could be taken for one covariance where there are as many rows as columns.
        arrays = [_full(a) if a.ndim == 2 and k in (2, 4) and len(a) == a.shape[1] else a for k, a in enumerate(arrays)]
        phi, gamma, q, h, r = arrays
        return LinearModel(phi, gamma, q, h, r, dtype=dtype)

    @property
    def prior(self) -> dict[str, Any]:
        """The prior as arguments of ``estimator.smooth``."""
        return {"x0": self.x0, "p0": self.p0}

    def every_step(self) -> tuple[Array, Array, Array, Array, Array]:
        """phi, gamma, q, h and r with a leading axis of N, as views."""
        phi, gamma, q, h, r = (
            np.broadcast_to(a, (self.steps, *a.shape[1:])) for a in (self.phi, self.gamma, self.q, self.h, self.r)
        )
        return phi, gamma, q, h, r

    def cut(self, steps: int) -> Record:
        """The first ``steps`` steps."""
        matrices = {k: a[:steps] for k, a in vars(self).items() if k in ("phi", "gamma", "q", "h", "r")}
        return replace(self, z=np.ascontiguousarray(self.z[..., :steps, :]), **matrices)


def _full(variances: Array) -> Array:
    return variances[:, :, None] * np.eye(variances.shape[1])


def _measure(rng: np.random.Generator, record: Record, x: Array, tracks: int = 1) -> Record:
    """Simulate the record from its own model, from the state(s) ``x`` (n,) at epoch 0; what is NaN in z stays NaN."""
    phi, gamma, q, h, r = record.every_step()
    (steps, p), m = q.shape, r.shape[1]
    z = np.empty((tracks, steps, m))
    for k in range(tracks):
        state = x
        w, v = rng.normal(size=(steps, p)), rng.normal(size=(steps, m))
        for j in range(steps):
            state = phi[j] @ state + gamma[j] @ (np.sqrt(q[j]) * w[j])
            z[k, j] = h[j] @ state + np.sqrt(r[j]) * v[j]
    z = np.where(np.isnan(record.z), np.nan, z if tracks > 1 else z[0])
    return replace(record, z=z)


def benchmark(n: int, p: int, m: int, steps: int, *, tracks: int = 1, varying: bool = False, seed: int = 0) -> Record:
    """A well-conditioned record: lightly damped rotations, Q = G G^T of rank p < n (gamma = G, q = 1), R diagonal.

    Parameters
    ----------
    n, p, m, steps
        Sizes. p = n is allowed.
    tracks
        Tracks of the one model; above 1, z has a leading axis.
    varying
        phi_j is perturbed from step to step, and r with it.
    seed
        The same seed gives the same record.
    """
    rng = np.random.default_rng(seed)
    angles = rng.uniform(0.02, 0.3, (n + 1) // 2)
    turn = np.zeros((n, n))
    for i, angle in enumerate(angles):
        at = slice(2 * i, min(2 * i + 2, n))
        turn[at, at] = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])[
            : n - 2 * i, : n - 2 * i
        ]
    basis = np.linalg.qr(rng.normal(size=(n, n)))[0]
    phi = 0.995 * basis @ turn @ basis.T
    gamma = rng.normal(size=(n, p)) / np.sqrt(n)
    h = rng.normal(size=(m, n)) / np.sqrt(n)
    r = rng.uniform(0.05, 0.5, m)
    transitions, variances = phi[None], r[None]
    if varying:
        transitions = phi + 0.01 / np.sqrt(n) * rng.normal(size=(steps, n, n))
        variances = r * rng.uniform(0.5, 2.0, (steps, m))
    record = Record(
        f"{n},{p},{m}", transitions, gamma[None], np.ones((1, p)), h[None], variances, np.zeros((steps, m)),
        np.zeros(n), np.eye(n),
    )  # fmt: skip
    return _measure(rng, record, rng.normal(size=n), tracks)


def _axes(name: str, axes: int, steps: int) -> Record:
    """Constant velocity along several axes, position measured: R = 1e-10 under a prior of 1e10."""
    rng = np.random.default_rng(axes)
    dt, n = 0.1, 2 * axes
    phi, gamma, h = np.eye(n), np.zeros((n, axes)), np.zeros((axes, n))
    for i in range(axes):
        phi[2 * i, 2 * i + 1] = dt
        gamma[2 * i : 2 * i + 2, i] = dt * dt / 2, dt
        h[i, 2 * i] = 1.0
    record = Record(
        name, phi[None], gamma[None], np.ones((1, axes)), h[None], np.full((1, axes), 1e-10), np.zeros((steps, axes)),
        np.zeros(n), 1e10 * np.eye(n),
    )  # fmt: skip
    return _measure(rng, record, rng.normal(size=n))


def three_axes() -> Record:
    """Three axes of constant velocity, R = 1e-10 under a prior of 1e10, 100 steps."""
    return _axes("3 axes", 3, 100)


def fifteen_axes() -> Record:
    """Fifteen axes of constant velocity, n = 30, 30 steps."""
    return _axes("15 axes", 15, 30)


def collinear() -> Record:
    """Bierman and Thornton's two measurements that are nearly one: rows [1 1 1] and [1 1 1+1e-5], R = 1e-10, Q rank 1.

    References
    ----------
    G. J. Bierman and C. L. Thornton, "Numerical comparison of Kalman filter algorithms: orbit determination case
    study", Automatica 13 (1977) 23-35.
    """
    rng = np.random.default_rng(3)
    h = np.array([[1.0, 1.0, 1.0], [1.0, 1.0, 1.0 + 1e-5]])
    gamma = np.array([[1.0], [-0.5], [0.3]])
    record = Record(
        "collinear", np.eye(3)[None], gamma[None], np.ones((1, 1)), h[None], np.full((1, 2), 1e-10), np.zeros((60, 2)),
        np.zeros(3), 1e6 * np.eye(3),
    )  # fmt: skip
    return _measure(rng, record, rng.normal(size=3))


def _random(
    name: str, seed: int, *, modes: tuple[float, ...] = (0.7, 0.9, 0.97, 1.0), r: tuple[float, float] = (0.1, 1.0),
    p0: float | None = 1.0, missing: float = 0.0, silent: float = 0.0, no_input: float = 0.0, steps: int = 40,
) -> Record:  # fmt: skip
    """A random time-varying record of four states, hard in the ways asked for."""
    rng = np.random.default_rng(seed)
    n, p, m = len(modes), 2, 2
    basis = np.linalg.qr(rng.normal(size=(n, n)))[0]
    phi = basis @ np.diag(modes) @ basis.T * np.ones((steps, 1, 1))
    if max(modes) <= 1.0 and min(modes) > 0.1:
        phi = phi + 0.05 * rng.normal(size=(steps, n, n))
        phi /= np.maximum(np.abs(np.linalg.eigvals(phi)).max(axis=1), 1.0)[:, None, None]
    gamma = rng.normal(size=(steps, n, p))
    gamma[rng.random(steps) < no_input] = 0.0
    q = np.exp(rng.uniform(np.log(0.1), 0.0, (steps, p))) * (rng.random((steps, p)) >= silent)
    h = rng.normal(size=(steps, m, n))
    variances = np.exp(rng.uniform(np.log(r[0]), np.log(r[1]), (steps, m)))
    z = np.where(rng.random((steps, m)) < missing, np.nan, 0.0)
    z[rng.random(steps) < missing / 2] = np.nan
    prior = (np.zeros(n), p0 * np.eye(n)) if p0 is not None else (None, None)
    return _measure(rng, Record(name, phi, gamma, q, h, variances, z, *prior), rng.normal(size=n))


def near_perfect() -> Record:
    """Measurements of R = 1e-12 under a prior of 1e8."""
    return _random("R 1e-12", 11, r=(1e-12, 1.0001e-12), p0=1e8)


def no_prior() -> Record:
    """Nothing is known at the start."""
    return _random("no prior", 12, p0=None)


def gaps() -> Record:
    """Most samples are missing, singly and by rows, under a prior of 1e8."""
    return _random("gaps", 13, missing=0.6, p0=1e8)


def silent() -> Record:
    """Half of the noise variances are zero; R = 1e-8 under a prior of 1e6."""
    return _random("zero q", 14, silent=0.5, r=(1e-8, 1e-7), p0=1e6)


def no_input() -> Record:
    """At half of the steps no noise enters at all, Gamma = 0; R = 1e-8 under a prior of 1e6."""
    return _random("gamma 0", 15, no_input=0.5, r=(1e-8, 1e-7), p0=1e6)


def mixed() -> Record:
    """Measurement variances from 1e-12 to 1e6, side by side."""
    return _random("R mixed", 16, r=(1e-12, 1e6), p0=1e8)


def unstable() -> Record:
    """One mode grows by 30 % a step, one is gone after two."""
    return _random("unstable", 17, modes=(1e-4, 0.5, 1.0, 1.3), r=(1e-8, 1e-4), p0=1e6)


def everything() -> Record:
    """All of it together."""
    return _random(
        "all", 18, modes=(0.05, 0.5, 1.0, 1.3), r=(1e-12, 1e6), p0=1e8, missing=0.3, silent=0.3, no_input=0.2
    )


def dying() -> Record:
    """Beyond float64: a mode that shrinks 1e4-fold a step while noise pauses for several steps.

    The state is then known in that direction to less than 1e-16 of the others. Sixteen digits of a square root of the
    information do not hold both, and on the way back a smoother divides by what has been lost. Covariance filters may
    forget the direction unpunished, and so may Watanabe's smoother, which never inverts phi.
    """
    modes = (1e-4, 0.5, 1.0, 1.3)
    return _random("dying", 18, modes=modes, r=(1e-12, 1e6), p0=1e8, missing=0.3, silent=0.3, no_input=0.2)


STRESS: tuple[Callable[[], Record], ...] = (
    three_axes, fifteen_axes, collinear, near_perfect, no_prior, gaps, silent, no_input, mixed, unstable, everything,
)  # fmt: skip
LIMITS: tuple[Callable[[], Record], ...] = (dying,)  # beyond "ms": shown, and not promised


class Truth(NamedTuple):
    """The answer, rounded once to float64: all (N+1, n); NaN and infinity where nothing is known yet."""

    mean: Array
    std: Array
    filtered_mean: Array
    filtered_std: Array


def truth(record: Record) -> Truth:
    """Filtered and smoothed means and standard deviations of one track, in decimal arithmetic of 120 digits.

    The covariance Kalman filter, one scalar measurement after the other, and the smoother of Bryson and Frazier in
    Bierman's form [1]_, which inverts nothing:

        Lambda <- h^T h / s + C^T Lambda C,  lambda <- -h^T nu / s + C^T lambda,  C = I - K h      per scalar
        Lambda <- phi^T Lambda phi,          lambda <- phi^T lambda                                per step
        x_{j/N} = x_{j/j} - P_{j/j} lambda,  P_{j/N} = P_{j/j} - P_{j/j} Lambda P_{j/j}

    No prior information is a prior of 1e120, and 480 digits. The arithmetic and the algorithm are not the
    estimator's, and the cost is O(N n^3).

    References
    ----------
    .. [1] G. J. Bierman, "Fixed interval smoothing with discrete measurements", International Journal of Control 18
       (1973) 65-75.
    """
    with localcontext(Context(prec=DIGITS if record.p0 is not None else 4 * DIGITS)):
        return _truth(record)


def _truth(record: Record) -> Truth:
    exactly = np.vectorize(Decimal, otypes=[object])
    steps, n = record.steps, record.n
    phi, gamma, q, h, r = record.every_step()
    constant = exactly(record.phi[0]) if record.phi.shape[0] == 1 else None
    x = exactly(np.zeros(n) if record.x0 is None else record.x0)
    cov = exactly(np.eye(n)) * VAGUE if record.p0 is None else exactly(record.p0)
    filtered, used = [(x, cov)], []
    for j in range(steps):
        f, g = exactly(phi[j]) if constant is None else constant, exactly(gamma[j])
        x, cov = f.dot(x), f.dot(cov).dot(f.T) + (g * exactly(q[j])).dot(g.T)
        scalars = []
        for c in np.flatnonzero(~np.isnan(record.z[j])):
            row = exactly(h[j, c])
            ph = cov.dot(row)
            s = row.dot(ph) + Decimal(float(r[j, c]))
            nu = Decimal(float(record.z[j, c])) - row.dot(x)
            gain = ph / s
            x, cov = x + gain * nu, cov - np.outer(gain, ph)
            scalars.append((row, gain, s, nu))
        filtered.append((x, cov))
        used.append((f, scalars))
    adjoint, adjoints = exactly(np.zeros(n)), exactly(np.zeros((n, n)))
    smoothed = [filtered[-1]]
    for j in range(steps - 1, -1, -1):
        f, scalars = used[j]
        for row, gain, s, nu in reversed(scalars):
            across = adjoints.dot(gain)
            adjoints = adjoints - np.outer(row, across) - np.outer(across, row)
            adjoints = adjoints + np.outer(row, row) * (gain.dot(across) + 1 / s)
            adjoint = adjoint - row * (gain.dot(adjoint) + nu / s)
        adjoint, adjoints = f.T.dot(adjoint), f.T.dot(adjoints).dot(f)
        x, cov = filtered[j]
        pa = cov.dot(adjoints)
        smoothed.append((x - cov.dot(adjoint), cov - pa.dot(cov)))
    mean, std = _rounded(smoothed[::-1])
    return Truth(mean, std, *_rounded(filtered))


def _rounded(estimates: list[tuple[Digits, Digits]]) -> tuple[Array, Array]:
    mean = np.array([[float(v) for v in x] for x, _ in estimates])
    std = np.array([[float(v.sqrt()) for v in np.diag(cov)] for _, cov in estimates])
    unknown = (std * std > UNKNOWN).any(axis=1)
    mean[unknown], std[unknown] = np.nan, np.inf
    return mean, std
