"""A record longer than memory: filtered in batches, its steps on disk, smoothed exactly from its end to its beginning.

Twelve states that are lightly damped rotations, six noise components, three measurements, all matrices different from
step to step. Truth is simulated, so that the errors of the smoothed states can be counted in their own sigmas.
"""

from __future__ import annotations

import resource
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from estimator import LinearModel, Store
from estimator.information import filter, start
from estimator.smoother import Interval, stretches
from estimator.ud import Array

N, P, M = 12, 6, 3
BATCH = 8192  # steps
FEWEST = -(-N // M)  # steps: fewer measurements do not tell the states, of which nothing is known before


class LongRecord(NamedTuple):
    """What it took, and how good it was.

    Attributes
    ----------
    steps, windows : int
    disk : int
        Bytes of snapshots on disk.
    memory : int
        Bytes by which the peak of the process's memory grew.
    filtering, smoothing : float
        Seconds, the simulation not counted.
    error : float
        Root mean square error of the smoothed states, in their own sigmas: 1 for an honest sigma.
    """

    steps: int
    windows: int
    disk: int
    memory: int
    filtering: float
    smoothing: float
    error: float


def batches(steps: int, seed: int = 0) -> Iterator[tuple[LinearModel, Array, Array]]:
    """Yield models of up to BATCH steps with measurements (k, m) and true states (k, n) at their ends."""
    rng = np.random.default_rng(seed)
    half = rng.normal(size=(N, N))
    turn = np.linalg.qr(np.eye(N) + 0.05 * (half - half.T))[0] * 0.999
    x = rng.normal(size=N)
    for a in range(0, steps, BATCH):
        count = min(BATCH, steps - a)
        phi = turn + 1e-3 * rng.normal(size=(count, N, N))
        gamma, h = 0.1 * rng.normal(size=(count, N, P)), rng.normal(size=(count, M, N))
        pushed = np.einsum("jnp,jp->jn", gamma, rng.normal(size=(count, P)))
        truth = np.empty((count, N))
        for j in range(count):
            x = phi[j] @ x + pushed[j]
            truth[j] = x
        z = np.einsum("jmn,jn->jm", h, truth) + rng.normal(size=(count, M))
        yield LinearModel(phi, gamma, np.ones(P), h, np.ones(M)), z, truth


def run(steps: int = 2_000_000, folder: Path | None = None, tell: Callable[[str], None] = lambda _: None) -> LongRecord:
    """Filter and smooth a record, whose snapshots and true states are kept.

    Parameters
    ----------
    steps : int
        At least FEWEST.
    folder : path, optional
        Where they are kept, in "record"; None: in a temporary folder.
    tell : called with a line about what is being done

    Raises
    ------
    ValueError
        Too few steps.
    FileExistsError
        ``folder`` holds an earlier record.
    """
    if steps < FEWEST:
        raise ValueError(f"steps is {steps}: {N} states need {FEWEST} steps of {M} measurements at least")
    if folder is None:
        with tempfile.TemporaryDirectory() as own:
            return run(steps, Path(own), tell)
    if any((folder / "record").glob("*.npy")):
        raise FileExistsError(f"{folder} holds an earlier record: choose a new or an empty folder")
    with tempfile.TemporaryDirectory() as warm:
        list(_pass(min(steps, 300), Path(warm)))  # compiled before anything is counted
    before = _peak()
    windows = disk = 0
    squares = filtering = smoothing = 0.0
    for told in _pass(steps, folder / "record", tell):
        filtering, smoothing, windows, disk = told.filtering, told.smoothing, told.windows, told.disk
        squares += told.error
    error = float(np.sqrt(squares / (steps * N)))
    return LongRecord(steps, windows, disk, _peak() - before, filtering, smoothing, error)


def _pass(steps: int, folder: Path, tell: Callable[[str], None] = lambda _: None) -> Iterator[LongRecord]:
    store, carry, filtering = Store(folder, spill=BATCH), start(N), 0.0
    truths = []
    for i, (model, z, truth) in enumerate(batches(steps)):
        truths.append(folder / f"truth-{i:06d}.npy")
        np.save(truths[-1], truth)
        begun = time.perf_counter()
        carry, _ = filter(model, carry, z, store=store, estimates=False)
        filtering += time.perf_counter() - begun
        if i % 32 == 31:
            tell(f"filtered {(i + 1) * BATCH:,} of {steps:,} steps")
    disk = sum(path.stat().st_size for path in folder.glob("steps-*"))

    def room(a: int, b: int) -> Interval:
        count = b - a + 1
        return Interval(np.empty((count, N, 1)), np.empty((count, N)), np.empty((0, N, N)), np.empty((0, N, N)))

    windows = sum(i < len(store) for i in store.anchors)  # one that ends with the record is followed by none
    begun, waited = time.perf_counter(), 0.0
    for a, part in stretches(store, carry, 0, True, False, False, room):
        paused = time.perf_counter()
        errors = (part.mean[1:, :, 0] - np.load(truths[a // BATCH])) / part.std[1:]
        waited += time.perf_counter() - paused
        spent = time.perf_counter() - begun - waited
        yield LongRecord(steps, windows, disk, 0, filtering, spent, float((errors * errors).sum()))
        if a // BATCH % 32 == 0 and a:
            tell(f"smoothed back to step {a:,}")


def _peak() -> int:
    """The largest resident memory of this process so far, bytes."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
