"""Datagrams over real sockets."""

from __future__ import annotations

import socket
import threading
import time

import pytest

from telemetry.archive import RawLog
from telemetry.sources.endpoint import Endpoint, leads_to, parse_endpoint
from telemetry.sources.receiver import Receiver
from tests.telemetry.receiving import DIALECT, Listening, evidence, free_port, replay, until
from tests.telemetry.wire import Sender


@pytest.fixture
def port() -> int:
    return free_port()


@pytest.mark.parametrize(
    ("text", "endpoint"),
    [
        ("udpin:14550", Endpoint("udpin", "127.0.0.1", 14550)),
        ("udpout:10.0.0.1:99", Endpoint("udpout", "10.0.0.1", 99)),
        ("tcp:5760", Endpoint("tcp", "127.0.0.1", 5760)),
        ("tcpin:0.0.0.0:5760", Endpoint("tcpin", "0.0.0.0", 5760)),
        ("udpin:[::1]:14550", Endpoint("udpin", "::1", 14550)),
        ("serial:/dev/ttyUSB0", Endpoint("serial", device="/dev/ttyUSB0", baud=57600)),
        ("serial:/dev/ttyACM0:921600", Endpoint("serial", device="/dev/ttyACM0", baud=921600)),
        (
            "serial:/dev/serial/by-path/pci-0000:00:14.0-usb-0:1:1.0-port0",
            Endpoint("serial", device="/dev/serial/by-path/pci-0000:00:14.0-usb-0:1:1.0-port0", baud=57600),
        ),
    ],
)
def test_endpoints_are_loopback_and_57600_baud_unless_told_otherwise(text, endpoint):
    assert parse_endpoint(text) == endpoint
    assert parse_endpoint(str(endpoint)) == endpoint


@pytest.mark.parametrize(
    "text",
    [
        "", "udpin", "udpin:", "udpin:x", "udpin:127.0.0.1:0", "udpin:1.2.3.4:70000", "14550", "udp:1.2.3.4:5",
        "udpin:::1:14550", "udpin:[]:5", "udpin:١٢", "tcp:", "serial", "serial:", "serial::57600",
    ],
)  # fmt: skip
def test_what_is_no_endpoint_is_refused_with_an_example(text):
    with pytest.raises(ValueError, match=r"no endpoint: write udpin:HOST:PORT.*e\.g\. udpin:127\.0\.0\.1:14550"):
        parse_endpoint(text)


def test_a_busy_port_is_named(port):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", port))
        with pytest.raises(OSError, match=f"udpin:127.0.0.1:{port}: the port is in use"):
            Receiver([f"udpin:127.0.0.1:{port}"], DIALECT)


def test_a_host_that_cannot_be_is_named():
    with pytest.raises(OSError, match=r"udpout:no\.such\.host\.invalid:5: no host 'no\.such\.host\.invalid' is known"):
        Receiver(["udpout:no.such.host.invalid:5"], DIALECT)


@pytest.mark.parametrize(
    ("caller", "listener", "leads"),
    [
        ("udpout:127.0.0.1:5", "udpin:127.0.0.1:5", True),
        ("udpout:127.0.0.1:5", "udpin:0.0.0.0:5", True),
        ("tcp:127.0.0.1:5", "tcpin:127.0.0.1:5", True),
        ("udpout:127.0.0.1:5", "udpin:127.0.0.1:6", False),
        ("udpout:127.0.0.1:5", "tcpin:127.0.0.1:5", False),
        ("udpout:192.0.2.1:5", "udpin:0.0.0.0:5", False),
        ("udpin:127.0.0.1:5", "udpin:127.0.0.1:5", False),
    ],
)
def test_an_endpoint_that_calls_another_one_of_ours_is_found_out(caller, listener, leads):
    assert leads_to(parse_endpoint(caller), parse_endpoint(listener)) == leads


