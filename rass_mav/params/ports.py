"""What an autopilot's parameters show about its MAVLink ports, and about the readings that it sends."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import NamedTuple

from rass_mav.mavlink.firmware import ARDUPILOT, PX4, Firmware

from .names import system_id_names

#: Ports of ArduPilot that are checked: SERIAL0 is USB, SERIAL1 is TELEM1, SERIAL2 is TELEM2.
_SERIALS = range(6)
_TELEMETRY = (1, 2)
#: MAVLink instances of PX4.
_INSTANCES = range(3)
#: SERIALn_PROTOCOL: MAVLink 1, MAVLink 2, MAVLink for high latency.
_MAVLINK = frozenset({1, 2, 43})
#: SERIALn_PROTOCOL of a port that a script reads.
SCRIPTING = 28
#: No forwarding: bit of SERIALn_OPTIONS to 4.6, and of MAVn_OPTIONS since 4.7.
_CLOSED_SERIAL, _CLOSED_MAV = 1 << 10, 1 << 1
#: Names of the ports in MAV_n_CONFIG.
_PX4_PORTS = {101: "TELEM1", 102: "TELEM2", 103: "TELEM3", 104: "TELEM4", 1000: "Ethernet"}


class ClosedPort(NamedTuple):
    """A MAVLink port that forwards nothing, in either direction."""

    port: str
    """Name for people."""
    parameter: str
    """The parameter that turns forwarding off."""
    value: int
    """Its present value."""
    opened: int
    """The value that turns forwarding on and changes nothing else."""


def telling_names(firmware: Firmware) -> list[str]:
    """The parameters that this module uses, by their names in this firmware; empty: unknown firmware."""
    own = list(system_id_names(firmware))
    if firmware.autopilot == PX4:
        return own + [f"MAV_{n}_{what}" for n in _INSTANCES for what in ("CONFIG", "FORWARD")]
    if firmware.autopilot != ARDUPILOT or firmware.renamed is None:
        return []
    options = (
        [f"MAV{n + 1}_OPTIONS" for n in _SERIALS] if firmware.renamed else [f"SERIAL{n}_OPTIONS" for n in _SERIALS[1:]]
    )
    return [*own, *(f"SERIAL{n}_PROTOCOL" for n in _SERIALS), *options, "SCR_ENABLE", "RADS_SOURCE"]


def closed_ports(firmware: Firmware, values: Mapping[str, float]) -> list[ClosedPort]:
    """The MAVLink ports that forward nothing. `values`: the vehicle's values of `telling_names`."""
    if firmware.autopilot == PX4:
        return list(_closed_instances(values))
    speaking = [n for n in _SERIALS if values.get(f"SERIAL{n}_PROTOCOL") in _MAVLINK]
    # Since 4.7 the options are numbered by the ports that use MAVLink, from 1.
    named = (
        [(n, f"MAV{place}_OPTIONS") for place, n in enumerate(speaking, 1)]
        if firmware.renamed
        else [(n, f"SERIAL{n}_OPTIONS") for n in speaking]
    )
    bit = _CLOSED_MAV if firmware.renamed else _CLOSED_SERIAL
    found = []
    for n, parameter in named:
        value = int(values.get(parameter, 0))
        if value & bit:
            found.append(ClosedPort(f"SERIAL{n}", parameter, value, value & ~bit))
    return found


def silent_ports(firmware: Firmware, values: Mapping[str, float]) -> list[ClosedPort]:
    """Of TELEM1 and TELEM2, where computer and radio usually are, those of an ArduPilot that do not use MAVLink."""
    if firmware.autopilot != ARDUPILOT:
        return []
    names = ((n, f"SERIAL{n}_PROTOCOL") for n in _TELEMETRY)
    return [
        ClosedPort(f"SERIAL{n}", name, int(values[name]), 2) for n, name in names if values.get(name, 2) not in _MAVLINK
    ]


def _closed_instances(values: Mapping[str, float]) -> Iterator[ClosedPort]:
    for n in _INSTANCES:
        forward, port = values.get(f"MAV_{n}_FORWARD"), values.get(f"MAV_{n}_CONFIG")
        if forward == 0 and port != 0:
            name = f"MAVLink instance {n}" if port is None else _PX4_PORTS.get(int(port), f"port {port:g}")
            yield ClosedPort(name, f"MAV_{n}_FORWARD", 0, 1)


def has_scripting_port(values: Mapping[str, float]) -> bool:
    """Whether there is a serial port for a script to read."""
    return any(values.get(f"SERIAL{n}_PROTOCOL") == SCRIPTING for n in _SERIALS)
