"""Who has no good certificate stays out, and who is in says only what its role may say; all over real sessions."""

from __future__ import annotations

import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
import zenoh

from telemetry import keys
from telemetry.bus import Bus, publish, security, serve
from telemetry.bus.publisher import MSGPACK
from telemetry.bus.router import router_config, router_file, serve_router
from telemetry.bus.session import open_session, settings
from telemetry.wire import encode, schema
from tests.telemetry.test_bus import collect, heard, stream, wait_for

ROOT = Path(__file__).parents[2]


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as sock:
        sock.bind(("127.0.0.1", 0))
        return sock.getsockname()[1]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("keys")
    keys.create(folder)
    return folder


def carried(endpoint, folder):
    """A router in a thread; the answer ends it."""
    stop, ready = threading.Event(), threading.Event()
    thread = threading.Thread(
        target=serve_router, args=([endpoint], folder), kwargs={"stop": stop, "ready": ready.set}, daemon=True
    )
    thread.start()
    assert ready.wait(20)

    def end() -> None:
        stop.set()
        thread.join(20)

    return end


@pytest.fixture(scope="module")
def router(folder):
    endpoint = f"tls/127.0.0.1:{free_port()}"
    end = carried(endpoint, folder)
    yield endpoint
    end()


def member(router, folder, role, **options) -> Bus:
    return Bus("s", connect=[router], credentials=folder, role=role, wait=10, **options)


@pytest.mark.parametrize("endpoint", ["udp/127.0.0.1:7447", "7447", "tcp/nowhere", "tls/a/b:1"])
def test_what_is_no_endpoint_is_refused(endpoint):
    with pytest.raises(ValueError, match="is no endpoint of the bus"):
        Bus("s", listen=[endpoint])


@pytest.mark.parametrize("endpoint", ["tcp/0.0.0.0:7447", "tcp/10.0.0.1:7447", "tcp/[fd00::1]:7447", "tcp/host:7447"])
def test_nothing_leaves_this_machine_in_the_clear(endpoint):
    for side in ("listen", "connect"):
        with pytest.raises(ValueError, match=r"in the clear: use tls/.* and certificates; sortie keys FOLDER --host"):
            Bus("s", **{side: [endpoint]})


def test_tls_without_certificates_is_refused(folder, tmp_path):
    with pytest.raises(ValueError, match="tls needs certificates"):
        Bus("s", connect=["tls/127.0.0.1:7447"])
    with pytest.raises(ValueError, match=r"ca\.pem is not there: make it with sortie keys"):
        Bus("s", connect=["tls/127.0.0.1:7447"], credentials=tmp_path, role="ingest")
    with pytest.raises(ValueError, match="shows no certificate: use tls/"):
        Bus("s", connect=["tcp/127.0.0.1:7447"], credentials=folder, role="ingest")


def test_three_roles_do_their_work_through_the_router_also_when_late(router, folder):
    recorded: list = []
    with (
        member(router, folder, "ingest") as ingest,
        member(router, folder, "estimate") as estimate,
        member(router, folder, "record") as record,
    ):
        publisher = ingest.publisher("ingest")
        *messages, last = stream(600)
        for message in messages:
            publisher.put(message)
        subscription = record.subscribe("record", ["ingest", "estimate"], health=True)
        threads = [
            threading.Thread(target=collect, args=(subscription, recorded)),
            threading.Thread(target=serve, args=(estimate, "estimate", ["ingest"], lambda messages: messages)),
        ]
        for thread in threads:
            thread.start()
        wait_for(lambda: {m.source for m in recorded if type(m).__name__ == "Health"} == {"record", "estimate"})
        publisher.put(last)
        assert publisher.finish()
        for thread in threads:
            thread.join(20)
            assert not thread.is_alive()
    assert subscription.backfilled >= 600, "history passes the access list"
    assert subscription.missing == subscription.refused == 0
    assert sum(m.source == "0/1" for m in recorded) == 2 * 400, "told by both"


