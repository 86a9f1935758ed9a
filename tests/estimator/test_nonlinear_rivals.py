"""Extended, unscented and cubature Kalman filters in covariance form: what they should give, and where they stop."""

from __future__ import annotations

import numpy as np
import pytest
from numba import njit

from estimator import cubature
from estimator.rivals import ckf, ekf, ukf
from sims.experiments.coordinated_turn import PROBLEM, X0, radar, radar_jacobian, turn, turn_jacobian
from sims.experiments.stress import cases, exact

RIVALS = [ckf, ukf, ekf]
PHI = np.array([[1.0, 0.1, 0.0], [0.0, 1.0, 0.1], [-0.2, 0.0, 0.9]])
H = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, 0.0]])
MEAN = np.array([1.0, -2.0, 0.5])
ROOT = np.array([[1.0, 0.0, 0.0], [0.3, 0.5, 0.0], [-0.2, 0.1, 2.0]])
SQRT_Q = np.array([[0.1, 0.0], [0.0, 0.2], [0.3, 0.1]])
SQRT_R = np.array([[0.2, 0.0], [0.1, 0.4]])
Z = np.array([1.3, -1.7])
BEARING = (1,)
_turn, _radar = turn.py_func, radar.py_func  # models in plain Python


def f(x):
    return PHI @ x


def h(x):
    return H @ x


def kalman(z, rows):
    """Mean and covariance by the textbook, and those of the prediction."""
    predicted, p = PHI @ MEAN, PHI @ ROOT @ ROOT.T @ PHI.T + SQRT_Q @ SQRT_Q.T
    some, r = H[rows], (SQRT_R @ SQRT_R.T)[np.ix_(rows, rows)]
    gain = p @ some.T @ np.linalg.inv(some @ p @ some.T + r)
    return predicted + gain @ (z[rows] - some @ predicted), p - gain @ some @ p, predicted, p


@pytest.mark.parametrize("rival", RIVALS)
@pytest.mark.parametrize("rows", [[0, 1], [0], [1], []])
def test_a_linear_step_is_that_of_the_kalman_filter_without_what_is_missing(rival, rows):
    z = np.where(np.isin([0, 1], rows), Z, np.nan)
    mean, root = rival.filter_step(MEAN, ROOT, f, h, z, SQRT_Q, SQRT_R)
    known, cov, _, _ = kalman(z, rows)
    np.testing.assert_allclose(mean, known, atol=1e-9)
    np.testing.assert_allclose(root @ root.T, cov, atol=1e-9)
    np.testing.assert_array_equal(root, np.tril(root))


@pytest.mark.parametrize("rival", RIVALS)
def test_no_measurement_is_a_missing_one(rival):
    for one, other in zip(
        rival.filter_step(MEAN, ROOT, f, h, None, SQRT_Q, SQRT_R),
        rival.filter_step(MEAN, ROOT, f, h, [np.nan, np.nan], SQRT_Q, SQRT_R),
        strict=True,
    ):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("rival", RIVALS)
def test_a_linear_step_back_is_that_of_rauch_tung_and_striebel(rival):
    known, cov, predicted, p = kalman(Z, [0, 1])
    gain = ROOT @ ROOT.T @ PHI.T @ np.linalg.inv(p)
    mean, root = rival.smooth_step(MEAN, ROOT, f, SQRT_Q, known, np.linalg.cholesky(cov))
    np.testing.assert_allclose(mean, MEAN + gain @ (known - predicted), atol=1e-9)
    np.testing.assert_allclose(root @ root.T, ROOT @ ROOT.T + gain @ (cov - p) @ gain.T, atol=1e-9)


def test_moments_of_a_square_are_exact_in_the_unscented_filter_and_want_a_fourth_in_the_cubature_filter():
    # x^2 of N(m, p): mean m^2 + p, variance 4 m^2 p + 2 p^2; the points at +- sigma do not see the last term
    m, p = 1.5, 0.49
    for step, variance in ((ukf.filter_step, 4 * m**2 * p + 2 * p**2), (ckf.filter_step, 4 * m**2 * p)):
        mean, root = step([m], [[np.sqrt(p)]], np.square, h, None, [[0.0]], SQRT_R)
        assert mean[0] == pytest.approx(m**2 + p, rel=1e-12)
        assert root[0, 0] ** 2 == pytest.approx(variance, rel=1e-12)


