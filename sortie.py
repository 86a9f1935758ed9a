"""The front door: one command line over the four rooms.

A command is a function; its docstring is its help. Nothing is imported before a command needs it, not even the library
that reads the command line, so that ``sortie --help`` answers at once.
"""

from __future__ import annotations

import atexit
import inspect
import json
import os
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from apart import follow_apart
from bench import BENCHMARKS, REPRODUCTIONS
from configuration import DISTRIBUTION, Estimator, configure, configure_log, read_what_ran
from live import Reception, follow, make_prompt, new_folder, record_lives, stop_on_signals
from offline import open_log, smooth_log
from telling import Failure, counted, say, watch

if TYPE_CHECKING:
    from telemetry.messages import Message

BUS = "tcp/127.0.0.1:7447"
DEMO_FAULTS = "loss=0.005,outage=100:6"
DEMO_SPEED = 8.0


@dataclass(frozen=True)
class Receive:
    """How telemetry is received.

    Parameters
    ----------
    forward
        Where ground stations are, e.g. udpout:127.0.0.1:14551: they get every byte, and what they say goes to the
        vehicles; may be given again.
    dialect
        MAVLink dialect, one that pymavlink ships; that of the settings if not given.
    estimator
        What filters and smooths, ms or cubature; that of the settings if not given.
    signing_key
        File with the key that frames must be signed with: a passphrase, or 64 hexadecimal digits.
    accept_unsigned
        Let unsigned frames pass all the same.
    resume
        Go on with the sortie that is in the folder.
    idle
        Stop by itself after so many seconds without telemetry.
    """

    forward: list[str] = field(default_factory=list)
    dialect: str | None = None
    estimator: Estimator | None = None
    signing_key: Path | None = None
    accept_unsigned: bool = False
    resume: bool = False
    idle: float | None = None

    def begin(self, folder: Path, name: str, endpoints: Sequence[str], config: Path | None) -> Reception:
        """Listen, and archive what comes into the folder of a sortie."""
        if self.resume and (config or self.dialect or self.estimator):
            raise Failure("--resume goes on with the settings that ran, without --config, --dialect and --estimator")
        return Reception(
            folder,
            name,
            endpoints,
            configure(config, self.dialect, self.estimator),
            forward=self.forward,
            resume=self.resume,
            signing_key=self.signing_key,
            accept_unsigned=self.accept_unsigned,
        )


def live(
    *endpoint: str,
    sortie: str | None = None,
    folder: Path | None = None,
    config: Path | None = None,
    receive: Receive = Receive(),
) -> None:
    """Follow a flight: archive, estimate, smooth and record what arrives, until Ctrl-C.

    Leaves a sortie folder: raw.tlog (the evidence), live.rrd and its layer windows.rrd, report.json, sortie.toml.

    Parameters
    ----------
    endpoint
        Where telemetry comes from: udpin:HOST:PORT listens, udpout:HOST:PORT calls, tcp:HOST:PORT connects,
        tcpin:HOST:PORT accepts, serial:DEVICE:BAUD.
    sortie
        Name of the sortie; its start time if not given.
    folder
        Where to write; sorties/NAME if not given.
    config
        TOML file with settings.
    """
    if not endpoint and not receive.resume:
        raise Failure("say where telemetry comes from, e.g. sortie live udpin:127.0.0.1:14550")
    name, folder = new_folder(sortie, folder, resume=receive.resume)
    reception = receive.begin(folder, name, endpoint, config)
    where = ", ".join(reception.endpoints)
    again = f"; goes on after {reception.raw_log.size} bytes" if receive.resume else ""
    summary = follow(
        reception,
        name,
        folder,
        receive.idle,
        lambda: say(f"{name}: listening on {where}; writing to {folder}{again}; Ctrl-C ends"),
        say,
        again=receive.resume,
    )
    say(f"{folder}: {summary.completeness}; look at it with: sortie review {folder}")
    if not summary.vehicles:
        raise Failure(f"nothing was received on {where}")


