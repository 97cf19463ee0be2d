"""The air that takes time: who hears a frame, when, and what frames do to each other."""

from __future__ import annotations

import random
from collections import Counter
from itertools import pairwise
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rass_mav.core.messages import BROADCAST
from rass_mav.lab.medium.channel import Csma, Datagram, Medium, Order, Tdma, Timeline
from rass_mav.lab.medium.drivers import Exposure
from rass_mav.lab.medium.neighbours import Position, RangeGraph, Reach
from rass_mav.lab.medium.settings import PRESETS, RadioSection
from tests.extent import examples
from tests.some import some

from .worlds import run, scenario, world_of

FRAME = bytes(100)


class Air:
    """Radios at fixed places, and what they hear."""

    def __init__(self, places: list[Position], seed: int = 1, **keys: Any) -> None:
        section = scenario(radio={"range_m": 10, "preset": "wifi-6m", **keys}).radio
        self.timeline = Timeline()
        self.heard: list[tuple[int, int, bytes, float]] = []
        reach = Reach(section, seed)
        reach.update(RangeGraph(places, 10.0).neighbours, places)
        kind = Csma if section.kind == "csma" else Tdma
        self.medium: Medium = kind(
            section, self.timeline, reach, self._hear, stations=len(places), step_s=1.0, rng=random.Random(seed),
            record=None,
        )  # fmt: skip
        self.channel = section.channel

    def _hear(self, hearers: Any, sender: int, frame: bytes, since: float, now: float) -> None:
        self.heard += [(sender, hearer, frame, now) for hearer in hearers]

    def send(self, sender: int, at: float, frame: bytes = FRAME, target: int = BROADCAST) -> None:
        self.timeline.at(at, Order.TURN, lambda now: self.medium.send(sender, frame, now, now, target))

    def run(self) -> list[tuple[int, int, bytes, float]]:
        self.timeline.run(float("inf"))
        return self.heard


LINE: list[Position] = [(0.0, 0.0), (9.0, 0.0), (18.0, 0.0)]


def test_events_happen_by_time_then_by_order_then_as_they_were_added() -> None:
    timeline, happened = Timeline(), list[str]()
    for time, order, name in [
        (2.0, Order.STRIKE, "later"), (1.0, Order.AIR, "air"), (1.0, Order.TURN, "first turn"),
        (1.0, Order.TURN, "second turn"), (1.0, Order.STRIKE, "strike"),
    ]:  # fmt: skip
        timeline.at(time, order, lambda now, name=name: happened.append(name))  # type: ignore[misc]
    timeline.run(2.0)
    assert happened == ["strike", "first turn", "second turn", "air"]
    timeline.run(2.1)
    assert happened[-1] == "later"


def test_a_frame_is_heard_when_its_last_bit_has_arrived() -> None:
    air = Air(LINE)
    air.send(0, 1.0)
    # Preamble 20 us, 164 bytes at 6 Mbit/s.
    ((sender, hearer, frame, now),) = air.run()
    assert (sender, hearer, frame) == (0, 1, FRAME)
    assert now == pytest.approx(1.0 + 20e-6 + 8 * 164 / 6e6)


def test_frames_that_are_sent_at_once_share_a_datagram() -> None:
    air = Air(LINE)
    for _ in range(7):
        air.send(0, 1.0)
    air.send(0, 1.0 + 1e-3)
    heard = air.run()
    assert list(Counter(now for *_, now in heard).values()) == [5, 2, 1]
    # Headers and preamble once for each datagram.
    assert heard[0][3] == pytest.approx(1.0 + 20e-6 + 8 * (64 + 500) / 6e6)
    assert air.medium.heard == 8


def test_frames_that_share_a_datagram_are_lost_together() -> None:
    air = Air(LINE, capture="none")
    for _ in range(3):
        air.send(0, 1.0)
    air.send(2, 1.0 + 300e-6)
    assert air.run() == []
    assert air.medium.collided == 4


