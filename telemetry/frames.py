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
agrees. A record's time cannot be checked either: a day or more off the record before, it counts only where the record
after agrees, so that a damaged one dates nothing but a lasting step of the recorder's clock is kept.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

STX1, STX2 = 0xFE, 0xFD
LONGEST = 280
HEADER = 8
JUNK = b"\x00junk"
JUNK_HEADER = HEADER + len(JUNK) + 2
LONGEST_JUNK = 0xFFFF
LATEST = 7_258_118_400_000_000  # the year 2200, us: what lies beyond is no time
DAY = 86_400_000_000  # us

_NOTHING, _GOOD, _UNKNOWN, _CORRUPT, _SHORT = range(5)


@dataclass(frozen=True, slots=True)
class Frames:
    """A batch of frames in the order of their arrival, in columns.

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

    def checksum(self) -> NDArray[np.int64]:
        """Checksum bytes of every frame, shape (k,): tells a repeated frame from a different one of the same number."""
        signed = (self.data[self.start] == STX2) & (self.data[np.minimum(self.start + 2, len(self.data) - 1)] & 1 == 1)
        end = self.start + self.length - 13 * signed
        low, high = self.data[end - 2].astype(np.int64), self.data[end - 1].astype(np.int64)
        return np.asarray(low | high << 8)


_PER_FRAME = ("start", "length", "msgid", "link", "sysid", "compid", "seq", "known", "t_rx")
_PER_JUNK = ("junk_start", "junk_length", "junk_t_rx", "junk_link", "junk_corrupt")
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


def _crc_table() -> NDArray[np.uint16]:
    table = np.arange(256, dtype=np.uint16)
    for _ in range(8):
        table = np.where(table & 1, table >> 1 ^ 0x8408, table >> 1).astype(np.uint16)
    return table


_CRC = _crc_table()  # CRC-16/MCRF4XX: reflected polynomial 0x1021, start 0xFFFF


@njit(cache=True, nogil=True)
def _frame_at(data, i, end, extra, table):  # type: ignore[no-untyped-def]
    """What begins at data[i], given that bytes from `end` on are not ours: (status, length, msgid)."""
    if i >= end:
        return _NOTHING, 0, 0
    stx = data[i]
    if stx != STX2 and stx != STX1:
        return _NOTHING, 0, 0
    head = 10 if stx == STX2 else 6
    if i + head > end:
        return _SHORT, 0, 0
    size = np.int64(data[i + 1])
    length = head + size + 2
    if stx == STX2:
        if data[i + 2] & 0xFE:  # a flag from the future: not to be parsed
            return _NOTHING, 0, 0
        if data[i + 2] & 1:
            length += 13
        msgid = np.int64(data[i + 7]) | np.int64(data[i + 8]) << 8 | np.int64(data[i + 9]) << 16
    else:
        msgid = np.int64(data[i + 5])
    known = msgid < len(extra) and extra[msgid] >= 0
    if i + length > end:
        return _SHORT, length if known else 0, msgid
    if not known:
        return _UNKNOWN, length, msgid
    crc = np.int64(0xFFFF)
    body = i + head + size
    for k in range(i + 1, body):
        crc = crc >> 8 ^ table[(crc ^ data[k]) & 0xFF]
    crc = crc >> 8 ^ table[(crc ^ extra[msgid]) & 0xFF]
    if crc == np.int64(data[body]) | np.int64(data[body + 1]) << 8:
        return _GOOD, length, msgid
    return _CORRUPT, length, msgid


@njit(cache=True, nogil=True)
def _is_stx(data, i, end):  # type: ignore[no-untyped-def]
    return i < end and (data[i] == STX2 or data[i] == STX1)


@njit(cache=True, nogil=True)
def _is_corrupt(data, i, end, extra, table):  # type: ignore[no-untyped-def]
    """Whether a run of no frame, data[i:end], begins like one of a known id: told by its own bytes alone, so that it
    is the same live and out of the archive.
    """
    status, length, _ = _frame_at(data, i, end, extra, table)
    return status == _CORRUPT or (status == _SHORT and length > 0)


@njit(cache=True, nogil=True)
def _scan_datagrams(data, bounds, extra, table, rows, known, junk, corrupt):  # type: ignore[no-untyped-def]
    """Fill rows (k,4: start, length, msgid, datagram), known (k,), junk (j,3: start, length, datagram), corrupt
    (j,).
    """
    frames = 0
    runs = 0
    for record in range(len(bounds) - 1):
        i, end = bounds[record], bounds[record + 1]
        aligned = True
        while i < end:
            status, length, msgid = _frame_at(data, i, end, extra, table)
            if status == _GOOD or (
                status == _UNKNOWN and aligned and (i + length == end or _is_stx(data, i + length, end))
            ):
                rows[frames, 0], rows[frames, 1], rows[frames, 2], rows[frames, 3] = i, length, msgid, record
                known[frames] = status == _GOOD
                frames += 1
                aligned = True
                i += length
            else:
                if aligned:
                    junk[runs, 0], junk[runs, 1], junk[runs, 2] = i, 0, record
                    runs += 1
                aligned = False
                junk[runs - 1, 1] += 1
                i += 1
    for run in range(runs):
        corrupt[run] = _is_corrupt(data, junk[run, 0], junk[run, 0] + junk[run, 1], extra, table)
    return frames, runs


@njit(cache=True, nogil=True)
def _time_at(data, i):  # type: ignore[no-untyped-def]
    t = 0
    for k in range(8):
        t = t << 8 | int(data[i + k])
    return t


@njit(cache=True, nogil=True)
def _record_time(data, i, after, final, last, low):  # type: ignore[no-untyped-def]
    """Time of the record data[i:after], us: the record before's, `last`, if its own is not to be believed (such
    records are not counted); -1 if that depends on the record after and it is not here yet. The bits `low` are no
    time and always its own. The log's first record is believed.
    """
    t = _time_at(data, i)
    if 0 <= t < LATEST:
        if last <= low or -DAY < t - last < DAY:
            return t
        if after + HEADER > len(data):
            if not final:
                return -1
        elif -DAY < _time_at(data, after) - t < DAY:
            return t
    return last & ~low | t & low


@njit(cache=True, nogil=True)
def _mark_at(data, i, mark):  # type: ignore[no-untyped-def]
    """Whether data[i:] begins with the mark: _GOOD or _NOTHING; _SHORT if it ends before that can be told."""
    for k in range(len(mark)):
        if i + k >= len(data):
            return _SHORT
        if data[i + k] != mark[k]:
            return _NOTHING
    return _GOOD


@njit(cache=True, nogil=True)
def _scan_tlog(data, final, aligned, last, low, extra, table, rows, known, junk, corrupt, mark):  # type: ignore[no-untyped-def]
    """Fill rows (k,4: start, length, msgid, us), junk (j,3: start, length, us); return where it stopped and the
    account.

    `aligned`: data[0] is where a record should begin; if not, a run of discarded bytes that began in the block before
    goes on. `last`: time of the record before, us. `low`: bits of a time that are none.
    """
    i = 0
    n = len(data)
    frames = 0
    runs = 0
    headers = 0
    if not aligned:
        junk[0, 0], junk[0, 1], junk[0, 2] = 0, 0, last
        corrupt[0] = False
        runs = 1
    while i + HEADER < n:
        mine = _mark_at(data, i + HEADER, mark) if aligned else _NOTHING
        if mine != _NOTHING:
            start = i + JUNK_HEADER
            after = start
            if start <= n:
                after += int(data[start - 2]) | int(data[start - 1]) << 8
            if after <= n:
                t = _record_time(data, i, after, final, last, low)
                if t < 0:
                    break
                last = t
                junk[runs, 0], junk[runs, 1], junk[runs, 2] = start, after - start, last
                corrupt[runs] = _is_corrupt(data, start, after, extra, table)
                runs += 1
                headers += JUNK_HEADER
                i = after
                continue
            if not final:
                break
        status, length, msgid = _frame_at(data, i + HEADER, n, extra, table)
        if status == _SHORT and not final:
            break
        after = i + HEADER + length
        ok = status == _GOOD
        if status == _UNKNOWN and aligned:
            next_mark = _mark_at(data, after + HEADER, mark)
            if next_mark == _SHORT and not final:
                break
            ok = after == n or _is_stx(data, after + HEADER, n) or next_mark == _GOOD
        if ok:
            t = _record_time(data, i, after, final, last, low)
            if t < 0:
                break
            last = t
            rows[frames, 0], rows[frames, 1], rows[frames, 2], rows[frames, 3] = i + HEADER, length, msgid, last
            known[frames] = status == _GOOD
            frames += 1
            headers += HEADER
            i = after
            aligned = True
            continue
        if status == _SHORT and final and aligned and length > 0:
            break  # the log was cut inside its last frame
        if aligned:
            junk[runs, 0], junk[runs, 1], junk[runs, 2] = i, 0, last
            corrupt[runs] = status == _CORRUPT
            runs += 1
        aligned = False
        junk[runs - 1, 1] += 1
        i += 1
    return i, frames, runs, headers, aligned, last


def _room(size: int) -> tuple[NDArray[np.int64], NDArray[np.bool_], NDArray[np.int64], NDArray[np.bool_]]:
    frames = size // 8 + 2  # the shortest frame has 8 bytes
    return (
        np.empty((frames, 4), np.int64),
        np.empty(frames, np.bool_),
        np.empty((frames, 3), np.int64),
        np.empty(frames, np.bool_),
    )


def _columns(
    data: NDArray[np.uint8],
    rows: NDArray[np.int64],
    known: NDArray[np.bool_],
    link: NDArray[np.uint8],
    t_rx: NDArray[np.int64],
) -> dict[str, Any]:
    start = np.ascontiguousarray(rows[:, 0])
    header = np.where(data[start] == STX2, 4, 2)
    return {
        "start": start,
        "length": rows[:, 1].copy(),
        "msgid": rows[:, 2].copy(),
        "link": link,
        "sysid": data[start + header + 1],
        "compid": data[start + header + 2],
        "seq": data[start + header],
        "known": known.copy(),
        "t_rx": t_rx,
    }


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
    rows, known, junk, corrupt = _room(len(data) + 8 * len(bounds))
    frames, runs = _scan_datagrams(data, bounds, crc_extra, _CRC, rows, known, junk, corrupt)
    rows, junk = rows[:frames], junk[:runs]
    return Frames(
        data,
        **_columns(data, rows, known[:frames], link[rows[:, 3]], t_rx[rows[:, 3]]),
        junk_start=junk[:, 0].copy(),
        junk_length=junk[:, 1].copy(),
        junk_t_rx=t_rx[junk[:, 2]],
        junk_link=link[junk[:, 2]],
        junk_corrupt=corrupt[:runs].copy(),
        until=int(t_rx[-1]) if len(t_rx) else 0,
    )


class TlogScanner:
    """Find the records of a telemetry log, block by block.

    Parameters
    ----------
    crc_extra : int16 array
        As in `scan_datagrams`.
    links : int
        1: the time is a time. 2 to 4: its two lowest bits are the link number (only logs that are known to say so); a
        number beyond the links is damage and counts as link 0.
    """

    def __init__(self, crc_extra: NDArray[np.int16], links: int = 1) -> None:
        self._extra = crc_extra
        self._links = links
        self._low = 3 if links > 1 else 0
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
        rows, known, junk, corrupt = _room(len(data))
        stop, frames, runs, headers, self._aligned, self._last = _scan_tlog(
            data, final, self._aligned, self._last, self._low, self._extra, _CRC, rows, known, junk, corrupt, self._mark
        )
        self._rest = data[stop:]
        rows, junk, corrupt = rows[:frames], junk[:runs], corrupt[:runs]
        keep = junk[:, 1] > 0
        junk, corrupt = junk[keep], corrupt[keep]
        t_rx, link = self._split(rows[:, 3])
        junk_t_rx, junk_link = self._split(junk[:, 2])
        reached = (self._last & ~self._low) * 1000
        return Frames(
            data,
            **_columns(data, rows, known[:frames], link, t_rx),
            junk_start=junk[:, 0].copy(),
            junk_length=junk[:, 1].copy(),
            junk_t_rx=junk_t_rx,
            junk_link=junk_link,
            junk_corrupt=corrupt,
            headers=int(headers),
            pending=len(self._rest),
            until=reached - (not final) if reached else 0,
        )

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
