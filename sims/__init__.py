"""Truth to test against: a simulated aircraft that speaks MAVLink.

A flight is flown once, in seconds, and then sent or written as often as wanted::

    flight = sims.fly("c172x", "demo", sensors="mems", seed=1)
    sims.send(sims.frames(flight), "udpout:127.0.0.1:14550", speed=8, faults="loss=0.02")

SI and radians inside, NED for the Earth, FRD for the body, specific force and not acceleration, times int64 ns since
the vehicle's boot. The names below are loaded when they are first used, so that importing the room loads no JSBSim.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sims.faults import Faults, Injected
    from sims.flight import Flight, Mark, fly
    from sims.manoeuvres import PLANS
    from sims.sensors import GRADES
    from sims.transmitter import Sent, send, write_tlog
    from sims.truth import Truth
    from sims.vehicle import frames

_HOMES = {
    "Faults": "sims.faults",
    "Flight": "sims.flight",
    "GRADES": "sims.sensors",
    "Injected": "sims.faults",
    "Mark": "sims.flight",
    "PLANS": "sims.manoeuvres",
    "Sent": "sims.transmitter",
    "Truth": "sims.truth",
    "fly": "sims.flight",
    "frames": "sims.vehicle",
    "send": "sims.transmitter",
    "write_tlog": "sims.transmitter",
}

__all__ = [
    "GRADES",
    "PLANS",
    "Faults",
    "Flight",
    "Injected",
    "Mark",
    "Sent",
    "Truth",
    "fly",
    "frames",
    "send",
    "write_tlog",
]


def __getattr__(name: str) -> Any:
    """Load a public name from its file."""
    if name not in _HOMES:
        raise AttributeError(f"module 'sims' has no attribute {name!r}")
    return getattr(importlib.import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *_HOMES])