def test_what_is_sent_is_archived_and_handed_out_in_order(port, tmp_path):
    sender = Sender()
    sent = [sender.attitude(i) for i in range(500)]
    with Listening(f"udpin:127.0.0.1:{port}", raw_log=RawLog(tmp_path / "raw.tlog")) as source:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
            for i in range(0, 500, 2):
                sock.sendto(sent[i] + sent[i + 1], ("127.0.0.1", port))
        until(lambda: len(source.got) == 500)
    found = source.all()
    assert source.got == sent
    assert (found.t_rx[2::2] > found.t_rx[:-2:2]).all()
    assert evidence(replay(tmp_path / "raw.tlog", 1)) == evidence(found)


def test_ipv6_is_heard_as_well(port):
    try:
        with socket.socket(socket.AF_INET6, socket.SOCK_DGRAM) as sock:
            sock.bind(("::1", 0))
    except OSError:
        pytest.skip("this machine has no IPv6")
    with Listening(f"udpin:[::1]:{port}") as source, socket.socket(socket.AF_INET6, socket.SOCK_DGRAM) as sock:
        sock.sendto(Sender().attitude(1), ("::1", port))
        until(lambda: len(source.got) == 1)


def test_calling_a_station_introduces_itself_and_hears_the_answer(port):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as station:
        station.bind(("127.0.0.1", port))
        station.settimeout(5)
        with Listening(f"udpout:127.0.0.1:{port}") as source:
            hello, caller = station.recvfrom(300)
            assert hello[0] == 0xFD
            station.sendto(Sender().attitude(1), caller)
            until(lambda: len(source.got) == 1)


def test_a_station_that_is_not_there_yet_is_a_trouble_and_is_heard_when_it_is(port):
    with Listening(f"udpout:127.0.0.1:{port}") as source:
        until(lambda: any("Connection refused" in text for text in source.troubles))
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as station:
            station.bind(("127.0.0.1", port))
            station.settimeout(5)
            _, caller = station.recvfrom(300)
            station.sendto(Sender().attitude(1), caller)
            until(lambda: len(source.got) == 1)
    assert "Connection refused" in source.hear()


def test_stop_hands_out_what_was_received_and_frees_the_port(port):
    endpoint = f"udpin:127.0.0.1:{port}"
    source = Receiver([endpoint], DIALECT, batch=0.5)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.sendto(Sender().attitude(1), ("127.0.0.1", port))
    threading.Timer(0.2, source.stop).start()
    begin = time.monotonic()
    assert sum(len(batch) for batch in source.batches()) == 1
    assert time.monotonic() - begin < 5
    Receiver([endpoint], DIALECT).stop()


def test_it_stops_by_itself_after_a_silence(port):
    source = Receiver([f"udpin:127.0.0.1:{port}"], DIALECT)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.sendto(Sender().attitude(1), ("127.0.0.1", port))
    assert sum(len(batch) for batch in source.batches(idle=0.2)) == 1


def test_stop_works_while_telemetry_goes_on(port):
    source = Receiver([f"udpin:127.0.0.1:{port}"], DIALECT)
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


class HeldUp(RawLog):
    """A log whose first write takes as long as it is told to."""

    def __init__(self, path) -> None:
        super().__init__(path)
        self.begun, self.go_on = threading.Event(), threading.Event()

    def write(self, frames) -> None:
        self.begun.set()
        self.go_on.wait(20)
        super().write(frames)


def test_what_the_kernel_drops_is_counted_apart(port, tmp_path):
    raw_log = HeldUp(tmp_path / "raw.tlog")
    sent = 0
    with Listening(f"udpin:127.0.0.1:{port}", raw_log=raw_log) as source:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
            sock.sendto(Sender().attitude(1), ("127.0.0.1", port))
            assert raw_log.begun.wait(10)
            for _ in range(600):
                sent += sock.sendto(bytes(60_000), ("127.0.0.1", port))
        raw_log.go_on.set()
        until(lambda: len(Sender().attitude(1)) + sent == source.bytes_in + 60_000 * source.kernel_drops[0])
    assert source.kernel_drops[0] > 0
    assert f"the kernel dropped {source.kernel_drops[0]} datagrams" in source.hear()
    assert not source.dropped
