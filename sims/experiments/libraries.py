"""Filters and smoothers of other libraries, and our own, behind one protocol: a record in, estimates out.

Every estimator gets the same arrays and returns means and full covariances of the epochs 1..N (our filter returns means
and standard deviations). Several libraries set the prior at the first measured state; for them the prior at epoch 0 is
moved one transition on: x_1 = phi_0 x_0, P_1 = phi_0 P_0 phi_0^T + gamma_0 Q_0 gamma_0^T. A library is imported when it
is used; one that is not installed says so.
"""

from __future__ import annotations

import atexit
import importlib
import importlib.util
import os
import sys
import threading
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple, Protocol

import numpy as np

from sims.experiments.records import Array, Record

ABSENT = "not installed"
PATIENCE = 30.0  # seconds for one call of a JAX library, compilation included


class Estimates(NamedTuple):
    """Means (.., N, n) with covariances (.., N, n, n), or with standard deviations (.., N, n) where that is all."""

    mean: Array
    covariance: Array | None
    std: Array | None = None


Run = Callable[[], Estimates]


class Refused(Exception):
    """An estimator that by its nature cannot take this record; says why in a few words."""


class Peer(Protocol):
    """A filter and smoother under comparison.

    Attributes
    ----------
    name : str
    many : bool
        Whether it takes many tracks of one model in one call.
    slow : bool
        Whether its loop over steps is interpreted: it then gets fewer steps, and time per step is what is compared.
    alone : bool
        Whether its filter runs without its smoother, and so has a time of its own.
    """

    name: str
    many: bool
    slow: bool
    alone: bool

    def available(self) -> str | None:
        """Why it cannot run here, or None."""
        ...

    def prepare(self, record: Record) -> tuple[Run | None, Run | None]:
        """Its filter and its smoother (with the filter in it) for one record, ready to be timed; None: has none.

        Raises
        ------
        Refused
            The record has something that it does not know: gaps, no prior, a varying model.
        """
        ...


class _Known:
    """What most have in common: one track, compiled, available where its modules are installed."""

    many, slow, alone = False, False, True
    modules: ClassVar[tuple[str, ...]] = ()

    def available(self) -> str | None:
        """Why it cannot run here, or None."""
        missing = [module for module in self.modules if importlib.util.find_spec(module) is None]
        return ABSENT if missing else None


def _moved(record: Record) -> tuple[Array, Array]:
    """Prior of the first measured state."""
    x0, p0 = _prior(record)
    phi, root = record.phi[0], record.gamma[0] * np.sqrt(record.q[0])
    moved = phi @ p0 @ phi.T + root @ root.T
    return phi @ x0, (moved + moved.T) / 2


def _prior(record: Record) -> tuple[Array, Array]:
    if record.x0 is None or record.p0 is None:
        raise Refused("needs a prior")
    return record.x0, record.p0


def _noise(record: Record) -> tuple[Array, Array]:
    """Gamma Q Gamma^T (1|N, n, n) and R (1|N, m, m)."""
    root = record.gamma * np.sqrt(record.q)[:, None, :]
    return root @ root.transpose(0, 2, 1), record.r[:, :, None] * np.eye(record.r.shape[1])


def _rows_only(record: Record) -> None:
    """Refuse rows of which a part is missing."""
    lost = np.isnan(record.z)
    if (lost.any(axis=-1) & ~lost.all(axis=-1)).any():
        raise Refused("partial rows")


def _one(record: Record) -> None:
    if record.tracks > 1:
        raise Refused("one track")


def _forward(method: str) -> Callable[..., tuple[Array, Array]] | None:
    """The filter alone of one of our rivals: model, z, x0 and p0 in, mean and standard deviation (N+1, n) out."""
    from estimator import rivals

    module = importlib.import_module(rivals.METHODS[method])
    found: Callable[..., tuple[Array, Array]] | None = getattr(module, "filtered", None)
    return found


