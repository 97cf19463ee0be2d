"""The published protocols: each delivers, and each keeps to its own rules."""

from __future__ import annotations

import random
from collections import Counter
from typing import Any, TypeVar

import pytest

from rass_mav.core.datum import DatumId
from rass_mav.core.messages import (
    BEACON_BASE,
    BROADCAST,
    Committed,
    CopyStatus,
    CopyStatusEntry,
    CopyStatuses,
    Data,
    Message,
    Receipt,
    Route,
)
from rass_mav.core.risk import RiskEstimator
from rass_mav.errors import StoreFullError
from rass_mav.lab.baselines import PROTOCOLS, prophet, spray
from rass_mav.lab.baselines.backpressure import HOP_WEIGHT, Backpressure
from rass_mav.lab.baselines.common import MAX_TRIES, Baseline
from rass_mav.lab.baselines.epidemic import Epidemic
from rass_mav.lab.baselines.prophet import BASES, Prophet
from rass_mav.lab.baselines.rapid import Rapid
from rass_mav.lab.baselines.spray import COPIES, SprayAndFocus, SprayAndWait
from rass_mav.lab.swarm import invariants
from rass_mav.lab.swarm.scenario import load_scenario
from rass_mav.lab.swarm.world import World
from rass_mav.policy.settings import PolicySettings
from rass_mav.store.memory import MemoryStore
from tests.core.build import beacon, data, datum, node_settings, of, statement
from tests.extent import seeds

STEPS = 60
ALL = sorted(PROTOCOLS)
OTHERS = [name for name in ALL if PROTOCOLS[name].participant is not None]


