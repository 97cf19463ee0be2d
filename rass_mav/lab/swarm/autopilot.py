"""The mock flight controller: an autopilot's frames about a simulated vehicle, as real MAVLink."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import TypeAlias

from rass_mav.mavlink.dialect import MavlinkMessage, common, payload_of
from rass_mav.mavlink.frames import FrameWriter
from rass_mav.mavlink.messages import (
    DIALECT_VERSION,
    GLOBAL_POSITION_INT,
    HEARTBEAT,
    NAMED_VALUE_FLOAT,
    named_value_float_payload,
)

#: Where the centre of an arena is on Earth: degrees, degrees, metres above mean sea level.
Origin: TypeAlias = tuple[float, float, float]
#: Where that of the mock swarm is.
ORIGIN: Origin = (45.0, -73.0, 100.0)
#: Metres in a degree of latitude (WGS 84, mean).
METRES_PER_DEGREE = 111_319.5
#: How high the vehicles fly, metres.
HEIGHT_M = 10.0
_HEARTBEAT_S = 1.0
_UNKNOWN_HEADING = 0xFFFF
_pack_global_position = common.MAVLink_global_position_int_message.unpacker.pack


def autopilot_heartbeat(*, armed: bool = True, custom_mode: int = 0) -> MavlinkMessage:
    """HEARTBEAT of an ArduPilot quadrotor, for a mock flight controller.

    :param custom_mode: ArduCopter's number of the flight mode, 0..2^32 - 1.
    """
    base_mode = common.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED | (common.MAV_MODE_FLAG_SAFETY_ARMED if armed else 0)
    state = common.MAV_STATE_ACTIVE if armed else common.MAV_STATE_STANDBY
    return common.MAVLink_heartbeat_message(
        common.MAV_TYPE_QUADROTOR, common.MAV_AUTOPILOT_ARDUPILOTMEGA, base_mode, custom_mode, state, DIALECT_VERSION
    )


def _degrees_e7(latitude: float, longitude: float) -> tuple[int, int]:
    if not (-90.0 <= latitude <= 90.0 and -180.0 <= longitude <= 180.0):
        raise ValueError(f"not a place on Earth: latitude {latitude}, longitude {longitude}")
    return round(latitude * 1e7), round(longitude * 1e7)


def global_position_int_payload(
    latitude: float,
    longitude: float,
    altitude: float,
    relative_altitude: float,
    time_boot_ms: int,
    *,
    velocity: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> bytes:
    """The payload (28 bytes) of GLOBAL_POSITION_INT, with an unknown heading, for `FrameWriter.frame`.

    A mock flight controller sends one in each step; a message object would take three times as long.

    :param latitude: degrees, -90..90.
    :param longitude: degrees, -180..180.
    :param altitude: metres above mean sea level.
    :param relative_altitude: metres above home.
    :param time_boot_ms: milliseconds since boot; wraps after 49.7 days.
    :param velocity: metres per second to north, east and down, each within +-327.67.
    :raises ValueError: a latitude or longitude out of its range.
    """
    north, east, down = velocity
    payload: bytes = _pack_global_position(
        time_boot_ms & 0xFFFFFFFF, *_degrees_e7(latitude, longitude),
        round(altitude * 1000.0), round(relative_altitude * 1000.0),
        round(north * 100.0), round(east * 100.0), round(down * 100.0), _UNKNOWN_HEADING,
    )  # fmt: skip
    return payload


def local_position_ned(
    x: float, y: float, z: float, time_boot_ms: int, *, velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> MavlinkMessage:
    """LOCAL_POSITION_NED: metres to north, east and down of the origin; velocity in metres per second likewise."""
    return common.MAVLink_local_position_ned_message(time_boot_ms & 0xFFFFFFFF, x, y, z, *velocity)


def home_position(latitude: float, longitude: float, altitude: float) -> MavlinkMessage:
    """HOME_POSITION in degrees and metres above mean sea level, upright, with the local origin at home.

    :raises ValueError: a latitude or longitude out of its range.
    """
    lat, lon = _degrees_e7(latitude, longitude)
    upright = [1.0, 0.0, 0.0, 0.0]
    return common.MAVLink_home_position_message(
        lat, lon, round(altitude * 1000.0), 0.0, 0.0, 0.0, upright, 0.0, 0.0, 0.0
    )


def gps_raw_int(accuracy_m: float, time_boot_ms: int) -> MavlinkMessage:
    """GPS_RAW_INT with a three-dimensional fix of this horizontal accuracy, metres; what else it has is unknown."""
    unknown = (1 << 16) - 1
    return common.MAVLink_gps_raw_int_message(
        time_boot_ms * 1000, common.GPS_FIX_TYPE_3D_FIX, 0, 0, 0, unknown, unknown, unknown, unknown, 255,
        h_acc=round(accuracy_m * 1000.0),
    )  # fmt: skip


# Always the same bytes, so they are packed once.
_HEARTBEAT = payload_of(autopilot_heartbeat())


def metres_east(origin: Origin) -> float:
    """Metres in a degree of longitude there."""
    return METRES_PER_DEGREE * math.cos(math.radians(origin[0]))


_METRES_EAST = metres_east(ORIGIN)


def to_earth(x: float, y: float) -> tuple[float, float]:
    """Latitude and longitude, in degrees, of a point of the arena (metres east and north of its centre)."""
    latitude = ORIGIN[0] + y / METRES_PER_DEGREE
    return latitude, ORIGIN[1] + x / _METRES_EAST


def to_arena(latitude: float, longitude: float) -> tuple[float, float]:
    """Convert a place on Earth in degrees to metres east and north of the arena's centre; the inverse of `to_earth`."""
    return (longitude - ORIGIN[1]) * _METRES_EAST, (latitude - ORIGIN[0]) * METRES_PER_DEGREE


