"""The only module that imports pymavlink: its generated `common` dialect, never `mavutil` (24 MiB more)."""

from __future__ import annotations

from typing import Any, NamedTuple, TypeAlias

from pymavlink.dialects.v20 import common

__all__ = ["FORMATS", "MavlinkMessage", "MessageFormat", "common", "forget_texts", "payload_of"]

#: A message object of pymavlink (`MAVLink_..._message`). pymavlink has no types of its own.
MavlinkMessage: TypeAlias = Any


class MessageFormat(NamedTuple):
    """What a reader must know about a message to check its frame."""

    crc_extra: bytes
    """One byte that enters the checksum after the payload: a digest of the message's definition."""
    size: int
    """Size of the whole payload in bytes, including extension fields, before zeros are trimmed."""


#: Format of each message of the dialect, by message id.
FORMATS: dict[int, MessageFormat] = {
    message_id: MessageFormat(bytes((definition.crc_extra,)), definition.unpacker.size)
    for message_id, definition in common.mavlink_map.items()
}

# `pack` needs it for its state (no signing). It never sends, so it never changes.
_PACKER = common.MAVLink(None)


def forget_texts() -> None:
    """Free pymavlink's descriptions of enumerations, 1 MiB, which are for programs that explain messages to people.

    Call it at the start of a process that only runs a node; modules loaded afterwards use the memory. Do not call it in
    a process where other code may use pymavlink.
    """
    common.enums.clear()


def payload_of(message: MavlinkMessage) -> bytes:
    """The payload of a pymavlink message, packed by pymavlink, with trailing zeros trimmed.

    :raises struct.error: a field is out of range (a mistake of the caller).
    """
    frame: bytes = message.pack(_PACKER)
    return frame[10:-2]
