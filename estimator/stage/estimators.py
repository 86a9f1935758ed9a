"""The choice of the estimator: what the stage asks of one, and where each is by its name.

An estimator is a module with the functions below. Of a linear model, as the trajectory is one, it has a carry, all that
is known so far, and functions of it that give the same bits however the steps are cut; and it begins stretches of
flight path. Windows, marks, gates, reports and recordings are the stage's, the same for all. A new estimator is one
module, its line in ``ESTIMATORS``, and its name in the settings.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any, Protocol, cast

import numpy as np
from numpy.typing import NDArray

from estimator.extended import Drive, Told
from estimator.information import Filtered
from estimator.model import LinearModel
from estimator.models.flight_path import FlightPath
from estimator.stretch import Filtered as FilteredPath
from estimator.stretch import Smoothed
from estimator.window import Rule

Floats = NDArray[np.float64]

ESTIMATORS = {"ms": "estimator.stage.ms", "cubature": "estimator.stage.cubature"}


class Store(Protocol):
    """The steps of a window, or of a leg, as smoothing needs them."""

    def __len__(self) -> int: ...

    @property
    def anchors(self) -> list[int]:
        """First steps of the stretches between which the coordinates were changed; empty where they never are."""

    def drop(self, before: int) -> None:
        """Forget the steps before index ``before``."""


class Path(Protocol):
    """A stretch of flight path: what `estimator.stretch.Stretch` is, which has the words for all of it."""

    flight: FlightPath

    def __len__(self) -> int: ...

    def advance(self, drive: Drive) -> FilteredPath:
        """Filter steps; `estimator.stretch.Diverged` where a result is not finite."""

    def point(self) -> Any:
        """The present epoch, to come back to with `rewind`."""

    def rewind(self, point: Any) -> None:
        """Forget the steps since a point, to the same bits as if they had never been."""

    def smooth(self, *, std: bool = True) -> Smoothed:
        """Smooth everything, given what is known now."""

    def hybrid(self, found: Smoothed, *, std: bool = True) -> Smoothed:
        """One more pass about a smoothed path."""

    def taken(self) -> Path:
        """All that is known now, to be smoothed while the filter goes on here with `drop`."""

    def drop(self) -> None:
        """Forget the steps: what is smoothed next begins at the present epoch."""

    def cut(self, first: int, stop: int) -> tuple[Drive, Told]:
        """What drove the steps first..stop-1, and what was told of them."""


class Estimator(Protocol):
    """The functions of an estimator."""

    def store(self) -> Any:
        """An empty `Store`."""

    def start(self, n: int, x0: Floats, p0: Floats) -> Any:
        """A carry from a prior, mean (n,) and covariance (n, n)."""

    def filter(self, model: LinearModel, carry: Any, z: Floats, *, rule: Rule, store: Any) -> tuple[Any, Filtered]:
        """Filter steps into a store; ValueError where that fails, and carry and store are then as they were."""

    def anchor(self, carry: Any) -> Any:
        """The carry with which the next window begins."""

    def smooth(self, store: Any, carry: Any) -> tuple[Floats, Floats]:
        """Mean and standard deviation (k+1, n) of the epochs of a store, given everything up to the carry."""

    def begin(
        self, flight: FlightPath, values: dict[str, float], sigma: Floats | None = None, *, gated: bool = True
    ) -> Path:
        """A stretch of flight path from named values with standard deviations (n,), those of the prior if none."""


def named(name: str) -> Estimator:
    """The estimator of a name, loaded when it is asked for.

    Raises
    ------
    ValueError
        There is none of that name; the text lists those that there are.
    """
    if name not in ESTIMATORS:
        raise ValueError(f"estimator {name!r}: it is one of {', '.join(ESTIMATORS)}")
    return cast(Estimator, importlib.import_module(ESTIMATORS[name]))


if TYPE_CHECKING:  # that they are what they are taken for
    from estimator.stage import cubature, ms

    _KNOWN: tuple[Estimator, ...] = (ms, cubature)
