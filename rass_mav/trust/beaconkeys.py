"""One-way chains of keys, one key a beacon: only a node itself can make its next beacon.

Hashing a key gives that of the beacon before. A node that has verified one recognises the next ones when they come, and
no node knows them earlier. docs/reference/protocol-keys.md ("Beacon keys") has the rules;
docs/explanation/security.md compares them with signatures and TESLA.
"""

from __future__ import annotations

from hashlib import blake2b
from struct import Struct

from rass_mav.trust.chains import hashed
from rass_mav.trust.keys.secret import Purpose, Secret

#: Beacons with keys of one chain.
LENGTH = 1024
#: A beacon further ahead of the last one is not verified: its sender has to introduce itself again. A false one thus
#: costs at most so many hashes.
MOST_AHEAD = 64
KEY_SIZE = 8

_ABOUT = Struct("<HI")
_CHAIN = Struct("<QI")


def salt_of(node_id: int, life: int) -> bytes:
    """The salt of a node's chains, 8 bytes."""
    return blake2b(_ABOUT.pack(node_id, life), digest_size=8, person=Purpose.BEACONS).digest()


class OwnKeys:
    """The keys of this node's beacons. `index` counts beacons over all lives of the node, 32 bits."""

    __slots__ = ("_chains", "_life", "_salt", "_secret")

    def __init__(self, secret: Secret, node_id: int, store_life: int, start: int) -> None:
        """:param secret: the node's own.
        :param start: drawn at random whenever the node starts, 64 bits: no key is used in two lives.
        """
        self._secret = secret
        self._life = start
        self._salt = salt_of(node_id, store_life)
        self._chains: dict[int, bytes] = {}
        """By their number, the present one and the next: the end, and then the keys."""

    def key(self, index: int) -> bytes:
        """The key of a beacon, 8 bytes. It must not leave before that beacon."""
        number, place = divmod(index, LENGTH)
        at = (place + 1) * KEY_SIZE
        return self._chain(number)[at : at + KEY_SIZE]

    def next_end(self, index: int) -> bytes:
        """The end of the chain after that of this beacon: what its first key hashes to."""
        return self._chain(index // LENGTH + 1)[:KEY_SIZE]

    def _chain(self, number: int) -> bytes:
        chain = self._chains.get(number)
        if chain is None:
            about = _CHAIN.pack(self._life, number & 0xFFFFFFFF)
            key = self._secret.derive(Purpose.BEACONS, about).reveal()[:KEY_SIZE]
            keys = [key]
            for _ in range(LENGTH):
                key = hashed(self._salt, key, 1)
                keys.append(key)
            self._chains = {other: value for other, value in self._chains.items() if abs(other - number) == 1}
            chain = self._chains[number] = b"".join(reversed(keys))
        return chain


class HeardKeys:
    """What is known of another node's keys: the last one that was proved or verified."""

    __slots__ = ("index", "key", "next_end")

    def __init__(self, index: int, key: bytes, next_end: bytes) -> None:
        self.index = index
        """Of the last beacon that is known to be the node's."""
        self.key = key
        self.next_end = next_end
        """Of the next chain; empty: not known."""

    def verify(self, number: int, key: bytes, salt: bytes) -> bool | None:
        """Whether a beacon (number: 16 bits) is the node's, and newer than all before. If so, it is the last one from
        now on. False: it is late, or came before. None: it is not, unless the node has started again, or was away."""
        ahead = (number - self.index) & 0xFFFF
        if ahead == 0 or ahead > 0xFFFF - MOST_AHEAD:
            return False
        index = self.index + ahead
        chains = index // LENGTH - self.index // LENGTH
        if ahead > MOST_AHEAD or chains > 1 or (chains and not self.next_end):
            return None
        last, hashes = (self.next_end, index % LENGTH + 1) if chains else (self.key, ahead)
        if hashed(salt, key, hashes) != last:
            return None
        self.index, self.key = index, key
        if chains:
            self.next_end = b""
        return True
