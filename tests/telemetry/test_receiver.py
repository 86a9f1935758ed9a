"""The receiver: every kind of endpoint alike, several at once, and passed on to ground stations and back."""

from __future__ import annotations

import socket
import tempfile
import time
from contextlib import ExitStack
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from telemetry.archive import RawLog
from telemetry.frames import Frames
from telemetry.ingest import ingest
from telemetry.messages import SENSORS
from telemetry.sources.receiver import Receiver
from tests.telemetry.receiving import DIALECT, Listening, Pty, evidence, free_port, in_order, replay, until
from tests.telemetry.wire import Sender

LOOPBACK = "127.0.0.1"


def datagrams() -> socket.socket:
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.bind((LOOPBACK, 0))
    sock.settimeout(10)
    return sock


def flight(count: int) -> list[bytes]:
    sender = Sender()
    return [
        frame
        for i in range(count)
        for frame in (
            sender.attitude(1000 + 20 * i, roll=0.01 * i),
            sender.pressure(1000 + 20 * i, 1000 - i),
            sender.gps(1000 + 20 * i, 47.0 + 1e-5 * i, 8.0, 500.0 + i),
        )
    ]


def samples(frames: Frames) -> list[tuple[str, str, bytes]]:
    """All samples, byte for byte, but for when they arrived."""
    spaced = {"t_rx": np.int64(10**18) + 10**7 * np.arange(len(frames)), "until": 2 * 10**18}
    columns = {name: getattr(frames, name) for name in frames.__dataclass_fields__}
    out: dict[tuple[str, str], bytes] = {}
    for message in ingest([Frames(**(columns | spaced))], ["0"], DIALECT):
        if isinstance(message, SENSORS):
            key = type(message).__name__, message.source
            values = [getattr(message, name) for name in message.__struct_fields__]
            arrays = [value.tobytes() for value in values if isinstance(value, np.ndarray)]
            out[key] = out.get(key, b"") + b"".join(arrays)
    return sorted((*key, value) for key, value in out.items())


def heard_over(kind: str, sent: list[bytes], piece: int) -> Frames:
    """The frames as they come out of an endpoint of this kind."""
    stream = b"".join(sent)
    pieces = [stream[i : i + piece] for i in range(0, len(stream), piece)]
    with ExitStack() as stack:
        if kind == "udp":
            port = free_port()
            source = stack.enter_context(Listening(f"udpin:{port}"))
            sock = stack.enter_context(datagrams())
            for frame in sent:
                sock.sendto(frame, (LOOPBACK, port))
        elif kind == "tcp":
            server = stack.enter_context(socket.create_server((LOOPBACK, 0)))
            source = stack.enter_context(Listening(f"tcp:{server.getsockname()[1]}"))
            connection = stack.enter_context(server.accept()[0])
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            for part in pieces:
                connection.sendall(part)
        elif kind == "tcpin":
            port = free_port(socket.SOCK_STREAM)
            source = stack.enter_context(Listening(f"tcpin:{port}"))
            connection = stack.enter_context(socket.create_connection((LOOPBACK, port)))
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            for part in pieces:
                connection.sendall(part)
        else:
            line = Pty()
            stack.callback(line.unplug)
            source = stack.enter_context(Listening(f"serial:{line.device}"))
            for part in pieces:
                line.write(part)
        until(lambda: len(source.got) >= len(sent))
    return source.all()


def test_the_same_frames_give_the_same_samples_over_every_kind_of_endpoint():
    sent = flight(30)
    udp, *others = [heard_over(kind, sent, 61) for kind in ("udp", "tcp", "tcpin", "serial")]
    assert [udp.frame(i) for i in range(len(udp))] == sent
    assert len(samples(udp)) >= 3
    for other in others:
        assert [other.frame(i) for i in range(len(other))] == sent
        assert samples(other) == samples(udp)


PARTS = st.lists(
    st.one_of(
        st.tuples(st.just("frame"), st.integers(0, 5000)),
        st.tuples(st.just("cut"), st.integers(1, 30)),
        st.tuples(st.just("unknown"), st.just(0)),
        st.tuples(st.just("noise"), st.binary(min_size=1, max_size=400)),
    ),
    max_size=20,
)


