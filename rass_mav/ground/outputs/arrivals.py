"""What has arrived at a base since a moment, read from its store."""

from __future__ import annotations

from itertools import chain, islice
from pathlib import Path
from typing import NamedTuple

from rass_mav.core.datum import Datum, DatumId, Fate
from rass_mav.errors import StoreDamagedError, StoreError
from rass_mav.ground.archive import Archive
from rass_mav.ground.entry import Entry
from rass_mav.ground.opening import Opens

#: Data that are read at a time.
MOST_ENTRIES = 256
#: The same with their contents: bytes, and one datum more.
MOST_BYTES = 1 << 22
#: Seconds between two looks at a store in which there was nothing new.
LOOK_S = 0.5


class Mark(NamedTuple):
    """How far somebody has read a store."""

    life: int
    epoch: int
    """Of the store. With another one, arrivals may have other numbers."""
    arrival: int = 0
    """The `Entry.arrival` of the last datum; 0: none."""
    apart: int = 0
    """The same of the last second content; 0: none, or they are not of interest."""


class Look(NamedTuple):
    """What has arrived behind a mark."""

    start: Mark
    """The mark; at the beginning of the store if that has a new life or a new epoch."""
    entries: list[Entry]
    """The next data, in the order of arrival."""
    behind: int
    """How many data are behind the mark in all."""


def look(store: Path, mark: Mark | None, opens: Opens | None = None) -> Look:
    """Read what comes next. `mark`: None: the beginning. `opens`: opens sealed data. Raises `StoreError`."""
    # Open only meanwhile: a reader that stays keeps the node from shortening its log.
    with Archive(store, salvage=False, opens=opens) as archive:
        if mark is None or archive.lineage != mark[:2]:
            mark = Mark(*archive.lineage)
        entries = list(islice(archive.entries(after=mark.arrival), MOST_ENTRIES))
        return Look(mark, entries, archive.count(after=mark.arrival))


class Contents(NamedTuple):
    """The same as a `Look`, with contents."""

    start: Mark
    data: list[tuple[Entry, Datum]]
    """The data themselves as they are stored, perhaps sealed. Without those whose copy is damaged: a sound one arrives
    as a new datum."""
    end: Mark
    """The mark behind them."""
    behind: int
    """How many data are behind `end`, at most."""


def look_into(store: Path, mark: Mark | None, opens: Opens | None = None) -> Contents:
    """Read what comes next: data, or if there are no more, second contents. `mark`: None: the beginning. `opens`: opens
    sealed data. Raises `StoreError`."""
    with Archive(store, salvage=False, opens=opens) as archive:
        if mark is None or archive.lineage != mark[:2]:
            mark = Mark(*archive.lineage)
        data: list[tuple[Entry, Datum]] = []
        end, size = mark, 0
        for entry in chain(archive.entries(after=mark.arrival), archive.second_contents(mark.apart)):
            if len(data) == MOST_ENTRIES or size >= MOST_BYTES:
                break
            end = end._replace(apart=entry.arrival) if entry.apart else end._replace(arrival=entry.arrival)
            try:
                data.append((entry, archive.datum(entry.name)))
            except StoreDamagedError:
                raise
            except StoreError:
                continue
            size += entry.size
        return Contents(mark, data, end, archive.count(after=end.arrival))


def losses(store: Path) -> list[tuple[DatumId, Fate]]:
    """What the store's node knows to be lost. Raises `StoreError`."""
    with Archive(store, salvage=False) as archive:
        return archive.losses()


def behind(store: Path, mark: Mark | None) -> int:
    """How many data are behind a mark. Raises `StoreError`."""
    with Archive(store, salvage=False) as archive:
        known = mark is not None and archive.lineage == mark[:2]
        return archive.count(after=mark.arrival if mark is not None and known else 0)
