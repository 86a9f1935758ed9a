"""The tables of `operation_counts`, drawn on a console: the paper's numbers, ours beside them, verdicts and caveats."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from estimator.coordinates import CHECK
from sims.experiments.counting import Operations
from sims.experiments.operation_counts import (
    ACCOUNTS,
    CONVENTION,
    LENGTH,
    OTHER,
    PARTS,
    RIVALS,
    SHOWN,
    Case,
    Reproduction,
    Step,
    sized,
)
from sims.experiments.shi import METHODS

if TYPE_CHECKING:
    from rich.console import Console


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
        _executed(found),
        _closing(found),
        _claims(found),
        _storage(found),
    )
    for table in tables:
        title, table.title = table.title, None  # as wide as the console, not as the table
        console.print(title, style="bold")
        console.print(table)
    for target in found.targets:
        verdict = "met" if target.met else "NOT MET"
        console.print(f"{verdict} ({CONVENTION}): {target.what}: {_listed(target.figures)}")
        for account, met, values in target.beside:
            console.print(f"    {'met' if met else 'NOT MET'} {ACCOUNTS[account]}: {_listed(values)}")
    console.print()
    for caveat in found.caveats:
        console.print(f"- {caveat}")


def _listed(values: Iterable[float]) -> str:
    return " ".join(f"{value:.2f}" for value in values)


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
        f"Table 1, filter of MS at n,p,m = {sized(one.size)}, and counted for the same work",
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
    rule = one.windows.rule
    kinds = (rule.additions, rule.multiplications, rule.divisions, rule.total)
    table.add_row(*empty, f"apart: rule, mean of {CHECK}", *(f"{kind / CHECK:.0f}" for kind in kinds))
    table.add_row(*empty, "apart: stored 0 and 1", "", "", "", str(one.ours.structural["filter"]))
    table.add_row(*empty, "(smoother: stored 0 and 1)", "", "", "", str(one.ours.structural["smoother"]))
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
            table.add_row(sized(one.size), method, *_cells(printed), *_cells(counted), ratio)
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
                    table.add_row(sized(one.size), method, *row)
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
            table.add_row(sized(one.size), name, *passes, *_cells(step.both))
        table.add_section()
    return table


def _ratios(found: Reproduction) -> Any:
    table = _table(
        "Operations over those of MS: by Table 4; by Tables 2 + 3; counted as the paper charges the rivals (one "
        "Gram-Schmidt per noise component); counted with rank-one steps. Last: counted MS over MS of Table 4",
        ["n,p,m", "T.4: FPS", "SS", "T.2+3: FPS", "SS", "charged: FPS", "SS", "rank one: FPS", "SS", "RTS", "MS / T.4"],
    )
    accounts = ("Table 4", "formulas", "per component", "rank one")
    for one in found.cases:
        rts, share = one.rts.both.total / one.ours.both.total, one.share(one.ours)
        cells = [one.ratios(rival)[account] for account in accounts for rival in RIVALS]
        table.add_row(sized(one.size), *(f"{v:.2f}" for v in [*cells, rts, share]))
    return table


def _executed(found: Reproduction) -> Any:
    """What the convention of leaving out zeros and ones hides."""
    table = _table(
        "As executed: operations with stored zeros and ones per step (FPS and SS charged); with them, operations over "
        "those of MS, and MS over MS of Table 4",
        ["n,p,m", "0 and 1: MS", "FPS", "SS", "RTS", "charged: FPS", "SS", "rank one: FPS", "SS", "RTS", "MS / T.4"],
    )  # fmt: skip
    for one in found.cases:
        steps = [one.ours, *(kind[rival] for kind in (one.per_component, one.rank_one) for rival in RIVALS), one.rts]
        idle = [str(sum(step.structural.values())) for step in (*steps[:3], steps[-1])]
        ratios = [step.executed / one.ours.executed for step in steps[1:]]
        table.add_row(sized(one.size), *idle, *(f"{v:.2f}" for v in [*ratios, one.shares["executed"]]))
    return table


def _closing(found: Reproduction) -> Any:
    """What windows cost, which the paper leaves out."""
    table = _table(
        f"Windows of MS: the rule per step (mean of {CHECK}), closing one, closing per step of a window of {LENGTH}; "
        "MS over MS of Table 4 within a window, with the rule, with both, and with both as executed",
        ["n,p,m", "rule", "closing", "per step", "within", "rule", "both", "executed"],
    )
    for one in found.cases:
        rule, closing = one.windows.rule.total / CHECK, one.windows.closing.total
        shares = one.shares
        ruled = (one.ours.both.total + rule) / one.table_4["MS"].total
        share = [shares["per component"], ruled, shares["windows"], shares["executed, windows"]]
        table.add_row(
            sized(one.size), f"{rule:.0f}", str(closing), f"{closing / LENGTH:.0f}", *(f"{v:.4f}" for v in share)
        )
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
        table.add_row(sized(one.size), *(f"{cell:.0%}" for cell in cells))
    return table


def _storage(found: Reproduction) -> Any:
    table = _table(
        "Table 5, numbers stored per step, and really kept, together with those of the model that the way back reads",
        ["n,p,m", "MS", "kept", "FPS", "kept", "SS", "kept", "RTS kept"],
    )
    for one in found.cases:
        steps = {"MS": one.ours, **one.rank_one}
        cells = [v for method in METHODS for v in (one.table_5[method], steps[method].kept + steps[method].read)]
        table.add_row(sized(one.size), *(str(v) for v in [*cells, one.rts.kept + one.rts.read]))
    return table
