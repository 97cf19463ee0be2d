"""What has changed in a store since its last commit, and the batch that brings the changes to the disk."""

from __future__ import annotations

import enum
from dataclasses import dataclass, field

from rass_mav.core.datum import Datum, DatumId
from rass_mav.core.store import Loss, PartialKey, key_of

from .quota import cost


@dataclass(slots=True)
class Changes:
    """Changes that are not on disk yet.

    They are applied in this order: rows in `removes` are deleted, data in `puts` are inserted, the rest is set. All
    values are absolute, so applying the same changes twice does no harm. If an I/O error leaves unclear whether a batch
    reached the disk, it can safely be written again.
    """

    puts: dict[DatumId, Datum] = field(default_factory=dict)
    """Data to store, in the order of arrival."""
    apart: dict[tuple[DatumId, int], Datum] = field(default_factory=dict)
    """Second contents of an id, by their CRC; one that is kept already stays unchanged."""
    removes: dict[DatumId, None] = field(default_factory=dict)
    """Older rows to delete (a set that keeps its order)."""
    losses: dict[DatumId, Loss] = field(default_factory=dict)
    """New entries of the table of losses; a loss that is recorded already stays unchanged."""
    founds: dict[DatumId, None] = field(default_factory=dict)
    """Entries to remove from the table of losses, before the new ones are inserted."""
    counters: dict[str, int] = field(default_factory=dict)
    """New values of the counters that changed."""
    meta: dict[str, int] = field(default_factory=dict)
    """New values of the meta numbers that changed."""
    sequence: int | None = None
    """The next sequence number, if one has been claimed."""
    amends: dict[DatumId, float] = field(default_factory=dict)
    """After the removals and puts: the time of creation of a stored datum, which is not older than that."""
    aged: bool = False
    """Before all else: every datum on disk is at least as old as recorded."""
    forgotten: set[PartialKey] = field(default_factory=set)
    """At the end: what has come of these payloads is of no use."""
    pieces: dict[PartialKey, list[tuple[int, bytes]]] = field(default_factory=dict)
    """And then, pieces of payloads that have not come whole, with their offsets; the payload that grew last is last.
    They need no transaction."""

    def __bool__(self) -> bool:
        return self.urgent or bool(self.removes or self.founds or self.counters)

    @property
    def urgent(self) -> bool:
        """Whether a commit is due.

        Data, losses, meta numbers and the sequence numbers of new data are about to be sent to other nodes, and nothing
        leaves that is not on disk. Removals and counters may wait: after a crash the node merely holds a replica,
        reports a loss twice, or counts a little less.
        """
        # A number may occur alone: its datum was sent without custody, and removed.
        changed = self.puts or self.apart or self.losses or self.meta or self.amends or self.aged
        return bool(changed) or self.sequence is not None

    @property
    def has_partials(self) -> bool:
        """Whether there is something about payloads that have not come whole."""
        return bool(self.pieces or self.forgotten)

    def partials(self) -> Changes:
        """Take out that part, which can go by itself."""
        part = Changes(forgotten=self.forgotten, pieces=self.pieces)
        self.forgotten, self.pieces = set(), {}
        return part

    @property
    def rows(self) -> int:
        """Rows to insert."""
        return len(self.puts) + len(self.apart) + len(self.losses)

    @property
    def bytes(self) -> int:
        """What waits in memory: the sum of `cost`."""
        return sum(cost(len(d.payload)) for data in (self.puts, self.apart) for d in data.values())

    def put(self, datum: Datum, older: bool) -> None:
        """Store a datum. `older`: a datum with its id is stored already, in this batch or before."""
        id = datum.id
        if older and self.puts.pop(id, None) is None:
            self.removes[id] = None
        self.amends.pop(id, None)
        self.puts[id] = datum
        self.pieces.pop(key_of(datum), None)

    def remove(self, id: DatumId) -> None:
        """Delete a stored datum. One inserted since the last commit is simply dropped; an older row of it stays in
        `removes`, where `put` recorded it."""
        self.amends.pop(id, None)
        if self.puts.pop(id, None) is None:
            self.removes[id] = None

    def lose(self, id: DatumId, loss: Loss) -> None:
        """Record a loss."""
        self.losses.setdefault(id, loss)

    def found(self, id: DatumId) -> None:
        """Remove a loss from the table."""
        self.losses.pop(id, None)
        self.founds[id] = None

    def forget(self, key: PartialKey) -> None:
        """The pieces of a payload are of no use."""
        self.pieces.pop(key, None)
        self.forgotten.add(key)

    def relief(self) -> Changes:
        """The part that only removes data, with the losses that explain it: on a full disk it can go first."""
        return Changes(removes={id: None for id in self.removes if id not in self.puts}, losses=self.losses)

    def followed_by(self, later: Changes) -> Changes:
        """These changes followed by the `later` ones, as one."""
        puts = {id: datum for id, datum in self.puts.items() if id not in later.removes}
        # Of what is removed or replaced later, nothing is amended.
        amends = {id: at for id, at in self.amends.items() if id not in later.removes and id not in later.puts}
        stored = {key_of(datum) for datum in later.puts.values()} if self.pieces else set()
        pieces = {key: some for key, some in self.pieces.items() if key not in later.forgotten and key not in stored}
        for key, some in later.pieces.items():
            pieces[key] = [*pieces.pop(key, ()), *some]
        return Changes(
            puts={**puts, **later.puts},
            apart={**self.apart, **later.apart},
            removes={**self.removes, **later.removes},
            losses={**later.losses, **{id: loss for id, loss in self.losses.items() if id not in later.founds}},
            founds={**self.founds, **later.founds},
            counters={**self.counters, **later.counters},
            meta={**self.meta, **later.meta},
            sequence=self.sequence if later.sequence is None else later.sequence,
            amends={**amends, **later.amends},
            aged=self.aged or later.aged,
            forgotten=self.forgotten | later.forgotten,
            pieces=pieces,
        )


class BatchState(enum.Enum):
    """How far a batch is with its write."""

    TAKEN = "taken"
    """Returned by `take`, not yet passed to `write`."""
    WRITING = "writing"
    """A thread is writing it."""
    WRITTEN = "written"
    """Durable."""
    FAILED = "failed"
    """Not durable: to be written again."""


class Batch:
    """What `take` returns and `write` makes durable.

    Its state is all that the thread in `write` and the owner of the store share. One side sets it, the other reads it,
    and neither changes `changes`.
    """

    __slots__ = ("changes", "state")

    def __init__(self, changes: Changes) -> None:
        self.changes = changes
        self.state = BatchState.TAKEN
