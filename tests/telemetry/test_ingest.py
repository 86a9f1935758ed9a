"""Frames become samples that do not depend on how they were cut into batches."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from telemetry.frames import Frames
from telemetry.ingest import Settings, guarded, ingest
from telemetry.mavlink import Dialect
from telemetry.messages import (
    AirData,
    Altitude,
    ClockFit,
    Event,
    Gnss,
    LinkBytes,
    LinkStats,
    Mark,
    Message,
    Progress,
    StatusText,
)
from tests.telemetry.test_frames import read, scan
from tests.telemetry.wire import DATA, LOGS, Sender, tlog

DIALECT = Dialect()
US = 1_700_000_000_000_000


def run(batches: Iterable[Frames], links=("0",)) -> list[Message]:
    return list(ingest(batches, links, DIALECT))


def told(messages: Iterable[Message], kind: type[Message]) -> list[Message]:
    return [m for m in messages if isinstance(m, kind)]


def texts(messages: Iterable[Message]) -> list[str]:
    return [text for m in told(messages, Event) for text in m.text]


def columns(messages: Iterable[Message]) -> dict:
    """Everything said, per stream, as if it had been said at once."""
    rows: dict = {}
    for m in messages:
        if isinstance(m, Progress | LinkBytes):
            continue
        mine = rows.setdefault((type(m).__name__, m.vehicle, m.source, m.boot), {})
        for name in m.__struct_fields__:
            value = getattr(m, name)
            if isinstance(value, np.ndarray):
                mine.setdefault(name, []).append(value)
            elif isinstance(value, list):
                mine.setdefault(name, []).append(np.array(value))
    whole = {key: {name: np.concatenate(parts) for name, parts in found.items()} for key, found in rows.items()}
    for key, found in whole.items():
        if key[0] == "Event":  # of one sender, but about different things: told as they become known
            order = np.lexsort((found["text"], found["t_rx"]))
            whole[key] = {name: column[order] for name, column in found.items()}
    return whole


def assert_same(a: dict, b: dict) -> None:
    assert a.keys() == b.keys()
    for key, found in a.items():
        for name, column in found.items():
            np.testing.assert_array_equal(column, b[key][name], err_msg=f"{key} {name}")


def flight(seconds: int = 20, boot_ms: int = 5000, reboot_at: int | None = None) -> list[tuple[int, bytes]]:
    """A vehicle at 4 Hz, rebooted once after 10 s of silence if asked for."""
    sender, frames, us, ms = Sender(), [], US, boot_ms
    for second in range(seconds):
        if second == reboot_at:
            sender, us, ms = Sender(), us + 10_000_000, 3000
        frames += [(us, sender.heartbeat()), (us + 1, sender.system_time(US, ms))]
        for quarter in range(4):
            t = ms + 250 * quarter
            frames += [
                (us + 250_000 * quarter + 10, sender.pressure(t, 900 + 0.01 * second)),
                (us + 250_000 * quarter + 20, sender.gps(t - 50, 47.0, 8.0, 500 + second)),
                (us + 250_000 * quarter + 30, sender.attitude(t)),
            ]
        us, ms = us + 1_000_000, ms + 1000
    return frames


def test_the_vehicle_clock_is_anchored_at_its_first_timed_frame():
    frames = flight(3)
    found = told(run(read(tlog(frames))), Altitude)[0]
    first_timed = (US + 1) * 1000
    assert found.t[0] == first_timed
    assert np.diff(found.t).tolist() == [250_000_000] * 11, "the vehicle's own intervals"
    assert found.t_rx[0] == (US + 10) * 1000


def test_a_fix_has_the_time_of_the_fix():
    fixes = told(run(read(tlog(flight(3)))), Gnss)[0]
    pressure = told(run(read(tlog(flight(3)))), Altitude)[0]
    assert (pressure.t - fixes.t == 50_000_000).all()


def test_a_reboot_begins_a_new_epoch():
    messages = run(read(tlog(flight(30, reboot_at=15))))
    assert [m.boot for m in told(messages, Altitude)] == [0, 1]
    assert any("rebooted: boot clock" in text for text in texts(messages))
    stats = told(messages, LinkStats)
    assert stats[-1].restarted[-1] == 1
    assert stats[-1].lost[-1] == 0, "the jump of a restart is no loss"


@given(st.lists(st.integers(0, 15_000), max_size=8))
@settings(max_examples=25, deadline=None)
def test_batches_do_not_change_what_is_said(cuts):
    log = tlog(flight(30, reboot_at=15))
    whole = columns(run(read(log)))
    assert_same(columns(run(read(log, [min(cut, len(log)) for cut in cuts]))), whole)


@pytest.mark.parametrize("name", LOGS)
def test_batches_do_not_change_what_a_real_log_says(name):
    path = DATA / name
    if not path.exists():
        pytest.skip(f"{path} is not here")
    log = path.read_bytes()
    random = np.random.default_rng(3)
    cuts = random.integers(0, len(log), 40).tolist()
    assert_same(columns(run(read(log, cuts))), columns(run(read(log))))


def test_progress_covers_all_that_was_told_and_ends():
    messages = run(read(tlog(flight(30, reboot_at=15)), list(range(200, 12_000, 500))))
    until = 0
    pending: list[int] = []
    for message in messages:
        if isinstance(message, Progress):
            assert message.t_rx[-1] >= until
            until = int(message.t_rx[-1])
        elif isinstance(message, Altitude):
            assert message.t_rx[0] > until, "nothing is told after its time has been covered"
            pending += message.t_rx.tolist()
    assert message.final
    assert until >= max(pending)


def test_a_vehicle_whose_clock_is_in_doubt_holds_nobody_else_up():
    a, b = Sender(1), Sender(2)
    log = [
        (US + i * 100_000, s.pressure(ms, 900)) for i in range(100) for s, ms in ((a, 100_000 + 100 * i), (b, 100 * i))
    ]
    log += [(US + 10_100_000, a.pressure(1000, 900)), (US + 10_200_000, b.pressure(10_100, 900))]
    messages = list(ingest(read(tlog(log)), ["0"], DIALECT))
    assert sum(len(m.t) for m in told(messages, Altitude) if m.vehicle == 2) == 101
    assert sum(len(m.t) for m in told(messages, Altitude) if m.vehicle == 1) == 101


def test_messages_without_a_time_take_that_of_their_neighbours():
    sender = Sender()
    log = [(US, sender.attitude(1000)), (US + 5, sender.text("TP 1 start")), (US + 9, sender.attitude(2000))]
    messages = run(read(tlog(log)))
    assert US * 1000 <= told(messages, Mark)[0].t[0] <= (US + 9) * 1000
    assert told(messages, StatusText)[0].text == ["TP 1 start"]


def test_another_component_has_its_own_clock_and_does_not_upset_the_autopilots():
    pilot, gimbal = Sender(1, 1), Sender(1, 154)
    log = [
        (US + i * 100_000, f)
        for i in range(50)
        for f in (gimbal.attitude(9_000_000 + i), pilot.pressure(1000 + 100 * i, 900))
    ]
    messages = run(read(tlog(log)))
    assert not any(
        "clock" in text or "reboot" in text for text in texts(messages) if "stepped back" in text and "90" not in text
    )
    found = told(messages, Altitude)
    assert sum(len(m.t) for m in found) == 50
    assert {m.boot for m in found} == {0}


def test_a_receive_clock_that_steps_back_is_told_and_time_runs_on():
    log = flight(10)
    later = [(us - 3_600_000_000, frame) for us, frame in flight(10, boot_ms=15_000)]
    messages = run(read(tlog(log + later)))
    assert any("the receive clock stepped back by" in text for text in texts(messages))
    t_rx = np.concatenate([m.t_rx for m in told(messages, Altitude)])
    assert (np.diff(t_rx) > 0).all()


def test_a_receive_clock_that_creeps_back_is_judged_by_the_newest_time_however_it_is_cut():
    sender = Sender()
    seconds = [0, 10, 9.2, 8.4, 20]
    log = tlog([(US + round(s * 1e6), sender.pressure(1000 + 1000 * i, 900)) for i, s in enumerate(seconds)])
    whole, cut = run(read(log)), run(read(log, [80, 120, 140]))
    assert_same(columns(cut), columns(whole))
    assert sum("the receive clock stepped back by" in text for text in texts(whole)) == 1


def test_an_unknown_id_does_not_invent_a_sender():
    messages = run(
        [scan(Sender(9).unknown(), Sender(1).attitude(1), Sender(1, 33).unknown(), Sender(1, seq=1).unknown())]
    )
    assert [(m.vehicle, m.source) for m in told(messages, LinkStats)] == [(1, "0/1")]
    assert told(messages, LinkStats)[-1].received[-1] == 2
    assert told(messages, LinkBytes)[-1].unknown[-1] == 3


def test_who_speaks_over_two_links_is_told_by_who_was_heard_first():
    sender = Sender()
    beats = [sender.heartbeat(), sender.heartbeat()]
    found = scan(*beats)
    linked = type(found)(
        **{n: getattr(found, n) for n in found.__dataclass_fields__} | {"link": np.array([1, 0], np.uint8)}
    )
    (said,) = told(run([linked], links=("0", "1")), Event)
    assert said.t_rx[0] == found.t_rx[0]


def test_a_mark_over_two_links_is_one_mark():
    sender = Sender()
    frames = [sender.attitude(1000), sender.text("TP 1 start")]
    found = scan(*frames, frames[1])
    linked = type(found)(
        **{n: getattr(found, n) for n in found.__dataclass_fields__} | {"link": np.array([0, 0, 1], np.uint8)}
    )
    assert len(told(run([linked], links=("0", "1")), Mark)) == 1


def test_every_byte_is_in_the_account_and_damage_is_told():
    log = tlog(flight(5)[:-3]) + b"rubbish" + tlog(flight(5)[-3:])
    messages = run(read(log[:-4]))
    account = told(messages, LinkBytes)[-1]
    frames = account.frames[-1]
    assert account.discarded[-1] == 7
    assert account.pending[-1] > 0
    assert account.bytes[-1] + 8 * frames == len(log) - 4
    assert "link 0: 7 bytes were no frame, 0 frames were corrupt" in texts(messages)
    assert any("the log ends inside a record" in text for text in texts(messages))


def test_a_rest_that_comes_alone_in_the_last_block_is_told():
    log = tlog(flight(2))
    messages = run(read(log + log[:20], [len(log)]))
    assert told(messages, LinkBytes)[-1].pending[-1] == 20
    assert any("the log ends inside a record: its last 20 bytes" in text for text in texts(messages))


def test_a_frame_of_an_unknown_id_fills_its_number_and_is_counted():
    sender = Sender()
    messages = run([scan(sender.attitude(1), sender.unknown(), sender.attitude(2))])
    assert told(messages, LinkBytes)[-1].unknown[-1] == 1
    assert told(messages, LinkStats)[-1].received[-1] == 3
    assert told(messages, LinkStats)[-1].lost[-1] == 0


def test_who_speaks_is_told_once():
    said = texts(run(read(tlog(flight(5)))))
    assert (
        said.count("system 1 component 1: quadrotor, autopilot ardupilotmega")
        + said.count("system 1 component 1: fixed wing, autopilot ardupilotmega")
        == 1
    )


def test_the_pattern_of_marks_is_a_setting():
    sender = Sender()
    log = tlog([(US, sender.attitude(1000)), (US + 5, sender.text("POINT 3 stop"))])
    settings_ = Settings(mark=r"POINT (?P<name>\d+) (?P<action>start|stop)")
    marks = told(ingest(read(log), ["0"], DIALECT, settings_), Mark)
    assert (marks[0].name, marks[0].action) == (["3"], ["stop"])


def marks(messages: Iterable[Message]) -> list[tuple]:
    return [(m.vehicle, m.boot, m.action[0], m.name[0], int(m.t[0])) for m in told(messages, Mark)]


def ground(*said: tuple[float, str], seq: int = 40) -> list[tuple[int, bytes]]:
    """What `sortie mark` sends, at seconds since the beginning; every mark has a number that continues nobody's."""
    return [(US + round(s * 1e6), Sender(255, 190, seq=seq + 17 * i).text(text)) for i, (s, text) in enumerate(said)]


