"""Tables 1 to 5 of Shi's paper (`shi`), value by value, beside what the running code counts.

The information smoother (MS) and its rivals run on one dense, well-conditioned record in its steady state with
arithmetic that counts (`counting`): the source that is compiled for every other use, not formulas typed again. A step
is counted as the difference of two records, one a step longer than the other, so that beginning and end drop out; no
window closes within, and the coordinates are worked out at every step, not looked up.

What a step returns is the smoothed mean and standard deviations. The standard deviations, the residuals of the
measurements and the check that nothing has overflowed are part of the count of MS; the paper forms none of them. The
test whether a window must close is not part of the paper's method: it is counted apart (its estimate of a condition
number, due every eighth step, falls on neither record). Zeros and ones that are only stored are no arithmetic (see
`counting`). Square roots are part of every sum; the rivals take theirs after the sweep, where they are not counted: n.

SS and FPS pay one Gram-Schmidt orthogonalisation, n^3, for each noise component in the paper's account; a rank-one step
of n^2 does the same. Both are counted.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from sims.experiments import shi
from sims.experiments.counting import Counting, Operations, Path
from sims.experiments.shi import METHODS, SIZES, Size

if TYPE_CHECKING:
    from rich.console import Console

Array = np.ndarray[Any, np.dtype[np.float64]]

SOLVERS = {"MS": "ms", "FPS": "watanabe", "SS": "bierman", "RTS": "rts"}  # the names under which ``smooth`` has them
RIVALS = ("FPS", "SS")
# What a pass over the record is, by solver and outermost kernel. Whatever else a solver runs may cost nothing per step.
PASSES = {
    "ms": {
        "coordinates.move": "filter", "coordinates.observe": "filter", "sweeps.forward": "filter",
        "sweeps.backward": "smoother",
    },
    "watanabe": {"rivals.watanabe.backward": "filter", "rivals.watanabe.forward": "smoother"},
    "bierman": {"rivals.bierman.forward": "filter", "rivals.bierman.backward": "smoother"},
    "rts": {"rivals.rts.forward": "filter", "rivals.rts.backward": "smoother"},
}  # fmt: skip
RULE = ("coordinates.suspect", "coordinates.condition")  # kernels that judge whether a window must close
READ = {"ms": (), "watanabe": ("phi", "gamma", "q"), "bierman": ("phi", "gamma", "q"), "rts": ("phi",)}
# what the way back reads of the model again, which Table 5 counts as stored

Names = tuple[str, ...]
# Parts of the filter of MS: rows of Table 1, and the outermost kernel and how the innermost is called that do the same.
PARTS: Mapping[str, tuple[Names, tuple[str, str]]] = {
    "E: solves": (("E_j",), ("coordinates.move", "ud.solve")),
    "M: product": (("M_j+1",), ("coordinates.observe", "dot")),
    "noise: downdates": (("C_j", "U_q, D_q", "S_j", "B_j", "U_j+1/j, D_j+1/j"), ("sweeps.forward", "ud.bierman")),
    "measurements: updates": (("U_j+1, D_j+1", "x*_j"), ("sweeps.forward", "ud.agee_turner")),
    "phi_j+1,0: product": (("phi_j+1,0",), ("coordinates.move", "dot")),
    "phi_j+1,0^-1: LU": (("phi_j+1,0^-1",), ("coordinates.move", "ud.factor")),
}
OTHER = "the rest"

WANT = ("mean", "std")
SAVED = 0.95  # target: MS needs at most so much of what Table 4 says
GAINED = 1.7  # target, and the claim of the paper: the rivals need at least so many times more
SHOWN = (Size(10, 2, 2), Size(30, 15, 15))  # sizes at which Table 1 is printed row by row


class Problem(NamedTuple):
    """A dense record in its steady state: arguments of `LinearModel` per step, measurements, prior."""

    model: dict[str, Array]
    z: Array
    x0: Array
    p0: Array


def problem(size: Size, steps: int, seed: int = 1) -> Problem:
    """Return a record without a zero anywhere: phi is a rotation times 0.95, P_0 the steady state of the filter."""
    n, p, m = size
    rng = np.random.default_rng(seed)
    phi = 0.95 * np.linalg.qr(rng.normal(size=(n, n)))[0]
    gamma, h = rng.normal(size=(n, p)) / np.sqrt(n), rng.normal(size=(m, n)) / np.sqrt(n)
    q, r = rng.uniform(0.5, 1.5, p), rng.uniform(0.5, 1.5, m)
    covariance = np.eye(n)
    for _ in range(200):
        covariance = phi @ covariance @ phi.T + (gamma * q) @ gamma.T
        gain = np.linalg.solve(h @ covariance @ h.T + np.diag(r), h @ covariance)
        covariance = covariance - covariance @ h.T @ gain
        covariance = 0.5 * (covariance + covariance.T)
    constant = {"phi": phi, "gamma": gamma, "q": q, "h": h, "r": r}
    model = {name: np.repeat(array[None], steps, axis=0) for name, array in constant.items()}
    return Problem(model, rng.normal(size=(steps, m)), rng.normal(size=n), covariance)


@dataclass(frozen=True)
class Step:
    """What a step of a filter and its smoother costs, as counted.

    Attributes
    ----------
    filter, smoother : Operations
        Arithmetic, the window rule left out.
    rule : Operations
        Arithmetic of the test whether a window must close.
    structural : int
        Operations with stored zeros and ones.
    parts : dict
        The filter of MS by `PARTS`; empty for the others.
    kept, read : int
        Numbers stored for the way back, and numbers of the model that it reads again.
    """

    filter: Operations
    smoother: Operations
    rule: Operations
    structural: int
    parts: dict[str, Operations]
    kept: int
    read: int

    @property
    def both(self) -> Operations:
        """Filter and smoother."""
        return self.filter + self.smoother


def run(solver: str, given: Problem, want: Sequence[str] = WANT, **settings: Any) -> tuple[Any, Counting]:
    """Smooth a record with the counting copy of the estimator, and return `Smoothed` and the copy.

    A window of 2000 steps never closes here, and is too long for its coordinates to be tabulated.
    """
    counting = Counting(**settings)
    estimator = counting.module("estimator")
    model = estimator.LinearModel(**given.model)
    smoothed = estimator.smooth(model, given.z, x0=given.x0, p0=given.p0, method=solver, window=2000, want=want)
    if counting.unheard:
        raise RuntimeError(f"no kernel of {solver} has an argument {sorted(counting.unheard)[0]}")
    if smoothed.windows != [0]:
        raise RuntimeError(f"windows of {solver} began at {smoothed.windows}: what closing costs would be counted")
    return smoothed, counting


def count(method: str, size: Size, want: Sequence[str] = WANT, **settings: Any) -> Step:
    """Count one step in the middle of a window.

    Parameters
    ----------
    method : str
        "MS", "FPS", "SS" or "RTS".
    want : names of results, as for ``estimator.smooth``
    **settings
        For kernels, as for `Counting`: ``per_component_mwgs=True`` is the paper's account of SS and FPS.

    Raises
    ------
    RuntimeError
        Something is counted per step outside the passes that `PASSES` knows, a setting reaches no kernel, or a window
        closed.
    """
    solver = SOLVERS[method]
    # FPS begins without information: its factors are full when the measurements of n/m steps are in.
    steps = -(-size.n // size.m) if method == "FPS" else 1
    _, shorter = run(solver, problem(size, steps), want, **settings)
    given = problem(size, steps + 1)
    smoothed, longer = run(solver, given, want, **settings)
    none = Operations()
    before, idle = shorter.tally.arithmetic(), shorter.tally.structural()
    passes: dict[str, Operations] = {"filter": none, "smoother": none, "rule": none}
    parts = dict.fromkeys([*PARTS, OTHER], none) if method == "MS" else {}
    for path, whole in longer.tally.arithmetic().items():
        each = whole - before.get(path, none)
        if each == none:
            continue
        if path[0] not in PASSES[solver]:
            raise RuntimeError(f"{path[0]} costs {each.total} operations per step and is no pass of {solver}")
        now = "rule" if _judges(path) else PASSES[solver][path[0]]
        passes[now] += each
        if now == "filter" and parts:
            parts[_part(path)] += each
    structural = sum(
        (whole - idle.get(path, none)).total for path, whole in longer.tally.structural().items() if not _judges(path)
    )
    read = sum(given.model[name][0].size for name in READ[solver])
    kept = smoothed.bytes_per_step // smoothed.mean.itemsize
    return Step(**passes, structural=structural, parts=parts, kept=kept, read=read)


def _judges(path: Path) -> bool:
    """Was this done to decide whether a window must close?"""
    return any(name in RULE for name in path)


def _part(path: Path) -> str:
    """The part of the filter of MS that a path of kernels belongs to."""
    return next((name for name, (_, (a, z)) in PARTS.items() if path[0] == a and path[-1].startswith(z)), OTHER)


@dataclass(frozen=True)
class Case:
    """One size: the paper's tables and the counts.

    Attributes
    ----------
    table_1 : dict
        By row of the table.
    table_2, table_3, table_4 : dict
        By method; Table 4 as printed.
    slips : dict
        What Table 4 prints in excess of Tables 2 and 3, by method.
    table_5 : dict
        Numbers stored per step, by method.
    ours, ours_with_covariance : Step
        MS; with whole covariances instead of standard deviations.
    per_component, rank_one : dict
        FPS and SS, reconstructed, with one Gram-Schmidt per noise component and with a rank-one step for it.
    rts : Step
        Rauch, Tung and Striebel, dense.
    """

    size: Size
    table_1: dict[str, Operations]
    table_2: dict[str, Operations]
    table_3: dict[str, Operations]
    table_4: dict[str, Operations]
    slips: dict[str, Operations]
    table_5: dict[str, int]
    ours: Step
    ours_with_covariance: Step
    per_component: dict[str, Step]
    rank_one: dict[str, Step]
    rts: Step

    @property
    def sum_1(self) -> Operations:
        """All rows of Table 1."""
        return sum(self.table_1.values(), Operations())

    @property
    def formulas(self) -> dict[str, Operations]:
        """Table 2 and Table 3 together, by method: what Table 4 should say."""
        return {method: self.table_2[method] + self.table_3[method] for method in METHODS}

    @property
    def tabulated(self) -> tuple[Operations, Operations]:
        """MS without forming and factoring phi_{j,0}: by the paper's formulas, and counted."""
        paper, ours = self.formulas["MS"], self.ours.both
        for name, (rows, _) in PARTS.items():
            if rows[0] in shi.TABULATED:
                paper, ours = paper - self.table_1[rows[0]], ours - self.ours.parts[name]
        return paper, ours

    def ratios(self, rival: str) -> dict[str, float]:
        """Operations of a rival over those of MS, by each account."""
        ours = self.ours.both.total
        return {
            "Table 4": self.table_4[rival].total / self.table_4["MS"].total,
            "formulas": self.formulas[rival].total / self.formulas["MS"].total,
            "per component": self.per_component[rival].both.total / ours,
            "rank one": self.rank_one[rival].both.total / ours,
        }

    def share(self, step: Step) -> float:
        """Operations of a step of MS over those that Table 4 prints for it."""
        return step.both.total / self.table_4["MS"].total


