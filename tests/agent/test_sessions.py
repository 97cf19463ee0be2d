"""Sessions, seen by the adversary: how nodes come to know each other, which frames and words are new, and what is
remembered of others, whoever repeats, invents or changes something."""

from __future__ import annotations

import random
from collections.abc import Iterator, Sequence
from typing import cast

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rass_mav.agent.agent import Agent
from rass_mav.core.messages import Data, Handover, Message
from rass_mav.errors import ForgedError
from rass_mav.lab.medium.air import open_datagram
from rass_mav.mavlink.frames import FrameWriter, Stream
from rass_mav.mavlink.signing import Signer
from rass_mav.trust import sessions
from rass_mav.trust.keys.certificate import Certificate, GroundPublic
from rass_mav.trust.sessions import MESSAGES, UNPROVEN
from rass_mav.wire import encode
from rass_mav.wire.introduction import Introduction, decode_introduction, encode_introduction, is_introduction
from tests.keyed import keyed

from .agent_net import KEY, AgentNet, agent_with_keys, beacon_of, crew_of_three, last_beacon_of, words_of
from .session_net import (
    BASE,
    BEACON,
    CAPTURED,
    CUSTODIAN,
    FORWARDER,
    STRANGER,
    STREAM,
    Air,
    D,
    Speaker,
    acquainted,
    answer,
    keys_of,
    offered,
    words,
)  # fmt: skip

TYPE = 33200

# -- how nodes come to know each other ---------------------------------------------------------------------------------


def introductions(frames: list[bytes]) -> list[bytes]:
    opened = [open_datagram(frame, 0.0) for frame in frames]
    return [one[3] for one in opened if one is not None and is_introduction(one[3])]


def test_two_nodes_believe_each_other_in_the_step_after_they_have_met() -> None:
    air = Air(Speaker(CUSTODIAN), Speaker(FORWARDER))
    air.steps(2)
    custodian, forwarder = air.speakers
    custodian.says(offered())
    assert custodian.believes(forwarder.says(answer()))
    air.steps(1)
    assert custodian.knows(FORWARDER)
    # A question with a certificate, an answer with one and a proof, a question, and a proof.
    assert len(air.introductions) <= 5
    before = len(air.introductions)
    air.steps(50)
    assert len(air.introductions) == before, "and then they are silent"


@pytest.mark.no_cover
def test_a_swarm_that_starts_as_a_whole_knows_itself_with_the_fourth_beacon() -> None:
    net = AgentNet(*(agent_with_keys(node_id) for node_id in range(1, 9)))
    net.steps(4)
    assert all(len(net.hears(position)) == 7 for position in range(8))
    heard = len(net.recorded)
    net.steps(5)
    assert not introductions(net.recorded[heard:]), "who is known is asked no more"


def test_one_round_trip_is_enough_after_a_restart() -> None:
    net = crew_of_three()
    net.restart(2)
    before = len(net.recorded)
    net.steps(3)
    assert [net.hears(position) for position in range(3)] == [{2, 3}, {1, 3}, {1, 2}]
    assert len(introductions(net.recorded[before:])) <= 7


@pytest.mark.no_cover
def test_a_node_that_was_out_of_range_for_long_introduces_itself_and_its_old_frames_stay_old() -> None:
    net = crew_of_three()
    net.deaf = {2}
    heard = last_beacon_of(2, net)
    net.steps(3)
    unheard = last_beacon_of(2, net)
    hearer = net.agents[2]
    for _ in range(10):
        net.steps(10)
        # Repetitions of what is old do not show that the node is there.
        hearer.peer_bytes(heard, net.now)
    before = len(net.recorded)
    net.deaf = set()
    net.steps(4)
    assert introductions(net.recorded[before:])
    assert net.hears(2) == {1, 2}
    known = hearer.node.routing.neighbours[2].heard
    assert not hearer.peer_bytes(unheard, net.now + 5)
    assert hearer.node.routing.neighbours[2].heard == known, "it was sent when nobody here could hear it"


