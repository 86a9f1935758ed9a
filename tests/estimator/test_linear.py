"""One door: any linear system in, `Smoothed` out, and everything that does not fit named with its step."""

import numpy as np
import pytest

from estimator import LinearModel, Smoothed, smooth
from estimator.linear import RESULTS
from sims.experiments.records import STRESS, dying
from tests.estimator.oracle import Problem, batch, in_sigmas, problem, relative

N, P, M = 4, 2, 3
GOOD = {"phi": np.eye(N), "gamma": np.ones((N, P)), "q": np.ones(P), "h": np.ones((M, N)), "r": np.ones(M)}


def model(**changes):
    return LinearModel(**{**GOOD, **changes})


def bad(shape, at, value):
    array = np.ones(shape)
    array[at] = value
    return array


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"phi": np.eye(3)}, r"h has shape \(3, 4\) per step, \(3, 3\) is needed|gamma has shape"),
        ({"phi": np.ones((2, 3))}, r"phi has shape \(2, 3\) per step, \(3, 3\) is needed"),
        ({"phi": np.ones(4)}, r"phi has shape \(4,\), \(n, n\) or \(N, n, n\) is needed"),
        ({"gamma": np.ones((3, P))}, r"gamma has shape \(3, 2\) per step, \(4, 2\) is needed"),
        ({"h": np.ones((M, 5))}, r"h has shape \(3, 5\) per step, \(3, 4\) is needed"),
        ({"q": np.ones(3)}, r"q has shape \(3,\)"),
        ({"q": np.ones((7, 3))}, r"q has shape \(7, 3\)"),
        ({"r": np.ones((2, 2))}, r"r has shape \(2, 2\)"),
        ({"r": "loud"}, "r is not an array of numbers"),
        ({"phi": np.ones((5, N, N)), "q": np.ones((6, P))}, "q is given for 6 steps, others for 5"),
        ({"phi": bad((5, N, N), (3, 0, 0), np.nan)}, "phi is not finite at step 3"),
        ({"gamma": bad((5, N, P), (2, 0, 0), np.inf)}, "gamma is not finite at step 2"),
        ({"h": bad((M, N), (0, 0), np.nan)}, "h is not finite at step 0"),
        ({"q": bad((7, P), (4, 1), -1.0)}, "q is negative at step 4"),
        ({"q": bad((7, P), (4, 1), np.nan)}, "q is not finite at step 4"),
        ({"r": bad((7, M), (6, 1), 0.0)}, "r is not positive at step 6"),
        ({"r": bad((7, M), (6, 1), -np.inf)}, "r is not finite at step 6"),
        (
            {"q": np.stack([np.eye(P), [[1.0, 2.0], [2.0, 1.0]]])},
            r"q is not symmetric and positive semidef.* at step 1",
        ),
        ({"q": [[1.0, 0.3], [0.2, 1.0]]}, "q is not symmetric"),
        ({"q": [[1.0, 0.3], [0.3, 0.0]]}, "q is not symmetric and positive semidefinite at step 0"),
        ({"r": np.stack([np.eye(M), np.ones((M, M))])}, "r is not symmetric and positive definite at step 1"),
        ({"r": np.diag([1.0, 0.0, 1.0])}, "r is not symmetric and positive definite at step 0"),
    ],
)
def test_a_model_that_cannot_be_is_refused_by_argument_and_step(changes, message):
    with pytest.raises(ValueError, match=message):
        model(**changes)


def test_shapes_and_steps():
    assert model().steps is None and repr(model()) == "LinearModel(n=4, p=2, m=3, constant)"
    varying = model(phi=np.broadcast_to(np.eye(N), (5, N, N)))
    assert varying.steps == 5 and "5 steps" in repr(varying)
    assert model(q=np.ones((9, P))).steps == 9
    assert model(r=np.ones((9, M))).steps == 9
    assert varying.cut(1, 3).steps == 2 and varying.cut(1, 3).q.shape == (1, P)
    with pytest.raises(IndexError, match=r"steps 3\.\.6 of a model of 5 steps"):
        varying.cut(3, 6)


def test_read_only_and_strided_arrays_are_fine():
    phi = np.asfortranarray(np.eye(N) + 0.1)
    phi.flags.writeable = False
    smooth(model(phi=phi), np.ones((5, 2 * M))[:, ::2], x0=np.zeros(N), p0=np.eye(N))


