"""Nodes with all their keys, among strangers, and a captured drone that has the link key and a certificate of its own.

A stranger sends bytes, frames that are not signed or with another key, and true frames with changes. The captured drone
takes part in the swarm as it should. Besides, it sends anything: in its own stream, in those of others, and in the
names of others. No tag is its own then, unless the world says so.
"""

from __future__ import annotations

import random
import struct
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from typing import Any
from zlib import crc32

from rass_mav.agent.agent import Agent
from rass_mav.agent.outgoing import Outgoing, Way, frames_about_links
from rass_mav.agent.settings import AgentSettings
from rass_mav.config.loading import convert
from rass_mav.core.datum import Datum, DatumId
from rass_mav.core.messages import Committed, CopyStatus, CopyStatusEntry, CopyStatuses, Message
from rass_mav.core.news.receipts import Receipts
from rass_mav.core.node import Node
from rass_mav.errors import DatumError, MalformedError, StoreFullError
from rass_mav.lab.medium.air import open_datagram
from rass_mav.lab.swarm.mission import keyring_of
from rass_mav.mavlink.crc import crc16
from rass_mav.mavlink.dialect import FORMATS
from rass_mav.mavlink.frames import TUNNEL_ID, FrameWriter
from rass_mav.mavlink.signing import SIGNATURE_SIZE, SigningKey
from rass_mav.station.node import build_node
from rass_mav.trust import (
    attestations,
    key_update_table,
    route_proofs,
    statement_signatures,
)
from rass_mav.trust.key_updates import MAX_AWAITED
from rass_mav.trust.keys.identity import Ground
from rass_mav.trust.keys.key_updates import write_key_update
from rass_mav.trust.keys.keyring import Keyring
from rass_mav.trust.keys.secret import Secret
from rass_mav.trust.pairs import MAX_OFFERED
from rass_mav.trust.trust import trust_of
from rass_mav.wire import MAX_TUNNEL, decode, encode
from rass_mav.wire.attestation import ANCHOR
from rass_mav.wire.codec import BEACON, MORE, VERSION
from tests.core.books import check_node
from tests.core.durable import DurableStore
from tests.keyed import keyed
from tests.some import some
from tests.wire.kinds import beside

from .forging import Liar, changed, sealed
from .source import Source

#: Deeds in one world.
MOST_DEEDS = 60
#: Frames that may be heard again later.
MOST_HEARD = 64
#: Steps until nodes that start together know each other.
INTRODUCED = 3
#: More than anybody says because of one frame.
ENDLESS = 2000
BASE, DRONES, CAPTURED = 1, (2, 3), 9
HONEST = (BASE, *DRONES)
TYPE = 33200
GROUND = Ground(Secret(bytes(range(32))), serials=dict.fromkeys((*DRONES, CAPTURED), 1))
#: What the ground does, one after the other: all get another link key, and then all but the captured drone.
CHANGES = (replace(GROUND, number=2), replace(GROUND, number=3, revoked=frozenset({CAPTURED})))
#: All that it ever writes.
KEY_UPDATES = {write_key_update(ground, node_id).pack() for ground in CHANGES for node_id in ground.serials}
STRANGERS_KEY = SigningKey(bytes(32))
HEAD_OF_ANCHOR = bytes([VERSION << 4 | MORE, ANCHOR])
#: What a payload may begin with: each type of message, and each of what is beside them.
HEADS = [bytes([VERSION << 4 | type_]) for type_ in range(16)] + [bytes([VERSION << 4 | MORE, n]) for n in beside()]


def payload_of(frame: bytes) -> bytes:
    """Of its TUNNEL; empty: there is none."""
    opened = open_datagram(frame, 0.0)
    return b"" if opened is None else opened[3]


@cache
def keyring(node_id: int) -> Keyring:
    return keyring_of(GROUND, node_id)


@cache
def settings_of(node_id: int, mirror: bool) -> AgentSettings:
    raw: dict[str, Any] = {"node_id": node_id, "base": node_id == BASE, "step_s": 1.0, "forward": "immediate"}
    raw["mavlink"] = {"system_id": node_id}
    raw["data"] = {"interval_steps": 0}
    raw["custody"] = {} if mirror else {"replicas": False}
    return convert(raw, AgentSettings, "test")


