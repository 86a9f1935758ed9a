"""Boot epochs and clock fits: scripted vehicles, real logs, and the same results however the stream is cut."""

from __future__ import annotations

import dataclasses
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega

from telemetry.clock import NO_TIME, BootClock, Epochs
from telemetry.clockfit import ClockFitter
from telemetry.messages import ClockFit, Event

DATA = Path(__file__).resolve().parents[2].parent / "shared/data"
SECOND = 1_000_000_000
MS = 1_000_000
UINT32_US, UINT32_MS = 2**32 * 1000, 2**32 * MS
SERVO = 36
COLUMNS = ("epoch", "segment", "t", "sigma", "timed", "restarted", "stale")


@dataclasses.dataclass
class Log:
    """Frames of one vehicle in the order of arrival, as `BootClock.feed` takes them, and SYSTEM_TIME's UTC."""

    t_boot: np.ndarray
    kind: np.ndarray
    t_rx: np.ndarray
    seq: np.ndarray
    modulus: np.ndarray
    unix: np.ndarray

    def cut(self, begin, end):
        return (column[begin:end] for column in (self.t_boot, self.kind, self.t_rx, self.seq, self.modulus))


def script(frames):
    """A log of (t_rx s, kind, t_boot s or None) rows, numbered one by one; message 36 wraps as uint32 us."""
    t_rx, kind, t_boot = zip(*frames, strict=True)
    boot = np.array([NO_TIME if b is None else round(b * 1e9) for b in t_boot], np.int64)
    kind = np.array(kind, np.int32)
    modulus = np.where(kind == SERVO, UINT32_US, 0)
    boot = np.where((kind == SERVO) & (boot >= 0), boot % UINT32_US, boot)
    arrival = np.array([round(t * 1e9) for t in t_rx], np.int64)
    count = len(frames)
    return Log(boot, kind, arrival, np.arange(count).astype(np.uint8), modulus, np.zeros(count, np.int64))


def steady(begin, end, offset, kinds=(30, 27, 29), step=0.1):
    """Frames of several kinds at a steady rate, whose clock shows the receive time + offset."""
    return [(t + k * 1e-3, kind, t + offset) for t in np.arange(begin, end, step) for k, kind in enumerate(kinds)]


def feed(log, cuts=()):
    """Results of a log fed in pieces, the undecided tail of each with the next."""
    clock, base, parts, events = BootClock(1), 0, [], []
    for end in [*cuts, len(log.t_boot)]:
        part = clock.feed(*log.cut(base, end), flush=end == len(log.t_boot))
        events += [(index + base, text) for index, text in part.events]
        parts.append(part)
        base += part.decided
    assert base == len(log.t_boot)
    return Epochs(base, *(np.concatenate([getattr(p, c) for p in parts]) for c in COLUMNS), events)


def same(one, other):
    assert one.events == other.events
    for column in COLUMNS:
        np.testing.assert_array_equal(getattr(one, column), getattr(other, column))


def test_time_is_the_boot_clock_plus_an_anchor():
    log = script([(99.0, 0, None), *steady(100, 102, -50), (102.5, 0, None)])
    found = feed(log)
    assert found.t[0] == 99 * SECOND  # no clock yet
    timed = slice(1, -1)
    np.testing.assert_array_equal(found.t[timed], log.t_boot[timed] + 50 * SECOND)
    assert 0 < found.t[-1] - found.t[-2] < 500 * MS
    assert found.timed.tolist() == [False, *[True] * 60, False]


@pytest.mark.parametrize("silence", [3, 16, 100])
def test_reboot(silence):
    log = script([*steady(0, 60, 1000), *steady(60 + silence, 70 + silence, -58 - silence)])
    found = feed(log)
    assert found.epoch[-1] == 1 and found.restarted.sum() == 1
    index = int(found.restarted.argmax())
    assert index == np.flatnonzero(found.epoch == 1)[0] == 1800
    assert found.t[index] == log.t_rx[index]
    assert found.events[0][1] == f"vehicle 1 rebooted: boot clock 1059.900 -> 2.000 s, {silence} s of silence"


