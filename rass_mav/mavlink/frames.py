"""MAVLink 2 frames, and how a component writes them.

Layout (https://mavlink.io/en/guide/serialization.html), little-endian: magic 0xFD, payload length, incompatibility
flags, compatibility flags, sequence, system id, component id (one byte each), message id (3 bytes), payload
(0..255 bytes, trailing zeros trimmed), checksum (2 bytes), signature (13 bytes, only with incompatibility flag 1).
"""

from __future__ import annotations

import struct
from typing import NamedTuple, TypeAlias

from .crc import crc16
from .dialect import FORMATS, MavlinkMessage, common, payload_of
from .signing import SIGNATURE_SIZE, Signer

MAGIC_V2 = 0xFD
MAGIC_V1 = 0xFE
#: Incompatibility flag: the frame carries a signature.
FLAG_SIGNED = 0x01
#: The most bytes that a TUNNEL message carries.
TUNNEL_MAX = 128

TUNNEL_ID: int = common.MAVLINK_MSG_ID_TUNNEL
TUNNEL_EXTRA = FORMATS[TUNNEL_ID].crc_extra
_TUNNEL_ID_BYTES = TUNNEL_ID.to_bytes(3, "little")

_HEADER = struct.Struct("<BBBBBBBHB")
# The header, and TUNNEL's fields before its 128 bytes: payload_type, target_system, target_component, payload_length.
_TUNNEL_FIELDS = struct.Struct("<HBBB")
_TUNNEL_HEADER = struct.Struct("<BBBBBBBHBHBBB")


#: System id, component id and link id: timestamps of signatures rise in each stream (0..255 each).
Stream: TypeAlias = tuple[int, int, int]


class Frame(NamedTuple):
    """A received frame with a good checksum."""

    message_id: int
    """0..2^24 - 1."""
    sequence: int
    """The sender's frame counter, 0..255."""
    system_id: int
    """0..255."""
    component_id: int
    """0..255."""
    payload: bytes
    """As on the wire: MAVLink 2 trims trailing zeros."""
    signed: bool
    """The frame carried a signature. Whether it was checked depends on the reader's `SignatureCheck`."""
    link_id: int = 0
    """Of the signature, 0..255."""
    timestamp: int = 0
    """Of the signature, 48 bits."""
    mavlink: int = 2
    """Version of MAVLink, 1 or 2. Version 1 has no signatures, whether the sender has a key or not."""

    @property
    def stream(self) -> Stream:
        """Whose timestamps those of this frame are, if it is signed."""
        return self.system_id, self.component_id, self.link_id

    @property
    def size(self) -> int:
        """Bytes on the wire, if it is a frame of MAVLink 2."""
        return _HEADER.size + len(self.payload) + 2 + (SIGNATURE_SIZE if self.signed else 0)


def timestamp_of(frame: bytes) -> int | None:
    """The timestamp of a whole frame with a signed TUNNEL message; None: it is none."""
    if frame[0] != MAGIC_V2 or not frame[2] & FLAG_SIGNED or frame[7:10] != _TUNNEL_ID_BYTES:
        return None
    return int.from_bytes(frame[-12:-6], "little")


class FrameWriter:
    """Writes the frames of one component. All messages share one sequence.

    `system_id` and `component_id` (0..255) may be changed between frames.
    """

    __slots__ = ("component_id", "flags", "sequence", "signer", "system_id", "tunnel_flags")

    def __init__(self, system_id: int, component_id: int, signer: Signer | None = None) -> None:
        """:param signer: signs each frame; None: frames are unsigned."""
        self.system_id = system_id
        self.component_id = component_id
        self.signer = signer
        self.tunnel_flags = 0 if signer is None else FLAG_SIGNED
        """Incompatibility flags of TUNNEL messages. `FLAG_SIGNED` without a signer: somebody else appends the
        signature, when the frame leaves."""
        self.flags = 0
        """Those of all other messages, where there is no signer."""
        self.sequence = 0
        """Sequence number of the next frame, 0..255."""

    def tunnel(self, data: bytes, *, payload_type: int, target_system: int = 0, target_component: int = 0) -> bytes:
        """A whole frame with a TUNNEL message (385, https://mavlink.io/en/messages/common.html#TUNNEL).

        :param data: 0..128 bytes.
        :param payload_type: 0..65535; above 32767 for local use.
        :param target_system: 0: everybody.
        :param target_component: 0: every component.
        :returns: 13..145 bytes, signed 26..158.
        :raises ValueError: more than 128 bytes.
        :raises struct.error: a number out of range.
        """
        size = len(data)
        if size > TUNNEL_MAX:
            raise ValueError(f"a TUNNEL carries at most {TUNNEL_MAX} bytes, not {size}")
        content = data.rstrip(b"\0")
        if not content:
            # Trimming continues into the fields. This is too rare to need a fast path.
            return self.frame(TUNNEL_ID, _TUNNEL_FIELDS.pack(payload_type, target_system, target_component, size))
        signer = self.signer
        sequence = self.sequence
        frame = _TUNNEL_HEADER.pack(
            MAGIC_V2, len(content) + 5, self.tunnel_flags, 0, sequence, self.system_id, self.component_id, TUNNEL_ID, 0,
            payload_type, target_system, target_component, size,
        ) + content  # fmt: skip
        frame += crc16(frame[1:] + TUNNEL_EXTRA).to_bytes(2, "little")
        self.sequence = (sequence + 1) & 0xFF
        return frame if signer is None else signer.sign(frame)

    def message(self, message: MavlinkMessage) -> bytes:
        """A whole frame with a pymavlink message object, whose fields pymavlink packs.

        :raises struct.error: a field is out of range.
        """
        return self.frame(message.get_msgId(), payload_of(message))

    def frame(self, message_id: int, payload: bytes) -> bytes:
        """A whole frame with a packed payload, which may still have trailing zeros.

        :param message_id: of the common dialect (others raise KeyError: their CRC_EXTRA is unknown).
        :param payload: 0..255 bytes.
        :raises struct.error: a longer payload.
        """
        # At least one byte stays, even if it is zero.
        payload = payload.rstrip(b"\0") or payload[:1]
        signer = self.signer
        sequence = self.sequence
        flags = self.tunnel_flags if message_id == TUNNEL_ID else self.flags if signer is None else FLAG_SIGNED
        frame = _HEADER.pack(
            MAGIC_V2, len(payload), flags, 0, sequence, self.system_id, self.component_id,
            message_id & 0xFFFF, message_id >> 16,
        ) + payload  # fmt: skip
        frame += crc16(frame[1:] + FORMATS[message_id].crc_extra).to_bytes(2, "little")
        self.sequence = (sequence + 1) & 0xFF
        return frame if signer is None else signer.sign(frame)
