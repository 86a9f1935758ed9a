"""Frames in a stream are found wherever it is cut into blocks, and every byte is accounted for after every block."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from telemetry.frames import Frames, StreamScanner, join
from tests.telemetry.test_frames import DIALECT, archived, arrivals, evidence, read
from tests.telemetry.wire import Sender

STEP = 1_000_000
LINK = 2
MOST = 559


def listen(blocks: list[bytes], *, final: bool = True) -> list[Frames]:
    scanner = StreamScanner(DIALECT.crc_extra, LINK)
    return [scanner.scan(block, STEP * i, final and i == len(blocks)) for i, block in enumerate(blocks, 1)]


def said(batches: list[Frames]) -> tuple:
    """Frames and runs without their times."""
    frames, junk = evidence(join(batches))
    return [(*one[:-1],) for one in frames], [(run, *rest) for run, _, *rest in junk]


def cut(stream: bytes, edges: list[int]) -> list[bytes]:
    return [stream[a:b] for a, b in pairwise([0, *sorted(min(e, len(stream)) for e in edges), len(stream)])]


# Arrivals, and what makes runs long: more noise than a frame has bytes, and start bytes in a row.
streams = st.lists(
    st.one_of(
        arrivals, st.builds(lambda byte, n: bytes([byte]) * n, st.sampled_from([0, 0xFD, 0xFE]), st.integers(200, 700))
    ),
    min_size=1,
    max_size=6,
).map(b"".join)


@given(streams, st.lists(st.integers(0, 2000), max_size=12))
@settings(max_examples=300, deadline=None)
def test_frames_and_junk_are_the_same_however_the_stream_is_cut(stream, edges):
    whole, parts = listen([stream]), listen(cut(stream, edges))
    assert said(parts) == said(whole)
    assert join(parts).discarded + join(parts).length.sum() == len(stream)


@given(streams, st.lists(st.integers(0, 2000), max_size=12))
@settings(max_examples=200, deadline=None)
def test_after_every_block_frames_plus_discarded_plus_pending_are_the_bytes_in(stream, edges):
    came = told = 0
    blocks = cut(stream, edges)
    for block, found in zip(blocks, listen(blocks, final=False), strict=True):
        came += len(block)
        told += int(found.length.sum()) + found.discarded
        assert told + found.pending == came
        assert found.pending <= MOST


@given(streams, st.lists(st.integers(0, 2000), max_size=12))
@settings(max_examples=100, deadline=None)
def test_our_archive_reads_as_what_was_heard_on_the_stream(stream, edges):
    live = join(listen(cut(stream, edges)))
    assert evidence(join(read(archived(live, 4), links=4))) == evidence(live)


def test_byte_by_byte_every_frame_comes_with_its_last_byte():
    sender = Sender()
    frames = [sender.attitude(i) for i in range(5)]
    ends = np.cumsum([len(frame) for frame in frames])
    blocks = [bytes([byte]) for byte in b"".join(frames)]
    found = listen(blocks, final=False)
    assert [i + 1 for i, batch in enumerate(found) if len(batch)] == ends.tolist()
    assert [batch.frame(0) for batch in found if len(batch)] == frames
    whole = join(found)
    assert whole.t_rx.tolist() == (STEP * ends).tolist()
    assert whole.link.tolist() == [LINK] * 5
    assert [batch.until for batch in found] == [STEP * (i + 1) for i in range(len(blocks))]


def test_an_unknown_id_waits_for_the_byte_behind_it():
    sender = Sender()
    first, unknown = sender.attitude(1), sender.unknown()
    held, taken = listen([first + unknown, sender.attitude(2)], final=False)
    assert (len(held), held.pending) == (1, len(unknown))
    assert taken.known.tolist() == [False, True]
    _, refused = listen([first + unknown, b"?"], final=False)
    assert (len(refused), refused.pending) == (0, len(unknown) + 1)
    _, at_the_end = listen([first + unknown, b""])
    assert at_the_end.frame(0) == unknown


def test_a_damaged_frame_cut_in_two_is_counted_once():
    sender = Sender()
    good, bad = sender.attitude(1), bytearray(sender.attitude(2))
    bad[15] ^= 1
    stream = good + bytes(bad) + bytes(bad) + good
    for edge in range(len(stream)):
        found = join(listen([stream[:edge], stream[edge:]], final=False))
        assert [found.frame(i) for i in range(len(found))] == [good, good]
        assert [found.junk(i) for i in range(len(found.junk_start))] == [bytes(bad) * 2]
        assert found.junk_corrupt.tolist() == [True]


def test_noise_does_not_pile_up():
    scanner = StreamScanner(DIALECT.crc_extra)
    noise = np.random.default_rng(1).integers(0, 256, 200_000, dtype=np.uint8).tobytes()
    for i in range(0, len(noise), 1000):
        found = scanner.scan(noise[i : i + 1000], i)
        assert len(found) == 0
        assert found.pending == scanner.pending <= MOST
        assert (found.junk_length <= 280).all()
    assert scanner.scan(b"", len(noise), final=True).pending == 0


def test_a_length_byte_that_claims_too_much_only_delays_what_follows():
    sender = Sender()
    frames = [sender.attitude(i) for i in range(17)]
    stream = b"\xfd\xff\x00" + b"".join(frames)
    found = join(listen([stream[:100], stream[100:]], final=False))
    assert [found.frame(i) for i in range(len(found))] == frames
    assert found.discarded == 3
