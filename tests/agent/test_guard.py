"""One frame is one frame: whatever it breaks, the node goes on, as after a restart, and nothing is promised falsely."""

from __future__ import annotations

import logging
import random
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rass_mav.agent.commits import CommitGate
from rass_mav.agent.guard import FIRST_MUTE_S, MAX_DIGESTS, MAX_SENDERS, MOST_MUTE_S, SUSPECT_S, Guard, Mutes
from rass_mav.agent.outgoing import Outgoing
from rass_mav.core.datum import Datum, DatumId, Fate, make_datum
from rass_mav.core.messages import (
    BEACON_BASE,
    Accept,
    Committed,
    Data,
    DeletionEntry,
    DeletionReport,
    Handover,
    Message,
    Offer,
    Route,
)
from rass_mav.core.news.statements import note_crc
from rass_mav.core.store import PartialKey
from rass_mav.errors import RassError, StoreDamagedError, StoreError
from rass_mav.lab.swarm.autopilot import autopilot_heartbeat
from rass_mav.mavlink.dialect import common
from rass_mav.mavlink.frames import Frame, FrameWriter
from rass_mav.mavlink.messages import NAMED_VALUE_FLOAT, STATUSTEXT, parse
from rass_mav.station.node import build_node
from rass_mav.store.sqlite import SqliteStore
from rass_mav.wire import encode
from tests.agent.build import heard, make, said, to_vehicle
from tests.agent.conversation import Conversation
from tests.core.build import beacon
from tests.extent import examples
from tests.some import some
from tests.telemetry import global_position_int, named_value_float

POISON = b"poison"


class BuggyStore(SqliteStore):
    """A disk library with a fault: it does half of its work, and raises."""

    def put(self, datum: Datum) -> None:
        super().put(datum)
        if datum.payload.startswith(POISON):
            self.set_meta("half", 1)
            raise ValueError("not a payload I like")
        if datum.payload.startswith(b"damage"):
            raise StoreDamagedError("pages are missing")

    def partial(self, key: PartialKey) -> list[tuple[int, bytes]]:
        if key.size == 666:
            raise KeyError(key)
        return super().partial(key)


class Node:
    """A forgiving agent on a real disk behind its gate, and what leaves it."""

    def __init__(self, path: Path, **sections: Any) -> None:
        self.path = path
        self.store = BuggyStore.open(path, node_id=7, draw_epoch=lambda: 7)
        self.agent = build_node(make(1, **sections).settings, self.store, random.Random(1), now=0.0, forgiving=True)
        self.gate = CommitGate(self.store)
        self.agent.guard.use(self.gate.roll_back)
        self.batch: object | None = None
        self.left: list[Any] = []
        self.told: dict[DatumId, RassError | None] = {}

    def say(self, frames: Sequence[Outgoing]) -> None:
        self.left += said(self.gate.say(frames))

    def hear(self, message: Message, now: float = 0.0) -> None:
        self.say(heard(self.agent, message, now))

    def put(self, payload: bytes) -> DatumId:
        id = self.agent.node.put(payload, 0.0)
        self.gate.ask(lambda error: self.told.__setitem__(id, error))
        return id

    def begin(self) -> None:
        if self.batch is None:
            self.batch = self.gate.begin()
            if self.batch is None:
                self.left += said(self.gate.written())

    def write(self) -> None:
        if self.batch is not None:
            self.store.write(self.batch)
            self.batch = None
            self.left += said(self.gate.written())

    def fail(self) -> None:
        """The disk fails a write, as a file system does that is full."""
        if self.batch is not None:
            committer = some(self.store._committer)
            committer.connection.execute("PRAGMA query_only = ON")
            with pytest.raises(StoreError):
                self.store.write(self.batch)
            committer.connection.execute("PRAGMA query_only = OFF")
            self.batch = None
            self.gate.failed(StoreError("the disk is full"))

    def commit(self) -> None:
        self.write()
        self.begin()
        self.write()

    def committed(self) -> set[int]:
        """The numbers of the hand-overs that it said it has."""
        return {number for m in self.left if isinstance(m, Committed) for number, _ in m.committed}

    def guard(self) -> Guard:
        assert isinstance(self.agent.guard, Guard)
        return self.agent.guard


