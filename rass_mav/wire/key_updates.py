"""How the ground's key updates about a change of the link key travel, and key summaries of those that a node has.

They are no messages of core: they are about links, and no participant sees them (docs/protocol.md).
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from typing import NamedTuple

from rass_mav.errors import MalformedError

from .codec import MORE, VERSION

#: The types, in the second byte.
KEY_UPDATE, KEY_SUMMARY = 249, 248
#: Key updates that one key summary names.
MAX_NAMED = 35
#: The highest node id.
LAST_NODE = 65534

_KEY_UPDATE_HEAD = bytes((VERSION << 4 | MORE, KEY_UPDATE))
_KEY_SUMMARY_HEAD = bytes((VERSION << 4 | MORE, KEY_SUMMARY))
_HEADS = (_KEY_UPDATE_HEAD, _KEY_SUMMARY_HEAD)
_KEY_SUMMARY = struct.Struct("<HIIIHHB")
_NAMED = struct.Struct("<HB")


class KeySummary(NamedTuple):
    """What a node says about its link key, and about the key updates that it has for this key."""

    node_id: int
    """The sender, 0..65534."""
    serial: int
    """Its serial, 32 bits. 0: a base."""
    number: int
    """Of its link key, 32 bits. Who has a key update of a higher number for the sender sends it."""
    updates_hash: int
    """Of the key updates that the sender has for this key, 32 bits."""
    first: int = 1
    last: int = 0
    """Of the drones in this range of node ids, `named` are all of whose key updates the sender has. The range may be
    empty."""
    named: Mapping[int, int] = {}
    """By node id, the mark of a key update, 0..255. At most `MAX_NAMED`."""


def is_about_keys(payload: bytes) -> bool:
    """Whether a TUNNEL payload begins like a key update or a key summary of this version."""
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


def encode_key_summary(key_summary: KeySummary) -> bytes:
    """The TUNNEL payload, 21 to 126 bytes. ValueError or struct.error: out of bounds, which is our bug."""
    if len(key_summary.named) > MAX_NAMED:
        raise ValueError("too much for one key summary")
    parts = [_KEY_SUMMARY_HEAD, _KEY_SUMMARY.pack(*key_summary[:6], len(key_summary.named))]
    parts += (_NAMED.pack(*named) for named in key_summary.named.items())
    return b"".join(parts)


def decode_key_summary(payload: bytes) -> KeySummary:
    """The key summary in a TUNNEL payload that `is_about_keys` and is no key update. Raises `MalformedError`, and
    nothing else."""
    at = len(_KEY_SUMMARY_HEAD)
    try:
        node_id, serial, number, updates_hash, first, last, count = _KEY_SUMMARY.unpack_from(payload, at)
        if count > MAX_NAMED:
            raise MalformedError(f"a key summary of {count} key updates")
        at += _KEY_SUMMARY.size
        named = dict(_NAMED.unpack_from(payload, at + _NAMED.size * index) for index in range(count))
    except struct.error as error:
        raise MalformedError(f"truncated key summary: {error}") from None
    return KeySummary(node_id, serial, number, updates_hash, first, last, named)
