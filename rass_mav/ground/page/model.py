"""What the page shows of a mission: made from the data in a store, one after the other. Pure: no clock, no files.

All that it keeps is bounded. Times are seconds since 1970. Values for the page are plain, ready for JSON.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Mapping
from itertools import islice
from math import inf
from typing import Any

from rass_mav.core.datum import DatumId, Fate
from rass_mav.ground.album import Album
from rass_mav.ground.attention.watch import Rules, Watch
from rass_mav.ground.contours import contours_of, plain
from rass_mav.ground.entry import Entry, Place
from rass_mav.ground.field import Field, Painted
from rass_mav.ground.history import Arrivals, Reading, Readings, Slots
from rass_mav.ground.report import AtMost, BasePlace, Drone, Report
from rass_mav.ground.sources.readings import Samples
from rass_mav.wire.nodestatus import NodeStatus

#: Drones that are shown. Data of others, which can only be forged ids, are counted.
MOST_DRONES = 500
#: Of each drone: places, statuses, counts of its data, and readings that its panel draws.
MOST_PLACES, MOST_STATUSES, MOST_COUNTS, MOST_DRAWN = 400, 120, 300, 400
#: The mission began at most so long before its first datum arrived, seconds. An older age is not believed.
LEAD_S = 3600.0
# The median of the delays is reckoned again after so many more have come, as a part of them.
_MORE = 0.01

#: Latitude, longitude (degrees) and risk (0..1) at a place.
Spot = tuple[float, float, float]


class Story:
    """The history of a drone."""

    def __init__(self) -> None:
        self.places: Slots[Spot] = Slots(MOST_PLACES)
        """Where it was and how dangerous that was, by the time of creation."""
        self.statuses: Slots[NodeStatus] = Slots(MOST_STATUSES)
        """By the time of creation."""
        self.counts: Slots[tuple[int, int]] = Slots(MOST_COUNTS)
        """How many of its data had arrived, and how many it had created at least, by the time of arrival."""
        self.new: list[tuple[float, Spot]] = []
        """Places since the last look."""
        self.span_s = self.places.span_s
        """The length of a slot of `places` at the last look, seconds."""

    def take(self, entry: Entry, drone: Drone) -> None:
        """One of its data has arrived, and is in `drone` already."""
        utc, status, measurement = entry.utc, entry.status, entry.measurement
        place = entry.whereabouts
        risk = measurement.risk if measurement is not None else 0.0 if status is None else status.risk
        if place is not None and self.places.put(utc, spot := (*place, risk)):
            self.new.append((utc, spot))
        if status is not None:
            self.statuses.put(utc, status)
        self.counts.put(utc if entry.arrived is None else entry.arrived, (drone.arrived, drone.created))

    def changes(self) -> dict[str, Any] | None:
        """The places since the last look; None: there are none. `whole`: they are all that there are."""
        if not self.new:
            return None
        whole = self.places.span_s != self.span_s
        places = self.places.ordered if whole else self.new
        self.new, self.span_s = [], self.places.span_s
        return {"span_s": self.span_s, "whole": whole, "points": [_point(utc, spot) for utc, spot in places]}

    def plain(self) -> dict[str, Any]:
        """All places."""
        points = [_point(utc, spot) for utc, spot in self.places]
        return {"span_s": self.places.span_s, "whole": True, "points": points}


class Mission:
    """The state of a mission, as far as a store knows it."""

    def __init__(self) -> None:
        self.watch = Watch()
        self.stories: dict[int, Story] = {}
        """By node id."""
        self.readings = Readings()
        self.fields: dict[str, Field] = {}
        """By unit; empty: unknown."""
        self.samples = Samples()
        """Readings from which sources are located."""
        self.album = Album()
        """Photographs and lines that operators have put."""
        self._notes: list[dict[str, Any]] = []
        """Those that the browsers have."""
        self.arrivals = Arrivals()
        self.begin, self.end = inf, -inf
        """The first and the last time that the page shows."""
        self.unlisted = 0
        """Data of drones that are not shown."""
        self.taken = 0
        """How many data have come, of all kinds."""
        self._sent: dict[int, dict[str, Any]] = {}
        self._sides: dict[str, float] = {}
        self._delay: tuple[int, dict[str, float | None]] = (0, {"p50": None, "p95": None})

    @property
    def report(self) -> Report:
        """What has become of the data."""
        return self.watch.report

    @property
    def rules(self) -> Rules:
        """Of what needs attention."""
        return self.watch.rules

    @rules.setter
    def rules(self, rules: Rules) -> None:
        self.watch.rules = rules

    # -- what comes in -------------------------------------------------------------------------------------------------

    def take(self, entries: Iterable[Entry]) -> int:
        """Data that have arrived, in the order of arrival. Returns how many."""
        count = 0
        for entry in entries:
            count += 1
            if not entry.apart and not self._shows(entry.id.origin):
                self.unlisted += 1
                continue
            self.watch.take((entry,))
            if not entry.apart:
                self._take(entry)
        self.taken += count
        return count

    def hear(self, losses: Iterable[tuple[DatumId, Fate]], at: float | None = None) -> bool:
        """All data that are known to be lost now. Returns whether any are new. `at`: as for a `Watch`."""
        return self.watch.hear((loss for loss in losses if self._shows(loss[0].origin)), at)

    def _shows(self, drone: int) -> bool:
        return drone in self.report.drones or len(self.report.drones) < MOST_DRONES

    def _take(self, entry: Entry) -> None:
        arrived = entry.arrived
        self.begin = min(self.begin, entry.utc if arrived is None else max(entry.utc, arrived - LEAD_S))
        self.end = max(self.end, entry.utc if arrived is None else arrived)
        if arrived is not None:
            self.arrivals.take(arrived, None if entry.at_least else max(0.0, arrived - entry.utc))
        drone = entry.id.origin
        self.stories.setdefault(drone, Story()).take(entry, self.report.drone(drone))
        self.album.take(entry)
        if entry.painted is None:
            return
        place, reading, unit = entry.painted
        self.readings.take(Reading(entry.utc, drone, *place, reading, unit))
        self.samples.take(entry)
        if unit not in self.fields:
            self.fields[unit] = Field(place)
        self.fields[unit].add(place, reading)

    # -- for the page --------------------------------------------------------------------------------------------------

    def snapshot(self) -> dict[str, Any]:
        """All that the page shows."""
        return {
            **self._frame(),
            "notes": self._listed_notes(),
            "drones": self._drones(),
            "tracks": {str(id): story.plain() for id, story in self.stories.items()},
            "fields": {unit: _field(field, field.painted(), whole=True) for unit, field in self.fields.items()},
        }

    def changes(self) -> dict[str, Any]:
        """The same, but of drones, tracks and fields only what has changed since the last call."""
        drones = [figures for figures in self._drones() if self._sent.get(figures["drone"]) != figures]
        self._sent.update((figures["drone"], figures) for figures in drones)
        tracks = {str(id): track for id, story in self.stories.items() if (track := story.changes()) is not None}
        fields = {}
        for unit, field in self.fields.items():
            if painted := field.changes():
                whole = self._sides.get(unit) != field.grid.side_m
                self._sides[unit] = field.grid.side_m
                fields[unit] = _field(field, painted, whole=whole)
        found = {**self._frame(), "drones": drones, "tracks": tracks, "fields": fields}
        if (notes := self._listed_notes()) != self._notes:
            self._notes = found["notes"] = notes
        return found

    def _listed_notes(self) -> list[dict[str, Any]]:
        """Photographs and lines. What does not say where it was made was made where its drone was then."""
        bases = self.report.bases(self.rules.base)

        def place_of(entry: Entry) -> Place | None:
            if (base := bases.get(entry.id.origin)) is not None:
                return base.place
            spot = self.stories[entry.id.origin].places.at(entry.utc)
            return None if spot is None else spot[1][:2]

        return self.album.plain(place_of)

    def at(self, time: float) -> dict[str, Any]:
        """The state at an earlier time. Places, statuses and readings are of data that were created by then, counts
        of data that had arrived. When data were lost is not known, so what had not arrived includes them."""
        highest: dict[int, Reading] = {}
        fields: dict[str, Field] = {}
        for reading in self.readings.until(time):
            known = highest.get(reading.drone)
            if known is None or reading.value > known.value:
                highest[reading.drone] = reading
            if reading.unit not in fields:
                now = self.fields[reading.unit]
                fields[reading.unit] = Field(now.grid.origin, now.grid.side_m)
            fields[reading.unit].add((reading.latitude, reading.longitude), reading.value)
        bases = self.report.bases(self.rules.base)
        stories = {**{id: Story() for id in bases}, **self.stories}
        drones = [_past(id, story, time, highest.get(id), bases) for id, story in sorted(stories.items())]
        drones = [drone for drone in drones if drone["heard"] is not None or drone["created"] or drone["place"]]
        figures = ("created", "arrived", "missing")
        return {
            "at": time,
            "totals": {**{name: sum(drone[name] for drone in drones) for name in figures}, "lost": None},
            "drones": drones,
            "fields": {unit: _field(field, field.painted(), whole=True) for unit, field in fields.items()},
            "contours": self._contours(fields),
        }

    def contours(self) -> dict[str, Any]:
        """Lines of equal readings, by unit: their levels, and the lines. Takes longer than other figures."""
        return self._contours(self.fields)

    def _contours(self, fields: Mapping[str, Field]) -> dict[str, Any]:
        return {
            unit: {"levels": levels, "lines": plain(contours_of(field, levels))}
            for unit, field in fields.items()
            if (levels := self.rules.levels(unit))
        }

    def drone(self, id: int) -> dict[str, Any] | None:
        """What only the panel of a drone shows; None: it is not known."""
        found = self.report.drones.get(id) or (Drone(id) if id in self.report.unheard else None)
        if found is None:
            return None
        return {
            "drone": id,
            "kinds": dict(found.kinds),
            "missing_numbers": found.missing_numbers,
            "readings": self.drawn([id])[id],
        }

    def drawn(self, drones: Collection[int]) -> dict[int, dict[str, Any]]:
        """What charts draw of some drones: for each, by unit, times and readings, at most `MOST_DRAWN`."""
        found: dict[int, dict[str, Slots[float]]] = {id: {} for id in drones}
        for reading in self.readings.of(found):
            found[reading.drone].setdefault(reading.unit, Slots(MOST_DRAWN)).put(reading.utc, reading.value)
        return {
            id: {
                unit: {"utc": [round(utc, 1) for utc, _ in slots], "value": [value for _, value in slots]}
                for unit, slots in by_unit.items()
            }
            for id, by_unit in found.items()
        }

    def _frame(self) -> dict[str, Any]:
        drones = self.report.drones.values()
        lost = Counter[str]()
        for drone in drones:
            lost.update({fate.value: count for fate, count in drone.lost.items()})
        known = self.begin <= self.end
        return {
            "begin": round(self.begin, 3) if known else None,
            "end": round(self.end, 3) if known else None,
            "totals": {
                "created": sum(drone.created for drone in drones),
                "arrived": sum(drone.arrived for drone in drones),
                "missing": sum(drone.missing for drone in drones),
                "lost": lost.total(),
            },
            "lost": dict(lost),
            "unheard": self._unheard(),
            "off_map": self.report.off_map(self.rules.base),
            "above": self.rules.above,
            "hot_spots": [spot.plain() for spot in self.watch.spots.highest()],
            "apart": self.report.apart,
            "unlisted": self.unlisted,
            "thinned": self.readings.every,
            "delay_s": self._delays(),
            "arrivals": self.arrivals.plain(),
        }

    def _delays(self) -> dict[str, float | None]:
        """They are sorted, which takes long where there are many."""
        count = len(self.report.delays)
        if not self._delay[0] <= count <= self._delay[0] * (1 + _MORE):
            delays = {name: self.report.delay(part) for name, part in (("p50", 0.5), ("p95", 0.95))}
            self._delay = count, {name: None if s is None else round(s, 3) for name, s in delays.items()}
        return self._delay[1]

    def _drones(self) -> list[dict[str, Any]]:
        bounds, bases = self.report.at_most(), self.report.bases(self.rules.base)
        return [self._figures(drone, bounds.get(drone.id), bases) for _, drone in sorted(self.report.drones.items())]

    def _unheard(self) -> list[dict[str, Any]]:
        """Drones of which nothing has arrived, and that others hear; and the base of the configuration, if nothing has
        arrived from it. All of them each time: they may be gone again."""
        # If some drones are not shown, data of these may have arrived.
        left = MOST_DRONES - len(self.report.drones)
        known, bases = self.report.listed, self.report.bases(self.rules.base)
        silent = [Drone(id) for id in bases.keys() - {drone.id for drone in known}]
        unheard = islice((drone for drone in known if drone.id not in self.report.drones), left)
        return [self._figures(drone, None, bases) for drone in (*silent, *unheard)]

    def _figures(self, drone: Drone, bound: AtMost | None, bases: Mapping[int, BasePlace | None]) -> dict[str, Any]:
        story = self.stories.get(drone.id)
        last = None if story is None else story.places.latest
        highest, naming = drone.highest, self.report.unheard.get(drone.id)
        status, latest = drone.status, drone.last_status
        state = _state(last, None if status is None or latest is None else (latest.utc, status))
        if naming is not None:
            state |= {"heard_by": [naming.id.origin, round(naming.utc, 1)]}
        state |= _as_base(drone.id, bases)
        return {
            "drone": drone.id,
            "created": drone.created,
            "arrived": drone.arrived,
            "missing": drone.missing,
            "lost": {fate.value: count for fate, count in drone.lost.items()},
            "store_faults": sorted({fate.value for fate in drone.store_faults}),
            "heard": None if drone.heard is None else round(drone.heard.utc, 1),
            **state,
            "at_risk": self.report.at_risk(drone.id),
            "at_most": None if bound is None else list(bound),
            "highest": None
            if highest is None or highest.measurement is None
            else _highest(highest.utc, highest.reading or 0.0, highest.measurement.unit or "", highest.place),
        }


def _as_base(id: int, bases: Mapping[int, BasePlace | None]) -> dict[str, Any]:
    """What is different for a base: where it is, and how that is known. Where its autopilot says so, it is a place as
    that of a drone."""
    if id not in bases:
        return {}
    found = bases[id]
    if found is None or found.how == "heard":
        return {"base": True, "how": None if found is None else found.how}
    return {"base": True, "how": found.how, "place": [round(part, 7) for part in found.place], "placed": None}


def _past(
    id: int, story: Story, time: float, highest: Reading | None, bases: Mapping[int, BasePlace | None]
) -> dict[str, Any]:
    """The figures of a drone at an earlier time."""
    place, status, counts = story.places.at(time), story.statuses.at(time), story.counts.at(time)
    arrived, created = (0, 0) if counts is None else counts[1]
    heard = max((utc for utc, _ in filter(None, (place, status))), default=None)
    return {
        "drone": id,
        "created": created,
        "arrived": arrived,
        "missing": created - arrived,
        "lost": None,
        "store_faults": [],
        "heard": None if heard is None else round(heard, 1),
        **_state(place, status),
        **_as_base(id, bases),
        "at_risk": None if status is None else status[1].alone,
        "at_most": None,
        "highest": None
        if highest is None
        else _highest(highest.utc, highest.value, highest.unit, (highest.latitude, highest.longitude)),
    }


def _point(utc: float, spot: Spot) -> list[float]:
    return [round(utc, 1), round(spot[0], 6), round(spot[1], 6)]


def _state(spot: tuple[float, Spot] | None, latest: tuple[float, NodeStatus] | None) -> dict[str, Any]:
    """Where a drone was last, and its latest status, each with its time."""
    state: dict[str, Any] = {"place": None, "placed": None, "risk": None, "status_utc": None}
    if latest is not None:
        since, status = latest
        state |= {
            "status_utc": round(since, 1),
            "risk": round(status.risk, 4),
            "held": status.held,
            "alone": status.alone,
            "replicas": status.spares,
            "free": status.free,
            "hops": status.hops,
            "battery": status.battery,
            "base": status.base,
            "next_hop": status.next_hop,
            "neighbours": [[id, round(quality, 2)] for id, quality in status.neighbours.items()],
        }
    if spot is not None:
        utc, (latitude, longitude, risk) = spot
        state |= {"place": [round(latitude, 7), round(longitude, 7)], "placed": round(utc, 1)}
        if latest is None or utc >= latest[0]:
            state["risk"] = round(risk, 4)
    return state


def _highest(utc: float, reading: float, unit: str, place: Place | None) -> dict[str, Any]:
    return {"utc": round(utc, 1), "reading": reading, "unit": unit, "place": None if place is None else list(place)}


def _field(field: Field, painted: list[Painted], *, whole: bool) -> dict[str, Any]:
    """`whole`: these are all squares, and others of the browser are outdated."""
    height, width = field.grid.step
    return {
        "whole": whole,
        "origin": list(field.grid.origin),
        "step": [height, width],
        "side_m": field.grid.side_m,
        "reach_m": field.reach_m,
        "squares": [[p.row, p.column, float(f"{p.reading:.4g}"), p.readings] for p in painted],
    }
