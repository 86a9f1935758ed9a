"""A forged packet can neither pass nor lock out the aircraft."""

from __future__ import annotations

import hashlib
import json
import socket
import time
from pathlib import Path

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from telemetry.archive import RawLog
from telemetry.frames import STX2, scan_datagrams
from telemetry.signing import COPIES, SignatureGuard, read_key, sift
from tests.telemetry.receiving import DIALECT, Listening, evidence, free_port, replay, until
from tests.telemetry.wire import Sender

KEY, OTHER = bytes(range(32)), bytes(32)
EPOCH = 1_420_070_400
NOW = 1_700_000_000_000_000_000
LOOPBACK = "127.0.0.1"


class Signer:
    """A vehicle whose frames pymavlink signs."""

    def __init__(self, key: bytes = KEY, *, sysid: int = 1, link: int = 0, at: int = NOW) -> None:
        self.mav = mavlink.MAVLink(None, srcSystem=sysid, srcComponent=1)
        self.mav.signing.secret_key = key
        self.mav.signing.link_id = link
        self.mav.signing.sign_outgoing = True
        self.set_clock(at)

    def set_clock(self, ns: int) -> None:
        self.mav.signing.timestamp = (ns - EPOCH * 10**9) // 10_000

    def attitude(self, ms: int = 1) -> bytes:
        frame = bytes(mavlink.MAVLink_attitude_message(ms, 0.1, 0.2, 0.3, 0, 0, 0).pack(self.mav))
        self.mav.seq = (self.mav.seq + 1) % 256
        return frame


def radio_status(sysid: int = 51, compid: int = 68, *, version: int = 2) -> bytes:
    return Sender(sysid, compid, version=version).pack(mavlink.MAVLink_radio_status_message(1, 2, 3, 4, 5, 6, 7))


def test_a_frame_signed_with_the_key_passes_once():
    guard, frame = SignatureGuard(KEY), Signer().attitude()
    assert guard.check(frame, NOW) == "ok"
    assert guard.check(frame, NOW) == "replay"
    assert guard.counts == {"ok": 1, "replay": 1, "bad": 0, "future": 0, "unsigned": 0, "radio": 0}


def test_the_signature_is_that_of_the_specification():
    frame = Signer(sysid=7, link=5).attitude()
    assert frame[0] == STX2 and frame[2] & 1 and frame[-13] == 5
    assert frame[-6:] == hashlib.sha256(KEY + frame[:-6]).digest()[:6]
    assert SignatureGuard(KEY).check(frame, NOW) == "ok"


