"""Steps in the order of measurement, whatever the order of arrival and however it was cut."""

from __future__ import annotations

import itertools

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from estimator.synchronise import Rows, Steps, Synchroniser

MS = 1_000_000


def rows(samples, m=3):
    """Samples (t ms, t_rx ms, sensor, value); the sensor measures the component of its number."""
    t, t_rx, sensor, value = (np.array(column) for column in zip(*samples, strict=True))
    z = np.full((len(samples), m), np.nan)
    z[np.arange(len(samples)), sensor] = value
    return Rows(t * MS, t_rx * MS, sensor, z, np.full((len(samples), m), 2.0))


def synchroniser(lag=100, grid=10_000):
    return Synchroniser(3, 3, lag=lag * MS, grid=grid * MS)


def times(steps: Steps) -> list[int]:
    return (steps.t // MS).tolist()


def test_samples_leave_in_the_order_of_their_time():
    s = synchroniser()
    s.push(rows([(10, 1, 0, 1.0), (5, 2, 1, 2.0), (20, 3, 0, 3.0)]))
    steps = s.release(10 * MS, final=True)
    assert times(steps) == [5, 10, 20]
    np.testing.assert_allclose(steps.dt, [0, 0.005, 0.010])


def test_they_wait_until_older_ones_are_no_longer_expected():
    s = synchroniser(lag=100)
    s.push(rows([(1000, 1, 0, 1.0), (1090, 2, 0, 1.0)]))
    assert times(s.release(2 * MS)) == []
    s.push(rows([(1150, 3, 0, 1.0)]))
    assert times(s.release(3 * MS)) == [1000]


def test_samples_of_one_time_make_one_step():
    s = synchroniser()
    s.push(rows([(10, 1, 0, 1.0), (10, 2, 2, 3.0)]))
    steps = s.release(9 * MS, final=True)
    assert times(steps) == [10]
    np.testing.assert_array_equal(steps.z, [[1, np.nan, 3]])
    assert steps.used.tolist() == [[1, 0, 1]]
    assert steps.t_rx[0] == 2 * MS


def test_of_two_samples_of_one_sensor_at_one_time_the_first_counts():
    s = synchroniser()
    s.push(rows([(10, 2, 0, 8.0), (10, 1, 0, 7.0)]))
    assert s.release(9 * MS, final=True).z[0, 0] == 7


def test_what_has_not_been_covered_is_not_looked_at():
    s = synchroniser()
    s.push(rows([(10, 1, 0, 1.0), (500, 5, 0, 1.0)]))
    assert times(s.release(4 * MS)) == []
    assert times(s.release(5 * MS)) == [10]


def test_a_late_sample_is_counted_and_left_out():
    s = synchroniser(lag=100)
    s.push(rows([(1000, 1, 0, 1.0), (1200, 2, 0, 1.0), (1050, 3, 1, 9.0)]))
    steps = s.release(9 * MS, final=True)
    assert times(steps) == [1000, 1200]
    assert steps.late == [(1100 * MS + 1, 1)]


def test_a_mark_is_ordered_like_a_sample_but_is_never_late():
    s = synchroniser(lag=100)
    s.push(rows([(1000, 1, 0, 1.0), (1200, 4, 0, 1.0)]))
    assert s.mark(1050 * MS, 2 * MS) == 0
    assert s.mark(900 * MS, 5 * MS) == 1
    steps = s.release(9 * MS, final=True)
    assert steps.marks == [(1050 * MS, 0), (1100 * MS + 1, 1)]
    assert times(steps) == [1000, 1200]


def test_a_mark_makes_no_sample_late():
    s = synchroniser(lag=100)
    s.push(rows([(1000, 1, 0, 1.0), (1050, 3, 0, 1.0)]))
    s.mark(5000 * MS, 2 * MS)
    steps = s.release(9 * MS, final=True)
    assert times(steps) == [1000, 1050]
    assert not steps.late


def test_a_mark_in_a_silence_leaves_with_the_sample_that_ends_it():
    s = synchroniser(lag=100, grid=500)
    s.push(rows([(0, 1, 0, 1.0), (2000, 3, 0, 1.0)]))
    s.mark(700 * MS, 2 * MS)
    assert not s.release(3 * MS).marks
    s.push(rows([(2200, 4, 0, 1.0)]))
    steps = s.release(4 * MS)
    assert (times(steps), steps.marks) == ([500, 1000, 1500, 2000], [(700 * MS, 0)])


def test_a_silence_is_filled_so_that_it_is_seen():
    s = synchroniser(grid=500)
    s.push(rows([(0, 1, 0, 1.0), (400, 2, 0, 1.0), (2100, 3, 0, 1.0)]))
    steps = s.release(9 * MS, final=True)
    assert times(steps) == [0, 400, 900, 1400, 1900, 2100]
    assert steps.silent.tolist() == [False, False, True, True, True, False]
    np.testing.assert_allclose(steps.silence, [0, 0.4, 1.7, 1.7, 1.7, 1.7])
    assert np.isnan(steps.z[2:5]).all()
    assert not steps.used[2:5].any()


def test_a_silence_of_days_does_not_fill_memory():
    s = synchroniser(grid=500)
    s.push(rows([(0, 1, 0, 1.0), (3 * 86_400_000, 2, 0, 1.0)]))
    steps = s.release(9 * MS, final=True)
    assert len(steps.t) == 2002
    assert (np.diff(steps.t) > 0).all()


arrivals = st.lists(
    st.tuples(st.integers(-300, 300), st.integers(0, 40), st.integers(0, 3), st.booleans()), min_size=1, max_size=60
)


@given(arrivals, st.lists(st.integers(0, 60), max_size=6))
@settings(max_examples=300, deadline=None)
def test_batches_do_not_change_the_steps(arrived, cuts):
    """Each sample: offset of its time, receive interval, sensor (3: a mark)."""
    now, stream = 0, []
    for offset, gap, sensor, _ in arrived:
        now += gap
        stream.append((20 * now + offset, now, sensor))

    def run(edges):
        s = synchroniser(lag=150, grid=400)
        found = []
        for a, b in itertools.pairwise(edges):
            for t, t_rx, sensor in stream[a:b]:
                if sensor == 3:
                    s.mark(t * MS, t_rx * MS)
                else:
                    s.push(rows([(t, t_rx, sensor, float(t))]))
            # a batch covers a receive time only when all of it has been said
            last = stream[b - 1][1] if b else 0
            covered = last if b == len(stream) or stream[b][1] > last else last - 1
            found.append(s.release(covered * MS, final=b == len(stream)))
        return found

    whole = run([0, len(stream)])[0]
    parts = run(sorted({0, len(stream), *(c for c in cuts if c < len(stream))}))
    for name in ("t", "t_rx", "dt", "silence", "silent", "z", "r", "used"):
        np.testing.assert_array_equal(
            np.concatenate([getattr(p, name) for p in parts]), getattr(whole, name), err_msg=name
        )
    assert [m[0] for p in parts for m in p.marks] == [m[0] for m in whole.marks]
    assert sorted(x for p in parts for x in p.late) == sorted(whole.late)


def adaptive(lag=300, least=5):
    return Synchroniser(2, 3, lag=lag * MS, grid=10_000 * MS, least=least * MS)


def stream(until, late=0, period=10, begin=1000):
    """Sensor 0 in time every `period` ms, sensor 1 every 100 ms and `late` ms behind; in the order of arrival."""
    prompt = [(t, t, 0, 1.0) for t in range(begin, until, period)]
    behind = [(t, t + late, 1, 1.0) for t in range(begin, until, 100)]
    return sorted(prompt + behind, key=lambda sample: sample[1])


def released(s, samples):
    """How long each step waited after its own time (ms), released arrival by arrival."""
    waited = {}
    late = 0
    for sample in samples:
        s.push(rows([sample]))
        steps = s.release(sample[1] * MS)
        late += len(steps.late)
        waited |= dict.fromkeys(times(steps), sample[1])
    return {t: at - t for t, at in waited.items()}, late


def test_the_lag_falls_to_the_least_where_nothing_is_late():
    waited, late = released(adaptive(), stream(40_000))
    assert late == 0
    assert all(wait == 300 for t, wait in waited.items() if t < 3_600)
    assert max(wait for t, wait in waited.items() if t > 5_000) <= 10


def test_the_lag_stays_a_little_more_than_the_latest_sample():
    waited, late = released(adaptive(), stream(40_000, late=83))
    assert late == 0
    assert all(83 <= wait <= 120 for t, wait in waited.items() if t > 5_000)


def test_what_is_late_for_the_first_time_is_told_and_is_waited_for_from_then_on():
    early, later = stream(40_000), stream(60_000, late=150, begin=40_000)
    s = adaptive()
    _, late = released(s, early)
    assert late == 0
    waited, late = released(s, sorted(later, key=lambda sample: sample[1]))
    assert late == 2, "the second had been passed when the first came"
    assert {t for t, _, sensor, _ in later if sensor == 1} <= set(waited) | set(range(59_700, 60_000))


def test_time_passes_with_the_sensors_that_make_no_steps():
    s = Synchroniser(1, 3, lag=20 * MS, grid=10_000 * MS)
    s.push(rows([(1000, 1, 0, 1.0), (1019, 2, 1, 1.0)]))
    assert times(s.release(2 * MS)) == []
    s.push(rows([(1020, 3, 1, 1.0)]))
    steps = s.release(3 * MS)
    assert times(steps) == [1000] and steps.used.tolist() == [[1]]
    s.push(rows([(1000, 4, 1, 1.0)]))
    assert not s.release(4 * MS).late


@given(
    samples=st.lists(st.tuples(st.integers(0, 60_000), st.integers(0, 40), st.integers(0, 2)), min_size=1, max_size=40),
    cuts=st.lists(st.integers(0, 60), max_size=6),
)
@settings(max_examples=60, deadline=None)
def test_a_lag_that_follows_the_samples_does_not_depend_on_the_cuts(samples, cuts):
    ordered = sorted((t, 1 + i, sensor, float(i)) for i, (t, _, sensor) in enumerate(samples))
    arriving = [(t, k + 1, sensor, value) for k, (t, _, sensor, value) in enumerate(ordered[::-1] + ordered)]
    whole = adaptive()
    whole.push(rows(arriving))
    once = whole.release(len(arriving) * MS)
    pieces = adaptive()
    got, late = [], []
    for sample in arriving:
        pieces.push(rows([sample]))
        if sample[1] in cuts or sample is arriving[-1]:
            steps = pieces.release(sample[1] * MS)
            got += times(steps)
            late += steps.late
    assert got == times(once) and late == once.late
