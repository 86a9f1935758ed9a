"""Two recordings of one flight are compared state by state, in their own sigmas."""

from __future__ import annotations

import io

import numpy as np
import pytest
from rich.console import Console

from estimator.stage import Settings
from telemetry.messages import Estimate, Event, Window
from tests.estimator.test_stage import flight, run
from viewer.agreement import agreement, tell
from viewer.recorder import record
from viewer.review import review

S = 1_000_000_000
T = 1_700_000_000 * S + np.arange(50) * S // 10
FIELDS = {"vehicle": 1, "source": "estimate", "boot": 0}


def estimate(mean, std, t=T, model="flight_path", names=("h", "psi"), kind=Estimate, **more):
    k = len(t)
    return kind(
        **FIELDS, t=t, t_rx=t + 7, model=model, names=names, units=("m", "rad"), mean=mean, std=std,
        nis=np.ones(k) if kind is Estimate else 1.0, dof=np.ones(k, np.int64) if kind is Estimate else 1,
        geodetic=np.full((k, 3), np.nan), **more,
    )  # fmt: skip


def window(mean, std, scope):
    more = {"measurements": {}, "late": {}, "anchors": 0, "digest": "0" * 64}
    return estimate(mean, std, kind=Window, number=0, test_point="", reason="end", scope=scope, **more)


def recorded(path, messages, estimator):
    record(messages, path, sortie=path.stem, interval=None, properties={"estimator": estimator} if estimator else {})
    return path


@pytest.fixture
def pair(tmp_path):
    mean, std = np.tile([500.0, 3.1], (50, 1)), np.tile([2.0, 0.1], (50, 1))
    other = mean + np.array([1.0, 0.2])
    other[:, 1] -= 2.0 * np.pi  # on the other side of the turn
    late = np.concatenate([T[:40], T[40:] + 1])  # ten samples that the first has not
    a = recorded(tmp_path / "a.rrd", [estimate(mean, std), window(mean, std, "window")], "ms")
    b = recorded(tmp_path / "b.rrd", [estimate(other, 1.5 * std, late), window(mean + 4.0, std, "sortie")], "cubature")
    return a, b


def test_differences_are_counted_in_sigmas_of_the_first(pair):
    found = agreement(*pair)
    assert found.estimators == ["ms", "cubature"]
    live = {state.name: state for state in found.states if state.stage == "live"}
    height = live["h"]
    assert (height.rows, height.alone) == (40, [10, 10])
    assert (height.rms, height.largest) == pytest.approx((1.0, 1.0))
    assert (height.rms_sigma, height.largest_sigma, height.ratio) == pytest.approx((0.5, 0.5, 1.5))
    back = {state.name: state for state in agreement(*pair[::-1]).states if state.stage == "live"}
    assert (back["h"].rms_sigma, back["h"].ratio) == pytest.approx((1.0 / 3.0, 2.0 / 3.0))


def test_an_angle_differs_the_shorter_way_round(pair):
    (heading,) = [s for s in agreement(*pair).states if s.stage == "live" and s.name == "psi"]
    assert (heading.rms, heading.rms_sigma) == pytest.approx((0.2, 2.0))


def test_windows_that_do_not_know_the_same_are_said(pair):
    found = agreement(*pair)
    assert "their windows do not know the same: smoothed over window and sortie" in found.remarks
    assert {state.rows for state in found.states if state.stage == "window"} == {50}


def test_it_is_told_for_a_reader(pair):
    text = io.StringIO()
    tell(agreement(*pair), Console(file=text, width=100))
    said = text.getvalue()
    assert "a.rrd, estimator ms" in said and "b.rrd, estimator cubature" in said
    assert "flight path, live: 40 estimates in both, 10 and 10 others without counterpart" in said
    (row,) = [line.split() for line in said.split("smoothed:")[0].splitlines() if line.split()[:1] == ["h"]]
    assert row == ["h", "1", "1", "0.5", "0.5", "1.500"]


def test_a_recording_of_another_flight_is_said(tmp_path, pair):
    mean, std = np.tile([500.0, 3.1], (50, 1)), np.tile([2.0, 0.1], (50, 1))
    other = recorded(tmp_path / "c.rrd", [estimate(mean, std, T + 77)], "")
    found = agreement(pair[0], other)
    assert found.estimators == ["ms", ""]
    assert any("is it the same flight?" in remark for remark in found.remarks)
    alien = recorded(tmp_path / "d.rrd", [estimate(mean, std, model="other")], "")
    with pytest.raises(ValueError, match="have no estimated state in common"):
        agreement(pair[0], alien)


@pytest.mark.parametrize("name", ["ms", "cubature"])
def test_the_log_says_who_flew_whatever_the_recorder_was_told(tmp_path, name):
    said = run(flight(6.0), options=Settings(model="trajectory", estimator=name))
    messages = [m for m in said if isinstance(m, (Estimate, Window, Event))]
    for told in ("", "another"):
        path = recorded(tmp_path / f"{told}.rrd", messages, told)
        assert review(path).summary.properties == {"estimator": name}
        assert agreement(path, path).estimators == [name, name]
