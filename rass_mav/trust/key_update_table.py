"""The key updates that a node keeps, and those of them that are to leave next. What is in them does not matter here."""

from __future__ import annotations

import random
import zlib
from collections.abc import Mapping
from math import inf
from struct import Struct

from rass_mav.trust.keys.key_updates import KeyUpdate

#: Key updates that a node keeps.
MAX_KEY_UPDATES = 1024
#: Key updates that leave in one turn.
MAX_SENT = 4
#: Key updates that may leave at once because somebody without the link key has asked, and seconds until there is one
#: more.
MAX_ASKED, ASKED_S = 32, 8.0

_NAMED = Struct("<HB")


class KeyUpdateTable:
    """Of the key updates about one drone, the one of the highest rank. All in it are the ground's."""

    __slots__ = ("_key_updates", "_number", "_updates_hash", "news")

    def __init__(self, number: int) -> None:
        """`number`: of the link key in use."""
        self._key_updates: dict[int, KeyUpdate] = {}
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
        """Whether a key update is news. `own`: the one to this node, for which there is always space."""
        held = self._key_updates.get(key_update.node_id)
        if held.rank >= key_update.rank if held is not None else len(self._key_updates) >= MAX_KEY_UPDATES and not own:
            return False
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


class KeyUpdateQueue:
    """Which key updates leave next, and when."""

    __slots__ = ("_asked", "_awaited", "_credit", "_credit_at", "_missing", "_rng", "_send_at")

    def __init__(self, rng: random.Random) -> None:
        self._rng = rng
        self.begin()

    def begin(self) -> None:
        """Nothing is to leave, and time begins."""
        self._asked: dict[int, None] = {}
        self._awaited: dict[int, None] = {}
        self._missing: dict[int, None] = {}
        self._credit, self._credit_at = float(MAX_ASKED), inf
        self._send_at = -inf

    def clear(self) -> None:
        """Nothing is to leave."""
        self._asked.clear()
        self._awaited.clear()
        self._missing.clear()

    def ask(self, node_id: int, there: bool) -> None:
        """Somebody without the link key has asked for the key update about this drone. `there`: the node has it;
        otherwise it leaves when it comes."""
        some = self._asked if there else self._awaited
        if len(some) >= MAX_ASKED and node_id not in some:
            # Nobody can take all places for long by asking for the others.
            del some[self._rng.choice(list(some))]
        some[node_id] = None

    def gain(self, node_id: int) -> None:
        """The node has got this key update."""
        if node_id in self._awaited:
            del self._awaited[node_id]
            self.ask(node_id, True)

    def miss(self, node_id: int) -> None:
        """A node with the link key does not have this key update."""
        self._missing[node_id] = None

    def sent(self, node_id: int) -> None:
        """Somebody else has sent this key update."""
        self._asked.pop(node_id, None)
        self._missing.pop(node_id, None)

    def due(self, now: float, turn_s: float, items: int) -> list[int]:
        """The node ids of the key updates that leave now."""
        if not (self._asked or self._missing) or now < self._send_at:
            return []
        self._send_at = now + 0.9 * turn_s
        most = max(1, min(MAX_SENT, items))
        self._credit = min(self._credit + max(0.0, now - self._credit_at) / ASKED_S, MAX_ASKED)
        self._credit_at = now
        chosen: list[int] = []
        while self._asked and len(chosen) < most and self._credit >= 1.0:
            self._credit -= 1.0
            chosen.append(self._rng.choice(list(self._asked)))
            self.sent(chosen[-1])
        # All that hear what somebody has send key updates: each another one, as far as possible.
        some = self._rng.sample(list(self._missing), min(len(self._missing), most - len(chosen)))
        for node_id in some:
            self.sent(node_id)
        return chosen + some
