"""What kind of log a file is: told by its first bytes, and by its name only where they cannot tell."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from telemetry import dataflash
from telemetry.sources.ulog import MAGIC

Kind = Literal["tlog", "dataflash", "ulog"]

FIRST = 1 << 16
HEADS = 0xFD, 0xFE  # of MAVLink frames, behind the eight bytes of a time
SUFFIXES: dict[str, Kind] = {".tlog": "tlog", ".bin": "dataflash", ".log": "dataflash", ".ulg": "ulog"}


def kind(path: str | Path) -> Kind:
    """Tell what kind of log a file is.

    Raises
    ------
    OSError
        If it cannot be read.
    ValueError
        If neither its content nor its name tells.
    """
    path = Path(path)
    with path.open("rb") as file:
        first = file.read(FIRST)
    if first.startswith(MAGIC):
        return "ulog"
    if len(first) > 8 and first[8] in HEADS and not first.startswith(b"\xa3\x95"):
        return "tlog"
    if first.startswith(b"\xa3\x95") or dataflash.is_text(first) or dataflash.is_binary(first):
        return "dataflash"
    if (found := SUFFIXES.get(path.suffix.lower())) is not None:
        return found
    raise ValueError(
        f"{path} is no log that Sortie knows: neither its first {len(first)} bytes nor its name say which; "
        "give a .tlog, a DataFlash .BIN or .log, or a PX4 .ulg"
    )
