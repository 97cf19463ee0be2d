"""Converts counts to a dose rate: dead time, the tube's sensitivity, units."""

from __future__ import annotations

from typing import Literal, NamedTuple

from rass_mav.errors import MalformedError

Unit = Literal["usvh", "cpm", "cps"]

#: The correction for dead time stops growing where a tube is dead for this share of the time. There the true rate is
#: 100 times the measured one. Close to the formula's pole its result would mean nothing.
MAX_DEAD = 0.99


class Tube(NamedTuple):
    """A Geiger-Mueller tube."""

    cpm_per_usvh: float
    """Counts per minute at 1 microsievert per hour of Cs-137."""
    dead_time_us: float
    """Microseconds after each pulse in which it detects nothing; 0: unknown, so not corrected."""


TUBES: dict[str, Tube] = {
    "sbm-20": Tube(106.0, 190.0),
    "j305": Tube(135.0, 0.0),
    "m4011": Tube(108.0, 0.0),
    "lnd-7317": Tube(253.0, 40.0),
    # The same tube with Safecast's conversion and no correction, so that readings agree with Safecast's map.
    "safecast": Tube(334.0, 0.0),
}


class DoseMeter:
    """Converts a device's counts into readings of one unit."""

    __slots__ = ("believe_device", "cpm_per_usvh", "dead_time_us", "saturated", "unit")

    def __init__(self, tube: Tube, unit: Unit = "usvh", *, believe_device: bool = True) -> None:
        """:param unit: of the readings: usvh (microsievert per hour), cpm or cps (counts per minute, per second).
        :param believe_device: use the sensitivity that the device reports, if any, instead of that of `tube`.
        :raises ValueError: a sensitivity that is not above 0, or a negative dead time.
        """
        if tube.cpm_per_usvh <= 0.0 or tube.dead_time_us < 0.0:
            raise ValueError(f"a tube needs a sensitivity above 0 and a dead time of at least 0, got {tube}")
        self.cpm_per_usvh = tube.cpm_per_usvh
        self.dead_time_us = tube.dead_time_us
        self.unit: Unit = unit
        self.believe_device = believe_device
        self.saturated = 0
        """Readings that are a lower bound, because the tube was dead more than `MAX_DEAD` of the time."""

    def true_cpm(self, cpm: float) -> float:
        """The rate without dead time tau: m / (1 - m tau), non-paralysable.

        From m tau = `MAX_DEAD` the factor stays at 100, and `saturated` counts the reading.
        """
        dead = cpm * self.dead_time_us / 60e6
        if dead > MAX_DEAD:
            self.saturated += 1
            dead = MAX_DEAD
        return cpm / (1.0 - dead)

    def reading(self, cpm: float, cpm_per_usvh: float | None = None) -> float:
        """The reading for a measured rate.

        :param cpm: counts per minute as the device reports them, at least 0.
        :param cpm_per_usvh: the sensitivity that the device reports, above 0; None: it reports none.
        """
        true = self.true_cpm(cpm)
        if self.unit == "cpm":
            return true
        if self.unit == "cps":
            return true / 60.0
        return true / (cpm_per_usvh if cpm_per_usvh is not None and self.believe_device else self.cpm_per_usvh)


#: The units in which programs state readings: what they measure, and how many uSv/h or counts a minute one of them is.
STATED: dict[str, tuple[str, float]] = {
    "uSv/h": ("usvh", 1.0), "usvh": ("usvh", 1.0), "\u00b5Sv/h": ("usvh", 1.0), "\u03bcSv/h": ("usvh", 1.0),
    "nSv/h": ("usvh", 1e-3), "mSv/h": ("usvh", 1e3), "Sv/h": ("usvh", 1e6),
    "cpm": ("cpm", 1.0), "cps": ("cpm", 60.0), "counts": ("counts", 1.0),
}  # fmt: skip


def converted(value: float, stated: str, unit: str, cpm_per_usvh: float | None) -> float:
    """A reading in another unit.

    :param stated: its unit, a key of `STATED`.
    :param unit: the wanted one, as well.
    :param cpm_per_usvh: counts per minute at 1 uSv/h, above 0; None: unknown.
    :raises MalformedError: counts and dose rates need a sensitivity; counts of no stated time are no rate.
    """
    kind, factor = STATED[stated]
    wanted, size = STATED[unit]
    if kind == wanted:
        return value * factor / size
    if "counts" in (kind, wanted):
        raise MalformedError(f"unit: {stated} cannot be converted to {unit}, the unit of this node's readings")
    if cpm_per_usvh is None:
        raise MalformedError(
            f"unit: {stated} needs sensor.cpm_per_usvh to be converted to {unit}, the unit of this node's readings"
        )
    value *= factor / size
    return value * cpm_per_usvh if wanted == "cpm" else value / cpm_per_usvh
