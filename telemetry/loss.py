"""The fate of sequence numbers: the compiled rules behind the loss account of one sender on one link.

MAVLink senders number their frames 0..255 per (system, component). The rules unwrap these numbers and give each of them
exactly one fate, so that at any moment::

    numbers spanned = received + (lost - late) + open + held

``open`` holes are at most 1 s old and at most 64 numbers behind the highest, so they may still be filled. ``held``
numbers lie in a jump after a long silence, where three stories look alike: numbers were lost, the sender stood still,
or it began again at zero. What follows the silence tells which:

- the sender is known to have begun again: the jump was none, its numbers are dropped;
- its boot clock goes on (``continued``): decided 5 s after the jump. By then a radio that had stalled has emptied its
  buffer, so the rate before the silence (or after it, if less) tells how many numbers are missing *in all*, and from
  that how many turns of the 8-bit counter: ``turns = round((expected - counted) / 256)`` over silence and aftermath;
- neither, because only frames without a time arrive (a vehicle that boots sends heartbeats for ten seconds and more
  before its first timed message): decided likewise after 20 s.

The receive clock may have stepped forward instead. Then the vehicle's clock, over the same jump, has gone on by far
less: what the receive clock is ahead by is no silence.

A long silence is one of more than 2 s, or of more than 128 frame periods (half a turn). A silence followed by the very
next number was a stall and loses nothing: a lost number of turns would land there once in 256.
"""

import numpy as np
from numba import njit

SECOND = 1_000_000_000
HOLE_AGE = 1 * SECOND  # a hole older than this is given up
HOLE_SPAN = 64  # and so is one further behind the highest number
SILENCE = 2 * SECOND
SETTLE, SETTLE_UNKNOWN = 5 * SECOND, 20 * SECOND
RATE_WINDOW = 10 * SECOND  # the frame period is that of the last 10..20 s, bursts and stalls included
STEPPED = 10 * SECOND  # a receive clock ahead of the vehicle's by more has stepped
SILENT_ROWS = 60 * SECOND  # rows stop this long after the last frame
RECENT = 100  # steps looked at for consistency
NEVER = np.iinfo(np.int64).max

# What is known of a frame, as bits: its sender has begun again, or is known to go on; its id is not in the dialect;
# another link has brought it before.
BEGUN, CONTINUES, UNKNOWN_ID, COPY = 1, 2, 4, 8

# One int64 vector holds the account; its first ten entries are the counters of a row.
# fmt: off
(RECEIVED, LOST, LATE, DISORDER, DUPLICATE, CONFLICT, AMBIGUOUS, RESTARTED, UNKNOWN, REDUNDANT,
 STARTED, NOW, BOUNDARY, SPOKEN,                                  # times: reached, of the next row, of the last frame
 FIRST, HIGHEST, SPANNED, OPEN, EXPIRY,                           # unwrapped numbers; when the oldest hole is given up
 HELD, JUMP, BEFORE, JUMP_NUMBER, JUMP_PROGRESS, JUMP_TIME, JUMP_NUMBERS, TURNING, CONTINUED,  # the held jump
 PROGRESS, OLD_T, OLD_PROGRESS, NEW_T, NEW_PROGRESS, NEW_FRAMES, FRAMES, BEST,                 # the rate
 TOLD, TOLD_RX, TOLD_BEFORE, TOLD_RX_BEFORE,           # the vehicle's time, last told and last before the jump
 ODD, STEPS, SIZE) = range(43)
# fmt: on
COUNTERS = REDUNDANT + 1
UNSEEN, ARRIVED, HOLE, GONE, KEPT = range(5)  # the fates; KEPT: in the held jump


@njit(cache=True, nogil=True)
def _settle(a, fate, turning):  # type: ignore[no-untyped-def]
    """Count the held jump as lost; with ``turning``, the turns of the counter that the rate before it asks for too."""
    missing = a[HELD]
    if turning and a[JUMP_TIME] > 0:
        rate, after = a[JUMP_NUMBERS] / a[JUMP_TIME], a[SPOKEN] - a[JUMP]
        if after >= SECOND:  # a sender that has slowed down has sent fewer than its old rate says
            rate = min(rate, (a[HIGHEST] - a[JUMP_NUMBER]) / after)
        silence = a[SPOKEN] - a[BEFORE]
        if a[TOLD_BEFORE] > 0:
            ahead = a[TOLD_RX] - a[TOLD_RX_BEFORE]
            gone = max(a[TOLD] - a[TOLD_BEFORE], 0)
            if ahead - gone > STEPPED and 4 * gone < ahead:
                silence = max(silence - (ahead - gone), 0)
        expected = silence * rate
        turns = np.int64(np.floor((expected - (a[PROGRESS] - a[JUMP_PROGRESS])) / 256 + 0.5))
        if turns > 0:
            missing += 256 * turns
            a[PROGRESS] += 256 * turns
            a[SPANNED] += 256 * turns
        a[AMBIGUOUS] += missing
    a[LOST] += missing
    a[HELD] = 0
    a[JUMP] = -1
    for s in range(256):
        if fate[s] == KEPT:
            fate[s] = GONE


