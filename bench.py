"""The commands that measure and that find a paper's figures again: ``sortie bench`` and ``sortie reproduce``.

As in `sortie`, a command is a function, its docstring is its help, and nothing heavy is imported before it is needed.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

from offline import smooth_log
from telling import Failure, say


def smooth(log: Path | None = None) -> None:
    """Where the time of a smoothing goes: read, decode, estimate, write.

    Parameters
    ----------
    log
        A .tlog file; a simulated flight of 170 s if not given.
    """
    import tempfile

    import sims

    spent = {"read": 0.0, "decode": 0.0, "estimate": 0.0}

    def through(stage: str, stream: Iterable[Any]) -> Iterator[Any]:
        iterator = iter(stream)
        while True:
            begin = time.perf_counter()
            try:
                item = next(iterator)
            except StopIteration:
                return
            finally:
                spent[stage] += time.perf_counter() - begin
            yield item

    with tempfile.TemporaryDirectory() as folder:
        if log is None:
            log = Path(folder) / "c172x.tlog"
            flight = sims.fly("c172x", "demo")
            sims.write_tlog(sims.frames(flight), log, flight.start_utc)
        smooth_log(log, Path(folder) / "warm.rrd", None, None)
        spent = dict.fromkeys(spent, 0.0)
        begin = time.perf_counter()
        summary = smooth_log(log, Path(folder) / "out.rrd", None, None, through=through, overlap=False)
        total = time.perf_counter() - begin
        begin = time.perf_counter()
        smooth_log(log, Path(folder) / "again.rrd", None, None)
        overlapped = time.perf_counter() - begin
        size = log.stat().st_size
        written = (Path(folder) / "out.rrd").stat().st_size
    # Each stage pulls from the one before, so its time holds that of the one before.
    own = {
        "read": spent["read"],
        "decode": spent["decode"] - spent["read"],
        "estimate": spent["estimate"] - spent["decode"],
        "write": total - spent["estimate"],
    }
    frames = sum(account.frames for account in summary.byte_accounts)
    print(f"{log.name}: {size / 1e6:.1f} MB, {frames} frames -> {written / 1e6:.1f} MB, second run in one process")
    for stage, seconds in own.items():
        rate = frames / max(seconds, 1e-9) / 1e3
        print(f"  {stage:9} {seconds:7.3f} s  {100 * seconds / total:5.1f} %  {rate:8.0f} k frames/s")
    print(f"  {'all':9} {total:7.3f} s  100.0 %  {frames / total / 1e3:8.0f} k frames/s")
    print(f"  {'overlapped':10} {overlapped:6.3f} s   estimating and writing at the same time, as sortie smooth does")


def shi(*, json: bool = False) -> None:
    """Tables 1 to 5 of Shi's paper of 1991, beside the operations that the running code counts.

    Takes a minute: every operation of the smoother and of its rivals is done by numbers that count.

    Parameters
    ----------
    json
        Print JSON instead of tables.
    """
    import msgspec
    from rich.console import Console

    from sims.experiments.operation_counts import figures, tables
    from sims.experiments.operation_tables import tell

    found = tables(told=lambda size: say(f"counting a step of n = {size.n}, p = {size.p}, m = {size.m}"))
    if json:
        print(msgspec.json.format(msgspec.json.encode(figures(found))).decode())
    else:
        tell(found, Console(highlight=False, width=max(Console().width, 120)))  # a narrower one would cut digits


def tang(*, runs: int = 200, seed: int = 1, json: bool = False) -> None:
    """Tables 1 and 2 of Tang's paper of 2015, square-root cubature filtering with backward smoothing, beside ours.

    Says what reproduces and what does not, judged by what experiments as large as the paper's give. The figures follow
    from runs and seed; the times are measured.

    Parameters
    ----------
    runs
        Of the radar problem; the paper has 200.
    seed
        Of truths, measurements and intervals.
    json
        Print JSON instead of tables.
    """
    import msgspec
    from rich.console import Console

    from sims.experiments.tang import compare
    from sims.experiments.tang_tables import tell

    found = compare(runs, seed, tell=say)
    if json:
        print(msgspec.json.format(msgspec.json.encode(found)).decode())
    else:
        tell(found, Console(highlight=False, width=max(Console().width, 200)))


def linear(*, quick: bool = False, json: bool = False) -> None:
    """Our linear filters and smoothers beside those of other libraries: time per step, and what hard records leave.

    The other libraries come with the extra `peers`; those that are not installed are rows that say so.

    Parameters
    ----------
    quick
        Fewer sizes, fewer steps, fewer rounds.
    json
        Print JSON instead of tables.
    """
    import msgspec
    from rich.console import Console

    from sims.experiments.peers import FULL, QUICK, compare

    found = compare(QUICK if quick else FULL, tell=say)
    if json:
        print(msgspec.json.format(msgspec.json.encode(found)).decode())
        return
    console = Console(highlight=False, width=max(Console().width, 140))
    for what, value in found.machine.items():
        console.print(f"{what}: {value}", markup=False)
    for table in found.tables():
        console.print(table)


def long(*, steps: int = 2_000_000, folder: Path | None = None) -> None:
    """A record that does not fit in memory, smoothed exactly: time per step, memory, what is kept on disk.

    Needs 2.5 kB of disk per step while it runs.

    Parameters
    ----------
    steps
        Of a system with 12 states and 6 noise components, all matrices different from step to step; 4 or more.
    folder
        For the snapshots and the true states, which stay there; it must not hold those of an earlier run. Without it a
        temporary one.
    """
    from sims.experiments.long_record import FEWEST, M, N, run

    if steps < FEWEST:
        raise ValueError(f"--steps is {steps}: at least {FEWEST} are needed, {M} measurements each for {N} states")
    told = run(steps, folder, say)
    print(f"{told.steps:,} steps, {told.windows:,} windows: {told.disk / 1e9:.2f} GB of snapshots on disk")
    print(f"memory grew by {told.memory / 1e6:.0f} MB")
    filtering, smoothing = (seconds / steps * 1e6 for seconds in (told.filtering, told.smoothing))
    print(f"filter {filtering:.1f} us per step, smoother {smoothing:.1f} us per step")
    print(f"errors of the smoothed states: {told.error:.4f} of their sigmas, root mean square")


def extended(*, steps: int = 3000, rounds: int = 7, json: bool = False) -> None:
    """The smoother of the flight path beside a textbook extended RTS of the same model: time per step.

    Both are compiled and do the same work in one run; a line says how nearly their answers agree.

    Parameters
    ----------
    steps
        Of the simulated records, 100 a second.
    rounds
        The least time of so many counts.
    json
        Print JSON instead of a table.
    """
    import msgspec
    from rich.console import Console

    from sims.experiments.extended_speed import compare

    found = compare(steps, rounds, tell=say)
    if json:
        print(msgspec.json.format(msgspec.json.encode(found)).decode())
        return
    Console(highlight=False, width=max(Console().width, 130)).print(found.table())


def truth(*, seeds: int = 10, quick: bool = False, json: bool = False) -> None:
    """How accurate the flight path is in simulation, how honest its error bars, and which targets that meets.

    Aircraft x manoeuvres x sensors x air; every draw has gusts and sensor errors of its own. Takes minutes.

    Parameters
    ----------
    seeds
        Draws of every case in gusts; half as many in calm air.
    quick
        Two aircraft, one plan, three draws.
    json
        Print JSON instead of tables.
    """
    import msgspec
    from rich.console import Console
    from rich.progress import Progress

    from sims.experiments.truth_table import QUICK, Plan, compare

    plan = QUICK if quick else Plan(seeds=seeds)
    with Progress(console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("flying and reconstructing", total=None)
        found = compare(plan, progress=lambda done, of: bar.update(task, completed=done, total=of))
    if json:
        print(msgspec.json.format(msgspec.json.encode(found)).decode())
        return
    console = Console(highlight=False, width=max(Console().width, 190))
    for table in found.tables():
        console.print(table)
    console.print(f"{found.draws} flights, {found.took:.0f} s")


def withheld(*log: Path, json: bool = False) -> None:
    """Samples of a real flight withheld and predicted: satellite velocity and airspeed, beside interpolation.

    Parameters
    ----------
    log
        .tlog files with inertial samples at 20 Hz or more, satellite fixes and airspeed.
    json
        Print JSON instead of a table.
    """
    import msgspec
    from rich.console import Console

    from sims.experiments.withheld import compare, table

    if not log:
        raise Failure("say which flight, e.g. sortie bench withheld flight.tlog")
    found = compare(log, tell=say)
    if json:
        print(msgspec.json.format(msgspec.json.encode(found)).decode())
        return
    Console(highlight=False, width=max(Console().width, 170)).print(table(found))


def decode(*log: Path, dialect: str = "ardupilotmega", rounds: int = 3, json: bool = False) -> None:
    """Messages per second of our decoders and of pymavlink's, DFReader's and pyulog's, and what a live message costs.

    Parameters
    ----------
    log
        .tlog, DataFlash or ULog files; a simulated flight if not given.
    dialect
        MAVLink dialect of the .tlog files.
    rounds
        The least CPU time of so many counts.
    json
        Print JSON instead of tables.
    """
    import msgspec
    from rich.console import Console

    from sims.experiments.decode_speed import compare

    found = compare(log, dialect=dialect, rounds=rounds, tell=say)
    if json:
        print(msgspec.json.format(msgspec.json.encode(found)).decode())
        return
    console = Console(highlight=False, width=max(Console().width, 140))
    for what, value in found.machine.items():
        console.print(f"{what}: {value}", markup=False)
    for table in found.tables():
        console.print(table)


def pipeline(
    *, seconds: float | None = None, soak: bool = False, vehicles: int = 5, imu: int = 200, json: bool = False
) -> None:
    """The live pipeline under load, in one and in three processes: losses, age of the estimates, CPU and memory.

    Real processes, sockets and bus; a sender takes a part of a core. Ages mean little on a machine that does other
    work.

    Parameters
    ----------
    seconds
        Of each run that are measured; 60 if not given, 600 of a soak.
    soak
        One run in three processes, with what the sensors say and nothing beside, instead of six at 1, 5 and 20 thousand
        messages per second.
    vehicles
        Of the soak.
    imu
        Inertial samples per second of each vehicle of the soak, a divisor of 400.
    json
        Print JSON instead of tables.
    """
    import msgspec
    from rich.console import Console

    from sims.experiments.pipeline_speed import compare, run

    if soak:
        found = run(vehicles, imu, seconds or 600.0, say)
    else:
        found = compare(seconds=seconds or 60.0, tell=say)
    if json:
        print(msgspec.json.format(msgspec.json.encode(found)).decode())
    else:
        console = Console(highlight=False, width=max(Console().width, 160))
        for what, value in found.machine.items():
            console.print(f"{what}: {value}", markup=False)
        for table in found.tables():
            console.print(table)
    if soak and (faults := found.rows[0].faults):
        raise Failure(f"the soak did not pass: {', '.join(faults)}")


BENCHMARKS: dict[str, Callable[..., None]] = {
    "smooth": smooth,
    "decode": decode,
    "pipeline": pipeline,
    "linear": linear,
    "extended": extended,
    "long": long,
    "truth": truth,
    "withheld": withheld,
}
REPRODUCTIONS: dict[str, Callable[..., None]] = {"shi": shi, "tang": tang}
