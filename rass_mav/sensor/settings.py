"""Settings of a node's own radiation sensor (docs/how-to/sensors.md)."""

from __future__ import annotations

from collections.abc import Callable
from pkgutil import resolve_name
from typing import Annotated

from rass_mav.config.sections import Meta, Mistakes, NonNegative, Positive, Section
from rass_mav.config.typed import shown

from .base import Sensor
from .dose import TUBES, DoseMeter, Tube, Unit
from .kinds import KINDS, SensorKind

TubeName = Annotated[str, Meta(one_of=TUBES.keys)]


class SensorSettings(Section):
    """The source of radiation readings (docs/how-to/sensors.md). A key that has no effect with the type is an error."""

    type: Annotated[str, Meta(one_of=KINDS.keys)] = "autopilot"
    """autopilot: NAMED_VALUE_FLOAT `mavlink.reading_name`; program: programs on this computer submit readings; log: a
    recorded bGeigie log, for demonstrations; the others: a detector of this kind."""
    port: Annotated[str, Meta(min_length=1)] | None = None
    """Serial port of the counter. Of a RadiaCode its serial number or Bluetooth address; null: the first on USB."""
    baud: Annotated[int, Meta(ge=50, le=4_000_000)] | None = None
    """Speed of the port; null: the counter's factory setting."""
    path: Annotated[str, Meta(min_length=1)] | None = None
    """With type log: path of the log."""
    speed: Positive = 1.0
    """With type log: seconds of the log per second."""
    unit: Unit = "usvh"
    """Unit of a counter's readings. usvh: microsievert per hour; cpm, cps: counts per minute, per second."""
    tube: TubeName | None = None
    """Tube of the counter; null: its usual one."""
    cpm_per_usvh: Positive | None = None
    """Counts per minute at 1 uSv/h; null: what the counter reports, or else that of the tube."""
    dead_time_us: NonNegative | None = None
    """Dead time of the tube; null: its usual one, unless the counter corrects for it; 0: no correction."""

    @property
    def kind(self) -> SensorKind:
        """Its row in the registry."""
        return KINDS[self.type]

    @property
    def own(self) -> bool:
        """Whether the node has its own sensor, or programs hand in readings; False: they come from the autopilot."""
        return self.kind.opener is not None or self.kind.handed_in

    def check(self) -> None:
        """Raise `ConfigError` for keys that are missing or have no effect."""
        kind = self.kind
        mistakes = Mistakes()
        if kind.needs and getattr(self, kind.keys[0]) is None:
            mistakes.add(f"sensor.{kind.keys[0]}", f"missing, expected {kind.needs} with sensor.type {self.type}")
        if kind.at_autopilot and self.unit == "usvh" and self.cpm_per_usvh is None:
            mistakes.add("sensor.unit", f"expected cps or cpm with sensor.type {self.type}, or sensor.cpm_per_usvh too")
        for key, value in vars(self).items():
            if key not in ("type", *kind.keys) and value != getattr(type(self), key):
                mistakes.add(f"sensor.{key}", f"has no effect with sensor.type {self.type}, got {shown(value)}")
        mistakes.check()

    def open(self, now: Callable[[], float]) -> Sensor | None:
        """Open the sensor; None: readings come from the autopilot, or are handed in.

        :param now: the node's timeline, seconds.
        :raises ConfigError: pyserial is missing, or `path` is not a log with a valid record.
        """
        opener = self.kind.opener
        return None if opener is None else resolve_name(opener)(self, now)

    def meter(self) -> DoseMeter:
        """A new converter for this counter."""
        name = self.tube or self.kind.tube
        tube = TUBES[name] if name else Tube(1.0, 0.0)
        if self.kind.corrects and self.tube is None:
            tube = tube._replace(dead_time_us=0.0)
        is_set = self.tube is not None or self.cpm_per_usvh is not None
        return DoseMeter(adjusted(tube, self.cpm_per_usvh, self.dead_time_us), self.unit, believe_device=not is_set)


def adjusted(tube: Tube, cpm_per_usvh: float | None, dead_time_us: float | None) -> Tube:
    """The tube with these values in place of its own; None: its own."""
    return Tube(
        tube.cpm_per_usvh if cpm_per_usvh is None else cpm_per_usvh,
        tube.dead_time_us if dead_time_us is None else dead_time_us,
    )
