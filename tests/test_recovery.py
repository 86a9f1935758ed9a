"""Any of the three processes may die at any moment: the evidence stays whole, and the result is what offline gives.

``SORTIE_KILLS`` is how often a process is killed (3: each of them once), over a flight of ``SORTIE_FLIGHT`` seconds.
"""

from __future__ import annotations

import json
import os
import random
import signal
import threading
import time

import pytest

import sims
from telemetry.mavlink import Dialect
from telemetry.sources.tlog import TlogSource
from tests.console import Process, free_port, run

KILLS = int(os.environ.get("SORTIE_KILLS", "3"))
DURATION = float(os.environ.get("SORTIE_FLIGHT", "30"))
SPEED = 3.0 if KILLS <= 3 else 1.0
SEED = int(os.environ.get("SORTIE_SEED", "1"))


@pytest.mark.timeout(900)
def test_the_estimate_after_any_kill_equals_offline_processing_of_the_raw_log(tmp_path):
    flight = sims.fly("c172x", "demo", duration=DURATION)
    folder, port, bus = tmp_path / "s", free_port(), f"tcp/127.0.0.1:{free_port()}"
    name = ("--sortie", "kills")
    commands = {
        "ingest": ("ingest", f"udpin:127.0.0.1:{port}", *name, "--folder", folder, "--listen", bus),
        "estimate": ("estimate", *name, "--connect", bus),
        "record": ("record", folder, *name, "--connect", bus),
    }
    ready = {"ingest": "listening", "estimate": "estimating", "record": "recording"}
    draw = random.Random(SEED)
    order = list(commands) if KILLS == 3 else [draw.choice(list(commands)) for _ in range(KILLS)]
    draw.shuffle(order)
    running = {which: Process(*command) for which, command in commands.items()}
    killed = []
    try:
        for which, process in running.items():
            process.wait_for(ready[which])
        sent = []

        def fly():
            sent.append(sims.send(sims.frames(flight), f"udpout:127.0.0.1:{port}", speed=SPEED))

        sender = threading.Thread(target=fly)
        sender.start()
        begin, length = time.monotonic(), DURATION / SPEED
        for i, which in enumerate(order):
            due = begin + length * (0.1 + 0.75 * (i + draw.random()) / len(order))
            time.sleep(max(0.0, due - time.monotonic()))
            running[which].process.send_signal(signal.SIGKILL)
            running[which].process.wait()
            killed.append(running[which])
            size = (folder / "raw.tlog").stat().st_size
            again = () if which == "estimate" else ("--resume",)
            running[which] = Process(*commands[which], *again)
            running[which].wait_for(ready[which])
            assert (folder / "raw.tlog").stat().st_size >= size, "evidence is never cut"
        sender.join()
        running["ingest"].process.send_signal(signal.SIGINT)
        for which in ("ingest", "estimate", "record"):
            assert running[which].end(300) == 0, f"{which}: {running[which].said}"
    finally:
        for process in [*running.values(), *killed]:
            process.__exit__()
    verified = run("verify", folder)
    assert verified.returncode == 0, verified.stdout + verified.stderr
    assert "live equals replay, bit for bit" in verified.stdout
    source = TlogSource(folder, Dialect(), trusted=True)
    frames = sum(len(batch) for batch in source.batches())
    assert source.truncated == 0 and frames > 0
    summary = json.loads(run("review", folder, "--json").stdout)["summary"]
    assert summary["completeness"] == "complete"
    lost = sent[0].datagrams - frames
    deaf = order.count("ingest")
    assert lost >= 0 and (deaf or lost == 0), "only a dead ingest loses what is sent meanwhile"
