"""What the command line answers to what users type: one line, and an exit code that a script can trust."""

from __future__ import annotations

import json
import socket
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest

import sims
import sortie
from telemetry.mavlink import Dialect
from telemetry.sources.tlog import TlogSource
from telling import Failure
from tests.console import RERUN, Process, free_port, run
from tests.telemetry.wire import DATA, Sender, tlog

US = 1_700_000_000_000_000


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    """A flight of 40 s as a log."""
    path = tmp_path_factory.mktemp("log") / "flight.tlog"
    flight = sims.fly("c172x", "demo", duration=40, start_utc=US * 1000)
    sims.write_tlog(sims.frames(flight), path, flight.start_utc)
    return path


def one_line(done: subprocess.CompletedProcess[str]) -> str:
    lines = [line for line in done.stderr.splitlines() if line.startswith("sortie: ")]
    assert len(lines) == 1, done.stderr
    assert "Traceback" not in done.stderr
    return lines[0]


def test_help_loads_nothing_heavy():
    loaded = "('cyclopts', 'rich', 'numpy', 'numba', 'rerun', 'zenoh', 'pymavlink', 'jsbsim', 'matplotlib', 'pyarrow')"
    heavy = (
        "import sys, sortie\nsys.argv = ['sortie', '--help']\nsortie.main()\n"
        f"print([m for m in {loaded} if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", heavy], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"


@pytest.mark.parametrize(
    "command",
    ["demo", "live", "mark", "ingest", "estimate", "record", "smooth", "review", "replay", "sim", "verify", "bench"],
)
def test_every_command_explains_itself(command):
    done = run(command, "--help")
    assert done.returncode == 0
    assert "Usage: sortie" in done.stdout


