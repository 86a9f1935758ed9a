"""MAVLink 2 signatures, checked by our own code.

The last 13 bytes of a signed frame::

    link[1] time[6] signature[6]

`time` counts 10 us since 2015-01-01 UTC, and the signature is the beginning of SHA-256(key + frame up to and including
the time) (https://mavlink.io/en/guide/message_signing.html). A time counts only once for a (system, component, link)
and they run forward, so that what was recorded cannot be sent again. Nothing is remembered of a frame before its
signature has been found right: a forged one can neither pass nor lock out the aircraft.

It shows who sent a frame. It hides nothing.
"""

from __future__ import annotations

import hashlib
import hmac
import json
import os
import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from telemetry.frames import STX2, Frames

Verdict = Literal["ok", "radio", "unsigned", "bad", "replay", "future"]
VERDICTS: tuple[Verdict, ...] = get_args(Verdict)
WHY: dict[Verdict, str] = {
    "unsigned": "it is not signed",
    "bad": "its signature is wrong",
    "replay": "its time of signing is not new, or lies too far back: a recording, or the sender's clock is behind",
    "future": "its time of signing lies ahead: one of the clocks is wrong",
}
EPOCH = 1_420_070_400_000_000_000  # 2015-01-01 UTC, ns of Unix time
UNIT = 10_000  # ns
SIGNATURE = 13
SIGNED = 1  # incompatibility flag
RADIO, RADIO_COMPONENT, RADIO_STATUS = 51, 68, 109
COPIES = 4096  # frames of each sender whose copies over other links are still known
SAVE = 5.0  # s
LONGEST_KEY_FILE = 4096
TITLE = "times of MAVLink signatures, 10 us since 2015"


@dataclass(frozen=True)
class Key:
    """A signing key.

    Attributes
    ----------
    secret : bytes
        32 bytes; not shown when the key is printed.
    warning : str or None
        What is wrong with how it is kept.
    """

    secret: bytes = field(repr=False)
    warning: str | None = None


def read_key(path: Path) -> Key:
    """Read a signing key from a file.

    A text is a passphrase, from which the key is made as MAVProxy and Mission Planner do (SHA-256), unless it is 64
    hexadecimal digits: these, like 32 bytes that are no text, are the key itself. White space around a text does not
    count.

    Raises
    ------
    OSError
        If the file cannot be read.
    ValueError
        If it holds no key; the text names the way out.
    """
    with path.open("rb") as file:
        mode = os.fstat(file.fileno()).st_mode
        content = file.read(LONGEST_KEY_FILE + 1)
    warning = None
    text: str | None = None
    if mode & 0o077:
        warning = f"{path}: others can read or change this key: chmod 600 {path}"
    try:
        text = content.decode().strip()
    except UnicodeDecodeError:
        pass
    if text is not None and not text.isprintable():
        text = None
    if text is None:
        if len(content) != 32:
            what = "over 4 kB" if len(content) > LONGEST_KEY_FILE else f"{len(content)} bytes"
            raise ValueError(f"{path}: {what} are no signing key: 32 bytes, 64 hexadecimal digits or a passphrase are")
        return Key(content, warning)
    if not text:
        raise ValueError(f"{path}: no signing key in it: write a passphrase or 64 hexadecimal digits into it")
    if len(content) > LONGEST_KEY_FILE:
        raise ValueError(f"{path}: over 4 kB are no signing key: 32 bytes, 64 hexadecimal digits or a passphrase are")
    if len(text) == 64 and all(digit in "0123456789abcdefABCDEF" for digit in text):
        return Key(bytes.fromhex(text), warning)
    return Key(hashlib.sha256(text.encode()).digest(), warning)


