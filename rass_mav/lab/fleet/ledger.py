"""The ledger of a swarm of processes, read from outside: from the nodes' stores on disk."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rass_mav.app.clock import DateNote
from rass_mav.core.datum import DatumId, Fate
from rass_mav.lab.ledger import LOST, InvariantError, outcome
from rass_mav.store.reader import SqliteReader


class StoreLedger:
    """Counts distinct data over all stores: created = delivered + held + lost.

    A datum is created when it was durable in its origin's store: it has a sequence number below the next one that this
    store knows. Data that are durable in no store at the end, neither at a base nor on a drone nor in a table of
    losses, have vanished; with custody that never happens.
    """

    def __init__(self, stores: Sequence[Path], bases: int, step_s: float, *, first: int = 0) -> None:
        """`stores`: the file of each node, by node id, the first of which is `first`. So many at the beginning are
        `bases`."""
        self._stores = dict(enumerate(stores, first))
        self._bases = list(self._stores)[:bases]
        self._step_s = step_s
        self._created: dict[tuple[int, int], int] = {}
        """(origin, epoch) -> how many sequence numbers are used: the most that was ever seen durable."""
        self.delays: dict[DatumId, int] = {}
        """Whole steps from creation to the arrival at a base, of all that has arrived."""
        self.hops: dict[DatumId, int] = {}
        self.samples = 0
        """How often copies have been counted."""
        self.stored = 0
        """Copies that drones hold, summed over samples."""
        self.waiting = 0
        """Data with a copy that have not arrived, summed over samples."""
        self.waiting_copies = 0
        """Their copies."""
        self.overflow = 0
        """Measurements that full nodes refused; after `close`."""
        self.altered = 0
        """Data at bases with a checksum that does not match; after `close`."""
        self.held = 0
        """Data on drones that have not arrived; after `close`."""
        self._lost: Counter[Fate] = Counter()

    @property
    def created(self) -> int:
        """Data created, including those that were refused."""
        return sum(self._created.values()) + self.overflow

    @property
    def delivered(self) -> int:
        """Data that have arrived at a base."""
        return len(self.delays)

    def figures(self) -> dict[str, Any]:
        """What became of the data, for a summary; after `close`."""
        lost = {fate.value: self._lost[fate] for fate in LOST}
        return outcome(self.created, self.delivered, self.held, lost, self.altered)

    def look_at_bases(self, now: float) -> None:
        """Record what has arrived since the last look. `now`: seconds since 1970."""
        for node_id in self._bases:
            with self._open(node_id) as store:
                offset = DateNote.of(store.meta()).offset_s
                for info in store.held():
                    if info.id not in self.delays:
                        # It arrived up to one look earlier: rounding down makes up for that.
                        self.delays[info.id] = max(0, int((now - info.created - offset) / self._step_s))
                        self.hops[info.id] = info.hops

    def look_at_all(self, now: float) -> None:
        """The same, and what every node has created."""
        for node_id in self._stores.keys() - self._bases:
            self._open(node_id).close()
        self.look_at_bases(now)

    @property
    def complete(self) -> bool:
        """Whether all that was seen created has been seen at a base."""
        return sum(self._created.values()) == len(self.delays)

    def sample(self) -> None:
        """Count the copies on the drones' disks. These are slightly more than the drones hold: rows wait to be deleted
        until something is written."""
        copies: Counter[DatumId] = Counter()
        for node_id in self._stores:
            if node_id not in self._bases:
                with self._open(node_id) as store:
                    copies.update(store.ids())
        waiting = [count for id, count in copies.items() if id not in self.delays]
        self.samples += 1
        self.stored += sum(copies.values())
        self.waiting += len(waiting)
        self.waiting_copies += sum(waiting)

    def close(self, now: float) -> None:
        """The last look, when all nodes have ended. Raises `InvariantError` for data that no node created."""
        self.look_at_bases(now)
        on_drones: set[DatumId] = set()
        losses: dict[DatumId, Fate] = {}
        for node_id in self._stores:
            with self._open(node_id) as store:
                self.overflow += store.counters().get(Fate.OVERFLOW.value, 0)
                losses.update(store.losses())
                if node_id not in self._bases:
                    on_drones.update(store.ids())
                    continue
                for id in store.ids():
                    datum = store.get(id)
                    self.altered += datum is None or not datum.intact
        created = {DatumId(*key, sequence) for key, count in self._created.items() for sequence in range(count)}
        found = on_drones | self.delays.keys()
        if not found <= created:
            raise InvariantError(f"data that no node created: {sorted(found - created)[:3]}")
        self.held = len(on_drones - self.delays.keys())
        self._lost = Counter(losses.get(id, Fate.VANISHED) for id in created - found)
        self._lost[Fate.OVERFLOW] += self.overflow

    def _open(self, node_id: int) -> SqliteReader:
        store = SqliteReader(self._stores[node_id])
        key = (node_id, store.epoch)
        self._created[key] = max(self._created.get(key, 0), store.assigned)
        return store