@settings(max_examples=25, deadline=None)
@given(PARTS, st.lists(st.integers(0, 4000), max_size=12))
def test_every_byte_of_a_stream_is_accounted_for_however_it_is_cut(parts, cuts):
    sender = Sender()
    stream = b""
    for kind, value in parts:
        if kind == "noise":
            stream += value
        elif kind == "unknown":
            stream += sender.unknown()
        else:
            stream += sender.attitude(7)[: None if kind == "frame" else value]
    edges = sorted({0, len(stream), *(cut for cut in cuts if cut < len(stream))})
    with tempfile.TemporaryDirectory() as folder, socket.create_server((LOOPBACK, 0)) as server:
        log = Path(folder) / "raw.tlog"
        with Listening(f"tcp:{server.getsockname()[1]}", raw_log=RawLog(log)) as source:
            with server.accept()[0] as connection:
                connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                for begin, end in pairwise(edges):
                    connection.sendall(stream[begin:end])
            until(lambda: "lost" in source.hear())
        assert source.bytes_in == len(stream)
        if stream:
            found = source.all()
            assert found.pending == 0
            assert evidence(replay(log, 1)) == evidence(found)


def test_pending_bytes_are_told_until_the_rest_comes():
    frame = Sender().attitude(1)
    with (
        socket.create_server((LOOPBACK, 0)) as server,
        Listening(f"tcp:{server.getsockname()[1]}") as source,
        server.accept()[0] as connection,
    ):
        connection.sendall(frame + frame[:10])
        until(lambda: source.got == [frame])
        assert source.collected[-1].pending == 10
        connection.sendall(frame[10:])
        until(lambda: source.got == [frame, frame])
        assert source.collected[-1].pending == 0


def test_links_of_every_kind_are_numbered_by_endpoint_and_in_order_of_time(tmp_path):
    ports = [free_port(), free_port(), free_port(), free_port()]
    with ExitStack() as stack:
        server = stack.enter_context(socket.create_server((LOOPBACK, 0)))
        endpoints = [*(f"udpin:{port}" for port in ports), f"tcp:{server.getsockname()[1]}"]
        source = stack.enter_context(Listening(*endpoints, raw_log=RawLog(tmp_path / "raw.tlog", links=5)))
        sock, connection = stack.enter_context(datagrams()), stack.enter_context(server.accept()[0])
        for i in range(200):
            for link, port in enumerate(ports):
                sock.sendto(Sender(sysid=link + 1).attitude(i), (LOOPBACK, port))
            connection.sendall(Sender(sysid=5).attitude(i))
        until(lambda: len(source.got) == 1000)
    found = source.all()
    assert source.links == ["0", "1", "2", "3", "4"]
    assert (found.link + 1 == found.sysid).all()
    assert in_order(found)
    assert all(batch.until >= int(batch.t_rx[-1]) for batch in source.collected)
    assert all(int(b.t_rx[0]) > a.until for a, b in pairwise(source.collected))
    assert evidence(replay(tmp_path / "raw.tlog", 5)) == evidence(found)


def test_a_silence_is_told_by_empty_batches_and_what_follows_is_later():
    port, silent, ends = free_port(), [], []
    source = Receiver([f"udpin:{port}"], DIALECT)
    with datagrams() as sock:
        for batch in source.batches():
            if len(batch.data):
                ends.append(int(batch.t_rx[0]))
                break
            assert not len(batch) and not batch.pending
            silent.append(batch.until)
            if len(silent) == 3:
                sock.sendto(Sender().attitude(1), (LOOPBACK, port))
        source.stop()
        source.join()
    assert all(b > a for a, b in pairwise(silent + ends))


def test_a_consumer_that_was_busy_gets_all_that_has_come_meanwhile_in_one_batch():
    port, sender = free_port(), Sender()
    source = Receiver([f"udpin:{port}"], DIALECT, batch=0.001)
    with datagrams() as sock:
        for number in range(12):
            sock.sendto(sender.attitude(number), (LOOPBACK, port))
            time.sleep(0.02)
        time.sleep(0.1)
        source.stop()
    got = [batch for batch in source.batches() if len(batch)]
    source.join()
    assert sum(map(len, got)) == 12
    assert len(got) <= 2  # the empty ones of a silence count among those that are handed out together


def test_sixteen_endpoints_are_the_most():
    with pytest.raises(ValueError, match="17 endpoints: 1 to 16 can be received"):
        Receiver([f"udpin:{port}" for port in range(20001, 20018)], DIALECT)


