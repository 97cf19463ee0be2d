"""What one node sends in chunks: a few transfers to each neighbour, and bounded in all."""

from __future__ import annotations

import random
from collections.abc import Iterable, Iterator

from rass_mav.core.custody.custody_store import CustodyStore
from rass_mav.core.custody.flow import SACK_EVERY, Flight, Flow, round_s, times
from rass_mav.core.custody.holdings import Holding, Pending
from rass_mav.core.custody.sending import Sending
from rass_mav.core.datum import Datum
from rass_mav.core.messages import CHUNK_BYTES, OTHER_BITS, REPORT_BITS, Accept, Chunk, Message, Report, Sack
from rass_mav.core.pace import LOSSY, Pace

#: Transfers at a time, in each direction. Each holds at most one datum (1 MiB) in memory.
MAX_TRANSFERS = 8
#: How many of them may be with one neighbour, and how many incoming ones may be data of one origin.
MAX_OF_ONE = 4
#: How many offers to one neighbour may wait for an answer.
MAX_OFFERED = 2
# Tuned: python -m tools.sensitivity custody.transfers
#: The next datum is offered when fewer chunks than this many windows are unsent.
AHEAD = 3
#: No other transfer begins while the chunks of those before it, to all neighbours, take more turns than this. All
#: share one link, and one that brings nothing for 8 rounds is given up.
MOST_AHEAD_TURNS = 2.0
#: A transfer without progress for so many rounds delays no other.
SILENT_ROUNDS = 2
#: Chunk indexes have 14 bits.
MAX_CHUNKS = 1 << 14
#: Where nothing else can be sent, what was missing is sent more than once: one copy for so many chunks, and the most
#: that are saved up.
CHUNKS_A_COPY = 32
MOST_SAVED = 2 * CHUNKS_A_COPY
#: What is known of a link that was idle for longer does not count any more, seconds.
IDLE_S = 30.0
#: Questions that are remembered, for each neighbour.
MAX_QUESTIONS = 8


class Stream:
    """What one neighbour is sent in chunks, over all transfers to it."""

    __slots__ = ("flow", "full", "last_question", "questions")

    def __init__(self, now: float, first_question: int) -> None:
        self.flow = Flow(now)
        self.full = False
        """Whether no transfer could begin when this was looked at last."""
        self.last_question = first_question
        """Number of the last question. The first is drawn at random: another node may have the same handle."""
        self.questions: dict[int, Flight] = {}
        """The last questions, by number."""


