"""One message of each type, as docs/reference/protocol.md shows them, and strategies that make any message."""

from __future__ import annotations

from hypothesis import strategies as st

from rass_mav.core.datum import TERMS, Datum, DatumId, Terms, make_datum
from rass_mav.core.messages import (
    BROADCAST,
    CHUNK_BYTES,
    DISTANT_BYTES,
    INLINE_BYTES,
    MAX_OTHERS,
    NOTE_PROOF_BYTES,
    OTHER_BITS,
    REPORT_BITS,
    Accept,
    Beacon,
    Chunk,
    Committed,
    CopyStatus,
    CopyStatusEntry,
    CopyStatuses,
    Data,
    DeletionEntry,
    DeletionReport,
    Distance,
    Handover,
    Message,
    Offer,
    Put,
    Query,
    Receipt,
    ReceiptEntry,
    Report,
    Sack,
    SequenceMark,
)
from rass_mav.core.news.statements import make_receipt, make_sequence_mark, note_crc
from rass_mav.core.routes.contacts import pack
from rass_mav.mavlink.telemetry import Position

#: The moment at which the samples are encoded and decoded, seconds.
NOW = 1000.0
FLYING = Position(45.0001, -72.9998, 0.0, NOW - 2.0, 3.0, -1.5)

HELLO = make_datum(DatumId(3, 0xCAFEBABE, 7), 0, NOW - 1.5, b"hello")._replace(hops=2)
WORLD = make_datum(DatumId(4, 0x12345678, 0), 1, NOW - 60.0, b"world!")
#: As tests/trust/test_words.py has it.
SEALED_READING = make_datum(
    DatumId(7, 0xCAFEBABE, 5), 0x81, NOW - 1.5, bytes.fromhex("226deaa0c41d07a9ab9b9fa6e1992b7aa18d7f9d88d45824cf63")
)
#: Nine is the most urgent priority; after 3600 s nobody needs it.
URGENT_HELLO = make_datum(HELLO.id, TERMS, HELLO.created, Terms(9, 3600).pack() + b"hello")._replace(hops=2)
#: As tests/trust/test_words.py has it; for a day.
SEALED_TERMS = make_datum(
    DatumId(7, 0xCAFEBABE, 5), 0x81 | TERMS, NOW - 1.5,
    Terms(ttl_s=86400).pack() + bytes.fromhex("226deaa0c41d07a9ab9b26af3b7396515a404c5c8a9b6f434457"),
)  # fmt: skip
#: Its holder was switched off for it does not know how long.
OLD_HELLO = HELLO._replace(at_least=True)

AGAIN = Beacon(3, 0xCAFEBABE, 515, 0, 1, 0x0BADF00D, 42, 2, 0, 0, 16384, 49, 0xBEEF, 1 << 23, 0)

