"""Messages of a component to a ground station, besides texts and values: parameters, acknowledgements, its version.

Field definitions: https://mavlink.io/en/messages/common.html. All builders return payloads for `FrameWriter.frame`,
with trailing zeros trimmed. A number outside its field's range raises struct.error: a mistake of the caller.
"""

from __future__ import annotations

import math
import re
import struct
from typing import NamedTuple

from .dialect import common, payload_of

PARAM_REQUEST_READ: int = common.MAVLINK_MSG_ID_PARAM_REQUEST_READ
PARAM_REQUEST_LIST: int = common.MAVLINK_MSG_ID_PARAM_REQUEST_LIST
PARAM_SET: int = common.MAVLINK_MSG_ID_PARAM_SET
PARAM_VALUE: int = common.MAVLINK_MSG_ID_PARAM_VALUE
COMMAND_INT: int = common.MAVLINK_MSG_ID_COMMAND_INT
#: Newer than some versions of the dialect; None: the dialect does not have it, and it is not sent.
PARAM_ERROR: int | None = getattr(common, "MAVLINK_MSG_ID_PARAM_ERROR", None)
PING: int = common.MAVLINK_MSG_ID_PING
FILE_TRANSFER_PROTOCOL: int = common.MAVLINK_MSG_ID_FILE_TRANSFER_PROTOCOL
AUTOPILOT_VERSION: int = common.MAVLINK_MSG_ID_AUTOPILOT_VERSION
MESSAGE_INTERVAL: int = common.MAVLINK_MSG_ID_MESSAGE_INTERVAL
ONBOARD_COMPUTER_STATUS: int = common.MAVLINK_MSG_ID_ONBOARD_COMPUTER_STATUS

CMD_REQUEST_MESSAGE: int = common.MAV_CMD_REQUEST_MESSAGE
CMD_SET_MESSAGE_INTERVAL: int = common.MAV_CMD_SET_MESSAGE_INTERVAL
CMD_GET_MESSAGE_INTERVAL: int = common.MAV_CMD_GET_MESSAGE_INTERVAL

ACCEPTED: int = common.MAV_RESULT_ACCEPTED
DENIED: int = common.MAV_RESULT_DENIED
UNSUPPORTED: int = common.MAV_RESULT_UNSUPPORTED

#: MAV_PARAM_ERROR: why a PARAM_SET or PARAM_REQUEST_READ failed.
DOES_NOT_EXIST, VALUE_OUT_OF_RANGE, PERMISSION_DENIED, READ_ONLY = 1, 2, 3, 5
#: The only type of our parameters: some programs read INT32 as a float, others as bits.
REAL32: int = common.MAV_PARAM_TYPE_REAL32
#: The longest parameter name, in bytes.
PARAM_NAME_SIZE = 16

# C cast, not bytewise: a component must report one of the two. For floats they mean the same.
_CAPABILITIES: int = (
    common.MAV_PROTOCOL_CAPABILITY_MAVLINK2
    | common.MAV_PROTOCOL_CAPABILITY_COMMAND_INT
    | common.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_C_CAST
)
# Header of a file transfer: sequence, session, opcode, data size, answered opcode, end of burst, padding, offset.
_FTP_HEADER = struct.Struct("<HBBBBBxI")
_FTP_PAYLOAD = 251
_UNKNOWN_U8 = 0xFF
_UNKNOWN_I8 = 0x7F
_UNKNOWN_I16 = 0x7FFF
_UNKNOWN_U32 = 0xFFFFFFFF


def single(value: float) -> float:
    """The nearest 32-bit float; infinite if the number is too large."""
    try:
        rounded: float = struct.unpack("<f", struct.pack("<f", value))[0]
    except OverflowError:
        return math.copysign(math.inf, value)
    return rounded


def param_value(name: str, value: float, count: int, index: int) -> bytes:
    """PARAM_VALUE of a REAL32 parameter (https://mavlink.io/en/services/parameter.html).

    :param name: 1 to 16 ASCII characters.
    :param value: rounded to 32 bits.
    :param count: how many parameters there are.
    :param index: index of this parameter, from 0.
    """
    return payload_of(common.MAVLink_param_value_message(name.encode("ascii"), value, REAL32, count, index))


def param_error(name: str, index: int, error: int, *, target_system: int, target_component: int) -> bytes:
    """PARAM_ERROR, where the dialect has it. The ground station then need not ask again.

    :param name: at most 16 characters; empty if the request was by index.
    :param index: as in the request; -1 if the request was by name.
    :param error: `DOES_NOT_EXIST`, `VALUE_OUT_OF_RANGE`, `PERMISSION_DENIED` or `READ_ONLY`.
    """
    encoded = name.encode("ascii", errors="replace")[:PARAM_NAME_SIZE]
    return payload_of(common.MAVLink_param_error_message(target_system, target_component, encoded, index, error))


