"""The kinds of sensors that a configuration can name."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from .bgeigie import Bgeigie
from .gmc import Gmc
from .mightyohm import MightyOhm
from .protocol import Protocol
from .radpro import RadPro


class Kind(NamedTuple):
    """A device on a serial port."""

    protocol: Callable[[], Protocol]
    baud: int
    """bit/s, as it comes from the factory."""
    tube: str
    """The tube that it usually has, a key of `dose.TUBES`."""
    corrects: bool = False
    """It corrects its rate for dead time itself, so that we do not by default."""


SERIAL_KINDS: dict[str, Kind] = {
    "mightyohm": Kind(MightyOhm, 9600, "sbm-20"),
    "gmc": Kind(Gmc, 115200, "m4011"),
    "radpro": Kind(RadPro, 115200, "m4011", corrects=True),
    "bgeigie": Kind(Bgeigie, 57600, "safecast"),
}
#: The tube of a recorded bGeigie log.
LOG_TUBE = "safecast"
