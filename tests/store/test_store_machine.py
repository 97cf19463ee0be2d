"""Any sequence of changes, commits, failed commits, crashes and restarts: three stores must agree.

The memory store, the store on disk and a model of plain dicts see the same calls. A second model holds what has been
committed: this, no more and no less, must be what a reader from outside finds, and what is left after a crash.
"""

from __future__ import annotations

import copy
import shutil
import sqlite3
import tempfile
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from rass_mav.core.datum import Datum, DatumId, Fate
from rass_mav.errors import StoreError
from rass_mav.store.memory import MemoryStore
from rass_mav.store.quota import cost
from rass_mav.store.reader import SqliteReader
from tests.extent import examples

from .store_helpers import EPOCH, open_store

#: Storms: other tests reach what these reach, and coverage would only make them slower.
pytestmark = pytest.mark.no_cover

IDS = st.builds(DatumId, st.sampled_from([1, 0xFFFE]), st.just(EPOCH), st.integers(0, 3))
ALL_IDS = [DatumId(origin, EPOCH, sequence) for origin in (1, 0xFFFE) for sequence in range(4)]
FATES = st.sampled_from(Fate)
DATA = st.builds(
    Datum,
    IDS,
    st.integers(0, 255),
    st.floats(allow_nan=False),
    st.integers(0, 255),
    st.integers(0, 2**32 - 1),
    st.one_of(
        st.binary(max_size=40),
        # Beside the database.
        st.builds(lambda size, sign: bytes([sign]) * size, st.integers(4000, 20_000), st.integers(0, 255)),
    ),
    st.booleans(),
)


@dataclass
class Model:
    data: dict[DatumId, Datum] = field(default_factory=dict)
    losses: dict[DatumId, Fate] = field(default_factory=dict)
    counters: dict[str, int] = field(default_factory=dict)
    meta: dict[str, int] = field(default_factory=dict)
    sequence: int = 0


