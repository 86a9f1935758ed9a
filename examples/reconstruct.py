"""Reconstruct a flight path in a dozen lines, from a log or from a simulated flight, and see how far it can be trusted.

python examples/reconstruct.py                 a simulated light aircraft with flight-test instrumentation
python examples/reconstruct.py flight.tlog     a MAVLink log with HIGHRES_IMU at 20 Hz or more
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

import estimator
import sims
from estimator.models import flight_path
from estimator.stage import Settings
from telemetry.ingest import ingest
from telemetry.mavlink import Dialect
from telemetry.sources.tlog import TlogSource


def main() -> None:
    """Print the states, the parameters and the verdicts of one flight."""
    if len(sys.argv) > 1:
        dialect = Dialect("ardupilotmega")
        source = TlogSource(Path(sys.argv[1]), dialect)
        path = estimator.reconstruct(ingest(source.batches(), source.links, dialect))
    else:
        flight = sims.fly("c172x", "calibration", sensors="fti", turbulence=3)
        places = flight.sensors.arms.from_imu()._asdict()  # of vanes, antenna and centre, from the inertial sensors
        settings = flight_path.Settings.fti(turbulence=1.9, turbulence_time=6.0, gnss_delay=0.0, **places)
        path = estimator.reconstruct(sims.messages(flight), Settings(flight_path=settings))

    print(f"{len(path.t)} epochs, {(path.t[-1] - path.t[0]) * 1e-9:.1f} s")
    print(f"\n{'state':12} {'unit':6} {'sigma live':>11} {'smoothed':>11}")
    for i, (name, unit) in enumerate(zip(path.names, path.units, strict=True)):
        live, smoothed = np.nanmedian(path.filtered_std[:, i]), np.nanmedian(path.smoothed_std[:, i])
        print(f"{name:12} {unit:6} {live:11.3g} {smoothed:11.3g}")
    print("\nparameters")
    for name, found in path.parameters.items():
        number = "" if found.value is None else f"{found.value:.3g} +- {found.sigma:.2g} {found.unit}: "
        print(f"{name:12} {number}{found.verdict} ({found.why})")
    print("\nmean normalised innovation squared, 1 if model and noise are right")
    for name, nis in path.nis.items():
        print(f"{name:15} {nis:.2f}  {path.verdicts[name]}")
    for alarm in path.reports[-1].alarms:
        print("ALARM", alarm)
    for finding in path.reports[-1].findings:
        print("found", finding)


if __name__ == "__main__":
    main()
