"""Files of which some data may be lost: Reed-Solomon codes by stripes (docs/how-to/files.md).

Each stripe has K parts, and N - K more shares that are computed from them. Any K of the N give the parts back. What
lies beyond the end of the file counts as zeros, which everybody has.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from rass_mav.errors import ConfigError, RassError, installing
from rass_mav.wire.file import Cut

#: The most shares of a stripe that are created: a node computes them in memory.
MOST_SHARES = 64


def parse_redundancy(text: str) -> tuple[int, int]:
    """K and N of `K/N`. Raises `ConfigError`."""
    needed, slash, shares = text.partition("/")
    if not (slash and needed.isdecimal() and shares.isdecimal() and 1 <= int(needed) < int(shares) <= MOST_SHARES):
        raise ConfigError(
            f"--redundancy: expected K/N (any K of N parts suffice), 1 <= K < N <= {MOST_SHARES}, got {text!r}"
        )
    _zfec()
    return int(needed), int(shares)


def shares_of(pieces: Iterator[bytes], cut: Cut) -> Iterator[bytes]:
    """The contents of all data of a packed file that comes in pieces, in the order of their indexes."""
    if not cut.needed:
        yield from pieces
        return
    encoder = _zfec().Encoder(cut.needed, cut.shares)
    computed = tuple(range(cut.needed, cut.shares))
    for stripe in _stripes(pieces, cut.needed * cut.part_bytes):
        yield stripe
        yield from encoder.encode(_blocks(stripe, cut), computed)


def _stripes(pieces: Iterator[bytes], size: int) -> Iterator[bytes]:
    waiting = bytearray()
    for piece in pieces:
        waiting += piece
        while len(waiting) >= size:
            yield bytes(waiting[:size])
            del waiting[:size]
    if waiting:
        yield bytes(waiting)


def _blocks(stripe: bytes, cut: Cut) -> list[bytes]:
    """The parts of a stripe, with zeros to the end."""
    each = cut.part_bytes
    return [stripe[at : at + each].ljust(each, b"\0") for at in range(0, cut.needed * each, each)]


def restored(shares: Mapping[int, bytes], stripe: int, cut: Cut) -> bytes | None:
    """The parts of a stripe, from its shares by their place in it; None: there are too few. Raises `RassError`: the
    package is missing."""
    own = min(cut.needed, cut.parts - stripe * cut.needed)
    if not all(place in shares for place in range(own)):
        zeros = {place: bytes(cut.part_bytes) for place in range(own, cut.needed)}
        by_place = {**{place: share.ljust(cut.part_bytes, b"\0") for place, share in shares.items()}, **zeros}
        if len(by_place) < cut.needed:
            return None
        places = sorted(by_place)[: cut.needed]
        blocks = _zfec().Decoder(cut.needed, cut.shares).decode([by_place[place] for place in places], places)
    else:
        blocks = [shares[place] for place in range(own)]
    size = min(cut.needed * cut.part_bytes, cut.length - stripe * cut.needed * cut.part_bytes)
    return b"".join(blocks)[:size]


def _zfec() -> Any:
    try:
        import zfec
    except ImportError:
        raise RassError(f"redundancy needs the Python package zfec: {installing('redundancy')}") from None
    return zfec