class _Talk:
    """Who is there, what was on the air, and what must hold whatever it was."""

    def __init__(self, source: Source) -> None:
        self.source = source
        world = source.byte()
        self.forgiving = bool(world & 1)
        """Frames go the way that they go in a real node; otherwise a fault shows where it is."""
        self.speaks = bool(world & 2)
        """The captured drone also says something else than it does, as itself."""
        self.mirror = not world & 8
        """Without replicas, a false answer would be enough to delete a datum."""
        self.now = 1000.0
        self.lives = 0
        self.changes = list(CHANGES)
        self.loss = 0
        """Bit i: of eight frames, the one that is lost."""
        self.sent = 0
        self.air: deque[bytes] = deque(maxlen=MOST_HEARD)
        self.created: dict[DatumId, Datum] = {}
        self.arrived: dict[DatumId, Datum] = {}
        """What the base has of them."""
        self.stores = {id: DurableStore(epoch=0x1000 + id) for id in (*HONEST, CAPTURED)}
        self.trusts = {id: trust_of(keyring(id), random.Random(id)) for id in self.stores}
        self.agents = {id: self.start(id) for id in self.stores}
        if not world & 4:
            self.settle()

    def start(self, id: int) -> Agent:
        self.lives += 1
        agent = build_node(
            settings_of(id, self.mirror), self.stores[id], random.Random(self.lives), now=self.now,
            newborn=self.lives <= len(self.stores), forgiving=self.forgiving, keys=self.trusts[id],
        )  # fmt: skip
        self.stores[id].commit()
        return agent

    def settle(self) -> None:
        """All know each other and the way to the base."""
        for _ in range(INTRODUCED):
            self.step()
        # The base's first anchor left before anybody knew its stream. It comes once more, to save the time until it is
        # asked for.
        [anchor] = {payload for payload in map(payload_of, self.air) if payload[:2] == HEAD_OF_ANCHOR}
        self.say(BASE, frames_about_links([anchor], self.agents[BASE].peers.writer, TYPE))
        self.step()
        self.step()
        assert all(agent.node.routing.route for agent in self.agents.values())

    def step(self) -> None:
        self.now += 1.0
        for id, agent in self.agents.items():
            self.say(id, agent.step(self.now))

    def say(self, id: int, frames: Sequence[Outgoing]) -> None:
        """All hear it, and the answers."""
        self.stores[id].commit()
        waiting = deque((id, outgoing) for outgoing in frames)
        count = 0
        while waiting:
            sender, outgoing = waiting.popleft()
            if outgoing.way is not Way.NEIGHBOURS:
                continue
            count += 1
            assert count < ENDLESS, "an answer to each answer"
            frame = self.leaving(sender, outgoing)
            self.air.append(frame)
            for other in self.agents:
                self.sent += 1
                if other != sender and not self.loss >> self.sent % 8 & 1:
                    waiting += [(other, answer) for answer in self.heard(other, frame)]

    def leaving(self, sender: int, outgoing: Outgoing) -> bytes:
        frame = self.agents[sender].peers.leaving(outgoing).frame
        self.stores[sender].commit()
        return frame

    def heard(self, id: int, data: bytes) -> Sequence[Outgoing]:
        answers = self.agents[id].peer_bytes(data, self.now)
        self.stores[id].commit()
        return answers

    def attack(self, whom: int, data: bytes) -> None:
        """One of the honest hears it, or all."""
        for id in HONEST if self.source.byte() & 1 else (whom,):
            self.say(id, self.heard(id, data))

    def stranger(self, whom: int, data: bytes) -> None:
        """The same with what nobody has signed: it is not even looked at."""
        before = [self.agents[id].peers.received for id in HONEST]
        self.attack(whom, data)
        assert [self.agents[id].peers.received for id in HONEST] == before

    def captured(self, whom: int, payload: bytes) -> None:
        """What the captured drone sends besides, in its own stream."""
        if not payload:
            return
        peers = self.agents[CAPTURED].peers
        [outgoing] = frames_about_links([payload[:MAX_TUNNEL]], peers.writer, TYPE)
        self.attack(whom, self.leaving(CAPTURED, outgoing))

    def lie(self, whom: int, make: Callable[[], Message]) -> None:
        """The same with a message, whoever is named in it."""
        try:
            message = sealed(make())
            tags = keyed(self.agents[CAPTURED]).tags
            said = tags.encoded(message, self.stores[CAPTURED], self.now) if self.speaks else encode(message, self.now)
        except (ValueError, OverflowError, struct.error):
            return
        self.captured(whom, self.source.pick(said))

    def recorded(self) -> bytes:
        return self.source.pick(self.air) if self.air else b""

    def recorded_payload(self) -> bytes:
        return payload_of(self.recorded())

    def changed_bytes(self, data: bytes) -> bytes:
        changed = bytearray(data)
        for _ in range(self.source.byte() % 4):
            changed[self.source.byte() % len(changed)] = self.source.byte()
        return bytes(changed)

    def junk(self) -> bytes:
        """A payload that begins like one of ours."""
        return self.source.pick(HEADS) + self.source.some(self.source.byte() % MAX_TUNNEL)

    # -- what must hold ------------------------------------------------------------------------------------------------

    def check(self) -> None:
        for agent in self.agents.values():
            assert agent.guard.faults == 0
        self.check_data()
        for id in HONEST:
            self.check_what_is_known(self.agents[id])
            self.check_bounds(id)

    def check_data(self) -> None:
        """No datum is gone, except what the captured drone has taken if it does not say what it does. Nothing arrives
        that nobody has created."""
        held = self.stores.values()
        if not self.speaks:
            for id, datum in self.created.items():
                assert any((found := store.get(id)) is not None and found.payload == datum.payload for store in held)
        base = self.stores[BASE]
        assert all(base.get(id) == datum for id, datum in self.arrived.items())
        assert self.created.keys() >= set(base.ids())
        for id, datum in self.created.items():
            there = base.get(id)
            if there is not None and there.payload == datum.payload:
                self.arrived[id] = there

    def check_what_is_known(self, agent: Agent) -> None:
        """There is one base, which has made all statements; and all key updates are the ground's."""
        true = BASE, self.stores[BASE].life
        node = agent.node
        assert isinstance(node, Node)
        if agent.settings.node_id != BASE:
            check_node(node)
        route = node.routing.route
        assert route is None or (route.base, route.base_life) == true
        assert isinstance(node.receipts, Receipts)
        assert not node.receipts.disagreement()
        assert all(statement[:2] == true for statement in node.receipts.identities())
        assert KEY_UPDATES.issuperset(self.trusts[agent.settings.node_id].key_updates.packed())

    def check_bounds(self, id: int) -> None:
        trust = keyed(self.agents[id])
        assert not trust.sessions.disagreement()
        assert len(trust.tags._offered) <= MAX_OFFERED
        key_updates = self.trusts[id].key_updates
        assert len(key_updates._table) <= key_update_table.MAX_KEY_UPDATES
        assert len(key_updates._asked.keys()) <= key_update_table.MAX_KEY_UPDATES
        assert len(key_updates._awaited) <= MAX_AWAITED
        assert len(trust.attestations.queue) <= attestations.MAX_STREAMS
        assert all(len(waiting) <= attestations.MAX_OF_STREAM for waiting in trust.attestations.queue.values())
        told, routes = trust.attestations.statement_signatures, trust.attestations.routes
        assert not told.disagreement()
        assert len(told.signatures) <= statement_signatures.MAX_KNOWN
        assert len(routes.bases) <= route_proofs.MAX_BASES
        assert len(routes._lacking) <= route_proofs.MAX_LACKING
        assert all(len(base.chains) <= route_proofs.MAX_CHAINS for base in routes.bases.values())


