"""What `run` says on a terminal: what the node sees, a line when something changes (docs/configuration.md).

It looks at the node once a step. A neighbour that comes and goes, or names that somebody invents, must not fill the
terminal: what is not said in time is said later, if it is still so.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import Generic, TypeVar

from rass_mav.agent.agent import Agent
from rass_mav.agent.floods import Allowance
from rass_mav.agent.rates import SILENT_S
from rass_mav.core.routes.neighbours import is_base
from rass_mav.mavlink.frames import Frame

#: The same thing is told of so often within so many seconds, at most.
MOST_CHANGES, WITHIN_S = 4, 60.0
#: So many times neighbours are told of in as many seconds, whoever they are.
MOST_OF_NEIGHBOURS = 10
#: In a line so many of them are named.
MOST_NAMED = 8
#: So many that are gone are remembered.
MAX_LOST = 256
#: After so many seconds a line says what has not been heard at all.
NOT_YET_S = 15.0

T = TypeVar("T")


class _Told(Generic[T]):
    """What was said last of one thing."""

    def __init__(self, value: T) -> None:
        self.value = value
        self._allowance = Allowance(MOST_CHANGES, WITHIN_S)

    def would(self, value: T, now: float) -> bool:
        """Whether it is news that it is so now, and may be said."""
        return value != self.value and self._allowance.would(now)

    def changes(self, value: T, now: float) -> bool:
        """The same, and it will be said."""
        if not self.would(value, now):
            return False
        self._allowance.take(now)
        self.value = value
        return True


class Narration:
    """A service of the agent that speaks to whoever watches."""

    def __init__(
        self,
        agent: Agent,
        say: Callable[[str], None],
        now: float,
        *,
        autopilot: bool,
        reading: bool,
    ) -> None:
        """:param say: takes a line. :param autopilot: whether there should be one. :param reading: likewise."""
        self._agent = agent
        self._say = say
        self._expects_autopilot = autopilot
        self._expects_reading = reading
        self._not_yet_at: float | None = now + NOT_YET_S
        self._autopilot = _Told(False)
        self._reading = _Told(False)
        self._base: _Told[int | None] = _Told(None)
        self._neighbours: dict[int, _Told[bool]] = {}
        """By node id, whether it was said to be heard."""
        self._of_neighbours = Allowance(MOST_OF_NEIGHBOURS, WITHIN_S)
        self._arrived = _Told(self._origins())

    def hear(self, frame: Frame, now: float) -> None:
        """Telemetry has it already."""

    def step(self, now: float) -> None:
        """Say what has changed."""
        for look in (self._autopilots, self._readings, self._meetings, self._routes, self._arrivals, self._not_yet):
            for line in look(now):
                self._say(line)

    def _autopilots(self, now: float) -> Iterator[str]:
        telemetry = self._agent.telemetry
        heard = telemetry.heartbeat_at is not None and now - telemetry.heartbeat_at <= SILENT_S
        if self._autopilot.changes(heard, now):
            yield f"autopilot {telemetry.system_id} heard" if heard else f"autopilot silent for {SILENT_S:g} s"

    def _readings(self, now: float) -> Iterator[str]:
        risk = self._agent.node.risk
        known, reading = risk.known(now), self._agent.last_reading
        if self._reading.changes(known, now):
            if known and reading is not None:
                yield f"sensor heard: reading {reading.value:g}, risk {risk.risk(now):.2f}"
            else:
                yield f"sensor silent for {risk.stale_s:g} s: risk counts as {risk.worst:g}"

    def _meetings(self, now: float) -> Iterator[str]:
        # Anybody can say a beacon in a name of its own invention, so heard once does not count.
        heard = {id: n for id, n in self._agent.node.routing.neighbours.items() if n.confirmed}
        told = self._neighbours
        gone = [id for id in told if id not in heard]
        for id in gone[: max(0, len(gone) - MAX_LOST)]:
            del told[id]
        met = [id for id in sorted(heard) if told.setdefault(id, _Told(False)).would(True, now)]
        lost = [id for id, last in sorted(told.items()) if id not in heard and last.would(False, now)]
        if not (met or lost) or not self._of_neighbours.take(now):
            return
        for ids, there in ((met, True), (lost, False)):
            for id in ids:
                told[id].changes(there, now)
        if met:
            yield _some("neighbour", [f"{id} (base)" if is_base(heard[id].beacon) else str(id) for id in met], "heard")
        if lost:
            yield _some("neighbour", map(str, lost), "lost")

    def _routes(self, now: float) -> Iterator[str]:
        routing = self._agent.node.routing
        route = None if self._agent.node.base else routing.route
        if self._base.changes(None if route is None else route.base, now):
            if route is None:
                yield "route to a base lost: data wait here"
            else:
                hops = "1 hop" if route.hops == 1 else f"{route.hops} hops"
                yield f"base {route.base} reached: {hops}, next node {routing.next_hop}"

    def _arrivals(self, now: float) -> Iterator[str]:
        before, origins = self._arrived.value, self._origins()
        if origins - before and self._arrived.changes(origins, now):
            if not self._agent.node.base:
                yield "a base has data of this node"
            else:
                yield _some("data of node", map(str, sorted(origins - before)), "arrived")

    def _origins(self) -> frozenset[int]:
        """Whose data have arrived at a base: of a drone, as far as it is about its own."""
        node = self._agent.node
        known = frozenset(origin for origin, _ in node.receipts.known())
        return known if node.base else known & {node.id}

    def _not_yet(self, now: float) -> Iterator[str]:
        if self._not_yet_at is None or now < self._not_yet_at:
            return
        self._not_yet_at = None
        missing = []
        if self._expects_autopilot and not self._autopilot.value:
            missing.append("autopilot")
        if self._expects_reading and not self._reading.value:
            missing.append("sensor")
        if not self._neighbours:
            missing.append("neighbour")
        if missing:
            yield f"not heard yet: {', '.join(missing)} (rass-mav doctor says why)"


def _some(what: str, names: Iterable[str], verb: str) -> str:
    """A line on one or several nodes."""
    named = list(names)
    more = f" and {len(named) - MOST_NAMED} more" if len(named) > MOST_NAMED else ""
    return f"{what}{'s' if len(named) > 1 else ''} {', '.join(named[:MOST_NAMED])}{more} {verb}"
