"""ULog: the samples as pyulog reads them, at their own rates, and the defects of a log told."""

from __future__ import annotations

import os
import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimator.stage import estimate
from telemetry.messages import (
    AirData,
    Altitude,
    Attitude,
    ClockFit,
    Event,
    Gnss,
    Imu,
    LinkBytes,
    Mark,
    Progress,
    Sample,
    StatusText,
    Window,
)
from telemetry.sources import onboard
from telemetry.sources.ulog import UlogSource, walk
from tests.telemetry.wire import DATA

VTOL, SITL = DATA / "vtol_pyulog_sample_log_small.ulg", DATA / "sitl_pyulog_sample_px4_events.ulg"
needs_logs = pytest.mark.skipif(not (VTOL.exists() and SITL.exists()), reason=f"{VTOL} or {SITL} is not there")
TYPES = {"uint64_t": "Q", "int64_t": "q", "uint32_t": "I", "int32_t": "i", "uint8_t": "B", "float": "f", "double": "d"}
TOPICS = {
    "sensor_combined": "uint64_t timestamp;float[3] gyro_rad;float[3] accelerometer_m_s2;",
    "vehicle_imu": "uint64_t timestamp;uint64_t timestamp_sample;float[3] delta_angle;float[3] delta_velocity;"
    "uint32_t delta_angle_dt;uint32_t delta_velocity_dt;",
    "sensor_gyro": "uint64_t timestamp;uint64_t timestamp_sample;float x;float y;float z;",
    "sensor_accel": "uint64_t timestamp;uint64_t timestamp_sample;float x;float y;float z;",
    "vehicle_attitude": "uint64_t timestamp;float[4] q;",
    "vehicle_gps_position": "uint64_t timestamp;uint64_t time_utc_usec;int32_t lat;int32_t lon;int32_t alt;"
    "float s_variance_m_s;float eph;float epv;float vel_n_m_s;float vel_e_m_s;float vel_d_m_s;"
    "int32_t timestamp_time_relative;uint8_t fix_type;uint8_t vel_ned_valid;uint8_t satellites_used;",
    "sensor_gps": "uint64_t timestamp;uint64_t timestamp_sample;double latitude_deg;double longitude_deg;"
    "double altitude_msl_m;uint64_t time_utc_usec;float s_variance_m_s;float eph;float epv;float vel_n_m_s;"
    "float vel_e_m_s;float vel_d_m_s;int32_t timestamp_time_relative;uint8_t fix_type;uint8_t vel_ned_valid;"
    "uint8_t satellites_used;",
    "vehicle_air_data": "uint64_t timestamp;uint64_t timestamp_sample;float baro_alt_meter;float baro_pressure_pa;",
    "sensor_baro": "uint64_t timestamp;uint64_t timestamp_sample;float pressure;",
    "airspeed": "uint64_t timestamp;float indicated_airspeed_m_s;float true_airspeed_m_s;float confidence;",
}
UTC = 1_700_000_000_000_000  # us


class Log:
    """Writes a ULog, message by message."""

    def __init__(self, *names: str) -> None:
        self.data = bytes.fromhex("554c6f6701123501") + struct.pack("<Q", 1_000_000)
        self.say("B", bytes(40))
        for name in names or TOPICS:
            self.say("F", f"{name}:{TOPICS[name]}".encode())
        self._numbers: dict[tuple[str, int], int] = {}

    def say(self, kind: str, body: bytes) -> None:
        self.data += struct.pack("<HB", len(body), ord(kind)) + body

    def add(self, name: str, us: int, *values: float, instance: int = 0) -> None:
        if (name, instance) not in self._numbers:
            self._numbers[name, instance] = len(self._numbers)
            self.say("A", struct.pack("<BH", instance, self._numbers[name, instance]) + name.encode())
        code = "<HQ"
        for field in TOPICS[name].split(";")[1:-1]:
            kind, _, count = field.split()[0].rstrip("]").partition("[")
            code += (count or "1") + TYPES[kind]
        self.say("D", struct.pack(code, self._numbers[name, instance], us, *values))

    def text(self, us: int, words: str, level: int = 6) -> None:
        self.say("L", struct.pack("<BQ", ord("0") + level, us) + words.encode())

    def fix(self, us: int, *, kind: int = 3, utc: int | None = None, valid: int = 1) -> None:
        utc = UTC + us - 100_000 if utc is None else utc
        velocity = 10.0, 5.0, -1.0
        place = 470_000_000, 85_000_000, 450_000
        self.add("vehicle_gps_position", us, utc, *place, 0.3, 1.5, 2.5, *velocity, -100_000, kind, valid, 12)


