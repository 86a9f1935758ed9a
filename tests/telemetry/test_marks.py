"""Test points of a file become marks at their times, and a mark from the ground arrives as one."""

from __future__ import annotations

import itertools
import re
import socket

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimator.stage import estimate
from telemetry.ingest import ingest
from telemetry.marks import Point, insert, read, say
from telemetry.mavlink import Dialect
from telemetry.messages import Altitude, Event, Gnss, Mark, Message, Progress, StatusText, Window
from tests.telemetry.test_frames import scan
from tests.telemetry.wire import Sender

S = 1_000_000_000
BEGIN = 1_700_000_000 * S


# -- the file ----------------------------------------------------------------------------------------------------------


def written(folder, text: str, kind: str = "csv"):
    path = folder / f"points.{kind}"
    path.write_text(text, encoding="utf-8")
    return path


def test_a_csv_file_tells_seconds_from_the_first_sample(tmp_path):
    path = written(tmp_path, "\ufeffname, start, stop, vehicle\n\nphugoid 3, 95, 150.25, 7\n1,12.5,40,\n")
    assert read(path) == [
        Point("1", 12_500_000_000, 40 * S, 0, True),
        Point("phugoid 3", 95 * S, 150_250_000_000, 7, True),
    ]


@pytest.mark.parametrize("start", ["2023-11-14T22:13:20Z", "2023-11-14T23:13:20+01:00", "1700000000", "1700000000.0"])
@pytest.mark.parametrize("kind", ["csv", "toml"])
def test_utc_and_unix_seconds_are_the_same_time(start, kind, tmp_path):
    stop = "2023-11-14T22:13:21.25Z"
    text = f"name,start,stop\n1,{start},{stop}\n"
    if kind == "toml":
        text = f'[[test_point]]\nname = 1\nstart = {start}\nstop = "{stop}"\n'
    assert read(written(tmp_path, text, kind)) == [Point("1", BEGIN, BEGIN + 5 * S // 4)]


def test_a_toml_file_may_name_a_vehicle(tmp_path):
    text = (
        '[[test_point]]\nname = "a"\nstart = 1\nstop = 2\nvehicle = 3\n[[test_point]]\nname = "b"\nstart=0\nstop=1.5\n'
    )
    with pytest.raises(ValueError, match="a vehicle flies one test point at a time"):
        read(written(tmp_path, text, "toml"))
    assert read(written(tmp_path, text.replace("1.5", "1"), "toml")) == [
        Point("b", 0, S, 0, True),
        Point("a", S, 2 * S, 3, True),
    ]


def test_two_vehicles_may_fly_at_the_same_time(tmp_path):
    assert len(read(written(tmp_path, "name,start,stop,vehicle\na,1,5,1\nb,2,4,2\n"))) == 2


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "no test point in it"),
        ("name,start,stop\n", "no test point in it"),
        ("name,begin,stop\n1,2,3\n", "row 1: unknown 'begin': there are name, start, stop and, if wanted, vehicle"),
        ("name;start;stop\n1;2;3\n", "row 1: unknown 'name;start;stop'"),
        ("name,start,start\n1,2,3\n", "row 1: a column is there twice"),
        ("name,start\n1,2\n", "row 2: stop is missing"),
        ("name,start,stop\n1,2,3\n2,,5\n", "row 3: start is missing"),
        ("name,start,stop\n1,2\n", "row 2: 2 values where row 1 names 3 columns"),
        ("name,start,stop\n1,5,5\n", "row 2: stop = 5 is not after start = 5"),
        ("name,start,stop\n1,soon,5\n", "row 2: start = soon: a time is seconds from the first sample, Unix seconds"),
        ("name,start,stop\n1,-1,5\n", "row 2: start = -1: before the first sample"),
        ("name,start,stop\n1,1,nan\n", "row 2: stop = nan: a time is"),
        ("name,start,stop\n1,1,1e300\n", "row 2: stop = 1e300: before the first sample, or beyond the year 2200"),
        ("name,start,stop\n1,2023-11-14T22:13:20,5\n", "no zone: end it with Z, or with an offset such as +02:00"),
        ("name,start,stop\n1,5,2023-11-14T22:13:20Z\n", "row 2: only one of start and stop counts from the first"),
        ("name,start,stop\n1,1,2\n2,1700000000,1700000001\n", "row 3: times count from the first sample in some"),
        ("name,start,stop,vehicle\n1,1,2,0\n", "row 2: vehicle = '0' is no MAVLink system, 1 to 255; leave it out"),
        ("name,start,stop,vehicle\n1,1,2,x\n", "row 2: vehicle = 'x'"),
        ("name,start,stop\n1,1,3\n2,2,4\n", "row 3: test point 2 (2 s to 4 s) begins before test point 1 (1 s to 3 s)"),
        ("name,start,stop,vehicle\n1,1,9,\nb,0,0.5,2\n2,2,4,2\n", "row 4: test point 2"),
        ('name,start,stop\n"1,1,3\n', "unexpected end of data"),
    ],
)
def test_what_is_wrong_in_a_csv_file_is_named(text, words, tmp_path):
    path = written(tmp_path, text)
    with pytest.raises(ValueError, match=re.escape(words)) as caught:
        read(path)
    assert str(caught.value).startswith(str(path))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "no test point in it"),
        ("[test_point]\nname = 1\n", "write [[test_point]] above each"),
        ("[[points]]\n", "unknown key 'points': each test point is a table under [[test_point]]"),
        ("[[test_point]]\nname = 1\nstart = 1\nend = 2\n", "test_point 1: unknown 'end'"),
        ("[[test_point]]\nname = 1\nstart = 1\nstop = true\n", "test_point 1: stop = True: a time is"),
        ("[[test_point]]\nname = 1\nstart = 2023-11-14\nstop = 2\n", "test_point 1: start = 2023-11-14: a time is"),
        ("[[test_point]]\nname = 1\nstart = 2023-11-14T00:00:00\nstop = 2\n", "no zone"),
        ('[[test_point]]\nname = ""\nstart = 1\nstop = 2\n', "test_point 1: name = '': a name is printable text"),
        ('[[test_point]]\nname = 1\nstart = 1\nstop = 2\nvehicle = "b"\n', "test_point 1: vehicle = 'b'"),
        ("[[test_point]\n", "line 1"),
    ],
)
def test_what_is_wrong_in_a_toml_file_is_named(text, words, tmp_path):
    with pytest.raises(ValueError, match=re.escape(words)):
        read(written(tmp_path, text, "toml"))


