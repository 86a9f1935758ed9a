"""The streaming filter: pure, chunk-invariant to the bit, honest about what is not known yet."""

import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimator import InformationFilter, LinearModel, Rule, Store
from estimator.information import anchor, filter, start
from tests.estimator.oracle import in_sigmas, problem

seeds = st.integers(0, 2**32 - 1)


def run(case, cuts, rule, prior=True):
    carry, store = start(case.phi.shape[1], **(case.prior if prior else {})), Store()
    model, parts = case.model, []
    for a, b in zip([0, *cuts], [*cuts, len(case.z)], strict=True):
        carry, filtered = filter(model.cut(a, b), carry, case.z[a:b], rule=rule, store=store)
        parts.append(filtered)
    return carry, [np.concatenate(field) for field in zip(*parts, strict=True)], store


def same(a, b):
    return all(np.array_equal(x, y, equal_nan=True) for x, y in zip(a, b, strict=True))


@given(
    seeds, st.integers(1, 8), st.integers(1, 4), st.integers(1, 3), st.booleans(), st.booleans(),
    st.sampled_from([1, 5, 16, 100]), st.data(),
)  # fmt: skip
@settings(max_examples=60, deadline=None)
def test_any_chunks_give_the_same_bits(seed, n, p, m, prior, correlated, length, data):
    steps = 40
    growth = data.draw(st.sampled_from([1.0, 1.5]))
    case = problem(seed, n, p, m, steps, missing=0.3, correlated=correlated, growth=growth, quiet=0.2)
    rule = Rule(steps=length, kappa=data.draw(st.sampled_from([10.0, 1e4])))
    cuts = sorted(data.draw(st.lists(st.integers(0, steps), max_size=6)))
    whole = run(case, [], rule, prior)
    for cut in (cuts, list(range(1, steps))):
        carry, filtered, store = run(case, cut, rule, prior)
        assert same(carry, whole[0])
        assert same(filtered, whole[1])
        assert same(store.steps, whole[2].steps) and store.anchors == whole[2].anchors
        assert store.reasons == whole[2].reasons


def test_a_long_record_in_batches_of_a_thousand_and_one_by_one():
    case = problem(3, 5, 2, 2, 1000, missing=0.2)
    one = run(case, list(range(1, 1000)), Rule())
    all_at_once = run(case, [], Rule())
    assert same(one[0], all_at_once[0]) and same(one[1], all_at_once[1])
    assert same(one[2].steps, all_at_once[2].steps)


def test_the_carry_is_never_changed():
    case = problem(4)
    carry = start(4, **case.prior)
    copies = [np.array(a) for a in carry]
    after, _ = filter(case.model, carry, case.z)
    anchor(after)
    assert same(carry, copies) and after.steps == 20
    with pytest.raises(ValueError, match="read-only"):
        after.d[0] = 1.0


def test_no_steps_change_nothing():
    case = problem(5)
    carry = start(4, **case.prior)
    after, filtered = filter(case.model.cut(3, 3), carry, np.empty((0, 2)))
    assert after is carry and filtered.mean.shape == (0, 4) and filtered.nis.shape == (0,)


def test_the_filter_is_the_kalman_filter():
    for seed in range(5):
        case = problem(seed, 5, 2, 3, 30, missing=0.3, correlated=True)
        _, filtered = filter(case.model, start(5, **case.prior), case.z, rule=Rule(steps=7))
        x, p = case.x0, case.p0
        for j in range(30):
            x = case.phi[j] @ x
            p = case.phi[j] @ p @ case.phi[j].T + case.gamma[j] @ case.q[j] @ case.gamma[j].T
            there = ~np.isnan(case.z[j])
            h, r = case.h[j][there], case.r[j][np.ix_(there, there)]
            nu, s = case.z[j][there] - h @ x, h @ p @ h.T + r
            gain = p @ h.T @ np.linalg.inv(s)
            x, p = x + gain @ nu, p - gain @ s @ gain.T
            assert np.allclose(filtered.mean[j], x, rtol=1e-9, atol=1e-9)
            assert np.allclose(filtered.std[j], np.sqrt(np.diag(p)), rtol=1e-9)
            assert filtered.nis[j] == pytest.approx(nu @ np.linalg.solve(s, nu), rel=1e-8, abs=1e-10)
            assert filtered.dof[j] == there.sum()


