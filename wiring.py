"""How the stages are chained: from a log into a recording, from a socket into a sortie folder.

The command line (`sortie`) asks, and the rooms do the work; this file only connects them. Nothing heavy is imported
before it is needed.

A sortie folder::

    raw.tlog      the evidence: every byte received, with its time
    live.rrd      raw samples, live estimate, events, links
    windows.rrd   smoothed windows, a layer of the same recording
    report.json   the summary that the recording holds too
    sortie.toml   what ran: endpoints, settings, versions
"""

from __future__ import annotations

import os
import queue
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from configuration import Failure, configure, read_what_ran, say, write_what_runs

if TYPE_CHECKING:
    from telemetry.marks import Point
    from telemetry.messages import Message
    from viewer.summary import Summary

Item = TypeVar("Item")

TOLD = (  # of a window: state, factor, unit for people
    ("north", 1.0, "m"),
    ("altitude", 1.0, "m"),
    ("velocity_north", 1.0, "m/s"),
    ("h", 1.0, "m"),
    ("u", 1.0, "m/s"),
    ("w", 1.0, "m/s"),
    ("theta", 57.29578, "deg"),
    ("phi", 57.29578, "deg"),
)


def ahead(stream: Iterable[Item], depth: int = 64) -> Iterator[Item]:
    """The items of a stream that is worked out in a thread of its own, at most `depth` of them in advance.

    Compiled loops and the writer of recordings leave the interpreter to each other, so two cores are busy.
    """
    items: queue.Queue[tuple[bool, Any]] = queue.Queue(depth)
    stop = threading.Event()

    def put(entry: tuple[bool, Any]) -> None:
        while not stop.is_set():
            with suppress(queue.Full):
                items.put(entry, timeout=0.1)
                return

    def work() -> None:
        try:
            for item in stream:
                put((True, item))
                if stop.is_set():
                    return
            put((False, None))
        except BaseException as error:
            put((False, error))

    worker = threading.Thread(target=work, name="ahead", daemon=True)
    worker.start()
    try:
        while True:
            more, item = items.get()
            if more:
                yield item
            elif item is not None:
                raise item
            else:
                return
    finally:
        stop.set()
        worker.join()


def also(messages: Iterable[Message], stage: Callable[[Iterable[Message]], Iterable[Message]]) -> Iterator[Message]:
    """The messages, and among them what a stage makes of them."""
    passed: deque[Message] = deque()

    def tap() -> Iterator[Message]:
        for message in messages:
            passed.append(message)
            yield message

    for made in stage(tap()):
        while passed:
            yield passed.popleft()
        yield made
    yield from passed


def open_log(log: Path, configuration: Any, on_progress: Callable[[int], None] | None = None) -> tuple[Any, Any, Any]:
    """Source, dialect and settings of a log, or of a sortie folder and what ran there."""
    from telemetry.mavlink import Dialect
    from telemetry.sources.tlog import TlogSource

    links, ours = 1, log.is_dir()
    if ours:
        _, links, ran = read_what_ran(log)
        configuration = configuration or ran
        log = log / "raw.tlog"
    configuration = configuration or configure(None)
    dialect = Dialect(configuration.ingest.dialect)
    source = TlogSource(log, dialect, links=links, trusted=ours, on_progress=on_progress)
    return source, dialect, configuration


def new_folder(name: str | None, folder: Path | None, *, shared: bool = False) -> tuple[str, Path]:
    """Name and folder of a new sortie; `shared` by several processes, it may exist."""
    name = name or datetime.now(UTC).strftime("sortie-%Y%m%d-%H%M%S")
    folder = folder or Path("sorties") / name
    if not shared and folder.exists() and any(folder.iterdir()):
        raise Failure(
            f"{folder} exists and is not empty: a sortie is never overwritten; choose another --folder or --sortie"
        )
    folder.mkdir(parents=True, exist_ok=True)
    if not os.access(folder, os.W_OK):
        raise Failure(f"{folder} cannot be written to: choose another --folder")
    return name, folder


