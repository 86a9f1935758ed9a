"""Where a frame begins and ends: the compiled half of `telemetry.frames`.

All of it fills a `room`, whose columns are those of `telemetry.frames.Frames`. What a discarded
run looks like is told by its own bytes alone, so that it is the same live and out of the archive.
"""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numba import njit
from numpy.typing import NDArray

STX1, STX2 = 0xFE, 0xFD
LONGEST = 280
HEADER = 8
JUNK = b"\x00junk"
JUNK_HEADER = HEADER + len(JUNK) + 2
LATEST = 7_258_118_400_000_000  # the year 2200, us: what lies beyond is no time
DAY = 86_400_000_000  # us

_NOTHING, _GOOD, _UNKNOWN, _CORRUPT, _SHORT = range(5)


Room: TypeAlias = tuple[NDArray[np.int64], NDArray[np.uint8], NDArray[np.bool_]]


def room(size: int) -> Room:
    """Columns for all that can be found in `size` bytes, to be filled, one row per frame or run.

    Returns
    -------
    int64 array, shape (7, k)
        Of frames: start, length, message id, receive time. Of runs: start, length, receive time.
    uint8 array, shape (5, k)
        Of frames: link, system, component, sequence number. Of runs: link.
    bool array, shape (3, k)
        Of frames: known. Of runs: corrupt, refused.
    """
    k = size // 8 + 2  # the shortest frame has 8 bytes
    return np.empty((7, k), np.int64), np.empty((5, k), np.uint8), np.empty((3, k), np.bool_)


def _crc_table() -> NDArray[np.uint16]:
    table = np.arange(256, dtype=np.uint16)
    for _ in range(8):
        table = np.where(table & 1, table >> 1 ^ 0x8408, table >> 1).astype(np.uint16)
    return table


CRC = _crc_table()  # CRC-16/MCRF4XX: reflected polynomial 0x1021, start 0xFFFF


@njit(cache=True, nogil=True)
def checksum(data, i, end, extra, table):  # type: ignore[no-untyped-def]
    """Of data[i:end] and the secret byte of the message id."""
    crc = np.int64(0xFFFF)
    for k in range(i, end):
        crc = crc >> 8 ^ table[(crc ^ data[k]) & 0xFF]
    return crc >> 8 ^ table[(crc ^ extra) & 0xFF]


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
    body = i + head + size
    if checksum(data, i + 1, body, extra[msgid], table) == np.int64(data[body]) | np.int64(data[body + 1]) << 8:
        return _GOOD, length, msgid
    return _CORRUPT, length, msgid


@njit(cache=True, nogil=True)
def _is_stx(data, i, end):  # type: ignore[no-untyped-def]
    return i < end and (data[i] == STX2 or data[i] == STX1)


@njit(cache=True, nogil=True)
def _is_hollow(data, i, end, extra, table):  # type: ignore[no-untyped-def]
    """Whether no good frame of a known id lies in data[i:end]: one would say more than an id that nobody knows."""
    for k in range(i, end):  # noqa: SIM110  numba has no all()
        if _is_stx(data, k, end) and _frame_at(data, k, end, extra, table)[0] == _GOOD:
            return False
    return True


@njit(cache=True, nogil=True)
def _put_frame(wide, narrow, flags, k, data, i, length, msgid, t_rx, link, known):  # type: ignore[no-untyped-def]
    wide[0, k], wide[1, k], wide[2, k], wide[3, k] = i, length, msgid, t_rx
    seq = i + (4 if data[i] == STX2 else 2)
    narrow[0, k], narrow[1, k], narrow[2, k], narrow[3, k] = link, data[seq + 1], data[seq + 2], data[seq]
    flags[0, k] = known


@njit(cache=True, nogil=True)
def _put_run(wide, narrow, flags, k, data, i, end, t_rx, link, extra, table):  # type: ignore[no-untyped-def]
    """A run of no frame, data[i:end]. Corrupt: it begins like a frame of a known id; refused: it is a good one."""
    wide[4, k], wide[5, k], wide[6, k] = i, end - i, t_rx
    narrow[4, k] = link
    status, length, _ = _frame_at(data, i, end, extra, table)
    flags[1, k] = status == _CORRUPT or (status == _SHORT and length > 0)
    flags[2, k] = status == _GOOD and length == end - i


