"""What the product's own store holds: days of measurements, and never more than the disk and the memory have."""

from __future__ import annotations

import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from rass_mav.app.config import RunConfig
from rass_mav.config.loading import convert
from rass_mav.core.datum import Datum, DatumId, Fate, Kind, make_datum
from rass_mav.core.messages import Committed, Data, Handover
from rass_mav.core.node import Node
from rass_mav.errors import StoreFullError
from rass_mav.station.node import build_node
from rass_mav.store.disk import BlockFile, Space
from rass_mav.store.memory import MemoryStore
from rass_mav.store.quota import cost
from rass_mav.store.sqlite import SqliteStore
from tests.core.build import beacon, of

DAY_S = 86_400
READING = b"a reading of 23 bytes.."
MIB = 1 << 20


class SmallDisk:
    """A disk with so much free space, beside what the store takes."""

    vfs = None

    def __init__(self, path: Path, free: int) -> None:
        self.path = path
        self.free = free

    def open_file(self, path: Path, *, writable: bool) -> BlockFile:
        return BlockFile(path, writable=writable)

    def space(self, folder: Path) -> Space:
        taken = sum(file.stat().st_size for file in self.path.parent.iterdir())
        return Space(max(0, self.free - taken), 64 * MIB)


def node_on(on: Any, **sections: Any) -> Node:
    """A drone with the product's own settings."""
    raw = {"node": {"id": 7}, "links": [{"type": "udp", "listen": "127.0.0.1:0"}], **sections}
    settings = convert(raw, RunConfig, "test").agent_settings()
    node = build_node(settings, on, random.Random(7), now=0.0, newborn=True).node
    assert isinstance(node, Node)
    return node


def commit(store: SqliteStore) -> None:
    if (batch := store.take(force=True)) is not None:
        store.write(batch)


def opened(path: Path, free: int, **options: Any) -> SqliteStore:
    return SqliteStore.open(path, node_id=7, draw_epoch=lambda: 1, disk=SmallDisk(path, free), **options)


def filled(put: Callable[[], Any], store: SqliteStore | None = None) -> int:
    """How often something could be put until the store was full."""
    for count in range(1_000_000):
        try:
            put()
        except StoreFullError:
            return count
        if store is not None and count % 500 == 499:
            commit(store)
    raise AssertionError("it is never full")


@pytest.mark.no_cover
def test_a_drone_alone_measures_for_days() -> None:
    node = node_on(MemoryStore(1))
    for number in range(5 * DAY_S // 10):
        node.put(READING, 10.0 * number, Kind.MEASUREMENT)
    assert len(node.holdings.custody) == 43_200


@pytest.mark.no_cover
def test_what_the_memory_cannot_hold_is_refused() -> None:
    node = node_on(MemoryStore(1))
    assert 50_000 < filled(lambda: node.put(READING, 1.0, Kind.MEASUREMENT)) < 65_535


def test_a_bound_that_the_file_names_holds_as_before() -> None:
    node = node_on(MemoryStore(1), store={"capacity_items": 50})
    assert filled(lambda: node.put(READING, 1.0, Kind.MEASUREMENT)) == 50


@pytest.mark.no_cover
def test_a_reserve_of_the_disk_stays_free(tmp_path: Path) -> None:
    """The disk fills up; the node refuses before it is full, and goes on when there is space again."""
    path = tmp_path / "n.db"
    with opened(path, 65 * MIB) as store:
        node = node_on(store)
        many = filled(lambda: node.put(READING, 1.0, Kind.MEASUREMENT), store)
        assert 7_000 < many <= MIB // cost(len(READING))
        assert SmallDisk(path, 65 * MIB).space(tmp_path).free > 59 * MIB
        node.receive(beacon(9), 1.0)
        (refused,) = of(Committed, node.receive(Data(9, 7, (Handover(5, theirs(0)),)), 1.0))
        assert (refused.committed, refused.refused) == ((), (5,))
        assert node.step(2.0)[0].free == 0  # type: ignore[union-attr]
        # What has been handed over leaves space inside the files.
        for id in list(node.holdings.custody)[:1000]:
            node.custody_store.drop(node.holdings.custody[id], Fate.PASSED_ON)
        commit(store)
        assert filled(lambda: node.put(READING, 1.0, Kind.MEASUREMENT), store) >= 900


def theirs(sequence: int, size: int = 90, origin: int = 3) -> Datum:
    return make_datum(DatumId(origin, 3, sequence), 0, 0.0, bytes(size))


@pytest.mark.no_cover
def test_at_the_bound_of_the_disk_copies_make_way_for_own_measurements_and_custody_never_does(tmp_path: Path) -> None:
    path = tmp_path / "n.db"
    with opened(path, 64 * MIB + 400_000) as store:
        node = node_on(store)
        node.receive(beacon(9), 1.0)
        for number in range(500):
            node.receive(Data(9, 7, (Handover(number + 1, theirs(number)),)), 1.0)
        for number in range(500):
            node.receive(Data(9, 7, (Handover(10_000 + number, theirs(1000 + number)),), True), 1.0)
        for number in range(500):
            node.receive(Data(9, 8, (Handover(20_000 + number, theirs(2000 + number, origin=number)),)), 1.0)
        commit(store)
        custody = set(node.holdings.custody)
        replicas = len(node.holdings) - len(custody)
        assert (len(custody), replicas) == (500, 500)
        assert len(node.overheard) > 100
        overheard_gone = None
        while True:
            try:
                node.put(READING, 2.0, Kind.MEASUREMENT)
            except StoreFullError:
                break
            if len(node.holdings.custody) % 50 == 0:
                commit(store)
            here = len(node.holdings) - len(node.holdings.custody)
            if here < replicas and overheard_gone is None:
                overheard_gone = not node.overheard
        assert overheard_gone, "replicas went before overheard copies"
        left = len(node.holdings) - len(node.holdings.custody)
        assert left <= 1, "replicas are left, and a measurement was refused"
        assert custody <= node.holdings.custody.keys(), "custody made way"


@pytest.mark.no_cover
def test_nobody_fills_the_disk_alone(tmp_path: Path) -> None:
    """Others leave a part of the disk for the node's own measurements, and the last of their part to each other."""
    path = tmp_path / "n.db"
    with opened(path, 64 * MIB + 1_000_000) as store:
        node = node_on(store)
        taken = 0
        for number in range(4000):
            (answer,) = of(Committed, node.receive(Data(9, 7, (Handover(number + 1, theirs(number, 97)),)), 1.0))
            taken += len(answer.committed)
            if number % 100 == 99:
                commit(store)
        assert 1000 < taken < 4000
        (answer,) = of(Committed, node.receive(Data(8, 7, (Handover(9, theirs(1, 97, origin=4)),)), 1.0))
        assert answer.committed, "another custodian gets nothing"
        assert filled(lambda: node.put(READING, 2.0, Kind.MEASUREMENT), store) > 1000


def test_a_quota_below_what_the_disk_has_holds_as_before(tmp_path: Path) -> None:
    path = tmp_path / "n.db"
    with opened(path, 1000 * MIB, quota_bytes=10 * cost(len(READING))) as store:
        node = node_on(store)
        assert filled(lambda: node.put(READING, 1.0, Kind.MEASUREMENT), store) == 10
