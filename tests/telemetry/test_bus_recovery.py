"""Processes are killed at any moment, links break, consumers stall: what is recorded in the end is whole.

This file is also the program of those processes: ``python -m tests.telemetry.test_bus_recovery PART ENDPOINT FOLDER``.
"""

from __future__ import annotations

import hashlib
import os
import random
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from telemetry.bus import Bus, publish, serve
from telemetry.messages import Altitude, Event, Message, Progress
from tests.console import free_port

ROOT = Path(__file__).parents[2]
RATE = 400.0  # messages a second
PATIENT = 60.0


def received(folder: Path, count: int | None = None):
    """What the first stage tells: what has been received since the beginning at once, then what is being received.

    Like a raw log, it is the same whenever it is read. It holds what was received until the file `end` was made.
    """
    begin, end = (folder / "begin").stat().st_mtime, folder / "end"
    i = 0
    while True:
        if count is None:
            if end.exists() and i >= (end.stat().st_mtime - begin) * RATE:
                break
            if time.time() < begin + i / RATE:
                time.sleep(0.001)
                continue
        elif i >= count:
            break
        t = np.array([i * 1_000_000])
        yield Altitude(
            vehicle=1, source="0/1", boot=0, t=t, t_rx=t, altitude=t * 0.5, pressure=t * 1.0, sigma=np.ones(1)
        )
        i += 1
    t = np.array([i * 1_000_000])
    yield Progress(vehicle=0, source="ingest", boot=0, t=t, t_rx=t, final=True)


def chained(messages):
    """A stage whose every word depends on all that it heard before."""
    state = hashlib.sha256()
    for message in messages:
        if isinstance(message, Altitude):
            state.update(message.altitude.tobytes())
            number = np.array([int.from_bytes(state.digest()[:6], "little") * 1.0])
            yield Altitude(
                vehicle=1, source="estimate", boot=0, t=message.t, t_rx=message.t_rx,
                altitude=number, pressure=message.pressure, sigma=message.sigma,
            )  # fmt: skip
        elif isinstance(message, Progress):
            yield Progress(vehicle=0, source="estimate", boot=0, t=message.t, t_rx=message.t_rx, final=message.final)


def line(message: Message) -> str:
    said = message.altitude[0] if isinstance(message, Altitude) else "final"
    return f"{'estimate' if message.source == 'estimate' else 'ingest'} {message.sequence} {said!r}"


def record(bus: Bus, path: Path) -> None:
    """Begin a new file with every life; only a last life leaves a whole one."""
    subscription = bus.subscribe("record", ["ingest", "estimate"])
    for life in subscription.lives():
        with path.open("w") as file:
            for message in life:
                if message is None:
                    file.flush()
                elif isinstance(message, Event):
                    print(message.text[0], file=sys.stderr)  # shown where a test fails
                else:
                    print(line(message), file=file)
    subscription.close()
    path.with_suffix(".whole").write_text(f"{subscription.missing} {subscription.refused}")


def main(part: str, endpoint: str, folder: Path) -> None:
    if part == "router":
        from telemetry.bus.router import serve_router

        serve_router([endpoint])
    with Bus("s", connect=[endpoint], block=1.0) as bus:
        if part == "ingest":
            publish(bus, "ingest", received(folder))
        elif part == "estimate":
            serve(bus, "estimate", ["ingest"], chained)
        else:
            record(bus, folder / "recorded")


class Processes:
    """The parts of a sortie, each in a process."""

    def __init__(self, endpoint: str, folder: Path) -> None:
        self.endpoint, self.folder = endpoint, folder
        self.running: dict[str, subprocess.Popen] = {}
        (folder / "begin").touch()

    def start(self, *parts: str) -> None:
        for part in parts:
            command = [sys.executable, "-m", "tests.telemetry.test_bus_recovery", part, self.endpoint, str(self.folder)]
            self.running[part] = subprocess.Popen(command, cwd=ROOT)

    def kill(self, part: str) -> None:
        self.running[part].kill()
        self.running[part].wait()

    def recorded(self) -> int:
        """How far the recording of the last life is: messages of the relay."""
        path = self.folder / "recorded"
        return path.read_text().count("estimate ") if path.exists() else 0

    def end(self, *parts: str) -> list[str]:
        """Let the first stage end; the answer is what was recorded."""
        (self.folder / "end").touch()
        for part in parts:
            assert self.running[part].wait(PATIENT) == 0, part
        assert (self.folder / "recorded.whole").read_text() == "0 0"
        return (self.folder / "recorded").read_text().splitlines()

    def __enter__(self) -> Processes:
        return self

    def __exit__(self, *_: object) -> None:
        for process in self.running.values():
            process.kill()
            process.wait()


def told(lines: list[str], stage: str) -> list[str]:
    return [one for one in lines if one.startswith(f"{stage} ")]


