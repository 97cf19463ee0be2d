"""A datum as people and other programs use it, and which of them somebody wants to see."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from datetime import datetime, timezone
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from rass_mav.core.datum import Datum, DatumId, Fate, Kind
from rass_mav.core.seals import SEALED
from rass_mav.wire.measurement import MOST_READING, Measurement
from rass_mav.wire.nodestatus import NodeStatus

#: Units of readings, as people write them.
UNIT_NAMES = {"usvh": "uSv/h", "cpm": "cpm", "cps": "cps", "counts": "counts"}

#: Latitude and longitude, degrees.
Place = tuple[float, float]


class Entry(NamedTuple):
    """A datum in a store."""

    arrival: int
    """Rises in the order in which the store got its data."""
    id: DatumId
    crc: int
    kind: int
    """A `Kind`, or that of a later version; with the bit `SEALED` if the datum is sealed, and could not be opened."""
    size: int
    """Bytes of contents; of payload, if it is sealed."""
    hops: int
    utc: float
    """When it was created, seconds since 1970."""
    error_s: float | None
    """`utc` is at most this far from the truth, seconds; None: nobody knows how far."""
    at_least: bool
    """It may be older, by any time: `utc` is the latest possible date."""
    age_s: float
    """How old it is now, seconds. Where the date is not known: how old it was when the store was last used."""
    measurement: Measurement | None = None
    status: NodeStatus | None = None
    file: str | None = None
    """The name of a named file, as its drone gave it: not trustworthy."""
    malformed: str = ""
    """Why the contents cannot be read; empty: they can, or nobody has to read them."""
    arrived: float | None = None
    """When it came to the store, seconds since 1970; None: unknown."""
    apart: bool = False
    """It is a second content of an id."""

    @property
    def name(self) -> str:
        """What `get` takes: the id, and for a second content a # and its checksum."""
        return f"{self.id}#{self.crc:08x}" if self.apart else str(self.id)

    @property
    def dated(self) -> bool:
        """Whether `utc` can be a date: the node of the store had one, and its note is not damaged."""
        return self.utc >= _FIRST_DATE

    @property
    def sealed(self) -> bool:
        """Whether the contents are sealed, and could not be opened."""
        return self.kind & SEALED != 0

    @property
    def kind_name(self) -> str:
        """For people: measurement, file, bytes, status or sealed; the number of an unknown kind."""
        if self.sealed:
            return "sealed"
        try:
            return Kind(self.kind).name.lower()
        except ValueError:
            return str(self.kind)

    @property
    def place(self) -> Place | None:
        """Latitude and longitude of a measurement, degrees; None: unknown, or degrees that no place on Earth has."""
        m = self.measurement
        return None if m is None or m.latitude is None or m.longitude is None else _earthly((m.latitude, m.longitude))

    @property
    def whereabouts(self) -> Place | None:
        """The same of a measurement or of a status: where the drone was."""
        if self.status is None or self.status.place is None:
            return self.place
        return _earthly(self.status.place)

    @property
    def reading(self) -> float | None:
        """In the unit of the measurement; None: there is none, or one that no sensor can send."""
        reading = None if self.measurement is None else self.measurement.reading
        return reading if reading is not None and abs(reading) <= MOST_READING else None

    @property
    def painted(self) -> tuple[Place, float, str] | None:
        """What a map shows of a measurement: its place, its reading, and the unit (empty: unknown); None: nothing."""
        m, place, reading = self.measurement, self.place, self.reading
        return None if m is None or place is None or reading is None else (place, reading, m.unit or "")

    def plain(self) -> dict[str, Any]:
        """As plain values for JSON; what does not apply is left out."""
        m = self.measurement
        return {
            "id": self.name,
            "kind": self.kind if self.kind_name.isdigit() else self.kind_name,
            "size": self.size,
            "hops": self.hops,
            "created": round(self.utc, 3),
            **({"utc": iso(self.utc)} if self.dated else {}),
            **({} if self.error_s is None else {"error_s": round(self.error_s, 3)}),
            "age_s": round(self.age_s, 3),
            **({} if self.arrived is None else {"arrived": round(self.arrived, 3)}),
            **({"at_least": True} if self.at_least else {}),
            **({"apart": True} if self.apart else {}),
            **({} if m is None else {"measurement": m._asdict()}),
            **({} if self.status is None else {"status": self.status._asdict()}),
            **({} if self.file is None else {"name": self.file}),
            **({"malformed": self.malformed} if self.malformed else {}),
        }


