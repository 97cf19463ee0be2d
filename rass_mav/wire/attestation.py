"""The ground's word about statements and routes, and how a node asks for it (docs/reference/protocol-keys.md).

These are no messages of core: they show that what core is told comes from a base. They are relayed byte for byte.
"""

from __future__ import annotations

import struct
from typing import NamedTuple

from rass_mav.errors import MalformedError

from .codec import MORE_HEAD
from .generated_keyed import (
    ANCHOR,
    ASK,
    STATEMENT_SIGNATURE,
    decode_anchor,
    decode_ask,
    decode_statement_signature,
    encode_anchor,
    encode_ask,
    encode_statement_signature,
)  # fmt: skip
from .keyed_records import (
    HASH_BYTES,
    MAX_BASES_ASKED,
    MAX_STATEMENTS_ASKED,
    MAX_VOUCHED,
    Anchor,
    Ask,
    StatementSignature,
)

__all__ = [
    "ANCHOR", "ASK", "HASH_BYTES", "MAX_BASES_ASKED", "MAX_STATEMENTS_ASKED", "MAX_VOUCHED", "STATEMENT_SIGNATURE",
    "Anchor", "Ask", "Signed", "StatementSignature", "body_of", "decode_attestation", "encode_ask", "is_attestation",
]  # fmt: skip

#: Bytes of a signature (Ed25519).
_SIGNATURE_BYTES = 64
_HEADS = frozenset(MORE_HEAD + bytes([type_]) for type_ in (STATEMENT_SIGNATURE, ANCHOR, ASK))


class Signed(NamedTuple):
    """What the ground has signed, as it travels."""

    kind: int
    """`STATEMENT_SIGNATURE` or `ANCHOR`."""
    content: StatementSignature | Anchor
    body: bytes
    """What is signed: all that comes before the signature."""
    signature: bytes
    """64 bytes; nobody has verified it yet."""

    @property
    def payload(self) -> bytes:
        """The TUNNEL payload."""
        return self.body + self.signature


def is_attestation(payload: bytes) -> bool:
    """Whether a TUNNEL payload begins like one of these, in this version."""
    return payload[:2] in _HEADS


def body_of(content: StatementSignature | Anchor) -> bytes:
    """What the ground signs. ValueError or struct.error: out of bounds, which is our bug."""
    return encode_anchor(content) if isinstance(content, Anchor) else encode_statement_signature(content)


def decode_attestation(payload: bytes) -> Signed | Ask:
    """What is in a TUNNEL payload for which `is_attestation`; no signature is verified. Raises `MalformedError`, and
    nothing else."""
    content: StatementSignature | Anchor
    try:
        if payload[1] == ASK:
            return decode_ask(payload)
        content, size = decode_anchor(payload) if payload[1] == ANCHOR else decode_statement_signature(payload)
    except struct.error as error:
        raise MalformedError(f"truncated: {error}") from None
    signature = payload[size : size + _SIGNATURE_BYTES]
    if len(signature) != _SIGNATURE_BYTES:
        raise MalformedError("truncated signature")
    return Signed(payload[1], content, payload[:size], signature)