def test_a_small_sequence_number_is_a_witness():
    frames = [*steady(0, 60, 1000, (30,)), *steady(63, 64, -61, (30,))]
    log = script(frames)
    assert feed(log).epoch[-1] == 0  # one witness: a step
    log.seq[600:] = np.arange(10)
    log.seq[:600] = 100
    assert feed(log).epoch[-1] == 1


def test_a_step_of_the_whole_clock_is_no_reboot():
    log = script([*steady(0, 10, 600), *steady(10, 20, 598.5)])
    found = feed(log)
    assert found.epoch[-1] == 0 and found.segment[-1] == 1
    assert [text for _, text in found.events] == [
        "vehicle 1: boot clock stepped back without a reboot: 609.900 -> 608.500 s"
    ]


def test_a_straggler_changes_nothing():
    frames = steady(0, 20, 600)
    frames.insert(300, (10.0005, 30, 608.0))
    found = feed(script(frames))
    assert found.segment[-1] == 0
    assert not found.timed[300] and found.timed.sum() == len(frames) - 1
    assert "message 30 alone" in found.events[0][1]


def test_the_time_of_a_fix_is_no_witness():
    frames = steady(0, 20, 600)
    for k, t in enumerate((10.0, 10.001, 10.002)):
        frames.insert(300 + k, (t, (24, 124, 33)[k], 1.0))
    found = feed(script(frames))
    assert found.segment[-1] == 0 and not found.events


def test_a_fix_that_comes_first_after_a_reboot_belongs_to_it():
    log = script([*steady(0, 60, 1000), (70.0, 24, 3.9), *steady(70.01, 80, -66)])
    found = feed(log)
    assert found.epoch[1800] == 1 and found.restarted[1800] and found.epoch[-1] == 1


def test_a_message_type_that_lags_is_no_suspect():
    frames = sorted([*steady(0, 20, 600), *steady(5, 20, 590, (180,))])
    found = feed(script(frames))
    assert found.segment[-1] == 0 and not found.events


@pytest.mark.parametrize("kinds", [(30, SERVO, 27), (SERVO, 30), (SERVO,)])
@pytest.mark.parametrize("offset", [4250, 5000])
def test_wraps_of_one_message_type(kinds, offset):
    """The counter wraps under way, or has wrapped before the recording opens."""
    log = script(steady(0, 200, offset, kinds))
    found = feed(log)
    assert found.segment[-1] == 0
    said = ["vehicle 1: the counter of message 36 wrapped, the clock goes on: "] if offset < 4294 else []
    assert [text[: text.index("on: ") + 4] for _, text in found.events] == said
    np.testing.assert_allclose(found.t - log.t_rx, 0, atol=3 * MS)


@pytest.mark.parametrize("order", [(SERVO, 30, 27), (30, SERVO, 27)])
def test_a_reboot_is_not_taken_for_a_wrap(order):
    log = script([*steady(0, 60, 3000, order), *steady(66, 80, -62, order)])
    found = feed(log)
    assert found.epoch[-1] == 1 and found.restarted[1800]
    np.testing.assert_allclose(found.t - log.t_rx, 0, atol=3 * MS)


@pytest.mark.parametrize("speed", [10, 50])
def test_a_fast_replay(speed):
    log = script([*steady(0, 60, 1000), *steady(70, 80, -64), *steady(80, 90, -65.5)])
    log.t_rx //= speed
    found = feed(log)
    assert found.epoch[-1] == 1 and found.segment[-1] == 2


def test_hold_back_ends_with_receive_time_alone():
    log = script([*steady(0, 60, 1000, (30,)), (61.0, 30, 1050.0)])
    clock = BootClock(1)
    assert clock.feed(*log.cut(0, None)).decided == 600
    assert clock.feed(*log.cut(600, None), now=63 * SECOND).decided == 0
    found = clock.feed(*log.cut(600, None), now=63 * SECOND + 1)
    assert found.decided == 1 and found.segment[0] == 1


def test_hold_back_is_bounded():
    log = script([*steady(0, 60, 1000, (30,)), *steady(61, 62, 990, (30,), step=1e-3)])
    clock = BootClock(1)
    decided = clock.feed(*log.cut(0, None)).decided
    assert decided == len(log.t_boot)


