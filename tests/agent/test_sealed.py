"""Sealed data: nobody but the ground reads them, nobody but their origin makes them, and forged ones are in no one's
way."""

from __future__ import annotations

import random
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import pytest

from rass_mav.agent.agent import Agent
from rass_mav.agent.commits import CommitGate
from rass_mav.agent.outgoing import Outgoing, Way
from rass_mav.core.alarms import Alarm
from rass_mav.core.custody.holdings import State
from rass_mav.core.datum import MAX_PAYLOAD, TERMS, USUAL, Datum, DatumId, Kind, Terms, make_datum, parted
from rass_mav.core.messages import Committed, Data, Handover
from rass_mav.core.seals import SEALED
from rass_mav.core.store import MAX_APART
from rass_mav.errors import DatumError, ForgedError, StoreError, StoreFullError
from rass_mav.lab.disk.disk import Disk
from rass_mav.mavlink.tunnel import tunnel_from_datagram
from rass_mav.store.memory import MemoryStore
from rass_mav.store.quota import ROW_OVERHEAD
from rass_mav.store.sqlite import SqliteStore
from rass_mav.trust.keys.keyring import Keyring
from rass_mav.trust.keys.sealing import SEAL_SIZE, Sealer
from rass_mav.trust.seals import DataKeys
from rass_mav.trust.trust import trust_of
from rass_mav.wire import decode
from rass_mav.wire.measurement import decode_measurement
from rass_mav.wire.nodestatus import decode_status
from tests.core.durable import DurableStore
from tests.extent import seeds
from tests.keyed import keyed
from tests.some import some

from .build import on
from .sealed import BASE, GROUND, OPENER, Row, arrived, forged_by, handed, keyring, make, opened, with_crc

TEXT = b"the source is in the third house"


def row(*ids: int) -> Row:
    """Without data of their own; they have routes."""
    row = Row(*(make(id) for id in ids))
    row.until(6.0)
    return row


# -- nobody else reads them --------------------------------------------------------------------------------------------


def test_what_a_drone_creates_is_sealed_on_all_ways_and_read_by_the_ground() -> None:
    field = row(8, 9, BASE)
    small, large = field.put(0, TEXT), field.put(0, 40 * TEXT, Kind.FILE)
    field.until(20.0)
    base = field.agents[-1]
    for id, payload in ((small, TEXT), (large, 40 * TEXT)):
        assert opened(base, id) == payload
        for agent in field.agents:
            stored = agent.store.get(id)
            assert stored is None or (TEXT[:8] not in stored.payload and stored.kind & SEALED)
        stored = some(base.store.get(id))
        assert len(stored.payload) == len(payload) + 16
    assert not [frame for frame in field.frames if TEXT[:8] in frame]
    assert base.store.counters().get("forged", 0) == 0


def test_measurements_and_statuses_are_sealed_too_and_those_of_a_base() -> None:
    agents = make(8, data={"interval_steps": 1, "status_s": 2.0}), make(BASE, data={"status_s": 2.0})
    field = Row(*agents)
    field.until(10.0)
    base = agents[1]
    found = {(id.origin, datum.kind) for id in base.store.ids() if (datum := base.store.get(id)) is not None}
    assert found == {(8, Kind.MEASUREMENT | SEALED), (8, Kind.STATUS | SEALED), (BASE, Kind.STATUS | SEALED)}
    for id in base.store.ids():
        datum = some(base.store.get(id))
        read = decode_measurement if datum.kind & ~SEALED == Kind.MEASUREMENT else decode_status
        read(opened(base, id))


def test_without_keys_data_are_open() -> None:
    agent = make(8, keys=False)
    datum = some(agent.store.get(agent.node.put(TEXT, 0.0)))
    assert (datum.kind, datum.payload) == (0, TEXT)


def test_what_fits() -> None:
    agent = make(8)
    datum = some(agent.store.get(agent.node.put(bytes(MAX_PAYLOAD - SEAL_SIZE), 0.0)))
    assert len(datum.payload) == MAX_PAYLOAD
    for payload in (b"", bytes(MAX_PAYLOAD - SEAL_SIZE + 1)):
        with pytest.raises(DatumError, match="1 to 1048560 bytes"):
            agent.node.put(payload, 0.0)
    for keys in (True, False):
        with pytest.raises(DatumError, match="0 to 63"):
            make(8, keys=keys).node.put(b"x", 0.0, kind=SEALED)
    bounded = make(8, MemoryStore(1, quota_bytes=ROW_OVERHEAD + len(TEXT) + 15))
    with pytest.raises(StoreFullError):
        bounded.node.put(TEXT, 0.0)
    bounded.node.put(TEXT[1:], 0.0)


