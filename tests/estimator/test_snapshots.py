"""The store keeps what Table 5 counts, grows without copying much, and forgets on request."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimator import LinearModel, Rule, Store
from estimator.information import anchor, filter, start
from estimator.smoother import backward
from tests.estimator.oracle import problem


def sides(store, carry, **options):
    smoothed = backward(store, carry, **options)
    return smoothed.mean, smoothed.covariance


def filled(steps=40, seed=1, length=7):
    case = problem(seed, 4, 2, 2, steps, missing=0.2)
    store = Store()
    carry, _ = filter(case.model, start(4, **case.prior), case.z, rule=Rule(steps=length), store=store)
    return case, store, carry


def test_bytes_per_step_are_those_of_table_5():
    _, store, _ = filled()
    n, p = 4, 2
    assert store.bytes_per_step == 8 * (n * n + 2 * n * p + 2 * p)
    assert sum(field.nbytes for field in store.steps) == len(store) * store.bytes_per_step + 8 * n * n
    assert Store().bytes_per_step == 0


def test_windows_begin_where_they_should_and_say_why():
    _, store, carry = filled(40, length=7)
    assert len(store) == 40 and store.anchors == [0, 7, 14, 21, 28, 35]
    assert store.reasons == ["start"] + ["length"] * 5 and carry.steps == 5
    _, store, carry = filled(14, length=7)
    assert store.anchors == [0, 7, 14] and carry.steps == 0
    assert "14 steps" in repr(store)


@given(st.lists(st.tuples(st.integers(0, 30), st.floats(0.0, 1.0)), min_size=1, max_size=12))
@settings(max_examples=40, deadline=None)
def test_dropping_never_changes_what_is_left(parts):
    total = sum(count for count, _ in parts)
    case = problem(2, 3, 1, 1, total)
    model, rule = case.model, Rule(steps=9)
    store, all_kept = Store(), Store()
    carry = start(3, **case.prior)
    at = 0
    for count, share in parts:
        chunk, z = model.cut(at, at + count), case.z[at : at + count]
        filter(chunk, carry, z, rule=rule, store=all_kept)
        carry, _ = filter(chunk, carry, z, rule=rule, store=store)
        at += count
        store.drop(int(share * len(store)))
        gone = store.dropped
        assert gone + len(store) == at
        mean, covariance = sides(store, carry)
        full_mean, full_covariance = sides(all_kept, carry, first=gone)
        assert np.array_equal(mean, full_mean) and np.array_equal(covariance, full_covariance)
        assert store.anchors == [i - gone for i in all_kept.anchors if i >= gone]


def test_memory_is_bounded_by_what_is_held():
    case = problem(3, 4, 2, 2, 10)
    store, carry = Store(), start(4, **case.prior)
    for _ in range(400):
        carry, _ = filter(case.model, carry, case.z, store=store)
        store.drop(max(0, len(store) - 100))
    assert len(store) == 100 and store.dropped == 3900
    assert store.steps.phi.base.shape[0] <= 512


def test_a_mark_in_the_middle_is_a_window():
    case = problem(4, 4, 2, 2, 30)
    model, store = case.model, Store()
    carry, _ = filter(model.cut(0, 11), start(4, **case.prior), case.z[:11], store=store)
    carry, _ = filter(model.cut(11, 30), anchor(carry), case.z[11:], store=store)
    assert store.anchors == [0, 11] and store.reasons == ["start", "start"]


def test_a_fresh_store_may_begin_inside_a_window():
    case = problem(5, 4, 2, 2, 30)
    model, whole, late = case.model, Store(), Store()
    carry, _ = filter(model.cut(0, 11), start(4, **case.prior), case.z[:11], store=whole)
    filter(model.cut(11, 30), carry, case.z[11:], store=late)
    carry, _ = filter(model.cut(11, 30), carry, case.z[11:], store=whole)
    assert np.array_equal(backward(late, carry)[0], backward(whole, carry, first=11)[0])


def test_steps_that_do_not_follow_are_refused():
    case, store, carry = filled()
    other, _ = filter(case.model.cut(0, 9), start(4), case.z[:9])
    with pytest.raises(ValueError, match="carry is not the one that the newest step"):
        filter(case.model, other, case.z, store=store)
    wide = problem(1, 4, 3, 2, 5)
    with pytest.raises(ValueError, match="store holds 4 states and 2 noise components, the model has 4 states and 3"):
        filter(wide.model, carry, wide.z, store=store)
    with pytest.raises(IndexError, match="the store holds 40 steps"):
        store.drop(41)


def test_a_store_on_disk_is_a_store_in_memory(tmp_path):
    case = problem(6, 4, 2, 2, 100, missing=0.2)
    inside, outside, carry = Store(), Store(tmp_path / "steps", spill=16), start(4, **case.prior)
    for a in range(0, 100, 5):
        chunk, z = case.model.cut(a, a + 5), case.z[a : a + 5]
        filter(chunk, carry, z, rule=Rule(steps=9), store=inside)
        carry, _ = filter(chunk, carry, z, rule=Rule(steps=9), store=outside)
    assert len(list((tmp_path / "steps").glob("*.b.npy"))) == 4
    for first in (0, 3, 20, 41, 99, 100):
        a, b = backward(inside, carry, first=first, cross=True), backward(outside, carry, first=first, cross=True)
        assert all(np.array_equal(x, y) for x, y in zip(a, b, strict=True))
    assert all(np.array_equal(x, y) for x, y in zip(inside.steps, outside.steps, strict=True))
    outside.drop(45)
    assert len(list((tmp_path / "steps").glob("*.b.npy"))) == 2
    assert np.array_equal(sides(outside, carry)[0], sides(inside, carry, first=45)[0])


def test_steps_of_a_constant_model_are_looked_up_and_not_kept():
    case = problem(7, 4, 2, 2, 1)
    z = np.random.default_rng(0).normal(size=(70, 2))
    constant = LinearModel(case.phi[0], case.gamma[0], case.q[0], case.h[0], case.r[0])
    varying = LinearModel(*(np.repeat(a, 70, axis=0) for a in (case.phi, case.gamma, case.q, case.h, case.r)))
    table, rows, carry = Store(), Store(), start(4, **case.prior)
    end = carry
    for a in range(0, 70, 10):
        end, _ = filter(constant, end, z[a : a + 10], rule=Rule(steps=8), store=table)
    filter(varying, carry, z, rule=Rule(steps=8), store=rows)
    assert table.bytes_per_step == 8 * (4 * 2 + 2 * 2 + 1) < rows.bytes_per_step == 8 * (16 + 2 * 8 + 2 * 2)
    assert all(np.array_equal(a, b) for a, b in zip(table.steps, rows.steps, strict=True))
    for first in (0, 5, 33, 70):
        assert np.array_equal(sides(table, end, first=first)[1], sides(rows, end, first=first)[1])
    end, _ = filter(problem(8).model, end, problem(8).z, rule=Rule(steps=8), store=table)  # then another model
    assert len(table) == 90 and backward(table, end).mean.shape == (91, 4)


def test_stores_do_not_share_a_folder(tmp_path):
    case = problem(9, 4, 2, 2, 40)
    one, other, carry = Store(tmp_path, spill=10), Store(tmp_path, spill=10), start(4, **case.prior)
    half, _ = filter(case.model.cut(0, 20), carry, case.z[:20], store=one)
    filter(case.model.cut(0, 20), carry, case.z[:20], store=other)
    filter(case.model.cut(20, 40), half, case.z[20:], store=one)
    with pytest.raises(FileExistsError):
        filter(case.model.cut(20, 40), half, case.z[20:], store=other)
    with pytest.raises(FileExistsError, match="holds the steps of another store: choose an empty folder"):
        Store(tmp_path)
    with pytest.raises(ValueError, match="spill is 0: a block on disk has at least one step"):
        Store(spill=0)


def test_parts_of_a_block_go_to_disk_when_another_begins(tmp_path):
    case = problem(10, 4, 2, 2, 120)
    constant = LinearModel(case.phi[0], case.gamma[0], case.q[0], case.h[0], case.r[0])
    store, inside, carry = Store(tmp_path, spill=1000), Store(), start(4, **case.prior)
    for a in range(0, 120, 20):
        model = case.model.cut(a, a + 20) if a % 40 else constant
        filter(model, carry, case.z[a : a + 20], rule=Rule(steps=5), store=inside)
        carry, _ = filter(model, carry, case.z[a : a + 20], rule=Rule(steps=5), store=store)
    assert len(list(tmp_path.glob("steps-*.b.npy"))) == 5
    assert all(np.array_equal(a, b) for a, b in zip(backward(store, carry), backward(inside, carry), strict=True))


def test_a_call_that_fails_leaves_no_trace_in_a_fresh_store():
    store = Store()
    with pytest.raises(ValueError, match="phi is singular at step 0"):
        filter(LinearModel(np.zeros((2, 2)), np.eye(2), [1.0, 1.0], np.eye(2), [1.0, 1.0]), start(2), np.ones((3, 2)),
               store=store)  # fmt: skip
    case = problem(11)
    carry, _ = filter(case.model, start(4, **case.prior), case.z, store=store)
    assert len(store) == 20 and backward(store, carry).mean.shape == (21, 4)


def test_a_carry_of_other_records_or_numbers_is_refused():
    case = problem(12)
    store = Store()
    filter(case.model, start(4, **case.prior), case.z, store=store)
    with pytest.raises(ValueError, match="carry has 4 states of 3 records, the store 4 states"):
        backward(store, start(4, **case.prior, records=3))
    with pytest.raises(ValueError, match="carry has 4 states in float32, the store 4 states"):
        backward(store, start(4, **case.prior, dtype=np.float32))
