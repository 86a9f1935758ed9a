"""Datagrams over real sockets."""

from __future__ import annotations

import errno
import socket
import threading
import time

import pytest

from telemetry.archive import RawLog
from telemetry.frames import join
from telemetry.ingest import guarded, ingest
from telemetry.mavlink import Dialect
from telemetry.messages import Attitude, Event
from telemetry.sources import udp
from telemetry.sources.udp import UdpSource, parse_endpoint
from tests.telemetry.test_archive import FullDisk
from tests.telemetry.test_frames import frames_of, read
from tests.telemetry.wire import Sender

DIALECT = Dialect()


@pytest.fixture
def port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.0.1", 0))
        return sock.getsockname()[1]


def test_endpoints_are_loopback_unless_told_otherwise():
    assert parse_endpoint("udpin:14550") == ("udpin", "127.0.0.1", 14550)
    assert parse_endpoint("udpout:10.0.0.1:99") == ("udpout", "10.0.0.1", 99)


@pytest.mark.parametrize(
    "text", ["", "udpin", "udpin:", "udpin:x", "udpin:127.0.0.1:0", "udpin:1.2.3.4:70000", "tcp:1:2", "14550"]
)
def test_what_is_no_endpoint_is_refused_with_an_example(text):
    with pytest.raises(ValueError, match=r"no endpoint: write udpin:HOST:PORT"):
        parse_endpoint(text)


def test_a_busy_port_is_named(port):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", port))
        with pytest.raises(OSError, match=f"udpin:127.0.0.1:{port}: the port is in use"):
            UdpSource([f"udpin:127.0.0.1:{port}"], DIALECT)


def test_what_is_sent_is_archived_and_handed_out_in_order(port, tmp_path):
    sender = Sender()
    sent = [sender.attitude(i) for i in range(500)]
    source = UdpSource([f"udpin:127.0.0.1:{port}"], DIALECT, RawLog(tmp_path / "raw.tlog"))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        for i in range(0, 500, 2):
            sock.sendto(sent[i] + sent[i + 1], ("127.0.0.1", port))
    found = join(list(source.batches(idle=0.3)))
    assert [found.frame(i) for i in range(len(found))] == sent
    assert (found.t_rx[2::2] > found.t_rx[:-2:2]).all()
    assert frames_of(read((tmp_path / "raw.tlog").read_bytes())) == frames_of([found])


def test_calling_a_station_introduces_itself_and_hears_the_answer(port):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as station:
        station.bind(("127.0.0.1", port))
        station.settimeout(5)
        source = UdpSource([f"udpout:127.0.0.1:{port}"], DIALECT)
        hello, caller = station.recvfrom(300)
        assert hello[0] == 0xFD
        station.sendto(Sender().attitude(1), caller)
        found = join(list(source.batches(idle=0.3)))
    assert len(found) == 1


def test_stop_hands_out_what_was_received_and_frees_the_port(port):
    endpoint = f"udpin:127.0.0.1:{port}"
    source = UdpSource([endpoint], DIALECT, batch=0.5)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.sendto(Sender().attitude(1), ("127.0.0.1", port))
    threading.Timer(0.2, source.stop).start()
    begin = time.monotonic()
    assert sum(len(batch) for batch in source.batches()) == 1
    assert time.monotonic() - begin < 5
    UdpSource([endpoint], DIALECT).stop()


def test_a_full_disk_raises_an_alarm_and_the_samples_go_on(port, tmp_path):
    raw_log = RawLog(tmp_path / "raw.tlog")
    whole = raw_log._file
    raw_log._file = FullDisk(whole, 100)
    source = UdpSource([f"udpin:127.0.0.1:{port}"], DIALECT, raw_log)
    sender = Sender()

    def send():
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
            for i in range(40):
                if i == 20:
                    raw_log._file = whole
                sock.sendto(sender.attitude(1000 + 20 * i), ("127.0.0.1", port))
                time.sleep(0.02)

    thread = threading.Thread(target=send)
    thread.start()
    messages = list(guarded(ingest(source.batches(idle=0.5), ["0"], DIALECT), raw_log, lambda: source.dropped))
    thread.join()
    told = [text for m in messages if isinstance(m, Event) for text in m.text]
    assert any("ALARM" in text and "No space left on device" in text for text in told)
    assert any("raw telemetry is being kept again" in text for text in told)
    assert sum(len(m.t) for m in messages if isinstance(m, Attitude)) == 40


def test_stop_works_while_telemetry_goes_on(port):
    source = UdpSource([f"udpin:127.0.0.1:{port}"], DIALECT)
    sender, over = Sender(), threading.Event()

    def send():
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
            while not over.wait(0.002):
                sock.sendto(sender.attitude(1), ("127.0.0.1", port))

    thread = threading.Thread(target=send)
    thread.start()
    threading.Timer(0.3, source.stop).start()
    begin = time.monotonic()
    received = sum(len(batch) for batch in source.batches())
    took = time.monotonic() - begin
    over.set()
    thread.join()
    assert received > 0
    assert took < 3


class _LostNetwork:
    """A socket that complains now and then, as one does when the far end's network goes away."""

    def __init__(self, sock) -> None:
        self._sock, self._calls = sock, 0

    def recv(self, size: int) -> bytes:
        self._calls += 1
        if self._calls % 3 == 0:
            raise OSError(errno.EHOSTUNREACH, "No route to host")
        return self._sock.recv(size)

    def __getattr__(self, name):
        return getattr(self._sock, name)


def test_a_complaint_of_the_network_does_not_end_the_reception(port, monkeypatch):
    opened = udp._open
    monkeypatch.setattr(udp, "_open", lambda endpoint: _LostNetwork(opened(endpoint)))
    source = UdpSource([f"udpin:127.0.0.1:{port}"], DIALECT)
    sender = Sender()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        for i in range(30):
            sock.sendto(sender.attitude(i), ("127.0.0.1", port))
            time.sleep(0.005)
    assert sum(len(batch) for batch in source.batches(idle=0.3)) == 30
    assert source.troubles["No route to host"] > 0


def test_links_are_numbered_by_endpoint(port):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.0.1", 0))
        second = sock.getsockname()[1]
    source = UdpSource([f"udpin:127.0.0.1:{port}", f"udpin:127.0.0.1:{second}"], DIALECT)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.sendto(Sender(sysid=1).attitude(1), ("127.0.0.1", port))
        sock.sendto(Sender(sysid=2).attitude(1), ("127.0.0.1", second))
    found = join(list(source.batches(idle=0.3)))
    assert sorted(zip(found.link.tolist(), found.sysid.tolist(), strict=True)) == [(0, 1), (1, 2)]
