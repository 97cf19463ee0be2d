"""A memory store that is honest about crashes."""

from __future__ import annotations

from rass_mav.core.datum import RECORDED, Datum, DatumId, Fate
from rass_mav.core.store import Loss
from rass_mav.store.memory import MemoryStore
from rass_mav.store.sqlite import MAX_WAITING_REMOVALS


class CrashStore(MemoryStore):
    """A `MemoryStore` whose `restart` finds what a durable store would have had on its disk.

    Commits take no time in virtual time: what is put, recorded as lost or set is on disk before a frame that depends on
    it leaves. But removals alone wait for other changes, as in the durable store. So a restart brings back what was
    removed since the last commit: replicas of data that another node has by now, and losses that were already
    reported.
    """

    __slots__ = ("_found", "_removed")

    def __init__(self, epoch: int, *, quota_bytes: int | None = None) -> None:
        """As for a `MemoryStore`."""
        super().__init__(epoch, quota_bytes=quota_bytes)
        # Removed, but still on the disk: fewer than MAX_WAITING_REMOVALS of both together.
        self._removed: dict[DatumId, Datum] = {}
        self._found: dict[DatumId, Loss | None] = {}

    def restart(self) -> None:
        """The node starts again after a crash: what was not written is as before."""
        # They fit: all of this was stored at the time of the last commit.
        for datum in list(self._removed.values()):
            super().put(datum)
            self._flipped.add(datum.id)
        for id, loss in self._found.items():
            if loss is not None:
                super().lose(id, *loss)
        self._commit()

    def put(self, datum: Datum) -> None:
        """Store a datum as the latest, or replace the one with its id. `StoreFullError` over the quota."""
        super().put(datum)
        self._commit()

    def remove(self, id: DatumId, fate: Fate) -> None:
        """Forget a datum; record the loss if it was corrupted or expired. Unknown ids are ignored."""
        datum = self.get(id)
        super().remove(id, fate)
        if datum is None:
            return
        self._removed[id] = datum
        if fate in RECORDED:
            self._commit()
        else:
            self._wait()

    def lose(self, id: DatumId, fate: Fate, proof: bytes = b"") -> None:
        """Record a loss elsewhere. The first fate recorded for an id stays."""
        super().lose(id, fate, proof)
        self._commit()

    def found(self, id: DatumId) -> None:
        """Remove an entry from the table of losses. Unknown ids are ignored."""
        self._found.setdefault(id, self._losses.get(id))
        super().found(id)
        self._wait()

    def set_meta(self, key: str, value: int) -> None:
        """Set a small number that survives a restart."""
        super().set_meta(key, value)
        self._commit()

    def _wait(self) -> None:
        if len(self._removed) + len(self._found) >= MAX_WAITING_REMOVALS:
            self._commit()

    def _commit(self) -> None:
        self._removed.clear()
        self._found.clear()
