"""The timestamps of a node's own signatures: each is used once, over all lives of the node, and no clock is needed.

They are claimed on disk before a frame with them leaves, so the next life starts above all that this one may use.
"""

from __future__ import annotations

from rass_mav.core.store import Store
from rass_mav.mavlink.signing import SIGNATURE_SIZE, Signer, SigningKey

#: Timestamps claimed at a time, one for each frame. Half a claim is left when the next one is made: at 100 frames a
#: second a disk may fail for 23 hours before the node falls silent.
CLAIMED = 1 << 24
#: More than the frames that wait in a node at any time.
WAITING = 1 << 16
#: The highest timestamp that somebody else can make a node skip to. It leaves enough for all time.
MOST_SKIPPED = 1 << 47
# The store keeps under this name the first timestamp that is not claimed.
_KEY = "timestamps"


class Timestamps:
    """Signs frames when they leave, and knows whether they may."""

    __slots__ = ("_durable", "_enough", "_signer", "_skip_to", "_store")

    def __init__(self, store: Store, signer: Signer) -> None:
        """`signer`: continues above all that earlier lives on this store have claimed."""
        self._store = store
        self._signer = signer
        signer.raise_to(store.get_meta(_KEY) or 0)
        self._skip_to = signer.timestamp
        """The next timestamp is at least this one, as soon as it is claimed."""
        self._durable = signer.timestamp
        """The claims up to this one, exclusive, are known to be on disk."""
        self._enough = -1
        """So many can be used before the next claim."""
        self.cover()

    @property
    def link_id(self) -> int:
        """Link id of the signatures, 0..255."""
        return self._signer.link_id

    @property
    def next(self) -> int:
        """The next timestamp, 48 bits."""
        return max(self._signer.timestamp, self._skip_to)

    def cover(self) -> bool:
        """Claim timestamps, if it is time. Returns whether frames that are made now may leave at once. If not, they may
        when the present changes of the store are on disk."""
        if self._signer.timestamp > self._enough or self._skip_to > self._signer.timestamp:
            self._claim()
        return self.next + WAITING <= self._durable

    def sign(self, frame: bytes) -> bytes:
        """A frame as it leaves. Call it for frames that may leave, in their order on the air: hearers take a frame that
        others have overtaken only within a window."""
        self.cover()
        assert self._signer.timestamp < self._durable, "a frame leaves before its timestamp is claimed"
        return self._signer.sign(frame)

    def sign_again(self, frame: bytes) -> bytes:
        """A signed frame of this node with a new timestamp, because too many others have overtaken it."""
        return self.sign(frame[:-SIGNATURE_SIZE])

    def use(self, key: SigningKey) -> None:
        """Sign with another key from now on. No timestamp is used under two keys."""
        key.give_to(self._signer)

    def skip_to(self, timestamp: int) -> None:
        """Somebody has seen all timestamps below this one: use none of them."""
        if timestamp <= MOST_SKIPPED:
            self._skip_to = max(self._skip_to, timestamp)

    def _claim(self) -> None:
        store, wanted = self._store, self.next
        # The store is asked each time: it rolls back what a fault has changed.
        claimed = store.get_meta(_KEY) or 0
        if claimed < wanted + CLAIMED // 2:
            claimed = wanted + CLAIMED
            store.set_meta(_KEY, claimed)
        if store.meta_durable(_KEY):
            self._signer.raise_to(wanted)
            self._durable = claimed
            self._enough = claimed - CLAIMED // 2
