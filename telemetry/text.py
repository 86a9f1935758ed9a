"""What a vehicle says in words: STATUSTEXT, put together again, and the test-point marks in it.

A vehicle marks a test point of its own, in words that the settings choose (`MARK` unless they say otherwise)::

    TP 12 start
    TP 12 stop

A ground station marks those of the vehicles. It uses the same words, and may name one vehicle behind them; 0, or none
named, is every vehicle heard::

    TP 12 start @1
    TP 12 start @0

With a name behind them these words are understood whatever the settings choose, so that who says them (`sortie mark`)
need not know the settings.
"""

from __future__ import annotations

import re
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from telemetry.frames import Frames
from telemetry.messages import Mark, StatusText

MSGID = 253
CHUNK = 50
PATIENCE = 2_000_000_000  # ns that a text waits for its next chunk
DUPLICATE = 1_000_000_000  # ns within which the same frame on the same link is a copy
REDUNDANT = 10_000_000_000  # ns within which the same frame on another link is the same text
MARK = r"^TP (?P<name>\S+) (?P<action>start|stop)$"
STATION, STATION_COMPONENT = 255, 190  # a ground station is this system or this component (MAV_COMP_ID_MISSIONPLANNER)
_ADDRESS = re.compile(r" @(?P<vehicle>[0-9]{1,3})$")
_ADDRESSED = re.compile(r"^TP (?P<name>\S(?:.*\S)?) (?P<action>start|stop)$")

Action = Literal["start", "stop"]


class _Said(NamedTuple):
    t: int
    t_rx: int
    boot: int
    severity: int
    text: str


class GroundMark(NamedTuple):
    """A mark that a ground station says: of which vehicle, 0 for every one."""

    action: Action
    name: str
    vehicle: int


class Texts:
    """The texts of one component of one vehicle, over all links.

    A text longer than 50 characters comes in chunks under a non-zero ``id``. It is told when its last chunk, the one
    with a terminating NUL, has arrived; when another long text begins; or with what there is `PATIENCE` after the
    newest chunk. A text heard twice, over two links or as a copy, is told once.

    Parameters
    ----------
    vehicle : int
    source : str
    pattern : str or None
        Regular expression of a test-point mark with the groups ``name`` and ``action``; None: no text is a mark.
    duplicate : int
        How long the same frame on the same link is a copy, ns.
    """

    def __init__(self, vehicle: int, source: str, pattern: str | None = MARK, *, duplicate: int = DUPLICATE) -> None:
        self._vehicle = vehicle
        self._source = source
        self._pattern = pattern
        self._duplicate = duplicate
        self._id = 0
        self._chunks: dict[int, bytes] = {}
        self._newest = _Said(0, 0, 0, 6, "")  # of the chunks that wait
        self._heard: dict[int, tuple[bytes, int, int]] = {}  # sequence number -> frame's payload, link, receive time

    def read(
        self,
        values: NDArray[Any],
        seq: NDArray[np.uint8],
        link: NDArray[np.uint8],
        t: NDArray[np.int64],
        t_rx: NDArray[np.int64],
        boot: int,
    ) -> list[StatusText | Mark]:
        """Turn a batch of STATUSTEXT payloads, in the order of arrival, into texts and the marks among them."""
        said: list[_Said] = []
        for i, value in enumerate(values):
            said += self._overdue(int(t_rx[i]))
            if self._repeated(int(seq[i]), value.tobytes(), int(link[i]), int(t_rx[i])):
                continue
            chunk = _chunk(value)
            now = _Said(int(t[i]), int(t_rx[i]), boot, int(value["severity"]), "")
            number = int(value["id"]) if "id" in (values.dtype.names or ()) else 0
            if number == 0:
                said.append(now._replace(text=_readable(chunk)))
                continue
            if self._chunks and number != self._id:
                said.append(self._join(now.t_rx))
            self._id, self._newest = number, now
            self._chunks[int(value["chunk_seq"])] = chunk
            if len(chunk) < CHUNK:
                said.append(self._join(now.t_rx))
        return self._messages(said)

    @property
    def waits(self) -> bool:
        """Whether the beginning of a text waits for its end."""
        return bool(self._chunks)

    def expire(self, until: int, final: bool = False) -> list[StatusText | Mark]:
        """What has waited long enough for its end, now that everything received up to `until` has been read."""
        if final and self._chunks:
            return self._messages([self._join(self._newest.t_rx)])
        return self._messages(self._overdue(until))

    def _overdue(self, now: int) -> list[_Said]:
        deadline = self._newest.t_rx + PATIENCE
        return [self._join(deadline)] if self._chunks and now >= deadline else []

    def _repeated(self, seq: int, payload: bytes, link: int, t_rx: int) -> bool:
        before = self._heard.get(seq)
        if before and before[0] == payload and t_rx - before[2] < (self._duplicate if before[1] == link else REDUNDANT):
            return True
        self._heard[seq] = payload, link, t_rx
        return False

    def _messages(self, said: list[_Said]) -> list[StatusText | Mark]:
        out: list[StatusText | Mark] = []
        for one in said:
            common: dict[str, Any] = {"vehicle": self._vehicle, "source": self._source, "boot": one.boot}
            common |= {"t": np.array([one.t]), "t_rx": np.array([one.t_rx])}
            out.append(StatusText(**common, severity=np.array([one.severity]), text=[one.text]))
            if self._pattern and (found := _mark(re.match(self._pattern, one.text))):
                out.append(Mark(**common, action=[found[0]], name=[found[1]]))
        return out

    def _join(self, t_rx: int) -> _Said:
        whole = b"".join(self._chunks[k] for k in sorted(self._chunks))
        self._chunks = {}
        return self._newest._replace(t_rx=t_rx, text=_readable(whole))