def test_other_files_are_refused(tmp_path):
    with pytest.raises(ValueError, match=re.escape("is neither .toml nor .csv")):
        read(written(tmp_path, "", "xlsx"))
    (tmp_path / "latin.csv").write_bytes(b"name,start,stop\n\xe4,1,2\n")
    with pytest.raises(ValueError, match=r"latin\.csv"):
        read(tmp_path / "latin.csv")


# -- the stage ---------------------------------------------------------------------------------------------------------


def flight(seconds=40.0, *, vehicle=1, boot=0, begin=0.0, silence=(), stray=None) -> list[Message]:
    """Single samples as they arrive: pressure at 10 Hz, fixes at 5 Hz that are 50 ms old; times jitter on the way."""
    random = np.random.default_rng(seed=vehicle)
    out: list[Message] = []
    for i in range(round(10 * seconds)):
        if any(a <= 0.1 * i < b for a, b in silence):
            continue
        t = BEGIN + round((begin + 0.1 * i) * S)
        t_rx = t + round(random.exponential(0.02) * S)
        odd = stray is not None and i == round(10 * stray)
        common = {"vehicle": vehicle, "source": "0/1", "boot": boot}
        one = np.ones(1)
        times = {"t": np.array([t + 1000 * S * odd]), "t_rx": np.array([t_rx])}
        out.append(Altitude(**common, **times, altitude=500 * one, pressure=one, sigma=0.5 * one))
        if i % 2 == 0:
            times = {"t": np.array([t - S // 20]), "t_rx": np.array([t_rx + 1])}
            columns = {"latitude": 0.8 * one + 3e-7 * i, "longitude": 0.2 * one, "altitude": 470 * one}
            columns |= {"velocity": np.array([[20.0, 0.0, np.nan]]), "sigma": np.array([[2.0, 3.0, 0.3]])}
            out.append(Gnss(**common, **times, **columns, satellites=np.array([9])))
    return out


def stream(messages: list[Message], cuts=()) -> list[Message]:
    """The messages, and a `Progress` behind each cut and at the end."""
    messages = sorted(messages, key=lambda m: int(m.t_rx[0]))
    edges = sorted({0, len(messages), *(min(cut, len(messages)) for cut in cuts)})
    out: list[Message] = []
    for a, b in itertools.pairwise(edges):
        t = np.array([messages[b - 1].t_rx[0]])
        out += [*messages[a:b], Progress(vehicle=0, source="", boot=0, t=t, t_rx=t, final=b == len(messages))]
    return out


def point(name: str, start: float, stop: float, vehicle: int = 0) -> Point:
    """Seconds since BEGIN, told as UTC."""
    return Point(name, BEGIN + round(start * S), BEGIN + round(stop * S), vehicle)


def marks(messages) -> list[tuple]:
    found = [m for m in messages if isinstance(m, Mark)]
    return [(m.vehicle, m.boot, m.action[0], m.name[0], (int(m.t[0]) - BEGIN) / S) for m in found]


def warnings(messages) -> list[str]:
    return [text for m in messages if isinstance(m, Event) and m.level == ["warning"] for text in m.text]


def windows(messages, points, cuts=(), scope="sortie") -> list[Window]:
    found = estimate(insert(stream(messages, cuts), points), scope=scope)
    return [m for m in found if isinstance(m, Window)]


def test_a_mark_has_the_time_of_the_file_and_comes_with_the_first_sample_that_is_not_older():
    messages = flight()
    out = list(insert(stream(messages), [point("1", 10.03, 20.1)]))
    assert marks(out) == [(1, 0, "start", "1", 10.03), (1, 0, "stop", "1", 20.1)]
    for mark in (m for m in out if isinstance(m, Mark)):
        arrived = sorted((int(m.t_rx[0]), int(m.t[0])) for m in messages)
        assert mark.t_rx[0] == next(t_rx for t_rx, t in arrived if t >= mark.t[0])
    assert warnings(out) == []


def test_seconds_count_from_the_first_sample_of_the_log():
    out = insert(stream(flight(begin=3)), [Point("1", 10 * S, 20 * S, relative=True)])
    assert [m[4] for m in marks(out)] == [13.0, 23.0]


@pytest.mark.parametrize("scope", ["sortie", "window"])
def test_the_estimator_smooths_the_test_points_of_the_file(scope):
    found = windows(flight(), [point("1", 10.03, 20.1), point("2", 20.1, 30)], scope=scope)
    assert [(w.test_point, w.reason) for w in found] == [("", "mark"), ("1", "mark"), ("2", "mark"), ("", "end")]
    for window, (a, b) in zip(found, itertools.pairwise([-1.0, 10.03, 20.1, 30.0, 41.0]), strict=True):
        assert ((window.t > BEGIN + round(a * S)) & (window.t <= BEGIN + round(b * S))).all()
    assert sum(len(w.t) for w in found) == 599, "all but the pressure before the first fix: none is late"


@given(st.lists(st.integers(1, 1000), max_size=30), st.sampled_from(["window", "sortie"]))
@settings(max_examples=15, deadline=None)
def test_batches_change_neither_marks_nor_windows(cuts, scope):
    messages = [
        *flight(stray=12.0),
        *flight(20, boot=1, begin=60, silence=[(5, 11)]),
        *flight(vehicle=2, begin=7, silence=[(3, 20)]),
    ]
    points = [point("1", 8, 16), point("2", 17, 66), point("3", 70, 75, 1), point("4", 900, 901)]
    whole, parts = (list(insert(stream(messages, c), points)) for c in ((), cuts))
    assert sorted(marks(parts)) == sorted(marks(whole))
    assert sorted(int(m.t_rx[0]) for m in parts if isinstance(m, Mark)) == sorted(
        int(m.t_rx[0]) for m in whole if isinstance(m, Mark)
    )
    assert warnings(parts) == warnings(whole)
    a, b = windows(messages, points, cuts, scope), windows(messages, points, (), scope)
    about = [[(w.vehicle, w.boot, w.number, w.test_point, w.reason, w.digest) for w in found] for found in (a, b)]
    assert sorted(about[0]) == sorted(about[1])


def test_a_point_without_a_vehicle_is_one_of_every_vehicle():
    messages = [*flight(), *flight(vehicle=2)]
    points = [point("1", 10, 20), point("2", 20, 25, 2)]
    assert {m[:4] for m in marks(insert(stream(messages), points))} == {
        *((vehicle, 0, action, "1") for vehicle in (1, 2) for action in ("start", "stop")),
        (2, 0, "start", "2"),
        (2, 0, "stop", "2"),
    }


def test_a_point_across_a_reboot_begins_again():
    messages = [*flight(20), *flight(20, boot=1, begin=30)]
    found = windows(messages, [point("1", 10, 40)])
    assert [(w.boot, w.test_point, w.reason) for w in found] == [
        (0, "", "mark"),
        (0, "1", "reboot"),
        (1, "1", "mark"),
        (1, "", "end"),
    ]


def test_marks_of_the_log_itself_stay():
    said = np.array([BEGIN + 30 * S])
    own = Mark(vehicle=1, source="0/1", boot=0, t=said, t_rx=said + S // 20, action=["start"], name=["own"])
    found = windows([*flight(), own], [point("1", 10, 20)])
    assert [w.test_point for w in found] == ["", "1", "", "own"]


def test_a_stray_time_ahead_of_all_others_reaches_nothing():
    found = windows(flight(stray=12.0), [point("1", 20, 30)])
    assert [w.test_point for w in found] == ["", "1", ""]
    assert found[1].t[0] > BEGIN + 20 * S >= found[0].t[-1]


def test_a_clock_that_leaps_and_steps_back_is_followed():
    """Two samples a thousand seconds ahead are believed, and no test point is skipped by them."""
    ahead = flight(0.1, begin=1012.02)
    for message in ahead:
        message.t_rx[:] -= 1000 * S
    out = list(insert(stream([*flight(), *ahead]), [point("1", 20, 30), point("2", 1000, 1100)]))
    arrived = sorted((m for m in out if isinstance(m, Mark)), key=lambda m: int(m.t_rx[0]))
    assert [m[2:] for m in marks(arrived)] == [("start", "2", 1000), ("start", "1", 20), ("stop", "1", 30)]


@pytest.mark.parametrize(
    ("points", "words"),
    [
        ([point("1", 50, 60)], "test point 1 (2023-11-14T22:14:10.0Z to 2023-11-14T22:14:20.0Z) is not used: the"),
        ([Point("1", 50 * S, 60 * S, 0, True)], "the log, 0.0 s to 39.9 s, holds no sample in it"),
        ([point("1", -9, -8)], "holds no sample in it"),
        ([point("1", 11, 12)], "holds no sample in it"),
        ([point("1", 30, 60)], "reaches beyond the log, 2023-11-14T22:13:20.0Z to 2023-11-14T22:13:59.9Z: it is cut"),
        ([point("1", -5, 5)], "reaches beyond the log"),
        ([point("1", 5, 6, 7)], "is not used: the log holds no samples of vehicle 7, but of 1"),
    ],
)
def test_a_point_outside_the_log_is_told(points, words):
    (said,) = warnings(insert(stream(flight(silence=[(10.5, 13)])), points))
    assert words in said


def test_a_point_that_reaches_beyond_the_log_is_used_as_far_as_it_goes():
    assert [w.test_point for w in windows(flight(), [point("1", -5, 5), point("2", 30, 60)])] == ["1", "", "2"]


def test_a_log_without_a_sample_is_told():
    t = np.array([BEGIN])
    (said,) = warnings(insert([Progress(vehicle=0, source="", boot=0, t=t, t_rx=t, final=True)], [point("1", 1, 2)]))
    assert "the log holds no samples" in said


# -- from the ground ---------------------------------------------------------------------------------------------------


def test_what_is_said_from_the_ground_arrives_as_a_mark():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.0.1", 0))
        text = say(f"udpout:127.0.0.1:{sock.getsockname()[1]}", "start", "phugoid 3", 1)
        frames = scan(Sender(1).attitude(1000), sock.recv(1000))
    assert (frames.sysid[1], frames.compid[1]) == (255, 190)
    messages = list(ingest([frames], ["0"], Dialect()))
    (mark,) = [m for m in messages if isinstance(m, Mark)]
    assert (mark.vehicle, mark.action, mark.name) == (1, ["start"], ["phugoid 3"])
    assert [m.text for m in messages if isinstance(m, StatusText)] == [[text]]


def test_where_nobody_listens_the_mark_is_refused():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.0.1", 0))
        port = sock.getsockname()[1]
    with pytest.raises(OSError, match=f"udpout:127.0.0.1:{port}: nobody listens there, so the mark is lost"):
        say(f"udpout:127.0.0.1:{port}", "start", "1")


@pytest.mark.parametrize("endpoint", ["udpin:127.0.0.1:14550", "14550", "tcp:127.0.0.1:14550"])
def test_a_mark_goes_to_an_endpoint(endpoint):
    with pytest.raises(ValueError, match=re.escape(repr(endpoint))):
        say(endpoint, "start", "1")
