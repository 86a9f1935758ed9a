"""The tool, not the operator, finds and names what is wrong with the sensors, and is silent where nothing is."""

from pathlib import Path

import numpy as np
import pytest

import sims
from estimator.suspicion import Air, Altitude, Attitude, Columns, Flow, Gnss, Imu, examine
from estimator.suspicion.attitude import attitude_by_gnss
from estimator.suspicion.axes import gyro_by_attitude
from estimator.suspicion.delay import gnss_delay
from estimator.suspicion.rest import scale_at_rest
from sims.sensors import sense
from telemetry import messages as vocabulary
from telemetry.ingest import ingest
from telemetry.mavlink import Dialect
from telemetry.sources.tlog import TlogSource

DATA = Path(__file__).resolve().parents[2].parent / "shared" / "data"
GRAVITY = 9.80
DEGREE = np.pi / 180.0
CASES = {  # aircraft, plan, turbulence, seconds
    "calm": ("c172x", "demo", 0, 120.0),
    "rough": ("c172x", "demo", 3, 170.0),
    "inputs": ("c172x", "inputs", 3, 90.0),
    "airliner": ("737", "demo", 3, 110.0),
}


@pytest.fixture(scope="module")
def truths():
    return {
        name: sims.fly(aircraft, plan, sensors="fti", turbulence=turbulence, duration=seconds).truth
        for name, (aircraft, plan, turbulence, seconds) in CASES.items()
    }


SAID: dict[tuple, Columns] = {}


def columns(truth, grade, seed=1, delay=0.0) -> Columns:
    """What sensors say of a flight, drawn once: a test changes copies."""
    key = id(truth), grade, seed, delay
    if key not in SAID:
        SAID[key] = drawn(truth, grade, seed, delay)
    return SAID[key]


def drawn(truth, grade, seed, delay) -> Columns:
    said = sense(truth, grade, seed=seed, latencies={"gnss": delay} if delay else None)
    height = np.interp(said.pitot.t, said.static.t, said.static.altitude)
    density = (1.0 - 2.25577e-5 * height) ** 4.2559  # over that at sea level
    velocity = said.gnss.velocity.copy()
    if not said.grade.gnss_down:
        velocity[:, 2] = np.nan
    return Columns(
        Imu(said.imu.t, said.imu.specific_force, said.imu.rates),
        Attitude(said.attitude.t, *said.attitude.attitude.T),
        Air(said.pitot.t, said.pitot.airspeed / np.sqrt(density)),
        Flow(said.vanes.t, said.vanes.alpha, said.vanes.beta),
        Altitude(said.static.t, said.static.altitude),
        Gnss(said.gnss.t, velocity, said.gnss.altitude, np.full(len(said.gnss.t), 14)),
    )


def told(of: Columns, **context):
    return [(f.sensor, f.defect) for f in examine(of, gravity=GRAVITY, **context)]


def forces(of: Columns, change) -> Columns:
    return of._replace(imu=of.imu._replace(specific_force=change(of.imu.specific_force)))


def rates(of: Columns, change) -> Columns:
    return of._replace(imu=of.imu._replace(angular_rate=change(of.imu.angular_rate)))


def airspeed(of: Columns, change) -> Columns:
    return of._replace(air=Air(of.air.t, change(of.air.true_airspeed)))


def altitude(of: Columns, change) -> Columns:
    return of._replace(altitude=Altitude(of.altitude.t, change(of.altitude.altitude)))


def repeated(values, share):
    """Values of which a share, known exactly, repeats the one before."""
    again = np.random.default_rng(1).random(len(values)) < share
    again[0] = False
    source = np.maximum.accumulate(np.where(again, 0, np.arange(len(values))))
    return values[source], again.mean()


def stuck(values, start=0.5, stop=0.6):
    values = values.copy()
    values[int(start * len(values)) : int(stop * len(values))] = values[int(start * len(values))]
    return values


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("grade", ["fti", "mems", "mems-vanes"])
def test_sensors_without_fault_give_no_finding(truths, case, grade):
    assert examine(columns(truths[case], grade), gravity=GRAVITY) == []


def test_nothing_is_said_of_nothing():
    empty = np.empty(0)
    none = np.empty(0, np.int64)
    assert examine(Columns()) == []
    assert examine(Columns(imu=Imu(none, np.empty((0, 3)), np.empty((0, 3))), air=Air(none, empty))) == []


