"""Two attackers who understand what they overhear, among a few agents that forgive nothing.

Open, the attackers are outsiders. With keys they are captured drones, which take part in the swarm besides. They
remember every field of every message that was on the air. They say any kind of message, made of these fields: in the
names of others, with fields changed, more than once, late, and in answer to what was said. A fault of a node raises.

The bytes make all choices. When they are used up, choices that depend on them only make the rest of the world. So any
bytes are a whole world, and a change of one byte changes the rest.

`python -m tests.fuzz.attackers --seconds 1800` plays worlds without a guide, and counts what happened in them.
"""

from __future__ import annotations

import argparse
import logging
import random
import struct
import time
from collections import Counter, deque
from collections.abc import Container, Iterable, Sequence
from functools import cache
from typing import Any

from rass_mav.agent.agent import Agent
from rass_mav.agent.outgoing import Outgoing, Way
from rass_mav.agent.settings import AgentSettings
from rass_mav.config.loading import convert
from rass_mav.core.datum import Datum, DatumId, make_datum
from rass_mav.core.exchange import SPREAD_S
from rass_mav.core.messages import (
    BROADCAST,
    Accept,
    Beacon,
    Chunk,
    Committed,
    CopyStatuses,
    Data,
    DeletionReport,
    Message,
    Offer,
    Receipt,
    Sack,
    SequenceMark,
)
from rass_mav.core.node import Node
from rass_mav.core.store import MAX_APART
from rass_mav.errors import DatumError, MalformedError, StoreFullError
from rass_mav.lab.medium.air import open_datagram
from rass_mav.lab.swarm.mission import keyring_of
from rass_mav.mavlink.frames import FrameWriter
from rass_mav.station.node import build_node
from rass_mav.trust.keys.identity import Ground
from rass_mav.trust.keys.keyring import Keyring
from rass_mav.trust.keys.secret import Secret
from rass_mav.trust.trust import trust_of
from rass_mav.wire import MAX_TUNNEL, decode, encode
from tests.core.books import check_node
from tests.core.durable import DurableStore
from tests.keyed import keyed
from tests.some import some
from tests.wire.samples import SAMPLES

from .forging import EDGES, sealed

BASE, ATTACKERS, MOST_DRONES = 1, (8, 9), 4
TYPE = 33200
GROUND = Ground(Secret(bytes(range(32))), serials=dict.fromkeys((*range(2, 2 + MOST_DRONES), *ATTACKERS), 1))
#: Steps in one world, deeds of an attacker in a step, and messages in a row of the same kind.
MOST_STEPS, MOST_DEEDS, MOST_IN_A_ROW = 40, 8, 8
#: Parts of a step after which what waits is sent.
TENDED = (0.0, 0.03, 0.3, 0.7)
#: What is remembered of each field, and of each kind of message.
REMEMBERED = 48
#: Frames heard in one moment: more are answers to answers without end. In world 4285 several large data go from node to
#: node in one moment, which are 4,119 for all who hear them, and then it is quiet.
ENDLESS = 20_000
#: Sizes of data: they fit a frame, or come in chunks.
SIZES = (1, 20, 97, 98, 246, 400, 1500)
#: Fields with the same meaning have the same pool.
ALIASES = {
    **dict.fromkeys(
        ("target", "base", "giver", "writer", "origin", "near", "custodian", "further", "wanted_base", "holders"),
        "sender",
    ),
    **dict.fromkeys(("base_life", "epoch"), "life"),
    **dict.fromkeys(("refused", "committed"), "number"),
    **dict.fromkeys(("route_number", "wanted_number", "lamport"), "serial"),
    **dict.fromkeys(("position", "next_index", "question"), "index"),
    **dict.fromkeys(("first", "assigned"), "sequence"),
    "ids": "id",
}  # fmt: skip
#: Kinds of messages about the same things. Of transfers a node remembers most.
FAMILIES: tuple[tuple[type, ...], ...] = (
    (Offer, Offer, Accept, Chunk, Sack),
    (Offer, Committed),
    (Data, Committed, DeletionReport, CopyStatuses),
    (Receipt, SequenceMark, Data),
    (Beacon,),
)
#: Fields that say what a message is about.
SUBJECTS = {"id", "ids", "number", "crc", "handle", "serial", "handovers", "entries", "committed", "others", "life"}
#: Of fields that do not fit a message.
UNSAYABLE = ValueError, OverflowError, struct.error


