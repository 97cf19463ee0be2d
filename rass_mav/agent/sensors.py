"""The section `sensor`: what can be set of a node's own radiation sensor (docs/sensors.md)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Literal

from rass_mav.agent.settings import NonNegative, Positive
from rass_mav.config.sections import Meta, Section
from rass_mav.config.typed import shown
from rass_mav.errors import ConfigError, LogError
from rass_mav.sensor.base import Sensor
from rass_mav.sensor.dose import TUBES, DoseMeter, Tube, Unit
from rass_mav.sensor.kinds import LOG_TUBE, SERIAL_KINDS

#: The keys of `sensor.dose.TUBES`.
TubeName = Literal["sbm-20", "j305", "m4011", "lnd-7317", "safecast"]


class CountsSettings(Section):
    """From counts to readings, for recorded bGeigie logs."""

    unit: Unit = "usvh"
    """usvh: microsievert per hour; cpm, cps: counts per minute, per second."""
    tube: TubeName | None = None
    """Which tube it is; null: the one that bGeigies have, converted as Safecast does."""
    cpm_per_usvh: Positive | None = None
    """Its counts per minute in 1 uSv/h; null: the tube's."""
    dead_time_us: NonNegative | None = None
    """Its dead time, microseconds; null: the tube's; 0: no correction."""

    def meter(self) -> DoseMeter:
        """A new converter with these settings."""
        tube = TUBES[self.tube or LOG_TUBE]
        return DoseMeter(_with(tube, self.cpm_per_usvh, self.dead_time_us), self.unit)


class SensorSettings(Section):
    """Where a node's readings come from."""

    type: Literal["autopilot", "mightyohm", "gmc", "radpro", "bgeigie", "log"] = "autopilot"
    """autopilot: NAMED_VALUE_FLOAT `mavlink.reading_name`; log: a recorded bGeigie log, for demonstrations."""
    port: Annotated[str, Meta(min_length=1)] | None = None
    """Serial port of the counter."""
    baud: Annotated[int, Meta(ge=50, le=4_000_000)] | None = None
    """bit/s; null: as the counter comes from the factory."""
    path: Annotated[str, Meta(min_length=1)] | None = None
    """The log."""
    speed: Positive = 1.0
    """Seconds of the log in a second."""
    unit: Unit = "usvh"
    """Of a counter's readings. usvh: microsievert per hour; cpm, cps: counts per minute, per second."""
    tube: TubeName | None = None
    """Which tube the counter has; null: the one it usually has."""
    cpm_per_usvh: Positive | None = None
    """Its counts per minute in 1 uSv/h; null: what the counter says, else the tube's."""
    dead_time_us: NonNegative | None = None
    """Its dead time, microseconds; null: the tube's, unless the counter corrects for it; 0: no correction."""

    def check(self) -> None:
        """Raise `ConfigError` for keys that are missing, or would have no effect."""
        serial = self.type in SERIAL_KINDS
        if serial and self.port is None:
            raise ConfigError(f"sensor.port: missing, expected the counter's serial port with sensor.type {self.type}")
        if self.type == "log" and self.path is None:
            raise ConfigError("sensor.path: missing, expected a bGeigie log with sensor.type log")
        idle = [] if serial else ["port", "baud"]
        idle += [] if self.type == "log" else ["path", "speed"]
        idle += ["unit", "tube", "cpm_per_usvh", "dead_time_us"] if self.type == "autopilot" else []
        for key in idle:
            value, default = getattr(self, key), getattr(_DEFAULTS, key)
            if value != default:
                raise ConfigError(f"sensor.{key}: has no effect with sensor.type {self.type}, got {shown(value)}")

    def open(self, now: Callable[[], float]) -> Sensor | None:
        """The sensor; None: readings are the autopilot's.

        :param now: the node's timeline, seconds.
        :raises ConfigError: pyserial is missing, or there is no log with a valid record at `path`.
        """
        if self.type == "autopilot":
            return None
        if self.type == "log":
            from rass_mav.sensor.bgeigie_log import load_bgeigie
            from rass_mav.sensor.playback import PlaybackSensor

            assert self.path is not None
            try:
                recorded = load_bgeigie(self.path)
            except (ConfigError, LogError) as error:
                raise ConfigError(f"sensor.path: {error}") from None
            return PlaybackSensor(self.path, recorded, self.meter(), now, speed=self.speed)
        from rass_mav.sensor.serial_sensor import SerialSensor

        assert self.port is not None
        kind = SERIAL_KINDS[self.type]
        return SerialSensor(self.port, self.baud or kind.baud, kind.protocol(), self.meter(), now)

    def meter(self) -> DoseMeter:
        """A new converter for this counter."""
        kind = SERIAL_KINDS.get(self.type)
        tube = TUBES[self.tube or (LOG_TUBE if kind is None else kind.tube)]
        if kind is not None and kind.corrects and self.tube is None:
            tube = tube._replace(dead_time_us=0.0)
        told = self.tube is not None or self.cpm_per_usvh is not None
        return DoseMeter(_with(tube, self.cpm_per_usvh, self.dead_time_us), self.unit, believe_device=not told)


_DEFAULTS = SensorSettings()


def _with(tube: Tube, cpm_per_usvh: float | None, dead_time_us: float | None) -> Tube:
    return Tube(
        tube.cpm_per_usvh if cpm_per_usvh is None else cpm_per_usvh,
        tube.dead_time_us if dead_time_us is None else dead_time_us,
    )
