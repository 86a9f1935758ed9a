"""What the settings say about sensors: which message is used, vanes of one's own, noise; and what they refuse."""

from __future__ import annotations

import math
import pkgutil

import msgspec
import numpy as np
import pymavlink.dialects.v20
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

import telemetry.ingest
from telemetry.mavlink import Dialect
from telemetry.messages import SENSORS, AirData, Altitude, Attitude, Event, FlowAngles, Gnss, Imu
from telemetry.sensors import FEEDS, Quantity, Sensors, SensorSettings, check
from tests.telemetry.test_sensors import (
    DIALECT,
    Vehicle,
    gps,
    gps_input,
    heartbeat,
    highres,
    hud,
    pressure,
    raw,
    samples,
    scaled,
    vanes,
)


def named(name, value, ms=5):
    return mavlink.MAVLink_named_value_float_message(ms, name.encode(), value)


def array(name, *data, us=5):
    return mavlink.MAVLink_debug_float_array_message(us, name.encode(), 0, [*data, *[0.0] * (58 - len(data))])


def vector(name, *xyz, us=5):
    return mavlink.MAVLink_debug_vect_message(name.encode(), us, *xyz)


def read(text):
    """The settings in the text of a file."""
    return msgspec.toml.decode(text, type=telemetry.ingest.Settings).sensors


def test_the_settings_of_a_file():
    told = read("""
        [sensors]
        imu = "SCALED_IMU2@1.1"
        attitude = "off"
        altitude_sigma = 0.5

        [sensors.alpha]
        message = "NAMED_VALUE_FLOAT"
        name = "AOA"
        unit = "deg"
        scale = -1.0

        [sensors.beta]
        message = "DEBUG_FLOAT_ARRAY"
        name = "VANES"
        index = 1
    """)
    check(told, DIALECT)
    assert told.wanted(Imu) == ("SCALED_IMU2", 1, 1)
    assert told.beta == Quantity(message="DEBUG_FLOAT_ARRAY", name="VANES", index=1)
    again = msgspec.convert(msgspec.to_builtins(told), SensorSettings)
    assert again == told, "sortie.toml can be read back"


def test_a_message_that_is_asked_for_goes_before_better_ones():
    vehicle = Vehicle(imu="SCALED_IMU2")
    told = [m for m in vehicle.hear(highres(), scaled(number=2)) if isinstance(m, Imu)]
    assert [(m.source, m.chosen) for m in told] == [("0/1", True), ("0/1.1", True)]
    later = [m for m in vehicle.hear(highres(us=2), scaled(ms=6, number=2)) if isinstance(m, Imu)]
    assert [(m.source, m.chosen) for m in later] == [("0/1", False), ("0/1.1", True)]
    assert [text for text in vehicle.events if text.startswith("imu")] == [
        "imu: HIGHRES_IMU of component 1 (closest to the instrument;"
        " SCALED_IMU2 of [ingest.sensors] has not been heard)",
        "imu: SCALED_IMU2 of component 1 takes over from HIGHRES_IMU of component 1 (as [ingest.sensors] says)",
    ]


def test_a_lesser_message_of_the_same_instrument_can_be_asked_for():
    told = [m for m in Vehicle(imu="SCALED_IMU").hear(scaled(), highres()) if isinstance(m, Imu)]
    assert [len(m.t) for m in told] == [1]
    assert told[0].specific_force[0, 2] == pytest.approx(-9.80665)


@pytest.mark.parametrize(("wish", "source"), [("HIGHRES_IMU@1.1", "0/1.1"), ("HIGHRES_IMU@2", "0/2")])
def test_one_component_and_one_instance_can_be_asked_for(wish, source):
    vehicle = Vehicle(imu=wish)
    told = vehicle.hear_all([(highres(), 1), (highres(id=1), 1), (highres(), 2)])
    told += vehicle.hear_all([(highres(us=2), 1), (highres(us=2, id=1), 1), (highres(us=2), 2)])
    assert [m.source for m in told if isinstance(m, Imu) and m.chosen][-1] == source