@settings(max_examples=150, deadline=None)
@given(
    st.lists(
        st.tuples(
            st.sampled_from([1, 2, 30, 400, 2100, 15_000]),
            st.sampled_from([0, 30, 27, 29, SERVO, 24]),
            st.sampled_from([0.0] * 12 + [-0.4, -1.2, -1.6, -30.0, "reboot", "step", "wrap"]),
        ),
        min_size=1,
        max_size=120,
    ),
    st.lists(st.integers(0, 120), max_size=20),
)
def test_cutting_changes_nothing(stream, cuts):
    t, offset, frames = 10.0, 300.0, []
    for ms, kind, what in stream:
        t += ms * 1e-3
        if what == "reboot":
            offset = 2.0 - t
        elif what == "step":
            offset -= min(1.5, t + offset)
        elif what == "wrap":
            offset += 4000.0
        lag = what if isinstance(what, float) else 0.0
        frames.append((t, kind, None if kind == 0 else max(t + offset + lag, 1e-3)))
    log = script(frames)
    same(feed(log), feed(log, sorted(min(cut, len(frames)) for cut in cuts)))


def read(name):
    """The vehicle's frames of a tlog, decoded by pymavlink."""
    path = DATA / name
    if not path.exists():
        pytest.skip(f"{path} is not here")
    data, link, rows, i = path.read_bytes(), ardupilotmega.MAVLink(None), [], 0
    while i + 16 < len(data):
        head, body = data[i + 8], data[i + 9]
        length = {0xFD: 12 + 13 * (data[i + 10] & 1), 0xFE: 8}[head] + body
        frame = bytearray(data[i + 8 : i + 8 + length])
        if len(frame) < length:
            break
        t_rx = int.from_bytes(data[i : i + 8], "big")
        i += 8 + length
        message = link.decode(frame)
        if (message.get_srcSystem(), message.get_srcComponent()) != (1, 1):
            continue
        boot = getattr(message, "time_boot_ms", 0) * 1000 or getattr(message, "time_usec", 0)
        unix = getattr(message, "time_unix_usec", 0)
        rows.append((boot, message.get_msgId(), t_rx, message.get_seq(), unix))
    boot, kind, t_rx, seq, unix = np.array(rows, np.int64).T
    boot = np.where((boot > 0) & (boot < 10**15), boot * 1000, NO_TIME)
    modulus = np.where(kind == SERVO, UINT32_US, UINT32_MS)
    return Log(boot, kind.astype(np.int32), t_rx * 1000, seq.astype(np.uint8), modulus, unix * 1000)


@pytest.fixture(scope="module")
def copter():
    return read("copter_2015_4reboots.tlog")


@pytest.fixture(scope="module")
def quadplane():
    return read("sitl_quadplane_uavlogviewer_vtol.tlog")


def test_five_boots_of_a_copter(copter):
    found = feed(copter)
    assert [text for _, text in found.events] == [
        "vehicle 1 rebooted: boot clock 259.474 -> 15.986 s, 16 s of silence",
        "vehicle 1 rebooted: boot clock 84.275 -> 17.754 s, 22 s of silence",
        "vehicle 1 rebooted: boot clock 1188.048 -> 20.115 s, 45 s of silence",
        "vehicle 1 rebooted: boot clock 861.118 -> 13.772 s, 59 s of silence",
    ]
    assert found.epoch[-1] == found.segment[-1] == found.restarted.sum() == 4
    for epoch in range(5):  # no frame went to the wrong boot: the arrival delay is that of a radio
        mine = (found.epoch == epoch) & found.timed
        delay = copter.t_rx[mine] - found.t[mine]
        assert delay.max() - delay.min() < 3 * SECOND


def test_one_step_of_a_simulated_clock(quadplane):
    found = feed(quadplane)
    assert found.epoch[-1] == 0 and found.segment[-1] == 1
    assert [text for _, text in found.events] == [
        "vehicle 1: boot clock stepped back without a reboot: 611.982 -> 610.541 s"
    ]


