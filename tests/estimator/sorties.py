"""Flights for the stage: simulated once, spoilt in many ways, handed over in any batches."""

from __future__ import annotations

from functools import cache

import msgspec
import numpy as np

import sims
from estimator.models.flight_path import Settings as FlightPath
from estimator.stage import Settings, estimate
from sims.manoeuvres import Plan, Segment, bank_to_bank, three_two_one_one
from telemetry.messages import Estimate, Event, Mark, Progress, Report, Window

S = 1_000_000_000
BEGIN = 1_700_000_000 * S
PLAN = Plan(
    "short",
    (
        Segment("straight and level", 8.0),
        Segment("3-2-1-1 in pitch", 9.0, input=three_two_one_one(delay=1.0), test_point="TP 1"),
        *bank_to_bank("TP 2"),
        Segment("straight and level", 8.0),
    ),
)


@cache
def flown(grade="mems-vanes", plan=PLAN, turbulence=0, seed=1, **options):
    return sims.fly("c172x", plan, sensors=grade, turbulence=turbulence, seed=seed, start_utc=BEGIN, **options)


def flight_path(flight, **changes):
    """Settings that are right for the flight."""
    arms = flight.sensors.arms.from_imu()
    right = {"turbulence": 0.3, "vane": arms.vane, "antenna": arms.antenna, "gnss_delay": 0.0, "stall_speed": 25.0}
    return FlightPath.mems(**{**right, **changes})


def settings(flight, *, window=15.0, stage=None, **changes):
    return Settings(window=window, flight_path=flight_path(flight, **changes), **(stage or {}))


def seconds(message):
    """Seconds from the beginning of the flight, by the vehicle's time."""
    return (message.t - BEGIN) * 1e-9


def rows(message, keep):
    """Some rows of a message."""
    columns = {}
    for name in message.__struct_fields__:
        value = getattr(message, name)
        if isinstance(value, np.ndarray):
            value = value[keep]
        elif name in message.texts:
            value = [value[i] for i in np.arange(len(value))[keep]]
        columns[name] = value
    return type(message)(**columns)


def changed(messages, kind, change):
    """The messages, those of one kind changed; None leaves one out."""
    out = [change(m) if isinstance(m, kind) else m for m in messages]
    return [m for m in out if m is not None]


def column(messages, kind, name, change):
    """One column changed, ``change(values, seconds)``."""

    def apply(m):
        return msgspec.structs.replace(m, **{name: change(getattr(m, name).copy(), seconds(m))})

    return changed(messages, kind, apply)


def without(messages, kind, first=-1e9, stop=1e9):
    """The messages without what one sensor says between two times."""

    def silent(m):
        keep = (seconds(m) < first) | (seconds(m) > stop)
        return rows(m, keep) if keep.any() else None

    return changed(messages, kind, silent)


def delayed(messages, kind, delays):
    """Samples that arrive late by ``delays(seconds)``, s, in the order of their arrival."""

    def wait(m):
        t_rx = m.t + np.round(delays(seconds(m)) * S).astype(np.int64)
        return rows(msgspec.structs.replace(m, t_rx=t_rx), np.argsort(t_rx, kind="stable"))

    return changed(messages, kind, wait)


def batches(messages, cuts=()):
    """The messages cut into batches at receive times, given as shares of the flight."""
    samples = [m for m in messages if not isinstance(m, Progress)]
    begin, end = min(int(m.t_rx.min()) for m in samples), max(int(m.t_rx.max()) for m in samples)
    out, low = [], -(1 << 62)
    for edge in [*sorted(begin + int(cut * (end - begin)) for cut in cuts), end]:
        for m in samples:
            keep = (m.t_rx > low) & (m.t_rx <= edge)
            if keep.any():
                out.append(rows(m, keep))
        when = np.array([edge])
        out.append(Progress(vehicle=0, source="ingest", boot=0, t=when, t_rx=when, final=False))
        low = edge
    out[-1] = msgspec.structs.replace(out[-1], final=True)
    return out


def run(messages, options, scope="window"):
    return list(estimate(messages, options, scope=scope))


def told(out, kind, model="flight_path"):
    return [m for m in out if isinstance(m, kind) and getattr(m, "model", model) == model]


def texts(out, level=None):
    return [m.text[0] for m in told(out, Event) if level is None or m.level[0] == level]


def said(out):
    """Everything that warns: events, findings and alarms."""
    reports = told(out, Report)
    return [*texts(out, "warning"), *texts(out, "error"), *(t for r in reports for t in (*r.findings, *r.alarms))]


def everything(out):
    """All that the stage said about the flight path, to be compared bit for bit."""
    live = told(out, Estimate)
    names = ("t", "t_rx", "mean", "std", "nis", "dof")
    columns = {}
    for vehicle, boot in sorted({(m.vehicle, m.boot) for m in live}):
        mine = [m for m in live if (m.vehicle, m.boot) == (vehicle, boot)]
        for state in {m.names for m in mine}:
            parts = [m for m in mine if m.names == state]
            for name in names:
                whole = np.concatenate([getattr(m, name) for m in parts])
                columns[vehicle, boot, state, name] = whole.tobytes()
    rest = [msgspec.structs.asdict(m) for m in told(out, Window) + told(out, Report)]
    for one in rest:
        for name, value in one.items():
            if isinstance(value, np.ndarray):
                one[name] = value.tobytes()
    marks = sorted((int(m.t[0]), int(m.t_rx[0]), m.level[0], m.text[0]) for m in told(out, Event))
    return columns, rest, marks


def errors(flight, out, kind=Window, after=0.0):
    """Error and standard deviation of u, v, w, theta, phi, psi, by name."""
    truth, found = sims.truth_states(flight), {}
    parts = told(out, kind)
    t = np.concatenate([m.t for m in parts])
    late = (t - BEGIN) * 1e-9 >= after
    for name in ("u", "v", "w", "theta", "phi", "psi"):
        i = parts[0].names.index(name)
        true = np.unwrap(truth[name]) if name == "psi" else truth[name]
        e = np.concatenate([m.mean[:, i] for m in parts]) - np.interp(t, flight.utc, true)
        e = (e + np.pi) % (2 * np.pi) - np.pi if name in ("theta", "phi", "psi") else e
        found[name] = e[late], np.concatenate([m.std[:, i] for m in parts])[late]
    return found


def worst(found):
    """Largest mean square of the error over its standard deviation, and the rms errors of velocity and angles."""
    ratio = max(float(np.sqrt(np.mean((e / s) ** 2))) for e, s in found.values())
    speed = max(float(np.sqrt(np.mean(found[name][0] ** 2))) for name in ("u", "v", "w"))
    angle = max(float(np.sqrt(np.mean(found[name][0] ** 2))) for name in ("theta", "phi", "psi"))
    return ratio, speed, angle


def mark(second, action, name):
    t = np.array([BEGIN + round(second * S)])
    return Mark(vehicle=1, source="0/1", boot=0, t=t, t_rx=t + 1, action=[action], name=[name])


def messages_of(flight):
    return sims.messages(flight)
