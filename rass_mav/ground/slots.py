"""A bounded history: the latest value of each span of time."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterator
from typing import Generic, TypeVar

T = TypeVar("T")


class Slots(Generic[T]):
    """The latest value of each span of time, of at most so many spans. Where there are more, spans become twice as
    long. What is kept does not depend on the order in which the values come."""

    def __init__(self, most: int, span_s: float = 1.0) -> None:
        """`most`: 2 or more spans. `span_s`: their length at first, seconds."""
        self.most = most
        self.span_s = span_s
        self._slots: dict[int, tuple[float, T]] = {}
        self._ordered: list[tuple[float, T]] | None = []

    def put(self, at: float, value: T) -> bool:
        """Add a value of a time, seconds. Returns whether it is kept for now."""
        slot = int(at // self.span_s)
        kept = self._slots.get(slot)
        if kept is not None and kept[0] > at:
            return False
        self._slots[slot] = at, value
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
