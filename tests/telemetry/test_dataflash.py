"""DataFlash logs: the bytes as pymavlink reads them, the samples as the sensors measured them, the defects told."""

from __future__ import annotations

import os
import struct
from collections import defaultdict

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from telemetry import dataflash
from telemetry.dataflash import Scanner, read
from telemetry.messages import (
    AirData,
    Altitude,
    Attitude,
    ClockFit,
    Event,
    FlowAngles,
    Gnss,
    Imu,
    LinkBytes,
    Mark,
    Progress,
    Sample,
    StatusText,
)
from telemetry.sources.dataflash import DataFlashSource
from telemetry.sources.kinds import kind
from tests.telemetry.wire import DATA

COPTER = DATA / "copter_dronekit_log171.bin"
needs_copter = pytest.mark.skipif(not COPTER.exists(), reason=f"{COPTER} is not there")
STRUCT = {
    "b": "b", "B": "B", "h": "h", "H": "H", "i": "i", "I": "I", "f": "f", "d": "d", "n": "4s", "N": "16s", "Z": "64s",
    "c": "h", "C": "H", "e": "i", "E": "I", "L": "i", "M": "B", "q": "q", "Q": "Q",
}  # fmt: skip
FORMATS = {
    "PARM": (129, "QNff", "TimeUS,Name,Value,Default"),
    "MSG": (130, "QZ", "TimeUS,Message"),
    "IMU": (131, "QBffffffIIfBBHH", "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ,EG,EA,T,GH,AH,GHz,AHz"),
    "GPS": (132, "QBBIHBcLLeffffB", "TimeUS,I,Status,GMS,GWk,NSats,HDop,Lat,Lng,Alt,Spd,GCrs,VZ,Yaw,U"),
    "GPA": (133, "QBCCCCfBIH", "TimeUS,I,VDop,HAcc,VAcc,SAcc,YAcc,VV,SMS,Delta"),
    "BARO": (134, "QBfffcfIffB", "TimeUS,I,Alt,AltAMSL,Press,Temp,CRt,SMS,Offset,GndTemp,H"),
    "ATT": (135, "QccccCCCCB", "TimeUS,DesRoll,Roll,DesPitch,Pitch,DesYaw,Yaw,ErrRP,ErrYaw,AEKF"),
    "ARSP": (136, "QBffcffBBfB", "TimeUS,I,Airspeed,DiffPress,Temp,RawPress,Offset,U,H,Hp,Pri"),
    "AOA": (137, "Qff", "TimeUS,AOA,SSA"),
    "MODE": (138, "QMBB", "TimeUS,Mode,ModeNum,Rsn"),
    "EV": (139, "QB", "TimeUS,Id"),
    "UNIT": (140, "QbZ", "TimeUS,Id,Label"),
    "FMTU": (141, "QBNN", "TimeUS,FmtType,UnitIds,MultIds"),
    "ACC": (142, "QBQfff", "TimeUS,I,SampleUS,AccX,AccY,AccZ"),
    "DSF": (144, "QIHIIII", "TimeUS,Dp,Blk,Bytes,FMn,FMx,FAv"),
    "GYR": (143, "QBQfff", "TimeUS,I,SampleUS,GyrX,GyrY,GyrZ"),
}
WEEK, MS = 2300, 345_600_000  # 2024-02-08 00:00:00 GPS
MIDNIGHT = 1_707_350_400 - 18  # UTC of that, s


