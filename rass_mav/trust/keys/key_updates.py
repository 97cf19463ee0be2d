"""Key updates: the ground's signed message to each drone about a change of the link key (docs/how-to/keys.md).

A key update has the new link key for one drone, which alone can open it, or says that the drone is revoked. Relays
cannot open key updates of others, but see that they are the ground's. All key updates of one change are the same
whenever they are written, so several bases write the same ones.
"""

from __future__ import annotations

from collections.abc import Iterable
from hashlib import blake2b
from struct import Struct
from typing import NamedTuple

from nacl.bindings import (
    crypto_aead_chacha20poly1305_ietf_ABYTES,
    crypto_aead_chacha20poly1305_ietf_decrypt,
    crypto_aead_chacha20poly1305_ietf_encrypt,
    crypto_scalarmult_base,
)
from nacl.exceptions import CryptoError

from rass_mav.errors import ForgedError, MalformedError

from .certificate import SIGNATURE_SIZE, GroundPublic, agreed, certificate_body
from .identity import Ground, LinkKey, NodeKeys
from .secret import SECRET_SIZE, Purpose, Secret

_BODY = Struct("<BIHI")
_NONCE = Struct("<I8x")
_SEALED_SIZE: int = SECRET_SIZE + crypto_aead_chacha20poly1305_ietf_ABYTES
#: The flag of a key update that has no key.
_REVOKED = 1
_FIRST_LINE = "rass letters 1"
#: Bytes of a key update with a key, and of one that revokes.
KEY_UPDATE_SIZE = _BODY.size + _SEALED_SIZE + SIGNATURE_SIZE
REVOCATION_SIZE = _BODY.size + SIGNATURE_SIZE


class KeyUpdate(NamedTuple):
    """One key update. One that another node has brought must be verified (`verify`) or opened."""

    number: int
    """Of the link key, 32 bits. A later change has a higher one."""
    node_id: int
    """The drone that it is about, 0..65534."""
    serial: int
    """Its serial, 32 bits. Lower serials of this drone are out, whatever the key update says."""
    sealed: bytes
    """The key for the drone alone, 48 bytes. Empty: the drone is revoked."""
    signature: bytes
    """By the ground, 64 bytes."""

    @property
    def rank(self) -> tuple[int, int, bool]:
        """Of two key updates about one drone, the one of higher rank counts."""
        return self.number, self.serial, not self.sealed

    @property
    def last_revoked(self) -> int:
        """Certificates of the drone up to this serial are refused."""
        return self.serial - bool(self.sealed)

    @property
    def body(self) -> bytes:
        """What the ground has signed."""
        return _BODY.pack(0 if self.sealed else _REVOKED, self.number, self.node_id, self.serial) + self.sealed

    def pack(self) -> bytes:
        """123 bytes, or 75 if it revokes."""
        return self.body + self.signature

    @classmethod
    def unpack(cls, data: bytes) -> KeyUpdate:
        """Read a key update, and ignore what may follow. It is not verified. :raises MalformedError: it is none."""
        if len(data) < REVOCATION_SIZE:
            raise MalformedError(f"a key update has at least {REVOCATION_SIZE} bytes, got {len(data)}")
        flags, number, node_id, serial = _BODY.unpack_from(data)
        size = REVOCATION_SIZE if flags == _REVOKED else KEY_UPDATE_SIZE
        if flags not in (0, _REVOKED) or len(data) < size:
            raise MalformedError(f"a key update of {len(data)} bytes with flags {flags}")
        sealed, signature = data[_BODY.size : size - SIGNATURE_SIZE], data[size - SIGNATURE_SIZE : size]
        return cls(number, node_id, serial, sealed, signature)

    def verify(self, ground: GroundPublic) -> None:
        """:raises ForgedError: not signed by this ground."""
        ground.verify(Purpose.KEY_UPDATE, self.body, self.signature)


def write_key_update(ground: Ground, node_id: int) -> KeyUpdate:
    """The ground's key update to a drone that it has given keys, about its present link key."""
    serial = ground.serials[node_id]
    sealed = b""
    if node_id not in ground.revoked:
        public = crypto_scalarmult_base(ground.node_secret(node_id, serial).reveal())
        key = _sealing_key(agreed(ground.opening, public), certificate_body(node_id, serial, public), ground.public)
        # The number is the nonce: under one number there is one link key.
        sealed = crypto_aead_chacha20poly1305_ietf_encrypt(
            ground.link.key.reveal(), b"", _NONCE.pack(ground.number), key.reveal()
        )
    key_update = KeyUpdate(ground.number, node_id, serial, sealed, b"")
    return key_update._replace(signature=ground.sign(Purpose.KEY_UPDATE, key_update.body))


class KeyUpdateOpener:
    """Opens the key updates to one drone. This takes no signature, so it costs as little as to check a frame."""

    __slots__ = ("_key", "_own")

    def __init__(self, own: NodeKeys) -> None:
        self._own = own
        self._key: Secret | None = None

    def is_for_this(self, key_update: KeyUpdate) -> bool:
        """Whether a key update names this drone and its serial."""
        certificate = self._own.certificate
        return key_update[1:3] == (certificate.node_id, certificate.serial)

    def open(self, key_update: KeyUpdate) -> LinkKey:
        """The link key in a key update to this drone.

        :raises ForgedError: neither the ground nor this drone wrote it, or it is for another one.
        """
        if self._key is None:
            own = self._own
            self._key = _sealing_key(agreed(own.secret, own.ground.sealing), own.certificate.body, own.ground)
        try:
            opened = crypto_aead_chacha20poly1305_ietf_decrypt(
                key_update.sealed, b"", _NONCE.pack(key_update.number), self._key.reveal()
            )
        except CryptoError:
            raise ForgedError("a key update that the ground has not written to this drone") from None
        return LinkKey(key_update.number, Secret(opened))


def _sealing_key(common: Secret, drone: bytes, ground: GroundPublic) -> Secret:
    """`drone`: the body of its certificate."""
    return common.derive(Purpose.KEY_UPDATE_KEY, drone + ground.sealing)


# -- on disk -----------------------------------------------------------------------------------------------------------


def key_updates_text(packed: Iterable[bytes]) -> str:
    """The contents of a file of key updates. A finder of the file can open none of them but its own."""
    text = "".join(f"{line}\n" for line in (_FIRST_LINE, *(key_update.hex() for key_update in packed)))
    return f"{text}{_checksum(text)}\n"


def key_updates_in(data: bytes, ground: GroundPublic) -> list[bytes]:
    """The packed key updates in such a file. Empty: they are of another mission. :raises MalformedError: it is
    damaged."""
    try:
        text, _, checksum = data.decode("ascii").rstrip("\n").rpartition("\n")
        first, *lines = text.split("\n")
        if first != _FIRST_LINE or checksum != _checksum(text + "\n"):
            raise ValueError("not what was written")
        packed = [bytes.fromhex(line) for line in lines]
    except ValueError as error:
        raise MalformedError(f"not a file of key updates: {error}") from None
    key_updates = [KeyUpdate.unpack(key_update) for key_update in packed]
    try:
        # The file has a checksum, so one shows that all are of this mission.
        if key_updates:
            key_updates[0].verify(ground)
    except ForgedError:
        return []
    return packed


def _checksum(text: str) -> str:
    return blake2b(text.encode(), digest_size=8, person=Purpose.FILE).hexdigest()