@pytest.mark.parametrize(
    ("role", "stage"), [("record", "ingest"), ("viewer", "estimate"), ("estimate", "ingest"), ("ingest", "estimate")]
)
def test_who_says_what_its_role_may_not_is_not_heard(router, folder, role, stage):
    received: list = []
    (last,) = stream(0, stage)
    with (
        Bus("t", connect=[router], credentials=folder, role=role, wait=10) as forger,
        Bus("t", connect=[router], credentials=folder, role=stage, wait=10) as rightful,
        Bus("t", connect=[router], credentials=folder, role="viewer", wait=10) as reader,
    ):
        thread = threading.Thread(target=collect, args=(reader.subscribe("viewer", [stage]), received))
        thread.start()
        instance = "f" * 24  # born later than anybody
        token = forger.token("alive", stage, instance, "-")
        forger.session.put(
            f"sortie/t/{stage}/0/event/progress",
            encode(last),
            encoding=zenoh.Encoding(MSGPACK).with_schema(schema(type(last))),
            attachment=f"{instance} 0",
        )
        assert publish(rightful, stage, stream(20, stage))
        thread.join(20)
        assert not thread.is_alive()
        token.undeclare()
    assert heard(received, "viewer") == list(range(21))
    assert not [m for m in received if m.source == "viewer" and "restarted" in m.text[0]]


def test_an_acknowledgement_in_anothers_name_does_not_count(router, folder):
    with (
        Bus("a", connect=[router], credentials=folder, role="viewer", wait=10) as forger,
        Bus("a", connect=[router], credentials=folder, role="ingest", wait=10) as ingest,
        Bus("a", connect=[router], credentials=folder, role="record", wait=10) as record,
    ):
        subscription = record.subscribe("record", ["ingest"])
        publisher = ingest.publisher("ingest")
        publisher.put(next(stream(1)))
        wait_for(lambda: ingest.tokens("listening/**"))

        def answer(query) -> None:
            with query:
                query.reply("sortie/a/ack/record/ingest", f"{publisher.instance} 0")

        forged = forger.session.declare_queryable("sortie/a/ack/record/ingest", answer)
        forger.session.put("sortie/a/ack/record/ingest", b"left")
        assert not publisher.finish(1.0)
        forged.undeclare()
        subscription.close()


def raw(router, folder, items) -> None:
    """Try to open a session with these settings, as a stranger would with tools of its own."""
    base = "transport/link/tls/"
    session = open_session(
        settings("client", connect=[router]) | {base + "root_ca_certificate": str(folder / "ca.pem")} | items
    )
    session.close()


def shown(folder, role) -> dict:
    base = "transport/link/tls/"
    return {
        base + "enable_mtls": True,
        base + "connect_certificate": str(folder / f"{role}.pem"),
        base + "connect_private_key": str(folder / f"{role}.key"),
    }


def test_who_shows_no_certificate_is_refused(router, folder):
    with pytest.raises(zenoh.ZError):
        raw(router, folder, {})
    with pytest.raises(zenoh.ZError):
        raw(router, folder, {"transport/link/tls/verify_name_on_connect": False})
    raw(router, folder, shown(folder, "viewer"))  # nothing else is wrong


def test_who_has_the_certificate_of_another_authority_is_refused_and_told(router, folder, tmp_path):
    keys.create(tmp_path)
    with pytest.raises(zenoh.ZError):  # it trusts the router, but the router not it
        raw(router, folder, shown(tmp_path, "ingest"))
    begin = time.monotonic()
    with pytest.raises(OSError, match=f"{router}: the router's certificate is not good: .*certificate"):
        member(router, tmp_path, "ingest")
    assert time.monotonic() - begin < 10
    mixed = tmp_path / "mixed"
    mixed.mkdir()
    for name, source in (("ca.pem", folder), ("ingest.pem", tmp_path), ("ingest.key", tmp_path)):
        (mixed / name).write_bytes((source / name).read_bytes())
    with pytest.raises(ValueError, match=r"ingest\.pem was not signed by the authority in .*ca\.pem"):
        member(router, mixed, "ingest")
    assert "the router refuses the certificate of ingest" in str(security.refusal(router, mixed, "ingest"))


def test_who_signed_the_right_name_himself_is_refused(router, folder, tmp_path):
    keys.create(tmp_path, ["x"])
    authority = tmp_path / "authority" / "ca.key"
    (tmp_path / "router.pem").write_bytes((tmp_path / "ca.pem").read_bytes())
    (tmp_path / "router.key").write_bytes(authority.read_bytes())
    with pytest.raises(zenoh.ZError):
        raw(router, folder, shown(tmp_path, "router"))


