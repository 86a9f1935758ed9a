"""What the settings say about sensors: which message is used, where vanes of one's own are found, and noise.

In the settings file::

    [ingest.sensors]
    imu = "SCALED_IMU2"              # the message; of one component and instance: "HIGHRES_IMU@1.2"
    attitude = "off"                 # recorded, not used
    altitude_sigma = 0.5

    [ingest.sensors.alpha]
    message = "NAMED_VALUE_FLOAT"
    name = "AOA"
    unit = "deg"
    scale = -1.0

    [ingest.sensors.beta]
    message = "DEBUG_FLOAT_ARRAY"
    name = "VANES"
    index = 1
"""

from __future__ import annotations

import re
from difflib import get_close_matches
from typing import Annotated, Any, NamedTuple

import msgspec
import numpy as np

from telemetry.mavlink import Dialect
from telemetry.messages import AirData, Altitude, Attitude, FlowAngles, Gnss, Imu, Sample
from telemetry.sensors.air import AIR_FEEDS
from telemetry.sensors.feeds import Feed
from telemetry.sensors.gnss import GNSS_FEEDS
from telemetry.sensors.imu import IMU_FEEDS

FEEDS: tuple[Feed, ...] = (*IMU_FEEDS, *AIR_FEEDS, *GNSS_FEEDS)
"""Every message that can feed a sensor without being told how."""

KINDS: tuple[type[Sample], ...] = (Imu, Attitude, AirData, FlowAngles, Altitude, Gnss)
OFF = "off"

QUANTITIES: dict[str, tuple[type[Sample], dict[str, float]]] = {
    "alpha": (FlowAngles, {"rad": 1.0, "deg": np.pi / 180.0}),
    "beta": (FlowAngles, {"rad": 1.0, "deg": np.pi / 180.0}),
    "airspeed": (AirData, {"m/s": 1.0, "kt": 1852.0 / 3600.0, "km/h": 1.0 / 3.6, "mph": 0.44704}),
    "pressure_altitude": (Altitude, {"m": 1.0, "ft": 0.3048}),
}
"""What a message of one's own can carry, its units and their SI values."""

PRESSURES = {"Pa": 1.0, "hPa": 100.0, "mbar": 100.0, "inHg": 3386.389, "inH2O": 249.0889}
"""Units in which an airspeed is told as differential pressure, a pressure altitude as static pressure."""

DEFAULT_UNIT = {"alpha": "deg", "beta": "deg", "airspeed": "m/s", "pressure_altitude": "m"}
ALTIMETER_SIGMA = 1.0  # m, of a MEMS barometer
GNSS_SIGMA = 2.5  # m, horizontal, per axis, at HDOP 1 when the receiver states no accuracy
GNSS_VELOCITY_SIGMA = 0.3  # m/s

VALUE_FIELDS = ("value", "data", "x")
AXES = ("x", "y", "z")

_WANTED = re.compile(r"(?P<message>[A-Z][A-Z0-9_]*)(@(?P<component>\d{1,3})(\.(?P<instance>\d{1,3}))?)?")

Positive = Annotated[float, msgspec.Meta(gt=0)]


class Wanted(NamedTuple):
    """The message that the settings ask for, perhaps of one component and instance."""

    message: str
    component: int | None
    instance: int | None


