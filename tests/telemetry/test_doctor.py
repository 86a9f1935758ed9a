"""The doctor finds what would stop a flight, and says the way out."""

from __future__ import annotations

import math
import os
import pty
import re
import resource
import socket
import subprocess
import sys
import time
from importlib.metadata import requires

import pytest
import zenoh

from telemetry import doctor
from telemetry.archive import RESERVE
from telemetry.doctor import DISTRIBUTION, Finding, examine


def of(findings: list[Finding], what: str) -> list[Finding]:
    found = [finding for finding in findings if finding.what == what]
    assert found, f"nothing about {what} in {findings}"
    return found


@pytest.fixture(scope="module")
def healthy(tmp_path_factory) -> list[Finding]:
    return examine(tmp_path_factory.mktemp("sorties") / "new" / "folder", seconds=0.1)


def test_everything_is_examined_and_leaves_nothing_behind(tmp_path):
    findings = examine(tmp_path / "sorties" / "s1", ["udpin:0"], seconds=0.0)
    assert {finding.level for finding in findings} <= {"ok", "warning", "error"}
    everything = {"Python", "rerun", "udpin:0", "loopback", "receive buffer", "cores", "memory", "open files"}
    everything |= {str(tmp_path / "sorties" / "s1"), "compiled functions", "bus", "date", "clock", "clock rate"}
    assert everything <= {finding.what for finding in findings}
    assert list(tmp_path.iterdir()) == []
    assert not [finding for finding in findings if "cannot be examined" in finding.text]
    assert all("\n" not in finding.text and finding.text for finding in findings)


def test_every_package_that_is_asked_for_is_looked_at(healthy):
    for text in requires(DISTRIBUTION) or []:
        if "extra ==" not in text:
            name = text.split(">")[0].split("=")[0]
            assert [finding.level for finding in of(healthy, name)] == ["ok"]
    assert of(healthy, "rerun")[0].text.startswith("0.41.")


def test_a_package_that_is_too_old_or_missing_is_an_error_with_the_command_that_mends_it(tmp_path):
    packages = {
        "sortie_telemetry": ["Requires-Python: >=9", "Requires-Dist: numpy>=2.2", "Requires-Dist: gone>=1",
                             "Requires-Dist: peer>=1 ; extra == 'peers'"],
        "numpy": [],
    }  # fmt: skip
    for name, more in packages.items():
        (tmp_path / f"{name}-1.0.dist-info").mkdir()
        lines = ["Metadata-Version: 2.1", f"Name: {name.replace('_', '-')}", "Version: 1.0", *more]
        (tmp_path / f"{name}-1.0.dist-info" / "METADATA").write_text("\n".join(lines) + "\n")
    sys.path.insert(0, str(tmp_path))
    try:
        found = list(doctor._versions())
    finally:
        sys.path.remove(str(tmp_path))
    assert [(finding.level, finding.what) for finding in found] == [
        ("error", "Python"), ("error", "numpy"), ("error", "gone"),
    ]  # fmt: skip
    assert ">=9 is needed" in found[0].text
    assert found[1].text == "1.0 is installed: pip install 'numpy>=2.2'"
    assert found[2].text == "is not installed: pip install 'gone>=1'"


def test_a_port_in_use_is_an_error(tmp_path):
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp,
        socket.socket(socket.AF_INET, socket.SOCK_STREAM) as tcp,
    ):
        udp.bind(("127.0.0.1", 0))
        tcp.bind(("127.0.0.1", 0))
        tcp.listen()
        used = [f"udpin:{udp.getsockname()[1]}", f"tcpin:{tcp.getsockname()[1]}"]
        found = list(doctor._endpoints(used))
    assert [finding.level for finding in found] == ["error", "error"]
    assert all("the port is in use" in finding.text and "choose another port" in finding.text for finding in found)
    assert [finding.level for finding in doctor._endpoints(used)] == ["ok", "ok"]


def test_one_port_does_not_serve_two_endpoints():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp:
        udp.bind(("127.0.0.1", 0))
        port = udp.getsockname()[1]
    found = list(doctor._endpoints([f"udpin:{port}", f"udpin:127.0.0.1:{port}"]))
    assert [finding.level for finding in found] == ["ok", "error"]


def test_what_is_no_endpoint_no_host_or_no_device_is_an_error(tmp_path):
    (tmp_path / "file").touch()
    found = list(
        doctor._endpoints(
            ["udp:14550", "udpout:no host:14550", f"serial:{tmp_path}/ttyUSB0", f"serial:{tmp_path}/file"]
        )
    )
    assert [finding.level for finding in found] == ["error"] * 4
    for finding, text in zip(
        found, ("is no endpoint: write", "no host", "plug it in", "no serial device"), strict=True
    ):
        assert text in finding.text


