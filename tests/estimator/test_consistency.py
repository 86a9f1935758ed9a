"""Verdicts are those of chi-square and of simple arithmetic, and no account depends on how its input was cut."""

import math
from fractions import Fraction
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from estimator.consistency import APART, BITS, HUGE, Tally, band, coverage, judge, nees, parameter, zscores

seeds = st.integers(0, 2**32 - 1)


def used(e):
    return Tally().add(np.asarray(e, float), np.ones(len(e), np.int64))


def stream(seed, size, scale):
    """Innovations of any size with every status, holes and extremes among them."""
    rng = np.random.default_rng(seed)
    e = rng.normal(size=size) * np.exp(scale * rng.normal(size=size))
    e[rng.random(size) < 0.1] = np.nan
    e[rng.random(size) < 0.02] = np.inf
    e[rng.random(size) < 0.02] = 0.0
    return e, rng.choice([0, 1, 1, 1, 2, 3], size=size).astype(np.int64)


def correlated(rng, lag, size):
    """Innovations of variance 1 whose neighbours are correlated."""
    e, w = np.empty(size), rng.normal(size=size)
    e[0] = w[0]
    for i in range(1, size):
        e[i] = lag * e[i - 1] + math.sqrt(1 - lag**2) * w[i]
    return e


# -- the account --


@given(seeds, st.integers(0, 60), st.sampled_from([0.0, 3.0, 60.0]), st.lists(st.integers(0, 60), max_size=6))
@settings(max_examples=150, deadline=None)
def test_cutting_and_merging_change_not_one_bit(seed, size, scale, cuts):
    e, status = stream(seed, size, scale)
    whole = Tally().add(e, status)
    edges = sorted({0, size, *(c for c in cuts if c < size)})
    fed, merged = Tally(), Tally()
    for low, high in pairwise(edges):
        fed.add(e[low:high], status[low:high])
        merged = merged + Tally().add(e[low:high], status[low:high])
    one_by_one = Tally()
    for i in range(size):
        one_by_one.add(e[i : i + 1], status[i : i + 1])
    for other in (fed, merged, one_by_one):
        assert other == whole
        assert (other.used, other.weakened, other.rejected) == (whole.used, whole.weakened, whole.rejected)
        assert (other.nis, other.lag1) == (whole.nis, whole.lag1)


@given(seeds, st.lists(st.integers(0, 20), min_size=3, max_size=3))
@settings(max_examples=40, deadline=None)
def test_merging_may_be_bracketed_at_will_and_leaves_its_parts_alone(seed, sizes):
    parts = [Tally().add(*stream(seed + i, size, 2.0)) for i, size in enumerate(sizes)]
    before = repr(parts)
    assert (parts[0] + parts[1]) + parts[2] == parts[0] + (parts[1] + parts[2])
    assert repr(parts) == before


@given(seeds, st.integers(1, 80), st.sampled_from([0.0, 3.0, 60.0]))
@settings(max_examples=80, deadline=None)
def test_the_figures_are_the_exact_ones_correctly_rounded(seed, size, scale):
    e, status = stream(seed, size, scale)
    tally = Tally().add(e, status)
    there = ~np.isnan(e)
    kept = np.clip(e[there & ((status == 1) | (status == 2))], -HUGE, HUGE)
    assert tally.used == len(kept)
    assert tally.weakened == int((there & (status == 2)).sum())
    assert tally.rejected == int((there & (status == 3)).sum())
    if not len(kept):
        assert tally.nis is None and tally.lag1 is None
        return
    squares = sum((Fraction(float(x)) for x in kept * kept), Fraction(0))
    products = sum((Fraction(float(x)) for x in kept[1:] * kept[:-1]), Fraction(0))
    assert tally.nis == float(squares / len(kept))
    assert tally.lag1 == (float(products / squares) if len(kept) > 1 and squares else None)


def test_what_is_not_measured_is_in_no_count():
    tally = Tally().add(np.array([np.nan, 1.0, np.nan, 5.0]), np.array([1, 0, 3, 1]))
    assert (tally.used, tally.rejected, tally.nis, tally.lag1) == (1, 0, 25.0, None)


def test_rejected_innovations_are_counted_and_are_in_no_mean():
    tally = Tally().add(np.array([1.0, 9.0, -1.0, 6.0]), np.array([1, 3, 1, 2]))
    assert (tally.used, tally.weakened, tally.rejected) == (3, 1, 1)
    assert tally.nis == 38.0 / 3.0 and tally.lag1 == -7.0 / 38.0


def test_an_infinite_innovation_is_wrong_and_still_a_number():
    tally = used([np.inf, -np.inf])
    assert tally.nis == pytest.approx(HUGE**2) and tally.lag1 == pytest.approx(-0.5)
    assert judge(tally).verdict == "over-confident"


