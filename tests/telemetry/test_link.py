"""The loss account against a slow reference that knows the true numbers, the worked cases, and its own cutting."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from telemetry.clock import BootClock
from telemetry.link import LinkAccounts, LossAccount, Rows
from telemetry.loss import BEGUN, CONTINUES, COPY, UNKNOWN_ID
from tests.telemetry.test_clock import read

SECOND = 1_000_000_000
MS = 1_000_000


def columns(frames):
    """Arrays of (number, t in ns, digest, restarted, continued) rows."""
    number, t, digest, restarted, continued = zip(*frames, strict=True)
    return (
        (np.array(number) & 255).astype(np.uint8),
        np.array(t, np.int64),
        np.array(digest, np.int64),
        (BEGUN * np.array(restarted) + CONTINUES * np.array(continued)).astype(np.uint8),
    )


def run(frames, cuts=(), finish=None):
    """Rows and counters of an account fed with frames, cut at the given places."""
    account = LossAccount()
    data = columns(frames)
    edges = [0, *sorted(cuts), len(frames)]
    for begin, end in pairwise(edges):
        account.feed(*(column[begin:end] for column in data))
        if end > begin:
            account.advance(int(data[1][end - 1]))
    if finish is not None:
        account.finish(finish)
    return account.rows(), account.counters


def steady(numbers, period=10 * MS, t=0):
    """Frames that arrive at a steady rate, each with a checksum of its own number."""
    return [(n, t + i * period, n, False, False) for i, n in enumerate(numbers)]


def closed(frames):
    """Counters after the end."""
    return run(frames, finish=frames[-1][1] + SECOND // 2)[1]


@pytest.mark.parametrize(
    ("numbers", "expected"),
    [
        ([1, 2, 2, 3], {"duplicate": 1, "received": 3, "lost": 0}),
        ([1, 3, 2, 4], {"out_of_order": 1, "received": 4, "lost": 0}),
        ([254, 255, 0, 1], {"received": 4, "lost": 0, "out_of_order": 0}),
        ([1, 2, 6, 7], {"lost": 3, "received": 4}),
        ([5, 4, 6], {"received": 3, "lost": 0, "out_of_order": 1}),
    ],
)
def test_worked_cases(numbers, expected):
    counters = closed(steady(numbers))
    assert {name: counters[name] for name in expected} == expected


def test_late_after_two_seconds():
    frames = [(1, 0, 1, False, False), (3, 10 * MS, 3, False, False), (2, 2010 * MS, 2, False, False)]
    counters = closed(frames)
    assert (counters["lost"], counters["late"], counters["received"]) == (1, 1, 3)


def test_a_hole_is_open_for_a_second_and_no_longer():
    account = LossAccount()
    account.feed(*columns(steady([1, 3])))
    account.advance(10 * MS + SECOND)
    assert account.counters["open"] == 1
    account.advance(10 * MS + SECOND + 1)
    assert (account.counters["open"], account.counters["lost"]) == (0, 1)


def test_same_number_other_bytes_is_a_conflict():
    frames = steady([1, 2, 2, 3])
    frames[2] = (2, frames[2][1], 99, False, False)
    counters = closed(frames)
    assert (counters["conflict"], counters["duplicate"]) == (1, 0)


@pytest.mark.parametrize("back", [True, False])
def test_whole_turns_of_the_counter_are_lost_in_a_long_silence(back):
    frames = steady(range(1000))  # 10 s, ends with number 999
    t = frames[-1][1]
    missing = 301 if not back else 200
    frames += [(999 + missing + i, t + (missing + i) * 10 * MS, i, False, True) for i in range(600)]
    counters = closed(frames)
    assert counters["lost"] == counters["ambiguous"] == missing - 1


def test_a_long_silence_is_judged_at_the_end_too():
    frames = steady(range(1000))
    frames.append((999 + 301, frames[-1][1] + 301 * 10 * MS, 1, False, False))
    _, counters = run(frames)
    assert (counters["held"], counters["lost"]) == (300 - 256, 0)
    counters = closed(frames)
    assert counters["lost"] == counters["ambiguous"] == 300


def test_a_stall_followed_by_a_burst_loses_nothing():
    frames = steady(range(1000))
    t = frames[-1][1] + 4 * SECOND
    frames += [(1000 + i, t + i * MS // 10, i, False, True) for i in range(400)]
    frames += [(1400 + i, t + (i + 1) * 10 * MS, i, False, True) for i in range(600)]
    assert closed(frames)["lost"] == 0


def test_a_stall_that_drops_part_of_its_buffer_loses_that_part():
    frames = steady(range(1000))
    t = frames[-1][1] + 4 * SECOND
    frames += [(1050 + i, t + i * MS // 10, i, False, True) for i in range(350)]
    frames += [(1400 + i, t + (i + 1) * 10 * MS, i, False, True) for i in range(600)]
    counters = closed(frames)
    assert counters["lost"] == counters["ambiguous"] == 50


@pytest.mark.parametrize("told_after", [0, 4, 12])
@pytest.mark.parametrize("silence", [3, 16, 59])
def test_a_reboot_loses_nothing(told_after, silence):
    """Heartbeats at 1 Hz with numbers from 0 come first; the boot clock tells up to 12 s later."""
    frames = steady(range(1, 1208))
    t = frames[-1][1] + silence * SECOND
    frames += [(n, t + n * SECOND, 5000 + n, n == told_after, False) for n in range(told_after + 1)]
    t = frames[-1][1]
    frames += steady(range(told_after + 1, 700), t=t + 10 * MS)
    counters = closed(frames)
    assert (counters["restarted"], counters["lost"], counters["ambiguous"], counters["late"]) == (1, 0, 0, 0)
    assert counters["received"] == len(frames) == counters["spanned"]


def test_a_jump_is_held_until_the_clock_is_known_to_go_on():
    frames = steady(range(1000))
    t = frames[-1][1] + 5 * SECOND
    frames += [(1100 + i, t + i * SECOND, i, False, i == 2) for i in range(9)]
    held = run(frames[:1005])[1]
    assert (held["held"], held["lost"]) == (100, 0)
    assert run(frames[:1006])[1]["lost"] == 100  # 5 s after the jump


def test_the_clock_of_rows_may_jump_by_years():
    frames = steady(range(100))
    frames.append((100, 10**9 * SECOND, 100, False, False))
    rows, _ = run(frames, finish=10**9 * SECOND + 3 * SECOND)
    assert len(rows.t_rx) < 70
    assert np.all(np.diff(rows.t_rx) >= 0)


def test_a_sender_that_does_not_count_has_no_percentage():
    rng = np.random.default_rng(3)
    frames = steady(rng.integers(0, 256, 3000).tolist())
    rows, _ = run(frames, finish=frames[-1][1])
    assert np.isnan(rows.loss[5:]).all() and np.isnan(rows.loss_total[5:]).all()


def test_heavy_loss_keeps_its_percentage():
    rng = np.random.default_rng(4)
    heard = [(n, n * 10 * MS, n, False, False) for n in range(6000) if n < 3000 or rng.random() < 0.3]
    rows, counters = run(heard, finish=heard[-1][1])
    assert rows.loss[-1] == pytest.approx(0.7, abs=0.05)
    assert rows.loss_total[-1] == counters["lost"] / counters["spanned"]


def test_loss_of_the_last_ten_seconds():
    frames = [(n, n * 10 * MS, n, False, False) for n in range(4000) if n < 2000 or n % 4]
    rows, _ = run(frames)
    at = dict(zip((rows.t_rx // SECOND).tolist(), rows.loss.tolist(), strict=True))
    assert at[19] == 0
    assert at[35] == pytest.approx(0.25, abs=0.01)


class Reference:
    """The rules with sets of true numbers, where nothing wraps."""

    def __init__(self):
        self.seen, self.holes, self.gone = {}, {}, set()
        self.first = self.highest = None
        self.n = dict.fromkeys(("received", "lost", "late", "out_of_order", "duplicate", "conflict"), 0)

    def give_up(self, numbers):
        for number in list(numbers):
            del self.holes[number]
            self.gone.add(number)
            self.n["lost"] += 1

    def frame(self, number, t, digest):
        self.give_up([h for h, since in self.holes.items() if t - since > SECOND])
        if self.first is None:
            self.first = self.highest = number
        skipped = [*range(self.highest + 1, number), *range(number, self.first)]
        self.highest, self.first = max(self.highest, number), min(self.first, number)
        self.holes.update(dict.fromkeys(skipped, t))
        self.give_up([h for h in self.holes if self.highest - h > 64])
        if number in self.seen:
            self.n["duplicate" if self.seen[number] == digest else "conflict"] += 1
            return
        self.n["late"] += number in self.gone
        self.n["out_of_order"] += number in self.holes
        self.n["received"] += 1
        self.holes.pop(number, None)
        self.gone.discard(number)
        self.seen[number] = digest


steps = st.one_of(st.just(1), st.integers(1, 4), st.integers(-3, 30), st.integers(-100, 0))
streams = st.lists(st.tuples(steps, st.integers(10, 40), st.booleans()), min_size=1, max_size=400)


def unfold(stream):
    """Frames of a stream of (step from the highest, ms, honest checksum)."""
    highest, t, frames = 1000, 5 * SECOND, []
    for step, ms, honest in stream:
        t += ms * MS
        number = highest + step
        highest = max(highest, number)
        frames.append((number, t, number if honest else len(frames) + 10**6, False, False))
    return frames


@settings(max_examples=300, deadline=None)
@given(streams)
def test_agrees_with_the_reference(stream):
    frames = unfold(stream)
    reference = Reference()
    for number, t, digest, _, _ in frames:
        reference.frame(number, t, digest)
    _, counters = run(frames)
    assert {name: counters[name] for name in reference.n} == reference.n
    assert counters["open"] == len(reference.holes)
    spanned = reference.highest - reference.first + 1
    assert (
        spanned == counters["spanned"] == counters["received"] + counters["lost"] - counters["late"] + counters["open"]
    )


wild = st.lists(
    st.tuples(st.integers(0, 255), st.sampled_from([0, 1, 10, 300, 2500, 7000, 70_000]), st.integers(0, 15)),
    max_size=300,
)


@settings(max_examples=200, deadline=None)
@given(wild, st.data())
def test_cutting_changes_nothing_and_the_identity_holds(stream, data):
    t, number, frames = 0, 0, []
    for value, ms, what in stream:
        t += ms * MS
        number = value if what > 11 else number + 1
        frames.append((number, t, value % 3, what == 0, what in (1, 2, 3)))
    if not frames:
        return
    cuts = data.draw(st.lists(st.integers(0, len(frames)), max_size=8))
    whole, counters = run(frames, finish=t + SECOND)
    parts, again = run(frames, cuts, finish=t + SECOND)
    assert counters == again
    for name in Rows._fields:
        np.testing.assert_array_equal(getattr(whole, name), getattr(parts, name))
    assert counters["spanned"] == counters["received"] + counters["lost"] - counters["late"]
    assert counters["open"] == counters["held"] == 0
    open_now = run(frames, cuts)[1]
    held = open_now["open"] + open_now["held"]
    assert open_now["spanned"] == open_now["received"] + open_now["lost"] - open_now["late"] + held


def test_accounts_of_many_senders():
    rng = np.random.default_rng(5)
    count = 3000
    link, sysid, compid = (rng.integers(0, 3, count).astype(np.uint8) for _ in range(3))
    seq = np.zeros(count, np.uint8)
    for key in range(27):
        mine = link * 9 + sysid * 3 + compid == key
        seq[mine] = np.arange(mine.sum()) % 256
    t_rx = np.sort(rng.integers(0, 20 * SECOND, count))
    digest, flags = np.arange(count), np.zeros(count, np.uint8)
    whole, parts = LinkAccounts(), LinkAccounts()
    whole.feed(link, sysid, compid, seq, t_rx, digest, flags)
    for i in range(0, count, 7):
        cut = slice(i, i + 7)
        parts.feed(*(column[cut] for column in (link, sysid, compid, seq, t_rx, digest, flags)))
        parts.advance(int(t_rx[cut][-1]))
    said = []
    for accounts in (whole, parts):
        accounts.finish(20 * SECOND)
        said.append(accounts.drain(["a", "b", "c"], lambda vehicle: vehicle * 10))
    assert len(said[0]) == 27
    keys = [("abc".index(m.source[0]), m.vehicle, int(m.source[2:])) for m in said[0]]
    assert keys == sorted(keys)
    for one, other in zip(*said, strict=True):
        assert (one.source, one.vehicle, one.boot) == (other.source, other.vehicle, other.vehicle * 10)
        np.testing.assert_array_equal(one.received, other.received)
        np.testing.assert_array_equal(one.t_rx, other.t)
        assert one.loss_total[-1] == 0
    assert whole.drain(["a", "b", "c"], lambda vehicle: 0) == []


def test_nothing_is_said_of_nobody():
    account = LossAccount()
    account.advance(5 * SECOND)
    account.finish(9 * SECOND)
    assert len(account.rows().t_rx) == 0


def test_loss_of_a_real_flight_with_four_reboots():
    """About 2.4 % by the autopilot's own numbers; a reboot adds nothing, though its clock tells only 5..13 s later."""
    log = read("copter_2015_4reboots.tlog")
    found = BootClock(1).feed(*log.cut(0, None), flush=True)
    continued = found.timed & ~found.restarted
    account = LossAccount()
    marks = (BEGUN * found.restarted + CONTINUES * continued).astype(np.uint8)
    account.feed(log.seq, log.t_rx, np.arange(len(log.seq)), marks, np.where(found.timed, found.t, 0))
    account.finish(int(log.t_rx[-1]))
    rows, counters = account.rows(), account.counters
    assert (counters["restarted"], counters["received"]) == (4, len(log.seq))
    assert rows.loss_total[-1] == pytest.approx(0.024, abs=0.002)
    for reboot in np.flatnonzero(found.restarted):
        around = np.abs(rows.t_rx - log.t_rx[reboot]) < 5 * SECOND
        assert np.ptp(rows.ambiguous[around]) == 0


