"""Frames heard more than once: over several links, or twice over one.

A frame that another link has brought before is *redundant*: it is used once, at its first arrival, and counted on both
links. A frame that its own link has brought before is a *duplicate*. Both are told by all bytes of the frame but its
signature, so a MAVLink 1 and a MAVLink 2 frame are never the same.

Bytes alone do not tell enough: a heartbeat is the same after 256 frames, when its number comes again. So

- over one link, only a frame that takes the same place among the sender's numbers is a duplicate;
- over another link, every frame of the last 10 s of receive time can be matched once, the oldest first.

What is remembered is bounded: 10 s, and 131072 frames of all senders.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from telemetry.frames import STX2, Frames
from telemetry.messages import Counts

FIRST, REDUNDANT, DUPLICATE = range(3)
WINDOW = 10_000_000_000  # ns of receive time
RING = 1 << 17
BUCKETS = 1 << 16
STEPS = 64  # of a search: as many frames of one bucket are looked at, the newest first

_PRINT, _TIME, _NUMBER, _BEFORE, _LINK, _COLUMNS = range(6)  # what is remembered of an arrival


class Copies:
    """Tells first arrivals from copies, for all senders on all links.

    Parameters
    ----------
    links : int
        How many links there are.
    """

    def __init__(self, links: int) -> None:
        self._ring = np.zeros((RING, _COLUMNS), np.int64)
        self._matched = np.zeros((RING, links), np.bool_)  # on which links an arrival is known to have been repeated
        self._heads = np.full(BUCKETS, -1, np.int64)
        self._highest = np.full((links, 1 << 16), -1, np.int64)  # newest number per link and sender
        self._count = np.zeros(1, np.int64)

    def tell(self, frames: Frames) -> tuple[NDArray[np.uint8], Counts]:
        """What each frame is, and a digest of its bytes.

        Parameters
        ----------
        frames : Frames
            In the order of arrival; receive times never run backwards.

        Returns
        -------
        copy : uint8 array, shape (k,)
            `FIRST`, `REDUNDANT` or `DUPLICATE`.
        digest : int64 array, shape (k,)
            Equal for equal frames; two different ones agree once in 2^64.
        """
        copy, digest = np.empty(len(frames), np.uint8), np.empty(len(frames), np.int64)
        _tell(
            frames.data,
            frames.start,
            frames.length,
            frames.link,
            frames.sysid,
            frames.compid,
            frames.seq,
            frames.t_rx,
            self._ring,
            self._matched,
            self._heads,
            self._highest,
            self._count,
            copy,
            digest,
        )
        return copy, digest


@njit(cache=True, nogil=True)
def _digest(data, start, length):  # type: ignore[no-untyped-def]
    """FNV-1a over a frame without its signature, 64 bits, eight bytes at a time as far as they go."""
    if data[start] == STX2 and data[start + 2] & 1:
        length -= 13
    value = np.uint64(0xCBF29CE484222325)
    prime = np.uint64(0x100000001B3)
    i = start
    end = start + length
    while i + 8 <= end:
        word = np.uint64(0)
        for k in range(8):
            word |= np.uint64(data[i + k]) << np.uint64(8 * k)
        value = (value ^ word) * prime
        value ^= value >> np.uint64(29)
        i += 8
    while i < end:
        value = (value ^ np.uint64(data[i])) * prime
        i += 1
    value ^= value >> np.uint64(32)
    return np.int64(value)


@njit(cache=True, nogil=True)
def _tell(data, start, length, link, sysid, compid, seq, t_rx, ring, matched, heads, highest, count, copy, digest):  # type: ignore[no-untyped-def]
    for i in range(len(start)):
        mark = _digest(data, start[i], length[i])
        digest[i] = mark
        on = np.int64(link[i])
        sender = np.int64(sysid[i]) << 8 | np.int64(compid[i])
        before = highest[on, sender]
        number = np.int64(seq[i])
        if before >= 0:
            number = before + ((number - before + 128) & 255) - 128
        else:
            number += 256
        highest[on, sender] = max(before, number)
        bucket = mark & (BUCKETS - 1)
        at = heads[bucket]
        original = np.int64(-1)
        what = FIRST
        for _ in range(STEPS):
            if at < 0 or at <= count[0] - RING:
                break
            k = at % RING
            if t_rx[i] - ring[k, _TIME] > WINDOW:
                break
            if ring[k, _PRINT] == mark:
                if ring[k, _LINK] == on:
                    if ring[k, _NUMBER] == number:
                        what = DUPLICATE
                        break
                elif not matched[k, on]:
                    original = at
            at = ring[k, _BEFORE]
        copy[i] = what
        if what == DUPLICATE:
            continue
        k = count[0] % RING
        matched[k, :] = False
        if original >= 0:
            copy[i] = REDUNDANT
            matched[original % RING, on] = True
            matched[k, :] = True  # a copy is never an original
        ring[k, _PRINT], ring[k, _TIME], ring[k, _NUMBER] = mark, t_rx[i], number
        ring[k, _BEFORE], ring[k, _LINK] = heads[bucket], on
        heads[bucket] = count[0]
        count[0] += 1
