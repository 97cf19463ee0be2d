"""A link queue believes its radio, and nobody else who says that the radio's buffer is full."""

from __future__ import annotations

import random
from typing import Any

import pytest

from rass_mav.app.duplicates import Duplicates
from rass_mav.app.linkqueue import LinkQueue
from rass_mav.core.messages import Chunk, Committed, Message, Urgency
from rass_mav.link.airtime import LEAST_THROTTLE
from rass_mav.link.budget import Budget
from rass_mav.link.radios import RADIOS
from rass_mav.mavlink.dialect import common
from rass_mav.mavlink.frames import FrameReader, FrameWriter
from rass_mav.mavlink.messages import STATUSTEXT
from rass_mav.mavlink.signing import Signer
from rass_mav.station.node import build_node
from rass_mav.store.memory import MemoryStore
from tests.some import some

from .agent_net import STRANGERS_KEY, AgentNet, agent_with_keys
from .build import settings_of
from .test_signed_links import state

SIK = (51, 68)


class Radio:
    """A link queue with a radio, and who else says RADIO_STATUS."""

    now = 0.0

    def __init__(self, mavlink: dict[str, Any] | None = None, *, stream: bool = True, known: str | None = None) -> None:
        """`known`: its name in the table of radios."""
        self.agent = build_node(settings_of(7, mavlink=mavlink or {}), MemoryStore(1), random.Random(1), now=0.0)
        self.link_queue = LinkQueue(
            self.agent, Duplicates(), budget=Budget(bytes_s=1000.0), radio=None if known is None else RADIOS[known],
            stream=stream, rng=random.Random(1), now=0.0,
        )  # fmt: skip

    def says(self, txbuf: int, now: float, sender: tuple[int, int] = SIK) -> None:
        message = common.MAVLink_radio_status_message(100, 100, txbuf, 10, 10, 0, 0)
        assert not any(self.link_queue.take(FrameWriter(*sender).message(message), now, lambda _: None))

    @property
    def throttle(self) -> float:
        assert self.link_queue.pacer is not None
        self.link_queue.pacer.next_at(self.now)
        return self.link_queue.pacer.throttle

    def texts(self) -> list[str]:
        """What the ground is told."""
        reader = FrameReader()
        heard = []
        until = self.now + 3.0
        while self.now < until:
            frames, self.now = self.agent.tend(self.now)
            heard += [f.payload[1:] for out in frames for f in reader.feed(out.frame) if f.message_id == STATUSTEXT]
        return [text.decode(errors="replace") for text in heard]


def test_a_radio_that_says_0_whatever_happens_does_not_slow_the_node_down() -> None:
    """DroneBridge for ESP32 always reports a txbuf of 0."""
    radio = Radio({"radio_system_id": 7})
    for now in range(60):
        radio.says(0, float(now), (7, 68))
    radio.now = 60.0
    assert radio.throttle == 1.0
    # This one measures: it is full now.
    radio.says(70, 61.0, (7, 68))
    radio.says(0, 62.0, (7, 68))
    radio.now = 62.0
    assert radio.throttle == 0.5


def test_a_radio_that_says_nothing_true_cannot_stall_the_node() -> None:
    """Of an unknown radio one report of anything but 0, forged or another radio's, makes all zeros count. What is known
    of DroneBridge decides it: no report does."""
    unknown, known = Radio({"radio_system_id": 7}), Radio(known="dronebridge")
    for radio in (unknown, known):
        radio.says(70, 0.0, (7, 68))
        for now in range(1, 61):
            radio.says(0, float(now), (7, 68))
        radio.now = 60.0
    assert unknown.throttle == LEAST_THROTTLE
    assert known.throttle == 1.0
    assert known.link_queue.report()["radio_status"] == {"system_id": 7, "component_id": 68, "txbuf": 0}
    assert known.link_queue.not_the_radio == 0


@pytest.mark.parametrize(
    ("known", "sender", "believed"),
    [
        ("sik", SIK, True),
        ("rfd900", SIK, True),
        ("sik", (7, 68), False),
        ("mlrs", (52, 68), True),
        ("elrs", (255, 68), True),
        ("elrs", (255, 1), False),
        ("dronebridge", (7, 68), False),
        ("halow", SIK, False),
    ],
)
def test_a_known_radio_is_believed_from_its_first_word(known: str, sender: tuple[int, int], believed: bool) -> None:
    """Also when that is 0: it is full."""
    radio = Radio(known=known)
    radio.says(0, 0.0, sender)
    assert (radio.throttle == 0.5) is believed


def test_a_radio_that_reports_a_hundred_times_a_second_is_no_flood_and_counts_once_a_second() -> None:
    """ExpressLRS. An unknown radio that does so is taken for a forger."""
    unknown, known = Radio({"radio_system_id": 255}), Radio(known="elrs")
    for radio in (unknown, known):
        for n in range(1500):
            radio.now = n / 100
            radio.says(10 if n == 730 else 95, radio.now, (255, 68))
    assert any("forged" in text for text in unknown.texts())
    assert known.link_queue.not_the_radio == 0
    assert not known.texts()
    # The one moment in which it was nearly full was not missed.
    slowed = Radio(known="elrs")
    for n in range(300):
        slowed.now = n / 100
        slowed.says(10 if n == 150 else 60, slowed.now, (255, 68))
    assert slowed.throttle == 0.5


