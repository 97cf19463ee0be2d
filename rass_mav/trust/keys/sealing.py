"""Sealed data: readable for the ground alone, and made by their origin alone.

ChaCha20-Poly1305 (RFC 8439) with a key on which the origin and the ground agree once. The nonce is the id of the datum,
which never names two data. Its kind and what stays open beside the contents are authenticated with it; its age and hops
are not, because relays change them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import lru_cache
from hashlib import blake2b
from hmac import compare_digest
from itertools import chain
from struct import Struct

from nacl.bindings import (
    crypto_aead_chacha20poly1305_ietf_ABYTES,
    crypto_aead_chacha20poly1305_ietf_decrypt,
    crypto_aead_chacha20poly1305_ietf_encrypt,
    crypto_scalarmult_base,
)
from nacl.exceptions import CryptoError

from rass_mav.errors import ForgedError, MalformedError

from .certificate import BASE_SERIAL, GroundPublic, agreed, certificate_body
from .identity import Ground, NodeKeys
from .secret import Purpose, Secret

#: Bytes of the tag of a deletion report.
LOSS_TAG_SIZE = 8
#: Bytes that sealing adds to a payload.
SEAL_SIZE: int = crypto_aead_chacha20poly1305_ietf_ABYTES
#: A base also tries this many serials above the last one it knows: drones that were replaced since its file was copied.
LATER_SERIALS = 3
#: Keys that an opener remembers. To agree on one takes ten times as long as to open a datum.
KEPT_KEYS = 4096

# Origin, epoch and sequence, and two zero bytes.
_NONCE = Struct("<HIIxx")
_KIND = Struct("<B")


class Sealer:
    """Seals the data of one node, in one epoch of its store.

    Each life of a node has one of its own: after a roll-back the store assigns numbers again of which nothing has left.
    """

    __slots__ = ("_epoch", "_key", "_loss_key", "_next", "_origin")

    def __init__(self, keys: NodeKeys, epoch: int, first: int) -> None:
        """:param epoch: 32 bits. :param first: the lowest sequence that the store has not assigned."""
        common = agreed(keys.secret, keys.ground.sealing)
        self._key, self._loss_key = _derived(common, keys.certificate.body, keys.ground)
        self._origin, self._epoch, self._next = keys.certificate.node_id, epoch, first

    def seal(self, sequence: int, kind: int, payload: bytes, beside: bytes = b"") -> bytes:
        """The sealed payload, 16 bytes longer.

        :param sequence: of the datum in this epoch, above those sealed before. Two data under one id would reveal both.
        :param kind: of the datum, 0..255. :param beside: what stays open, and must not be altered either.
        :raises ValueError: a sequence that is not above those sealed before.
        """
        if sequence < self._next:
            raise ValueError(f"{self._origin}-{self._epoch:08x}-{sequence} would be sealed a second time")
        self._next = sequence + 1
        nonce = _NONCE.pack(self._origin, self._epoch, sequence)
        return crypto_aead_chacha20poly1305_ietf_encrypt(payload, _about(kind, beside), nonce, self._key.reveal())

    def loss_tag(self, loss: bytes) -> bytes:
        """The tag of what the node reports lost: only the node and the ground can make it."""
        return _loss_tag(self._loss_key, loss)


class Opener:
    """Opens sealed data, at a base or afterwards."""

    def __init__(self, ground: Ground, serials: Callable[[], Mapping[int, int]] | None = None) -> None:
        """`serials`: returns the last serials by node id, if they may change; None: those of `ground`."""
        self._ground = ground
        self._serials = serials or (lambda: ground.serials)
        self._key = lru_cache(KEPT_KEYS)(self._agree)

    def open(self, id: tuple[int, int, int], kind: int, sealed: bytes, beside: bytes = b"") -> bytes:
        """The payload.

        :param id: origin (0..65534), epoch and sequence (32 bits) of the datum.
        :param kind: of the datum, 0..255. :param beside: what is open.
        :raises MalformedError: too short to be sealed. :raises ForgedError: not sealed by its origin, or altered.
        """
        if len(sealed) < SEAL_SIZE:
            raise MalformedError(f"a sealed datum has at least {SEAL_SIZE} bytes, got {len(sealed)}")
        nonce, about = _NONCE.pack(*id), _about(kind, beside)
        for key, _ in self._keys(id[0]):
            try:
                return crypto_aead_chacha20poly1305_ietf_decrypt(sealed, about, nonce, key.reveal())
            except CryptoError:
                continue
        raise ForgedError("not sealed by the origin that it names, or altered")

    def made(self, node_id: int, loss: bytes, tag: bytes) -> bool:
        """Whether a node (0..65534) has reported a loss."""
        return any(compare_digest(_loss_tag(key, loss), tag) for _, key in self._keys(node_id))

    def _keys(self, origin: int) -> Iterator[tuple[Secret, Secret]]:
        """Those that the origin may have, the likely ones first."""
        last = self._serials().get(origin)
        if last is None:
            # No drone of this mission, at most a base. Invented origins must not push out the keys of drones.
            yield self._agree(origin, BASE_SERIAL)
            return
        for serial in chain(range(last, BASE_SERIAL - 1, -1), range(last + 1, last + 1 + LATER_SERIALS)):
            yield self._key(origin, serial)

    def _agree(self, origin: int, serial: int) -> tuple[Secret, Secret]:
        public = crypto_scalarmult_base(self._ground.node_secret(origin, serial).reveal())
        common = agreed(self._ground.opening, public)
        return _derived(common, certificate_body(origin, serial, public), self._ground.public)


def _about(kind: int, beside: bytes) -> bytes:
    """What is authenticated, and not encrypted."""
    return _KIND.pack(kind) + beside


def _loss_tag(key: Secret, loss: bytes) -> bytes:
    return blake2b(loss, digest_size=LOSS_TAG_SIZE, key=key.reveal()).digest()


def _derived(common: Secret, origin: bytes, ground: GroundPublic) -> tuple[Secret, Secret]:
    """The keys of data and of deletion reports. `origin`: the body of its certificate."""
    return common.derive(Purpose.SEAL, origin + ground.sealing), common.derive(Purpose.LOSS, origin + ground.sealing)
