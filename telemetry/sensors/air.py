"""Altimeter, airspeed system and vanes: pressures to altitude and airspeed."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from telemetry.messages import AirData, Altitude, FlowAngles
from telemetry.sensors.feeds import Columns, Doubt, Feed, Mask, Refusals, number

if TYPE_CHECKING:
    from telemetry.sensors.overrides import SensorSettings

SEA_LEVEL_PRESSURE = 101325.0
SEA_LEVEL_SOUND = 340.294  # m/s
SONIC = 0.8929 * SEA_LEVEL_PRESSURE  # Pa: impact pressure at the speed of sound, where the formula ends
FASTEST = 1000.0  # m/s
HIGHEST = 1e5  # m
STATIC, DIFFERENTIAL, PRESSURE_ALTITUDE = 0x200, 0x400, 0x800  # of fields_updated
UNHEALTHY = 1  # of AIRSPEED.flags
COPY = 0.1  # m/s: an airspeed nearer to the groundspeed may be a copy of it

BAD_ALTITUDE, BAD_PRESSURE = "the altitude is impossible", "the static pressure is impossible"
BAD_DIFFERENTIAL, BAD_AIRSPEED = "the differential pressure is impossible", "the airspeed is impossible"
BAD_VANE = "the vanes point backwards or nowhere"


def pressure_altitude(pressure: NDArray[np.float64]) -> NDArray[np.float64]:
    """Altitude in the ICAO standard atmosphere up to 11 km, m, from static pressure, Pa (NaN stays NaN)."""
    return 44330.769 * (1.0 - (pressure / SEA_LEVEL_PRESSURE) ** 0.19026324)


def calibrated_airspeed(differential: NDArray[np.float64]) -> NDArray[np.float64]:
    """Calibrated airspeed, m/s, of subsonic compressible flow, V = a0 sqrt(5 ((q_c/p0 + 1)^(2/7) - 1)).

    A negative pressure, as at rest, gives a negative airspeed, not a root of it. NaN beyond the speed of sound.
    """
    ratio = np.abs(differential) / SEA_LEVEL_PRESSURE
    ratio[~(ratio < SONIC / SEA_LEVEL_PRESSURE)] = np.nan
    return np.sign(differential) * SEA_LEVEL_SOUND * np.sqrt(5.0 * np.expm1(2.0 / 7.0 * np.log1p(ratio)))


def altitude_columns(altitude: NDArray[np.float64], pressure: NDArray[np.float64], sigma: float) -> Columns:
    """The columns of `Altitude`."""
    return {"altitude": altitude, "pressure": pressure, "sigma": np.full(len(altitude), sigma)}


def possible(pressure: NDArray[np.float64]) -> Mask:
    """Static pressure, Pa, between the Dead Sea's and that at 30 km; NaN, infinity and zero are none."""
    return np.asarray((pressure > 1e3) & (pressure < 1.2e5))


def flow(angle: NDArray[np.float64]) -> NDArray[np.float64]:
    """An angle of the flow, rad, NaN where it cannot be one: a vane that points backwards, or nowhere."""
    return np.where(np.abs(angle) <= 0.5 * np.pi, angle, np.nan)


def _highres_altitude(values: NDArray[Any], settings: SensorSettings) -> tuple[Refusals, Columns]:
    told = values["fields_updated"]
    pressure = np.where(told & STATIC, number(values, "abs_pressure", 100.0), np.nan)
    pressure[~possible(pressure)] = np.nan
    altitude = np.where(told & PRESSURE_ALTITUDE, number(values, "pressure_alt"), pressure_altitude(pressure))
    bad = ~(np.abs(altitude) < HIGHEST)
    return [(BAD_ALTITUDE, bad)], altitude_columns(altitude, pressure, settings.altitude_sigma)


def _scaled_pressure(values: NDArray[Any], settings: SensorSettings) -> tuple[Refusals, Columns]:
    pressure = number(values, "press_abs", 100.0)
    real = possible(pressure)
    altitude = pressure_altitude(np.where(real, pressure, np.nan))
    return [(BAD_PRESSURE, ~real)], altitude_columns(altitude, pressure, settings.altitude_sigma)


def _hud_altitude(values: NDArray[Any], settings: SensorSettings) -> tuple[Refusals, Columns]:
    altitude = number(values, "alt")
    bad = ~(np.abs(altitude) < HIGHEST)
    return [(BAD_ALTITUDE, bad)], altitude_columns(altitude, np.full(len(bad), np.nan), settings.altitude_sigma)


def _position_altitude(values: NDArray[Any], settings: SensorSettings) -> tuple[Refusals, Columns]:
    nowhere = (values["lat"] == 0) & (values["lon"] == 0)
    columns = altitude_columns(number(values, "alt", 1e-3), np.full(len(nowhere), np.nan), settings.altitude_sigma)
    return [("latitude and longitude are 0", nowhere)], columns


def _differential(name: str, values: NDArray[Any]) -> tuple[Refusals, Columns]:
    pressure = number(values, name, 100.0)
    airspeed = calibrated_airspeed(pressure)
    return [(BAD_DIFFERENTIAL, np.isnan(airspeed))], {"airspeed": airspeed, "differential_pressure": pressure}


