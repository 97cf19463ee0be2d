"""The files that a node has taken and not yet created all data of: whole, on its disk, beside the store.

A file is taken as soon as its draft `1.new` has become `7.file`. What ends the program before leaves nothing of it,
what ends it afterwards costs nothing: the node goes on with the data that its store does not have (`app.files`).
"""

from __future__ import annotations

import logging
import os
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from rass_mav.core.datum import TERMS, USUAL, Kind, Terms, parted, terms_of
from rass_mav.errors import MalformedError, RassError, StoreError
from rass_mav.store.errors import explained
from rass_mav.store.files import sync_directory
from rass_mav.wire.file import Manifest, decode_manifest, encode_manifest

log = logging.getLogger(__name__)

#: Files that may wait.
MOST_WAITING = 1024
_MAGIC = b"RASS file 1\n"
_SIZE = 4
#: Bytes of kind, terms and manifest at most.
_MOST_HEAD = 1024
_DRAFT, _TAKEN, _BAD = ".new", ".file", ".damaged"
_TAKING, _LOOKING = "taking a file", "looking for files to send"


class Spooled(NamedTuple):
    """A file that was taken."""

    number: int
    """Rises from file to file."""
    path: Path
    manifest: Manifest
    at: int
    """Where its data begin."""
    terms: Terms
    """Those of all its data."""

    def read(self, index: int) -> bytes:
        """What belongs into one of its data. Blocking. Raises `StoreError`."""
        cut = self.manifest.cut
        with explained(self.path, "reading a file to send"), self.path.open("rb") as file:
            file.seek(self.at + cut.offset(index))
            content = file.read(cut.size(index))
        if len(content) != cut.size(index):
            raise StoreError(f"{self.path}: truncated")
        return content

    def delete(self) -> None:
        """All its data are in the store. Blocking."""
        with suppress(OSError):
            self.path.unlink()


class Draft:
    """A file that is being taken. Every method blocks."""

    def __init__(self, path: Path, manifest: Manifest, terms: Terms) -> None:
        """Raises `StoreError`: it cannot be created."""
        self.manifest = manifest
        self._terms = terms
        # Its manifest as a datum has it: the kind, and the payload.
        packed = terms.pack()
        head = bytes((Kind.MANIFEST | (TERMS if packed else 0),)) + packed + encode_manifest(manifest)
        self._path = path
        self._left = manifest.cut.total()
        self._at = len(_MAGIC) + _SIZE + len(head)
        with explained(self._path, _TAKING):
            self._file = os.fdopen(
                os.open(self._path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o600), "wb"
            )
            self._file.write(_MAGIC + len(head).to_bytes(_SIZE, "little") + head)

    @property
    def missing(self) -> int:
        """Bytes that are still to come."""
        return self._left

    def write(self, data: bytes) -> None:
        """The next bytes. Raises `StoreError`: too many, or the disk is full."""
        if len(data) > self._left:
            raise StoreError(f"{self.manifest.name}: longer than stated")
        with explained(self._path, _TAKING):
            self._file.write(data)
        self._left -= len(data)

    def finish(self, number: int) -> Spooled:
        """The file is taken when this returns. Raises `StoreError`: it is not."""
        if self._left:
            raise StoreError(f"{self.manifest.name}: {self._left} bytes missing")
        taken = self._path.with_name(f"{number}{_TAKEN}")
        with explained(self._path, _TAKING):
            self._file.flush()
            os.fsync(self._file.fileno())
            self._file.close()
            self._path.rename(taken)
            sync_directory(taken)
        return Spooled(number, taken, self.manifest, self._at, self._terms)

    def give_up(self) -> None:
        """Leave nothing of it."""
        with suppress(OSError):
            self._file.close()
        with suppress(OSError):
            self._path.unlink()


class Spool:
    """The folder."""

    def __init__(self, folder: Path) -> None:
        """`folder`: created with the first file."""
        self.folder = folder
        self.waiting: dict[int, Spooled] = {}
        """By number, the oldest first."""
        self._next = 1
        self._drafts = 0
        if folder.is_dir():
            self._load()

    def _load(self) -> None:
        with explained(self.folder, _LOOKING):
            for draft in self.folder.glob(f"*{_DRAFT}"):
                draft.unlink()
            found = sorted(
                (int(path.stem), path) for path in self.folder.iterdir()
                if path.suffix in (_TAKEN, _BAD) and path.stem.isdecimal() and path.stem.isascii()
            )  # fmt: skip
        for number, path in found:
            self._next = max(self._next, number + 1)
            if path.suffix != _TAKEN:
                continue
            try:
                self.waiting[number] = _spooled(number, path)
            except RassError as error:
                self.set_aside(number, path, str(error))

    def number_after(self, number: int) -> None:
        """Numbers up to this one are in use."""
        self._next = max(self._next, number + 1)

    def draft(self, manifest: Manifest, terms: Terms = USUAL) -> Draft:
        """Begin a file. Blocking. Raises `StoreError`."""
        with explained(self.folder, _TAKING):
            self.folder.mkdir(mode=0o700, exist_ok=True)
        self._drafts += 1
        return Draft(self.folder / f"{self._drafts}{_DRAFT}", manifest, terms)

    def take(self, draft: Draft) -> Spooled:
        """Finish a file, with the next number. It does not wait yet. Blocking; one call at a time. Raises
        `StoreError`."""
        spooled = draft.finish(self._next)
        self._next += 1
        return spooled

    def set_aside(self, number: int, path: Path, trouble: str) -> None:
        """It cannot be read: keep it for people, under another name."""
        self.waiting.pop(number, None)
        log.error("%s: set aside: %s", path, trouble)
        with suppress(OSError):
            path.rename(path.with_suffix(_BAD))


def _spooled(number: int, path: Path) -> Spooled:
    """Raises `StoreError`, `MalformedError`."""
    with explained(path, _LOOKING), path.open("rb") as file:
        start = file.read(len(_MAGIC) + _SIZE)
        size = int.from_bytes(start[len(_MAGIC) :], "little")
        if not start.startswith(_MAGIC) or len(start) < len(_MAGIC) + _SIZE or size > _MOST_HEAD:
            raise MalformedError(f"{path}: not a spooled file")
        at = len(start) + size
        length = os.fstat(file.fileno()).st_size
        head = file.read(size)
    kind, payload = head[0] if head else 0, head[1:]
    manifest = decode_manifest(parted(kind, payload)[1])
    if length != at + manifest.cut.total():
        raise MalformedError(f"{path}: {length} bytes, expected {at + manifest.cut.total()}")
    return Spooled(number, path, manifest, at, terms_of(kind, payload))
