"""Boot epochs: one vehicle's clock, told apart from boot to boot.

A vehicle stamps its messages with the time since boot. That clock starts again with a reboot, a 32-bit counter of it
wraps, and it can step back without either. Which of these a backward step is, the frames around it tell:

wrap
    A counter of one message type falls by more than half its range, and adding the range explains it: the wrapped
    reading is at most the silence + 5 s ahead.
reboot
    The clock is back by more than 1 s, *and* a second witness agrees: another message type, a silence of 10 s, or a
    sequence number that jumps to a small one; *and* time allows it: a vehicle that started after it was last heard
    reads at most the silence + 5 s, or (a replay may run faster than its receive times) less than half of before.
clock step
    The clock is back and stays back, but no reboot explains it, or nothing else bears witness within 2 s or 512
    frames. The epoch goes on.
straggler
    The clock of before goes on in the next frames: the frame was late, or its message tells the time of an event.

Message types are compared with the vehicle's clock, each with the lag it had when it was last seen, so rare and
habitually late ones are neither suspects nor false witnesses. The times of GNSS messages are those of the fix; they
never bear witness.

Over each link the clock is followed by itself, so a link that is seconds behind another one is neither a step nor a
reboot. What still comes over it from before a reboot that another link has shown belongs to the boot before.

A frame that tells no time is placed by what came before it. Its sender's timed frames follow each other at intervals D;
an instant that falls at random among them lies in one in proportion to its length, so since the last reading have
passed, with E the running means over the last 64 intervals::

    mean age = E[D^2] / (2 E[D])        variance = E[D^3] / (3 E[D]) - (mean age)^2

which is D/2 and D^2/12 where they are equal. After a silence g of receive time that is longer it lies anywhere in it:
the age is at least g/2 and its standard deviation at least g/sqrt(12), be it that the timed frames were lost, or that
everything was held up and this one came out first. Before the second reading an interval of 1 s is assumed.

A frame that tells UTC but not the vehicle's time is placed by the last SYSTEM_TIME, which pairs the two; before there
is one, by the frame that was the least late.

While a suspect waits for its witness the frames from it on are *undecided*: `BootClock.feed` says how many are decided
and remembers only those. The caller feeds the rest again, with what has come since.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from telemetry.boots import (
    ANCHOR,
    CLOCK,
    EPOCH,
    KINDS,
    KNOWN,
    L_SEGMENT,
    L_SEQ,
    LINK,
    LINKS,
    NEWS,
    NO_TIME,
    RESTART,
    SECOND,
    SILENCE,
    STATE,
    STEP,
    TURNED,
    WRAP,
    feed,
)
from telemetry.messages import Counts, Times

__all__ = ["NO_TIME", "BootClock", "Epochs"]


class Epochs(NamedTuple):
    """What the frames fed to a `BootClock` turned out to be; columns of shape (decided,).

    Parameters
    ----------
    decided : int
        How many of the frames are decided. The rest must be fed again, before anything newer.
    epoch : int64 array
        Boot epoch, from 0.
    segment : int64 array
        Counts reboots and clock steps: inside a segment the vehicle's time is one line.
    t : int64 array
        Vehicle time, ns: the unwrapped boot clock plus the anchor of the epoch, which is t_rx - t_boot of its first
        timed frame. A frame without a time has the one that is to be expected (`telemetry.clock`).
    sigma : int64 array
        Standard deviation of t, ns; 0 where the frame tells the vehicle's time.
    timed : bool array
        The frame tells the vehicle's clock (and not the time of a fix, an event or nothing).
    restarted : bool array
        First timed frame after a reboot, on each link.
    stale : bool array
        The frame is of a boot before this one, over a link that is behind: its time is of that boot.
    events : list of (int, str)
        Index of the frame, and what happened there.
    """

    decided: int
    epoch: Counts
    segment: Counts
    t: Times
    sigma: Times
    timed: NDArray[np.bool_]
    restarted: NDArray[np.bool_]
    stale: NDArray[np.bool_]
    events: list[tuple[int, str]]


def _plain(values: NDArray[np.generic], dtype: type) -> NDArray[np.generic]:
    """Contiguous and writeable: numba would compile its kernel once more for a read-only array."""
    values = np.ascontiguousarray(values, dtype)
    return values if values.flags.writeable else values.copy()


def _seconds(ns: int) -> str:
    return f"{ns // 1_000_000 / 1000:.3f}"


class BootClock:
    """The clock of one vehicle.

    Frames must come from one clock: the autopilot's component, over any links. Frames of the vehicle's other components
    may be fed among them without a time, to be placed on the same time axis.

    Parameters
    ----------
    vehicle : int
        MAVLink system id, for the texts of events.
    """

    def __init__(self, vehicle: int) -> None:
        self.vehicle = vehicle
        self._state = np.zeros(STATE, np.int64)
        self._state[TURNED] = -SILENCE
        self._links = np.zeros((LINKS, LINK), np.int64)
        self._links[:, [L_SEGMENT, L_SEQ]] = -1
        self._rhythm = np.zeros((LINKS, 3))
        self._table = np.zeros((KINDS, 4), np.int64)
        self._news = np.zeros((NEWS, 6), np.int64)

    @property
    def epoch(self) -> int:
        """Boot epoch of the last decided frame."""
        return int(self._state[EPOCH])

    def place(self, t_rx: int) -> int:
        """Newest vehicle time, ns; before any clock t_rx, ns."""
        state = self._state
        return int(state[CLOCK] + state[ANCHOR]) if state[KNOWN] else t_rx

    def feed(
        self,
        t_boot: Times,
        kind: NDArray[np.int32],
        t_rx: Times,
        seq: NDArray[np.uint8],
        modulus: Times,
        link: NDArray[np.uint8] | None = None,
        copy: NDArray[np.bool_] | None = None,
        unix: Times | None = None,
        *,
        now: int | None = None,
        flush: bool = False,
    ) -> Epochs:
        """Decide as many frames as can be decided.

        The results do not depend on how the frames are cut into calls, as long as the undecided tail of one call is the
        head of the next.

        Parameters
        ----------
        t_boot : int64 array, shape (k,)
            Time since boot as decoded, ns; `NO_TIME` for a frame that tells none.
        kind : int32 array, shape (k,)
            Message ids.
        t_rx : int64 array, shape (k,)
            Receive times, ns, in the order of arrival.
        seq : uint8 array, shape (k,)
            Sequence numbers.
        modulus : int64 array, shape (k,)
            Range of the counter behind t_boot, ns; 0 when it never wraps.
        link : uint8 array, shape (k,), optional
            Link numbers; all the same if not given.
        copy : bool array, shape (k,), optional
            The frame has been fed before, over another link or this one: it shows only how far this link is behind.
        unix : int64 array, shape (k,), optional
            UTC that the frame tells, ns; 0 where it tells none.
        now : int, optional
            Receive time that the whole stream has reached, ns: lets a wait end when this vehicle has fallen silent.
        flush : bool
            Decide everything: nothing more will come.
        """
        size = len(t_boot)
        out, flags = np.empty((4, size), np.int64), np.empty((3, size), np.bool_)
        columns = (
            _plain(t_boot, np.int64),
            _plain(kind, np.int32),
            _plain(t_rx, np.int64),
            _plain(seq, np.uint8),
            _plain(modulus, np.int64),
            np.zeros(size, np.uint8) if link is None else _plain(link, np.uint8),
            np.zeros(size, np.bool_) if copy is None else _plain(copy, np.bool_),
            np.zeros(size, np.int64) if unix is None else _plain(unix, np.int64),
        )
        reached = int(t_rx[-1]) if now is None and size else now or 0
        events: list[tuple[int, str]] = []
        state = self._state, self._links, self._rhythm, self._table
        decided, told = 0, NEWS
        while told == NEWS:  # the kernel stops when it has no room for more news
            decided, told = feed(*state, *columns, decided, reached, flush, out, flags, self._news)
            if told:
                events += [(row[0], self._text(*row[1:])) for row in self._news[:told].tolist()]
        if decided < size:
            out, flags = out[:, :decided], flags[:, :decided]
        epoch, segment, t, sigma = out
        timed, restarted, stale = flags
        return Epochs(decided, epoch, segment, t, sigma, timed, restarted, stale, events)

    def _text(self, verdict: int, kind: int, before: int, reading: int, silence: int) -> str:
        readings = f"{_seconds(before)} -> {_seconds(reading)} s"
        if verdict == RESTART:
            return f"vehicle {self.vehicle} rebooted: boot clock {readings}, {silence / SECOND:.0f} s of silence"
        if verdict == STEP:
            return f"vehicle {self.vehicle}: boot clock stepped back without a reboot: {readings}"
        if verdict == WRAP:
            return f"vehicle {self.vehicle}: the counter of message {kind} wrapped, the clock goes on: {readings}"
        return f"vehicle {self.vehicle}: message {kind} alone is behind the boot clock: {readings}"
