"""One message of one instrument of one component: what it has said before, and whether it is believed."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from telemetry.sensors.choice import NOBODY, Rank
from telemetry.sensors.feeds import Feed, Mask
from telemetry.sensors.refused import Refused

AUTOPILOT = 1


class Use:
    """What a stream is used for: one kind of sensor.

    Parameters
    ----------
    words : str
        For the log.
    why : str
        What speaks for it.
    rank : tuple
        Its place in the choice.
    instrument : object
        What it is a message of.
    feed : Feed, optional
    believed : bool
        Without having to show anything first.
    """

    def __init__(
        self, words: str, why: str, rank: Rank, instrument: object, feed: Feed | None = None, *, believed: bool = True
    ) -> None:
        self.words, self.why, self.rank, self.instrument, self.feed = words, why, rank, instrument, feed
        self.stream = NOBODY  # its number in the choice
        self.refused = Refused()
        self._always, self._believed, self._run = believed, believed, 0

    @property
    def doubted(self) -> bool:
        """Whether the feed's doubt still stands."""
        return not self._believed

    def begin(self) -> None:
        """The vehicle has booted: what it has shown before does not count."""
        self._believed, self._run = self._always, 0

    def weigh(self, shows: Mask, running: int) -> Mask:
        """Rows that are not believed yet, where `running` in succession must show that a sensor is there."""
        place = np.arange(1, len(shows) + 1)
        broken = np.maximum.accumulate(np.where(shows, 0, place))
        run = place - broken + np.where(broken == 0, self._run, 0)
        self._run = int(run[-1])
        enough = run >= running
        self._believed = bool(enough.any())
        return ~np.logical_or.accumulate(enough)


class Stream:
    """One message of one instrument of one component.

    Parameters
    ----------
    words, source : str
        For the log, and for its samples.
    uses : sequence of Use
    stamp : str or None
        Its time field.
    """

    def __init__(self, words: str, source: str, uses: Sequence[Use], stamp: str | None) -> None:
        self.words, self.source, self.uses, self._field = words, source, uses, stamp
        self.refused = Refused()
        self._stamp = 0

    def held(self, values: NDArray[Any]) -> Mask | None:
        """Rows that repeat the time of the one before, so their values are old; None if there is none. 0 is no time."""
        if self._field is None:
            return None
        stamp = values[self._field]
        if len(stamp) == 1:
            before, self._stamp = self._stamp, int(stamp[0])
            return np.ones(1, np.bool_) if self._stamp and self._stamp == before else None
        again = np.empty(len(stamp), np.bool_)
        again[0] = int(stamp[0]) == self._stamp
        np.equal(stamp[1:], stamp[:-1], out=again[1:])
        self._stamp = int(stamp[-1])
        if not again.any():
            return None
        again &= stamp != 0
        return again if again.any() else None


class Autopilots:
    """Which components an ArduPilot speaks for, by their heartbeats: what it derives from its filter is no measurement.

    The autopilot's own component is in doubt until its heartbeat has been heard.
    """

    ARDUPILOT = 3  # MAV_AUTOPILOT_ARDUPILOTMEGA

    def __init__(self) -> None:
        self._since: dict[int, tuple[int, int]] = {}  # row of the first heartbeat of an ArduPilot, and of another

    def hear(self, component: int, rows: NDArray[np.int64], values: NDArray[Any]) -> None:
        """Heartbeats of one component in a batch."""
        says = values["autopilot"] == self.ARDUPILOT
        of, other = self._since.get(component, (NEVER_HEARD, NEVER_HEARD))
        if of == NEVER_HEARD and says.any():
            of = int(rows[says][0])
        if other == NEVER_HEARD and not says.all():
            other = int(rows[~says][0])
        self._since[component] = of, other

    def end(self) -> None:
        """The batch ends: its row numbers mean nothing any more."""
        for component, (of, other) in self._since.items():
            self._since[component] = (
                min(of, -1) if of != NEVER_HEARD else of,
                (min(other, -1) if other != NEVER_HEARD else other),
            )

    def derives(self, component: int, rows: NDArray[np.int64]) -> Mask:
        """Rows that may be derived from a filter's state."""
        of, other = self._since.get(component, (NEVER_HEARD, NEVER_HEARD))
        return np.asarray((rows > of) | ((rows < other) & (component == AUTOPILOT)))


NEVER_HEARD = 1 << 62