def test_a_mark_from_the_ground_is_one_of_every_vehicle_at_its_own_time():
    """Vehicle 1 reads 5 s at the beginning, vehicle 2 drifts: it has counted 1.9 s of 2."""
    other = Sender(2)
    drifting = [(US + 100_000 * i, other.pressure(9000 + 95 * i, 900)) for i in range(40)]
    log = flight(4) + drifting + ground((2.05, "TP 3 start @0"), (2.55, "TP 3 stop @0"))
    messages = run(read(tlog(sorted(log))))
    t = (US + 1) * 1000
    assert marks(messages) == [  # in the middle between two readings, which are 250 and 95 ms apart
        (1, 0, "start", "3", t + 2_125_000_000),
        (1, 0, "stop", "3", t + 2_625_000_000),
        (2, 0, "start", "3", US * 1000 + 1_900_000_000 + 47_500_000),
        (2, 0, "stop", "3", US * 1000 + 2_375_000_000 + 47_500_000),
    ]
    assert {m.vehicle for m in told(messages, StatusText)} == {255}
    assert "ground station 255/190 marks the start of test point 3" in texts(messages)


def test_a_mark_from_the_ground_may_name_one_vehicle():
    other = Sender(2)
    log = flight(4) + [(US + 100_000 * i, other.pressure(9000 + 100 * i, 900)) for i in range(40)]
    messages = run(read(tlog(sorted(log + ground((2.05, "TP 3 start @2"))))))
    assert [m[:4] for m in marks(messages)] == [(2, 0, "start", "3")]


