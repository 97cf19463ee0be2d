"""The sentences of Safecast's bGeigie counters, live and in logs.

`$BNRDD,204,2012-09-20T15:13:40Z,11,2,11,V,5218.7185,N,00445.6503,E,4.80,A,132,6*64`: header, device, UTC, counts in the
last minute (CPM), in the last 5 s, in total, whether CPM is valid (A) or the first minute is not over (V), latitude,
longitude (degrees and minutes), altitude in metres, whether there is a fix (A) or not (V), and two fields that are not
read because their order depends on the firmware (dilution of precision, satellites). After the star comes the XOR of
all bytes between $ and star. See https://github.com/Safecast/bGeigieNanoKit.
"""

from __future__ import annotations

import re
from datetime import datetime, timedelta, timezone
from functools import reduce
from operator import xor
from typing import NamedTuple

from rass_mav.errors import MalformedError

from .protocol import LineProtocol, Sample, shown

#: Headers of measurements, by kind of device: bGeigie Mini, Classic, Nano, NX, Pointcast, Zen.
HEADERS = frozenset((b"BMRDD", b"BGRDD", b"BNRDD", b"BNXRDD", b"PNTDD", b"CZRDD"))
#: A measurement has at least this many fields, including the header. The last one that is read is the flag for a fix.
MIN_FIELDS = 13

#: The start of a sentence in a text.
SENTENCE = re.compile(rb"\$(?:" + b"|".join(sorted(HEADERS)) + rb"),")

_CHECKED = re.compile(rb"\$([\x20-\x7e]*)\*([0-9A-Fa-f]{2})")
_SIGN = re.compile(rb",-(\d+\.\d+,[SW])(?=,)")
_NUMBER = re.compile(rb"\d{1,9}")
_TIME = re.compile(rb"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\dZ")
_DEGREES = re.compile(rb"\d{1,5}(?:\.\d{1,9})?")
_METRES = re.compile(rb"-?\d{1,6}(?:\.\d{1,9})?")
_EPOCH = datetime(1970, 1, 1, tzinfo=timezone.utc)


class Place(NamedTuple):
    """Where the device was."""

    latitude: float
    """Degrees, -90..90."""
    longitude: float
    """Degrees, -180..180."""
    altitude: float
    """Metres above mean sea level."""


class Record(NamedTuple):
    """One measurement."""

    device: int
    """The device's number."""
    time_us: int
    """Microseconds since 1970. Without a fix, the device's clock may never have been set."""
    cpm: float | None
    """Counts per minute; None: not valid (V)."""
    place: Place | None
    """None: no fix (V)."""


def fields_of(sentence: bytes) -> list[bytes] | None:
    """The fields of a measurement, starting with the header; None: a valid sentence of another kind.

    :param sentence: from `$` to the checksum, without the end of the line.
    :raises MalformedError: not a sentence, a wrong checksum, or too few fields.
    """
    found = _CHECKED.fullmatch(sentence)
    if found is None:
        raise MalformedError(f"expected $...*XX, got {shown(sentence)}")
    checksum = int(found[2], 16)
    # Some firmware writes -07355.3663,W: the sign repeats the letter, and is not part of the checksum.
    body = _SIGN.sub(rb",\1", found[1])
    if reduce(xor, body, 0) != checksum:
        body = found[1]
        if reduce(xor, body, 0) != checksum:
            raise MalformedError(f"wrong checksum: {shown(sentence)}")
    fields = body.split(b",")
    if fields[0] not in HEADERS:
        return None
    if len(fields) < MIN_FIELDS:
        raise MalformedError(f"expected at least {MIN_FIELDS} fields, got {len(fields)}: {shown(sentence)}")
    return fields


def rate_of(fields: list[bytes]) -> float | None:
    """Counts per minute; None: not valid yet. Raises `MalformedError`."""
    valid = _flag(fields[6], "CPM")
    if _NUMBER.fullmatch(fields[3]) is None:
        raise MalformedError(f"expected counts per minute, got {shown(fields[3])}")
    return float(fields[3]) if valid else None


def decode_record(sentence: bytes) -> Record | None:
    """The whole measurement in a sentence; None: a valid sentence of another kind. Raises `MalformedError`."""
    fields = fields_of(sentence)
    if fields is None:
        return None
    if _NUMBER.fullmatch(fields[1]) is None:
        raise MalformedError(f"expected a device number, got {shown(fields[1])}")
    # Without a fix, the place is the last one known, or none at all. Ignore it.
    place = None
    if _flag(fields[12], "fix"):
        if _METRES.fullmatch(fields[11]) is None:
            raise MalformedError(f"expected an altitude in metres, got {shown(fields[11])}")
        place = Place(
            _degrees(fields[7], fields[8], b"NS", 90.0),
            _degrees(fields[9], fields[10], b"EW", 180.0),
            float(fields[11]),
        )
    return Record(int(fields[1]), _time_us(fields[2]), rate_of(fields), place)


def _flag(text: bytes, what: str) -> bool:
    if text not in (b"A", b"V"):
        raise MalformedError(f"expected A or V for the {what}, got {shown(text)}")
    return text == b"A"


def _time_us(text: bytes) -> int:
    if _TIME.fullmatch(text) is None:
        raise MalformedError(f"expected a time like 2012-09-20T15:13:40Z, got {shown(text)}")
    try:
        time = datetime.fromisoformat(text[:-1].decode("ascii") + "+00:00")
    except ValueError as error:
        # Before a device knows the time, it writes day 0 of month 0.
        raise MalformedError(f"{shown(text)}: {error}") from None
    return (time - _EPOCH) // timedelta(microseconds=1)


def _degrees(text: bytes, letter: bytes, letters: bytes, limit: float) -> float:
    """Degrees from `dddmm.mmmm` and a letter; the second of `letters` makes them negative."""
    if _DEGREES.fullmatch(text) is None or len(letter) != 1 or letter not in letters:
        raise MalformedError(f"expected dddmm.mmmm and one of {letters.decode()}, got {shown(text + b',' + letter)}")
    degrees, minutes = divmod(float(text), 100.0)
    value = degrees + minutes / 60.0
    if minutes >= 60.0 or value > limit:
        raise MalformedError(f"not a place on Earth: {shown(text + b',' + letter)}")
    return -value if letter == letters[1:] else value


class Bgeigie(LineProtocol):
    """A bGeigie on a serial port, which sends a sentence about every 5 s. Its position and time are not used."""

    def _line(self, line: bytes, now: float) -> Sample | None:
        if line.startswith(b"#"):
            return None
        fields = fields_of(line)
        if fields is None:
            return None
        cpm = rate_of(fields)
        return None if cpm is None else Sample(cpm, now)
