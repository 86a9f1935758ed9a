"""Frames are found wherever they begin, and every byte is accounted for."""

from __future__ import annotations

import tempfile
from itertools import pairwise
from pathlib import Path

import fastcrc
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from telemetry.archive import RawLog
from telemetry.frames import DAY, STX1, STX2, Frames, TlogScanner, join, scan_datagrams, write_junk, write_record
from telemetry.mavlink import Dialect
from tests.telemetry.wire import DATA, LOGS, Sender, tlog

DIALECT = Dialect()


US = 1_700_000_000_000_000


def scan(*datagrams: bytes, links: int = 1):
    data = np.frombuffer(b"".join(datagrams), np.uint8)
    bounds = np.cumsum([0] + [len(d) for d in datagrams])
    count = np.arange(len(datagrams))
    return scan_datagrams(data, bounds, 1_000_000 * (count + 1), (count % links).astype(np.uint8), DIALECT.crc_extra)


def read(log: bytes, cuts: list[int] | None = None, links: int = 1):
    scanner = TlogScanner(DIALECT.crc_extra, links)
    edges = [0, *sorted(cuts or []), len(log)]
    return [
        scanner.scan(log[a:b], final=b == len(log) and i == len(edges) - 2) for i, (a, b) in enumerate(pairwise(edges))
    ]


def account(batches) -> int:
    """Bytes in frames, headers, discarded and, at the end, pending."""
    return sum(int(b.length.sum()) + b.headers + b.discarded for b in batches) + batches[-1].pending


