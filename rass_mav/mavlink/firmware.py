"""Which firmware an autopilot runs, how it is asked for it, and what it can therefore do."""

from __future__ import annotations

from typing import NamedTuple

from .component import CMD_REQUEST_MESSAGE, ONBOARD_COMPUTER_STATUS, PARAM_ERROR
from .dialect import common, payload_of
from .frames import Frame
from .messages import command_long, parse

ARDUPILOT: int = common.MAV_AUTOPILOT_ARDUPILOTMEGA
PX4: int = common.MAV_AUTOPILOT_PX4

_NAMES: dict[int, str] = {ARDUPILOT: "ArduPilot", PX4: "PX4"}
#: Messages of ours, and the first version of ArduPilot that knows each. ArduPilot does not forward unknown messages.
_KNOWN_SINCE = {PARAM_ERROR: (4, 7), ONBOARD_COMPUTER_STATUS: (4, 8)}


def firmware_name(autopilot: int) -> str:
    """The firmware's name for people; `autopilot`: MAV_AUTOPILOT."""
    return _NAMES.get(autopilot, f"autopilot of type {autopilot}")


class AutopilotVersion(NamedTuple):
    """The contents of AUTOPILOT_VERSION."""

    capabilities: int
    version: tuple[int, int, int]
    """Major, minor and patch of the firmware; all 0: unknown."""


class Firmware(NamedTuple):
    """What an autopilot runs, as far as it has reported it."""

    autopilot: int
    """MAV_AUTOPILOT of its heartbeat."""
    version: tuple[int, int, int] = (0, 0, 0)
    """Major, minor and patch; all 0: unknown."""

    def __str__(self) -> str:
        """Name and version for people."""
        name = firmware_name(self.autopilot)
        return f"{name} {'.'.join(map(str, self.version))}" if any(self.version) else name

    @property
    def renamed(self) -> bool | None:
        """Whether it is an ArduPilot with the MAVLink port parameters of 4.7 and later.

        None: an ArduPilot of unknown version.
        """
        if self.autopilot != ARDUPILOT:
            return False
        return self.version >= (4, 7, 0) if any(self.version) else None

    def passes_on(self, message_id: int) -> bool:
        """Whether it knows a message of the node, and therefore forwards it. False if in doubt."""
        since = _KNOWN_SINCE.get(message_id)
        return since is None or self.autopilot != ARDUPILOT or self.version[:2] >= since


def read_version(frame: Frame) -> AutopilotVersion:
    """The contents of an AUTOPILOT_VERSION frame. Raises `MalformedError`."""
    message = parse(frame)
    number = message.flight_sw_version
    return AutopilotVersion(message.capabilities, (number >> 24, number >> 16 & 0xFF, number >> 8 & 0xFF))


def request_message(message_id: int, *, target_system: int, target_component: int) -> bytes:
    """Payload of COMMAND_LONG with MAV_CMD_REQUEST_MESSAGE: asks for a message once."""
    target = {"target_system": target_system, "target_component": target_component}
    return payload_of(command_long(CMD_REQUEST_MESSAGE, (message_id,), **target))
