"""From a socket into a sortie folder, in one process or in three.

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

import fcntl
import gc
import os
import signal
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from configuration import read_what_ran, write_what_runs
from offline import open_log
from telling import Failure, counted, say, watch

if TYPE_CHECKING:
    from telemetry.messages import Message
    from viewer.summary import Summary


def new_folder(
    name: str | None, folder: Path | None, *, shared: bool = False, resume: bool = False
) -> tuple[str, Path]:
    """Name and folder of a sortie: a new one, unless it is `shared` by several processes or resumed."""
    if resume and not name:
        if folder is None:
            raise Failure("say which sortie is resumed: --sortie NAME, or --folder FOLDER")
        name = read_what_ran(folder).sortie
    name = name or datetime.now(UTC).strftime("sortie-%Y%m%d-%H%M%S")
    folder = folder or Path("sorties") / name
    if not (shared or resume) and folder.exists() and any(folder.iterdir()):
        raise Failure(
            f"{folder} exists and is not empty: a sortie is never overwritten; choose another --folder or --sortie, "
            "or go on with it: --resume"
        )
    folder.mkdir(parents=True, exist_ok=True)
    if not os.access(folder, os.W_OK):
        raise Failure(f"{folder} cannot be written to: choose another --folder")
    return name, folder


def stop_on_signals(stop: Callable[[], None], what: str = "the window, the recording and the raw log") -> None:
    """The first Ctrl-C or SIGTERM ends the input, so that everything closes in order; the second kills."""

    def handle(*_: object) -> None:
        say(f"closing: {what} (again to abandon)")
        signal.signal(signal.SIGINT, signal.default_int_handler)
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        stop()

    signal.signal(signal.SIGINT, handle)
    signal.signal(signal.SIGTERM, handle)


def warm_up(dialect: Any, settings: Any) -> None:
    """Load and compile before a socket is open: what arrives meanwhile would be lost."""
    import estimator.stage
    import telemetry.ingest

    telemetry.ingest.warm_up(dialect)
    estimator.stage.warm_up(settings)


def make_prompt() -> None:
    """Let nothing in this process hold up what arrives: collections of garbage pass over what is there by now, which
    takes 60 ms each time, and a thread that computes gives way to the others within half a millisecond.
    """
    gc.collect()
    gc.freeze()
    sys.setswitchinterval(5e-4)


class Reception:
    """What is received live: archived, framed, and turned into samples; a sortie that is resumed is told from its
    beginning.

    Parameters
    ----------
    folder, name : Path, str
        The sortie's.
    endpoints, forward : sequence of str
        Where vehicles and ground stations are; those that ran before if a sortie is resumed without any.
    configuration : Configuration
    resume : bool
        Go on with the sortie that is in the folder, with the settings that ran there.
    signing_key : Path, optional
        File of the key that frames must be signed with.
    accept_unsigned : bool
        Let unsigned frames pass all the same.

    Attributes
    ----------
    since : int
        Receive time up to which the sortie had been told before, ns.
    """

    def __init__(
        self,
        folder: Path,
        name: str,
        endpoints: Sequence[str],
        configuration: Any,
        *,
        forward: Sequence[str] = (),
        resume: bool = False,
        signing_key: Path | None = None,
        accept_unsigned: bool = False,
    ) -> None:
        from telemetry.archive import RawLog
        from telemetry.mavlink import Dialect
        from telemetry.sources.receiver import Receiver

        if resume:
            ran = read_what_ran(folder)
            if name != ran.sortie:
                raise Failure(f"{folder} holds the sortie {ran.sortie!r}: resume it with --sortie {ran.sortie}")
            endpoints, forward = endpoints or ran.endpoints, forward or ran.forward
            if (len(endpoints), len(forward)) != (len(ran.endpoints), len(ran.forward)):
                before = f"{counted(len(ran.endpoints), 'endpoint')} and {len(ran.forward)} to forward to"
                raise Failure(f"{folder}: the sortie ran with {before}; resume it with as many, in their order")
            configuration = ran.configuration
        if not endpoints:
            raise Failure("say where telemetry comes from, e.g. udpin:127.0.0.1:14550")
        self.configuration = configuration
        self.endpoints = endpoints
        self.dialect = Dialect(configuration.ingest.dialect)
        self.since = 0
        guard = _guard(signing_key, accept_unsigned)
        warm_up(self.dialect, configuration.estimate)
        make_prompt()
        path = folder / "raw.tlog"
        links = len(endpoints) + len(forward)
        self.raw_log = RawLog(path, links=links, resume=resume, crc_extra=self.dialect.crc_extra)
        try:
            past: Iterable[Any] = ()
            if self.raw_log.size:
                self.since = self.raw_log.reached
                past = open_log(folder, configuration, size=self.raw_log.size).source.batches()
            self.source = Receiver(endpoints, self.dialect, self.raw_log, forward=forward, guard=guard)
            self._past = past
            if not resume:
                write_what_runs(folder, name, endpoints, forward, configuration, self.dialect)
            for trouble in (self.raw_log.error, self.raw_log.warning, *self.raw_log.notes):
                if trouble:  # nobody else hears of it before something is received
                    say(f"warning: {trouble}")
        except BaseException:
            self.raw_log.close()
            if not self.raw_log.size:
                path.unlink()
            raise

    def batches(self, idle: float | None = None) -> Iterator[Any]:
        """Frames: those of before, then what arrives, until nothing has for `idle` seconds or it is stopped."""
        yield from self._past
        yield from self.source.batches(idle)

    def messages(self, idle: float | None = None) -> Iterator[Message]:
        """What they say, and what befalls the evidence."""
        from telemetry.ingest import guarded, ingest

        frames = self.batches(idle)
        told = ingest(frames, self.source.links, self.dialect, self.configuration.ingest)
        return guarded(told, self.raw_log, self.source)

    def close(self) -> None:
        """Stop receiving, and close the raw log."""
        self.source.stop()
        self.source.join()

    def refuse_loss(self) -> None:
        """Fail if evidence was lost."""
        if self.raw_log.lost:
            lost = f"{self.raw_log.lost} bytes of raw telemetry could not be written and are lost"
            raise Failure(f"{self.raw_log.path}: {lost}")


def _guard(signing_key: Path | None, accept_unsigned: bool) -> Any:
    """What refuses frames that are not signed as they should be, if a key is given."""
    from telemetry.signing import SignatureGuard, read_key

    if signing_key is None:
        if accept_unsigned:
            raise Failure("--accept-unsigned says what to do beside a --signing-key, and there is none")
        return None
    key = read_key(signing_key)
    if key.warning:
        say(f"warning: {key.warning}")
    seen = signing_key.with_name(signing_key.name + ".seen")
    return SignatureGuard(key.secret, accept_unsigned=accept_unsigned, seen=seen)


def record_folder(
    messages: Iterable[Message],
    folder: Path,
    name: str,
    properties: dict[str, str],
    *,
    finished: Callable[[], bool],
    again: bool = False,
) -> Summary:
    """Record what stages say into a sortie folder; `again` in place of a recording that it makes void.

    `finished` tells in the end whether all stages have said their last.
    """
    import msgspec

    from viewer import load

    load()
    from viewer.recorder import record

    live, windows = folder / "live.rrd", folder / "windows.rrd"
    if again:
        live.unlink(missing_ok=True)
        windows.unlink(missing_ok=True)
    summary = record(
        messages,
        live,
        windows=windows,
        sortie=name,
        properties=properties,
        completeness=lambda: "complete" if finished() else "broken off: the stages had not said their last",
        interval=0.5,  # a chunk takes as long to write as a hundred rows, and who looks on wants to see things move
        on_alarm=lambda text: say(f"ALARM: {text}"),
    )
    (folder / "report.json").write_bytes(msgspec.json.format(msgspec.json.encode(summary)))
    return summary


def record_lives(
    subscription: Any,
    folder: Path,
    name: str,
    properties: dict[str, str],
    *,
    through: Callable[[Iterable[Message]], Iterable[Message]],
    resume: bool = False,
) -> Summary | None:
    """Record what some stages say into a sortie folder; when one of them is restarted, all of it again.

    Returns
    -------
    Summary or None
        None when there was nothing to record.
    """
    summary = None
    with only_recorder(folder):
        for life in subscription.lives():
            messages = through(message for message in life if message is not None)
            again = resume or summary is not None
            whole = partial(_is_whole, subscription)
            summary = record_folder(messages, folder, name, properties, finished=whole, again=again)
    return summary


def _is_whole(subscription: Any) -> bool:
    """Whether all that some stages said has been heard, to their last word."""
    return bool(subscription.finished and not subscription.missing)


@contextmanager
def only_recorder(folder: Path) -> Iterator[None]:
    """Keep a second process from recording into the same folder."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise Failure(f"{folder}: another process is recording there; end it first") from None
        yield
    finally:
        os.close(handle)