@pytest.fixture
def node(tmp_path: Path) -> Any:
    node = Node(tmp_path / "node.db")
    yield node
    node.store.abandon()


def handover(number: int, payload: bytes, sender: int = 2) -> Data:
    return Data(sender, 1, (Handover(number, make_datum(DatumId(sender, 77, number), 0, 0.0, payload)),))


def tunnels(*messages: Message) -> bytes:
    """One datagram with all of them."""
    writer = FrameWriter(9, 191)
    return b"".join(writer.tunnel(payload, payload_type=33200) for m in messages for payload in encode(m, 0.0))


def test_without_forgiveness_a_fault_is_raised(tmp_path: Path) -> None:
    with BuggyStore.open(tmp_path / "node.db", node_id=7, draw_epoch=lambda: 7) as store:
        agent = build_node(make(1).settings, store, random.Random(1), now=0.0)
        with pytest.raises(ValueError, match="not a payload I like"):
            heard(agent, handover(5, POISON), 0.0)
        assert agent.guard.report(0.0) is None


def test_what_was_acknowledged_stays_and_what_was_dropped_was_not_acknowledged_and_comes_again(
    node: Node, caplog: pytest.LogCaptureFixture
) -> None:
    node.hear(handover(5, b"first"))
    node.commit()
    node.hear(handover(6, b"second"))
    own = node.put(b"mine")
    before = node.agent.node
    node.hear(handover(7, POISON, sender=3))
    assert node.agent.node is not before
    assert str(node.told.pop(own)).startswith("not stored: a frame received at the same time triggered a fault")
    node.commit()
    assert node.committed() == {5}
    assert (node.store.ids(), node.store.get_meta("half"), node.store.counters()["faults"]) == (
        [handover(5, b"").handovers[0].datum.id], None, 1,
    )  # fmt: skip
    # Nobody has seen the number of the datum that was dropped.
    assert node.put(b"again") == own
    node.commit()
    node.hear(handover(8, b"second"), 0.5)
    node.commit()
    assert (node.committed(), node.told) == ({5, 8}, {own: None})
    assert len(node.agent.step(1.0)) > 0
    [logged] = [record for record in caplog.records if record.exc_info]
    assert handover(7, POISON, 3).handovers[0].datum.payload.hex() in logged.getMessage()
    assert logged.levelno == logging.ERROR
    with_half = [text for text in caplog.messages if "RASS: a bug dropped a frame" in text]
    assert len(with_half) == 1


def test_what_is_on_its_way_to_the_disk_stays_whether_it_gets_there_at_once_or_not(node: Node) -> None:
    for number, on_the_way in ((5, True), (6, False)):
        node.hear(handover(number, b"x"), 10.0 * number)
        own = node.put(b"mine %d" % number)
        node.begin()
        if not on_the_way:
            node.fail()
            assert str(node.told.pop(own)) == "the disk is full"
        node.hear(handover(number + 10, b"y"), 10.0 * number)
        node.hear(handover(number + 20, POISON + b"%d" % number), 10.0 * number)
        assert own in node.store.ids()
        node.commit()
        assert number in node.committed()
        assert number + 10 not in node.committed()
        assert own in node.store.ids()
    node.store.close()
    with SqliteStore.open(node.path, node_id=7, draw_epoch=lambda: 8) as again:
        assert len(list(again.ids())) == 4


def test_an_answer_to_a_frame_of_the_same_datagram_is_not_said_when_its_datum_is_dropped(node: Node) -> None:
    lost = DeletionReport(4, 1, (DeletionEntry(7, DatumId(4, 77, 7), 1, note_crc(DatumId(4, 77, 7), 1)),))
    node.say(node.agent.peer_bytes(tunnels(handover(5, b"x"), handover(6, POISON, 3), lost), 0.0))
    node.commit()
    assert node.committed() == {7}
    assert list(node.store.ids()) == []


