"""Units, frames and traps of every message that feeds a sensor."""

from __future__ import annotations

import math

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from telemetry.mavlink import Dialect
from telemetry.messages import SENSORS, AirData, Altitude, Attitude, Event, FlowAngles, Gnss, Imu
from telemetry.sensors import Sensors, SensorSettings, calibrated_airspeed, pressure_altitude
from tests.telemetry.test_frames import scan
from tests.telemetry.wire import Sender

DIALECT = Dialect()
MS = 1_000_000
STANDARD_GRAVITY = 9.80665


class Vehicle:
    """A vehicle that is heard frame by frame; samples and events are kept."""

    def __init__(self, dialect=DIALECT, **settings):
        self.dialect = dialect
        self.sensors = Sensors(1, SensorSettings(**settings), dialect)
        self.now = 0
        self.senders = {}
        self.said = []

    def hear(self, *messages, component=1, later=0, boot=0, t_sigma=None):
        """Messages of one component that arrive in one batch, a millisecond apart; return what they bring."""
        return self.hear_all([(m, component) for m in messages], later=later, boot=boot, t_sigma=t_sigma)

    def hear_all(self, spoken, *, later=0, boot=0, t_sigma=None):
        """Messages and their components in one batch."""
        self.now += later
        senders = [self.senders.setdefault(component, Sender(1, component)) for _, component in spoken]
        frames = scan(*[s.pack(m) for s, (m, _) in zip(senders, spoken, strict=True)])
        t = self.now + MS * np.arange(1, len(frames) + 1)
        self.now = int(t[-1])
        keys = list(zip(frames.compid.tolist(), frames.msgid.tolist(), strict=True))
        decoded = {}
        for key in sorted(set(keys)):
            rows = np.array([i for i, k in enumerate(keys) if k == key])
            if key[1] in self.sensors.msgids:
                decoded[key] = rows, self.dialect.decode(frames, key[1], rows)
        sources = {component: f"0/{component}" for _, component in spoken}
        sigma = None if t_sigma is None else np.array(t_sigma)
        self.said += (found := self.sensors.samples(decoded, sources, t, t, sigma, boot))
        return found

    @property
    def events(self):
        return [m.text[0] for m in self.said if isinstance(m, Event)]


def samples(*messages, vehicle=None, **how):
    """What a batch of messages measures, by kind, where one stream is used."""
    found = (vehicle or Vehicle()).hear(*messages, **how)
    return {type(m): m for m in found if isinstance(m, SENSORS) and m.chosen}


def highres(bits=0xFFFF, us=1000, id=0, **values):
    fields = {
        "xacc": 0.0, "yacc": 0.0, "zacc": -9.8, "xgyro": 0.0, "ygyro": 0.0, "zgyro": 0.0, "xmag": 0.0, "ymag": 0.0,
        "zmag": 0.0, "abs_pressure": 0.0, "diff_pressure": 0.0, "pressure_alt": 0.0, "temperature": 0.0,
    }  # fmt: skip
    return mavlink.MAVLink_highres_imu_message(us, *(fields | values).values(), bits, id)


def scaled(ms=5, acc=(0, 0, -1000), gyro=(0, 0, 0), number=1):
    kind = {
        1: mavlink.MAVLink_scaled_imu_message, 2: mavlink.MAVLink_scaled_imu2_message,
        3: mavlink.MAVLink_scaled_imu3_message,
    }[number]  # fmt: skip
    return kind(ms, *acc, *gyro, 0, 0, 0)


def raw(us, acc=(0, 0, -1000), gyro=(0, 0, 0)):
    return mavlink.MAVLink_raw_imu_message(us, *acc, *gyro, 0, 0, 0)


