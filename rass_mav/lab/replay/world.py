"""The swarm of a recording: places and readings come from the logs, and who is in range from the places."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

from rass_mav.errors import LogError
from rass_mav.lab.medium.air import Record
from rass_mav.lab.medium.neighbours import TOLERANCE_M
from rass_mav.lab.swarm.autopilot import METRES_PER_DEGREE
from rass_mav.lab.swarm.virtual import Danger, VirtualSwarm

from .recording import Recording
from .settings import ReplaySettings

#: East, north and up, in metres.
Point = tuple[float, float, float]


class Projection:
    """An equirectangular projection around a place: metres east, north and up of it.

    Within 10 km of the place, and below 70 degrees of latitude, distances are accurate to 1 %.
    """

    def __init__(self, latitude: float, longitude: float, altitude: float) -> None:
        """The place: degrees, degrees, metres above mean sea level."""
        self._latitude = latitude
        self._longitude = longitude
        self._altitude = altitude
        self._east = METRES_PER_DEGREE * math.cos(math.radians(latitude))

    def point(self, latitude: float, longitude: float, altitude: float) -> Point:
        """A place in metres, by the shorter way round the Earth."""
        east = (longitude - self._longitude + 540.0) % 360.0 - 180.0
        north = latitude - self._latitude
        return east * self._east, north * METRES_PER_DEGREE, altitude - self._altitude


def links(points: Sequence[Point | None], range_m: float) -> list[list[int]]:
    """For each node the ids at most `range_m` metres away (in three dimensions), ascending.

    A node without a place (None) has no neighbours. The work is quadratic in the number of nodes.
    """
    neighbours: list[list[int]] = [[] for _ in points]
    limit = (range_m + TOLERANCE_M) ** 2
    for i, here in enumerate(points):
        if here is None:
            continue
        x, y, z = here
        for j in range(i):
            there = points[j]
            if there is None:
                continue
            dx, dy, dz = x - there[0], y - there[1], z - there[2]
            if dx * dx + dy * dy + dz * dz <= limit:
                neighbours[i].append(j)
                neighbours[j].append(i)
    return neighbours


#: A vehicle whose log has been silent for longer than this is out of range of all others, seconds.
SILENT_S = 10.0
#: The longest replay, steps.
MAX_STEPS = 1_000_000


class Place(NamedTuple):
    """The place of the base."""

    latitude: float
    """Degrees, -90..90."""
    longitude: float
    """Degrees, -180..180."""
    altitude: float
    """Metres above mean sea level."""


class ReplaySwarm(VirtualSwarm):
    """Node 0 is the base, nodes 1 to n are the vehicles of the recording. Time 0 is the first record."""

    def __init__(
        self,
        recording: Recording,
        settings: ReplaySettings,
        *,
        base: tuple[float, float] | None = None,
        record: Record | None = None,
    ) -> None:
        """:param base: latitude and longitude of the base in degrees, at the altitude of home; None: it is at home.
        :param record: called with every frame put on the air, and its step.
        :raises LogError: the logs span more than `MAX_STEPS` steps.
        """
        self.recording = recording
        step_s = settings.node.step_s
        self.span_steps = math.ceil(recording.span_s / step_s) + 1
        """Steps from the first record to the last, both included."""
        if self.span_steps > MAX_STEPS:
            raise LogError(
                f"the logs span {recording.span_s / 86400:.1f} days, more than {MAX_STEPS} steps of {step_s:g} s: "
                "replay together only logs that were recorded together, or set node.step_s"
            )
        systems = [None, *(vehicle.system_id for vehicle in recording.vehicles)]
        super().__init__(
            settings,
            [settings.agent_settings(node, system, steps=self.span_steps) for node, system in enumerate(systems)],
            topology="replay",
            record=record,
        )
        home = recording.home
        self.base: Place | None = None
        """The place of the base; None: no log has a position, so no node has a place."""
        if home is not None:
            latitude, longitude = base or (home.latitude, home.longitude)
            self.base = Place(latitude, longitude, home.altitude)
        self._projection = None if self.base is None else Projection(*self.base)
        self._range_m = settings.radio.range_m
        self._corruption = settings.radiation.corruption
        self._next = [0] * len(recording.vehicles)
        """For each vehicle, which of its records comes next."""
        self._neighbours: list[list[int]] = [[] for _ in self.agents]

    @property
    def neighbours(self) -> Sequence[Sequence[int]]:
        """For each node the ids in its range, ascending."""
        return self._neighbours

    def drain(self, steps: int, *, after: Callable[[ReplaySwarm], None] | None = None) -> int:
        """Continue with the last places of the logs, without new data, until all have arrived or for `steps` steps.

        Returns how many were needed.
        """
        for done in range(steps):
            if not self.ledger.held:
                return done
            self.run(1, after=after)
        return steps

    def _surround(self, t: int, now: float) -> None:
        for place, agent in enumerate(self.agents[1:]):
            vehicle_bytes = agent.vehicle_bytes
            for time_us, frame in self._due(place, now):
                vehicle_bytes(frame, self._seconds(time_us))
        self._neighbours = links(self._points(now), self._range_m)

    def _dangers(self) -> Iterator[Danger]:
        """The drones whose risk is known."""
        if self._corruption:
            now = self.t * self.step_s
            for agent in self.agents[1:]:
                risk = agent.node.risk
                if risk.known(now):
                    yield Danger(agent.node.id, risk.risk(now))

    def _seconds(self, time_us: int) -> float:
        """A time of the logs on the timeline of the nodes."""
        return (time_us - self.recording.start_us) / 1e6

    def _due(self, place: int, now: float) -> Sequence[tuple[int, bytes]]:
        """The records of a vehicle since the last step, up to `now`."""
        records = self.recording.vehicles[place].records
        begin = end = self._next[place]
        while end < len(records) and self._seconds(records[end][0]) <= now:
            end += 1
        self._next[place] = end
        return records[begin:end]

    def _points(self, now: float) -> list[Point | None]:
        projection = self._projection
        if projection is None:
            return [None] * len(self.agents)
        # While the swarm drains, the vehicles stay where the logs left them.
        now = min(now, self.recording.span_s)
        points: list[Point | None] = [(0.0, 0.0, 0.0)]
        for place, agent in enumerate(self.agents[1:]):
            position = agent.telemetry.position
            if position is None or now - self._heard(place) > SILENT_S:
                points.append(None)
            else:
                points.append(projection.point(position.latitude, position.longitude, position.altitude))
        return points

    def _heard(self, place: int) -> float:
        return self._seconds(self.recording.vehicles[place].records[self._next[place] - 1][0])
