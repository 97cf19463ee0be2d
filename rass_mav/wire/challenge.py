"""Challenges and their answers, which prove that a stream of signed frames is there now (docs/protocol.md).

They are no messages of core: they are about links, and no participant sees them.
"""

from __future__ import annotations

import struct
from typing import NamedTuple

from rass_mav.errors import MalformedError

from .codec import MORE, VERSION

#: The type, in the second byte: the last one, since the others count from below.
CHALLENGE = 255
#: Streams in one challenge, and nonces of others in it. Together they fit one TUNNEL.
MAX_ASKED, MAX_ANSWERED = 8, 5

_HEAD = bytes((VERSION << 4 | MORE, CHALLENGE))
_COUNTS = struct.Struct("<BB")
_ASKED = struct.Struct("<BBB6s")
_NONCE = struct.Struct("<Q")


class Asked(NamedTuple):
    """A stream that is asked to answer."""

    stream: tuple[int, int, int]
    """System id, component id and link id, 0..255 each."""
    highest: int
    """The highest timestamp of this stream that the sender has seen, rightly signed: 48 bits."""


class Challenge(NamedTuple):
    """What a node asks of others, and what it answers them."""

    asked: tuple[Asked, ...] = ()
    """At most `MAX_ASKED`."""
    nonce: int = 0
    """What they should send back, 64 bits. Without a meaning if nobody is asked."""
    answered: tuple[int, ...] = ()
    """The nonces of others, at most `MAX_ANSWERED`."""


def is_challenge(payload: bytes) -> bool:
    """Whether a TUNNEL payload begins like a challenge of this version."""
    return payload[:2] == _HEAD


def encode_challenge(challenge: Challenge) -> bytes:
    """The TUNNEL payload, 12 to 124 bytes. ValueError or struct.error: out of bounds, which is our bug."""
    asked, nonce, answered = challenge
    if len(asked) > MAX_ASKED or len(answered) > MAX_ANSWERED:
        raise ValueError("too much for one challenge")
    parts = [_HEAD, _COUNTS.pack(len(asked), len(answered))]
    parts += (_ASKED.pack(*stream, highest.to_bytes(6, "little")) for stream, highest in asked)
    if asked:
        parts.append(_NONCE.pack(nonce))
    parts += map(_NONCE.pack, answered)
    return b"".join(parts)


def decode_challenge(payload: bytes) -> Challenge:
    """The challenge in a TUNNEL payload for which `is_challenge`. Raises `MalformedError`, and nothing else."""
    try:
        asked, answered = _COUNTS.unpack_from(payload, len(_HEAD))
        if asked > MAX_ASKED or answered > MAX_ANSWERED:
            raise MalformedError(f"a challenge of {asked} streams with {answered} answers")
        at = len(_HEAD) + _COUNTS.size
        streams = []
        for _ in range(asked):
            *stream, highest = _ASKED.unpack_from(payload, at)
            streams.append(Asked((stream[0], stream[1], stream[2]), int.from_bytes(highest, "little")))
            at += _ASKED.size
        nonces = [_NONCE.unpack_from(payload, at + _NONCE.size * index)[0] for index in range(bool(asked) + answered)]
    except struct.error as error:
        raise MalformedError(f"truncated challenge: {error}") from None
    return Challenge(tuple(streams), nonces.pop(0) if asked else 0, tuple(nonces))