@pytest.mark.parametrize("log", ["copter", "quadplane"])
def test_cutting_a_real_log(log, request):
    log = request.getfixturevalue(log)
    whole = feed(log)
    rng = np.random.default_rng(1)
    turns = np.flatnonzero(np.diff(whole.segment)) + 1
    near = (turns[:, None] + np.arange(-3, 4)).ravel()  # exactly at, before and inside every reboot
    same(whole, feed(log, near.tolist()))
    same(whole, feed(log, np.sort(rng.choice(len(log.t_boot), 500, replace=False)).tolist()))
    for turn in turns[:2]:
        window = Log(*(getattr(log, f.name)[turn - 300 : turn + 300] for f in dataclasses.fields(Log)))
        same(feed(window), feed(window, range(1, 600)))


def fits(log, cuts=()):
    """Last fit of each (epoch, reference), every row, and the moves."""
    found = feed(log)
    fitter = ClockFitter(1)
    for begin, end in pairwise([0, *cuts, len(log.t_boot)]):
        part = Epochs(end - begin, *(getattr(found, column)[begin:end] for column in COLUMNS), [])
        fitter.feed(part, log.t_rx[begin:end], log.unix[begin:end])
    fitter.finish()
    told = fitter.drain()
    said = [message for message in told if isinstance(message, ClockFit)]
    moves = [(int(m.t[0]), int(m.t_rx[0]), m.text[0]) for m in told if isinstance(m, Event)]
    last, rows = {}, []
    for message in said:
        for k, reference in enumerate(message.reference):
            fields = ("offset", "offset_sigma", "rate", "rate_sigma", "delay_p50", "delay_max", "span", "valid")
            last[message.boot, reference] = {name: float(getattr(message, name)[k]) for name in fields}
            rows.append(
                (
                    message.boot,
                    reference,
                    int(message.t[k]),
                    int(message.t_rx[k]),
                    *last[message.boot, reference].values(),
                )
            )
    return last, rows, moves


def test_rates_of_a_copter(copter):
    """Least squares says 251, -2946, -33, -163 and -868 ppm; the vehicle's own UTC agrees with the hull instead."""
    last, _, _ = fits(copter)
    arrival = [last[epoch, "arrival"]["rate"] * 1e6 for epoch in range(5)]
    assert np.all(np.abs(arrival) < [150, 700, 70, 80, 700])
    assert [last[epoch, "arrival"]["valid"] for epoch in range(5)] == [1, 1, 1, 1, 0]
    for epoch in (2, 3):  # twenty and fourteen minutes
        assert arrival[epoch] == pytest.approx(last[epoch, "system_time"]["rate"] * 1e6, abs=25)
    assert 0.2 < last[2, "arrival"]["delay_p50"] < 0.5 and 1 < last[2, "arrival"]["delay_max"] < 3


def test_the_fit_begins_anew_with_a_step(quadplane):
    last, _, _ = fits(quadplane)
    assert last[0, "arrival"]["offset"] == pytest.approx(-1, abs=0.6)
    assert abs(last[0, "arrival"]["rate"]) < 50e-6 and abs(last[0, "system_time"]["rate"]) < 5e-6


def test_fits_do_not_depend_on_the_cut(copter, quadplane):
    for log in (copter, quadplane):
        rng = np.random.default_rng(2)
        cuts = np.sort(rng.choice(len(log.t_boot), 700, replace=False)).tolist()
        assert repr(fits(log)) == repr(fits(log, cuts))


def radio(rng, span, rate, mean=0.08, hertz=10.0):
    """Frames with exponential delays, and a clock that is fast by rate."""
    t = np.arange(0, span, 1 / hertz)
    delay = rng.exponential(mean, len(t))
    arrival = np.round((1e6 + np.maximum.accumulate(t * (1 + rate) + delay)) * 1e9).astype(np.int64)
    count = len(t)
    zero = np.zeros(count, np.int64)
    return Log(
        np.round((t + 5) * 1e9).astype(np.int64), zero.astype(np.int32) + 30, arrival, zero.astype(np.uint8), zero, zero
    )


@pytest.mark.parametrize(("span", "ppm"), [(60.5, 40), (300, 1.5), (600, 0.5)])
def test_the_rate_and_its_sigma(span, ppm):
    """Delays of 80 ms at 10 Hz, in order: the rate errs by no more than a hull's, and by what it says."""
    rng = np.random.default_rng(6)
    errors, sigmas = [], []
    for _ in range(40):
        fit = fits(radio(rng, span, 50e-6))[0][0, "arrival"]
        errors.append(fit["rate"] - 50e-6)
        sigmas.append(fit["rate_sigma"])
    rms = float(np.sqrt(np.mean(np.square(errors))))
    assert rms < ppm * 1e-6
    assert 0.5 < rms / np.sqrt(np.mean(np.square(sigmas))) < 2


