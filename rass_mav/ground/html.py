"""The report as one file to mail or to print: a map and tables, without scripts, and with nothing from elsewhere."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from html import escape
from math import cos, floor, log, log10, radians
from pathlib import Path
from typing import Any, NamedTuple

from rass_mav.wire.measurement import UNIT_NAMES

from .album import Album
from .attention.conditions import Row
from .attention.watch import Rules, Watch
from .contours import Contour, contours_of
from .enclosed import Note, enclosed
from .entry import Data, Entry, Place, iso
from .field import DEGREE_M, Field
from .formats.kml import COLOURS
from .history import Slots
from .hotspots import HotSpot
from .hotspots import report_lines as spots_lines
from .report import FAULT_TEXTS, BasePlace, heard_text, range_text, risk_text, span
from .sources.locator import located
from .sources.readings import Samples
from .sources.texts import report_lines as sources_lines

#: Places of a drone that are drawn.
MOST_PLACES = 300
#: Ranges of missing numbers that are listed for a drone, the latest.
MOST_RANGES = 8
# The map, in its own units, and the least that it shows, metres.
_WIDTH, _HEIGHT, _EDGE, _LEAST_M = 900.0, 560.0, 30.0, 40.0
# The lowest reading of the scale is at least this part of the highest.
_DYNAMIC = 1e-3
_CONTROLS = re.compile("[^\t\n\x20-\x7e\xa0-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")

_STYLE = """
body { font: 11pt/1.4 system-ui, sans-serif; color: #14181d; background: #fff; max-width: 62rem; margin: 1rem auto;
  padding: 0 1rem; }
