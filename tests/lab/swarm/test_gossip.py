"""Receipts and deletion reports in whole swarms, with the invariants checked in full after every step."""

from __future__ import annotations

import pytest

from rass_mav.core.alarms import Alarm
from rass_mav.core.datum import DatumId, Fate
from rass_mav.core.gossip import IMAX
from rass_mav.core.messages import ReceiptEntry
from rass_mav.core.news.receipts import Receipts
from rass_mav.core.news.statements import make_receipt
from rass_mav.lab.ledger import InvariantError
from rass_mav.lab.swarm.invariants import check
from rass_mav.lab.swarm.world import World
from tests.nodes import node_of
from tests.some import some

from .worlds import world_of

#: Storms: other tests reach what these reach, and coverage would only make them slower.
pytestmark = pytest.mark.no_cover


def receipts_of(world: World) -> list[Receipts]:
    found = [agent.node.receipts for agent in world.agents]
    assert all(isinstance(receipts, Receipts) for receipts in found)
    return [receipts for receipts in found if isinstance(receipts, Receipts)]


@pytest.mark.parametrize(
    ("topology", "mirror"),
    [
        ("grid", False),
        ("random-walk", True),
        pytest.param("grid", True, marks=pytest.mark.soak),
        pytest.param("random-walk", False, marks=pytest.mark.soak),
    ],
)
@pytest.mark.parametrize(("nodes", "steps"), [(16, 350), pytest.param(49, 900, marks=pytest.mark.soak)])
def test_all_know_what_has_arrived_and_the_base_what_is_lost(
    nodes: int, steps: int, topology: str, mirror: bool
) -> None:
    world = world_of(
        nodes=nodes,
        steps=steps,
        seed=4,
        topology=topology,
        radio={"loss": 0.2, "duplicate": 0.1, "reorder": 0.1},
        radiation={"random_sources": 2},
        custody={"replicas": mirror, "receipt_steps": 2},
        data={"until_step": steps // 4},
        policy={"name": "hop-count"},
    )
    world.run(steps, after=check)
    ledger = world.ledger
    lost = {id for id in ledger.lost if id not in ledger.arrived}
    assert ledger.held == 0
    assert lost or mirror
    base = node_of(world.agents[0])
    assert {id for id in ledger.born if some(base.archive).is_lost(id)} == lost == dict(base.store.losses()).keys()
    first, *others = receipts_of(world)
    assert all(receipts.arrivals() == first.arrivals() for receipts in others)
    assert {receipts.statements_hash for receipts in receipts_of(world)} == {first.statements_hash}
    # Nobody holds anything any more, and nobody has anything to tell.
    assert not ledger.copies
    sent = world.air.tally.sent
    world.run(50)
    assert world.air.tally.sent - sent == 50 * nodes


def test_where_there_are_keys_the_base_knows_the_losses_that_origins_have_outlived() -> None:
    """All but the last numbers: nothing shows the base that these were created."""
    world = world_of(
        nodes=16,
        steps=200,
        seed=5,
        topology="random-walk",
        radio={"loss": 0.2, "duplicate": 0.1, "reorder": 0.1},
        radiation={"random_sources": 2},
        custody={"replicas": False, "receipt_steps": 2},
        data={"until_step": 87},
        policy={"name": "hop-count"},
        keys=True,
    )
    world.run(200, after=check)
    base = node_of(world.agents[0])
    lost = {id for id in world.ledger.lost if id not in world.ledger.arrived}
    told = dict(base.store.losses()).keys()
    assert told <= lost
    assert len(told) > 10
    assert all(id.sequence >= some(base.archive).end(id[:2]) for id in lost - told)


def test_who_comes_back_from_an_island_learns_what_has_arrived() -> None:
    world = world_of(
        nodes=25,
        steps=330,
        topology="islands",
        mobility={"split_step": 60, "rejoin_step": 200, "gap_m": 20.0},
        radiation={"sources": []},
        custody={"replicas": True, "receipt_steps": 4},
        data={"interval_steps": 20, "until_step": 150},
        store={"capacity_items": 200},
    )
    world.run(200, after=check)
    base, *drones = receipts_of(world)
    behind = [receipts for receipts in drones if receipts.statements_hash != base.statements_hash]
    assert len(behind) >= 10
    world.run(130, after=check)
    assert {receipts.statements_hash for receipts in receipts_of(world)} == {base.statements_hash}
    assert not world.ledger.copies
    assert len(world.ledger.arrived) == world.ledger.created


def test_with_two_bases_what_reached_one_of_them_has_arrived() -> None:
    world = world_of(
        nodes=12, bases=2, steps=200, topology="line", radiation={"sources": []}, data={"until_step": 60},
        custody={"replicas": True, "receipt_steps": 2},
    )  # fmt: skip
    world.run(200, after=check)
    assert not world.ledger.copies
    assert len({receipts.statements_hash for receipts in receipts_of(world)}) == 1
    assert len(world.ledger.arrived) == world.ledger.created


def test_receipts_stay_within_their_share_of_the_air() -> None:
    frames = {}
    for receipts in (False, True):
        world = world_of(
            nodes=25,
            steps=100,
            seed=2,
            custody={"replicas": False},
            without=[] if receipts else ["receipts"],
            radiation={"corruption": False},
        )
        world.run(100)
        frames[receipts] = world.air.tally.sent
        period = world.agents[0].settings.custody.receipt_steps
    assert 0 < frames[True] - frames[False] <= 25 * (100 // period + 1)


def test_differing_summaries_do_not_keep_a_quiet_swarm_talking() -> None:
    world = world_of(
        nodes=9, steps=100, radiation={"sources": []}, data={"until_step": 30}, custody={"receipt_steps": 1}
    )
    world.run(100)
    # One of them is full of what others said long ago, and had to forget.
    receipts_of(world)[4].statements.forgetful = True
    world.run(4 * IMAX)
    sent = world.air.tally.sent
    world.run(20)
    assert world.air.tally.sent - sent == 20 * 9


def test_a_swarm_that_believes_in_an_arrival_that_never_was_is_found_out() -> None:
    world = world_of(nodes=4, steps=10, radiation={"sources": []})
    world.run(10, after=check)
    forged = make_receipt(0, 1, 0, [ReceiptEntry(1, 1, 0, 5, 0, False)])
    for receipts in receipts_of(world):
        receipts.learn(forged)
    with pytest.raises(InvariantError, match="has arrived"):
        check(world)


@pytest.mark.parametrize(
    ("mirror", "real_name"),
    [
        (False, True),
        (True, False),
        pytest.param(False, False, marks=pytest.mark.soak),
        pytest.param(True, True, marks=pytest.mark.soak),
    ],
)
def test_forged_receipts_delete_nothing(mirror: bool, real_name: bool) -> None:
    """Three frames say that everything has arrived at a base, far from it; the last one of numbers never given."""
    world = world_of(
        nodes=25, steps=200, seed=4, topology="grid", radiation={"sources": []}, data={"until_step": 100},
        custody={"replicas": mirror, "receipt_steps": 2}, policy={"name": "hop-count"}, radio={"loss": 0.1},
    )  # fmt: skip
    world.run(50)
    base = world.agents[0].node
    life = base.store.life if real_name else base.store.life ^ 1
    stores = [agent.node.store for agent in world.agents]
    all_given = [
        [ReceiptEntry(id, stores[id].epoch, 0, stores[id].assigned, 0, False) for id in some]
        for some in (range(1, 10), range(10, 19))
    ]
    never_given = [ReceiptEntry(id, stores[id].epoch, (1 << 32) - 2, 2, 0, False) for id in (20, 21)]
    for serial, entries in enumerate([*all_given, never_given]):
        forged = make_receipt(0, life, 50_000 + serial, entries)
        for agent in world.agents[12:]:
            agent.node.receive(forged, float(world.t))
    before = world.ledger.created
    world.run(150)
    assert world.ledger.created > before
    assert world.ledger.losses() == dict.fromkeys(world.ledger.losses(), 0)
    assert world.ledger.held == 0
    assert len(world.ledger.arrived) == world.ledger.created
    # Whoever hears numbers that it never gave says so, and everybody believes it.
    for agent in world.agents:
        assert DatumId(20, stores[20].epoch, (1 << 32) - 1) not in agent.node.receipts


def test_what_a_base_has_is_known_again_after_forged_receipts_swallowed_its_own() -> None:
    """They say all that the base has said, and more. When origins deny the rest, what is true must not go with it."""
    world = world_of(
        nodes=25, steps=250, seed=4, topology="grid", radiation={"sources": []}, data={"until_step": 60},
        custody={"replicas": True, "receipt_steps": 2}, policy={"name": "hop-count"},
    )  # fmt: skip
    world.run(50)
    base = world.agents[0].node
    for serial in range(6):
        entries = [
            ReceiptEntry(node.id, node.store.epoch, 0, node.store.assigned + 50, 0, False)
            for node in (agent.node for agent in world.agents[1 + 4 * serial : 5 + 4 * serial])
        ]
        forged = make_receipt(0, base.store.life, 50_000 + serial, entries)
        for agent in world.agents:
            agent.node.receive(forged, float(world.t))
    world.run(200)
    assert base.alarms.counts[Alarm.FORGED] > 0
    assert len(world.ledger.arrived) == world.ledger.created
    for agent in world.agents[1:]:
        holdings = node_of(agent).holdings
        assert not holdings.replica
        assert not holdings.passed_on
        assert agent.node.figures()["sent_again_unconfirmed"] == 0


def test_what_is_deleted_on_a_false_word_is_told_apart() -> None:
    world = world_of(nodes=4, steps=10, radiation={"sources": []}, topology="line", data={"until_step": 3})
    world.run(4)
    far = world.agents[3].node
    id = next(iter(far.holdings.custody), None) or far.put(b"x", float(world.t))
    world.ledger.lost.clear()
    for agent in world.agents[1:]:
        node = node_of(agent)
        holding = node.holdings.get(id)
        if holding is not None:
            node.custody_store.drop(holding, Fate.DELIVERED)
    assert world.ledger.losses()["unfounded"] == 1
    assert world.statistics.summary()["reliability"] < 1.0
