"""The stage: frames to samples.

Every frame gets its place on its vehicle's clock, every sequence number its fate, and what a frame measures becomes
samples in SI units; a frame that came over several links is used once. Frames that cannot be placed yet wait for the
next batch (`telemetry.system`), and `Progress` says how far everything has been told. What is said does not depend on
how the stream was cut into batches; only how often the byte account is told does, and which of two events about
different things comes first.

A batch may be empty: then it says only how far receive time has come, and nothing depends on it but the `Progress`,
how soon a wait ends, and until when a silent link's account has rows.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any, Protocol

import msgspec
import numpy as np
from numpy.typing import NDArray

from telemetry import text
from telemetry.boottimes import AUTOPILOT, UNIX_US, BootTimes
from telemetry.frames import Frames, scan_datagrams
from telemetry.heard import Heard
from telemetry.link import SENDERS, LinkAccounts
from telemetry.mavlink import Dialect
from telemetry.messages import Event, LinkBytes, Message, Progress, event
from telemetry.redundant import Copies
from telemetry.sensors import Sensors, SensorSettings, check
from telemetry.system import STAGE, System
from telemetry.text import said_on_the_ground

RECEIVE_STEP = 1_000_000_000
BYTES_ROW = 1_000_000_000  # ns of receive time between two rows of the byte account
_BYTES, _FRAMES, _UNKNOWN, _CORRUPT, _REFUSED, _DISCARDED, _PENDING = range(7)  # columns of the byte account


class Settings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How telemetry is read.

    Parameters
    ----------
    dialect : str
        MAVLink dialect, one that pymavlink ships.
    mark : str
        Regular expression of a test-point mark in a STATUSTEXT, with the groups ``name`` and ``action`` (start or
        stop). It is held against the beginning of what a vehicle says, and of what a ground station says, who may add
        ``@7`` for vehicle 7 alone (`telemetry.text`).
    sensors : SensorSettings
        Which messages feed the sensors, where they are not to be chosen automatically, and noise.
    """

    dialect: str = "ardupilotmega"
    mark: str = text.MARK
    sensors: SensorSettings = SensorSettings()


def ingest(
    batches: Iterable[Frames], links: Sequence[str], dialect: Dialect, settings: Settings | None = None
) -> Iterator[Message]:
    """Turn frames into the vocabulary.

    Parameters
    ----------
    batches : iterable of Frames
        In the order of arrival, e.g. ``TlogSource.batches()``.
    links : sequence of str
        Names of the links that the frames number.
    dialect : Dialect
    settings : Settings, optional

    Returns
    -------
    iterator of Message
        Samples, texts, marks, events, link statistics and clock fits; after each batch a `Progress`, at the end a
        final one.

    Raises
    ------
    ValueError
        If the settings of the sensors do not fit the dialect.
    """
    settings = settings or Settings()
    check(settings.sensors, dialect)
    return _run(batches, Ingest(links, dialect, settings))


def _run(batches: Iterable[Frames], stage: Ingest) -> Iterator[Message]:
    for batch in batches:
        yield from stage.batch(batch)
    yield from stage.finish()


def warm_up(dialect: Dialect) -> None:
    """Compile the stage by running it on a few frames, so that the first real ones do not wait for it."""
    from pymavlink.dialects.v20 import ardupilotmega as mavlink

    sender = mavlink.MAVLink(None, srcSystem=1, srcComponent=AUTOPILOT)
    sent = [
        message.pack(sender)
        for ms in (1000, 2000)
        for message in (
            mavlink.MAVLink_heartbeat_message(1, 3, 0, 0, 4, 3),
            mavlink.MAVLink_system_time_message(UNIX_US + ms, ms),
            mavlink.MAVLink_gps_raw_int_message(ms * 1000, 3, 1, 1, 1, 100, 100, 0, 0, 9),
            mavlink.MAVLink_statustext_message(6, b"warm up"),
        )
    ]
    bounds = np.cumsum([0] + [len(frame) for frame in sent])
    frames = scan_datagrams(
        np.frombuffer(b"".join(sent), np.uint8),
        bounds,
        4000 * np.arange(1, len(sent) + 1),
        np.zeros(len(sent), np.uint8),
        dialect.crc_extra,
    )
    for _ in ingest([frames], ["0"], dialect):
        pass


class Evidence(Protocol):
    """What `guarded` looks at of a raw log (`telemetry.archive.RawLog`)."""

    @property
    def path(self) -> Any:
        """Where it is."""

    @property
    def error(self) -> str | None:
        """What is wrong now."""

    @property
    def warning(self) -> str | None:
        """What will be wrong before long."""

    @property
    def notes(self) -> Sequence[str]:
        """What has happened to the evidence; only ever grows."""


class Source(Protocol):
    """What `guarded` looks at of a receiver (`telemetry.sources.receiver.Receiver`)."""

    @property
    def dropped(self) -> int:
        """Frames that were archived but not handed on."""

    def news(self) -> Sequence[tuple[int, Any, str]]:
        """What has happened to the links since the last time: (t_rx, level, text)."""