class MockAutopilot:
    """Sends as ArduPilot does: HEARTBEAT at 1 Hz, GLOBAL_POSITION_INT at `position_hz`, the reading when it is
    measured.

    It does not fly: it reports the place where the mock swarm puts it. docs/evaluation/simulation.md lists what it
    does not
    simulate.
    """

    __slots__ = (
        "_accuracy_m", "_beside", "_east_m", "_heartbeat_at", "_origin", "_position_at", "_position_s",
        "_reading_name", "_sensor", "_writer",
    )  # fmt: skip

    def __init__(
        self, system_id: int, *, reading_name: str = "RAD", position_hz: float = 1.0, accuracy_m: float = 0.0,
        origin: Origin = ORIGIN, reading_component: int = 1, flags: int = 0,
        beside: Callable[[float], Iterable[MavlinkMessage]] = lambda now: (),
    ) -> None:  # fmt: skip
        """`system_id` 1..255; `reading_name` of the NAMED_VALUE_FLOAT, and the component 1..255 that sends it;
        `position_hz` > 0; `accuracy_m`: the standard deviation of its error that GPS reports, 0: none; `flags`: of the
        frames (`FrameWriter.flags`); `beside`: what else it sends with each heartbeat, by the seconds since boot."""
        self._accuracy_m = accuracy_m
        self._writer = FrameWriter(system_id, 1)
        self._sensor = self._writer if reading_component == 1 else FrameWriter(system_id, reading_component)
        self._writer.flags = self._sensor.flags = flags
        self._reading_name = reading_name
        self._position_s = 1.0 / position_hz
        self._origin, self._east_m = origin, metres_east(origin)
        self._beside = beside
        self._heartbeat_at = 0.0
        self._position_at = 0.0

    def frames(
        self, now: float, x: float, y: float, reading: float | None, velocity: tuple[float, float] = (0.0, 0.0)
    ) -> list[bytes]:
        """The frames it sends at `now` (seconds since boot) at (x, y), metres east and north of its origin.

        `reading` None: the sensor sends nothing. `velocity`: metres per second to east and north.
        """
        out = []
        boot_ms = int(now * 1000.0)
        if now >= self._heartbeat_at:
            out.append(self._writer.frame(HEARTBEAT, _HEARTBEAT))
            if self._heartbeat_at == 0.0:
                out.append(self._writer.message(home_position(*self._origin)))
            self._heartbeat_at = now + _HEARTBEAT_S
            if self._accuracy_m:
                out.append(self._writer.message(gps_raw_int(self._accuracy_m, boot_ms)))
            out.extend(map(self._writer.message, self._beside(now)))
        if now >= self._position_at:
            latitude, longitude, altitude = self._origin
            payload = global_position_int_payload(
                latitude + y / METRES_PER_DEGREE, longitude + x / self._east_m, altitude + HEIGHT_M, HEIGHT_M, boot_ms,
                velocity=(velocity[1], velocity[0], 0.0),
            )  # fmt: skip
            out.append(self._writer.frame(GLOBAL_POSITION_INT, payload))
            self._position_at = now + self._position_s
        if reading is not None:
            payload = named_value_float_payload(self._reading_name, reading, boot_ms)
            out.append(self._sensor.frame(NAMED_VALUE_FLOAT, payload))
        return out
