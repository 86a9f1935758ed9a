"""The vocabulary: every message that crosses a room's wall.

A message is a frozen struct of columns over k >= 1 samples: live, a batch holds what has just arrived; offline it may
hold millions. Units are SI, angles radians, the Earth frame north-east-down, the body frame forward-right-down.
``NaN`` means "not measured"; a number is never invented.

Two times stand on every sample, both int64 nanoseconds of Unix time:

``t``
    The vehicle's own clock, anchored once per boot epoch to the receive time of the epoch's first timed frame. Inside
    an epoch its intervals are the vehicle's; it never jumps when more is learnt about the clock. What it differs from
    UTC is a message of its own, `ClockFit`.
``t_rx``
    When the frame arrived here.

How a message travels is told in `telemetry.wire`.
"""

from __future__ import annotations

from typing import ClassVar, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

Times = NDArray[np.int64]
Counts = NDArray[np.int64]
Floats = NDArray[np.float64]
Bytes = NDArray[np.uint8]


class Message(msgspec.Struct, frozen=True, kw_only=True, eq=False):
    """What every message says: who measured, in which boot epoch, when, and when we heard of it.

    Parameters
    ----------
    vehicle : int
        MAVLink system id; 0 when the message is about a link or a stage rather than a vehicle.
    source : str
        ``"link/component"`` of the sender, ``"link"`` for a whole link, or the name of the stage. A sender heard over
        several links keeps the name of the first.
    boot : int
        Boot epoch of the vehicle, counted from 0 in this recording.
    t, t_rx : int64 array, shape (k,)
        Vehicle time and receive time, ns (module docstring).
    sequence : int
        Position in the output of the stage that made the message, gap-free from 0; -1 before the stage has numbered it.

    Raises
    ------
    ValueError
        If a column has not the shape it should, or t is empty.
    """

    vehicle: int
    source: str
    boot: int
    t: Times
    t_rx: Times
    sequence: int = -1

    family: ClassVar[str] = "event"  # the chunk of the bus key that names the kind of traffic
    stream: ClassVar[str] = ""  # the last chunk of the key
    texts: ClassVar[tuple[str, ...]] = ()  # columns of text: lists with one entry per row
    widths: ClassVar[dict[str, int | str]] = {}  # columns of vectors: their length, or the field whose length it is

    def __post_init__(self) -> None:
        rows = len(self.t)
        if rows == 0:
            raise ValueError(f"{type(self).__name__}: a message holds at least one sample")
        for name in self.__struct_fields__:
            value = getattr(self, name)
            if isinstance(value, np.ndarray):
                width = self.widths.get(name)
                shape = (
                    (rows,) if width is None else (rows, len(getattr(self, width)) if isinstance(width, str) else width)
                )
                if value.shape != shape:
                    raise ValueError(f"{type(self).__name__}.{name}: shape {value.shape} where {shape} belongs")
            elif name in self.texts and len(value) != rows:
                raise ValueError(f"{type(self).__name__}.{name}: {len(value)} rows where t has {rows}")


class Sample(Message, frozen=True, kw_only=True, eq=False):
    """What a sensor measured.

    One of several like sensors has its number in `source`: ``"link/component.instance"``, instance 0 being plain.

    Parameters
    ----------
    chosen : bool
        The estimator uses it. Other streams of the same kind are recorded beside it, for comparison.
    t_sigma : float array, shape (k,), or None
        Standard deviation of `t`, s, where the vehicle did not say when it measured; None where it did.
    """

    chosen: bool = True
    t_sigma: Floats | None = None


class Imu(Sample, frozen=True, kw_only=True, eq=False):
    """Inertial measurement: what accelerometers and gyros feel, body axes.

    Parameters
    ----------
    specific_force : float array, shape (k, 3)
        m/s2, forward-right-down: at rest (0, 0, -9.81).
    angular_rate : float array, shape (k, 3)
        rad/s, inertial p, q, r.
    """

    specific_force: Floats
    angular_rate: Floats

    family: ClassVar[str] = "sensor"
    stream: ClassVar[str] = "imu"
    widths: ClassVar[dict[str, int | str]] = {"specific_force": 3, "angular_rate": 3}