def ingest(
    *endpoint: str,
    sortie: str,
    folder: Path,
    listen: str | None = None,
    connect: str | None = None,
    credentials: Path | None = None,
    config: Path | None = None,
    receive: Receive = Receive(),
) -> None:
    """The first of three processes: receive, archive and publish samples; carries the bus, unless a router does.

    Parameters
    ----------
    endpoint
        Where telemetry comes from.
    sortie
        Name of the sortie, the same in all three.
    folder
        Where raw.tlog goes.
    listen
        Endpoint of the bus for the other processes; tcp/127.0.0.1:7447 if neither is given.
    connect
        Endpoint of the router that carries the bus.
    credentials
        Folder of certificates, for a bus that leaves this machine.
    config
        TOML file with settings.
    """
    from telemetry.bus import Bus, publish

    if not endpoint and not receive.resume:
        raise Failure("say where telemetry comes from, e.g. sortie ingest udpin:127.0.0.1:14550 --sortie S --folder F")
    if listen and connect:
        raise Failure("--listen carries the bus and --connect joins one: give one of them")
    bus_at = connect or listen or BUS
    carries, joins = ([], [connect]) if connect else ([bus_at], [])
    role = "ingest" if connect else "router"
    name, folder = new_folder(sortie, folder, shared=True)
    with Bus(name, listen=carries, connect=joins, credentials=credentials, role=role) as bus:
        reception = receive.begin(folder, name, endpoint, config)
        try:
            stop_on_signals(reception.source.stop)
            say(f"{name}: listening on {', '.join(reception.endpoints)}, bus on {bus_at}")
            messages = watch(reception.messages(receive.idle), say, since=reception.since)
            drained = publish(bus, "ingest", messages)
            if not connect:
                bus.linger()  # the others still talk to one another over the bus that is carried here
            if not drained:
                raise Failure("a consumer on the bus had not processed everything in time; the raw log is whole")
        finally:
            reception.close()
    reception.refuse_loss()


def estimate(
    *,
    sortie: str,
    connect: str = BUS,
    credentials: Path | None = None,
    config: Path | None = None,
    estimator: Estimator | None = None,
) -> None:
    """The second of three processes: samples to estimates and windows.

    Parameters
    ----------
    sortie
        Name of the sortie.
    connect
        Endpoint of the bus.
    credentials
        Folder of certificates, for a bus that leaves this machine.
    config
        TOML file with settings, the one that sortie ingest has: sortie verify goes by that.
    estimator
        What filters and smooths, ms or cubature, as told to sortie ingest; that of the settings if not given.
    """
    from estimator.stage import estimate as run
    from estimator.stage import warm_up
    from telemetry.bus import Bus, serve

    configuration = configure(config, estimator=estimator)
    warm_up(configuration.estimate)
    make_prompt()

    def stage(messages: Iterable[Message]) -> Iterator[Message]:
        return run(watch(messages, say, every=False), configuration.estimate, beside=True)

    say(f"{sortie}: waiting for the bus on {connect}")
    with Bus(sortie, connect=[connect], credentials=credentials, role="estimate") as bus:
        say(f"{sortie}: estimating on {connect}")
        started = lambda subscription: stop_on_signals(subscription.stop)  # noqa: E731
        if not serve(bus, "estimate", ["ingest"], stage, started=started):
            raise Failure("a consumer on the bus had not processed every estimate in time, or the bus is gone")


def record(
    folder: Path, *, sortie: str, connect: str = BUS, credentials: Path | None = None, resume: bool = False
) -> None:
    """The third of three processes: write the recording.

    Parameters
    ----------
    folder
        Where live.rrd, windows.rrd and report.json go.
    sortie
        Name of the sortie.
    connect
        Endpoint of the bus.
    credentials
        Folder of certificates, for a bus that leaves this machine.
    resume
        Put the recordings in the place of those of before, which they hold too.
    """
    import viewer
    from telemetry.bus import Bus

    viewer.load()
    import viewer.recorder  # now, and not when the first data wait for it

    make_prompt()
    name, folder = new_folder(sortie, folder, shared=True)
    say(f"{name}: waiting for the bus on {connect}")
    with Bus(name, connect=[connect], credentials=credentials, role="record") as bus:
        subscription = bus.subscribe("record", ["ingest", "estimate"], health=True)
        say(f"{name}: recording from {connect} into {folder}")
        stop_on_signals(subscription.stop)
        told = partial(watch, tell=say)
        summary = record_lives(subscription, folder, name, {"bus": connect}, through=told, resume=resume)
        subscription.close()
    if summary is None or not summary.vehicles:
        raise Failure(f"nothing was heard of sortie {name} on {connect}")


