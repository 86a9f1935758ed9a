"""A bus that leaves the machine: certificates for everybody, a router that denies what is not allowed.

python examples/secure_bus.py            everything in this process, over 127.0.0.1, with keys in a temporary folder
python examples/secure_bus.py FOLDER     the same with keys of your own, and the router's rules in FOLDER/router.json5

On real machines the commands are ``sortie keys FOLDER --host NAME``, ``sortie router --listen tls/NAME:7447
--credentials FOLDER`` (or ``zenohd -c router.json5``), and ``--connect tls/NAME:7447 --credentials FOLDER`` for
ingest, estimate and record; each machine has ca.pem and the certificate and key of its own roles, and no others.
"""

from __future__ import annotations

import socket
import sys
import tempfile
import threading
import time
from pathlib import Path

import numpy as np

from telemetry import keys
from telemetry.bus import Bus, publish, serve
from telemetry.bus.router import router_file, serve_router
from telemetry.messages import Event, Message, Progress, event


def main() -> None:
    """Show who is heard and who is not."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(temporary)
        if not (folder / "ca.pem").exists():
            print(f"made {len(keys.create(folder))} files in {folder}")
        endpoint = f"tls/127.0.0.1:{free_port()}"
        (folder / "router.json5").write_text(router_file([endpoint], folder))
        stop, ready = threading.Event(), threading.Event()
        options = {"stop": stop, "ready": ready.set}
        router = threading.Thread(target=serve_router, args=([endpoint], folder), kwargs=options)
        router.start()
        try:
            if ready.wait(30):
                fly(endpoint, folder)
                strangers(endpoint)
        finally:
            stop.set()
            router.join()


def fly(endpoint: str, folder: Path) -> None:
    """Three roles at work, and another viewer who tries to speak for one of them."""
    with (
        Bus("example", connect=[endpoint], credentials=folder, role="ingest") as ingest,
        Bus("example", connect=[endpoint], credentials=folder, role="estimate") as estimate,
        Bus("example", connect=[endpoint], credentials=folder, role="viewer") as viewer,
        Bus("example", connect=[endpoint], credentials=folder, role="viewer") as forger,
    ):
        forged = forger.publisher("ingest")
        forged.put(event("forged", t=0, t_rx=0))
        subscription = viewer.subscribe("viewer", ["ingest", "estimate"])  # first: nobody waits long for who looks on
        listening = threading.Event()
        started = {"started": lambda _: listening.set()}
        told = [
            threading.Thread(target=serve, args=(estimate, "estimate", ["ingest"], iter), kwargs=started),
            threading.Thread(target=publish, args=(ingest, "ingest", words())),
        ]
        told[0].start()
        listening.wait(30)  # who has said his last and has been heard goes, and is not there for those who come later
        told[1].start()
        heard = [message for message in subscription if isinstance(message, Event)]
        subscription.close()
        for thread in told:
            thread.join()
    print(f"heard {sum('word' in message.text[0] for message in heard)} words of two stages")
    print(f"heard {sum(message.text[0] == 'forged' for message in heard)} words of the viewer who spoke for ingest")


def words() -> list[Message]:
    """What the first stage says."""
    now = np.array([time.time_ns()])
    said: list[Message] = [event(f"word {i}", t=int(now[0]), t_rx=int(now[0])) for i in range(100)]
    return [*said, Progress(vehicle=0, source="ingest", boot=0, t=now, t_rx=now, final=True)]


def strangers(endpoint: str) -> None:
    """Who has no certificate of this authority, or calls in the clear, is told why he stays out."""
    with tempfile.TemporaryDirectory() as temporary:
        keys.create(Path(temporary))
        for where, credentials in ((endpoint, Path(temporary)), (endpoint.replace("tls", "tcp"), None)):
            try:
                Bus("example", connect=[where], credentials=credentials, role="viewer", wait=5).close()
            except OSError as error:
                print(f"refused: {error}")


def free_port() -> int:
    """A TCP port of this machine that nobody uses."""
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as sock:
        sock.bind(("127.0.0.1", 0))
        return int(sock.getsockname()[1])


if __name__ == "__main__":
    main()
