"""Our decoders beside those of other libraries: messages per second of whole logs, microseconds per live message.

Logs are read from their files to the values of every message: by us to columns, by the others to their objects. Live
frames come a few at a time, as the receiving thread hands them on. All is done in one process, one after the other and
round after round, so that a busy moment of the machine meets all alike; the least CPU time counts. What the first calls
compile is not timed.
"""

from __future__ import annotations

import contextlib
import importlib
import importlib.util
import io
import os
import platform
import tempfile
import time
from collections.abc import Callable, Sequence
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

import sims
from telemetry import dataflash
from telemetry.frames import scan_datagrams
from telemetry.ingest import ingest
from telemetry.mavlink import Dialect
from telemetry.sources.tlog import TlogSource

if TYPE_CHECKING:
    from rich.table import Table

RATE = 500_000.0
"""Messages per second that the columns of a .tlog are to reach,"""
TIMES = 10.0
"""how many times the rate of `recv_match` that is to be,"""
SHARE = 1.0 / 3.0
"""and the share of the CPU time of `parse_buffer` that a live message is to cost at most."""
COLUMNS, RECV_MATCH = "ours, columns of every message", "pymavlink recv_match"
BATCHES = (1, 2, 5, 10, 30, 100)
LIVE = 3000
"""Live frames in a round, at most."""


class Row(msgspec.Struct, frozen=True, kw_only=True):
    """One reader on one log.

    Parameters
    ----------
    log, reader : str
    messages : int
        Of which it found the values.
    seconds : float or None
        CPU time; None if it could not be run.
    times : float or None
        How many times as long as our columns it took for the log.
    note : str
        Why it could not.
    """

    log: str
    reader: str
    messages: int = 0
    seconds: float | None = None
    times: float | None = None
    note: str = ""


class Live(msgspec.Struct, frozen=True, kw_only=True):
    """Live frames, CPU microseconds per message.

    Parameters
    ----------
    batch : int
        Frames in a call, each in a datagram of its own.
    ours, theirs : float
        Scanned and decoded to columns; pymavlink's `parse_buffer` to its objects.
    share : float
        Ours of theirs.
    """

    batch: int
    ours: float
    theirs: float
    share: float


class Verdict(msgspec.Struct, frozen=True, kw_only=True):
    """A target, what was found, and whether that reaches it."""

    target: str
    found: str
    met: bool


class Comparison(msgspec.Struct, frozen=True, kw_only=True):
    """What was measured."""

    machine: dict[str, str]
    rounds: int
    rows: list[Row]
    live: list[Live]
    verdicts: list[Verdict]

    def tables(self) -> list[Table]:
        """Logs, live frames, and the verdicts."""
        from rich.table import Table

        logs = Table(
            "log", "reader", title="whole logs: messages per second", title_justify="left",
            caption=f"least CPU time of {self.rounds} rounds", caption_justify="left",
        )  # fmt: skip
        for name in ("messages", "CPU s", "messages/s", "time beside ours"):
            logs.add_column(name, justify="right")
        for row in self.rows:
            if row.seconds is None:
                logs.add_row(row.log, row.reader, row.note)
            else:
                rate = f"{row.messages / row.seconds:,.0f}".replace(",", " ")
                times = f"{row.times:.1f}x" if row.times else ""
                logs.add_row(row.log, row.reader, f"{row.messages}", f"{row.seconds:.3f}", rate, times)
        live = Table(title="live: CPU microseconds per message", title_justify="left")
        for name in ("messages in a call", "ours", "pymavlink parse_buffer", "share"):
            live.add_column(name, justify="right")
        for one in self.live:
            live.add_row(f"{one.batch}", f"{one.ours:.2f}", f"{one.theirs:.2f}", f"{one.share:.2f}")
        verdicts = Table("target", "found", "", title="verdicts", title_justify="left")
        for verdict in self.verdicts:
            verdicts.add_row(verdict.target, verdict.found, "met" if verdict.met else "missed")
        return [logs, live, verdicts]


class _Reader(NamedTuple):
    """A name, and what reads the log and says how many messages it found; or why there is none."""

    name: str
    read: Callable[[], int] | None
    note: str = ""


