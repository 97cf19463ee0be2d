"""A recorded log as a sensor, for demonstrations: readings come at the intervals at which they were measured."""

from __future__ import annotations

from collections.abc import Callable

from rass_mav.errors import ConfigError, LogError

from .base import MAX_WAITING, Sensor, SensorReading, SensorState
from .bgeigie_log import BgeigieLog, load_bgeigie
from .dose import DoseMeter
from .settings import SensorSettings


class PlaybackSensor(Sensor):
    """Plays the log from its first record when it starts. After the last record there are no more readings."""

    def __init__(
        self, name: str, log: BgeigieLog, meter: DoseMeter, now: Callable[[], float], *, speed: float = 1.0
    ) -> None:
        """:param log: with at least one record.
        :param now: the driver's timeline, seconds.
        :param speed: seconds of the log per second, above 0.
        """
        super().__init__(name)
        begin_us = log.records[0].time_us
        self._due = [
            ((record.time_us - begin_us) / 1e6 / speed, record.cpm) for record in log.records if record.cpm is not None
        ]
        self._malformed = log.rejected
        self._meter = meter
        self._now = now
        self._begin: float | None = None
        self._next = 0
        self._dropped = 0

    def start(self, wake: Callable[[], None]) -> None:
        """Start the log. `wake` is not called: the driver asks at every step."""
        self._begin = self._now()

    def receive(self) -> list[SensorReading]:
        """The log's readings up to now. Their times are right even if the driver is late."""
        if self._begin is None:
            return []
        passed = self._now() - self._begin
        first = self._next
        while self._next < len(self._due) and self._due[self._next][0] <= passed:
            self._next += 1
        self._dropped += max(0, self._next - first - MAX_WAITING)
        return [
            SensorReading(self._meter.reading(cpm), self._begin + at)
            for at, cpm in self._due[max(first, self._next - MAX_WAITING) : self._next]
        ]

    def state(self) -> SensorState:
        """Its state."""
        ended = self._next == len(self._due)
        return SensorState(
            self._begin is not None, self._next - self._dropped, self._malformed, self._meter.saturated, self._dropped,
            int(self._begin is not None), "the log has ended" if ended else "",
        )  # fmt: skip

    def close(self) -> None:
        """Nothing to release."""


def open_log(settings: SensorSettings, now: Callable[[], float]) -> PlaybackSensor:
    """Open the log of a configuration; `now`: the driver's timeline. Raises `ConfigError`: no valid record."""
    assert settings.path is not None
    try:
        log = load_bgeigie(settings.path)
    except (ConfigError, LogError) as error:
        raise ConfigError(f"sensor.path: {error}") from None
    return PlaybackSensor(settings.path, log, settings.meter(), now, speed=settings.speed)
