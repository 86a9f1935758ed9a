"""A second model beside the trajectory of `flight`: the flight path, its windows, its reports, and vanes."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np

from telemetry import messages as m
from tests.viewer import flight as f

NAMES = (
    *("h", "u", "v", "w", "theta", "phi", "psi"),
    *("ba_x", "ba_y", "ba_z", "bg_x", "bg_y", "bg_z"),
    *("wind_north", "wind_east", "gust_north", "gust_east", "gust_down"),
    *("k_airspeed", "b_alpha", "b_beta"),
)
UNITS = (
    *("m", "m/s", "m/s", "m/s", "rad", "rad", "rad"),
    *("m/s2",) * 3,
    *("rad/s",) * 3,
    *("m/s",) * 5,
    *("1", "rad", "rad"),
)
SIGMA = np.array([0.5, 0.1, 0.2, 0.2, 0.002, 0.002, 0.01, *[0.01] * 3, *[0.001] * 3, *[0.3] * 5, 0.01, 0.005, 0.005])


def states(s: Any) -> Any:
    """The flight path at the times s, shape (k, n)."""
    x = np.zeros((len(s), len(NAMES)))
    x[:, 0] = f.truth(s)[:, 2]
    x[:, 1] = 42 + 3 * np.sin(s / 9)
    x[:, 2] = np.sin(s / 4)
    x[:, 3] = 2 + np.cos(s / 5)
    x[:, 4], x[:, 5] = 0.06 + 0.03 * np.sin(s / 6), 0.5 * np.sin(s / 10)
    x[:, 6] = np.mod(2 * np.pi / 60 * s, 2 * np.pi)
    x[:, 7:] = 0.3 * np.concatenate([SIGMA[7:13], 10 * SIGMA[13:15], SIGMA[15:]])
    return x


def estimates(vehicle: int = 1, rate: float = 5.0) -> list[m.Estimate]:
    """Live flight path of both boots, without a position."""
    rng, out = np.random.default_rng(vehicle), []
    for boot, (low, high) in enumerate(((4.0, 143.0), (150.0, f.END))):
        s = f.times(rate)
        s = s[(s >= low) & (s < high)]
        std = SIGMA * (1 + 2 * np.exp(-(s - s[0]) / 8.0))[:, None]
        out.append(
            m.Estimate(
                model="flight_path",
                names=NAMES,
                units=UNITS,
                mean=states(s) + 0.5 * std * rng.normal(size=std.shape),
                std=std,
                nis=rng.chisquare(5, len(s)),
                dof=np.full(len(s), 5),
                geodetic=np.full((len(s), 3), np.nan),
                **f.base(s, vehicle=vehicle, boot=boot, source="estimator"),
            )
        )
    return out


def windows(vehicle: int = 1) -> list[m.Window]:
    """Smoothed flight path, cut elsewhere than the trajectory: one window less in the first boot."""
    out = []
    spans = [(4.0, *f.WINDOWS[0][1:]), *f.WINDOWS[1:5], (150.0, f.END, 1, 0, "", "end")]
    for low, high, boot, number, test_point, reason in spans:
        s = f.times(5.0)
        s = s[(s >= low) & (s <= high)]
        out.append(
            m.Window(
                model="flight_path",
                names=NAMES,
                units=UNITS,
                mean=states(s),
                std=np.tile(0.6 * SIGMA, (len(s), 1)),
                geodetic=np.full((len(s), 3), np.nan),
                number=number,
                test_point=test_point,
                reason=reason,
                scope="window",
                measurements={"imu": len(s), "air_data": 2 * len(s), "flow_angles": 2 * len(s)},
                late={},
                anchors=3,
                nis=5.0 * len(s),
                dof=5 * len(s),
                digest=f"{100 + number:064x}",
                **f.base(s, vehicle=vehicle, boot=boot, source="estimator"),
            )
        )
    return out


PARAMETERS = (
    m.Parameter(
        name="ba_x", unit="m/s2", value=0.0213, sigma=0.0042, prior=0.05, gain=3.57, z=0.4,
        verdict="consistent", why="3.6 bit gained",
    ),
    m.Parameter(
        name="bg_z", unit="rad/s", value=-0.0021, sigma=0.00031, prior=0.0052, gain=4.07, z=-0.9,
        verdict="consistent", why="4.1 bit gained",
    ),
    m.Parameter(
        name="b_alpha", unit="rad", value=0.0204, sigma=0.0031, prior=0.0087, gain=1.49, z=4.2,
        verdict="inconsistent", why="4.2 sigmas from the mean of the other test points, beyond 3",
    ),
    m.Parameter(
        name="b_beta", unit="rad", value=None, sigma=None, prior=0.0087, gain=0.12, z=None,
        verdict="not observable", why="0.12 bit gained, below 0.5: sigma is still 0.92 of what it was before",
    ),
)  # fmt: skip
CHANNELS = (
    m.Channel(
        name="airspeed", unit="m/s", used=580, weakened=3, rejected=1, nis=2.31, low=0.86, high=1.16, lag1=0.52,
        verdict="over-confident", why="mean NIS 2.31: innovations are large and correlated: raise the turbulence sigma",
    ),
    m.Channel(
        name="alpha", unit="rad", used=580, weakened=0, rejected=0, nis=1.02, low=0.86, high=1.16, lag1=-0.04,
        verdict="consistent", why="mean NIS 1.02",
    ),
    m.Channel(
        name="psi", unit="rad", used=0, weakened=0, rejected=4, nis=None, low=None, high=None, lag1=None,
        verdict="no data", why="no scalar was used, 4 refused by the gate",
    ),
)  # fmt: skip


def report(
    test_point: str, scope: Any, window: int, low: float, high: float, *, vehicle: int = 1, boot: int = 0, **more: Any
) -> m.Report:
    """What a stretch is worth."""
    fields: dict[str, Any] = {
        "states": tuple(
            m.Spread(name=name, unit=unit, filtered=float(x), smoothed=0.6 * float(x))
            for name, unit, x in zip(NAMES[::-1], UNITS[::-1], SIGMA[::-1], strict=True)
        ),
        "parameters": PARAMETERS,
        "channels": CHANNELS,
        "gaps": {"held": 0.3, "interpolated": 0.0, "lost": 12.0},
        "loss": 0.0312,
        "loss_effect": {"h": 1.14},
        "findings": ("gyro z: 3.1 times its noise | vibration at 47 Hz",),
        "alarms": ("airspeed: over-confident, mean NIS 2.31", "[silence] of 12.0 s"),
        "digest": f"{window:064x}",
    }
    return m.Report(
        model="flight_path", test_point=test_point, scope=scope, window=window, begin=int(f.ns(low)),
        **{**fields, **more},
        **f.base(np.array([high]), vehicle=vehicle, boot=boot, source="estimator"),
    )  # fmt: skip


QUIET: dict[str, Any] = {
    "alarms": (), "findings": (), "parameters": PARAMETERS[:2], "channels": CHANNELS[1:2], "gaps": {}, "loss": None,
    "loss_effect": {},
}  # fmt: skip


def reports(vehicle: int = 1) -> list[m.Report]:
    """One per test point, one per window between, one of each boot as a whole."""
    return [
        report("", "window", 0, 4.0, 30.0, vehicle=vehicle, **QUIET),
        report("level turn", "test point", 1, 30.0, 60.0, vehicle=vehicle),
        report("", "window", 3, 82.0, 110.0, vehicle=vehicle, **QUIET),
        report("phugoid", "test point", 4, 110.0, 135.0, vehicle=vehicle, **QUIET),
        report("", "sortie", 4, 4.0, 135.0, vehicle=vehicle),
        report("", "sortie", 0, 150.0, f.END, vehicle=vehicle, boot=1, **QUIET),
    ]


def vanes(vehicle: int = 1) -> list[m.FlowAngles]:
    """Angle of attack at 20 Hz; sideslip only every other time."""
    out = []
    for boot, (low, high) in enumerate(((0.0, 143.0), (143.0, f.END))):
        s = f.times(20.0)
        s = s[(s >= low) & (s < high)]
        beta = 0.01 * np.sin(s)
        beta[::2] = np.nan
        out.append(m.FlowAngles(alpha=0.05 + 0.01 * np.cos(s), beta=beta, **f.base(s, vehicle=vehicle, boot=boot)))
    return out


def attitudes(vehicle: int = 1) -> list[m.Attitude]:
    """The autopilot's own attitude."""
    out = []
    for boot, (low, high) in enumerate(((0.0, 143.0), (143.0, f.END))):
        s = f.times(10.0)
        s = s[(s >= low) & (s < high)]
        x = states(s)
        out.append(
            m.Attitude(phi=x[:, 5] + 0.02, theta=x[:, 4] - 0.01, psi=x[:, 6], **f.base(s, vehicle=vehicle, boot=boot))
        )
    return out


def flight(vehicle: int = 1) -> list[m.Message]:
    """The flight of `tests.viewer.flight` with both models, their messages interleaved."""
    return [
        *vanes(vehicle),
        *attitudes(vehicle),
        *f.flight(vehicle),
        *estimates(vehicle),
        *windows(vehicle),
        *reports(vehicle),
    ]


def changed(message: Any, **fields: Any) -> Any:
    """The message with other fields."""
    return msgspec.structs.replace(message, **fields)
