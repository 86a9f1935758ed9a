"""What a user sets and what ran: settings from a TOML file, and the sortie.toml that a sortie folder keeps.

Nothing heavy is imported before it is needed.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

DISTRIBUTION = "sortie-telemetry"


class Failure(Exception):
    """The work failed, for a reason that one line can tell."""


def say(text: str) -> None:
    """Tell the user something that is not the result."""
    print(text, file=sys.stderr, flush=True)


def configure(path: Path | None) -> Any:
    """Settings of the stages, from a TOML file with the tables [ingest] and [estimate].

    A ``grade`` in [estimate.flight_path] stands for all settings of that grade of sensors; what is given beside it
    replaces one of them.
    """
    import msgspec

    import estimator.stage
    import telemetry.ingest
    from telemetry.text import check_mark

    kind = msgspec.defstruct(
        "Configuration",
        [
            ("ingest", telemetry.ingest.Settings, telemetry.ingest.Settings()),
            ("estimate", estimator.stage.Settings, estimator.stage.Settings()),
        ],
        forbid_unknown_fields=True,
        frozen=True,
    )
    if path is None:
        return kind()
    try:
        told = msgspec.toml.decode(path.read_bytes())
        flight = told.get("estimate", {}).get("flight_path", {})
        if "grade" in flight:
            told["estimate"]["flight_path"] = _graded(flight)
        configuration: Any = msgspec.convert(told, type=kind)
        check_mark(configuration.ingest.mark)
    except ValueError as error:  # msgspec's own are among them
        raise Failure(f"{path}: {error}") from None
    return configuration


def _graded(given: dict[str, Any]) -> dict[str, Any]:
    """Settings of the flight path, with the grade they begin from filled in."""
    import msgspec

    from estimator.models.flight_path import GRADES

    grade = given["grade"]
    if grade not in GRADES:
        raise ValueError(f"grade {grade!r} of [estimate.flight_path]: it is one of {', '.join(GRADES)}")
    whole: dict[str, Any] = _told(msgspec.to_builtins(GRADES[grade]()))
    return whole | {key: value for key, value in given.items() if key != "grade"}


def write_what_runs(folder: Path, name: str, endpoints: Sequence[str], configuration: Any, dialect: Any) -> None:
    """Leave sortie.toml in a sortie folder."""
    import msgspec

    what = {
        "sortie": name,
        "endpoints": list(endpoints),
        "started": datetime.now(UTC).isoformat(timespec="seconds"),
        "versions": {
            package: version(package) for package in (DISTRIBUTION, "pymavlink", "eclipse-zenoh", "rerun-sdk")
        },
        "dialect": {"name": dialect.name, "sha256": dialect.digest},
        "settings": msgspec.to_builtins(configuration),
    }
    (folder / "sortie.toml").write_bytes(msgspec.toml.encode(_told(what)))


def _told(value: Any) -> Any:
    """Without what is None: TOML has no word for it, and read back it is the default."""
    if isinstance(value, dict):
        return {key: _told(item) for key, item in value.items() if item is not None}
    return value


def read_what_ran(folder: Path) -> tuple[str, int, Any]:
    """Name, number of links and settings of a sortie folder."""
    import msgspec

    path = folder / "sortie.toml"
    if not path.is_file():
        raise Failure(f"{folder} is no sortie folder: it has no sortie.toml")
    ran = msgspec.toml.decode(path.read_bytes())
    return ran["sortie"], len(ran["endpoints"]), msgspec.convert(ran["settings"], type(configure(None)))


def counted(number: int, what: str) -> str:
    """A number of things, in words."""
    return f"{number} {what}{'' if number == 1 else 's'}"
