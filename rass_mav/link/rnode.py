"""A LoRa modem with the RNode firmware on a serial port, under the control of this host.

The protocol was read in the published sources: RNode_Firmware 1.86 (Framing.h, RNode_Firmware.ino, Utilities.h), and
RNS/Interfaces/RNodeInterface.py of Reticulum, which shows how a host talks to it. The modem listens before it sends, by
itself. The frames that are sent at once share a packet.
"""

from __future__ import annotations

import asyncio
import logging
from collections import deque
from collections.abc import Callable, Iterator
from typing import Any

from rass_mav.config.sections import Mistakes

from .address import parse_serial
from .airtime import BEACON_BYTES, MAX_TURN_S
from .base import Datagram, Inbox, LinkCounters, Remark
from .budget import FRAME_BYTES, USUAL, Budget
from .gathering import Gathering
from .kiss import Command, Unframer, framed
from .lora import allowed, packet_s
from .radio import SharedLink
from .serialport import SerialOpener
from .settings import LinkSection, RNodeSection
from .stream import Opener, StreamPort
from .vehicle import VehiclePort

log = logging.getLogger(__name__)

#: The most bytes in a packet (MTU in Config.h).
PACKET_BYTES = 508
#: The most frames at once: as many small ones as share a packet.
PACKET_FRAMES = 8
#: Packets that wait because the modem's queue is full. When there are more, the oldest is dropped.
MAX_WAITING = 4
#: The oldest firmware that reports what Reticulum needs.
OLDEST = (1, 52)
#: The modem has this long to answer, seconds. Many boards restart when their port is opened, which takes two.
ANSWER_S = 1.0
#: A modem whose queue is full is asked again after this, seconds.
FULL_S = 0.2
#: It is not blamed for silence before it was asked so often.
PATIENT = 4
#: A modem that is not set up as asked is set up again after this, seconds.
AGAIN_S = 5.0
#: Below this number of nodes in range, a swarm on so slow a link is hardly one.
_FEW_NODES = 5

_DATA, _FREQUENCY, _BANDWIDTH, _POWER, _SPREADING, _CODING, _STATE = range(7)
_DETECT, _LONG_LIMIT, _READY, _RSSI, _SNR, _CHANNEL, _FIRMWARE, _RESET, _ERROR = (
    0x08, 0x0C, 0x0F, 0x23, 0x24, 0x25, 0x50, 0x55, 0x90,
)  # fmt: skip
_DETECT_ASK, _DETECT_ANSWER, _RESET_DONE = b"\x73", b"\x46", b"\xf8"
_ON = b"\x01"
#: What is written as RSSI is this much above dBm; SNR has quarters of a dB.
_RSSI_OFFSET, _SNR_STEPS = 157, 4
_ERRORS = {
    0x01: "its radio chip does not start",
    0x02: "it could not send",
    0x03: "its memory is locked",
    0x04: "its queue is full",
    0x05: "its memory is full",
    0x06: "its radio chip does not answer",
}
#: What the modem has to have as asked, with the unit, and by how much it may round that.
_SETTINGS = {
    _FREQUENCY: ("frequency", "Hz", 100),
    _BANDWIDTH: ("bandwidth", "Hz", 0),
    _POWER: ("power", "dBm", 0),
    _SPREADING: ("spreading factor", "", 0),
    _CODING: ("coding rate", "", 0),
}


