"""Which firmware an autopilot runs, and what it can therefore do."""

from __future__ import annotations

from typing import NamedTuple

from .component import ONBOARD_COMPUTER_STATUS, PARAM_ERROR
from .dialect import common

ARDUPILOT: int = common.MAV_AUTOPILOT_ARDUPILOTMEGA
PX4: int = common.MAV_AUTOPILOT_PX4

_NAMES: dict[int, str] = {ARDUPILOT: "ArduPilot", PX4: "PX4"}
#: Messages of ours, and the first version of ArduPilot that knows each. ArduPilot does not forward unknown messages.
_KNOWN_SINCE = {PARAM_ERROR: (4, 7), ONBOARD_COMPUTER_STATUS: (4, 8)}


def firmware_name(autopilot: int) -> str:
    """The firmware's name for people; `autopilot`: MAV_AUTOPILOT."""
    return _NAMES.get(autopilot, f"autopilot of type {autopilot}")


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