@pytest.mark.parametrize(("policy", "most"), [("survival", MAX_PAYLOAD), ("stigmergy", 97)])
def test_measurements_are_filled_up_to_what_fits(policy: str, most: int) -> None:
    agent = make(8, policy={"name": policy}, data={"bytes": most})
    id = some(agent.measure(0.0))
    datum = some(agent.store.get(id))
    assert len(datum.payload) == most


# -- nobody else makes them --------------------------------------------------------------------------------------------


def lies(field: Row) -> list[Datum]:
    """Other contents for data that drone 8 is about to create: what a captured drone 7 can do."""
    origin = field.agents[0]
    ids = [DatumId(8, origin.store.epoch, origin.store.assigned + n) for n in range(3)]
    # Sealed with its own key; open; and with the bit, but not sealed at all.
    return [forged_by(7, ids[0]), make_datum(ids[1], 0, 0.0, b"a lie"), make_datum(ids[2], SEALED, 0.0, b"a lie")]


@pytest.mark.no_cover
@pytest.mark.parametrize("mirror", [True, False])
def test_what_a_captured_drone_forges_is_counted_and_the_true_data_arrive_all_the_same(mirror: bool) -> None:
    field = Row(*(make(id, custody={"replicas": mirror}) for id in (8, 9, 7, BASE)))
    field.until(6.0)
    base = field.agents[3]
    forged = lies(field)
    for number, datum in enumerate(forged):
        # To the node in the middle, which has it before the true one comes, and by itself to the base.
        field.say(2, handed(7, 9, datum, 70 + number))
        field.say(2, handed(7, BASE, datum, 80 + number))
    field.until(8.0)
    assert base.store.counters()["forged"] == 3
    assert base.node.alarms.counts[Alarm.UNSEALED] == 3
    assert not [datum for datum in forged if datum.id in arrived(base) or datum.id in field.agents[1].node.receipts]
    true = [field.put(0, TEXT) for _ in forged]
    assert true == [datum.id for datum in forged]
    field.until(60.0)
    assert [opened(base, id) for id in true] == [TEXT] * 3
    assert all(id in arrived(base) for id in true)
    assert base.store.counters()["forged"] == 3, "each is counted once"
    assert {info.id for info in base.store.apart()} == set(true), "in case the keys were the wrong ones"


def test_any_change_of_a_datum_is_found() -> None:
    field = row(8, BASE)
    id = field.put(0, TEXT)
    base = field.agents[1]
    datum = some(base.store.get(id))
    other = make(BASE)
    rng = random.Random(5)
    for number in range(200):
        changed = bytearray(datum.payload)
        changed[rng.randrange(len(changed))] ^= 1 << rng.randrange(8)
        forged = make_datum(id, datum.kind, 0.0, bytes(changed))
        other.node.receive(handed(7, BASE, forged, number), 1.0)
    for forged in (
        make_datum(DatumId(9, *id[1:]), datum.kind, 0.0, datum.payload),
        make_datum(id._replace(epoch=id.epoch + 1), datum.kind, 0.0, datum.payload),
        make_datum(id._replace(sequence=id.sequence + 1), datum.kind, 0.0, datum.payload),
        make_datum(id, Kind.FILE | SEALED, 0.0, datum.payload),
        make_datum(id, datum.kind & ~SEALED, 0.0, datum.payload),
        make_datum(id, datum.kind, 0.0, datum.payload[:15]),
    ):
        other.node.receive(handed(7, BASE, forged, 999), 1.0)
    assert not list(other.store.ids())
    assert other.store.counters()["forged"] > 150
    other.node.receive(handed(7, BASE, datum, 1000), 1.0)
    assert list(other.store.ids()) == [id]