class Attitude(Sample, frozen=True, kw_only=True, eq=False):
    """Attitude as the autopilot estimates it: Euler angles 3-2-1, NED to body.

    Parameters
    ----------
    phi, theta, psi : float array, shape (k,)
        Roll, pitch, heading, rad.
    """

    phi: Floats
    theta: Floats
    psi: Floats

    family: ClassVar[str] = "sensor"
    stream: ClassVar[str] = "attitude"


class AirData(Sample, frozen=True, kw_only=True, eq=False):
    """Airspeed system.

    Parameters
    ----------
    airspeed : float array, shape (k,)
        Indicated (calibrated) airspeed, m/s.
    differential_pressure : float array, shape (k,)
        Pa; small negative values occur at rest and keep their sign.
    """

    airspeed: Floats
    differential_pressure: Floats

    family: ClassVar[str] = "sensor"
    stream: ClassVar[str] = "air_data"


class FlowAngles(Sample, frozen=True, kw_only=True, eq=False):
    """Vanes or a multi-hole probe: the direction of the flow where they stand.

    Parameters
    ----------
    alpha, beta : float array, shape (k,)
        Angle of attack, atan2(w, u), and sideslip, asin(v / V), rad; NaN where one of the two is not measured.
    """

    alpha: Floats
    beta: Floats

    family: ClassVar[str] = "sensor"
    stream: ClassVar[str] = "flow_angles"


class Altitude(Sample, frozen=True, kw_only=True, eq=False):
    """Pressure altimeter.

    Parameters
    ----------
    altitude : float array, shape (k,)
        Pressure altitude in the ICAO standard atmosphere, m: off from the true altitude by the weather of the day.
    pressure : float array, shape (k,)
        Static pressure, Pa.
    sigma : float array, shape (k,)
        Standard deviation of the noise, m; the weather's offset is not part of it.
    """

    altitude: Floats
    pressure: Floats
    sigma: Floats

    family: ClassVar[str] = "sensor"
    stream: ClassVar[str] = "altitude"


class Gnss(Sample, frozen=True, kw_only=True, eq=False):
    """Satellite navigation fix; only fixes that the receiver itself calls three-dimensional.

    Parameters
    ----------
    latitude, longitude : float array, shape (k,)
        WGS-84, rad.
    altitude : float array, shape (k,)
        Above mean sea level, m.
    velocity : float array, shape (k, 3)
        North, east, down, m/s; NaN where the receiver does not report a component.
    sigma : float array, shape (k, 3)
        Standard deviation of horizontal position (per axis) and altitude, m, and of velocity (per axis), m/s.
    satellites : int64 array, shape (k,)
        Satellites in use, -1 when not reported.
    """

    latitude: Floats
    longitude: Floats
    altitude: Floats
    velocity: Floats
    sigma: Floats
    satellites: Counts

    family: ClassVar[str] = "sensor"
    stream: ClassVar[str] = "gnss"
    widths: ClassVar[dict[str, int | str]] = {"velocity": 3, "sigma": 3}


class StatusText(Message, frozen=True, kw_only=True, eq=False):
    """What the vehicle says in words; severity 0 (emergency) to 7 (debug) as in syslog."""

    severity: Counts
    text: list[str]

    family: ClassVar[str] = "event"
    stream: ClassVar[str] = "status_text"
    texts: ClassVar[tuple[str, ...]] = ("text",)


class Mark(Message, frozen=True, kw_only=True, eq=False):
    """A test point begins (``action`` "start") or ends ("stop")."""

    action: list[Literal["start", "stop"]]
    name: list[str]

    family: ClassVar[str] = "mark"
    stream: ClassVar[str] = "test_point"
    texts: ClassVar[tuple[str, ...]] = ("action", "name")


