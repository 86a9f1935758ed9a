"""The pipeline under load, as it is flown: real processes, real sockets, the bus between them.

Several vehicles are sent over UDP in real time to ``sortie live``, or to ``sortie ingest``, ``estimate`` and
``record`` in three processes. What was sent is held against what was received, by the loss accounts and by the kernel;
what every process cost, how its memory grew and how old the estimates were when they were recorded is measured from
outside. The first `SETTLE` seconds, in which filters begin, count for nothing but the losses.
"""

from __future__ import annotations

import json
import math
import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import msgspec
import numpy as np

import sims
from sims.command import Command, free_port
from sims.experiments.pipeline_load import Load, Sent
from sims.grades import GRADES, Rates

if TYPE_CHECKING:
    from rich.table import Table

Processes = Literal[1, 3]
Tell = Callable[[str], None]

SETTLE = 30.0  # s; ages are counted from there on, or all where it is never reached
AGE = 0.05  # s: the target for the 99th percentile
GROWTH = 0.05  # share of its memory by which a process may grow per minute and still be called flat
LONG = 300.0  # s that a run must take to show whether memory grows: before, the first windows are open
PATIENCE = 300.0  # s that a pipeline has to end after the last message was sent
LAG = 0.005  # s that a sample waits for older ones where none is late
PAGE = os.sysconf("SC_PAGE_SIZE")
TICK = os.sysconf("SC_CLK_TCK")
IMU = 200  # Hz
LINKS = 4  # that a raw log tells apart


class Use(msgspec.Struct, frozen=True, kw_only=True):
    """What one process took.

    Parameters
    ----------
    name : str
        The command.
    cpu : float
        CPU seconds per second.
    per_message : float
        CPU seconds per message sent.
    memory, growth : float
        Resident bytes at the end, and by how much it grew per minute, from a line through the second half of the run:
        the first windows of a flight are open until then, and what they hold comes back. Runs shorter than `LONG` say
        nothing of it.
    """

    name: str
    cpu: float
    per_message: float
    memory: float
    growth: float


class Row(msgspec.Struct, frozen=True, kw_only=True):
    """One run.

    Parameters
    ----------
    processes, vehicles : int
    rate, seconds : float
        Messages per second that were to be sent, and for how long.
    sent, received, lost, dropped : int
        Frames sent; that arrived, and that did not, by the loss accounts; datagrams that the kernel threw away.
    corrupt : int
        Frames with a wrong checksum, and bytes in no frame.
    estimates : int
    age_p50, age_p99, age_max : float
        From the arrival of the newest sample in an estimate to its recording, s.
    behind : float
        How late the sender was at most, s: ages are worth nothing where that is much.
    ending : float
        From the last message sent until all processes had ended by themselves, s, of which the benchmark waits 2 s; a
        pipeline that cannot follow has work left then. NaN where they had to be killed: nothing is known of what came
        through, and counts are 0 and ages NaN.
    uses : tuple of Use
    recorded : int
        Bytes of the recordings.
    """

    processes: int
    vehicles: int
    rate: float
    seconds: float
    sent: int
    received: int
    lost: int
    dropped: int
    corrupt: int
    estimates: int
    age_p50: float
    age_p99: float
    age_max: float
    behind: float
    ending: float
    uses: tuple[Use, ...]
    recorded: int

    @property
    def faults(self) -> tuple[str, ...]:
        """What was missed, in words; empty where everything was reached."""
        if not np.isfinite(self.ending):
            return ("does not follow",)
        found = []
        if self.received != self.sent or self.lost or self.dropped or self.corrupt:
            found.append("lost")
        if not self.age_p99 < AGE:
            found.append("old")
        if self.seconds >= LONG and any(use.growth > GROWTH * use.memory for use in self.uses):
            found.append("grows")
        return tuple(found)


class Comparison(msgspec.Struct, frozen=True, kw_only=True):
    """All runs, and the machine they ran on."""

    machine: dict[str, str]
    rows: tuple[Row, ...]

    def tables(self) -> Iterator[Table]:
        """One table of what came through, one of what each process took."""
        from rich.table import Table

        table = Table(title="through the pipeline, in real time", title_justify="left")
        for name in (
            "processes", "vehicles", "messages/s", "s", "sent", "received", "lost", "kernel drops", "estimates",
            "age p50", "p99", "max", "sender late", "ending", "verdict",
        ):  # fmt: skip
            table.add_column(name, justify="left" if name == "verdict" else "right")
        for row in self.rows:
            table.add_row(
                f"{row.processes}", f"{row.vehicles}", f"{row.sent / row.seconds:.0f}", f"{row.seconds:.0f}",
                f"{row.sent}", f"{row.received}", f"{row.lost}", f"{row.dropped}", f"{row.estimates}",
                *(f"{age * 1e3:.0f} ms" for age in (row.age_p50, row.age_p99, row.age_max, row.behind)),
                f"{row.ending:.1f} s", ", ".join(row.faults) or "good",
            )  # fmt: skip
        yield table
        table = Table(title="what each process took", title_justify="left")
        for name in ("processes", "messages/s", "process", "CPU of a core", "per message", "memory", "growth"):
            table.add_column(name, justify="left" if name == "process" else "right")
        for row in self.rows:
            for use in row.uses:
                growth = f"{use.growth / 1e6:+.1f} MB/min" if row.seconds >= LONG else "too short to tell"
                table.add_row(
                    f"{row.processes}", f"{row.sent / row.seconds:.0f}", use.name, f"{100 * use.cpu:.0f} %",
                    f"{use.per_message * 1e6:.0f} us", f"{use.memory / 1e6:.0f} MB", growth,
                )  # fmt: skip
        yield table


