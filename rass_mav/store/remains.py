"""The pages of a damaged store: their size, and every state of each that its database and its log have."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterator
from functools import partial
from pathlib import Path

from .disk import HOST
from .files import LOG_ENDINGS, beside
from .found import found_in
from .log import LogFrame, log_page_bytes, read_log
from .page_size import EARLIER_PAGE_BYTES, PAGE_BYTES, is_page_size
from .pages import rows_on
from .payloads import Payloads

#: So much of the database is read at a time to find its page size, bytes: whole pages of every size.
_PIECE_BYTES = 65536
#: The page size is the one that has found the most when one has found so many rows and frames.
_ENOUGH = 100


class Remains:
    """The pages, and the large payloads beside them."""

    def __init__(self, path: Path) -> None:
        """`path`: of the database. `OSError`."""
        log = beside(path, LOG_ENDINGS[0])
        self._files = [_opened(path), _opened(log)]
        self.payloads = Payloads(path, HOST, writable=False)
        database, _ = self._files
        self._database_bytes = 0 if database is None else os.fstat(database).st_size
        self.size = sum(os.fstat(file).st_size for file in self._files if file is not None)
        self.page_bytes = log_page_bytes(log) or self._likeliest_page_bytes(log)
        self.log = read_log(log, self.page_bytes)
        frames = self.log.frames[: self.log.committed] if self.log.intact else self.log.frames
        self._newest = {frame.page: frame.at for frame in frames if frame.sound}

    @property
    def pages(self) -> int:
        """How many pages the database has, without those that only the log has."""
        return self._database_bytes // self.page_bytes

    def fetch(self, number: int) -> bytes | None:
        """The latest state of a page; None: there is none."""
        at = self._newest.get(number)
        return self._stored(self.page_bytes, number) if at is None else self._read(1, at, self.page_bytes)

    def state(self, frame: LogFrame) -> bytes | None:
        """A page as a frame of the log contains it."""
        return self._read(1, frame.at, self.page_bytes)

    def newest(self) -> Iterator[tuple[int, bytes]]:
        """The latest state of each page."""
        for number in sorted(self._newest.keys() | set(range(1, self.pages + 1))):
            page = self.fetch(number)
            if page is not None:
                yield number, page

    def all(self) -> Iterator[tuple[int, bytes]]:
        """Every existing state of every page, the broken frames of the log too, the latest first."""
        for frame in reversed(self.log.frames):
            page = self.state(frame)
            if page is not None:
                yield frame.page, page
        for number in range(1, self.pages + 1):
            page = self._stored(self.page_bytes, number)
            if page is not None:
                yield number, page

    def close(self) -> None:
        """Release the files."""
        for file in self._files:
            if file is not None:
                os.close(file)
        self.payloads.close()

    def _likeliest_page_bytes(self, log: Path) -> int:
        """The page size with which the most rows and frames match their checksums."""
        header = self._read(0, 0, 20) or bytes(20)
        named = int.from_bytes(header[16:18], "big")
        named = 65536 if named == 1 else named
        sizes = [*([named] if is_page_size(named) else []), PAGE_BYTES, EARLIER_PAGE_BYTES]
        found = Counter({size: sum(frame.sound for frame in read_log(log, size).frames) for size in sizes})
        for start in range(0, self._database_bytes, _PIECE_BYTES):
            if max(found.values()) >= _ENOUGH:
                break
            for size in found:
                found[size] += self._count_rows(start, size)
        # Of equals the first.
        return max(found, key=found.__getitem__)

    def _count_rows(self, start: int, page_bytes: int) -> int:
        """How many sound rows a piece of the database has, if its pages have this size."""
        fetch = partial(self._stored, page_bytes)
        first = start // page_bytes + 1
        pages = ((number, fetch(number)) for number in range(first, first + _PIECE_BYTES // page_bytes))
        rows = (row for number, page in pages if page is not None for row in rows_on(page, number, fetch))
        return sum(found_in(columns, self.payloads) is not None for _, columns in rows)

    def _stored(self, page_bytes: int, number: int) -> bytes | None:
        """A page as the database has it."""
        return self._read(0, (number - 1) * page_bytes, page_bytes)

    def _read(self, which: int, at: int, size: int) -> bytes | None:
        file = self._files[which]
        if file is None or at < 0:
            return None
        page = os.pread(file, size, at)
        return page if len(page) == size else None


def _opened(path: Path) -> int | None:
    try:
        return os.open(path, os.O_RDONLY)
    except FileNotFoundError:
        return None