class Log:
    """Writes a log, message by message."""

    def __init__(self, *names: str) -> None:
        self.data = b""
        self.sizes: list[int] = []
        for name in names or FORMATS:
            self.define(name)

    def define(self, name: str, form: str | None = None, columns: str | None = None) -> None:
        number, usual, labels = FORMATS[name]
        form, columns = form or usual, columns or labels
        size = 3 + struct.calcsize("<" + "".join(STRUCT[c] for c in form))
        self._add(
            struct.pack("<BBBBB4s16s64s", 0xA3, 0x95, 128, number, size, *(w.encode() for w in (name, form, columns)))
        )

    def add(self, name: str, *values: object) -> None:
        number, form, _ = FORMATS[name]
        packed = [v.encode() if isinstance(v, str) else v for v in values]
        self._add(struct.pack("<BBB" + "".join(STRUCT[c] for c in form), 0xA3, 0x95, number, *packed))

    def _add(self, message: bytes) -> None:
        self.data += message
        self.sizes.append(len(message))

    def imu(self, us: int, instance: int = 0, x: float = 0.1, *, healthy: int = 1) -> None:
        self.add("IMU", us, instance, x, 0.2, 0.3, 1.0, 2.0, -9.8, 0, 0, 25.0, healthy, healthy, 1000, 1000)

    def gps(self, us: int, ms: int = 0, *, instance: int = 0, status: int = 3, week: int = WEEK, vv: int = 1) -> None:
        place = 470_000_000, 85_000_000, 45_000
        self.add("GPS", us, instance, status, MS + ms, week, 12, 80, *place, 20.0, 90.0, -1.5, 0.0, 1)
        self.add("GPA", us, instance, 120, 150, 220, 35, 0.0, vv, us // 1000, 0)

    def baro(self, us: int, press: float = 95_000.0, *, healthy: int = 1) -> None:
        self.add("BARO", us, 0, 1.0, 500.0, press, 2500, 0.0, us // 1000, 0.0, 20.0, healthy)

    def attitude(self, us: int) -> None:
        self.add("ATT", us, 0, 1000, 0, -500, 0, 27000, 0, 0, 3)

    def airspeed(self, us: int, speed: float = 20.0, *, healthy: int = 1) -> None:
        self.add("ARSP", us, 0, speed, 250.0, 2000, 250.0, 0.0, 1, healthy, 0.0, 0)


def flight(seconds: float = 12.0, begin: int = 2_000_000) -> Log:
    """A short flight: three IMUs at 50 Hz, the others at 5 Hz."""
    log = Log()
    log.add("PARM", begin, "SYSID_THISMAV", 7.0, 1.0)
    log.add("MSG", begin, "ArduPlane V4.5.1 (abcdef01)")
    for k in range(int(50 * seconds)):
        us = begin + 20_000 * k
        for instance in range(3):
            log.imu(us + instance, instance, 0.1 + instance)
        if k % 10 == 0:
            log.gps(us + 5, 20 * k)
            log.baro(us + 6, 95_000.0 - k)
            log.attitude(us + 7)
            log.airspeed(us + 8)
    return log


@pytest.fixture
def source(tmp_path):
    def make(log: Log | bytes, **options):
        path = tmp_path / "flight.BIN"
        path.write_bytes(log if isinstance(log, bytes) else log.data)
        return DataFlashSource(path, **options)

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


def same(one, other) -> bool:
    """Whether two messages are the same, bit for bit."""
    return type(one) is type(other) and all(
        np.array_equal(a, b, equal_nan=a.dtype.kind == "f") if isinstance(a, np.ndarray) else a == b
        for a, b in ((getattr(one, n), getattr(other, n)) for n in one.__struct_fields__)
    )


def results(source) -> list:
    """Everything but the byte account, whose rows come with the blocks of the file."""
    return [m for m in source.messages() if not isinstance(m, LinkBytes)]


# -- bytes --


@needs_copter
def test_every_field_of_every_message_is_what_pymavlink_reads():
    from pymavlink.DFReader import DFReader_binary

    tables, seen = read(COPTER), defaultdict(int)
    with DFReader_binary(str(COPTER)) as log:
        while (message := log.recv_msg()) is not None:
            name = message.get_type()
            row = seen[name]
            seen[name] += 1
            if row % 11 == 0:
                for column in message.get_fieldnames():
                    value, ours = getattr(message, column), tables[name].column(column)[row]
                    assert ours == (value.encode() if isinstance(value, str) else value), (name, row, column)
    assert seen == {name: len(table) for name, table in tables.items()}


def test_messages_of_any_format_are_read_in_blocks_of_any_size():
    log = flight(1.0)
    whole = Scanner()
    expected = {t.layout.name: t for t in whole.scan(log.data, True)}
    for size in (1, 7, 100, 1000):
        scanner, found = Scanner(), defaultdict(list)
        for i in range(0, len(log.data), size):
            for table in scanner.scan(log.data[i : i + size], False):
                found[table.layout.name].append(table)
        for table in scanner.scan(b"", True):
            found[table.layout.name].append(table)
        assert scanner.messages == whole.messages == len(log.sizes)
        assert scanner.discarded == scanner.truncated == 0
        for name, table in expected.items():
            assert np.array_equal(np.concatenate([t.values for t in found[name]]), table.values)
            assert np.array_equal(np.concatenate([t.offset for t in found[name]]), table.offset)


def test_no_good_message_is_lost_for_a_damaged_one_before_it():
    log = flight(2.0)
    begin = sum(log.sizes[:40])  # of a message in the middle
    for gone in range(1, log.sizes[40]):
        scanner = Scanner()
        damaged = log.data[: begin + log.sizes[40] - gone] + log.data[begin + log.sizes[40] :]
        found = np.sort(np.concatenate([table.offset for table in scanner.scan(damaged, True)]))
        starts = np.cumsum([0, *log.sizes[:-1]])
        assert np.array_equal(found, np.concatenate([starts[:40], starts[41:] - gone]))
        assert scanner.discarded == log.sizes[40] - gone


def test_garbage_between_messages_is_counted_and_costs_none():
    log = flight(1.0)
    cut = sum(log.sizes[:50])
    scanner = Scanner()
    scanner.scan(log.data[:cut] + b"\xa3\x95" + bytes(range(100)) + log.data[cut:], True)
    assert scanner.messages == len(log.sizes)
    assert scanner.discarded == 102


def test_a_type_that_is_defined_anew_is_read_by_the_definition_before_each_message():
    log = Log("EV")
    log.add("EV", 1000, 10)
    log.define("EV", "QH", "TimeUS,Number")
    log._add(struct.pack("<BBBQH", 0xA3, 0x95, 139, 2000, 777))
    for data in (log.data, log.data + log.data):
        tables = [t for t in Scanner().scan(data, True) if t.layout.name == "EV"]
        assert [t.values.tolist() for t in tables][:2] == [[(1000, 10)], [(2000, 777)]]


def test_a_log_cut_at_any_byte_is_read_to_its_last_whole_message(tmp_path):
    log = Log("MSG", "IMU", "GPS", "GPA")
    log.add("MSG", 1_000_000, "hello")
    for k in range(6):
        log.imu(1_000_000 + 20_000 * k)
    log.gps(1_130_000)
    ends = np.cumsum(log.sizes)
    path = tmp_path / "cut.bin"
    for size in range(len(log.data) + 1):
        scanner = Scanner()
        scanner.scan(log.data[:size], True)
        whole = int((ends <= size).sum())
        assert scanner.messages == whole
        assert scanner.discarded == 0
        assert scanner.truncated == size - (ends[whole - 1] if whole else 0)
        path.write_bytes(log.data[:size])
        if size < ends[5]:  # no sample yet: its first message is the sixth
            with pytest.raises(ValueError, match=r"cut\.bin"):
                DataFlashSource(path)
        elif size % 5 == 0:
            cut = DataFlashSource(path)
            messages = list(cut.messages())
            assert len(together(messages, Imu)["t"]) == min(whole - 5, 6)
            assert cut.truncated == scanner.truncated
            assert bool(cut.truncated) == any("ends inside a message" in text for text in told(messages))


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.tuples(st.integers(0, 9000), st.integers(0, 255)), max_size=40),
    st.integers(0, 9000),
    st.integers(0, 300),
)
def test_whatever_the_damage_counters_add_up_and_nothing_but_a_refusal_is_raised(tmp_path_factory, changes, at, gone):
    data = bytearray(flight(0.8).data)
    for place, value in changes:
        data[place % len(data)] = value
    at %= len(data)
    data = bytes(data[:at] + data[at + gone :])
    path = tmp_path_factory.getbasetemp() / "fuzzed.bin"
    path.write_bytes(data)
    try:
        source = DataFlashSource(path)
    except ValueError as error:
        assert "fuzzed.bin" in str(error)
        return
    messages = list(source.messages())
    account = [m for m in messages if isinstance(m, LinkBytes)][-1]
    inside = sum(len(t) * t.layout.length for t in read(path).values())
    assert account.bytes[0] == len(data)
    assert account.discarded[0] + account.pending[0] + inside == len(data) or account.unknown[0]
    reached = 0
    for message in messages:
        if isinstance(message, Sample):
            assert message.t_rx.min() > reached or reached == 0
        if isinstance(message, Progress):
            assert message.t_rx[-1] >= reached
            reached = int(message.t_rx[-1])


