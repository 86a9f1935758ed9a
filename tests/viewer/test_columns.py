"""Columns, tracks and words, without a recording."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.viewer import flight as f
from viewer.columns import Seam, belief, broken_times, local_metres, role, slug
from viewer.summary import chi_square_interval, smoothed, verdict
from viewer.track import Track

gaps = st.lists(st.sampled_from([1, 2, 5, -1, 40]), min_size=1, max_size=60)
cuts = st.lists(st.integers(0, 60), max_size=8)


def pieces(n, where):
    edges = sorted({0, n, *(c for c in where if c < n)})
    return list(pairwise(edges))


@given(gaps, cuts, st.integers(0, 60))
def test_breaks_do_not_depend_on_batches(steps, where, reboot):
    t = np.cumsum(np.array(steps, np.int64)) * 10**8
    boots = (np.arange(len(t)) >= reboot).astype(int)

    def run(parts):
        seam, out = Seam(3.0), []
        for low, high in parts:
            at, times, receive = seam.find(int(boots[low]), t[low:high], t[low:high] + 7)
            out += list(
                zip(broken_times(t[low:high], at, times), broken_times(t[low:high] + 7, at, receive), strict=True)
            )
        return out, seam.count, seam.silence

    edge = [reboot] if reboot < len(t) else []
    assert run(pieces(len(t), [*where, *edge])) == run(pieces(len(t), edge))


@given(gaps, cuts, st.lists(st.integers(0, 59), max_size=5))
def test_strips_do_not_depend_on_batches(steps, where, holes):
    t = np.cumsum(np.abs(np.array(steps, np.int64))) * 3 * 10**8
    points = np.column_stack([np.arange(len(t)), t, t]).astype(float)
    points[[h for h in holes if h < len(t)]] = np.nan

    def run(parts):
        track, seam, out = Track(joins=True), Seam(3.0), []
        for low, high in parts:
            at, _, _ = seam.find(0, t[low:high], t[low:high])
            out += track.add(t[low:high], t[low:high], points[low:high], at)
        return [(s.t, s.points.tolist()) for s in out + track.take()]

    assert run(pieces(len(t), where)) == run([(0, len(t))])


@pytest.mark.parametrize(
    ("name", "meaning"),
    [
        ("north", "north"),
        ("velocity_north", "velocity_north"),
        ("north velocity", "velocity_north"),
        ("vn", "velocity_north"),
        ("altitude", "altitude"),
        ("h", "altitude"),
        ("climb_rate", "climb_rate"),
        ("altimeter_bias", ""),
        ("wind_north", ""),
        ("phi", "roll"),
        ("theta", "pitch"),
        ("u", ""),
        ("position_east", "east"),
    ],
)
def test_roles(name, meaning):
    assert role(name) == meaning


def test_belief_is_nothing_or_both():
    values, variances = belief(np.array([1.0, np.nan, 2.0, np.inf]), np.array([0.1, 1.0, np.inf, 1.0]))
    assert np.array_equal(np.isnan(values), [False, True, True, True]) and np.array_equal(
        np.isnan(variances), np.isnan(values)
    )
    assert variances[0] == np.float64(0.1) ** 2


def test_local_metres():
    origin = np.array(f.HOME)
    away = origin + np.array([1e-5, 2e-5, 3.0])
    east, north, up = local_metres(away[None], origin)[0]
    assert (east, north, up) == (pytest.approx(86.6, abs=0.2), pytest.approx(63.6, abs=0.2), pytest.approx(3.0))


def test_verdicts():
    low, high = chi_square_interval(100)
    assert (low, high) == (pytest.approx(74.22, abs=0.1), pytest.approx(129.56, abs=0.1))
    assert (
        verdict(100.0, 100) == "consistent"
        and verdict(300.0, 100) == "overconfident"
        and verdict(20.0, 100) == "cautious"
    )
    assert verdict(11000.0, 10000) == "nearly consistent" and verdict(None, 3) == "no test"


def test_figures_of_a_window_need_no_position():
    import msgspec

    window = msgspec.structs.replace(f.window(0, *f.WINDOWS[1]), names=("a", "b", "c", "d", "e", "g"))
    assert smoothed(window).max_sigma_altitude is None


def test_slug():
    assert slug("udpin:0.0.0.0:14550") == "udpin_0.0.0.0_14550" and slug("///") == "_"
