"""The vehicle's state as its autopilot reports it: position, home, heartbeat, reading, date.

Only one autopilot is trusted. A component on the same link sends the same messages about something else. So does a
neighbour's autopilot, whose frames a radio or router may forward. A setting can name another component of the same
vehicle for the reading alone.

One echo looks genuine: PX4 repeats a companion's NAMED_VALUE_FLOAT as if the autopilot had measured it. So never send
the autopilot a value under the name of the reading.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from rass_mav.errors import ConfigError, MalformedError

from .component import AUTOPILOT_VERSION
from .dialect import common
from .firmware import AutopilotVersion, Firmware, read_version
from .frames import Frame
from .identity import AUTOPILOT_COMPONENT
from .messages import (
    GLOBAL_POSITION_INT,
    GPS_RAW_INT,
    HEARTBEAT,
    HOME_POSITION,
    LOCAL_POSITION_NED,
    NAME_SIZE,
    NAMED_VALUE_FLOAT,
    SYSTEM_TIME,
)

_global_position = common.MAVLink_global_position_int_message.unpacker
_named_value = common.MAVLink_named_value_float_message.unpacker
_local_position = common.MAVLink_local_position_ned_message.unpacker
_home_position = common.MAVLink_home_position_message.unpacker
_heartbeat = common.MAVLink_heartbeat_message.unpacker
_gps_raw = common.MAVLink_gps_raw_int_message.unpacker
_system_time = common.MAVLink_system_time_message.unpacker
_NO_AUTOPILOT: int = common.MAV_AUTOPILOT_INVALID
_ARMED: int = common.MAV_MODE_FLAG_SAFETY_ARMED
_LEAST_FIX: int = common.GPS_FIX_TYPE_2D_FIX

_MAX_LATITUDE = 900_000_000
_MAX_LONGITUDE = 1_800_000_000
#: The first and the last date that is believed, seconds since 1970: 2024-01-01 and 2100-01-01.
FIRST_DATE, _LAST_DATE = 1_704_067_200.0, 4_102_444_800.0

#: Kinds of ignored NAMED_VALUE_FLOATs that are remembered: those heard last.
MOST_IGNORED = 8
#: If time_boot_ms falls by more than this, the autopilot has rebooted. A smaller fall is a frame that was overtaken.
REBOOT_MS = 5000


class Position(NamedTuple):
    """A place on Earth."""

    latitude: float
    """Degrees, -90..90."""
    longitude: float
    """Degrees, -180..180."""
    altitude: float
    """Metres above mean sea level."""
    at: float
    """When it was received, in seconds on the caller's timeline."""
    north: float = 0.0
    """Metres per second; 0 for a home."""
    east: float = 0.0
    """Metres per second; 0 for a home."""


class LocalPosition(NamedTuple):
    """A place relative to the autopilot's local origin."""

    x: float
    """Metres to north."""
    y: float
    """Metres to east."""
    z: float
    """Metres down."""
    at: float
    """When it was received, in seconds on the caller's timeline."""


class Accuracy(NamedTuple):
    """How exact the position from GPS is."""

    horizontal_m: float
    """Standard deviation, metres, above 0."""
    at: float
    """When it was received, in seconds on the caller's timeline."""


class Date(NamedTuple):
    """The date that the autopilot knows, in most cases from GPS."""

    utc: float
    """Seconds since 1970."""
    at: float
    """When it was received, in seconds on the caller's timeline."""


class Reading(NamedTuple):
    """A reading of the sensor."""

    value: float
    """Finite, in the sensor's unit."""
    at: float
    """When it was received, in seconds on the caller's timeline."""
    unit: str | None = None
    """Of the value, where a program states it; None: that of the node's sensor."""


class Ignored(NamedTuple):
    """NAMED_VALUE_FLOATs of one name from one component."""

    times: int
    at: float
    """When the last one was received, in seconds on the caller's timeline."""


