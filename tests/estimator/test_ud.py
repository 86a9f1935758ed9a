"""The U-D kernels do what the dense formulas say, and keep doing it where the dense formulas fail."""

import importlib
import pkgutil
import types
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numba.core.dispatcher import Dispatcher

import estimator
from estimator import ud

seeds = st.integers(0, 2**32 - 1)
sizes = st.integers(1, 9)


def factors(rng, n, spread=1.0):
    """U^T (unit lower triangular) and D > 0."""
    return np.tril(rng.normal(size=(n, n)), -1) + np.eye(n), np.exp(spread * rng.normal(size=n))


def dense(ut, d):
    return ut.T @ np.diag(d) @ ut


def is_unit_triangular(ut):
    return np.array_equal(np.triu(ut), np.eye(len(ut)))


@given(seeds, sizes)
@settings(max_examples=40, deadline=None)
def test_bierman_subtracts_what_a_scalar_tells(seed, n):
    rng = np.random.default_rng(seed)
    ut, d = factors(rng, n)
    before, h, r, k = dense(ut, d), rng.normal(size=n), rng.uniform(0.1, 2.0), np.empty(n)
    s = ud.bierman(ut, d, h, r, k)
    assert np.isclose(s, r + h @ before @ h, rtol=1e-12)
    assert np.allclose(k, before @ h, rtol=1e-11, atol=1e-11 * np.abs(before).max())
    ph = before @ h
    assert np.allclose(dense(ut, d), before - np.outer(ph, ph) / s, atol=1e-11 * np.abs(before).max())
    assert is_unit_triangular(ut) and (d > 0.0).all()


@given(seeds, sizes, st.sampled_from([0.0, 1e-9, 1.0, 1e9]), st.booleans())
@settings(max_examples=60, deadline=None)
def test_agee_turner_adds_a_square(seed, n, c, empty):
    rng = np.random.default_rng(seed)
    ut, d = factors(rng, n)
    if empty:
        d[rng.random(n) < 0.5] = 0.0
    before, a = dense(ut, d), rng.normal(size=n)
    ud.agee_turner(ut, d, a.copy(), c)
    expected = before + c * np.outer(a, a)
    assert np.allclose(dense(ut, d), expected, atol=1e-12 * np.abs(expected).max())
    assert is_unit_triangular(ut) and (d >= 0.0).all()


@given(seeds, sizes, st.integers(1, 3))
@settings(max_examples=40, deadline=None)
def test_data_in_front_are_whatever_the_whole_matrix_would_hold(seed, n, records):
    # L_aug = [[rho, (L x)^T], [L x, L]] for each record: the columns in front are row 0 of its factor.
    rng = np.random.default_rng(seed)
    ut, d = factors(rng, n)
    eta, e, r, row, c = rng.normal(size=(n, records)), rng.normal(size=n), 0.7, rng.normal(size=records + n), 1.3
    with_data = np.ascontiguousarray(np.concatenate([eta, ut], axis=1))
    pivots, k = d.copy(), np.empty(records + n)
    s = ud.bierman(with_data, pivots, e, r, k)
    residual = row.copy()
    left = ud.agee_turner(with_data, pivots, residual, c)
    for t in range(records):
        alone = np.block([[np.ones((1, 1)), np.zeros((1, n))], [eta[:, t : t + 1], ut]])
        whole = dense(alone, np.concatenate([[0.0], d]))
        padded = np.concatenate([[0.0], e])
        assert np.isclose(k[t], (whole @ padded)[0], atol=1e-10)
        whole -= np.outer(whole @ padded, whole @ padded) / s
        a = np.concatenate([row[t : t + 1], row[records:]])
        whole += c * np.outer(a, a)
        kept = dense(np.block([[np.ones((1, 1)), np.zeros((1, n))], [with_data[:, t : t + 1], with_data[:, records:]]]),
                     np.concatenate([[0.0], pivots]))  # fmt: skip
        scale = np.abs(whole).max()
        assert np.allclose(kept[1:], whole[1:], atol=1e-9 * scale)
        told = whole[0, 0] - kept[0, 0]  # c (z - M x)^2 / (1 + ..) less what the downdate took from rho
        assert np.isclose(told + k[t] ** 2 / s, left * residual[t] ** 2 + k[t] ** 2 / s, atol=1e-9 * scale)


def test_agee_turner_keeps_the_small_pivot_under_a_dominating_datum():
    # Without the composite branch U_01 = u + beta (a_0 - s u) cancels, and with it the digits of what was there before.
    u, d, a, c = 0.3, [1.0, 1e-18], [0.7, 1.1], 1.0
    exact_u, exact_d = [Fraction(u)], [Fraction(x) for x in d]
    s = Fraction(a[1])
    dn = exact_d[1] + Fraction(c) * s * s
    expected = (exact_d[1] * exact_u[0] + Fraction(c) * s * Fraction(a[0])) / dn
    rest = Fraction(c) * exact_d[1] / dn * (Fraction(a[0]) - s * exact_u[0]) ** 2
    ut, pivots = np.array([[1.0, 0.0], [u, 1.0]]), np.array(d)
    ud.agee_turner(ut, pivots, np.array(a), c)
    assert ut[1, 0] == pytest.approx(float(expected), rel=1e-15)
    assert pivots[0] == pytest.approx(1.0 + float(rest), rel=1e-15)


