"""GeoJSON (RFC 7946): a point for each datum with a position, and contours, for maps, web pages and scripts."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path

from rass_mav.ground.contours import contours_of, features, levels_of
from rass_mav.ground.entry import Data, Entry
from rass_mav.ground.field import Field

from . import Exported, Format
from .csv import COLUMNS, row


def write(entries: Iterable[Entry], out: Path, source: Data) -> Exported:
    """A feature a line. Its properties are the columns of CSV, without those that are unknown. Behind the data come the
    contours of their readings, as lines, at the levels that no setting has changed.

    The third coordinate is the altitude above mean sea level, as everywhere in this program; the RFC means the height
    above the ellipsoid, which differs by up to 110 m.
    """
    count, left_out, fields = 0, Counter[str](), dict[str, Field]()
    with out.open("x", encoding="ascii") as file:
        file.write('{"type": "FeatureCollection", "features": [')
        for entry, point in placed(entries, left_out):
            feature = {
                "type": "Feature",
                "id": entry.name,
                "geometry": {"type": "Point", "coordinates": point},
                "properties": known(entry),
            }
            file.write((",\n" if count else "\n") + json.dumps(feature))
            count += 1
            if entry.painted is not None and not entry.apart:
                place, reading, unit = entry.painted
                fields.setdefault(unit, Field(place)).add(place, reading)
        for unit, field in sorted(fields.items()):
            lines = features(contours_of(field, levels_of(unit)), unit)
            file.writelines(",\n" + json.dumps(line) for line in lines)
        file.write("\n]}\n")
    return Exported(count, left_out, [out])


def point_of(entry: Entry) -> tuple[float, float, float] | None:
    """Longitude and latitude, degrees, and metres above mean sea level; None: no place on Earth."""
    if entry.place is None:
        return None
    latitude, longitude = entry.place
    return longitude, latitude, entry.altitude or 0.0


def placed(entries: Iterable[Entry], left_out: Counter[str]) -> Iterator[tuple[Entry, tuple[float, float, float]]]:
    """Those with a position, each with its point; the others are counted."""
    for entry in entries:
        point = point_of(entry)
        if point is None:
            left_out["no position"] += 1
        else:
            yield entry, point


def known(entry: Entry) -> dict[str, object]:
    """The columns of CSV that are known, by their names."""
    return {name: value for name, value in zip(COLUMNS, row(entry), strict=True) if value is not None}


FORMAT = Format(".geojson", "measurements and files with a position on Earth", write)
