"""Streams are chained without losing an item or an error."""

from __future__ import annotations

import threading

import pytest

from configuration import configure, configure_log, write_what_runs
from offline import ahead
from telemetry.mavlink import Dialect
from telling import Failure


def test_what_is_worked_out_ahead_comes_in_order():
    assert list(ahead(iter(range(1000)), depth=3)) == list(range(1000))


def test_it_is_worked_out_in_another_thread():
    here = threading.get_ident()
    assert {item != here for item in ahead(threading.get_ident() for _ in range(3))} == {True}


def test_an_error_comes_after_the_items_before_it():
    def stream():
        yield 1
        raise ValueError("broken")

    found = []
    with pytest.raises(ValueError, match="broken"):
        found.extend(ahead(stream()))
    items = ahead(stream())
    assert next(items) == 1
    with pytest.raises(ValueError, match="broken"):
        next(items)


def test_who_stops_listening_stops_the_work():
    made = []

    def stream():
        for i in range(10_000):
            made.append(i)
            yield i

    items = ahead(stream(), depth=2)
    assert next(items) == 0
    items.close()
    assert len(made) < 10
    assert not [thread for thread in threading.enumerate() if thread.name == "ahead"]


def test_a_grade_stands_for_all_its_settings_and_any_of_them_can_be_replaced(tmp_path):
    (tmp_path / "a.toml").write_text('[estimate.flight_path]\ngrade = "fti"\nheight = 3.0\nvane = [1.0, 0.0, 2.0]\n')
    found = configure(tmp_path / "a.toml").estimate.flight_path
    assert (found.gnss_velocity, found.height, found.vane) == (0.05, 3.0, (1.0, 0.0, 2.0))


def test_a_grade_that_does_not_exist_is_named(tmp_path):
    (tmp_path / "a.toml").write_text('[estimate.flight_path]\ngrade = "gold"\n')
    with pytest.raises(Failure, match=r"grade 'gold' of .* is one of autopilot, mems, fti"):
        configure(tmp_path / "a.toml")


def test_an_estimator_is_told_by_the_file_or_in_its_place(tmp_path):
    (tmp_path / "a.toml").write_text('[estimate]\nestimator = "cubature"\nwindow = 9.0\n')
    assert configure(None).estimate.estimator == "ms"
    assert configure(tmp_path / "a.toml").estimate.estimator == "cubature"
    found = configure(tmp_path / "a.toml", estimator="ms").estimate
    assert (found.estimator, found.window) == ("ms", 9.0)


def test_an_estimator_that_does_not_exist_is_an_error_that_lists_those_that_do(tmp_path):
    (tmp_path / "a.toml").write_text('[estimate]\nestimator = "magic"\n')
    for told in ((tmp_path / "a.toml",), (None, None, "magic")):
        with pytest.raises(Failure, match=r"estimator 'magic' of \[estimate\]: it is one of ms, cubature"):
            configure(*told)


def test_an_estimator_alone_leaves_the_other_settings_of_a_sortie_as_they_ran(tmp_path):
    (tmp_path / "a.toml").write_text('[estimate]\nwindow = 9.0\nestimator = "cubature"\n')
    ran = configure(tmp_path / "a.toml")
    write_what_runs(tmp_path, "s", ["udpin:1"], [], ran, Dialect())
    found = configure_log(tmp_path, None, None, "ms").estimate
    assert (found.estimator, found.window) == ("ms", 9.0)
    assert configure_log(tmp_path, None, None, None) is None