def expected(folder: Path, count: int) -> tuple[list[str], list[str]]:
    """The same, offline."""
    first = list(received(folder, count))
    second = list(chained(first))
    numbered = [
        [line(message).replace(" -1 ", f" {i} ", 1) for i, message in enumerate(messages)]
        for messages in (first, second)
    ]
    return numbered[0], numbered[1]


def check(lines: list[str], folder: Path) -> None:
    ingest, estimate = expected(folder, len(told(lines, "ingest")) - 1)
    assert told(lines, "ingest") == ingest
    assert told(lines, "estimate") == estimate
    assert len(ingest) > 400, "too short to show anything"


def wait_for(condition, seconds: float = PATIENT) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)


@pytest.mark.parametrize("seed", range(int(os.environ.get("SORTIE_KILLS", "1"))))
def test_killed_at_any_moment_the_recording_is_that_of_one_whole_run(seed, tmp_path):
    draw = random.Random(seed)
    with Processes(f"tcp/127.0.0.1:{free_port()}", tmp_path) as processes:
        processes.start("router", "ingest", "estimate", "record")
        wait_for(lambda: processes.recorded() > 20)
        victims = ["ingest", "estimate", "record", draw.choice(["ingest", "estimate", "record"])]
        draw.shuffle(victims)
        for victim in victims:
            time.sleep(draw.uniform(0.0, 1.0))  # at any moment
            processes.kill(victim)
            if draw.random() < 0.5:
                time.sleep(draw.uniform(0.0, 0.5))
            processes.start(victim)
        # What is recorded then was heard after the last restart: all are there again.
        again = (time.time() - (tmp_path / "begin").stat().st_mtime) * RATE
        wait_for(lambda: processes.recorded() > again)
        lines = processes.end("record", "estimate", "ingest")
    check(lines, tmp_path)


def test_a_router_that_is_killed_and_comes_back_costs_nothing(tmp_path):
    with Processes(f"tcp/127.0.0.1:{free_port()}", tmp_path) as processes:
        processes.start("router", "ingest", "estimate", "record")
        wait_for(lambda: processes.recorded() > 100)
        processes.kill("router")
        time.sleep(0.7)
        processes.start("router")
        before = processes.recorded()
        wait_for(lambda: processes.recorded() > before + 200)
        wait_for(lambda: processes.recorded() > 400)
        lines = processes.end("record", "estimate", "ingest")
    check(lines, tmp_path)


def test_a_consumer_that_stalls_loses_its_link_and_nothing_else():
    """The publisher goes on after `block` seconds; the consumer, whose link is dropped, opens it again by itself."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    code = (
        "import sys\n"
        "from telemetry.bus import Bus\n"
        "from telemetry.messages import Event\n"
        f"with Bus('s', connect=[{endpoint!r}]) as bus:\n"
        "    subscription = bus.subscribe('record', ['ingest'])\n"
        "    for message in subscription:\n"
        "        if isinstance(message, Event):\n"
        "            print(message.text[0], flush=True)\n"
        "        elif message is not None:\n"
        "            print(message.sequence, flush=message.sequence == 0)\n"
        "    print(subscription.missing, subscription.backfilled)\n"
    )
    with Bus("s", listen=[endpoint], block=1.0) as router:
        consumer = subprocess.Popen([sys.executable, "-c", code], cwd=ROOT, stdout=subprocess.PIPE, text=True)
        try:
            publisher = router.publisher("ingest")
            column = np.zeros(10_000)
            t = np.zeros(10_000, np.int64)
            message = Altitude(
                vehicle=1, source="0/1", boot=0, t=t, t_rx=t, altitude=column, pressure=column, sigma=column
            )  # 320 kB
            publisher.put(message)
            assert consumer.stdout.readline() == "0\n"
            lines: list[str] = []
            reader = threading.Thread(target=lambda: lines.extend(consumer.stdout))
            reader.start()
            consumer.send_signal(signal.SIGSTOP)
            stalls = []
            for _ in range(300):  # more than all buffers between the two hold
                begin = time.monotonic()
                publisher.put(message)
                stalls.append(time.monotonic() - begin)
            assert max(stalls) > 0.5, "nobody was held up, so no link was dropped"
            consumer.send_signal(signal.SIGCONT)
            last = np.array([1])
            publisher.put(Progress(vehicle=0, source="ingest", boot=0, t=last, t_rx=last, final=True))
            assert publisher.finish(PATIENT)
            assert consumer.wait(PATIENT) == 0
            reader.join()
        finally:
            consumer.kill()
            consumer.communicate()
    numbers = [int(one) for one in lines[:-1] if one.strip().isdecimal()]
    assert numbers == list(range(1, 302))
    assert "bus: the link is lost\n" in lines
    assert "bus: the link is open again\n" in lines
    missing, backfilled = lines[-1].split()
    assert missing == "0"
    assert int(backfilled) > 0


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], Path(sys.argv[3]))
