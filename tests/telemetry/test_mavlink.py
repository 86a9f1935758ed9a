"""Columns hold what pymavlink decodes, for every message of every real log."""

from __future__ import annotations

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from telemetry.mavlink import Dialect
from telemetry.sources.tlog import TlogSource
from tests.telemetry.test_frames import scan
from tests.telemetry.wire import DATA, LOGS, Sender


def test_an_unknown_dialect_is_refused_by_name():
    with pytest.raises(ValueError, match="no MAVLink dialect 'martian'"):
        Dialect("martian")


def test_every_layout_has_the_size_that_pymavlink_gives_it():
    dialect = Dialect()
    for msgid, kind in mavlink.mavlink_map.items():
        assert dialect.layouts[msgid].itemsize == kind.unpacker.size


def test_cut_zeros_come_back_and_longer_payloads_are_cut():
    dialect = Dialect()
    short = Sender().pack(mavlink.MAVLink_gps_raw_int_message(7, 3, 1, 2, 3, 4, 5, 6, 7, 8))
    long = Sender().pack(mavlink.MAVLink_gps_raw_int_message(7, 3, 1, 2, 3, 4, 5, 6, 7, 8, h_acc=9, yaw=1))
    assert len(short) < len(long)
    values = dialect.decode(scan(short + long), 24, np.array([0, 1]))
    assert values["time_usec"].tolist() == [7, 7]
    assert values["h_acc"].tolist() == [0, 9]


@pytest.mark.parametrize("name", LOGS)
def test_values_are_those_of_pymavlink(name):
    path = DATA / name
    if not path.exists():
        pytest.skip(f"{path} is not here")
    dialect = Dialect()
    reader = mavlink.MAVLink(None)
    for frames in TlogSource(path, dialect).batches():
        for msgid in np.unique(frames.msgid).tolist():
            rows = np.flatnonzero(frames.msgid == msgid)
            values = dialect.decode(frames, msgid, rows)
            for i in {0, len(rows) // 2, len(rows) - 1}:
                message = reader.decode(bytearray(frames.frame(rows[i])))
                for field in message.fieldnames:
                    ours = values[field][i]
                    theirs = getattr(message, field)
                    if ours.dtype.kind == "S":
                        theirs = theirs.encode() if isinstance(theirs, str) else theirs
                        assert b"".join(np.atleast_1d(ours).tolist()).split(b"\0")[0] == theirs.split(b"\0")[0]
                    else:
                        np.testing.assert_array_equal(ours, theirs)
