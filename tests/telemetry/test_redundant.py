"""A frame over two links is used once and counted on both; a link that is behind upsets neither clock nor boots."""

from __future__ import annotations

from collections import defaultdict
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from telemetry.frames import scan_datagrams
from telemetry.ingest import ingest
from telemetry.mavlink import Dialect
from telemetry.messages import Altitude, Attitude, Event, LinkStats
from telemetry.redundant import DUPLICATE, FIRST, REDUNDANT, Copies
from tests.telemetry.test_ingest import assert_same, columns
from tests.telemetry.wire import Sender

DIALECT = Dialect()
US = 1_700_000_000_000_000
S = 1_000_000


def frames(arrivals):
    """Frames of (us, link, bytes) rows."""
    us, links, pieces = zip(*arrivals, strict=True)
    bounds = np.cumsum([0] + [len(piece) for piece in pieces])
    data = np.frombuffer(b"".join(pieces), np.uint8)
    t_rx = np.array(us, np.int64) * 1000
    return scan_datagrams(data, bounds, t_rx, np.array(links, np.uint8), DIALECT.crc_extra)


def tell(arrivals, links=2):
    return Copies(links).tell(frames(arrivals))[0].tolist()


def run(arrivals, cuts=(), links=("near", "far")):
    edges = [0, *sorted(min(cut, len(arrivals)) for cut in cuts), len(arrivals)]
    batches = [frames(arrivals[a:b]) for a, b in pairwise(edges) if b > a]
    return list(ingest(batches, links, DIALECT))


def said(messages):
    return [text for m in messages if isinstance(m, Event) for text in m.text]


def stats(messages, source):
    return next(m for m in reversed(messages) if isinstance(m, LinkStats) and m.source == source)


def flight(seconds, *, boot_ms=5000, begin=0, sender=None, step_us=50_000):
    """What a vehicle says at 20 Hz: (us, bytes), every frame unlike any other."""
    sender = sender or Sender()
    out = []
    for i in range(int(seconds * S / step_us)):
        us, ms = begin + i * step_us, boot_ms + i * step_us // 1000
        out.append((US + us, sender.attitude(ms, roll=i * 1e-4)))
        out.append((US + us + 8, sender.pressure(ms, 900 + i * 1e-3)))
    return out


def over(said_, link, lag=0, keep=lambda i: True):
    return [(us + lag, link, data) for i, (us, data) in enumerate(said_) if keep(i)]


def test_the_first_arrival_is_used_and_the_copy_is_counted():
    data = Sender().attitude(1000)
    assert tell([(US, 0, data), (US + 500, 1, data)]) == [FIRST, REDUNDANT]
    assert tell([(US, 1, data), (US + 500, 0, data)]) == [FIRST, REDUNDANT]


def test_the_same_frame_twice_over_one_link_is_a_duplicate():
    data = Sender().attitude(1000)
    assert tell([(US, 0, data), (US + 8, 0, data), (US + 12, 1, data), (US + 16, 1, data)]) == [
        FIRST,
        DUPLICATE,
        REDUNDANT,
        DUPLICATE,
    ]


def test_three_links_bring_two_copies():
    data = Sender().attitude(1000)
    assert tell([(US + 4 * i, i, data) for i in range(3)], links=3) == [FIRST, REDUNDANT, REDUNDANT]


def test_a_frame_that_comes_again_after_256_is_a_new_one():
    """255 other frames, then the same heartbeat under the same number: new on its link, and a copy on the other."""
    sender = Sender()
    sent = []
    for turn in range(3):
        sent.append(sender.heartbeat())
        sent += [sender.attitude(1000 + turn * 1000 + i) for i in range(255)]
    near = [(US + 4000 * i, 0, data) for i, data in enumerate(sent)]
    far = [(US + 1_500_000 + 4000 * i + 2, 1, data) for i, data in enumerate(sent)]
    found = tell(sorted(near + far))
    assert found.count(FIRST) == found.count(REDUNDANT) == len(sent)
    assert tell(near) == [FIRST] * len(sent)


def test_a_copy_that_comes_later_than_the_window_is_not_known_any_more():
    data = Sender().attitude(1000)
    assert tell([(US, 0, data), (US + 10 * S, 1, data)]) == [FIRST, REDUNDANT]
    assert tell([(US, 0, data), (US + 10 * S + 4, 1, data)]) == [FIRST, FIRST]


def test_mavlink_1_and_2_are_never_the_same():
    assert tell([(US, 0, Sender(version=1).attitude(1000)), (US + 4, 1, Sender().attitude(1000))]) == [FIRST, FIRST]


def test_other_bytes_under_the_same_number_are_another_frame():
    assert tell([(US, 0, Sender().attitude(1000)), (US + 4, 1, Sender().attitude(1001))]) == [FIRST, FIRST]
    assert tell([(US, 0, Sender(1).attitude(1000)), (US + 4, 1, Sender(2).attitude(1000))]) == [FIRST, FIRST]


def test_a_flood_of_equal_frames_is_looked_through_in_bounded_time():
    """Numbers that run in circles make each of them a new one; nothing is searched longer for it."""
    raw = [Sender(seq=seq).heartbeat() for seq in (0, 64, 128, 192)]
    found = tell([(US + 4 * i, 0, raw[i % 4]) for i in range(200_000)])
    assert set(found) == {FIRST}


arrivals = st.lists(
    st.tuples(st.integers(0, 12), st.integers(0, 2), st.sampled_from([4, 1000, 400_000, 3_000_000])), max_size=80
)