def test_a_square_q_is_a_covariance_unless_it_can_only_be_rows():
    q = np.array([[2.0, 1.0], [1.0, 2.0]])
    per_step = {"phi": np.broadcast_to(np.eye(N), (P, N, N))}
    more = {"phi": np.broadcast_to(np.eye(N), (P + 1, N, N))}
    for same in (model(q=q), model(q=q[None]), model(q=q, **more), model(q=q[None], **per_step)):
        assert np.allclose(same.gamma[0] @ np.diag(same.q[0]) @ same.gamma[0].T, GOOD["gamma"] @ q @ GOOD["gamma"].T)
    for rows in (np.array([[1.0, 2.0], [1.0, 2.0]]), np.ones((P, P))):
        assert np.array_equal(model(q=rows, **per_step).q, rows)
        assert np.array_equal(model(q=rows, **per_step).gamma[0], GOOD["gamma"])
    for either in (q, np.diag([1.0, 2.0])):
        with pytest.raises(ValueError, match=r"q has shape \(2, 2\) beside 2 steps: one covariance is written \(1"):
            model(q=either, **per_step)


def test_a_singular_covariance_of_process_noise_is_absorbed():
    q = np.outer([1.0, 2.0], [1.0, 2.0])
    absorbed = model(q=q)
    gamma = absorbed.gamma[0]
    assert np.allclose(gamma @ np.diag(absorbed.q[0]) @ gamma.T, np.ones((N, P)) @ q @ np.ones((P, N)))


@pytest.mark.parametrize("method", ["ms", "rts"])
def test_constant_matrices_are_the_same_as_repeated_ones(method):
    rng = np.random.default_rng(0)
    phi, gamma, h = 0.5 * rng.normal(size=(4, 4)), rng.normal(size=(4, 2)), rng.normal(size=(3, 4))
    q, r = np.array([[2.0, 1.0], [1.0, 3.0]]), np.eye(3) + 0.3
    z, prior = rng.normal(size=(10, 3)), {"x0": np.zeros(4), "p0": np.eye(4), "method": method}
    constant = smooth(LinearModel(phi, gamma, q, h, r), z, **prior)
    repeated = smooth(LinearModel(*(np.repeat(a[None], 10, axis=0) for a in (phi, gamma, q, h, r))), z, **prior)
    for name in set(constant._fields) - {"bytes_per_step"}:  # constant matrices are looked up, not kept
        assert np.array_equal(getattr(constant, name), getattr(repeated, name), equal_nan=True)
    assert constant.bytes_per_step <= repeated.bytes_per_step


def test_the_fields_of_smoothed():
    case = problem(1, 4, 2, 2, 30, missing=0.2)
    smoothed = smooth(case.model, case.z, **case.prior, window=10)
    assert isinstance(smoothed, Smoothed) and smoothed.windows == [0, 10, 20]
    for field in (smoothed.mean, smoothed.std, smoothed.filtered_mean, smoothed.filtered_std):
        assert field.shape == (31, 4)
    assert smoothed.covariance.shape == (31, 4, 4) and smoothed.bytes_per_step == 8 * (16 + 16 + 4)
    assert np.array_equal(smoothed.filtered_mean[0], case.x0)
    assert np.allclose(smoothed.filtered_std[0], np.sqrt(np.diag(case.p0)))
    assert np.allclose(smoothed.filtered_mean[-1], smoothed.mean[-1])


def test_without_prior_row_0_of_the_filter_is_empty():
    case = problem(2, prior=False)
    smoothed = smooth(case.model, case.z)
    assert np.isnan(smoothed.filtered_mean[0]).all() and np.isinf(smoothed.filtered_std[0]).all()
    mean, covariance = batch(case)
    std = np.sqrt(np.einsum("jii->ji", covariance))
    assert in_sigmas(smoothed.mean, mean, std) < 1e-9 and relative(smoothed.std, std) < 1e-9


def test_an_explicit_window_is_still_closed_by_condition():
    # Unwindowed, 60 steps of these modes have a condition number of 1e36 and nothing would be left of the answer.
    case = problem(3, 3, 2, 2, 60, growth=2.0)
    smoothed = smooth(case.model, case.z, **case.prior, window=1000)
    by_one = smooth(case.model, case.z, **case.prior, window=1)
    assert len(smoothed.windows) > 5 and relative(smoothed.std, by_one.std) < 1e-10


