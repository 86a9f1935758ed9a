"""Frames to columns of any message type, from pymavlink's own tables.

pymavlink supplies what a dialect *is* (ids, wire layouts, checksum bytes); a frame's payload is that layout in
memory, so a batch of payloads viewed with a numpy dtype is already decoded. Two conventions of the wire are undone on
the way: MAVLink 2 cuts trailing zero bytes of a payload (they are put back), and newer extensions may make it longer
than known (cut).
"""

from __future__ import annotations

import hashlib
import importlib
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from telemetry.frames import STX2, Frames

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
        try:
            table = importlib.import_module(f"pymavlink.dialects.v20.{name}").mavlink_map
        except (ImportError, AttributeError):
            raise ValueError(f"no MAVLink dialect {name!r}: pymavlink ships e.g. ardupilotmega, common") from None
        self.name = name
        self.crc_extra = np.full(max(table) + 1, -1, np.int16)
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
        start = frames.start[rows]
        out = np.zeros((len(rows), layout.itemsize), np.uint8)
        _gather(frames.data, start, out)
        return out.view(layout)[:, 0]


@njit(cache=True, nogil=True)
def _gather(data, start, out):  # type: ignore[no-untyped-def]
    """Copy the payloads of frames at `start` into the zeroed rows of `out`."""
    for k in range(len(start)):
        size = min(np.int64(data[start[k] + 1]), out.shape[1])
        head = start[k] + (10 if data[start[k]] == STX2 else 6)
        for i in range(size):
            out[k, i] = data[head + i]