def flight(seconds: float = 12.0) -> Log:
    log = Log()
    log.text(1_500_000, "[commander] Takeoff detected")
    for k in range(int(200 * seconds)):
        us = 2_000_000 + 5000 * k
        log.add("sensor_combined", us, 0.1, 0.2, 0.3, 1.0, 2.0, -9.8)
        if k % 40 == 0:
            log.fix(us + 100)
            log.add("vehicle_attitude", us, np.cos(0.1), np.sin(0.1), 0.0, 0.0)
            log.add("vehicle_air_data", us + 3000, us - 500, 0.0, 95_000.0 - k)
            log.add("airspeed", us, -2.0 + k, 0.0, 1.0)
    return log


@pytest.fixture
def source(tmp_path):
    def make(log: Log | bytes, **options):
        path = tmp_path / "flight.ulg"
        path.write_bytes(log if isinstance(log, bytes) else log.data)
        return UlogSource(path, **options)

    return make


def together(messages, kind: type[Sample], source: str = "log/1") -> dict[str, np.ndarray]:
    mine = [m for m in messages if isinstance(m, kind) and m.source == source]
    return {
        name: np.concatenate([getattr(m, name) for m in mine])
        for name in kind.__struct_fields__
        if mine and isinstance(getattr(mine[0], name), np.ndarray)
    }


def told(messages) -> list[str]:
    return [text for m in messages if isinstance(m, Event) for text in m.text]


# -- real logs --


def dataset(path, name: str, instance: int = 0) -> dict[str, np.ndarray]:
    from pyulog import ULog

    return ULog(str(path)).get_dataset(name, instance).data


@needs_logs
@pytest.mark.parametrize(("path", "rate"), [(VTOL, 205), (SITL, 250)])
def test_inertial_samples_are_what_pyulog_reads_at_their_own_rate(path, rate):
    log = UlogSource(path)
    imu, data = together(log.messages(), Imu), dataset(path, "sensor_combined")
    for i in range(3):
        assert np.array_equal(imu["angular_rate"][:, i], data[f"gyro_rad[{i}]"])
        assert np.array_equal(imu["specific_force"][:, i], data[f"accelerometer_m_s2[{i}]"])
    assert np.array_equal(imu["t"] - log.boots[0].offset, data["timestamp"].astype(np.int64) * 1000)
    assert round(1e9 / np.median(np.diff(imu["t"]))) == rate


@needs_logs
def test_the_other_samples_of_the_vtol_log_are_what_pyulog_reads():
    log = UlogSource(VTOL)
    messages = list(log.messages())
    fix, data = together(messages, Gnss), dataset(VTOL, "vehicle_gps_position")
    assert np.allclose(np.rad2deg(fix["latitude"]), data["lat"] * 1e-7, rtol=0, atol=1e-12)
    assert np.allclose(np.rad2deg(fix["longitude"]), data["lon"] * 1e-7, rtol=0, atol=1e-12)
    assert np.array_equal(fix["altitude"], data["alt"] / 1000)
    assert np.array_equal(fix["velocity"], np.stack([data[f"vel_{a}_m_s"] for a in "ned"], axis=1))
    assert np.array_equal(fix["sigma"], np.stack([data[n] for n in ("eph", "epv", "s_variance_m_s")], axis=1))
    assert np.array_equal(fix["satellites"], data["satellites_used"])
    utc = data["time_utc_usec"].astype(np.int64) * 1000
    assert fix["t"][0] == utc[0]
    assert np.abs(fix["t"] - utc).max() < 50_000_000  # the receiver's own jitter
    air = together(messages, AirData)
    assert np.array_equal(air["airspeed"], dataset(VTOL, "airspeed")["indicated_airspeed_m_s"])
    assert air["airspeed"].max() < 0
    altimeter = together(messages, Altitude)
    data = dataset(VTOL, "vehicle_air_data")
    assert np.array_equal(altimeter["pressure"], data["baro_pressure_pa"])
    assert np.array_equal(altimeter["t"] - log.boots[0].offset, data["timestamp_sample"].astype(np.int64) * 1000)
    assert np.allclose(together(messages, Altitude, "log/1.2")["pressure"][0], 100_270.0)  # in hPa in this version
    attitude, data = together(messages, Attitude), dataset(VTOL, "vehicle_attitude")
    w, x, y, z = (data[f"q[{i}]"].astype(float) for i in range(4))
    assert np.allclose(np.tan(attitude["psi"]), 2 * (w * z + x * y) / (1 - 2 * (y * y + z * z)))
    assert np.allclose(np.sin(attitude["theta"]), 2 * (w * y - z * x))


