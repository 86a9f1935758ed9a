"""A stretch of flight, filtered and smoothed with its parameters beside the states."""

from __future__ import annotations

from typing import Literal, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from estimator import extended
from estimator.extended import WALKS, Carry, Drive
from estimator.models.flight_path import FlightPath
from estimator.separated.backward import backward
from estimator.separated.forward import forward
from estimator.separated.structures import Known, Rows, Split
from estimator.stretch import BLOCK, KEPT, WINDOW, Diverged
from estimator.sweeps import terminal

Floats = NDArray[np.float64]
Form: TypeAlias = Literal["corrected", "free", "paper"]


class Separated(NamedTuple):
    """A stretch of flight, states and parameters apart; states are named as by ``FlightPath``, N + 1 epochs.

    Attributes
    ----------
    mean, std (N+1, n) : smoothed; std NaN where none was wanted
    filtered, filtered_std (N, n) : at the ends of the steps
    names, units : of the parameters
    value, sigma (k,) : of the parameters, SI
    nis (N, 10) : squared innovations over their variances, NaN = absent
    constant : bool
        The parameters walk in the settings, and are constants here.
    """

    mean: Floats
    std: Floats
    filtered: Floats
    filtered_std: Floats
    names: tuple[str, ...]
    units: tuple[str, ...]
    value: Floats
    sigma: Floats
    nis: Floats
    constant: bool


def separated(
    flight: FlightPath, carry: Carry, drive: Drive, *, form: Form = "corrected", window: int = WINDOW,
    block: int = BLOCK, smooth: bool = True,
) -> Separated:  # fmt: skip
    """Filter and smooth N steps, parameters beside the states.

    Parameters
    ----------
    flight : FlightPath
    carry : Carry
        The start, as of `FlightPath.start`; it is not changed.
    drive : Drive
        The steps. There is no gate: measurements to be left out are NaN.
    form : {"corrected", "free", "paper"}
        As told of the package.
    window : int
        Steps between anchors; the result does not depend on it.
    block : int
        Steps whose snapshots are made again on the way back where there are more than 8 such blocks; nor on this.
    smooth : bool
        Without it `mean` and `std` have no rows.

    Raises
    ------
    Diverged
        A result is not finite.
    ValueError
        There are no steps, or the form is none of the three.
    """
    if form not in ("corrected", "free", "paper"):
        raise ValueError(f"form {form!r} is none of corrected, free, paper")
    model, n, total = flight.model, flight.n, len(drive.dt)
    if total == 0:
        raise ValueError("there are no steps to filter")
    split, free, paper = Split.of(model), form == "free", form == "paper"
    known = Known.of(model, split, carry)
    k = split.fixed.size
    x, q, b = np.empty((total + 1, n)), np.empty((total + 1, 4)), np.zeros((total + 1, k))
    std, nis, filtered = np.full((total, n), np.nan), np.empty((total, 10)), np.empty((total, n))
    begins: list[Known] = []
    kept: dict[int, Rows] = {}
    spare: Rows | None = None

    def run(first: int, state: Known, rows: Rows, again: bool) -> Rows:
        stop = min(first + block, total)
        part, rows = drive.part(first, stop), rows.part(stop - first)
        said = (std[first:stop], nis[first:stop])
        if again:
            part = part._replace(shown=np.zeros(stop - first, np.uint8))
            said = (np.empty((stop - first, n)), np.empty((stop - first, 10)))
        wrong = forward(model, split, part, window, free, not paper, state, smooth, rows, *said)
        if wrong >= 0:
            raise Diverged(first + wrong)
        return rows

    for first in range(0, total, block):
        begins.append(known.copy())
        known.clock[:] = 0
        if len(kept) == KEPT:
            spare = kept.pop(min(kept))
        room = spare if spare is not None else Rows.empty(min(block, total), split, window)
        spare = None
        kept[first] = rows = run(first, known, room, False)
        stop = first + len(rows.closed)
        extended.named(model, rows.x, rows.q, True, filtered[first:stop])
        b[first + 1 : stop + 1] = rows.b
    values = known.ref[split.fixed] + known.b[1:]
    root = np.linalg.inv(known.ub[:, 1:])
    sigma = np.sqrt(np.square(root) @ (1.0 / known.db))
    names, units = (tuple(of[i] for i in split.fixed_at) for of in (flight.names, flight.units))
    nothing = np.empty((0, n))
    result = Separated(nothing, nothing, filtered, std, names, units, values, sigma, nis, flight.p > WALKS)
    if not smooth:
        return result
    m = split.moving.size
    star, stars, vt, d = np.empty((m, 1 + k)), np.empty((m, k)), np.empty((m, m)), np.empty(m)
    terminal(known.ut, known.d, star, vt, d)
    mean_star = star[:, 0].copy()
    stars[:, :] = star[:, 1:]
    if not paper:
        b[:] = known.b[1:]
    smoothed_std = np.full((total + 1, n), np.nan)
    shown = np.concatenate([[1], drive.shown]).astype(np.uint8)
    for number in range(len(begins) - 1, -1, -1):
        first = number * block
        begin = begins[number]
        if first in kept:
            rows = kept.pop(first)
        else:
            state = begin.copy()
            state.clock[:] = 0
            rows = run(first, state, Rows.empty(block, split, window), True)
        here = slice(first, first + len(rows.closed) + 1)
        backward(
            split, rows, begin, known, b[here], paper, not paper, mean_star, stars, vt, d, shown[here], True, x[here],
            q[here], smoothed_std[here],
        )  # fmt: skip
    mean = np.empty((total + 1, n))
    extended.named(model, x, q, True, mean)
    return result._replace(mean=mean, std=smoothed_std)
