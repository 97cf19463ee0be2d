"""News of arrivals: what has just reached a base, by name, in the beacons of one node after another.

A statement of a base counts, but it names one block of one origin's data, so it takes long until all nodes have heard
of all that has arrived. Until then copies of what has arrived wander through the swarm, and take the airtime of what
has not. So a base's beacon names what has arrived last, and so does that of each node that hears it and has a copy:
the news runs back along the way on which the datum came.

Anybody can say so. Therefore no copy ends because of it: it is moved seldom, searched for later, and not copied. Of
16,000 data that have not arrived one has the name of one that has, and fares the same.
"""

from __future__ import annotations

from collections.abc import Container, Iterable
from itertools import islice
from struct import Struct
from zlib import crc32

from rass_mav.core.datum import DatumId
from rass_mav.core.messages import MAX_ARRIVALS
from rass_mav.core.news.table import Statements

#: How many names a node remembers, so that it says each only once.
MAX_KNOWN = 1024
_ID = Struct("<HII")


def name(id: DatumId) -> bytes:
    """The short name of a datum: the low 24 bits of the CRC-32 of its id, both as on the wire."""
    return crc32(_ID.pack(*id)).to_bytes(4, "little")[:3]


class Arrivals:
    """What has arrived, by the statements of bases or by the beacons of neighbours."""

    __slots__ = ("_due", "_known", "_statements")

    def __init__(self, statements: Statements) -> None:
        """`statements`: those of bases."""
        self._statements = statements
        self._known: dict[bytes, None] = {}
        """The names that were heard, the oldest first."""
        self._due: dict[bytes, None] = {}
        """Those that no beacon has named yet, the latest last."""

    def __contains__(self, id: object) -> bool:
        if not isinstance(id, DatumId):
            return False
        return name(id) in self._known or id.sequence in self._statements.sum(id[:2]).arrived

    def arrive(self, id: DatumId) -> None:
        """At a base: a datum has arrived."""
        one = name(id)
        self.hear((one,), (one,))

    def hear(self, names: Iterable[bytes], held: Container[bytes]) -> None:
        """A neighbour says that these have arrived. `held`: the names of all that is here."""
        known, due = self._known, self._due
        for one in names:
            if one not in known:
                known[one] = None
                if one in held:
                    due[one] = None
                if len(known) > MAX_KNOWN:
                    oldest = next(iter(known))
                    del known[oldest]
                    due.pop(oldest, None)

    def latest(self) -> tuple[bytes, ...]:
        """Once a turn: what this node's beacon names."""
        due = self._due
        named = tuple(islice(reversed(due), MAX_ARRIVALS))
        for one in named:
            del due[one]
        return named