@needs_logs
def test_several_imus_are_several_streams_and_the_selected_one_is_chosen():
    messages = list(UlogSource(VTOL).messages())
    chosen = {m.source: m.chosen for m in messages if isinstance(m, Imu)}
    assert chosen == {"log/1": True, "log/1.1": False, "log/1.2": False, "log/1.3": False}
    data = dataset(VTOL, "vehicle_imu", 1)
    expected = data["delta_velocity[2]"].astype(float) / (data["delta_velocity_dt"] * 1e-6)
    assert np.allclose(together(messages, Imu, "log/1.2")["specific_force"][:, 2], expected)


@needs_logs
def test_the_dropout_and_the_hole_of_the_vtol_log_are_told():
    texts = told(UlogSource(VTOL).messages())
    assert "0.16 s hole in the log at 20.33 s since boot: no imu sample" in texts
    assert any(text.startswith("the logger dropped out for 30 ms about 20.3 s since boot") for text in texts)
    assert "imu from sensor_combined, 205 Hz; also vehicle_imu, vehicle_imu[1], vehicle_imu[2]" in texts


@needs_logs
def test_new_names_of_columns_are_known_and_fixes_below_three_dimensions_left_out():
    log = UlogSource(SITL)
    messages = list(log.messages())
    fix, data = together(messages, Gnss), dataset(SITL, "vehicle_gps_position")
    solid = data["fix_type"] >= 3
    assert np.allclose(np.rad2deg(fix["latitude"]), data["latitude_deg"][solid], rtol=0, atol=1e-12)
    assert np.array_equal(fix["altitude"], data["altitude_msl_m"][solid])
    assert 0 < solid.sum() < len(solid)
    assert f"vehicle_gps_position: no three-dimensional fix: {(~solid).sum()} samples left out" in told(messages)
    words = [text for m in messages if isinstance(m, StatusText) for text in m.text]
    assert "[commander] Ready for takeoff!" in words  # without its colour
    severity = [s for m in messages if isinstance(m, StatusText) for s in m.severity.tolist()]
    assert severity[words.index("[health_and_arming_checks] Preflight: GPS fix too low")] == 4


@needs_logs
def test_every_byte_of_the_logs_is_accounted_for():
    for path in (VTOL, SITL):
        found = walk(path.read_bytes())
        assert (found.discarded, found.truncated) == (0, 0)
    assert [d.duration for d in walk(VTOL.read_bytes()).dropouts] == [30]


@needs_logs
def test_the_estimator_flies_the_log():
    models = {m.model for m in estimate(UlogSource(SITL).messages(), scope="sortie") if isinstance(m, Window)}
    assert models == {"trajectory", "flight_path"}


@needs_logs
def test_the_estimate_does_not_depend_on_the_blocks_in_which_a_log_is_told(monkeypatch):
    def windows() -> list[Window]:
        return [m for m in estimate(UlogSource(SITL).messages(), scope="sortie") if isinstance(m, Window)]

    expected = windows()
    monkeypatch.setattr(onboard, "BLOCK", 700_000_000)
    found = windows()
    assert len(found) == len(expected)
    for one, other in zip(found, expected, strict=True):
        assert np.array_equal(one.mean, other.mean) and np.array_equal(one.std, other.std)


# -- samples --


def test_samples_are_in_si_units_and_dated_when_they_were_taken(source):
    log = source(flight())
    messages = list(log.messages())
    imu, fix, altimeter, attitude, air = (together(messages, k) for k in (Imu, Gnss, Altitude, Attitude, AirData))
    assert np.allclose(imu["specific_force"], [1.0, 2.0, -9.8])
    assert np.allclose(fix["velocity"], [10.0, 5.0, -1.0])
    assert np.allclose([fix["latitude"][0], fix["altitude"][0]], [np.deg2rad(47.0), 450.0])
    assert np.allclose(attitude["phi"], 0.2)
    assert np.allclose(air["airspeed"][:2], [-2.0, 38.0])
    assert altimeter["t"][1] - imu["t"][40] == -500_000
    assert np.allclose(altimeter["altitude"][0], 540.3, atol=0.1)
    # UTC was true 0.1 s before the fix was published, and the boot clock showed 2.0001 s then
    assert log.boots[0].offset == (UTC - 100_000) * 1000 + 100_000_000
    assert imu["t"][0] == log.boots[0].offset + 2_000_000_000