class Quantity(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A measured quantity in a message of one's own: ``unit * (scale * told + offset)``.

    Parameters
    ----------
    message : str
        NAMED_VALUE_FLOAT, DEBUG_VECT, DEBUG_FLOAT_ARRAY or any other of the dialect.
    name : str, optional
        What its field ``name`` must say.
    field : str, optional
        The field; by default ``value``, ``data`` or, of DEBUG_VECT, x, y or z by the index.
    index : int
        Place in an array, from 0.
    component : int, optional
        Of this component only; by default of the first from which it is heard.
    unit : str, optional
        "deg" (default) or "rad" of an angle; "m/s" (default), "kt", "km/h", "mph" of an airspeed, "m" (default), "ft"
        of an altitude; or a pressure, "Pa", "hPa", "mbar", "inHg", "inH2O": differential for the airspeed, static for
        the altitude.
    scale, offset : float
        Calibration, `offset` in the unit; a scale of -1 turns the sign.
    """

    message: str
    name: str | None = None
    field: str | None = None
    index: Annotated[int, msgspec.Meta(ge=0)] = 0
    component: Annotated[int, msgspec.Meta(ge=1, le=255)] | None = None
    unit: str | None = None
    scale: float = 1.0
    offset: float = 0.0

    def __post_init__(self) -> None:
        if not (np.isfinite([self.scale, self.offset]).all() and self.scale):
            raise ValueError(f"scale = {self.scale}, offset = {self.offset}: finite numbers, the scale not 0")


class SensorSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Which messages feed the sensors, where they are not to be chosen automatically, and noise.

    Parameters
    ----------
    imu, attitude, air_data, flow_angles, altitude, gnss : str, optional
        Name of the message to be used before any other, ``"NAME@component.instance"`` to say more, or "off": recorded,
        but not used. As long as what is asked for is not heard, the choice is automatic.
    alpha, beta, airspeed, pressure_altitude : Quantity, optional
        Where a sensor of one's own is found. It is used before any other of its kind.
    altitude_sigma : float
        Noise of the altimeter, m; by default that of a MEMS barometer.
    gnss_sigma, gnss_velocity_sigma : float
        Noise of a fix whose receiver states no accuracy: horizontal, per axis, at HDOP 1, m, and of velocity, m/s.

    Raises
    ------
    ValueError
        If no such message feeds the sensor, or a unit is not one of the quantity's.
    """

    imu: str | None = None
    attitude: str | None = None
    air_data: str | None = None
    flow_angles: str | None = None
    altitude: str | None = None
    gnss: str | None = None
    alpha: Quantity | None = None
    beta: Quantity | None = None
    airspeed: Quantity | None = None
    pressure_altitude: Quantity | None = None
    altitude_sigma: Positive = ALTIMETER_SIGMA
    gnss_sigma: Positive = GNSS_SIGMA
    gnss_velocity_sigma: Positive = GNSS_VELOCITY_SIGMA

    def __post_init__(self) -> None:
        for kind in KINDS:
            key, told = kind.stream, getattr(self, kind.stream)
            own = [name for name, _ in self.quantities(kind)]
            if told is None:
                continue
            if own:
                raise ValueError(f"{key} = {told!r} and [ingest.sensors.{own[0]}]: only one of the two can be used")
            if told == OFF:
                continue
            names = sorted({feed.message for feed in FEEDS if feed.kind is kind})
            parts = _WANTED.fullmatch(told)
            if not parts or parts["message"] not in names:
                raise ValueError(
                    f"{key} = {told!r}: it is one of {', '.join(names)} (with @component.instance where several"
                    f' are heard) or "{OFF}"'
                )
        for name, (kind, units) in QUANTITIES.items():
            quantity = getattr(self, name)
            known = [*units, *(PRESSURES if kind is not FlowAngles else ())]
            if quantity is not None and quantity.unit is not None and quantity.unit not in known:
                raise ValueError(f"unit = {quantity.unit!r} of {name}: it is one of {', '.join(known)}")

    def off(self, kind: type[Sample]) -> bool:
        """Whether a kind is recorded only."""
        return bool(getattr(self, kind.stream) == OFF)

    def wanted(self, kind: type[Sample]) -> Wanted | None:
        """The message that a kind is to be read from."""
        told = getattr(self, kind.stream)
        if told is None or told == OFF:
            return None
        parts: Any = _WANTED.fullmatch(told)
        component, instance = (None if parts[name] is None else int(parts[name]) for name in ("component", "instance"))
        return Wanted(parts["message"], component, instance)

    def quantities(self, kind: type[Sample]) -> list[tuple[str, Quantity]]:
        """The quantities of a kind that have a message of their own."""
        found = [(name, getattr(self, name)) for name, (owner, _) in QUANTITIES.items() if owner is kind]
        return [(name, quantity) for name, quantity in found if quantity is not None]


def check(settings: SensorSettings, dialect: Dialect) -> None:
    """Refuse settings that a dialect has no message, no field or no place for.

    Parameters
    ----------
    settings : SensorSettings
    dialect : Dialect

    Raises
    ------
    ValueError
        One line with the key, the place and the way out.
    """
    ids = {name: msgid for msgid, name in dialect.names.items()}
    for kind in KINDS:
        wanted = settings.wanted(kind)
        if wanted is not None and wanted.message not in ids:
            raise ValueError(
                f"[ingest.sensors] {kind.stream} = {wanted.message!r}: the dialect {dialect.name} has no such message;"
                " choose another dialect or another message"
            )
        for name, quantity in settings.quantities(kind):
            key = f"[ingest.sensors.{name}]"
            if quantity.message not in ids:
                raise ValueError(
                    f"{key} message = {quantity.message!r}: the dialect {dialect.name} has none of that name;"
                    f" {_near(quantity.message.upper(), ids)}"
                )
            _check_field(key, quantity, dialect.layouts[ids[quantity.message]])


def value_field(quantity: Quantity, layout: np.dtype[Any]) -> str | None:
    """The field of a message that holds a quantity."""
    names = layout.names or ()
    if quantity.field is not None:
        return quantity.field if quantity.field in names else None
    found = next((name for name in VALUE_FIELDS if name in names), None)
    if found == "x" and set(AXES) <= set(names):
        return AXES[quantity.index] if quantity.index < len(AXES) else None
    return found


def _check_field(key: str, quantity: Quantity, layout: np.dtype[Any]) -> None:
    names = [name for name in layout.names or () if layout[name].base.kind != "S"]
    if quantity.name is not None:
        if "name" not in (layout.names or ()):
            raise ValueError(f"{key} name = {quantity.name!r}: {quantity.message} has no name; leave it out")
        longest = layout["name"].shape[0]
        if not quantity.name.isascii() or not 0 < len(quantity.name) <= longest:
            raise ValueError(
                f"{key} name = {quantity.name!r}: the names of {quantity.message} have 1 to {longest} letters"
            )
    elif "name" in (layout.names or ()):
        raise ValueError(f"{key}: {quantity.message} carries many quantities; say which by name = ...")
    field = value_field(quantity, layout)
    if field is None and quantity.field is None and "x" in names:
        raise ValueError(f"{key} index = {quantity.index}: {quantity.message} has x, y and z, index 0 to 2")
    if field is None or field not in names:
        told = f"field = {quantity.field!r}" if quantity.field is not None else "field"
        raise ValueError(f"{key} {told}: {quantity.message} has {', '.join(names)}")
    places = int(np.prod(layout[field].shape, dtype=int))
    if layout[field].shape and quantity.index >= places:
        raise ValueError(f"{key} index = {quantity.index}: {field} of {quantity.message} has {places} places, from 0")
    if not layout[field].shape and field not in AXES and quantity.index:
        raise ValueError(f"{key} index = {quantity.index}: {field} of {quantity.message} is one number; leave it out")


def _near(name: str, names: dict[str, int]) -> str:
    near = get_close_matches(name, names, 3, 0.5)
    return f"did you mean {' or '.join(near)}?" if near else "choose another dialect or another message"
