"""What a node with keys says to another one, and no third node can say.

docs/reference/protocol-keys.md ("Tags between two nodes") has the rules.

All nodes have the link key, and so has a captured drone. Whatever makes another node delete or release a copy therefore
has a tag by a key that only the two nodes have. Such a message without a right tag does not reach the participant.
"""

from __future__ import annotations

from hashlib import blake2b
from struct import Struct

from rass_mav.core.datum import Datum, DatumId
from rass_mav.core.messages import Message, custodian_of
from rass_mav.core.seals import CRC_MASK, ContentHashes, of_offers
from rass_mav.core.store import Store
from rass_mav.trust.keys.pairs import TAG_SIZE
from rass_mav.trust.sessions import Sessions
from rass_mav.wire import encode
from rass_mav.wire.codec import COMMITTED
from rass_mav.wire.tags import Claim, believed

#: Hand-overs whose contents are remembered, the latest. More wait for an answer only where thousands are sent a step.
MAX_OFFERED = 4096

_DATUM = Struct("<HIIBB")
_NOTE = Struct("<HIIB")
_PLACE = Struct("<Q")
_NO_TAG = bytes(TAG_SIZE)
_NO_TAGS = (_NO_TAG, b"")


class StrongContentHashes(ContentHashes):
    """No attacker can find a second content for one of these: the checksum, and above it 16 bytes of BLAKE2b."""

    __slots__ = ("_last",)

    proven = True

    def __init__(self) -> None:
        # A node asks three times in a row for each datum that it is given.
        self._last: tuple[Datum | None, bool, int] = (None, False, 0)

    def of(self, datum: Datum, *, replica: bool = False) -> int:
        last, as_replica, content_hash = self._last
        if last is not datum or as_replica is not replica:
            about = _DATUM.pack(*datum.id, datum.kind, replica)
            content_hash = _strong_hash(b"rass offer", about + datum.payload) | datum.crc & CRC_MASK
            self._last = datum, replica, content_hash
        return content_hash

    def of_note(self, id: DatumId, reason: int) -> int:
        return _strong_hash(b"rass note", _NOTE.pack(*id, reason))


def _strong_hash(person: bytes, data: bytes) -> int:
    return int.from_bytes(blake2b(data, digest_size=16, person=person).digest(), "little") << 32


class PairTags:
    """Proves one node's messages, and verifies others'."""

    __slots__ = ("_again", "_early", "_forged", "_now", "_offered", "_own", "_sessions", "_unknown")

    content_hashes = StrongContentHashes()

    def __init__(self, node_id: int, sessions: Sessions) -> None:
        """`sessions`: of this node with the others."""
        self._own = node_id
        self._sessions = sessions
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

    def of_answer(self, to: int, claim: bytes) -> bytes:
        """The tag of an answer. Zeros: that node's certificate is not known, so it will ask again."""
        return self._tag(COMMITTED, to, claim)

    def of_message(self, type_: int, to: int, claim: bytes) -> tuple[int, bytes]:
        """The place of a message, the low 32 bits, and its tag."""
        self._sessions.place += 1
        place = self._sessions.place
        return place & 0xFFFFFFFF, self._tag(type_, to, _PLACE.pack(place) + claim)

    def _tag(self, type_: int, to: int, claim: bytes) -> bytes:
        session = self._sessions.get(to)
        return _NO_TAG if session is None or session.pair is None else session.pair.tag(type_, claim)

    # -- what comes in -------------------------------------------------------------------------------------------------

    def believed(self, message: Message, payload: bytes, now: float) -> Message | None:
        """A message that was heard, without the parts that its sender has not made; None: nothing is left of it.
        `payload`: of its TUNNEL."""
        self._now = now
        heard = believed(message, payload, self._own, self)
        custodian = custodian_of(heard)
        if custodian is not None:
            session = self._sessions.get(custodian)
            if session is None or session.pair is None:
                # No answer of this node would be believed, so it will come again. And no node hands anything over
                # under an invented name.
                self._unknown += 1
                return None
        return heard

    def content_hash(self, number: int) -> int | None:
        """What was last handed over under this number."""
        return self._offered.get(number)

    def is_true(self, claim: Claim) -> bool:
        """Whether the sender has said this, and it is new if it has a place."""
        session = self._sessions.get(claim.sender)
        if session is None or session.pair is None or claim.tag in _NO_TAGS:
            # One of the two does not know the other's certificate yet.
            self._unknown += 1
            if session is None or session.pair is None:
                self._sessions.ask(claim.sender, self._now)
            return False
        if claim.place is None:
            made = session.pair.made(claim.type, claim.data, claim.tag)
            self._forged += not made
            return made
        if session.proven is None:
            self._early += 1
            self._sessions.ask(claim.sender, self._now)
            return False
        place = session.proven.life << 32 | claim.place
        if not session.pair.made(claim.type, _PLACE.pack(place) + claim.data, claim.tag):
            self._forged += 1
            # Perhaps it has started again.
            self._sessions.ask(claim.sender, self._now)
            return False
        session.proven.messages.advance(place)
        new = session.proven.messages.is_new(place, place)
        self._again += not new
        return new

    def report(self) -> dict[str, int]:
        """For `status`: how many messages were not believed."""
        return {"unknown": self._unknown, "forged": self._forged, "early": self._early, "repeated": self._again}
