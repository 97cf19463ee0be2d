"""The ground's word about statements and routes, and how a node asks for it (docs/protocol.md).

These are no messages of core: they show that what core is told comes from a base. They are relayed byte for byte.
"""

from __future__ import annotations

import struct
from typing import NamedTuple

from rass_mav.errors import MalformedError

from .codec import MORE, PROOF_BYTES, VERSION

#: The types, in the second byte.
STATEMENT_SIGNATURE, ANCHOR, ASK = 253, 252, 251
#: Statements that one statement signature is about, at most: so it fits one TUNNEL.
MAX_VOUCHED = 5
#: Bases, and statements, that one `Ask` names.
MAX_BASES_ASKED, MAX_STATEMENTS_ASKED = 4, 9
#: Bytes of a statement's hash in a statement signature.
HASH_BYTES = 8
#: Bytes of a signature (Ed25519).
_SIGNATURE_BYTES = 64

_MORE = VERSION << 4 | MORE
_TYPES = frozenset((STATEMENT_SIGNATURE, ANCHOR, ASK))
_STATEMENT_SIGNATURE = struct.Struct("<BBHIIIB")
_ANCHOR = struct.Struct(f"<BBHIIH{PROOF_BYTES}s")
_COUNTS = struct.Struct("<BBBB")
_BASE = struct.Struct("<HI")
_STATEMENT = struct.Struct("<HII")


class StatementSignature(NamedTuple):
    """The ground has made these statements: those of one base with serials that follow each other."""

    base: int
    base_life: int
    first: int
    """Serial of the first one, 32 bits."""
    salt: int
    """Of the hashes, 32 bits: nobody knew it before the statements were made."""
    hashes: tuple[bytes, ...]
    """Of each statement, 8 bytes; 1 to `MAX_VOUCHED`."""


class Anchor(NamedTuple):
    """The end of a hash chain for the announcements of one base."""

    base: int
    base_life: int
    serial: int
    """Of the chain, 32 bits: a later one has a higher serial."""
    first: int
    """The first announcement number, 16 bits."""
    element: bytes
    """The end of the chain, 8 bytes."""


class Ask(NamedTuple):
    """A node lacks the ground's word."""

    bases: tuple[tuple[int, int], ...] = ()
    """Bases (node id, life) whose anchors it lacks, at most `MAX_BASES_ASKED`."""
    statements: tuple[tuple[int, int, int], ...] = ()
    """Statements (base, life, serial) whose statement signatures it lacks, at most `MAX_STATEMENTS_ASKED`."""


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
    return len(payload) > 1 and payload[0] == _MORE and payload[1] in _TYPES


def body_of(content: StatementSignature | Anchor) -> bytes:
    """What the ground signs. ValueError or struct.error: out of bounds, which is our bug."""
    if isinstance(content, Anchor):
        return _ANCHOR.pack(_MORE, ANCHOR, *content)
    base, life, first, salt, hashes = content
    if not 0 < len(hashes) <= MAX_VOUCHED:
        raise ValueError(f"a statement signature for {len(hashes)} statements")
    return _STATEMENT_SIGNATURE.pack(_MORE, STATEMENT_SIGNATURE, base, life, first, salt, len(hashes)) + b"".join(
        hashes
    )


def encode_ask(ask: Ask) -> bytes:
    """The TUNNEL payload. ValueError or struct.error: out of bounds, which is our bug."""
    if len(ask.bases) > MAX_BASES_ASKED or len(ask.statements) > MAX_STATEMENTS_ASKED:
        raise ValueError("too much for one frame")
    parts = [_COUNTS.pack(_MORE, ASK, len(ask.bases), len(ask.statements))]
    parts += (_BASE.pack(*base) for base in ask.bases)
    parts += (_STATEMENT.pack(*statement) for statement in ask.statements)
    return b"".join(parts)


def decode_attestation(payload: bytes) -> Signed | Ask:
    """What is in a TUNNEL payload for which `is_attestation`; no signature is verified. Raises `MalformedError`, and
    nothing else."""
    try:
        if payload[1] == ASK:
            return _decode_ask(payload)
        if payload[1] == ANCHOR:
            size = _ANCHOR.size
            content: StatementSignature | Anchor = Anchor._make(_ANCHOR.unpack_from(payload)[2:])
        else:
            base, life, first, salt, count = _STATEMENT_SIGNATURE.unpack_from(payload)[2:]
            if not 0 < count <= MAX_VOUCHED:
                raise MalformedError(f"a statement signature for {count} statements")
            size = _STATEMENT_SIGNATURE.size + count * HASH_BYTES
            hashes = (payload[at : at + HASH_BYTES] for at in range(_STATEMENT_SIGNATURE.size, size, HASH_BYTES))
            content = StatementSignature(base, life, first, salt, tuple(hashes))
    except struct.error as error:
        raise MalformedError(f"truncated: {error}") from None
    signature = payload[size : size + _SIGNATURE_BYTES]
    if len(signature) != _SIGNATURE_BYTES:
        raise MalformedError("a signature that is cut off")
    return Signed(payload[1], content, payload[:size], signature)


def _decode_ask(payload: bytes) -> Ask:
    _, _, bases, statements = _COUNTS.unpack_from(payload)
    if bases > MAX_BASES_ASKED or statements > MAX_STATEMENTS_ASKED:
        raise MalformedError(f"{bases} bases and {statements} statements are asked for")
    at = _COUNTS.size
    end = at + bases * _BASE.size
    return Ask(
        tuple([_BASE.unpack_from(payload, at + i * _BASE.size) for i in range(bases)]),
        tuple([_STATEMENT.unpack_from(payload, end + i * _STATEMENT.size) for i in range(statements)]),
    )
