"""Every smoother of linear systems, on random systems, windows, gaps and priors, is batch least squares."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from estimator import LinearModel, Unobservable, rivals, smooth
from estimator.linear import RESULTS
from tests.estimator.oracle import batch, in_correlation, in_sigmas, problem, relative

METHODS = ["ms", *rivals.METHODS]
PRIORLESS = {"ms", "watanabe"}  # the others are told so, and say so
EPS = np.finfo(float).eps
BOUND = {"watanabe": 1e-6}  # sigma; it carries the information vector, the others a square root of it or the state


# Drawn as arguments of ``problem``, not as arrays: a failure then prints what one can read and use again.
records = st.fixed_dictionaries(
    {
        "seed": st.integers(0, 2**32 - 1),
        "n": st.integers(1, 9),
        "p": st.integers(1, 4),
        "m": st.integers(1, 4),
        "steps": st.integers(1, 20),
        "prior": st.booleans(),
        "missing": st.sampled_from([0.0, 0.3, 0.7]),
        "correlated": st.booleans(),
        "quiet": st.sampled_from([0.0, 0.4]),
    }
)


@given(records, st.sampled_from([1, 2, 7, None]), st.sampled_from([1, 2]))
@settings(max_examples=80, deadline=None)
def test_every_method_is_batch_least_squares(record, window, threads):
    case = problem(**record)
    mean = covariance = None
    for method in METHODS if case.x0 is not None else sorted(PRIORLESS):
        try:
            found = smooth(case.model, case.z, **case.prior, method=method, window=window, threads=threads)
        except Unobservable:
            assert case.x0 is None  # too few measurements for a start from nothing
            continue
        except ValueError as error:
            # A prediction that has lost rank is no fault of the record; these two alone have to invert it.
            assert method in ("rts", "joseph") and "not positive definite" in str(error)
            continue
        if mean is None:
            mean, covariance = batch(case)
            std = np.sqrt(np.einsum("jii->ji", covariance))
            # Few measurements can tell a start from nothing badly: then float64 keeps fewer digits.
            slack = 0.0 if case.x0 is not None else 1e-7
        assert in_sigmas(found.mean, mean, std) < (
            BOUND.get(method, 1e-8) + slack + 1e2 * EPS * np.abs(mean / std).max()
        ), method
        assert relative(found.std, std) < 1e-8 + slack, method
        assert in_correlation(found.covariance, covariance) < 1e-8 + slack, method
        assert np.array_equal(found.covariance, found.covariance.transpose(0, 2, 1)), method


@given(records, st.sampled_from([1, 7, None]))
@settings(max_examples=25, deadline=None)
def test_a_masked_measurement_is_a_removed_one(record, window):
    case = problem(**record)
    if case.x0 is None or not np.isnan(case.z).any():
        return
    wild = case.h.copy()
    wild[np.isnan(case.z)] = 1e6  # what an absent sensor would have measured is nobody's business
    for method in METHODS:
        try:
            one, other = (
                smooth(c.model, c.z, **c.prior, method=method, window=window) for c in (case, case.but(h=wild))
            )
        except ValueError as error:
            assert method in ("rts", "joseph") and "not positive definite" in str(error)
            continue
        assert in_sigmas(one.mean, other.mean, other.std) < 1e-12 and relative(one.std, other.std) < 1e-12


@given(st.integers(0, 2**32 - 1), st.sampled_from(METHODS), st.sampled_from([np.float64, np.float32]))
@settings(max_examples=40, deadline=None)
def test_covariances_are_symmetric_and_variances_positive_in_both_number_types(seed, method, dtype):
    case = problem(seed, 5, 2, 2, 30, missing=0.2)
    model = LinearModel(case.phi, case.gamma, case.q, case.h, case.r, dtype=dtype)
    found = smooth(
        model, case.z, **case.prior, method=method, want=RESULTS if method == "ms" else ("std", "covariance")
    )
    assert found.covariance.dtype == dtype and (found.std > 0.0).all()
    assert np.array_equal(found.covariance, found.covariance.transpose(0, 2, 1))
    assert np.allclose(
        np.sqrt(np.einsum("jii->ji", found.covariance)), found.std, rtol=1e-3 if dtype == np.float32 else 1e-12
    )
