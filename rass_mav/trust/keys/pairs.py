"""Two nodes that can tell each other's messages from those of all others, although all have the link key."""

from __future__ import annotations

from hashlib import blake2b
from hmac import compare_digest

from rass_mav.errors import ForgedError

from .certificate import Certificate, agreed
from .identity import NodeKeys
from .secret import Purpose, Secret

#: Bytes of a tag.
TAG_SIZE = 8


class Pair:
    """What one node says to another one, and hears from it, with tags of 8 bytes.

    There is a key for each direction, so a node does not accept its own messages when they come back. A tag does not
    show that a message is new: it must say what it answers, for example the number of a hand-over.
    """

    __slots__ = ("_heard", "_own")

    def __init__(self, own: NodeKeys, other: Certificate) -> None:
        """:param other: verified by `Certificate.unpack`. :raises ForgedError: it names this node itself."""
        mine = own.certificate
        if other.node_id == mine.node_id:
            raise ForgedError(f"a certificate of another node with this node's id, {mine.node_id}")
        common = agreed(own.secret, other.public)
        self._own = common.derive(Purpose.PAIR, mine.body + other.body)
        self._heard = common.derive(Purpose.PAIR, other.body + mine.body)

    def tag(self, kind: int, data: bytes) -> bytes:
        """The tag of what this node says to the other one, 8 bytes. `kind`: the message's type on the wire, 0..255."""
        return _tag(self._own, kind, data)

    def made(self, kind: int, data: bytes, tag: bytes) -> bool:
        """Whether the other node has made this tag for this node."""
        return compare_digest(_tag(self._heard, kind, data), tag)


def _tag(key: Secret, kind: int, data: bytes) -> bytes:
    return blake2b(bytes((kind,)) + data, digest_size=TAG_SIZE, key=key.reveal()).digest()