@njit(cache=True, nogil=True)
def scan_datagrams(data, bounds, t_rx, link, extra, table, wide, narrow, flags):  # type: ignore[no-untyped-def]
    """Frames and runs in datagrams: datagram d is data[bounds[d]:bounds[d + 1]]."""
    frames = 0
    runs = 0
    for d in range(len(bounds) - 1):
        i, end = bounds[d], bounds[d + 1]
        begin = i  # of the run of no frame
        while i < end:
            status, length, msgid = _frame_at(data, i, end, extra, table)
            ok = status == _GOOD
            if status == _UNKNOWN and begin == i:
                ok = i + length == end or _is_stx(data, i + length, end)
                ok = ok and _is_hollow(data, i + 1, i + length, extra, table)
            if not ok:
                i += 1
                continue
            if begin < i:
                _put_run(wide, narrow, flags, runs, data, begin, i, t_rx[d], link[d], extra, table)
                runs += 1
            _put_frame(wide, narrow, flags, frames, data, i, length, msgid, t_rx[d], link[d], status == _GOOD)
            frames += 1
            i += length
            begin = i
        if begin < end:
            _put_run(wide, narrow, flags, runs, data, begin, end, t_rx[d], link[d], extra, table)
            runs += 1
    return frames, runs


@njit(cache=True, nogil=True)
def scan_stream(data, held, aligned, final, t_rx, link, extra, table, wide, narrow, flags):  # type: ignore[no-untyped-def]
    """Frames and runs in a stream whose first `held` bytes are known to be in no frame.

    `aligned`: the byte behind those follows a frame. A run is cut after `LONGEST` bytes, wherever the blocks end.
    Return their numbers, where the pending bytes begin, how many of them are in no frame, and aligned.
    """
    frames = 0
    runs = 0
    begin = 0
    i = held
    n = len(data)
    while i < n:
        status, length, msgid = _frame_at(data, i, n, extra, table)
        if status == _SHORT and not final:
            break
        ok = status == _GOOD
        if status == _UNKNOWN and aligned:
            if i + length == n and not final:
                break
            ok = i + length == n or _is_stx(data, i + length, n)
            ok = ok and _is_hollow(data, i + 1, i + length, extra, table)
        if ok:
            if begin < i:
                _put_run(wide, narrow, flags, runs, data, begin, i, t_rx, link, extra, table)
                runs += 1
            _put_frame(wide, narrow, flags, frames, data, i, length, msgid, t_rx, link, status == _GOOD)
            frames += 1
            i += length
            begin = i
        else:
            i += 1
            if i - begin == LONGEST:
                _put_run(wide, narrow, flags, runs, data, begin, i, t_rx, link, extra, table)
                runs += 1
                begin = i
        aligned = ok
    if final and begin < i:
        _put_run(wide, narrow, flags, runs, data, begin, i, t_rx, link, extra, table)
        runs += 1
        begin = i
    return frames, runs, begin, i - begin, aligned


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
def _put_garbage(wide, narrow, flags, k, i, end, t_rx, corrupt):  # type: ignore[no-untyped-def]
    """Bytes between the records of a log, data[i:end]: no frame alone, since its time would stand before it."""
    wide[4, k], wide[5, k], wide[6, k] = i, end - i, t_rx
    narrow[4, k] = 0
    flags[1, k], flags[2, k] = corrupt, False
    return k + (end > i)


@njit(cache=True, nogil=True)
def scan_tlog(data, final, aligned, last, low, extra, table, wide, narrow, flags, mark):  # type: ignore[no-untyped-def]
    """Frames and runs in a telemetry log; times in us with the link number in the bits `low`.

    `aligned`: data[0] is where a record should begin; if not, a run of discarded bytes that began in the block before
    goes on. `last`: time of the record before, us. Return the numbers of frames and runs, where the pending bytes
    begin, bytes of record headers, aligned and last.
    """
    i = 0
    n = len(data)
    frames = 0
    runs = 0
    headers = 0
    begin = 0  # of the run of no frame, where not aligned
    dated = last
    corrupt = False
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
                if start < after:
                    _put_run(wide, narrow, flags, runs, data, start, after, last, 0, extra, table)
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
            ok = ok and _is_hollow(data, i + HEADER + 1, after, extra, table)
        if ok:
            t = _record_time(data, i, after, final, last, low)
            if t < 0:
                break
            if not aligned:
                runs = _put_garbage(wide, narrow, flags, runs, begin, i, dated, corrupt)
            last = t
            _put_frame(wide, narrow, flags, frames, data, i + HEADER, length, msgid, last, 0, status == _GOOD)
            frames += 1
            headers += HEADER
            i = after
            aligned = True
            continue
        if status == _SHORT and final and aligned and length > 0:
            break  # the log was cut inside its last frame
        if aligned:
            begin, dated, corrupt = i, last, status == _CORRUPT
        aligned = False
        i += 1
    if not aligned:
        runs = _put_garbage(wide, narrow, flags, runs, begin, i, dated, corrupt)
    return frames, runs, i, headers, aligned, last
