"""The link key changes in flight: who gets the new one, who does not, and what an adversary can do about it."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rass_mav.agent.agent import Agent
from rass_mav.agent.peers import Peers
from rass_mav.core.messages import BROADCAST
from rass_mav.core.routes.neighbours import Neighbour
from rass_mav.errors import KeysError
from rass_mav.ground.attention.node import of_node
from rass_mav.lab.medium.air import open_datagram
from rass_mav.lab.swarm.mission import keyring_of
from rass_mav.mavlink.frames import FrameReader, FrameWriter
from rass_mav.mavlink.signing import SigningKey
from rass_mav.store.memory import MemoryStore
from rass_mav.trust.attestations import Attestations
from rass_mav.trust.key_update_table import MAX_KEY_UPDATES, KeyUpdateTable
from rass_mav.trust.key_updates import ASKED_PERIOD, LACKING_TURNS, MAX_VERIFIED, KeyUpdates
from rass_mav.trust.keys.certificate import GroundPublic
from rass_mav.trust.keys.identity import Ground
from rass_mav.trust.keys.key_updates import (
    KEY_UPDATE_SIZE,
    KeyUpdate,
    key_updates_in,
    key_updates_text,
    write_key_update,
)
from rass_mav.trust.keys.keyring import Keyring
from rass_mav.trust.keys.secret import Secret
from rass_mav.trust.sessions import Sessions
from rass_mav.trust.trust import Signed
from rass_mav.wire import encode
from rass_mav.wire.key_updates import (
    KeyRequest,
    decode_key_request,
    enclose,
    encode_key_request,
    is_about_keys,
    is_key_update,
)
from tests.core.build import beacon
from tests.extent import examples, seeds
from tests.wire.samples import NOW, SAMPLES

from .agent_net import AgentNet, agent_with_keys
from .picture import picture

TYPE = 33200
PAYLOADS = [payload for message in SAMPLES.values() for payload in encode(message, NOW)]
#: Two bases may share it, nodes 1 and 2.
GROUND = Ground(Secret(bytes(range(32))), serials={7: 1, 8: 1, 9: 1, 10: 1})
ROTATED = replace(GROUND, number=2)
REVOKED = replace(GROUND, number=2, revoked=frozenset({8}))
STRANGER = Ground(Secret(bytes(32)), number=5, serials=GROUND.serials)


class Changing(AgentNet):
    """A net whose nodes have key updates. Position 0 is base 1."""

    def __init__(self, *node_ids: int, ground: Ground = GROUND) -> None:
        super().__init__()
        self.key_updates: list[KeyUpdates] = []
        for node_id in node_ids:
            self.key_updates.append(key_updates_of(node_id, ground))
            self.agents.append(agent_with_keys(node_id, base=node_id < 7, key_updates=self.key_updates[-1]))

    def ground_changes(self, ground: Ground, position: int = 0) -> None:
        """A base takes the changed file."""
        self.key_updates[position].renew(keyring_of(ground, self.agents[position].settings.node_id))

    def restart(self, position: int, **changed: Any) -> None:
        """`key_updates`: what was kept on the disk; the same key file as at first."""
        super().restart(position, **{"key_updates": self.key_updates[position], **changed})
        if "key_updates" in changed:
            self.key_updates[position] = changed["key_updates"]

    @property
    def numbers(self) -> list[int]:
        return [key_updates.link.number for key_updates in self.key_updates]

    def payloads(self, since: int = 0) -> list[bytes]:
        """What was said about keys."""
        opened = [open_datagram(frame, 0.0) for frame in self.recorded[since:]]
        return [one[3] for one in opened if one is not None and is_about_keys(one[3])]


def key_updates_of(node_id: int, ground: Ground = GROUND, kept: Iterable[bytes] = (), life: int = 0) -> KeyUpdates:
    return KeyUpdates(keyring_of(ground, node_id), random.Random(f"{node_id}:{life}"), kept)


def state(agent: Agent) -> object:
    return picture(
        [agent, agent.node, agent.store], without=(Sessions, FrameReader, Peers, KeyUpdates, Signed, Attestations)
    )


def frame_of(payload: bytes, key: SigningKey, timestamp: int = 5, system: int = 66) -> bytes:
    """A frame by somebody with this key, in a stream that nobody knows."""
    return FrameWriter(system, 191, key.signer(3, timestamp)).tunnel(payload, payload_type=TYPE)


def key_update_to(node_id: int, ground: Ground = ROTATED) -> bytes:
    return enclose(write_key_update(ground, node_id).pack())


# -- a change ----------------------------------------------------------------------------------------------------------


def test_nothing_is_said_before_the_first_change() -> None:
    net = Changing(1, 7, 8, 9)
    net.steps(40)
    assert net.hears(0) == {7, 8, 9}
    assert net.payloads() == []
    assert net.key_updates[0].packed() == []


@pytest.mark.no_cover
def test_all_have_the_new_key_within_a_few_steps_and_go_on() -> None:
    net = Changing(1, 7, 8, 9)
    net.steps(10)
    ids = [net.agents[position].node.put(b"before", net.now) for position in (1, 2, 3)]
    net.ground_changes(ROTATED)
    ids += [net.agents[position].node.put(b"amid", net.now) for position in (1, 2, 3)]
    net.steps(12)
    assert net.numbers == [2, 2, 2, 2]
    assert [net.hears(position) for position in range(4)] == [{7, 8, 9}, {1, 8, 9}, {1, 7, 9}, {1, 7, 8}]
    ids += [net.agents[position].node.put(b"after", net.now) for position in (1, 2, 3)]
    net.steps(5)
    assert all(net.agents[0].store.get(id) is not None for id in ids)
    # And each has the key updates about all, for those that may come.
    net.steps(20)
    assert {len(key_updates.packed()) for key_updates in net.key_updates} == {4}
    before = len(net.recorded)
    net.steps(120)
    assert net.payloads(before) == [], "when all have everything, only their beacons say so"


@pytest.mark.no_cover
def test_a_revoked_drone_is_out_of_everything_and_knows_it() -> None:
    net = Changing(1, 7, 8, 9)
    net.steps(10)
    net.ground_changes(REVOKED)
    net.steps(20)
    assert net.numbers == [2, 2, 1, 2]
    assert net.key_updates[2].revoked
    for position in (0, 1, 3):
        key_updates = net.key_updates[position]
        assert key_updates.is_revoked(8, 1)
        assert not key_updates.is_revoked(8, 2)
        assert not key_updates.is_revoked(7, 1)
        assert key_updates.report(net.now)["others_revoked"] == [{"node_id": 8, "serial": 1}]
    # Whatever it has recorded, and whatever it says now, changes nobody.
    before = [state(net.agents[position]) for position in (0, 1, 3)]
    for position in (0, 1, 3):
        for frame in net.recorded:
            if frame[5] == 8:
                assert not net.agents[position].peer_bytes(frame, net.now)
    assert [state(net.agents[position]) for position in (0, 1, 3)] == before
    net.deaf = {0, 1, 3}
    net.steps(1)
    net.deaf = set()
    [beacon] = net.agents[2].peers.frames([SAMPLES["beacon-drone"]], net.agents[2].store, 0.0)
    before = [state(net.agents[position]) for position in (0, 1, 3)]
    for position in (0, 1, 3):
        for payload in [open_datagram(beacon.frame, 0.0), *PAYLOADS]:
            data = payload if isinstance(payload, bytes) else payload[3] if payload is not None else b""
            assert not net.agents[position].peer_bytes(frame_of(data, net.key_updates[2].signing, system=8), net.now)
    assert [state(net.agents[position]) for position in (0, 1, 3)] == before
    # With the next change it is out, too.
    net.ground_changes(replace(REVOKED, number=3))
    net.steps(20)
    assert net.numbers == [3, 3, 1, 3]
    # Another drone in its place has keys of its own, and is in at once.
    replaced = replace(REVOKED, number=3, serials={**GROUND.serials, 8: 2}, revoked=frozenset())
    net.ground_changes(replaced)
    net.restart(2, store=MemoryStore(88), key_updates=key_updates_of(8, replaced))
    net.steps(10)
    assert net.hears(2) == {1, 7, 9}
    net.steps(30)
    assert all(key_updates.is_revoked(8, 1) and not key_updates.is_revoked(8, 2) for key_updates in net.key_updates)


@pytest.mark.no_cover
def test_a_change_goes_from_hop_to_hop() -> None:
    net = Changing(1, 7, 8, 9, 10)
    net.apart = {frozenset((a, b)) for a in range(5) for b in range(5) if abs(a - b) > 1}
    net.steps(20)
    id = net.agents[4].node.put(b"from the far end", net.now)
    net.ground_changes(ROTATED)
    net.steps(40)
    assert net.numbers == [2] * 5
    net.steps(20)
    assert net.agents[0].store.get(id) is not None


@pytest.mark.no_cover
@given(seed=st.integers(0, 2**32), loss=st.sampled_from([0.2, 0.5]))
@settings(deadline=None, max_examples=examples(3, 320), suppress_health_check=[HealthCheck.too_slow])
def test_a_change_arrives_whatever_is_lost(seed: int, loss: float) -> None:
    rng = random.Random(seed)
    net = Changing(1, 7, 8, 9)
    net.apart = {frozenset((0, 3))}
    net.steps(10)
    net.lost = lambda: rng.random() < loss
    net.ground_changes(REVOKED)
    net.steps(900)
    assert net.numbers == [2, 2, 1, 2]
    net.lost = lambda: False
    net.steps(80)
    assert {len(net.key_updates[position].packed()) for position in (0, 1, 3)} == {4}


# -- who has missed it -------------------------------------------------------------------------------------------------


@pytest.mark.no_cover
def test_who_was_out_of_range_for_two_changes_gets_the_last_key_update_from_any_neighbour() -> None:
    net = Changing(1, 7, 8, 9)
    net.steps(10)
    net.deaf = {3}
    id = net.agents[3].node.put(b"waits", net.now)
    net.ground_changes(ROTATED)
    net.steps(60)
    net.ground_changes(replace(ROTATED, number=3))
    net.steps(60)
    assert net.numbers == [3, 3, 3, 1]
    # The base is gone, and the others were switched off since: they have everything on their disks.
    for position in (1, 2):
        kept = key_updates_in(key_updates_text(net.key_updates[position].packed()).encode(), GROUND.public)
        net.restart(position, key_updates=key_updates_of(net.agents[position].settings.node_id, kept=kept))
    assert net.numbers == [3, 3, 3, 1]
    net.deaf = {0}
    net.steps(10)
    assert net.numbers == [3, 3, 3, 3]
    assert net.hears(3) >= {7, 8}
    net.deaf = set()
    net.steps(10)
    assert net.agents[0].store.get(id) is not None


@pytest.mark.no_cover
def test_who_is_found_after_a_day_of_strangers_is_asked_at_once() -> None:
    """Frames with another key, all day: it asks now and then. A true key update is taken whenever it comes."""
    net = Changing(1, 7)
    net.deaf = {0, 1}
    net.ground_changes(ROTATED)
    junk = frame_of(b"x", SigningKey(bytes(32)))
    before = len(net.recorded)
    for _ in range(600):
        net.agents[1].peer_bytes(junk, net.now)
        net.steps(1)
    asked = [decode_key_request(payload) for payload in net.payloads(before) if not is_key_update(payload)]
    assert 600 / 8 <= sum(key_request.node_id == 7 for key_request in asked) < 600 / 8 + 5
    net.deaf = set()
    # The base has heard that somebody has an earlier key.
    net.steps(20)
    assert net.numbers == [2, 2]


def test_who_lacks_key_updates_for_long_is_offered_them_now_and_then() -> None:
    """It may have heard nothing, though its neighbour hears its beacons."""
    base = key_updates_of(1)
    base.renew(keyring_of(ROTATED, 1))
    base.due(0.0, 10)
    others = [Neighbour(beacon(7)._replace(updates=1 << 16), 0.0)]
    for _ in range(20):
        sent = [is_key_update(payload) for _ in range(LACKING_TURNS) for payload in base.turn(others)]
        assert 4 <= len(sent) <= 4 * 5
    equal = [Neighbour(beacon(7)._replace(updates=base.summary), 0.0)]
    assert not any(base.turn(equal) for _ in range(LACKING_TURNS))


def test_who_starts_again_has_the_key_from_its_key_update_and_without_it_asks() -> None:
    net = Changing(1, 7, 8)
    net.steps(5)
    net.ground_changes(ROTATED)
    net.steps(15)
    kept = net.key_updates[1].packed()
    net.restart(1, key_updates=key_updates_of(7, kept=kept))
    assert net.numbers == [2, 2, 2]
    net.steps(4)
    assert net.hears(1) == {1, 8}
    # The disk was full.
    net.restart(1, key_updates=key_updates_of(7))
    assert net.numbers == [2, 1, 2]
    net.steps(10)
    assert net.numbers == [2, 2, 2]
    # A revoked drone remembers that, too.
    net.ground_changes(replace(ROTATED, number=3, revoked=frozenset({7})))
    net.steps(20)
    assert key_updates_of(7, kept=net.key_updates[1].packed()).revoked


def test_a_file_that_is_copied_by_hand_does_the_same_and_needs_no_restart() -> None:
    net = Changing(1, 7, 8)
    net.steps(5)
    net.key_updates[1].renew(keyring_of(ROTATED, 7))
    net.steps(2)
    assert net.numbers == [1, 2, 1]
    net.ground_changes(ROTATED)
    net.steps(15)
    assert net.numbers == [2, 2, 2]
    assert net.hears(1) == {1, 8}
    for wrong, said in [
        (keyring_of(GROUND, 7), "the file now holds link key 1, and this node has 2 already; copy the newest file"),
        (keyring_of(ROTATED, 8), "the file now holds other keys; restart the node to use them"),
        (keyring_of(STRANGER, 7), "the file now holds other keys; restart the node to use them"),
    ]:
        with pytest.raises(KeysError) as caught:
            net.key_updates[1].renew(wrong)
        assert str(caught.value) == said
    net.steps(5)
    assert net.numbers == [2, 2, 2]


@pytest.mark.no_cover
def test_another_base_gets_it_over_the_air_and_lets_nobody_in_with_its_old_file() -> None:
    net = Changing(1, 2, 7, 8)
    net.apart = {frozenset((0, 3))}
    net.steps(5)
    net.ground_changes(REVOKED)
    net.steps(20)
    assert net.numbers == [2, 2, 2, 1]
    assert net.key_updates[3].revoked, "from base 2 or drone 7"
    # It starts again with the old file, and the key updates that it has kept.
    net.restart(1, key_updates=key_updates_of(2, kept=net.key_updates[1].packed()))
    assert net.numbers == [2, 2, 2, 1]
    net.steps(10)
    assert net.hears(1) == {1, 7}
    assert [KeyUpdate.unpack(packed).sealed == b"" for packed in net.key_updates[1].packed()] == [
        False,
        True,
        False,
        False,
    ]
    # Without its disk it asks as drones do. Then it has the new file.
    net.restart(1, key_updates=key_updates_of(2))
    net.steps(10)
    assert net.numbers == [2, 2, 2, 1]
    net.ground_changes(REVOKED, 1)
    net.steps(10)
    assert net.hears(1) == {1, 7}


def test_two_copies_of_the_grounds_keys_that_revoke_different_drones_are_noticed_at_both(
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Both write key updates about one number. Each lets in whom the other one has revoked."""
    net = Changing(1, 2, 7, 8, 9)
    # Each change reaches the drone that the other one revokes.
    net.apart = {frozenset(pair) for pair in [(0, 1), (0, 3), (1, 4), (2, 3), (2, 4), (3, 4)]}
    net.steps(5)
    other = replace(GROUND, number=2, revoked=frozenset({9}))
    net.ground_changes(REVOKED, 0)
    net.ground_changes(other, 1)
    net.steps(10)
    assert net.numbers == [2, 2, 2, 2, 2]
    net.apart = set()
    net.steps(20)
    # Neither of them is a neighbour any more, though both have the link key.
    assert [net.hears(position) for position in (0, 1, 2)] == [{2, 7}, {1, 7}, {1, 2}]
    assert all(key_updates.is_revoked(8, 1) and key_updates.is_revoked(9, 1) for key_updates in net.key_updates[:3])
    for drone in (8, 9):
        said = f"RASS: another copy of ground.keys has revoked or replaced drone {drone}, see how-to/keys"
        assert caplog.messages.count(said) == 1
    assert [net.key_updates[base].report(net.now)["revoked_elsewhere"] for base in (0, 1)] == [[9], [8]]
    assert [net.key_updates[drone].report(net.now)["revoked_elsewhere"] for drone in (2, 3, 4)] == [[], [], []]
    [found] = of_node({"role": "base", "key_updates": net.key_updates[0].report(net.now)})
    assert found.title == "another copy of ground.keys has revoked or replaced drone 9, this one has not"

    # The remedy: revoke it on this copy as well, and use this copy everywhere.
    both = replace(GROUND, number=3, revoked=frozenset({8, 9}))
    net.ground_changes(both, 1)
    net.steps(20)
    assert net.numbers == [3, 3, 3, 2, 2]
    net.ground_changes(both, 0)
    net.steps(10)
    assert net.hears(2) == {1, 2}
    assert [net.key_updates[base].report(net.now)["revoked_elsewhere"] for base in (0, 1)] == [[], []]