def guarded(messages: Iterable[Message], raw_log: Evidence, source: Source) -> Iterator[Message]:
    """Pass on what is ingested live, and tell at once when evidence, links or samples are in trouble.

    It looks with every message that passes, so while nothing is received the source must hand out empty batches.

    Parameters
    ----------
    messages : iterable of Message
    raw_log : Evidence
        What keeps the evidence: what is wrong with it is told when it appears and when it is over.
    source : Source
        What receives: its news, and frames that ingest could not take.
    """
    error: str | None = None
    warning: str | None = None
    noted = gone = 0
    for message in messages:
        now = int(message.t_rx[-1])
        said: list[tuple[int, Any, str]] = list(source.news())
        if raw_log.error != error:
            error = raw_log.error
            well = f"{raw_log.path}: raw telemetry is being kept again"
            said.append((now, "error", f"ALARM: {error}") if error else (now, "info", well))
        if raw_log.warning != warning:
            warning = raw_log.warning
            well = f"{raw_log.path}: there is room for raw telemetry again"
            said.append((now, "warning", warning) if warning else (now, "info", well))
        for note in raw_log.notes[noted:]:
            said.append((now, "warning", note))
            noted += 1
        if source.dropped > gone:
            lost, gone = source.dropped - gone, source.dropped
            said.append((now, "error", f"ALARM: {lost} frames are in the raw log only: ingest could not follow"))
        for t_rx, level, words in said:
            yield event(words, level=level, source=STAGE, t=t_rx, t_rx=t_rx)
        yield message  # afterwards: a final word has nobody listening behind it