def test_a_proof_counts_only_in_the_stream_of_who_makes_it() -> None:
    """A captured drone is faster than the node, and sends its proof in a stream of its own."""
    custodian, forwarder = Speaker(CUSTODIAN), Speaker(FORWARDER)
    for now in range(1, 6):
        for speaker, hearer in ((custodian, forwarder), (forwarder, custodian)):
            for payload in speaker.sessions.due(float(now)):
                if speaker is forwarder:
                    hearer.hears(decode_introduction(payload), float(now))
                hearer.is_introduced(payload, float(now), speaker.own)
            hearer.believes(speaker.says(BEACON._replace(sender=speaker.id)), float(now), speaker.own)
    assert custodian.knows(FORWARDER)
    assert custodian.sessions.quota_holder(forwarder.own) == forwarder.own
    assert custodian.sessions.quota_holder(STREAM) == UNPROVEN


@pytest.mark.no_cover
@settings(deadline=None, max_examples=30)
@given(st.lists(st.tuples(st.integers(2, 5), st.integers(0, 4), st.booleans()), max_size=25))
def test_a_node_is_heard_in_the_stream_in_which_it_has_proved_itself_last(done: list[tuple[int, int, bool]]) -> None:
    """Four nodes prove themselves in any of five streams, or are revoked and come back with another certificate."""
    hearer, now = Speaker(1), 0.0
    speakers, proven = {node_id: Speaker(node_id) for node_id in range(2, 6)}, dict[int, Stream]()
    for node_id, number, leaves in done:
        now += 10.0
        speaker = speakers[node_id]
        if leaves:
            serial = speaker.serial
            hearer.out.add((node_id, serial))
            speakers[node_id] = Speaker(node_id, serial=serial + 1, life=serial)
            hearer.knows(node_id)
            proven.pop(node_id, None)
        else:
            speaker.moves_to(20, number)
            hearer.believes(speaker.says(BEACON._replace(sender=node_id), now), now, speaker.own)
            hearer.sessions.ask(node_id, now)
            for _ in range(2):
                for one, other in ((hearer, speaker), (speaker, hearer)):
                    for payload in one.sessions.due(now):
                        other.is_introduced(payload, now, one.own)
            proven[node_id] = speaker.own
        assert not hearer.sessions.disagreement()
        known = {
            one: session.proven.stream for one in speakers if (session := hearer.sessions.get(one)) and session.proven
        }
        assert known == proven
        assert hearer.sessions.report_of_streams(now)["known"] == len(set(proven.values()))


# -- frames and words that come again ----------------------------------------------------------------------------------


def test_a_frame_is_taken_once_and_not_two_beacons_later() -> None:
    net = crew_of_three()
    hearer, teller = net.agents[0], net.agents[1]
    old = words_of(teller, 3)
    frames = [beacon_of(teller), *words_of(teller, 3)]
    before = hearer.peers.received

    def taken(*some: bytes) -> int:
        for frame in some:
            hearer.peer_bytes(frame, net.now)
        return hearer.peers.received - before

    assert taken(frames[0], frames[3], frames[1], frames[1], frames[3]) == 3, "in any order, each once"
    assert taken(old[0], frames[2], frames[1]) == 5, "a beacon has overtaken the first one"
    assert taken(beacon_of(teller)) == 6
    assert taken(old[1], frames[2], frames[1]) == 6
    refused = net.report(0)["refused"]
    assert (refused["repeated"], refused["late"]) == (5, 1)


@pytest.mark.parametrize("restarted", [(CUSTODIAN,), (FORWARDER,), (CUSTODIAN, FORWARDER)])
def test_what_was_said_before_a_restart_is_not_believed_after_it(restarted: Sequence[int]) -> None:
    custodian, forwarder = acquainted(CUSTODIAN, FORWARDER)
    heard = [forwarder.says(message) for message in words()]
    for payload in heard:
        custodian.believes(payload)
    missed = [forwarder.says(message) for message in words()]
    again = Air(*(Speaker(v.id, store=v.store, life=1) if v.id in restarted else v for v in (custodian, forwarder)))
    again.steps(20)
    custodian, forwarder = again.speakers
    assert custodian.knows(FORWARDER)
    assert [custodian.believes(payload) for payload in heard] == [None, None]
    if restarted:
        assert [custodian.believes(payload) for payload in missed] == [None, None]
    for message in words():
        assert custodian.believes(forwarder.says(message), again.now) == message


