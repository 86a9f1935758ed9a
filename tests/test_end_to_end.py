"""A sortie over real sockets, sessions and processes: what was live is what a replay gives."""

from __future__ import annotations

import json
import math
import shutil
import signal
import subprocess
import threading
import time
from types import SimpleNamespace

import pytest

import sims
from tests.console import RERUN, Process, free_port, run
from tests.telemetry.wire import DATA

SPEED = 20.0


@pytest.fixture(scope="module")
def flight():
    """The demo's flight up to the end of the first test point."""
    return sims.fly("c172x", "demo", duration=80)


def send(flight, port: int, faults: str | None = None, until: float = math.inf):
    frames = ((t, frame) for t, frame in sims.frames(flight) if t < until * 1e9)
    return sims.send(frames, f"udpout:127.0.0.1:{port}", speed=SPEED, faults=faults)


def review(folder) -> dict:
    return json.loads(run("review", folder, "--json").stdout)


@pytest.fixture(scope="module")
def flown(flight, tmp_path_factory):
    """A sortie over a bad radio, from the first frame until nothing more comes."""
    port, folder = free_port(), tmp_path_factory.mktemp("flown") / "s"
    with Process("live", f"udpin:127.0.0.1:{port}", "--folder", folder, "--idle", 1.5) as live:
        live.wait_for("listening")
        sent = send(flight, port, "loss=0.01,corrupt=0.002,outage=75:4")
        assert live.end() == 0, live.said
    return SimpleNamespace(folder=folder, sent=sent)


@pytest.fixture(scope="module")
def interrupted(flight, tmp_path_factory):
    """A sortie that ends with Ctrl-C soon after a test point, and what was said until then."""
    port, folder = free_port(), tmp_path_factory.mktemp("interrupted") / "s"
    with Process("live", f"udpin:127.0.0.1:{port}", "--folder", folder) as live:
        live.wait_for("listening")
        send(flight, port)
        live.wait_for("test point 1", timeout=2)
        before = live.said
        time.sleep(0.3)
        live.process.send_signal(signal.SIGINT)
        assert live.end() == 0, live.said
    return SimpleNamespace(folder=folder, before=before, said=live.said)


def test_live_equals_replay_and_nothing_is_lost(flown):
    verified = run("verify", flown.folder)
    assert verified.returncode == 0, verified.stdout + verified.stderr
    assert "live equals replay, bit for bit" in verified.stdout
    for name in ("live.rrd", "windows.rrd"):
        assert subprocess.run([RERUN, "rrd", "verify", flown.folder / name], check=False).returncode == 0
    found = review(flown.folder)
    (account,) = found["summary"]["accounts"]
    (octets,) = found["summary"]["byte_accounts"]
    injected = flown.sent.injected
    # A frame whose id was hit looks like one of a dialect that we do not know: it has a number, but no checksum.
    refused = injected.corrupted - octets["unknown"]
    assert account["received"] == octets["frames"] == flown.sent.datagrams - refused
    assert 0 < octets["corrupt"] <= refused, "one hit in its first byte does not even begin like a frame"
    off = account["lost"] - (injected.lost + injected.outage + refused)
    turns = round(off / 256)  # at 20 times real time the outage is a blink, and a busy machine loses count of turns
    assert abs(off - 256 * turns) <= 3
    assert turns == 0 or account["ambiguous"] >= abs(off)
    windows = found["summary"]["windows"]
    assert "1" in [w["test_point"] for w in windows]
    assert any(w["reason"] == "gap" for w in windows)


def test_a_test_point_is_smoothed_while_the_flight_goes_on(interrupted):
    assert "test point 1" in interrupted.before
    assert "closing" not in interrupted.before


def test_interrupted_it_closes_the_window_the_recording_and_the_log(interrupted):
    assert "closing: the window, the recording and the raw log" in interrupted.said
    found = review(interrupted.folder)
    assert found["closed"]
    assert found["summary"]["completeness"] == "complete"
    assert found["summary"]["windows"][-1]["reason"] == "end"
    assert run("verify", interrupted.folder).returncode == 0


