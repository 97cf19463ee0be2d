"""Words between two nodes, seen by a captured drone: it has the link key and a certificate of its own, hears all that
is on the air, and can send anything in anybody's name. No word that a node has not said to another one is believed."""

from __future__ import annotations

import random
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import cast

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rass_mav.core.datum import Datum, DatumId, Fate, datum_crc, make_datum
from rass_mav.core.messages import (
    BROADCAST,
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
    Handover,
    Message,
    Offer,
    PassedOn,
)
from rass_mav.core.news.statements import note_crc
from rass_mav.core.store import Store
from rass_mav.errors import MalformedError
from rass_mav.mavlink.frames import Stream
from rass_mav.store.memory import MemoryStore
from rass_mav.trust import peers
from rass_mav.trust.candidates import LATE_VERIFIED, MAX_VERIFIED
from rass_mav.trust.keys.certificate import Certificate, GroundPublic
from rass_mav.trust.keys.identity import Ground, NodeKeys
from rass_mav.trust.keys.secret import Secret
from rass_mav.trust.pairs import PairTags, StrongContentHashes
from rass_mav.wire import MAX_TUNNEL, decode
from rass_mav.wire.codec import TAG_BYTES, answer_claim
from rass_mav.wire.introduction import Introduction, decode_introduction, encode_introduction
from tests.some import some
from tests.wire.samples import HELLO, NOW, SAMPLES

from .agent_net import AgentNet, agent_with_keys

PROTOCOL = Path(__file__).parents[2] / "docs" / "protocol.md"
BASE, CUSTODIAN, FORWARDER, CAPTURED = 1, 2, 3, 9
GROUND = Ground(Secret(bytes(range(32))))
STRANGER = Ground(Secret(bytes(32)))
PRINTS = StrongContentHashes()
#: Of the captured drone.
STREAM = (CAPTURED, 191, 0)
D = make_datum(DatumId(CUSTODIAN, 0xCAFE, 7), 0, 0.0, b"measured")
E = make_datum(DatumId(CUSTODIAN, 0xCAFE, 8), 0, 0.0, b"another")
BEACON = cast(Beacon, SAMPLES["beacon-drone"])


def keys_of(node_id: int, serial: int = 1, ground: Ground = GROUND) -> NodeKeys:
    return ground.node(node_id, 0 if node_id == BASE else serial)


def stream_of(node_id: int) -> Stream:
    """The one in which it sends."""
    return (node_id & 0xFF, 191, node_id >> 8)


class ReportComposer:
    """One node, as far as words go."""

    def __init__(self, node_id: int, *, serial: int = 1, store: Store | None = None, life: int = 0) -> None:
        self.id = node_id
        self.store = store or MemoryStore(node_id)
        self.out: set[tuple[int, int]] = set()
        """Node ids and serials that the ground has revoked."""
        rng = random.Random(f"{node_id}:{life}")
        self.tags = PairTags(keys_of(node_id, serial), lambda *named: named in self.out, self.store, rng, 1.0)
        self.own = stream_of(node_id)
        self.proved: list[tuple[int, Stream]] = []
        """The nodes that have proved themselves to this one, and in which streams."""
        self.index = 0
        self.advanced: list[tuple[int, int]] = []
        self.tags.use(self)

    def prove(self, node_id: int, stream: Stream, index: int) -> None:
        self.proved.append((node_id, stream))

    def advance(self, node_id: int, index: int) -> None:
        self.advanced.append((node_id, index))

    def forget(self, node_id: int) -> None:
        self.proved = [one for one in self.proved if one[0] != node_id]

    def begin_turn(self, number: int) -> int:
        self.index += number - self.index & 0xFFFF
        return self.index

    def says(self, message: Message, now: float = 0.0) -> bytes:
        if isinstance(message, Beacon) and message.sender == self.id:
            own = message._replace(life=self.store.life, number=self.index + 1 & 0xFFFF)
            message = self.tags.shown(own)
        [payload] = self.tags.encoded(message, self.store, now)
        assert len(payload) <= MAX_TUNNEL
        return payload

    def believes(self, payload: bytes, now: float = 0.0, stream: Stream = STREAM) -> Message | None:
        return self.tags.believed(decode(payload, now), payload, now, stream)

    def hears(self, introduction: Introduction, now: float, stream: Stream = STREAM) -> None:
        assert self.tags.introduced(encode_introduction(introduction), now, stream)

    def knows(self, other: int) -> bool:
        known = self.tags.peer_table.get(other)
        return known is not None and known.place is not None

    def unbelieved(self) -> dict[str, int]:
        counts: dict[str, int] = self.tags.report()["not_believed"]
        return counts


