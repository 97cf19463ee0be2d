"""How nodes with keys write and read what is no message. From `table.py`, by tools/wire.py: do not edit."""

from struct import Struct

from rass_mav.errors import MalformedError
from rass_mav.wire.keyed_records import Anchor, Ask, KeySummary, StatementSignature

from .parts import fitting

# Types, in the second byte
INTRODUCTION = 254
STATEMENT_SIGNATURE = 253
ANCHOR = 252
ASK = 251
KEY_UPDATE = 249
KEY_SUMMARY = 248

ASKED_FIELDS = Struct("<Q")
NODE_FIELDS = Struct("<H")
PROOFS_FIELDS = Struct("<QI8s8s")
PROOF_FIELDS = Struct("<H8s")
INTRODUCTION_FIELDS = Struct("<BBHBBB")
STATEMENT_SIGNATURE_FIELDS = Struct("<BBHIIIB")
HASH_FIELDS = Struct("<8s")
ANCHOR_FIELDS = Struct("<BBHIIH8s")
ASK_FIELDS = Struct("<BBBB")
BASE_FIELDS = Struct("<HI")
STATEMENT_FIELDS = Struct("<HII")
KEY_UPDATE_FIELDS = Struct("<BBBIHI")
KEY_SUMMARY_FIELDS = Struct("<BBHIIIHHB")
ROW_FIELDS = Struct("<HB")


def encode_statement_signature(m: StatementSignature) -> bytes:
    """Statement signature but for its signature. ValueError or struct.error: our bug."""
    base, base_life, first, salt, hashes = m
    if not 1 <= len(hashes) <= 5:
        raise ValueError(f"{len(hashes)} hashes")
    return fitting(
        STATEMENT_SIGNATURE_FIELDS.pack(0x3F, 253, base, base_life, first, salt, len(hashes))
        + b"".join([HASH_FIELDS.pack(hash) for hash in hashes])
    )


def decode_statement_signature(p: bytes) -> tuple[StatementSignature, int]:
    """Statement signature, and where its signature begins. struct.error: it is cut off."""
    _, _, base, base_life, first, salt, count = STATEMENT_SIGNATURE_FIELDS.unpack_from(p)
    if not 1 <= count <= 5:
        raise MalformedError(f"count is {count}")
    hashes = [HASH_FIELDS.unpack_from(p, at)[0] for at in range(17, 17 + count * HASH_FIELDS.size, HASH_FIELDS.size)]
    at = 17 + count * HASH_FIELDS.size
    return StatementSignature(base, base_life, first, salt, tuple(hashes)), at


def encode_anchor(m: Anchor) -> bytes:
    """Anchor but for its signature. ValueError or struct.error: our bug."""
    base, base_life, serial, first, element = m
    return ANCHOR_FIELDS.pack(0x3F, 252, base, base_life, serial, first, element)


def decode_anchor(p: bytes) -> tuple[Anchor, int]:
    """Anchor, and where its signature begins. struct.error: it is cut off."""
    _, _, base, base_life, serial, first, element = ANCHOR_FIELDS.unpack_from(p)
    return Anchor(base, base_life, serial, first, element), 22


def encode_ask(m: Ask) -> bytes:
    """Ask. ValueError or struct.error: our bug."""
    bases, statements = m
    if len(bases) > 4:
        raise ValueError(f"{len(bases)} bases")
    if len(statements) > 9:
        raise ValueError(f"{len(statements)} statements")
    return fitting(
        ASK_FIELDS.pack(0x3F, 251, len(bases), len(statements))
        + b"".join([BASE_FIELDS.pack(base, base_life) for base, base_life in bases])
        + b"".join([STATEMENT_FIELDS.pack(base, base_life, serial) for base, base_life, serial in statements])
    )


def decode_ask(p: bytes) -> Ask:
    """Ask. struct.error: it is cut off."""
    _, _, base_count, statement_count = ASK_FIELDS.unpack_from(p)
    if base_count > 4:
        raise MalformedError(f"{base_count} bases")
    bases = [BASE_FIELDS.unpack_from(p, at) for at in range(4, 4 + base_count * BASE_FIELDS.size, BASE_FIELDS.size)]
    at = 4 + base_count * BASE_FIELDS.size
    if statement_count > 9:
        raise MalformedError(f"{statement_count} statements")
    statements = [
        STATEMENT_FIELDS.unpack_from(p, at)
        for at in range(at, at + statement_count * STATEMENT_FIELDS.size, STATEMENT_FIELDS.size)
    ]
    return Ask(tuple(bases), tuple(statements))


def encode_key_summary(m: KeySummary) -> bytes:
    """Key summary. ValueError or struct.error: our bug."""
    node_id, serial, number, updates_hash, first, last, named = m
    if len(named) > 35:
        raise ValueError(f"{len(named)} named")
    return fitting(
        KEY_SUMMARY_FIELDS.pack(0x3F, 248, node_id, serial, number, updates_hash, first, last, len(named))
        + b"".join([ROW_FIELDS.pack(node_id, mark) for node_id, mark in named.items()])
    )


def decode_key_summary(p: bytes) -> KeySummary:
    """Key summary. struct.error: it is cut off."""
    _, _, node_id, serial, number, updates_hash, first, last, count = KEY_SUMMARY_FIELDS.unpack_from(p)
    if count > 35:
        raise MalformedError(f"{count} named")
    named = [ROW_FIELDS.unpack_from(p, at) for at in range(21, 21 + count * ROW_FIELDS.size, ROW_FIELDS.size)]
    return KeySummary(node_id, serial, number, updates_hash, first, last, dict(named))
