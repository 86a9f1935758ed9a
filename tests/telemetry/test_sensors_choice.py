"""Which of several streams is used, when another takes over, and what is said of it."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from telemetry.messages import SENSORS, AirData, Altitude, Attitude, Event, FlowAngles, Gnss, Imu
from telemetry.sensors import FEEDS, MEASURING, PATIENCE, Quantity, Sensors, SensorSettings
from telemetry.sensors.choice import Choice
from tests.telemetry.test_frames import scan
from tests.telemetry.test_sensors import (
    DIALECT,
    Vehicle,
    airspeed,
    gps,
    gps_input,
    heartbeat,
    highres,
    hil_sensor,
    hud,
    pressure,
    raw,
    samples,
    scaled,
    vanes,
)
from tests.telemetry.wire import Sender

S = 1_000_000_000


def gps2(us=1000, fix=3):
    return mavlink.MAVLink_gps2_raw_message(us, fix, 474000000, 85000000, 500000, 100, 100, 1000, 9000, 9, 0, 0)


def streams(messages, kind):
    """Who was told, how many rows of it, and whether they are used."""
    found: dict = {}
    for m in messages:
        if isinstance(m, kind):
            found[m.source, m.chosen] = found.get((m.source, m.chosen), 0) + len(m.t)
    return found


def test_the_better_message_wins_from_when_it_is_first_heard():
    vehicle = Vehicle()
    told = vehicle.hear(scaled(ms=5), highres(zacc=-9.0), scaled(ms=6), highres(us=2000, zacc=-8.0))
    imu = [m for m in told if isinstance(m, Imu)]
    assert [z for m in imu for z in m.specific_force[:, 2].tolist()] == pytest.approx([-9.80665, -9.0, -8.0])
    assert Imu not in samples(scaled(ms=7), vehicle=vehicle)
    assert [text for text in vehicle.events if text.startswith("imu")] == [
        "imu: SCALED_IMU of component 1 (in steps of 1 mg and 1 mrad/s)",
        "imu: HIGHRES_IMU of component 1 takes over from SCALED_IMU of component 1 (closest to the instrument)",
    ]


def test_a_lesser_message_of_the_same_instrument_is_not_told_at_all():
    vehicle = Vehicle()
    assert streams(vehicle.hear(highres(), scaled()), Imu) == {("0/1", True): 1}
    assert "imu: SCALED_IMU of component 1 is also heard: the same instrument from further away, not used" in (
        vehicle.events
    )


def test_another_instrument_is_recorded_beside():
    vehicle = Vehicle()
    told = vehicle.hear(highres(), highres(id=1), scaled(number=2), scaled(number=3))
    assert streams(told, Imu) == {("0/1", True): 1, ("0/1.1", False): 1, ("0/1.2", False): 1}
    beside = "is also heard: another instrument, recorded beside the one in use"
    assert [text for text in vehicle.events if "beside" in text and text.startswith("imu")] == [
        f"imu: HIGHRES_IMU of component 1 (instance 1) {beside}",
        f"imu: SCALED_IMU3 of component 1 {beside}",
    ]


@pytest.mark.parametrize("first", [0, 1])
def test_the_autopilot_goes_before_other_components(first):
    spoken = [(mavlink.MAVLink_attitude_message(5, 0.1, 0.2, 0.3, 0, 0, 0), c) for c in (1, 154)]
    told = Vehicle().hear_all(spoken[first:] + spoken[:first])
    assert [m.source for m in told if isinstance(m, Attitude)].count("0/1") == 1
    assert streams(told, Attitude)["0/1", True] == 1


def test_of_two_equals_the_first_heard_is_used():
    told = Vehicle().hear_all([(pressure(), 9), (pressure(), 8)])
    assert streams(told, Altitude) == {("0/9", True): 1, ("0/8", False): 1}


@pytest.mark.parametrize(
    ("better", "lesser", "kind"),
    [
        ([highres()], [hil_sensor()], Imu),
        ([hil_sensor()], [scaled()], Imu),
        ([scaled()], [raw(100 * i) for i in range(1, 12)], Imu),
        ([raw(100 * i) for i in range(1, 12)], [scaled(number=2)], Imu),
        ([highres(bits=0x200, abs_pressure=900.0)], [pressure()], Altitude),
        ([pressure()], [pressure(number=2)], Altitude),
        ([highres(bits=0x400, diff_pressure=1.0)], [airspeed(10.0)], AirData),
        ([airspeed(10.0)], [hud(10.0, 12.0)] * 6, AirData),
        ([hud(10.0, 12.0)] * 6, [pressure(ms=i, diff=1.0) for i in range(1, 7)], AirData),
        ([gps_input()], [gps()], Gnss),
        ([gps()], [gps2()], Gnss),
    ],
    ids=lambda v: "",
)
def test_the_order_in_which_messages_are_preferred(better, lesser, kind):
    vehicle = Vehicle()
    vehicle.hear(*lesser)
    words = better[0].get_type()
    vehicle.hear(*better)
    assert any(f"{words} of component 1 takes over" in text for text in vehicle.events if text.startswith(kind.stream))


def alternate(vehicle, seconds, *makers, step=0.5):
    """Streams that go on side by side; return what they bring."""
    out = []
    for _ in range(round(seconds / step)):
        stamp = vehicle.now // 1000 + 1_000_000
        out += vehicle.hear(*[make(stamp) for make in makers], later=round(step * S))
    return out


def test_when_the_stream_in_use_falls_silent_the_next_takes_over():
    vehicle = Vehicle()
    alternate(vehicle, 2, lambda us: gps(us=us), gps2)
    told = alternate(vehicle, 8, gps2)
    assert streams(told, Gnss) == {("0/1.1", False): 9, ("0/1.1", True): 7}
    (said,) = [m for m in vehicle.said if isinstance(m, Event) and "takes over" in m.text[0]]
    assert said.level == ["warning"]
    assert said.text[0].startswith("gnss: GPS2_RAW of component 1 takes over: nothing from GPS_RAW_INT of component 1")


def test_what_was_silent_comes_back_when_it_has_been_heard_for_a_while():
    vehicle = Vehicle()
    alternate(vehicle, 2, lambda us: gps(us=us), gps2)
    alternate(vehicle, 8, gps2)
    told = alternate(vehicle, 8, lambda us: gps(us=us), gps2)
    assert streams(told, Gnss)["0/1", False] == pytest.approx(PATIENCE / S / 0.5, abs=1)
    assert vehicle.events[-1] == (
        "gnss: GPS_RAW_INT of component 1 takes over from GPS2_RAW of component 1 (heard again for 5 s)"
    )


def test_a_stream_that_comes_and_goes_does_not_make_the_choice_flap():
    vehicle = Vehicle()
    for _ in range(10):
        alternate(vehicle, 1, lambda us: gps(us=us), gps2)
        alternate(vehicle, 7, gps2)
    assert sum("takes over" in text for text in vehicle.events) == 1


def test_the_lesser_message_of_one_instrument_stands_in_for_the_better():
    vehicle = Vehicle()
    alternate(vehicle, 2, lambda us: highres(us=us), lambda us: scaled(ms=us // 1000))
    told = alternate(vehicle, 8, lambda us: scaled(ms=us // 1000))
    assert streams(told, Imu) == {("0/1", True): 7}


def test_a_silence_of_everything_says_nothing_about_one_stream():
    vehicle = Vehicle()
    alternate(vehicle, 2, gps2, lambda us: gps(us=us))
    vehicle.hear(gps2(us=77), later=60 * S)
    alternate(vehicle, 2, gps2, lambda us: gps(us=us))
    assert not any("nothing from" in text for text in vehicle.events)


def test_a_stream_that_stays_alone_is_used_whatever_its_gaps():
    vehicle = Vehicle()
    told = [m for i in range(5) for m in vehicle.hear(gps(us=i + 1), later=20 * S)]
    assert streams(told, Gnss) == {("0/1", True): 5}


def test_a_gap_between_two_rows_counts_one_second_at_most():
    vehicle = Vehicle()
    vehicle.hear(gps(us=1), gps2(us=1))
    waiting = [vehicle.hear(gps2(us=100 + i), later=3 * S) for i in range(7)]
    assert [streams(told, Gnss) for told in waiting] == [*[{("0/1.1", False): 1}] * 4, *[{("0/1.1", True): 1}] * 3]


@pytest.mark.parametrize("seed", range(40))
def test_rows_of_one_stream_that_are_not_looked_at_closely_count_as_all_do(seed):
    random = np.random.default_rng(seed)
    of = np.repeat(random.integers(0, 3, 80), random.integers(1, 8, 80))
    t_rx = np.cumsum(random.choice(STEPS, len(of))) * 1_000_000
    whole, cut = Choice(), Choice()
    for choice in (whole, cut):
        for i in range(3):
            choice.add((True, 2 - i, False, 0), i % 2)
    expected, _ = whole.choose(of, t_rx)
    used, quick = np.empty_like(expected), 0
    for begin, end in pairwise([0, *(np.flatnonzero(np.diff(of)) + 1).tolist(), len(of)]):
        if cut.only(int(of[begin]), t_rx[begin:end]):
            used[begin:end], quick = 2, quick + 1
        else:
            used[begin:end], _ = cut.choose(of[begin:end], t_rx[begin:end])
    np.testing.assert_array_equal(used, expected)
    assert quick > 3


def test_one_fix_that_two_messages_tell_is_one_measurement():
    vehicle = Vehicle()
    assert streams(vehicle.hear(gps(us=7)), Gnss) == {("0/1", True): 1}
    assert streams(vehicle.hear(gps_input(us=7)), Gnss) == {}
    assert streams(vehicle.hear(gps(us=8), gps_input(us=8)), Gnss) == {("0/1", True): 1}


def test_an_unbelieved_stream_is_not_heard():
    """A VFR_HUD that copies the groundspeed must not stand in for a silent airspeed sensor."""
    vehicle = Vehicle()
    alternate(vehicle, 2, lambda us: airspeed(10.0 + us * 1e-9), lambda us: hud(12.0, 12.0))
    told = alternate(vehicle, 10, lambda us: hud(12.0, 12.0))
    assert streams(told, AirData) == {}


def test_no_sender_can_make_the_list_of_ofgrow_without_end():
    vehicle = Vehicle()
    told = vehicle.hear_all([(gps_input(gps_id=i), c) for c in range(2, 8) for i in range(60)])
    assert len(streams(told, Gnss)) == 64
    assert any("64 streams of its kind" in text for text in vehicle.events)
    assert any("256 streams are followed" in text for text in vehicle.events)


def test_messages_that_are_sent_to_vehicles_show_no_vehicle():
    assert {feed.message for feed in FEEDS if feed.msgid in MEASURING}.isdisjoint(
        {"GPS_INPUT", "HIL_GPS", "HIL_SENSOR", "HEARTBEAT", "GLOBAL_POSITION_INT"}
    )
    assert 105 in MEASURING


STEPS = (0, 1, 250, 900, 1500, 6000)  # ms

ANY = {
    "highres": lambda us: highres(us=us),
    "highres, gyros only": lambda us: highres(us=us, bits=0x3F),
    "highres, second": lambda us: highres(us=us, id=1, diff_pressure=0.3),
    "nothing": lambda us: highres(us=us, zacc=0.0),
    "scaled": lambda us: scaled(ms=us // 1000),
    "scaled 2": lambda us: scaled(ms=us // 1000, number=2),
    "raw": lambda us: raw(us),
    "counts": lambda us: raw(us, acc=(0, 0, -4096)),
    "pressure": lambda us: pressure(ms=us // 1000, diff=0.01 * (us % 3)),
    "second pressure": lambda us: pressure(ms=us // 1000, number=2),
    "hud": lambda us: hud(10.0 + us % 5, 12.0),
    "copying hud": lambda us: hud(12.0, 12.0),
    "airspeed": lambda us: airspeed(10.0, flags=us % 2),
    "fix": lambda us: gps(us=us),
    "no fix": lambda us: gps(us=us, fix=1),
    "fix, second": gps2,
    "fix with vertical velocity": lambda us: gps_input(us=us),
    "vanes": lambda us: vanes(3.0, 100.0 * (us % 2), us=us),
    "ardupilot": lambda us: heartbeat(3),
    "other autopilot": lambda us: heartbeat(0),
    "named": lambda us: mavlink.MAVLink_named_value_float_message(us // 1000, b"AOA", 3.0),
    "array": lambda us: mavlink.MAVLink_debug_float_array_message(us, b"VANES", 0, [1.0, 2.0, *[0.0] * 56]),
}


def run(frames, keys, cuts, chosen):
    """What is told in as many batches as `cuts` make, per kind and source, as if at once; and the events, sorted."""
    sensors = Sensors(1, SensorSettings(**chosen), DIALECT)
    t = frames.t_rx
    said = []
    edges = sorted({0, len(frames), *(cut % (len(frames) + 1) for cut in cuts)})
    for begin, end in pairwise(edges):
        decoded = {}
        for key in sorted(set(keys[begin:end])):
            rows = np.array([i for i in range(begin, end) if keys[i] == key])
            if key[1] in sensors.msgids:
                decoded[key] = rows - begin, DIALECT.decode(frames, key[1], rows)
        sigma = (np.arange(begin, end) % 3) * 0.125
        said += sensors.samples(decoded, {1: "0/1", 2: "0/2"}, t[begin:end], t[begin:end], sigma, 0)
    said += sensors.finish(int(t[-1]), int(t[-1]), 0)
    rows: dict = {}
    for m in said:
        if isinstance(m, SENSORS):
            columns = [getattr(m, name) for name in m.__struct_fields__ if isinstance(getattr(m, name), np.ndarray)]
            if m.t_sigma is None:
                columns.append(np.full(len(m.t), -1.0))
            for i in range(len(m.t)):
                one = (m.chosen, m.t_sigma is None, *(c[i].tobytes() for c in columns))
                rows.setdefault((type(m).__name__, m.source), []).append(one)
    events = sorted((int(m.t[0]), m.level[0], m.text[0]) for m in said if isinstance(m, Event))
    return rows, events


@given(st.integers(0, 2**32 - 1), st.sampled_from(["", "SCALED_IMU2", "vanes", "off"]))
@settings(max_examples=100, deadline=None)
def test_batches_do_not_change_what_is_told(seed, wish):
    """Few kinds of messages in an example, so that they meet; some repeat the time of the one before."""
    random = np.random.default_rng(seed)
    kinds = random.choice(sorted(ANY), random.integers(2, 6), replace=False).tolist()
    n = 100
    cuts = random.integers(0, n, random.integers(1, 12)).tolist()
    senders = {1: Sender(1, 1), 2: Sender(1, 2)}
    times = np.cumsum(random.choice(STEPS, n)) * 1_000_000
    sent, us = [], 1000
    for at in times.tolist():
        us = us if random.random() < 0.3 else max(us, 1000 + at // 1000)
        sent.append(senders[1 + int(random.random() < 0.3)].pack(ANY[random.choice(kinds)](us)))
    frames = scan(*sent)
    frames.t_rx[:] = times
    keys = list(zip(frames.compid.tolist(), frames.msgid.tolist(), strict=True))
    chosen: dict = {} if not wish else {"imu": wish}
    if wish == "vanes":
        chosen = {
            "alpha": {"message": "NAMED_VALUE_FLOAT", "name": "AOA"},
            "beta": {"message": "DEBUG_FLOAT_ARRAY", "name": "VANES", "index": 1},
        }
        chosen = {name: Quantity(**told) for name, told in chosen.items()}
    whole = run(frames, keys, [], chosen)
    assert run(frames, keys, cuts, chosen) == whole
    assert run(frames, keys, range(len(frames) + 1), chosen) == whole


def test_angles_are_chosen_with_their_reason():
    vehicle = Vehicle()
    assert FlowAngles in samples(heartbeat(), vanes(1.0, 2.0), vehicle=vehicle)
    assert vehicle.events == ["flow_angles: AOA_SSA of component 1 (from no ArduPilot, so of vanes)"]
