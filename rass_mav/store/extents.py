"""Which sectors of a file are in use: a pure table. Nothing of it is on disk, since the rows of the database tell."""

from __future__ import annotations

from bisect import bisect_left, insort
from collections.abc import Iterable


class Extents:
    """The free sectors of a file, as ranges. There are never more of them than one for each range in use, and one.

    A range that was in use waits until `recycle`: what is on the medium may still refer to it.
    """

    def __init__(self, used: Iterable[tuple[int, int]], first: int, end: int) -> None:
        """`used`: first sector and number of sectors of each range in use. `first`: the first sector that can be used.
        `end`: the sectors of the file. ValueError: a range lies outside, or two have a sector in common.

        What is free at the start waits too.
        """
        self._free: list[tuple[int, int]] = []
        """First sector of each free range, and the one behind it: sorted, and apart from each other."""
        self._waiting: list[tuple[int, int]] = []
        self.used = 0
        """How many ranges are in use."""
        at = first
        self.end = max(end, first)
        """The first sector behind all that were ever taken."""
        for start, count in (*sorted(used), (self.end, 0)):
            if start < at or start + count > self.end:
                raise ValueError(f"sectors {start} to {start + count} of {end} are allocated twice or missing")
            if start > at:
                self._waiting.append((at, start))
            at = start + count
            self.used += count > 0

    def take(self, count: int) -> int:
        """Take a range of `count` sectors, the lowest that fits. Returns its first sector."""
        self.used += 1
        free = self._free
        for index, (start, stop) in enumerate(free):
            if stop - start > count:
                free[index] = start + count, stop
                return start
            if stop - start == count or stop == self.end:
                del free[index]
                self.end = max(self.end, start + count)
                return start
        start = self.end
        self.end += count
        return start

    def release(self, start: int, count: int) -> None:
        """A range is no longer in use."""
        self.used -= 1
        self._waiting.append((start, start + count))

    def recycle(self) -> None:
        """Nothing refers any more to what was released."""
        for start, stop in self._waiting:
            self._insert(start, stop)
        self._waiting.clear()

    def give_back(self, start: int, count: int) -> None:
        """A range that was taken has never been in use."""
        self.used -= 1
        self._insert(start, start + count)

    def _insert(self, start: int, stop: int) -> None:
        free = self._free
        index = bisect_left(free, (start, stop))
        if index < len(free) and free[index][0] == stop:
            stop = free.pop(index)[1]
        if index and free[index - 1][1] == start:
            start = free.pop(index - 1)[0]
        insort(free, (start, stop))

    @property
    def waiting(self) -> bool:
        """Whether there is something to recycle."""
        return bool(self._waiting)

    @property
    def tail(self) -> int:
        """How many free sectors are at the end."""
        return self._free[-1][1] - self._free[-1][0] if self._free and self._free[-1][1] == self.end else 0

    def trim(self) -> None:
        """The file ends before its `tail` now."""
        if self.tail:
            self.end = self._free.pop()[0]
