"""TCP: ``tcp`` connects to a server, ``tcpin`` is one.

A client whose server is not there, or has gone, tries again; connections may be silent for as long as they like, and
one whose far end has vanished without a word is found out by the kernel's keep-alive. Nothing is said by itself: what
offers telemetry over TCP sends to whoever connects.
"""

from __future__ import annotations

import errno
import os
import socket
import time
from selectors import EVENT_READ, EVENT_WRITE, BaseSelector

from telemetry.sources.endpoint import Endpoint, resolve
from telemetry.sources.port import Journal, Port
from telemetry.sources.stream import Retry, StreamChannel

CLIENTS = 16
ARRIVALS = 64  # accepted before the links have their turn
CONNECTING = 5.0  # s that a server's machine may take to answer
RECEIVE_BUFFER = 4 << 20
KEEP_ALIVE = {"TCP_KEEPIDLE": 10, "TCP_KEEPINTVL": 5, "TCP_KEEPCNT": 3}  # s, s, times


def open_port(
    endpoint: Endpoint, link: int, selector: BaseSelector, journal: Journal, *, two_way: bool, ground: bool
) -> Port:
    """Open ``tcp`` or ``tcpin`` (`telemetry.sources.port.open_port`)."""
    kind = ClientPort if endpoint.scheme == "tcp" else ServerPort
    return kind(endpoint, link, selector, journal)


class ClientPort:
    """A connection to a server, made again whenever it is lost."""

    stream = True

    def __init__(self, endpoint: Endpoint, link: int, selector: BaseSelector, journal: Journal) -> None:
        self.link = link
        self.origin: object = None
        self.closed = False
        self.kernel_drops = 0
        self._endpoint, self._selector, self._journal = endpoint, selector, journal
        self._name = f"link {link}: {endpoint}"
        self._family, self._address = resolve(endpoint, socket.SOCK_STREAM)
        self._socket: socket.socket | None = None
        self._channel: StreamChannel | None = None  # none while it is connecting
        self._retry = Retry()
        self._until = 0.0
        self.tick(time.monotonic())

    def tick(self, now: float) -> None:
        """Begin to connect when it is time; give up when it takes too long."""
        if self.closed:
            return
        if self._socket is None:
            if self._retry.due(now):
                self._connect(now)
        elif self._channel is None and now > self._until:
            self._failed("no answer")

    def read(self) -> bytes | None:
        """Nothing: it is watched itself only while it is connecting."""
        return None

    def flush(self) -> None:
        """The attempt to connect has come to an end."""
        sock = self._socket
        if sock is None or self._channel is not None:
            return
        error = sock.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)
        try:  # a port of this machine that nobody serves may by chance be the one that it calls from
            if not error and sock.getpeername() == sock.getsockname():
                error = errno.ECONNREFUSED
        except OSError as gone:
            error = gone.errno or errno.ENOTCONN
        if error:
            self._failed(os.strerror(error))
            return
        self._selector.unregister(sock)
        self._channel = StreamChannel(
            self._endpoint, self.link, self._selector, self._journal, sock, sock.recv, sock.send, self._lost
        )
        self._journal.tell("info", f"{self._name}: connected", f"{self._name} connected")

    def heard(self, origin: object) -> None:
        """There is only one who can be."""

    def send(self, unit: bytes, origin: object) -> None:
        """Write to the server."""
        if self._channel is None:
            self._journal.trouble(f"link {self.link}: not passed on to {self._endpoint}: not connected")
        else:
            self._channel.send(unit)

    def close(self) -> None:
        """Close the connection and make no other."""
        self.closed = True
        self._drop()

    def _connect(self, now: float) -> None:
        self._socket = socket.socket(self._family, socket.SOCK_STREAM)
        self._socket.setblocking(False)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER)
        _prepare(self._socket)
        self._until = now + CONNECTING
        self._selector.register(self._socket, EVENT_WRITE, self)
        error = self._socket.connect_ex(self._address)
        if error not in (0, errno.EINPROGRESS):
            self._failed(os.strerror(error))

    def _failed(self, why: str) -> None:
        self._journal.trouble(f"{self._name}: {why}: trying again")
        self._drop()

    def _lost(self, channel: StreamChannel, why: str) -> None:
        if channel.received:
            self._retry.forget()
        self._journal.tell("warning", f"{self._name}: lost: {why}; trying again", f"{self._name} lost")
        self._drop()

    def _drop(self) -> None:
        if self._socket is not None:
            if self._channel is None:
                self._selector.unregister(self._socket)
            else:
                self._channel.close()
            self._socket.close()
        self._socket = self._channel = None
        self._retry.later(time.monotonic())


