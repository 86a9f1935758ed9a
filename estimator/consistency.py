"""Consistency: whether errors are as large as a filter says, and whether a parameter was found at all.

If model and noise are right, the normalised innovations e / sqrt(S) of a measured quantity are independent and standard
normal. So the mean of their squares (NIS) is 1 within a chi-square band, and successive ones are not correlated. The
same holds, where the truth is known, of the errors of the states (NEES, coverage).

A long record makes the chi-square band so narrow that no real sensor stays inside: 10 000 scalars give 0.96 .. 1.04.
A channel is therefore called wrong only when it is outside the band *and* outside practical limits (`LAMP`, `LAG`).

References
----------
.. [1] Y. Bar-Shalom, X. R. Li, T. Kirubarajan, "Estimation with Applications to Tracking and Navigation", Wiley, 2001,
   section 5.4: NEES, NIS and the test of whiteness.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammainccinv, gammaincinv

from estimator.ud import compiled, exact

Floats = NDArray[np.float64]
Counts = NDArray[np.int64]

ABSENT, USED, WEAKENED, REJECTED = 0, 1, 2, 3

LEVEL = 0.99  # of the two-sided chi-square band
LAMP = (0.7, 1.4)  # practical limits of the mean NIS
LAG = 0.3  # practical limit of the correlation of successive innovations
SYSTEMATIC = (1.15, 0.15)  # NIS and correlation that together are a model that is wrong
BITS = 0.5  # information below which a parameter was not found: `parameter`
FAR = 4.0  # prior sigmas beyond which a parameter is no longer what the data sheet says
APART = 3.0  # sigmas beyond which test points contradict each other

HUGE = 1e100  # an innovation beyond is as wrong as this one, and its square is still a number

_LIMB = 32
_MASK = (1 << _LIMB) - 1
_UNIT = 1200  # the lowest limb counts in units of 2**-1200: below the last digit of any double
_LIMBS = (_UNIT + 1024) // _LIMB + 3


@exact
def _deposit(limbs: Counts, x: float) -> None:
    """Add a double to an integer of many limbs: exact, hence the same in every order."""
    fraction, exponent = math.frexp(abs(x))
    mantissa = np.int64(fraction * 9007199254740992.0)  # 2**53
    place = exponent - 53 + _UNIT
    limb, shift = place // _LIMB, place % _LIMB
    low, high = (mantissa & _MASK) << shift, (mantissa >> _LIMB) << shift
    sign = 1 if x > 0.0 else -1
    limbs[limb] += sign * (low & _MASK)
    limbs[limb + 1] += sign * ((low >> _LIMB) + (high & _MASK))
    limbs[limb + 2] += sign * (high >> _LIMB)


@exact
def _carry(limbs: Counts) -> None:
    """Bring every limb but the last into 0 .. 2**32 - 1: one number, one form; and no limb ever overflows."""
    for i in range(limbs.size - 1):
        limbs[i + 1] += limbs[i] >> _LIMB
        limbs[i] &= _MASK


@compiled
def _account(e: Floats, status: Counts, counts: Counts, ends: Floats, squares: Counts, products: Counts) -> None:
    for i in range(e.size):
        if status[i] == 0 or math.isnan(e[i]):
            continue
        if status[i] == 3:
            counts[2] += 1
            continue
        here = min(max(e[i], -HUGE), HUGE)
        if counts[0] == 0:
            ends[0] = here
        elif here * ends[1] != 0.0:
            _deposit(products, here * ends[1])
        if here * here != 0.0:
            _deposit(squares, here * here)
        ends[1] = here
        counts[0] += 1
        if status[i] == 2:
            counts[1] += 1
    _carry(squares)
    _carry(products)


def _number(limbs: Counts) -> int:
    """The integer that limbs hold, in units of ``2**-_UNIT``."""
    return sum(int(limb) << (_LIMB * i) for i, limb in enumerate(limbs.tolist()))


class Tally:
    """Running account of the normalised innovations of one measured quantity.

    Sums are exact integers, so the figures are the same to the last bit however the stream is cut, and whether it is
    taken in one piece or merged from several.
    """

    def __init__(self) -> None:
        self._counts = np.zeros(3, np.int64)  # used, weakened, rejected
        self._ends = np.full(2, np.nan)  # first and last used innovation
        self._squares = np.zeros(_LIMBS, np.int64)
        self._products = np.zeros(_LIMBS, np.int64)  # of successive ones

    def add(self, e: Floats, status: Counts) -> Tally:
        """Take innovations in their order of time.

        Parameters
        ----------
        e : float array, shape (k,)
            Signed innovation over its standard deviation; NaN is absent, whatever its status, and infinity counts as
            `HUGE`.
        status : int array, shape (k,)
            0 absent, 1 used, 2 used with noise that the gate has raised, 3 rejected.

        Returns
        -------
        Tally
            This one.

        Raises
        ------
        ValueError
            If the two have not one length, or a status is none of these.
        """
        e, status = np.ascontiguousarray(e, np.float64), np.ascontiguousarray(status, np.int64)
        if e.ndim != 1 or e.shape != status.shape:
            raise ValueError(f"innovations of shape {e.shape} with a status of shape {status.shape}: both are (k,)")
        if status.size and not (status.min() >= 0 and status.max() <= REJECTED):
            wrong = status[(status < 0) | (status > REJECTED)][0]
            raise ValueError(f"status {wrong} of an innovation: it is 0 absent, 1 used, 2 weakened or 3 rejected")
        _account(e, status, self._counts, self._ends, self._squares, self._products)
        return self

    def __add__(self, later: Tally) -> Tally:
        """Both in one account: what ``later`` has seen follows what this one has."""
        out = Tally()
        out._counts[:] = self._counts + later._counts
        out._squares[:] = self._squares + later._squares
        out._products[:] = self._products + later._products
        if self.used and later.used:
            seam = float(self._ends[1] * later._ends[0])
            if seam != 0.0:
                _deposit(out._products, seam)
        out._ends[0] = (self if self.used else later)._ends[0]
        out._ends[1] = (later if later.used else self)._ends[1]
        _carry(out._squares)
        _carry(out._products)
        return out

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Tally):
            return NotImplemented
        mine, theirs = (
            (*t._counts.tolist(), *t._ends.view(np.int64).tolist(), _number(t._squares), _number(t._products))
            for t in (self, other)
        )
        return mine == theirs

    __hash__ = None  # type: ignore[assignment]

    def __repr__(self) -> str:
        return f"Tally({self.used} used, {self.weakened} weakened, {self.rejected} rejected, NIS {self.nis})"

    @property
    def used(self) -> int:
        """Scalars absorbed, weakened ones among them."""
        return int(self._counts[0])

    @property
    def weakened(self) -> int:
        """Scalars absorbed with raised noise."""
        return int(self._counts[1])

    @property
    def rejected(self) -> int:
        """Scalars that the gate refused; they are in no mean."""
        return int(self._counts[2])

    @property
    def nis(self) -> float | None:
        """Mean of e^2 / S over the scalars used; None without any."""
        return _number(self._squares) / (self.used << _UNIT) if self.used else None

    @property
    def lag1(self) -> float | None:
        """Correlation of successive used innovations, sum e_i e_{i+1} / sum e_i^2; None for fewer than two.

        The mean is not taken off: it is zero if the model is right, and an offset is to show.
        """
        squares = _number(self._squares)
        return _number(self._products) / squares if self.used > 1 and squares else None


def band(scalars: int, level: float = LEVEL) -> tuple[float, float]:
    """Two-sided band of the mean of independent chi-square variables of one degree of freedom.

    Parameters
    ----------
    scalars : int
        How many; at least 1.
    level : float
        Probability of the band, between 0 and 1.

    Returns
    -------
    low, high : float
        ``chi2.ppf((1 -+ level) / 2, scalars) / scalars``.

    Raises
    ------
    ValueError
        If there is no scalar, or the level is no probability.
    """
    if scalars < 1:
        raise ValueError(f"a band for {scalars} scalars: it takes at least one")
    if not 0.0 < level < 1.0:
        raise ValueError(f"a band of level {level}: it lies between 0 and 1")
    tail = (1.0 - level) / 2.0
    half = scalars / 2.0
    return float(gammaincinv(half, tail)) / half, float(gammainccinv(half, tail)) / half


class Judged(NamedTuple):
    """What a `Tally` says.

    Parameters
    ----------
    verdict : str
        "consistent", "over-confident", "cautious", "not white" or "no data".
    why : str
        The number behind it, and advice.
    nis, low, high, lag1 : float or None
        Mean NIS, its chi-square band, correlation of successive innovations.
    """

    verdict: Literal["consistent", "over-confident", "cautious", "not white", "no data"]
    why: str
    nis: float | None
    low: float | None
    high: float | None
    lag1: float | None


def judge(tally: Tally, *, air_data: bool = False, level: float = LEVEL) -> Judged:
    """Judge the innovations of one measured quantity.

    Over-confident: mean NIS above the chi-square band and above 1.4; or above 1.15 while successive innovations are
    correlated beyond 0.15 and beyond ``3 / sqrt(scalars)``, three sigmas of chance. Cautious: below the band and below
    0.7. Not white: a correlation beyond 0.3 and beyond chance.

    Parameters
    ----------
    tally : Tally
    air_data : bool
        Whether gusts enter the quantity (airspeed, alpha, beta): a model of too weak gusts shows there as large and
        correlated innovations.
    level : float
        Of the chi-square band.
    """
    nis, lag1 = tally.nis, tally.lag1
    if nis is None:
        refused = f", {tally.rejected} refused by the gate" if tally.rejected else ""
        return Judged("no data", f"no scalar was used{refused}", None, None, None, None)
    low, high = band(tally.used, level)
    correlated = lag1 is not None and abs(lag1) > max(LAG, 3.0 / math.sqrt(tally.used))
    least, lasting = SYSTEMATIC
    systematic = nis > least and lag1 is not None and lag1 > max(lasting, 3.0 / math.sqrt(tally.used))
    lag = "" if lag1 is None else f", lag-1 {lag1:z.2f}"
    said = f"mean NIS {nis:.3g} of {tally.used} scalars (band {low:.2f} .. {high:.2f}){lag}"
    verdict: Literal["consistent", "over-confident", "cautious", "not white", "no data"]
    if nis > high and (nis > LAMP[1] or systematic):
        verdict = "over-confident"
        if not (correlated or systematic):
            advice = f"multiply its variance R by {nis:.3g} (its sigma by {math.sqrt(nis):.3g})"
        elif air_data:
            advice = "innovations are large and correlated: raise the turbulence sigma"
        else:
            advice = (
                "innovations are large and correlated: look for an offset, a delay or errors that last, "
                "before raising its noise"
            )
    elif nis < min(low, LAMP[0]):
        verdict = "cautious"
        advice = (
            "innovations are small and correlated: the quantity is smoothed, held or quantised before it arrives"
            if correlated
            else f"multiply its variance R by {nis:.3g} (its sigma by {math.sqrt(nis):.3g})"
        )
    elif correlated:
        verdict = "not white"
        advice = (
            f"beyond {LAG}: "
            + ("raise the turbulence sigma, or look for " if air_data and nis > 1.0 else "look for ")
            + "an offset, a delay, or errors that last longer than the time between samples"
        )
    else:
        verdict = "consistent"
        if low <= nis <= high:
            advice = ""
        else:
            advice = f"outside the band, but within the practical limits {LAMP[0]} .. {LAMP[1]}"
    if tally.rejected:
        share = tally.rejected / (tally.used + tally.rejected)
        advice = "; ".join(filter(None, [advice, f"{tally.rejected} ({share:.1%}) refused by the gate are in no mean"]))
    return Judged(verdict, f"{said}: {advice}" if advice else said, nis, low, high, lag1)


class Found(NamedTuple):
    """What a parameter is worth; fields as in the vocabulary: `parameter`."""

    value: float | None
    sigma: float | None
    gain: float
    z: float | None
    verdict: Literal["consistent", "inconsistent", "not observable"]
    why: str


def parameter(
    value: float,
    sigma: float,
    prior: float,
    others: Iterable[tuple[float | None, float | None]] = (),
    factor: float = 1.0,
) -> Found:
    """Judge the estimate of a constant whose expectation is zero: a bias, an offset, a scale error.

    It was not observable when the information gained, log2(prior / sigma), is below half a bit: there the data know
    less than the prior did (sigma^2 > prior^2 / 2), so the number is more assumption than measurement. It is
    inconsistent when it is further from zero than four prior sigmas, or more than three sigmas from the weighted mean
    of the other test points.

    Parameters
    ----------
    value, sigma : float
        Estimate and its standard deviation; not finite where there is none.
    prior : float
        Standard deviation before any measurement, about zero.
    others : iterable of (float or None, float or None)
        Value and sigma of the same parameter in other test points, as this function returned them (with the factor);
        None is passed over. They must be independent of this one: estimates of one filter that runs on are not.
    factor : float
        By how much the sigma is known to be too small: it is stated, and judged, multiplied by this.

    Returns
    -------
    Found
        value, sigma None when not observable; gain in bits, at least 0; z None without others.

    Raises
    ------
    ValueError
        If prior or factor is not positive and finite, or sigma is not positive.
    """
    for name, number in (("prior", prior), ("factor", factor)):
        if not (0.0 < number < math.inf):
            raise ValueError(f"{name} {number} of a parameter: it must be positive and finite")
    if sigma <= 0.0:
        raise ValueError(f"sigma {sigma} of a parameter: it must be positive; a constant that is known has no sigma")
    if not (math.isfinite(value) and math.isfinite(sigma)):
        return Found(None, None, 0.0, None, "not observable", "no estimate")
    stated = sigma * factor
    bits = math.log2(prior / stated)
    gain = max(bits, 0.0)
    doubled = "" if factor == 1.0 else f" (stated with {factor:g} times its sigma)"
    if bits < BITS:
        left = min(stated / prior, 1.0)
        why = f"{gain:.2f} bit gained, below {BITS}: sigma is still {left:.2f} of what it was before{doubled}"
        return Found(None, None, gain, None, "not observable", why)
    z = _apart(value, stated, others)
    distance = abs(value) / prior
    if distance > FAR:
        why = f"{distance:.1f} prior sigmas from zero, beyond {FAR:g}{doubled}"
        return Found(value, stated, gain, z, "inconsistent", why)
    if z is not None and abs(z) > APART:
        why = f"{abs(z):.1f} sigmas from the mean of the other test points, beyond {APART:g}{doubled}"
        return Found(value, stated, gain, z, "inconsistent", why)
    agrees = "" if z is None else f", {abs(z):.1f} sigmas from the other test points"
    why = f"{gain:.1f} bit gained, {distance:.1f} prior sigmas from zero{agrees}{doubled}"
    return Found(value, stated, gain, z, "consistent", why)


def _apart(value: float, sigma: float, others: Iterable[tuple[float | None, float | None]]) -> float | None:
    """Distance from the weighted mean of others, in sigmas of the difference."""
    known = [(v, s) for v, s in others if v is not None and s is not None and math.isfinite(v) and 0.0 < s < math.inf]
    if not known:
        return None
    # Weights relative to the best: 1 / s^2 itself leaves the range of doubles for the smallest sigmas.
    best = min(s for _, s in known)
    weight = [(best / s) ** 2 for _, s in known]
    mean = math.fsum(w * v for w, (v, _) in zip(weight, known, strict=True)) / math.fsum(weight)
    return (value - mean) / math.hypot(sigma, best / math.sqrt(math.fsum(weight)))


class Nees(NamedTuple):
    """Normalised estimation error squared of k samples.

    Parameters
    ----------
    values : float array, shape (k,)
        e^T P^-1 e over the known components; NaN where there is none.
    dof : int array, shape (k,)
        Known components.
    """

    values: Floats
    dof: Counts

    @property
    def mean(self) -> float:
        """Per degree of freedom, 1 if the covariance is right; NaN without any sample."""
        dof = int(self.dof.sum())
        return math.fsum(self.values[self.dof > 0].tolist()) / dof if dof else math.nan

    def band(self, level: float = LEVEL) -> tuple[float, float]:
        """Band of the mean if the k samples are independent; successive errors of one filter are not."""
        dof = int(self.dof.sum())
        return band(dof, level) if dof else (math.nan, math.nan)


def nees(error: Floats, covariance: Floats) -> Nees:
    """Normalised estimation error squared, chi-square with as many degrees of freedom as known components.

    Parameters
    ----------
    error : float array, shape (k, n)
        Estimate minus truth; NaN where a component is not known.
    covariance : float array, shape (k, n, n)
        NaN or inf on the diagonal where a component is not known: it is left out.

    Raises
    ------
    ValueError
        If the shapes do not fit, or the covariance of a sample is not positive definite; the text says which.
    """
    error, covariance = np.asarray(error, np.float64), np.asarray(covariance, np.float64)
    if error.ndim != 2 or covariance.shape != (*error.shape, error.shape[1]):
        raise ValueError(f"errors of shape {error.shape} with covariances of {covariance.shape}: (k, n) and (k, n, n)")
    variance = np.diagonal(covariance, axis1=1, axis2=2)
    known = np.isfinite(error) & np.isfinite(variance)
    values, dof = np.full(len(error), np.nan), known.sum(axis=1)
    if (bad := (known & (variance <= 0.0)).any(axis=1)).any():
        raise ValueError(f"covariance of sample {int(np.flatnonzero(bad)[0])}: a variance is not positive")
    for pattern in np.unique(known, axis=0):
        if not pattern.any():
            continue
        rows = np.flatnonzero((known == pattern).all(axis=1))
        std = np.sqrt(variance[rows][:, pattern])
        # Units differ by many decades; correlations do not.
        scaled = covariance[rows][:, pattern][:, :, pattern] / (std[:, :, None] * std[:, None, :])
        try:
            root = np.linalg.cholesky(scaled)
        except np.linalg.LinAlgError:
            least = np.linalg.eigvalsh(scaled)[:, 0]
            raise ValueError(f"covariance of sample {rows[int(least.argmin())]} is not positive definite") from None
        white = np.linalg.solve(root, (error[rows][:, pattern] / std)[:, :, None])[:, :, 0]
        values[rows] = np.square(white).sum(axis=1)
    return Nees(values, dof.astype(np.int64))


def zscores(error: Floats, std: Floats) -> Floats:
    """Errors in their own sigmas, of the shape of ``error``; NaN where one of the two is not finite."""
    error, std = np.asarray(error, np.float64), np.asarray(std, np.float64)
    known = np.isfinite(error) & np.isfinite(std)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(known, error / std, np.nan)


def coverage(error: Floats, std: Floats, width: float = 2.0) -> Floats:
    """Share of the errors within ``width`` sigmas, over the first axis; NaN where there is none.

    Parameters
    ----------
    error, std : float array, shape (k,) or (k, n)
        Samples that are not finite are left out.
    width : float
        2.0 should cover erf(2 / sqrt 2) = 0.954.

    Returns
    -------
    float array, shape () or (n,)
    """
    error, std = np.asarray(error, np.float64), np.asarray(std, np.float64)
    known = np.isfinite(error) & np.isfinite(std)
    inside = known & (np.abs(np.where(known, error, 0.0)) <= width * np.where(known, std, 0.0))
    with np.errstate(invalid="ignore"):
        return np.asarray(inside.sum(axis=0) / known.sum(axis=0))
