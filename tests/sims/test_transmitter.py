"""Frames arrive over a real socket, at the pace asked for; a .tlog holds the same flight."""

import math
import socket
import struct
import threading
import time

import pytest

import sims
from sims.faults import FaultError
from sims.transmitter import EndpointError, parse_endpoint, write_tlog

from .conftest import UTC


class Receiver:
    """Reads datagrams on a loopback port until it is closed."""

    def __init__(self):
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", 0))
        self.socket.settimeout(0.3)
        self.endpoint = f"udpout:127.0.0.1:{self.socket.getsockname()[1]}"
        self.got = []
        self.stop = threading.Event()
        self.thread = threading.Thread(target=self.read, daemon=True)

    def read(self):
        while True:
            try:
                self.got.append((time.monotonic(), self.socket.recv(2048)))
            except TimeoutError:
                if self.stop.is_set():
                    return

    def __enter__(self):
        self.thread.start()
        return self

    def __exit__(self, *_):
        self.stop.set()
        self.thread.join()
        self.socket.close()


def together(frames, receiver, share=1.0):
    """The frames, never more of them ahead of a receiver on a busy machine than the buffer of its socket holds."""
    for i, item in enumerate(frames):
        end = time.monotonic() + 20.0
        while share * i - len(receiver.got) > 100:
            assert time.monotonic() < end, f"{len(receiver.got)} of {i} frames arrived"
            time.sleep(1e-3)
        yield item


def test_every_frame_arrives_at_full_speed(sent):
    told = []
    with Receiver() as receiver:
        frames = together(sent, receiver)
        report = sims.send(frames, receiver.endpoint, speed=math.inf, progress=lambda *where: told.append(where))
    assert [data for _, data in receiver.got] == [frame for _, frame in sent]
    assert report.datagrams == len(sent)
    assert report.octets == sum(len(frame) for _, frame in sent)
    assert report.flown == 170
    assert report.injected.offered == report.injected.delivered == len(sent)
    assert told[-1] == (170, len(sent))
    assert told == sorted(told)


def test_the_pace_is_the_one_asked_for(sent):
    four = [item for item in sent if item[0] < 8_000_000_000]
    for _ in range(5):  # a busy machine is late now and then
        with Receiver() as receiver:
            report = sims.send(four, receiver.endpoint, speed=4.0)
        start = receiver.got[0][0]
        late = [at - start - (t - four[0][0]) * 1e-9 / 4 for (at, _), (t, _) in zip(receiver.got, four, strict=True)]
        median = sorted(late)[len(late) // 2]
        if report.took == pytest.approx(1.0, abs=0.1) and median < 0.02:
            return
    pytest.fail(f"4 s took {report.took} s at four times their pace, frames were late by {median} s")


def test_faults_are_injected_on_the_way(sent):
    some = sent[:3000]
    with Receiver() as receiver:
        frames, faults = together(some, receiver, 0.9), "loss=0.1,duplicate=0.05,corrupt=0.02"
        report = sims.send(frames, receiver.endpoint, speed=math.inf, faults=faults)
    assert len(receiver.got) == report.injected.delivered == report.datagrams
    good = {frame for _, frame in some}
    assert sum(data not in good for _, data in receiver.got) == report.injected.corrupted > 0
    assert report.injected.lost > 0


def test_nobody_listening_is_no_error(sent):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    assert sims.send(sent[:200], f"udpout:{port}", speed=math.inf).datagrams == 200


@pytest.mark.parametrize(
    ("endpoint", "parsed"),
    [
        ("udpout:127.0.0.1:14550", ("127.0.0.1", 14550)),
        ("udpout:14550", ("127.0.0.1", 14550)),
        ("udpout:[::1]:14550", ("::1", 14550)),
        ("udpout:ground.example:1", ("ground.example", 1)),
    ],
)
def test_endpoints(endpoint, parsed):
    assert parse_endpoint(endpoint) == parsed


@pytest.mark.parametrize("endpoint", ["", "127.0.0.1:14550", "tcp:127.0.0.1:5760", "udpin:127.0.0.1:14550", "udpout"])
def test_only_udpout_is_an_endpoint_of_a_vehicle(endpoint):
    with pytest.raises(EndpointError, match=r"as in udpout:127\.0\.0\.1:14550"):
        sims.send([], endpoint)


@pytest.mark.parametrize("endpoint", ["udpout:127.0.0.1", "udpout:127.0.0.1:0", "udpout:host:99999", "udpout:host:x"])
def test_a_port_is_a_number(endpoint):
    with pytest.raises(EndpointError, match="is not a port from 1 to 65535"):
        sims.send([], endpoint)


def test_wrong_speeds_and_faults_are_refused_before_anything_is_sent():
    for speed in (0.0, -1.0, math.nan):
        with pytest.raises(ValueError, match="positive factor"):
            sims.send([], "udpout:14550", speed=speed)
    with pytest.raises(FaultError):
        sims.send([], "udpout:14550", faults="rain=1")


def test_a_tlog_holds_the_same_frames(sent, tmp_path):
    path = tmp_path / "flight.tlog"
    assert write_tlog(sent, path, UTC) == len(sent)
    data, at, frames = path.read_bytes(), 0, []
    while at < len(data):
        (stamp,) = struct.unpack_from(">Q", data, at)
        size = 12 + data[at + 9]
        frames.append((stamp * 1000 - UTC + sent[0][0], data[at + 8 : at + 8 + size]))
        at += 8 + size
    assert frames == sent


def test_the_vehicle_offers_its_transmitter():
    from sims import vehicle

    assert vehicle.send is sims.send
    assert vehicle.write_tlog is sims.write_tlog