def case(size: Size) -> Case:
    """The paper and the counts at one size of Table 4."""
    return Case(
        size=size,
        table_1={row: shi.evaluated(formula, size) for row, formula in shi.TABLE_1.items()},
        table_2={method: shi.evaluated(shi.TABLE_2[method], size) for method in METHODS},
        table_3={method: shi.evaluated(shi.TABLE_3[method], size) for method in METHODS},
        table_4=dict(shi.TABLE_4[size]),
        slips={method: shi.slip(method, size) for method in METHODS},
        table_5={method: shi.TABLE_5[method](*size) for method in METHODS},
        ours=count("MS", size),
        ours_with_covariance=count("MS", size, ("mean", "covariance")),
        per_component={rival: count(rival, size, per_component_mwgs=True) for rival in RIVALS},
        rank_one={rival: count(rival, size, per_component_mwgs=False) for rival in RIVALS},
        rts=count("RTS", size),
    )


class Target(NamedTuple):
    """A figure that was to be reached, and the figures at every size."""

    what: str
    met: bool
    figures: tuple[float, ...]


@dataclass(frozen=True)
class Reproduction:
    """All sizes, in the order of Table 4."""

    cases: tuple[Case, ...]

    @property
    def targets(self) -> tuple[Target, ...]:
        """What was to be reached, at every size."""
        share = tuple(one.share(one.ours) for one in self.cases)
        found = [Target(f"counted MS / MS of Table 4 <= {SAVED}", max(share) <= SAVED, share)]
        for rival in ("SS", "FPS"):
            gain = tuple(one.ratios(rival)["per component"] for one in self.cases)
            what = f"counted {rival}, one Gram-Schmidt per component / counted MS >= {GAINED}"
            found.append(Target(what, min(gain) >= GAINED, gain))
        return tuple(found)

    @property
    def caveats(self) -> tuple[str, ...]:
        """What the ratios do not say."""
        last = self.cases[-1]
        ratios = [last.ratios(rival)["rank one"] for rival in RIVALS]
        share = [one.share(one.ours_with_covariance) for one in self.cases]
        return (
            "Against rivals with a rank-one step for each noise component most of the gain at large p disappears: at "
            f"n,p,m = {_sized(last.size)} FPS needs {ratios[0]:.2f} times the operations of MS, SS {ratios[1]:.2f}.",
            "The block form that Tables 1 and 2 account for cannot reach Table 4: Table 2 leaves out forming Y_j "
            "(1.5 n^2 p) and the recursion of x* (2 n p). Counted here is the sequential form, which needs neither.",
            "SS and FPS are reconstructed from the tables of this paper: they are not the code of their authors.",
            "Counts of operations are not times: short dependent loops and divisions wait, dense products do not.",
            "MS is counted with standard deviations; the 1.5 n^3 of Table 2 pay for the factor phi U, D and not for "
            f"P. With whole covariances it is {min(share):.2f} to {max(share):.2f} of Table 4.",
        )


