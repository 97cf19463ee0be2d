"""A running node and a frame that hits a fault: the driver on SQLite, and a real process over UDP."""

from __future__ import annotations

import asyncio
import signal
import socket
from itertools import count
from pathlib import Path

import pytest

from rass_mav.core.datum import Datum, DatumId, make_datum
from rass_mav.core.messages import BEACON_BASE, UNBOUNDED_FREE, Beacon, Committed, Data, Handover, Message
from rass_mav.core.policy import POTENTIAL_BASE
from rass_mav.errors import StoreError
from rass_mav.mavlink.frames import FrameReader, FrameWriter
from rass_mav.mavlink.tunnel import decode_tunnel
from rass_mav.store.sqlite import SqliteStore
from rass_mav.wire import decode, encode
from tests.link.loopback import LoopbackHub
from tests.patience import PATIENCE_S

from .app_drivers import PAYLOAD_TYPE, HeldExecutor, NeighbourEnd, running, settings
from .app_nodes import RunningNode, free_ports

POISON = b"poison"


def a_datum(sequence: int, payload: bytes = b"reading") -> Datum:
    return make_datum(DatumId(9, 0xABCD, sequence), 0, 0.0, payload)


class BuggyStore(SqliteStore):
    """A disk library that stores half of what it should, and raises."""

    def put(self, datum: Datum) -> None:
        super().put(datum)
        if datum.payload.startswith(POISON):
            raise ValueError("not a payload I like")


def numbers(heard: list[Message]) -> set[int]:
    return {number for m in heard if isinstance(m, Committed) for number, _ in m.committed}


async def test_with_a_commit_under_way_the_node_goes_on_and_only_the_next_batch_is_dropped(tmp_path: Path) -> None:
    hub = LoopbackHub()
    a, b = hub.endpoint("neighbour"), hub.endpoint("node")
    hub.connect(a, b)
    disk = HeldExecutor()
    store = BuggyStore.open(tmp_path / "node.db", node_id=7, draw_epoch=lambda: 77)
    neighbour = NeighbourEnd(a, 9)

    async def written() -> None:
        await asyncio.wait_for(disk.arrived.wait(), PATIENCE_S)
        disk.arrived.clear()
        disk.release()

    async with running(b, store, settings(3), executor=disk, forgiving=True) as driver:
        await neighbour.beacons(1)
        first = asyncio.ensure_future(driver.put(b"mine", 0))
        neighbour.hand_over(3, 100, a_datum(0))
        await asyncio.wait_for(disk.arrived.wait(), PATIENCE_S)
        # The first batch is on its way; what comes now is in the next one.
        second = asyncio.ensure_future(driver.put(b"dropped", 0))
        neighbour.hand_over(3, 101, a_datum(1))
        await neighbour.beacons(2)
        before = driver.agent.node
        neighbour.say(Data(8, 3, (Handover(102, a_datum(2, POISON)),)), 3)
        with pytest.raises(StoreError, match="triggered a fault; try again"):
            await asyncio.wait_for(second, PATIENCE_S)
        assert driver.agent.node is not before
        await neighbour.beacons(3)
        assert numbers(neighbour.heard) == set()
        assert not first.done()
        disk.arrived.clear()
        disk.release()
        own = await asyncio.wait_for(first, PATIENCE_S)
        await neighbour.until(lambda heard: numbers(heard) == {100})
        assert set(store.ids()) == {own, a_datum(0).id}
        # Whoever was not answered says it again, also while such messages are muted.
        disk.arrived.clear()
        while not disk.arrived.is_set():
            neighbour.hand_over(3, 103, a_datum(1))
            await neighbour.beacons(1)
        await written()
        await neighbour.until(lambda heard: numbers(heard) == {100, 103})
        again = asyncio.ensure_future(driver.put(b"dropped", 0))
        await written()
        assert (await asyncio.wait_for(again, PATIENCE_S)).sequence == own.sequence + 1
    store.abandon()
    with SqliteStore.open(tmp_path / "node.db", node_id=7, draw_epoch=lambda: 78) as found:
        assert {id.sequence for id in found.ids() if id.origin == 9} == {0, 1}