def test_raw_sensors_are_joined_by_the_nearest_times_and_nothing_is_interpolated(source):
    log = Log("sensor_gyro", "sensor_accel")
    for k in range(400):
        for instance in range(2):
            log.add("sensor_gyro", 2_000_000 + 5000 * k, 0, 0.01 * k, 0.0, 0.0, instance=instance)
            if k % 50:
                log.add("sensor_accel", 2_000_700 + 5000 * k, 0, float(k), 0.0, -9.8, instance=instance)
    messages = list(source(log).messages())
    for name in ("log/1", "log/1.1"):
        imu = together(messages, Imu, name)
        assert np.allclose(imu["specific_force"][:, 0], imu["angular_rate"][:, 0] / 0.01)
        assert len(imu["t"]) == 392
    assert "sensor_gyro: no sample of sensor_accel beside it: 8 samples left out" in told(messages)
    assert any("neither calibrated nor turned into the body" in text for text in told(messages))


def test_means_over_increments_are_taken_over_their_own_intervals(source):
    log = Log("vehicle_imu")
    for k in range(100):
        log.add("vehicle_imu", 2_000_000 + 5000 * k, 0, 0.001, 0.0, 0.0, 0.0, 0.0, -0.0392, 5000, 4000)
    imu = together(source(log).messages(), Imu)
    assert np.allclose(imu["angular_rate"][0], [0.2, 0.0, 0.0])
    assert np.allclose(imu["specific_force"][0], [0.0, 0.0, -9.8])