def tables(sizes: Sequence[Size] = SIZES, told: Callable[[Size], None] = lambda size: None) -> Reproduction:
    """Tables 1 to 5 at sizes of Table 4, printed and counted; ``told`` hears of each size before it is counted."""
    cases = []
    for size in sizes:
        told(size)
        cases.append(case(size))
    return Reproduction(tuple(cases))


def figures(found: Reproduction) -> dict[str, Any]:
    """Everything as plain values, for JSON."""
    cases = []
    for one in found.cases:
        paper, ours = one.tabulated
        cases.append(
            {
                **asdict(one),
                "size": one.size._asdict(),
                "sum_1": asdict(one.sum_1),
                "formulas": {method: asdict(each) for method, each in one.formulas.items()},
                "without_phi": {"formulas": paper.total, "counted": ours.total},
                "ratios": {rival: one.ratios(rival) for rival in RIVALS},
                "share": one.share(one.ours),
                "share_with_covariance": one.share(one.ours_with_covariance),
            }
        )
    targets = [target._asdict() for target in found.targets]
    return {"cases": cases, "targets": targets, "caveats": list(found.caveats)}


def tell(found: Reproduction, console: Console) -> None:
    """Print everything as tables, for people."""
    per_component = "FPS and SS counted with one Gram-Schmidt per noise component"
    tables = (
        *(_rows(one) for one in found.cases if one.size in SHOWN),
        _beside(found, f"Table 2, smoothers, and counted; {per_component}", lambda c: c.table_2, lambda s: s.smoother),
        _beside(found, f"Table 3, filters, and counted; {per_component}", lambda c: c.table_3, lambda s: s.filter),
        _beside(found, f"Table 4, both together, and counted; {per_component}", lambda c: c.table_4, lambda s: s.both),
        _slips(found),
        _others(found),
        _ratios(found),
        _claims(found),
        _storage(found),
    )
    for table in tables:
        title, table.title = table.title, None  # as wide as the console, not as the table
        console.print(title, style="bold")
        console.print(table)
    for target in found.targets:
        shown = ", ".join(f"{value:.2f}" for value in target.figures)
        console.print(f"{'met' if target.met else 'NOT MET'}: {target.what}: {shown}")
    console.print()
    for caveat in found.caveats:
        console.print(f"- {caveat}")


