"""Commands of ``sortie`` in processes of their own, as an engineer starts them."""

from __future__ import annotations

import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable

LOOPBACK = "127.0.0.1"
GRACE = 10.0  # s that it has to close when it is no longer wanted
# What nobody writes to ends when this process does, however it does: then the command closes, as by Ctrl-C.
_CODE = """
import os, signal, threading
def outlive():
    os.read(0, 1)
    os.kill(os.getpid(), signal.SIGTERM)
threading.Thread(target=outlive, daemon=True).start()
import sortie
sortie.main()
"""


class Command:
    """A command in a process of its own: an interruption of this one from the keyboard does not reach it, its end does.

    Parameters
    ----------
    name : str
        The command.
    ready : str
        Words that it says when it is ready.
    *arguments : object
    hear : callable, optional
        Given every line that it says, on another thread.

    Attributes
    ----------
    name : str
    process : subprocess.Popen
    """

    def __init__(self, name: str, ready: str, *arguments: object, hear: Callable[[str], object] | None = None) -> None:
        self.name, self._ready, self._hear = name, ready, hear
        command = [sys.executable, "-P", "-c", _CODE, name, *map(str, arguments)]
        self.process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
        self._said: list[str] = []
        self._heard = threading.Event()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self.process.stderr is not None
        for line in self.process.stderr:
            self._said = [*self._said[-99:], line]
            if self._ready in line:
                self._heard.set()
            if self._hear is not None:
                self._hear(line.rstrip())

    def wait(self, seconds: float = 120.0) -> None:
        """Until it says that it is ready.

        Raises
        ------
        RuntimeError
            If it ends before, or does not say so in time.
        """
        end = time.monotonic() + seconds
        while not self._heard.wait(0.05):
            if self.process.poll() is not None or time.monotonic() > end:
                raise RuntimeError(f"sortie {self.name} did not begin: {self._last()}")

    def end(self, until: float) -> bool:
        """Whether it ends by itself before a monotonic time.

        Raises
        ------
        RuntimeError
            If it ends with an error.
        """
        try:
            code = self.process.wait(max(0.0, until - time.monotonic()))
        except subprocess.TimeoutExpired:
            return False
        if code:
            raise RuntimeError(f"sortie {self.name} ended with {code}: {self._last()}")
        return True

    def _last(self) -> str:
        return "".join(self._said[-3:]).strip()

    def __enter__(self) -> Command:
        return self

    def __exit__(self, *_: object) -> None:
        if self.process.poll() is None:
            self.process.terminate()
            try:
                self.process.wait(GRACE)
            except subprocess.TimeoutExpired:
                self.process.kill()
                self.process.wait()
        self._reader.join()
        for pipe in (self.process.stdin, self.process.stderr):
            assert pipe is not None
            pipe.close()


def free_port(kind: socket.SocketKind = socket.SOCK_DGRAM) -> int:
    """A port of this machine that nobody listens on; of UDP if nothing else is said."""
    with socket.socket(socket.AF_INET, kind) as held:
        held.bind((LOOPBACK, 0))
        return int(held.getsockname()[1])
