"""The loss account of every sender on every link: who was heard, what was lost, one row per second.

Accounts are kept per (link, system, component) and never added up: radios and ground stations share a link with the
autopilot and often count oddly. The rules are in `telemetry.loss`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from telemetry import loss
from telemetry.loss import COUNTERS, SECOND, SILENT_ROWS
from telemetry.messages import Counts, Floats, LinkStats, Times

Numbers = NDArray[np.uint8]


class Rows(NamedTuple):
    """Columns of an account, all of shape (k,), one row per second; counters and losses as in `LinkStats`."""

    t_rx: Times
    received: Counts
    lost: Counts
    late: Counts
    out_of_order: Counts
    duplicate: Counts
    conflict: Counts
    ambiguous: Counts
    restarted: Counts
    unknown: Counts
    redundant: Counts
    loss: Floats
    loss_total: Floats


def _plain(values: NDArray[np.generic], dtype: type) -> NDArray[np.generic]:
    """Contiguous and writeable: numba would compile its kernel once more for a read-only array."""
    values = np.ascontiguousarray(values, dtype)
    return values if values.flags.writeable else values.copy()


class LossAccount:
    """The account of one (link, system, component).

    The same frames give the same rows wherever the stream is cut. Receive times that run backwards are taken as
    standing still: the age of a hole is a matter of a monotonic clock.

    Rows stand at whole seconds of receive time, from the first one after the first frame; each states the account of
    the frames *before* its second. They stop 60 s after the last frame and begin again with the next one, so a receive
    clock that jumps by years makes 60 rows.
    """

    def __init__(self) -> None:
        self._state = np.zeros(loss.SIZE, np.int64)
        self._state[[loss.EXPIRY, loss.JUMP]] = loss.NEVER, -1
        self._fate = np.zeros(256, np.uint8)
        self._since, self._digests = np.zeros(256, np.int64), np.zeros(256, np.int64)
        self._odd, self._odd_times = np.zeros(loss.RECENT, np.uint8), np.zeros(loss.RECENT, np.int64)
        self._past = np.zeros((10, 2), np.int64)
        self._counts: list[Counts] = []
        self._losses: list[Floats] = []
        self._quiet = loss.NEVER  # receive time up to which nothing is due

    @property
    def counters(self) -> dict[str, int]:
        """The counters now, with ``spanned``, ``open`` and ``held`` of the identity in `telemetry.loss`."""
        names = (*Rows._fields[1 : 1 + COUNTERS], "spanned", "open", "held")
        values = self._state[[*range(COUNTERS), loss.SPANNED, loss.OPEN, loss.HELD]]
        return dict(zip(names, values.tolist(), strict=True))

    def feed(
        self, seq: Numbers, t_rx: Times, digest: Counts, marks: Numbers | None = None, told: Times | None = None
    ) -> None:
        """Account for frames in the order of arrival.

        Parameters
        ----------
        seq : uint8 array, shape (k,)
            Sequence numbers.
        t_rx : int64 array, shape (k,)
            Receive times, ns.
        digest : int64 array, shape (k,)
            Digest of the frame: a second frame with the same number is a duplicate if it has the same, else a conflict.
        marks : uint8 array, shape (k,), optional
            What is known of each frame, bits of `telemetry.loss`: ``BEGUN``, at this frame the sender is known to have
            begun again, now or a few frames ago; ``CONTINUES``, it is known *not* to have begun again, because its boot
            clock goes on, which shortens the wait for a restart after a long silence from 20 s to 5 s; ``UNKNOWN_ID``;
            ``COPY``, another link has brought it before.
        told : int64 array, shape (k,), optional
            Vehicle time, ns, where the frame tells it, else 0: tells a silence from a step of the receive clock.
        """
        if len(seq) == 0:
            return
        times = _plain(t_rx, np.int64)
        state = self._state
        since, until = (int(state[loss.BOUNDARY]) if state[loss.STARTED] else int(times[0])), int(times[-1])
        if len(times) > 1:
            until = max(until, int(times.max()))
        counts, losses = self._room(since, until, len(times))
        k = loss.feed(
            state,
            self._fate,
            self._since,
            self._digests,
            self._odd,
            self._odd_times,
            self._past,
            _plain(seq, np.uint8),
            times,
            _plain(digest, np.int64),
            np.zeros(len(times), np.uint8) if marks is None else _plain(marks, np.uint8),
            np.zeros(len(times), np.int64) if told is None else _plain(told, np.int64),
            counts,
            losses,
        )
        self._keep(counts, losses, k)

    def advance(self, t_rx: int) -> None:
        """Receive time has reached t_rx (ns): every frame before it has been fed."""
        if t_rx < self._quiet:
            return
        state = self._state
        if state[loss.STARTED] and t_rx > state[loss.NOW]:
            counts, losses = self._room(int(state[loss.BOUNDARY]), t_rx, 0)
            k = loss.advance(state, self._fate, self._since, self._past, self._odd_times, t_rx, counts, losses, 0)
            self._keep(counts, losses, k)

    def finish(self, t_rx: int) -> None:
        """The stream has ended at t_rx (ns): open holes and a held jump are lost, and one last row says so."""
        state = self._state
        if state[loss.STARTED]:
            t = max(t_rx, int(state[loss.NOW]))
            counts, losses = self._room(int(state[loss.BOUNDARY]), t, 0)
            k = loss.end(state, self._fate, self._since, self._past, self._odd_times, t, counts, losses)
            self._keep(counts, losses, k)

    def rows(self) -> Rows:
        """Drain the rows due so far."""
        self._counts = self._counts or [np.empty((0, 1 + COUNTERS), np.int64)]
        self._losses = self._losses or [np.empty((0, 2))]
        counts, losses = np.concatenate(self._counts), np.concatenate(self._losses)
        self._counts, self._losses = [], []
        return Rows(*np.ascontiguousarray(counts.T), *np.ascontiguousarray(losses.T))

    @staticmethod
    def _room(since: int, until: int, frames: int) -> tuple[Counts, Floats]:
        """Space for the rows due: one per second, but not more than one silence per frame can make."""
        size = min(max((until - since) // SECOND, 0) + 2, (frames + 1) * (SILENT_ROWS // SECOND + 2))
        return np.empty((size, 1 + COUNTERS), np.int64), np.empty((size, 2))

    def _keep(self, counts: Counts, losses: Floats, k: int) -> None:
        if k:
            self._counts.append(counts[:k])
            self._losses.append(losses[:k])
        state = self._state
        due = min(int(state[loss.BOUNDARY]), int(state[loss.EXPIRY]))
        if state[loss.JUMP] >= 0:
            due = min(due, int(state[loss.JUMP]) + loss.SETTLE)
        self._quiet = due

    @property
    def due(self) -> bool:
        """Whether there are rows to drain."""
        return bool(self._counts)


SENDERS = 1024  # followed at once: what invents more of them must not use up memory and time


class LinkAccounts:
    """The accounts of all senders on all links, fed with whole batches of frames.

    Attributes
    ----------
    unfollowed : int
        Frames of senders beyond the first 1024, which have no account.
    """

    def __init__(self) -> None:
        self._accounts: dict[tuple[int, int, int], LossAccount] = {}
        self.unfollowed = 0

    def __getitem__(self, key: tuple[int, int, int]) -> LossAccount:
        """The account of (link, system, component)."""
        return self._accounts[key]

    def feed(
        self,
        link: Numbers,
        sysid: Numbers,
        compid: Numbers,
        seq: Numbers,
        t_rx: Times,
        digest: Counts,
        marks: Numbers | None = None,
        told: Times | None = None,
    ) -> None:
        """Account for a batch of frames of any senders in the order of arrival; columns as in `LossAccount.feed`."""
        keys = (link.astype(np.int64) << 16) | (sysid.astype(np.int64) << 8) | compid
        marks = np.zeros(len(keys), np.uint8) if marks is None else marks
        told = np.zeros(len(keys), np.int64) if told is None else told
        present: list[int] = sorted(set(keys.tolist())) if len(keys) < 64 else np.unique(keys).tolist()
        for key in present:
            name = key >> 16, key >> 8 & 255, key & 255
            if name not in self._accounts:
                if len(self._accounts) >= SENDERS:
                    self.unfollowed += int(np.count_nonzero(keys == key))
                    continue
                self._accounts[name] = LossAccount()
            if len(present) == 1:
                self._accounts[name].feed(seq, t_rx, digest, marks, told)
            else:
                mine = (keys == key).nonzero()[0]
                self._accounts[name].feed(seq[mine], t_rx[mine], digest[mine], marks[mine], told[mine])

    def advance(self, t_rx: int) -> None:
        """Receive time has reached t_rx (ns) on every link: every frame before it has been fed."""
        for account in self._accounts.values():
            account.advance(t_rx)

    def finish(self, t_rx: int) -> None:
        """Every stream has ended at t_rx (ns)."""
        for account in self._accounts.values():
            account.finish(t_rx)

    def drain(self, link_names: Mapping[int, str] | Sequence[str], boot: Callable[[int], int]) -> list[LinkStats]:
        """Say what is due: one message per sender with new rows, in the order of (link, system, component).

        Parameters
        ----------
        link_names : mapping or sequence of str
            Name of each link; the source of a message is ``"name/component"``.
        boot : callable
            Boot epoch of a system id.
        """
        said = []
        for link, sysid, compid in sorted(name for name, account in self._accounts.items() if account.due):
            rows = self._accounts[link, sysid, compid].rows()
            source = f"{link_names[link]}/{compid}"
            said.append(LinkStats(vehicle=sysid, source=source, boot=boot(sysid), t=rows.t_rx, **rows._asdict()))
        return said