def _sized(size: Size) -> str:
    return ",".join(str(value) for value in size)


def _cells(each: Operations) -> list[str]:
    """Additions, multiplications, divisions and the sum of all."""
    return [str(value) for value in (each.additions, each.multiplications, each.divisions, each.total)]


def _table(title: str, columns: Sequence[str], left: Sequence[int] = (0,)) -> Any:
    from rich.box import SIMPLE
    from rich.table import Table

    table = Table(title=title, box=SIMPLE, pad_edge=False)
    for i, column in enumerate(columns):
        table.add_column(column, justify="left" if i in left else "right", no_wrap=i in left)
    return table


def _rows(one: Case) -> Any:
    """Table 1, and beside it the same work in the running code."""
    table = _table(
        f"Table 1, filter of MS at n,p,m = {_sized(one.size)}, and counted for the same work",
        ["of the paper", "add", "mul", "div", "sum", "in the code", "add", "mul", "div", "sum"],
        left=(0, 5),
    )
    empty = [""] * 5
    for name, (rows, _) in PARTS.items():
        for row in rows:
            counted = [name, *_cells(one.ours.parts[name])] if row == rows[-1] else empty
            table.add_row(row, *_cells(one.table_1[row]), *counted)
    table.add_row(*empty, OTHER, *_cells(one.ours.parts[OTHER]), end_section=True)
    table.add_row("all", *_cells(one.sum_1), "all", *_cells(one.ours.filter), style="bold")
    verdict = "the same" if one.sum_1 == one.table_3["MS"] else "NOT THE SAME"
    table.add_row("Table 3, MS", *_cells(one.table_3["MS"]), f"({verdict} as all of Table 1)", *empty[1:])
    table.add_row(*empty, "apart: window rule", *_cells(one.ours.rule))
    table.add_row(*empty, "apart: stored zeros and ones", "", "", "", str(one.ours.structural))
    return table


