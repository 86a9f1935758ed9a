"""Review: a recording read back, whether it was closed or not."""

from __future__ import annotations

import re
from pathlib import Path

import msgspec
import numpy as np

from telemetry.messages import Times
from viewer.books import BYTES, CONSUMED, COUNTERS
from viewer.columns import first, place
from viewer.comparison import Difference, compare
from viewer.reading import Reading, column
from viewer.states import order
from viewer.summary import (
    Account,
    Boot,
    ByteAccount,
    Clock,
    Consumer,
    Live,
    Sensor,
    Silence,
    Smoothed,
    Summary,
    Vehicle,
    finite,
    read,
)
from viewer.worth import Worth

__all__ = ["Difference", "Line", "Reading", "Review", "column", "compare", "estimator", "review"]

_FLOWN = re.compile(r"trajectory model(?: \((\w+)\))? from satellite fixes")  # what a leg begins with in the log


class Line(msgspec.Struct, kw_only=True):
    """One line of the event log; t in ns."""

    t: int
    level: str
    text: str


class Review(msgspec.Struct, kw_only=True):
    """What a recording says.

    Parameters
    ----------
    files : list of str
        What was read.
    closed : bool
        Whether the recorder finished its work. If not, the summary was made again from the data, and holds only what
        they tell.
    remarks : list of str
        What is wrong with the files, and what was done about it.
    summary : Summary
    log : list of Line
        The event log.
    """

    files: list[str]
    closed: bool
    remarks: list[str]
    summary: Summary
    log: list[Line]


def review(path: str | Path) -> Review:
    """Read a recording or a sortie folder back.

    Parameters
    ----------
    path : path
        An .rrd file, or a folder with ``live.rrd`` and ``windows.rrd``.

    Raises
    ------
    FileNotFoundError, ValueError
        If there is no recording, or what is there is none.
    """
    with Reading(path) as reading:
        log = _log(reading)
        text = reading.constant("/__properties/sortie", "summary")
        if text is not None:
            summary = read(text)
        else:
            summary = _rebuilt(reading, log)
            reading.remarks.append("the recording was not closed cleanly: what follows was counted from its data")
        if flown := estimator(reading, log):
            summary.properties = summary.properties | {"estimator": flown}
        if Path(path).is_dir() and len(reading.files) == 1:
            reading.remarks.append("there is no windows.rrd: smoothed windows are missing")
        return Review(
            files=[str(file) for file in reading.files],
            closed=text is not None,
            remarks=reading.remarks,
            summary=summary,
            log=log,
        )


def estimator(reading: Reading, log: list[Line] | None = None) -> str:
    """Name of the estimator that made a recording, "" where nothing was estimated.

    The log says who flew; what was to fly is known only where the recorder had been told.
    """
    named = reading.constant("/__properties/run", "estimator")
    lines = _log(reading) if log is None else log
    flown = [found[1] or "ms" for line in lines if (found := _FLOWN.search(line.text))]
    return ", ".join(dict.fromkeys(flown)) or str(named or "")


def _log(reading: Reading) -> list[Line]:
    (t,), (texts, levels) = reading.columns("/events", ("TextLog:text", "TextLog:level"), ("t_vehicle",))
    return [Line(t=int(a), level=str(b), text=str(c)) for a, b, c in zip(t, levels, texts, strict=True)]


