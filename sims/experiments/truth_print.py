"""The accuracy table for people."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from sims.experiments.scoring import BIASES, FILTER, HYBRID, HYBRID_T, KINEMATIC, METHODS, SMOOTHER
from sims.experiments.truth_table import LATELY, Case, Comparison

if TYPE_CHECKING:
    from rich.table import Table

UNITS = {"h": "m", **dict.fromkeys(("u", "v", "w", "airspeed"), "m/s"),
         **dict.fromkeys(("theta", "phi", "psi", "alpha", "beta"), "deg")}  # fmt: skip
CONSTANTS = ("k_airspeed", "b_alpha", "b_beta", "k_alpha", "k_beta", "wind_north", "wind_east")


def tables(found: Comparison) -> list[Table]:
    """Gusts, accuracy, consistency, constants, variants and targets."""
    groups = dict.fromkeys((c.sensors, c.air) for c in found.cases)
    out = [_gusts(found)] if found.gusts else []
    out += [_accuracy([c for c in found.cases if (c.sensors, c.air) == group], *group) for group in groups]
    return [*out, _consistency(found), _innovations(found), _constants(found), _variants(found), _targets(found)]


def _table(title: str, columns: list[str], *, left: int = 1, caption: str = "") -> Table:
    from rich.table import Table

    table = Table(title=title, title_justify="left", caption=caption or None, caption_justify="left")
    for i, column in enumerate(columns):
        table.add_column(column, justify="left" if i < left else "right", overflow="fold")
    return table


def _gusts(found: Comparison) -> Table:
    lags = [f"r({seconds:g} s)" for seconds in LATELY]
    table = _table(
        f"gusts, severity 3: north, east, down, {found.seeds} draws of each plan",
        ["", "std less mean, m/s", "rms of means, m/s", *lags, "fitted: m/s, s", "told: m/s, s"],
    )
    for aircraft, g in found.gusts.items():
        three = [" ".join(f"{v:.2f}" for v in g[name]) for name in ("std", "mean")]
        three += [" ".join(f"{v:.2f}" for v in g[f"after {seconds:g} s"]) for seconds in LATELY]
        told = g["told"]
        table.add_row(aircraft, *three, f"{g['sigma']:.2f}, {g['time']:.1f}", f"{told['sigma']:g}, {told['time']:g}")
    return table


def _accuracy(cases: list[Case], sensors: str, air: str) -> Table:
    methods = [m for m in METHODS if any(m in row for row in cases[0].rmse.values())]
    table = _table(
        f"RMSE after 10 s, {sensors}, {air}; {cases[0].draws} draws",
        ["", *methods, f"{SMOOTHER}/{FILTER}"],
        caption="hybrid: the default, mean wind predicted with the gusts; 'hybrid, T': gusts alone",
    )
    for case in cases:
        for quantity, unit in UNITS.items():
            row = case.rmse.get(quantity, {})
            scale = 180.0 / math.pi if unit == "deg" else 1.0
            ratio = row[SMOOTHER] / row[FILTER] if FILTER in row else math.nan
            table.add_row(
                f"{case.name} {quantity}, {unit}",
                *(f"{row[m] * scale:.3g}" if m in row else "" for m in methods), f"{ratio:.2f}",
            )  # fmt: skip
        table.add_section()
    return table


def _consistency(found: Comparison) -> Table:
    table = _table(
        "kinematic states: share of errors within 2 sigma, mean (worst draw and state); NEES per state; NEES jointly",
        ["", "coverage: filter", "smoother", "hybrid", f"NEES: {' '.join(KINEMATIC)} (hybrid)", "joint: f, s, hybrid"],
    )
    for case in found.cases:
        cells = []
        for method in (FILTER, SMOOTHER, HYBRID):
            mean = np.mean([case.cover[method][q] for q in KINEMATIC])
            worst = min(case.worst_cover[method][q] for q in KINEMATIC)
            cells.append(f"{mean:.3f} ({worst:.2f})")
        cells.append(" ".join(f"{case.nees[HYBRID][q]:.2f}" for q in KINEMATIC))
        cells.append(" ".join(f"{value:.2f}" for value in case.joint.values()))
        table.add_row(f"{case.sensors} {case.air} {case.name}", *cells)
    return table


def _innovations(found: Comparison) -> Table:
    channels = list(dict.fromkeys(q for c in found.cases for q in c.nis))
    table = _table("NIS / correlation of successive innovations", ["", *channels])
    for case in found.cases:
        cells = (f"{case.nis[q]:.2f}/{case.lag1[q]:.2f}" if q in case.nis else "" for q in channels)
        table.add_row(f"{case.sensors} {case.air} {case.name}", *cells)
    return table


def _constants(found: Comparison) -> Table:
    table = _table(
        "constants at the end, hybrid: rms of errors over sigma (largest), and by how many sigmas the pass moved kV",
        ["", "ba", "bg", *CONSTANTS, "kV moved"],
    )
    for case in found.cases:
        z = case.z[HYBRID]
        groups = [BIASES[:3], BIASES[3:], *((name,) for name in CONSTANTS)]
        cells = []
        for group in groups:
            all_z = [value for name in group for value in z.get(name, [])]
            cells.append(f"{np.sqrt(np.mean(np.square(all_z))):.2f} ({np.abs(all_z).max():.1f})" if all_z else "")
        table.add_row(f"{case.sensors} {case.air} {case.name}", *cells, f"{case.moved:.2f}")
    return table


def _variants(found: Comparison) -> Table:
    methods = (SMOOTHER, HYBRID_T, HYBRID)
    table = _table(
        "what relinearising does: smoother / gusts predicted / gusts and mean wind predicted (the default)",
        ["", "V m/s", "alpha deg", "beta deg", "z rms of kV", "coverage, kinematic"],
    )
    for case in found.cases:
        if HYBRID_T not in case.cover:
            continue
        cells = []
        for quantity, scale in (("airspeed", 1.0), ("alpha", 180.0 / math.pi), ("beta", 180.0 / math.pi)):
            cells.append(" / ".join(f"{case.rmse[quantity][m] * scale:.3g}" for m in methods))
        z = (case.z[m].get("k_airspeed", []) for m in methods)
        cells.append(" / ".join(f"{np.sqrt(np.mean(np.square(values))):.2f}" for values in z))
        cells.append(" / ".join(f"{np.mean([case.cover[m][q] for q in KINEMATIC]):.3f}" for m in methods))
        table.add_row(f"{case.sensors} {case.air} {case.name}", *cells)
    return table


def _targets(found: Comparison) -> Table:
    table = _table("targets", ["", "wanted", "found", ""], left=4)
    for target in found.targets:
        table.add_row(target.what, target.wanted, target.found, "met" if target.met else "missed")
    return table