def test_a_word_may_be_overtaken_by_as_many_as_the_window_holds() -> None:
    custodian, forwarder = acquainted(CUSTODIAN, FORWARDER)
    said = [forwarder.says(words()[0]) for _ in range(2 * MESSAGES)]
    assert custodian.believes(said[-1])
    assert custodian.believes(said[0]) is None
    assert all(custodian.believes(payload) for payload in said[MESSAGES - 1 : -1])
    assert not any(custodian.believes(payload) for payload in said)


def test_old_introductions_bring_back_no_old_place() -> None:
    """A captured drone repeats all introductions of an earlier life, in any order."""
    air = Air(Speaker(CUSTODIAN), Speaker(FORWARDER))
    air.steps(5)
    old = list(air.introductions)
    said = [air.speakers[1].says(message) for message in words()]
    air.speakers[1] = Speaker(FORWARDER, store=air.speakers[1].store, life=1)
    air.steps(12)
    custodian, forwarder = air.speakers
    assert custodian.believes(forwarder.says(words()[0]), air.now), "they know each other again"
    for payload in old * 2:
        custodian.is_introduced(payload, air.now, STREAM)
        assert not any(custodian.believes(word, air.now) for word in said)
    assert custodian.believes(forwarder.says(words()[0]), air.now)


@pytest.mark.no_cover
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


def test_swapped_certificates_are_refused() -> None:
    custodian = Speaker(CUSTODIAN)
    for speaker, other in ((CUSTODIAN, FORWARDER), (FORWARDER, CAPTURED), (BASE, CUSTODIAN)):
        introduction = Introduction(speaker, keys_of(other).certificate.pack(), asked=(CUSTODIAN,), wants=True, nonce=1)
        custodian.hears(introduction, 1.0)
    assert custodian.sessions.report()["certificates"] == 0
    assert custodian.sessions.report()["forged"] == 2, "its own id is not even looked at"


def test_a_certificate_of_another_mission_or_with_a_wrong_signature_is_counted_and_dropped() -> None:
    custodian = Speaker(CUSTODIAN)
    altered = bytearray(keys_of(FORWARDER).certificate.pack())
    altered[50] ^= 1
    for packed in (keys_of(FORWARDER, ground=STRANGER).certificate.pack(), bytes(altered)):
        custodian.hears(Introduction(FORWARDER, packed, asked=(CUSTODIAN,), nonce=1), 1.0)
    assert custodian.sessions.report() == {"certificates": 0, "forged": 2, "stale": 0, "beacons_refused": 0}


def test_a_higher_serial_replaces_a_lower_one_for_good() -> None:
    air = Air(Speaker(CUSTODIAN), Speaker(FORWARDER))
    air.steps(4)
    lost = air.speakers[1]
    air.speakers[1] = Speaker(FORWARDER, serial=2, life=1)
    air.steps(12)
    custodian, new = air.speakers
    custodian.says(offered())
    assert custodian.believes(lost.says(answer())) is None
    assert custodian.believes(new.says(answer()))
    # The old one shows its certificate again, also when the sender has started again.
    old = Introduction(FORWARDER, keys_of(FORWARDER).certificate.pack(), asked=(CUSTODIAN,), wants=True, nonce=1)
    for hearer in (custodian, Speaker(CUSTODIAN, store=custodian.store, life=2)):
        hearer.hears(old, 50.0)
        assert hearer.sessions.report()["stale"] > 0
        hearer.says(offered())
        assert hearer.believes(lost.says(answer())) is None


