"""The load of the pipeline benchmark is what it says, and a short run of it loses nothing."""

from __future__ import annotations

import io
import socket
import threading

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from rich.console import Console

from sims.experiments import pipeline_load as load
from sims.experiments import pipeline_speed as speed


@pytest.fixture(scope="module")
def flight(tmp_path_factory):
    return speed.fly(tmp_path_factory.mktemp("flight") / "flight.tlog", 4.0)


def told(flight, **given):
    return load.Load(**({"flight": flight.path, "vehicles": 3, "rate": 0.0, "seconds": 4.0, "ports": (1,)} | given))


def test_every_vehicle_says_what_the_flight_says_under_its_own_number(flight):
    frames = load.encode(told(flight, seconds=9.0))
    _, base = load.read(flight.path, 9.0)
    for vehicle in range(3):
        own = [frames.frame[i] for i in np.flatnonzero(frames.sender == vehicle)]
        assert len(own) == len(base) == flight.frames
        parser = mavlink.MAVLink(None)
        messages = [parser.parse_char(frame) for frame in own]  # checks every checksum
        assert {message.get_srcSystem() for message in messages} == {vehicle + 1}
        assert [message.get_seq() for message in messages] == [i % 256 for i in range(len(own))]
        assert [frame[10:-2] for frame in own] == [frame[10:-2] for frame in base]


def test_what_the_flight_does_not_say_is_filled_up_to_the_rate(flight):
    frames = load.encode(told(flight, rate=6000.0))
    assert len(frames.frame) == pytest.approx(24_000, abs=10)
    assert (np.diff(frames.t) >= 0).all()
    kinds = {frame[7] for frame in frames.frame}
    assert {mavlink.MAVLINK_MSG_ID_HIGHRES_IMU, mavlink.MAVLINK_MSG_ID_VIBRATION} <= kinds


def test_the_clock_of_a_vehicle_goes_on_through_everything_it_says(flight):
    frames = load.encode(told(flight, rate=6000.0))
    parser, clock = mavlink.MAVLink(None), []
    for i in np.flatnonzero(frames.sender == 1):
        message = parser.parse_char(frames.frame[i])
        if message.get_type() in ("HIGHRES_IMU", "VIBRATION", "SERVO_OUTPUT_RAW"):
            clock.append(message.time_usec * 1e-6)
        elif message.get_type() in ("RC_CHANNELS", "LOCAL_POSITION_NED"):
            clock.append(message.time_boot_ms * 1e-3)
    assert clock[-1] - clock[0] == pytest.approx(4.0, abs=0.1)
    assert np.diff(clock).min() > -0.05  # milliseconds are cut off, and a sensor tells when it measured
    inertial = sum(frame[7] == mavlink.MAVLINK_MSG_ID_HIGHRES_IMU for frame in frames.frame)
    assert inertial == pytest.approx(3 * 4 * speed.IMU, abs=6)


def test_everything_is_sent_in_its_own_time(flight, monkeypatch):
    monkeypatch.setattr(load, "STAGGER", 200_000_000)
    frames = load.encode(told(flight, seconds=0.5))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp:
        udp.bind(("127.0.0.1", 0))
        udp.settimeout(10.0)
        got: list[bytes] = []
        reader = threading.Thread(target=lambda: [got.append(udp.recv(4096)) for _ in frames.frame])
        reader.start()
        sent = load.send(frames, (udp.getsockname()[1],))
        reader.join()
    assert got == frames.frame
    assert sent.datagrams == len(got) and sent.octets == sum(map(len, got))
    assert sent.seconds >= frames.t[-1] * 1e-9


def row(**given):
    use = speed.Use(name="estimate", cpu=0.2, per_message=1e-4, memory=1e8, growth=1e6)
    good = {
        "processes": 3, "vehicles": 5, "rate": 0.0, "seconds": 60.0, "sent": 100, "received": 100, "lost": 0,
        "dropped": 0, "corrupt": 0, "estimates": 10, "age_p50": 0.01, "age_p99": 0.04, "age_max": 0.2, "behind": 0.0,
        "ending": 3.0, "uses": (use,), "recorded": 1,
    }  # fmt: skip
    return speed.Row(**(good | given))


def test_a_run_is_called_good_only_without_loss_and_with_young_estimates_and_flat_memory():
    assert row().faults == ()
    for fault in ({"received": 99}, {"lost": 1}, {"dropped": 1}, {"corrupt": 1}):
        assert row(**fault).faults == ("lost",)
    assert row(age_p99=0.051).faults == ("old",)
    assert row(age_p99=float("nan")).faults == ("old",)
    growing = speed.Use(name="record", cpu=0.2, per_message=1e-4, memory=1e8, growth=6e6)
    assert row(uses=(growing,), seconds=speed.LONG).faults == ("grows",)
    assert row(uses=(growing,)).faults == (), "windows are still filling"
    assert row(ending=float("nan")).faults == ("does not follow",)


def test_a_pipeline_that_does_not_end_is_a_row_and_not_the_end_of_the_benchmark(monkeypatch):
    monkeypatch.setattr(speed, "PATIENCE", 0.0)
    found = speed.run(vehicles=1, seconds=1.0, settle=0.0, processes=1)
    (only,) = found.rows
    assert only.sent > 100 and only.faults == ("does not follow",)
    said = io.StringIO()
    for table in found.tables():
        Console(width=200, file=said).print(table)
    assert "does not follow" in said.getvalue()


def test_three_processes_receive_all_that_is_sent():
    found = speed.run(vehicles=2, seconds=3.0, settle=1.0)
    (only,) = found.rows
    assert only.sent == only.received > 2000
    assert only.lost == only.dropped == only.corrupt == 0
    assert only.estimates > 100 and only.recorded > 0
    assert 2.0 < only.ending < speed.PATIENCE
    assert [use.name for use in only.uses] == ["ingest", "estimate", "record"]
    assert all(use.cpu > 0 and use.memory > 1e7 for use in only.uses)
    said = io.StringIO()
    for table in found.tables():
        Console(width=200, file=said).print(table)
    assert "estimate" in said.getvalue() and f"{only.sent}" in said.getvalue()