def test_the_same_bytes_again_do_nothing(node: Node, caplog: pytest.LogCaptureFixture) -> None:
    frame = Frame(385, 1, 9, 191, tunnels(handover(7, POISON))[10:-2], False)
    node.agent.peer_frame(frame, 0.0)
    survivor = node.agent.node
    for sequence in range(5):
        # Long after the sender is heard again, and under other MAVLink ids.
        assert node.agent.peer_frame(frame._replace(sequence=sequence, system_id=sequence), 5000.0) == ()
    assert node.agent.node is survivor
    assert (node.guard().faults, node.guard().dropped) == (1, 5)
    assert len([record for record in caplog.records if record.exc_info]) == 1


def offer(number: int, size: int = 666, sender: int = 3) -> Offer:
    return Offer(sender, 1, number, DatumId(sender, 77, number), 0, 0.0, 0, number, size, 123)


def test_a_kind_of_message_is_muted_for_a_time_that_doubles_and_others_are_heard(node: Node) -> None:
    now, number, lengths = 0.0, 100, []

    def accepted(number: int, now: float) -> bool:
        node.hear(beacon(4, int(now * 10) & 0xFFFF), now)
        before = len(node.left)
        node.hear(offer(number, 1000, 4), now)
        return any(isinstance(message, Accept) for message in node.left[before:])

    for _ in range(7):
        number += 1
        node.hear(beacon(3, int(now * 10) & 0xFFFF), now)
        node.hear(offer(number), now)
        [(kind, length)] = node.guard().report(now)["muted"].items()
        assert kind == "Offer from the neighbours"
        lengths.append(length)
        faults = node.guard().faults
        # What is said meanwhile, in whatever name, is not heard, and does not make it longer.
        node.hear(offer(number + 1000, sender=5), now + 0.5 * length)
        assert not accepted(number + 2000, now + 0.9 * length)
        node.hear(handover(number + 3000, b"good", sender=3), now + 0.9 * length)
        node.commit()
        assert node.guard().faults == faults
        assert number + 3000 in node.committed()
        now += length
        assert accepted(number + 4000, now)
    assert lengths == [min(FIRST_MUTE_S * 2**n, MOST_MUTE_S) for n in range(7)]
    # After a while without it is as if nothing had been.
    now += SUSPECT_S
    node.hear(beacon(3, int(now * 10) & 0xFFFF), now)
    node.hear(offer(99), now)
    assert node.guard().report(now)["muted"] == {"Offer from the neighbours": FIRST_MUTE_S}


def test_a_hand_over_that_is_suspect_waits_until_it_can_drop_nothing_else(node: Node) -> None:
    node.hear(handover(7, POISON, sender=3))
    node.commit()
    own = node.put(b"mine")
    for number in range(10, 20):
        node.hear(handover(number, POISON, sender=number), 10.0)
    node.hear(handover(8, b"good"), 10.0)
    assert node.told == {}
    node.commit()
    assert node.told == {own: None}
    node.hear(handover(9, b"good"), 10.0)
    node.commit()
    assert (node.committed(), node.guard().faults) == ({9}, 1)


def test_a_fault_that_does_not_strike_the_routes_leaves_them(node: Node) -> None:
    for number in range(2):
        node.hear(beacon(2, number, Route(2, 1, 5, 0), flags=BEACON_BASE), float(number))
    node.agent.step(20.0)
    for number in range(18, 22):
        node.hear(beacon(2, number, Route(2, 1, 5, 0), flags=BEACON_BASE), float(number))
        node.agent.step(float(number))
    route = some(node.agent.node.routing.route)
    before = node.agent.node
    node.hear(handover(7, POISON, sender=3), 21.0)
    assert node.agent.node is not before
    node.agent.step(21.5)
    assert node.agent.node.routing.route == route


