"""The times that frames tell: time since boot, and UTC.

Every message of a dialect that has a field ``time_boot_ms`` or ``time_usec`` tells when it was measured. The latter is
time since boot or Unix time; its size tells which. SYSTEM_TIME tells both at once.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from telemetry.clock import NO_TIME
from telemetry.frames import LATEST, STX2, Frames
from telemetry.mavlink import Dialect
from telemetry.messages import Counts, Times

AUTOPILOT = 1
SYSTEM_TIME = 2
UNIX_US = 10**15  # a time_usec above this is Unix time, below it is time since boot
TURN = 1 << 32  # of a 32-bit counter

_OFFSET, _WIDTH, _UNIT, _PAIRED = range(4)  # columns of the table of message ids


class Told(NamedTuple):
    """What frames tell of time; columns of shape (k,).

    Parameters
    ----------
    t_boot : int64 array
        Time since boot, ns; `NO_TIME` where there is none.
    modulus : int64 array
        Range of the counter behind it, ns; 0 for one that never wraps.
    unix : int64 array
        UTC, ns of Unix time; 0 where none is told.
    """

    t_boot: Times
    modulus: Counts
    unix: Times


class BootTimes:
    """Where the messages of a dialect keep their times.

    Parameters
    ----------
    dialect : Dialect
    """

    def __init__(self, dialect: Dialect) -> None:
        self._table = np.zeros((len(dialect.crc_extra), 4), np.int64)
        for msgid, layout in dialect.layouts.items():
            fields: Any = layout.fields or {}
            if "time_boot_ms" in fields:
                kind, offset = fields["time_boot_ms"][:2]
                self._table[msgid, :_PAIRED] = offset, kind.itemsize, 1_000_000
            elif "time_usec" in fields:
                kind, offset = fields["time_usec"][:2]
                self._table[msgid, :_PAIRED] = offset, kind.itemsize, 1_000
            if msgid == SYSTEM_TIME:
                self._table[msgid, _PAIRED] = 1 + fields["time_unix_usec"][1]

    def read(self, frames: Frames) -> Told:
        """The times that frames of known ids tell."""
        told = np.empty((3, len(frames)), np.int64)
        _read(frames.data, frames.start, frames.msgid, frames.known, self._table, told)
        return Told(*told)


@njit(cache=True, nogil=True)
def _number(data, begin, end, width):  # type: ignore[no-untyped-def]
    """Little-endian number at data[begin:begin + width]; MAVLink 2 cuts trailing zero bytes, so what lies at or beyond
    `end` is zero. A number that does not fit 63 bits is no time: 0.
    """
    value = np.int64(0)
    for k in range(min(width, end - begin)):
        byte = np.int64(data[begin + k])
        if k == 7 and byte > 127:
            return np.int64(0)
        value |= byte << 8 * k
    return value


@njit(cache=True, nogil=True)
def _read(data, start, msgid, known, table, told):  # type: ignore[no-untyped-def]
    """Fill told (3, k: t_boot, modulus, unix)."""
    for i in range(len(start)):
        told[0, i] = NO_TIME
        told[1, i] = told[2, i] = 0
        if not known[i] or table[msgid[i], _WIDTH] == 0:
            continue
        offset, width, unit, paired = table[msgid[i]]
        begin = start[i] + (10 if data[start[i]] == STX2 else 6)
        end = begin + np.int64(data[start[i] + 1])
        value = _number(data, begin + offset, end, width)
        if 0 < value < UNIX_US:
            told[0, i] = value * unit
        elif UNIX_US < value < LATEST:
            told[2, i] = value * 1000
        if width == 4:
            told[1, i] = TURN * unit
        if paired > 0:
            value = _number(data, begin + paired - 1, end, 8)
            if UNIX_US < value < LATEST:  # 0 before the vehicle knows it
                told[2, i] = value * 1000


class Owner:
    """Whose clock a system's is.

    A system has one clock, its autopilot's; what other components call time since boot is their own, and is used only
    as long as no autopilot has spoken.
    """

    def __init__(self) -> None:
        self._component: int | None = None

    def strip(self, told: Told, compid: NDArray[np.uint8]) -> Told:
        """The same times, without those of components whose clock it is not."""
        if self._component == AUTOPILOT and (compid == AUTOPILOT).all():
            return told
        timed = told.t_boot != NO_TIME
        others = ~self._ours(compid, timed)
        if not others.any():
            return told
        return told._replace(
            t_boot=np.where(others, NO_TIME, told.t_boot), unix=np.where(others, np.int64(0), told.unix)
        )

    def _ours(self, compid: NDArray[np.uint8], timed: NDArray[np.bool_]) -> NDArray[np.bool_]:
        autopilot = compid == AUTOPILOT
        if self._component == AUTOPILOT:
            return np.asarray(autopilot)
        spoken = np.logical_or.accumulate(autopilot & timed)
        first = self._component
        if first is None:
            where = np.flatnonzero(timed)
            first = int(compid[where[0]]) if len(where) else AUTOPILOT
        return np.asarray(np.where(spoken, autopilot, compid == first))

    def commit(self, components: NDArray[np.uint8]) -> None:
        """Remember whose clock it is, by the components whose times have been used."""
        if self._component != AUTOPILOT and len(components):
            self._component = AUTOPILOT if (components == AUTOPILOT).any() else int(components[0])