def test_nis_is_chi_square():
    case = problem(11, 4, 2, 2, 4000, missing=0.2)
    _, filtered = filter(case.model, start(4, **case.prior), case.z)
    total, dof = filtered.nis.sum(), filtered.dof.sum()
    assert abs(total - dof) < 4.0 * np.sqrt(2.0 * dof)


def test_the_sum_of_nis_is_the_first_pivot():
    case = problem(12, prior=False)
    carry, filtered = filter(case.model, start(4), case.z)
    assert filtered.nis.sum() == pytest.approx(carry.d[0], rel=1e-12)


def test_without_prior_there_is_no_estimate_before_every_direction_is_known():
    # A clock with a drift, measured at its reading: two readings are needed, and only the third can be compared.
    model = LinearModel([[1.0, 1.0], [0.0, 1.0]], np.zeros((2, 1)), [0.0], [[1.0, 0.0]], [1.0])
    carry, filtered = filter(model, start(2), [[1.0], [2.0], [np.nan], [4.0], [5.5]])
    assert np.isnan(filtered.mean[0]).all() and np.isinf(filtered.std[0]).all()
    assert np.allclose(filtered.mean[1], [2.0, 1.0]) and np.isfinite(filtered.std[1:]).all()
    assert filtered.dof.tolist() == [0, 0, 0, 1, 1]
    assert np.allclose(filtered.nis[:4], 0.0, atol=1e-20) and filtered.nis[4] > 0.01
    assert carry.regular


@pytest.mark.parametrize("length", [1, 4, 100])
def test_an_oblique_direction_nobody_sees_never_becomes_known(length):
    # Only the sum of the two states is measured: rounding leaves a pivot that is not zero, and is not information.
    model = LinearModel(np.eye(2), np.eye(2), [0.0, 0.0], [[0.1, 0.3]], [0.01])
    z = np.random.default_rng(0).normal(size=(300, 1))
    carry, filtered = filter(model, start(2), z, rule=Rule(steps=length))
    assert not carry.regular
    assert np.isnan(filtered.mean).all() and np.isinf(filtered.std).all()
    assert filtered.dof.tolist() == [0] + [1] * 299


def test_partial_prior_information():
    model = LinearModel(np.eye(2), np.zeros((2, 1)), [0.0], [[0.0, 1.0]], [1.0])
    _, filtered = filter(model, start(2, [5.0, 0.0], [4.0, np.inf]), [[2.0], [4.0]])
    assert np.allclose(filtered.mean, [[5.0, 2.0], [5.0, 3.0]])
    assert np.allclose(filtered.std**2, [[4.0, 1.0], [4.0, 0.5]])
    assert filtered.dof.tolist() == [0, 1]


def test_a_masked_measurement_is_a_removed_one():
    case = problem(21, 5, 2, 3, 30, correlated=True)
    z = case.z.copy()
    z[:, 1] = np.nan
    left = np.ix_(range(30), [0, 2], [0, 2])
    removed = case.but(h=np.ascontiguousarray(case.h[:, [0, 2]]), r=case.r[left], z=np.ascontiguousarray(z[:, [0, 2]]))
    masked, _ = filter(case.model, start(5, **case.prior), z)
    other, _ = filter(removed.model, start(5, **case.prior), removed.z)
    assert same(masked, other)


def test_anchoring_changes_no_estimate():
    case = problem(22, 6, 2, 2, 30)
    model, carry = case.model, start(6, **case.prior)
    _, whole = filter(model, carry, case.z)
    carry, _ = filter(model.cut(0, 11), carry, case.z[:11])
    carry = anchor(carry)
    assert carry.steps == 0 and np.array_equal(carry.phi, np.eye(6)) and anchor(carry) is carry
    _, rest = filter(model.cut(11, 30), carry, case.z[11:])
    assert in_sigmas(rest.mean, whole.mean[11:], whole.std[11:]) < 1e-11
    assert np.allclose(rest.std, whole.std[11:], rtol=1e-11)


def test_estimates_can_be_left_out():
    case = problem(23)
    full, _ = filter(case.model, start(4, **case.prior), case.z)
    bare, filtered = filter(case.model, start(4, **case.prior), case.z, estimates=False)
    assert same(full, bare) and filtered.mean.shape == (0, 4) and filtered.nis.shape == (20,)


