"""What would stop a flight today, and the way out, found before it does.

Everything is tried for real where that leaves no trace: ports are bound, a file is written through to the disk, a
message goes over the bus and comes back.
"""

from __future__ import annotations

import ctypes
import importlib
import math
import os
import platform
import resource
import socket
import stat
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal, NamedTuple

DISTRIBUTION = "sortie-telemetry"
RERUN = "0.41"
MB = 1_000_000
TRIAL = 16 * MB  # bytes written to measure the disk
FILES = 1024  # open files
MEMORY = 1_000 * MB
YEARS = 2025, 2100
STA_UNSYNC = 0x40  # linux/timex.h: the kernel's clock is not disciplined
TIMEX = 256  # bytes, more than struct timex has
MAXERROR, STATUS = 24, 40  # where its maximum error (long, us) and status (int) are on 64-bit Linux

Level = Literal["ok", "warning", "error"]


class Finding(NamedTuple):
    """One thing that was examined.

    Attributes
    ----------
    level : "ok", "warning" or "error"
        An error stops a flight, or loses it; a warning may.
    what : str
        The thing: a port, a folder, a package, ...
    text : str
        What was found and, unless it is ok, the way out.
    """

    level: Level
    what: str
    text: str


def examine(
    folder: str | Path,
    endpoints: Sequence[str] = (),
    connect: Sequence[str] = (),
    *,
    credentials: Path | None = None,
    role: str | None = None,
    reserve: int | None = None,
    seconds: float = 1.0,
    compiled: Sequence[str] = ("telemetry.ingest", "telemetry.archive"),
) -> list[Finding]:
    """Examine this machine for a flight.

    Parameters
    ----------
    folder : str or Path
        Where the sortie would be written; it need not exist.
    endpoints : sequence of str
        Where telemetry would come from and go to (`telemetry.sources.endpoint`).
    connect : sequence of str
        Endpoints of the router of the bus; without any, a bus inside one process is tried.
    credentials : Path, optional
        Folder with the certificates of the bus.
    role : str, optional
        Whose certificate to show.
    reserve : int, optional
        Bytes of free space below which there is an alarm; that of `telemetry.archive` if not given.
    seconds : float
        How long the clocks are compared.
    compiled : sequence of str
        Modules whose compiled functions, and those of what they import of the same package, should be ready.

    Returns
    -------
    list of Finding
        One or more of everything, whatever goes wrong on the way.
    """
    folder = Path(folder)
    clocks = time.time_ns(), time.monotonic_ns()
    tried: list[tuple[str, Callable[[], Iterator[Finding]]]] = [
        ("versions", _versions),
        ("rerun", _rerun),
        ("endpoints", lambda: _endpoints(endpoints)),
        ("loopback", _loopback),
        ("receive buffer", _receive_buffer),
        ("disk", lambda: _disk(folder, reserve)),
        ("compiled functions", lambda: _compiled(compiled)),
        ("machine", _machine),
        ("bus", lambda: _bus(connect, credentials, role)),
        ("clock", lambda: _clock(clocks, seconds)),
    ]
    findings: list[Finding] = []
    for what, look in tried:
        try:
            findings += look()
        except Exception as error:  # the next thing is examined all the same
            text = f"cannot be examined: {type(error).__name__}: {error}"
            findings.append(Finding("error", what, text))
    return findings


def _versions() -> Iterator[Finding]:
    from importlib.metadata import PackageNotFoundError, distribution, version

    try:
        ours = distribution(DISTRIBUTION)
    except PackageNotFoundError:
        yield Finding("error", DISTRIBUTION, "is not installed: pip install -e . in its folder")
        return
    from packaging.requirements import Requirement
    from packaging.specifiers import SpecifierSet

    asked, python = ours.metadata["Requires-Python"] or "", platform.python_version()
    good = SpecifierSet(asked).contains(python, prereleases=True)
    yield Finding("ok" if good else "error", "Python", python + ("" if good else f": {asked} is needed"))
    for text in ours.requires or []:
        requirement = Requirement(text)
        if requirement.marker and not requirement.marker.evaluate({"extra": ""}):
            continue
        try:
            found = version(requirement.name)
        except PackageNotFoundError:
            found = ""
        if found and requirement.specifier.contains(found, prereleases=True):
            yield Finding("ok", requirement.name, found)
        else:
            have = f"{found} is installed" if found else "is not installed"
            needed = f"{requirement.name}{requirement.specifier}"
            yield Finding("error", requirement.name, f"{have}: pip install '{needed}'")