class Air:
    """All hear each other, in steps of a second."""

    def __init__(self, *composers: ReportComposer) -> None:
        self.composers = list(composers)
        self.now = 0.0
        self.introductions: list[bytes] = []

    def step(self) -> None:
        self.now += 1.0
        for composer in self.composers:
            payloads = composer.tags.introductions(self.now)
            self.introductions += payloads
            beacon = BEACON._replace(sender=composer.id)
            for other in self.composers:
                if other is not composer:
                    for payload in payloads:
                        assert other.tags.introduced(payload, self.now, stream_of(composer.id))
                    other.believes(composer.says(beacon, self.now), self.now, stream_of(composer.id))

    def steps(self, count: int) -> None:
        for _ in range(count):
            self.step()


def acquainted(*node_ids: int) -> list[ReportComposer]:
    air = Air(*(ReportComposer(node_id) for node_id in node_ids))
    air.steps(5)
    assert all(one.knows(other.id) for one in air.composers for other in air.composers if one is not other)
    return air.composers


def offered(datum: Datum = D, number: int = 77, *, replica: bool = False) -> Data:
    return Data(CUSTODIAN, FORWARDER, (Handover(number, datum),), replica)


def answer(datum: Datum = D, number: int = 77, *, replica: bool = False, sender: int = FORWARDER) -> Committed:
    return Committed(sender, CUSTODIAN, ((number, PRINTS.of(datum, replica=replica)),), ())


def twin(datum: Datum, seed: int = 1) -> Datum:
    """Another content with the same id and checksum, as anybody can make one. It is 8 bytes longer."""
    rng = random.Random(seed)
    # The checksum is linear: some combination of 33 changes does not change it.
    rows: dict[int, tuple[int, bytes]] = {}
    base = bytes(len(datum.payload) + 8)
    zero = datum_crc(datum.id, datum.kind, base)
    for _ in range(40):
        change = rng.randbytes(len(base))
        value = datum_crc(datum.id, datum.kind, change) ^ zero
        while value and (pivot := value.bit_length()) in rows:
            value ^= rows[pivot][0]
            change = bytes(a ^ b for a, b in zip(change, rows[pivot][1], strict=True))
        if value:
            rows[value.bit_length()] = value, change
    value, content = datum.crc ^ zero, base
    while value:
        row = rows[value.bit_length()]
        value ^= row[0]
        content = bytes(a ^ b for a, b in zip(content, row[1], strict=True))
    assert datum_crc(datum.id, datum.kind, content) == datum.crc
    return datum._replace(payload=content)


# -- what is said is believed ------------------------------------------------------------------------------------------


def words() -> list[Message]:
    entries = (CopyStatusEntry(D.id, CopyStatus.TAKEN), CopyStatusEntry(E.id, CopyStatus.NONE))
    return [PassedOn(FORWARDER, CUSTODIAN, (D.id, E.id)), CopyStatuses(FORWARDER, CUSTODIAN, entries)]


def carriers(told: tuple[Committed, ...]) -> list[Message]:
    """All messages in which answers come."""
    sender = told[0].sender
    return [
        *told,
        BEACON._replace(sender=sender, answers=told, moves=5),
        Data(sender, BASE, (Handover(5, E),), answers=told),
    ]