def _highres_air(values: NDArray[Any], _: SensorSettings) -> tuple[Refusals, Columns]:
    return _differential("diff_pressure", values)


def _scaled_air(values: NDArray[Any], _: SensorSettings) -> tuple[Refusals, Columns]:
    return _differential("press_diff", values)


def _airspeed(values: NDArray[Any], _: SensorSettings) -> tuple[Refusals, Columns]:
    airspeed, pressure = number(values, "airspeed"), number(values, "raw_press", 100.0)
    pressure[~(np.abs(pressure) < SONIC)] = np.nan
    refusals = [
        ("its flags say unhealthy", (values["flags"] & UNHEALTHY) != 0),
        (BAD_AIRSPEED, ~(np.abs(airspeed) < FASTEST)),
        ("airspeed and pressure are 0", (airspeed == 0.0) & (pressure == 0.0)),
    ]
    return refusals, {"airspeed": airspeed, "differential_pressure": pressure}


def _hud_airspeed(values: NDArray[Any], _: SensorSettings) -> tuple[Refusals, Columns]:
    airspeed = number(values, "airspeed")
    refusals = [(BAD_AIRSPEED, ~(np.abs(airspeed) < FASTEST)), ("the airspeed is exactly 0", airspeed == 0.0)]
    return refusals, {"airspeed": airspeed, "differential_pressure": np.full(len(airspeed), np.nan)}


def _some(name: str) -> Doubt:
    return Doubt("its differential pressure has only been 0 (there is no sensor)", lambda values: values[name] != 0, 1)


FLOWN = 25.0  # Pa, an airspeed of 6.4 m/s: a port to which nothing is connected drifts by less


def _flown(name: str) -> Doubt:
    reason = f"its differential pressure has not yet been {FLOWN:.0f} Pa in 5 rows running (no probe, or at rest)"
    return Doubt(reason, lambda values: np.asarray(number(values, name, 100.0) > FLOWN), 5)


def _differs(values: NDArray[Any]) -> Mask:
    with np.errstate(invalid="ignore"):
        return np.asarray(np.abs(number(values, "airspeed") - number(values, "groundspeed")) > COPY)


COPIED = Doubt(
    f"its airspeed has not yet differed from its groundspeed by {COPY} m/s in 5 rows running (a copy has no sensor)",
    _differs,
    5,
)


def _aoa_ssa(values: NDArray[Any], _: SensorSettings) -> tuple[Refusals, Columns]:
    alpha, beta = (flow(np.deg2rad(number(values, name))) for name in ("AOA", "SSA"))
    return [(BAD_VANE, np.isnan(alpha) & np.isnan(beta))], {"alpha": alpha, "beta": beta}


_BAROMETER, _PITOT = (STATIC, PRESSURE_ALTITUDE), (DIFFERENTIAL,)
_CLOSEST, _SIMULATED = "closest to the instrument", "the sensors of a simulator"
_STATIC = "static pressure"
_UNCORRECTED = "differential pressure, to which the autopilot's correction of the probe is not applied"
_HUD = "the airspeed as the autopilot corrects it; no AIRSPEED is heard"
_ASKED = "a filter's output"

AIR_FEEDS = (
    Feed("HIGHRES_IMU", 105, Altitude, 0, _highres_altitude, _CLOSEST, "id", _BAROMETER),
    Feed("HIL_SENSOR", 107, Altitude, 1, _highres_altitude, _SIMULATED, "id", _BAROMETER, sent_to=True),
    Feed("SCALED_PRESSURE", 29, Altitude, 2, _scaled_pressure, _STATIC, 0),
    Feed("SCALED_PRESSURE2", 137, Altitude, 2, _scaled_pressure, _STATIC, 1),
    Feed("SCALED_PRESSURE3", 143, Altitude, 2, _scaled_pressure, _STATIC, 2),
    Feed("VFR_HUD", 74, Altitude, 3, _hud_altitude, _ASKED, asked=True),
    Feed("GLOBAL_POSITION_INT", 33, Altitude, 4, _position_altitude, _ASKED, asked=True),
    Feed("HIGHRES_IMU", 105, AirData, 0, _highres_air, _CLOSEST, "id", _PITOT, _some("diff_pressure")),
    Feed("HIL_SENSOR", 107, AirData, 1, _highres_air, _SIMULATED, "id", _PITOT, _some("diff_pressure"), sent_to=True),
    Feed("AIRSPEED", 295, AirData, 2, _airspeed, "the sensor as the autopilot corrects it", "id"),
    Feed("VFR_HUD", 74, AirData, 3, _hud_airspeed, _HUD, doubt=COPIED),
    Feed("SCALED_PRESSURE", 29, AirData, 4, _scaled_air, _UNCORRECTED, 0, doubt=_flown("press_diff")),
    Feed("SCALED_PRESSURE2", 137, AirData, 4, _scaled_air, _UNCORRECTED, 1, doubt=_flown("press_diff")),
    Feed("SCALED_PRESSURE3", 143, AirData, 4, _scaled_air, _UNCORRECTED, 2, doubt=_flown("press_diff")),
    Feed("AOA_SSA", 11020, FlowAngles, 0, _aoa_ssa, "from no ArduPilot, so of vanes", derived=True),
)
