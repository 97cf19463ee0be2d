"""Hand-overs on an air that loses frames: answers that come twice, retries that wait, and what attackers make of it."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rass_mav.agent.commits import CommitGate
from rass_mav.agent.outgoing import Outgoing, frames_of
from rass_mav.core.custody.handovers import MAX_ACCEPTED, HandoverNumbers
from rass_mav.core.datum import Datum, DatumId, Kind, make_datum
from rass_mav.core.exchange import MOST_DOUBLINGS, Exchange, RoundTrip, mark
from rass_mav.core.messages import (
    Beacon,
    Committed,
    Data,
    Message,
)
from rass_mav.core.node import MAX_ANSWERED, Node
from rass_mav.core.pace import RESERVED
from rass_mav.core.policy import POTENTIAL_ONE
from rass_mav.core.seals import ContentHashes
from rass_mav.errors import StoreError
from rass_mav.mavlink.frames import FrameWriter
from rass_mav.mavlink.tunnel import tunnel_from_datagram
from rass_mav.trust.pairs import StrongContentHashes
from rass_mav.wire import decode
from tests.some import some

from .books import check_node
from .build import beacon, data, datum, make_node, of, tries
from .durable import DurableStore

ME, NEXT, OTHER = 1, 2, 3


@pytest.fixture(autouse=True, scope="module")
def never_given_up() -> Iterator[None]:
    with tries(1000):
        yield


class Custodian:
    """A node with data in custody, one fitter neighbour, `NEXT`, and the frames that reach it. Its turns are at whole
    seconds."""

    def __init__(self, **settings: Any) -> None:
        self.node = make_node(ME, **settings)
        self.now = 0.0
        self.beacons = 0
        self.beacon()

    def beacon(self, *answers: Committed, sender: int = NEXT) -> None:
        """A beacon is heard, half a second after the last turn."""
        self.beacons += 1
        said = beacon(sender, self.beacons, policy=self.node.policy.tag, potential=POTENTIAL_ONE)
        self.node.receive(said._replace(answers=answers), self.now + 0.5)

    def turn(self) -> list[tuple[int, int, DatumId]]:
        """The node's next turn. Returns what it hands over: target, number and id."""
        self.now += 1.0
        sent = of(Data, self.node.step(self.now))
        check_node(self.node)
        return [(d.target, handover.number, handover.datum.id) for d in sent for handover in d.handovers]

    def turns(self, count: int) -> list[list[tuple[int, int, DatumId]]]:
        """The node's next turns, with a beacon before each."""
        handed = []
        for _ in range(count):
            self.beacon()
            handed.append(self.turn())
        return handed

    def put(self) -> DatumId:
        return self.node.put(b"reading", self.now)

    def hand_over(self, *, trip_s: float | None = None) -> tuple[int, int, DatumId]:
        """A new datum leaves in the next turn; the answer comes after `trip_s`, or not at all."""
        id = self.put()
        [sent] = [sent for sent in self.turn() if sent[2] == id]
        if trip_s is not None:
            self.node.receive(self.answer(sent), self.now + trip_s)
            assert id not in self.node.holdings.custody
        return sent

    def answer(self, sent: tuple[int, int, DatumId]) -> Committed:
        target, number, id = sent
        return Committed(target, ME, ((number, self.node.holdings.custody[id].crc),), ())


# -- answers that are repeated -----------------------------------------------------------------------------------------


def test_an_answer_in_a_beacon_ends_custody() -> None:
    custodian = Custodian()
    sent = custodian.hand_over()
    custodian.beacon(custodian.answer(sent))
    assert not custodian.node.holdings.custody
    assert not custodian.node.exchange.open
    assert [custodian.turn() for _ in range(5)] == [[]] * 5


def test_an_answer_is_repeated_once_the_datum_is_on_disk_and_only_once() -> None:
    store, d = DurableStore(epoch=5), datum()
    node = make_node(NEXT, store=store)
    node.receive(data(ME, NEXT, (77, d), (0, datum(sequence=1))), 0.1)
    assert answers_in(node, 1.0) == ()
    batch = store.take()
    assert answers_in(node, 2.0) == (), "it is on its way to the disk"
    assert batch is not None
    store.write(batch)
    assert answers_in(node, 3.0) == (Committed(NEXT, ME, ((77, d.crc),), ()),)
    assert answers_in(node, 4.0) == ()