def test_what_nodes_say_to_each_other_is_believed_once() -> None:
    custodian, forwarder = acquainted(CUSTODIAN, FORWARDER)
    custodian.says(offered())
    for message in carriers((answer(),)):
        heard = custodian.believes(forwarder.says(message))
        told = heard.answers if isinstance(heard, Beacon | Data) else (heard,)
        assert [done.committed for done in told if isinstance(done, Committed)] == [((77, D.crc),)]
    for message in words():
        payload = forwarder.says(message)
        assert custodian.believes(payload) == message
        assert custodian.believes(payload) is None, "it is repeated"
    assert custodian.unbelieved() == {"unknown": 0, "forged": 0, "early": 0, "again": 2}


def test_each_answer_in_a_frame_has_its_own_tag() -> None:
    custodian, forwarder, base = acquainted(CUSTODIAN, FORWARDER, BASE)
    custodian.says(offered())
    base.says(Data(BASE, FORWARDER, (Handover(5, E),)))
    told = (answer(), Committed(FORWARDER, BASE, ((5, PRINTS.of(E)),), (6,)))
    for message in carriers(told)[-2:]:
        payload = forwarder.says(message)
        for hearer, index in ((custodian, 0), (base, 1)):
            heard = hearer.believes(payload)
            assert isinstance(heard, Beacon | Data)
            assert [done.target for done in heard.answers] == [told[index].target]
            if isinstance(heard, Data) and isinstance(message, Data):
                assert heard.handovers[0].datum.payload == E.payload, "the rest is heard"


def test_what_was_passed_on_is_told_to_several_holders_in_one_frame() -> None:
    composers = acquainted(FORWARDER, 1, 2, 4, 5, 6)
    message = PassedOn(FORWARDER, BROADCAST, (D.id,), (1, 2, 4, 5, 6))
    frames = composers[0].tags.encoded(message, composers[0].store, 0.0)
    assert [len(frame) for frame in frames] == [6 + 10 + 4 + 4 * 10, 6 + 10 + 4 + 10]
    for composer in composers[1:]:
        heard = [composer.believes(frame) for frame in frames]
        assert [one for one in heard if one is not None] == [message._replace(holders=())]
        assert [composer.believes(frame) for frame in frames] == [None, None]


def test_everybody_may_ask_and_no_more() -> None:
    custodian, forwarder = acquainted(CUSTODIAN, FORWARDER)
    payload = forwarder.says(
        CopyStatuses(
            FORWARDER, BROADCAST, (CopyStatusEntry(D.id, CopyStatus.WANTED), CopyStatusEntry(D.id, CopyStatus.TAKEN))
        )
    )
    heard = custodian.believes(payload)
    assert isinstance(heard, CopyStatuses)
    assert heard.entries == (CopyStatusEntry(D.id, CopyStatus.WANTED),)


def test_large_data_and_notes_are_answered_too() -> None:
    custodian, forwarder = acquainted(CUSTODIAN, FORWARDER)
    large = make_datum(DatumId(CUSTODIAN, 1, 2), 0, 0.0, bytes(5000))
    custodian.store.put(large)
    custodian.says(Offer(CUSTODIAN, FORWARDER, 6, large.id, 0, 0.0, 0, large.crc, 5000, 123))
    custodian.says(DeletionReport(CUSTODIAN, FORWARDER, (DeletionEntry(7, D.id, 1, note_crc(D.id, 1)),)))
    assert custodian.believes(forwarder.says(Committed(FORWARDER, CUSTODIAN, ((6, PRINTS.of(large)),), ())))
    assert custodian.believes(forwarder.says(Committed(FORWARDER, CUSTODIAN, ((7, PRINTS.of_note(D.id, 1)),), (6,))))
    # Of another note, and of a datum instead of the note.
    assert not custodian.believes(forwarder.says(Committed(FORWARDER, CUSTODIAN, ((7, PRINTS.of_note(E.id, 1)),), ())))
    assert not custodian.believes(forwarder.says(answer(number=7)))


# -- what a captured drone can say -------------------------------------------------------------------------------------


