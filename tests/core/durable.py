"""A store that is honest about crashes: what was not committed is gone. Each commit is a snapshot of everything."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field

from rass_mav.core.datum import Datum, DatumId, Fate
from rass_mav.core.store import MAX_APART, MAX_APART_OF_ONE, Loss, PartialKey, StoredInfo, info_of, key_of
from rass_mav.errors import StoreFullError
from rass_mav.store.memory import flipped


@dataclass
class State:
    """All that a store knows."""

    data: dict[DatumId, Datum] = field(default_factory=dict)
    apart: dict[tuple[DatumId, int], Datum] = field(default_factory=dict)
    losses: dict[DatumId, Loss] = field(default_factory=dict)
    counters: dict[str, int] = field(default_factory=dict)
    meta: dict[str, int] = field(default_factory=dict)
    sequence: int = 0

    def snapshot(self) -> State:
        return State(
            dict(self.data), dict(self.apart), dict(self.losses), dict(self.counters), dict(self.meta), self.sequence
        )  # fmt: skip


class DurableStore:
    """`core.store.Store` over two states: the live one, and the one on the disk."""

    def __init__(
        self,
        epoch: int,
        *,
        quota_bytes: int | None = None,
        disk: State | None = None,
        partials: dict[PartialKey, dict[int, bytes]] | None = None,
    ) -> None:
        self.life = self.epoch = epoch
        self.fresh = disk is None
        self.quota_bytes = quota_bytes
        self.disk = disk or State()
        self._live = self.disk.snapshot()
        self._urgent = False
        self._lazy = False
        self._out: State | None = None
        self.partials = {} if partials is None else partials
        """No commit covers them: a process that is killed leaves them behind."""

    def crashed(self) -> DurableStore:
        """What the next life finds."""
        return DurableStore(self.epoch, quota_bytes=self.quota_bytes, disk=self.disk, partials=self.partials)

    def commit(self) -> None:
        """What a driver does before it sends."""
        batch = self.take()
        if batch is not None:
            self.write(batch)

    def next_sequence(self) -> int:
        self._lazy = True
        self._live.sequence += 1
        return self._live.sequence - 1

    @property
    def assigned(self) -> int:
        return self._live.sequence

    @property
    def accepting(self) -> bool:
        return True

    @property
    def unwritten(self) -> bool:
        return self._urgent or self._out is not None

    @property
    def used_bytes(self) -> int:
        return sum(len(d.payload) for d in self._live.data.values())

    def room_for(self, size: int) -> bool:
        used = sum(len(d.payload) for d in self._live.data.values())
        return self.quota_bytes is None or used + size <= self.quota_bytes

    def corrupt(self, ids: Iterable[DatumId]) -> list[DatumId]:
        return [id for id in ids if not self._live.data[id].intact]

    def durable(self, id: DatumId) -> bool:
        # One that was removed and came again is not: the batch that is under way may be from between.
        datum = self._live.data.get(id)
        written = self.disk.data.get(id) is datum and (self._out is None or self._out.data.get(id) is datum)
        return datum is not None and written

    def put(self, datum: Datum) -> None:
        data = self._live.data
        old = data.get(datum.id)
        if not self.room_for(len(datum.payload) - (0 if old is None else len(old.payload))):
            raise StoreFullError("over quota")
        data.pop(datum.id, None)
        data[datum.id] = datum
        self.partials.pop(key_of(datum), None)
        self._urgent = True

    def get(self, id: DatumId) -> Datum | None:
        return self._live.data.get(id)

    def keep_apart(self, datum: Datum) -> bool:
        apart = self._live.apart
        if (datum.id, datum.crc) in apart:
            return True
        if len(apart) >= MAX_APART or sum(id == datum.id for id, _ in apart) >= MAX_APART_OF_ONE:
            return False
        apart[datum.id, datum.crc] = datum
        self._urgent = True
        return True

    def apart(self) -> Iterable[StoredInfo]:
        return list(map(info_of, self._live.apart.values()))

    def get_apart(self, id: DatumId, crc: int) -> Datum | None:
        return self._live.apart.get((id, crc))

    def flip_bit(self, id: DatumId, bit: int = 0) -> None:
        """Radiation: a bit of a stored payload changes, on the disk and in what is read from it."""
        d = self._live.data[id]
        struck = flipped(d, bit)
        self._live.data[id] = struck
        if self._out is not None and id in self._out.data:
            self._out.data[id] = struck
        if id in self.disk.data:
            # The states of earlier commits are somebody else's.
            self.disk = self.disk.snapshot()
            self.disk.data[id] = struck

    def remove(self, id: DatumId, fate: Fate) -> None:
        if self._live.data.pop(id, None) is not None:
            self._lazy = True
            if fate in (Fate.CORRUPTED, Fate.EXPIRED):
                self.lose(id, fate)

    def lose(self, id: DatumId, fate: Fate, proof: bytes = b"") -> None:
        self._live.losses.setdefault(id, Loss(fate, proof))
        self._urgent = True

    def found(self, id: DatumId) -> None:
        if self._live.losses.pop(id, None) is not None:
            self._lazy = True

    def keep_partial(self, key: PartialKey, offset: int, data: bytes) -> None:
        self.partials.setdefault(key, {})[offset] = data

    def partial(self, key: PartialKey) -> list[tuple[int, bytes]]:
        return list(self.partials.get(key, {}).items())

    def forget_partial(self, key: PartialKey) -> None:
        self.partials.pop(key, None)

    def count(self, name: str, amount: int = 1) -> None:
        self._live.counters[name] = self._live.counters.get(name, 0) + amount
        self._lazy = True

    def counters(self) -> dict[str, int]:
        return dict(self._live.counters)

    def held(self) -> Iterator[StoredInfo]:
        for d in list(self._live.data.values()):
            yield info_of(d)

    def ids(self) -> Iterable[DatumId]:
        return list(self._live.data)

    def losses(self) -> Iterable[tuple[DatumId, Fate]]:
        return [(id, loss.fate) for id, loss in self._live.losses.items()]

    def proofs(self) -> dict[DatumId, bytes]:
        return {id: loss.proof for id, loss in self._live.losses.items() if loss.proof}

    def get_meta(self, key: str) -> int | None:
        return self._live.meta.get(key)

    def set_meta(self, key: str, value: int) -> None:
        self._live.meta[key] = value
        self._urgent = True

    def meta_durable(self, key: str) -> bool:
        return self._live.meta.get(key) == self.disk.meta.get(key)

    def take(self, *, force: bool = False) -> object | None:
        if not (self.unwritten or (force and self._lazy)):
            return None
        self._urgent = self._lazy = False
        self._out = self._live.snapshot()
        return self._out

    @property
    def under_way(self) -> State | None:
        """The batch that is on its way to the disk."""
        return self._out

    @property
    def busy(self) -> bool:
        """Whether a batch is on its way to the disk."""
        return self._out is not None

    def roll_back(self) -> None:
        self._live = (self._out or self.disk).snapshot()
        self._urgent = self._lazy = False

    def write(self, batch: object) -> None:
        assert batch is self._out
        assert isinstance(batch, State)
        self.disk, self._out = batch, None

    def close(self) -> None:
        batch = self.take(force=True)
        if batch is not None:
            self.write(batch)
