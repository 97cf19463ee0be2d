"""Attestations: what only a base can sign, and every node of the mission can verify."""

from __future__ import annotations

from hashlib import blake2b
from struct import Struct

from rass_mav.errors import ForgedError

from .certificate import GroundPublic
from .identity import Ground
from .keyring import Keyring
from .secret import Purpose

_CHAIN = Struct("<HII")
#: Bytes of a chain's first element.
_SEED_BYTES = 8


class Attestation:
    """What a node knows of the ground, and what a base can say in its name."""

    __slots__ = ("_ground", "_public", "speaks")

    def __init__(self, keyring: Keyring) -> None:
        self._public: GroundPublic = keyring.own.ground
        self._ground: Ground | None = keyring.ground
        self.speaks = keyring.ground is not None
        """Whether this node is a base, and has the ground's keys."""

    def vouches(self, body: bytes, signature: bytes) -> bool:
        """Whether the ground has signed a statement signature."""
        return self._is_signed(Purpose.STATEMENT_SIGNATURE, body, signature)

    def anchors(self, body: bytes, signature: bytes) -> bool:
        """Whether the ground has signed an anchor."""
        return self._is_signed(Purpose.ANCHOR, body, signature)

    def _is_signed(self, purpose: Purpose, body: bytes, signature: bytes) -> bool:
        try:
            self._public.verify(purpose, body, signature)
        except ForgedError:
            return False
        return True

    def vouch(self, body: bytes) -> bytes:
        """At a base: the signature of a statement signature, 64 bytes."""
        assert self._ground is not None
        return self._ground.sign(Purpose.STATEMENT_SIGNATURE, body)

    def anchor(self, body: bytes) -> bytes:
        """At a base: the signature of an anchor, 64 bytes."""
        assert self._ground is not None
        return self._ground.sign(Purpose.ANCHOR, body)

    def chain_seed(self, base: int, base_life: int, serial: int) -> bytes:
        """At a base: where a hash chain begins, 8 bytes. `serial`: of the chain, 32 bits."""
        assert self._ground is not None
        secret = self._ground.secret.derive(Purpose.CHAIN, _CHAIN.pack(base, base_life, serial))
        return blake2b(secret.reveal(), digest_size=_SEED_BYTES, person=Purpose.CHAIN).digest()

    def chain_salt(self, base: int, base_life: int, serial: int) -> bytes:
        """What tells the hashes of one chain from those of all others, 8 bytes. It is no secret."""
        about = self._public.signing + _CHAIN.pack(base, base_life, serial)
        return blake2b(about, digest_size=8, person=Purpose.ANCHOR).digest()
