"""Losses, boots and bytes against an injected truth.

A simulated vehicle numbers its frames, tells its boot clock and speaks over two links, one of which is behind the
other. Whatever is done to its frames on the way is written down here, in plain Python that shares nothing with what is
tested, and held against what the stage says.

``SORTIE_FUZZ`` multiplies the number of examples.
"""

from __future__ import annotations

import heapq
import os
from collections import defaultdict
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from telemetry.frames import scan_datagrams
from telemetry.ingest import Ingest, Settings
from telemetry.mavlink import Dialect
from telemetry.messages import Attitude, Event, LinkBytes, LinkStats, Message
from tests.telemetry.test_ingest import assert_same, columns
from tests.telemetry.wire import Sender

FUZZ = int(os.environ.get("SORTIE_FUZZ", "1"))
DIALECT = Dialect()
EPOCH = 1_700_000_000_000_000  # us
PERIOD = 40_000  # us between two frames of the autopilot
AUTOPILOT, GIMBAL = 1, 154
LINKS = ("a", "b")
FINE, DROP, TWICE, SWAP, DELAY, BROKEN = "fine", "drop", "twice", "swap", "delay", "broken"
FATES = st.sampled_from([FINE] * 5 + [DROP, DROP, TWICE, SWAP, DELAY, BROKEN])


@dataclass
class Sent:
    """One frame as it left the vehicle."""

    serial: int
    component: int
    boot: int
    number: int
    data: bytes
    sample: int | None = None  # what identifies the sample in it
    clock: int = 0  # ms since boot, not wrapped
    known: bool = True


@dataclass
class Heard:
    """What truly came over one link from one component."""

    numbers: dict[int, set[int]] = field(default_factory=lambda: defaultdict(set), repr=False)  # by boot
    received: int = 0
    twice: int = 0
    redundant: int = 0
    unknown: int = 0
    boots: list[int] = field(default_factory=list)

    @property
    def lost(self) -> int:
        return sum(max(some) - min(some) + 1 - len(some) for some in self.numbers.values())


