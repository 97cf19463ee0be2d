"""Missions, and a simulated vehicle's true position: for a mock flight controller and the program that flies it.

Field definitions: https://mavlink.io/en/messages/common.html and https://mavlink.io/en/services/mission.html.
"""

from __future__ import annotations

from typing import NamedTuple

from rass_mav.errors import MalformedError
from rass_mav.mavlink.dialect import MavlinkMessage, common
from rass_mav.mavlink.frames import Frame
from rass_mav.mavlink.messages import parse

MISSION_COUNT: int = common.MAVLINK_MSG_ID_MISSION_COUNT
MISSION_ITEM_INT: int = common.MAVLINK_MSG_ID_MISSION_ITEM_INT
MISSION_CURRENT: int = common.MAVLINK_MSG_ID_MISSION_CURRENT
SIM_STATE: int = common.MAVLINK_MSG_ID_SIM_STATE
HIL_STATE_QUATERNION: int = common.MAVLINK_MSG_ID_HIL_STATE_QUATERNION

CMD_WAYPOINT: int = common.MAV_CMD_NAV_WAYPOINT
CMD_TAKEOFF: int = common.MAV_CMD_NAV_TAKEOFF
CMD_RETURN: int = common.MAV_CMD_NAV_RETURN_TO_LAUNCH
CMD_SPEED: int = common.MAV_CMD_DO_CHANGE_SPEED
CMD_SET_MODE: int = common.MAV_CMD_DO_SET_MODE
CMD_START: int = common.MAV_CMD_MISSION_START
CMD_ARM: int = common.MAV_CMD_COMPONENT_ARM_DISARM
TEMPORARILY_REJECTED: int = common.MAV_RESULT_TEMPORARILY_REJECTED

#: Frames of mission items: degrees and metres above sea level; above home; no place at all.
FRAME_GLOBAL: int = common.MAV_FRAME_GLOBAL
FRAME_RELATIVE: int = common.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT
FRAME_NO_PLACE: int = common.MAV_FRAME_MISSION


class MissionItem(NamedTuple):
    """The contents of MISSION_ITEM_INT, except for its number."""

    command: int
    """MAV_CMD."""
    frame: int
    """MAV_FRAME: the zero of `altitude`."""
    latitude: float = 0.0
    """Degrees."""
    longitude: float = 0.0
    """Degrees."""
    altitude: float = 0.0
    """Metres."""
    param1: float = 0.0
    param2: float = 0.0


def mission_item(frame: Frame) -> tuple[int, MissionItem]:
    """Number and contents of a MISSION_ITEM_INT. Raises `MalformedError`."""
    m = parse(frame)
    return m.seq, MissionItem(m.command, m.frame, m.x / 1e7, m.y / 1e7, m.z, m.param1, m.param2)


def sim_state(
    latitude: float, longitude: float, altitude: float, velocity: tuple[float, float, float]
) -> MavlinkMessage:
    """SIM_STATE: the true position of a simulated vehicle, level and without acceleration.

    Degrees, degrees, metres above sea level; metres per second to north, east and down.
    """
    level = (1.0, 0.0, 0.0, 0.0)
    still = (0.0,) * 9
    place = (latitude, longitude, altitude, 0.0, 0.0, *velocity)
    return common.MAVLink_sim_state_message(*level, *still, *place, round(latitude * 1e7), round(longitude * 1e7))


def true_place(frame: Frame) -> tuple[float, float, float] | None:
    """A simulated vehicle's true position: latitude and longitude in degrees, metres above sea level.

    From SIM_STATE (ArduPilot) or HIL_STATE_QUATERNION (PX4). None for other messages, and for those that do not parse.
    """
    try:
        if frame.message_id == SIM_STATE:
            m = parse(frame)
            # Newer senders add degrees times 1e7, because a 32-bit float is only accurate to half a metre.
            if m.lat_int or m.lon_int:
                return m.lat_int / 1e7, m.lon_int / 1e7, m.alt
            return m.lat, m.lon, m.alt
        if frame.message_id == HIL_STATE_QUATERNION:
            m = parse(frame)
            return m.lat / 1e7, m.lon / 1e7, m.alt / 1e3
    except MalformedError:
        pass
    return None
