"""Units, frames and traps of every message that feeds a sensor."""

from __future__ import annotations

import math

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from telemetry.mavlink import Dialect
from telemetry.messages import AirData, Altitude, Attitude, FlowAngles, Gnss, Imu
from telemetry.sensors import PATIENCE, Sensors, pressure_altitude
from tests.telemetry.test_frames import scan
from tests.telemetry.wire import Sender

DIALECT = Dialect()


def samples(*messages, sensors=None, t=None, later=0):
    """What a batch of messages measures, by kind."""
    sender = Sender()
    frames = scan(*[sender.pack(m) for m in messages])
    decoded = {}
    for msgid in set(frames.msgid.tolist()):
        rows = np.flatnonzero(frames.msgid == msgid)
        decoded[msgid] = rows, DIALECT.decode(frames, msgid, rows)
    t = np.arange(len(frames)) if t is None else np.array(t)
    sensors = sensors or Sensors(1, "0/1")
    return {type(m): m for m in sensors.samples(decoded, t, frames.t_rx + later, 0)}


def highres(bits=0xFFFF, **values):
    fields = dict.fromkeys(
        (
            "xacc",
            "yacc",
            "zacc",
            "xgyro",
            "ygyro",
            "zgyro",
            "xmag",
            "ymag",
            "zmag",
            "abs_pressure",
            "diff_pressure",
            "pressure_alt",
            "temperature",
        ),
        0.0,
    )
    return mavlink.MAVLink_highres_imu_message(1000, *(fields | values).values(), bits)


def gps(fix=3, us=1000, lat=474000000, lon=85000000, alt=500000, eph=100, epv=65535, vel=1000, cog=9000, sat=9, **more):
    return mavlink.MAVLink_gps_raw_int_message(us, fix, lat, lon, alt, eph, epv, vel, cog, sat, **more)


def test_pressure_altitude_of_the_standard_atmosphere():
    np.testing.assert_allclose(pressure_altitude(np.array([101325.0, 89874.6, 54019.9])), [0, 1000, 5000], atol=0.6)


def test_milli_g_become_specific_force():
    imu = samples(mavlink.MAVLink_scaled_imu_message(5, 0, 0, -1000, 100, 0, -200, 0, 0, 0))[Imu]
    np.testing.assert_allclose(imu.specific_force, [[0, 0, -9.80665]])
    np.testing.assert_allclose(imu.angular_rate, [[0.1, 0, -0.2]])


def test_the_better_message_wins_from_when_it_is_first_heard():
    scaled = mavlink.MAVLink_scaled_imu_message(5, 0, 0, -1000, 0, 0, 0, 0, 0, 0)
    sensors = Sensors(1, "0/1")
    first = samples(scaled, highres(zacc=-9.0), scaled, highres(zacc=-8.0), sensors=sensors)[Imu]
    np.testing.assert_allclose(first.specific_force[:, 2], [-9.80665, -9.0, -8.0])
    assert Imu not in samples(scaled, sensors=sensors)


def test_a_field_that_was_not_updated_is_no_measurement():
    assert samples(highres(bits=0x3F)).keys() == {Imu}
    only = samples(highres(bits=0x800, pressure_alt=123.0))
    assert only.keys() == {Altitude}
    assert only[Altitude].altitude.tolist() == [123.0]
    assert math.isnan(only[Altitude].pressure[0])


def test_static_pressure_is_hectopascal_on_the_wire():
    found = samples(mavlink.MAVLink_scaled_pressure_message(5, 1013.25, 0, 0))[Altitude]
    assert found.pressure[0] == pytest.approx(101325)
    assert found.altitude[0] == pytest.approx(0, abs=0.1)
    assert not samples(mavlink.MAVLink_scaled_pressure_message(5, 0.0, 0, 0))


