"""The estimator is a choice: the same windows and marks whoever filters, the same path as far as mathematics says."""

from __future__ import annotations

import json
import subprocess
import sys
from typing import get_args

import msgspec
import numpy as np
import pytest

import configuration
import offline
from estimator.cubature import trajectory as cubature
from estimator.model import LinearModel
from estimator.stage import Settings
from estimator.stage.estimators import ESTIMATORS, named
from estimator.stage.settings import Name, Scope, fingerprint
from telemetry.messages import Altitude, Attitude, Estimate, Event, Report, Window
from telemetry.wire import encode
from tests.estimator import sorties
from tests.estimator.test_stage import flight, live, mark, run, smoothed, told
from tests.telemetry.wire import DATA

MARKED = [*flight(silence=[(22.0, 27.0)]), mark(1008.03, "start", "trim"), mark(1015.0, "stop", "trim")]


def by(estimator, **changes):
    return Settings(**{"window": 7.0, "model": "trajectory", "estimator": estimator, **changes})


# -- the choice ----------------------------------------------------------------------------------------------------


def test_settings_command_line_and_stage_know_the_same_names():
    assert get_args(Name) == get_args(configuration.Estimator) == tuple(ESTIMATORS)


@pytest.mark.parametrize("name", ESTIMATORS)
def test_every_estimator_has_the_functions_that_the_stage_asks_of_one(name):
    there = named(name)
    assert all(callable(getattr(there, what)) for what in ("store", "start", "filter", "anchor", "smooth", "begin"))


def test_a_name_that_is_none_is_an_error_that_lists_those_that_are():
    with pytest.raises(ValueError, match="estimator 'magic': it is one of ms, cubature"):
        run(flight(3.0), options=Settings(estimator="magic"))


def test_an_estimator_that_is_not_asked_for_is_not_loaded():
    """And one that is, where the trajectory flies alone, not more of it than flies there."""
    asked = (
        "import sys\nfrom estimator.stage import estimators\n"
        "for name in ('ms', 'cubature'):\n"
        "    estimators.named(name)\n"
        "    print([m for m in ('estimator.cubature', 'estimator.cubature.flight') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", asked], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines() == ["[]", "['estimator.cubature']"]


def test_a_digest_names_the_estimator_only_where_it_is_not_the_first():
    settings = Settings(window=9.0)
    whole = msgspec.json.encode(settings)
    assert whole.count(b'"estimator":"ms",') == 1
    assert fingerprint(settings) == whole.replace(b'"estimator":"ms",', b"")
    other = msgspec.structs.replace(settings, estimator="cubature")
    assert json.loads(fingerprint(other))["estimator"] == "cubature"


# -- the trajectory ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("scope", ["window", "sortie"])
def test_both_fly_the_same_trajectory_in_the_same_windows(scope):
    one, other = (run(MARKED, scope=scope, options=by(name)) for name in ESTIMATORS)
    for get in (live, smoothed):
        a, b = get(one), get(other)
        assert a["t"].tolist() == b["t"].tolist()
        assert np.abs((a["mean"] - b["mean"]) / a["std"]).max() < 1e-6
        assert np.abs(b["std"] / a["std"] - 1.0).max() < 1e-6
        assert np.abs(a["geodetic"] - b["geodetic"]).max() < 1e-10
    assert np.abs(live(one)["nis"] - live(other)["nis"]).max() < 1e-6
    assert live(one)["dof"].tolist() == live(other)["dof"].tolist()
    windows = [told(out, Window) for out in (one, other)]
    for a, b in zip(*windows, strict=True):
        for name in ("number", "test_point", "reason", "measurements", "late", "dof"):
            assert getattr(a, name) == getattr(b, name)
        assert a.digest != b.digest
        assert b.nis == pytest.approx(a.nis, rel=1e-9)
    assert {w.reason for w in windows[0]} == {"mark", "length", "gap", "end"}
    events = [[e.text[0] for e in told(out, Event)] for out in (one, other)]
    assert events[1] == [text.replace("trajectory model", "trajectory model (cubature)") for text in events[0]]