@pytest.mark.parametrize("terms", [USUAL, Terms(2, 3600)])
def test_nobody_changes_the_terms_of_a_datum_or_adds_or_removes_them(terms: Terms) -> None:
    field = row(8, BASE)
    id = field.put(0, TEXT, terms=terms)
    datum = some(field.agents[1].store.get(id))
    assert opened(field.agents[1], id) == TEXT
    packed, rest = parted(datum.kind, datum.payload)
    assert (datum.terms, packed) == (terms, terms.pack())
    other = make(BASE)
    number = 0
    for told in (Terms(9), Terms(9, 3600), Terms(2, 1), Terms(2), Terms(ttl_s=3600), Terms(3, 3600), USUAL):
        if told != terms:
            kind = (datum.kind & ~TERMS) | (TERMS if told.pack() else 0)
            forged = make_datum(id, kind, 0.0, told.pack() + rest)
            assert forged.terms == told
            number += 1
            other.node.receive(handed(7, BASE, forged, number), 1.0)
    # The same bytes, as if they were others.
    other.node.receive(handed(7, BASE, make_datum(id, datum.kind ^ TERMS, 0.0, datum.payload), 99), 1.0)
    assert not list(other.store.ids())
    assert other.store.counters()["forged"] == number + 1
    other.node.receive(handed(7, BASE, datum, 100), 1.0)
    assert list(other.store.ids()) == [id]


def test_a_captured_drone_that_shortens_a_life_does_not_end_the_true_datum() -> None:
    """It hands the changed datum to the node in the middle before the true one comes there."""
    field = row(8, 9, 7, BASE)
    origin, _, _, base = field.agents
    id = origin.node.put(TEXT, field.now, terms=Terms(ttl_s=3600))
    true = some(origin.store.get(id))
    forged = make_datum(id, true.kind, field.now, Terms(9, 1).pack() + parted(true.kind, true.payload)[1])
    field.say(2, handed(7, 9, forged, 70))
    field.say(2, handed(7, BASE, forged, 71))
    field.until(40.0)
    stored = some(base.store.get(id))
    assert stored.terms == Terms(ttl_s=3600)
    assert opened(base, id) == TEXT
    assert id in arrived(base)
    assert base.store.counters()["forged"] == 1


def test_what_a_base_overhears_must_be_true_too() -> None:
    base = make(BASE)
    id = DatumId(8, 77, 0)
    base.node.receive(handed(7, 9, forged_by(7, id)), 1.0)
    assert not list(base.store.ids())
    base.node.receive(handed(7, 9, forged_by(8, id)), 1.0)
    assert list(base.store.ids()) == [id]


@pytest.mark.no_cover
@pytest.mark.parametrize("mirror", [True, False])
def test_a_forged_datum_with_the_crc_of_the_true_one_takes_nothing_away(mirror: bool) -> None:
    """Whoever has heard the true datum can make one that differs in nothing that an answer names."""
    field = Row(*(make(id, custody={"replicas": mirror}) for id in (8, 9, 7, BASE)))
    field.until(6.0)
    origin, _, _, base = field.agents
    # The datum is created and held back, as if its frame had been lost.
    id = origin.node.put(TEXT, field.now)
    true = some(origin.store.get(id))
    forged = with_crc(forged_by(7, id, TEXT), true.crc)
    assert (forged.crc, forged.intact, forged.payload == true.payload) == (true.crc, True, False)
    field.say(2, handed(7, 9, forged, 70))
    field.until(60.0)
    assert opened(base, id) == TEXT
    assert base.store.counters()["forged"] == 1


@pytest.mark.no_cover
def test_an_answer_that_a_forger_has_brought_about_costs_time_but_not_the_datum() -> None:
    """A forger sends a base something in a drone's name, with the number and the CRC of what that hands over just then:
    the drone believes that the base has it."""
    field = Row(make(8), make(BASE))
    field.until(30.0)
    drone, base = field.agents
    id = drone.node.put(TEXT, field.now)
    true = some(drone.store.get(id))
    # The frame is lost, but the forger has heard it.
    [sent] = on(Way.NEIGHBOURS, drone.forward(field.now))
    fields = some(tunnel_from_datagram(drone.peers.leaving(sent).frame))
    message = decode(fields[5], field.now)
    assert isinstance(message, Data)
    forged = with_crc(forged_by(7, id, TEXT), true.crc)
    field.say(0, handed(8, BASE, forged, message.handovers[0].number))
    holding = some(drone.node.holdings.get(id))
    assert holding.state is State.PASSED_ON
    assert id not in arrived(base)
    field.until(300.0)
    assert opened(base, id) == TEXT
    assert id in arrived(base)


