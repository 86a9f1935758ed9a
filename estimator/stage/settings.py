"""What the stage is told to do, and the words it shares with its parts."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec

from estimator.models import flight_path, trajectory

STAGE = "estimate"
Seconds = Annotated[float, msgspec.Meta(gt=0, le=1e9)]
Scope = Literal["window", "sortie"]
Level = Literal["info", "warning", "error"]
Reason = Literal["mark", "gap", "length", "reboot", "end"]
Name = Literal["ms", "cubature"]  # of an estimator, as in ``estimators``


class Settings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How samples become estimates.

    Parameters
    ----------
    lag : float
        How long a sample waits for older ones, s: the delay of the live estimate.
    least_lag : float or None
        With a number the lag follows the samples: a little more than the most by which one of them was late in the
        last seconds, between this and `lag`. So the live estimate is as young as the link allows, and what is late for
        the first time waits for the smoothing. None: the lag is fixed.
    grid : float
        Longest step without a measurement, s.
    gap : float
        A silence longer than this closes the window, s.
    window : float
        Longest window between test points, s, from its first measurement; a silence is never cut by it.
    test_point : float
        Longest window of a test point, s; one that lasts longer is cut there and goes on under the same name.
    output : float
        Interval of the estimates of the flight path, s.
    model : {"auto", "trajectory", "flight_path"}
        "auto" flies the flight path wherever the sensors allow, "flight_path" too and warns where they do not; the
        trajectory, which gives the position, is always flown.
    estimator : {"ms", "cubature"}
        What filters and smooths both models: the information filter and smoother in moving coordinates, or the
        square-root cubature filter and smoother. Windows, marks and reports are the same.
    iterate : int
        Hybrid passes of "ms" over a whole sortie; 0 leaves the extended smoother's result.
    trajectory : estimator.models.trajectory.Settings
    flight_path : estimator.models.flight_path.Settings
    """

    lag: Annotated[float, msgspec.Meta(ge=0, le=1e9)] = 0.3
    least_lag: Annotated[float, msgspec.Meta(ge=0, le=1e9)] | None = None
    grid: Seconds = 0.5
    gap: Seconds = 3.0
    window: Seconds = 30.0
    test_point: Seconds = 600.0
    output: Seconds = 0.04
    model: Literal["auto", "trajectory", "flight_path"] = "auto"
    estimator: Name = "ms"
    iterate: Annotated[int, msgspec.Meta(ge=0, le=10)] = 1
    trajectory: trajectory.Settings = trajectory.Settings()
    flight_path: flight_path.Settings = flight_path.Settings()


def fingerprint(settings: Settings) -> bytes:
    """What the digest of a window begins with: the settings as JSON.

    An estimator is named in it only where it is not "ms", which is what a digest without one has always meant.
    """
    told: dict[str, object] = msgspec.to_builtins(settings)
    if settings.estimator == "ms":
        del told["estimator"]
    return msgspec.json.encode(told)
