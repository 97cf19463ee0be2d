"""The payload of a datum of kind STATUS: what a node says about itself (docs/reference/payloads.md)."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from typing import NamedTuple

from rass_mav.errors import MalformedError

_HEAD = struct.Struct("<BBHHHHHBBii")
_NEIGHBOUR = struct.Struct("<HB")
_ORIGIN = struct.Struct("<HH")
_NUMBER = struct.Struct("<I")
_VERSION = 1
_HAS_POSITION = 1
_BASE = 2
_NEXT_HOP = 4
_LINK_KEY = 8
#: So many neighbours and origins fit one frame; of more, the next hop and the best heard, and those with
#: most data.
MOST_NEIGHBOURS = 10
MOST_ORIGINS = 9
_MOST_BYTES = _HEAD.size + 2 + MOST_NEIGHBOURS * _NEIGHBOUR.size + MOST_ORIGINS * _ORIGIN.size + _NUMBER.size
_MOST_LAT, _MOST_LON = 900_000_000, 1_800_000_000
_UNKNOWN_16, _UNKNOWN_8 = 0xFFFF, 0xFF


class NodeStatus(NamedTuple):
    """A node at the time of the datum. Its sequence number says how many data the node had created before it."""

    held: int
    """Data in custody; 0..65535, and the same for all counts."""
    alone: int
    """Those of them of which no other node keeps a copy for this one: they are lost if it fails."""
    spares: int
    """Copies that it keeps for others."""
    free: int | None
    """Data for which it has space; None: no limit."""
    risk: float
    """0..1, resolution 1/65535."""
    hops: int | None
    """To a base, 0..254; None: no route."""
    battery: int | None
    """Percent, 0..100; None: unknown."""
    place: tuple[float, float] | None
    """Latitude and longitude, degrees, resolution 1e-7; None: unknown."""
    neighbours: Mapping[int, float]
    """Node id -> share of its beacons that are heard, 0..1, resolution 1/255. At most `MOST_NEIGHBOURS`."""
    alone_by_origin: Mapping[int, int]
    """Node id -> how many of `alone` it created. At most `MOST_ORIGINS`; the rest are of others."""
    base: bool = False
    """Whether it is a base, where data are at their goal."""
    next_hop: int | None = None
    """Where its route leads, one of `neighbours`; None: nowhere, or the status does not say."""
    link_key: int | None = None
    """Number of its link key, 32 bits; None: its links are open, or the status does not say."""


def encode_status(s: NodeStatus, most: int = _MOST_BYTES) -> bytes:
    """`<BBHHHHHBBii` version, flags (1 position, 2 base, 4 next hop, 8 link key), held, alone, replicas, free, risk,
    hops, battery, latitude, longitude; a byte and so many neighbours (`<HB`); a byte and so many origins (`<HH`); with
    flag 8 the link key (`<I`).

    With flag 4 the first neighbour is the next hop. One that is not among the neighbours is not told. `most`: bytes, at
    least 44; if need be, fewer neighbours and origins are told.
    """
    lat, lon = (0.0, 0.0) if s.place is None else s.place
    neighbours = sorted(s.neighbours.items(), key=lambda item: (item[0] != s.next_hop, -item[1]))[:MOST_NEIGHBOURS]
    flags = (s.place is not None) * _HAS_POSITION + s.base * _BASE + (s.next_hop in s.neighbours) * _NEXT_HOP
    key = b""
    if s.link_key is not None:
        flags += _LINK_KEY
        key = _NUMBER.pack(s.link_key)
    origins = sorted(s.alone_by_origin.items(), key=lambda item: -item[1])[:MOST_ORIGINS]
    while _HEAD.size + 2 + len(neighbours) * _NEIGHBOUR.size + len(origins) * _ORIGIN.size + len(key) > most:
        (neighbours if len(neighbours) >= len(origins) else origins).pop()
    return b"".join(
        (
            _HEAD.pack(
                _VERSION, flags, _count(s.held), _count(s.alone), _count(s.spares),
                _UNKNOWN_16 if s.free is None else min(s.free, _UNKNOWN_16 - 1),
                round(s.risk * 65535), _UNKNOWN_8 if s.hops is None else min(s.hops, _UNKNOWN_8 - 1),
                _UNKNOWN_8 if s.battery is None else s.battery, round(lat * 1e7), round(lon * 1e7),
            ),
            bytes([len(neighbours)]),
            *(_NEIGHBOUR.pack(id, round(quality * 255)) for id, quality in neighbours),
            bytes([len(origins)]),
            *(_ORIGIN.pack(id, _count(count)) for id, count in origins),
            key,
        )
    )  # fmt: skip


def _count(number: int) -> int:
    return min(number, 65535)


def decode_status(payload: bytes) -> NodeStatus:
    """A node's status; what follows is of a later version. Raises `MalformedError`."""
    if len(payload) < _HEAD.size + 2:
        raise MalformedError(f"truncated status: {len(payload)} bytes, expected at least {_HEAD.size + 2}")
    try:
        version, flags, held, alone, spares, free, risk, hops, battery, lat, lon = _HEAD.unpack_from(payload)
        if version != _VERSION:
            raise MalformedError(f"status version {version}, ours is {_VERSION}")
        neighbours, at = _table(payload, _HEAD.size, _NEIGHBOUR)
        origins, at = _table(payload, at, _ORIGIN)
        link_key = _NUMBER.unpack_from(payload, at)[0] if flags & _LINK_KEY else None
    except (struct.error, IndexError):
        raise MalformedError("truncated status") from None
    return NodeStatus(
        held,
        alone,
        spares,
        None if free == _UNKNOWN_16 else free,
        risk / 65535,
        None if hops == _UNKNOWN_8 else hops,
        battery if battery <= 100 else None,
        (lat / 1e7, lon / 1e7) if flags & _HAS_POSITION and abs(lat) <= _MOST_LAT and abs(lon) <= _MOST_LON else None,
        {id: quality / 255 for id, quality in neighbours},
        dict(origins),
        bool(flags & _BASE),
        neighbours[0][0] if flags & _NEXT_HOP and neighbours else None,
        link_key,
    )


def _table(payload: bytes, at: int, row: struct.Struct) -> tuple[list[tuple[int, int]], int]:
    """The rows of a table that begins with their number, and where it ends."""
    count = payload[at]
    rows = [row.unpack_from(payload, at + 1 + index * row.size) for index in range(count)]
    return [(first, second) for first, second in rows], at + 1 + count * row.size