def test_smooth_review_and_plot(log, tmp_path):
    done = run("smooth", log, "-o", "out.rrd", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("out.rrd: 1 vehicle, ")
    assert done.stdout.strip().endswith("complete")
    assert subprocess.run([RERUN, "rrd", "verify", tmp_path / "out.rrd"], check=False).returncode == 0
    told = run("review", "out.rrd", "--plot", "out.png", cwd=tmp_path)
    assert told.returncode == 0, told.stderr
    assert "complete" in told.stdout
    assert (tmp_path / "out.png").read_bytes().startswith(b"\x89PNG")
    found = json.loads(run("review", "out.rrd", "--json", cwd=tmp_path).stdout)
    assert found["closed"]
    windows = found["summary"]["windows"]
    assert [w["reason"] for w in windows if w["model"] == "trajectory"] == ["mark", "end"]
    assert [w["reason"] for w in windows if w["model"] == "flight_path"] == ["mark", "end"]


def test_a_simulated_flight_becomes_a_log_or_arrays(tmp_path):
    flight = [
        "sim",
        "c172x",
        "--manoeuvre",
        "3-2-1-1",
        "--sensors",
        "fti",
        "--turbulence",
        "3",
        "--dropout",
        "gnss:5:8",
    ]
    done = run(*flight, "--to", "flight.tlog", "--faults", "loss=0.1", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("flight.tlog: ")
    smoothed = run("smooth", "flight.tlog", cwd=tmp_path)
    assert smoothed.returncode == 0, smoothed.stderr
    done = run(*flight, "--to", "flight.npz", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "truth and sensors" in done.stdout
    wrong = run("sim", "c172x", "--to", "flight.npz", "--dropout", "gnss", cwd=tmp_path)
    assert "--dropout gnss: SENSOR:START:STOP is needed" in one_line(wrong)


def test_the_output_is_never_overwritten(log, tmp_path):
    (tmp_path / "out.rrd").write_text("mine")
    done = run("smooth", log, "-o", "out.rrd", cwd=tmp_path)
    assert done.returncode == 1
    assert "out.rrd exists and a recording is never overwritten" in one_line(done)
    assert (tmp_path / "out.rrd").read_text() == "mine"


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("none.tlog", None, "none.tlog: no such file or directory"),
        ("empty.tlog", b"", "empty.tlog is empty: nothing was recorded"),
        (
            "text.tlog",
            b"To whom it may concern\n" * 100,
            "text.tlog is no telemetry log: no MAVLink frame in its first 2300 bytes",
        ),
        ("folder", "folder", "folder is no sortie folder: it has no sortie.toml"),
    ],
)
def test_what_is_no_log_is_named(name, content, words, tmp_path):
    if content == "folder":
        (tmp_path / name).mkdir()
    elif content is not None:
        (tmp_path / name).write_bytes(content)
    done = run("smooth", name, cwd=tmp_path)
    assert done.returncode == 1
    assert words in one_line(done)
    assert not list(tmp_path.glob("*.rrd"))


def test_an_output_folder_that_is_not_there_is_named(log, tmp_path):
    done = run("smooth", log, "-o", tmp_path / "no" / "out.rrd")
    assert done.returncode == 1
    assert str(tmp_path / "no") in one_line(done)


def test_a_log_cut_inside_a_frame_is_used_to_its_last_good_byte(log, tmp_path):
    (tmp_path / "cut.tlog").write_bytes(log.read_bytes()[:-7])
    done = run("smooth", "cut.tlog", cwd=tmp_path)
    assert done.returncode == 0
    assert "truncated: the log ends inside a record" in done.stdout
    told = run("review", "cut.rrd", cwd=tmp_path).stdout
    assert "truncated" in told
    assert "bytes are left out" in " ".join(told.split())


def test_garbage_between_frames_is_counted_and_the_rest_used(log, tmp_path):
    whole = log.read_bytes()
    noise = np.random.default_rng(2).integers(0, 256, 5000, dtype=np.uint8).tobytes()
    (tmp_path / "hurt.tlog").write_bytes(whole[:30_000] + noise + whole[30_000:])
    done = run("smooth", "hurt.tlog", cwd=tmp_path)
    assert done.returncode == 0
    assert "damaged: 5" in done.stdout
    found = json.loads(run("review", "hurt.rrd", "--json", cwd=tmp_path).stdout)
    assert 5000 <= sum(b["discarded"] for b in found["summary"]["byte_accounts"]) < 5200
    assert sum(a["received"] for a in found["summary"]["accounts"]) > 3000


def test_a_log_without_a_fix_is_recorded_and_said(tmp_path):
    sender = Sender()
    (tmp_path / "blind.tlog").write_bytes(
        tlog([(US + 100_000 * i, sender.pressure(1000 + 100 * i, 900)) for i in range(100)])
    )
    done = run("smooth", "blind.tlog", cwd=tmp_path)
    assert done.returncode == 1
    assert "no satellite fix, so there is nothing to smooth; what could be read is in blind.rrd" in one_line(done)
    found = json.loads(run("review", "blind.rrd", "--json", cwd=tmp_path).stdout)
    assert [s["samples"] for s in found["summary"]["vehicles"][0]["sensors"]] == [100]


def test_unknown_ids_are_counted_and_harm_nothing(tmp_path):
    sender = Sender()
    frames = []
    for i in range(100):
        frames += [
            (US + 200_000 * i, sender.gps(1000 + 200 * i, 48.0, 11.0, 500.0)),
            (US + 200_000 * i + 5, sender.unknown()),
        ]
    (tmp_path / "odd.tlog").write_bytes(tlog(frames))
    done = run("smooth", "odd.tlog", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    found = json.loads(run("review", "odd.rrd", "--json", cwd=tmp_path).stdout)
    assert sum(b["unknown"] for b in found["summary"]["byte_accounts"]) == 100
    assert sum(a["lost"] for a in found["summary"]["accounts"]) == 0


def test_a_busy_port_leaves_nothing_behind(tmp_path):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", 0))
        port = other.getsockname()[1]
        done = run("live", f"udpin:127.0.0.1:{port}", "--folder", "here", cwd=tmp_path)
    assert done.returncode == 1
    assert f"udpin:127.0.0.1:{port}: the port is in use" in one_line(done)
    assert not list((tmp_path / "here").iterdir())


def test_a_sortie_is_never_overwritten(tmp_path):
    (tmp_path / "here").mkdir()
    (tmp_path / "here" / "raw.tlog").write_text("evidence")
    done = run("live", f"udpin:{free_port()}", "--folder", "here", cwd=tmp_path)
    assert done.returncode == 1
    assert "here exists and is not empty" in one_line(done)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["frobnicate"], "Unknown command"),
        (["smooth"], "requires an argument"),
        (["smooth", "a.tlog", "--windw", "3"], "Unknown option"),
        (["sim", "--to", "udpout:1", "--speed", "fast"], "Invalid value"),
        (["mark", "begin", "12"], "Invalid value"),
        (["smooth", "a.tlog", "--estimator", "magic"], 'Choose from: "ms", "cubature"'),
    ],
)
def test_wrong_usage_is_exit_code_two(arguments, words):
    done = run(*arguments)
    assert done.returncode == 2
    assert words in one_line(done)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["live"], "say where telemetry comes from"),
        (["live", "morse:1"], "'morse:1' is no endpoint"),
        (["sim", "zeppelin", "--to", "udpout:14550"], "zeppelin"),
        (["review", "none.rrd"], "none.rrd: no such recording"),
        (["verify", "."], "is no sortie folder"),
        (["mark", "start", "x" * 40], "choose a shorter name"),
        (["mark", "start", "1", "--to", "udpin:14550"], "a mark is sent to where sortie live listens"),
    ],
)
def test_what_cannot_be_done_is_exit_code_one(arguments, words, tmp_path):
    done = run(*arguments, cwd=tmp_path)
    assert done.returncode == 1
    assert words in one_line(done)


