"""Introductions: how nodes with keys learn each other's certificates, and which messages are new
(docs/reference/protocol-keys.md).

They are no messages of core: no participant sees them.
"""

from __future__ import annotations

import struct
from typing import NamedTuple

from rass_mav.core.messages import BROADCAST
from rass_mav.errors import MalformedError

from .codec import KEY_BYTES, MORE_HEAD
from .generated_keyed import ASKED_FIELDS, INTRODUCTION, INTRODUCTION_FIELDS, NODE_FIELDS, PROOF_FIELDS, PROOFS_FIELDS

__all__ = [
    "ASKED_BESIDE", "CERTIFICATE_BYTES", "INTRODUCTION", "MAX_ASKED", "MAX_PROOFS", "Introduction", "Whereabouts",
    "decode_introduction", "encode_introduction", "is_introduction", "proof_claim",
]  # fmt: skip

#: Bytes of a certificate. What is in it is no matter of the wire.
CERTIFICATE_BYTES = 102
#: Nodes that are asked, and proofs, in one introduction without a certificate.
MAX_ASKED, MAX_PROOFS = 8, 6
#: Nodes that are asked beside a certificate. There are no proofs beside it.
ASKED_BESIDE = 5

_HEAD = MORE_HEAD + bytes([INTRODUCTION])
_CERTIFICATE, _WANTS = 1, 2


class Whereabouts(NamedTuple):
    """Where the sender of a proof is: what it says from now on is newer."""

    place: int = 0
    """Its last place among its tagged messages, 64 bits."""
    beacon: int = 0
    """The index of its last beacon, over all its lives, 32 bits."""
    key: bytes = bytes(KEY_BYTES)
    """The key of that beacon."""
    next_end: bytes = bytes(KEY_BYTES)
    """The end of its next chain of keys."""


class Introduction(NamedTuple):
    """What a node says of itself, and asks of others."""

    sender: int
    """Node id."""
    certificate: bytes = b""
    """Its own, packed; empty: it is not in here."""
    asked: tuple[int, ...] = ()
    """Nodes that should prove that they are there."""
    wants: bool = False
    """Whether they should send their certificates too."""
    nonce: int = 0
    """What their proofs should contain, 64 bits. Without a meaning if nobody is asked."""
    whereabouts: Whereabouts = Whereabouts()
    """Without a meaning if there is no proof."""
    proofs: tuple[tuple[int, bytes], ...] = ()
    """For other nodes, by node id: the tag of the other's nonce, of the whereabouts, and of the sender's stream."""


def is_introduction(payload: bytes) -> bool:
    """Whether a TUNNEL payload begins like an introduction of this version."""
    return payload[:2] == _HEAD


def proof_claim(nonce: int, whereabouts: Whereabouts, stream: tuple[int, int, int]) -> bytes:
    """What the tag of a proof covers. `stream`: the sender's, in which the proof travels."""
    return ASKED_FIELDS.pack(nonce) + PROOFS_FIELDS.pack(*whereabouts) + bytes(stream)


def encode_introduction(m: Introduction) -> bytes:
    """The TUNNEL payload, at most 127 bytes. ValueError or struct.error: out of bounds, which is our bug."""
    if len(m.certificate) not in (0, CERTIFICATE_BYTES) or not _fits(bool(m.certificate), len(m.asked), len(m.proofs)):
        raise ValueError("too much for one introduction")
    flags = (_CERTIFICATE if m.certificate else 0) | (_WANTS if m.wants else 0)
    parts = [INTRODUCTION_FIELDS.pack(*_HEAD, m.sender, flags, len(m.asked), len(m.proofs)), m.certificate]
    if m.asked:
        parts.append(ASKED_FIELDS.pack(m.nonce))
        parts += map(NODE_FIELDS.pack, m.asked)
    if m.proofs:
        parts.append(PROOFS_FIELDS.pack(*m.whereabouts))
        parts += (PROOF_FIELDS.pack(*proof) for proof in m.proofs)
    return b"".join(parts)


def _fits(certificate: bool, asked: int, proofs: int) -> bool:
    return asked <= (ASKED_BESIDE if certificate else MAX_ASKED) and proofs <= (0 if certificate else MAX_PROOFS)


def decode_introduction(payload: bytes) -> Introduction:
    """The introduction in a TUNNEL payload for which `is_introduction`. Raises `MalformedError`, and nothing else."""
    try:
        _, _, sender, flags, asked, proofs = INTRODUCTION_FIELDS.unpack_from(payload)
        if sender == BROADCAST or not _fits(bool(flags & _CERTIFICATE), asked, proofs):
            raise MalformedError(f"an introduction with {asked} questions and {proofs} proofs")
        at = INTRODUCTION_FIELDS.size
        certificate = b""
        if flags & _CERTIFICATE:
            certificate = payload[at : at + CERTIFICATE_BYTES]
            if len(certificate) != CERTIFICATE_BYTES:
                raise MalformedError("truncated certificate")
            at += CERTIFICATE_BYTES
        nonce, whereabouts = 0, Whereabouts()
        ids: list[int] = []
        tags: list[tuple[int, bytes]] = []
        if asked:
            (nonce,) = ASKED_FIELDS.unpack_from(payload, at)
            at += ASKED_FIELDS.size
            ids += (NODE_FIELDS.unpack_from(payload, at + i * NODE_FIELDS.size)[0] for i in range(asked))
            at += asked * NODE_FIELDS.size
        if proofs:
            whereabouts = Whereabouts._make(PROOFS_FIELDS.unpack_from(payload, at))
            at += PROOFS_FIELDS.size
            tags += (PROOF_FIELDS.unpack_from(payload, at + i * PROOF_FIELDS.size) for i in range(proofs))
    except struct.error as error:
        raise MalformedError(f"truncated introduction: {error}") from None
    return Introduction(sender, certificate, tuple(ids), bool(flags & _WANTS), nonce, whereabouts, tuple(tags))
