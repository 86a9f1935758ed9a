"""Tang's square-root cubature filter with backward smoothing, found again: Tables 1 and 2, and what holds of them.

The paper [1]_ has 200 runs of the coordinated turn. What it printed is judged against what experiments of 200 runs give
here: the middle 95 % of such experiments, drawn with repetition from our runs (bootstrap), widened for the finite
number of ours. Intervals of our own figures are bootstrap intervals over all our runs. The formulas of the circulating
text are lost in part: SR-BS-CKF here is its most plausible reading (A); B, C and D are others.

References
----------
.. [1] X. Tang, X. Huang, M. Wu and H. Zhang, "Research on square root CKF / backward smoothing nonlinear filter",
   Journal of Academy of Armored Force Engineering, 2015 (2), 65-69.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sims.experiments.coordinated_turn import draw
from sims.experiments.stress import Verdict, verdicts
from sims.experiments.turn_batches import METHODS, Outcome, run
from sims.experiments.turn_costs import BASE, Cost, Range, measure

Array = NDArray[np.float64]

PAPER: Mapping[str, tuple[float, float, float]] = {  # Table 1: m, m/s, deg/s
    "sr_ckf": (24.9789, 14.0939, 1.4096),
    "a": (22.9108, 13.6139, 1.4018),
}
PAPER_GAINS = (10.0, 4.0, 1.0)  # per cent, as its text says
PAPER_RUNS = 200
PAPER_COST = (2.0, 3.0)  # times SR-CKF, as its text says; Table 2 is lost
QUANTITIES = ("position", "velocity", "turn rate")
UNITS = ("m", "m/s", "deg/s")

RESAMPLES = 1000
EDGE = 2.58  # sigma, 99 %


def gains(base: Sequence[float], other: Sequence[float]) -> tuple[float, ...]:
    """By how many per cent the figures of ``other`` are less."""
    return tuple(100.0 * (1.0 - b / a) for a, b in zip(base, other, strict=True))


@dataclass(frozen=True)
class Figures:
    """Of one method on some of the runs.

    Attributes
    ----------
    rmse : tuple of Range
        Position (m), velocity (m/s), turn rate (deg/s): root of the mean square over runs, mean over the steps.
    anees : Range
        Normalised estimation error squared over n; 1 if the covariance is right.
    gains : tuple of Range
        By how many per cent ``rmse`` is less than that of SR-CKF on the same runs.
    """

    rmse: tuple[Range, ...]
    anees: Range
    gains: tuple[Range, ...]


@dataclass(frozen=True)
class Row:
    """A method in Table 1.

    Attributes
    ----------
    name, label : str
    every : Figures
        Of all runs in which it did not stop.
    kept : Figures
        Of the runs that neither it nor, in gains, SR-CKF has lost.
    lost, stopped : int
        Runs.
    """

    name: str
    label: str
    every: Figures
    kept: Figures
    lost: int
    stopped: int


@dataclass(frozen=True)
class Claim:
    """What the paper says, what was found, and what that means: "reproduced", "not reproduced" and the like."""

    what: str
    paper: str
    found: str
    verdict: str


@dataclass(frozen=True)
class Reproduction:
    """Everything that was found.

    Attributes
    ----------
    runs, seed : int
    rows : list of Row
    expected : dict
        By name: what experiments of 200 runs give, as ``Figures``; "a" with all runs, "a kept" without those it loses.
    costs : list of Cost
    stress : list of Verdict
    claims : list of Claim
    """

    runs: int
    seed: int
    rows: list[Row]
    expected: dict[str, Figures]
    costs: list[Cost]
    stress: list[Verdict]
    claims: list[Claim]

    def row(self, name: str) -> Row:
        """The row of a method."""
        return next(row for row in self.rows if row.name == name)

    def cost(self, name: str) -> Cost:
        """The cost of a method."""
        return next(cost for cost in self.costs if cost.name == name)


def figures(weights: Array, squares: Array) -> Array:
    """RMSE of position, velocity and turn rate (deg/s), and ANEES, (k, 4), of runs with these weights (k, runs)."""
    k, runs = weights.shape
    sums = weights @ np.nan_to_num(squares).reshape(runs, -1)
    with np.errstate(invalid="ignore"):  # where no run is left
        means = (sums / weights.sum(axis=1, keepdims=True)).reshape(k, 4, -1)
    out = np.empty((k, 4))
    out[:, :3] = np.sqrt(means[:, :3]).mean(axis=2)
    out[:, 2] = np.degrees(out[:, 2])
    out[:, 3] = means[:, 3].mean(axis=1)
    return out


def resampled(runs: int, size: int, seed: int) -> Array:
    """How often each run is drawn in experiments of ``size`` runs, (RESAMPLES, runs), with repetition."""
    rng = np.random.default_rng([seed, size])
    return np.array([np.bincount(rng.integers(runs, size=size), minlength=runs) for _ in range(RESAMPLES)], float)


class Judge:
    """The figures of the methods of a batch, with intervals from experiments of ``size`` runs; None: as many as ran."""

    def __init__(self, outcomes: Mapping[str, Outcome], seed: int, size: int | None = None) -> None:
        self.outcomes = outcomes
        self.runs = len(outcomes[BASE].far)
        self.weights = resampled(self.runs, size or self.runs, seed)
        self.widened = 1.0 if size is None else float(np.sqrt(1.0 + size / self.runs))

    def _ranges(self, value: Array, many: Array) -> list[Range]:
        low, high, sigma = np.full((3, value.size), np.nan)
        for i in range(value.size):
            good = many[np.isfinite(many[:, i]), i]
            if good.size:
                low[i], high[i] = value[i] + self.widened * (np.percentile(good, [2.5, 97.5]) - value[i])
                sigma[i] = self.widened * good.std()
        return [Range(*(float(v) for v in each)) for each in zip(value, low, high, sigma, strict=True)]

    def _both(self, name: str, runs: Array) -> tuple[Array, Array]:
        squares = self.outcomes[name].squares
        return figures(runs[None, :], squares)[0], figures(self.weights * runs, squares)

    def of(self, name: str, kept: bool = False, base: str = BASE) -> Figures:
        """Of a method, its gains over ``base``; with ``kept`` without the runs that are lost."""
        own, other = self.outcomes[name], self.outcomes[base]
        runs = np.asarray(~(own.lost if kept else own.stopped), float)
        common = runs * ~(other.lost if kept else other.stopped)
        value, many = self._both(name, runs)
        told = self._ranges(value, many)
        base_value, base_many = self._both(base, common)
        if (common != runs).any():
            value, many = self._both(name, common)
        gain = self._ranges(100.0 * (1.0 - value / base_value), 100.0 * (1.0 - many / base_many))
        return Figures(tuple(told[:3]), told[3], tuple(gain[:3]))

    def row(self, name: str) -> Row:
        """A method's row of Table 1."""
        own = self.outcomes[name]
        lost, stopped = int(own.lost.sum()), int(own.stopped.sum())
        every = self.of(name)
        kept = self.of(name, kept=True) if own.lost.any() or self.outcomes[BASE].lost.any() else every
        return Row(name, METHODS[name].label, every, kept, lost, stopped)


