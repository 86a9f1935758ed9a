"""Moving coordinates: worked out step by step or looked up, they are the same bits; the condition number is near."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimator import LinearModel, Rule, coordinates, ud
from estimator.information import filter, start
from tests.estimator.oracle import problem

seeds = st.integers(0, 2**32 - 1)


def moved(model, rule, steps):
    n, p = model.n, model.p
    ends, es, closed = np.empty((steps, n, n)), np.empty((steps, p, n)), np.empty(steps, np.uint8)
    left, singular = coordinates.move(
        model.phi, model.gamma, np.eye(n), 0, rule.steps, rule.kappa, rule.scales(n), model.eps, ends, es, closed
    )
    return ends, es, closed, left, singular


def constant(seed, n=4, growth=1.0):
    case = problem(seed, n, 2, 3, 1, growth=growth)
    return LinearModel(case.phi[0], case.gamma[0], case.q[0], case.h[0], case.r[0])


@given(seeds, st.integers(1, 12), st.sampled_from([0.0, 2.0, 4.0]))
@settings(max_examples=60, deadline=None)
def test_the_estimated_condition_number_is_a_close_lower_bound(seed, n, spread):
    rng = np.random.default_rng(seed)
    u, v = (np.linalg.qr(rng.normal(size=(n, n)))[0] for _ in range(2))
    a, scale = u * np.exp(spread * rng.normal(size=n)) @ v, np.exp(rng.normal(size=n))
    lu, order = np.empty((n, n)), np.empty(n, np.int64)
    ud.factor(a, lu, order)
    scaled = a * scale / scale[:, None]
    exact = np.linalg.cond(scaled, np.inf)
    estimate = coordinates.condition(a, lu, order, scale, np.empty((4, n)))
    assert exact / 10.0 <= estimate <= exact * (1.0 + 1e-12 + 1e-15 * exact)


def test_the_condition_number_of_a_diagonal_matrix_is_exact():
    a, n = np.diag([1e3, 1.0, 1e-3]), 3
    lu, order = np.empty((n, n)), np.empty(n, np.int64)
    ud.factor(a, lu, order)
    assert coordinates.condition(a, lu, order, np.ones(n), np.empty((4, n))) == pytest.approx(1e6, rel=1e-12)


def test_a_step_is_a_random_walk_in_star_coordinates():
    case = problem(1, 5, 2, 3, 30)
    ends, es, closed, _, _ = moved(case.model, Rule(steps=10), 30)
    assert np.flatnonzero(closed).tolist() == [9, 19, 29]
    for j in (0, 4, 13, 29):
        product = np.eye(5)
        for i in range(j // 10 * 10, j + 1):
            product = case.phi[i] @ product
        assert np.allclose(ends[j], product, rtol=1e-12, atol=1e-14)
        assert np.allclose(product @ es[j].T, case.gamma[j], rtol=1e-10, atol=1e-12)
    rows = np.empty((30, 3, 5))
    coordinates.observe(case.h, ends, rows)
    assert np.allclose(rows, case.h @ ends)


@pytest.mark.parametrize("rule", [Rule(steps=7), Rule(steps=1), Rule(steps=40, kappa=50.0)])
def test_the_table_of_a_constant_model_is_what_each_step_would_give(rule):
    model = constant(2, growth=1.0 if rule.kappa > 1e3 else 1.2)
    table = coordinates.table(model, rule, 60)
    ends, es, closed, left, _ = moved(model, rule, 60)
    at, marked, after = coordinates.phases(table, 0, 60)
    assert np.array_equal(table.phi[1:][at], ends) and np.array_equal(table.es[at], es)
    assert np.array_equal(marked, closed) and after == left
    for split in (1, 5, 7, 23):
        head, tail = coordinates.phases(table, 0, split), None
        tail = coordinates.phases(table, head[2], 60 - split)
        assert np.array_equal(np.concatenate([head[0], tail[0]]), at)
        assert np.array_equal(np.concatenate([head[1], tail[1]]), closed)


def test_what_varies_or_is_too_long_is_not_tabulated():
    assert coordinates.table(problem(3).model, Rule(), 10**6) is None
    assert coordinates.table(constant(3), Rule(steps=coordinates.LONGEST_TABLE + 1), 10**6) is None


def test_a_window_is_tabulated_when_as_many_steps_have_been_taken():
    model = constant(5)
    assert [coordinates.table(model, Rule(steps=10), 3) is None for _ in range(4)] == [True, True, True, False]
    assert coordinates.table(model, Rule(steps=10), 1) is coordinates.table(model, Rule(steps=10), 1)


def test_a_constant_model_keeps_no_hold_of_its_callers_arrays():
    phi = np.eye(2)
    model = LinearModel(phi, np.eye(2), [1.0, 1.0], np.eye(2), [1.0, 1.0])
    phi[0, 1] = 5.0
    assert np.array_equal(model.phi[0], np.eye(2))


def test_a_window_begun_with_another_model_goes_on_without_the_table():
    case = problem(4, 4, 2, 3, 12)
    model = constant(4)
    before, _ = filter(case.model, start(4, **case.prior), case.z)
    whole, told = filter(model, before, np.ones((20, 3)))
    repeated = LinearModel(*(np.repeat(a, 20, axis=0) for a in (model.phi, model.gamma, model.q, model.h, model.r)))
    again, same = filter(repeated, before, np.ones((20, 3)))
    assert whole.steps == 32 and np.array_equal(whole.u, again.u) and np.array_equal(told.mean, same.mean)
