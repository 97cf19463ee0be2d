"""What the driver asks of a sensor."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import NamedTuple

#: Readings that may wait for the driver. Beyond it the oldest one is lost: the newest says most about the danger now.
MAX_WAITING = 64


class SensorReading(NamedTuple):
    """What a sensor said."""

    value: float
    """Finite, in the sensor's unit."""
    at: float
    """When it was received, seconds on the driver's timeline."""


class SensorState(NamedTuple):
    """How a sensor is, for status and for people."""

    connected: bool
    """Whether its port is open."""
    readings: int
    """Readings so far."""
    malformed: int
    """Answers, lines or records that made no sense."""
    saturated: int
    """Readings that are a lower bound, because the tube was dead nearly all of the time."""
    dropped: int
    """Readings lost because the driver did not take them."""
    connections: int
    """How often its port was opened."""
    trouble: str
    """What is wrong; empty: nothing."""


class Sensor(ABC):
    """A source of readings. It never blocks the driver, and never raises for what the device does."""

    def __init__(self, name: str) -> None:
        """`name`: how status and log call it."""
        self.name = name

    @abstractmethod
    def start(self, wake: Callable[[], None]) -> None:
        """Begin, on the running event loop. `wake` is called on it when there is something new; a sensor whose
        readings can wait for the next step need not call it."""

    @abstractmethod
    def receive(self) -> list[SensorReading]:
        """The readings since the last call, at most `MAX_WAITING`, in order. A sensor that has failed gives none."""

    @abstractmethod
    def state(self) -> SensorState:
        """How it is."""

    @abstractmethod
    def close(self) -> None:
        """Release its port."""
