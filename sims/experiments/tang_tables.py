"""What `tang` finds, drawn on a console: Tables 1 and 2 with the paper beside, and which of its claims hold."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from sims.experiments.coordinated_turn import FIRST, STEPS
from sims.experiments.tang import PAPER, PAPER_COST, PAPER_RUNS, RESAMPLES, Figures, Reproduction, Row, gains
from sims.experiments.turn_costs import Range

if TYPE_CHECKING:
    from rich.console import Console

PRINTED = {"sr_ckf": "paper: SR-CKF", "a": "paper: SR-BS-CKF"}
NOTES = (
    f"RMSE over runs, mean over steps {FIRST} to {STEPS}; ANEES: 1 if the covariance is right; gain: % less than",
    "  SR-CKF on the same runs; lost: position error ever above 500 m",
    f"in brackets: middle 95 % of {RESAMPLES} bootstrap experiments over runs; the more runs, the sharper the verdicts",
    "A is the most plausible reading of the paper, whose formulas are lost in part; B, C and D are others; DIPLF,",
    "  SR-CKS and fixed lag use every measurement once and are not of the paper",
)
HARD = "Hard cases: largest relative error of a standard deviation, against rational arithmetic"


def tell(found: Reproduction, console: Console) -> None:
    """Print everything as tables, for people."""
    for title, table in (
        (f"Table 1: {found.runs} runs, seed {found.seed}", _accuracy(found)),
        ("Table 2: CPU time per step (the paper's table is lost)", _costs(found)),
        (
            "Hard cases: largest relative error of a standard deviation, exact rational arithmetic beside",
            _stress(found),
        ),
        (f"What the paper says, and the middle 95 % of experiments of {PAPER_RUNS} runs here", _claims(found)),
    ):
        console.print(title, style="bold")
        console.print(table)
        if title.startswith("Table 1"):
            for note in NOTES:
                console.print(note)
            console.print()


def _table(*columns: str, left: int = 1) -> Any:
    from rich.box import SIMPLE
    from rich.table import Table

    table = Table(box=SIMPLE, pad_edge=False, padding=(0, 1))
    for i, column in enumerate(columns):
        table.add_column(column, justify="left" if i < left else "right", no_wrap=left == 1)
    return table


def _span(r: Range, digits: int) -> str:
    return f"{r.value:.{digits}f} [{r.low:.{digits}f} {r.high:.{digits}f}]"


def _accuracy(found: Reproduction) -> Any:
    table = _table(
        "", "position, m", "velocity, m/s", "turn, deg/s", "ANEES", "lost", "gain: position", "velocity", "turn, %"
    )
    for row in found.rows:
        if row.name in PAPER:
            printed = PAPER[row.name]
            gain = gains(PAPER["sr_ckf"], printed) if row.name == "a" else ()
            cells = [f"{v:.{d}f}" for v, d in zip(printed, (2, 2, 3), strict=True)]
            table.add_row(PRINTED[row.name], *cells, "", "", *(f"{v:+.2f}" for v in gain), style="dim")
        _add(table, row.label, row.every, row, str(row.lost) + (f", {row.stopped} stopped" if row.stopped else ""))
        if row.lost:
            _add(table, "  without lost runs", row.kept, row, "")
    return table


def _add(table: Any, label: str, of: Figures, row: Row, lost: str) -> None:
    rmse = [_span(r, d) for r, d in zip(of.rmse, (2, 2, 3), strict=True)]
    gain = [] if row.name == "sr_ckf" else [_gain(r, d) for r, d in zip(of.gains, (1, 1, 2), strict=True)]
    table.add_row(label, *rmse, _span(of.anees, 2), lost, *gain, style="bold" if row.name in PAPER else "")


def _gain(r: Range, digits: int) -> str:
    return f"{r.value:+.{digits}f} [{r.low:+.{digits}f} {r.high:+.{digits}f}]"


def _costs(found: Reproduction) -> Any:
    table = _table("", "microseconds", "times SR-CKF [least most]", "paper")
    for cost in found.costs:
        paper = "{:g} to {:g}".format(*PAPER_COST) if cost.name == "a" else ""
        if cost.seconds is None or cost.ratio is None:
            table.add_row(cost.label, cost.note, "", paper)
        else:
            table.add_row(cost.label, f"{1e6 * cost.seconds:.2f}", _span(cost.ratio, 2), paper)
    return table


def _stress(found: Reproduction) -> Any:
    table = _table("", "CKF", "SR-CKF")
    for one in found.stress:
        plain = f"{one.plain_error:.0e}" if one.plain_error is not None else f"stops at step {one.plain_stops}"
        table.add_row(one.case, plain, "stops" if one.square_root_error is None else f"{one.square_root_error:.0e}")
    return table


def _claims(found: Reproduction) -> Any:
    table = _table("claim", "paper", "here", "verdict", left=4)
    for claim in found.claims:
        table.add_row(claim.what, claim.paper, claim.found, claim.verdict)
    return table
