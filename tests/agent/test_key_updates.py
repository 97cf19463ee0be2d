"""The link key changes in flight: who gets the new one, who does not, and what an adversary can do about it."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterable
from dataclasses import replace
from itertools import islice
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rass_mav.agent.agent import Agent
from rass_mav.agent.peers import Peers, open_datagram
from rass_mav.commands.status import status_lines
from rass_mav.core.messages import BROADCAST
from rass_mav.errors import KeysError
from rass_mav.lab.swarm.mission import keyring_of
from rass_mav.mavlink.frames import FrameWriter
from rass_mav.mavlink.reader import FrameReader
from rass_mav.mavlink.signing import SigningKey
from rass_mav.store.memory import MemoryStore
from rass_mav.trust.attestations import Attestations
from rass_mav.trust.key_update_table import MAX_ASKED, MAX_KEY_UPDATES
from rass_mav.trust.key_updates import MAX_VERIFIED, KeyUpdates
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
from rass_mav.trust.signed import Signed
from rass_mav.trust.streams import Streams
from rass_mav.wire import encode
from rass_mav.wire.key_updates import (
    KeySummary,
    decode_key_summary,
    enclose,
    encode_key_summary,
    is_about_keys,
    is_key_update,
)
from tests.extent import examples, seeds
from tests.wire.samples import NOW, SAMPLES

from .agent_net import Crew, agent_with_keys
from .picture import picture

TYPE = 33200
PAYLOADS = [payload for message in SAMPLES.values() for payload in encode(message, NOW)]
#: Two bases may share it, nodes 1 and 2.
GROUND = Ground(Secret(bytes(range(32))), serials={7: 1, 8: 1, 9: 1, 10: 1})
ROTATED = replace(GROUND, number=2)
REVOKED = replace(GROUND, number=2, revoked=frozenset({8}))
STRANGER = Ground(Secret(bytes(32)), number=5, serials=GROUND.serials)


class Changing(Crew):
    """A crew whose nodes have key updates. Position 0 is base 1."""

    def __init__(self, *node_ids: int, ground: Ground = GROUND, words: bool = False) -> None:
        """`words`: see `agent_with_keys`."""
        super().__init__()
        self.key_updates: list[KeyUpdates] = []
        for node_id in node_ids:
            self.key_updates.append(key_updates_of(node_id, ground))
            self.agents.append(
                agent_with_keys(node_id, base=node_id < 7, key_updates=self.key_updates[-1], words=words)
            )

    def ground_changes(self, ground: Ground, position: int = 0) -> None:
        """A base takes the changed file."""
        self.key_updates[position].renew(keyring_of(ground, self.agents[position].settings.node_id))

    def restart(self, position: int, **changed: Any) -> None:
        """`key_updates`: what was kept on the disk; the same file of keys as at first."""
        super().restart(position, **{"key_updates": self.key_updates[position], **changed})
        if "key_updates" in changed:
            self.key_updates[position] = changed["key_updates"]

    @property
    def numbers(self) -> list[int]:
        return [key_updates.link.number for key_updates in self.key_updates]

    def payloads(self, since: int = 0) -> list[bytes]:
        """What was said about keys."""
        opened = [open_datagram(frame) for frame in self.recorded[since:]]
        return [one[3] for one in opened if one is not None and is_about_keys(one[3])]


def key_updates_of(node_id: int, ground: Ground = GROUND, kept: Iterable[bytes] = (), life: int = 0) -> KeyUpdates:
    return KeyUpdates(keyring_of(ground, node_id), random.Random(f"{node_id}:{life}"), 1.0, kept)


def state(agent: Agent) -> object:
    return picture(
        [agent, agent.node, agent.store], without=(Streams, FrameReader, Peers, KeyUpdates, Signed, Attestations)
    )


def frame_of(payload: bytes, key: SigningKey, timestamp: int = 5, system: int = 66) -> bytes:
    """A frame by somebody with this key, in a stream that nobody knows."""
    return FrameWriter(system, 191, key.signer(3, timestamp)).tunnel(payload, payload_type=TYPE)


def key_update_to(node_id: int, ground: Ground = ROTATED) -> bytes:
    return enclose(write_key_update(ground, node_id).pack())


# -- a change ----------------------------------------------------------------------------------------------------------


def test_nothing_is_said_before_the_first_change() -> None:
    crew = Changing(1, 7, 8, 9)
    crew.steps(40)
    assert crew.hears(0) == {7, 8, 9}
    assert crew.payloads() == []
    assert crew.key_updates[0].packed() == []


def test_all_have_the_new_key_within_a_few_steps_and_go_on() -> None:
    crew = Changing(1, 7, 8, 9)
    crew.steps(10)
    ids = [crew.agents[position].node.put(b"before", crew.now) for position in (1, 2, 3)]
    crew.ground_changes(ROTATED)
    ids += [crew.agents[position].node.put(b"amid", crew.now) for position in (1, 2, 3)]
    crew.steps(12)
    assert crew.numbers == [2, 2, 2, 2]
    assert [crew.hears(position) for position in range(4)] == [{7, 8, 9}, {1, 8, 9}, {1, 7, 9}, {1, 7, 8}]
    ids += [crew.agents[position].node.put(b"after", crew.now) for position in (1, 2, 3)]
    crew.steps(5)
    assert all(crew.agents[0].store.get(id) is not None for id in ids)
    # And each has the key updates about all, for those that may come.
    crew.steps(20)
    assert {len(key_updates.packed()) for key_updates in crew.key_updates} == {4}
    before = len(crew.recorded)
    crew.steps(120)
    said = crew.payloads(before)
    assert len(said) <= 4 * 4, "when all have everything, they send short key summaries, about one in a minute each"
    assert {len(payload) for payload in said} == {21}


def test_a_revoked_drone_is_out_of_everything_and_knows_it() -> None:
    crew = Changing(1, 7, 8, 9)
    crew.steps(10)
    crew.ground_changes(REVOKED)
    crew.steps(20)
    assert crew.numbers == [2, 2, 1, 2]
    assert crew.key_updates[2].revoked
    for position in (0, 1, 3):
        key_updates = crew.key_updates[position]
        assert key_updates.is_revoked(8, 1)
        assert not key_updates.is_revoked(8, 2)
        assert not key_updates.is_revoked(7, 1)
        assert key_updates.report(crew.now)["out"] == [{"node_id": 8, "serial": 1}]
    # Whatever it has recorded, and whatever it says now, changes nobody.
    before = [state(crew.agents[position]) for position in (0, 1, 3)]
    for position in (0, 1, 3):
        for frame in crew.recorded:
            if frame[5] == 8:
                assert not crew.agents[position].peer_bytes(frame, crew.now)
    assert [state(crew.agents[position]) for position in (0, 1, 3)] == before
    crew.deaf = {0, 1, 3}
    crew.steps(1)
    crew.deaf = set()
    [beacon] = crew.agents[2].peers.frames([SAMPLES["beacon-drone"]], crew.agents[2].store, 0.0)
    before = [state(crew.agents[position]) for position in (0, 1, 3)]
    for position in (0, 1, 3):
        for payload in [open_datagram(beacon.frame), *PAYLOADS]:
            data = payload if isinstance(payload, bytes) else payload[3] if payload is not None else b""
            assert not crew.agents[position].peer_bytes(frame_of(data, crew.key_updates[2].signing, system=8), crew.now)
    assert [state(crew.agents[position]) for position in (0, 1, 3)] == before
    # With the next change it is out, too.
    crew.ground_changes(replace(REVOKED, number=3))
    crew.steps(20)
    assert crew.numbers == [3, 3, 1, 3]
    # Another drone in its place has keys of its own, and is in at once.
    replaced = replace(REVOKED, number=3, serials={**GROUND.serials, 8: 2}, revoked=frozenset())
    crew.ground_changes(replaced)
    crew.restart(2, store=MemoryStore(88), key_updates=key_updates_of(8, replaced))
    crew.steps(10)
    assert crew.hears(2) == {1, 7, 9}
    crew.steps(30)
    assert all(key_updates.is_revoked(8, 1) and not key_updates.is_revoked(8, 2) for key_updates in crew.key_updates)


def test_a_change_goes_from_hop_to_hop() -> None:
    crew = Changing(1, 7, 8, 9, 10)
    crew.apart = {frozenset((a, b)) for a in range(5) for b in range(5) if abs(a - b) > 1}
    crew.steps(20)
    id = crew.agents[4].node.put(b"from the far end", crew.now)
    crew.ground_changes(ROTATED)
    crew.steps(40)
    assert crew.numbers == [2] * 5
    crew.steps(20)
    assert crew.agents[0].store.get(id) is not None


@pytest.mark.no_cover
@given(seed=st.integers(0, 2**32), loss=st.sampled_from([0.2, 0.5]))
@settings(deadline=None, max_examples=examples(3, 320), suppress_health_check=[HealthCheck.too_slow])
def test_a_change_arrives_whatever_is_lost(seed: int, loss: float) -> None:
    rng = random.Random(seed)
    crew = Changing(1, 7, 8, 9)
    crew.apart = {frozenset((0, 3))}
    crew.steps(10)
    crew.lost = lambda: rng.random() < loss
    crew.ground_changes(REVOKED)
    crew.steps(900)
    assert crew.numbers == [2, 2, 1, 2]
    crew.lost = lambda: False
    crew.steps(80)
    assert {len(crew.key_updates[position].packed()) for position in (0, 1, 3)} == {4}


# -- who has missed it -------------------------------------------------------------------------------------------------


def test_who_was_out_of_range_for_two_changes_gets_the_last_key_update_from_any_neighbour() -> None:
    crew = Changing(1, 7, 8, 9)
    crew.steps(10)
    crew.deaf = {3}
    id = crew.agents[3].node.put(b"waits", crew.now)
    crew.ground_changes(ROTATED)
    crew.steps(60)
    crew.ground_changes(replace(ROTATED, number=3))
    crew.steps(60)
    assert crew.numbers == [3, 3, 3, 1]
    # The base is gone, and the others were switched off since: they have everything on their disks.
    for position in (1, 2):
        kept = key_updates_in(key_updates_text(crew.key_updates[position].packed()).encode(), GROUND.public)
        crew.restart(position, key_updates=key_updates_of(crew.agents[position].settings.node_id, kept=kept))
    assert crew.numbers == [3, 3, 3, 1]
    crew.deaf = {0}
    crew.steps(10)
    assert crew.numbers == [3, 3, 3, 3]
    assert crew.hears(3) >= {7, 8}
    crew.deaf = set()
    crew.steps(10)
    assert crew.agents[0].store.get(id) is not None


def test_who_is_found_after_a_day_of_strangers_is_asked_at_once() -> None:
    """Frames with another key, all day: it asks, more and more rarely. A true key update is taken whenever it comes."""
    crew = Changing(1, 7)
    crew.deaf = {0, 1}
    crew.ground_changes(ROTATED)
    junk = frame_of(b"x", SigningKey(bytes(32)))
    before = len(crew.recorded)
    for _ in range(600):
        crew.agents[1].peer_bytes(junk, crew.now)
        crew.steps(1)
    asked = [decode_key_summary(payload) for payload in crew.payloads(before) if not is_key_update(payload)]
    assert 600 / 16 <= sum(key_summary.node_id == 7 for key_summary in asked) < 600 / 16 + 5
    crew.deaf = set()
    # The base has heard that somebody has an earlier key.
    crew.steps(20)
    assert crew.numbers == [2, 2]


def test_who_starts_again_has_the_key_from_its_key_update_and_without_it_asks() -> None:
    crew = Changing(1, 7, 8)
    crew.steps(5)
    crew.ground_changes(ROTATED)
    crew.steps(15)
    kept = crew.key_updates[1].packed()
    crew.restart(1, key_updates=key_updates_of(7, kept=kept))
    assert crew.numbers == [2, 2, 2]
    crew.steps(4)
    assert crew.hears(1) == {1, 8}
    # The disk was full.
    crew.restart(1, key_updates=key_updates_of(7))
    assert crew.numbers == [2, 1, 2]
    crew.steps(10)
    assert crew.numbers == [2, 2, 2]
    # A revoked drone remembers that, too.
    crew.ground_changes(replace(ROTATED, number=3, revoked=frozenset({7})))
    crew.steps(20)
    assert key_updates_of(7, kept=crew.key_updates[1].packed()).revoked


def test_a_file_that_is_copied_by_hand_does_the_same_and_needs_no_restart() -> None:
    crew = Changing(1, 7, 8)
    crew.steps(5)
    crew.key_updates[1].renew(keyring_of(ROTATED, 7))
    crew.steps(2)
    assert crew.numbers == [1, 2, 1]
    crew.ground_changes(ROTATED)
    crew.steps(15)
    assert crew.numbers == [2, 2, 2]
    assert crew.hears(1) == {1, 8}
    for wrong, said in [
        (keyring_of(GROUND, 7), "the file now holds link key 1, and this node has 2 already; copy the newest file"),
        (keyring_of(ROTATED, 8), "the file now holds other keys; restart the node to use them"),
        (keyring_of(STRANGER, 7), "the file now holds other keys; restart the node to use them"),
    ]:
        with pytest.raises(KeysError) as caught:
            crew.key_updates[1].renew(wrong)
        assert str(caught.value) == said
    crew.steps(5)
    assert crew.numbers == [2, 2, 2]


def test_another_base_gets_it_over_the_air_and_lets_nobody_in_with_its_old_file() -> None:
    crew = Changing(1, 2, 7, 8)
    crew.apart = {frozenset((0, 3))}
    crew.steps(5)
    crew.ground_changes(REVOKED)
    crew.steps(20)
    assert crew.numbers == [2, 2, 2, 1]
    assert crew.key_updates[3].revoked, "from base 2 or drone 7"
    # It starts again with the old file, and the key updates that it has kept.
    crew.restart(1, key_updates=key_updates_of(2, kept=crew.key_updates[1].packed()))
    assert crew.numbers == [2, 2, 2, 1]
    crew.steps(10)
    assert crew.hears(1) == {1, 7}
    assert [KeyUpdate.unpack(packed).sealed == b"" for packed in crew.key_updates[1].packed()] == [
        False,
        True,
        False,
        False,
    ]
    # Without its disk it asks as drones do. Then it has the new file.
    crew.restart(1, key_updates=key_updates_of(2))
    crew.steps(10)
    assert crew.numbers == [2, 2, 2, 1]
    crew.ground_changes(REVOKED, 1)
    crew.steps(10)
    assert crew.hears(1) == {1, 7}


def test_two_copies_of_the_grounds_keys_that_revoke_different_drones_are_noticed_at_both(
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Both write key updates about one number. Each lets in whom the other one has revoked."""
    crew = Changing(1, 2, 7, 8, 9)
    # Each change reaches the drone that the other one revokes.
    crew.apart = {frozenset(pair) for pair in [(0, 1), (0, 3), (1, 4), (2, 3), (2, 4), (3, 4)]}
    crew.steps(5)
    other = replace(GROUND, number=2, revoked=frozenset({9}))
    crew.ground_changes(REVOKED, 0)
    crew.ground_changes(other, 1)
    crew.steps(10)
    assert crew.numbers == [2, 2, 2, 2, 2]
    crew.apart = set()
    crew.steps(20)
    # Neither of them is a neighbour any more, though both have the link key.
    assert [crew.hears(position) for position in (0, 1, 2)] == [{2, 7}, {1, 7}, {1, 2}]
    assert all(key_updates.is_revoked(8, 1) and key_updates.is_revoked(9, 1) for key_updates in crew.key_updates[:3])
    for drone in (8, 9):
        said = f"RASS: another copy of ground.keys has revoked or replaced drone {drone}, see docs/keys.md"
        assert caplog.messages.count(said) == 1
    assert [crew.key_updates[base].report(crew.now)["out_elsewhere"] for base in (0, 1)] == [[9], [8]]
    assert [crew.key_updates[drone].report(crew.now)["out_elsewhere"] for drone in (2, 3, 4)] == [[], [], []]
    status = {"node_id": 1, "role": "base", "epoch": "1", "uptime_s": 1.0, "steps": 1, "keys": None}
    lines = status_lines({**status, "letters": crew.key_updates[0].report(crew.now)})
    assert "WARNING: another copy of ground.keys has revoked or replaced drone 9, this one has not" in islice(lines, 4)

    # The remedy: revoke it on this copy as well, and use this copy everywhere.
    both = replace(GROUND, number=3, revoked=frozenset({8, 9}))
    crew.ground_changes(both, 1)
    crew.steps(20)
    assert crew.numbers == [3, 3, 3, 2, 2]
    crew.ground_changes(both, 0)
    crew.steps(10)
    assert crew.hears(2) == {1, 2}
    assert [crew.key_updates[base].report(crew.now)["out_elsewhere"] for base in (0, 1)] == [[], []]