def test_a_captured_drone_cannot_speak_for_another() -> None:
    custodian, forwarder, captured = acquainted(CUSTODIAN, FORWARDER, CAPTURED)
    custodian.says(offered())
    for message in [*carriers((answer(),)), *words()]:
        heard = custodian.believes(captured.says(message))
        assert heard is None or not getattr(heard, "answers", ()), message
    assert custodian.unbelieved()["forged"] == len(carriers((answer(),))) - 1 + len(words())
    assert custodian.tags.report()["beacons_refused"] == 1
    # In its own name it may say that it has what it was given.
    custodian.says(Data(CUSTODIAN, CAPTURED, (Handover(78, D),)))
    assert custodian.believes(captured.says(answer(number=78, sender=CAPTURED)))
    del forwarder


def test_what_it_handed_over_in_the_name_of_another_ends_no_custody() -> None:
    """It sends another content with the same checksum, or as a replica, under the sender's number. The forwarder
    answers the sender truthfully that it has this. So the sender keeps what it has handed over."""
    custodian, forwarder = acquainted(CUSTODIAN, FORWARDER)
    custodian.says(offered())
    other = twin(D)
    assert other.crc == D.crc
    assert custodian.believes(forwarder.says(answer(other))) is None
    assert custodian.believes(forwarder.says(answer(replica=True))) is None
    assert custodian.believes(forwarder.says(answer())) is not None
    # And the other way round: no replica is counted on that is not one.
    custodian.says(offered(replica=True, number=78))
    assert custodian.believes(forwarder.says(answer(number=78))) is None
    assert custodian.believes(forwarder.says(answer(number=78, replica=True))) is not None


@pytest.mark.parametrize("base", [False, True])
def test_a_node_confirms_what_it_has_and_nothing_else(base: bool) -> None:
    """Somebody else was first to hand over a datum under the sender's number, with another content."""
    node = agent_with_keys(FORWARDER, base=base).node
    first, second = (node.receive(offered(datum), 1.0) for datum in (twin(D), D))
    assert first == [answer(twin(D))]
    assert second == [Committed(FORWARDER, CUSTODIAN, (), (77,))], "it keeps its own"
    if not base:
        # When it has passed the other one on, it takes this one, and does not just remember the number.
        node.holdings.remove(node.holdings.custody[D.id], Fate.PASSED_ON)
        assert node.receive(offered(), 2.0) == [answer()]
        stored = some(node.store.get(D.id))
        assert stored.payload == D.payload
        node.holdings.remove(node.holdings.custody[D.id], Fate.PASSED_ON)
        assert node.receive(offered(), 3.0) == [answer()], "this very one was accepted"
        assert D.id not in node.holdings


def test_what_was_overheard_is_confirmed_as_what_it_is() -> None:
    """A large datum is not sent to a node that has heard it on its way to another. If that was another content, with
    the same size and checksum, the sender does not believe the answer, and keeps its own."""
    datum = make_datum(DatumId(CUSTODIAN, 0xCAFE, 9), 0, 0.0, bytes(200))
    true, false = twin(datum), twin(datum, seed=2)
    size = len(true.payload)
    node = agent_with_keys(FORWARDER).node

    def offer(sender: int, target: int) -> Offer:
        return Offer(sender, target, 77, true.id, 0, 0.0, 0, true.crc, size, 123)

    for sender in (CUSTODIAN, CAPTURED):
        node.receive(BEACON._replace(sender=sender), 1.0)
    node.receive(offer(CAPTURED, BASE), 1.1)
    node.receive(Accept(BASE, CAPTURED, 77, 5, 0), 1.1)
    for index, part in enumerate((false.payload[:123], false.payload[123:])):
        node.receive(Chunk(BROADCAST, 5, index, False, part), 1.1)
    [told] = node.receive(offer(CUSTODIAN, FORWARDER), 1.2)
    assert told == Committed(FORWARDER, CUSTODIAN, ((77, PRINTS.of(false)),), ())
    custodian, forwarder = acquainted(CUSTODIAN, FORWARDER)
    custodian.store.put(true)
    custodian.says(offer(CUSTODIAN, FORWARDER))
    assert custodian.believes(forwarder.says(told)) is None


Change = Callable[[bytes, st.DataObject], bytes]