class Choices(random.Random):
    """Random choices that some bytes make, and after them what follows from the bytes."""

    def __new__(cls, data: bytes) -> Choices:
        return super().__new__(cls)

    def __init__(self, data: bytes) -> None:
        self._data = b""
        super().__init__(data)
        self._data, self._at = data, 0

    def getrandbits(self, k: int, /) -> int:
        """The next bytes, as many as are needed."""
        if not k or self._at >= len(self._data):
            return super().getrandbits(k) if k else 0
        size = -(-k // 8)
        taken = self._data[self._at : self._at + size].ljust(size, b"\0")
        self._at += size
        return int.from_bytes(taken, "little") & (1 << k) - 1

    def random(self) -> float:
        """In steps of 1/65536."""
        return self.getrandbits(16) / 65536

    def _randbelow(self, n: int) -> int:
        # `random.Random` draws until it is below.
        return self.getrandbits(max(8, n.bit_length())) % n


class Memory:
    """What an attacker has overheard, and what it has said itself."""

    def __init__(self, choices: Choices) -> None:
        self._choices = choices
        self._fields: dict[str, deque[Any]] = {}
        self._kinds: dict[type, deque[Message]] = {}
        self.payloads: deque[bytes] = deque(maxlen=REMEMBERED)
        for message in SAMPLES.values():
            self._kinds.setdefault(type(message), deque(maxlen=REMEMBERED)).append(message)
        families = [family for family in FAMILIES if not self._kinds.keys().isdisjoint(family)]
        known = {kind for family in families for kind in family}
        families.append(tuple([kind for kind in self._kinds if kind not in known]))
        chosen = choices.sample([family for family in families if family], choices.choice((1, 1, 2)))
        self._themes = [kind for family in chosen for kind in family]
        """What this attacker speaks of most: of all, it would seldom say enough of one."""

    def keep(self, message: Message) -> None:
        """Remember a message, and each of its fields."""
        self._kinds.setdefault(type(message), deque(maxlen=REMEMBERED)).append(message)
        self._keep(type(message).__name__, message)

    def _keep(self, name: str, value: Any) -> None:
        if isinstance(value, tuple):
            if hasattr(value, "_fields"):
                if isinstance(value, (Datum, DatumId)):
                    self._field("datum" if isinstance(value, Datum) else "id").append(value)
                for field, part in zip(value._fields, value, strict=True):
                    self._keep(field, part)
            else:
                for part in value:
                    self._keep(name, part)
        else:
            self._field(name).append(value)

    def _field(self, name: str) -> deque[Any]:
        return self._fields.setdefault(ALIASES.get(name, name), deque(maxlen=REMEMBERED))

    def value(self, name: str, otherwise: Any) -> Any:
        """One that a field had, rather a recent one."""
        found = self.recent(self._field(name))
        return otherwise if found is None else found

    def kind(self) -> type:
        """A kind of message."""
        return self._choices.choice(self._themes if self._choices.random() < 0.8 else list(self._kinds))

    def message(self, kind: type) -> Message:
        """One of a kind, rather a recent one."""
        found: Message = self.recent(self._kinds[kind])
        return found

    def recent(self, things: Sequence[Any]) -> Any:
        """One of them, rather one of the last; None: there is none."""
        if not things:
            return None
        last = 4 if self._choices.random() < 0.5 else len(things)
        return things[-1 - self._choices.randrange(min(last, len(things)))]


class Attacker:
    """Says what it makes of what it has overheard."""

    def __init__(self, id: int, choices: Choices) -> None:
        self.id = id
        self.choices = choices
        self.memory = Memory(choices)
        self.number = choices.getrandbits(16)
        self.names = [id]
        """Of the nodes that it hears."""
        self._guise, self._victim, self._kind = id, BASE, self.memory.kind()
        """In whose name it speaks to whom, and about what, for a while."""
        self.said: deque[Message] = deque(maxlen=REMEMBERED)
        self.raw: deque[bytes] = deque(maxlen=REMEMBERED)
        """Payloads that are no messages of core."""
        self.addressed: deque[Message] = deque(maxlen=REMEMBERED)
        """Messages that want an answer."""

    def overhear(self, payload: bytes, now: float) -> None:
        self.memory.payloads.append(payload)
        try:
            message = decode(payload, now)
        except MalformedError:
            self.raw.append(payload)
            return
        if message is None:
            return
        self.memory.keep(message)
        if isinstance(message, Beacon) and message.sender not in self.names:
            self.names.append(message.sender)
        if isinstance(message, (Data, Offer, Chunk, DeletionReport)):
            self.addressed.append(message)

    # -- what it says --------------------------------------------------------------------------------------------------

    def deed(self, now: float) -> Iterable[Message | bytes]:
        """One thing that it does, of one or more messages."""
        how = self.choices.choice(
            (self._beacon, self._again, self._changed, self._changed, self._row, self._row, self._answer, self._raw)
        )
        return how(now)

    def _beacon(self, now: float) -> Iterable[Message | bytes]:
        """Be a neighbour: under its own name, twice in order."""
        for _ in range(2):
            self.number = self.number + 1 & 0xFFFF
            template = self.memory.message(Beacon)
            assert isinstance(template, Beacon)
            yield template._replace(sender=self.id, life=self.id, number=self.number, answers=())

    def _again(self, now: float) -> Iterable[Message | bytes]:
        """What was said, once more."""
        if self.memory.payloads:
            yield self.choices.choice(self.memory.payloads)

    def _changed(self, now: float) -> Iterable[Message | bytes]:
        message = self.memory.message(self.memory.kind())
        for _ in range(self.choices.randrange(4)):
            message = self.change(message)
        yield message

    def _row(self, now: float) -> Iterable[Message | bytes]:
        """Several of a kind in one name and to one node, each about something else, or about what one before was."""
        if self.choices.random() < 0.05:
            self._guise, self._victim, self._kind = self._name(), self._name(), self.memory.kind()
        before = [message for message in self.said if type(message) is self._kind]
        old = before and self.choices.random() < 0.5
        message: Any = self.memory.recent(before) if old else self.memory.message(self._kind)
        if "sender" in message._fields and self.choices.random() < 0.8:
            message = message._replace(sender=self._guise)
        if "target" in message._fields and self.choices.random() < 0.8:
            message = message._replace(target=self._victim)
        about = [name for name in message._fields if name in SUBJECTS]
        among = [self.choices.choice(about)] if about else ()
        said = [message]
        for _ in range(self.choices.randrange(MOST_IN_A_ROW)):
            said.append(self.change(message, among))
        for _ in range(self.choices.randrange(4)):
            # What was said before of something else, above all of the first.
            one = said[0] if self.choices.random() < 0.5 else self.choices.choice(said)
            said.append(self.change(one, SUBJECTS))
        yield from said

    def _answer(self, now: float) -> Iterable[Message | bytes]:
        """What somebody could answer, perhaps somebody else, and perhaps wrongly."""
        if not self.addressed:
            return
        to, choices = self.memory.recent(self.addressed), self.choices
        message: Message
        if isinstance(to, Offer):
            handle = choices.choice((choices.getrandbits(16), self.memory.value("handle", 0)))
            message = Accept(to.target, to.sender, to.number, handle, 0, 0)
        elif isinstance(to, Chunk):
            index = to.position if to.data else 0
            message = Sack(self._name(), self._name(), to.handle, index, 0, 0 if to.data else to.position)
        elif isinstance(to, Data):
            pairs = tuple([(number, datum.crc) for number, datum in to.handovers])
            message = Committed(to.target, to.sender, pairs, ())
        else:
            assert isinstance(to, DeletionReport)
            message = Committed(to.target, to.sender, tuple([(e.number, e.crc) for e in to.entries]), ())
        for _ in range(choices.randrange(3)):
            message = self.change(message)
        yield message

    def _raw(self, now: float) -> Iterable[Message | bytes]:
        """Bytes of a payload changed: also of what is no message."""
        choices, some = self.choices, self.raw if self.choices.random() < 0.7 else self.memory.payloads
        if not some:
            return
        payload = bytearray(choices.choice(some))
        for _ in range(choices.randrange(4)):
            at = choices.randrange(len(payload))
            name = self._name().to_bytes(2, "little")
            payload[at : at + 2] = name if choices.random() < 0.3 else bytes([choices.getrandbits(8)])
        if choices.random() < 0.2:
            del payload[choices.randrange(len(payload)) :]
        yield bytes(payload[:MAX_TUNNEL]) or b"\0"

    # -- fields --------------------------------------------------------------------------------------------------------

    def _name(self) -> int:
        return self.choices.choice(self.names) if self.choices.random() < 0.9 else self.choices.getrandbits(16)

    def change(self, message: Message, among: Container[str] = ()) -> Message:
        """The same with another field, or part of one; `among`: its names, if there is one of these."""
        names = [name for name in message._fields if name in among] or message._fields
        name = self.choices.choice(names)
        return message._replace(**{name: self._other(name, getattr(message, name))})

    def _other(self, name: str, value: Any) -> Any:
        choices, memory = self.choices, self.memory
        if isinstance(value, bool):
            return not value
        if isinstance(value, DatumId):
            if choices.random() < 0.5:
                return memory.value("id", value)
            at = choices.randrange(3)
            return value._replace(**{value._fields[at]: self._other(value._fields[at], value[at])})
        if isinstance(value, Datum):
            return self._datum(value)
        if isinstance(value, int):
            how = choices.random()
            if ALIASES.get(name, name) == "sender":
                return self._name()
            if how < 0.6 and isinstance(known := memory.value(name, None), int):
                return known
            near = value + choices.choice((1, -1)), value ^ 1 << choices.randrange(32), choices.choice(EDGES)
            return choices.choice(near)
        if isinstance(value, float):
            return value - choices.choice((-10.0, 1.0, 100.0, 1e6))
        if isinstance(value, bytes):
            return value[: choices.randrange(len(value) + 1)] + choices.randbytes(choices.randrange(8))
        if not isinstance(value, tuple):
            return value
        if hasattr(value, "_make"):
            fields: dict[str, Any] = getattr(value, "_asdict")()  # noqa: B009
            changed = choices.choice(list(fields))
            return value._make([self._other(f, v) if f == changed else v for f, v in fields.items()])
        if not value:
            return value
        how, at = choices.random(), choices.randrange(len(value))
        if how < 0.7:
            return (*value[:at], self._other(name, value[at]), *value[at + 1 :])
        return value[:at] if how < 0.85 else (*value, self._other(name, value[at]))

    def _datum(self, datum: Datum) -> Datum:
        """Another, or the same id with another content; its checksum is right."""
        choices = self.choices
        if choices.random() < 0.4:
            known = self.memory.value("datum", datum)
            assert isinstance(known, Datum)
            return known
        id, kind, payload = datum.id, datum.kind, datum.payload
        how = choices.randrange(3)
        if how == 0:
            id = self._other("id", id)
        elif how == 1:
            kind = choices.getrandbits(8)
        else:
            payload = self._other("payload", payload)
        made = make_datum(id, kind & 0xFF, datum.created, payload or b"\0")
        return made._replace(hops=self._other("hops", datum.hops) & 0xFF) if choices.random() < 0.3 else made


@cache
def keyring(node_id: int) -> Keyring:
    return keyring_of(GROUND, node_id)


class World:
    """Who is there, and what must hold whatever is said."""

    def __init__(self, data: bytes) -> None:
        self.choices = choices = Choices(data)
        self.counts: Counter[str] = Counter()
        self.keys = choices.random() < 0.4
        self.drones = tuple(range(2, 2 + choices.randrange(2, MOST_DRONES + 1)))
        self.honest = BASE, *self.drones
        self.line = choices.random() < 0.3
        """Each hears only those next to it, and the attackers."""
        self.loss = choices.choice((0.0, 0.0, 0.1, 0.4))
        self.shuffled = choices.random() < 0.5
        """Frames overtake each other."""
        self.spread_s = choices.choice((0.0, SPREAD_S))
        self.settings = {
            "forward": choices.choice(("immediate", "step")),
            "store": {"capacity_items": choices.choice((6, 12, 50))},
            "custody": {"replicas": choices.random() < 0.8, "receipt_steps": choices.choice((1, 6))},
            "policy": {"name": choices.choice(("survival", "rass"))},
        }
        self.now = 1000.0
        self.lives = 0
        ids = (*self.honest, *ATTACKERS) if self.keys else self.honest
        self.stores = {id: DurableStore(epoch=0x1000 + id) for id in ids}
        self.trusts = {id: trust_of(keyring(id), random.Random(id)) for id in ids} if self.keys else {}
        self.agents = {id: self.start(id) for id in ids}
        self.attackers = [Attacker(id, choices) for id in ATTACKERS]
        self.air: deque[tuple[int, bytes]] = deque()
        """Frames, each with who hears it."""
        self.arrived: dict[DatumId, Datum] = {}

    def start(self, id: int) -> Agent:
        self.lives += 1
        raw: dict[str, Any] = {"node_id": id, "base": id == BASE, "step_s": 1.0}
        raw |= {"mavlink": {"system_id": id}, "data": {"interval_steps": 0}, **self.settings}
        agent = build_node(
            convert(raw, AgentSettings, "test"), self.stores[id], random.Random(self.lives), now=self.now,
            newborn=self.lives <= len(self.stores), keys=self.trusts.get(id),
        )  # fmt: skip
        agent.answers.spread_s = self.spread_s
        self.stores[id].commit()
        return agent

    # -- the air -------------------------------------------------------------------------------------------------------

    def say(self, id: int, frames: Sequence[Outgoing]) -> None:
        """A node says something: commit, then send."""
        self.stores[id].commit()
        for outgoing in frames:
            if outgoing.way is Way.NEIGHBOURS:
                frame = self.agents[id].peers.leaving(outgoing).frame
                opened = some(open_datagram(frame, 0.0))
                for attacker in self.attackers:
                    attacker.overhear(opened[3], self.now)
                self.send(id, frame)
        self.stores[id].commit()

    def send(self, id: int, frame: bytes, only: int | None = None) -> None:
        """A frame is on the air; `only`: who hears it."""
        for other in self.agents:
            near = not self.line or {id, other} & set(ATTACKERS) or abs(id - other) == 1
            if other != id and near and only in (None, other) and self.choices.random() >= self.loss:
                self.air.append((other, frame))

    def deliver(self) -> None:
        """All that is on the air, and the answers."""
        count = 0
        while self.air:
            count += 1
            assert count < ENDLESS, "an answer to each answer"
            if self.shuffled:
                self.air.rotate(self.choices.randrange(min(8, len(self.air))))
            id, frame = self.air.popleft()
            self.counts["frames heard"] += 1
            agent = self.agents[id]
            # As in a real node, but nobody catches what it raises.
            for whole in agent.peers.tunnels(frame):
                self.say(id, agent.peer_frame(whole, self.now))

    # -- what happens --------------------------------------------------------------------------------------------------

    def step(self) -> None:
        self.now += 1.0
        for id in list(self.agents):
            self.say(id, self.agents[id].step(self.now))
        self.deliver()
        self.happen()
        start = self.now
        for part in TENDED:
            self.now = start + part
            for attacker in self.attackers:
                for _ in range(self.choices.randrange(MOST_DEEDS)):
                    self.do(attacker)
            self.deliver()
            for id in list(self.agents):
                self.say(id, self.agents[id].tend(self.now)[0])
            self.deliver()
        self.now = start
        self.check()

    def happen(self) -> None:
        """What honest nodes do, and what befalls them."""
        choices = self.choices
        for id in self.drones:
            if choices.random() < 0.5:
                self.put(id)
        if choices.random() < 0.04:
            id = choices.choice(self.honest)
            self.stores[id] = self.stores[id].crashed()
            self.agents[id] = self.start(id)
            self.counts["restarts"] += 1
        if choices.random() < 0.05:
            self.now += choices.choice((5.0, 30.0, 300.0))
        drone = choices.choice(self.drones)
        stored = list(self.stores[drone].ids())
        if stored and choices.random() < 0.05:
            self.stores[drone].flip_bit(choices.choice(stored))

    def put(self, id: int) -> None:
        agent = self.agents[id]
        try:
            agent.node.put(self.choices.randbytes(self.choices.choice(SIZES)), self.now, self.choices.randrange(4))
        except (StoreFullError, DatumError):
            return
        self.counts["data"] += 1
        self.say(id, agent.forward(self.now))
        self.deliver()

    def do(self, attacker: Attacker) -> None:
        try:
            said = list(attacker.deed(self.now))
        except UNSAYABLE:
            return
        for one in said:
            self.attack(attacker, one)

    def attack(self, attacker: Attacker, said: Message | bytes) -> None:
        """One node hears it, or all."""
        choices = self.choices
        if isinstance(said, bytes):
            payloads = [said]
        else:
            try:
                said = sealed(said)
                if self.keys:
                    tags = keyed(self.agents[attacker.id]).tags
                    payloads = tags.encoded(said, self.stores[attacker.id], self.now)
                else:
                    payloads = encode(said, self.now)
            except UNSAYABLE:
                self.counts["cannot be said"] += 1
                return
            attacker.said.append(said)
            self.counts[type(said).__name__] += 1
        only = choices.choice(self.honest) if choices.random() < 0.5 else None
        for payload in payloads:
            self.counts["frames of attackers"] += 1
            for _ in range(2 if choices.random() < 0.1 else 1):
                self.send(attacker.id, self.signed(attacker, payload[:MAX_TUNNEL] or b"\0"), only)

    def signed(self, attacker: Attacker, payload: bytes) -> bytes:
        """A frame as the attacker sends it: with keys in its own stream, or in that of another node."""
        choices = self.choices
        if not self.keys:
            system = choices.choice((*self.honest, attacker.id, choices.getrandbits(8)))
            return FrameWriter(system, 191).tunnel(payload, payload_type=TYPE)
        peers = self.agents[attacker.id].peers
        if choices.random() < 0.7:
            frame = peers.writer.tunnel(payload, payload_type=TYPE)
            return peers.leaving(Outgoing(frame, BROADCAST, False)).frame
        trust = keyed(self.agents[attacker.id])
        system = choices.choice(self.honest)
        link = self.stores[system].epoch & 0xFF
        timestamp = choices.choice((0, 1 << 24, (1 << 24) + 1000, 1 << 40, (1 << 47) + 5, (1 << 48) - 99))
        signer = trust.signed.key.signer(link, timestamp + choices.randrange(64))
        return FrameWriter(system, 191, signer).tunnel(payload, payload_type=TYPE)

    # -- what must hold ------------------------------------------------------------------------------------------------

    def check(self) -> None:
        """The books are right, all tables are bounded, and what has arrived stays as it is."""
        for id in self.honest:
            node, store = self.agents[id].node, self.stores[id]
            assert isinstance(node, Node)
            assert len(list(store.apart())) <= MAX_APART
            if id != BASE:
                check_node(node)
                assert set(node.holdings) == set(store.ids())
        there = self.stores[BASE].disk.data
        assert all(there.get(id) == datum for id, datum in self.arrived.items())
        self.arrived = dict(there)


def play(data: bytes) -> None:
    """One world. The attackers stop at the end, and the swarm goes on for a few steps."""
    watch(data)


def watch(data: bytes) -> Counter[str]:
    """The same. Returns what happened."""
    world = World(data)
    for _ in range(world.choices.randrange(2, 6)):
        # They know each other.
        for attacker in world.attackers:
            for said in attacker._beacon(world.now):
                world.attack(attacker, said)
        world.step()
    for _ in range(world.choices.randrange(10, MOST_STEPS)):
        world.step()
    world.attackers = []
    for _ in range(5):
        world.step()
    world.counts["arrived"] = len(world.arrived)
    world.counts["worlds with keys" if world.keys else "open worlds"] = 1
    return world.counts


def main() -> None:
    """Play worlds until the time is over or something is found."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz.attackers")
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=1, help="of the first world; the next one has the next")
    parser.add_argument("--worlds", type=int, default=1 << 31)
    options = parser.parse_args()
    logging.disable(logging.CRITICAL)
    until, counts, seed = time.monotonic() + options.seconds, Counter[str](), options.seed
    while time.monotonic() < until and seed < options.seed + options.worlds:
        try:
            counts += watch(random.Random(seed).randbytes(16))
        except BaseException:
            print(f"found in world {seed}, after {dict(sorted(counts.items()))}", flush=True)  # noqa: T201
            raise
        seed += 1
    print(f"worlds {options.seed} to {seed - 1}: {dict(sorted(counts.items()))}")  # noqa: T201


if __name__ == "__main__":
    main()