class Stores(RuleBasedStateMachine):
    def __init__(self) -> None:
        super().__init__()
        self.directory = Path(tempfile.mkdtemp())
        self.path = self.directory / "node.db"
        self.sqlite = open_store(self.path, busy_timeout=0.0)
        self.memory = MemoryStore(EPOCH)
        self.model = Model()
        self.committed = Model()
        self.out: object | None = None
        self.at_take = Model()
        self.kept = Model()
        """What a store has that forgets what has changed since the last batch was taken."""

    def teardown(self) -> None:
        self.sqlite.abandon()
        shutil.rmtree(self.directory)

    @rule(datum=DATA)
    def put(self, datum: Datum) -> None:
        for store in (self.sqlite, self.memory):
            store.put(datum)
        self.model.data.pop(datum.id, None)
        self.model.data[datum.id] = datum

    @rule(id=IDS, fate=FATES)
    def remove(self, id: DatumId, fate: Fate) -> None:
        for store in (self.sqlite, self.memory):
            store.remove(id, fate)
        if self.model.data.pop(id, None) is not None and fate in (Fate.CORRUPTED, Fate.EXPIRED):
            self.model.losses.setdefault(id, fate)

    @rule(ids=st.lists(IDS, max_size=4), off_s=st.floats(0.0, 1e9))
    def amend(self, ids: list[DatumId], off_s: float) -> None:
        for store in (self.sqlite, self.memory):
            store.amend(ids, off_s)
        for id in set(ids) & set(self.model.data):
            datum = self.model.data[id]
            self.model.data[id] = datum._replace(created=datum.created - off_s, at_least=False)

    @rule(id=IDS, fate=FATES)
    def lose(self, id: DatumId, fate: Fate) -> None:
        for store in (self.sqlite, self.memory):
            store.lose(id, fate)
        self.model.losses.setdefault(id, fate)

    @rule(id=IDS)
    def found(self, id: DatumId) -> None:
        for store in (self.sqlite, self.memory):
            store.found(id)
        self.model.losses.pop(id, None)

    @rule(name=st.sampled_from(["delivered", "überlauf"]), amount=st.integers(-5, 5))
    def count(self, name: str, amount: int) -> None:
        for store in (self.sqlite, self.memory):
            store.count(name, amount)
        self.model.counters[name] = self.model.counters.get(name, 0) + amount

    @rule(key=st.sampled_from(["announcement", "epoch"]), value=st.integers(-(2**63), 2**63 - 1))
    def set_meta(self, key: str, value: int) -> None:
        for store in (self.sqlite, self.memory):
            store.set_meta(key, value)
        self.model.meta[key] = value

    @rule()
    def claim(self) -> None:
        for store in (self.sqlite, self.memory):
            assert store.next_sequence() == self.model.sequence
        self.model.sequence += 1

    @precondition(lambda self: self.out is None)
    @rule(force=st.booleans())
    def take(self, force: bool) -> None:
        self.out = self.sqlite.take(force=force)
        self.at_take = copy.deepcopy(self.model)
        self.kept = copy.deepcopy(self.committed if self.out is None else self.model)
        if self.out is None:
            waits_at_most = copy.deepcopy(self.committed)
            if not force:
                for id in set(waits_at_most.data) - set(self.model.data):
                    del waits_at_most.data[id]
                for id in set(waits_at_most.losses) - set(self.model.losses):
                    del waits_at_most.losses[id]
                waits_at_most.counters, waits_at_most.sequence = self.model.counters, self.model.sequence
            assert self.model == waits_at_most

    @rule()
    def roll_back(self) -> None:
        """Whether a batch was taken, is written or has failed, or there is none: what was in the last one stays."""
        self.sqlite.roll_back()
        self.model = copy.deepcopy(self.kept)
        self._refill_memory()

    @precondition(lambda self: self.out is not None)
    @rule()
    def write(self) -> None:
        self.sqlite.write(self.out)
        self.out, self.committed = None, self.at_take

    @precondition(lambda self: self.out is not None)
    @rule()
    def write_fails_because_another_program_locks_the_database(self) -> None:
        with closing(sqlite3.connect(self.path, isolation_level=None)) as other:
            other.execute("BEGIN IMMEDIATE")
            with pytest.raises(StoreError, match="locked"):
                self.sqlite.write(self.out)
            other.execute("ROLLBACK")
        self.out = None

    @precondition(lambda self: self.out is not None)
    @rule()
    def give_back(self) -> None:
        self.sqlite.restore(self.out)
        self.kept = copy.deepcopy(self.committed)
        self.out = None

    @rule()
    def crash(self) -> None:
        self.sqlite.abandon()
        self.out = None
        self.model = copy.deepcopy(self.committed)
        self.kept = copy.deepcopy(self.committed)
        self._refill_memory()
        self.sqlite = open_store(self.path, busy_timeout=0.0)
        assert not self.sqlite.report.created

    def _refill_memory(self) -> None:
        self.memory = MemoryStore(EPOCH)
        for datum in self.model.data.values():
            self.memory.put(datum)
        for id, fate in self.model.losses.items():
            self.memory.lose(id, fate)
        for name, value in self.model.counters.items():
            self.memory.count(name, value)
        for key, value in self.model.meta.items():
            self.memory.set_meta(key, value)
        for _ in range(self.model.sequence):
            self.memory.next_sequence()

    @rule()
    def restart(self) -> None:
        self.sqlite.close()
        self.out = None
        self.committed = copy.deepcopy(self.model)
        self.kept = copy.deepcopy(self.model)
        self.sqlite = open_store(self.path, busy_timeout=0.0)
        assert (self.sqlite.report.created, self.sqlite.epoch) == (False, EPOCH)

    @invariant()
    def the_stores_agree(self) -> None:
        model = self.model
        for store in (self.sqlite, self.memory):
            assert [info.id for info in store.held()] == list(model.data)
            for id, kind, created, hops, crc, size, at_least, terms in store.held():
                datum = model.data[id]
                assert (id, kind, created, hops, crc, size) == (*datum[:5], len(datum.payload))
                assert (at_least, terms) == (datum.at_least, datum.terms)
            assert set(store.ids()) == set(model.data)
            for id in ALL_IDS:
                assert store.get(id) == model.data.get(id)
            assert dict(store.losses()) == model.losses
            assert store.counters() == model.counters
            assert {key: store.get_meta(key) for key in ("announcement", "epoch")} == {
                key: model.meta.get(key) for key in ("announcement", "epoch")
            }
            assert store.used_bytes == sum(cost(len(datum.payload)) for datum in model.data.values())

    @invariant()
    def the_disk_has_what_was_committed(self) -> None:
        with SqliteReader(self.path) as reader:
            assert [reader.get(id) for id in reader.ids()] == list(self.committed.data.values())
            assert dict(reader.losses()) == self.committed.losses
            assert reader.counters() == self.committed.counters
            assert reader.meta() == self.committed.meta
            assert (reader.epoch, reader.assigned) == (EPOCH, self.committed.sequence)


Stores.TestCase.settings = settings(max_examples=examples(40), stateful_step_count=30, deadline=None)
TestStores = Stores.TestCase
