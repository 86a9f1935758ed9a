"""MAVLink bytes to frames, with nothing lost unaccounted.

A MAVLink frame (v2 above, v1 below; the checksum covers everything after STX and one secret byte per message id)::

    FD len incompat compat seq sysid compid id[3] payload[len] crc[2] (signature[13] if incompat & 1)
    FE len seq sysid compid id payload[len] crc[2]

A telemetry log (tlog) is a sequence of records, 8 bytes of big-endian microseconds (receive time, Unix) and then the
frame.
What arrived but was no frame is evidence too: our archive keeps it as a record of its own. Other readers take it for
noise and skip it; one that trusts the length byte of a broken frame may skip good ones behind it too::

    time[8] frame[...]
    time[8] 00 'j' 'u' 'n' 'k' length[2, little-endian] bytes[length]

After any failure the scan moves on by one byte, because a good frame may start inside a bad one. For every input::

    bytes in = bytes in frames + record headers + discarded + pending

A frame whose id the dialect does not know cannot be checked: it counts as a frame only where framing on both sides
agrees and no good frame lies in it. A record's time cannot be checked either: a day or more off the record before, it
counts only where the record after agrees, so that a damaged one dates nothing but a lasting step of the recorder's
clock is kept.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from fastcrc.crc16 import mcrf4xx
from numpy.typing import NDArray

from telemetry import framing
from telemetry.framing import CRC, DAY, HEADER, JUNK, JUNK_HEADER, LATEST, LONGEST, STX1, STX2, Room

__all__ = [
    "DAY", "HEADER", "JUNK", "JUNK_HEADER", "LATEST", "LONGEST", "LONGEST_JUNK", "STX1", "STX2",
    "Frames", "StreamScanner", "TlogScanner", "join", "scan_datagrams", "write_junk", "write_record",
]  # fmt: skip

LONGEST_JUNK = 0xFFFF
MOST_LINKS = 16


@dataclass(slots=True)  # a frozen one would take longer to make than a frame to find
class Frames:
    """A batch of frames in the order of their arrival, in columns, never changed once made.

    Attributes
    ----------
    data : uint8 array
        The bytes all frames and junk lie in.
    start, length : int64 array, shape (k,)
        Where a frame lies in `data`, from its STX to its last byte.
    msgid : int64 array, shape (k,)
    link, sysid, compid, seq : uint8 array, shape (k,)
        Link number and what the header says.
    known : bool array, shape (k,)
        False: an id that the dialect does not know, so its checksum was not verified.
    t_rx : int64 array, shape (k,)
        Receive time, ns of Unix time.
    junk_start, junk_length, junk_t_rx : int64 array, shape (j,)
        Runs of bytes that were no frame.
    junk_link : uint8 array, shape (j,)
    junk_corrupt : bool array, shape (j,)
        The run begins like a frame of a known id: a frame whose checksum failed.
    junk_refused : bool array, shape (j,)
        The run is one whole frame of a known id with the right checksum: one that was not accepted when it arrived,
        because of its signature. Such a run is found in our archive only.
    headers : int
        Bytes of record headers.
    pending : int
        Bytes at the end that may be the beginning of a frame.
    until : int
        All that came with ``t_rx <= until``, frames and junk, is in this batch or an earlier one.
    """

    data: NDArray[np.uint8]
    start: NDArray[np.int64]
    length: NDArray[np.int64]
    msgid: NDArray[np.int64]
    link: NDArray[np.uint8]
    sysid: NDArray[np.uint8]
    compid: NDArray[np.uint8]
    seq: NDArray[np.uint8]
    known: NDArray[np.bool_]
    t_rx: NDArray[np.int64]
    junk_start: NDArray[np.int64]
    junk_length: NDArray[np.int64]
    junk_t_rx: NDArray[np.int64]
    junk_link: NDArray[np.uint8]
    junk_corrupt: NDArray[np.bool_]
    junk_refused: NDArray[np.bool_]
    headers: int = 0
    pending: int = 0
    until: int = 0

    def __len__(self) -> int:
        return len(self.start)

    @property
    def discarded(self) -> int:
        """Bytes in no frame."""
        return int(self.junk_length.sum())

    def frame(self, i: int) -> bytes:
        """The bytes of frame i."""
        return self.data[self.start[i] : self.start[i] + self.length[i]].tobytes()

    def junk(self, i: int) -> bytes:
        """The bytes of the i-th discarded run."""
        return self.data[self.junk_start[i] : self.junk_start[i] + self.junk_length[i]].tobytes()

    def select(self, rows: NDArray[Any] | slice) -> Frames:
        """The frames at `rows` (mask, indices or slice), without junk."""
        columns: dict[str, Any] = {name: getattr(self, name)[rows] for name in _PER_FRAME}
        columns |= {name: getattr(self, name)[:0] for name in _PER_JUNK}
        return Frames(self.data, **columns, until=self.until)

    def compact(self) -> Frames:
        """The same frames, without junk, over bytes and columns of their own: for those kept while the rest may go."""
        end = np.cumsum(self.length)
        start = end - self.length
        rows = np.repeat(self.start - start, self.length) + np.arange(self.length.sum())
        return replace(self.select(np.arange(len(self))), data=self.data[rows], start=start)

    def refuse(self, mask: NDArray[np.bool_]) -> Frames:
        """The same with the frames of `mask` (bool, shape (k,)) among the junk, each a run of its own."""
        columns: dict[str, Any] = {name: getattr(self, name)[~mask] for name in _PER_FRAME}
        good = np.zeros(len(mask), np.bool_)
        runs: tuple[NDArray[Any], ...] = (self.start, self.length, self.t_rx, self.link, good, self.known)
        order = np.argsort(np.concatenate([self.junk_start, self.start[mask]]), kind="stable")
        for name, mine in zip(_PER_JUNK, runs, strict=True):
            columns[name] = np.concatenate([getattr(self, name), mine[mask]])[order]
        return replace(self, **columns)

    def checksum(self) -> NDArray[np.int64]:
        """Checksum bytes of every frame, shape (k,): tells a repeated frame from a different one of the same number."""
        signed = (self.data[self.start] == STX2) & (self.data[np.minimum(self.start + 2, len(self.data) - 1)] & 1 == 1)
        end = self.start + self.length - 13 * signed
        low, high = self.data[end - 2].astype(np.int64), self.data[end - 1].astype(np.int64)
        return np.asarray(low | high << 8)


_PER_FRAME = ("start", "length", "msgid", "link", "sysid", "compid", "seq", "known", "t_rx")
_PER_JUNK = ("junk_start", "junk_length", "junk_t_rx", "junk_link", "junk_corrupt", "junk_refused")
assert [f.name for f in fields(Frames)][1 : 1 + len(_PER_FRAME + _PER_JUNK)] == [*_PER_FRAME, *_PER_JUNK]


def join(batches: Sequence[Frames]) -> Frames:
    """One batch out of several, in their order; the account (headers, pending, until) is the last one's."""
    if len(batches) == 1:
        return batches[0]
    base = np.cumsum([0] + [len(b.data) for b in batches])
    columns: dict[str, Any] = {}
    for name in (*_PER_FRAME, *_PER_JUNK):
        shift = name.endswith("start")
        columns[name] = np.concatenate(
            [getattr(b, name) + (base[i] if shift else 0) if shift else getattr(b, name) for i, b in enumerate(batches)]
        )
    last = batches[-1]
    return Frames(
        np.concatenate([b.data for b in batches]),
        **columns,
        headers=sum(b.headers for b in batches),
        pending=last.pending,
        until=last.until,
    )