@settings(max_examples=60, deadline=None)
@given(st.binary(max_size=3000))
def test_noise_is_no_log(tmp_path_factory, noise):
    path = tmp_path_factory.getbasetemp() / "noise.bin"
    path.write_bytes(noise)
    with pytest.raises(ValueError, match=r"noise\.bin"):
        DataFlashSource(path)


# -- text --


def as_text(path) -> bytes:
    """The log as pymavlink's mavlogdump would write it."""
    from pymavlink.DFReader import DFReader_binary

    lines = []
    with DFReader_binary(str(path)) as log:
        while (m := log.recv_msg()) is not None:
            lines.append(", ".join([m.get_type(), *(str(getattr(m, c)) for c in m.get_fieldnames())]))
    return ("\r\n".join(lines) + "\r\n").encode()


def test_a_text_log_says_what_the_binary_one_says(tmp_path):
    binary, text = tmp_path / "a.bin", tmp_path / "a.log"
    binary.write_bytes(flight(6.0).data)
    text.write_bytes(as_text(binary))
    os.utime(text, ns=(binary.stat().st_mtime_ns,) * 2)
    one, other = DataFlashSource(binary), DataFlashSource(text)
    assert other.properties["format"].endswith("text")
    ours, theirs = results(one), results(other)
    assert len(ours) == len(theirs)
    for a, b in zip(ours, theirs, strict=True):
        if isinstance(a, Event) and a.text[0].startswith("ArduPilot DataFlash"):
            continue
        assert same(a, b), (a, b)


