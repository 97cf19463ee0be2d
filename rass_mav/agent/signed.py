"""What a node with keys has for its links: the keys, its own timestamps, and the streams that it hears."""

from __future__ import annotations

import random
from collections.abc import Callable
from typing import NamedTuple

from rass_mav.agent.streams import Streams
from rass_mav.agent.timestamps import Timestamps
from rass_mav.core.store import Store
from rass_mav.mavlink.frames import FLAG_SIGNED, FrameWriter
from rass_mav.mavlink.messages import RADIO_STATUS
from rass_mav.mavlink.signing import SignatureCheck, SigningKeys


class Signed(NamedTuple):
    """The links of one life of a node, all together: a frame that leaves on several has the same timestamp on all."""

    keys: SigningKeys
    timestamps: Timestamps
    streams: Streams

    @classmethod
    def begin(
        cls, node_id: int, keys: SigningKeys, writer: FrameWriter, store: Store, rng: random.Random, step_s: float
    ) -> Signed:
        """`writer`: its TUNNEL messages are signed from now on. `rng`: draws nonces. `step_s`: length of a step,
        seconds."""
        writer.tunnel_flags = FLAG_SIGNED
        # A store that may have lost numbers has a new epoch, and so this node a new stream.
        timestamps = Timestamps(store, keys.signer(store.epoch & 0xFF, 0))
        return cls(keys, timestamps, Streams(node_id, writer, timestamps, rng, step_s))

    def check(self, needed: Callable[[int], bool] = lambda message_id: message_id != RADIO_STATUS) -> SignatureCheck:
        """For a reader. `needed`: returns whether messages with this id must be signed; by default all but
        RADIO_STATUS, which the node's own radio sends."""
        return SignatureCheck(self.keys, needed)