def answers_in(node: Node, now: float) -> tuple[Committed, ...]:
    """What the beacon of the node's next turn repeats."""
    [said] = of(Beacon, node.step(now))
    answers: tuple[Committed, ...] = said.answers
    return answers


def test_a_base_repeats_no_answer_for_a_second_content_that_is_not_on_disk() -> None:
    """The first content under the same id is on disk already."""
    store, one, two = DurableStore(epoch=5), datum(payload=b"one"), datum(payload=b"two")
    base = make_node(0, base=True, store=store, receipts=False)
    base.receive(data(ME, 0, (1, one)), 0.1)
    store.commit()
    base.step(1.0)
    [answer] = base.receive(data(ME, 0, (2, two)), 1.1)
    assert answer == Committed(0, ME, ((2, two.crc),), ())
    assert store.unwritten
    assert answers_in(base, 2.0) == ()


def test_a_flood_of_hand_overs_fills_no_table() -> None:
    node, d = make_node(NEXT, capacity_items=1000), datum()
    for _ in range(3):
        node.receive(data(ME, NEXT, (77, d)), 0.1)
    node.store.commit()  # type: ignore[attr-defined]
    assert answers_in(node, 1.0) == (Committed(NEXT, ME, ((77, d.crc),), ()),), "the same one counts once"
    for number in range(5 * MAX_ANSWERED):
        node.receive(data(number % 7, NEXT, (number + 1, d)), 1.1)
    node.store.commit()  # type: ignore[attr-defined]
    said = [answer for turn in range(2, 200) for answer in answers_in(node, float(turn))]
    assert sum(len(answer.committed) for answer in said) == MAX_ANSWERED


# -- forged answers ----------------------------------------------------------------------------------------------------

u32 = st.integers(0, 0xFFFFFFFF)


@given(
    numbers=st.lists(st.tuples(u32, u32), max_size=5), refused=st.lists(u32, max_size=5),
    near=st.sampled_from(["nothing", "number", "crc", "another sender", "another target"]),
)  # fmt: skip
def test_answers_that_name_nothing_pending_do_nothing(
    numbers: list[tuple[int, int]], refused: list[int], near: str
) -> None:
    custodian = Custodian(mirror=True)
    sent = custodian.hand_over()
    [(number, crc)] = custodian.answer(sent).committed
    sender, target = NEXT, ME
    if near == "number":
        numbers = [*numbers, (number ^ 1, crc)]
    elif near == "crc":
        numbers = [*numbers, (number, crc ^ 1)]
    elif near == "another sender":
        numbers, refused, sender = [*numbers, (number, crc)], [*refused, number], OTHER
    elif near == "another target":
        numbers, refused, target = [*numbers, (number, crc)], [*refused, number], OTHER
    if sender == NEXT and target == ME:
        numbers = [pair for pair in numbers if pair != (number, crc)]
        refused = [other for other in refused if other != number]
    forged = Committed(sender, target, tuple(numbers), tuple(refused))
    node = custodian.node
    custodian.beacon(forged, sender=sender)
    assert list(node.holdings.custody) == [sent[2]]
    assert list(node.exchange.open) == [number]
    check_node(node)


# -- the gate ----------------------------------------------------------------------------------------------------------


class Sender:
    """A node's frames behind its gate: a disk that a test holds up."""

    def __init__(self) -> None:
        self.store = DurableStore(epoch=5)
        self.node = make_node(NEXT, store=self.store, immediate=True)
        self.gate = CommitGate(self.store)
        self.writer = FrameWriter(NEXT, 191)
        self.node.receive(beacon(OTHER, policy=self.node.policy.tag, potential=POTENTIAL_ONE), 0.0)
        self.node.step(0.4)

    def say(self, messages: list[Message]) -> list[Message]:
        """What leaves at once."""
        return opened(self.gate.say(frames_of(messages, self.writer, 33200, self.store, 1.0)))

    def take(self, *handovers: tuple[int, Datum]) -> list[Message]:
        """Data come in and go on at once. What leaves at once."""
        answers = self.node.receive(data(ME, NEXT, *handovers), 0.5)
        return self.say(answers + self.node.forward(0.5))


