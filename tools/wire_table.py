"""All messages as one table: what stands in a TUNNEL payload, byte for byte.

`tools/generate_wire.py` writes from it: the functions in `generated.py` and the packers of `core/news/layouts.py`, the
layouts in docs/reference/protocol.md, and those of tools/rass.lua. No node loads it. What is no plain field has a
*hook*: a
function that is written by hand, which the generated one calls.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TypeAlias

from rass_mav.core import messages as core
from rass_mav.core.datum import Datum, DatumId
from rass_mav.wire import keyed_records as keyed

#: Major version of the format, the high four bits of the first byte.
VERSION = 4
#: After a head of this type, the second byte is the type, from 16 on.
MORE = 15


@dataclass(frozen=True)
class Field:
    """A number, little-endian, or bytes."""

    name: str
    """In the record."""
    type: str
    """u8, u16, u32, u64, the same with x if it is shown in hex, or `N bytes`."""
    about: str = ""
    """In docs/reference/protocol.md, and in Wireshark if it is short."""
    title: str = ""
    """There; empty: the name, in words."""
    key: str = ""
    """In Wireshark, after `rass.`; empty: the name."""
    least: int = 0
    most: int | None = None
    """Others are malformed."""
    flags: tuple[tuple[str, int], ...] = ()
    """Its bits that have names of their own."""
    counts: str = ""
    """The name of the rows, or of the bytes, whose number it is."""
    crc: bool = False
    """It is the CRC-32 of all other bytes but head and type."""


@dataclass(frozen=True)
class Age:
    """Milliseconds, and the highest bit for "at least". In the record they are `created` and `at_least`."""


@dataclass(frozen=True)
class Record:
    """A record within the record."""

    name: str
    record: type
    parts: tuple[Part, ...]
    about: str = ""


@dataclass(frozen=True)
class Bytes:
    """So many bytes as a field before it says, at least one; or those up to the end."""

    name: str
    about: str = ""
    to_the_end: bool = False
    key: str = ""
    hook: str = ""
    """What else reads them in rass.lua."""


@dataclass(frozen=True)
class Bitmap:
    """A byte with its size, and a number without the zeros at its end."""

    name: str
    bits: int
    about: str = ""


@dataclass(frozen=True)
class Rows:
    """Parts that come as often as a field before them says."""

    name: str
    title: str
    parts: tuple[Part, ...]
    record: type | None = None
    """None: a tuple, or if there is one field, its value."""
    most: int | None = None
    about: str = ""
    optional: Field | None = None
    """With the flag of the count, each row ends with this field."""
    hook: str = ""
    """The name of functions that write and read one row: `hook_bytes(row)`, and `read_hook(p, at)`."""


@dataclass(frozen=True)
class When:
    """Parts that are there if a field or a flag is not 0; or `unless` it is."""

    name: str
    about: str
    """In docs/reference/protocol.md."""
    parts: tuple[Part, ...]
    unless: bool = False


@dataclass(frozen=True)
class Blocks:
    """From here to the end there may be blocks."""


@dataclass(frozen=True)
class Packed:
    """What only a hook reads and writes; in rass.lua too, under this name."""

    name: str
    about: str


Part: TypeAlias = Field | Age | Record | Bytes | Bitmap | Rows | Blocks | Packed | When


@dataclass(frozen=True)
class Layout:
    """A kind of message."""

    number: int
    """Its type: the low four bits of the first byte; from 16 on the second byte, after a first one of type 15."""
    record: type
    """Only its name counts if functions by hand write and read it."""
    parts: tuple[Part, ...]
    by_hand: str = ""
    """Why functions in codec.py write and read it, with the structs from here."""
    frames: bool = False
    """It fills as many frames as its rows need."""
    tagged: bool = False
    """Its frames end with a place and a tag, where there are keys."""
    not_sent: Mapping[str, str] = field(default_factory=dict)
    """Fields of the record that do not travel, and what a reader puts there."""

    @property
    def title(self) -> str:
        """As on the page."""
        return in_words(self.record.__name__)


@dataclass(frozen=True)
class Block:
    """What may follow the fields of a beacon, or the hand-overs of data, behind its kind and its size. A reader ignores
    blocks of kinds that it does not know."""

    kind: int
    name: str
    title: str
    parts: tuple[Part, ...]
    again: bool = False
    """The parts come again and again, up to its end."""


def in_words(name: str) -> str:
    """`DeletionReport` and `deletion_report` as `Deletion report`."""
    return "".join(" " + c.lower() if c.isupper() else " " if c == "_" else c for c in name).strip().capitalize()


# -- what several have -------------------------------------------------------------------------------------------------

SENDER, TARGET = Field("sender", "u16"), Field("target", "u16")
TO = (SENDER, TARGET)
NUMBER = Field("number", "x32", title="hand-over number")
ORIGIN, EPOCH = Field("origin", "u16"), Field("epoch", "x32")
ID = Record("id", DatumId, (ORIGIN, EPOCH, Field("sequence", "u32")))
CRC, KIND, COUNT = Field("crc", "x32", title="CRC"), Field("kind", "u8"), Field("count", "u8")
HOPS = Field("hops", "u8", "hand-overs so far; the receiver adds one", key="datum_hops")
HANDLE = Field("handle", "x16")
NEXT_INDEX = Field("next_index", "u16", "all chunks below have arrived")
CHUNKS = Bitmap("bitmap", core.REPORT_BITS, "bit i: chunk next index + 1 + i has come")
BASE, BASE_LIFE, SERIAL = Field("base", "u16"), Field("base_life", "x32"), Field("serial", "u32")
WITH_KEYS = Packed("place_and_tag", "only [with keys](protocol-keys.md#tags-between-two-nodes)")


def datum(most: int, about: str = "") -> Record:
    """A datum with its payload."""
    size = Field("size", "u8", f"1..{most}", counts="payload")
    return Record("datum", Datum, (ID, Age(), HOPS, KIND, CRC, size, Bytes("payload", about, hook="datum_payload")))


def count(rows: str, about: str) -> Field:
    """The number of rows that follow."""
    return replace(COUNT, about=about, counts=rows)


ANSWER = (
    Field("committed", "u8", "number of pairs"),
    Field("refused", "u8", "number of numbers"),
    Rows("committed", "Pair", (NUMBER, CRC)),
    Rows("refused", "Refused", (replace(NUMBER, key="refused_number"),), about="together at most 109 bytes"),
)

BLOCKS = (
    Block(
        1,
        "answers",
        "answers",
        (replace(TARGET, about="it need not be the target of the message"), *ANSWER),
        again=True,
    ),
    Block(
        2,
        "distance",
        "a distant replica",
        (
            Field("near", "u16", "the node that the sender keeps its replica for"),
            Field("custodian", "u16", "the node with custody"),
            Field("further", "u8", "how many more nodes should have a copy"),
        ),
    ),
    Block(3, "motion", "motion", (Field("moves", "x64", title="motion"),)),
    Block(4, "proof", "proof of the route", (Field("proof", "8 bytes", "element of the hash chain"),)),
    Block(5, "tags", "tags of the answers", (Packed("tags", "8 bytes for each answer"),)),
    Block(6, "key", "key of the beacon", (Field("key", "8 bytes", "of the beacon"),)),
    Block(7, "updates", "key updates", (Field("updates", "x32", title="key updates"),)),
)

# -- messages between nodes --------------------------------------------------------------------------------------------

_FLAGS = "bit 0: sender is a base; bit 1: the two `wanted` fields hold a request"
_BEACON = (
    replace(SENDER, about="0..65534"),
    Field("life", "x32", "of the sender"),
    Field("number", "u16", "compared by RFC 1982; starts anywhere", title="beacon number", key="beacon"),
    Field("flags", "x8", _FLAGS, flags=(("flags.base", 1), ("flags.wanted", 2))),
    replace(BASE, about="of the route; 0: none"),
    BASE_LIFE,
    Field("route_number", "u16", title="announcement number"),
    Field("hops", "u8", "sender to base, 0..254; 255: no route"),
    Field("wanted_base", "u16"),
    Field("wanted_number", "u16"),
    Field("risk", "u16", "0..65535 for 0..1"),
    Field("free", "u16", "data that can come into custody, replicas counted as free; 65535: no bound"),
    Field("policy", "x16", "potentials of different tags cannot be compared", title="policy tag"),
    Field("potential", "u32", "2^24 is fitness 1; 4294967295: a base; 0: no room"),
    Field("statements_hash", "x32", "of what the sender knows from receipts; 0: do not compare"),
    Field(
        "crc",
        "x32",
        "CRC-32 of bytes 0 to 36, and then 41 to the end",
        "CRC",
        "beacon_crc",
    ),
    Field("turn", "u16", "tenths of a second between two beacons of the sender; 0: one step"),
    Blocks(),
)
_HANDOVERS = (
    *TO,
    Field(
        "count",
        "u8",
        "bits 0 to 6: hand-overs that follow; bit 7: [replicas](#rules-of-custody-with-replicas)",
        counts="handovers",
        flags=(("replica", 0x80),),
    ),
    Rows(
        "handovers",
        "Hand-over",
        (replace(NUMBER, about="0: no custody offered, no answer wanted"), datum(97)),
        core.Handover,
    ),
    Blocks(),
)
_OFFER = (
    *(*TO, NUMBER, ID, Age(), HOPS, KIND, CRC),
    Field("size", "u32", "bytes, 1..1048576; more is refused", least=1),
    Field("chunk_size", "u8", "1..123", least=1, most=123),
)
_ACCEPT = (
    *(*TO, replace(NUMBER, about="of the offer"), replace(HANDLE, about="chosen by the sender of this message")),
    *(replace(NEXT_INDEX, about="first chunk that is missing"), CHUNKS),
)
_INDEX = "low 15 bits: 0..16383; bit 15: the sender wants a sack now"
_CHUNK = (
    HANDLE,
    Field("position", "u16", _INDEX, title="index", flags=(("poll", 0x8000),)),
    Bytes("data", "to the end; all chunks but the last have the offered size", to_the_end=True),
)
_OTHERS = (HANDLE, NEXT_INDEX, replace(CHUNKS, bits=core.OTHER_BITS))
_SACK = (
    *(*TO, HANDLE, NEXT_INDEX, CHUNKS),
    Field("question", "u16", "number of the question that this answers; 0: it answers none"),
    count("others", f"further transfers between the two nodes, 0..{core.MAX_OTHERS}"),
    Rows("others", "Transfer", _OTHERS, core.Report, most=core.MAX_OTHERS),
)
_RECEIPT = (
    replace(BASE, about="the base that makes the statement"),
    BASE_LIFE,
    replace(SERIAL, about="raised with each statement; never used twice, even after a restart"),
    replace(CRC, about="CRC-32 of bytes 1 to 10 and of all from offset 15 on", crc=True),
    count("entries", "entries that follow"),
    Rows(
        "entries",
        "Entry",
        (ORIGIN, EPOCH, Packed("receipt_entry", "see below")),
        core.ReceiptEntry,
        hook="receipt_entry",
    ),
)
_LOSSES = (
    *TO,
    Field(
        "count",
        "u8",
        "bits 0 to 6: entries that follow; bit 7: each has its proof",
        counts="entries",
        flags=(("proven", 0x80),),
    ),
    Rows(
        "entries",
        "Loss",
        (NUMBER, ID, Field("reason", "u8", "see below"), replace(CRC, about="over id and reason")),
        core.DeletionEntry,
        optional=Field("proof", f"{core.NOTE_PROOF_BYTES} bytes", "only with bit 7 of the count", key="report_proof"),
    ),
)
_PUT = (
    *(SENDER, Field("lamport", "u16", "from 1", title="Lamport timestamp")),
    *(Field("writer", "u16", "node id of the last writer"), datum(100, "the value")),
)
_QUERY = (
    *(*TO, count("ids", f"keys that follow, at most {core.QUERY_IDS}")),
    Rows("ids", "Key", (ID,), most=core.QUERY_IDS, about="keys whose values the sender has lost"),
)
_STATUS = Field("status", "u8", "see below")
_STATUSES = (
    *(*TO, count("entries", "entries that follow, at most 10")),
    *(Rows("entries", "Datum", (ID, _STATUS), core.CopyStatusEntry), WITH_KEYS),
)
_MARK = (
    *(ORIGIN, replace(EPOCH, about="the origin's present one, of its data")),
    Field("assigned", "u32", "the origin has assigned the sequences below this one"),
    replace(CRC, about="CRC-32 of bytes 1 to 10", crc=True),
)

MESSAGES = (
    Layout(
        1,
        core.Beacon,
        _BEACON,
        by_hand="its checksum covers what is before and behind it; and most of what is heard is beacons",
    ),
    Layout(2, core.Data, _HANDOVERS, by_hand="it fills several frames, and blocks ride on the last one"),
    Layout(3, core.Offer, _OFFER),
    Layout(4, core.Accept, _ACCEPT),
    Layout(5, core.Chunk, _CHUNK, not_sent={"target": "BROADCAST"}),
    Layout(6, core.Sack, _SACK),
    Layout(
        7, core.Committed, (*TO, *ANSWER), by_hand="it stands in blocks too; of a content hash the checksum travels"
    ),
    Layout(8, core.Receipt, _RECEIPT, not_sent={"senders": "()"}),
    Layout(9, core.DeletionReport, _LOSSES, frames=True),
    Layout(10, core.Put, _PUT),
    Layout(11, core.Query, _QUERY),
    Layout(13, core.CopyStatuses, _STATUSES, frames=True, tagged=True),
    Layout(14, core.SequenceMark, _MARK),
)

# -- what nodes with keys say about links and keys, and what the ground has signed -------------------------------------

SIGNATURE = Field("signature", "64 bytes", "by the ground, not checked")
NODE_ID, NODE_SERIAL = Field("node_id", "u16"), Field("serial", "u32", key="node_serial")
LINK_KEY = Field("number", "u32", "of the sender's link key", key="link_key")
_SHOWS, _WANTS = "introduction.flags.certificate", "introduction.flags.wanted"
_INTRODUCTION_FLAGS = "bit 0: a certificate follows; bit 1: those who are asked should send theirs"
_PROVES = (
    "node id, and tag over that node's nonce (u64), the sender's place, index, key and next end (28 bytes), and the "
    "stream of the frame (system id, component id, link id: 3 bytes), with type 254"
)
_INTRODUCTION = (
    replace(SENDER, about="0..65534"),
    Field("flags", "x8", _INTRODUCTION_FLAGS, key="introduction.flags", flags=((_SHOWS, 1), (_WANTS, 2))),
    Field("asked", "u8", "nodes that are asked, at most 8; beside a certificate 5", counts="nodes"),
    Field("proofs", "u8", "for other nodes, at most 6; beside a certificate none", counts="tags"),
    When(_SHOWS, "flags bit 0", (Packed("certificate", "the sender's own"),)),
    When("asked", "if `asked`", (Field("nonce", "x64"), Rows("nodes", "Node", (NODE_ID,)))),
    When(
        "proofs",
        "if `proofs`",
        (
            Field("place", "x64", "the sender's last one"),
            Field("index", "u32", "of the sender's last beacon", key="introduction.beacon"),
            Field("key", "8 bytes", "of that beacon"),
            Field("next_end", "8 bytes", "of the sender's next chain of keys", key="introduction.next_end"),
            Rows("tags", "Proof", (NODE_ID, Field("tag", "8 bytes")), about=_PROVES),
        ),
    ),
)
_STATEMENT_SIGNATURE = (
    *(BASE, BASE_LIFE),
    Field(
        "first",
        "u32",
        "serial of the first statement; the serials of the others follow without a gap",
        key="first_serial",
    ),
    Field("salt", "x32", "drawn at random by the base when it signs"),
    Field("count", "u8", f"1..{keyed.MAX_VOUCHED}", counts="hashes", least=1, most=keyed.MAX_VOUCHED),
    Rows("hashes", "Hash", (Field("hash", f"{keyed.HASH_BYTES} bytes"),), about="one for each statement"),
    replace(SIGNATURE, about="Ed25519, over `rass voucher`, 4 zero bytes, and everything before the signature"),
)
_CHAIN = "of the chain; never used twice, even after a restart: a base claims serials on disk"
_ANCHOR = (
    *(BASE, BASE_LIFE, replace(SERIAL, about=_CHAIN, key="chain")),
    Field("first", "u16", "the first announcement number of the chain", key="first_number"),
    Field("element", "8 bytes", title="anchor", key="anchor"),
    replace(SIGNATURE, about="Ed25519, over `rass anchor`, 5 zero bytes, and everything before the signature"),
)
_LACKS = "are lacking, at most"
_ASK = (
    Field("base_count", "u8", f"whose anchors {_LACKS} {keyed.MAX_BASES_ASKED}", "bases", "bases", counts="bases"),
    Field(
        *("statement_count", "u8", f"whose statement signatures {_LACKS} {keyed.MAX_STATEMENTS_ASKED}", "statements"),
        key="statements",
        counts="statements",
    ),
    Rows("bases", "Base", (BASE, BASE_LIFE), most=keyed.MAX_BASES_ASKED),
    Rows("statements", "Statement", (BASE, BASE_LIFE, SERIAL), most=keyed.MAX_STATEMENTS_ASKED),
)
_LETTER = "by the ground (Ed25519), over 16 bytes (`rass letter`, then zeros) and all from offset 2 to here"
_KEY_UPDATE = (
    Field("flags", "u8", "0: with a key; 1: revoked; others are malformed", key="update.flags", most=1),
    replace(LINK_KEY, about="of the link key, from 1; each change has the next one"),
    *(replace(NODE_ID, about="of the drone"), replace(NODE_SERIAL, about="of the drone")),
    When("flags", "flags 0", (Field("sealed_key", "48 bytes", "for the drone alone"),), unless=True),
    replace(SIGNATURE, about=_LETTER),
)
_OF_SENDER = replace(NODE_ID, about="of the sender"), replace(NODE_SERIAL, about="of the sender; 0: a base")


class Introduction:
    """In introduction.py."""


class KeyUpdate:
    """In trust/keys/key_updates.py."""


#: They are no messages of core, and only nodes with keys load the functions for them.
KEYED = (
    Layout(254, Introduction, _INTRODUCTION, by_hand="what is in it depends on its flags and numbers"),
    Layout(253, keyed.StatementSignature, _STATEMENT_SIGNATURE),
    Layout(252, keyed.Anchor, _ANCHOR),
    Layout(251, keyed.Ask, _ASK),
    Layout(249, KeyUpdate, _KEY_UPDATE, by_hand="what is in it is no matter of the wire"),
    Layout(248, keyed.KeyRequest, (*_OF_SENDER, LINK_KEY)),
)
