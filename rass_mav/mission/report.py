"""What has become of a mission's data, by drone, as far as a base knows: arrived, missing, lost, at risk."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any

from rass_mav.core.datum import WOUNDS, DatumId, Fate
from rass_mav.core.news.ranges import Ranges
from rass_mav.wire.nodestatus import NodeStatus

from .entry import Data, Entry, iso

#: Ranges of missing numbers that are listed for a drone; of more, the latest.
MOST_RANGES = 100
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

    def note(self, entry: Entry) -> None:
        """When one was created that has arrived."""
        if entry.error_s is not None:
            span = int((entry.utc - entry.error_s) / _SPAN_S)
            self.firsts[span] = min(entry.id.sequence, self.firsts.get(span, entry.id.sequence))

    def missing(self) -> Iterator[tuple[int, int]]:
        """Ranges of numbers, each as (first, last), that were created and have neither arrived nor been reported
        lost."""
        first = 0
        gone = Ranges()
        for start, end in self.arrived:
            gone.add(start, end)
        for number in self.lost:
            gone.add(number, number + 1)
        for start, end in (*gone, (self.known, self.known)):
            if first < min(start, self.known):
                yield first, min(start, self.known) - 1
            first = max(first, end)

    def missing_below(self, number: int) -> int:
        """How many of the numbers below this one are missing."""
        return sum(min(last, number - 1) - first + 1 for first, last in self.missing() if first < number)

    def created_before(self, utc: float) -> int | None:
        """The numbers below this one include all that were created before that time; None: it is not known."""
        return min((number for span, number in self.firsts.items() if span * _SPAN_S >= utc), default=None)


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
    wounds: list[Fate] = field(default_factory=list)
    """UNKNOWN: more may have been created than is known; DAMAGED: its store was damaged."""
    heard: Entry | None = None
    """Its latest datum, by the time of its creation."""
    placed: tuple[float, tuple[float, float]] | None = None
    """Its last known place: when, seconds since 1970; latitude and longitude, degrees."""
    highest: Entry | None = None
    """Its highest reading."""
    told: Entry | None = None
    """Its latest status."""

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
        """What it last said about itself."""
        return None if self.told is None else self.told.status

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
        if entry.status is not None and (self.told is None or entry.utc >= self.told.utc):
            self.told = entry

    def lose(self, id: DatumId, fate: Fate) -> None:
        """One of its data is known to be lost."""
        if fate in WOUNDS:
            self.wounds.append(fate)
            return
        numbers = self._know(id)
        if id.sequence not in numbers.arrived:
            self._find(numbers, id.sequence)
            numbers.lost[id.sequence] = fate
            self.lost[fate] += 1

    def _know(self, id: DatumId) -> Numbers:
        """The numbers of its epoch. It was created, and so were all before it."""
        numbers = self.epochs.setdefault(id.epoch, Numbers())
        self.created += max(0, id.sequence + 1 - numbers.known)
        numbers.known = max(numbers.known, id.sequence + 1)
        return numbers

    def _find(self, numbers: Numbers, number: int) -> None:
        """What was said about the loss of this one does not hold."""
        if (fate := numbers.lost.pop(number, None)) is not None:
            self.lost -= Counter((fate,))


class Report:
    """Made from the data in a base's store, one after the other."""

    def __init__(self) -> None:
        self.drones: dict[int, Drone] = {}
        """By node id."""
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
            if entry.arrived is not None and not entry.at_least:
                self._delay(max(0.0, entry.arrived - entry.utc))

    def hear(self, losses: Iterable[tuple[DatumId, Fate]]) -> None:
        """Data that are known to be lost."""
        for id, fate in losses:
            self.drone(id.origin).lose(id, fate)

    def drone(self, id: int) -> Drone:
        """What is known of a drone."""
        return self.drones.setdefault(id, Drone(id))

    def _delay(self, delay_s: float) -> None:
        self._delayed += 1
        if self._delayed % self._every == 0:
            self.delays.append(delay_s)
            if len(self.delays) == _DELAYS:
                del self.delays[::2]
                self._every *= 2

    def at_risk(self, id: int) -> int | None:
        """At most how many data are lost if a drone fails, of those that were created before its last status; None: it
        has sent none. Newer data are unknown, and so are those that came to it since.

        Data that it alone held then, and that have arrived since, are safe. Which ones these are is not known, but of
        each origin no more are at risk than are missing.
        """
        told = self.drone(id).told
        if told is None or (status := told.status) is None:
            return None
        others = status.alone - sum(status.alone_by_origin.values())
        return others + sum(
            count if (missing := self._missing_at(told, origin)) is None else min(count, missing)
            for origin, count in status.alone_by_origin.items()
        )

    def _missing_at(self, told: Entry, origin: int) -> int | None:
        """How many data of an origin that are older than a status are missing; None: it is not known."""
        drone = self.drones.get(origin)
        if drone is None or drone.wounds or len(drone.epochs) != 1:
            return None
        [(epoch, numbers)] = drone.epochs.items()
        if (origin, epoch) == told.id[:2]:
            return numbers.missing_below(told.id.sequence)
        number = None if told.error_s is None else numbers.created_before(told.utc + told.error_s)
        return None if number is None else numbers.missing_below(number)

    def delay(self, part: float) -> float | None:
        """The delay in seconds that so large a part (0..1) of the arrived data had at most; None: unknown."""
        ordered = sorted(self.delays)
        return ordered[min(int(part * len(ordered)), len(ordered) - 1)] if ordered else None

    def plain(self, now: float) -> dict[str, Any]:
        """As plain values for JSON. `now`: seconds since 1970, for ages."""
        drones = [self._plain(drone, now) for _, drone in sorted(self.drones.items())]
        figures = ("created", "arrived", "missing")
        return {
            **{name: sum(drone[name] for drone in drones) for name in figures},
            "lost": sum(sum(drone["lost"].values()) for drone in drones),
            "apart": self.apart,
            "delay_s": {"p50": _rounded(self.delay(0.5)), "p95": _rounded(self.delay(0.95))},
            "drones": drones,
        }

    def _plain(self, drone: Drone, now: float) -> dict[str, Any]:
        status, highest = drone.status, drone.highest
        return {
            "drone": drone.id,
            "created": drone.created,
            "arrived": drone.arrived,
            "kinds": dict(drone.kinds),
            "missing": drone.missing,
            "missing_numbers": drone.missing_numbers,
            "lost": {fate.value: count for fate, count in drone.lost.items()},
            "wounds": [fate.value for fate in drone.wounds],
            "heard": None if drone.heard is None else {"utc": iso(drone.heard.utc), "age_s": _age(drone.heard, now)},
            "place": None if drone.placed is None else drone.placed[1],
            "highest": None
            if highest is None or highest.measurement is None
            else {
                "reading": highest.reading, "unit": highest.measurement.unit, "place": highest.place,
                "utc": iso(highest.utc), "id": highest.name,
            },
            "status": None
            if status is None or drone.told is None
            else {
                **status._asdict(), "neighbours": dict(status.neighbours),
                "alone_by_origin": dict(status.alone_by_origin), "utc": iso(drone.told.utc),
                "age_s": _age(drone.told, now),
            },
            "at_risk": self.at_risk(drone.id),
        }  # fmt: skip


def _age(entry: Entry, now: float) -> float:
    return round(max(0.0, now - entry.utc), 1)


def _rounded(seconds: float | None) -> float | None:
    return None if seconds is None else round(seconds, 3)