def test_a_base_that_was_replaced_by_an_old_copy_of_itself_asks_others() -> None:
    """The only base starts with the backup from before the change."""
    crew = Changing(1, 7, 8)
    crew.steps(5)
    crew.ground_changes(REVOKED)
    crew.steps(20)
    crew.restart(0, store=MemoryStore(9), key_updates=key_updates_of(1))
    crew.steps(15)
    assert crew.numbers == [2, 2, 1]
    assert crew.hears(0) == {7}
    assert crew.key_updates[0].is_revoked(8, 1)


# -- the adversary -----------------------------------------------------------------------------------------------------


@given(data=st.data())
@settings(deadline=None, max_examples=60, suppress_health_check=[HealthCheck.too_slow])
def test_nobody_but_the_ground_changes_a_key(data: st.DataObject) -> None:
    """Key updates of another ground, of an earlier change, to others, altered, cut off: in frames of strangers, of
    those with the old key, and of those with the present one."""
    crew = Changing(1, 7, 8, ground=ROTATED)
    crew.steps(5)
    before = [state(agent) for agent in crew.agents]
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
            payload = b"\x2f" + data.draw(st.sampled_from([b"\xf8", b"\xf9"])) + data.draw(st.binary(max_size=126))
        else:
            numbers = st.integers(0, 2**32 - 1)
            named = data.draw(st.dictionaries(st.integers(0, 65535), st.integers(0, 255), max_size=35))
            key_summary = KeySummary(
                *data.draw(st.tuples(st.integers(0, 65535), numbers, numbers, numbers)), 0, 65535, named
            )
            payload = encode_key_summary(key_summary)
        key, system = data.draw(st.sampled_from(keys)), data.draw(st.integers(1, 255))
        # A base knows all keys when it knows the number, so key updates to others are to it, too.
        for agent in crew.agents[way == "to others" :]:
            assert not agent.peer_bytes(frame_of(payload, key, data.draw(st.integers(0, 2**40)), system), crew.now)
    assert [state(agent) for agent in crew.agents] == before
    crew.steps(4)
    assert crew.numbers == [2, 2, 2]
    assert [crew.hears(position) for position in range(3)] == [{7, 8}, {1, 8}, {1, 7}]