def test_negative_differential_pressure_keeps_its_sign():
    air = samples(highres(bits=0x400, diff_pressure=-0.5))[AirData]
    assert air.differential_pressure[0] == -50
    assert air.airspeed[0] == pytest.approx(-math.sqrt(2 * 50 / 1.225), rel=1e-3)  # incompressible


def test_attitude_from_angles_and_from_a_quaternion_agree():
    angles = samples(mavlink.MAVLink_attitude_message(5, 0.3, -0.2, 1.0, 0, 0, 0))[Attitude]
    cr, sr, cp, sp, cy, sy = (f(a / 2) for a in (0.3, -0.2, 1.0) for f in (math.cos, math.sin))
    q = (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )
    turned = samples(mavlink.MAVLink_attitude_quaternion_message(5, *q, 0, 0, 0))[Attitude]
    for name in ("phi", "theta", "psi"):
        np.testing.assert_allclose(getattr(turned, name), getattr(angles, name), atol=1e-6)


def test_a_fix_in_si_units_with_what_the_receiver_knows_of_its_accuracy():
    fix = samples(gps(h_acc=1500, v_acc=2500, vel_acc=200))[Gnss]
    assert math.degrees(fix.latitude[0]) == pytest.approx(47.4)
    assert math.degrees(fix.longitude[0]) == pytest.approx(8.5)
    assert fix.altitude[0] == 500
    np.testing.assert_allclose(fix.velocity[0], [0, 10, math.nan], atol=1e-12)
    assert fix.sigma[0].tolist() == [1.5, 2.5, 0.2]
    assert fix.satellites[0] == 9


def test_what_the_receiver_does_not_know_is_not_zero():
    fix = samples(gps(vel=65535, cog=65535, sat=255, eph=65535))[Gnss]
    assert np.isnan(fix.velocity).all()
    assert fix.satellites[0] == -1
    assert (fix.sigma > 0.1).all()


@pytest.mark.parametrize("bad", [{"fix": 2}, {"fix": 0}, {"lat": 950000000}])
def test_a_fix_that_is_none_is_no_measurement(bad):
    assert not samples(gps(**bad))


@pytest.mark.parametrize("pressure", [math.inf, -math.inf, math.nan, 3e38, 0.0, -5.0, 1e-30])
def test_a_pressure_that_is_none_is_no_measurement(pressure):
    assert Altitude not in samples(mavlink.MAVLink_scaled_pressure_message(5, pressure, 0.0, 0))
    assert Altitude not in samples(highres(bits=0x200, abs_pressure=pressure))


@pytest.mark.parametrize("value", [math.inf, math.nan])
def test_infinity_is_no_measurement_of_anything(value):
    assert not samples(
        highres(bits=0x1FFF, xacc=value, diff_pressure=value, pressure_alt=value, abs_pressure=value),
        mavlink.MAVLink_attitude_message(5, value, 0, 0, 0, 0, 0),
        mavlink.MAVLink_attitude_quaternion_message(5, value, 0, 0, 0, 0, 0, 0),
        mavlink.MAVLink_vfr_hud_message(value, value, 0, 0, value, value),
    )


def test_a_compass_alone_has_a_heading_and_no_other_angle():
    found = samples(mavlink.MAVLink_attitude_message(5, math.nan, math.nan, 1.0, 0, 0, 0))[Attitude]
    assert found.psi[0] == 1.0
    assert math.isnan(found.phi[0]) and math.isnan(found.theta[0])


def test_when_the_better_message_falls_silent_the_lesser_is_used_again():
    sensors = Sensors(1, "0/1")
    samples(highres(zacc=-9.0), sensors=sensors)
    scaled = mavlink.MAVLink_scaled_imu_message(5, 0, 0, -1000, 0, 0, 0, 0, 0, 0)
    assert Imu not in samples(scaled, sensors=sensors)
    assert Imu in samples(scaled, sensors=sensors, later=PATIENCE + 1_000_000)


