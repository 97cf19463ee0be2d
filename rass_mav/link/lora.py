"""LoRa: how long a packet is on the air, and what a region allows. Pure."""

from __future__ import annotations

import math
from typing import NamedTuple

from rass_mav.errors import ConfigError

from .settings import RNodeSection

#: From this symbol time on, seconds, chips use the low data rate optimisation (Semtech AN1200.13).
_SLOW_SYMBOL_S = 0.016
#: The preamble that the RNode firmware sends: so many symbols at least, and so many seconds; shorter above a bit rate
#: (RNode_Firmware, Config.h and updateBitrate in Utilities.h).
_PREAMBLE, _PREAMBLE_S, _FAST_PREAMBLE_S, _FAST_BIT_S = 18, 0.024, 0.006, 30_000.0
#: The RNode firmware puts a byte before each packet on the air, and cuts what is longer than the rest of it in two.
PIECE_BYTES = 254


class Band(NamedTuple):
    """What a transmitter may do in a part of the spectrum."""

    low_mhz: float
    high_mhz: float
    duty: float
    """Share of the time that one transmitter may send, in any hour."""
    power_dbm: int
    """Most power, radiated by a dipole."""
    least_khz: float = 0.0
    """The narrowest signal that may stay on one frequency."""


#: ETSI EN 300 220-2 and ERC/REC 70-03, annex 1, without the polite spectrum access that needs more than listening; 47
#: CFR 15.247 (a)(2) for digital modulation. What is narrower there must hop, and a modem like this does not.
REGIONS: dict[str, tuple[Band, ...]] = {
    "eu433": (Band(433.05, 434.79, 0.1, 10),),
    "eu868": (
        Band(863.0, 865.0, 0.001, 14),
        Band(865.0, 868.6, 0.01, 14),
        Band(868.7, 869.2, 0.001, 14),
        Band(869.4, 869.65, 0.1, 27),
        Band(869.7, 870.0, 0.01, 14),
    ),
    "us915": (Band(902.0, 928.0, 1.0, 30, least_khz=500.0),),
}


def symbol_s(section: RNodeSection) -> float:
    """Length of a symbol, seconds."""
    return float(2**section.spreading_factor) / (section.bandwidth_khz * 1000.0)


def on_air_s(section: RNodeSection, size: int, preamble: float) -> float:
    """How long `size` bytes are on the air, seconds: with a header and a check sum, after so many symbols of preamble.

    Semtech AN1200.13, and for spreading factors 5 and 6 the data sheet of the SX1261/2, section 6.1.4.
    """
    factor, symbol = section.spreading_factor, symbol_s(section)
    bits = 8 * size + 16 + 20 - 4 * factor + (8 if factor >= 7 else 0)
    bits_per_group = 4 * (factor - (2 if symbol > _SLOW_SYMBOL_S else 0))
    symbols = 8 + max(0, math.ceil(bits / bits_per_group)) * section.coding_rate
    return (preamble + (4.25 if factor >= 7 else 6.25) + symbols) * symbol


def packet_s(section: RNodeSection, size: int) -> float:
    """How long an RNode takes to send a packet of `size` bytes, 1 or more, seconds; without the wait for a free
    channel."""
    symbol = symbol_s(section)
    bit_s = section.spreading_factor * 4.0 / section.coding_rate / symbol
    preamble = max(_PREAMBLE, math.ceil((_FAST_PREAMBLE_S if bit_s > _FAST_BIT_S else _PREAMBLE_S) / symbol))
    whole, rest = divmod(size, PIECE_BYTES)
    pieces = [PIECE_BYTES] * whole + [rest] * (rest > 0)
    return sum(on_air_s(section, piece + 1, preamble) for piece in pieces)


def allowed(section: RNodeSection, key: str = "rnode") -> Band | None:
    """The part of the spectrum that a signal is in; None: the region is `none`.

    Raises `ConfigError` if the region does not allow the signal. `key`: that of the section.
    """
    bands = REGIONS.get(section.region)
    if bands is None:
        return None
    half = section.bandwidth_khz / 2000.0
    low, high = section.frequency_mhz - half, section.frequency_mhz + half
    band = next((band for band in bands if band.low_mhz <= low + 1e-6 and high <= band.high_mhz + 1e-6), None)
    if band is None:
        parts = ", ".join(f"{band.low_mhz:g} to {band.high_mhz:g}" for band in bands)
        raise ConfigError(
            f"{key}.frequency_mhz: expected the signal within {parts} in {section.region}, got {low:g} to {high:g}"
        )
    if section.bandwidth_khz < band.least_khz:
        raise ConfigError(
            f"{key}.bandwidth_khz: expected {band.least_khz:g} or more in {section.region}, where a narrower signal"
            f" must hop, got {section.bandwidth_khz:g}"
        )
    if section.power_dbm > band.power_dbm:
        raise ConfigError(
            f"{key}.power_dbm: expected {band.power_dbm} or less at {section.frequency_mhz:g} MHz in {section.region},"
            f" got {section.power_dbm}"
        )
    return band
