"""Signed links, seen by the adversary: nothing that he says or repeats changes a node, and nobody is locked out."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import count
from pathlib import Path
from typing import Any, cast

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common

from rass_mav.agent.agent import Agent
from rass_mav.agent.commits import CommitGate
from rass_mav.agent.outgoing import Outgoing, Way
from rass_mav.agent.peers import Peers
from rass_mav.core.alarms import Alarms
from rass_mav.core.messages import Beacon
from rass_mav.errors import StoreError
from rass_mav.lab.medium.air import open_datagram
from rass_mav.mavlink.frames import FrameReader, FrameWriter
from rass_mav.mavlink.messages import HEARTBEAT
from rass_mav.mavlink.signing import Signer
from rass_mav.store.memory import MemoryStore
from rass_mav.trust.key_updates import KeyUpdates
from rass_mav.trust.pairs import PairTags
from rass_mav.trust.sessions import Sessions
from rass_mav.trust.trust import Signed
from rass_mav.wire import decode, encode
from tests.keyed import keyed
from tests.some import some
from tests.store.store_helpers import open_store
from tests.wire.samples import NOW, SAMPLES

from .agent_net import (
    KEY,
    STRANGERS,
    STRANGERS_KEY,
    AgentNet,
    agent_with_keys,
    beacon_of,
    crew_of_three,
    last_beacon_of,
    signed_of,
    words_of,
)  # fmt: skip
from .picture import picture

TYPE = 33200
PAYLOADS = [payload for message in SAMPLES.values() for payload in encode(message, NOW)]
BEACON = cast(Beacon, SAMPLES["beacon-drone"])
#: Counters and the tables of who has proved himself are not the state of a node, nor who has asked or will be asked,
#: nor what a net is told of another node with the same id: such a one signs as this node itself.
NOT_STATE = (Sessions, FrameReader, Peers, KeyUpdates, PairTags, Alarms, Signed)


def state(agent: Agent) -> object:
    """Everything that can make a difference to what the node says or does."""
    return picture(
        [agent, agent.node, agent.store, agent.peers.system_ids, agent.peers.other_versions], without=NOT_STATE
    )


def test_a_new_frame_of_a_friend_does_change_a_node() -> None:
    """Otherwise the rest here would show nothing."""
    net = crew_of_three()
    hearer, teller = net.agents[0], net.agents[2]
    before = state(hearer)
    assert state(hearer) == before
    hearer.peer_bytes(beacon_of(teller), net.now)
    assert state(hearer) != before


# -- what no adversary can do ------------------------------------------------------------------------------------------


def test_nothing_that_is_recorded_and_repeated_changes_a_node() -> None:
    net = crew_of_three()
    for position, agent in enumerate(net.agents):
        before = state(agent)
        for frame in net.recorded:
            assert not agent.peer_bytes(frame, net.now)
        assert state(agent) == before, position


@pytest.mark.no_cover
@pytest.mark.parametrize("wiped", [False, True])
def test_nothing_recorded_changes_a_node_that_has_started_again(wiped: bool) -> None:
    net = crew_of_three()
    net.deaf = {0, 1, 2}
    net.restart(1, **({"store": MemoryStore(5)} if wiped else {}))
    agent = net.agents[1]
    before = state(agent)
    for frame in net.recorded:
        assert not agent.peer_bytes(frame, net.now)
    assert state(agent) == before
    # And the others are known again as soon as they are there.
    net.deaf = set()
    net.steps(4)
    assert net.hears(1) == {1, 3}


@pytest.mark.no_cover
@given(data=st.data())
@settings(deadline=None, max_examples=60, suppress_health_check=[HealthCheck.too_slow])
def test_no_forged_frame_changes_a_node(data: st.DataObject) -> None:
    net = AgentNet(agent_with_keys(1, base=True), agent_with_keys(2))
    net.steps(12)
    agent = net.agents[data.draw(st.integers(0, 1))]
    before = state(agent)
    for _ in range(data.draw(st.integers(1, 5))):
        way = data.draw(st.sampled_from(["unsigned", "stranger", "altered", "other timestamp", "bytes"]))
        system, component = data.draw(st.tuples(st.integers(0, 255), st.integers(0, 255)))
        payload = data.draw(st.sampled_from(PAYLOADS) | st.binary(max_size=128))
        signer = Signer(STRANGERS_KEY, data.draw(st.integers(0, 255)), data.draw(st.integers(0, 2**48 - 1)))
        recorded = bytearray(data.draw(st.sampled_from(net.recorded)))
        if way == "unsigned":
            frame = FrameWriter(system, component).tunnel(payload, payload_type=TYPE)
        elif way == "stranger":
            frame = FrameWriter(system, component, signer).tunnel(payload, payload_type=TYPE)
        elif way == "altered":
            recorded[data.draw(st.integers(0, len(recorded) - 1))] ^= data.draw(st.integers(1, 255))
            frame = bytes(recorded)
        elif way == "other timestamp":
            frame = bytes(recorded[:-12]) + data.draw(st.binary(min_size=6, max_size=6)) + bytes(recorded[-6:])
        else:
            frame = data.draw(st.binary(max_size=300))
        assert not agent.peer_bytes(frame, net.now)
    assert state(agent) == before
    # The node lives on among its own, whatever timestamps were claimed.
    net.steps(2)
    assert net.hears(0) == {2}
    assert agent.node.routing.neighbours.popitem()[1].heard == net.now


@pytest.mark.no_cover
@given(data=st.data())
@settings(deadline=None, max_examples=40)
def test_whatever_is_repeated_and_whenever_somebody_starts_again_all_find_each_other(data: st.DataObject) -> None:
    """The adversary repeats anything at any time, to anybody. It is taken once at most, and locks nobody out."""
    net = AgentNet(agent_with_keys(1, base=True), agent_with_keys(2), agent_with_keys(3))
    for _ in range(data.draw(st.integers(1, 8))):
        deed = data.draw(st.sampled_from(["steps", "restart", "wipe", "repeat", "apart"]))
        position = data.draw(st.integers(0, 2))
        if deed == "steps":
            net.steps(data.draw(st.integers(1, 6)))
        elif deed == "restart":
            net.restart(position)
        elif deed == "wipe":
            net.restart(position, store=MemoryStore(data.draw(st.integers(0, 2**32 - 1))))
        elif deed == "apart":
            net.deaf = {position}
            net.steps(data.draw(st.integers(1, 6)))
            net.deaf = set()
        elif net.recorded:
            for frame in data.draw(st.lists(st.sampled_from(net.recorded), max_size=20)):
                net.say(position, net.agents[position].peer_bytes(frame, net.now))
    net.steps(16)
    assert [net.hears(position) for position in range(3)] == [{2, 3}, {1, 3}, {1, 2}]
    for position, agent in enumerate(net.agents):
        assert all(known.heard >= net.now - 1 for known in agent.node.routing.neighbours.values()), position


def test_a_swarm_of_strangers_and_ours_do_not_see_each_other() -> None:
    net = AgentNet(agent_with_keys(1, base=True), agent_with_keys(2), agent_with_keys(3, ground=STRANGERS))
    net.steps(10)
    assert [net.hears(position) for position in range(3)] == [{2}, {1}, set()]
    assert net.report(2)["known"] == 0


# -- timestamps --------------------------------------------------------------------------------------------------------


def timestamps(frames: list[bytes], system: int) -> list[int]:
    return [int.from_bytes(frame[-12:-6], "little") for frame in frames if frame[5] == system]


@pytest.mark.no_cover
def test_a_hundred_restarts_without_a_clock_reuse_nothing_and_lock_nobody_out() -> None:
    net = AgentNet(agent_with_keys(1, base=True), agent_with_keys(2))
    for _ in range(100):
        net.restart(1)
        net.steps(4)
        assert net.hears(0) == {2}
        assert net.hears(1) == {1}
    used = timestamps(net.recorded, 2)
    assert used == sorted(set(used))


def test_who_has_lost_its_store_is_known_again_and_its_old_frames_are_not() -> None:
    """Even if nobody is left who remembers how far its timestamps had come."""
    net = AgentNet(agent_with_keys(1, base=True), agent_with_keys(2))
    net.steps(30)
    old = list(net.recorded)
    net.restart(1, store=MemoryStore(77))
    net.restart(0)
    net.steps(4)
    assert net.hears(0) == {2}
    base = net.agents[0]
    before = state(base)
    for frame in old:
        base.peer_bytes(frame, net.now)
    assert state(base) == before


def test_who_has_lost_its_timestamps_alone_is_known_again() -> None:
    """The same epoch, and so the same stream: as with an image of the card that was written back."""
    net = crew_of_three()
    net.steps(20)
    for life in range(4):
        # Each begins elsewhere, above what others have heard or below it.
        net.restart(1, store=MemoryStore(1002), life=life)
        net.steps(5)
        assert net.hears(0) == {2, 3}
        assert net.hears(1) == {1, 3}
        net.steps(1)
        assert net.agents[0].node.routing.neighbours[2].heard == net.now
    starts = [timestamp for timestamp in timestamps(net.recorded, 2) if not timestamp & 0xFFFF]
    assert starts != sorted(starts)


# -- what a captured drone cannot do: it has the link key --------------------------------------------------------------


def in_stream_of(agent: Agent, timestamp: int, payload: bytes = b"x") -> bytes:
    """A frame that somebody else has signed."""
    system, component, link = keyed(agent).sessions.own
    return FrameWriter(system, component, Signer(KEY, link, timestamp)).tunnel(payload, payload_type=TYPE)


@pytest.mark.no_cover
@pytest.mark.parametrize("restarts", [False, True])
@pytest.mark.parametrize("ahead", [1, 31, 40 << 16, 100 << 16, 1 << 46, (1 << 47) - 1, 1 << 47, (1 << 48) - 1])
def test_nobody_can_move_the_stream_of_another(ahead: int, restarts: bool) -> None:
    """Also not while it introduces itself, and not by steps."""
    net = crew_of_three()
    hearer, owner = net.agents[0], net.agents[1]
    if restarts:
        net.restart(0)
        hearer = net.agents[0]
    [beacon] = encode(BEACON._replace(sender=2, life=owner.store.life, number=7), 0.0)
    for _ in range(4):
        for payload in (b"x", beacon):
            timestamp = min(signed_of(owner).timestamps.next + ahead, (1 << 48) - 4)
            for at in range(4):
                hearer.peer_bytes(in_stream_of(owner, timestamp + at, payload), net.now)
        net.steps(1)
    net.steps(2)
    assert net.hears(0) == {2, 3}
    assert hearer.node.routing.neighbours[2].heard == net.now
    before = hearer.peers.received
    for frame in words_of(owner, 20):
        hearer.peer_bytes(frame, net.now)
    assert hearer.peers.received == before + 20
    assert signed_of(owner).timestamps.next < 1 << 40


def test_nobody_can_use_up_the_timestamps_of_another() -> None:
    """All that it could use in this turn and the next."""
    net = crew_of_three()
    hearer, owner = net.agents[0], net.agents[1]
    timestamp = signed_of(owner).timestamps.next
    for at in range(300):
        for turn in (0, 1 << 16):
            hearer.peer_bytes(in_stream_of(owner, timestamp + turn + at), net.now)
    before = hearer.peers.received
    for frame in (*words_of(owner, 50), beacon_of(owner), *words_of(owner, 50)):
        hearer.peer_bytes(frame, net.now)
    assert hearer.peers.received == before + 101


@pytest.mark.no_cover
@pytest.mark.parametrize("lead", [0, 1, 2, 16, 31, 32, 63, 64, 65, 1000, 0x7FFF])
@pytest.mark.parametrize(
    "changed", [{"turn": 0xFFFF}, {"hops": 255, "base": 0}, {"potential": 0, "free": 0}, {"life": 9}]
)
def test_a_beacon_in_the_name_of_another_changes_nothing(lead: int, changed: dict[str, Any]) -> None:
    """It is sent after the true one was heard, with the key of that one: a later one is not known."""
    net = crew_of_three()
    hearer = net.agents[0]
    for _ in range(10):
        net.steps(1)
        opened = some(open_datagram(last_beacon_of(2, net), 0.0))
        beacon = decode(opened[3], net.now)
        assert isinstance(beacon, Beacon)
        believed = hearer.node.routing.neighbours[2].beacon
        forged = beacon._replace(**{"number": beacon.number + lead & 0xFFFF, **changed})
        [payload] = encode(forged, net.now)
        timestamp = signed_of(net.agents[1]).timestamps.next + 5
        hearer.peer_bytes(in_stream_of(net.agents[1], timestamp, payload), net.now)
        assert hearer.node.routing.neighbours[2].beacon == believed
    net.steps(1)
    assert net.hears(0) == {2, 3}
    assert hearer.node.routing.neighbours[2].heard == net.now


def test_who_missed_a_beacon_believes_a_false_one_until_the_next() -> None:
    """As docs/reference/protocol.md states it: the key of a beacon does not cover what is in it."""
    net = crew_of_three()
    hearer = net.agents[0]
    net.apart = {frozenset({0, 1})}
    net.steps(1)
    net.apart = set()
    opened = some(open_datagram(last_beacon_of(2, net), 0.0))
    beacon = decode(opened[3], net.now)
    assert isinstance(beacon, Beacon)
    [payload] = encode(beacon._replace(hops=255, base=0, base_life=0, turn=0xFFFF), net.now)
    hearer.peer_bytes(in_stream_of(net.agents[1], signed_of(net.agents[1]).timestamps.next, payload), net.now)
    assert hearer.node.routing.neighbours[2].beacon.hops == 255
    net.steps(1)
    assert hearer.node.routing.neighbours[2].beacon.hops == 1
    assert hearer.node.routing.neighbours[2].turn_s == 1.0


@pytest.mark.no_cover
def test_beacons_are_believed_over_the_ends_of_chains() -> None:
    """A node that is heard now and then, over several chains of keys, and one that begins near the end of one."""
    net = crew_of_three()
    for _ in range(60):
        net.steps(40)
        assert net.hears(0) == {2, 3}
        net.deaf = {0}
        net.steps(12)
        net.deaf = set()
    assert keyed(net.agents[0]).sessions.report()["beacons_refused"] == 0


def leave(gate: CommitGate, agent: Agent, now: float) -> list[bytes]:
    return on_air(gate.say(agent.step(now)), agent)


def on_air(frames: Sequence[Outgoing], agent: Agent) -> list[bytes]:
    return [agent.peers.leaving(outgoing).frame for outgoing in frames if outgoing.way is Way.NEIGHBOURS]


@pytest.mark.parametrize("dies", ["before the write", "after the write"])
def test_no_timestamp_leaves_before_its_claim_is_on_disk(tmp_path: Path, dies: str) -> None:
    used: list[int] = []
    for life in range(4):
        store = open_store(tmp_path / "node.db", draw_epoch=count(9).__next__)
        agent = agent_with_keys(7, store, life=life)
        gate = CommitGate(store)
        held = leave(gate, agent, 1.0)
        assert held == [], "the claim is not on disk yet"
        batch = gate.begin(force=True)
        if dies == "after the write" or life % 2:
            store.write(batch)
            sent = on_air(gate.written(), agent)
            assert sent
            sent += leave(gate, agent, 2.0)
            used += timestamps(sent, 7)
        # SIGKILL: nothing else is written.
        store.abandon()
    assert used == sorted(set(used))
    assert used


def test_a_disk_that_fails_later_does_not_silence_a_node(tmp_path: Path) -> None:
    store = open_store(tmp_path / "node.db")
    agent = agent_with_keys(7, store)
    gate = CommitGate(store)
    leave(gate, agent, 1.0)
    store.write(gate.begin(force=True))
    gate.written()
    gate.begin(force=True)
    gate.failed(StoreError("no more"))
    assert all(leave(gate, agent, float(second)) for second in range(2, 200))
    store.abandon()


def test_a_claim_that_was_rolled_back_is_made_again(tmp_path: Path) -> None:
    store = open_store(tmp_path / "node.db")
    agent = agent_with_keys(7, store)
    gate = CommitGate(store)
    leave(gate, agent, 1.0)
    gate.roll_back(StoreError("a fault"))
    assert leave(gate, agent, 2.0) == []
    store.write(gate.begin(force=True))
    frames = on_air(gate.written(), agent)
    assert frames
    assert max(timestamps(frames, 7)) < (store.get_meta("timestamps") or 0)
    store.abandon()


# -- two nodes with one system and component id ------------------------------------------------------------------------


@pytest.mark.parametrize("epoch", [1002, 1003], ids=["one stream", "two streams"])
def test_a_node_takes_nothing_from_another_with_its_ids_and_says_so(epoch: int) -> None:
    twin = agent_with_keys(9, MemoryStore(epoch), mavlink={"system_id": 2})
    net = AgentNet(agent_with_keys(2), twin)
    net.steps(12)
    assert [net.hears(0), net.hears(1)] == [set(), set()]
    assert [one["node_id"] for one in net.report(0)["twins"]] == [9]
    assert [one["node_id"] for one in net.report(1)["twins"]] == [2]


def test_the_ground_station_is_told_about_a_twin(caplog: pytest.LogCaptureFixture) -> None:
    net = AgentNet(agent_with_keys(2), agent_with_keys(9, mavlink={"system_id": 2}))
    net.steps(12)
    assert "RASS: node 9 has this system id 2 and component 191: change one" in caplog.messages
    assert "RASS: node 2 has this system id 2 and component 191: change one" in caplog.messages
    assert len(caplog.messages) == 2, "not in each step"


def test_own_frames_that_come_back_are_no_twin() -> None:
    net = crew_of_three()
    for frame in net.recorded:
        net.agents[1].peer_bytes(frame, net.now)
    recorded = len(net.recorded)
    net.steps(10)
    for frame in net.recorded[recorded:]:
        net.agents[1].peer_bytes(frame, net.now)
    net.steps(2)
    assert net.report(1)["twins"] == []


# -- with pymavlink ----------------------------------------------------------------------------------------------------


def test_pymavlink_takes_what_a_node_sends_and_a_node_what_pymavlink_sends() -> None:
    """In order, a stream is as any other program expects it. Such a one takes none that is a minute behind others."""
    net = crew_of_three()
    for system in (1, 2, 3):
        theirs = common.MAVLink(None, 250, 190)
        theirs.signing.secret_key = KEY
        theirs.robust_parsing = True
        frames = [frame for frame in net.recorded if frame[5] == system]
        parsed = [message for frame in frames for message in theirs.parse_buffer(frame) or ()]
        assert [message.get_type() for message in parsed] == ["TUNNEL"] * len(frames)
        assert theirs.signing.reject_count == 0
    # pymavlink speaks in the name of node 2, with timestamps of a clock.
    speaker = common.MAVLink(None, 2, 191)
    speaker.signing.secret_key, speaker.signing.sign_outgoing, speaker.signing.timestamp = (
        KEY,
        True,
        signed_of(net.agents[1]).timestamps.next,
    )
    speaker.signing.link_id = keyed(net.agents[1]).sessions.own[2]
    base = net.agents[0]
    before = base.peers.received
    for payload in PAYLOADS:
        message = common.MAVLink_tunnel_message(0, 0, TYPE, len(payload), payload.ljust(128, b"\0"))
        base.peer_bytes(bytes(message.pack(speaker)), net.now)
    assert base.peers.received == before + len(PAYLOADS)


def test_what_waits_for_the_disk_is_not_overtaken_by_more_than_the_window(tmp_path: Path) -> None:
    """A slow disk holds back a hundred answers, and a beacon leaves before them."""
    store = open_store(tmp_path / "node.db")
    agent, hearer = agent_with_keys(7, store, base=True), agent_with_keys(8)
    gate = CommitGate(store)
    net = AgentNet(hearer)

    def commit() -> list[bytes]:
        batch = gate.begin(force=True)
        if batch is not None:
            store.write(batch)
        return on_air(gate.written(), agent)

    for second in range(1, 5):
        net.steps(1)
        for frame in [*leave(gate, agent, float(second)), *commit()]:
            hearer.peer_bytes(frame, net.now)
        for frame in net.recorded:
            agent.peer_bytes(frame, net.now)
        net.recorded.clear()
    assert net.hears(0) == {7}
    held: list[bytes] = []
    answers = [agent.peers.frames([SAMPLES["committed"]], store, 5.0)[0]._replace(promises=True) for _ in range(100)]
    store.set_meta("anything", 1)
    held += on_air(gate.say(answers), agent)
    assert held == []
    beacons = leave(gate, agent, 5.0)
    received = hearer.peers.received
    for frame in [*beacons, *commit()]:
        hearer.peer_bytes(frame, 5.0)
    assert hearer.peers.received == received + len(beacons) + 100
    store.abandon()


def test_through_the_autopilot_the_neighbours_frames_are_signed_and_no_others() -> None:
    net = crew_of_three()
    agent = net.agents[1]
    agent.share_port()
    reader = agent.vehicle_reader
    heartbeat = agent.greet_vehicle().frame
    [read] = reader.feed(heartbeat)
    assert (read.message_id, read.signed) == (HEARTBEAT, False)
    signed = beacon_of(net.agents[2])
    [read] = reader.feed(signed)
    assert read.signed
    unsigned = FrameWriter(3, 191).tunnel(PAYLOADS[0], payload_type=TYPE)
    assert reader.feed(unsigned + signed[:-1] + bytes([signed[-1] ^ 1])) == []
    assert reader.check is not None
    assert (reader.check.unsigned, reader.check.forged) == (1, 1)


def test_status_says_what_was_refused() -> None:
    net = crew_of_three()
    hearer = net.agents[0]
    again = beacon_of(net.agents[1])
    for frame in (again, again):
        hearer.peer_bytes(frame, net.now)
    report = net.report(0)
    assert (report["known"], report["twins"]) == (2, [])
    assert report["refused"]["repeated"] == 1