@njit(cache=True, nogil=True)
def _age(a, fate, since, t):  # type: ignore[no-untyped-def]
    """Give up what is too old at time t."""
    if t > a[EXPIRY]:
        a[EXPIRY] = NEVER
        for number in range(max(a[FIRST], a[HIGHEST] - HOLE_SPAN), a[HIGHEST]):
            s = number & 255
            if fate[s] == HOLE:
                if t - since[s] > HOLE_AGE:
                    fate[s] = GONE
                    a[OPEN] -= 1
                    a[LOST] += 1
                else:
                    a[EXPIRY] = min(a[EXPIRY], since[s] + HOLE_AGE)
    if a[JUMP] >= 0 and t >= a[JUMP] + (SETTLE if a[CONTINUED] else SETTLE_UNKNOWN):
        _settle(a, fate, a[TURNING] == 1)


@njit(cache=True, nogil=True)
def _row(a, past, odd_times, t, then, counts, losses, k):  # type: ignore[no-untyped-def]
    """Write the account as row k; past[then] holds (received, net loss) ten seconds ago."""
    net = a[LOST] - a[LATE]
    counts[k, 0] = t
    counts[k, 1:] = a[:COUNTERS]
    arrived, gone = a[RECEIVED] - past[then, 0], max(net - past[then, 1], 0)
    losses[k, 0] = gone / (arrived + gone) if arrived + gone > 0 else np.nan
    losses[k, 1] = net / (a[RECEIVED] + net) if a[RECEIVED] + net > 0 else np.nan
    # Real loss makes steps other than 1 as well, but then frames come more seldom than they have been seen to come.
    steady = (a[SPOKEN] - odd_times[a[STEPS] % RECENT]) * float(a[BEST]) <= 2.0 * RECENT * RATE_WINDOW
    if 2 * a[ODD] > RECENT and steady:
        losses[k, 0] = losses[k, 1] = np.nan
    return k + 1


