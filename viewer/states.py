"""States: what the states of a flight path are called in words, and which of them are looked at together."""

from __future__ import annotations

import math

from viewer.columns import role

GROUPS = {
    "Velocities": ("h", "u", "v", "w"),
    "Angles": ("theta", "phi", "psi"),
    "Air data and wind": (
        *("airspeed", "alpha", "beta", "wind_north", "wind_east"),
        *("gust_north", "gust_east", "gust_down"),
    ),
    "Biases": ("ba_x", "ba_y", "ba_z", "bg_x", "bg_y", "bg_z"),
    "Air data errors": ("k_airspeed", "b_airspeed", "b_alpha", "b_beta", "k_alpha", "k_beta"),
}
OTHERS = "Other states"

_WORDS = {
    "h": "height",
    "u": "forward velocity u",
    "v": "rightward velocity v",
    "w": "downward velocity w",
    "theta": "pitch theta",
    "phi": "roll phi",
    "psi": "heading psi",
    "wind_north": "north wind",
    "wind_east": "east wind",
    "gust_north": "north gust",
    "gust_east": "east gust",
    "gust_down": "down gust",
    "k_airspeed": "airspeed scale error",
    "b_airspeed": "airspeed offset",
    **{f"ba_{axis}": f"accelerometer bias {axis}" for axis in "xyz"},
    **{f"bg_{axis}": f"gyro bias {axis}" for axis in "xyz"},
    **{f"b_{angle}": f"{angle} offset" for angle in ("alpha", "beta")},
    **{f"k_{angle}": f"{angle} slope error" for angle in ("alpha", "beta")},
}

# Quantities as measured that belong beside a state: sensor and quantity below /v1/raw.
_MEASURED = {
    "altitude": ("gnss/altitude", "altitude/altitude"),
    "climb_rate": ("gnss/climb_rate",),
    "velocity_north": ("gnss/velocity_north",),
    "velocity_east": ("gnss/velocity_east",),
    "roll": ("attitude/roll",),
    "pitch": ("attitude/pitch",),
    "heading": ("attitude/heading",),
    "airspeed": ("air_data/airspeed",),
    "alpha": ("flow_angles/alpha",),
    "beta": ("flow_angles/beta",),
}


def words(name: str) -> str:
    """A state of the flight path in words, e.g. "forward velocity u"; empty for a name that is none."""
    return _WORDS.get(name, "")


def group(name: str) -> str:
    """Title of the group of a state."""
    return next((title for title, names in GROUPS.items() if name in names), OTHERS)


def order(name: str) -> tuple[int, int, str]:
    """Sorting key: by group, inside it in the order of the group; then what has a role, then the rest, by name."""
    for i, names in enumerate(GROUPS.values()):
        if name in names:
            return i, names.index(name), name
    return len(GROUPS), 0 if role(name) else 1, name


def measured(name: str) -> tuple[str, ...]:
    """Raw quantities that belong beside a state, e.g. ``attitude/pitch``."""
    return _MEASURED.get(name, _MEASURED.get(role(name), ()))


def shown(value: float | None, unit: str) -> tuple[float | None, str]:
    """A number in the unit of its reader: angles and rates in degrees, all else as it is."""
    if unit == "rad" or unit.startswith("rad/"):
        return None if value is None else math.degrees(value), "deg" + unit[3:]
    return value, unit