def compare(
    runs: int = PAPER_RUNS, seed: int = 1, *, rounds: int = 7, threads: int | None = None,
    tell: Callable[[str], None] | None = None,
) -> Reproduction:  # fmt: skip
    """Run every method, measure, and judge what the paper says.

    Parameters
    ----------
    runs : int
    seed : int
        Everything but the times follows from these two.
    rounds : int
        Of timing.
    threads : int, optional
        None: as many as there are processors for this process.
    tell : callable, optional
        Called with a line about what is being done.

    Raises
    ------
    ValueError
        Fewer than two runs, or a negative seed.
    """
    if runs < 2:
        raise ValueError(f"--runs is {runs}: at least 2 are needed to say how sure the figures are")
    if seed < 0:
        raise ValueError(f"--seed is {seed}: it is 0 or more")
    say = tell or (lambda _: None)
    draws = draw(runs, seed)
    outcomes = {}
    for name, method in METHODS.items():
        say(f"{runs} runs: {method.label}")
        outcomes[name] = run(method, draws, threads)
    say("intervals")
    judge, paper = Judge(outcomes, seed), Judge(outcomes, seed, PAPER_RUNS)
    rows = [judge.row(name) for name in METHODS]
    expected = {BASE: paper.of(BASE), "a": paper.of("a"), "a kept": paper.of("a", True), "diplf": paper.of("diplf")}
    say("times")
    costs = measure(draws, rounds)
    found = Reproduction(runs, seed, rows, expected, costs, verdicts(), [])
    found.claims.extend(judged(found, judge))
    return found


def judged(found: Reproduction, judge: Judge) -> list[Claim]:
    """What the paper says, against what was found."""
    printed = gains(PAPER["sr_ckf"], PAPER["a"])
    claims = [_stated(printed)]
    base = found.expected[BASE]
    for i, quantity in enumerate(QUANTITIES):
        what = f"SR-CKF: {quantity} {PAPER[BASE][i]:.4g} {UNITS[i]}"
        claims.append(_against(what, PAPER[BASE][i], base.rmse[i], UNITS[i]))
    inside = [r.holds(v) for r, v in zip(base.rmse, PAPER[BASE], strict=True)]
    claims.append(_together("all three figures of SR-CKF together", "SR-CKF", inside))
    for i, quantity in enumerate(QUANTITIES):
        what = f"SR-BS-CKF: {quantity} {printed[i]:.2f} % better"
        for who in ("a kept", "a") if found.row("a").lost else ("a",):
            said = {"a kept": ", without lost runs", "a": ", with lost runs" if found.row("a").lost else ""}[who]
            claims.append(_against(what + said, printed[i], found.expected[who].gains[i], "%"))
    for who, label in (("a kept", "A" + (", without lost runs" if found.row("a").lost else "")), ("diplf", "DIPLF")):
        inside = [r.holds(v) for r, v in zip(found.expected[who].gains, printed, strict=True)]
        claims.append(_together("all three gains together", label, inside))
    claims += _iterating(judge)
    claims += [_honest(found), _cost(found), *_stronger(found)]
    return claims


