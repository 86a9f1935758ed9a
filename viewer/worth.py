"""Worth: what a test point, a window or a whole sortie is worth, as numbers that last and as a page to read."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence

import msgspec

from telemetry.messages import Channel, Report, Spread
from viewer.states import order, shown, words
from viewer.text import duration, utc

_FIELDS = ("vehicle", "boot", "model", "test_point", "scope", "window", "begin", "states", "parameters", "channels")
_MORE = ("gaps", "loss", "loss_effect", "findings", "alarms", "digest")
PARAMETERS = ("parameter", "value ± sigma", "prior sigma", "gain, bit", "z", "verdict")
CHANNELS = ("channel", "mean NIS", "band", "lag-1", "used / weakened / rejected", "verdict")
STATES = ("state", "filtered", "smoothed", "ratio")
WRONG = ("inconsistent", "over-confident", "cautious", "not white")
_SCOPES = {"sortie": "whole sortie", "test point": "test point", "window": "window"}
_GAPS = {
    "held": "held at its last value",
    "interpolated": "interpolated",
    "lost": "lost: the estimate ended and began anew",
}


class Constant(msgspec.Struct, kw_only=True):
    """A `telemetry.messages.Parameter`; what is not finite is None, because JSON has neither NaN nor infinity."""

    name: str
    unit: str
    value: float | None
    sigma: float | None
    prior: float | None
    gain: float | None
    z: float | None
    verdict: str
    why: str


class Worth(msgspec.Struct, kw_only=True):
    """A `telemetry.messages.Report` as JSON holds it; ``begin`` to ``end`` in ns, the rest as in the message."""

    vehicle: int
    boot: int
    model: str
    test_point: str
    scope: str
    window: int
    begin: int
    end: int
    t_rx: int
    states: list[Spread]
    parameters: list[Constant]
    channels: list[Channel]
    gaps: dict[str, float | None]
    loss: float | None
    loss_effect: dict[str, float | None]
    findings: list[str]
    alarms: list[str]
    digest: str


def worth(report: Report) -> Worth:
    """A report without its columns."""
    fields = {name: getattr(report, name) for name in (*_FIELDS, *_MORE)}
    text = msgspec.json.encode({**fields, "end": int(report.t[-1]), "t_rx": int(report.t_rx[-1])})
    return msgspec.json.decode(text, type=Worth)


def title(found: Worth) -> str:
    """What a report is about."""
    if found.scope == "sortie":
        return "Whole sortie"
    return found.test_point or f"Window {found.window}, between test points"


def headline(found: Worth) -> str:
    """The verdict in a few words, the worst first."""
    channels: Counter[str] = Counter(c.verdict for c in found.channels)
    said = [_counted(len(found.alarms), "alarm")] if found.alarms else []
    worst = [v for v in ("over-confident", "not white", "cautious") if channels[v]]
    said += [f"{_counted(channels[v], 'channel')} {v}" for v in worst]
    if apart := sum(p.verdict == "inconsistent" for p in found.parameters):
        said.append(f"{_counted(apart, 'parameter')} inconsistent")
    if found.findings:
        said.append(_counted(len(found.findings), "finding"))
    if said:
        return ", ".join(said)
    return "consistent" if channels["consistent"] else "no innovation was tested"


def estimate(p: Constant) -> str:
    """A parameter with its sigma, both to the digits that the sigma allows; angles in degrees."""
    if p.value is None or p.sigma is None:
        return "-"
    value, unit = shown(p.value, p.unit)
    sigma, _ = shown(p.sigma, p.unit)
    assert value is not None and sigma is not None
    places = digits(sigma)
    return f"{value:z.{places}f} ± {sigma:.{places}f}{_unit(unit)}"


def digits(sigma: float) -> int:
    """Decimal places that show two figures of a standard deviation."""
    if not (0.0 < sigma < math.inf):
        return 3
    return min(max(1 - math.floor(math.log10(sigma)), 0), 9)


def amount(value: float | None, unit: str = "") -> str:
    """A number to three figures in the unit of its reader; "-" where there is none."""
    value, unit = shown(value, unit)
    return "-" if value is None else f"{value:.3g}{_unit(unit)}"


def named(name: str) -> str:
    """A state or parameter with its words, e.g. ``ba_x (accelerometer bias x)``."""
    said = words(name)
    return f"{name} ({said})" if said and name not in said.split() else said or name


def gaps(found: Worth) -> str:
    """Seconds without inertial data, in words."""
    there = [f"{amount(s, 's')} {_GAPS.get(kind, kind)}" for kind, s in found.gaps.items() if s]
    return "; ".join(there) or "none"


def loss(found: Worth) -> str:
    """What was lost on the way and what that cost, in words."""
    share = "not known" if found.loss is None else f"{100 * found.loss:.2f} % of the samples due did not come"
    worse = [f"{name} by {amount(factor)}" for name, factor in found.loss_effect.items()]
    return f"{share}; it multiplied the sigma of {', '.join(worse)}" if worse else share


def states(found: Worth) -> list[Spread]:
    """The states in the order in which they are read."""
    return sorted(found.states, key=lambda s: order(s.name))


def wrong(found: Worth) -> bool:
    """Whether a parameter or a channel is other than it should be."""
    return any(p.verdict in WRONG for p in found.parameters) or any(c.verdict in WRONG for c in found.channels)


def doubts(what: Sequence[Constant | Channel]) -> list[str]:
    """Why parameters or channels are not simply consistent, a line each."""
    return [f"{x.name}: {x.verdict}: {x.why}" for x in what if x.verdict != "consistent"]


def parameter_row(p: Constant) -> tuple[str, ...]:
    """A parameter as `PARAMETERS` heads it."""
    return named(p.name), estimate(p), amount(p.prior, p.unit), _figure(p.gain), _figure(p.z), p.verdict


def channel_row(c: Channel) -> tuple[str, ...]:
    """A channel as `CHANNELS` heads it."""
    band = "-" if c.low is None or c.high is None else f"{c.low:.2f} .. {c.high:.2f}"
    counts = f"{c.used} / {c.weakened} / {c.rejected}"
    return named(c.name), _figure(c.nis), band, _figure(c.lag1), counts, c.verdict


def state_row(s: Spread) -> tuple[str, ...]:
    """A state as `STATES` heads it."""
    ratio = f"{s.smoothed / s.filtered:.2f}" if s.smoothed is not None and s.filtered else "-"
    return named(s.name), amount(s.filtered, s.unit), amount(s.smoothed, s.unit), ratio


def about(found: Worth) -> str:
    """Which stretch of flight a report is about, in one line."""
    where = f"vehicle {found.vehicle}, boot {found.boot}, window {found.window}"
    at = f"{utc(found.begin)} - {utc(found.end, date=False)} ({duration((found.end - found.begin) / 1e9)})"
    return f"{_SCOPES.get(found.scope, found.scope)}, model {found.model.replace('_', ' ')}, {where}: {at}"


def markdown(found: Worth) -> str:
    """Report as a page for the viewer's document panel: the verdict first, the evidence below it."""
    out = [f"# {_plain(title(found))}", f"**{headline(found)}**", "", _plain(about(found))]
    out += _bullets("Alarms", [f"**{_plain(text)}**" for text in found.alarms])
    out += _table("Parameters", PARAMETERS, [parameter_row(p) for p in found.parameters])
    out += _bullets("", [_plain(text) for text in doubts(found.parameters)])
    out += _table("Channels", CHANNELS, [channel_row(c) for c in found.channels])
    out += _bullets("", [_plain(text) for text in doubts(found.channels)])
    out += _table("Median sigma", STATES, [state_row(s) for s in states(found)])
    data = [f"without inertial data: {gaps(found)}", f"loss: {loss(found)}"]
    out += _bullets("Data", [_plain(text) for text in data])
    out += _bullets("Findings", [_plain(text) for text in found.findings])
    return "\n".join([*out, "", f"Inputs and configuration: `{found.digest[:16]}`"])


def _bullets(head: str, lines: list[str]) -> list[str]:
    if not lines:
        return []
    return ["", *([f"## {head}"] if head else []), *(f"- {line}" for line in lines)]


def _table(head: str, columns: tuple[str, ...], rows: list[tuple[str, ...]]) -> list[str]:
    """A table whose last column is emphasised where it is a verdict that needs attention."""
    if not rows:
        return []
    lines = ["", f"## {head}", f"| {' | '.join(columns)} |", "|---" * len(columns) + "|"]
    for row in rows:
        *cells, last = map(_plain, row)
        lines.append(f"| {' | '.join([*cells, f'**{last}**' if last in WRONG else last])} |")
    return lines


def _plain(text: str) -> str:
    """Text that does not break a table and is not taken for a tag."""
    return text.replace("|", "\\|").replace("<", "&lt;").replace("\n", " ")


def _figure(value: float | None) -> str:
    return "-" if value is None else f"{value:z.2f}"


def _unit(unit: str) -> str:
    return "" if unit in ("", "1", "-") else f" {unit}"


def _counted(number: int, what: str) -> str:
    return f"{number} {what}{'' if number == 1 else 's'}"
