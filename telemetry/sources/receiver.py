"""Telemetry as it arrives: read, archived, passed on and framed by a thread that nothing downstream can hold up.

::

    endpoints (vehicles)  --->  Receiver  --->  raw log, then batches of frames
                          <---     |  ^
                                   v  |
                        forward (ground stations)

What comes from the vehicles goes to every ground station and what comes from a ground station to every vehicle, bytes
unchanged and at once: a datagram as it is, a stream frame by frame as soon as each is whole (with the bytes that were
no frame), so that several streams can share one. Both are evidence alike: a forward endpoint is a link like the others.

With a `SignatureGuard` what comes from the vehicles is passed on after the check, within a batch, and only the frames
that pass. What comes from a ground station is not checked but where it speaks in the name of a vehicle that signs; it
goes to the vehicles unchanged, which check it themselves.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import groupby
from selectors import EVENT_READ, EVENT_WRITE, DefaultSelector

import numpy as np

from telemetry.archive import RawLog
from telemetry.frames import Frames, StreamScanner, join, link_bits, scan_datagrams
from telemetry.mavlink import Dialect
from telemetry.signing import WHY, SignatureGuard, Verdict, sift
from telemetry.sources.endpoint import leads_to, parse_endpoint
from telemetry.sources.port import Channel, Journal, News, Port, open_port, tenfold

BACKLOG = 256 << 20
LINKS = 16
TICK = 0.1  # s between two looks at what is due
PIECES = 1024  # in a batch, at most
TURN = 256 << 10  # bytes of one channel before the others have their turn,
COST = 1 << 10  # a piece counting as so many more
TOGETHER = 16  # batches handed out as one where the consumer has fallen behind: it catches up the sooner
QUIET = 0.25  # s of silence after which an empty batch is handed out
LAST_ROUNDS = 64  # turns of each after the stop


_Piece = tuple[int, int, object, bytes | Frames]
"""Receive time, link and sender of a datagram, or of what a piece of a stream completed."""


class Receiver:
    """One or more endpoints, archived and framed.

    The thread reads, archives and frames; `batches` hands out what it has found. A consumer that falls behind by more
    than 256 MB of telemetry misses batches, which `dropped` counts and the raw log still holds.

    Parameters
    ----------
    endpoints : sequence of str
        Where vehicles are heard (`telemetry.sources.endpoint`).
    dialect : Dialect
    raw_log : RawLog or None
        Where the evidence goes, before it is handed out; for as many links as there are endpoints of both kinds.
    forward : sequence of str
        Where ground stations are.
    guard : SignatureGuard, optional
        Refuses frames that are not signed as they should be: they become junk.
    batch : float
        Longest time a frame waits for others, s.

    Attributes
    ----------
    endpoints : list of Endpoint
        Those of the vehicles, then those of the ground stations.
    links : list of str
        Names of the links, one per endpoint.
    dropped : int
        Frames in batches that were not handed out.

    Raises
    ------
    ValueError
        If an endpoint does not read as one, there are more than 16, or one calls another.
    OSError
        If an endpoint cannot be opened, e.g. because the port is in use. A TCP server that is not there is waited for.
    """

    def __init__(
        self,
        endpoints: Sequence[str],
        dialect: Dialect,
        raw_log: RawLog | None = None,
        *,
        forward: Sequence[str] = (),
        guard: SignatureGuard | None = None,
        batch: float = 0.01,
    ) -> None:
        self.endpoints = [parse_endpoint(text) for text in (*endpoints, *forward)]
        self.links = [str(i) for i in range(len(self.endpoints))]
        self.dropped = 0
        if not 0 < len(self.links) <= LINKS:
            raise ValueError(f"{len(self.links)} endpoints: 1 to {LINKS} can be received")
        for caller in self.endpoints:
            for listener in self.endpoints:
                if leads_to(caller, listener):
                    raise ValueError(f"{caller} calls {listener}, which is an endpoint here too: choose another port")
        anchor = time.time_ns() - time.monotonic_ns()  # one anchor: a step of the system clock does not reach us
        behind = raw_log.reached - anchor - time.monotonic_ns() if raw_log else 0
        self._anchor = anchor + max(behind, 0)
        self._journal = Journal(lambda: time.monotonic_ns() + self._anchor)
        if behind > 0:
            said = f"this machine's clock is {behind * 1e-9:.1f} s behind the end of the raw log: what follows"
            self._journal.tell("warning", f"{said} is dated later by as much")
        self._dialect, self._raw_log, self._guard, self._batch = dialect, raw_log, guard, batch
        self._refused: dict[tuple[int, Verdict], int] = {}
        self._unsaved: str | None = None
        self._vehicles = len(endpoints)
        self._resolution = 1000 << link_bits(len(self.links))  # ns: in the raw log the bits below are the link number
        self._last = raw_log.reached if raw_log else 0
        self._resumed = self._last > 0
        self._heard: float | None = None  # when something was last handed out, s
        self._pieces: list[_Piece] = []
        self._oldest = 0.0
        self._streams: dict[Channel, StreamScanner] = {}
        self._nothing = _warm_up(dialect)
        self._selector = DefaultSelector()
        self._ports: list[Port] = []
        try:
            for link, endpoint in enumerate(self.endpoints):
                ground = link >= self._vehicles
                self._ports.append(
                    open_port(endpoint, link, self._selector, self._journal, two_way=bool(forward), ground=ground)
                )
        except BaseException:
            self._close()
            raise
        at_once = () if guard else tuple(self._ports[self._vehicles :])
        back = tuple(self._ports[: self._vehicles])
        self._answers = [back if link >= self._vehicles else at_once for link in range(len(self._ports))]
        self._queue: deque[Frames] = deque()
        self._queued = 0
        self._ready = threading.Condition()
        self._stopping = threading.Event()
        self._done = False
        self._failure: Exception | None = None
        self._thread = threading.Thread(target=self._run, name="sortie-receive", daemon=True)
        self._thread.start()

    @property
    def troubles(self) -> dict[str, int]:
        """What the network complained of or could not take, and how often; receiving goes on."""
        return self._journal.troubles

    @property
    def kernel_drops(self) -> list[int]:
        """Datagrams that the kernel dropped because this machine could not follow, per link: no loss of the radio."""
        return [port.kernel_drops for port in self._ports]

    def news(self) -> list[News]:
        """What has happened to the links since the last time: (t_rx, level, text)."""
        return self._journal.drain()

    def stop(self) -> None:
        """Stop receiving; `batches` ends when it has handed out what was received."""
        self._stopping.set()

    def join(self) -> None:
        """Wait until the receiving thread has ended and the raw log is closed."""
        self._thread.join()

    def batches(self, idle: float | None = None) -> Iterator[Frames]:
        """Yield what has arrived, in order, until `stop`; while nothing arrives, empty batches that say how far receive
        time has come.

        Parameters
        ----------
        idle : float, optional
            Stop by itself when nothing has arrived for so long, s, counted from the first arrival, or from now where
            a raw log is resumed.

        Raises
        ------
        Exception
            What ended the receiving thread, if anything did.
        """
        if self._resumed and self._heard is None:
            self._heard = time.monotonic()
        while True:
            with self._ready:
                if not self._queue and not self._done:
                    self._ready.wait(0.1)
                waiting = [self._queue.popleft() for _ in range(min(len(self._queue), TOGETHER))]
                self._queued -= sum(map(_size, waiting))
                if not waiting and self._done:
                    break
            frames = join(waiting) if waiting else None
            if frames is not None and len(frames.data):
                self._heard = time.monotonic()
            elif idle is not None and self._heard is not None and time.monotonic() - self._heard > idle:
                self.stop()
            if frames is not None:
                yield frames
        self._thread.join()
        if self._failure:
            raise self._failure

    def _run(self) -> None:
        try:
            self._receive()
        except Exception as error:  # the consumer is told; the thread has nobody to tell
            self._failure = error
        finally:
            self._close()
            if self._guard:
                self._guard.save()
            if self._raw_log:
                self._raw_log.close()
            with self._ready:
                self._done = True
                self._ready.notify()

    def _receive(self) -> None:
        due = quiet = 0.0
        last_rounds = LAST_ROUNDS
        while True:
            stopping = self._stopping.is_set()
            ready = self._selector.select(0.0 if stopping else self._batch if self._pieces else 0.05)
            for key, events in ready:
                channel: Channel = key.data
                if events & EVENT_WRITE:
                    channel.flush()
                if events & EVENT_READ:
                    self._take(channel)
            if stopping:  # what has arrived by now is still taken, but no more than the buffers held
                last_rounds -= 1
                if not ready or not last_rounds:
                    break
            now = time.monotonic()
            if now >= due:
                due = now + TICK
                self._tick(now)
            if self._pieces:
                if now - self._oldest >= self._batch or len(self._pieces) >= PIECES:
                    self._hand_over()
                    quiet = now + QUIET
            elif now >= quiet:
                quiet = now + QUIET
                self._hand_out(replace(self._nothing, pending=self._pending(), until=self._now()))
            if self._raw_log:
                self._raw_log.sync(force=False)
        for channel in list(self._streams):
            self._end(channel)
        if self._pieces:
            self._hand_over()

    def _tick(self, now: float) -> None:
        for port in self._ports:
            port.tick(now)
        if self._guard:
            self._guard.save(force=False)
            if self._guard.error != self._unsaved:
                self._unsaved = self._guard.error
                if self._unsaved:
                    self._journal.tell("error", f"ALARM: {self._unsaved}")

    def _take(self, channel: Channel) -> None:
        """Read what is there; a busy link must not starve the others."""
        link, stream, pieces, left = channel.link, channel.stream, self._pieces, TURN
        answers, now = self._answers[link], self._now
        while left > 0 and (data := channel.read()) is not None:
            left -= len(data) + COST
            if stream:
                self._take_block(channel, data, answers)
                continue
            pieces.append((now(), link, channel.origin, data))
            if answers:
                self._ports[link].heard(channel.origin)
                for port in answers:
                    port.send(data, channel.origin)
        if channel.closed and channel in self._streams:
            self._end(channel)

    def _take_block(self, channel: Channel, block: bytes, answers: Sequence[Port], final: bool = False) -> None:
        scanner = self._streams.get(channel)
        if scanner is None:
            scanner = self._streams[channel] = StreamScanner(self._dialect.crc_extra, channel.link)
        t_rx = self._now()
        found = scanner.scan(block, t_rx, final)
        if not len(found) and not len(found.junk_start):
            return
        self._pieces.append((t_rx, channel.link, None, found))
        if answers:
            runs = zip(found.junk_start.tolist(), found.junk_length.tolist(), strict=True)
            whole = zip(found.start.tolist(), found.length.tolist(), strict=True)
            for start, length in sorted([*runs, *whole]):
                unit = found.data[start : start + length].tobytes()
                for port in answers:
                    port.send(unit, None)

    def _end(self, channel: Channel) -> None:
        """Nothing more will come over it: what waits for the rest of a frame is in no frame."""
        self._take_block(channel, b"", self._answers[channel.link], final=True)
        del self._streams[channel]

    def _now(self) -> int:
        """The receive time of the next piece: later than all before, so that it dates every piece apart."""
        now, step = time.monotonic_ns(), self._resolution
        if not self._pieces:
            self._oldest = now * 1e-9
        t_rx = (now + self._anchor) // step * step
        if t_rx <= self._last:
            t_rx = self._last + step
        self._last = t_rx
        return t_rx

    def _hand_over(self) -> None:
        pieces, self._pieces = self._pieces, []
        batches: list[Frames] = []
        for whole, run in groupby(pieces, lambda piece: isinstance(piece[-1], Frames)):
            if whole:
                batches += [found for *_, found in run if isinstance(found, Frames)]
            else:
                batches.append(self._datagrams(list(run)))
        frames = join(batches)
        if self._streams or frames.pending:
            frames = replace(frames, pending=self._pending(), until=self._last)
        if self._guard:
            frames = self._sift(frames, self._guard, {t_rx: origin for t_rx, _, origin, _ in pieces})
        if self._raw_log:
            self._raw_log.write(frames)
        self._hand_out(frames)

    def _pending(self) -> int:
        return sum(scanner.pending for scanner in self._streams.values())

    def _hand_out(self, frames: Frames) -> None:
        with self._ready:
            if self._queued > BACKLOG:
                self.dropped += len(frames)
            else:
                self._queue.append(frames)
                self._queued += _size(frames)
            self._ready.notify()

    def _datagrams(self, pieces: list[_Piece]) -> Frames:
        t_rx, links, _, data = zip(*pieces, strict=True)
        bounds = np.zeros(len(pieces) + 1, np.int64)
        np.cumsum([len(datagram) for datagram in data], out=bounds[1:])
        return scan_datagrams(
            np.frombuffer(b"".join(data), np.uint8),
            bounds,
            np.array(t_rx, np.int64),
            np.array(links, np.uint8),
            self._dialect.crc_extra,
        )

    def _sift(self, frames: Frames, guard: SignatureGuard, origins: dict[int, object]) -> Frames:
        """Make junk of what the guard refuses, and pass on what it does not."""

        def refused(frame: bytes, t_rx: int, link: int) -> bool:
            ground = link >= self._vehicles
            if ground and frame[5 if frame[0] == 0xFD else 3] not in guard.systems:
                return False
            verdict = guard.check(frame, t_rx, link)
            passes = guard.passes(verdict)
            if not passes:
                self._refuse(link, verdict, frame)
            elif not ground and len(self._ports) > self._vehicles:
                self._ports[link].heard(origins[t_rx])
                for port in self._ports[self._vehicles :]:
                    port.send(frame, origins[t_rx])
            return not passes

        return sift(frames, refused)

    def _refuse(self, link: int, verdict: Verdict, frame: bytes) -> None:
        before = self._refused.get((link, verdict), 0)
        self._refused[link, verdict] = before + 1
        if tenfold(before, before + 1):
            system = frame[5 if frame[0] == 0xFD else 3]
            what = f"{before + 1} frames refused, the last of system {system}" if before else ""
            what = what or f"1 frame of system {system} refused"
            said = f"ALARM: link {self.links[link]}: {what}: {WHY[verdict]}"
            self._journal.tell("error", said)

    def _close(self) -> None:
        for port in self._ports:
            port.close()
        self._selector.close()


def _size(frames: Frames) -> int:
    return len(frames.data) + 64 * (len(frames) + len(frames.junk_start))


def _warm_up(dialect: Dialect) -> Frames:
    """Compile what frames, so that nothing arrives while that is done; the frames of no datagram."""
    t_rx, data = np.array([1, 2], np.int64), np.zeros(4, np.uint8)
    link = np.zeros(2, np.uint8)
    scan_datagrams(data, np.array([0, 2, 4]), t_rx, link, dialect.crc_extra)
    StreamScanner(dialect.crc_extra).scan(bytes(4), 1)
    return scan_datagrams(data[:0], np.array([0]), t_rx[:0], link[:0], dialect.crc_extra)
