"""What has become of a mission's data, by drone, as far as a base knows: arrived, missing, lost, at risk."""

from __future__ import annotations

from bisect import bisect_left
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import accumulate, chain
from math import inf, isfinite
from typing import Any, NamedTuple

from rass_mav.core.datum import STORE_FAULTS, DatumId, Fate
from rass_mav.core.news.ranges import Ranges
from rass_mav.wire.nodestatus import NodeStatus

from .entry import Data, Entry, Place, iso, shown_reading

#: Ranges of missing numbers that are listed for a drone; of more, the latest.
MOST_RANGES = 100
#: Nodes that are known only because drones hear them; of more, those that were heard last. Real ones soon send data.
MOST_UNHEARD = 100
#: Drones that are named in a sentence about several, at most.
MOST_NAMES = 8
#: What the faults of a drone's store mean, for people.
FAULT_TEXTS = {
    "unknown": "may have created data that no node knows of: its numbers were lost in a crash",
    "damaged": "had a damaged store, and data in it may be lost",
}
#: How finely it is known when numbers were created, seconds.
_SPAN_S = 10.0
#: Delays that are kept to find the median and the 95th percentile of all.
_DELAYS = 100_000


@dataclass
class Numbers:
    """The data of one epoch of a drone. Their numbers have no gaps, so what is missing is known."""

    arrived: Ranges = field(default_factory=Ranges)
    lost: dict[int, Fate] = field(default_factory=dict)
    """Those that are known to be lost, and why."""
    known: int = 0
    """So many were created at least: the highest number that the base has heard of, and 1."""
    firsts: dict[int, int] = field(default_factory=dict)
    """The lowest number that was created in each `_SPAN_S` (counted since 1970) at the earliest."""
    newest: tuple[float, int] = -inf, 0
    """When the newest was created at the earliest, seconds since 1970, and its number; -inf: nobody knows."""

    _marks: tuple[list[int], list[float]] | None = None
    """`firsts` sorted by number; and for each, when the one before it was created at the earliest. None: outdated."""

    def note(self, entry: Entry) -> None:
        """When one was created that has arrived."""
        if entry.error_s is not None and isfinite(earliest := entry.utc - entry.error_s):
            number = entry.id.sequence
            span = int(earliest // _SPAN_S)
            if number < self.firsts.get(span, inf):
                self.firsts[span] = number
                self._marks = None
            self.newest = max(self.newest, (earliest, number))

    def missing(self) -> Iterator[tuple[int, int]]:
        """Ranges of numbers, each as (first, last), that were created and have neither arrived nor been reported
        lost."""
        gone = self.arrived
        if self.lost:
            gone = Ranges()
            for start, end in self.arrived:
                gone.add(start, end)
            for number in self.lost:
                gone.add(number, number + 1)
        first = 0
        for start, end in (*gone, (self.known, self.known)):
            if first < min(start, self.known):
                yield first, min(start, self.known) - 1
            first = max(first, end)

    def missing_below(self, number: int) -> int:
        """How many of the numbers below this one are missing."""
        return sum(min(last, number - 1) - first + 1 for first, last in self.missing() if first < number)

    def created_before(self, utc: float) -> int | None:
        """The numbers below this one include all that were created before that time; None: it is not known."""
        numbers = [number for span, number in self.firsts.items() if span * _SPAN_S >= utc]
        if self.newest[0] >= utc:
            numbers.append(self.newest[1])
        return min(numbers, default=None)

    def missing_since(self) -> list[tuple[float, int]]:
        """Each range of missing numbers as a time, seconds since 1970, and a count: they may have been created before
        any later time, and were not created before this one."""
        if self._marks is None:
            marks = sorted((number, span * _SPAN_S) for span, number in self.firsts.items())
            self._marks = [number for number, _ in marks], [-inf, *accumulate((time for _, time in marks), max)]
        numbers, times = self._marks
        newest_s, newest = self.newest
        return [
            (newest_s if newest < first else times[bisect_left(numbers, first)], last - first + 1)
            for first, last in self.missing()
        ]


@dataclass
class Drone:
    """What a base knows of a drone."""

    id: int
    epochs: dict[int, Numbers] = field(default_factory=dict)
    # Counted as data come, and not over all epochs: forged data may have any number of them.
    created: int = 0
    """How many it has created at least."""
    arrived: int = 0
    """How many of its data have arrived."""
    lost: Counter[Fate] = field(default_factory=Counter)
    """How many are known to be lost, by reason."""
    kinds: Counter[str] = field(default_factory=Counter)
    """Arrived data by kind."""
    store_faults: list[Fate] = field(default_factory=list)
    """UNKNOWN: more may have been created than is known; DAMAGED: its store was damaged."""
    heard: Entry | None = None
    """Its latest datum, by the time of its creation."""
    placed: tuple[float, tuple[float, float]] | None = None
    """Its last known place: when, seconds since 1970; latitude and longitude, degrees."""
    highest: Entry | None = None
    """Its highest reading."""
    last_status: Entry | None = None
    """Its latest status."""
    first_hop: Place | None = None
    """Of a base: where the first drone was that had it as its next hop."""

    @property
    def missing(self) -> int:
        """How many have neither arrived nor been reported lost: on their way, or lost without anybody knowing."""
        return self.created - self.arrived - self.lost.total()

    @property
    def missing_numbers(self) -> list[dict[str, Any]]:
        """The same as ranges of numbers, as plain values for JSON; of many the latest."""
        ranges = [
            {"epoch": f"{epoch:08x}", "first": first, "last": last}
            for epoch, numbers in self.epochs.items()
            for first, last in numbers.missing()
        ]
        return ranges[-MOST_RANGES:]

    @property
    def status(self) -> NodeStatus | None:
        """Its latest status, without the datum that it came in."""
        return None if self.last_status is None else self.last_status.status

    def take(self, entry: Entry) -> None:
        """One of its data has arrived."""
        numbers = self._know(entry.id)
        numbers.note(entry)
        if entry.id.sequence not in numbers.arrived:
            numbers.arrived.add(entry.id.sequence, entry.id.sequence + 1)
            self.arrived += 1
            self._find(numbers, entry.id.sequence)
        self.kinds[entry.kind_name] += 1
        if self.heard is None or entry.utc >= self.heard.utc:
            self.heard = entry
        place = entry.whereabouts
        if place is not None and (self.placed is None or entry.utc >= self.placed[0]):
            self.placed = entry.utc, place
        if entry.reading is not None and (self.highest is None or entry.reading > (self.highest.reading or 0.0)):
            self.highest = entry
        if entry.status is not None and (self.last_status is None or entry.utc >= self.last_status.utc):
            self.last_status = entry

    def lose(self, id: DatumId, fate: Fate) -> None:
        """One of its data is known to be lost."""
        if fate in STORE_FAULTS:
            self.store_faults.append(fate)
            return
        numbers = self._know(id)
        if id.sequence not in numbers.arrived:
            self._find(numbers, id.sequence)
            numbers.lost[id.sequence] = fate
            self.lost[fate] += 1

    @property
    def only_epoch(self) -> tuple[int, Numbers] | None:
        """The epoch of all its data, and their numbers; None: there are several or none, or numbers were lost, and how
        many it created before some time cannot be known."""
        if self.store_faults or len(self.epochs) != 1:
            return None
        return next(iter(self.epochs.items()))

    def _know(self, id: DatumId) -> Numbers:
        """The numbers of its epoch. It was created, and so were all before it."""
        numbers = self.epochs.setdefault(id.epoch, Numbers())
        self.created += max(0, id.sequence + 1 - numbers.known)
        numbers.known = max(numbers.known, id.sequence + 1)
        return numbers

    def _find(self, numbers: Numbers, number: int) -> None:
        """A report that this one is lost does not hold."""
        if (fate := numbers.lost.pop(number, None)) is not None:
            self.lost -= Counter((fate,))


class BasePlace(NamedTuple):
    """Where a base is on a map."""

    place: Place
    how: str
    """set: its configuration says so; heard: its autopilot does; guess: where the first hop to it was."""


class AtMost(NamedTuple):
    """A bound of what is lost if a drone fails, of the data that were created before its last status."""

    data: int
    """So many of them are known to be missing: on their way, there or elsewhere, or lost without anybody knowing."""
    drones_unknown: int
    """Of so many drones the base does not know how many they had created by then, so there may be more; 0: it is a
    bound."""


class Report:
    """Made from the data in a base's store, one after the other."""

    def __init__(self) -> None:
        self.drones: dict[int, Drone] = {}
        """By node id."""
        self.unheard: dict[int, Entry] = {}
        """Nodes of which nothing has arrived, each with the latest status that names it as a neighbour."""
        self.nearest: tuple[int, Place] | None = None
        """The fewest hops of a datum with a place, and this, of the first such datum; None: there is none."""
        self.delays: list[float] = []
        """Seconds from creation to arrival, where both are known; of every so many data, where there are many."""
        self._every = 1
        self._delayed = 0
        self.apart = 0
        """Second contents under an id: two drones with one id, or a forged datum."""

    @classmethod
    def of(cls, archive: Data) -> Report:
        """The report of all that a store or a database holds."""
        report = cls()
        report.take(archive.entries())
        report.hear(archive.losses())
        return report

    def take(self, entries: Iterable[Entry]) -> None:
        """Data that have arrived."""
        for entry in entries:
            if entry.apart:
                self.apart += 1
                continue
            self.drone(entry.id.origin).take(entry)
            self.unheard.pop(entry.id.origin, None)
            self._note_first_hop(entry)
            if entry.status is not None:
                self._note_neighbours(entry, entry.status.neighbours)
            if entry.arrived is not None and not entry.at_least:
                self._delay(max(0.0, entry.arrived - entry.utc))

    def hear(self, losses: Iterable[tuple[DatumId, Fate]]) -> None:
        """Data known to be lost."""
        for id, fate in losses:
            self.drone(id.origin).lose(id, fate)

    def drone(self, id: int) -> Drone:
        """What is known of a drone."""
        return self.drones.setdefault(id, Drone(id))

    def _note_first_hop(self, entry: Entry) -> None:
        """A datum with a place shows where a drone is that a base may be near."""
        place, status = entry.whereabouts, entry.status
        if place is None:
            return
        if entry.hops and (self.nearest is None or entry.hops < self.nearest[0]):
            self.nearest = entry.hops, place
        if status is not None and status.hops == 1 and status.next_hop in self.drones:
            base = self.drones[status.next_hop]
            base.first_hop = base.first_hop or place

    def _note_neighbours(self, naming: Entry, neighbours: Iterable[int]) -> None:
        """A status names nodes as neighbours."""
        for id in neighbours:
            if id in self.drones and self.drones[id].heard is not None:
                continue
            if id not in self.unheard or naming.utc >= self.unheard[id].utc:
                self.unheard[id] = naming
        while len(self.unheard) > MOST_UNHEARD:
            del self.unheard[min(self.unheard, key=lambda id: self.unheard[id].utc)]

    @property
    def listed(self) -> list[Drone]:
        """All drones and bases that are known, by id; of some, nothing has arrived."""
        known = {**{id: Drone(id) for id in self.unheard}, **self.drones}
        return [drone for _, drone in sorted(known.items())]

    def is_base(self, id: int) -> bool:
        """Whether a node has said that it is a base, or is known only as the goal of a neighbour's route."""
        drone = self.drones.get(id)
        if drone is not None and drone.status is not None:
            return drone.status.base
        naming = self.unheard.get(id)
        status = None if naming is None else naming.status
        return status is not None and status.hops == 1 and status.next_hop == id

    def bases(self, configured: tuple[int, Place | None] | None = None) -> dict[int, BasePlace | None]:
        """All bases that are known, by node id, each with its place on a map; None: not even a guess is possible.

        :param configured: the node id of a base that need not have been heard, and its place if that is set.
        """
        ids = {id for id in (*self.drones, *self.unheard) if self.is_base(id)}
        found = {id: self._base_place(id) for id in sorted(ids | ({configured[0]} if configured else set()))}
        if configured is not None and configured[1] is not None:
            found[configured[0]] = BasePlace(configured[1], "set")
        return found

    def _base_place(self, id: int) -> BasePlace | None:
        drone, naming = self.drones.get(id), self.unheard.get(id)
        if drone is not None and drone.placed is not None:
            return BasePlace(drone.placed[1], "heard")
        guess = None if drone is None else drone.first_hop
        if guess is None and naming is not None and self.is_base(id):
            guess = naming.whereabouts
        if guess is None and self.nearest is not None:
            guess = self.nearest[1]
        return None if guess is None else BasePlace(guess, "guess")

    def _delay(self, delay_s: float) -> None:
        self._delayed += 1
        if self._delayed % self._every == 0:
            self.delays.append(delay_s)
            if len(self.delays) == _DELAYS:
                del self.delays[::2]
                self._every *= 2

    def at_risk(self, id: int) -> int | None:
        """How many data are probably lost if a drone fails, of those that were created before its last status; None: it
        has sent none.

        It is what the drone alone had then. What has arrived since is safe. Which ones these are is not known, but of
        each origin no more are at risk than are missing. Not in it are data that came to it since, and data of which
        the other copies that it counts on are gone: `at_most` bounds these.
        """
        latest = None if (drone := self.drones.get(id)) is None else drone.last_status
        if latest is None or (status := latest.status) is None:
            return None
        others = status.alone - sum(status.alone_by_origin.values())
        return others + sum(
            count if (missing := self._missing_at(latest, origin)) is None else min(count, missing)
            for origin, count in status.alone_by_origin.items()
        )

    def _missing_at(self, latest: Entry, origin: int) -> int | None:
        """How many data of an origin that are older than a status are missing; None: it is not known."""
        drone = self.drones.get(origin)
        if drone is None or (only := drone.only_epoch) is None:
            return None
        epoch, numbers = only
        if (origin, epoch) == latest.id[:2]:
            return numbers.missing_below(latest.id.sequence)
        number = None if latest.error_s is None else numbers.created_before(latest.utc + latest.error_s)
        return None if number is None else numbers.missing_below(number)

    def at_most(self) -> dict[int, AtMost]:
        """At most how many data are lost if a drone fails, by its id, of those created before its last status.

        These are all that are missing, wherever they are: what is lost with a drone has not arrived. Only data of
        drones that no node has ever named are left out. Without bases, and drones that have sent no status.
        """
        ranges: dict[int, list[tuple[float, int]]] = {}
        # At a base, data are at their goal.
        newest = [-inf for id in self.unheard if id not in self.drones and not self.is_base(id)]
        for drone in self.drones.values():
            if self.is_base(drone.id):
                continue
            only = drone.only_epoch
            ranges[drone.id] = [(-inf, drone.missing)] if only is None else only[1].missing_since()
            newest.append(-inf if only is None else only[1].newest[0])
        newest.sort()
        of_all = sorted(chain.from_iterable(ranges.values()))
        sums = [0, *accumulate(count for _, count in of_all)]
        bounds = {}
        for id, of_it in ranges.items():
            drone = self.drones[id]
            if (latest := drone.last_status) is None:
                continue
            before = inf if latest.error_s is None else latest.utc + latest.error_s
            missing = sums[bisect_left(of_all, (before,))]
            unknown = bisect_left(newest, before)
            if (only := drone.only_epoch) is not None:
                # How many it had created itself it says exactly.
                missing += only[1].missing_below(latest.id.sequence)
                missing -= sum(count for since, count in of_it if since < before)
                unknown -= only[1].newest[0] < before
            bounds[id] = AtMost(max(missing, self.at_risk(id) or 0), unknown)
        return bounds

    def delay(self, part: float) -> float | None:
        """The delay in seconds that so large a part (0..1) of the arrived data had at most; None: unknown."""
        ordered = sorted(self.delays)
        return ordered[min(int(part * len(ordered)), len(ordered) - 1)] if ordered else None

    def plain(self, now: float, base: tuple[int, Place | None] | None = None) -> dict[str, Any]:
        """As plain values for JSON. `now`: seconds since 1970, for ages. `base`: as for `bases`."""
        bounds = self.at_most()
        drones = [self._plain(drone, bounds.get(drone.id), now) for drone in self.listed]
        figures = ("created", "arrived", "missing")
        return {
            **{name: sum(drone[name] for drone in drones) for name in figures},
            "lost": sum(sum(drone["lost"].values()) for drone in drones),
            "apart": self.apart,
            "bases": [
                {
                    "drone": id,
                    "place": None if found is None else found.place,
                    "how": None if found is None else found.how,
                }
                for id, found in self.bases(base).items()
            ],
            "off_map": self.off_map(base),
            "delay_s": {"p50": _rounded(self.delay(0.5)), "p95": _rounded(self.delay(0.95))},
            "drones": drones,
        }

    def off_map(self, base: tuple[int, Place | None] | None = None) -> list[str]:
        """Who has no place on a map, and why, as a sentence for each reason: bases first. Of bases whose place is a
        guess, that it is one. Before all that how many data are sealed. `base`: as for `bases`."""
        found: dict[tuple[str, str], list[int]] = {}
        bases = self.bases(base)
        for drone in self.listed:
            if drone.placed is None and bases.get(drone.id) is None:
                kind = "Base" if drone.id in bases else "Drone"
                if drone.heard is None:
                    reason = "no data have arrived"
                elif kind == "Base":
                    reason = "no position is known (no autopilot reports one)"
                else:
                    reason = "no position on Earth has arrived"
                found.setdefault((kind, reason), []).append(drone.id)
        sentences = [
            f"{kind}{'s' if len(ids) > 1 else ''} {', '.join(map(str, ids[:MOST_NAMES]))}"
            + (f" and {len(ids) - MOST_NAMES} more" if len(ids) > MOST_NAMES else "")
            + f" {'are' if len(ids) > 1 else 'is'} not on the map: {reason}."
            for (kind, reason), ids in sorted(found.items())
        ] + [
            f"The position of base {id} is a guess, from the first hop to it: set base.place in its configuration."
            for id, place in bases.items()
            if place is not None and place.how == "guess"
        ]
        if sealed := sum(drone.kinds["sealed"] for drone in self.listed):
            what = f"{sealed} data are sealed, so their readings and places are not shown"
            sentences.insert(0, f"{what}: give the ground's keys with --keys.")
        return sentences

    def _plain(self, drone: Drone, bound: AtMost | None, now: float) -> dict[str, Any]:
        status, highest, naming = drone.status, drone.highest, self.unheard.get(drone.id)
        return {
            "drone": drone.id,
            "created": drone.created,
            "arrived": drone.arrived,
            "kinds": dict(drone.kinds),
            "missing": drone.missing,
            "missing_numbers": drone.missing_numbers,
            "lost": {fate.value: count for fate, count in drone.lost.items()},
            "wounds": [fate.value for fate in drone.store_faults],
            "heard": None if drone.heard is None else {"utc": iso(drone.heard.utc), "age_s": _age(drone.heard, now)},
            "heard_by": None
            if naming is None
            else {
                "drone": naming.id.origin, "utc": iso(naming.utc), "age_s": _age(naming, now),
                "base": self.is_base(drone.id),
            },
            "place": None if drone.placed is None else drone.placed[1],
            "highest": None
            if highest is None or highest.measurement is None
            else {
                "reading": shown_reading(highest.reading), "unit": highest.measurement.unit, "place": highest.place,
                "utc": iso(highest.utc), "id": highest.name,
            },
            "status": None
            if status is None or drone.last_status is None
            else {
                **status._asdict(), "neighbours": dict(status.neighbours),
                "alone_by_origin": dict(status.alone_by_origin), "utc": iso(drone.last_status.utc),
                "age_s": _age(drone.last_status, now),
            },
            "at_risk": self.at_risk(drone.id),
            "at_most": None if bound is None else bound._asdict(),
        }  # fmt: skip


def heard_text(report: dict[str, Any]) -> str:
    """Who is heard, where nothing needs attention. `report`: as of `Watch.plain`."""
    ages = [
        drone["heard"]["age_s"]
        for drone in report["drones"]
        if drone["heard"] is not None and not (drone["status"] or {"base": False})["base"]
    ]
    longest = max(0.0, max(ages) - report["as_of"]["age_s"])
    return f"{f'all {len(ages)} drones' if len(ages) > 1 else 'the only drone'} heard in the last {span(longest)}"


def sums_text(report: dict[str, Any]) -> str:
    """The totals, as far as they are known. `report`: as of `Watch.plain`."""
    least = "at least " if report["created_at_least"] else ""
    return least + ", ".join(f"{report[name]:,} {name}" for name in ("created", "arrived", "missing", "lost"))


def risk_text(drone: dict[str, Any]) -> str:
    """What is lost if a drone fails now. `drone`: one of those of `Report.plain`."""
    if drone["at_risk"] is None or drone["status"] is None:
        return "if it fails now: unknown, it has sent no status"
    data, bound = drone["at_risk"], drone["at_most"]
    lost, more = (f"{data:,} data lost" if data else "no data lost"), ""
    if bound is not None and bound["data"] > data:
        more = f", perhaps {bound['data']:,} or more" if bound["drones_unknown"] else f", at most {bound['data']:,}"
    elif bound is not None and bound["drones_unknown"]:
        lost = f"{data:,} or more data lost" if data else "no data lost as far as is known"
    return f"if it fails now: {lost}{more}, of those older than {span(drone['status']['age_s'])}"


def lost_text(lost: Mapping[Fate, int] | Mapping[str, int]) -> str:
    """How many are lost, by reason."""
    return ", ".join(f"{count:,} {getattr(fate, 'value', fate)}" for fate, count in lost.items())


def span(seconds: float) -> str:
    """So many seconds in words: `45 s`, `32 min`, `14 h`, `3 d`."""
    for size, unit in ((86_400.0, "d"), (3600.0, "h"), (60.0, "min")):
        if seconds >= 2 * size:
            return f"{seconds / size:.0f} {unit}"
    return f"{seconds:.0f} s" if seconds >= 10 else f"{seconds:.1f} s"


def range_text(missing: dict[str, Any]) -> str:
    """One of a drone's `missing_numbers`, for people."""
    last = "" if missing["first"] == missing["last"] else f"..{missing['last']}"
    return f"{missing['epoch']}-{missing['first']}{last}"


def _age(entry: Entry, now: float) -> float:
    return round(max(0.0, now - entry.utc), 1)


def _rounded(seconds: float | None) -> float | None:
    return None if seconds is None else round(seconds, 3)
