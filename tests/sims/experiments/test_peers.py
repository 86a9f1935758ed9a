"""Filters and smoothers side by side: agreement where it is easy, and who is left where it is hard."""

import io
import json

import msgspec
import numpy as np
import pytest
from rich.console import Console

from estimator import rivals, smooth
from sims.experiments import libraries
from sims.experiments.libraries import ABSENT, Estimates, Numpy, Ours
from sims.experiments.peers import Comparison, Effort, compare, deviation, judge
from sims.experiments.records import STRESS, benchmark, dying, three_axes, truth

TINY = Effort(sizes=((4, 2, 2),), fast=20, slow=10, tracks=6, rounds=2)
hard = pytest.mark.parametrize("make", STRESS, ids=[make.__name__ for make in STRESS])


class Missing(libraries._Known):
    name, modules = "a library that nobody has", ("a_library_that_nobody_has",)

    def prepare(self, record):
        raise AssertionError("it is not there")


class Broken(libraries._Known):
    name = "a library that breaks"

    def prepare(self, record):
        def run():
            raise ArithmeticError("the determinant has left the building")

        return run, run


@pytest.fixture(scope="module")
def tiny():
    return compare(TINY, stress=[three_axes], peers=[Numpy(), Missing(), Broken()])


def epochs(record, **options):
    found = smooth(record.model(), record.z, **record.prior, **options)
    return Estimates(found.mean[..., 1:, :], found.covariance[..., 1:, :, :])


@pytest.mark.parametrize("varying", [False, True])
def test_the_numpy_reference_agrees(varying):
    record = benchmark(6, 3, 2, 60, varying=varying)
    filtered, smoothed = (run() for run in Numpy().prepare(record))
    assert deviation(epochs(record), smoothed) < 1e-11
    assert np.allclose(epochs(record).covariance, smoothed.covariance, rtol=1e-9, atol=1e-12)
    found = smooth(record.model(), record.z, **record.prior)
    assert deviation(Estimates(found.filtered_mean[1:], None, found.filtered_std[1:]), filtered) < 1e-11


def test_the_numpy_reference_agrees_with_many_tracks_and_with_gaps():
    record = benchmark(6, 3, 2, 30, tracks=3)
    assert deviation(epochs(record), Numpy().prepare(record)[1]()) < 1e-11
    gappy = benchmark(6, 3, 2, 30)
    gappy.z[3], gappy.z[8:20, 0] = np.nan, np.nan
    assert deviation(epochs(gappy), Numpy().prepare(gappy)[1]()) < 1e-11


@hard
def test_ms_is_within_a_millionth_of_a_sigma_on_every_hard_record(make):
    record = make()
    known = truth(record)
    smoothed = smooth(record.model(), record.z, **record.prior)
    covariance, variance = smoothed.covariance, np.einsum("jii->ji", smoothed.covariance)
    assert (variance > 0.0).all() and np.array_equal(covariance, covariance.transpose(0, 2, 1))
    assert np.abs((smoothed.mean - known.mean) / known.std).max() < 1e-6
    assert np.abs(np.sqrt(variance) / known.std - 1.0).max() < 1e-6
    assert np.allclose(smoothed.std, np.sqrt(variance), rtol=1e-12)


@hard
def test_so_is_its_filter_as_soon_as_anything_can_be_known(make):
    record = make()
    known = truth(record)
    verdict = judge(record.name, "ms", "filter", Ours().prepare(record)[0], known)
    assert verdict.positive and verdict.mean < 1e-6 and verdict.std < 1e-6


@hard
def test_in_single_precision_variances_stay_positive_and_symmetric(make):
    record = make()
    smoothed = smooth(record.model(np.float32), record.z.astype(np.float32), **record.prior)
    covariance = smoothed.covariance
    assert covariance.dtype == np.float32 and np.isfinite(smoothed.mean).all()
    assert (np.einsum("jii->ji", covariance) > 0.0).all() and (smoothed.std > 0.0).all()
    assert np.array_equal(covariance, covariance.transpose(0, 2, 1))


def test_the_textbook_is_not_right_there():
    record = three_axes()
    verdict = judge(record.name, "rts", "smooth", Ours("rts").prepare(record)[1], truth(record))
    assert not verdict.right and (verdict.negative or verdict.raised or verdict.lost)


def test_a_comparison_has_a_row_for_everyone(tiny):
    timed = {(t.setting, t.peer) for t in tiny.timings}
    for method in ("ms", *rivals.METHODS):
        assert ("one track, varying", f"ours, {method}") in timed
    many = {peer for setting, peer in timed if "64" in setting}
    assert many == {"ours, ms", "ours, ms, 2 threads", "numpy, Joseph and RTS"}
    for timing in tiny.timings:
        if timing.peer in ("ours, ms", "numpy, Joseph and RTS"):
            assert timing.microseconds > 0.0 and timing.ratio > 0.0 and timing.first > 0.0 and timing.gap < 1e-9
            assert timing.ratio == 1.0 or timing.peer != "ours, ms"
    judged = {v.peer for v in tiny.verdicts}
    assert {"ours, ms", "ours, ms, float32", "numpy, Joseph and RTS"} <= judged
    assert next(v for v in tiny.verdicts if (v.peer, v.task) == ("ours, ms", "smooth")).right