def test_every_changed_bit_is_found():
    frame = Signer().attitude()
    for i in range(8 * len(frame)):
        forged = bytearray(frame)
        forged[i // 8] ^= 1 << i % 8
        guard = SignatureGuard(KEY)
        assert not guard.passes(guard.check(bytes(forged), NOW))
    assert guard.check(frame, NOW) == "ok"


@pytest.mark.parametrize("far", [NOW, NOW + 30 * 10**9, NOW + 10**18])
def test_a_forged_frame_of_any_time_locks_nobody_out(far):
    guard, honest = SignatureGuard(KEY), Signer()
    assert guard.check(honest.attitude(), NOW) == "ok"
    assert guard.check(Signer(OTHER, at=far).attitude(), NOW) == "bad"
    assert guard.check(honest.attitude(), NOW) == "ok"


def test_a_time_that_lies_ahead_is_refused_and_not_remembered():
    guard, honest = SignatureGuard(KEY, ahead=60), Signer()
    assert guard.check(Signer(at=NOW + 61 * 10**9).attitude(), NOW) == "future"
    assert guard.check(honest.attitude(), NOW) == "ok"
    assert guard.check(Signer(at=NOW + 59 * 10**9).attitude(), NOW) == "ok"


def test_a_new_sender_may_be_a_minute_behind_and_no_more():
    guard = SignatureGuard(KEY)
    assert guard.check(Signer(at=NOW - 61 * 10**9).attitude(), NOW) == "replay"
    assert guard.check(Signer(at=NOW - 59 * 10**9).attitude(), NOW) == "ok"
    assert guard.check(Signer(sysid=2, at=NOW - 61 * 10**9).attitude(), NOW) == "replay"


def test_each_system_component_and_signing_link_has_its_own_time():
    guard = SignatureGuard(KEY)
    assert guard.check(Signer(at=NOW + 10**9).attitude(), NOW) == "ok"
    assert guard.check(Signer(at=NOW).attitude(), NOW) == "replay"
    assert guard.check(Signer(sysid=2).attitude(), NOW) == "ok"
    assert guard.check(Signer(link=3).attitude(), NOW) == "ok"
    assert guard.systems == {1, 2}


def test_the_same_frame_passes_once_over_each_link():
    guard, signer = SignatureGuard(KEY), Signer()
    frames = [signer.attitude(i) for i in range(50)]
    assert [guard.check(frame, NOW, link=0) for frame in frames] == ["ok"] * 50
    assert [guard.check(frame, NOW, link=1) for frame in frames] == ["ok"] * 50
    assert [guard.check(frame, NOW, link=1) for frame in frames] == ["replay"] * 50


def test_a_copy_is_known_for_a_while_only():
    guard, signer = SignatureGuard(KEY), Signer()
    frames = [signer.attitude(i) for i in range(COPIES + 1)]
    assert [guard.check(frame, NOW, link=0) for frame in frames] == ["ok"] * len(frames)
    assert guard.check(frames[0], NOW, link=1) == "replay"
    assert guard.check(frames[1], NOW, link=1) == "ok"


@pytest.mark.parametrize("version", [1, 2])
def test_unsigned_frames_pass_only_where_they_may(version):
    frame = Sender(version=version).attitude(1)
    strict, lenient = SignatureGuard(KEY), SignatureGuard(KEY, accept_unsigned=True)
    assert [guard.check(frame, NOW) for guard in (strict, lenient)] == ["unsigned"] * 2
    assert [guard.passes("unsigned") for guard in (strict, lenient)] == [False, True]


def test_a_wrong_signature_never_passes_where_none_would():
    guard = SignatureGuard(KEY, accept_unsigned=True)
    assert not guard.passes(guard.check(Signer(OTHER).attitude(), NOW))


@pytest.mark.parametrize("version", [1, 2])
def test_the_status_of_a_radio_needs_no_signature(version):
    guard = SignatureGuard(KEY)
    assert guard.passes(guard.check(radio_status(version=version), NOW))
    assert not guard.passes(guard.check(radio_status(1, 1, version=version), NOW))
    assert not guard.passes(guard.check(Sender(51, 68, version=version).attitude(1), NOW))
    assert guard.counts["radio"] == 1


def test_what_was_seen_before_a_restart_does_not_pass_after_it(tmp_path):
    seen, signer = tmp_path / "seen.json", Signer()
    frame = signer.attitude()
    before = SignatureGuard(KEY, seen=seen)
    assert before.check(frame, NOW) == "ok"
    before.save()
    after = SignatureGuard(KEY, seen=seen)
    assert after.check(frame, NOW) == "replay"
    assert after.check(signer.attitude(), NOW) == "ok"
    assert not list(tmp_path.glob("*.new"))


def test_a_file_that_cannot_be_written_is_told_and_checking_goes_on(tmp_path):
    guard = SignatureGuard(KEY, seen=tmp_path / "no folder" / "seen.json")
    assert guard.check(Signer().attitude(), NOW) == "ok"
    guard.save()
    assert "No such file or directory: what is recorded now could pass after a restart" in guard.error


@pytest.mark.parametrize(
    "content",
    ["", "{", "[]", "{}", json.dumps({"title": "something else", "last": []}), "\xff"]
    + [
        json.dumps({"title": "times of MAVLink signatures, 10 us since 2015", "last": last})
        for last in (1, [1], [[1, 2, 3]], [[1, 2, 3, "4"]], [[1, 2, 3, -4]], [[1, 2, 3, 4.0]])
    ],
)
def test_a_file_of_something_else_is_named(tmp_path, content):
    (tmp_path / "seen.json").write_bytes(content.encode("latin-1"))
    with pytest.raises(ValueError, match=r"seen\.json: it does not hold the times of signatures"):
        SignatureGuard(KEY, seen=tmp_path / "seen.json")


@pytest.mark.parametrize(
    ("content", "secret"),
    [
        (bytes(range(200, 232)), bytes(range(200, 232))),
        (KEY.hex().encode(), KEY),
        (b" " + KEY.hex().upper().encode() + b"\r\n", KEY),
        (b"correct horse", hashlib.sha256(b"correct horse").digest()),
        (b"correct horse\n", hashlib.sha256(b"correct horse").digest()),
        (b"x" * 32, hashlib.sha256(b"x" * 32).digest()),  # 32 bytes of text are a passphrase all the same
        ("Flügel".encode(), hashlib.sha256("Flügel".encode()).digest()),
    ],
)
def test_a_key_is_read_as_bytes_digits_or_a_passphrase(tmp_path, content, secret):
    path = tmp_path / "key"
    path.touch(0o600)
    path.write_bytes(content)
    assert read_key(path) == (key := read_key(path))
    assert key.secret == secret
    assert key.warning is None
    assert secret.hex() not in repr(key) and repr(secret) not in repr(key)


@pytest.mark.parametrize("content", [b"", b"\n", bytes(range(200, 230)), b"two\nlines", b"a" * 5000, b"\xff" * 5000])
def test_what_is_no_key_is_refused(tmp_path, content):
    path = tmp_path / "key"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"key: .*(no signing key|are)"):
        read_key(path)