def _rerun() -> Iterator[Finding]:
    try:
        found = str(importlib.import_module("rerun").__version__)
    except Exception as error:  # whatever a broken installation raises
        yield Finding("error", "rerun", f"cannot be imported ({error}): pip install 'rerun-sdk=={RERUN}.*'")
        return
    good = found.startswith(f"{RERUN}.")
    yield Finding(
        "ok" if good else "error", "rerun", found if good else f"is {found}: pip install 'rerun-sdk=={RERUN}.*'"
    )


def _endpoints(endpoints: Sequence[str]) -> Iterator[Finding]:
    from selectors import DefaultSelector

    from telemetry.sources.endpoint import parse_endpoint, resolve
    from telemetry.sources.port import Journal, open_port

    with ExitStack() as opened:  # all at once, as in flight: one port cannot serve two endpoints
        selector = opened.enter_context(DefaultSelector())
        for link, text in enumerate(endpoints):
            try:
                endpoint = parse_endpoint(text)
            except ValueError as error:
                yield Finding("error", text, str(error))
                continue
            if endpoint.scheme == "serial":
                yield _device(text, Path(endpoint.device))
                continue
            try:
                if endpoint.scheme in ("udpin", "tcpin"):
                    port = open_port(endpoint, link, selector, Journal(time.time_ns), two_way=False, ground=True)
                    opened.callback(port.close)
                    yield Finding("ok", text, "is free")
                else:  # a far end is not disturbed
                    _, address = resolve(endpoint, socket.SOCK_DGRAM)
                    yield Finding("ok", text, f"is {address[0]}; whether it answers was not tried")
            except OSError as error:
                yield Finding("error", text, error.strerror or str(error))


def _device(text: str, device: Path) -> Finding:
    if not device.exists():
        there = sorted(str(p) for p in Path("/dev/serial/by-id").glob("*"))
        return Finding("error", text, f"no device {device}: plug it in; there is {', '.join(there) or 'none'}")
    if not stat.S_ISCHR(device.stat().st_mode):
        return Finding("error", text, f"{device} is no serial device: see ls /dev/serial/by-id")
    if not os.access(device, os.R_OK | os.W_OK):
        return Finding("error", text, f"{device} is not ours to use: sudo usermod -aG dialout $USER, and log in again")
    return Finding("ok", text, "is there")


def _loopback() -> Iterator[Finding]:
    what = "loopback"
    try:
        with (
            socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as here,
            socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as there,
        ):
            here.bind(("127.0.0.1", 0))
            here.settimeout(2.0)
            there.sendto(b"sortie", here.getsockname())
            here.recv(16)
    except OSError as error:
        yield Finding("error", what, f"127.0.0.1 does not work ({error}): sudo ip link set lo up, and see the firewall")
        return
    yield Finding("ok", what, "127.0.0.1 works")


def _receive_buffer() -> Iterator[Finding]:
    from telemetry.sources.udp import RECEIVE_BUFFER

    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        for option in (getattr(socket, "SO_RCVBUFFORCE", 33), socket.SO_RCVBUF):  # the first needs a privilege
            try:
                sock.setsockopt(socket.SOL_SOCKET, option, RECEIVE_BUFFER)
                break
            except OSError:
                continue
        had = sock.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) // 2  # the kernel tells twice what it gives
    text = f"{had / MB:.1f} of {RECEIVE_BUFFER / MB:.1f} MB"
    if had < RECEIVE_BUFFER:
        way = f"sudo sysctl -w net.core.rmem_max={RECEIVE_BUFFER}"
        yield Finding("warning", "receive buffer", f"{text}: a burst may overflow it: {way}")
    else:
        yield Finding("ok", "receive buffer", text)