@given(arrivals, st.lists(st.integers(0, 80), max_size=6))
@settings(max_examples=60, deadline=None)
def test_agrees_with_a_slow_reference_however_it_is_cut(stream, cuts):
    """The reference knows the frames by name: of a name, the first within 10 s is used, and no link brings two."""
    named = {name: Sender(seq=name * 3).attitude(1000 + name) for name in range(13)}
    us, rows, expected = US, [], []
    last: dict = defaultdict(list)  # name -> [(us, links it came over)]
    for name, link, step in stream:
        us += step
        rows.append((us, link, named[name]))
        seen = [entry for entry in last[name] if us - entry[0] <= 10 * S]
        if any(link == on for entry in seen for on in [entry[1]]):
            expected.append(DUPLICATE)
            continue
        originals = [entry for entry in seen if entry[2] == FIRST]
        expected.append(REDUNDANT if originals else FIRST)
        last[name].append((us, link, expected[-1]))
    if not rows:
        return
    assert tell(rows, links=3) == expected
    copies, edges = Copies(3), [0, *sorted(min(cut, len(rows)) for cut in cuts), len(rows)]
    parts = [copies.tell(frames(rows[a:b]))[0] for a, b in pairwise(edges) if b > a]
    assert np.concatenate(parts).tolist() == expected


@pytest.mark.parametrize("lag", [0, 40_000, 1_500_000, 1_900_000])
def test_two_links_make_one_stream_of_samples(lag):
    sent = flight(20)
    alone = run(over(sent, 0), links=("near",))
    both = run(sorted(over(sent, 0) + over(sent, 1, lag + 4)))
    for kind in (Attitude, Altitude):
        one, two = ([m for m in some if isinstance(m, kind)] for some in (alone, both))
        assert {m.source for m in two} == {"near/1"}
        assert np.array_equal(np.concatenate([m.t for m in one]), np.concatenate([m.t for m in two]))
    near, far = stats(both, "near/1"), stats(both, "far/1")
    assert (near.received[-1], near.redundant[-1], near.lost[-1]) == (800, 0, 0)
    assert (far.received[-1], far.redundant[-1], far.lost[-1]) == (800, 800, 0)
    assert not [text for text in said(both) if "clock" in text or "reboot" in text]


@pytest.mark.parametrize("lag", [300_000, 1_500_000, 1_900_000])
def test_what_one_link_loses_the_other_brings(lag):
    """Each loses a third of the frames, and others than the other does; the far one is behind from the first second."""
    rng = np.random.default_rng(4)
    sent = flight(30)
    fate = rng.integers(0, 3, len(sent))
    both = run(sorted(over(sent, 0, 0, lambda i: fate[i] != 0) + over(sent, 1, lag + 4, lambda i: fate[i] != 1)))
    rolls = np.concatenate([m.phi for m in both if isinstance(m, Attitude)])
    assert sorted(np.round(rolls * 1e4).astype(int).tolist()) == list(range(600)), "each once, none twice"
    times = {m.boot for m in both if isinstance(m, Attitude)}
    assert times == {0}
    assert not [text for text in said(both) if "clock" in text or "reboot" in text]
    assert stats(both, "far/1").redundant[-1] == (fate == 2).sum()
    t = np.sort(np.concatenate([m.t for m in both if isinstance(m, Attitude)]))
    assert (np.diff(t) == 50_000_000).all()


@pytest.mark.parametrize("silence", [1, 20])
@pytest.mark.parametrize("lag", [300_000, 1_500_000])
def test_a_reboot_over_two_links_is_one_reboot(silence, lag):
    """The far link still brings frames of before, some of them only it, when the near one shows the reboot."""
    rng = np.random.default_rng(5)
    before = flight(60)
    after = flight(30, boot_ms=900, begin=(60 + silence) * S, sender=Sender())
    kept = rng.integers(0, 3, len(before))
    near = over(before, 0, 0, lambda i: kept[i] != 0) + over(after, 0)
    far = over(before, 1, lag + 4) + over(after, 1, lag + 4)
    messages = run(sorted(near + far))
    assert sum("rebooted" in text for text in said(messages)) == 1
    assert {m.boot for m in messages if isinstance(m, Attitude)} == {0, 1}
    for m in messages:
        if isinstance(m, Attitude):
            shown = m.t - (m.t[0] if len(m.t) else 0)
            assert shown.max() < 61 * 10**9
    for source in ("near/1", "far/1"):
        assert stats(messages, source).restarted[-1] == 1
    lost = sum("brings samples of before the reboot" in text for text in said(messages))
    assert lost == (silence == 1 and lag > S), "said once if any came too late"
    assert stats(messages, "far/1").lost[-1] == 0


@given(st.lists(st.integers(0, 2500), max_size=8), st.sampled_from([0, 300_000, 1_700_000]))
@settings(max_examples=15, deadline=None)
def test_batches_do_not_change_what_two_links_say(cuts, lag):
    rng = np.random.default_rng(6)
    sent = flight(20) + flight(10, boot_ms=700, begin=21 * S, sender=Sender())
    fate = rng.integers(0, 4, len(sent))
    rows = sorted(over(sent, 0, 0, lambda i: fate[i] != 0) + over(sent, 1, lag + 4, lambda i: fate[i] != 1))
    assert_same(columns(run(rows, cuts)), columns(run(rows)))


def test_a_frame_of_an_unknown_id_is_counted_per_sender():
    sender = Sender()
    sent = [(US, sender.attitude(1)), (US + 4, sender.unknown()), (US + 8, sender.attitude(2))]
    messages = run(over(sent, 0) + over(sent, 1, 100))
    assert [stats(messages, s).unknown[-1] for s in ("near/1", "far/1")] == [1, 1]
    assert [stats(messages, s).redundant[-1] for s in ("near/1", "far/1")] == [0, 3]
