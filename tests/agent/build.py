"""Short ways to what the tests of agents need again and again."""

from __future__ import annotations

import random
from collections.abc import Sequence
from typing import Any

from rass_mav.agent.agent import Agent
from rass_mav.agent.outgoing import Outgoing, Way
from rass_mav.agent.settings import AgentSettings
from rass_mav.config.loading import convert
from rass_mav.core.messages import Beacon, Message, Route
from rass_mav.core.policy import POTENTIAL_ONE
from rass_mav.mavlink.frames import FrameReader, FrameWriter
from rass_mav.mavlink.tunnel import tunnel_from_datagram
from rass_mav.station.node import build_node
from rass_mav.store.memory import MemoryStore
from rass_mav.wire import decode, encode
from tests.some import some

ONE_HOP = Route(0, 9, 1, 1)


def settings_of(node_id: int, *, base: bool = False, forward: str = "immediate", **sections: Any) -> AgentSettings:
    """`sections`: of the configuration file, each with the keys that matter."""
    raw = {"node_id": node_id, "base": base, "step_s": 1.0, "forward": forward, **sections}
    return convert(raw, AgentSettings, "test")


def make(node_id: int, *, base: bool = False, forward: str = "step", **sections: Any) -> Agent:
    settings = settings_of(node_id, base=base, forward=forward, **sections)
    store = MemoryStore(1000 + node_id, quota_bytes=settings.store.quota_bytes)
    return build_node(settings, store, random.Random(node_id), now=0.0, newborn=True)


def on(way: Way, frames: Sequence[Outgoing]) -> list[Outgoing]:
    return [outgoing for outgoing in frames if outgoing.way is way]


def step(agent: Agent, now: float) -> list[Outgoing]:
    """What a step says to the neighbours."""
    return on(Way.NEIGHBOURS, agent.step(now))


def said(frames: Sequence[Outgoing], now: float = 0.0) -> list[Any]:
    out = []
    for outgoing in on(Way.NEIGHBOURS, frames):
        fields = some(tunnel_from_datagram(outgoing.frame))
        out.append(decode(fields[5], now))
    return out


def to_vehicle(frames: Sequence[Outgoing]) -> list[Any]:
    reader = FrameReader()
    return [frame for outgoing in on(Way.VEHICLE, frames) for frame in reader.feed(outgoing.frame)]


def heard(agent: Agent, message: Message, now: float) -> list[Any]:
    """What an agent answers to a neighbour's message."""
    out: list[Any] = []
    for payload in encode(message, now):
        out += agent.peer_bytes(FrameWriter(9, 191).tunnel(payload, payload_type=33200), now)
    return out


def fit_beacon(agent: Agent, sender: int, number: int) -> Beacon:
    return Beacon(
        sender, 1, number, 0, *ONE_HOP, 0, 0, 0, 50, agent.node.policy.tag, POTENTIAL_ONE, 0
    )  # fmt: skip
