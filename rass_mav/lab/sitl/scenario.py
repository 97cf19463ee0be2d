"""Scenarios of flying vehicles: those of a mock swarm, with `positions` as take-off positions, and missions."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Annotated, Any

from rass_mav.config.sections import Meta, NodeId, Positive, Section
from rass_mav.errors import ConfigError
from rass_mav.lab.medium.neighbours import Position
from rass_mav.lab.swarm.autopilot import ORIGIN, to_earth
from rass_mav.lab.swarm.scenario import FailureSection, Scenario, TrafficSection, find, read_scenario

from .mission import (
    CMD_RETURN,
    CMD_SPEED,
    CMD_TAKEOFF,
    CMD_WAYPOINT,
    FRAME_GLOBAL,
    FRAME_NO_PLACE,
    FRAME_RELATIVE,
    MissionItem,
)

Waypoint = Annotated[list[float], Meta(min_length=2, max_length=3)]


class FlightSection(Section):
    """The flights of the vehicles."""

    altitude_m: Positive = 15.0
    """Height above the take-off position, metres."""
    speed_m_s: Positive = 5.0
    missions: tuple[tuple[Waypoint, ...], ...] = ()
    """For each drone, by node id, the places it flies to: [x, y] or [x, y, seconds to stay]. Then it returns. A drone
    without any stays above its take-off position for the whole run."""


class FlightFailureSection(FailureSection):
    """Failures in flight. Of the failures of other swarms, only `kill_every_s` is supported."""

    kill_autopilots: tuple[tuple[NodeId, Positive], ...] = ()
    """[drone, seconds after take-off]: its autopilot dies permanently. Its node continues."""


class FlightScenario(Scenario):
    """A scenario for `rass-mav sitl`."""

    flight: FlightSection = FlightSection()
    failures: FlightFailureSection = FlightFailureSection()

    def mistakes(self) -> Iterator[str]:
        """Mistakes that concern more than one key."""
        yield from super().mistakes()
        for node, _ in self.failures.kill_autopilots:
            if not self.bases <= node < self.nodes:
                yield f"failures.kill_autopilots: expected drones, {self.bases}..{self.nodes - 1}, got {node}"
        if self.topology != "positions":
            yield f"topology: expected positions (the take-off positions), got {self.topology}"
        drones = self.nodes - self.bases
        if len(self.flight.missions) > drones:
            yield f"flight.missions: expected at most one for each of {drones} drones"
        if self.radiation.drift or self.radiation.cylinder_m:
            yield "radiation: expected sources that do not move, and no cylinders"
        if self.traffic != TrafficSection():
            yield "traffic: expected its defaults with flying vehicles"
        if self.radiation.law != "paper":
            yield f"radiation.law: expected paper with flying vehicles, got {self.radiation.law}"

    @property
    def places(self) -> list[Position]:
        """Each node's position at the start, metres east and north of the origin."""
        return list(self.mobility.positions or ())

    @property
    def sources(self) -> list[tuple[float, float, float]]:
        """x, y in metres and intensity of each source."""
        return list(self.radiation.sources_of(self.seed) or ())

    def level(self, x: float, y: float, height: float) -> float:
        """Radiation at a place in the air, Eq. 1 with the height (metres) included."""
        decay = self.radiation.decay
        return sum(
            intensity / (1.0 + decay * ((sx - x) ** 2 + (sy - y) ** 2 + height**2))
            for sx, sy, intensity in self.sources
        )

    def waypoints(self, node_id: int) -> Sequence[Sequence[float]]:
        """The places that a drone flies to, as in `flight.missions`; none: it stays above its take-off position."""
        number = node_id - self.bases
        missions = self.flight.missions
        return missions[number] if number < len(missions) else ()

    def mission(self, node_id: int, *, home_first: bool) -> list[MissionItem]:
        """The mission of a drone. `home_first`: item 0 is home, as with ArduPilot."""
        flight = self.flight
        start = self.places[node_id]
        stay = self.steps * self.node.step_s
        home = to_earth(*start)
        items = [MissionItem(CMD_WAYPOINT, FRAME_GLOBAL, *home, ORIGIN[2])] if home_first else []
        items.append(MissionItem(CMD_TAKEOFF, FRAME_RELATIVE, *home, flight.altitude_m))
        # 1: speed over ground. -1 would mean: leave the throttle unchanged.
        items.append(MissionItem(CMD_SPEED, FRAME_NO_PLACE, param1=1.0, param2=flight.speed_m_s))
        for x, y, *hold in self.waypoints(node_id) or [(*start, stay)]:
            place = to_earth(x, y)
            items.append(MissionItem(CMD_WAYPOINT, FRAME_RELATIVE, *place, flight.altitude_m, param1=sum(hold)))
        items.append(MissionItem(CMD_RETURN, FRAME_NO_PLACE))
        return items


def load_flight(
    name: str, options: dict[str, Any] | None = None, assignments: Sequence[str] = (), vehicles: int | None = None
) -> FlightScenario:
    """A scenario from a file. `options` by key path, then `assignments` (`key.path=value`) override its keys.

    `vehicles`: how many of its drones, the first ones; None: all. Raises `ConfigError`, which names the file and key.
    """
    path = find(name)
    scenario = read_scenario(path, FlightScenario, options or {}, assignments)
    if scenario.variants:
        raise ConfigError(f"{path.name}: variants: not for scenarios of flying vehicles")
    if vehicles is not None:
        scenario = _fewer(scenario, vehicles, path.name)
    return scenario


def _fewer(scenario: FlightScenario, vehicles: int, name: str) -> FlightScenario:
    drones = scenario.nodes - scenario.bases
    if not 1 <= vehicles <= drones:
        raise ConfigError(f"--vehicles: expected 1..{drones}, the drones of {name}, got {vehicles}")
    nodes = scenario.bases + vehicles
    failures = scenario.failures
    doomed = tuple((node, at_s) for node, at_s in failures.kill_autopilots if node < nodes)
    return replace(
        scenario,
        nodes=nodes,
        failures=replace(failures, kill_autopilots=doomed),
        mobility=replace(scenario.mobility, positions=scenario.places[:nodes]),
        flight=replace(scenario.flight, missions=scenario.flight.missions[:vehicles]),
    )
