"""Files that came in parts: which are there, how much of them, and their contents (docs/how-to/files.md)."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from hashlib import sha256
from itertools import chain
from typing import Any, NamedTuple

from rass_mav.app.packing import unpacked
from rass_mav.app.payloads import parse_name
from rass_mav.app.redundancy import restored
from rass_mav.errors import ConfigError, DatumError, MalformedError, RassError, StoreError, UnpackedSizeError
from rass_mav.wire.file import MOST_FILE, PLAIN, Cut, decode_part, key_of

from .entry import Data, Entry

#: Of several data that say they are the same part, so many are looked at.
MOST_RIVALS = 8
#: A packed file is unpacked if it has at most so many bytes, or so many times the bytes of its parts. With a larger one
#: a drone could fill the disk of whoever unpacks it.
SMALL_FILE = 16 << 20
MOST_RATIO = 100


class Extent(NamedTuple):
    """How much of a file is there."""

    there: int
    """Parts that are there, or can be computed."""
    of: int
    """Parts that it has."""

    @property
    def whole(self) -> bool:
        """Whether all of it is there."""
        return self.there >= self.of

    @property
    def share(self) -> float:
        """How much of it is there, 0..1."""
        return self.there / self.of

    @property
    def text(self) -> str:
        """For people."""
        return f"{self.of} parts" if self.whole else f"{self.there} of {self.of} parts"


class Group:
    """The data of one drone that say they are parts of the same file. Its memory grows with them only."""

    __slots__ = ("cut", "names", "origin", "rivals")

    def __init__(self, origin: int, cut: Cut) -> None:
        self.origin = origin
        self.cut = cut
        self.names: dict[int, str] = {}
        """The first datum of each index, as `get` takes it."""
        self.rivals: dict[int, list[str]] = {}
        """Further data of the same index."""

    @property
    def name(self) -> str:
        """Names it if its manifest is not there."""
        return f"file-{self.cut.key.hex()}"

    @property
    def key(self) -> tuple[int, Cut]:
        """What all its data have in common."""
        return self.origin, self.cut

    def plain(self) -> dict[str, Any]:
        """For JSON, where the manifest is not there."""
        return {"name": self.name, "drone": self.origin, "parts": self.extent._asdict()}

    def add(self, index: int, name: str) -> None:
        """One more part."""
        if self.names.setdefault(index, name) != name:
            rivals = self.rivals.setdefault(index, [])
            if len(rivals) < MOST_RIVALS and name not in rivals:
                rivals.append(name)

    @property
    def extent(self) -> Extent:
        """How much is there."""
        return Extent(self.cut.enough(self.names), self.cut.parts)

    @property
    def whole(self) -> bool:
        """Whether all of it is there."""
        return len(self.names) >= self.cut.parts and self.extent.whole

    def stored(self, payload: Callable[[str], bytes]) -> Iterator[bytes]:
        """The packed file, as far as it is there without a gap. `payload`: returns the contents of a datum. Raises
        `StoreError`: one of them cannot be read."""
        if self.cut.needed:
            yield from self._restored(payload)
            return
        for index in range(self.cut.parts):
            if index not in self.names:
                return
            yield self._content(index, self.names[index], payload)

    def _restored(self, payload: Callable[[str], bytes]) -> Iterator[bytes]:
        cut = self.cut
        for stripe in range(cut.stripes):
            first = stripe * cut.shares
            places = [place for place in range(cut.shares) if first + place in self.names][: cut.needed]
            found = {place: self._content(first + place, self.names[first + place], payload) for place in places}
            parts = restored(found, stripe, cut)
            if parts is None:
                return
            yield parts

    def _content(self, index: int, name: str, payload: Callable[[str], bytes]) -> bytes:
        try:
            part = decode_part(payload(name))
        except MalformedError as error:
            raise StoreError(f"{name}: {error}") from None
        if part.cut != self.cut or part.number != index:
            raise StoreError(f"{name}: differs from the part listed")
        return part.content

    def contradicts(self, payload: Callable[[str], bytes]) -> list[str]:
        """The data of which others with the same index have other contents."""
        found = []
        for index, rivals in self.rivals.items():
            first = self._content(index, self.names[index], payload)
            found += [name for name in rivals if self._content(index, name, payload) != first]
        return found


class Groups:
    """The parts in a store, by their file."""

    def __init__(self) -> None:
        self._groups: dict[tuple[int, Cut], Group] = {}
        self.unread = 0
        """Parts of which nobody can tell to which file they belong: sealed or malformed ones."""

    @classmethod
    def of(cls, data: Data) -> Groups:
        """All that are there."""
        groups = cls()
        for entry in data.entries(parts=True):
            groups.add(entry)
        return groups

    def add(self, entry: Entry) -> Group | None:
        """One more datum. Returns its group; None: nobody can tell."""
        if entry.part is None:
            self.unread += 1
            return None
        key = entry.id.origin, entry.part.cut
        group = self._groups.get(key)
        if group is None:
            group = self._groups[key] = Group(*key)
        group.add(entry.part.number, entry.name)
        return group

    def parts_of(self, entry: Entry) -> Group:
        """What there is of the file of a manifest."""
        assert entry.manifest is not None
        key = entry.id.origin, entry.manifest.cut
        return self._groups.get(key) or Group(*key)

    def orphans(self, data: Data) -> list[Group]:
        """Those whose manifest is not there."""
        known = {
            (entry.id.origin, entry.manifest.cut) for entry in data.entries(parts=False) if entry.manifest is not None
        }
        return [group for key, group in self._groups.items() if key not in known]


class File:
    """A file of a store."""

    def __init__(
        self, group: Group, entry: Entry | None, payload: Callable[[str], bytes], *, any_size: bool = False
    ) -> None:
        """`entry`: of the manifest; None: it is not there. `payload`: returns the contents of a datum. `any_size`:
        it is unpacked however large it becomes."""
        self._group = group
        self._any_size = any_size
        self.entry = entry
        self._manifest = None if entry is None else entry.manifest
        self._payload = payload
        self.name = group.name if self._manifest is None else self._manifest.name
        """As its drone gave it: not trustworthy."""

    @property
    def extent(self) -> Extent:
        """How much of it is there."""
        return self._group.extent

    def check(self) -> int:
        """Read all of it once; returns its size. Raises `StoreError`: it is not whole, or not what was put;
        `UnpackedSizeError`."""
        extent = self._group.extent
        if not extent.whole:
            raise StoreError(f"{self.name}: only {extent.text} have arrived; --partial fetches the beginning")
        digest, size = sha256(), 0
        for piece in self.pieces():
            digest.update(piece)
            size += len(piece)
        if key_of(digest.digest(), *self._group.cut[:5]) != self._group.cut.key or (
            self._manifest is not None and (digest.digest(), size) != (self._manifest.digest, self._manifest.size)
        ):
            against = self._group.contradicts(self._payload)
            why = f": {', '.join(against)} contradict other parts" if against else ""
            raise StoreError(f"{self.name}: not the file that was submitted: its SHA-256 does not match{why}")
        return size

    def beginning(self) -> Iterator[bytes]:
        """What there is of the beginning of a file that is not whole. Raises `StoreError`: nothing is."""
        pieces = filter(None, self.pieces(partial=True))
        first = next(pieces, None)
        if first is None:
            raise StoreError(f"{self.name}: only {self.extent.text} have arrived, none of them at the beginning")
        return chain([first], pieces)

    def pieces(self, *, partial: bool = False) -> Iterator[bytes]:
        """The contents, of a file that was checked. `partial`: what there is of the beginning. Raises `StoreError`,
        `UnpackedSizeError`."""
        cut, manifest = self._group.cut, self._manifest
        size = MOST_FILE if manifest is None else manifest.size
        limit = size if self._any_size or cut.packing == PLAIN else max(SMALL_FILE, MOST_RATIO * cut.length)
        too_large = UnpackedSizeError(
            f"{self.name}: packed in {cut.length} bytes, it has more than {limit}; --any-size unpacks it anyway"
        )
        if limit < size and manifest is not None:
            raise too_large
        found = 0
        try:
            for piece in unpacked(self._group.stored(self._payload), cut.packing, size):
                found += len(piece)
                if found > limit:
                    raise too_large
                yield piece
        except MalformedError as error:
            if not partial:
                raise StoreError(f"{self.name}: {error}") from None


def find(data: Data, name: str, *, any_size: bool = False) -> tuple[Entry | None, File | None]:
    """What `get` is asked for: an id, or the name of a file. The entry of the datum, which may be a manifest; None: the
    manifest of the file is not there. The file; None: the datum is none that came in parts. `any_size`: as of `File`.

    Raises `DatumError`: neither; `StoreError`: it is not there; `ConfigError`: several files have this name.
    """

    def file(group: Group, entry: Entry | None) -> File:
        return File(group, entry, data.payload, any_size=any_size)

    with suppress(DatumError):
        parse_name(name)
        entry = data.entry(name)
        return entry, None if entry.manifest is None else file(Groups.of(data).parts_of(entry), entry)
    named = [entry for entry in data.entries(parts=False) if entry.file == name and not entry.malformed]
    groups = Groups.of(data)
    if not named:
        orphans = [file(group, None) for group in groups.orphans(data) if group.name == name]
        if not orphans:
            raise DatumError(f"expected an id like 7-0123abcd-42, or the name of a file in this store, got {name!r}")
        return None, _best(orphans)
    if len({None if entry.manifest is None else entry.manifest.digest for entry in named}) > 1 or (
        len(named) > 1 and named[0].manifest is None
    ):
        raise ConfigError(f"{name!r}: several files have this name: {', '.join(entry.name for entry in named)}")
    if named[0].manifest is None:
        return named[0], None
    # Put more than once, by one drone or by several: the same contents.
    best = _best([file(groups.parts_of(entry), entry) for entry in named])
    return best.entry, best


def _best(files: list[File]) -> File:
    """Of files that say that they are the same, one that is, or the one of which most is there."""
    by_share = sorted(files, key=lambda file: -file.extent.share)
    for file in by_share if len(files) > 1 else ():
        with suppress(RassError):
            file.check()
            return file
    return by_share[0]