POLICY = """
from rass_mav.policy.fitness import FitnessPolicy
from rass_mav.policy.settings import PolicyKind

class Superstitious(FitnessPolicy):
    def plan(self, view):
        if any(id.sequence == 13 for id in view.data(0xFFFE)):
            raise ArithmeticError("thirteen")
        return []

POLICIES = (PolicyKind("superstitious", 77, lambda settings: Superstitious(settings.name, alpha=1.0, beta=50.0)),)
"""
WITH_POLICY = """
import subprocess
import sys
import rass_mav.policy
from rass_mav.cli import main

rass_mav.policy.__path__.append(sys.argv[1])
sys.exit(main(sys.argv[2:]))
"""


class Neighbour:
    """A neighbour made by hand, on a socket: a base that tells of itself, hands over, and listens."""

    def __init__(self, port: int, node: int, node_port: int) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", port))
        self.socket.settimeout(PATIENCE_S)
        self.to = ("127.0.0.1", node_port)
        self.node = node
        self.writer, self.reader = FrameWriter(200, 191), FrameReader()
        self.heard: list[Message] = []

    def say(self, message: Message) -> list[bytes]:
        frames = [self.writer.tunnel(payload, payload_type=PAYLOAD_TYPE) for payload in encode(message, 0.0)]
        for frame in frames:
            self.socket.sendto(frame, self.to)
        return frames

    def hand_over(self, sender: int, number: int, sequence: int) -> None:
        self.say(Data(sender, self.node, (Handover(number, a_datum(sequence)),)))

    def until(self, kind: type[Message], number: int = 0) -> None:
        """Listen until one comes that names a hand-over, if one is given."""
        while True:
            # Frames that leave together share a datagram.
            frames = self.reader.datagram(self.socket.recv(2048))
            assert frames
            messages = [decode(decode_tunnel(frame.payload).payload, 0.0) for frame in frames]
            self.heard += messages
            if any(isinstance(m, kind) and (not number or number in numbers([m])) for m in messages):
                return


class NodeWithPolicy(RunningNode):
    """With a policy that somebody has added."""

    def program(self) -> list[str]:
        (self.directory / "superstitious.py").write_text(POLICY)
        return ["-c", WITH_POLICY, str(self.directory)]


def test_a_process_whose_policy_has_a_fault_goes_on(tmp_path: Path) -> None:
    port, node_port = free_ports(2)
    node = NodeWithPolicy(
        tmp_path, 3, node={"forward": "immediate"}, policy={"name": "superstitious"},
        links=[{"listen": f"127.0.0.1:{node_port}", "peers": [{"id": 1, "address": f"127.0.0.1:{port}"}]}],
    )  # fmt: skip
    node.faulty = True
    base = Neighbour(port, 3, node_port)
    try:
        node.start(forked=False)
        base.until(Beacon)
        own = Beacon(1, 5, 0, BEACON_BASE, 1, 5, 0, 0, 0, 0, 0, UNBOUNDED_FREE, 77, POTENTIAL_BASE, 0)
        base.say(own)
        base.hand_over(9, 100, 12)
        base.until(Committed, 100)
        beacons = count(1)

        def has_dropped() -> bool:
            # On a busy machine the base would be gone before the policy is asked.
            base.say(own._replace(number=next(beacons)))
            base.hand_over(8, 101, 13)
            return bool(node.status()["faults"]["frames_dropped"] >= 2)

        node.until(has_dropped)
        faults = node.status()["faults"]
        assert faults["last"]["sender"].partition(" ")[0] == "Data"
        # Not the node in whose name it came.
        assert faults["muted"].keys() <= {faults["last"]["sender"]}
        assert node.status()["ledger"]["faults"] == faults["count"] >= 1
        while 102 not in numbers(base.heard):
            # It may be muted yet.
            base.hand_over(9, 102, 14)
            base.until(Beacon)
        base.until(Beacon)
        assert numbers(base.heard) == {100, 102}
        assert set(node.listing()) == {str(a_datum(12).id), str(a_datum(14).id)}
        assert "please report" in node.log()
        assert "ArithmeticError: thirteen" in node.log()
        assert node.signal(signal.SIGTERM) == 0
    finally:
        node.end()
        base.socket.close()
    with SqliteStore.open(tmp_path / "n3.db", node_id=7, draw_epoch=lambda: 78) as found:
        assert {id.sequence for id in found.ids()} == {12, 14}