def test_a_device_that_is_there_is_not_opened():
    ours, theirs = pty.openpty()
    try:
        found = list(doctor._endpoints([f"serial:{os.ttyname(theirs)}:57600"]))
    finally:
        os.close(ours)
        os.close(theirs)
    assert found == [Finding("ok", found[0].what, "is there")]


def test_a_folder_that_cannot_be_made_is_an_error(tmp_path):
    (tmp_path / "file").touch()
    found = list(doctor._disk(tmp_path / "file" / "s1", None))
    assert [finding.level for finding in found] == ["error"]
    assert "is a file: choose another --folder" in found[0].text


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_that_cannot_be_written_is_an_error(tmp_path):
    tmp_path.chmod(0o500)
    found = list(doctor._disk(tmp_path / "s1", None))
    assert [finding.level for finding in found] == ["error"]
    assert "cannot be written to (Permission denied): choose another --folder" in found[0].text


def test_little_space_is_a_warning_and_very_little_an_error(tmp_path):
    free = os.statvfs(tmp_path).f_bavail * os.statvfs(tmp_path).f_frsize
    for reserve, level in ((free // 100, "ok"), (free // 2, "warning"), (2 * free, "error")):
        found = [finding for finding in doctor._disk(tmp_path, reserve) if "MB free" in finding.text]
        assert [finding.level for finding in found] == [level]
        assert ("make room" in found[0].text) == (level != "ok")
    assert RESERVE > 100_000_000


def test_few_open_files_are_a_warning(healthy):
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(soft, 512), hard))
    try:
        found = of(list(doctor._machine()), "open files")
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    assert found == [Finding("warning", "open files", "512 at most: ulimit -n 1024 before starting")]


def test_a_receive_buffer_is_told_as_the_kernel_gives_it(healthy):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 8 << 20)
        unprivileged = sock.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) // 2
    found = of(healthy, "receive buffer")[0]
    assert float(found.text.split()[0]) >= round(unprivileged / 1e6, 1)
    assert (found.level == "warning") == ("sysctl -w net.core.rmem_max=" in found.text)


def test_a_bus_that_nobody_carries_is_an_error_and_one_that_is_there_is_not(healthy):
    assert of(healthy, "bus") == [Finding("ok", "bus", "a message came back")]
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as sock:
        sock.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{sock.getsockname()[1]}"
    found = list(doctor._bus([endpoint], None, None))
    assert [(finding.level, finding.what) for finding in found] == [("error", f"bus on {endpoint}")]
    assert "nobody carries the bus" in found[0].text
    config = zenoh.Config()
    for key, value in (
        ("mode", '"router"'),
        ("listen/endpoints", f'["{endpoint}"]'),
        ("scouting/multicast/enabled", "false"),
    ):
        config.insert_json5(key, value)
    with zenoh.open(config):
        assert [finding.level for finding in doctor._bus([endpoint], None, None)] == ["ok"]


def test_a_clock_that_is_being_set_is_seen():
    def told(step: int) -> doctor.Finding:
        return of(list(doctor._clock((time.time_ns() - step, time.monotonic_ns()), 0.0)), "clock rate")[0]

    assert any(told(0).level == "ok" for _ in range(20)), "a busy machine may read the two clocks a little apart"
    stepped = told(5_000_000_000)
    assert stepped.level == "warning"
    (apart,) = re.findall(r"differ by (\d+) us", stepped.text)
    assert int(apart) == pytest.approx(5e6, rel=0.02)


def test_whether_the_clock_is_synchronised_is_the_kernels_word():
    synchronised, error = doctor._discipline()
    assert synchronised in (True, False, None)
    assert error >= 0 or (synchronised is None and math.isnan(error))


def test_a_cold_start_is_foretold(tmp_path):
    code = "from telemetry import doctor; [print(f.level, f.text) for f in doctor._compiled(['telemetry.framing'])]"
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    said = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert said.stdout.startswith("warning")
    assert "not compiled yet: the first start takes up to a minute" in said.stdout


def test_what_fails_does_not_keep_the_rest_from_being_examined(tmp_path):
    findings = examine(tmp_path, compiled=["telemetry.no_such_module"], seconds=0.0)
    broken = of(findings, "compiled functions")[0]
    assert broken.level == "error"
    assert "no_such_module" in broken.text
    assert of(findings, "clock rate")
