"""Smoothing from both ends is the smoothing from one end."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimator import LinearModel, Unobservable, smooth
from estimator.middle import smooth_from_both_ends
from tests.estimator.oracle import batch, exact, in_correlation, in_sigmas, problem, relative

seeds = st.integers(0, 2**32 - 1)
EPS = np.finfo(float).eps
EVERYTHING = frozenset({"mean", "std", "covariance", "cross", "filtered"})


def from_both_ends(case, window=None, want=EVERYTHING):
    return smooth_from_both_ends(case.model, case.z, case.x0, case.p0, window, want)


def from_one_end(case, window=None, want=EVERYTHING):
    return smooth(case.model, case.z, **case.prior, window=window, want=want)


def met(smoothed):
    """Did two halves meet, or was the record left to one thread, whose filter reaches the end?"""
    return bool(np.isnan(smoothed.filtered_mean[-1]).all())


def deviations(covariance):
    return np.sqrt(np.einsum("jii->ji", covariance))


@pytest.mark.parametrize("window", [1, 7, None])
@pytest.mark.parametrize("prior", [True, False])
@pytest.mark.parametrize("steps", [24, 25])
@pytest.mark.parametrize(
    "kind",
    [{}, {"missing": 0.4}, {"correlated": True, "missing": 0.3}, {"quiet": 0.5}],
    ids=["plain", "missing", "correlated", "quiet"],
)
def test_two_threads_and_one_agree_to_a_ten_billionth_of_a_sigma(kind, steps, prior, window):
    for seed, (n, p, m) in enumerate([(2, 1, 1), (5, 2, 2), (8, 8, 8), (12, 12, 3)]):
        case = problem(seed, n, p, m, steps, prior=prior, **kind)
        two, one = from_both_ends(case, window), from_one_end(case, window)
        assert met(two)
        assert in_sigmas(two.mean, one.mean, one.std) < 1e-10
        assert relative(two.std, one.std) < 1e-12
        assert in_correlation(two.covariance, one.covariance) < 1e-12
        scale = one.std[:-1, :, None] * one.std[1:, None, :]
        assert (np.abs(two.cross - one.cross) / scale).max() < 1e-12


@pytest.mark.parametrize("window", [1, 7, None])
@pytest.mark.parametrize("prior", [True, False])
@pytest.mark.parametrize(
    "kind", [{}, {"missing": 0.3, "correlated": True}, {"r_range": (1e-12, 1e6)}, {"growth": 1.3}],
    ids=["plain", "missing and correlated", "near-perfect beside terrible", "unstable and stiff"],
)  # fmt: skip
def test_it_is_batch_least_squares(kind, prior, window):
    for seed, (n, p, m) in enumerate([(2, 1, 1), (5, 2, 2), (12, 4, 3)]):
        case = problem(seed, n, p, m, 25, prior=prior, **kind)
        two = from_both_ends(case, window)
        mean, covariance = batch(case)
        std = deviations(covariance)
        assert met(two)
        assert in_sigmas(two.mean, mean, std) < 1e-9
        assert relative(two.std, std) < 1e-9
        assert in_correlation(two.covariance, covariance) < 1e-9


@pytest.mark.parametrize("window", [1, 5, None])
@pytest.mark.parametrize("prior", [1e8, None])
@pytest.mark.parametrize("growth", [1.0, 3.0])
def test_hard_records_keep_positive_variances_and_right_sigmas(growth, prior, window):
    for seed in range(4):
        case = problem(seed, 4, 2, 2, 12, growth=growth, r_range=(1e-12, 1e6), missing=0.3, quiet=0.3)
        case = case.but(x0=prior and case.x0, p0=prior and prior * np.eye(4))
        two = from_both_ends(case, window)
        mean, std = exact(case)
        assert (two.std > 0.0).all()
        assert relative(two.std, std) < 1e-8
        assert in_sigmas(two.mean, mean, std) < 1e-9 + 100.0 * EPS * np.abs(mean).max() / std.min()


@given(
    seeds, st.integers(1, 12), st.integers(1, 4), st.integers(1, 4), st.integers(1, 20), st.booleans(),
    st.sampled_from([0.0, 0.3]), st.booleans(), st.sampled_from([0.0, 0.4]), st.sampled_from([1, 7, None]),
)  # fmt: skip
@settings(max_examples=60, deadline=None)
def test_any_record_comes_out_as_from_one_thread(seed, n, p, m, steps, prior, missing, correlated, quiet, window):
    case = problem(seed, n, p, m, steps, prior=prior, missing=missing, correlated=correlated, quiet=quiet)
    try:
        one = from_one_end(case, window)
    except Unobservable as known:
        with pytest.raises(Unobservable) as caught:
            from_both_ends(case, window)
        assert str(caught.value) == str(known)
        return
    two = from_both_ends(case, window)
    # Few measurements can tell a start from nothing badly: then float64 keeps fewer digits.
    assert in_sigmas(two.mean, one.mean, one.std) < 1e-9 + 1e2 * EPS * np.abs(one.mean / one.std).max() + (
        0 if prior else 1e-7
    )
    assert relative(two.std, one.std) < (1e-9 if prior else 1e-7)


@pytest.mark.parametrize("steps", [0, 1, 2, 3, 4, 5])
@pytest.mark.parametrize("prior", [True, False])
def test_the_shortest_records_too(steps, prior):
    case = problem(20 + steps, 2, 2, 2, steps, prior=prior) if steps else problem(20, 2, 2, 2, 1)
    if not steps:
        one = smooth(
            LinearModel(np.eye(2), np.eye(2), np.ones(2), np.eye(2), np.ones(2)), np.empty((0, 2)), **case.prior
        )
        model = LinearModel(np.eye(2), np.eye(2), np.ones(2), np.eye(2), np.ones(2))
        two = smooth_from_both_ends(model, np.empty((0, 2)), case.x0, case.p0, None, EVERYTHING)
        assert np.array_equal(two.mean, one.mean)
        return
    two, one = from_both_ends(case), from_one_end(case)
    assert met(two) == (steps > 1)
    assert in_sigmas(two.mean, one.mean, one.std) < 1e-10 and relative(two.std, one.std) < 1e-12


@pytest.mark.parametrize("r", [np.full(2, 0.3), np.array([[1.0, 0.4], [0.4, 0.5]])], ids=["variances", "correlated"])
def test_a_constant_model_stays_constant(r):
    rng = np.random.default_rng(3)
    phi = np.linalg.qr(rng.normal(size=(4, 4)))[0]
    model = LinearModel(phi, rng.normal(size=(4, 2)), np.eye(2) + 0.5, rng.normal(size=(2, 4)), r)
    z = rng.normal(size=(331, 2))
    z[50:60] = np.nan
    two = smooth_from_both_ends(model, z, np.zeros(4), np.eye(4), None, EVERYTHING)
    one = smooth(model, z, x0=np.zeros(4), p0=np.eye(4), want=EVERYTHING)
    assert met(two)
    assert in_sigmas(two.mean, one.mean, one.std) < 1e-10 and relative(two.std, one.std) < 1e-12


def test_some_arguments_may_vary_and_others_not():
    rng = np.random.default_rng(4)
    full = problem(5, 3, 3, 3, 6)
    z = full.z
    arguments = {"phi": full.phi, "gamma": full.gamma, "q": full.model.q, "h": full.h, "r": full.model.r}
    for _ in range(20):
        chosen = {name: a if rng.random() < 0.5 else a[0] for name, a in arguments.items()}
        model = LinearModel(**chosen)
        two = smooth_from_both_ends(model, z, full.x0, full.p0, None, EVERYTHING)
        one = smooth(model, z, **full.prior)
        assert met(two)
        assert in_sigmas(two.mean, one.mean, one.std) < 1e-10 and relative(two.std, one.std) < 1e-12


def test_unstable_and_stiff_modes_are_closed_into_windows_on_both_sides():
    case = problem(6, 4, 2, 2, 300, growth=1.3)
    case = case.but(z=case.z - case.z)  # states of thousands of sigmas leave fewer digits for the mean
    case = case.but(x0=0.0 * case.x0)
    two, one = from_both_ends(case), from_one_end(case)
    assert met(two) and len(two.windows) > 10
    assert relative(two.std, one.std) < 1e-11 and in_correlation(two.covariance, one.covariance) < 1e-11


def test_windows_are_told_in_the_order_of_the_record():
    case = problem(7, 4, 2, 2, 50)
    two = from_both_ends(case, window=10)
    assert two.windows == [0, 10, 20, 25, 30, 40]  # the second half is cut from its end: 50, 40, 30, 25
    assert two.bytes_per_step == from_one_end(case, window=10).bytes_per_step


def test_the_filter_is_known_up_to_the_middle():
    case = problem(8, 4, 2, 2, 31)
    two, one = from_both_ends(case), from_one_end(case)
    assert np.array_equal(two.filtered_mean[:17], one.filtered_mean[:17])
    assert np.array_equal(two.filtered_std[:17], one.filtered_std[:17])
    assert np.isnan(two.filtered_mean[17:]).all() and np.isinf(two.filtered_std[17:]).all()


def test_only_what_is_wanted_is_there():
    case = problem(9)
    whole = from_both_ends(case)
    for want, fields in (
        (frozenset(), []), (frozenset({"std"}), ["std"]), (frozenset({"covariance", "cross"}), ["covariance", "cross"]),
        (frozenset({"filtered"}), ["filtered_mean", "filtered_std"]),
    ):  # fmt: skip
        part = from_both_ends(case, want=want)
        assert np.array_equal(part.mean, whole.mean)
        for name in ("std", "covariance", "cross", "filtered_mean", "filtered_std"):
            expected = getattr(whole, name) if name in fields else getattr(whole, name)[:0]
            assert np.allclose(getattr(part, name), expected, rtol=1e-13, atol=0, equal_nan=True), name
            assert getattr(part, name).shape == expected.shape


def test_float32_is_smoothed_in_float32():
    case = problem(10, 5, 2, 2, 60)
    arguments = (case.phi, case.gamma, case.model.q, case.h, case.model.r)
    model = LinearModel(*arguments, dtype=np.float32)
    two = smooth_from_both_ends(model, case.z, case.x0, case.p0, None, EVERYTHING)
    one = from_one_end(case)
    assert met(two) and two.mean.dtype == np.float32 and two.covariance.dtype == np.float32
    assert relative(two.std, one.std) < 1e-4 and in_sigmas(two.mean, one.mean, one.std) < 1e-2


def test_z_is_left_as_it_was():
    for steps in (2, 3, 20):
        case = problem(11, 2, 2, 2, steps)
        before = case.z.copy()
        from_both_ends(case)
        assert np.array_equal(case.z, before)


def test_halves_that_know_nothing_of_a_state_still_meet():
    # The first half measures x[0] alone, the second x[1]; there is no prior, and each half leaves exact zeros in D.
    h = np.zeros((40, 1, 2))
    h[:20, 0, 0] = h[20:, 0, 1] = 1.0
    model = LinearModel(np.eye(2), np.eye(2), np.full(2, 0.1), h, [0.5])
    z = np.random.default_rng(12).normal(size=(40, 1))
    two, one = smooth_from_both_ends(model, z, None, None, 7, EVERYTHING), smooth(model, z, window=7)
    assert met(two)
    assert in_sigmas(two.mean, one.mean, one.std) < 1e-10 and relative(two.std, one.std) < 1e-12


def test_a_second_half_without_any_measurement_is_prediction():
    case = problem(13, 4, 2, 2, 60)
    case.z[30:] = np.nan
    two, one = from_both_ends(case), from_one_end(case)
    assert met(two)
    assert in_sigmas(two.mean, one.mean, one.std) < 1e-10 and relative(two.std, one.std) < 1e-12


def test_rounding_in_a_direction_only_the_prior_knows_is_not_taken_for_information():
    # x[0] + 2 x[1] grows by 1e19 and only the prior tells it; on the way back what rounding leaves there grows as well.
    basis = np.array([[1.0, 2.0, 0.0], [-2.0, 1.0, 0.5], [0.3, 0.0, 1.0]])
    phi = np.linalg.solve(basis, np.diag([1.25, 1.0, 0.9]) @ basis)
    model = LinearModel(phi, 0.1 * np.eye(3), np.ones(3), basis[1:] / 3.0, [1.0, 1.0])
    z = np.random.default_rng(14).normal(size=(200, 2))
    for window in (1, 7, None):
        two = smooth_from_both_ends(model, z, np.ones(3), np.eye(3), window, EVERYTHING)
        one = smooth(model, z, x0=np.ones(3), p0=np.eye(3), window=window, want=EVERYTHING)
        assert relative(two.std, one.std) < 1e-8


@pytest.mark.parametrize("window", [1, 7, None])
@pytest.mark.parametrize("h", [[[1.0, 0.0, 0.0], [0.0, 0.0, 2.0]], [[0.1, 0.2, 0.0], [0.0, 0.0, 1.0]]])
def test_an_unobservable_direction_is_named_as_by_one_thread(h, window):
    model = LinearModel(np.eye(3), np.eye(3), np.full(3, 0.1), h, np.ones(2))
    z = np.random.default_rng(0).normal(size=(40, 2))
    with pytest.raises(Unobservable) as one:
        smooth(model, z, window=window)
    with pytest.raises(Unobservable) as two:
        smooth_from_both_ends(model, z, None, None, window, EVERYTHING)
    assert str(two.value) == str(one.value) and two.value.count == one.value.count == 1
    assert np.array_equal(two.value.direction, one.value.direction)


@pytest.mark.parametrize("step", [4, 14, 19])
def test_a_singular_phi_is_named_by_the_step_of_the_record(step):
    case = problem(15, 4, 2, 2, 20)
    case.phi[step, :, 1] = 0.0
    with pytest.raises(ValueError, match=rf"phi is singular at step {step}: "):
        from_both_ends(case)


def test_other_errors_are_those_of_one_thread():
    case = problem(16, 4, 2, 2, 20)
    z = case.z.copy()
    z[13, 1] = np.inf
    with pytest.raises(ValueError, match="z is infinite at step 13; a missing measurement is NaN"):
        from_both_ends(case.but(z=z))
    with pytest.raises(ValueError, match="x0 and p0 come together"):
        from_both_ends(case.but(p0=None))
    with pytest.raises(ValueError, match="z has 19 rows, the model 20 steps"):
        from_both_ends(case.but(z=z[:19]))
