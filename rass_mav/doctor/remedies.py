"""What a person can do at the autopilot, depending on its firmware: parameter names, and what it cannot do."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from rass_mav.mavlink.firmware import ARDUPILOT, PX4, Firmware
from rass_mav.params.names import system_id_names
from rass_mav.params.ports import SCRIPTING, ClosedPort, has_scripting_port

#: The vehicle's parameters by name. None: they were not read.
Values = Mapping[str, float] | None


def for_positions(firmware: Firmware) -> str:
    """Positions do not come, or too rarely."""
    if firmware.autopilot == PX4:
        return "set MAV_1_MODE 2 (Onboard) on the autopilot, and reboot it"
    if firmware.autopilot != ARDUPILOT:
        return "check autopilot.messages"
    rate = {True: "MAV3_POSITION", False: "SR2_POSITION", None: "SR2_POSITION or MAV3_POSITION"}[firmware.renamed]
    return f"check autopilot.messages, and {rate} on the autopilot"


def for_readings(firmware: Firmware, values: Values) -> tuple[str, str]:
    """The autopilot sends no readings: why, if the parameters show it (otherwise empty), and what to do."""
    if firmware.autopilot != ARDUPILOT:
        # PX4 has no scripts. Nothing is known about others.
        return "", "connect the counter to this computer and set sensor.type (documentation: how-to/sensors)"
    otherwise = "or connect the counter to this computer and set sensor.type"
    if values is None:
        script = "set SCR_ENABLE 1, install rass_rad.lua and set RADS_SOURCE (documentation: how-to/sensors)"
        return "", f"{script}; {otherwise}"
    if values.get("SCR_ENABLE") != 1:
        install = "install rass_rad.lua, set SCR_ENABLE 1 and reboot (documentation: how-to/sensors)"
        return "the autopilot runs no scripts", f"{install}; {otherwise}"
    source = values.get("RADS_SOURCE")
    if source is None:
        put = "copy rass_rad.lua to APM/scripts on its card and reboot (documentation: how-to/sensors)"
        return "the autopilot runs scripts, but not rass_rad.lua", f"{put}; {otherwise}"
    if source == 0:
        return (
            "RADS_SOURCE is 0: the script sends nothing",
            "set RADS_SOURCE and reboot (documentation: how-to/sensors)",
        )
    if source == 1 and not has_scripting_port(values):
        return (
            f"RADS_SOURCE is 1, a serial counter, but no port has SERIALn_PROTOCOL {SCRIPTING}",
            f"set SERIALn_PROTOCOL {SCRIPTING} for the counter's port, or another RADS_SOURCE, and reboot",
        )
    if source == 1:
        return (
            "RADS_SOURCE is 1, and the script sends nothing until it hears the counter",
            "check that the counter is on, wired to that port, and set to the speed in RADS_BAUD",
        )
    if source == 2:
        return "RADS_SOURCE is 2, pulses on a pin", "check RADS_PIN and SERVOn_FUNCTION (documentation: how-to/sensors)"
    if source == 3:
        return "RADS_SOURCE is 3: readings are simulated when there is a position", "wait for the position"
    return f"RADS_SOURCE is {source:g}, which the script does not support", "set RADS_SOURCE 1, 2 or 3 and reboot"


def for_signing(firmware: Firmware) -> str:
    """The autopilot requires signatures, and this node does not sign."""
    ours = "set autopilot.signing: true (rass-mav params signing; documentation: how-to/autopilot)"
    if firmware.autopilot == PX4:
        return f"{ours}, or turn signing off with the ground station that holds its key"
    return (
        f"{ours}, allow unsigned frames on this port (ArduPilot 4.7 and later: bit 0 of its MAVn_OPTIONS), use the "
        "autopilot's USB port (SERIAL0), or turn signing off"
    )


def for_closed_ports(closed: Sequence[ClosedPort]) -> str:
    """These ports do not forward."""
    settings = ", ".join(f"{port.parameter} {port.opened}" for port in closed)
    return f"set {settings}, and reboot the autopilot"


def for_system_id(firmware: Firmware | None) -> str:
    """Two vehicles have the same system id. `firmware`: that of this node's autopilot."""
    names = () if firmware is None else system_id_names(firmware)
    called = " or ".join(names or ("SYSID_THISMAV", "MAV_SYSID", "MAV_SYS_ID"))
    return (
        f"give each vehicle its own {called} (rass-mav params write ... --sysid N) and reboot it; "
        "on a node without an autopilot, set mavlink.system_id"
    )
