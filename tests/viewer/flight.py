"""A plausible three-minute flight as messages: a test point, a silence of 12 s, a reboot, an honest error model."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from itertools import pairwise
from typing import Any, Literal

import msgspec
import numpy as np

from telemetry import messages as m

START = 1_700_000_000_000_000_000
SECOND = 1_000_000_000
NAMES = ("north", "east", "altitude", "velocity_north", "velocity_east", "climb_rate")
UNITS = ("m", "m", "m", "m/s", "m/s", "m/s")
SILENCE = (70.0, 82.0)
REBOOT = (140.0, 146.0)
END = 180.0
HOME = (np.radians(47.4), np.radians(8.5), 450.0)


def times(rate: float) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Seconds at which a sensor of this rate is heard."""
    s = np.arange(0.0, END, 1.0 / rate)
    return s[~((s > SILENCE[0]) & (s < SILENCE[1])) & ~((s > REBOOT[0]) & (s < REBOOT[1]))]


def truth(s: Any) -> Any:
    """North, east, altitude and their rates at the times s, shape (k, 6)."""
    turn = 2 * np.pi / 60.0
    north, east = 400 * np.sin(turn * s), 250 * (1 - np.cos(turn * s)) + 2.0 * s
    up = HOME[2] + 60 * np.tanh(s / 25.0) + np.where(s > 100, 25 * np.sin((s - 100) / 8.0), 0.0)
    climb = 60 / 25.0 / np.cosh(s / 25.0) ** 2 + np.where(s > 100, 25 / 8.0 * np.cos((s - 100) / 8.0), 0.0)
    return np.column_stack([north, east, up, 400 * turn * np.cos(turn * s), 250 * turn * np.sin(turn * s) + 2.0, climb])


def geodetic(state: Any) -> Any:
    """Latitude, longitude, altitude of states."""
    return np.column_stack(
        [HOME[0] + state[:, 0] / 6378137.0, HOME[1] + state[:, 1] / 6378137.0 / np.cos(HOME[0]), state[:, 2]]
    )


def ns(s: Any) -> Any:
    """Seconds of the flight as Unix time."""
    return START + np.round(np.asarray(s) * 1e9).astype(np.int64)


def base(s: Any, *, vehicle: int = 1, source: str = "0/1", boot: int = 0, delay: float = 0.08) -> dict[str, Any]:
    """What every message says."""
    t = ns(s)
    return {"vehicle": vehicle, "source": source, "boot": boot, "t": t, "t_rx": t + round(delay * 1e9)}


def spread(s: Any) -> Any:
    """Standard deviation of the live estimate: settles, and grows with the time since the last sample."""
    since = np.where(s >= REBOOT[1], s - REBOOT[1], np.where(s >= SILENCE[1], s - SILENCE[1], s))
    one = 0.8 + 6.0 * np.exp(-since / 3.0)
    return np.column_stack([one, one, 1.5 * one, 0.3 * one, 0.3 * one, 0.4 * one])