def test_missing_sensors_and_missing_values_are_borne(truths):
    whole = columns(truths["rough"], "fti")
    for name in Columns._fields:
        assert examine(whole._replace(**{name: None}), gravity=GRAVITY) == []
        alone = Columns(**{name: getattr(whole, name)})
        assert examine(alone, gravity=GRAVITY) == []
        few = alone._replace(
            **{
                name: type(getattr(whole, name))(
                    *(c if c is None else c[:3] for c in alone[Columns._fields.index(name)])
                )
            }
        )
        assert examine(few, gravity=GRAVITY) == []
    holes = np.random.default_rng(2).random(len(whole.air.t)) < 0.2
    assert told(airspeed(whole, lambda v: np.where(holes, np.nan, v))) == []
    assert told(altitude(whole, lambda h: np.where(holes[: len(h)], np.nan, h))) == []
    heading = whole.attitude._replace(phi=whole.attitude.phi * np.nan, theta=whole.attitude.theta * np.nan)
    assert told(whole._replace(attitude=heading)) == []


@pytest.mark.parametrize("share", [0.08, 0.38])
@pytest.mark.parametrize("grade", ["fti", "mems"])
def test_held_samples_are_counted(truths, share, grade):
    whole = columns(truths["rough"], grade)
    for sensor, injected in (
        ("airspeed", lambda x: airspeed(whole, lambda _: x)), ("altimeter", lambda x: altitude(whole, lambda _: x))
    ):  # fmt: skip
        values = whole.air.true_airspeed if sensor == "airspeed" else whole.altitude.altitude
        held, truth = repeated(values, share)
        (finding,) = examine(injected(held), gravity=GRAVITY)
        assert (finding.sensor, finding.defect) == (sensor, "held")
        assert abs(finding.value - truth) < 4 * finding.sigma
        assert finding.severity == ("warning" if share > 0.25 else "note")


def test_a_frozen_sensor_is_named_and_judges_no_other(truths):
    whole = columns(truths["rough"], "fti")
    assert told(airspeed(whole, stuck)) == [("airspeed", "frozen")]
    assert told(airspeed(whole, np.zeros_like)) == [("airspeed", "frozen")]
    assert told(altitude(whole, stuck)) == [("altimeter", "frozen")]
    assert told(whole._replace(flow=whole.flow._replace(alpha=stuck(whole.flow.alpha)))) == [("vanes", "frozen")]
    assert told(rates(whole, lambda w: w * [1.0, 0.0, 1.0])) == [("gyro", "frozen")]
    (finding,) = examine(altitude(whole, stuck), gravity=GRAVITY)
    assert finding.value == pytest.approx(0.1 * 170.0, abs=0.2) and "altitude stands at" in finding.text


def resting(scale, seconds=90.0):
    """An IMU of 50 Hz and a GNSS of 5 Hz that stand still."""
    random = np.random.default_rng(3)
    t, fix = (np.arange(0, int(seconds * 1e9), step, dtype=np.int64) for step in (20_000_000, 200_000_000))
    down = np.array([0.08, -0.01, -1.0])
    force = GRAVITY * scale * down / np.linalg.norm(down) + 0.02 * random.standard_normal((len(t), 3))
    velocity = 0.05 * random.standard_normal((len(fix), 3))
    return Columns(
        imu=Imu(t, force, 0.001 * random.standard_normal((len(t), 3))),
        gnss=Gnss(fix, velocity, np.zeros(len(fix)), np.full(len(fix), 9)),
    )


def test_the_scale_of_the_accelerometer_is_found_at_rest():
    (finding,) = examine(resting(0.985), gravity=GRAVITY)
    assert (finding.sensor, finding.defect, finding.severity) == ("accelerometer", "scale", "note")
    assert finding.value == pytest.approx(-0.015, abs=5e-4) and abs(finding.value + 0.015) < 3 * finding.sigma
    assert examine(resting(1.0), gravity=GRAVITY) == []
    assert examine(resting(0.92), gravity=GRAVITY)[0].severity == "warning"


def test_a_quiet_flight_is_no_rest(truths):
    assert scale_at_rest(columns(truths["calm"], "fti"), GRAVITY) is None