def test_data_from_before_the_keys_hold_up_none_that_are_made_with_them() -> None:
    """The base takes them, and no receipt names them. That is no fault of the base."""
    store = MemoryStore(1008)
    for _ in range(30):
        store.put(make_datum(DatumId(8, store.epoch, store.next_sequence()), 0, 0.0, TEXT))
    field = Row(make(8, store), make(BASE))
    drone, base = field.agents
    field.until(12.0)
    for turn in range(13, 150):
        id = field.put(0, TEXT)
        field.until(float(turn))
        assert id in arrived(base)
    assert drone.node.figures()["doubted"] == 0
    assert len(list(base.store.apart())) == 30


@pytest.mark.no_cover
def test_forged_data_fill_no_more_than_their_place_and_stay_with_nobody() -> None:
    base = make(BASE)
    for sequence in range(MAX_APART + 10):
        lie = forged_by(7, DatumId(8, 77, sequence))
        answers = base.node.receive(handed(7, BASE, lie, sequence + 1), 1.0)
        said = [answer.committed for answer in answers if isinstance(answer, Committed)]
        assert said == [((sequence + 1, keyed(base).tags.content_hashes.of(lie)),)]
    assert len(list(base.store.apart())) == MAX_APART
    assert base.store.counters()["forged"] == MAX_APART + 10


@pytest.mark.parametrize("accept_open", [True, False])
def test_open_data_arrive_only_if_the_base_is_told_to_take_them(accept_open: bool) -> None:
    field = Row(make(8, sealing=False), make(BASE, accept_open=accept_open))
    field.until(6.0)
    base = field.agents[1]
    id = field.put(0, TEXT)
    assert (id in arrived(base)) is accept_open
    assert base.store.counters().get("forged", 0) == (0 if accept_open else 1)
    assert [info.id for info in base.store.apart()] == ([] if accept_open else [id])
    lie = forged_by(7, id._replace(sequence=99))
    field.say(0, handed(8, BASE, lie))
    assert lie.id not in arrived(base), "what is sealed must be true all the same"


def test_two_bases_read_each_other_and_a_base_without_keys_takes_what_it_cannot_read() -> None:
    other = make(BASE, keys=False)
    datum = forged_by(8, DatumId(8, 77, 0), TEXT)
    other.node.receive(handed(8, BASE, datum), 1.0)
    assert datum.id in arrived(other)
    with pytest.raises(ForgedError):
        OPENER.open(datum.id, 1, datum.payload)


def test_a_base_opens_what_its_file_says_by_now_and_nothing_of_others() -> None:
    """A running base takes a changed key file. What its file does not name costs it no search."""
    trust = trust_of(keyring(BASE), random.Random(1))
    seals = trust.seals(MemoryStore(5))

    def made_by(node_id: int, serial: int) -> bool:
        id = DatumId(node_id, 5, 0)
        sealed = Sealer(GROUND.node(node_id, serial), *id[1:]).seal(0, 0, b"payload")
        return seals.is_authentic(make_datum(id, SEALED, 0.0, sealed))

    assert [made_by(7, 1), made_by(7, 4), made_by(7, 9), made_by(12, 1), made_by(2, 0)] == [
        True, True, False, False, True,
    ]  # fmt: skip
    later = replace(GROUND, serials={**GROUND.serials, 7: 9, 12: 1})
    trust.key_updates.renew(Keyring(later.node(BASE), later))
    assert made_by(7, 9)
    assert made_by(12, 1)


# -- no number is sealed twice -----------------------------------------------------------------------------------------


def test_a_second_content_under_one_id_is_refused() -> None:
    store = MemoryStore(5)
    seals = DataKeys(keyring(8), dict)(store)
    seals.seal(DatumId(8, 5, 3), 0, b"one")
    for sequence in (3, 0):
        with pytest.raises(ValueError, match="sealed a second time"):
            seals.seal(DatumId(8, 5, sequence), 0, b"two")