def flight(vehicle: int = 1, seed: int = 7) -> list[m.Message]:
    """All messages in big batches, one per sensor and boot epoch, in no order of time."""
    rng = np.random.default_rng(seed + vehicle)
    shift = 150.0 * (vehicle - 1)
    out: list[m.Message] = []
    for boot, (low, high) in enumerate(((0.0, 143.0), (143.0, END))):
        s = times(5.0)
        s = s[(s >= low) & (s < high)]
        x = truth(s) + np.array([shift, 0, 0, 0, 0, 0])
        noisy = x + rng.normal(size=x.shape) * np.array([2.0, 2.0, 4.0, 0.4, 0.4, 0.6])
        g = geodetic(noisy)
        velocity = noisy[:, 3:] * np.array([1, 1, -1])
        velocity[::7, 2] = np.nan
        out.append(
            m.Gnss(
                latitude=g[:, 0],
                longitude=g[:, 1],
                altitude=g[:, 2],
                velocity=velocity,
                sigma=np.tile([2.0, 4.0, 0.5], (len(s), 1)),
                satellites=np.full(len(s), 11),
                **base(s, vehicle=vehicle, boot=boot),
            )
        )
        b = times(10.0)
        b = b[(b >= low) & (b < high)]
        out.append(
            m.Altitude(
                altitude=truth(b)[:, 2] + 18 + rng.normal(size=len(b)) * 0.5,
                pressure=95000 - 11 * truth(b)[:, 2],
                sigma=np.full(len(b), 0.5),
                **base(b, vehicle=vehicle, boot=boot),
            )
        )
        i = times(25.0)
        i = i[(i >= low) & (i < high)]
        out.append(
            m.Imu(
                specific_force=rng.normal(size=(len(i), 3)) * 0.2 + [0, 0, -9.81],
                angular_rate=rng.normal(size=(len(i), 3)) * 0.02,
                **base(i, vehicle=vehicle, boot=boot),
            )
        )
        std = spread(s)
        mean = x + rng.normal(size=x.shape) * std * 0.5
        blind = s - s[0] < 1.0
        mean[blind, 3:], std[blind, 3:] = np.nan, np.inf
        out.append(
            m.Estimate(
                model="trajectory",
                names=NAMES,
                units=UNITS,
                mean=mean,
                std=std,
                nis=rng.chisquare(3, len(s)),
                dof=np.full(len(s), 3),
                geodetic=geodetic(mean),
                **base(s, vehicle=vehicle, boot=boot, source="estimator"),
            )
        )
    out += [window(n, *span, vehicle=vehicle, seed=seed) for n, span in enumerate(WINDOWS)]
    return out + events(vehicle) + links(vehicle)


Reason = Literal["mark", "gap", "length", "reboot", "end"]
WINDOWS: tuple[tuple[float, float, int, int, str, Reason], ...] = (
    (0.0, 30.0, 0, 0, "", "mark"),
    (30.0, 60.0, 0, 1, "level turn", "mark"),
    (60.0, 70.0, 0, 2, "", "gap"),
    (82.0, 110.0, 0, 3, "", "mark"),
    (110.0, 135.0, 0, 4, "phugoid", "mark"),
    (135.0, 140.0, 0, 5, "", "reboot"),
    (146.0, 180.0, 1, 0, "", "end"),
)


def window(
    _: int,
    low: float,
    high: float,
    boot: int,
    number: int,
    test_point: str,
    reason: Reason,
    *,
    vehicle: int = 1,
    seed: int = 7,
    scope: Literal["window", "sortie"] = "window",
) -> m.Window:
    """A smoothed window."""
    rng = np.random.default_rng(seed + number)
    s = times(5.0)
    s = s[(s >= low) & (s <= high)]
    x = truth(s) + np.array([150.0 * (vehicle - 1), 0, 0, 0, 0, 0])
    edge = np.minimum(s - s[0], s[-1] - s)
    std = np.outer(0.6 + 0.8 * np.exp(-edge / 4.0), [1, 1, 1.5, 0.3, 0.3, 0.4])
    mean = x + std * 0.4 * np.sin(s / 3.0 + rng.uniform(0, 6))[:, None]
    dof = 4 * len(s)
    return m.Window(
        model="trajectory",
        names=NAMES,
        units=UNITS,
        mean=mean,
        std=std,
        geodetic=geodetic(mean),
        number=number,
        test_point=test_point,
        reason=reason,
        scope=scope,
        measurements={"gnss": len(s), "altitude": 2 * len(s)},
        late={"gnss": 3, "altitude": 0},
        anchors=1,
        nis=float(rng.chisquare(dof)),
        dof=dof,
        digest=f"{number:064x}",
        **base(s, vehicle=vehicle, boot=boot, source="estimator"),
    )