def test_a_base_that_was_replaced_by_an_old_copy_of_itself_asks_others() -> None:
    """The only base starts with the backup from before the change."""
    net = Changing(1, 7, 8)
    net.steps(5)
    net.ground_changes(REVOKED)
    net.steps(20)
    net.restart(0, store=MemoryStore(9), key_updates=key_updates_of(1))
    net.steps(15)
    assert net.numbers == [2, 2, 1]
    assert net.hears(0) == {7}
    assert net.key_updates[0].is_revoked(8, 1)


# -- the adversary -----------------------------------------------------------------------------------------------------


@pytest.mark.no_cover
@given(data=st.data())
@settings(deadline=None, max_examples=60, suppress_health_check=[HealthCheck.too_slow])
def test_nobody_but_the_ground_changes_a_key(data: st.DataObject) -> None:
    """Key updates of another ground, of an earlier change, to others, altered, cut off: in frames of strangers, of
    those with the old key, and of those with the present one."""
    net = Changing(1, 7, 8, ground=ROTATED)
    net.steps(5)
    before = [state(agent) for agent in net.agents]
    true = [key_update_to(node_id, ground) for ground in (GROUND, ROTATED, REVOKED) for node_id in (7, 8, 9)]
    later = replace(ROTATED, number=3)
    own = [key_update_to(node_id, later) for node_id in (7, 8)]
    keys = [SigningKey(bytes(32)), *(SigningKey(GROUND.link_key(number).key.reveal()) for number in (1, 2, 3))]
    for _ in range(data.draw(st.integers(1, 6))):
        way = data.draw(st.sampled_from(["true", "to others", "another ground", "altered", "cut", "bytes", "roll"]))
        if way == "true":
            payload = data.draw(st.sampled_from(true))
        elif way == "to others":
            payload = key_update_to(data.draw(st.sampled_from([9, 10])), later)
        elif way == "another ground":
            payload = key_update_to(data.draw(st.sampled_from([7, 8, 9])), STRANGER)
        elif way == "altered":
            # Where the key, the number or the name is.
            altered = bytearray(data.draw(st.sampled_from(own)))
            altered[data.draw(st.integers(2, KEY_UPDATE_SIZE - 64 + 1))] ^= data.draw(st.integers(1, 255))
            payload = bytes(altered)
        elif way == "cut":
            payload = data.draw(st.sampled_from(own))[: data.draw(st.integers(0, KEY_UPDATE_SIZE + 1))]
        elif way == "bytes":
            payload = b"\x4f" + data.draw(st.sampled_from([b"\xf8", b"\xf9"])) + data.draw(st.binary(max_size=126))
        else:
            numbers = st.integers(0, 2**32 - 1)
            payload = encode_key_request(KeyRequest(*data.draw(st.tuples(st.integers(0, 65535), numbers, numbers))))
        key, system = data.draw(st.sampled_from(keys)), data.draw(st.integers(1, 255))
        # A base knows all keys when it knows the number, so key updates to others are to it, too.
        for agent in net.agents[way == "to others" :]:
            assert not agent.peer_bytes(frame_of(payload, key, data.draw(st.integers(0, 2**40)), system), net.now)
    assert [state(agent) for agent in net.agents] == before
    net.steps(4)
    assert net.numbers == [2, 2, 2]
    assert [net.hears(position) for position in range(3)] == [{7, 8}, {1, 8}, {1, 7}]


