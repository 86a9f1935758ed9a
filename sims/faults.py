"""What a radio link does to frames: losses, outages, corruption, duplicates and swaps, seeded and counted.

A frame meets at most one fault, so that the counts add up on the receiver's side::

    delivered = offered - lost - outage + duplicated
    lost numbers at the receiver = lost + outage + corrupted      (as far as a later frame reveals them)
"""

from __future__ import annotations

import dataclasses
import math
import random
from collections.abc import Iterable, Iterator
from typing import NamedTuple

Frame = tuple[int, bytes]
"""Vehicle time (ns since boot) and the bytes of one MAVLink frame."""


class FaultError(ValueError):
    """A fault that is not known, or a value that makes no sense for it."""


class Faults(NamedTuple):
    """What goes wrong.

    Attributes
    ----------
    loss, corrupt, duplicate, swap : float
        Probability per frame: lost; one byte changed; sent twice; overtaken by its successor. Together at most 1.
    outage : tuple of (float, float)
        Start after the first frame and duration of each silence (s).
    seed : int
        Of the random draws.
    """

    loss: float = 0.0
    corrupt: float = 0.0
    duplicate: float = 0.0
    swap: float = 0.0
    outage: tuple[tuple[float, float], ...] = ()
    seed: int = 1


@dataclasses.dataclass(slots=True)
class Injected:
    """What was done so far; complete once the frames have run out."""

    offered: int = 0
    delivered: int = 0
    lost: int = 0
    outage: int = 0
    corrupted: int = 0
    duplicated: int = 0
    swapped: int = 0


_PROBABILITIES = ("loss", "corrupt", "duplicate", "swap")


def parse(text: str) -> Faults:
    """Return the faults that a string names.

    Parameters
    ----------
    text : str
        Comma-separated, such as ``loss=0.02,outage=60:5,corrupt=0.001,duplicate=0.01,swap=0.01,seed=7``. An outage is
        start:duration in seconds and may be named more than once.

    Raises
    ------
    FaultError
        Unknown name, or a value out of range.
    """
    faults = Faults()
    for item in filter(None, (part.strip() for part in text.split(","))):
        name, equals, value = (part.strip() for part in item.partition("="))
        if name not in Faults._fields:
            raise FaultError(f"unknown fault {name!r}; known: {', '.join(Faults._fields)}")
        if not equals or not value:
            raise FaultError(f"fault {name!r} needs a value, as in {_example(name)}")
        try:
            if name == "outage":
                start, duration = (float(part) for part in value.split(":"))
                faults = faults._replace(outage=(*faults.outage, (start, duration)))
            elif name == "seed":
                faults = faults._replace(seed=int(value))
            else:
                faults = Faults(**{**faults._asdict(), name: float(value)})
        except ValueError as error:
            raise FaultError(f"fault {name!r} cannot be {value!r}; write {_example(name)}") from error
    check(faults)
    return faults


def check(faults: Faults) -> None:
    """Raise FaultError when a value is out of range."""
    for name in _PROBABILITIES:
        value = getattr(faults, name)
        if not 0.0 <= value <= 1.0:
            raise FaultError(f"fault {name!r} is a probability from 0 to 1, not {value}")
    total = math.fsum(getattr(faults, name) for name in _PROBABILITIES)
    if total > 1.0 + 1e-12:
        raise FaultError(f"loss, corrupt, duplicate and swap add up to {total:.3g}; a frame meets at most one of them")
    for start, duration in faults.outage:
        if not (0.0 <= start < math.inf and 0.0 < duration < math.inf):
            raise FaultError(f"an outage starts at 0 s or later and lasts some time: not {start}:{duration}")


def apply(frames: Iterable[Frame], faults: str | Faults | None) -> tuple[Iterator[Frame], Injected]:
    """Return what arrives of `frames`, lazily, and the counts that grow as it is read.

    The times never go back: a frame that was overtaken carries the time of the one that overtook it.

    Raises
    ------
    FaultError
        At once, before any frame is read.
    """
    if faults is None:
        faults = Faults()
    elif isinstance(faults, str):
        faults = parse(faults)
    check(faults)
    injected = Injected()
    return _link(iter(frames), faults, injected), injected


def _link(frames: Iterator[Frame], faults: Faults, injected: Injected) -> Iterator[Frame]:
    draw = random.Random(faults.seed)
    silences = None
    held: bytes | None = None
    last = 0
    for t, frame in frames:
        if silences is None:
            silences = [(t + round(a * 1e9), t + round((a + b) * 1e9)) for a, b in faults.outage]
        injected.offered += 1
        last = t
        fault = _fault(draw.random(), faults)
        byte, change = draw.randrange(len(frame)), draw.randrange(1, 256)
        if any(start <= t < stop for start, stop in silences):
            injected.outage += 1
            continue
        if fault == "loss":
            injected.lost += 1
            continue
        if held is not None:
            # The overtaking frame meets no other fault: a swap that corruption hides could not be counted.
            injected.swapped += 1
            injected.delivered += 2
            yield t, frame
            yield t, held
            held = None
            continue
        if fault == "swap":
            held = frame
            continue
        if fault == "corrupt":
            injected.corrupted += 1
            frame = frame[:byte] + bytes([frame[byte] ^ change]) + frame[byte + 1 :]
        injected.delivered += 1
        yield t, frame
        if fault == "duplicate":
            injected.duplicated += 1
            injected.delivered += 1
            yield t, frame
    if held is not None:
        injected.delivered += 1
        yield last, held


def _fault(chance: float, faults: Faults) -> str | None:
    """Return the fault that falls on `chance`, uniform in 0..1."""
    edge = 0.0
    for name in _PROBABILITIES:
        edge += getattr(faults, name)
        if chance < edge:
            return name
    return None


def _example(name: str) -> str:
    return {"outage": "outage=60:5 (start:duration in seconds)", "seed": "seed=7"}.get(name, f"{name}=0.01")
