"""Books: kept of a recording while it is written, in constant memory per vehicle, sensor and link."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from telemetry.messages import (
    SENSORS,
    ClockFit,
    Estimate,
    Event,
    Floats,
    Health,
    LinkBytes,
    LinkStats,
    Mark,
    Message,
    Progress,
    Report,
    StatusText,
    Window,
)
from viewer.columns import Seam, first, span
from viewer.summary import (
    Account,
    Age,
    Boot,
    ByteAccount,
    Clock,
    Consumer,
    Live,
    Sensor,
    Silence,
    Summary,
    Vehicle,
    finite,
    smoothed,
)
from viewer.worth import worth

COUNTERS = (
    "received",
    "lost",
    "late",
    "out_of_order",
    "duplicate",
    "conflict",
    "ambiguous",
    "restarted",
    "unknown",
    "redundant",
)
CONSUMED = ("messages", "missing", "backfilled", "refused")
BYTES = ("bytes", "frames", "unknown", "corrupt", "refused", "discarded", "pending")
LEVELS = {"info": "INFO", "warning": "WARN", "error": "ERROR"}
SEVERITIES = ("CRITICAL", "CRITICAL", "CRITICAL", "ERROR", "WARN", "INFO", "INFO", "DEBUG")


SETTLED = 30.0  # s after the beginning, when vehicles are in flight and it is known how late their samples come


class Ages:
    """How old things were, counted in steps of one per cent: constant memory, however many."""

    LEAST, MOST, STEP = 1e-4, 1e7, math.log(1.01)  # s

    def __init__(self) -> None:
        self._counts = np.zeros(round(math.log(self.MOST / self.LEAST) / self.STEP) + 1, np.int64)
        self.max = -math.inf

    def add(self, age: float) -> None:
        """Count one, s."""
        self.max = max(self.max, age)
        place = math.log(min(max(age, self.LEAST), self.MOST) / self.LEAST) / self.STEP
        self._counts[min(round(place), len(self._counts) - 1)] += 1

    def quantile(self, share: float) -> float:
        """The age that this share of them does not exceed, within half a per cent; NaN for none."""
        if self.max == -math.inf:
            return math.nan
        place = int(np.searchsorted(np.cumsum(self._counts), share * self._counts.sum()))
        return min(self.LEAST * math.exp(place * self.STEP), self.max)

    def told(self) -> Age:
        """What is said of all of them."""
        return Age(p50=self.quantile(0.5), p99=self.quantile(0.99), max=self.max)


class Books:
    """Counts what passes by.

    Parameters
    ----------
    sortie : str
    gap : float
        Silence from which a sensor counts as interrupted, s.
    """

    def __init__(self, sortie: str, gap: float) -> None:
        self.summary = Summary(sortie=sortie, completeness="not closed", gap=gap, properties={}, events={}, alarms=[])
        self._vehicles: dict[int, Vehicle] = {}
        self._sensors: dict[tuple[int, str, str], tuple[Sensor, Seam]] = {}
        self._clocks: dict[tuple[int, int], Clock] = {}
        self._links: dict[tuple[int, str], Account] = {}
        self._bytes: dict[str, ByteAccount] = {}
        self._ages, self._settled = Ages(), Ages()
        self._consumers: dict[tuple[str, str], Consumer] = {}

    def vehicle(self, number: int) -> Vehicle:
        """The books of one vehicle, opened when first asked for."""
        if number not in self._vehicles:
            self._vehicles[number] = Vehicle(vehicle=number, boots=[], silences=[], sensors=[], clocks=[])
        return self._vehicles[number]

    def add(self, message: Message, now: int | None = None) -> None:
        """Count a message; ``now`` is the wall time in ns of a live recording."""
        whole, t, t_rx = self.summary, message.t, message.t_rx
        whole.messages += 1
        if isinstance(message, Progress):
            return
        if isinstance(message, Health):  # what stages say of themselves is no sample of a vehicle
            self._health(message)
            return
        first = whole.rows == 0
        whole.rows += len(t)
        (low, high), rx = span(t), span(t_rx)
        whole.t0, whole.t1 = (low, high) if first else (min(whole.t0, low), max(whole.t1, high))
        whole.t_rx0, whole.t_rx1 = rx if first else (min(whole.t_rx0, rx[0]), max(whole.t_rx1, rx[1]))
        match message:
            case Estimate():
                self._estimate(message)
                if now is not None:
                    age = (now - int(t_rx[-1])) / 1e9
                    self._ages.add(age)
                    if t_rx[-1] - whole.t_rx0 > SETTLED * 1e9:
                        self._settled.add(age)
            case Window():
                whole.windows.append(smoothed(message))
            case Report():
                whole.reports.append(worth(message))
            case Event():
                for level in message.level:
                    self._level(LEVELS[level])
            case StatusText():
                for severity in message.severity.tolist():
                    self._level(SEVERITIES[min(max(severity, 0), 7)])
            case Mark():
                for _ in message.action:
                    self._level("INFO")
            case ClockFit():
                self._clock(message)
            case LinkStats():
                counts = {name: int(getattr(message, name)[-1]) for name in COUNTERS}
                self._links[message.vehicle, message.source] = Account(
                    vehicle=message.vehicle, source=message.source, loss=finite(message.loss_total[-1]), **counts
                )
            case LinkBytes():
                counts = {name: int(getattr(message, name)[-1]) for name in BYTES}
                self._bytes[message.source] = ByteAccount(source=message.source, **counts)
        if isinstance(message, SENSORS):
            self._sensor(message, low, high)
            self._boot(message.vehicle, message.boot, (low, high), rx)

    def silent(self, vehicle: int, boot: int, t0: int, t1: int) -> None:
        """Note a silence of a whole vehicle."""
        self.vehicle(vehicle).silences.append(Silence(boot=boot, t0=t0, t1=t1))

    def close(self, completeness: str, alarms: Sequence[str]) -> Summary:
        """The books, balanced."""
        whole = self.summary
        whole.completeness = completeness
        whole.alarms = list(alarms)
        for (number, _, _), (sensor, seam) in sorted(self._sensors.items(), key=lambda item: item[0]):
            sensor.gaps, sensor.silence = seam.count, seam.silence / 1e9
            boots = self.vehicle(number).boots
            between = sum(max(0, b.t0 - a.t1) for a, b in pairwise(boots))  # nobody measures while rebooting
            heard = (sensor.t1 - sensor.t0 - seam.silence - between) / 1e9
            steps = sensor.samples - 1 - seam.count
            sensor.rate = steps / heard if steps > 0 and heard > 0 else None
            self.vehicle(number).sensors.append(sensor)
        for (number, _), clock in sorted(self._clocks.items()):
            self.vehicle(number).clocks.append(clock)
        for vehicle in self._vehicles.values():
            vehicle.live.sort(key=lambda live: first(live.model))
        whole.vehicles = [self._vehicles[number] for number in sorted(self._vehicles)]
        whole.accounts = [self._links[key] for key in sorted(self._links)]
        whole.byte_accounts = [self._bytes[key] for key in sorted(self._bytes)]
        whole.consumers = [self._consumers[key] for key in sorted(self._consumers)]
        if self._ages.quantile(0.5) < 3600.0:  # else the stream was not live
            whole.age = self._ages.told()
            whole.settled = self._settled.told() if self._settled.max > -math.inf else None
        return whole

    def _level(self, level: str) -> None:
        self.summary.events[level] = self.summary.events.get(level, 0) + 1

    def _estimate(self, message: Estimate) -> None:
        accounts = self.vehicle(message.vehicle).live
        live = next((account for account in accounts if account.model == message.model), None)
        if live is None:
            live = Live(model=message.model, names=[], units=[])
            accounts.append(live)
        live.names, live.units = list(message.names), list(message.units)
        live.rows += len(message.t)
        live.determined += int((np.isfinite(message.mean) & np.isfinite(message.std)).all(axis=1).sum())
        tested = np.isfinite(message.nis) & (message.dof > 0)
        live.nis += math.fsum(message.nis[tested].tolist())
        live.dof += int(message.dof[tested].sum())

    def _sensor(self, message: Message, low: int, high: int) -> None:
        key = (message.vehicle, message.stream, message.source)
        if key not in self._sensors:
            self.vehicle(message.vehicle)
            self._sensors[key] = (
                Sensor(sensor=message.stream, source=message.source, t0=low, t1=high),
                Seam(self.summary.gap),
            )
        sensor, seam = self._sensors[key]
        seam.find(message.boot, message.t, message.t_rx)
        sensor.samples += len(message.t)
        sensor.t0, sensor.t1 = min(sensor.t0, low), max(sensor.t1, high)

    def _boot(self, number: int, boot: int, t: tuple[int, int], t_rx: tuple[int, int]) -> None:
        boots = self.vehicle(number).boots
        known = next((b for b in boots if b.boot == boot), None)
        if known is None:
            boots.append(Boot(boot=boot, t0=t[0], t1=t[1], t_rx0=t_rx[0], t_rx1=t_rx[1]))
            boots.sort(key=lambda b: b.boot)
        else:
            known.t0, known.t1 = min(known.t0, t[0]), max(known.t1, t[1])
            known.t_rx0, known.t_rx1 = min(known.t_rx0, t_rx[0]), max(known.t_rx1, t_rx[1])

    def _health(self, message: Health) -> None:
        key = message.source, message.stage
        counts = {name: int(getattr(message, name)[-1]) for name in CONSUMED}
        was = self._consumers.get(key)
        p99 = _most(message.age_p99, was.age_p99 if was else None)
        most = _most(message.age_max, was.age_max if was else None)
        self._consumers[key] = Consumer(consumer=key[0], stage=key[1], age_p99=p99, age_max=most, **counts)

    def _clock(self, message: ClockFit) -> None:
        self.vehicle(message.vehicle)
        fields = ("offset", "offset_sigma", "rate", "rate_sigma", "delay_p50", "delay_p99", "delay_max", "span")
        numbers = {name: finite(getattr(message, name)[-1]) for name in fields}
        self._clocks[message.vehicle, message.boot] = Clock(
            boot=message.boot, reference=message.reference[-1], valid=bool(message.valid[-1]), **numbers
        )


def _most(values: Floats, before: float | None) -> float | None:
    """The largest of the finite values and the one before; None for none."""
    known = [*values[np.isfinite(values)].tolist(), *([] if before is None else [before])]
    return max(known, default=None)