def opened(frames: Any) -> list[Message]:
    """The messages in frames."""
    messages = []
    for outgoing in frames:
        assert isinstance(outgoing, Outgoing)
        fields = some(tunnel_from_datagram(outgoing.frame))
        message = decode(fields[5], 1.0)
        assert message is not None
        messages.append(message)
    return messages


def test_an_answer_leaves_when_what_it_confirms_is_on_disk() -> None:
    sender, d = Sender(), datum()
    assert sender.take((77, d)) == []
    batch = some(sender.gate.begin())
    assert d.id not in sender.store.disk.data
    sender.store.write(batch)
    answer, moves = opened(sender.gate.written())
    assert answer == Committed(NEXT, ME, ((77, d.crc),), ())
    assert isinstance(moves, Data)
    assert moves.target == OTHER
    assert d.id in sender.store.disk.data


def test_a_failing_disk_delays_no_beacon_and_lets_no_answer_out() -> None:
    sender, d = Sender(), datum()
    assert sender.take((77, d)) == []
    for t in range(1, 5):
        assert sender.gate.begin() is not None
        [said] = of(Beacon, sender.say(sender.node.step(float(t))))
        assert said.answers == ()
        sender.gate.failed(StoreError("I/O error"))
    batch = some(sender.gate.begin())
    sender.store.write(batch)
    assert of(Committed, opened(sender.gate.written())) == [Committed(NEXT, ME, ((77, d.crc),), ())]
    [said] = of(Beacon, sender.say(sender.node.step(5.0)))
    assert said.answers == (Committed(NEXT, ME, ((77, d.crc),), ()),)


# -- retries -----------------------------------------------------------------------------------------------------------


def test_retries_come_twice_as_late_each_time_but_not_later_and_later() -> None:
    """Of a neighbour that has never answered."""
    gaps = []
    for seed in range(5):
        custodian = Custodian(seed=seed)
        custodian.beacon()
        custodian.hand_over()
        last, own = custodian.now, []
        for _ in range(80):
            custodian.beacon()
            if custodian.turn():
                own.append(custodian.now - last)
                last = custodian.now
        assert own[0] <= 2
        # Rounded up to whole turns; a beacon without an answer may make them earlier, but not more frequent than that.
        longest = 1.5 * (1 << MOST_DOUBLINGS) * 1.25 + 1
        assert own[1] >= own[0]
        assert own[2] > own[0]
        assert all(own[0] < gap <= longest for gap in own[2:])
        assert min(own[4:]) >= 4
        gaps.append(tuple(own))
    assert len(set(gaps)) > 1, "others that wait for the same air wait differently"


def test_what_follows_a_late_answer_waits_long_enough() -> None:
    """Answers take four turns: only what is sent before the first that could be measured is sent twice."""
    custodian = Custodian()
    waiting: list[tuple[float, Committed]] = []
    sent: dict[DatumId, int] = {}
    for t in range(60):
        if t % 5 == 0:
            custodian.put()
        for handed in custodian.turn():
            sent[handed[2]] = sent.get(handed[2], 0) + 1
            waiting.append((custodian.now + 4.0, custodian.answer(handed)))
        custodian.beacon()
        while waiting and waiting[0][0] <= custodian.now + 0.9:
            custodian.node.receive(waiting.pop(0)[1], custodian.now + 0.9)
    assert len(sent) == 12
    times = list(sent.values())
    assert times[0] > 1
    assert times[3:] == [1] * 9


# -- early repeats -----------------------------------------------------------------------------------------------------


def repeats(custodian: Custodian) -> list[tuple[float, int]]:
    """What is sent again before the next turn: how long after the last one, and its number."""
    node, found = custodian.node, []
    while node.exchange.due < custodian.now + 1.0:
        at = node.exchange.due
        sent = of(Data, node.tend(at))
        found += [(at - custodian.now, handover.number) for d in sent for handover in d.handovers]
        check_node(node)
    return found