@pytest.mark.parametrize("scope", ["window", "sortie"])
@pytest.mark.parametrize("cuts", [[137], range(1, len(MARKED), 3)])
def test_batches_do_not_change_a_bit(cuts, scope):
    whole, parts = (run(MARKED, c, scope, by("cubature")) for c in (None, cuts))
    a, b = live(whole), live(parts)
    assert all(a[name].tobytes() == b[name].tobytes() for name in a)
    for kind in (Window, Event):
        assert [encode(m) for m in told(parts, kind)] == [encode(m) for m in told(whole, kind)]


# -- the flight path -----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def flown():
    """A flight of two test points over a radio that loses attitudes and is late with altitudes, by both estimators."""
    trip = sorties.flown()
    messages = sorties.without(sorties.messages_of(trip), Attitude, 10.0, 14.0)
    messages = sorties.delayed(messages, Altitude, lambda t: np.where((t > 20.0) & (t < 20.5), 0.8, 0.01))
    out = {
        name: {
            scope: sorties.run(sorties.batches(messages), sorties.settings(trip, stage={"estimator": name}), scope)
            for scope in get_args(Scope)
        }
        for name in ESTIMATORS
    }
    return trip, messages, out


def path(out, kind):
    parts = sorties.told(out, kind)
    return {name: np.concatenate([getattr(m, name) for m in parts]) for name in ("t", "mean", "std")}


@pytest.mark.parametrize("scope", get_args(Scope))
def test_both_tell_the_same_flight_path_within_their_error_bars(flown, scope):
    trip, _, out = flown
    one, other = (out[name][scope] for name in ESTIMATORS)
    for kind in (Estimate, Window):
        a, b = path(one, kind), path(other, kind)
        assert a["t"].tolist() == b["t"].tolist()
        assert np.sqrt(np.mean(((b["mean"] - a["mean"]) / a["std"]) ** 2, axis=0)).max() < 0.8
        assert np.abs(np.median(b["std"] / a["std"], axis=0) - 1.0).max() < 0.1
        assert not np.array_equal(a["mean"], b["mean"])
    for told_by in (one, other):
        ratio, speed, angle = sorties.worst(sorties.errors(trip, told_by))
        assert ratio < 1.5 and speed < 0.2 and angle < 0.01


@pytest.mark.parametrize("scope", get_args(Scope))
def test_both_tell_the_same_windows_and_reports(flown, scope):
    one, other = (out[scope] for out in flown[2].values())
    for a, b in zip(sorties.told(one, Window), sorties.told(other, Window), strict=True):
        for name in ("number", "test_point", "reason", "scope", "measurements", "late", "names", "units"):
            assert getattr(a, name) == getattr(b, name)
        assert b.nis == pytest.approx(a.nis, rel=0.1)
    reports = [sorties.told(out, Report) for out in (one, other)]
    for a, b in zip(*reports, strict=True):
        assert [(p.name, p.verdict) for p in a.parameters] == [(p.name, p.verdict) for p in b.parameters]
        assert [(c.name, c.used, c.verdict) for c in a.channels] == [(c.name, c.used, c.verdict) for c in b.channels]
        assert (a.findings, a.loss, a.gaps) == (b.findings, b.loss, b.gaps)
        assert b.loss_effect == pytest.approx(a.loss_effect, rel=0.05)
    assert any(report.loss_effect for report in reports[1])
    assert any("flight path (cubature), mode G" in text for text in sorties.texts(other, "info"))
    assert any("late samples put in" in text for text in sorties.texts(other, "info"))


@pytest.mark.parametrize("scope", get_args(Scope))
def test_batches_do_not_change_a_bit_of_the_flight_path_either(flown, scope):
    trip, messages, out = flown
    settings = sorties.settings(trip, stage={"estimator": "cubature"})
    cut = sorties.run(sorties.batches(messages, np.linspace(0.0, 1.0, 67).tolist()), settings, scope)
    assert sorties.everything(cut) == sorties.everything(out["cubature"][scope])