def command_ack(command: int, result: int, *, target_system: int, target_component: int) -> bytes:
    """COMMAND_ACK to the sender of a command; `result`: `ACCEPTED`, `DENIED` or `UNSUPPORTED`."""
    return payload_of(common.MAVLink_command_ack_message(command, result, 0, 0, target_system, target_component))


def ping(time_us: int, sequence: int, *, target_system: int, target_component: int) -> bytes:
    """PING. An answer has the time and sequence of the question, and its sender as the target."""
    return payload_of(common.MAVLink_ping_message(time_us, sequence, target_system, target_component))


def file_transfer_refusal(request: bytes, *, target_system: int, target_component: int) -> bytes | None:
    """FILE_TRANSFER_PROTOCOL that refuses a request as an unknown command (https://mavlink.io/en/services/ftp.html).

    :param request: the field `payload` of the request, 251 bytes.
    :returns: None if `request` is itself an answer, which must not be answered.
    """
    sequence, session, opcode, *_ = _FTP_HEADER.unpack_from(request)
    if opcode in (common.MAV_FTP_OPCODE_ACK, common.MAV_FTP_OPCODE_NAK):
        return None
    header = _FTP_HEADER.pack((sequence + 1) & 0xFFFF, session, common.MAV_FTP_OPCODE_NAK, 1, opcode, 0, 0)
    payload = header + bytes((common.MAV_FTP_ERR_UNKNOWNCOMMAND,))
    return payload_of(
        common.MAVLink_file_transfer_protocol_message(
            0, target_system, target_component, payload.ljust(_FTP_PAYLOAD, b"\0")
        )
    )


def message_interval(message_id: int, interval_s: float | None) -> bytes:
    """MESSAGE_INTERVAL: seconds between two messages; 0: never; None: this message is not available.

    :param message_id: 0..65535.
    :param interval_s: at most 2147 seconds.
    """
    # On the wire 0 means "not available" and -1 "not sent".
    micros = 0 if interval_s is None else round(interval_s * 1e6) or -1
    return payload_of(common.MAVLink_message_interval_message(message_id, micros))


def autopilot_version(version: str) -> bytes:
    """AUTOPILOT_VERSION of a component that is not an autopilot.

    :param version: starts with major.minor.patch, each 0..255.
    """
    # The lowest byte is the type of the release: 0 for a development version.
    number = int.from_bytes([*map(int, re.findall(r"\d+", version)[:3]), common.FIRMWARE_VERSION_TYPE_DEV], "big")
    nothing = bytes(8)
    return payload_of(
        common.MAVLink_autopilot_version_message(
            _CAPABILITIES, number, 0, 0, 0, nothing, nothing, nothing, 0, 0, 0, bytes(18)
        )
    )


class ComputerStatus(NamedTuple):
    """The state of the computer; None: unknown."""

    uptime_s: float
    """Seconds since it was started."""
    cores_percent: tuple[float, ...] = ()
    """Load of each processor, 0..100; only the first 8 are used."""
    temperature_c: float | None = None
    """Temperature of the processor, degrees Celsius."""
    ram_used_mib: float | None = None
    ram_total_mib: float | None = None
    storage_used_mib: float | None = None
    """Used space of the disk with the store."""
    storage_total_mib: float | None = None


def onboard_computer_status(status: ComputerStatus) -> bytes:
    """ONBOARD_COMPUTER_STATUS. Values outside their field's range are clipped to it.

    Its time counts from the computer's start, because the date may be wrong.
    """
    cores = [_within(value, 100, _UNKNOWN_U8) for value in status.cores_percent[:8]]
    temperature = _UNKNOWN_I8 if status.temperature_c is None else max(-127, min(126, round(status.temperature_c)))
    uptime_ms = _within(status.uptime_s * 1000.0, _UNKNOWN_U32, 0)
    gpu = ([_UNKNOWN_U8] * 4, [_UNKNOWN_U8] * 10)
    used, total = ([_mib(size)] + [_UNKNOWN_U32] * 3 for size in (status.storage_used_mib, status.storage_total_mib))
    links = [[_UNKNOWN_U32] * 6] * 5
    message = common.MAVLink_onboard_computer_status_message(
        uptime_ms * 1000, uptime_ms, 0, _filled(cores, 8, _UNKNOWN_U8), [_UNKNOWN_U8] * 10, *gpu, _UNKNOWN_I8,
        _filled([temperature], 8, _UNKNOWN_I8), [_UNKNOWN_I16] * 4, _mib(status.ram_used_mib),
        _mib(status.ram_total_mib), [_UNKNOWN_U32] * 4, used, total, *links,
    )  # fmt: skip
    return payload_of(message)


def _within(value: float, most: int, unknown: int) -> int:
    return max(0, min(most, round(value))) if math.isfinite(value) else unknown


def _mib(value: float | None) -> int:
    return _UNKNOWN_U32 if value is None else _within(value, _UNKNOWN_U32 - 1, _UNKNOWN_U32)


def _filled(values: list[int], size: int, unknown: int) -> list[int]:
    return values + [unknown] * (size - len(values))