def test_a_radio_waits_for_the_one_that_it_hears() -> None:
    air = Air(LINE)
    air.send(0, 1.0)
    air.send(1, 1.0 + 50e-6)
    assert [(sender, hearer) for sender, hearer, _, _ in air.run()] == [(0, 1), (1, 0), (1, 2)]
    assert air.medium.collided == 0


def test_a_backoff_may_have_no_slots() -> None:
    air = Air(LINE[:2], window=1)
    for number in range(401):
        air.send(0, 1.0 + 1e-6 * number)
    ends = [now for *_, now in air.run()]
    gaps = [after - before - air.channel.airtime(len(FRAME)) for before, after in pairwise(ends)]
    slots = Counter(round((gap - 34e-6) / 9e-6) for gap in gaps)
    assert set(slots) == {0, 1}
    assert 160 < slots[0] < 240


def test_hidden_radios_collide_at_the_one_between_them() -> None:
    air = Air(LINE, capture="none")
    air.send(0, 1.0)
    air.send(2, 1.0 + 50e-6)
    assert air.run() == []
    assert air.medium.collided == 2


def test_no_radio_is_hidden_if_all_notice_each_other_at_twice_the_range() -> None:
    air = Air(LINE, sense=2.0)
    air.send(0, 1.0)
    air.send(2, 1.0 + 50e-6)
    assert [(sender, hearer) for sender, hearer, _, _ in air.run()] == [(0, 1), (2, 1)]


def test_a_radio_that_sends_hears_nothing() -> None:
    air = Air(LINE[:2])
    # At the same moment: neither notices the other in time.
    air.send(0, 1.0)
    air.send(1, 1.0)
    assert air.run() == []
    assert air.medium.collided == 2


def test_a_receiver_keeps_the_frame_that_it_has_locked_on_to() -> None:
    slot_s = 9e-6
    for apart_s, heard in ((0.0, []), (0.5 * slot_s, []), (slot_s, [0]), (50e-6, [0])):
        air = Air(LINE, capture="first")
        air.send(0, 1.0)
        air.send(2, 1.0 + apart_s)
        assert [sender for sender, *_ in air.run()] == heard
        assert air.medium.collided == 2 - len(heard)


def test_a_receiver_that_has_missed_the_beginning_does_not_lock_on_to_what_follows() -> None:
    air = Air(LINE, capture="first")
    # Node 2 begins in the frame of node 0 and ends after it; node 0 sends again meanwhile.
    air.send(0, 1.0)
    air.send(2, 1.0 + 200e-6, bytes(400))
    air.send(0, 1.0 + 260e-6)
    assert [(sender, hearer) for sender, hearer, *_ in air.run()] == [(0, 1)]
    assert air.medium.collided == 2


def test_radios_with_slots_of_their_own_never_collide() -> None:
    air = Air(LINE, preset="sik-64k")
    for sender in (0, 1, 2):
        for _ in range(5):
            air.send(sender, 1.0)
    heard = air.run()
    assert Counter((sender, hearer) for sender, hearer, _, _ in heard) == {(0, 1): 5, (1, 0): 5, (1, 2): 5, (2, 1): 5}
    slot_s = air.channel.slot_s
    assert {(int(now / slot_s) % 3, sender) for sender, _, _, now in heard} == {(0, 0), (1, 1), (2, 2)}
    assert max(now for *_, now in heard) > 3 * slot_s


def test_radios_that_share_a_slot_collide() -> None:
    air = Air(LINE, preset="sik-64k", slots=2)
    air.send(0, 0.0)
    air.send(2, 0.0)
    assert air.run() == []


def test_a_full_radio_drops_frames() -> None:
    air = Air(LINE, queue_bytes=250)
    for _ in range(5):
        air.send(0, 1.0)
    assert len(air.run()) == 2
    assert air.medium.overflow == 3