_SMALL = 1 << 12
_WIDE, _NARROW, _FLAGS = np.empty(0, np.int64), np.empty(0, np.uint8), np.empty(0, np.bool_)
_NO_RUNS = (_WIDE, _WIDE, _WIDE, _NARROW, _FLAGS, _FLAGS)
_NUMBER = [np.array([i]) for i in range(512)]
_BYTE = [np.array([i], np.uint8) for i in range(256)]
_KNOWN = np.ones(1, np.bool_)


def _frames(
    data: NDArray[np.uint8], room: Room, frames: int, runs: int, headers: int = 0, pending: int = 0, until: int = 0
) -> Frames:
    """What was found, in columns of its own length."""
    wide, narrow, flags = room
    if len(data) > _SMALL:  # most of the room is empty, and what is found may be kept for long
        wide, narrow, flags = wide[:, : max(frames, runs)].copy(), narrow[:, : max(frames, runs)].copy(), flags.copy()
    junk = _NO_RUNS
    if runs:
        r = slice(runs)
        junk = (wide[4, r], wide[5, r], wide[6, r], narrow[4, r], flags[1, r], flags[2, r])
    f = slice(frames)
    return Frames(
        data, wide[0, f], wide[1, f], wide[2, f], narrow[0, f], narrow[1, f], narrow[2, f], narrow[3, f], flags[0, f],
        wide[3, f], *junk, headers, pending, until,
    )  # fmt: skip


