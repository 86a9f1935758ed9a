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

While a suspect waits for its witness the frames from it on are *undecided*: `BootClock.feed` says how many are decided
and remembers only those. The caller feeds the rest again, with what has come since.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from telemetry.messages import Counts, Times

NO_TIME = -1  # t_boot of a frame that tells no time

SECOND = 1_000_000_000
BACK = 1 * SECOND
AGREE = SECOND // 2  # a witness is back by at least this much
SLACK = 5 * SECOND
SILENCE = 10 * SECOND
HOLD_TIME, HOLD_FRAMES = 2 * SECOND, 512
SMALL_SEQ, SEQ_JUMP = 32, 32
SLOW = 1 << 51  # ns, 26 days: a counter with a range beyond this is taken at its word when first seen
KINDS = 64  # message types told apart; further ones are taken at their word

EPOCH, SEGMENT, ANCHOR, CLOCK, KNOWN, HEARD, SEQ, COUNT, STATE = range(9)
UNKNOWN, BY_FIX, BY_CLOCK = range(3)  # what CLOCK was read from
ID, LAG, TURNS, SAID = range(4)  # columns of the table of message types
WAIT, RESTART, STEP, WRAP, ALONE = range(5)  # verdicts
NEWS = 64  # events one call of the kernel can report


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
        timed frame. A frame without a time has that of the clock when it came, and before any clock its receive time.
    timed : bool array
        The frame tells the vehicle's clock (and not the time of a fix, an event or nothing).
    restarted : bool array
        First timed frame after a reboot.
    events : list of (int, str)
        Index of the frame, and what happened there.
    """

    decided: int
    epoch: Counts
    segment: Counts
    t: Times
    timed: NDArray[np.bool_]
    restarted: NDArray[np.bool_]
    events: list[tuple[int, str]]


@njit(cache=True, nogil=True)
def _is_fix(kind):  # type: ignore[no-untyped-def]
    return kind == 24 or kind == 124 or kind == 33


@njit(cache=True, nogil=True)
def _slot(a, table, kind):  # type: ignore[no-untyped-def]
    for k in range(a[COUNT]):
        if table[k, ID] == kind:
            return k
    return -1


@njit(cache=True, nogil=True)
def _unwrap(a, table, slot, raw, modulus):  # type: ignore[no-untyped-def]
    """The reading with the turns known so far; of a type never seen, with those that bring it nearest to the clock."""
    if modulus <= 0:
        return raw
    if slot >= 0:
        return raw + table[slot, TURNS] * modulus
    return raw + max(0, (a[CLOCK] - raw + modulus // 2) // modulus) * modulus


@njit(cache=True, nogil=True)
def _wraps(back, modulus, elapsed):  # type: ignore[no-untyped-def]
    """Whether a reading that is back by so much is explained by a wrap."""
    return modulus > 0 and 2 * back > modulus and modulus - back <= elapsed + SLACK


@njit(cache=True, nogil=True)
def _can_be_boot(a, raw, elapsed):  # type: ignore[no-untyped-def]
    return raw <= elapsed + SLACK or 2 * raw < a[CLOCK]


@njit(cache=True, nogil=True)
def _testifies(a, seq, elapsed):  # type: ignore[no-untyped-def]
    """Whether silence or the sequence number speak for a reboot."""
    return elapsed >= SILENCE or (seq < SMALL_SEQ and ((seq - a[SEQ]) & 255) >= SEQ_JUMP)


@njit(cache=True, nogil=True)
def _judge(a, table, i, reading, back, t_boot, kind, t_rx, seq, modulus, now, flush):  # type: ignore[no-untyped-def]
    """Verdict on frame i, whose reading is back by more than `BACK`."""
    elapsed = t_rx[i] - a[HEARD]
    falls = modulus[i] > 0 and 2 * back > modulus[i]
    suspect = -1  # the frame that bears the first witness
    first = reading
    if not _is_fix(kind[i]) and not _wraps(back, modulus[i], elapsed):
        suspect = i
        if _can_be_boot(a, t_boot[i], elapsed) and _testifies(a, np.int64(seq[i]), elapsed):
            return RESTART
    expired = flush or now - t_rx[i] > HOLD_TIME
    for j in range(i + 1, len(t_boot)):
        waited = t_rx[j] - t_rx[i]
        if waited > HOLD_TIME or j - i >= HOLD_FRAMES:
            expired = True
            break
        if t_boot[j] < 0 or _is_fix(kind[j]):
            continue
        slot = _slot(a, table, kind[j])
        if slot < 0 and 0 < modulus[j] < SLOW:
            continue  # its turns are a guess from the very clock that is in question
        other = _unwrap(a, table, slot, t_boot[j], modulus[j])
        if other >= a[CLOCK] - BACK:
            return WRAP if falls else ALONE
        behind = a[CLOCK] - (table[slot, LAG] if slot >= 0 else 0) - other
        if behind <= AGREE or _wraps(behind, modulus[j], elapsed + waited):
            continue
        if suspect < 0:
            if behind > BACK:
                suspect = j
                first = other
                if _can_be_boot(a, t_boot[j], elapsed + waited) and _testifies(a, np.int64(seq[j]), elapsed + waited):
                    return RESTART
        elif kind[j] != kind[suspect] and (
            abs(other - first) <= SLACK + waited or abs(t_boot[j] - t_boot[suspect]) <= SLACK + waited
        ):
            return RESTART if _can_be_boot(a, t_boot[suspect], elapsed + t_rx[suspect] - t_rx[i]) else STEP
    if not expired:
        return WAIT
    if falls:
        return WRAP
    return ALONE if _is_fix(kind[i]) else STEP


@njit(cache=True, nogil=True)
def _first_turns(i, t_boot, t_rx, modulus, now, flush):  # type: ignore[no-untyped-def]
    """Turns of the counter that opens the recording, by the first clock that does not wrap so soon; -1: wait."""
    for j in range(i + 1, len(t_boot)):
        if t_rx[j] - t_rx[i] > HOLD_TIME or j - i >= HOLD_FRAMES:
            return 0
        if t_boot[j] >= 0 and (modulus[j] <= 0 or modulus[j] >= SLOW):
            return max(0, (t_boot[j] - t_boot[i] + modulus[i] // 2) // modulus[i])
    return 0 if flush or now - t_rx[i] > HOLD_TIME else -1


@njit(cache=True, nogil=True)
def _feed(a, table, t_boot, kind, t_rx, seq, modulus, begin, now, flush, out, flags, news):  # type: ignore[no-untyped-def]
    """Decide frames from `begin` on: fill out (k, 3: epoch, segment, t), flags (k, 2: timed, restarted) and news
    (e, 6: index, verdict, kind, clock before, reading, silence); return (how many are decided, e).
    """
    told = 0
    for i in range(begin, len(t_boot)):
        raw = t_boot[i]
        flags[i, 0] = flags[i, 1] = False
        if raw < 0:
            out[i, 0], out[i, 1] = a[EPOCH], a[SEGMENT]
            out[i, 2] = a[CLOCK] + a[ANCHOR] if a[KNOWN] else t_rx[i]
            continue
        if told == len(news):
            return i, told
        fix = _is_fix(kind[i])
        elapsed = t_rx[i] - a[HEARD]
        slot = _slot(a, table, kind[i])
        if a[KNOWN]:
            reading = _unwrap(a, table, slot, raw, modulus[i])
        else:
            turns = 0
            if 0 < modulus[i] < SLOW:
                turns = _first_turns(i, t_boot, t_rx, modulus, now, flush)
                if turns < 0:
                    return i, told
            reading = raw + turns * modulus[i]
            a[CLOCK] = reading
            a[ANCHOR] = t_rx[i] - reading
            a[HEARD] = t_rx[i]
        back = a[CLOCK] - (table[slot, LAG] if slot >= 0 else 0) - reading
        tells = not fix
        if back > BACK:
            verdict = _judge(a, table, i, reading, back, t_boot, kind, t_rx, seq, modulus, now, flush)
            if verdict == WAIT:
                return i, told
            tells = tells and verdict != ALONE
            if verdict == RESTART:
                reading = raw
            if verdict in (RESTART, STEP) or (verdict == ALONE and not fix and slot >= 0 and table[slot, SAID] == 0):
                news[told, 0], news[told, 1], news[told, 2] = i, verdict, kind[i]
                news[told, 3], news[told, 4], news[told, 5] = a[CLOCK], reading, elapsed
                told += 1
            if verdict == RESTART:
                a[EPOCH] += 1
                a[SEGMENT] += 1
                a[ANCHOR] = t_rx[i] - raw
                a[COUNT] = 0
                a[KNOWN] = UNKNOWN
                slot = -1
                flags[i, 1] = True
            elif verdict == STEP:
                a[SEGMENT] += 1
                a[CLOCK] -= back
            elif verdict == WRAP:
                reading += modulus[i]
            elif slot >= 0 and not fix:
                table[slot, SAID] = 1
        if a[KNOWN] == UNKNOWN or (not fix and a[KNOWN] == BY_FIX and back <= BACK):
            a[CLOCK] = reading
            a[KNOWN] = BY_FIX if fix else BY_CLOCK
        elif not fix or a[KNOWN] == BY_FIX:
            a[CLOCK] = max(a[CLOCK], reading)
        if not fix or a[KNOWN] == BY_FIX:
            a[HEARD] = t_rx[i]
            a[SEQ] = seq[i]
        if slot < 0 and a[COUNT] < KINDS:
            slot = a[COUNT]
            a[COUNT] += 1
            table[slot, ID] = kind[i]
            table[slot, SAID] = 0
        if slot >= 0:
            table[slot, LAG] = a[CLOCK] - reading
            table[slot, TURNS] = (reading - raw) // modulus[i] if modulus[i] > 0 else 0
        out[i, 0], out[i, 1], out[i, 2] = a[EPOCH], a[SEGMENT], reading + a[ANCHOR]
        flags[i, 0] = tells
    return len(t_boot), told


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
        self._table = np.zeros((KINDS, 4), np.int64)
        self._news = np.zeros((NEWS, 6), np.int64)

    @property
    def epoch(self) -> int:
        """Boot epoch of the last decided frame."""
        return int(self._state[EPOCH])

    def place(self, t_rx: int) -> int:
        """Vehicle time for what happened here at t_rx (ns): the clock as last heard, or t_rx before any clock."""
        state = self._state
        return int(state[CLOCK] + state[ANCHOR]) if state[KNOWN] else t_rx

    def feed(
        self,
        t_boot: Times,
        kind: NDArray[np.int32],
        t_rx: Times,
        seq: NDArray[np.uint8],
        modulus: Times,
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
        now : int, optional
            Receive time that the whole stream has reached, ns: lets a wait end when this vehicle has fallen silent.
        flush : bool
            Decide everything: nothing more will come.
        """
        size = len(t_boot)
        out, flags = np.empty((size, 3), np.int64), np.empty((size, 2), np.bool_)
        columns = (
            _plain(t_boot, np.int64),
            _plain(kind, np.int32),
            _plain(t_rx, np.int64),
            _plain(seq, np.uint8),
            _plain(modulus, np.int64),
        )
        reached = int(t_rx[-1]) if now is None and size else now or 0
        events: list[tuple[int, str]] = []
        decided, told = 0, NEWS
        while told == NEWS:  # the kernel stops when it has no room for more news
            decided, told = _feed(self._state, self._table, *columns, decided, reached, flush, out, flags, self._news)
            events += [(row[0], self._text(*row[1:])) for row in self._news[:told].tolist()]
        epoch, segment, t = np.ascontiguousarray(out[:decided].T)
        timed, restarted = np.ascontiguousarray(flags[:decided].T)
        return Epochs(decided, epoch, segment, t, timed, restarted, events)

    def _text(self, verdict: int, kind: int, before: int, reading: int, silence: int) -> str:
        readings = f"{_seconds(before)} -> {_seconds(reading)} s"
        if verdict == RESTART:
            return f"vehicle {self.vehicle} rebooted: boot clock {readings}, {silence / SECOND:.0f} s of silence"
        if verdict == STEP:
            return f"vehicle {self.vehicle}: boot clock stepped back without a reboot: {readings}"
        return f"vehicle {self.vehicle}: message {kind} alone is behind the boot clock: {readings}"