@pytest.mark.parametrize(("case", "grade"), [("calm", "fti"), ("rough", "fti"), ("rough", "mems"), ("airliner", "fti")])
def test_a_late_gnss_is_told_with_its_delay(truths, case, grade):
    late = columns(truths[case], grade, delay=0.3)
    (finding,) = examine(late, gravity=GRAVITY)
    assert (finding.sensor, finding.defect, finding.severity) == ("gnss", "delay", "warning")
    assert abs(finding.value - 0.3) < 3 * finding.sigma < 0.3
    assert "configure estimate.flight_path.gnss_delay" in finding.text
    assert examine(late, gravity=GRAVITY, gnss_delay=0.3) == []


def test_the_sigma_of_the_delay_holds_over_many_draws(truths):
    found = [gnss_delay(columns(truths["rough"], "mems", seed, 0.2), GRAVITY) for seed in range(10)]
    z = np.array([(delay.value - 0.2) / delay.sigma for delay in found])
    assert np.abs(z).max() < 3.5 and 0.3 < np.sqrt(np.mean(z**2)) < 1.6


def test_the_delay_needs_no_attitude_and_no_vertical_speed(truths):
    late = columns(truths["rough"], "fti", delay=0.25)
    blind = Columns(imu=late.imu, gnss=late.gnss._replace(velocity=late.gnss.velocity * [1.0, 1.0, np.nan]))
    delay = gnss_delay(blind, GRAVITY)
    assert abs(delay.value - 0.25) < 3 * delay.sigma < 0.1


def test_jumps_beyond_physics_are_told(truths):
    whole = columns(truths["rough"], "mems")
    velocity, height = whole.gnss.velocity.copy(), whole.gnss.altitude.copy()
    velocity[300:303, 0] += 40.0
    finding = examine(whole._replace(gnss=whole.gnss._replace(velocity=velocity)), gravity=GRAVITY)[0]
    assert (finding.sensor, finding.defect, finding.severity) == ("gnss", "jump", "warning")
    assert finding.value == pytest.approx(40.0, abs=6.0)
    height[300:310] += 80.0
    finding = examine(whole._replace(gnss=whole.gnss._replace(altitude=height)), gravity=GRAVITY)[0]
    assert (finding.sensor, finding.defect) == ("gnss", "jump") and finding.value == pytest.approx(80.0, abs=20.0)


UNITS = {
    "airspeed in knots": (lambda c: airspeed(c, lambda v: v * 1.943844), "airspeed", 1.943844, "knots"),
    "airspeed in km/h": (lambda c: airspeed(c, lambda v: v * 3.6), "airspeed", 3.6, "km/h"),
    "altitude in feet": (lambda c: altitude(c, lambda h: h * 3.28084), "altimeter", 3.28084, "feet"),
    "forces in g": (lambda c: forces(c, lambda f: f / 9.80665), "accelerometer", 0.102, "in g,"),
    "forces in mg": (lambda c: forces(c, lambda f: f * 101.97), "accelerometer", 102.0, "in mg,"),
    "rates in deg/s": (lambda c: rates(c, lambda w: w / DEGREE), "gyro", 57.2958, "deg/s"),
}


@pytest.mark.parametrize("name", UNITS)
@pytest.mark.parametrize("grade", ["fti", "mems"])
def test_wrong_units_are_named(truths, name, grade):
    change, sensor, ratio, words = UNITS[name]
    (finding,) = examine(change(columns(truths["rough"], grade)), gravity=GRAVITY)
    assert (finding.sensor, finding.defect, finding.severity) == (sensor, "units", "warning")
    # The scale error of the sensor itself and the load factor of the flight come on top.
    assert finding.value == pytest.approx(ratio, rel=0.15) and words in finding.text


def test_angles_in_degrees_are_named(truths):
    whole = columns(truths["rough"], "fti")
    attitude = Attitude(whole.attitude.t, *(angle / DEGREE for angle in whole.attitude[1:]))
    assert told(whole._replace(attitude=attitude)) == [("attitude", "units")]
    flow = Flow(whole.flow.t, whole.flow.alpha / DEGREE, whole.flow.beta / DEGREE)
    assert told(whole._replace(flow=flow)) == [("vanes", "units")]


@pytest.mark.parametrize("grade", ["fti", "mems"])
@pytest.mark.parametrize(("axis", "name"), list(enumerate("pqr")))
def test_a_reversed_gyro_axis_is_named(truths, grade, axis, name):
    sign = np.where(np.arange(3) == axis, -1.0, 1.0)
    (finding,) = examine(rates(columns(truths["rough"], grade), lambda w: w * sign), gravity=GRAVITY)
    assert (finding.sensor, finding.defect) == ("gyro", "sign") and f" {name} has the wrong sign" in finding.text
    assert abs(finding.value + 1.0) < 4 * finding.sigma < 0.1


