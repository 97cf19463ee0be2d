"""What a row says that was read without SQLite: only its checksum makes it a row of ours."""

from __future__ import annotations

from typing import Any, NamedTuple

from rass_mav.core.datum import Datum, DatumId, Fate

from .payloads import Payloads
from .schema import sound_loss


class FoundLoss(NamedTuple):
    """A row of the table of losses."""

    id: DatumId
    fate: Fate
    proof: bytes


class FoundNumber(NamedTuple):
    """A row of `meta` or `counter`."""

    name: bytes
    value: int


def found_in(columns: tuple[Any, ...], payloads: Payloads) -> Datum | FoundLoss | FoundNumber | None:
    """What a row says; None: it is not ours, or not sound. `OSError`."""
    if len(columns) in (10, 11):
        return _datum(columns, payloads)
    if len(columns) == 5 and (loss := sound_loss(columns[:3], columns[3], columns[4])) is not None:
        return FoundLoss(DatumId(*columns[:3]), *loss)
    if len(columns) == 3:
        name, value, inverse = columns
        if type(name) is bytes and type(value) is int and inverse == ~value:
            return FoundNumber(name, value)
    return None


def _datum(columns: tuple[Any, ...], payloads: Payloads) -> Datum | None:
    # The first version had no at_least.
    _, origin, epoch, sequence, kind, created, hops, crc, size, *at_least, payload = columns
    if type(payload) is int and type(size) is int:
        payload = payloads.read(payload, size)
    numbers = (origin, epoch, sequence, kind, hops, crc, size, *at_least)
    if any(type(number) is not int or number < 0 for number in numbers) or type(payload) is not bytes:
        return None
    # SQLite stores a real number without a fraction as an integer.
    if type(created) not in (float, int) or len(payload) != size:
        return None
    if (
        max(epoch, sequence, crc) >= 1 << 32
        or origin >= 1 << 16
        or max(kind, hops) > 255
        or max(at_least, default=0) > 1
    ):
        return None
    datum = Datum(DatumId(origin, epoch, sequence), kind, float(created), hops, crc, payload, bool(*at_least))
    return datum if datum.intact else None
