"""Streams are chained without losing an item or an error."""

from __future__ import annotations

import threading

import pytest

from configuration import configure
from offline import ahead
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
