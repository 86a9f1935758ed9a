"""ArduPilot's on-board logs (.BIN, .log): native rates, every sensor of a kind, boots, pauses and damage told.

The file is read twice in blocks, so that a log of any size passes through bounded memory: first for what stands in it
(boots, the first fix that knows the date, which sensors there are and how fast), then for the samples.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from telemetry import dataflash, text
from telemetry.dataflash import join
from telemetry.dataflash_places import Reader
from telemetry.dataflash_sensors import FEEDS, FELT, HELPERS, Rows, Sensors, gps_time, label
from telemetry.dataflash_words import declared, parameters, remarks, units, words
from telemetry.messages import Gnss, Imu, Message, Sample, Times
from telemetry.sources.logtime import LATEST, NEVER, Boot, clock_fit, gps_to_unix, place
from telemetry.sources.onboard import BLOCK, SLACK, STAGE, Account, Level, Note, Said, Teller, readable, said_of

REMARKS = 2000  # modes, events and errors told in one boot
RATE = 2000  # intervals from which a rate is told
VEHICLE_PARAMETERS = "SYSID_THISMAV", "MAV_SYSID"
EVIDENCE = (
    "AHRS_ORIENTATION", "AHRS_TRIM_X", "AHRS_TRIM_Y", "AHRS_TRIM_Z", "ARSPD_TYPE", "ARSPD_RATIO", "ARSPD_USE",
    "INS_POS1_X", "INS_POS1_Y", "INS_POS1_Z", "GPS_POS1_X", "GPS_POS1_Y", "GPS_POS1_Z", "GPS_DELAY_MS",
)  # fmt: skip
VEHICLES = {
    "copter": "copter",
    "plane": "plane",
    "rover": "rover",
    "sub": "submarine",
    "blimp": "blimp",
    "tracker": "antenna tracker",
}


class DataFlashSource:
    """The samples of a DataFlash log, binary or text.

    Parameters
    ----------
    path : str or Path
    mark : str
        Regular expression of a test-point mark in a text (`telemetry.text`).
    on_progress : callable, optional
        Called with the number of bytes read so far, while `messages` goes through the log.

    Attributes
    ----------
    path : Path
    size : int
        Bytes.
    truncated, discarded : int
        Bytes of a message cut at the end, and of no message.
    properties : dict of str to str
        What is to stand in the recording: format, digest, firmware, vehicle, parameters that matter.
    vehicle : int
        System id, 1 if the log does not tell.
    boots : list of Boot

    Raises
    ------
    OSError
        If the file cannot be read.
    ValueError
        If it is empty, no DataFlash log, or holds no sample.
    """

    def __init__(
        self, path: str | Path, *, mark: str = text.MARK, on_progress: Callable[[int], None] | None = None
    ) -> None:
        text.check_mark(mark)
        self.path = Path(path)
        self.size = self.path.stat().st_size
        self._mark, self._progress = mark, on_progress
        self.boots: list[Boot] = []
        self._parameters: dict[str, float] = {}
        self._banner: list[str] = []
        self._heard: dict[tuple[str, int], list[int]] = {}  # first times of every sensor, by message and instance
        self._refused = 0.0  # messages that the logger could not write
        self._numbered: set[str] = set()  # messages with a column for the instance
        self._units: dict[str, str] = {}
        self._declared: dict[int, str] = {}
        self._types: dict[str, int] = {}
        self._columns: dict[str, tuple[str, ...]] = {}
        self._fixes: dict[int, dict[tuple[str, int], Boot]] = {}  # dated fixes of every boot and receiver
        digest = hashlib.sha256()
        for block in Reader(self.path, digest).blocks():
            self.discarded, self.truncated = block.scanner.discarded, block.scanner.truncated
            with np.errstate(invalid="ignore", over="ignore"):  # damaged numbers
                self._survey(block.rows, block.boots)
        for number, receivers in self._fixes.items():  # the receiver that first knew the date gives it
            first = min(receivers, key=lambda receiver: (receivers[receiver].t[0], receiver))
            self.boots[number].t, self.boots[number].utc = receivers[first].t, receivers[first].utc
        place(self.boots, self.path.stat().st_mtime_ns)
        if not any(name in FEEDS for name, _ in self._heard):
            raise ValueError(
                f"{self.path} holds no sample: no dated message of {', '.join(sorted(FEEDS))} in {self.size} bytes; "
                "log the IMU, GPS and BARO (LOG_BITMASK) or use a telemetry log"
            )
        ids = [self._parameters[name] for name in VEHICLE_PARAMETERS if 0 < self._parameters.get(name, 0) < 256]
        self.vehicle = int(ids[0]) if ids else 1
        self.properties = self._describe(digest.hexdigest())

    # -- what stands in it --

    def _survey(self, rows: list[Rows], boots: list[Any]) -> None:
        for part, boot in zip(rows, boots, strict=True):
            name = part.table.layout.name
            self._types[name], self._columns[name] = part.table.layout.number, part.table.layout.columns
            if name == "PARM" and len(self._parameters) < 10_000:
                self._parameters |= parameters(part)
            elif name == "MSG" and len(self._banner) < 4:
                self._banner += [readable(word) for word in words(part, "Message")[:4]]
            elif name == "UNIT":
                self._units |= units(part)
            elif name == "DSF" and (refused := part.column("Dp")) is not None:
                self._refused = max(self._refused, float(np.nan_to_num(refused).max()))
            elif name == "FMTU":
                self._declared |= declared(part)
            for number in np.unique(boot).tolist():
                mine = part.t[boot == number]
                mine = mine[mine != NEVER]
                while len(self.boots) <= number:
                    self.boots.append(Boot(len(self.boots), LATEST, 0))
                if len(mine):
                    one = self.boots[number]
                    one.begin, one.end = min(one.begin, int(mine.min())), max(one.end, int(mine.max()))
            if name in FEEDS:
                self._count(part, boot)

    def _count(self, part: Rows, boot: Times) -> None:
        name = part.table.layout.name
        if "I" in part.table:
            self._numbered.add(name)
        numbers = part.instance()
        for instance in np.unique(numbers[(numbers >= 0) & (numbers < FELT)]).tolist():
            mine = numbers == instance
            times = self._heard.setdefault((name, instance), [])
            times += part.t[mine][: RATE - len(times)].tolist() if len(times) < RATE else []
            status = part.column("Status")
            week, ms = gps_time(part)
            if FEEDS[name].kind is Gnss and status is not None and week is not None and ms is not None:
                utc = gps_to_unix(week, ms)
                utc = np.where((status >= 3) & mine, utc, 0)
                for number in np.unique(boot[utc > 0]).tolist():
                    here = boot == number
                    fixes = self._fixes.setdefault(number, {}).setdefault((name, instance), Boot(number, 0, 0))
                    fixes.pair(part.t[here], utc[here])

    def _describe(self, digest: str) -> dict[str, str]:
        firmware = self._banner[0] if self._banner else ""
        kind = next((said for word, said in VEHICLES.items() if word in firmware.lower()), "")
        out = {
            "log": self.path.name,
            "bytes": str(self.size),
            "sha256": digest,
            "format": "ArduPilot DataFlash, " + ("binary" if self._is_binary() else "text"),
            "firmware": firmware,
            "vehicle type": kind,
            "boots": str(len(self.boots)),
        }
        out |= {name: f"{self._parameters[name]:g}" for name in EVIDENCE if name in self._parameters}
        return {name: value for name, value in out.items() if value}

    def _is_binary(self) -> bool:
        with self.path.open("rb") as file:
            return dataflash.is_binary(file.read(1 << 16))

    def _interval(self, name: str, instance: int) -> float:
        """Median time between two messages, s."""
        steps = np.diff(np.sort(np.array(self._heard[name, instance], np.int64)))
        steps = steps[steps > 0]
        return float(np.median(steps)) * 1e-9 if len(steps) else 0.0

    @property
    def _inertial(self) -> str:
        return "IMU" if any(name.startswith("IMU") for name, _ in self._heard) else "GYR"

    def _feeds(self) -> tuple[list[str], type[Sample], float]:
        """What is told at the beginning; the sensor whose silence is a hole, and its interval."""
        first: dict[str, tuple[str, float]] = {}
        others: dict[str, list[str]] = {}
        pulse: dict[type[Sample], float] = {}
        unused = "GYR" if self._inertial == "IMU" else "IMU"
        for name, instance in sorted(self._heard, key=lambda key: (list(FEEDS).index(key[0]), key[1])):
            kind, called = FEEDS[name].kind, label(name, instance, name in self._numbered)
            if name == unused:
                called += " (raw, not used)"
            if kind.stream in first or name == unused:
                others.setdefault(kind.stream, []).append(called)
            else:
                first[kind.stream] = called, self._interval(name, instance)
                pulse[kind] = first[kind.stream][1]
        if "flow_angles" in first:
            called, interval = first["flow_angles"]
            first["flow_angles"] = f"{called} (the filter's, no vane: never used)", interval
        fastest = Imu if Imu in pulse else min(pulse, key=lambda k: pulse[k] or np.inf)
        return said_of(first, others), fastest, pulse[fastest]

    def _doubts(self) -> list[str]:
        """Columns whose unit the log declares to be another than the one they are taken for."""
        said = []
        for name, expected in {**{n: f.units for n, f in FEEDS.items()}, **HELPERS}.items():
            ids = self._declared.get(self._types.get(name, -1))
            columns = self._columns.get(name, ())
            for column, letter in zip(columns, ids or "", strict=False):
                unit, wanted = self._units.get(letter, ""), expected.get(column, "")
                if unit and wanted and unit != wanted and not (unit.startswith("deg") and wanted.startswith("deg")):
                    said.append(f"{name}.{column} is declared to be in {unit} and is taken for {wanted}")
        return said

    # -- telling --

    def messages(self) -> Iterator[Message]:
        """Yield samples, texts, marks, events and the byte account, with a `Progress` after every block of time."""
        account = Account(0, 0, 0, 0, 0, 0)

        def so_far() -> Account:
            return account

        teller = Teller(self.vehicle, self._mark, so_far)
        feeds, pulse, interval = self._feeds()
        left_out: Counter[str] = Counter()
        current: _Boot | None = None
        reader = Reader(self.path)
        for rows, boots, done, scanner in reader.blocks():
            cut = scanner.pending + scanner.truncated
            account = Account(done, scanner.messages, scanner.unreadable, scanner.corrupt, scanner.discarded, cut)
            for number in sorted({number for boot in boots for number in np.unique(boot).tolist()}):
                mine = [part.select(boot == number) for part, boot in zip(rows, boots, strict=True)]
                mine = [part for part in mine if len(part)]
                if current is None or current.boot.number != number:
                    if current is not None:
                        yield from current.finish()
                    boot = self.boots[number]
                    notes = self._notes(number, feeds)
                    teller.boot(number, boot.begin + boot.offset, boot.offset, pulse, interval)
                    current = _Boot(boot, teller, Sensors(left_out, self._inertial), notes, self.vehicle)
                current.take(mine)
            if current is not None:
                yield from current.advance()
            if self._progress:
                self._progress(done)
        if current is not None:
            yield from current.finish()
        yield from teller.finish(self._sums(left_out, reader))

    def _notes(self, number: int, feeds: list[str]) -> list[tuple[Level, str]]:
        boot = self.boots[number]
        told = f"boot {number}: time is from {boot.how}"
        if boot.t:
            told += " (GPS time less 18 s, which is UTC since 2017)"
        notes: list[tuple[Level, str]] = [("info" if boot.t else "warning", told)]
        if number == 0:
            notes = [("info", line) for line in feeds] + [("warning", line) for line in self._doubts()] + notes
            notes = [
                ("info", f"{self.properties['format']}: {self.properties.get('firmware', 'firmware unknown')}"),
                *notes,
            ]
        elif number:
            notes.insert(0, ("warning", f"the boot clock stepped back: boot {number} begins"))
        return notes

    def _sums(self, left_out: Counter[str], reader: Reader) -> list[Note]:
        said = [f"{why}: {count} messages left out" for why, count in sorted(left_out.items())]
        said += [f"{name}: does not say when: {count} messages left out" for name, count in reader.untimed.items()]
        if self._refused:
            said.append(f"the logger dropped {self._refused:g} messages: they could not be written (DSF.Dp)")
        if reader.misdated:
            said.append(f"{reader.misdated} messages left out: their time is damaged")
        if self.discarded:
            said.append(f"{self.discarded} bytes of the log were no message")
        if self.truncated:
            said.append(f"the log ends inside a message: its last {self.truncated} bytes are left out")
        return [Note(0, 0, "warning", line) for line in said]


class _Boot:
    """What waits of one boot until its time is complete."""

    def __init__(
        self, boot: Boot, teller: Teller, sensors: Sensors, notes: list[tuple[Level, str]], vehicle: int
    ) -> None:
        self.boot = boot
        self._teller, self._sensors, self._vehicle = teller, sensors, vehicle
        self._notes = notes
        self._rows: list[Rows] = []
        self._remarks = 0
        self._newest = boot.begin
        self._told = boot.begin

    def take(self, rows: list[Rows]) -> None:
        for part in rows:
            unknown = part.t == NEVER
            if unknown.any():  # nothing before it told a time
                part.t[unknown], part.t_rx[unknown] = self.boot.begin, self.boot.begin
            self._newest = max(self._newest, int(part.t.max()))
        self._rows += rows

    def advance(self) -> Iterator[Message]:
        complete = (self._newest - SLACK - self.boot.begin) // BLOCK * BLOCK + self.boot.begin
        if complete > self._told:
            self._told = complete
            ready: list[Rows] = []
            rest: list[Rows] = []
            for part in self._rows:
                now = part.t_rx < complete
                ready += [part.select(now)] if now.any() else []
                rest += [part.select(~now)] if not now.all() else []
            self._rows = rest
            yield from self._tell(ready)

    def finish(self) -> Iterator[Message]:
        rows, self._rows = self._rows, []
        yield from self._tell(rows)
        yield from self._teller.end(clock_fit(self.boot, self._vehicle, STAGE))

    def _tell(self, rows: list[Rows]) -> Iterator[Message]:
        by_name: dict[str, list[Rows]] = {}
        layouts: dict[int, list[Rows]] = {}
        for part in rows:
            layouts.setdefault(id(part.table.layout), []).append(part)
        for parts in layouts.values():
            t, t_rx = (np.concatenate([getattr(p, name) for p in parts]) for name in ("t", "t_rx"))
            whole = Rows(join([p.table for p in parts]), t + self.boot.offset, t_rx + self.boot.offset)
            by_name.setdefault(whole.table.layout.name, []).append(whole)
        begin = self.boot.begin + self.boot.offset
        notes = [Note(begin, begin, level, line) for level, line in self._notes]
        self._notes = []
        said = []
        for part in by_name.get("MSG", []):
            times = zip(part.t.tolist(), part.t_rx.tolist(), words(part, "Message"), strict=False)  # or no texts
            said += [Said(t, t_rx, 6, readable(word)) for t, t_rx, word in times]
        for name in ("MODE", "EV", "ERR"):
            for part in by_name.get(name, []):
                notes += remarks(name, part)[: max(REMARKS - self._remarks, 0)]
                self._remarks += len(part)
        with np.errstate(invalid="ignore", over="ignore"):  # damaged numbers
            streams = self._sensors.streams(by_name)
        yield from self._teller.tell(streams, said, notes)
