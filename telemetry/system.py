"""One system: a vehicle, a ground station, a radio; what its frames say, placed on its own clock.

Frames that cannot be placed yet (a vehicle whose clock has stepped back may have rebooted; the next frames tell) wait
for the next batch.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import pairwise
from typing import Any, Literal, Protocol

import numpy as np
from numba import njit
from numpy.typing import NDArray

from telemetry import text
from telemetry.boottimes import AUTOPILOT, Owner, Told
from telemetry.clock import NO_TIME, BootClock, Epochs
from telemetry.clockfit import ClockFitter
from telemetry.frames import Frames
from telemetry.heard import Heard, join
from telemetry.link import LinkAccounts
from telemetry.loss import BEGUN, CONTINUES, COPY, UNKNOWN_ID
from telemetry.mavlink import Dialect
from telemetry.messages import Event, Mark, Message, StatusText, event
from telemetry.redundant import FIRST, REDUNDANT
from telemetry.sensors import MEASURING
from telemetry.text import GroundMark, Texts, ground_mark, is_addressed, is_station, said_on_the_ground

STAGE = "ingest"
HEARTBEAT = 0
NEVER = np.iinfo(np.int64).max
FEW = 64  # frames of a batch that plain Python goes through faster than numpy

Rows = dict[tuple[int, int], NDArray[np.int64]]  # by component and message id
Decoded = dict[tuple[int, int], tuple[NDArray[np.int64], NDArray[Any]]]


class Instruments(Protocol):
    """What makes samples of a vehicle's messages (`telemetry.sensors.Sensors`)."""

    @property
    def msgids(self) -> frozenset[int]:
        """Ids of the messages it wants."""

    def samples(
        self,
        decoded: Decoded,
        sources: Mapping[int, str],
        t: NDArray[np.int64],
        t_rx: NDArray[np.int64],
        t_sigma: NDArray[np.float64] | None,
        boot: int,
    ) -> Sequence[Message]:
        """What the frames of a batch measure.

        Parameters
        ----------
        decoded : dict
            By component and message id: rows, and the payloads there.
        sources : mapping of int to str
            Source of the samples of each component.
        t, t_rx, t_sigma
            Times of the whole batch, ns, and standard deviation of t, s (0: the vehicle told it; None: everywhere).
        boot : int
        """

    def finish(self, t: int, t_rx: int, boot: int) -> Sequence[Message]:
        """What is left to say at the end."""


COMPONENTS = 32  # of one system that are told: what invents more must not become a flood of events