def _rebuilt(reading: Reading, log: list[Line]) -> Summary:
    """A summary from the data alone."""
    run = "/__properties/run"
    summary = Summary(
        sortie=str(reading.constant(run, "sortie") or ""),
        completeness="truncated" if reading.truncated else "not closed",
        gap=float(reading.constant(run, "gap") or 0.0),
        properties={},
        vehicles=[],
        accounts=[],
        byte_accounts=[],
        windows=[],
        events={},
        alarms=[],
    )
    for line in log:
        summary.events[line.level] = summary.events.get(line.level, 0) + 1
    vehicles: dict[int, Vehicle] = {}
    spans: list[tuple[int, int, int, int]] = []
    for entity in sorted(reading.chunks):
        parts = entity.split("/")[1:]
        if parts[0] == "link":
            _account(reading, entity, summary)
        if parts[0] == "health" and parts[-1] == "counters":
            _consumer(reading, entity, summary)
        if not (parts[0].startswith("v") and parts[0][1:].isdigit()):
            continue
        number = int(parts[0][1:])
        vehicle = vehicles.setdefault(number, Vehicle(vehicle=number, boots=[], silences=[], sensors=[], clocks=[]))
        if parts[1] == "raw" and not any(sensor.sensor == parts[2] for sensor in vehicle.sensors):
            (t, t_rx), _ = reading.columns(entity, ("Scalars:scalars",), ("t_vehicle", "t_rx"))
            if len(t):
                vehicle.sensors.append(_sensor(parts[2], t))
                spans.append((int(t[0]), int(t[-1]), int(t_rx.min()), int(t_rx.max())))
                summary.rows += vehicle.sensors[-1].samples
        elif parts[1] == "est" and parts[-1] == "report":
            _, verdicts = reading.column(entity, "verdict")
            summary.windows += [msgspec.json.decode(verdict, type=Smoothed) for verdict in verdicts]
        elif parts[1] == "boot":
            _boots(reading, entity, vehicle)
        elif parts[1] == "report":
            _, texts = reading.column(entity, "report")
            summary.reports += [msgspec.json.decode(told, type=Worth) for told in texts]
        elif parts[1] == "est" and parts[-2:] == ["live", "nis"]:
            _live(reading, entity, vehicle)
        elif parts[1:] == ["clock", "offset"]:
            _clock(reading, entity, vehicle)
    summary.vehicles = [vehicles[number] for number in sorted(vehicles)]
    for vehicle in vehicles.values():
        vehicle.live.sort(key=lambda live: first(live.model))
    summary.windows.sort(key=lambda w: (w.t1, w.vehicle, first(w.model)))
    summary.reports.sort(key=lambda r: (r.t_rx, r.end))
    for vehicle in summary.vehicles:
        if vehicle.boots and vehicle.sensors:  # an epoch that nobody closed lasts as long as anything was measured
            vehicle.boots[-1].t1 = max(vehicle.boots[-1].t1, *(sensor.t1 for sensor in vehicle.sensors))
    if spans:
        table = np.array(spans)
        summary.t0, summary.t_rx0 = int(table[:, 0].min()), int(table[:, 2].min())
        summary.t1, summary.t_rx1 = int(table[:, 1].max()), int(table[:, 3].max())
    return summary


def _sensor(name: str, t: Times) -> Sensor:
    breaks = np.concatenate([[False], np.diff(t) == 1])  # the recorder's breaks follow a sample by one nanosecond
    times = t[~breaks]
    after = np.flatnonzero(breaks)
    silence = sum(int(t[i + 1] - t[i]) for i in after if i + 1 < len(t)) / 1e9
    heard = (int(times[-1]) - int(times[0])) / 1e9 - silence
    steps = len(times) - 1 - len(after)
    rate = steps / heard if steps > 0 and heard > 0 else None
    return Sensor(
        sensor=name,
        source="",
        samples=len(times),
        rate=rate,
        gaps=len(after),
        silence=silence,
        t0=int(t[0]),
        t1=int(t[-1]),
    )


def _boots(reading: Reading, entity: str, vehicle: Vehicle) -> None:
    (t, t_rx), (states,) = reading.columns(entity, ("StateChange:state",), ("t_vehicle", "t_rx"))
    last: tuple[int, int] | None = None
    for when, arrived, state in zip(t.tolist(), t_rx.tolist(), states.tolist(), strict=True):
        if not state:  # silence begins
            if vehicle.boots:
                vehicle.boots[-1].t1, vehicle.boots[-1].t_rx1 = when - 1, arrived
            last = when - 1, arrived
            continue
        boot = int(str(state).removeprefix("boot "))
        if last is not None:
            vehicle.silences.append(Silence(boot=boot, t0=last[0], t1=when))
        if not vehicle.boots or vehicle.boots[-1].boot != boot:
            vehicle.boots.append(Boot(boot=boot, t0=when, t1=when, t_rx0=arrived, t_rx1=arrived))