def _disk(folder: Path, reserve: int | None) -> Iterator[Finding]:
    from telemetry.archive import RESERVE

    reserve = RESERVE if reserve is None else reserve
    place = folder.absolute()
    while not place.exists():
        place = place.parent
    what = str(folder)
    if not place.is_dir():
        yield Finding("error", what, f"{place} is a file: choose another --folder")
        return
    try:
        with tempfile.TemporaryFile(dir=place) as file:
            begin = time.monotonic()
            file.write(bytes(TRIAL))
            file.flush()
            os.fsync(file.fileno())
            rate = TRIAL / (time.monotonic() - begin)
            took = []
            for _ in range(5):
                file.write(bytes(4096))
                file.flush()
                begin = time.monotonic()
                os.fsync(file.fileno())
                took.append(time.monotonic() - begin)
    except OSError as error:
        yield Finding("error", what, f"{place} cannot be written to ({error.strerror}): choose another --folder")
        return
    text = f"{rate / MB:.0f} MB/s written through, {max(took) * 1e3:.1f} ms for a small write"
    slow = rate < 5 * MB or max(took) > 1.0
    yield Finding(
        "warning" if slow else "ok", what, f"{text}: use a local disk, and stop what else writes" if slow else text
    )
    disk = os.statvfs(place)
    free = disk.f_bavail * disk.f_frsize
    text = f"{free / MB:.0f} MB free"
    if free < 4 * reserve:
        text += f", of which {reserve / MB:.0f} MB are a reserve: make room or choose another --folder"
    yield Finding("error" if free < reserve else "warning" if free < 4 * reserve else "ok", what, text)
    files = disk.f_favail if disk.f_files else 1000  # some file systems do not count
    if files < 100:
        yield Finding("error", what, f"{files} more files only: remove some or choose another --folder")


def _compiled(names: Sequence[str]) -> Iterator[Finding]:
    """Whether what numba compiles can be kept, and is: compiling everything anew takes about a minute."""
    what = "compiled functions"
    places: dict[Path, None] = {}
    missing = count = 0
    for name in names:
        importlib.import_module(name)
    packages = {name.partition(".")[0] for name in names}
    loaded = [module for name, module in sorted(sys.modules.items()) if name.partition(".")[0] in packages]
    for function in {id(f): f for module in loaded for f in vars(module).values() if _is_compiled(f)}.values():
        place, source = Path(function.stats.cache_path), Path(function.py_func.__code__.co_filename)
        places[place] = None
        code = function.py_func.__code__
        index = f"{function.py_func.__module__.rpartition('.')[2]}.{code.co_qualname}-{code.co_firstlineno}.py*.nbi"
        kept = [p for p in place.glob(index) if p.stat().st_mtime >= source.stat().st_mtime]
        count += 1
        missing += not kept
    for place in places:
        if place.exists() and not os.access(place, os.W_OK):
            way = "set NUMBA_CACHE_DIR to a folder that can"
            yield Finding("warning", what, f"{place} cannot be written to: every start takes about a minute: {way}")
    if missing:
        text = f"{missing} of {count} are not compiled yet: the first start takes up to a minute: start sortie once"
        yield Finding("warning", what, f"{text}, e.g. sortie demo")
    elif count:
        yield Finding("ok", what, f"{count} are kept in {', '.join(map(str, places))}")


def _is_compiled(thing: Any) -> bool:
    return hasattr(thing, "py_func") and bool(getattr(getattr(thing, "stats", None), "cache_path", None))


def _machine() -> Iterator[Finding]:
    cores = len(os.sched_getaffinity(0))
    yield Finding(
        "ok" if cores > 1 else "warning",
        "cores",
        f"{cores}" if cores > 1 else "1: estimating may hold up receiving: give it two",
    )
    memory = _available_memory()
    if math.isnan(memory):
        yield Finding("warning", "memory", "unknown: make sure that 1 GB is free")
    elif memory < MEMORY:
        yield Finding("warning", "memory", f"{memory / MB:.0f} MB available: end other programs until there is 1 GB")
    else:
        yield Finding("ok", "memory", f"{memory / MB:.0f} MB available")
    files, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    if files != resource.RLIM_INFINITY and files < FILES:
        yield Finding("warning", "open files", f"{files} at most: ulimit -n {FILES} before starting")
    else:
        yield Finding("ok", "open files", "unlimited" if files == resource.RLIM_INFINITY else f"{files} at most")


