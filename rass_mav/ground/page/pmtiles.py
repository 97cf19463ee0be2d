"""A file of map tiles as PMTiles, version 3 (https://github.com/protomaps/PMTiles/blob/main/spec/v3/spec.md).

The package `pmtiles` reads such files too. It sets no limits to what a damaged or forged file makes it unpack, and
unpacks the directories again for each tile.
"""

from __future__ import annotations

import json
import os
import struct
import zlib
from array import array
from bisect import bisect_right
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

from rass_mav.errors import ConfigError, MalformedError, os_errors_as

#: How such a file begins.
MAGIC = b"PMTiles"
_VERSION = 3
# Where and how long the root directory, the metadata, the leaf directories and the tiles are, and three counts;
# whether tiles are in order, two kinds of compression, the kind of tiles; the zooms; west, south, east and north.
_HEADER = struct.Struct("<7xB11Q4x2B4i9x")
_COMPRESSION_AT = 97
_PLAIN, _GZIP = 1, 2
# What a directory or the metadata may be at most, unpacked, bytes; writers make directories of some ten thousand.
_MOST_BYTES = 1 << 20
# The root directory, and leaves of leaves: so many levels, and so many directories that are kept unpacked.
_MOST_DEPTH = 4
_KEPT = 8
_MOST_BITS = 64


class Directory(NamedTuple):
    """Where tiles are: columns of the same length, in the order of the tiles' numbers."""

    numbers: array[int]
    """Of the first tile of each row."""
    runs: array[int]
    """So many tiles in a row are this one; 0: a further directory is there."""
    lengths: array[int]
    """Bytes."""
    offsets: array[int]
    """From the beginning of the tiles, or of the leaf directories."""


class PMTiles:
    """The tiles of a file. Any thread may use it, one at a time."""

    def __init__(self, path: Path) -> None:
        """Raises `ConfigError`: it is damaged, of another version, or has no tiles."""
        with os_errors_as(ConfigError, path):
            self._file = path.open("rb")
        try:
            self._open()
        except MalformedError as error:
            self._file.close()
            raise ConfigError(f"{path}: {error}") from None

    def _open(self) -> None:
        self._size = os.fstat(self._file.fileno()).st_size
        header = self._read(0, _HEADER.size)
        version, *places, least, most, west, south, east, north = _HEADER.unpack(header)
        if version != _VERSION:
            raise MalformedError(f"PMTiles version {version}, ours is {_VERSION}: convert it with `pmtiles convert`")
        self._packed = header[_COMPRESSION_AT] == _GZIP
        if header[_COMPRESSION_AT] not in (_PLAIN, _GZIP):
            raise MalformedError("its directories are not compressed with gzip")
        self._root = places[0], places[1]
        self._leaves_at, self._tiles_at = places[4], places[6]
        self._directory = lru_cache(_KEPT)(self._unpacked_directory)
        if not self._directory(*self._root).numbers:
            raise MalformedError("it contains no tiles")
        self.zooms = least, most
        self.bounds = [degrees / 1e7 for degrees in (west, south, east, north)]
        self.attribution = self._attribution(places[2], places[3])

    def _attribution(self, at: int, length: int) -> str:
        try:
            named = json.loads(self._unpacked(at, length)) if length else {}
        except (ValueError, RecursionError):
            raise MalformedError("its metadata is not JSON") from None
        return str(named.get("attribution", "")) if isinstance(named, dict) else ""

    def sample(self, most: int) -> bytes | None:
        """Some tile. None: it has more than `most` bytes, or the file is damaged."""
        return self._tile(self._directory(*self._root).numbers[0], most)

    def get(self, zoom: int, x: int, y: int, most: int) -> bytes | None:
        """The tile with the usual numbers (rows counted from the north). None: there is none, it has more than `most`
        bytes, or the file is damaged there."""
        return self._tile(tile_number(zoom, x, y), most)

    def _tile(self, number: int, most: int) -> bytes | None:
        at, length = self._root
        try:
            for _ in range(_MOST_DEPTH):
                found = self._directory(at, length)
                row = bisect_right(found.numbers, number) - 1
                if row < 0:
                    return None
                run, length = found.runs[row], found.lengths[row]
                if run:
                    here = number - found.numbers[row] < run and length <= most
                    return self._read(self._tiles_at + found.offsets[row], length) if here else None
                at = self._leaves_at + found.offsets[row]
        except MalformedError:
            return None
        return None

    def _unpacked_directory(self, at: int, length: int) -> Directory:
        numbers = varints(self._unpacked(at, length))
        count = numbers[0] if numbers else 0
        if len(numbers) < 1 + 4 * count:
            raise MalformedError("a truncated directory")
        steps, runs, lengths, places = (numbers[1 + count * n : 1 + count * (n + 1)] for n in range(4))
        ids, offsets = array("Q"), array("Q")
        last = end = 0
        try:
            for step, length, place in zip(steps, lengths, places, strict=True):
                last += step
                ids.append(last)
                # 0: behind the one before.
                offsets.append(place - 1 if place else end)
                end = offsets[-1] + length
        except OverflowError:
            raise MalformedError("a damaged directory") from None
        return Directory(ids, runs, lengths, offsets)

    def _unpacked(self, at: int, length: int) -> bytes:
        if length > _MOST_BYTES:
            raise MalformedError("a directory or metadata that are too long")
        plain = self._read(at, length)
        if not self._packed:
            return plain
        unpacker = zlib.decompressobj(wbits=31)
        try:
            plain = unpacker.decompress(plain, _MOST_BYTES)
        except zlib.error as error:
            raise MalformedError(f"not gzip: {error}") from None
        if not unpacker.eof:
            raise MalformedError("a directory or metadata that are truncated, or too long")
        return plain

    def _read(self, at: int, length: int) -> bytes:
        if at + length > self._size:
            raise MalformedError("truncated")
        with os_errors_as(MalformedError, "it cannot be read"):
            found = os.pread(self._file.fileno(), length, at)
        if len(found) < length:
            raise MalformedError("truncated")
        return found

    def close(self) -> None:
        """Release the file."""
        self._file.close()


def tile_number(zoom: int, x: int, y: int) -> int:
    """The number of a tile: zoom by zoom, along a Hilbert curve."""
    number = ((1 << 2 * zoom) - 1) // 3
    for level in reversed(range(zoom)):
        side = 1 << level
        east, south = x & side > 0, y & side > 0
        number += (3 * east ^ south) << 2 * level
        x, y = x & side - 1, y & side - 1
        if not south:
            x, y = (side - 1 - y, side - 1 - x) if east else (y, x)
    return number


def varints(packed: bytes) -> array[int]:
    """Numbers of 7 bits each byte, the lowest first. Raises `MalformedError`: one has more than 64 bits."""
    numbers = array("Q")
    value = shift = 0
    for byte in packed:
        value |= (byte & 0x7F) << shift
        if byte & 0x80:
            shift += 7
            if shift >= _MOST_BITS:
                raise MalformedError("a number that is too large")
        elif value >> _MOST_BITS:
            raise MalformedError("a number that is too large")
        else:
            numbers.append(value)
            value = shift = 0
    return numbers
