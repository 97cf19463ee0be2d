"""A ground station's side of a conversation with a node, in virtual time: read by pymavlink's own parser."""

from __future__ import annotations

import random
from typing import Any

from rass_mav.agent.commits import CommitGate
from rass_mav.agent.outgoing import Outgoing, Way
from rass_mav.core.store import Store
from rass_mav.mavlink import component as mav
from rass_mav.mavlink.dialect import MavlinkMessage, common
from rass_mav.mavlink.frames import FrameWriter
from rass_mav.mavlink.messages import (
    HEARTBEAT,
)
from rass_mav.station.ground import VALUE_NAMES, Ground
from rass_mav.station.node import build_node
from rass_mav.store.memory import MemoryStore

from .build import settings_of

GCS = (255, 190)
QUIET = {"values_s": 0, "computer_s": 0}
#: The values that a drone says. What its policy goes by is either a fitness or a cost.
SAID = [name for name in VALUE_NAMES if name != "RASS_COST"]


class Conversation:
    """An agent with a ground station that asks through the autopilot, and with its own hands on the clock."""

    def __init__(self, node_id: int = 7, store: Store | None = None, **sections: Any) -> None:
        # Most parameters are weights of this policy.
        sections["policy"] = {"name": "rass", **sections.get("policy", {})}
        sections["ground"] = {**QUIET, "may_set_by_radio": True, **sections.get("ground", {})}
        self.now = 0.0
        self.store: Store = store or MemoryStore(1000 + node_id)
        about = settings_of(node_id, **sections)
        self.agent = build_node(about, self.store, random.Random(1), now=0.0)
        assert isinstance(self.agent.ground, Ground)
        self.ground = self.agent.ground
        self.gate = CommitGate(self.store)
        self.leaving: list[Outgoing] = []
        self.gcs = FrameWriter(*GCS)
        self.parsers = (common.MAVLink(None), common.MAVLink(None))
        self.times: list[float] = []

    def ask(self, message: MavlinkMessage, *, direct: bool = False) -> None:
        data = self.gcs.message(message)
        if direct:
            self.ground.receive(data, self.now)
        else:
            self.agent.vehicle_bytes(data, self.now)

    def commit(self) -> None:
        """What a driver does: the store writes, and what waited for that leaves."""
        batch = self.gate.begin()
        if batch is not None:
            self.store.write(batch)
        self.leaving += self.gate.written()

    def hear(self, until: float | None = None, *, direct: bool = False) -> list[Any]:
        """What arrives at the ground station up to a time (default: half a second from now), woken up as asked."""
        until = self.now + 0.5 if until is None else until
        out = []
        while self.now <= until:
            frames, due = self.agent.tend(self.now)
            self.leaving += self.gate.say(frames)
            while self.leaving:
                outgoing = self.leaving.pop(0)
                for message in self.parsers[outgoing.way].parse_buffer(outgoing.frame):
                    if (outgoing.way is Way.GROUND) is direct:
                        out.append(message)
                        self.times.append(self.now)
            assert due > self.now, "or it would be asked for ever"
            self.now = due
        self.now = until
        return [m for m in out if m.get_msgId() != HEARTBEAT]

    def set(self, name: str, value: float, kind: int = mav.REAL32, *, direct: bool = False) -> list[Any]:
        self.ask(common.MAVLink_param_set_message(7, 191, name.encode(), value, kind), direct=direct)
        self.commit()
        return self.hear(direct=direct)

    def command(self, command: int, *params: float, component: int = 191) -> list[Any]:
        filled = [*params, *[0.0] * (7 - len(params))]
        self.ask(common.MAVLink_command_long_message(7, component, command, 0, *filled))
        return self.hear()


def values(messages: list[Any]) -> dict[str, float]:
    return {m.param_id: m.param_value for m in messages if m.get_type() == "PARAM_VALUE"}


def kinds(messages: list[Any]) -> list[str]:
    return [m.get_type() for m in messages]
