"""The ledger that is read from stores on disk."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from pathlib import Path

import pytest

from rass_mav.core.datum import Datum, DatumId, Fate, make_datum
from rass_mav.lab.fleet.ledger import StoreLedger
from rass_mav.lab.ledger import InvariantError
from rass_mav.store.sqlite import SqliteStore


class Fleet:
    """A base (node 0) and two drones, as their stores."""

    def __init__(self, directory: Path) -> None:
        self.paths = [directory / f"{n}.db" for n in range(3)]
        self.stores = [self._opened(path, 100 + n) for n, path in enumerate(self.paths)]
        self.ledger = StoreLedger(self.paths, 1, step_s=0.5)

    @staticmethod
    def _opened(path: Path, epoch: int) -> SqliteStore:
        return SqliteStore.open(path, node_id=7, draw_epoch=lambda: epoch)

    def create(self, node: int, created: float = 0.0) -> Datum:
        store = self.stores[node]
        datum = make_datum(DatumId(node, store.epoch, store.next_sequence()), 0, created, b"abc")
        store.put(datum)
        return datum

    def commit(self) -> None:
        for store in self.stores:
            batch = store.take(force=True)
            if batch is not None:
                store.write(batch)

    def close(self) -> None:
        for store in self.stores:
            store.close()


@pytest.fixture
def fleet(tmp_path: Path) -> Iterator[Fleet]:
    fleet = Fleet(tmp_path)
    yield fleet
    fleet.close()


def test_each_datum_counts_once_however_many_copies(fleet: Fleet) -> None:
    arrived, held, both = fleet.create(1), fleet.create(1), fleet.create(2)
    fleet.stores[0].put(arrived.arrived())
    fleet.stores[2].put(held.arrived())
    fleet.stores[0].put(both.arrived())
    fleet.close()
    ledger = fleet.ledger
    ledger.close(10.0)
    assert (ledger.created, ledger.delivered, ledger.held) == (3, 2, 1)
    assert not any(ledger.figures()["lost"].values())
    assert ledger.altered == 0


def test_what_is_nowhere_has_vanished_and_what_is_noted_is_lost_for_its_reason(fleet: Fleet) -> None:
    gone, spoilt = fleet.create(1), fleet.create(1)
    fleet.commit()
    fleet.stores[1].remove(gone.id, Fate.PASSED_ON)
    fleet.stores[1].remove(spoilt.id, Fate.CORRUPTED)
    fleet.stores[2].count("overflow", 4)
    fleet.close()
    ledger = fleet.ledger
    ledger.close(10.0)
    losses = ledger.figures()["lost"]
    assert losses.pop("vanished") == 1
    assert losses.pop("corrupted") == 1
    assert losses.pop("overflow") == 4
    assert not any(losses.values())
    assert ledger.created == ledger.delivered + ledger.held + 6


def test_delays_are_whole_steps_up_to_the_first_look(fleet: Fleet) -> None:
    datum = fleet.create(1, created=3.0)
    fleet.stores[0].put(datum.arrived().arrived())
    fleet.commit()
    fleet.ledger.look_at_bases(4.7)
    fleet.ledger.look_at_bases(9.0)
    assert fleet.ledger.delays == {datum.id: 3}
    assert fleet.ledger.hops == {datum.id: 2}


def test_complete_when_all_that_was_created_has_arrived(fleet: Fleet) -> None:
    datum = fleet.create(2)
    fleet.commit()
    fleet.ledger.look_at_all(1.0)
    assert not fleet.ledger.complete
    fleet.stores[0].put(datum.arrived())
    fleet.commit()
    fleet.ledger.look_at_all(2.0)
    assert fleet.ledger.complete


def test_copies_of_what_has_arrived_fill_memory_but_do_not_wait(fleet: Fleet) -> None:
    arrived, waiting = fleet.create(1), fleet.create(1)
    fleet.stores[0].put(arrived.arrived())
    fleet.commit()
    ledger = fleet.ledger
    ledger.look_at_bases(1.0)
    fleet.stores[2].put(waiting.arrived())
    fleet.commit()
    ledger.sample()
    assert (ledger.samples, ledger.stored, ledger.waiting, ledger.waiting_copies) == (1, 3, 1, 2)


def test_altered_bytes_at_the_base_are_found(fleet: Fleet) -> None:
    datum = fleet.create(1)
    fleet.stores[0].put(datum.arrived())
    fleet.close()
    with sqlite3.connect(fleet.paths[0]) as base:
        base.execute("UPDATE datum SET payload = x'616264'")
    base.close()
    fleet.ledger.close(10.0)
    assert fleet.ledger.altered == 1


def test_data_that_nobody_created_are_our_bug(fleet: Fleet) -> None:
    fleet.stores[0].put(make_datum(DatumId(1, fleet.stores[1].epoch, 7), 0, 0.0, b"ghost"))
    fleet.close()
    with pytest.raises(InvariantError, match="no node created"):
        fleet.ledger.close(10.0)
