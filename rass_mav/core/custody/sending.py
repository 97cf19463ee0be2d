"""The sender's side of a transfer: which chunks of a datum have arrived, are on their way, or are missing.

The other side is not trusted. A report of chunks that were never sent is ignored, and a transfer counts as alive only
while more is reported than ever before.
"""

from __future__ import annotations

from collections.abc import Iterator

from rass_mav.core.custody.flow import Flight, Flow
from rass_mav.core.datum import Datum
from rass_mav.core.messages import REPORT_BITS, Chunk, Offer

#: Fact: A chunk this far beyond the first that is missing waits, so that a report covers all that has arrived.
SPAN = REPORT_BITS
#: Bound: After so many reports in a row by which chunks got lost and none arrived, chunks wait for the next turn: a
#: receiver that reports so has another content in mind, or lies.
MOST_VAIN = 16


class Sending:
    """One datum on its way to one neighbour in chunks."""

    __slots__ = (
        "_most", "_next", "_sent", "arrived", "count", "datum", "flying", "handle", "missing", "moved", "named",
        "neighbour", "number", "offered", "omitted", "size", "tries", "vain",
    )  # fmt: skip

    def __init__(self, datum: Datum, neighbour: int, number: int, chunk_size: int) -> None:
        self.datum = datum
        self.neighbour = neighbour
        self.number = number
        """The hand-over number."""
        self.size = chunk_size
        self.count = -(-len(datum.payload) // chunk_size)
        """Number of chunks."""
        self.handle: int | None = None
        """The receiver's name for the transfer; None: it has not answered."""
        self.named = 0.0
        """When the receiver gave that name, seconds."""
        self.offered = 0.0
        """When it was offered last, seconds."""
        self.omitted: float | None = None
        """Since when the receiver's reports leave it out, seconds: there it is over. None: they do not."""
        self.tries = 0
        """Offers since an answer."""
        self.moved = False
        """Whether more has been reported than ever before, since `Transfers.check` looked last."""
        self.vain = 0
        """Reports since the last one by which something arrived, and since the turn began, by which chunks got lost."""
        self.arrived = 0
        """Chunks that the receiver has by its own report: bit i is chunk i."""
        self.flying: dict[int, Flight] = {}
        """Chunks on their way, with their last transmissions, the oldest first."""
        self.missing: dict[int, Flight] = {}
        """Chunks to be sent again, with the transmissions that got lost."""
        self._sent = 0
        """Chunks that the receiver may have, as bits."""
        self._next = 0
        """The next chunk to be sent for the first time under this handle."""
        self._most = -1
        """The most chunks that were ever reported; -1: no answer yet."""

    def offer(self, sender: int, now: float) -> Offer:
        """The offer, which is also the probe."""
        self.offered = now
        d = self.datum
        return Offer(
            sender, self.neighbour, self.number, d.id, d.kind, d.created, d.hops, d.crc, len(d.payload), self.size,
            d.at_least,
        )  # fmt: skip

    @property
    def complete(self) -> bool:
        """Whether the receiver has all chunks by its own report."""
        return self.arrived == (1 << self.count) - 1

    @property
    def waits(self) -> float | None:
        """Since when it waits for the answer to an offer, or for COMMITTED, seconds; None: it does not."""
        if self.omitted is not None:
            return max(self.omitted, self.offered)
        return self.offered if self.handle is None or self.complete else None

    @property
    def unsent(self) -> int:
        """Chunks that have not been sent for the first time."""
        return self.count - self._next

    # -- what the receiver says ----------------------------------------------------------------------------------------

    def open(self, handle: int, report: int, now: float) -> bool:
        """The receiver names the transfer anew, and has the chunks of this report, perhaps from an earlier transfer.
        False: that cannot be."""
        if report >> self.count or report == (1 << self.count) - 1:
            return False
        self.handle, self.named, self.omitted = handle, now, None
        self.flying.clear()
        self.missing.clear()
        self._next = 0
        self._sent = self.arrived = report
        self._count()
        return True

    def believes(self, report: int) -> bool:
        """Whether all chunks of a report have been sent."""
        return not report & ~self._sent

    def take(self, report: int, flow: Flow) -> list[tuple[int, Flight]]:
        """The receiver reports these chunks. Returns those that were on their way, and their last transmissions."""
        new = report & ~self.arrived
        self.arrived |= new
        if new:
            self.vain = 0
        landed = []
        while new:
            position = (new & -new).bit_length() - 1
            new &= new - 1
            if (flight := self.flying.pop(position, None)) is not None:
                landed.append((position, flight))
            elif (flight := self.missing.pop(position, None)) is not None and flight.serial:
                flow.overtaken()
        self._count()
        return landed

    def contradict(self, report: int) -> None:
        """All chunks were reported, but the receiver asks for some once more: it has only these."""
        self.arrived = report
        self.missing = dict.fromkeys([i for i in range(self.count) if not report >> i & 1], Flight(0, 0.0, 0, 0))

    def miss(self, before: int, covered: int, flow: Flow) -> None:
        """All transmissions before this serial have arrived or are lost. `covered`: of the chunks below this one it is
        known which have arrived."""
        flying = len(self.flying)
        for position, flight in list(self.flying.items()):
            if flight.serial >= before:
                break
            if position < covered:
                del self.flying[position]
                self.missing[position] = flight
                flow.lost()
        self.vain += len(self.flying) < flying

    def omit(self, before: int, now: float) -> None:
        """A report about the other transfers leaves this one out. `before`: as in `miss`."""
        over = self.flying and not self.missing and not self.unsent
        if self.omitted is None and over and all(flight.serial < before for flight in self.flying.values()):
            self.omitted = now

    def _count(self) -> None:
        if self.arrived.bit_count() > self._most:
            self._most = self.arrived.bit_count()
            self.moved = True

    # -- what is sent --------------------------------------------------------------------------------------------------

    def due(self, *, fresh: bool) -> Iterator[int]:
        """The chunks that may be sent again, or with `fresh` for the first time. Each has to be sent before the next is
        taken."""
        if not fresh:
            while self.missing and self.vain < MOST_VAIN:
                yield min(self.missing)
            return
        first_missing = (~self.arrived & self.arrived + 1).bit_length() - 1
        while self._next < min(self.count, first_missing + SPAN):
            if self.arrived >> self._next & 1:
                self._next += 1
            else:
                yield self._next

    def chunk(self, position: int, flow: Flow, now: float) -> Chunk:
        """Send a chunk now."""
        lost = self.missing.pop(position, None)
        self.flying[position] = flow.send(now, 0 if lost is None else lost.serial)
        if position == self._next:
            self._next += 1
        self._sent |= 1 << position
        return self.content(position)

    def content(self, position: int) -> Chunk:
        """The chunk at this position."""
        assert self.handle is not None
        data = self.datum.payload[position * self.size : (position + 1) * self.size]
        return Chunk(self.neighbour, self.handle, position, False, data)

    def question(self, number: int) -> Chunk:
        """Ask for a report."""
        assert self.handle is not None
        return Chunk(self.neighbour, self.handle, number, True, b"")
