"""TCP connections over real sockets: lost, made again, shared."""

from __future__ import annotations

import socket
import struct

import pytest

from telemetry.archive import RawLog
from telemetry.sources.receiver import Receiver
from tests.telemetry.receiving import DIALECT, Listening, evidence, free_port, in_order, replay, until
from tests.telemetry.wire import Sender


@pytest.fixture
def port() -> int:
    return free_port(socket.SOCK_STREAM)


def serve(port: int) -> socket.socket:
    server = socket.create_server(("127.0.0.1", port))
    server.settimeout(10)
    return server


def test_a_server_that_is_not_there_yet_is_connected_to_when_it_is(port):
    with Listening(f"tcp:127.0.0.1:{port}") as source:
        until(lambda: any("Connection refused" in text for text in source.troubles))
        with serve(port) as server, server.accept()[0] as connection:
            connection.sendall(Sender().attitude(1))
            until(lambda: len(source.got) == 1)
    assert f"link 0: tcp:127.0.0.1:{port}: Connection refused" in source.hear()
    assert f"link 0: tcp:127.0.0.1:{port}: connected" in source.hear()


def test_a_lost_connection_is_made_again_and_the_other_links_go_on_meanwhile(port, tmp_path):
    other, sender, second = free_port(), Sender(), Sender(sysid=2)
    endpoints = f"tcp:127.0.0.1:{port}", f"udpin:127.0.0.1:{other}"
    with (
        Listening(*endpoints, raw_log=RawLog(tmp_path / "raw.tlog", links=2)) as source,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock,
    ):
        with serve(port) as server, server.accept()[0] as connection:
            frame = sender.attitude(1)
            connection.sendall(frame + sender.attitude(2)[:20])
            until(lambda: len(source.got) == 1)
        until(lambda: f"link 0: tcp:127.0.0.1:{port}: lost: the far end closed it" in source.hear())
        for i in range(5):
            sock.sendto(second.attitude(i), ("127.0.0.1", other))
        until(lambda: len(source.got) == 6)
        with serve(port) as server, server.accept()[0] as connection:
            connection.sendall(sender.attitude(3))
            until(lambda: len(source.got) == 7)
    found = source.all()
    assert found.link.tolist() == [0, 1, 1, 1, 1, 1, 0]
    assert found.junk(0) == Sender(seq=1).attitude(2)[:20]
    assert found.discarded == 20
    assert found.t_rx[0] < found.junk_t_rx[0] < found.t_rx[1]
    assert in_order(found)
    assert evidence(replay(tmp_path / "raw.tlog", 2)) == evidence(found)


def test_a_connection_that_is_reset_gives_what_came_before(port):
    with Listening(f"tcp:127.0.0.1:{port}") as source, serve(port) as server:
        connection = server.accept()[0]
        connection.sendall(Sender().attitude(1))
        until(lambda: len(source.got) == 1)
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        connection.close()  # now a reset
        until(lambda: "lost: Connection reset by peer" in source.hear())
        with server.accept()[0] as connection:
            connection.sendall(Sender(seq=1).attitude(2))
            until(lambda: len(source.got) == 2)


def test_frames_cut_anywhere_between_pieces_are_whole(port):
    sender = Sender()
    sent = [sender.attitude(i) for i in range(40)]
    with Listening(f"tcp:127.0.0.1:{port}") as source, serve(port) as server, server.accept()[0] as connection:
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        stream = b"".join(sent)
        for i in range(0, len(stream), 17):
            connection.sendall(stream[i : i + 17])
        until(lambda: len(source.got) == 40)
    assert source.got == sent
    assert source.all().discarded == 0


def test_several_clients_of_a_server_do_not_mix_their_frames(port):
    senders = [Sender(sysid=sysid) for sysid in (1, 2, 3)]
    streams = [b"".join(sender.attitude(i) for i in range(30)) for sender in senders]
    with Listening(f"tcpin:127.0.0.1:{port}") as source:
        clients = [socket.create_connection(("127.0.0.1", port)) for _ in streams]
        for client, stream in zip(clients, streams, strict=True):
            client.sendall(stream[:50])  # a frame and the beginning of the next
        until(lambda: len(source.got) == 3)
        for client, stream in zip(clients, streams, strict=True):
            client.sendall(stream[50:])
        until(lambda: len(source.got) == 90)
        for client in clients:
            client.close()
        until(lambda: source.hear().count("lost: the far end closed it") == 3)
    found = source.all()
    assert found.discarded == 0
    for sysid in (1, 2, 3):
        mine = found.select(found.sysid == sysid)
        assert b"".join(mine.frame(i) for i in range(len(mine))) == streams[sysid - 1]
    assert found.link.tolist() == [0] * 90


def test_a_served_port_in_use_is_named(port):
    with serve(port), pytest.raises(OSError, match=f"tcpin:127.0.0.1:{port}: the port is in use"):
        Receiver([f"tcpin:127.0.0.1:{port}"], DIALECT)


def test_stop_frees_the_served_port_although_a_client_is_there(port):
    with Listening(f"tcpin:127.0.0.1:{port}"), socket.create_connection(("127.0.0.1", port)) as client:
        client.sendall(Sender().attitude(1))
    Receiver([f"tcpin:127.0.0.1:{port}"], DIALECT).stop()


def test_more_clients_than_can_be_are_refused(port):
    with Listening(f"tcpin:127.0.0.1:{port}") as source:
        clients = [socket.create_connection(("127.0.0.1", port)) for _ in range(17)]
        clients[16].settimeout(10)
        assert clients[16].recv(1) == b""
        clients[0].sendall(Sender().attitude(1))
        until(lambda: len(source.got) == 1)
        for client in clients:
            client.close()
    assert "a client was refused: there are 16" in source.hear()


def test_clients_that_come_and_go_are_told_in_bounded_number(port):
    with Listening(f"tcpin:127.0.0.1:{port}") as source:
        for _ in range(120):
            with socket.create_connection(("127.0.0.1", port)) as client:
                client.shutdown(socket.SHUT_WR)
                assert client.recv(1) == b""  # the receiver has seen it go
        with socket.create_connection(("127.0.0.1", port)) as last:
            last.sendall(Sender().attitude(1))
            until(lambda: len(source.got) == 1)
    told = source.hear()
    assert told.count(" connected") == 21  # the first 20, and the 100th
    assert told.count(" lost") <= 21
