"""The payloads of data of the kinds MANIFEST, PART and SHARE: files that are groups of data (docs/how-to/files.md)."""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Iterable, Iterator
from typing import NamedTuple

from rass_mav.errors import MalformedError

# Version, packing, K, N, bytes of a part, bytes of the packed file: what the parts of a file have in common.
_CUT = struct.Struct("<BBBBIQ")
_KEY_BYTES = 8
_INDEX = struct.Struct("<I")
# Flags, size, digest, milliseconds since 1970, latitude, longitude, altitude in millimetres.
_FILE = struct.Struct("<BQ32sqiii")
_VERSION = 1
_HAS_TIME = 1
_HAS_PLACE = 2
#: How the contents of a file may be packed.
PLAIN, ZLIB, ZSTD = range(3)
PACKINGS = {PLAIN: "plain", ZLIB: "zlib", ZSTD: "zstd"}
#: Bytes of file in a part at most.
MOST_PART = 1 << 16
#: Bytes of a file at most, packed or not, and parts of one at most.
MOST_FILE = 1 << 45
MOST_PARTS = (1 << 32) - 2
#: Bytes before the contents of a part.
PART_HEAD = _CUT.size + _KEY_BYTES + _INDEX.size
#: Bytes of a file's name in UTF-8 at most.
MOST_NAME = 255
_MOST_LAT, _MOST_LON = 900_000_000, 1_800_000_000
_MOST_MS = 1 << 53


