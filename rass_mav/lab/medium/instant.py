"""The air that takes no time: all that is sent at one time arrives at that time, or whole steps later."""

from __future__ import annotations

import random
from collections.abc import Callable, Mapping, Sequence

from rass_mav.agent.agent import Agent
from rass_mav.agent.outgoing import Outgoing

from .air import Air, Heard
from .radio import Radio
from .settings import RadioSection
from .tally import Record
from .timeline import Order, Timeline


class Instant(Air):
    """A `Radio` on the timeline."""

    def __init__(
        self,
        settings: RadioSection,
        timeline: Timeline,
        reach: Callable[[], Sequence[Sequence[int]]],
        heard: Heard,
        *,
        seed: int,
        record: Record | None,
    ) -> None:
        """`reach`: for each node, then for each attacker, the nodes in its range now."""
        self.tally = self._radio = Radio(settings, random.Random(f"{seed}:radio"), record=record)
        self.at_once = not settings.latency_steps
        self._delays = bool(settings.latency_steps or settings.reorder)
        self._timeline = timeline
        self._reach = reach
        self._heard = heard
        self._t = 0
        self._delivers_at = -1.0
        """For which time the delivery is planned, seconds."""

    def arrive(self, t: int, now: float) -> None:
        """Frames that take whole steps, and those that others have overtaken, arrive."""
        self._t = t
        if self._delays:
            self._radio.begin_step(t)
            self._deliver(now)

    def rearrange(self) -> None:
        """A frame is heard where nodes are when it arrives."""

    def send(self, node: int, outgoing: Outgoing, now: float) -> None:
        """There is no driver: the frame is on the air."""
        self.broadcast(node, outgoing.frame, now)

    def broadcast(self, sender: int, frame: bytes, now: float) -> None:
        """It arrives after all that happens at this time."""
        self._radio.send(sender, frame, self._t)
        if self.at_once and self._delivers_at < now:
            self._delivers_at = now
            self._timeline.at(now, Order.AIR, self._deliver)

    def _deliver(self, now: float) -> None:
        """Deliver until the air is quiet."""
        for hearers, frame in self._radio.arrivals(self._t, self._reach()):
            self._heard(hearers, frame, now)

    def start(self, node: int, agent: Agent, now: float) -> None:
        """There is no driver."""

    def stop(self, node: int) -> None:
        """What a node has sent still arrives."""

    def begin_turn(self, node: int, agent: Agent, now: float) -> None:
        """This air has no limit."""

    def strike(self, probabilities: Mapping[int, float], now: float) -> None:
        """Nothing waits."""

    def figures(self, seconds: float) -> dict[str, float]:
        """There is nothing to say."""
        return {}
