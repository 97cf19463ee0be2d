"""A DroneBridge for ESP32 as its host sees it, by its published sources (v2.3.0); built and read by pymavlink alone.

It answers the parameter SYS_ESP32_MODE and AUTOPILOT_VERSION at its serial port, whatever its mode. A ground unit also
lets through what air units send, with their RADIO_STATUS.
"""

from __future__ import annotations

import struct

from pymavlink.dialects.v20 import common

AIR, GROUND, ACCESS_POINT = 4, 5, 1


class DroneBridge:
    """Bytes in, bytes out."""

    def __init__(self, mode: int, version: tuple[int, int, int] = (2, 3, 0), system_id: int = 1) -> None:
        self.mode = mode
        self.version = version
        self._mav = common.MAVLink(None, system_id, 68)
        self._mav.robust_parsing = True

    def hear(self, data: bytes) -> bytes:
        """What it answers."""
        return b"".join(self._answer(message) for message in self._mav.parse_buffer(data) or [])

    def _answer(self, message: common.MAVLink_message) -> bytes:
        kind = message.get_type()
        if kind not in ("PARAM_REQUEST_READ", "COMMAND_LONG") or message.target_system not in (0, self._mav.srcSystem):
            return b""
        if kind == "PARAM_REQUEST_READ":
            if message.param_id != "SYS_ESP32_MODE":
                return b""
            (value,) = struct.unpack("<f", struct.pack("<B3x", self.mode))
            return self._packed(common.MAVLink_param_value_message(b"SYS_ESP32_MODE", value, 1, 17, 65535))
        if (message.command, message.param1) != (512, 148):
            return b""
        major, minor, patch = self.version
        # Before 2.2 it put the major version where the kind of release belongs, and the minor elsewhere.
        number = major << 24 | minor << 16 | patch << 8 | 255 if self.version >= (2, 2, 0) else major
        zeros = [0] * 8
        return self._packed(common.MAVLink_command_ack_message(512, 0)) + self._packed(
            common.MAVLink_autopilot_version_message(8192, number, 20, 0, 1205, zeros, zeros, zeros, 0, 0, 0)
        )

    def radio_status(self) -> bytes:
        """What an air unit sends once a second."""
        return self._packed(common.MAVLink_radio_status_message(200, 198, 0, 161, 161, 0, 0))

    def _packed(self, message: common.MAVLink_message) -> bytes:
        packed: bytes = message.pack(self._mav)
        return packed
