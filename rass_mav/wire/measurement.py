"""The payload of a datum of kind MEASUREMENT: a position and a reading (docs/protocol.md)."""

from __future__ import annotations

import math
import struct
from typing import NamedTuple

from rass_mav.errors import MalformedError

_MEASUREMENT = struct.Struct("<BBiiifH")
#: Bytes of a measurement without padding.
MEASUREMENT_BYTES = _MEASUREMENT.size
_VERSION = 1
_HAS_POSITION = 1
_HAS_READING = 2
_LOCAL = 4
#: Largest 32-bit float.
_FLOAT_MAX = 3.4028234663852886e38


class Measurement(NamedTuple):
    """One measurement. Its time is the datum's creation time."""

    latitude: float | None
    """Degrees, resolution 1e-7; None: no position fix."""
    longitude: float | None
    """Degrees, resolution 1e-7; None: no position fix."""
    altitude: float | None
    """Metres above mean sea level, resolution 1 mm; None: no position fix."""
    reading: float | None
    """As the sensor sent it, in its own unit (32-bit float); None: unknown."""
    risk: float
    """Local risk at that time, 0..1, resolution 1/65535."""
    local: tuple[float, float, float] | None = None
    """Without a position on Earth: metres north, east and down of the autopilot's origin, resolution 1 mm."""


def encode_measurement(m: Measurement) -> bytes:
    """`<BBiiifH` version, flags (1 position, 2 reading, 4 local), latitude, longitude, altitude, reading, risk.

    With flag 4 the three places hold north, east and down instead.
    """
    flags = 0
    lat = lon = alt = 0
    reading = 0.0
    if m.latitude is not None and m.longitude is not None:
        flags |= _HAS_POSITION
        lat, lon = round(m.latitude * 1e7), round(m.longitude * 1e7)
        alt = _millimetres(m.altitude or 0.0)
    elif m.local is not None:
        flags |= _LOCAL
        lat, lon, alt = (_millimetres(metres) for metres in m.local)
    if m.reading is not None and abs(m.reading) <= _FLOAT_MAX:
        flags |= _HAS_READING
        reading = m.reading
    return _MEASUREMENT.pack(_VERSION, flags, lat, lon, alt, reading, round(m.risk * 65535))


def _millimetres(metres: float) -> int:
    return max(-(1 << 31), min((1 << 31) - 1, round(metres * 1000)))


def decode_measurement(payload: bytes) -> Measurement:
    """A measurement; bytes after it are padding. Raises `MalformedError`."""
    try:
        version, flags, lat, lon, alt, reading, risk = _MEASUREMENT.unpack_from(payload)
    except struct.error as error:
        raise MalformedError(f"truncated measurement: {error}") from None
    if version != _VERSION:
        raise MalformedError(f"measurement version {version}, ours is {_VERSION}")
    here = bool(flags & _HAS_POSITION)
    return Measurement(
        lat / 1e7 if here else None,
        lon / 1e7 if here else None,
        alt / 1000 if here else None,
        reading if flags & _HAS_READING and math.isfinite(reading) else None,
        risk / 65535,
        (lat / 1000, lon / 1000, alt / 1000) if flags & _LOCAL and not here else None,
    )
