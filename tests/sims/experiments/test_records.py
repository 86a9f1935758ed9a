"""Hard records are hard, and the truth about them is beyond doubt."""

import numpy as np
import pytest

from sims.experiments.records import LIMITS, STRESS, Record, benchmark, truth
from tests.estimator.oracle import Problem, batch, exact, in_sigmas, relative

EVERY = (*STRESS, *LIMITS)
names = {make.__name__: make for make in EVERY}
whole = pytest.mark.parametrize("make", EVERY, ids=list(names))


def as_problem(record: Record) -> Problem:
    phi, gamma, q, h, r = (np.array(a) for a in record.every_step())
    q, r = q[:, :, None] * np.eye(q.shape[1]), r[:, :, None] * np.eye(r.shape[1])
    return Problem(phi, gamma, q, h, r, record.z, record.x0, record.p0)


@pytest.mark.parametrize("make", [make for make in EVERY if make().n <= 6])
def test_the_truth_is_exact_least_squares(make):
    record = make().cut(8)
    found = truth(record)
    mean, std = exact(as_problem(record))
    assert in_sigmas(found.mean, mean, std) == 0.0
    assert relative(found.std, std) == 0.0


def test_the_truth_is_batch_least_squares_in_the_plain_case_too():
    record = benchmark(5, 2, 2, 12, varying=True)
    found = truth(record)
    mean, covariance = batch(as_problem(record))
    std = np.sqrt(np.einsum("jii->ji", covariance))
    assert in_sigmas(found.mean, mean, std) < 1e-14
    assert relative(found.std, std) < 1e-14


@whole
def test_the_truth_is_finite_and_positive(make):
    record = make()
    found = truth(record)
    assert np.isfinite(found.mean).all() and np.isfinite(found.std).all() and (found.std > 0.0).all()
    known = np.isfinite(found.filtered_std).all(axis=1)
    assert np.isfinite(found.filtered_mean[known]).all() and np.isnan(found.filtered_mean[~known]).all()
    assert known[0] == (record.x0 is not None) and known[-1]
    assert (found.std[known] <= found.filtered_std[known] * (1.0 + 1e-12)).all()
    assert np.array_equal(found.std[-1], found.filtered_std[-1])


@whole
def test_a_record_is_the_same_whenever_it_is_made(make):
    one, other = make(), make()
    assert np.array_equal(one.z, other.z, equal_nan=True) and np.array_equal(one.phi, other.phi)


def test_the_families_are_what_their_names_say():
    record = {name: make() for name, make in names.items()}
    assert [record[name].n for name in ("three_axes", "fifteen_axes", "collinear")] == [6, 30, 3]
    assert record["three_axes"].steps == 100
    for name in ("three_axes", "fifteen_axes"):
        assert (record[name].r == 1e-10).all() and np.array_equal(record[name].p0, 1e10 * np.eye(record[name].n))
    rows = record["collinear"].h[0]
    assert np.ptp(rows, axis=0).max() < 2e-5 and np.linalg.matrix_rank(rows) == 2
    assert record["collinear"].gamma.shape[2] == 1
    assert np.allclose(record["near_perfect"].r, 1e-12, rtol=1e-3) and record["near_perfect"].p0[0, 0] == 1e8
    assert record["no_prior"].x0 is None and record["no_prior"].p0 is None
    lost = np.isnan(record["gaps"].z)
    assert lost.mean() > 0.5 and lost.all(axis=1).any() and (lost.any(axis=1) & ~lost.all(axis=1)).any()
    assert 0.3 < (record["silent"].q == 0.0).mean() < 0.7
    assert 0.3 < (record["no_input"].gamma == 0.0).all(axis=(1, 2)).mean() < 0.7
    spread = np.log10(record["mixed"].r.max(axis=1) / record["mixed"].r.min(axis=1))
    assert record["mixed"].r.min() < 1e-11 and record["mixed"].r.max() > 1e5 and spread.max() > 12
    modes = np.abs(np.linalg.eigvals(record["unstable"].phi[0]))
    assert np.allclose(sorted(modes), [1e-4, 0.5, 1.0, 1.3])


@pytest.mark.parametrize("varying", [False, True])
@pytest.mark.parametrize("size", [(6, 3, 3), (10, 2, 2), (5, 2, 1), (30, 15, 15)])
def test_the_benchmark_record_is_well_conditioned(size, varying):
    record = benchmark(*size, 50, varying=varying)
    n, p, m = size
    assert (record.n, record.gamma.shape[2], record.z.shape) == (n, p, (50, m))
    assert record.varying is varying and record.model().steps == (50 if varying else None)
    values = np.abs(np.linalg.eigvals(record.phi))
    assert values.min() > 0.9 and values.max() < 1.05
    assert np.linalg.cond(record.phi).max() < 1.5
    assert np.linalg.matrix_rank(record.gamma[0] @ record.gamma[0].T) == p


def test_tracks_of_one_model_differ_in_what_was_measured():
    record = benchmark(4, 2, 2, 20, tracks=3)
    assert record.z.shape == (3, 20, 2) and record.tracks == 3 and not record.varying
    assert not np.array_equal(record.z[0], record.z[1])


def test_a_cut_is_the_beginning():
    record = benchmark(4, 2, 2, 20, varying=True)
    part = record.cut(7)
    assert part.steps == 7 and part.phi.shape[0] == 7 and part.gamma.shape[0] == 1
    assert np.array_equal(part.z, record.z[:7])


def test_rows_of_variances_are_never_taken_for_a_covariance():
    record = benchmark(4, 2, 2, 2, varying=True)  # as many steps as measurements
    model = record.model()
    assert model.steps == 2 and np.allclose(model.r if model.r.ndim == 2 else np.einsum("jii->ji", model.r), record.r)