def test_an_expired_certificate_is_refused_and_told(router, folder, tmp_path):
    old = tmp_path / "old"
    (old / "authority").mkdir(parents=True)
    for name in ("ca.pem", "authority/ca.key"):
        (old / name).write_bytes((folder / name).read_bytes())
    keys.create(old, ["ingest"], days=-1)
    with pytest.raises(zenoh.ZError):
        raw(router, folder, shown(old, "ingest"))
    with pytest.raises(ValueError, match=r"ingest\.pem expired on \d{4}-.* UTC: make a new one"):
        member(router, old, "ingest")


def test_a_link_ends_when_its_certificate_does(router, folder, tmp_path):
    short = tmp_path / "short"
    (short / "authority").mkdir(parents=True)
    for name in ("ca.pem", "authority/ca.key"):
        (short / name).write_bytes((folder / name).read_bytes())
    keys.create(short, ["viewer"], days=4 / 86400)
    with member(router, short, "viewer") as viewer:
        assert viewer.connected
        wait_for(lambda: not viewer.connected)


def test_who_calls_in_the_clear_is_refused_and_told(router):
    plain = router.replace("tls/", "tcp/")
    with pytest.raises(zenoh.ZError):
        open_session(settings("client", connect=[plain])).close()
    with pytest.raises(OSError, match="what listens there wants certificates: use tls/ and --credentials"):
        Bus("s", connect=[plain], wait=5)


def test_a_router_called_by_a_name_that_it_has_not_is_refused(router, folder, tmp_path):
    named = tmp_path / "named"
    keys.create(named, hosts=["ground.example"])
    endpoint = f"tls/127.0.0.1:{free_port()}"
    end = carried(endpoint, named)
    try:
        with pytest.raises(OSError, match="the router's certificate is not good: IP address mismatch"):
            member(endpoint, named, "viewer")
    finally:
        end()


def test_who_carries_the_bus_of_its_own_stage_has_the_same_rules(folder):
    endpoint = f"tls/127.0.0.1:{free_port()}"
    received: list = []
    with (
        Bus("s", listen=[endpoint], credentials=folder) as carrier,
        member(endpoint, folder, "record") as record,
        member(endpoint, folder, "viewer") as viewer,
    ):
        thread = threading.Thread(target=collect, args=(record.subscribe("record", ["ingest"]), received))
        thread.start()
        forged = viewer.token("alive", "ingest", "f" * 24, "-")
        assert publish(carrier, "ingest", stream(30))
        thread.join(20)
        forged.undeclare()
    assert heard(received) == list(range(31))


def test_what_is_too_large_does_not_pass_the_router(folder, monkeypatch):
    monkeypatch.setattr(security, "LARGEST", 10_000)
    endpoint = f"tls/127.0.0.1:{free_port()}"
    end = carried(endpoint, folder)
    try:
        with member(endpoint, folder, "ingest") as ingest, member(endpoint, folder, "viewer") as viewer:
            heard_sizes: list[int] = []
            subscriber = viewer.session.declare_subscriber(
                "sortie/s/ingest/**", lambda sample: heard_sizes.append(len(sample.payload))
            )

            def arrived() -> bool:
                for size in (20_000, 9_000):
                    ingest.session.put("sortie/s/ingest/1/x/y", bytes(size))
                return len(heard_sizes) > 3

            wait_for(arrived)
            subscriber.undeclare()
        assert set(heard_sizes) == {9_000}
    finally:
        end()


def test_any_router_can_have_the_same_rules_from_a_file(folder):
    endpoint = f"tls/127.0.0.1:{free_port()}"
    config = zenoh.Config.from_json5(router_file([endpoint], folder))
    assert '"default_permission":"deny"' in config.get_json("access_control").replace(" ", "")
    with zenoh.open(config):
        with member(endpoint, folder, "viewer") as viewer:
            assert viewer.connected
        with pytest.raises(zenoh.ZError):
            raw(endpoint, folder, {})


def test_the_example_shows_who_is_heard_and_who_is_not():
    command = [sys.executable, "examples/secure_bus.py"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    assert "heard 200 words of two stages\nheard 0 words of the viewer who spoke for ingest\n" in done.stdout
    assert done.stdout.count("refused: ") == 2


def test_a_router_needs_somewhere_to_listen():
    with pytest.raises(ValueError, match="a router listens somewhere"):
        router_config([])