class ServerPort:
    """A server; both a port and the channel on which clients arrive, each of which is a channel of its own."""

    stream = True

    def __init__(self, endpoint: Endpoint, link: int, selector: BaseSelector, journal: Journal) -> None:
        self.link = link
        self.origin: object = None
        self.closed = False
        self.kernel_drops = 0
        self._endpoint, self._selector, self._journal = endpoint, selector, journal
        self._name = f"link {link}: {endpoint}"
        self._clients: dict[StreamChannel, tuple[socket.socket, str]] = {}
        family, address = resolve(endpoint, socket.SOCK_STREAM)
        self._socket = socket.socket(family, socket.SOCK_STREAM)
        try:
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # connections of before may linger
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER)  # clients inherit it
            self._socket.bind(address)
            self._socket.listen(128)
        except OSError as error:
            self._socket.close()
            why = (
                "the port is in use: another program serves it; stop it or choose another port"
                if error.errno == errno.EADDRINUSE
                else error.strerror or str(error)
            )
            raise OSError(error.errno, f"{endpoint}: {why}") from None
        self._socket.setblocking(False)
        selector.register(self._socket, EVENT_READ, self)

    def read(self) -> bytes | None:
        """No bytes: it accepts who has come."""
        for _ in range(ARRIVALS):
            try:
                sock, address = self._socket.accept()
            except BlockingIOError:
                break
            except OSError as error:  # e.g. it has gone again, or there are too many open files
                self._journal.trouble(f"{self._name}: {error.strerror or error}")
                break
            self._accept(sock, f"{address[0]} port {address[1]}")
        return None

    def flush(self) -> None:
        """It writes nothing itself."""

    def tick(self, now: float) -> None:
        """Nothing is due."""

    def heard(self, origin: object) -> None:
        """Who is connected can be answered."""

    def send(self, unit: bytes, origin: object) -> None:
        """Write to every client."""
        if not self._clients:
            self._journal.trouble(f"link {self.link}: not passed on to {self._endpoint}: nobody is connected")
        for channel in self._clients:
            channel.send(unit)

    def close(self) -> None:
        """Close the server and its connections."""
        if not self.closed:
            self.closed = True
            self._selector.unregister(self._socket)
            self._socket.close()
            for channel, (sock, _) in self._clients.items():
                channel.close()
                sock.close()
            self._clients.clear()

    def _accept(self, sock: socket.socket, who: str) -> None:
        if len(self._clients) >= CLIENTS:
            self._journal.trouble(f"{self._name}: a client was refused: there are {CLIENTS}")
            sock.close()
            return
        sock.setblocking(False)
        _prepare(sock)
        channel = StreamChannel(
            self._endpoint, self.link, self._selector, self._journal, sock, sock.recv, sock.send, self._lost
        )
        self._clients[channel] = sock, who
        self._journal.tell("info", f"{self._name}: {who} connected", f"{self._name} connected")

    def _lost(self, channel: StreamChannel, why: str) -> None:
        sock, who = self._clients.pop(channel)
        sock.close()
        self._journal.tell("info", f"{self._name}: {who} lost: {why}", f"{self._name} lost")


def _prepare(sock: socket.socket) -> None:
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for option, value in KEEP_ALIVE.items():
        if hasattr(socket, option):  # not every system has them
            sock.setsockopt(socket.IPPROTO_TCP, getattr(socket, option), value)
