"""Messages that a liar says: one that was said, with fields changed, or an invented one. Checksums are right.

Noise dies at the checksums of beacons, receipts, deletion reports and data; what is behind them only a liar reaches.
Names and numbers come from small pools of what is in use, so that lies meet what they are about.
"""

from __future__ import annotations

from typing import Any

from rass_mav.core.datum import Datum, DatumId, make_datum
from rass_mav.core.messages import (
    Accept,
    Beacon,
    Committed,
    CopyStatusEntry,
    CopyStatuses,
    Data,
    DeletionEntry,
    DeletionReport,
    Handover,
    Message,
    Offer,
    Put,
    Query,
    Receipt,
    ReceiptEntry,
    Sack,
    SequenceMark,
)
from rass_mav.core.news.statements import make_receipt, make_sequence_mark, note_crc
from rass_mav.core.participant import Participant

from .source import Source

#: In whose name lies are told: those who are there, and two who are not.
NAMES = (0, 1, 2, 3, 9)
#: Numbers at which something may break.
EDGES = (0, 1, 2, 0x7F, 0xFF, 0x7FFF, 0xFFFE, 0xFFFF, 0x7FFFFFFF, 0xFFFFFFFF)


def sealed(message: Message) -> Message:
    """The same message with right checksums."""
    if isinstance(message, Receipt):
        return make_receipt(*message[:3], message.entries)
    if isinstance(message, SequenceMark):
        return make_sequence_mark(*message[:3])
    if isinstance(message, DeletionReport):
        return message._replace(entries=tuple([e._replace(crc=note_crc(e.id, e.reason)) for e in message.entries]))
    return message


def changed(value: Any, source: Source) -> Any:
    """A field, or a field of a field, becomes another. ValueError, struct.error on encoding: nobody can say that."""
    if isinstance(value, bool):
        return not value
    if isinstance(value, int):
        how = source.byte() % 4
        return (value + 1, value - 1, source.pick(EDGES), value ^ 1 << source.byte() % 32)[how]
    if isinstance(value, float):
        return value - source.byte()
    if isinstance(value, bytes):
        return value[: source.byte()] + source.some(source.byte() % 8)
    if not isinstance(value, tuple) or not value:
        return value
    at = source.byte() % (len(value) + 1)
    if at == len(value):
        # Twice as long, or half; what has a name for each field stays as it is.
        longer = value + value if source.byte() % 2 else value[: len(value) // 2]
        return value if hasattr(value, "_fields") else longer
    parts = [changed(part, source) if i == at else part for i, part in enumerate(value)]
    if isinstance(value, Datum) and at != Datum._fields.index("crc"):
        id, kind, created, _, _, payload, _ = parts
        fits = make_datum(id, kind & 0xFF, created, payload)
        return Datum(*parts)._replace(crc=fits.crc)
    return value._make(parts) if hasattr(value, "_make") else tuple(parts)


class Liar:
    """Invents messages for one node."""

    def __init__(self, source: Source, victim: Participant, known: list[Datum], now: float) -> None:
        """`known`: data that exist somewhere."""
        self._source = source
        self._victim = victim
        self._known = known
        self._now = now

    def message(self) -> Message:
        """Any kind but chunks, whose handles nobody can guess."""
        return self._source.pick(_INVENTED)(self)

    def _name(self) -> int:
        return self._source.pick(NAMES)

    def _some(self) -> range:
        return range(self._source.byte() % 3 + 1)

    def _number(self) -> int:
        return self._source.pick([*(key for key in self._victim.exchange.open if isinstance(key, int)), 0, 1, 2])

    def _life(self) -> int:
        return 0x1000 + self._source.byte() % 4

    def _id(self) -> DatumId:
        how = self._source.byte()
        if how % 4 == 0 and self._known:
            return self._source.pick(self._known).id
        if how % 4 == 1:
            # A number that the victim has yet to give.
            store = self._victim.store
            return DatumId(self._victim.id, store.epoch, store.assigned + how // 4 % 3)
        return DatumId(self._name(), self._life(), how // 4 % 8)

    def _datum(self) -> Datum:
        if self._known and self._source.byte() % 2:
            return self._source.pick(self._known)
        created = self._now - self._source.byte()
        return make_datum(self._id(), self._source.byte() % 4, created, bytes(self._source.byte() % 97 + 1))

    def _beacon(self) -> Message:
        flags, hops, number = self._source.byte() % 4, self._source.byte(), self._source.byte()
        return Beacon(
            self._name(), self._life(), number << self._source.byte() % 9, flags, self._name(), self._life(),
            self._source.pick(EDGES) & 0xFFFF, hops, self._name(), self._source.byte(), self._source.byte() << 8,
            self._source.byte(), self._victim.policy.tag, self._source.byte() << 24, self._source.byte(),
            self._source.byte() * self._source.byte(),
        )  # fmt: skip

    def _data(self) -> Message:
        handovers = tuple([Handover(self._number(), self._datum()) for _ in self._some()])
        return Data(self._name(), self._victim.id, handovers, bool(self._source.byte() % 2))

    def _committed(self) -> Message:
        done = []
        for _ in self._some():
            number = self._number()
            question = self._victim.exchange.open.get(number)
            holding = None if question is None else self._victim.holdings.get(question.id)
            done.append((number, 0 if holding is None else holding.crc))
        return Committed(self._name(), self._victim.id, tuple(done), tuple([self._number() for _ in self._some()]))

    def _offer(self) -> Message:
        datum = self._datum()
        size, chunk = self._source.pick((1, 98, 1000, 1 << 20, 0xFFFFFFFF)), self._source.byte() % 123 + 1
        return Offer(
            self._name(), self._victim.id, self._number(), datum.id, datum.kind, datum.created, 1, datum.crc, size,
            chunk,
        )  # fmt: skip

    def _accept(self) -> Message:
        return Accept(self._name(), self._victim.id, self._number(), self._source.byte(), self._source.byte())

    def _sack(self) -> Message:
        return Sack(self._name(), self._victim.id, self._source.byte(), self._source.byte(), self._source.byte())

    def _receipt(self) -> Message:
        entries = []
        for _ in self._some():
            id, bitmap = self._id(), self._source.byte() << self._source.byte() % 100
            entries.append(ReceiptEntry(*id, self._source.byte() + 1, bitmap & ~1, bool(self._source.byte() % 2)))
        return make_receipt(self._name(), self._life(), self._source.pick(EDGES), entries)

    def _sequence_mark(self) -> Message:
        return make_sequence_mark(self._name(), self._life(), self._source.byte())

    def _deletion_report(self) -> Message:
        entries = [DeletionEntry(self._number(), self._id(), self._source.byte() % 9, 0) for _ in self._some()]
        return DeletionReport(self._name(), self._victim.id, tuple(entries))

    def _copy_statuses(self) -> Message:
        entries = [CopyStatusEntry(self._id(), self._source.byte() % 9) for _ in self._some()]
        return CopyStatuses(self._name(), self._victim.id, tuple(entries))

    def _put(self) -> Message:
        return Put(self._name(), self._source.pick(EDGES) & 0xFFFF, self._name(), self._datum())

    def _query(self) -> Message:
        return Query(self._name(), self._victim.id, tuple([self._id() for _ in self._some()]))


_INVENTED = (
    Liar._beacon, Liar._data, Liar._committed, Liar._offer, Liar._accept, Liar._sack, Liar._receipt,
    Liar._sequence_mark, Liar._deletion_report, Liar._copy_statuses, Liar._put,
    Liar._query,
)  # fmt: skip