def watch(messages: Iterable[Message], tell: Callable[[str], None], *, every: bool = True) -> Iterator[Message]:
    """Pass messages on and say what an engineer would look up for; unless `every`, only warnings and test points."""
    import numpy as np

    from telemetry.messages import Event, Report, Window

    for message in messages:
        if isinstance(message, Event):
            for t, level, text in zip(message.t.tolist(), message.level, message.text, strict=True):
                if every or level != "info":
                    tell(f"{_clock(t)} {text}" if level == "info" else f"{_clock(t)} {level}: {text}")
        elif isinstance(message, Window) and (every or message.test_point):
            name = f"test point {message.test_point}" if message.test_point else f"window {message.number}"
            told = [(what, scale, unit) for what, scale, unit in TOLD if what in message.names]
            sigma = ", ".join(
                f"{what} {np.nanmedian(message.std[:, message.names.index(what)]) * scale:.2g} {unit}"
                for what, scale, unit in told
            )
            seconds = (message.t[-1] - message.t[0]) * 1e-9
            model = message.model.replace("_", " ")
            tell(
                f"{_clock(int(message.t[-1]))} {name}, {model}, {seconds:.1f} s, closed by {message.reason}; "
                f"sigma: {sigma}"
            )
        elif isinstance(message, Report) and message.alarms:
            name = f"test point {message.test_point}" if message.test_point else message.scope
            tell(f"{_clock(int(message.t[-1]))} ALARM: {name}: {'; '.join(message.alarms)}")
        yield message


