"""Frames to columns of any message type and back, from pymavlink's own tables.

pymavlink supplies what a dialect *is* (ids, wire layouts, checksum bytes); a frame's payload is that layout in
memory, so a batch of payloads viewed with a numpy dtype is already decoded. Two conventions of the wire are undone on
the way: MAVLink 2 cuts trailing zero bytes of a payload (they are put back), and newer extensions may make it longer
than known (cut).
"""

from __future__ import annotations

import hashlib
import importlib
import pkgutil
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from telemetry.frames import STX1, STX2, Frames
from telemetry.framing import CRC, checksum

LONGEST_PAYLOAD = 255
_FEW = 128  # frames
_CODES = {
    "Q": "<u8",
    "q": "<i8",
    "I": "<u4",
    "i": "<i4",
    "H": "<u2",
    "h": "<i2",
    "B": "u1",
    "b": "i1",
    "c": "S1",
    "f": "<f4",
    "d": "<f8",
}


def dialects() -> list[str]:
    """Names of the dialects that pymavlink ships."""
    from pymavlink.dialects import v20

    return sorted((module.name for module in pkgutil.iter_modules(v20.__path__)), key=str.lower)


class Dialect:
    """What the ids of a MAVLink dialect mean.

    Parameters
    ----------
    name : str
        A dialect that pymavlink ships. ``ardupilotmega`` contains ``common`` and clashes with no id of it.

    Attributes
    ----------
    crc_extra : int16 array
        Checksum byte per message id, -1 where the id is unknown.
    names : dict of int to str
        Message names.
    layouts : dict of int to numpy.dtype
        Wire layout of the payload, extensions included.
    digest : str
        SHA-256 over ids and checksum bytes: a recording made with another dialect shows it.

    Raises
    ------
    ValueError
        If pymavlink has no such dialect.
    """

    def __init__(self, name: str = "ardupilotmega") -> None:
        if name not in dialects():
            raise ValueError(f"no MAVLink dialect {name!r}: pymavlink ships {', '.join(dialects())}")
        table = importlib.import_module(f"pymavlink.dialects.v20.{name}").mavlink_map
        self.name = name
        self.crc_extra = np.full(max(table) + 1, -1, np.int16)
        self._sizes = np.full(max(table) + 1, -1, np.int16)  # of payloads, -1 where the id is unknown
        self.names: dict[int, str] = {}
        self.layouts: dict[int, np.dtype[Any]] = {}
        for msgid, kind in sorted(table.items()):
            self.crc_extra[msgid] = kind.crc_extra
            self.names[msgid] = kind.msgname
            codes = kind.native_format.decode().lstrip("<>=")
            self.layouts[msgid] = np.dtype(
                [
                    (field, _CODES[code], (size,)) if size > 1 else (field, _CODES[code])
                    for field, code, size in zip(kind.ordered_fieldnames, codes, kind.array_lengths, strict=True)
                ]
            )
            self._sizes[msgid] = self.layouts[msgid].itemsize
        self.digest = hashlib.sha256(repr([(i, int(self.crc_extra[i])) for i in sorted(table)]).encode()).hexdigest()

    def decode(self, frames: Frames, msgid: int, rows: NDArray[np.int64]) -> NDArray[Any]:
        """Payloads of frames of one message id.

        Parameters
        ----------
        frames : Frames
        msgid : int
            The id that all of `rows` have.
        rows : int64 array, shape (k,)
            Which frames.

        Returns
        -------
        structured array, shape (k,)
            Fields by their MAVLink names, in MAVLink units.
        """
        layout = self.layouts[msgid]
        out = np.zeros((len(rows), layout.itemsize), np.uint8)
        _gather(frames.data, frames.start[rows], out)
        return np.ndarray(len(rows), layout, out)

    def columns(self, frames: Frames) -> dict[int, tuple[NDArray[np.int64], NDArray[Any]]]:
        """Every message of a known id.

        Returns
        -------
        dict of int to (int64 array, structured array)
            By message id, ascending: the rows of its frames, ascending, and their payloads as `decode` gives them.
        """
        if len(frames) <= _FEW:
            return self._few(frames)
        order = np.argsort(frames.msgid, kind="stable")
        ids = frames.msgid[order]
        cuts = [0, *(np.flatnonzero(np.diff(ids)) + 1).tolist(), len(ids)]
        groups = [(msgid, order[a:b]) for a, b in pairwise(cuts) if (msgid := ids.item(a)) in self.layouts]
        return {msgid: (rows, self.decode(frames, msgid, rows)) for msgid, rows in groups}

    def _few(self, frames: Frames) -> dict[int, tuple[NDArray[np.int64], NDArray[Any]]]:
        """Live batches hold few frames of many ids: one call of compiled code for all of them, into one room."""
        count = len(frames)
        order, groups = np.empty(count, np.int64), np.empty((count + 1, 3), np.int64)
        out = np.zeros(count * LONGEST_PAYLOAD, np.uint8)
        found = _gather_few(frames.data, frames.start, frames.msgid, self._sizes, order, groups, out)
        layouts = self.layouts
        return {
            msgid: (order[begin:end], np.ndarray(end - begin, layouts[msgid], out, at))
            for (msgid, begin, at), (_, end, _) in pairwise(groups[: found + 1].tolist())
        }

    def encode(
        self,
        msgid: int,
        values: NDArray[Any],
        *,
        sysid: int | NDArray[Any],
        compid: int | NDArray[Any],
        seq: int | NDArray[Any],
        version: int = 2,
    ) -> tuple[NDArray[np.uint8], NDArray[np.int64]]:
        """Frames of one message id, unsigned: what `decode` is undone by.

        Parameters
        ----------
        msgid : int
        values : structured array, shape (k,)
            Payloads in the id's layout.
        sysid, compid, seq : int or array, shape (k,)
            What the headers say.
        version : int
            2: trailing zero bytes of a payload are cut. 1: extensions are left out.

        Returns
        -------
        data : uint8 array
            The frames, end to end.
        bounds : int64 array, shape (k + 1,)
            Frame i is ``data[bounds[i]:bounds[i + 1]]``.

        Raises
        ------
        ValueError
            If the dialect has no such id, MAVLink 1 cannot carry it, or `values` have another layout.
        """
        if msgid not in self.layouts:
            raise ValueError(f"dialect {self.name} has no message id {msgid}")
        layout = self.layouts[msgid]
        if values.dtype != layout:
            raise ValueError(f"{self.names[msgid]}: values of dtype {values.dtype} where {layout} belongs")
        size = layout.itemsize
        if version == 1:
            if msgid not in self._sizes1:
                raise ValueError(f"{self.names[msgid]}: MAVLink 1 has no message id {msgid}")
            size = self._sizes1[msgid]
        payload = np.ascontiguousarray(values).view(np.uint8).reshape(len(values), layout.itemsize)[:, :size].copy()
        header = np.empty((len(values), 3), np.uint8)
        header[:, 0], header[:, 1], header[:, 2] = seq, sysid, compid
        out = np.empty(len(values) * (size + 12), np.uint8)
        bounds = np.zeros(len(values) + 1, np.int64)
        _encode(payload, header, msgid, version == 1, int(self.crc_extra[msgid]), CRC, out, bounds)
        return out[: bounds[-1]], bounds

    @cached_property
    def _sizes1(self) -> dict[int, int]:
        """Payload sizes in MAVLink 1, which knows no extensions."""
        table = importlib.import_module(f"pymavlink.dialects.v10.{self.name}").mavlink_map
        return {msgid: kind.unpacker.size for msgid, kind in table.items()}