def compare(
    rates: Sequence[float] = (1000.0, 5000.0, 20000.0),
    seconds: float = 60.0,
    processes: Sequence[Processes] = (1, 3),
    tell: Tell | None = None,
    *,
    settle: float = SETTLE,
) -> Comparison:
    """Run the pipeline at several rates.

    Parameters
    ----------
    rates : sequence of float
        Messages per second. Inertial samples come 200 times a second from each vehicle, the other sensors as from a
        small autopilot, 290 messages/s in all; there are five vehicles, fewer where that is more than the rate, and
        what is missing to the rate are messages that autopilots send beside.
    seconds : float
        For each; `settle` more are sent before.
    processes : sequence of {1, 3}
    tell : callable, optional
        Given a line when something begins.
    settle : float
        Seconds that count for nothing but the losses.
    """
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        flight = fly(Path(folder) / "flight.tlog", seconds + settle)
        per_vehicle = flight.frames / (seconds + settle)
        for rate in rates:
            vehicles = min(5, max(1, round(rate / per_vehicle)))
            for count in processes:
                if tell:
                    tell(f"{rate:.0f} messages/s, {vehicles} vehicles, {count} processes: {seconds + settle:.0f} s")
                rows.append(_run(flight, vehicles, rate, seconds, count, settle, tell))
    return Comparison(machine=machine(), rows=tuple(rows))


def run(
    vehicles: int = 5,
    imu: int = IMU,
    seconds: float = 600.0,
    tell: Tell | None = None,
    *,
    processes: Processes = 3,
    settle: float = SETTLE,
) -> Comparison:
    """Run the pipeline for long, with what the sensors of the vehicles say and nothing beside.

    Parameters
    ----------
    vehicles : int
    imu : int
        Inertial samples per second of each; a divisor of 400.
    seconds : float
    tell, processes, settle
        As `compare`.
    """
    with tempfile.TemporaryDirectory() as folder:
        if tell:
            tell(f"flying {seconds + settle:.0f} s")
        flight = fly(Path(folder) / "flight.tlog", seconds + settle, imu)
        if tell:
            tell(f"{vehicles} vehicles, inertial samples at {imu} Hz, {processes} processes")
        return Comparison(machine=machine(), rows=(_run(flight, vehicles, 0.0, seconds, processes, settle, tell),))


class Flown(msgspec.Struct, frozen=True, kw_only=True):
    """A simulated flight on disk."""

    path: str
    frames: int


def fly(path: Path, seconds: float, imu: int = IMU) -> Flown:
    """Simulate a flight of a small aircraft with fast inertial sensors and write its frames."""
    rates = Rates(imu=imu, attitude=50, heading=50, static=25, pitot=25, gnss=5, navigation=5)
    flight = sims.fly("c172x", "demo", sensors=GRADES["mems"]._replace(rates=rates), duration=seconds)
    return Flown(path=str(path), frames=sims.write_tlog(sims.frames(flight), path, flight.start_utc))


def machine() -> dict[str, str]:
    """What it was measured on."""
    return {"cores": str(os.cpu_count()), "python": sys.version.split()[0], "least_lag": f"{LAG:g} s"}


def _run(
    flight: Flown, vehicles: int, rate: float, seconds: float, processes: Processes, settle: float, tell: Tell | None
) -> Row:
    with tempfile.TemporaryDirectory() as name, ExitStack() as stack:
        folder = Path(name)
        config = folder / "settings.toml"
        config.write_text(f"[estimate]\nleast_lag = {LAG}\n")
        ports = tuple(free_port() for _ in range(min(vehicles, LINKS)))
        load = Load(flight=flight.path, vehicles=vehicles, rate=rate, seconds=seconds + settle, ports=ports)
        sender = stack.enter_context(_Sender(load))
        stages = _start(stack, ports, folder, config, processes)
        sender.wait_ready()
        with _Watch(stages, ports) as watch:
            sent = sender.send()
            stopped = time.monotonic()
            time.sleep(2.0)
        for stage in stages:
            if stage.name in ("live", "ingest"):
                stage.process.send_signal(signal.SIGINT)
        try:
            ended = all(stage.end(stopped + PATIENCE) for stage in stages)
        except RuntimeError as error:  # e.g. because a consumer did not take everything in time
            ended = False
            if tell:
                tell(str(error))
        ending = time.monotonic() - stopped if ended else math.nan
        return _row(folder / "sortie", load, sent, watch, processes, settle, ending)