def _stated(printed: Sequence[float]) -> Claim:
    own = ", ".join(f"{v:.2f}" for v in printed)
    close = all(abs(a - b) < 0.5 for a, b in zip(printed, PAPER_GAINS, strict=True))
    return Claim(
        "gains as stated in words", ", ".join(f"{v:g}" for v in PAPER_GAINS) + " %", f"its own table gives {own} %",
        "consistent" if close else "not what its table says",
    )  # fmt: skip


def _together(what: str, label: str, inside: Sequence[bool]) -> Claim:
    told = ", ".join(f"{q} {'in' if ok else 'not in'}" for q, ok in zip(QUANTITIES, inside, strict=True))
    verdict = "reproduced" if all(inside) else "not reproduced"
    if all(inside) and label == METHODS["diplf"].label:
        verdict = "in range, but the paper does not describe it"
    return Claim(what, label, f"{told} its range", verdict)


def _span(r: Range, digits: int = 2) -> str:
    return f"{r.value:.{digits}f} ({r.low:.{digits}f} .. {r.high:.{digits}f})"


def _against(what: str, printed: float, expected: Range, unit: str) -> Claim:
    """A printed figure against the middle 95 % of experiments of 200 runs."""
    off = (printed - expected.value) / expected.sigma
    far = f"{abs(off):.1f} sigma {'above' if off > 0.0 else 'below'}"
    if expected.holds(printed):
        verdict = "reproduced"
    elif printed * expected.value < 0.0 and not expected.holds(0.0):
        verdict = f"not reproduced: the sign is opposite, {far}"
    elif abs(off) < EDGE:
        verdict = f"at the edge: {far}"
    else:
        verdict = f"not reproduced: {far}"
    return Claim(what, f"{printed:.2f} {unit}", f"{_span(expected)} {unit}", verdict)


def _iterating(judge: Judge) -> list[Claim]:
    """More passes of A and of DIPLF, each against one pass of the same."""
    claims = []
    for base, others in (("a", ("a_2", "a_3", "a_5", "a_10")), ("diplf", ("diplf_2",))):
        told, better, worse = [], [], []
        for name in others:
            more = judge.of(name, True, base)
            told.append(f"{METHODS[name].repeats}: {_span(more.gains[0])} %, ANEES {more.anees.value:.2f}")
            better.append(more.gains[0].low > 0.0)
            worse.append(more.gains[0].high < 0.0)
        small = all(abs(judge.of(name, True, base).gains[0].value) < 0.5 for name in others)
        verdict = "holds" if all(better) and not small else "undecided"
        if small:
            verdict = "no difference worth a pass"
        elif worse[-1]:
            verdict = "does not hold: in the end it gets worse"
        claims.append(Claim(f"iterating improves further: {METHODS[base].label}", "better", "; ".join(told), verdict))
    return claims


def _honest(found: Reproduction) -> Claim:
    row = found.row("a")
    anees, inflated = row.kept.anees, found.row("a_inflated").every.anees
    verdict = "overconfident" if anees.low > 1.0 else "honest" if anees.holds(1.0) else "cautious"
    told = f"ANEES {_span(anees)}, {inflated.value:.2f} with R doubled; {row.lost} of {found.runs} runs lost"
    return Claim("covariance of SR-BS-CKF (z used twice)", "not looked at", told, verdict)


def _cost(found: Reproduction) -> Claim:
    ratio = found.cost("a").ratio
    assert ratio is not None
    low, high = PAPER_COST
    verdict = "holds" if ratio.low <= high and ratio.high >= low else "does not hold"
    return Claim("cost of SR-BS-CKF over SR-CKF", f"{low:g} to {high:g} times", _span(ratio) + " times", verdict)


def _stronger(found: Reproduction) -> list[Claim]:
    fails, bad = sum(v.plain_fails for v in found.stress), sum(v.square_root_fails for v in found.stress)
    worst = max((v.square_root_error for v in found.stress if v.square_root_error is not None), default=float("nan"))
    told = f"of {len(found.stress)} hard cases CKF fails in {fails}, SR-CKF in {bad}"
    stronger = bad < fails
    plain, root = found.row("ckf"), found.row(BASE)
    gap = max(abs(a.value / b.value - 1.0) for a, b in zip(plain.every.rmse, root.every.rmse, strict=True))
    needed = plain.stopped > root.stopped or gap > 1e-3
    return [
        Claim("square roots are stronger numerically", "stronger", f"{told}; sigma to {worst:.0e}",
              "holds" if stronger else "does not hold"),
        Claim("square roots are needed for Table 1", "implied",
              f"CKF stops in {plain.stopped} runs; figures differ by {gap:.0e}",
              "holds" if needed else "does not hold"),
    ]  # fmt: skip