def test_both_fly_a_real_flight_within_their_error_bars():
    log = DATA / "plane_swiss_137hz.tlog"
    if not log.exists():
        pytest.skip(f"{log} is not here")
    messages = list(offline.open_log(log).messages())
    one, other = (sorties.run(messages, Settings(estimator=name), "sortie") for name in ESTIMATORS)
    for kind in (Estimate, Window):
        a, b = path(one, kind), path(other, kind)
        assert a["t"].tolist() == b["t"].tolist() and len(a["t"]) > 2000
        assert np.sqrt(np.mean(((b["mean"] - a["mean"]) / a["std"]) ** 2, axis=0)).max() < 1.5
        assert np.abs(np.median(b["std"] / a["std"], axis=0) - 1.0).max() < 0.1


# -- its filter and smoother ---------------------------------------------------------------------------------------


def system(seed, *, singular=False, correlated=False, steps=7):
    """A random system with missing measurements, and a prior; singular: less noise than states, a phi that projects."""
    random = np.random.default_rng(seed)
    n, p, m = 3, 2, 2
    phi = np.eye(n) + 0.3 * random.normal(size=(steps, n, n))
    gamma, h = random.normal(size=(steps, n, p)), random.normal(size=(steps, m, n))
    q, r = random.uniform(0.1, 2.0, (steps, p)), random.uniform(0.1, 2.0, (steps, m))
    p0 = np.diag(random.uniform(0.5, 9.0, n))
    if singular:
        phi[3] = np.outer([1.0, 2.0, 3.0], [0.5, 1.0, -1.0])
        q[2:5], p0[1, 1] = 0.0, 0.0
    if correlated:
        r = r[:, :, None] * np.eye(m) + 0.4 * np.sqrt(r[:, :1, None] * r[:, 1:, None]) * (1.0 - np.eye(m))
    z = 3.0 * random.normal(size=(steps, m))
    z[random.random((steps, m)) < 0.3] = np.nan
    return LinearModel(phi, gamma, q, h, r), random.normal(size=n), p0, z


def conditioned(model, x0, p0, z, known):
    """Mean and standard deviation of all states given the first measurements: one normal distribution of everything."""
    n, steps = model.n, len(z)
    size = n * (steps + 1)
    mean, covariance = np.zeros(size), np.zeros((size, size))
    mean[:n], covariance[:n, :n] = x0, p0
    for j in range(steps):
        a, b = slice(n * j, n * j + n), slice(n * j + n, n * j + 2 * n)
        phi = model.phi[j]
        mean[b] = phi @ mean[a]
        covariance[b, : n * j + n] = phi @ covariance[a, : n * j + n]
        covariance[: n * j + n, b] = covariance[b, : n * j + n].T
        covariance[b, b] = phi @ covariance[a, a] @ phi.T + model.gamma[j] * model.q[j] @ model.gamma[j].T
    rows, noise, seen = [], [], []
    for j in range(known):
        there = np.flatnonzero(~np.isnan(z[j]))
        block = np.zeros((len(there), size))
        block[:, n * j + n : n * j + 2 * n] = model.h[j][there]
        r = np.diag(model.r[j]) if model.r.ndim == 2 else model.r[j]
        rows.append(block)
        noise.append(r[np.ix_(there, there)])
        seen.append(z[j][there])
    if rows:
        h, measured = np.concatenate(rows), np.concatenate(seen)
        r, at = np.zeros((len(measured),) * 2), 0
        for part in noise:
            r[at : at + len(part), at : at + len(part)] = part
            at += len(part)
        gain = np.linalg.solve(h @ covariance @ h.T + r, h @ covariance).T
        mean = mean + gain @ (measured - h @ mean)
        covariance = covariance - gain @ h @ covariance
    std = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    return mean.reshape(-1, n), std.reshape(-1, n)


