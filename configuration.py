"""What a user sets and what ran: settings from a TOML file, and the sortie.toml that a sortie folder keeps.

Nothing heavy is imported before it is needed.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

from telling import Failure

DISTRIBUTION = "sortie-telemetry"
Estimator = Literal["ms", "cubature"]  # those of the stage, which is not loaded to say so


def configure(path: Path | None, dialect: str | None = None, estimator: str | None = None) -> Any:
    """Settings of the stages, from a TOML file with the tables [ingest] and [estimate]; `dialect` and `estimator`
    replace its own.

    A ``grade`` in [estimate.flight_path] stands for all settings of that grade of sensors; what is given beside it
    replaces one of them.
    """
    import msgspec

    from estimator.stage.settings import Settings as Estimate
    from telemetry.ingest import Settings as Ingest
    from telemetry.mavlink import Dialect
    from telemetry.sensors import check
    from telemetry.text import check_mark

    kind = msgspec.defstruct(
        "Configuration",
        [("ingest", Ingest, Ingest()), ("estimate", Estimate, Estimate())],
        forbid_unknown_fields=True,
        frozen=True,
    )
    try:
        told = msgspec.toml.decode(path.read_bytes()) if path else {}
        flight = told.get("estimate", {}).get("flight_path", {})
        if "grade" in flight:
            told["estimate"]["flight_path"] = _graded(flight)
        _check_estimator(told.get("estimate", {}).get("estimator", "ms"))
        configuration = estimating(_speaking(msgspec.convert(told, type=kind), dialect), estimator)
        check_mark(configuration.ingest.mark)
        check(configuration.ingest.sensors, Dialect(configuration.ingest.dialect))
    except ValueError as error:  # msgspec's own are among them
        raise Failure(f"{path}: {error}" if path else str(error)) from None
    return configuration


def _speaking(configuration: Any, dialect: str | None) -> Any:
    """The settings, with another dialect."""
    import msgspec

    if dialect is None:
        return configuration
    ingest = msgspec.structs.replace(configuration.ingest, dialect=dialect)
    return msgspec.structs.replace(configuration, ingest=ingest)


def estimating(configuration: Any, estimator: str | None) -> Any:
    """The settings, with another estimator.

    Raises
    ------
    ValueError
        There is none of that name.
    """
    import msgspec

    if estimator is None:
        return configuration
    _check_estimator(estimator)
    return msgspec.structs.replace(
        configuration, estimate=msgspec.structs.replace(configuration.estimate, estimator=estimator)
    )


def _check_estimator(name: object) -> None:
    if name not in get_args(Estimator):
        raise ValueError(f"estimator {name!r} of [estimate]: it is one of {', '.join(get_args(Estimator))}")


def configure_log(log: Path, path: Path | None, dialect: str | None, estimator: str | None) -> Any:
    """Settings for a log or a sortie folder; None where those that ran there stand, or the usual ones.

    An estimator alone replaces that of what ran, and nothing else.
    """
    if path or dialect:
        return configure(path, dialect, estimator)
    if estimator is None:
        return None
    return estimating(read_what_ran(log).configuration if log.is_dir() else configure(None), estimator)


def _graded(given: dict[str, Any]) -> dict[str, Any]:
    """Settings of the flight path, with the grade they begin from filled in."""
    import msgspec

    from estimator.models.flight_path import GRADES

    grade = given["grade"]
    if grade not in GRADES:
        raise ValueError(f"grade {grade!r} of [estimate.flight_path]: it is one of {', '.join(GRADES)}")
    whole: dict[str, Any] = _told(msgspec.to_builtins(GRADES[grade]()))
    return whole | {key: value for key, value in given.items() if key != "grade"}


def write_what_runs(
    folder: Path, name: str, endpoints: Sequence[str], forward: Sequence[str], configuration: Any, dialect: Any
) -> None:
    """Leave sortie.toml in a sortie folder."""
    import msgspec

    what = {
        "sortie": name,
        "endpoints": list(endpoints),
        "forward": list(forward),
        "started": datetime.now(UTC).isoformat(timespec="seconds"),
        "versions": {
            package: version(package) for package in (DISTRIBUTION, "pymavlink", "eclipse-zenoh", "rerun-sdk")
        },
        "dialect": {"name": dialect.name, "sha256": dialect.digest},
        "settings": msgspec.to_builtins(configuration),
    }
    path, beside = folder / "sortie.toml", folder / "sortie.toml.new"
    with beside.open("wb") as file:  # without it the raw log does not tell how many links it has
        file.write(msgspec.toml.encode(_told(what)))
        file.flush()
        os.fsync(file.fileno())
    beside.replace(path)


def _told(value: Any) -> Any:
    """Without what is None: TOML has no word for it, and read back it is the default."""
    if isinstance(value, dict):
        return {key: _told(item) for key, item in value.items() if item is not None}
    return value


class Ran(NamedTuple):
    """What ran in a sortie folder."""

    sortie: str
    endpoints: list[str]
    forward: list[str]
    configuration: Any

    @property
    def links(self) -> int:
        """How many links its raw log tells apart."""
        return len(self.endpoints) + len(self.forward)


def read_what_ran(folder: Path) -> Ran:
    """Read the sortie.toml of a sortie folder."""
    import msgspec

    path = folder / "sortie.toml"
    if not path.is_file():
        raise Failure(f"{folder} is no sortie folder: it has no sortie.toml")
    kind = type(configure(None))
    told = msgspec.defstruct(
        "Told", [("sortie", str), ("endpoints", list[str]), ("settings", kind), ("forward", list[str], [])]
    )
    try:
        ran: Any = msgspec.toml.decode(path.read_bytes(), type=told)
    except ValueError as error:
        evidence = f"the evidence is whole all the same: sortie smooth {folder / 'raw.tlog'}"
        raise Failure(f"{path} is damaged: {error}; {evidence}") from None
    return Ran(ran.sortie, ran.endpoints, ran.forward, ran.settings)
