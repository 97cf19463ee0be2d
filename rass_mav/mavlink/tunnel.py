"""Reads TUNNEL messages, which carry everything that nodes send to each other."""

from __future__ import annotations

import struct
from typing import NamedTuple

from rass_mav.errors import MalformedError

from .crc import crc16
from .frames import FLAG_SIGNED, MAGIC_V2, TUNNEL_EXTRA, TUNNEL_MAX
from .signing import SIGNATURE_SIZE

_FIELDS = struct.Struct("<HBBB")
#: Bytes of a TUNNEL message before the payload of the tunnel.
TUNNEL_AHEAD = _FIELDS.size
# Size of a frame without its payload, and with the fields before the data, in bytes.
_AROUND = 12
_AHEAD = _AROUND + _FIELDS.size
_LARGEST = _AHEAD + TUNNEL_MAX
_TUNNEL_ID = b"\x81\x01\x00"
_SIGNED = bytes((FLAG_SIGNED,))

# By the length of the frame up to its checksum, from the smallest with all fields: one struct that unpacks it, and the
# first two bytes (magic, payload length) that such a frame must have.
_SHAPES = [
    (struct.Struct(f"<2sBxxBB3sHBBB{length - _AHEAD}sH").unpack, bytes((MAGIC_V2, length - _AROUND)), length - _AHEAD)
    for length in range(_AHEAD, _LARGEST + 1)
]


class TunnelFields(NamedTuple):
    """The fields of a TUNNEL message (https://mavlink.io/en/messages/common.html#TUNNEL)."""

    target_system: int
    """0: everybody."""
    target_component: int
    """0: every component."""
    payload_type: int
    """0..65535."""
    payload: bytes
    """`payload_length` bytes, 0..128."""


def decode_tunnel(payload: bytes) -> TunnelFields:
    """The fields of a TUNNEL message, from its MAVLink payload as on the wire (zeros trimmed).

    Bytes after the 133 that we know belong to a newer version and are ignored.

    :raises MalformedError: `payload_length` is more than 128.
    """
    payload_type, target_system, target_component, length = _FIELDS.unpack_from(payload.ljust(_FIELDS.size, b"\0"))
    if length > TUNNEL_MAX:
        raise MalformedError(f"TUNNEL with payload_length {length}")
    data = payload[_FIELDS.size : _FIELDS.size + length].ljust(length, b"\0")
    return TunnelFields(target_system, target_component, payload_type, data)


def tunnel_from_datagram(data: bytes) -> tuple[int, int, int, int, int, bytes] | None:
    """A short cut from a datagram to a node's TUNNEL message. It does not check signatures.

    :returns: (system id, component id, target system, target component, payload type, payload of 0..128 bytes) if
        `data` is exactly one MAVLink 2 frame with a TUNNEL message and a good checksum. None for anything else, valid
        or not: then pass it to a `FrameReader`, which also counts it.
    """
    signed = data[2:3] == _SIGNED
    if signed:
        data = data[:-SIGNATURE_SIZE]
    size = len(data)
    if not _AHEAD <= size <= _LARGEST:
        return _tiny_tunnel(data, signed)
    unpack, prefix, held = _SHAPES[size - _AHEAD]
    (
        start, flags, system_id, component_id, message_id,
        payload_type, target_system, target_component, length, payload, crc,
    ) = unpack(data)  # fmt: skip
    if (
        start != prefix
        or flags != signed
        or message_id != _TUNNEL_ID
        or length > TUNNEL_MAX
        or crc16(data[1:-2] + TUNNEL_EXTRA) != crc
    ):
        return None
    if length != held:
        # Restore trimmed zeros, and drop bytes beyond payload_length.
        payload = payload[:length].ljust(length, b"\0")
    return system_id, component_id, target_system, target_component, payload_type, payload


def _tiny_tunnel(data: bytes, signed: bool) -> tuple[int, int, int, int, int, bytes] | None:
    """The same for frames so short that even the fields were trimmed (`payload_length` is 0, or all data are zeros)."""
    size = len(data)
    if (
        not _AROUND <= size < _AHEAD
        or data[:3] != bytes((MAGIC_V2, size - _AROUND, signed))
        or data[7:10] != _TUNNEL_ID
        or crc16(data[1:-2] + TUNNEL_EXTRA) != int.from_bytes(data[-2:], "little")
    ):
        return None
    fields = decode_tunnel(data[10:-2])
    return data[5], data[6], fields.target_system, fields.target_component, fields.payload_type, fields.payload
