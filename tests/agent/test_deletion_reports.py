"""What a base with keys believes of deletion reports: what the ground's keys show about who has created them."""

from __future__ import annotations

import random

import pytest

from rass_mav.core.alarms import Alarm
from rass_mav.core.datum import REASONS, DatumId, Fate, make_datum
from rass_mav.core.messages import Committed, DeletionEntry, DeletionReport
from rass_mav.core.news.statements import note_crc
from rass_mav.core.node import Node
from rass_mav.core.risk import RiskEstimator
from rass_mav.core.settings import NodeSettings
from rass_mav.policy.settings import PolicySettings
from rass_mav.store.memory import MemoryStore
from rass_mav.trust.keys.identity import Ground
from rass_mav.trust.keys.keyring import Keyring
from rass_mav.trust.keys.secret import Secret
from rass_mav.trust.seals import Seals
from rass_mav.trust.trust import trust_of

BASE, HONEST, CAPTURED = 1, 7, 8
EPOCH = 5
GROUND = Ground(Secret(bytes(range(32))), serials={HONEST: 1, CAPTURED: 1})


def seals_of(node_id: int, store: MemoryStore) -> Seals:
    keyring = Keyring(GROUND.node(node_id), GROUND) if node_id == BASE else Keyring(GROUND.node(node_id, 1), None)
    seals = trust_of(keyring, random.Random(1)).seals(store)
    assert isinstance(seals, Seals)
    return seals


@pytest.fixture
def base() -> Node:
    store = MemoryStore(BASE)
    settings = NodeSettings(node_id=BASE, base=True)
    policy = PolicySettings(name="hop-count").make()
    risk = RiskEstimator(stale_s=1e9)
    return Node(settings, store, policy, risk, random.Random(1), now=0.0, newborn=True, seals=seals_of(BASE, store))


@pytest.fixture
def drones() -> dict[int, Seals]:
    return {node_id: seals_of(node_id, MemoryStore(EPOCH)) for node_id in (HONEST, CAPTURED)}


def number(sequence: int, origin: int = HONEST) -> DatumId:
    return DatumId(origin, EPOCH, sequence)


def hears(base: Node, id: DatumId, fate: Fate, proof: bytes) -> None:
    """A note comes, from whoever relays it. It is answered, so that it ends."""
    reason = REASONS[fate]
    said = base.receive(DeletionReport(9, BASE, (DeletionEntry(77, id, reason, note_crc(id, reason), proof),)), 0.0)
    assert [answer.committed[0][0] for answer in said if isinstance(answer, Committed)] == [77]


def arrives(base: Node, seals: Seals, id: DatumId) -> None:
    kind, payload = seals.seal(id, 0, b"data")
    assert base.custody_store.take_custody(9, 1, make_datum(id, kind, 0.0, payload))


def proof(seals: Seals, id: DatumId, fate: Fate = Fate.CORRUPTED) -> bytes:
    return seals.of_note(id, REASONS[fate])


def known(base: Node) -> dict[DatumId, Fate]:
    return dict(base.store.losses())


def test_a_note_without_a_proof_or_with_anothers_is_not_believed(base: Node, drones: dict[int, Seals]) -> None:
    arrives(base, drones[HONEST], number(5))
    in_its_name = HONEST.to_bytes(2, "little") + proof(drones[CAPTURED], number(0))[2:]
    of_another_number, of_another_reason = (
        proof(drones[HONEST], number(1)), proof(drones[HONEST], number(0), Fate.EXPIRED)
    )  # fmt: skip
    for junk in (b"", bytes(10), in_its_name, of_another_number, of_another_reason):
        hears(base, number(0), Fate.CORRUPTED, junk)
    assert known(base) == {}


def test_a_drone_is_believed_about_what_others_have_created_and_nothing_else(
    base: Node, drones: dict[int, Seals]
) -> None:
    for sequence in (0, 3, 5, 6):
        hears(base, number(sequence), Fate.CORRUPTED, proof(drones[CAPTURED], number(sequence)))
    assert known(base) == {}
    arrives(base, drones[HONEST], number(5))
    assert known(base) == {number(0): Fate.CORRUPTED, number(3): Fate.CORRUPTED}
    # It arrives all the same.
    arrives(base, drones[HONEST], number(6))
    arrives(base, seals_of(HONEST, MemoryStore(EPOCH)), number(3))
    assert known(base) == {number(0): Fate.CORRUPTED}


def test_a_drone_is_believed_about_itself_and_no_other_about_its_store(base: Node, drones: dict[int, Seals]) -> None:
    for fate in (Fate.DAMAGED, Fate.UNKNOWN):
        hears(base, number(4), fate, proof(drones[CAPTURED], number(4), fate))
    assert known(base) == {}
    assert not base.alarms.counts
    hears(base, number(4), Fate.DAMAGED, proof(drones[HONEST], number(4), Fate.DAMAGED))
    hears(base, number(9), Fate.CORRUPTED, proof(drones[HONEST], number(9)))
    assert known(base) == {number(4): Fate.DAMAGED, number(9): Fate.CORRUPTED}
    assert base.alarms.counts.keys() == {Alarm.DAMAGED}


def test_what_one_drone_says_of_others_is_bounded(base: Node, drones: dict[int, Seals]) -> None:
    for sequence in range(1000):
        hears(base, number(sequence), Fate.CORRUPTED, proof(drones[CAPTURED], number(sequence)))
    arrives(base, drones[HONEST], number(2000))
    assert 0 < len(known(base)) <= 64