def test_information_from_nothing_is_exact():
    rng = np.random.default_rng(1)
    n = 6
    ut, d, rows = np.eye(n), np.zeros(n), rng.normal(size=(n, n))
    for row in rows:
        ud.agee_turner(ut, d, row.copy(), 1.0)
    assert np.allclose(dense(ut, d), rows.T @ rows, rtol=1e-12, atol=1e-12)


@given(seeds, sizes, st.integers(0, 5))
@settings(max_examples=40, deadline=None)
def test_mwgs_factors_a_weighted_square(seed, n, more):
    rng = np.random.default_rng(seed)
    w, weight = rng.normal(size=(n, n + more)), np.exp(rng.normal(size=n + more))
    expected, ut, d = w @ np.diag(weight) @ w.T, np.empty((n, n)), np.empty(n)
    ud.mwgs(w.copy(), weight, ut, d)
    assert np.allclose(dense(ut, d), expected, atol=1e-12 * np.abs(expected).max())
    assert is_unit_triangular(ut) and (d > 0.0).all()


def test_mwgs_gives_a_zero_pivot_a_zero_column():
    ut, d = np.empty((2, 2)), np.empty(2)
    ud.mwgs(np.array([[1.0, 2.0], [0.0, 0.0]]), np.ones(2), ut, d)
    assert np.array_equal(d, [5.0, 0.0]) and np.array_equal(ut, np.eye(2))


@given(seeds, sizes, st.integers(1, 4))
@settings(max_examples=40, deadline=None)
def test_solves_undo_multiplications(seed, n, count):
    rng = np.random.default_rng(seed)
    a = rng.normal(size=(n, n)) + 3.0 * np.eye(n)
    a[rng.random((n, n)) < 0.3] = 0.0
    if abs(np.linalg.det(a)) < 1e-3:
        return
    lu, order, x = np.empty((n, n)), np.empty(n, np.int64), np.empty((n, count))
    assert not ud.factor(a, lu, order)
    b = rng.normal(size=(n, count))
    ud.solve(lu, order, b, x)
    assert np.allclose(a @ x, b, atol=1e-9)
    y = np.empty(n)
    ud.solve_vector(lu, order, b[:, 0].copy(), y)
    assert np.allclose(a @ y, b[:, 0], atol=1e-9)
    ud.solve_transposed(lu, order, b[:, 0].copy(), y)
    assert np.allclose(a.T @ y, b[:, 0], atol=1e-9)


@pytest.mark.parametrize(
    ("matrix", "singular"),
    [
        ([[1.0, 2.0], [2.0, 4.0]], True),
        ([[0.0, 1.0], [0.0, 1.0]], True),
        ([[1e-10, 0.0], [0.0, 1e10]], False),  # units, not singularity
        ([[0.0, 1.0], [1.0, 0.0]], False),
    ],
)
def test_factor_knows_a_singular_matrix(matrix, singular):
    lu, order = np.empty((2, 2)), np.empty(2, np.int64)
    assert ud.factor(np.array(matrix), lu, order) is singular


def test_compiled_code_is_forgotten_when_what_it_calls_has_changed(tmp_path):
    caller, callee, cache = tmp_path / "caller.py", tmp_path / "callee.py", tmp_path / "__pycache__"
    caller.write_text("one")
    callee.write_text("two")
    cache.mkdir()
    index = cache / "caller.kernel-1.py311.nbi"
    other = cache / "other.kernel-1.py311.nbi"
    ud.follow(str(caller), str(callee))
    for changed in (False, True):
        index.write_text("compiled")
        other.write_text("compiled")
        if changed:
            callee.write_text("three")
        ud.follow(str(caller), str(callee))
        assert index.exists() != changed
        assert other.exists()


def kernels():
    for module in pkgutil.walk_packages(estimator.__path__, "estimator."):
        for name, kernel in vars(importlib.import_module(module.name)).items():
            if isinstance(kernel, Dispatcher) and "rivals" not in kernel.py_func.__module__:  # they fly with nobody
                yield f"{module.name}.{name}", kernel


def called(kernel):
    function = kernel.py_func
    for name in function.__code__.co_names:
        callee = function.__globals__.get(name)
        if isinstance(callee, types.ModuleType):  # module.kernel: any of its names may be meant
            yield from (vars(callee)[n] for n in function.__code__.co_names if n in vars(callee))
        else:
            yield callee


def test_what_a_kernel_calls_is_rounded_one_way():
    """Reassociated code that is not inlined is one thing in the process that compiles it, another in later ones."""
    found = 0
    for name, kernel in kernels():
        for callee in called(kernel):
            if isinstance(callee, Dispatcher) and callee.targetoptions.get("fastmath"):
                assert callee.targetoptions.get("forceinline"), f"{name} calls {callee.py_func.__name__}"
                assert kernel.targetoptions.get("fastmath"), f"{name} is not exact: it calls {callee.py_func.__name__}"
                found += 1
    assert found
