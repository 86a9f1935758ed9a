"""Columns hold what pymavlink decodes, and encode to the bytes they came from, for every message of every dialect."""

from __future__ import annotations

import importlib
from itertools import pairwise

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from telemetry.frames import STX1, scan_datagrams
from telemetry.mavlink import Dialect, dialects
from telemetry.sources.tlog import TlogSource
from tests.telemetry.test_frames import scan
from tests.telemetry.wire import DATA, LOGS, Sender

DIALECT, ALL = Dialect(), Dialect("all")


def test_an_unknown_dialect_is_refused_by_name_and_the_known_ones_are_listed():
    with pytest.raises(ValueError, match=r"no MAVLink dialect 'martian': pymavlink ships .*ardupilotmega.* common"):
        Dialect("martian")


def test_a_module_that_is_no_dialect_is_refused():
    with pytest.raises(ValueError, match="no MAVLink dialect"):
        Dialect("..generator.mavcrc")


def same(ours, theirs) -> bool:
    """Whether a field has the value that pymavlink gives it; its texts end at the first NUL."""
    if ours.dtype.kind == "S":
        theirs = theirs.encode() if isinstance(theirs, str) else theirs
        return b"".join(np.atleast_1d(ours).tolist()).split(b"\0")[0] == theirs.split(b"\0")[0]
    return np.array_equal(ours, np.asarray(theirs, ours.dtype), equal_nan=ours.dtype.kind == "f")