def test_what_is_off_is_recorded_and_not_used():
    vehicle = Vehicle(gnss="off")
    (fix,) = [m for m in vehicle.hear(gps()) if isinstance(m, Gnss)]
    assert not fix.chosen
    assert vehicle.events == ["gnss: GPS_RAW_INT of component 1 is recorded, not used: gnss is off in [ingest.sensors]"]


def test_what_is_asked_for_is_believed():
    assert AirData in samples(hud(12.0, 12.0), vehicle=Vehicle(air_data="VFR_HUD"))
    assert Imu in samples(raw(5, acc=(0, 0, -2048)), vehicle=Vehicle(imu="RAW_IMU"))
    flow = Vehicle(flow_angles="AOA_SSA")
    assert FlowAngles in samples(heartbeat(3), vanes(1.0, 2.0), vehicle=flow)


@pytest.mark.parametrize(
    ("wish", "message"),
    [
        ("VFR_HUD", hud(12.0, 12.0, alt=512.0)),
        ("GLOBAL_POSITION_INT", mavlink.MAVLink_global_position_int_message(5, 1, 1, 512000, 0, 0, 0, 0, 0)),
    ],
)
def test_the_altitude_of_a_filter_is_used_only_if_asked_for(wish, message):
    assert Altitude not in samples(message)
    assert samples(message, vehicle=Vehicle(altitude=wish))[Altitude].altitude[0] == 512


def test_what_was_never_heard_is_told_at_the_end():
    vehicle = Vehicle(imu="SCALED_IMU3", alpha=Quantity(message="NAMED_VALUE_FLOAT", name="AOA"))
    vehicle.hear(highres())
    said = [(m.level[0], m.text[0]) for m in vehicle.sensors.finish(1, 1, 0)]
    assert ("warning", "imu: SCALED_IMU3 of [ingest.sensors] was never heard") in said
    assert ("warning", "flow_angles: NAMED_VALUE_FLOAT AOA of [ingest.sensors] was never heard") in said


def test_vanes_of_ones_own_in_two_messages_leave_each_other_unmeasured():
    vehicle = Vehicle(
        alpha=Quantity(message="NAMED_VALUE_FLOAT", name="AOA", scale=-1.0, offset=0.5),
        beta=Quantity(message="NAMED_VALUE_FLOAT", name="SSA", unit="rad"),
    )
    (flow,) = [m for m in vehicle.hear(named("AOA", 3.0), named("SSA", 0.1), named("RPM", 9.0)) if m.stream != "log"]
    np.testing.assert_allclose(flow.alpha, [math.radians(-2.5), math.nan], rtol=1e-6)
    np.testing.assert_allclose(flow.beta, [math.nan, 0.1], rtol=1e-6)
    assert flow.chosen and flow.source == "0/1"
    assert vehicle.events == ["flow_angles: NAMED_VALUE_FLOAT AOA and NAMED_VALUE_FLOAT SSA (as [ingest.sensors] says)"]


def test_vanes_of_ones_own_in_one_message_are_one_sample():
    places = {
        name: Quantity(message="DEBUG_FLOAT_ARRAY", name="VANES", index=i) for i, name in enumerate(("alpha", "beta"))
    }
    flow = samples(array("VANES", 3.0, -1.0), array("OTHER", 9.0), vehicle=Vehicle(**places))[FlowAngles]
    np.testing.assert_allclose([flow.alpha, flow.beta], np.radians([[3.0], [-1.0]]), rtol=1e-6)


def test_vanes_of_ones_own_may_come_from_two_components():
    vehicle = Vehicle(
        alpha=Quantity(message="DEBUG_VECT", name="V", index=1),
        beta=Quantity(message="NAMED_VALUE_FLOAT", name="SSA", component=26),
    )
    found = vehicle.hear_all([(vector("V", 0.0, 4.0, 0.0), 25), (named("SSA", 2.0), 26), (named("SSA", 2.0, 6), 27)])
    assert [(m.source, m.chosen) for m in found if isinstance(m, FlowAngles)] == [("0/25", True), ("0/26", True)]


def test_two_components_that_say_the_same_are_not_mixed():
    vehicle = Vehicle(alpha=Quantity(message="NAMED_VALUE_FLOAT", name="AOA"))
    found = vehicle.hear_all([(named("AOA", 3.0), 26), (named("AOA", 9.0), 25)])
    (flow,) = [m for m in found if isinstance(m, FlowAngles)]
    assert flow.source == "0/26"
    assert any("component 26 says it too" in text for text in vehicle.events)