def known_frames(net: Changing, forger: int, payloads: Iterable[bytes]) -> list[bytes]:
    """Frames of a captured drone with all its keys, in its own stream, which all know."""
    peers = net.agents[forger].peers
    out = []
    for payload in payloads:
        frame = peers.writer.tunnel(payload, payload_type=TYPE)
        out.append(peers.leaving(peers.frames([SAMPLES["beacon-drone"]], net.agents[forger].store, 0.0)[0]._replace(
            frame=frame, target=BROADCAST
        )).frame)  # fmt: skip
    return out


def counting(monkeypatch: pytest.MonkeyPatch) -> Callable[[], int]:
    """How many signatures were verified since the last call."""
    count, verify = [0], GroundPublic.verify

    def counted(self: GroundPublic, *arguments: Any) -> None:
        count[0] += 1
        verify(self, *arguments)

    def taken() -> int:
        taken, count[0] = count[0], 0
        return taken

    monkeypatch.setattr(GroundPublic, "verify", counted)
    return taken


def junk_key_updates(number: int, count: int) -> list[bytes]:
    rng = random.Random(5)
    key_updates = (
        KeyUpdate(number, rng.randrange(7, 12), rng.randrange(1, 3), rng.randbytes(48), rng.randbytes(64))
        for _ in range(count)
    )
    return [enclose(key_update.pack()) for key_update in key_updates]