def test_what_was_not_measured_is_left_out_and_counted(source):
    log = flight(2.0)
    now = 4_000_000
    log.fix(now, kind=2)
    log.fix(now + 200_000, valid=0)
    log.fix(now + 400_000, utc=UTC + now + 100_000)  # the fix before, again
    log.add("airspeed", now, 30.0, 30.0, 0.0)
    log.add("vehicle_attitude", now, 0.0, 0.0, 0.0, 0.0)
    log.add("vehicle_air_data", now, now, 0.0, 0.0)
    log.add("sensor_combined", now, np.nan, 0.0, 0.0, 0.0, 0.0, 0.0)
    log.add("sensor_combined", 0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    messages = list(source(log).messages())
    fix = together(messages, Gnss)
    assert len(fix["t"]) == 11
    assert np.isnan(fix["velocity"][-1]).all()
    assert [len(together(messages, k)["t"]) for k in (Imu, AirData, Attitude, Altitude)] == [400, 10, 10, 10]
    for text in (
        "vehicle_gps_position: no three-dimensional fix: 1 samples left out",
        "vehicle_gps_position: the same fix again: 1 samples left out",
        "airspeed: not trusted by the autopilot: 1 samples left out",
        "vehicle_attitude: no rotation: 1 samples left out",
        "vehicle_air_data: no pressure of the atmosphere: 1 samples left out",
        "sensor_combined: not a number: 1 samples left out",
        "sensor_combined: its time is damaged or 0: 1 samples left out",
    ):
        assert text in told(messages)


def test_where_the_first_source_falls_silent_the_next_one_is_used(source):
    log = flight(4.0)
    for k in range(200):
        log.add("sensor_baro", 2_000_000 + 100_000 * k, 0, 95_000.0)
    for k in range(3000):
        log.add("sensor_combined", 6_000_000 + 5000 * k, 0.1, 0.2, 0.3, 1.0, 2.0, -9.8)
    messages = list(source(log).messages())
    assert any("altitude: vehicle_air_data has been silent for" in text for text in told(messages))
    chosen = [m for m in messages if isinstance(m, Altitude) and m.chosen]
    assert [m.source for m in chosen][:1] == ["log/1"] and chosen[-1].source == "log/1.1"


# -- time, words, order --


def test_the_clock_fit_finds_how_fast_the_vehicles_clock_runs(source):
    log = Log("vehicle_gps_position", "sensor_combined")
    for k in range(1000):
        us = 2_000_000 + 200_000 * k
        log.fix(us, utc=UTC + round(us * (1 - 30e-6)))
    (fit,) = [m for m in source(log).messages() if isinstance(m, ClockFit)]
    assert abs(fit.rate[0] + 30e-6) < 1e-7
    assert fit.valid[0] == 1


def test_without_a_fix_the_time_of_the_file_is_that_of_the_last_sample(source, tmp_path):
    log = Log("sensor_combined")
    for k in range(100):
        log.add("sensor_combined", 2_000_000 + 5000 * k, 0.1, 0.2, 0.3, 1.0, 2.0, -9.8)
    source(log)
    os.utime(tmp_path / "flight.ulg", ns=(1_700_000_000_000_000_000,) * 2)
    messages = list(UlogSource(tmp_path / "flight.ulg").messages())
    assert together(messages, Imu)["t"][-1] == 1_700_000_000_000_000_000
    assert any("the time of the file" in text for text in told(messages))


def test_test_points_are_marked_in_logged_texts(source):
    log = flight(6.0)
    log.text(3_000_000, "[mavlink] TP 3 start\t")
    log.text(5_000_000, "TP 3 stop")
    marks = [m for m in source(log).messages() if isinstance(m, Mark)]
    assert [(a, n) for m in marks for a, n in zip(m.action, m.name, strict=True)] == [("start", "3"), ("stop", "3")]


def test_progress_covers_what_has_been_told_and_nothing_that_is_to_come(source):
    reached, final = 0, []
    for message in source(flight(20.0)).messages():
        if isinstance(message, Sample):
            assert message.t_rx.min() > reached
        if isinstance(message, Progress):
            assert message.t_rx[-1] >= reached
            reached = int(message.t_rx[-1])
            final.append(message.final)
    assert final[-1] and not any(final[:-1]) and len(final) >= 5


# -- damage --


def test_a_cut_log_is_read_to_its_last_whole_message(source):
    data = flight(2.0).data
    whole = together(source(data).messages(), Imu)
    for gone in (1, 2, 3, 17, 40, 1000, 9999):
        cut = source(data[:-gone])
        messages = list(cut.messages())
        imu = together(messages, Imu)
        assert np.array_equal(imu["t"], whole["t"][: len(imu["t"])])
        assert len(whole["t"]) - len(imu["t"]) <= gone // 37 + 1
        assert cut.discarded == 0
        assert bool(cut.truncated) == any("ends inside a message" in text for text in told(messages))
        account = [m for m in messages if isinstance(m, LinkBytes)][-1]
        assert account.bytes[0] == len(data) - gone
    assert source(data[:-1]).truncated > 0


def test_a_log_cut_in_its_head_or_definitions_is_refused_with_its_name(source):
    data = flight(1.0).data
    for size in (*range(20), 100, 500, 1500):
        with pytest.raises(ValueError, match=r"flight\.ulg"):
            source(data[:size])


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.tuples(st.integers(0, 40_000), st.integers(0, 255)), max_size=20),
    st.integers(0, 40_000),
    st.integers(0, 300),
)
def test_whatever_the_damage_a_log_is_read_or_refused_with_its_name(tmp_path_factory, changes, at, gone):
    data = bytearray(flight(1.0).data)
    for place, value in changes:
        data[place % len(data)] = value
    at %= len(data)
    data = bytes(data[:at] + data[at + gone :])
    path = tmp_path_factory.getbasetemp() / "fuzzed.ulg"
    path.write_bytes(data)
    try:
        source = UlogSource(path)
    except ValueError as error:
        assert "fuzzed.ulg" in str(error)
        return
    messages = list(source.messages())
    assert messages[-1].final
    account = [m for m in messages if isinstance(m, LinkBytes)][-1]
    assert account.bytes[0] == len(data)
    assert account.discarded[0] + account.pending[0] + 16 + 4 * account.frames[0] <= len(data)


@pytest.mark.parametrize(
    "formats",
    [
        ["sensor_combined:uint64_t timestamp;sensor_combined again;"],
        ["a:float[60000] x;", "sensor_combined:uint64_t timestamp;a[60000] y;"],
        ["a:b x;", "b:a x;", "sensor_combined:uint64_t timestamp;a y;"],
    ],
)
def test_definitions_that_would_exhaust_memory_are_refused(source, formats):
    log = Log("airspeed")
    for form in formats:
        log.say("F", form.encode())
    log.say("A", struct.pack("<BH", 0, 9) + b"sensor_combined")
    with pytest.raises(ValueError, match=r"flight\.ulg cannot be read.*(claims|contains itself)"):
        source(log)


def test_a_reader_that_goes_round_in_circles_is_stopped(source):
    header = Log("airspeed").data
    with pytest.raises(ValueError, match=r"flight\.ulg"):
        source(header + struct.pack("<HB", 10_500, 0) + b"short")


def test_what_is_no_log_or_holds_nothing_is_refused_with_its_name_and_a_way_out(source):
    for content, why in (
        (b"", "nothing was recorded"),
        (b"time,latitude\n" * 9, "no PX4 log"),
        (Log("airspeed").data, "holds no sample"),
    ):
        with pytest.raises(ValueError, match=f"flight.ulg.*{why}"):
            source(content)