def hil_sensor(bits=0x1FFF, us=1000, **values):
    fields = {
        "xacc": 0.0, "yacc": 0.0, "zacc": -9.8, "xgyro": 0.1, "ygyro": 0.0, "zgyro": 0.0, "xmag": 0.0, "ymag": 0.0,
        "zmag": 0.0, "abs_pressure": 900.0, "diff_pressure": 2.0, "pressure_alt": 990.0, "temperature": 0.0,
    }  # fmt: skip
    return mavlink.MAVLink_hil_sensor_message(us, *(fields | values).values(), bits)


def pressure(ms=5, hpa=900.0, diff=0.0, number=1):
    kind = {
        1: mavlink.MAVLink_scaled_pressure_message, 2: mavlink.MAVLink_scaled_pressure2_message,
        3: mavlink.MAVLink_scaled_pressure3_message,
    }[number]  # fmt: skip
    return kind(ms, hpa, diff, 0)


def hud(airspeed, groundspeed, alt=0.0):
    return mavlink.MAVLink_vfr_hud_message(airspeed, groundspeed, 0, 0, alt, 0.0)


def airspeed(value, hpa=1.0, flags=0, id=0):
    return mavlink.MAVLink_airspeed_message(id, value, 0, hpa, flags)


def gps(fix=3, us=1000, lat=474000000, lon=85000000, alt=500000, eph=100, epv=65535, vel=1000, cog=9000, sat=9, **more):
    return mavlink.MAVLink_gps_raw_int_message(us, fix, lat, lon, alt, eph, epv, vel, cog, sat, **more)


def gps_input(fix=3, us=1000, flags=0, gps_id=0, **more):
    fields = {
        "time_week_ms": 0, "time_week": 0, "fix_type": fix, "lat": 474000000, "lon": 85000000, "alt": 500.0,
        "hdop": 1.0, "vdop": 2.0, "vn": 1.0, "ve": 2.0, "vd": -3.0, "speed_accuracy": 0.05, "horiz_accuracy": 1.5,
        "vert_accuracy": 2.5, "satellites_visible": 9,
    }  # fmt: skip
    return mavlink.MAVLink_gps_input_message(us, gps_id, flags, *(fields | more).values())


def vanes(alpha, beta, us=1000):
    return mavlink.MAVLink_aoa_ssa_message(us, alpha, beta)


def heartbeat(autopilot=mavlink.MAV_AUTOPILOT_GENERIC):
    return mavlink.MAVLink_heartbeat_message(1, autopilot, 0, 0, 4, 3)


def test_pressure_altitude_of_the_standard_atmosphere():
    np.testing.assert_allclose(pressure_altitude(np.array([101325.0, 89874.6, 54019.9])), [0, 1000, 5000], atol=0.6)


def test_calibrated_airspeed_of_known_points():
    """100 kt is 1628.9 Pa (incompressible 1621); 250 kt is 10,484 Pa: tables of impact pressure."""
    np.testing.assert_allclose(calibrated_airspeed(np.array([1630.5, 10484.0])), [51.444, 128.61], rtol=2e-3)
    assert math.isnan(calibrated_airspeed(np.array([1e5]))[0]), "beyond the speed of sound the formula does not hold"


def test_milli_g_become_specific_force():
    imu = samples(scaled(gyro=(100, 0, -200)))[Imu]
    np.testing.assert_allclose(imu.specific_force, [[0, 0, -STANDARD_GRAVITY]])
    np.testing.assert_allclose(imu.angular_rate, [[0.1, 0, -0.2]])


@pytest.mark.parametrize("bad", [{"acc": (32767, 0, 0)}, {"gyro": (0, -32768, 0)}])
def test_a_value_at_the_end_of_its_range_is_no_measurement(bad):
    assert Imu not in samples(scaled(**bad))


@pytest.mark.parametrize("message", [scaled(acc=(0, 0, 0)), highres(zacc=0.0)])
def test_six_zeros_are_a_sensor_that_is_not_there(message):
    assert Imu not in samples(message)


def test_raw_counts_are_no_units():
    """At 2048 counts per g rest weighs 2048, not 1000."""
    vehicle = Vehicle()
    vehicle.hear(*[raw(100 * i, acc=(0, 0, -2048)) for i in range(1, 50)])
    assert not any(isinstance(m, Imu) for m in vehicle.said)
    assert any("it may be raw counts" in text for text in vehicle.events)