SAMPLES: dict[str, Message] = {
    "beacon-drone": Beacon(3, 0xCAFEBABE, 513, 0, 1, 0x0BADF00D, 42, 2, 0, 0, 16384, 49, 0xBEEF, 1 << 23, 0),
    "beacon-base": Beacon(1, 0x0BADF00D, 9, 1, 1, 0x0BADF00D, 42, 0, 0, 0, 0, 65535, 0xBEEF, 0xFFFFFFFF, 0),
    "beacon-request": Beacon(5, 0x00C0FFEE, 1, 2, 0, 0, 0, 255, 1, 43, 65535, 0, 0xBEEF, 0, 0),
    "beacon-slow": Beacon(3, 0xCAFEBABE, 514, 0, 1, 0x0BADF00D, 42, 2, 0, 0, 16384, 49, 0xBEEF, 1 << 23, 0, 90),
    "beacon-moving": AGAIN._replace(moves=pack(FLYING, NOW)),
    "beacon-proof": AGAIN._replace(number=516, moves=pack(FLYING, NOW), proof=bytes(range(0xA0, 0xA8))),
    "beacon-key": AGAIN._replace(
        number=517,
        moves=pack(FLYING, NOW),
        proof=bytes(range(0xA0, 0xA8)),
        key=bytes(range(0xB0, 0xB8)),
    ),
    "beacon-updates": AGAIN._replace(number=518, moves=pack(FLYING, NOW), updates=0x0006118A),
    "beacon-answers": AGAIN._replace(
        answers=(Committed(3, 2, ((0x01020304, HELLO.crc),), ()), Committed(3, 9, ((0x01020305, WORLD.crc),), ()))
    ),
    "data": Data(3, 2, (Handover(0x01020304, HELLO),)),
    "data-two": Data(3, 2, (Handover(0x01020304, HELLO), Handover(0, WORLD))),
    "data-sealed": Data(7, 2, (Handover(0x01020304, SEALED_READING),)),
    "data-terms": Data(3, 2, (Handover(0x01020304, URGENT_HELLO),)),
    "data-sealed-terms": Data(7, 2, (Handover(0x01020304, SEALED_TERMS),)),
    "data-at-least": Data(3, 2, (Handover(0x01020304, OLD_HELLO),)),
    "offer": Offer(3, 2, 0x01020305, DatumId(3, 0xCAFEBABE, 8), 2, NOW - 2.0, 0, 0xDEADBEEF, 100000, 123),
    "accept": Accept(2, 3, 0x01020305, 0xA1B2, 10),
    "accept-resumed": Accept(2, 3, 0x01020305, 0xA1B2, 10, 0b101),
    "chunk": Chunk(BROADCAST, 0xA1B2, 10, False, b"chunk"),
    "chunk-poll": Chunk(BROADCAST, 0xA1B2, 11, True, b"chunk"),
    "chunk-question": Chunk(BROADCAST, 0xA1B2, 515, True, b""),
    "sack": Sack(2, 3, 0xA1B2, 10, 0b101),
    "sack-further": Sack(2, 3, 0xA1B2, 10, 0b101, 515, (Report(0xC3D4, 266, 0), Report(0xE5F6, 0, 0b11))),
    "committed": Committed(2, 3, ((0x01020304, HELLO.crc),), (0x01020305,)),
    "committed-refused": Committed(2, 3, (), (0x01020305,)),
    "receipt": make_receipt(1, 0x0BADF00D, 513, [ReceiptEntry(3, 0xCAFEBABE, 0, 7, 0b100, False)]),
    "receipt-lost": make_receipt(
        1,
        0x0BADF00D,
        514,
        [ReceiptEntry(4, 0x12345678, 300, 70, 0, False), ReceiptEntry(3, 0xCAFEBABE, 9, 1, 0, True)],
    ),
    "deletion-report": DeletionReport(
        3, 2, (DeletionEntry(0x01020306, DatumId(3, 0xCAFEBABE, 9), 1, note_crc(DatumId(3, 0xCAFEBABE, 9), 1)),)
    ),
    "deletion-report-proven": DeletionReport(
        3,
        2,
        (
            DeletionEntry(
                0x01020306,
                DatumId(3, 0xCAFEBABE, 9),
                1,
                note_crc(DatumId(3, 0xCAFEBABE, 9), 1),
                bytes.fromhex("03008084bff17b1ac6de"),
            ),
        ),
    ),
    "sequence-mark": make_sequence_mark(3, 0xCAFEBABE, 11),
    "put": Put(3, 2, 4, HELLO),
    "query": Query(3, 2, (HELLO.id, WORLD.id)),
    "data-replica": Data(3, 2, (Handover(0x01020307, HELLO),), True),
    "data-distant": Data(3, 2, (Handover(0x01020308, HELLO),), True, Distance(4, 5, 2)),
    "copy-statuses-enclosed": CopyStatuses(2, 3, (CopyStatusEntry(HELLO.id, CopyStatus.ENCLOSED),)),
    "copy-statuses": CopyStatuses(
        2, 3, (CopyStatusEntry(HELLO.id, CopyStatus.AGAIN), CopyStatusEntry(WORLD.id, CopyStatus.NONE))
    ),
    "copy-statuses-passed-on": CopyStatuses(2, 3, (CopyStatusEntry(HELLO.id, CopyStatus.PASSED_ON),)),
    "copy-statuses-taken": CopyStatuses(2, 3, (CopyStatusEntry(HELLO.id, CopyStatus.TAKEN),)),
}

u8, u15, u16, u32 = (st.integers(0, (1 << bits) - 1) for bits in (8, 15, 16, 32))
node_ids = st.integers(0, 0xFFFE)
ids = st.builds(DatumId, u16, u32, u32)
#: Ages travel in milliseconds: these moments survive the journey.
moments = st.integers(0, 1_000_000).map(lambda ms: NOW - ms / 1000.0)


def data(largest: int) -> st.SearchStrategy[Datum]:
    return st.builds(Datum, ids, u8, moments, u8, u32, st.binary(min_size=1, max_size=largest), st.booleans())


