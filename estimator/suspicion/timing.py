"""Is the IMU quick and regular enough for its integration to mean anything?"""

from __future__ import annotations

import numpy as np

from estimator.suspicion.columns import Columns, Finding

SLOWEST = 20.0
"""Samples per second below which there is no flight-path reconstruction (Hz)."""
HOLE, LOST = 0.5, 2.0
"""Holes of the IMU that are told, and those that end an estimate (s)."""


def find_timing(columns: Columns) -> list[Finding]:
    """Rate (median interval), irregularity (5 to 95 % of the intervals) and holes of the IMU."""
    if columns.imu is None or len(columns.imu.t) < 10:
        return []
    interval = np.diff(columns.imu.t) * 1e-9
    low, middle, high = np.percentile(interval, (5.0, 50.0, 95.0))
    worst, rate = float(interval.max()), 1.0 / float(middle)
    found = []
    # 0.1 % of slack: stamps are rounded.
    if rate < SLOWEST * 0.999:
        found.append(
            Finding(
                "imu", "slow", rate, 0.0, "Hz", "warning",
                f"imu: {rate:.3g} samples per second (median; longest interval {worst:.2f} s) where flight-path "
                f"reconstruction needs {SLOWEST:.0f}: the trajectory model is used; log the IMU on board or ask for a "
                "higher rate",
            )
        )  # fmt: skip
    elif high - low > 0.5 * middle:
        found.append(
            Finding(
                "imu", "irregular", float(high - low), 0.0, "s", "note",
                f"imu: intervals of {1e3 * low:.1f} to {1e3 * high:.1f} ms (5 to 95 %; median {1e3 * middle:.1f}, "
                f"longest "
                f"{1e3 * worst:.1f} ms): each interval is integrated with its own length; a steadier logger is better",
            )
        )  # fmt: skip
    holes = interval[interval > max(HOLE, 5.0 * middle)]
    if len(holes) and rate >= SLOWEST * 0.999:
        found.append(
            Finding(
                "imu", "gap", worst, 0.0, "s", "warning" if worst > LOST else "note",
                f"imu: {len(holes)} gaps above {HOLE} s, the longest {worst:.2f} s: "
                + (
                    f"above {LOST:.0f} s the estimate starts anew; log on board"
                    if worst > LOST
                    else "motion inside them is guessed"
                ),
            )
        )  # fmt: skip
    return found