class Transfers:
    """The offers and chunks of one node, and what its neighbours report of them."""

    __slots__ = ("_custody_store", "_id", "_pace", "_rng", "_streams")

    def __init__(self, custody_store: CustodyStore, pace: Pace, rng: random.Random) -> None:
        self._id = custody_store.settings.node_id
        self._custody_store = custody_store
        self._pace = pace
        self._rng = rng
        self._streams: dict[int, Stream] = {}
        """By neighbour."""

    def _to(self, neighbour: int) -> Iterator[Sending]:
        """The transfers to a neighbour, the earliest first."""
        for pending in self._custody_store.holdings.large.get(neighbour, {}).values():
            if pending.sending is not None:
                yield pending.sending

    def free(self, neighbour: int) -> bool:
        """Whether a transfer to this neighbour can begin: there is a place, and the ones before it are nearly sent."""
        large = self._custody_store.holdings.large
        if sum(map(len, large.values())) >= MAX_TRANSFERS or self._ahead() > MOST_AHEAD_TURNS:
            return False
        sendings = list(self._to(neighbour))
        if not sendings:
            return True
        offered = sum(sending.handle is None for sending in sendings)
        if len(sendings) >= MAX_OF_ONE or offered >= MAX_OFFERED:
            return False
        unsent = sum(sending.unsent for sending in sendings if sending.handle is not None)
        flow = self._streams[neighbour].flow
        return unsent < AHEAD * flow.window()

    def _ahead(self) -> float:
        """How long the chunks of all transfers take that are open and make progress, turns."""
        pace, turns = self._pace, 0.0
        for neighbour, transfers in self._custody_store.holdings.large.items():
            chunks = 0
            for pending in transfers.values():
                sending = pending.sending
                if sending is not None and sending.handle is not None and pending.tries <= SILENT_ROUNDS:
                    chunks += sending.count - sending.arrived.bit_count()
            # Until the rate is known: as many as there may be small data.
            turns += chunks / (self._streams[neighbour].flow.rate * pace.turn_s or pace.items)
        return turns

    def begin(self, holding: Holding, datum: Datum, neighbour: int, now: float, out: list[Message]) -> None:
        """Offer a datum to a neighbour that is `free`."""
        custody_store = self._custody_store
        number = custody_store.exchange.draw()
        sending = Sending(datum, neighbour, number, CHUNK_BYTES)
        pending = Pending(number, holding.id, neighbour, now, sending)
        pending.due = now + 0.5 * round_s(self._pace)
        custody_store.holdings.give(holding, pending)
        stream = self._streams.get(neighbour)
        if stream is None or now - stream.flow.active > IDLE_S:
            stream = self._streams[neighbour] = Stream(now, self._rng.getrandbits(14))
        self._offer(sending, stream.flow, now, out)

    def _offer(self, sending: Sending, flow: Flow, now: float, out: list[Message]) -> None:
        # One that gets lost may leave the link idle, and is small.
        out += [sending.offer(self._id, now)] * (2 if flow.loss > LOSSY else 1)
        self._wake(now + flow.wait_s(round_s(self._pace), sending.tries))

    def check(self, pending: Pending, sending: Sending, now: float, out: list[Message]) -> None:
        """Count the rounds in which a transfer made no progress."""
        pending.sent = now
        waits = bool(sending.unsent or sending.missing)
        idle = sending.handle is not None and not sending.flying and sending.omitted is None and waits
        # One that waits for those before it cannot move: that says nothing of the neighbour.
        behind = idle and any(other.flying for other in self._to(sending.neighbour))
        if not behind:
            pending.tries = 1 if sending.moved else pending.tries + 1
        sending.moved = False
        sending.vain = 0
        if idle and not behind:
            # Those before it were given up.
            out += self._fill(sending.neighbour, self._streams[sending.neighbour], now)

    def on_accept(self, accept: Accept, now: float) -> list[Message]:
        """The neighbour opened a transfer, or says of one that is open what it has."""
        pending = self._custody_store.holdings.large.get(accept.sender, {}).get(accept.number)
        sending = None if pending is None else pending.sending
        if sending is None:
            return []
        stream = self._streams[accept.sender]
        flow, report = stream.flow, Report(accept.handle, accept.next_index, accept.bitmap).chunks
        wait_s = flow.wait_s(round_s(self._pace), 0)
        if accept.handle != sending.handle:
            # A node that names it again and again would be sent it again and again.
            if sending.handle is not None and now - sending.named < wait_s:
                return []
            first = not sending.tries and sending.handle is None
            if not sending.open(accept.handle, report, now):
                return []
            if first:
                flow.measure_answer(now - sending.offered)
        elif not sending.believes(report):
            return []
        elif sending.complete and sending.tries:
            sending.contradict(report)
        else:
            self._landed(stream, sending.take(report, flow), now, asked=True)
        sending.tries = 0
        return self._fill(accept.sender, stream, now)

    def on_sack(self, sack: Sack, now: float) -> list[Message]:
        """The neighbour reports the chunks it has."""
        stream = self._streams.get(sack.sender)
        if stream is None:
            return []
        by_handle = {sending.handle: sending for sending in self._to(sack.sender)}
        reports: list[tuple[Sending, Report, int]] = []
        for number, report in enumerate((Report(*sack[2:5]), *sack.others)):
            sending = by_handle.pop(report.handle, None)
            if sending is not None and sending.handle is not None and sending.believes(report.chunks):
                covered = report.next_index + 1 + (OTHER_BITS if number else REPORT_BITS)
                reports.append((sending, report, covered))
        if not reports:
            return []
        flow = stream.flow
        landed = [flight for sending, report, _ in reports for flight in sending.take(report.chunks, flow)]
        asked = stream.questions.pop(sack.question, None)
        self._landed(stream, landed, now, asked=asked is not None)
        before = flow.lost_before()
        if asked is not None:
            # It was sent after all others, so nothing has overtaken them.
            before = max(before, asked.serial)
            flow.measure_answer(now - asked.at)
            flow.report(now)
        for sending, _, covered in reports:
            sending.miss(before, covered, flow)
        for sending in by_handle.values():
            sending.omit(before, now)
        return self._fill(sack.sender, stream, now)

    def taken(self, sending: Sending, now: float) -> list[Message]:
        """The neighbour has the whole datum on disk."""
        stream = self._streams[sending.neighbour]
        for _ in sending.flying:
            stream.flow.arrived()
        stream.flow.report(now)
        # The next one may begin.
        stream.full = True
        return self._fill(sending.neighbour, stream, now)

    def _landed(self, stream: Stream, landed: Iterable[tuple[int, Flight]], now: float, *, asked: bool) -> None:
        """Chunks that were on their way are reported. `asked`: in the answer to an offer or a question."""
        flow = stream.flow
        newest: Flight | None = None
        for _, flight in landed:
            flow.arrived()
            if not flow.is_new(flight, now):
                flow.overtaken()
            elif newest is None or flight.serial > newest.serial:
                newest = flight
            flow.report(now)
        if newest is not None:
            flow.newest = max(flow.newest, newest.serial)
            flow.measure(newest, now, asked=asked)

    def _fill(self, neighbour: int, stream: Stream, now: float) -> list[Message]:
        """Send as many chunks as the window allows; those that are missing first, then by age of the transfer."""
        flow = stream.flow
        every = list(self._to(neighbour))
        sendings = [sending for sending in every if sending.handle is not None]
        room = flow.window() - sum(len(sending.flying) for sending in sendings if sending.omitted is None)
        chunks: list[Chunk] = []
        again = []
        ended = True
        for fresh in (False, True):
            for sending in sendings:
                for position in sending.due(fresh=fresh):
                    if room <= 0:
                        ended = False
                        break
                    room -= 1
                    if not fresh:
                        again.append((sending, position))
                    chunks.append(sending.chunk(position, flow, now))
        flow.copies = min(MOST_SAVED, flow.copies + len(chunks) / CHUNKS_A_COPY)
        flow.unpolled += len(chunks)
        if chunks and (ended or flow.unpolled >= SACK_EVERY // 2):
            chunks[-1] = chunks[-1]._replace(poll=True)
            flow.unpolled = 0
        if chunks and ended and len(sendings) == len(every) and flow.window() - room <= flow.fits:
            chunks += self._copies(flow, again)
        if chunks and ended and flow.loss > LOSSY:
            # Without a report nothing else would be sent.
            asked = next(sending for sending in sendings if sending.flying)
            chunks += [self._question(stream, asked, now) for _ in range(flow.asks)]
        self._pace.sent += sum(bool(chunk.data) for chunk in chunks)
        if not any(sending.flying and sending.omitted is None for sending in every):
            # Offers that wait for their answers wait less long now.
            self._wake(now)
        elif chunks:
            self._wake(now + flow.wait_s(round_s(self._pace), flow.tries))
        full = not self.free(neighbour)
        if stream.full and not full:
            self._custody_store.dirty = True
        stream.full = full
        return list(chunks)

    def _copies(self, flow: Flow, again: list[tuple[Sending, int]]) -> list[Chunk]:
        """Nothing else waits: what was missing is sent so often that it should not be missing once more."""
        more = min(times(flow.loss) - 1, int(flow.copies / max(1, len(again))))
        flow.copies -= more * len(again)
        return [sending.content(position) for _ in range(more) for sending, position in again]

    def _question(self, stream: Stream, sending: Sending, now: float) -> Chunk:
        stream.last_question = stream.last_question % (MAX_CHUNKS - 1) + 1
        stream.questions[stream.last_question] = stream.flow.send(now)
        while len(stream.questions) > MAX_QUESTIONS:
            del stream.questions[next(iter(stream.questions))]
        return sending.question(stream.last_question)

    # -- waiting -------------------------------------------------------------------------------------------------------

    def _wake(self, at: float) -> None:
        self._custody_store.exchange.wake(at)

    def tend(self, now: float) -> list[Message]:
        """Ask for reports that are late, and repeat offers that are not answered. Returns what to send."""
        out: list[Message] = []
        most_s = round_s(self._pace)
        for neighbour in self._custody_store.holdings.large:
            stream = self._streams[neighbour]
            flow = stream.flow
            flying = [sending for sending in self._to(neighbour) if sending.flying and sending.omitted is None]
            if flying:
                at = flow.quiet + flow.wait_s(most_s, flow.tries)
                if at <= now:
                    flow.tries += 1
                    if flow.tries % 2:
                        out.append(self._question(stream, flying[0], now))
                    else:
                        # The neighbour may have started anew, and know nothing of its handles.
                        flow.quiet = now
                        out += [sending.offer(self._id, now) for sending in flying]
                    at = now + flow.wait_s(most_s, flow.tries)
                self._wake(at)
            for sending in self._to(neighbour):
                if (since := sending.waits) is not None:
                    at = since + flow.wait_s(most_s, sending.tries, idle=not flying)
                    if at <= now:
                        sending.tries += 1
                        self._offer(sending, flow, now, out)
                    else:
                        self._wake(at)
        return out

    def age(self, now: float) -> None:
        """Forget links that are long idle."""
        large = self._custody_store.holdings.large
        for neighbour, stream in list(self._streams.items()):
            if neighbour not in large and now - stream.flow.active > IDLE_S:
                del self._streams[neighbour]
