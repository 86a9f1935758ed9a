"""One simulated record against its truth: the errors of every method, and whether their error bars say so.

Methods are the sensors themselves, a Savitzky-Golay filter, and what ``passes`` makes of the record. Errors count after
the first ten seconds, which the start may take to settle. Airspeed and flow angles are no states: they follow from
velocity, attitude, mean wind and gust, at the inertial sensors. Those of the sensors are compared with the truth where
the sensors are, which favours them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.signal import savgol_filter

from estimator.consistency import coverage, judge, nees, zscores
from estimator.models.flight_path import PARAMETERS
from estimator.stage import Settings
from sims import points
from sims.experiments.passes import Passes, Path, Record, prepare
from sims.flight import Flight
from sims.states import truth_states
from sims.vocabulary import messages

Floats = NDArray[np.float64]

SETTLED = 10.0  # s after the start
KINEMATIC = ("h", "u", "v", "w", "theta", "phi", "psi")
AIR = ("airspeed", "alpha", "beta")
BIASES = ("ba_x", "ba_y", "ba_z", "bg_x", "bg_y", "bg_z")
WINDOWS = (10.0, 30.0)  # s
SENSORS, SAVGOL, FILTER, SMOOTHER, HYBRID, HYBRID_T = "sensors", "best SG", "filter", "smoother", "hybrid", "hybrid, T"
METHODS = (SENSORS, SAVGOL, FILTER, *(f"{seconds:.0f} s" for seconds in WINDOWS), SMOOTHER, HYBRID, HYBRID_T)
HALF_WIDTHS = (1, 2, 3, 5, 8, 12, 18, 27, 40, 60, 90, 135, 200)  # samples of a Savitzky-Golay window, either side
MEASURED = {  # quantity -> column of the measurements
    "airspeed": 0, "alpha": 1, "beta": 2, "theta": 3, "phi": 4, "psi": 5, "h": 6,
}  # fmt: skip


class Score(NamedTuple):
    """What one record said of the methods; by method and quantity where not said otherwise, SI and rad.

    Attributes
    ----------
    rmse : dict of dict of float
    cover : dict of dict of float
        Share of the errors within two standard deviations.
    nees : dict of dict of float
        Mean of the squared errors over their variances.
    joint : dict of float
        The same of all seven kinematic states together, per degree of freedom; by method.
    z : dict of dict of float
        Of the constants at the end, errors over standard deviations.
    nis, lag1 : dict of float
        By measured quantity.
    moved : float
        By how many sigmas the hybrid pass moved the scale error of the airspeed.
    """

    rmse: dict[str, dict[str, float]]
    cover: dict[str, dict[str, float]]
    nees: dict[str, dict[str, float]]
    joint: dict[str, float]
    z: dict[str, dict[str, float]]
    nis: dict[str, float]
    lag1: dict[str, float]
    moved: float

    @classmethod
    def nothing(cls, methods: tuple[str, ...]) -> Score:
        """Room for these methods."""
        return cls({m: {} for m in methods}, {m: {} for m in methods}, {m: {} for m in methods}, {}, {}, {}, {}, 0.0)


def score(flight: Flight, settings: Settings, *, windows: tuple[float, ...] = WINDOWS, joint: bool = False) -> Score:
    """Reconstruct a simulated flight by every method and compare with the truth.

    Parameters
    ----------
    flight : Flight
    settings : Settings
        With the delay of the fixes, which is not looked for.
    windows : tuple of float
        Lengths of windows that are smoothed one by one, s.
    joint : bool
        Whether the covariances of the kinematic states are worked out too, by the textbook's smoother.
    """
    record = prepare(messages(flight), settings)
    passes = Passes(record)
    paths = {FILTER: passes.filter(), SMOOTHER: passes.smoother(), HYBRID: passes.hybrid()}
    if record.flight.settings.mode == "G":
        paths[HYBRID_T] = passes.hybrid(predict_wind=False)
    for seconds in windows:
        paths[f"{seconds:.0f} s"] = passes.windows(seconds)
    truth = truth_at(flight, record.t)
    late = record.t > record.begin + round(SETTLED * 1e9)
    out = Score.nothing((*paths, SENSORS, SAVGOL))
    for method, path in paths.items():
        _score_path(out, method, record, path, truth, late)
    _score_sensors(out, record, flight)
    if joint:
        before, after = passes.covariances()
        for method, covariance in ((FILTER, before), (SMOOTHER, after), (HYBRID, after)):
            error = kinematic_errors(record, paths[method], truth)[late]
            out.joint[method] = nees(error, covariance[late]).mean
    for name, tally in passes.tallies().items():
        judged = judge(tally)
        out.nis[name], out.lag1[name] = judged.nis or np.nan, judged.lag1 or np.nan
    if "k_airspeed" in record.flight.names:
        at = record.flight.names.index("k_airspeed")
        last = paths[HYBRID].mean[-1, at] - paths[SMOOTHER].mean[-1, at]
        out = out._replace(moved=abs(float(last / paths[SMOOTHER].std[-1, at])))
    return out


def truth_at(flight: Flight, t: NDArray[np.int64]) -> dict[str, Floats]:
    """The truth by the names of states and quantities at times of the samples' clock, each (k,).

    ``h`` is what the altimeter would show without noise, the winds are the steady ones.
    """
    states = truth_states(flight)
    at = np.minimum(np.searchsorted(flight.utc, t), len(flight.utc) - 1)
    found = {name: column[at] for name, column in states.items()}
    found["h"] = found["pressure_altitude"] + found["altimeter_offset"]
    for axis in ("north", "east"):
        found[f"wind_{axis}"] = found[f"wind_{axis}"] - found[f"gust_{axis}"]
    return found


def air(names: tuple[str, ...], mean: Floats) -> dict[str, Floats]:
    """Airspeed, alpha and beta at the inertial sensors from named states (k, n)."""
    column = {name: mean[:, i] for i, name in enumerate(names)}
    nothing = np.zeros(len(mean))
    moving = np.stack(
        [
            column.get(f"wind_{axis}", nothing) + column.get(f"gust_{axis}", nothing)
            for axis in ("north", "east", "down")
        ],
        axis=1,
    )
    turn = points.body_to_ned(mean[:, [names.index(name) for name in ("phi", "theta", "psi")]])
    first = names.index("u")
    u, v, w = (mean[:, first : first + 3] - np.einsum("kji,kj->ki", turn, moving)).T
    speed = np.sqrt(u * u + v * v + w * w)
    return {"airspeed": speed, "alpha": np.arctan2(w, u), "beta": np.arcsin(v / speed)}


def kinematic_errors(record: Record, path: Path, truth: dict[str, Floats]) -> Floats:
    """Errors (k, 7) of height, of velocity along the axes of the estimate, and of attitude as a rotation about them."""
    names = record.flight.names
    angles = [names.index(name) for name in ("phi", "theta", "psi")]
    mine = points.body_to_ned(path.mean[:, angles])
    true = points.body_to_ned(np.stack([truth["phi"], truth["theta"], truth["psi"]], axis=1))
    velocity = np.einsum("kij,kj->ki", true, np.stack([truth["u"], truth["v"], truth["w"]], axis=1))
    first = names.index("u")
    small = np.einsum("kji,kjl->kil", mine, true)
    odd = 0.5 * (small - np.swapaxes(small, 1, 2))  # of a small angle: its cross matrix
    rotation = np.stack([odd[:, 2, 1], odd[:, 0, 2], odd[:, 1, 0]], axis=1)
    along = np.einsum("kji,kj->ki", mine, velocity) - path.mean[:, first : first + 3]
    return np.concatenate([(truth["h"] - path.mean[:, names.index("h")])[:, None], along, rotation], axis=1)


def _score_path(
    out: Score, method: str, record: Record, path: Path, truth: dict[str, Floats], late: NDArray[np.bool_]
) -> None:
    names = record.flight.names
    for i, name in enumerate(names):
        error = path.mean[:, i] - truth[name]
        if name == "psi":
            error = _wrapped(error)
        out.rmse[method][name] = rms(error[late])
        out.cover[method][name] = float(coverage(error[late], path.std[late, i]))
        out.nees[method][name] = float(np.mean(np.square(zscores(error[late], path.std[late, i]))))
        if name in PARAMETERS:
            out.z.setdefault(method, {})[name] = float(error[-1] / path.std[-1, i])
    for name, column in air(names, path.mean).items():
        out.rmse[method][name] = rms((column - truth[name])[late])


def _score_sensors(out: Score, record: Record, flight: Flight) -> None:
    """The sensors themselves, and the best Savitzky-Golay filter of each: its width is chosen by the truth."""
    z, t = record.steps.drive.z, record.steps.t
    true = truth_at(flight, t)
    at = np.minimum(np.searchsorted(flight.utc, t), len(flight.utc) - 1)
    for name, column in zip(AIR, points.air_data(flight.truth, flight.sensors.arms.vanes), strict=True):
        true[name] = column[at]
    for name, at_column in MEASURED.items():
        known = np.flatnonzero(~np.isnan(z[:, at_column]))
        late = t[known] > record.begin + round(SETTLED * 1e9)
        if late.sum() < 2 * max(HALF_WIDTHS):
            continue
        said, wanted = z[known, at_column], true[name][known]
        if name == "psi":
            said = wanted + _wrapped(said - wanted)
            wanted, said = np.unwrap(wanted), said + np.unwrap(wanted) - wanted
        out.rmse[SENSORS][name] = rms((said - wanted)[late])
        smoothed = (savgol_filter(said, 2 * half + 1, 2) for half in HALF_WIDTHS)
        out.rmse[SAVGOL][name] = min(rms((path - wanted)[late]) for path in smoothed)


def rms(error: Floats) -> float:
    """Root of the mean square."""
    return float(np.sqrt(np.mean(np.square(error))))


def _wrapped(angle: Floats) -> Floats:
    return np.asarray((angle + np.pi) % (2.0 * np.pi) - np.pi)
