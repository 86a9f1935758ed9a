"""The sensors of one vehicle: columns of its messages to samples, and what was chosen, refused and why."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from telemetry.mavlink import Dialect
from telemetry.messages import Message, Sample
from telemetry.sensors.batch import Batch, Level, told
from telemetry.sensors.feeds import Feed
from telemetry.sensors.overrides import FEEDS, KINDS, SensorSettings, check
from telemetry.sensors.own import OwnFeed, own_feeds
from telemetry.sensors.refused import Refused
from telemetry.sensors.selection import Selection
from telemetry.sensors.stream import AUTOPILOT, Autopilots, Stream, Use

HEARTBEAT = 0
STREAMS = 256
"""Messages of instruments of components that are told apart for one vehicle."""

HELD = "it repeats the time before it (held values)"
DERIVED = "an ArduPilot derives it from its filter, so it is no vane's (or which autopilot it is has not been told yet)"

Decoded = Mapping[tuple[int, int], tuple[NDArray[np.int64], NDArray[Any]]]


class _Kind(NamedTuple):
    """What is known of one message id: its time field, where the instance stands, and what it feeds."""

    stamp: str | None
    instance: int | str
    feeds: tuple[Feed, ...]


class _Own:
    """A feed of the settings' own making, in use."""

    def __init__(self, feed: OwnFeed, use: Use, stamp: str | None) -> None:
        self.feed, self.use, self.stamp = feed, use, stamp
        self.stream: Stream | None = None
        self.others = Refused()


