"""Messages of the common dialect: parsing into pymavlink's message objects, and builders for those we send.

Field definitions: https://mavlink.io/en/messages/common.html. Builders take the units that people use (degrees, metres)
and raise ValueError for values out of range: a mistake of the caller.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

from rass_mav.errors import MalformedError

from .dialect import MavlinkMessage, common
from .frames import Frame

HEARTBEAT: int = common.MAVLINK_MSG_ID_HEARTBEAT
LOCAL_POSITION_NED: int = common.MAVLINK_MSG_ID_LOCAL_POSITION_NED
GLOBAL_POSITION_INT: int = common.MAVLINK_MSG_ID_GLOBAL_POSITION_INT
GPS_RAW_INT: int = common.MAVLINK_MSG_ID_GPS_RAW_INT
SYSTEM_TIME: int = common.MAVLINK_MSG_ID_SYSTEM_TIME
COMMAND_LONG: int = common.MAVLINK_MSG_ID_COMMAND_LONG
COMMAND_ACK: int = common.MAVLINK_MSG_ID_COMMAND_ACK
RADIO_STATUS: int = common.MAVLINK_MSG_ID_RADIO_STATUS
HOME_POSITION: int = common.MAVLINK_MSG_ID_HOME_POSITION
NAMED_VALUE_FLOAT: int = common.MAVLINK_MSG_ID_NAMED_VALUE_FLOAT
STATUSTEXT: int = common.MAVLINK_MSG_ID_STATUSTEXT
TUNNEL: int = common.MAVLINK_MSG_ID_TUNNEL

#: How urgent a text is: of MAV_SEVERITY, from 0 (emergency) to 7 (debug), those that are used.
CRITICAL, WARNING, INFO = 2, 4, 6
#: The longest name of a NAMED_VALUE_FLOAT, in bytes.
NAME_SIZE = 10
#: Bytes of text in one STATUSTEXT, and the largest number of pieces into which a longer text is split.
TEXT_SIZE = 50
TEXT_PIECES = 8

# `<version>` of minimal.xml; a heartbeat carries it.
DIALECT_VERSION = 3
_pack_named_value = common.MAVLink_named_value_float_message.unpacker.pack


def parse(frame: Frame) -> MavlinkMessage:
    """The pymavlink message object of a frame, the same that pymavlink's own parser creates.

    Trimmed fields are zero. Bytes after the fields we know are ignored.

    :raises MalformedError: the dialect has no message with this id, or it cannot be built from this payload.
    """
    definition = common.mavlink_map.get(frame.message_id)
    if definition is None:
        raise MalformedError(f"message id {frame.message_id} is not in the dialect")
    unpacker = definition.unpacker
    values = unpacker.unpack_from(frame.payload.ljust(unpacker.size, b"\0"))
    # On the wire fields are sorted by size. `lengths` has the number of values of each, in that order (a char array is
    # one value). `orders` has the position on the wire of each field of the definition.
    fields: list[object] = []
    position = 0
    for length in definition.lengths:
        value = values[position]
        if isinstance(value, bytes):
            fields.append(value.rstrip(b"\0"))
        else:
            fields.append(value if length == 1 else list(values[position : position + length]))
        position += length
    try:
        message = definition(*(fields[order] for order in definition.orders))
    except (TypeError, ValueError) as error:
        raise MalformedError(f"{definition.msgname}: {error}") from error
    header = message.get_header()
    header.mlen = len(frame.payload)
    header.seq = frame.sequence
    header.srcSystem = frame.system_id
    header.srcComponent = frame.component_id
    return message


class RadioStatus(NamedTuple):
    """What a telemetry radio reports."""

    system_id: int
    component_id: int
    txbuf: int
    """The free share of its buffer, 0..100 percent."""


def radio_status(frame: Frame) -> RadioStatus:
    """A RADIO_STATUS: https://mavlink.io/en/messages/common.html#RADIO_STATUS."""
    # On the wire: rxerrors and fixed (2 bytes each), rssi, remrssi, txbuf; trimmed zeros mean a full buffer.
    txbuf = min(100, frame.payload[6]) if len(frame.payload) > 6 else 0
    return RadioStatus(frame.system_id, frame.component_id, txbuf)


def companion_heartbeat() -> MavlinkMessage:
    """HEARTBEAT of a companion computer: active, and not an autopilot."""
    kind, state = common.MAV_TYPE_ONBOARD_CONTROLLER, common.MAV_STATE_ACTIVE
    return common.MAVLink_heartbeat_message(kind, common.MAV_AUTOPILOT_INVALID, 0, 0, state, DIALECT_VERSION)


@lru_cache(16)  # a vehicle always sends the same few names
def _name(name: str) -> bytes:
    encoded = name.encode("ascii")
    if not 1 <= len(encoded) <= NAME_SIZE or 0 in encoded:
        raise ValueError(f"a NAMED_VALUE_FLOAT's name has 1 to {NAME_SIZE} ASCII characters: {name!r}")
    return encoded


def named_value_float_payload(name: str, value: float, time_boot_ms: int) -> bytes:
    """The payload (18 bytes) of NAMED_VALUE_FLOAT, for `FrameWriter.frame`.

    :param name: 1 to 10 ASCII characters.
    :param value: rounded to 32 bits on the wire.
    :param time_boot_ms: milliseconds since boot; wraps after 49.7 days.
    :raises ValueError: an invalid name.
    """
    payload: bytes = _pack_named_value(time_boot_ms & 0xFFFFFFFF, value, _name(name))
    return payload


def statustext(severity: int, text: str, *, text_id: int = 1) -> list[MavlinkMessage]:
    """STATUSTEXT, in several messages if the text is longer than 50 characters.

    :param severity: MAV_SEVERITY, 0 (emergency) .. 7 (debug).
    :param text: characters outside ASCII become `?`, because some ground stations read only ASCII. Cut after
        `TEXT_SIZE * TEXT_PIECES` characters.
    :param text_id: 1..65535, links the pieces of one text: pass a different one for each text.
    """
    encoded = text.replace("\0", " ").encode("ascii", errors="replace")
    if len(encoded) <= TEXT_SIZE:
        return [common.MAVLink_statustext_message(severity, encoded)]
    pieces = [encoded[start : start + TEXT_SIZE] for start in range(0, len(encoded), TEXT_SIZE)][:TEXT_PIECES]
    if len(pieces[-1]) == TEXT_SIZE:
        # A receiver recognises the last piece by a zero byte within the 50.
        pieces.append(b"")
    return [common.MAVLink_statustext_message(severity, piece, text_id, index) for index, piece in enumerate(pieces)]


def command_long(
    command: int, parameters: Sequence[float], *, target_system: int, target_component: int
) -> MavlinkMessage:
    """COMMAND_LONG with MAV_CMD `command`. Parameters that are not given, of the seven, are 0."""
    given = (*parameters, *[0.0] * (7 - len(parameters)))
    return common.MAVLink_command_long_message(target_system, target_component, command, 0, *given)


def set_message_interval(
    message_id: int, interval_s: float, *, target_system: int, target_component: int
) -> MavlinkMessage:
    """COMMAND_LONG with MAV_CMD_SET_MESSAGE_INTERVAL: asks an autopilot for a message at a fixed rate.

    :param message_id: the message wanted.
    :param interval_s: seconds between two messages; whole microseconds on the wire.
    """
    return command_long(
        common.MAV_CMD_SET_MESSAGE_INTERVAL,
        (message_id, round(interval_s * 1e6)),
        target_system=target_system,
        target_component=target_component,
    )