@pytest.mark.parametrize("cut", range(1, 15))
def test_raw_imu_is_believed_after_ten_plausible_rows_running(cut):
    vehicle = Vehicle()
    weights = [1000, 1000, 1000, 4000, *[1010] * 12]
    sent = [raw(100 * i + 100, acc=(0, 0, -weight)) for i, weight in enumerate(weights)]
    vehicle.hear(*sent[:cut])
    vehicle.hear(*sent[cut:])
    assert sum(len(m.t) for m in vehicle.said if isinstance(m, Imu)) == 3, "the tenth, eleventh and twelfth"


def test_the_sensors_of_a_simulator():
    found = samples(hil_sensor())
    np.testing.assert_allclose(found[Imu].angular_rate, [[0.1, 0, 0]])
    assert found[Altitude].pressure[0] == pytest.approx(90000)
    assert found[Altitude].altitude[0] == 990
    assert found[AirData].differential_pressure[0] == pytest.approx(200)
    assert not samples(hil_sensor(bits=0)), "no bit is set, no field is new"


def test_a_field_that_was_not_updated_is_no_measurement():
    assert samples(highres(bits=0x3F)).keys() == {Imu}
    only = samples(highres(bits=0x800, pressure_alt=123.0))
    assert only.keys() == {Altitude}
    assert only[Altitude].altitude.tolist() == [123.0]
    assert math.isnan(only[Altitude].pressure[0])


def test_static_pressure_is_hectopascal_on_the_wire():
    found = samples(pressure(hpa=1013.25))[Altitude]
    assert found.pressure[0] == pytest.approx(101325)
    assert found.altitude[0] == pytest.approx(0, abs=0.1)
    assert found.sigma[0] == 1.0
    assert not samples(pressure(hpa=0.0))


def test_negative_differential_pressure_keeps_its_sign():
    flown = [pressure(ms=i, diff=1.0) for i in range(1, 6)]
    vehicle = Vehicle()
    found = [samples(highres(bits=0x400, diff_pressure=-0.5))[AirData]]
    found += [m for m in vehicle.hear(*flown, pressure(ms=6, diff=-0.5)) if isinstance(m, AirData)]
    for air in found:
        assert air.differential_pressure[-1] == -50
        assert air.airspeed[-1] == pytest.approx(-math.sqrt(2 * 50 / 1.225), rel=1e-3)  # incompressible


def test_a_differential_pressure_that_no_flight_has_made_is_no_airspeed_system():
    vehicle = Vehicle()
    drift = [0, 0, 0.25, -0.2, 0.05, 1.0, 1.0, 1.0, 1.0, 0.1]  # an open port drifts, a gust is no flight
    found = vehicle.hear(*[pressure(ms=i, diff=d) for i, d in enumerate(drift, 1)])
    assert not [m for m in found if isinstance(m, AirData)]
    flown = vehicle.hear(*[pressure(ms=i, diff=d) for i, d in enumerate([1.0, 1.0, 1.0, 1.0, 1.0, 0.0], 20)])
    (air,) = [m for m in flown if isinstance(m, AirData)]
    assert air.differential_pressure[-1] == 0, "once it has flown, zero is a pressure"
    assert not [m for m in Vehicle().hear(highres(bits=0x400), highres(bits=0x400, us=2)) if isinstance(m, AirData)]


def test_an_airspeed_sensor_tells_speed_and_pressure_and_its_health():
    air = samples(airspeed(20.0, hpa=2.5))[AirData]
    assert air.airspeed[0] == 20
    assert air.differential_pressure[0] == 250
    assert not samples(airspeed(20.0, flags=1))
    assert not samples(airspeed(0.0, hpa=0.0))
    assert math.isnan(samples(airspeed(20.0, hpa=math.nan))[AirData].differential_pressure[0])