@pytest.mark.parametrize("kind", [{}, {"correlated": True}, {"singular": True}])
@pytest.mark.parametrize("seed", range(4))
def test_filter_and_smoother_are_the_conditional_distribution(seed, kind):
    model, x0, p0, z = system(seed, **kind)
    store = cubature.Store()
    carry, filtered = cubature.filter(model, cubature.start(3, x0, p0), z, store=store)
    mean, std = cubature.smooth(store, carry)
    whole = conditioned(model, x0, p0, z, len(z))
    assert np.abs(mean - whole[0]).max() < 1e-9
    assert np.abs(std - whole[1]).max() < 1e-7
    for j in range(len(z)):
        so_far = conditioned(model, x0, p0, z, j + 1)
        assert np.abs(filtered.mean[j] - so_far[0][j + 1]).max() < 1e-9
        assert np.abs(filtered.std[j] - so_far[1][j + 1]).max() < 1e-7
    assert filtered.dof.tolist() == np.count_nonzero(~np.isnan(z), axis=1).tolist()


@pytest.mark.parametrize("cuts", [(3,), (1, 2, 6)])
def test_steps_in_any_chunks_give_the_same_bits(cuts):
    model, x0, p0, z = system(9)
    store, parts = cubature.Store(), cubature.Store()
    carry, filtered = cubature.filter(model, cubature.start(3, x0, p0), z, store=store)
    now, means = cubature.start(3, x0, p0), []
    for a, b in zip((0, *cuts), (*cuts, len(z)), strict=True):
        now, told_now = cubature.filter(model.cut(a, b), now, z[a:b], store=parts)
        means.append(told_now.mean)
    assert np.concatenate(means).tobytes() == filtered.mean.tobytes()
    assert [a.tobytes() for a in now] == [a.tobytes() for a in carry]
    whole = cubature.smooth(store, carry)
    assert [a.tobytes() for a in cubature.smooth(parts, now)] == [a.tobytes() for a in whole]
    parts.drop(2)
    assert len(parts) == len(z) - 2
    assert [a.tobytes() for a in cubature.smooth(parts, now)] == [a[2:].tobytes() for a in whole]


def test_what_cannot_be_filtered_changes_nothing():
    model, x0, p0, z = system(2)
    store = cubature.Store()
    carry, _ = cubature.filter(model.cut(0, 3), cubature.start(3, x0, p0), z[:3], store=store)
    before = cubature.smooth(store, carry)
    bad = z[3:].copy()
    bad[1, 0] = np.inf
    huge = LinearModel(1e160 * model.phi[3:], model.gamma[3:], model.q[3:], model.h[3:], model.r[3:])
    for steps, seen, words in ((model.cut(3, 7), bad, "infinite at step 1"), (huge, z[3:], "longer finite at step")):
        with pytest.raises(ValueError, match=words):
            cubature.filter(steps, carry, seen, store=store)
    assert [a.tobytes() for a in cubature.smooth(store, carry)] == [a.tobytes() for a in before]
    with pytest.raises(ValueError, match="not the one that the newest step"):
        cubature.smooth(store, cubature.start(3, x0, p0))


@pytest.mark.parametrize(
    ("x0", "p0", "words"),
    [
        ([0.0, np.nan], [1.0, 1.0], "begins from a prior of every state"),
        ([0.0, 0.0], [1.0, np.inf], "begins from a prior of every state"),
        ([0.0, 0.0], [[1.0, 2.0], [2.0, 1.0]], "singular or indefinite"),
        ([0.0, 0.0], [[1.0, 0.5], [0.0, 1.0]], "not symmetric"),
        ([0.0], [1.0, 1.0], "shape"),
    ],
)
def test_a_prior_that_is_none_is_named(x0, p0, words):
    with pytest.raises(ValueError, match=words):
        cubature.start(2, x0, p0)
