"""How the ground's letters about a change of the link key travel, and rolls of those that a node has.

They are no messages of core: they are about links, and no participant sees them (docs/protocol.md).
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from typing import NamedTuple

from rass_mav.errors import MalformedError

from .codec import MORE, VERSION

#: The types, in the second byte.
LETTER, ROLL = 249, 248
#: Letters that one roll names.
MAX_NAMED = 35
#: The highest node id.
LAST_NODE = 65534

_LETTER_HEAD = bytes((VERSION << 4 | MORE, LETTER))
_ROLL_HEAD = bytes((VERSION << 4 | MORE, ROLL))
_HEADS = (_LETTER_HEAD, _ROLL_HEAD)
_ROLL = struct.Struct("<HIIIHHB")
_NAMED = struct.Struct("<HB")


class Roll(NamedTuple):
    """What a node says about its link key, and about the letters that it has for this key."""

    node_id: int
    """The sender, 0..65534."""
    serial: int
    """Its serial, 32 bits. 0: a base."""
    number: int
    """Of its link key, 32 bits. Who has a letter of a higher number for the sender sends it."""
    digest: int
    """Of the letters that the sender has for this key, 32 bits."""
    first: int = 1
    last: int = 0
    """Of the drones in this range of node ids, `named` are all of whose letters the sender has. The range may be
    empty."""
    named: Mapping[int, int] = {}
    """By node id, the mark of a letter, 0..255. At most `MAX_NAMED`."""


def is_about_keys(payload: bytes) -> bool:
    """Whether a TUNNEL payload begins like a letter or a roll of this version."""
    return payload[:2] in _HEADS


def is_letter(payload: bytes) -> bool:
    """Whether a TUNNEL payload begins like a letter of this version."""
    return payload[:2] == _LETTER_HEAD


def enclose(letter: bytes) -> bytes:
    """The TUNNEL payload with a letter."""
    return _LETTER_HEAD + letter


def enclosed(payload: bytes) -> bytes:
    """The letter in a TUNNEL payload for which `is_letter`, and what may follow it."""
    return payload[len(_LETTER_HEAD) :]


def encode_roll(roll: Roll) -> bytes:
    """The TUNNEL payload, 21 to 126 bytes. ValueError or struct.error: out of bounds, which is our bug."""
    if len(roll.named) > MAX_NAMED:
        raise ValueError("too much for one roll")
    parts = [_ROLL_HEAD, _ROLL.pack(*roll[:6], len(roll.named))]
    parts += (_NAMED.pack(*named) for named in roll.named.items())
    return b"".join(parts)


def decode_roll(payload: bytes) -> Roll:
    """The roll in a TUNNEL payload that `is_about_keys` and is no letter. Raises `MalformedError`, and nothing else."""
    at = len(_ROLL_HEAD)
    try:
        node_id, serial, number, digest, first, last, count = _ROLL.unpack_from(payload, at)
        if count > MAX_NAMED:
            raise MalformedError(f"a roll of {count} letters")
        at += _ROLL.size
        named = dict(_NAMED.unpack_from(payload, at + _NAMED.size * index) for index in range(count))
    except struct.error as error:
        raise MalformedError(f"truncated roll: {error}") from None
    return Roll(node_id, serial, number, digest, first, last, named)
