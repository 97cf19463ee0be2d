"""What `run` prints on a terminal: what the node observes, a line when something changes
(docs/reference/configuration.md).

It checks the node once a step. A neighbour that comes and goes, or invented node ids, must not fill the terminal. What
is not printed in time is printed later, if it still holds.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import Generic, TypeVar

from rass_mav.agent.agent import Agent, VehicleService
from rass_mav.agent.floods import Allowance
from rass_mav.core.routes.neighbours import is_base
from rass_mav.station.rates import SILENT_S

#: Lines about the same thing in this many seconds, at most.
MOST_CHANGES, WITHIN_S = 4, 60.0
#: Lines about neighbours in `WITHIN_S`, at most, whichever neighbours.
MOST_OF_NEIGHBOURS = 10
#: Neighbours named in one line, at most.
MOST_NAMED = 8
#: Lost neighbours that are remembered.
MAX_LOST = 256
#: After this many seconds a line names what has not been heard at all.
NOT_YET_S = 15.0

T = TypeVar("T")


class _Narrated(Generic[T]):
    """What was last printed about one thing."""

    def __init__(self, value: T) -> None:
        self.value = value
        self._allowance = Allowance(MOST_CHANGES, WITHIN_S)

    def would(self, value: T, now: float) -> bool:
        """Whether this value is news, and may be printed now."""
        return value != self.value and self._allowance.would(now)

    def changes(self, value: T, now: float) -> bool:
        """The same; the caller then prints it."""
        if not self.would(value, now):
            return False
        self._allowance.take(now)
        self.value = value
        return True


class Narration(VehicleService):
    """A service of the agent that informs the person at the terminal."""

    def __init__(
        self,
        agent: Agent,
        say: Callable[[str], None],
        now: float,
        *,
        autopilot: bool,
        reading: bool,
    ) -> None:
        """:param say: prints a line. :param autopilot, reading: whether one is expected."""
        self._agent = agent
        self._say = say
        self._expects_autopilot = autopilot
        self._expects_reading = reading
        self._not_yet_at: float | None = now + NOT_YET_S
        self._autopilot = _Narrated(False)
        self._reading = _Narrated(False)
        self._base: _Narrated[int | None] = _Narrated(None)
        self._neighbours: dict[int, _Narrated[bool]] = {}
        """By node id, whether it was last printed as heard."""
        self._of_neighbours = Allowance(MOST_OF_NEIGHBOURS, WITHIN_S)
        self._arrived = _Narrated(self._origins())

    def step(self, now: float) -> None:
        """Print what has changed."""
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
        # Anybody can send a beacon under an invented node id, so hearing it once does not count.
        heard = {id: n for id, n in self._agent.node.routing.neighbours.items() if n.confirmed}
        narrated = self._neighbours
        gone = [id for id in narrated if id not in heard]
        for id in gone[: max(0, len(gone) - MAX_LOST)]:
            del narrated[id]
        met = [id for id in sorted(heard) if narrated.setdefault(id, _Narrated(False)).would(True, now)]
        lost = [id for id, last in sorted(narrated.items()) if id not in heard and last.would(False, now)]
        if not (met or lost) or not self._of_neighbours.take(now):
            return
        for ids, there in ((met, True), (lost, False)):
            for id in ids:
                narrated[id].changes(there, now)
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
                yield "data of this node have arrived at a base"
            else:
                yield _some("data of node", map(str, sorted(origins - before)), "arrived")

    def _origins(self) -> frozenset[int]:
        """The nodes whose data have arrived at a base. On a drone: only itself."""
        node = self._agent.node
        origins = frozenset(origin for origin, _ in node.receipts.arrivals())
        return origins if node.base else origins & {node.id}

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
            yield f"not heard yet: {', '.join(missing)} (rass-mav doctor shows why)"


def _some(what: str, names: Iterable[str], verb: str) -> str:
    """A line about one or more nodes."""
    named = list(names)
    more = f" and {len(named) - MOST_NAMED} more" if len(named) > MOST_NAMED else ""
    return f"{what}{'s' if len(named) > 1 else ''} {', '.join(named[:MOST_NAMED])}{more} {verb}"
