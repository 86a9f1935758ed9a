"""Summary: what a recording holds, in numbers that stay readable when the recording is long gone."""

from __future__ import annotations

import math

import msgspec
import numpy as np

from telemetry.messages import Window
from viewer.columns import role
from viewer.text import utc
from viewer.worth import Worth

FORMAT = 2


def finite(x: float) -> float | None:
    """A number for JSON, where neither NaN nor infinity exist."""
    return float(x) if math.isfinite(x) else None


class Boot(msgspec.Struct, kw_only=True):
    """A boot epoch: its number, and the span of vehicle and receive times in it, ns."""

    boot: int
    t0: int
    t1: int
    t_rx0: int
    t_rx1: int


class Silence(msgspec.Struct, kw_only=True):
    """A stretch in which a vehicle was not heard at all, ns; between boots it is the reboot."""

    t0: int
    t1: int
    boot: int


class Sensor(msgspec.Struct, kw_only=True):
    """Samples of one sensor of one component.

    Parameters
    ----------
    sensor, source : str
        Kind of sensor, and who sent it.
    samples : int
    rate : float or None
        1/s over the time in which it was heard; None for fewer than two samples.
    gaps : int
        Silences and reboots between its samples.
    silence : float
        Length of its silences inside boot epochs, s.
    t0, t1 : int
        First and last sample, ns.
    """

    sensor: str
    source: str
    samples: int = 0
    rate: float | None = None
    gaps: int = 0
    silence: float = 0.0
    t0: int = 0
    t1: int = 0


class Clock(msgspec.Struct, kw_only=True):
    """Last clock fit of a boot epoch; s and dimensionless, as in the message."""

    boot: int
    reference: str
    offset: float | None
    offset_sigma: float | None
    rate: float | None
    rate_sigma: float | None
    delay_p50: float | None
    delay_p99: float | None
    delay_max: float | None
    span: float | None
    valid: bool


class Live(msgspec.Struct, kw_only=True):
    """The live estimates of one model of a vehicle: rows, rows with every state determined, and the sum of NIS over its
    scalars.
    """

    model: str
    names: list[str]
    units: list[str]
    rows: int = 0
    determined: int = 0
    nis: float = 0.0
    dof: int = 0


class Vehicle(msgspec.Struct, kw_only=True):
    """One vehicle."""

    vehicle: int
    boots: list[Boot] = []
    silences: list[Silence] = []
    sensors: list[Sensor] = []
    clocks: list[Clock] = []
    live: list[Live] = []


class Account(msgspec.Struct, kw_only=True):
    """Last row of the loss account of one sender on one link; the counters are those of the message."""

    vehicle: int
    source: str
    received: int
    lost: int
    late: int
    out_of_order: int
    duplicate: int
    conflict: int
    ambiguous: int
    restarted: int
    loss: float | None
    unknown: int = 0
    redundant: int = 0


class ByteAccount(msgspec.Struct, kw_only=True):
    """Last row of the byte account of one link: ``bytes = bytes in frames + discarded + pending``."""

    source: str
    bytes: int
    frames: int
    unknown: int
    corrupt: int
    discarded: int
    pending: int
    refused: int = 0


class Smoothed(msgspec.Struct, kw_only=True):
    """One smoothed window.

    Parameters
    ----------
    sigma_altitude, sigma_horizontal : list of float or None
        Standard deviation at the start, in the middle and at the end, m; horizontal: root of the sum of squares of
        both axes.
    max_sigma_altitude, median_sigma_altitude, max_sigma_horizontal, median_sigma_horizontal : float or None
        m; None where the model has no such state or did not determine it.
    t0, t1 : int
        ns.
    k : int
        Rows.
    """

    vehicle: int
    number: int
    boot: int
    test_point: str
    reason: str
    scope: str
    model: str
    t0: int
    t1: int
    k: int
    measurements: dict[str, int]
    late: dict[str, int]
    anchors: int
    nis: float | None
    dof: int
    digest: str
    sigma_altitude: list[float | None]
    sigma_horizontal: list[float | None]
    max_sigma_altitude: float | None
    median_sigma_altitude: float | None
    max_sigma_horizontal: float | None
    median_sigma_horizontal: float | None


class Age(msgspec.Struct, kw_only=True):
    """How old a live estimate was when it was recorded, s after its frame arrived here."""

    p50: float
    p99: float
    max: float


class Consumer(msgspec.Struct, kw_only=True):
    """How a consumer kept up with a stage.

    Parameters
    ----------
    consumer, stage : str
        Who listened to whom.
    age_p99, age_max : float or None
        The largest 99th percentile of any second, and the largest age: from the receive time of a message's newest
        sample to the moment it was handed on, s.
    messages, missing, backfilled, refused : int
        As in `telemetry.messages.Health`, at the end.
    """

    consumer: str
    stage: str
    age_p99: float | None
    age_max: float | None
    messages: int
    missing: int
    backfilled: int
    refused: int


