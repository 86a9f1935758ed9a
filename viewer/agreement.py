"""Agreement: how far apart two recordings of one flight are, state by state, measured by their own error bars."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from viewer.columns import first, place, role
from viewer.reading import Reading
from viewer.review import estimator
from viewer.states import order
from viewer.summary import finite

if TYPE_CHECKING:
    from rich.console import Console

Floats = NDArray[np.float64]

ANGLES = ("roll", "pitch", "heading")  # differences of which are turned to the nearer side


class State(msgspec.Struct, kw_only=True):
    """One state in two recordings.

    Parameters
    ----------
    vehicle, model, stage, name
        As in the path of the state; `stage` is "live" or "window".
    rows : int
        Estimates of the same sample in both, told in both: what the figures are of.
    alone : list of int
        Estimates that only the one, and only the other has.
    rms, largest : float or None
        Of the differences, in the unit of the state.
    rms_sigma, largest_sigma : float or None
        The same in standard deviations of the first recording.
    ratio : float or None
        Median standard deviation of the second over that of the first.
    """

    vehicle: int
    model: str
    stage: str
    name: str
    rows: int
    alone: list[int]
    rms: float | None = None
    largest: float | None = None
    rms_sigma: float | None = None
    largest_sigma: float | None = None
    ratio: float | None = None


class Agreement(msgspec.Struct, kw_only=True):
    """Two recordings of one flight side by side.

    Parameters
    ----------
    files : list of str
        What was read, the first and the second.
    estimators : list of str
        What made them, "" where nothing says so.
    remarks : list of str
        What has to be known to read the figures.
    states : list of State
    """

    files: list[str]
    estimators: list[str]
    remarks: list[str]
    states: list[State]


class _Column(NamedTuple):
    """Estimates of a state: vehicle time and receive time (k, 2), mean and variance (k,)."""

    when: NDArray[np.int64]
    mean: Floats
    variance: Floats


def agreement(path: str | Path, against: str | Path) -> Agreement:
    """Compare the estimates and smoothed windows of two recordings where they are of the same samples.

    Parameters
    ----------
    path, against : path
        Recordings or sortie folders: the first is what the other is measured by.

    Raises
    ------
    FileNotFoundError, ValueError
        As `viewer.reading.Reading`; or the recordings have no state in common.
    """
    with Reading(path) as one, Reading(against) as other:
        entities = [[entity for entity in reading.chunks if _is_state(entity)] for reading in (one, other)]
        both = set(entities[0]) & set(entities[1])
        if not both:
            raise ValueError(f"{path} and {against} have no estimated state in common")
        states = [_state(entity, _column(one, entity), _column(other, entity)) for entity in both]
        scopes = [_scopes(reading) for reading in (one, other)]
        remarks = [*one.remarks, *other.remarks]
        if scopes[0] != scopes[1] and all(scopes):
            told = " and ".join(", ".join(scope) for scope in scopes)
            remarks.append(f"their windows do not know the same: smoothed over {told}")
        if not any(state.rows for state in states):
            remarks.append("no estimate of one is of the same sample as one of the other: is it the same flight?")
        return Agreement(
            files=[str(path), str(against)],
            estimators=[estimator(reading) for reading in (one, other)],
            remarks=remarks,
            states=sorted(states, key=lambda s: (s.vehicle, first(s.model), s.stage, order(s.name))),
        )


def _is_state(entity: str) -> bool:
    here = place(entity)
    return here is not None and here.stage in ("live", "window") and here.name not in ("nis", "geodetic", "report")


def _scopes(reading: Reading) -> list[str]:
    found = set()
    for entity in reading.chunks:
        if (here := place(entity)) is not None and here.name == "report":
            _, texts = reading.column(entity, "verdict")
            found |= {str(msgspec.json.decode(text)["scope"]) for text in texts}
    return sorted(found)


def _column(reading: Reading, entity: str) -> _Column:
    components = ("Measurements:values", "Measurements:variances")
    times, (mean, variance) = reading.columns(entity, components, ("t_vehicle", "t_rx"))
    mean, variance = mean.astype(np.float64), variance.astype(np.float64)
    known = np.flatnonzero(np.isfinite(mean) & np.isfinite(variance))
    when, at = np.unique(np.column_stack(times)[known], axis=0, return_index=True)
    return _Column(when, mean[known[at]], variance[known[at]])


def _state(entity: str, one: _Column, other: _Column) -> State:
    here = place(entity)
    assert here is not None
    _, numbers = np.unique(np.concatenate([one.when, other.when]), axis=0, return_inverse=True)
    keys = np.split(numbers.reshape(-1), [len(one.when)])
    _, mine, theirs = np.intersect1d(keys[0], keys[1], assume_unique=True, return_indices=True)
    rows = len(mine)
    state = State(
        vehicle=here.vehicle, model=here.model, stage=here.stage, name=here.name, rows=rows,
        alone=[len(keys[0]) - rows, len(keys[1]) - rows],
    )  # fmt: skip
    if rows:
        apart = other.mean[theirs] - one.mean[mine]
        if role(here.name) in ANGLES:
            apart = (apart + np.pi) % (2.0 * np.pi) - np.pi
        sigma, theirs_sigma = np.sqrt(one.variance[mine]), np.sqrt(other.variance[theirs])
        with np.errstate(divide="ignore", invalid="ignore"):
            sigmas = apart / sigma
            state.ratio = finite(float(np.median(theirs_sigma) / np.median(sigma)))
        state.rms, state.largest = finite(_rms(apart)), finite(float(np.abs(apart).max()))
        state.rms_sigma, state.largest_sigma = finite(_rms(sigmas)), finite(float(np.abs(sigmas).max()))
    return state


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def tell(found: Agreement, console: Console) -> None:
    """Print it for a human reader."""
    from rich import box
    from rich.table import Table

    for what, file, name in zip(("", "against "), found.files, found.estimators, strict=True):
        by = f", estimator {name}" if name else ""
        console.print(f"{what}{file}{by}", markup=False, highlight=False)
    for remark in found.remarks:
        console.print(f"  ! {remark}", markup=False, highlight=False, style="yellow")
    groups: dict[tuple[Any, ...], list[State]] = {}
    for state in found.states:
        groups.setdefault((state.vehicle, state.model, state.stage, state.rows, *state.alone), []).append(state)
    for (vehicle, model, stage, rows, mine, theirs), states in groups.items():
        what = "live" if stage == "live" else "smoothed"
        more = f", {mine} and {theirs} others without counterpart" if mine or theirs else ""
        title = f"Vehicle {vehicle}, {model.replace('_', ' ')}, {what}: {rows} estimates in both{more}"
        console.print(title, markup=False, highlight=False, style="bold")
        table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0))
        table.add_column("state", no_wrap=True)
        for name in ("rms, SI", "largest", "rms, sigma", "largest", "std ratio"):
            table.add_column(name, justify="right", no_wrap=True)
        for s in states:
            table.add_row(s.name, *(_figure(x) for x in (s.rms, s.largest, s.rms_sigma, s.largest_sigma)), _ratio(s))
        console.print(table)


def _figure(value: float | None) -> str:
    return "-" if value is None else f"{value:.2g}"


def _ratio(state: State) -> str:
    return "-" if state.ratio is None else f"{state.ratio:.3f}"