def made_up(layout: np.dtype, rng: np.random.Generator) -> np.ndarray:
    """Three payloads of any values; the second one ends in zeros."""
    values = np.frombuffer(rng.bytes(3 * layout.itemsize), layout).copy()
    for name in layout.names:
        field = values[name]
        if field.dtype.kind == "f":
            field[:] = rng.normal(size=field.shape)
        elif field.dtype.kind == "S":
            field[:] = rng.choice([b"a", b"Z", b"7"], size=field.shape)
    values.view(np.uint8).reshape(3, -1)[1, layout.itemsize // 2 :] = 0
    return values


def check_against_pymavlink(dialect: Dialect, peer, msgid: int, version: int) -> None:
    kind = peer.mavlink_map[msgid]
    values = made_up(dialect.layouts[msgid], np.random.default_rng(msgid))
    data, bounds = dialect.encode(msgid, values, sysid=7, compid=np.array([8, 9, 10]), seq=255, version=version)
    frames = [data[a:b].tobytes() for a, b in pairwise(bounds.tolist())]
    for i, frame in enumerate(frames):
        message = peer.MAVLink(None).decode(bytearray(frame))
        assert message.get_type() == kind.msgname
        assert all(same(values[field][i], getattr(message, field)) for field in kind.fieldnames)
        sender = peer.MAVLink(None, srcSystem=7, srcComponent=8 + i)
        sender.seq = 255
        if kind.msgname != "TEST_TYPES":  # pymavlink cannot pack its field of one character
            assert bytes(message.pack(sender)) == frame
    found = scan_with(dialect, *frames)
    assert [found.frame(i) for i in range(3)] == frames
    assert found.known.all()
    ((_, (rows, again)),) = dialect.columns(found).items()
    assert rows.tolist() == [0, 1, 2]
    assert all(np.array_equal(again[field], values[field]) for field in kind.fieldnames)


@pytest.mark.parametrize("name", dialects())
def test_every_message_of_every_dialect_is_encoded_and_decoded_as_by_pymavlink(name):
    dialect, peer = Dialect(name), importlib.import_module(f"pymavlink.dialects.v20.{name}")
    assert list(dialect.layouts) == sorted(peer.mavlink_map)
    for msgid in dialect.layouts:
        if name == "all" or dialect.layouts[msgid] != ALL.layouts.get(msgid):
            check_against_pymavlink(dialect, peer, msgid, 2)
        else:  # seen above
            assert dialect.crc_extra[msgid] == ALL.crc_extra[msgid]


@pytest.mark.parametrize("name", ["all", "minimal"])
def test_every_message_is_encoded_and_decoded_in_mavlink_1_as_by_pymavlink(name):
    dialect, peer = Dialect(name), importlib.import_module(f"pymavlink.dialects.v10.{name}")
    for msgid in peer.mavlink_map:
        check_against_pymavlink(dialect, peer, msgid, 1)


def scan_with(dialect: Dialect, *datagrams: bytes):
    data = np.frombuffer(b"".join(datagrams), np.uint8)
    bounds = np.cumsum([0, *map(len, datagrams)])
    count = len(datagrams)
    return scan_datagrams(data, bounds, 1000 * np.arange(1, count + 1), np.zeros(count, np.uint8), dialect.crc_extra)


def test_what_cannot_be_encoded_is_refused_by_name():
    values = np.zeros(1, DIALECT.layouts[30])
    header = {"sysid": 1, "compid": 1, "seq": 0}
    with pytest.raises(ValueError, match="dialect ardupilotmega has no message id 16000000"):
        DIALECT.encode(16_000_000, values, **header)
    with pytest.raises(ValueError, match="HEARTBEAT: values of dtype"):
        DIALECT.encode(0, values, **header)
    with pytest.raises(ValueError, match="OPEN_DRONE_ID_BASIC_ID: MAVLink 1 has no message id 12900"):
        DIALECT.encode(12900, np.zeros(1, DIALECT.layouts[12900]), **header, version=1)


def test_cut_zeros_come_back_and_longer_payloads_are_cut():
    short = Sender().pack(mavlink.MAVLink_gps_raw_int_message(7, 3, 1, 2, 3, 4, 5, 6, 7, 8))
    long = Sender().pack(mavlink.MAVLink_gps_raw_int_message(7, 3, 1, 2, 3, 4, 5, 6, 7, 8, h_acc=9, yaw=1))
    assert len(short) < len(long)
    values = DIALECT.decode(scan(short + long), 24, np.array([0, 1]))
    assert values["time_usec"].tolist() == [7, 7]
    assert values["h_acc"].tolist() == [0, 9]


@pytest.mark.parametrize("count", [0, 1, 7, 128, 129, 300])
def test_the_columns_of_a_batch_are_its_known_frames_by_message_id(count):
    sender = Sender()
    makers = [lambda i: sender.attitude(i), lambda i: sender.unknown(), lambda i: sender.pressure(i, 900.0)]
    found = scan(*(makers[i % 3](i) for i in range(count)))
    columns = DIALECT.columns(found)
    assert list(columns) == sorted(set(found.msgid[found.known].tolist()))
    for msgid, (rows, values) in columns.items():
        assert rows.tolist() == np.flatnonzero(found.msgid == msgid).tolist()
        assert values["time_boot_ms"].tolist() == rows.tolist()


def log_of(name: str):
    path = DATA / name
    if not path.exists():
        pytest.skip(f"{path} is not here")
    return TlogSource(path, DIALECT).batches()


@pytest.mark.parametrize("name", LOGS)
def test_values_of_real_logs_are_those_of_pymavlink(name):
    reader = mavlink.MAVLink(None)
    for frames in log_of(name):
        for rows, values in DIALECT.columns(frames).values():
            for i in {*range(0, len(rows), 97), len(rows) - 1}:
                message = reader.decode(bytearray(frames.frame(rows[i])))
                assert all(same(values[field][i], getattr(message, field)) for field in message.fieldnames)


@pytest.mark.parametrize("name", LOGS)
def test_every_message_of_real_logs_encodes_to_the_bytes_it_came_from(name):
    for frames in log_of(name):
        first = frames.data[frames.start] == STX1
        for msgid, (rows, values) in DIALECT.columns(frames).items():
            for version, mine in ((1, first[rows]), (2, ~first[rows])):
                of = rows[mine]
                header = {"sysid": frames.sysid[of], "compid": frames.compid[of], "seq": frames.seq[of]}
                data, bounds = DIALECT.encode(msgid, values[mine], **header, version=version)
                assert np.diff(bounds).tolist() == frames.length[of].tolist()
                assert data.tobytes() == frames.select(of).compact().data.tobytes()
