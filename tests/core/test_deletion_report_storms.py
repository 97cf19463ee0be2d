"""Deletion reports through loss, doubling, delay, restarts and corruption: they arrive, and cost no datum."""

from __future__ import annotations

import random
from collections.abc import Iterator

import pytest

from rass_mav.core.custody.effects import Search
from rass_mav.core.datum import DatumId, Fate
from rass_mav.core.messages import BROADCAST, Message
from rass_mav.core.news.deletion_reports import DeletionReports, fate_of
from rass_mav.core.node import Node
from rass_mav.core.observer import Observer
from rass_mav.core.replicas.replicas import Replicas
from rass_mav.errors import StoreFullError
from rass_mav.wire import decode, encode, target_of
from tests.extent import extents
from tests.some import some

from .books import records
from .build import make_node, tries
from .durable import DurableStore

#: Storms: other tests reach what these reach, and coverage would only make them slower.
pytestmark = pytest.mark.no_cover


@pytest.fixture(autouse=True, scope="module")
def soon_given_up() -> Iterator[None]:
    with tries(3):
        yield


class GivenUp(Observer):
    """Notes which copies are let go of because the datum has arrived."""

    def __init__(self, given_up: list[DatumId]) -> None:
        self.given_up = given_up

    def dropped(self, id: DatumId, fate: Fate) -> None:
        if fate is Fate.DELIVERED:
            self.given_up.append(id)


class Storm:
    """A base and three drones in a line over real bytes; the driver commits, then sends; a kill takes the rest."""

    NODES = 4

    def __init__(self, seed: int, *, mirror: bool) -> None:
        self.rng = random.Random(seed)
        self.mirror = mirror
        self.now = 0.0
        self.lives = 0
        self.stores = {i: DurableStore(1000 + i) for i in range(self.NODES)}
        self.nodes: dict[int, Node] = {}
        self.outbox: dict[int, list[bytes]] = {i: [] for i in range(self.NODES)}
        self.air: list[tuple[int, bytes]] = []
        self.created: set[DatumId] = set()
        self.newborn: dict[int, set[DatumId]] = {i: set() for i in range(self.NODES)}
        self.given_up: list[DatumId] = []
        self.told: set[DatumId] = set()
        """All that the base was ever told lost."""
        for i in range(self.NODES):
            self.start(i)

    def start(self, i: int) -> None:
        self.lives += 1
        self.nodes[i] = make_node(
            i, store=self.stores[i], risk=0.1 * i, now=self.now, seed=self.lives, base=i == 0, capacity_items=6,
            receipt_steps=2, mirror=self.mirror, neighbour_steps=2, observer=GivenUp(self.given_up),
        )  # fmt: skip

    def kill(self, i: int) -> None:
        self.stores[i] = self.stores[i].crashed()
        self.outbox[i] = []
        self.newborn[i] = set()
        self.start(i)

    def say(self, i: int, messages: list[Message]) -> None:
        for message in messages:
            self.outbox[i] += encode(message, self.now)

    def commit(self, i: int) -> None:
        self.stores[i].commit()
        self.created |= self.newborn[i]
        self.newborn[i] = set()
        for payload in self.outbox[i]:
            self.air += [(j, payload) for j in (i - 1, i + 1) if 0 <= j < self.NODES]
        self.outbox[i] = []
        del self.air[:-300]

    def hear(self, i: int, payload: bytes) -> None:
        message = decode(payload, self.now) if target_of(payload) in (i, BROADCAST) else None
        if message is not None:
            self.say(i, self.nodes[i].receive(message, self.now))

    def put(self, i: int) -> None:
        if len(self.created) < 10:
            try:
                self.newborn[i].add(self.nodes[i].put(self.rng.randbytes(8), self.now))
            except StoreFullError:
                return

    def strike(self, i: int) -> None:
        """A stored bit of one datum flips: at once, on the disk and in what is not written yet."""
        ids = [id for id in self.stores[i].ids() if i]
        if ids:
            id = self.rng.choice(ids)
            self.commit(i)
            self.stores[i].flip_bit(id)

    def check(self) -> None:
        at_base = self.stores[0].disk.data
        while self.given_up:
            # Copies are let go of as delivered only when the base has the datum on its disk.
            assert at_base[self.given_up.pop()].intact
        self.told |= self.stores[0].disk.losses.keys()
        for i, node in self.nodes.items():
            notes = node.custody_store.notes
            if isinstance(notes, DeletionReports):
                waiting = {id: fate_of(note.reason) for id, note in notes.waiting.items()}
                assert dict(self.stores[i].losses()) == {**waiting, **notes.suspected}
                if isinstance(node.replicas, Replicas):
                    assert notes.suspected.keys() <= {search.id for search in node.exchange.of(Search)}
            if i:
                assert all(id in at_base for id in self.created if id in node.custody_store.arrived)

    def turn(self, loss: float) -> None:
        """A step of everybody; what is said arrives or is lost, and is answered."""
        self.now += 1.0
        for i, node in self.nodes.items():
            self.say(i, node.step(self.now))
        for _ in range(12):
            for i in self.nodes:
                self.commit(i)
            frames, self.air = self.air, []
            for to, payload in frames:
                if self.rng.random() >= loss:
                    self.hear(to, payload)
            if not any(self.outbox.values()):
                break
        self.check()

    def rage(self, events: int) -> None:
        rng = self.rng
        for _ in range(events):
            i = rng.randrange(self.NODES)
            event = rng.random()
            if event < 0.25:
                self.now += 0.3
                self.say(i, self.nodes[i].step(self.now))
            elif event < 0.5:
                self.commit(i)
            elif event < 0.52:
                self.kill(i)
            elif event < 0.55:
                self.put(rng.randrange(1, self.NODES))
            elif event < 0.57:
                self.strike(i)
            elif self.air:
                to, payload = self.air[k := rng.randrange(len(self.air))]
                fortune = rng.random()
                if fortune < 0.8:
                    del self.air[k]
                if fortune > 0.2:
                    self.hear(to, payload)
            self.check()

    def settle(self) -> None:
        """Once the network is good, the base comes to know what has become of each datum."""
        self.air.clear()
        for _ in range(250):
            self.turn(0.0)
            if self.settled():
                return
        raise AssertionError("the base does not know what has become of all data")

    def settled(self) -> bool:
        index = some(self.nodes[0].archive)
        losses = dict(self.stores[0].losses())
        # What is removed, but not yet from the disk, does not count.
        intact = {h.id for node in self.nodes.values() for h in records(node.holdings) if node.custody_store.load(h)}
        return all(id in index or (index.is_lost(id) and id in losses and id not in intact) for id in self.created)


@pytest.mark.parametrize("mirror", [False, True])
@pytest.mark.parametrize("storms", extents(40, 2_000))
def test_notes_reach_the_base_and_never_cost_a_datum(storms: int, mirror: bool) -> None:
    told = rescued = 0
    for seed in range(130, 130 + storms):
        storm = Storm(seed, mirror=mirror)
        storm.turn(0.0)
        storm.turn(0.0)
        for _ in range(4):
            storm.rage(80)
            storm.turn(0.3)
        storm.settle()
        index = some(storm.nodes[0].archive)
        told += index.reported_lost
        rescued += len(storm.told - {id for id in storm.created if index.is_lost(id)})
    assert rescued > 0
    assert told > 0