# -- deeds: what may happen, to whom -----------------------------------------------------------------------------------


def _turn(talk: _Talk, whom: int) -> None:
    talk.step()


def _put(talk: _Talk, whom: int) -> None:
    agent = talk.agents[whom]
    try:
        id = agent.node.put(bytes(1 + talk.source.byte()), talk.now, talk.source.byte() % 4)
    except (StoreFullError, DatumError):
        return
    datum = some(talk.stores[whom].get(id))
    talk.created[id] = datum
    talk.say(whom, agent.forward(talk.now))


def _restart(talk: _Talk, whom: int) -> None:
    talk.stores[whom] = talk.stores[whom].crashed()
    talk.agents[whom] = talk.start(whom)


def _wait(talk: _Talk, whom: int) -> None:
    talk.now += talk.source.byte()


def _lose(talk: _Talk, whom: int) -> None:
    talk.loss = talk.source.byte()


def _change_keys(talk: _Talk, whom: int) -> None:
    """The base takes a changed file."""
    if talk.changes:
        talk.trusts[BASE].key_updates.renew(keyring_of(talk.changes.pop(0), BASE))


# A stranger.


def _hear_bytes(talk: _Talk, whom: int) -> None:
    talk.stranger(whom, talk.source.some(talk.source.byte()))


def _hear_unsigned(talk: _Talk, whom: int) -> None:
    """Without a signature, or with another key."""
    how = talk.source.byte()
    payload = talk.recorded_payload() if how & 1 else talk.junk()
    signer = STRANGERS_KEY.signer(how >> 4, 1 << (how >> 2) % 48) if how & 2 else None
    frame = FrameWriter(how >> 4, 191, signer).tunnel(payload[:MAX_TUNNEL] or b"\0", payload_type=TYPE)
    talk.stranger(whom, frame)


def _hear_again(talk: _Talk, whom: int) -> None:
    frame = talk.recorded()
    if frame:
        talk.attack(whom, frame)


def _hear_noise(talk: _Talk, whom: int) -> None:
    """A true frame with changes, and a right checksum if somebody wants it to look like one."""
    frame = talk.recorded()
    if not frame:
        return
    noise = talk.changed_bytes(frame)
    if talk.source.byte() & 1:
        end = len(frame) - SIGNATURE_SIZE - 2
        check = crc16(noise[1:end] + FORMATS[TUNNEL_ID].crc_extra).to_bytes(2, "little")
        noise = noise[:end] + check + noise[end + 2 :]
    if noise != frame:
        talk.stranger(whom, noise)


