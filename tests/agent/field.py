"""Some agents in range of each other in virtual time, and the autopilot of one of them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rass_mav.agent.outgoing import Way
from rass_mav.lab.swarm.autopilot import MockAutopilot
from rass_mav.mavlink.frames import FrameReader
from rass_mav.mavlink.messages import GLOBAL_POSITION_INT, STATUSTEXT, parse

from .build import make, on, to_vehicle

DRONE, BASE = 7, 1


class Field:
    """Steps of one second. What the test switches off is silent."""

    def __init__(self, *others: int, **sections: Any) -> None:
        """The drone `DRONE`, the base `BASE`, and other drones."""
        self.now = 0.0
        self.drone = make(DRONE, forward="immediate", **sections)
        self.base = make(BASE, base=True, forward="immediate")
        self.agents = {DRONE: self.drone, BASE: self.base} | {id: make(id) for id in others}
        self.silent: set[int] = set()
        """Who neither hears nor is heard."""
        self.autopilot = True
        self.fix = True
        self.reading: float | None = 0.5
        self.texts: list[tuple[float, int, str]] = []
        """Time, severity and words of what the drone has told the ground."""
        self._autopilot = MockAutopilot(DRONE)

    def step(self) -> None:
        """A second later."""
        self.now += 1.0
        if self.autopilot:
            for raw in self._autopilot.frames(self.now, 0.0, 0.0, self.reading):
                [frame] = FrameReader().feed(raw)
                if self.fix or frame.message_id != GLOBAL_POSITION_INT:
                    self.drone.vehicle_bytes(raw, self.now)
        for id, agent in self.agents.items():
            if id not in (DRONE, BASE):
                agent.reading(1e6, self.now)  # the worst risk, and something to measure
            frames = agent.step(self.now)
            if id == DRONE:
                messages = [parse(frame) for frame in to_vehicle(frames) if frame.message_id == STATUSTEXT]
                self.texts += [(self.now, message.severity, message.text) for message in messages]
            waiting = [(id, outgoing) for outgoing in on(Way.NEIGHBOURS, frames)]
            while waiting:
                sender, outgoing = waiting.pop(0)
                for other, hearer in self.agents.items():
                    if other != sender and not {other, sender} & self.silent:
                        answers = on(Way.NEIGHBOURS, hearer.peer_bytes(outgoing.frame, self.now))
                        waiting += [(other, answer) for answer in answers]

    def until(self, now: float, each: Callable[[], None] = lambda: None) -> None:
        """All steps up to a time; `each` is called before each of them."""
        while self.now < now:
            each()
            self.step()

    def told(self) -> list[str]:
        """The texts since the last call."""
        texts, self.texts = [text for _, _, text in self.texts], []
        return texts
