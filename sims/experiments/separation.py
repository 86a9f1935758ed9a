"""Parameters beside the states or among them: Shi's separated form and the augmented smoother on the steps of a log.

Both filter and smooth the same steps from the same start, one after the other and round after round, without a gate:
what the gate of the flight refused is left out, what it weakened keeps its raised variance. The augmented smoother is
the one that flies, before its pass about the result. What the three forms are is told in ``estimator.separated``.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimator.extended import REJECTED, Carry, Drive
from estimator.models.flight_path import FlightPath
from estimator.separated import Form, Separated, separated
from estimator.stretch import Filtered, Smoothed, Stretch

if TYPE_CHECKING:
    from rich.table import Table

Floats = NDArray[np.float64]
FORMS: tuple[Form, ...] = ("corrected", "free", "paper")
TOLD: dict[Form, str] = {
    "corrected": "separated",
    "free": "separated, linearised without feedback",
    "paper": "separated, smoothed as the paper words it",
}
FEW = 200  # steps that are run before the clock counts, so that nothing is compiled or loaded while it does
PEOPLE = {"rad": (180.0 / math.pi, "deg"), "rad/s": (180.0 / math.pi, "deg/s"), "1": (100.0, "%")}


class Steps(NamedTuple):
    """One stretch of flight: its model, its start and what drove it."""

    flight: FlightPath
    carry: Carry
    drive: Drive


@dataclass
class Witness:
    """Remembers the steps of every stretch that begins: what ``estimator.stage.estimate`` takes as ``begun``.

    For a whole sortie only: windows that are told as they close forget their steps.
    """

    _begun: list[tuple[Stretch, Carry]] = field(default_factory=list)

    def __call__(self, stretch: Stretch) -> None:
        """Remember a stretch, of which nothing has been flown."""
        self._begun.append((stretch, stretch.carry.copy()))

    def steps(self) -> list[Steps]:
        """The stretches that were flown, with what was refused left out."""
        return [_steps(stretch, carry) for stretch, carry in self._begun if len(stretch)]


def _steps(stretch: Stretch, carry: Carry) -> Steps:
    drive, told = stretch.cut(0, len(stretch))
    z = np.where(told.status == REJECTED, np.nan, drive.z)
    return Steps(stretch.flight, carry, drive._replace(z=z, r=told.r))


class Row(NamedTuple):
    """A parameter at the end of the stretch, SI: value and sigma by either, and their difference in sigmas."""

    name: str
    unit: str
    augmented: tuple[float, float]
    separated: tuple[float, float]
    difference: float


class States(NamedTuple):
    """How the smoothed states of a form differ from those of the augmented smoother.

    Attributes
    ----------
    rms, largest : float
        Of the differences, in sigmas of the augmented.
    sigma : float
        Smallest quotient of standard deviations, form over augmented, of any state and time.
    seconds : float
        Filter and smoother; the least of the rounds.
    """

    rms: float
    largest: float
    sigma: float
    seconds: float


@dataclass(frozen=True)
class Comparison:
    """Both on one stretch.

    Attributes
    ----------
    steps : int
    states, constants : int
        That move, and that do not.
    constant : bool
        Biases walk in the settings, and in the separated form do not.
    parameters : list of Row
    forms : dict of str to States
    seconds : float
        The augmented filter and smoother; the least of the rounds.
    """

    steps: int
    states: int
    constants: int
    constant: bool
    parameters: list[Row]
    forms: dict[Form, States]
    seconds: float

    def table(self) -> Table:
        """The parameters, for people."""
        from rich.table import Table

        table = Table(title="parameters by both", title_justify="left")
        for name in ("parameter", "unit", "augmented", "+-", "separated", "+-", "difference, sigma"):
            table.add_column(name, justify="left" if name in ("parameter", "unit") else "right")
        for row in self.parameters:
            scale, unit = PEOPLE.get(row.unit, (1.0, row.unit))
            figures = (f"{scale * value:.4g}" for value in (*row.augmented, *row.separated))
            table.add_row(row.name, unit, *figures, f"{row.difference:.1e}")
        return table

    def forms_table(self) -> Table:
        """States and time, for people."""
        from rich.table import Table

        table = Table(
            title=f"smoothed states beside the augmented ones, and time of filter and smoother, {self.steps} steps",
            title_justify="left",
            caption=f"separated: {self.states} states move, {self.constants} parameters beside them"
            + ("; biases walk in the settings and are constants here" if self.constant else ""),
            caption_justify="left",
        )  # fmt: skip
        table.add_column("form")
        for name in ("rms, sigma", "largest, sigma", "least sigma ratio", "us per step"):
            table.add_column(name, justify="right")
        table.add_row("augmented", "", "", "", f"{self.seconds / self.steps * 1e6:.1f}")
        for form, states in self.forms.items():
            told = (f"{states.rms:.1e}", f"{states.largest:.1e}", f"{states.sigma:.2f}")
            table.add_row(TOLD[form], *told, f"{states.seconds / self.steps * 1e6:.1f}")
        return table


def augmented(steps: Steps) -> tuple[Filtered, Smoothed]:
    """All states in one vector, filtered and smoothed."""
    stretch = Stretch(steps.flight, steps.carry.copy(), gated=False)
    return stretch.advance(steps.drive), stretch.smooth()


def compare(steps: Steps, *, rounds: int = 3, tell: Callable[[str], None] | None = None) -> Comparison:
    """Filter and smooth a stretch by both.

    Parameters
    ----------
    steps : Steps
    rounds : int
        The least time of so many counts; at least 1.
    tell : callable, optional
        Called with a line about what is being done.
    """
    few = steps._replace(drive=steps.drive.part(0, FEW))
    augmented(few)
    separated(*few)
    best: dict[str, float] = {}
    found: dict[str, Separated] = {}
    known: Smoothed | None = None
    for turn in range(max(rounds, 1)):
        if tell:
            tell(f"{len(steps.drive.dt)} steps, parameters among the states and beside them, round {turn + 1}")
        begin = time.perf_counter()
        _, known = augmented(steps)
        best["augmented"] = min(best.get("augmented", math.inf), time.perf_counter() - begin)
        for form in FORMS:
            begin = time.perf_counter()
            found[form] = separated(*steps, form=form)
            best[form] = min(best.get(form, math.inf), time.perf_counter() - begin)
    assert known is not None
    exact = found["corrected"]
    names = steps.flight.names
    rows = []
    std = np.array(known.std)
    last = int(np.flatnonzero(np.isfinite(std[:, 0]))[-1])  # standard deviations are told now and then
    for name, unit, value, sigma in zip(exact.names, exact.units, exact.value, exact.sigma, strict=True):
        at = names.index(name)
        mean, spread = float(known.mean[last, at]), float(std[last, at])
        apart = (float(value) - mean) / spread
        rows.append(Row(name, unit, (mean, spread), (float(value), float(sigma)), apart))
    forms = {form: _states(known, found[form], exact, names, best[form]) for form in FORMS}
    count = len(exact.names)
    return Comparison(
        len(steps.drive.dt), len(names) - count, count, exact.constant, rows, forms, best["augmented"]
    )  # fmt: skip


def _states(known: Smoothed, found: Separated, exact: Separated, names: tuple[str, ...], seconds: float) -> States:
    shown = np.flatnonzero(np.isfinite(known.std[:, 0]) & np.isfinite(found.std[:, 0]))
    moving = np.flatnonzero([name not in exact.names for name in names])
    at = np.ix_(shown, moving)
    gap = found.mean[at] - known.mean[at]
    for column, i in enumerate(moving.tolist()):
        if names[i] in ("theta", "phi", "psi"):
            gap[:, column] -= 2.0 * np.pi * np.round(gap[:, column] / (2.0 * np.pi))
    gap /= known.std[at]
    return States(
        float(np.sqrt(np.mean(np.square(gap)))), float(np.abs(gap).max()),
        float((found.std[at] / known.std[at]).min()), seconds,
    )  # fmt: skip