def follow(
    reception: Reception,
    name: str,
    folder: Path,
    idle: float | None,
    ready: Callable[[], object],
    tell: Callable[[str], None],
    again: bool = False,
) -> Summary:
    """Follow a flight in one process: receive, estimate and record in one chain, until stopped.

    Only the receiver, which nothing may hold up, and the smoothing of windows, which takes long, have threads of their
    own: more of them would take the interpreter from one another.

    Parameters
    ----------
    reception : Reception
    name, folder
        The sortie's.
    idle : float or None
        Stop by itself after so many seconds of silence.
    ready : callable
        Called when everything is listening.
    tell : callable
        Given a line for every event and window.
    again : bool
        Put the recordings in the place of those of before.
    """
    from estimator.stage import estimate
    from telemetry.chain import aged, also, expendable, unbroken
    from telemetry.messages import Estimate
    from viewer import load

    load()
    failures: list[Exception] = []
    settings = reception.configuration.estimate
    flying = expendable("estimate", partial(estimate, settings=settings, beside=True), failures)
    try:
        stop_on_signals(reception.source.stop)
        ready()
        said = aged(unbroken("ingest", reception.messages(idle), failures), "live", "ingest")
        whole = aged(also(said, flying), "live", "estimate", Estimate)
        try:
            told = watch(whole, tell, since=reception.since)
            properties = {"endpoints": " ".join(reception.endpoints), "estimator": settings.estimator}
            with only_recorder(folder):
                summary = record_folder(told, folder, name, properties, finished=lambda: not failures, again=again)
            if failures:
                raise failures[0]
        except Exception as error:  # what else may be broken, the evidence of the flight is not given up
            tell(f"ALARM: {error or type(error).__name__}: only the raw log goes on; Ctrl-C ends it")
            for _ in reception.source.batches(idle):
                pass
            raise
    finally:
        reception.close()
    reception.refuse_loss()
    return summary