#: All numbers have 32 bits; a run does not reach into its bitmap.
receipt_entries = st.builds(
    lambda origin, epoch, first, run, bits, lost: ReceiptEntry(
        origin, epoch, first, max(1, min(run, (1 << 32) - first - 128)), bits << 1, lost
    ),
    u16, u32, st.integers(0, (1 << 32) - 129), u32, st.integers(0, (1 << 127) - 1), st.booleans(),
)  # fmt: skip
handovers = st.builds(Handover, u32, data(INLINE_BYTES))


def answers(most: int, numbers: int) -> st.SearchStrategy[tuple[tuple[int, list[tuple[int, int]], list[int]], ...]]:
    """Up to `most` answers that tell something: targets, committed, refused; of `numbers` at most."""
    done = st.lists(st.tuples(u32, u32), max_size=numbers)
    told = st.tuples(u16, done, st.lists(u32, max_size=numbers))
    return st.lists(told.filter(lambda answer: bool(answer[1] or answer[2])), max_size=most).map(tuple)


def _with_answers(message: Beacon, told: tuple[tuple[int, list[tuple[int, int]], list[int]], ...]) -> Message:
    """They are answers of the message's sender."""
    return message._replace(answers=tuple([Committed(message.sender, to, tuple(a), tuple(b)) for to, a, b in told]))


elements = st.sampled_from([b"", bytes(8), b"\xff" * 8]) | st.binary(min_size=8, max_size=8)
by_type: dict[type, st.SearchStrategy[Message]] = {
    Beacon: st.builds(
        _with_answers,
        st.builds(
            Beacon,
            node_ids,
            u32,
            u16,
            u8,
            u16,
            u32,
            u16,
            u8,
            u16,
            u16,
            u16,
            u16,
            u16,
            u32,
            u32,
            u16,
            st.just(()),
            st.integers(0, (1 << 64) - 1),
            elements,
            elements,
            u32,
        ),
        # So many fit.
        answers(2, 1),
    ),
    Data: st.one_of(
        st.builds(Data, u16, u16, st.lists(handovers, max_size=12).map(tuple), st.booleans(), st.none()),
        st.builds(
            Data,
            u16,
            u16,
            st.lists(st.builds(Handover, u32, data(INLINE_BYTES - DISTANT_BYTES)), max_size=12).map(tuple),
            st.just(True),
            st.builds(Distance, u16, u16, u8),
        ),
    ),
    Offer: st.builds(
        Offer,
        u16,
        u16,
        u32,
        ids,
        u8,
        moments,
        u8,
        u32,
        st.integers(1, 0xFFFFFFFF),
        st.integers(1, CHUNK_BYTES),
        st.booleans(),
    ),
    Accept: st.builds(Accept, u16, u16, u32, u16, u16, st.integers(0, (1 << REPORT_BITS) - 1)),
    Chunk: st.builds(Chunk, st.just(BROADCAST), u16, u15, st.booleans(), st.binary(max_size=CHUNK_BYTES)),
    Sack: st.builds(
        Sack,
        u16,
        u16,
        u16,
        u16,
        st.integers(0, (1 << REPORT_BITS) - 1),
        u16,
        st.lists(st.builds(Report, u16, u16, st.integers(0, (1 << OTHER_BITS) - 1)), max_size=MAX_OTHERS).map(tuple),
    ),
    Committed: st.builds(
        Committed,
        u16,
        u16,
        st.lists(st.tuples(u32, u32), max_size=40).map(tuple),
        st.lists(u32, max_size=60).map(tuple),
    ),
    Receipt: st.builds(make_receipt, u16, u32, u32, st.lists(receipt_entries, max_size=3)),
    DeletionReport: st.sampled_from([b"", bytes(range(NOTE_PROOF_BYTES))]).flatmap(
        lambda proof: st.builds(
            DeletionReport,
            u16,
            u16,
            st.lists(st.builds(DeletionEntry, u32, ids, u8, u32, st.just(proof)), max_size=20).map(tuple),
        )
    ),
    SequenceMark: st.builds(make_sequence_mark, u16, u32, u32),
    Put: st.builds(Put, u16, u16, u16, data(100)),
    Query: st.builds(Query, node_ids, u16, st.lists(ids, max_size=12).map(tuple)),
    CopyStatuses: st.builds(
        CopyStatuses, u16, u16, st.lists(st.builds(CopyStatusEntry, ids, u8), max_size=30).map(tuple)
    ),
}
any_message = st.one_of(*by_type.values())
