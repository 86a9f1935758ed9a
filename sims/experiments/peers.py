"""Our filters and smoothers beside those of other libraries: time per step, and what is left of hard records.

Time is compared in one process, row after row and round after round on the same arrays, so that a busy moment of the
machine meets every row alike; the first call of each is left out, because it compiles. Nothing is timed without being
checked: `Timing.gap` is the worst deviation from the numpy reference. The hard records of `records.STRESS` are judged
against `records.truth`.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import platform
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sims.experiments.libraries import ABSENT, Estimates, Numpy, Ours, Peer, Refused, Run, others, ours
from sims.experiments.records import LIMITS, STRESS, Array, Record, Truth, benchmark, truth

if TYPE_CHECKING:
    from rich.console import Group
    from rich.table import Table

SIZES = ((6, 3, 3), (10, 2, 2), (12, 6, 6), (30, 4, 4), (30, 15, 15))
SETTINGS = ("one track, varying", "one track, constant", "64 tracks, constant")
NONE = "-"  # there is no such filter or smoother
TASKS = ("filter", "smooth")
CAPTIONS = {
    ("filter", ""): "ours give means and standard deviations, the others means and covariances; ms has to form them "
    "from a factor of the information, rts and joseph read them off the covariance that they propagate",
    ("filter", "constant"): "ms looks up phi_j,0 and E in a table of one window, made once, in the call not timed",
    ("smooth", "constant"): "ms looks up phi_j,0 and E in a table of one window, made once, in the call not timed",
}  # by task and what the setting says
BEYOND = "*: beyond what is promised"
UNCHECKED = (
    "; of 'ms' covariances are asked for here, which it gives unchecked: asked for std and "
    "filtered as well, as it is by default, smoothing compares the two and refuses this record"
)
AGREE = 1e-6  # sigma: a larger deviation is marked
MEAN_WRONG, STD_WRONG = 0.1, 0.05  # sigma, and relative: beyond these an answer is wrong and not merely inexact
TRIM_THRESHOLD, MMAP_THRESHOLD = -1, -3  # options of glibc's mallopt
BUDGET = 1.0  # seconds that all rounds of one row may take; at least two are run
VERSIONS = ("numpy", "numba", "filterpy", "pykalman", "statsmodels", "simdkalman", "dynamax", "cuthbertlib", "jax")


@dataclass(frozen=True)
class Effort:
    """How much is measured.

    Attributes
    ----------
    sizes : (n, p, m) of the records
    fast, slow : steps of a record for compiled and for interpreted loops
    tracks : steps where there are 64 tracks
    rounds : times that every row is measured
    """

    sizes: tuple[tuple[int, int, int], ...] = SIZES
    fast: int = 1000
    slow: int = 150
    tracks: int = 100
    rounds: int = 5


FULL = Effort()
QUICK = Effort(sizes=((6, 3, 3), (30, 4, 4)), fast=300, slow=60, tracks=30, rounds=3)


@dataclass(frozen=True)
class Timing:
    """One cell of the tables of time.

    Attributes
    ----------
    setting, size, peer, task : str
    microseconds : float or None
        Median over the rounds, per step and track.
    ratio : float or None
        To our "ms", median over the rounds.
    gap : float or None
        Worst deviation from the numpy reference, of the mean in sigma or of sigma relatively; None where it is
        infinite or NaN.
    finite : bool
        Whether every estimate was comparable: False with a ``gap`` of None.
    first : float or None
        Seconds of the first call: compilation, and one run.
    note : str
        Why there is no number.
    """

    setting: str
    size: str
    peer: str
    task: str
    microseconds: float | None = None
    ratio: float | None = None
    gap: float | None = None
    finite: bool = True
    first: float | None = None
    note: str = ""


@dataclass(frozen=True)
class Verdict:
    """What one estimator made of one hard record, against the truth.

    Attributes
    ----------
    record, peer, task : str
    negative : int
        Variances that are negative or zero.
    lost : int
        Epochs with an estimate that is NaN or infinite.
    asymmetry : float
        Of a covariance, in units of its own sigmas.
    mean : float or None
        Worst error of the mean, in true sigmas.
    std : float or None
        Worst relative error of sigma.
    note : str
        Why it was not run, or the first words of what it raised.
    raised : bool
    positive : bool
        Whether it answered, with nothing but finite estimates, positive variances and symmetric covariances.
    right : bool
        Whether mean and sigma are usable: positive, and neither is off by what an engineer would notice.
    """

    record: str
    peer: str
    task: str
    negative: int = 0
    lost: int = 0
    asymmetry: float = 0.0
    mean: float | None = None
    std: float | None = None
    note: str = ""
    raised: bool = False
    positive: bool = field(init=False)
    right: bool = field(init=False)

    def __post_init__(self) -> None:
        positive = self.mean is not None and not (self.negative or self.lost) and self.asymmetry <= STD_WRONG
        object.__setattr__(self, "positive", positive)
        right = positive and (self.mean or 0.0) < MEAN_WRONG and (self.std or 0.0) < STD_WRONG
        object.__setattr__(self, "right", right)


@dataclass(frozen=True)
class Comparison:
    """The numbers of one run.

    Attributes
    ----------
    machine : dict
        Processor, cores, load averages before and after, threads of BLAS, the allocator, versions.
    timings : list of Timing
    verdicts : list of Verdict
    """

    machine: dict[str, str]
    timings: list[Timing] = field(default_factory=list)
    verdicts: list[Verdict] = field(default_factory=list)

    def tables(self) -> list[Group]:
        """Time by setting and task, then what is left of the hard records."""
        timed = [
            self._times(setting, task)
            for setting in dict.fromkeys(t.setting for t in self.timings)
            for task in TASKS
            if any(t.microseconds for t in self.timings if (t.setting, t.task) == (setting, task))
        ]
        return timed + [self._judged(task) for task in TASKS if self.verdicts]

    def _times(self, setting: str, task: str) -> Group:
        from rich.table import Table

        what = "filter alone" if task == "filter" else "filter and smoother"
        caption = [text for (of, about), text in CAPTIONS.items() if of == task and about in setting]
        table = Table()
        cells = {(t.peer, t.size): t for t in self.timings if (t.setting, t.task) == (setting, task)}
        table.add_column("")
        sizes = list(dict.fromkeys(t.size for t in cells.values() if t.size))
        for size in sizes:
            table.add_column(f"n,p,m = {size}", justify="right")
        table.add_column("worst gap, sigma", justify="right")
        for peer in dict.fromkeys(t.peer for t in cells.values()):
            row = [cells.get((peer, size)) for size in sizes]
            if all(t is None or t.note == NONE for t in row):
                continue
            gaps = [t.gap for t in row if t is not None and t.gap is not None]
            gap = f"{max(gaps):.0e}" + ("" if max(gaps) <= AGREE else " ✗") if gaps else ""
            if not all(t is None or t.finite for t in row):
                gap = "not finite ✗"
            table.add_row(peer, *(_time(t) for t in row), gap)
        return _headed(f"{setting}: {what}, microseconds per step and track (times ours)", table, caption)

    def _judged(self, task: str) -> Group:
        from rich.table import Table

        chosen = [v for v in self.verdicts if v.task == task]
        records = list(dict.fromkeys(v.record for v in chosen))
        raised = list(dict.fromkeys(v.note for v in chosen if v.raised))
        letters = {note: chr(ord("a") + i % 26) for i, note in enumerate(raised)}
        beyond = {make().name for make in LIMITS}
        caption = [
            "worst error of mean (in true sigma) or sigma (relative); ✗: over 0.1 sigma or 5 %; "
            "N neg: variances not positive; N NaN: epochs lost; asym: covariances not symmetric; "
            "-: it has no such method, or does not take the record",
            "float32: error of sigma alone, for its means want deviations from a nominal",
        ]
        if beyond & set(records):
            caption.append(BEYOND + (UNCHECKED if task == "smooth" else ""))
        caption += [f"✗ ({letters[note]}): {note}" for note in raised]
        title = "filters" if task == "filter" else "smoothers"
        table = Table(padding=(0, 0))
        table.add_column("", min_width=23)
        for record in records:
            shown = f"{record}*" if record in beyond else record
            table.add_column(shown, justify="right", min_width=8, no_wrap=True)
        cells = {(v.peer, v.record): v for v in chosen}
        for peer in dict.fromkeys(v.peer for v in chosen):
            absent = any(v.note == ABSENT for v in chosen if v.peer == peer)
            name = f"{peer}: {ABSENT}" if absent else peer
            table.add_row(name, *(_cell(cells.get((peer, record)), letters) for record in records))
        return _headed(f"hard records, {title}", table, caption)


def _headed(title: str, table: Table, caption: Sequence[str]) -> Group:
    """A table between title and caption that are as wide as the console, not as the table."""
    from rich.console import Group
    from rich.text import Text

    return Group("", Text(title, "italic"), table, *(Text(line, "dim italic") for line in caption))


def _time(timing: Timing | None) -> str:
    if timing is None:
        return ""
    if timing.microseconds is None:
        return timing.note if len(timing.note) < 16 else timing.note[:13] + "..."
    ratio = f" ({timing.ratio:.2g}x)" if timing.ratio is not None and timing.ratio < 99.5 else ""
    if timing.ratio is not None and timing.ratio >= 99.5:
        ratio = f" ({timing.ratio:.0f}x)"
    return f"{timing.microseconds:.3g}{ratio}"


def _cell(verdict: Verdict | None, letters: dict[str, str]) -> str:
    if verdict is None:
        return ""
    if verdict.raised:
        return f"[red]✗ ({letters[verdict.note]})[/]"
    if verdict.mean is None or verdict.std is None:
        return "-"
    if verdict.lost:
        return f"[red]✗ {verdict.lost} NaN[/]"
    if verdict.negative:
        return f"[red]✗ {verdict.negative} neg[/]"
    if verdict.asymmetry > STD_WRONG:
        return "[red]✗ asym[/]"
    single = "float32" in verdict.peer
    error = verdict.std if single else max(verdict.mean, verdict.std)
    if error >= STD_WRONG if single else not verdict.right:
        return f"[red]✗ {error:.0e}[/]"
    return f"{error:.0e}" if error > AGREE else f"[green]{error:.0e}[/]"


def compare(
    effort: Effort = FULL,
    *,
    settings: Sequence[str] = SETTINGS,
    stress: Iterable[Callable[[], Record]] = (*STRESS, *LIMITS),
    peers: Sequence[Peer] | None = None,
    tell: Callable[[str], None] | None = None,
) -> Comparison:
    """Measure every row, then judge every row on the hard records.

    Parameters
    ----------
    effort : Effort
    settings : names of ``SETTINGS``
    stress : functions that make records
    peers : rows beside ours; None: all that are known, those that are not installed with a note
    tell : called with a line about what is being done
    """
    tell = tell or (lambda _: None)
    peers = others() if peers is None else peers
    before = _load()
    memory = _keep_memory()
    with _quiet(), _one_thread() as threads:
        mine: list[Peer] = [*ours(), Ours(dtype=np.float32)]
        verdicts = [v for make in stress for v in _judge_all(make(), [*mine, *peers], tell)]
        timings = [
            t for setting in settings for size in effort.sizes for t in _measure(setting, size, effort, peers, tell)
        ]
    machine = {
        "processor": _processor(),
        "cores": str(os.cpu_count()),
        "load average before, after": f"{before}, {_load()}",
        "BLAS threads": threads,
        "memory": memory,
        "versions": ", ".join(f"{name} {found}" for name in VERSIONS if (found := _version(name))),
    }
    return Comparison(machine, timings, verdicts)


def _measure(
    setting: str, size: tuple[int, int, int], effort: Effort, peers: Sequence[Peer], tell: Callable[[str], None]
) -> list[Timing]:
    """All rows of one setting and size, interleaved."""
    tell(f"{setting}, n,p,m = {_label(size)}")
    varying, many = "varying" in setting, "64" in setting
    steps = effort.tracks if many else effort.fast
    record = benchmark(*size, steps, tracks=64 if many else 1, varying=varying)
    short = record if many else record.cut(min(effort.slow, steps))
    lengths = {id(r): r for r in (record, short)}
    known = {key: [run() if run else None for run in Numpy().prepare(r)] for key, r in lengths.items()}
    found: dict[tuple[str, str], Timing] = {}
    runs: dict[tuple[str, str], tuple[Run, int]] = {}
    rows: list[Peer] = [*ours(), *peers]
    for peer in rows:
        if many and not peer.many:
            continue
        data = short if peer.slow else record
        blank = {task: Timing(setting, _label(size), peer.name, task) for task in TASKS}
        note = peer.available()
        try:
            prepared = (None, None) if note else peer.prepare(data)
        except Exception as error:  # a library that fails is a row that says so
            prepared, note = (None, None), _words(error)
        for task, run, reference in zip(TASKS, prepared, known[id(data)], strict=True):
            key = (peer.name, task)
            found[key] = replace(blank[task], note=note or NONE)
            if run is None or (task == "filter" and not peer.alone):
                continue
            begin = time.perf_counter()
            try:
                gap = deviation(run(), reference) if reference is not None else None
            except Exception as error:
                found[key] = replace(blank[task], note=_words(error))
                continue
            finite = gap is None or bool(np.isfinite(gap))
            first = time.perf_counter() - begin
            found[key] = replace(blank[task], gap=gap if finite else None, finite=finite, first=first)
            runs[key] = run, data.steps * data.tracks
    spent: dict[tuple[str, str], list[float]] = {key: [] for key in runs}
    for turn in range(effort.rounds):
        for key, (run, count) in runs.items():
            if turn < 2 or sum(spent[key]) * count < BUDGET:
                begin = time.perf_counter()
                try:
                    run()
                except Exception as error:
                    found[key] = replace(found[key], note=_words(error))
                    continue
                spent[key].append((time.perf_counter() - begin) / count)
    for (peer_name, task), each in spent.items():
        if not each:
            continue
        base = spent.get((rows[0].name, task))
        ratio = float(np.median([a / b for a, b in zip(each, base, strict=False)])) if base else None
        key = (peer_name, task)
        found[key] = replace(found[key], microseconds=float(np.median(each)) * 1e6, ratio=ratio)
    return list(found.values())


def _label(size: tuple[int, int, int]) -> str:
    return ",".join(str(v) for v in size)


def _deviations(estimates: Estimates) -> Array:
    if estimates.covariance is None:
        assert estimates.std is not None
        return estimates.std
    variance = np.einsum("...ii->...i", estimates.covariance)
    return np.sqrt(np.where(variance >= 0.0, variance, np.nan))


def deviation(estimates: Estimates, reference: Estimates) -> float:
    """Worst deviation of means in the reference's sigmas, and of sigmas relatively; NaN counts as infinite."""
    std = _deviations(reference)
    mean = np.abs((estimates.mean - reference.mean) / std).max()
    worst = np.maximum(mean, np.abs(_deviations(estimates) / std - 1.0).max())
    return float(worst) if np.isfinite(worst) else float("inf")