class Summary(msgspec.Struct, kw_only=True):
    """What a recording holds.

    Parameters
    ----------
    completeness : str
        "complete", "truncated", "no data", "not closed", or what the caller of the recorder said.
    origin : list of float or None
        Latitude, longitude (degrees), altitude (m) of the map's zero.
    events : dict of str to int
        Events by level.
    age, settled : Age or None
        Of all live estimates; of those from 30 s after the beginning, when their wait has adapted to the telemetry.
    alarms : list of str
        What went wrong while writing.
    messages, rows : int
        Messages consumed; rows of samples in them.
    """

    sortie: str
    completeness: str
    format: int = FORMAT
    properties: dict[str, str] = {}
    gap: float = 0.0
    t0: int = 0
    t1: int = 0
    t_rx0: int = 0
    t_rx1: int = 0
    messages: int = 0
    rows: int = 0
    origin: list[float] | None = None
    vehicles: list[Vehicle] = []
    accounts: list[Account] = []
    byte_accounts: list[ByteAccount] = []
    consumers: list[Consumer] = []
    windows: list[Smoothed] = []
    reports: list[Worth] = []
    events: dict[str, int] = {}
    age: Age | None = None
    settled: Age | None = None
    alarms: list[str] = []


def read(text: str) -> Summary:
    """A summary from its JSON; the first format had one live account per vehicle.

    Raises
    ------
    msgspec.ValidationError
        If it is none.
    """
    found = msgspec.json.decode(text)
    for vehicle in found.get("vehicles", []):
        live = vehicle.get("live")
        if not isinstance(live, list):
            vehicle["live"] = [] if live is None else [live]
    return msgspec.convert(found, Summary)


def smoothed(window: Window) -> Smoothed:
    """The figures of a window."""
    roles = [role(name) for name in window.names]
    with np.errstate(over="ignore", invalid="ignore"):
        altitude = window.std[:, roles.index("altitude")] if "altitude" in roles else np.full(len(window.t), np.nan)
        if "north" in roles and "east" in roles:
            horizontal = np.hypot(window.std[:, roles.index("north")], window.std[:, roles.index("east")])
        else:
            horizontal = np.full(len(window.t), np.nan)
    places = (0, len(window.t) // 2, len(window.t) - 1)
    return Smoothed(
        vehicle=window.vehicle,
        number=window.number,
        boot=window.boot,
        test_point=window.test_point,
        reason=window.reason,
        scope=window.scope,
        model=window.model,
        t0=int(window.t[0]),
        t1=int(window.t[-1]),
        k=len(window.t),
        measurements=dict(window.measurements),
        late=dict(window.late),
        anchors=window.anchors,
        nis=finite(window.nis),
        dof=window.dof,
        digest=window.digest,
        sigma_altitude=[finite(altitude[i]) for i in places],
        sigma_horizontal=[finite(horizontal[i]) for i in places],
        max_sigma_altitude=finite(altitude.max()),
        median_sigma_altitude=finite(float(np.median(altitude))),
        max_sigma_horizontal=finite(horizontal.max()),
        median_sigma_horizontal=finite(float(np.median(horizontal))),
    )


def chi_square_interval(dof: int) -> tuple[float, float]:
    """Two-sided 95 % interval of a chi-square variable, after Wilson and Hilferty (error under 1 % from 3 degrees
    on).
    """
    spread = 2.0 / (9.0 * dof)
    low, high = (dof * max(0.0, 1.0 - spread + z * math.sqrt(spread)) ** 3 for z in (-1.959964, 1.959964))
    return low, high


def verdict(nis: float | None, dof: int) -> str:
    """What the innovations say of the model: "consistent", "overconfident", "cautious" or "no test".

    Overconfident: the residuals are larger than the model claims. With thousands of scalars the interval is so narrow
    that no real sensor passes it; a ratio within 20 % of one counts as consistent too, and says so by the word
    "nearly".
    """
    if nis is None or dof <= 0:
        return "no test"
    low, high = chi_square_interval(dof)
    if low <= nis <= high:
        return "consistent"
    if 0.8 <= nis / dof <= 1.2:
        return "nearly consistent"
    return "overconfident" if nis > high else "cautious"


def _metres(values: list[float | None]) -> str:
    return " / ".join("-" if value is None else f"{value:.2f}" for value in values) + " m"


def markdown(window: Smoothed) -> str:
    """Report of a window, for the viewer's document panel."""
    title = window.test_point or "between test points"
    knew = "everything up to its closing" if window.scope == "window" else "the whole boot epoch"
    used = ", ".join(f"{sensor} {n}" for sensor, n in window.measurements.items()) or "none"
    late = ", ".join(f"{sensor} {n}" for sensor, n in window.late.items() if n) or "none"
    ratio = f"{window.nis / window.dof:.2f}" if window.nis is not None and window.dof > 0 else "-"
    return "\n".join(
        [
            f"# {title}",
            f"Window {window.number} of boot {window.boot}, vehicle {window.vehicle}. "
            f"Closed by **{window.reason}**, smoothed with {knew}.",
            "",
            "| | |",
            "|---|---|",
            f"| span | {utc(window.t0)} - {utc(window.t1, date=False)} "
            f"({(window.t1 - window.t0) / 1e9:.1f} s, {window.k} rows) |",
            f"| model | {window.model} |",
            f"| samples used | {used} |",
            f"| samples late for the live estimate | {late} |",
            f"| NIS / dof | {ratio} ({window.dof} scalars): {verdict(window.nis, window.dof)} |",
            f"| sigma altitude, start / middle / end | {_metres(window.sigma_altitude)} |",
            f"| sigma horizontal, start / middle / end | {_metres(window.sigma_horizontal)} |",
            f"| re-anchored | {window.anchors} times |",
            f"| inputs | `{window.digest[:16]}` |",
        ]
    )