@pytest.mark.parametrize(
    ("said", "words"),
    [
        ((0.0, "TP 3 start"), "mark 'TP 3 start' is not used: no vehicle has been heard yet; say it again when one is"),
        ((6.0, "TP 3 start @9"), "mark 'TP 3 start @9' is not used: vehicle 9 has not been heard yet"),
        ((6.0, "TP 3 start @51"), "vehicle 51 has not been heard yet"),
    ],
)
def test_a_mark_for_nobody_is_told_and_dropped(said, words):
    """System 51 is a radio: it neither has an autopilot nor measures."""
    later = [(us + 5_000_000, frame) for us, frame in flight(4)]
    radio = [(US + 5_500_000, Sender(51, 68).heartbeat())]
    messages = run(read(tlog(sorted(later + radio + ground(said)))))
    assert marks(messages) == []
    (warning,) = [m for m in told(messages, Event) if m.level == ["warning"]]
    assert words in warning.text[0]
    assert warning.t_rx[0] == (US + said[0] * 1e6) * 1000


def test_a_mark_from_the_ground_after_a_reboot_belongs_to_the_new_boot():
    messages = run(read(tlog(sorted(flight(30, reboot_at=15) + ground((5, "TP 1 start"), (28.1, "TP 1 stop"))))))
    assert [m[:3] for m in marks(messages)] == [(1, 0, "start"), (1, 1, "stop")]