def test_settings_come_from_a_file_and_mistakes_in_it_are_named(log, tmp_path):
    (tmp_path / "good.toml").write_text("[estimate]\nwindow = 5\n[estimate.trajectory]\ngnss_correlated_share = 0.5\n")
    (tmp_path / "bad.toml").write_text("[estimate]\nwindow = 'long'\n")
    assert run("smooth", log, "-o", "a.rrd", "--config", "good.toml", cwd=tmp_path).returncode == 0
    reasons = [
        w["reason"] for w in json.loads(run("review", "a.rrd", "--json", cwd=tmp_path).stdout)["summary"]["windows"]
    ]
    assert "length" in reasons
    (tmp_path / "mark.toml").write_text("[ingest]\nmark = '^TP (.+) (start|stop)$'\n")
    done = run("smooth", log, "-o", "b.rrd", "--config", "mark.toml", cwd=tmp_path)
    assert "mark.toml: mark '^TP (.+) (start|stop)$' needs the groups" in one_line(done)
    done = run("smooth", log, "-o", "b.rrd", "--config", "bad.toml", cwd=tmp_path)
    assert done.returncode == 1
    assert "bad.toml: Expected `float`, got `str` - at `$.estimate.window`" in one_line(done)


def test_another_estimator_is_flown_verified_and_compared(tmp_path):
    port = free_port()
    flight = sims.fly("c172x", "straight", duration=20)
    told = ("--folder", "s", "--idle", 1.5, "--estimator", "cubature")
    with Process("live", f"udpin:127.0.0.1:{port}", *told, cwd=tmp_path) as live:
        live.wait_for("listening")
        sims.send(sims.frames(flight), f"udpout:127.0.0.1:{port}", speed=20)
        assert live.end() == 0, live.said
    assert "flight path (cubature), mode G" in live.said
    assert 'estimator = "cubature"' in (tmp_path / "s" / "sortie.toml").read_text()
    verified = run("verify", "s", cwd=tmp_path)
    assert verified.returncode == 0, verified.stdout + verified.stderr
    done = run("smooth", "s", "-o", "ms.rrd", "--estimator", "ms", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    found = json.loads(run("review", "s", "--against", "ms.rrd", "--json", cwd=tmp_path).stdout)
    assert found["estimators"] == ["cubature", "ms"]
    states = [state for state in found["states"] if state["stage"] == "live"]
    assert {state["model"] for state in states} == {"trajectory", "flight_path"}
    assert all(state["rows"] and state["rms_sigma"] < 1.0 for state in states)
    with pytest.raises(Failure, match="--bias-separation looks at the stretches of estimator ms"):
        sortie.smooth(tmp_path / "s", bias_separation=True)


def test_a_test_point_is_marked_from_the_ground_while_live(tmp_path):
    """What was marked is in the raw log, so a replay closes the same windows."""
    port = free_port()
    there = f"udpout:127.0.0.1:{port}"
    flight = sims.fly("c172x", "demo", duration=30)
    sender = threading.Thread(target=lambda: sims.send(sims.frames(flight), there, speed=4))
    with Process("live", f"udpin:127.0.0.1:{port}", "--folder", "s", "--idle", 2, cwd=tmp_path) as live:
        live.wait_for("listening")
        early = run("mark", "start", "early", "--to", there)
        assert early.returncode == 0
        live.wait_for("mark 'TP early start @0' is not used: no vehicle has been heard yet")
        sender.start()
        live.wait_for("system 1 component 1")
        done = run("mark", "start", "trim 7", "--to", there, "--vehicle", 1)
        assert done.returncode == 0, done.stderr
        assert done.stdout == f"start of test point trim 7 for vehicle 1: 'TP trim 7 start @1' to {there}\n"
        live.wait_for("ground station 255/190 marks the start of test point trim 7")
        assert run("mark", "stop", "trim 7", "--to", there).returncode == 0
        live.wait_for("test point trim 7, ", timeout=30)
        sender.join()
        assert live.end() == 0, live.said
    verified = run("verify", "s", cwd=tmp_path)
    assert verified.returncode == 0, verified.stdout + verified.stderr + live.said
    windows = json.loads(run("review", "s", "--json", cwd=tmp_path).stdout)["summary"]["windows"]
    assert [w["reason"] for w in windows if w["test_point"] == "trim 7"][-1] == "mark"
    lost = run("mark", "start", "late", "--to", there)
    assert lost.returncode == 1
    assert f"{there}: nobody listens there, so the mark is lost" in one_line(lost)


def test_test_points_of_a_file_are_smoothed(log, tmp_path):
    (tmp_path / "points.csv").write_text("name,start,stop\ntrim,5,12.5\nlate,90,100\n")
    done = run("smooth", log, "-o", "out.rrd", "--test-points", "points.csv", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "warning: test point late (90 s to 100 s) is not used: the log, 0.0 s to " in done.stderr
    windows = json.loads(run("review", "out.rrd", "--json", cwd=tmp_path).stdout)["summary"]["windows"]
    trim = [w for w in windows if w["test_point"] == "trim"]
    assert 7.0 < (max(w["t1"] for w in trim) - min(w["t0"] for w in trim)) * 1e-9 <= 7.5
    assert "1" in [w["test_point"] for w in windows], "what the log marks stays"


def test_a_mistake_in_a_file_of_test_points_is_named(log, tmp_path):
    (tmp_path / "points.toml").write_text("[[test_point]]\nname = 1\nstart = 9\nstop = 5\n")
    done = run("smooth", log, "--test-points", "points.toml", cwd=tmp_path)
    assert done.returncode == 1
    assert one_line(done) == "sortie: points.toml: test_point 1: stop = 5 is not after start = 9"
    done = run("smooth", log, "--test-points", "none.csv", cwd=tmp_path)
    assert one_line(done) == "sortie: none.csv: no such file or directory"


@pytest.mark.parametrize(
    ("name", "boots"), [("copter_2015_4reboots.tlog", 5), ("sitl_quadplane_uavlogviewer_vtol.tlog", 1)]
)
def test_real_logs(name, boots, tmp_path):
    if not (DATA / name).exists():
        pytest.skip(f"{DATA / name} is not here")
    done = run("smooth", DATA / name, "-o", "out.rrd", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert subprocess.run([RERUN, "rrd", "verify", tmp_path / "out.rrd"], check=False).returncode == 0
    summary = json.loads(run("review", "out.rrd", "--json", cwd=tmp_path).stdout)["summary"]
    assert len(summary["vehicles"][0]["boots"]) == boots
    windows = summary["windows"]
    assert {w["boot"] for w in windows} == set(range(boots))
    assert [w["reason"] for w in windows].count("reboot") == boots - 1
    spans = sorted((b["t0"], b["t1"]) for b in summary["vehicles"][0]["boots"])
    assert all(any(t0 <= w["t0"] and w["t1"] <= t1 for t0, t1 in spans) for w in windows), "no window across a boot"


def test_bench_says_where_the_time_goes(log):
    done = run("bench", "smooth", log)
    assert done.returncode == 0, done.stderr
    told = [line.split()[0] for line in done.stdout.splitlines()[1:]]
    assert told == ["read", "decode", "estimate", "write", "all", "overlapped"]


def test_a_port_in_use_would_stop_a_flight(tmp_path):
    port = free_port()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.0.1", port))
        done = run("doctor", f"udpin:127.0.0.1:{port}", "--folder", tmp_path, "--json")
    assert done.returncode == 1
    found = {one["what"]: one for one in json.loads(done.stdout)}
    assert "in use" in found[f"udpin:127.0.0.1:{port}"]["text"]
    assert f"1 thing would stop a flight: udpin:127.0.0.1:{port}" in done.stderr


def test_keys_are_made_once_and_never_overwritten(tmp_path):
    done = run("keys", tmp_path / "keys", "--host", "10.0.0.1")
    assert done.returncode == 0, done.stderr
    made = {Path(path).name for path in done.stdout.split()}
    assert {"ca.pem", "ca.key", "router.key", "ingest.pem"} <= made
    again = run("keys", tmp_path / "keys")
    assert again.returncode == 1
    assert one_line(again)


def test_a_bus_off_this_machine_needs_certificates(tmp_path):
    done = run("router", "--listen", "tcp/10.0.0.1:7447")
    assert done.returncode == 1
    assert "sortie keys FOLDER --host 10.0.0.1" in one_line(done)
    assert run("keys", tmp_path / "keys").returncode == 0
    printed = run("router", "--listen", "tls/127.0.0.1:7447", "--credentials", tmp_path / "keys", "--zenohd")
    told = json.loads(printed.stdout)
    assert told["access_control"]["default_permission"] == "deny"
    assert told["transport"]["link"]["tls"]["enable_mtls"] is True


def test_a_sortie_is_resumed_as_what_it_was(tmp_path):
    port = free_port()
    flight = sims.fly("c172x", "straight", duration=20)
    for resume, count in (((), 1), (("--resume",), 2)):
        told = ("--sortie", "s", "--folder", tmp_path / "s", "--idle", 1.5, *resume)
        with Process("live", f"udpin:127.0.0.1:{port}", *told) as live:
            live.wait_for("listening")
            sims.send(sims.frames(flight), f"udpout:127.0.0.1:{port}", speed=20)
            assert live.end() == 0, live.said
        assert len(list((tmp_path / "s").glob("*.rrd"))) == 2
        source = TlogSource(tmp_path / "s", Dialect(), trusted=True)
        assert sum(len(batch) for batch in source.batches()) == count * len(list(sims.frames(flight)))
    wrong = run("live", "--sortie", "other", "--folder", tmp_path / "s", "--resume")
    assert "resume it with --sortie s" in one_line(wrong)
    assert run("verify", tmp_path / "s").returncode == 0


@pytest.mark.parametrize(
    ("name", "what"),
    [("copter_dronekit_log171.bin", "hole in the log"), ("vtol_pyulog_sample_log_small.ulg", "dropped out")],
)
def test_logs_written_on_board_are_smoothed_too(name, what, tmp_path):
    log = DATA / name
    if not log.exists():
        pytest.skip(f"{log} is not here")
    done = run("smooth", log, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert what in done.stderr
    assert "1 vehicle" in done.stdout and "0 windows" not in done.stdout
    refused = run("replay", log, "--to", "udpout:127.0.0.1:14550")
    assert "holds no MAVLink frames to send" in one_line(refused)