def test_what_gets_lost_by_chance_is_repeated_as_soon_as_its_answer_is_late() -> None:
    custodian = Custodian()
    for _ in range(20):
        custodian.hand_over(trip_s=0.05)
        custodian.beacon()
    _, number, id = custodian.hand_over()
    [(first_s, first), *_] = repeats(custodian)
    assert first == number
    assert 0.05 < first_s < 0.2
    custodian.node.receive(custodian.answer((NEXT, number, id)), custodian.now + 0.3)
    assert not custodian.node.exchange.open


@pytest.mark.parametrize("risk", [0.0, 0.5])
def test_a_neighbour_that_falls_silent_is_asked_less_and_less(risk: float) -> None:
    """Where frames collide, what is repeated at once collides again. That does not depend on the danger."""
    custodian = Custodian()
    for _ in range(100):
        custodian.hand_over(trip_s=0.05)
        custodian.beacon()
    custodian.node.risk.observe(risk, custodian.now)
    _, number, _ = custodian.hand_over()
    at = [0.0, *(s for s, found in repeats(custodian) if found == number)]
    usual, *gaps = [later - earlier for earlier, later in pairwise(at)]
    assert 0.05 <= usual < 0.1
    assert len(gaps) > MOST_DOUBLINGS - 1
    for again, gap in enumerate(gaps, start=1):
        assert 0.75 * usual <= gap / (1 << min(again, MOST_DOUBLINGS)) <= 1.25 * usual


# -- hearing a datum move on -------------------------------------------------------------------------------------------


def handed_on(custodian: Custodian, sent: tuple[int, int, DatumId], *, sender: int = NEXT) -> Data:
    """The frame in which a neighbour hands on what it took under this number."""
    copy = some(custodian.node.store.get(sent[2]))
    return data(sender, 9, (5 << 16 | mark(sent[1]), copy.arrived()))


def test_a_receiver_that_is_heard_handing_the_datum_on_has_taken_it() -> None:
    """Passive acknowledgement: its answer was lost. The copy here stays until the report, as after an answer."""
    custodian = Custodian(mirror=True)
    sent = custodian.hand_over()
    custodian.node.receive(handed_on(custodian, sent), custodian.now + 0.7)
    assert not custodian.node.exchange.open
    assert custodian.node.holdings.replica.keys() == {sent[2]}
    assert sent[2] in custodian.node.custody_store.journal, "it is judged like any other"
    assert custodian.turns(10) == [[]] * 10


def test_a_receiver_says_by_its_number_that_it_has_taken_the_datum() -> None:
    """Two real nodes: what the first hears of the second is enough, also when the second has to repeat it."""
    custodian, receiver = Custodian(mirror=True), make_node(NEXT, mirror=True)
    sent = custodian.hand_over()
    copy = some(custodian.node.store.get(sent[2]))
    receiver.receive(data(ME, NEXT, (sent[1], copy)), custodian.now)
    handed: list[Data] = []
    for number in range(1, 6):
        said = beacon(OTHER, number, policy=receiver.policy.tag, potential=POTENTIAL_ONE)
        receiver.receive(said, custodian.now + number)
        handed += of(Data, receiver.step(custodian.now + number + 0.5))
    assert len(handed) > 1
    for heard in handed[:2]:
        other = Custodian(mirror=True)
        assert other.hand_over() == sent
        other.node.receive(heard, other.now + 0.7)
        assert not other.node.holdings.custody


NOT_TAKEN = {
    "it hands on a replica": lambda said: said._replace(replica=True),
    "no custody is offered": lambda said: said._replace(handovers=(said.handovers[0]._replace(number=0),)),
    "it took the datum under another number": lambda said: said._replace(
        handovers=(said.handovers[0]._replace(number=said.handovers[0].number ^ 1),)
    ),
    "another content": lambda said: said._replace(
        handovers=(said.handovers[0]._replace(datum=make_datum(said.handovers[0].datum.id, 0, 0.0, b"other")),)
    ),
    "noise": lambda said: said._replace(
        handovers=(
            said.handovers[0]._replace(datum=said.handovers[0].datum._replace(payload=b"noise")),
        )
    ),
    "another node": lambda said: said._replace(sender=OTHER),
}  # fmt: skip