@pytest.mark.parametrize(("links", "later"), [((0, 1), 8.0), ((0, 0), 8.0)])
def test_a_mark_that_a_vehicle_passes_on_is_used_once(links, later):
    """The frame comes back over another link, or over the same one, long after the stop has been said."""
    log = flight(12) + ground((1.05, "TP 1 start @0"), (3.05, "TP 1 stop @0"))
    log += [(us + round(later * 1e6), frame) for us, frame in ground((1.05, "TP 1 start @0"))]
    log.sort()
    number = [links[1] if us == US + round((1.05 + later) * 1e6) else links[0] for us, _ in log]
    recorded = tlog([(us & ~3 | link, frame) for (us, frame), link in zip(log, number, strict=True)])
    messages = run(read(recorded, links=2), links=("0", "1"))
    assert [m[2] for m in marks(messages)] == ["start", "stop"]


def test_marks_from_the_ground_are_no_loss_of_the_ground_station():
    station = Sender(255, 190)
    beats = [(US + 1_000_000 * i + 7, station.heartbeat()) for i in range(30)]
    log = flight(30) + beats + ground((5.1, "TP 1 start @0"), (20.1, "TP 1 stop @0"), seq=200)
    messages = run(read(tlog(sorted(log))))
    account = [m for m in told(messages, LinkStats) if m.vehicle == 255][-1]
    assert (account.received[-1], account.lost[-1], account.conflict[-1], account.restarted[-1]) == (30, 0, 0, 0)
    assert told(messages, LinkBytes)[-1].frames[-1] == len(log), "but every frame is in the account of bytes"