def test_a_library_that_is_not_installed_is_a_row_that_says_so(tiny):
    rows = [t for t in tiny.timings if t.peer == Missing.name] + [v for v in tiny.verdicts if v.peer == Missing.name]
    assert len(rows) == 2 * 2 + 2 and {row.note for row in rows} == {ABSENT}


def test_a_library_that_breaks_is_a_row_that_says_how(tiny):
    assert {t.note for t in tiny.timings if t.peer == Broken.name} == {"the determinant has left the building"}
    verdicts = [v for v in tiny.verdicts if v.peer == Broken.name]
    assert all(v.raised and not v.right and v.mean is None for v in verdicts)


def printed(comparison, width):
    console = Console(width=width, record=True, file=io.StringIO())
    for table in comparison.tables():
        console.print(table)
    return console.export_text()


def test_tables_fit_a_wide_terminal(tiny):
    def framed(text):
        return [line.rstrip() for line in text.splitlines() if line[:1] in "┏┃┡│└"]

    # On the narrow one everything looks as it does where there is room to spare.
    narrow, roomy = framed(printed(tiny, 140)), framed(printed(tiny, 1000))
    assert narrow == roomy and len(roomy) > 20 and max(len(line) for line in roomy) <= 140


def test_titles_are_in_one_line_whatever_the_table(tiny):
    lines = [line.strip() for line in printed(tiny, 140).splitlines()]
    for setting in ("one track, varying", "one track, constant", "64 tracks, constant"):
        assert f"{setting}: filter and smoother, microseconds per step and track (times ours)" in lines
    assert "hard records, smoothers" in lines


def test_captions_tell_what_is_not_alike(tiny):
    text = " ".join(printed(tiny, 140).split())
    # one track and 64, each filter and smoother
    assert text.count("made once, in the call not timed") == 4
    assert text.count("ours give means and standard deviations, the others means and covariances") == 3


def test_a_record_beyond_what_is_promised_is_marked():
    verdicts = [judge(record, "ms", "smooth", None, None) for record in ("dying", "3 axes")]
    text = " ".join(printed(Comparison({}, [], verdicts), 140).split())
    assert "dying*" in text and "*: beyond what is promised" in text and "3 axes*" not in text
    assert "beyond" not in printed(Comparison({}, [], verdicts[1:]), 140)


def test_smoothing_as_by_default_refuses_that_record():
    record = dying()
    with pytest.raises(ValueError, match="lost on the way back"):
        smooth(record.model(), record.z, **record.prior)


@pytest.mark.parametrize("method", ["rts", "joseph"])
def test_a_filter_is_not_charged_with_what_its_smoother_raises(method, monkeypatch):
    record = benchmark(4, 2, 2, 20)
    filtered, _ = Ours(method).prepare(record)

    def broken(*_, **__):
        raise ArithmeticError("the smoother breaks")

    monkeypatch.setattr("estimator.smooth", broken)
    assert deviation(filtered(), Numpy().prepare(record)[0]()) < 1e-9
    with pytest.raises(ArithmeticError):
        Ours(method).prepare(record)[1]()


def test_tables_tell_everything_and_figures_are_json(tiny):
    text = printed(tiny, 140)
    for expected in (
        "one track, varying: filter and smoother",
        "hard records, smoothers",
        "3 axes",
        ABSENT,
        "building",
    ):
        assert expected in text
    figures = json.loads(msgspec.json.encode(tiny))
    assert set(figures) == {"machine", "timings", "verdicts"} and figures["machine"]["cores"]
    for verdict, known in zip(figures["verdicts"], tiny.verdicts, strict=True):
        assert (verdict["positive"], verdict["right"]) == (known.positive, known.right)
    assert {verdict["right"] for verdict in figures["verdicts"]} == {True, False}


class Lost(libraries._Known):
    name = "a library that gives NaN"

    def prepare(self, record):
        filtered, smoothed = (run() for run in Numpy().prepare(record))
        return lambda: filtered, lambda: smoothed._replace(mean=np.full_like(smoothed.mean, np.nan))


def test_what_is_not_finite_is_told_in_tables_and_in_json():
    found = compare(TINY, settings=["one track, constant"], stress=[], peers=[Lost()])
    assert "not finite ✗" in printed(found, 140)
    rows = [t for t in json.loads(msgspec.json.encode(found))["timings"] if t["peer"] == Lost.name]
    assert {t["task"]: (t["finite"], t["gap"] is None) for t in rows} == {
        "filter": (True, False),
        "smooth": (False, True),
    }


@pytest.mark.filterwarnings("ignore")  # theirs
@pytest.mark.parametrize("peer", libraries.others(), ids=lambda peer: peer.name)
def test_every_library_that_is_here_agrees(peer):
    if reason := peer.available():
        pytest.skip(f"{peer.name}: {reason}")
    for record in (benchmark(4, 2, 2, 30, varying=True), benchmark(4, 2, 2, 30), benchmark(4, 2, 2, 20, tracks=3)):
        references = [run() for run in Numpy().prepare(record)]
        if record.tracks > 1 and not peer.many:
            continue
        try:
            runs = peer.prepare(record)
        except libraries.Refused:
            continue
        for run, reference in zip(runs, references, strict=True):
            assert deviation(run(), reference) < 1e-5
