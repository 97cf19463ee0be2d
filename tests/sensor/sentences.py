"""Sentences of a bGeigie, made by hand."""

from __future__ import annotations


def checked(body: bytes) -> bytes:
    """With `$` and the checksum."""
    checksum = 0
    for byte in body:
        checksum ^= byte
    return b"$%s*%02X" % (body, checksum)


def sentence(
    *,
    header: bytes = b"BNRDD",
    device: int = 204,
    time: bytes = b"2012-09-20T15:13:40Z",
    cpm: int | bytes = 30,
    valid: bytes = b"A",
    latitude: bytes = b"5218.7185",
    ns: bytes = b"N",
    longitude: bytes = b"445.6503",
    ew: bytes = b"E",
    altitude: bytes = b"4.80",
    fix: bytes = b"A",
    rest: bytes = b"132,6",
) -> bytes:
    counts = b"%d" % cpm if isinstance(cpm, int) else cpm
    place = b",".join((latitude, ns, longitude, ew, altitude, fix))
    return checked(b"%s,%03d,%s,%s,2,99,%s,%s,%s" % (header, device, time, counts, valid, place, rest))