@pytest.mark.no_cover
def test_ten_thousand_junk_key_updates_of_a_captured_drone_cost_a_bounded_number_of_verifications(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    net = Changing(1, 7, 8, 9)
    net.steps(10)
    taken = counting(monkeypatch)
    victim = net.agents[1]
    # Before a change and during it: with the key, and with another one.
    for number in (1, 2):
        junk = junk_key_updates(number, 2_500)
        frames = known_frames(net, 3, junk) + [frame_of(payload, SigningKey(bytes(32))) for payload in junk]
        for frame in frames:
            assert not victim.peer_bytes(frame, net.now)
        assert taken() == 0, "nothing is verified while frames come in"
        net.key_updates[1].due(net.now, 10)
        assert taken() <= MAX_VERIFIED
    assert net.key_updates[1].packed() == []
    # Amid all of that, the change comes through.
    net.ground_changes(replace(GROUND, number=2, revoked=frozenset({9})))
    net.apart = {frozenset((0, 2))}
    for _ in range(40):
        for payload in junk_key_updates(1 + net.key_updates[1].link.number % 2, 20):
            victim.peer_bytes(frame_of(payload, net.key_updates[3].signing, timestamp=7), net.now)
        net.steps(1)
    assert net.numbers == [2, 2, 2, 1]


def test_a_captured_drone_with_the_new_key_cannot_keep_key_updates_from_others(monkeypatch: pytest.MonkeyPatch) -> None:
    """It floods the relay with junk under its own name, in each step more than can be verified."""
    net = Changing(1, 7, 8, 9)
    net.apart = {frozenset((0, 2))}
    net.steps(10)
    net.ground_changes(ROTATED)
    net.deaf = {2}
    net.steps(12)
    assert net.numbers == [2, 2, 1, 2]
    without_it = [packed for packed in net.key_updates[1].packed() if KeyUpdate.unpack(packed).node_id != 8]
    net.restart(1, key_updates=key_updates_of(7, kept=without_it))
    net.deaf = set()
    taken = counting(monkeypatch)
    for _ in range(30):
        for frame in known_frames(net, 3, junk_key_updates(2, 50)):
            net.agents[1].peer_bytes(frame, net.now)
        net.steps(1)
        assert taken() <= 4 * MAX_VERIFIED
    assert net.numbers == [2, 2, 2, 2]


def test_a_true_key_under_a_false_signature_is_used_once_and_not_passed_on(monkeypatch: pytest.MonkeyPatch) -> None:
    net = Changing(1, 7, 8)
    net.steps(5)
    taken = counting(monkeypatch)
    true = write_key_update(ROTATED, 7)
    for number in range(200):
        forged = enclose(true._replace(signature=bytes([number] * 64)).pack())
        net.agents[1].peer_bytes(frame_of(forged, SigningKey(bytes(32))), net.now)
    assert taken() == 1
    net.steps(1)
    assert net.numbers == [1, 2, 1]
    assert net.key_updates[1].packed() == []
    # Its true key update comes with the others.
    net.ground_changes(ROTATED)
    net.steps(40)
    assert true.pack() in net.key_updates[1].packed()
    assert {len(key_updates.packed()) for key_updates in net.key_updates} == {4}


@pytest.mark.no_cover
def test_an_asker_without_the_key_gets_a_bounded_number_of_key_updates() -> None:
    told = []
    for asks in (0, 50):
        net = Changing(1, 7)
        net.ground_changes(replace(ROTATED, serials={**dict.fromkeys(range(100, 200), 1), **GROUND.serials}))
        net.steps(10)
        rng = random.Random(1)
        for _ in range(100):
            for _ in range(asks):
                key_request = encode_key_request(KeyRequest(rng.randrange(100, 200), 1, 1))
                for agent in net.agents:
                    agent.peer_bytes(frame_of(key_request, SigningKey(bytes(32))), net.now)
            net.steps(1)
        told.append(sum(is_key_update(payload) for payload in net.payloads()))
    # Drone 7 is to keep all 104, and some are sent twice before it has verified them.
    assert 104 <= told[0] <= 1.5 * 104
    assert told[1] <= told[0] + 2 * (1 + 100 / ASKED_PERIOD)


@pytest.mark.no_cover
@pytest.mark.parametrize("seed", seeds(2, 5))
def test_who_asks_for_the_key_updates_of_others_delays_one_that_comes_back_and_no_more(seed: int) -> None:
    """A revoked drone asks in the names of all others, in each step, for as long as it can."""
    rng = random.Random(seed)
    net = Changing(1, 7, 8, ground=replace(GROUND, serials={**dict.fromkeys(range(100, 120), 1), **GROUND.serials}))
    net.deaf = {2}
    net.steps(5)
    net.ground_changes(replace(GROUND, number=2, serials={**dict.fromkeys(range(100, 120), 1), **GROUND.serials}))
    net.steps(100)
    assert net.numbers == [2, 2, 1]
    net.deaf = set()
    for _ in range(300):
        for _ in range(40):
            key_request = encode_key_request(KeyRequest(rng.randrange(100, 120), 1, 1))
            for agent in net.agents[:2]:
                agent.peer_bytes(frame_of(key_request, net.key_updates[2].signing), net.now)
        net.steps(1)
    assert net.numbers == [2, 2, 2]


@pytest.mark.no_cover
def test_a_node_keeps_a_bounded_number_of_key_updates_and_always_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rass_mav.trust.key_update_table.MAX_KEY_UPDATES", 2)
    net = Changing(1, 9, 10)
    net.steps(5)
    net.ground_changes(ROTATED)
    net.steps(100)
    assert net.numbers == [2, 2, 2]
    for position, node_id in ((1, 9), (2, 10)):
        kept = [KeyUpdate.unpack(packed).node_id for packed in net.key_updates[position].packed()]
        assert len(kept) <= 3
        assert node_id in kept
    assert MAX_KEY_UPDATES * KEY_UPDATE_SIZE < 130_000


def test_a_revocation_always_finds_its_place(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rass_mav.trust.key_update_table.MAX_KEY_UPDATES", 2)
    ground = replace(ROTATED, revoked=frozenset({8, 10}))
    table = KeyUpdateTable(9, 2)
    assert table.keep(write_key_update(ground, 9), own=True)
    assert table.keep(write_key_update(ground, 7))
    assert table.keep(write_key_update(ground, 8)), "it displaces the one to drone 7"
    assert not table.keep(write_key_update(ground, 7))
    assert not table.keep(write_key_update(ground, 10)), "the other one revokes too, or is the node's own"
    assert table.out() == {8: 1}
    assert table.get(9) is not None


def test_a_key_update_waits_for_no_stream_to_be_known() -> None:
    """A drone that starts again among those with the new key gets it before it knows anybody."""
    net = Changing(1, 7)
    net.ground_changes(ROTATED)
    net.steps(3)
    keyring = Keyring(GROUND.node(8, 1), None)
    net.key_updates.append(KeyUpdates(keyring, random.Random(1)))
    net.agents.append(agent_with_keys(8, key_updates=net.key_updates[-1], now=net.now))
    net.steps(4)
    assert net.numbers == [2, 2, 2]