@pytest.mark.parametrize("value", [math.nan, math.inf, 91.0])
def test_a_vane_of_ones_own_that_points_nowhere_is_not_measured(value):
    vehicle = Vehicle(alpha=Quantity(message="NAMED_VALUE_FLOAT", name="AOA"))
    assert not samples(named("AOA", value), vehicle=vehicle)


def test_a_name_ends_at_its_first_zero():
    vehicle = Vehicle(alpha=Quantity(message="NAMED_VALUE_FLOAT", name="AOA"))
    assert FlowAngles in samples(named("AOA\0xyz", 3.0), vehicle=vehicle)
    assert not samples(named("AOA2", 3.0, 6), named("AO", 3.0, 7), vehicle=vehicle)
    ten = Vehicle(alpha=Quantity(message="NAMED_VALUE_FLOAT", name="ABCDEFGHIJ"))
    assert FlowAngles in samples(named("ABCDEFGHIJ", 3.0), vehicle=ten)


def test_what_repeats_its_time_is_held_also_here():
    vehicle = Vehicle(alpha=Quantity(message="NAMED_VALUE_FLOAT", name="AOA"))
    assert len(samples(named("AOA", 3.0), named("AOA", 3.0), vehicle=vehicle)[FlowAngles].t) == 1


@pytest.mark.parametrize(
    ("unit", "value", "expected"),
    [("m/s", 50.0, 50.0), ("kt", 100.0, 51.444), ("km/h", 180.0, 50.0), ("hPa", 16.305, 51.444), ("Pa", -50.0, -9.035)],
)
def test_an_airspeed_of_ones_own(unit, value, expected):
    vehicle = Vehicle(airspeed=Quantity(message="NAMED_VALUE_FLOAT", name="IAS", unit=unit))
    air = samples(named("IAS", value), hud(12.0, 12.0), vehicle=vehicle)[AirData]
    assert air.airspeed[0] == pytest.approx(expected, rel=2e-3)
    assert math.isnan(air.differential_pressure[0]) == (unit in ("m/s", "kt", "km/h"))


@pytest.mark.parametrize(("unit", "value"), [("m", 1000.0), ("ft", 3280.84), ("hPa", 898.746), ("inHg", 26.5397)])
def test_a_pressure_altitude_of_ones_own(unit, value):
    vehicle = Vehicle(pressure_altitude=Quantity(message="NAMED_VALUE_FLOAT", name="H", unit=unit), altitude_sigma=0.25)
    altitude = samples(named("H", value), pressure(), vehicle=vehicle)[Altitude]
    assert altitude.altitude[0] == pytest.approx(1000, abs=0.6)
    assert altitude.sigma[0] == 0.25


def test_any_field_of_any_message_can_be_a_quantity():
    vehicle = Vehicle(alpha=Quantity(message="SERVO_OUTPUT_RAW", field="servo5_raw", scale=0.1, offset=-150.0))
    message = mavlink.MAVLink_servo_output_raw_message(5, 0, 0, 0, 0, 0, 1520, 0, 0, 0)
    assert samples(message, vehicle=vehicle)[FlowAngles].alpha[0] == pytest.approx(math.radians(2.0))


