"""The keys of a node, and of the ground, from whose one secret all keys of a mission are derived."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from struct import Struct
from typing import NamedTuple

from nacl.bindings import crypto_scalarmult_base, crypto_sign, crypto_sign_seed_keypair

from rass_mav.config.keys import AboutKeys

from .certificate import BASE_SERIAL, SIGNATURE_SIZE, Certificate, GroundPublic, certificate_body, signed_bytes
from .secret import Purpose, Secret

_NODE = Struct("<HI")
_NUMBER = Struct("<I")


class LinkKey(NamedTuple):
    """A key that all nodes of the mission have."""

    number: int
    """From 1, 32 bits; a later key has a higher one."""
    key: Secret


@dataclass(frozen=True)
class NodeKeys:
    """The keys of one node."""

    certificate: Certificate
    secret: Secret
    """Of the public key in the certificate."""
    ground: GroundPublic
    link: LinkKey
    """The one in the node's file. A key update may have brought a later one (`trust.keys.key_updates`)."""

    @property
    def about(self) -> AboutKeys:
        """The public part."""
        own = self.certificate
        return {
            "mission": self.ground.mission, "node_id": own.node_id, "serial": own.serial, "link_key": self.link.number
        }  # fmt: skip


@dataclass(frozen=True)
class Ground:
    """The ground's keys. Every base holds them, and no drone ever does."""

    secret: Secret
    """All other keys are derived from it."""
    number: int = 1
    """Of the link key in use."""
    serials: Mapping[int, int] = field(default_factory=dict)
    """By node id, the last serial that a drone was given."""
    revoked: frozenset[int] = frozenset()
    """Node ids whose last serial is revoked."""

    @cached_property
    def public(self) -> GroundPublic:
        """The public part of it."""
        signing, _ = crypto_sign_seed_keypair(self._signing.reveal())
        return GroundPublic(signing, crypto_scalarmult_base(self.opening.reveal()))

    @cached_property
    def opening(self) -> Secret:
        """The X25519 secret with which sealed data are opened."""
        return self.secret.derive(Purpose.GROUND_OPENS)

    @cached_property
    def _signing(self) -> Secret:
        """The seed of the Ed25519 key."""
        return self.secret.derive(Purpose.GROUND_SIGNS)

    def sign(self, purpose: Purpose, data: bytes) -> bytes:
        """The ground's signature, 64 bytes (Ed25519, RFC 8032)."""
        # libsodium's form of the secret key: the seed, then the public key.
        key = self._signing.reveal() + self.public.signing
        return crypto_sign(signed_bytes(purpose, data), key)[:SIGNATURE_SIZE]

    @property
    def link(self) -> LinkKey:
        """The link key in use."""
        return self.link_key(self.number)

    def link_key(self, number: int) -> LinkKey:
        """The link key with this number, from 1."""
        return LinkKey(number, self.secret.derive(Purpose.LINK, _NUMBER.pack(number)))

    def node_secret(self, node_id: int, serial: int) -> Secret:
        """The X25519 secret of a node. `node_id`: 16 bits. `serial`: 32 bits, 0 for the base with this id."""
        return self.secret.derive(Purpose.NODE, _NODE.pack(node_id, serial))

    def node(self, node_id: int, serial: int = BASE_SERIAL) -> NodeKeys:
        """The keys of a drone, or of the base with this id (serial 0). They are the same each time."""
        secret = self.node_secret(node_id, serial)
        public = crypto_scalarmult_base(secret.reveal())
        signature = self.sign(Purpose.CERTIFICATE, certificate_body(node_id, serial, public))
        return NodeKeys(Certificate(node_id, serial, public, signature), secret, self.public, self.link)