def test_a_log_that_goes_on_is_never_dated_back(tmp_path):
    port = free_port()
    log = RawLog(tmp_path / "raw.tlog")
    log.reached = time.time_ns() + 3600 * 10**9  # the clock was an hour ahead when the log was begun
    with Listening(f"udpin:{port}", raw_log=log) as source, datagrams() as sock:
        sock.sendto(Sender().attitude(1), (LOOPBACK, port))
        until(lambda: len(source.got) == 1)
        time.sleep(0.05)
        sock.sendto(Sender().attitude(2), (LOOPBACK, port))
        until(lambda: len(source.got) == 2)
    first, second = source.all().t_rx.tolist()
    assert first > log.reached
    assert second - first > 40_000_000  # and time goes on as it should
    assert "3600.0 s behind the end of the raw log" in source.hear()


def test_a_full_disk_does_not_end_the_reception(tmp_path):
    from tests.telemetry.test_archive import no_file_longer_than

    port, log = free_port(), tmp_path / "raw.tlog"
    raw_log = RawLog(log)
    sender = Sender()
    with Listening(f"udpin:{port}", raw_log=raw_log) as source, datagrams() as sock:
        with no_file_longer_than(300):
            for i in range(40):
                sock.sendto(sender.attitude(i), (LOOPBACK, port))
            until(lambda: len(source.got) == 40 and raw_log.error)
        until(lambda: raw_log.error is None)
    assert evidence(replay(log, 1)) == evidence(source.all())


# Forwarding


def test_what_the_vehicle_says_goes_to_the_ground_station_and_back_unchanged(tmp_path):
    port = free_port()
    log = RawLog(tmp_path / "raw.tlog", links=2)
    with datagrams() as vehicle, datagrams() as ground:
        forward = f"udpout:{ground.getsockname()[1]}"
        with Listening(f"udpin:{port}", forward=[forward], raw_log=log) as source:
            said = [Sender().attitude(1), b"no frame at all", Sender(seq=1).unknown(), Sender().attitude(2)[:20]]
            for datagram in said:
                vehicle.sendto(datagram, (LOOPBACK, port))
            received = [ground.recvfrom(65535) for _ in said]
            assert [datagram for datagram, _ in received] == said
            answers = [Sender(sysid=255).heartbeat(), b"\xfd what the station says, too"]
            for answer in answers:
                ground.sendto(answer, received[0][1])
            assert [vehicle.recv(65535) for _ in answers] == answers
            until(lambda: source.bytes_in == sum(map(len, said + answers)))
    found = source.all()
    assert source.links == ["0", "1"]
    assert sorted(zip(found.link.tolist(), found.sysid.tolist(), strict=True)) == [(0, 1), (0, 1), (1, 255)]
    assert evidence(replay(tmp_path / "raw.tlog", 2)) == evidence(found)


def test_a_mark_said_over_a_ground_station_is_a_frame_like_any_other():
    port = free_port()
    with (
        datagrams() as ground,
        datagrams() as vehicle,
        Listening(f"udpin:{port}", forward=[f"udpout:{ground.getsockname()[1]}"]) as source,
    ):
        vehicle.sendto(Sender().attitude(1), (LOOPBACK, port))
        _, here = ground.recvfrom(65535)
        mark = Sender(sysid=255, compid=190).text("TP start phugoid")
        ground.sendto(mark, here)
        until(lambda: mark in source.got)