def _tlog(path: Path, dialect: Dialect) -> list[_Reader]:
    from pymavlink import mavutil

    mavlink = importlib.import_module(f"pymavlink.dialects.v20.{dialect.name}")
    frames = [batch.frame(i) for batch in TlogSource(path, dialect).batches() for i in range(len(batch))]
    blocks = [b"".join(frames[i : i + 1000]) for i in range(0, len(frames), 1000)]

    def columns() -> int:
        batches = TlogSource(path, dialect).batches()
        return sum(len(rows) for batch in batches for rows, _ in dialect.columns(batch).values())

    def stage() -> int:
        source, found = TlogSource(path, dialect), 0

        def counted(batches: Any) -> Any:
            nonlocal found
            for batch in batches:
                found += int(batch.known.sum())
                yield batch

        for _ in ingest(counted(source.batches()), source.links, dialect):
            pass
        return found

    def recv_match() -> int:
        log = mavutil.mavlink_connection(str(path), dialect=dialect.name)
        found = 0
        try:
            while message := log.recv_match():
                found += message.get_type() != "BAD_DATA"
        finally:
            log.close()
        return found

    def parse_buffer() -> int:
        mav = mavlink.MAVLink(None)
        mav.robust_parsing = True
        return sum(m.get_type() != "BAD_DATA" for block in blocks for m in mav.parse_buffer(block) or ())

    def fast() -> int:
        with contextlib.redirect_stdout(io.StringIO()):
            messages, _ = importlib.import_module("fasttlogparser").parseTLog(str(path))
        return sum(max(map(len, fields.values()), default=0) for fields in messages.values())

    return [
        _Reader(COLUMNS, columns),
        _Reader("ours, the whole ingest stage", stage),
        _Reader(RECV_MATCH, recv_match),
        _Reader("pymavlink parse_buffer, frames in memory", parse_buffer),
        _Reader("fasttlogparser", *_if_installed("fasttlogparser", fast)),
    ]


def _dataflash(path: Path) -> list[_Reader]:
    def columns() -> int:
        return sum(len(table) for table in dataflash.read(path).values())

    def reader() -> int:
        from pymavlink import DFReader

        with contextlib.redirect_stdout(io.StringIO()):
            kind = DFReader.DFReader_binary if dataflash.is_binary(_head(path)) else DFReader.DFReader_text
            log = kind(str(path))
        found = 0
        try:
            while log.recv_msg():
                found += 1
        finally:
            log.close()
        return found

    return [_Reader("ours, columns of DataFlash", columns), _Reader("pymavlink DFReader", reader)]


def _ulog(path: Path) -> list[_Reader]:
    def samples() -> int:
        source = importlib.import_module("telemetry.sources.ulog").UlogSource(path)
        return sum(len(message.t) for message in source.messages())

    def ulog() -> int:
        log = importlib.import_module("pyulog").ULog(str(path))
        return sum(len(data.data["timestamp"]) for data in log.data_list)

    return [
        _Reader("ours, samples", *_if_installed("telemetry.sources.ulog", samples)),
        _Reader("pyulog ULog, every topic", *_if_installed("pyulog", ulog)),
    ]


def _if_installed(module: str, read: Callable[[], int]) -> tuple[Callable[[], int] | None, str]:
    return (read, "") if importlib.util.find_spec(module) else (None, "not installed")


def _head(path: Path) -> bytes:
    with path.open("rb") as file:
        return file.read(1 << 16)


def _readers(path: Path, dialect: Dialect) -> list[_Reader]:
    first = _head(path)
    if first.startswith(b"ULog"):
        return _ulog(path)
    if dataflash.is_binary(first) or dataflash.is_text(first):
        return _dataflash(path)
    return _tlog(path, dialect)


def _read(path: Path, dialect: Dialect, rounds: int, tell: Callable[[str], None]) -> list[Row]:
    readers = _readers(path, dialect)
    best: dict[str, float] = {}
    found: dict[str, int] = {}
    for turn in range(rounds + 1):
        for reader in readers:
            if reader.read is None or (not turn and not reader.name.startswith("ours")):
                continue
            tell(f"{path.name}: {reader.name}, {f'round {turn} of {rounds}' if turn else 'compiling'}")
            begin = time.process_time()
            found[reader.name] = reader.read()
            spent = time.process_time() - begin
            if turn:
                best[reader.name] = min(best.get(reader.name, spent), spent)
    rows = []
    for reader in readers:
        seconds = best.get(reader.name)
        ours = best.get(readers[0].name)
        times = None if seconds is None or ours is None else seconds / ours
        rows.append(
            Row(
                log=path.name,
                reader=reader.name,
                messages=found.get(reader.name, 0),
                seconds=seconds,
                times=times,
                note=reader.note,
            )
        )
    return rows


class _Call(NamedTuple):
    """Datagrams that arrived together, end to end, and what else their receiver knows of them."""

    wire: bytes
    bounds: NDArray[np.int64]
    t_rx: NDArray[np.int64]
    link: NDArray[np.uint8]