@pytest.mark.parametrize("order", [(1, 0, 2), (2, 1, 0), (0, 2, 1), (1, 2, 0)])
def test_exchanged_gyro_axes_are_named(truths, order):
    (finding,) = examine(rates(columns(truths["rough"], "fti"), lambda w: w[:, list(order)]), gravity=GRAVITY)
    assert (finding.sensor, finding.defect) == ("gyro", "axes")
    assert all(f"{'pqr'[i]} is {'pqr'[order.index(i)]}" in finding.text for i in range(3) if order[i] != i)


@pytest.mark.parametrize("axis", range(3))
def test_a_reversed_accelerometer_axis_is_named(truths, axis):
    sign = np.where(np.arange(3) == axis, -1.0, 1.0)
    for grade in ("fti", "mems"):
        (finding,) = examine(forces(columns(truths["rough"], grade), lambda f: f * sign), gravity=GRAVITY)
        assert (finding.sensor, finding.defect) == ("accelerometer", "sign")
        assert f"f_{'xyz'[axis]} has the wrong sign" in finding.text


@pytest.mark.parametrize("order", [(1, 0, 2), (2, 1, 0), (0, 2, 1)])
def test_exchanged_accelerometer_axes_are_named(truths, order):
    assert told(forces(columns(truths["rough"], "fti"), lambda f: f[:, list(order)])) == [("accelerometer", "axes")]


@pytest.mark.parametrize("name", ["phi", "psi"])
@pytest.mark.parametrize("grade", ["fti", "mems"])
def test_a_reversed_angle_is_blamed_on_the_attitude_not_on_the_gyro(truths, name, grade):
    whole = columns(truths["rough"], grade)
    attitude = whole.attitude._replace(**{name: -getattr(whole.attitude, name)})
    (finding,) = examine(whole._replace(attitude=attitude), gravity=GRAVITY)
    assert (finding.sensor, finding.defect) == ("attitude", "sign") and name in finding.text


def test_a_mirrored_ground_track_is_blamed_on_the_gnss(truths):
    whole = columns(truths["rough"], "mems")
    velocity = whole.gnss.velocity
    assert told(whole._replace(gnss=whole.gnss._replace(velocity=velocity[:, [1, 0, 2]]))) == [("gnss", "axes")]
    assert told(whole._replace(gnss=whole.gnss._replace(velocity=velocity * [1.0, -1.0, 1.0]))) == [("gnss", "sign")]


@pytest.mark.parametrize("case", ["rough", "inputs"])
def test_vanes_of_the_wrong_sign_or_place_are_named(truths, case):
    whole = columns(truths[case], "fti")
    t, alpha, beta = whole.flow
    for flow, defect, words in (
        (Flow(t, -alpha, beta), "sign", "alpha has the wrong sign"),
        (Flow(t, alpha, -beta), "sign", "beta has the wrong sign"),
        (Flow(t, beta, alpha), "axes", "exchanged"),
    ):
        (finding,) = examine(whole._replace(flow=flow), gravity=GRAVITY)
        assert (finding.sensor, finding.defect) == ("vanes", defect) and words in finding.text


def test_slopes_of_good_sensors_are_one_within_their_sigma(truths):
    for grade in ("fti", "mems"):
        fitted = gyro_by_attitude(columns(truths["rough"], grade), int(truths["rough"].t[0]))
        assert (np.abs(fitted.value - np.eye(3)) < 5 * fitted.sigma + 0.01).all() and (fitted.sigma < 0.05).all()
        slope, sigma = attitude_by_gnss(columns(truths["rough"], grade), int(truths["rough"].t[0]), GRAVITY)["phi"]
        assert abs(slope - 1.0) < 0.1 and sigma < 0.05


def test_saturation_is_told_with_the_end_of_the_range(truths):
    whole = columns(truths["rough"], "fti")
    limit = float(np.percentile(np.abs(whole.imu.angular_rate[:, 0]), 98.0))
    (finding,) = examine(rates(whole, lambda w: np.clip(w, -limit, limit)), gravity=GRAVITY)
    assert (finding.sensor, finding.defect) == ("gyro", "saturated") and abs(finding.value) == limit


