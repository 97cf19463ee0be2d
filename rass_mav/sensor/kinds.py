"""The sensors that a configuration can name, one row each. A node loads only the module of its own sensor."""

from __future__ import annotations

from typing import NamedTuple

#: The keys that determine how counts become readings.
_OF_COUNTS = ("unit", "tube", "cpm_per_usvh", "dead_time_us")


class SensorKind(NamedTuple):
    """A kind of sensor."""

    opener: str | None
    """`module:name` of the function that creates the `Sensor` from the `SensorSettings` and the node's clock. None:
    readings come from the autopilot, or are handed in."""
    keys: tuple[str, ...] = ()
    """The keys that have an effect with it. The first one is required if it `needs` one."""
    needs: str = ""
    """What the required key must be, in words."""
    tube: str = ""
    """Its usual tube, a key of `dose.TUBES`."""
    protocol: str = ""
    """`module:name` of the `Protocol` of a device on a serial port."""
    baud: int = 0
    """Factory setting of such a device, bit/s."""
    corrects: bool = False
    """Whether the device corrects its rate for dead time. By default, we then do not."""
    at_autopilot: bool = False
    """Whether it sends TUNNEL messages through the autopilot."""
    handed_in: bool = False
    """Whether programs on this computer hand in its readings (`rass-mav measure`)."""


def counter(protocol: str, baud: int, tube: str, *, corrects: bool = False) -> SensorKind:
    """The row of a counter on a serial port, with its factory settings."""
    opener, keys = "rass_mav.sensor.serial_sensor:open_counter", ("port", "baud", *_OF_COUNTS)
    return SensorKind(opener, keys, "the counter's serial port", tube, protocol, baud, corrects)


KINDS: dict[str, SensorKind] = {
    "autopilot": SensorKind(None),
    "program": SensorKind(None, ("unit", "cpm_per_usvh"), handed_in=True),
    "mightyohm": counter("rass_mav.sensor.mightyohm:MightyOhm", 9600, "sbm-20"),
    "gmc": counter("rass_mav.sensor.gmc:Gmc", 115200, "m4011"),
    "radpro": counter("rass_mav.sensor.radpro:RadPro", 115200, "m4011", corrects=True),
    "bgeigie": counter("rass_mav.sensor.bgeigie:Bgeigie", 57600, "safecast"),
    "radiacode": SensorKind("rass_mav.sensor.radiacode:open_radiacode", ("port", "unit")),
    "airdos": SensorKind("rass_mav.sensor.airdos:open_airdos", ("unit", "cpm_per_usvh"), at_autopilot=True),
    "log": SensorKind("rass_mav.sensor.playback:open_log", ("path", "speed", *_OF_COUNTS), "a bGeigie log", "safecast"),
}