@njit(cache=True, nogil=True)
def advance(a, fate, since, past, odd_times, t, counts, losses, k):  # type: ignore[no-untyped-def]
    """Let receive time reach t: the rows due, each as of its own second, then what is given up by t itself."""
    while a[BOUNDARY] <= t:
        b = a[BOUNDARY]
        if b > a[SPOKEN] + SILENT_ROWS:
            past[:, 0] = a[RECEIVED]
            past[:, 1] = a[LOST] - a[LATE]
            a[BOUNDARY] = (t // SECOND + 1) * SECOND
            break
        _age(a, fate, since, b)
        second = (b // SECOND) % 10
        k = _row(a, past, odd_times, b, second, counts, losses, k)
        past[second, 0] = a[RECEIVED]
        past[second, 1] = a[LOST] - a[LATE]
        a[BOUNDARY] = b + SECOND
    _age(a, fate, since, t)
    a[NOW] = t
    return k


@njit(cache=True, nogil=True)
def _open(a, fate, since, number, t):  # type: ignore[no-untyped-def]
    """Number has been skipped: a hole, unless it is too far behind to be filled."""
    s = number & 255
    if a[HIGHEST] - number > HOLE_SPAN:
        fate[s] = GONE
        a[LOST] += 1
    else:
        fate[s] = HOLE
        since[s] = t
        a[OPEN] += 1
        a[EXPIRY] = min(a[EXPIRY], t + HOLE_AGE)


@njit(cache=True, nogil=True)
def _arrive(a, fate, digests, s, digest):  # type: ignore[no-untyped-def]
    fate[s] = ARRIVED
    digests[s] = digest
    a[RECEIVED] += 1


@njit(cache=True, nogil=True)
def _forward(a, fate, since, digests, step, t, digest, hold):  # type: ignore[no-untyped-def]
    """Advance the highest number by step > 0; the numbers between become holes, or are held."""
    before = a[HIGHEST]
    a[HIGHEST] = before + step
    a[SPANNED] += step
    a[PROGRESS] += step
    if a[OPEN] > 0:
        for number in range(max(a[FIRST], before - HOLE_SPAN), min(before, a[HIGHEST] - HOLE_SPAN)):
            if fate[number & 255] == HOLE:
                fate[number & 255] = GONE
                a[OPEN] -= 1
                a[LOST] += 1
    for number in range(before + 1, a[HIGHEST]):
        if hold:
            fate[number & 255] = KEPT
        else:
            _open(a, fate, since, number, t)
    if hold:
        a[HELD] = step - 1
    _arrive(a, fate, digests, a[HIGHEST] & 255, digest)


@njit(cache=True, nogil=True)
def _back(a, fate, since, digests, step, t, digest):  # type: ignore[no-untyped-def]
    """A number at or below the highest (step <= 0)."""
    number = a[HIGHEST] + step
    if number < a[FIRST]:  # sent before the first one we saw: the account begins there
        a[SPANNED] += a[FIRST] - number
        for skipped in range(number, a[FIRST]):
            _open(a, fate, since, skipped, t)
        a[FIRST] = number
    s = number & 255
    if fate[s] == ARRIVED or fate[s] == UNSEEN:
        a[DUPLICATE if fate[s] == ARRIVED and digests[s] == digest else CONFLICT] += 1
        return
    if fate[s] == GONE:
        a[LATE] += 1
    else:
        a[DISORDER] += 1
        a[OPEN if fate[s] == HOLE else HELD] -= 1
    _arrive(a, fate, digests, s, digest)


@njit(cache=True, nogil=True)
def _begin(a, fate, digests, seq, t, digest):  # type: ignore[no-untyped-def]
    """Number anew from this frame on."""
    fate[:] = UNSEEN
    a[LOST] += a[OPEN]
    a[OPEN] = 0
    a[EXPIRY] = NEVER
    a[FIRST] = a[HIGHEST] = seq
    a[SPANNED] += 1
    _arrive(a, fate, digests, seq, digest)
    a[OLD_T] = a[NEW_T] = t
    a[OLD_PROGRESS] = a[NEW_PROGRESS] = a[PROGRESS]
    a[NEW_FRAMES] = a[FRAMES]


@njit(cache=True, nogil=True)
def _drop(a, fate):  # type: ignore[no-untyped-def]
    """The held jump was a restart: no number lies between, and what was open before it is lost."""
    a[SPANNED] -= a[HELD]
    a[HELD] = 0
    a[JUMP] = -1
    a[FIRST] = a[JUMP_NUMBER]
    a[OLD_T] = a[NEW_T] = a[SPOKEN]
    a[OLD_PROGRESS] = a[NEW_PROGRESS] = a[PROGRESS]
    a[NEW_FRAMES] = a[FRAMES]
    for number in range(a[HIGHEST] - 255, a[FIRST]):
        if fate[number & 255] == HOLE:
            a[OPEN] -= 1
            a[LOST] += 1
        fate[number & 255] = UNSEEN


@njit(cache=True, nogil=True)
def _frame(a, fate, since, digests, odd, odd_times, seq, t, digest, restarted):  # type: ignore[no-untyped-def]
    """Account for one frame at time t."""
    a[FRAMES] += 1
    if a[STARTED] == 0:
        a[STARTED] = 1
        _begin(a, fate, digests, seq, t, digest)
        return
    if restarted:
        a[RESTARTED] += 1
        if a[JUMP] >= 0 and a[CONTINUED]:  # the boot clock has gone on across the jump: it was not this restart
            _settle(a, fate, a[TURNING] == 1)
        if a[JUMP] < 0:
            _begin(a, fate, digests, seq, t, digest)
            return
        _drop(a, fate)
    step = ((seq - a[HIGHEST] + 128) & 255) - 128
    s = seq & 255
    same = fate[s] == ARRIVED and digests[s] == digest and step <= 0
    silence = t - a[SPOKEN]
    numbers, time = a[PROGRESS] - a[OLD_PROGRESS], a[SPOKEN] - a[OLD_T]
    if a[JUMP] >= 0 and float(a[JUMP_NUMBERS]) * time > float(numbers) * a[JUMP_TIME]:
        numbers, time = a[JUMP_NUMBERS], a[JUMP_TIME]  # the rate since is dulled by the silence
    turning = time >= SECOND and numbers > 0 and float(silence) * numbers > 128.0 * time
    # After half a turn of silence a number that seems to lie behind is one of a later turn; after a shorter one, if it
    # has arrived before and now has other bytes.
    repeats = step <= 0 and (fate[s] == ARRIVED or fate[s] == UNSEEN or a[HIGHEST] + step < a[FIRST])
    turning = turning or (silence > SILENCE and repeats and time >= SECOND and numbers > 0)
    jump = not same and step != 1 and (turning or (silence > SILENCE and (step > 1 or repeats)))
    if jump and a[JUMP] >= 0:  # of two jumps the longer silence is the one that may be a restart
        if a[CONTINUED] or silence > a[JUMP] - a[BEFORE]:
            _settle(a, fate, a[TURNING] == 1)
        else:
            jump = False
            turning = False
    if jump:
        a[JUMP], a[BEFORE], a[JUMP_PROGRESS] = t, a[SPOKEN], a[PROGRESS]
        a[JUMP_TIME], a[JUMP_NUMBERS] = time, numbers
        a[TURNING], a[CONTINUED] = (1 if turning else 0), 0
        a[TOLD_BEFORE], a[TOLD_RX_BEFORE] = a[TOLD], a[TOLD_RX]
        _forward(a, fate, since, digests, step if step > 0 else step + 256, t, digest, True)
        a[JUMP_NUMBER] = a[HIGHEST]
    elif step > 0:
        _forward(a, fate, since, digests, step, t, digest, False)
    else:
        _back(a, fate, since, digests, step, t, digest)
    if not jump and not same:
        i = a[STEPS] % RECENT
        a[ODD] += (1 if step != 1 else 0) - odd[i]
        odd[i] = 1 if step != 1 else 0
        odd_times[i] = t
        a[STEPS] += 1
    if t - a[NEW_T] >= RATE_WINDOW:
        # BEST: the highest frame rate of any window, in frames per RATE_WINDOW.
        a[BEST] = max(a[BEST], np.int64((a[FRAMES] - a[NEW_FRAMES]) * (float(RATE_WINDOW) / (t - a[NEW_T]))))
        a[OLD_T], a[OLD_PROGRESS] = a[NEW_T], a[NEW_PROGRESS]
        a[NEW_T], a[NEW_PROGRESS], a[NEW_FRAMES] = t, a[PROGRESS], a[FRAMES]


@njit(cache=True, nogil=True)
def feed(a, fate, since, digests, odd, odd_times, past, seq, t_rx, digest, marks, told, counts, losses):  # type: ignore[no-untyped-def]
    """Account for frames; the rows due on the way go to counts (r, 1 + COUNTERS) and losses (r, 2): how many."""
    k = 0
    for i in range(len(seq)):
        t = t_rx[i]
        if a[STARTED] == 0:
            a[NOW] = a[SPOKEN] = t
            a[BOUNDARY] = (t // SECOND + 1) * SECOND
        t = max(t, a[NOW])
        k = advance(a, fate, since, past, odd_times, t, counts, losses, k)
        begun = marks[i] & BEGUN != 0
        _frame(a, fate, since, digests, odd, odd_times, np.int64(seq[i]), t, digest[i], begun)
        if begun:
            a[TOLD] = a[TOLD_BEFORE] = 0
        if marks[i] & CONTINUES:
            a[CONTINUED] = 1
        if marks[i] & UNKNOWN_ID:
            a[UNKNOWN] += 1
        if marks[i] & COPY:
            a[REDUNDANT] += 1
        if told[i] > 0:
            a[TOLD], a[TOLD_RX] = told[i], t
        a[SPOKEN] = t
    return k


@njit(cache=True, nogil=True)
def end(a, fate, since, past, odd_times, t, counts, losses):  # type: ignore[no-untyped-def]
    """The stream ends at t: nothing can fill a hole any more; one last row says so."""
    k = advance(a, fate, since, past, odd_times, t, counts, losses, 0)
    if a[JUMP] >= 0:
        _settle(a, fate, a[TURNING] == 1)
    for s in range(256):
        if fate[s] == HOLE:
            fate[s] = GONE
    a[LOST] += a[OPEN]
    a[OPEN] = 0
    a[EXPIRY] = NEVER
    return _row(a, past, odd_times, t, (t // SECOND + 1) % 10, counts, losses, k)