def test_a_frame_breaks_off_when_its_radio_is_switched_off() -> None:
    air = Air(LINE)
    air.send(0, 1.0)
    air.send(0, 1.0)
    air.timeline.at(1.0 + 100e-6, Order.TURN, lambda now: air.medium.switch_off(0))
    assert air.run() == []


def test_half_of_the_frames_arrive_at_the_range_and_few_beyond() -> None:
    share = {}
    for distance in (7.0, 10.0, 13.0):
        air = Air([(0.0, 0.0), (distance, 0.0)], path_loss=3.0)
        for number in range(400):
            air.send(0, 1.0 + 0.01 * number)
        share[distance] = len(air.run()) / 400
    assert share[7.0] > 0.95
    assert 0.4 < share[10.0] < 0.6
    assert share[13.0] < 0.05


def test_shadowing_makes_single_links_better_and_worse_for_good() -> None:
    shares = []
    for seed in range(20):
        air = Air([(0.0, 0.0), (10.0, 0.0)], seed, path_loss=3.0, shadowing_db=8.0)
        for number in range(50):
            air.send(0, 1.0 + 0.01 * number)
        shares.append(len(air.run()) / 50)
    assert sum(share < 0.1 for share in shares) >= 4
    assert sum(share > 0.9 for share in shares) >= 4


#: SIFS, and an acknowledgement of 14 bytes with its preamble.
SIFS_S, ACK_S = 16e-6, 20e-6 + 8 * 14 / 6e6


def unicast(places: list[Position], **keys: Any) -> tuple[Air, Csma]:
    air = Air(places, mac="unicast", **keys)
    assert isinstance(air.medium, Csma)
    return air, air.medium


def test_a_frame_for_one_node_is_acknowledged_before_the_next() -> None:
    air, medium = unicast(LINE, window=0)
    air.send(0, 1.0, target=1)
    air.send(0, 1.0)
    (_, _, _, first), (_, _, _, second) = air.run()
    assert first == pytest.approx(1.0 + 20e-6 + 8 * 164 / 6e6)
    assert second == pytest.approx(first + SIFS_S + ACK_S + 34e-6 + 20e-6 + 8 * 164 / 6e6)
    assert (medium.repeats, medium.given_up) == (0, 0)


def test_others_leave_the_air_to_the_acknowledgement() -> None:
    # Node 2 hears the frame of node 1, and does not hear the acknowledgement of node 0.
    air, medium = unicast(LINE, window=0)
    air.send(1, 1.0, target=0)
    air.send(2, 1.0 + 50e-6)
    assert [(sender, hearer) for sender, hearer, *_ in air.run()] == [(1, 0), (1, 2), (2, 1)]
    assert medium.repeats == 0


def test_what_hidden_radios_destroy_is_sent_again() -> None:
    for seed in range(5):
        air, medium = unicast(LINE, seed=seed)
        for number in range(20):
            air.send(0, 1.0 + 0.02 * number, bytes([0, number]) * 50, target=1)
            air.send(2, 1.0 + 0.02 * number, bytes([2, number]) * 50, target=1)
        heard = air.run()
        assert Counter(sender for sender, *_ in heard) == {0: 20, 2: 20}
        assert medium.repeats >= 20
        assert medium.collided == 0


def test_a_node_that_is_gone_gets_a_frame_eight_times_and_then_it_is_given_up() -> None:
    air, medium = unicast(LINE)
    air.send(0, 1.0, target=2)
    air.send(0, 1.0)
    heard = air.run()
    assert (medium.repeats, medium.given_up) == (7, 1)
    # Its neighbour overhears it, once.
    assert [hearer for _, hearer, *_ in heard] == [1, 1]
    took = heard[1][3] - heard[0][3]
    assert took > 7 * (20e-6 + 8 * 164 / 6e6)
    # The window doubles up to 1023 slots.
    waits = []
    for seed in range(40):
        air, medium = unicast(LINE, seed=seed)
        air.send(0, 1.0, target=2)
        air.send(0, 1.0)
        heard = air.run()
        waits.append(heard[1][3] - heard[0][3])
    slots = sum(min(16 << tries, 1024) - 1 for tries in range(1, 8)) + 15
    try_s = 20e-6 + 8 * 164 / 6e6 + 34e-6 + SIFS_S + 9e-6 + 20e-6
    assert sum(waits) / len(waits) == pytest.approx(slots / 2 * 9e-6 + 8 * try_s, rel=0.15)


