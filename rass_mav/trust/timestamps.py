"""The timestamps of a node's own signatures: each is used once, over all lives of the node, and no clock is needed.

The high bits of a timestamp are the index of the node's last beacon, so that a beacon's key also shows where the node's
stream of frames is (`trust.sessions`). They are claimed on disk before a frame with them leaves, so the next life
starts above all that this one may use.
"""

from __future__ import annotations

from rass_mav.core.store import Store
from rass_mav.mavlink.signing import SIGNATURE_SIZE, Signer, SigningKey

#: Fact: Low bits of a timestamp: they count the frames since the last beacon.
COUNT_BITS = 16
#: Fact: Timestamps claimed at a time: those of 65,536 beacons. Half a claim is left when the next one is made: at a
#: beacon a second a disk may fail for 9 hours before the node falls silent.
CLAIMED = 1 << 16 + COUNT_BITS
#: Fact: More than the frames that wait in a node at any time.
WAITING = 1 << COUNT_BITS
# The store keeps under this name the first timestamp that is not claimed.
_KEY = "timestamps"


class Timestamps:
    """Signs frames when they leave, and knows whether they may."""

    __slots__ = ("_durable", "_enough", "_signer", "_store", "index", "start")

    def __init__(self, store: Store, signer: Signer, skip: int) -> None:
        """`signer`: continues above all that earlier lives on this store have claimed. `skip`: so many beacons above,
        drawn at random, below 2^15: two nodes on copies of one card tell their beacons apart by that."""
        self._store = store
        self._signer = signer
        self.start = -(-(store.get_meta(_KEY) or 0) >> COUNT_BITS)
        """No earlier life has sent a beacon with this index, or a higher one."""
        self.index = self.start + skip
        """Of this node's last beacon, over all its lives, 32 bits."""
        signer.raise_to(self.index << COUNT_BITS)
        self._durable = signer.timestamp
        """The claims up to this one, exclusive, are known to be on disk."""
        self._enough = -1
        """How many can be used before the next claim."""
        self.cover()

    @property
    def link_id(self) -> int:
        """Link id of the signatures, 0..255."""
        return self._signer.link_id

    @property
    def next(self) -> int:
        """The next timestamp, 48 bits."""
        return max(self._signer.timestamp, self.index << COUNT_BITS)

    def begin_turn(self, number: int) -> int:
        """The node makes a beacon with this number (16 bits). Returns its index."""
        self.index += (number - self.index) & 0xFFFF
        return self.index

    def cover(self) -> bool:
        """Claim timestamps, if it is time. Returns whether frames that are made now may leave at once. If not, they may
        when the present changes of the store are on disk."""
        if self.next > self._enough:
            self._claim()
        return self.next + WAITING <= self._durable

    def sign(self, frame: bytes) -> bytes:
        """A frame as it leaves. Call it for frames that may leave, in their order on the air."""
        self.cover()
        self._signer.raise_to(self.next)
        assert self._signer.timestamp < self._durable, "a frame leaves before its timestamp is claimed"
        return self._signer.sign(frame)

    def sign_again(self, frame: bytes) -> bytes:
        """A signed frame of this node with a new timestamp, because a beacon has overtaken it."""
        return self.sign(frame[:-SIGNATURE_SIZE])

    def use(self, key: SigningKey) -> None:
        """Sign with another key from now on. No timestamp is used under two keys."""
        key.give_to(self._signer)

    def _claim(self) -> None:
        store, wanted = self._store, self.next
        # The store is asked each time: it rolls back what a fault has changed.
        claimed = store.get_meta(_KEY) or 0
        if claimed < wanted + CLAIMED // 2:
            claimed = wanted + CLAIMED
            store.set_meta(_KEY, claimed)
        if store.meta_durable(_KEY):
            self._durable = claimed
            self._enough = claimed - CLAIMED // 2