def test_delays_are_those_above_the_line():
    fit = fits(radio(np.random.default_rng(7), 600, -1e-4, mean=0.1))[0][0, "arrival"]
    assert fit["delay_p50"] == pytest.approx(0.1, rel=0.25)
    assert fit["delay_max"] > 0.5


def test_two_hours_fit_the_last_one():
    """The clock changes its rate after an hour: what is older is forgotten."""
    rng = np.random.default_rng(8)
    log = radio(rng, 2.2 * 3600, 0, hertz=4.0)
    bend = np.maximum((log.t_boot - log.t_boot[0]) - 3600 * SECOND, 0)
    log.t_rx = log.t_rx + (bend * 200e-6).astype(np.int64)
    fit = fits(log)[0][0, "arrival"]
    assert fit["rate"] == pytest.approx(200e-6, abs=1e-6)
    assert fit["span"] == pytest.approx(3605, abs=10)


def test_utc_outlives_a_jump():
    log = radio(np.random.default_rng(9), 300, 0)
    log.unix = log.t_boot + 10**18
    log.unix[:300] = 0  # before the first fix
    log.unix[300:400] += 2_300 * MS
    last, rows, _ = fits(log)
    fit = last[0, "system_time"]
    assert abs(fit["rate"]) < 1e-9
    anchor = int(log.t_rx[0] - log.t_boot[0])
    assert fit["offset"] == pytest.approx(10**9 - anchor * 1e-9, abs=1e-6)
    instants = np.array([row[3] for row in rows if row[1] == "arrival"]) - log.t_rx[0]
    np.testing.assert_array_equal(instants[:-1] % (10 * SECOND), 0)


def test_a_big_move_is_told():
    log = radio(np.random.default_rng(10), 200, 0)
    log.t_rx = log.t_rx + np.where(log.t_boot < 105 * SECOND, 100 * MS, 0)
    _, _, moves = fits(log)
    assert any("the clock fit to arrival moved time by -" in move[2] for move in moves)


def place(log, unix=None, **more):
    """Epochs of a whole log."""
    return BootClock(1).feed(*log.cut(0, None), unix=unix, flush=True, **more)


@pytest.mark.parametrize(("hertz", "jitter"), [(100, 0.0), (10, 0.02), (4, 0.24), (4, 0.0)])
def test_the_sigma_of_messages_without_a_time(hertz, jitter):
    """Untimed messages fall at random among timed ones; a link in order delays all of them alike, with stalls."""
    rng = np.random.default_rng(11)
    errors, sigmas = [], []
    for _ in range(10):
        timed = np.arange(0, 120, 1 / hertz)
        untimed = np.sort(rng.uniform(5, 119, 300))
        t = np.concatenate([timed, untimed])
        order = np.argsort(t, kind="stable")
        t = t[order]
        arrival = np.maximum.accumulate(t + (rng.exponential(jitter, len(t)) if jitter else 0.0))
        stall = (arrival > 60) & (arrival < 63)
        arrival[stall] = 63.0
        told = order < len(timed)
        log = script([(a, 30 if w else 74, x + 100 if w else None) for a, w, x in zip(arrival, told, t, strict=True)])
        found = place(log)
        anchor = found.t[told][0] - log.t_boot[told][0]
        truth = (t + 100) * 1e9 + anchor
        assert (found.sigma[told] == 0).all()
        errors.append((found.t[~told] - truth[~told]) * 1e-9)
        sigmas.append(found.sigma[~told] * 1e-9)
    z = np.concatenate(errors) / np.concatenate(sigmas)
    assert 0.8 < np.sqrt(np.mean(z**2)) < 1.25
    assert np.mean(np.abs(z) < 2) > 0.95
    assert np.median(np.concatenate(sigmas)) < 0.5 / hertz + 0.2 * jitter