class Ingest:
    """The stage, step by step; `ingest` takes all steps.

    Parameters
    ----------
    links, dialect, settings
        As in `ingest`.

    Attributes
    ----------
    accounts : LinkAccounts
        The loss accounts of all senders on all links.
    """

    def __init__(self, links: Sequence[str], dialect: Dialect, settings: Settings) -> None:
        self._links, self._dialect, self._settings = links, dialect, settings
        self._instruments = lambda sysid: Sensors(sysid, settings.sensors, dialect)
        self._systems: dict[int, System] = {}
        self._times = BootTimes(dialect)
        self._copies = Copies(len(links))
        self.accounts = LinkAccounts()
        self._bytes = np.zeros((len(links), 7), np.int64)
        self._bytes_told = 0
        self._unfollowed = 1  # frames of senders without an account that are worth telling
        self._pending = 0
        self._reached = 0  # receive time of everything told so far
        self._received = 0  # receive time of the newest frame
        self._shift = 0  # what the receive clock's steps back are made up by

    def batch(self, frames: Frames) -> Iterator[Message]:
        """What a batch of frames says."""
        frames, said = self._forward(frames)
        yield from said
        self._count(frames)
        yield from self._advance(frames, frames.until, final=False)

    def finish(self) -> Iterator[Message]:
        """What is left to say when nothing will follow."""
        now = self._received
        if self._pending:
            yield event(
                f"the log ends inside a record: its last {self._pending} bytes are left out",
                level="warning",
                source=STAGE,
                t=now,
                t_rx=now,
            )
        for link, (_, _, _, corrupt, refused, discarded, _) in enumerate(self._bytes.tolist()):
            if discarded:
                refusals = f", {refused} were refused" if refused else ""
                said = f"{discarded} bytes were no frame, {corrupt} frames were corrupt{refusals}"
                yield event(f"link {self._links[link]}: {said}", level="warning", source=STAGE, t=now, t_rx=now)
        yield from self._advance(None, now, final=True)

    def _forward(self, frames: Frames) -> tuple[Frames, list[Message]]:
        """Make receive time run forward: where the recorder's clock stepped back, what follows is moved up to it."""
        until = frames.until + self._shift
        if not len(frames):
            self._received = max(self._received, until)
            return (replace(frames, until=until) if self._shift else frames), []
        t_rx = frames.t_rx
        if not self._shift and t_rx[0] >= self._received and (t_rx[1:] >= t_rx[:-1]).all():
            self._received = max(self._received, until, int(t_rx[-1]))
            return frames, []
        t_rx = t_rx + self._shift
        said: list[Message] = []
        begin = self._received or int(t_rx[0])
        while True:
            newest = np.maximum.accumulate(np.concatenate([[begin], t_rx[:-1]]))
            back = np.flatnonzero(t_rx < newest - RECEIVE_STEP)
            if not len(back):
                break
            at = int(back[0])
            step = int(newest[at] - t_rx[at])
            t_rx[at:] += step
            self._shift += step
            now = int(t_rx[at])
            text = f"the receive clock stepped back by {step * 1e-9:.1f} s: what follows is dated from before"
            said.append(event(text, level="warning", source=STAGE, t=now, t_rx=now))
        t_rx = np.maximum(t_rx, newest)
        until = frames.until + self._shift
        self._received = max(self._received, until, int(t_rx[-1]))
        return replace(frames, t_rx=t_rx, until=until), said

    def _count(self, frames: Frames) -> None:
        self._pending = frames.pending
        for link in range(len(self._links)):
            mine, junk = frames.link == link, frames.junk_link == link
            account = self._bytes[link]
            if mine.any():
                account[_BYTES] += frames.length[mine].sum()
                account[_FRAMES] += np.count_nonzero(mine)
                account[_UNKNOWN] += np.count_nonzero(mine & ~frames.known)
            if junk.any():
                lost = frames.junk_length[junk].sum()
                account[_BYTES] += lost
                account[_DISCARDED] += lost
                account[_CORRUPT] += np.count_nonzero(frames.junk_corrupt[junk])
                account[_REFUSED] += np.count_nonzero(frames.junk_refused[junk])

    def _advance(self, frames: Frames | None, until: int, final: bool) -> Iterator[Message]:
        fed: set[int] = set()
        if frames is not None and len(frames):
            yield from self._hear(frames, until, fed)
        for sysid, system in sorted(self._systems.items()):
            if final or not (system.idle or sysid in fed):
                yield from system.feed(None, self.accounts, until, final)
            if system.marks:
                yield from self._unheard(system)
        waiting = [system.waits for system in self._systems.values() if system.waits]
        covered = min([until, *(t - 1 for t in waiting)])
        self._reached = max(self._reached, covered)
        if self._reached or final:
            now = np.array([self._reached], np.int64)
            if final:
                self.accounts.finish(self._received)
            else:
                self.accounts.advance(self._reached)
            yield from self.accounts.drain(self._links, lambda _: 0)
            if self.accounts.unfollowed >= self._unfollowed:
                count = self.accounts.unfollowed
                self._unfollowed = 10 ** len(str(count))
                words = f"ALARM: {count} frames of senders beyond the first {SENDERS}: what these lost is not counted"
                yield event(words, level="error", source=STAGE, t=self._reached, t_rx=self._reached)
            if final or self._reached - self._bytes_told >= BYTES_ROW:
                self._bytes_told = self._reached
                for link in np.flatnonzero(self._bytes[:, _BYTES]).tolist():
                    yield self._account_of(link, now)
            yield Progress(vehicle=0, source=STAGE, boot=0, t=now, t_rx=now, final=final)

    def _hear(self, frames: Frames, until: int, fed: set[int]) -> Iterator[Message]:
        """Give every system its frames, and add to `fed` those that got some."""
        heard = Heard(frames, self._times.read(frames), *self._copies.tell(frames))
        sysids = np.unique(frames.sysid[frames.known]).tolist()
        for sysid in sysids:
            if sysid not in self._systems:
                make = self._instruments
                self._systems[sysid] = System(sysid, self._links, self._dialect, self._settings.mark, make)
        ground = said_on_the_ground(frames)
        spoken = bool(ground.any())
        present = set(sysids if frames.known.all() else np.unique(frames.sysid).tolist())
        for sysid, system in sorted(self._systems.items()):
            if sysid not in present and not spoken:
                continue
            mine = frames.sysid == sysid
            rows = np.flatnonzero(mine)
            system.notice(frames, rows)
            if spoken:  # takes its place on the vehicle's clock among the vehicle's own frames
                rows = np.flatnonzero(mine | ground & (frames.t_rx > system.heard))
            if len(rows):
                fed.add(sysid)
                yield from system.feed(
                    heard if len(rows) == len(frames) else heard.select(rows), self.accounts, until, False
                )

    def _unheard(self, station: System) -> Iterator[Event]:
        """Tell of the marks that a ground station said for nobody."""
        for t_rx, said, mark in station.marks:
            vehicles = [v for v, system in self._systems.items() if system.heard < t_rx]
            if not vehicles or (mark.vehicle and mark.vehicle not in vehicles):
                who = f"vehicle {mark.vehicle}" if mark.vehicle else "no vehicle"
                heard = f"{who} has {'not ' if mark.vehicle else ''}been heard yet"
                text = f"mark {said!r} is not used: {heard}; say it again when one is"
                yield event(text, level="warning", source=STAGE, t=t_rx, t_rx=t_rx)
        station.marks.clear()

    def _account_of(self, link: int, now: NDArray[np.int64]) -> LinkBytes:
        names = ("bytes", "frames", "unknown", "corrupt", "refused", "discarded", "pending")
        columns: dict[str, Any] = {name: self._bytes[link, i : i + 1].copy() for i, name in enumerate(names)}
        if link == 0:  # only a log, which is one link, can end inside a record
            columns["pending"] += self._pending
            columns["bytes"] += self._pending
        return LinkBytes(vehicle=0, source=self._links[link], boot=0, t=now, t_rx=now, **columns)
