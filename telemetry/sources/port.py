"""The seam between receiving and the kinds of endpoints.

A `Port` is an endpoint in use. What can be waited on are its `Channel`s: the one socket of a UDP port, the connections
of a TCP server beside the socket that accepts them, none while a device is unplugged. A port registers its channels
with the selector of the receiving thread and takes them away when they end; all its methods are called by that thread,
and none of them may wait.
"""

from __future__ import annotations

import importlib
from collections import deque
from collections.abc import Callable
from selectors import BaseSelector
from typing import Literal, NamedTuple, Protocol

from telemetry.sources.endpoint import SCHEMES, Endpoint

Level = Literal["info", "warning", "error"]
FLUENT = 20  # times something is told before it is told at every tenfold only


class News(NamedTuple):
    """Something that a reader of the log should know; `level` as in `telemetry.messages.Event`."""

    t_rx: int
    level: Level
    text: str


class Journal:
    """What happens to the endpoints: counted, and told in bounded quantity however often it happens.

    Parameters
    ----------
    clock : callable
        Receive time now, ns.

    Attributes
    ----------
    troubles : dict of str to int
        What went wrong, and how often.
    """

    def __init__(self, clock: Callable[[], int]) -> None:
        self.clock = clock
        self.troubles: dict[str, int] = {}
        self._happened: dict[str, int] = {}
        self._news: deque[News] = deque(maxlen=1000)

    def tell(self, level: Level, text: str, kind: str = "") -> None:
        """Tell it; of a `kind` that happens over and over only the first 20 and every tenfold. All are counted, and
        those that are no mere information are troubles.
        """
        if kind:
            counts = self._happened if level == "info" else self.troubles
            times = counts[kind] = counts.get(kind, 0) + 1
            if times > FLUENT and not tenfold(times - 1, times):
                return
        self._news.append(News(self.clock(), level, text))

    def trouble(self, text: str, times: int = 1) -> None:
        """Count it, and tell the first time and every tenfold."""
        before = self.troubles.get(text, 0)
        now = self.troubles[text] = before + times
        if tenfold(before, now):
            self.tell("warning", f"{text} ({now} times)" if now > 1 else text)

    def drain(self) -> list[News]:
        """What has been told since the last time."""
        news = []
        while self._news:
            news.append(self._news.popleft())
        return news


def tenfold(before: int, now: int) -> bool:
    """Whether a count has just passed 1, 10, 100, ..."""
    return now > before and (before == 0 or len(str(now)) > len(str(before)))


class Channel(Protocol):
    """One socket or device that can be waited on.

    Attributes
    ----------
    link : int
        Number of its endpoint.
    stream : bool
        A frame may continue from one piece to the next; each channel is then a stream of its own.
    origin : object
        Who sent the piece read last; None where there is only one who can.
    closed : bool
        It has ended and is no longer registered.
    """

    link: int
    stream: bool
    origin: object
    closed: bool

    def read(self) -> bytes | None:
        """The next piece of bytes; None when there is none for now, or the channel has ended."""

    def flush(self) -> None:
        """Go on with what could not be written before, now that it can."""


class Port(Protocol):
    """An endpoint in use.

    Attributes
    ----------
    kernel_drops : int
        Datagrams that the kernel dropped because they were not taken in time.
    """

    kernel_drops: int

    def tick(self, now: float) -> None:
        """What is done from time to time: greet, try to connect again. `now` is monotonic, s."""

    def heard(self, origin: object) -> None:
        """What `origin` sent was believed: it can be answered from now on."""

    def send(self, unit: bytes, origin: object) -> None:
        """Write whole frames to everybody there, but never back to `origin`; what cannot be written is counted."""

    def close(self) -> None:
        """Close everything; closing twice is harmless."""


def open_port(
    endpoint: Endpoint, link: int, selector: BaseSelector, journal: Journal, *, two_way: bool, ground: bool
) -> Port:
    """Take an endpoint into use.

    Parameters
    ----------
    endpoint : Endpoint
    link : int
        Its number.
    selector : BaseSelector
        Where its channels are registered; their ``data`` is the `Channel`.
    journal : Journal
    two_way : bool
        Something may be passed on over it, so who sent a piece must be known.
    ground : bool
        A ground station lies there, not a vehicle: it need not be greeted.

    Raises
    ------
    OSError
        If it cannot be, and waiting would not mend that: a port in use, no such host or device.
    """
    module = importlib.import_module(f"telemetry.sources.{SCHEMES[endpoint.scheme]}")
    port: Port = module.open_port(endpoint, link, selector, journal, two_way=two_way, ground=ground)
    return port