def test_an_airspeed_that_copies_the_groundspeed_is_none():
    vehicle = Vehicle()
    vehicle.hear(*[hud(v, v) for v in np.linspace(0.1, 30, 300).tolist()])
    assert not any(isinstance(m, AirData) for m in vehicle.said)
    assert [text for text in vehicle.events if "airspeed" in text] == [
        "air_data: VFR_HUD of component 1 is not used where its airspeed has not yet differed from its groundspeed by"
        " 0.1 m/s in 5 rows running (a copy has no sensor)"
    ]


def test_an_airspeed_that_differs_from_the_groundspeed_is_believed_from_then_on():
    vehicle = Vehicle()
    vehicle.hear(*[hud(v, v) for v in (10.0, 11.0)], *[hud(v, 14.0) for v in (12.0, 12.5, 13.0, 15.0)])
    assert not any(isinstance(m, AirData) for m in vehicle.said), "five rows running"
    assert samples(hud(12.5, 14.0), hud(14.0, 14.0), vehicle=vehicle)[AirData].airspeed.tolist() == [12.5, 14.0]


def test_what_was_believed_before_a_reboot_must_be_shown_again():
    vehicle = Vehicle()
    assert AirData in samples(*[hud(12.0, 15.0)] * 5, vehicle=vehicle)
    assert AirData not in samples(hud(12.0, 12.0), vehicle=vehicle, boot=1)


def test_an_airspeed_of_exactly_zero_is_none():
    assert len(samples(*[hud(v, 5.0) for v in (1.0, 2.0, 1.0, 2.0, 1.0, 0.0, 3.0)])[AirData].t) == 2


def test_attitude_from_angles_and_from_a_quaternion_agree():
    angles = samples(mavlink.MAVLink_attitude_message(5, 0.3, -0.2, 1.0, 0, 0, 0))[Attitude]
    turned = samples(mavlink.MAVLink_attitude_quaternion_message(5, *quaternion(0.3, -0.2, 1.0), 0, 0, 0))[Attitude]
    for name in ("phi", "theta", "psi"):
        np.testing.assert_allclose(getattr(turned, name), getattr(angles, name), atol=1e-6)


def quaternion(phi, theta, psi):
    cr, sr, cp, sp, cy, sy = (f(a / 2) for a in (phi, theta, psi) for f in (math.cos, math.sin))
    return (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )


def test_what_turns_a_tail_sitters_display_does_not_turn_its_sensors():
    plain, shown = (
        samples(mavlink.MAVLink_attitude_quaternion_message(5, *quaternion(0.3, -0.2, 1.0), 0, 0, 0, repr_offset_q=q))
        for q in ([1, 0, 0, 0], [0.7071, 0, 0.7071, 0])
    )
    assert plain[Attitude].theta.tolist() == shown[Attitude].theta.tolist()


def test_a_quaternion_that_is_not_quite_of_length_one_is_still_a_rotation():
    q = [1.1 * x for x in quaternion(0.3, -0.2, 1.0)]
    found = samples(mavlink.MAVLink_attitude_quaternion_message(5, *q, 0, 0, 0))[Attitude]
    np.testing.assert_allclose([found.phi[0], found.theta[0], found.psi[0]], [0.3, -0.2, 1.0], atol=1e-6)


def test_a_fix_in_si_units_with_what_the_receiver_knows_of_its_accuracy():
    fix = samples(gps(h_acc=1500, v_acc=2500, vel_acc=200))[Gnss]
    assert math.degrees(fix.latitude[0]) == pytest.approx(47.4)
    assert math.degrees(fix.longitude[0]) == pytest.approx(8.5)
    assert fix.altitude[0] == 500
    np.testing.assert_allclose(fix.velocity[0], [0, 10, math.nan], atol=1e-12)
    assert fix.sigma[0].tolist() == [1.5, 2.5, 0.2]
    assert fix.satellites[0] == 9


