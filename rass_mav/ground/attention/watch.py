"""The conditions that the data in a store show, and when they began and ended.

Everything follows from what has arrived. So a base that was restarted, or a page that is opened later, comes to the
same list with the same times.
"""

from __future__ import annotations

from collections import Counter, defaultdict, deque
from collections.abc import Collection, Iterable, Iterator
from heapq import heappop, heappush
from math import inf, isinf
from typing import Any, NamedTuple

from rass_mav.app.clock import DateNote
from rass_mav.core.datum import DatumId, Fate
from rass_mav.ground.contours import levels_of
from rass_mav.ground.entry import Data, Entry, Place, iso
from rass_mav.ground.hotspots import HotSpots, is_high
from rass_mav.ground.report import MOST_NAMES, Drone, Report, lost_text, span
from rass_mav.wire.nodestatus import NodeStatus

from .conditions import (
    MOST_LISTED,
    Condition,
    Event,
    Row,
    condition,
    in_order,
    marks,
    place_text,
    reading_text,
    rows,
)

#: A drone is silent when its newest datum is older than so many times what is usual between two signs of it, and than
#: `LEAST_SILENT_S`; and than `SILENT_S` while too few signs show what is usual. Seconds.
SILENT_GAPS = 5
LEAST_SILENT_S = 60.0
SILENT_S = 180.0
#: So many of the last gaps show what is usual, their median; fewer than the second do not.
_GAPS, _FEW_GAPS = 31, 5
#: A store that is full within this time at the present rate fills up, seconds. The rate is that of so many statuses, of
#: fewer and in less than a minute there is none.
FILLS_S = 1800.0
_RATES, _FEW_RATES = 8, 3
#: After a change of the base's link key, drones have this time to get it, seconds.
KEY_S = 120.0
#: A hot spot is new for so long, seconds.
NEW_SPOT_S = 600.0
#: So many data of a drone that went its usual way for so long, and are with nobody, make their forwarder suspect.
SUSPECT_DATA, SUSPECT_S = 20, 300.0
#: A base that has written nothing for so long does not run, seconds: it notes its time every minute.
STOPPED_S = 180.0
#: Events that are kept of each drone, the latest.
MOST_EVENTS = 50
# Data that come within so many seconds of each other are one batch.
_BATCH_S = 5.0
#: Nothing is known about the time of a store's node.
NO_NOTE = DateNote(inf, 0.0, True)


class Rules(NamedTuple):
    """What the data do not tell."""

    above: float | None = None
    """A reading above this is high, in its own unit; None: as of `is_high`."""
    revoked: frozenset[int] = frozenset()
    """Drones whose keys the ground has revoked."""
    contours: tuple[float, ...] | None = None
    """Readings along which maps have lines, besides `above`, in their own unit; None: the usual ones."""
    base: tuple[int, Place | None] | None = None
    """The node id of the base, and its place if that is set; None: nobody says which one it is."""

    def levels(self, unit: str) -> tuple[float, ...]:
        """The readings of a unit along which maps have lines, ascending."""
        return levels_of(unit, self.contours, self.above)


class _Track:
    """What is kept of a drone besides `Drone`."""

    __slots__ = (
        "arrived",
        "expected",
        "free",
        "gaps",
        "had",
        "intervals",
        "key",
        "located",
        "measured",
        "open",
        "route",
        "status_utc",
    )  # fmt: skip

    def __init__(self) -> None:
        self.gaps: deque[float] = deque(maxlen=_GAPS)
        """How old its newest datum was when a newer one came, seconds."""
        self.intervals: deque[float] = deque(maxlen=_GAPS)
        """Seconds between its measurements."""
        self.arrived = -inf
        self.free: deque[tuple[float, int]] = deque(maxlen=_RATES)
        """Space for data in its last statuses, with their times."""
        self.had: set[str] = set()
        """What it has had: `position`, `sensor`."""
        self.located = self.status_utc = -inf
        """When what decides about its position, and its last status, were created."""
        self.measured: Entry | None = None
        self.key: tuple[int, float] | None = None
        """The number of its link key, and since when."""
        self.route: tuple[int, float, int] | None = None
        """The next hop of its data, since when, and how many data were missing and not with it then."""
        self.open: dict[str, Condition] = {}
        """What holds now, by kind."""
        self.expected = inf
        """When it is looked at again, because something newer has to come by then."""

    @property
    def silent_after_s(self) -> float:
        """It is silent when its newest datum is older."""
        return silent_after(self.gaps)


