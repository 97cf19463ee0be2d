"""The payload of a datum of kind MEASUREMENT: a position and a reading (docs/reference/payloads.md)."""

from __future__ import annotations

import math
import struct
from typing import NamedTuple

from rass_mav.errors import MalformedError

_MEASUREMENT = struct.Struct("<BBiiifH")
_READING = struct.Struct("<f")
_UNIT = struct.Struct("<B")
_ERROR = struct.Struct("<H")
#: Bytes of a measurement without unit, error and padding.
MEASUREMENT_BYTES = _MEASUREMENT.size
#: With unit and error.
MOST_MEASUREMENT_BYTES = MEASUREMENT_BYTES + _UNIT.size + _ERROR.size
_VERSION = 1
_HAS_POSITION = 1
_HAS_READING = 2
_LOCAL = 4
_HAS_UNIT = 8
_HAS_ERROR = 16
#: The number of each unit on the wire. Readings of a unit that a later version added have no unit here.
UNITS: dict[str, int] = {"usvh": 1, "cpm": 2, "cps": 3, "counts": 4}
_UNIT_OF = {number: name for name, number in UNITS.items()}
#: Units, as people write them.
UNIT_NAMES = {"usvh": "uSv/h", "cpm": "cpm", "cps": "cps", "counts": "counts"}
#: The largest reading: the largest 32-bit float.
MOST_READING = 3.4028234663852886e38
#: Largest error of a position that can be sent; beyond that it is unknown.
_MOST_ERROR_M = 6553.5


class Measurement(NamedTuple):
    """One measurement. Its time is the datum's creation time."""

    latitude: float | None
    """Degrees, resolution 1e-7; None: no position fix."""
    longitude: float | None
    """Degrees, resolution 1e-7; None: no position fix."""
    altitude: float | None
    """Metres above mean sea level, resolution 1 mm; None: no position fix."""
    reading: float | None
    """As the sensor sent it, in `unit` (32-bit float); None: unknown."""
    risk: float
    """Local risk at that time, 0..1, resolution 1/65535."""
    local: tuple[float, float, float] | None = None
    """Without a position on Earth: metres north, east and down of the autopilot's origin, resolution 1 mm."""
    unit: str | None = None
    """Of the reading, a key of `UNITS`; None: unknown."""
    error_m: float | None = None
    """The position is at most this far from the true one, metres, resolution 0.1 rounded up; None: unknown."""


def encode_measurement(m: Measurement) -> bytes:
    """`<BBiiifH` version, flags (1 position, 2 reading, 4 local), latitude, longitude, altitude, reading, risk.

    With flag 4 the three places hold north, east and down instead. With flag 8 the unit follows (`<B`), with flag 16
    the error of the position (`<H`, decimetres). A reader that does not know these takes them for padding. ValueError:
    a unit that is none of `UNITS`.
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
    if m.reading is not None and abs(m.reading) <= MOST_READING:
        flags |= _HAS_READING
        reading = m.reading
    more = b""
    if m.unit is not None and flags & _HAS_READING:
        if m.unit not in UNITS:
            raise ValueError(f"expected a unit, one of {', '.join(UNITS)}, got {m.unit!r}")
        flags |= _HAS_UNIT
        more += _UNIT.pack(UNITS[m.unit])
    if m.error_m is not None and m.error_m <= _MOST_ERROR_M and flags & (_HAS_POSITION | _LOCAL):
        flags |= _HAS_ERROR
        more += _ERROR.pack(math.ceil(max(m.error_m, 0.0) * 10))
    return _MEASUREMENT.pack(_VERSION, flags, lat, lon, alt, reading, round(m.risk * 65535)) + more


def _millimetres(metres: float) -> int:
    return max(-(1 << 31), min((1 << 31) - 1, round(metres * 1000)))


def shortest(value: float) -> float:
    """The number with the fewest decimal digits that is the same 32-bit float: what a sensor showed or a person set."""
    sent = _READING.pack(value)
    # Any number of six digits comes back as it was, and nine are always enough.
    rounded = (float(f"{value:.{digits}g}") for digits in range(6, 10))
    return next(one for one in rounded if _READING.pack(one) == sent)


def decode_measurement(payload: bytes) -> Measurement:
    """A measurement; bytes after it are padding. Raises `MalformedError`."""
    end = MEASUREMENT_BYTES
    try:
        version, flags, lat, lon, alt, reading, risk = _MEASUREMENT.unpack_from(payload)
        if version != _VERSION:
            raise MalformedError(f"measurement version {version}, ours is {_VERSION}")
        unit = error = None
        if flags & _HAS_UNIT:
            end += _UNIT.size
            (unit,) = _UNIT.unpack_from(payload, end - _UNIT.size)
        if flags & _HAS_ERROR:
            end += _ERROR.size
            (error,) = _ERROR.unpack_from(payload, end - _ERROR.size)
    except struct.error:
        raise MalformedError(f"truncated measurement: {len(payload)} bytes, expected at least {end}") from None
    here = bool(flags & _HAS_POSITION)
    return Measurement(
        lat / 1e7 if here else None,
        lon / 1e7 if here else None,
        alt / 1000 if here else None,
        reading if flags & _HAS_READING and math.isfinite(reading) else None,
        risk / 65535,
        (lat / 1000, lon / 1000, alt / 1000) if flags & _LOCAL and not here else None,
        None if unit is None else _UNIT_OF.get(unit),
        None if error is None else error / 10,
    )
