"""Sealed data, and what opens them."""

from __future__ import annotations

from rass_mav.core.datum import Datum, make_datum
from rass_mav.core.seals import SEALED
from rass_mav.trust.keys.identity import Ground
from rass_mav.trust.keys.sealing import Opener, Sealer
from rass_mav.trust.keys.secret import Secret

GROUND = Ground(Secret(bytes(range(32))), serials={7: 1, 8: 1})
OPENS = Opener(GROUND).open
#: Contents that a list does not show.
PHOTO = bytes(range(256)) * 40


def sealed(datum: Datum, by: int | None = None) -> Datum:
    """As its origin seals it, or another drone in its name."""
    keys = GROUND.node(datum.id.origin if by is None else by, 1)
    payload = Sealer(keys, datum.id.epoch, 0).seal(datum.id.sequence, datum.kind, datum.payload)
    return make_datum(datum.id, datum.kind | SEALED, datum.created, payload)._replace(hops=datum.hops)