def known_frames(crew: Changing, forger: int, payloads: Iterable[bytes]) -> list[bytes]:
    """Frames of a captured drone with all its keys, in its own stream, which all know."""
    peers = crew.agents[forger].peers
    out = []
    for payload in payloads:
        frame = peers.writer.tunnel(payload, payload_type=TYPE)
        out.append(peers.leaving(peers.frames([SAMPLES["beacon-drone"]], crew.agents[forger].store, 0.0)[0]._replace(
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


def test_ten_thousand_junk_key_updates_of_a_captured_drone_cost_a_bounded_number_of_verifications(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    crew = Changing(1, 7, 8, 9)
    crew.steps(10)
    taken = counting(monkeypatch)
    victim = crew.agents[1]
    # Before a change and during it: with the key, and with another one.
    for number in (1, 2):
        junk = junk_key_updates(number, 2_500)
        frames = known_frames(crew, 3, junk) + [frame_of(payload, SigningKey(bytes(32))) for payload in junk]
        for frame in frames:
            assert not victim.peer_bytes(frame, crew.now)
        assert taken() == 0, "nothing is verified while frames come in"
        crew.key_updates[1].due(crew.now, 1.0, 10)
        assert taken() <= MAX_VERIFIED
    assert crew.key_updates[1].packed() == []
    # Amid all of that, the change comes through.
    crew.ground_changes(replace(GROUND, number=2, revoked=frozenset({9})))
    crew.apart = {frozenset((0, 2))}
    for _ in range(40):
        for payload in junk_key_updates(1 + crew.key_updates[1].link.number % 2, 20):
            victim.peer_bytes(frame_of(payload, crew.key_updates[3].signing, timestamp=7), crew.now)
        crew.steps(1)
    assert crew.numbers == [2, 2, 2, 1]


def test_a_captured_drone_with_the_new_key_cannot_keep_key_updates_from_others(monkeypatch: pytest.MonkeyPatch) -> None:
    """It floods the relay with junk under its own name, in each step more than can be verified."""
    crew = Changing(1, 7, 8, 9)
    crew.apart = {frozenset((0, 2))}
    crew.steps(10)
    crew.ground_changes(ROTATED)
    crew.deaf = {2}
    crew.steps(12)
    assert crew.numbers == [2, 2, 1, 2]
    crew.key_updates[1]._table._key_updates.pop(8, None)
    crew.key_updates[1]._table.use(2)
    crew.deaf = set()
    taken = counting(monkeypatch)
    for _ in range(30):
        for frame in known_frames(crew, 3, junk_key_updates(2, 50)):
            crew.agents[1].peer_bytes(frame, crew.now)
        crew.steps(1)
        assert taken() <= 4 * MAX_VERIFIED
    assert crew.numbers == [2, 2, 2, 2]


def test_a_true_key_under_a_false_signature_is_used_once_and_not_passed_on(monkeypatch: pytest.MonkeyPatch) -> None:
    crew = Changing(1, 7, 8)
    crew.steps(5)
    taken = counting(monkeypatch)
    true = write_key_update(ROTATED, 7)
    for number in range(200):
        forged = enclose(true._replace(signature=bytes([number] * 64)).pack())
        crew.agents[1].peer_bytes(frame_of(forged, SigningKey(bytes(32))), crew.now)
    assert taken() == 1
    crew.steps(1)
    assert crew.numbers == [1, 2, 1]
    assert crew.key_updates[1].packed() == []
    # Its true key update comes with the others.
    crew.ground_changes(ROTATED)
    crew.steps(40)
    assert true.pack() in crew.key_updates[1].packed()
    assert {len(key_updates.packed()) for key_updates in crew.key_updates} == {4}


def test_an_asker_without_the_key_gets_a_bounded_number_of_key_updates() -> None:
    told = []
    for asks in (0, 50):
        crew = Changing(1, 7)
        crew.ground_changes(replace(ROTATED, serials={**dict.fromkeys(range(100, 200), 1), **GROUND.serials}))
        crew.steps(10)
        rng = random.Random(1)
        for _ in range(100):
            for _ in range(asks):
                key_summary = encode_key_summary(KeySummary(rng.randrange(100, 200), 1, 1, 0))
                for agent in crew.agents:
                    agent.peer_bytes(frame_of(key_summary, SigningKey(bytes(32))), crew.now)
            crew.steps(1)
        told.append(sum(is_key_update(payload) for payload in crew.payloads()))
    # Drone 7 is to keep all 104, and some are sent twice before it has verified them.
    assert 104 <= told[0] <= 1.5 * 104
    assert told[1] <= told[0] + 2 * (MAX_ASKED + 100 / 8)


@pytest.mark.parametrize("seed", seeds(2, 5))
def test_who_asks_for_the_key_updates_of_others_delays_one_that_comes_back_and_no_more(seed: int) -> None:
    """A revoked drone asks in the names of all others, in each step, for as long as it can."""
    rng = random.Random(seed)
    crew = Changing(1, 7, 8, ground=replace(GROUND, serials={**dict.fromkeys(range(100, 120), 1), **GROUND.serials}))
    crew.deaf = {2}
    crew.steps(5)
    crew.ground_changes(replace(GROUND, number=2, serials={**dict.fromkeys(range(100, 120), 1), **GROUND.serials}))
    crew.steps(100)
    assert crew.numbers == [2, 2, 1]
    crew.deaf = set()
    for _ in range(300):
        for _ in range(40):
            key_summary = encode_key_summary(KeySummary(rng.randrange(100, 120), 1, 1, 0))
            for agent in crew.agents[:2]:
                agent.peer_bytes(frame_of(key_summary, crew.key_updates[2].signing), crew.now)
        crew.steps(1)
    assert crew.numbers == [2, 2, 2]


def test_a_node_keeps_a_bounded_number_of_key_updates_and_always_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rass_mav.trust.key_update_table.MAX_KEY_UPDATES", 2)
    crew = Changing(1, 9, 10)
    crew.steps(5)
    crew.ground_changes(ROTATED)
    crew.steps(100)
    assert crew.numbers == [2, 2, 2]
    for position, node_id in ((1, 9), (2, 10)):
        kept = [KeyUpdate.unpack(packed).node_id for packed in crew.key_updates[position].packed()]
        assert len(kept) <= 3
        assert node_id in kept
    assert MAX_KEY_UPDATES * KEY_UPDATE_SIZE < 130_000


def test_a_key_update_waits_for_no_stream_to_be_known() -> None:
    """A drone that starts again among those with the new key gets it before it knows anybody."""
    crew = Changing(1, 7)
    crew.ground_changes(ROTATED)
    crew.steps(3)
    keyring = Keyring(GROUND.node(8, 1), None)
    crew.key_updates.append(KeyUpdates(keyring, random.Random(1), 1.0))
    crew.agents.append(agent_with_keys(8, key_updates=crew.key_updates[-1], now=crew.now))
    crew.steps(4)
    assert crew.numbers == [2, 2, 2]