def _beside(
    found: Reproduction, title: str, paper: Callable[[Case], dict[str, Operations]], of: Callable[[Step], Operations]
) -> Any:
    """A table of the paper beside the counts."""
    table = _table(
        title, ["n,p,m", "", "add", "mul", "div", "sum", "counted: add", "mul", "div", "sum", "ratio"], left=(0, 1)
    )
    for one in found.cases:
        for method in METHODS:
            printed, counted = paper(one)[method], of(one.ours if method == "MS" else one.per_component[method])
            ratio = f"{counted.total / printed.total:.2f}"
            table.add_row(_sized(one.size), method, *_cells(printed), *_cells(counted), ratio)
        table.add_section()
    return table


def _slips(found: Reproduction) -> Any:
    table = _table(
        "Slips: what Table 4 prints in excess of Table 2 + Table 3 (everything else agrees)",
        ["n,p,m", "", "of", "Table 4", "Table 2 + 3", "slip", "", ""],
        left=(0, 1, 2, 6, 7),
    )
    for one in found.cases:
        for method in METHODS:
            printed, due = asdict(one.table_4[method]), asdict(one.formulas[method])
            for kind, slip in asdict(one.slips[method]).items():
                if slip:
                    much = f"{slip / printed[kind]:+.1%}"
                    cube = "n^3/2" if 2 * abs(slip) == one.size.n**3 else ""
                    row = [kind, str(printed[kind]), str(due[kind]), f"{slip:+d}", much, cube]
                    table.add_row(_sized(one.size), method, *row)
    return table


