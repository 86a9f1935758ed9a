"""Windows that are smoothed beside the flight say the same, and keep nobody waiting."""

from __future__ import annotations

import os
import sys
import threading

import numpy as np
import pytest

from estimator.stage import estimate
from estimator.stage.beside import BACKLOG, Beside
from estimator.stretch import Stretch
from telemetry.messages import Estimate, Event, Progress, Report, Window, event
from telemetry.wire import encode
from tests.estimator.sorties import batches, everything, flown, messages_of, settings, told


@pytest.fixture(scope="module")
def flight():
    """A flight of two test points, in batches of half a second, and its settings."""
    flight = flown()
    cuts = np.linspace(0.0, 1.0, 100).tolist()
    return list(batches(messages_of(flight), cuts)), settings(flight)


@pytest.mark.parametrize("scope", ["window", "sortie"])
def test_all_is_the_same_to_the_last_bit_and_in_its_order_by_kind(flight, scope):
    at_once, beside = (list(estimate(flight[0], flight[1], scope=scope, beside=how)) for how in (False, True))
    assert everything(beside) == everything(at_once)
    for kind in (Estimate, Window, Report, Event, Progress):
        assert [encode(m) for m in told(beside, kind)] == [encode(m) for m in told(at_once, kind)]
    assert len(told(beside, Report)) == 3
    assert isinstance(beside[-1], Progress)


def test_the_flight_goes_on_while_a_window_is_being_smoothed(flight, monkeypatch):
    go, smooth = threading.Event(), Stretch.smooth

    def slow(self, **options):
        assert go.wait(60.0)
        return smooth(self, **options)

    monkeypatch.setattr(Stretch, "smooth", slow)
    seen, late = [], told(flight[0], Progress)[90].t_rx[-1]
    for message in estimate(flight[0], flight[1], beside=True):
        seen.append(message)
        if isinstance(message, Progress) and message.t_rx[-1] >= late:
            go.set()
    kinds = [type(message) for message in seen if getattr(message, "model", "flight_path") == "flight_path"]
    assert kinds[: kinds.index(Window)].count(Estimate) > 0.8 * kinds.count(Estimate)


def test_a_window_that_cannot_be_smoothed_is_told_and_the_flight_goes_on(flight, monkeypatch):
    smooth, count = Stretch.smooth, [0]

    def once(self, **options):
        count[0] += 1
        if count[0] == 2:
            raise ArithmeticError("lost")
        return smooth(self, **options)

    for beside in (False, True):
        count[0] = 0
        monkeypatch.setattr(Stretch, "smooth", once)
        out = list(estimate(flight[0], flight[1], beside=beside))
        texts = [text for message in told(out, Event) for text in message.text]
        assert "window 1 of the flight path could not be smoothed, its estimates stand: lost" in texts
        numbers = [message.number for message in told(out, Window) if message.model == "flight_path"]
        assert 1 not in numbers and len(numbers) >= 3


def test_no_more_than_a_bounded_number_of_jobs_waits():
    beside, go = Beside(True), threading.Event()
    done = []

    def job(i):
        assert go.wait(60.0)
        done.append(i)
        yield event(str(i), level="info", vehicle=1, source="", boot=0, t=i, t_rx=i)

    for i in range(BACKLOG):
        assert list(beside.run(lambda i=i: job(i))) == []
    assert list(beside.done()) == []
    threading.Timer(0.05, go.set).start()
    out = list(beside.run(lambda: job(BACKLOG)))  # waits for the first
    assert done[0] == 0 and [message.text for message in out][:1] == [["0"]]
    out += list(beside.done(all=True))
    assert [message.text for message in out] == [[str(i)] for i in range(BACKLOG + 1)]
    beside.close()


def test_what_fails_for_other_reasons_is_raised_where_the_flight_is(flight, monkeypatch):
    def broken(self, **options):
        raise TypeError("a mistake in the programme")

    monkeypatch.setattr(Stretch, "smooth", broken)
    with pytest.raises(TypeError, match="a mistake"):
        list(estimate(flight[0], flight[1], beside=True))


def test_a_report_that_fails_is_told_alike_and_its_windows_stand(flight, monkeypatch):
    def broken(*_):
        raise ArithmeticError("unreadable")

    monkeypatch.setattr("estimator.stage.flight.test_point_report", broken)
    monkeypatch.setattr("estimator.stage.report.Sum.report", broken)
    outs = [list(estimate(flight[0], flight[1], beside=beside)) for beside in (False, True)]
    for out in outs:
        texts = [text for message in told(out, Event) for text in message.text]
        assert sum(text.endswith("is smoothed, but could not be reported: unreadable") for text in texts) == 2
        assert texts[-1] == "the flight path is smoothed, but could not be reported as a whole: unreadable"
    windows = [[encode(m) for m in told(out, Window)] for out in outs]
    assert windows[0] == windows[1] and len(windows[0]) >= 3


def test_a_question_does_not_wait_for_windows():
    beside, go = Beside(True), threading.Event()

    def job():
        assert go.wait(60.0)
        return ()

    assert list(beside.run(job)) == []
    assert beside.ask(lambda: 3)() == 3
    go.set()
    assert list(beside.done(all=True)) == []
    beside.close()


@pytest.mark.skipif(sys.platform != "linux", reason="a thread has no priority of its own here")
def test_windows_make_way_for_the_flight():
    def nice():
        return os.getpriority(os.PRIO_PROCESS, threading.get_native_id())

    said = []
    jobs = Beside(thread=True)
    list(jobs.run(lambda: said.append((nice(), os.sched_getscheduler(0))) or ()))
    list(jobs.done(all=True))
    jobs.close()
    assert said == [(min(nice() + 10, 19), os.SCHED_OTHER)]
