"""What the estimate says, for people, and as GeoJSON. Without numpy."""

from __future__ import annotations

import json
from collections.abc import Iterator
from math import pi, sqrt
from typing import Any

from rass_mav.wire.measurement import UNIT_NAMES


def number(value: float) -> str:
    """A reading, to three digits."""
    return f"{value:,.0f}" if 1000 <= abs(value) < 1e7 else f"{value:.3g}"


def unit_text(unit: str) -> str:
    """A unit as people write it, after a blank; nothing if it is unknown."""
    return f" {UNIT_NAMES[unit]}" if unit in UNIT_NAMES else ""


def lines(found: dict[str, Any]) -> Iterator[str]:
    """An estimate in lines. `found`: as of `Estimate.plain`."""
    yield f"sources: {summary(found)}"
    for source in found["sources"]:
        yield f"      {source_text(source, found['unit'])}"


def report_lines(found: dict[str, Any] | None) -> Iterator[str]:
    """The same below a report: nothing where there are too few readings."""
    if found is not None and found["verdict"] != "too few readings":
        yield from lines(found)


def summary(found: dict[str, Any]) -> str:
    """How many there are, or why that cannot be told."""
    from_what = f"from {found['readings']:,} readings of {found['drones']} drone{'s' if found['drones'] != 1 else ''}"
    if found["verdict"] == "too few readings":
        return f"too few readings: {found['why']}"
    if found["verdict"] == "no fit":
        return f"NO FIT, {from_what}: {found['why']}"
    ground = ""
    if found["background"] is not None:
        ground = f"; background {number(found['background'])}{unit_text(found['unit'])}"
    if found["verdict"] == "no source":
        return f"none found, {from_what}{ground}"
    resolved = sum(source["resolved"] for source in found["sources"])
    more = len(found["sources"]) - resolved
    rest = f", and {more} not resolved" if more else ""
    return f"{resolved} located{rest}, {from_what}, {found['height_m']:.0f} m above them{ground}"


def source_text(source: dict[str, Any], unit: str) -> str:
    """A source: where, how strong, how certain."""
    latitude, longitude = source["place"]
    strength, within = f"{number(source['strength'])}{unit_text(unit)} at 1 m", source["strength_range"]
    strength += " or any other" if within is None else f" ({number(within[0])} to {number(within[1])})"
    if not source["resolved"]:
        return f"NOT RESOLVED, near {latitude:.6f} {longitude:.6f}: {source['why']}; as if {strength}"
    area = source["area_m2"]
    moves = ", if it rests or moves" if source["may_move"] else ""
    return (
        f"{latitude:.6f} {longitude:.6f}, {strength}; with 95 % within {area:,.0f} m²{moves}, as a circle of "
        f"{sqrt(area / pi):.0f} m"
    )


def geojson(found: dict[str, Any]) -> str:
    """RFC 7946: a point for each source, and its region, which has the same number. `found`: as of `Estimate.plain`."""
    features = []
    for index, source in enumerate(found["sources"], 1):
        about = {
            "source": index, "resolved": source["resolved"], "why": source["why"], "strength": source["strength"],
            "strength_range": source["strength_range"], "unit": found["unit"], "drones": source["drones"],
            "may_move": source["may_move"],
        }  # fmt: skip
        features.append(_feature("Point", _lonlat(source["place"]), {**about, "what": "source"}))
        if source["region"]:
            rings = [[[_lonlat(corner) for corner in ring]] for ring in source["region"]]
            region = {**about, "what": "region", "share": 0.95, "area_m2": source["area_m2"]}
            features.append(_feature("MultiPolygon", rings, region))
    rest = {key: value for key, value in found.items() if key != "sources"}
    return json.dumps({"type": "FeatureCollection", "features": features, "estimate": rest}, allow_nan=False) + "\n"


def _feature(kind: str, coordinates: Any, properties: dict[str, Any]) -> dict[str, Any]:
    return {
        "type": "Feature", "geometry": {"type": kind, "coordinates": coordinates}, "properties": properties,
    }  # fmt: skip


def _lonlat(place: tuple[float, float]) -> list[float]:
    return [round(place[1], 7), round(place[0], 7)]