class Ours(_Known):
    """`estimator.smooth` with one of its methods; a filter is the forward pass alone where there is one to be had.

    It is `estimator.information.filter` of "ms" and ``filtered`` of "rts" and "joseph"; "bierman" filters with its
    smoother behind it, and is charged with what that one raises. Of many tracks "ms" returns the covariances once,
    because they are the same.
    """

    def __init__(self, method: str = "ms", dtype: Any = np.float64, threads: int = 1) -> None:
        self.method, self.dtype, self.threads = method, np.dtype(dtype), threads
        single = ", float32" if self.dtype == np.float32 else ""
        self.name = f"ours, {method}{single}" + (f", {threads} threads" if threads > 1 else "")
        self.many = method == "ms"
        self.forward = None if method == "ms" else _forward(method)
        self.alone = self.many or self.forward is not None

    def prepare(self, record: Record) -> tuple[Run | None, Run | None]:
        """As `Peer.prepare`."""
        from estimator import smooth
        from estimator.information import filter, start

        model = record.model(self.dtype)
        z = record.z.astype(self.dtype)

        def smoother() -> Estimates:
            found = smooth(
                model, z, **record.prior, method=self.method, want=("mean", "covariance"), threads=self.threads
            )
            return Estimates(found.mean[..., 1:, :], found.covariance[..., 1:, :, :])

        def information() -> Estimates:
            carry = start(model.n, **record.prior, records=record.tracks, dtype=self.dtype)
            found = filter(model, carry, z)[1]
            return Estimates(found.mean, None, found.std)

        def filtered() -> Estimates:
            if self.forward is not None:
                mean, std = self.forward(model, z, record.x0, record.p0)
                return Estimates(mean[1:], None, std[1:])
            found = smooth(model, z, **record.prior, method=self.method, want=("mean", "filtered"))
            return Estimates(found.filtered_mean[1:], None, found.filtered_std[1:])

        if self.method == "ms":
            return information if self.threads == 1 else None, smoother
        # Watanabe's first pass runs backward: there is no filter in it.
        return None if self.method == "watanabe" else filtered, smoother


class Numpy(_Known):
    """The covariance Kalman filter in Joseph's form and the RTS smoother, in numpy: matrix products per step.

    The covariances of many tracks of one model without gaps are one sequence, computed once.
    """

    name, many, slow = "numpy, Joseph and RTS", True, True

    def prepare(self, record: Record) -> tuple[Run | None, Run | None]:
        """As `Peer.prepare`."""
        x0, p0 = _prior(record)
        (qs, rs), (phi, _, _, h, _) = _noise(record), record.every_step()
        q, r = (np.broadcast_to(a, (record.steps, *a.shape[1:])) for a in (qs, rs))
        z, n, lost = record.z, record.n, np.isnan(record.z)
        if record.tracks > 1 and lost.any():
            raise Refused("gaps in many tracks")
        shape = (*z.shape[:-1], n)

        def run(smoothing: bool) -> Estimates:
            mean, cov = np.empty(shape), np.empty((record.steps, n, n))
            x_pred, p_pred = np.empty(shape), np.empty_like(cov)
            x, p, unit = np.broadcast_to(x0, (*shape[:-2], n)), p0, np.eye(n)
            for j in range(record.steps):
                x, p = x @ phi[j].T, phi[j] @ p @ phi[j].T + q[j]
                x_pred[..., j, :], p_pred[j] = x, p
                rows, noise, seen = h[j], r[j], z[..., j, :]
                if lost[..., j, :].any():
                    there = ~lost[j]
                    rows, noise, seen = rows[there], noise[np.ix_(there, there)], seen[there]
                if len(rows):
                    ph = p @ rows.T
                    gain = np.linalg.solve(rows @ ph + noise, ph.T).T
                    x = x + (seen - x @ rows.T) @ gain.T
                    keep = unit - gain @ rows
                    p = keep @ p @ keep.T + gain @ noise @ gain.T
                mean[..., j, :], cov[j] = x, p
            if smoothing:
                for j in range(record.steps - 2, -1, -1):
                    gain = np.linalg.solve(p_pred[j + 1], phi[j + 1] @ cov[j]).T
                    mean[..., j, :] += (mean[..., j + 1, :] - x_pred[..., j + 1, :]) @ gain.T
                    cov[j] += gain @ (cov[j + 1] - p_pred[j + 1]) @ gain.T
            return Estimates(mean, np.broadcast_to(cov, (*shape, n)))

        return lambda: run(False), lambda: run(True)