def test_the_noise_of_fixes_without_an_accuracy():
    vehicle = Vehicle(gnss_sigma=1.0, gnss_velocity_sigma=0.1)
    assert samples(gps(), vehicle=vehicle)[Gnss].sigma[0].tolist() == [1.0, 1.5, 0.1]
    assert samples(gps_input(us=2000, flags=224), vehicle=vehicle)[Gnss].sigma[0].tolist() == pytest.approx(
        [1.0, 2.0, 0.1]
    )


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('imu = "SCALED_IM2"', "imu = 'SCALED_IM2': it is one of HIGHRES_IMU, HIL_SENSOR, RAW_IMU, SCALED_IMU"),
        ('gnss = "HIGHRES_IMU"', "gnss = 'HIGHRES_IMU': it is one of GPS2_RAW, GPS_INPUT"),
        ('imu = "HIGHRES_IMU@x"', 'or "off" - at `$.sensors`'),
        ('barometer = "off"', "unknown field `barometer`"),
        ("altitude_sigma = 0.0", "`$.sensors.altitude_sigma`"),
        ('alpha = {message = "M", unit = "m"}', "unit = 'm' of alpha: it is one of rad, deg"),
        ('airspeed = {message = "M", unit = "Pas"}', "it is one of m/s, kt, km/h, mph, Pa, hPa, mbar, inHg, inH2O"),
        ('alpha = {message = "M", scale = 0.0}', "the scale not 0"),
        ('alpha = {message = "M", offset = nan}', "finite numbers"),
        ('flow_angles = "AOA_SSA"\nalpha = {message = "M"}', "only one of the two can be used"),
    ],
)
def test_settings_that_cannot_be_meant_are_refused(text, words):
    with pytest.raises(msgspec.ValidationError) as error:
        read(f"[sensors]\n{text}")
    assert words in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("quantity", "words"),
    [
        ({"message": "NAMED_VALUE_FLOT", "name": "A"}, "none of that name; did you mean NAMED_VALUE_FLOAT"),
        ({"message": "named_value_float", "name": "A"}, "did you mean NAMED_VALUE_FLOAT"),
        ({"message": "QQQQ"}, "choose another dialect or another message"),
        ({"message": "NAMED_VALUE_FLOAT"}, "carries many quantities; say which by name = ..."),
        ({"message": "NAMED_VALUE_FLOAT", "name": "ABCDEFGHIJK"}, "have 1 to 10 letters"),
        ({"message": "ATTITUDE", "name": "A"}, "ATTITUDE has no name; leave it out"),
        ({"message": "ATTITUDE"}, "ATTITUDE has time_boot_ms, roll"),
        ({"message": "ATTITUDE", "field": "rol"}, "field = 'rol': ATTITUDE has time_boot_ms, roll"),
        ({"message": "NAMED_VALUE_FLOAT", "name": "A", "field": "name"}, "field = 'name'"),
        ({"message": "NAMED_VALUE_FLOAT", "name": "A", "index": 1}, "value of NAMED_VALUE_FLOAT is one number"),
        ({"message": "DEBUG_VECT", "name": "A", "index": 3}, "has x, y and z, index 0 to 2"),
        ({"message": "DEBUG_FLOAT_ARRAY", "name": "A", "index": 58}, "has 58 places, from 0"),
    ],
)
def test_a_quantity_that_the_dialect_has_no_place_for_is_refused(quantity, words):
    with pytest.raises(ValueError, match=r"^\[ingest.sensors.alpha\]") as error:
        check(SensorSettings(alpha=Quantity(**quantity)), DIALECT)
    assert words in str(error.value)


def test_a_message_that_the_dialect_has_not_is_refused_before_anything_is_read():
    with pytest.raises(ValueError, match="the dialect common has no such message"):
        telemetry.ingest.ingest(
            [], ["0"], Dialect("common"), telemetry.ingest.Settings(sensors=SensorSettings(flow_angles="AOA_SSA"))
        )


def dialects():
    return sorted(module.name for module in pkgutil.iter_modules(pymavlink.dialects.v20.__path__))


def test_no_dialect_means_something_else_by_the_messages_that_feed_sensors():
    for name in dialects():
        dialect = Dialect(name)
        sensors = Sensors(1, SensorSettings(), dialect)
        row = np.zeros(1, np.int64)
        for feed in FEEDS:
            if dialect.names.get(feed.msgid) == feed.message:
                refusals, columns = feed.convert(np.zeros(1, dialect.layouts[feed.msgid]), SensorSettings())
                assert columns
                assert all(len(mask) == 1 for _, mask in refusals)
        zeros = {(1, msgid): (row, np.zeros(1, dialect.layouts[msgid])) for msgid in sensors.msgids}
        told = sensors.samples(zeros, {1: "0/1"}, row + 1, row + 1, None, 0)
        kinds = {type(m) for m in told if isinstance(m, SENSORS)}
        assert kinds <= {Attitude, FlowAngles}, f"{name}: zeros measure nothing but angles"
        assert any(isinstance(m, Event) for m in told) == (len(dialect.names) > 40)