def _call(frames: list[bytes], first: int) -> _Call:
    bounds = np.cumsum([0, *map(len, frames)])
    return _Call(
        b"".join(frames), bounds, 4000 * np.arange(first, first + len(frames)), np.zeros(len(frames), np.uint8)
    )


def _live(path: Path, dialect: Dialect, rounds: int, tell: Callable[[str], None]) -> list[Live]:
    mavlink = importlib.import_module(f"pymavlink.dialects.v20.{dialect.name}")
    frames: list[bytes] = []
    for batch in TlogSource(path, dialect).batches():
        frames += [batch.frame(i) for i in np.flatnonzero(batch.known)[: LIVE - len(frames)].tolist()]
    found = []
    for size in BATCHES:
        calls = [_call(frames[i : i + size], i + 1) for i in range(0, len(frames) - size + 1, size)]
        if not calls:
            break
        tell(f"{path.name}: live, {size} in a call")
        best = [np.inf, np.inf]
        for turn in range(rounds + 1):
            begin = time.process_time()
            for wire, bounds, t_rx, link in calls:
                data = np.frombuffer(wire, np.uint8)
                dialect.columns(scan_datagrams(data, bounds, t_rx, link, dialect.crc_extra))
            middle = time.process_time()
            mav = mavlink.MAVLink(None)
            mav.robust_parsing = True
            for call in calls:
                mav.parse_buffer(call.wire)
            end = time.process_time()
            if turn:
                best = [min(best[0], middle - begin), min(best[1], end - middle)]
        ours, theirs = (spent * 1e6 / (len(calls) * size) for spent in best)
        found.append(Live(batch=size, ours=ours, theirs=theirs, share=ours / theirs))
    return found


def _verdicts(rows: list[Row], live: list[Live]) -> list[Verdict]:
    found = []
    ours = {row.log: row for row in rows if row.reader == COLUMNS}
    for row in rows:
        if row.reader != RECV_MATCH or row.seconds is None or row.times is None:
            continue
        mine = ours[row.log]
        rate = mine.messages / (mine.seconds or np.inf)
        found += [
            Verdict(target=f"{row.log}: {RATE:.0f} messages/s", found=f"{rate:.0f}", met=rate >= RATE),
            Verdict(target=f"{row.log}: {TIMES:.0f}x recv_match", found=f"{row.times:.1f}x", met=row.times >= TIMES),
        ]
    return found + [
        Verdict(
            target=f"live, {one.batch} in a call: {SHARE:.2f} of parse_buffer",
            found=f"{one.share:.2f}",
            met=one.share <= SHARE,
        )
        for one in live
    ]


def _sample(folder: Path) -> Path:
    """A simulated flight of three minutes."""
    flight = sims.fly("c172x", "demo", start_utc=1_700_000_000_000_000_000)
    path = folder / "c172x.tlog"
    sims.write_tlog(sims.frames(flight), path, flight.start_utc)
    return path


def compare(
    logs: Sequence[str | Path] = (),
    *,
    dialect: str = "ardupilotmega",
    rounds: int = 3,
    tell: Callable[[str], None] | None = None,
) -> Comparison:
    """Read logs with all readers that are here, and frames of the first .tlog as they would come live.

    Parameters
    ----------
    logs : sequence of str or Path
        .tlog, DataFlash or ULog; a simulated flight if none is given.
    dialect : str
        Of the .tlog files.
    rounds : int
        Beside the one that compiles; the least time counts.
    tell : callable, optional
        Called with a line about what is being done.

    Raises
    ------
    OSError
        If a log cannot be read.
    ValueError
        If one is none, the dialect is not known, or `rounds` is below 1.
    """
    if rounds < 1:
        raise ValueError(f"{rounds} rounds: at least one is needed")
    say = tell or (lambda said: None)
    table = Dialect(dialect)
    with tempfile.TemporaryDirectory() as folder:
        if not logs:
            say("flying a simulated flight")
        paths = [Path(log) for log in logs] or [_sample(Path(folder))]
        rows = [row for path in paths for row in _read(path, table, rounds, say)]
        tlogs = [path for path in paths if any(row.log == path.name and row.reader == COLUMNS for row in rows)]
        live = _live(tlogs[0], table, rounds, say) if tlogs else []
    return Comparison(machine=_machine(), rounds=rounds, rows=rows, live=live, verdicts=_verdicts(rows, live))


def _machine() -> dict[str, str]:
    versions = {name: metadata.version(name) for name in ("numpy", "numba", "pymavlink")}
    load = f"{os.getloadavg()[0]:.1f}" if hasattr(os, "getloadavg") else "unknown"
    return {"python": platform.python_version(), **versions, "cores": f"{os.cpu_count() or 1}", "load": load}