def router(*, listen: list[str], credentials: Path | None = None, zenohd: bool = False) -> None:
    """Carry the bus between machines when no stage shall, until Ctrl-C.

    Parameters
    ----------
    listen
        Endpoints, e.g. tls/10.0.0.1:7447; off this machine only with certificates.
    credentials
        Folder of certificates: who shows none of them is refused, and a certificate allows what its role needs.
    zenohd
        Print the same as a configuration for any zenohd (zenohd -c FILE) and do nothing else.
    """
    from telemetry.bus.router import router_file, serve_router

    if zenohd:
        print(router_file(listen, credentials), end="")
        return
    stop = threading.Event()
    stop_on_signals(stop.set, "the bus")
    serve_router(listen, credentials, stop=stop, ready=lambda: say(f"carrying the bus on {', '.join(listen)}"))


def keys(folder: Path, *, host: list[str] | None = None, days: float = 365.0) -> None:
    """Make certificates for a bus that leaves this machine: one for every role, and the authority that signs them.

    Parameters
    ----------
    folder
        Where they go; each machine gets ca.pem and the two files of its own roles, and never the authority.
    host
        Name or address at which the router is called; may be given again. localhost and 127.0.0.1 always work.
    days
        How long they are good for.
    """
    from telemetry.keys import HOSTS, create

    if not days > 0:
        raise ValueError(f"--days {days}: more than 0 are needed")
    for path in create(folder, hosts=[*HOSTS, *(host or ())], days=days):
        print(path)


def doctor(
    *endpoint: str,
    folder: Path = Path("sorties"),
    connect: list[str] | None = None,
    credentials: Path | None = None,
    json: bool = False,
) -> None:
    """Look for what would stop a flight today: versions, ports, clocks, disk, bus.

    Parameters
    ----------
    endpoint
        Where telemetry would come from.
    folder
        Where sorties would be written.
    connect
        Endpoint of the router of the bus.
    credentials
        Folder of certificates.
    json
        Print JSON instead of a table.
    """
    import msgspec
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    from telemetry.doctor import examine

    role = "viewer" if credentials else None
    compiled = ("telemetry.ingest", "telemetry.archive", "estimator.stage")
    found = examine(folder, endpoint, connect or (), credentials=credentials, role=role, compiled=compiled)
    if json:
        print(msgspec.json.format(msgspec.json.encode([one._asdict() for one in found])).decode())
    else:
        table = Table(box=None, show_header=False)
        style = {"ok": "green", "warning": "yellow", "error": "red"}
        for level, what, text in found:
            table.add_row(Text(level, style[level]), what, Text(text))
        Console().print(table)
    if errors := [one for one in found if one.level == "error"]:
        raise Failure(f"{counted(len(errors), 'thing')} would stop a flight: {', '.join(one.what for one in errors)}")


def mark(action: Literal["start", "stop"], name: str, *, to: str = "udpout:127.0.0.1:14550", vehicle: int = 0) -> None:
    """Mark the start or stop of a test point from the ground while sortie live follows the flight.

    The mark is a STATUSTEXT of a ground station: it is kept in the raw log like everything else that arrives.

    Parameters
    ----------
    action
        start or stop.
    name
        Name of the test point.
    to
        Where sortie live listens: udpout:HOST:PORT for its udpin:HOST:PORT.
    vehicle
        MAVLink system id of the vehicle; every vehicle heard if not given.
    """
    from telemetry.marks import say as send

    text = send(to, action, name, vehicle)
    print(f"{action} of test point {name} for {f'vehicle {vehicle}' if vehicle else 'every vehicle'}: {text!r} to {to}")