def _one_frame(
    data: NDArray[np.uint8], t_rx: NDArray[np.int64], link: NDArray[np.uint8], crc_extra: NDArray[np.int16]
) -> Frames | None:
    """What `framing.scan_datagrams` says of a datagram that is one good frame of a known id; else None.

    Nearly all live batches of a slow link are such, and calling compiled code and making columns for it would cost
    several times what the frame does.
    """
    raw = data.tobytes()
    length = len(raw)
    if length < 8:
        return None
    size, flags = raw[1], raw[2]
    if raw[0] == STX2 and length >= 12 and flags <= 1:
        body, end = 10 + size, 12 + size + 13 * flags
        seq, sysid, compid, low, middle, high = raw[4:10]
        msgid = low | middle << 8 | high << 16
    elif raw[0] == STX1:
        body, end = 6 + size, 8 + size
        seq, sysid, compid, msgid = raw[2:6]
    else:
        return None
    extra = crc_extra.item(msgid) if msgid < len(crc_extra) else -1
    if end != length or extra < 0:
        return None
    if mcrf4xx(raw[1:body] + extra.to_bytes(), 0xFFFF) != raw[body] | raw[body + 1] << 8:
        return None
    return Frames(
        data, _NUMBER[0], _NUMBER[length], _NUMBER[msgid] if msgid < 512 else np.array([msgid]),
        link, _BYTE[sysid], _BYTE[compid], _BYTE[seq], _KNOWN, t_rx, *_NO_RUNS, until=t_rx.item(),
    )  # fmt: skip


def scan_datagrams(
    data: NDArray[np.uint8],
    bounds: NDArray[np.int64],
    t_rx: NDArray[np.int64],
    link: NDArray[np.uint8],
    crc_extra: NDArray[np.int16],
) -> Frames:
    """Find the frames in datagrams; a frame never continues in the next one.

    Parameters
    ----------
    data : uint8 array
        The datagrams, end to end.
    bounds : int64 array, shape (d + 1,)
        Datagram i is ``data[bounds[i]:bounds[i + 1]]``.
    t_rx : int64 array, shape (d,)
        Receive times, ns, strictly increasing.
    link : uint8 array, shape (d,)
        Link numbers.
    crc_extra : int16 array
        The dialect's checksum byte per message id, -1 for an unknown id (`telemetry.mavlink.Dialect`).
    """
    if (
        len(t_rx) == 1
        and bounds.item(1) - bounds.item(0) == len(data)
        and (one := _one_frame(data, t_rx, link, crc_extra))
    ):
        return one
    room = framing.room(len(data) + 8 * len(bounds))
    frames, runs = framing.scan_datagrams(data, bounds, t_rx, link, crc_extra, CRC, *room)
    return _frames(data, room, frames, runs, until=t_rx.item(-1) if len(t_rx) else 0)


