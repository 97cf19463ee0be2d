"""AIRDOS03 detectors, which send MAVLink TUNNEL messages through the autopilot as TF-ATMON instruments do.

Their firmware is public: github.com/UniversalScientificTechnologies/AIRDOS03, `fw/AIRDOS03_MAVLink`, whose README has
the messages. Every 10 s the detector sends what it has counted: STOP with the events in channel 64 and above, and two
messages with the histogram of the channels below. The first channels are noise: the authors' analysis
(`sw/flux_analysis.py`) leaves out six. Nothing published says how many counts are a dose rate.

All of them send as system 1, component 10, with the payload type of TF-ATMON for an AIRDOS03, which is 4.
"""

from __future__ import annotations

import struct
from collections.abc import Callable

from rass_mav.errors import MalformedError

from .base import MAX_WAITING, SensorReading, SensorState, TunnelSensor
from .dose import DoseMeter
from .protocol import shown
from .settings import SensorSettings

#: Who sends: system and component; and the type of the payload.
SENDER, PAYLOAD_TYPE = (1, 10), 4
#: Seconds in which it counts.
CYCLE_S = 10.0
#: Channels of the histogram with noise, the lowest ones.
NOISE = 6

_STOP, _HIST_LO, _HIST_HI = 0x04, 0x05, 0x06
#: Messages that say nothing about counts: STARTUP, TIMESYNC, START, EVENTS, ENV, ALIVE.
_OTHERS = frozenset((0x01, 0x02, 0x03, 0x07, 0x08, 0x09))
# type, cycle, Unix time, hundredths, ticks, events in all, events sent
_STOP_FIELDS = struct.Struct("<BHIBHHH")
# type, cycle, 32 channels
_HIST_FIELDS = struct.Struct("<BH32H")


def decode_counts(payload: bytes) -> tuple[int, int, int] | None:
    """The kind of a message, its cycle, and its counts; None: it has none. Raises `MalformedError`."""
    kind = payload[0] if payload else None
    if kind in _OTHERS:
        return None
    fields = {_STOP: _STOP_FIELDS, _HIST_LO: _HIST_FIELDS, _HIST_HI: _HIST_FIELDS}.get(kind or 0)
    if kind is None or fields is None or len(payload) != fields.size:
        raise MalformedError(f"expected a message of an AIRDOS03, got {shown(payload)}")
    values = fields.unpack(payload)
    if kind == _STOP:
        return kind, values[1], values[5]
    return kind, values[1], sum(values[2 + NOISE if kind == _HIST_LO else 2 :])


class Airdos(TunnelSensor):
    """Hears the autopilot's port."""

    def __init__(self, meter: DoseMeter, now: Callable[[], float]) -> None:
        """`now`: the driver's timeline, seconds."""
        super().__init__("airdos")
        self._meter = meter
        self._now = now
        self._cycle = -1
        self._counts: dict[int, int] = {}
        """What is known of this cycle, by kind of message."""
        self._readings: list[SensorReading] = []
        self._count = self._malformed = 0
        self._heard = False
        self._trouble = ""
        self._wake: Callable[[], None] = lambda: None  # until `start`

    def start(self, wake: Callable[[], None]) -> None:
        """Nothing to open."""
        self._wake = wake

    def tunnel(self, system_id: int, component_id: int, payload_type: int, payload: bytes) -> None:
        """A TUNNEL message at the autopilot's port, whoever sent it."""
        if (system_id, component_id) != SENDER or payload_type != PAYLOAD_TYPE:
            return
        self._heard = True
        try:
            found = decode_counts(payload)
        except MalformedError as error:
            self._malformed += 1
            self._trouble = str(error)
            return
        self._trouble = ""
        if found is None:
            return
        kind, cycle, counts = found
        if cycle != self._cycle:
            self._cycle, self._counts = cycle, {}
        self._counts[kind] = counts
        if len(self._counts) == 3:
            cpm = sum(self._counts.values()) * 60.0 / CYCLE_S
            # Sent again, they are the same cycle, and no other reading.
            self._counts = {}
            self._count += 1
            self._readings = [*self._readings, SensorReading(self._meter.reading(cpm), self._now())][-MAX_WAITING:]
            self._wake()

    def receive(self) -> list[SensorReading]:
        """The readings since the last call."""
        arrived, self._readings = self._readings, []
        return arrived

    def state(self) -> SensorState:
        """Its state."""
        unheard = "" if self._heard else "no AIRDOS03 heard at the autopilot's port"
        return SensorState(self._heard, self._count, self._malformed, 0, 0, int(self._heard), self._trouble or unheard)

    def close(self) -> None:
        """Nothing to release."""


def open_airdos(settings: SensorSettings, now: Callable[[], float]) -> Airdos:
    """The detector of a configuration; `now`: the driver's timeline."""
    return Airdos(settings.meter(), now)