def _judge_all(record: Record, rows: Sequence[Peer], tell: Callable[[str], None]) -> list[Verdict]:
    tell(f"hard record: {record.name}")
    known = truth(record)
    verdicts = []
    for peer in rows:
        note, raised, prepared = peer.available(), False, None
        try:
            prepared = None if note else peer.prepare(record)
        except Refused as error:
            note = str(error)
        except Exception as error:
            note, raised = _words(error), True
        for task, run in zip(TASKS, prepared or (None, None), strict=True):
            if prepared is None:
                verdicts.append(Verdict(record.name, peer.name, task, note=note or "", raised=raised))
            else:
                verdicts.append(judge(record.name, peer.name, task, run, known))
    return verdicts


def judge(record: str, peer: str, task: str, run: Run | None, known: Truth) -> Verdict:
    """Run one estimator and compare the epochs 1..N with the truth, as far as anything can be known about them."""
    if run is None:
        return Verdict(record, peer, task, note="none")
    mean, std = (known.filtered_mean, known.filtered_std) if task == "filter" else (known.mean, known.std)
    mean, std = mean[1:], std[1:]
    try:
        found = run()
    except Refused as error:
        return Verdict(record, peer, task, note=str(error))
    except Exception as error:  # whatever a library raises is its answer
        if "needs x0 and p0" in str(error):
            return Verdict(record, peer, task, note="needs a prior")
        return Verdict(record, peer, task, note=_words(error), raised=True)
    known_here = np.isfinite(std).all(axis=1)
    x, std, mean = np.asarray(found.mean, float)[known_here], std[known_here], mean[known_here]
    asymmetry = 0.0
    if found.covariance is not None:
        cov = np.asarray(found.covariance, float)[known_here]
        variance = np.einsum("jii->ji", cov)
        skew = np.abs(cov - cov.transpose(0, 2, 1)) / (std[:, :, None] * std[:, None, :])
        asymmetry = float(np.nan_to_num(skew, nan=np.finfo(float).max).max(initial=0.0))
    else:
        assert found.std is not None
        variance = np.asarray(found.std, float)[known_here] ** 2
    fine = np.isfinite(x).all(axis=1) & np.isfinite(variance).all(axis=1)
    negative = int((variance[fine] <= 0.0).sum())
    sigma = np.sqrt(np.maximum(variance[fine], 0.0))
    return Verdict(
        record,
        peer,
        task,
        negative,
        int((~fine).sum()),
        asymmetry if fine.all() else 0.0,
        float(np.abs((x[fine] - mean[fine]) / std[fine]).max(initial=0.0)),
        float(np.abs(sigma / std[fine] - 1.0).max(initial=0.0)),
    )


