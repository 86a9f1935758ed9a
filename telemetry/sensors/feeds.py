"""Which message can feed which sensor, and what is known against it."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from telemetry.messages import Sample

if TYPE_CHECKING:
    from telemetry.sensors.overrides import SensorSettings

Columns = dict[str, NDArray[Any]]
Mask = NDArray[np.bool_]
Refusals = list[tuple[str, Mask]]
"""Reasons, as what follows "where", and the rows that they hold for; of several the first counts."""


class Doubt(NamedTuple):
    """What a stream must have shown before it is believed.

    Parameters
    ----------
    reason : str
        Why it is not, as what follows "where".
    shows : callable
        Rows that show that a sensor stands behind them.
    running : int
        Such rows in succession that are enough, the last of them being the first to be believed.
    """

    reason: str
    shows: Callable[[NDArray[Any]], Mask]
    running: int


class Feed(NamedTuple):
    """One message that can feed one sensor.

    Parameters
    ----------
    message : str
    msgid : int
    kind : type of Sample
    rank : int
        How far from the instrument it is: of those heard, the lowest is used.
    convert : callable
        From payloads to columns in SI units, and the rows that are no measurement.
    why : str
        What speaks for it, for the log.
    instance : int or str
        Number of the instrument, or the field that tells it.
    updated : tuple of int
        Masks of ``fields_updated``, one of which must be set whole; empty where the message has no such field.
    doubt : Doubt, optional
    derived : bool
        An ArduPilot makes it of its filter's state: no measurement when it comes from one.
    asked : bool
        A filter's output: used only where the settings ask for it.
    sent_to : bool
        Sent to vehicles as well as by them, so it shows no vehicle.
    """

    message: str
    msgid: int
    kind: type[Sample]
    rank: int
    convert: Callable[[NDArray[Any], SensorSettings], tuple[Refusals, Columns]]
    why: str
    instance: int | str = 0
    updated: tuple[int, ...] = ()
    doubt: Doubt | None = None
    derived: bool = False
    asked: bool = False
    sent_to: bool = False


def vector(values: NDArray[Any], names: tuple[str, str, str], scale: float = 1.0) -> NDArray[np.float64]:
    """Three fields as the columns of one array, shape (k, 3)."""
    out = np.empty((len(values), 3))
    for i, name in enumerate(names):
        out[:, i] = values[name]
    if scale != 1.0:
        out *= scale
    return out


def number(values: NDArray[Any], name: str, scale: float = 1.0) -> NDArray[np.float64]:
    """A field as float64."""
    with np.errstate(invalid="ignore"):  # a signalling NaN is no number either
        out = values[name].astype(np.float64)
    if scale != 1.0:
        out *= scale
    return out


def known(values: NDArray[Any], name: str, unknown: int, scale: float) -> NDArray[np.float64]:
    """An integer field, with the value that means "unknown" as NaN."""
    field = values[name]
    return np.where(field == unknown, np.nan, field * scale)


def infinite(columns: Columns) -> Mask:
    """Rows with NaN or infinity."""
    bad = np.zeros(len(next(iter(columns.values()))), np.bool_)
    for column in columns.values():
        finite = np.isfinite(column)
        if np.count_nonzero(finite) < column.size:
            bad |= ~finite.reshape(len(bad), -1).all(axis=1)
    return bad
