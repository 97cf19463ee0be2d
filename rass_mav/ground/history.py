"""Bounded histories: the latest value of each span of time, counts of arrivals, readings."""

from __future__ import annotations

from array import array
from bisect import bisect_right
from collections import Counter
from collections.abc import Collection, Iterator
from math import inf, log2
from typing import Any, Generic, NamedTuple, TypeVar

T = TypeVar("T")

#: Spans of time that are kept, and their length at first, seconds. Where there are more, spans become twice as long.
MOST_SPANS = 300
SPAN_S = 30.0
# Steps of delays for each doubling, and the shortest delay that is told from 0, seconds.
_STEPS = 8
_LEAST_S = 0.01
#: Readings that are kept. Of more, every second one is dropped, and from then on only every second one is taken.
MOST_READINGS = 100_000


class Slots(Generic[T]):
    """The latest value of each span of time, of at most so many spans. Where there are more, spans become twice as
    long. What is kept does not depend on the order in which the values come."""

    def __init__(self, most: int, span_s: float = 1.0) -> None:
        """`most`: 2 or more spans. `span_s`: their length at first, seconds."""
        self.most = most
        self.span_s = span_s
        self._slots: dict[int, tuple[float, T]] = {}
        self._ordered: list[tuple[float, T]] | None = []
        self._last = -inf
        """The latest slot."""

    def put(self, at: float, value: T) -> bool:
        """Add a value of a time, seconds. Returns whether it is kept for now."""
        slot = int(at // self.span_s)
        kept = self._slots.get(slot)
        if kept is not None and kept[0] > at:
            return False
        self._slots[slot] = at, value
        self._last = max(self._last, slot)
        self._ordered = None
        while len(self._slots) > self.most:
            self._widen()
        return True

    def _widen(self) -> None:
        self.span_s *= 2
        old, self._slots = self._slots, {}
        for at, value in old.values():
            slot = int(at // self.span_s)
            kept = self._slots.get(slot)
            if kept is None or at >= kept[0]:
                self._slots[slot] = at, value
        self._last = max(self._slots)

    @property
    def latest(self) -> tuple[float, T] | None:
        """The latest value, with its time; None: there is none."""
        return self._slots[int(self._last)] if self._slots else None

    @property
    def ordered(self) -> list[tuple[float, T]]:
        """The times and values, the earliest first."""
        if self._ordered is None:
            self._ordered = [self._slots[slot] for slot in sorted(self._slots)]
        return self._ordered

    def at(self, time: float) -> tuple[float, T] | None:
        """The latest value that is not later than `time`, with its own time; None: there is none."""
        ordered = self.ordered
        index = bisect_right(ordered, time, key=_time)
        return ordered[index - 1] if index else None

    def __iter__(self) -> Iterator[tuple[float, T]]:
        return iter(self.ordered)

    def __len__(self) -> int:
        return len(self._slots)


def _time(timed: tuple[float, object]) -> float:
    return timed[0]


class Arrivals:
    """Counts by the time of arrival. Delays are known to 5 %."""

    def __init__(self) -> None:
        self.span_s = SPAN_S
        self._counts: Counter[int] = Counter()
        self._delays: dict[int, Counter[int]] = {}

    def take(self, arrived: float, delay_s: float | None) -> None:
        """A datum arrived, seconds since 1970. `delay_s`: its age then; None: unknown."""
        span = int(arrived // self.span_s)
        self._counts[span] += 1
        if delay_s is not None:
            self._delays.setdefault(span, Counter())[_step(delay_s)] += 1
        while len(self._counts) > MOST_SPANS:
            self._widen()

    def _widen(self) -> None:
        self.span_s *= 2
        counts, self._counts = self._counts, Counter()
        for span, count in counts.items():
            self._counts[span >> 1] += count
        delays, self._delays = self._delays, {}
        for span, steps in delays.items():
            self._delays.setdefault(span >> 1, Counter()).update(steps)

    def plain(self) -> dict[str, Any]:
        """For JSON: for each span with arrivals its start, their number, and the delays of half and of 95 % of them."""
        spans = sorted(self._counts)
        return {
            "span_s": self.span_s,
            "start": [span * self.span_s for span in spans],
            "count": [self._counts[span] for span in spans],
            "p50": [self._delay(span, 0.5) for span in spans],
            "p95": [self._delay(span, 0.95) for span in spans],
        }

    def _delay(self, span: int, part: float) -> float | None:
        """So large a part of the span's data had at most this delay, seconds; None: no delay is known."""
        steps = self._delays.get(span)
        if not steps:
            return None
        wanted = part * steps.total()
        for step in sorted(steps):
            wanted -= steps[step]
            if wanted <= 0:
                break
        return round(_LEAST_S * 2 ** (step / _STEPS), 3)


def _step(delay_s: float) -> int:
    return round(_STEPS * log2(max(delay_s, _LEAST_S) / _LEAST_S))


class Reading(NamedTuple):
    """A reading with a place."""

    utc: float
    """Seconds since 1970."""
    drone: int
    latitude: float
    longitude: float
    """Degrees."""
    value: float
    unit: str
    """A key of `UNITS`; empty: unknown."""


class Readings:
    """They are kept as numbers side by side, 41 bytes each."""

    def __init__(self, most: int = MOST_READINGS) -> None:
        self.every = 1
        """Of so many readings one is kept."""
        self._most = most
        self._come = 0
        self._numbers = array("d")
        """Time, latitude, longitude and value of each."""
        self._drones = array("Q")
        self._units = array("B")
        self._names: list[str] = []

    def take(self, reading: Reading) -> None:
        """Add one."""
        self._come += 1
        if self._come % self.every:
            return
        if reading.unit not in self._names:
            self._names.append(reading.unit)
        self._numbers.extend((reading.utc, reading.latitude, reading.longitude, reading.value))
        self._drones.append(reading.drone)
        self._units.append(self._names.index(reading.unit))
        if len(self._drones) > self._most:
            self._thin()

    def _thin(self) -> None:
        numbers = self._numbers
        kept = array("d", bytes(8 * 4 * len(self._drones[::2])))
        for column in range(4):
            kept[column::4] = numbers[column::8]
        self._numbers, self._drones, self._units = kept, self._drones[::2], self._units[::2]
        self.every *= 2

    def __len__(self) -> int:
        return len(self._drones)

    def until(self, time: float) -> Iterator[Reading]:
        """Those that are not later than `time`, seconds since 1970, in the order in which they came."""
        numbers = iter(self._numbers)
        rows = zip(numbers, numbers, numbers, numbers, self._drones, self._units, strict=False)
        for utc, latitude, longitude, value, drone, unit in rows:
            if utc <= time:
                yield Reading(utc, drone, latitude, longitude, value, self._names[unit])

    def of(self, drones: Collection[int]) -> Iterator[Reading]:
        """Those of some drones, in the order in which they came."""
        numbers = self._numbers
        for index, drone in enumerate(self._drones):
            if drone in drones:
                utc, latitude, longitude, value = numbers[4 * index : 4 * index + 4]
                yield Reading(utc, drone, latitude, longitude, value, self._names[self._units[index]])
