"""Boot epochs, the compiled rules: what each frame of a vehicle turns out to be (`telemetry.clock`)."""

from __future__ import annotations

import numpy as np
from numba import njit

NO_TIME = -1  # t_boot of a frame that tells no time

SECOND = 1_000_000_000
BACK = 1 * SECOND
AGREE = SECOND // 2  # a witness is back by at least this much
SLACK = 5 * SECOND
SILENCE = 10 * SECOND
HOLD_TIME, HOLD_FRAMES = 2 * SECOND, 512
SMALL_SEQ, SEQ_JUMP = 32, 32
SLOW = 1 << 51  # ns, 26 days: a counter with a range beyond this is taken at its word when first seen
KINDS = 256  # pairs of link and message type told apart; further ones are taken at their word
MILLISECOND = 1_000_000
SHARE, LONGEST = 1 / 64, 8.0  # of a running mean: weight of the newest, and what is cut off, in means
NO_RHYTHM = SECOND  # interval assumed before there is one, and standard deviation of a time before any clock
DRIFT = 1e-4  # of a vehicle's clock against UTC
FIX_DELAY = 0.2e9  # ns: a fix is told about so late, and less or more by as much

# One int64 vector holds the state of the vehicle, another one that of each link.
# fmt: off
(EPOCH, SEGMENT, ANCHOR, CLOCK, KNOWN, HEARD, COUNT,  # the clock: newest reading, and when it was heard
 TURNED, TURN,                                        # receive time and verdict of the last reboot or step
 WRAPPED_US, WRAPPED_MS,                              # turns of the counters that have been told
 UTC, UTC_OFFSET, UTC_SEEN, UTC_DOUBT,                # UTC less vehicle time, by the last that told both
 TELLER, STATE) = range(17)                           # the link that told CLOCK
L_SEGMENT, L_CLOCK, L_ANCHOR, L_HEARD, L_SEQ, LINK = range(6)
# fmt: on
LINKS = 256
UNKNOWN, BY_FIX, BY_CLOCK = range(3)  # what CLOCK was read from
ID, LAG, TURNS, SAID = range(4)  # columns of the table of message types
WAIT, RESTART, STEP, WRAP, ALONE, STALE = range(6)  # verdicts
NEWS = 64  # events one call of the kernel can report
NO_UTC, BY_ARRIVAL, BY_PAIR = range(3)
TIMED, RESTARTED, LATE = range(3)  # flags


@njit(cache=True, nogil=True)
def _is_fix(kind):  # type: ignore[no-untyped-def]
    return kind == 24 or kind == 124 or kind == 33


@njit(cache=True, nogil=True)
def _slot(a, table, kind, link):  # type: ignore[no-untyped-def]
    key = np.int64(link) << 24 | np.int64(kind)
    for k in range(a[COUNT]):
        if table[k, ID] == key:
            return k
    return -1


@njit(cache=True, nogil=True)
def _forget(a, table, link):  # type: ignore[no-untyped-def]
    """Forget what is known of the message types of a link."""
    kept = 0
    for k in range(a[COUNT]):
        if table[k, ID] >> 24 != link:
            for column in range(table.shape[1]):
                table[kept, column] = table[k, column]
            kept += 1
    a[COUNT] = kept