def test_three_processes_give_the_same_estimates_as_one(flight, tmp_path):
    port, bus = free_port(), f"tcp/127.0.0.1:{free_port()}"
    name = ("--sortie", "three")
    with (
        Process("record", tmp_path / "s", *name, "--connect", bus) as record,
        Process("estimate", *name, "--connect", bus) as estimate,
        Process(
            "ingest", f"udpin:127.0.0.1:{port}", *name, "--folder", tmp_path / "s", "--listen", bus, "--idle", 1.5
        ) as ingest,
    ):
        ingest.wait_for("listening")
        record.wait_for("recording")
        estimate.wait_for("estimating")
        send(flight, port, "loss=0.01")
        assert ingest.end() == 0, ingest.said
        assert estimate.end() == 0, estimate.said
        assert record.end() == 0, record.said
    verified = run("verify", tmp_path / "s")
    assert verified.returncode == 0, verified.stdout + verified.stderr


def test_a_real_log_replayed_over_udp_is_archived_byte_for_byte(tmp_path):
    log = DATA / "plane_swiss_137hz.tlog"
    if not log.exists():
        pytest.skip(f"{log} is not here")
    port = free_port()
    with Process("live", f"udpin:127.0.0.1:{port}", "--folder", tmp_path / "s", "--idle", 1.5) as live:
        live.wait_for("listening")
        assert run("replay", log, "--to", f"udpout:127.0.0.1:{port}", "--speed", 20).returncode == 0
        assert live.end() == 0, live.said
    assert (tmp_path / "s" / "raw.tlog").stat().st_size == log.stat().st_size
    assert run("verify", tmp_path / "s").returncode == 0


def test_interrupted_while_telemetry_goes_on(flight, tmp_path):
    port = free_port()
    with Process("live", f"udpin:127.0.0.1:{port}", "--folder", tmp_path / "s") as live:
        live.wait_for("listening")
        sender = threading.Thread(target=send, args=(flight, port, None, 54.0))
        sender.start()
        time.sleep(1.2)
        live.process.send_signal(signal.SIGINT)
        begin = time.monotonic()
        assert live.end() == 0, live.said
        assert time.monotonic() - begin < 10
        sender.join()
    assert run("verify", tmp_path / "s").returncode == 0


def test_a_recording_that_fails_does_not_take_the_evidence_with_it(flight, tmp_path):
    """The recorder cannot begin, because something took its place after the sortie had its folder."""
    port = free_port()
    with Process("live", f"udpin:127.0.0.1:{port}", "--folder", tmp_path / "s", "--idle", 1.5) as live:
        (tmp_path / "s").mkdir(exist_ok=True)
        while not (tmp_path / "s" / "raw.tlog").exists():
            time.sleep(0.001)
        (tmp_path / "s" / "live.rrd").write_text("in the way")
        live.wait_for("ALARM")
        sent = send(flight, port, until=24.0)
        assert live.end() == 1
    assert "live.rrd exists and a recording is never overwritten" in live.said
    assert (tmp_path / "s" / "raw.tlog").stat().st_size == sent.octets + 8 * sent.datagrams


def test_a_flight_is_followed_to_its_end_where_nobody_listens_to_what_is_said_of_it(flight, tmp_path):
    port, folder = free_port(), tmp_path / "s"
    with Process("live", f"udpin:127.0.0.1:{port}", "--folder", folder, "--idle", 1.5) as live:
        live.wait_for("listening")
        assert live.process.stdout is not None
        live.process.stdout.close()
        send(flight, port, until=20)
        assert live.process.wait(60) == 0
    assert review(folder)["summary"]["completeness"] == "complete"


def test_nothing_received_is_said(tmp_path):
    with Process("live", f"udpin:127.0.0.1:{free_port()}", "--folder", tmp_path / "s") as live:
        live.wait_for("listening")
        live.process.send_signal(signal.SIGINT)
        assert live.end() == 1
    assert "nothing was received" in live.said
    assert review(tmp_path / "s")["summary"]["completeness"] == "no data"


def test_verify_finds_a_recording_that_is_not_of_its_log(flown, tmp_path):
    shutil.copytree(flown.folder, tmp_path / "s")
    raw = tmp_path / "s" / "raw.tlog"
    raw.write_bytes(raw.read_bytes()[:-20_000])
    done = run("verify", tmp_path / "s")
    assert done.returncode == 1
    assert "differ in" in done.stderr