def test_the_sigma_grows_with_the_silence_of_the_clock():
    frames = steady(0, 20, 600, (30,)) + [(20 + s, 74, None) for s in (0.05, 1.0, 5.0, 30.0)]
    found = place(script(frames))
    np.testing.assert_allclose(found.sigma[-4:] * 1e-9, np.array([0.15, 1.1, 5.1, 30.1]) / np.sqrt(12), rtol=0.02)


def test_before_any_clock_a_time_is_worth_a_second():
    found = place(script([(5.0, 74, None), (6.0, 74, None), *steady(7, 8, 0)]))
    assert found.t[:2].tolist() == [5 * SECOND, 6 * SECOND]
    assert found.sigma[:2].tolist() == [SECOND, SECOND]


@pytest.mark.parametrize("paired", [True, False])
def test_a_fix_that_tells_only_utc_is_placed_by_it(paired):
    """Fixes at 5 Hz, 0.15..0.35 s old when they come; SYSTEM_TIME at 1 Hz, or never."""
    rng = np.random.default_rng(12)
    rows = [(t, 30, t + 600, 0.0) for t in np.arange(0, 60, 0.05)]
    rows += [(t + 0.001, 2, t + 600.001, t + 0.001) for t in np.arange(1, 60, 1.0) if paired]
    fixes = np.arange(2, 59, 0.2)
    rows += [(t + 0.15 + rng.uniform(0, 0.2), 24, None, t) for t in fixes]
    rows.sort()
    log = script([row[:3] for row in rows])
    unix = np.array([round((u + 1.7e9) * 1e9) if u else 0 for *_, u in rows], np.int64)
    found = place(log, unix=unix)
    fix = log.kind == 24
    error = (found.t[fix] - (unix[fix] - round(1.7e9 * 1e9))) * 1e-9
    assert (found.sigma[fix] > 0).all()
    assert np.mean(np.abs(error) < 2 * found.sigma[fix] * 1e-9) > 0.95
    assert np.abs(error).max() < (0.002 if paired else 0.4)
    assert np.std(np.diff(found.t[fix][20:])) < 0.02e9, "evenly, as the receiver says"


def test_utc_of_another_day_is_not_believed():
    rows = [(t, 30, t + 600) for t in np.arange(0, 20, 0.1)] + [(20.0, 24, None)]
    unix = np.zeros(201, np.int64)
    unix[100], unix[200] = 1_700_000_010 * SECOND, 1_800_000_000 * SECOND
    found = place(script(rows), unix=unix)
    assert abs(found.t[200] - found.t[199]) < SECOND


@pytest.mark.parametrize(("kind", "turn"), [(SERVO, UINT32_US), (30, UINT32_MS)])
@pytest.mark.parametrize("silence", [0.1, 8.0])
def test_a_counter_that_wraps_in_a_silence(kind, turn, silence):
    seconds = turn / 1e9
    frames = [(t, seconds - 20 + t) for t in np.arange(0, 20, 0.1)] + [
        (t, t - 20) for t in np.arange(20 + silence, 40 + silence, 0.1)
    ]
    raw = np.array([round(b * 1e9) for _, b in frames], np.int64)
    raw[200:] = np.maximum(raw[200:], MS)
    t_rx = np.array([round(t * 1e9) for t, _ in frames], np.int64)
    count = len(frames)
    log = Log(
        raw, np.full(count, kind, np.int32), t_rx, np.arange(count).astype(np.uint8), np.full(count, turn), raw * 0
    )
    found = place(log)
    assert found.epoch[-1] == found.segment[-1] == 0
    np.testing.assert_allclose(np.diff(found.t), np.diff(t_rx), atol=2 * MS)
    assert sum("wrapped" in text for _, text in found.events) == 1


@pytest.mark.parametrize("after", [3.0, 30.0])
def test_a_reboot_soon_after_a_wrap(after):
    seconds = UINT32_MS / 1e9
    frames = [(t, 30 if i % 2 else 27, seconds - 20 + t) for i, t in enumerate(np.arange(0, 20, 0.1))]
    frames += [(t, 30 if i % 2 else 27, t - 20 + 0.05) for i, t in enumerate(np.arange(20, 20 + after, 0.1))]
    boot = 20 + after + 1.5
    frames += [(t, 30 if i % 2 else 27, t - boot + 0.9) for i, t in enumerate(np.arange(boot, boot + 20, 0.1))]
    log = script(frames)
    log.modulus[:] = UINT32_MS
    found = place(log)
    assert found.epoch[-1] == 1 and found.restarted.sum() == 1
    assert np.flatnonzero(found.epoch == 1)[0] == np.searchsorted(log.t_rx, boot * SECOND - MS)
    assert [("wrapped" in text, "rebooted" in text) for _, text in found.events] == [(True, False), (False, True)]


