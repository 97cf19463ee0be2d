"""What a node with keys says to another one, which nobody else can say (docs/protocol.md, "Words between two nodes").

All nodes have the link key, and so has a captured drone. So whatever makes another node delete or release a copy has a
tag by a key that only the two nodes have. Such a message without a right tag does not reach the participant.
"""

from __future__ import annotations

import random
from collections.abc import Sequence
from hashlib import blake2b
from struct import Struct
from typing import Any

from rass_mav.core.datum import Datum, DatumId
from rass_mav.core.messages import Beacon, Message, custodian_of
from rass_mav.core.seals import CRC_MASK, ContentHashes, of_offers
from rass_mav.core.store import Store
from rass_mav.mavlink.frames import Stream
from rass_mav.trust.keys.identity import NodeKeys
from rass_mav.trust.keys.pairs import TAG_SIZE
from rass_mav.trust.peers import IsRevoked, Links, PeerTable
from rass_mav.wire import encode
from rass_mav.wire.codec import COMMITTED
from rass_mav.wire.introduction import decode_introduction, is_introduction
from rass_mav.wire.tags import Claim, believed, is_tagged

#: Hand-overs whose contents are remembered, the latest. More wait for an answer only where thousands are sent a step.
MAX_OFFERED = 4096

_DATUM = Struct("<HIIBB")
_NOTE = Struct("<HIIB")
_PLACE = Struct("<Q")
_NO_TAG = bytes(TAG_SIZE)
_NO_TAGS = (_NO_TAG, b"")


class StrongContentHashes(ContentHashes):
    """Nobody can find a second content for one of these: the checksum, and above it 16 bytes of BLAKE2b."""

    __slots__ = ("_last",)

    def __init__(self) -> None:
        # A node asks three times in a row for each datum that it is given.
        self._last: tuple[Datum | None, bool, int] = (None, False, 0)

    def of(self, datum: Datum, *, replica: bool = False) -> int:
        last, as_replica, content_hash = self._last
        if last is not datum or as_replica is not replica:
            about = _DATUM.pack(*datum.id, datum.kind, replica)
            content_hash = _print(b"rass offer", about + datum.payload) | datum.crc & CRC_MASK
            self._last = datum, replica, content_hash
        return content_hash

    def of_note(self, id: DatumId, reason: int) -> int:
        return _print(b"rass note", _NOTE.pack(*id, reason))


def _print(person: bytes, data: bytes) -> int:
    return int.from_bytes(blake2b(data, digest_size=16, person=person).digest(), "little") << 32