def test_a_repeated_fix_is_no_new_measurement():
    sensors = Sensors(1, "0/1")
    first = samples(gps(us=1), gps(us=1), gps(us=2), sensors=sensors, t=[1, 1, 2])[Gnss]
    assert first.t.tolist() == [1, 2]
    assert Gnss not in samples(gps(us=2), sensors=sensors, t=[3])


def vanes(alpha, beta, us=1000):
    return mavlink.MAVLink_aoa_ssa_message(us, alpha, beta)


def gps_input(fix=3, us=1000, flags=0, **more):
    fields = {
        "time_week_ms": 0, "time_week": 0, "fix_type": fix, "lat": 474000000, "lon": 85000000, "alt": 500.0,
        "hdop": 1.0, "vdop": 2.0, "vn": 1.0, "ve": 2.0, "vd": -3.0, "speed_accuracy": 0.05, "horiz_accuracy": 1.5,
        "vert_accuracy": 2.5, "satellites_visible": 9,
    }  # fmt: skip
    return mavlink.MAVLink_gps_input_message(us, 0, flags, *(fields | more).values())


def test_vanes_are_degrees_on_the_wire():
    flow = samples(vanes(5.0, -2.0))[FlowAngles]
    np.testing.assert_allclose([flow.alpha[0], flow.beta[0]], np.radians([5.0, -2.0]))


@pytest.mark.parametrize("value", [math.inf, -math.inf, math.nan, 90.5, -179.0])
def test_a_vane_that_points_nowhere_is_not_measured_and_leaves_the_other(value):
    flow = samples(vanes(value, 3.0))[FlowAngles]
    assert math.isnan(flow.alpha[0])
    assert flow.beta[0] == pytest.approx(math.radians(3))
    assert not samples(vanes(value, value))


def test_a_fix_with_its_vertical_velocity():
    fix = samples(gps_input())[Gnss]
    assert math.degrees(fix.latitude[0]) == pytest.approx(47.4)
    assert fix.altitude[0] == 500
    assert fix.velocity[0].tolist() == [1, 2, -3]
    np.testing.assert_allclose(fix.sigma[0], [1.5, 2.5, 0.05])
    assert fix.satellites[0] == 9


@pytest.mark.parametrize("reverse", [False, True])
def test_the_fix_with_vertical_velocity_goes_before_the_one_without(reverse):
    sensors = Sensors(1, "0/1")
    pair = [gps_input(us=200), gps(us=200)]
    samples(gps_input(us=100), sensors=sensors)
    found = samples(*(pair[::-1] if reverse else pair), sensors=sensors)[Gnss]
    assert found.velocity.tolist() == [[1, 2, -3]]


def test_what_the_flags_leave_out_is_not_measured():
    fix = samples(gps_input(flags=8 | 16 | 32 | 64 | 128))[Gnss]
    assert np.isnan(fix.velocity).all()
    assert fix.sigma[0].tolist() == [2.5, 5.0, 0.3]
    horizontal = samples(gps_input(flags=16))[Gnss]
    np.testing.assert_array_equal(horizontal.velocity[0], [1, 2, math.nan])
    assert Gnss not in samples(gps_input(flags=1)), "without a height it is no fix in three dimensions"


@pytest.mark.parametrize("bad", [{"fix": 2}, {"fix": 0}, {"fix": 9}, {"lat": 950000000}, {"alt": math.nan}])
def test_an_input_that_is_no_fix_is_no_measurement(bad):
    assert Gnss not in samples(gps_input(**bad))


def test_infinite_velocity_and_accuracy_are_not_believed():
    fix = samples(gps_input(vn=math.inf, vd=math.nan, speed_accuracy=math.inf, horiz_accuracy=-1.0, hdop=65535.0))[Gnss]
    np.testing.assert_array_equal(fix.velocity[0], [math.nan, 2, math.nan])
    np.testing.assert_allclose(fix.sigma[0], [2.5, 2.5, 0.3])
