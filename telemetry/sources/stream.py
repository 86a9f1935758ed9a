"""Connections that carry bytes rather than datagrams, whatever carries them."""

from __future__ import annotations

from collections.abc import Callable
from selectors import EVENT_READ, EVENT_WRITE, BaseSelector

from telemetry.sources.endpoint import Endpoint
from telemetry.sources.port import Journal

PIECE = 65_536
ROOM = 256 << 10  # bytes that may wait for a slow far end: more than the largest unit
SOONEST, LATEST = 0.2, 5.0  # s


class Retry:
    """When to try again: soon, then after twice as long each time."""

    def __init__(self) -> None:
        self._wait = SOONEST
        self._at = 0.0

    def due(self, now: float) -> bool:
        """Whether it is time; `now` is monotonic, s."""
        return now >= self._at

    def later(self, now: float) -> None:
        """It was in vain."""
        self._at = now + self._wait
        self._wait = min(2 * self._wait, LATEST)

    def forget(self) -> None:
        """It was worth it: the next time begins soon again."""
        self._wait = SOONEST


class StreamChannel:
    """An open connection (`telemetry.sources.port.Channel`).

    What cannot be written at once waits, up to 256 kB, and a unit for which there is no room is left out whole, so
    that the far end never sees a frame cut.

    Parameters
    ----------
    endpoint : Endpoint
    link : int
    selector : BaseSelector
    journal : Journal
    handle : int or object with fileno
        What the selector watches.
    receive : callable
        Given a size, the bytes that are there, none at the end.
    transmit : callable
        Given bytes, how many it took.
    ended : callable
        Called once with this channel and the reason when the far end or the network ends it.

    Attributes
    ----------
    received : int
        Bytes read.
    """

    stream = True

    def __init__(
        self,
        endpoint: Endpoint,
        link: int,
        selector: BaseSelector,
        journal: Journal,
        handle: object,
        receive: Callable[[int], bytes],
        transmit: Callable[[bytes | bytearray], int],
        ended: Callable[[StreamChannel, str], None],
    ) -> None:
        self.link = link
        self.origin: object = None
        self.closed = False
        self.received = 0
        self._to = f"link {link}: not passed on to {endpoint}"
        self._selector, self._journal, self._handle = selector, journal, handle
        self._receive, self._transmit, self._ended = receive, transmit, ended
        self._waiting = bytearray()
        selector.register(handle, EVENT_READ, self)  # type: ignore[arg-type]

    def read(self) -> bytes | None:
        """The next bytes; None when there are none, or no more."""
        if self.closed:
            return None
        try:
            piece = self._receive(PIECE)
        except BlockingIOError:
            return None
        except OSError as error:
            self._end(error.strerror or str(error))
            return None
        if not piece:
            self._end("the far end closed it")
            return None
        self.received += len(piece)
        return piece

    def send(self, unit: bytes) -> None:
        """Write whole frames, or keep them until they can be."""
        if self.closed:
            return
        if len(self._waiting) + len(unit) > ROOM:
            self._journal.trouble(f"{self._to}: the far end does not follow")
            return
        sent = 0
        if not self._waiting:
            try:
                sent = self._transmit(unit)
            except BlockingIOError:
                pass
            except OSError as error:  # the end of the connection is told where it is read: something may still come
                self._journal.trouble(f"{self._to}: {error.strerror or error}")
                return
            if sent < len(unit):
                self._watch(EVENT_READ | EVENT_WRITE)
        self._waiting += unit[sent:]

    def flush(self) -> None:
        """Write what waits."""
        if self.closed:
            return
        try:
            del self._waiting[: self._transmit(self._waiting)]
        except BlockingIOError:
            return
        except OSError:  # as in `send`
            self._waiting.clear()
        if not self._waiting:
            self._watch(EVENT_READ)

    def close(self) -> None:
        """Take it away from the selector; the handle is its owner's to close."""
        if not self.closed:
            self.closed = True
            self._selector.unregister(self._handle)  # type: ignore[arg-type]
            self._waiting.clear()

    def _end(self, why: str) -> None:
        self.close()
        self._ended(self, why)

    def _watch(self, events: int) -> None:
        self._selector.modify(self._handle, events, self)  # type: ignore[arg-type]
