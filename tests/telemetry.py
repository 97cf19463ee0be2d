"""What an autopilot says of its vehicle, as message objects of pymavlink."""

from __future__ import annotations

from rass_mav.lab.swarm.autopilot import global_position_int_payload
from rass_mav.mavlink.dialect import MavlinkMessage, common
from rass_mav.mavlink.frames import Frame
from rass_mav.mavlink.messages import GLOBAL_POSITION_INT, NAMED_VALUE_FLOAT, named_value_float_payload, parse


def global_position_int(
    latitude: float, longitude: float, altitude: float, relative_altitude: float, boot_ms: int
) -> MavlinkMessage:
    payload = global_position_int_payload(latitude, longitude, altitude, relative_altitude, boot_ms)
    return parse(Frame(GLOBAL_POSITION_INT, 0, 1, 1, payload, False))


def named_value_float(name: str, value: float, boot_ms: int) -> MavlinkMessage:
    return parse(Frame(NAMED_VALUE_FLOAT, 0, 1, 1, named_value_float_payload(name, value, boot_ms), False))


def gps_raw_int(h_acc_mm: int, *, fix: int = common.GPS_FIX_TYPE_3D_FIX) -> MavlinkMessage:
    return common.MAVLink_gps_raw_int_message(0, fix, 455000000, -736000000, 120000, 100, 100, 0, 0, 12, 0, h_acc_mm)


def system_time(time_us: int, boot_ms: int = 1000) -> MavlinkMessage:
    return common.MAVLink_system_time_message(time_us, boot_ms)
