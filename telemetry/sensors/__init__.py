"""MAVLink columns to SI samples: which message feeds which sensor, in which units, and which values are no measurement.

Several messages, instruments and components can feed one sensor. One stream is used, the others are recorded beside it
(`telemetry.sensors.choice`), and every choice is told with its reason. Stale but plausible values never become
measurements: a fix below three dimensions, a field that ``fields_updated`` leaves out, whatever repeats the time
before it, an airspeed that copies the groundspeed, angles that a filter made. They are counted, by reason.

What is not chosen well automatically can be said in the settings (`telemetry.sensors.overrides`).
"""

from telemetry.sensors.air import calibrated_airspeed, pressure_altitude
from telemetry.sensors.choice import PATIENCE
from telemetry.sensors.overrides import (
    ALTIMETER_SIGMA,
    FEEDS,
    GNSS_SIGMA,
    GNSS_VELOCITY_SIGMA,
    Quantity,
    SensorSettings,
    check,
)
from telemetry.sensors.vehicle import Sensors

MEASURING = frozenset(feed.msgid for feed in FEEDS if not (feed.sent_to or feed.asked))
"""Messages that show their sender to be a vehicle: one that measures, not one that is told."""

__all__ = [
    "ALTIMETER_SIGMA",
    "FEEDS",
    "GNSS_SIGMA",
    "GNSS_VELOCITY_SIGMA",
    "MEASURING",
    "PATIENCE",
    "Quantity",
    "SensorSettings",
    "Sensors",
    "calibrated_airspeed",
    "check",
    "pressure_altitude",
]
