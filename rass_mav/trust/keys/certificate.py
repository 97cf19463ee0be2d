"""The ground's public keys, and certificates: the ground's statement that a node id has a public key."""

from __future__ import annotations

from hashlib import blake2b
from struct import Struct
from typing import NamedTuple

from nacl.bindings import crypto_scalarmult, crypto_sign_open
from nacl.exceptions import BadSignatureError
from nacl.exceptions import RuntimeError as SodiumError

from rass_mav.errors import ForgedError, MalformedError

from .secret import Purpose, Secret

#: Bytes of a public key, of Ed25519 and of X25519.
PUBLIC_SIZE = 32
#: Bytes of a signature (Ed25519).
SIGNATURE_SIZE = 64
#: The serial of bases. A drone's are above it.
BASE_SERIAL = 0

_BODY = Struct("<HI32s")
#: Bytes of a certificate. It fits one TUNNEL payload.
CERTIFICATE_SIZE = _BODY.size + SIGNATURE_SIZE
_PURPOSE_SIZE = 16


def signed_bytes(purpose: Purpose, data: bytes) -> bytes:
    """What is signed: the purpose, filled up with zeros to 16 bytes, and the data."""
    return purpose.ljust(_PURPOSE_SIZE, b"\0") + data


class GroundPublic(NamedTuple):
    """The public part of the ground's keys."""

    signing: bytes
    """Its Ed25519 public key, 32 bytes."""
    sealing: bytes
    """Its X25519 public key, 32 bytes."""

    @property
    def mission(self) -> str:
        """The mission's name for people, 8 hexadecimal digits. With much time an attacker can create another mission
        of the same name, so programs compare the keys."""
        return blake2b(self.signing + self.sealing, digest_size=4, person=Purpose.MISSION).hexdigest()

    def verify(self, purpose: Purpose, data: bytes, signature: bytes) -> None:
        """:param signature: 64 bytes. :raises ForgedError: the ground has not signed these data for this purpose."""
        try:
            crypto_sign_open(signature + signed_bytes(purpose, data), self.signing)
        except BadSignatureError:
            raise ForgedError("not signed by the ground of this mission") from None


def certificate_body(node_id: int, serial: int, public: bytes) -> bytes:
    """What the ground signs, 38 bytes: node id u16, serial u32, public key; little-endian."""
    return _BODY.pack(node_id, serial, public)


class Certificate(NamedTuple):
    """The ground's statement that a node has a public key."""

    node_id: int
    """0..65534."""
    serial: int
    """32 bits. It rises when another drone takes the place of one; 0: a base."""
    public: bytes
    """The node's X25519 public key, 32 bytes."""
    signature: bytes
    """By the ground, 64 bytes."""

    @property
    def body(self) -> bytes:
        """What the ground has signed."""
        return certificate_body(self.node_id, self.serial, self.public)

    def pack(self) -> bytes:
        """102 bytes: the body and the signature."""
        return self.body + self.signature

    @classmethod
    def unpack(cls, data: bytes, ground: GroundPublic) -> Certificate:
        """Read and verify one. There are no others in the program.

        :raises MalformedError: not 102 bytes. :raises ForgedError: not signed by this ground.
        """
        if len(data) != CERTIFICATE_SIZE:
            raise MalformedError(f"a certificate has {CERTIFICATE_SIZE} bytes, got {len(data)}")
        body, signature = data[: _BODY.size], data[_BODY.size :]
        ground.verify(Purpose.CERTIFICATE, body, signature)
        node_id, serial, public = _BODY.unpack(body)
        return cls(node_id, serial, public, signature)


def agreed(own: Secret, other: bytes) -> Secret:
    """What the owners of two key pairs have in common (X25519, RFC 7748). Only ever derive keys from it.

    :param other: the other's public key, 32 bytes.
    :raises ForgedError: a public key with which everybody would agree on the same.
    """
    try:
        return Secret(crypto_scalarmult(own.reveal(), other))
    except SodiumError:
        raise ForgedError("a public key of low order") from None