def _available_memory() -> float:
    """Bytes that can be had without swapping; NaN if the system does not say."""
    try:
        for line in Path("/proc/meminfo").read_text().splitlines():
            if line.startswith("MemAvailable:"):
                return 1024.0 * int(line.split()[1])
    except (OSError, ValueError, IndexError):
        pass
    return math.nan


def _bus(connect: Sequence[str], credentials: Path | None, role: str | None) -> Iterator[Finding]:
    import threading

    from telemetry import keys
    from telemetry.bus import session

    if credentials is not None:
        for role_there in sorted(path.stem for path in credentials.glob("*.pem") if path.stem != "ca"):
            certificate = f"certificate of {role_there}"
            if (why := keys.problem(credentials, role_there)) is not None:
                yield Finding("error", certificate, why)
            else:
                soon = keys.warning(credentials, role_there)
                yield Finding("warning" if soon else "ok", certificate, soon or "is good")
    what = f"bus on {', '.join(connect)}" if connect else "bus"
    try:
        bus = session.Bus("doctor", connect=connect, wait=2.0, credentials=credentials, role=role)
    except (OSError, ValueError) as error:
        yield Finding("error", what, str(error))
        return
    came = threading.Event()
    if connect:
        bus.close()
        yield Finding("ok", what, f"the router lets in {role or 'us'}")
        return
    with bus:
        key = f"{bus.root}/{os.getpid()}"
        subscriber: Any = bus.session.declare_subscriber(key, lambda _: came.set())
        bus.session.put(key, b"sortie")
        back = came.wait(2.0)
        subscriber.undeclare()
    text = "a message came back" if back else "a message did not come back: pip install --force-reinstall eclipse-zenoh"
    yield Finding("ok" if back else "error", what, text)


def _clock(begin: tuple[int, int], seconds: float) -> Iterator[Finding]:
    year = datetime.now(UTC).year
    if not YEARS[0] <= year < YEARS[1]:
        yield Finding("error", "date", f"the system clock says {year}: set it: sudo timedatectl set-ntp true")
    else:
        yield Finding("ok", "date", f"{datetime.now(UTC):%Y-%m-%d %H:%M} UTC")
    synchronised, error = _discipline()
    if synchronised is None:
        yield Finding("warning", "clock", "whether it is synchronised is unknown: see timedatectl")
    elif synchronised:
        yield Finding("ok", "clock", f"is synchronised, to {error:.3f} s at worst")
    else:
        text = "is not synchronised: receive times may be wrong by any amount: sudo timedatectl set-ntp true"
        yield Finding("warning", "clock", text)
    time.sleep(max(0.0, seconds - (time.monotonic_ns() - begin[1]) * 1e-9))
    now = time.time_ns(), time.monotonic_ns()
    drift = ((now[0] - begin[0]) - (now[1] - begin[1])) * 1e-9
    over = (now[1] - begin[1]) * 1e-9
    text = f"system and monotonic clock differ by {drift * 1e6:.0f} us over {over:.1f} s"
    if abs(drift) > 1e-3 * max(1.0, over):
        yield Finding("warning", "clock rate", f"{text}: the clock is being set: wait until it is synchronised")
    else:
        yield Finding("ok", "clock rate", text)


def _discipline() -> tuple[bool | None, float]:
    """Whether the kernel's clock is synchronised (None: unknown), and its maximum error, s (Linux's ``adjtimex``)."""
    if sys.platform != "linux" or ctypes.sizeof(ctypes.c_long) != 8:
        return None, math.nan
    told = ctypes.create_string_buffer(TIMEX)  # modes = 0: nothing is set
    try:
        if ctypes.CDLL(None, use_errno=True).adjtimex(told) < 0:
            return None, math.nan
    except (OSError, AttributeError):
        return None, math.nan
    error = int.from_bytes(told.raw[MAXERROR : MAXERROR + 8], sys.byteorder, signed=True) * 1e-6
    status = int.from_bytes(told.raw[STATUS : STATUS + 4], sys.byteorder)
    return not status & STA_UNSYNC, error
