"""Stores with the data of a mission."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import count
from pathlib import Path
from typing import Any

from rass_mav.app.clock import LivedClock, TimeSources
from rass_mav.app.payloads import pack_file
from rass_mav.core.datum import Datum, DatumId, Kind, make_datum
from rass_mav.ground.archive import Archive
from rass_mav.store.sqlite import SqliteStore
from rass_mav.wire.measurement import Measurement, encode_measurement
from tests.some import some

EPOCH = 0x0123ABCD
#: 2026-11-22T12:00:00Z.
NOW = 1_795_348_800.0
#: How long the node has been running, seconds.
LIVED_S = 100_000.0

HOSTILE = (
    "../../etc/passwd", "=cmd()", "CON", "photo 🛸.jpg", "é" * 127 + "x", "two\nlines", "<script>alert(1)</script>",
    "...", "C:\\autoexec.bat", "bell\x07", "gpj.\u202eexe", "nul\0",
)  # fmt: skip


def measured(sequence: int, ago_s: float = 100.0, *, drone: int = 7, **fields: Any) -> Datum:
    """A measurement; each field of `Measurement` has a value."""
    values = {"latitude": 47.5, "longitude": 8.25, "altitude": 412.5, "reading": 0.75, "risk": 0.5, "unit": "usvh"}
    payload = encode_measurement(Measurement(**{**values, **fields}))
    return make_datum(DatumId(drone, EPOCH, sequence), Kind.MEASUREMENT, LIVED_S - ago_s, payload)


def put(sequence: int, kind: int, payload: bytes, *, drone: int = 7, ago_s: float = 100.0) -> Datum:
    """Another datum."""
    return make_datum(DatumId(drone, EPOCH, sequence), kind, LIVED_S - ago_s, payload)


def nowhere(sequence: int, **fields: Any) -> Datum:
    """A measurement without a position on Earth."""
    return measured(sequence, latitude=None, longitude=None, altitude=None, **fields)


def mission() -> list[Datum]:
    """Some of everything."""
    corrupt = put(90, Kind.BYTES, b"all well")
    return [
        measured(0),
        measured(1, reading=40.0, unit="cpm", risk=0.1, error_m=2.5),
        measured(2, reading=2.0, unit="cps", risk=1.0),
        measured(3, reading=5.0, unit="counts"),
        measured(4, reading=5.0, unit=None),
        measured(5, reading=None, unit=None, risk=1.0),
        measured(6, latitude=-33.123456, longitude=-70.654321, altitude=-12.5),
        measured(7, latitude=120.0, longitude=8.0),
        nowhere(8),
        nowhere(9, local=(1.5, -2.5, -30.0), error_m=0.5),
        measured(10)._replace(at_least=True),
        *(put(20 + n, Kind.FILE, pack_file(name, name.encode() * 2)) for n, name in enumerate(HOSTILE)),
        put(40, Kind.BYTES, b"\0\1\2 a line"),
        put(41, 59, b"of a later version"),
        put(42, Kind.FILE, b"\xffshort"),
        put(43, Kind.MEASUREMENT, b"\1"),
        corrupt._replace(payload=b"all WELL"),
    ]


#: Of these: with a position on Earth; and those that a bGeigie log can hold.
PLACED, SAFECAST = 8, 4
#: How many files are in the mission, the datum of bytes included.
FILES = len(HOSTILE) + 1


def stored(
    path: Path, data: Iterable[Datum], now: float = NOW, *, trusted: bool = True, apart: Iterable[Datum] = ()
) -> Path:
    """A store whose node has written its time, and has then stopped. `now`: the date then, seconds since 1970. `apart`:
    second contents of ids."""
    elapsed = [0.0]
    sources = TimeSources(lambda: elapsed[0], lambda: 1, lambda: now, lambda: trusted)
    with SqliteStore.open(path, node_id=0, draw_epoch=count(EPOCH).__next__) as store:
        clock = LivedClock(store, sources)
        elapsed[0] = LIVED_S
        clock.note()
        for number, datum in enumerate(data):
            store.put(datum)
            if number % 2000 == 1999:
                batch = some(store.take(force=True))
                store.write(batch)
        for datum in apart:
            assert store.keep_apart(datum)
    return path


def archive(path: Path, now: float = NOW) -> Archive:
    """The archive of such a store, read at once."""
    return Archive(path, lambda: now)
