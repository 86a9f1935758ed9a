"""A JSBSim aircraft, trimmed in flight and stepped at 400 Hz.

JSBSim works in feet, pounds and slugs; this file is the only one that knows it. Everything that leaves it is SI,
radians, NED for the Earth and FRD for the body.
"""

from __future__ import annotations

import math
import os
import tempfile
from typing import Any, NamedTuple

import jsbsim

from sims.earth import EQUATOR, FLAT_GRAVITY, PLANETS, Planet, unroll
from sims.truth import Array

RATE = 400
"""Integration rate (Hz)."""

FOOT = 0.3048
SLUG_FOOT_PER_S2 = 0.3048  # one pound of force accelerates one slug by one ft/s2
STANDARD_GRAVITY = 9.80665
PASCAL_PER_PSF = 47.88025898
KELVIN_PER_RANKINE = 5.0 / 9.0


class AircraftError(ValueError):
    """The aircraft is not known, or it cannot be trimmed as asked."""


class Place(NamedTuple):
    """Where a flight starts: geodetic latitude and longitude on WGS-84 (rad) and the true heading (rad)."""

    latitude: float = math.radians(48.0)
    longitude: float = math.radians(11.3)
    heading: float = math.radians(60.0)


class Airframe(NamedTuple):
    """A flight condition that is known to trim, and how lively the controls are there.

    Attributes
    ----------
    altitude : float
        Height above mean sea level (m).
    airspeed : float
        True airspeed (m/s).
    pitch, roll, yaw : float
        Factors on the autopilot's gains about the three axes (1 = the light single they were found on).
    climb : float
        Climb rate that the engines sustain there (m/s).
    stick : float
        Factor on test inputs in pitch, on top of `pitch`, that keeps the load factor within about 1 +- 0.5.
    agility : float
        Factor on what a plan asks of the load factor beyond 1.
    backlash : float
        Half the dead travel of the elevator linkage (normalised command).
    """

    altitude: float
    airspeed: float
    pitch: float = 1.0
    roll: float = 1.0
    yaw: float = 1.0
    climb: float = 2.0
    stick: float = 1.0
    backlash: float = 0.0
    agility: float = 1.0


AIRFRAMES: dict[str, Airframe] = {
    # Found by flying: the factors follow 1 / control power, softened where the airframe is slow to answer.
    "c172x": Airframe(1000.0, 52.0, backlash=0.0623),
    "c172p": Airframe(1000.0, 52.0, yaw=0.7, stick=1.4),
    "pa28": Airframe(1000.0, 55.0, pitch=1.3, roll=1.8, yaw=0.45, stick=1.2),
    "737": Airframe(6000.0, 190.0, pitch=4.0, roll=3.0, yaw=0.5, climb=5.0, stick=0.4),
    "A320": Airframe(6000.0, 190.0, pitch=2.5, roll=2.0, yaw=0.3, climb=5.0, stick=0.6),
    "MD11": Airframe(8000.0, 220.0, pitch=12.0, roll=8.0, yaw=3.0, climb=3.0, stick=0.3),
    "787-8": Airframe(8000.0, 220.0, pitch=2.0, roll=8.0, yaw=2.0, climb=3.0, stick=0.8),
    "global5000": Airframe(8000.0, 210.0, pitch=2.0, roll=1.5, yaw=0.6, climb=3.0, stick=0.4),
    "B747": Airframe(8000.0, 220.0, pitch=5.0, roll=6.0, yaw=2.0, climb=3.0, stick=0.5),
    "f15": Airframe(5000.0, 220.0, yaw=0.4, climb=6.0, stick=0.5),
    "f16": Airframe(5000.0, 200.0, roll=0.4, yaw=2.0, climb=6.0),
    "T37": Airframe(3000.0, 130.0, roll=0.75, yaw=0.5, climb=4.0, stick=0.8),
    "T38": Airframe(5000.0, 200.0, pitch=1.5, roll=0.8, yaw=1.5, climb=6.0, stick=0.5, agility=1.4),
    "A4": Airframe(5000.0, 200.0, pitch=0.8, roll=0.6, yaw=0.3, climb=6.0, stick=0.6),
}
"""Aircraft of the installed JSBSim package that trim and fly the demonstration plan."""