def smooth(
    log: Path,
    *,
    output: Path | None = None,
    test_points: Path | None = None,
    config: Path | None = None,
    dialect: str | None = None,
    estimator: Estimator | None = None,
    bias_separation: bool = False,
    quiet: bool = False,
) -> None:
    """Smooth a log, each boot as a whole, into one recording.

    Parameters
    ----------
    log
        A .tlog, ArduPilot DataFlash (.bin, .log) or PX4 ULog (.ulg) file, or a sortie folder.
    output
        The recording to write; NAME.rrd in this folder if not given.
    test_points
        TOML or CSV file of test points (name, start, stop, vehicle), beside those that the log itself marks.
    config
        TOML file with settings.
    dialect
        MAVLink dialect, one that pymavlink ships; that of the settings if not given.
    estimator
        What filters and smooths, ms or cubature; that of the settings, or of what ran in the folder, if not given.
    bias_separation
        Also estimate biases and scale errors beside the states, as in Shi's eq. (17), and print both; of estimator ms.
    quiet
        Say nothing but the result.
    """
    configuration = configure_log(log, config, dialect, estimator)
    output = output or Path(log.resolve().name).with_suffix(".rrd")
    points = []
    if test_points:
        from telemetry.marks import read

        points = read(test_points)
    if bias_separation and _flying(configuration, log) != "ms":
        raise Failure("--bias-separation looks at the stretches of estimator ms: give it with --estimator ms")
    witness = _witness() if bias_separation else None
    tell = None if quiet else say
    summary = smooth_log(log, output, configuration, tell, test_points=points, begun=witness)
    print(
        f"{output}: {counted(len(summary.vehicles), 'vehicle')}, {counted(len(summary.windows), 'window')}, "
        f"{summary.completeness}"
    )
    alarms, findings = (
        sum(len(getattr(report, what)) for report in summary.reports) for what in ("alarms", "findings")
    )
    if tell and (alarms or findings):
        tell(f"{counted(alarms, 'alarm')} and {counted(findings, 'finding')} in its reports: sortie review {output}")
    if witness is not None:
        _separation(log, witness, tell)
    if not summary.windows:
        raise Failure(f"{log}: no satellite fix, so there is nothing to smooth; what could be read is in {output}")


def _flying(configuration: Any, log: Path) -> str:
    """The estimator that is going to smooth a log or sortie folder."""
    if configuration is None:
        configuration = read_what_ran(log).configuration if log.is_dir() else configure(None)
    return str(configuration.estimate.estimator)


def _witness() -> Any:
    from sims.experiments.separation import Witness

    return Witness()


def _separation(log: Path, witness: Any, tell: Callable[[str], None] | None) -> None:
    """Print parameters among the states and beside them, for every stretch of flight path that was smoothed."""
    from rich.console import Console

    from sims.experiments.separation import compare

    stretches = witness.steps()
    if not stretches:
        raise Failure(f"{log}: no flight path, so there are no biases to separate; its events say why")
    console = Console(highlight=False, width=max(Console().width, 120))
    for number, steps in enumerate(stretches, 1):
        seconds = float(steps.drive.dt.sum())
        console.print(f"\nstretch {number} of {len(stretches)}, mode {steps.flight.settings.mode}, {seconds:.1f} s")
        try:
            found = compare(steps, tell=tell)
        except ArithmeticError as error:  # there is no gate here that would begin anew
            console.print(f"not compared: {error}")
            continue
        console.print(found.table())
        console.print(found.forms_table())


def review(recording: Path, *, json: bool = False, plot: Path | None = None, against: Path | None = None) -> None:
    """Read a recording or a sortie folder back: what flew, what was lost, each window and why it closed.

    Parameters
    ----------
    recording
        An .rrd file or a sortie folder.
    json
        Print JSON instead of tables.
    plot
        Also draw a picture of it, a PNG.
    against
        Another recording of the same flight, e.g. by another --estimator: only tell how far apart their states are.
    """
    import msgspec
    from rich.console import Console

    if against:
        if plot:
            raise Failure("--against compares two recordings in figures: --plot draws one, without it")
        _agreement(recording, against, json)
        return
    from viewer.report import tell
    from viewer.review import review as read_back

    found = read_back(recording)
    if plot:
        from viewer.plot import plot as draw

        draw(recording, plot)
    if json:
        print(msgspec.json.format(msgspec.json.encode(found)).decode())
    else:
        tell(found, Console(soft_wrap=True))
        if plot:
            print(f"picture: {plot}")