class StreamScanner:
    """Find the frames in the bytes of one connection (TCP, serial), block by block.

    A frame may be cut anywhere: what may be the beginning of one waits for the rest, and so do discarded bytes
    before it. Frames and runs are the same however the stream is cut into blocks. To that end a run ends where a frame
    begins or after 280 bytes, the length of the longest frame, and not where a block does; so at most 559 bytes wait,
    and a damaged frame is counted as corrupt once.

    Parameters
    ----------
    crc_extra : int16 array
        As in `scan_datagrams`.
    link : int
        The connection's link number.
    """

    def __init__(self, crc_extra: NDArray[np.int16], link: int = 0) -> None:
        self._extra = crc_extra
        self._link = link
        self._rest = b""
        self._held = 0  # bytes of it that are known to be in no frame
        self._aligned = True

    @property
    def pending(self) -> int:
        """Bytes that wait for the rest of a frame."""
        return len(self._rest)

    def scan(self, block: bytes, t_rx: int, final: bool = False) -> Frames:
        """The frames that the next block completes.

        Parameters
        ----------
        block : bytes
        t_rx : int
            Its receive time, ns, later than those before: that of all that is found now.
        final : bool
            The connection has ended: nothing stays pending.
        """
        data = np.frombuffer(self._rest + block, np.uint8)
        room = framing.room(len(data))
        frames, runs, stop, self._held, self._aligned = framing.scan_stream(
            data, self._held, self._aligned, final, t_rx, self._link, self._extra, CRC, *room
        )
        self._rest = data[stop:].tobytes()
        return _frames(data, room, frames, runs, pending=len(self._rest), until=t_rx)


def link_bits(links: int) -> int:
    """How many lowest bits of a record's microseconds are the link number, in a raw log of more than one link.

    Receive times are multiples of ``1 << link_bits(links)`` us, with one link too.

    Raises
    ------
    ValueError
        If there are more than 16 links, or none.
    """
    if not 0 < links <= MOST_LINKS:
        raise ValueError(f"{links} links: a raw log tells 1 to {MOST_LINKS} apart")
    return max(2, (links - 1).bit_length())


class TlogScanner:
    """Find the records of a telemetry log, block by block.

    Parameters
    ----------
    crc_extra : int16 array
        As in `scan_datagrams`.
    links : int
        1: the time is a time. More: its `link_bits` lowest bits are the link number (only logs that are known to say
        so); a number beyond the links is damage and counts as link 0.

    Raises
    ------
    ValueError
        If there are more links than a log tells apart.
    """

    def __init__(self, crc_extra: NDArray[np.int16], links: int = 1) -> None:
        self._extra = crc_extra
        self._links = links
        self._low = (1 << link_bits(links)) - 1 if links > 1 else 0
        self._rest = np.empty(0, np.uint8)
        self._aligned = True
        self._last: int = 0
        self._mark = np.frombuffer(JUNK, np.uint8)

    def scan(self, block: bytes, final: bool = False) -> Frames:
        """The frames of the next block; what may continue in the one after stays pending.

        Parameters
        ----------
        block : bytes
        final : bool
            Nothing will follow: what is pending then is a record cut short.
        """
        data = np.concatenate([self._rest, np.frombuffer(block, np.uint8)])
        room = framing.room(len(data))
        frames, runs, stop, headers, self._aligned, self._last = framing.scan_tlog(
            data, final, self._aligned, self._last, self._low, self._extra, CRC, *room, self._mark
        )
        self._rest = data[stop:]
        reached = (self._last & ~self._low) * 1000
        found = _frames(data, room, frames, runs, headers, len(self._rest), reached - (not final) if reached else 0)
        t_rx, link = self._split(found.t_rx)
        junk_t_rx, junk_link = self._split(found.junk_t_rx)
        return replace(found, t_rx=t_rx, link=link, junk_t_rx=junk_t_rx, junk_link=junk_link)

    def _split(self, us: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.uint8]]:
        link = us & self._low
        return (us - link) * 1000, np.where(link < self._links, link, 0).astype(np.uint8)


def write_record(us: int, frame: bytes) -> bytes:
    """A tlog record of one frame received at `us` microseconds."""
    return us.to_bytes(8, "big") + frame


def write_junk(us: int, junk: bytes) -> bytes:
    """Tlog records of bytes that were no frame, received at `us` microseconds."""
    pieces = [junk[i : i + LONGEST_JUNK] for i in range(0, len(junk), LONGEST_JUNK)]
    return b"".join(us.to_bytes(8, "big") + JUNK + len(piece).to_bytes(2, "little") + piece for piece in pieces)