class FilterPy(_Known):
    """filterpy's KalmanFilter: batch_filter (Joseph's form) and rts_smoother."""

    name, slow = "filterpy", True
    modules = ("filterpy", "scipy")

    def prepare(self, record: Record) -> tuple[Run | None, Run | None]:
        """As `Peer.prepare`; rows of which a part is missing become measurements of fewer rows."""
        from filterpy.kalman import KalmanFilter

        _one(record)
        x0, p0 = _prior(record)
        steps, there = range(record.steps), ~np.isnan(record.z)
        qs, rs = (np.broadcast_to(a, (record.steps, *a.shape[1:])) for a in _noise(record))
        phi, hs = record.every_step()[0], record.every_step()[3]
        zs = [record.z[j][there[j]] if there[j].any() else None for j in steps]
        h = [hs[j][there[j]] for j in steps]
        r = [rs[j][np.ix_(there[j], there[j])] for j in steps]

        def filtered() -> tuple[Any, Estimates]:
            kalman = KalmanFilter(record.n, record.z.shape[1])
            kalman.x, kalman.P = x0.copy(), p0.copy()
            mean, cov, _, _ = kalman.batch_filter(zs, Fs=phi, Qs=qs, Hs=h, Rs=r)
            return kalman, Estimates(mean, cov)

        def smoothed() -> Estimates:
            kalman, (mean, cov, _) = filtered()
            return Estimates(*kalman.rts_smoother(mean, cov, phi, qs)[:2])

        return lambda: filtered()[1], smoothed


class PyKalman(_Known):
    """pykalman's KalmanFilter; it drops a whole row when one element of it is masked."""

    name, slow = "pykalman", True
    modules = ("pykalman",)

    def prepare(self, record: Record) -> tuple[Run | None, Run | None]:
        """As `Peer.prepare`."""
        from pykalman import KalmanFilter

        _one(record)
        _rows_only(record)
        x1, p1 = _moved(record)
        q, r = _noise(record)

        def next_steps(a: Array) -> Array:
            return a[1:] if a.shape[0] > 1 else a[0]

        def per_step(a: Array) -> Array:
            return a if a.shape[0] > 1 else a[0]

        kalman = KalmanFilter(
            next_steps(record.phi), per_step(record.h), next_steps(q), per_step(r),
            initial_state_mean=x1, initial_state_covariance=p1,
        )  # fmt: skip
        z = np.ma.masked_invalid(record.z)
        return lambda: Estimates(*kalman.filter(z)), lambda: Estimates(*kalman.smooth(z))


class Statsmodels(_Known):
    """statsmodels' compiled KalmanSmoother; tolerance 0 keeps its shortcut to the steady state from being taken.

    Without a prior and with a phi that varies its smoother is wrong at the first epoch alone (0.15.0): its filter there
    and its smoother everywhere else are right to 1e-12, and with a constant phi all of it is.
    """

    modules = ("statsmodels",)

    def __init__(self, univariate: bool = False, tolerance: float | None = 0.0) -> None:
        self.univariate, self.tolerance = univariate, tolerance
        kind = "univariate" if univariate else "conventional" if tolerance is not None else "defaults"
        self.name = f"statsmodels, {kind}"

    def prepare(self, record: Record) -> tuple[Run | None, Run | None]:
        """As `Peer.prepare`; no prior is its exact diffuse start."""
        from statsmodels.tsa.statespace.kalman_filter import FILTER_CONVENTIONAL, FILTER_UNIVARIATE
        from statsmodels.tsa.statespace.kalman_smoother import SMOOTHER_STATE, SMOOTHER_STATE_COV, KalmanSmoother

        _one(record)
        if record.x0 is None and not self.univariate:
            raise Refused("needs a prior")
        m, (n, p) = record.z.shape[1], record.gamma.shape[1:]
        extra = {} if self.tolerance is None else {"tolerance": self.tolerance}
        space = KalmanSmoother(m, n, p, **extra)
        space.filter_method = FILTER_UNIVARIATE if self.univariate else FILTER_CONVENTIONAL
        space.smoother_output = SMOOTHER_STATE | SMOOTHER_STATE_COV
        space.bind(np.ascontiguousarray(record.z))

        def ahead(a: Array) -> Array:  # its transition t leads from t to t + 1, and its axis of time is the last
            return np.moveaxis(np.concatenate([a[1:], a[-1:]]), 0, -1)

        space["transition"], space["selection"] = ahead(record.phi), ahead(record.gamma)
        space["state_cov"] = ahead(record.q[:, :, None] * np.eye(p))
        space["design"] = np.moveaxis(record.h, 0, -1)
        space["obs_cov"] = np.moveaxis(_noise(record)[1], 0, -1)
        if record.x0 is None:
            space.initialize_diffuse()
        else:
            space.initialize_known(*_moved(record))

        def filtered() -> Estimates:
            found = space.filter()
            return Estimates(found.filtered_state.T, np.moveaxis(found.filtered_state_cov, -1, 0))

        def smoothed() -> Estimates:
            found = space.smooth()
            return Estimates(found.smoothed_state.T, np.moveaxis(found.smoothed_state_cov, -1, 0))

        return filtered, smoothed


