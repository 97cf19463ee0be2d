"""Words between two nodes, seen by a captured drone: it has the link key and a certificate of its own, hears all that
is on the air, and can send anything in anybody's name. No word that a node has not said to another one is believed."""

from __future__ import annotations

import random
from collections.abc import Callable
from pathlib import Path

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
)
from rass_mav.core.news.statements import note_crc
from rass_mav.errors import MalformedError
from rass_mav.wire import decode
from rass_mav.wire.codec import TAG_BYTES, answer_claim
from tests.some import some
from tests.wire.samples import HELLO, NOW

from .agent_net import agent_with_keys
from .session_net import (
    BASE,
    BEACON,
    CAPTURED,
    CUSTODIAN,
    FORWARDER,
    PRINTS,
    D,
    E,
    acquainted,
    answer,
    offered,
    words,
)  # fmt: skip

PROTOCOL = Path(__file__).parents[2] / "docs" / "reference" / "protocol-keys.md"


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


def carriers(told: tuple[Committed, ...]) -> list[Message]:
    """All messages in which answers come."""
    return [*told, BEACON._replace(sender=told[0].sender, answers=told, moves=5)]


def test_what_nodes_say_to_each_other_is_believed_once() -> None:
    custodian, forwarder = acquainted(CUSTODIAN, FORWARDER)
    custodian.says(offered())
    for message in carriers((answer(),)):
        heard = custodian.believes(forwarder.says(message))
        told = heard.answers if isinstance(heard, Beacon) else (heard,)
        assert [done.committed for done in told if isinstance(done, Committed)] == [((77, D.crc),)]
    for message in words():
        payload = forwarder.says(message)
        assert custodian.believes(payload) == message
        assert custodian.believes(payload) is None, "it is repeated"
    assert custodian.tags.report() == {"unknown": 0, "forged": 0, "early": 0, "repeated": 2}


def test_each_answer_in_a_beacon_has_its_own_tag() -> None:
    custodian, forwarder, base = acquainted(CUSTODIAN, FORWARDER, BASE)
    custodian.says(offered())
    base.says(Data(BASE, FORWARDER, (Handover(5, E),)))
    told = (answer(), Committed(FORWARDER, BASE, ((5, PRINTS.of(E)),), (6,)))
    payload = forwarder.says(carriers(told)[-1])
    for hearer, index in ((custodian, 0), (base, 1)):
        heard = hearer.believes(payload)
        assert isinstance(heard, Beacon)
        assert [done.target for done in heard.answers] == [told[index].target]


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
    assert custodian.tags.report()["forged"] == len(carriers((answer(),))) - 1 + len(words())
    assert custodian.sessions.report()["beacons_refused"] == 1
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
        accepted, passed_on = node.receive(offered(), 3.0)
        assert accepted == answer(), "this very one was accepted"
        assert passed_on == CopyStatuses(FORWARDER, CUSTODIAN, (CopyStatusEntry(D.id, CopyStatus.PASSED_ON),))
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


SPEAKERS = acquainted(CUSTODIAN, FORWARDER, BASE, CAPTURED)
SAID = [SPEAKERS[1].says(message) for message in (answer(), *words())]
SPEAKERS[0].says(offered())
for _payload in SAID:
    assert SPEAKERS[0].believes(_payload)


@pytest.mark.no_cover
@given(st.data())
@settings(deadline=None, max_examples=300)
def test_nothing_that_is_altered_or_repeated_is_believed(data: st.DataObject) -> None:
    payload = data.draw(st.sampled_from(SAID))
    for change in data.draw(st.lists(st.sampled_from([flip, cut, guess, rename, redirect]), min_size=1, max_size=3)):
        if len(payload) > 5 + TAG_BYTES:
            payload = change(payload, data)
    hearer = data.draw(st.sampled_from([speaker for speaker in SPEAKERS if speaker.id != FORWARDER]))
    try:
        message = decode(payload, 0.0)
    except MalformedError:
        return
    heard = hearer.tags.believed(message, payload, 0.0)
    if type(message) in (CopyStatuses, Committed) and payload != SAID[0]:
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


def test_what_is_covered_tells_a_replica_from_custody_and_one_content_from_another() -> None:
    covered = [answer_claim(answer(datum, replica=replica)) for datum in (D, twin(D)) for replica in (False, True)]
    assert len(set(covered)) == 4
    assert len({said[:12] for said in covered}) == 1, "on the wire they are the same"


# -- golden vectors ----------------------------------------------------------------------------------------------------

HELLO_ANSWER = Committed(2, 3, ((0x01020304, PRINTS.of(HELLO)),), (0x01020305,))
GOLDEN: dict[str, Message] = {
    "committed-tagged": HELLO_ANSWER,
    "beacon-answers-tagged": BEACON._replace(sender=2, answers=(HELLO_ANSWER,)),
    "copy-statuses-tagged": CopyStatuses(2, 3, (CopyStatusEntry(HELLO.id, CopyStatus.TAKEN),)),
}


def golden(name: str) -> bytes:
    """What node 2 says to nodes 3 and 9 of the mission whose secret is 00 01 .. 1f."""
    speaker, _, _ = acquainted(2, 3, 9)
    speaker.sessions.place = 0x0A0B0C0D00000004
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