class Cut(NamedTuple):
    """How a file was cut. All its parts say so, and so does its manifest."""

    packing: int
    """One of `PACKINGS`."""
    needed: int
    """K: so many parts are a stripe, and any K of the stripe's N shares give it back; 0: no redundancy."""
    shares: int
    """N, above K and at most 255; 0: no redundancy."""
    part_bytes: int
    """Bytes of each part, 1..`MOST_PART`; the last may have fewer."""
    length: int
    """Bytes of the packed file, 1..`MOST_FILE`."""
    key: bytes
    """8 bytes that name the file among those of its origin: `key_of`."""

    @property
    def parts(self) -> int:
        """How many parts the packed file has."""
        return -(-self.length // self.part_bytes)

    @property
    def stripes(self) -> int:
        """How many stripes the parts make."""
        return -(-self.parts // self.needed) if self.needed else 0

    @property
    def end(self) -> int:
        """The indexes of data are below this."""
        return self.stripes * self.shares if self.needed else self.parts

    def data(self) -> int:
        """How many data hold the file: its parts, and with redundancy those computed from them."""
        return self.parts + self.stripes * (self.shares - self.needed)

    def size(self, index: int) -> int:
        """Bytes of file in the datum of this index; 0: there is none, because its part is beyond the end."""
        part = index
        if self.needed:
            stripe, place = divmod(index, self.shares)
            if place >= self.needed:
                return self.part_bytes
            part = stripe * self.needed + place
        return max(0, min(self.part_bytes, self.length - part * self.part_bytes))

    def offset(self, index: int) -> int:
        """Bytes in the data before this one."""
        if not self.needed:
            return min(self.length, index * self.part_bytes)
        stripe, place = divmod(index, self.shares)
        own = self.length - stripe * self.needed * self.part_bytes
        in_parts = min(self.needed * self.part_bytes, own, place * self.part_bytes)
        computed = max(0, place - self.needed) * self.part_bytes
        return stripe * self.shares * self.part_bytes + in_parts + computed

    def total(self) -> int:
        """Bytes in all data."""
        return self.length + self.stripes * (self.shares - self.needed) * self.part_bytes

    def enough(self, indexes: Iterable[int]) -> int:
        """How many of the parts the data of these indexes give back."""
        if not self.needed:
            return sum(1 for _ in indexes)
        found = Counter(index // self.shares for index in indexes)
        return sum(min(count, self.needed, self.parts - stripe * self.needed) for stripe, count in found.items())

    def indexes(self) -> Iterator[int]:
        """Those of all data, ascending."""
        return (index for index in range(self.end) if self.size(index))


class Manifest(NamedTuple):
    """What a file is, and how it was cut."""

    cut: Cut
    name: str
    """1..255 bytes in UTF-8. Not trustworthy: show it, but never open it."""
    size: int
    """Bytes of the file, 0..`MOST_FILE`."""
    digest: bytes
    """SHA-256 of the file."""
    time: float | None = None
    """When it was made, seconds since 1970, resolution 1 ms; None: unknown."""
    place: tuple[float, float, float] | None = None
    """Where: degrees (resolution 1e-7), and metres above mean sea level (resolution 1 mm); None: unknown."""


class Part(NamedTuple):
    """One part of a file, or with redundancy one share of a stripe."""

    cut: Cut
    number: int
    """Its index, from 0. With redundancy: stripe times N plus a place; the first K places of a stripe are its parts."""
    content: bytes


class PartHead(NamedTuple):
    """The beginning of a part."""

    cut: Cut
    number: int


def cut_file(
    size: int, length: int, digest: bytes, packing: int, most: int, redundancy: tuple[int, int] | None = None
) -> Cut:
    """The cut of a file of `size` bytes, `length` packed, into even parts of at most `most` bytes.

    `redundancy`: K and N; then the parts fill their stripes.
    """
    needed, shares = redundancy or (0, 0)
    parts = -(-length // most)
    if needed:
        parts = -(-parts // needed) * needed
    part_bytes = -(-length // parts)
    return Cut(packing, needed, shares, part_bytes, length, key_of(digest, packing, needed, shares, part_bytes, length))


def key_of(digest: bytes, packing: int, needed: int, shares: int, part_bytes: int, length: int) -> bytes:
    """The first 8 bytes of SHA-256 over the file's SHA-256 and its cut: the same file cut anew has the same parts."""
    from hashlib import sha256  # later than the command line, which loads this module: see `app.light`

    cut = _CUT.pack(_VERSION, packing, needed, shares, part_bytes, length)
    return sha256(digest + cut).digest()[:_KEY_BYTES]


def encode_manifest(m: Manifest) -> bytes:
    """`<BBBBIQ` version, packing, K, N, bytes of a part, bytes of the packed file; 8 bytes of key; `<BQ32sqiii` flags
    (1 time, 2 place), size, SHA-256, time, latitude, longitude, altitude; a byte with the length of the name, the name.

    Raises `ValueError` for a name that does not have 1..255 bytes.
    """
    name = m.name.encode(errors="replace")
    if not 1 <= len(name) <= MOST_NAME:
        raise ValueError(f"a name has 1 to {MOST_NAME} bytes, got {len(name)}")
    flags = (m.time is not None) * _HAS_TIME + (m.place is not None) * _HAS_PLACE
    lat, lon, alt = m.place or (0.0, 0.0, 0.0)
    file = _FILE.pack(
        flags, m.size, m.digest, round((m.time or 0.0) * 1000), round(lat * 1e7), round(lon * 1e7), _mm(alt)
    )
    return _cut_bytes(m.cut) + file + bytes([len(name)]) + name


def decode_manifest(payload: bytes) -> Manifest:
    """A manifest; what follows the name is of a later version. Raises `MalformedError`."""
    cut, at = _read_cut(payload)
    if len(payload) <= at + _FILE.size:
        raise MalformedError(f"truncated manifest: {len(payload)} bytes, expected at least {at + _FILE.size + 1}")
    flags, size, digest, time_ms, lat, lon, alt = _FILE.unpack_from(payload, at)
    at += _FILE.size
    name = payload[at + 1 : at + 1 + payload[at]]
    if not name or len(name) < payload[at]:
        raise MalformedError("truncated name of a file")
    if size > MOST_FILE or (cut.packing == PLAIN and size != cut.length):
        raise MalformedError(f"a file of {size} bytes in {cut.length}")
    if key_of(digest, *cut[:5]) != cut.key:
        raise MalformedError("the key of a manifest is not that of its file")
    placed = flags & _HAS_PLACE and abs(lat) <= _MOST_LAT and abs(lon) <= _MOST_LON
    return Manifest(
        cut, name.decode(errors="replace"), size, digest,
        time_ms / 1000 if flags & _HAS_TIME and abs(time_ms) <= _MOST_MS else None,
        (lat / 1e7, lon / 1e7, alt / 1e3) if placed else None,
    )  # fmt: skip


def encode_part(p: Part) -> bytes:
    """The cut as in a manifest, 8 bytes of key, `<I` the index, then the contents."""
    return _cut_bytes(p.cut) + _INDEX.pack(p.number) + p.content


def decode_head(payload: bytes) -> PartHead:
    """The beginning of a part. Raises `MalformedError`."""
    cut, at = _read_cut(payload)
    if len(payload) < at + _INDEX.size:
        raise MalformedError("truncated part")
    (index,) = _INDEX.unpack_from(payload, at)
    if index >= cut.end or not cut.size(index):
        raise MalformedError(f"part {index} of {cut.end}")
    return PartHead(cut, index)


def decode_part(payload: bytes) -> Part:
    """A part with its contents. Raises `MalformedError`."""
    cut, index = decode_head(payload)
    content = payload[PART_HEAD:]
    if len(content) != cut.size(index):
        raise MalformedError(f"part {index} has {len(content)} bytes, expected {cut.size(index)}")
    return Part(cut, index, content)


def _cut_bytes(cut: Cut) -> bytes:
    packing, needed, shares, part_bytes, length, key = cut
    return _CUT.pack(_VERSION, packing, needed, shares, part_bytes, length) + key


def _read_cut(payload: bytes) -> tuple[Cut, int]:
    """The cut, and where it ends."""
    at = _CUT.size + _KEY_BYTES
    if len(payload) < at:
        raise MalformedError(f"truncated cut of a file: {len(payload)} bytes, expected at least {at}")
    version, packing, needed, shares, part_bytes, length = _CUT.unpack_from(payload)
    if version != _VERSION or packing not in PACKINGS:
        raise MalformedError(f"file version {version}, packing {packing}: of a later version")
    if (needed or shares) and not 1 <= needed < shares:
        raise MalformedError(f"redundancy {needed}/{shares}")
    cut = Cut(packing, needed, shares, part_bytes, length, payload[_CUT.size : at])
    if not (1 <= part_bytes <= MOST_PART and 1 <= length <= MOST_FILE and cut.end <= MOST_PARTS):
        raise MalformedError(f"{length} bytes in parts of {part_bytes}")
    return cut, at


def _mm(metres: float) -> int:
    return max(-(1 << 31), min((1 << 31) - 1, round(metres * 1000)))