class SimdKalman(_Known):
    """simdkalman: numpy over many tracks of one constant model; it drops a row when one element is missing."""

    name, many, slow = "simdkalman", True, True
    modules = ("simdkalman",)

    def prepare(self, record: Record) -> tuple[Run | None, Run | None]:
        """As `Peer.prepare`."""
        from simdkalman import KalmanFilter

        if record.varying:
            raise Refused("constant model")
        _rows_only(record)
        x1, p1 = _moved(record)
        q, r = _noise(record)
        kalman = KalmanFilter(record.phi[0], q[0], record.h[0], r[0])
        z = record.z.reshape(record.tracks, record.steps, -1)

        def run(smoothing: bool) -> Estimates:
            found = kalman.compute(z, 0, x1, p1, smoothed=smoothing, filtered=not smoothing, observations=False)
            states = found.smoothed.states if smoothing else found.filtered.states
            return Estimates(states.mean, states.cov) if record.tracks > 1 else Estimates(states.mean[0], states.cov[0])

        return lambda: run(False), lambda: run(True)


def _leave() -> None:
    """End the process at once: its ordinary end would abort in the thread that XLA never gave back."""
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(0)


class _Jax(_Known):
    """What the JAX libraries share: float64 is switched on, and results are waited for, but not for ever.

    XLA on few cores has been seen to stop for good without using the processor (jaxlib 0.10.2, 64 tracks of n = 30). A
    call is then given up, and with it all later ones in this process: they would wait for the same threads.
    """

    many = True
    stuck = False

    def __init__(self) -> None:
        self._compiled: dict[tuple[str, bool], Any] = {}

    def _run(self, task: str, function: Callable[..., Any], record: Record, *arguments: Any) -> Run:
        """``function`` of model arguments and z, compiled once per shape, over the tracks of z where there are many."""
        import jax

        many = record.tracks > 1
        if (task, many) not in self._compiled:
            mapped = jax.vmap(function, (*[None] * len(arguments), 0)) if many else function
            self._compiled[task, many] = jax.jit(mapped)
        compiled, z = self._compiled[task, many], jax.numpy.asarray(record.z)

        def call(answer: list[Estimates | Exception]) -> None:
            try:
                mean, cov = jax.block_until_ready(compiled(*arguments, z))
                answer.append(Estimates(np.asarray(mean), np.asarray(cov)))
            except Exception as error:
                answer.append(error)

        def run() -> Estimates:
            answer: list[Estimates | Exception] = []
            if not _Jax.stuck:
                thread = threading.Thread(target=call, args=(answer,), daemon=True)
                thread.start()
                thread.join(PATIENCE)
            if not answer:
                if not _Jax.stuck:
                    atexit.register(_leave)
                _Jax.stuck = True
                raise TimeoutError("XLA stopped")
            if isinstance(answer[0], Exception):
                raise answer[0]
            return answer[0]

        return run


