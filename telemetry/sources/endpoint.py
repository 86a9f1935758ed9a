"""Endpoints as they are written on the command line.

========================  ===============================================================
``udpin:[HOST:]PORT``     listen for datagrams
``udpout:[HOST:]PORT``    call a station that listens
``tcp:[HOST:]PORT``       connect to a server
``tcpin:[HOST:]PORT``     be a server, for several clients
``serial:DEVICE[:BAUD]``  a radio or an autopilot on a serial port, 57600 baud if not said
========================  ===============================================================

A host that is left out is the loopback address, never every interface of the machine. An IPv6 address stands in
brackets: ``udpin:[::1]:14550``.
"""

from __future__ import annotations

import socket
from typing import Any, NamedTuple

LOOPBACK = "127.0.0.1"
BAUD = 57_600
FASTEST = 10_000_000  # baud
SCHEMES = {"udpin": "udp", "udpout": "udp", "tcp": "tcp", "tcpin": "tcp", "serial": "serial"}
"""What opens each scheme: the module of `telemetry.sources` with an ``open_port``. A new kind is a line and a file."""


class Endpoint(NamedTuple):
    """Where to listen or whom to call: `host` and `port`, or the `device` and `baud` of a serial port."""

    scheme: str
    host: str = ""
    port: int = 0
    device: str = ""
    baud: int = 0

    def __str__(self) -> str:
        if self.scheme == "serial":
            return f"serial:{self.device}:{self.baud}"
        return f"{self.scheme}:{f'[{self.host}]' if ':' in self.host else self.host}:{self.port}"


def parse_endpoint(text: str) -> Endpoint:
    """Read an endpoint.

    Parameters
    ----------
    text : str
        As in the table above.

    Raises
    ------
    ValueError
        If it is none; the text says what is expected.
    """
    scheme, _, rest = text.partition(":")
    if scheme == "serial":
        device, _, last = rest.rpartition(":")
        baud = _number(last, FASTEST) if device else 0
        if not baud:  # a device's own name may have colons
            device, baud = rest, BAUD
        if device and device[0] != ":" != device[-1]:
            return Endpoint(scheme, device=device, baud=baud)
    elif scheme in SCHEMES:
        host, _, last = rest.rpartition(":")
        port = _number(last, 65535)
        bare = host[1:-1] if host.startswith("[") and host.endswith("]") else host
        if port and (bare != host or ":" not in host) and not (host and not bare):
            return Endpoint(scheme, bare or LOOPBACK, port)
    raise ValueError(
        f"{text!r} is no endpoint: write udpin:HOST:PORT to listen or udpout:HOST:PORT to call, tcp:HOST:PORT to "
        "connect or tcpin:HOST:PORT to be connected to, or serial:DEVICE:BAUD, e.g. udpin:127.0.0.1:14550"
    )


def _number(text: str, greatest: int) -> int:
    """The number, 0 if it is none from 1 to `greatest`."""
    if not (text.isascii() and text.isdigit() and len(text) < 10):
        return 0
    return int(text) if int(text) <= greatest else 0


def resolve(endpoint: Endpoint, kind: socket.SocketKind) -> tuple[socket.AddressFamily, Any]:
    """Family and address of its host and port; an IPv4 address where the host has several.

    Raises
    ------
    OSError
        If there is no such host.
    """
    try:
        found = socket.getaddrinfo(endpoint.host, endpoint.port, type=kind)
    except (OSError, UnicodeError) as error:  # a name that cannot be one is told as UnicodeError
        why = error.strerror if isinstance(error, OSError) and error.strerror else "it cannot be a host's name"
        raise OSError(None, f"{endpoint}: no host {endpoint.host!r} is known: {why}") from None
    family, _, _, _, address = min(found, key=lambda one: one[0] != socket.AF_INET)
    return family, address


def leads_to(caller: Endpoint, listener: Endpoint) -> bool:
    """Whether what `caller` sends arrives at `listener`, on this machine: what is passed on would come back and be
    passed on again, for ever.
    """
    kinds = {("udpout", "udpin"): socket.SOCK_DGRAM, ("tcp", "tcpin"): socket.SOCK_STREAM}
    kind = kinds.get((caller.scheme, listener.scheme))
    if kind is None or caller.port != listener.port:
        return False
    (family, there), (_, here) = resolve(caller, kind), resolve(listener, kind)
    if there[0] == here[0]:
        return True
    if here[0] not in ("0.0.0.0", "::"):
        return False
    with socket.socket(family, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind((there[0], 0))
        except OSError:  # an address of another machine
            return False
    return True