def _others(found: Reproduction) -> Any:
    table = _table(
        "Counted per step beyond the paper: rank-one rivals, RTS, and MS with whole covariances",
        ["n,p,m", "", "filter", "smoother", "add", "mul", "div", "sum"],
        left=(0, 1),
    )
    for one in found.cases:
        steps = {f"{rival}, rank one": step for rival, step in one.rank_one.items()}
        steps |= {"RTS": one.rts, "MS, covariances": one.ours_with_covariance}
        for name, step in steps.items():
            passes = [str(step.filter.total), str(step.smoother.total)]
            table.add_row(_sized(one.size), name, *passes, *_cells(step.both))
        table.add_section()
    return table


def _ratios(found: Reproduction) -> Any:
    table = _table(
        "Operations over those of MS: by Table 4; by Tables 2 + 3; counted as the paper charges the rivals (one "
        "Gram-Schmidt per noise component); counted with rank-one steps. Last: counted MS over MS of Table 4",
        ["n,p,m", "T.4: FPS", "SS", "T.2+3: FPS", "SS", "charged: FPS", "SS", "rank one: FPS", "SS", "RTS", "MS / T.4"],
    )
    for one in found.cases:
        by = [one.ratios(rival) for rival in RIVALS]
        rts, share = one.rts.both.total / one.ours.both.total, one.share(one.ours)
        table.add_row(_sized(one.size), *(f"{v:.2f}" for account in by[0] for v in (by[0][account], by[1][account])),
                      f"{rts:.2f}", f"{share:.2f}")  # fmt: skip
    return table


def _claims(found: Reproduction) -> Any:
    """The three claims in words of the paper, by each account."""
    table = _table(
        "Claims: 40 % fewer operations than FPS and SS; 50 % when phi_j,0 is a closed formula of j, which saves 20 % "
        "of the filter. Counted against rivals as the paper charges them",
        ["n,p,m", "T.4: FPS", "SS", "T.2+3: FPS", "SS", "no phi: FPS", "SS", "filter", "counted: FPS", "SS", "filter"],
    )
    for one in found.cases:
        paper, ours = one.tabulated
        by = [one.ratios(rival) for rival in RIVALS]
        cells = [1.0 - 1.0 / ratio[account] for account in ("Table 4", "formulas") for ratio in by]
        cells += [1.0 - paper.total / one.formulas[rival].total for rival in RIVALS]
        cells += [(one.formulas["MS"] - paper).total / one.table_3["MS"].total]
        cells += [1.0 - ours.total / one.per_component[rival].both.total for rival in RIVALS]
        cells += [(one.ours.both - ours).total / one.ours.filter.total]
        table.add_row(_sized(one.size), *(f"{cell:.0%}" for cell in cells))
    return table


def _storage(found: Reproduction) -> Any:
    table = _table(
        "Table 5, numbers stored per step, and really kept, together with those of the model that the way back reads",
        ["n,p,m", "MS", "kept", "FPS", "kept", "SS", "kept", "RTS kept"],
    )
    for one in found.cases:
        steps = {"MS": one.ours, **one.rank_one}
        cells = [v for method in METHODS for v in (one.table_5[method], steps[method].kept + steps[method].read)]
        table.add_row(_sized(one.size), *(str(v) for v in [*cells, one.rts.kept + one.rts.read]))
    return table
