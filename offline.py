"""From a log into a recording.

The command line (`sortie`) asks, and the rooms do the work; this file only connects them. Nothing heavy is imported
before it is needed.
"""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

from configuration import configure, read_what_ran
from telling import Failure, watch

if TYPE_CHECKING:
    from telemetry.marks import Point
    from telemetry.messages import Message
    from viewer.summary import Summary

Item = TypeVar("Item")
Through = Callable[[str, Iterable[Any]], Iterable[Any]]


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


class Log(NamedTuple):
    """A log to be processed again.

    Parameters
    ----------
    source : TlogSource, DataFlashSource or UlogSource
    configuration : Configuration
    dialect : Dialect or None
        None for a log that was written on board and holds no MAVLink.
    """

    source: Any
    configuration: Any
    dialect: Any = None

    def messages(self, through: Through = lambda _, stream: stream) -> Iterable[Message]:
        """What the log says, in the vocabulary; streams pass `through` with the name of their stage."""
        if self.dialect is None:
            return through("decode", self.source.messages())
        from telemetry.ingest import ingest

        frames = through("read", self.source.batches())
        return through("decode", ingest(frames, self.source.links, self.dialect, self.configuration.ingest))

    @property
    def properties(self) -> dict[str, str]:
        """What a recording says of its origin."""
        told = {"log": self.source.path.name, "bytes": str(self.source.size)}
        if self.dialect is None:
            more: dict[str, str] = self.source.properties
            return told | more
        return told | {"dialect": self.dialect.name, "dialect_sha256": self.dialect.digest}

    @property
    def completeness(self) -> str:
        """Whether all of it could be read, once it has been."""
        damage = []
        if self.source.truncated:
            damage.append(f"truncated: the log ends inside a record, {self.source.truncated} bytes left out")
        if missing := getattr(self.source, "missing", []):
            damage.append(f"incomplete: {', '.join(path.name for path in missing)} is not there")
        if self.source.discarded:
            damage.append(f"damaged: {self.source.discarded} bytes were no {'frame' if self.dialect else 'record'}")
        return "; ".join(damage) or "complete"


def open_log(
    log: Path,
    configuration: Any = None,
    on_progress: Callable[[int], None] | None = None,
    *,
    size: int | None = None,
    framed: bool = False,
) -> Log:
    """Open a telemetry log, an on-board log, or a sortie folder with the settings of what ran there.

    Parameters
    ----------
    log, configuration
        Settings replace those of a folder.
    on_progress : callable, optional
        Given the number of bytes read so far.
    size : int, optional
        Read so many bytes only.
    framed : bool
        Only a log of frames will do.
    """
    from telemetry.mavlink import Dialect
    from telemetry.sources.kinds import kind
    from telemetry.sources.tlog import TlogSource

    if log.is_dir():
        ran = read_what_ran(log)
        configuration = configuration or ran.configuration
        dialect = Dialect(configuration.ingest.dialect)
        source = TlogSource(log, dialect, links=ran.links, trusted=True, on_progress=on_progress, size=size)
        return Log(source, configuration, dialect)
    configuration = configuration or configure(None)
    what = kind(log)
    if what == "tlog":
        dialect = Dialect(configuration.ingest.dialect)
        return Log(TlogSource(log, dialect, on_progress=on_progress), configuration, dialect)
    if framed:
        raise Failure(f"{log} was written on board and holds no MAVLink frames to send; sortie smooth reads it")
    if what == "dataflash":
        from telemetry.sources.dataflash import DataFlashSource

        return Log(DataFlashSource(log, mark=configuration.ingest.mark, on_progress=on_progress), configuration)
    from telemetry.sources.ulog import UlogSource

    return Log(UlogSource(log, mark=configuration.ingest.mark, on_progress=on_progress), configuration)


def smooth_log(
    log: Path,
    output: Path,
    configuration: Any,
    tell: Callable[[str], None] | None,
    through: Through = lambda _, stream: stream,
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
    from telemetry.chain import also
    from telemetry.marks import insert
    from viewer.recorder import record

    console = Console(stderr=True)
    columns = TextColumn("{task.description}"), BarColumn(), DownloadColumn(), TimeElapsedColumn()
    hidden = tell is None or not console.is_terminal
    with Progress(*columns, console=console, transient=True, disable=hidden) as bar:
        task = bar.add_task(f"smoothing {log.name}", total=None)
        opened = open_log(log, configuration, lambda done: bar.update(task, completed=done))
        bar.update(task, total=opened.source.size)
        samples = opened.messages(through)
        samples = insert(samples, test_points) if test_points else samples
        whole = partial(estimate, settings=opened.configuration.estimate, scope="sortie", begun=begun)
        messages = through("estimate", also(samples, whole))
        messages = ahead(messages) if overlap else messages
        if tell:
            messages = watch(messages, lambda text: bar.console.out(text, highlight=False), every=False)
        return record(
            messages,
            output,
            sortie=output.stem,
            completeness=lambda: opened.completeness,
            interval=None,
            properties=opened.properties | {"estimator": opened.configuration.estimate.estimator},
        )
