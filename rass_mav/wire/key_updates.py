"""How the ground's key updates about a change of the link key travel, and key requests of nodes that have missed some.

They are no messages of core: they are about links, and no participant sees them (docs/reference/protocol-keys.md).
"""

from __future__ import annotations

import struct

from rass_mav.errors import MalformedError

from .codec import MORE_HEAD
from .generated_keyed import KEY_REQUEST, KEY_UPDATE, encode_key_request
from .generated_keyed import decode_key_request as _decode
from .keyed_records import KeyRequest

__all__ = [
    "KEY_REQUEST", "KEY_UPDATE", "KeyRequest", "decode_key_request", "enclose", "enclosed",
    "encode_key_request", "is_about_keys", "is_key_update",
]  # fmt: skip

_KEY_UPDATE_HEAD = MORE_HEAD + bytes([KEY_UPDATE])
_HEADS = (_KEY_UPDATE_HEAD, MORE_HEAD + bytes([KEY_REQUEST]))


def is_about_keys(payload: bytes) -> bool:
    """Whether a TUNNEL payload begins like a key update or a key request of this version."""
    return payload[:2] in _HEADS


def is_key_update(payload: bytes) -> bool:
    """Whether a TUNNEL payload begins like a key update of this version."""
    return payload[:2] == _KEY_UPDATE_HEAD


def enclose(key_update: bytes) -> bytes:
    """The TUNNEL payload with a key update."""
    return _KEY_UPDATE_HEAD + key_update


def enclosed(payload: bytes) -> bytes:
    """The key update in a TUNNEL payload for which `is_key_update`, and what may follow it."""
    return payload[len(_KEY_UPDATE_HEAD) :]


def decode_key_request(payload: bytes) -> KeyRequest:
    """The key request in a TUNNEL payload that `is_about_keys` and is no key update. Raises `MalformedError`, and
    nothing else."""
    try:
        return _decode(payload)
    except struct.error as error:
        raise MalformedError(f"truncated key request: {error}") from None