def world(protocol: str, *assignments: str, seed: int = 1, steps: int = STEPS, **keys: Any) -> World:
    """A grid of 16 around the sources; data are created until the last third."""
    options = {"nodes": 16, "arena_m": 8, "steps": steps, "seed": seed, "data.until_step": steps * 2 // 3}
    options |= PROTOCOLS[protocol].keys | keys
    return World(load_scenario("demo", options, assignments), participant=PROTOCOLS[protocol].participant)


LINE = ("topology=line", "nodes=4", "radiation.corruption=false")


# -- in a swarm --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("protocol", ALL)
def test_each_delivers_everything_on_a_line_without_loss(protocol: str) -> None:
    """It is short enough for the few copies of spray and wait."""
    line = world(protocol, *LINE)
    line.run(STEPS)
    assert line.ledger.created == len(line.ledger.arrived) == 3 * 4
    assert line.ledger.altered == 0


@pytest.mark.no_cover
@pytest.mark.parametrize("protocol", ALL)
@pytest.mark.parametrize("seed", seeds(1, 5))
def test_the_ledger_holds_among_loss_radiation_and_failures(protocol: str, seed: int) -> None:
    swarm = world(
        protocol, "radio.loss=0.2", "radio.duplicate=0.1", "radio.reorder=0.1", "failures.reboot_rate=0.01",
        "failures.wipe_rate=0.005", "failures.die_fraction=0.3", "topology=random-walk", "store.capacity_items=8",
        seed=seed,
    )  # fmt: skip
    swarm.run(STEPS, after=invariants.check)
    assert len(swarm.ledger.arrived) > 0.2 * swarm.ledger.created
    # After a reboot, too.
    expected = PROTOCOLS[protocol].participant
    assert expected is None or {type(agent.node) for agent in swarm.agents} == {expected}


@pytest.mark.no_cover
@pytest.mark.parametrize("protocol", OTHERS)
def test_the_same_seed_gives_the_same_bytes(protocol: str) -> None:
    def sha256(seed: int) -> str:
        swarm = world(protocol, "radio.loss=0.1", "topology=random-walk", seed=seed, steps=20)
        swarm.run(20)
        return swarm.air.tally.sha256

    assert sha256(1) == sha256(1) != sha256(2)


@pytest.mark.no_cover
@pytest.mark.parametrize("protocol", OTHERS)
def test_nobody_sends_more_than_the_bandwidth_in_a_step(protocol: str) -> None:
    swarm = world(protocol, "node.phases=lockstep", "store.bandwidth_items=3", "data.interval_steps=2")
    sent = [0] * len(swarm.agents)

    def look(swarm: World) -> None:
        for node_id, agent in enumerate(swarm.agents):
            assert agent.node.pace.sent - sent[node_id] <= 3
            sent[node_id] = agent.node.pace.sent

    swarm.run(STEPS, after=look)
    assert sum(sent) > 0


@pytest.mark.no_cover
@pytest.mark.parametrize("protocol", ["spray-and-wait", "spray-and-focus"])
def test_there_are_never_more_copies_or_tokens_of_a_datum_than_it_began_with(protocol: str) -> None:
    swarm = world(protocol, "topology=random-walk", "radio.range_m=2", "failures.reboot_rate=0.02")
    most: Counter[DatumId] = Counter()

    def look(swarm: World) -> None:
        tokens: Counter[DatumId] = Counter()
        for agent in swarm.agents:
            node = agent.node
            assert isinstance(node, SprayAndWait)
            if not node.base:
                assert node.tokens.keys() == set(node.holdings)
                tokens.update(node.tokens)
        assert max(tokens.values(), default=0) <= COPIES
        most.update({id: copies - most[id] for id, copies in swarm.ledger.copies.items() if copies > most[id]})

    swarm.run(STEPS, after=look)
    assert 4 < max(most.values()) <= COPIES


def test_an_epidemic_reaches_every_node_and_ends_with_the_receipts() -> None:
    cut_off = world("epidemic", *LINE, "failures.base_off=[[0, 30]]", "data.until_step=11")
    cut_off.run(29)
    assert {len(agent.node.holdings) for agent in cut_off.agents[1:]} == {cut_off.ledger.created}
    cut_off.run(31)
    assert len(cut_off.ledger.arrived) == cut_off.ledger.created
    assert cut_off.ledger.stored == 0


# -- one node ----------------------------------------------------------------------------------------------------------

B = TypeVar("B", bound=Baseline)


def node_of(kind: type[B], node_id: int = 5, **settings: Any) -> B:
    """A drone with an empty store."""
    return kind(
        node_settings(node_id, **settings), MemoryStore(77), PolicySettings(name="hop-count").make(),
        RiskEstimator(stale_s=1e9), random.Random(1), now=0.0, newborn=True,
    )  # fmt: skip


def hear(node: Baseline, now: float = 0.0, *, base: int | None = None, **potentials: int) -> None:
    """Beacons of neighbours with these potentials, `n7=3`: node 7 announces 3; and of a base."""
    for name, potential in potentials.items():
        node.receive(beacon(int(name[1:]), round(now), potential=potential), now)
    if base is not None:
        route = Route(base, 1, 0, 0)
        node.receive(beacon(base, round(now), route, flags=BEACON_BASE, potential=0), now)


def given(messages: list[Message]) -> list[tuple[int, int]]:
    """Target and sequence number of each datum that is sent."""
    return [(m.target, h.datum.id.sequence) for m in of(Data, messages) for h in m.handovers]


def answer(node: Baseline, messages: list[Message], now: float = 0.0) -> list[Message]:
    """All that is sent has been received. Returns what follows at once."""
    out = []
    for m in of(Data, messages):
        committed = tuple((h.number, h.datum.crc) for h in m.handovers)
        out += node.receive(Committed(m.target, node.id, committed, ()), now)
    return out + node.forward(now)


def test_what_is_not_answered_is_sent_again_with_growing_pauses_and_then_given_up() -> None:
    node = node_of(Prophet)
    hear(node, n7=60000)
    node.step(0.0)
    node.put(b"reading", 0.0)
    sent = [0.0] * len(given(node.forward(0.0)))
    for now in range(1, 12):
        hear(node, now, n7=60000)
        sent += [now] * len(given(node.step(now)))
    # One step, two and four later; after as long again it is like new, and the neighbour is still the best.
    assert sent[:MAX_TRIES] == [0, 1, 3, 7]
    assert node.holdings.get(DatumId(5, 77, 0)) is not None


def test_a_neighbour_on_a_clean_link_is_in_contact_as_long_as_its_beacons_come_and_others_somewhat_longer() -> None:
    def contacts(heard: list[int]) -> list[float]:
        node, found = node_of(Epidemic), []
        for now in range(24):
            if now in heard:
                hear(node, now, n7=0)
            node.step(now)
            node.put(b"reading", now)
            found.append(bool(given(node.forward(now))))
        return [now for now in range(heard[-1], 24) if found[now]]

    assert contacts(list(range(20))) == [19, 20]
    assert contacts([now for now in range(20) if now % 3]) == [19, 20, 21, 22]


def test_a_neighbour_that_has_a_datum_is_not_sent_it() -> None:
    node = node_of(Prophet)
    hear(node, n7=60000, n8=50000)
    node.step(0.0)
    id = node.put(b"reading", 0.0)
    node.receive(CopyStatuses(7, BROADCAST, (CopyStatusEntry(id, CopyStatus.HERE),)), 0.0)
    assert given(node.forward(0.0)) == [(8, 0)]


def test_a_new_neighbour_is_told_of_all_copies_and_others_of_new_ones() -> None:
    node = node_of(Epidemic)

    def told(now: float) -> set[int]:
        return {entry.id.sequence for m in of(CopyStatuses, node.step(now)) for entry in m.entries}

    node.put(b"one", 0.0)
    node.put(b"two", 0.0)
    hear(node, n7=0)
    assert told(0.0) == {0, 1}
    hear(node, 1.0, n7=0)
    node.receive(data(7, 5, (70000, datum(7, 3))), 1.0)
    assert told(1.0) == {3}
    hear(node, 2.0, n7=0)
    assert told(2.0) == set()


def test_a_receipt_ends_a_copy_and_it_is_not_taken_again() -> None:
    node = node_of(Epidemic)
    one = datum(9, 0)
    node.receive(data(7, BROADCAST, (0, one)), 0.0)
    assert list(node.holdings) == [one.id]
    node.receive(statement(one.id), 0.0)
    node.receive(data(7, BROADCAST, (0, one)), 0.0)
    assert not list(node.holdings)


def test_a_statement_is_relayed_at_once_but_only_one_in_a_turn() -> None:
    node = node_of(Epidemic, receipt_steps=1)
    hear(node, n7=0)
    assert not of(Receipt, node.step(0.0))
    first, second = (statement(datum(9, sequence).id, serial=sequence) for sequence in range(2))
    node.receive(first, 0.0)
    assert of(Receipt, node.forward(0.0)) == [first]
    node.receive(second, 0.0)
    assert not of(Receipt, node.forward(0.0))
    hear(node, 1.0, n7=0)
    assert of(Receipt, node.step(1.0)) == [second]


def test_two_nodes_that_hand_each_other_the_same_datum_do_not_both_let_go() -> None:
    node = node_of(SprayAndFocus)
    one = datum(9, 0)
    hear(node, n7=3)
    node.receive(data(8, 5, (1 << 16 | 1, one)), 0.0)
    sent = node.step(0.0)
    (message,) = of(Data, sent)
    assert message.target == 7
    (accepted,) = of(Committed, node.receive(data(7, 5, (2 << 16 | 1, one)), 0.0))
    assert accepted.committed == ((2 << 16 | 1, one.crc),)
    answer(node, sent)
    assert list(node.holdings) == [one.id]


def test_a_corrupt_copy_is_neither_kept_nor_sent() -> None:
    node = node_of(Prophet)
    spoilt = datum(9, 0)._replace(payload=b"Reading")
    assert node.receive(data(7, 5, (1 << 16, spoilt)), 0.0) == []
    hear(node, n7=60000)
    id = node.put(b"reading", 0.0)
    assert isinstance(node.store, MemoryStore)
    node.store.flip_bit(id, 0)
    assert not given(node.step(0.0))
    assert not list(node.holdings)


def test_a_base_keeps_each_datum_once_and_states_that_it_has_arrived() -> None:
    base = node_of(Epidemic, 0, base=True, capacity_items=None, receipt_steps=1)
    for _ in range(2):
        (committed,) = of(Committed, base.receive(data(7, 0, (1 << 16, datum(9, 4))), 0.0))
        assert len(committed.committed) == 1
    hear(base, n7=0)
    (receipt,) = of(Receipt, base.step(0.0))
    assert [(entry.origin, entry.first, entry.run) for entry in receipt.entries] == [(9, 4, 1)]


@pytest.mark.parametrize("kind", [Epidemic, SprayAndWait, Prophet])
def test_a_full_store_drops_the_oldest(kind: type[Baseline]) -> None:
    node = node_of(kind, capacity_items=3)
    for sequence in range(4):
        node.receive(data(7, 5, (sequence << 16 | 1, datum(9, sequence))), 0.0)
    assert [id.sequence for id in node.holdings] == [1, 2, 3]


# -- spray -------------------------------------------------------------------------------------------------------------


def test_half_of_the_tokens_go_and_the_last_one_waits() -> None:
    node = node_of(SprayAndWait)
    hear(node, n7=0, n8=0, n9=0, n10=0)
    node.step(0.0)
    id = node.put(b"reading", 0.0)
    sent, marks = node.forward(0.0), []
    while of(Data, sent):
        (message,) = of(Data, sent)
        marks.append(message.handovers[0].number & 0xFFFF)
        sent = answer(node, sent)
    assert marks == [4, 2, 1]
    assert node.tokens == {id: 1}
    hear(node, 1.0, n7=0, base=0)
    assert given(node.step(1.0)) == [(0, 0)]


def test_a_timer_counts_the_steps_since_a_base_was_met_by_anybody() -> None:
    node = node_of(SprayAndFocus)
    assert node.announce(0.0) == spray.NEVER
    hear(node, 3.0, n7=9)
    assert node.announce(3.0) == 10
    hear(node, 4.0, n8=20)
    assert node.announce(4.0) == 11
    hear(node, 5.0, base=0)
    assert (node.announce(5.0), node.announce(8.0)) == (0, 3)


def test_the_last_token_moves_to_a_neighbour_with_a_smaller_timer_only() -> None:
    node = node_of(SprayAndFocus)
    hear(node, n7=3)
    node.receive(data(8, 5, (1 << 16 | 1, datum(9, 0))), 0.0)
    hear(node, 1.0, n7=4)
    sent = node.step(1.0)
    assert node.potential == 5
    assert given(sent) == [(7, 0)]
    answer(node, sent, 1.0)
    assert not list(node.holdings)
    node.receive(data(8, 5, (2 << 16 | 1, datum(9, 1))), 1.0)
    hear(node, 2.0, n7=6)
    assert not given(node.step(2.0))
    assert node.potential == 6


# -- PRoPHET -----------------------------------------------------------------------------------------------------------


def test_the_equations_of_rfc_6693() -> None:
    # First encounter, or as good as forgotten: P_encounter_first.
    assert prophet.met(0.0, 1.0) == prophet.met(0.0999, 1.0) == 0.5
    # 0.5 + (1 - 0.01 - 0.5) * 0.7, and with half of the usual interval 0.5 + (1 - 0.01 - 0.5) * 0.35.
    assert prophet.met(0.5, 1.0) == prophet.met(0.5, 7.0) == pytest.approx(0.843)
    assert prophet.met(0.5, 0.5) == pytest.approx(0.6715)
    # Never above 1 - delta.
    value = 0.0
    for _ in range(100):
        value = prophet.met(value, 1.0)
    assert value == pytest.approx(0.99)
    # 0.8 * 0.999^1000.
    assert prophet.aged(0.8, 1000) == pytest.approx(0.294156, abs=1e-6)
    # 0.8 * 0.7 * 0.9 = 0.504, where that is more.
    assert prophet.passed_on(0.1, 0.8, 0.7) == pytest.approx(0.504)
    assert prophet.passed_on(0.6, 0.8, 0.7) == 0.6


def test_predictabilities_follow_the_beacons() -> None:
    node = node_of(Prophet)
    hear(node, n7=round(0.8 * prophet.SCALE))
    assert node.predictability == pytest.approx({7: 0.5, BASES: 0.5 * 0.8 * 0.9}, abs=1e-4)
    hear(node, 1.0, n7=round(0.8 * prophet.SCALE))
    assert node.predictability == pytest.approx({7: 0.843, BASES: 0.843 * 0.8 * 0.9}, abs=1e-4)
    announced = node.announce(1.0)
    assert announced / prophet.SCALE == pytest.approx(0.843 * 0.8 * 0.9 * 0.999**50, abs=1e-4)
    hear(node, 2.0, base=0)
    assert node.predictability[BASES] == pytest.approx(0.577 + 0.413 * 0.7, abs=1e-2)


def test_a_copy_goes_to_whoever_is_better_than_all_that_have_received_it() -> None:
    node = node_of(Prophet)
    hear(node, n7=60000, n8=50000, n9=100)
    node.step(0.0)
    node.put(b"reading", 0.0)
    sent = node.forward(0.0)
    assert given(sent) == [(7, 0)]
    assert not given(answer(node, sent))
    # The own copy stays, and goes on to a better one.
    hear(node, 1.0, n7=60000, n10=65000)
    assert given(node.step(1.0)) == [(10, 0)]


# -- RAPID -------------------------------------------------------------------------------------------------------------


def test_the_expected_time_grows_with_the_hops_and_with_the_time_between_meetings() -> None:
    node = node_of(Rapid)
    for step in range(3):
        hear(node, step, n7=2 * 16)
    assert node.announce(2.0) == 3 * 16
    # Node 8 comes by every 10 steps: the average interval approaches 10, from 1.
    for step in (2, 12, 22):
        hear(node, step, n8=0)
    expected = node.announce(22.0) / 16
    assert expected == pytest.approx(1 * 0.75**2 + 10 * (1 - 0.75**2), abs=0.05)


def test_the_datum_with_the_fewest_copies_leaves_first_to_whoever_expects_a_base_soonest() -> None:
    node = node_of(Rapid)
    hear(node, n7=64, n8=32)
    node.receive(data(9, 5, (1 << 16 | 3000, datum(9, 0))), 0.0)
    node.receive(data(9, 5, (2 << 16 | 10, datum(9, 1))), 0.0)
    assert given(node.step(0.0)) == [(8, 1), (8, 0)]


def test_a_full_store_drops_the_longest_expected_delay_but_no_own_datum() -> None:
    node = node_of(Rapid, capacity_items=3)
    hear(node, n7=64)
    node.put(b"own", 0.0)
    node.receive(data(9, 5, (1 << 16 | 3000, datum(9, 0))), 0.0)
    node.receive(data(9, 5, (2 << 16 | 10, datum(9, 1))), 0.0)
    node.step(0.0)
    node.receive(data(9, 5, (3 << 16 | 3000, datum(9, 2))), 0.0)
    assert sorted(node.holdings) == [(5, 77, 0), (9, 77, 0), (9, 77, 2)]
    for _ in range(2):
        node.put(b"own", 0.0)
    assert {id.origin for id in node.holdings} == {5}
    with pytest.raises(StoreFullError):
        node.put(b"own", 0.0)


# -- backpressure ------------------------------------------------------------------------------------------------------


def test_data_move_down_the_gradient_of_queues_and_stop_where_it_ends() -> None:
    node = node_of(Backpressure)
    for _ in range(6):
        node.put(b"reading", 0.0)
    hear(node, n7=1, n8=3, n9=8)
    # 6 against 1; each datum that leaves makes the own queue shorter and that one longer: 5:2, then 4:3 or 4:3.
    targets = [target for target, _ in given(node.step(0.0))]
    assert targets == [7, 7, 7]


def test_a_hop_counts_as_much_as_some_waiting_data() -> None:
    def target(queue: int) -> int:
        node = node_of(Backpressure)
        for number in range(2):
            node.receive(beacon(7, number, Route(0, 1, 0, 1), potential=queue), number)
            node.receive(beacon(8, number, Route(0, 1, 0, 2), potential=0), number)
        node.put(b"reading", 1.0)
        ((neighbour, _),) = given(node.step(1.0))
        return neighbour

    assert [target(HOP_WEIGHT - 1), target(HOP_WEIGHT + 1)] == [7, 8]


def test_a_full_queue_takes_no_more_and_there_is_one_copy() -> None:
    node = node_of(Backpressure, capacity_items=1)
    one, two = datum(9, 0), datum(9, 1)
    (taken,) = of(Committed, node.receive(data(7, 5, (1 << 16, one), (2 << 16, two)), 0.0))
    assert (taken.committed, taken.refused) == (((1 << 16, one.crc),), (2 << 16,))
    hear(node, n8=0)
    sent = node.step(0.0)
    assert given(sent) == [(8, 0)]
    answer(node, sent)
    assert not list(node.holdings)
