"""The sizes of the pages of a store's database."""

from __future__ import annotations

#: Of a new store, bytes. A commit changes three to five pages, however little is stored, and SQLite logs whole ones:
#: 1024 would still be too much for a part of 16 KiB with a commit of its own (docs/benchmarks.md).
PAGE_BYTES = 512
#: Of a store that was created before. It keeps them.
EARLIER_PAGE_BYTES = 4096


def is_page_size(size: int) -> bool:
    """Whether SQLite has pages of `size` bytes."""
    return 512 <= size <= 65536 and size & (size - 1) == 0
