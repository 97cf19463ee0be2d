"""The kinds of sensors that a configuration can name. A node loads the protocol of its own one only."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from .protocol import Protocol


class Kind(NamedTuple):
    """A device on a serial port."""

    protocol: Callable[[], Protocol]
    baud: int
    """bit/s, as it comes from the factory."""
    tube: str
    """The tube that it usually has, a key of `dose.TUBES`."""
    corrects: bool = False
    """It corrects its rate for dead time itself, so that we do not by default."""


def _mightyohm() -> Protocol:
    from .mightyohm import MightyOhm

    return MightyOhm()


def _gmc() -> Protocol:
    from .gmc import Gmc

    return Gmc()


def _radpro() -> Protocol:
    from .radpro import RadPro

    return RadPro()


def _bgeigie() -> Protocol:
    from .bgeigie import Bgeigie

    return Bgeigie()


SERIAL_KINDS: dict[str, Kind] = {
    "mightyohm": Kind(_mightyohm, 9600, "sbm-20"),
    "gmc": Kind(_gmc, 115200, "m4011"),
    "radpro": Kind(_radpro, 115200, "m4011", corrects=True),
    "bgeigie": Kind(_bgeigie, 57600, "safecast"),
}
#: The tube of a recorded bGeigie log.
LOG_TUBE = "safecast"