def events(vehicle: int = 1) -> list[m.Message]:
    """What is said during the flight."""
    one = lambda s, boot=0, **more: base(np.array([s]), vehicle=vehicle, boot=boot, **more)  # noqa: E731
    return [
        m.StatusText(severity=np.array([6]), text=["ArduPlane V4.5.1"], **one(1.0)),
        m.Event(
            level=["info"],
            text=["model: trajectory (position and velocity from GNSS and altitude)"],
            **one(1.2, source="estimator"),
        ),
        *(
            m.Mark(action=[action], name=[name], **one(s, source="pilot"))
            for s, action, name in (
                (30.0, "start", "level turn"),
                (60.0, "stop", "level turn"),
                (110.0, "start", "phugoid"),
                (135.0, "stop", "phugoid"),
            )
        ),
        m.Event(
            level=["warning"], text=["silence of 12.0 s; the estimate begins anew"], **one(82.0, source="estimator")
        ),
        m.StatusText(severity=np.array([3]), text=["EKF3 IMU0 yaw reset"], **one(139.0)),
        m.Event(level=["error"], text=["reboot: boot epoch 1 begins"], **one(146.0, boot=1, source="ingest")),
    ]


def links(vehicle: int = 1) -> list[m.Message]:
    """Link accounts, once a second, and clock fits."""
    s = times(1.0)
    n = np.arange(len(s), dtype=np.int64)
    count = dict.fromkeys(
        ("late", "out_of_order", "duplicate", "conflict", "ambiguous", "restarted", "unknown", "redundant"), n * 0
    )
    lost = n * 2 + np.where(s > 80, 40, 0)
    stats = m.LinkStats(
        received=n * 50,
        lost=lost,
        loss=np.clip(0.04 + 0.3 * ((s > 78) & (s < 92)), 0, 1),
        loss_total=lost / np.maximum(1, n * 50 + lost),
        **count,
        **base(s, vehicle=vehicle),
    )
    zero = n * 0
    total = m.LinkBytes(
        bytes=n * 2000,
        frames=n * 50,
        unknown=n,
        corrupt=n // 10,
        refused=n * 0,
        discarded=n * 3,
        pending=zero,
        **base(s, vehicle=0, source="0"),
    )
    fit = s[s > 60][::5]
    k = len(fit)
    full = lambda x: np.full(k, float(x))  # noqa: E731
    clock = m.ClockFit(
        reference=["arrival"] * k,
        offset=full(0.02),
        offset_sigma=full(0.004),
        rate=full(12e-6),
        rate_sigma=full(2e-6),
        delay_p50=full(0.015),
        delay_p99=full(0.12),
        delay_max=full(0.4),
        span=fit,
        valid=np.ones(k, np.int64),
        **base(fit, vehicle=vehicle),
    )
    return [stats, total, clock]


def sliced(message: m.Message, rows: slice) -> m.Message:
    """Some rows of a message."""
    if isinstance(message, (m.Window, m.Report)):
        return message
    parts = {
        name: value[rows]
        for name in message.__struct_fields__
        if isinstance(value := getattr(message, name), np.ndarray) or name in message.texts
    }
    return msgspec.structs.replace(message, **parts)


def batched(messages: Iterable[m.Message], period: float) -> Iterator[m.Message]:
    """The same messages as they arrive live: cut into batches of ``period`` seconds of receive time, with `Progress`
    between."""
    pieces: list[tuple[int, int, m.Message]] = []
    for order, message in enumerate(messages):
        slot = (message.t_rx - START) // round(period * 1e9)
        if isinstance(message, (m.Window, m.Report)):
            pieces.append((int(slot[-1]), order, message))
            continue
        edges: Sequence[int] = [0, *(np.flatnonzero(np.diff(slot)) + 1).tolist(), len(slot)]
        for low, high in pairwise(edges):
            pieces.append((int(slot[low]), order, sliced(message, slice(low, high))))
    pieces.sort(key=lambda piece: piece[:2])
    last = None
    for slot_number, _, message in pieces:
        if last is not None and slot_number != last:
            yield progress(START + slot_number * round(period * 1e9) - 1)
        last = slot_number
        yield message
    yield progress(START + round((END + 1) * 1e9), final=True)


def progress(t: int, *, final: bool = False) -> m.Progress:
    """A boundary of the stream."""
    one = np.array([t])
    return m.Progress(vehicle=0, source="ingest", boot=0, t=one, t_rx=one, final=final)