@pytest.mark.parametrize(
    ("e", "status", "said"),
    [
        ([1.0], [4], "status 4"),
        ([1.0], [-1], "status -1"),
        ([1.0, 2.0], [1], r"shape \(2,\)"),
        ([[1.0]], [[1]], "both"),
    ],
)
def test_what_is_no_account_is_refused(e, status, said):
    with pytest.raises(ValueError, match=said):
        Tally().add(np.array(e), np.array(status))


def test_a_refused_batch_leaves_the_account_alone():
    tally = used([1.0])
    with pytest.raises(ValueError, match="status 7"):
        tally.add(np.array([1.0, 2.0]), np.array([1, 7]))
    assert tally == used([1.0])


# -- the band --


@pytest.mark.parametrize("scalars", [1, 2, 3, 10, 1000, 10**6, 10**9])
@pytest.mark.parametrize("level", [0.5, 0.95, 0.99, 0.9999])
def test_the_band_is_that_of_chi_square(scalars, level):
    expected = stats.chi2.ppf([(1 - level) / 2, (1 + level) / 2], scalars) / scalars
    assert band(scalars, level) == pytest.approx(tuple(expected), rel=1e-9)


def test_the_band_holds_as_often_as_it_says():
    rng = np.random.default_rng(1)
    means = np.square(rng.normal(size=(20000, 12))).mean(axis=1)
    low, high = band(12, 0.95)
    assert np.mean((means >= low) & (means <= high)) == pytest.approx(0.95, abs=0.005)


@pytest.mark.parametrize(("scalars", "level"), [(0, 0.99), (-1, 0.99), (5, 0.0), (5, 1.0), (5, math.nan)])
def test_there_is_no_band_of_nothing(scalars, level):
    with pytest.raises(ValueError, match="band"):
        band(scalars, level)


# -- the verdict on a channel --


def test_a_right_filter_is_consistent_at_every_length():
    rng = np.random.default_rng(2)
    for size in (1, 2, 3, 10, 100, 10_000):
        verdicts = [judge(used(rng.normal(size=size))).verdict for _ in range(200)]
        assert verdicts.count("consistent") >= 190, size


@pytest.mark.parametrize(
    ("scale", "verdict", "advice"),
    [
        (2.0, "over-confident", "multiply its variance R by 3.98 (its sigma by 1.99)"),
        (0.5, "cautious", "multiply its variance R by 0.248 (its sigma by 0.498)"),
        (1.1, "consistent", "within the practical limits"),
        (0.9, "consistent", "within the practical limits"),
    ],
)
def test_a_wrong_noise_is_said_with_its_factor(scale, verdict, advice):
    judged = judge(used(scale * np.random.default_rng(3).normal(size=40_000)))
    assert judged.verdict == verdict and advice in judged.why
    assert judged.nis == pytest.approx(scale**2, rel=0.03) and f"{judged.nis:.3g}" in judged.why
    assert judged.low == pytest.approx(0.98, abs=0.01) and judged.high == pytest.approx(1.02, abs=0.01)


def test_few_scalars_convict_nobody():
    judged = judge(used([1.5, -1.5, 1.4]))
    assert judged.nis > 2.0 and judged.verdict == "consistent"
    assert judge(used([0.0])).verdict == "cautious"  # an exact hit has no probability at all
    assert judge(used([0.1])).verdict == "consistent"


@pytest.mark.parametrize("lag", [0.6, -0.6])
def test_correlated_innovations_are_not_white(lag):
    judged = judge(used(correlated(np.random.default_rng(4), lag, 4000)))
    assert judged.verdict == "not white" and judged.lag1 == pytest.approx(lag, abs=0.05)
    assert f"lag-1 {judged.lag1:.2f}" in judged.why


def test_a_correlation_that_chance_explains_is_no_fault():
    tally = used([1.0, 1.1, 0.8, -0.9, -1.2, -0.7])
    assert 0.3 < tally.lag1 < 3 / math.sqrt(6) and judge(tally).verdict == "consistent"


def test_gusts_that_are_too_weak_are_told_by_the_air_data():
    tally = used(1.6 * correlated(np.random.default_rng(5), 0.6, 4000))
    assert "raise the turbulence sigma" in judge(tally, air_data=True).why
    other = judge(tally)
    assert other.verdict == "over-confident" and "turbulence" not in other.why and "multiply" not in other.why


def test_what_is_a_little_too_large_and_lasts_is_a_wrong_model():
    random = np.random.default_rng(7)
    lasting = used(1.12 * correlated(random, 0.25, 4000))
    assert 1.15 < lasting.nis < 1.4 and judge(lasting).verdict == "over-confident"
    white = used(1.12 * random.normal(size=4000))
    assert 1.15 < white.nis < 1.4 and judge(white).verdict == "consistent"


