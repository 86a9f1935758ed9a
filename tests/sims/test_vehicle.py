"""Every frame decodes to the values that went in, within the wire's quantisation."""

import collections

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

import sims
from sims import atmosphere

from .conftest import UTC


@pytest.fixture(scope="module")
def decoded(sent):
    parser = mavlink.MAVLink(None)
    messages = collections.defaultdict(list)
    for t, frame in sent:
        message = parser.decode(bytearray(frame))
        messages[message.get_type()].append((t, message))
    return messages


def column(messages, field):
    return np.array([getattr(message, field) for _, message in messages], float)


def times(messages):
    return np.array([t for t, _ in messages])


def test_frames_come_in_order_of_time(sent):
    assert [t for t, _ in sent] == sorted(t for t, _ in sent)
    assert sent[0][0] == 4_000_000_000


def test_sequence_numbers_have_no_gaps(sent):
    assert [frame[4] for _, frame in sent] == [k % 256 for k in range(len(sent))]
    assert {(frame[0], frame[5], frame[6]) for _, frame in sent} == {(0xFD, 1, 1)}


@pytest.mark.parametrize(
    ("name", "rate"),
    [
        ("HEARTBEAT", 1),
        ("SYSTEM_TIME", 1),
        ("HIGHRES_IMU", 50),
        ("ATTITUDE", 25),
        ("SCALED_PRESSURE", 10),
        ("VFR_HUD", 5),
        ("GPS_RAW_INT", 5),
        ("GLOBAL_POSITION_INT", 5),
    ],
)
def test_rates(decoded, name, rate):
    assert len(decoded[name]) == 170 * rate + 1
    assert set(np.diff(times(decoded[name]))) == {1_000_000_000 // rate}


def test_stamps_are_the_times_of_the_samples(decoded):
    for name in ("HIGHRES_IMU", "GPS_RAW_INT"):
        np.testing.assert_array_equal(column(decoded[name], "time_usec") * 1000, times(decoded[name]))
    for name in ("ATTITUDE", "SCALED_PRESSURE", "GLOBAL_POSITION_INT", "SYSTEM_TIME"):
        np.testing.assert_array_equal(column(decoded[name], "time_boot_ms") * 1_000_000, times(decoded[name]))


def test_system_time_anchors_the_vehicle_clock_to_utc(decoded):
    for t, message in decoded["SYSTEM_TIME"]:
        assert message.time_unix_usec == (UTC + t - 4_000_000_000) // 1000


def test_status_texts_are_the_greeting_and_the_marks(flight, decoded):
    texts = [(t, message.text) for t, message in decoded["STATUSTEXT"]]
    assert texts == [(4_000_000_000, "Sortie simulated c172x"), *flight.marks]


def test_heartbeat_is_a_fixed_wing(decoded):
    message = decoded["HEARTBEAT"][0][1]
    assert message.type == mavlink.MAV_TYPE_FIXED_WING
    assert message.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED


def test_imu(flight, decoded):
    imu, messages = flight.sensors.imu, decoded["HIGHRES_IMU"]
    force = np.stack([column(messages, f"{axis}acc") for axis in "xyz"], axis=1)
    rates = np.stack([column(messages, f"{axis}gyro") for axis in "xyz"], axis=1)
    np.testing.assert_allclose(force, imu.specific_force, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(rates, imu.rates, rtol=1e-6, atol=1e-8)


def test_imu_says_which_fields_are_new(flight, decoded):
    messages, static, pitot = decoded["HIGHRES_IMU"], flight.sensors.static, flight.sensors.pitot
    fields = [message.fields_updated for _, message in messages]
    assert fields[:6] == [0b1111000111111, *[0b111111] * 4, 0b1111000111111]
    fresh = [item for item in messages if item[1].fields_updated & 1 << 9]
    np.testing.assert_array_equal(times(fresh), static.t)
    np.testing.assert_allclose(column(fresh, "abs_pressure") * 100, static.pressure, atol=0.004)
    np.testing.assert_allclose(column(fresh, "diff_pressure") * 100, pitot.impact, atol=2e-4)
    np.testing.assert_allclose(column(fresh, "pressure_alt"), static.altitude, atol=1e-4)
    np.testing.assert_allclose(column(fresh, "temperature") + 273.15, static.temperature, atol=1e-5)
    assert messages[3][1].abs_pressure == messages[0][1].abs_pressure


def test_attitude(flight, decoded):
    reference, messages = flight.sensors.attitude, decoded["ATTITUDE"]
    angles = np.stack([column(messages, name) for name in ("roll", "pitch", "yaw")], axis=1)
    error = (angles - reference.attitude + np.pi) % (2 * np.pi) - np.pi
    assert np.abs(error).max() < 1e-6
    assert np.abs(angles[:, 2]).max() <= np.pi + 1e-6
    rates = np.stack([column(messages, f"{name}speed") for name in ("roll", "pitch", "yaw")], axis=1)
    np.testing.assert_allclose(rates, reference.rates, rtol=1e-6, atol=1e-8)


def test_pressures(flight, decoded):
    messages, static = decoded["SCALED_PRESSURE"], flight.sensors.static
    np.testing.assert_allclose(column(messages, "press_abs") * 100, static.pressure, atol=0.004)
    np.testing.assert_allclose(column(messages, "press_diff") * 100, flight.sensors.pitot.impact, atol=2e-4)
    np.testing.assert_allclose(column(messages, "temperature") / 100 + 273.15, static.temperature, atol=0.006)
    height = atmosphere.pressure_altitude(column(messages, "press_abs") * 100)
    np.testing.assert_allclose(height, static.altitude, atol=1e-3)


def test_gnss(flight, decoded):
    messages, gnss, grade = decoded["GPS_RAW_INT"], flight.sensors.gnss, flight.sensors.grade
    np.testing.assert_allclose(column(messages, "lat"), np.degrees(gnss.latitude) * 1e7, atol=0.51)
    np.testing.assert_allclose(column(messages, "lon"), np.degrees(gnss.longitude) * 1e7, atol=0.51)
    np.testing.assert_allclose(column(messages, "alt") / 1e3, gnss.altitude, atol=6e-4)
    speed, course = column(messages, "vel") / 100, np.radians(column(messages, "cog") / 100)
    np.testing.assert_allclose(speed * np.cos(course), gnss.velocity[:, 0], atol=0.011)
    np.testing.assert_allclose(speed * np.sin(course), gnss.velocity[:, 1], atol=0.011)
    first = messages[0][1]
    assert (first.fix_type, first.h_acc, first.v_acc, first.vel_acc) == (3, 5000, 7500, 200)
    assert first.h_acc == grade.position * 1e3


def test_position(flight, decoded):
    messages, navigation = decoded["GLOBAL_POSITION_INT"], flight.sensors.navigation
    np.testing.assert_allclose(column(messages, "lat"), np.degrees(navigation.latitude) * 1e7, atol=0.51)
    np.testing.assert_allclose(column(messages, "lon"), np.degrees(navigation.longitude) * 1e7, atol=0.51)
    np.testing.assert_allclose(column(messages, "alt") / 1e3, navigation.altitude, atol=6e-4)
    velocity = np.stack([column(messages, f"v{axis}") for axis in "xyz"], axis=1) / 100
    np.testing.assert_allclose(velocity, navigation.velocity, atol=0.0051)
    assert np.all((column(messages, "hdg") >= 0) & (column(messages, "hdg") < 36000))


def test_hud(flight, decoded):
    messages, navigation = decoded["VFR_HUD"], flight.sensors.navigation
    np.testing.assert_allclose(column(messages, "airspeed"), flight.sensors.pitot.airspeed[::2], atol=1e-5)
    np.testing.assert_allclose(column(messages, "alt"), navigation.altitude, atol=1e-3)
    np.testing.assert_allclose(column(messages, "climb"), -navigation.velocity[:, 2], atol=1e-6)
    assert np.all((column(messages, "throttle") > 30) & (column(messages, "throttle") <= 100))
    assert np.all((column(messages, "heading") >= 0) & (column(messages, "heading") < 360))


def test_the_small_autopilot_sends_neither_vanes_nor_vertical_velocity(decoded):
    assert "AOA_SSA" not in decoded
    assert "GPS_INPUT" not in decoded


@pytest.fixture(scope="module")
def instrumented():
    """A short flight with flight-test instrumentation, and its messages."""
    flown = sims.fly("737", "level", sensors="fti", duration=5, start_utc=UTC)
    parser = mavlink.MAVLink(None)
    messages = collections.defaultdict(list)
    for t, frame in sims.frames(flown):
        message = parser.decode(bytearray(frame))
        messages[message.get_type()].append((t, message))
    return flown, messages


def test_vanes_are_degrees(instrumented):
    flown, messages = instrumented
    vanes, told = flown.sensors.vanes, messages["AOA_SSA"]
    np.testing.assert_array_equal(times(told), vanes.t)
    np.testing.assert_array_equal(column(told, "time_usec") * 1000, vanes.t)
    np.testing.assert_allclose(column(told, "AOA"), np.degrees(vanes.alpha), rtol=1e-6)
    np.testing.assert_allclose(column(told, "SSA"), np.degrees(vanes.beta), rtol=1e-6, atol=1e-6)


def test_a_fix_with_three_components_of_velocity(instrumented):
    flown, messages = instrumented
    gnss, told = flown.sensors.gnss, messages["GPS_INPUT"]
    assert len(told) == len(messages["GPS_RAW_INT"])
    velocity = np.stack([column(told, name) for name in ("vn", "ve", "vd")], axis=1)
    np.testing.assert_allclose(velocity, gnss.velocity, rtol=1e-6, atol=1e-5)
    np.testing.assert_allclose(column(told, "lat"), np.degrees(gnss.latitude) * 1e7, atol=0.51)
    np.testing.assert_allclose(column(told, "alt"), gnss.altitude, rtol=1e-6)
    first = told[0][1]
    assert (first.fix_type, first.ignore_flags, first.satellites_visible) == (3, 0, 14)
    accuracy = (first.speed_accuracy, first.horiz_accuracy, first.vert_accuracy)
    np.testing.assert_allclose(accuracy, [0.05, 2, 3], rtol=1e-6)
    gps = UTC / 1e9 - 315964800 + 18
    assert first.time_week == int(gps // 604800)
    assert first.time_week_ms == round(gps % 604800 * 1000)


def test_flight_test_rates_on_the_link(instrumented):
    _, messages = instrumented
    for name, rate in (("HIGHRES_IMU", 100), ("ATTITUDE", 50), ("SCALED_PRESSURE", 20), ("AOA_SSA", 50)):
        assert set(np.diff(times(messages[name]))) == {1_000_000_000 // rate}
    fresh = [m.fields_updated >> 9 for _, m in messages["HIGHRES_IMU"]]
    assert fresh[:6] == [0b1111, 0, 0, 0, 0, 0b1111]


def test_several_vehicles_have_numbers_of_their_own(flight):
    assert {frame[5] for _, frame in sims.frames(flight, sysid=7)} == {7}
    for number in (0, 256):
        with pytest.raises(ValueError, match=r"1\.\.255"):
            sims.frames(flight, sysid=number)


def test_the_same_flight_gives_the_same_bytes(flight, sent):
    assert list(sims.frames(flight)) == sent