class Dynamax(_Jax):
    """dynamax: lgssm_filter and lgssm_smoother under jit, over tracks by vmap (XLA then shares the covariances)."""

    name, modules = "dynamax", ("jax", "dynamax")

    def prepare(self, record: Record) -> tuple[Run | None, Run | None]:
        """As `Peer.prepare`."""
        import jax

        jax.config.update("jax_enable_x64", True)
        from dynamax.linear_gaussian_ssm import inference

        if np.isnan(record.z).any():
            raise Refused("no gaps")
        x1, p1 = _moved(record)
        q, r = _noise(record)

        def per_step(a: Array) -> Any:  # its transition t leads from t - 1 to t, and the first is not used
            return jax.numpy.asarray(a if a.shape[0] > 1 else a[0])

        initial, dynamics = inference.ParamsLGSSMInitial, inference.ParamsLGSSMDynamics
        n, m = record.n, record.z.shape[-1]
        parameters = inference.ParamsLGSSM(
            initial(jax.numpy.asarray(x1), jax.numpy.asarray(p1)),
            dynamics(per_step(record.phi), jax.numpy.zeros(n), jax.numpy.zeros((n, 0)), per_step(q)),
            inference.ParamsLGSSMEmissions(
                per_step(record.h), jax.numpy.zeros(m), jax.numpy.zeros((m, 0)), per_step(r)
            ),
        )

        def filtered(model: Any, z: Any) -> Any:
            found = inference.lgssm_filter(model, z)
            return found.filtered_means, found.filtered_covariances

        def smoothed(model: Any, z: Any) -> Any:
            found = inference.lgssm_smoother(model, z)
            return found.smoothed_means, found.smoothed_covariances

        return self._run("filter", filtered, record, parameters), self._run("smooth", smoothed, record, parameters)


class Cuthbert(_Jax):
    """cuthbertlib: its square-root predict, update and RTS step of Park and Kailath, driven by a scan under jit."""

    name, modules = "cuthbertlib, square root", ("jax", "cuthbertlib")

    def prepare(self, record: Record) -> tuple[Run | None, Run | None]:
        """As `Peer.prepare`."""
        import jax

        jax.config.update("jax_enable_x64", True)
        from cuthbertlib.kalman import filtering, smoothing

        jnp = jax.numpy
        x0, p0 = _prior(record)
        root_q = record.gamma * np.sqrt(record.q)[:, None, :]
        root_r = np.sqrt(record.r)[:, :, None] * np.eye(record.r.shape[1])
        varies = [a.shape[0] > 1 for a in (record.phi, root_q, record.h, root_r)]
        arrays = tuple(
            jnp.asarray(a if v else a[0]) for a, v in zip((record.phi, root_q, record.h, root_r), varies, strict=True)
        )

        def at(model: Any, j: Any) -> Any:
            return tuple(a[j] if a.ndim == 3 else a for a in model)

        def forward(prior: Any, model: Any, z: Any) -> Any:
            n, m = prior[0].size, z.shape[1]

            def step(carry: Any, j: Any) -> Any:
                phi, q, h, r = at(model, j)
                carry = filtering.predict(*carry, phi, jnp.zeros(n), q)
                carry, _ = filtering.update(*carry, h, jnp.zeros(m), r, z[j])
                return carry, carry

            return jax.lax.scan(step, prior, jnp.arange(z.shape[0]))

        def filtered(prior: Any, model: Any, z: Any) -> Any:
            mean, root = forward(prior, model, z)[1]
            return mean, root @ root.transpose(0, 2, 1)

        def smoothed(prior: Any, model: Any, z: Any) -> Any:
            last, (mean, root) = forward(prior, model, z)
            n = prior[0].size

            def step(carry: Any, known: Any) -> Any:
                j, x, s = known
                phi, q, _, _ = at(model, j + 1)
                square = jnp.zeros((n, n)).at[:, : q.shape[1]].set(q)
                carry, _ = smoothing.update(x, s, *carry, phi, jnp.zeros(n), square)
                return carry, carry

            known = jnp.arange(z.shape[0] - 1), mean[:-1], root[:-1]
            _, (x, s) = jax.lax.scan(step, last, known, reverse=True)
            x, s = jnp.concatenate([x, last[0][None]]), jnp.concatenate([s, last[1][None]])
            return x, s @ s.transpose(0, 2, 1)

        prior = jnp.asarray(x0), jnp.asarray(np.linalg.cholesky(p0))
        return self._run("filter", filtered, record, prior, arrays), self._run(
            "smooth", smoothed, record, prior, arrays
        )


def ours() -> list[Peer]:
    """`estimator.smooth` with each of its methods, "ms" first and again on two threads."""
    from estimator import rivals

    return [Ours(), Ours(threads=2), *(Ours(method) for method in rivals.METHODS)]


def others() -> list[Peer]:
    """The numpy reference and every library, installed or not."""
    return [
        Numpy(), FilterPy(), PyKalman(), Statsmodels(), Statsmodels(univariate=True), Statsmodels(tolerance=None),
        SimdKalman(), Dynamax(), Cuthbert(),
    ]  # fmt: skip
