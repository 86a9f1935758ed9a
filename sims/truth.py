"""The truth: what the simulated aircraft really did, at the record rate.

Earth: rotating WGS-84, or flat (`sims.earth`); altitude is geodetic height, which stands for height above mean sea
level because no geoid is modelled. Frames: NED for the Earth, FRD for the body. Angles rad, everything SI.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Times = npt.NDArray[np.int64]

UNITS: dict[str, str] = {
    "t": "ns since boot of the vehicle (int64)",
    "latitude": "rad, geodetic, WGS-84",
    "longitude": "rad",
    "altitude": "m above mean sea level (geodetic height; no geoid)",
    "velocity": "m/s relative to the ground: north, east, down",
    "attitude": "rad: phi, theta in -pi..pi, psi in 0..2 pi (true heading)",
    "rates": "rad/s: inertial body rates p, q, r at the instant t",
    "specific_force": "m/s2 at the centre of gravity, body axes, at the instant t",
    "mean_rates": "rad/s: mean of `rates` over the interval that ends at t",
    "mean_specific_force": "m/s2: mean of `specific_force` over the interval that ends at t",
    "airspeed": "m/s, true",
    "alpha": "rad, angle of attack",
    "beta": "rad, sideslip",
    "wind": "m/s, the way the air moves: north, east, down; turbulence included",
    "pressure": "Pa, static",
    "temperature": "K, of the air outside",
    "controls": "rad: elevator, left aileron, rudder; throttle 0..1",
    "segment": "index into the plan's segments (int64)",
}
"""Unit, frame and meaning of every column."""


@dataclasses.dataclass(frozen=True, slots=True)
class Truth:
    """Columns over N records; `UNITS` says what each one is.

    Vectors are (N, 3), `controls` is (N, 4), all others (N,). `planet` is "wgs84" or "flat", `aircraft` the JSBSim
    model that flew.
    """

    t: Times
    latitude: Array
    longitude: Array
    altitude: Array
    velocity: Array
    attitude: Array
    rates: Array
    specific_force: Array
    mean_rates: Array
    mean_specific_force: Array
    airspeed: Array
    alpha: Array
    beta: Array
    wind: Array
    pressure: Array
    temperature: Array
    controls: Array
    segment: Times
    planet: str = "wgs84"
    aircraft: str = ""

    def __len__(self) -> int:
        """Return the number of records N."""
        return len(self.t)

    @property
    def seconds(self) -> Array:
        """Time since boot (N,), s."""
        return np.asarray(self.t * 1e-9, np.float64)

    @property
    def rate(self) -> float:
        """Records per second (Hz)."""
        return 1e9 / float(self.t[1] - self.t[0])

    def save(self, path: str | Path, **more: str) -> None:
        """Write all columns, their units and `more` texts to a compressed .npz."""
        columns = {name: getattr(self, name) for name in UNITS}
        texts = {name: np.array(text) for name, text in more.items()}
        who = {"planet": np.array(self.planet), "aircraft": np.array(self.aircraft)}
        units = np.array([f"{name}: {unit}" for name, unit in UNITS.items()])
        np.savez_compressed(path, allow_pickle=False, **columns, **who, **texts, units=units)

    @classmethod
    def load(cls, path: str | Path) -> Truth:
        """Read what `save` wrote.

        Raises
        ------
        ValueError
            A column is missing: the file is not a truth record.
        """
        with np.load(path, allow_pickle=False) as file:
            missing = [name for name in UNITS if name not in file]
            if missing:
                raise ValueError(f"{path} is not a truth record: no column {', '.join(missing)}")
            who: dict[str, Any] = {name: str(file[name]) for name in ("planet", "aircraft") if name in file}
            return cls(**{name: file[name] for name in UNITS}, **who)