def _clock(t: int) -> str:
    return datetime.fromtimestamp(t // 1_000_000_000, UTC).strftime("%H:%M:%S")


class _Stages:
    """Threads that run stages on a bus; their first failure is raised when they are joined."""

    def __init__(self) -> None:
        self.failures: list[Exception] = []
        self._threads: list[threading.Thread] = []

    def run(self, name: str, function: Callable[[], object]) -> None:
        def guarded() -> None:
            try:
                function()
            except Exception as error:
                self.failures.append(error)

        thread = threading.Thread(target=guarded, name=name, daemon=True)
        thread.start()
        self._threads.append(thread)

    def check(self) -> None:
        """Raise the first failure so far, if there is one."""
        if self.failures:
            raise self.failures[0]

    def join(self) -> None:
        """Wait for all, and raise their first failure."""
        for thread in self._threads:
            thread.join()
        self.check()


def stop_on_signals(stop: Callable[[], None]) -> None:
    """The first Ctrl-C or SIGTERM ends the input, so that everything closes in order; the second kills."""

    def handle(*_: object) -> None:
        say("closing: the window, the recording and the raw log (again to abandon)")
        signal.signal(signal.SIGINT, signal.default_int_handler)
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        stop()

    signal.signal(signal.SIGINT, handle)
    signal.signal(signal.SIGTERM, handle)


def _warm_up(dialect: Any) -> None:
    """Load and compile before a socket is open: what arrives meanwhile would be lost."""
    import estimator.stage
    import telemetry.ingest

    telemetry.ingest.warm_up(dialect)
    estimator.stage.warm_up()


def record_folder(messages: Iterable[Message], folder: Path, name: str, properties: dict[str, str]) -> Summary:
    """Record what comes over the bus into a sortie folder."""
    import msgspec

    from viewer.recorder import record

    summary = record(
        messages,
        folder / "live.rrd",
        windows=folder / "windows.rrd",
        sortie=name,
        properties=properties,
        interval=0.25,  # every chunk costs a kilobyte, and a viewer shows no more than this
        on_alarm=lambda text: say(f"ALARM: {text}"),
    )
    (folder / "report.json").write_bytes(msgspec.json.format(msgspec.json.encode(summary)))
    return summary


def follow(
    endpoints: Sequence[str],
    name: str,
    folder: Path,
    configuration: Any,
    idle: float | None,
    ready: Callable[[], None],
    tell: Callable[[str], None],
    keep: Callable[[Message], None] | None = None,
) -> Summary:
    """Receive, archive, estimate and record in one process, over an embedded bus.

    Parameters
    ----------
    endpoints, name, folder, configuration
        What to listen to, and where to write it.
    idle : float or None
        Stop by itself after so many seconds of silence.
    ready : callable
        Called when everything is listening.
    tell : callable
        Given a line for every event and window.
    keep : callable, optional
        Given every message.
    """
    from functools import partial

    from estimator.stage import estimate
    from telemetry.bus import Bus, publish, serve
    from telemetry.ingest import guarded, ingest
    from telemetry.mavlink import Dialect

    dialect = Dialect(configuration.ingest.dialect)
    _warm_up(dialect)
    source, raw_log = open_source(endpoints, dialect, folder)
    stages = _Stages()
    try:
        write_what_runs(folder, name, endpoints, configuration, dialect)
        stop_on_signals(source.stop)
        with Bus(name) as bus:
            subscription = bus.subscribe("record", ["ingest", "estimate"])
            settings = configuration.estimate
            stages.run("estimate", lambda: serve(bus, "estimate", ["ingest"], partial(estimate, settings=settings)))
            messages = ingest(source.batches(idle), source.links, dialect, configuration.ingest)
            stages.run("ingest", lambda: publish(bus, "ingest", guarded(messages, raw_log, lambda: source.dropped)))
            ready()

            def received() -> Iterator[Message]:
                for message in subscription:
                    if message is not None:
                        if keep:
                            keep(message)
                        yield message

            try:
                summary = record_folder(watch(received(), tell), folder, name, {"endpoints": " ".join(endpoints)})
                stages.check()
            except Exception as error:  # what else may be broken, the evidence of the flight is not given up
                tell(f"ALARM: {error or type(error).__name__}: only the raw log goes on; Ctrl-C ends it")
                subscription.close()
                for _ in source.batches(idle):
                    pass
                raise
            subscription.close()
            stages.join()
    finally:
        source.stop()
        source.join()
    refuse_loss(raw_log)
    return summary


def open_source(endpoints: Sequence[str], dialect: Any, folder: Path) -> tuple[Any, Any]:
    """Listen to the endpoints, with the raw log of a sortie folder behind them; nothing is left if that fails."""
    from telemetry.archive import RawLog
    from telemetry.sources.udp import UdpSource

    raw_log = RawLog(folder / "raw.tlog", links=len(endpoints))
    try:
        return UdpSource(endpoints, dialect, raw_log), raw_log
    except BaseException:
        raw_log.close()
        raw_log.path.unlink()
        raise


def refuse_loss(raw_log: Any) -> None:
    """Fail if evidence was lost."""
    if raw_log.lost:
        raise Failure(f"{raw_log.path}: {raw_log.lost} bytes of raw telemetry could not be written and are lost")


def smooth_log(
    log: Path,
    output: Path,
    configuration: Any,
    tell: Callable[[str], None] | None,
    through: Callable[[str, Iterable[Any]], Iterable[Any]] = lambda _, stream: stream,
    overlap: bool = True,
    test_points: Sequence[Point] = (),
    begun: Callable[[Any], object] | None = None,
) -> Summary:
    """Smooth a log, each boot as a whole, into one recording.

    Parameters
    ----------
    log, output, configuration
        The log or sortie folder, the recording, and settings if not those of the folder.
    tell : callable or None
        Given a line for every warning and test point; None also hides the progress bar.
    through : callable
        Every stream that one stage hands to the next passes through it, with the stage's name.
    overlap : bool
        Estimate in one thread and write in another.
    test_points : sequence of Point
        Those to be marked beside what the log itself marks.
    begun : callable, optional
        Given every stretch of flight path that begins.
    """
    from functools import partial

    from rich.console import Console
    from rich.progress import BarColumn, DownloadColumn, Progress, TextColumn, TimeElapsedColumn

    from estimator.stage import estimate
    from telemetry.ingest import ingest
    from telemetry.marks import insert
    from viewer.recorder import record

    console = Console(stderr=True)
    columns = TextColumn("{task.description}"), BarColumn(), DownloadColumn(), TimeElapsedColumn()
    hidden = tell is None or not console.is_terminal
    with Progress(*columns, console=console, transient=True, disable=hidden) as bar:
        task = bar.add_task(f"smoothing {log.name}", total=None)
        source, dialect, configuration = open_log(log, configuration, lambda done: bar.update(task, completed=done))
        bar.update(task, total=source.size)
        frames = through("read", source.batches())
        samples = through("decode", ingest(frames, source.links, dialect, configuration.ingest))
        samples = insert(samples, test_points) if test_points else samples
        whole = partial(estimate, settings=configuration.estimate, scope="sortie", begun=begun)
        messages = through("estimate", also(samples, whole))
        messages = ahead(messages) if overlap else messages
        if tell:
            messages = watch(messages, lambda text: bar.console.out(text, highlight=False), every=False)
        properties = {
            "log": source.path.name,
            "bytes": str(source.size),
            "dialect": dialect.name,
            "dialect_sha256": dialect.digest,
        }
        return record(
            messages,
            output,
            sortie=output.stem,
            completeness=lambda: _completeness(source),
            interval=None,
            properties=properties,
        )


def _completeness(source: Any) -> str:
    damage = []
    if source.truncated:
        damage.append(f"truncated: the log ends inside a record, {source.truncated} bytes left out")
    if source.discarded:
        damage.append(f"damaged: {source.discarded} bytes were no frame")
    return "; ".join(damage) or "complete"
