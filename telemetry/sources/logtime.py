"""Time in an on-board log: boots, leaps, and what the boot clock is in UTC.

A log is written by one processor in nearly the order of its clock. `judge` goes through it in the order of the file: a
time more than a second behind the newest is a new boot, and a time far ahead is a pause in the log, if the messages
that follow confirm it; otherwise the time is damaged and its message is left out. What `judge` says of a message
depends on the messages and not on how the file was cut into blocks.

UTC comes from the satellite receiver. GPS time has no leap seconds and has been ahead of UTC by 18 s since 2017; a
fix of an older log comes out up to 3 s early. A fix is dated when it was logged, later than it was made by what the
receiver needs: neither the offset nor the fit can see that.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numba import njit

from telemetry.messages import ClockFit, Floats, Times

S = 1_000_000_000
NEVER = np.iinfo(np.int64).min
LATEST = 4_000_000_000 * S  # no clock shows more
AHEAD = 10 * S  # a leap further than this is to be confirmed; so near must the times be that confirm it
BACK = 1 * S
LATE = 60 * S  # a time so far behind that nobody confirms is that of a late message
WITNESSES = 4

GPS_EPOCH = 315_964_800  # Unix time of 1980-01-06, s
WEEK = 604_800
LEAP_SECONDS = 18
WEEKS = 1560, 4000  # GPS weeks of end 2009 and 2056: the receiver does not know another
UTC = 1_262_304_000 * S, 2_713_910_400 * S  # 2010 and 2056
PAIR = 4 * S  # a pair of (t, UTC) is kept per so much boot time
MIN_SPAN, MAX_RATE = 60.0, 0.01
RESOLUTION = 1e-6  # s: no scatter is taken as smaller

NEWEST, BOOT, STATE = range(3)


@njit(cache=True, nogil=True)
def judge(t, timed, final, state, boot, newest, good):  # type: ignore[no-untyped-def]
    """Place messages in the order of the file: how many could be placed before more must be seen.

    Parameters
    ----------
    t : int64 array, shape (k,)
        Time since boot, ns.
    timed : bool array, shape (k,)
        Which messages tell a time; the others get that of the newest before them, `NEVER` if there is none.
    final : bool
        Nothing follows.
    state : int64 array, shape (2,)
        Newest time and boot so far; begins with (`NEVER`, 0).
    boot, newest : int64 array, shape (k,)
        Boot of each message, and newest time of that boot up to and with it.
    good : bool array, shape (k,)
        False where the time is damaged.
    """
    n = len(t)
    for i in range(n):
        now = state[NEWEST]
        good[i] = True
        if timed[i]:
            x = t[i]
            impossible = x < 0 or x > LATEST
            first = now == NEVER
            ahead = not first and x > now + AHEAD
            back = not first and x < now - BACK
            if impossible:
                good[i] = False
            elif first or ahead or back:
                seen = near = 0
                j = i + 1
                while j < n and seen < WITNESSES:
                    if timed[j]:
                        seen += 1
                        elsewhere = first or (ahead and t[j] > now + BACK) or (back and t[j] < now - BACK)
                        if elsewhere and abs(t[j] - x) <= AHEAD:
                            near += 1
                    j += 1
                if seen < WITNESSES and not final:
                    return i
                if (seen == 0 and first) or (near > 0 and near >= seen - 1):
                    state[BOOT] += back
                    state[NEWEST] = x
                elif not back or x < now - LATE:
                    good[i] = False
            else:
                state[NEWEST] = max(now, x)
        boot[i], newest[i] = state[BOOT], state[NEWEST]
    return n


def gps_to_unix(week: Floats, ms: Floats) -> Times:
    """Unix time, ns, of GPS week and milliseconds of the week; 0 where the receiver does not know the week."""
    known = (week >= WEEKS[0]) & (week <= WEEKS[1]) & (ms >= 0) & (ms < WEEK * 1000)
    whole, part = (np.where(known, x, 0).astype(np.int64) for x in (week, ms))
    return np.where(known, (GPS_EPOCH + WEEK * whole - LEAP_SECONDS) * S + part * 1_000_000, 0)


@dataclass
class Boot:
    """One boot of the vehicle in a log.

    Attributes
    ----------
    number : int
    begin, end : int
        First and last time since boot in the log, ns.
    t, utc : list of int
        Pairs of time since boot and Unix time, ns, one in `PAIR`.
    offset : int
        Unix time at boot, ns: what is added to every time.
    how : str
        Where that comes from, in words.
    """

    number: int
    begin: int
    end: int
    t: list[int] = field(default_factory=list)
    utc: list[int] = field(default_factory=list)
    offset: int = 0
    how: str = ""

    def pair(self, t: Times, utc: Times) -> None:
        """Take fixes in: time since boot, and Unix time or 0, ns."""
        known = np.flatnonzero((utc > UTC[0]) & (utc < UTC[1]))
        while len(known):
            if self.t:
                known = known[t[known] >= self.t[-1] + PAIR]
                if not len(known):
                    break
            self.t.append(int(t[known[0]]))
            self.utc.append(int(utc[known[0]]))
            known = known[1:]


def place(boots: list[Boot], modified: int) -> None:
    """Find the Unix time of each boot, so that no boot begins before the one before it has ended.

    Parameters
    ----------
    boots : list of Boot
        In the order of the file; `offset` and `how` are set.
    modified : int
        When the file was modified, Unix time, ns; 0 if that is not known.
    """
    for boot in boots:
        if boot.t:
            boot.offset, boot.how = boot.utc[0] - boot.t[0], "the first satellite fix that knows the date"
    known = [i for i, boot in enumerate(boots) if boot.t]
    for i in range(len(boots) - 1, -1, -1):
        boot = boots[i]
        if boot.t or (known and i > known[0]):
            continue
        if i + 1 < len(boots):
            boot.how = f"boot {i + 1}, which it is put 1 s before: no fix knew the date"
            boot.offset = boots[i + 1].offset + boots[i + 1].begin - S - boot.end
        elif UTC[0] < modified < UTC[1]:
            boot.how = "the time of the file, taken for that of its last message: no fix knew the date"
            boot.offset = modified - boot.end
        else:
            boot.how = "nothing: neither a fix nor the file knows the date, and time counts from boot"
    for before, boot in pairwise(boots):
        over = before.offset + before.end + S
        if not boot.t and not boot.how:
            boot.offset, boot.how = (
                over - boot.begin,
                f"boot {before.number}, which it is put 1 s behind: no fix knew it",
            )
        elif boot.offset + boot.begin < over:
            boot.how = f"boot {before.number}, which it is put 1 s behind: its own fixes say that it was before"
            boot.offset = over - boot.begin


def clock_fit(boot: Boot, vehicle: int, source: str) -> ClockFit | None:
    """What the clock of a boot is worth beside that of the satellites; None with fewer than four fixes.

    A straight line by least squares over what lies within four robust standard deviations of a line by medians.
    """
    if len(boot.t) < 4:
        return None
    t, utc = np.array(boot.t, np.int64), np.array(boot.utc, np.int64)
    x = (t - boot.begin) * 1e-9
    base = int(utc[0] - t[0])
    y = (utc - t - base) * 1e-9
    half = len(x) // 2
    rate = float(np.median((y[half:] - y[: len(y) - half]) / (x[half:] - x[: len(x) - half])))
    level = float(np.median(y - rate * x))
    scatter = 1.4826 * float(np.median(np.abs(y - rate * x - level)))
    near = np.abs(y - rate * x - level) <= 4 * max(scatter, RESOLUTION)
    x, y = x[near], y[near]
    centre = float(x.mean())
    sxx = float(np.square(x - centre).sum())
    if len(x) < 3 or sxx <= 0:
        return None
    rate = float(((x - centre) * (y - y.mean())).sum() / sxx)
    level = float(y.mean() - rate * centre)
    variance = max(float(np.square(y - rate * x - level).sum()) / (len(x) - 2), RESOLUTION**2)
    span = float(x[-1] - x[0])
    now = np.array([boot.end + boot.offset], np.int64)
    nothing = np.array([np.nan])
    return ClockFit(
        vehicle=vehicle,
        source=source,
        boot=boot.number,
        t=now,
        t_rx=now,
        reference=["gnss"],
        offset=np.array([(base - boot.offset) * 1e-9 + level]),
        offset_sigma=np.array([np.sqrt(variance * (1 / len(x) + centre**2 / sxx))]),
        rate=np.array([rate]),
        rate_sigma=np.array([np.sqrt(variance / sxx)]),
        delay_p50=nothing,
        delay_p99=nothing,
        delay_max=nothing,
        span=np.array([span]),
        valid=np.array([int(span >= MIN_SPAN and abs(rate) <= MAX_RATE)], np.int64),
    )