class System:
    """What one system id says.

    Parameters
    ----------
    sysid : int
    links : sequence of str
        Names of the links that the frames number.
    dialect : Dialect
    mark : str
        Regular expression of a test-point mark (`telemetry.text`).
    instruments : callable
        Makes its `Instruments`, when it is known to be a vehicle.

    Attributes
    ----------
    waits : int
        Receive time of the first frame that waits for its place, ns; 0 if none does.
    heard : int
        Receive time of the first frame that shows it to be a vehicle, ns.
    marks : list of (int, str, GroundMark)
        What it said as a ground station: time, words, meaning.
    """

    def __init__(
        self, sysid: int, links: Sequence[str], dialect: Dialect, mark: str, instruments: Callable[[int], Instruments]
    ) -> None:
        self.waits = 0
        self.heard = NEVER
        self.marks: list[tuple[int, str, GroundMark]] = []
        self._sysid, self._links, self._dialect, self._mark = sysid, links, dialect, mark
        self._make_instruments = instruments
        self._clock = BootClock(sysid)
        self._held: Heard | None = None
        self._owner = Owner()
        self._fitter = ClockFitter(sysid, STAGE)
        self._sources: dict[int, str] = {}  # by component: the link it was first heard on, and its number
        self._instruments: Instruments | None = None
        self._texts: dict[tuple[int, int], Texts] = {}  # by system, itself or a ground station, and component
        self._seen: set[int] = set()  # components whose heartbeat has been told
        self._verified: set[int] = set()  # components whose checksums are right
        self._stale = -1  # boot epoch in which stale frames have been told

    def notice(self, frames: Frames, mine: NDArray[Any]) -> None:
        """See whether it is a vehicle: one has an autopilot, or measures."""
        if self.heard == NEVER:
            for row in mine.tolist():
                if frames.known[row] and (frames.compid[row] == AUTOPILOT or int(frames.msgid[row]) in MEASURING):
                    self.heard = int(frames.t_rx[row])
                    return

    @property
    def idle(self) -> bool:
        """Whether there is nothing to do for it while nothing of it arrives."""
        return not self.waits and not any(texts.waits for texts in self._texts.values())

    def feed(self, new: Heard | None, accounts: LinkAccounts, until: int, final: bool) -> Iterator[Message]:
        """Take its frames of a batch, and say what can be told.

        Parameters
        ----------
        new : Heard or None
            Its frames, and texts of ground stations.
        accounts : LinkAccounts
            Given the frames that are decided.
        until : int
            Receive time that the whole stream has reached, ns.
        final : bool
            Nothing will follow.
        """
        heard = new if self._held is None else self._held if new is None else join(self._held, new)
        if heard is not None:
            yield from self._place(heard, accounts, until, final)
        if final:
            self._fitter.finish()
            if self._instruments:
                t = self._clock.place(until)
                yield from self._instruments.finish(t, until, self._clock.epoch)
        yield from self._fitter.drain()
        if self._texts:
            covered = min(until, self.waits - 1) if self.waits else until
            for (sysid, compid), texts in self._texts.items():
                if texts.waits:
                    yield from self._spoken(sysid, compid, texts.expire(covered, final))

    def _place(self, heard: Heard, accounts: LinkAccounts, until: int, final: bool) -> Iterator[Message]:
        """Give the frames their place on the vehicle's clock, as far as it can be told, and decode those."""
        frames = heard.frames
        told = self._owner.strip(heard.told, frames.compid)
        epochs = self._clock.feed(
            told.t_boot,
            frames.msgid.astype(np.int32),
            frames.t_rx,
            frames.seq,
            told.modulus,
            frames.link,
            heard.copy != FIRST,
            told.unix,
            now=until,
            flush=final,
        )
        n = epochs.decided
        self._held, self.waits = None, 0
        if n < len(frames):
            self._held, self.waits = heard.kept(n), int(frames.t_rx[n])
            if n == 0:
                return
            heard = heard.select(slice(0, n))
            frames, told = heard.frames, Told(*(column[:n] for column in told))
        self._owner.commit(frames.compid[told.t_boot != NO_TIME])
        self._account(heard, epochs, accounts)
        for row, said in epochs.events:
            yield self._event("warning", said, epochs, row, frames)
        first = heard.copy == FIRST
        self._fitter.feed(epochs, frames.t_rx, np.where(first, told.unix, 0))
        yield from self._decode(frames, epochs, np.flatnonzero(frames.known & first))

    def _account(self, heard: Heard, epochs: Epochs, accounts: LinkAccounts) -> None:
        """Count the frames; one of an unknown id proves nothing, so its sender must have been verified before."""
        frames = heard.frames
        counted = frames.known & (frames.sysid == self._sysid)
        if not frames.known.all():
            verified = self._verified.copy()
            for i, compid in enumerate(frames.compid.tolist()):
                if frames.known[i]:
                    if counted[i]:
                        verified.add(compid)
                elif frames.sysid[i] == self._sysid:
                    counted[i] = compid in verified
        if len(frames) < FEW:
            self._verified.update(frames.compid[counted].tolist())
        else:
            self._verified.update(np.unique(frames.compid[counted]).tolist())
        if (frames.msgid == text.MSGID).any():
            ground = np.flatnonzero(said_on_the_ground(frames) & counted)
            if len(ground):  # an addressed mark comes from a sender of its own, whose number continues nobody's
                said = self._dialect.decode(frames, text.MSGID, ground)
                counted[ground[[is_addressed(value) for value in said]]] = False
        marks, vehicle = np.empty(len(frames), np.uint8), np.empty(len(frames), np.int64)
        _mark(epochs.restarted, epochs.timed, epochs.t, frames.known, heard.copy, marks, vehicle)
        columns = (frames.link, frames.sysid, frames.compid, frames.seq, frames.t_rx, heard.digest, marks, vehicle)
        accounts.feed(*(columns if counted.all() else (column[counted] for column in columns)))

    def _decode(self, frames: Frames, epochs: Epochs, rows: NDArray[np.int64]) -> Iterator[Message]:
        """What the frames at `rows`, first arrivals of known ids, say and measure."""
        ids = frames.msgid[rows]
        own = frames.sysid[rows] == self._sysid
        for row in rows[own & (ids == HEARTBEAT)].tolist():
            compid = int(frames.compid[row])
            if compid not in self._seen and len(self._seen) < COMPONENTS:
                self._seen.add(compid)
                (heartbeat,) = self._dialect.decode(frames, HEARTBEAT, np.array([row]))
                said = f"system {self._sysid} component {compid}: {_describe(heartbeat)}"
                yield self._event("info", said, epochs, row, frames)
        if len(mine := rows[own]):
            self._name_sources(frames, mine)
            yield from self._measure(frames, epochs, mine)
        if len(spoken := rows[ids == text.MSGID]):
            yield from self._say(frames, epochs, spoken)

    def _name_sources(self, frames: Frames, mine: NDArray[np.int64]) -> None:
        """A component keeps the name of the link it was first heard on."""
        compid = frames.compid[mine]
        new = set(compid.tolist() if len(mine) < FEW else np.unique(compid).tolist()) - self._sources.keys()
        for component in new:
            link = int(frames.link[mine[np.argmax(compid == component)]])
            self._sources[component] = f"{self._links[link]}/{component}"

    def _measure(self, frames: Frames, epochs: Epochs, mine: NDArray[np.int64]) -> Iterator[Message]:
        """The samples in its own frames."""
        if self._instruments is None:
            if self.heard == NEVER:
                return
            self._instruments = self._make_instruments(self._sysid)
        if frames.t_rx[mine[0]] < self.heard:
            mine = mine[frames.t_rx[mine] >= self.heard]
        t_sigma = np.asarray(epochs.sigma * 1e-9, np.float64)
        for boot, stale, found in _groups(frames, epochs, mine, self._instruments.msgids):
            if stale:
                yield from self._outlived(found, epochs, frames)
                continue
            decoded = {key: (which, self._dialect.decode(frames, key[1], which)) for key, which in found.items()}
            yield from self._instruments.samples(decoded, self._sources, epochs.t, frames.t_rx, t_sigma, boot)

    def _outlived(self, found: Rows, epochs: Epochs, frames: Frames) -> Iterator[Event]:
        """What was measured before a reboot comes too late to be used when the boot after it has begun."""
        row = min(int(which[0]) for which in found.values())
        if self._stale < epochs.epoch[row]:
            self._stale = int(epochs.epoch[row])
            link = self._links[int(frames.link[row])]
            said = f"vehicle {self._sysid}: link {link} brings samples of before the reboot after it: not used"
            yield self._event("warning", said, epochs, row, frames)

    def _say(self, frames: Frames, epochs: Epochs, spoken: NDArray[np.int64]) -> Iterator[Message]:
        """The texts among the frames."""
        speakers = (
            (frames.sysid[spoken].astype(np.int64) << 8 | frames.compid[spoken]) << 32 | epochs.epoch[spoken]
        ).tolist()
        for speaker in sorted(set(speakers), key=lambda key: (key & 0xFFFFFFFF, key)):
            sysid, compid, boot = speaker >> 40, speaker >> 32 & 255, speaker & 0xFFFFFFFF
            mine = spoken[[key == speaker for key in speakers]]
            if (sysid, compid) not in self._texts:
                source = self._sources.get(compid) if sysid == self._sysid else None
                source = source or f"{self._links[int(frames.link[mine[0]])]}/{compid}"
                self._texts[sysid, compid] = (
                    Texts(self._sysid, source, None, duplicate=text.REDUNDANT)  # a vehicle may say it back
                    if is_station(sysid, compid)
                    else Texts(self._sysid, source, self._mark)
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
            found = ground_mark(one.text[0], self._mark)
            if found and sysid == self._sysid:
                self.marks.append((int(one.t_rx[0]), one.text[0], found))
            if found and found.vehicle in (0, self._sysid) and one.t_rx[0] > self.heard:
                common: dict[str, Any] = {"vehicle": self._sysid, "boot": one.boot}
                yield Mark(
                    **common, source=one.source, t=one.t, t_rx=one.t_rx, action=[found.action], name=[found.name]
                )
                words = f"ground station {sysid}/{compid} marks the {found.action} of test point {found.name}"
                yield event(words, **common, source=STAGE, t=int(one.t[0]), t_rx=int(one.t_rx[0]))

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


@njit(cache=True, nogil=True)
def _mark(restarted, timed, t, known, copy, marks, vehicle):  # type: ignore[no-untyped-def]
    """What the loss account is to know of frames: marks, and the vehicle's time where it is told."""
    for i in range(len(known)):
        mark = BEGUN if restarted[i] else CONTINUES if timed[i] else 0
        if not known[i]:
            mark |= UNKNOWN_ID
        if copy[i] == REDUNDANT:
            mark |= COPY
        marks[i] = mark
        vehicle[i] = t[i] if timed[i] else 0


def _groups(
    frames: Frames, epochs: Epochs, rows: NDArray[np.int64], wanted: frozenset[int]
) -> Iterator[tuple[int, bool, Rows]]:
    """The rows of wanted ids by boot epoch and staleness: of each component and id, in the order of arrival."""
    if len(rows) < FEW:
        some: dict[tuple[int, bool], dict[tuple[int, int], list[int]]] = {}
        columns = (
            epochs.epoch[rows].tolist(),
            epochs.stale[rows].tolist(),
            frames.compid[rows].tolist(),
            frames.msgid[rows].tolist(),
            rows.tolist(),
        )
        for boot, stale, compid, msgid, row in zip(*columns, strict=True):
            if msgid in wanted:
                some.setdefault((boot, stale), {}).setdefault((compid, msgid), []).append(row)
        for (boot, stale), found in sorted(some.items(), key=lambda item: item[0]):
            yield boot, stale, {key: np.array(found[key], np.int64) for key in sorted(found)}
        return
    rows = rows[np.isin(frames.msgid[rows], list(wanted))]
    if not len(rows):
        return
    keys = (epochs.epoch[rows] << 1 | epochs.stale[rows]) << 32 | frames.compid[rows].astype(np.int64) << 24
    keys |= frames.msgid[rows]
    order = np.argsort(keys, kind="stable")
    keys, rows = keys[order], rows[order]
    cuts = [0, *(np.flatnonzero(np.diff(keys)) + 1).tolist(), len(rows)]
    group: Rows = {}
    for begin, end in pairwise(cuts):
        key = int(keys[begin])
        group[key >> 24 & 255, key & 0xFFFFFF] = rows[begin:end]
        if end == len(rows) or int(keys[end]) >> 32 != key >> 32:
            yield key >> 33, bool(key >> 32 & 1), group
            group = {}


def _describe(heartbeat: Any) -> str:
    from pymavlink.dialects.v20 import ardupilotmega

    def name(group: str, value: int) -> str:
        entry = ardupilotmega.enums[group].get(value)
        return entry.name.removeprefix(group + "_").lower().replace("_", " ") if entry else f"unknown {value}"

    return f"{name('MAV_TYPE', int(heartbeat['type']))}, autopilot {name('MAV_AUTOPILOT', int(heartbeat['autopilot']))}"
