"""The interface of a sensor."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import NamedTuple

#: Readings that may wait for the driver. When there are more, the oldest is lost: the newest is the most useful.
MAX_WAITING = 64


class SensorReading(NamedTuple):
    """A reading of a sensor."""

    value: float
    """Finite, in the sensor's unit."""
    at: float
    """When it was received, seconds on the driver's timeline."""


class SensorState(NamedTuple):
    """The state of a sensor, for status and for people."""

    connected: bool
    """Whether its port is open."""
    readings: int
    """Readings so far."""
    malformed: int
    """Answers, lines or records that do not parse."""
    saturated: int
    """Readings that are a lower bound, because the tube was dead nearly all the time."""
    dropped: int
    """Readings lost because the driver did not take them."""
    connections: int
    """How often its port was opened."""
    trouble: str
    """What is wrong; empty: nothing."""


class Sensor(ABC):
    """A source of readings. It never blocks the driver, and never raises because of the device's behaviour."""

    def __init__(self, name: str) -> None:
        """`name`: its name in status and log."""
        self.name = name

    @abstractmethod
    def start(self, wake: Callable[[], None]) -> None:
        """Start, on the running event loop. The sensor calls `wake` on that loop when it has something new. A sensor
        whose readings can wait for the next step need not call it."""

    @abstractmethod
    def receive(self) -> list[SensorReading]:
        """The readings since the last call, at most `MAX_WAITING`, in order. A failed sensor returns none."""

    @abstractmethod
    def state(self) -> SensorState:
        """Its state."""

    @abstractmethod
    def close(self) -> None:
        """Release its port."""


class TunnelSensor(Sensor):
    """A sensor whose device sends MAVLink TUNNEL messages through the autopilot."""

    @abstractmethod
    def tunnel(self, system_id: int, component_id: int, payload_type: int, payload: bytes) -> None:
        """A TUNNEL message at the autopilot's port, whoever sent it: its sender, `payload_type` and 0 to 128 bytes.
        Never raises because of it."""
