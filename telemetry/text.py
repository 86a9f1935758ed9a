"""What a vehicle says in words: STATUSTEXT, put together again, and the test-point marks in it."""

from __future__ import annotations

import re
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from telemetry.messages import Mark, StatusText

MSGID = 253
CHUNK = 50
PATIENCE = 2_000_000_000  # ns that a text waits for its next chunk
DUPLICATE = 1_000_000_000  # ns within which the same frame on the same link is a copy
REDUNDANT = 10_000_000_000  # ns within which the same frame on another link is the same text
MARK = r"^TP (?P<name>\S+) (?P<action>start|stop)$"


class _Said(NamedTuple):
    t: int
    t_rx: int
    boot: int
    severity: int
    text: str


class Texts:
    """The texts of one component of one vehicle, over all links.

    A text longer than 50 characters comes in chunks under a non-zero ``id``. It is told when its last chunk, the one
    with a terminating NUL, has arrived; when another long text begins; or with what there is `PATIENCE` after the
    newest chunk. A text heard twice, over two links or as a copy, is told once.

    Parameters
    ----------
    vehicle : int
    source : str
    pattern : str
        Regular expression of a test-point mark with the groups ``name`` and ``action``.
    """

    def __init__(self, vehicle: int, source: str, pattern: str = MARK) -> None:
        self._vehicle = vehicle
        self._source = source
        self._mark = re.compile(pattern)
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
            # numpy strips trailing NULs of a character: an empty item is the terminator
            chunk = b"".join(c or b"\0" for c in value["text"]).split(b"\0", 1)[0]
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
        if before and before[0] == payload and t_rx - before[2] < (DUPLICATE if before[1] == link else REDUNDANT):
            return True
        self._heard[seq] = payload, link, t_rx
        return False

    def _messages(self, said: list[_Said]) -> list[StatusText | Mark]:
        out: list[StatusText | Mark] = []
        for one in said:
            common: dict[str, Any] = {"vehicle": self._vehicle, "source": self._source, "boot": one.boot}
            common |= {"t": np.array([one.t]), "t_rx": np.array([one.t_rx])}
            out.append(StatusText(**common, severity=np.array([one.severity]), text=[one.text]))
            if found := self._mark.match(one.text):
                action: Literal["start", "stop"] = "start" if found["action"] == "start" else "stop"
                out.append(Mark(**common, action=[action], name=[found["name"]]))
        return out

    def _join(self, t_rx: int) -> _Said:
        whole = b"".join(self._chunks[k] for k in sorted(self._chunks))
        self._chunks = {}
        return self._newest._replace(t_rx=t_rx, text=_readable(whole))


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
