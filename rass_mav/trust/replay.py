"""Which numbers of one sender were heard before: the replay window of RFC 6479.

It is kept in blocks of numbers, and what is more than one block behind is old. Nothing is shifted when it moves on: the
oldest block is forgotten as a whole. It moves only on what the sender itself has proved; every holder of the link key
can send any number.
"""

from __future__ import annotations

#: Fact: Blocks behind that of the highest number in which a number may still be new.
LATE = 1
#: Marks of one block that are remembered; when there are more, the earlier ones are forgotten with the next block. More
#: than a node sends in a turn: only an attacker who floods its stream has so many.
MAX_MARKS = 1024


class ReplayWindow:
    """What was heard of one sender in its present block, and before."""

    __slots__ = ("_before", "_heard", "_size", "block", "floor")

    def __init__(self, size: int, number: int) -> None:
        """`size`: numbers of a block. `number`: where the sender is."""
        self._size = size
        self._heard: set[int] = set()
        self._before: set[int] = set()
        self.block = number // size
        """In which the sender is."""
        self.floor = (self.block - LATE) * size
        """Numbers below this one are old."""

    def is_new(self, number: int, mark: int) -> bool:
        """Whether this was not heard before. From then on it was. `mark`: the number itself, or if other nodes could
        use it too, a hash of it and of what came with it."""
        if number < self.floor or mark in self._heard or mark in self._before:
            return False
        self._heard.add(mark)
        if len(self._heard) >= MAX_MARKS:
            self._turn()
        return True

    def advance(self, number: int) -> None:
        """The sender has come as far as this, unless it was further already."""
        block = number // self._size
        if block > self.block:
            self._turn()
            self.block, self.floor = block, max(self.floor, (block - LATE) * self._size)

    def set_back(self, number: int) -> None:
        """The sender has shown that it is here, although it was further before."""
        self._turn()
        self.block = number // self._size
        self.floor = (self.block - LATE) * self._size

    def __len__(self) -> int:
        return len(self._heard) + len(self._before)

    def _turn(self) -> None:
        self._before, self._heard = self._heard, set()