@given(st.lists(st.integers(0, 17_000), max_size=8))
@settings(max_examples=25, deadline=None)
def test_batches_do_not_change_marks_from_the_ground(cuts):
    later = [(us + 3_000_000, frame) for us, frame in flight(30, reboot_at=15)]
    said = [
        (1, "TP 0 start"),
        (3.0, "TP 0 start"),
        (6, "TP 1 start @1"),
        (18.01, "TP 1 stop @1"),
        (36, "TP 2 start @4"),
    ]
    long = [
        (US + 20_000_000 + i, Sender(255, 190, seq=i).text(text, id=3, chunk_seq=i))
        for i, text in enumerate(["TP " + "x" * 47, "y" * 44 + " start"])
    ]
    log = tlog(sorted(later + ground(*said) + long))
    whole = run(read(log))
    assert [m[2:4] for m in marks(whole)] == [("start", "1"), ("stop", "1"), ("start", "x" * 47 + "y" * 44)]
    assert_same(columns(run(read(log, [min(cut, len(log)) for cut in cuts]))), columns(whole))


@given(st.lists(st.text("TP 1startop@09\x00\x1b\xff", max_size=30), max_size=6), st.sampled_from([0, 1, 255]))
@settings(max_examples=25, deadline=None)
def test_whatever_a_ground_station_says_harms_nothing(said, system):
    log = flight(3)
    for i, text in enumerate(said):
        log.append((US + 1_000_000 + 1000 * i, Sender(system, 190).text(text, id=i % 3, chunk_seq=5 * i)))
    messages = run(read(tlog(sorted(log))))
    assert sum(len(m.t) for m in told(messages, Altitude)) == 12
    assert {m.boot for m in told(messages, Altitude)} == {0}
    assert not [m for m in told(messages, LinkStats) if m.source == "0/1" and m.lost[-1]]


def empty(us: int) -> Frames:
    """Receive time has come so far, and nothing with it."""
    nothing = scan()
    return replace(nothing, until=us * 1000)


def test_empty_batches_change_nothing_but_how_far_time_has_come():
    log = flight(30, reboot_at=15)
    whole = read(tlog(log))
    parts = [batch for us, frame in log for batch in (*read(tlog([(us, frame)])), empty(us + 1))]
    last = log[-1][0]
    waited = run(parts + [empty(last + 1_000_000 * s) for s in range(1, 5)])
    found, expected = columns(waited), columns(run(whole))
    for key, rows in expected.items():
        if key[0] == "Event":
            assert found[key]["text"].tolist() == rows["text"].tolist()
        elif key[0] != "LinkStats":
            assert_same({key: found[key]}, {key: rows})
    assert told(waited, Progress)[-2].t_rx[-1] == (last + 4_000_000) * 1000
    stats = {key: rows for key, rows in expected.items() if key[0] == "LinkStats"}
    for key, rows in stats.items():
        inside = rows["t_rx"][:-1]
        assert found[key]["t_rx"][: len(inside)].tolist() == inside.tolist()


def test_an_empty_batch_says_only_how_far_time_has_come():
    (said,) = [m for m in run([empty(US)]) if not m.final]
    assert isinstance(said, Progress) and said.t_rx[-1] == US * 1000


class Log:
    """What `guarded` looks at of a raw log and of a source."""

    def __init__(self) -> None:
        self.path, self.error, self.warning = "raw.tlog", None, None
        self.notes: list[str] = []
        self.dropped = 0
        self.waiting: list[tuple[int, str, str]] = []

    def news(self):
        waiting, self.waiting = self.waiting, []
        return waiting


def test_trouble_is_told_at_once_while_nothing_arrives():
    log = Log()

    def batches() -> Iterator[Frames]:
        for i, change in enumerate(
            [
                {},
                {"error": "disk full"},
                {},
                {"error": None, "warning": "disk nearly full"},
                {"warning": None, "dropped": 7},
                {"notes": ["a hole", "a repair"], "waiting": [(5, "info", "link 0: connected")]},
                {},
            ]
        ):
            vars(log).update(change)
            yield empty(US + i * 100_000)

    said = [
        (round(m.t_rx[0] / 1e3 - US) if m.t_rx[0] > 5 else 5, m.level[0], m.text[0])
        for m in guarded(ingest(batches(), ["0"], DIALECT), log, log)
        if isinstance(m, Event)
    ]
    assert said == [
        (100_000, "error", "ALARM: disk full"),
        (300_000, "info", "raw.tlog: raw telemetry is being kept again"),
        (300_000, "warning", "disk nearly full"),
        (400_000, "info", "raw.tlog: there is room for raw telemetry again"),
        (400_000, "error", "ALARM: 7 frames are in the raw log only: ingest could not follow"),
        (5, "info", "link 0: connected"),
        (500_000, "warning", "a hole"),
        (500_000, "warning", "a repair"),
    ]