def test_an_imu_that_is_too_slow_is_refused(truths):
    whole = columns(truths["rough"], "fti")
    slow = whole._replace(imu=Imu(*(column[::10] for column in whole.imu)))
    (finding,) = examine(slow, gravity=GRAVITY)
    assert (finding.sensor, finding.defect, finding.severity) == ("imu", "slow", "warning")
    assert finding.value == pytest.approx(10.0) and "trajectory model" in finding.text


def test_gaps_and_irregular_intervals_are_told(truths):
    whole = columns(truths["rough"], "fti")
    kept = np.ones(len(whole.imu.t), np.bool_)
    kept[5000:5300] = False
    (finding,) = examine(whole._replace(imu=Imu(*(column[kept] for column in whole.imu))), gravity=GRAVITY)
    assert (finding.defect, finding.severity) == ("gap", "warning") and finding.value == pytest.approx(3.01)
    kept = np.random.default_rng(4).random(len(whole.imu.t)) < 0.6
    assert ("imu", "irregular") in told(whole._replace(imu=Imu(*(column[kept] for column in whole.imu))))


def test_times_that_step_back_are_told_and_left_out(truths):
    whole = columns(truths["rough"], "fti")
    t = whole.air.t.copy()
    t[500:505] -= 10_000_000_000
    (finding,) = examine(whole._replace(air=Air(t, whole.air.true_airspeed)), gravity=GRAVITY)
    assert (finding.sensor, finding.defect, finding.value) == ("airspeed", "order", 5.0)


def test_every_text_is_one_line_that_names_its_sensor(truths):
    whole = columns(truths["rough"], "fti", delay=0.3)
    broken = rates(airspeed(whole, lambda v: v * 1.943844), lambda w: w * [1.0, -1.0, 1.0])
    found = examine(broken, gravity=GRAVITY)
    assert {(f.sensor, f.defect) for f in found} >= {("airspeed", "units"), ("gyro", "sign"), ("gnss", "delay")}
    assert all(f.text.startswith(f.sensor) and "\n" not in f.text for f in found)


def logged(name: str) -> Columns:
    path = DATA / name
    if not path.exists():
        pytest.skip(f"{path} is not here: the real logs are no part of the project")
    dialect = Dialect()
    source = TlogSource(path, dialect)
    kept: dict = {}
    for message in ingest(source.batches(), source.links, dialect):
        kept.setdefault(type(message), []).append(message)

    def column(kind, field):
        return np.concatenate([getattr(message, field) for message in kept[kind]])

    def table(kind, *fields):
        return [column(kind, field) for field in ("t", *fields)]

    return Columns(
        Imu(*table(vocabulary.Imu, "specific_force", "angular_rate")),
        Attitude(*table(vocabulary.Attitude, "phi", "theta", "psi")),
        Air(*table(vocabulary.AirData, "airspeed")),
        None,
        Altitude(*table(vocabulary.Altitude, "altitude")),
        Gnss(*table(vocabulary.Gnss, "velocity", "altitude", "satellites"), column(vocabulary.Gnss, "sigma")[:, 1]),
    )


def test_the_aerobatic_flight_of_2014_has_a_late_gnss_a_low_accelerometer_and_a_wandering_gnss_altitude():
    log = logged("plane_2014_aerobatic_50hz.tlog")
    found = {(f.sensor, f.defect): f for f in examine(log, gravity=GRAVITY)}
    assert {key for key, f in found.items() if f.severity == "warning"} == {("gnss", "delay")}
    delay, scale, height = (found[key] for key in (("gnss", "delay"), ("accelerometer", "scale"), ("gnss", "altitude")))
    assert 0.22 < delay.value < 0.32 and delay.sigma < 0.02
    # It warms up: 1.3 % low in the first minute, 0.3 % in the last.
    assert -0.015 < scale.value < -0.003 and scale_at_rest(log, GRAVITY).first == pytest.approx(-0.013, abs=0.003)
    assert 6.0 < height.value < 12.0
    assert found.keys() <= {*[("gnss", d) for d in ("delay", "altitude", "jump")], ("accelerometer", "scale")}


def test_the_swiss_flight_has_a_late_gnss_held_airspeed_and_an_irregular_imu():
    found = {(f.sensor, f.defect): f for f in examine(logged("plane_swiss_137hz.tlog"), gravity=GRAVITY)}
    assert found.keys() == {("gnss", "delay"), ("airspeed", "held"), ("imu", "irregular")}
    assert 0.18 < found["gnss", "delay"].value < 0.4 and found["gnss", "delay"].sigma < 0.03
    assert found["airspeed", "held"].value == pytest.approx(0.076, abs=0.015)