def test_damaged_lines_are_counted_and_left_out_as_a_whole(tmp_path):
    path = tmp_path / "a.log"
    path.write_bytes(flight(2.0).data)
    lines = as_text(path).split(b"\r\n")
    imu = [i for i, line in enumerate(lines) if line.startswith(b"IMU,")]
    lines[imu[3]] = lines[imu[3]][:25]
    lines[imu[9]] = lines[imu[9]].replace(b"0.2", b"0,2")
    lines[imu[12]] = lines[imu[12]].replace(b"0.3", b"0.x3")
    lines[imu[15]] = b"\xff\xfe garbage"
    path.write_bytes(b"\r\n".join(lines) + b"IMU, 4000000, 0, 0.1")
    source = DataFlashSource(path)
    messages = list(source.messages())
    samples = [len(together(messages, Imu, name)["t"]) for name in ("log/1", "log/1.1", "log/1.2")]
    assert sum(samples) == len(imu) - 4
    assert source.truncated == len(b"IMU, 4000000, 0, 0.1")
    account = [m for m in messages if isinstance(m, LinkBytes)][-1]
    assert account.corrupt[0] == 4
    assert account.bytes[0] == source.size


# -- samples --


def test_samples_are_in_si_units_and_in_the_frames_of_the_vocabulary(source):
    messages = list(source(flight()).messages())
    imu, fix, altimeter, attitude, air = (together(messages, k) for k in (Imu, Gnss, Altitude, Attitude, AirData))
    assert np.allclose(imu["specific_force"], [1.0, 2.0, -9.8])
    assert np.allclose(imu["angular_rate"], [0.1, 0.2, 0.3])
    assert np.allclose([fix["latitude"][0], fix["longitude"][0]], np.deg2rad([47.0, 8.5]))
    assert np.allclose(fix["altitude"], 450.0)
    assert np.allclose(
        fix["velocity"], [0.0, 20.0, -1.5], atol=1e-6
    )  # course 90 degrees: east; climbing: down negative
    assert np.allclose(fix["sigma"], [1.5, 2.2, 0.35])
    assert (fix["satellites"] == 12).all()
    assert np.allclose(altimeter["pressure"][0], 95_000.0)
    assert np.allclose(altimeter["altitude"][0], 540.3, atol=0.1)  # ICAO tables
    assert np.allclose([attitude["phi"][0], attitude["theta"][0], attitude["psi"][0]], np.deg2rad([10.0, -5.0, -90.0]))
    assert np.allclose(air["airspeed"], 20.0)
    assert {m.vehicle for m in messages if isinstance(m, Sample)} == {7}


def test_the_pressure_that_a_probe_felt_stands_beside_the_calibrated_airspeed_and_is_not_used(source):
    messages = list(source(flight()).messages())
    assert np.isnan(together(messages, AirData)["differential_pressure"]).all()
    felt = [m for m in messages if isinstance(m, AirData) and m.source == "log/1.10"]
    assert felt and not any(m.chosen for m in felt)
    assert all(np.allclose(m.differential_pressure, 250.0) and np.isnan(m.airspeed).all() for m in felt)


def test_every_imu_is_a_stream_and_the_first_is_chosen(source):
    messages = list(source(flight()).messages())
    for instance in range(3):
        name = "log/1" + f".{instance}" * (instance > 0)
        mine = [m for m in messages if isinstance(m, Imu) and m.source == name]
        assert {m.chosen for m in mine} == {instance == 0}
        assert np.allclose(together(messages, Imu, name)["angular_rate"][:, 0], 0.1 + instance)
        assert len(together(messages, Imu, name)["t"]) == 600
    assert "imu from IMU[0], 50 Hz; also IMU[1], IMU[2]" in told(messages)