def test_a_frame_whose_acknowledgement_is_lost_is_heard_once() -> None:
    # Node 3 is hidden from node 1, and its frames destroy at node 0 what node 1 acknowledges.
    places = [(0.0, 0.0), (9.0, 0.0), (18.0, 0.0), (-9.0, 0.0)]
    air, medium = unicast(places)
    air.send(0, 1.0, target=1)
    end = 1.0 + 20e-6 + 8 * 164 / 6e6
    # It begins within half a slot of the acknowledgement.
    air.timeline.at(end + SIFS_S + 1e-6, Order.AIR, lambda now: medium._begin(3, now))
    air.timeline.at(end, Order.TURN, lambda now: medium.stations[3].waiting.append(_datagram(now)))
    heard = air.run()
    assert [(sender, hearer) for sender, hearer, *_ in heard if sender == 0] == [(0, 1), (0, 3)]
    assert medium.repeats == 1


def _datagram(now: float) -> Datagram:
    datagram = Datagram(now, BROADCAST)
    datagram.add(FRAME, now)
    return datagram


def test_only_with_overhearing_do_others_hear_a_frame_for_one() -> None:
    for overhear, hearers in ((True, {0, 2}), (False, {2})):
        air, medium = unicast(LINE, overhear=overhear)
        air.send(1, 1.0, target=2)
        air.send(1, 2.0)
        heard = air.run()
        assert {hearer for _, hearer, _, now in heard if now < 2.0} == hearers
        assert {hearer for _, hearer, _, now in heard if now > 2.0} == {0, 2}
        assert medium.heard == len(heard)


def test_frames_for_the_same_node_share_a_datagram() -> None:
    air, medium = unicast(LINE)
    for target in (0, 2, 0, BROADCAST, 2):
        air.send(1, 1.0, target=target)
    heard = air.run()
    assert list(Counter(now for *_, now in heard).values()) == [4, 4, 2]
    assert medium.sent == 5


def test_a_node_that_is_off_acknowledges_nothing() -> None:
    air, medium = unicast(LINE)
    air.timeline.at(0.5, Order.TURN, lambda now: medium.switch_off(1))
    air.send(0, 1.0, target=1)
    air.timeline.at(1.5, Order.TURN, lambda now: medium.switch_on(1))
    air.send(0, 2.0, target=1)
    air.run()
    assert (medium.repeats, medium.given_up) == (7, 1)


def test_a_strong_link_carries_a_frame_for_one_node_faster() -> None:
    took = {}
    for distance in (1.0, 5.0, 9.0):
        air, _ = unicast([(0.0, 0.0), (distance, 0.0)], path_loss=3.0)
        air.send(0, 1.0, target=1)
        took[distance] = air.run()[0][3] - 1.0
    assert took[1.0] == pytest.approx(20e-6 + 8 * 164 / 54e6)
    assert took[1.0] < took[5.0] < took[9.0]
    # All hear what is for all at the lowest rate, and so where the rate is set.
    for keys in ({}, {"bitrate": 6e6}):
        air, _ = unicast([(0.0, 0.0), (1.0, 0.0)], path_loss=3.0, **keys)
        air.send(0, 1.0, target=1 if keys else BROADCAST)
        assert air.run()[0][3] - 1.0 == pytest.approx(20e-6 + 8 * 164 / 6e6)