def test_a_key_that_others_can_read_is_warned_of(tmp_path):
    path = tmp_path / "key"
    path.write_text("secret")
    path.chmod(0o640)
    assert f"chmod 600 {path}" in str(read_key(path).warning)


def test_a_key_of_another_length_is_refused():
    with pytest.raises(ValueError, match="a signing key has 32 bytes, not 3"):
        SignatureGuard(b"abc")


def test_a_refused_frame_becomes_a_run_of_its_own_in_its_place():
    sender = Sender()
    sent = [sender.attitude(i) for i in range(4)]
    data = b"".join([sent[0], b"noise", *sent[1:]])
    frames = scan_datagrams(
        np.frombuffer(data, np.uint8),
        np.array([0, len(data)]),
        np.array([8000], np.int64),
        np.array([2], np.uint8),
        DIALECT.crc_extra,
    )
    found = sift(frames, lambda frame, t_rx, link: (t_rx, link) == (8000, 2) and frame in sent[1:3])
    assert [found.frame(i) for i in range(len(found))] == [sent[0], sent[3]]
    assert [found.junk(i) for i in range(len(found.junk_start))] == [b"noise", sent[1], sent[2]]
    assert found.junk_corrupt.tolist() == [False] * 3
    assert found.junk_refused.tolist() == [False, True, True]
    assert found.junk_t_rx.tolist() == [8000] * 3 and found.junk_link.tolist() == [2] * 3
    assert found.until == frames.until


# In the receiver


def clock() -> int:
    return time.time_ns()