def test_swapped_frames_at_a_wrap():
    seconds = UINT32_US / 1e9
    frames = steady(0, 40, seconds - 20, (SERVO,))
    for i in (198, 199, 200, 201):
        frames[i], frames[i + 1] = (frames[i][0], *frames[i + 1][1:]), (frames[i + 1][0], *frames[i][1:])
    found = place(script(frames))
    assert found.segment[-1] == 0
    assert np.abs(found.t - np.sort(found.t)).max() < SECOND


def test_a_link_that_is_behind_is_followed_by_itself():
    """Two links 1.6 s apart, no frame over both: neither reboot nor step, from the first second of a boot on."""
    near, far = steady(0, 30, 1, (30, 27, 29)), steady(1.605, 31.605, -0.605, (30, 27, 29))
    rows = sorted([(*row, 0) for row in near] + [(*row, 1) for row in far])
    log = script([row[:3] for row in rows])
    link = np.array([row[3] for row in rows], np.uint8)
    copy = (link == 1) & (log.t_rx < 4 * SECOND)  # as long as both were fine
    found = place(log, link=link, copy=copy)
    assert found.segment[-1] == 0 and not found.events
    np.testing.assert_array_equal(found.t - log.t_boot, found.t[0] - log.t_boot[0])


def bursts(rng, span, rate):
    """Arrival of a radio that stalls: delays of 0.3 s rms in all, in bursts."""
    log = radio(rng, span, rate, mean=0.12)
    t = (log.t_rx - log.t_rx[0]).astype(float) * 1e-9
    for begin in rng.uniform(0, span, int(span / 20)):
        held = (t >= begin) & (t < begin + rng.uniform(0.5, 2.0))
        t[held] = t[held].max(initial=0)
    log.t_rx = np.maximum.accumulate(log.t_rx[0] + np.round(t * 1e9).astype(np.int64))
    return log


@pytest.mark.parametrize("span", [90, 300, 900])
def test_the_sigma_of_a_fit_is_honest_under_bursts(span):
    rng = np.random.default_rng(13)
    z, delays = [], []
    for _ in range(30):
        log = bursts(rng, span, 20e-6)
        fit = fits(log)[0][0, "arrival"]
        z.append((fit["rate"] - 20e-6) / fit["rate_sigma"])
        late = (log.t_rx - log.t_boot * (1 + 20e-6)) * 1e-9
        delays.append(np.std(late))
    assert 0.15 < np.mean(delays) < 0.5
    assert np.sqrt(np.mean(np.square(z))) < 1.6
    assert np.mean(np.abs(z) < 2) > 0.8


def test_what_changes_about_a_fit_is_told_once():
    log = radio(np.random.default_rng(14), 200, 0)
    log.unix = log.t_boot + 10**18
    log.unix[:500] = 0
    _, _, news = fits(log)
    texts = [text for _, _, text in news]
    for said in (
        "the clock fit to arrival is valid",
        "the clock fit to system_time is valid",
        "UTC comes from system_time",
    ):
        assert sum(said in text for text in texts) == 1, said


@pytest.mark.parametrize("hours", [0.002, 3.0])
def test_a_receive_clock_that_steps_forward_begins_the_fit_anew(hours):
    log = radio(np.random.default_rng(15), 600, 30e-6)
    log.t_rx = log.t_rx + np.where(log.t_boot > 305 * SECOND, round(hours * 3600e9), 0)
    last, _, news = fits(log)
    texts = [text for _, _, text in news]
    assert sum(f"the receive clock stepped forward by {hours * 3600:.1f} s" in text for text in texts) == 1
    assert sum("the clock fit to arrival is no longer valid" in text for text in texts) == 1
    fit = last[0, "arrival"]
    assert fit["valid"] and fit["rate"] == pytest.approx(30e-6, abs=5e-6)
