"""GPX 1.1 (Topografix): each drone's way as a track; hot spots, files and what is in no track as waypoints. For GPS
receivers and maps."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from itertools import groupby
from operator import itemgetter
from pathlib import Path

from rass_mav.ground.attention.conditions import reading_text
from rass_mav.ground.entry import Data, Entry, Place, iso, shown_reading
from rass_mav.ground.hotspots import HotSpot, HotSpots
from rass_mav.ground.sorting import Sorter, sorting

from . import Exported, Format
from .kml import text_of

#: Of the elements within `extensions`. A name, not an address: there is nothing to fetch.
NAMESPACE = "urn:rass-mav:gpx:1"
_HEAD = f"""<?xml version="1.0" encoding="UTF-8"?>
<gpx version="1.1" creator="rass-mav" xmlns="http://www.topografix.com/GPX/1/1" xmlns:rass="{NAMESPACE}">
"""
_TAIL = "</gpx>\n"


def write(entries: Iterable[Entry], out: Path, source: Data) -> Exported:
    """Waypoints first, as the schema demands, then a track for each drone, in order of time.

    A track has the places of a drone's measurements and statuses. A segment ends where the drone began a new epoch.
    Where the order is not known, a place is a waypoint: data of which only the latest possible date is known, and
    second contents of an id. Altitudes are above mean sea level, as GPX means them.
    """
    count, left_out, spots = 0, Counter[str](), HotSpots()
    with out.open("x", encoding="utf-8") as file, sorting(out) as sorter:
        file.write(_HEAD)
        for entry in entries:
            spots.take(entry, None)
            place = entry.place or entry.whereabouts
            if place is None:
                left_out["no position"] += 1
                continue
            if entry.whereabouts is not None and not entry.at_least and not entry.apart:
                sorter.add(entry.id.origin, entry.utc, entry.id.epoch, _point("trkpt", entry, place))
            else:
                file.write(_point("wpt", entry, place))
            count += 1
        file.writelines(_spot(number, spot) for number, spot in enumerate(spots.highest(), 1))
        file.writelines(_tracks(sorter))
        file.write(_TAIL)
    return Exported(count, left_out, [out])


def _tracks(sorter: Sorter) -> Iterator[str]:
    for drone, points in groupby(sorter.sorted(), itemgetter(0)):
        yield f"<trk><name>drone {drone}</name>\n"
        for _, segment in groupby(points, itemgetter(2)):
            yield "<trkseg>\n"
            yield from (text for *_, text in segment)
            yield "</trkseg>\n"
        yield "</trk>\n"


def _point(tag: str, entry: Entry, place: Place) -> str:
    """A point of a track or a waypoint. Its elements are in the order of the schema."""
    made = None if entry.manifest is None else entry.manifest.time
    if made is None and entry.dated and not entry.at_least:
        made = entry.utc
    return (
        _opened(tag, place)
        + ("" if entry.altitude is None else f"<ele>{entry.altitude:.3f}</ele>")
        + ("" if made is None else f"<time>{iso(made)}</time>")
        + f"<name>{text_of(entry.file or entry.name)}</name>"
        + (f"<desc>{text_of(_described(entry))}</desc>" if tag == "wpt" else "")
        + f"<type>{entry.kind_name}</type><extensions>{_extensions(_columns(entry))}</extensions></{tag}>\n"
    )


def _opened(tag: str, place: Place) -> str:
    latitude, longitude = place
    # The schema has no 180 degrees east.
    return f'<{tag} lat="{latitude:.7f}" lon="{-180.0 if longitude == 180.0 else longitude:.7f}">'


def _spot(number: int, spot: HotSpot) -> str:
    """Its time may be that of a datum which is perhaps older, so it has none; its datum, which is named, has."""
    values = {"id": spot.id, "drone": spot.drone, "reading": shown_reading(spot.reading), "unit": spot.unit or None}
    return (
        f"{_opened('wpt', spot.place)}<name>hot spot {number}</name>"
        f"<desc>{text_of(f'drone {spot.drone}, {spot.id}, {reading_text(spot.reading, spot.unit)}')}</desc>"
        f"<type>hot spot</type><extensions>{_extensions(values)}</extensions></wpt>\n"
    )


def _described(entry: Entry) -> str:
    """A datum in a line, for people: which it is, and what it measured."""
    reading = entry.reading
    unit = None if entry.measurement is None else entry.measurement.unit
    said = [f"drone {entry.id.origin}", entry.name] + ([] if reading is None else [reading_text(reading, unit)])
    return ", ".join(said + (["possibly older than its date"] if entry.at_least else []))


def _columns(entry: Entry) -> dict[str, object]:
    """The columns of CSV that a point has no element for."""
    m = entry.measurement
    return {
        "id": entry.name,
        "drone": entry.id.origin,
        "reading": shown_reading(entry.reading),
        "unit": None if m is None else m.unit,
        "risk": None if m is None else round(m.risk, 5),
        "position_error_m": None if m is None else m.error_m,
        "time_error_s": None if entry.error_s is None else round(entry.error_s, 3),
        "at_least_so_old": 1 if entry.at_least else None,
    }


def _extensions(values: dict[str, object]) -> str:
    return "".join(
        f"<rass:{name}>{text_of(str(value))}</rass:{name}>" for name, value in values.items() if value is not None
    )


FORMAT = Format(".gpx", "data with a position on Earth", write)