def test_the_live_object_is_the_same_function():
    case = problem(24, missing=0.2)
    whole, filtered = filter(case.model, start(4, **case.prior), case.z, store=(store := Store()))
    live = InformationFilter(case.model, case.x0, case.p0, store=Store())
    for j in range(20):
        step = live.step(case.z[j])
        assert np.array_equal(step.mean, filtered.mean[j]) and np.array_equal(step.std, filtered.std[j])
        assert step.nis == filtered.nis[j] and step.dof == filtered.dof[j]
    assert same(live.carry, whole) and same(live.store.steps, store.steps)
    extra = live.step([0.0, np.nan], model=case.model.cut(0, 1))
    assert extra.mean.shape == (4,)


def test_importing_the_package_does_not_import_numba():
    code = "import sys, estimator; assert 'numba' not in sys.modules; estimator.smooth; assert 'numba' in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize(
    ("x0", "p0", "message"),
    [
        ([0.0, 0.0], None, "x0 and p0 come together"),
        (None, np.eye(2), "x0 and p0 come together"),
        ([0.0], np.eye(2), r"x0 has shape \(1,\)"),
        ([0.0, np.nan], np.eye(2), "x0 is not finite"),
        ([0.0, 0.0], np.eye(3), r"p0 has shape \(3, 3\)"),
        ([0.0, 0.0], [[1.0, 0.5], [0.2, 1.0]], "p0 is not symmetric"),
        ([0.0, 0.0], [1.0, 0.0], "p0 is singular or indefinite; every state needs a variance above zero"),
        ([0.0, 0.0], [[1.0, 1.0], [1.0, 1.0]], "p0 is singular"),
        ([0.0, 0.0], [[1.0, 2.0], [2.0, 1.0]], "p0 is singular or indefinite"),
        ([0.0, 0.0], [[np.inf, 2.0], [2.0, 1.0]], "p0 is not finite"),
        ([0.0, 0.0], [[np.nan, 0.0], [0.0, 1.0]], "p0 is not finite"),
    ],
)
def test_a_prior_that_cannot_be_is_refused(x0, p0, message):
    with pytest.raises(ValueError, match=message):
        start(2, x0, p0)


def test_what_cannot_be_filtered_is_refused_by_name_and_step_and_changes_nothing():
    case = problem(31)
    model, store, carry = case.model, Store(), start(4, **case.prior)
    carry, _ = filter(model.cut(0, 5), carry, case.z[:5], store=store)
    held = [np.array(a) for a in store.steps]
    z = case.z[5:].copy()
    z[3, 1] = np.inf
    with pytest.raises(ValueError, match="z is infinite at step 3"):
        filter(model.cut(5, 20), carry, z, store=store)
    phi = case.phi[5:].copy()
    phi[2, :, 0] = phi[2, :, 1]
    singular = LinearModel(phi, model.gamma[5:], model.q[5:], model.h[5:], model.r[5:])
    with pytest.raises(ValueError, match="phi is singular at step 2"):
        filter(singular, carry, case.z[5:], store=store)
    huge = LinearModel(1e200 * np.eye(4), np.ones((4, 1)), [1e300], np.eye(4), np.full(4, 1e-300))
    with pytest.raises(ValueError, match="no longer finite at step"):
        filter(huge, start(4), np.ones((5, 4)))
    assert same(store.steps, held)
    with pytest.raises(ValueError, match="carry has 3 states, the model has 4"):
        filter(model, start(3), case.z)
    with pytest.raises(ValueError, match=r"z has shape \(20, 1\), \(N, 2\) is needed"):
        filter(model, carry, case.z[:, :1])
    with pytest.raises(ValueError, match="z has 7 rows, the model 20 steps"):
        filter(model, carry, case.z[:7])


def test_infinite_measurement_with_correlated_noise():
    case = problem(32, correlated=True)
    z = case.z.copy()
    z[6, 0] = -np.inf
    with pytest.raises(ValueError, match="z is infinite at step 6"):
        filter(case.model, start(4, **case.prior), z)


def test_the_live_object_names_the_step_of_the_record():
    live = InformationFilter(
        LinearModel(np.eye(2), np.eye(2), [1.0, 1.0], np.eye(2), [1.0, 1.0]), [0.0, 0.0], [1.0, 1.0]
    )
    for _ in range(7):
        live.step([1.0, 2.0])
    with pytest.raises(ValueError, match="phi is singular at step 7"):
        live.step([1.0, 2.0], LinearModel(np.zeros((2, 2)), np.eye(2), [1.0, 1.0], np.eye(2), [1.0, 1.0]))


def test_a_prior_beyond_the_number_type_is_refused():
    with pytest.raises(ValueError, match="x0 or 1 / p0 is beyond float32"):
        start(2, [1e40, 0.0], [1.0, 1.0], dtype=np.float32)
