"""The command line as a process, as a user starts it."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import time
from pathlib import Path

SORTIE = Path(sys.executable).parent / "sortie"
RERUN = Path(sys.executable).parent / "rerun"
ENVIRONMENT = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}  # as users have it


def run(*arguments: object, cwd: Path | None = None, timeout: float = 240) -> subprocess.CompletedProcess[str]:
    """Run ``sortie`` to its end."""
    return subprocess.run(
        [SORTIE, *map(str, arguments)], cwd=cwd, capture_output=True, text=True, timeout=timeout, check=False
    )


class Process:
    """``sortie`` in the background, its messages to be waited for."""

    def __init__(self, *arguments: object, cwd: Path | None = None) -> None:
        self.process = subprocess.Popen(
            [SORTIE, *map(str, arguments)], cwd=cwd, env=ENVIRONMENT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
        )
        assert self.process.stdout is not None
        os.set_blocking(self.process.stdout.fileno(), False)
        self.said = ""

    def wait_for(self, words: str, timeout: float = 120) -> None:
        end = time.monotonic() + timeout
        while words not in self.listen():
            assert self.process.poll() is None, f"ended with {self.process.returncode}: {self.listen()}"
            assert time.monotonic() < end, f"never said {words!r}: {self.said}"
            time.sleep(0.05)

    def listen(self) -> str:
        assert self.process.stdout is not None
        self.said += (self.process.stdout.read() or b"").decode()
        return self.said

    def end(self, timeout: float = 120) -> int:
        code = self.process.wait(timeout)
        self.listen()
        return code

    def __enter__(self) -> Process:
        return self

    def __exit__(self, *_: object) -> None:
        self.process.kill()
        self.process.wait()
        assert self.process.stdout is not None
        self.process.stdout.close()


def free_port(kind: int = socket.SOCK_DGRAM) -> int:
    with socket.socket(socket.AF_INET, kind) as sock:
        sock.bind(("127.0.0.1", 0))
        return int(sock.getsockname()[1])
