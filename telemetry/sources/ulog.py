"""PX4's on-board logs (.ulg): native rates, every sensor of a kind, dropouts and damage told.

pyulog reads the columns, and it reads whole files: memory grows with the log. What of the file it could not use is
counted by a walk of our own over the messages, each of which is ``size[2] type[1] body[size]`` behind a head of 16
bytes; a place where the types make no sense is gone through byte by byte.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from telemetry import text
from telemetry.messages import Gnss, Imu, Message
from telemetry.sources.logtime import Boot, clock_fit, place
from telemetry.sources.onboard import STAGE, Account, Level, Note, Said, Stream, Teller, readable, said_of
from telemetry.ulog_sensors import TOPICS, Topic, streams, utc

MAGIC = bytes.fromhex("554c6f67011235")
HEAD = 16
MOST_FIELDS = 1 << 14  # of a topic: a damaged definition can claim billions
STATUS = "vehicle_status"
RATE = 50  # data messages from whose times the place of a dropout is told
EVIDENCE = (
    "SENS_BOARD_ROT", "SENS_BOARD_X_OFF", "SENS_BOARD_Y_OFF", "SENS_BOARD_Z_OFF", "EKF2_GPS_DELAY", "EKF2_IMU_POS_X",
    "EKF2_IMU_POS_Y", "EKF2_IMU_POS_Z", "EKF2_GPS_POS_X", "EKF2_GPS_POS_Y", "EKF2_GPS_POS_Z", "CAL_AIR_CMODEL",
    "SENS_BARO_QNH",
)  # fmt: skip
VEHICLES = {
    1: "fixed wing",
    2: "quadrotor",
    4: "helicopter",
    10: "rover",
    12: "submarine",
    13: "hexarotor",
    14: "octorotor",
    **dict.fromkeys(range(19, 26), "VTOL"),
}
_TYPES = np.zeros(256, np.bool_)
_TYPES[list(b"BFIMPQARSOLCD")] = True


@njit(cache=True, nogil=True)
def _walk(data, types, dropouts):  # type: ignore[no-untyped-def]
    """Messages, bytes of none, bytes of the one that the end cuts; dropouts: where, ms, time before (us)."""
    n = len(data)
    i, messages, lost, cut, k = 16, 0, 0, -1, 0
    stamps = np.zeros(RATE, np.int64)
    told = 0
    while i < n:
        good = False
        end = n + 1
        if i + 3 <= n and types[data[i + 2]]:
            size = data[i] | np.int64(data[i + 1]) << 8
            end = i + 3 + size
            good = size > 0 and (end == n or (end + 3 <= n and types[data[end + 2]]) or (end < n < end + 3))
        if not good:
            if cut < 0 and (i + 3 > n or (types[data[i + 2]] and end > n)):
                cut = i
            lost += 1
            i += 1
            continue
        cut = -1
        messages += 1
        if data[i + 2] == 68 and end - i >= 13:  # D: message number, then its time
            stamp = np.int64(0)
            for b in range(8):
                stamp |= np.int64(data[i + 5 + b]) << (8 * b)
            stamps[told % RATE] = stamp
            told += 1
        elif data[i + 2] == 79 and end - i >= 5 and k < len(dropouts):
            dropouts[k, 0] = i
            dropouts[k, 1] = data[i + 3] | np.int64(data[i + 4]) << 8
            dropouts[k, 2] = np.median(stamps[: min(told, RATE)]) if told else 0
            k += 1
        i = end
    truncated = 0
    if cut >= 0:
        truncated = n - cut
        lost -= truncated
    return messages, lost, truncated, k


class Dropout(NamedTuple):
    """The logger could not write: about when since boot, us, and for how long, ms."""

    t: int
    duration: int


class Walk(NamedTuple):
    """What stands in a file, byte for byte: size = head + bytes of messages + `discarded` + `truncated`."""

    messages: int
    discarded: int
    truncated: int
    dropouts: list[Dropout]


def walk(data: bytes) -> Walk:
    """Count the messages of a log, the bytes of none, and those of the message that the end cuts."""
    dropouts = np.zeros((4096, 3), np.int64)
    messages, lost, truncated, k = _walk(np.frombuffer(data, np.uint8), _TYPES, dropouts)
    return Walk(messages, lost, truncated, [Dropout(int(t), int(ms)) for _, ms, t in dropouts[:k]])


class _Overrun(Exception):
    """A damaged log makes the reader go round in circles."""


class _Bounded(io.BytesIO):
    """A file in memory that ends a reader which does not get on."""

    def __init__(self, data: bytes) -> None:
        super().__init__(data)
        self._reads, self._bytes = 4 * len(data) + 10_000, 64 * len(data) + (1 << 26)

    def read(self, size: int | None = -1, /) -> bytes:
        got = super().read(size)
        self._reads -= 1
        self._bytes -= len(got)
        if self._reads < 0 or self._bytes < 0:
            raise _Overrun
        return got


def _fields(formats: dict[str, Any]) -> None:
    """Refuse definitions that contain themselves or claim too many fields."""
    sizes: dict[str, int] = {}

    def size(name: str, depth: int) -> int:
        if name not in formats:
            return 1
        if name not in sizes:
            if depth > 8:
                raise ValueError(f"the definition of {readable(name)} contains itself")
            sizes[name] = sum(max(count, 1) * size(kind, depth + 1) for kind, count, _ in formats[name].fields)
        if sizes[name] > MOST_FIELDS:
            raise ValueError(f"the definition of {readable(name)} claims {sizes[name]} fields")
        return sizes[name]

    for name in formats:
        size(name, 0)


def _parse(path: Path, data: bytes) -> tuple[Any, str]:
    """What pyulog makes of a log, and what it complained of."""
    from pyulog import ULog

    complaints = io.StringIO()
    try:
        with contextlib.redirect_stdout(complaints):
            _fields(ULog(_Bounded(data), parse_header_only=True).message_formats)
            log = ULog(_Bounded(data), message_name_filter_list=[*sorted(TOPICS), STATUS])
    except MemoryError:
        raise
    except Exception as error:  # whatever a damaged file makes pyulog fail with
        why = "its reader goes round in circles" if isinstance(error, _Overrun) else str(error) or type(error).__name__
        raise ValueError(
            f"{path} cannot be read as a PX4 log ({len(data)} bytes): {readable(why)}; "
            "download it from the vehicle again, or use the telemetry log"
        ) from None
    return log, readable("; ".join(dict.fromkeys(complaints.getvalue().splitlines())))


class UlogSource:
    """The samples of a ULog.

    Parameters
    ----------
    path : str or Path
    mark : str
        Regular expression of a test-point mark in a text (`telemetry.text`).
    on_progress : callable, optional
        Called with the number of bytes read, once.

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
        One.

    Raises
    ------
    OSError
        If the file cannot be read.
    ValueError
        If it is empty, no PX4 log, damaged beyond reading, or holds no sample.
    """

    def __init__(
        self, path: str | Path, *, mark: str = text.MARK, on_progress: Callable[[int], None] | None = None
    ) -> None:
        text.check_mark(mark)
        self.path = Path(path)
        self._mark, self._progress = mark, on_progress
        data = self.path.read_bytes()
        self.size = len(data)
        if not data:
            raise ValueError(f"{self.path} is empty: nothing was recorded")
        if data[: len(MAGIC)] != MAGIC or len(data) < HEAD:
            raise ValueError(f"{self.path} is no PX4 log: it does not begin as a ULog does; a .ulg file is expected")
        self._walk = walk(data)
        self.truncated, self.discarded = self._walk.truncated, self._walk.discarded
        log, self._complaints = _parse(self.path, data)
        self._left_out: Counter[str] = Counter()
        with np.errstate(invalid="ignore", over="ignore"):  # damaged numbers
            topics = [
                Topic(d.name, d.multi_id, d.data, self._left_out)
                for d in log.data_list
                if "timestamp" in d.data and d.name != STATUS
            ]
            self._streams, self._unused = streams(topics, self._left_out)
        if not self._streams:
            damaged = f" ({self.discarded} of them are no message)" if self.discarded else ""
            raise ValueError(
                f"{self.path} holds no sample: no topic that feeds a sensor in {self.size} bytes{damaged}; "
                "log sensor_combined, vehicle_gps_position and vehicle_air_data (SDLOG_PROFILE)"
            )
        self._texts = _texts(log)
        self.vehicle, kind = _vehicle(log)
        begin = min(int(s.t[0]) for s in self._streams)
        boot = Boot(0, begin, max(int(s.t[-1]) for s in self._streams))
        receiver = next((s.name for s in self._streams if s.kind is Gnss), None)
        for topic in topics:
            if topic.called == receiver:
                boot.pair(*utc(topic))
        self.boots = [boot]
        place(self.boots, self.path.stat().st_mtime_ns)
        self.properties = self._describe(log, kind, hashlib.sha256(data).hexdigest())

    def _describe(self, log: Any, kind: str, digest: str) -> dict[str, str]:
        info = log.msg_info_dict
        try:
            release = log.get_version_info_str()
        except (TypeError, ValueError):  # the version in the log is no number
            release = None
        firmware = [info.get("sys_name"), release or info.get("ver_sw_branch"), info.get("ver_sw"), info.get("ver_hw")]
        out = {
            "log": self.path.name,
            "bytes": str(self.size),
            "sha256": digest,
            "format": "PX4 ULog",
            "firmware": readable(" ".join(str(part) for part in firmware if part)),
            "vehicle type": kind,
            "boots": "1",
        }
        parameters = log.initial_parameters
        out |= {name: f"{float(parameters[name]):g}" for name in EVIDENCE if _is_number(parameters.get(name))}
        return {name: value for name, value in out.items() if value}

    def messages(self) -> Iterator[Message]:
        """Yield samples, texts, marks, events and the byte account, with a `Progress` after every block of time."""
        (boot,) = self.boots
        account = Account(self.size, self._walk.messages, 0, 0, self.discarded, self.truncated)
        if self._progress:
            self._progress(self.size)
        teller = Teller(self.vehicle, self._mark, lambda: account)
        first = next((s for s in self._streams if s.kind is Imu), None) or max(self._streams, key=lambda s: len(s.t))
        teller.boot(0, boot.begin + boot.offset, boot.offset, first.kind, _interval(first))
        begin = boot.begin + boot.offset
        notes = [Note(begin, begin, level, line) for level, line in self._remarks()]
        for dropout in self._walk.dropouts:
            t = min(max(dropout.t * 1000, boot.begin), boot.end)
            line = (
                f"the logger dropped out for {dropout.duration} ms about {t * 1e-9:.1f} s since boot: "
                "it could not write, and what was measured then is lost"
            )
            notes.append(Note(t + boot.offset, t + boot.offset, "warning", line))
        said = []
        for stamp, severity, words in self._texts:
            t = min(max(stamp, boot.begin), boot.end) + boot.offset  # a text of another time stands at the edge
            said.append(Said(t, t, severity, words))
        shifted = [s._replace(t=s.t + boot.offset, t_rx=s.t_rx + boot.offset) for s in self._streams]
        yield from teller.tell(shifted, said, notes)
        yield from teller.end(clock_fit(boot, self.vehicle, STAGE))
        yield from teller.finish(self._sums())

    def _remarks(self) -> list[tuple[Level, str]]:
        """What is told at the beginning."""
        (boot,) = self.boots
        feeds: dict[str, tuple[str, float]] = {}
        others: dict[str, list[str]] = {}
        for stream in self._streams:
            sensor = stream.kind.stream
            if sensor in feeds:
                others.setdefault(sensor, []).append(stream.name)
            else:
                feeds[sensor] = stream.name, _interval(stream)
        notes: list[tuple[Level, str]] = [("info", f"PX4 ULog: {self.properties.get('firmware', 'firmware unknown')}")]
        notes += [("info", line) for line in said_of(feeds, others)]
        if self._unused:
            notes.append(("info", f"not used, because there is better: {', '.join(self._unused)}"))
        if feeds.get("imu", ("", 0))[0].startswith("sensor_gyro"):
            turned = self.properties.get("SENS_BOARD_ROT", "unknown")
            line = f"imu from raw sensors: neither calibrated nor turned into the body (SENS_BOARD_ROT {turned})"
            notes.append(("warning", line))
        notes.append(("info" if boot.t else "warning", f"boot 0: time is from {boot.how}"))
        return notes

    def _sums(self) -> list[Note]:
        said = [f"{why}: {count} samples left out" for why, count in sorted(self._left_out.items())]
        if self._complaints:
            said.append(f"damage: {self._complaints[:500]}")
        if self.discarded:
            said.append(f"{self.discarded} bytes of the log were no message")
        if self.truncated:
            said.append(f"the log ends inside a message: its last {self.truncated} bytes are left out")
        return [Note(0, 0, "warning", line) for line in said]


def _interval(stream: Stream) -> float:
    steps: NDArray[np.int64] = np.diff(stream.t)
    steps = steps[steps > 0]
    return float(np.median(steps)) * 1e-9 if len(steps) else 0.0


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float))


def _texts(log: Any) -> list[tuple[int, int, str]]:
    """Time, ns, severity and words of everything that was logged as text."""
    tagged = [message for messages in log.logged_messages_tagged.values() for message in messages]
    return [
        (min(int(m.timestamp), 1 << 52) * 1000, int(m.log_level) & 7, readable(m.message))
        for m in [*log.logged_messages, *tagged]
    ]


def _vehicle(log: Any) -> tuple[int, str]:
    """System id, 1 if it is not told, and kind of vehicle, empty if it is not told."""
    number, kind = log.initial_parameters.get("MAV_SYS_ID", 0), ""
    for data in log.data_list:
        if data.name == STATUS:
            kind = VEHICLES.get(int(data.data["system_type"][-1]), "") if "system_type" in data.data else ""
            if not number and "system_id" in data.data:
                number = int(data.data["system_id"][-1])
    return (int(number) if _is_number(number) and 0 < number < 256 else 1), kind