def test_what_was_not_measured_is_left_out_and_counted(source):
    log = flight(6.0)
    now = 2_000_000 + 6_000_000
    log.gps(now, 6000, status=2)
    log.gps(now + 200_000, 5800)  # the last fix again, logged anew
    log.gps(now + 400_000, 6400, vv=0)
    log.imu(now + 410_000, healthy=0)
    log.baro(now + 420_000, healthy=0)
    log.baro(now + 430_000, 0.0)
    log.airspeed(now + 440_000, healthy=0)
    messages = list(source(log).messages())
    fix = together(messages, Gnss)
    assert len(fix["t"]) == 31
    assert np.isnan(fix["velocity"][-1, 2]) and np.isfinite(fix["velocity"][:-1]).all()
    assert len(together(messages, Imu)["t"]) == 300
    assert len(together(messages, Altitude)["t"]) == len(together(messages, AirData)["t"]) == 30
    for text in (
        "GPS[0]: no three-dimensional fix: 1 messages left out",
        "GPS[0]: the same fix again: 1 messages left out",
        "IMU[0]: unhealthy: 1 messages left out",
        "BARO[0]: unhealthy: 1 messages left out",
        "BARO[0]: no pressure of the atmosphere: 1 messages left out",
        "ARSP[0]: unhealthy: 1 messages left out",
    ):
        assert text in told(messages)


def test_flow_angles_of_the_autopilots_filter_are_told_and_never_chosen(source):
    log = flight(2.0)
    log.add("AOA", 4_000_000, 5.0, -3.0)
    messages = list(source(log).messages())
    (flow,) = [m for m in messages if isinstance(m, FlowAngles)]
    assert not flow.chosen
    assert np.allclose([flow.alpha[0], flow.beta[0]], np.deg2rad([5.0, -3.0]))


def test_raw_sensors_serve_where_there_is_no_imu_each_rate_with_the_force_beside_it(source):
    log = Log("ACC", "GYR", "BARO")
    for k in range(0, 8000, 8):  # bursts of eight, as from a FIFO
        us = 1_000_000 + 1000 * k
        for j in range(8):
            log.add("GYR", us + 8000, 0, us + 1000 * j, 0.001 * (k + j), 0.0, 0.0)
        for j in range(8):
            if (k + j) % 100 != 50:
                log.add("ACC", us + 8200, 0, us + 1000 * j + 40, 0.01 * (k + j), 0.0, -9.8)
    messages = list(source(log).messages())
    imu = together(messages, Imu)
    assert np.allclose(np.diff(imu["t"]), 1e6)
    number = np.round(imu["angular_rate"][:, 0] / 0.001)
    partner = np.round(imu["specific_force"][:, 0] / 0.01)
    missing = number % 100 == 50
    assert len(number) == 8000
    assert np.array_equal(number[~missing], partner[~missing])
    assert (np.abs(number - partner)[missing] == 1).all()
    assert (imu["t_rx"] > imu["t"]).all()


@needs_copter
def test_the_copters_samples_are_what_pymavlink_reads_at_their_own_rates():
    from pymavlink.DFReader import DFReader_binary

    rows = defaultdict(list)
    with DFReader_binary(str(COPTER)) as log:
        while (m := log.recv_match(type=["IMU", "IMU2", "IMU3", "ATT", "GPS", "BARO", "BAR2"])) is not None:
            rows[m.get_type()].append(m)
    source = DataFlashSource(COPTER)
    messages = list(source.messages())
    for name, where in (("IMU", "log/1"), ("IMU2", "log/1.1"), ("IMU3", "log/1.2")):
        imu = together(messages, Imu, where)
        assert np.array_equal(imu["specific_force"], [[m.AccX, m.AccY, m.AccZ] for m in rows[name]])
        assert np.array_equal(imu["angular_rate"], [[m.GyrX, m.GyrY, m.GyrZ] for m in rows[name]])
        assert np.array_equal(imu["t"] - source.boots[0].offset, [m.TimeMS * 1_000_000 for m in rows[name]])
        assert 1e9 / np.median(np.diff(imu["t"])) == 50.0
    attitude = together(messages, Attitude)
    assert np.array_equal(attitude["theta"], np.deg2rad([m.Pitch for m in rows["ATT"]]))
    assert np.allclose(np.exp(1j * attitude["psi"]), np.exp(1j * np.deg2rad([m.Yaw for m in rows["ATT"]])))
    for name, where in (("BARO", "log/1"), ("BAR2", "log/1.1")):
        assert np.array_equal(together(messages, Altitude, where)["pressure"], [m.Press for m in rows[name]])
    fixes = [m for m in rows["GPS"] if m.Status >= 3]
    fixes = [m for m, before in zip(fixes, [None, *fixes], strict=False) if before is None or m.TimeMS != before.TimeMS]
    fix = together(messages, Gnss)
    assert np.array_equal(fix["latitude"], np.deg2rad([m.Lat for m in fixes]))
    assert np.array_equal(fix["altitude"], [m.Alt for m in fixes])
    assert np.array_equal(fix["velocity"][:, 2], [m.VZ for m in fixes])
    assert np.allclose(np.hypot(*fix["velocity"][:, :2].T), [m.Spd for m in fixes])
    assert np.allclose(fix["t"] * 1e-9, [m._timestamp for m in fixes], atol=1.0)  # pymavlink anchors at another fix