class SignatureGuard:
    """Tell frames of those who hold the key from all others.

    Parameters
    ----------
    key : bytes
        32 bytes.
    accept_unsigned : bool
        Let frames pass that are not signed; those whose signature is wrong never pass.
    ahead, behind : float
        How far a time of signing may lie ahead of the receive time, and behind it for a sender that is new, s.
    seen : Path, optional
        File that keeps the senders' last times, so that nothing recorded before a restart passes after it.

    Attributes
    ----------
    counts : dict of str to int
        Frames by verdict: "ok"; "radio", the status of a radio of the SiK kind, which cannot sign and always passes;
        "unsigned"; "bad" signature; "replay", not later than the sender's last; "future".
    systems : set of int
        Systems whose signature has been found right.
    error : str or None
        Why `seen` could not be written the last time.

    Raises
    ------
    ValueError
        If the key has another length, or `seen` holds something else.
    OSError
        If `seen` is there and cannot be read.
    """

    def __init__(
        self,
        key: bytes,
        *,
        accept_unsigned: bool = False,
        ahead: float = 60.0,
        behind: float = 60.0,
        seen: Path | None = None,
    ) -> None:
        if len(key) != 32:
            raise ValueError(f"a signing key has 32 bytes, not {len(key)}: read_key makes one of a passphrase")
        self.counts: dict[Verdict, int] = dict.fromkeys(VERDICTS, 0)
        self.systems: set[int] = set()
        self.error: str | None = None
        self._hash = hashlib.sha256(key)
        self._accept_unsigned = accept_unsigned
        self._ahead, self._behind = int(ahead * 1e9) // UNIT, int(behind * 1e9) // UNIT
        self._seen = seen
        self._last = _load(seen) if seen is not None and seen.exists() else {}
        self._copies: dict[tuple[int, int, int], OrderedDict[int, tuple[bytes, int]]] = {}
        self._floor: dict[tuple[int, int, int], int] = {}  # up to here it is not known what has passed
        self._over: dict[tuple[int, int, int, int], int] = {}  # newest time that each link has brought
        self._changed = False
        self._saved = time.monotonic()

    def check(self, frame: bytes, t_rx: int, link: int = 0) -> Verdict:
        """Judge a whole frame, and remember its time if it is right.

        Parameters
        ----------
        frame : bytes
        t_rx : int
            Receive time, ns of Unix time.
        link : int
            Over which link it came: the same frame may come once over each.
        """
        verdict = self._judge(frame, (t_rx - EPOCH) // UNIT, link)
        self.counts[verdict] += 1
        return verdict

    def passes(self, verdict: Verdict) -> bool:
        """Whether a frame of this verdict may be used."""
        return verdict in ("ok", "radio") or (verdict == "unsigned" and self._accept_unsigned)

    def save(self, force: bool = True) -> None:
        """Write the senders' last times: now, or (not `force`) when 5 s have passed since the last time."""
        now = time.monotonic()
        if self._seen is None or not self._changed or not (force or now - self._saved >= SAVE):
            return
        self._saved = now
        content = {"title": TITLE, "last": [[*sender, last] for sender, last in sorted(self._last.items())]}
        beside = self._seen.with_name(self._seen.name + ".new")
        try:
            with beside.open("w") as file:
                json.dump(content, file)
                file.flush()
                os.fsync(file.fileno())
            beside.replace(self._seen)
        except OSError as error:
            self.error = f"{self._seen}: {error.strerror}: what is recorded now could pass after a restart"
            return
        self.error = None
        self._changed = False

    def _judge(self, frame: bytes, now: int, link: int) -> Verdict:
        if frame[0] != STX2 or not frame[2] & SIGNED:
            return "radio" if _from_radio(frame) else "unsigned"
        if len(frame) < 12 + SIGNATURE:
            return "bad"
        digest = self._hash.copy()
        digest.update(frame[:-6])
        signature = frame[-6:]
        if not hmac.compare_digest(digest.digest()[:6], signature):
            return "bad"
        signed = int.from_bytes(frame[-12:-6], "little")
        sender = (frame[5], frame[6], frame[-SIGNATURE])
        copies = self._copies.get(sender)
        bit = 1 << link
        last = self._last.get(sender, now - self._behind)
        if signed <= last:  # a copy, or what the other links lost: over this link the times still run forward
            known, links = copies.get(signed, (signature, 0)) if copies else (b"", 0)
            if not copies or known != signature or links & bit or signed <= self._over.get((*sender, link), -1):
                return "replay"
            if not links and signed <= self._floor[sender]:
                return "replay"
            self._remember(copies, sender, link, signed, signature)
            return "ok"
        if signed > now + self._ahead:
            return "future"
        self._last[sender] = signed
        self.systems.add(sender[0])
        self._changed = True
        if copies is None:
            copies = self._copies[sender] = OrderedDict()
            self._floor[sender] = last
        self._remember(copies, sender, link, signed, signature)
        return "ok"

    def _remember(
        self,
        copies: OrderedDict[int, tuple[bytes, int]],
        sender: tuple[int, int, int],
        link: int,
        signed: int,
        signature: bytes,
    ) -> None:
        copies[signed] = signature, copies.get(signed, (b"", 0))[1] | 1 << link
        self._over[(*sender, link)] = signed
        if len(copies) > COPIES:  # what is older cannot be told from a replay any more
            self._floor[sender] = max(self._floor[sender], copies.popitem(last=False)[0])


def _from_radio(frame: bytes) -> bool:
    at, width = (5, 3) if frame[0] == STX2 else (3, 1)
    msgid = int.from_bytes(frame[at + 2 : at + 2 + width], "little")
    return (frame[at], frame[at + 1], msgid) == (RADIO, RADIO_COMPONENT, RADIO_STATUS)


def _load(path: Path) -> dict[tuple[int, int, int], int]:
    try:
        content = json.loads(path.read_text())
        if content["title"] != TITLE:
            raise ValueError
        last: dict[tuple[int, int, int], int] = {}
        for row in content["last"]:
            system, component, link, signed = row
            if not all(type(number) is int and number >= 0 for number in row):
                raise ValueError
            last[system, component, link] = signed
    except (ValueError, KeyError, TypeError, RecursionError):
        said = "it does not hold the times of signatures that were seen; delete it to begin anew, which lets frames "
        raise ValueError(f"{path}: {said}recorded within the last minute pass once") from None
    return last


def sift(frames: Frames, refused: Callable[[bytes, int, int], bool]) -> Frames:
    """Make junk of the frames that are refused: each becomes a run of its own, so that the raw log tells them as well.

    Parameters
    ----------
    frames : Frames
    refused : callable
        Given a frame's bytes, receive time and link.
    """
    columns = zip(
        frames.start.tolist(), frames.length.tolist(), frames.t_rx.tolist(), frames.link.tolist(), strict=True
    )
    data = frames.data.tobytes()
    rows = np.array([refused(data[start : start + length], t, link) for start, length, t, link in columns], np.bool_)
    return frames.refuse(rows) if rows.any() else frames
