"""A command in a process of its own begins, ends and fails in words, and does not outlive who started it."""

from __future__ import annotations

import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

from sims.command import Command, free_port

CARRIES = "import sys, time\nfrom sims.command import Command\n" + (
    "with Command('router', 'carrying', '--listen', sys.argv[1]) as router:\n"
    "    router.wait()\n    print(router.process.pid, flush=True)\n    time.sleep(600)\n"
)


def bus() -> str:
    return f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"


def test_it_is_ready_when_it_says_so_and_ends_by_itself():
    with Command("router", "carrying", "--listen", bus()) as router:
        router.wait()
        assert not router.end(time.monotonic() + 0.1), "nobody asked it to"
        router.process.send_signal(signal.SIGINT)
        assert router.end(time.monotonic() + 30.0)


def test_one_that_fails_says_why(tmp_path):
    with Command("review", "reviewed", tmp_path / "nothing.rrd") as failing:
        with pytest.raises(RuntimeError, match=r"sortie review did not begin: .*nothing\.rrd"):
            failing.wait()
        with pytest.raises(RuntimeError, match=r"sortie review ended with 1: .*nothing\.rrd"):
            failing.end(time.monotonic() + 30.0)


def test_it_does_not_outlive_who_started_it():
    with subprocess.Popen([sys.executable, "-c", CARRIES, bus()], stdout=subprocess.PIPE, text=True) as starter:
        assert starter.stdout is not None
        pid = int(starter.stdout.readline())
        starter.kill()
    end = time.monotonic() + 30.0
    while is_running(pid):
        assert time.monotonic() < end, "it goes on"
        time.sleep(0.05)


def is_running(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False
