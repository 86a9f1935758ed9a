"""What crosses a wall arrives as it left, or is refused by name."""

from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from telemetry.messages import KINDS, Altitude, Event, Gnss, Imu, Mark, Message, event
from telemetry.wire import decode, encode, schema

T = np.array([1_700_000_000_000_000_000, 1_700_000_000_100_000_000])


def altitude(**changes):
    columns = {"altitude": np.array([1.0, math.nan]), "pressure": np.array([1e5, math.inf]), "sigma": np.ones(2)}
    return Altitude(**({"vehicle": 1, "source": "0/1", "boot": 2, "t": T, "t_rx": T + 5, **columns} | changes))


def same(a: Message, b: Message) -> bool:
    return type(a) is type(b) and all(
        np.array_equal(x, y, equal_nan=x.dtype.kind == "f") if isinstance(x, np.ndarray) else x == y
        for x, y in ((getattr(a, name), getattr(b, name)) for name in a.__struct_fields__)
    )


@given(arrays.arrays(np.float64, (2,), elements=st.floats(allow_nan=True, allow_infinity=True, width=64)))
def test_every_float_survives_the_wire(values):
    message = altitude(altitude=values)
    assert same(decode("sortie.Altitude.v1", encode(message)), message)


def test_the_layout_on_the_wire_is_fixed():
    wire = msgspec.msgpack.decode(encode(altitude(sequence=7)))
    assert list(wire) == [
        *("vehicle", "source", "boot", "t", "t_rx", "sequence"),
        *("chosen", "t_sigma", "altitude", "pressure", "sigma"),
    ]
    assert wire["t"] == ["<i8", [2], T.astype("<i8").tobytes()]
    assert wire["sigma"] == ["<f8", [2], np.ones(2, "<f8").tobytes()]
    assert schema(Altitude) == "sortie.Altitude.v1"


def test_every_kind_has_its_own_key():
    keys = {(kind.family, kind.stream) for kind in KINDS.values()}
    assert len(keys) == len(KINDS)
    assert all(family and stream for family, stream in keys)


def test_events_and_marks_carry_text():
    mark = Mark(vehicle=1, source="0/1", boot=0, t=T[:1], t_rx=T[:1], action=["start"], name=["12"])
    said = event("a gap", level="warning", t=5, t_rx=6)
    assert same(decode(schema(Mark), encode(mark)), mark)
    assert same(decode(schema(Event), encode(said)), said)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"altitude": np.zeros(3)}, r"Altitude.altitude: shape \(3,\) where \(2,\) belongs"),
        ({"altitude": np.zeros((2, 2))}, r"Altitude.altitude: shape \(2, 2\)"),
        ({"t": T[:0]}, "Altitude: a message holds at least one sample"),
    ],
)
def test_columns_that_do_not_fit_are_refused_by_name(changes, words):
    with pytest.raises(ValueError, match=words):
        altitude(**changes)


def test_vectors_have_their_width():
    with pytest.raises(ValueError, match=r"Imu.angular_rate: shape \(2, 2\) where \(2, 3\) belongs"):
        Imu(vehicle=1, source="", boot=0, t=T, t_rx=T, specific_force=np.zeros((2, 3)), angular_rate=np.zeros((2, 2)))


def test_an_unknown_kind_or_version_is_refused():
    for name in ("sortie.Altitude.v2", "sortie.Nothing.v1", "altitude", ""):
        with pytest.raises(ValueError, match="unknown message"):
            decode(name, encode(altitude()))


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        (b"\xa3<f8", b"\xa3|O8", "carries only"),
        (b"\xa3<i8", b"\xa3<f8", "'<f8' where '<i8' belongs"),
        (b"\x91\x02", b"\x91\x7f", "shape"),
        (b"\x01", b"\xc0", "sortie.Altitude.v1: Expected `int`"),
    ],
)
def test_a_payload_that_lies_is_refused(old, new, words):
    with pytest.raises(ValueError, match=words.replace("<", "<")):
        decode("sortie.Altitude.v1", encode(altitude()).replace(old, new, 1))


@given(st.binary(max_size=300))
def test_hostile_bytes_raise_one_kind_of_error(payload):
    for kind in KINDS.values():
        with pytest.raises(ValueError):
            decode(schema(kind), payload)


@given(st.integers(0, 10_000), st.integers(0, 255))
def test_a_flipped_byte_is_a_message_or_a_refusal(place, value):
    wire = bytearray(
        encode(
            Gnss(
                vehicle=1,
                source="0/1",
                boot=0,
                t=T,
                t_rx=T,
                latitude=np.ones(2),
                longitude=np.ones(2),
                altitude=np.ones(2),
                velocity=np.ones((2, 3)),
                sigma=np.ones((2, 3)),
                satellites=np.ones(2, np.int64),
            )
        )
    )
    wire[place % len(wire)] = value
    try:
        decode("sortie.Gnss.v1", bytes(wire))
    except ValueError as error:
        assert "sortie.Gnss.v1" in str(error)