def _agreement(recording: Path, against: Path, json: bool) -> None:
    """How far apart the states of two recordings are."""
    import msgspec
    from rich.console import Console

    from viewer.agreement import agreement, tell

    found = agreement(recording, against)
    if json:
        print(msgspec.json.format(msgspec.json.encode(found)).decode())
    else:
        tell(found, Console(soft_wrap=True))


def verify(folder: Path) -> None:
    """Prove that live equals replay: process the raw log of a sortie again and compare with its recording, bit for bit.

    Parameters
    ----------
    folder
        A sortie folder.
    """
    from estimator.stage import estimate
    from telemetry.messages import Estimate, Window
    from viewer.review import compare

    if not folder.is_dir():
        raise Failure(f"{folder} is no sortie folder: only a sortie that was followed live can be verified")
    log = open_log(folder)
    counts = {"estimates": 0, "windows": 0}

    def replayed() -> Iterator[Message]:
        for message in estimate(log.messages(), log.configuration.estimate):
            if isinstance(message, Estimate):
                counts["estimates"] += len(message.t)
            elif isinstance(message, Window):
                counts["windows"] += 1
            yield message

    differences = compare(folder, replayed())
    for difference in differences:
        print(difference)
    if differences:
        why = "if sortie estimate ran with another --config or --estimator than sortie ingest, that is why"
        places = counted(len(differences), "place")
        raise Failure(f"{folder}: the recording and the replay of its raw log differ in {places}; {why}")
    if not counts["estimates"]:
        raise Failure(f"{folder}: nothing was estimated, so nothing could be compared")
    print(f"{folder}: live equals replay, bit for bit: {counts['estimates']} estimates, {counts['windows']} windows")


def replay(log: Path, *, to: str, speed: float = 1.0, faults: str | None = None) -> None:
    """Send a log over UDP as it was received.

    Parameters
    ----------
    log
        A .tlog file, or a sortie folder.
    to
        udpout:HOST:PORT.
    speed
        Times real time; inf is as fast as a receiver can follow.
    faults
        What the link does to it, e.g. loss=0.02,outage=60:5.
    """
    import sims

    batches = open_log(log, framed=True).source.batches()
    frames = ((int(batch.t_rx[i]), batch.frame(i)) for batch in batches for i in range(len(batch)))
    sent = sims.send(frames, to, speed=speed, faults=faults)
    print(f"{counted(sent.datagrams, 'frame')} to {to} in {sent.took:.1f} s")


def sim(
    aircraft: str = "c172x",
    *,
    to: str,
    manoeuvre: str = "demo",
    sensors: str = "mems",
    speed: float = 1.0,
    faults: str | None = None,
    seed: int = 1,
    planet: Literal["wgs84", "flat"] = "wgs84",
    wind: tuple[float, float] = (-3.0, 4.0),
    turbulence: int = 0,
    gnss_delay: float = 0.0,
    dropout: list[str] | None = None,
    truth: Path | None = None,
) -> None:
    """Fly a simulated aircraft: MAVLink over UDP, a log, or arrays.

    Parameters
    ----------
    aircraft
        A JSBSim aircraft.
    to
        udpout:HOST:PORT; or a file: NAME.tlog, or NAME.npz with everything in arrays, truth and sensors.
    manoeuvre
        The flight plan.
    sensors
        mems, mems-vanes or fti.
    speed
        Times real time, on a socket.
    faults
        What the link does, e.g. loss=0.02,outage=60:5.
    seed
        The same seed flies the same flight, bit for bit.
    planet
        wgs84, or flat: a plane at rest.
    wind
        Steady wind, north and east, the way the air moves, m/s.
    turbulence
        0 (calm) to 7.
    gnss_delay
        By how much satellite fixes are late, s.
    dropout
        SENSOR:START:STOP in s, e.g. gnss:20:30; may be given again.
    truth
        Write the truth there, an .npz file.
    """
    import sims

    if not 0 <= turbulence <= 7:
        raise ValueError(f"--turbulence {turbulence}: it is 0 (calm) to 7")
    if not all(abs(part) <= 100.0 for part in wind):
        raise ValueError(f"--wind {wind[0]} {wind[1]}: two numbers of up to 100 m/s are needed")
    if faults and to.endswith(".npz"):
        raise ValueError("--faults are those of a link, and arrays have none: write to NAME.tlog or udpout:HOST:PORT")
    if truth and truth.suffix != ".npz":
        raise ValueError(f"--truth {truth}: it is an .npz file")
    late = {"gnss": gnss_delay} if gnss_delay else None
    dropouts = [_dropout(text) for text in dropout or ()]
    flight = sims.fly(
        aircraft,
        manoeuvre,
        sensors=sensors,
        seed=seed,
        planet=planet,
        wind=wind,
        turbulence=turbulence,
        latencies=late,
        dropouts=dropouts,
    )
    if truth:
        flight.truth.save(truth)
    if to.endswith(".npz"):
        flight.save(to)
        print(f"{to}: {(flight.truth.t[-1] - flight.truth.t[0]) * 1e-9:.1f} s of flight, truth and sensors")
    elif to.endswith(".tlog"):
        from sims.faults import apply

        count = sims.write_tlog(apply(sims.frames(flight), faults)[0], to, flight.start_utc)
        print(f"{to}: {counted(count, 'frame')}")
    else:
        sent = sims.send(sims.frames(flight), to, speed=speed, faults=faults)
        print(f"{sent.flown:.1f} s of flight, {counted(sent.datagrams, 'frame')} to {to} in {sent.took:.1f} s")


