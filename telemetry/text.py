"""What a vehicle says in words: STATUSTEXT, put together again, and the test-point marks in it."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
from numpy.typing import NDArray

from telemetry.messages import Mark, StatusText

MSGID = 253
CHUNK = 50
MARK = r"^TP (?P<name>\S+) (?P<action>start|stop)$"


class Texts:
    """The texts of one component of one vehicle.

    A text longer than 50 characters comes in chunks under one non-zero ``id``; it is told when its last chunk, the
    one with a terminating NUL, has arrived, and with what there is when another text begins first.

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
        self._severity = 6

    def read(
        self, values: NDArray[Any], t: NDArray[np.int64], t_rx: NDArray[np.int64], boot: int
    ) -> list[StatusText | Mark]:
        """Turn a batch of STATUSTEXT payloads into texts and the marks among them."""
        said: list[tuple[int, int, int, str]] = []
        for i, value in enumerate(values):
            # numpy strips trailing NULs of a character: an empty item is the terminator
            chunk = b"".join(c or b"\0" for c in value["text"]).split(b"\0", 1)[0]
            chunked = int(value["id"]) if "id" in (values.dtype.names or ()) else 0
            if self._chunks and chunked != self._id:
                said.append((int(t[i]), int(t_rx[i]), self._severity, self._join()))
            if chunked == 0:
                said.append((int(t[i]), int(t_rx[i]), int(value["severity"]), _readable(chunk)))
                continue
            self._id, self._severity = chunked, int(value["severity"])
            self._chunks[int(value["chunk_seq"])] = chunk
            if len(chunk) < CHUNK:
                said.append((int(t[i]), int(t_rx[i]), self._severity, self._join()))
        if not said:
            return []
        common: dict[str, Any] = {"vehicle": self._vehicle, "source": self._source, "boot": boot}
        times = np.array([(when, rx) for when, rx, _, _ in said], np.int64)
        out: list[StatusText | Mark] = [
            StatusText(
                **common,
                t=times[:, 0],
                t_rx=times[:, 1],
                severity=np.array([severity for _, _, severity, _ in said], np.int64),
                text=[text for _, _, _, text in said],
            )
        ]
        for when, rx, _, text in said:
            if found := self._mark.match(text):
                out.append(
                    Mark(
                        **common,
                        t=np.array([when]),
                        t_rx=np.array([rx]),
                        action=["start" if found["action"] == "start" else "stop"],
                        name=[found["name"]],
                    )
                )
        return out

    def _join(self) -> str:
        whole = b"".join(self._chunks[k] for k in sorted(self._chunks))
        self._chunks = {}
        return _readable(whole)


def _readable(raw: bytes) -> str:
    """Text from a wire: whatever is not printable is shown as a replacement character."""
    text = raw.decode("utf-8", "replace")
    return "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in text)
