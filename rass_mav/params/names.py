"""Which file of firmware_params/ matches a firmware, and the names of the same parameter in its versions."""

from __future__ import annotations

import re

from rass_mav.mavlink.firmware import ARDUPILOT, PX4, Firmware

_RENAMED = {"SYSID_THISMAV": "MAV_SYSID", "SYSID_MYGCS": "MAV_GCS_SYSID", "TELEM_DELAY": "MAV_TELEM_DELAY"}
_RENAMED_BACK = {new: old for old, new in _RENAMED.items()}
_RATE = re.compile(r"SR(\d)_([A-Z0-9_]+)")
_PORT = re.compile(r"MAV(\d)_([A-Z0-9_]+)")
_OF_PX4 = re.compile(r"MAV_\d_\w+|SER_[A-Z]+\d_BAUD|MAV_SYS_ID")
_OF_ARDUPILOT = re.compile(r"SERIAL\d_\w+|SR\d_\w+|MAV\d_\w+|BRD_\w+|SYSID_\w+|MAV_SYSID|SCR_ENABLE")
#: Parameters with the vehicle's system id. When one is set, the vehicle may send under the new id.
SYSTEM_ID_NAMES = frozenset({"SYSID_THISMAV", "MAV_SYSID", "MAV_SYS_ID"})
#: Parameters that take effect only after a reboot, even if no comment says so. A system id shows it when set.
_AFTER_REBOOT = re.compile(
    r"SERIAL\d_(PROTOCOL|BAUD|OPTIONS)|BRD_SER\d_RTSCTS|SR\d_\w+|MAV\d_OPTIONS|SCR_ENABLE|SYSID_THISMAV"
    r"|MAV_\d_\w+|SER_\w+_(BAUD|PROTO)|MAV_SYS_ID|RADS_(SOURCE|PORT|BAUD|PIN)"
)
#: Replacements in PX4's development branch, whose values have other meanings.
_PX4_REPLACED = {"MAV_1_CONFIG": "SER_TEL2_PROTO", "MAV_0_CONFIG": "SER_TEL1_PROTO"}


def other_name(name: str) -> str | None:
    """The name of a parameter in ArduPilot before or since 4.7, or in PX4's development branch; None: the same."""
    if found := _RENAMED.get(name) or _RENAMED_BACK.get(name) or _PX4_REPLACED.get(name):
        return found
    # The stream rates of port 2 became those of the third MAVLink port. The options of a port have no such
    # counterpart: SERIAL2_OPTIONS still exists, with fewer bits.
    if old := _RATE.fullmatch(name):
        return f"MAV{int(old[1]) + 1}_{old[2]}"
    if (new := _PORT.fullmatch(name)) and new[2] != "OPTIONS" and int(new[1]) > 0:
        return f"SR{int(new[1]) - 1}_{new[2]}"
    return None


def replaced_in_px4(name: str) -> bool:
    """Whether the other name of a parameter needs another value."""
    return name in _PX4_REPLACED


def needs_reboot(name: str) -> bool:
    """Whether a new value takes effect only after a reboot."""
    return _AFTER_REBOOT.fullmatch(name) is not None


def system_id_names(firmware: Firmware) -> tuple[str, ...]:
    """The name of the parameter with the vehicle's system id. Several: it is one of them; none: unknown."""
    if firmware.autopilot == PX4:
        return ("MAV_SYS_ID",)
    if firmware.autopilot != ARDUPILOT:
        return ()
    return {True: ("MAV_SYSID",), False: ("SYSID_THISMAV",), None: ("SYSID_THISMAV", "MAV_SYSID")}[firmware.renamed]


def second_protocol(firmware: Firmware) -> str:
    """What makes a port of this firmware send MAVLink 2."""
    if firmware.autopilot == PX4:
        return "set MAV_PROTO_VER 2, and reboot the autopilot"
    return "set SERIALn_PROTOCOL 2 for this port (SERIAL2 is TELEM2), and reboot the autopilot"


def made_for(names: frozenset[str]) -> int | None:
    """The MAV_AUTOPILOT that has parameters with such names; None: unknown."""
    px4 = any(map(_OF_PX4.fullmatch, names))
    ardupilot = any(map(_OF_ARDUPILOT.fullmatch, names))
    return None if px4 == ardupilot else PX4 if px4 else ARDUPILOT


def fitting_file(firmware: Firmware, names: frozenset[str] = frozenset()) -> str | None:
    """The file of firmware_params/ for a vehicle; None: there is none, or it is unknown.

    :param names: parameters that the vehicle is known to have. They decide if it did not report its version.
    """
    if firmware.autopilot == PX4:
        return "px4.params"
    if firmware.autopilot != ARDUPILOT:
        return None
    newer = firmware.renamed
    if newer is None and bool(names & _RENAMED.keys()) != bool(names & _RENAMED_BACK.keys()):
        newer = bool(names & _RENAMED_BACK.keys())
    if newer is None:
        return None
    return "ardupilot-4.7.parm" if newer else "ardupilot-4.6.parm"