def test_nothing_grows_without_bound(node: Node) -> None:
    mutes = Mutes()
    mutes.raised("long", 0.0, 2.0, 4.0)
    mutes.raised("long", 0.0, 2.0, 4.0)
    for n in range(3 * MAX_SENDERS):
        mutes.raised(f"node {n}", 0.0, 2.0, 4.0)
    assert len(mutes.left(0.0)) == MAX_SENDERS
    assert mutes.muted("long", 3.9), "the one that is muted longest stays"
    for number in range(MAX_DIGESTS + 20):
        node.hear(handover(number + 1, POISON, sender=number), float(number))
    report = node.guard().report(float(number))
    assert report["count"] == MAX_DIGESTS + 20
    assert len(node.guard().digests) == MAX_DIGESTS
    assert list(node.store.ids()) == []


def test_a_frame_from_the_autopilots_port_mutes_that_kind_of_message(node: Node) -> None:
    class Listener:
        """Does not bear a certain message."""

        def hear(self, frame: Frame, now: float) -> None:
            if frame.message_id == NAMED_VALUE_FLOAT:
                raise RecursionError

    agent, autopilot = node.agent, FrameWriter(1, 1)
    agent.vehicle_bytes(autopilot.message(autopilot_heartbeat()), 0.0)
    agent.vehicle_bytes(autopilot.message(named_value_float("RAD", 0.5, 1000)), 0.0)
    agent.listeners.append(Listener())
    risk = agent.node.risk.risk(0.5)
    agent.vehicle_bytes(autopilot.message(named_value_float("RAD", 0.75, 1001)), 0.5)
    assert agent.node.risk.risk(0.5) == risk, "the reading from before is still known"
    agent.vehicle_bytes(autopilot.message(named_value_float("RAD", 0.8, 1002)), 1.0)
    agent.vehicle_bytes(autopilot.message(global_position_int(45.5, -73.6, 120.0, 20.0, 1000)), 1.0)
    assert agent.telemetry.position is not None
    report = node.guard().report(1.0)
    assert (report["count"], report["frames_dropped"]) == (1, 1)
    assert report["muted"] == {"message 251 from the autopilot's port": 1.5}


def test_the_ground_is_told_once_in_half_a_minute(node: Node) -> None:
    for sender in range(3, 8):
        node.hear(handover(sender, POISON, sender), 0.2 * sender)
    texts = [parse(frame).text for frame in to_vehicle(node.agent.step(2.0)) if frame.message_id == STATUSTEXT]
    told = "RASS: a bug dropped a frame (Data from the neighbours); please report"
    assert "".join(texts) == told
    assert node.guard().report(2.0)["count"] == 5


def test_damage_is_for_the_driver(node: Node) -> None:
    with pytest.raises(StoreDamagedError):
        node.hear(handover(5, b"damage"))


def test_a_fault_in_a_step_is_raised(node: Node) -> None:
    class Service:
        def step(self, now: float) -> None:
            raise ValueError("a step is no frame")

    node.agent.services.append(Service())
    with pytest.raises(ValueError, match="a step is no frame"):
        node.agent.step(0.0)


def forgiving_conversation(path: Path) -> Conversation:
    c = Conversation(store=BuggyStore.open(path, node_id=7, draw_epoch=lambda: 7))
    c.agent.guard = Guard(c.agent)
    c.agent.guard.use(c.gate.roll_back)
    return c


def test_what_the_ground_has_set_stays_in_force_and_on_disk(tmp_path: Path) -> None:
    c = forgiving_conversation(tmp_path / "node.db")
    c.ask(common.MAVLink_param_set_message(7, 191, b"RASS_ALPHA", 3.0, 9))
    heard(c.agent, Data(2, 7, (Handover(5, make_datum(DatumId(2, 7, 5), 0, 0.0, POISON)),)), 0.0)
    assert c.agent.guard.faults == 1
    c.commit()
    c.store.abandon()  # type: ignore[attr-defined]
    again = forgiving_conversation(tmp_path / "node.db")
    assert again.ground.in_force()["RASS_ALPHA"] == c.ground.in_force()["RASS_ALPHA"] == 3.0
    again.store.abandon()  # type: ignore[attr-defined]


