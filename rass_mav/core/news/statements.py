"""What one entry of a receipt covers, and how a base composes the entries about its data.

A base reports in blocks of 128 numbers. The entry of a block covers what has arrived in it, and extends in both
directions as far as numbers follow each other without a gap. So where nothing is missing, one entry covers everything
from 0 on, and a newer entry contains the older ones.
"""

from __future__ import annotations

from collections.abc import Iterator

from rass_mav.core.messages import ReceiptEntry
from rass_mav.core.news.ranges import Ranges

#: Numbers in a block, and bits in a bitmap at most.
RECEIPT_BITS = 128


def blocks(ranges: Ranges) -> Iterator[int]:
    """Blocks whose entries together cover everything."""
    last = -1
    for first, end in ranges:
        for block in (first // RECEIPT_BITS, (end - 1) // RECEIPT_BITS):
            if block > last:
                last = block
                yield block


def entry_of(origin: int, epoch: int, ranges: Ranges, block: int, *, lost: bool) -> ReceiptEntry | None:
    """The entry of a block of an origin and epoch; None: there is nothing in it."""
    ahead = ranges.behind(block * RECEIPT_BITS)
    first, end = next(ahead, (0, 0))
    if first >= (block + 1) * RECEIPT_BITS or not end:
        return None
    # To the end of the block in which the run ends.
    limit = -(-end // RECEIPT_BITS) * RECEIPT_BITS
    bitmap = 0
    for start, stop in ahead:
        if start >= limit:
            break
        bitmap |= ((1 << (min(stop, limit) - start)) - 1) << (start - end)
    return ReceiptEntry(origin, epoch, first, end - first, bitmap, lost)


def ranges_of(entry: ReceiptEntry) -> Iterator[tuple[int, int]]:
    """The numbers that an entry covers, as (first, last + 1)."""
    _, _, first, run, bitmap, _ = entry
    end = first + run
    yield first, end
    while bitmap:
        skip = (bitmap & -bitmap).bit_length() - 1
        bitmap >>= skip
        length = (~bitmap & (bitmap + 1)).bit_length() - 1
        bitmap >>= length
        yield end + skip, end + skip + length
        end += skip + length


def last_of(entry: ReceiptEntry) -> int:
    """The highest number that an entry covers."""
    return entry.first + entry.run + entry.bitmap.bit_length() - 1


def covers(a: ReceiptEntry, b: ReceiptEntry) -> bool:
    """Whether an entry covers all numbers that another one of the same kind, origin and epoch covers."""
    _, _, first_a, run_a, bits_a, _ = a
    _, _, first_b, run_b, bits_b, _ = b
    if first_b < first_a:
        return False
    end_a = first_a + run_a
    ahead = first_b + run_b - end_a
    if ahead <= 0:
        # The run of b is within that of a.
        return not bits_b >> -ahead & ~bits_a
    if ahead > RECEIPT_BITS:
        return False
    inside = max(0, first_b - end_a)
    return not ((bits_b << ahead) | ((1 << ahead) - (1 << inside))) & ~bits_a