def test_an_offset_shows_as_correlation():
    judged = judge(used(0.9 + 0.5 * np.random.default_rng(6).normal(size=2000)))
    assert judged.verdict == "not white" and "offset" in judged.why


def test_no_data_is_no_verdict():
    for tally in (Tally(), Tally() + Tally(), used([np.nan] * 5)):
        assert judge(tally) == ("no data", "no scalar was used", None, None, None, None)
    refused = Tally().add(np.array([9.0, 9.0]), np.array([3, 3]))
    assert judge(refused).verdict == "no data" and "2 refused" in judge(refused).why


def test_refused_innovations_are_said_beside_the_mean():
    tally = Tally().add(np.random.default_rng(7).normal(size=100), np.repeat([1, 3], [75, 25]))
    assert "25 (25.0%) refused by the gate" in judge(tally).why


# -- the verdict on a parameter --


def test_a_parameter_found_is_told_with_what_was_learnt():
    found = parameter(0.01, 0.0025, 0.02)
    assert found[:5] == (0.01, 0.0025, 3.0, None, "consistent")
    assert "3.0 bit gained, 0.5 prior sigmas from zero" in found.why


@given(st.floats(0.01, 2.0), st.sampled_from([1e-6, 0.5, 1e3]), st.sampled_from([1.0, 2.0]))
def test_half_a_bit_divides_what_was_found_from_what_was_assumed(ratio, prior, factor):
    found = parameter(0.1 * prior, ratio * prior, prior, factor=factor)
    bits = math.log2(1.0 / (ratio * factor))
    if abs(bits - BITS) < 1e-9:
        return
    assert (found.verdict == "not observable") == (bits < BITS)
    assert (found.value is None) == (found.sigma is None) == (found.verdict == "not observable")
    assert found.gain == pytest.approx(max(bits, 0.0), abs=1e-9)
    if found.sigma is None:
        assert f"{found.gain:.2f} bit gained" in found.why and found.z is None
    else:
        assert found.sigma == ratio * prior * factor


def test_below_the_limit_the_prior_weighs_more_than_the_data():
    # Posterior information = prior + data; at the limit both are equal.
    prior, data = 0.5, 0.5
    sigma = (prior**-2 + data**-2) ** -0.5
    assert math.log2(prior / sigma) == pytest.approx(BITS)


@pytest.mark.parametrize("value", [0.09, -0.09])
def test_a_parameter_far_from_its_data_sheet_is_inconsistent(value):
    found = parameter(value, 0.001, 0.02)
    assert found.verdict == "inconsistent" and "4.5 prior sigmas from zero" in found.why and found.value == value


def test_test_points_that_contradict_each_other_are_inconsistent():
    others = [(0.010, 0.002), (0.012, 0.001), (None, None), (0.5, math.inf), (math.nan, 1.0)]
    weights = np.array([0.002, 0.001]) ** -2.0
    mean = np.dot(weights, [0.010, 0.012]) / weights.sum()
    expected = (0.02 - mean) / math.hypot(0.001, weights.sum() ** -0.5)
    found = parameter(0.02, 0.001, 0.02, others)
    assert found.z == pytest.approx(expected) and found.z > APART
    assert found.verdict == "inconsistent" and f"{expected:.1f} sigmas from the mean of the other" in found.why
    assert parameter(0.02, 0.001, 0.02, others, factor=3.0).verdict == "consistent"
    assert parameter(0.02, 0.001, 0.02, [(None, None)]).z is None


def test_the_distance_between_test_points_is_standard_normal():
    rng = np.random.default_rng(8)
    sigmas = np.array([0.3, 0.5, 0.2, 0.4])
    z = [
        parameter(v[0], sigmas[0], 10.0, list(zip(v[1:], sigmas[1:], strict=True))).z
        for v in 1.0 + sigmas * rng.normal(size=(4000, 4))
    ]
    assert stats.kstest(z, "norm").pvalue > 1e-3


def test_sigmas_of_any_size_can_be_compared():
    assert parameter(1e-200, 1e-201, 1e-200, [(2e-200, 1e-201)]).z == pytest.approx(-10 / math.sqrt(2))


def test_no_estimate_is_not_observable():
    for value, sigma in ((math.nan, 1.0), (0.0, math.inf), (0.0, math.nan)):
        assert parameter(value, sigma, 1.0) == (None, None, 0.0, None, "not observable", "no estimate")


