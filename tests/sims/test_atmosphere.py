"""The standard atmosphere, against its published table."""

import numpy as np
import pytest

from sims import atmosphere


@pytest.mark.parametrize(("altitude", "pressure"), [(0, 101325), (1000, 89874.6), (5000, 54019.9), (10000, 26436.3)])
def test_pressure_against_the_table(altitude, pressure):
    assert atmosphere.pressure(np.array(float(altitude))) == pytest.approx(pressure, rel=2e-5)
    assert atmosphere.pressure_altitude(np.array(float(pressure))) == pytest.approx(altitude, abs=0.2)


def test_calibrated_airspeed_is_true_airspeed_at_sea_level():
    v = np.array([30.0, 80.0, 200.0])
    impact = atmosphere.impact_pressure(v, np.full(3, atmosphere.P0), np.full(3, atmosphere.T0))
    np.testing.assert_allclose(atmosphere.calibrated_airspeed(impact), v, rtol=1e-12)
    np.testing.assert_allclose(atmosphere.impact_of_calibrated(v), impact, rtol=1e-12)


def test_calibrated_airspeed_shrinks_with_height():
    impact = atmosphere.impact_pressure(np.array([100.0]), np.array([54019.9]), np.array([255.65]))
    assert atmosphere.calibrated_airspeed(impact) == pytest.approx(100 * np.sqrt(0.6012), rel=0.01)


def test_negative_impact_pressure_is_no_airspeed():
    assert atmosphere.calibrated_airspeed(np.array([-5.0])) == 0
