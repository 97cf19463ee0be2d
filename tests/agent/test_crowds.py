"""One captured drone that sends under any number of names, in any number of streams: those who have proved themselves
stay, whoever comes finds a place, and what is remembered is bounded."""

from __future__ import annotations

import random
from collections.abc import Iterator
from typing import cast

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rass_mav.agent.agent import Agent
from rass_mav.core.messages import Beacon, Message
from rass_mav.mavlink.frames import FrameWriter, Stream
from rass_mav.mavlink.signing import Signer
from rass_mav.trust import candidates, streams
from rass_mav.trust.candidates import Candidates, Intake
from rass_mav.trust.pairs import PairTags
from rass_mav.wire import encode
from rass_mav.wire.introduction import Introduction, encode_introduction
from tests.keyed import keyed
from tests.some import some
from tests.wire.samples import SAMPLES

from .agent_net import KEY, AgentNet, agent_with_keys

TYPE = 33200
BEACON = cast(Beacon, SAMPLES["beacon-drone"])


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


def check_bounds(agent: Agent) -> None:
    signed, tags = keyed(agent).signed, keyed(agent).tags
    assert signed is not None
    assert isinstance(tags, PairTags)
    assert tags.peer_table.disagreement() == ""
    assert len(signed.streams) <= len(tags.peer_table) - len(tags.peer_table.names)


@pytest.mark.no_cover
@pytest.mark.parametrize("seed", [1, 2])
def test_neighbours_stay_and_a_newcomer_is_known_while_a_crowd_sends(seed: int) -> None:
    net, crowd = crew_of(3), Crowd(seed)
    for _ in range(10):
        turn(net, crowd, 300)
        assert all(len(net.hears(position)) == 2 for position in range(3))
    net.agents.append(agent_with_keys(4, now=net.now))
    for _ in range(60):
        turn(net, crowd, 300)
        for position in range(3):
            check_bounds(net.agents[position])
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


# -- the tables, by themselves -----------------------------------------------------------------------------------------

HONEST = [((1, 191, position), 100 + position) for position in range(5)]


@settings(deadline=None, max_examples=100)
@given(st.lists(st.tuples(st.integers(0, 30), st.integers(100, 130)), max_size=300), st.integers(1, 29))
def test_a_stream_holds_one_name_and_takes_none_from_another(brought: list[tuple[int, int]], every: int) -> None:
    """Invented streams bring any names, those of honest nodes too. Who speaks now and then keeps its own name."""
    names = Candidates()
    for at, (stream, node_id) in enumerate(brought):
        if at % every == 0:
            for own, name in HONEST:
                names.bring(name, own)
        gone = names.bring(node_id, (2, 191, stream))
        assert gone is None or (gone not in names and gone not in [name for _, name in HONEST])
        assert not names.disagreement()
    for _, name in HONEST:
        names.release(name)
        assert name not in names
        assert not names.disagreement()


@settings(deadline=None, max_examples=100)
@given(st.lists(st.tuples(st.integers(2, 6), st.integers(0, 5), st.integers(0, 2**32 - 1), st.booleans()), max_size=80))
def test_each_node_has_one_stream_and_nobody_else_moves_it(done: list[tuple[int, int, int, bool]]) -> None:
    """Five nodes prove themselves in any of six streams, or are forgotten."""
    signed = some(keyed(agent_with_keys(1)).signed)
    table, proven = signed.streams, dict[int, tuple[Stream, int]]()
    for node_id, number, index, proves in done:
        stream = (20, 191, number)
        table.admit(stream, index << 16, b"", 0.0)
        if proves:
            table.prove(node_id, stream, index)
            proven[node_id] = stream, index
        else:
            table.forget(node_id)
            proven.pop(node_id, None)
        held = {id: (stream, one.nodes[id]) for stream, one in table.proven.items() for id in one.nodes}
        assert held == proven
        assert len(table) == len({stream for stream, _ in proven.values()})


def test_what_is_remembered_of_a_stream_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(streams, "MAX_REMEMBERED", 10)
    signed = some(keyed(agent_with_keys(1)).signed)
    table, stream = signed.streams, (20, 191, 0)
    table.prove(2, stream, 5)
    for at in range(100):
        assert table.admit(stream, (5 << 16) + at, b"", 0.0) is streams.Verdict.NEW
        assert table.admit(stream, (5 << 16) + at, b"", 0.0) is streams.Verdict.AGAIN
        assert len(table.proven[stream].recent) + len(table.proven[stream].before) <= 20


def test_streams_that_are_too_many_push_each_other_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(candidates, "MAX_NAMES", 3)
    table = Candidates()
    assert [table.bring(node_id, (1, 1, node_id)) for node_id in (5, 6, 7)] == [None] * 3
    assert table.bring(5, (1, 1, 5)) is None, "it is the latest again"
    assert table.bring(8, (1, 1, 8)) == 6
    assert table.bring(8, (1, 1, 9)) == 7
    assert table.bring(4, (1, 1, 8)) is None, "another stream holds the name"
    assert table.bring(9, (1, 1, 9)) == 8
    assert len(table) == 3


def test_junk_does_not_keep_a_certificate_from_being_verified() -> None:
    """A hundred streams bring one in each step, before the honest node."""
    rng, verified = random.Random(1), 0
    intake = Intake(rng)
    for step in range(400):
        count = sum(intake.takes(rng.randrange(60000), (9, 9, step + i & 0xFF), b"junk") for i in range(100))
        assert count <= candidates.MAX_VERIFIED
        intake.takes(7, (7, 191, 0), b"true")
        assert len(intake) <= candidates.MAX_LATE
        late = intake.begin_step()
        assert len(late) <= candidates.LATE_VERIFIED
        verified += ((7, 191, 0), b"true") in late
    assert verified > 10
