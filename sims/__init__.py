"""Truth to test against: a simulated aircraft that speaks MAVLink.

A flight is flown once, in seconds, and then sent or written as often as wanted::

    flight = sims.fly("c172x", "demo", sensors="mems", seed=1)
    sims.send(sims.frames(flight), "udpout:127.0.0.1:14550", speed=8, faults="loss=0.02")

or handed over as arrays, with other sensor errors as often as wanted, and compared with the truth::

    flight = sims.fly("737", "calibration", sensors="fti", turbulence=3)
    for seed in range(10):
        drawn = sims.redraw(flight, seed)
        samples, truth = sims.messages(drawn), sims.truth_states(drawn)

SI and radians inside, NED for the Earth, FRD for the body, specific force and not acceleration, times int64 ns since
the vehicle's boot. The names below are loaded when they are first used, so that importing the room loads no JSBSim.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sims.draws import monte_carlo, redraw
    from sims.faults import Faults, Injected
    from sims.flight import Flight, Mark, fly
    from sims.grades import GRADES, RIGS, Arms, Grade, Rates
    from sims.manoeuvres import PLANS
    from sims.sensors import sense
    from sims.states import parameters, truth_states
    from sims.transmitter import Sent, send, write_tlog
    from sims.truth import Truth
    from sims.vehicle import frames
    from sims.vocabulary import messages

_HOMES = {
    "Arms": "sims.grades",
    "Faults": "sims.faults",
    "Flight": "sims.flight",
    "GRADES": "sims.grades",
    "Grade": "sims.grades",
    "Injected": "sims.faults",
    "Mark": "sims.flight",
    "PLANS": "sims.manoeuvres",
    "RIGS": "sims.grades",
    "Rates": "sims.grades",
    "Sent": "sims.transmitter",
    "Truth": "sims.truth",
    "fly": "sims.flight",
    "frames": "sims.vehicle",
    "messages": "sims.vocabulary",
    "monte_carlo": "sims.draws",
    "parameters": "sims.states",
    "redraw": "sims.draws",
    "send": "sims.transmitter",
    "sense": "sims.sensors",
    "truth_states": "sims.states",
    "write_tlog": "sims.transmitter",
}

__all__ = [
    "GRADES",
    "PLANS",
    "RIGS",
    "Arms",
    "Faults",
    "Flight",
    "Grade",
    "Injected",
    "Mark",
    "Rates",
    "Sent",
    "Truth",
    "fly",
    "frames",
    "messages",
    "monte_carlo",
    "parameters",
    "redraw",
    "send",
    "sense",
    "truth_states",
    "write_tlog",
]


def __getattr__(name: str) -> Any:
    """Load a public name from its file."""
    if name not in _HOMES:
        raise AttributeError(f"module 'sims' has no attribute {name!r}")
    return getattr(importlib.import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *_HOMES])
