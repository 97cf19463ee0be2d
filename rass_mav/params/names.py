"""Which file of firmware_params/ fits a firmware, and what its versions call the same parameter."""

from __future__ import annotations

import re

from rass_mav.mavlink.vehicle_parameters import ARDUPILOT, PX4

#: Of an autopilot, by the MAV_AUTOPILOT of its heartbeat.
FIRMWARES: dict[int, str] = {ARDUPILOT: "ArduPilot", PX4: "PX4"}
#: Since this version ArduPilot has other names for the parameters of its MAVLink ports.
RENAMING_VERSION = (4, 7)

_RENAMED = {"SYSID_THISMAV": "MAV_SYSID", "SYSID_MYGCS": "MAV_GCS_SYSID", "TELEM_DELAY": "MAV_TELEM_DELAY"}
_RENAMED_BACK = {new: old for old, new in _RENAMED.items()}
_RATE = re.compile(r"SR(\d)_([A-Z0-9_]+)")
_PORT = re.compile(r"MAV(\d)_([A-Z0-9_]+)")
_OF_PX4 = re.compile(r"MAV_\d_\w+|SER_[A-Z]+\d_BAUD|MAV_SYS_ID")
_OF_ARDUPILOT = re.compile(r"SERIAL\d_\w+|SR\d_\w+|MAV\d_\w+|BRD_\w+|SYSID_\w+|MAV_SYSID|SCR_ENABLE")
#: Parameters that hold the vehicle's system id. Once they are set, the vehicle may speak under the new one.
SYSTEM_ID_NAMES = frozenset({"SYSID_THISMAV", "MAV_SYSID", "MAV_SYS_ID"})
#: What PX4's development branch has instead; the values mean something else.
_PX4_REPLACED = {"MAV_1_CONFIG": "SER_TEL2_PROTO", "MAV_0_CONFIG": "SER_TEL1_PROTO"}


def firmware_name(autopilot: int) -> str:
    """For people; `autopilot`: MAV_AUTOPILOT."""
    return FIRMWARES.get(autopilot, f"autopilot of type {autopilot}")


def other_name(name: str) -> str | None:
    """What ArduPilot before or since 4.7, or PX4's development branch, has in place of a parameter; None: the same."""
    if found := _RENAMED.get(name) or _RENAMED_BACK.get(name) or _PX4_REPLACED.get(name):
        return found
    # The stream rates of port 2 became those of the third MAVLink port. The options of a port have no such
    # counterpart: SERIAL2_OPTIONS is still there, with fewer bits.
    if old := _RATE.fullmatch(name):
        return f"MAV{int(old[1]) + 1}_{old[2]}"
    if (new := _PORT.fullmatch(name)) and new[2] != "OPTIONS" and int(new[1]) > 0:
        return f"SR{int(new[1]) - 1}_{new[2]}"
    return None


def replaced_in_px4(name: str) -> bool:
    """Whether the other name of a parameter wants another value."""
    return name in _PX4_REPLACED


def made_for(names: frozenset[str]) -> int | None:
    """The MAV_AUTOPILOT that has parameters with such names; None: it cannot be told."""
    px4 = any(map(_OF_PX4.fullmatch, names))
    ardupilot = any(map(_OF_ARDUPILOT.fullmatch, names))
    return None if px4 == ardupilot else PX4 if px4 else ARDUPILOT


def fitting_file(autopilot: int, version: tuple[int, int, int], names: frozenset[str] = frozenset()) -> str | None:
    """The file of firmware_params/ for a vehicle; None: there is none, or it cannot be told.

    :param version: all 0: not known; then `names` decide, parameters that the vehicle is known to have.
    """
    if autopilot == PX4:
        return "px4.params"
    if autopilot != ARDUPILOT:
        return None
    if version > (0, 0, 0):
        newer = version[:2] >= RENAMING_VERSION
    elif bool(names & _RENAMED.keys()) != bool(names & _RENAMED_BACK.keys()):
        newer = bool(names & _RENAMED_BACK.keys())
    else:
        return None
    return "ardupilot-4.7.parm" if newer else "ardupilot-4.6.parm"
