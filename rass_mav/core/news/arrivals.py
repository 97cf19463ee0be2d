"""What is known of the arrivals of one origin's data, in bounded space, and how two pieces of knowledge are merged.

Most data arrive nearly in order. So what is known is: everything from a floor up to `closed` has arrived, and a window
of 17 numbers from there on says one by one. Of what lies below the floor nothing is said (nobody concludes anything
from it). The floor is 0 until so much has arrived behind a datum that is missing that it falls out of the window.

    0        floor           closed     + 16
    |  ?  ?  |##################|..#.x##..|            # arrived   . not yet   x told lost

A piece of knowledge never says that a datum has arrived which has not. A set of data has one description only (`Known`
is canonical), so equal knowledge is equal word by word, and a digest can tell. Merging is symmetric. The merged piece
has the higher top (what arrived last) of the two, and for an equal top it knows all that either knew. So whoever merges
what neighbours tell gets better and better knowledge, of which there is a best: telling each other comes to an end.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

#: How many numbers behind `closed` the window reaches.
WINDOW_BITS = 16
#: How many numbers from `closed` on can be marked as told lost.
LOST_BITS = 16


#: What is known of the data of one origin and epoch, as (closed, bitmap, lost, floor):
#: all sequence numbers from `floor` up to, but not including, `closed` have arrived, `closed` itself has not;
#: bit i of `bitmap` (16 bits): closed + 1 + i has arrived;
#: bit i of `lost` (16 bits): a base was told that closed + i is lost, and it has not arrived;
#: of numbers below `floor` nothing is said.
#: A plain tuple: a node makes and compares thousands of them, and a class of its own takes ten times as long to make.
Known: TypeAlias = tuple[int, int, int, int]

#: What is known at first.
NOTHING: Known = (0, 0, 0, 0)


def has_arrived(known: Known, sequence: int) -> bool:
    """Whether a datum is known to have arrived."""
    closed, bitmap, _, floor = known
    if sequence < closed:
        return sequence >= floor
    return sequence != closed and bool(bitmap >> (sequence - closed - 1) & 1)


def is_told_lost(known: Known, sequence: int) -> bool:
    """Whether a base was told that a datum is lost, and none has got it."""
    return sequence >= known[0] and bool(known[2] >> (sequence - known[0]) & 1)


def canonical(closed: int, bitmap: int, lost: int, floor: int) -> Known:
    """The one description of what a neighbour said in its own way. `floor` at most `closed`."""
    if floor and closed == floor and not bitmap:
        # Nothing has arrived.
        return NOTHING
    top = closed + 1 + bitmap.bit_length() if bitmap else closed
    start = max(0, top - WINDOW_BITS - 1)
    if floor > start:
        # The window itself reaches below the floor.
        zone = (1 << (closed - floor)) - 1
        return _normal(
            start, start, (bitmap << (closed + 1 - start)) | (zone << (floor - start)), lost << (closed - start)
        )
    return _normal(floor, closed, bitmap << 1, lost)


def one(sequence: int) -> Known:
    """That one datum has arrived, and nothing else."""
    return (
        _normal(0, 0, 1 << sequence, 0)
        if sequence <= WINDOW_BITS
        else (sequence - WINDOW_BITS, 1 << (WINDOW_BITS - 1), 0, sequence - WINDOW_BITS)
    )


def merged(a: Known, b: Known) -> Known:
    """What two pieces of knowledge say together."""
    if a[0] > b[0]:
        a, b = b, a
    closed_a, bitmap_a, lost_a, floor_a = a
    closed_b, bitmap_b, lost_b, floor_b = b
    ahead = closed_b - closed_a
    if floor_b <= closed_a:
        # What is known without a hole overlaps: it goes from the lower floor to the higher end.
        floor = floor_a if floor_a < floor_b else floor_b
        if not (bitmap_a or bitmap_b or lost_a or lost_b):
            return (closed_b, 0, 0, floor)
        return _normal(floor, closed_b, bitmap_b << 1 | (bitmap_a << 1) >> ahead, lost_b | lost_a >> ahead)
    if ahead <= 4 * WINDOW_BITS:
        # There is a hole in between, and the window may reach down to it.
        arrived = bitmap_a << 1 | bitmap_b << (ahead + 1) | ((1 << (closed_b - floor_b)) - 1) << (floor_b - closed_a)
        return _normal(floor_a, closed_a, arrived, lost_a | lost_b << ahead)
    # The hole lies below the window: `a` can tell only of numbers just below the floor of `b`.
    below = (bitmap_a << 1) & ((1 << (floor_b - closed_a)) - 1) if floor_b - closed_a <= WINDOW_BITS + 1 else 0
    hole = floor_b - closed_a
    while below >> (hole - 1) & 1:
        hole -= 1
    return (closed_b, bitmap_b, lost_b, closed_a + hole)


def completed(known: Known, arrived_here: Callable[[int], bool], lost_here: Callable[[int], bool]) -> Known:
    """A piece of knowledge with all that somebody who knows every datum can add to it, apart from a higher top."""
    while True:
        closed, bitmap, lost, floor = known
        arrived = bitmap << 1
        for offset in range(WINDOW_BITS + 1):
            if arrived_here(closed + offset):
                arrived |= 1 << offset
            elif offset < LOST_BITS and lost_here(closed + offset):
                lost |= 1 << offset
        while floor and arrived_here(floor - 1):
            floor -= 1
        better = _normal(floor, closed, arrived, lost)
        if better == known:
            return known
        known = better


def _normal(floor: int, start: int, arrived: int, lost: int) -> Known:
    """The canonical form. [floor, start) has arrived; bit i of `arrived` and `lost` stands for start + i."""
    if arrived & 1:
        run = (~arrived & (arrived + 1)).bit_length() - 1
        start += run
        arrived >>= run
        lost >>= run
    beyond = arrived.bit_length() - WINDOW_BITS - 1
    if beyond > 0:
        # The window moves up; below it only what reaches up to it without a hole can still be told.
        floor = start + (~arrived & ((1 << beyond) - 1)).bit_length()
        return _normal(floor, start + beyond, arrived >> beyond, lost >> beyond)
    return (start, arrived >> 1, lost & ~arrived & 0xFFFF, floor)
