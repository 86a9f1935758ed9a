"""What a DataFlash log says in words: texts, parameters, units, and the autopilot's own remarks."""

from __future__ import annotations

from telemetry.dataflash_sensors import Rows
from telemetry.sources.onboard import Level, Note, readable

# What EV says; the numbers are ArduPilot's.
EVENTS = {10: "armed", 11: "disarmed", 15: "armed automatically", 17: "perhaps landed", 18: "landed", 28: "not landed"}


def words(part: Rows, column: str) -> list[str]:
    """A column of text; nothing if there is none."""
    if column not in part.table or part.table.values[column].dtype.kind != "S":
        return []
    return [raw.split(b"\0", 1)[0].decode("utf-8", "replace") for raw in part.table.values[column].tolist()]


def parameters(part: Rows) -> dict[str, float]:
    """Parameters and their values, from PARM."""
    value = part.column("Value")
    return {} if value is None else dict(zip(words(part, "Name"), value.tolist(), strict=False))


def units(part: Rows) -> dict[str, str]:
    """Units by their letters, from UNIT."""
    number = part.column("Id")
    return (
        {}
        if number is None
        else {chr(int(i)): unit for i, unit in zip(number, words(part, "Label"), strict=False) if 0 < i < 128}
    )


def declared(part: Rows) -> dict[int, str]:
    """Letters of the units of the columns, by type of message, from FMTU."""
    number = part.column("FmtType")
    return (
        {}
        if number is None
        else {int(i): u for i, u in zip(number, words(part, "UnitIds"), strict=False) if 0 <= i < 256}
    )


def remarks(name: str, part: Rows) -> list[Note]:
    """Changes of mode, events and errors of the autopilot, in words."""
    notes = []
    modes = words(part, "Mode")
    numbers = {c: v.tolist() for c in ("Mode", "ModeNum", "Id", "Subsys", "ECode") if (v := part.column(c)) is not None}
    for k, (t, t_rx) in enumerate(zip(part.t.tolist(), part.t_rx.tolist(), strict=True)):
        level: Level = "info"
        value = {c: v[k] for c, v in numbers.items()}
        if name == "MODE":
            mode = modes[k] if modes else f"{value.get('ModeNum', value.get('Mode', -1)):g}"
            line = f"autopilot: mode {readable(mode)}"
        elif name == "EV":
            number = value.get("Id", -1)
            line = f"autopilot: event {number:g}" + (f", {EVENTS[int(number)]}" if number in EVENTS else "")
        else:
            code = value.get("ECode", -1)
            level = "warning" if code else "info"  # 0: it is over
            line = f"autopilot: error {code:g} of subsystem {value.get('Subsys', -1):g}"
        notes.append(Note(t, t_rx, level, line))
    return notes