class Telemetry:
    """The state of the vehicle as its autopilot reports it. Pass it every incoming frame."""

    def __init__(
        self,
        system_id: int,
        component_id: int = AUTOPILOT_COMPONENT,
        reading_name: str = "RAD",
        reading_component: int | None = AUTOPILOT_COMPONENT,
    ) -> None:
        """:param system_id: of the autopilot, 1..255. 0: that of the first autopilot heard; the others are ignored.
        :param component_id: of the autopilot.
        :param reading_component: of the vehicle, that sends the reading; None: none is used.
        :param reading_name: name of the NAMED_VALUE_FLOAT that contains the reading, 1 to 10 ASCII characters.
        :raises ConfigError: an invalid name.
        """
        if not (reading_name.isascii() and 1 <= len(reading_name) <= NAME_SIZE):
            raise ConfigError(f"a reading's name has 1 to {NAME_SIZE} ASCII characters, got {reading_name!r}")
        self.system_id = system_id
        """0 until an autopilot has been heard."""
        self.component_id = component_id
        self.reading_component = reading_component
        self._name = reading_name.encode("ascii")
        self._name_padded = self._name.ljust(NAME_SIZE, b"\0")
        self.position: Position | None = None
        """The last position fix."""
        self.accuracy: Accuracy | None = None
        """Of the GPS; None: the autopilot does not report it now, or there is no fix."""
        self.date: Date | None = None
        """The last plausible date; None: not heard."""
        self.local: LocalPosition | None = None
        self.home: Position | None = None
        self.reading: Reading | None = None
        self.heartbeat_at: float | None = None
        """When the last heartbeat was received."""
        self.autopilot: int | None = None
        """MAV_AUTOPILOT of its heartbeat."""
        self.version: AutopilotVersion | None = None
        """The contents of its AUTOPILOT_VERSION; None: not heard."""
        self.signed: bool | None = False
        """Whether the last heartbeat was signed; None: it was MAVLink 1, which has no signatures."""
        self.no_fix_at: float | None = None
        """When the last position without a fix was received."""
        self.armed = False
        self.boot_ms = 0
        """The autopilot's last time_boot_ms."""
        self.reboots = 0
        """How often time_boot_ms fell by more than `REBOOT_MS`. Message rates must then be requested again."""
        self.rejected = 0
        """Impossible values from our autopilot: a reading or local position that is not finite, degrees out of range,
        a date before 2024 or after 2099."""
        self.ignored: dict[tuple[int, int, str], Ignored] = {}
        """NAMED_VALUE_FLOATs that were not used, by system, component and name; at most `MOST_IGNORED`. All of the
        vehicle, and those of others that have the name of the reading."""

    def handle(self, frame: Frame, now: float) -> bool:
        """Take the contents of a frame.

        :param now: seconds on the caller's timeline.
        :returns: True if it came from our autopilot and changed the state. False otherwise, also for rejected values
            and for a position without a fix.
        """
        message_id, _, system_id, component_id, payload = frame[:5]
        if system_id != self.system_id or component_id != self.component_id or not system_id:
            if message_id == NAMED_VALUE_FLOAT:
                return bool(self.system_id) and self._on_named_value(frame, now)
            if self.system_id or not system_id or component_id != self.component_id or message_id != HEARTBEAT:
                return False
            return self._on_heartbeat(frame, now, latch=system_id)
        if message_id == NAMED_VALUE_FLOAT:
            return self._on_named_value(frame, now)
        if message_id == GLOBAL_POSITION_INT:
            return self._on_global_position(payload, now)
        if message_id == HEARTBEAT:
            return self._on_heartbeat(frame, now)
        if message_id == LOCAL_POSITION_NED:
            return self._on_local_position(payload, now)
        if message_id == GPS_RAW_INT:
            return self._on_gps(payload, now)
        if message_id == SYSTEM_TIME:
            return self._on_system_time(payload, now)
        if message_id == HOME_POSITION:
            return self._on_home_position(payload, now)
        if message_id == AUTOPILOT_VERSION:
            return self._on_version(frame)
        return False

    def _is_reading(self, name: bytes) -> bool:
        # The zero that ends the name may be followed by anything.
        return name == self._name_padded or name.split(b"\0", 1)[0] == self._name

    def _on_named_value(self, frame: Frame, now: float) -> bool:
        system_id, component_id = frame.system_id, frame.component_id
        boot_ms, value, name = _named_value.unpack_from(frame.payload.ljust(_named_value.size, b"\0"))
        ours = system_id == self.system_id
        if boot_ms and ours and component_id == self.component_id:
            self._on_boot_time(boot_ms)
        named = self._is_reading(name)
        if not (named and ours and component_id == self.reading_component):
            if named or ours:
                self._ignore((system_id, component_id, name.split(b"\0", 1)[0].decode("ascii", "replace")), now)
            return False
        if not math.isfinite(value):
            self.rejected += 1
            return False
        self.reading = Reading(value, now)
        return True

    def _ignore(self, key: tuple[int, int, str], now: float) -> None:
        before = self.ignored.pop(key, None)
        if len(self.ignored) == MOST_IGNORED:
            del self.ignored[next(iter(self.ignored))]
        self.ignored[key] = Ignored(1 if before is None else before.times + 1, now)

    def _on_global_position(self, payload: bytes, now: float) -> bool:
        fields = _global_position.unpack_from(payload.ljust(_global_position.size, b"\0"))
        boot_ms, lat, lon, alt, _, north, east, *_ = fields
        if boot_ms:
            self._on_boot_time(boot_ms)
        if not self._is_place(lat, lon):
            self.no_fix_at = now
            return False
        self.position = Position(lat / 1e7, lon / 1e7, alt / 1e3, now, north / 100, east / 100)
        return True

    def _on_local_position(self, payload: bytes, now: float) -> bool:
        boot_ms, x, y, z, _, _, _ = _local_position.unpack_from(payload.ljust(_local_position.size, b"\0"))
        if boot_ms:
            self._on_boot_time(boot_ms)
        if not (math.isfinite(x) and math.isfinite(y) and math.isfinite(z)):
            self.rejected += 1
            return False
        self.local = LocalPosition(x, y, z, now)
        return True

    def _on_home_position(self, payload: bytes, now: float) -> bool:
        lat, lon, alt = _home_position.unpack_from(payload.ljust(_home_position.size, b"\0"))[:3]
        if not self._is_place(lat, lon):
            return False
        self.home = Position(lat / 1e7, lon / 1e7, alt / 1e3, now)
        return True

    def _on_gps(self, payload: bytes, now: float) -> bool:
        """Its accuracy alone: https://mavlink.io/en/messages/common.html#GPS_RAW_INT."""
        fields = _gps_raw.unpack_from(payload.ljust(_gps_raw.size, b"\0"))
        fix, h_acc = fields[8], fields[11]
        # 0: unknown. Without a fix it says nothing about the position, which is then extrapolated.
        self.accuracy = Accuracy(h_acc / 1e3, now) if h_acc and fix >= _LEAST_FIX else None
        return True

    def _on_system_time(self, payload: bytes, now: float) -> bool:
        """https://mavlink.io/en/messages/common.html#SYSTEM_TIME."""
        time_us, boot_ms = _system_time.unpack_from(payload.ljust(_system_time.size, b"\0"))
        if boot_ms:
            self._on_boot_time(boot_ms)
        if not time_us:
            return False  # not known yet
        if not FIRST_DATE <= time_us / 1e6 < _LAST_DATE:
            self.rejected += 1
            return False
        self.date = Date(time_us / 1e6, now)
        return True

    @property
    def firmware(self) -> Firmware | None:
        """What the autopilot runs; None: its heartbeat has not been heard."""
        if self.autopilot is None:
            return None
        return Firmware(self.autopilot) if self.version is None else Firmware(self.autopilot, self.version.version)

    def _on_version(self, frame: Frame) -> bool:
        try:
            self.version = read_version(frame)
        except MalformedError:
            self.rejected += 1
            return False
        return True

    def _on_heartbeat(self, frame: Frame, now: float, latch: int = 0) -> bool:
        _, _, autopilot, base_mode, _, _ = _heartbeat.unpack_from(frame.payload.ljust(_heartbeat.size, b"\0"))
        if autopilot == _NO_AUTOPILOT:
            return False
        if latch:
            self.system_id = latch
        self.heartbeat_at = now
        self.autopilot = autopilot
        self.signed = frame.signed if frame.mavlink == 2 else None
        self.armed = bool(base_mode & _ARMED)
        return True

    def _is_place(self, lat: int, lon: int) -> bool:
        if lat == 0 and lon == 0:
            return False  # autopilots send 0, 0 before their first fix; the altitude may already come from a barometer
        if -_MAX_LATITUDE <= lat <= _MAX_LATITUDE and -_MAX_LONGITUDE <= lon <= _MAX_LONGITUDE:
            return True
        self.rejected += 1
        return False

    def _on_boot_time(self, boot_ms: int) -> None:
        # Callers skip 0: some scripts never set the field, which would look like a reboot each time.
        if boot_ms < self.boot_ms - REBOOT_MS:
            self.reboots += 1
        self.boot_ms = boot_ms
