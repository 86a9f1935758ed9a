"""A window closes by length or by condition number, and closing one changes nothing."""

import numpy as np
import pytest

from estimator import LinearModel, Rule, Store
from estimator.information import filter, start


def windows(phi, rule, steps=60):
    n = len(phi)
    model = LinearModel(phi, np.eye(n), np.ones(n), np.eye(n), np.ones(n))
    store = Store()
    filter(model, start(n), np.zeros((steps, n)), rule=rule, store=store)
    return store


def test_length_closes_a_window():
    store = windows(np.eye(2), Rule(steps=25))
    assert store.anchors == [0, 25, 50] and store.reasons == ["start", "length", "length"]


@pytest.mark.parametrize("growth", [1.05, 1.3, 3.0])
def test_condition_closes_a_window_before_the_limit_is_passed(growth):
    phi = np.diag([growth, 1.0, 1.0 / growth])
    store = windows(phi, Rule(steps=1000, kappa=1e4))
    longest = int(np.log(1e4) / (2.0 * np.log(growth)))
    lengths = np.diff([*store.anchors, 60])
    assert lengths.max() <= longest and lengths[:-1].min(initial=longest) >= longest - 8
    assert set(store.reasons[1:]) <= {"condition"}


def test_a_step_beyond_the_limit_is_a_window_of_its_own():
    store = windows(np.diag([300.0, 1.0 / 300.0]), Rule(), steps=10)
    assert store.anchors == list(range(10))


def test_a_typical_scale_keeps_units_from_closing_windows():
    # Position in mm and rate in km/s: phi looks ill-conditioned and is not.
    phi = np.array([[1.0, 1e6], [0.0, 1.0]])
    assert len(windows(phi, Rule()).anchors) == 60
    assert windows(phi, Rule(scale=np.array([1e6, 1.0]))).anchors == [0]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"steps": 0}, "at least one step"),
        ({"kappa": 0.5}, "at least 1"),
        ({"kappa": np.nan}, "at least 1"),
        ({"scale": [1.0, 0.0]}, "scale"),
        ({"scale": [[1.0]]}, "scale"),
    ],
)
def test_a_rule_that_cannot_be_is_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        Rule(**arguments)


def test_a_scale_of_the_wrong_size_is_refused():
    with pytest.raises(ValueError, match="scale has 3 entries for 2 states"):
        windows(np.eye(2), Rule(scale=np.ones(3)))