@pytest.mark.parametrize("change", NOT_TAKEN)
def test_what_else_is_heard_ends_and_delays_nothing(change: str) -> None:
    plain, custodian = Custodian(mirror=True), Custodian(mirror=True)
    sent = custodian.hand_over()
    assert plain.hand_over() == sent
    heard = NOT_TAKEN[change](handed_on(custodian, sent))
    custodian.node.receive(heard, custodian.now + 0.7)
    # It shows that the neighbour is there.
    plain.node.receive(data(heard.sender, 9, (5, datum())), plain.now + 0.7)
    assert custodian.node.holdings.custody.keys() == {sent[2]}
    assert custodian.turns(9) == plain.turns(9)


def test_hearing_the_datum_move_on_tells_how_long_answers_take() -> None:
    custodian = Custodian(mirror=True)
    sent = custodian.hand_over()
    custodian.node.receive(handed_on(custodian, sent), custodian.now + 0.125)
    assert custodian.node.exchange.trip(NEXT).mean_s == 0.125


def took(*, base: bool = False, kind: int = 0, **settings: Any) -> tuple[Node, list[Message], list[Data]]:
    """A node takes a datum and hands it on: its answers, one of them about another datum, and what moves."""
    node = make_node(NEXT, base=base, immediate=True, **settings)
    node.receive(beacon(OTHER, 1, policy=node.policy.tag, potential=POTENTIAL_ONE), 0.1)
    node.step(0.2)
    datum = make_datum(DatumId(ME, 5, 0), kind, 0.0, b"x")
    answers = node.receive(data(ME, NEXT, (0x10007, datum)), 0.3)
    moves = of(Data, node.forward(0.3))
    assert bool(moves) is not base
    return node, [*answers, Committed(NEXT, 7, ((0x10008, datum.crc),), ())], moves


@pytest.mark.parametrize(
    ("settings", "needed"),
    [
        ({"mirror": True}, False),
        # Nobody takes it for an answer.
        ({"mirror": False}, True),
        ({"mirror": True, "without": ("passive-acknowledgement",)}, True),
        ({"mirror": True, "without": ("measured-retries",)}, True),
        # No replica of a share stays where it came from.
        ({"mirror": True, "kind": Kind.SHARE}, True),
        ({"mirror": True, "base": True}, True),
    ],
)
def test_who_gave_a_datum_and_hears_it_move_on_needs_no_answer(settings: dict[str, Any], needed: bool) -> None:
    store = DurableStore(5)
    node, answers, moves = took(store=store, **settings)
    assert node.needed(answers, [*moves]) == answers[0 if needed else 1 :]
    assert node.needed(answers, []) == answers
    store.commit()
    assert {answer.target for answer in answers_in(node, 1.0)} == ({ME} if node.settings.measured else set())


def test_with_keys_every_answer_is_needed() -> None:
    node, answers, moves = took(mirror=True)
    node.numbers.content_hashes = StrongContentHashes()
    assert node.needed(answers, [*moves]) == answers


def test_an_answer_says_what_does_not_move_on() -> None:
    node, answers, [moved] = took(mirror=True)
    answer = of(Committed, answers)[0]
    [(number, crc)] = answer.committed
    for committed, refused, left in (
        (((number, crc), (number + 1, crc)), (), Committed(NEXT, ME, ((number + 1, crc),), ())),
        (((number, crc),), (9,), Committed(NEXT, ME, (), (9,))),
        (((number, crc ^ 1),), (), Committed(NEXT, ME, ((number, crc ^ 1),), ())),
    ):
        assert node.needed([Committed(NEXT, ME, committed, refused)], [moved]) == [left]
    assert node.needed([answer], [moved._replace(replica=True)]) == [answer]


