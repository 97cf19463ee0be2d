"""Nodes with keys in a row: each hears only those next to it. And one that was captured."""

from __future__ import annotations

import random
from typing import Any

from rass_mav.agent.agent import Agent
from rass_mav.agent.outgoing import Outgoing, Way
from rass_mav.core.datum import USUAL, Datum, DatumId, Terms, datum_crc, make_datum, parted
from rass_mav.core.messages import Data, Handover, Message
from rass_mav.core.news.archive import Archive
from rass_mav.core.node import Node
from rass_mav.core.seals import SEALED
from rass_mav.core.store import Store
from rass_mav.station.node import build_node
from rass_mav.store.memory import MemoryStore
from rass_mav.trust.keys.identity import Ground
from rass_mav.trust.keys.keyring import Keyring
from rass_mav.trust.keys.sealing import Opener, Sealer
from rass_mav.trust.keys.secret import Secret
from rass_mav.trust.trust import trust_of
from tests.some import some

from .agent_net import links_alone
from .build import on, settings_of

BASE = 1
GROUND = Ground(Secret(bytes(range(32))), serials={7: 1, 8: 1, 9: 1})
OPENER = Opener(GROUND)


def keyring(node_id: int) -> Keyring:
    return Keyring(GROUND.node(node_id), GROUND) if node_id == BASE else Keyring(GROUND.node(node_id, 1), None)


def make(
    node_id: int, store: Store | None = None, *, keys: bool = True, sealing: bool = True, accept_open: bool = False,
    **sections: Any,
) -> Agent:  # fmt: skip
    """A node with keys for its links and its data; node `BASE` is a base. `sealing`: False: its data are open."""
    settings = settings_of(node_id, base=node_id == BASE, forward="immediate", **sections)
    trust = None
    if keys:
        whole = trust_of(keyring(node_id), random.Random(node_id), accept_open=accept_open)
        trust = links_alone(keyring(node_id), whole.key_updates)
        if sealing:
            trust = trust._replace(seals=whole.seals)
    rng = random.Random(node_id)
    return build_node(settings, store or MemoryStore(1000 + node_id), rng, now=0.0, newborn=True, keys=trust)


class Row:
    """Steps of one second."""

    def __init__(self, *agents: Agent) -> None:
        self.agents = agents
        self.now = 0.0
        self.frames: list[bytes] = []
        """All that was on the air."""

    def step(self) -> None:
        self.now += 1.0
        for place, agent in enumerate(self.agents):
            if not agent.settings.base:
                agent.reading(1e6, self.now)  # the worst risk, and something to measure
            self._deliver([(place, outgoing) for outgoing in on(Way.NEIGHBOURS, agent.step(self.now))])

    def until(self, now: float) -> None:
        while self.now < now:
            self.step()

    def put(self, place: int, payload: bytes, kind: int = 0, terms: Terms = USUAL) -> DatumId:
        """A node creates a datum, which moves on at once."""
        agent = self.agents[place]
        id = agent.node.put(payload, self.now, kind, terms)
        self._deliver([(place, outgoing) for outgoing in on(Way.NEIGHBOURS, agent.forward(self.now))])
        return id

    def say(self, place: int, message: Message) -> None:
        """Somebody at a place says anything, in any name."""
        agent = self.agents[place]
        frames = agent.peers.frames([message], agent.store, self.now)
        self._deliver([(place, outgoing) for outgoing in frames])

    def _deliver(self, waiting: list[tuple[int, Outgoing]]) -> None:
        while waiting:
            place, outgoing = waiting.pop(0)
            frame = self.agents[place].peers.leaving(outgoing).frame
            self.frames.append(frame)
            for other in (place - 1, place + 1):
                if 0 <= other < len(self.agents):
                    answers = on(Way.NEIGHBOURS, self.agents[other].peer_bytes(frame, self.now))
                    waiting += [(other, answer) for answer in answers]


def forged_by(captured: int, id: DatumId, payload: bytes = b"a lie", *, now: float = 0.0) -> Datum:
    """What a captured drone can make of its own keys in another's name."""
    sealed = Sealer(GROUND.node(captured, 1), id.epoch, id.sequence).seal(id.sequence, 0, payload)
    return make_datum(id, SEALED, now, sealed)


def with_crc(datum: Datum, crc: int) -> Datum:
    """The same with other last bytes, so that it has this CRC: CRC-32 is linear, so anybody can find them."""
    prefix = datum.payload[:-4]

    def crc_of(word: int) -> int:
        return datum_crc(datum.id, datum.kind, prefix + word.to_bytes(4, "little"))

    # Gauss over GF(2): each bit of the last word flips a fixed set of bits of the CRC.
    zero, rows = crc_of(0), [(crc_of(1 << bit) ^ crc_of(0), 1 << bit) for bit in range(32)]
    word, wanted = 0, zero ^ crc
    for bit in range(31, -1, -1):
        pivot = some(next((row for row in rows if row[0] >> bit & 1), None))
        rows = [(a ^ pivot[0], b ^ pivot[1]) if a >> bit & 1 else (a, b) for a, b in rows if (a, b) != pivot]
        if wanted >> bit & 1:
            wanted, word = wanted ^ pivot[0], word ^ pivot[1]
    found = datum._replace(payload=prefix + word.to_bytes(4, "little"), crc=crc)
    assert found.intact
    return found


def handed(sender: int, target: int, datum: Datum, number: int = 77) -> Data:
    return Data(sender, target, (Handover(number, datum),))


def arrived(base: Agent) -> Archive:
    """What a base tells as arrived."""
    assert isinstance(base.node, Node)
    assert base.node.archive is not None
    return base.node.archive


def opened(agent: Agent, id: DatumId) -> bytes:
    """The contents of what a node stores, with the ground's keys."""
    datum = some(agent.store.get(id))
    assert datum.kind & SEALED
    terms, sealed = parted(datum.kind, datum.payload)
    return OPENER.open(id, datum.kind & ~SEALED, sealed, terms)