def _chunk(value: Any) -> bytes:
    """The characters of a STATUSTEXT payload before its first NUL."""
    # numpy strips trailing NULs of a character: an empty item is the terminator
    return b"".join(c or b"\0" for c in value["text"]).split(b"\0", 1)[0]


def _mark(found: re.Match[str] | None) -> tuple[Action, str] | None:
    """Action and name, if both were said."""
    if not found or not found["name"]:
        return None
    said = (found["action"] or "").lower()
    return ("start" if said == "start" else "stop", found["name"]) if said in ("start", "stop") else None


def is_station(sysid: int, compid: int) -> bool:
    """Whether a sender is a ground station."""
    return sysid == STATION or compid == STATION_COMPONENT


def said_on_the_ground(frames: Frames) -> NDArray[np.bool_]:
    """Which frames are texts of ground stations, shape (k,)."""
    station = (frames.sysid == STATION) | (frames.compid == STATION_COMPONENT)
    return np.asarray(frames.known & (frames.msgid == MSGID) & station)


def ground_text(action: Action, name: str, vehicle: int = 0) -> str:
    """What a ground station says to mark a test point of one vehicle, or with 0 of every vehicle.

    Raises
    ------
    ValueError
        If the name cannot be said in one STATUSTEXT, or the vehicle is not one of 0 to 255.
    """
    if not 0 <= vehicle <= 255:
        raise ValueError(f"vehicle {vehicle}: a MAVLink system is 1 to 255, and 0 is every vehicle")
    if not name or name != name.strip() or not name.isprintable():
        raise ValueError(f"test point {name!r}: a name is printable and neither empty nor begins or ends with a space")
    text = f"TP {name} {action} @{vehicle}"
    over = len(text.encode("utf-8", "replace")) - CHUNK
    if over > 0:
        raise ValueError(
            f"test point {name!r}: a STATUSTEXT holds {CHUNK} bytes and {text!r} has {over} more; choose a shorter name"
        )
    return text


def ground_mark(text: str, pattern: str = MARK) -> GroundMark | None:
    """The mark in what a ground station says; None if there is none.

    Parameters
    ----------
    text : str
    pattern : str
        As in `Texts`; what is said in the words of `ground_text` needs none.
    """
    address = _ADDRESS.search(text)
    said = text[: address.start()] if address else text
    found = _mark(_ADDRESSED.match(said)) if address else None
    found = found or _mark(re.match(pattern, said))
    return GroundMark(*found, int(address["vehicle"]) if address else 0) if found else None


def is_addressed(value: Any) -> bool:
    """Whether a STATUSTEXT payload of a ground station names a vehicle behind a mark, as `ground_text` does."""
    text = _readable(_chunk(value))
    address = _ADDRESS.search(text)
    return bool(address and _ADDRESSED.match(text[: address.start()]))


def _readable(raw: bytes) -> str:
    """Text from a wire: whatever is not printable is shown as a replacement character."""
    text = raw.decode("utf-8", "replace")
    return "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in text)


def check_mark(pattern: str) -> None:
    """Refuse a pattern of marks that cannot work.

    Raises
    ------
    ValueError
        If it is no regular expression, or lacks the groups ``name`` and ``action``.
    """
    try:
        groups = set(re.compile(pattern).groupindex)
    except re.error as error:
        raise ValueError(f"mark {pattern!r} is no regular expression: {error}") from None
    if not {"name", "action"} <= groups:
        raise ValueError(f"mark {pattern!r} needs the groups (?P<name>...) and (?P<action>start|stop)")