def flip(payload: bytes, data: st.DataObject) -> bytes:
    bit = data.draw(st.integers(0, 8 * len(payload) - 1))
    return (int.from_bytes(payload, "little") ^ 1 << bit).to_bytes(len(payload), "little")


def cut(payload: bytes, data: st.DataObject) -> bytes:
    return payload[: data.draw(st.integers(1, len(payload) - 1))]


def guess(payload: bytes, data: st.DataObject) -> bytes:
    return payload[:-TAG_BYTES] + data.draw(st.binary(min_size=TAG_BYTES, max_size=TAG_BYTES))


def rename(payload: bytes, data: st.DataObject) -> bytes:
    return payload[:1] + data.draw(st.integers(0, 65534)).to_bytes(2, "little") + payload[3:]


def redirect(payload: bytes, data: st.DataObject) -> bytes:
    return payload[:3] + data.draw(st.sampled_from([CUSTODIAN, BASE, FORWARDER])).to_bytes(2, "little") + payload[5:]


COMPOSERS = acquainted(CUSTODIAN, FORWARDER, BASE, CAPTURED)
SAID = [COMPOSERS[1].says(message) for message in (answer(), *words())]
COMPOSERS[0].says(offered())
for _payload in SAID:
    assert COMPOSERS[0].believes(_payload)


@pytest.mark.no_cover
@given(st.data())
@settings(deadline=None, max_examples=300)
def test_nothing_that_is_altered_or_repeated_is_believed(data: st.DataObject) -> None:
    payload = data.draw(st.sampled_from(SAID))
    for change in data.draw(st.lists(st.sampled_from([flip, cut, guess, rename, redirect]), min_size=1, max_size=3)):
        if len(payload) > 5 + TAG_BYTES:
            payload = change(payload, data)
    hearer = data.draw(st.sampled_from([composer for composer in COMPOSERS if composer.id != FORWARDER]))
    try:
        message = decode(payload, 0.0)
    except MalformedError:
        return
    heard = hearer.tags.believed(message, payload, 0.0, STREAM)
    if type(message) in (PassedOn, CopyStatuses, Committed) and payload != SAID[0]:
        assert not ends_something(heard)


def ends_something(heard: Message | None) -> bool:
    if isinstance(heard, CopyStatuses) and heard.target == BROADCAST:
        return any(word != CopyStatus.WANTED for _, word in heard.entries)
    return heard is not None


def test_an_answer_whose_number_is_not_known_any_more_is_not_believed() -> None:
    custodian, forwarder = acquainted(CUSTODIAN, FORWARDER)
    assert custodian.believes(forwarder.says(answer())) is None
    custodian.says(offered())
    assert custodian.believes(forwarder.says(answer())) is not None


def test_nobody_hands_anything_over_under_an_invented_name() -> None:
    custodian, forwarder, captured = acquainted(CUSTODIAN, FORWARDER, CAPTURED)
    for message in (
        offered(),
        offered(replica=True),
        Offer(CUSTODIAN, FORWARDER, 6, D.id, 0, 0.0, 0, D.crc, 5000, 123),
        DeletionReport(CUSTODIAN, FORWARDER, (DeletionEntry(7, D.id, 1, note_crc(D.id, 1)),)),
    ):
        custodian.store.put(D)
        assert forwarder.believes(custodian.says(message)) == message
        assert forwarder.believes(captured.says(message._replace(sender=1234))) is None
    # Answers that ride on it have tags of their own.
    forwarder.says(Data(FORWARDER, CAPTURED, (Handover(78, D),)))
    stranger = ReportComposer(CAPTURED)
    riding = Data(
        CAPTURED, BASE, (Handover(5, E),), answers=(answer(number=78, sender=CAPTURED)._replace(target=FORWARDER),)
    )
    heard = forwarder.believes(captured.says(riding))
    assert isinstance(heard, Data)
    assert (len(heard.handovers), len(heard.answers)) == (1, 1)
    assert ReportComposer(BASE).believes(stranger.says(riding)) is None, "it does not know the certificate"