@pytest.mark.no_cover
@given(
    places=st.lists(st.tuples(st.floats(0, 40), st.floats(0, 40)), min_size=2, max_size=8),
    sends=st.lists(
        st.tuples(st.integers(0, 7), st.floats(0, 0.01), st.integers(20, 158), st.integers(0, 8)), max_size=40
    ),
    preset=st.sampled_from(sorted(PRESETS)),
    sense=st.sampled_from([1.0, 1.5, 2.0]),
    mac=st.sampled_from(["broadcast", "unicast"]),
    capture=st.sampled_from(["first", "none"]),
    overhear=st.booleans(),
    loss=st.sampled_from([0.0, 0.3]),
)
@settings(max_examples=examples(200), deadline=None)
def test_every_frame_is_heard_or_lost_once_by_each_node_in_reach(
    places: list[Position],
    sends: list[tuple[int, float, int, int]],
    preset: str,
    sense: float,
    mac: str,
    capture: str,
    overhear: bool,
    loss: float,
) -> None:
    keys: dict[str, Any] = {"mac": mac, "capture": capture, "overhear": overhear} if preset.startswith("wifi") else {}
    air = Air(places, preset=preset, sense=sense, queue_bytes=10**6, loss=loss, **keys)
    hearers = RangeGraph(places, 10.0).neighbours
    due = []
    for number, (sender, at, size, target) in enumerate(sends):
        sender %= len(places)
        target = BROADCAST if target == 8 else target % len(places)
        frame = number.to_bytes(2, "big") + bytes(size)
        air.send(sender, at, frame, target)
        alone = keys and mac == "unicast" and not overhear and target != BROADCAST
        due += [(sender, hearer, frame) for hearer in hearers[sender] if not alone or hearer == target]
    heard = air.run()
    medium = air.medium
    assert medium.sent == len(sends)
    assert medium.heard == len(heard)
    assert medium.heard + medium.collided + medium.dropped == len(due)
    assert max(Counter((sender, hearer, frame) for sender, hearer, frame, _ in heard).values(), default=1) == 1
    assert {(sender, hearer, frame) for sender, hearer, frame, _ in heard} <= set(due)
    for station in medium.stations:
        assert not any((station.waiting, station.heard, station.sends, station.serves, station.awaits))
    # A radio sends one frame at a time.
    for node in range(len(places)):
        ends = sorted({(now, frame) for sender, _, frame, now in heard if sender == node})
        for (before, _), (after, frame) in pairwise(ends):
            assert after == before or after - air.channel.airtime(len(frame)) >= before - 1e-9


def test_a_frame_is_struck_as_likely_as_a_stored_datum() -> None:
    exposure = Exposure(2, random.Random(1))
    for time in range(10):
        exposure.strike({1: 0.1}, float(time))

    def struck(node: int, since: float, until: float) -> float:
        return sum(exposure.touched(node, FRAME, since, until) != FRAME for _ in range(2000)) / 2000

    assert struck(0, -1.0, 20.0) == 0.0
    assert struck(1, 3.2, 3.8) == 0.0
    assert struck(1, 2.5, 3.5) == pytest.approx(0.1, abs=0.03)
    assert struck(1, -1.0, 20.0) == pytest.approx(1 - 0.9**10, abs=0.04)


SMALL = {"nodes": 16, "steps": 25, "data": {"interval_steps": 5}}


@pytest.mark.no_cover
@pytest.mark.parametrize("preset", sorted(PRESETS))
def test_a_swarm_delivers_on_every_preset(preset: str) -> None:
    step_s = {"wifi-6m": 0.2, "wifi-1m": 0.2}.get(preset, 20.0)
    keys = {**SMALL, "radio": {"preset": preset}, "node": {"step_s": step_s}, "radiation": {"corruption": False}}
    world = run(**keys)
    summary = world.statistics.summary()
    assert summary["delivered"] > 0.5 * summary["created"] > 0
    assert sum(summary["lost"].values()) == 0
    assert 0 < summary["air"]["busy"] < 1


