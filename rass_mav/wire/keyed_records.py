"""What the ground signs, how a node asks for it, and what nodes say about their link keys
(docs/reference/protocol-keys.md).

These are no messages of core: no participant sees them.
"""

from __future__ import annotations

from typing import NamedTuple

#: Statements that one statement signature is about, at most: so it fits one TUNNEL.
MAX_VOUCHED = 5
#: Bases, and statements, that one `Ask` names.
MAX_BASES_ASKED, MAX_STATEMENTS_ASKED = 4, 9
#: Bytes of a statement's hash in a statement signature.
HASH_BYTES = 8


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


class KeyRequest(NamedTuple):
    """A node that hears frames with another link key says which one it has."""

    node_id: int
    """The sender, 0..65534."""
    serial: int
    """Its serial, 32 bits. 0: a base."""
    number: int
    """Of its link key, 32 bits. Who has a key update of a higher number for the sender sends it."""