# A captured drone.


def _junk(talk: _Talk, whom: int) -> None:
    talk.captured(whom, talk.junk())


def _changed_payload(talk: _Talk, whom: int) -> None:
    """What somebody has said, with some bytes changed, cut off, or with more behind it."""
    payload = talk.recorded_payload()
    if not payload:
        return
    payload = talk.changed_bytes(payload)[: talk.source.byte() or None] + talk.source.some(talk.source.byte() % 8)
    if payload[0] == VERSION << 4 | BEACON and len(payload) >= 43:
        crc = crc32(payload[:37] + payload[41:MAX_TUNNEL])
        payload = payload[:37] + crc.to_bytes(4, "little") + payload[41:]
    talk.captured(whom, payload)


def _changed_message(talk: _Talk, whom: int) -> None:
    try:
        message = decode(talk.recorded_payload() or b"\0", talk.now)
    except MalformedError:
        return
    talk.lie(whom, lambda: changed(message, talk.source))


def _invented(talk: _Talk, whom: int) -> None:
    known = [datum for store in talk.stores.values() for datum in store.disk.data.values()]
    liar = Liar(talk.source, talk.agents[whom].node, known, talk.now)
    talk.lie(whom, liar.message)


def _confirm(talk: _Talk, whom: int) -> None:
    """In the names of those who could, all that would let this node delete or release its copies."""
    holdings = talk.agents[whom].node.holdings
    pending = [(h.pending.to, h.pending.number, h.crc) for h in holdings.custody.values() if h.pending is not None]
    partners = [(h.partner.id, id) for id, h in (*holdings.replica.items(), *holdings.custody.items()) if h.partner]
    messages: list[Message] = [Committed(name, whom, ((number, crc),), ()) for name, number, crc in pending]
    for name, id in partners:
        for status in (CopyStatus.PASSED_ON, talk.source.byte() % len(CopyStatus)):
            messages.append(CopyStatuses(name, whom, (CopyStatusEntry(id, status),)))
    for message in messages:
        for payload in encode(message, talk.now):
            talk.captured(whom, payload + talk.source.some(talk.source.byte() % 13))


def _other_stream(talk: _Talk, whom: int) -> None:
    """Anything in a stream of somebody else, or in one that nobody has."""
    how = talk.source.byte()
    system = talk.source.pick((*HONEST, 77))
    link = talk.stores[system].epoch & 0xFF if system in talk.stores else how >> 4
    timestamp = talk.source.pick((0, 1 << 24, (1 << 24) + 100, 1 << 40, (1 << 48) - 2))
    payload = talk.recorded_payload() if how & 1 else talk.junk()
    signed = some(keyed(talk.agents[CAPTURED]).signed)
    writer = FrameWriter(system, 191, signed.key.signer(link, timestamp))
    talk.attack(whom, writer.tunnel(payload[:MAX_TUNNEL] or b"\0", payload_type=TYPE))


def _flood(talk: _Talk, whom: int) -> None:
    """One payload in many names: of streams, and of nodes where it names its sender."""
    payload = talk.recorded_payload() if talk.source.byte() & 1 else talk.junk()
    signed = some(keyed(talk.agents[CAPTURED]).signed)
    at = talk.source.byte() % 16
    for name in range(talk.source.byte()):
        renamed = payload[:at] + name.to_bytes(2, "little") + payload[at + 2 :]
        if name & 1:
            writer = FrameWriter(name, 191, signed.key.signer(name, 1 << 24))
            frame = writer.tunnel(renamed[:MAX_TUNNEL], payload_type=TYPE)
        else:
            [outgoing] = frames_about_links([renamed[:MAX_TUNNEL]], talk.agents[CAPTURED].peers.writer, TYPE)
            frame = talk.leaving(CAPTURED, outgoing)
        talk.say(whom, talk.heard(whom, frame))


DEEDS: tuple[Callable[[_Talk, int], None], ...] = (
    _turn, _put, _hear_bytes, _hear_unsigned, _hear_again, _hear_noise, _junk, _changed_payload, _changed_message,
    _invented, _confirm, _other_stream, _flood, _restart, _wait, _lose, _change_keys,
)  # fmt: skip


def play(data: bytes) -> None:
    """The first byte says what world it is. Each deed is a byte, what happens and to whom; most take more bytes."""
    source = Source(data)
    talk = _Talk(source)
    talk.check()
    for _ in range(MOST_DEEDS):
        if not source:
            break
        deed, whom = divmod(source.byte(), len(HONEST))
        DEEDS[deed % len(DEEDS)](talk, HONEST[whom])
        talk.check()
    # What waits for a step is looked at too.
    talk.step()
    talk.check()
