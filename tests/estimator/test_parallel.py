"""Many records at once: the same bits as one by one, in order, and an error says whose it is."""

import threading

import numpy as np
import pytest

import estimator.parallel
from estimator import LinearModel, Unobservable, smooth
from estimator.parallel import AHEAD, Record, processors, smooth_records
from tests.estimator.oracle import problem


def record(seed, steps=30, **kind):
    case = problem(seed, 2 + seed % 4, 2, 2, steps, **kind)
    return Record(case.model, case.z, case.x0, case.p0)


@pytest.mark.parametrize("threads", [1, 2, 5, None])
@pytest.mark.parametrize("options", [{}, {"window": 7, "want": ("std", "filtered")}, {"method": "rts"}])
def test_the_results_are_those_of_one_after_the_other_to_the_last_bit(threads, options):
    records = [record(seed, 10 + 7 * seed, missing=0.2, correlated=seed % 2 == 0) for seed in range(12)]
    together = smooth_records(records, threads=threads, **options)
    assert len(together) == 12
    for own, result in zip(records, together, strict=True):
        alone = smooth(own.model, own.z, x0=own.x0, p0=own.p0, **options)
        for a, b in zip(alone, result, strict=True):
            assert np.array_equal(a, b, equal_nan=True)


def test_records_may_share_one_model():
    rng = np.random.default_rng(5)
    model = LinearModel(0.9 * np.eye(3), np.eye(3), np.ones(3), rng.normal(size=(2, 3)), np.ones(2))
    records = [Record(model, rng.normal(size=(200, 2)), np.zeros(3), np.ones(3)) for _ in range(8)]
    for own, result in zip(records, smooth_records(records, threads=4), strict=True):
        alone = smooth(model, own.z, x0=own.x0, p0=own.p0)
        assert np.array_equal(result.mean, alone.mean) and np.array_equal(result.covariance, alone.covariance)


def test_a_record_without_prior_is_one_too():
    case = problem(1, prior=False)
    (result,) = smooth_records([Record(case.model, case.z)])
    assert np.array_equal(result.mean, smooth(case.model, case.z).mean)


def test_no_records_give_no_results():
    assert smooth_records([]) == [] and smooth_records(iter(()), threads=3) == []


@pytest.mark.parametrize("threads", [1, 3])
def test_records_of_a_generator_are_taken_as_they_are_needed(threads, monkeypatch):
    made, ended = 0, 0
    lock = threading.Lock()

    def counted(*arguments, **options):
        nonlocal ended
        result = smooth(*arguments, **options)
        with lock:
            ended += 1
        return result

    monkeypatch.setattr(estimator.parallel, "smooth", counted)

    def records():
        nonlocal made
        for seed in range(20):
            made += 1
            with lock:
                assert made - ended <= AHEAD * threads
            yield record(seed)

    assert len(smooth_records(records(), threads=threads)) == 20 == made


def test_threads_work_at_the_same_time(monkeypatch):
    # Every record waits for two others: with fewer threads than three nobody would ever get on.
    meeting = threading.Barrier(3, timeout=30)

    def waits(*arguments, **options):
        meeting.wait()
        return smooth(*arguments, **options)

    monkeypatch.setattr(estimator.parallel, "smooth", waits)
    assert len(smooth_records([record(seed) for seed in range(6)], threads=3)) == 6


@pytest.mark.parametrize("threads", [1, 2])
def test_an_error_keeps_its_type_and_says_which_record(threads):
    good = record(1)
    unseen = record(2, steps=1, prior=False)
    with pytest.raises(Unobservable) as caught:
        smooth_records([good, good, good, unseen, good], threads=threads)
    assert caught.value.__notes__ == ["in record 3"]
    assert caught.value.direction.shape == (4,)


def test_of_several_errors_the_first_in_order_is_raised():
    short = record(1)._replace(z=np.zeros((3, 2)))
    slow, unseen = record(2, steps=4000), record(2, steps=1, prior=False)
    with pytest.raises(ValueError, match="z has 3 rows, the model 30 steps") as caught:
        smooth_records([slow, short, unseen, short], threads=4)
    assert caught.value.__notes__ == ["in record 1"]


def test_after_an_error_no_more_records_are_begun(monkeypatch):
    begun = []

    def noted(model, z, **options):
        begun.append(len(z))
        return smooth(model, z, **options)

    monkeypatch.setattr(estimator.parallel, "smooth", noted)
    bad = record(2, steps=1, prior=False)
    made = []

    def records():
        for steps in (1, 20, 21, 22, 23, 24, 25, 26, 27):
            made.append(steps)
            yield bad if steps == 1 else record(3, steps=steps)

    with pytest.raises(Unobservable):
        smooth_records(records(), threads=1)
    assert len(made) == AHEAD and len(begun) <= AHEAD


def test_an_error_of_the_generator_is_its_own():
    def records():
        yield record(1)
        raise OSError("the disk is gone")

    with pytest.raises(OSError, match="the disk is gone") as caught:
        smooth_records(records())
    assert not hasattr(caught.value, "__notes__")


def test_at_least_one_thread_is_needed():
    with pytest.raises(ValueError, match="threads is 0: at least 1 is needed"):
        smooth_records([], threads=0)
    assert processors() >= 1


def test_one_folder_is_not_for_many_records(tmp_path):
    with pytest.raises(ValueError, match="spill is for one record"):
        smooth_records([], spill=tmp_path)