# -- old words ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("restarted", [(CUSTODIAN,), (FORWARDER,), (CUSTODIAN, FORWARDER)])
def test_what_was_said_before_a_restart_is_not_believed_after_it(restarted: Sequence[int]) -> None:
    custodian, forwarder = acquainted(CUSTODIAN, FORWARDER)
    heard = [forwarder.says(message) for message in words()]
    for payload in heard:
        custodian.believes(payload)
    missed = [forwarder.says(message) for message in words()]
    again = Air(
        *(ReportComposer(v.id, store=v.store, life=1) if v.id in restarted else v for v in (custodian, forwarder))
    )
    again.steps(20)
    custodian, forwarder = again.composers
    assert custodian.knows(FORWARDER)
    assert [custodian.believes(payload) for payload in heard] == [None, None]
    if restarted:
        assert [custodian.believes(payload) for payload in missed] == [None, None]
    for message in words():
        assert custodian.believes(forwarder.says(message), again.now) == message


def test_a_word_may_be_overtaken_by_as_many_as_the_window_holds() -> None:
    custodian, forwarder = acquainted(CUSTODIAN, FORWARDER)
    said = [forwarder.says(words()[0]) for _ in range(peers.WINDOW + 1)]
    assert custodian.believes(said[-1])
    assert custodian.believes(said[0]) is None
    assert all(custodian.believes(payload) for payload in said[1:-1])
    assert not any(custodian.believes(payload) for payload in said)


def test_old_introductions_bring_back_no_old_place() -> None:
    """A captured drone repeats all introductions of an earlier life, in any order."""
    air = Air(ReportComposer(CUSTODIAN), ReportComposer(FORWARDER))
    air.steps(5)
    old = list(air.introductions)
    said = [air.composers[1].says(message) for message in words()]
    air.composers[1] = ReportComposer(FORWARDER, store=air.composers[1].store, life=1)
    air.steps(12)
    custodian, forwarder = air.composers
    assert custodian.believes(forwarder.says(words()[0]), air.now), "they know each other again"
    for payload in old * 2:
        custodian.tags.introduced(payload, air.now, STREAM)
        assert not any(custodian.believes(word, air.now) for word in said)
    assert custodian.believes(forwarder.says(words()[0]), air.now)


def test_data_of_any_size_are_handed_over_whoever_starts_again() -> None:
    net = AgentNet(agent_with_keys(BASE, base=True), agent_with_keys(CUSTODIAN))
    for restarted in (None, 0, 1, 1, 0):
        if restarted is not None:
            net.restart(restarted)
        net.steps(12)
        base, custodian = net.agents
        ids = [custodian.node.put(bytes(size), net.now) for size in (20, 97, 98, 5000)]
        net.steps(12)
        assert not custodian.node.holdings.custody
        assert all(base.store.get(id) is not None for id in ids)


# -- certificates ------------------------------------------------------------------------------------------------------


def test_two_nodes_believe_each_other_in_the_step_after_they_have_met() -> None:
    air = Air(ReportComposer(CUSTODIAN), ReportComposer(FORWARDER))
    air.steps(2)
    custodian, forwarder = air.composers
    custodian.says(offered())
    assert custodian.believes(forwarder.says(answer()))
    air.steps(1)
    assert custodian.knows(FORWARDER)
    # A question with a certificate, an answer with one and a proof, a question, and a proof.
    assert len(air.introductions) <= 5
    before = len(air.introductions)
    air.steps(50)
    assert len(air.introductions) == before, "and then they are silent"


def test_swapped_certificates_are_refused() -> None:
    custodian = ReportComposer(CUSTODIAN)
    for composer, other in ((CUSTODIAN, FORWARDER), (FORWARDER, CAPTURED), (BASE, CUSTODIAN)):
        introduction = Introduction(
            composer, keys_of(other).certificate.pack(), asked=(CUSTODIAN,), wants=True, nonce=1
        )
        custodian.hears(introduction, 1.0)
    assert custodian.tags.peer_table.with_certificate == 0
    assert custodian.tags.report()["forged"] == 2, "its own id is not even looked at"