class Filter(NamedTuple):
    """Which data somebody wants. None: all; what a datum does not tell does not match."""

    drones: Collection[int] | None = None
    kinds: Collection[str] | None = None
    """As in `Entry.kind_name`."""
    since: float | None = None
    """Created then or later, seconds since 1970."""
    until: float | None = None
    """Created before, seconds since 1970."""
    box: tuple[float, float, float, float] | None = None
    """South, west, north, east, degrees. West above east: across the 180th meridian."""
    above: float | None = None
    """With a reading above this, in its own unit."""

    def admits(self, entry: Entry) -> bool:
        """Whether it is one of them."""
        return (
            (self.drones is None or entry.id.origin in self.drones)
            and (self.kinds is None or entry.kind_name in self.kinds)
            and (self.since is None or entry.utc >= self.since)
            and (self.until is None or entry.utc < self.until)
            and (self.above is None or (entry.reading is not None and entry.reading > self.above))
            and (self.box is None or _inside(entry.place, *self.box))
        )


#: All data.
ALL = Filter()


class Data(Protocol):
    """The data of a mission: in a node's store, or in a database."""

    path: Path
    """Names it; the store's file, if it is one."""
    remarks: list[str]
    """About its state, for people."""
    seen: int
    """The latest `Entry.arrival` that was read."""

    def renew(self) -> None:
        """Read from now on what is there now."""

    def rest(self) -> None:
        """Read nothing until `renew`, so that whoever writes is not held up."""

    def count(self) -> int:
        """How many data `entries` reads."""

    def entries(self, wanted: Filter = ALL, *, after: int = -1) -> Iterator[Entry]:
        """The data in the order of arrival, and then the second contents of ids. `after`: only what arrived later than
        this `Entry.arrival`, and no second contents."""

    def second_contents(self, after: int) -> Iterator[Entry]:
        """The second contents of ids, in an order of their own: those behind this `Entry.arrival` of theirs; 0: all."""

    def datum(self, name: str) -> Datum:
        """A datum by its name, as it is stored. Raises `DatumError`: not a name; `StoreError`: there is none, or it is
        corrupt."""

    def payload(self, name: str) -> bytes:
        """The contents of a datum by its name. Raises the same, and `StoreError` if it is sealed and cannot be
        opened."""

    def entry(self, name: str) -> Entry:
        """The same as an entry."""

    def losses(self) -> list[tuple[DatumId, Fate]]:
        """What is known to be lost."""

    def close(self) -> None:
        """Release the files or the connection."""


def _earthly(place: Place) -> Place | None:
    """A place if it is on Earth."""
    return place if abs(place[0]) <= 90.0 and abs(place[1]) <= 180.0 else None


def _inside(place: Place | None, south: float, west: float, north: float, east: float) -> bool:
    if place is None or not south <= place[0] <= north:
        return False
    return west <= place[1] <= east if west <= east else place[1] >= west or place[1] <= east


def iso(utc: float) -> str:
    """A date as ISO 8601 in UTC, to the millisecond. `utc`: seconds since 1970; dates that no calendar has become the
    first or the last."""
    utc = min(max(utc, _FIRST), _LAST)
    return datetime.fromtimestamp(utc, timezone.utc).isoformat(timespec="milliseconds").replace("+00:00", "Z")


# 2000-01-01.
_FIRST_DATE = 946_684_800.0
# The years 1 and 9999.
_FIRST, _LAST = -62_135_596_800.0, 253_402_300_799.0
