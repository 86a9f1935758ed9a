"""A record longer than memory is smoothed in the memory of a few of its blocks, and its sigmas are honest."""

import subprocess
import sys

import numpy as np
import pytest

import bench
from sims.experiments import long_record


def test_batches_are_one_record_whatever_its_length():
    short, long = (list(long_record.batches(steps)) for steps in (100, long_record.BATCH + 50))
    assert [z.shape for _, z, _ in long] == [(long_record.BATCH, long_record.M), (50, long_record.M)]
    assert short[0][0].steps == 100 and np.isfinite(short[0][2]).all()


def test_memory_does_not_grow_with_the_record(tmp_path):
    # In a process of its own: peak memory is that of everything a process has ever done.
    code = (
        "import sys; from pathlib import Path; from sims.experiments.long_record import run; "
        "told = run(int(sys.argv[1]), Path(sys.argv[2])); print(told.disk, told.memory, told.error, told.windows)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, "120000", str(tmp_path)], capture_output=True, text=True, timeout=240, check=True
    )
    disk, memory, error, windows = (float(word) for word in done.stdout.split())
    assert disk > 0.9 * 120_000 * 8 * (12 * 12 + 2 * 12 * 6 + 2 * 6)  # all but the block still in memory
    assert memory < 0.5 * disk  # blocks in memory, not the record
    assert abs(error - 1.0) < 0.01
    assert windows == 120_000 / 100  # and none that begins where the record ends


def test_an_earlier_record_is_left_alone(tmp_path):
    first = long_record.run(100, tmp_path)
    before = sorted(path.name for path in tmp_path.rglob("*"))
    assert first.windows == 1 and first.steps == 100
    with pytest.raises(FileExistsError, match="holds an earlier record: choose a new or an empty folder"):
        long_record.run(50, tmp_path)
    assert sorted(path.name for path in tmp_path.rglob("*")) == before


def test_as_few_steps_as_tell_the_states_are_enough_and_fewer_are_refused():
    assert np.isfinite(long_record.run(long_record.FEWEST).error)
    with pytest.raises(ValueError, match="steps is 3: 12 states need 4 steps of 3 measurements at least"):
        long_record.run(3)
    with pytest.raises(ValueError, match="--steps is 3: at least 4 are needed, 3 measurements each for 12 states"):
        bench.long(steps=3)
