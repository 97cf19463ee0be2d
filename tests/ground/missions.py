"""Stores that a mission may leave."""

from __future__ import annotations

from pathlib import Path

from rass_mav.app.clock import LivedClock, TimeSources
from rass_mav.app.payloads import pack_file
from rass_mav.core.datum import Datum, DatumId, Kind, make_datum
from rass_mav.store.files import MARK, beside
from rass_mav.store.sqlite import SqliteStore
from rass_mav.wire.measurement import Measurement, encode_measurement
from tests.store.store_helpers import commit, epochs

#: 2026-11-22T10:00:00Z.
WALL_S = 1_795_341_600.0
EPOCH = 0xABC00001


class Base:
    """A base's store while data arrive. Its clock is right, and shows `wall` at first, seconds since 1970."""

    def __init__(self, path: Path, *, trusted: bool = True, wall: float = WALL_S) -> None:
        self.path = path
        self.wall = wall
        self._sources = TimeSources(
            elapsed=lambda: self.wall - wall, boot=lambda: 1, wall=lambda: self.wall, trusted=lambda: trusted
        )
        self._epochs = epochs()
        self.start()

    def start(self) -> None:
        """Open the store, as a base does that starts: a damaged one is set aside, and a new one gets what it held."""
        self.store = SqliteStore.open(self.path, node_id=1, draw_epoch=self._epochs)
        self.clock = LivedClock(self.store, self._sources)

    def damage(self) -> None:
        """The base ends, and the beginning of its store is overwritten."""
        self.close()
        content = bytearray(self.path.read_bytes())
        content[:100] = bytes(100)
        self.path.write_bytes(content)

    def lose_mark(self) -> None:
        """The base ends, and the mark of its numbers is gone: when it starts it draws a new epoch."""
        self.close()
        beside(self.path, MARK).unlink()

    def arrive(self, *data: Datum) -> None:
        """They arrive now, in one commit."""
        for datum in data:
            self.store.put(datum)
        self.clock.note()
        assert commit(self.store)

    def datum(
        self, origin: int, sequence: int, kind: int, payload: bytes, *, age_s: float = 0.0, hops: int = 1
    ) -> Datum:
        """One that a drone made so long ago."""
        return make_datum(DatumId(origin, EPOCH, sequence), kind, self.clock.now() - age_s, payload)._replace(hops=hops)

    def measurement(self, origin: int, sequence: int, m: Measurement, *, age_s: float = 0.0, hops: int = 1) -> Datum:
        return self.datum(origin, sequence, Kind.MEASUREMENT, encode_measurement(m), age_s=age_s, hops=hops)

    def file(self, origin: int, sequence: int, name: str, content: bytes) -> Datum:
        return self.datum(origin, sequence, Kind.FILE, pack_file(name, content))

    def close(self) -> None:
        self.store.close()


#: A measurement of drone 7 over Zurich.
HERE = Measurement(47.3769, 8.5417, 412.0, 0.142, 0.25, unit="usvh", error_m=2.1)