@njit(cache=True, nogil=True)
def _copy(data, start, out):  # type: ignore[no-untyped-def]
    """Copy the payload of the frame at `start`, as far as it goes, into the zeroed `out`."""
    size = min(np.int64(data[start + 1]), out.shape[0])
    head = start + (10 if data[start] == STX2 else 6)
    for i in range(size):
        out[i] = data[head + i]


@njit(cache=True, nogil=True)
def _gather(data, start, out):  # type: ignore[no-untyped-def]
    """Copy the payloads of frames at `start` into the zeroed rows of `out`."""
    for k in range(len(start)):
        _copy(data, start[k], out[k])


@njit(cache=True, nogil=True)
def _gather_few(data, start, msgid, sizes, order, groups, out):  # type: ignore[no-untyped-def]
    """Copy the payloads of a few frames into the zeroed `out`, one message id after the other.

    Fill `order`, the frames of known ids sorted by id, and a row of `groups` for each id and one behind: id, first
    place in `order`, first byte in `out`. Return the number of ids.
    """
    known = 0
    for k in range(len(start)):
        if msgid[k] < len(sizes) and sizes[msgid[k]] >= 0:
            at = known
            while at > 0 and msgid[order[at - 1]] > msgid[k]:
                order[at] = order[at - 1]
                at -= 1
            order[at] = k
            known += 1
    found = 0
    byte = 0
    for place in range(known):
        k = order[place]
        if place == 0 or msgid[k] != msgid[order[place - 1]]:
            groups[found, 0], groups[found, 1], groups[found, 2] = msgid[k], place, byte
            found += 1
        size = sizes[msgid[k]]
        _copy(data, start[k], out[byte : byte + size])
        byte += size
    groups[found, 0], groups[found, 1], groups[found, 2] = -1, known, byte
    return found


@njit(cache=True, nogil=True)
def _encode(payload, header, msgid, first, extra, table, out, bounds):  # type: ignore[no-untyped-def]
    """Frames around the rows of `payload` into `out`; header rows are sequence number, system, component."""
    i = 0
    for k in range(len(payload)):
        size = payload.shape[1]
        if first:
            head = 6
            out[i], out[i + 5] = STX1, msgid
        else:
            head = 10
            while size > 1 and payload[k, size - 1] == 0:
                size -= 1
            out[i], out[i + 2], out[i + 3] = STX2, 0, 0
            out[i + 7], out[i + 8], out[i + 9] = msgid & 0xFF, msgid >> 8 & 0xFF, msgid >> 16
        out[i + 1] = size
        at = i + (2 if first else 4)
        out[at : at + 3] = header[k]
        body = i + head + size
        out[i + head : body] = payload[k, :size]
        crc = checksum(out, i + 1, body, extra, table)
        out[body], out[body + 1] = crc & 0xFF, crc >> 8
        i = body + 2
        bounds[k + 1] = i
