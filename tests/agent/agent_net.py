"""Agents with keys in range of each other, in steps of one second, and everything that was on the air."""

from __future__ import annotations

import random
from collections.abc import Callable, Sequence
from typing import Any, cast

from rass_mav.agent.agent import Agent
from rass_mav.agent.outgoing import Outgoing, Way
from rass_mav.core.datum import DatumId
from rass_mav.core.messages import BROADCAST, Beacon, Query
from rass_mav.core.seals import NoSeals
from rass_mav.core.store import Store
from rass_mav.lab.medium.air import open_datagram
from rass_mav.station.node import build_node
from rass_mav.store.memory import MemoryStore
from rass_mav.trust.key_updates import KeyUpdates
from rass_mav.trust.keys.attestation import Attestation
from rass_mav.trust.keys.identity import Ground
from rass_mav.trust.keys.keyring import Keyring
from rass_mav.trust.keys.secret import Secret
from rass_mav.trust.trust import Signed, Trust
from rass_mav.wire import beacon_sender
from tests.keyed import keyed
from tests.wire.samples import SAMPLES

from .build import settings_of

GROUND = Ground(Secret(bytes(range(32))))
KEY = GROUND.link.key.reveal()
STRANGERS = Ground(Secret(bytes(32)))
STRANGERS_KEY = STRANGERS.link.key.reveal()
BEACON = cast(Beacon, SAMPLES["beacon-drone"])


def links_alone(keyring: Keyring, key_updates: KeyUpdates) -> Trust:
    """All but sealed data."""
    return Trust(key_updates, keyring.own, lambda _: NoSeals(), Attestation(keyring))


def keyring_in(ground: Ground, node_id: int, *, base: bool) -> Keyring:
    return Keyring(ground.node(node_id), ground) if base else Keyring(ground.node(node_id, 1), None)


def agent_with_keys(
    node_id: int, store: Store | None = None, *, base: bool = False, life: int = 0, now: float = 0.0,
    ground: Ground = GROUND, key_updates: KeyUpdates | None = None, **sections: Any,
) -> Agent:  # fmt: skip
    """`life`: another one has other random numbers. `key_updates`: None: those of a node that has just started."""
    sections["mavlink"] = {"system_id": node_id, **sections.get("mavlink", {})}
    store = MemoryStore(1000 + node_id) if store is None else store
    rng = random.Random(f"{node_id}:{life}")
    keyring = keyring_in(ground, node_id, base=base) if key_updates is None else key_updates.keyring
    trust = links_alone(keyring, KeyUpdates(keyring, random.Random(node_id)) if key_updates is None else key_updates)
    return build_node(settings_of(node_id, base=base, forward="immediate", **sections), store, rng, now=now, keys=trust)


class AgentNet:
    """What the test makes deaf or dumb hears or says nothing."""

    def __init__(self, *agents: Agent) -> None:
        self.now = 0.0
        self.agents = list(agents)
        self.deaf: set[int] = set()
        """Positions in `agents`."""
        self.apart: set[frozenset[int]] = set()
        """Pairs of positions that do not hear each other."""
        self.lost: Callable[[], bool] = lambda: False
        """Whether somebody misses a frame."""
        self.recorded: list[bytes] = []
        """All frames that were on the air, in order."""

    def steps(self, count: int) -> None:
        for _ in range(count):
            self.now += 1.0
            for position, agent in enumerate(self.agents):
                if not agent.settings.base:
                    agent.reading(1e6, self.now)  # the worst risk, and something to measure
                self.say(position, agent.step(self.now))

    def say(self, sender: int, frames: Sequence[Outgoing]) -> None:
        """Frames are on the air, and then the answers to them."""
        waiting = [(sender, outgoing) for outgoing in frames]
        while waiting:
            position, outgoing = waiting.pop(0)
            if outgoing.way is not Way.NEIGHBOURS:
                continue
            frame = self.agents[position].peers.leaving(outgoing).frame
            self.recorded.append(frame)
            for other, agent in enumerate(self.agents):
                if other == position or {other, position} & self.deaf or {other, position} in self.apart:
                    continue
                if not self.lost():
                    waiting += [(other, answer) for answer in agent.peer_bytes(frame, self.now)]

    def restart(self, position: int, **changed: Any) -> None:
        """An agent starts again, on the same store and with no memory."""
        old = self.agents[position]
        changed = {"store": old.store, "life": int(self.now) + 1, **changed}
        self.agents[position] = agent_with_keys(old.settings.node_id, base=old.settings.base, now=self.now, **changed)

    def hears(self, position: int) -> set[int]:
        """The node ids that an agent has as neighbours."""
        return set(self.agents[position].node.routing.neighbours)

    def report(self, position: int) -> dict[str, Any]:
        """What an agent's status says about streams."""
        return keyed(self.agents[position]).sessions.report_of_streams(self.now)


def signed_of(agent: Agent) -> Signed:
    return keyed(agent).signed


def beacon_of(agent: Agent) -> bytes:
    """The next beacon that it sends."""
    number = signed_of(agent).timestamps.index + 1 & 0xFFFF
    own = BEACON._replace(sender=agent.settings.node_id, life=agent.store.life, number=number)
    *_, outgoing = agent.peers.frames_of_turn([own], agent.store, 0.0)
    return agent.peers.leaving(outgoing).frame


def words_of(agent: Agent, count: int) -> list[bytes]:
    """Frames of its present turn."""
    asked = [Query(agent.settings.node_id, BROADCAST, (DatumId(9, 9, number),)) for number in range(count)]
    return [agent.peers.leaving(outgoing).frame for outgoing in agent.peers.frames(asked, agent.store, 0.0)]


def crew_of_three() -> AgentNet:
    """A base and two drones that know each other, and have handed data over."""
    net = AgentNet(agent_with_keys(1, base=True), agent_with_keys(2), agent_with_keys(3))
    net.steps(30)
    assert [net.hears(position) for position in range(3)] == [{2, 3}, {1, 3}, {1, 2}]
    return net


def last_beacon_of(node_id: int, net: AgentNet) -> bytes:
    opened = [(frame, open_datagram(frame, 0.0)) for frame in net.recorded]
    return [frame for frame, one in opened if one is not None and beacon_sender(one[3]) == node_id][-1]