def _dropout(text: str) -> tuple[str, float, float]:
    """A sensor and the time it is silent, from SENSOR:START:STOP."""
    sensor, *times = text.split(":")
    try:
        start, stop = (float(time) for time in times)
    except ValueError:
        raise ValueError(f"--dropout {text}: SENSOR:START:STOP is needed, seconds from the start") from None
    return sensor, start, stop


def demo(*, folder: Path | None = None, speed: float = DEMO_SPEED, estimator: Estimator | None = None) -> None:
    """Fly a simulated aircraft, record and smooth it live, and compare everything with the truth.

    Parameters
    ----------
    folder
        Where the sortie goes; sorties/demo-TIME if not given.
    speed
        Times real time; everything else is as in flight: the socket, the bus, the stages.
    estimator
        What filters and smooths, ms or cubature; ms if not given.
    """
    from rich.console import Console

    import sims
    import sims.accuracy
    from sims.command import free_port

    console = Console(highlight=False, soft_wrap=True)
    name, folder = new_folder(
        datetime.now(UTC).strftime("demo-%Y%m%d-%H%M%S") if folder is None else folder.name, folder
    )
    console.print("flying a Cessna 172: two turns (TP 1), a climb with 6 s without radio (TP 2), a 3-2-1-1 (TP 3)")
    flight = sims.fly("c172x", "demo", sensors="mems", seed=1)
    flight.truth.save(folder / "truth.npz")
    port = free_port()
    endpoint = f"udpin:127.0.0.1:{port}"
    accuracy = sims.accuracy.Accuracy(flight)
    sender = threading.Thread(
        daemon=True,
        target=lambda: sims.send(sims.frames(flight), f"udpout:127.0.0.1:{port}", speed=speed, faults=DEMO_FAULTS),
    )

    def ready(bus: str) -> None:
        console.print(
            f"live, in three processes: MAVLink over {endpoint} at {speed:g}x real time -> zenoh over {bus} -> "
            f"estimator -> zenoh -> recording in {folder}"
        )
        sender.start()

    follow_apart(
        Reception(folder, name, [endpoint], configure(None, estimator=estimator)),
        name,
        folder,
        2.0,
        ready,
        lambda text: console.print("  " + text, markup=False),
        accuracy.live,
    )
    sender.join()
    console.print("post-sortie: the raw log once more, smoothed as a whole")
    smooth_log(folder, folder / "smoothed.rrd", None, None, through=accuracy.smoothed)
    verify(folder)
    console.print(accuracy.table())
    (folder / "accuracy.json").write_text(json.dumps(accuracy.figures(), indent=2))
    from viewer.plot import plot as draw

    draw(folder / "smoothed.rrd", folder / "smoothed.png")
    console.print(
        f"\nopen it:    {Path(sys.executable).parent / 'rerun'} {folder / 'live.rrd'} {folder / 'windows.rrd'}"
    )
    console.print(f"or:         {Path(sys.executable).parent / 'rerun'} {folder / 'smoothed.rrd'}")
    console.print(f"review it:  {Path(sys.argv[0])} review {folder}")
    console.print(f"picture:    {folder / 'smoothed.png'}", soft_wrap=True)