@pytest.mark.parametrize("stream", [False, True])
def test_what_the_guard_refuses_is_kept_as_junk_and_neither_handed_out_nor_passed_on(tmp_path, stream):
    honest, forger, unsigned = Signer(at=clock()), Signer(OTHER, at=clock() + 10**18), Sender()
    first = honest.attitude(1)
    sent = [
        first,
        forger.attitude(2),
        first,  # a replay
        unsigned.attitude(3),
        honest.attitude(4),
        Signer(at=clock() + 120 * 10**9).attitude(5),
        radio_status(),
        honest.attitude(6),
    ]
    allowed = [first, sent[4], sent[6], sent[7]]
    guard = SignatureGuard(KEY, seen=tmp_path / "seen.json")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as ground, socket.create_server((LOOPBACK, 0)) as server:
        ground.bind((LOOPBACK, 0))
        ground.settimeout(10)
        port = free_port()
        endpoint = f"tcp:{server.getsockname()[1]}" if stream else f"udpin:{port}"
        with Listening(
            endpoint,
            forward=[f"udpout:{ground.getsockname()[1]}"],
            guard=guard,
            raw_log=RawLog(tmp_path / "raw.tlog", links=2),
        ) as source:
            if stream:
                with server.accept()[0] as connection:
                    connection.sendall(b"".join(sent))
                    until(lambda: len(source.got) == 4)
            else:
                with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as vehicle:
                    for frame in sent:
                        vehicle.sendto(frame, (LOOPBACK, port))
                    until(lambda: len(source.got) == 4)
            assert [ground.recv(65535) for _ in allowed] == allowed
    found = source.all()
    assert source.got == allowed
    assert [found.junk(i) for i in range(len(found.junk_start))] == [sent[1], sent[2], sent[3], sent[5]]
    assert guard.counts == {"ok": 3, "radio": 1, "bad": 1, "replay": 1, "unsigned": 1, "future": 1}
    told = source.hear()
    for why in ("its signature is wrong", "not new", "it is not signed", "lies ahead"):
        assert (
            sum(why in line and "ALARM: link 0: 1 frame of system 1 refused" in line for line in told.splitlines()) == 1
        )
    assert evidence(replay(tmp_path / "raw.tlog", 2)) == evidence(found)  # and the replay has no key
    after = SignatureGuard(KEY, seen=tmp_path / "seen.json")
    assert after.check(sent[7], clock()) == "replay"


def test_a_flood_of_forged_frames_is_told_ten_times_more_rarely_each_time():
    port, forger = free_port(), Signer(OTHER)
    with (
        Listening(f"udpin:{port}", guard=SignatureGuard(KEY)) as source,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as vehicle,
    ):
        for i in range(150):
            vehicle.sendto(forger.attitude(i), (LOOPBACK, port))
        until(lambda: source.bytes_in == 150 * len(forger.attitude()))
    assert source.hear().splitlines() == [
        f"ALARM: link 0: {what}: its signature is wrong"
        for what in (
            "1 frame of system 1 refused",
            "10 frames refused, the last of system 1",
            "100 frames refused, the last of system 1",
        )
    ]


def test_a_ground_station_need_not_sign_but_cannot_speak_as_the_vehicle():
    vehicle_port, ground_port = free_port(), free_port()
    guard, honest = SignatureGuard(KEY), Signer(at=clock())
    with (
        Listening(f"udpin:{vehicle_port}", forward=[f"udpin:{ground_port}"], guard=guard) as source,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as vehicle,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as ground,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger,
    ):
        for sock in (vehicle, stranger):
            sock.settimeout(10)
        stranger.sendto(Signer(OTHER).attitude(), (LOOPBACK, vehicle_port))
        vehicle.sendto(honest.attitude(), (LOOPBACK, vehicle_port))
        until(lambda: len(source.got) == 1)
        said = [Sender(sysid=255).heartbeat(), Sender(sysid=1).attitude(9)]
        for frame in said:
            ground.sendto(frame, (LOOPBACK, ground_port))
        assert [vehicle.recv(300) for _ in said] == said  # which checks it itself
        until(lambda: len(source.got) == 2 and guard.counts["unsigned"] == 1)
        stranger.setblocking(False)
        with pytest.raises(BlockingIOError):  # who cannot sign is not answered either
            stranger.recv(300)
    assert source.all().sysid.tolist() == [1, 255]


def test_the_seen_file_is_written_at_the_end(tmp_path: Path):
    port, honest, seen = free_port(), Signer(at=clock()), tmp_path / "seen.json"
    with (
        Listening(f"udpin:{port}", guard=SignatureGuard(KEY, seen=seen)) as source,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as vehicle,
    ):
        vehicle.sendto(honest.attitude(), (LOOPBACK, port))
        until(lambda: len(source.got) == 1)
    assert json.loads(seen.read_text())["last"][0][:3] == [1, 1, 0]
