"""A datum as people and other programs use it, and which of them somebody wants to see."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterator
from datetime import datetime, timezone
from math import inf
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from rass_mav.app.clock import DateNote
from rass_mav.core.datum import PARTS, Datum, DatumId, Fate, Kind, parted
from rass_mav.core.seals import SEALED
from rass_mav.errors import ForgedError, MalformedError, StoreError
from rass_mav.wire.file import PACKINGS, Manifest, PartHead
from rass_mav.wire.measurement import MOST_READING, Measurement, shortest
from rass_mav.wire.nodestatus import NodeStatus

D = TypeVar("D", bound="Data")

#: Returns the contents of a sealed datum: its id, its kind without `SEALED`, its payload without terms, its terms.
#: Raises `ForgedError`, `MalformedError`.
Opens = Callable[[DatumId, int, bytes, bytes], bytes]
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
    """Bytes of contents, without terms, of a manifest those of its file; sealed, if it could not be opened."""
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
    manifest: Manifest | None = None
    part: PartHead | None = None
    text: str | None = None
    """The beginning of bytes that are a line of text, as `put --line` hands it in: not trustworthy."""
    malformed: str = ""
    """Why the contents cannot be read; empty: they can, or nobody has to read them."""
    arrived: float | None = None
    """When it came to the store, seconds since 1970; None: unknown."""
    apart: bool = False
    """It is a second content of an id."""
    priority: int | None = None
    """As in `Terms`; None: the usual one, and it has no lifetime."""
    ttl_s: int | None = None
    """Its lifetime, seconds; None: it has none."""

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
        """For people: measurement, file, part, bytes, status or sealed; the number of an unknown kind."""
        if self.sealed:
            return "sealed"
        if self.kind == Kind.MANIFEST:
            return "file"
        if self.kind in PARTS:
            return "part"
        try:
            return Kind(self.kind).name.lower()
        except ValueError:
            return str(self.kind)

    @property
    def place(self) -> Place | None:
        """Latitude and longitude of a measurement or of a file, degrees; None: unknown, or degrees that no place
        on Earth has."""
        if self.manifest is not None and self.manifest.place is not None:
            return _earthly(self.manifest.place[:2])
        m = self.measurement
        return None if m is None or m.latitude is None or m.longitude is None else _earthly((m.latitude, m.longitude))

    @property
    def altitude(self) -> float | None:
        """Of the same, metres above mean sea level; None: unknown."""
        if self.manifest is not None and self.manifest.place is not None:
            return self.manifest.place[2]
        return None if self.measurement is None else self.measurement.altitude

    @property
    def whereabouts(self) -> Place | None:
        """The same of a measurement or of a status: where the drone was."""
        if self.status is not None and self.status.place is not None:
            return _earthly(self.status.place)
        # A file may be from another time.
        return None if self.manifest is not None else self.place

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
            **({} if self.priority is None else {"priority": self.priority}),
            **({} if self.ttl_s is None else {"ttl_s": self.ttl_s}),
            **({"at_least": True} if self.at_least else {}),
            **({"apart": True} if self.apart else {}),
            **({} if m is None else {"measurement": {**m._asdict(), "reading": shown_reading(m.reading)}}),
            **({} if self.status is None else {"status": self.status._asdict()}),
            **({} if self.file is None else {"name": self.file}),
            **({} if self.manifest is None else _file(self.manifest)),
            **({} if self.part is None else {"part": self.part.number, "file": self.part.cut.key.hex()}),
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


def shown_reading(reading: float | None) -> float | None:
    """As the sensor showed it, if a datum can hold it."""
    return reading if reading is None or abs(reading) > MOST_READING else shortest(reading)


#: All data.
ALL = Filter()


class Data(ABC):
    """The data of a mission: in a node's store, or in a database. It changes nothing there."""

    path: Path
    """Names it; the store's file, if it is one."""
    title: str
    """The mission's name, for people."""

    def __init__(self, now: Callable[[], float], opens: Opens | None) -> None:
        """`now`: the date, seconds since 1970. `opens`: opens sealed data; None: they stay sealed."""
        self.remarks: list[str] = []
        """About its state, for people."""
        self._now = now
        self._opens = opens

    @property
    def date(self) -> DateNote:
        """What it tells about the time of its node. Of a database, of which there are several: nothing."""
        return DateNote(inf, 0.0, True)

    @property
    def notes(self) -> list[str]:
        """What a report of it does not mean, in sentences."""
        return []

    @property
    def ended(self) -> bool:
        """Whether nothing more will come, as far as it tells."""
        return False

    @abstractmethod
    def renew(self) -> None:
        """Read from now on what is there now."""

    @abstractmethod
    def rest(self) -> None:
        """Read nothing until `renew`, so that whoever writes is not held up."""

    @property
    @abstractmethod
    def lineage(self) -> tuple[int, int]:
        """While it stays the same, no `Entry.arrival` is used for another datum."""

    @abstractmethod
    def count(self, *, after: int = -1) -> int:
        """How many data `entries` reads. `after`: only data that arrived later, without second contents."""

    @abstractmethod
    def arrivals(self, after: int, *, apart: bool = False, parts: bool | None = None) -> Iterator[Entry]:
        """What arrived later than this `Entry.arrival`, in this order. `apart`: of the second contents of ids, which
        have an order of their own. `parts`: only parts of files, or only other data; None: all."""

    def entries(self, wanted: Filter = ALL, *, parts: bool | None = None) -> Iterator[Entry]:
        """The data in the order of arrival, and then the second contents of ids. `parts`: as above."""
        for apart in (False, True):
            yield from filter(wanted.admits, self.arrivals(-1, apart=apart, parts=parts))

    @abstractmethod
    def datum(self, name: str) -> Datum:
        """A datum by its name, as it is stored. Raises `DatumError`: not a name; `StoreError`: there is none, or it is
        corrupt."""

    def payload(self, name: str) -> bytes:
        """The contents of a datum by its name. Raises the same, and `StoreError` if it is sealed and cannot be
        opened."""
        datum = self.datum(name)
        terms, payload = parted(datum.kind, datum.payload)
        if not datum.kind & SEALED:
            return payload
        if self._opens is None:
            raise StoreError(f"{name}: sealed; give the ground's keys with --keys")
        try:
            return self._opens(datum.id, datum.kind & ~SEALED, payload, terms)
        except (ForgedError, MalformedError) as error:
            raise StoreError(f"{name}: {error}") from None

    @abstractmethod
    def entry(self, name: str) -> Entry:
        """The same as an entry."""

    @abstractmethod
    def losses(self) -> list[tuple[DatumId, Fate]]:
        """What is known to be lost."""

    @abstractmethod
    def close(self) -> None:
        """Release the files or the connection."""

    def __enter__(self: D) -> D:
        return self

    def __exit__(self, *raised: object) -> None:
        self.close()


def _file(manifest: Manifest) -> dict[str, Any]:
    """The fields of a manifest for JSON."""
    return {
        "sha256": manifest.digest.hex(),
        "packing": PACKINGS[manifest.cut.packing],
        **({} if manifest.time is None else {"time": manifest.time}),
        **({} if manifest.place is None else {"place": list(manifest.place)}),
    }


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
