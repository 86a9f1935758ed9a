"""What Joseph's form is for: sums keep what differences of covariances lose."""

import numpy as np

from estimator import LinearModel, smooth
from tests.estimator.oracle import exact, problem, relative


def test_a_near_perfect_measurement_leaves_its_own_variance():
    # P - K S K^T is 1e8 - 1e8; (1 - K)^2 P + K^2 R is the measurement's 1e-12.
    model = LinearModel(np.eye(1), np.zeros((1, 1)), [0.0], [[1.0]], [1e-12])
    prior = {"x0": [0.0], "p0": [1e8], "want": "filtered"}
    assert np.isclose(smooth(model, [[1.0]], **prior, method="joseph").filtered_std[1, 0], 1e-6, rtol=1e-6)
    assert smooth(model, [[1.0]], **prior, method="rts").filtered_std[1, 0] != 1e-6


def test_sums_keep_digits_where_differences_lose_them():
    # Measurements of 1e-12 beside 1e6, a prior of 1e8, unstable and stiff modes, hardly any process noise.
    lost = {"rts": 0.0, "joseph": 0.0}
    for seed in (1, 2, 4):
        case = problem(seed, 4, 2, 2, 12, r_range=(1e-12, 1e6), growth=3.0, quiet=0.8).but(p0=1e8 * np.eye(4))
        _, std = exact(case)
        for method in lost:
            lost[method] = max(lost[method], relative(smooth(case.model, case.z, **case.prior, method=method).std, std))
    assert lost["joseph"] < 1e-3 and not lost["rts"] < 10.0 * lost["joseph"]