class LinkStats(Message, frozen=True, kw_only=True, eq=False):
    """The loss account of one (link, system, component), one row per second of receive time; every counter only grows.

    An account runs across the boots of the vehicle; its `boot` is 0.

    ``loss = (lost - late) / (received + lost - late)``; NaN where the sender does not count per component, because a
    percentage would then be a fiction.

    Parameters
    ----------
    received, lost, late, out_of_order, duplicate, conflict, ambiguous, restarted : int64 array, shape (k,)
        Distinct numbers that arrived; numbers given up; numbers that arrived after that; numbers that came after a
        higher one in time; numbers seen before; the same number with other bytes; numbers in holes too long for an
        8-bit counter to tell; restarts of the sender.
    unknown, redundant : int64 array, shape (k,)
        Frames of an id that the dialect does not know; frames that another link had brought before, which are used
        once and counted on both.
    loss : float array, shape (k,)
        Over the last 10 s, 0..1.
    loss_total : float array, shape (k,)
        Since the beginning, 0..1.
    """

    received: Counts
    lost: Counts
    late: Counts
    out_of_order: Counts
    duplicate: Counts
    conflict: Counts
    ambiguous: Counts
    restarted: Counts
    unknown: Counts
    redundant: Counts
    loss: Floats
    loss_total: Floats

    family: ClassVar[str] = "link"
    stream: ClassVar[str] = "stats"


class LinkBytes(Message, frozen=True, kw_only=True, eq=False):
    """The byte account of one link, a row about every second; all but `pending` only grow.

    ``bytes = bytes in frames + discarded + pending``. A corrupt frame is also a lost number: never add the two.

    Parameters
    ----------
    bytes, frames, unknown, corrupt, refused, discarded, pending : int64 array, shape (k,)
        Bytes in; frames accepted; of these, frames whose id the dialect does not know; frames of a known id whose
        checksum failed; whole frames that were refused, because of their signature; bytes in no accepted frame; bytes
        that wait for the rest of a frame.
    """

    bytes: Counts
    frames: Counts
    unknown: Counts
    corrupt: Counts
    refused: Counts
    discarded: Counts
    pending: Counts

    family: ClassVar[str] = "link"
    stream: ClassVar[str] = "bytes"


class ClockFit(Message, frozen=True, kw_only=True, eq=False):
    """What the vehicle clock is worth: ``UTC = t + offset + rate (t - t[0 of the epoch])``, as far as known at this
    time.

    Parameters
    ----------
    reference : list of str
        What it was fitted to: "arrival" (this machine's clock, late by the link's least delay), "system_time" (the
        vehicle's own UTC) or, in on-board logs, "gnss" (UTC of the satellite fixes, late by the receiver's delay).
    offset, offset_sigma : float array, shape (k,)
        s.
    rate, rate_sigma : float array, shape (k,)
        Dimensionless; 1e-6 is one ppm.
    delay_p50, delay_p99, delay_max : float array, shape (k,)
        Arrival delay above the least one, s.
    span : float array, shape (k,)
        Length of the data behind the fit, s.
    valid : int64 array, shape (k,)
        1 when the fit may be used, else 0 (span under 60 s, |rate| above 1 %).
    """

    reference: list[str]
    offset: Floats
    offset_sigma: Floats
    rate: Floats
    rate_sigma: Floats
    delay_p50: Floats
    delay_p99: Floats
    delay_max: Floats
    span: Floats
    valid: Counts

    family: ClassVar[str] = "clock"
    stream: ClassVar[str] = "fit"
    texts: ClassVar[tuple[str, ...]] = ("reference",)


class Event(Message, frozen=True, kw_only=True, eq=False):
    """Something a reader of the log should know: a reboot, a gap, a repair, a refusal; ``level`` as in `logging`."""

    level: list[Literal["info", "warning", "error"]]
    text: list[str]

    family: ClassVar[str] = "event"
    stream: ClassVar[str] = "log"
    texts: ClassVar[tuple[str, ...]] = ("level", "text")


