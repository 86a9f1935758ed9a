"""Report: a review in words and tables, and as JSON."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING

import msgspec

from viewer.columns import first
from viewer.summary import Clock, Summary, Vehicle, verdict
from viewer.text import duration, utc
from viewer.worth import (
    STATES,
    Worth,
    about,
    channel_row,
    doubts,
    gaps,
    headline,
    loss,
    parameter_row,
    state_row,
    states,
    title,
    wrong,
)

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from viewer.review import Review

LINES = 40  # lines of the event log that a report repeats; all of them are in the recording
REPORTS = 12  # reports up to which each is told in full
_LEVELS = ("CRITICAL", "ERROR", "WARN", "INFO", "DEBUG")
# Shorter than on the page, because a terminal may be narrow.
_PARAMETERS = ("parameter", "value ± sigma", "prior", "gain", "z", "verdict")
_CHANNELS = ("channel", "NIS", "band", "lag-1", "used/weak/rejected", "verdict")
_VERDICTS = {
    "consistent": "green",
    "inconsistent": "red",
    "over-confident": "red",
    "cautious": "yellow",
    "not white": "yellow",
    "not observable": "dim",
    "no data": "dim",
}
_COLOURS = {"CRITICAL": "bold red", "ERROR": "red", "WARN": "yellow", "DEBUG": "dim"}


def to_json(review: Review) -> bytes:
    """The review as indented JSON."""
    return msgspec.json.format(msgspec.json.encode(review))


def tell(review: Review, console: Console) -> None:
    """Print a review for a human reader.

    Parameters
    ----------
    review : Review
    console : rich.console.Console
    """
    summary = review.summary
    good = summary.completeness == "complete" and review.closed and not review.remarks
    console.print(
        f"[bold]{_plain(summary.sortie) or 'unnamed sortie'}[/bold]: "
        f"[{'green' if good else 'yellow'}]{_plain(summary.completeness)}[/]",
        highlight=False,
    )
    for text in [*review.remarks, *summary.alarms]:
        console.print(f"  ! {_plain(text)}", style="yellow", highlight=False)
    if not summary.vehicles:
        console.print("  no vehicle was heard")
    else:
        span = (summary.t_rx1 - summary.t_rx0) / 1e9
        console.print(f"  {utc(summary.t_rx0)} UTC, {duration(span)}", highlight=False)
    for key, value in summary.properties.items():
        console.print(f"  {_plain(key)}: {_plain(value)}", style="dim", highlight=False)
    for vehicle in summary.vehicles:
        _vehicle(vehicle, console)
    _links(summary, console)
    if summary.windows:
        _windows(summary, console)
    for found in summary.reports:
        # In a long flight windows without a complaint would push everything else off the screen.
        _report(found, console, whole=len(summary.reports) <= REPORTS or found.scope != "window" or bool(found.alarms))
    _events(review, console)


def _plain(text: str) -> str:
    from rich.markup import escape

    return escape(text)


def _table(title: str, *columns: str) -> Table:
    from rich import box
    from rich.table import Table

    table = Table(title=title, title_justify="left", title_style="bold", box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for column in columns:
        name, _, side = column.partition(">")
        table.add_column(name, justify="right" if side == "" and column.endswith(">") else "left", no_wrap=True)
    return table


def _number(value: float | None, form: str = ".1f", unit: str = "") -> str:
    return "-" if value is None else f"{value:{form}}{unit}"


def _vehicle(vehicle: Vehicle, console: Console) -> None:
    table = _table(
        f"Vehicle {vehicle.vehicle}: measured", "sensor", "from", "samples>", "rate>", "interruptions>", "silent>"
    )
    for sensor in vehicle.sensors:
        table.add_row(
            sensor.sensor,
            _plain(sensor.source),
            str(sensor.samples),
            _number(sensor.rate, ".1f", " Hz"),
            str(sensor.gaps),
            f"{sensor.silence:.1f} s",
        )
    console.print(table)
    for boot in vehicle.boots:
        console.print(
            f"  boot {boot.boot}: {utc(boot.t0)} - {utc(boot.t1, date=False)} ({duration((boot.t1 - boot.t0) / 1e9)})",
            highlight=False,
        )
        for clock in vehicle.clocks:
            if clock.boot == boot.boot:
                console.print(f"    clock: {_clock(clock)}", highlight=False)
    for silence in vehicle.silences:
        console.print(
            f"  not heard: {utc(silence.t0, date=False)} - {utc(silence.t1, date=False)} "
            f"({duration((silence.t1 - silence.t0) / 1e9)})",
            style="yellow",
            highlight=False,
        )
    for live in vehicle.live:
        ratio = (
            f"NIS/dof {live.nis / live.dof:.2f}, {verdict(live.nis, live.dof)}"
            if live.dof
            else "no test of the innovations"
        )
        model = f"model {live.model}, " if live.model else ""
        console.print(
            f"  live estimate: {model}{live.rows} rows, {live.determined} of them with every state determined; {ratio}",
            highlight=False,
        )


def _clock(clock: Clock) -> str:
    if not clock.valid:
        return f"no usable fit ({_number(clock.span, '.0f', ' s')} of data)"
    offset = f"offset {_number(clock.offset, '.3f')} ± {_number(clock.offset_sigma, '.3f', ' s')}"
    rate = "-" if clock.rate is None else f"{clock.rate * 1e6:.1f} ± {(clock.rate_sigma or 0.0) * 1e6:.1f} ppm"
    p50, p99, most = (_number(value, ".3f") for value in (clock.delay_p50, clock.delay_p99, clock.delay_max))
    late = "" if clock.delay_p50 is None else f"; arrival delay p50 {p50}, p99 {p99}, max {most} s"
    return f"{offset}, rate {rate}, fitted to {clock.reference or 'arrival'}{late}"


def _links(summary: Summary, console: Console) -> None:
    if summary.accounts:
        table = _table(
            "Links",
            "sender",
            "vehicle>",
            "received>",
            "lost>",
            "late>",
            "duplicate>",
            "redundant>",
            "restarts>",
            "loss>",
        )
        notes = []
        for a in summary.accounts:
            loss = "not counted" if a.loss is None else f"{100 * a.loss:.2f} %"
            counts = (a.vehicle, a.received, a.lost, a.late, a.duplicate, a.redundant, a.restarted)
            table.add_row(_plain(a.source), *map(str, counts), loss)
            who = f"  {a.source} of vehicle {a.vehicle}:"
            if a.ambiguous:
                notes.append(f"{who} {a.ambiguous} lost in holes too long for an 8-bit counter to tell their length")
            if a.conflict:
                notes.append(f"{who} {a.conflict} frames bore the number of another frame")
            if a.unknown:
                notes.append(f"{who} {a.unknown} frames of ids that the dialect does not know")
        console.print(table)
        for note in notes:
            console.print(note, highlight=False, markup=False)
    if summary.byte_accounts:
        table = _table(
            "Bytes", "link", "bytes>", "frames>", "unknown>", "corrupt>", "refused>", "discarded bytes>", "pending>"
        )
        for b in summary.byte_accounts:
            counts = (b.bytes, b.frames, b.unknown, b.corrupt, b.refused, b.discarded, b.pending)
            table.add_row(_plain(b.source), *map(str, counts))
        console.print(table)
    if summary.consumers:
        table = _table(
            "Consumers", "consumer", "listens to", "worst p99 age>", "max age>", "messages>", "missing>",
            "backfilled>", "refused>",
        )  # fmt: skip
        for c in summary.consumers:
            ages = ("-" if age is None else f"{age:.3f} s" for age in (c.age_p99, c.age_max))
            figures = map(str, (c.messages, c.missing, c.backfilled, c.refused))
            table.add_row(_plain(c.consumer), _plain(c.stage), *ages, *figures)
        console.print(table)
    if summary.age is not None:
        console.print(
            f"  age of live estimates when recorded: p50 {summary.age.p50:.3f}, p99 {summary.age.p99:.3f}, "
            f"max {summary.age.max:.3f} s",
            highlight=False,
        )


def _windows(summary: Summary, console: Console) -> None:
    scopes = ", ".join(sorted({w.scope for w in summary.windows}))
    known = {"window": "everything up to their closing", "sortie": "the whole boot epoch"}.get(scopes, scopes)
    several = len({w.vehicle for w in summary.windows}) > 1
    models = sorted({w.model for w in summary.windows}, key=first)
    for model in models:
        whose = f" of the {_plain(model.replace('_', ' '))}" if len(models) > 1 else ""
        height = "altitude>" if model == "trajectory" else "h, noise>"  # not what the altimeter is wrong by
        columns = "window", "test point", "from", "length>", "closed", "NIS/dof>", height, "horiz.>"
        table = _table(f"Windows{whose}, smoothed with {known}", *columns)
        for w in summary.windows:
            if w.model == model:
                table.add_row(
                    f"{f'v{w.vehicle} ' if several else ''}{w.boot}.{w.number}",
                    _plain(w.test_point) or "-",
                    utc(w.t0, date=False),
                    duration((w.t1 - w.t0) / 1e9),
                    w.reason,
                    f"{w.nis / w.dof:.2f}" if w.nis is not None and w.dof else "-",
                    _number(w.median_sigma_altitude, ".2f", " m"),
                    _number(w.median_sigma_horizontal, ".2f", " m"),
                )
        console.print(table)
    verdicts = Counter(verdict(w.nis, w.dof) for w in summary.windows)
    innovations = ", ".join(f"{count} {word}" for word, count in verdicts.most_common())
    console.print(
        "  altitude, horiz.: median standard deviations (h: without the altimeter's offset); NIS/dof is 1 if the model "
        "is right",
        highlight=False,
    )
    console.print(f"  innovations: {innovations}", highlight=False)
    late = sum(sum(w.late.values()) for w in summary.windows)
    if late:
        console.print(f"  {late} samples came too late for the estimate", highlight=False, style="yellow")


def _report(found: Worth, console: Console, *, whole: bool) -> None:
    colour = "bold red" if found.alarms else "yellow" if wrong(found) or found.findings else "green"
    console.print(
        f"[bold]{_plain(title(found))}[/bold]: [{colour}]{_plain(headline(found))}[/]\n  {_plain(about(found))}",
        highlight=False,
    )
    for text in found.alarms:
        console.print(f"  ! {_plain(text)}", style="bold red", highlight=False)
    if not whole:
        return
    _rows("Parameters", _PARAMETERS, [(p.name, *parameter_row(p)[1:]) for p in found.parameters], console)
    for text in doubts(found.parameters):
        console.print(f"  {_plain(text)}", style="dim", highlight=False)
    _rows("Channels", _CHANNELS, [(c.name, *channel_row(c)[1:]) for c in found.channels], console)
    for text in doubts(found.channels):
        console.print(f"  {_plain(text)}", style="dim", highlight=False)
    _rows("Median sigma", STATES, [(s.name, *state_row(s)[1:]) for s in states(found)], console)
    console.print(f"  without inertial data: {_plain(gaps(found))}\n  loss: {_plain(loss(found))}", highlight=False)
    for text in found.findings:
        console.print(f"  finding: {_plain(text)}", style="yellow", highlight=False)
    console.print(f"  inputs and configuration: {found.digest[:16]}\n", style="dim", highlight=False)


def _rows(head: str, columns: tuple[str, ...], rows: list[tuple[str, ...]], console: Console) -> None:
    """A table that fits a narrow terminal: names without their words."""
    if not rows:
        return
    words = {"parameter", "channel", "state", "verdict"}
    table = _table(head, *(name if name in words else f"{name}>" for name in columns))
    for row in rows:
        *cells, last = map(_plain, row)
        colour = _VERDICTS.get(last, "")
        table.add_row(*cells, f"[{colour}]{last}[/]" if colour else last)
    console.print(table)


def _events(review: Review, console: Console) -> None:
    counts = review.summary.events
    if not counts:
        return
    levels = sorted(counts, key=lambda level: _LEVELS.index(level) if level in _LEVELS else len(_LEVELS))
    console.print(
        "[bold]Events[/bold]: " + ", ".join(f"{counts[level]} {level.lower()}" for level in levels), highlight=False
    )
    for line in review.log[:LINES]:
        console.print(
            f"  {utc(line.t, date=False)} {line.level:8} {_plain(line.text)}",
            style=_COLOURS.get(line.level),
            highlight=False,
        )
    if len(review.log) > LINES:
        console.print(f"  ... and {len(review.log) - LINES} more in the recording", style="dim")