def _start(stack: ExitStack, ports: Sequence[int], folder: Path, config: Path, processes: Processes) -> list[Command]:
    endpoints = [f"udpin:127.0.0.1:{port}" for port in ports]
    where = folder / "sortie"
    if processes == 1:
        stages = [Command("live", "listening on", *endpoints, "--folder", where, "--config", config)]
    else:
        bus, name = f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}", ("--sortie", "bench")
        stages = [
            Command(
                "ingest", "listening on", *endpoints, *name, "--folder", where, "--listen", bus, "--config", config
            ),
            Command("estimate", "estimating on", *name, "--connect", bus, "--config", config),
            Command("record", "recording from", where, *name, "--connect", bus),
        ]
    for stage in stages:
        stack.enter_context(stage)
    for stage in stages:
        stage.wait()
    return stages


class _Sender:
    """The load in a process of its own."""

    def __init__(self, load: Load) -> None:
        told = msgspec.json.encode(load).decode()
        command = [sys.executable, "-m", "sims.experiments.pipeline_load", told]
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def wait_ready(self) -> None:
        """Until everything is encoded."""
        assert self._process.stdout is not None
        if self._process.stdout.readline().strip() != "ready":
            raise RuntimeError("the load could not be encoded")

    def send(self) -> Sent:
        """Send all of it, in real time."""
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.write("go\n")
        self._process.stdin.flush()
        return msgspec.json.decode(self._process.stdout.readline(), type=Sent)

    def __enter__(self) -> _Sender:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.wait()
        for pipe in (self._process.stdin, self._process.stdout):
            assert pipe is not None
            pipe.close()


class _Watch:
    """Looks at processes and sockets from outside, once a second.

    Attributes
    ----------
    seen : list of (float, dict of str to (float, float))
        Time, s; CPU seconds and resident bytes by process.
    dropped : int
        Datagrams that the kernel has thrown away.
    """

    def __init__(self, stages: Sequence[Command], ports: Iterable[int]) -> None:
        self._stages, self._ports = stages, set(ports)
        self._stop = threading.Event()
        self.seen: list[tuple[float, dict[str, tuple[float, float]]]] = []
        self.dropped = 0
        self._thread = threading.Thread(target=self._run, daemon=True)

    def _run(self) -> None:
        begin = time.monotonic()
        while True:
            last = self._stop.wait(1.0)
            now = {stage.name: _use(stage.process.pid) for stage in self._stages}
            self.seen.append((time.monotonic() - begin, now))
            self.dropped = max(self.dropped, _drops(self._ports))
            if last:
                return

    def use(self, name: str, after: float, messages: float) -> Use:
        """What a process took, from a line through what was seen after some seconds; `messages` per second."""
        t = np.array([at for at, _ in self.seen if at >= after])
        cpu, memory = np.array([use[name] for at, use in self.seen if at >= after]).T
        per_second = float(np.polyfit(t, cpu, 1)[0]) if len(t) > 1 else float("nan")
        late = len(t) // 2
        slope = float(np.polyfit(t[late:], memory[late:], 1)[0]) if len(t) - late > 1 else float("nan")
        return Use(
            name=name, cpu=per_second, per_message=per_second / messages,
            memory=float(memory[-1]), growth=slope * 60.0,
        )  # fmt: skip

    def __enter__(self) -> _Watch:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()


def _use(pid: int) -> tuple[float, float]:
    """CPU seconds and resident bytes of a process; NaN where it is gone."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return float("nan"), float("nan")
    return (int(fields[11]) + int(fields[12])) / TICK, int(fields[21]) * PAGE


def _drops(ports: set[int]) -> int:
    """Datagrams for these ports that found no room."""
    total = 0
    for line in Path("/proc/net/udp").read_text().splitlines()[1:]:
        fields = line.split()
        if int(fields[1].rpartition(":")[2], 16) in ports:
            total += int(fields[-1])
    return total


def _row(
    folder: Path, load: Load, sent: Sent, watch: _Watch, processes: Processes, settle: float, ending: float
) -> Row:
    told: dict[str, Any] = {"accounts": (), "byte_accounts": (), "vehicles": ()}
    if math.isfinite(ending):
        told = json.loads((folder / "report.json").read_text())
    accounts, octets, age = told["accounts"], told["byte_accounts"], told.get("settled") or told.get("age") or {}
    names = list(watch.seen[-1][1])
    return Row(
        processes=processes,
        vehicles=load.vehicles,
        rate=load.rate,
        seconds=load.seconds,
        sent=sent.datagrams,
        received=sum(account["received"] for account in accounts),
        lost=sum(account["lost"] - account["late"] for account in accounts),
        dropped=watch.dropped,
        corrupt=sum(account["corrupt"] + account["discarded"] for account in octets),
        estimates=sum(live["rows"] for vehicle in told["vehicles"] for live in vehicle["live"]),
        age_p50=age.get("p50", float("nan")),
        age_p99=age.get("p99", float("nan")),
        age_max=age.get("max", float("nan")),
        behind=sent.behind,
        ending=ending,
        uses=tuple(watch.use(name, settle, sent.datagrams / load.seconds) for name in names),
        recorded=sum(path.stat().st_size for path in folder.glob("*.rrd")),
    )
