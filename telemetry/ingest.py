"""The stage: frames to samples.

Every frame gets its place on its vehicle's clock, every sequence number its fate, and what a frame measures becomes
samples in SI units. Frames that cannot be placed yet (a vehicle whose clock has stepped back may have rebooted; the
next frames tell) wait for the next batch, and `Progress` says how far everything has been told. What is said
does not depend on how the stream was cut into batches; only how often the byte account is told does, and which of two
events about different things comes first.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from telemetry import text
from telemetry.archive import RawLog
from telemetry.clock import NO_TIME, BootClock, Epochs
from telemetry.clockfit import ClockFitter
from telemetry.frames import LATEST, Frames, join, scan_datagrams
from telemetry.link import LinkAccounts
from telemetry.mavlink import Dialect
from telemetry.messages import Event, LinkBytes, Mark, Message, Progress, StatusText, event
from telemetry.sensors import FEEDS, Sensors
from telemetry.text import REDUNDANT, GroundMark, Texts, ground_mark, is_addressed, is_station, said_on_the_ground

STAGE = "ingest"
AUTOPILOT = 1
HEARTBEAT, SYSTEM_TIME = 0, 2
UNIX_US = 10**15  # a time_usec above this is Unix time, below it is time since boot
RECEIVE_STEP = 1_000_000_000
BYTES_ROW = 1_000_000_000  # ns of receive time between two rows of the byte account
NEVER = np.iinfo(np.int64).max


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
    """

    dialect: str = "ardupilotmega"
    mark: str = text.MARK


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

    Yields
    ------
    Message
        Samples, texts, marks, events, link statistics and clock fits; after each batch a `Progress`, at the end a
        final one.
    """
    stage = _Ingest(links, dialect, settings or Settings())
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


def guarded(messages: Iterable[Message], raw_log: RawLog, dropped: Callable[[], int]) -> Iterator[Message]:
    """Pass on what is ingested live, and tell when evidence or samples are being lost.

    Parameters
    ----------
    messages : iterable of Message
    raw_log : RawLog
        What keeps the evidence; its `error` is told when it appears and when it is over.
    dropped : callable
        Frames that were archived but not handed on, because ingest could not follow.
    """
    error: str | None = None
    gone = 0
    for message in messages:
        now = int(message.t_rx[-1])
        if raw_log.error != error:
            error = raw_log.error
            said = f"ALARM: {error}" if error else f"{raw_log.path}: raw telemetry is being kept again"
            yield event(said, level="error" if error else "info", source=STAGE, t=now, t_rx=now)
        if dropped() > gone:
            said = f"ALARM: {dropped() - gone} frames are in the raw log only: ingest could not follow"
            gone = dropped()
            yield event(said, level="error", source=STAGE, t=now, t_rx=now)
        yield message  # afterwards: a final word has nobody listening behind it


class _Ingest:
    def __init__(self, links: Sequence[str], dialect: Dialect, settings: Settings) -> None:
        self._links, self._dialect, self._settings = links, dialect, settings
        self._systems: dict[int, _System] = {}
        self._accounts = LinkAccounts()
        self._bytes = np.zeros((len(links), 7), np.int64)
        self._bytes_told = 0
        self._pending = 0
        self._reached = 0  # receive time of everything told so far
        self._received = 0  # receive time of the newest frame
        self._shift = 0  # what the receive clock's steps back are made up by

    def batch(self, frames: Frames) -> Iterator[Message]:
        frames, said = self._forward(frames)
        yield from said
        self._count(frames)
        yield from self._advance(frames, frames.until, final=False)

    def finish(self) -> Iterator[Message]:
        now = self._received
        if self._pending:
            yield event(
                f"the log ends inside a record: its last {self._pending} bytes are left out",
                level="warning",
                source=STAGE,
                t=now,
                t_rx=now,
            )
        for link, (_, _, _, corrupt, _, discarded, _) in enumerate(self._bytes.tolist()):
            if discarded:
                yield event(
                    f"link {self._links[link]}: {discarded} bytes were no frame, {corrupt} frames were corrupt",
                    level="warning",
                    source=STAGE,
                    t=now,
                    t_rx=now,
                )
        yield from self._advance(None, now, final=True)

    def _forward(self, frames: Frames) -> tuple[Frames, list[Message]]:
        """Make receive time run forward: where the recorder's clock stepped back, what follows is moved up to it."""
        t_rx = frames.t_rx + self._shift
        said: list[Message] = []
        begin = self._received or (int(t_rx[0]) if len(t_rx) else 0)
        while True:
            newest = np.maximum.accumulate(np.concatenate([[begin], t_rx[:-1]])) if len(t_rx) else t_rx
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
        self._received = max(self._received, until, int(t_rx[-1]) if len(t_rx) else 0)
        if self._shift or not np.array_equal(t_rx, frames.t_rx):
            columns = {name: getattr(frames, name) for name in frames.__dataclass_fields__}
            frames = Frames(**(columns | {"t_rx": t_rx, "until": until}))
        return frames, said

    def _count(self, frames: Frames) -> None:
        self._pending = frames.pending
        for link in range(len(self._links)):
            mine, junk = frames.link == link, frames.junk_link == link
            inside, lost = int(frames.length[mine].sum()), int(frames.junk_length[junk].sum())
            self._bytes[link] += (
                inside + lost,
                mine.sum(),
                (mine & ~frames.known).sum(),
                frames.junk_corrupt[junk].sum(),
                0,
                lost,
                0,
            )

    def _advance(self, frames: Frames | None, until: int, final: bool) -> Iterator[Message]:
        verified = np.unique(frames.sysid[frames.known]).tolist() if frames is not None else []
        for sysid in verified:
            if sysid not in self._systems:
                self._systems[sysid] = _System(sysid, self._links, self._dialect, self._settings)
        ground = said_on_the_ground(frames) if frames is not None else np.empty(0, np.bool_)
        for sysid, system in sorted(self._systems.items()):
            new = None
            if frames is not None:
                mine = frames.sysid == sysid
                system.notice(frames, mine)
                if ground.any():  # takes its place on the vehicle's clock among the vehicle's own frames
                    mine |= ground & (frames.t_rx > system.heard)
                if len(rows := np.flatnonzero(mine)):
                    new = frames if len(rows) == len(frames) else frames.select(rows)
            if new is not None or system.waits or final or system.listens:
                yield from system.feed(new, self._accounts, until, final)
        for _, system in sorted(self._systems.items()):
            yield from self._unheard(system)
        waiting = [system.waits for system in self._systems.values() if system.waits]
        covered = min([until, *(t - 1 for t in waiting)])
        self._reached = max(self._reached, covered)
        now = np.array([self._reached], np.int64)
        if self._reached or final:
            if final:
                self._accounts.finish(self._received)
            else:
                self._accounts.advance(self._reached)
            yield from self._accounts.drain(self._links, lambda _: 0)
            if final or self._reached - self._bytes_told >= BYTES_ROW:
                self._bytes_told = self._reached
                for link in np.flatnonzero(self._bytes[:, 0]).tolist():
                    yield self._account_of(link, now)
            yield Progress(vehicle=0, source=STAGE, boot=0, t=now, t_rx=now, final=final)

    def _unheard(self, station: _System) -> Iterator[Event]:
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