COMMANDS: tuple[Callable[..., None], ...] = (
    demo,
    live,
    mark,
    smooth,
    review,
    verify,
    replay,
    sim,
    ingest,
    estimate,
    record,
    router,
    keys,
    doctor,
)
PURPOSE = "Turn the telemetry of a test flight into a trustworthy flight path while the aircraft still flies."


def _overview() -> str:
    """The help of the whole command line."""
    lines = ["Usage: sortie COMMAND", "", PURPOSE, "", "Commands:"]
    about = [(command.__name__, inspect.getdoc(command) or "") for command in COMMANDS]
    about += [(f"bench {name}", inspect.getdoc(command) or "") for name, command in BENCHMARKS.items()]
    about += [(f"reproduce {name}", inspect.getdoc(command) or "") for name, command in REPRODUCTIONS.items()]
    lines += [f"  {name:14} {text.splitlines()[0]}" for name, text in about]
    lines += [
        "",
        "sortie COMMAND --help explains a command; --version tells the version; --debug shows where an error arose.",
    ]
    return "\n".join(lines)


def _application() -> Any:
    from cyclopts import App, Parameter

    app = App(name="sortie", help=PURPOSE, help_format="plaintext", version=lambda: version(DISTRIBUTION))
    for command in (live, ingest):
        command.__annotations__["receive"] = Annotated[Receive, Parameter(name="*")]
    Receive.__annotations__["forward"] = Annotated[list[str], Parameter(negative="")]
    sim.__annotations__["wind"] = Annotated[tuple[float, float], Parameter(negative="")]
    sim.__annotations__["dropout"] = Annotated[list[str] | None, Parameter(negative="")]
    smooth.__annotations__["output"] = Annotated[Path | None, Parameter(name=["--output", "-o"])]
    for command in COMMANDS:
        app.command(command)
    bench = App(name="bench", help="Measure speed and accuracy.", help_format="plaintext")
    for name, command in BENCHMARKS.items():
        bench.command(command, name=name)
    app.command(bench)
    reproduce = App(name="reproduce", help="Find what a paper printed again.", help_format="plaintext")
    for name, command in REPRODUCTIONS.items():
        reproduce.command(command, name=name)
    app.command(reproduce)
    return app


def main() -> None:
    """Run the command line: exit code 0 when the work is done, 1 when it failed, 2 when it was asked for wrongly."""
    code = _run(sys.argv[1:])
    if "zenoh" in sys.modules:
        # Its threads may be about to ask for the interpreter, and one that goes meanwhile takes the process with it
        # (SIGABRT, after the work is done). Everything of ours is closed by now.
        atexit._run_exitfuncs()
        with suppress(OSError):  # nobody may be listening any more
            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(code)
    if code:
        sys.exit(code)


def _run(arguments: list[str]) -> int:
    if not arguments or arguments[0] in ("--help", "-h"):
        print(_overview())
        return 0
    debug = "--debug" in arguments
    from cyclopts import CycloptsError

    try:
        _application()([a for a in arguments if a != "--debug"], exit_on_error=False, print_error=False)
    except CycloptsError as error:
        say(f"sortie: {' '.join(str(error).split())} (see sortie --help)")
        return 2
    except KeyboardInterrupt:
        say("sortie: interrupted")
        return 1
    except (Failure, OSError, ValueError) as error:
        if debug:
            raise
        say(f"sortie: {_line(error)}")
        return 1
    return 0


def _line(error: Exception) -> str:
    """One line for an error, with the file it is about."""
    if isinstance(error, OSError) and error.filename is not None and error.strerror:
        return f"{error.filename}: {error.strerror[0].lower()}{error.strerror[1:]}"
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    return " ".join(str(error).split()) or type(error).__name__


if __name__ == "__main__":
    main()
