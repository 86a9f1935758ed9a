"""Correlated noise is factored once and absorbed; what is missing is left out of it."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from estimator import noise

seeds = st.integers(0, 2**32 - 1)


@given(seeds, st.integers(1, 6), st.integers(0, 6))
@settings(max_examples=40, deadline=None)
def test_factored_gives_back_the_matrix_whatever_its_rank(seed, size, rank):
    root = np.random.default_rng(seed).normal(size=(size, min(rank, size)))
    matrix, u, d = root @ root.T, np.empty((size, size)), np.empty(size)
    assert noise.factored(matrix, 1e-12, False, u, d)
    assert np.allclose(u @ np.diag(d) @ u.T, matrix, atol=1e-10 * (1.0 + np.abs(matrix).max()))
    assert np.array_equal(np.tril(u), np.eye(size)) and (d >= 0.0).all()


@given(seeds, st.integers(1, 5), st.booleans())
@settings(max_examples=40, deadline=None)
def test_whitening_keeps_the_information_of_what_is_present(seed, m, constant):
    rng = np.random.default_rng(seed)
    n, steps = 3, 4
    root = rng.normal(size=(1 if constant else steps, m, m)) + 2.0 * np.eye(m)
    r, h, z = root @ root.transpose(0, 2, 1), rng.normal(size=(1, m, n)), rng.normal(size=(steps, m))
    z[rng.random((steps, m)) < 0.4] = np.nan
    out_h, out_r, out_z = np.empty((steps, m, n)), np.empty((steps, m)), z.copy()
    noise.whiten(r, h, z, out_h, out_r, out_z[None])
    assert np.array_equal(np.isnan(out_z), np.isnan(z))
    for j in range(steps):
        there = ~np.isnan(z[j])
        inverse = np.linalg.inv(r[min(j, len(r) - 1)][np.ix_(there, there)])
        before, after = h[0][there], out_h[j][there]
        assert np.allclose(after.T / out_r[j][there] @ after, before.T @ inverse @ before, rtol=1e-7, atol=1e-8)
        assert np.allclose(after.T / out_r[j][there] @ out_z[j][there], before.T @ inverse @ z[j][there], atol=1e-7)
