"""What stands in examples/ runs, as it would for a reader."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
LOGS = ROOT.parent / "shared" / "data"


def run(*arguments: str | Path) -> str:
    done = subprocess.run(
        [sys.executable, *arguments], cwd=ROOT, capture_output=True, text=True, timeout=240, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_a_simulated_flight_is_reconstructed():
    told = run("examples/reconstruct.py")
    assert "ba_x" in told
    assert "consistent" in told
    assert "ALARM" not in told


def test_a_log_is_reconstructed():
    log = LOGS / "plane_swiss_137hz.tlog"
    if not log.exists():
        pytest.skip(f"no flight log at {log}")
    told = run("examples/reconstruct.py", log)
    assert "found gnss: velocity is 0.2" in told
