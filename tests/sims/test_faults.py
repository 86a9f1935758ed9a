"""A link's faults are seeded, counted, and add up."""

import collections
import itertools

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sims.faults import FaultError, Faults, apply, parse

# The number stands there three times, so that no corrupted frame passes for another one.
FRAMES = [(1_000_000_000 + 10_000_000 * k, 3 * k.to_bytes(4, "little")) for k in range(5000)]
EVERYTHING = "loss=0.02,outage=20:5,corrupt=0.01,duplicate=0.03,swap=0.02,seed=9"


def test_a_string_names_the_faults():
    faults = parse(" loss=0.02, outage=60:5,outage=90:1.5,corrupt=0.001,duplicate=0.01,swap=0.01,seed=7 ")
    assert faults == Faults(0.02, 0.001, 0.01, 0.01, ((60, 5), (90, 1.5)), 7)
    assert parse("") == Faults()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("lose=0.1", "unknown fault 'lose'; known: loss, corrupt, duplicate, swap, outage, seed"),
        ("loss", "fault 'loss' needs a value, as in loss=0.01"),
        ("loss=", "needs a value"),
        ("loss=much", "fault 'loss' cannot be 'much'; write loss=0.01"),
        ("loss=1.5", "probability from 0 to 1, not 1.5"),
        ("loss=nan", "probability from 0 to 1"),
        ("loss=-0.1", "probability"),
        ("outage=60", r"write outage=60:5 \(start:duration in seconds\)"),
        ("outage=60:-5", "lasts some time"),
        ("outage=60:inf", "lasts some time"),
        ("seed=x", "seed=7"),
        ("loss=0.6,swap=0.6", "add up to 1.2"),
    ],
)
def test_a_wrong_string_says_what_is_wrong(text, message):
    with pytest.raises(FaultError, match=message):
        parse(text)


def test_a_wrong_fault_is_refused_before_the_first_frame():
    with pytest.raises(FaultError):
        apply(FRAMES, Faults(loss=2.0))


def test_no_faults_change_nothing():
    for none in (None, "", Faults()):
        arriving, injected = apply(FRAMES, none)
        assert list(arriving) == FRAMES
        assert injected.offered == injected.delivered == len(FRAMES)


def test_the_same_seed_injects_the_same():
    one, two = (list(apply(FRAMES, EVERYTHING)[0]) for _ in range(2))
    assert one == two
    assert one != list(apply(FRAMES, parse(EVERYTHING)._replace(seed=10))[0])


def test_counts_say_what_the_receiver_sees():
    arriving, injected = apply(FRAMES, EVERYTHING)
    frames = [frame for _, frame in arriving]
    good = {frame for _, frame in FRAMES}
    seen = collections.Counter(frame for frame in frames if frame in good)
    assert injected.delivered == len(frames)
    assert injected.delivered == injected.offered - injected.lost - injected.outage + injected.duplicated
    assert sum(frame not in good for frame in frames) == injected.corrupted
    assert sum(count - 1 for count in seen.values()) == injected.duplicated
    assert len(FRAMES) - len(seen) == injected.lost + injected.outage + injected.corrupted
    numbers = [int.from_bytes(frame[:4], "little") for frame in frames if frame in good]
    assert sum(b < a for a, b in itertools.pairwise(numbers)) == injected.swapped
    assert injected.outage == 500
    expected = (5000 - 500) * 0.02
    assert injected.lost == pytest.approx(expected, abs=5 * expected**0.5)
    assert min(injected.corrupted, injected.duplicated, injected.swapped) > 0


def test_an_outage_is_silent_for_exactly_its_time():
    times = [t for t, _ in apply(FRAMES, "outage=10:2.5")[0]]
    assert not [t for t in times if 11_000_000_000 <= t < 13_500_000_000]
    assert 13_500_000_000 in times
    assert 10_990_000_000 in times


@settings(max_examples=60, deadline=None)
@given(
    rates=st.tuples(*[st.floats(0, 0.25)] * 4),
    outages=st.lists(st.tuples(st.floats(0, 5), st.floats(0.01, 1)), max_size=2),
    n=st.integers(0, 300),
    seed=st.integers(0, 99),
)
def test_whatever_the_faults_time_runs_forward_and_counts_add_up(rates, outages, n, seed):
    arriving, injected = apply(FRAMES[:n], Faults(*rates, outage=tuple(outages), seed=seed))
    arrived = list(arriving)
    assert [t for t, _ in arrived] == sorted(t for t, _ in arrived)
    assert injected.offered == n
    assert len(arrived) == injected.delivered == n - injected.lost - injected.outage + injected.duplicated
