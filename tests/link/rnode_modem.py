"""RNode modems on pseudo-terminals, as RNode_Firmware 1.86 behaves towards its host, and the air between them.

Emulated: the commands that a host needs (detection, settings, radio state, data, readiness), restarts, errors, a queue
that is full. Not emulated: time on the air, listening, collisions, and loss, unless a test asks for it.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import re
from collections.abc import Callable
from pathlib import Path

from tests.ptys import SerialDevice

FREQUENCY, BANDWIDTH, POWER, SPREADING, CODING, STATE = range(1, 7)
DETECT, LIMIT, READY, RSSI, SNR, CHANNEL, FIRMWARE, RESET, ERROR = 8, 12, 15, 0x23, 0x24, 0x25, 0x50, 0x55, 0x90


def kiss(code: int, data: bytes) -> bytes:
    swapped = re.sub(b"[\xc0\xdb]", lambda found: b"\xdb" + {b"\xc0": b"\xdc", b"\xdb": b"\xdd"}[found[0]], data)
    return b"\xc0" + bytes([code]) + swapped + b"\xc0"


class Modem:
    """One modem. Its port appears when it is plugged in."""

    def __init__(self, path: Path, *, firmware: tuple[int, int] = (1, 86), most_power: int = 22) -> None:
        self.device = SerialDevice(path)
        self.firmware = firmware
        self.most_power = most_power
        self.works = True
        """Whether its radio can be turned on."""
        self.mute = False
        """Whether it answers nothing."""
        self.full = False
        """Whether its queue is."""
        self.settings: dict[int, bytes] = {}
        self.on = False
        self.sent: list[bytes] = []
        """Packets that went on the air."""
        self.asked: list[int] = []
        """The commands that came, in order."""
        self.transmit: Callable[[bytes], None] = lambda packet: None
        self._inside = b""

    def plug(self) -> Modem:
        self.device.plug()
        self.settings, self.on, self._inside = {}, False, b""
        asyncio.get_running_loop().add_reader(self.device.far, self._read)
        return self

    def unplug(self) -> None:
        asyncio.get_running_loop().remove_reader(self.device.far)
        self.device.unplug()

    def restart(self) -> None:
        """It forgets all and says so, as an ESP32 does."""
        self.settings, self.on = {}, False
        self.say(RESET, b"\xf8")

    def say(self, code: int, data: bytes) -> None:
        self.raw(kiss(code, data))

    def raw(self, data: bytes) -> None:
        with contextlib.suppress(OSError):  # nobody has opened the port
            os.write(self.device.far, data)

    def hear(self, packet: bytes) -> None:
        """A packet from the air."""
        if self.on:
            self.say(RSSI, bytes([157 - 80]))
            self.say(SNR, bytes([256 - 10]))  # -2.5 dB
            self.say(0, packet)

    def _read(self) -> None:
        try:
            self._inside += os.read(self.device.far, 4096)
        except OSError:
            return
        *frames, self._inside = self._inside.split(b"\xc0")
        for frame in filter(None, frames):
            plain = re.sub(b"\xdb([\xdc\xdd])", lambda found: b"\xc0" if found[1] == b"\xdc" else b"\xdb", frame[1:])
            self.asked.append(frame[0])
            if not self.mute:
                self._obey(frame[0], plain)

    def _obey(self, code: int, data: bytes) -> None:
        if code == DETECT and data == b"\x73":
            self.say(DETECT, b"\x46")
        elif code == FIRMWARE:
            self.say(FIRMWARE, bytes(self.firmware))
        elif code == POWER:
            self._set(code, bytes([min(data[0], self.most_power)]))
        elif code in (FREQUENCY, BANDWIDTH, SPREADING, CODING, LIMIT):
            self._set(code, data)
        elif code == STATE:
            self.on = data == b"\1" and self.works and self.settings.keys() >= {FREQUENCY, BANDWIDTH, POWER, SPREADING}
            if self.on or self.works:
                self.say(STATE, bytes([self.on]))
            else:
                self.say(ERROR, b"\1")
        elif code == READY:
            self.say(READY, bytes([not self.full]))
        elif code == 0 and self.on:
            self.sent.append(data)
            self.transmit(data)

    def _set(self, code: int, data: bytes) -> None:
        self.settings[code] = data
        self.say(code, data)


def join(one: Modem, other: Modem) -> None:
    """Each hears the other."""
    one.transmit, other.transmit = other.hear, one.hear