def test_a_certificate_of_another_mission_or_with_a_wrong_signature_is_counted_and_dropped() -> None:
    custodian = ReportComposer(CUSTODIAN)
    altered = bytearray(keys_of(FORWARDER).certificate.pack())
    altered[50] ^= 1
    for packed in (keys_of(FORWARDER, ground=STRANGER).certificate.pack(), bytes(altered)):
        custodian.hears(Introduction(FORWARDER, packed, asked=(CUSTODIAN,), nonce=1), 1.0)
    assert custodian.tags.report() | {"not_believed": 0} == {
        "certificates": 0, "forged": 2, "stale": 0, "beacons_refused": 0, "not_believed": 0,
    }  # fmt: skip


def test_a_higher_serial_replaces_a_lower_one_for_good() -> None:
    air = Air(ReportComposer(CUSTODIAN), ReportComposer(FORWARDER))
    air.steps(4)
    lost = air.composers[1]
    air.composers[1] = ReportComposer(FORWARDER, serial=2, life=1)
    air.steps(12)
    custodian, new = air.composers
    custodian.says(offered())
    assert custodian.believes(lost.says(answer())) is None
    assert custodian.believes(new.says(answer()))
    # The old one shows its certificate again, also when the sender has started again.
    old = Introduction(FORWARDER, keys_of(FORWARDER).certificate.pack(), asked=(CUSTODIAN,), wants=True, nonce=1)
    for hearer in (custodian, ReportComposer(CUSTODIAN, store=custodian.store, life=2)):
        hearer.hears(old, 50.0)
        assert hearer.tags.report()["stale"] > 0
        hearer.says(offered())
        assert hearer.believes(lost.says(answer())) is None


def test_a_revoked_certificate_is_forgotten_and_refused() -> None:
    air = Air(ReportComposer(CUSTODIAN), ReportComposer(FORWARDER))
    air.steps(4)
    custodian, forwarder = air.composers
    custodian.says(offered())
    beacon = forwarder.says(BEACON._replace(sender=FORWARDER))
    assert custodian.believes(beacon, stream=forwarder.own)
    assert custodian.believes(forwarder.says(answer()))
    custodian.out.add((FORWARDER, 1))
    assert custodian.believes(beacon, stream=forwarder.own) is None, "it is no neighbour any more"
    assert custodian.believes(forwarder.says(answer())) is None
    air.steps(20)
    assert custodian.believes(forwarder.says(answer())) is None
    air.composers[1] = ReportComposer(FORWARDER, serial=2, life=1)
    air.steps(12)
    assert custodian.believes(air.composers[1].says(answer()))


def test_a_proof_counts_only_in_the_stream_of_who_makes_it() -> None:
    """A captured drone is faster than the node, and sends its proof in a stream of its own."""
    custodian, forwarder = ReportComposer(CUSTODIAN), ReportComposer(FORWARDER)
    for now in range(1, 6):
        for speaker, hearer in ((custodian, forwarder), (forwarder, custodian)):
            for payload in speaker.tags.introductions(float(now)):
                if speaker is forwarder:
                    hearer.hears(decode_introduction(payload), float(now))
                assert hearer.tags.introduced(payload, float(now), speaker.own)
            hearer.believes(speaker.says(BEACON._replace(sender=speaker.id)), float(now), speaker.own)
    assert custodian.knows(FORWARDER)
    assert custodian.proved == [(FORWARDER, stream_of(FORWARDER))]


# -- bounds ------------------------------------------------------------------------------------------------------------