def test_no_steps_give_the_prior():
    smoothed = smooth(model(), np.empty((0, M)), x0=np.arange(4.0), p0=np.ones(4))
    assert np.array_equal(smoothed.mean, [np.arange(4.0)]) and smoothed.windows == []


def test_an_unknown_method_is_refused_by_name():
    with pytest.raises(ValueError, match="method 'magic' is unknown: choose from ms, rts, joseph, bierman, watanabe"):
        smooth(model(), np.ones((2, M)), method="magic")


def test_a_singular_phi_is_refused_by_the_method_that_inverts_it():
    phi = np.repeat(np.eye(N)[None], 6, axis=0)
    phi[4, 3, 3] = 0.0
    singular, prior = model(phi=phi), {"x0": np.zeros(N), "p0": np.eye(N)}
    with pytest.raises(ValueError, match=r"phi is singular at step 4: .* methods 'rts' and 'watanabe' do not"):
        smooth(singular, np.ones((6, M)), **prior)


@pytest.mark.parametrize("wanted", [(), ("std",), ("covariance",), ("cross",), ("filtered",), "std", RESULTS])
def test_what_is_not_asked_for_is_empty_and_what_is_asked_for_does_not_depend_on_the_rest(wanted):
    case = problem(4, 5, 2, 2, 30, missing=0.2)
    everything = smooth(case.model, case.z, **case.prior, window=7, want=RESULTS)
    part = smooth(case.model, case.z, **case.prior, window=7, want=wanted)
    for name in ("mean", "std", "covariance", "cross", "filtered_mean", "filtered_std"):
        asked = name == "mean" or name.removesuffix("_mean").removesuffix("_std") in (
            [wanted] if wanted == "std" else wanted
        )
        if asked:
            assert np.array_equal(getattr(part, name), getattr(everything, name), equal_nan=True)
        else:
            assert len(getattr(part, name)) == 0


def test_a_result_that_does_not_exist_is_refused_by_name():
    with pytest.raises(ValueError, match="want names 'variance': choose from mean, std, covariance, cross, filtered"):
        smooth(model(), np.ones((2, M)), want=("variance",))


def doubled(case):
    """The same record with the epoch before in the state: its covariance holds that of neighbours."""
    steps, n, p = case.gamma.shape
    phi, gamma, h = np.zeros((steps, 2 * n, 2 * n)), np.zeros((steps, 2 * n, p)), np.zeros((*case.h.shape[:2], 2 * n))
    phi[:, :n, :n], phi[:, n:, :n], gamma[:, :n], h[:, :, :n] = case.phi, np.eye(n), case.gamma, case.h
    p0 = np.eye(2 * n)
    p0[:n, :n] = case.p0
    return Problem(phi, gamma, case.q, h, case.r, case.z, np.concatenate([case.x0, np.zeros(n)]), p0)


@pytest.mark.parametrize("window", [1, 6, None])
def test_covariances_of_neighbours_are_those_of_batch_least_squares(window):
    case = problem(5, 4, 2, 2, 18, missing=0.2, quiet=0.3)
    _, covariance = batch(doubled(case))
    smoothed = smooth(case.model, case.z, **case.prior, window=window, want="cross")
    std = np.sqrt(np.einsum("jii->ji", covariance[:, :4, :4]))
    error = np.abs(smoothed.cross - covariance[1:, 4:, :4]) / (std[:-1, :, None] * std[1:, None, :])
    assert error.max() < 1e-11


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("window", [7, None])
def test_records_of_one_model_are_what_each_is_alone(threads, window):
    rng = np.random.default_rng(6)
    phi, gamma, h = np.linalg.qr(rng.normal(size=(5, 5)))[0], rng.normal(size=(5, 2)), rng.normal(size=(3, 5))
    system = LinearModel(phi, gamma, np.ones(2), h, np.eye(3) + 0.3)
    z, x0, p0 = rng.normal(size=(20, 40, 3)), rng.normal(size=(20, 5)), np.ones(5)
    z[17:, 4, 1], z[19, 7] = np.nan, np.nan  # three patterns of missing samples
    for prior in ({"x0": x0, "p0": p0}, {}):
        together = smooth(system, z, **prior, window=window, want=RESULTS, threads=threads)
        for k in (0, 11, 16, 17, 19):
            own = {} if not prior else {"x0": x0[k], "p0": p0}
            alone = smooth(system, z[k], **own, window=window, want=RESULTS)
            assert in_sigmas(together.mean[k], alone.mean, alone.std) < 1e-10
            assert np.allclose(together.filtered_mean[k], alone.filtered_mean, rtol=1e-9, atol=1e-9, equal_nan=True)
            for name in ("std", "covariance", "cross", "filtered_std"):
                assert np.allclose(getattr(together, name)[k], getattr(alone, name), rtol=1e-12, atol=1e-12)


