"""The key updates that a node keeps."""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from struct import Struct

from rass_mav.trust.keys.key_updates import KeyUpdate

#: Key updates that a node keeps.
MAX_KEY_UPDATES = 1024

_NAMED = Struct("<HB")


class KeyUpdateTable:
    """Of the key updates about one drone, the one of the highest rank. All in it are the ground's."""

    __slots__ = ("_key_updates", "_node_id", "_number", "_updates_hash", "news")

    def __init__(self, node_id: int, number: int) -> None:
        """`node_id`: of the node itself. `number`: of the link key in use."""
        self._key_updates: dict[int, KeyUpdate] = {}
        self._node_id = node_id
        self._number = number
        self._updates_hash: int | None = None
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
        self._updates_hash = None

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
        self._updates_hash = None
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

    def marks(self) -> dict[int, int]:
        """By node id, what tells the key updates about one drone and the link key in use apart, 0..255."""
        return {
            id: (key_update.serial << 1 | (not key_update.sealed)) & 0xFF for id, key_update in self.current().items()
        }

    def updates_hash(self) -> int:
        """Of the marks, 32 bits: the same for nodes that have the same key updates about the link key in use."""
        if self._updates_hash is None:
            self._updates_hash = zlib.crc32(b"".join(_NAMED.pack(*mark) for mark in self.marks().items()))
        return self._updates_hash