@pytest.mark.parametrize("mac", ["unicast", "broadcast"])
def test_data_that_move_on_answer_only_in_frames_that_reach_all(mac: str) -> None:
    """As on the link `udp`: a monitor interface hears most of a unicast, and nobody repeats the rest for it."""
    world = run(**SMALL, radio={"preset": "wifi-1m", "mac": mac}, node={"step_s": 0.2})
    assert {agent.answers.broadcast for agent in world.agents} == {mac == "broadcast"}


@pytest.mark.no_cover
@pytest.mark.parametrize("overhear", [True, False])
@pytest.mark.parametrize("capture", ["first", "none"])
def test_a_swarm_delivers_with_acknowledgements(overhear: bool, capture: str) -> None:
    radio = {"preset": "wifi-1m", "mac": "unicast", "overhear": overhear, "capture": capture}
    keys = {**SMALL, "radio": radio, "node": {"step_s": 0.2}, "radiation": {"corruption": False}}
    summary = run(**keys).statistics.summary()
    assert summary["delivered"] > 0.5 * summary["created"] > 0
    assert sum(summary["lost"].values()) == 0
    assert summary["air"]["repeats"] > summary["air"]["given_up"]


@pytest.mark.no_cover
def test_turns_have_phases_of_their_own_without_an_air_that_takes_time() -> None:
    keys = {**SMALL, "node": {"phases": "random"}, "radiation": {"strikes_per_step": 4}}
    world = run(**keys)
    lockstep = world_of(**SMALL)
    lockstep.run(lockstep.scenario.steps)
    assert world.ledger.arrived
    assert lockstep.ledger.arrived
    assert world.air.tally.sha256 != lockstep.air.tally.sha256
    assert "air" not in world.statistics.summary()


@pytest.mark.no_cover
def test_strikes_through_the_step_hit_as_often_as_one_at_its_beginning() -> None:
    def struck(strikes: int) -> int:
        keys = {
            "nodes": 30, "steps": 40, "arena_m": 200, "topology": "grid", "custody": {"replicas": False},
            "radiation": {"strikes_per_step": strikes, "random_sources": 0, "sources": [[0, 0, 1]], "decay": 0.001},
        }  # fmt: skip
        world = run(**keys)
        return world.ledger.losses()["corrupted"]

    once, often = struck(1), struck(5)
    assert once > 30
    assert often == pytest.approx(once, rel=0.25)


@pytest.mark.parametrize(
    ("radio", "step_s"), [({"preset": "sik-250k"}, 5), ({"preset": "wifi-1m", "mac": "unicast"}, 0.2)]
)
def test_drones_that_fail_leave_the_air(radio: dict[str, Any], step_s: float) -> None:
    """Also those for whose acknowledgements others wait."""
    keys = {
        **SMALL, "steps": 40, "radio": radio, "node": {"step_s": step_s},
        "failures": {"reboot_rate": 0.02, "wipe_rate": 0.01, "die_fraction": 0.1, "reboot_steps": 3},
    }  # fmt: skip
    world = run(**keys)
    assert some(world.failures).counts["rebooted"] > 0
    assert world.ledger.arrived
    assert world.statistics.summary()["air"].get("repeats", 1) > 0


@pytest.mark.no_cover
def test_attackers_and_disks_work_on_an_air_that_takes_time() -> None:
    keys = {
        **SMALL, "radio": {"preset": "wifi-6m"}, "radiation": {"corruption": False},
        "disk": {"cut_rate": 0.01, "commit_steps": 1}, "failures": {"reboot_steps": 2},
        "hostile": [{"kind": "replayer", "near": 5}],
    }  # fmt: skip
    world = run(**keys)
    assert world.ledger.arrived


def test_a_preset_gives_what_is_not_set() -> None:
    radio = RadioSection(preset="wifi-1m", bitrate=2e6)
    assert radio.channel == PRESETS["wifi-1m"]._replace(bitrate=2e6)
    assert not RadioSection().takes_time
    assert not RadioSection(preset="lora", air="none").takes_time
