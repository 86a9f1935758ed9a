"""Recordings looked at from outside, and recordings as a process that is killed leaves them."""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from telemetry.messages import Message
from tests.viewer import flight as f
from viewer.reading import Reading
from viewer.recorder import Recorder


def rerun(*arguments: object) -> subprocess.CompletedProcess[str]:
    """What the SDK's own command line says."""
    command = [sys.executable, "-m", "rerun", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def everything(path: Path) -> dict[tuple[str, str], list[Any]]:
    """All numbers of a recording, by entity and component."""
    found: dict[tuple[str, str], list[Any]] = {}
    with Reading(path) as reading:
        for entity in sorted(reading.chunks):
            if entity.startswith("/__") or entity.endswith(("/boot", "/window", "/report")):
                continue
            for component in (
                "Scalars:scalars",
                "Measurements:values",
                "Measurements:variances",
                "TextLog:text",
                "LineStrips3D:strips",
                "Points3D:positions",
                "GeoLineStrings:line_strings",
                "GeoPoints:positions",
            ):
                t, (rows,) = reading.columns(entity, (component,), ("t_vehicle", "t_rx"))
                if len(t[0]):
                    found[entity, component] = [*(x.tolist() for x in t), repr(rows.tolist())]
    return found


def grown(messages: Iterable[Message], path: Path, finished: Path, **more: Any) -> Path:
    """Write what a recorder has on the disk just before it is closed; then it is closed, as `finished`."""
    recorder = Recorder(finished, sortie="grown", **more)
    for message in messages:
        recorder.write(message)
    recorder.write(f.progress(f.ns(f.END + 10.0).item()))  # long after the last row: nothing waits any more
    recorder.flush()
    shutil.copy(finished, path)
    recorder.close()
    return path