def test_frames_refused_for_their_signature_are_in_the_account():
    sender = Sender()
    frames = scan(sender.attitude(1), sender.attitude(2), sender.attitude(3))
    messages = run([frames.refuse(np.array([False, True, False]))])
    account = told(messages, LinkBytes)[-1]
    assert (account.frames[-1], account.refused[-1], account.corrupt[-1]) == (2, 1, 0)
    assert account.bytes[-1] == frames.length.sum()
    assert account.discarded[-1] == frames.length[1]
    assert told(messages, LinkStats)[-1].lost[-1] == 1


@pytest.mark.parametrize("steps", [(3,), (-3,), (5, -5), (-2, 2)])
def test_a_ground_clock_that_steps_by_hours_changes_neither_boots_nor_losses(steps):
    """It steps after every 100 s of flight, and there five frames are lost."""
    sender, log, shift = Sender(), [], 0
    for i in range(4000):
        if i and i % 1000 == 0 and i // 1000 <= len(steps):
            shift += steps[i // 1000 - 1] * 3_600_000_000
            for _ in range(5):
                sender.pressure(1, 900)
        log.append((US + 100_000 * i + shift, sender.pressure(5000 + 100 * i, 900)))
    messages = run(read(tlog(log)))
    stats = told(messages, LinkStats)[-1]
    assert (stats.received[-1], stats.lost[-1], stats.restarted[-1]) == (4000, 5 * len(steps), 0)
    samples = told(messages, Altitude)
    assert {m.boot for m in samples} == {0}
    assert (np.diff(np.concatenate([m.t for m in samples])) == 100_000_000).all()
    fit = told(messages, ClockFit)[-1]
    assert fit.valid[-1] and abs(fit.rate[-1]) < 1e-5
    assert sum("the receive clock stepped" in text for text in texts(messages)) == len(steps)


def test_vehicle_time_without_a_field_has_a_sigma_and_a_told_one_has_none():
    sender, log = Sender(), []
    for i in range(100):
        log.append((US + 100_000 * i, sender.pressure(5000 + 100 * i, 900)))
        log.append((US + 100_000 * i + 40_000, sender.pack(mavlink.MAVLink_vfr_hud_message(20, 21, 90, 50, 100, 0))))
    messages = run(read(tlog(log)))
    air = [m for m in told(messages, AirData) if m.t_sigma is not None]
    sigma = np.concatenate([m.t_sigma for m in air])[5:]
    np.testing.assert_allclose(sigma, 0.1 / np.sqrt(12), rtol=0.05)
    assert all(m.t_sigma is None for m in told(messages, Altitude))


def test_nothing_in_nothing_out_but_the_end():
    messages = run([])
    assert told(messages, Progress)[-1].final


@pytest.mark.parametrize(
    ("name", "boots", "words"),
    [
        ("copter_2015_4reboots.tlog", 5, "rebooted"),
        ("sitl_quadplane_uavlogviewer_vtol.tlog", 1, "stepped back without a reboot"),
    ],
)
def test_boots_of_the_real_logs(name, boots, words):
    path = DATA / name
    if not path.exists():
        pytest.skip(f"{path} is not here")
    messages = run(read(path.read_bytes()))
    assert {m.boot for m in told(messages, Gnss)} == set(range(boots))
    assert any(words in text for text in texts(messages))
    fits = told(messages, ClockFit)
    assert {reference for m in fits for reference in m.reference} == {"arrival", "system_time"}


def test_invented_senders_use_up_neither_memory_nor_time():
    frames = [Sender(sysid, compid).heartbeat() for sysid in range(1, 41) for compid in range(1, 101)]
    messages = run([scan(*frames)])
    assert len({(m.vehicle, m.source) for m in told(messages, LinkStats)}) == 1024
    said = texts(messages)
    assert any("frames of senders beyond the first 1024" in text for text in said)
    assert sum(" component " in text for text in said) <= 40 * 32