class PairTags:
    """Proves one node's words, and suspects others'."""

    __slots__ = (
        "_again",
        "_early",
        "_forged",
        "_is_revoked",
        "_keys",
        "_now",
        "_offered",
        "_own",
        "_unknown",
        "peer_table",
    )

    content_hashes = StrongContentHashes()

    def __init__(self, keys: NodeKeys, is_revoked: IsRevoked, store: Store, rng: random.Random, step_s: float) -> None:
        """`is_revoked`: see `KeyUpdates`. `rng`: draws nonces. `step_s`: seconds."""
        self._keys = keys
        self._is_revoked = is_revoked
        self._own = keys.certificate.node_id
        self.peer_table = PeerTable(keys, store, rng, step_s, is_revoked)
        """The nodes whose certificates are known."""
        self._offered: dict[int, int] = {}
        """Content hashes of what was handed over, by number, the latest last."""
        self._now = 0.0
        self._unknown = self._forged = self._early = self._again = 0

    # -- what goes out -------------------------------------------------------------------------------------------------

    def encoded(self, message: Message, store: Store, now: float) -> list[bytes]:
        """The TUNNEL payloads of a message of this node."""
        offered = self._offered
        for number, content_hash in of_offers(message, self.content_hashes, store.get):
            offered.pop(number, None)
            offered[number] = content_hash
            if len(offered) > MAX_OFFERED:
                del offered[next(iter(offered))]
        return encode(message, now, self)

    def use(self, links: Links) -> None:
        """Set the streams of the links whose frames are signed."""
        self.peer_table.links = links

    def introductions(self, now: float) -> list[bytes]:
        """What this node has to say of itself now, as TUNNEL payloads for everybody."""
        return self.peer_table.due(now)

    def of_answer(self, to: int, claim: bytes) -> bytes:
        """The tag of an answer. Zeros: that node's certificate is not known, so it will ask again."""
        return self._tag(COMMITTED, to, claim)

    def of_word(self, type_: int, to: Sequence[int], claim: bytes) -> tuple[int, list[bytes]]:
        """The place of a word, the low 32 bits, and its tag for each receiver."""
        self.peer_table.place += 1
        place = self.peer_table.place
        return place & 0xFFFFFFFF, [self._tag(type_, node_id, _PLACE.pack(place) + claim) for node_id in to]

    def _tag(self, type_: int, to: int, claim: bytes) -> bytes:
        peer = self.peer_table.get(to)
        return _NO_TAG if peer is None or peer.pair is None else peer.pair.tag(type_, claim)

    # -- what comes in -------------------------------------------------------------------------------------------------

    def meet(self, node_id: int, now: float, stream: Stream) -> None:
        """A beacon in the name of a node was heard in a stream in which it has not proved itself, or not lately."""
        self.peer_table.heard(node_id, now, stream)
        self.peer_table.ask(node_id, now)

    def shown(self, beacon: Beacon) -> Beacon:
        """This node's own beacon as it leaves."""
        return self.peer_table.shown(beacon)

    def introduced(self, payload: bytes, now: float, stream: Stream) -> bool:
        """Take a TUNNEL payload that only introduces another node. False: it is something else."""
        if not is_introduction(payload):
            return False
        self.peer_table.hear(decode_introduction(payload), now, stream)
        return True

    def believed(self, message: Message, payload: bytes, now: float, stream: Stream) -> Message | None:
        """A message that was heard, without what its sender has not said; None: nothing is left of it. `payload`: of
        its TUNNEL. `stream`: in which it came."""
        self._now = now
        if (
            type(message) is Beacon
            and message.sender != self._own
            and not self.peer_table.believes(message, now, stream)
        ):
            return None
        heard = believed(message, payload, self._own, self)
        custodian = custodian_of(heard)
        if custodian is not None:
            peer = self.peer_table.get(custodian)
            if peer is None or peer.pair is None:
                # Nothing that this node says about it would be believed, so it will come again. And nobody hands
                # anything over under an invented name.
                self._unknown += 1
                return None
        return heard

    def proves(self, message: Message) -> bool:
        """Whether nobody but its sender can have said a message that is `believed`."""
        return is_tagged(message)

    def content_hash(self, number: int) -> int | None:
        """What was last handed over under this number."""
        return self._offered.get(number)

    def is_true(self, claim: Claim) -> bool:
        """Whether the sender has said this, and it is new if it has a place."""
        peer = self.peer_table.get(claim.sender)
        if peer is None or peer.pair is None or claim.tag in _NO_TAGS:
            # One of the two does not know the other's certificate yet.
            self._unknown += 1
            if peer is None or peer.pair is None:
                self.peer_table.ask(claim.sender, self._now)
            return False
        if claim.place is None:
            made = peer.pair.made(claim.type, claim.data, claim.tag)
            self._forged += not made
            return made
        if peer.place is None:
            self._early += 1
            self.peer_table.ask(claim.sender, self._now)
            return False
        place = peer.place >> 32 << 32 | claim.place
        if not peer.pair.made(claim.type, _PLACE.pack(place) + claim.data, claim.tag):
            self._forged += 1
            # Perhaps it has started again.
            self.peer_table.ask(claim.sender, self._now)
            return False
        new = peer.is_new(place)
        self._again += not new
        return new

    def report(self) -> dict[str, Any]:
        """For `status`: the certificates, and how many words were not believed."""
        return {
            **self.peer_table.report(),
            "not_believed": {
                "unknown": self._unknown,
                "forged": self._forged,
                "early": self._early,
                "again": self._again,
            },
        }