def test_what_the_receiver_does_not_know_is_not_zero():
    fix = samples(gps(vel=65535, cog=65535, sat=255, eph=65535, h_acc=0xFFFFFFFF))[Gnss]
    assert np.isnan(fix.velocity).all()
    assert fix.satellites[0] == -1
    assert (fix.sigma > 0.1).all() and (fix.sigma < 10).all()


@pytest.mark.parametrize("bad", [{"fix": 2}, {"fix": 0}, {"lat": 950000000}, {"lat": 0, "lon": 0}, {"alt": 0}])
def test_a_fix_that_is_none_is_no_measurement(bad):
    assert not samples(gps(**bad))


def test_a_fix_at_sea_level_has_an_accuracy():
    assert samples(gps(alt=0, v_acc=1200))[Gnss].altitude[0] == 0


@pytest.mark.parametrize("value", [math.inf, -math.inf, math.nan, 3e38, 0.0, -5.0, 1e-30])
def test_a_pressure_that_is_none_is_no_measurement(value):
    assert Altitude not in samples(pressure(hpa=value))
    assert Altitude not in samples(highres(bits=0x200, abs_pressure=value))


@pytest.mark.parametrize("value", [math.inf, math.nan, 3e38])
def test_infinity_is_no_measurement_of_anything(value):
    bad = [
        hil_sensor(xacc=math.inf, diff_pressure=value, pressure_alt=value, abs_pressure=value),
        highres(bits=0x1FFF, xacc=math.nan, diff_pressure=value, pressure_alt=value, abs_pressure=value),
        pressure(hpa=value, diff=value),
        airspeed(value, hpa=value),
        mavlink.MAVLink_attitude_message(5, math.inf, 0, 0, 0, 0, 0),
        mavlink.MAVLink_attitude_quaternion_message(5, value, 0, 0, 0, 0, 0, 0),
        *[hud(value, value)] * 6,
        *[hud(value, 5.0)] * 6,
    ]
    assert not samples(*bad)


def test_a_compass_alone_has_a_heading_and_no_other_angle():
    found = samples(mavlink.MAVLink_attitude_message(5, math.nan, math.nan, 1.0, 0, 0, 0))[Attitude]
    assert found.psi[0] == 1.0
    assert math.isnan(found.phi[0]) and math.isnan(found.theta[0])


def test_a_repeated_fix_is_no_new_measurement():
    vehicle = Vehicle()
    first = vehicle.hear(gps(us=1), gps(us=1), gps(us=2))
    (fixes,) = [m for m in first if isinstance(m, Gnss)]
    assert fixes.t.tolist() == [1 * MS, 3 * MS]
    assert Gnss not in samples(gps(us=2), vehicle=vehicle)


@pytest.mark.parametrize(
    "again", [highres, scaled, pressure, vanes, gps, gps_input, hil_sensor], ids=lambda make: make.__name__
)
def test_whatever_repeats_the_time_before_it_is_held(again):
    make = (lambda: vanes(1.0, 2.0)) if again is vanes else again
    vehicle = Vehicle(flow_angles="AOA_SSA")
    assert samples(make(), vehicle=vehicle)
    assert not samples(make(), make(), vehicle=vehicle)
    (said,) = [text for text in vehicle.events if "repeats the time" in text]
    assert said.endswith("of component 1 is not used where it repeats the time before it (held values)")


def test_a_message_without_a_time_cannot_be_held():
    vehicle = Vehicle()
    assert sum(len(samples(gps(us=0), vehicle=vehicle)[Gnss].t) for _ in range(3)) == 3


def test_vanes_are_degrees_on_the_wire():
    flow = samples(heartbeat(), vanes(5.0, -2.0))[FlowAngles]
    np.testing.assert_allclose([flow.alpha[0], flow.beta[0]], np.radians([5.0, -2.0]))


