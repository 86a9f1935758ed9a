"""The walls of the house: imports run one way."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
ROOMS = {"telemetry", "estimator", "viewer", "sims"}
ALLOWED = {"telemetry": set(), "estimator": set(), "viewer": {"telemetry.messages"}, "sims": {"telemetry", "estimator"}}
FILES = sorted(path for room in ROOMS for path in (ROOT / room).rglob("*.py"))


def imports(path: Path) -> list[str]:
    names = []
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            names.append(node.module)
    return [name for name in names if name.split(".")[0] in ROOMS]


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(ROOT)))
def test_a_room_imports_only_what_it_may(path):
    room = path.relative_to(ROOT).parts[0]
    allowed = ALLOWED[room] | ({"telemetry.messages"} if path.parent == ROOT / "estimator" / "stage" else set())
    for name in imports(path):
        assert name.split(".")[0] == room or name in allowed or name.split(".")[0] in allowed, f"{path}: imports {name}"
