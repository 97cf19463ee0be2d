"""The key updates that a node keeps."""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from struct import Struct

from rass_mav.trust.keys.key_updates import KeyUpdate

#: Key updates that a node keeps.
MAX_KEY_UPDATES = 1024

_ROW = Struct("<HQ")


class KeyUpdateTable:
    """Of the key updates about one drone, the one of the highest rank. All in it are the ground's."""

    __slots__ = ("_key_updates", "_node_id", "_number", "_summary", "news")

    def __init__(self, node_id: int, number: int) -> None:
        """`node_id`: of the node itself. `number`: of the link key in use."""
        self._key_updates: dict[int, KeyUpdate] = {}
        self._node_id = node_id
        self._number = number
        self._summary: int | None = None
        self.news = 0
        """Rises with each key update that is new."""

    def __len__(self) -> int:
        return len(self._key_updates)

    def get(self, node_id: int) -> KeyUpdate | None:
        """The key update about a drone."""
        return self._key_updates.get(node_id)

    def use(self, number: int) -> None:
        """Another link key is in use."""
        self._number = number
        self._summary = None

    def keep(self, key_update: KeyUpdate, *, own: bool = False) -> bool:
        """Whether a key update is news. `own`: the one to this node, or that it has written, for which there is always
        space. There is for one that revokes, too, as long as another one does not: that one goes."""
        held = self._key_updates.get(key_update.node_id)
        if held is not None:
            if held.rank >= key_update.rank:
                return False
        elif len(self._key_updates) >= MAX_KEY_UPDATES and not own:
            others = (id for id, other in self._key_updates.items() if other.sealed and id != self._node_id)
            useless = None if key_update.sealed else next(others, None)
            if useless is None:
                return False
            del self._key_updates[useless]
        self._key_updates[key_update.node_id] = key_update
        self._summary = None
        self.news += 1
        return True

    def packed(self) -> list[bytes]:
        """All key updates."""
        return [key_update.pack() for _, key_update in sorted(self._key_updates.items())]

    def last(self) -> int:
        """The highest number of a link key that there are key updates about; 0: there are none."""
        return max((key_update.number for key_update in self._key_updates.values()), default=0)

    def out(self) -> dict[int, int]:
        """The last serial of each drone whose certificate is refused."""
        return {
            id: key_update.last_revoked
            for id, key_update in sorted(self._key_updates.items())
            if key_update.last_revoked
        }

    def current(self) -> Mapping[int, KeyUpdate]:
        """The key updates about the link key in use, by node id, ascending."""
        return {
            id: key_update for id, key_update in sorted(self._key_updates.items()) if key_update.number == self._number
        }

    def summary(self) -> int:
        """Of the key updates about the link key in use, 32 bits; higher with each one more, or a later one. In the high
        half are twice their serials, one for each that revokes, and one; in the low half their hash. 0: it is the first
        link key, and there can be none."""
        if self._summary is None:
            rows = [(id, 2 * one.serial + (not one.sealed)) for id, one in self.current().items()]
            rank = min(0xFFFF, 1 + sum(row[1] for row in rows))
            hash = zlib.crc32(b"".join(_ROW.pack(*row) for row in rows)) & 0xFFFF
            self._summary = rank << 16 | hash if self._number > 1 else 0
        return self._summary