def test_a_revoked_certificate_is_forgotten_and_refused() -> None:
    air = Air(Speaker(CUSTODIAN), Speaker(FORWARDER))
    air.steps(4)
    custodian, forwarder = air.speakers
    custodian.says(offered())
    beacon = forwarder.says(BEACON._replace(sender=FORWARDER))
    assert custodian.believes(beacon, stream=forwarder.own)
    assert custodian.believes(forwarder.says(answer()))
    custodian.out.add((FORWARDER, 1))
    assert custodian.believes(beacon, stream=forwarder.own) is None, "it is no neighbour any more"
    assert custodian.believes(forwarder.says(answer())) is None
    air.steps(20)
    assert custodian.believes(forwarder.says(answer())) is None
    air.speakers[1] = Speaker(FORWARDER, serial=2, life=1)
    air.steps(12)
    assert custodian.believes(air.speakers[1].says(answer()))


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
        payloads = custodian.sessions.due(float(step)) + custodian.sessions.due(float(step))
        sent += len(payloads)
        bytes_sent += sum(map(len, payloads))
        assert custodian.sessions.disagreement() == ""
    assert len(verified) <= 10 * (sessions.MAX_VERIFIED + sessions.LATE_VERIFIED)
    assert sent <= 10 * sessions.MAX_SENT
    certificates = sum(bool(decode_introduction(payload).certificate) for payload in custodian.sessions.due(20.0))
    assert certificates <= sessions.CERTIFICATES_AT_ONCE
    # Who has shown a certificate is not pushed out by those who have invented a name.
    assert custodian.knows(FORWARDER)
    custodian.says(offered())
    assert custodian.believes(forwarder.says(answer()))


def test_more_neighbours_than_the_table_holds_take_turns(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sessions, "MAX_PROVEN", 3)
    air = Air(*(Speaker(node_id) for node_id in (2, 3, 4, 5, 6)))
    air.steps(40)
    assert all(sum(speaker.knows(other.id) for other in air.speakers) == 3 for speaker in air.speakers)
    # Whoever it knows, it believes.
    custodian = air.speakers[0]
    known = [speaker for speaker in air.speakers[1:] if custodian.knows(speaker.id) and speaker.knows(custodian.id)]
    for speaker in known:
        custodian.says(Data(CUSTODIAN, speaker.id, (Handover(5, D),)))
        assert custodian.believes(speaker.says(answer(number=5, sender=speaker.id)))


HONEST = [((1, 191, position), 100 + position) for position in range(5)]


def named(hearer: Speaker, node_id: int, stream: Stream) -> None:
    """A beacon in the name of a node."""
    hearer.sessions.believes(BEACON._replace(sender=node_id), 0.0, stream)
    assert not hearer.sessions.disagreement()


@settings(deadline=None, max_examples=50)
@given(st.lists(st.tuples(st.integers(0, 30), st.integers(100, 130)), max_size=200), st.integers(1, 29))
def test_a_stream_brings_one_name_and_takes_none_from_another(brought: list[tuple[int, int]], every: int) -> None:
    """Invented streams bring any names, those of honest nodes too. Who speaks now and then keeps its own name."""
    hearer = Speaker(BASE)
    for at, (number, node_id) in enumerate(brought):
        if at % every == 0:
            for own, name in HONEST:
                named(hearer, name, own)
        named(hearer, node_id, (2, 191, number))
        assert all(hearer.sessions.get(name) for _, name in HONEST)


def test_streams_that_are_too_many_push_each_other_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sessions, "MAX_NAMES", 3)
    hearer = Speaker(BASE)

    def known() -> set[int]:
        return {node_id for node_id in range(2, 10) if hearer.sessions.get(node_id)}

    for node_id in (5, 6, 7, 5):
        named(hearer, node_id, (1, 1, node_id))
    assert known() == {5, 6, 7}
    for node_id, number, left in ((8, 8, {5, 7, 8}), (8, 9, {5, 8}), (4, 8, {4, 5, 8}), (9, 9, {4, 5, 9})):
        named(hearer, node_id, (1, 1, number))
        assert known() == left


