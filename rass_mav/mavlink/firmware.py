"""Which firmware an autopilot runs, and what follows from it."""

from __future__ import annotations

from typing import NamedTuple

from .component import ONBOARD_COMPUTER_STATUS, PARAM_ERROR
from .dialect import common

ARDUPILOT: int = common.MAV_AUTOPILOT_ARDUPILOTMEGA
PX4: int = common.MAV_AUTOPILOT_PX4

_NAMES: dict[int, str] = {ARDUPILOT: "ArduPilot", PX4: "PX4"}
#: Messages of ours that ArduPilot does not know before a version. What it does not know it does not pass on.
_KNOWN_SINCE = {PARAM_ERROR: (4, 7), ONBOARD_COMPUTER_STATUS: (4, 8)}


def firmware_name(autopilot: int) -> str:
    """For people; `autopilot`: MAV_AUTOPILOT."""
    return _NAMES.get(autopilot, f"autopilot of type {autopilot}")


class Firmware(NamedTuple):
    """What an autopilot runs, as far as it told."""

    autopilot: int
    """MAV_AUTOPILOT of its heartbeat."""
    version: tuple[int, int, int] = (0, 0, 0)
    """Major, minor and patch; all 0: not told."""

    def __str__(self) -> str:
        """For people."""
        name = firmware_name(self.autopilot)
        return f"{name} {'.'.join(map(str, self.version))}" if any(self.version) else name

    @property
    def renamed(self) -> bool | None:
        """Whether it is an ArduPilot whose MAVLink ports have parameters of their own, named since 4.7.

        None: an ArduPilot that did not tell its version.
        """
        if self.autopilot != ARDUPILOT:
            return False
        return self.version >= (4, 7, 0) if any(self.version) else None

    def passes_on(self, message_id: int) -> bool:
        """Whether it knows a message that the node says, and so passes it on. If in doubt, it does not."""
        since = _KNOWN_SINCE.get(message_id)
        return since is None or self.autopilot != ARDUPILOT or self.version[:2] >= since