@pytest.mark.parametrize("value", [math.inf, -math.inf, math.nan, 90.5, -179.0])
def test_a_vane_that_points_nowhere_is_not_measured_and_leaves_the_other(value):
    flow = samples(heartbeat(), vanes(value, 3.0))[FlowAngles]
    assert math.isnan(flow.alpha[0])
    assert flow.beta[0] == pytest.approx(math.radians(3))
    assert not samples(heartbeat(), vanes(value, value))


def test_angles_that_an_ardupilot_derives_from_its_filter_are_no_vanes():
    vehicle = Vehicle()
    vehicle.hear(vanes(5.0, -2.0), heartbeat(mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA), vanes(5.0, -2.0, us=2000))
    assert not any(isinstance(m, FlowAngles) for m in vehicle.said)
    assert any("AOA_SSA of component 1 is not used where an ArduPilot derives it" in text for text in vehicle.events)


def test_angles_of_another_component_are_those_of_a_vane():
    vehicle = Vehicle()
    vehicle.hear(heartbeat(mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA))
    flow = samples(vanes(5.0, -2.0), vehicle=vehicle, component=25)[FlowAngles]
    assert flow.source == "0/25"


def test_a_fix_with_its_vertical_velocity():
    fix = samples(gps_input())[Gnss]
    assert math.degrees(fix.latitude[0]) == pytest.approx(47.4)
    assert fix.altitude[0] == 500
    assert fix.velocity[0].tolist() == [1, 2, -3]
    np.testing.assert_allclose(fix.sigma[0], [1.5, 2.5, 0.05])
    assert fix.satellites[0] == 9


def test_a_simulators_receiver_has_a_vertical_velocity():
    message = mavlink.MAVLink_hil_gps_message(1, 3, 474000000, 85000000, 500000, 100, 200, 0, 100, -200, 300, 0, 9)
    fix = samples(message)[Gnss]
    np.testing.assert_allclose(fix.velocity[0], [1, -2, 3])
    assert fix.sigma[0].tolist() == [2.5, 5.0, 0.3]
    assert fix.altitude[0] == 500


@pytest.mark.parametrize("reverse", [False, True])
def test_the_fix_with_vertical_velocity_goes_before_the_one_without(reverse):
    vehicle = Vehicle()
    pair = [gps_input(us=200), gps(us=200)]
    vehicle.hear(gps_input(us=100))
    found = samples(*(pair[::-1] if reverse else pair), vehicle=vehicle)[Gnss]
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


def test_the_uncertainty_of_a_time_that_was_not_told_goes_with_the_sample():
    vehicle = Vehicle()
    found = vehicle.hear(gps(us=1), *[hud(12.0 + i, 3.0) for i in range(6)], t_sigma=[0.0, *[0.25] * 6])
    assert {type(m): None if m.t_sigma is None else m.t_sigma.tolist() for m in found if isinstance(m, SENSORS)} == {
        Gnss: None,
        AirData: [0.25, 0.25],
    }


def test_wind_and_the_output_of_filters_are_no_measurement():
    position = mavlink.MAVLink_global_position_int_message(5, 474000000, 85000000, 500000, 0, 1, 2, 3, 0)
    assert not samples(position, mavlink.MAVLink_wind_message(10.0, 5.0, 0.0), hud(12.0, 12.0, alt=500.0))


def test_how_much_was_not_used_is_told_again_and_at_the_end():
    vehicle = Vehicle()
    vehicle.hear(*[gps(fix=1, us=i) for i in range(1, 1201)])
    reason = "there is no fix in three dimensions"
    assert vehicle.events == [
        f"gnss: GPS_RAW_INT of component 1 is not used where {reason}",
        f"gnss: GPS_RAW_INT of component 1 is not used where {reason}: 1000 rows so far",
    ]
    assert [int(m.t[0]) for m in vehicle.said] == [1 * MS, 1000 * MS]
    (last,) = vehicle.sensors.finish(vehicle.now, vehicle.now, 0)
    assert last.text == [f"gnss: GPS_RAW_INT of component 1 was not used where {reason}: 1200 rows in all"]
