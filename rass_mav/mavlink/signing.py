"""Signatures of MAVLink 2 frames (https://mavlink.io/en/guide/message_signing.html).

The signature is 13 bytes after the checksum: a link id (1), a timestamp (6, little-endian), and the first 48 bits of
SHA-256 over the key, the frame with its checksum, the link id and the timestamp.

The timestamps of a stream (system id, component id, link id) only rise, so an old frame cannot be replayed. Whether a
timestamp is new is not decided here: a signature shows who made a frame, not when.
"""

from __future__ import annotations

import hashlib
import hmac
import struct
from collections.abc import Callable

SIGNATURE_SIZE = 13
KEY_SIZE = 32
#: The highest timestamp.
MAX_TIMESTAMP = (1 << 48) - 1
#: https://mavlink.io/en/messages/common.html#SETUP_SIGNING
SETUP_SIGNING = 256

# As on the wire: initial_timestamp, target_system, target_component, secret_key.
_SETUP = struct.Struct(f"<QBB{KEY_SIZE}s")


def _keyed_hash(key: bytes) -> hashlib._Hash:
    if len(key) != KEY_SIZE:
        raise ValueError(f"a signing key has {KEY_SIZE} bytes, got {len(key)}")
    return hashlib.sha256(key)


class Signer:
    """Signs the frames of one stream. Each timestamp is used once."""

    __slots__ = ("_hash", "_link", "link_id", "timestamp")

    def __init__(self, key: bytes, link_id: int, timestamp: int) -> None:
        """:param key: 32 bytes, the same on all systems.
        :param link_id: 0..255.
        :param timestamp: of the first frame, 48 bits. The caller has to know that it was never used.
        :raises ValueError: a key, link id or timestamp out of range.
        """
        self._hash = _keyed_hash(key)
        self._link = bytes((link_id,))
        self.link_id = link_id
        self.timestamp = 0
        """Of the next frame. It rises by one with each."""
        self.raise_to(timestamp)

    def use(self, key: bytes) -> None:
        """Sign with another key from now on. The timestamps continue."""
        self._hash = _keyed_hash(key)

    def raise_to(self, timestamp: int) -> None:
        """Raise the timestamp of the next frame; never lowers it. :raises ValueError: it has more than 48 bits."""
        if not 0 <= timestamp <= MAX_TIMESTAMP:
            raise ValueError(f"a signing timestamp has 48 bits, got {timestamp}")
        self.timestamp = max(self.timestamp, timestamp)

    def sign(self, frame: bytes) -> bytes:
        """The frame, followed by its signature.

        :param frame: from the magic byte to the checksum, with incompatibility flag 1 set.
        :raises OverflowError: all timestamps are used, which takes 89 years at 100,000 frames a second.
        """
        timestamp = self.timestamp
        frame += self._link + timestamp.to_bytes(6, "little")
        self.timestamp = timestamp + 1
        digest = self._hash.copy()
        digest.update(frame)
        return frame + digest.digest()[:6]


class SigningKey:
    """The key of a mission's links. Immutable; it appears in no representation."""

    __slots__ = ("_hash", "_key")

    def __init__(self, key: bytes) -> None:
        """:param key: 32 bytes. :raises ValueError: another length."""
        self._key = key
        self._hash = _keyed_hash(key)

    def signer(self, link_id: int, timestamp: int) -> Signer:
        """As for a `Signer`."""
        return Signer(self._key, link_id, timestamp)

    def give_to(self, signer: Signer) -> None:
        """Let it sign with this key from now on."""
        signer.use(self._key)

    def made(self, frame: bytes) -> bool:
        """Whether a signed frame was signed with this key.

        :param frame: the whole frame, from the magic byte to the last byte of the signature.
        """
        digest = self._hash.copy()
        digest.update(frame[:-6])
        return hmac.compare_digest(digest.digest()[:6], frame[-6:])


def setup_signing(key: SigningKey | None, timestamp: int, *, target_system: int, target_component: int) -> bytes:
    """Payload of SETUP_SIGNING. Whoever reads it on its way has the key.

    :param key: to sign with; None: turn signing off.
    :param timestamp: to start from, 48 bits; 0 without a key.
    """
    return _SETUP.pack(timestamp, target_system, target_component, bytes(KEY_SIZE) if key is None else key._key)


class SignatureCheck:
    """Refuses frames that are not signed with the key, and counts them."""

    __slots__ = ("_needed", "_tell", "forged", "key", "unsigned")

    def __init__(
        self, key: SigningKey, needed: Callable[[int], bool], tell: Callable[[bytes], None] | None = None
    ) -> None:
        """:param needed: returns whether messages with this id need a signature; others are not checked.
        :param tell: called with each frame that is signed with another key. It is refused nevertheless.
        """
        self.key = key
        """May be changed between frames."""
        self._needed = needed
        self._tell = tell
        self.unsigned = 0
        """Frames without a signature."""
        self.forged = 0
        """Frames with a signature by another key."""

    def passes(self, frame: bytes, message_id: int, *, signed: bool) -> bool:
        """:param frame: a whole frame with a good checksum."""
        if not self._needed(message_id):
            return True
        if not signed:
            self.unsigned += 1
            return False
        made = self.key.made(frame)
        if not made:
            self.forged += 1
            if self._tell is not None:
                self._tell(frame)
        return made

    def report(self) -> dict[str, int]:
        """How many frames were refused, and why, for `status`."""
        return {"unsigned": self.unsigned, "forged": self.forged}