def silent_after(gaps: Collection[float]) -> float:
    """After so many seconds without a sign, if these were usual."""
    return SILENT_S if len(gaps) < _FEW_GAPS else max(LEAST_SILENT_S, SILENT_GAPS * _median(gaps))


class Watch:
    """The report of a mission, what of it needs attention, and what needed it before.

    Takes the data of a store in the order of arrival. So a base that was restarted, or a page that is opened later,
    comes to the same list with the same times.
    """

    def __init__(self) -> None:
        self.report = Report()
        self.rules = Rules()
        """They may change meanwhile."""
        self._tracks: defaultdict[int, _Track] = defaultdict(_Track)
        self._events: defaultdict[int | None, deque[Event]] = defaultdict(lambda: deque(maxlen=MOST_EVENTS))
        self.counted = 0
        """Events so far: whether there are new ones."""
        self._silences: list[tuple[float, int]] = []
        """A heap: when a drone is silent if nothing comes."""
        self.spots = HotSpots()
        self._held: dict[int, int] = {}
        """Data in custody by drone, as their statuses say."""
        self._held_sum = 0
        self._suspecting: defaultdict[int, dict[int, int]] = defaultdict(dict)
        """By forwarder: whose data do not arrive, and how many."""
        self._apart: Counter[int] = Counter()
        self._lost: set[tuple[DatumId, Fate]] = set()
        self._base_key: tuple[int, float] | None = None
        """The highest link key that a base had, and since when."""

    @classmethod
    def of(cls, archive: Data, rules: Rules | None = None, entries: Iterable[Entry] | None = None) -> Watch:
        """Of all that a store or a database holds. `entries`: those of it, if somebody else looks at them too."""
        watch = cls()
        watch.rules = Rules() if rules is None else rules
        watch.take(archive.entries() if entries is None else entries)
        watch.hear(archive.losses())
        return watch

    # -- what comes in -------------------------------------------------------------------------------------------------

    def take(self, entries: Iterable[Entry]) -> int:
        """Data that have arrived, in the order of arrival; second contents of ids too. Returns how many."""
        count = 0
        for entry in entries:
            count += 1
            at = entry.utc if entry.arrived is None else entry.arrived
            if not entry.apart:
                # A batch of old data is no silence.
                self._pass(at - _BATCH_S)
            before = self.report.drones.get(entry.id.origin)
            heard = None if before is None or before.heard is None else before.heard.utc
            self.report.take((entry,))
            if entry.apart:
                self._apart[entry.id.origin] += 1
                kept = self._apart[entry.id.origin]
                self._set("two contents", entry.id.origin, at, at, f"{kept:,} of them")
            else:
                self._take(entry, self._tracks[entry.id.origin], heard, at)
        return count

    def hear(self, losses: Iterable[tuple[DatumId, Fate]], at: float | None = None) -> bool:
        """All data that are known to be lost now. Returns whether any are new.

        `at`: the date, seconds since 1970; None: nobody knows since when they are lost."""
        origins = set()
        for loss in losses:
            if loss not in self._lost:
                self._lost.add(loss)
                self.report.hear((loss,))
                origins.add(loss[0].origin)
        for id in origins:
            self._tell_losses(self.report.drones[id], at)
        return bool(origins)

    def _tell_losses(self, drone: Drone, at: float | None) -> None:
        if drone.lost:
            self._set("lost", drone.id, None, at, lost_text(drone.lost))
        else:
            self._clear("lost", drone.id, at)
        for fault in set(drone.store_faults):
            self._set(fault.value, drone.id, None, at)

    def _take(self, entry: Entry, track: _Track, heard: float | None, at: float) -> None:
        drone = self.report.drones[entry.id.origin]
        if heard is not None and entry.utc > heard and at > track.arrived:
            track.gaps.append(max(0.0, at - heard))
        track.arrived = max(track.arrived, at)
        if heard is None or entry.utc > heard:
            self._clear("silent", drone.id, at)
            self._expect(drone.id, track, entry.utc + track.silent_after_s)
            self._hold("ages", drone.id, entry.at_least, entry.utc, at)
            if entry.status is None:
                # It was created after the last status, and has found a route.
                self._clear("no route", drone.id, at)
        if "lost" in track.open:
            self._tell_losses(drone, at)
        if (spot := self.spots.take(entry, self.rules.above)) is not None:
            self._clear("hot spot", drone.id, at)
            self._set("hot spot", drone.id, at, at, spot.text)
        if entry.measurement is not None and (track.measured is None or entry.utc >= track.measured.utc):
            self._measured(entry, track, at)
        if entry.status is not None and entry.utc >= track.status_utc:
            track.status_utc = entry.utc
            self._told(entry, entry.status, track, at)

    def _measured(self, entry: Entry, track: _Track, at: float) -> None:
        m, id = entry.measurement, entry.id.origin
        assert m is not None
        if track.measured is not None:
            track.intervals.append(entry.utc - track.measured.utc)
        track.measured = entry
        # The places that programs state have no known error, and say nothing about the vehicle's position.
        if entry.place is None or m.error_m is not None:
            self._locate(entry, track, entry.place is not None or m.local is not None, at)
        reading = entry.reading
        if reading is not None:
            track.had.add("sensor")
        self._hold("sensor", id, reading is None and "sensor" in track.had, entry.utc, at)
        high = is_high(entry, self.rules.above)
        text = "" if reading is None else reading_text(reading, m.unit)
        where = "" if entry.place is None else f" at {place_text(entry.place)}"
        self._hold("reading", id, high, entry.utc, at, text + where)

    def _locate(self, entry: Entry, track: _Track, there: bool, at: float) -> None:
        """Whether a datum has a position."""
        if entry.utc < track.located:
            return
        track.located = entry.utc
        if there:
            track.had.add("position")
        self._hold("position", entry.id.origin, not there and "position" in track.had, entry.utc, at)

    def _told(self, entry: Entry, status: NodeStatus, track: _Track, at: float) -> None:
        """A status that is newer than all before."""
        id, utc = entry.id.origin, entry.utc
        if status.link_key is not None and (track.key is None or track.key[0] != status.link_key):
            track.key = status.link_key, utc
            if status.base and (self._base_key is None or status.link_key > self._base_key[0]):
                self._base_key = track.key
        if status.base:
            return
        if status.place is not None:
            self._locate(entry, track, True, at)
        newest = self.report.drones[id].heard is entry
        self._hold("no route", id, status.hops is None and newest, utc, at)
        self._fills(id, status.free, track, utc, at)
        self._look_at_key(id, track, utc, at)
        self._look_for_measurements(entry, track, at)
        self._held_sum += status.held - self._held.get(id, 0)
        self._held[id] = status.held
        self._follow_route(entry, status, track, at)

    def _fills(self, id: int, free: int | None, track: _Track, utc: float, at: float) -> None:
        if free is None:
            track.free.clear()
        else:
            track.free.append((utc, free))
        full_at = _full_at(track.free)
        self._hold("filling", id, bool(free) and full_at is not None and full_at - utc <= FILLS_S, utc, at)
        self._hold("full", id, free == 0, utc, at)

    def _look_at_key(self, id: int, track: _Track, utc: float, at: float) -> None:
        newest, since = self._base_key or (0, -inf)
        behind = track.key is not None and track.key[0] < newest and utc > since + KEY_S
        text = "" if track.key is None else f"{track.key[0]}, the base has {newest}"
        self._hold("link key", id, behind and id not in self.rules.revoked, utc, at, text)

    def _look_for_measurements(self, entry: Entry, track: _Track, at: float) -> None:
        """A drone without a position and a reading measures nothing, and goes on with its statuses."""
        last = track.measured
        if last is None or last.id.epoch != entry.id.epoch or len(track.intervals) < _FEW_GAPS:
            return
        numbers = self.report.drones[entry.id.origin].epochs[entry.id.epoch]
        between = last.id.sequence + 1, entry.id.sequence
        # What is on its way may be measurements.
        whole = between[0] >= between[1] or numbers.arrived.holds(*between)
        late = entry.utc - last.utc > max(LEAST_SILENT_S, SILENT_GAPS * _median(track.intervals))
        if whole and late:
            self._hold("sensor", entry.id.origin, "sensor" in track.had, last.utc, at)

    def _follow_route(self, entry: Entry, status: NodeStatus, track: _Track, at: float) -> None:
        """Data that a drone handed on, that do not arrive, and that no drone says to have: their forwarder has them."""
        id, hop = entry.id.origin, status.next_hop
        numbers = self.report.drones[id].epochs[entry.id.epoch]
        away = max(0, numbers.missing_below(entry.id.sequence) - self._held_sum)
        before = track.route
        if before is None or before[0] != hop:
            if before is not None:
                self._suspect(before[0], id, 0, entry.utc, at)
            track.route = None if hop is None else (hop, entry.utc, away)
        elif not self.report.is_base(before[0]):
            grown = away - before[2]
            found = grown >= SUSPECT_DATA and entry.utc - before[1] >= SUSPECT_S
            self._suspect(before[0], id, grown if found else 0, before[1], at)

    def _suspect(self, forwarder: int, origin: int, count: int, since: float, at: float) -> None:
        by = self._suspecting[forwarder]
        if count:
            by[origin] = count
        else:
            by.pop(origin, None)
        if not by:
            del self._suspecting[forwarder]
        text = f"{sum(by.values()):,} of drone{'s' if len(by) > 1 else ''} {_named(sorted(by))}"
        self._hold("forwarder", forwarder, bool(by), since, at, text)

    # -- time passes ---------------------------------------------------------------------------------------------------

    def _pass(self, now: float) -> None:
        """Drones whose time is over are silent."""
        while self._silences and self._silences[0][0] <= now:
            expected, id = heappop(self._silences)
            track, heard = self._tracks[id], self.report.drones[id].heard
            if expected != track.expected:
                continue
            track.expected = inf
            if heard is None or self.report.is_base(id):
                continue
            due = heard.utc + track.silent_after_s
            if due > now:
                self._expect(id, track, due)
            else:
                self._set("silent", id, heard.utc, max(due, track.arrived))

    def _expect(self, id: int, track: _Track, due: float) -> None:
        """By then something has to come. If that is later than it was, it is seen when that time is over."""
        if due < track.expected:
            track.expected = due
            heappush(self._silences, (due, id))

    def _set(self, kind: str, id: int, since: float | None, at: float | None, detail: str = "") -> None:
        """It holds. Its beginning is that of the first time."""
        track = self._tracks[id]
        known = track.open.get(kind)
        if known is None:
            track.open[kind] = known = condition(kind, id, since, detail)
            self._note(Event(at, True, known.level, kind, id, known.text))
        elif known.detail != detail:
            track.open[kind] = known._replace(detail=detail)

    def _clear(self, kind: str, id: int, at: float | None) -> None:
        if (known := self._tracks[id].open.pop(kind, None)) is not None:
            self._note(Event(at, False, known.level, kind, id, known.title))

    def _hold(self, kind: str, id: int, holds: bool, since: float, at: float, detail: str = "") -> None:
        if holds:
            self._set(kind, id, since, at, detail)
        elif kind in self._tracks[id].open:
            self._clear(kind, id, at)

    def _note(self, event: Event) -> None:
        self._events[event.drone].append(event)
        self.counted += 1

    # -- the list ------------------------------------------------------------------------------------------------------

    def conditions(self, now: float, date: DateNote = NO_NOTE) -> list[Condition]:
        """What needs attention now, the most severe first.

        :param now: seconds since 1970.
        :param date: what the store says about the time of its node. Where that has stopped, it is as of then.
        """
        asked = now
        now, stopped = as_of(now, date)
        self._pass(now)
        found = list(self._of_swarm(date.trusted or isinf(date.lived_s)))
        if stopped:
            found.append(condition("stopped", since=now, detail=f"last written {span(max(0.0, asked - now))} ago"))
        for id in self.rules.revoked:
            if id in self.report.drones or id in self.report.unheard:
                self._set("revoked", id, None, None)
        for id, track in self._tracks.items():
            if "revoked" in track.open and id not in self.rules.revoked:
                self._clear("revoked", id, now)
            spot = track.open.get("hot spot")
            if spot is not None and spot.since is not None and now - spot.since > NEW_SPOT_S:
                self._clear("hot spot", id, spot.since + NEW_SPOT_S)
            found += (self._now(condition, track, now, date) for condition in track.open.values())
        own = None if self.rules.base is None else self.rules.base[0]
        for drone in self.report.listed:
            if drone.heard is None and drone.id != own and not self.report.is_base(drone.id):
                naming = self.report.unheard.get(drone.id)
                detail = "" if naming is None else f"last drone {naming.id.origin}"
                found.append(condition("unheard", drone.id, detail=detail))
        return in_order(found)

    def rows(self, now: float, date: DateNote = NO_NOTE) -> list[Row]:
        """The same as lines for people."""
        return rows(self.conditions(now, date), as_of(now, date)[0])

    def _of_swarm(self, known: bool) -> Iterator[Condition]:
        if not known and self.report.drones:
            yield condition("clock")
        if all(self.report.is_base(drone.id) for drone in self.report.listed):
            yield condition("nothing")

    def _now(self, open: Condition, track: _Track, now: float, date: DateNote) -> Condition:
        """With the figures of now."""
        if open.kind == "filling" and (full_at := _full_at(track.free)) is not None:
            left_s, free = full_at - now, track.free[-1][1]
            when = f"full in about {span(left_s)}" if left_s > 0 else "by now it is probably full"
            return open._replace(detail=f"{free:,} more data fit, {when}")
        if open.kind == "silent" and open.drone is not None:
            return open._replace(detail="; ".join(self._about_silence(open.drone, now, date)))
        return open

    def _about_silence(self, drone: int, now: float, date: DateNote) -> Iterator[str]:
        heard = self.report.drones[drone].heard
        started = date.started_s + date.offset_s
        if heard is not None and heard.arrived is not None and heard.arrived < started:
            up = span(max(0.0, now - started))
            yield f"not heard since this base started {up} ago (an earlier mission?)"
        if at_risk := self.report.at_risk(drone):
            yield f"{at_risk:,} older data have no copy elsewhere"

    def events(self) -> list[Event]:
        """What has begun and ended, in the order of time. Those that nobody has dated come first."""
        found = [event for events in self._events.values() for event in events]
        return sorted(found, key=lambda event: -inf if event.utc is None else event.utc)

    # -- for JSON ------------------------------------------------------------------------------------------------------

    def plain(self, now: float, date: DateNote = NO_NOTE) -> dict[str, Any]:
        """The report and the list as plain values for JSON. `now`, `date`: as for `conditions`."""
        conditions = self.conditions(now, date)
        levels = marks(conditions)
        report = self.report.plain(now, self.rules.base)
        then, _ = as_of(now, date)
        silent = [one.drone for one in conditions if one.kind in ("unheard", "silent")]
        ages = {drone["drone"]: drone["heard"] for drone in report["drones"]}
        for drone in report["drones"]:
            level = levels.get(drone["drone"])
            drone["silent_after_s"] = round(self.silent_after_s(drone["drone"]), 1)
            drone["silent"] = drone["drone"] in silent
            drone["attention"] = None if level is None else level.word
        return {
            **report,
            "hot_spots": [spot.plain() for spot in self.spots.highest()],
            "as_of": {"utc": iso(then), "age_s": round(max(0.0, now - then), 1)},
            "created_at_least": bool(silent),
            "silent_after_s": SILENT_S,
            "silent": [
                {"drone": id, "age_s": None, "utc": None}
                if id is None or (heard := ages[id]) is None
                else {"drone": id, "age_s": heard["age_s"], "utc": heard["utc"]}
                for id in sorted(silent, key=lambda id: ages[id] is not None if id is not None else False)
            ],
            "attention": [one.plain(then) for one in conditions[:MOST_LISTED]],
            "attention_more": max(0, len(conditions) - MOST_LISTED),
        }

    def last_reading(self, id: int) -> tuple[float, str] | None:
        """Of a drone: its last reading, and the unit (empty: unknown)."""
        measured = self._tracks[id].measured if id in self._tracks else None
        if measured is None or measured.measurement is None or measured.reading is None:
            return None
        return measured.reading, measured.measurement.unit or ""

    def silent_after_s(self, id: int) -> float:
        """A drone is silent when its newest datum is older, seconds."""
        return self._tracks[id].silent_after_s if id in self._tracks else SILENT_S


def as_of(now: float, date: DateNote) -> tuple[float, bool]:
    """For when the list is made, seconds since 1970, and whether the node of the store has stopped by then."""
    wrote = date.lived_s + date.offset_s
    if isinf(wrote):
        return now, False
    if not date.trusted or now - wrote > STOPPED_S:
        # Where the date is not known, the only clock that fits the data is that of their store.
        return wrote, abs(now - wrote) > STOPPED_S
    return max(now, wrote), False


def _full_at(free: Collection[tuple[float, int]]) -> float | None:
    """When a store is full at the rate of these statuses, seconds since 1970; None: it does not fill up."""
    if len(free) < _FEW_RATES:
        return None
    (begun, first), *_, (ended, last) = free
    if ended - begun < LEAST_SILENT_S or last >= first:
        return None
    return ended + last * (ended - begun) / (first - last)


def _median(values: Collection[float]) -> float:
    return sorted(values)[len(values) // 2]


def _named(ids: list[int]) -> str:
    more = f" and {len(ids) - MOST_NAMES} more" if len(ids) > MOST_NAMES else ""
    return ", ".join(map(str, ids[:MOST_NAMES])) + more