@pytest.mark.parametrize("keys", [False, True])
def test_without_a_replica_and_with_keys_only_an_answer_ends_custody(keys: bool) -> None:
    """Anybody who has the link key can hand on in another node's name: answers have tags, data have none."""
    custodian = Custodian(mirror=keys)
    if keys:
        custodian.node.numbers.content_hashes = StrongContentHashes()
    sent = custodian.hand_over()
    custodian.node.receive(handed_on(custodian, sent), custodian.now + 0.7)
    assert custodian.node.holdings.custody.keys() == {sent[2]}
    assert [sent] in custodian.turns(3), "it is asked again"
    custodian.node.receive(custodian.answer(sent), custodian.now + 0.1)
    assert not custodian.node.holdings.custody


def test_a_frame_from_an_earlier_round_says_nothing() -> None:
    """The datum comes back, and is handed to the same node again: what that one handed on before is late news."""
    custodian = Custodian(mirror=True)
    sent = custodian.hand_over()
    late = handed_on(custodian, sent)
    custodian.node.receive(custodian.answer(sent), custodian.now + 0.1)
    copy = some(custodian.node.store.get(sent[2]))
    custodian.node.receive(data(OTHER, ME, (7, copy)), custodian.now + 0.2)
    [again] = custodian.turn()
    assert (again[0], again[2]) == (NEXT, sent[2])
    custodian.node.receive(late, custodian.now + 0.1)
    assert sent[2] in custodian.node.holdings.custody


@tries(8)
def test_an_attacker_who_repeats_such_frames_holds_nothing_back_for_good() -> None:
    custodian = Custodian()
    custodian.beacon()
    sent = custodian.hand_over()
    copy = some(custodian.node.store.get(sent[2]))
    times = [custodian.now]
    targets, number = [NEXT], sent[1]
    for turn in range(300):
        # The real neighbour has never got it, and everything it sends is heard. No replica would stay here.
        custodian.beacon()
        custodian.beacon(sender=OTHER)
        for _ in range(3):
            forged = data(NEXT, 9, (turn << 16 | mark(number), copy))
            custodian.node.receive(forged, custodian.now + 0.7)
        for target, last, _ in custodian.turn():
            number = last
            times.append(custodian.now)
            targets.append(target)
    gaps = [b - a for a, b in pairwise(times)]
    assert gaps[0] <= 2
    assert max(gaps) <= max(1.5 * (1 << MOST_DOUBLINGS) * 1.25 + 1, RESERVED)
    assert len(times) > 8
    assert OTHER in targets, "after so many tries another one gets it"


def test_an_answer_that_had_to_be_repeated_says_nothing_of_how_long_answers_take() -> None:
    custodian = Custodian()
    custodian.hand_over(trip_s=0.1)
    custodian.beacon()
    for _ in range(9):
        custodian.beacon(custodian.answer(custodian.hand_over()))
    sent = custodian.hand_over()
    custodian.beacon()
    assert custodian.turn() == [sent]


# -- round trips -------------------------------------------------------------------------------------------------------


def test_the_time_to_wait_follows_rfc_6298() -> None:
    trip = RoundTrip()
    assert trip.wait_s == trip.usual_s == 0.0
    trip.measure(0.8)
    # SRTT = R, RTTVAR = R / 2, RTO = SRTT + 4 RTTVAR
    assert trip.wait_s == pytest.approx(2.4)
    trip.measure(0.4)
    # RTTVAR = 3/4 * 0.4 + 1/4 * 0.4, SRTT = 7/8 * 0.8 + 1/8 * 0.4
    assert trip.wait_s == pytest.approx(0.75 + 4 * 0.4)
    for _ in range(200):
        trip.measure(0.1)
    assert trip.wait_s == pytest.approx(0.1, abs=1e-3)


