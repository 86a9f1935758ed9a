"""Whatever bytes arrive: no exception, bounded memory, and every byte in the account.

A few thousand inputs here; as many as you like by hand, e.g. a million:
``SORTIE_FUZZ=1000000 pytest tests/telemetry/test_fuzz_frames.py``.
"""

from __future__ import annotations

import os
import resource
from collections import Counter
from collections.abc import Iterator
from itertools import pairwise
from random import Random

import fastcrc
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from telemetry.frames import Frames, StreamScanner, TlogScanner, join
from telemetry.ingest import ingest
from telemetry.messages import LinkBytes, Progress
from tests.telemetry.test_frames import DIALECT, account, junk_of, read, scan
from tests.telemetry.wire import Sender, tlog

INPUTS = int(os.environ.get("SORTIE_FUZZ", "4000"))
ROUND = 500
MOST = 559  # bytes that a stream may keep waiting
GROWTH = 400 << 20  # bytes by which the process may grow
US = 1_700_000_000_000_000
pytestmark = pytest.mark.timeout(300 + INPUTS // 500)
IDS = sorted(DIALECT.layouts)
SPOKEN = [
    0, 1, 2, 24, 27, 29, 30, 31, 33, 36, 74, 105, 109, 116, 124, 129, 132, 147, 168, 242, 251, 253, 295, 331, 11020,
]  # fmt: skip
INSERTED = [b"\xfd", b"\xfe\x09\x00", b"\x00junk\xff\xff"]
NOISE = [b"\xfe" * 300, bytes(20), b"\xfd\xff\x00"]


def checksum(frame: bytes, body: int, msgid: int) -> int:
    return fastcrc.crc16.mcrf4xx(frame[1:body] + bytes([DIALECT.crc_extra[msgid] & 255]), 0xFFFF)


def made(random: Random) -> bytes:
    """A whole frame, mostly of an id that is read, that says anything at all."""
    msgid = random.choice(SPOKEN if random.random() < 0.8 else IDS)
    size = DIALECT.layouts[msgid].itemsize
    size = min(random.choice([size, size, size, random.randrange(1, size + 1), size + 3]), 255)
    payload = random.choice([random.randbytes(size), bytes(size), random.randbytes(1) * size, b"\xff" * size])
    if random.random() < 0.5:  # a time since boot that goes on now and then
        payload = (random.randrange(1 << 20) * 10).to_bytes(8, "little")[: min(8, size)] + payload[8:]
    sysid, compid, seq = random.choice([1, 1, 1, 2, 255, random.randrange(256)]), random.choice([1, 1, 191]), 0
    seq = random.randrange(256)
    if msgid < 256 and random.random() < 0.4:
        frame = bytes([0xFE, size, seq, sysid, compid, msgid]) + payload
        body = len(frame)
        return frame + checksum(frame, body, msgid).to_bytes(2, "little")
    signed = random.random() < 0.1
    frame = bytes([0xFD, size, signed, random.choice([0, 0, 0, 7]), seq, sysid, compid]) + msgid.to_bytes(3, "little")
    frame += payload
    return frame + checksum(frame, len(frame), msgid).to_bytes(2, "little") + random.randbytes(13 * signed)


def spoilt(wire: bytes, random: Random) -> bytes:
    """The same with something wrong: a bit, a length, an id, bytes missing, repeated, or put in."""
    out = bytearray(wire)
    for _ in range(random.choice([1, 1, 1, 2, 5])):
        at = random.randrange(len(out)) if out else 0
        what = random.randrange(8)
        if not out or what == 0:
            out[at:at] = random.choice([random.randbytes(random.randrange(1, 40)), *INSERTED])
        elif what == 1:
            del out[at:]
        elif what == 2:
            del out[at : at + random.randrange(1, 20)]
        elif what == 3:
            out[at:at] = out[at : at + random.randrange(1, 60)]
        elif what == 4 and len(out) > 1:
            out[1] = random.choice([0, 1, 254, 255, random.randrange(256)])
        elif what == 5 and len(out) > 9:
            out[random.choice([2, 5, 7, 8, 9])] = random.randrange(256)
        else:
            out[at] ^= 1 << random.randrange(8)
    return bytes(out)


def arrival(random: Random) -> bytes:
    """One input: one or a few frames, whole or spoilt, or noise."""
    kind = random.random()
    if kind < 0.45:
        return made(random)
    if kind < 0.75:
        return spoilt(made(random), random)
    if kind < 0.85:
        return b"".join(made(random) if random.random() < 0.6 else spoilt(made(random), random) for _ in range(3))
    if kind < 0.92:
        return Sender(seq=random.randrange(256)).unknown()
    return random.choice([random.randbytes(random.randrange(300)), *NOISE, made(random) + NOISE[-1]])


def rounds(name: str) -> Iterator[tuple[Random, list[bytes]]]:
    for i in range(max(INPUTS // ROUND, 1)):
        random = Random(f"{name} {i}")
        yield random, [arrival(random) for _ in range(ROUND)]


def good_at(wire: bytes, i: int) -> int:
    """Length of the frame that begins at i, if its id is known and its checksum right, else 0."""
    at = frame_at(wire, i)
    if not at or at[2] not in DIALECT.layouts:
        return 0
    end, body, msgid = at
    return (end - i) * (checksum(wire[i:], body - i, msgid) == int.from_bytes(wire[body : body + 2], "little"))


def frame_at(wire: bytes, i: int) -> tuple[int, int, int] | None:
    """Where what begins at i would end, with and without checksum and signature, and its id."""
    head = {0xFD: 10, 0xFE: 6}.get(wire[i])
    if not head or i + head + 2 > len(wire) or (head == 10 and wire[i + 2] & 0xFE):
        return None
    body = i + head + wire[i + 1]
    end = body + 2 + 13 * (head == 10 and wire[i + 2])
    msgid = int.from_bytes(wire[i + 7 : i + 10], "little") if head == 10 else wire[i + 5]
    return (end, body, msgid) if end <= len(wire) else None


def plain(wire: bytes) -> list[tuple[bytes, bool]]:
    """Frames in bytes that are followed by nothing, and whether their ids are known: read one byte after the other."""
    found, i, aligned = [], 0, True
    while i < len(wire):
        length, known = good_at(wire, i), True
        if not length and aligned and (at := frame_at(wire, i)) and at[2] not in DIALECT.layouts:
            inside = wire[i : at[0]]
            if wire[at[0] : at[0] + 1] in (b"", b"\xfd", b"\xfe") and not any(
                good_at(inside, k) for k in range(1, len(inside))
            ):
                length, known = len(inside), False
        if length:
            found.append((wire[i : i + length], known))
        aligned = length > 0
        i += length or 1
    return found


def frames_in(found: Frames) -> list[tuple[bytes, bool]]:
    raw, known = found.data.tobytes(), found.known.tolist()
    return [(raw[a : a + n], k) for a, n, k in zip(found.start.tolist(), found.length.tolist(), known, strict=True)]


def test_datagrams_hold_the_frames_that_are_found_byte_by_byte():
    for _, wires in rounds("datagrams"):
        found = scan(*wires)
        assert frames_in(found) == [frame for wire in wires for frame in plain(wire)]
        assert account([found]) == sum(map(len, wires))
        assert (found.junk_length > 0).all()
        decoded = DIALECT.columns(found)
        assert sum(len(rows) for rows, _ in decoded.values()) == found.known.sum()


def test_a_stream_holds_the_frames_that_are_found_byte_by_byte_and_all_that_pymavlink_finds():
    ours = theirs = missed = 0
    for random, wires in rounds("stream"):
        stream = b"".join(wires)
        edges = sorted(random.randrange(len(stream)) for _ in range(random.choice([0, 10, 300])))
        scanner, batches, came, told = StreamScanner(DIALECT.crc_extra), [], 0, 0
        for i, (a, b) in enumerate(pairwise([0, *edges, len(stream)])):
            batches.append(scanner.scan(stream[a:b], i, b == len(stream)))
            came, told = came + b - a, told + int(batches[-1].length.sum()) + batches[-1].discarded
            assert told + scanner.pending == came
            assert scanner.pending <= MOST
        assert scanner.pending == 0
        found = frames_in(join(batches))
        assert found == plain(stream)
        peer = mavlink.MAVLink(None)
        peer.robust_parsing = True
        messages = peer.parse_buffer(stream) or []
        good = Counter(bytes(m.get_msgbuf()) for m in messages if m.get_msgId() in DIALECT.layouts)
        # A frame that lost its signature takes the bytes behind it for one; only the receiver's key would tell.
        signed = [frame[-13:] for frame, known in found if known and frame[0] == 0xFD and frame[2] & 1]
        for frame in good - Counter(frame for frame, known in found if known):
            missed += not any(cut[-n:] == frame[:n] for cut in signed for n in range(1, 14))
        ours, theirs = ours + sum(known for _, known in found), theirs + good.total()
    assert ours > theirs
    assert missed <= ours / 10_000  # in noise one checksum of 65 536 is right


def test_a_log_of_anything_reads_the_same_however_it_is_cut():
    for random, wires in rounds("log"):
        records = [(US + 1000 * i).to_bytes(8, "big") + wire for i, wire in enumerate(wires)]
        log = b"".join(spoilt(record, random) if random.random() < 0.05 else record for record in records)
        whole = read(log)
        parts = read(log, [random.randrange(len(log)) for _ in range(random.choice([1, 30]))])
        assert account(whole) == account(parts) == len(log)
        once, again = join(whole), join(parts)
        assert frames_in(once) == frames_in(again)
        assert once.t_rx.tolist() == again.t_rx.tolist()
        assert junk_of([once]) == junk_of([again])
        assert once.junk_corrupt.sum() == again.junk_corrupt.sum()
        assert all(good_at(frame, 0) == len(frame) for frame, known in frames_in(once) if known)


def told(batches: list[Frames], links: int) -> dict[str, int]:
    """The byte account that ingest ends with, summed over the links."""
    last: dict[str, LinkBytes] = {}
    final = False
    for message in ingest(batches, [str(i) for i in range(links)], DIALECT):
        if isinstance(message, LinkBytes):
            last[message.source] = message
        final = isinstance(message, Progress) and message.final
    assert final
    names = ("bytes", "frames", "unknown", "corrupt", "refused", "discarded", "pending")
    return {name: sum(int(getattr(row, name)[-1]) for row in last.values()) for name in names}


def test_ingest_survives_anything_and_its_byte_account_adds_up():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for random, wires in rounds("ingest"):
        batch = scan(*wires, links=2)
        live = told([batch], 2)
        assert live["bytes"] == sum(map(len, wires)) == int(batch.length.sum()) + live["discarded"]
        assert live["frames"] == len(batch)
        assert live["unknown"] == (~batch.known).sum()
        assert live["corrupt"] == batch.junk_corrupt.sum()
        log = tlog([(US + 1000 * i, wire) for i, wire in enumerate(wires)])
        log = log[: random.randrange(len(log) // 2, len(log))]
        batches = read(log, [len(log) // 3, len(log) // 2])
        replay = told(batches, 1)
        assert replay["bytes"] == len(log) - sum(b.headers for b in batches)
        assert replay["bytes"] == sum(int(b.length.sum()) for b in batches) + replay["discarded"] + replay["pending"]
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    assert grown * 1024 < GROWTH


def test_a_signalling_nan_is_a_nan_and_no_more():
    batches = []
    for sender in range(1, 9):
        size = DIALECT.layouts[105].itemsize
        payload = (1_000_000).to_bytes(8, "little") + b"\x01\x00\xa0\x7f" * 13 + b"\xff" * (size - 60)
        frame = bytes([0xFD, size, 0, 0, 0, sender, 1]) + (105).to_bytes(3, "little") + payload
        batches.append(frame + checksum(frame, len(frame), 105).to_bytes(2, "little"))
    assert told([scan(*batches)], 1)["frames"] == 8


@given(st.lists(st.binary(max_size=80), max_size=8), st.booleans())
@settings(max_examples=200, deadline=None)
def test_any_bytes_at_all_are_accounted_for(blocks, final):
    stream, log = StreamScanner(DIALECT.crc_extra), TlogScanner(DIALECT.crc_extra)
    size = sum(map(len, blocks))
    heard = [stream.scan(block, i, final and i == len(blocks)) for i, block in enumerate(blocks, 1)]
    logged = [log.scan(block, final and i == len(blocks)) for i, block in enumerate(blocks, 1)]
    for batches in (heard, logged) if blocks else ():
        assert account(batches) == size
    assert account([scan(*blocks)]) == size
    assert frames_in(scan(*blocks)) == [frame for block in blocks for frame in plain(block)]


def test_a_false_start_does_not_lose_the_seventeen_frames_behind_it_as_it_does_with_pymavlink():
    sender = Sender()
    stream = b"\xfd\xff\x00" + b"".join(sender.attitude(i) for i in range(17))
    peer = mavlink.MAVLink(None)
    peer.robust_parsing = True
    theirs = [m for m in peer.parse_buffer(stream) if m.get_type() == "ATTITUDE"]
    assert len(StreamScanner(DIALECT.crc_extra).scan(stream, 1, final=True)) == 17
    assert len(theirs) < 17
