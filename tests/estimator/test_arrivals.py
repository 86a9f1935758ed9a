"""Which arrivals are believed: decided by those that follow, and by nothing else."""

from __future__ import annotations

import numpy as np

from estimator.arrivals import Arrivals
from estimator.synchronise import MARK, Rows

S = 1_000_000_000
FIX, OTHER = 0, 1


def rows(times, sensors=None, latitude=0.8):
    """Samples at times (s) that arrive one after the other; the first is a fix."""
    k = len(times)
    sensors = np.array([FIX] + [OTHER] * (k - 1) if sensors is None else sensors)
    z = np.tile([latitude, 0.2, 500.0], (k, 1))
    return Rows(np.array([round(t * S) for t in times]), np.arange(k), sensors, z, np.ones((k, 3)))


def judge(*batches):
    """Believed times by leg, and what was told."""
    arrivals = Arrivals(("fix", "other"), FIX, lag=300_000_000)
    legs, notes, until = [], [], 0
    for number, batch in enumerate(batches):
        arrivals.push(batch._replace(t_rx=batch.t_rx + until))
        until += len(batch.t)
        left = arrivals.covered(until - 1)
        while left is not None and len(left.t):
            piece = arrivals.judge(left, number == len(batches) - 1)
            left = piece.rest
            legs += [[]] if piece.origin is not None else []
            if legs:
                legs[-1] += (piece.rows.t / S).tolist()
            notes += [note.text for note in piece.notes]
    return legs, notes


def test_ordinary_arrivals_are_all_believed():
    times = [100, 99.9, 100.2, 98, 109, 110]
    assert judge(rows(times)) == ([times], [])


def test_a_leap_waits_for_the_next_arrival():
    assert judge(rows([100, 160]), rows([160.1, 160.2], [OTHER, OTHER])) == ([[100, 160, 160.1, 160.2]], [])
    told = ["a sample of other 60 s ahead of the others was left out"]
    assert judge(rows([100, 160]), rows([100.1], [OTHER])) == ([[100, 100.1]], told)
    assert judge(rows([100, 160])) == ([[100]], told)


def test_two_wild_times_that_differ_do_not_confirm_one_another():
    legs, notes = judge(rows([100, 160, 900, 100.1]))
    assert legs == [[100, 100.1]]
    assert len(notes) == 2


def test_a_mark_confirms_nothing_and_does_not_lie_ahead():
    legs, _ = judge(rows([100, 160, 160.1, 100.1], [FIX, OTHER, MARK, OTHER]))
    assert legs == [[100, 100, 100.1]]


def test_ten_old_arrivals_make_a_step_back_and_nine_do_not():
    old = [50 + 0.1 * i for i in range(10)]
    legs, notes = judge(rows([100, *old], [FIX] * 11))
    assert legs == [[100], old]
    assert notes == ["the vehicle clock stepped back by 50.0 s: the estimate begins anew"]
    assert judge(rows([100, *old[1:], 100.1], [FIX] * 11)) == ([[100, *old[1:], 100.1]], [])


def test_a_mark_waits_for_the_first_fix():
    assert judge(rows([90, 95, 100, 101], [MARK, OTHER, FIX, OTHER])) == ([[90, 100, 101]], [])


def test_one_far_fix_is_left_out_and_a_second_begins_anew():
    near, far = rows([100, 101], [FIX, FIX]), rows([102], [FIX], 0.9)
    legs, notes = judge(near, far, rows([103], [FIX]))
    assert legs == [[100, 101, 103]]
    assert notes == ["a fix 637 km from the origin was left out"]
    legs, _ = judge(near, far, rows([103, 104], [FIX, FIX], 0.9))
    assert legs == [[100, 101], [103, 104]]
