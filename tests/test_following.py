"""A flight is followed in one process and in three, and a stage that fails takes nothing else along."""

from __future__ import annotations

import gc
import json
import signal
import sys
import threading
from itertools import islice

import pytest

import estimator.stage
import sims
from apart import follow_apart
from configuration import configure
from live import Reception, follow
from telemetry.messages import Estimate, Window
from tests.console import free_port, run

SPEED = 20.0


@pytest.fixture(scope="module")
def flight():
    return sims.fly("c172x", "demo", duration=40)


@pytest.fixture(autouse=True)
def handlers():
    """Following a flight takes over the keyboard's interruption, and makes the interpreter prompt."""
    interval = sys.getswitchinterval()
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)
    sys.setswitchinterval(interval)
    gc.unfreeze()


def receive(folder):
    folder.mkdir()
    port = free_port()
    return Reception(folder, folder.name, [f"udpin:127.0.0.1:{port}"], configure(None)), port


def sender(flight, port):
    return threading.Thread(target=lambda: sims.send(sims.frames(flight), f"udpout:127.0.0.1:{port}", speed=SPEED))


def test_three_processes_started_by_one_leave_a_whole_sortie(flight, tmp_path):
    reception, port = receive(tmp_path / "s")
    thread, said, kept = sender(flight, port), [], []
    follow_apart(reception, "s", tmp_path / "s", 1.5, lambda bus: thread.start(), said.append, kept.append)
    thread.join()
    assert json.loads((tmp_path / "s" / "report.json").read_text())["completeness"] == "complete"
    assert run("verify", tmp_path / "s").returncode == 0
    assert sum(isinstance(message, Estimate) for message in kept) > 100
    windows = [message for message in kept if isinstance(message, Window)]
    assert len([line for line in said if "closed by" in line]) == len(windows) > 0


def test_an_estimator_that_fails_takes_neither_the_recording_nor_the_evidence_along(flight, tmp_path, monkeypatch):
    whole = estimator.stage.estimate

    def failing(messages, **settings):
        yield from islice(whole(messages, **settings), 200)
        raise ArithmeticError("the matrix is not what it was")

    reception, port = receive(tmp_path / "s")
    monkeypatch.setattr(estimator.stage, "estimate", failing)
    thread, said = sender(flight, port), []
    with pytest.raises(ArithmeticError, match="not what it was"):
        follow(reception, "s", tmp_path / "s", 1.5, thread.start, said.append)
    thread.join()
    assert any("stage estimate failed: the matrix is not what it was" in line for line in said)
    told = json.loads((tmp_path / "s" / "report.json").read_text())
    assert told["completeness"].startswith("broken off")
    (account,) = told["accounts"]
    assert account["received"] == len(list(sims.frames(flight))) and account["lost"] == 0


def test_a_recorder_that_fails_leaves_the_evidence_to_go_on_until_silence(flight, tmp_path, monkeypatch):
    import viewer.recorder

    def failing(messages, *_, **__):
        for message in messages:
            if isinstance(message, Window):
                raise OSError(28, "No space left on device")

    monkeypatch.setattr(viewer.recorder, "record", failing)
    reception, port = receive(tmp_path / "s")
    thread, said = sender(flight, port), []
    with pytest.raises(OSError, match="No space left"):
        follow(reception, "s", tmp_path / "s", 1.5, thread.start, said.append)
    thread.join()
    assert any("only the raw log goes on" in line for line in said)
    source = sims.frames(flight)
    held = (tmp_path / "s" / "raw.tlog").read_bytes()
    assert all(frame in held for _, frame in source)