class _System:
    """One system id: a vehicle, a ground station, a radio."""

    def __init__(self, sysid: int, links: Sequence[str], dialect: Dialect, settings: Settings) -> None:
        self.clock = BootClock(sysid)
        self.waits = 0  # receive time of the first frame that waits for its place, 0 if none does
        self.heard = NEVER  # receive time of the first frame that shows it to be a vehicle
        self.marks: list[tuple[int, str, GroundMark]] = []  # what it said as a ground station: time, words, meaning
        self._sysid, self._links, self._dialect, self._settings = sysid, links, dialect, settings
        self._held: Frames | None = None
        self._times = _BootTimes(dialect)
        self._fitter = ClockFitter(sysid, STAGE)
        self._sensors: dict[tuple[int, int], Sensors] = {}
        self._texts: dict[tuple[int, int], Texts] = {}  # by system, itself or a ground station, and component
        self._seen: set[int] = set()  # components whose heartbeat has been told
        self._verified: set[int] = set()  # components whose checksums are right

    def notice(self, frames: Frames, mine: NDArray[np.bool_]) -> None:
        """See whether it is a vehicle: one has an autopilot, or measures."""
        if self.heard == NEVER:
            shows = (frames.compid == AUTOPILOT) | np.isin(frames.msgid, list(_MEASURING))
            rows = np.flatnonzero(mine & frames.known & shows)
            self.heard = int(frames.t_rx[rows[0]]) if len(rows) else NEVER

    def feed(self, new: Frames | None, accounts: LinkAccounts, until: int, final: bool) -> Iterator[Message]:
        parts = [part for part in (self._held, new) if part is not None]
        if parts:
            yield from self._place(join(parts), accounts, until, final)
        yield from self._fits(final)
        covered = min(until, self.waits - 1) if self.waits else until
        for (sysid, compid), texts in self._texts.items():
            yield from self._spoken(sysid, compid, texts.expire(covered, final))

    def _place(self, frames: Frames, accounts: LinkAccounts, until: int, final: bool) -> Iterator[Message]:
        """Give the frames their place on the vehicle's clock, as far as it can be told, and decode those."""
        boot_time, modulus = self._times.read(frames)
        epochs = self.clock.feed(
            boot_time, frames.msgid.astype(np.int32), frames.t_rx, frames.seq, modulus, now=until, flush=final
        )
        n = epochs.decided
        self._held = frames.select(slice(n, None)).compact() if n < len(frames) else None
        self.waits = int(frames.t_rx[n]) if n < len(frames) else 0
        if n == 0:
            return
        self._times.commit(frames.compid[:n][boot_time[:n] != NO_TIME])
        done = frames if n == len(frames) else frames.select(slice(0, n))
        counted = self._counted(done)
        accounts.feed(
            done.link[counted],
            done.sysid[counted],
            done.compid[counted],
            done.seq[counted],
            done.t_rx[counted],
            done.checksum()[counted],
            epochs.restarted[counted],
            (epochs.timed & ~epochs.restarted)[counted],
        )
        for row, said in epochs.events:
            yield self._event("warning", said, epochs, row, done)
        self._fitter.feed(epochs, done.t_rx, self._unix(done))
        for boot in np.unique(epochs.epoch).tolist():
            yield from self._decode(done, epochs, np.flatnonzero(epochs.epoch == boot), boot)

    @property
    def listens(self) -> bool:
        """Whether a text waits for its end."""
        return any(texts.waits for texts in self._texts.values())

    def _counted(self, frames: Frames) -> NDArray[np.bool_]:
        """Frames that count: an unknown id proves nothing, so its sender must have been verified before."""
        own = frames.sysid == self._sysid
        known = frames.known & own
        counted = known.copy()
        for i in np.flatnonzero(~frames.known).tolist():
            same = frames.compid[:i] == frames.compid[i]
            counted[i] = int(frames.compid[i]) in self._verified or bool((same & known[:i]).any())
        self._verified |= set(np.unique(frames.compid[known]).tolist())
        ground = np.flatnonzero(said_on_the_ground(frames) & own)
        if len(ground):  # an addressed mark comes from a sender of its own, whose number continues nobody's
            said = self._dialect.decode(frames, text.MSGID, ground)
            counted[ground[[is_addressed(value) for value in said]]] = False
        return np.asarray(counted)

    def _decode(self, frames: Frames, epochs: Epochs, rows: NDArray[np.int64], boot: int) -> Iterator[Message]:
        known = rows[frames.known[rows]]
        spoken = known[frames.msgid[known] == text.MSGID]
        known = known[frames.sysid[known] == self._sysid]
        for row in known[frames.msgid[known] == HEARTBEAT].tolist():
            compid = int(frames.compid[row])
            if compid not in self._seen:
                self._seen.add(compid)
                (heartbeat,) = self._dialect.decode(frames, HEARTBEAT, np.array([row]))
                said = f"system {self._sysid} component {compid}: {_describe(heartbeat)}"
                yield self._event("info", said, epochs, row, frames)
        senders = frames.link[known].astype(np.int64) << 8 | frames.compid[known]
        for sender in np.unique(senders).tolist():
            link, compid = sender >> 8, sender & 255
            mine = known[senders == sender]
            msgids = frames.msgid[mine]
            decoded = {}
            for msgid in _MEASURING & set(np.unique(msgids).tolist()):
                which = mine[msgids == msgid]
                decoded[msgid] = which, self._dialect.decode(frames, msgid, which)
            if (link, compid) not in self._sensors:
                self._sensors[link, compid] = Sensors(self._sysid, f"{self._links[link]}/{compid}")
            yield from self._sensors[link, compid].samples(decoded, epochs.t, frames.t_rx, boot)
        speakers = frames.sysid[spoken].astype(np.int64) << 8 | frames.compid[spoken]
        for speaker in np.unique(speakers).tolist():
            sysid, compid = speaker >> 8, speaker & 255
            mine = spoken[speakers == speaker]
            if (sysid, compid) not in self._texts:
                source = f"{self._links[int(frames.link[mine[0]])]}/{compid}"
                self._texts[sysid, compid] = (
                    Texts(self._sysid, source, None, duplicate=REDUNDANT)  # a vehicle may say it back over its link
                    if is_station(sysid, compid)
                    else Texts(self._sysid, source, self._settings.mark)
                )
            values = self._dialect.decode(frames, text.MSGID, mine)
            texts = self._texts[sysid, compid].read(
                values, frames.seq[mine], frames.link[mine], epochs.t[mine], frames.t_rx[mine], boot
            )
            yield from self._spoken(sysid, compid, texts)

    def _spoken(self, sysid: int, compid: int, said: Sequence[StatusText | Mark]) -> Iterator[Message]:
        """What a component said; of what a ground station said to this vehicle, the marks."""
        for one in said:
            if sysid == self._sysid:
                yield one
            if not is_station(sysid, compid) or not isinstance(one, StatusText):
                continue
            found = ground_mark(one.text[0], self._settings.mark)
            if found and sysid == self._sysid:
                self.marks.append((int(one.t_rx[0]), one.text[0], found))
            if found and found.vehicle in (0, self._sysid) and one.t_rx[0] > self.heard:
                common: dict[str, Any] = {"vehicle": self._sysid, "boot": one.boot}
                yield Mark(
                    **common, source=one.source, t=one.t, t_rx=one.t_rx, action=[found.action], name=[found.name]
                )
                words = f"ground station {sysid}/{compid} marks the {found.action} of test point {found.name}"
                yield event(words, **common, source=STAGE, t=int(one.t[0]), t_rx=int(one.t_rx[0]))

    def _unix(self, frames: Frames) -> NDArray[np.int64]:
        """UTC that each frame tells, ns; 0 for the frames that tell none."""
        unix = np.zeros(len(frames), np.int64)
        rows = np.flatnonzero((frames.msgid == SYSTEM_TIME) & frames.known)
        if len(rows):
            us = self._dialect.decode(frames, SYSTEM_TIME, rows)["time_unix_usec"]
            plausible = (us > UNIX_US) & (us < LATEST)  # 0 before the vehicle knows it
            unix[rows] = np.where(plausible, us, 0).astype(np.int64) * 1000
        return unix

    def _fits(self, final: bool) -> Sequence[Message]:
        if final:
            self._fitter.finish()
        return self._fitter.drain()

    def _event(
        self, level: Literal["info", "warning", "error"], said: str, epochs: Epochs, row: int, frames: Frames
    ) -> Event:
        return event(
            said,
            level=level,
            vehicle=self._sysid,
            source=STAGE,
            boot=int(epochs.epoch[row]),
            t=int(epochs.t[row]),
            t_rx=int(frames.t_rx[row]),
        )


