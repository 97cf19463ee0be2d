"""The drivers of the nodes on an air that takes time: each has the pacer and the queues of a real one."""

from __future__ import annotations

import random
from array import array
from bisect import bisect_right
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from math import expm1, log1p

from rass_mav.agent.agent import Agent
from rass_mav.agent.outgoing import Outgoing
from rass_mav.app.duplicates import Duplicates
from rass_mav.app.linkqueue import LinkQueue, set_pace
from rass_mav.core.exchange import SPREAD_S
from rass_mav.link.backlog import WAITING_FRAME_BYTES

from .air import Air, Heard, Record
from .channel import Csma, Order, Tdma, Timeline
from .neighbours import Position, Reach
from .settings import RadioSection

#: A strike that hits everything, in numbers that can be subtracted.
_MOST = 1.0 - 1e-12


class Exposure:
    """The strikes that each node has been exposed to."""

    def __init__(self, nodes: int, rng: random.Random) -> None:
        self._rng = rng
        self._times: list[float] = []
        # For each node the sum of -log(1 - probability) before each strike, and after the last.
        self._sums = [array("d", [0.0]) for _ in range(nodes)]

    def strike(self, probabilities: Mapping[int, float], now: float) -> None:
        """A strike. `probabilities`: that an item at a node is hit, 0..1; nodes that are left out are safe."""
        self._times.append(now)
        for node, sums in enumerate(self._sums):
            sums.append(sums[-1] - log1p(-min(probabilities.get(node, 0.0), _MOST)))

    def touched(self, node: int, frame: bytes, since: float, until: float) -> bytes:
        """A frame after it was at a node between two times, seconds: with a flipped bit if a strike hit it."""
        sums = self._sums[node]
        exposed = sums[bisect_right(self._times, until)] - sums[bisect_right(self._times, since)]
        if not exposed or self._rng.random() >= -expm1(-exposed):
            return frame
        place = self._rng.randrange(8 * len(frame))
        struck = bytearray(frame)
        struck[place // 8] ^= 1 << place % 8
        return bytes(struck)


#: Seconds between two reports of a radio about its buffer.
REPORT_S = 1.0


class Drivers(Air):
    """What is between the nodes and the air."""

    def __init__(
        self,
        settings: RadioSection,
        timeline: Timeline,
        reach: Callable[[], Sequence[Sequence[int]]],
        places: Callable[[], Sequence[Position]],
        heard: Heard,
        *,
        nodes: int,
        attackers: int,
        step_s: float,
        seed: int,
        record: Record | None,
    ) -> None:
        """`reach`: for each node, then for each attacker, the nodes in its range now. `places`: where the nodes are,
        metres."""
        self._reach = reach
        self._places = places
        kind = Csma if settings.kind == "csma" else Tdma
        self.tally = self._medium = kind(
            settings, timeline, Reach(settings, seed), self._end, stations=nodes + attackers, step_s=step_s,
            rng=random.Random(f"{seed}:radio"), record=record,
        )  # fmt: skip
        self._timeline = timeline
        self._heard = heard
        self._nodes = nodes
        self._seed = seed
        self._link_queues: list[LinkQueue | None] = [None] * nodes
        """The link of each node; None: it is off."""
        self._due = [0] * nodes
        """Number of each node's last alarm: earlier ones are cancelled."""
        self._reporting: list[LinkQueue | None] = [None] * nodes
        """The link for which each node's radio will report its buffer."""
        self._exposure = Exposure(nodes, random.Random(f"{seed}:flying"))

    def arrive(self, t: int, now: float) -> None:
        """Frames arrive when it is their time."""

    def rearrange(self) -> None:
        """Nodes have moved."""
        self._medium.reach.update(self._reach(), self._places())

    def broadcast(self, sender: int, frame: bytes, now: float) -> None:
        """The radio gets the frame."""
        self._medium.send(sender, frame, now, now)

    def figures(self, seconds: float) -> dict[str, float]:
        """For the summary."""
        return self._medium.figures(seconds)

    def start(self, node: int, agent: Agent, now: float) -> None:
        """A node is switched on."""
        channel = self._medium.channel
        self._medium.switch_on(node)
        if channel.budget is None:
            agent.answers.spread_s = SPREAD_S
        agent.answers.broadcast = channel.mac == "broadcast"
        self._link_queues[node] = LinkQueue(
            agent, Duplicates(), budget=channel.budget, interface=partial(self._waiting, node),
            rng=random.Random(f"{self._seed}:lane:{node}:{now}"), now=now,
        )  # fmt: skip

    def stop(self, node: int) -> None:
        """A node goes off: what waits is gone."""
        self._link_queues[node] = self._reporting[node] = None
        self._medium.switch_off(node)

    def strike(self, probabilities: Mapping[int, float], now: float) -> None:
        """Radiation strikes: see `Exposure`."""
        self._exposure.strike(probabilities, now)

    def begin_turn(self, node: int, agent: Agent, now: float) -> None:
        """Tell a node what its link can carry."""
        link_queue = self._link_queues[node]
        assert link_queue is not None
        link_queue.meet(agent.node.routing.neighbours.keys())
        set_pace(
            agent, [link_queue], now, 0 if link_queue.pacer is not None else len(self._medium.stations[node].waiting)
        )

    def send(self, node: int, outgoing: Outgoing, now: float) -> None:
        """A node sends a frame to its neighbours."""
        link_queue = self._link_queues[node]
        assert link_queue is not None
        link_queue.push(outgoing, now)
        self._pump(node, link_queue, now)
        if self._medium.channel.reports:
            self._report_later(node, link_queue, now)

    def _pump(self, node: int, link_queue: LinkQueue, now: float) -> None:
        """Let what may leave now go to the radio."""
        while (queued := link_queue.pop(now)) is not None:
            self._medium.send(node, queued.frame, queued.since, now, queued.target)
        due = link_queue.next_at(now)
        if due is None:
            return
        self._due[node] += 1
        alarm = self._due[node]

        def ring(now: float) -> None:
            if alarm == self._due[node] and link_queue is self._link_queues[node]:
                self._pump(node, link_queue, now)

        self._timeline.at(max(due, now), Order.AIR, ring)

    def _waiting(self, node: int) -> int:
        """What a node's radio has to send, bytes as a system counts them."""
        station = self._medium.stations[node]
        return WAITING_FRAME_BYTES * (len(station.waiting) + (station.serves is not None))

    def _report_later(self, node: int, link_queue: LinkQueue, now: float) -> None:
        """Let the radio report its buffer in a second, and then as long as its reports change anything."""
        if self._reporting[node] is link_queue:
            return
        self._reporting[node] = link_queue

        def report(now: float) -> None:
            if link_queue is not self._reporting[node]:
                return
            self._reporting[node] = None
            assert link_queue.pacer is not None
            free = self._medium.free_percent(node)
            if free < 100 or link_queue.pacer.throttle < 1.0:
                link_queue.pacer.radio_status(free, now)
                self._report_later(node, link_queue, now)

        self._timeline.at(now + REPORT_S, Order.AIR, report)

    def _end(self, hearers: Sequence[int], sender: int, frame: bytes, since: float, now: float) -> None:
        """A frame has been heard to its end."""
        if sender < self._nodes:
            frame = self._exposure.touched(sender, frame, since, now)
        budget = self._medium.channel.budget
        if budget is not None and budget.listen_s:
            for hearer in hearers:
                link_queue = self._link_queues[hearer]
                if link_queue is not None and link_queue.pacer is not None:
                    link_queue.pacer.heard(now, len(frame))
        self._heard(hearers, frame, now)