class Estimate(Message, frozen=True, kw_only=True, eq=False):
    """The live estimate after each step.

    Parameters
    ----------
    model : str
        The state-space model.
    names, units : tuple of str, length n
        State names and their SI units.
    mean, std : float array, shape (k, n)
        State and standard deviation; NaN and inf while the measurements so far do not determine the state.
    nis : float array, shape (k,)
        Normalised innovation squared of the step, chi-square with ``dof`` degrees of freedom if the model is right.
    dof : int64 array, shape (k,)
        Scalars absorbed in the step; 0 for a step across a silence.
    geodetic : float array, shape (k, 3)
        Latitude, longitude (rad) and altitude (m) of the mean.
    """

    model: str
    names: tuple[str, ...]
    units: tuple[str, ...]
    mean: Floats
    std: Floats
    nis: Floats
    dof: Counts
    geodetic: Floats

    family: ClassVar[str] = "estimate"
    stream: ClassVar[str] = "live"
    widths: ClassVar[dict[str, int | str]] = {"mean": "names", "std": "names", "geodetic": 3}


class Window(Message, frozen=True, kw_only=True, eq=False):
    """Fixed-interval smoothing of a closed window: the flight path between two closings.

    Parameters
    ----------
    model, names, units, mean, std, geodetic
        As in `Estimate`, smoothed.
    number : int
        Counts the windows of one boot epoch from 0.
    test_point : str
        Name of the test point, empty between test points.
    reason : str
        Why it closed: "mark", "gap", "length", "reboot" or "end".
    scope : str
        What the smoothing knew: "window" (everything up to the closing) or "sortie" (the whole boot epoch).
    measurements : dict of str to int
        Samples used, per sensor.
    late : dict of str to int
        Samples that came too late to be used, per sensor.
    anchors : int
        How often the numerics re-anchored inside the window (exact, so for information only).
    nis, dof : float, int
        Sum of the normalised innovations squared, and the scalars behind it.
    digest : str
        SHA-256 of the inputs (times, values, noise) and the configuration.
    """

    model: str
    names: tuple[str, ...]
    units: tuple[str, ...]
    mean: Floats
    std: Floats
    geodetic: Floats
    number: int
    test_point: str
    reason: Literal["mark", "gap", "length", "reboot", "end"]
    scope: Literal["window", "sortie"]
    measurements: dict[str, int]
    late: dict[str, int]
    anchors: int
    nis: float
    dof: int
    digest: str

    family: ClassVar[str] = "window"
    stream: ClassVar[str] = "smoothed"
    widths: ClassVar[dict[str, int | str]] = {"mean": "names", "std": "names", "geodetic": 3}


class Spread(msgspec.Struct, frozen=True, kw_only=True):
    """How well a state was known over a stretch of flight: medians of the standard deviation, SI."""

    name: str
    unit: str
    filtered: float | None
    smoothed: float | None


class Parameter(msgspec.Struct, frozen=True, kw_only=True):
    """A constant that the estimator found, and what that is worth.

    Parameters
    ----------
    name, unit : str
    value, sigma : float or None
        None where it is not observable: a number would be taken for one.
    prior : float
        Standard deviation before any measurement.
    gain : float
        Information gained, log2(prior / sigma), bits.
    z : float or None
        Distance from the same parameter in the other test points, in sigmas; None for the only one.
    verdict : str
        "consistent", "inconsistent" or "not observable".
    why : str
        The number behind the verdict, in words.
    """

    name: str
    unit: str
    value: float | None
    sigma: float | None
    prior: float
    gain: float
    z: float | None
    verdict: Literal["consistent", "inconsistent", "not observable"]
    why: str


class Channel(msgspec.Struct, frozen=True, kw_only=True):
    """What the innovations of one measured quantity say about its noise and about the model.

    Parameters
    ----------
    name, unit : str
    used, weakened, rejected : int
        Scalars absorbed; of these with raised noise; refused by the gate.
    nis : float or None
        Mean of the normalised innovation squared, 1 if the model is right.
    low, high : float or None
        Band of the mean that chi-square allows, two-sided 99 %, for as many independent scalars.
    lag1 : float or None
        Correlation of successive innovations, 0 if the model is right.
    verdict : str
        "consistent", "over-confident" (above the band), "cautious" (below), "not white" or "no data".
    why : str
        Number and advice in words.
    """

    name: str
    unit: str
    used: int
    weakened: int
    rejected: int
    nis: float | None
    low: float | None
    high: float | None
    lag1: float | None
    verdict: Literal["consistent", "over-confident", "cautious", "not white", "no data"]
    why: str


