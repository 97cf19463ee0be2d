"""Agents with a mission's keys, whose bases speak for the ground."""

from __future__ import annotations

import random
from dataclasses import replace
from typing import Any

from rass_mav.agent.agent import Agent
from rass_mav.agent.outgoing import frames_about_links
from rass_mav.core.news.receipts import Receipts
from rass_mav.core.store import Store
from rass_mav.station.node import build_node
from rass_mav.store.memory import MemoryStore
from rass_mav.trust.attestations import Attestations
from rass_mav.trust.keys.attestation import Attestation
from rass_mav.trust.keys.identity import Ground
from rass_mav.trust.keys.keyring import Keyring
from rass_mav.trust.keys.secret import Secret
from rass_mav.trust.trust import trust_of
from tests.keyed import keyed

from .agent_net import AgentNet, keyring_in
from .build import settings_of

GROUND = Ground(Secret(bytes(range(32))))
#: With all the drones of these tests.
MISSION = replace(GROUND, serials=dict.fromkeys(range(2, 100), 1))
BASE_ATTESTATION = Attestation(Keyring(GROUND.node(1), GROUND))
DRONE_ATTESTATION = Attestation(Keyring(GROUND.node(7, 2), None))


def member(
    node_id: int, store: Store | None = None, *, base: bool = False, now: float = 0.0, forgiving: bool = False,
    **sections: Any,
) -> Agent:  # fmt: skip
    """An agent that takes only the ground's word about bases."""
    sections["mavlink"] = {"system_id": node_id, **sections.get("mavlink", {})}
    settings = settings_of(node_id, base=base, forward="immediate", **sections)
    store = MemoryStore(1000 + node_id) if store is None else store
    rng = random.Random(f"{node_id}:{now}")
    trust = trust_of(keyring_in(MISSION, node_id, base=base), random.Random(node_id))
    return build_node(settings, store, rng, now=now, forgiving=forgiving, keys=trust)


class GroundNet(AgentNet):
    """A base, 1, and drones from 2 on, all in range of each other."""

    def __init__(self, drones: int, *more: Agent, **sections: Any) -> None:
        ids = range(1, drones + 2)
        super().__init__(*(member(node_id, base=node_id == 1, **sections) for node_id in ids), *more)

    def restart(self, position: int, **changed: Any) -> None:
        old = self.agents[position]
        self.agents[position] = member(
            old.settings.node_id, changed.get("store", old.store), base=old.settings.base, now=self.now
        )

    def send(self, position: int, payload: bytes) -> None:
        """A payload in a frame of this agent, which is in wrong hands, reaches all others."""
        peers = self.agents[position].peers
        [outgoing] = frames_about_links([payload], peers.writer, 33200)
        frame = peers.leaving(outgoing).frame
        for other, agent in enumerate(self.agents):
            if other != position:
                agent.peer_bytes(frame, self.now)

    def known(self, position: int) -> set[tuple[int, int, int, int]]:
        """The statements that an agent knows."""
        receipts = self.agents[position].node.receipts
        assert isinstance(receipts, Receipts)
        return set(receipts.statements.of)


def attestations_of(agent: Agent) -> Attestations:
    return keyed(agent).attestations
