"""The end of a raw log whose writer was killed: found by the reader's own rule, repaired so that nothing is removed.

What follows the last whole record (a record cut short, or bytes that are none) becomes junk records, as
`telemetry.frames` draws them, dated by the last whole record, so that every reader finds the record written next::

    record record record reco            before
    record record record (junk: reco)    after

A kill at any moment of the repair leaves a log that can be read and repaired. What will stand at the end is first kept
on disk beside the log, in ``raw.tlog.tail`` (8 bytes of big-endian offset, then the records); only then is it
written over the damaged end, which it is longer than, and at last the file beside it is removed. A repair that finds
such a file completes the one before.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from telemetry.frames import HEADER, JUNK, JUNK_HEADER, LONGEST_JUNK, TlogScanner, write_junk

BLOCK = 1 << 20


class Whole(NamedTuple):
    """The whole records of a log: where they `end`, bytes, and time and link of the last one, us (0: there is none)."""

    end: int
    us: int


def find_whole(path: Path, crc_extra: NDArray[np.int16], links: int = 1) -> Whole:
    """Read a log, block by block, to the end of its last whole record.

    Parameters
    ----------
    path : Path
    crc_extra : int16 array
        The dialect's checksum byte per message id, as in `telemetry.frames.scan_datagrams`.
    links : int
        Links of the log.

    Raises
    ------
    OSError
        If it cannot be read.
    """
    scanner = TlogScanner(crc_extra, links)
    end = base = newest = us = 0
    with path.open("rb") as file:
        final = False
        while not final:
            block = file.read(BLOCK)
            final = len(block) < BLOCK
            found = scanner.scan(block, final)
            for start, t_rx, link in (
                (found.start, found.t_rx, found.link),
                (found.junk_start, found.junk_t_rx, found.junk_link),
            ):
                if len(start) and base + int(start[-1]) >= newest:
                    newest = base + int(start[-1])
                    us = int(t_rx[-1]) // 1000 | (int(link[-1]) if links > 1 else 0)
            if len(found):
                end = base + int(found.start[-1] + found.length[-1])
            base += len(found.data) - found.pending
        return Whole(_past_junk(file, end), us)


def _past_junk(file: BinaryIO, end: int) -> int:
    """The end of the junk records that follow the last frame: a reader takes them for records up to the first that
    is none.
    """
    size = os.fstat(file.fileno()).st_size
    file.seek(end)
    while len(header := file.read(JUNK_HEADER)) == JUNK_HEADER and header.startswith(JUNK, HEADER):
        after = end + JUNK_HEADER + int.from_bytes(header[-2:], "little")
        if after > size:
            break
        end = file.seek(after)
    return end


def repair(path: Path, crc_extra: NDArray[np.int16], links: int = 1, *, before: Path | None = None) -> tuple[int, int]:
    """Make what follows the last whole record of a log junk records; nobody else may be writing to it.

    Parameters
    ----------
    path, crc_extra, links
        As in `find_whole`.
    before : Path, optional
        The segment before, whose last record dates the end if this one has not one whole record.

    Returns
    -------
    repaired : int
        Bytes that followed the last whole record; 0 if nothing had to be done.
    us : int
        Time and link of the last record now, us; 0 if there is none.

    Raises
    ------
    OSError
        If it cannot be read or written.
    """
    beside = path.with_name(path.name + ".tail")
    repaired = _finish(path, beside) if beside.is_file() else 0
    end, us = find_whole(path, crc_extra, links)
    if not us and before:
        us = find_whole(before, crc_extra, links).us
    if end < path.stat().st_size:
        _keep(path, end, us, beside)
        repaired += _finish(path, beside)
    return repaired, us


def _finish(path: Path, beside: Path) -> int:
    """Write over the end what is kept beside the log, any number of times."""
    repaired = 0
    with beside.open("rb") as file, path.open("r+b", buffering=0) as log:
        end = int.from_bytes(file.read(8), "big")
        log.seek(end)
        while piece := file.read(JUNK_HEADER + LONGEST_JUNK):
            write_whole(log, piece)
            repaired += len(piece) - JUNK_HEADER
        os.fsync(log.fileno())
    beside.unlink()
    sync_folder(path.parent)
    return repaired


def _keep(path: Path, end: int, us: int, beside: Path) -> None:
    """Put on disk what will stand at the end, under its name only when all of it is there."""
    part = beside.with_name(beside.name + ".part")
    with path.open("rb") as log, part.open("wb", buffering=0) as file:
        write_whole(file, end.to_bytes(8, "big"))
        log.seek(end)
        while piece := log.read(LONGEST_JUNK):
            write_whole(file, write_junk(us, piece))
        os.fsync(file.fileno())
    part.rename(beside)
    sync_folder(path.parent)


def write_whole(file: BinaryIO, data: bytes | memoryview) -> None:
    """Write all of it to an unbuffered file, which may take it in parts.

    Raises
    ------
    OSError
        If some of it could not be written.
    """
    view = memoryview(data)
    while view:
        view = view[file.write(view) :]


def sync_folder(folder: Path) -> None:
    """Write a folder's list of files through to the disk.

    Raises
    ------
    OSError
        If that failed.
    """
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
