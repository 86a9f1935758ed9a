"""Numbers that count: each operation once, under the kernel that did it; the values are those of the compiled code."""

import numpy as np
import pytest

from estimator import LinearModel, smooth
from sims.experiments.counting import Counted, Counting, Operations, Tally, counted, plain
from tests.estimator.oracle import problem


def spent(tally):
    return sum(tally.arithmetic().values(), Operations())


def stored(tally):
    return sum(tally.structural().values(), Operations())


def test_every_operation_counts_once():
    tally = Tally()
    x, y = Counted(2.0, tally), Counted(3.0, tally)
    results = [x + y, x - y, x + 1.5, 1.5 - x, x * y, 2.5 * x, x / y, 5.0 / x, np.sqrt(x), -x, abs(-y), max(x, y)]
    assert [each.value for each in results] == [5, -1, 3.5, -0.5, 6, 5, 2 / 3, 2.5, np.sqrt(2), -2, 3, 3]
    assert spent(tally) == Operations(4, 2, 2, 1)
    assert stored(tally) == Operations()
    assert (x**3).value == 8 and spent(tally) == Operations(4, 4, 2, 1)


def test_stored_zeros_and_ones_are_no_arithmetic():
    tally = Tally()
    x, zero, one = Counted(2.0, tally), Counted(0.0, tally), Counted(1.0, tally)
    results = [x + 0.0, 0.0 - x, zero + x, x * zero, one * x, x * 1.0, zero / x, x / one]
    assert [each.value for each in results] == [2, -2, 2, 0, 2, 2, 0, 2]
    assert spent(tally) == Operations()
    assert stored(tally) == Operations(3, 3, 2, 0)
    assert (1.0 / x).value == 0.5 and spent(tally) == Operations(0, 0, 1, 0)


def test_comparisons_cost_nothing_and_nothing_leaks_into_floats():
    tally = Tally()
    x = Counted(2.0, tally)
    assert x > 1.0 and x >= 2.0 and x < 3.0 and x <= Counted(2.0, tally) and x == 2.0 and x != 0.0 and x
    assert Counted(np.nan, tally) != Counted(np.nan, tally)
    assert spent(tally) == Operations() and stored(tally) == Operations()
    with pytest.raises(TypeError):
        np.zeros(2)[0] = x


def test_a_matrix_product_of_objects_costs_what_it_costs_on_paper():
    tally = Tally()
    a, b = np.array([[2.0, 3.0], [5.0, 7.0]]), np.array([[11.0, 13.0], [17.0, 19.0]])
    out = np.empty((2, 2), object)
    np.dot(counted(a, tally), counted(b, tally), out)
    assert np.array_equal(plain(out), a @ b)
    assert spent(tally) == Operations(additions=4, multiplications=8)


@pytest.mark.parametrize("n", [1, 3, 6])
def test_agee_turner_costs_its_formula(n):
    rng = np.random.default_rng(n)
    counting = Counting()
    ut, d = np.tril(rng.normal(size=(n, n)), -1) + np.eye(n), rng.uniform(1.0, 2.0, n)
    before, a = ut.T @ np.diag(d) @ ut, 0.1 * rng.normal(size=n)
    counting.module("estimator.ud").agee_turner(ut, d, a.copy(), 0.7)
    assert np.allclose(ut.T @ np.diag(d) @ ut, before + 0.7 * np.outer(a, a), rtol=1e-13)
    # Per pivot v = c s, dn = d + v s, beta = v / dn, rho = d / dn, c = c rho; per pair a - s u, u + beta a.
    pairs = n * (n - 1) // 2
    assert counting.tally.arithmetic()[("ud.agee_turner",)] == Operations(n + 2 * pairs, 3 * n + 2 * pairs, 2 * n)


