"""What arrives at the bases of a mock swarm, as the store of a base: for `report`, `export` and `page`."""

from __future__ import annotations

import secrets
from pathlib import Path

from rass_mav.app.clock import LivedClock, TimeSources
from rass_mav.core.datum import DatumId
from rass_mav.errors import ConfigError
from rass_mav.ground.archive import ENDED
from rass_mav.store.sqlite import SqliteStore

from .virtual import VirtualSwarm


class Harvest:
    """A store that gets what arrives at any base. Its dates are those of a mission that begins now."""

    def __init__(self, path: Path, swarm: VirtualSwarm, bases: int, began: float) -> None:
        """`bases`: the nodes with the ids below it. `began`: the date of the first step, seconds since 1970. Raises
        `ConfigError`: there is a file already; `StoreError`."""
        if path.exists():
            raise ConfigError(f"{path}: already exists; choose another name or delete it")
        self._swarm, self._bases = swarm, bases
        self._known: set[DatumId] = set()
        self._store = SqliteStore.open(path, node_id=0, draw_epoch=lambda: secrets.randbits(32))
        sources = TimeSources(
            elapsed=self._now, boot=lambda: 1, wall=lambda: began + self._now(), trusted=lambda: True
        )  # fmt: skip
        self._clock = LivedClock(self._store, sources)

    def _now(self) -> float:
        return self._swarm.t * self._swarm.step_s

    def gather(self) -> None:
        """Take what has arrived since the last call. Raises `StoreError`."""
        for source in self._swarm.stores[: self._bases]:
            for id in source.ids():
                if id not in self._known and (datum := source.get(id)) is not None:
                    self._known.add(id)
                    self._store.put(datum)
            for info in source.apart():
                if (second := source.get_apart(info.id, info.crc)) is not None:
                    self._store.keep_apart(second)
            for id, fate in source.losses():
                self._store.lose(id, fate)
        self._clock.note()
        if (batch := self._store.take(force=True)) is not None:
            self._store.write(batch)

    def end(self) -> None:
        """The swarm has done its last step: nothing more will come. Raises `StoreError`."""
        self._store.set_meta(ENDED, 1)
        self.gather()

    def close(self) -> None:
        """Close the store."""
        self._store.close()
