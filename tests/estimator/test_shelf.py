"""What sensors said is kept in a file without a name, and comes back as it was."""

from __future__ import annotations

import resource
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from estimator.stage.shelf import EVER, ROWS, Rows, Shelf


def said(rng, count, late):
    t = np.sort(rng.integers(-(10**9), 10**9, count)) + rng.integers(-late, late + 1, count)
    return Rows(t, t - rng.integers(0, 100, count), rng.normal(size=(count, 3)))


def cut(rows, edges):
    edges = [0, *sorted(min(edge, len(rows.t)) for edge in edges), len(rows.t)]
    return [Rows(*(c[a:b] for c in rows)) for a, b in pairwise(edges) if b > a]


@given(
    seed=st.integers(0, 99),
    count=st.integers(1, 4 * ROWS),
    edges=st.lists(st.integers(0, 4 * ROWS), max_size=6),
    span=st.tuples(st.integers(-(10**9), 10**9), st.integers(-(10**9), 10**9)),
)
def test_what_was_put_in_comes_back_in_order_of_arrival_whatever_the_parts(seed, count, edges, span):
    rows, shelf = said(np.random.default_rng(seed), count, 1000), Shelf(3)
    for part in cut(rows, edges):
        shelf.put(part)
    inside = (rows.t >= min(span)) & (rows.t <= max(span))
    found, times = shelf.rows(min(span), max(span)), shelf.times(min(span), max(span))
    for mine, theirs in zip(found, rows, strict=True):
        assert np.array_equal(mine, theirs[inside])
    assert np.array_equal(times[0], found.t) and np.array_equal(times[1], found.passed)


def test_one_that_was_taken_stays_as_it_was_and_outlives_the_other():
    rng, shelf = np.random.default_rng(1), Shelf(3)
    rows = said(rng, 3 * ROWS, 0)
    for part in cut(rows, [ROWS, 2 * ROWS + 5]):
        shelf.put(part)
    taken = shelf.so_far()
    shelf.put(said(rng, 2 * ROWS, 0))
    del shelf
    assert all(np.array_equal(mine, theirs) for mine, theirs in zip(taken.rows(), rows, strict=True))


def test_nothing_is_left_open():
    def files():
        return len(list(Path("/dev/fd").iterdir()))

    before = files()
    shelf = Shelf(3)
    shelf.put(said(np.random.default_rng(1), 2 * ROWS, 0))
    taken = shelf.so_far()
    assert files() == before + 1  # one, whoever reads it
    del shelf, taken
    assert files() == before


def test_where_nothing_can_be_written_everything_stays_in_memory():
    """In a process that may write no file, as where a disk is full."""
    text = (
        "import numpy as np, resource, signal\n"
        "from estimator.stage.shelf import ROWS, Rows, Shelf\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        f"resource.setrlimit(resource.RLIMIT_FSIZE, (8 * 5 * ROWS + 100, {resource.RLIM_INFINITY}))\n"
        "shelf = Shelf(3)\n"
        "t = np.arange(3 * ROWS)\n"
        "for k in range(3):\n"
        "    part = t[k * ROWS : (k + 1) * ROWS]\n"
        "    shelf.put(Rows(part, part, np.repeat(part[:, None], 3, axis=1).astype(float)))\n"
        "assert len(shelf._filed) == 1\n"
        "assert np.array_equal(shelf.rows().t, t) and np.array_equal(shelf.rows().z[:, 2], t)\n"
    )
    subprocess.run([sys.executable, "-c", text], check=True)


def test_memory_does_not_grow_with_what_is_kept():
    shelf = Shelf(3)
    for k in range(40):
        t = np.arange(k * ROWS, (k + 1) * ROWS)
        shelf.put(Rows(t, t, np.zeros((ROWS, 3))))
    assert not shelf._loose
    assert np.array_equal(shelf.times(39 * ROWS, EVER)[0], np.arange(39 * ROWS, 40 * ROWS))
