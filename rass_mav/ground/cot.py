"""Cursor on Target (CoT) 2.0, as the clients and servers of TAK take it: the drones, bases, hot spots and contours of a
mission as events.

The types are those of MIL-STD-2525 as MITRE's list of CoT types has them, and of the drawings of ATAK (its `takcot`).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from html import escape
from math import inf
from time import perf_counter
from typing import NamedTuple

from rass_mav.core.datum import DatumId, Fate

from .attention.conditions import reading_text
from .attention.watch import Rules, Watch
from .contours import Contour, contours_of
from .entry import Entry, Place, iso
from .field import Field
from .formats.kml import text_of
from .hotspots import HotSpot
from .report import Drone

#: A friendly rotary-wing drone; a friendly telecommunications facility; a spot on a map; a free drawing; a deletion.
DRONE, BASE, SPOT, LINE, DELETION = "a-f-A-M-H-Q", "a-f-G-I-U-T", "b-m-p-s-m", "u-d-f", "t-x-d-d"
#: A place of a node that is older is not sent, and what a client has is out of date after so long, seconds.
STALE_S = 300.0
#: Nodes, contours, and points of a contour that are sent, at most: an event fits a UDP datagram.
MOST_NODES, MOST_LINES, MOST_POINTS = 500, 60, 200
#: Seconds between two times that contours are drawn, at least and at most.
LEAST_DRAWN_S, MOST_DRAWN_S = 0.9, 60.0
# What is not known of a point, metres.
_UNKNOWN = "9999999.0"
_RED, _WHITE = -65536, -1
# Of contours, as signed 32-bit ARGB, from the lowest level to the highest; the last is that of all higher ones.
_COLOURS = tuple(rgb - (1 << 24) for rgb in (0x21918C, 0x5EC962, 0xFDE725, 0xFF8C00, 0xFF0000))


class Event(NamedTuple):
    """An event. Two that are equal show the same."""

    uid: str
    type: str
    how: str
    """m-g: measured, by GPS; m-p: computed."""
    place: Place
    detail: str
    """The contents of `detail`, XML."""
    error_m: float | None = None
    """The place is at most this far from the true one; None: nobody knows how far."""
    start: float | None = None
    """When it was so, seconds since 1970; None: it is so now."""

    def xml(self, now: float) -> bytes:
        """The event as it is sent. `now`: seconds since 1970. Altitudes are left out: CoT means heights above the
        ellipsoid, which differ from those above mean sea level by up to 110 m."""
        start = now if self.start is None else min(self.start, now)
        latitude, longitude = self.place
        return (
            f'<?xml version="1.0" encoding="UTF-8"?>'
            f'<event version="2.0" uid="{self.uid}" type="{self.type}" how="{self.how}" time="{iso(now)}" '
            f'start="{iso(start)}" stale="{iso(start + STALE_S)}">'
            f'<point lat="{latitude:.7f}" lon="{_within(longitude):.7f}" hae="{_UNKNOWN}" '
            f'ce="{_UNKNOWN if self.error_m is None else f"{self.error_m:.1f}"}" le="{_UNKNOWN}"/>'
            f"<detail>{self.detail}</detail></event>"
        ).encode()


def deletion(uid: str) -> Event:
    """Takes an event off the maps of the clients."""
    link = f'<link uid="{uid}" relation="none" type="none"/><__forcedelete/>'
    return Event(f"{uid}-deletion", DELETION, "m-p", (0.0, 0.0), link)


class Picture:
    """What a mission shows on a map of TAK. Takes the data of a store in the order of arrival."""

    def __init__(self, base: int) -> None:
        """`base`: the node id of the base that sends it."""
        self.watch = Watch()
        self._base = base
        self._measured: dict[int, Entry] = {}
        self._fields: dict[str, Field] = {}
        self._painted = 0
        """Readings in the fields."""
        self._drawn: tuple[object, list[Event]] = None, []
        self._draw_due = -inf

    @property
    def rules(self) -> Rules:
        """Of the list of what needs attention."""
        return self.watch.rules

    @rules.setter
    def rules(self, rules: Rules) -> None:
        self.watch.rules = rules

    def take(self, entries: Iterable[Entry]) -> int:
        """Data that have arrived. Returns how many."""
        return self.watch.take(self._noted(entries))

    def hear(self, losses: Iterable[tuple[DatumId, Fate]], at: float | None = None) -> bool:
        """All data that are known to be lost now."""
        return self.watch.hear(losses, at)

    def _noted(self, entries: Iterable[Entry]) -> Iterator[Entry]:
        for entry in entries:
            if entry.painted is not None:
                place, reading, unit = entry.painted
                if unit not in self._fields:
                    self._fields[unit] = Field(place)
                self._fields[unit].add(place, reading)
                self._painted += 1
                last = self._measured.get(entry.id.origin)
                if last is None or entry.utc >= last.utc:
                    self._measured[entry.id.origin] = entry
            yield entry

    # -- as events -----------------------------------------------------------------------------------------------------

    def events(self, now: float, shift_s: float = 0.0) -> Iterator[Event]:
        """All that the clients have to show now.

        :param now: seconds since 1970.
        :param shift_s: what to add to the times of data: their store may have had no date.
        """
        report = self.watch.report
        bases = report.bases(self.rules.base)
        for id, where in bases.items():
            if where is not None:
                remarks = {"set": "", "heard": "", "guess": "a guess: the position of this base is unknown"}[where.how]
                yield Event(uid_of(id), BASE, "m-g", where.place, _contact(f"base {id}") + _remarks(remarks))
        nodes = (drone for drone in report.listed if drone.id not in bases)
        for _, drone in zip(range(MOST_NODES), nodes, strict=False):
            event = self._drone(drone, shift_s)
            if event is not None and event.start is not None and now - event.start <= STALE_S:
                yield event
        for spot in self.watch.spots.highest():
            yield self._spot(spot)
        yield from self._contours(now)

    def _drone(self, drone: Drone, shift_s: float) -> Event | None:
        if drone.placed is None:
            return None
        utc, place = drone.placed
        last, status = self._measured.get(drone.id), drone.status
        said, error_m = [], None
        if last is not None and last.reading is not None and last.measurement is not None:
            said.append(reading_text(last.reading, last.measurement.unit))
            said.append(f"risk {last.measurement.risk:.2f}")
            error_m = last.measurement.error_m if last.place == place else None
        battery = ""
        if status is not None and status.battery is not None:
            battery = f'<status battery="{status.battery}"/>'
        detail = f"{battery}{_contact(f'drone {drone.id}')}{_remarks(', '.join(said))}"
        return Event(uid_of(drone.id), DRONE, "m-g", place, detail, error_m, utc + shift_s)

    def _spot(self, spot: HotSpot) -> Event:
        text = f"{reading_text(spot.reading, spot.unit)}, drone {spot.drone}"
        detail = (
            f"{_contact(reading_text(spot.reading, spot.unit))}{_remarks(f'hot spot: {text}')}"
            f'<color argb="{_RED}"/><usericon iconsetpath="COT_MAPPING_SPOTMAP/{SPOT}/{_RED}"/>'
        )
        return Event(f"rass-hot-spot-{spot.id.replace('#', '-')}", SPOT, "m-g", spot.place, detail)

    def _contours(self, now: float) -> list[Event]:
        """They are drawn again only when something has changed, and in at most half of the time."""
        state = self._painted, self.rules.above, self.rules.contours
        if state != self._drawn[0] and not now < self._draw_due < now + MOST_DRAWN_S:
            began = perf_counter()
            found = [
                event
                for unit, field in self._fields.items()
                for event in self._lines(unit, contours_of(field, self.rules.levels(unit)))
            ]
            self._drawn = state, found[:MOST_LINES]
            self._draw_due = now + min(max(LEAST_DRAWN_S, perf_counter() - began), MOST_DRAWN_S)
        return self._drawn[1]

    def _lines(self, unit: str, contours: Iterable[Contour]) -> Iterator[Event]:
        numbers: dict[float, int] = {}
        for contour in contours:
            numbers[contour.level] = number = numbers.get(contour.level, 0) + 1
            uid = f"{uid_of(self._base)}-contour-{unit or 'unknown'}-{contour.level:g}-{number}"
            colour = _COLOURS[min(len(numbers), len(_COLOURS)) - 1]
            name = reading_text(contour.level, unit)
            links = "".join(f'<link point="{lat:.7f},{_within(lon):.7f}"/>' for lat, lon in _thinned(contour.line))
            detail = (
                f'{links}<strokeColor value="{colour}"/><strokeWeight value="3.0"/><fillColor value="0"/>'
                f"{_contact(name)}{_remarks(f'along this line {name}')}"
                f'<archive/><labels_on value="false"/><color value="{_WHITE}"/><precisionlocation altsrc="???"/>'
            )
            yield Event(uid, LINE, "m-p", contour.line[0], detail)


def uid_of(id: int) -> str:
    """Of a node: the same at all bases."""
    return f"rass-{id}"


def _contact(callsign: str) -> str:
    return f'<contact callsign="{escape(text_of(callsign), quote=True)}"/>'


def _remarks(text: str) -> str:
    return f"<remarks>{text_of(text)}</remarks>"


def _within(longitude: float) -> float:
    """A longitude within -180 to 180 degrees."""
    return (longitude + 180.0) % 360.0 - 180.0


def _thinned(line: list[Place]) -> list[Place]:
    """Its ends, and as many points between them as fit."""
    every = -(-len(line) // (MOST_POINTS - 1))
    return line[::every] if (len(line) - 1) % every == 0 else [*line[::every], line[-1]]