def frames_of(batches) -> list[tuple[int, bytes]]:
    return [(int(b.t_rx[i]) // 1000, b.frame(i)) for b in batches for i in range(len(b))]


def junk_of(batches) -> bytes:
    return b"".join(b.junk(i) for b in batches for i in range(len(b.junk_start)))


def test_both_versions_and_their_headers():
    one, two = Sender(3, 7, seq=200, version=1).attitude(5), Sender(4, 8, seq=255).attitude(6)
    found = scan(one + two)
    assert found.frame(0) == one
    assert found.frame(1) == two
    assert found.sysid.tolist() == [3, 4]
    assert found.compid.tolist() == [7, 8]
    assert found.seq.tolist() == [200, 255]
    assert found.msgid.tolist() == [30, 30]
    assert (one[0], two[0]) == (STX1, STX2)


@pytest.mark.parametrize("position", [1, 10, 20])
def test_a_corrupt_frame_is_counted_and_kept_and_its_neighbours_survive(position):
    sender = Sender()
    good = [sender.attitude(i) for i in range(3)]
    bad = bytearray(good[1])
    bad[position] ^= 0x40
    found = scan(good[0] + bytes(bad) + good[2])
    assert [found.frame(i) for i in range(len(found))] == [good[0], good[2]]
    assert found.junk(0) == bytes(bad)
    assert found.junk_corrupt.tolist() == [True]


def test_a_length_byte_that_claims_too_much_does_not_swallow_what_follows():
    sender = Sender()
    good = [sender.attitude(i) for i in range(17)]
    found = scan(b"\xfd\xff\x00" + b"".join(good))
    assert len(found) == 17
    assert found.discarded == 3


def test_a_datagram_is_not_continued_in_the_next():
    frame = Sender().attitude(1)
    found = scan(frame[:20], frame[20:] + frame)
    assert len(found) == 1
    assert found.discarded == len(frame)
    assert found.junk_corrupt.tolist() == [True, False]


def test_an_unknown_id_is_a_frame_only_where_framing_on_both_sides_agrees():
    sender = Sender()
    found = scan(sender.attitude(1) + sender.unknown() + sender.attitude(2), sender.unknown(), sender.unknown() + b"?")
    assert found.known.tolist() == [True, False, True, False]
    assert found.discarded == len(sender.unknown()) + 1


def test_an_unknown_id_with_a_good_frame_in_it_is_a_false_start():
    sender = Sender()
    good = [sender.attitude(i) for i in range(17)]
    for size in range(256):  # wherever it claims to end, also where the next frame begins
        start = bytes([STX2, size, 0, 0, 0, 1, 1]) + (15_000_000).to_bytes(3, "little") + b"?"
        assert scan(start + b"".join(good)).known.sum() == 17
        log = tlog([(US, start), *((US + i, frame) for i, frame in enumerate(good))])
        assert join(read(log)).known.sum() == 17


def test_flags_from_the_future_are_not_parsed():
    frame = bytearray(Sender().attitude(1))
    frame[2] = 2
    assert len(scan(bytes(frame))) == 0


def test_a_signed_frame_is_thirteen_bytes_longer():
    frame = bytearray(Sender().attitude(1)[:-2])
    frame[2] = 1
    crc = fastcrc.crc16.mcrf4xx(bytes(frame[1:]) + bytes([int(DIALECT.crc_extra[30])]), 0xFFFF)
    signed = bytes(frame) + crc.to_bytes(2, "little") + bytes(13)
    found = scan(signed + Sender().heartbeat())
    assert found.length.tolist() == [len(signed), 21]
    assert found.checksum()[0] == crc


def test_noise_holds_no_frames():
    noise = np.random.default_rng(1).integers(0, 256, 100_000, dtype=np.uint8).tobytes()
    found = scan(noise)
    assert len(found) == 0
    assert found.discarded == len(noise)


pieces = st.lists(
    st.one_of(
        st.builds(lambda i: ("frame", i), st.integers(0, 2**32 - 1)),
        st.builds(lambda b: ("noise", b), st.binary(min_size=1, max_size=60)),
        st.builds(
            lambda b: ("noise", b), st.sampled_from([b"\xfd", b"\xfe", b"\xfd\xfd\x00", b"\xfe\x09\x00", bytes(9)])
        ),
    ),
    max_size=12,
)


@given(st.lists(pieces, min_size=1, max_size=4))
@settings(max_examples=200, deadline=None)
def test_datagrams_frames_plus_discarded_are_the_bytes_in(datagrams):
    sender = Sender()
    wires = [b"".join(sender.attitude(x) if kind == "frame" else x for kind, x in d) for d in datagrams]
    found = scan(*wires)
    assert int(found.length.sum()) + found.discarded == sum(map(len, wires))
    assert (found.junk_length > 0).all()


@given(pieces, st.lists(st.integers(0, 600), max_size=5), st.integers(0, 40))
@settings(max_examples=300, deadline=None)
def test_a_log_reads_the_same_however_it_is_cut(parts, cuts, missing):
    sender = Sender()
    log = b"".join(
        (1_700_000_000_000_000 + i).to_bytes(8, "big") + sender.attitude(x) if kind == "frame" else x
        for i, (kind, x) in enumerate(parts)
    )
    log = log[: len(log) - missing]
    whole = read(log)
    pieces_ = read(log, [min(c, len(log)) for c in cuts])
    assert account(whole) == account(pieces_) == len(log)
    assert frames_of(pieces_) == frames_of(whole)
    assert junk_of(pieces_) == junk_of(whole)
    assert sum(b.junk_corrupt.sum() for b in pieces_) == sum(b.junk_corrupt.sum() for b in whole)


def archived(batch: Frames, links: int) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        log = RawLog(Path(folder) / "raw.tlog", links=links)
        log.write(batch)
        log.close()
        return log.path.read_bytes()


JUNK_COLUMNS = ("junk_t_rx", "junk_link", "junk_corrupt", "junk_refused")


def evidence(batch: Frames) -> tuple:
    """All that a batch says, in Python's types."""
    frames = [
        (batch.frame(i), *(int(getattr(batch, name)[i]) for name in ("msgid", "link", "seq", "known", "t_rx")))
        for i in range(len(batch))
    ]
    junk = [
        (batch.junk(i), *(int(getattr(batch, name)[i]) for name in JUNK_COLUMNS)) for i in range(len(batch.junk_start))
    ]
    return frames, junk


# Whole, cut and damaged frames of known and unknown ids, and noise that looks like the beginning of one or of a record.
arrivals = st.lists(
    st.one_of(
        st.builds(lambda ms: Sender(seq=ms % 256).attitude(ms), st.integers(0, 1000)),
        st.builds(lambda seq: Sender(seq=seq).unknown(), st.integers(0, 255)),
        st.builds(lambda ms, n: Sender().attitude(ms)[:n], st.integers(0, 1000), st.integers(1, 27)),
        st.builds(lambda n: b"\xfd\x10\x00\x00\x01\x01\x1e\x00" + bytes(n), st.integers(0, 40)),
        st.sampled_from([b"\xfd", b"\xfe", b"\xfe\x09\x00", b"\x00junk\xff\xff", bytes(8) + b"\x00junk\x02\x00"]),
        st.binary(min_size=1, max_size=40),
    ),
    min_size=1,
    max_size=4,
).map(b"".join)


@given(st.lists(arrivals, min_size=1, max_size=8), st.integers(1, 4), st.lists(st.integers(0, 900), max_size=6))
@settings(max_examples=300, deadline=None)
def test_our_archive_reads_as_what_arrived_however_it_is_cut(datagrams, links, cuts):
    live = scan(*datagrams, links=links)
    log = archived(live, links)
    replay = read(log, [min(c, len(log)) for c in cuts], links)
    whole = join(replay)
    assert evidence(whole) == evidence(live)
    assert (whole.discarded, whole.pending, whole.until) == (live.discarded, 0, live.until)
    assert whole.headers == 8 * len(live) + 15 * len(live.junk_start)
    for before, after in pairwise(replay):
        assert before.until <= after.until
        assert (after.t_rx > before.until).all()
        assert (after.junk_t_rx > before.until).all()


@given(arrivals)
@settings(max_examples=300, deadline=None)
def test_a_datagram_alone_gives_what_it_gives_among_others(datagram):
    alone, among = scan(datagram), scan(datagram, b"", b"")
    assert evidence(alone) == evidence(among)
    assert alone.sysid.tolist() == among.sysid.tolist()
    assert alone.compid.tolist() == among.compid.tolist()
    for name in alone.__dataclass_fields__:
        one, other = getattr(alone, name), getattr(among, name)
        if isinstance(one, np.ndarray):
            assert (one.dtype, one.shape, one.flags.c_contiguous) == (other.dtype, other.shape, True)
    assert alone.until == int(alone.t_rx[0]) if len(alone) else 1_000_000


@pytest.mark.parametrize("version", [1, 2])
def test_every_damage_to_a_lone_frame_is_seen(version):
    whole = Sender(3, 7, seq=200, version=version).attitude(5)
    assert scan(whole).known.tolist() == [True]
    for place in range(len(whole)):
        for bit in range(8):
            damaged = bytearray(whole)
            damaged[place] ^= 1 << bit
            assert not scan(bytes(damaged)).known.any()
    for end in range(len(whole)):
        assert not len(scan(whole[:end]))


@given(st.lists(arrivals, min_size=1, max_size=6), st.integers(1, 4), st.data())
@settings(max_examples=100, deadline=None)
def test_refused_frames_are_runs_of_their_own_live_and_out_of_the_archive(datagrams, links, data):
    batch = scan(*datagrams, links=links)
    mask = np.array(data.draw(st.lists(st.booleans(), min_size=len(batch), max_size=len(batch))), np.bool_)
    live = batch.refuse(mask)
    assert [live.frame(i) for i in range(len(live))] == [batch.frame(i) for i in np.flatnonzero(~mask)]
    assert live.junk_refused.sum() == (mask & batch.known).sum()
    assert live.junk_corrupt.sum() == batch.junk_corrupt.sum()
    assert live.discarded + live.length.sum() == sum(map(len, datagrams))
    assert (np.diff(live.junk_start) > 0).all()
    assert evidence(join(read(archived(live, links), links=links))) == evidence(live)


def test_every_cut_inside_a_junk_record_waits_for_the_rest():
    sender = Sender()
    log = write_record(US, sender.unknown()) + write_junk(US + 4, b"rubbish") + write_record(US + 8, sender.attitude(2))
    whole = evidence(join(read(log)))
    assert [len(part) for part in whole] == [2, 1]
    for cut in range(len(log)):
        found = join(read(log, [cut]))
        assert evidence(found) == whole
        assert (found.headers, found.pending) == (8 + 15 + 8, 0)


def test_a_batch_of_nothing_but_junk_moves_time_on():
    log = write_record(US, Sender().attitude(1)) + write_junk(US + 1000, b"noise") + write_junk(US + 2000, b"noise")
    first, middle, last = read(log, [len(log) - 40, len(log) - 10])
    assert first.until == US * 1000 - 1
    assert middle.until == (US + 1000) * 1000 - 1
    assert last.until == (US + 2000) * 1000


@pytest.mark.parametrize("byte", [0xFD, 0xFE])
@pytest.mark.parametrize("place", range(2, 8))
def test_a_start_byte_anywhere_in_a_time_changes_nothing(byte, place):
    us = int.from_bytes(bytes(byte if i == place else min(i, 6) for i in range(8)), "big")
    frames = [(us, Sender().attitude(place))]
    assert frames_of(read(tlog(frames))) == frames


@given(
    st.lists(st.sampled_from(["frame", "unknown", "junk"]), min_size=3, max_size=8),
    st.data(),
    st.lists(st.integers(0, 400), max_size=6),
)
@settings(max_examples=300, deadline=None)
def test_one_flipped_bit_in_a_time_dates_nothing_else(kinds, data, cuts):
    sender = Sender()
    records = [
        write_junk(US + 1000 * i, b"rubbish")
        if kind == "junk"
        else write_record(US + 1000 * i, sender.attitude(i) if kind == "frame" else sender.unknown())
        for i, kind in enumerate(kinds)
    ]
    hit = data.draw(st.integers(1, len(kinds) - 1))
    us = US + 1000 * hit ^ 1 << data.draw(st.integers(0, 63))
    clean = join(read(b"".join(records)))
    records[hit] = us.to_bytes(8, "big") + records[hit][8:]
    log = b"".join(records)
    found = join(read(log, [min(c, len(log)) for c in cuts]))
    assert (len(found), found.discarded, found.headers) == (len(clean), clean.discarded, clean.headers)
    expected = us if abs(us - US - 1000 * (hit - 1)) < DAY else US + 1000 * (hit - 1)
    times = [t // 1000 for t in sorted([*found.t_rx.tolist(), *found.junk_t_rx.tolist()])]
    assert times == sorted(expected if i == hit else US + 1000 * i for i in range(len(kinds)))


@pytest.mark.parametrize("step", [-50 * 365 * DAY, -2 * DAY, 2 * DAY, 50 * 365 * DAY])
def test_a_lasting_step_of_the_recorders_clock_is_kept(step):
    sender = Sender()
    frames = [(US + 1000 * i + (step if i >= 3 else 0), sender.attitude(i)) for i in range(6)]
    log = tlog(frames)
    for cut in range(len(log)):
        assert frames_of(read(log, [cut])) == frames


def test_a_damaged_time_keeps_its_link():
    sender = Sender()
    times = [US, US + 4 + 1 + (1 << 50), US + 8]
    found = join(read(tlog([(us, sender.attitude(i)) for i, us in enumerate(times)]), links=2))
    assert found.t_rx.tolist() == [US * 1000, US * 1000, (US + 8) * 1000]
    assert found.link.tolist() == [0, 1, 0]


def test_a_time_that_is_none_does_not_lose_its_frame():
    frames = [(10**15, Sender().attitude(0)), (2**63 + 5, Sender().attitude(1))]
    assert [f for _, f in frames_of(read(tlog(frames)))] == [f for _, f in frames]
    assert [t for t, _ in frames_of(read(tlog(frames)))] == [10**15, 10**15]


def test_a_log_cut_inside_its_last_frame_leaves_it_pending():
    sender = Sender()
    log = tlog([(1000, sender.attitude(1)), (2000, sender.attitude(2))])
    found = read(log[:-5])
    assert len(frames_of(found)) == 1
    assert found[-1].pending == 8 + len(sender.attitude(3)) - 5
    assert found[-1].discarded == 0


def test_garbage_between_records_is_skipped_and_counted():
    sender = Sender()
    a, b = (10**15, sender.attitude(1)), (10**15 + 5, sender.attitude(2))
    found = read(tlog([a]) + b"garbage \xfd in between" + tlog([b]))
    assert frames_of(found) == [a, b]
    assert junk_of(found) == b"garbage \xfd in between"


def test_our_own_archive_keeps_what_was_no_frame_with_its_time():
    sender = Sender()
    bad = bytearray(sender.attitude(1))
    bad[12] ^= 1
    log = write_record(1000, sender.attitude(0)) + write_junk(2000, bytes(bad)) + write_junk(3000, b"x" * 70000)
    found = join(read(log, [17, 60, 5000]))
    assert len(found) == 1
    assert found.junk(0) == bytes(bad)
    assert found.discarded == len(bad) + 70000
    assert found.junk_t_rx.tolist() == [2_000_000, 3_000_000, 3_000_000]
    assert found.junk_corrupt.tolist() == [True, False, False]


def test_link_numbers_travel_in_the_two_lowest_bits_when_the_log_says_so():
    frame = Sender().attitude(1)
    found = join(read(tlog([(4000, frame), (4007, frame)]), links=4))
    assert found.link.tolist() == [0, 3]
    assert found.t_rx.tolist() == [4_000_000, 4_004_000]


def test_a_link_number_beyond_the_links_is_damage():
    log = (
        write_record(4003, Sender().attitude(1)) + write_junk(8002, b"rubbish") + write_record(8005, Sender().unknown())
    )
    found = join(read(log, links=2))
    assert found.link.tolist() == [0, 1]
    assert found.junk_link.tolist() == [0]
    assert found.t_rx.tolist() == [4_000_000, 8_004_000]


def test_joined_batches_are_one():
    sender = Sender()
    batches = [scan(sender.attitude(i), b"junk") for i in range(3)]
    whole = join(batches)
    assert [whole.frame(i) for i in range(3)] == [b.frame(0) for b in batches]
    assert [whole.junk(i) for i in range(3)] == [b"junk"] * 3
    assert whole.select(np.array([2])).frame(0) == batches[2].frame(0)


@given(st.lists(arrivals, min_size=1, max_size=6), st.data())
@settings(max_examples=100, deadline=None)
def test_compact_frames_are_the_same_over_bytes_of_their_own(datagrams, data):
    batch = scan(*datagrams, links=2)
    rows = data.draw(
        st.lists(st.sampled_from(range(len(batch))), unique=True).map(sorted) if len(batch) else st.just([])
    )
    chosen = batch.select(np.array(rows, np.int64))
    found = chosen.compact()
    assert evidence(found) == evidence(chosen)
    assert found.checksum().tolist() == chosen.checksum().tolist()
    assert found.until == batch.until
    assert found.data.base is None
    assert len(found.data) == int(chosen.length.sum())


@pytest.mark.parametrize("name", LOGS)
def test_a_real_log_is_read_to_its_last_byte(name):
    path = DATA / name
    if not path.exists():
        pytest.skip(f"{path} is not here")
    log = path.read_bytes()
    found = read(log, list(range(100_000, len(log), 100_000)))
    assert account(found) == len(log)
    assert sum(b.discarded for b in found) == 0
    assert found[-1].pending == (31 if name.startswith("copter") else 0)
    counts = {
        "copter_2015_4reboots.tlog": 163_851,
        "sitl_quadplane_uavlogviewer_vtol.tlog": 23_894,
        "plane_2014_aerobatic_50hz.tlog": 74_759,
        "plane_swiss_137hz.tlog": 27_016,
    }
    assert sum(len(b) for b in found) == counts[name]