class Listener:
    """Hears all that leaves a node with keys: two contents under one id are a failure."""

    def __init__(self) -> None:
        self.left: dict[DatumId, bytes] = {}

    def hear(self, agent: Agent, frames: Sequence[Outgoing], now: float) -> None:
        for outgoing in on(Way.NEIGHBOURS, frames):
            fields = some(tunnel_from_datagram(agent.peers.leaving(outgoing).frame))
            message = decode(fields[5], now)
            if type(message) is Data:
                for _, datum in message.handovers:
                    assert self.left.setdefault(datum.id, datum.payload) == datum.payload
                    OPENER.open(datum.id, datum.kind & ~SEALED, datum.payload)


def puts(agent: Agent, number: int, now: float) -> list[Outgoing]:
    """A node in range of another one creates a datum; what it has to say then."""
    for message in make(9).node.step(now):
        agent.node.receive(message, now)
    frames = list(agent.step(now))
    agent.node.put(b"content %d" % number, now)
    return frames + list(agent.forward(now))


@pytest.mark.no_cover
@pytest.mark.parametrize("seed", range(10))
def test_no_two_contents_of_one_id_leave_a_node_that_crashes_and_rolls_back(seed: int) -> None:
    rng, listener = random.Random(seed), Listener()
    store, now, created = DurableStore(1008), 0.0, 0
    for _ in range(30):
        agent, gate = make(8, store), CommitGate(store)
        # The timestamps of its frames are claimed.
        store.commit()
        crashed = False
        while not crashed:
            now += 1.0
            out: list[Outgoing] = []
            what = rng.choice(["put", "put", "put", "begin", "end", "end", "roll back", "crash"])
            if what == "put":
                created += 1
                out += gate.say(puts(agent, created, now))
            if what == "begin" and not gate.committing and gate.begin() is None:
                out += gate.written()
            if what == "end" and gate.committing:
                store.write(store.under_way)
                out += gate.written()
            if what == "roll back":
                gate.roll_back(StoreError("a fault"))
                agent.begin_again(agent.settings, now)
            if what == "crash":
                # A batch that was under way may have come to the disk or not.
                if store.busy and rng.random() < 0.5:
                    store.disk = store.under_way or store.disk
                store, crashed = store.crashed(), True
            listener.hear(agent, out, now)
    assert created > len(listener.left) > 10


@pytest.mark.no_cover
@pytest.mark.parametrize("seed", seeds(2, 4))
def test_nor_one_whose_power_is_cut_in_the_middle_of_a_commit(seed: int) -> None:
    """The real store, on a simulated disk that loses, tears and reorders what was not synced."""
    rng, listener = random.Random(seed), Listener()
    now, created, cuts = 0.0, 0, 0
    with Disk(rng) as disk:
        for _ in range(25):
            store = SqliteStore.open(
                disk.directory / "node.db", node_id=8, draw_epoch=partial(rng.getrandbits, 32), disk=disk
            )
            agent, gate = make(8, store), CommitGate(store)
            disk.cut(after=rng.randrange(40))
            try:
                while not disk.off:
                    now, created = now + 1.0, created + 1
                    listener.hear(agent, gate.say(puts(agent, created, now)), now)
                    if rng.random() < 0.2:
                        gate.roll_back(StoreError("a fault"))
                        agent.begin_again(agent.settings, now)
                    if (batch := gate.begin()) is not None:
                        store.write(batch)
                    listener.hear(agent, gate.written(), now)
            except StoreError:
                cuts += 1
            store.abandon()
            disk.restart()
    assert cuts > 5
    assert created > len(listener.left) > 10


# -- what it costs -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("size", "keys", "frames"), [(20, False, [113]), (20, True, [145]), (23, False, [119]), (23, True, [87, 87])]
)
def test_what_two_measurements_take_on_the_air(size: int, keys: bool, frames: list[int]) -> None:
    """As docs/reference/protocol.md has it."""
    agent = make(8, keys=keys)
    data = [agent.store.get(agent.node.put(b"\xff" * size, 0.0, Kind.MEASUREMENT)) for _ in range(2)]
    handovers = tuple(Handover(number + 1, datum) for number, datum in enumerate(data) if datum is not None)
    said = agent.peers.frames([Data(8, 9, handovers)], agent.store, 0.0)
    assert [len(outgoing.frame) for outgoing in said] == frames