@needs_copter
def test_the_hole_in_the_copters_log_and_its_sensors_are_told():
    messages = list(DataFlashSource(COPTER).messages())
    assert "imu from IMU, 50 Hz; also IMU2, IMU3" in told(messages)
    assert [text for text in told(messages) if "hole" in text] == [
        "2.02 s hole in the log at 72.61 s since boot: no imu sample"
    ]


# -- time --


def test_time_is_utc_by_the_first_fix_that_knows_the_week(source):
    log = flight()
    unknowing = Log()
    unknowing.gps(1_500_000, week=0)
    log.data = unknowing.data + log.data
    messages = list(source(log).messages())
    assert together(messages, Gnss)["t"][1] == MIDNIGHT * 1_000_000_000
    assert together(messages, Imu)["t"][0] == MIDNIGHT * 1_000_000_000 - 5_000
    assert any("the first satellite fix that knows the date" in text for text in told(messages))


def test_without_a_fix_the_time_of_the_file_is_that_of_its_last_message(source, tmp_path):
    log = Log("IMU")
    for k in range(100):
        log.imu(1_000_000 + 20_000 * k)
    (tmp_path / "flight.BIN").write_bytes(log.data)
    for modified, newest in ((1_700_000_000_000_000_000, 1_700_000_000_000_000_000), (0, 2_980_000_000)):
        os.utime(tmp_path / "flight.BIN", ns=(modified, modified))
        messages = list(DataFlashSource(tmp_path / "flight.BIN").messages())
        assert together(messages, Imu)["t"][-1] == newest
        assert any("the time of the file" in text or "counts from boot" in text for text in told(messages))


def test_the_clock_fit_finds_how_fast_the_vehicles_clock_runs(source):
    log = Log("IMU", "GPS", "GPA")
    for k in range(1000):
        log.gps(1_000_000 + 200_000 * k, round(200 * k * (1 + 50e-6)) + (700 if k % 40 == 7 else 0))
        log.imu(1_000_000 + 200_000 * k + 50)
    (fit,) = [m for m in source(log).messages() if isinstance(m, ClockFit)]
    assert fit.reference == ["gnss"]
    assert abs(fit.rate[0] - 50e-6) < 4 * fit.rate_sigma[0] < 10e-6
    assert abs(fit.offset[0]) < 1e-3
    assert fit.valid[0] == 1


def test_several_boots_in_one_file_are_boots_and_time_runs_on(source):
    first, second, third = flight(6.0), flight(6.0, begin=500_000), Log("IMU")
    for k in range(200):
        third.imu(300_000 + 20_000 * k)
    late = flight(6.0).data.replace(struct.pack("<H", WEEK), struct.pack("<H", WEEK + 1))  # a week later
    log = first.data + second.data + third.data + late
    messages = list(source(log).messages())
    imu = [m for m in messages if isinstance(m, Imu) and m.source == "log/1"]
    assert sorted({m.boot for m in imu}) == [0, 1, 2, 3]
    t = np.concatenate([m.t for m in imu])
    assert (np.diff(t) > 0).all()
    assert (t[-1] - t[0]) * 1e-9 == pytest.approx(7 * 86400 + 6, abs=10)
    assert sum("the boot clock stepped back" in text for text in told(messages)) == 3
    assert any("boot 2: time is from boot 1, which it is put 1 s behind" in text for text in told(messages))