def test_missed_answers_double_the_time_until_the_next_measurement() -> None:
    unknown, trip = RoundTrip(), RoundTrip()
    unknown.missed(5.0, 1.5, 12.0)
    assert (unknown.usual_s, unknown.wait_s) == (0.0, 3.0)
    trip.measure(0.1)
    usual = trip.usual_s
    # A frame with three data was lost.
    for _ in range(3):
        trip.missed(5.0, 1.5, 12.0)
    assert trip.wait_s == usual
    for _ in range(2):
        trip.missed(6.0, 1.5, 12.0)
    assert (trip.usual_s, trip.wait_s) == (usual, 3.0)
    for t in range(7, 16):
        trip.missed(float(t), trip.wait_s, 12.0)
    assert trip.wait_s == 12.0
    trip.measure(0.1)
    assert trip.wait_s == trip.usual_s < 1.0
    trip.missed(17.0, 1.5, 12.0)
    assert trip.wait_s == trip.usual_s


def test_the_round_trips_of_nodes_that_are_gone_are_forgotten() -> None:
    exchange = Exchange(0)
    for id in range(300):
        exchange.trip(id).measure(1.0)
        exchange.keep(set(range(id - 3, id + 1)))
    assert exchange.trip(299).usual_s > 0.0
    assert sum(exchange.trip(id).usual_s > 0.0 for id in range(300)) <= 4 * 4


# -- what was passed on is told together -------------------------------------------------------------------------------


# -- numbers of hand-overs --------------------------------------------------------------------------------------------

X, Y = datum().id, datum(sequence=1).id


@pytest.fixture
def numbers() -> HandoverNumbers:
    return HandoverNumbers(ContentHashes())


@given(st.integers(0, 0xFFFFFFFF), st.integers(1, 0xFFFFFFFF))
def test_numbers_differ_are_never_zero_and_mark_what_was_taken(last: int, taken_as: int) -> None:
    exchange = Exchange(last)
    drawn = [exchange.draw(taken_as * (n % 2)) for n in range(200)]
    assert len({*drawn}) == len(drawn)
    assert 0 not in drawn
    assert max(drawn) <= 0xFFFFFFFF
    assert {number & 0xFFFF for number in drawn[1::2]} == {mark(taken_as)}


def test_numbers_wrap_without_zero() -> None:
    exchange = Exchange(0xFFFFFFFE)
    assert [exchange.draw() for _ in range(3)] == [0xFFFFFFFF, 1 << 16, 2 << 16]


@pytest.mark.no_cover
def test_numbers_of_what_was_taken_from_nobody_do_not_return_in_a_life() -> None:
    exchange = Exchange(5)
    assert len({exchange.draw() for _ in range(200_000)}) == 200_000


def test_a_later_life_starts_elsewhere() -> None:
    first, second = (make_node(1, seed=life).exchange.draw() for life in (1, 2))
    assert first != second


def test_the_memory_names_custodian_number_and_datum(numbers: HandoverNumbers) -> None:
    numbers.accept(7, 100, X, 5)
    assert numbers.has_accepted(7, 100, X, 5)
    assert not numbers.has_accepted(8, 100, X, 5)
    assert not numbers.has_accepted(7, 101, X, 5)
    assert not numbers.has_accepted(7, 100, Y, 5)
    assert not numbers.has_accepted(7, 100, X, 6)
    numbers.forget(X)
    assert not numbers.has_accepted(7, 100, X, 5)


def test_the_memory_is_bounded_and_forgets_the_oldest(numbers: HandoverNumbers) -> None:
    for number in range(MAX_ACCEPTED + 1):
        numbers.accept(7, number, X, 5)
    assert not numbers.has_accepted(7, 0, X, 5)
    assert numbers.has_accepted(7, 1, X, 5)
    assert sum(numbers.has_accepted(7, number, X, 5) for number in range(MAX_ACCEPTED + 1)) == MAX_ACCEPTED


def test_what_was_accepted_under_a_number_is_known_by_its_checksum_too(numbers: HandoverNumbers) -> None:
    """An offer of a large datum names no more than that."""
    strong = 77 << 32 | 5
    numbers.accept(7, 100, X, strong)
    assert numbers.accepted(7, 100, X, 5) == strong
    assert not numbers.has_accepted(7, 100, X, 5), "another content"
    assert numbers.accepted(7, 100, X, 6) is None
    assert numbers.accepted(7, 100, Y, 5) is None
    assert numbers.accepted(8, 100, X, 5) is None
