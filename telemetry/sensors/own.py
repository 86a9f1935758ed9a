"""Quantities in messages of one's own: named values, debug vectors and arrays to angles, airspeed and altitude."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from telemetry.mavlink import Dialect
from telemetry.messages import AirData, Altitude, FlowAngles, Sample
from telemetry.sensors.air import FASTEST, HIGHEST, altitude_columns, calibrated_airspeed, flow, possible
from telemetry.sensors.air import pressure_altitude as altitude_of
from telemetry.sensors.feeds import Columns, Mask, Refusals
from telemetry.sensors.overrides import DEFAULT_UNIT, PRESSURES, QUANTITIES, Quantity, SensorSettings, value_field


class OwnFeed:
    """What one message of one name tells of one kind of sensor.

    Parameters
    ----------
    kind : type of Sample
    quantities : list of (str, Quantity)
        All of the same message, name and component.
    settings : SensorSettings
    dialect : Dialect

    Attributes
    ----------
    msgid : int
    words : str
        For the log: message and name.
    component : int or None
        The one it is read from; None until it is heard.
    """

    def __init__(
        self, kind: type[Sample], quantities: list[tuple[str, Quantity]], settings: SensorSettings, dialect: Dialect
    ) -> None:
        first = quantities[0][1]
        self.kind, self.message = kind, first.message
        self.msgid = next(msgid for msgid, name in dialect.names.items() if name == first.message)
        self.words = first.message if first.name is None else f"{first.message} {first.name}"
        self.component = first.component
        self._name = None if first.name is None else first.name.encode()
        self._settings = settings
        self._layout = dialect.layouts[self.msgid]
        self._quantities = dict(quantities)

    def mine(self, values: NDArray[Any]) -> Mask | None:
        """Rows of its name; None where all are, because the message has no names."""
        if self._name is None:
            return None
        letters = np.ascontiguousarray(values["name"])
        size = letters.shape[1]
        padded = np.frombuffer(self._name.ljust(size, b"\0"), "S1")
        told = min(len(self._name) + 1, size)  # up to the NUL; what follows it means nothing
        return np.asarray((letters[:, :told] == padded[:told]).all(axis=1))

    def convert(self, values: NDArray[Any]) -> tuple[Refusals, Columns]:
        """Columns in SI units, and the rows that are no measurement; NaN where one of two is told elsewhere."""
        nothing = np.full(len(values), np.nan)
        if self.kind is FlowAngles:
            angles = {name: self._told(name, values) or (nothing, False) for name in ("alpha", "beta")}
            columns: Columns = {name: flow(told[0]) for name, told in angles.items()}
            bad = np.isnan(columns["alpha"]) & np.isnan(columns["beta"])
            return [("the vanes point backwards or nowhere", bad)], columns
        if self.kind is AirData:
            speed, is_pressure = self._told("airspeed", values) or (nothing, False)
            pressure = speed if is_pressure else nothing
            airspeed = calibrated_airspeed(speed) if is_pressure else speed
            bad = ~(np.abs(airspeed) < FASTEST)
            return [("the airspeed is impossible", bad)], {"airspeed": airspeed, "differential_pressure": pressure}
        height, is_pressure = self._told("pressure_altitude", values) or (nothing, False)
        pressure = np.where(possible(height), height, np.nan) if is_pressure else nothing
        altitude = altitude_of(pressure) if is_pressure else height
        bad = ~(np.abs(altitude) < HIGHEST)
        return [("the altitude is impossible", bad)], altitude_columns(
            altitude, pressure, self._settings.altitude_sigma
        )

    def _told(self, name: str, values: NDArray[Any]) -> tuple[NDArray[np.float64], bool] | None:
        """A quantity in SI units, NaN where it is not finite, and whether it is a pressure; None if not told here."""
        quantity = self._quantities.get(name)
        if quantity is None:
            return None
        field = value_field(quantity, self._layout)
        column = values[field].astype(np.float64)
        if column.ndim > 1:
            column = column.reshape(len(column), -1)[:, quantity.index]
        unit = quantity.unit or DEFAULT_UNIT[name]
        units = QUANTITIES[name][1]
        with np.errstate(over="ignore", invalid="ignore"):
            told = (column * quantity.scale + quantity.offset) * units.get(unit, PRESSURES.get(unit, 1.0))
        told[~np.isfinite(told)] = np.nan
        return told, unit not in units


def own_feeds(settings: SensorSettings, dialect: Dialect) -> list[OwnFeed]:
    """The feeds that the settings make, those of one message and name together."""
    out = []
    for kind in (FlowAngles, AirData, Altitude):
        groups: dict[tuple[str, str | None, int | None], list[tuple[str, Quantity]]] = {}
        for name, quantity in settings.quantities(kind):
            groups.setdefault((quantity.message, quantity.name, quantity.component), []).append((name, quantity))
        out += [OwnFeed(kind, quantities, settings, dialect) for quantities in groups.values()]
    return out