class Report(Message, frozen=True, kw_only=True, eq=False):
    """What a test point, a window or a whole sortie is worth; one row, at its end.

    Parameters
    ----------
    model : str
    test_point : str
        Empty between test points and for a whole sortie.
    scope : str
        "window", "test point" or "sortie".
    window : int
        Number of its last window.
    begin : int
        Time of its first estimate, ns.
    states : tuple of Spread
    parameters : tuple of Parameter
    channels : tuple of Channel
    gaps : dict of str to float
        Seconds without inertial data, by what was done: "interpolated", "lost" between two stretches of the estimate;
        and longer silences of the other sensors, by their streams.
    loss : float or None
        Share of the samples due that did not come, 0..1.
    loss_effect : dict of str to float
        By how much the loss raised the standard deviation of a state: factor by name.
    findings : tuple of str
        Defects of sensors and settings, each named with the number that shows it.
    alarms : tuple of str
        What makes the error bars untrustworthy.
    digest : str
        SHA-256 of inputs and configuration.
    """

    model: str
    test_point: str
    scope: Literal["window", "test point", "sortie"]
    window: int
    begin: int
    states: tuple[Spread, ...]
    parameters: tuple[Parameter, ...]
    channels: tuple[Channel, ...]
    gaps: dict[str, float]
    loss: float | None
    loss_effect: dict[str, float]
    findings: tuple[str, ...]
    alarms: tuple[str, ...]
    digest: str

    family: ClassVar[str] = "window"
    stream: ClassVar[str] = "report"


class Health(Message, frozen=True, kw_only=True, eq=False):
    """How a consumer keeps up with a stage: a row about every second, `source` being the consumer.

    Parameters
    ----------
    stage : str
        The stage it listens to.
    age_p50, age_p99, age_max : float array, shape (k,)
        From the receive time of a message's newest sample to the moment it was handed on, over that second, s.
    messages, missing, backfilled, refused : int64 array, shape (k,)
        Handed on so far; given up for ever; fetched again after a gap; payloads that were no message of this version.
    """

    stage: str
    age_p50: Floats
    age_p99: Floats
    age_max: Floats
    messages: Counts
    missing: Counts
    backfilled: Counts
    refused: Counts

    family: ClassVar[str] = "event"
    stream: ClassVar[str] = "health"


class Progress(Message, frozen=True, kw_only=True, eq=False):
    """Everything received up to ``t_rx[-1]`` has been told; with ``final``, nothing more will come.

    Batches end here: all samples of one receive time stand on one side of a `Progress`, which is what makes results
    independent of how the stream was cut.
    """

    final: bool = False

    family: ClassVar[str] = "event"
    stream: ClassVar[str] = "progress"


KINDS: dict[str, type[Message]] = {
    kind.__name__: kind
    for kind in (
        Imu,
        Attitude,
        AirData,
        FlowAngles,
        Altitude,
        Gnss,
        StatusText,
        Mark,
        LinkStats,
        LinkBytes,
        ClockFit,
        Event,
        Estimate,
        Window,
        Report,
        Health,
        Progress,
    )
}

SENSORS = (Imu, Attitude, AirData, FlowAngles, Altitude, Gnss)


def event(
    text: str,
    *,
    level: Literal["info", "warning", "error"] = "info",
    vehicle: int = 0,
    source: str = "",
    boot: int = 0,
    t: int,
    t_rx: int,
) -> Event:
    """One event at one time."""
    times = np.array([t], np.int64), np.array([t_rx], np.int64)
    return Event(vehicle=vehicle, source=source, boot=boot, t=times[0], t_rx=times[1], level=[level], text=[text])