class State(NamedTuple):
    """What a pilot sees at one instant: SI, rad; `climb_rate` is up; `load` is the load factor, 1 in level flight."""

    altitude: float
    climb_rate: float
    airspeed: float
    phi: float
    theta: float
    psi: float
    p: float
    q: float
    r: float
    beta: float
    load: float = 1.0


class Controls(NamedTuple):
    """Pilot commands, normalised -1..1 (throttle 0..1).

    Positive elevator is nose down and positive aileron rolls to the right, as JSBSim has them.
    """

    elevator: float
    aileron: float
    rudder: float
    throttle: float


class _Silent(jsbsim.FGLogger):
    """Drops every record. JSBSim otherwise greets, lists the aircraft and reports the trim on the console."""

    def set_level(self, level: Any) -> None: ...
    def file_location(self, filename: str, line: int) -> None: ...
    def format(self, fmt: Any) -> None: ...
    def message(self, message: str) -> None: ...
    def flush(self) -> None: ...


_COLUMNS = {
    "latitude": ("position/lat-geod-rad", 1.0),
    "longitude": ("position/long-gc-rad", 1.0),
    "altitude": ("position/geod-alt-ft", FOOT),
    "velocity_north": ("velocities/v-north-fps", FOOT),
    "velocity_east": ("velocities/v-east-fps", FOOT),
    "velocity_down": ("velocities/v-down-fps", FOOT),
    "phi": ("attitude/phi-rad", 1.0),
    "theta": ("attitude/theta-rad", 1.0),
    "psi": ("attitude/psi-rad", 1.0),
    "u_air": ("velocities/u-aero-fps", FOOT),
    "v_air": ("velocities/v-aero-fps", FOOT),
    "w_air": ("velocities/w-aero-fps", FOOT),
    "wind_north": ("atmosphere/total-wind-north-fps", FOOT),
    "wind_east": ("atmosphere/total-wind-east-fps", FOOT),
    "wind_down": ("atmosphere/total-wind-down-fps", FOOT),
    "pressure": ("atmosphere/P-psf", PASCAL_PER_PSF),
    "temperature": ("atmosphere/T-R", KELVIN_PER_RANKINE),
    "elevator": ("fcs/elevator-pos-rad", 1.0),
    "aileron": ("fcs/left-aileron-pos-rad", 1.0),
    "rudder": ("fcs/rudder-pos-rad", 1.0),
    "throttle": ("fcs/throttle-pos-norm", 1.0),
}


_FLAT_RADIUS = 1000.0 * EQUATOR
_FLAT_PLANET = f"""<?xml version="1.0"?>
<planet name="Flat">
  <semimajor_axis unit="M"> {_FLAT_RADIUS} </semimajor_axis>
  <semiminor_axis unit="M"> {_FLAT_RADIUS} </semiminor_axis>
  <rotation_rate unit="RAD/SEC"> 0.0 </rotation_rate>
  <GM unit="M3/SEC2"> {FLAT_GRAVITY * _FLAT_RADIUS**2} </GM>
  <J2> 0.0 </J2>
</planet>
"""