def marked(frames, bits, told=None):
    """Counters at the end of frames with marks of their own, and the vehicle's time where it is told."""
    account = LossAccount()
    seq, t_rx, digest, _ = columns(frames)
    account.feed(seq, t_rx, digest, np.array(bits, np.uint8), told)
    account.finish(int(t_rx[-1]) + SECOND // 2)
    return account.counters


def test_unknown_ids_and_copies_are_counted_and_are_no_loss():
    counters = marked(steady([1, 2, 3, 4]), [0, UNKNOWN_ID, COPY, UNKNOWN_ID | COPY])
    assert (counters["unknown"], counters["redundant"]) == (2, 2)
    assert (counters["received"], counters["lost"], counters["duplicate"]) == (4, 0, 0)


def test_a_restart_after_an_outage_does_not_take_its_losses_back():
    """The clock went on behind the outage, so the jump was lost numbers; the restart comes 3 s later."""
    frames = steady(range(1000))
    t = frames[-1][1]
    frames += [(1250 + i, t + (251 + i) * 10 * MS, i, False, True) for i in range(250)]
    frames += [(i, frames[-1][1] + (i + 1) * 10 * MS, 5000 + i, i == 0, i > 0) for i in range(200)]
    counters = closed(frames)
    assert (counters["restarted"], counters["lost"]) == (1, 250)


@pytest.mark.parametrize("missing", [0, 1, 30])
def test_a_receive_clock_that_steps_forward_is_no_silence(missing):
    """It steps by two hours while the vehicle's clock goes on, and a few frames are lost there as well."""
    frames = steady(range(1000))
    t = frames[-1][1]
    frames += [(1000 + missing + i, t + 7200 * SECOND + i * 10 * MS, i, False, True) for i in range(900)]
    numbers = np.array([n for n, *_ in frames])
    counters = marked(frames, [CONTINUES] * len(frames), numbers * 10 * MS + SECOND)
    assert (counters["lost"], counters["received"]) == (missing, 1900)


def test_two_outages_one_after_the_other():
    frames = steady(range(2000))
    for missing in (400, 400):
        number, t = frames[-1][:2]
        begin = number + missing
        frames += [(begin + i, t + (missing + i) * 10 * MS, begin + i, False, True) for i in range(1, 101)]
    number, t = frames[-1][:2]
    frames += [(number + i, t + i * 10 * MS, number + i, False, True) for i in range(1, 900)]
    counters = closed(frames)
    assert counters["conflict"] == counters["late"] == 0
    assert counters["lost"] == 800