def test_all_kinds_are_forwarded_to_all_kinds_whole_and_unchanged():
    port, served, kept = free_port(), free_port(socket.SOCK_STREAM), free_port()
    line, radio = Pty(), Pty()
    udp_sent, tcp_sent, line_sent = ([Sender(sysid=n).attitude(i) for i in range(20)] for n in (1, 2, 3))
    with ExitStack() as stack:
        for pty in (line, radio):
            stack.callback(pty.unplug)
        server = stack.enter_context(socket.create_server((LOOPBACK, 0)))
        ground = stack.enter_context(datagrams())
        source = stack.enter_context(
            Listening(
                f"udpin:{port}",
                f"tcp:{server.getsockname()[1]}",
                f"serial:{line.device}",
                forward=[
                    f"udpout:{ground.getsockname()[1]}",
                    f"tcpin:{served}",
                    f"serial:{radio.device}:115200",
                    f"udpin:{kept}",
                ],
            )
        )
        vehicle, asks = stack.enter_context(datagrams()), stack.enter_context(datagrams())
        connection = stack.enter_context(server.accept()[0])
        station = stack.enter_context(socket.create_connection((LOOPBACK, served)))
        hello = Sender(sysid=254).heartbeat()
        asks.sendto(hello, (LOOPBACK, kept))
        until(lambda: source.got == [hello] and "connected" in source.hear())
        until(lambda: source.hear().count("connected") == 2)
        streams = b"".join(tcp_sent), b"".join(line_sent)
        for i in range(0, len(streams[0]), 31):  # no frame of a stream comes in one piece
            connection.sendall(streams[0][i : i + 31])
            line.write(streams[1][i : i + 31])
            if udp_sent:
                vehicle.sendto(udp_sent.pop(0), (LOOPBACK, port))
        for frame in udp_sent:
            vehicle.sendto(frame, (LOOPBACK, port))
        sent = sorted([Sender(sysid=1).attitude(i) for i in range(20)] + tcp_sent + line_sent)
        size = sum(map(len, sent))
        assert sorted(ground.recv(65535) for _ in sent) == sent
        assert sorted(asks.recv(65535) for _ in sent) == sent
        over_tcp, over_radio = bytearray(), bytearray()
        station.settimeout(10)
        while len(over_tcp) < size:
            over_tcp += station.recv(65536)

        def radio_has_it() -> bool:
            over_radio.extend(radio.read())
            return len(over_radio) >= size

        until(radio_has_it)
        for stream in (bytes(over_tcp), bytes(over_radio)):
            frames = []
            while stream:
                length = stream[1] + 12
                frames.append(stream[:length])
                stream = stream[length:]
            assert sorted(frames) == sent
        answer = Sender(sysid=255).attitude(3)
        station.sendall(answer[:11])
        station.sendall(answer[11:])
        assert vehicle.recv(65535) == answer
        connection.settimeout(10)
        over_tcp.clear()
        while not over_tcp.endswith(answer):
            over_tcp += connection.recv(65536)
        over_radio.clear()

        def line_has_it() -> bool:
            over_radio.extend(line.read())
            return over_radio.endswith(answer)

        until(line_has_it)
        assert bytes(over_tcp).removeprefix(hello) == answer


def test_nothing_goes_back_to_the_port_it_came_from():
    port = free_port()
    with datagrams() as both, datagrams() as other:
        forward = [f"udpout:{both.getsockname()[1]}", f"udpout:{other.getsockname()[1]}"]
        with Listening(f"udpin:{port}", forward=forward) as source:
            frames = [Sender().attitude(i) for i in range(5)]
            for frame in frames:
                both.sendto(frame, (LOOPBACK, port))
            assert [other.recv(65535) for _ in frames] == frames
            until(lambda: source.got == frames)
            both.settimeout(0.2)
            with pytest.raises(TimeoutError):
                both.recv(65535)


def test_what_a_sender_is_told_is_never_what_it_said_itself():
    port, ground_port = free_port(), free_port()
    with Listening(f"udpin:{port}", forward=[f"udpin:{ground_port}"]) as source, datagrams() as both:
        hello, frame = Sender(sysid=255).heartbeat(), Sender().attitude(1)
        both.sendto(hello, (LOOPBACK, ground_port))
        until(lambda: len(source.got) == 1)
        both.sendto(frame, (LOOPBACK, port))
        until(lambda: len(source.got) == 2)
        both.settimeout(0.2)
        with pytest.raises(TimeoutError):
            both.recv(65535)


def test_bytes_of_a_stream_that_are_no_frame_are_forwarded_too():
    sent = Sender().attitude(1) + b"no frame" + Sender(seq=1).attitude(2)
    with (
        datagrams() as ground,
        socket.create_server((LOOPBACK, 0)) as server,
        Listening(f"tcp:{server.getsockname()[1]}", forward=[f"udpout:{ground.getsockname()[1]}"]),
        server.accept()[0] as connection,
    ):
        connection.sendall(sent)
        assert b"".join(ground.recv(65535) for _ in range(3)) == sent


@pytest.mark.parametrize(("listens", "calls"), [("udpin", "udpout"), ("tcpin", "tcp")])
def test_forwarding_to_an_endpoint_of_ours_is_refused(listens, calls):
    with pytest.raises(ValueError, match=f"{calls}:127.0.0.1:14599 calls {listens}:0.0.0.0:14599, which is"):
        Receiver([f"{listens}:0.0.0.0:14599"], DIALECT, forward=[f"{calls}:14599"])