class Aircraft:
    """An aircraft in trimmed flight.

    Parameters
    ----------
    name : str
        One of `AIRFRAMES`.
    altitude, airspeed : float, optional
        Height above mean sea level (m) and true airspeed (m/s); the airframe's own by default.
    place : Place
        Start.
    planet : str
        ``wgs84``, the rotating ellipsoid, or ``flat``, a plane with constant gravity that does not rotate.
    seed : int
        Of JSBSim's random numbers (turbulence).

    Raises
    ------
    AircraftError
        Unknown name or planet, or no trim at this altitude and airspeed.
    """

    def __init__(
        self,
        name: str = "c172x",
        *,
        altitude: float | None = None,
        airspeed: float | None = None,
        place: Place | None = None,
        planet: Planet = "wgs84",
        seed: int = 1,
    ) -> None:
        if name not in AIRFRAMES:
            raise AircraftError(f"unknown aircraft {name!r}; known to trim: {', '.join(sorted(AIRFRAMES))}")
        if planet not in PLANETS:
            raise AircraftError(f"unknown planet {planet!r}; known: {', '.join(PLANETS)}")
        self.name = name
        self.planet = planet
        self.airframe = AIRFRAMES[name]
        self.altitude = self.airframe.altitude if altitude is None else altitude
        self.airspeed = self.airframe.airspeed if airspeed is None else airspeed
        self._place = Place() if place is None else place
        self._load(seed)
        self._trim(self._place)

        manager = self._fdm.get_property_manager()

        def node(path: str) -> Any:
            found = manager.get_node(path)
            if found is None:
                raise AircraftError(f"{name} has no property {path} in this version of JSBSim")
            return found.get_double_value

        self._columns = tuple((node(path), factor) for path, factor in _COLUMNS.values())
        self._forces = tuple(node(f"forces/fb{axis}-total-lbs") for axis in "xyz")
        self._mass = node("inertia/mass-slugs")
        self._rates = tuple(node(f"velocities/{axis}i-rad_sec") for axis in "pqr")
        names = ("position/geod-alt-ft", "velocities/h-dot-fps", "velocities/vt-fps", "attitude/phi-rad",
                 "attitude/theta-rad", "attitude/psi-rad", "velocities/p-rad_sec", "velocities/q-rad_sec",
                 "velocities/r-rad_sec", "aero/beta-rad")  # fmt: skip
        self._state = tuple(node(path) for path in names)

    def _load(self, seed: int) -> None:
        # The logger is per thread in JSBSim; a second aircraft in the same thread shares it.
        if not isinstance(jsbsim.get_logger(), _Silent):
            jsbsim.set_logger(_Silent())
        self._fdm = jsbsim.FGFDMExec(None)
        self._fdm.set_debug_level(0)
        if self.planet == "flat":
            self._flatten()
        if not self._fdm.load_model(self.name):
            raise AircraftError(f"JSBSim cannot load {self.name!r} from {jsbsim.get_default_root_dir()}")
        self._discard_outputs()
        self._fdm.set_dt(1.0 / RATE)
        self._fdm["simulation/randomseed"] = seed
        # Buss2: rectangular Euler, the default, drifts 0.03 deg/min against its own rates.
        self._fdm["simulation/integrator/position/rotational"] = 7
        if self.planet == "flat":
            self._fdm["simulation/gravity-model"] = 0

    def _flatten(self) -> None:
        """Put the aircraft on a sphere a thousand times as large as the Earth, which neither turns nor bulges."""
        # JSBSim reads planets only from files.
        with tempfile.NamedTemporaryFile("w", suffix=".xml") as file:
            file.write(_FLAT_PLANET)
            file.flush()
            if not self._fdm.load_planet(file.name, False):
                raise AircraftError(
                    "this version of JSBSim does not load a planet of one's own, so planet='flat' fails"
                )

    def _discard_outputs(self) -> None:
        # Some models write a .csv into the working directory, with its header even when output is disabled.
        self._fdm.disable_output()
        index = 0
        while self._fdm.get_output_filename(index):
            self._fdm.set_output_filename(index, os.devnull)
            index += 1

    def _trim(self, place: Place) -> None:
        fdm = self._fdm
        fdm["ic/lat-geod-deg"] = math.degrees(place.latitude)
        fdm["ic/long-gc-deg"] = math.degrees(place.longitude)
        fdm["ic/h-sl-ft"] = self.altitude / FOOT
        fdm["ic/psi-true-deg"] = math.degrees(place.heading) % 360.0
        fdm["ic/vt-fps"] = self.airspeed / FOOT  # last, because the altitude setter converts an earlier speed
        fdm.run_ic()
        fdm["propulsion/set-running"] = -1
        fdm["gear/gear-cmd-norm"] = 0.0
        fdm["gear/gear-pos-norm"] = 0.0
        try:
            fdm["simulation/do_simple_trim"] = 1
        except jsbsim.TrimFailureError as error:
            raise AircraftError(
                f"{self.name} does not trim at {self.altitude:.0f} m and {self.airspeed:.0f} m/s; "
                f"known to trim at {self.airframe.altitude:.0f} m and {self.airframe.airspeed:.0f} m/s"
            ) from error
        self._engines = fdm.get_propulsion().get_num_engines()
        self.trim = Controls(*(fdm[f"fcs/{c}-cmd-norm"] for c in ("elevator", "aileron", "rudder", "throttle")))
        self._elevator, self._play = self.trim.elevator, 0.0
        self.trim_theta = float(fdm["attitude/theta-rad"])
        self.trim_alpha = float(fdm["aero/alpha-rad"])

    def state(self) -> State:
        """Return what the autopilot sees now."""
        h, climb, v, phi, theta, psi, p, q, r, beta = (get() for get in self._state)
        load = -self._forces[2]() * SLUG_FOOT_PER_S2 / self._mass() / STANDARD_GRAVITY
        return State(h * FOOT, climb * FOOT, v * FOOT, phi, theta, psi, p, q, r, beta, load)

    def command(self, controls: Controls) -> None:
        """Set the controls; they hold until the next command."""
        fdm = self._fdm
        # The light single's elevator has 2.9 deg of dead travel: unless the stick jumps across it at every reversal,
        # as a pilot's hand does, the autopilot ends in a limit cycle.
        if controls.elevator != self._elevator:
            self._play = math.copysign(self.airframe.backlash, controls.elevator - self._elevator)
            self._elevator = controls.elevator
        fdm["fcs/elevator-cmd-norm"] = controls.elevator + self._play
        fdm["fcs/aileron-cmd-norm"] = controls.aileron
        fdm["fcs/rudder-cmd-norm"] = controls.rudder
        for engine in range(self._engines):
            fdm[f"fcs/throttle-cmd-norm[{engine}]"] = controls.throttle

    def set_wind(self, north: float, east: float) -> None:
        """Set the steady wind (m/s, the way the air moves)."""
        self._fdm["atmosphere/wind-north-fps"] = north / FOOT
        self._fdm["atmosphere/wind-east-fps"] = east / FOOT

    def set_turbulence(self, severity: int) -> None:
        """Switch MIL-F-8785C turbulence on at `severity` 1 (light) .. 7 (severe); 0 leaves the air calm."""
        if severity:
            self._fdm["atmosphere/turb-type"] = 4
            self._fdm["atmosphere/turbulence/milspec/windspeed_at_20ft_AGL-fps"] = 50.0
            self._fdm["atmosphere/turbulence/milspec/severity"] = severity

    def step(self) -> None:
        """Advance by 1 / `RATE` seconds."""
        self._fdm.run()

    def inertial(self) -> tuple[float, float, float, float, float, float]:
        """Return specific force at the CG (m/s2) and inertial body rates (rad/s), at the instant of the state."""
        # forces/mass and not accelerations/N*: those are one integration frame late and N_z has the other sign.
        scale = SLUG_FOOT_PER_S2 / self._mass()
        fx, fy, fz = self._forces
        p, q, r = self._rates
        return fx() * scale, fy() * scale, fz() * scale, p(), q(), r()

    def columns(self) -> list[float]:
        """Return the remaining quantities of one truth record, in the order of `column_names` (SI, rad)."""
        return [get() * factor for get, factor in self._columns]

    def on_map(self, latitude: Array, longitude: Array) -> tuple[Array, Array]:
        """Return recorded latitudes and longitudes (rad) on WGS-84: as they are, or from the flat Earth."""
        if self.planet == "wgs84":
            return latitude, longitude
        # The start of the flight: the settling before the first record is flown on the same plane.
        return unroll(latitude, longitude, (self._place.latitude, self._place.longitude), _FLAT_RADIUS)

    @staticmethod
    def column_names() -> tuple[str, ...]:
        """Return the names that go with `columns`."""
        return tuple(_COLUMNS)