class _BootTimes:
    """Time since boot in the frames of one system that tell it.

    A system has one clock, its autopilot's; what other components call time since boot is their own, and is used only
    as long as no autopilot has spoken.
    """

    def __init__(self, dialect: Dialect) -> None:
        self._dialect = dialect
        self._fields: dict[
            int, tuple[str, int, int]
        ] = {}  # message id -> field, ns per unit, range of the counter in ns
        for msgid, layout in dialect.layouts.items():
            names = layout.names or ()
            if "time_boot_ms" in names:
                self._fields[msgid] = "time_boot_ms", 1_000_000, (1 << 32) * 1_000_000
            elif "time_usec" in names:
                width = layout["time_usec"].itemsize
                self._fields[msgid] = "time_usec", 1_000, (1 << 32) * 1_000 if width == 4 else 0
        self._told: int | None = None  # component whose clock it is

    def read(self, frames: Frames) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Time since boot and range of its counter, ns, of every frame; `NO_TIME` where there is none."""
        boot_time = np.full(len(frames), NO_TIME, np.int64)
        modulus = np.zeros(len(frames), np.int64)
        for msgid in np.unique(frames.msgid[frames.known]).tolist():
            if msgid not in self._fields:
                continue
            field, unit, span = self._fields[msgid]
            rows = np.flatnonzero((frames.msgid == msgid) & frames.known)
            value = self._dialect.decode(frames, msgid, rows)[field].astype(np.uint64)
            usable = (value > 0) & (value < UNIX_US)
            boot_time[rows[usable]] = value[usable].astype(np.int64) * unit
            modulus[rows] = span
        timed = boot_time != NO_TIME
        boot_time[timed & ~self._ours(frames, timed)] = NO_TIME
        return boot_time, modulus

    def _ours(self, frames: Frames, timed: NDArray[np.bool_]) -> NDArray[np.bool_]:
        autopilot = frames.compid == AUTOPILOT
        if self._told == AUTOPILOT:
            return np.asarray(autopilot)
        spoken = np.logical_or.accumulate(autopilot & timed)
        first = self._told
        if first is None:
            where = np.flatnonzero(timed)
            first = int(frames.compid[where[0]]) if len(where) else AUTOPILOT
        return np.asarray(np.where(spoken, autopilot, frames.compid == first))

    def commit(self, components: NDArray[np.uint8]) -> None:
        """Remember whose clock it is, by the components whose times have been used."""
        if len(components) and self._told != AUTOPILOT:
            self._told = AUTOPILOT if (components == AUTOPILOT).any() else int(components[0])


_MEASURING = {feed.msgid for feed in FEEDS}


def _describe(heartbeat: Any) -> str:
    from pymavlink.dialects.v20 import ardupilotmega

    def name(group: str, value: int) -> str:
        entry = ardupilotmega.enums[group].get(value)
        return entry.name.removeprefix(group + "_").lower().replace("_", " ") if entry else f"unknown {value}"

    return f"{name('MAV_TYPE', int(heartbeat['type']))}, autopilot {name('MAV_AUTOPILOT', int(heartbeat['autopilot']))}"