@njit(cache=True, nogil=True)
def _unwrap(clock, table, slot, raw, modulus):  # type: ignore[no-untyped-def]
    """The reading with the turns known so far; of a type never seen, with those that bring it nearest to the clock."""
    if modulus <= 0:
        return raw
    if slot >= 0:
        reading = raw + table[slot, TURNS] * modulus
        if table[slot, TURNS] > 0 and 2 * (reading - clock) > modulus:
            reading -= modulus  # sent before the counter wrapped
        return reading
    return raw + max(0, (clock - raw + modulus // 2) // modulus) * modulus


@njit(cache=True, nogil=True)
def _wraps(back, modulus, elapsed):  # type: ignore[no-untyped-def]
    """Whether a reading that is back by so much is explained by a wrap."""
    return modulus > 0 and 2 * back > modulus and modulus - back <= elapsed + SLACK


@njit(cache=True, nogil=True)
def _can_be_boot(clock, raw, reading, elapsed):  # type: ignore[no-untyped-def]
    """Whether time allows a boot; a clock whose counter has turned is compared as the counter would show it."""
    return raw <= elapsed + SLACK or 2 * raw < clock - (reading - raw)


@njit(cache=True, nogil=True)
def _testifies(before, seq, elapsed):  # type: ignore[no-untyped-def]
    """Whether silence or the sequence number speak for a reboot."""
    return elapsed >= SILENCE or (before >= 0 and seq < SMALL_SEQ and ((seq - before) & 255) >= SEQ_JUMP)


@njit(cache=True, nogil=True)
def _clock(a, links, link):  # type: ignore[no-untyped-def]
    """The newest reading over a link; of one not heard since the clock last turned, the newest over any."""
    return links[link, L_CLOCK] if links[link, L_SEGMENT] == a[SEGMENT] else a[CLOCK]


@njit(cache=True, nogil=True)
def _judge(a, links, table, i, reading, back, t_boot, kind, t_rx, seq, modulus, link, copy, now, flush):  # type: ignore[no-untyped-def]
    """Verdict on frame i, whose reading is back by more than `BACK`."""
    elapsed = t_rx[i] - a[HEARD]
    clock = _clock(a, links, link[i])
    falls = modulus[i] > 0 and 2 * back > modulus[i]
    suspect = -1  # the frame that bears the first witness
    first = reading
    elsewhere = False  # over another link the clock goes on
    if not _is_fix(kind[i]) and not _wraps(back, modulus[i], elapsed):
        suspect = i
        if _can_be_boot(clock, t_boot[i], reading, elapsed) and _testifies(
            links[link[i], L_SEQ], np.int64(seq[i]), elapsed
        ):
            return RESTART
    expired = flush or now - t_rx[i] > HOLD_TIME
    for j in range(i + 1, len(t_boot)):
        waited = t_rx[j] - t_rx[i]
        if waited > HOLD_TIME or j - i >= HOLD_FRAMES:
            expired = True
            break
        if t_boot[j] < 0 or copy[j] or _is_fix(kind[j]):
            continue
        slot = _slot(a, table, kind[j], link[j])
        if slot < 0 and 0 < modulus[j] < SLOW:
            continue  # its turns are a guess from the very clock that is in question
        if links[link[j], L_SEGMENT] >= 0 and links[link[j], L_SEGMENT] != a[SEGMENT]:
            continue  # it has not shown the last turn yet
        clock_j = _clock(a, links, link[j])
        other = _unwrap(clock_j, table, slot, t_boot[j], modulus[j])
        if other >= clock_j - BACK:
            if link[j] == link[i]:
                return WRAP if falls else ALONE
            elsewhere = True
            continue
        behind = clock_j - (table[slot, LAG] if slot >= 0 else 0) - other
        if behind <= AGREE or _wraps(behind, modulus[j], elapsed + waited):
            continue
        if suspect < 0:
            if behind > BACK:
                suspect = j
                first = other
                if _can_be_boot(clock_j, t_boot[j], other, elapsed + waited) and _testifies(
                    links[link[j], L_SEQ], np.int64(seq[j]), elapsed + waited
                ):
                    return RESTART
        elif kind[j] != kind[suspect] and (
            abs(other - first) <= SLACK + waited or abs(t_boot[j] - t_boot[suspect]) <= SLACK + waited
        ):
            return (
                RESTART
                if _can_be_boot(
                    _clock(a, links, link[suspect]), t_boot[suspect], first, elapsed + t_rx[suspect] - t_rx[i]
                )
                else STEP
            )
    if not expired:
        return WAIT
    if falls:
        return WRAP
    return ALONE if _is_fix(kind[i]) or elsewhere else STEP


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
def _advance(links, rhythm, link, reading, t_rx, seq):  # type: ignore[no-untyped-def]
    """A link has told this reading."""
    step = float(reading - links[link, L_CLOCK])
    if step > 0:
        mean = rhythm[link]
        if mean[0] > 0:
            step = min(step, LONGEST * mean[0])
        part = SHARE if mean[0] > 0 else 1.0
        for power in range(3):
            mean[power] += part * (step ** (power + 1) - mean[power])
        links[link, L_CLOCK] = reading
    links[link, L_HEARD] = t_rx
    links[link, L_SEQ] = seq


@njit(cache=True, nogil=True)
def _expect(mean, clock, heard, t_rx):  # type: ignore[no-untyped-def]
    """Reading to be expected for a frame that tells none, and its standard deviation, ns."""
    silence = float(max(t_rx - heard, 0))
    if mean[0] > 0:
        age = mean[1] / (2.0 * mean[0])
        sigma = np.sqrt(max(mean[2] / (3.0 * mean[0]) - age * age, 0.0))
    else:
        age, sigma = 0.0, NO_RHYTHM / np.sqrt(3.0)
    age = max(age, 0.5 * silence)
    sigma = max(sigma, silence / np.sqrt(12.0))
    return clock + np.int64(age), np.int64(sigma)


@njit(cache=True, nogil=True)
def _by_utc(a, unix, t, sigma, fix):  # type: ignore[no-untyped-def]
    """Vehicle time and its standard deviation, ns, of a frame that tells UTC, and without it would be put at t."""
    if a[UTC] == BY_PAIR:
        found = unix - a[UTC_OFFSET]
        if abs(found - t) <= SILENCE + sigma:
            drift = DRIFT * float(found - a[UTC_SEEN])
            return found, np.int64(np.sqrt(float(MILLISECOND) ** 2 + float(a[UTC_DOUBT]) ** 2 + drift * drift))
        return t, np.int64(np.hypot(float(sigma), FIX_DELAY))
    offset = unix - t
    if a[UTC] == NO_UTC or abs(offset - a[UTC_OFFSET]) > SILENCE:
        a[UTC], a[UTC_OFFSET] = BY_ARRIVAL, offset
    else:
        a[UTC_OFFSET] = max(offset, a[UTC_OFFSET] - np.int64(DRIFT * float(max(t - a[UTC_SEEN], 0))))
    a[UTC_SEEN] = t
    return unix - a[UTC_OFFSET], np.int64(np.hypot(float(sigma), FIX_DELAY if fix else 0.0))


@njit(cache=True, nogil=True)
def _learn_utc(a, unix, t):  # type: ignore[no-untyped-def]
    """A frame has told UTC and the vehicle's time at once."""
    offset = unix - t
    known = a[UTC] == BY_PAIR and t - a[UTC_SEEN] < 60 * SECOND
    a[UTC_DOUBT] = abs(offset - a[UTC_OFFSET]) if known else 0
    a[UTC], a[UTC_OFFSET], a[UTC_SEEN] = BY_PAIR, offset, t


@njit(cache=True, nogil=True)
def _behind(a, links, link, reading, t_rx):  # type: ignore[no-untyped-def]
    """Whether a reading goes on with the clock before its last turn, over a link that has not shown the turn yet."""
    state = links[link]
    if t_rx - a[TURNED] > SILENCE or not (
        state[L_CLOCK] - BACK <= reading <= state[L_CLOCK] + t_rx - state[L_HEARD] + SLACK
    ):
        return False
    return a[TURN] == STEP or reading > a[CLOCK] + t_rx - a[HEARD] + BACK


@njit(cache=True, nogil=True)
def feed(  # type: ignore[no-untyped-def]
    a, links, rhythm, table, t_boot, kind, t_rx, seq, modulus, link, copy, unix, begin, now, flush, out, flags, news
):
    """Decide frames from `begin` on: fill out (4, k: epoch, segment, t, sigma), flags (3, k: timed, restarted, stale)
    and news (e, 6: index, verdict, kind, clock before, reading, silence); return (how many are decided, e).
    """
    told = 0
    for i in range(begin, len(t_boot)):
        raw, on = t_boot[i], np.int64(link[i])
        mine = links[on]
        flags[TIMED, i] = flags[RESTARTED, i] = flags[LATE, i] = False
        out[0, i], out[1, i], out[3, i] = a[EPOCH], a[SEGMENT], 0
        joins = a[KNOWN] != UNKNOWN and mine[L_SEGMENT] != a[SEGMENT]  # the link is yet to show the clock as it is now
        heard_before = mine[L_SEGMENT] >= 0
        if raw < 0:
            if a[KNOWN] == UNKNOWN:
                t, sigma = t_rx[i], NO_RHYTHM
            elif joins and heard_before and a[TURN] == RESTART and t_rx[i] - a[TURNED] <= SILENCE:
                t, sigma = _expect(rhythm[on], mine[L_CLOCK], mine[L_HEARD], t_rx[i])
                t += mine[L_ANCHOR]
                flags[LATE, i] = True
            elif joins:
                t, sigma = _expect(rhythm[a[TELLER]], a[CLOCK], a[HEARD], t_rx[i])
                t += a[ANCHOR]
            else:
                t, sigma = _expect(rhythm[on], mine[L_CLOCK], mine[L_HEARD], t_rx[i])
                t += a[ANCHOR]
            if unix[i] > 0 and not copy[i] and not flags[LATE, i]:
                t, sigma = _by_utc(a, unix[i], t, sigma, _is_fix(kind[i]))
            out[2, i], out[3, i] = t, sigma
            continue
        if told == len(news):
            return i, told
        fix = _is_fix(kind[i])
        elapsed = t_rx[i] - a[HEARD]
        slot = _slot(a, table, kind[i], on)
        if a[KNOWN]:
            reading = _unwrap(mine[L_CLOCK] if heard_before else a[CLOCK], table, slot, raw, modulus[i])
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
            mine[L_CLOCK] = reading
            mine[L_SEGMENT], mine[L_ANCHOR] = a[SEGMENT], a[ANCHOR]
        if joins and heard_before and _behind(a, links, on, reading, t_rx[i]):
            if not fix:
                _advance(links, rhythm, on, reading, t_rx[i], np.int64(seq[i]))
            out[2, i] = reading + mine[L_ANCHOR]
            flags[LATE, i] = a[TURN] == RESTART
            continue
        if joins and heard_before and a[TURN] == RESTART:
            _forget(a, table, on)
            slot = -1
            reading = _unwrap(a[CLOCK], table, slot, raw, modulus[i])
        back = _clock(a, links, on) - (table[slot, LAG] if slot >= 0 else 0) - reading
        slow = joins and (copy[i] or heard_before) and back <= SILENCE  # a link that is behind another one
        tells = not fix
        if copy[i] and 0 < modulus[i] < 2 * back:  # the counter has wrapped over this link too
            reading += modulus[i]
            back -= modulus[i]
        if back > BACK and copy[i] and not slow:
            out[2, i] = reading + a[ANCHOR]  # no witness of anything
            continue
        if back > BACK and not slow:
            verdict = _judge(
                a, links, table, i, reading, back, t_boot, kind, t_rx, seq, modulus, link, copy, now, flush
            )
            if verdict == WAIT:
                return i, told
            tells = tells and verdict != ALONE
            if verdict == RESTART:
                reading = raw
            elif verdict == WRAP:
                reading += modulus[i]
            counter = WRAPPED_US if modulus[i] < SLOW else WRAPPED_MS
            turned = verdict == WRAP and (reading - raw) // modulus[i] > a[counter]
            if turned:
                a[counter] = (reading - raw) // modulus[i]
            if (
                turned
                or verdict in (RESTART, STEP)
                or (verdict == ALONE and not fix and slot >= 0 and table[slot, SAID] == 0)
            ):
                news[told, 0], news[told, 1], news[told, 2] = i, verdict, kind[i]
                news[told, 3], news[told, 4], news[told, 5] = _clock(a, links, on), reading, elapsed
                told += 1
            if verdict == RESTART:
                a[EPOCH] += 1
                a[ANCHOR] = t_rx[i] - raw
                _forget(a, table, on)
                a[KNOWN] = UNKNOWN
                a[WRAPPED_US] = a[WRAPPED_MS] = 0
                slot = -1
                flags[RESTARTED, i] = True
            elif verdict == STEP:
                a[CLOCK] -= back
                mine[L_CLOCK] -= back
            elif verdict == ALONE and slot >= 0 and not fix:
                table[slot, SAID] = 1
            if verdict in (RESTART, STEP):
                a[SEGMENT] += 1
                a[TURNED], a[TURN] = t_rx[i], verdict
                a[UTC] = NO_UTC
                joins = True
        elif joins and heard_before and a[TURN] == RESTART and not fix:
            flags[RESTARTED, i] = True
        if joins and not fix:
            mine[L_SEGMENT], mine[L_ANCHOR] = a[SEGMENT], a[ANCHOR]
            mine[L_CLOCK] = reading
        if a[KNOWN] == UNKNOWN or (not fix and a[KNOWN] == BY_FIX and back <= BACK):
            a[CLOCK] = reading
            mine[L_CLOCK] = reading
            mine[L_SEGMENT], mine[L_ANCHOR] = a[SEGMENT], a[ANCHOR]
            a[KNOWN] = BY_FIX if fix else BY_CLOCK
        elif not copy[i] and (not fix or a[KNOWN] == BY_FIX):
            a[CLOCK] = max(a[CLOCK], reading)
        if not fix or a[KNOWN] == BY_FIX:
            _advance(links, rhythm, on, reading, t_rx[i], np.int64(seq[i]))
            if not copy[i]:
                a[HEARD], a[TELLER] = t_rx[i], on
        if slot < 0 and a[COUNT] < KINDS:
            slot = a[COUNT]
            a[COUNT] += 1
            table[slot, ID] = on << 24 | np.int64(kind[i])
            table[slot, SAID] = table[slot, TURNS] = 0
        if slot >= 0:
            table[slot, LAG] = mine[L_CLOCK] - reading
            table[slot, TURNS] = max(table[slot, TURNS], (reading - raw) // modulus[i]) if modulus[i] > 0 else 0
        out[0, i], out[1, i], out[2, i] = a[EPOCH], a[SEGMENT], reading + a[ANCHOR]
        flags[TIMED, i] = tells
        if unix[i] > 0 and tells and not copy[i]:
            _learn_utc(a, unix[i], reading + a[ANCHOR])
    return len(t_boot), told