def test_records_that_share_their_factors_share_the_memory_of_a_covariance():
    together = smooth(model(), np.ones((9, 12, M)), x0=np.zeros(N), p0=np.ones(N))
    assert together.covariance.shape == (9, 13, N, N) and together.covariance.strides[0] == 0
    assert together.mean.shape == (9, 13, N) and together.filtered_mean.shape == (9, 13, N)


def test_rivals_take_many_records_too():
    z, prior = np.random.default_rng(7).normal(size=(3, 12, M)), {"x0": np.zeros(N), "p0": np.ones(N), "method": "rts"}
    together = smooth(model(), z, **prior, threads=2)
    for k in range(3):
        alone = smooth(model(), z[k], **prior)
        assert np.array_equal(together.mean[k], alone.mean) and np.array_equal(together.covariance[k], alone.covariance)


def test_float32_is_float64_to_its_own_digits():
    for seed in range(3):
        case = problem(seed, 6, 2, 2, 300, missing=0.2)
        parts = case.phi, case.gamma, case.q, case.h, case.r
        single = smooth(LinearModel(*parts, dtype=np.float32), case.z, **case.prior, want=RESULTS)
        double = smooth(case.model, case.z, **case.prior)
        assert {getattr(single, name).dtype for name in ("mean", "std", "covariance", "filtered_std")} == {
            np.dtype("f4")
        }
        assert in_sigmas(single.mean, double.mean, double.std) < 1e-3 and relative(single.std, double.std) < 1e-4
        assert (single.std > 0.0).all() and np.array_equal(single.covariance, single.covariance.transpose(0, 2, 1))


def test_a_number_type_that_is_neither_is_refused():
    with pytest.raises(ValueError, match="dtype is int64: float64 or float32 is needed"):
        model(dtype=np.int64)


def test_results_on_disk_are_those_in_memory(tmp_path):
    case = problem(8, 4, 2, 2, 100, missing=0.1)
    inside = smooth(case.model, case.z, **case.prior, window=9, want=RESULTS)
    outside = smooth(case.model, case.z, **case.prior, window=9, want=RESULTS, spill=tmp_path)
    for name in inside._fields:
        assert np.array_equal(getattr(inside, name), getattr(outside, name), equal_nan=True)
    assert isinstance(outside.covariance, np.memmap) and (tmp_path / "covariance.npy").exists()
    assert not list(tmp_path.glob("**/steps-*"))  # snapshots are gone when they have served


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"spill": "x", "method": "rts"}, "method 'rts' keeps everything in memory; spill is for method 'ms'"),
        ({"threads": 0}, "threads is 0: at least 1 is needed"),
    ],
)
def test_options_that_do_not_go_together_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        smooth(model(), np.ones((3, M)), **options)


def test_records_that_do_not_fit_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"spill is for one record, z of shape \(N, m\)"):
        smooth(model(), np.ones((2, 3, M)), spill=tmp_path)
    with pytest.raises(ValueError, match="z has no records"):
        smooth(model(), np.ones((0, 3, M)))


def test_digits_lost_on_the_way_back_are_reported_and_not_returned():
    lost = dying()
    with pytest.raises(ValueError, match=r"digits of epoch \d+ are lost .* method 'watanabe' smooths forward"):
        smooth(lost.model(np.float64), lost.z, **lost.prior)
    for make in STRESS:  # hard, and within reach
        record = make()
        smooth(record.model(np.float64), record.z, **record.prior)