def _words(error: Exception) -> str:
    """The first words of an error."""
    lines = str(error).strip().splitlines()
    text = lines[0] if lines else type(error).__name__
    return text if len(text) <= 100 else text[:97] + "..."


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Libraries warn where they fail; here the failure itself is the result."""
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        yield


@contextlib.contextmanager
def _one_thread() -> Iterator[str]:
    """Hold BLAS to one thread where `threadpoolctl` can; say what is."""
    try:
        from threadpoolctl import threadpool_limits
    except ImportError:
        own = {name: os.environ[name] for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS") if name in os.environ}
        yield ", ".join(f"{k}={v}" for k, v in own.items()) or "as the libraries choose (no threadpoolctl)"
        return
    with threadpool_limits(1):
        yield "1; XLA has its own pool"


def _keep_memory() -> str:
    """Let the allocator keep what is freed: the first touch of a new page costs more than a step of a small filter."""
    try:
        libc = ctypes.CDLL("libc.so.6")
        kept = libc.mallopt(TRIM_THRESHOLD, 1 << 30) and libc.mallopt(MMAP_THRESHOLD, 1 << 25)
    except (OSError, AttributeError):
        kept = 0
    return "freed memory is kept, so that no row pays for new pages" if kept else "as the allocator chooses"


def _load() -> str:
    return f"{os.getloadavg()[0]:.1f}" if hasattr(os, "getloadavg") else "unknown"


def _processor() -> str:
    with contextlib.suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()


def _version(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None