def through(forward: list[str], count: int = 3000, size: int = 0) -> Listening:
    """What came of so many datagrams while they were forwarded there."""
    port, sender = free_port(), Sender()
    with Listening(f"udpin:{port}", forward=forward) as source, datagrams() as vehicle:
        for i in range(count):
            vehicle.sendto(sender.attitude(i) + bytes(size), (LOOPBACK, port))
            if i % 100 == 99:  # no faster than the socket's buffer, so that nothing else is lost
                until(lambda i=i: len(source.got) > i - 1000)
        until(lambda: len(source.got) == count)
    return source


def test_ground_stations_that_are_absent_do_not_hold_up_the_reception():
    source = through([f"udpout:{free_port()}", f"tcp:{free_port(socket.SOCK_STREAM)}", f"udpin:{free_port()}"])
    told = source.hear()
    for why in ("nobody listens there", "not connected", "nobody has been heard there"):
        assert why in told
        assert any(why in text and count > 100 for text, count in source.troubles.items())
    assert sum("nobody has been heard" in text for _, _, text in source.told) == 4  # 1, 10, 100 and 1000 times


def test_a_ground_station_that_does_not_read_loses_whole_frames_and_the_others_none():
    line = Pty()
    with socket.create_server((LOOPBACK, 0)) as server, datagrams() as ground:
        server.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        tcp, udp = (f"{kind}:{sock.getsockname()[1]}" for kind, sock in (("tcp", server), ("udpout", ground)))
        sender, port = Sender(), free_port()
        forward = [tcp, udp, f"serial:{line.device}"]
        with Listening(f"udpin:{port}", forward=forward) as source, datagrams() as vehicle:
            station = server.accept()[0]
            with station:
                until(lambda: "connected" in source.hear())
                sent = []
                while not any("does not follow" in text and "tcp" in text for text in source.troubles):
                    sent += [sender.text(f"{len(sent)} {'x' * 40}") for _ in range(100)]
                    for frame in sent[-100:]:
                        vehicle.sendto(frame, (LOOPBACK, port))
                        assert ground.recv(65535) == frame
                until(lambda: source.got == sent)
                assert any("does not follow" in text and "serial" in text for text in source.troubles)
                station.settimeout(0.5)
                stream = bytearray()
                try:
                    while piece := station.recv(1 << 20):
                        stream += piece
                except TimeoutError:
                    pass
        line.unplug()
    whole = set(sent)
    while stream:
        frame = bytes(stream[: stream[1] + 12])
        assert frame in whole
        del stream[: len(frame)]


def test_a_ground_station_that_comes_later_is_served_from_then_on():
    port, served = free_port(), free_port(socket.SOCK_STREAM)
    with Listening(f"udpin:{port}", forward=[f"tcp:{served}"]) as source, datagrams() as vehicle:
        vehicle.sendto(Sender().attitude(1), (LOOPBACK, port))
        until(lambda: any("not connected" in text for text in source.troubles))
        with socket.create_server((LOOPBACK, served)) as server, server.accept()[0] as station:
            until(lambda: "connected" in source.hear().replace("not connected", ""))
            second = Sender(seq=1).attitude(2)
            vehicle.sendto(second, (LOOPBACK, port))
            station.settimeout(10)
            assert station.recv(65536) == second


def test_of_many_senders_those_heard_last_are_answered():
    port = free_port()
    with Listening(f"udpin:{port}", forward=[f"udpin:{free_port()}"]) as source, ExitStack() as stack:
        senders = [stack.enter_context(datagrams()) for _ in range(20)]
        for i, sender in enumerate(senders):
            sender.sendto(Sender(sysid=i + 1).heartbeat(), (LOOPBACK, port))
            until(lambda i=i: len(source.got) == i + 1)
        station, ground = stack.enter_context(datagrams()), source.endpoints[1].port
        station.sendto(Sender(sysid=255).heartbeat(), (LOOPBACK, ground))
        for sender in senders[4:]:
            assert sender.recv(300) == Sender(sysid=255).heartbeat()
        for sender in senders[:4]:
            sender.setblocking(False)
            with pytest.raises(BlockingIOError):
                sender.recv(300)