def test_a_message_whose_time_is_damaged_is_left_out(source):
    log = flight(6.0)
    cut = sum(log.sizes[:300])
    wrong = Log()
    begin = len(wrong.data)
    for us in (2**60, 900_000_000, 2**64 - 1):
        wrong.imu(us)
    messages = list(source(log.data[:cut] + wrong.data[begin:] + log.data[cut:]).messages())
    assert "3 messages left out: their time is damaged" in told(messages)
    imu = together(messages, Imu)
    assert len(imu["t"]) == 300
    assert (np.diff(imu["t"]) == 20_000_000).all()


def test_a_pause_of_minutes_is_a_hole_and_no_boot(source):
    log = flight(4.0)
    again = flight(4.0, begin=400_000_000)
    messages = list(source(log.data + again.data).messages())
    assert {m.boot for m in messages if isinstance(m, Sample)} == {0}
    assert "394.02 s hole in the log at 5.98 s since boot: no imu sample" in told(messages)


def test_a_message_written_long_after_its_time_is_told_late_and_in_order(source):
    log = flight(12.0)
    log.baro(3_000_000, 12_345.0)
    log.imu(14_100_000)
    altitude = together(list(source(log).messages()), Altitude)
    row = int(np.flatnonzero(altitude["pressure"] == 12_345.0)[0])
    assert altitude["t_rx"][row] > altitude["t"][row]
    assert (altitude["t_rx"][:50] == altitude["t"][:50]).all()
    assert (np.diff(altitude["t_rx"]) >= 0).all()


def test_progress_covers_what_has_been_told_and_nothing_that_is_to_come(source):
    reached, final = 0, []
    for message in source(flight(30.0)).messages():
        if isinstance(message, Sample):
            assert message.t_rx.min() > reached
        if isinstance(message, Progress):
            assert message.t_rx[-1] >= reached
            reached = int(message.t_rx[-1])
            final.append(message.final)
    assert final[-1] and not any(final[:-1]) and len(final) > 5


def test_nothing_depends_on_how_the_file_was_cut_into_blocks(source, monkeypatch):
    log = flight(20.0)
    early = Log()
    early.gps(1_900_000, 40, instance=1)  # a second receiver knows the date first, by a time of its own
    log.data, log.sizes = early.data + log.data, early.sizes + log.sizes
    for k in range(100):  # what is written after its time, but not too late
        log.attitude(22_000_000 + 20_000 * k - 1_500_000 * (k % 3 == 0))
        log.baro(22_000_000 + 20_000 * k)
    cut = sum(log.sizes[:900])
    data = log.data[:cut] + b"garbage" + log.data[cut:] + flight(9.0, begin=100_000).data
    expected = results(source(data))
    assert together(expected, Gnss, "log/1.1")["t"][0] == MIDNIGHT * 1_000_000_000 + 40_000_000
    for size in (199, 977, 5000, 65_536):
        monkeypatch.setattr(dataflash, "BLOCK", size)
        found = results(source(data))
        assert len(found) == len(expected)
        assert all(same(a, b) for a, b in zip(found, expected, strict=True))


@needs_copter
def test_nothing_of_the_copters_log_depends_on_blocks_either(monkeypatch):
    expected = results(DataFlashSource(COPTER))
    monkeypatch.setattr(dataflash, "BLOCK", 100_003)
    found = results(DataFlashSource(COPTER))
    assert all(same(a, b) for a, b in zip(found, expected, strict=True))


# -- what else is told --


def test_where_the_first_imu_falls_silent_the_next_is_used_from_then_on(source):
    log = Log("IMU")
    for k in range(1500):
        if k < 500 or k > 1200:
            log.imu(1_000_000 + 20_000 * k, 0)
        log.imu(1_000_001 + 20_000 * k, 1)
    messages = list(source(log).messages())
    chosen = [m for m in messages if isinstance(m, Imu) and m.chosen]
    t = np.concatenate([m.t for m in chosen])
    assert (np.diff(t) > 0).all()
    assert (chosen[0].source, chosen[-1].source) == ("log/1", "log/1.1")
    (text,) = [text for text in told(messages) if "silent" in text]
    assert text == "imu: IMU[0] has been silent for 5.0 s: IMU[1] is used from here on"
    assert len(together(messages, Imu)["t"]) == 799  # what it said again later is recorded