def test_without_kappa_the_unscented_filter_is_the_cubature_filter():
    z = _radar(_turn(X0)) + PROBLEM.sqrt_r @ [0.5, -0.7]
    given = X0, PROBLEM.sqrt_p, _turn, _radar, z, PROBLEM.sqrt_q, PROBLEM.sqrt_r, BEARING
    for one, other in zip(ukf.filter_step(*given, kappa=0.0), ckf.filter_step(*given), strict=True):
        np.testing.assert_array_equal(one, other)
    assert not np.array_equal(ukf.filter_step(*given)[0], ckf.filter_step(*given)[0])


def test_kappa_may_not_take_the_points_away():
    with pytest.raises(ValueError, match=r"kappa is -3\.0 with 3 states: n \+ kappa must be positive"):
        ukf.filter_step(MEAN, ROOT, f, h, Z, SQRT_Q, SQRT_R, kappa=-3.0)


def test_the_cubature_filter_in_covariance_form_is_the_one_in_square_roots():
    z = _radar(_turn(X0)) + PROBLEM.sqrt_r @ [0.5, -0.7]
    given = X0, PROBLEM.sqrt_p, _turn, _radar, z, PROBLEM.sqrt_q, PROBLEM.sqrt_r, BEARING
    mean, root = ckf.filter_step(*given)
    other, other_root = cubature.filter_step(*given)
    np.testing.assert_allclose(mean, other, rtol=1e-11)
    np.testing.assert_allclose(root @ root.T, other_root @ other_root.T, rtol=1e-9, atol=1e-12)
    back, back_root = ckf.smooth_step(X0, PROBLEM.sqrt_p, _turn, PROBLEM.sqrt_q, mean, root)
    other, other_root = cubature.smooth_step(X0, PROBLEM.sqrt_p, _turn, PROBLEM.sqrt_q, mean, root)
    np.testing.assert_allclose(back, other, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(back_root @ back_root.T, other_root @ other_root.T, rtol=1e-8, atol=1e-10)


def test_differences_do_what_jacobians_do():
    z = _radar(_turn(X0)) + PROBLEM.sqrt_r @ [0.5, -0.7]
    given = X0, PROBLEM.sqrt_p, _turn, _radar, z, PROBLEM.sqrt_q, PROBLEM.sqrt_r, BEARING
    slopes = {"f_jacobian": turn_jacobian.py_func, "h_jacobian": radar_jacobian.py_func}
    for one, other in zip(ekf.filter_step(*given), ekf.filter_step(*given, **slopes), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("rival", RIVALS)
def test_a_whole_turn_in_a_bearing_changes_nothing_and_the_seam_is_no_place(rival):
    x = np.array([-3000.0, 200.0, 5.0, -40.0, 0.05])  # bearings of its points on both sides of pi
    z = _radar(_turn(x)) + PROBLEM.sqrt_r @ [0.5, 0.7]
    rotated, turned = np.eye(5), x.copy()
    rotated[:4, :4] = -np.eye(4)
    turned[:4] = -x[:4]
    given = PROBLEM.sqrt_q, PROBLEM.sqrt_r, BEARING
    mean, root = rival.filter_step(x, PROBLEM.sqrt_p, _turn, _radar, z, *given)
    again, same = rival.filter_step(x, PROBLEM.sqrt_p, _turn, _radar, z + np.array([0.0, 2.0 * np.pi]), *given)
    np.testing.assert_allclose(again, mean, rtol=1e-9)
    np.testing.assert_allclose(same, root, atol=1e-9)
    away, other = rival.filter_step(turned, PROBLEM.sqrt_p, _turn, _radar, z + np.array([0.0, np.pi]), *given)
    np.testing.assert_allclose(rotated @ away, mean, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(rotated @ other @ other.T @ rotated, root @ root.T, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("case", cases(), ids=lambda case: case.name)
def test_differences_of_covariances_fail_where_square_roots_do_not(case):
    def plain(x):
        return case.phi @ x

    def seen(x):
        return case.h @ x

    def after(step):
        mean, root = np.zeros(len(case.phi), case.phi.dtype), case.sqrt_p
        for _ in range(case.steps):
            mean, root = step(mean, root, plain, seen, np.zeros(len(case.h)), case.sqrt_q, case.sqrt_r)
        assert root.dtype == case.phi.dtype
        return np.sqrt((root.astype(float) ** 2).sum(axis=1))

    true = exact(case)
    tolerance = 1e-4 if case.phi.dtype == np.float32 else 1e-8
    np.testing.assert_allclose(after(cubature.filter_step), true, rtol=tolerance)
    try:
        wrong = after(ckf.filter_step)
    except ArithmeticError as error:
        assert "cubature filter in covariance form: the covariance" in str(error)
        assert "is not positive definite" in str(error)
    else:
        assert np.abs(wrong / true - 1.0).max() > 0.5


def test_at_least_three_hard_cases_stop_the_covariance_form():
    stopped = 0
    for case in cases():
        mean, root = np.zeros(len(case.phi), case.phi.dtype), case.sqrt_p
        try:
            for _ in range(case.steps):
                mean, root = ckf.filter_step(
                    mean, root, lambda x, a=case.phi: a @ x, lambda x, a=case.h: a @ x, np.zeros(len(case.h)),
                    case.sqrt_q, case.sqrt_r,
                )  # fmt: skip
        except ArithmeticError:
            stopped += 1
    assert stopped >= 3


@pytest.mark.parametrize("rival", RIVALS)
def test_a_model_that_gives_no_number_is_named(rival):
    def broken(x):
        return np.full(len(x), np.nan)

    def blind(x):
        return np.array([np.inf, 0.0])

    with pytest.raises(FloatingPointError, match="f, broken, gave a number that is not finite"):
        rival.filter_step(MEAN, ROOT, broken, h, Z, SQRT_Q, SQRT_R)
    with pytest.raises(FloatingPointError, match="h, blind, gave a number that is not finite"):
        rival.filter_step(MEAN, ROOT, f, blind, Z, SQRT_Q, SQRT_R)


@pytest.mark.parametrize("rival", RIVALS)
def test_single_precision_stays_single(rival):
    mean, root = rival.filter_step(MEAN.astype(np.float32), ROOT, f, h, Z, SQRT_Q, SQRT_R)
    assert mean.dtype == root.dtype == np.float32
    np.testing.assert_allclose(mean, kalman(Z, [0, 1])[0], atol=2e-3 if rival is ekf else 1e-5)


@pytest.mark.parametrize("rival", [ckf, ekf])
def test_compiled_models_give_what_python_gives(rival):
    def swing(x):
        return np.array([x[0] + 0.1 * x[1], x[1] - 0.1 * np.sin(x[0])])

    def sight(x):
        return np.array([np.cos(x[0])])

    given = [0.4, -0.2], [[0.3, 0.0], [0.1, 0.2]], [0.7], [[0.01, 0.0], [0.0, 0.02]], [[0.1]]
    mean, root, z, q, r = given
    expected = rival.filter_step(mean, root, swing, sight, z, q, r)
    for found, known in zip(rival.filter_step(mean, root, njit(swing), njit(sight), z, q, r), expected, strict=True):
        np.testing.assert_allclose(found, known, rtol=1e-9)


@pytest.mark.parametrize("rival", RIVALS)
@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"sqrt_q": np.ones((400, 2))}, "sqrt_q has shape"),
        ({"sqrt_r": np.ones((400, 2))}, "sqrt_r has shape"),
        ({"sqrt_cov": np.ones((1, 1))}, "sqrt_cov has shape"),
    ],
)
def test_what_does_not_fit_is_refused_by_name(rival, changed, words):
    given = {"sqrt_cov": ROOT, "sqrt_q": SQRT_Q, "sqrt_r": SQRT_R} | changed
    with pytest.raises(ValueError, match=words):
        rival.filter_step(MEAN, given["sqrt_cov"], f, h, Z, given["sqrt_q"], given["sqrt_r"])


@pytest.mark.parametrize("rival", RIVALS)
def test_a_model_may_write_on_the_state_it_is_given(rival):
    def writes_f(x):
        x[:] = PHI @ x
        return x

    def writes_h(x):
        x *= 2.0
        return 0.5 * H @ x

    before = MEAN.copy()
    clean = rival.filter_step(MEAN, ROOT, f, h, Z, SQRT_Q, SQRT_R)
    written = rival.filter_step(MEAN, ROOT, writes_f, writes_h, Z, SQRT_Q, SQRT_R)
    np.testing.assert_array_equal(MEAN, before)
    for mine, theirs in zip(written, clean, strict=True):
        np.testing.assert_allclose(mine, theirs, atol=1e-9)