def test_a_frame_of_the_ground_that_breaks_what_it_sets_sets_nothing(tmp_path: Path) -> None:
    class StoreWithoutParameters(BuggyStore):
        def set_meta(self, key: str, value: int) -> None:
            if key.startswith("param."):
                raise KeyError(key)
            super().set_meta(key, value)

    with StoreWithoutParameters.open(tmp_path / "node.db", node_id=7, draw_epoch=lambda: 7) as store:
        c = Conversation(store=store)
        c.agent.guard = Guard(c.agent)
        before = c.agent.settings
        for direct in (True, False):
            c.ask(common.MAVLink_param_set_message(7, 191, b"RASS_ALPHA", 3.0, 9), direct=direct)
        assert c.agent.settings is before
        assert (c.agent.guard.faults, c.agent.guard.dropped) == (1, 1), "the same bytes by another way are the same"
        assert c.agent.node.settings.node_id == 7


class HalfWay:
    """Does much, and raises."""

    def __init__(self, node: Node) -> None:
        self.node = node

    def hear(self, frame: Frame, now: float) -> None:
        node, store = self.node.agent.node, self.node.store
        for holding in list(node.holdings.custody.values())[::2]:
            node.holdings.remove(holding, Fate.CORRUPTED)
        node.put(b"half", now)
        store.set_meta("half", 1)
        store.count("half")
        raise RecursionError


EVENTS = st.sampled_from(["good", "good", "twice", "put", "spare", "step", "begin", "begin", "write", "fail", "loss"])


@pytest.mark.no_cover
@settings(max_examples=examples(40), deadline=None)
@given(st.lists(EVENTS, max_size=25))
def test_wherever_a_fault_strikes_the_store_is_what_a_restart_would_have_found(
    tmp_path_factory: pytest.TempPathFactory, events: list[str]
) -> None:
    node = Node(tmp_path_factory.mktemp("node") / "node.db", store={"capacity_items": 60})
    lost = set()
    for number, event in enumerate(events, 1):
        if event == "good":
            node.hear(handover(number, b"%d" % number))
        elif event == "twice":
            node.hear(handover(1, b"1"))
        elif event == "spare":
            node.hear(handover(number, b"%d" % number)._replace(replica=True))
        elif event == "put":
            node.put(b"mine %d" % number)
        elif event == "step":
            node.say(node.agent.step(float(number)))
        elif event == "loss" and node.store.ids():
            node.store.count("some")
            for holding in list(node.agent.node.holdings.custody.values())[:1]:
                node.agent.node.holdings.remove(holding, Fate.EXPIRED)
                lost.add(holding.id.sequence)
        elif event in ("begin", "write", "fail"):
            getattr(node, event)()
    node.agent.listeners.append(HalfWay(node))
    node.agent.vehicle_bytes(FrameWriter(1, 1).message(autopilot_heartbeat()), 100.0)
    assert node.guard().faults == 1
    found = (
        [node.store.get(info.id) for info in node.store.held()], dict(node.store.losses()), node.store.assigned,
        node.store.used_bytes, node.store.get_meta("half"), {**node.store.counters(), "faults": 0},
    )  # fmt: skip
    held = set(node.agent.node.holdings.custody)
    # What was on its way comes to the disk, or its write has failed and is tried again; then the power is cut.
    node.begin()
    node.write()
    assert node.committed() <= {handover.sequence for handover in held if handover.origin == 2} | lost | {1}
    node.store.abandon()
    with SqliteStore.open(node.path, node_id=7, draw_epoch=lambda: 8) as again:
        assert found == (
            [again.get(info.id) for info in again.held()], dict(again.losses()), again.assigned,
            again.used_bytes, None, {**again.counters(), "faults": 0},
        )  # fmt: skip
        assert held == set(again.ids())
