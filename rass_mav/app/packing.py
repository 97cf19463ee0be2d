"""How files are compressed: zstd where Python or a package has it, zlib otherwise (docs/how-to/files.md)."""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Iterator
from contextlib import suppress
from importlib import import_module
from types import ModuleType
from typing import Protocol

from rass_mav.errors import MalformedError, RassError, installing
from rass_mav.wire.file import PLAIN, ZLIB, ZSTD

#: Bytes that are unpacked at a time.
PIECE = 1 << 16
# The memory of a stream that is unpacked, as a power of two. `packer` needs 2 MiB; RFC 8878 asks for 8 MiB.
_ZSTD_WINDOW = 23


class Packer(Protocol):
    """Compresses a stream."""

    def compress(self, data: bytes, /) -> bytes:
        """The next bytes."""

    def flush(self) -> bytes:
        """The last bytes."""


class _Plain:
    """Leaves a stream as it is."""

    def compress(self, data: bytes, /) -> bytes:
        return data

    def flush(self) -> bytes:
        return b""


def best() -> int:
    """The packing to use here."""
    return ZLIB if _zstd() is None else ZSTD


def packer(packing: int) -> Packer:
    """A new stream of one of `PACKINGS`. It packs the same file to the same bytes each time."""
    if packing == PLAIN:
        return _Plain()
    if packing == ZLIB:
        return zlib.compressobj()
    found: Packer = _needed_zstd().ZstdCompressor()
    return found


def unpacked(pieces: Iterable[bytes], packing: int, size: int) -> Iterator[bytes]:
    """The file of `size` bytes in packed pieces, in pieces of at most `PIECE` or as large as they came.

    Raises `MalformedError` for what was not packed so, or has more bytes; `RassError` if zstd is needed, and missing.
    """
    found = 0
    for data in _unpacked(pieces, packing):
        found += len(data)
        if found > size:
            raise MalformedError(f"larger than the stated {size} bytes")
        yield data


def _unpacked(pieces: Iterable[bytes], packing: int) -> Iterator[bytes]:
    if packing == PLAIN:
        yield from pieces
    elif packing == ZLIB:
        yield from _unpacked_zlib(pieces)
    else:
        yield from _unpacked_zstd(pieces, _needed_zstd())


def _unpacked_zlib(pieces: Iterable[bytes]) -> Iterator[bytes]:
    unpacker = zlib.decompressobj()
    try:
        for piece in pieces:
            while piece and not unpacker.eof:
                yield unpacker.decompress(piece, PIECE)
                piece = unpacker.unconsumed_tail
    except zlib.error as error:
        raise MalformedError(f"not packed with zlib: {error}") from None
    if not unpacker.eof:
        raise MalformedError("packed with zlib, but truncated")


def _unpacked_zstd(pieces: Iterable[bytes], zstd: ModuleType) -> Iterator[bytes]:
    unpacker = zstd.ZstdDecompressor(options={zstd.DecompressionParameter.window_log_max: _ZSTD_WINDOW})
    try:
        for piece in pieces:
            if unpacker.eof:
                break
            yield unpacker.decompress(piece, PIECE)
            while not unpacker.eof and not unpacker.needs_input:
                yield unpacker.decompress(b"", PIECE)
    except zstd.ZstdError as error:
        raise MalformedError(f"not packed with zstd: {error}") from None
    if not unpacker.eof:
        raise MalformedError("packed with zstd, but truncated")


def _zstd() -> ModuleType | None:
    """Python 3.14 has it; for older ones there is a package with the same functions."""
    for name in ("compression.zstd", "backports.zstd"):
        with suppress(ImportError):
            return import_module(name)
    return None


def _needed_zstd() -> ModuleType:
    found = _zstd()
    if found is None:
        raise RassError(f"packed with zstd, which needs Python 3.14 or newer, or: {installing('zstd')}")
    return found
