"""The backward pass is batch least squares, for every cut into windows."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimator import LinearModel, Rule, Store, Unobservable, smooth
from estimator.information import anchor, filter, start
from estimator.smoother import backward
from tests.estimator.oracle import Problem, batch, exact, in_correlation, in_sigmas, problem, relative

seeds = st.integers(0, 2**32 - 1)
EPS = np.finfo(float).eps


def sides(store, carry, **options):
    smoothed = backward(store, carry, **options)
    return smoothed.mean, smoothed.covariance


def deviations(covariance):
    return np.sqrt(np.einsum("jii->ji", covariance))


@given(
    seeds, st.integers(1, 12), st.integers(1, 4), st.integers(1, 3), st.integers(1, 16), st.booleans(),
    st.sampled_from([0.0, 0.3]), st.booleans(), st.sampled_from([0.0, 0.4]), st.sampled_from([1, 7, None]),
)  # fmt: skip
@settings(max_examples=60, deadline=None)
def test_smoothing_is_batch_least_squares(seed, n, p, m, steps, prior, missing, correlated, quiet, window):
    case = problem(seed, n, p, m, steps, prior=prior, missing=missing, correlated=correlated, quiet=quiet)
    try:
        smoothed = smooth(case.model, case.z, **case.prior, window=window)
    except Unobservable:
        assert not prior  # too few measurements for a start from nothing
        return
    mean, covariance = batch(case)
    std = deviations(covariance)
    # Few measurements can tell a start from nothing badly: then float64 keeps fewer digits.
    assert in_sigmas(smoothed.mean, mean, std) < 1e-9 + 1e2 * EPS * np.abs(mean / std).max() + (0 if prior else 1e-7)
    assert relative(smoothed.std, std) < (1e-9 if prior else 1e-7)
    assert in_correlation(smoothed.covariance, covariance) < (1e-9 if prior else 1e-7)


@pytest.mark.parametrize("window", [1, 7, 25, None])
@pytest.mark.parametrize("prior", [True, False])
@pytest.mark.parametrize(
    "kind",
    [
        {},
        {"missing": 0.4},
        {"correlated": True, "missing": 0.3},
        {"quiet": 0.5},
        {"r_range": (1e-12, 1e6)},
        {"growth": 1.3},
    ],
    ids=["plain", "missing", "correlated", "quiet", "near-perfect beside terrible", "unstable and stiff"],
)
def test_every_kind_of_record_to_a_billionth_of_a_sigma(kind, prior, window):
    for seed, (n, p, m) in enumerate([(2, 1, 1), (5, 2, 2), (12, 4, 3)]):
        case = problem(seed, n, p, m, 25, prior=prior, **kind)
        smoothed = smooth(case.model, case.z, **case.prior, window=window)
        mean, covariance = batch(case)
        std = deviations(covariance)
        assert in_sigmas(smoothed.mean, mean, std) < 1e-9
        assert relative(smoothed.std, std) < 1e-9
        assert in_correlation(smoothed.covariance, covariance) < 1e-9


@pytest.mark.parametrize("window", [1, 5, None])
@pytest.mark.parametrize("prior", [1e8, None])
@pytest.mark.parametrize("growth", [1.0, 3.0])
def test_hard_records_keep_positive_variances_and_right_sigmas(growth, prior, window):
    # Measurements of 1e-12 and 1e6, a vague prior or none, silent noise, gaps, strongly unstable and stiff modes.
    for seed in range(4):
        case = problem(seed, 4, 2, 2, 12, growth=growth, r_range=(1e-12, 1e6), missing=0.3, quiet=0.3)
        case = case.but(x0=prior and case.x0, p0=prior and prior * np.eye(4))
        smoothed = smooth(case.model, case.z, **case.prior, window=window)
        mean, std = exact(case)
        assert (smoothed.std > 0.0).all()
        assert relative(smoothed.std, std) < 1e-8
        assert in_sigmas(smoothed.mean, mean, std) < 1e-9 + 100.0 * EPS * np.abs(mean).max() / std.min()


@pytest.mark.parametrize("window", [1, 7, None])
@pytest.mark.parametrize("mode", [0.8, 0.9])
def test_a_direction_first_seen_at_the_end_of_the_record(mode, window):
    # Nothing tells the oblique first mode for 58 steps: what rounding leaves in its place must not count as knowledge.
    basis = np.array([[1.0, 2.0, 0.0], [-2.0, 1.0, 0.5], [0.3, 0.0, 1.0]])
    back, steps = np.linalg.inv(basis), 60
    h = np.repeat(basis[None, 1:] / 3.0, steps, axis=0)
    h[-2:] = np.eye(3)[:2]
    phi, gamma = back @ np.diag([mode, 1.0, 0.95]) @ basis, back @ np.diag([0.0, 1.0, 1.0])
    every = [np.repeat(a[None], steps, axis=0) for a in (phi, gamma, 0.1 * np.eye(3), np.eye(2))]
    z = np.random.default_rng(1).normal(size=(steps, 2))
    case = Problem(every[0], every[1], every[2], h, every[3], z, None, None)
    mean, covariance = batch(case)
    smoothed = smooth(case.model, z, window=window)
    assert in_sigmas(smoothed.mean, mean, deviations(covariance)) < 1e-9
    assert relative(smoothed.std, deviations(covariance)) < 1e-9


def test_the_two_oracles_agree():
    case = problem(7, 3, 2, 2, 8, missing=0.2)
    case = case.but(p0=np.diag(np.diag(case.p0)))
    mean, covariance = batch(case)
    exact_mean, exact_std = exact(case)
    assert in_sigmas(mean, exact_mean, exact_std) < 1e-14
    assert relative(deviations(covariance), exact_std) < 1e-14


@given(seeds, st.integers(1, 8), st.lists(st.integers(1, 59), max_size=8), st.integers(0, 60), st.integers(1, 60))
@settings(max_examples=30, deadline=None)
def test_any_chain_of_windows_is_one_smoothing(seed, n, marks, first, length):
    case = problem(seed, n, 2, 2, 60, missing=0.2)
    model = case.model
    whole, chain = Store(), Store()
    end, _ = filter(model, start(n, **case.prior), case.z, rule=Rule(steps=1000, kappa=np.inf), store=whole)
    mean, covariance = sides(whole, end)
    carry = start(n, **case.prior)
    cuts = [0, *sorted(marks), 60]
    for a, b in pairwise(cuts):
        carry, _ = filter(model.cut(a, b), carry, case.z[a:b], rule=Rule(steps=length), store=chain)
        carry = anchor(carry)
    chained_mean, chained = sides(chain, carry, first=first)
    std = deviations(covariance)[first:]
    assert in_sigmas(chained_mean, mean[first:], std) < 1e-9
    assert in_correlation(chained, covariance[first:]) < 1e-10


def test_row_0_is_the_first_epoch_and_the_last_row_is_the_filter():
    case = problem(8, 5, 2, 2, 30)
    store = Store()
    carry, filtered = filter(case.model, start(5, **case.prior), case.z, rule=Rule(steps=8), store=store)
    mean, covariance = sides(store, carry)
    assert mean.shape == (31, 5) and covariance.shape == (31, 5, 5)
    assert in_sigmas(mean[-1], filtered.mean[-1], filtered.std[-1]) < 1e-12
    for first in (0, 1, 8, 13, 30):
        part, std, *_ = backward(store, carry, first=first, std=True, covariance=False)
        assert np.array_equal(part, mean[first:])
        assert np.allclose(std, deviations(covariance[first:]), rtol=1e-14)


def test_covariances_are_symmetric_to_the_last_bit():
    _, covariance = case_of(9)
    assert np.array_equal(covariance, covariance.transpose(0, 2, 1))


def case_of(seed):
    case = problem(seed, 6, 2, 2, 50)
    store = Store()
    carry, _ = filter(case.model, start(6, **case.prior), case.z, store=store)
    return sides(store, carry)


def test_smoothing_is_never_less_sure_than_filtering():
    for seed in range(10):
        smoothed = smooth((case := problem(seed, 6, 2, 2, 50, missing=0.3)).model, case.z, **case.prior)
        assert (smoothed.std <= smoothed.filtered_std * (1.0 + 1e-12)).all()


def test_an_empty_store_gives_the_carry():
    mean, covariance = sides(Store(), start(3, [1.0, 2.0, 3.0], [1.0, 4.0, 9.0]))
    assert np.array_equal(mean, [[1.0, 2.0, 3.0]]) and np.allclose(covariance, [np.diag([1.0, 4.0, 9.0])])


def test_backward_leaves_store_and_carry_alone():
    case = problem(10)
    store = Store()
    carry, _ = filter(case.model, start(4, **case.prior), case.z, rule=Rule(steps=6), store=store)
    first = backward(store, anchor(carry))
    again = backward(store, carry)
    assert np.allclose(first[0], again[0], rtol=1e-10, atol=1e-12)
    assert store.anchors == [0, 6, 12, 18]
    assert np.array_equal(again[0], backward(store, carry)[0])


def unobservable(h, phi=None, n=3, window=None, steps=40):
    phi = np.eye(n) if phi is None else phi
    model = LinearModel(phi, np.eye(n), np.full(n, 0.1), h, np.ones(len(h)))
    with pytest.raises(Unobservable) as caught:
        smooth(model, np.random.default_rng(0).normal(size=(steps, len(h))), window=window)
    return caught.value


@pytest.mark.parametrize("window", [1, 7, None])
def test_an_unobserved_axis_is_named(window):
    error = unobservable([[1.0, 0.0, 0.0], [0.0, 0.0, 2.0]], window=window)
    assert np.allclose(error.direction, [0.0, 1.0, 0.0]) and error.count == 1
    assert str(error) == "no measurement and no prior tells the direction +1 x[1]"


@pytest.mark.parametrize("window", [1, 7, None])
def test_an_oblique_unobserved_direction_is_named(window):
    # x0 + 2 x1 and x2 are seen, so (2, -1, 0) is not; no pivot of the factor is an exact zero.
    error = unobservable([[0.1, 0.2, 0.0], [0.0, 0.0, 1.0]], window=window)
    assert np.allclose(error.direction, [1.0, -0.5, 0.0], atol=1e-6) and error.count == 1


def test_several_unobserved_directions_are_all_named():
    error = unobservable([[1.0, 1.0, 1.0]])
    assert error.count == 2 and np.abs(error.directions.sum(axis=1)).max() < 1e-6
    assert np.linalg.matrix_rank(error.directions) == 2
    error = unobservable([[0.0, 0.0, 0.0]])
    assert str(error) == "no measurement and no prior tells the directions +1 x[0]; +1 x[1]; +1 x[2]"


def test_axes_and_oblique_directions_are_named_together_and_the_many_are_counted():
    # x0 + 2 x1 is seen: x2 is an axis of what is not, (2, -1, 0) is not one.
    error = unobservable([[1.0, 2.0, 0.0]])
    assert np.allclose(error.directions, [[0.0, 0.0, 1.0], [1.0, -0.5, 0.0]], atol=1e-6)
    assert str(unobservable(np.eye(6)[:1], n=6)).endswith("+1 x[1]; +1 x[2]; +1 x[3]; and 2 more")


def test_the_direction_is_that_of_the_last_epoch():
    # An offset that turns by 90 degrees per step: after one step the unseen axis is the other one.
    phi = np.array([[0.0, 1.0], [-1.0, 0.0]])
    model = LinearModel(phi, np.zeros((2, 1)), [0.0], [[1.0, 0.0]], [1.0])
    with pytest.raises(Unobservable) as caught:
        smooth(model, [[3.0]])
    assert np.allclose(caught.value.direction, [0.0, 1.0])


def test_a_carry_that_is_not_the_stores_is_refused():
    case = problem(13)
    store = Store()
    before, _ = filter(case.model.cut(0, 12), start(4, **case.prior), case.z[:12], store=store)
    carry, _ = filter(case.model.cut(12, 20), before, case.z[12:], store=store)
    with pytest.raises(ValueError, match="carry is not the one that the newest step of this store ended with"):
        backward(store, before)
    with pytest.raises(ValueError, match="carry has 3 states, the store 4"):
        backward(store, start(3, np.zeros(3), np.ones(3)))
    for first in (-1, 21):
        with pytest.raises(IndexError, match="the store holds 20 steps"):
            backward(store, carry, first=first)
