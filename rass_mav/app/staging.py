"""Reads a file that is to be put: twice, in pieces, and checks that it does not change meanwhile
(docs/how-to/files.md)."""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator
from hashlib import sha256
from pathlib import Path
from typing import NamedTuple

from rass_mav.core.datum import USUAL, Terms
from rass_mav.errors import ConfigError, DatumError, os_errors_as
from rass_mav.wire.file import MOST_FILE, PLAIN

from .packing import best, packer

#: Bytes that are read at a time.
PIECE = 1 << 16
#: A file is packed if that saves at least this share: of its first bytes, and then of all.
WORTH = 0.1
TRIAL = 1 << 18


class About(NamedTuple):
    """A file at the first reading."""

    name: str
    size: int
    """Bytes."""
    time: float
    """When it was last changed, seconds since 1970."""
    digest: bytes
    """SHA-256."""
    packing: int
    """How it is best packed, one of `wire.file.PACKINGS`."""
    length: int
    """Bytes then."""
    terms: Terms = USUAL
    """Those of all its data."""


class Staging:
    """A file that is being put."""

    def __init__(self, path: Path, *, follow: bool = True) -> None:
        """`follow`: symbolic links. Raises `ConfigError`: it cannot be opened, or is no plain file."""
        self._path = path
        # A pipe that nobody writes to must not hold us up.
        flags = os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC | (0 if follow else os.O_NOFOLLOW)
        with os_errors_as(ConfigError, path):
            self._file = os.open(path, flags)
        try:
            self._began = self._stat()
            if not stat.S_ISREG(self._began.st_mode):
                raise ConfigError(f"{path}: not a regular file")
            if self._began.st_size > MOST_FILE:
                raise ConfigError(f"{path}: larger than {MOST_FILE} bytes")
        except BaseException:
            os.close(self._file)
            raise
        self.size = self._began.st_size
        """Bytes."""

    def _stat(self) -> os.stat_result:
        with os_errors_as(ConfigError, self._path):
            return os.fstat(self._file)

    def whole(self) -> bytes:
        """All of a small file. Raises `DatumError` if it changes."""
        content = b"".join(self._read())
        self._check(len(content))
        return content

    def look(self, *, pack: bool = True) -> About:
        """Read all of it once. `pack`: whether it may be packed. Raises `ConfigError`, `DatumError`."""
        packing = best() if pack and self._pays() else PLAIN
        digest, packed, chosen, length, size = sha256(), packer(packing), packing, 0, 0
        for piece in self._read():
            digest.update(piece)
            size += len(piece)
            if packing != PLAIN:
                length += len(packed.compress(piece))
        self._check(size)
        length += len(packed.flush())
        if packing == PLAIN or length > (1.0 - WORTH) * size:
            chosen, length = PLAIN, size
        return About(self._path.name, size, self._began.st_mtime_ns / 1e9, digest.digest(), chosen, length)

    def _pays(self) -> bool:
        trial = packer(best())
        with os_errors_as(ConfigError, self._path):
            head = os.pread(self._file, TRIAL, 0)
        return len(trial.compress(head)) + len(trial.flush()) <= (1.0 - WORTH) * len(head)

    def packed(self, about: About) -> Iterator[bytes]:
        """Its packed bytes, in pieces. Raises `DatumError` at the latest at the end if it is not what it was."""
        digest, packed, size, length = sha256(), packer(about.packing), 0, 0
        for piece in self._read():
            digest.update(piece)
            size += len(piece)
            if out := packed.compress(piece):
                length += len(out)
                yield out
        out = packed.flush()
        self._check(size)
        if digest.digest() != about.digest or length + len(out) != about.length:
            raise self._changed()
        if out:
            yield out

    def _read(self) -> Iterator[bytes]:
        at = 0
        while True:
            with os_errors_as(ConfigError, self._path):
                piece = os.pread(self._file, PIECE, at)
            if not piece:
                return
            at += len(piece)
            yield piece

    def _check(self, size: int) -> None:
        now = self._stat()
        same = (now.st_size, now.st_mtime_ns) == (self._began.st_size, self._began.st_mtime_ns)
        if not same or size != self._began.st_size:
            raise self._changed()

    def _changed(self) -> DatumError:
        return DatumError(f"{self._path}: changed while being read; nothing was submitted")

    def close(self) -> None:
        """Close the file."""
        os.close(self._file)

    def __enter__(self) -> Staging:
        return self

    def __exit__(self, *raised: object) -> None:
        self.close()


def in_pieces(data: Iterator[bytes], most: int = PIECE) -> Iterator[bytes]:
    """The same bytes in pieces of at most `most`."""
    for piece in data:
        for at in range(0, len(piece), most):
            yield piece[at : at + most]
