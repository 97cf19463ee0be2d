"""The timestamps of a node's own signatures: each is used once, over all lives of the node, and no clock is needed.

They are claimed on disk before a frame with them leaves, so the next life starts above all that this one may use.
"""

from __future__ import annotations

from rass_mav.core.store import Store
from rass_mav.mavlink.signing import Signer

#: Timestamps claimed at a time, one for each frame. Half a claim is left when the next one is made: at 100 frames a
#: second a disk may fail for 23 hours before the node falls silent.
CLAIMED = 1 << 24
#: The highest timestamp that somebody else can make a node skip to. It leaves enough for all time.
MOST_SKIPPED = 1 << 47
# The store keeps under this name the first timestamp that is not claimed.
_KEY = "timestamps"


class Timestamps:
    """Which timestamps of a `Signer` may be on the air."""

    __slots__ = ("_durable", "_enough", "_store", "signer")

    def __init__(self, store: Store, signer: Signer) -> None:
        """`signer`: continues above all that earlier lives on this store have claimed."""
        self._store = store
        self.signer = signer
        signer.raise_to(store.get_meta(_KEY) or 0)
        self._durable = signer.timestamp
        """Claims up to this one, exclusive, are known to be on disk."""
        self._enough = -1
        """So many can be used before the next claim."""
        self.covers()

    def covers(self) -> bool:
        """Whether all timestamps that were used until now are claimed on disk, so that frames may leave.

        If not, they may when the present changes of the store are on disk.
        """
        used = self.signer.timestamp
        if used > self._enough:
            self._claim(used)
        return used <= self._durable

    def skip_to(self, timestamp: int) -> None:
        """Somebody has seen all timestamps below this one: use none of them."""
        if timestamp <= MOST_SKIPPED:
            self.signer.raise_to(timestamp)

    def _claim(self, used: int) -> None:
        store = self._store
        # The store is asked each time: it rolls back what a fault has changed.
        claimed = store.get_meta(_KEY) or 0
        if claimed < used + CLAIMED // 2:
            claimed = used + CLAIMED
            store.set_meta(_KEY, claimed)
        if store.meta_durable(_KEY):
            self._durable = claimed
            self._enough = claimed - CLAIMED // 2
