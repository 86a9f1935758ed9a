"""One record of samples, and all that the flight-path estimator can make of it: filter, windows, smoother, hybrids.

The stage tells one result at a time, and decodes, orders and examines the samples anew for each. Here they are ordered
once, by the stage's own parts and in its order, and every method runs on the same steps; to the last bit the results
are the stage's.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from estimator import alignment
from estimator.consistency import Tally
from estimator.drive import MEASURED, WIDTH, Driver, Samples, Steps
from estimator.extended import REJECTED, Carry
from estimator.kinematics import MEASUREMENTS, TURBULENCE, WIND
from estimator.models.flight_path import FlightPath
from estimator.rivals import extended_rts
from estimator.stage import Settings
from estimator.stage.flight import TRY
from estimator.stage.rows import AIR, GNSS, KINDS, SENSORS, rows
from estimator.stretch import Filtered, Smoothed, Stretch
from estimator.synchronise import Synchroniser, take
from telemetry.messages import Gnss, Message

Floats = NDArray[np.float64]
Times = NDArray[np.int64]

S = 1_000_000_000
FOREVER = 1 << 62


class Record(NamedTuple):
    """The steps of one record, and what is known when they begin.

    Attributes
    ----------
    flight : FlightPath
    carry : Carry
        The start.
    begin : int
        Its time, ns.
    steps : Steps
    shown : int array
        Steps that are told.
    """

    flight: FlightPath
    carry: Carry
    begin: int
    steps: Steps
    shown: NDArray[np.intp]

    @property
    def t(self) -> Times:
        """Times of the rows that are told, ns."""
        return np.asarray(self.steps.t[self.shown])


class Path(NamedTuple):
    """Named states (k, n) at the rows that are told, and their standard deviations."""

    mean: Floats
    std: Floats


class NoStart(ValueError):
    """The samples do not allow a start; the text says why."""


def prepare(messages: Iterable[Message], settings: Settings) -> Record:
    """Order the samples of one vehicle and find the start, as the stage does over a whole sortie.

    The clock is believed, and the delay of the fixes is that of the settings, 0 where they have none.

    Raises
    ------
    NoStart
        There is no start, or no inertial sample after it.
    """
    taken = [message for message in messages if isinstance(message, KINDS)]
    first = next((message for message in taken if isinstance(message, Gnss)), None)
    if first is None:
        raise NoStart("no satellite fix")
    chosen = settings.flight_path
    delays = {GNSS: round((chosen.gnss_delay or 0.0) * S), AIR: round(chosen.air_delay * S)}
    synchroniser = Synchroniser(len(SENSORS), WIDTH, lag=round(settings.lag * S), grid=1 << 60)
    since = int(first.t[0])
    for message in taken:
        found = rows(message)
        z, sensor = found.z, int(found.sensor[0])
        if sensor == GNSS:
            z = z.copy()
            z[:, :3] = np.nan  # the place: not a specific force
        keep = found.t >= since  # a leg begins with a fix
        late = delays.get(sensor, 0)
        synchroniser.push(take(found._replace(t=found.t - late, z=z), keep))
    ordered = synchroniser.release(FOREVER, True)
    samples = Samples(ordered.t, ordered.t_rx, ordered.z, ordered.r)
    place = float(first.latitude[0]), float(first.altitude[0])
    slot = samples.t // TRY
    why = "no samples"
    for i in np.flatnonzero(np.diff(slot, prepend=slot[:1] - 1)).tolist():
        earliest = np.searchsorted(samples.t, samples.t[i] - round(alignment.SPAN * S))
        recent = samples.rows(slice(int(earliest), i + 1))
        mode = chosen
        if mode.mode == "auto":
            air = bool(np.isfinite(recent.z[:, MEASURED]).any())
            mode = msgspec.structs.replace(mode, mode="G" if air else "I")
        flight = FlightPath.of(mode, *place)
        start = alignment.find(recent, flight, alignment.true_airspeed(recent))
        if isinstance(start, str):
            why = start
            continue
        row = int(earliest) + start.row
        t = int(samples.t[row])
        driver = Driver(
            flight, t, samples.z[row, :6].copy(), start.period, output=round(settings.output * S),
            attitude_interval=round(mode.attitude_interval * S),
        )  # fmt: skip
        steps = driver.push(samples.rows(slice(row + 1, None)))
        if steps is None:
            raise NoStart("no inertial samples after the start")
        return Record(flight, flight.start(start.values, start.sigma), t, steps, np.flatnonzero(steps.drive.shown == 1))
    raise NoStart(why)


class Passes:
    """What one run of the filter leads to.

    Attributes
    ----------
    record : Record
    stretch : Stretch
    told : Filtered
        Of every step.
    """

    def __init__(self, record: Record) -> None:
        self.record = record
        self.stretch = Stretch(record.flight, record.carry.copy())
        self.told: Filtered = self.stretch.advance(record.steps.drive)
        self._smoothed: Smoothed | None = None

    def filter(self) -> Path:
        """As it would have been known at the time."""
        shown = self.record.shown
        return Path(self.told.mean[shown], self.told.std[shown])

    def tallies(self) -> dict[str, Tally]:
        """Normalised innovations by measured quantity, of those that were measured."""
        status = self.told.status.astype(np.int64)
        found = (Tally().add(self.told.innovation[:, i], status[:, i]) for i in range(len(MEASUREMENTS)))
        return {name: tally for name, tally in zip(MEASUREMENTS, found, strict=True) if tally.used or tally.rejected}

    def smoother(self) -> Path:
        """The whole record, linearised where the filter was."""
        self._smoothed = self.stretch.smooth()
        return self._rows(self._smoothed)

    def hybrid(self, passes: int = 1, *, predict_wind: bool = True) -> Path:
        """The whole record, linearised about the smoothed trajectory.

        The gusts, and the mean wind with them if ``predict_wind``, are linearised about their own prediction.
        """
        found = self._smoothed or self.stretch.smooth(std=False)
        flight = self.record.flight
        predicted = flight.model._replace(wind=WIND if predict_wind else TURBULENCE)
        self.stretch.flight = flight._replace(model=predicted)
        for i in range(passes):
            found = self.stretch.hybrid(found, std=i == passes - 1)
        self.stretch.flight = flight
        return self._rows(found)

    def windows(self, seconds: float) -> Path:
        """Smoothed window by window, each with what is known when it closes, as in flight."""
        record = self.record
        stretch = Stretch(record.flight, record.carry.copy())
        mean, std, first, begin = [], [], 0, record.begin
        while first < len(record.steps.t):
            begin += round(seconds * S)
            stop = int(np.searchsorted(record.steps.t, begin, "right"))
            if stop > first:
                stretch.advance(record.steps.drive.part(first, stop))
                found = stretch.smooth()
                stretch.drop()
                mean.append(found.mean[1:])
                std.append(found.std[1:])
            first = stop
        return Path(np.concatenate(mean)[record.shown], np.concatenate(std)[record.shown])

    def covariances(self) -> tuple[Floats, Floats]:
        """Covariances (k, 7, 7) of height, velocity and rotation about body axes, of the filter and of the smoother.

        They are those of the textbook's smoother on the same steps, with what the gate decided.
        """
        record = self.record
        drive, told = self.stretch.cut(0, len(record.steps.t))
        drive = drive._replace(z=np.where(told.status == REJECTED, np.nan, drive.z), r=told.r)
        room = extended_rts.Room.of(record.carry, len(drive.dt))
        at = record.shown + 1
        extended_rts.forward(record.flight.model, drive, record.carry.x, room)
        before = room.p[at, -7:, -7:]
        extended_rts.backward(record.flight.model, drive, room)
        return before, room.p[at, -7:, -7:]

    def _rows(self, found: Smoothed) -> Path:
        at = self.record.shown + 1
        return Path(found.mean[at], found.std[at])