def test_bierman_costs_its_formula():
    n, rng = 5, np.random.default_rng(1)
    counting = Counting()
    ut, d, k = np.tril(rng.normal(size=(n, n)), -1) + np.eye(n), rng.uniform(1.0, 2.0, n), np.empty(n)
    before, h = ut.T @ np.diag(d) @ ut, rng.normal(size=n)
    s = counting.module("estimator.ud").bierman(ut, d, h, 0.3, k)
    assert np.isclose(s, 0.3 + h @ before @ h, rtol=1e-13) and np.allclose(k, before @ h, rtol=1e-13)
    # Per pivot v = d f, grown = a + f v, d a / grown, gain = f / a; per pair f + u h, u - gain k, k + v u.
    pairs = n * (n - 1) // 2
    assert counting.tally.arithmetic()[("ud.bierman",)] == Operations(n + 3 * pairs, 3 * n + 3 * pairs, 2 * n)


def test_what_is_done_is_found_under_the_kernel_that_did_it():
    made = problem(3, steps=4)
    counting = Counting()
    estimator = counting.module("estimator")
    model = estimator.LinearModel(made.phi, made.gamma, np.einsum("jii->ji", made.q), made.h, made.r)
    estimator.smooth(model, made.z, x0=made.x0, p0=made.p0)
    paths = counting.tally.arithmetic()
    assert paths[()] == Operations()
    assert paths["sweeps.forward", "ud.bierman"].total > 0
    assert paths["coordinates.move", "dot"] == Operations(3 * 4**2 * 3, 3 * 4**3)  # the first step needs no product


@pytest.mark.parametrize("method", ["ms", "bierman", "watanabe", "rts"])
def test_the_counting_copy_gives_what_the_compiled_code_gives(method):
    made = problem(2, n=5, p=2, m=3, steps=9, missing=0.2)
    arguments = (made.phi, made.gamma, np.einsum("jii->ji", made.q), made.h, np.einsum("jii->ji", made.r))
    options = {"x0": made.x0, "p0": made.p0, "method": method, "want": ("mean", "std", "covariance", "filtered")}
    if method == "ms":
        options["window"] = 4
    expected = smooth(LinearModel(*arguments), made.z, **options)
    estimator = Counting().module("estimator")
    found = estimator.smooth(estimator.LinearModel(*arguments), made.z, **options)
    assert found is not expected and type(found) is not type(expected)
    for name in ("mean", "std", "covariance", "filtered_mean", "filtered_std"):
        a, b = getattr(found, name), getattr(expected, name)
        assert np.allclose(a, b, rtol=1e-12, atol=1e-12, equal_nan=True), name


def test_a_setting_reaches_the_kernels_that_know_it():
    made = problem(2, n=5, p=2, m=3, steps=3)
    totals = {}
    for each in (False, True):
        counting = Counting(per_component_mwgs=each)
        estimator = counting.module("estimator")
        model = estimator.LinearModel(made.phi, made.gamma, made.q, made.h, made.r)
        found = estimator.smooth(model, made.z, x0=made.x0, p0=made.p0, method="bierman")
        totals[each] = spent(counting.tally).total, found
        assert not counting.unheard
    assert totals[True][0] > totals[False][0]
    assert np.allclose(totals[True][1].covariance, totals[False][1].covariance, rtol=1e-10, atol=1e-12)
    counting = Counting(no_such_argument=1)
    counting.module("estimator.ud").faint(np.ones((1, 1)), 0, 1.0, 1e-20)
    assert counting.unheard == {"no_such_argument"}


def test_the_compiled_package_is_left_as_it_was():
    import sys

    before = {name: module for name, module in sys.modules.items() if name.partition(".")[0] in ("estimator", "numba")}
    copy = Counting().module("estimator.sweeps")
    assert copy is not sys.modules["estimator.sweeps"]
    assert all(sys.modules[name] is module for name, module in before.items())
    assert hasattr(sys.modules["estimator.sweeps"].forward, "py_func") and not hasattr(copy.forward, "py_func")
