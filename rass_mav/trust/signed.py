"""What a node with keys has for its links: the key, its own timestamps, and the streams that it hears."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from rass_mav.agent.seam import all_but_radio
from rass_mav.core.store import Store
from rass_mav.mavlink.frames import FLAG_SIGNED, FrameWriter, Stream
from rass_mav.mavlink.signing import SignatureCheck, SigningKey
from rass_mav.mavlink.tunnel import tunnel_from_datagram
from rass_mav.trust.streams import Streams, Verdict
from rass_mav.trust.timestamps import Timestamps
from rass_mav.wire.key_updates import is_about_keys

if TYPE_CHECKING:
    from rass_mav.trust.key_updates import KeyUpdates


class Signed:
    """The links of one life of a node, all together: a frame that leaves on several has the same timestamp on all."""

    __slots__ = ("_checks", "_payload_type", "key", "key_updates", "streams", "timestamps")

    def __init__(
        self, node_id: int, key_updates: KeyUpdates, writer: FrameWriter, store: Store, start: int, payload_type: int
    ) -> None:
        """:param key_updates: bring the key, and later ones.
        :param writer: its TUNNEL messages are signed from now on.
        :param start: 15 bits, where its beacons begin.
        :param payload_type: of the swarm's TUNNEL messages.
        """
        writer.tunnel_flags = FLAG_SIGNED
        self.key = key = key_updates.signing
        # A store that may have lost numbers has a new epoch, and so this node a new stream.
        self.timestamps = Timestamps(store, key.signer(store.epoch & 0xFF, 0), start)
        self.streams = Streams(node_id, writer, self.timestamps)
        self.key_updates = key_updates
        self._payload_type = payload_type
        self._checks: list[SignatureCheck] = []

    def check(self, needed: Callable[[int], bool] = all_but_radio) -> SignatureCheck:
        """For a reader. `needed`: returns whether messages with this id must be signed; by default all but
        RADIO_STATUS, which the node's own radio sends."""
        check = SignatureCheck(self.key, needed, self._hear_other_key)
        self._checks.append(check)
        return check

    def use(self, key: SigningKey) -> None:
        """Sign with another link key from now on, and take no frames of the old one any more."""
        self.key = key
        self.timestamps.use(key)
        for check in self._checks:
            check.key = key

    def admit(self, stream: Stream, timestamp: int, payload: bytes, now: float) -> Verdict | None:
        """As `Streams.admit`. None: it was new, and about keys; it is taken here."""
        verdict = self.streams.admit(stream, timestamp, payload, now)
        if verdict is not Verdict.NEW or not is_about_keys(payload):
            return verdict
        self.key_updates.hear(self.streams.quota_holder(stream), payload, now)
        return None

    def _hear_other_key(self, frame: bytes) -> None:
        opened = tunnel_from_datagram(frame)
        if opened is not None and opened[4] == self._payload_type:
            self.key_updates.hear_other_key(opened[5])
