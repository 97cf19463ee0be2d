"""The one place where pymavlink is imported: its generated `common` dialect, never `mavutil` (24 MiB more)."""

from __future__ import annotations

from typing import Any, NamedTuple, TypeAlias

from pymavlink.dialects.v20 import common

__all__ = ["FORMATS", "MavlinkMessage", "MessageFormat", "common", "forget_texts", "payload_of"]

#: A message object of pymavlink (`MAVLink_..._message`). pymavlink has no types of its own.
MavlinkMessage: TypeAlias = Any


class MessageFormat(NamedTuple):
    """What a reader must know of a message to check its frame."""

    crc_extra: bytes
    """One byte that goes into the checksum behind the payload: a digest of the message's definition."""
    size: int
    """Bytes of the whole payload, extension fields included, before zeros are trimmed."""


#: Format of each message of the dialect, by message id.
FORMATS: dict[int, MessageFormat] = {
    message_id: MessageFormat(bytes((definition.crc_extra,)), definition.unpacker.size)
    for message_id, definition in common.mavlink_map.items()
}

# Only lends its state to `pack` (no signing); it never sends, so it never changes.
_PACKER = common.MAVLink(None)


def forget_texts() -> None:
    """Give up pymavlink's descriptions of enumerations, 1 MiB: they are for programs that explain messages to people.

    For the start of a process that does nothing but run a node: what is loaded afterwards takes their place. Not for a
    process in which others may use pymavlink too.
    """
    common.enums.clear()


def payload_of(message: MavlinkMessage) -> bytes:
    """The payload of a pymavlink message, packed by pymavlink, trailing zeros trimmed.

    :raises struct.error: a field is out of its range (a mistake of the caller).
    """
    frame: bytes = message.pack(_PACKER)
    return frame[10:-2]
