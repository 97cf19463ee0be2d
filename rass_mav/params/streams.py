"""How much telemetry an autopilot sends to the radio on its first telemetry port, by its parameters."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from rass_mav.mavlink.firmware import ARDUPILOT, PX4, Firmware

#: Bytes that each group of ArduPilot's streams sends at a rate of 1 Hz: of an ordinary copter with one GPS and one
#: battery, with full payloads and 12 bytes around each (the lists STREAM_..._msgs in ArduCopter's GCS_MAVLink_Copter
#: .cpp, or GCS_Mavlink.cpp to 4.6; the sizes are those of the ardupilotmega dialect).
GROUP_BYTES = {
    "RAW_SENS": 169,
    "EXT_STAT": 318,
    "RC_CHAN": 103,
    "POSITION": 80,
    "EXTRA1": 76,
    "EXTRA2": 32,
    "EXTRA3": 236,
}
#: A heartbeat a second leaves whatever the rates are.
_HEARTBEAT_BYTES = 21
#: What PX4 sends over an instance whose rate is 0: half of what its port carries, at ten bits a byte.
_PX4_PART = 0.5 / 10


class StreamLoad(NamedTuple):
    """What leaves on the port."""

    bytes_s: float
    names: str
    """The parameters that decide it, for people."""
    largest: str
    """The one that takes most, and its value; empty: none takes anything."""


def stream_names(firmware: Firmware) -> list[str]:
    """The parameters that `stream_load` uses, by their names in this firmware; empty: unknown firmware."""
    if firmware.autopilot == PX4:
        return ["MAV_0_RATE", "SER_TEL1_BAUD"]
    if firmware.autopilot != ARDUPILOT or firmware.renamed is None:
        return []
    return [f"{_prefix(firmware)}_{group}" for group in GROUP_BYTES]


def _prefix(firmware: Firmware) -> str:
    # Since 4.7 by the number of the MAVLink port, counted from 1: SERIAL0 (USB) is the first.
    return "MAV2" if firmware.renamed else "SR1"


def stream_load(firmware: Firmware, values: Mapping[str, float]) -> StreamLoad | None:
    """What the autopilot sends to TELEM1 by its own parameters; None: they are unknown.

    A ground station may ask for other rates.
    """
    if firmware.autopilot == PX4:
        if "MAV_0_RATE" not in values:
            return None
        rate = values["MAV_0_RATE"] or values.get("SER_TEL1_BAUD", 57600.0) * _PX4_PART
        return StreamLoad(rate, "MAV_0_RATE", f"MAV_0_RATE {values['MAV_0_RATE']:g}")
    prefix = _prefix(firmware)
    known = {name: values[name] for name in (f"{prefix}_{group}" for group in GROUP_BYTES) if name in values}
    if not known:
        return None
    parts = {name: rate * GROUP_BYTES[name.removeprefix(f"{prefix}_")] for name, rate in known.items()}
    name = max(parts, key=lambda name: parts[name])
    largest = f"{name} {known[name]:g}" if parts[name] else ""
    return StreamLoad(sum(parts.values()) + _HEARTBEAT_BYTES, f"{prefix}_*", largest)