class Vehicle(RuleBasedStateMachine):
    @initialize(
        lag=st.sampled_from([0, 300_000, 1_700_000]),
        boot_ms=st.sampled_from([2000, 2**32 - 20_000]),
        seq=st.integers(0, 255),
    )
    def begin(self, lag: int, boot_ms: int, seq: int) -> None:
        self.now = EPOCH  # us
        self.clock_zero = EPOCH - boot_ms * 1000
        self.lag = {0: 0, 1: lag}
        self.boot = 0
        self.number = {AUTOPILOT: seq, GIMBAL: 7}
        self.count = self.serial = 0
        self.risky = [0, 0]  # losses that an 8-bit counter cannot tell, per link
        self.steps = 0
        self.booted = EPOCH
        self.pending: list[tuple[int, int, int, bytes, Sent | None, bool]] = []  # arrivals under way
        self.order = 0
        self.arrived: list[tuple[int, int, bytes]] = []
        self.heard: dict[tuple[int, int], Heard] = defaultdict(Heard)
        self.first: dict[int, int] = {}  # frames that came, by identity: on which link first
        self.on: set[tuple[int, int]] = set()  # frames that came over a link
        self.bytes = [0, 0]
        self.frames = [0, 0]
        self.junk = [0, 0]
        self.corrupt = [0, 0]
        self.samples: dict[int, Sent] = {}  # that must come out
        self.shown: list[int] = [0, 0]  # newest boot that a link has shown
        self.outlived: set[int] = set()  # samples that came over one link after the other had shown a reboot
        self.stage = Ingest(LINKS, DIALECT, Settings())
        self.said: list[Message] = []
        self.last = EPOCH
        self.fly(30)

    # The vehicle

    def send(self, known: bool = True) -> list[Sent]:
        """The next frame of the autopilot, and now and then one of the gimbal; time goes on."""
        self.now += PERIOD
        self.count += 1
        self.serial += 1
        clock = (self.now - self.clock_zero) // 1000
        told = clock % 2**32
        out = []
        sender = Sender(1, AUTOPILOT, self.number[AUTOPILOT] % 256)
        sample = None
        if not known:
            data = sender.unknown()
        elif self.count % 25 == 0:
            data = sender.pack(mavlink.MAVLink_heartbeat_message(1, 3, 0, self.serial, 4, 3))
        elif self.count % 3 == 0:
            data = sender.pressure(told, 900.0)
        else:
            sample = self.serial
            data = sender.attitude(told, roll=sample * 1e-4)
        out.append(Sent(2 * self.serial, AUTOPILOT, self.boot, self.number[AUTOPILOT], data, sample, clock, known))
        self.number[AUTOPILOT] += 1
        if self.count % 12 == 0:
            data = Sender(1, GIMBAL, self.number[GIMBAL] % 256).heartbeat()
            out.append(Sent(2 * self.serial + 1, GIMBAL, 0, self.number[GIMBAL], data))
            self.number[GIMBAL] += 1
        return out

    def carry(self, sent: Sent, link: int, fate: str) -> None:
        """Put a frame on its way over a link."""
        at = self.now + self.lag[link]
        if fate == DROP:
            return
        if fate == BROKEN:
            data = bytearray(sent.data)
            data[-4] ^= 0x55
            if sent.known:
                self.put(at, link, bytes(data), None, True)
            return
        at += {SWAP: PERIOD + 4000, DELAY: 800_000}.get(fate, 0)
        self.put(at, link, sent.data, sent)
        if fate == TWICE:
            self.put(at + 300_000, link, sent.data, sent)

    def put(self, at: int, link: int, data: bytes, sent: Sent | None, corrupt: bool = False) -> None:
        self.order += 1
        heapq.heappush(self.pending, (at, self.order, link, data, sent, corrupt))

    # What arrives, and the truth about it

    def deliver(self, until: int) -> None:
        arrivals = []
        while self.pending and self.pending[0][0] <= until:
            at, _, link, data, sent, corrupt = heapq.heappop(self.pending)
            self.last = max(at // 4 * 4, self.last + 4)
            arrivals.append((self.last, link, data))
            self.bytes[link] += len(data)
            if sent is None:
                self.junk[link] += len(data)
                self.corrupt[link] += corrupt
                continue
            self.frames[link] += 1
            self.note(sent, link)
        self.arrived += arrivals
        if arrivals:
            self.said += self.stage.batch(batch(arrivals))

    def note(self, sent: Sent, link: int) -> None:
        heard = self.heard[link, sent.component]
        if (sent.serial, link) in self.on:
            heard.twice += 1
            heard.unknown += not sent.known
            return
        self.on.add((sent.serial, link))
        heard.received += 1
        heard.unknown += not sent.known
        heard.numbers[sent.boot].add(sent.number)
        if sent.boot not in heard.boots:
            heard.boots.append(sent.boot)
        if self.first.setdefault(sent.serial, link) != link:
            heard.redundant += 1
        elif sent.sample is not None:
            if sent.boot < max(self.shown):
                self.outlived.add(sent.sample)
            else:
                self.samples[sent.sample] = sent
        if sent.component == AUTOPILOT and sent.known:
            self.shown[link] = max(self.shown[link], sent.boot)

    # What can happen

    @rule(seconds=st.integers(1, 15))
    def fly(self, seconds: int) -> None:
        for _ in range(seconds * 1_000_000 // PERIOD):
            for sent in self.send():
                self.carry(sent, 0, FINE)
                self.carry(sent, 1, FINE)
        self.deliver(self.now)

    @rule(fates=st.lists(st.tuples(FATES, FATES), min_size=1, max_size=40))
    def suffer(self, fates: list[tuple[str, str]]) -> None:
        for fate in fates:
            for sent in self.send():
                for link in (0, 1):
                    self.carry(sent, link, fate[link])
        self.fly(1)

    @rule(links=st.sampled_from([(0,), (1,), (0, 1)]), frames=st.integers(2, 700))
    def lose(self, links: tuple[int, ...], frames: int) -> None:
        for _ in range(frames):
            for sent in self.send():
                for link in {0, 1} - set(links):
                    self.carry(sent, link, FINE)
        if frames > 60:
            for link in links:
                self.risky[link] += 1
        self.fly(2)

    @rule(seconds=st.sampled_from([1, 3, 12]))
    def pause(self, seconds: int) -> None:
        self.now += seconds * 1_000_000
        self.risky = [self.risky[0] + 1, self.risky[1] + 1]
        self.fly(2)

    @rule(frames=st.integers(1, 5))
    def speak_unknown(self, frames: int) -> None:
        for _ in range(frames):
            for sent in self.send(known=False):
                self.carry(sent, 0, FINE)
                self.carry(sent, 1, FINE)
        self.deliver(self.now)

    @rule(link=st.sampled_from([0, 1]), size=st.integers(1, 60))
    def noise(self, link: int, size: int) -> None:
        self.put(self.now + self.lag[link], link, bytes(i * 7 % 200 for i in range(size)), None)
        self.deliver(self.now)

    @rule(silence=st.sampled_from([0, 4, 15]), begin=st.sampled_from([500, 2000]))
    def reboot(self, silence: int, begin: int) -> None:
        while self.now - self.booted < 15_000_000:
            self.fly(5)
        self.now += 900_000 + silence * 1_000_000  # what is under way over a link arrives before the reboot shows on it
        self.boot += 1
        self.booted = self.now
        self.clock_zero = self.now - begin * 1000
        self.number[AUTOPILOT] = 0
        self.count += 1 - self.count % 3  # the first frames tell the time
        self.count += (self.count % 25 > 15) * 12
        if silence == 15:
            self.risky = [self.risky[0] + 1, self.risky[1] + 1]
        self.fly(5)

    @rule(back=st.sampled_from([1300, 2500]))
    def step(self, back: int) -> None:
        self.fly(1)
        while self.now - self.booted < 30_000_000 or (self.now - self.clock_zero) // 1000 % 2**32 < 25_000:
            self.fly(5)
        self.now += 900_000
        self.clock_zero += back * 1000 + 900_000
        self.steps += 1
        self.fly(5)

    # What must hold

    @invariant()
    def numbers_have_one_fate_each(self) -> None:
        for key in getattr(self, "heard", {}):
            account = self.stage.accounts[(key[0], 1, key[1])].counters
            held = account["open"] + account["held"]
            assert account["spanned"] == account["received"] + account["lost"] - account["late"] + held

    def teardown(self) -> None:
        if not hasattr(self, "stage"):
            return
        self.now += 5_000_000
        self.deliver(self.now)
        self.said += self.stage.finish()
        self.check_accounts()
        self.check_bytes()
        self.check_samples()
        self.check_cuts()

    def check_accounts(self) -> None:
        for (link, component), truth in self.heard.items():
            found = [m for m in self.said if isinstance(m, LinkStats) and m.source == f"{LINKS[link]}/{component}"]
            told = {name: int(getattr(found[-1], name)[-1]) for name in found[-1].__struct_fields__[6:16]}
            note = f"link {link} component {component}: {told}, truth {truth} lost={truth.lost}"
            risky = self.risky[link]
            distinct = told["received"] + told["conflict"]
            net = told["lost"] - told["late"]
            assert told["redundant"] == truth.redundant, note
            assert told["unknown"] == truth.unknown, note
            assert told["restarted"] == len(truth.boots) - 1, note
            if not risky:
                assert (told["received"], told["duplicate"], told["conflict"]) == (truth.received, truth.twice, 0), note
                assert net == truth.lost, note
            else:
                assert distinct + told["duplicate"] == truth.received + truth.twice, note
                assert (net + told["received"] - truth.lost - truth.received) % 256 == 0, note
                assert abs(net - truth.lost) <= 256 * risky, note

    def check_bytes(self) -> None:
        for link in (0, 1):
            found = [m for m in self.said if isinstance(m, LinkBytes) and m.source == LINKS[link]]
            if not found:
                assert self.bytes[link] == 0
                continue
            last = found[-1]
            told = (last.bytes[-1], last.frames[-1], last.discarded[-1], last.corrupt[-1])
            assert told == (self.bytes[link], self.frames[link], self.junk[link], self.corrupt[link])

    def check_samples(self) -> None:
        said = [text for m in self.said if isinstance(m, Event) for text in m.text]
        assert sum("rebooted" in text for text in said) == self.boot, said
        assert sum("stepped back without a reboot" in text for text in said) == self.steps, said
        used: dict[int, tuple[int, int]] = {}
        for m in self.said:
            if isinstance(m, Attitude):
                assert m.source == "a/1"
                for phi, t in zip(m.phi.tolist(), m.t.tolist(), strict=True):
                    sample = round(phi * 1e4)
                    assert sample not in used, f"sample {sample} is used twice"
                    used[sample] = m.boot, t
        assert used.keys() == self.samples.keys(), (used.keys() ^ self.samples.keys(), self.outlived)
        anchors = defaultdict(set)
        for sample, (boot, t) in used.items():
            assert boot == self.samples[sample].boot
            anchors[boot].add(t - self.samples[sample].clock * 1_000_000)
        assert all(len(some) == 1 for some in anchors.values()), anchors

    def check_cuts(self) -> None:
        cuts = np.random.default_rng(len(self.arrived)).integers(0, len(self.arrived) + 1, 12)
        edges = [0, *sorted(cuts.tolist()), len(self.arrived)]
        stage, again = Ingest(LINKS, DIALECT, Settings()), []
        for first, last in pairwise(edges):
            if last > first:
                again += stage.batch(batch(self.arrived[first:last]))
        again += stage.finish()
        assert_same(columns(again), columns(self.said))


def batch(arrivals: list[tuple[int, int, bytes]]):
    us, links, pieces = zip(*arrivals, strict=True)
    bounds = np.cumsum([0] + [len(piece) for piece in pieces])
    data = np.frombuffer(b"".join(pieces), np.uint8)
    t_rx = np.array(us, np.int64) * 1000
    return scan_datagrams(data, bounds, t_rx, np.array(links, np.uint8), DIALECT.crc_extra)


TestVehicle = Vehicle.TestCase
TestVehicle.settings = settings(
    max_examples=12 * FUZZ,
    stateful_step_count=8,
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
)