@pytest.mark.no_cover
def test_junk_does_not_keep_a_certificate_from_being_verified(monkeypatch: pytest.MonkeyPatch) -> None:
    """A hundred streams bring one in each step, before the honest node."""
    verified: list[bytes] = []

    def refused(packed: bytes, ground: GroundPublic) -> Certificate:
        verified.append(packed)
        raise ForgedError("not signed")

    monkeypatch.setattr(Certificate, "unpack", refused)
    hearer, rng, true = Speaker(BASE), random.Random(1), keys_of(FORWARDER).certificate.pack()
    for step in range(400):
        before = len(verified)
        for i in range(100):
            name = rng.randrange(100, 60000)
            junk = name.to_bytes(2, "little") + rng.randbytes(100)
            hearer.hears(Introduction(name, junk, (BASE,)), float(step), (9, 9, step + i & 0xFF))
        hearer.hears(Introduction(FORWARDER, true, (BASE,)), float(step), (FORWARDER, 191, 0))
        assert not hearer.sessions.disagreement()
        assert len(verified) - before <= sessions.MAX_VERIFIED + sessions.LATE_VERIFIED
    assert verified.count(true) > 10


# -- a crowd: one captured drone in any number of streams --------------------------------------------------------------


class Crowd:
    """What the captured drone sends."""

    def __init__(self, seed: int) -> None:
        self.rng = random.Random(seed)
        self._sent = 0
        self.streams: list[Stream] = []
        """Those in which it has sent lately, the latest last."""

    def new_stream(self) -> Stream:
        self.streams.append(cast(Stream, tuple(self.rng.randbytes(3))))
        del self.streams[:-400]
        return self.streams[-1]

    def frame(self, stream: Stream, payload: bytes) -> bytes:
        self._sent += 1
        return FrameWriter(stream[0], stream[1], Signer(KEY, stream[2], self._sent)).tunnel(payload, payload_type=TYPE)

    def invented(self) -> Message:
        node_id, life = self.rng.randrange(1000, 65000), self.rng.getrandbits(32)
        return BEACON._replace(sender=node_id, life=life, number=self.rng.getrandbits(16))

    def turn(self, count: int) -> Iterator[bytes]:
        """Half of the frames are beacons, and half introductions, in streams old and new."""
        for i in range(count // 2):
            stream = self.new_stream() if i % 2 or not self.streams else self.rng.choice(self.streams)
            yield self.frame(stream, b"x")
            [beacon] = encode(self.invented(), 0.0)
            yield self.frame(self.rng.choice(self.streams), beacon)
            introduction = Introduction(self.rng.randrange(1000, 65000), self.rng.randbytes(102), (1,), True, 7)
            yield self.frame(self.rng.choice(self.streams), encode_introduction(introduction))


def crew_of(count: int) -> AgentNet:
    net = AgentNet(*(agent_with_keys(node_id, base=node_id == 1) for node_id in range(1, count + 1)))
    net.steps(10)
    assert all(len(net.hears(position)) == count - 1 for position in range(count))
    return net


def turn(net: AgentNet, crowd: Crowd, frames: int) -> None:
    """A step, with the crowd's frames before, between and after those of the net."""
    net.now += 1.0
    order: list[Agent | None] = [*net.agents, None, None]
    crowd.rng.shuffle(order)
    for one in order:
        if one is None:
            for frame in crowd.turn(frames // 2):
                for agent in net.agents:
                    agent.peer_bytes(frame, net.now)
        else:
            net.say(net.agents.index(one), one.step(net.now))


@pytest.mark.no_cover
@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.soak)])
def test_neighbours_stay_and_a_newcomer_is_known_while_a_crowd_sends(seed: int) -> None:
    net, crowd = crew_of(3), Crowd(seed)
    for _ in range(10):
        turn(net, crowd, 300)
        assert all(len(net.hears(position)) == 2 for position in range(3))
    net.agents.append(agent_with_keys(4, now=net.now))
    for _ in range(60):
        turn(net, crowd, 300)
        for position in range(3):
            assert not keyed(net.agents[position]).sessions.disagreement()
            assert net.hears(position) >= {1, 2, 3} - {position + 1}
    assert net.hears(3) == {1, 2, 3}
    assert all(4 in net.hears(position) for position in range(3))


@pytest.mark.no_cover
def test_data_reach_the_base_while_a_crowd_sends() -> None:
    net, crowd = crew_of(3), Crowd(5)
    ids = []
    for step in range(30):
        turn(net, crowd, 200)
        if step < 20:
            ids.append(net.agents[1 + step % 2].measure(net.now))
    store = net.agents[0].store
    assert all(id is not None and store.get(id) is not None for id in ids)