def test_nobody_can_make_a_node_verify_answer_or_remember_without_end(monkeypatch: pytest.MonkeyPatch) -> None:
    verified: list[bytes] = []
    unpack = Certificate.unpack

    def counted(packed: bytes, ground: GroundPublic) -> Certificate:
        verified.append(packed)
        return unpack(packed, ground)

    monkeypatch.setattr(Certificate, "unpack", counted)
    custodian, forwarder = acquainted(CUSTODIAN, FORWARDER)
    rng = random.Random(3)
    sent = bytes_sent = 0
    verified.clear()
    for step in range(10, 20):
        custodian.believes(forwarder.says(BEACON._replace(sender=FORWARDER)), float(step))
        for number in range(100):
            node_id = 1000 + rng.randrange(500)
            custodian.believes(forwarder.says(BEACON._replace(sender=node_id)), float(step), (number % 7, 1, 1))
            packed = node_id.to_bytes(2, "little") + rng.randbytes(100)
            introduction = Introduction(node_id, packed, asked=(CUSTODIAN,), wants=True, nonce=number)
            custodian.hears(introduction, float(step), (number % 7, 1, 1))
        payloads = custodian.tags.introductions(float(step)) + custodian.tags.introductions(float(step))
        sent += len(payloads)
        bytes_sent += sum(map(len, payloads))
        assert len(custodian.tags.peer_table) <= 1 + 7
    assert len(verified) <= 10 * (MAX_VERIFIED + LATE_VERIFIED)
    assert sent <= 10 * peers.MAX_SENT
    certificates = sum(bool(decode_introduction(payload).certificate) for payload in custodian.tags.introductions(20.0))
    assert certificates <= peers.CERTIFICATES_AT_ONCE
    # Who has shown a certificate is not pushed out by those who have invented a name.
    assert custodian.knows(FORWARDER)
    custodian.says(offered())
    assert custodian.believes(forwarder.says(answer()))


def test_more_neighbours_than_the_table_holds_take_turns(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(peers, "MAX_KNOWN", 3)
    air = Air(*(ReportComposer(node_id) for node_id in (2, 3, 4, 5, 6)))
    air.steps(40)
    assert all(sum(composer.knows(other.id) for other in air.composers) == 3 for composer in air.composers)
    # Whoever it knows, it believes.
    custodian = air.composers[0]
    known = [
        composer for composer in air.composers[1:] if custodian.knows(composer.id) and composer.knows(custodian.id)
    ]
    for composer in known:
        custodian.says(Data(CUSTODIAN, composer.id, (Handover(5, D),)))
        assert custodian.believes(composer.says(answer(number=5, sender=composer.id)))


def test_what_is_covered_tells_a_replica_from_custody_and_one_content_from_another() -> None:
    covered = [answer_claim(answer(datum, replica=replica)) for datum in (D, twin(D)) for replica in (False, True)]
    assert len(set(covered)) == 4
    assert len({said[:12] for said in covered}) == 1, "on the wire they are the same"


# -- golden vectors ----------------------------------------------------------------------------------------------------

HELLO_ANSWER = Committed(2, 3, ((0x01020304, PRINTS.of(HELLO)),), (0x01020305,))
GOLDEN: dict[str, Message] = {
    "committed-tagged": HELLO_ANSWER,
    "data-answers-tagged": Data(2, 9, (Handover(0x01020306, HELLO),), answers=(HELLO_ANSWER,)),
    "copy-statuses-tagged": CopyStatuses(2, 3, (CopyStatusEntry(HELLO.id, CopyStatus.TAKEN),)),
    "passed-on-tagged": PassedOn(2, BROADCAST, (HELLO.id,), (3, 9)),
}


def golden(name: str) -> bytes:
    """What node 2 says to nodes 3 and 9 of the mission whose secret is 00 01 .. 1f."""
    speaker, _, _ = acquainted(2, 3, 9)
    speaker.tags.peer_table.place = 0x0A0B0C0D00000004
    return speaker.says(GOLDEN[name], NOW)


@pytest.mark.parametrize("name", GOLDEN)
def test_the_page_shows_these_bytes(name: str) -> None:
    assert f"| `{name}` | `{golden(name).hex()}` |" in PROTOCOL.read_text(encoding="utf-8")


def test_the_page_shows_a_content_hash() -> None:
    text = PROTOCOL.read_text(encoding="utf-8")
    for replica in (False, True):
        content_hash = PRINTS.of(HELLO, replica=replica)
        assert content_hash & 0xFFFFFFFF == HELLO.crc
        assert f"`{(content_hash >> 32).to_bytes(16, 'little').hex()}`" in text