@pytest.mark.parametrize(
    ("sender", "settings", "believed"),
    [
        (SIK, {}, True),
        ((51, 69), {}, False),
        ((7, 68), {}, False),
        ((7, 68), {"radio_system_id": 7}, True),
        (SIK, {"radio_system_id": 7}, False),
        ((3, 4), {"radio_system_id": 3, "radio_component_id": 4}, True),
    ],
)
def test_only_the_radio_is_believed(sender: tuple[int, int], settings: dict[str, int], believed: bool) -> None:
    radio = Radio(settings)
    radio.says(1, 0.0, sender)
    assert (radio.throttle == 0.5) is believed
    assert radio.link_queue.not_the_radio == (not believed)


def test_no_datagram_of_a_neighbour_is_the_radio() -> None:
    radio = Radio(stream=False)
    for n in range(5):
        radio.says(1, float(n))
    assert radio.throttle == 1.0
    assert radio.link_queue.report()["not_the_radio"] == 5


def test_a_radio_that_is_really_full_is_believed_for_as_long_as_it_says_so() -> None:
    radio = Radio()
    for n in range(300):
        radio.now = n * 0.5
        radio.says(10, radio.now)
    assert radio.throttle == LEAST_THROTTLE
    assert radio.link_queue.not_the_radio == 0


def test_forged_ones_slow_the_node_down_for_a_moment_only_and_the_ground_is_told() -> None:
    radio = Radio()
    slow = 0
    for n in range(60 * 20):
        radio.now = n / 20
        radio.says(1, radio.now)
        slow += radio.throttle < 1.0
    assert radio.throttle == 1.0, "while they still come"
    assert slow / 20 < 25.0
    assert any("forged" in text for text in radio.texts())
    radio.now += 11.0
    before = radio.link_queue.not_the_radio
    for _ in range(5):
        radio.now += 1.0
        radio.says(10, radio.now)
    assert radio.link_queue.not_the_radio == before, "it is quiet again: the radio is believed"
    assert radio.throttle < 0.1


def test_with_keys_only_the_radio_itself_is_heard_unsigned() -> None:
    agent = agent_with_keys(7)
    link_queue = LinkQueue(
        agent, Duplicates(), budget=Budget(bytes_s=1000.0), stream=True, rng=random.Random(1), now=0.0
    )
    before = state(agent)
    unsigned = FrameWriter(3, 191).tunnel(b"x", payload_type=33200)
    forged = FrameWriter(3, 191, Signer(STRANGERS_KEY, 0, 1)).tunnel(b"x", payload_type=33200)
    assert not any(link_queue.take(unsigned + forged + unsigned, 1.0, lambda _: None))
    assert state(agent) == before
    full = FrameWriter(*SIK).message(common.MAVLink_radio_status_message(100, 100, 5, 10, 10, 0, 0))
    assert not any(link_queue.take(full, 1.0, lambda _: None))
    assert link_queue.pacer is not None
    assert link_queue.pacer.throttle < 1.0
    assert (link_queue.report()["unsigned"], link_queue.report()["forged"]) == (2, 1)
    assert "unsigned" not in Radio().link_queue.report()


@pytest.mark.parametrize("urgency", [Urgency.BULK, Urgency.DATA])
def test_what_waited_in_the_queue_while_others_went_first_is_not_refused_by_its_hearer(urgency: Urgency) -> None:
    """Frames are signed when they are queued, and hearers refuse a timestamp that is too far below the highest."""
    net = AgentNet(agent_with_keys(1, base=True), agent_with_keys(2))
    net.steps(5)
    agent = net.agents[1]
    link_queue = LinkQueue(
        agent, Duplicates(), budget=Budget(bytes_s=57600.0, duty=1.0), rng=random.Random(1), now=net.now
    )  # fmt: skip
    link_queue.meet({1})
    now = net.now

    def queue(message: Message, urgency: Urgency) -> None:
        for outgoing in agent.peers.frames([message], agent.store, now):
            link_queue.push(agent.peers.leaving(outgoing._replace(urgency=urgency, target=1)), now)

    for number in range(60):
        queue(Chunk(1, 0xA1B2, number, False, b"chunk" * 20), urgency)
    left, before = 0, net.report(0)["refused"]
    while link_queue.pacer is not None and (due := link_queue.pacer.next_at(now)) is not None:
        now = max(now + 1e-6, due)
        while (queued := link_queue.pop(now)) is not None:
            assert len(queued.frame) == 12 + 5 + 5 + 100 + 13
            net.agents[0].peer_bytes(queued.frame, now)
            left += 1
            if left % 10 == 0:
                queue(Committed(2, 1, ((left, 1),), ()), Urgency.ANSWER)
                now += 1e-2
                answer = some(link_queue.pop(now))
                net.agents[0].peer_bytes(answer.frame, now)
    assert left == 60
    assert net.report(0)["refused"] == before