def test_test_points_are_marked_in_texts(source):
    log = flight(4.0)
    log.add("MSG", 3_000_000, "TP 12 start")
    log.add("MSG", 5_000_000, "SRC=255/190:TP 12 stop")
    log.add("MSG", 5_100_000, "TP 13 start @9")  # another vehicle's
    log.add("MSG", 5_200_000, "PT 14 go")
    messages = list(source(log).messages())
    marks = [m for m in messages if isinstance(m, Mark)]
    assert [(a, n) for m in marks for a, n in zip(m.action, m.name, strict=True)] == [("start", "12"), ("stop", "12")]
    assert "ArduPlane V4.5.1 (abcdef01)" in [text for m in messages if isinstance(m, StatusText) for text in m.text]
    messages = list(source(log, mark=r"^PT (?P<name>\d+) (?P<action>start|stop)$").messages())
    assert not [m for m in messages if isinstance(m, Mark)]


def test_modes_and_events_of_the_autopilot_are_told(source):
    log = flight(4.0)
    log.add("MODE", 3_000_000, 11, 11, 1)
    log.add("EV", 3_100_000, 10)
    assert {"autopilot: mode 11", "autopilot: event 10, armed"} <= set(told(source(log).messages()))


def test_what_the_logger_could_not_write_is_told(source):
    log = flight(2.0)
    for k in (0, 17, 23):
        log.add("DSF", 2_000_000 + k, k, 0, 0, 0, 0, 0)
    assert any(text.startswith("the logger dropped 23 messages") for text in told(source(log).messages()))


def test_a_sensor_that_does_not_say_when_it_measured_is_left_out(source):
    log = flight(2.0)
    log.define("AOA", "ff", "AOA,SSA")
    log._add(struct.pack("<BBBff", 0xA3, 0x95, 137, 5.0, 1.0))
    messages = list(source(log).messages())
    assert not [m for m in messages if isinstance(m, FlowAngles)]
    assert "AOA: does not say when: 1 messages left out" in told(messages)


def test_a_unit_that_is_declared_otherwise_is_told(source):
    log = flight(2.0)
    for letter, unit in (("E", "deg/s"), ("o", "m/s/s"), ("s", "s")):
        log.add("UNIT", 2_000_000, ord(letter), unit)
    log.add("FMTU", 2_000_000, FORMATS["IMU"][0], "s#EEEooo--O--zz", "F-000000-----00")
    said = [text for text in told(source(log).messages()) if "declared" in text]
    assert said[0] == "IMU.GyrX is declared to be in deg/s and is taken for rad/s"
    assert len(said) == 3


def test_the_recording_is_told_what_the_log_is(source):
    properties = source(flight(2.0)).properties
    assert properties["firmware"] == "ArduPlane V4.5.1 (abcdef01)"
    assert properties["vehicle type"] == "plane"
    assert properties["format"] == "ArduPilot DataFlash, binary"
    assert len(properties["sha256"]) == 64


def test_what_is_no_log_is_refused_with_its_name_and_a_way_out(tmp_path):
    path = tmp_path / "x.bin"
    for content, why in (
        (b"", "nothing was recorded"),
        (b"time,latitude\n1,2\n" * 100, "no DataFlash log"),
        (Log("MSG").data, "holds no sample"),
    ):
        path.write_bytes(content)
        with pytest.raises(ValueError, match=f"x.bin.*{why}"):
            DataFlashSource(path)


def test_a_kind_of_log_is_told_by_content_and_only_then_by_name(tmp_path):
    from tests.telemetry.wire import Sender, tlog

    frames = tlog([(1_700_000_000_000_000 + i, Sender().attitude(i)) for i in range(9)])
    text = b"FMT, 128, 89, FMT, BBnNZ, Type,Length,Name,Format,Columns\n"
    ulog = bytes.fromhex("554c6f6701123501") + bytes(8)
    for name, content, expected in (
        ("a.bin", flight(0.2).data, "dataflash"),
        ("a.tlog", flight(0.2).data, "dataflash"),
        ("a.bin", frames, "tlog"),
        ("a.tlog", text, "dataflash"),
        ("a.log", ulog, "ulog"),
        ("a.tlog", b"damaged", "tlog"),
        ("a.BIN", b"damaged", "dataflash"),
        ("a.ulg", b"", "ulog"),
    ):
        (tmp_path / name).write_bytes(content)
        assert kind(tmp_path / name) == expected
    (tmp_path / "a.csv").write_bytes(b"t,x\n1,2\n")
    with pytest.raises(ValueError, match=r"a\.csv is no log"):
        kind(tmp_path / "a.csv")