h1 { font-size: 1.4rem; margin: 0; } h2 { font-size: 1.1rem; margin: 1.4rem 0 .4rem; }
p { margin: .3rem 0; } .quiet { color: #505a66; font-size: .9em; }
.totals { display: flex; gap: 2.5rem; margin: 1rem 0; } .totals b { display: block; font-size: 1.6rem; }
table { border-collapse: collapse; width: 100%; font-variant-numeric: tabular-nums; font-size: .92em; }
th, td { text-align: right; padding: .25rem .45rem; border-bottom: 1px solid #c6ccd4; vertical-align: top; }
th { color: #505a66; } td.text, th.text { text-align: left; overflow-wrap: anywhere; min-width: 8.5rem; }
svg { width: 100%; height: auto; border: 1px solid #c6ccd4; background: #f3f4f6; }
svg text { font: 12px system-ui, sans-serif; fill: #14181d; }
svg text.on { paint-order: stroke; stroke: #fff; stroke-width: 3px; font-weight: 700; }
p.warning { background: #fff6d9; padding: .4rem .6rem; }
.attention { list-style: none; padding: 0; margin: .8rem 0; } .attention li { padding: .35rem .6rem; margin: .2rem 0;
  border-left: .4rem solid; } li.alarm { background: #fbe3e0; border-color: #9b1c1c; font-size: 1.1rem; }
li.warning { background: #fff6d9; border-color: #8a6100; } li.note { background: #eef1f5; border-color: #505a66; }
td.alarm { background: #fbe3e0; font-weight: 700; } td.warning { background: #fff6d9; }
.notes { display: grid; grid-template-columns: repeat(auto-fill, minmax(13rem, 1fr)); gap: .6rem 2rem; }
.notes li { overflow-wrap: anywhere; break-inside: avoid; } .notes img { display: block; max-width: 100%;
  max-height: 11rem; }
@page { margin: 12mm; }
@media print { body { margin: 0; padding: 0; max-width: none; font-size: 9pt; } tr, thead, svg { break-inside: avoid; }
  th, td { padding: .15rem .3rem; } h2 { break-after: avoid; } svg { max-height: 160mm; }
  * { print-color-adjust: exact; -webkit-print-color-adjust: exact; } }
"""


class Drawing:
    """What the map shows, from the data one after the other."""

    def __init__(self) -> None:
        self.tracks: dict[int, Slots[Place]] = {}
        """By drone."""
        self.fields: dict[str, Field] = {}
        """Readings by unit; empty: unknown."""
        self.sources: dict[str, Any] | None = None
        """Where sources are, as of `located`."""
        self.places: dict[int, BasePlace | None] = {}
        """Where bases are."""
        self.levels: tuple[float, ...] = ()
        """Readings of the main unit along which there are lines, ascending."""
        self.spots: list[HotSpot] = []
        """Those of the main unit are on the map."""
        self.album = Album()
        self.notes: list[Note] = []
        """Photographs and lines, in the order of time."""
        self.first: float | None = None
        self.last: float | None = None
        """When the first and the last datum with a date were created, seconds since 1970."""

    def watch(self, entries: Iterable[Entry]) -> Iterator[Entry]:
        """Take the data on their way to another reader."""
        for entry in entries:
            if not entry.apart:
                self._take(entry)
            yield entry

    def _take(self, entry: Entry) -> None:
        self.album.take(entry)
        if entry.dated:
            self.first = entry.utc if self.first is None else min(self.first, entry.utc)
            self.last = entry.utc if self.last is None else max(self.last, entry.utc)
        if entry.whereabouts is not None:
            self.tracks.setdefault(entry.id.origin, Slots(MOST_PLACES)).put(entry.utc, entry.whereabouts)
        if entry.painted is not None:
            place, reading, unit = entry.painted
            if unit not in self.fields:
                self.fields[unit] = Field(place)
            self.fields[unit].add(place, reading)

    def place_of(self, entry: Entry) -> Place | None:
        """Where a datum was created that does not say so: where its drone was then."""
        if (base := self.places.get(entry.id.origin)) is not None:
            return base.place
        track = self.tracks.get(entry.id.origin)
        spot = None if track is None else track.at(entry.utc)
        return None if spot is None else spot[1]

    @property
    def main_unit(self) -> str | None:
        """The unit of most readings; None: there is none."""
        counts = {unit: sum(count for _, count in field.sums.values()) for unit, field in self.fields.items()}
        return max(counts, key=counts.__getitem__, default=None)


class Frame(NamedTuple):
    """How places become points of the map."""

    north: float
    west: float
    """Degrees."""
    scale: float
    """Units of the map for a metre."""
    metres: Place
    """In a degree to the south and to the east."""

    def point(self, place: Place) -> Place:
        """To the right and down, in units of the map."""
        # Across the 180th meridian too.
        east = (place[1] - self.west + 180.0) % 360.0 - 180.0
        south = self.north - place[0]
        return _EDGE + east * self.metres[1] * self.scale, _EDGE + south * self.metres[0] * self.scale


def write(archive: Data, out: Path, now: float, rules: Rules | None = None) -> tuple[Watch, dict[str, Any] | None]:
    """Write the report of a store to a file. Returns it, and where sources are (`located`). `now`: the date, seconds
    since 1970. `OSError`, `StoreError`."""
    drawing, samples = Drawing(), Samples()
    watch = Watch.of(archive, rules, samples.watch(drawing.watch(archive.entries())))
    drawing.sources = located(samples)
    drawing.places = watch.report.bases(watch.rules.base)
    drawing.levels = watch.rules.levels(drawing.main_unit or "")
    drawing.spots = watch.spots.highest()
    drawing.notes = enclosed(drawing.album, archive, drawing.place_of)
    plain = {**watch.plain(now, archive.date), "sources": drawing.sources}
    shown = watch.rows(now, archive.date)
    text = page(plain, shown, drawing, archive.title, [*archive.notes, *archive.remarks], now)
    out.write_text(text, encoding="utf-8")
    return watch, drawing.sources


def page(
    report: dict[str, Any], shown: Sequence[Row], drawing: Drawing, title: str, remarks: Iterable[str], now: float
) -> str:
    """The whole file. `report`: as of `Watch.plain`; `title`: the mission's name."""
    delay = report["delay_s"]
    period = ""
    if drawing.first is not None and drawing.last is not None:
        period = f"; data created from {_date(drawing.first)} to {_date(drawing.last)}"
    least = "created at least" if report["created_at_least"] else "created"
    totals = "".join(
        f"<div><b>{report[name]:,}</b>{least if name == 'created' else name}</div>"
        for name in ("created", "arrived", "missing", "lost")
    )
    body = [
        f"<h1>{_text(title)}</h1>",
        f'<p class="quiet">Report of the mission, as of {_date(now)}{period}. Times are in UTC.</p>',
        _attention(report, shown),
        *(f'<p class="warning">{_text(remark)}</p>' for remark in remarks),
        f'<div class="totals">{totals}</div>',
    ]
    if delay["p50"] is not None:
        body.append(f"<p>Half of the data arrived within {span(delay['p50'])}, 95 % within {span(delay['p95'])}.</p>")
    body += ["<h2>Map</h2>", *_map(drawing)]
    body += [f"<p>{line}</p>" for line in report["off_map"]]
    body += _hot_spots(report["hot_spots"])
    body += _sources(drawing.sources)
    body += _notes(drawing.notes)
    body += ["<h2>Drones</h2>", _drones(report["drones"])]
    body += [
        "<h2>Lost, by reason</h2>",
        _losses(report["drones"]),
        "<h2>Missing numbers</h2>",
        _missing(report["drones"]),
    ]
    head = (
        '<meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">'
        '<meta http-equiv="Content-Security-Policy" content="default-src \'none\'; img-src data:; '
        "style-src 'unsafe-inline'\">"
        f"<title>{_text(title)}: report of the mission</title><style>{_STYLE}</style>"
    )
    lines = "\n".join(body)
    return f'<!doctype html>\n<html lang="en"><head>{head}</head>\n<body>\n<main>\n{lines}\n</main>\n</body></html>\n'


def _attention(report: dict[str, Any], shown: Sequence[Row]) -> str:
    if not shown:
        return f"<p>Nothing needs attention: {_text(heard_text(report))}.</p>"
    items = "".join(
        f'<li class="{row.level.word}"><b>{row.level.name}</b> {_text(row.text)}. {_text(row.do)}</li>' for row in shown
    )
    return f'<ul class="attention" aria-label="What needs attention">{items}</ul>'


def _drones(drones: list[dict[str, Any]]) -> str:
    names = ("Drone", "Level", "Heard", "Battery", "Store", "Created", "Arrived", "Missing", "Lost")
    head = "".join(f'<th scope="col">{name}</th>' for name in names)
    rows = "".join(f"<tr>{''.join(_drone(drone))}</tr>\n" for drone in drones)
    note = (
        '<p class="quiet">Battery, and how full the store is: as of the last status. '
        "Created: a lower bound; a + marks a silent drone, which may have created more. "
        "Missing: in transit, or lost without a report. If it fails now: how many data would be lost, according to its "
        "last status and as of then. At most: all missing data created before that status. Or more: for some drones "
        "it is not known how many they had created by then. Newer data are unknown.</p>"
    )
    text = ("If it fails now", "Last position, highest reading")
    last = "".join(f'<th scope="col" class="text">{name}</th>' for name in text)
    return f"<table><thead><tr>{head}{last}</tr></thead>\n<tbody>{rows}</tbody></table>{note}"


def _drone(drone: dict[str, Any]) -> Iterator[str]:
    status, heard, named, highest = drone["status"], drone["heard"], drone["heard_by"], drone["highest"]
    base = " (base)" if (status is not None and status["base"]) or (named is not None and named["base"]) else ""
    level = f' class="{drone["attention"]}"' if drone["attention"] else ""
    yield f"<td{level}>{drone['drone']}{base}</td>"
    yield f"<td{level}>{drone['attention'] or ''}</td>"
    if named is not None:
        yield f"<td>by drone {named['drone']}; nothing has arrived</td>"
    else:
        yield f"<td>{'never' if heard is None else span(heard['age_s']) + ' ago'}</td>"
    yield f"<td>{'?' if status is None or status['battery'] is None else str(status['battery']) + ' %'}</td>"
    yield f"<td>{_store(status)}</td>"
    yield f"<td>{drone['created']:,}{'+' if drone['silent'] else ''}</td>"
    for name in ("arrived", "missing"):
        yield f"<td>{drone[name]:,}</td>"
    yield f"<td>{sum(drone['lost'].values()):,}{' or more' if drone['wounds'] else ''}</td>"
    yield "<td></td>" if base else f'<td class="text">{_text(risk_text(drone).partition(": ")[2])}</td>'
    words = ["no position yet" if drone["place"] is None else _place(drone["place"])]
    if highest is not None:
        where = "" if highest["place"] is None else f" at {_place(highest['place'])}"
        words.append(f"{_number(highest['reading'])} {UNIT_NAMES.get(highest['unit'], '')}".strip() + where)
    yield f'<td class="text">{_text("; ".join(words))}</td>'


def _store(status: dict[str, Any] | None) -> str:
    """How full a store was at the last status."""
    if status is None:
        return "?"
    held, free = status["held"], status["free"]
    if free is None or held + free == 0:
        return f"{held:,}, no limit" if free is None else "0 %"
    return f"{100 * held // (held + free)} %"


def _losses(drones: list[dict[str, Any]]) -> str:
    counts: dict[str, int] = {}
    for drone in drones:
        for reason, count in drone["lost"].items():
            counts[reason] = counts.get(reason, 0) + count
    lines = [f"{count:,} {_text(reason)}" for reason, count in counts.items()]
    for drone in drones:
        lines += [f"Drone {drone['drone']} {FAULT_TEXTS[fault]}" for fault in sorted(set(drone["wounds"]))]
    return "".join(f"<p>{line}.</p>" for line in lines or ["None reported"])


def _missing(drones: list[dict[str, Any]]) -> str:
    rows = []
    for drone in drones:
        ranges = drone["missing_numbers"]
        shown = [range_text(row) for row in ranges[-MOST_RANGES:]]
        if shown:
            more = f"; and {len(ranges) - len(shown)} or more earlier ranges" if len(ranges) > len(shown) else ""
            rows.append(f'<tr><td>{drone["drone"]}</td><td class="text">{", ".join(shown)}{more}</td></tr>\n')
    if not rows:
        return "<p>None.</p>"
    head = '<tr><th scope="col">Drone</th><th scope="col" class="text">Numbers</th></tr>'
    return f"<table><thead>{head}</thead><tbody>{''.join(rows)}</tbody></table>"


# -- the map -----------------------------------------------------------------------------------------------------------


def _map(drawing: Drawing) -> Iterator[str]:
    bases = {id: found for id, found in drawing.places.items() if found is not None}
    places = [place for track in drawing.tracks.values() for _, place in track]
    frame = _frame(places + [found.place for found in bases.values()])
    if frame is None:
        yield "<p>No position is known.</p>"
        return
    unit = drawing.main_unit
    field = None if unit is None else drawing.fields[unit]
    parts: list[str] = []
    notes: list[str] = []
    name = UNIT_NAMES.get(unit or "", "without a unit")
    if field is not None:
        squares, note = _squares(field, frame, name)
        parts += squares
        notes += [note] if note else []
        lines = contours_of(field, drawing.levels)
        parts += _lines(lines, frame)
        if lines:
            levels = ", ".join(_number(level) for level in sorted({one.level for one in lines}))
            notes.append(f"Lines: where readings are {levels} {escape(name)}. They end where nothing is drawn.")
    marks: dict[bool, list[str]] = {True: [], False: []}
    for id, base in sorted(bases.items()):
        guess = base.how == "guess"
        marks[guess] += _base(id, frame.point(base.place), guess=guess)
    # A guess covers no drone.
    parts += marks[True]
    for id, track in sorted(drawing.tracks.items()):
        parts += _track(id, [frame.point(place) for _, place in track], base=id in bases)
    parts += marks[False]
    parts += _spots([spot for spot in drawing.spots if spot.unit == unit], frame)
    parts += _regions(drawing.sources, frame)
    parts += _marks(drawing.notes, frame)
    parts += _bar(frame)
    title = "<title>The tracks and last positions of the drones, and the readings on the ground</title>"
    yield f'<svg viewBox="0 0 {_WIDTH:g} {_HEIGHT:g}" role="img">{title}{"".join(parts)}</svg>'
    yield from (f'<p class="quiet">{note}</p>' for note in notes)
    if len(drawing.fields) > 1:
        yield '<p class="quiet">Readings in other units are not on the map.</p>'


def _frame(places: list[Place]) -> Frame | None:
    """One with all places in it; None: there are none."""
    if not places:
        return None
    middle = places[0][1]
    longitudes = [(place[1] - middle + 180.0) % 360.0 - 180.0 for place in places]
    north, south = max(place[0] for place in places), min(place[0] for place in places)
    west, east = min(longitudes) + middle, max(longitudes) + middle
    metres = DEGREE_M, DEGREE_M * max(cos(radians((north + south) / 2)), 0.01)
    high, wide = max((north - south) * metres[0], _LEAST_M), max((east - west) * metres[1], _LEAST_M)
    scale = min((_WIDTH - 2 * _EDGE) / wide, (_HEIGHT - 2 * _EDGE) / high)
    # In the middle of what is left over.
    west -= ((_WIDTH - 2 * _EDGE) / scale - (east - west) * metres[1]) / 2 / metres[1]
    north += ((_HEIGHT - 2 * _EDGE) / scale - (north - south) * metres[0]) / 2 / metres[0]
    return Frame(north, west, scale, metres)


def _squares(field: Field, frame: Frame, unit: str) -> tuple[list[str], str]:
    """The readings, and what their colours mean."""
    painted = field.painted()
    high = max(square.reading for square in painted)
    positive = [square.reading for square in painted if square.reading > 0]
    if not positive:
        return [], ""
    low = max(min(positive), high * _DYNAMIC)
    side = field.grid.side_m * frame.scale
    parts = ['<g shape-rendering="crispEdges">']
    for square in painted:
        left, bottom = frame.point(field.grid.corner(square.row, square.column))
        part = log(max(square.reading, low) / low) / log(high / low) if high > low else 0.5
        parts.append(
            f'<rect x="{left:.2f}" y="{bottom - side:.2f}" width="{side:.2f}" height="{side:.2f}" '
            f'fill="{_colour(part)}" fill-opacity="{0.7 if square.readings else 0.5}"/>'
        )
    stops = "".join(
        f'<rect x="{10 + 8 * n}" y="10" width="8" height="10" fill="{_colour(n / 19)}"/>' for n in range(20)
    )
    parts.append(f'</g>{stops}<text x="10" y="36">{_number(low)} to {_number(high)} {escape(unit)}</text>')
    note = (
        f"Colours: means of the readings in squares of {field.grid.side_m:g} m, from violet (low) to yellow (high), on "
        "a logarithmic scale. Paler squares have no reading: they are interpolated from those at most "
        f"{field.reach_m:g} m away. Beyond that, nothing is drawn."
    )
    return parts, note


def _track(id: int, points: list[Place], *, base: bool) -> Iterator[str]:
    way = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
    yield f'<polyline points="{way}" fill="none" stroke="#3a5068" stroke-opacity="0.5"/>'
    if base:
        return
    x, y = points[-1]
    yield f'<circle cx="{x:.1f}" cy="{y:.1f}" r="10" fill="#fff" stroke="#14181d" stroke-width="1.5"/>'
    yield f'<text x="{x:.1f}" y="{y + 4:.1f}" text-anchor="middle">{id}</text>'


def _base(id: int, point: Place, *, guess: bool) -> Iterator[str]:
    """A square; dashed, with a question mark, and beside its place, where a drone was, if that is a guess."""
    x, y = point
    x -= 20 if guess else 0
    dashes = ' stroke-dasharray="3 3"' if guess else ""
    yield (
        f'<rect x="{x - 10:.1f}" y="{y - 10:.1f}" width="20" height="20" fill="#fff" stroke="#14181d" '
        f'stroke-width="1.5"{dashes}/>'
    )
    yield f'<text x="{x:.1f}" y="{y + 4:.1f}" text-anchor="middle">{id}{"?" if guess else ""}</text>'


def _lines(contours: Sequence[Contour], frame: Frame) -> Iterator[str]:
    """Contours, the higher the thicker; the longest line of each level says which one it is."""
    order = sorted({one.level for one in contours})
    labels: dict[float, Place] = {}
    for level, line in contours:
        points = [frame.point(place) for place in line]
        way = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
        width = 1 + 0.6 * order.index(level)
        yield f'<polyline points="{way}" fill="none" stroke="#fff" stroke-width="{width + 2:g}" stroke-opacity="0.7"/>'
        yield f'<polyline points="{way}" fill="none" stroke="#14181d" stroke-width="{width:g}"/>'
        # Of one level the longest comes first.
        labels.setdefault(level, min(points))
    # To the left: the names of hot spots are to the right.
    for level, (x, y) in labels.items():
        yield f'<text class="on" x="{x - 4:.1f}" y="{y + 4:.1f}" text-anchor="end">{_number(level)}</text>'


def _spots(spots: Sequence[HotSpot], frame: Frame) -> Iterator[str]:
    """Hot spots with their numbers in the list."""
    for number, spot in enumerate(spots, 1):
        x, y = frame.point(spot.place)
        yield f'<path d="M{x:.1f} {y - 8:.1f}l8 14h-16z" fill="#fff" stroke="#9b1c1c" stroke-width="2"/>'
        yield f'<text class="on" x="{x + 11:.1f}" y="{y + 6:.1f}">spot {number}</text>'


def _regions(found: dict[str, Any] | None, frame: Frame) -> Iterator[str]:
    """Where sources are: dashed if a region cannot be relied on."""
    for number, source in enumerate([] if found is None else found["sources"], 1):
        dashes = "" if source["resolved"] else ' stroke-dasharray="4 6"'
        for ring in source["region"]:
            corners = " ".join(f"{x:.1f},{y:.1f}" for x, y in map(frame.point, ring))
            yield f'<polygon points="{corners}" fill="none" stroke="#14181d" stroke-width="2"{dashes}/>'
        if source["resolved"]:
            x, y = frame.point(source["place"])
            yield f'<path d="M{x - 5:.1f} {y:.1f}h10M{x:.1f} {y - 5:.1f}v10" stroke="#14181d" stroke-width="2"/>'
            yield f'<text x="{x + 8:.1f}" y="{y - 8:.1f}">source {number}</text>'


def _marks(notes: Sequence[Note], frame: Frame) -> Iterator[str]:
    """Where photographs and lines are from, with their numbers in the list; those of one place have one mark."""
    by_place: dict[tuple[float, float], list[int]] = {}
    for number, note in enumerate(notes, 1):
        if note.about["place"] is not None:
            by_place.setdefault(tuple(note.about["place"]), []).append(number)
    for place, numbers in by_place.items():
        x, y = frame.point(place)
        if -_EDGE < x < _WIDTH + _EDGE and -_EDGE < y < _HEIGHT + _EDGE:
            text = f"note {', '.join(map(str, numbers[:3]))}{', …' if len(numbers) > 3 else ''}"
            yield f'<path d="M{x:.1f} {y - 6:.1f}l6 6l-6 6l-6 -6z" fill="#fff" stroke="#3b5bdb" stroke-width="2"/>'
            yield f'<text class="on" x="{x:.1f}" y="{y + 19:.1f}" text-anchor="middle">{text}</text>'


def _notes(notes: Sequence[Note]) -> list[str]:
    """The list; its numbers are those on the map."""
    if not notes:
        return []
    missing = sum(bool(note.why) for note in notes)
    items = "".join(f"<li>{_note(note)}</li>\n" for note in notes)
    said = f"{len(notes)}, in chronological order, numbered as on the map."
    if missing:
        said += f" {missing} photograph{'s are' if missing != 1 else ' is'} left out, each with the reason."
    return ["<h2>Photographs and lines</h2>", f"<p>{said}</p>", f'<ol class="notes">{items}</ol>']


def _note(note: Note) -> str:
    about = note.about
    where = "position unknown" if about["place"] is None else _place(tuple(about["place"]))
    said = f'<span class="quiet">drone {about["drone"]}, {_date(about["utc"])}, {where}</span>'
    if about["text"] is not None:
        return f"{_text(about['text'])}<br>{said}"
    name = _text(about["name"])
    if note.image:
        return f'{name}<br>{said}<img src="{note.image}" alt="{name}">'
    return f"{name}, {about['size']:,} bytes, left out: {_text(note.why)}<br>{said}"


def _hot_spots(spots: list[dict[str, Any]]) -> list[str]:
    lines = [_text(line.partition(". ")[2]) for line in spots_lines(spots)[1:]]
    if not lines:
        return []
    items = "".join(f"<li>{line}</li>" for line in lines)
    return ["<h2>Hot spots</h2>", f"<p>{len(lines)}, the highest first.</p>", f"<ol>{items}</ol>"]


def _sources(found: dict[str, Any] | None) -> list[str]:
    said = [_text(line.strip()) for line in sources_lines(found)]
    if not said:
        return []
    items = "".join(f"<li>{line}</li>" for line in said[1:])
    return ["<h2>Sources</h2>", f"<p>{said[0].removeprefix('sources: ')}.</p>", f"<ol>{items}</ol>"]


def _bar(frame: Frame) -> Iterator[str]:
    """A length of 1, 2 or 5 times a power of ten metres."""
    most = 200.0 / frame.scale
    power = 10.0 ** floor(log10(most))
    metres = next(n * power for n in (5, 2, 1) if n * power <= most)
    x, y = _WIDTH - 20.0, _HEIGHT - 14.0
    yield f'<path d="M{x - metres * frame.scale:.1f} {y}H{x}" stroke="#14181d" stroke-width="3"/>'
    text = f"{metres / 1000:g} km" if metres >= 1000 else f"{metres:g} m"
    yield f'<text x="{x}" y="{y - 8}" text-anchor="end">{text}</text>'


def _colour(part: float) -> str:
    """A colour between the steps of `COLOURS`, 0..1."""
    at = min(max(part, 0.0), 1.0) * (len(COLOURS) - 1)
    low = min(int(at), len(COLOURS) - 2)
    mixed = (round(a + (b - a) * (at - low)) for a, b in zip(COLOURS[low], COLOURS[low + 1], strict=True))
    return "#" + "".join(f"{value:02x}" for value in mixed)


# -- words -------------------------------------------------------------------------------------------------------------


def _text(text: str) -> str:
    """Untrusted text: escaped, and control characters shown."""
    return escape(_CONTROLS.sub("\ufffd", text))


def _number(value: float) -> str:
    return f"{value:,.0f}" if 1000 <= abs(value) < 1e7 else f"{value:.3g}"


def _place(place: Place) -> str:
    return f"{place[0]:.6f}, {place[1]:.6f}"


def _date(utc: float) -> str:
    return iso(utc)[:19].replace("T", " ")
