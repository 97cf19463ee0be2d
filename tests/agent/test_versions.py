"""Nodes of another version of the wire format in one swarm: they are named, and nothing else comes of them."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import pytest

from rass_mav.agent.agent import Agent
from rass_mav.agent.peers import MAX_OTHERS, OtherVersion
from rass_mav.core.messages import BROADCAST, Committed, CopyStatusEntry, CopyStatuses, Data, Message
from rass_mav.ground.attention.node import of_node
from rass_mav.mavlink.frames import FrameWriter
from rass_mav.mavlink.messages import STATUSTEXT, parse
from rass_mav.station.reports import MAX_REPORTED, REPORT_S, VERSION_TEXT_S
from rass_mav.wire import encode
from rass_mav.wire.codec import VERSION
from tests.agent.build import fit_beacon, make, said, step, to_vehicle
from tests.wire.version_1 import VERSION_1

WRITER = FrameWriter(9, 191)


def hears(agent: Agent, payload: bytes, now: float) -> Any:
    return agent.peer_bytes(WRITER.tunnel(payload, payload_type=33200), now)


def as_version(version: int, message: Message, now: float) -> bytes:
    """The message as another version says it, where that differs in the first byte only."""
    [payload] = encode(message, now)
    return bytes([version << 4 | payload[0] & 15]) + payload[1:]


def beacon_of(version: int, node_id: int) -> bytes:
    return bytes([version << 4 | 1]) + node_id.to_bytes(2, "little") + bytes(34)


def texts(agent: Agent, now: float) -> list[str]:
    found = [parse(frame).text for frame in to_vehicle(agent.step(now)) if frame.message_id == STATUSTEXT]
    return [text if isinstance(text, str) else text.decode() for text in found]


def test_nothing_of_another_version_is_taken() -> None:
    agent = make(2)
    for name, payload in VERSION_1.items():
        assert not hears(agent, payload, 0.0), name
    assert not agent.node.routing.neighbours
    assert not list(agent.node.store.ids())
    assert (agent.peers.foreign, agent.peers.malformed) == (len(VERSION_1), 0)
    # Who sent a chunk or a receipt is not said.
    assert agent.peers.other_versions == {node_id: OtherVersion(1, 0.0) for node_id in (1, 2, 3, 5)}


def test_custody_does_not_end_on_the_word_of_another_version() -> None:
    agent = make(3)
    for payload in encode(fit_beacon(agent, 2, 0), 0.0):
        hears(agent, payload, 0.0)
    id = agent.node.put(b"mine", 0.0)
    [(number, datum)] = [
        h for message in said(step(agent, 0.0)) if isinstance(message, Data) for h in message.handovers
    ]
    assert datum.id == id
    answer = Committed(2, 3, ((number, datum.crc),), ())
    refusal = Committed(2, 3, (), (number,))
    for version in (0, 1, VERSION - 1, VERSION + 1):
        for message in (answer, refusal, CopyStatuses(2, 3, (CopyStatusEntry(id, 0),))):
            assert not hears(agent, as_version(version, message, 0.5), 0.5)
    assert id in agent.node.holdings.custody
    assert agent.peers.foreign == 12
    # The same in our own version ends it.
    hears(agent, as_version(VERSION, answer, 0.5), 0.5)
    assert id not in agent.node.holdings.custody


def test_each_node_of_another_version_is_told_of_once() -> None:
    agent = make(2)
    hears(agent, VERSION_1["beacon-drone"], 0.0)
    assert "".join(texts(agent, 0.0)) == f"RASS: node 3 uses version 1, this one {VERSION}: update node 3"
    for t in range(1, 100):
        hears(agent, VERSION_1["beacon-drone"], float(t))
        assert texts(agent, float(t)) == []
    hears(agent, beacon_of(VERSION + 1, 7), 100.0)
    assert "".join(texts(agent, 100.0)) == f"RASS: node 7 uses version {VERSION + 1}, this one {VERSION}: update node 2"


def test_who_has_spoken_another_version_long_ago_is_not_told_of() -> None:
    agent = make(2)
    agent.peers.other_versions[7] = OtherVersion(1, 0.0)
    assert texts(agent, REPORT_S + 1) == []


def test_a_frame_that_is_for_somebody_else_or_from_nobody_names_no_node() -> None:
    agent = make(2)
    hears(agent, beacon_of(1, BROADCAST), 0.0)
    hears(agent, b"\x11", 0.0)
    hears(agent, bytes(40), 0.0)
    agent.peer_bytes(WRITER.tunnel(beacon_of(1, 7), payload_type=33200, target_system=77), 0.0)
    agent.peer_bytes(WRITER.tunnel(beacon_of(1, 7), payload_type=33201), 0.0)
    # A type of ours that we do not know is no other version.
    hears(agent, bytes([VERSION << 4 | 15, 7, 0]), 0.0)
    assert agent.peers.other_versions == {}


def test_the_nodes_heard_last_are_remembered() -> None:
    agent = make(2)
    for node_id in range(100, 100 + MAX_OTHERS):
        hears(agent, beacon_of(1, node_id), 0.0)
    hears(agent, beacon_of(2, 100), 1.0)
    hears(agent, beacon_of(1, 7), 2.0)
    others = agent.peers.other_versions
    assert len(others) == MAX_OTHERS
    assert 101 not in others
    assert (others[100], others[7]) == (OtherVersion(2, 1.0), OtherVersion(1, 2.0))


@pytest.mark.no_cover
@pytest.mark.parametrize("liars", [1, 20, 5000])
def test_forged_frames_bring_about_few_words_and_nothing_else(liars: int) -> None:
    agent, calm = make(2), make(2)
    told: dict[int, list[float]] = {}
    for t in range(300):
        for n in range(20):
            forged = beacon_of((1, 3, 4)[(t + n) % 3], 100 + (20 * t + n) % liars)
            assert not hears(agent, forged, float(t))
        both = agent.step(float(t)), calm.step(float(t))
        beacons = [said(frames, float(t)) for frames in both]
        assert [len(messages) for messages in beacons] == [1, 1]
        found = [parse(frame) for frame in to_vehicle(both[0]) if frame.message_id == STATUSTEXT]
        first = [text.text for text in found if text.chunk_seq == 0]
        assert len(first) <= 1
        for text in first:
            told.setdefault(int(text.split()[2]), []).append(float(t))
    times = sorted(t for at in told.values() for t in at)
    assert len(times) <= 300 / VERSION_TEXT_S
    for at in told.values():
        assert all(later - earlier >= REPORT_S for earlier, later in pairwise(at))
        if liars <= MAX_REPORTED:
            assert len(at) <= 3, "once for each version"
    assert len(agent.peers.other_versions) <= MAX_OTHERS
    assert not agent.node.routing.neighbours
    assert not agent.node.alarms.counts


def test_a_node_that_was_told_of_is_remembered_longer_than_a_text_may_be_repeated() -> None:
    assert MAX_REPORTED * VERSION_TEXT_S > REPORT_S


def test_the_status_names_them() -> None:
    status: dict[str, Any] = {
        "node_id": 2, "role": "base", "keys": None, "life": "1", "epoch": "1", "uptime_s": 1.0, "steps": 1,
        "reading": None, "sensor": None, "position": None, "store": {"items": 0, "capacity_items": None, "bytes": 0},
        "neighbours": [], "ground": None, "links": [], "vehicle": None, "ledger": {}, "malformed": 0, "foreign": 9,
        "rivals": [],
        "shared_system_ids": [{"system_id": 3, "node_ids": [4, 9]}],
        "commits": {"failed": 0}, "faults": None, "files": [],
        "other_versions": [{"node_id": 7, "version": 1, "age_s": 3.2}],
    }  # fmt: skip
    titles = [one.title for one in of_node(status)]
    assert "node 7 uses version 1 of the wire format, heard 3 s ago" in titles
    assert "nodes 4, 9 share system id 3, a ground station sees one vehicle" in titles