def test_results_on_disk_do_not_depend_on_blocks_and_name_the_steps_of_the_record(tmp_path, monkeypatch):
    monkeypatch.setattr("estimator.spilled.SPILL", 30)
    case = problem(9, 3, 1, 2, 100, missing=0.1)
    inside = smooth(case.model, case.z, **case.prior, window=9, want=RESULTS)
    outside = smooth(case.model, case.z, **case.prior, window=9, want=RESULTS, spill=tmp_path / "new")
    for name in inside._fields:
        assert np.array_equal(getattr(inside, name), getattr(outside, name), equal_nan=True)
    phi = case.phi.copy()
    phi[70] = 0.0
    with pytest.raises(ValueError, match="phi is singular at step 70"):
        smooth(case.but(phi=phi).model, case.z, **case.prior, spill=tmp_path / "bad")
    assert not list((tmp_path / "bad").iterdir())  # what failed leaves nothing


def test_results_on_disk_are_never_overwritten(tmp_path):
    first = smooth(model(), np.ones((9, M)), x0=np.zeros(N), p0=np.ones(N), spill=tmp_path)
    before = np.array(first.mean)
    with pytest.raises(FileExistsError, match="is there already: choose a new or empty folder"):
        smooth(model(), np.zeros((5, M)), x0=np.zeros(N), p0=np.ones(N), spill=tmp_path)
    assert np.array_equal(first.mean, before)


def test_no_steps_on_disk_give_the_prior(tmp_path):
    prior = {"x0": np.arange(4.0), "p0": np.ones(4)}
    for options in ({}, {"spill": tmp_path}):
        smoothed = smooth(model(), np.empty((0, M)), **prior, **options)
        assert np.array_equal(smoothed.filtered_mean, [np.arange(4.0)]) and np.array_equal(
            smoothed.mean, [np.arange(4)]
        )
        assert np.array_equal(smoothed.filtered_std, np.ones((1, 4)))


def unseen(seed, mode, gaps, steps=200):
    """A mode that grows or decays, oblique, under gaps in which it runs away from all that is known of it."""
    basis = np.array([[1.0, 0.4], [0.3, 1.0]])
    phi = basis @ np.diag([mode, 1.0]) @ np.linalg.inv(basis)
    rng = np.random.default_rng(seed)
    z = rng.normal(size=(steps, 1))
    z[rng.random(z.shape) < gaps] = np.nan
    return LinearModel(phi, np.eye(2), [1.0, 1.0], [[0.0, 1.0]], [1.0]), z


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize(("mode", "gaps"), [(0.2, 0.9), (0.2, 0.5), (1.3, 0.8), (2.0, 0.7)])
def test_means_hold_where_a_mode_runs_away_in_a_gap(mode, gaps, threads):
    for seed in range(6):
        system, z = unseen(seed, mode, gaps)
        prior = {"x0": np.zeros(2), "p0": np.ones(2)}
        mean = smooth(system, z, **prior, threads=threads)
        reference = smooth(system, z, **prior, method="watanabe")
        assert in_sigmas(mean.mean, reference.mean, reference.std) < 1e-6 and relative(mean.std, reference.std) < 1e-6


def test_records_that_do_not_belong_together_are_told_apart():
    z = np.ones((3, 5, M))
    with pytest.raises(ValueError, match=r"x0 has shape \(2, 4\) beside 3 records: \(n,\) or \(3, n\) is needed"):
        smooth(model(), z, x0=np.zeros((2, N)), p0=np.ones(N))
    with pytest.raises(ValueError, match=r"x0 has shape \(\) beside 3 records"):
        smooth(model(), z, x0=0.0, p0=np.ones(N))
    z[2, 1] = np.nan
    z[2, 3, 0] = np.inf
    with pytest.raises(ValueError, match="z is infinite at step 3") as caught:
        smooth(model(), z, x0=np.zeros(N), p0=np.ones(N))
    assert caught.value.__notes__ == ["in record 2"]


def test_a_direction_that_only_shrinks_ends_in_an_error_that_says_so():
    system = LinearModel([[1.0, 0.3], [0.0, 0.1]], [[1.0], [0.0]], [1.0], [[1.0, 0.0]], [1.0])
    with pytest.raises(ValueError, match=r"no longer finite at step \d+: .* shrinks .* method 'watanabe'"):
        smooth(system, np.ones((400, 1)), x0=np.zeros(2), p0=np.ones(2))
