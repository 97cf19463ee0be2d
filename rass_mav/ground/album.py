"""What operators have put that a map shows: photographs, and lines of text. Bounded, whatever drones send."""

from __future__ import annotations

from bisect import insort
from collections import defaultdict
from collections.abc import Callable
from typing import Any, NamedTuple

from rass_mav.app.payloads import unpack_file
from rass_mav.errors import StoreError
from rass_mav.wire.file import Cut

from .assembly import File, Group
from .entry import Data, Entry, Place
from .pictures import MOST_BYTES

#: The latest that are listed, of all drones and of one.
MOST_LISTED, MOST_OF_DRONE = 60, 20
#: Parts of a photograph. One that has more is listed, and not shown.
MOST_PARTS = 2048
#: How the names of photographs end.
_ENDINGS = (".jpg", ".jpeg", ".png", ".webp")


class _Kept(NamedTuple):
    """In the order of creation."""

    utc: float
    name: str
    entry: Entry


class Album:
    """Photographs and lines, by drone."""

    def __init__(self) -> None:
        self._kept: defaultdict[int, list[_Kept]] = defaultdict(list)
        self._parts: defaultdict[int, dict[Cut, Group]] = defaultdict(dict)

    def take(self, entry: Entry) -> None:
        """A datum that has arrived, no second content."""
        origin = entry.id.origin
        if entry.part is not None:
            cut = entry.part.cut
            if _shown(cut):
                groups = self._parts[origin]
                groups.setdefault(cut, Group(origin, cut)).add(entry.part.number, entry.name)
                # Parts may come before their manifest, so of a file that is not known yet they are kept too.
                if len(groups) > 2 * MOST_OF_DRONE:
                    del groups[next(iter(groups))]
        elif entry.text is not None or (entry.file or "").lower().endswith(_ENDINGS):
            kept = self._kept[origin]
            insort(kept, _Kept(entry.utc, entry.name, entry), key=lambda one: one[:2])
            if len(kept) > MOST_OF_DRONE:
                del kept[0]

    def plain(self, place_of: Callable[[Entry], Place | None]) -> list[dict[str, Any]]:
        """The latest, in the order of time, as plain values for JSON. `place_of`: where a datum was created, if it does
        not say so."""
        latest = sorted(one for kept in self._kept.values() for one in kept)[-MOST_LISTED:]
        return [self._plain(one.entry, place_of) for one in latest]

    def _plain(self, entry: Entry, place_of: Callable[[Entry], Place | None]) -> dict[str, Any]:
        place = entry.place or place_of(entry)
        group = self._group(entry)
        return {
            "id": entry.name,
            "drone": entry.id.origin,
            "utc": round(entry.utc, 1),
            "place": None if place is None else [round(part, 7) for part in place],
            "text": entry.text,
            "name": entry.file,
            "size": entry.size,
            "parts": None if entry.manifest is None or group is None else list(group.extent),
            "shown": entry.text is None and entry.size <= MOST_BYTES and (group is None or group.whole),
        }

    def _group(self, entry: Entry) -> Group | None:
        """The parts of a photograph; None: it came whole."""
        if entry.manifest is None:
            return None
        cut = entry.manifest.cut
        return self._parts[entry.id.origin].get(cut) or Group(entry.id.origin, cut)

    def find(self, name: str) -> Entry | None:
        """A photograph by the name of its datum; None: there is none, or it is not to be shown."""
        entries = (one.entry for kept in self._kept.values() for one in kept if one.name == name)
        entry = next(entries, None)
        if entry is None or entry.text is not None or entry.size > MOST_BYTES:
            return None
        group = self._group(entry)
        return entry if group is None or group.whole else None

    def read(self, entry: Entry, data: Data) -> bytes:
        """Its contents. `entry`: as of `find`. Raises `StoreError`."""
        group = self._group(entry)
        if group is None:
            return unpack_file(data.payload(entry.name))[1]
        file = File(group, entry, data.payload)
        if file.check() > MOST_BYTES:
            raise StoreError(f"{entry.name}: too large to display")
        return b"".join(file.pieces())


def _shown(cut: Cut) -> bool:
    return cut.length <= MOST_BYTES and cut.end <= MOST_PARTS