class RNodeLink(SharedLink):
    """The link. The modem is set up whenever its port was opened, and whenever it has restarted."""

    def __init__(self, opener: Opener, section: RNodeSection) -> None:
        """`section`: checked settings of the modem."""
        super().__init__(opener.name)
        self._port = StreamPort(opener)
        band = allowed(section)
        self._wanted = {
            _FREQUENCY: round(section.frequency_mhz * 1e6).to_bytes(4, "big"),
            _BANDWIDTH: round(section.bandwidth_khz * 1000).to_bytes(4, "big"),
            _POWER: bytes([section.power_dbm]),
            _SPREADING: bytes([section.spreading_factor]),
            _CODING: bytes([section.coding_rate]),
            # In hundredths of a percent of an hour; 0: no limit. The modem then stops sending by itself.
            _LONG_LIMIT: round(0 if band is None or band.duty >= 1.0 else band.duty * 10_000).to_bytes(2, "big"),
        }
        self._frames = Unframer(PACKET_BYTES)
        self._packets = Inbox()
        self._set_up_for = 0  # the opening of the port for which the modem was set up, or is being
        self._has: dict[int, bytes] = {}  # what the modem has reported since
        self._online = False
        self._fault = ""
        self._complaint = ""
        self._asked = 0
        self._firmware: tuple[int, int] | None = None
        self._rssi: int | None = None
        self._snr: float | None = None
        self._air: dict[str, float] | None = None
        self._errors = 0
        self._gathering: Gathering[None] = Gathering(PACKET_BYTES, self._hand_over)
        self._waiting: deque[bytes] = deque()
        self._may_send = True
        self._sent = 0
        self._dropped = 0
        self._alarm: asyncio.TimerHandle | None = None
        self._poll: asyncio.TimerHandle | None = None

    # -- the configuration ---------------------------------------------------------------------------------------------

    @staticmethod
    def check(section: LinkSection, key: str) -> None:
        """Raise `ConfigError` for invalid settings of such a link. `key`: the section's key."""
        mistakes = Mistakes()
        if section.device is None:
            mistakes.add(f"{key}.device", "missing, expected the modem's port, for example /dev/ttyUSB0,115200")
        else:
            with mistakes.gathering(f"{key}.device"):
                parse_serial(section.device)
        if section.rnode is None:
            mistakes.add(f"{key}.rnode", "missing, expected at least frequency_mhz and region")
        else:
            with mistakes.gathering():
                band = allowed(section.rnode, f"{key}.rnode")
                duty = None if section.airtime is None else section.airtime.duty
                if band is not None and duty is not None and duty > band.duty:
                    where = f"at {section.rnode.frequency_mhz:g} MHz in {section.rnode.region}"
                    mistakes.add(f"{key}.airtime.duty", f"expected {band.duty:g} or less {where}, got {duty:g}")
        mistakes.check()

    @classmethod
    def of(cls, section: LinkSection, vehicle: VehiclePort | None) -> RNodeLink:
        """Create the link of a checked configuration."""
        assert section.device is not None
        assert section.rnode is not None
        return cls(SerialOpener(*parse_serial(section.device), flow_control=section.flow_control), section.rnode)

    @staticmethod
    def usual(section: LinkSection) -> Budget:
        """What the air carries in full frames, and what the region allows one transmitter, for the whole swarm."""
        assert section.rnode is not None
        band = allowed(section.rnode)
        return USUAL._replace(
            bytes_s=FRAME_BYTES / packet_s(section.rnode, FRAME_BYTES),
            duty=min(USUAL.duty, 1.0 if band is None else band.duty),
            burst_frames=PACKET_FRAMES,
            packet_bytes=PACKET_BYTES,
        )

    @staticmethod
    def remarks(section: LinkSection, key: str) -> Iterator[Remark]:
        """Whether the air carries the beacons of more than a few nodes."""
        budget = section.budget
        assert budget is not None
        rate = budget.bytes_s * budget.duty
        nodes = int(MAX_TURN_S * rate * budget.beacons / BEACON_BYTES)
        if nodes < _FEW_NODES:
            yield Remark(
                key, f"{rate:.1f} bytes/s for the whole swarm: in {MAX_TURN_S:g} s the beacons of {nodes} nodes",
                "a smaller spreading factor, more bandwidth, or another part of the band (documentation: how-to/links)",
                works=True,
            )  # fmt: skip

    # -- the modem -----------------------------------------------------------------------------------------------------

    def start(self, wake: Callable[[], None]) -> None:
        """Start opening the port, on the running event loop."""
        self._packets.wake = wake
        self._port.start(self._woken)

    @property
    def generation(self) -> int:
        """How often the port was opened."""
        return self._port.generation

    @property
    def trouble(self) -> str:
        """Why nothing can leave: the port is not open, or the modem is not set up."""
        return self._port.trouble or ("" if self._online else self._fault or "the modem has not answered yet")

    def close(self) -> None:
        """Close the port. Waiting frames are lost. The modem goes on listening, and sends nothing."""
        self._stop_alarms()
        self._port.close()

    def _woken(self) -> None:
        if self._port.is_open and self._port.generation != self._set_up_for:
            self._set_up_for = self._port.generation
            self._frames.flush()
            self._set_up()
        self._read_on()
        self._packets.wake()

    def _read_on(self) -> None:
        # While the driver is behind, the stream waits, and then the kernel.
        while not self._packets.full and (pieces := self._port.take()):
            for piece, source in pieces:
                for command in self._frames.feed(piece):
                    if command.code == _DATA:
                        if command.data:
                            self._packets.put(Datagram(command.data, source))
                    else:
                        self._hear(command)

    def _set_up(self) -> None:
        """Ask whether a modem is there. Its answer starts the rest."""
        self._stop_alarms()
        self._online, self._may_send = False, True
        self._dropped += len(self._waiting)
        self._waiting.clear()
        self._has, self._complaint = {}, ""
        if self._port.is_open:
            self._port.write(framed(_DETECT, _DETECT_ASK) + framed(_FIRMWARE, b"\0"))
            self._alarm = asyncio.get_running_loop().call_later(ANSWER_S, self._unanswered)

    def _unanswered(self) -> None:
        if _DETECT in self._has:
            self._judge()
            return
        self._asked += 1
        if self._asked >= PATIENT:
            self._blame("the modem does not answer: check that it runs the RNode firmware")
        self._set_up()

    def _hear(self, command: Command) -> None:
        code, data = command
        if code == _DETECT and data == _DETECT_ANSWER:
            self._detected(data)
        elif code == _FIRMWARE and len(data) == 2:
            self._firmware = (data[0], data[1])
        elif code == _RESET and data == _RESET_DONE:
            # It has forgotten its settings.
            log.info("%s: the modem has restarted", self.name)
            self._set_up()
        elif code == _STATE and len(data) == 1:
            self._has[_STATE] = data
            if _DETECT in self._has:
                self._judge()
        elif code in self._wanted and len(data) == len(self._wanted[code]):
            self._has[code] = data
        elif code == _READY and len(data) == 1:
            self._ready(data == _ON)
        elif code == _ERROR and len(data) == 1:
            self._err(data[0])
        else:
            self._note(code, data)

    def _detected(self, data: bytes) -> None:
        if _DETECT in self._has:
            return
        self._has[_DETECT] = data
        self._stop_alarms()
        self._port.write(b"".join(framed(code, value) for code, value in self._wanted.items()) + framed(_STATE, _ON))
        self._alarm = asyncio.get_running_loop().call_later(ANSWER_S, self._unanswered)

    def _judge(self) -> None:
        """It has reported all that it was asked to set, or has had the time for it."""
        if self._alarm is not None:
            self._alarm.cancel()
        fault = self._wrong()
        if fault:
            self._online = False
            self._blame(fault)
            self._alarm = asyncio.get_running_loop().call_later(AGAIN_S, self._set_up)
        else:
            self._online, self._fault, self._alarm, self._asked = True, "", None, 0

    def _wrong(self) -> str:
        if self._firmware is not None and self._firmware < OLDEST:
            old, oldest = (f"{major}.{minor}" for major, minor in (self._firmware, OLDEST))
            return f"the modem's firmware {old} is too old, expected {oldest} or newer (rnodeconf --update)"
        for code, (name, unit, rounding) in _SETTINGS.items():
            wanted = int.from_bytes(self._wanted[code], "big")
            if code not in self._has:
                return f"the modem does not report its {name}"
            has = int.from_bytes(self._has[code], "big")
            if abs(has - wanted) > rounding:
                return f"{name}: asked for {wanted} {unit}".rstrip() + f", the modem has {has}"
        if self._has.get(_STATE) != _ON:
            return self._complaint or "the modem does not turn its radio on: set it up for its board (rnodeconf)"
        return ""

    def _blame(self, fault: str) -> None:
        if fault != self._fault:
            self._fault = fault
            log.warning("%s: %s", self.name, fault)

    def _err(self, number: int) -> None:
        self._errors += 1
        complaint = f"the modem reports: {_ERRORS.get(number, f'error {number:#04x}')}"
        if complaint != self._complaint:
            self._complaint = complaint
            log.warning("%s: %s", self.name, complaint)

    def _note(self, code: int, data: bytes) -> None:
        """What it says of the air."""
        if code == _RSSI and len(data) == 1:
            self._rssi = data[0] - _RSSI_OFFSET
        elif code == _SNR and len(data) == 1:
            self._snr = int.from_bytes(data, "big", signed=True) / _SNR_STEPS
        elif code == _CHANNEL and len(data) >= 8:
            _, own, _, load = (int.from_bytes(data[at : at + 2], "big") / 10_000 for at in (0, 2, 4, 6))
            self._air = {"airtime_1h": own, "load_1h": load}

    def _stop_alarms(self) -> None:
        for alarm in (self._alarm, self._poll):
            if alarm is not None:
                alarm.cancel()
        self._alarm = self._poll = None

    # -- packets -------------------------------------------------------------------------------------------------------

    def receive(self) -> list[Datagram]:
        """The packets of one turn, each of whole frames."""
        was_full = self._packets.full
        arrived = self._packets.take()
        if was_full:
            self._read_on()
        return arrived

    def send(self, frame: bytes, target: int) -> None:
        """Send to everybody, at the end of this turn of the event loop, together with others."""
        if not self._online or not self._port.is_open:
            self._dropped += 1
            return
        self._gathering.add(frame, None)

    def _hand_over(self, packet: bytes, to: None) -> None:
        if not self._online:
            self._dropped += 1
            return
        if len(self._waiting) >= MAX_WAITING:
            self._waiting.popleft()
            self._dropped += 1
        self._waiting.append(packet)
        self._pass_on()

    def _pass_on(self) -> None:
        """Give the modem the next packet, and ask whether it has space for another."""
        if self._may_send and self._waiting:
            self._may_send = False
            self._port.write(framed(_DATA, self._waiting.popleft()))
            self._sent += 1
            self._ask_ready()

    def _ask_ready(self) -> None:
        self._port.write(framed(_READY, _ON))
        # Without an answer it is not asked for ever: `airtime` bounds what it gets.
        self._poll = asyncio.get_running_loop().call_later(ANSWER_S, self._ready, True)

    def _ready(self, ready: bool) -> None:
        if self._poll is None or not self._online:
            return
        self._poll.cancel()
        self._poll = None
        if ready:
            self._may_send = True
            self._pass_on()
        else:
            self._poll = asyncio.get_running_loop().call_later(FULL_S, self._ask_ready)

    # -- for `status` --------------------------------------------------------------------------------------------------

    def counters(self) -> LinkCounters:
        """The counters so far, of packets."""
        return LinkCounters(self._sent, self._packets.taken, 0, self._port.counters().dropped_out + self._dropped, 0)

    def report(self) -> dict[str, Any]:
        """What the modem says of itself and of the air."""
        firmware = None if self._firmware is None else f"{self._firmware[0]}.{self._firmware[1]}"
        return {
            "modem": {
                "firmware": firmware,
                "rssi_dbm": self._rssi,
                "snr_db": self._snr,
                **(self._air or {"airtime_1h": None, "load_1h": None}),
                "errors": self._errors,
                "malformed": self._frames.malformed,
            }
        }
