"""What a vehicle's clock is worth: straight lines from vehicle time to UTC, with their quality.

``arrival``
    A frame arrives after it was sent, by a delay that is never negative: the points (t, t_rx - t) lie on or above the
    line sought. A least-squares line is biased by the mean delay; the line that supports the *lower convex hull* at the
    middle of the span is not. The least delay itself cannot be seen one-way: this UTC is late by it.
``system_time``
    The vehicle's own UTC, from messages that pair it with the boot clock: errors on both sides, and jumps. A line by
    least squares over what lies within four robust standard deviations of a line by medians.

Both look back over one hour and are renewed every 10 s of receive time, at instants counted from the first frame of the
boot epoch, so that a fit depends on the frames and not on how they were cut into batches.

Memory is bounded. Vehicle time is divided into chunks of 10 s; each keeps its own lower hull (for the line and the
scatter of its minima), its upper hull (for the greatest delay) and every 2^k-th point (for the quantiles). The hull of
an hour is the hull of the hulls of its chunks, so what falls out of the hour takes nothing with it.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
from numba import njit

from telemetry.clock import Epochs
from telemetry.messages import ClockFit, Event, Floats, Times, event

SECOND = 1_000_000_000
REFIT = 10 * SECOND
CHUNK = 10 * SECOND
HOUR = 361  # chunks looked back over
RING = 364
VERTICES = 24  # of the hull of a chunk; beyond that, the one that bends it least is dropped
SAMPLE = 16  # points of a chunk kept for the quantiles
PAIR = 4 * SECOND  # one pair of (t, UTC) is kept per so much vehicle time
PAIRS = 902
MIN_SPAN = 60.0  # s
MAX_RATE = 0.01
RESOLUTION = 1000.0  # ns, of receive times in common logs: no scatter is taken as smaller
MOVE = 0.010  # s: a refit that moves time by more is news
STEPPED = 1.0  # s: when all of the last 30 s came later than the line says by more, the receive clock has stepped

# One int64 vector holds the state.
# fmt: off
(BEGUN, ORIGIN, BASE, LAST, FRESH,                    # the segment: first t and t_rx - t, newest t, points since a fit
 STARTED, START, START_RX, DUE, LAST_RX,              # the epoch: first t and t_rx, receive time of the next fit
 UTC_BASE, UTC_COUNT, UTC_LAST, STATE) = range(14)
# fmt: on
ARRIVAL, SYSTEM_TIME = range(2)
REFERENCES = ("arrival", "system_time")
OFFSET, OFFSET_SIGMA, RATE, RATE_SIGMA, P50, P99, MAX, SPAN, VALID, MOVED, LATER, COLUMNS = range(12)
FIELDS = ("offset", "offset_sigma", "rate", "rate_sigma", "delay_p50", "delay_p99", "delay_max", "span")
LOWER, UPPER, KEPT, STRIDE, SEEN, SIZES = range(6)  # what a chunk holds


@njit(cache=True, nogil=True)
def _above(points, a, b, t, c):  # type: ignore[no-untyped-def]
    """Whether (t, c) lies on or above the line from vertex a to vertex b."""
    width, rise = points[b, 0] - points[a, 0], points[b, 1] - points[a, 1]
    return (c - points[a, 1]) * width >= rise * (t - points[a, 0])


@njit(cache=True, nogil=True)
def _remove(points, n, k):  # type: ignore[no-untyped-def]
    for m in range(k, n - 1):
        points[m, 0], points[m, 1] = points[m + 1, 0], points[m + 1, 1]
    return n - 1


@njit(cache=True, nogil=True)
def _insert(points, n, t, c):  # type: ignore[no-untyped-def]
    """Insert (t, c) into the lower hull points[:n], ordered by t; return its new size."""
    p = n
    while p > 0 and points[p - 1, 0] >= t:
        p -= 1
    if p < n and points[p, 0] == t:
        if c >= points[p, 1]:
            return n
        n = _remove(points, n, p)
    if 0 < p < n and _above(points, p - 1, p, t, c):
        return n
    for m in range(n, p, -1):
        points[m, 0], points[m, 1] = points[m - 1, 0], points[m - 1, 1]
    points[p, 0], points[p, 1] = t, c
    n += 1
    while p + 2 < n and _above(points, p, p + 2, points[p + 1, 0], points[p + 1, 1]):
        n = _remove(points, n, p + 1)
    while p >= 2 and _above(points, p - 2, p, points[p - 1, 0], points[p - 1, 1]):
        n = _remove(points, n, p - 1)
        p -= 1
    if n > VERTICES:
        least, flattest = np.inf, 1
        for m in range(1, n - 1):
            slope = (points[m + 1, 1] - points[m - 1, 1]) / (points[m + 1, 0] - points[m - 1, 0])
            bend = points[m - 1, 1] + slope * (points[m, 0] - points[m - 1, 0]) - points[m, 1]
            if bend < least:
                least, flattest = bend, m
        n = _remove(points, n, flattest)
    return n


@njit(cache=True, nogil=True)
def _fit_arrival(a, chunks, sizes, lower, upper, sample, work, values, fit):  # type: ignore[no-untyped-def]
    """The line that supports the lower hull of the last hour at the middle of its span, in ns from (ORIGIN, BASE).

    The least delays of the chunks scatter about the line; with independent delays this scatter falls with the number of
    points per chunk, and the line errs with it: its rate by 5 rms(scatter) / (number of chunks x span), a factor found
    by simulation with exponential delays. Bursts and stalls widen the scatter, and the stated error with it.
    """
    now = (a[LAST] - a[ORIGIN]) // CHUNK
    n = 0
    first, last = np.inf, -np.inf
    points, filled = 0, 0
    for chunk in range(max(now - HOUR + 1, 0), now + 1):
        k = chunk % RING
        if chunks[k] != chunk:
            continue
        points += sizes[k, SEEN]
        filled += 1
        for m in range(sizes[k, LOWER]):
            t, c = lower[k, m, 0], lower[k, m, 1]
            first, last = min(first, t), max(last, t)
            work[n, 0], work[n, 1] = t, c
            while n >= 2 and _above(work, n - 2, n, work[n - 1, 0], work[n - 1, 1]):
                n = _remove(work, n + 1, n - 1) - 1
            n += 1
    middle = 0.5 * (first + last)
    edge = 0
    while edge < n - 2 and work[edge + 1, 0] < middle:
        edge += 1
    rate, t0, c0 = 0.0, work[edge, 0], work[edge, 1]
    if n >= 2:
        rate = (work[edge + 1, 1] - c0) / (work[edge + 1, 0] - t0)
    minima, used, greatest, kept = 0.0, 0, 0.0, 0
    last3 = last2 = last1 = 0.0  # least delays of the last three chunks
    for chunk in range(max(now - HOUR + 1, 0), now + 1):
        k = chunk % RING
        if chunks[k] != chunk:
            continue
        least = np.inf
        for m in range(sizes[k, LOWER]):
            least = min(least, lower[k, m, 1] - c0 - rate * (lower[k, m, 0] - t0))
        for m in range(sizes[k, UPPER]):
            greatest = max(greatest, -upper[k, m, 1] - c0 - rate * (upper[k, m, 0] - t0))
        for m in range(sizes[k, KEPT]):
            values[kept] = sample[k, m, 1] - c0 - rate * (sample[k, m, 0] - t0)
            kept += 1
        if 2 * sizes[k, SEEN] * filled >= points:  # the last chunk, just begun, has no least delay yet
            minima += least**2
            used += 1
            last3, last2, last1 = last2, last1, least
    values[:kept].sort()
    begin = a[START] - a[ORIGIN]
    span = last - first
    fit[OFFSET] = (a[BASE] + (c0 + rate * (begin - t0))) * 1e-9
    fit[RATE] = rate
    fit[OFFSET_SIGMA] = fit[RATE_SIGMA] = np.nan
    if used > 3 and span > 0:
        scatter = max(np.sqrt(minima / (used - 2)), RESOLUTION)  # two of the minima lie on the line
        sigma = 5.0 * scatter / (used * span)
        fit[RATE_SIGMA] = sigma
        fit[OFFSET_SIGMA] = np.hypot(2.0 * scatter / used, sigma * (middle - begin)) * 1e-9
    fit[P50] = values[kept // 2] * 1e-9
    fit[P99] = values[(kept * 99) // 100] * 1e-9
    fit[MAX] = greatest * 1e-9
    fit[LATER] = min(last3, last2, last1) * 1e-9 if used > 5 else 0.0
    fit[SPAN] = span * 1e-9


@njit(cache=True, nogil=True)
def _fit_system_time(a, pairs, work, values, fit):  # type: ignore[no-untyped-def]
    """A robust line through (t, UTC - t), in ns from (ORIGIN, UTC_BASE)."""
    n = 0
    for m in range(max(a[UTC_COUNT] - PAIRS, 0), a[UTC_COUNT]):
        if pairs[m % PAIRS, 0] > a[LAST] - a[ORIGIN] - HOUR * CHUNK:
            work[n, 0], work[n, 1] = pairs[m % PAIRS, 0], pairs[m % PAIRS, 1]
            n += 1
    if n < 4:
        return False
    half = n // 2
    for m in range(n - half):
        values[m] = (work[m + half, 1] - work[m, 1]) / (work[m + half, 0] - work[m, 0])
    values[: n - half].sort()
    rate = values[(n - half) // 2]
    for m in range(n):
        values[m] = work[m, 1] - rate * work[m, 0]
    values[:n].sort()
    level = values[half]
    for m in range(n):
        values[m] = abs(work[m, 1] - rate * work[m, 0] - level)
    values[:n].sort()
    bound = 4 * max(1.4826 * values[half], RESOLUTION)
    centre, used, variance, sxx = 0.0, 0, 0.0, 0.0
    for _ in range(3):
        used = 0
        centre = mean = sxx = sxy = 0.0
        for m in range(n):
            if abs(work[m, 1] - rate * work[m, 0] - level) <= bound:
                used += 1
                centre += work[m, 0]
                mean += work[m, 1]
        centre, mean = centre / used, mean / used
        for m in range(n):
            if abs(work[m, 1] - rate * work[m, 0] - level) <= bound:
                sxx += (work[m, 0] - centre) ** 2
                sxy += (work[m, 0] - centre) * (work[m, 1] - mean)
        if sxx <= 0 or used < 3:
            return False
        rate = sxy / sxx
        level = mean - rate * centre
    variance = 0.0
    for m in range(n):
        if abs(work[m, 1] - rate * work[m, 0] - level) <= bound:
            variance += (work[m, 1] - rate * work[m, 0] - level) ** 2
    variance = max(variance / (used - 2), RESOLUTION**2)
    begin = a[START] - a[ORIGIN]
    fit[OFFSET] = (a[UTC_BASE] + (level + rate * begin)) * 1e-9
    fit[OFFSET_SIGMA] = np.sqrt(variance * (1 / used + (centre - begin) ** 2 / sxx)) * 1e-9
    fit[RATE] = rate
    fit[RATE_SIGMA] = np.sqrt(variance / sxx)
    fit[P50] = fit[P99] = fit[MAX] = np.nan
    fit[LATER] = 0.0
    fit[SPAN] = (work[n - 1, 0] - work[0, 0]) * 1e-9
    return True


@njit(cache=True, nogil=True)
def _emit(a, chunks, sizes, lower, upper, sample, pairs, work, values, before, t_rx, times, fits, k):  # type: ignore[no-untyped-def]
    """Write the fits as they are now, said at t_rx, from row k on."""
    for reference in range(2):
        fit = fits[k]
        if reference == ARRIVAL:
            _fit_arrival(a, chunks, sizes, lower, upper, sample, work, values, fit)
        elif not _fit_system_time(a, pairs, work, values, fit):
            continue
        valid = fit[SPAN] >= MIN_SPAN and abs(fit[RATE]) <= MAX_RATE
        fit[VALID] = 1.0 if valid else 0.0
        age = (a[LAST] - a[START]) * 1e-9
        was = before[reference, 0] + before[reference, 1] * age
        fit[MOVED] = fit[OFFSET] + fit[RATE] * age - was if valid and before[reference, 2] > 0 else 0.0
        before[reference, 0], before[reference, 1], before[reference, 2] = fit[OFFSET], fit[RATE], fit[VALID]
        if fit[LATER] > STEPPED:  # what came before tells nothing of what will come
            chunks[:] = -1
            before[ARRIVAL, 2] = 0.0
        times[k, 0], times[k, 1], times[k, 2] = a[LAST], t_rx, reference
        k += 1
    a[FRESH] = 0
    return k


@njit(cache=True, nogil=True)
def _feed(a, chunks, sizes, lower, upper, sample, pairs, work, values, before, t, t_rx, timed, unix, times, fits):  # type: ignore[no-untyped-def]
    """Take points; the fits due on the way go to times (r, 3: t, t_rx, reference) and fits (r, COLUMNS): how many."""
    k = 0
    for i in range(len(t)):
        if not timed[i]:
            continue
        if a[STARTED] == 0:
            a[STARTED] = 1
            a[START], a[START_RX], a[DUE] = t[i], t_rx[i], t_rx[i] + REFIT
        if a[BEGUN] == 0:
            a[BEGUN] = 1
            a[ORIGIN], a[BASE], a[LAST] = t[i], t_rx[i] - t[i], t[i]
            chunks[:] = -1
            a[UTC_COUNT] = 0
            before[:, 2] = 0.0
        if t_rx[i] >= a[DUE]:
            if a[FRESH] > 0:
                k = _emit(a, chunks, sizes, lower, upper, sample, pairs, work, values, before, a[DUE], times, fits, k)
            a[DUE] = a[START_RX] + ((t_rx[i] - a[START_RX]) // REFIT + 1) * REFIT
        a[LAST] = max(a[LAST], t[i])
        a[LAST_RX] = t_rx[i]
        x, c = float(t[i] - a[ORIGIN]), float(t_rx[i] - t[i] - a[BASE])
        chunk = max((t[i] - a[ORIGIN]) // CHUNK, 0)
        slot = chunk % RING
        if chunks[slot] < chunk:
            chunks[slot] = chunk
            sizes[slot, :] = 0
            sizes[slot, STRIDE] = 1
        if chunks[slot] == chunk:
            a[FRESH] += 1
            size = sizes[slot]
            size[LOWER] = _insert(lower[slot], size[LOWER], x, c)
            size[UPPER] = _insert(upper[slot], size[UPPER], x, -c)
            if size[SEEN] % size[STRIDE] == 0:
                if size[KEPT] == SAMPLE:  # full: keep every second one, from now on too
                    for m in range(SAMPLE // 2):
                        sample[slot, m, 0], sample[slot, m, 1] = sample[slot, 2 * m, 0], sample[slot, 2 * m, 1]
                    size[KEPT] = SAMPLE // 2
                    size[STRIDE] *= 2
                if size[SEEN] % size[STRIDE] == 0:
                    sample[slot, size[KEPT], 0], sample[slot, size[KEPT], 1] = x, c
                    size[KEPT] += 1
            size[SEEN] += 1
        if unix[i] > 0:
            if a[UTC_COUNT] == 0:
                a[UTC_BASE] = unix[i] - t[i]
                a[UTC_LAST] = t[i] - PAIR
            if t[i] >= a[UTC_LAST] + PAIR:
                pair = pairs[a[UTC_COUNT] % PAIRS]
                pair[0], pair[1] = x, float(unix[i] - t[i] - a[UTC_BASE])
                a[UTC_COUNT] += 1
                a[UTC_LAST] = t[i]
    return k


class ClockFitter:
    """Fits of one vehicle's clock; they begin anew with every boot epoch, and with every step of the clock.

    Parameters
    ----------
    vehicle : int
        MAVLink system id.
    source : str
        Source named in the messages.
    """

    def __init__(self, vehicle: int, source: str = "clock") -> None:
        self.vehicle, self.source = vehicle, source
        self._epoch = self._segment = -1
        self._state = np.zeros(STATE, np.int64)
        self._memory = (
            np.full(RING, -1, np.int64),
            np.zeros((RING, SIZES), np.int64),
            np.empty((RING, VERTICES + 1, 2)),
            np.empty((RING, VERTICES + 1, 2)),
            np.empty((RING, SAMPLE, 2)),
            np.empty((PAIRS, 2)),
            np.empty((RING * VERTICES + 1, 2)),
            np.empty(RING * SAMPLE + 1),
            np.zeros((2, 3)),
        )
        self._due: list[tuple[int, Times, Floats]] = []
        self._told = -1  # the boot epoch that `_valid` is about
        self._valid = [0, 0]  # whether each fit was valid when last told

    def feed(self, epochs: Epochs, t_rx: Times, unix: Times) -> None:
        """Take the decided frames of a batch.

        Parameters
        ----------
        epochs : Epochs
            What `BootClock.feed` said; k frames are decided.
        t_rx : int64 array, shape (k,)
            Their receive times, ns.
        unix : int64 array, shape (k,)
            Their own UTC, ns, from messages that pair it with the boot clock (SYSTEM_TIME); 0 for other frames, and
            before the vehicle knows UTC.
        """
        if epochs.decided == 0:
            return
        segment = epochs.segment
        if segment[0] == segment[-1]:
            self._take(epochs, t_rx, unix, 0, len(segment))
            return
        cuts = [0, *(np.flatnonzero(np.diff(segment)) + 1).tolist(), len(segment)]
        for begin, end in pairwise(cuts):
            self._take(epochs, t_rx, unix, begin, end)

    def finish(self) -> None:
        """Say what the points since the last fit have changed: nothing more will come."""
        if self._state[FRESH]:
            times, fits = np.empty((2, 3), np.int64), np.empty((2, COLUMNS))
            k = _emit(self._state, *self._memory, int(self._state[LAST_RX]), times, fits, 0)
            self._due.append((self._epoch, times[:k], fits[:k]))

    def drain(self) -> list[ClockFit | Event]:
        """Say what is due: the fits; and as events what changes about them, at most once per refit.

        A fit becomes valid, or is so no longer; UTC is told by the vehicle itself from now on; a refit moves time by
        more than 10 ms; the receive clock has stepped forward, and the fit to it begins anew.
        """
        said: list[ClockFit | Event] = []
        for epoch, times, fits in self._due:
            t, t_rx, reference = np.ascontiguousarray(times.T)
            columns = np.ascontiguousarray(fits.T)
            said.append(
                ClockFit(
                    vehicle=self.vehicle,
                    source=self.source,
                    boot=epoch,
                    t=t,
                    t_rx=t_rx,
                    reference=[REFERENCES[r] for r in reference.tolist()],
                    **dict(zip(FIELDS, columns[:VALID], strict=True)),
                    valid=columns[VALID].astype(np.int64),
                )
            )
            for k in range(len(t)):
                for text in self._news(epoch, int(reference[k]), fits[k]):
                    about: dict[str, Any] = {"vehicle": self.vehicle, "source": self.source, "boot": epoch}
                    said.append(event(f"vehicle {self.vehicle}: {text}", **about, t=int(t[k]), t_rx=int(t_rx[k])))
        self._due = []
        return said

    def _news(self, epoch: int, reference: int, fit: Floats) -> list[str]:
        """What a fit changes."""
        if epoch != self._told:
            self._told, self._valid = epoch, [0, 0]
        name, valid, was = REFERENCES[reference], int(fit[VALID]), self._valid[reference]
        self._valid[reference] = valid
        news = []
        if fit[LATER] > STEPPED:
            news.append(
                f"the receive clock stepped forward by {fit[LATER]:.1f} s, or the vehicle's stood still: "
                "the clock fit to arrival begins anew"
            )
        if valid and not was:
            news.append(f"the clock fit to {name} is valid: rate {fit[RATE] * 1e6:+.1f} ppm")
            if reference == SYSTEM_TIME:
                news.append("UTC comes from system_time from now on, no longer from arrival")
        elif was and not valid:
            why = f"rate {fit[RATE] * 1e6:+.0f} ppm" if abs(fit[RATE]) > MAX_RATE else f"{fit[SPAN]:.0f} s of data"
            news.append(f"the clock fit to {name} is no longer valid: {why}")
        if abs(fit[MOVED]) > MOVE:
            news.append(f"the clock fit to {name} moved time by {fit[MOVED] * 1e3:+.0f} ms")
        return news

    def _take(self, epochs: Epochs, t_rx: Times, unix: Times, begin: int, end: int) -> None:
        state = self._state
        if epochs.segment[begin] != self._segment:
            self.finish()
            self._segment = int(epochs.segment[begin])
            state[BEGUN] = 0
            if epochs.epoch[begin] != self._epoch:
                self._epoch = int(epochs.epoch[begin])
                state[STARTED] = 0
        t, arrival = epochs.t[begin:end], np.ascontiguousarray(t_rx[begin:end], np.int64)
        due = (
            2 * min(end - begin, int(arrival.max() - state[DUE]) // REFIT + 2) if state[STARTED] else 2 * (end - begin)
        )
        times, fits = np.empty((max(due, 2), 3), np.int64), np.empty((max(due, 2), COLUMNS))
        utc = np.array(unix[begin:end], np.int64)
        k = _feed(state, *self._memory, t, arrival, epochs.timed[begin:end], utc, times, fits)
        if k:
            self._due.append((self._epoch, times[:k], fits[:k]))