@pytest.mark.parametrize(
    ("sigma", "prior", "factor", "said"),
    [(1.0, 0.0, 1.0, "prior"), (1.0, math.inf, 1.0, "prior"), (0.0, 1.0, 1.0, "sigma"), (1.0, 1.0, 0.0, "factor")],
)
def test_what_is_no_deviation_is_refused(sigma, prior, factor, said):
    with pytest.raises(ValueError, match=said):
        parameter(0.0, sigma, prior, factor=factor)


# -- where the truth is known --


def covariances(rng, k, n):
    """Covariances with units as far apart as metres and radians per second."""
    a = rng.normal(size=(k, n, n)) * 10.0 ** rng.uniform(-6, 2, n)[:, None]
    return a @ a.transpose(0, 2, 1)


def test_nees_is_what_the_dense_formula_says():
    rng = np.random.default_rng(9)
    p = covariances(rng, 50, 4)
    error = rng.normal(size=(50, 4)) * np.sqrt(np.diagonal(p, axis1=1, axis2=2))
    scale = np.sqrt(np.diagonal(p, axis1=1, axis2=2))
    expected = [(e / s) @ np.linalg.inv(c / np.outer(s, s)) @ (e / s) for e, c, s in zip(error, p, scale, strict=True)]
    found = nees(error, p)
    assert np.allclose(found.values, expected, rtol=1e-6) and (found.dof == 4).all()


def test_nees_of_a_right_covariance_is_inside_its_band():
    rng = np.random.default_rng(10)
    root = np.tril(rng.normal(size=(3, 3))) + 2 * np.eye(3)
    inside = 0
    for _ in range(400):
        found = nees(rng.normal(size=(25, 3)) @ root.T, np.broadcast_to(root @ root.T, (25, 3, 3)))
        low, high = found.band(0.95)
        inside += low <= found.mean <= high
    assert inside / 400 == pytest.approx(0.95, abs=0.04)
    assert found.band(0.95) == pytest.approx(tuple(stats.chi2.ppf([0.025, 0.975], 75) / 75))


def test_nees_of_what_is_known_is_that_of_its_marginal():
    rng = np.random.default_rng(11)
    p = covariances(rng, 4, 3)
    error = rng.normal(size=(4, 3))
    error[1, 2] = error[2] = np.nan
    p[3, 0, 0] = np.inf
    found = nees(error, p)
    assert found.dof.tolist() == [3, 2, 0, 2] and np.isnan(found.values[2])
    assert found.values[1] == pytest.approx(nees(error[1:2, :2], p[1:2, :2, :2]).values[0])
    assert found.values[3] == pytest.approx(nees(error[3:, 1:], p[3:, 1:, 1:]).values[0])
    assert found.mean == pytest.approx(np.nansum(found.values) / 7)


def test_nees_of_nothing_is_nothing():
    for error in (np.empty((0, 3)), np.full((4, 3), np.nan)):
        found = nees(error, np.full((len(error), 3, 3), np.nan))
        assert math.isnan(found.mean) and all(map(math.isnan, found.band()))


def test_a_covariance_that_is_none_is_named():
    p = np.tile(np.eye(2), (3, 1, 1))
    p[1, 0, 1] = p[1, 1, 0] = 2.0
    with pytest.raises(ValueError, match="sample 1 is not positive definite"):
        nees(np.zeros((3, 2)), p)
    p[2, 0, 0] = -1.0
    with pytest.raises(ValueError, match="sample 2: a variance"):
        nees(np.zeros((3, 2)), p)
    with pytest.raises(ValueError, match="shape"):
        nees(np.zeros((3, 2)), p[0])


@pytest.mark.parametrize("width", [1.0, 2.0, 3.0])
def test_coverage_is_that_of_the_normal_distribution(width):
    rng = np.random.default_rng(12)
    std = np.exp(rng.normal(size=(50_000, 2)))
    error = rng.normal(size=(50_000, 2)) * std * [1.0, 2.0]
    error[::7, 0] = np.nan
    std[::5, 1] = np.inf
    expected = [math.erf(width / math.sqrt(2)), math.erf(width / 2 / math.sqrt(2))]
    assert coverage(error, std, width) == pytest.approx(expected, abs=0.01)
    assert coverage(error[:, 0], std[:, 0], width).shape == ()


def test_what_is_not_known_has_no_z_score_and_no_coverage():
    error, std = np.array([1.0, np.nan, 2.0, 0.0, 3.0]), np.array([0.5, 1.0, np.inf, 0.0, 0.0])
    assert np.array_equal(zscores(error, std), [2.0, np.nan, np.nan, np.nan, np.inf], equal_nan=True)
    assert coverage(error, std) == pytest.approx(2 / 3)
    assert (
        np.isnan(coverage(np.full(3, np.nan), np.ones(3)))
        and np.isnan(coverage(np.empty((0, 2)), np.empty((0, 2)))).all()
    )
