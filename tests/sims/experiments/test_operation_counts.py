"""Tables 1 to 5 of Shi's paper: what they say, where they disagree, and what the running code counts beside them."""

import json

import pytest
from rich.console import Console

import bench
from sims.experiments import shi
from sims.experiments.counting import Operations
from sims.experiments.operation_counts import (
    ACCOUNTS,
    CONVENTION,
    LENGTH,
    WANT,
    Reproduction,
    case,
    count,
    figures,
    problem,
    run,
    windows,
)  # fmt: skip
from sims.experiments.operation_tables import tell
from sims.experiments.shi import METHODS, SIZES, Size

SMALL = Size(10, 2, 2)


@pytest.fixture(scope="module")
def small():
    return Reproduction((case(SMALL),))


@pytest.mark.parametrize("size", SIZES)
def test_the_rows_of_table_1_add_up_to_table_3(size):
    rows = sum((shi.evaluated(row, size) for row in shi.TABLE_1.values()), Operations())
    assert rows == shi.evaluated(shi.TABLE_3["MS"], size)


def test_table_4_is_tables_2_and_3_but_for_its_slips():
    slips = {
        (size, method): (slip.additions, slip.multiplications, slip.divisions)
        for size in SIZES
        for method in METHODS
        if (slip := shi.slip(method, size)) != Operations()
    }
    assert slips == {
        (Size(10, 2, 2), "FPS"): (0, 269, 0),
        (Size(10, 2, 2), "SS"): (0, 270, 0),
        (Size(10, 6, 6), "FPS"): (185, 0, 0),
        (Size(10, 6, 6), "SS"): (45, 0, 0),
        (Size(30, 4, 4), "MS"): (-13500, -13488, 0),
        (Size(30, 15, 15), "MS"): (-13500, -13290, 0),
        (Size(30, 15, 15), "FPS"): (0, 2925, 0),
        (Size(30, 30, 30), "MS"): (-13500, -12635, 0),
    }
    assert [shi.formulas("MS", size) for size in SIZES[3:]] == [
        Operations(99428, 102581, 355),
        Operations(171335, 176930, 1004),
        Operations(293375, 301910, 1889),
    ]


def test_a_formula_that_gives_no_whole_number_is_named():
    with pytest.raises(ValueError, match=r"no whole number of operations at \(3, 1, 1\)"):
        shi.evaluated(lambda n, p, m: (n / 2, p, m), Size(3, 1, 1))


def test_the_record_is_dense_and_in_its_steady_state():
    given = problem(SMALL, 2)
    assert all((array != 0.0).all() for array in given.model.values())
    assert (given.p0 != 0.0).all() and (given.z != 0.0).all() and (given.x0 != 0.0).all()


def test_the_paper_s_ratios(small):
    ratios = {rival: small.cases[0].ratios(rival) for rival in ("FPS", "SS")}
    assert [round(ratios[rival]["Table 4"], 2) for rival in ratios] == [1.72, 1.77]
    assert [round(ratios[rival]["formulas"], 2) for rival in ratios] == [1.69, 1.74]


def test_the_targets_are_met_at_the_smallest_size(small):
    assert [target.met for target in small.targets] == [True, True, True]
    assert small.cases[0].share(small.cases[0].ours) < 0.9


def test_a_rank_one_step_makes_the_rivals_cheaper(small):
    one = small.cases[0]
    for rival in ("FPS", "SS"):
        assert one.rank_one[rival].filter == one.per_component[rival].filter
        assert one.rank_one[rival].smoother.total < one.per_component[rival].smoother.total


def test_a_rank_one_step_takes_away_the_gain_where_there_is_as_much_noise_as_state():
    size = Size(10, 10, 10)
    ours = count("MS", size).both.total
    assert count("FPS", size, per_component_mwgs=True).both.total > 1.7 * ours
    assert count("FPS", size, per_component_mwgs=False).both.total < ours


