"""Sets of sequence numbers as ranges: small as long as most numbers follow each other, however large they are."""

from __future__ import annotations

from array import array
from bisect import bisect_left, bisect_right
from collections.abc import Iterator


class Ranges:
    """A set of numbers 0 .. 2^32 - 1, as sorted ranges that neither overlap nor touch."""

    __slots__ = ("bounds",)

    def __init__(self) -> None:
        self.bounds = array("Q")
        """The first number of each range and its last + 1, in turn: a number with an odd number of bounds at or below
        it is in the set."""

    def __contains__(self, number: int) -> bool:
        return bool(bisect_right(self.bounds, number) & 1)

    def __len__(self) -> int:
        """How many ranges there are."""
        return len(self.bounds) >> 1

    def __iter__(self) -> Iterator[tuple[int, int]]:
        """Each range as (first, last + 1)."""
        bounds = self.bounds
        return zip(bounds[::2], bounds[1::2], strict=True)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Ranges) and self.bounds == other.bounds

    __hash__ = None  # type: ignore[assignment]

    def add(self, first: int, end: int) -> None:
        """Add the numbers from `first` up to, but not including, `end`; at least one."""
        bounds = self.bounds
        i, j = bisect_left(bounds, first), bisect_right(bounds, end)
        if i == j == len(bounds):
            # The usual case: nothing comes after.
            bounds.extend((first, end))
            return
        bounds[i:j] = array("Q", ([] if i & 1 else [first]) + ([] if j & 1 else [end]))

    def holds(self, first: int, end: int) -> bool:
        """Whether all numbers from `first` up to, but not including, `end` are in the set; at least one."""
        i = bisect_right(self.bounds, first)
        return bool(i & 1) and end <= self.bounds[i]

    def behind(self, number: int) -> Iterator[tuple[int, int]]:
        """The ranges that reach beyond `number`, whole."""
        bounds = self.bounds
        for i in range(bisect_right(bounds, number) & ~1, len(bounds), 2):
            yield bounds[i], bounds[i + 1]

    @property
    def end(self) -> int:
        """The last number + 1; 0: there is none."""
        return self.bounds[-1] if self.bounds else 0