def _live(reading: Reading, entity: str, vehicle: Vehicle) -> None:
    here = place(entity)
    assert here is not None
    _, rows = reading.column(entity, "Scalars:scalars")
    real = np.isfinite(rows[:, 1])
    tested = real & np.isfinite(rows[:, 0]) & (rows[:, 1] > 0)
    found = (p for path in reading.chunks if (p := place(path)) is not None)
    names = [p.name for p in found if p[:3] == here[:3] and p.name not in ("nis", "geodetic")]
    determined = np.zeros(0, bool)
    for name in names:
        _, values = reading.column(entity.removesuffix("nis") + name, "Measurements:values")
        known = np.isfinite(values)
        determined = known if not len(determined) else determined[: len(known)] & known[: len(determined)]
    vehicle.live.append(
        Live(
            model=here.model,
            names=sorted(names, key=order),
            units=[],
            rows=int(real.sum()),
            determined=int(determined.sum()),
            nis=float(rows[tested, 0].sum()),
            dof=int(rows[tested, 1].sum()),
        )
    )


def _clock(reading: Reading, entity: str, vehicle: Vehicle) -> None:
    found = {}
    for name in ("offset", "rate"):
        _, (values, variances) = reading.columns(
            entity.removesuffix("offset") + name, ("Measurements:values", "Measurements:variances"), ("t_vehicle",)
        )
        if not len(values):
            return
        found[name], found[f"{name}_sigma"] = finite(float(values[-1])), finite(float(np.sqrt(variances[-1])))
    _, delay = reading.column(entity.removesuffix("offset") + "delay", "Scalars:scalars")
    _, span = reading.column(entity.removesuffix("offset") + "span", "Scalars:scalars")
    if len(delay) and len(span):
        p50, p99, most = (finite(x) for x in delay[-1])
        boot = vehicle.boots[-1].boot if vehicle.boots else 0
        vehicle.clocks.append(
            Clock(
                boot=boot,
                reference="",
                delay_p50=p50,
                delay_p99=p99,
                delay_max=most,
                span=finite(span[-1, 0]),
                valid=bool(span[-1, 1]),
                **found,
            )
        )


def _consumer(reading: Reading, entity: str, summary: Summary) -> None:
    _, rows = reading.column(entity, "Scalars:scalars")
    _, ages = reading.column(entity.removesuffix("counters") + "age", "Scalars:scalars")
    if len(rows):
        parts = entity.split("/")
        p99, most = (finite(np.nanmax(ages[:, i], initial=-np.inf)) for i in (1, 2)) if len(ages) else (None, None)
        last = dict(zip(CONSUMED, [int(x) for x in rows[-1]], strict=True))
        summary.consumers.append(Consumer(consumer=parts[2], stage=parts[3], age_p99=p99, age_max=most, **last))


def _account(reading: Reading, entity: str, summary: Summary) -> None:
    parts = entity.split("/")[2:]
    if parts[-1] not in ("counters", "bytes"):
        return
    _, rows = reading.column(entity, "Scalars:scalars")
    if not len(rows):
        return
    last = [int(x) for x in rows[-1]]
    if parts[-1] == "bytes":
        summary.byte_accounts.append(ByteAccount(source=parts[0], **dict(zip(BYTES, last, strict=True))))
        return
    vehicle, _, component = parts[1][1:].partition(".")
    _, loss = reading.column(entity.removesuffix("counters") + "loss", "Scalars:scalars")
    summary.accounts.append(
        Account(
            vehicle=int(vehicle),
            source=f"{parts[0]}/{component}" if component else parts[0],
            loss=finite(loss[-1, 1]) if len(loss) else None,
            **dict(zip(COUNTERS, last, strict=True)),
        )
    )