def test_the_parts_of_the_filter_are_the_filter(small):
    ours = small.cases[0].ours
    assert sum(ours.parts.values(), Operations()) == ours.filter
    assert ours.parts["phi_j+1,0: product"] == small.cases[0].table_1["phi_j+1,0"]
    assert ours.parts["M: product"] == small.cases[0].table_1["M_j+1"]
    assert ours.parts["E: solves"] == small.cases[0].table_1["E_j"] + Operations(divisions=SMALL.n)
    assert ours.parts["the rest"].total < 0.02 * ours.filter.total


def arithmetic(tally):
    return sum((each.total for path, each in tally.arithmetic().items() if "coordinates.suspect" not in path), 0)


def test_every_closing_of_a_window_costs_the_same():
    given = problem(SMALL, 7)
    thrice, never = (arithmetic(run("ms", given, WANT, length)[1].tally) for length in (2, 2000))
    assert thrice - never == 3 * windows(SMALL).closing.total > 0


def test_the_window_rule_is_the_mean_of_cheap_steps_and_one_dear_one():
    once, rule, n = Operations(90, 2, 10), windows(SMALL).rule, SMALL.n
    dear = rule.total - 7 * once.total
    assert n * n < dear - once.total < 16 * n * n  # a few solutions with the factors at hand


def test_the_verdicts_say_what_they_leave_out(small):
    one, windows = small.cases[0], small.cases[0].windows
    assert one.ours.executed == one.ours.both.total + one.ours.structural["filter"] + one.ours.structural["smoother"]
    assert windows.per_step == pytest.approx(windows.rule.total / 8 + windows.closing.total / LENGTH)
    assert one.shares["executed, windows"] > one.shares["executed"] > one.shares["windows"] > one.share(one.ours)
    assert one.ratios("FPS")["executed"] == one.per_component["FPS"].executed / one.ours.executed
    for target in small.targets:
        assert [beside.account for beside in target.beside] == list(ACCOUNTS)
        assert target.met
        for found in (target.figures, *(beside.figures for beside in target.beside)):
            assert len(found) == len(small.cases)
    share = small.targets[0]
    assert [beside.met for beside in share.beside] == [beside.figures[0] <= 0.95 for beside in share.beside]


def test_storage_is_that_of_table_5(small):
    one = small.cases[0]
    n, p, _ = SMALL
    assert one.table_5 == {"MS": 152, "FPS": 146, "SS": 154}
    assert (one.ours.kept, one.ours.read) == (n * n + 2 * n * p + 2 * p, 0)
    for rival in ("FPS", "SS"):
        assert one.rank_one[rival].kept + one.rank_one[rival].read == one.table_5[rival]


def test_a_setting_that_no_kernel_knows_is_refused():
    with pytest.raises(RuntimeError, match="no kernel of ms has an argument per_component_mwgs"):
        count("MS", SMALL, per_component_mwgs=True)


def test_everything_can_be_printed_and_written(small, capsys):
    console = Console(width=400, record=True, highlight=False)
    tell(small, console)
    told = console.export_text()
    lines = told.splitlines()
    tables = [line for line in lines if line.startswith((" ", "met", "NOT MET"))]  # titles and caveats may be wrapped
    assert len(tables) > 50 and max(len(line.rstrip()) for line in tables) <= 120
    for words in ("Table 1", "Table 2", "Table 3", "Table 4", "Table 5", "+269", "+270", "the same as all of Table 1"):
        assert words in told
    assert [line.count(CONVENTION) for line in lines if line.startswith("met")] == [1, 1, 1]
    assert sum(line.startswith(("    met", "    NOT MET")) for line in lines) == 3 * len(ACCOUNTS)
    assert "rank-one" in told and "reconstructed" in told and "which needs no Y_j" in told
    found = json.loads(json.dumps(figures(small)))
    assert found["cases"][0]["size"] == {"n": 10, "p": 2, "m": 2}
    assert found["cases"][0]["slips"]["SS"]["multiplications"] == 270
    assert [target["met"] for target in found["targets"]] == [True] * 3


def test_the_command_prints_json(small, monkeypatch, capsys):
    monkeypatch.setattr("sims.experiments.operation_counts.tables", lambda told: small)
    bench.shi(json=True)
    assert json.loads(capsys.readouterr().out)["caveats"] == list(small.caveats)
    bench.shi()
    assert "Table 5" in capsys.readouterr().out