class Sensors:
    """The sensors of one vehicle.

    Parameters
    ----------
    vehicle : int
    settings : SensorSettings
    dialect : Dialect

    Attributes
    ----------
    msgids : frozenset of int
        The messages that `samples` wants decoded.

    Raises
    ------
    ValueError
        If the settings do not fit the dialect.
    """

    def __init__(self, vehicle: int, settings: SensorSettings, dialect: Dialect) -> None:
        check(settings, dialect)
        self._vehicle, self._settings = vehicle, settings
        self._wanted = {kind: settings.wanted(kind) for kind in KINDS}
        self._messages: dict[int, _Kind] = {}
        for feed in FEEDS:
            wanted = self._wanted[feed.kind]
            asked = wanted is not None and wanted.message == feed.message
            if dialect.names.get(feed.msgid) == feed.message and (asked or not feed.asked):
                before = self._messages.get(feed.msgid)
                feeds = (*before.feeds, feed) if before else (feed,)
                self._messages[feed.msgid] = _Kind(_stamp(dialect, feed.msgid), feed.instance, feeds)
        self._own: dict[int, list[_Own]] = {}
        self._prepare_own(dialect)
        self.msgids = frozenset({HEARTBEAT} & set(dialect.names)) | self._messages.keys() | self._own.keys()
        self._streams: dict[tuple[int, int, int], Stream] = {}
        self._selections = {kind: Selection(kind, settings) for kind in KINDS}
        self._autopilots = Autopilots()
        self._boot = 0
        self._left_out = Refused()

    def _prepare_own(self, dialect: Dialect) -> None:
        uses: dict[type[Sample], Use] = {}
        for feed in own_feeds(self._settings, dialect):
            if feed.kind not in uses:
                uses[feed.kind] = Use(feed.words, "as [ingest.sensors] says", (False, -1, False, 0), feed.kind)
            elif feed.words not in uses[feed.kind].words:
                uses[feed.kind].words += f" and {feed.words}"
            self._own.setdefault(feed.msgid, []).append(_Own(feed, uses[feed.kind], _stamp(dialect, feed.msgid)))

    def samples(
        self,
        decoded: Decoded,
        sources: Mapping[int, str],
        t: NDArray[np.int64],
        t_rx: NDArray[np.int64],
        t_sigma: NDArray[np.float64] | None,
        boot: int,
    ) -> list[Message]:
        """What a batch of frames of one boot epoch measures.

        Parameters
        ----------
        decoded : mapping of (int, int) to (int64 array, structured array)
            Per component and message id of `msgids` the rows of the batch, in order of arrival, and their payloads.
        sources : mapping of int to str
            ``"link/component"`` of every component.
        t, t_rx : int64 array
            Times of the whole batch, indexed by those rows; `t_rx` does not decrease.
        t_sigma : float64 array or None
            Standard deviation of `t`, s, 0 where the vehicle told it; None where it told all.
        boot : int

        Returns
        -------
        list of Message
            Samples, rows in order of arrival, and events: what is chosen and what is not used, with the reasons.
        """
        batch = Batch(self._vehicle, t, t_rx, t_sigma, boot)
        if boot != self._boot:
            self._boot = boot
            for use in (use for stream in self._streams.values() for use in stream.uses):
                use.begin()
        for (component, msgid), (rows, values) in decoded.items():
            if msgid == HEARTBEAT and len(rows):
                self._autopilots.hear(component, rows, values)
        for component, stream, rows, values in self._instruments(decoded, sources, batch):
            held = stream.held(values)
            if held is not None:
                batch.refuse(stream.refused, stream.words, HELD, rows[held])
                rows, values = rows[~held], values[~held]
            if len(rows):
                for use in stream.uses:
                    self._read(use, component, stream.source, rows, values, batch)
        if self._own:
            self._read_own(decoded, sources, batch)
        self._autopilots.end()
        for kind in KINDS:
            if kind in batch.parts:
                self._selections[kind].tell(batch.parts[kind], batch)
        return batch.out

    def finish(self, t: int, t_rx: int, boot: int) -> list[Message]:
        """At the end of the stream: how much was not used, and what was asked for in vain."""
        out: list[Message] = []

        def say(text: str, level: Level = "info") -> None:
            out.append(told(self._vehicle, text, t, t_rx, boot, level))

        for stream in self._streams.values():
            for words, refused in [(stream.words, stream.refused)] + [
                (f"{use.feed.kind.stream}: {use.words}", use.refused) for use in stream.uses if use.feed
            ]:
                for reason, count in refused.untold():
                    say(f"{words} was not used where {reason}: {count} rows in all")
        for own in (own for found in self._own.values() for own in found):
            if own.stream is None:
                say(f"{own.feed.kind.stream}: {own.feed.words} of [ingest.sensors] was never heard", "warning")
                continue
            for reason, count in (*own.stream.refused.untold(), *own.others.untold()):
                say(f"{own.stream.words} was not used where {reason}: {count} rows in all")
        for kind in KINDS:
            wanted = self._wanted[kind]
            if wanted is not None and not any(not use.rank[0] for use in self._selections[kind].uses):
                asked = getattr(self._settings, kind.stream)
                say(f"{kind.stream}: {asked} of [ingest.sensors] was never heard", "warning")
        return out

    def _instruments(
        self, decoded: Decoded, sources: Mapping[int, str], batch: Batch
    ) -> list[tuple[int, Stream, NDArray[np.int64], NDArray[Any]]]:
        """The batch by instrument of component and message."""
        found: list[tuple[int, Stream, NDArray[np.int64], NDArray[Any]]] = []
        new: list[tuple[int, int, int, NDArray[np.int64], NDArray[Any]]] = []
        for (component, msgid), (rows, values) in decoded.items():
            message = self._messages.get(msgid)
            if message is None or not len(rows):
                continue
            for instance, some, mine in _instances(message.instance, rows, values):
                stream = self._streams.get((component, msgid, instance))
                if stream is not None:
                    found.append((component, stream, some, mine))
                else:
                    new.append((component, msgid, instance, some, mine))
        for component, msgid, instance, some, mine in sorted(new, key=lambda item: int(item[3][0])):
            if len(self._streams) < STREAMS:
                stream = self._stream(component, msgid, instance, sources[component])
                self._streams[component, msgid, instance] = stream
                found.append((component, stream, some, mine))
            else:
                batch.refuse(self._left_out, "what more is heard", f"{STREAMS} streams are followed", some)
        return found

    def _stream(self, component: int, msgid: int, instance: int, source: str) -> Stream:
        message = self._messages[msgid]
        which = f" (instance {instance})" if isinstance(message.instance, str) and instance else ""
        words = f"{message.feeds[0].message} of component {component}{which}"
        uses = []
        for feed in message.feeds:
            wanted = self._wanted[feed.kind]
            first = (
                wanted is not None
                and wanted.message == feed.message
                and wanted.component in (None, component)
                and wanted.instance in (None, instance)
            )
            if feed.asked and not first:
                continue
            rank = (not first, feed.rank, component != AUTOPILOT, instance)
            why = "as [ingest.sensors] says" if first else feed.why
            believed = first or (feed.doubt is None and not feed.derived)
            uses.append(Use(words, why, rank, (component, instance), feed, believed=believed))
        return Stream(words, f"{source}.{instance}" if instance else source, uses, message.stamp)

    @np.errstate(invalid="ignore")  # any bits may come from a wire: a signalling NaN is a NaN
    def _read(
        self, use: Use, component: int, source: str, rows: NDArray[np.int64], values: NDArray[Any], batch: Batch
    ) -> None:
        """What rows of one stream say of one kind of sensor."""
        feed = use.feed
        assert feed is not None
        words = f"{feed.kind.stream}: {use.words}"
        if feed.updated:
            fields = values["fields_updated"]
            present = (fields & feed.updated[0]) == feed.updated[0]
            for bits in feed.updated[1:]:
                present |= (fields & bits) == bits
            if not present.all():  # nothing is refused: the message says itself what is new in it
                rows, values = rows[present], values[present]
        if feed.derived and use.doubted and len(rows):
            derived = self._autopilots.derives(component, rows)
            if derived.any():
                batch.refuse(use.refused, words, DERIVED, rows[derived])
                rows, values = rows[~derived], values[~derived]
        if not len(rows):
            return
        refusals, columns = feed.convert(values, self._settings)
        valid = batch.valid(use.refused, words, refusals, rows)
        if feed.doubt is not None and use.doubted:
            kept = np.flatnonzero(valid) if valid is not None else np.arange(len(rows))
            if len(kept):
                doubted = use.weigh(feed.doubt.shows(values[kept]), feed.doubt.running)
                if doubted.any():
                    batch.refuse(use.refused, words, feed.doubt.reason, rows[kept[doubted]])
                    valid = np.ones(len(rows), np.bool_) if valid is None else valid
                    valid[kept[doubted]] = False
        batch.add(feed.kind, use, source, rows, columns, valid)

    @np.errstate(invalid="ignore")  # any bits may come from a wire: a signalling NaN is a NaN
    def _read_own(self, decoded: Decoded, sources: Mapping[int, str], batch: Batch) -> None:
        for own in (own for found in self._own.values() for own in found):
            feed = own.feed
            heard: list[tuple[int, NDArray[np.int64], NDArray[Any]]] = []
            for (component, msgid), (rows, values) in decoded.items():
                if msgid == feed.msgid and len(rows):
                    mine = feed.mine(values)
                    rows, values = (rows, values) if mine is None else (rows[mine], values[mine])
                    if len(rows):
                        heard.append((component, rows, values))
            for component, rows, values in sorted(heard, key=lambda item: int(item[1][0])):
                if feed.component is None:
                    feed.component = component
                words = f"{feed.kind.stream}: {feed.words} of component {component}"
                if component != feed.component:
                    reason = f"component {feed.component} says it too (component = {component} would choose it)"
                    batch.refuse(own.others, words, reason, rows)
                    continue
                if own.stream is None:
                    own.stream = Stream(words, sources[component], (), own.stamp)
                held = own.stream.held(values)
                if held is not None:
                    batch.refuse(own.stream.refused, words, HELD, rows[held])
                    rows, values = rows[~held], values[~held]
                if len(rows):
                    refusals, columns = feed.convert(values)
                    valid = batch.valid(own.stream.refused, words, refusals, rows)
                    batch.add(feed.kind, own.use, own.stream.source, rows, columns, valid)


def _stamp(dialect: Dialect, msgid: int) -> str | None:
    names = dialect.layouts[msgid].names or ()
    return next((name for name in ("time_usec", "time_boot_ms") if name in names), None)


def _instances(
    instance: int | str, rows: NDArray[np.int64], values: NDArray[Any]
) -> list[tuple[int, NDArray[np.int64], NDArray[Any]]]:
    """The rows of each instrument."""
    if isinstance(instance, int):
        return [(instance, rows, values)]
    told = values[instance]
    first = int(told[0])
    if len(told) == 1 or (told == first).all():
        return [(first, rows, values)]
    return [(one, rows[told == one], values[told == one]) for one in np.unique(told).tolist()]
