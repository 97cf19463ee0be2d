"""An autopilot's parameters in MAVLink messages, from the client's side.

The protocol: https://mavlink.io/en/services/parameter.html. A value always travels in a field for a 32-bit float.
ArduPilot converts whole numbers to floats ("C cast"). PX4 puts the bytes of the whole number there ("bytewise").
Messages about our own node's parameters are in `component`.
"""

from __future__ import annotations

import math
import struct
from typing import NamedTuple

from rass_mav.errors import MalformedError

from .component import PARAM_NAME_SIZE, REAL32, single
from .dialect import common, payload_of
from .firmware import PX4
from .frames import Frame
from .messages import parse

_BYTEWISE: int = common.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE
_C_CAST: int = common.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_C_CAST | common.MAV_PROTOCOL_CAPABILITY_PARAM_FLOAT
#: The types that fit the field, with their layout in its four bytes (bytewise).
_LAYOUTS: dict[int, str] = {
    common.MAV_PARAM_TYPE_UINT8: "<B3x",
    common.MAV_PARAM_TYPE_INT8: "<b3x",
    common.MAV_PARAM_TYPE_UINT16: "<H2x",
    common.MAV_PARAM_TYPE_INT16: "<h2x",
    common.MAV_PARAM_TYPE_UINT32: "<I",
    common.MAV_PARAM_TYPE_INT32: "<i",
    common.MAV_PARAM_TYPE_REAL32: "<f",
}
TYPES: frozenset[int] = frozenset(_LAYOUTS)
# The range of the whole numbers that each type can hold.
_RANGES = {
    kind: (-(1 << bits - 1), (1 << bits - 1) - 1) if layout[1].islower() else (0, (1 << bits) - 1)
    for kind, layout in _LAYOUTS.items()
    if (bits := 8 * struct.calcsize(layout[:2])) and kind != REAL32
}


class ParameterValue(NamedTuple):
    """The contents of PARAM_VALUE."""

    name: str
    value: float
    """A whole number for all types except REAL32."""
    kind: int
    """MAV_PARAM_TYPE."""


def is_bytewise(capabilities: int, autopilot: int) -> bool:
    """Whether this autopilot encodes whole numbers bytewise.

    :param capabilities: from its AUTOPILOT_VERSION; 0: unknown.
    :param autopilot: MAV_AUTOPILOT from its heartbeat, which decides if the capabilities do not.
    """
    if capabilities & _BYTEWISE:
        return True
    if capabilities & _C_CAST:
        return False
    return autopilot == PX4


def fits(value: float, kind: int) -> bool:
    """Whether a parameter of this type can hold the number."""
    if kind not in _RANGES:
        return math.isfinite(single(value))
    least, most = _RANGES[kind]
    return value == int(value) and least <= value <= most


def same(a: float, b: float, kind: int, *, bytewise: bool) -> bool:
    """Whether two numbers are the same for a parameter of this type, within the precision of the wire."""
    return a == b if bytewise and kind != REAL32 else single(a) == single(b)


def read_value(frame: Frame, *, bytewise: bool) -> ParameterValue:
    """The contents of a PARAM_VALUE frame.

    :raises MalformedError: a type that does not fit the field, or an invalid name.
    """
    message = parse(frame)
    kind = message.param_type
    if kind not in _LAYOUTS:
        raise MalformedError(f"PARAM_VALUE: unknown parameter type {kind}")
    name = _name(message.param_id)
    if kind == REAL32:
        return ParameterValue(name, message.param_value, kind)
    if bytewise:
        # Read from the frame itself: Python may change the bits of a NaN when they pass through a float.
        (value,) = struct.unpack(_LAYOUTS[kind], frame.payload[:4].ljust(4, b"\0"))
        return ParameterValue(name, value, kind)
    if not math.isfinite(message.param_value):
        raise MalformedError(f"PARAM_VALUE: {name}: expected a finite number, got {message.param_value}")
    return ParameterValue(name, round(message.param_value), kind)


def read_error(frame: Frame) -> tuple[str, int]:
    """The name and MAV_PARAM_ERROR of a PARAM_ERROR frame. Raises `MalformedError`."""
    message = parse(frame)
    return _name(message.param_id), message.error


def param_request_read(name: str, *, target_system: int, target_component: int) -> bytes:
    """Payload of PARAM_REQUEST_READ by name; `name`: 1 to 16 ASCII characters."""
    return payload_of(
        common.MAVLink_param_request_read_message(target_system, target_component, name.encode("ascii"), -1)
    )


def param_set(
    name: str, value: float, kind: int, *, bytewise: bool, target_system: int, target_component: int
) -> bytes:
    """Payload of PARAM_SET.

    :param name: 1 to 16 ASCII characters.
    :param value: fits the type (`fits`).
    :param kind: MAV_PARAM_TYPE, as the vehicle reported it.
    """
    layout = _LAYOUTS[kind if bytewise else REAL32]
    field = struct.pack(layout, int(value) if layout != _LAYOUTS[REAL32] else value)
    message = common.MAVLink_param_set_message(target_system, target_component, name.encode("ascii"), 1.0, kind)
    # The value comes first on the wire. It is packed by hand, because some whole numbers would be NaN as a float.
    return field + payload_of(message)[len(field) :]


def _name(field: str | bytes) -> str:
    text = (field if isinstance(field, str) else field.decode("ascii", errors="replace")).split("\0", 1)[0]
    if not (0 < len(text) <= PARAM_NAME_SIZE and text.isascii() and text.isprintable()):
        raise MalformedError(f"invalid parameter name {text!r}")
    return text
